/* Derivatives of the upper floors, each against differences of the function it belongs to.
 *
 * Poses are moved in tangent space: the value of a row is f(q (+) d), its derivative is asked for
 * at d = 0 (docs/theory/dynamics.md). Positions near the ground are measured in layers of the
 * contact law, velocities there in stick velocities, so that one step fits all of them. */
#include "cli/gradcheck.h"
#include "cli/gradcheck_operators.h"

#include <math.h>
#include <string.h>

#include "kinegrad/arena.h"
#include "kinegrad/contact.h"
#include "kinegrad/correction.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/random.h"
#include "kinegrad/step.h"

struct cli_models {
  kg_arena arena;
  kg_random random;
  const kg_subject *subject; /* NULL: the small body */
  kg_body *own;
  const kg_body *body;
  kg_scene ground, shapes; /* shapes: the one under test is number `shape` */
  kg_contact_params contact;
  kg_height_field *field;
  kg_mesh *mesh;
  kg_dynamics *dynamics;
  kg_step *step;
  kg_correction *correction;
  cli_operators *operators;
  double dt;
  int shape;
  double *q, *moved, *v, *a; /* the state of the point */
  double *J, *part[3];       /* Jacobian of the row; (nv, nv) each */
  kg_vec3 position, velocity;
};

static kg_vec3 load(const double *p)
{
  return kg_vec3_make(p[0], p[1], p[2]);
}

static void store(double *p, kg_vec3 a)
{
  p[0] = a.x;
  p[1] = a.y;
  p[2] = a.z;
}

static kg_vec3 random_vector(cli_models *m, double size)
{
  double x[3];
  for (int k = 0; k < 3; k++) {
    x[k] = size * kg_random_normal(&m->random);
  }
  return load(x);
}

static size_t nv_of(const cli_models *m)
{
  return (size_t)m->body->nv;
}

/* ---- rotations ------------------------------------------------------------------------------- */

/* log(exp(r)^-1 exp(r + x)) */
static void prepare_rotation(cli_models *m, double *x)
{
  const double size = kg_random_uniform(&m->random) < 0.3 ? 1e-4 : 1.0;
  m->position = random_vector(m, size);
  memset(x, 0, 3 * sizeof *x);
}

static void rotation_value(cli_models *m, const double *x, double *y)
{
  const kg_quat from = kg_quat_exp(m->position);
  const kg_quat to = kg_quat_exp(kg_vec3_add(m->position, load(x)));
  store(y, kg_quat_log(kg_quat_mul(kg_quat_conj(from), to)));
}

static void rotation_jacobian(cli_models *m, const double *x, double *J)
{
  (void)x;
  const kg_mat3 Jr = kg_so3_right_jacobian(m->position);
  memcpy(J, Jr.m, sizeof Jr.m);
}

/* ---- signed distances ------------------------------------------------------------------------ */

enum { SHAPES = 11, BALL = 1, MOVING = 10 };

static kg_sdf_value distance(const cli_models *m, kg_vec3 x)
{
  kg_sdf_value value;
  (void)kg_scene_shape_distance(&m->shapes, m->shape, x, INFINITY, &value);
  return value;
}

/* Whether the normal turns smoothly around x: not across the border between the regions of two
 * faces or edges, where its derivative jumps. There its second difference is of order h over the
 * distance, elsewhere of its square. */
static bool turns_smoothly(const cli_models *m, kg_vec3 x)
{
  const double h = 0.02;
  const kg_sdf_value at = distance(m, x);
  if (fabs(at.distance) < 5 * h) return false;
  const kg_vec3 axes[3] = {{h, 0, 0}, {0, h, 0}, {0, 0, h}};
  for (int k = 0; k < 3; k++) {
    const kg_vec3 plus = distance(m, kg_vec3_add(x, axes[k])).normal;
    const kg_vec3 minus = distance(m, kg_vec3_sub(x, axes[k])).normal;
    const kg_vec3 bend = kg_vec3_add_scaled(kg_vec3_add(plus, minus), -2, at.normal);
    if (kg_vec3_norm(bend) > 0.2 * h / fabs(at.distance)) return false;
  }
  return true;
}

static void prepare_distance(cli_models *m, double *x)
{
  kg_vec3 at;
  do {
    at = random_vector(m, 0.5);
  } while (!turns_smoothly(m, at));
  store(x, at);
}

static void distance_value(cli_models *m, const double *x, double *y)
{
  *y = distance(m, load(x)).distance;
}

static void distance_jacobian(cli_models *m, const double *x, double *J)
{
  store(J, distance(m, load(x)).normal);
}

static void normal_value(cli_models *m, const double *x, double *y)
{
  store(y, distance(m, load(x)).normal);
}

static void normal_jacobian(cli_models *m, const double *x, double *J)
{
  const kg_sdf_value s = distance(m, load(x));
  const double *h = s.hessian;
  const double H[9] = {h[0], h[3], h[4], h[3], h[1], h[5], h[4], h[5], h[2]};
  memcpy(J, H, sizeof H);
}

/* ---- contact --------------------------------------------------------------------------------- */

/* A point at Phi between -0.1 and 0.9 layers of the body, or as far as that into the one of the
 * ground, moving up to a few stick velocities against the shape. */
static void prepare_contact(cli_models *m, double *x)
{
  const kg_ground *ground = m->shape == MOVING ? &m->shapes.grounds[0] : NULL;
  kg_vec3 at;
  do {
    at = random_vector(m, 0.8);
  } while (distance(m, at).distance < 0.0);
  const double share = kg_random_uniform(&m->random) - 0.1, layer = m->contact.layer;
  const kg_sdf_value from = distance(m, at);
  const double phi = share * (ground ? layer + ground->thickness : layer);
  m->position = kg_vec3_add_scaled(at, phi - from.distance, from.normal);
  m->velocity = random_vector(m, m->contact.stick);
  if (ground) {
    const kg_vec3 moves = kg_place_velocity(&m->shapes.places[0], m->position);
    m->velocity = kg_vec3_add(m->velocity, moves);
  }
  memset(x, 0, 6 * sizeof *x);
}

static kg_contact_force contact_at(const cli_models *m, const double *x)
{
  kg_scene one = m->shapes;
  one.shape_count = 1;
  one.shapes[0] = m->shapes.shapes[m->shape];
  one.shapes[0].part = false; /* the ball also belongs to combinations */
  kg_contact_force force;
  kg_contact_evaluate(&m->contact, &one, kg_vec3_add_scaled(m->position, m->contact.layer, load(x)),
                      kg_vec3_add_scaled(m->velocity, m->contact.stick, load(x + 3)), true, &force);
  return force;
}

static void contact_value(cli_models *m, const double *x, double *y)
{
  store(y, contact_at(m, x).f);
}

static void contact_jacobian(cli_models *m, const double *x, double *J)
{
  const kg_contact_force force = contact_at(m, x);
  for (int row = 0; row < 3; row++) {
    for (int k = 0; k < 3; k++) {
      J[6 * row + k] = m->contact.layer * force.df_dx.m[3 * row + k];
      J[6 * row + 3 + k] = m->contact.stick * force.df_du.m[3 * row + k];
    }
  }
}

/* ---- dynamics -------------------------------------------------------------------------------- */

static void random_pose(cli_models *m)
{
  store(m->q, random_vector(m, 1.0));
  for (int i = 0; i < m->body->segment_count; i++) {
    const kg_quat r = kg_quat_exp(random_vector(m, 0.5));
    memcpy(m->q + 3 + 4 * i, &r, 4 * sizeof(double));
  }
}

/* a frame of the clip with its velocity, or a random state of the small body */
static void prepare_state(cli_models *m)
{
  for (size_t k = 0; k < nv_of(m); k++) {
    m->v[k] = kg_random_normal(&m->random);
    m->a[k] = 5 * kg_random_normal(&m->random);
  }
  const kg_subject *s = m->subject;
  if (!s) {
    random_pose(m);
    return;
  }
  const int last = s->frame_count - 1;
  const int frame = (int)(kg_random_uniform(&m->random) * last);
  const double *q = s->q + (size_t)frame * (size_t)m->body->nq;
  memcpy(m->q, q, (size_t)m->body->nq * sizeof *q);
  if (last > 0) kg_body_difference(m->body, m->v, q + m->body->nq, q);
  for (size_t k = 0; last > 0 && k < nv_of(m); k++) {
    m->v[k] /= s->dt;
  }
}

/* x = (d, v, a) */
static void prepare_inverse(cli_models *m, double *x)
{
  prepare_state(m);
  memset(x, 0, nv_of(m) * sizeof *x);
  memcpy(x + nv_of(m), m->v, nv_of(m) * sizeof *x);
  memcpy(x + 2 * nv_of(m), m->a, nv_of(m) * sizeof *x);
}

static void inverse_value(cli_models *m, const double *x, double *y)
{
  kg_body_integrate(m->body, m->moved, m->q, x);
  kg_dynamics_inverse(m->dynamics, y, m->moved, x + nv_of(m), x + 2 * nv_of(m));
}

static void inverse_jacobian(cli_models *m, const double *x, double *J)
{
  const size_t nv = nv_of(m);
  kg_dynamics_inverse_derivatives(m->dynamics, m->part[0], m->part[1], m->part[2], NULL, m->q,
                                  x + nv, x + 2 * nv);
  for (size_t row = 0; row < nv; row++) {
    for (size_t k = 0; k < 3; k++) {
      memcpy(J + (3 * row + k) * nv, m->part[k] + row * nv, nv * sizeof *J);
    }
  }
}

static void prepare_pose(cli_models *m, double *x)
{
  prepare_state(m);
  memset(x, 0, nv_of(m) * sizeof *x);
}

static kg_body_point last_point(const cli_models *m)
{
  return m->body->points[m->body->point_count - 1];
}

static void point_value(cli_models *m, const double *x, double *y)
{
  kg_body_integrate(m->body, m->moved, m->q, x);
  store(y, kg_dynamics_point(m->dynamics, NULL, m->moved, last_point(m)));
}

static void point_jacobian(cli_models *m, const double *x, double *J)
{
  (void)x;
  kg_dynamics_point(m->dynamics, J, m->q, last_point(m));
}

/* Kinetic energy over velocities: its gradient is M v. */
static void prepare_energy(cli_models *m, double *x)
{
  prepare_state(m);
  memcpy(x, m->v, nv_of(m) * sizeof *x);
}

static void energy_value(cli_models *m, const double *x, double *y)
{
  *y = kg_dynamics_energy(m->dynamics, m->q, x);
}

static void energy_jacobian(cli_models *m, const double *x, double *J)
{
  const size_t nv = nv_of(m);
  kg_dynamics_mass_matrix(m->dynamics, m->part[0], m->q);
  for (size_t row = 0; row < nv; row++) {
    J[row] = 0;
    for (size_t k = 0; k < nv; k++) {
      J[row] += m->part[0][row * nv + k] * x[k];
    }
  }
}

/* ---- the step and the penetration loss ------------------------------------------------------- */

/* the pose with its lowest point so many metres above the ground */
static void set_down(cli_models *m, double height)
{
  double lowest = HUGE_VAL;
  for (int i = 0; i < m->body->point_count; i++) {
    const kg_vec3 p = kg_dynamics_point(m->dynamics, NULL, m->q, m->body->points[i]);
    lowest = fmin(lowest, kg_scene_distance(&m->ground, p).distance);
  }
  m->q[1] += height - lowest;
}

/* x = v': slow enough that the point in contact slips by a few stick velocities */
static void prepare_step(cli_models *m, double *x)
{
  prepare_state(m);
  set_down(m, m->contact.layer * (0.2 + 0.6 * kg_random_uniform(&m->random)));
  for (size_t k = 0; k < nv_of(m); k++) {
    x[k] = m->v[k] = 3 * m->contact.stick * kg_random_normal(&m->random);
  }
}

static void step_value(cli_models *m, const double *x, double *y)
{
  kg_step_residual(m->step, y, NULL, x, m->q, m->v, NULL, m->dt, NULL);
}

static void step_jacobian(cli_models *m, const double *x, double *J)
{
  kg_step_residual(m->step, m->a, J, x, m->q, m->v, NULL, m->dt, NULL);
}

/* the same in the air, as fast as it comes */
static void prepare_flight(cli_models *m, double *x)
{
  prepare_state(m);
  set_down(m, 1.0);
  memcpy(x, m->v, nv_of(m) * sizeof *x);
}

static void prepare_penetration(cli_models *m, double *x)
{
  prepare_pose(m, x);
  set_down(m, -0.02);
}

static void penetration_value(cli_models *m, const double *x, double *y)
{
  kg_body_integrate(m->body, m->moved, m->q, x);
  kg_penetration(m->correction, m->moved, y, NULL);
}

static void penetration_jacobian(cli_models *m, const double *x, double *J)
{
  double loss;
  (void)x;
  kg_penetration(m->correction, m->q, &loss, J);
}

/* ---- the table ------------------------------------------------------------------------------- */

/* sizes are plain numbers, or so many times nv when negative */
typedef struct model {
  const char *name;
  int inputs, outputs;
  int shape; /* of the distance rows */
  void (*prepare)(cli_models *m, double *x);
  void (*value)(cli_models *m, const double *x, double *y);
  void (*jacobian)(cli_models *m, const double *x, double *J);
} model;

/* clang-format off */
#define DISTANCE(name, shape)                                                                      \
  {"distance to " name, 3, 1, shape, prepare_distance, distance_value, distance_jacobian},         \
  {"normal of " name,   3, 3, shape, prepare_distance, normal_value, normal_jacobian}
static const model table[] = {
  {"rotation, right Jacobian",  3, 3, 0, prepare_rotation, rotation_value, rotation_jacobian},
  DISTANCE("plane", 0), DISTANCE("sphere", 1), DISTANCE("box", 2), DISTANCE("capsule", 3),
  DISTANCE("height field", 4), DISTANCE("mesh", 5), DISTANCE("ellipsoid", 6), DISTANCE("cylinder", 7),
  DISTANCE("intersection", 8), DISTANCE("smooth union", 9), DISTANCE("moved ellipsoid", MOVING),
  {"contact force",             6, 3, BALL, prepare_contact, contact_value, contact_jacobian},
  {"contact force, soft and moving", 6, 3, MOVING, prepare_contact, contact_value, contact_jacobian},
  {"position of a body point", -1, 3, 0, prepare_pose, point_value, point_jacobian},
  {"kinetic energy, M v",      -1, 1, 0, prepare_energy, energy_value, energy_jacobian},
  {"inverse dynamics (q, v, a)", -3, -1, 0, prepare_inverse, inverse_value, inverse_jacobian},
  {"step residual in contact", -1, -1, 0, prepare_step, step_value, step_jacobian},
  {"step residual in flight",  -1, -1, 0, prepare_flight, step_value, step_jacobian},
  {"penetration loss",         -1, 1, 0, prepare_penetration, penetration_value,
   penetration_jacobian},
};
/* clang-format on */

/* the rows of the table, then those of the operators */
enum { MODELS = KG_COUNT_OF(table) };

int cli_models_count(void)
{
  return MODELS + cli_operators_count();
}

const char *cli_models_name(int i)
{
  return i < MODELS ? table[i].name : cli_operators_name(i - MODELS);
}

static size_t size_of(const cli_models *m, int size)
{
  return size < 0 ? (size_t)-size * nv_of(m) : (size_t)size;
}

/* ---- a row as a function for kg_gradcheck ---------------------------------------------------- */

typedef struct checked {
  cli_models *models;
  const model *row;
  size_t inputs, outputs;
} checked;

static kg_status value(void *user, const double *x, double *y)
{
  const checked *c = user;
  c->row->value(c->models, x, y);
  return KG_OK;
}

static kg_status vjp(void *user, const double *x, const double *w, double *xw)
{
  const checked *c = user;
  c->row->jacobian(c->models, x, c->models->J);
  for (size_t j = 0; j < c->inputs; j++) {
    xw[j] = 0;
    for (size_t o = 0; o < c->outputs; o++) {
      xw[j] += c->models->J[o * c->inputs + j] * w[o];
    }
  }
  return KG_OK;
}

/* One point. Where differences cannot decide, because the second derivative jumps nearby, another
 * one is drawn. */
enum { DRAWS = 10 };

static kg_status check_point(checked *c, double *x, const kg_gradcheck_def *def,
                             kg_gradcheck_report *report, kg_error *error)
{
  const kg_differentiable function = {.name = c->row->name,
                                      .inputs = c->inputs,
                                      .outputs = c->outputs,
                                      .user = c,
                                      .value = value,
                                      .vjp = vjp};
  kg_status status = KG_OK;
  report->undecided = true;
  for (int i = 0; i < DRAWS && status == KG_OK && report->undecided; i++) {
    c->row->prepare(c->models, x);
    status = kg_gradcheck(&function, x, def, report, error);
  }
  return status;
}

static kg_status check_model(cli_models *models, int i, const kg_gradcheck_def *def,
                             kg_gradcheck_report *report, kg_error *error)
{
  const model *row = &table[i];
  checked c = {models, row, size_of(models, row->inputs), size_of(models, row->outputs)};
  const kg_arena_mark mark = kg_arena_mark_of(&models->arena);
  double *x = KG_ARENA_ARRAY(&models->arena, double, c.inputs);
  models->shape = row->shape;
  const kg_status status = x ? check_point(&c, x, def, report, error) : KG_ERR_NO_MEMORY;
  kg_arena_rewind(&models->arena, mark);
  return status;
}

static void prepare_operator(cli_models *m, int i)
{
  prepare_state(m);
  if (cli_operators_in_contact(i)) {
    set_down(m, m->contact.layer * (0.2 + 0.6 * kg_random_uniform(&m->random)));
    for (size_t k = 0; k < nv_of(m); k++) {
      m->v[k] = 3 * m->contact.stick * kg_random_normal(&m->random);
    }
  } else {
    set_down(m, 1.0);
  }
}

static kg_status check_operator(cli_models *m, int i, const kg_gradcheck_def *def,
                                kg_gradcheck_report *report, kg_error *error)
{
  kg_status status = KG_OK;
  report->undecided = true;
  for (int draw = 0; draw < DRAWS && status == KG_OK && report->undecided; draw++) {
    prepare_operator(m, i);
    status = cli_operators_check(m->operators, i, m->q, m->v, m->a, def, report, error);
  }
  return status;
}

/* how many points a row is checked at, for so many asked */
static int share_of(int i, int points)
{
  if (i >= MODELS) return (points + 19) / 20;
  return table[i].inputs < 0 ? (points + 4) / 5 : points;
}

kg_status cli_models_check(cli_models *models, int i, int points, const kg_gradcheck_def *def,
                           kg_gradcheck_report *report, kg_error *error)
{
  kg_status status = KG_OK;
  models->random = kg_random_make(def->seed + 1000 + (uint64_t)i);
  for (int point = 0; point < share_of(i, points) && status == KG_OK; point++) {
    kg_gradcheck_report one;
    kg_gradcheck_report *to = point == 0 ? report : &one;
    status = i < MODELS ? check_model(models, i, def, to, error)
                        : check_operator(models, i - MODELS, def, to, error);
    if (status == KG_OK && point > 0) kg_gradcheck_merge(report, &one);
  }
  return status;
}

/* ---- what they work on ----------------------------------------------------------------------- */

/* trunk, two legs of thigh, shank and foot, one arm: ball joints at the root, inside and at the
 * ends */
static kg_status create_small_body(kg_body **body)
{
  /* clang-format off */
  static const struct { int parent; kg_vec3 offset, com; double mass; } rows[] = {
    {-1, {0, 0, 0},         {0.01, 0.20, 0.02},  35},
    { 0, { 0.1, 0, 0},      {0, -0.2, 0.01},     8},
    { 1, {0, -0.4, 0},      {0, -0.2, -0.01},     3},
    { 2, {0, -0.4, 0},      {0, -0.04, 0.05},    1},
    { 0, {-0.1, 0, 0},      {0.01, -0.2, 0},      8},
    { 4, {0, -0.4, 0},      {0, -0.2, 0},        3},
    { 5, {0, -0.4, 0},      {0, -0.04, 0.05},     1},
    { 0, {-0.2, 0.4, 0},    {-0.02, -0.25, 0},   4}};
  /* clang-format on */
  enum { COUNT = KG_COUNT_OF(rows) };
  kg_segment segments[COUNT];
  kg_body_point points[2 * COUNT];
  for (int i = 0; i < COUNT; i++) {
    const double k = 0.01 * rows[i].mass;
    segments[i] = (kg_segment){.role = -1,
                               .joint = -1,
                               .parent = rows[i].parent,
                               .offset = rows[i].offset,
                               .mass = rows[i].mass,
                               .com = rows[i].com,
                               .inertia = {k, 0.5 * k, 0.8 * k, 0.1 * k, -0.05 * k, 0.07 * k}};
    points[2 * i] = (kg_body_point){i, {0.05, -0.06, 0.15}};
    points[2 * i + 1] = (kg_body_point){i, {-0.04, -0.07, -0.05}};
  }
  return kg_body_create(body, segments, COUNT, points, 2 * COUNT, NULL);
}

static kg_status create_shapes(cli_models *m)
{
  static const kg_vec3 corners[4] = {
    {-0.4, -0.3, -0.2}, {0.5, -0.2, -0.3}, {0.0, 0.6, 0.1}, {0.1, -0.1, 0.5}};
  static const int faces[12] = {0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3};
  static const double heights[9] = {0, 0.1, -0.1, 0.2, 0.3, 0, 0.1, -0.2, 0.1};
  kg_mesh_report report;
  kg_status status =
    kg_height_field_create(&m->field, heights, 3, 3, 0.5, (kg_vec3){-0.5, 0, -0.5}, NULL);
  if (status == KG_OK) status = kg_mesh_create(&m->mesh, corners, 4, faces, 4, &report, NULL, NULL);
  const kg_quat turned = kg_quat_exp(kg_vec3_make(0.3, -0.5, 0.2));
  const kg_sdf_shape shapes[SHAPES] = {
    {.kind = KG_SHAPE_PLANE, .a = {0, 0.1, 0}, .b = {0.6, 0.8, 0}},
    {.kind = KG_SHAPE_SPHERE, .a = {0.1, -0.2, 0.05}, .radius = 0.4},
    {.kind = KG_SHAPE_BOX, .a = {0, 0.1, 0}, .b = {0.2, 0.3, 0.1}, .orientation = turned},
    {.kind = KG_SHAPE_CAPSULE, .a = {-0.3, 0, 0.1}, .b = {0.2, 0.3, 0}, .radius = 0.15},
    {.kind = KG_SHAPE_HEIGHT_FIELD, .field = m->field},
    {.kind = KG_SHAPE_MESH, .mesh = m->mesh},
    {.kind = KG_SHAPE_ELLIPSOID, .b = {0.4, 0.2, 0.3}, .orientation = turned},
    {.kind = KG_SHAPE_CYLINDER, .a = {-0.3, 0, 0.1}, .b = {0.2, 0.3, 0}, .radius = 0.2},
    {.kind = KG_SHAPE_INTERSECTION, .children = {BALL, 6}},
    {.kind = KG_SHAPE_SMOOTH_UNION, .children = {BALL, 3}, .radius = 0.5},
    {.kind = KG_SHAPE_ELLIPSOID, .b = {0.4, 0.2, 0.3}, .place = 1, .ground = 1}};
  const kg_place place = {.at = {0.1, 0, -0.1},
                          .turn = kg_quat_exp(kg_vec3_make(-0.3, 0.2, 0.6)),
                          .velocity = {0.2, -0.1, 0.3},
                          .spin = {0.5, 1, -0.7}};
  const kg_ground mat = {.thickness = 0.02, .stiffness = 2e4, .damping = 0.5, .friction = 0.7};
  (void)kg_scene_add_place(&m->shapes, &place);
  (void)kg_scene_add_ground(&m->shapes, &mat);
  for (int k = 0; k < SHAPES; k++) {
    (void)kg_scene_add(&m->shapes, &shapes[k]);
  }
  return status;
}

static kg_status create_machines(cli_models *m)
{
  kg_status status = kg_dynamics_create(&m->dynamics, m->body, NULL);
  kg_step_def step = kg_step_default_def(m->body);
  step.scene = &m->ground;
  m->contact = step.contact;
  if (status == KG_OK) status = kg_step_create(&m->step, &step);
  if (status == KG_OK) status = cli_operators_create(&m->operators, m->body, &m->ground, m->dt);
  const kg_correction_def correction = kg_correction_default_def(m->body, &m->ground);
  return status == KG_OK ? kg_correction_create(&m->correction, &correction) : status;
}

static kg_status create_parts(cli_models *m)
{
  kg_status status = m->subject ? KG_OK : create_small_body(&m->own);
  if (status != KG_OK) return status;
  m->body = m->subject ? m->subject->body : m->own;
  m->ground = m->subject ? m->subject->scene : kg_scene_ground(0, kg_vec3_make(0.1, 1, 0));
  m->dt = m->subject ? m->subject->dt : 1.0 / 120;
  const size_t nv = nv_of(m);
  m->q = KG_ARENA_ARRAY(&m->arena, double, m->body->nq);
  m->moved = KG_ARENA_ARRAY(&m->arena, double, m->body->nq);
  m->v = KG_ARENA_ARRAY(&m->arena, double, nv);
  m->a = KG_ARENA_ARRAY(&m->arena, double, nv);
  m->J = KG_ARENA_ARRAY(&m->arena, double, 3 * nv * nv);
  for (int k = 0; k < 3; k++) {
    m->part[k] = KG_ARENA_ARRAY(&m->arena, double, nv *nv);
  }
  if (kg_arena_failed(&m->arena)) return KG_ERR_NO_MEMORY;
  status = create_shapes(m);
  return status == KG_OK ? create_machines(m) : status;
}

kg_status cli_models_create(cli_models **models, const kg_subject *subject)
{
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  cli_models *m = *models = KG_ARENA_ARRAY(&arena, cli_models, 1);
  if (!m) return KG_ERR_NO_MEMORY;
  m->arena = arena;
  m->subject = subject;
  const kg_status status = create_parts(m);
  if (status != KG_OK) {
    cli_models_destroy(m);
    *models = NULL;
  }
  return status;
}

void cli_models_destroy(cli_models *models)
{
  if (!models) return;
  cli_operators_destroy(models->operators);
  kg_correction_destroy(models->correction);
  kg_step_destroy(models->step);
  kg_dynamics_destroy(models->dynamics);
  kg_mesh_destroy(models->mesh);
  kg_height_field_destroy(models->field);
  kg_body_destroy(models->own);
  kg_arena arena = models->arena; /* the arena holds the object itself */
  kg_arena_release(&arena);
}
