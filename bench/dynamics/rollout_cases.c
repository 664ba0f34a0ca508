/* A run of 500 steps of 1/120 s, and the gradient of its end with respect to all torques.
 *
 * The body has springs and dampers in its joints and is pushed by torques that change every step.
 * From its feet it sways, gives way and comes to lie; in flight it falls all the time. Times are
 * those of a step: kg_rollout_run, and kg_rollout_vjp after a run, with all states kept or with
 * checkpoints.
 *
 * Compared: the gradient along three series of torques, with tangents carried forward by the full
 * derivatives of every step. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/dynamics/cases.h"
#include "bench/dynamics/scenes.h"
#include "kinegrad/rollout.h"

enum { STEPS = 500, DIRECTIONS = 3 };
static const double STIFFNESS = 300.0; /* N m/rad, towards the pose the skeleton was drawn in */
static const double DAMPING = 10.0;    /* N m s/rad, beside that of the scene                 */

typedef struct rollout {
  kg_bench_scene scene;
  kg_joint_passive *passive;
  int nq, nv;
  double *q, *v; /* (STEPS + 1, nq), (STEPS + 1, nv): the run   */
  double *tau;   /* (STEPS, nv)                                 */
  int substeps[STEPS];
  double *q_bar, *v_bar; /* weights of the end */
  double *direction;     /* (DIRECTIONS, STEPS, nv) */
  int contacts, iterations, divided, failed;
} rollout;

static void close(kg_bench_problem *problem)
{
  rollout *r = problem->data;
  kg_bench_scene_close(&r->scene);
  free(r->passive);
  free(r->q);
  free(r);
}

static kg_step_def step_def(const rollout *r, const kg_allocator *allocator)
{
  kg_step_def def = kg_bench_scene_step_def(&r->scene, allocator);
  def.passive = r->passive;
  return def;
}

static double *row(double *x, int n, int width)
{
  return x + (size_t)n * (size_t)width;
}

/* The whole run; the states go to r. */
static void roll(rollout *r, kg_step *step)
{
  for (int n = 0; n < STEPS; n++) {
    kg_step_report report;
    kg_step_advance(step, row(r->q, n + 1, r->nq), row(r->v, n + 1, r->nv), row(r->q, n, r->nq),
                    row(r->v, n, r->nv), row(r->tau, n, r->nv), r->scene.dt, false, &report);
    r->substeps[n] = report.substeps;
    r->contacts += report.contact_count;
    r->iterations += report.iterations;
    r->divided += report.substeps > 1;
    r->failed += !report.converged;
  }
}

static kg_status allocate(rollout *r)
{
  const kg_body *body = r->scene.model.body;
  const size_t nq = (size_t)body->nq, nv = (size_t)body->nv;
  r->nq = body->nq;
  r->nv = body->nv;
  r->passive = calloc((size_t)body->segment_count, sizeof *r->passive);
  r->q = calloc((STEPS + 1) * (nq + nv) + (1 + DIRECTIONS) * STEPS * nv + 2 * nv, sizeof *r->q);
  if (!r->passive || !r->q) {
    return KG_ERR_NO_MEMORY;
  }
  r->v = r->q + (STEPS + 1) * nq;
  r->tau = r->v + (STEPS + 1) * nv;
  r->q_bar = r->tau + STEPS * nv;
  r->v_bar = r->q_bar + nv;
  r->direction = r->v_bar + nv;
  return KG_OK;
}

static void fill(rollout *r)
{
  const int nv = r->nv;
  kg_random random = kg_random_make(500);
  for (int i = 0; i < r->scene.model.body->segment_count; i++) {
    r->passive[i] = (kg_joint_passive){.stiffness = STIFFNESS,
                                       .damping = DAMPING,
                                       .rest = kg_quat_identity(),
                                       .limit_low = {-INFINITY, -INFINITY, -INFINITY},
                                       .limit_high = {INFINITY, INFINITY, INFINITY}};
  }
  memcpy(r->q, r->scene.q, (size_t)r->nq * sizeof *r->q);
  r->q[1] += r->scene.situation == KG_BENCH_FLIGHT ? 200.0 : 0.0; /* it falls 86 m */
  memcpy(r->v, r->scene.v, (size_t)nv * sizeof *r->v);
  for (int k = 0; k < nv; k++) {
    r->q_bar[k] = kg_random_normal(&random);
    r->v_bar[k] = kg_random_normal(&random);
  }
  for (int k = 0; k < DIRECTIONS * STEPS * nv; k++) {
    r->direction[k] = k % nv < 6 ? 0.0 : kg_random_normal(&random);
  }
  for (int n = 0; n < STEPS; n++) { /* the scene's noise, again and again */
    const double *noise = r->scene.tau + n % KG_BENCH_STEPS * nv, *held = r->scene.tau;
    for (int k = 0; k < nv; k++) {
      r->tau[n * nv + k] = n % KG_BENCH_STEPS == 0 ? 0.0 : noise[k] - held[k];
    }
  }
}

static kg_status run_once(rollout *r)
{
  const kg_step_def def = step_def(r, NULL);
  kg_step *step = NULL;
  const kg_status status = kg_step_create(&step, &def);
  if (status == KG_OK) {
    roll(r, step);
    kg_step_destroy(step);
  }
  return status;
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  rollout *r = calloc(1, sizeof *r);
  if (!r) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status =
    kg_bench_scene_open(&r->scene, *(const kg_bench_situation *)detail, setting, error);
  if (status != KG_OK) {
    free(r);
    return status;
  }
  problem->data = r;
  problem->items = STEPS;
  problem->parts[0] = (kg_bench_part){"gradient along a direction", DIRECTIONS, 1};
  problem->part_count = 1;
  status = allocate(r);
  if (status == KG_OK) {
    fill(r);
    status = run_once(r);
  }
  if (status != KG_OK) {
    close(problem);
    return status;
  }
  snprintf(problem->source, sizeof problem->source,
           "%.150s; a step: %.1f iterations, %.1f contacts, %d not converged, %d divided",
           r->scene.model.source, (double)r->iterations / STEPS, (double)r->contacts / STEPS,
           r->failed, r->divided);
  return KG_OK;
}

/* ---- reference ------------------------------------------------------------------------------- */

/* y += A x */
static void add_product(double *y, const double *A, const double *x, int n)
{
  for (int r = 0; r < n; r++) {
    for (int c = 0; c < n; c++) {
      y[r] += A[r * n + c] * x[c];
    }
  }
}

/* Tangents (dq, dv) of all directions, one step on. J: six matrices in a row. */
static void carry(const rollout *r, const double *J, double *tangents, int n, double *work)
{
  const size_t nv = (size_t)r->nv, square = nv * nv;
  for (int i = 0; i < DIRECTIONS; i++) {
    double *dq = tangents + 2 * (size_t)i * nv, *dv = dq + nv;
    const double *dtau = r->direction + ((size_t)i * STEPS + (size_t)n) * nv;
    const double *in[3] = {dq, dv, dtau};
    memset(work, 0, 2 * nv * sizeof *work);
    for (size_t part = 0; part < 3; part++) {
      add_product(work, J + (3 + part) * square, in[part], r->nv);
      add_product(work + nv, J + part * square, in[part], r->nv);
    }
    memcpy(dq, work, 2 * nv * sizeof *dq);
  }
}

static kg_status reference(const void *data, double *answer)
{
  rollout *r = (rollout *)data;
  const size_t nv = (size_t)r->nv, square = nv * nv;
  const kg_step_def def = step_def(r, NULL);
  kg_step *step = NULL;
  double *J = calloc(6 * square + 2 * (DIRECTIONS + 1) * nv, sizeof *J);
  kg_status status = J ? kg_step_create(&step, &def) : KG_ERR_NO_MEMORY;
  double *tangents = J + 6 * square, *work = tangents + 2 * DIRECTIONS * nv;
  const kg_step_jacobian jacobian = {
    J, J + square, J + 2 * square, J + 3 * square, J + 4 * square, J + 5 * square};
  for (int n = 0; n < STEPS && status == KG_OK; n++) {
    status = kg_step_derivatives(step, &jacobian, row(r->q, n, r->nq), row(r->v, n, r->nv),
                                 row(r->tau, n, r->nv), r->scene.dt, row(r->v, n + 1, r->nv),
                                 r->substeps[n]);
    if (status == KG_OK) {
      carry(r, J, tangents, n, work);
    }
  }
  for (int i = 0; i < DIRECTIONS; i++) {
    const double *dq = tangents + 2 * (size_t)i * nv, *dv = dq + nv;
    answer[i] = 0.0;
    for (size_t k = 0; k < nv; k++) {
      answer[i] += r->q_bar[k] * dq[k] + r->v_bar[k] * dv[k];
    }
  }
  kg_step_destroy(step);
  free(J);
  return status;
}

/* ---- contestants ----------------------------------------------------------------------------- */

typedef struct runner {
  const rollout *of;
  kg_step *step;
  kg_rollout *rollout;
  double *gradient; /* (STEPS, nv) */
} runner;

static void destroy(void *state)
{
  runner *s = state;
  kg_rollout_destroy(s->rollout);
  kg_step_destroy(s->step);
  free(s->gradient);
  free(s);
}

static kg_status run_forward(void *state, double *answer)
{
  (void)answer;
  runner *s = state;
  const rollout *r = s->of;
  return kg_rollout_run(s->rollout, STEPS, r->q, r->v, r->tau, NULL, NULL, NULL);
}

static kg_status make(runner *s, bool checkpoints, const kg_allocator *allocator)
{
  const kg_step_def def = step_def(s->of, allocator);
  kg_status status = kg_step_create(&s->step, &def);
  if (status == KG_OK) {
    const kg_rollout_def rollout_def = {.step = s->step,
                                        .max_steps = STEPS,
                                        .dt = s->of->scene.dt,
                                        .checkpoints = checkpoints,
                                        .allocator = allocator};
    status = kg_rollout_create(&s->rollout, &rollout_def);
  }
  return status == KG_OK ? run_forward(s, NULL) : status;
}

static kg_status create_either(void **state, const void *data, bool checkpoints,
                               const kg_allocator *allocator)
{
  runner *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  s->gradient = calloc((size_t)STEPS * (size_t)s->of->nv, sizeof *s->gradient);
  const kg_status status = s->gradient ? make(s, checkpoints, allocator) : KG_ERR_NO_MEMORY;
  if (status != KG_OK) {
    destroy(s);
    return status;
  }
  *state = s;
  return KG_OK;
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  return create_either(state, data, false, allocator);
}

static kg_status create_checkpoints(void **state, const void *data, const kg_allocator *allocator)
{
  return create_either(state, data, true, allocator);
}

/* weights of the last state */
static void cotangent(void *user, int t, const double *q, const double *v, double *q_bar,
                      double *v_bar)
{
  const rollout *r = user;
  (void)q;
  (void)v;
  for (int k = 0; k < r->nv && t == STEPS; k++) {
    q_bar[k] += r->q_bar[k];
    v_bar[k] += r->v_bar[k];
  }
}

static kg_status run_backward(void *state, double *answer)
{
  runner *s = state;
  const rollout *r = s->of;
  const size_t count = (size_t)STEPS * (size_t)r->nv;
  memset(s->gradient, 0, count * sizeof *s->gradient);
  const kg_rollout_gradient gradient = {.tau = s->gradient};
  const kg_status status = kg_rollout_vjp(s->rollout, &gradient, cotangent, (void *)r);
  for (size_t i = 0; i < DIRECTIONS; i++) {
    const double *direction = r->direction + i * count;
    answer[i] = 0.0;
    for (size_t k = 0; k < count; k++) {
      answer[i] += direction[k] * s->gradient[k];
    }
  }
  return status;
}

/* ---- the case -------------------------------------------------------------------------------- */

static const kg_bench_contestant contestants[] = {
  {"forward", NULL, 0, create, run_forward, destroy},
  {"backward", NULL, 1, create, run_backward, destroy},
  {"backward, checkpoints", NULL, 1, create_checkpoints, run_backward, destroy},
};
static const kg_bench_pair pairs[] = {
  {"backward over forward", 1, 0, 1.0},
  {"checkpoints over forward", 2, 0, 0.0},
};

static const kg_bench_situation flight = KG_BENCH_FLIGHT, standing = KG_BENCH_STANDING;

/* clang-format off */
#define CASE(title, situation)                                                                     \
  {                                                                                                \
    .name = (title), .unit = "us", .unit_seconds = 1e-6, .tolerance = 1e-8,                        \
    .detail = &(situation), .open = open, .close = close, .reference = reference,                  \
    .contestants = contestants, .contestant_count = KG_COUNT_OF(contestants), .pairs = pairs,      \
    .pair_count = KG_COUNT_OF(pairs)                                                               \
  }
/* clang-format on */

const kg_bench_case kg_bench_rollout_cases[BENCH_ROLLOUT_CASES] = {
  CASE("rollout_500_flight", flight),
  CASE("rollout_500_standing", standing),
};
