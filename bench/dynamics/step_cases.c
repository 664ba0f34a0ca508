/* Steps of a body in flight, standing and lying beside MuJoCo.
 *
 * Timed: a run of 16 steps of 1/120 s from one start under one series of torques; times are those
 * of a step. Each engine follows its own trajectory and starts each step where it ended the last.
 *
 * Compared, where two laws of contact and two integrators must agree:
 *   flight    the acceleration at the start, from the first step's v' as its length goes to zero
 *             (Richardson's extrapolation over three lengths), with M^-1 (tau - damping v - bias)
 *   contact   the vertical impulse of the engine's contact forces over the change of momentum plus
 *             weight times time, which is 1, for steps 16 times shorter; how far the centre of mass
 *             rose or fell during the run, as a share of the stature (given as 1 + share, so that
 *             the reference is 1) */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/dynamics/cases.h"
#include "bench/dynamics/reference.h"
#include "bench/dynamics/scenes.h"

static const double LIMIT_STEP =
  2e-7; /* s, the longest of three: damping of 2 N m s/rad stops a hand
                                          within 1e-4 s */

enum { FINE = 16 }; /* momentum is balanced over steps so much shorter: to first order in theirs */

/* ---- one engine ------------------------------------------------------------------------------ */

typedef struct engine engine;

/* What an engine does; support: vertical contact force of the last step, N. */
typedef struct engine_calls {
  void (*start)(engine *e, const double *q, const double *v, double dt);
  void (*step)(engine *e, const double *tau);
  double (*support)(const engine *e);
  void (*state)(const engine *e, double *q, double *v);
} engine_calls;

struct engine {
  const kg_bench_scene *of;
  const engine_calls *calls;
  kg_step *step;
  kg_step_report report;
  double dt;
  double *q, *v;
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco *mujoco;
#endif
  kg_dynamics *dynamics; /* to measure with */
  double *answer;        /* what is compared, from create */
  size_t answer_count;
};

static void kinegrad_start(engine *e, const double *q, const double *v, double dt)
{
  e->dt = dt;
  memcpy(e->q, q, (size_t)e->of->model.body->nq * sizeof *q);
  memcpy(e->v, v, (size_t)e->of->model.body->nv * sizeof *v);
}

static void kinegrad_step(engine *e, const double *tau)
{
  kg_step_advance(e->step, e->q, e->v, e->q, e->v, tau, e->dt, false, &e->report);
}

static double kinegrad_support(const engine *e)
{
  double sum = 0.0;
  for (int k = 0; k < e->report.contact_count; k++) {
    sum += e->report.contacts[k].force.f.y;
  }
  return sum;
}

static void kinegrad_state(const engine *e, double *q, double *v)
{
  memcpy(q, e->q, (size_t)e->of->model.body->nq * sizeof *q);
  memcpy(v, e->v, (size_t)e->of->model.body->nv * sizeof *v);
}

static const engine_calls kinegrad = {kinegrad_start, kinegrad_step, kinegrad_support,
                                      kinegrad_state};

#ifdef KG_BENCH_HAS_MUJOCO
static void mujoco_start(engine *e, const double *q, const double *v, double dt)
{
  kg_mujoco_set_timestep(e->mujoco, dt);
  kg_mujoco_set_state(e->mujoco, q, v);
}

static void mujoco_step(engine *e, const double *tau)
{
  kg_mujoco_step(e->mujoco, tau);
}

static double mujoco_support(const engine *e)
{
  return kg_mujoco_support(e->mujoco);
}

static void mujoco_state(const engine *e, double *q, double *v)
{
  kg_mujoco_get_state(e->mujoco, q, v);
}

static const engine_calls mujoco = {mujoco_start, mujoco_step, mujoco_support, mujoco_state};
#endif

/* ---- what is compared ------------------------------------------------------------------------ */

/* a = lim (v' - v) / dt */
static void limit_of_flight(engine *e)
{
  const kg_bench_scene *s = e->of;
  const int nv = s->model.body->nv;
  const double weight[3] = {1.0 / 3.0, -2.0, 8.0 / 3.0}; /* of dt, dt/2, dt/4 */
  double *q = malloc((size_t)(s->model.body->nq + nv) * sizeof *q);
  if (!q) {
    return; /* the answer stays undefined and will not agree */
  }
  double *v = q + s->model.body->nq;
  memset(e->answer, 0, (size_t)nv * sizeof *e->answer);
  for (int level = 0; level < 3; level++) {
    const double dt = ldexp(LIMIT_STEP, -level);
    e->calls->start(e, s->q, s->v, dt);
    e->calls->step(e, s->tau);
    e->calls->state(e, q, v);
    for (int k = 0; k < nv; k++) {
      e->answer[k] += weight[level] * (v[k] - s->v[k]) / dt;
    }
  }
  free(q);
}

static void balance_of_contact(engine *e)
{
  const kg_bench_scene *s = e->of;
  const kg_body *body = s->model.body;
  double *q = malloc((size_t)(body->nq + body->nv) * sizeof *q);
  if (!q) {
    return;
  }
  double *v = q + body->nq, impulse = 0.0;
  const double before = kg_dynamics_centroid(e->dynamics, s->q, s->v).com_dot.y;
  const double dt = s->dt / FINE;
  e->calls->start(e, s->q, s->v, dt);
  for (int n = 0; n < FINE * KG_BENCH_STEPS; n++) {
    e->calls->step(e, s->tau + n / FINE * body->nv);
    impulse += dt * e->calls->support(e);
  }
  e->calls->state(e, q, v);
  const kg_centroid after = kg_dynamics_centroid(e->dynamics, q, v);
  const double needed = after.com_dot.y - before + kg_bench_gravity * KG_BENCH_STEPS * s->dt;
  e->answer[0] = impulse / (body->mass * needed);
  e->answer[1] = 1.0 + (after.com.y - s->height) / body->stature;
  free(q);
}

static void prepare_answer(engine *e)
{
  for (size_t k = 0; k < e->answer_count; k++) {
    e->answer[k] = NAN;
  }
  if (e->of->situation == KG_BENCH_FLIGHT) {
    limit_of_flight(e);
  } else {
    balance_of_contact(e);
  }
}

static kg_status reference(const void *data, double *answer)
{
  const kg_bench_scene *s = data;
  if (s->situation != KG_BENCH_FLIGHT) {
    answer[0] = 1.0;
    answer[1] = 1.0;
    return KG_OK;
  }
  const int nv = s->model.body->nv;
  double *tau = malloc((size_t)nv * sizeof *tau);
  if (!tau) {
    return KG_ERR_NO_MEMORY;
  }
  for (int k = 0; k < nv; k++) {
    tau[k] = s->tau[k] - (k < 6 ? 0.0 : kg_bench_joint_damping * s->v[k]);
  }
  const kg_status status = kg_bench_reference_forward(s->model.body, answer, s->q, s->v, tau);
  free(tau);
  return status;
}

/* ---- contestants ----------------------------------------------------------------------------- */

static void destroy(void *state)
{
  engine *e = state;
  kg_step_destroy(e->step);
  kg_dynamics_destroy(e->dynamics);
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco_close(e->mujoco);
#endif
  free(e->q);
  free(e);
}

static engine *engine_of(const kg_bench_scene *of, const engine_calls *calls)
{
  const kg_body *body = of->model.body;
  engine *e = calloc(1, sizeof *e);
  if (!e) {
    return NULL;
  }
  e->of = of;
  e->calls = calls;
  e->answer_count = of->situation == KG_BENCH_FLIGHT ? (size_t)body->nv : 2;
  e->q = calloc((size_t)(body->nq + body->nv) + e->answer_count, sizeof *e->q);
  if (!e->q || kg_dynamics_create(&e->dynamics, body, NULL) != KG_OK) {
    destroy(e);
    return NULL;
  }
  e->v = e->q + body->nq;
  e->answer = e->v + body->nv;
  return e;
}

/* The limit of short steps, in flight, needs v' to more digits than steps of 1/120 s do. */
static kg_status answer_precisely(engine *e, kg_step_def def)
{
  def.tolerance = e->of->situation == KG_BENCH_FLIGHT ? 1e-12 : def.tolerance;
  const kg_status status = kg_step_create(&e->step, &def);
  if (status == KG_OK) {
    prepare_answer(e);
    kg_step_destroy(e->step);
    e->step = NULL;
  }
  return status;
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  engine *e = engine_of(data, &kinegrad);
  if (!e) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_step_def def = kg_bench_scene_step_def(e->of, allocator);
  kg_status status = answer_precisely(e, def);
  if (status == KG_OK) {
    status = kg_step_create(&e->step, &def);
  }
  if (status != KG_OK) {
    destroy(e);
    return status;
  }
  *state = e;
  return KG_OK;
}

#ifdef KG_BENCH_HAS_MUJOCO
static kg_status open_mujoco(kg_mujoco **to, const kg_bench_scene *scene,
                             kg_mujoco_integrator integrator)
{
  const kg_mujoco_def def = {.body = scene->model.body,
                             .has_shapes = true,
                             .timestep = scene->dt,
                             .integrator = integrator,
                             .joint_damping = kg_bench_joint_damping,
                             .margin = kg_contact_default_params().layer};
  return kg_mujoco_open(to, &def);
}

static kg_status create_mujoco(void **state, const void *data, kg_mujoco_integrator integrator)
{
  engine *e = engine_of(data, &mujoco);
  if (!e) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_status status = open_mujoco(&e->mujoco, e->of, integrator);
  if (status != KG_OK) {
    destroy(e);
    return status;
  }
  prepare_answer(e);
  *state = e;
  return KG_OK;
}

static kg_status create_implicit(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  return create_mujoco(state, data, KG_MUJOCO_IMPLICIT);
}

static kg_status create_euler(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  return create_mujoco(state, data, KG_MUJOCO_EULER);
}
#endif

static kg_status run(void *state, double *answer)
{
  engine *e = state;
  const kg_bench_scene *s = e->of;
  e->calls->start(e, s->q, s->v, s->dt);
  for (int n = 0; n < KG_BENCH_STEPS; n++) {
    e->calls->step(e, s->tau + n * s->model.body->nv);
  }
  memcpy(answer, e->answer, e->answer_count * sizeof *answer);
  return KG_OK;
}

/* ---- problems -------------------------------------------------------------------------------- */

static void close(kg_bench_problem *problem)
{
  kg_bench_scene_close(problem->data);
  free(problem->data);
}

/* "11 contacts, 2.1 iterations a step; MuJoCo 8 contacts" */
static kg_status describe(kg_bench_problem *problem, const kg_bench_scene *s)
{
  engine *e = engine_of(s, &kinegrad);
  if (!e) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_step_def def = kg_bench_scene_step_def(s, NULL);
  const kg_status status = kg_step_create(&e->step, &def);
  if (status != KG_OK) {
    destroy(e);
    return status;
  }
  int iterations = 0, substeps = 0, failures = 0, contacts = 0;
  e->calls->start(e, s->q, s->v, s->dt);
  for (int n = 0; n < KG_BENCH_STEPS; n++) {
    e->calls->step(e, s->tau + n * s->model.body->nv);
    iterations += e->report.iterations;
    substeps += e->report.substeps - 1;
    failures += !e->report.converged;
    contacts += e->report.contact_count;
  }
  destroy(e);
  const int length = snprintf(problem->source, sizeof problem->source,
                              "%s; a step: %.1f iterations, %.1f contacts, %d not converged, %d "
                              "sub-steps",
                              s->model.source, (double)iterations / KG_BENCH_STEPS,
                              (double)contacts / KG_BENCH_STEPS, failures, substeps);
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco *m = NULL;
  if (length > 0 && (size_t)length < sizeof problem->source &&
      open_mujoco(&m, s, KG_MUJOCO_IMPLICIT) == KG_OK) {
    kg_mujoco_set_state(m, s->q, s->v);
    kg_mujoco_step(m, s->tau);
    snprintf(problem->source + length, sizeof problem->source - (size_t)length,
             "; MuJoCo %d contacts", kg_mujoco_contacts(m));
    kg_mujoco_close(m);
  }
#else
  (void)length;
#endif
  return KG_OK;
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  kg_bench_scene *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status = kg_bench_scene_open(s, *(const kg_bench_situation *)detail, setting, error);
  if (status != KG_OK) {
    free(s);
    return status;
  }
  problem->data = s;
  problem->items = KG_BENCH_STEPS;
  if (s->situation == KG_BENCH_FLIGHT) {
    problem->parts[0] = (kg_bench_part){"acceleration", (size_t)s->model.body->nv, 1};
    problem->part_count = 1;
  } else {
    problem->parts[0] = (kg_bench_part){"impulse over what it did", 1, 1};
    problem->parts[1] = (kg_bench_part){"rise of the centre of mass", 1, 1};
    problem->part_count = 2;
  }
  status = describe(problem, s);
  if (status != KG_OK) {
    close(problem);
  }
  return status;
}

/* ---- the cases ------------------------------------------------------------------------------- */

enum { OURS, IMPLICIT, EULER };

#define ENGINES(mask)                                                                              \
  {                                                                                                \
    [OURS] = {"kinegrad, backward Euler", NULL, mask, create, run, destroy},                       \
    [IMPLICIT] = MUJOCO_CONTESTANT("MuJoCo, implicit", mask, create_implicit, run, destroy),       \
    [EULER] = MUJOCO_CONTESTANT("MuJoCo, Euler", mask, create_euler, run, destroy)                 \
  }
static const kg_bench_contestant flying[] = ENGINES(1), touching[] = ENGINES(3);

#define STEP_PAIRS(aim)                                                                            \
  {                                                                                                \
    {"kinegrad", OURS, IMPLICIT, aim},                                                             \
    {                                                                                              \
      "kinegrad against Euler", OURS, EULER, 0.0                                                   \
    }                                                                                              \
  }
static const kg_bench_pair aimed_pairs[] = STEP_PAIRS(1.0 / 3.0), free_pairs[] = STEP_PAIRS(0.0);

static const kg_bench_situation flight = KG_BENCH_FLIGHT, standing = KG_BENCH_STANDING,
                                held = KG_BENCH_HELD, lying = KG_BENCH_LYING;

/* clang-format off */
#define CASE(title, situation, tolerated, table, ratios)                                           \
  {                                                                                                \
    .name = (title), .unit = "us", .unit_seconds = 1e-6, .tolerance = (tolerated),                 \
    .detail = &(situation), .open = open, .close = close, .reference = reference,                  \
    .contestants = (table), .contestant_count = KG_COUNT_OF(table), .pairs = (ratios),             \
    .pair_count = KG_COUNT_OF(ratios)                                                              \
  }
/* clang-format on */

const kg_bench_case kg_bench_step_cases[BENCH_STEP_CASES] = {
  CASE("step_flight", flight, 1e-6, flying, aimed_pairs),
  CASE("step_standing", standing, 0.02, touching, aimed_pairs),
  CASE("step_standing_still", held, 0.02, touching, aimed_pairs),
  CASE("step_lying", lying, 0.02, touching, free_pairs),
};
