/* Element-wise operators: complex steps, broadcasting, lanes, scalars against tensors. */
#include "tape_support.h"

typedef kg_value unary(kg_tape *tape, kg_value a);
typedef kg_value binary(kg_tape *tape, kg_value a, kg_value b);

static kg_tape *new_tape(void)
{
  kg_tape *tape;
  assert_int_equal(kg_tape_create(NULL, &tape, NULL), KG_OK);
  return tape;
}

static const struct unary_case {
  const char *name;
  unary *record;
  double low, high; /* where it is smooth */
} unaries[] = {{"neg", kg_neg, -3, 3},         {"reciprocal", kg_reciprocal, 0.2, 3},
               {"square", kg_square, -3, 3},   {"sqrt", kg_sqrt, 0.01, 4},
               {"abs", kg_abs, -3, 3},         {"exp", kg_exp, -4, 4},
               {"expm1", kg_expm1, -4, 4},     {"log", kg_log, 0.01, 5},
               {"log1p", kg_log1p, -0.9, 4},   {"sin", kg_sin, -9, 9},
               {"cos", kg_cos, -9, 9},         {"tan", kg_tan, -1.4, 1.4},
               {"asin", kg_asin, -0.95, 0.95}, {"acos", kg_acos, -0.95, 0.95},
               {"atan", kg_atan, -5, 5},       {"sinh", kg_sinh, -3, 3},
               {"cosh", kg_cosh, -3, 3},       {"tanh", kg_tanh, -3, 3},
               {"sigmoid", kg_sigmoid, -5, 5}, {"softplus", kg_softplus, -5, 5},
               {"relu", kg_relu, -3, 3}};

static void unary_rules_equal_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(1);
  for (size_t c = 0; c < KG_COUNT_OF(unaries); ++c) {
    kg_tape *tape = new_tape();
    double x[100];
    for (size_t i = 0; i < KG_COUNT_OF(x); ++i) {
      x[i] = unaries[c].low + (unaries[c].high - unaries[c].low) * kg_random_uniform(&random);
    }
    const kg_value a = kg_input(tape, KG_SHAPE(20, 5), x), y = unaries[c].record(tape, a);
    check_operator(tape, 1, &a, y, &random, 1e-12);
    check_lanes(tape, y, &random);
    for (size_t i = 0; i < KG_COUNT_OF(x); ++i) { /* scalars: the same bits */
      const kg_value s = kg_scalar(tape, x[i]), u = unaries[c].record(tape, s);
      const double value = kg_item(tape, u), entry = kg_item_at(tape, y, i);
      assert_memory_equal(&value, &entry, sizeof value);
    }
    kg_tape_destroy(tape);
  }
}

static const struct binary_case {
  const char *name;
  binary *record;
  double low;
} binaries[] = {{"add", kg_add, -3},     {"sub", kg_sub, -3},  {"mul", kg_mul, -3},
                {"div", kg_div, 0.3},    {"pow", kg_pow, 0.1}, {"atan2", kg_atan2, -3},
                {"hypot", kg_hypot, -3}, {"min", kg_min, -3},  {"max", kg_max, -3}};

static void binary_rules_broadcast_and_equal_complex_steps(void **state)
{
  (void)state;
  static const kg_shape shapes[][2] = {
    {{2, {3, 4}}, {2, {3, 4}}},          {{2, {3, 4}}, {1, {4}}},
    {{2, {3, 4}}, {2, {3, 1}}},          {{0, {0}}, {2, {3, 4}}},
    {{2, {3, 1}}, {2, {1, 4}}},          {{3, {2, 3, 4}}, {3, {2, 1, 4}}},
    {{4, {2, 1, 3, 1}}, {3, {5, 1, 2}}}, {{1, {600}}, {0, {0}}},
    {{2, {90, 10}}, {1, {10}}},       {{3, {4, 1, 7}}, {3, {1, 70, 7}}}};
  kg_random random = kg_random_make(2);
  for (size_t c = 0; c < KG_COUNT_OF(binaries); ++c) {
    for (size_t k = 0; k < KG_COUNT_OF(shapes); ++k) {
      kg_tape *tape = new_tape();
      kg_value v[2];
      for (int o = 0; o < 2; ++o) {
        const size_t n = kg_shape_size(&shapes[k][o]);
        double *x = random_numbers(&random, n);
        for (size_t i = 0; i < n; ++i) {
          x[i] = binaries[c].low + (3 - binaries[c].low) * kg_random_uniform(&random);
        }
        v[o] = kg_input(tape, shapes[k][o], x);
        free(x);
      }
      const kg_value y = binaries[c].record(tape, v[0], v[1]);
      check_operator(tape, 2, v, y, &random, 1e-12);
      check_lanes(tape, y, &random);
      kg_tape_destroy(tape);
    }
  }
}

/* three operands of 8 and 16 MB would make 2^61 numbers, whose bytes are 0 modulo 2^64 */
static void results_too_large_to_count_are_refused(void **state)
{
  (void)state;
  kg_tape *tape = new_tape();
  const int32_t n = 1 << 20;
  const kg_value mask = kg_constant(tape, KG_SHAPE(2 * n, 1, 1), NULL);
  const kg_value a = kg_input(tape, KG_SHAPE(n, 1), NULL), b = kg_input(tape, KG_SHAPE(n), NULL);
  assert_true(kg_is_null(kg_where(tape, mask, a, b)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
  kg_tape_destroy(tape);
}

static void check_value(kg_tape *tape, kg_value y, double expected, const char *what)
{
  const double got = kg_item(tape, y);
  if (got != expected && !(isnan(got) && isnan(expected))) {
    fail_msg("%s: %g, not %g", what, got, expected);
  }
}

/* min(max(a, low), high) to the letter, low > high too; what is not a number stays so */
static void clamp_and_relu_mean_their_formulas(void **state)
{
  (void)state;
  kg_tape *tape = new_tape();
  for (int rank = 0; rank < 2; ++rank) {
    for (double x = -3; x <= 3; x += 1) {
      const kg_value a = rank ? kg_input(tape, KG_SHAPE(1), &x) : kg_scalar(tape, x);
      check_value(tape, kg_clamp(tape, a, -1, 2), fmin(fmax(x, -1), 2), "clamp");
      check_value(tape, kg_clamp(tape, a, 2, -1), -1, "clamp between bounds exchanged");
    }
    const double nan = NAN;
    const kg_value a = rank ? kg_input(tape, KG_SHAPE(1), &nan) : kg_scalar(tape, nan);
    check_value(tape, kg_clamp(tape, a, -1, 2), NAN, "clamp");
    check_value(tape, kg_relu(tape, a), NAN, "relu");
  }
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(unary_rules_equal_complex_steps),
    cmocka_unit_test(binary_rules_broadcast_and_equal_complex_steps),
    cmocka_unit_test(results_too_large_to_count_are_refused),
    cmocka_unit_test(clamp_and_relu_mean_their_formulas),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
