/* Random graphs: sharing, dead code, constants, batches, every shape of operator.
 *
 *   gradient     against complex steps through the frozen program, along two random directions and
 *                four random entries: 1e-11 of the gradient's norm
 *   replay       at other inputs gives the bits of recording there, values and gradients
 *   repetition   second and third call give the bits of the first
 *
 * Graphs are well-conditioned by construction: inputs lie in (-1, 1), every step maps [-1, 1] into
 * itself with slopes of order one, arguments of functions with poles or branch points are shifted
 * away from them, and comparisons have a margin that rounding does not reach. */
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"
#include "support.h"

#include <complex.h>
#include <stdio.h>

enum { GRAPHS = 10000, FEWEST = 10, MOST = 500 };

/* scalars, vectors, batches of two vectors, quaternions and matrices */
enum kind { S, W, V, Q, M, KINDS };

static const kg_shape shape_of_kind[KINDS] = {
  {0, {0}}, {1, {3}}, {2, {2, 3}}, {2, {2, 4}}, {3, {2, 3, 3}}};
static const int size_of_kind[KINDS] = {1, 3, 6, 8, 18};

enum { INPUTS = 7, ENTRIES = 3 + 3 + 6 + 8 + 18, POOL = 2 * MOST };
static const enum kind kind_of_input[INPUTS] = {S, S, S, W, V, Q, M};

typedef struct builder {
  kg_tape *t;
  kg_random random;
  kg_value pool[KINDS][POOL];
  int count[KINDS]; /* values there are */
  int limit[KINDS]; /* values that may be picked */
} builder;

static int below(builder *b, int n)
{
  return (int)(kg_random_bits(&b->random) % (uint64_t)n);
}

/* one of the last few, or any */
static kg_value pick(builder *b, enum kind k)
{
  const int n = b->limit[k], recent = n < 4 ? n : 4;
  return b->pool[k][below(b, 2) ? n - 1 - below(b, recent) : below(b, n)];
}

static kg_value constant(builder *b, enum kind k)
{
  double x[18];
  for (int i = 0; i < size_of_kind[k]; ++i) {
    x[i] = 2 * kg_random_uniform(&b->random) - 1;
  }
  return k == S ? kg_constant_scalar(b->t, x[0]) : kg_constant(b->t, shape_of_kind[k], x);
}

/* -- steps from [-1, 1] into [-1, 1] ----------------------------------------------------------- */

static kg_value unary(builder *b, kg_value a)
{
  kg_tape *t = b->t;
  switch (below(b, 27)) {
    case 0:
      return kg_neg(t, a);
    case 1:
      return kg_sin(t, a);
    case 2:
      return kg_cos(t, a);
    case 3:
      return kg_tanh(t, a);
    case 4:
      return kg_sigmoid(t, a);
    case 5:
      return kg_atan(t, a);
    case 6:
      return kg_abs(t, a);
    case 7:
      return kg_square(t, a);
    case 8:
      return kg_relu(t, a);
    case 9:
      return kg_clamp(t, a, -0.6, 0.7);
    case 10:
      return kg_scale(t, kg_exp(t, a), 0.36);
    case 11:
      return kg_scale(t, kg_expm1(t, a), 0.55);
    case 12:
      return kg_scale(t, kg_log(t, kg_shift(t, a, 2)), 0.9);
    case 13:
      return kg_log1p(t, kg_scale(t, a, 0.5));
    case 14:
      return kg_scale(t, kg_sqrt(t, kg_shift(t, a, 2)), 0.55);
    case 15:
      return kg_scale(t, kg_tan(t, a), 0.6);
    case 16:
      return kg_asin(t, kg_scale(t, a, 0.7));
    case 17:
      return kg_scale(t, kg_acos(t, kg_scale(t, a, 0.7)), 0.4);
    case 18:
      return kg_scale(t, kg_sinh(t, a), 0.8);
    case 19:
      return kg_scale(t, kg_cosh(t, a), 0.6);
    case 20:
      return kg_scale(t, kg_softplus(t, a), 0.7);
    case 21:
      return kg_reciprocal(t, kg_shift(t, a, 2));
    case 22:
      return kg_scale(t, kg_power(t, kg_shift(t, a, 2), 1.3), 0.23);
    case 23:
      return kg_power(t, a, 3);
    case 24:
      return kg_scale(t, kg_shift(t, a, 0.5), 0.66);
    case 25:
      return kg_scale(t, a, 0.9);
    default:
      return kg_sin(t, kg_scale(t, a, 3));
  }
}

static kg_value binary(builder *b, kg_value x, kg_value y)
{
  kg_tape *t = b->t;
  switch (below(b, 10)) {
    case 0:
      return kg_scale(t, kg_add(t, x, y), 0.5);
    case 1:
      return kg_scale(t, kg_sub(t, x, y), 0.5);
    case 2:
      return kg_mul(t, x, y);
    case 3:
      return kg_div(t, x, kg_shift(t, y, 2));
    case 4:
      return kg_scale(t, kg_pow(t, kg_shift(t, x, 2), y), 0.33);
    case 5:
      return kg_atan2(t, x, kg_shift(t, y, 2));
    case 6:
      return kg_scale(t, kg_hypot(t, x, y), 0.7);
    case 7:
      return kg_min(t, x, y);
    case 8:
      return kg_max(t, x, y);
    default:
      return kg_sin(t, kg_add(t, x, y));
  }
}

static kg_value choose(builder *b, enum kind k)
{
  const kg_value x = pick(b, k), y = pick(b, k);
  const kg_value mask = below(b, 2) ? kg_less(b->t, x, kg_shift(b->t, y, 0.0137))
                                    : kg_less_equal(b->t, kg_shift(b->t, x, 0.0731), y);
  return kg_where(b->t, mask, pick(b, k), pick(b, k));
}

static kg_value mixture(builder *b, enum kind k)
{
  const int n = 2 + below(b, 3);
  kg_value terms[4];
  double factors[4];
  for (int i = 0; i < n; ++i) {
    terms[i] = pick(b, k);
    factors[i] = (below(b, 2) ? 1.0 : -1.0) / n;
  }
  return kg_combine(b->t, n, factors, terms);
}

/* -- steps between shapes ---------------------------------------------------------------------- */

static kg_value column(builder *b, kg_value vectors)
{
  return kg_reshape(b->t, vectors, KG_SHAPE(2, 3, 1));
}

static kg_value flat(builder *b, kg_value columns)
{
  return kg_reshape(b->t, columns, KG_SHAPE(2, 3));
}

static kg_value reduce(builder *b) /* to S */
{
  kg_tape *t = b->t;
  switch (below(b, 4)) {
    case 0:
      return kg_scale(t, kg_sum_all(t, pick(b, V)), 1.0 / 6);
    case 1:
      return kg_element(t, kg_scale(t, kg_dot(t, pick(b, V), pick(b, V), 1), 1.0 / 3),
                        (size_t)below(b, 2));
    case 2:
      return kg_element(t, pick(b, M), (size_t)below(b, 18));
    default:
      return kg_element(t, pick(b, Q), (size_t)below(b, 8));
  }
}

static kg_value reduce_matrix(builder *b) /* to V */
{
  kg_tape *t = b->t;
  const int axis = 1 + below(b, 2);
  const kg_value a = pick(b, M);
  switch (below(b, 6)) {
    case 0:
      return kg_scale(t, kg_sum(t, a, axis), 1.0 / 3);
    case 1:
      return kg_scale(t, kg_sum_squares(t, a, axis), 1.0 / 3);
    case 2:
      return kg_scale(t, kg_norm(t, kg_shift(t, a, 1.5), axis), 0.2);
    case 3:
      return kg_max_along(t, a, axis);
    case 4:
      return kg_min_along(t, a, axis - 3);
    default:
      return kg_scale(t, kg_logsumexp(t, a, axis), 0.45);
  }
}

static kg_value multiply(builder *b) /* to M */
{
  kg_tape *t = b->t;
  switch (below(b, 4)) {
    case 0:
      return kg_scale(t, kg_matmul(t, pick(b, M), pick(b, M), below(b, 4)), 1.0 / 3);
    case 1:
      return kg_mul(t, kg_reshape(t, pick(b, V), KG_SHAPE(2, 3, 1)),
                    kg_reshape(t, pick(b, V), KG_SHAPE(2, 1, 3)));
    case 2: {
      const kg_value weight =
        kg_reshape(t, kg_slice(t, pick(b, M), 0, below(b, 2), 1), KG_SHAPE(3, 3));
      return kg_scale(t, kg_affine(t, pick(b, M), weight, below(b, 2) ? pick(b, W) : (kg_value){0}),
                      0.25);
    }
    default:
      return kg_scale(t,
                      kg_convolve(t, pick(b, M), pick(b, M), pick(b, W),
                                  below(b, 2) ? KG_PAD_SAME : KG_PAD_CAUSAL, 1 + below(b, 2)),
                      1.0 / 7);
  }
}

static kg_value solve(builder *b) /* to V */
{
  kg_tape *t = b->t;
  static const double diagonal[9] = {4, 0, 0, 0, 4, 0, 0, 0, 4};
  const kg_value right = column(b, pick(b, V)), a = pick(b, M);
  switch (below(b, 3)) {
    case 0:
      return kg_scale(t, flat(b, kg_matmul(t, a, right, below(b, 2))), 1.0 / 3);
    case 1: {
      const kg_value shifted = kg_add(t, a, kg_constant(t, KG_SHAPE(3, 3), diagonal));
      return flat(b, kg_solve(t, shifted, right, below(b, 2)));
    }
    default: {
      const kg_value shifted = kg_add(t, a, kg_constant(t, KG_SHAPE(3, 3), diagonal));
      const int flags = (below(b, 2) ? KG_UPPER : 0) | (below(b, 2) ? KG_TRANSPOSE_A : 0) |
                        (below(b, 2) ? KG_UNIT : 0);
      return kg_scale(t, flat(b, kg_solve_triangular(t, shifted, right, flags)),
                      flags & KG_UNIT ? 0.25 : 1);
    }
  }
}

static kg_value move(builder *b, enum kind *k)
{
  kg_tape *t = b->t;
  static const int32_t order[3][3] = {{2, 0, 1}, {1, 1, -1}, {0, 2, 2}},
                       to[2][3] = {{1, 2, 0}, {2, -1, 0}};
  switch (below(b, 9)) {
    case 0:
      *k = M;
      return kg_transpose(t, pick(b, M), 1, 2);
    case 1:
      *k = V;
      return kg_slice(t, pick(b, Q), 1, below(b, 2), 3);
    case 2: {
      const kg_value parts[2] = {pick(b, V), kg_slice(t, pick(b, V), -1, below(b, 3), 1)};
      *k = Q;
      return kg_concat(t, 1, 2, parts);
    }
    case 3: {
      const kg_value parts[3] = {pick(b, S), pick(b, S), pick(b, S)};
      *k = W;
      return kg_stack(t, 3, parts);
    }
    case 4:
      *k = V;
      return kg_gather(t, pick(b, V), 1, 3, order[below(b, 3)]);
    case 5:
      *k = M;
      return kg_scatter(t, pick(b, M), 1 + below(b, 2), 3, to[below(b, 2)]);
    case 6:
      *k = V;
      return kg_broadcast(t, pick(b, W), shape_of_kind[V]);
    case 7:
      *k = W;
      return kg_reshape(t, kg_slice(t, pick(b, V), 0, below(b, 2), 1), shape_of_kind[W]);
    default:
      *k = V;
      return kg_reshape(t, kg_transpose(t, kg_reshape(t, pick(b, V), KG_SHAPE(3, 2)), 0, 1),
                        shape_of_kind[V]);
  }
}

static kg_value aggregate(builder *b) /* to M */
{
  static const int32_t start[4] = {0, 2, 2, 4}, column_of[4] = {0, 2, 1, 0};
  static const double weight[4] = {0.5, -0.5, 0.75, 0.25};
  const kg_sparse matrix = {3, 3, start, column_of, weight};
  return kg_aggregate(b->t, &matrix, pick(b, M));
}

static kg_value turn(builder *b, enum kind *k)
{
  kg_tape *t = b->t;
  const kg_value unit = kg_normalize(t, kg_shift(t, pick(b, Q), 1.5));
  *k = V;
  switch (below(b, 6)) {
    case 0:
      return kg_scale(t, kg_cross(t, pick(b, V), pick(b, V)), 0.5);
    case 1:
      return kg_scale(t, kg_rotate(t, unit, pick(b, V)), 0.57);
    case 2:
      return kg_scale(t, kg_rotation_log(t, unit), 0.3);
    case 3:
      return kg_normalize(t, kg_shift(t, pick(b, V), 1.5));
    case 4:
      *k = Q;
      return kg_scale(t, kg_compose(t, pick(b, Q), pick(b, Q)), 0.25);
    default:
      *k = Q;
      return kg_rotation_exp(t, pick(b, V));
  }
}

/* -- graphs ------------------------------------------------------------------------------------ */

static void push(builder *b, enum kind k, kg_value value)
{
  if (kg_is_null(value)) fail_msg("%s", kg_tape_error(b->t)->text);
  if (b->count[k] < POOL) b->pool[k][b->count[k]++] = value;
}

static void step(builder *b)
{
  enum kind k = (enum kind)below(b, KINDS);
  kg_value made = {0};
  switch (below(b, 16)) {
    case 0:
    case 1:
    case 2:
      made = unary(b, pick(b, k));
      break;
    case 3:
    case 4:
    case 5:
      made = binary(b, pick(b, k), pick(b, k));
      break;
    case 6:
      made = binary(b, pick(b, k), pick(b, S));
      break;
    case 7:
      k = below(b, 2) ? V : M;
      made = binary(b, pick(b, W), pick(b, k));
      break;
    case 8:
      made = choose(b, k);
      break;
    case 9:
      made = mixture(b, k);
      break;
    case 10:
      k = S;
      made = reduce(b);
      break;
    case 11:
      k = V;
      made = reduce_matrix(b);
      break;
    case 12:
      k = M;
      made = below(b, 4) ? multiply(b) : aggregate(b);
      break;
    case 13:
      k = V;
      made = solve(b);
      break;
    case 14:
      made = move(b, &k);
      break;
    default:
      made = turn(b, &k);
      break;
  }
  push(b, k, made);
}

/* one step in ten is made twice, so that values are shared */
static void step_maybe_twice(builder *b)
{
  memcpy(b->limit, b->count, sizeof b->limit);
  const kg_random before = b->random;
  step(b);
  if (kg_random_uniform(&b->random) > 0.1) return;
  const kg_random after = b->random;
  b->random = before;
  step(b);
  b->random = after;
}

/* Graph `number` at x. The same operators whatever x is. */
static kg_value record(builder *b, int number, const double *x, kg_value *inputs)
{
  b->random = kg_random_make((uint64_t)number + 1);
  memset(b->count, 0, sizeof b->count);
  for (int i = 0; i < INPUTS; ++i) {
    const enum kind k = kind_of_input[i];
    inputs[i] = k == S ? kg_scalar(b->t, *x) : kg_input(b->t, shape_of_kind[k], x);
    push(b, k, inputs[i]);
    x += size_of_kind[k];
  }
  for (int k = 0; k < KINDS; ++k) {
    push(b, (enum kind)k, constant(b, (enum kind)k));
  }
  const size_t enough = kg_tape_nodes(b->t) + FEWEST + (size_t)below(b, MOST - FEWEST);
  while (kg_tape_nodes(b->t) < enough) {
    step_maybe_twice(b);
  }
  memcpy(b->limit, b->count, sizeof b->limit);
  kg_value sum = pick(b, S);
  assert_true(kg_is_less(b->t, sum, kg_shift(b->t, pick(b, S), 5)));
  for (int i = 0; i < 4 * KINDS; ++i) {
    const kg_value term = pick(b, (enum kind)(i % KINDS));
    sum = kg_add(b->t, sum, i % KINDS == S ? term : kg_sum_all(b->t, term));
  }
  return sum;
}

/* -- checks ------------------------------------------------------------------------------------ */

static void random_point(kg_random *random, double *x)
{
  for (int i = 0; i < ENTRIES; ++i) {
    x[i] = 2 * kg_random_uniform(random) - 1;
  }
}

typedef struct answer {
  double value, gradient[ENTRIES];
} answer;

static answer by_recording(builder *b, int number, const double *x, kg_value *inputs,
                           kg_value *output)
{
  answer a;
  double *gradients[INPUTS], *next = a.gradient;
  kg_tape_rewind(b->t, (kg_tape_mark){0});
  *output = record(b, number, x, inputs);
  for (int i = 0; i < INPUTS; ++i) {
    gradients[i] = next;
    next += size_of_kind[kind_of_input[i]];
  }
  a.value = kg_item(b->t, *output);
  for (int round = 0; round < 3; ++round) {
    const answer before = a;
    if (kg_gradient(b->t, *output, INPUTS, inputs, gradients) != KG_OK) {
      fail_msg("graph %d: %s", number, kg_tape_error(b->t)->text);
    }
    if (round) assert_memory_equal(&before, &a, sizeof a);
  }
  return a;
}

static answer by_replay(kg_program *p, int number, const double *x)
{
  answer a;
  for (int i = 0; i < INPUTS; ++i) {
    const size_t n = kg_program_input_size(p, i);
    memcpy(kg_program_input(p, i), x, n * sizeof *x);
    x += n;
  }
  *(double *)kg_program_seed(p, 0, 1) = 1;
  if (kg_program_run(p) != KG_OK || kg_program_backward(p, 1) != KG_OK) {
    fail_msg("graph %d: %s", number, kg_program_error(p)->text);
  }
  a.value = *(const double *)kg_program_output(p, 0);
  double *next = a.gradient;
  for (int i = 0; i < INPUTS; ++i) {
    const size_t n = kg_program_input_size(p, i);
    memcpy(next, kg_program_adjoint(p, i), n * sizeof *next);
    next += n;
  }
  return a;
}

static void check_bits(int number, const answer *recorded, const answer *replayed)
{
  if (memcmp(&recorded->value, &replayed->value, sizeof(double)) != 0) {
    fail_msg("graph %d: recorded %.17g, replayed %.17g", number, recorded->value, replayed->value);
  }
  for (int i = 0; i < ENTRIES; ++i) {
    if (memcmp(&recorded->gradient[i], &replayed->gradient[i], sizeof(double)) != 0) {
      fail_msg("graph %d, entry %d: recorded gradient %.17g, replayed %.17g", number, i,
               recorded->gradient[i], replayed->gradient[i]);
    }
  }
}

enum { LANES = 6 };

static double norm(const double *x)
{
  double sum = 0;
  for (int i = 0; i < ENTRIES; ++i) {
    sum += x[i] * x[i];
  }
  return sqrt(sum);
}

/* the largest error over the gradient's norm */
static double complex_step_error(kg_program *p, int number, const double *x, const answer *a,
                                 kg_random *random)
{
  const double h = 1e-100;
  double d[LANES][ENTRIES] = {{0}}, worst = 0;
  for (int lane = 0; lane < LANES; ++lane) {
    for (int e = 0; lane < 2 && e < ENTRIES; ++e) {
      d[lane][e] = kg_random_normal(random);
    }
    if (lane >= 2) d[lane][kg_random_bits(random) % ENTRIES] = 1;
  }
  for (int i = 0, e = 0; i < INPUTS; ++i) {
    double _Complex *z = kg_program_input(p, i);
    for (size_t k = 0; k < kg_program_input_size(p, i); ++k, ++e) {
      for (int lane = 0; lane < LANES; ++lane) {
        *z++ = CMPLX(x[e], h * d[lane][e]);
      }
    }
  }
  if (kg_program_run(p) != KG_OK) fail_msg("graph %d: %s", number, kg_program_error(p)->text);
  const double _Complex *y = kg_program_output(p, 0);
  for (int lane = 0; lane < LANES; ++lane) {
    double product = 0;
    for (int e = 0; e < ENTRIES; ++e) {
      product += a->gradient[e] * d[lane][e];
    }
    const double error = fabs(product - cimag(y[lane]) / h);
    worst = fmax(worst, error > 0 ? error / (norm(a->gradient) * norm(d[lane])) : 0);
  }
  return worst;
}

typedef struct tally {
  size_t operators, shared, dead, constant;
  double worst;
} tally;

static void check_graph(builder *b, int number, tally *sum)
{
  double x[2][ENTRIES];
  kg_random random = kg_random_make(1000000 + (uint64_t)number);
  random_point(&random, x[0]);
  random_point(&random, x[1]);
  kg_value inputs[INPUTS], output;
  const answer first = by_recording(b, number, x[0], inputs, &output);
  kg_program *real, *analytic;
  const kg_program_def complex_def = {.lanes = LANES, .arithmetic_complex = true};
  assert_int_equal(kg_program_create(NULL, b->t, INPUTS, inputs, 1, &output, &real, NULL), KG_OK);
  assert_int_equal(
    kg_program_create(&complex_def, b->t, INPUTS, inputs, 1, &output, &analytic, NULL), KG_OK);
  const answer second = by_recording(b, number, x[1], inputs, &output);
  for (int round = 0; round < 3; ++round) {
    const answer again = by_replay(real, number, x[1]);
    check_bits(number, &second, &again);
  }
  const answer back = by_replay(real, number, x[0]);
  check_bits(number, &first, &back);
  const double error = complex_step_error(analytic, number, x[1], &second, &random);
  if (!(error <= 1e-11)) fail_msg("graph %d: error %.3g of the gradient's norm", number, error);
  const kg_program_info info = kg_program_describe(real);
  sum->operators += info.recorded;
  sum->shared += info.shared;
  sum->dead += info.dead;
  sum->constant += info.constant;
  sum->worst = fmax(sum->worst, error);
  kg_program_destroy(real);
  kg_program_destroy(analytic);
}

static void test_random_graphs(void **state)
{
  (void)state;
  builder *b = calloc(1, sizeof *b);
  assert_non_null(b);
  assert_int_equal(kg_tape_create(NULL, &b->t, NULL), KG_OK);
  tally sum = {0};
  for (int number = 0; number < GRAPHS; ++number) {
    check_graph(b, number, &sum);
  }
  printf("%d graphs of %zu operators on average: %zu shared, %zu dead, %zu constant; largest error "
         "%.2g of the gradient's norm\n",
         GRAPHS, sum.operators / GRAPHS, sum.shared / GRAPHS, sum.dead / GRAPHS,
         sum.constant / GRAPHS, sum.worst);
  assert_true(sum.shared > 0 && sum.dead > 0 && sum.constant > 0);
  kg_tape_destroy(b->t);
  free(b);
}

int main(void)
{
  const struct CMUnitTest tests[] = {cmocka_unit_test(test_random_graphs)};
  return cmocka_run_group_tests(tests, NULL, NULL);
}
