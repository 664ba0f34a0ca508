/* Aggregation and convolution: values against plain loops, derivatives against complex steps. */
#include "tape_support.h"

static kg_tape *new_tape(kg_precision precision, int simd)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = simd};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static kg_value random_input(kg_tape *tape, kg_shape shape, kg_random *random)
{
  double *x = random_numbers(random, kg_shape_size(&shape));
  const kg_value value = kg_input(tape, shape, x);
  free(x);
  return value;
}

/* 4 x 5; row 2 is empty, a column is named twice in row 3, column 4 by nobody */
static const int32_t start[] = {0, 2, 3, 3, 7}, column[] = {0, 3, 1, 2, 0, 2, 3};
static const double weight[] = {0.5, -2, 1.5, 1, 3, 0.25, -1};
static const kg_sparse sparse = {4, 5, start, column, weight};

static void aggregation_is_a_product_with_the_matrix(void **state)
{
  (void)state;
  static const kg_shape shapes[] = {{2, {5, 1}}, {2, {5, 7}}, {3, {3, 5, 40}}, {4, {2, 3, 5, 3}}};
  double A[4][5] = {{0}};
  for (int r = 0; r < 4; ++r) {
    for (int k = start[r]; k < start[r + 1]; ++k) {
      A[r][column[k]] += weight[k];
    }
  }
  kg_random random = kg_random_make(1);
  for (size_t c = 0; c < KG_COUNT_OF(shapes); ++c) {
    for (int precision = 0; precision < 2; ++precision) {
      kg_tape *tape = new_tape(precision ? KG_FLOAT : KG_DOUBLE, 3);
      const kg_value x = random_input(tape, shapes[c], &random), y = kg_aggregate(tape, &sparse, x);
      const size_t n = (size_t)shapes[c].dim[shapes[c].rank - 1];
      assert_int_equal(kg_size_of(tape, y), kg_size_of(tape, x) / 5 * 4);
      for (size_t e = 0; e < kg_size_of(tape, y); ++e) {
        const size_t outer = e / (4 * n), r = e / n % 4, f = e % n;
        double sum = 0;
        for (size_t k = 0; k < 5; ++k) {
          sum += A[r][k] * kg_item_at(tape, x, (outer * 5 + k) * n + f);
        }
        assert_close(kg_item_at(tape, y, e), sum, precision ? 1e-6 : 1e-15);
      }
      if (!precision) {
        check_operator(tape, 1, &x, y, &random, 1e-13);
        check_lanes(tape, y, &random);
      }
      kg_tape_destroy(tape);
    }
  }
}

/* what row 2 and column 4 hold is not mixed up with the rest: an infinity there stays out */
static void entries_outside_the_matrix_are_not_read(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value y =
    kg_aggregate(tape, &sparse, kg_input(tape, KG_SHAPE(5, 1), (double[]){1, 1, 1, 1, INFINITY}));
  const double expected[] = {-1.5, 1.5, 0, 3.25};
  for (size_t r = 0; r < 4; ++r) {
    assert_true(kg_item_at(tape, y, r) == expected[r]);
  }
  kg_tape_destroy(tape);
}

static void malformed_matrices_are_refused(void **state)
{
  (void)state;
  static const int32_t late[] = {1, 2, 3, 3, 7}, falling[] = {0, 2, 1, 3, 7};
  static const int32_t high[] = {0, 3, 1, 2, 0, 5, 3}, low[] = {0, 3, -1, 2, 0, 2, 3};
  static const struct {
    kg_sparse matrix;
    const char *text;
  } wrong[] = {
    {{0, 5, start, column, weight}, "aggregate: matrix: no rows or no columns"},
    {{4, 5, late, column, weight}, "aggregate: matrix: rows do not start from 0"},
    {{4, 5, falling, column, weight}, "aggregate: matrix: starts of rows decrease"},
    {{4, 5, start, high, weight}, "aggregate: matrix: column out of range"},
    {{4, 5, start, low, weight}, "aggregate: matrix: column out of range"},
    {{4, 6, start, column, weight}, "aggregate: a matrix of shape (4, 6) and x (2, 5, 3)"}};
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  for (size_t c = 0; c < KG_COUNT_OF(wrong); ++c) {
    const kg_value x = kg_input(tape, KG_SHAPE(2, 5, 3), NULL);
    assert_true(kg_is_null(kg_aggregate(tape, &wrong[c].matrix, x)));
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
    assert_string_equal(kg_tape_error(tape)->text, wrong[c].text);
    kg_tape_rewind(tape, (kg_tape_mark){0});
  }
  assert_true(kg_is_null(kg_aggregate(tape, &sparse, kg_input(tape, KG_SHAPE(5), NULL))));
  kg_tape_destroy(tape);
}

static const struct convolution_case {
  int32_t batch, time, in, out, taps;
  kg_padding padding;
  int dilation;
} convolutions[] = {{1, 1, 1, 1, 1, KG_PAD_SAME, 1},   {2, 6, 3, 4, 3, KG_PAD_SAME, 1},
                    {2, 6, 3, 4, 3, KG_PAD_CAUSAL, 1}, {3, 7, 2, 5, 4, KG_PAD_SAME, 1},
                    {2, 9, 2, 3, 3, KG_PAD_SAME, 2},   {2, 9, 2, 3, 3, KG_PAD_CAUSAL, 3},
                    {2, 4, 2, 2, 5, KG_PAD_SAME, 3},   {1, 2, 3, 2, 3, KG_PAD_CAUSAL, 100},
                    {2, 5, 2, 2, 3, KG_PAD_CAUSAL, 3}, {2, 40, 33, 20, 3, KG_PAD_SAME, 1}};

/* y[b, t, o] by the definition */
static double convolved(const kg_tape *tape, const struct convolution_case *c, kg_value x,
                        kg_value w, kg_value bias, size_t e)
{
  const int o = (int)e % c->out, t = (int)e / c->out % c->time, b = (int)e / c->out / c->time;
  const int centre = c->padding == KG_PAD_SAME ? (c->taps - 1) / 2 : c->taps - 1;
  double sum = bias.id ? kg_item_at(tape, bias, (size_t)o) : 0;
  for (int k = 0; k < c->taps; ++k) {
    const int from = t + (k - centre) * c->dilation;
    for (int i = 0; from >= 0 && from < c->time && i < c->in; ++i) {
      sum += kg_item_at(tape, x, (size_t)((b * c->time + from) * c->in + i)) *
             kg_item_at(tape, w, (size_t)((k * c->in + i) * c->out + o));
    }
  }
  return sum;
}

static void convolution_is_its_definition(void **state)
{
  (void)state;
  static const struct {
    kg_precision precision;
    int simd;
    double tolerance;
  } kinds[] = {
    {KG_DOUBLE, 0, 1e-13}, {KG_DOUBLE, 2, 1e-13}, {KG_DOUBLE, 3, 1e-13}, {KG_FLOAT, 3, 2e-5}};
  kg_random random = kg_random_make(2);
  for (size_t n = 0; n < KG_COUNT_OF(convolutions) * KG_COUNT_OF(kinds) * 2; ++n) {
    const struct convolution_case *c = &convolutions[n / 2 / KG_COUNT_OF(kinds)];
    const size_t kind = n / 2 % KG_COUNT_OF(kinds);
    const bool biased = n % 2 == 1;
    kg_tape *tape = new_tape(kinds[kind].precision, kinds[kind].simd);
    const kg_value v[3] = {random_input(tape, KG_SHAPE(c->batch, c->time, c->in), &random),
                           random_input(tape, KG_SHAPE(c->taps, c->in, c->out), &random),
                           random_input(tape, KG_SHAPE(c->out), &random)};
    const kg_value bias = biased ? v[2] : (kg_value){0};
    const kg_value y = kg_convolve(tape, v[0], v[1], bias, c->padding, c->dilation);
    assert_false(kg_is_null(y));
    for (size_t e = 0; e < kg_size_of(tape, y); ++e) {
      assert_close(kg_item_at(tape, y, e), convolved(tape, c, v[0], v[1], bias, e),
                   kinds[kind].tolerance);
    }
    if (kinds[kind].precision == KG_DOUBLE) {
      check_operator(tape, biased ? 3 : 2, v, y, &random, 1e-13);
      check_lanes(tape, y, &random);
    }
    kg_tape_destroy(tape);
  }
}

/* what an operand used several times receives adds up */
static void adjoints_of_shared_operands_add_up(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value v[3] = {random_input(tape, KG_SHAPE(2, 4, 3), &random),
                         random_input(tape, KG_SHAPE(3, 3, 3), &random),
                         random_input(tape, KG_SHAPE(3), &random)};
  const kg_value once = kg_convolve(tape, v[0], v[1], v[2], KG_PAD_SAME, 1);
  const kg_value twice = kg_convolve(tape, once, v[1], v[2], KG_PAD_CAUSAL, 1);
  check_operator(tape, 3, v, kg_add(tape, twice, kg_mul(tape, v[0], v[2])), &random, 1e-12);
  const kg_sparse square = {4, 4, start, column, weight};
  const kg_value y = kg_aggregate(tape, &square, kg_aggregate(tape, &square, v[0]));
  check_operator(tape, 1, v, kg_add(tape, y, v[0]), &random, 1e-12);
  kg_tape_destroy(tape);
}

static void convolutions_that_do_not_fit_are_named(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value x = kg_input(tape, KG_SHAPE(2, 9, 4), NULL);
  const kg_value w = kg_input(tape, KG_SHAPE(3, 4, 5), NULL), b = kg_input(tape, KG_SHAPE(5), NULL);
  const struct {
    kg_value x, w, bias;
    int dilation;
    const char *text;
  } wrong[] = {
    {w, x, b, 1, "convolve: x (3, 4, 5), weight (2, 9, 4), bias (5), dilation 1"},
    {x, w, x, 1, "convolve: x (2, 9, 4), weight (3, 4, 5), bias (2, 9, 4), dilation 1"},
    {b, w, b, 1, "convolve: x (5), weight (3, 4, 5), bias (5), dilation 1"},
    {x, w, (kg_value){0}, 0, "convolve: x (2, 9, 4), weight (3, 4, 5), bias none, dilation 0"}};
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  for (size_t c = 0; c < KG_COUNT_OF(wrong); ++c) {
    assert_true(kg_is_null(
      kg_convolve(tape, wrong[c].x, wrong[c].w, wrong[c].bias, KG_PAD_SAME, wrong[c].dilation)));
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
    assert_string_equal(kg_tape_error(tape)->text, wrong[c].text);
    kg_tape_rewind(tape, mark);
  }
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(aggregation_is_a_product_with_the_matrix),
    cmocka_unit_test(entries_outside_the_matrix_are_not_read),
    cmocka_unit_test(malformed_matrices_are_refused),
    cmocka_unit_test(convolution_is_its_definition),
    cmocka_unit_test(adjoints_of_shared_operands_add_up),
    cmocka_unit_test(convolutions_that_do_not_fit_are_named),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
