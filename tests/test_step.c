/* The implicit step: Jacobian against differences, answers against LAPACK and Ceres, convergence,
 * failures, bits, memory. What it does to bodies is in test_step_physics.c. */
#include "fixture_body.h"
#include "fixture_step.h"

#include "kinegrad/ceres.h"
#include "kinegrad/dense.h"
#include "kinegrad/step.h"

#include <stdio.h>
#include <time.h>

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
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .a = {0.1, -0.5, 0.1}, .radius = 0.5005};
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

/* Central differences err with the square of their width until rounding takes over: four widths,
 * each a quarter of the one before, along a random direction. The first is as large as kinks
 * allow. */
static void differences_of_four_widths_approach_the_jacobian(void **state)
{
  (void)state;
  static const char *const names[4] = {"flight", "standing", "sliding", "lying"};
  const double first[4] = {3e-2, 1e-5, 3e-4, 3e-4};
  kg_random random = kg_random_make(38);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  static double J[MAX_NV * MAX_NV];
  const int nv = body->nv;
  for (int kind = 0; kind < 4; kind++) {
    double q[MAX_NQ], v[MAX_NV], x[MAX_NV], p[MAX_NV], G[2][MAX_NV], slope[MAX_NV] = {0.0};
    human_state(&random, body, kind, q, v);
    double length = 0.0, error[4];
    for (int k = 0; k < nv; k++) {
      p[k] = kg_random_normal(&random);
      length += p[k] * p[k];
    }
    kg_step_residual(s, G[0], J, v, q, v, NULL, 0.01, NULL);
    for (int k = 0; k < nv * nv; k++) {
      slope[k / nv] += J[k] * p[k % nv] / sqrt(length);
    }
    print_message("%s: central differences", names[kind]);
    for (int level = 0; level < 4; level++) {
      const double h = ldexp(first[kind], -2 * level);
      for (int side = 0; side < 2; side++) {
        for (int k = 0; k < nv; k++) {
          x[k] = v[k] + (side == 0 ? h : -h) * p[k] / sqrt(length);
        }
        kg_step_residual(s, G[side], NULL, x, q, v, NULL, 0.01, NULL);
      }
      for (int k = 0; k < nv; k++) {
        G[0][k] = (G[0][k] - G[1][k]) / (2.0 * h) - slope[k];
      }
      error[level] = largest(G[0], nv) / largest(slope, nv);
      print_message(" %.1e", error[level]);
    }
    print_message("\n");
    for (int level = 1; level < 4; level++) { /* sixteen times less, or at what rounding leaves */
      const double rounding = 1e-13 / ldexp(first[kind], -2 * level);
      assert_at_most(error[level], error[level - 1] / 14.0 + rounding);
    }
    assert_at_most(error[3], 1e-7);
  }
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* ---- the answer against other solvers ---------------------------------------------------------*/

typedef struct square_system {
  kg_step *s;
  const double *q, *v, *tau;
  double dt;
  double row[MAX_NV]; /* of the residual, to make rows comparable */
  int nv;
} square_system;

static bool ceres_residual(double *r, const double *x, void *user)
{
  square_system *c = user;
  kg_step_residual(c->s, r, NULL, x, c->q, c->v, c->tau, c->dt, NULL);
  for (int k = 0; k < c->nv; k++) {
    r[k] *= c->row[k];
  }
  return true;
}

static bool ceres_jacobian(double *J, const double *x, void *user)
{
  square_system *c = user;
  double G[MAX_NV];
  kg_step_residual(c->s, G, J, x, c->q, c->v, c->tau, c->dt, NULL);
  for (int k = 0; k < c->nv * c->nv; k++) {
    J[k] *= c->row[k / c->nv];
  }
  return true;
}

static void scale_rows(square_system *c, const kg_body *body)
{
  static double M[MAX_NV * MAX_NV];
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_dynamics_mass_matrix(d, M, c->q);
  for (int k = 0; k < c->nv; k++) {
    c->row[k] = c->dt / sqrt(M[k * c->nv + k]);
  }
  kg_dynamics_destroy(d);
}

/* Largest difference of two velocities, in kg^1/2 m/s. */
static double velocity_difference(const square_system *c, const double *a, const double *b)
{
  double worst = 0.0;
  for (int k = 0; k < c->nv; k++) {
    worst = fmax(worst, fabs(a[k] - b[k]) * c->dt / c->row[k]);
  }
  return worst;
}

/* Newton with dense LAPACK factors, undamped, from nearby. */
static void polish_with_lapack(square_system *c, double *x)
{
  static double J[MAX_NV * MAX_NV];
  double G[MAX_NV];
  int pivots[MAX_NV];
  for (int k = 0; k < 6; k++) {
    kg_step_residual(c->s, G, J, x, c->q, c->v, c->tau, c->dt, NULL);
    assert_true(kg_dense_lu_factor(J, pivots, c->nv));
    kg_dense_lu_solve(J, pivots, c->nv, G, 1);
    for (int r = 0; r < c->nv; r++) {
      x[r] -= G[r];
    }
  }
}

/* Ceres on the same equation from x. True when it ends on a solution; x is then that one. */
static bool solve_with_ceres(square_system *c, double *x)
{
  kg_ceres_def ceres = kg_ceres_default_def(c->nv, c->nv);
  ceres.residual = ceres_residual;
  ceres.jacobian = ceres_jacobian;
  ceres.user = c;
  ceres.max_iterations = 400;
  kg_ceres_report answer;
  assert_int_equal(kg_ceres_minimize(&ceres, x, &answer), KG_OK);
  return sqrt(2.0 * answer.cost) <= 1e-9;
}

/* Ceres starts cold, at the velocity of the start of the step. It minimises |G|^2, which has minima
 * that are no solutions; from one of those it starts again beside our answer, where contact still
 * has a say. */
static void step_agrees_with_ceres_and_lapack(void **state)
{
  (void)state;
  static const char *const names[4] = {"flight", "standing", "sliding", "lying"};
  enum { TRIALS = 6 };
  kg_random random = kg_random_make(32);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 5.0;
  def.tolerance = 1e-10; /* both answers must be that near to the solution */
  kg_step *s = step_of(&def);
  for (int kind = 0; kind < 4; kind++) {
    double worst[2] = {0.0, 0.0};
    int cold = 0;
    for (int trial = 0; trial < TRIALS; trial++) {
      double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV], x[MAX_NV];
      human_state(&random, body, kind, q, v);
      for (int k = 0; k < body->nv; k++) {
        tau[k] = k < 6 ? 0.0 : 5.0 * kg_random_normal(&random);
      }
      kg_step_report report;
      kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, false, &report);
      assert_true(report.converged && report.substeps == 1);
      assert_at_most(report.residual, def.tolerance);
      assert_true((report.contact_count > 0) == (kind > 0));
      square_system c = {.s = s, .q = q, .v = v, .tau = tau, .dt = 0.01, .nv = body->nv};
      scale_rows(&c, body);
      memcpy(x, v_next, sizeof x);
      polish_with_lapack(&c, x);
      worst[0] = fmax(worst[0], velocity_difference(&c, x, v_next));
      memcpy(x, v, sizeof x);
      const bool found = solve_with_ceres(&c, x);
      cold += found;
      if (!found) {
        for (int k = 0; k < body->nv; k++) {
          x[k] = v_next[k] + 1e-3 * kg_random_normal(&random);
        }
        assert_true(solve_with_ceres(&c, x));
      }
      worst[1] = fmax(worst[1], velocity_difference(&c, x, v_next));
    }
    print_message(
      "%s: v' against LAPACK Newton %.1e, against Ceres %.1e kg^1/2 m/s; Ceres found it "
      "cold in %d of %d\n",
      names[kind], worst[0], worst[1], cold, TRIALS);
    assert_at_most(worst[0], 1e-8);
    assert_at_most(worst[1], 1e-8);
    assert_true(cold >= (kind < 2 ? TRIALS : 2)); /* an answer that owes nothing to ours */
  }
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* ---- convergence ------------------------------------------------------------------------------*/

/* Lowest point of the body moved to a height. */
static void put_on_ground(kg_dynamics *d, const kg_body *body, double height, double *q)
{
  double low = INFINITY;
  for (int k = 0; k < body->point_count; k++) {
    low = fmin(low, kg_dynamics_point(d, NULL, q, body->points[k]).y);
  }
  q[1] += height - low;
}

/* kind: 0 standing shaken, 1 landing at 1 to 3 m/s, 2 sliding at 2 m/s, 3 lying, 4 too deep */
static void contact_state(kg_random *random, kg_dynamics *d, const kg_body *body, int kind,
                          double *q, double *v)
{
  double turn[MAX_NV];
  rest_state(body, kind == 3 ? 0.092 : human_root_height + (kind == 4 ? -0.010 : 0.003), q);
  for (int k = 0; k < body->nv; k++) {
    const bool loose = (kind == 1 || kind == 2) && k >= 3;
    turn[k] = (loose ? 0.1 : 0.003) * kg_random_normal(random);
    v[k] = 0.2 * kg_random_normal(random);
  }
  turn[1] = 0.0;
  turn[3] += kind == 3 ? -1.5707963 : 0.0;
  kg_body_integrate(body, q, q, turn);
  if (kind == 1 || kind == 2) {
    put_on_ground(d, body, 0.006 * kg_random_uniform(random), q);
  }
  v[1] = kind == 1 ? -1.0 - 2.0 * kg_random_uniform(random) : v[1];
  v[0] += kind == 2 ? 2.0 : 0.0;
}

static void newton_converges_on_random_contact_states(void **state)
{
  (void)state;
  static const char *const names[5] = {"standing", "landing", "sliding", "lying", "deep"};
  static const double mean[5] = {4.5, 8.0, 4.5, 4.5, 5.5}; /* iterations; a little over today's */
  kg_random random = kg_random_make(33);
  kg_body *body = human_body();
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 2.0;
  kg_step *s = step_of(&def);
  for (int kind = 0; kind < 5; kind++) {
    int iterations = 0, most = 0, divided = 0;
    const int count = 80;
    for (int trial = 0; trial < count; trial++) {
      double q[MAX_NQ], v[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV];
      contact_state(&random, d, body, kind, q, v);
      const double dt = trial % 2 == 0 ? 1.0 / 120.0 : 1.0 / 60.0;
      kg_step_report report;
      kg_step_advance(s, q_next, v_next, q, v, NULL, dt, false, &report);
      assert_true(report.converged);
      assert_at_most(report.residual, def.tolerance);
      iterations += report.iterations;
      most = report.iterations > most ? report.iterations : most;
      divided += report.substeps > 1;
    }
    print_message("%-9s %d steps: all converged, %d in sub-steps, iterations mean %.1f max %d\n",
                  names[kind], count, divided, (double)iterations / count, most);
    assert_at_most((double)iterations / count, mean[kind]);
    assert_at_most(divided, kind == 1 ? 2 : 0);
  }
  kg_step_destroy(s);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* The report's contacts are the points inside the layer at q, no more and no fewer, with the forces
 * of the law as it was asked for. */
static void assert_contacts_are_true(const kg_step_def *def, kg_dynamics *d, const double *q,
                                     const kg_step_report *report)
{
  int seen = 0;
  for (int k = 0; k < def->body->point_count; k++) {
    const kg_vec3 x = kg_dynamics_point(d, NULL, q, def->body->points[k]);
    const bool inside = kg_scene_distance(def->scene, x).distance < def->contact.layer;
    const kg_step_contact *found = NULL;
    for (int c = 0; c < report->contact_count; c++) {
      found = report->contacts[c].point == k ? &report->contacts[c] : found;
    }
    assert_true((found != NULL) == inside);
    if (found) {
      seen++;
      assert_at_most(kg_vec3_norm(kg_vec3_sub(found->x, x)), 1e-14);
    }
  }
  assert_int_equal(seen, report->contact_count);
}

static void contact_list_matches_brute_force(void **state)
{
  (void)state;
  kg_random random = kg_random_make(40);
  kg_body *body = human_body();
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  int contacts = 0;
  for (int trial = 0; trial < 200; trial++) {
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], G[MAX_NV];
    random_state(&random, body, q, v, a);
    put_on_ground(d, body, 0.006 * kg_random_uniform(&random), q);
    memset(v, 0, sizeof v);
    kg_step_report report;
    kg_step_residual(s, G, NULL, v, q, v, NULL, 0.01, &report);
    assert_contacts_are_true(&def, d, q, &report);
    contacts += report.contact_count;
  }
  assert_true(contacts >= 200);
  kg_step_destroy(s);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* Sum of contact forces and moments of a report against the law and the point velocities. */
static void assert_forces_follow_the_law(const kg_step_def *def, kg_dynamics *d, const double *q,
                                         const double *v, const kg_step_report *report)
{
  for (int c = 0; c < report->contact_count; c++) {
    const kg_step_contact *contact = &report->contacts[c];
    double J[3 * MAX_NV], u[3] = {0.0};
    const int nv = def->body->nv;
    (void)kg_dynamics_point(d, J, q, def->body->points[contact->point]);
    for (int k = 0; k < 3 * nv; k++) {
      u[k / nv] += J[k] * v[k % nv];
    }
    kg_contact_force f;
    assert_true(kg_contact_evaluate(&def->contact, def->scene, contact->x,
                                    kg_vec3_make(u[0], u[1], u[2]), false, &f));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(f.f, contact->force.f)),
                   1e-6 * (1.0 + kg_vec3_norm(f.f)));
  }
}

/* Without sub-steps the hardest step fails and says so, with a consistent point; with them it is
 * the same as taking the sub-steps one by one. */
static void failure_is_reported_and_divided(void **state)
{
  (void)state;
  kg_random random = kg_random_make(34);
  kg_body *body = human_body();
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *divided = step_of(&def);
  def.max_substep_levels = 0;
  kg_step *whole = step_of(&def), *fresh = step_of(&def);
  int failures = 0, solved = 0;
  for (int trial = 0; trial < 20; trial++) {
    double q[MAX_NQ], v[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV], q_one[MAX_NQ], v_one[MAX_NV];
    double move[MAX_NV], G[MAX_NV];
    contact_state(&random, d, body, 1, q, v);
    kg_step_report a, b, c;
    kg_step_advance(whole, q_next, v_next, q, v, NULL, 0.04, false, &a);
    assert_int_equal(a.substeps, 1);
    assert_true(a.converged == (a.residual <= def.tolerance));
    for (int k = 0; k < body->nv; k++) {
      assert_true(isfinite(v_next[k]));
      move[k] = 0.04 * v_next[k];
    }
    kg_body_integrate(body, q_one, q, move);
    assert_memory_equal(q_one, q_next, (size_t)body->nq * sizeof *q);
    assert_contacts_are_true(&def, d, q_next, &a);
    assert_forces_follow_the_law(&def, d, q_next, v_next, &a);
    kg_step_residual(fresh, G, NULL, v_next, q, v, NULL, 0.04, &c);
    if (a.converged) {
      assert_at_most(c.residual, def.tolerance);
    }
    kg_step_advance(divided, q_next, v_next, q, v, NULL, 0.04, false, &b);
    assert_true(b.converged == (b.residual <= def.tolerance));
    assert_true((b.substeps > 1) == !a.converged);
    assert_forces_follow_the_law(&def, d, q_next, v_next, &b);
    memcpy(q_one, q, sizeof q_one);
    memcpy(v_one, v, sizeof v_one);
    for (int k = 0; k < b.substeps && b.converged; k++) {
      kg_step_advance(fresh, q_one, v_one, q_one, v_one, NULL, 0.04 / b.substeps, false, &c);
      assert_true(c.converged);
    }
    if (b.converged) {
      assert_memory_equal(q_one, q_next, (size_t)body->nq * sizeof *q);
      assert_memory_equal(v_one, v_next, (size_t)body->nv * sizeof *v);
    }
    failures += !a.converged;
    solved += b.converged;
  }
  assert_true(failures > 0);
  print_message("0.04 s landings: %d of 20 fail whole, %d of 20 solved with sub-steps\n", failures,
                solved);
  assert_true(solved >= 18);
  kg_step_destroy(fresh);
  kg_step_destroy(whole);
  kg_step_destroy(divided);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* 10 rad/s^2 on every joint, or a guess far off: no reason to divide a step in the air */
static void strong_torques_in_the_air_need_no_substeps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(5);
  kg_body *body = human_body();
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_step_def def = kg_step_default_def(body);
  kg_step *s = step_of(&def);
  static double M[MAX_NV * MAX_NV];
  for (int trial = 0; trial < 60; trial++) {
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV] = {0.0}, q_next[MAX_NQ], v_next[MAX_NV], again[MAX_NV];
    human_state(&random, body, 0, q, v);
    kg_dynamics_mass_matrix(d, M, q);
    for (int k = 0; k < body->nv; k++) {
      v[k] *= 0.15;
      tau[k] = k < 6 ? 0.0 : 10.0 * M[k * body->nv + k] * kg_random_normal(&random);
      again[k] = 1e6 * kg_random_normal(&random);
    }
    kg_step_report report;
    kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, false, &report);
    assert_true(report.converged);
    assert_int_equal(report.substeps, 1);
    kg_step_advance(s, q_next, again, q, v, tau, 0.01, true, &report);
    assert_true(report.converged);
    assert_int_equal(report.substeps, 1);
    for (int k = 0; k < body->nv; k++) {
      assert_close(again[k], v_next[k], 1e-5);
    }
  }
  kg_step_destroy(s);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* whatever number of the call is none: said, and no pose that looks like an answer */
static void numbers_that_are_none_do_not_converge(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  const double none[] = {NAN, INFINITY, -INFINITY, 1e300};
  for (int trial = 0; trial < 15; trial++) { /* a place of 1e300 m is a number */
    double q[MAX_NQ], v[MAX_NV] = {0.0}, tau[MAX_NV] = {0.0}, q_next[MAX_NQ], v_next[MAX_NV];
    rest_state(body, trial % 2 ? 2.0 : human_root_height + 0.003, q);
    double *const arrays[] = {q + 4, v + 7, tau + 8, q + 1};
    *arrays[trial / 4] = none[trial % 4];
    kg_step_report report;
    kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, false, &report);
    assert_false(report.converged);
  }
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* What a guess led to is not where the second attempt starts: from v it has the bits of a step without
 * a guess. The guess cannot come right: an iteration turns a joint by 0.4 rad at most, 40 rad/s. */
static void a_hopeless_guess_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_random random = kg_random_make(38);
  kg_body *body = human_body();
  kg_dynamics *d = dynamics_of(body);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.max_iterations = 12;
  def.max_substep_levels = 0;
  kg_step *plain = step_of(&def), *guessing = step_of(&def);
  int solved = 0;
  for (int trial = 0; trial < 20; trial++) {
    double q[MAX_NQ], v[MAX_NV], q_plain[MAX_NQ], v_plain[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV];
    contact_state(&random, d, body, trial % 5, q, v);
    kg_step_report a, b;
    kg_step_advance(plain, q_plain, v_plain, q, v, NULL, 0.01, false, &a);
    memcpy(v_next, v, sizeof v_next);
    v_next[3 + 3 * 9] += 1000.0; /* an elbow */
    kg_step_advance(guessing, q_next, v_next, q, v, NULL, 0.01, true, &b);
    if (!a.converged) continue;
    assert_true(b.converged && b.iterations > a.iterations);
    assert_memory_equal(q_plain, q_next, (size_t)body->nq * sizeof *q);
    assert_memory_equal(v_plain, v_next, (size_t)body->nv * sizeof *v);
    solved++;
  }
  assert_true(solved > 10);
  kg_step_destroy(plain);
  kg_step_destroy(guessing);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* points of the body may move: none is missed because of where they were */
static void contact_follows_the_points_of_the_body(void **state)
{
  (void)state;
  kg_body *body = box_body(10.0, kg_vec3_make(0.1, 0.1, 0.1));
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[MAX_NQ], v[MAX_NV] = {0.0}, G[MAX_NV];
  rest_state(body, 0.203, q);
  kg_step_report report;
  kg_step_residual(s, G, NULL, v, q, v, NULL, 0.01, &report);
  assert_int_equal(report.contact_count, 0);
  for (int k = 0; k < body->point_count; k++) {
    body->points[k].p.y *= 2.0;
  }
  kg_step_refresh(s);
  kg_step_residual(s, G, NULL, v, q, v, NULL, 0.01, &report);
  assert_int_equal(report.contact_count, 4);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

static void same_input_gives_the_same_bits(void **state)
{
  (void)state;
  kg_random random = kg_random_make(35);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *a = step_of(&def), *b = step_of(&def);
  for (int kind = 0; kind < 4; kind++) {
    double q[MAX_NQ], v[MAX_NV], q1[MAX_NQ], v1[MAX_NV], q2[MAX_NQ], v2[MAX_NV], other[MAX_NV];
    human_state(&random, body, kind, q, v);
    kg_step_advance(a, q1, v1, q, v, NULL, 0.01, false, NULL);
    for (int k = 0; k < body->nv; k++) { /* leave something else in the work memory of b */
      other[k] = v[k] + 1.0;
    }
    kg_step_advance(b, q2, v2, q, other, NULL, 0.002, false, NULL);
    kg_step_advance(b, q2, v2, q, v, NULL, 0.01, false, NULL);
    assert_memory_equal(q1, q2, (size_t)body->nq * sizeof *q1);
    assert_memory_equal(v1, v2, (size_t)body->nv * sizeof *v1);
    /* in place, and from the answer as the guess */
    kg_step_report report;
    kg_step_advance(b, q2, v2, q, v, NULL, 0.01, true, &report);
    assert_int_equal(report.iterations, 0);
    kg_step_advance(b, q, v, q, v, NULL, 0.01, false, NULL);
    assert_memory_equal(q1, q, (size_t)body->nq * sizeof *q1);
    assert_memory_equal(v1, v, (size_t)body->nv * sizeof *v1);
  }
  kg_step_destroy(a);
  kg_step_destroy(b);
  kg_body_destroy(body);
}

/* ---- memory -----------------------------------------------------------------------------------*/

static void survives_every_allocation_failure_and_then_allocates_nothing(void **state)
{
  (void)state;
  kg_random random = kg_random_make(37);
  kg_body *body = human_body();
  kg_scene scene = ground();
  bool done = false;
  int refused = 0;
  for (; !done; refused++) {
    failing_heap heap = {.calls_left = refused};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_step_def def = kg_step_default_def(body);
    def.scene = &scene;
    def.allocator = &allocator;
    kg_step *s = (kg_step *)(void *)&heap;
    const kg_status status = kg_step_create(&s, &def);
    done = status == KG_OK;
    assert_true(done || (status == KG_ERR_NO_MEMORY && s == NULL));
    if (done) {
      double q[MAX_NQ], v[MAX_NV], q2[MAX_NQ], v2[MAX_NV];
      static double J[MAX_NV * MAX_NV];
      const size_t bytes = heap.live_bytes;
      heap.calls_left = 0;
      for (int kind = 0; kind < 4; kind++) {
        human_state(&random, body, kind, q, v);
        kg_step_advance(s, q2, v2, q, v, NULL, 0.03, false, NULL);
        kg_step_residual(s, v2, J, v, q, v, NULL, 0.01, NULL);
      }
      assert_int_equal(heap.calls_left, 0); /* not even asked */
      assert_int_equal(heap.live_bytes, bytes);
    }
    kg_step_destroy(s);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(refused > 4);
  kg_step_destroy(NULL);
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
    cmocka_unit_test(differences_of_four_widths_approach_the_jacobian),
    cmocka_unit_test(step_agrees_with_ceres_and_lapack),
    cmocka_unit_test(newton_converges_on_random_contact_states),
    cmocka_unit_test(contact_list_matches_brute_force),
    cmocka_unit_test(failure_is_reported_and_divided),
    cmocka_unit_test(strong_torques_in_the_air_need_no_substeps),
    cmocka_unit_test(numbers_that_are_none_do_not_converge),
    cmocka_unit_test(a_hopeless_guess_leaves_nothing_behind),
    cmocka_unit_test(contact_follows_the_points_of_the_body),
    cmocka_unit_test(same_input_gives_the_same_bits),
    cmocka_unit_test(survives_every_allocation_failure_and_then_allocates_nothing),
    cmocka_unit_test(timings),
  };
  return cmocka_run_group_tests_name("step", tests, NULL, NULL);
}
