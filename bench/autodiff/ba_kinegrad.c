/* Bundle adjustment by kinegrad: one observation recorded as scalar operators.
 *
 *   recorded   anew for each observation, both rows of its Jacobian in one backward sweep
 *   replayed   recorded once and frozen; runs on LANES observations side by side (with 256 the rows
 *              would start 4096 bytes apart and compete for the same lines of the cache)
 *
 * Weight residuals have a program of their own; so has the loss, summed over the lanes after. */
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/cases.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"

enum { LANES = 248, INPUTS = KG_BENCH_BA_INPUTS, CAMERA = KG_BENCH_BA_CAMERA, WEIGHT = 14 };

/* ---- one observation ------------------------------------------------------------------------- */

typedef struct observation {
  kg_value in[INPUTS + 2]; /* camera, point, weight, and the feature, which is data */
  kg_value residual[2];
} observation;

static void inputs(kg_tape *t, const double *x, const double *feature, observation *o)
{
  kg_scalars(t, INPUTS, x, o->in);
  o->in[INPUTS] = kg_constant_scalar(t, feature[0]);
  o->in[INPUTS + 1] = kg_constant_scalar(t, feature[1]);
}

static kg_value sum3(kg_tape *t, kg_value a, kg_value b, kg_value c)
{
  return kg_add(t, kg_add(t, a, b), c);
}

/* y = R(r) v = v cos a + (e x v) sin a + e (e . v) (1 - cos a),  a = |r|, e = r / a */
static void rotate(kg_tape *t, const kg_value *r, const kg_value *v, kg_value *y)
{
  const kg_value square = sum3(t, kg_square(t, r[0]), kg_square(t, r[1]), kg_square(t, r[2]));
  const kg_value angle = kg_sqrt(t, square), one_over = kg_reciprocal(t, angle);
  const kg_value c = kg_cos(t, angle), s = kg_sin(t, angle);
  kg_value e[3], product[3];
  for (int i = 0; i < 3; ++i) {
    e[i] = kg_mul(t, r[i], one_over);
    product[i] = kg_mul(t, e[i], v[i]);
  }
  const kg_value rest = kg_sub(t, kg_constant_scalar(t, 1), c);
  const kg_value along = kg_mul(t, sum3(t, product[0], product[1], product[2]), rest);
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    const kg_value across = kg_sub(t, kg_mul(t, e[j], v[k]), kg_mul(t, e[k], v[j]));
    y[i] = sum3(t, kg_mul(t, v[i], c), kg_mul(t, across, s), kg_mul(t, e[i], along));
  }
}

static void observe(kg_tape *t, observation *o)
{
  const kg_value *r = o->in, *C = o->in + 3, *x0 = o->in + 7, *k = o->in + 9, *X = o->in + CAMERA;
  const kg_value f = o->in[6], w = o->in[WEIGHT], *feature = o->in + INPUTS;
  kg_value v[3], y[3], u[2];
  for (int i = 0; i < 3; ++i) {
    v[i] = kg_sub(t, X[i], C[i]);
  }
  rotate(t, r, v, y);
  for (int i = 0; i < 2; ++i) {
    u[i] = kg_div(t, y[i], y[2]);
  }
  const kg_value u2 = kg_add(t, kg_square(t, u[0]), kg_square(t, u[1]));
  const kg_value bend = kg_mul(t, u2, kg_add(t, k[0], kg_mul(t, k[1], u2)));
  const kg_value fd = kg_mul(t, f, kg_shift(t, bend, 1));
  for (int i = 0; i < 2; ++i) {
    const kg_value seen = kg_add(t, kg_mul(t, fd, u[i]), x0[i]);
    o->residual[i] = kg_mul(t, w, kg_sub(t, seen, feature[i]));
  }
}

static kg_value weight_residual(kg_tape *t, kg_value w)
{
  return kg_shift(t, kg_neg(t, kg_square(t, w)), 1);
}

static kg_value half_square(kg_tape *t, kg_value a, kg_value b, kg_value c)
{
  return kg_scale(t, sum3(t, kg_square(t, a), kg_square(t, b), kg_square(t, c)), 0.5);
}

/* ---- recorded -------------------------------------------------------------------------------- */

typedef struct state {
  const kg_bench_ba *ba;
  kg_tape *tape;
  kg_program *program, *weights;
} state;

void kg_bench_ba_tape_destroy(void *memory)
{
  state *s = memory;
  kg_tape_destroy(s->tape);
  kg_program_destroy(s->program);
  kg_program_destroy(s->weights);
  free(s);
}

kg_status kg_bench_ba_recorded(void **memory, const void *data, const kg_allocator *allocator)
{
  state *s = calloc(1, sizeof *s);
  if (!s) return KG_ERR_NO_MEMORY;
  kg_tape_def def = kg_tape_default_def();
  def.allocator = allocator;
  s->ba = data;
  const kg_status status = kg_tape_create(&def, &s->tape, NULL);
  if (status == KG_OK) {
    *memory = s;
  } else {
    kg_bench_ba_tape_destroy(s);
  }
  return status;
}

/* the two rows of observation i, 15 entries each */
static kg_status record_rows(state *s, int i, double *rows)
{
  static const double unit[2][2] = {{1, 0}, {0, 1}}; /* seeds of an output: one a direction */
  const double *const seeds[2] = {unit[0], unit[1]};
  double x[INPUTS], entries[INPUTS][2], *results[INPUTS];
  observation o;
  kg_bench_ba_inputs(s->ba, s->ba->theta, i, x);
  kg_tape_rewind(s->tape, (kg_tape_mark){0});
  inputs(s->tape, x, s->ba->feature + 2 * (size_t)i, &o);
  observe(s->tape, &o);
  for (int k = 0; k < INPUTS; ++k) {
    results[k] = entries[k];
  }
  const kg_status status = kg_vjp(s->tape, 2, 2, o.residual, seeds, INPUTS, o.in, results);
  for (int k = 0; k < INPUTS && status == KG_OK; ++k) {
    rows[k] = entries[k][0];
    rows[INPUTS + k] = entries[k][1];
  }
  return status;
}

static kg_status record_weight(state *s, int i, double *entry)
{
  const size_t first = (size_t)s->ba->n * CAMERA + (size_t)s->ba->m * 3;
  kg_tape_rewind(s->tape, (kg_tape_mark){0});
  const kg_value w = kg_scalar(s->tape, s->ba->theta[first + (size_t)i]);
  return kg_gradient(s->tape, weight_residual(s->tape, w), 1, &w, &entry);
}

kg_status kg_bench_ba_recorded_observations(void *memory, double *answer)
{
  state *s = memory;
  kg_status status = KG_OK;
  for (int i = 0; i < s->ba->p && status == KG_OK; ++i) {
    status = record_rows(s, i, answer + 2 * INPUTS * (size_t)i);
  }
  return status;
}

kg_status kg_bench_ba_recorded_jacobian(void *memory, double *answer)
{
  state *s = memory;
  kg_status status = kg_bench_ba_recorded_observations(s, answer);
  for (int i = 0; i < s->ba->p && status == KG_OK; ++i) {
    status = record_weight(s, i, answer + 2 * INPUTS * (size_t)s->ba->p + i);
  }
  return status;
}

/* ---- replayed -------------------------------------------------------------------------------- */

static kg_status freeze(state *s, const kg_allocator *allocator, int input_count,
                        const kg_value *in, int output_count, const kg_value *out,
                        kg_program **program)
{
  const kg_program_def def = {.lanes = LANES, .allocator = allocator};
  return kg_program_create(&def, s->tape, input_count, in, output_count, out, program, NULL);
}

static void seed_row(kg_program *program, int o, int directions, int direction)
{
  double *seed = kg_program_seed(program, o, directions);
  for (int lane = 0; seed && lane < LANES; ++lane) {
    seed[direction * LANES + lane] = 1;
  }
}

/* tape and programs; any observation serves to record one */
static kg_status create_programs(void **memory, const void *data, const kg_allocator *allocator,
                                 bool is_loss)
{
  kg_status status = kg_bench_ba_recorded(memory, data, allocator);
  if (status != KG_OK) return status;
  state *s = *memory;
  double x[INPUTS];
  observation o;
  kg_bench_ba_inputs(s->ba, s->ba->theta, 0, x);
  inputs(s->tape, x, s->ba->feature, &o);
  observe(s->tape, &o);
  const kg_value of_weight = weight_residual(s->tape, o.in[WEIGHT]);
  const kg_value loss = half_square(s->tape, o.residual[0], o.residual[1], of_weight);
  status = freeze(s, allocator, INPUTS + 2, o.in, is_loss ? 1 : 2, is_loss ? &loss : o.residual,
                  &s->program);
  if (status == KG_OK) {
    status = freeze(s, allocator, 1, &o.in[WEIGHT], 1, &of_weight, &s->weights);
  }
  if (status != KG_OK) {
    kg_bench_ba_tape_destroy(s);
    return status;
  }
  seed_row(s->weights, 0, 1, 0);
  seed_row(s->program, 0, is_loss ? 1 : 2, 0);
  if (!is_loss) seed_row(s->program, 1, 2, 1);
  return KG_OK;
}

kg_status kg_bench_ba_jacobian_replayed(void **memory, const void *data,
                                        const kg_allocator *allocator)
{
  return create_programs(memory, data, allocator, false);
}

kg_status kg_bench_ba_loss_replayed(void **memory, const void *data, const kg_allocator *allocator)
{
  return create_programs(memory, data, allocator, true);
}

static int fewer(int left)
{
  return left < LANES ? left : LANES;
}

/* `width` numbers of each of count items, the item in a lane; idle lanes keep what they had */
static void gather(kg_program *program, int first, int width, const double *from, const int *item,
                   int count)
{
  double *row[INPUTS];
  for (int k = 0; k < width; ++k) {
    row[k] = kg_program_input(program, first + k);
  }
  for (int lane = 0; lane < count; ++lane) {
    const double *x = from + (item ? item[lane] : lane) * width;
    for (int k = 0; k < width; ++k) {
      row[k][lane] = x[k];
    }
  }
}

static kg_status run_observations(state *s, int start, int count, int directions)
{
  const kg_bench_ba *ba = s->ba;
  const double *points = ba->theta + (size_t)ba->n * CAMERA, *weights = points + (size_t)ba->m * 3;
  gather(s->program, 0, CAMERA, ba->theta, ba->camera + start, count);
  gather(s->program, CAMERA, 3, points, ba->point + start, count);
  gather(s->program, WEIGHT, 1, weights + start, NULL, count);
  gather(s->program, INPUTS, 2, ba->feature + 2 * (size_t)start, NULL, count);
  const kg_status status = kg_program_run(s->program);
  return status == KG_OK ? kg_program_backward(s->program, directions) : status;
}

/* from rows of lanes to observations one after the other; some lanes at a time, so that what one
 * cache line holds is used while it is there */
static void store_rows(state *s, int count, double *restrict to)
{
  enum { TOGETHER = 8 };
  const double *rows[INPUTS];
  for (int k = 0; k < INPUTS; ++k) {
    rows[k] = kg_program_adjoint(s->program, k);
  }
  for (int start = 0; start < count; start += TOGETHER) {
    const int n = count - start < TOGETHER ? count - start : TOGETHER;
    for (int k = 0; k < INPUTS; ++k) {
      const double *adjoint = rows[k] + start;
      double *entry = to + (size_t)start * 2 * INPUTS + k;
      for (int lane = 0; lane < n; ++lane, entry += 2 * INPUTS) {
        entry[0] = adjoint[lane];
        entry[INPUTS] = adjoint[LANES + lane];
      }
    }
  }
}

kg_status kg_bench_ba_replay_observations(void *memory, double *answer)
{
  state *s = memory;
  kg_status status = KG_OK;
  for (int start = 0; start < s->ba->p && status == KG_OK; start += LANES) {
    const int count = fewer(s->ba->p - start);
    status = run_observations(s, start, count, 2);
    store_rows(s, count, answer + 2 * INPUTS * (size_t)start);
  }
  return status;
}

kg_status kg_bench_ba_replay_jacobian(void *memory, double *answer)
{
  state *s = memory;
  double *of_weights = answer + 2 * INPUTS * (size_t)s->ba->p;
  const double *weights = s->ba->theta + (size_t)s->ba->n * CAMERA + (size_t)s->ba->m * 3;
  kg_status status = kg_bench_ba_replay_observations(s, answer);
  for (int start = 0; start < s->ba->p && status == KG_OK; start += LANES) {
    const int count = fewer(s->ba->p - start);
    gather(s->weights, 0, 1, weights + start, NULL, count);
    status = kg_program_run(s->weights);
    if (status == KG_OK) status = kg_program_backward(s->weights, 1);
    memcpy(of_weights + start, kg_program_adjoint(s->weights, 0), (size_t)count * sizeof *answer);
  }
  return status;
}

/* adds row k of the adjoints to entry k of what an observation joins */
static void scatter(const kg_program *program, int first, int width, double *to, const int *number,
                    int count)
{
  for (int k = 0; k < width; ++k) {
    const double *adjoint = kg_program_adjoint(program, first + k);
    for (int lane = 0; lane < count; ++lane) {
      to[number[lane] * width + k] += adjoint[lane];
    }
  }
}

kg_status kg_bench_ba_replay_loss(void *memory, double *answer)
{
  state *s = memory;
  const kg_bench_ba *ba = s->ba;
  double *cameras = answer + 1, *points = cameras + (size_t)ba->n * CAMERA;
  double *weights = points + (size_t)ba->m * 3;
  kg_status status = KG_OK;
  memset(answer, 0, (1 + (size_t)ba->parameter_count) * sizeof *answer);
  for (int start = 0; start < ba->p && status == KG_OK; start += LANES) {
    const int count = fewer(ba->p - start);
    status = run_observations(s, start, count, 1);
    const double *loss = kg_program_output(s->program, 0);
    for (int lane = 0; lane < count; ++lane) {
      answer[0] += loss[lane];
    }
    scatter(s->program, 0, CAMERA, cameras, ba->camera + start, count);
    scatter(s->program, CAMERA, 3, points, ba->point + start, count);
    memcpy(weights + start, kg_program_adjoint(s->program, WEIGHT),
           (size_t)count * sizeof *weights);
  }
  return status;
}
