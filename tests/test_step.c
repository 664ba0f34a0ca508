/* The implicit step: Jacobian against differences and LAPACK, answers against Ceres, and physics:
 * flight, standing, sliding, sticking, energy. */
#include "fixture_body.h"

#include "kinegrad/ceres.h"
#include "kinegrad/dense.h"
#include "kinegrad/step.h"

#include <stdio.h>
#include <time.h>

static kg_scene ground(void)
{
  return kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
}

static kg_step *step_of(const kg_step_def *def)
{
  kg_step *s = NULL;
  assert_int_equal(kg_step_create(&s, def), KG_OK);
  return s;
}

static double largest(const double *a, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    size = fmax(size, fabs(a[k]));
  }
  return size;
}

/* A state of the human near the ground. kind: 0 flight, 1 standing, 2 sliding, 3 lying. */
static void human_state(kg_random *random, const kg_body *body, int kind, double *q, double *v)
{
  double d[MAX_NV];
  const double height[4] = {1.8, human_root_height + 0.003, human_root_height + 0.002, 0.092};
  rest_state(body, height[kind], q);
  for (int k = 0; k < body->nv; k++) {
    d[k] = (kind == 0 ? 0.5 : 0.002) * kg_random_normal(random);
    v[k] = (kind == 0 ? 2.0 : kind == 1 ? 1e-4 : 0.3) * kg_random_normal(random);
  }
  d[1] = 0.0;
  if (kind == 3) { /* on its back */
    d[3] = -0.5 * 3.14159265358979;
  }
  kg_body_integrate(body, q, q, d);
  if (kind == 2) {
    v[0] += 1.0;
  }
}

static double jacobian_error(kg_step *s, const kg_body *body, const double *q, const double *v,
                             const double *v_end, double dt, double h, int *contacts)
{
  static double J[MAX_NV * MAX_NV];
  double G[MAX_NV], x[MAX_NV], plus[MAX_NV], minus[MAX_NV];
  kg_step_report report;
  const int nv = body->nv;
  kg_step_residual(s, G, J, v_end, q, v, NULL, dt, &report);
  *contacts = report.contact_count;
  double worst = 0.0;
  memcpy(x, v_end, sizeof x);
  for (int c = 0; c < nv; c++) {
    double slope[MAX_NV] = {0.0}, column[MAX_NV];
    for (int r = 0; r < nv; r++) {
      column[r] = J[r * nv + c];
    }
    for (int level = 0; level < 2; level++) {
      const double step = level == 0 ? h : 0.5 * h;
      x[c] = v_end[c] + step;
      kg_step_residual(s, plus, NULL, x, q, v, NULL, dt, NULL);
      x[c] = v_end[c] - step;
      kg_step_residual(s, minus, NULL, x, q, v, NULL, dt, NULL);
      x[c] = v_end[c];
      for (int r = 0; r < nv; r++) {
        slope[r] += (level == 0 ? -1.0 : 4.0) / (6.0 * step) * (plus[r] - minus[r]);
      }
    }
    const double size = largest(J, nv * nv);
    for (int r = 0; r < nv; r++) {
      worst = fmax(worst, fabs(slope[r] - column[r]) / size);
    }
  }
  return worst;
}

static void jacobian_matches_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(31);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_scene bumpy = ground();
  const kg_shape ball = {.kind = KG_SHAPE_SPHERE, .a = {0.1, -0.5, 0.1}, .radius = 0.5005};
  assert_true(kg_scene_add(&bumpy, &ball));
  /* as large as kinks allow: of the slip at 3e-4 m/s when standing */
  const double step_size[4] = {1e-3, 2e-7, 4e-6, 4e-6};
  double worst[4] = {0.0};
  for (int trial = 0; trial < 24; trial++) {
    kg_step_def def = kg_step_default_def(body);
    def.scene = trial % 8 < 4 ? &scene : &bumpy;
    def.joint_damping = 2.0;
    kg_step *s = step_of(&def);
    double q[MAX_NQ], v[MAX_NV], v_end[MAX_NV];
    const int kind = trial % 4;
    human_state(&random, body, kind, q, v);
    for (int k = 0; k < body->nv; k++) {
      v_end[k] = v[k] + (kind == 0 ? 0.3 : 1e-3) * kg_random_normal(&random);
    }
    int contacts = 0;
    const double error = jacobian_error(s, body, q, v, v_end, 0.01, step_size[kind], &contacts);
    assert_true(kind == 0 ? contacts == 0 : contacts > 3);
    worst[kind] = fmax(worst[kind], error);
    assert_at_most(error, 2e-8);
    kg_step_destroy(s);
  }
  print_message("dG/dv' against differences: flight %.1e standing %.1e sliding %.1e lying %.1e\n",
                worst[0], worst[1], worst[2], worst[3]);
  kg_body_destroy(body);
}

static double seconds(void)
{
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Prints, claims nothing: microseconds on the standing human. */
static void timings(void **state)
{
  (void)state;
  kg_random random = kg_random_make(39);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[MAX_NQ], v[MAX_NV], G[MAX_NV], q2[MAX_NQ], v2[MAX_NV];
  static double J[MAX_NV * MAX_NV];
  for (int kind = 0; kind < 3; kind++) {
    human_state(&random, body, kind, q, v);
    double best[3] = {1.0, 1.0, 1.0};
    const int repeats = 300;
    kg_step_report report = {0};
    for (int round = 0; round < 5; round++) {
      const double t0 = seconds();
      for (int k = 0; k < repeats; k++) {
        kg_step_residual(s, G, NULL, v, q, v, NULL, 1.0 / 120.0, NULL);
      }
      const double t1 = seconds();
      for (int k = 0; k < repeats; k++) {
        kg_step_residual(s, G, J, v, q, v, NULL, 1.0 / 120.0, NULL);
      }
      const double t2 = seconds();
      for (int k = 0; k < repeats; k++) {
        kg_step_advance(s, q2, v2, q, v, NULL, 1.0 / 120.0, false, &report);
      }
      const double t3 = seconds();
      best[0] = fmin(best[0], (t1 - t0) / repeats);
      best[1] = fmin(best[1], (t2 - t1) / repeats);
      best[2] = fmin(best[2], (t3 - t2) / repeats);
    }
    const char *name[3] = {"flight", "standing", "sliding"};
    print_message("%s, us a call: residual %.1f, with Jacobian %.1f, step %.1f (%d iterations, %d "
                  "contacts, %d sub-steps)\n",
                  name[kind], 1e6 * best[0], 1e6 * best[1], 1e6 * best[2], report.iterations,
                  report.contact_count, report.substeps);
  }
  kg_step_destroy(s);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(jacobian_matches_differences),
    cmocka_unit_test(timings),
  };
  return cmocka_run_group_tests_name("step", tests, NULL, NULL);
}
