/* Kinematics and dynamics of bodies in random states beside MuJoCo's pipeline.
 *
 * Both sides start from q, v, a or tau alone: MuJoCo's times include the stages that its mj_rne,
 * mj_crb or mj_factorM build on. Times are those of one state. Answers: a part per result, one row a
 * state; entries of tau and a are compared by degree of freedom. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/dynamics/cases.h"
#include "bench/dynamics/reference.h"
#include "kinegrad/dynamics.h"

/* Which body and how many states: few where the answers are matrices. */
typedef struct size {
  kg_bench_skeleton skeleton;
  int count;
} size;

static const size vectors_23 = {KG_BENCH_MAPPED, 32}, vectors_37 = {KG_BENCH_EVERY_JOINT, 32};
static const size matrices_23 = {KG_BENCH_MAPPED, 2}, matrices_37 = {KG_BENCH_EVERY_JOINT, 2};

typedef struct states {
  kg_bench_model model;
  int count;
  double *q, *v, *a; /* (count, nq), (count, nv) */
} states;

/* ---- problems -------------------------------------------------------------------------------- */

static void close(kg_bench_problem *problem)
{
  states *s = problem->data;
  kg_bench_model_close(&s->model);
  free(s->q);
  free(s);
}

static kg_status fill(states *s, int count)
{
  const size_t nq = (size_t)s->model.body->nq, nv = (size_t)s->model.body->nv;
  s->count = count;
  s->q = malloc((size_t)count * (nq + 2 * nv) * sizeof *s->q);
  if (!s->q) {
    return KG_ERR_NO_MEMORY;
  }
  s->v = s->q + (size_t)count * nq;
  s->a = s->v + (size_t)count * nv;
  kg_random random = kg_random_make(23);
  for (size_t i = 0; i < (size_t)count; i++) {
    kg_bench_random_state(&random, s->model.body, s->q + i * nq, s->v + i * nv, s->a + i * nv);
  }
  return KG_OK;
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  const size *of = detail;
  states *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status = kg_bench_model_open(&s->model, of->skeleton, setting->data_folder, error);
  if (status != KG_OK) {
    free(s);
    return status;
  }
  problem->data = s;
  status = fill(s, of->count);
  if (status != KG_OK) {
    close(problem);
    return status;
  }
  problem->items = of->count;
  snprintf(problem->source, sizeof problem->source, "%s; %d random states", s->model.source,
           of->count);
  return KG_OK;
}

/* one vector of nv numbers a state */
static kg_status open_vectors(kg_bench_problem *problem, const kg_bench_setting *setting,
                              const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t nv = (size_t)s->model.body->nv;
    problem->parts[0] = (kg_bench_part){"of a degree of freedom", (size_t)s->count * nv, nv};
    problem->part_count = 1;
  }
  return status;
}

static kg_status open_matrix(kg_bench_problem *problem, const kg_bench_setting *setting,
                             const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t nv = (size_t)s->model.body->nv;
    problem->parts[0] = (kg_bench_part){"M", (size_t)s->count * nv * nv, 1};
    problem->part_count = 1;
  }
  return status;
}

/* all dtau/dq, then all dtau/dv, then all M */
static kg_status open_derivatives(kg_bench_problem *problem, const kg_bench_setting *setting,
                                  const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    static const char *const names[3] = {"dtau/dq", "dtau/dv", "dtau/da"};
    const states *s = problem->data;
    const size_t nv = (size_t)s->model.body->nv;
    for (int k = 0; k < 3; k++) {
      problem->parts[k] = (kg_bench_part){names[k], (size_t)s->count * nv * nv, 1};
    }
    problem->part_count = 3;
  }
  return status;
}

/* ---- a contestant's state -------------------------------------------------------------------- */

typedef struct kernel {
  const states *of;
  kg_dynamics *dynamics;
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco *mujoco;
#endif
  double *work; /* (count, nv) */
} kernel;

static void destroy(void *state)
{
  kernel *k = state;
  kg_dynamics_destroy(k->dynamics);
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco_close(k->mujoco);
#endif
  free(k->work);
  free(k);
}

static kernel *kernel_of(const states *of)
{
  kernel *k = calloc(1, sizeof *k);
  if (k) {
    k->of = of;
    k->work = malloc((size_t)of->count * (size_t)of->model.body->nv * sizeof *k->work);
    if (!k->work) {
      free(k);
      return NULL;
    }
  }
  return k;
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  kernel *k = kernel_of(data);
  if (!k) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_status status = kg_dynamics_create(&k->dynamics, k->of->model.body, allocator);
  if (status != KG_OK) {
    destroy(k);
    return status;
  }
  *state = k;
  return KG_OK;
}

#ifdef KG_BENCH_HAS_MUJOCO
static kg_status create_mujoco(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  kernel *k = kernel_of(data);
  if (!k) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_mujoco_def def = {.body = k->of->model.body, .timestep = 0.01};
  const kg_status status = kg_mujoco_open(&k->mujoco, &def);
  if (status != KG_OK) {
    destroy(k);
    return status;
  }
  *state = k;
  return KG_OK;
}
#endif

static const double *q_of(const states *s, int i)
{
  return s->q + (size_t)i * (size_t)s->model.body->nq;
}

/* row i of v, a or an answer */
static size_t row(const states *s, int i)
{
  return (size_t)i * (size_t)s->model.body->nv;
}

/* A run: f for every state, the arguments written with k, s and i. */
#define RUN(name, call)                                                                            \
  static kg_status name(void *state, double *answer)                                               \
  {                                                                                                \
    kernel *k = state;                                                                             \
    const states *s = k->of;                                                                       \
    for (int i = 0; i < s->count; i++) {                                                           \
      call;                                                                                        \
    }                                                                                              \
    return KG_OK;                                                                                  \
  }

/* ---- inverse dynamics ------------------------------------------------------------------------ */

static kg_status inverse_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_inverse(s->model.body, answer + row(s, i), q_of(s, i),
                                        s->v + row(s, i), s->a + row(s, i));
  }
  return status;
}

RUN(run_inverse, kg_dynamics_inverse(k->dynamics, answer + row(s, i), q_of(s, i), s->v + row(s, i),
                                     s->a + row(s, i)))

enum { INVERSE, INVERSE_RNE, INVERSE_MUJOCO, INVERSE_CONTESTANTS };

#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_rne,
    kg_mujoco_rne(k->mujoco, answer + row(s, i), q_of(s, i), s->v + row(s, i), s->a + row(s, i)))
RUN(run_mujoco_inverse, kg_mujoco_inverse(k->mujoco, answer + row(s, i), q_of(s, i),
                                          s->v + row(s, i), s->a + row(s, i)))
#endif

static const kg_bench_contestant inverses[INVERSE_CONTESTANTS] = {
  [INVERSE] = {"kinegrad", NULL, 1, create, run_inverse, destroy},
  [INVERSE_RNE] =
    MUJOCO_CONTESTANT("MuJoCo, mj_rne path", 1, create_mujoco, run_mujoco_rne, destroy),
  [INVERSE_MUJOCO] =
    MUJOCO_CONTESTANT("MuJoCo, mj_inverse", 1, create_mujoco, run_mujoco_inverse, destroy),
};
/* A pair of one with itself: microseconds a state. Absolute aims are for 23 joints. */
#define INVERSE_PAIRS(us)                                                                          \
  {                                                                                                \
    {"kinegrad, us", INVERSE, INVERSE, us}, {"kinegrad", INVERSE, INVERSE_RNE, 0.2},               \
      {"kinegrad against mj_inverse", INVERSE, INVERSE_MUJOCO, 0.0},                               \
  }
static const kg_bench_pair inverse_pairs_23[] = INVERSE_PAIRS(0.5);
static const kg_bench_pair inverse_pairs_37[] = INVERSE_PAIRS(0.0);

/* ---- mass matrix ----------------------------------------------------------------------------- */

static kg_status mass_reference(const void *data, double *answer)
{
  const states *s = data;
  const size_t nv = (size_t)s->model.body->nv;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_mass(s->model.body, answer + (size_t)i * nv * nv, q_of(s, i));
  }
  return status;
}

RUN(run_mass, kg_dynamics_mass_matrix(k->dynamics, answer + row(s, i) * (size_t)s->model.body->nv,
                                      q_of(s, i)))
#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_mass,
    kg_mujoco_mass_matrix(k->mujoco, answer + row(s, i) * (size_t)s->model.body->nv, q_of(s, i)))
#endif

static const kg_bench_contestant masses[] = {
  {"kinegrad", NULL, 1, create, run_mass, destroy},
  MUJOCO_CONTESTANT("MuJoCo, mj_crb path", 1, create_mujoco, run_mujoco_mass, destroy),
};
static const kg_bench_pair mass_pairs[] = {{"kinegrad", 0, 1, 0.0}};

/* ---- derivatives of inverse dynamics --------------------------------------------------------- */

static kg_status derivative_reference(const void *data, double *answer)
{
  const states *s = data;
  const size_t nv = (size_t)s->model.body->nv, all = (size_t)s->count * nv * nv;
  kg_status status = mass_reference(data, answer + 2 * all);
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    double *dq = answer + (size_t)i * nv * nv;
    status = kg_bench_reference_derivatives(s->model.body, dq, dq + all, q_of(s, i),
                                            s->v + row(s, i), s->a + row(s, i));
  }
  return status;
}

static kg_status run_derivatives(void *state, double *answer)
{
  kernel *k = state;
  const states *s = k->of;
  const size_t nv = (size_t)s->model.body->nv, all = (size_t)s->count * nv * nv;
  for (int i = 0; i < s->count; i++) {
    double *dq = answer + (size_t)i * nv * nv;
    kg_dynamics_inverse_derivatives(k->dynamics, dq, dq + all, dq + 2 * all, NULL, q_of(s, i),
                                    s->v + row(s, i), s->a + row(s, i));
  }
  return KG_OK;
}

static const kg_bench_contestant derivatives[] = {
  {"kinegrad", NULL, 7, create, run_derivatives, destroy},
};
static const kg_bench_pair derivative_pairs_23[] = {{"kinegrad, us", 0, 0, 10.0}};
static const kg_bench_pair derivative_pairs_37[] = {{"kinegrad, us", 0, 0, 0.0}};

/* ---- the cases ------------------------------------------------------------------------------- */

/* clang-format off */
#define CASE(title, size_of, open_function, reference_function, table, ratios)                     \
  {                                                                                                \
    .name = (title), .unit = "us", .unit_seconds = 1e-6, .tolerance = 1e-10, .detail = (size_of),  \
    .open = (open_function), .close = close, .reference = (reference_function),                    \
    .contestants = (table), .contestant_count = KG_COUNT_OF(table), .pairs = (ratios),             \
    .pair_count = KG_COUNT_OF(ratios)                                                              \
  }
/* clang-format on */

const kg_bench_case kg_bench_kernel_cases[BENCH_KERNEL_CASES] = {
  CASE("rnea_23", &vectors_23, open_vectors, inverse_reference, inverses, inverse_pairs_23),
  CASE("rnea_37", &vectors_37, open_vectors, inverse_reference, inverses, inverse_pairs_37),
  CASE("mass_matrix_23", &matrices_23, open_matrix, mass_reference, masses, mass_pairs),
  CASE("mass_matrix_37", &matrices_37, open_matrix, mass_reference, masses, mass_pairs),
  CASE("rnea_derivatives_23", &matrices_23, open_derivatives, derivative_reference, derivatives,
       derivative_pairs_23),
  CASE("rnea_derivatives_37", &matrices_37, open_derivatives, derivative_reference, derivatives,
       derivative_pairs_37),
};
