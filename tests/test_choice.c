/* Masks, where, and the guard behind an `if` of the recording code. */
#include "tape_support.h"

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = 3};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static void masks_compare_entry_by_entry(void **state)
{
  (void)state;
  const double x[4] = {1, 2, NAN, INFINITY}, bound[1] = {2};
  const double less[4] = {1, 0, 0, 0}, less_equal[4] = {1, 1, 0, 0};
  for (int p = 0; p < 2; ++p) {
    kg_tape *tape = new_tape(p ? KG_FLOAT : KG_DOUBLE);
    const kg_value a = kg_input(tape, KG_SHAPE(4), x), b = kg_input(tape, KG_SHAPE(1), bound);
    const kg_value below = kg_less(tape, a, b), up_to = kg_less_equal(tape, a, b);
    for (size_t i = 0; i < 4; ++i) {
      assert_true(kg_item_at(tape, below, i) == less[i]);
      assert_true(kg_item_at(tape, up_to, i) == less_equal[i]);
    }
    assert_false(kg_node_of(tape, below)->active);
    kg_tape_destroy(tape);
  }
}

/* mask, a, b: every operand is the one that repeats once */
static const kg_shape shapes[][3] = {
  {{2, {3, 4}}, {2, {3, 4}}, {2, {3, 4}}},    {{1, {4}}, {2, {3, 4}}, {2, {3, 1}}},
  {{2, {3, 1}}, {0, {0}}, {2, {3, 4}}},       {{2, {30, 40}}, {2, {30, 40}}, {0, {0}}},
  {{0, {0}}, {3, {2, 3, 2}}, {3, {2, 1, 2}}}, {{0, {0}}, {0, {0}}, {0, {0}}}};

static void where_equals_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(21);
  for (size_t k = 0; k < KG_COUNT_OF(shapes); ++k) {
    kg_tape *tape = new_tape(KG_DOUBLE);
    kg_value v[3];
    for (int o = 0; o < 3; ++o) {
      double *x = random_numbers(&random, kg_shape_size(&shapes[k][o]));
      v[o] = kg_input(tape, shapes[k][o], x);
      free(x);
    }
    const kg_value mask = kg_less(tape, v[0], kg_constant_scalar(tape, 0));
    const kg_value y = kg_where(tape, mask, v[1], v[2]);
    check_operator(tape, 3, v, y, &random, 1e-13);
    check_lanes(tape, y, &random);
    kg_tape_destroy(tape);
  }
}

/* sqrt of a negative number and its infinite slope at zero do not come through */
static void operand_not_taken_leaves_no_trace(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_input(tape, KG_SHAPE(4), (double[]){-1, 0, 4, INFINITY});
  const kg_value zero = kg_constant_scalar(tape, 0);
  const kg_value y = kg_where(tape, kg_less(tape, zero, x), kg_sqrt(tape, x), x);
  const double expected[4] = {1, 1, 0.25, 0}, value[4] = {-1, 0, 2, INFINITY};
  assert_int_equal(kg_backward(tape, y), KG_OK);
  for (size_t i = 0; i < 4; ++i) {
    assert_true(kg_item_at(tape, y, i) == value[i]);
    assert_true(kg_adjoint(tape, x)[i] == expected[i]);
  }
  const double seed[4] = {NAN, 0, NAN, 0}, *seeds = seed;
  double g[4], *gradient = g;
  const kg_value a = kg_input(tape, KG_SHAPE(4), NULL);
  const kg_value chosen = kg_where(tape, kg_less(tape, zero, x), a, x);
  assert_int_equal(kg_vjp(tape, 1, 1, &chosen, &seeds, 1, &a, &gradient), KG_OK);
  assert_true(g[0] == 0 && g[1] == 0 && isnan(g[2]) && g[3] == 0);
  kg_tape_destroy(tape);
}

/* -- is_less ----------------------------------------------------------------------------------- */

static kg_status run_guard(const kg_tape *tape, size_t lanes, const double *a, const double *b,
                           double *answers)
{
  const kg_node *node = &tape->graph.node[tape->graph.count - 1];
  const void *in[2] = {a, b};
  const kg_call call = {.attributes = node->is.block->attributes,
                        .size = 1,
                        .lanes = lanes,
                        .count = 2,
                        .in = in,
                        .out = answers};
  assert_int_equal(node->op, kg_op_is_less);
  return node->is.block->kernel->forward(&call);
}

static void guard_says_when_the_answer_turns(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value a = kg_scalar(tape, 1), b = kg_constant_scalar(tape, 2);
  double answers[3];
  assert_true(kg_is_less(tape, a, b));
  assert_int_equal(run_guard(tape, 3, (double[]){1, -5, 1.9}, (double[]){2, 2, 2}, answers), KG_OK);
  assert_int_equal(run_guard(tape, 3, (double[]){1, 2, 1}, (double[]){2, 2, 2}, answers),
                   KG_ERR_STALE);
  assert_true(answers[0] == 1 && answers[1] == 0 && answers[2] == 1);
  assert_int_equal(run_guard(tape, 1, (double[]){NAN}, (double[]){2}, answers), KG_ERR_STALE);
  assert_false(kg_is_less(tape, b, a));
  assert_int_equal(run_guard(tape, 1, (double[]){2}, (double[]){2}, answers), KG_OK);
  assert_int_equal(run_guard(tape, 1, (double[]){1}, (double[]){2}, answers), KG_ERR_STALE);
  kg_tape_destroy(tape);
}

/* between constants too (a program may change them), and on masks, which are inactive */
static void every_comparison_is_recorded(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value a = kg_scalar(tape, 1), b = kg_constant_scalar(tape, 2);
  const kg_value operands[3] = {a, b, kg_less(tape, a, b)};
  for (size_t i = 0; i < KG_COUNT_OF(operands); ++i) {
    const size_t nodes = kg_tape_nodes(tape);
    assert_true(kg_is_less(tape, operands[i], b) == (i != 1));
    assert_int_equal(kg_tape_nodes(tape), nodes + 1);
    assert_false(tape->graph.node[tape->graph.count - 1].active);
  }
  kg_tape_destroy(tape);
}

static void refusals(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value a = kg_input(tape, KG_SHAPE(2), NULL), b = kg_scalar(tape, 1);
  const kg_value c = kg_input(tape, KG_SHAPE(3), NULL);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  assert_false(kg_is_less(tape, a, b));
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
  assert_non_null(strstr(kg_tape_error(tape)->text, "is_less: shapes (2) and ()"));
  kg_tape_rewind(tape, mark);
  assert_true(kg_is_null(kg_where(tape, b, a, c)));
  assert_non_null(strstr(kg_tape_error(tape)->text, "where: shapes (), (2), (3)"));
  assert_false(kg_is_less(tape, kg_constant_scalar(tape, 0), b)); /* the null value: false */
  kg_tape_rewind(tape, mark);
  assert_true(kg_is_null(kg_less(tape, a, c)));
  assert_non_null(strstr(kg_tape_error(tape)->text, "less: shapes (2), (3)"));
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(masks_compare_entry_by_entry),
    cmocka_unit_test(where_equals_complex_steps),
    cmocka_unit_test(operand_not_taken_leaves_no_trace),
    cmocka_unit_test(guard_says_when_the_answer_turns),
    cmocka_unit_test(every_comparison_is_recorded),
    cmocka_unit_test(refusals),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
