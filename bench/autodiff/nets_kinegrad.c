/* The nets on kinegrad's tape. */
#include "bench/autodiff/nets_kinegrad.h"

#include <stdlib.h>
#include <string.h>

#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"

enum { LAYERS = KG_BENCH_NET_LAYERS };
enum { X = 2 * LAYERS, TARGET, INPUTS }; /* of the program, behind the parameters */

typedef struct net {
  const kg_bench_net *of;
  kg_arena arena;
  kg_sparse adjacency;
  kg_tape *tape;
  kg_value parameter[2 * LAYERS]; /* W_0, b_0, W_1, ... */
  kg_tape_mark parameters_end;
  kg_program *program;
} net;

/* ---- the model ------------------------------------------------------------------------------- */

static kg_sparse sparse_of(const kg_bench_net *of, kg_arena *arena)
{
  const int n = of->group;
  int32_t *start = KG_ARENA_ARRAY(arena, int32_t, n + 1);
  int32_t *column = KG_ARENA_ARRAY(arena, int32_t, n * n);
  double *weight = KG_ARENA_ARRAY(arena, double, n *n);
  for (int i = 0, k = 0; !kg_arena_failed(arena) && i < n; i++) {
    for (int j = 0; j < n; j++) {
      if (of->adjacency[i * n + j] != 0.0f) {
        column[k] = j;
        weight[k++] = of->adjacency[i * n + j];
      }
    }
    start[i + 1] = k;
  }
  return (kg_sparse){n, n, start, column, weight};
}

static kg_status record_parameters(net *m)
{
  const kg_bench_net *of = m->of;
  const float *at = of->theta;
  for (int l = 0; l < LAYERS; l++) {
    const int in = of->width[l], out = of->width[l + 1];
    const kg_shape shape =
      of->kind == KG_BENCH_TCN ? KG_SHAPE(of->taps, in, out) : KG_SHAPE(in, out);
    m->parameter[2 * l] = kg_input_f32(m->tape, shape, at);
    at += of->taps * in * out;
    m->parameter[2 * l + 1] = kg_input_f32(m->tape, KG_SHAPE(out), at);
    at += out;
  }
  m->parameters_end = kg_tape_mark_of(m->tape);
  return kg_tape_status(m->tape);
}

static kg_value layer(const net *m, int l, kg_value h)
{
  kg_tape *tape = m->tape;
  const kg_value W = m->parameter[2 * l], b = m->parameter[2 * l + 1];
  if (m->of->kind == KG_BENCH_TCN) return kg_convolve(tape, h, W, b, KG_PAD_SAME, 1);
  if (m->of->kind == KG_BENCH_MLP) return kg_affine(tape, h, W, b);
  if (m->of->width[l] <= m->of->width[l + 1]) {
    return kg_affine(tape, kg_aggregate(tape, &m->adjacency, h), W, b);
  }
  /* A (H W) = (A H) W, and H W is the narrower */
  return kg_add(tape, kg_aggregate(tape, &m->adjacency, kg_matmul(tape, h, W, 0)), b);
}

/* the sum of the squares of output - target over 2 x rows */
static kg_value loss(const net *m, kg_value x, kg_value target)
{
  kg_value h = x;
  for (int l = 0; l < LAYERS; l++) {
    h = layer(m, l, h);
    if (l < LAYERS - 1) {
      h = m->of->activation == KG_BENCH_RELU ? kg_relu(m->tape, h) : kg_tanh(m->tape, h);
    }
  }
  const kg_value error = kg_sub(m->tape, h, target);
  const kg_value flat = kg_reshape(m->tape, error, KG_SHAPE(m->of->rows * m->of->width[LAYERS]));
  return kg_scale(m->tape, kg_sum_squares(m->tape, flat, 0), 0.5 / m->of->rows);
}

static kg_shape rows_of(const net *m, int width)
{
  const kg_bench_net *of = m->of;
  return of->group == 1 ? KG_SHAPE(of->batch, width) : KG_SHAPE(of->batch, of->group, width);
}

/* ---- contestants ----------------------------------------------------------------------------- */

void kg_net_destroy(void *state)
{
  net *m = state;
  if (m) {
    kg_program_destroy(m->program);
    kg_tape_destroy(m->tape);
    kg_arena_release(&m->arena);
    free(m);
  }
}

kg_status kg_net_recorded_create(void **state, const void *data, const kg_allocator *allocator)
{
  *state = NULL;
  net *m = calloc(1, sizeof *m);
  if (!m) return KG_ERR_NO_MEMORY;
  m->of = data;
  kg_arena_init(&m->arena, allocator);
  m->adjacency = sparse_of(data, &m->arena);
  const kg_tape_def def = {.precision = KG_FLOAT, .allocator = allocator, .simd = 3};
  kg_status status = kg_arena_failed(&m->arena) ? KG_ERR_NO_MEMORY : KG_OK;
  if (status == KG_OK) status = kg_tape_create(&def, &m->tape, NULL);
  if (status == KG_OK) status = record_parameters(m);
  if (status != KG_OK) {
    kg_net_destroy(m);
    return status;
  }
  *state = m;
  return KG_OK;
}

static double *copy(double *to, const float *from, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    to[i] = from[i];
  }
  return to + count;
}

kg_status kg_net_recorded_run(void *state, double *answer)
{
  const net *m = state;
  const kg_bench_net *of = m->of;
  kg_tape_rewind(m->tape, m->parameters_end);
  const kg_value x = kg_constant_f32(m->tape, rows_of(m, of->width[0]), of->x);
  const kg_value target = kg_constant_f32(m->tape, rows_of(m, of->width[LAYERS]), of->target);
  const kg_value value = loss(m, x, target);
  const kg_status status = kg_backward(m->tape, value);
  if (status != KG_OK) return status;
  *answer++ = kg_item(m->tape, value);
  for (int i = 0; i < 2 * LAYERS; i++) {
    const kg_value p = m->parameter[i];
    answer = copy(answer, kg_adjoint_f32(m->tape, p), kg_size_of(m->tape, p));
  }
  return kg_tape_status(m->tape);
}

/* The parameters are inputs of the program, and x and target too, though not differentiated. */
kg_status kg_net_replayed_create(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = kg_net_recorded_create(state, data, allocator);
  if (status != KG_OK) return status;
  net *m = *state;
  const kg_bench_net *of = m->of;
  kg_value inputs[INPUTS];
  memcpy(inputs, m->parameter, sizeof m->parameter);
  inputs[X] = kg_constant_f32(m->tape, rows_of(m, of->width[0]), NULL);
  inputs[TARGET] = kg_constant_f32(m->tape, rows_of(m, of->width[LAYERS]), NULL);
  const kg_value value = loss(m, inputs[X], inputs[TARGET]);
  kg_program_def def = kg_program_default_def();
  def.allocator = allocator;
  status = kg_program_create(&def, m->tape, INPUTS, inputs, 1, &value, &m->program, NULL);
  if (status != KG_OK) {
    kg_net_destroy(m);
    *state = NULL;
  }
  return status;
}

static void write_input(const net *m, int i, const float *numbers)
{
  memcpy(kg_program_input(m->program, i), numbers,
         kg_program_input_size(m->program, i) * sizeof *numbers);
}

kg_status kg_net_replayed_run(void *state, double *answer)
{
  const net *m = state;
  write_input(m, X, m->of->x);
  write_input(m, TARGET, m->of->target);
  kg_status status = kg_program_run(m->program);
  if (status != KG_OK) return status;
  float *seed = kg_program_seed(m->program, 0, 1);
  if (!seed) return KG_ERR_NO_MEMORY;
  *seed = 1.0f;
  status = kg_program_backward(m->program, 1);
  if (status != KG_OK) return status;
  *answer++ = *(const float *)kg_program_output(m->program, 0);
  for (int i = 0; i < 2 * LAYERS; i++) {
    answer = copy(answer, kg_program_adjoint(m->program, i), kg_program_input_size(m->program, i));
  }
  return KG_OK;
}
