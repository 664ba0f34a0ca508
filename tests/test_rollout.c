/* Runs of steps: the gradient against differences of the run, with all states and with checkpoints
 * bit for bit the same; memory; what backward costs beside forward. */
#include "fixture_body.h"

#include "kinegrad/rollout.h"

#include <stdio.h>
#include <time.h>

enum { STEPS = 500 };

typedef struct fixture {
  kg_body *body;
  kg_scene scene;
  kg_step *step;
  double q[MAX_NQ], v[MAX_NV];
  double *tau;
} fixture;

/* The human standing or in the air, held up by small random torques and joint damping. */
static fixture *fixture_of(uint64_t seed, bool standing, double tolerance)
{
  fixture *f = calloc(1, sizeof *f);
  assert_non_null(f);
  kg_random random = kg_random_make(seed);
  f->body = human_body();
  f->scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_step_def def = kg_step_default_def(f->body);
  def.scene = &f->scene;
  def.joint_damping = 5.0;
  def.tolerance = tolerance;
  assert_int_equal(kg_step_create(&f->step, &def), KG_OK);
  rest_state(f->body, standing ? human_root_height + 0.003 : 200.0, f->q);
  f->tau = calloc((size_t)(STEPS * f->body->nv), sizeof(double));
  assert_non_null(f->tau);
  for (int k = 0; k < STEPS * f->body->nv; k++) {
    f->tau[k] = k % f->body->nv < 6 ? 0.0 : 0.5 * kg_random_normal(&random);
  }
  for (int k = 0; k < f->body->nv && !standing; k++) {
    f->v[k] = 0.5 * kg_random_normal(&random);
  }
  return f;
}

static void release(fixture *f)
{
  kg_step_destroy(f->step);
  kg_body_destroy(f->body);
  free(f->tau);
  free(f);
}

static kg_rollout *rollout_of(const fixture *f, bool checkpoints, const kg_allocator *allocator)
{
  const kg_rollout_def def = {.step = f->step,
                              .max_steps = STEPS,
                              .dt = 1.0 / 120.0,
                              .checkpoints = checkpoints,
                              .allocator = allocator};
  kg_rollout *r = NULL;
  assert_int_equal(kg_rollout_create(&r, &def), KG_OK);
  return r;
}

/* l_t = w . v_t + w_root . x_t, a different w at every t: running and terminal costs */
typedef struct cost {
  int nv;
  double *w;
} cost;

static void add_cost(void *user, int t, const double *q, const double *v, double *q_bar,
                     double *v_bar)
{
  const cost *c = user;
  (void)q, (void)v;
  for (int k = 0; k < c->nv; k++) {
    v_bar[k] += c->w[t * c->nv + k];
    q_bar[k] += k < 3 ? c->w[t * c->nv + k] : 0.0;
  }
}

static cost cost_of(const kg_body *body)
{
  kg_random random = kg_random_make(99);
  cost c = {body->nv, calloc((size_t)((STEPS + 1) * body->nv), sizeof(double))};
  assert_non_null(c.w);
  for (int k = 0; k < (STEPS + 1) * body->nv; k++) {
    c.w[k] = kg_random_normal(&random);
  }
  return c;
}

static double cost_value(const cost *c, const fixture *f, int steps, const double *q,
                         const double *v)
{
  double sum = 0.0;
  for (int t = 0; t <= steps; t++) {
    for (int k = 0; k < c->nv; k++) {
      sum += c->w[t * c->nv + k] * v[t * c->nv + k];
      sum += k < 3 ? c->w[t * c->nv + k] * q[t * f->body->nq + k] : 0.0;
    }
  }
  return sum;
}

/* ---- against differences ----------------------------------------------------------------------*/

static double moved_value(fixture *f, kg_rollout *r, const cost *c, int steps, double s,
                          const double *d)
{
  static double q_out[(STEPS + 1) * MAX_NQ], v_out[(STEPS + 1) * MAX_NV];
  const int nv = f->body->nv;
  double q[MAX_NQ], v[MAX_NV], turn[MAX_NV];
  double *tau = malloc((size_t)(steps * nv) * sizeof *tau);
  assert_non_null(tau);
  for (int k = 0; k < nv; k++) {
    turn[k] = s * d[k];
    v[k] = f->v[k] + s * d[nv + k];
  }
  for (int k = 0; k < steps * nv; k++) {
    tau[k] = f->tau[k] + s * d[(2 + k / nv % 3) * nv + k % nv];
  }
  kg_body_integrate(f->body, q, f->q, turn);
  assert_int_equal(kg_rollout_run(r, steps, q, v, tau, q_out, v_out, NULL), KG_OK);
  free(tau);
  return cost_value(c, f, steps, q_out, v_out);
}

static void gradient_equals_differences(void **state)
{
  (void)state;
  for (int standing = 0; standing < 2; standing++) {
    fixture *f = fixture_of(31, standing, standing ? 1e-11 : 1e-12);
    const int steps = standing ? 10 : 40, nv = f->body->nv;
    kg_rollout *r = rollout_of(f, true, NULL);
    cost c = cost_of(f->body);
    kg_random random = kg_random_make(32);
    double d[5 * MAX_NV], q_bar[MAX_NV] = {0.0}, v_bar[MAX_NV] = {0.0};
    double *tau_bar = calloc((size_t)(steps * nv), sizeof(double));
    assert_non_null(tau_bar);
    for (int k = 0; k < 5 * nv; k++) {
      d[k] = (k < 2 * nv && standing ? 1e-5 : 0.1) * kg_random_normal(&random);
    }
    kg_rollout_report report;
    assert_int_equal(kg_rollout_run(r, steps, f->q, f->v, f->tau, NULL, NULL, &report), KG_OK);
    assert_int_equal(report.steps, steps);
    const kg_rollout_gradient g = {.q = q_bar, .v = v_bar, .tau = tau_bar};
    assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
    double want = 0.0, slope[3];
    for (int k = 0; k < nv; k++) {
      want += q_bar[k] * d[k] + v_bar[k] * d[nv + k];
    }
    for (int k = 0; k < steps * nv; k++) {
      want += tau_bar[k] * d[(2 + k / nv % 3) * nv + k % nv];
    }
    for (int level = 0; level < 3; level++) {
      const double h = (standing ? 2e-2 : 4e-2) / (1 << level);
      slope[level] =
        (moved_value(f, r, &c, steps, h, d) - moved_value(f, r, &c, steps, -h, d)) / (2.0 * h);
    }
    for (int level = 1; level < 3; level++) {
      for (int k = 2; k >= level; k--) {
        slope[k] += (slope[k] - slope[k - 1]) / (pow(4.0, level) - 1.0);
      }
    }
    print_message("%s, %d steps: along a direction %.12g, by differences %.12g\n",
                  standing ? "standing" : "flight", steps, want, slope[2]);
    assert_close(want, slope[2], 1e-7);
    free(tau_bar);
    free(c.w);
    kg_rollout_destroy(r);
    release(f);
  }
}

/* ---- memory -----------------------------------------------------------------------------------*/

typedef struct everything {
  double q[MAX_NV], v[MAX_NV], tau[STEPS * MAX_NV];
  double contact[6], joint_damping, mass[MAX_NV], com[MAX_NV], inertia[2 * MAX_NV], offset[MAX_NV];
} everything;

static void add_gradient(kg_rollout *r, everything *e, cost *c)
{
  const kg_rollout_gradient g = {
    .q = e->q,
    .v = e->v,
    .tau = e->tau,
    .contact = e->contact,
    .joint_damping = &e->joint_damping,
    .body = {.mass = e->mass, .com = e->com, .inertia = e->inertia, .offset = e->offset}};
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, c), KG_OK);
}

static void gradient_into(kg_rollout *r, everything *e, cost *c)
{
  memset(e, 0, sizeof *e);
  add_gradient(r, e, c);
}

static void checkpoints_change_no_bit(void **state)
{
  (void)state;
  static everything all, few, again;
  const int counts[3] = {1, 23, 150}; /* inside one segment, at an end, across several */
  for (int trial = 0; trial < 6; trial++) {
    const int steps = counts[trial / 2];
    fixture *f = fixture_of(33, trial % 2, 1e-8);
    cost c = cost_of(f->body);
    failing_heap heap[2] = {{.calls_left = 100}, {.calls_left = 100}};
    const kg_allocator allocators[2] = {{failing_alloc, failing_free, &heap[0]},
                                        {failing_alloc, failing_free, &heap[1]}};
    kg_rollout *r[2] = {rollout_of(f, false, &allocators[0]), rollout_of(f, true, &allocators[1])};
    const int calls[2] = {heap[0].calls_left, heap[1].calls_left};
    kg_rollout_report report;
    for (int k = 0; k < 2; k++) {
      assert_int_equal(kg_rollout_run(r[k], steps, f->q, f->v, f->tau, NULL, NULL, &report), KG_OK);
      gradient_into(r[k], k == 0 ? &all : &few, &c);
    }
    gradient_into(r[1], &again, &c);
    assert_memory_equal(&all, &few, sizeof all);
    assert_memory_equal(&all, &again, sizeof all);
    assert_true(all.tau[10] != 0.0 && all.mass[3] != 0.0 && all.inertia[7] != 0.0);
    assert_true((all.contact[1] != 0.0) == (trial % 2 == 1));
    for (int k = 0; k < 2; k++) {
      assert_int_equal(heap[k].calls_left,
                       calls[k]); /* the run and the gradient allocate nothing */
    }
    if (trial == 0) {
      print_message("memory for %d steps: %zu bytes, with checkpoints %zu\n", STEPS,
                    heap[0].live_bytes, heap[1].live_bytes);
      assert_true(heap[1].live_bytes * 8 < heap[0].live_bytes);
    }
    for (int k = 0; k < 2; k++) {
      kg_rollout_destroy(r[k]);
      assert_int_equal(heap[k].live_bytes, 0);
    }
    free(c.w);
    release(f);
  }
}

static void arrays_are_a_cotangent(void **state)
{
  (void)state;
  fixture *f = fixture_of(34, false, 1e-8);
  const int steps = 6, nv = f->body->nv;
  cost c = cost_of(f->body);
  double *q_bar = calloc((size_t)((steps + 1) * nv), sizeof(double));
  assert_non_null(q_bar);
  for (int k = 0; k < (steps + 1) * nv; k++) {
    q_bar[k] = k % nv < 3 ? c.w[k] : 0.0;
  }
  kg_rollout_arrays arrays = {nv, q_bar, c.w};
  kg_rollout *r = rollout_of(f, true, NULL);
  double one[6 * MAX_NV] = {0.0}, other[6 * MAX_NV] = {0.0};
  assert_int_equal(kg_rollout_run(r, steps, f->q, f->v, f->tau, NULL, NULL, NULL), KG_OK);
  const kg_rollout_gradient g = {.tau = one}, h = {.tau = other};
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
  assert_int_equal(kg_rollout_vjp(r, &h, kg_rollout_add_arrays, &arrays), KG_OK);
  assert_memory_equal(one, other, sizeof one);
  free(q_bar);
  free(c.w);
  kg_rollout_destroy(r);
  release(f);
}

/* Steps that have to be divided, one by one: the same report, the same gradient. */
static void a_run_is_its_steps(void **state)
{
  (void)state;
  enum { COUNT = 3 };
  fixture *f = fixture_of(37, false, 1e-8);
  const int nv = f->body->nv, nq = f->body->nq;
  kg_step_def def = kg_step_default_def(f->body);
  def.max_iterations = 2;
  kg_step_destroy(f->step);
  assert_int_equal(kg_step_create(&f->step, &def), KG_OK);
  const kg_rollout_def long_steps = {.step = f->step, .max_steps = COUNT, .dt = 0.04};
  kg_rollout *r = NULL;
  assert_int_equal(kg_rollout_create(&r, &long_steps), KG_OK);
  for (int k = 0; k < nv; k++) {
    f->v[k] *= 8.0;
  }
  kg_rollout_report sum = {0}, report;
  double q[(COUNT + 1) * MAX_NQ], v[(COUNT + 1) * MAX_NV], q_out[(COUNT + 1) * MAX_NQ];
  double q_bar[(COUNT + 1) * MAX_NV] = {0.0}, v_bar[(COUNT + 1) * MAX_NV] = {0.0};
  double tau[COUNT * MAX_NV] = {0.0}, got[COUNT * MAX_NV] = {0.0};
  int substeps[COUNT];
  cost c = cost_of(f->body);
  memcpy(q, f->q, (size_t)nq * sizeof *q);
  memcpy(v, f->v, (size_t)nv * sizeof *v);
  for (int t = 0; t < COUNT; t++) {
    kg_step_report one;
    kg_step_advance(f->step, q + (t + 1) * nq, v + (t + 1) * nv, q + t * nq, v + t * nv,
                    f->tau + t * nv, long_steps.dt, false, &one);
    substeps[t] = one.substeps;
    sum.steps++;
    sum.substepped += one.substeps > 1;
    sum.iterations += one.iterations;
    sum.residual = fmax(sum.residual, one.residual);
  }
  assert_true(sum.substepped > 0);
  for (int t = COUNT; t >= 0; t--) {
    add_cost(&c, t, NULL, NULL, q_bar + t * nv, v_bar + t * nv);
    if (t == 0) break;
    const kg_step_gradient g = {
      .q = q_bar + (t - 1) * nv, .v = v_bar + (t - 1) * nv, .tau = tau + (t - 1) * nv};
    assert_int_equal(kg_step_vjp(f->step, &g, q + (t - 1) * nq, v + (t - 1) * nv,
                                 f->tau + (t - 1) * nv, long_steps.dt, v + t * nv, substeps[t - 1],
                                 q_bar + t * nv, v_bar + t * nv),
                     KG_OK);
  }
  assert_int_equal(kg_rollout_run(r, COUNT, f->q, f->v, f->tau, q_out, NULL, &report), KG_OK);
  assert_int_equal(report.steps, sum.steps);
  assert_int_equal(report.substepped, sum.substepped);
  assert_int_equal(report.iterations, sum.iterations);
  assert_true(report.residual == sum.residual);
  assert_memory_equal(q, q_out, (size_t)((COUNT + 1) * nq) * sizeof *q);
  const kg_rollout_gradient g = {.tau = got};
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
  for (int k = 0; k < COUNT * nv; k++) {
    assert_close(got[k], tau[k], 1e-12);
  }
  free(c.w);
  kg_rollout_destroy(r);
  release(f);
}

/* ---- refusals ---------------------------------------------------------------------------------*/

static void a_run_that_failed_has_no_gradient(void **state)
{
  (void)state;
  fixture *f = fixture_of(35, false, 1e-8);
  kg_rollout *r = rollout_of(f, false, NULL);
  cost c = cost_of(f->body);
  double tau_bar[4 * MAX_NV];
  const kg_rollout_gradient g = {.tau = tau_bar};
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED); /* no run yet */
  f->tau[2 * f->body->nv + 8] = NAN;
  kg_rollout_report report;
  assert_int_equal(kg_rollout_run(r, 4, f->q, f->v, f->tau, NULL, NULL, &report), KG_ERR_UNDEFINED);
  assert_int_equal(report.steps, 2);
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  free(c.w);
  kg_rollout_destroy(r);
  release(f);
}

/* Results are added, of every kind, with all states and with checkpoints. */
static void results_are_added(void **state)
{
  (void)state;
  static everything once, twice;
  for (int checkpoints = 0; checkpoints < 2; checkpoints++) {
    fixture *f = fixture_of(38, true, 1e-8);
    kg_rollout *r = rollout_of(f, checkpoints, NULL);
    cost c = cost_of(f->body);
    assert_int_equal(kg_rollout_run(r, 30, f->q, f->v, f->tau, NULL, NULL, NULL), KG_OK);
    gradient_into(r, &once, &c);
    gradient_into(r, &twice, &c);
    add_gradient(r, &twice, &c);
    const double *a = (const double *)&once, *b = (const double *)&twice;
    double size = 0.0;
    for (size_t k = 0; k < sizeof once / sizeof *a; k++) {
      assert_at_most(fabs(b[k] - 2.0 * a[k]), 1e-9 * fabs(a[k]) + 1e-12 * size);
      size = fmax(size, fabs(a[k]));
    }
    assert_true(once.q[1] != 0.0 && once.v[1] != 0.0 && once.joint_damping != 0.0);
    assert_true(once.com[4] != 0.0 && once.offset[4] != 0.0 && once.contact[1] != 0.0);
    free(c.w);
    kg_rollout_destroy(r);
    release(f);
  }
}

/* What is run again must end where it ended, so changed forces are seen; numbers of steps that are
 * none are refused and leave the run before as it is. */
static void what_is_not_the_run_is_refused(void **state)
{
  (void)state;
  fixture *f = fixture_of(39, false, 1e-8);
  kg_rollout *r = rollout_of(f, true, NULL);
  cost c = cost_of(f->body);
  static double tau_bar[60 * MAX_NV];
  const kg_rollout_gradient g = {.tau = tau_bar};
  const int counts[3] = {0, -1, STEPS + 1};
  for (int k = 0; k < 3; k++) {
    assert_int_equal(kg_rollout_run(r, counts[k], f->q, f->v, f->tau, NULL, NULL, NULL),
                     KG_ERR_SHAPE);
    assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  }
  assert_int_equal(kg_rollout_run(r, 60, f->q, f->v, f->tau, NULL, NULL, NULL), KG_OK);
  assert_int_equal(kg_rollout_run(r, 0, f->q, f->v, f->tau, NULL, NULL, NULL), KG_ERR_SHAPE);
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
  double *late = &f->tau[58 * f->body->nv + 8], was = *late; /* in the last segment */
  *late += 1e-3;
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  *late = was;
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
  f->tau[5 * f->body->nv + 8] += 1e-3;
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  f->tau[5 * f->body->nv + 8] = NAN;
  assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_ERR_UNDEFINED);
  free(c.w);
  kg_rollout_destroy(r);
  release(f);
}

/* ---- time -------------------------------------------------------------------------------------*/

static double seconds(void)
{
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Printed, not asserted: the machine is shared. `kinegrad bench step` measures it beside others. */
static void backward_beside_forward(void **state)
{
  (void)state;
  static everything e;
  for (int k = 0; k < 4; k++) {
    const bool standing = k % 2, checkpoints = k / 2;
    fixture *f = fixture_of(36, standing, 1e-8);
    kg_rollout *r = rollout_of(f, checkpoints, NULL);
    cost c = cost_of(f->body);
    kg_rollout_report report;
    const double start = seconds();
    const int steps = standing ? 100 : STEPS;
    assert_int_equal(kg_rollout_run(r, steps, f->q, f->v, f->tau, NULL, NULL, &report), KG_OK);
    const double middle = seconds();
    const kg_rollout_gradient g = {.tau = e.tau};
    assert_int_equal(kg_rollout_vjp(r, &g, add_cost, &c), KG_OK);
    const double end = seconds();
    print_message("%d steps, %s, %s: %.1f us a step forward (%.1f iterations), %.1f backward, "
                  "ratio %.2f\n",
                  steps, standing ? "standing" : "flight",
                  checkpoints ? "checkpoints" : "all states", 1e6 * (middle - start) / steps,
                  (double)report.iterations / steps, 1e6 * (end - middle) / steps,
                  (end - middle) / (middle - start));
    free(c.w);
    kg_rollout_destroy(r);
    release(f);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(gradient_equals_differences),
    cmocka_unit_test(checkpoints_change_no_bit),
    cmocka_unit_test(arrays_are_a_cotangent),
    cmocka_unit_test(a_run_is_its_steps),
    cmocka_unit_test(a_run_that_failed_has_no_gradient),
    cmocka_unit_test(results_are_added),
    cmocka_unit_test(what_is_not_the_run_is_refused),
    cmocka_unit_test(backward_beside_forward),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
