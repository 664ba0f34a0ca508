/* The registry is complete, its checks pass, and they are not blind: a wrong derivative in any operator is what
 * scripts/mutate-adjoints plants. */
#include "support.h"

#include "autodiff/gradcheck.h"

#include <stdio.h>

static void every_operator_has_a_check(void **state)
{
  (void)state;
  bool checked[KG_OP_COUNT] = {[kg_op_input] = true, [kg_op_constant] = true};
  for (int i = 0; i < kg_registry_count(); ++i) {
    checked[kg_registry_op(i)] = true;
    for (int k = 0; k < i; ++k) {
      assert_string_not_equal(kg_registry_name(i), kg_registry_name(k));
    }
  }
  for (int op = 0; op < KG_OP_COUNT; ++op) {
    if (!checked[op]) fail_msg("%s is in no row of the registry", kg_op_name((kg_op)op));
  }
}

static void every_check_passes(void **state)
{
  (void)state;
  int failed = 0;
  for (int i = 0; i < kg_registry_count(); ++i) {
    kg_gradcheck_report report;
    kg_error error = {0};
    const kg_status status = kg_registry_check(i, 40, NULL, &report, &error);
    char text[512];
    kg_gradcheck_row(&report, text, sizeof text);
    if (status != KG_OK || !report.passed) {
      printf("%s: %s %s\n", kg_registry_name(i), text, error.text);
      ++failed;
    }
  }
  assert_int_equal(failed, 0);
}

static void another_seed_draws_other_points(void **state)
{
  (void)state;
  kg_gradcheck_def def = kg_gradcheck_default_def();
  kg_gradcheck_report one, same, other;
  assert_int_equal(kg_registry_check(5, 3, &def, &one, NULL), KG_OK);
  assert_int_equal(kg_registry_check(5, 3, &def, &same, NULL), KG_OK);
  def.seed = 2;
  assert_int_equal(kg_registry_check(5, 3, &def, &other, NULL), KG_OK);
  assert_true(one.dot_test == same.dot_test && one.dot_test != other.dot_test);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(every_operator_has_a_check),
    cmocka_unit_test(every_check_passes),
    cmocka_unit_test(another_seed_draws_other_points),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
