/* Derivatives of one step beside MuJoCo's finite differences.
 *
 * Timed: what follows a step of 1/120 s that has been taken, all derivatives of (q', v') by q, v
 * and tau, or one product with their transpose; MuJoCo's mjd_transitionFD for the same derivatives
 * (`implicit`, a motor for each degree of freedom, one-sided differences).
 *
 * Compared:
 *   acceleration  in flight, derivatives of (v' - v) / dt as dt goes to zero (Richardson's
 *                 extrapolation over three lengths) with those of M^-1 (tau - damping v - bias); in
 *                 contact the two engines follow different laws
 *   step          derivatives of v' with extrapolated central differences of solutions by dense LU
 *   gradient      the transposed product with the same differences */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/dynamics/cases.h"
#include "bench/dynamics/reference.h"
#include "bench/dynamics/scenes.h"
#include "kinegrad/dense.h"

/* s, the longest of three: damping of 2 N m s/rad stops a hand within 1e-4 s */
static const double LIMIT_STEP = 2e-6;
static const double DIFFERENCE = 1e-6; /* rad, m, rad/s, m/s; times diag(M) for tau */

/* Parts of an answer. The first is there in flight alone. */
enum { STEP = 1, GRADIENT = 2, ACCELERATION = 4 };

/* ---- a problem ------------------------------------------------------------------------------- */

typedef struct step_problem {
  kg_bench_scene scene;
  int nv;
  double *v_next, *q_next, *q_bar, *v_bar; /* of the step, weights of the gradient */
  double *inertia;                         /* diag(M) */
} step_problem;

static size_t square(const step_problem *p)
{
  return (size_t)p->nv * (size_t)p->nv;
}

static void close(kg_bench_problem *problem)
{
  step_problem *p = problem->data;
  kg_bench_scene_close(&p->scene);
  free(p->v_next);
  free(p);
}

/* Newton's method with dense factors on the equation of a step: differences of its solution need
 * more digits than a step is asked for. */
typedef struct precise {
  kg_step *step;
  double *G, *J, *turn; /* nv, nv^2, nv */
  int *pivots;
} precise;

static void precise_close(precise *s)
{
  kg_step_destroy(s->step);
  free(s->G);
  free(s->pivots);
}

static kg_status precise_open(precise *s, const step_problem *p)
{
  const size_t nv = (size_t)p->nv;
  const kg_step_def def = kg_bench_scene_step_def(&p->scene, NULL);
  *s = (precise){.G = malloc((2 * nv + nv * nv) * sizeof *s->G),
                 .pivots = malloc(nv * sizeof *s->pivots)};
  const kg_status status = s->G && s->pivots ? kg_step_create(&s->step, &def) : KG_ERR_NO_MEMORY;
  if (status != KG_OK) {
    precise_close(s);
    return status;
  }
  s->turn = s->G + nv;
  s->J = s->turn + nv;
  return KG_OK;
}

/* The solution near v_next, and the pose that the step ends in. */
static bool solve_precisely(precise *s, const step_problem *p, double *q_next, double *v_next,
                            const double *q, const double *v, const double *tau)
{
  const double dt = p->scene.dt;
  for (int k = 0; k < 4; k++) {
    kg_step_residual(s->step, s->G, s->J, v_next, q, v, tau, dt, NULL);
    if (!kg_dense_lu_factor(s->J, s->pivots, p->nv)) {
      return false;
    }
    kg_dense_lu_solve(s->J, s->pivots, p->nv, s->G, 1);
    for (int r = 0; r < p->nv; r++) {
      v_next[r] -= s->G[r];
      s->turn[r] = dt * v_next[r];
    }
  }
  kg_body_integrate(p->scene.model.body, q_next, q, s->turn);
  return true;
}

static kg_status fill(step_problem *p, precise *solver)
{
  const kg_bench_scene *s = &p->scene;
  kg_dynamics *d = NULL;
  const kg_status status = kg_dynamics_create(&d, s->model.body, NULL);
  if (status != KG_OK) {
    return status;
  }
  kg_dynamics_mass_matrix(d, solver->J, s->q);
  kg_dynamics_destroy(d);
  kg_random random = kg_random_make(99);
  for (int k = 0; k < p->nv; k++) {
    p->inertia[k] = solver->J[k * p->nv + k];
    p->q_bar[k] = kg_random_normal(&random);
    p->v_bar[k] = kg_random_normal(&random);
  }
  kg_step_report report;
  kg_step_advance(solver->step, p->q_next, p->v_next, s->q, s->v, s->tau, s->dt, false, &report);
  const bool is_plain = report.converged && report.substeps == 1;
  return is_plain && solve_precisely(solver, p, p->q_next, p->v_next, s->q, s->v, s->tau)
           ? KG_OK
           : KG_ERR_UNDEFINED;
}

static kg_status prepare(step_problem *p)
{
  const size_t nv = (size_t)p->nv, nq = (size_t)p->scene.model.body->nq;
  precise solver;
  p->v_next = calloc(4 * nv + nq, sizeof *p->v_next);
  kg_status status = p->v_next ? precise_open(&solver, p) : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    p->q_bar = p->v_next + nv;
    p->v_bar = p->q_bar + nv;
    p->inertia = p->v_bar + nv;
    p->q_next = p->inertia + nv;
    status = fill(p, &solver);
    precise_close(&solver);
  }
  return status;
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  step_problem *p = calloc(1, sizeof *p);
  if (!p) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status =
    kg_bench_scene_open(&p->scene, *(const kg_bench_situation *)detail, setting, error);
  if (status != KG_OK) {
    free(p);
    return status;
  }
  p->nv = p->scene.model.body->nv;
  problem->data = p;
  problem->items = 1.0;
  problem->parts[0] = (kg_bench_part){"step", 3 * square(p), 1};
  problem->parts[1] = (kg_bench_part){"gradient", 3 * (size_t)p->nv, 1};
  problem->parts[2] = (kg_bench_part){"acceleration by q", square(p), 1};
  problem->parts[3] = (kg_bench_part){"acceleration by v", square(p), 1};
  problem->parts[4] = (kg_bench_part){"acceleration by tau", square(p), 1};
  problem->part_count = p->scene.situation == KG_BENCH_FLIGHT ? 5 : 2;
  snprintf(problem->source, sizeof problem->source, "%s", p->scene.model.source);
  status = prepare(p);
  if (status != KG_OK) {
    close(problem);
  }
  return status;
}

/* ---- reference ------------------------------------------------------------------------------- */

/* Arguments of a step, one of them moved: number k of q (tangent space), then v, then tau. */
typedef struct moved {
  double *q, *v, *tau, *turn;
} moved;

static void move(moved *x, const step_problem *p, int k, double by)
{
  const kg_bench_scene *s = &p->scene;
  const size_t nv = (size_t)p->nv;
  memset(x->turn, 0, nv * sizeof *x->turn);
  memcpy(x->v, s->v, nv * sizeof *x->v);
  memcpy(x->tau, s->tau, nv * sizeof *x->tau);
  double *const argument[3] = {x->turn, x->v, x->tau};
  argument[k / p->nv][k % p->nv] += by;
  kg_body_integrate(s->model.body, x->q, s->q, x->turn);
}

/* d (q', v') by argument k: central differences of two widths, extrapolated; q' in the tangent
 * space of q_next. */
static bool difference(const step_problem *p, precise *solver, moved *x, int k, double *dq,
                       double *dv, double *q_end, double *v_end)
{
  const double width = DIFFERENCE * (k < 2 * p->nv ? 1.0 : p->inertia[k % p->nv] / p->scene.dt);
  memset(dq, 0, (size_t)p->nv * sizeof *dq);
  memset(dv, 0, (size_t)p->nv * sizeof *dv);
  for (int side = 0; side < 4; side++) {
    const double sign = side % 2 == 0 ? 1.0 : -1.0;
    const double weight = sign * (side < 2 ? -1.0 / 6.0 : 8.0 / 6.0) / width;
    move(x, p, k, sign * (side < 2 ? width : 0.5 * width));
    memcpy(v_end, p->v_next, (size_t)p->nv * sizeof *v_end);
    if (!solve_precisely(solver, p, q_end, v_end, x->q, x->v, x->tau)) {
      return false;
    }
    kg_body_difference(p->scene.model.body, x->turn, q_end, p->q_next);
    for (int r = 0; r < p->nv; r++) {
      dq[r] += weight * x->turn[r];
      dv[r] += weight * v_end[r];
    }
  }
  return true;
}

/* dv'/d(q, v, tau), then the gradient. */
static kg_status reference_step(const step_problem *p, double *answer)
{
  const size_t nv = (size_t)p->nv, nq = (size_t)p->scene.model.body->nq;
  double *work = malloc((6 * nv + 2 * nq) * sizeof *work), *gradient = answer + 3 * nv * nv;
  precise solver;
  kg_status status = work ? precise_open(&solver, p) : KG_ERR_NO_MEMORY;
  if (status != KG_OK) {
    free(work);
    return status;
  }
  moved x = {work, work + nq, work + nq + nv, work + nq + 2 * nv};
  double *dq = x.turn + nv, *dv = dq + nv, *v_end = dv + nv, *q_end = v_end + nv;
  for (int k = 0; k < 3 * p->nv && status == KG_OK; k++) {
    status = difference(p, &solver, &x, k, dq, dv, q_end, v_end) ? KG_OK : KG_ERR_UNDEFINED;
    gradient[k] = 0.0;
    for (size_t r = 0; r < nv; r++) {
      answer[(size_t)(k / p->nv) * nv * nv + r * nv + (size_t)(k % p->nv)] = dv[r];
      gradient[k] += p->q_bar[r] * dq[r] + p->v_bar[r] * dv[r];
    }
  }
  precise_close(&solver);
  free(work);
  return status;
}

/* With damping D of the joints: a = FD(q, v, tau - D v), da/dv = da/dv|tau - da/dtau D. */
static kg_status reference_acceleration(const step_problem *p, double *answer)
{
  const kg_bench_scene *s = &p->scene;
  double *tau = malloc((size_t)p->nv * sizeof *tau);
  if (!tau) {
    return KG_ERR_NO_MEMORY;
  }
  for (int k = 0; k < p->nv; k++) {
    tau[k] = s->tau[k] - (k < 6 ? 0.0 : kg_bench_joint_damping * s->v[k]);
  }
  double *by_v = answer + square(p), *by_tau = by_v + square(p);
  const kg_status status =
    kg_bench_reference_forward_derivatives(s->model.body, answer, by_v, by_tau, s->q, s->v, tau);
  for (int k = 0; k < p->nv * p->nv && status == KG_OK; k++) {
    by_v[k] -= k % p->nv < 6 ? 0.0 : kg_bench_joint_damping * by_tau[k];
  }
  free(tau);
  return status;
}

static kg_status reference(const void *data, double *answer)
{
  const step_problem *p = data;
  const kg_status status = reference_step(p, answer);
  if (status != KG_OK || p->scene.situation != KG_BENCH_FLIGHT) {
    return status;
  }
  return reference_acceleration(p, answer + 3 * square(p) + 3 * (size_t)p->nv);
}

/* ---- contestants ----------------------------------------------------------------------------- */

typedef struct engine {
  const step_problem *of;
  kg_step *step;
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco *mujoco;
#endif
  double *A, *B; /* 6 nv^2 in all: matrices of the step */
  double *limit; /* 3 nv^2: of the acceleration */
  double *v_next, *q_next;
} engine;

static void destroy(void *state)
{
  engine *e = state;
  kg_step_destroy(e->step);
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco_close(e->mujoco);
#endif
  free(e->A);
  free(e);
}

static engine *engine_of(const step_problem *of)
{
  engine *e = calloc(1, sizeof *e);
  if (!e) {
    return NULL;
  }
  e->of = of;
  e->A = calloc(9 * square(of) + (size_t)(of->nv + of->scene.model.body->nq), sizeof *e->A);
  if (!e->A) {
    free(e);
    return NULL;
  }
  e->B = e->A + 4 * square(of);
  e->limit = e->A + 6 * square(of);
  e->v_next = e->limit + 3 * square(of);
  e->q_next = e->v_next + of->nv;
  return e;
}

/* Weight of the step dt 2^-level in the extrapolation to zero. */
static const double LIMIT_WEIGHT[3] = {1.0 / 3.0, -2.0, 8.0 / 3.0};

/* limit += weight (dv'/d(.) - [the identity, for v]) / dt */
static void add_to_limit(double *limit, const double *dv, int rows, int stride, bool is_by_v,
                         double weight)
{
  for (int r = 0; r < rows; r++) {
    for (int c = 0; c < rows; c++) {
      limit[r * rows + c] += weight * (dv[r * stride + c] - (is_by_v && r == c ? 1.0 : 0.0));
    }
  }
}

static kg_step_jacobian jacobian_of(const engine *e)
{
  const size_t n = square(e->of);
  double *J = e->A;
  return (kg_step_jacobian){J, J + n, J + 2 * n, J + 3 * n, J + 4 * n, J + 5 * n};
}

static kg_status limit_of_ours(engine *e)
{
  const kg_bench_scene *s = &e->of->scene;
  kg_step_def def = kg_bench_scene_step_def(s, NULL);
  def.tolerance = 1e-12;
  kg_step *step = NULL;
  kg_status status = kg_step_create(&step, &def);
  for (int level = 0; level < 3 && status == KG_OK; level++) {
    const double dt = ldexp(LIMIT_STEP, -level), weight = LIMIT_WEIGHT[level] / dt;
    const kg_step_jacobian J = jacobian_of(e);
    kg_step_report report;
    kg_step_advance(step, e->q_next, e->v_next, s->q, s->v, s->tau, dt, false, &report);
    status = kg_step_derivatives(step, &J, s->q, s->v, s->tau, dt, e->v_next, report.substeps);
    for (int part = 0; part < 3 && status == KG_OK; part++) {
      add_to_limit(e->limit + (size_t)part * square(e->of), e->A + (size_t)part * square(e->of),
                   e->of->nv, e->of->nv, part == 1, weight);
    }
  }
  kg_step_destroy(step);
  return status;
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  engine *e = engine_of(data);
  if (!e) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_step_def def = kg_bench_scene_step_def(&e->of->scene, allocator);
  kg_status status = kg_step_create(&e->step, &def);
  if (status == KG_OK && e->of->scene.situation == KG_BENCH_FLIGHT) {
    status = limit_of_ours(e);
  }
  if (status != KG_OK) {
    destroy(e);
    return status;
  }
  memcpy(e->v_next, e->of->v_next, (size_t)e->of->nv * sizeof *e->v_next);
  *state = e;
  return KG_OK;
}

static void answer_limit(const engine *e, double *answer)
{
  if (e->of->scene.situation == KG_BENCH_FLIGHT) {
    memcpy(answer + 3 * square(e->of) + 3 * (size_t)e->of->nv, e->limit,
           3 * square(e->of) * sizeof *answer);
  }
}

static kg_status run_jacobian(void *state, double *answer)
{
  engine *e = state;
  const kg_bench_scene *s = &e->of->scene;
  kg_step_jacobian J = jacobian_of(e);
  J.dv_dq = answer;
  J.dv_dv = answer + square(e->of);
  J.dv_dtau = answer + 2 * square(e->of);
  const kg_status status =
    kg_step_derivatives(e->step, &J, s->q, s->v, s->tau, s->dt, e->v_next, 1);
  answer_limit(e, answer);
  return status;
}

static kg_status run_step_and_jacobian(void *state, double *answer)
{
  engine *e = state;
  const kg_bench_scene *s = &e->of->scene;
  kg_step_advance(e->step, e->q_next, e->v_next, s->q, s->v, s->tau, s->dt, false, NULL);
  return run_jacobian(state, answer);
}

static kg_status run_gradient(void *state, double *answer)
{
  engine *e = state;
  const kg_bench_scene *s = &e->of->scene;
  const size_t nv = (size_t)e->of->nv;
  double *out = answer + 3 * square(e->of);
  memset(out, 0, 3 * nv * sizeof *out);
  const kg_step_gradient gradient = {.q = out, .v = out + nv, .tau = out + 2 * nv};
  return kg_step_vjp(e->step, &gradient, s->q, s->v, s->tau, s->dt, e->v_next, 1, e->of->q_bar,
                     e->of->v_bar);
}

#ifdef KG_BENCH_HAS_MUJOCO
static void limit_of_mujoco(engine *e)
{
  const kg_bench_scene *s = &e->of->scene;
  const int nv = e->of->nv;
  for (int level = 0; level < 3; level++) {
    const double dt = ldexp(LIMIT_STEP, -level), weight = LIMIT_WEIGHT[level] / dt;
    kg_mujoco_set_timestep(e->mujoco, dt);
    kg_mujoco_transition(e->mujoco, e->A, e->B, s->tau);
    const double *v_rows = e->A + 2 * square(e->of); /* rows nv .. 2 nv - 1 of 2 nv columns */
    add_to_limit(e->limit, v_rows, nv, 2 * nv, false, weight);
    add_to_limit(e->limit + square(e->of), v_rows + nv, nv, 2 * nv, true, weight);
    add_to_limit(e->limit + 2 * square(e->of), e->B + square(e->of), nv, nv, false, weight);
  }
  kg_mujoco_set_timestep(e->mujoco, s->dt);
}

static kg_status create_mujoco(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  engine *e = engine_of(data);
  if (!e) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_bench_scene *s = &e->of->scene;
  const kg_mujoco_def def = {.body = s->model.body,
                             .has_shapes = true,
                             .has_motors = true,
                             .timestep = s->dt,
                             .integrator = KG_MUJOCO_IMPLICIT,
                             .joint_damping = kg_bench_joint_damping,
                             .margin = kg_contact_default_params().layer};
  const kg_status status = kg_mujoco_open(&e->mujoco, &def);
  if (status != KG_OK) {
    destroy(e);
    return status;
  }
  kg_mujoco_set_state(e->mujoco, s->q, s->v);
  if (s->situation == KG_BENCH_FLIGHT) {
    limit_of_mujoco(e);
  }
  *state = e;
  return KG_OK;
}

static kg_status run_mujoco(void *state, double *answer)
{
  engine *e = state;
  kg_mujoco_transition(e->mujoco, e->A, e->B, e->of->scene.tau);
  answer_limit(e, answer);
  return KG_OK;
}
#endif

/* ---- the cases ------------------------------------------------------------------------------- */

enum { JACOBIAN, BOTH, VJP, MUJOCO };

/* parts: of the matrices in this situation; theirs: MuJoCo's */
#define ENGINES(parts, theirs)                                                                     \
  {                                                                                                \
    [JACOBIAN] = {"kinegrad, Jacobian", NULL, parts, create, run_jacobian, destroy},               \
    [BOTH] = {"kinegrad, step, Jacobian", NULL, parts, create, run_step_and_jacobian, destroy},    \
    [VJP] = {"kinegrad, one VJP", NULL, GRADIENT, create, run_gradient, destroy},                  \
    [MUJOCO] =                                                                                     \
      MUJOCO_CONTESTANT("MuJoCo, transitionFD", theirs, create_mujoco, run_mujoco, destroy)        \
  }
enum { ACCELERATIONS = ACCELERATION | ACCELERATION << 1 | ACCELERATION << 2 };
static const kg_bench_contestant flying[] = ENGINES(STEP | ACCELERATIONS, ACCELERATIONS),
                                 touching[] = ENGINES(STEP, 0);

static const kg_bench_pair pairs[] = {
  {"Jacobian", JACOBIAN, MUJOCO, 0.01},
  {"step and Jacobian", BOTH, MUJOCO, 0.0},
  {"one VJP", VJP, MUJOCO, 0.001},
};

static const kg_bench_situation flight = KG_BENCH_FLIGHT, standing = KG_BENCH_STANDING,
                                lying = KG_BENCH_LYING;

/* clang-format off */
#define CASE(title, situation, table)                                                              \
  {                                                                                                \
    .name = (title), .unit = "us", .unit_seconds = 1e-6, .tolerance = 1e-4,                        \
    .detail = &(situation), .open = open, .close = close, .reference = reference,                  \
    .contestants = (table), .contestant_count = KG_COUNT_OF(table), .pairs = pairs,                \
    .pair_count = KG_COUNT_OF(pairs)                                                               \
  }
/* clang-format on */

const kg_bench_case kg_bench_derivative_cases[BENCH_DERIVATIVE_CASES] = {
  CASE("step_derivatives_flight", flight, flying),
  CASE("step_derivatives_standing", standing, touching),
  CASE("step_derivatives_lying", lying, touching),
};
