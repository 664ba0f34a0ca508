/* Every row of `kinegrad bench dynamics` and `step` on the synthetic skeletons: kinegrad, MuJoCo
 * where it is installed, and the reference give one answer. Nothing is timed. */
#include "support.h"

#include "bench/bench.h"
#include "bench/dynamics/models.h"
#include "bench/dynamics/reference.h"

static const kg_bench_suite *suite_named(const char *name)
{
  for (int i = 0; i < kg_bench_suite_count; i++) {
    if (strcmp(kg_bench_suites[i].name, name) == 0) {
      return &kg_bench_suites[i];
    }
  }
  fail_msg("there is no suite %s", name);
  return NULL;
}

/* Contestants that answered, all of them as the case tolerates. */
static int check_case(const kg_bench_case *of)
{
  const kg_bench_setting setting = {.rounds = 1};
  kg_bench_case untimed = *of;
  untimed.is_check_only = true;
  kg_bench_result result;
  kg_error error = {.text = ""};
  if (kg_bench_run(&result, &untimed, &setting, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  int answers = 0;
  for (int i = 0; i < of->contestant_count; i++) {
    const kg_bench_measure *m = &result.measures[i];
    if (!isnan(m->difference)) {
      print_message("%s, %s: %.1e %s\n", of->name, of->contestants[i].name, m->difference,
                    result.problem.parts[m->worst_part].name);
      assert_at_most(m->difference, of->tolerance);
      answers++;
    }
  }
  assert_true(result.agrees);
  return answers;
}

static void check_suite(const char *name)
{
  const kg_bench_suite *suite = suite_named(name);
  for (int g = 0; g < suite->group_count; g++) {
    for (int k = 0; k < suite->groups[g].count; k++) {
      assert_true(check_case(&suite->groups[g].cases[k]) > 0);
    }
  }
}

static void answers_of_the_dynamics_agree(void **state)
{
  (void)state;
  check_suite("dynamics");
}

static void answers_of_the_step_agree(void **state)
{
  (void)state;
  check_suite("step");
}

/* The reference where the answer is known: one free rigid body. */
static void reference_of_one_body(void **state)
{
  (void)state;
  const kg_segment box = {.name = "box",
                          .role = -1,
                          .joint = -1,
                          .parent = -1,
                          .mass = 2.0,
                          .inertia = {0.3, 0.5, 0.4, 0.0, 0.0, 0.0}};
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, &box, 1, NULL, 0, NULL), KG_OK);
  const double s = sqrt(0.5), q[7] = {1.0, 2.0, 3.0, s, 0.0, 0.0, s}; /* quarter turn about z */
  const double v[6] = {0.1, 0.2, 0.3, 1.0, 2.0, 3.0}, a[6] = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0};
  double tau[6], p[3], R[9], A[36];
  assert_int_equal(kg_bench_reference_inverse(body, tau, q, v, a), KG_OK);
  /* Euler's equations: I w' + w x I w */
  const double expected[6] = {2.0,
                              2.0 * (2.0 + kg_bench_gravity),
                              6.0,
                              0.3 * 4.0 + (0.4 - 0.5) * 2.0 * 3.0,
                              0.5 * 5.0 + (0.3 - 0.4) * 3.0 * 1.0,
                              0.4 * 6.0 + (0.5 - 0.3) * 1.0 * 2.0};
  for (int k = 0; k < 6; k++) {
    assert_close(tau[k], expected[k], 1e-14);
  }
  assert_int_equal(kg_bench_reference_pose(body, p, R, q), KG_OK);
  assert_close(R[1], -1.0, 1e-15);
  assert_close(R[3], 1.0, 1e-15);
  assert_int_equal(kg_bench_reference_centroidal(body, A, q), KG_OK);
  assert_close(A[4], -0.5, 1e-15); /* L_x of a turn about the body's y, which is the world's -x */
  assert_close(A[6 * 3 + 0], 2.0, 1e-15);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(reference_of_one_body),
    cmocka_unit_test(answers_of_the_dynamics_agree),
    cmocka_unit_test(answers_of_the_step_agree),
  };
  return cmocka_run_group_tests_name("bench dynamics", tests, NULL, NULL);
}
