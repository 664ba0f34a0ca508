/* Every row of `kinegrad bench sdf`: kinegrad, its peers where they are installed, and the distance to
 * all triangles give one answer. Nothing is timed. The meshes of the bench are what they say. */
#include "support.h"

#include "bench/bench.h"
#include "bench/sdf/brute.h"
#include "bench/sdf/exact.h"
#include "kinegrad/mesh.h"

#include <stdio.h>

static const kg_bench_suite *suite_sdf(void)
{
  for (int i = 0; i < kg_bench_suite_count; i++) {
    if (strcmp(kg_bench_suites[i].name, "sdf") == 0) {
      return &kg_bench_suites[i];
    }
  }
  fail_msg("there is no suite sdf");
  return NULL;
}

static void check_case(const kg_bench_case *of)
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
  assert_true(answers > 0);
}

static void answers_agree(void **state)
{
  (void)state;
  const kg_bench_suite *suite = suite_sdf();
  for (int g = 0; g < suite->group_count; g++) {
    for (int k = 0; k < suite->groups[g].count; k++) {
      check_case(&suite->groups[g].cases[k]);
    }
  }
}

/* Counts and closedness as the names and flags say, outwards, without repeated or lost triangles. */
static void surfaces_are_what_they_say(void **state)
{
  (void)state;
  for (int kind = 0; kind < KG_BENCH_MILLION; kind++) {
    kg_bench_surface s;
    assert_int_equal(kg_bench_surface_make(&s, (kg_bench_surface_kind)kind), KG_OK);
    kg_mesh *mesh;
    kg_mesh_report report;
    assert_int_equal(kg_mesh_create(&mesh, s.vertices, s.vertex_count, s.triangles,
                                    s.triangle_count, &report, NULL, NULL),
                     KG_OK);
    char count[32];
    snprintf(count, sizeof count, "%d %03d triangles", s.triangle_count / 1000,
             s.triangle_count % 1000);
    assert_non_null(strstr(s.name, count));
    assert_int_equal(report.triangles, s.triangle_count);
    assert_int_equal(report.vertices, s.vertex_count);
    assert_true(report.closed == s.is_closed);
    assert_false(report.inside_out);
    assert_int_equal(report.non_manifold_edges + report.inconsistent_edges, 0);
    kg_mesh_destroy(mesh);
    kg_bench_surface_free(&s);
  }
}

/* The reference where the answer is known: the plate is a box of 2 x 0.004 x 2 m. */
static void reference_of_a_box(void **state)
{
  (void)state;
  kg_bench_surface s;
  assert_int_equal(kg_bench_surface_make(&s, KG_BENCH_PLATE), KG_OK);
  kg_bench_brute *brute = kg_bench_brute_make(&s);
  assert_non_null(brute);
  kg_random random = kg_random_make(3);
  int inside = 0;
  for (int i = 0; i < 300; i++) {
    const double x = kg_random_uniform(&random) * 2.4 - 1.2,
                 z = kg_random_uniform(&random) * 2.4 - 1.2;
    const double y = (kg_random_uniform(&random) - 0.5) * (i % 2 ? 0.006 : 0.4);
    const double out[3] = {fabs(x) - 1.0, fabs(y) - 0.002, fabs(z) - 1.0};
    const double within = fmax(out[0], fmax(out[1], out[2]));
    const double beyond =
      sqrt(pow(fmax(out[0], 0.0), 2.0) + pow(fmax(out[1], 0.0), 2.0) + pow(fmax(out[2], 0.0), 2.0));
    const kg_vec3 p = kg_vec3_make(x, y, z);
    assert_close(kg_bench_brute_distance(brute, p), within < 0.0 ? -within : beyond, 1e-14);
    assert_true(kg_bench_brute_inside(brute, p) == (within < 0.0));
    inside += within < 0.0;
  }
  assert_true(inside > 30);
  kg_bench_brute_free(brute);
  kg_bench_surface_free(&s);
}

/* The same points in larger numbers: bench/mesh_exact.c. */
static void distances_are_those_to_all_triangles(void **state)
{
  (void)state;
  for (int kind = 0; kind < KG_BENCH_MILLION; kind++) {
    kg_bench_tally t;
    kg_bench_exact(&t, (kg_bench_surface_kind)kind, 600, 77);
    print_message("%s: %.1e, %d inside, %d on it\n", t.name, t.worst, t.inside, t.on_surface);
    assert_int_equal(t.points, 600);
    assert_at_most(t.worst, 1e-13);
    assert_int_equal(t.signs_wrong, 0);
    assert_in_range(t.inside, 60, 300);
    assert_in_range(t.on_surface, 90, 110);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(reference_of_a_box),
    cmocka_unit_test(surfaces_are_what_they_say),
    cmocka_unit_test(distances_are_those_to_all_triangles),
    cmocka_unit_test(answers_agree),
  };
  return cmocka_run_group_tests_name("bench sdf", tests, NULL, NULL);
}
