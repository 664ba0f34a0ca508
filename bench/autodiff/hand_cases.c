/* Jacobian of a hand's residuals by its pose; where complicated two columns more, for every residual
 * the derivatives by its own two parameters. An answer is the residuals and the Jacobian. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/cases.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"

enum { RESIDUALS = 1, ALL = 3, VERTICES = 544, MOST_BONES = 32 };

typedef struct size {
  int correspondences;
  bool complicated;
} size;

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  (void)setting;
  const size *of = detail;
  kg_bench_hand *hand = NULL;
  if (kg_bench_hand_create(&hand, VERTICES, of->correspondences, of->complicated, 1) != KG_OK) {
    return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "not enough memory for a hand");
  }
  snprintf(problem->source, sizeof problem->source, "random, %d bones, %d vertices, %d points",
           hand->bones, hand->vertices, hand->correspondences);
  const size_t columns = (size_t)kg_bench_hand_columns(hand);
  const size_t rows = 3 * (size_t)hand->correspondences;
  problem->parts[0] = (kg_bench_part){"residuals", rows, 1};
  problem->parts[1] = (kg_bench_part){"Jacobian", rows * columns, columns};
  problem->part_count = 2;
  problem->items = 1.0;
  problem->data = hand;
  return KG_OK;
}

static void close(kg_bench_problem *problem)
{
  kg_bench_hand_destroy(problem->data);
}

static size_t rows_of(const kg_bench_hand *hand)
{
  return 3 * (size_t)hand->correspondences;
}

static kg_status reference(const void *data, double *answer)
{
  return kg_bench_hand_reference(data, answer, answer + rows_of(data));
}

/* ---- plain C --------------------------------------------------------------------------------- */

typedef struct plain {
  const kg_bench_hand *hand;
  double work[];
} plain;

static kg_status create_plain(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  plain *p = malloc(sizeof *p + kg_bench_hand_work(data) * sizeof(double));
  if (!p) return KG_ERR_NO_MEMORY;
  p->hand = data;
  *state = p;
  return KG_OK;
}

static kg_status run_plain(void *state, double *answer)
{
  plain *p = state;
  kg_bench_hand_residuals(p->hand, p->hand->theta, answer, p->work);
  return KG_OK;
}

/* ---- kinegrad -------------------------------------------------------------------------------- */

typedef struct model {
  const kg_bench_hand *hand;
  kg_tape *tape;
  kg_program *program; /* of the second contestant */
  kg_tape_mark recorded;
  kg_value base[MOST_BONES], inverse[MOST_BONES];
  kg_value weighted[MOST_BONES]; /* (4, vertices): the points times the bone's weights */
  kg_value target;               /* (correspondences, 3) */
  int32_t *corner;               /* (3, correspondences) */
  double *tangents, *columns;    /* (columns, parameters), (columns, rows) */
} model;

static void destroy_model(void *state)
{
  model *m = state;
  kg_program_destroy(m->program);
  kg_tape_destroy(m->tape);
  free(m->corner);
  free(m->tangents);
  free(m->columns);
  free(m);
}

static void record_constants(model *m)
{
  const kg_bench_hand *h = m->hand;
  kg_tape *t = m->tape;
  const kg_value points = kg_constant(t, KG_SHAPE(4, h->vertices), h->points);
  for (int b = 0; b < h->bones; b++) {
    m->base[b] = kg_constant(t, KG_SHAPE(4, 4), h->base + 16 * b);
    m->inverse[b] = kg_constant(t, KG_SHAPE(4, 4), h->inverse + 16 * b);
    const double *weight = h->weight + (size_t)b * (size_t)h->vertices;
    m->weighted[b] = kg_mul(t, points, kg_constant(t, KG_SHAPE(h->vertices), weight));
  }
  m->target = kg_constant(t, KG_SHAPE(h->correspondences, 3), h->target);
  m->recorded = kg_tape_mark_of(t);
}

/* direction c moves parameter c of the pose, or all the s, or all the t */
static bool fill_directions(model *m)
{
  const kg_bench_hand *h = m->hand;
  const size_t columns = (size_t)kg_bench_hand_columns(h), count = (size_t)h->correspondences;
  const size_t own = h->complicated ? 2 * count : 0;
  m->columns = calloc(columns * 3 * count, sizeof(double));
  m->tangents = calloc(columns * (KG_BENCH_HAND_POSE + own), sizeof(double));
  m->corner = calloc(3 * count, sizeof(int32_t));
  if (!m->columns || !m->tangents || !m->corner) return false;
  for (size_t i = 0; i < KG_BENCH_HAND_POSE; i++) {
    m->tangents[i * KG_BENCH_HAND_POSE + i] = 1.0;
  }
  for (size_t i = 0; i < own; i++) {
    m->tangents[columns * KG_BENCH_HAND_POSE + (KG_BENCH_HAND_POSE + i % 2) * own + i] = 1.0;
  }
  for (size_t i = 0; i < 3 * count; i++) {
    m->corner[i % 3 * count + i / 3] = h->corner[i];
  }
  return true;
}

static kg_status create_model(void **state, const void *data, const kg_allocator *allocator)
{
  model *m = calloc(1, sizeof *m);
  if (!m) return KG_ERR_NO_MEMORY;
  kg_tape_def def = kg_tape_default_def();
  def.allocator = allocator;
  m->hand = data;
  kg_status status = fill_directions(m) ? kg_tape_create(&def, &m->tape, NULL) : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    record_constants(m);
    status = kg_tape_status(m->tape);
  }
  if (status == KG_OK) {
    *state = m;
  } else {
    destroy_model(m);
  }
  return status;
}

/* rotation about x, then about y, (4, 4) */
static kg_value turn(kg_tape *t, kg_value x, kg_value y)
{
  const kg_value o = kg_constant_scalar(t, 0), i = kg_constant_scalar(t, 1);
  const kg_value cx = kg_cos(t, x), sx = kg_sin(t, x), cy = kg_cos(t, y), sy = kg_sin(t, y);
  const kg_value rows[16] = {cy,
                             kg_mul(t, sx, sy),
                             kg_mul(t, cx, sy),
                             o,
                             o,
                             cx,
                             kg_neg(t, sx),
                             o,
                             kg_neg(t, sy),
                             kg_mul(t, sx, cy),
                             kg_mul(t, cx, cy),
                             o,
                             o,
                             o,
                             o,
                             i};
  return kg_reshape(t, kg_stack(t, 16, rows), KG_SHAPE(4, 4));
}

/* (3, vertices): all bones' parts of the points, summed */
static kg_value skin(const model *m, kg_value pose)
{
  kg_tape *t = m->tape;
  kg_value world[MOST_BONES], parts[MOST_BONES];
  double ones[MOST_BONES];
  const kg_value none = kg_constant_scalar(t, 0);
  for (int b = 0; b < m->hand->bones; b++) {
    const int *angle = m->hand->angle + 2 * b, parent = m->hand->parent[b];
    const kg_value x = angle[0] < 0 ? none : kg_element(t, pose, (size_t)angle[0]);
    const kg_value y = angle[1] < 0 ? none : kg_element(t, pose, (size_t)angle[1]);
    const kg_value relative = kg_matmul(t, m->base[b], turn(t, x, y), 0);
    world[b] = parent < 0 ? relative : kg_matmul(t, world[parent], relative, 0);
    const kg_value whole = kg_matmul(t, world[b], m->inverse[b], 0);
    parts[b] = kg_matmul(t, kg_slice(t, whole, 0, 0, 3), m->weighted[b], 0);
    ones[b] = 1.0;
  }
  return kg_combine(t, m->hand->bones, ones, parts);
}

/* (3, correspondences): the vertices themselves, or s, t, 1 - s - t of the corners */
static kg_value pick(const model *m, kg_value vertices, kg_value own)
{
  kg_tape *t = m->tape;
  const int count = m->hand->correspondences;
  const kg_value first = kg_gather(t, vertices, 1, count, m->corner);
  if (!m->hand->complicated) return first;
  const kg_value second = kg_gather(t, vertices, 1, count, m->corner + count);
  const kg_value third = kg_gather(t, vertices, 1, count, m->corner + 2 * count);
  const kg_value weights = kg_transpose(t, own, 0, 1);
  const kg_value s = kg_slice(t, weights, 0, 0, 1), r = kg_slice(t, weights, 0, 1, 1);
  const kg_value along = kg_mul(t, s, kg_sub(t, first, third));
  return kg_add(t, third, kg_add(t, along, kg_mul(t, r, kg_sub(t, second, third))));
}

static kg_value record_residuals(const model *m, kg_value pose, kg_value own)
{
  kg_tape *t = m->tape;
  static const double axes[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  const kg_value picked = pick(m, skin(m, pose), own);
  const kg_value q = kg_rotation_exp(t, kg_slice(t, pose, 0, 0, 3));
  const kg_value turned_axes =
    kg_rotate(t, kg_broadcast(t, q, KG_SHAPE(3, 4)), kg_constant(t, KG_SHAPE(3, 3), axes)); /* R' */
  const kg_value turned = kg_matmul(t, turned_axes, picked, KG_TRANSPOSE_A);
  const kg_value moved = kg_add(t, kg_transpose(t, turned, 0, 1), kg_slice(t, pose, 0, 3, 3));
  return kg_sub(t, m->target, moved);
}

/* returns how many inputs there are */
static int record_all(const model *m, kg_value inputs[2], kg_value *residuals)
{
  const double *theta = m->hand->theta;
  kg_tape_rewind(m->tape, m->recorded);
  inputs[0] = kg_input(m->tape, KG_SHAPE(KG_BENCH_HAND_POSE), theta);
  if (m->hand->complicated) {
    inputs[1] =
      kg_input(m->tape, KG_SHAPE(m->hand->correspondences, 2), theta + KG_BENCH_HAND_POSE);
  }
  *residuals = record_residuals(m, inputs[0], inputs[1]);
  return m->hand->complicated ? 2 : 1;
}

/* from (columns, rows) to (rows, columns) */
static void exchange(const model *m, const double *columns, double *J)
{
  const size_t rows = rows_of(m->hand), count = (size_t)kg_bench_hand_columns(m->hand);
  for (size_t r = 0; r < rows; r++) {
    for (size_t c = 0; c < count; c++) {
      J[r * count + c] = columns[c * rows + r];
    }
  }
}

static kg_status run_tape(void *state, double *answer)
{
  const model *m = state;
  const size_t rows = rows_of(m->hand);
  kg_value inputs[2] = {{0}}, residuals;
  const int count = record_all(m, inputs, &residuals), columns = kg_bench_hand_columns(m->hand);
  const double *values = kg_data(m->tape, residuals);
  if (values) memcpy(answer, values, rows * sizeof *values);
  if (count == 1) return kg_jacobian(m->tape, residuals, inputs[0], answer + rows);
  const double *const tangents[2] = {m->tangents, m->tangents + columns * KG_BENCH_HAND_POSE};
  double *const results[1] = {m->columns};
  const kg_status status = kg_jvp(m->tape, columns, 2, inputs, tangents, 1, &residuals, results);
  exchange(m, m->columns, answer + rows);
  return status;
}

static kg_status create_program(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_model(state, data, allocator);
  if (status != KG_OK) return status;
  model *m = *state;
  kg_value inputs[2] = {{0}}, residuals;
  const int count = record_all(m, inputs, &residuals);
  kg_program_def def = kg_program_default_def();
  def.allocator = allocator;
  status = kg_program_create(&def, m->tape, count, inputs, 1, &residuals, &m->program, NULL);
  kg_tape_destroy(m->tape);
  m->tape = NULL;
  return status;
}

static kg_status run_program(void *state, double *answer)
{
  const model *m = state;
  kg_program *p = m->program;
  const int columns = kg_bench_hand_columns(m->hand);
  const double *theta = m->hand->theta, *tangents = m->tangents;
  for (int i = 0; i < (m->hand->complicated ? 2 : 1); i++) {
    const size_t n = kg_program_input_size(p, i);
    double *tangent = kg_program_tangent(p, i, columns);
    if (!tangent) return KG_ERR_NO_MEMORY;
    memcpy(kg_program_input(p, i), theta, n * sizeof *theta);
    memcpy(tangent, tangents, n * (size_t)columns * sizeof *theta);
    theta += n;
    tangents += n * (size_t)columns;
  }
  kg_status status = kg_program_run(p);
  if (status == KG_OK) status = kg_program_forward(p, columns);
  if (status != KG_OK) return status;
  memcpy(answer, kg_program_output(p, 0), rows_of(m->hand) * sizeof *answer);
  exchange(m, kg_program_output_tangent(p, 0), answer + rows_of(m->hand));
  return KG_OK;
}

/* ---- the cases ------------------------------------------------------------------------------- */

enum { PLAIN, TAPE, PROGRAM, CONTESTANTS };

static const kg_bench_contestant contestants[CONTESTANTS] = {
  [PLAIN] = {"plain residuals, -O3", NULL, RESIDUALS, create_plain, run_plain, free},
  [TAPE] = {"kinegrad tape", NULL, ALL, create_model, run_tape, destroy_model},
  [PROGRAM] = {"kinegrad program", NULL, ALL, create_program, run_program, destroy_model},
};

static const kg_bench_pair pairs[] = {{"kinegrad tape", TAPE, PLAIN, 10.0},
                                      {"kinegrad program", PROGRAM, PLAIN, 10.0}};

static const size sizes[BENCH_HAND_CASES] = {{100, false}, {192, false}, {100, true}};

/* clang-format off */
#define CASE(i, title)                                                                             \
  {                                                                                                \
    .name = (title), .unit = "us", .unit_seconds = 1e-6, .tolerance = 1e-11, .detail = &sizes[i],  \
    .open = open, .close = close, .reference = reference, .contestants = contestants,              \
    .contestant_count = CONTESTANTS, .pairs = pairs, .pair_count = KG_COUNT_OF(pairs)              \
  }
/* clang-format on */

const kg_bench_case kg_bench_hand_cases[BENCH_HAND_CASES] = {
  CASE(0, "hand_c100"),
  CASE(1, "hand_c192"),
  CASE(2, "hand_complicated_c100"),
};
