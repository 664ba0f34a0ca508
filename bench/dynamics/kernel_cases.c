/* Kinematics and dynamics of bodies in random states beside MuJoCo's pipeline.
 *
 * Both sides start from q, v, a or tau alone: MuJoCo's times include the stages that its mj_rne,
 * mj_crb or mj_factorM build on. Times are those of one state. Answers: a part per result, one row
 * a state; entries of tau and a are compared by degree of freedom. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/dynamics/cases.h"
#include "bench/dynamics/reference.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/dynamics_lanes.h"

/* Which body and how many states: few where the answers are matrices. */
typedef struct size {
  kg_bench_skeleton skeleton;
  int count;
} size;

static const size vectors_23 = {KG_BENCH_MAPPED, 32}, vectors_37 = {KG_BENCH_EVERY_JOINT, 32};
static const size matrices_23 = {KG_BENCH_MAPPED, 8}, matrices_37 = {KG_BENCH_EVERY_JOINT, 8};

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

/* all positions, then all rotations */
static kg_status open_poses(kg_bench_problem *problem, const kg_bench_setting *setting,
                            const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t n = (size_t)s->count * (size_t)s->model.body->segment_count;
    problem->parts[0] = (kg_bench_part){"positions", 3 * n, 1};
    problem->parts[1] = (kg_bench_part){"rotations", 9 * n, 1};
    problem->part_count = 2;
  }
  return status;
}

static kg_status open_momenta(kg_bench_problem *problem, const kg_bench_setting *setting,
                              const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t nv = (size_t)s->model.body->nv;
    problem->parts[0] = (kg_bench_part){"centroidal matrix", 6 * (size_t)s->count * nv, 1};
    problem->part_count = 1;
  }
  return status;
}

static kg_status open_accelerations(kg_bench_problem *problem, const kg_bench_setting *setting,
                                    const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t n = (size_t)s->count * (size_t)s->model.body->segment_count;
    problem->parts[0] = (kg_bench_part){"of the joints", 3 * n, 1};
    problem->parts[1] = (kg_bench_part){"of rotation", 3 * n, 1};
    problem->part_count = 2;
  }
  return status;
}

static kg_status open_points(kg_bench_problem *problem, const kg_bench_setting *setting,
                             const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const states *s = problem->data;
    const size_t nv = (size_t)s->model.body->nv;
    problem->parts[0] = (kg_bench_part){"Jacobian", 3 * (size_t)s->count * nv, 1};
    problem->part_count = 1;
  }
  return status;
}

/* all derivatives by q, then all by v, then all by a or tau */
static kg_status open_derivatives(kg_bench_problem *problem, const kg_bench_setting *setting,
                                  const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    static const char *const names[3] = {"by q", "by v", "by a or tau"};
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
  double *lanes; /* q, v, a and answers of the states, eight at a time: x[k][8] */
  double *wide;  /* three matrices of eight states                              */
  kg_lanes_matrix *matrix[3];
  bool is_compared;
} kernel;

static void destroy(void *state)
{
  kernel *k = state;
  for (int i = 0; i < 3; i++) {
    kg_lanes_matrix_destroy(k->matrix[i]);
  }
  kg_dynamics_destroy(k->dynamics);
#ifdef KG_BENCH_HAS_MUJOCO
  kg_mujoco_close(k->mujoco);
#endif
  free(k->lanes);
  free(k->wide);
  free(k);
}

static kernel *kernel_of(const states *of)
{
  kernel *k = calloc(1, sizeof *k);
  if (k) {
    k->of = of;
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

/* Where group g of eight states has its q, v, a and answer in lanes. */
typedef struct group {
  double *q, *v, *a, *out;
} group;

static group group_of(const kernel *k, int g)
{
  const size_t nq = (size_t)k->of->model.body->nq, nv = (size_t)k->of->model.body->nv;
  double *at = k->lanes + (size_t)g * 8 * (nq + 3 * nv);
  return (group){at, at + 8 * nq, at + 8 * (nq + nv), at + 8 * (nq + 2 * nv)};
}

static void to_lanes(double *lanes, const double *rows, int n)
{
  for (int f = 0; f < 8; f++) {
    for (int k = 0; k < n; k++) {
      lanes[8 * k + f] = rows[f * n + k];
    }
  }
}

static kg_status create_lanes(void **state, const void *data, const kg_allocator *allocator)
{
  const kg_status status = create(state, data, allocator);
  if (status != KG_OK) {
    return status;
  }
  kernel *k = *state;
  const states *s = k->of;
  const int nq = s->model.body->nq, nv = s->model.body->nv;
  KG_ASSERT(s->count % 8 == 0);
  k->lanes = calloc((size_t)s->count * (size_t)(nq + 3 * nv), sizeof *k->lanes);
  if (!k->lanes) {
    destroy(k);
    return KG_ERR_NO_MEMORY;
  }
  for (int g = 0; g < s->count / 8; g++) {
    const group at = group_of(k, g);
    to_lanes(at.q, s->q + 8 * g * nq, nq);
    to_lanes(at.v, s->v + 8 * g * nv, nv);
    to_lanes(at.a, s->a + 8 * g * nv, nv);
  }
  return KG_OK;
}

/* With room for matrices. */
static kg_status create_wide(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_lanes(state, data, allocator);
  if (status != KG_OK) {
    return status;
  }
  kernel *k = *state;
  const size_t nv = (size_t)k->of->model.body->nv;
  k->wide = calloc(24 * nv * nv, sizeof *k->wide);
  status = k->wide ? KG_OK : KG_ERR_NO_MEMORY;
  for (int i = 0; i < 3 && status == KG_OK; i++) {
    status = kg_lanes_matrix_create(&k->matrix[i], k->dynamics, allocator);
  }
  if (status != KG_OK) {
    destroy(k);
  }
  return status;
}

/* Rows of the eight states of group g out of lanes: count numbers a state, from wide. */
static void rows_of_group(const kernel *k, int g, const double *lanes, size_t count, double *answer)
{
  for (size_t f = 0; f < 8 && !k->is_compared; f++) {
    for (size_t j = 0; j < count; j++) {
      answer[(8 * (size_t)g + f) * count + j] = lanes[8 * j + f];
    }
  }
}

/* The same of a matrix of the tree. */
static void rows_of_matrix(const kernel *k, int g, const kg_lanes_matrix *matrix, double *answer)
{
  const size_t nv = (size_t)k->of->model.body->nv;
  for (int f = 0; f < 8 && !k->is_compared; f++) {
    kg_lanes_matrix_dense(matrix, f, answer + (8 * (size_t)g + (size_t)f) * nv * nv);
  }
}

/* Only the first answer is looked at: the runs that are timed leave theirs in lanes. */
static void answer_from_lanes(kernel *k, double *answer)
{
  const int nv = k->of->model.body->nv;
  for (int i = 0; i < k->of->count && !k->is_compared; i++) {
    const group at = group_of(k, i / 8);
    for (int j = 0; j < nv; j++) {
      answer[i * nv + j] = at.out[8 * j + i % 8];
    }
  }
  k->is_compared = true;
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

/* A run: the call for every state i of s. */
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

/* A run in lanes: the call for every group g of eight states, at which q, v, a and the answer are. */
#define RUN_LANES(name, call)                                                                      \
  static kg_status name(void *state, double *answer)                                               \
  {                                                                                                \
    kernel *k = state;                                                                             \
    const states *s = k->of;                                                                       \
    const size_t nv = (size_t)s->model.body->nv, n = (size_t)s->model.body->segment_count;         \
    (void)nv, (void)n, (void)answer;                                                               \
    for (int g = 0; g < s->count / 8; g++) {                                                       \
      const group at = group_of(k, g);                                                             \
      call;                                                                                        \
    }                                                                                              \
    k->is_compared = true;                                                                         \
    return KG_OK;                                                                                  \
  }

/* ---- kinematics ------------------------------------------------------------------------------ */

static double *positions(const states *s, int i, double *answer)
{
  return answer + 3 * (size_t)i * (size_t)s->model.body->segment_count;
}

static double *rotations(const states *s, int i, double *answer)
{
  return answer + (3 * (size_t)s->count + 9 * (size_t)i) * (size_t)s->model.body->segment_count;
}

static kg_status pose_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_pose(s->model.body, positions(s, i, answer),
                                     rotations(s, i, answer), q_of(s, i));
  }
  return status;
}

RUN(run_pose, kg_dynamics_pose(k->dynamics, q_of(s, i), (kg_vec3 *)positions(s, i, answer),
                               (kg_mat3 *)rotations(s, i, answer)))
#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_pose,
    kg_mujoco_pose(k->mujoco, positions(s, i, answer), rotations(s, i, answer), q_of(s, i)))
#endif

static kg_status run_pose_many(void *state, double *answer)
{
  kernel *k = state;
  const states *s = k->of;
  kg_dynamics_velocity_many(k->dynamics, s->count, s->q, NULL, (kg_vec3 *)positions(s, 0, answer),
                            (kg_mat3 *)rotations(s, 0, answer), NULL, NULL);
  return KG_OK;
}

RUN_LANES(run_pose_lanes, {
  double *p = k->wide;
  double *R = p + 8 * 3 * n;
  kg_dynamics_velocity_lanes(k->dynamics, at.q, NULL, p, R, NULL, NULL);
  rows_of_group(k, g, p, 3 * n, answer);
  rows_of_group(k, g, R, 9 * n, answer + 3 * (size_t)s->count * n);
})

static const kg_bench_contestant poses[] = {
  {"kinegrad", NULL, 3, create, run_pose, destroy},
  MUJOCO_CONTESTANT("MuJoCo, mj_kinematics", 3, create_mujoco, run_mujoco_pose, destroy),
  {"kinegrad, many", NULL, 3, create, run_pose_many, destroy},
  {"kinegrad, in lanes", NULL, 3, create_wide, run_pose_lanes, destroy},
};
static const kg_bench_pair pose_pairs[] = {{"kinegrad", 0, 1, 0.0},
                                           {"kinegrad many", 2, 1, 0.0},
                                           {"kinegrad in lanes", 3, 1, 0.0},
                                           {"lanes against one state", 3, 0, 1.0}};

/* ---- accelerations --------------------------------------------------------------------------- */

static double *joint_accelerations(const states *s, int i, double *answer)
{
  return answer + 3 * (size_t)i * (size_t)s->model.body->segment_count;
}

static double *angular_accelerations(const states *s, int i, double *answer)
{
  return joint_accelerations(s, s->count + i, answer);
}

static kg_status acceleration_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_acceleration(s->model.body, joint_accelerations(s, i, answer),
                                             angular_accelerations(s, i, answer), q_of(s, i),
                                             s->v + row(s, i), s->a + row(s, i));
  }
  return status;
}

RUN(run_acceleration,
    kg_dynamics_acceleration(k->dynamics, q_of(s, i), s->v + row(s, i), s->a + row(s, i),
                             (kg_vec3 *)joint_accelerations(s, i, answer),
                             (kg_vec3 *)angular_accelerations(s, i, answer)))
RUN_LANES(run_acceleration_lanes, {
  double *p_ddot = k->wide;
  double *alpha = p_ddot + 8 * 3 * n;
  kg_dynamics_acceleration_lanes(k->dynamics, at.q, at.v, at.a, p_ddot, alpha);
  rows_of_group(k, g, p_ddot, 3 * n, answer);
  rows_of_group(k, g, alpha, 3 * n, answer + 3 * (size_t)s->count * n);
})

static const kg_bench_contestant accelerations[] = {
  {"kinegrad", NULL, 3, create, run_acceleration, destroy},
  {"kinegrad, in lanes", NULL, 3, create_wide, run_acceleration_lanes, destroy},
};
/* bar of lanes: not slower than one state at a time */
static const kg_bench_pair lanes_pairs[] = {{"kinegrad, us", 0, 0, 0.0},
                                            {"kinegrad in lanes, us", 1, 1, 0.0},
                                            {"lanes against one state", 1, 0, 1.0}};

/* ---- points ---------------------------------------------------------------------------------- */

static const double point_place[3] = {0.03, -0.12, 0.07};

static kg_body_point point_of(const states *s)
{
  return (kg_body_point){s->model.body->segment_count - 1,
                         {point_place[0], point_place[1], point_place[2]}};
}

static kg_status point_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status =
      kg_bench_reference_point(s->model.body, answer + 3 * row(s, i), q_of(s, i), point_of(s).p);
  }
  return status;
}

RUN(run_point, kg_dynamics_point(k->dynamics, answer + 3 * row(s, i), q_of(s, i), point_of(s)))
RUN_LANES(run_point_lanes, {
  double x[24];
  kg_dynamics_point_lanes(k->dynamics, x, k->wide, at.q, point_of(s));
  rows_of_group(k, g, k->wide, 3 * nv, answer);
})
#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_point, kg_mujoco_point(k->mujoco, answer + 3 * row(s, i), q_of(s, i), point_place))
#endif

static const kg_bench_contestant points[] = {
  {"kinegrad", NULL, 1, create, run_point, destroy},
  {"kinegrad, in lanes", NULL, 1, create_wide, run_point_lanes, destroy},
  MUJOCO_CONTESTANT("MuJoCo, mj_jac path", 1, create_mujoco, run_mujoco_point, destroy),
};
static const kg_bench_pair point_pairs[] = {{"kinegrad", 0, 2, 0.0},
                                            {"kinegrad in lanes", 1, 2, 0.0},
                                            {"lanes against one state", 1, 0, 1.0}};

/* ---- momentum -------------------------------------------------------------------------------- */

static double *centroidal(const states *s, int i, double *answer)
{
  return answer + 6 * row(s, i);
}

static kg_status momentum_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_centroidal(s->model.body, centroidal(s, i, answer), q_of(s, i));
  }
  return status;
}

RUN(run_momentum, kg_dynamics_centroidal_matrix(k->dynamics, centroidal(s, i, answer), q_of(s, i)))

RUN_LANES(run_momentum_lanes, {
  kg_dynamics_centroidal_matrix_lanes(k->dynamics, k->wide, at.q);
  rows_of_group(k, g, k->wide, 6 * nv, answer);
})

static const kg_bench_contestant momenta[] = {
  {"kinegrad", NULL, 1, create, run_momentum, destroy},
  {"kinegrad, in lanes", NULL, 1, create_wide, run_momentum_lanes, destroy},
};

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

static kg_status run_inverse_many(void *state, double *answer)
{
  kernel *k = state;
  const states *s = k->of;
  kg_dynamics_inverse_many(k->dynamics, s->count, answer, s->q, s->v, s->a);
  return KG_OK;
}

static kg_status run_inverse_lanes(void *state, double *answer)
{
  kernel *k = state;
  for (int g = 0; g < k->of->count / 8; g++) {
    const group at = group_of(k, g);
    kg_dynamics_inverse_lanes(k->dynamics, at.out, at.q, at.v, at.a);
  }
  answer_from_lanes(k, answer);
  return KG_OK;
}

#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_rne,
    kg_mujoco_rne(k->mujoco, answer + row(s, i), q_of(s, i), s->v + row(s, i), s->a + row(s, i)))
RUN(run_mujoco_inverse, kg_mujoco_inverse(k->mujoco, answer + row(s, i), q_of(s, i),
                                          s->v + row(s, i), s->a + row(s, i)))
#endif

/* one state a call, many rows, many in lanes, MuJoCo's stages, MuJoCo's whole call */
enum { ONE, MANY, LANES, STAGES, WHOLE, VECTOR_CONTESTANTS };

static const kg_bench_contestant inverses[VECTOR_CONTESTANTS] = {
  [ONE] = {"kinegrad", NULL, 1, create, run_inverse, destroy},
  [MANY] = {"kinegrad, many", NULL, 1, create, run_inverse_many, destroy},
  [LANES] = {"kinegrad, many in lanes", NULL, 1, create_lanes, run_inverse_lanes, destroy},
  [STAGES] = MUJOCO_CONTESTANT("MuJoCo, mj_rne path", 1, create_mujoco, run_mujoco_rne, destroy),
  [WHOLE] = MUJOCO_CONTESTANT("MuJoCo, mj_inverse", 1, create_mujoco, run_mujoco_inverse, destroy),
};
/* A pair of one with itself: microseconds a state. Absolute aims are for 23 joints. */
/* batch: of the form in lanes; "many" pays for turning rows into lanes and back */
#define VECTOR_PAIRS(us, one, batch)                                                               \
  {                                                                                                \
    {"kinegrad, us", ONE, ONE, us}, {"kinegrad", ONE, STAGES, one},                                \
      {"kinegrad many", MANY, STAGES, 0.0}, {"kinegrad in lanes", LANES, STAGES, batch},           \
      {"against the whole call", ONE, WHOLE, 0.0},                                                 \
  }
static const kg_bench_pair inverse_pairs_23[] = VECTOR_PAIRS(0.5, 0.2, 1.0 / 30.0);
static const kg_bench_pair inverse_pairs_37[] = VECTOR_PAIRS(0.0, 0.2, 1.0 / 30.0);

/* ---- forward dynamics ------------------------------------------------------------------------ */

/* The numbers that are accelerations above serve as tau, in N m and N. */
static kg_status forward_reference(const void *data, double *answer)
{
  const states *s = data;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    status = kg_bench_reference_forward(s->model.body, answer + row(s, i), q_of(s, i),
                                        s->v + row(s, i), s->a + row(s, i));
  }
  return status;
}

RUN(run_forward, kg_dynamics_forward(k->dynamics, answer + row(s, i), q_of(s, i), s->v + row(s, i),
                                     s->a + row(s, i)))

static kg_status run_forward_many(void *state, double *answer)
{
  kernel *k = state;
  const states *s = k->of;
  kg_dynamics_forward_many(k->dynamics, s->count, answer, s->q, s->v, s->a);
  return KG_OK;
}

static kg_status run_forward_lanes(void *state, double *answer)
{
  kernel *k = state;
  for (int g = 0; g < k->of->count / 8; g++) {
    const group at = group_of(k, g);
    kg_dynamics_forward_lanes(k->dynamics, at.out, at.q, at.v, at.a);
  }
  answer_from_lanes(k, answer);
  return KG_OK;
}

#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_smooth, kg_mujoco_smooth_forward(k->mujoco, answer + row(s, i), q_of(s, i),
                                                s->v + row(s, i), s->a + row(s, i)))
RUN(run_mujoco_forward, kg_mujoco_forward(k->mujoco, answer + row(s, i), q_of(s, i),
                                          s->v + row(s, i), s->a + row(s, i)))
#endif

static const kg_bench_contestant forwards[VECTOR_CONTESTANTS] = {
  [ONE] = {"kinegrad", NULL, 1, create, run_forward, destroy},
  [MANY] = {"kinegrad, many", NULL, 1, create, run_forward_many, destroy},
  [LANES] = {"kinegrad, many in lanes", NULL, 1, create_lanes, run_forward_lanes, destroy},
  [STAGES] =
    MUJOCO_CONTESTANT("MuJoCo, smooth stages", 1, create_mujoco, run_mujoco_smooth, destroy),
  [WHOLE] = MUJOCO_CONTESTANT("MuJoCo, mj_forward", 1, create_mujoco, run_mujoco_forward, destroy),
};
static const kg_bench_pair forward_pairs[] = VECTOR_PAIRS(0.0, 0.0, 0.0);

/* ---- M^-1 x ---------------------------------------------------------------------------------- */

static kg_status solve_reference(const void *data, double *answer)
{
  const states *s = data;
  const size_t nv = (size_t)s->model.body->nv;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    memcpy(answer + row(s, i), s->a + row(s, i), nv * sizeof *answer);
    status = kg_bench_reference_solve(s->model.body, answer + row(s, i), q_of(s, i));
  }
  return status;
}

static double *start_of_solve(const states *s, int i, double *answer)
{
  double *x = answer + row(s, i);
  memcpy(x, s->a + row(s, i), (size_t)s->model.body->nv * sizeof *x);
  return x;
}

RUN(run_solve, kg_dynamics_mass_solve(k->dynamics, start_of_solve(s, i, answer), q_of(s, i)))
#ifdef KG_BENCH_HAS_MUJOCO
RUN(run_mujoco_solve, kg_mujoco_mass_solve(k->mujoco, start_of_solve(s, i, answer), q_of(s, i)))
#endif

RUN_LANES(run_solve_lanes, {
  memcpy(at.out, at.a, 8 * nv * sizeof *at.out);
  kg_dynamics_mass_solve_lanes(k->dynamics, at.out, at.q);
  rows_of_group(k, g, at.out, nv, answer);
})

/* M, its factors and the solution */
static kg_status run_factor_lanes(void *state, double *answer)
{
  kernel *k = state;
  const size_t nv = (size_t)k->of->model.body->nv;
  for (int g = 0; g < k->of->count / 8; g++) {
    const group at = group_of(k, g);
    memcpy(at.out, at.a, 8 * nv * sizeof *at.out);
    kg_dynamics_mass_matrix_lanes(k->dynamics, k->matrix[0], at.q);
    if (kg_lanes_matrix_factor(k->matrix[0]) != 0) {
      return KG_ERR_UNDEFINED;
    }
    kg_lanes_matrix_solve(k->matrix[0], at.out);
  }
  answer_from_lanes(k, answer);
  return KG_OK;
}

static const kg_bench_contestant solves[] = {
  {"kinegrad", NULL, 1, create, run_solve, destroy},
  MUJOCO_CONTESTANT("MuJoCo, mj_factorM path", 1, create_mujoco, run_mujoco_solve, destroy),
  {"kinegrad, in lanes", NULL, 1, create_wide, run_solve_lanes, destroy},
  {"kinegrad, in lanes, M factored", NULL, 1, create_wide, run_factor_lanes, destroy},
};
static const kg_bench_pair solve_pairs[] = {{"kinegrad", 0, 1, 0.0},
                                            {"kinegrad in lanes", 2, 1, 0.0},
                                            {"lanes, M factored", 3, 1, 0.0},
                                            {"lanes against one state", 2, 0, 1.0}};

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

/* Matrices of the tree stay as they are in the runs that are timed. */
RUN_LANES(run_mass_lanes, {
  kg_dynamics_mass_matrix_lanes(k->dynamics, k->matrix[0], at.q);
  rows_of_matrix(k, g, k->matrix[0], answer);
})

static const kg_bench_contestant masses[] = {
  {"kinegrad", NULL, 1, create, run_mass, destroy},
  MUJOCO_CONTESTANT("MuJoCo, mj_crb path", 1, create_mujoco, run_mujoco_mass, destroy),
  {"kinegrad, in lanes, sparse", NULL, 1, create_wide, run_mass_lanes, destroy},
};
static const kg_bench_pair mass_pairs[] = {{"kinegrad", 0, 1, 0.0},
                                           {"kinegrad in lanes", 2, 1, 0.0},
                                           {"lanes against one state", 2, 0, 1.0}};

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

RUN_LANES(run_derivatives_lanes, {
  kg_dynamics_inverse_derivatives_lanes(k->dynamics, k->matrix[0], k->matrix[1], k->matrix[2], NULL,
                                        at.q, at.v, at.a);
  for (size_t part = 0; part < 3; part++) {
    rows_of_matrix(k, g, k->matrix[part], answer + part * (size_t)s->count * nv * nv);
  }
})

static const kg_bench_contestant derivatives[] = {
  {"kinegrad", NULL, 7, create, run_derivatives, destroy},
  {"kinegrad, in lanes, sparse", NULL, 7, create_wide, run_derivatives_lanes, destroy},
};
static const kg_bench_pair derivative_pairs_23[] = {{"kinegrad, us", 0, 0, 10.0},
                                                    {"kinegrad in lanes, us", 1, 1, 0.0},
                                                    {"lanes against one state", 1, 0, 1.0}};

/* ---- derivatives of forward dynamics --------------------------------------------------------- */

static kg_status forward_derivative_reference(const void *data, double *answer)
{
  const states *s = data;
  const size_t nv = (size_t)s->model.body->nv, all = (size_t)s->count * nv * nv;
  kg_status status = KG_OK;
  for (int i = 0; i < s->count && status == KG_OK; i++) {
    double *dq = answer + (size_t)i * nv * nv;
    status = kg_bench_reference_forward_derivatives(s->model.body, dq, dq + all, dq + 2 * all,
                                                    q_of(s, i), s->v + row(s, i), s->a + row(s, i));
  }
  return status;
}

static kg_status run_forward_derivatives(void *state, double *answer)
{
  kernel *k = state;
  const states *s = k->of;
  const size_t nv = (size_t)s->model.body->nv, all = (size_t)s->count * nv * nv;
  for (int i = 0; i < s->count; i++) {
    double *dq = answer + (size_t)i * nv * nv;
    kg_dynamics_forward_derivatives(k->dynamics, dq, dq + all, dq + 2 * all, NULL, q_of(s, i),
                                    s->v + row(s, i), s->a + row(s, i));
  }
  return KG_OK;
}

RUN_LANES(run_forward_derivatives_lanes, {
  double *out = k->wide;
  const size_t all = 8 * nv * nv;
  kg_dynamics_forward_derivatives_lanes(k->dynamics, out, out + all, out + 2 * all, NULL, at.q,
                                        at.v, at.a);
  for (size_t part = 0; part < 3; part++) {
    rows_of_group(k, g, out + part * all, nv * nv, answer + part * (size_t)s->count * nv * nv);
  }
})

static const kg_bench_contestant forward_derivatives[] = {
  {"kinegrad", NULL, 7, create, run_forward_derivatives, destroy},
  {"kinegrad, in lanes", NULL, 7, create_wide, run_forward_derivatives_lanes, destroy},
};

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
  CASE("kinematics_23", &vectors_23, open_poses, pose_reference, poses, pose_pairs),
  CASE("kinematics_37", &vectors_37, open_poses, pose_reference, poses, pose_pairs),
  CASE("accelerations_23", &vectors_23, open_accelerations, acceleration_reference, accelerations,
       lanes_pairs),
  CASE("accelerations_37", &vectors_37, open_accelerations, acceleration_reference, accelerations,
       lanes_pairs),
  CASE("point_23", &vectors_23, open_points, point_reference, points, point_pairs),
  CASE("point_37", &vectors_37, open_points, point_reference, points, point_pairs),
  CASE("rnea_23", &vectors_23, open_vectors, inverse_reference, inverses, inverse_pairs_23),
  CASE("rnea_37", &vectors_37, open_vectors, inverse_reference, inverses, inverse_pairs_37),
  CASE("forward_23", &vectors_23, open_vectors, forward_reference, forwards, forward_pairs),
  CASE("forward_37", &vectors_37, open_vectors, forward_reference, forwards, forward_pairs),
  CASE("mass_solve_23", &vectors_23, open_vectors, solve_reference, solves, solve_pairs),
  CASE("mass_solve_37", &vectors_37, open_vectors, solve_reference, solves, solve_pairs),
  CASE("mass_matrix_23", &matrices_23, open_matrix, mass_reference, masses, mass_pairs),
  CASE("mass_matrix_37", &matrices_37, open_matrix, mass_reference, masses, mass_pairs),
  CASE("centroidal_23", &vectors_23, open_momenta, momentum_reference, momenta, lanes_pairs),
  CASE("centroidal_37", &vectors_37, open_momenta, momentum_reference, momenta, lanes_pairs),
  CASE("rnea_derivatives_23", &matrices_23, open_derivatives, derivative_reference, derivatives,
       derivative_pairs_23),
  CASE("rnea_derivatives_37", &matrices_37, open_derivatives, derivative_reference, derivatives,
       lanes_pairs),
  CASE("forward_derivatives_23", &matrices_23, open_derivatives, forward_derivative_reference,
       forward_derivatives, lanes_pairs),
  CASE("forward_derivatives_37", &matrices_37, open_derivatives, forward_derivative_reference,
       forward_derivatives, lanes_pairs),
};
