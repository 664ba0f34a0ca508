/* Reductions and linear combinations: values against plain loops in long double, derivatives
 * against complex steps, edge cases, the same bits on every instruction set. */
#include "tape_support.h"

typedef kg_value along(kg_tape *tape, kg_value a, int axis);
typedef long double reference(const double *a, size_t length, size_t step, size_t at);

static kg_tape *new_tape(kg_precision precision, int simd)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = simd};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

/* -- references: of the entries a[0], a[step], ...; the result's entry `at` -------------------- */

static long double sum_reference(const double *a, size_t length, size_t step, size_t at)
{
  long double sum = 0;
  (void)at;
  for (size_t i = 0; i < length; ++i) {
    sum += a[i * step];
  }
  return sum;
}

static long double squares_reference(const double *a, size_t length, size_t step, size_t at)
{
  long double sum = 0;
  (void)at;
  for (size_t i = 0; i < length; ++i) {
    sum += (long double)a[i * step] * a[i * step];
  }
  return sum;
}

static long double norm_reference(const double *a, size_t length, size_t step, size_t at)
{
  return sqrtl(squares_reference(a, length, step, at));
}

static long double max_reference(const double *a, size_t length, size_t step, size_t at)
{
  double best = -INFINITY;
  (void)at;
  for (size_t i = 0; i < length; ++i) {
    best = fmax(best, a[i * step]);
  }
  return best;
}

static long double min_reference(const double *a, size_t length, size_t step, size_t at)
{
  double best = INFINITY;
  (void)at;
  for (size_t i = 0; i < length; ++i) {
    best = fmin(best, a[i * step]);
  }
  return best;
}

static long double logsumexp_reference(const double *a, size_t length, size_t step, size_t at)
{
  long double sum = 0;
  (void)at;
  for (size_t i = 0; i < length; ++i) {
    sum += expl(a[i * step]);
  }
  return logl(sum);
}

static long double softmax_reference(const double *a, size_t length, size_t step, size_t at)
{
  return expl(a[at * step] - logsumexp_reference(a, length, step, at));
}

static const struct reduction_case {
  along *record;
  reference *expected;
  bool keeps_axis;
} reductions[] = {{kg_sum, sum_reference, false},       {kg_sum_squares, squares_reference, false},
                  {kg_norm, norm_reference, false},     {kg_max_along, max_reference, false},
                  {kg_min_along, min_reference, false}, {kg_logsumexp, logsumexp_reference, false},
                  {kg_softmax, softmax_reference, true}};

/* rows shorter and longer than the partial sums, columns fewer and more than a tile and a piece */
static const struct shape_case {
  kg_shape shape;
  int axis;
} shapes[] = {{{1, {1}}, 0},         {{1, {3}}, 0},      {{1, {101}}, -1},       {{2, {3, 5}}, 0},
              {{2, {5, 3}}, 1},      {{2, {4, 37}}, -1}, {{3, {2, 3, 4}}, 1},    {{2, {3, 700}}, 0},
              {{3, {2, 2, 130}}, 1}, {{2, {40, 16}}, 0}, {{4, {2, 3, 2, 2}}, -3}};

static kg_value random_input(kg_tape *tape, kg_shape shape, kg_random *random)
{
  double *x = random_numbers(random, kg_shape_size(&shape));
  const kg_value value = kg_input(tape, shape, x);
  free(x);
  return value;
}

static void check_values(const kg_tape *tape, const struct reduction_case *c,
                         const struct shape_case *s, kg_value a, kg_value y)
{
  const double *x = kg_data(tape, a), *out = kg_data(tape, y);
  const int axis = s->axis < 0 ? s->axis + s->shape.rank : s->axis;
  const kg_axis_split split = kg_split(s->shape, axis);
  const size_t results = c->keeps_axis ? split.length : 1;
  assert_int_equal(kg_size_of(tape, y), split.outer * split.inner * results);
  for (size_t o = 0; o < split.outer; ++o) {
    for (size_t at = 0; at < results; ++at) {
      for (size_t i = 0; i < split.inner; ++i) {
        const double *first = x + o * split.length * split.inner + i;
        const long double expected = c->expected(first, split.length, split.inner, at);
        assert_close(*out++, (double)expected, 1e-14);
      }
    }
  }
}

static void reductions_equal_loops_and_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(11);
  for (size_t c = 0; c < KG_COUNT_OF(reductions); ++c) {
    for (size_t k = 0; k < KG_COUNT_OF(shapes); ++k) {
      kg_tape *tape = new_tape(KG_DOUBLE, 3);
      const kg_value a = random_input(tape, shapes[k].shape, &random);
      const kg_value y = reductions[c].record(tape, a, shapes[k].axis);
      check_operator(tape, 1, &a, y, &random, 1e-12);
      check_lanes(tape, y, &random);
      check_values(tape, &reductions[c], &shapes[k], a, y);
      kg_tape_destroy(tape);
    }
  }
}

static void dot_equals_loops_and_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(12);
  for (size_t k = 0; k < KG_COUNT_OF(shapes); ++k) {
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const kg_value v[2] = {random_input(tape, shapes[k].shape, &random),
                           random_input(tape, shapes[k].shape, &random)};
    const kg_value y = kg_dot(tape, v[0], v[1], shapes[k].axis);
    check_operator(tape, 2, v, y, &random, 1e-12);
    check_lanes(tape, y, &random);
    const kg_value sum = kg_sum(tape, kg_mul(tape, v[0], v[1]), shapes[k].axis);
    for (size_t i = 0; i < kg_size_of(tape, y); ++i) {
      assert_close(kg_item_at(tape, y, i), kg_item_at(tape, sum, i), 1e-13);
    }
    const kg_value square = kg_dot(tape, v[0], v[0], shapes[k].axis); /* one operand twice */
    check_operator(tape, 1, v, square, &random, 1e-12);
    kg_tape_destroy(tape);
  }
}

static void sum_all_takes_any_shape(void **state)
{
  (void)state;
  kg_random random = kg_random_make(13);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = random_input(tape, KG_SHAPE(7, 5, 31), &random), y = kg_sum_all(tape, a);
  assert_int_equal(kg_shape_of(tape, y).rank, 0);
  assert_close(kg_item(tape, y), (double)sum_reference(kg_data(tape, a), 1085, 1, 0), 1e-13);
  check_operator(tape, 1, &a, y, &random, 1e-12);
  const kg_value s = kg_scalar(tape, 3);
  assert_close(kg_item(tape, kg_sum_all(tape, s)), 3, 0);
  kg_tape_destroy(tape);
}

static void combine_weighs_its_terms(void **state)
{
  (void)state;
  kg_random random = kg_random_make(14);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const double factors[4] = {2, -0.5, 0, 3};
  for (int32_t n = 1; n < 2000; n = 3 * n + 1) {
    kg_value v[4];
    for (int k = 0; k < 3; ++k) {
      v[k] = random_input(tape, KG_SHAPE(n), &random);
    }
    v[3] = v[0];
    const kg_value y = kg_combine(tape, 4, factors, v);
    for (int32_t i = 0; i < n; i += 7) {
      const size_t at = (size_t)i;
      const double expected = 5 * kg_item_at(tape, v[0], at) - 0.5 * kg_item_at(tape, v[1], at);
      assert_close(kg_item_at(tape, y, at), expected, 1e-15);
    }
    check_operator(tape, 3, v, y, &random, 1e-12);
    check_lanes(tape, y, &random);
  }
  const kg_value s[2] = {kg_scalar(tape, 2), kg_scalar(tape, 5)};
  const kg_value y = kg_combine(tape, 2, factors, s);
  assert_close(kg_item(tape, y), 1.5, 0);
  assert_int_equal(kg_backward(tape, y), KG_OK);
  assert_close(kg_adjoint_item(tape, s[1]), -0.5, 0);
  const kg_value mixed[2] = {kg_constant_scalar(tape, 2), s[1]}; /* one term does not move */
  const kg_value z = kg_combine(tape, 2, factors, mixed);
  check_operator(tape, 1, &s[1], z, &random, 1e-15);
  kg_tape_destroy(tape);
}

/* -- edges ------------------------------------------------------------------------------------- */

enum { LONGEST = 50 };

/* First result and its gradient: of a contiguous row, or of the first of two columns. */
static double edge(along *record, int32_t columns, size_t n, const double *x, double *gradient)
{
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  double numbers[2 * LONGEST] = {0}, g[2 * LONGEST], *to = g;
  const double seed[2 * LONGEST] = {1}, *seeds = seed;
  for (size_t i = 0; i < n; ++i) {
    numbers[i * (size_t)columns] = x[i];
  }
  const kg_value a = kg_input(tape, KG_SHAPE((int32_t)n, columns), numbers), y = record(tape, a, 0);
  assert_int_equal(kg_vjp(tape, 1, 1, &y, &seeds, 1, &a, &to), KG_OK);
  for (size_t i = 0; i < n; ++i) {
    gradient[i] = g[i * (size_t)columns];
  }
  const double value = kg_item(tape, y);
  kg_tape_destroy(tape);
  return value;
}

static void check_edge(along *record, size_t n, const double *x, double value,
                       const double *gradient, double tolerance)
{
  for (int32_t columns = 1; columns <= 2; ++columns) {
    double g[LONGEST];
    const double y = edge(record, columns, n, x, g);
    if (isfinite(value)) {
      assert_at_most(fabs(y - value), tolerance * fabs(value));
    } else {
      assert_true(y == value);
    }
    for (size_t i = 0; i < n; ++i) {
      assert_close(g[i], gradient[i], tolerance);
    }
  }
}

static void norm_is_safe_at_zero_and_far_out(void **state)
{
  (void)state;
  check_edge(kg_norm, 3, (double[]){0, 0, 0}, 0, (double[]){0, 0, 0}, 0);
  for (int e = -305; e <= 305; e += 61) {
    const double s = pow(10, e);
    check_edge(kg_norm, 3, (double[]){3 * s, 0, -4 * s}, 5 * s, (double[]){0.6, 0, -0.8}, 1e-14);
  }
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value zero = kg_input(tape, KG_SHAPE(3), NULL), y = kg_norm(tape, zero, 0);
  const double direction[3] = {1, 2, 3}, *directions = direction;
  double slope = NAN, *slopes = &slope;
  assert_int_equal(kg_jvp(tape, 1, 1, &zero, &directions, 1, &y, &slopes), KG_OK);
  assert_true(slope == 0);
  kg_tape_destroy(tape);
}

static void extremes_give_ties_to_the_first(void **state)
{
  (void)state;
  check_edge(kg_max_along, 4, (double[]){1, 3, 3, 2}, 3, (double[]){0, 1, 0, 0}, 0);
  check_edge(kg_min_along, 4, (double[]){3, 1, 2, 1}, 1, (double[]){0, 1, 0, 0}, 0);
  check_edge(kg_max_along, 2, (double[]){-INFINITY, -INFINITY}, -INFINITY, (double[]){1, 0}, 0);
  for (int32_t columns = 1; columns <= 2; ++columns) {
    double g[3];
    assert_true(isnan(edge(kg_max_along, columns, 3, (double[]){1, NAN, 2}, g)));
    assert_true(g[0] == 0 && g[1] == 1 && g[2] == 0);
    assert_true(isnan(edge(kg_min_along, columns, 3, (double[]){NAN, 1, NAN}, g)));
    assert_true(g[0] == 1 && g[1] == 0 && g[2] == 0);
  }
}

static void logsumexp_takes_infinities(void **state)
{
  (void)state;
  const double inf = INFINITY;
  check_edge(kg_logsumexp, 2, (double[]){1000, 1000}, 1000 + log(2), (double[]){0.5, 0.5}, 1e-15);
  check_edge(kg_logsumexp, 2, (double[]){-1000, -inf}, -1000, (double[]){1, 0}, 1e-15);
  check_edge(kg_logsumexp, 4, (double[]){-inf, -inf, -inf, -inf}, -inf,
             (double[]){0.25, 0.25, 0.25, 0.25}, 0);
  check_edge(kg_logsumexp, 3, (double[]){1, inf, 2}, inf, (double[]){0, 1, 0}, 0);
  check_edge(kg_logsumexp, 3, (double[]){inf, -inf, inf}, inf, (double[]){0.5, 0, 0.5}, 0);
  check_edge(kg_softmax, 2, (double[]){inf, 0}, 1, (double[]){0, 0}, 0);
  for (int32_t columns = 1; columns <= 2; ++columns) {
    double g[2];
    assert_true(isnan(edge(kg_logsumexp, columns, 2, (double[]){1, NAN}, g)));
    assert_true(isnan(edge(kg_logsumexp, columns, 2, (double[]){NAN, 1}, g)));
  }
  for (size_t at = 0; at < LONGEST; ++at) { /* one large entry, anywhere */
    double x[LONGEST] = {0}, weight[LONGEST] = {0};
    x[at] = 1000;
    weight[at] = 1;
    check_edge(kg_logsumexp, LONGEST, x, 1000, weight, 1e-15);
  }
}

/* a row of NaN that receives a zero adjoint stays to itself */
static void zero_adjoints_stop(void **state)
{
  (void)state;
  for (size_t c = 0; c < KG_COUNT_OF(reductions); ++c) {
    for (int axis = 0; axis < 2; ++axis) {
      kg_tape *tape = new_tape(KG_DOUBLE, 3);
      const double x[4] = {NAN, axis ? NAN : 1, axis ? 1 : NAN, 2};
      const kg_value a = kg_input(tape, KG_SHAPE(2, 2), x);
      const kg_value y = reductions[c].record(tape, a, axis);
      double seed[4] = {0, 0, 0, 0}, g[4], *gradient = g;
      seed[kg_size_of(tape, y) - 1] = 1;
      const double *seeds = seed;
      assert_int_equal(kg_vjp(tape, 1, 1, &y, &seeds, 1, &a, &gradient), KG_OK);
      assert_true(g[0] == 0 && g[axis ? 1 : 2] == 0 && isfinite(g[3]));
      kg_tape_destroy(tape);
    }
  }
}

static void shapes_are_refused_in_words(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = kg_input(tape, KG_SHAPE(3, 4), NULL), b = kg_input(tape, KG_SHAPE(4, 3), NULL);
  const kg_value pair[2] = {a, b};
  const kg_tape_mark mark = kg_tape_mark_of(tape);
#define REFUSED(call, words)                                                                       \
  assert_true(kg_is_null(call));                                                                   \
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);                                            \
  assert_non_null(strstr(kg_tape_error(tape)->text, words));                                       \
  kg_tape_rewind(tape, mark)
  REFUSED(kg_sum(tape, a, 2), "sum: axis 2 of a tensor of shape (3, 4)");
  REFUSED(kg_logsumexp(tape, a, -3), "logsumexp: axis -3");
  REFUSED(kg_norm(tape, kg_scalar(tape, 1), 0), "norm: axis 0 of a tensor of shape ()");
  REFUSED(kg_dot(tape, a, b, 0), "dot: shapes (3, 4) and (4, 3)");
  REFUSED(kg_combine(tape, 2, (double[]){1, 1}, pair), "combine: term 0 of shape (3, 4), term 1");
  REFUSED(kg_combine(tape, 0, NULL, NULL), "combine: 0 terms");
#undef REFUSED
  kg_tape_destroy(tape);
}

/* -- precisions and instruction sets ----------------------------------------------------------- */

/* all reductions of one array, summed with different weights: result and gradient */
static double everything(kg_precision precision, int simd, int32_t rows, int32_t columns,
                         const double *x, double *gradient)
{
  kg_tape *tape = new_tape(precision, simd);
  const kg_value a = kg_input(tape, KG_SHAPE(rows, columns), x);
  kg_value terms[2 * KG_COUNT_OF(reductions)];
  double factors[2 * KG_COUNT_OF(reductions)];
  for (size_t c = 0; c < KG_COUNT_OF(terms); ++c) {
    const kg_value y = reductions[c / 2].record(tape, a, (int)(c % 2));
    terms[c] = kg_sum_all(tape, kg_mul(tape, y, y));
    factors[c] = 1 / (1 + (double)c);
  }
  const kg_value total = kg_combine(tape, KG_COUNT_OF(terms), factors, terms);
  assert_int_equal(kg_gradient(tape, total, 1, &a, &gradient), KG_OK);
  const double value = kg_item(tape, total);
  kg_tape_destroy(tape);
  return value;
}

static void instruction_sets_agree_in_every_bit(void **state)
{
  (void)state;
  enum { ROWS = 23, COLUMNS = 150, N = ROWS * COLUMNS };
  kg_random random = kg_random_make(15);
  double *x = random_numbers(&random, N), *g = calloc(4 * N, sizeof *g), value[4];
  for (int i = 0; i < 4; ++i) {
    value[i] =
      everything(i < 3 ? KG_DOUBLE : KG_FLOAT, i < 2 ? 2 * i : 3, ROWS, COLUMNS, x, g + i * N);
  }
  for (int i = 1; i < 3; ++i) {
    assert_memory_equal(&value[0], &value[i], sizeof *value);
    assert_memory_equal(g, g + i * N, N * sizeof *g);
  }
  assert_at_most(fabs(value[3] - value[0]), 1e-5 * fabs(value[0]));
  for (size_t i = 0; i < N; ++i) {
    assert_at_most(fabs(g[3 * N + i] - g[i]), 1e-5 * largest(g, N));
  }
  free(x);
  free(g);
}

static void norms_of_infinities(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const double x[] = {1, -INFINITY, 2, INFINITY, INFINITY, NAN};
  const kg_value y = kg_norm(tape, kg_input(tape, KG_SHAPE(2, 3), x), 1);
  assert_true(kg_item_at(tape, y, 0) == INFINITY);
  assert_true(isnan(kg_item_at(tape, y, 1)));
  assert_true(isnan(kg_item(tape, kg_normalize(tape, kg_input(tape, KG_SHAPE(3), x)))));
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(reductions_equal_loops_and_complex_steps),
    cmocka_unit_test(dot_equals_loops_and_complex_steps),
    cmocka_unit_test(sum_all_takes_any_shape),
    cmocka_unit_test(combine_weighs_its_terms),
    cmocka_unit_test(norm_is_safe_at_zero_and_far_out),
    cmocka_unit_test(extremes_give_ties_to_the_first),
    cmocka_unit_test(logsumexp_takes_infinities),
    cmocka_unit_test(zero_adjoints_stop),
    cmocka_unit_test(shapes_are_refused_in_words),
    cmocka_unit_test(instruction_sets_agree_in_every_bit),
    cmocka_unit_test(norms_of_infinities),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
