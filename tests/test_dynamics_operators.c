/* Dynamics on the tape: values against plain calls, derivatives against differences and against the
 * complex model, leading dimensions, quaternions of any length, operands left out. */
#include "complex_body.h"

#include "kinegrad/derivatives.h"
#include "kinegrad/dynamics_operators.h"
#include "kinegrad/gradcheck.h"

#include <stdio.h>

enum { SEGMENTS = 5, POINTS = 3, NQ = 3 + 4 * SEGMENTS, NV = 3 + 3 * SEGMENTS };

typedef struct fixture {
  kg_body *body;
  kg_scene scene;
  kg_step_def def;
  kg_dynamics_operators *operators;
  kg_dynamics *dynamics;
  kg_step *step;
  kg_tape *tape;
  kg_random random;
  double q[NQ], v[NV], a[NV];
} fixture;

static const double DT = 0.01;

/* A small tree with three points, low enough for two of them to touch the ground. */
static kg_body *small_body(kg_random *random)
{
  kg_body *tree = random_tree(random, SEGMENTS, NULL), *body = NULL;
  const kg_body_point points[POINTS] = {
    {0, {0.1, 0.05, 0.0}}, {2, {0.0, -0.1, 0.1}}, {4, {0, 0, 0}}};
  assert_int_equal(kg_body_create(&body, tree->segments, SEGMENTS, points, POINTS, NULL), KG_OK);
  kg_body_destroy(tree);
  return body;
}

/* seed above SOFT: the ground is covered, and it moves and turns */
enum { SOFT = 1000 };

static fixture *fixture_of(uint64_t seed)
{
  fixture *f = calloc(1, sizeof *f);
  assert_non_null(f);
  f->random = kg_random_make(seed);
  f->body = small_body(&f->random);
  f->scene = kg_scene_ground(0.0, kg_vec3_make(0.1, 1.0, -0.2));
  if (seed > SOFT) {
    const kg_ground mat = {.thickness = 0.01, .stiffness = 2e4, .damping = 0.4, .friction = -1.0};
    const kg_place place = {.velocity = {0.3, 0.1, -0.2}, .spin = {0.4, -0.3, 0.2}};
    f->scene.shapes[0].ground = kg_scene_add_ground(&f->scene, &mat);
    f->scene.shapes[0].place = kg_scene_add_place(&f->scene, &place);
  }
  f->def = kg_step_default_def(f->body);
  f->def.scene = &f->scene;
  f->def.joint_damping = 0.3;
  assert_int_equal(kg_dynamics_operators_create(&f->operators, &f->def, DT), KG_OK);
  assert_int_equal(kg_dynamics_create(&f->dynamics, f->body, NULL), KG_OK);
  assert_int_equal(kg_step_create(&f->step, &f->def), KG_OK);
  assert_int_equal(kg_tape_create(NULL, &f->tape, NULL), KG_OK);
  random_state(&f->random, f->body, f->q, f->v, f->a);
  return f;
}

static void release(fixture *f)
{
  kg_tape_destroy(f->tape);
  kg_step_destroy(f->step);
  kg_dynamics_destroy(f->dynamics);
  kg_dynamics_operators_destroy(f->operators);
  kg_body_destroy(f->body);
  free(f);
}

/* Moves the root so that the lowest point is at this distance of the ground. */
static void set_down(fixture *f, double distance)
{
  kg_vec3 x[POINTS];
  double lowest = INFINITY;
  kg_dynamics_points(f->dynamics, x, NULL, f->q, NULL);
  for (int k = 0; k < POINTS; k++) {
    lowest = fmin(lowest, kg_scene_distance(&f->scene, x[k]).distance);
  }
  const kg_vec3 n = kg_scene_distance(&f->scene, x[0]).normal;
  f->q[0] += (distance - lowest) * n.x;
  f->q[1] += (distance - lowest) * n.y;
  f->q[2] += (distance - lowest) * n.z;
}

/* ---- values -----------------------------------------------------------------------------------*/

static void assert_same(const kg_tape *tape, kg_value value, size_t start, const double *want,
                        size_t count, double tolerance)
{
  assert_int_equal(kg_tape_status(tape), KG_OK);
  for (size_t k = 0; k < count; k++) {
    assert_close(kg_item_at(tape, value, start + k), want[k], tolerance);
  }
}

/* (2, 3) frames; the quaternions of the operands are of any length and sign */
static void values_equal_plain_calls(void **state)
{
  (void)state;
  enum { FRAMES = 6 };
  fixture *f = fixture_of(21);
  static double q[FRAMES * NQ], unit[FRAMES * NQ], v[FRAMES * NV], a[FRAMES * NV];
  double forces[FRAMES * 3 * POINTS];
  for (int k = 0; k < FRAMES; k++) {
    random_state(&f->random, f->body, f->q, v + k * NV, a + k * NV);
    set_down(f, 0.002);
    memcpy(unit + k * NQ, f->q, sizeof f->q);
    for (int c = 0; c < NQ; c++) {
      q[k * NQ + c] = c < 3 ? f->q[c] : (0.5 + (c - 3) / 4) * f->q[c];
    }
  }
  for (size_t k = 0; k < KG_COUNT_OF(forces); k++) {
    forces[k] = kg_random_normal(&f->random);
  }
  kg_tape *t = f->tape;
  const kg_value Q = kg_input(t, KG_SHAPE(2, 3, NQ), q), V = kg_input(t, KG_SHAPE(2, 3, NV), v);
  const kg_value A = kg_input(t, KG_SHAPE(2, 3, NV), a);
  const kg_value F = kg_input(t, KG_SHAPE(2, 3, POINTS, 3), forces), none = {0};
  const kg_value tau = kg_inverse_dynamics(t, f->operators, Q, V, A);
  const kg_value back = kg_forward_dynamics(t, f->operators, Q, V, tau);
  const kg_value p = kg_joint_positions(t, f->operators, Q);
  const kg_value p_dot = kg_joint_velocities(t, f->operators, Q, V);
  const kg_value p_ddot = kg_joint_accelerations(t, f->operators, Q, V, A);
  const kg_value x = kg_point_positions(t, f->operators, Q);
  const kg_value general = kg_point_forces(t, f->operators, Q, F);
  const kg_value contact = kg_contact_forces(t, f->operators, Q, V, none);
  const kg_value next = kg_implicit_step(t, f->operators, Q, V, tau, none, none, none);
  double touching = 0.0;
  for (int k = 0; k < FRAMES; k++) {
    const size_t at = (size_t)k;
    const double *qk = unit + k * NQ, *vk = v + k * NV, *ak = a + k * NV;
    double want[NQ + NV], J[3 * NV], sum[NV] = {0.0};
    kg_vec3 places[SEGMENTS], rates[SEGMENTS], accelerations[SEGMENTS], points[POINTS];
    kg_dynamics_inverse(f->dynamics, want, qk, vk, ak);
    assert_same(t, tau, at * NV, want, NV, 1e-12);
    assert_same(t, back, at * NV, ak, NV, 1e-9);
    kg_dynamics_velocity(f->dynamics, qk, vk, places, NULL, rates, NULL);
    kg_dynamics_acceleration(f->dynamics, qk, vk, ak, accelerations, NULL);
    assert_same(t, p, at * 3 * SEGMENTS, &places[0].x, 3 * SEGMENTS, 1e-13);
    assert_same(t, p_dot, at * 3 * SEGMENTS, &rates[0].x, 3 * SEGMENTS, 1e-13);
    assert_same(t, p_ddot, at * 3 * SEGMENTS, &accelerations[0].x, 3 * SEGMENTS, 1e-12);
    for (int c = 0; c < POINTS; c++) {
      kg_contact_force force;
      points[c] = kg_dynamics_point(f->dynamics, J, qk, f->body->points[c]);
      double u[3] = {0.0};
      for (int j = 0; j < NV; j++) {
        for (int r = 0; r < 3; r++) {
          sum[j] += J[r * NV + j] * forces[(k * POINTS + c) * 3 + r];
          u[r] += J[r * NV + j] * vk[j];
        }
      }
      kg_contact_evaluate(&f->def.contact, &f->scene, points[c], kg_vec3_make(u[0], u[1], u[2]),
                          false, &force);
      assert_same(t, contact, (at * POINTS + (size_t)c) * 3, &force.f.x, 3, 1e-7);
      touching += force.normal;
    }
    assert_same(t, x, at * 3 * POINTS, &points[0].x, 3 * POINTS, 1e-13);
    assert_same(t, general, at * NV, sum, NV, 1e-12);
    kg_step_report report;
    double torque[NV];
    kg_dynamics_inverse(f->dynamics, torque, qk, vk, ak);
    kg_step_advance(f->step, want, want + NQ, qk, vk, torque, DT, false, &report);
    assert_true(report.converged);
    assert_same(t, next, at * (NQ + NV), want, NQ + NV, 1e-7);
  }
  assert_true(touching > 0.0);
  release(f);
}

/* ---- derivatives ------------------------------------------------------------------------------*/

typedef struct recipe {
  fixture *f;
  int kind;
} recipe;

static kg_value part(kg_tape *t, kg_value x, int *start, int count)
{
  const kg_value p = kg_slice(t, x, 0, *start, count);
  *start += count;
  return p;
}

static const int sizes[][4] = {{NQ, NV, NV}, {NQ, NV, NV},    {NQ}, {NQ, NV}, {NQ, NV, NV},
                               {NQ},         {NQ, 3 * POINTS}};
static const char *const names[] = {"inverse_dynamics", "forward_dynamics",    "joint_positions",
                                    "joint_velocities", "joint_accelerations", "point_positions",
                                    "point_forces"};

static kg_value record_smooth(kg_tape *t, kg_value x, void *user)
{
  const recipe *r = user;
  kg_dynamics_operators *o = r->f->operators;
  kg_value in[3] = {{0}, {0}, {0}};
  int at = 0;
  for (int k = 0; k < 3 && sizes[r->kind][k] > 0; k++) {
    in[k] = part(t, x, &at, sizes[r->kind][k]);
  }
  switch (r->kind) {
    case 0:
      return kg_inverse_dynamics(t, o, in[0], in[1], in[2]);
    case 1:
      return kg_forward_dynamics(t, o, in[0], in[1], in[2]);
    case 2:
      return kg_joint_positions(t, o, in[0]);
    case 3:
      return kg_joint_velocities(t, o, in[0], in[1]);
    case 4:
      return kg_joint_accelerations(t, o, in[0], in[1], in[2]);
    case 5:
      return kg_point_positions(t, o, in[0]);
    default:
      return kg_point_forces(t, o, in[0], kg_reshape(t, in[1], KG_SHAPE(POINTS, 3)));
  }
}

static void check(const char *name, kg_recorded function, void *user, int count, const double *x,
                  double tolerance)
{
  kg_gradcheck_def def = kg_gradcheck_default_def();
  kg_gradcheck_report report;
  kg_error error;
  char row[300];
  def.tolerance = tolerance;
  assert_int_equal(
    kg_gradcheck_recorded(name, function, user, KG_SHAPE(count), x, &def, &report, &error), KG_OK);
  kg_gradcheck_row(&report, row, sizeof row);
  print_message("%s\n", row);
  assert_true(report.passed);
}

static void smooth_operators_pass_the_gradient_check(void **state)
{
  (void)state;
  fixture *f = fixture_of(22);
  for (int kind = 0; kind < (int)KG_COUNT_OF(names); kind++) {
    double x[NQ + 2 * NV];
    recipe r = {f, kind};
    int count = 0;
    for (int c = 0; c < NQ; c++) {
      x[count++] = c < 3 ? f->q[c] : 1.3 * f->q[c];
    }
    for (int k = 1; k < 3; k++) {
      for (int c = 0; c < sizes[kind][k]; c++) {
        x[count++] = kg_random_normal(&f->random);
      }
    }
    check(names[kind], record_smooth, &r, count, x, 1e-8);
  }
  release(f);
}

/* Small steps about a state in contact: x = (d root / layer, v / stick, tau, law in proportion,
 * masses and offsets in proportion); all of them operands. */
static kg_value record_step(kg_tape *t, kg_value x, void *user)
{
  const recipe *r = user;
  fixture *f = r->f;
  const kg_contact_params *c = &f->def.contact;
  const double law[6] = {c->layer, c->force, c->floor_share, c->damping, c->friction, c->stick};
  double masses[SEGMENTS], offsets[3 * SEGMENTS];
  for (int i = 0; i < SEGMENTS; i++) {
    masses[i] = f->body->segments[i].mass;
    memcpy(offsets + 3 * i, &f->body->segments[i].offset, sizeof(kg_vec3));
  }
  int at = 0;
  const kg_value dq = part(t, x, &at, NQ), dv = part(t, x, &at, NV), dl = part(t, x, &at, 6);
  const kg_value q = kg_add(t, kg_constant(t, KG_SHAPE(NQ), f->q), kg_scale(t, dq, c->layer));
  const kg_value v = kg_add(t, kg_constant(t, KG_SHAPE(NV), f->v), kg_scale(t, dv, c->stick));
  const kg_value L =
    kg_mul(t, kg_constant(t, KG_SHAPE(6), law), kg_shift(t, kg_scale(t, dl, 0.1), 1));
  if (r->kind == 0) return kg_contact_forces(t, f->operators, q, v, L);
  const kg_value tau = part(t, x, &at, NV), dm = part(t, x, &at, SEGMENTS);
  const kg_value dr = part(t, x, &at, 3 * SEGMENTS);
  const kg_value m = kg_mul(t, kg_constant(t, KG_SHAPE(SEGMENTS), masses), kg_shift(t, dm, 1));
  const kg_value o =
    kg_add(t, kg_constant(t, KG_SHAPE(3 * SEGMENTS), offsets), kg_scale(t, dr, c->layer));
  return kg_implicit_step(t, f->operators, q, v, tau, L, m,
                          kg_reshape(t, o, KG_SHAPE(SEGMENTS, 3)));
}

/* layers: where the lowest point is, above the ground's core */
static void check_contact_and_step(uint64_t seed, double layers, const char *contact,
                                   const char *step)
{
  enum { COUNT = NQ + 2 * NV + 6 + 4 * SEGMENTS };
  fixture *f = fixture_of(seed);
  f->def.tolerance = 1e-12; /* of the solution, that differences be of the function */
  kg_dynamics_operators_destroy(f->operators);
  assert_int_equal(kg_dynamics_operators_create(&f->operators, &f->def, DT), KG_OK);
  for (int k = 0; k < NV; k++) {
    f->v[k] *= 0.05;
  }
  set_down(f, layers * f->def.contact.layer);
  double x[COUNT] = {0.0};
  recipe r = {f, 0};
  check(contact, record_step, &r, NQ + NV + 6, x, 1e-7);
  r.kind = 1;
  check(step, record_step, &r, COUNT, x, 1e-6);
  release(f);
}

static void contact_and_step_pass_the_gradient_check(void **state)
{
  (void)state;
  check_contact_and_step(23, 0.5, "contact_forces", "implicit_step");
}

static void so_they_do_on_soft_and_moving_ground(void **state)
{
  (void)state;
  check_contact_and_step(SOFT + 23, 1.4, "contact_forces, soft", "implicit_step, soft");
  check_contact_and_step(SOFT + 24, 0.5, "contact_forces, core", "implicit_step, core");
}

/* 2 cm below where it touches: the loss, then the pose carried out */
static kg_value record_correction(kg_tape *t, kg_value x, void *user)
{
  const recipe *r = user;
  const kg_value q = kg_add(t, kg_constant(t, KG_SHAPE(NQ), r->f->q), kg_scale(t, x, 1e-3));
  if (r->kind == 0) return kg_scale(t, kg_collision_loss(t, r->f->operators, q), 1e3);
  return kg_corrected_pose(t, r->f->operators, q);
}

static void penetration_passes_the_gradient_check(void **state)
{
  (void)state;
  fixture *f = fixture_of(25);
  double x[NQ] = {0.0};
  set_down(f, -0.02);
  recipe r = {f, 0};
  check("collision_loss", record_correction, &r, NQ, x, 1e-9);
  r.kind = 1;
  check("corrected_pose", record_correction, &r, NQ, x, 1e-6);
  release(f);
}

/* Gradients by q are orthogonal to every quaternion, whatever its length. */
static void gradients_are_tangent_to_the_sphere(void **state)
{
  (void)state;
  fixture *f = fixture_of(24);
  kg_tape *t = f->tape;
  for (int c = 3; c < NQ; c++) {
    f->q[c] *= 0.7;
  }
  const kg_value q = kg_input(t, KG_SHAPE(NQ), f->q), v = kg_input(t, KG_SHAPE(NV), f->v);
  const kg_value a = kg_input(t, KG_SHAPE(NV), f->a);
  const kg_value next =
    kg_implicit_step(t, f->operators, q, v, a, (kg_value){0}, (kg_value){0}, (kg_value){0});
  const kg_value tau = kg_inverse_dynamics(t, f->operators, q, v, a);
  const kg_value sum = kg_add(t, kg_sum_all(t, kg_square(t, tau)), kg_sum_all(t, next));
  assert_int_equal(kg_backward(t, sum), KG_OK);
  const double *bar = kg_adjoint(t, q);
  for (int i = 0; i < SEGMENTS; i++) {
    double along = 0.0, size = 0.0;
    for (int c = 3 + 4 * i; c < 7 + 4 * i; c++) {
      along += bar[c] * f->q[c];
      size += fabs(bar[c] * f->q[c]);
    }
    assert_true(size > 0.0 && fabs(along) < 1e-13 * size);
  }
  release(f);
}

/* ---- against the complex model, to rounding ---------------------------------------------------*/

static void adjoints_equal_complex_steps(void **state)
{
  (void)state;
  enum { N = HUMAN_SEGMENTS };
  kg_random random = kg_random_make(25);
  kg_body *body = human_body();
  const complex_body model = complex_body_of(body);
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  double q[MAX_NQ], v[MAX_NV], a[MAX_NV], got[3][MAX_NV] = {{0.0}}, worst = 0.0, size = 0.0;
  kg_vec3 bars[3][N];
  random_state(&random, body, q, v, a);
  for (int k = 0; k < 3 * N; k++) {
    bars[k / N][k % N] = random_vec3(&random, 1.0);
  }
  kg_dynamics_motion_vjp(d, got[0], got[1], got[2], NULL, q, v, a, bars[0], bars[1], bars[2]);
  for (int kind = 0; kind < 3; kind++) {
    for (int k = 0; k < body->nv; k++) {
      static complex_pose pose;
      c3 w[MAX_NV], p_dot[MAX_NV], alpha[MAX_NV], p_ddot[MAX_NV];
      cplx move[MAX_NV] = {0.0}, cv[MAX_NV], ca[MAX_NV], sum = 0.0;
      for (int j = 0; j < body->nv; j++) {
        cv[j] = v[j];
        ca[j] = a[j];
      }
      cplx *const moved[3] = {move, cv, ca};
      moved[kind][k] += 1e-100 * _Complex_I;
      pose = complex_pose_of(&model, q);
      complex_move(&model, &pose, 1.0, move);
      complex_place(&model, &pose);
      complex_rates(&model, &pose, cv, w, p_dot);
      complex_accelerations(&model, &pose, cv, ca, alpha, p_ddot);
      for (int i = 0; i < N; i++) {
        sum += c_dot(c_real(bars[0][i]), pose.p[i]) + c_dot(c_real(bars[1][i]), p_dot[i]) +
               c_dot(c_real(bars[2][i]), p_ddot[i]);
      }
      worst = fmax(worst, fabs(got[kind][k] - cimag(sum) / 1e-100));
      size = fmax(size, fabs(got[kind][k]));
    }
  }
  print_message("motion of joints against complex steps: %.1e\n", worst / size);
  assert_at_most(worst, 1e-13 * size);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

static void forward_adjoint_equals_the_matrices(void **state)
{
  (void)state;
  kg_random random = kg_random_make(26);
  static double A[3][MAX_NV * MAX_NV];
  double worst = 0.0;
  for (int trial = 0; trial < 6; trial++) {
    kg_body *body = random_tree(&random, 3 + 3 * trial, NULL);
    const int nv = body->nv;
    kg_dynamics *d = NULL;
    assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], a[MAX_NV], bar[MAX_NV], got[3][MAX_NV] = {{0.0}};
    random_state(&random, body, q, v, tau);
    random_state(&random, body, q, v, bar);
    kg_dynamics_forward_derivatives(d, A[0], A[1], A[2], a, q, v, tau);
    kg_dynamics_forward_vjp(d, got[0], got[1], got[2], q, v, a, bar);
    for (int k = 0; k < 3; k++) {
      double size = 0.0, error = 0.0;
      for (int c = 0; c < nv; c++) {
        double want = 0.0;
        for (int r = 0; r < nv; r++) {
          want += bar[r] * A[k][r * nv + c];
        }
        error = fmax(error, fabs(want - got[k][c]));
        size = fmax(size, fabs(want));
      }
      worst = fmax(worst, error / size);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
  print_message("adjoint of forward dynamics against its matrices: %.1e\n", worst);
  assert_at_most(worst, 1e-11);
}

/* ---- masses and offsets -----------------------------------------------------------------------*/

/* The body itself with other masses or offsets, stepped without the tape. */
static void plain_step(const kg_step_def *def, const kg_body *like, const double *masses,
                       const double *offsets, const double *q, const double *v, double *next)
{
  kg_segment segments[HUMAN_SEGMENTS];
  kg_body *body = NULL;
  kg_step *step = NULL;
  kg_step_report report;
  memcpy(segments, like->segments, (size_t)like->segment_count * sizeof *segments);
  for (int i = 0; i < like->segment_count; i++) {
    if (masses) segments[i].mass = masses[i];
    if (offsets) memcpy(&segments[i].offset, offsets + 3 * i, sizeof(kg_vec3));
  }
  assert_int_equal(
    kg_body_create(&body, segments, like->segment_count, like->points, like->point_count, NULL),
    KG_OK);
  kg_step_def own = *def;
  own.body = body;
  assert_int_equal(kg_step_create(&step, &own), KG_OK);
  kg_step_advance(step, next, next + body->nq, q, v, NULL, DT, false, &report);
  assert_true(report.converged);
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* Masses and offsets of one call are those of this call alone, forward and backward, to the bit:
 * nothing of the call before is left, the sum of the masses neither. */
static void masses_are_of_one_call(void **state)
{
  (void)state;
  enum { N = HUMAN_SEGMENTS };
  kg_random random = kg_random_make(28);
  kg_body *body = human_body();
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_dynamics_operators *o = NULL;
  kg_tape *t = NULL;
  assert_int_equal(kg_dynamics_operators_create(&o, &def, DT), KG_OK);
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  double q[MAX_NQ], v[MAX_NV] = {0.0}, masses[3][N], offsets[3 * N], zero[MAX_NV] = {0.0};
  rest_state(body, human_root_height + 0.002, q);
  for (int k = 0; k < body->nv; k++) {
    v[k] = 0.05 * kg_random_normal(&random);
  }
  const double factor[3] = {1.5, 100.0, 0.01};
  for (int i = 0; i < N; i++) {
    const kg_vec3 offset = kg_vec3_scale(1.01, body->segments[i].offset);
    for (int k = 0; k < 3; k++) {
      masses[k][i] = factor[k] * body->segments[i].mass;
    }
    memcpy(offsets + 3 * i, &offset, sizeof offset);
  }
  const struct {
    const double *masses, *offsets;
  } calls[] = {{NULL, NULL},    {masses[0], NULL}, {NULL, NULL}, {masses[1], offsets},
               {NULL, offsets}, {masses[2], NULL}, {NULL, NULL}, {masses[1], NULL}};
  const kg_value Q = kg_input(t, KG_SHAPE(body->nq), q), V = kg_input(t, KG_SHAPE(body->nv), v);
  const kg_value tau = kg_input(t, KG_SHAPE(body->nv), zero), none = {0};
  for (size_t k = 0; k < KG_COUNT_OF(calls); k++) {
    const kg_value M = calls[k].masses ? kg_input(t, KG_SHAPE(N), calls[k].masses) : none;
    const kg_value O = calls[k].offsets ? kg_input(t, KG_SHAPE(N, 3), calls[k].offsets) : none;
    double want[MAX_NQ + MAX_NV];
    const kg_value next = kg_implicit_step(t, o, Q, V, tau, none, M, O);
    assert_int_equal(kg_tape_status(t), KG_OK);
    plain_step(&def, body, calls[k].masses, calls[k].offsets, q, v, want);
    for (int c = 0; c < body->nq + body->nv; c++) {
      if (kg_item_at(t, next, (size_t)c) != want[c]) {
        fail_msg("call %zu, number %d: %.17g, alone %.17g", k, c, kg_item_at(t, next, (size_t)c),
                 want[c]);
      }
    }
  }
  kg_tape_destroy(t);
  kg_dynamics_operators_destroy(o);
  kg_body_destroy(body);
}

/* ---- refusals ---------------------------------------------------------------------------------*/

static void wrong_operands_are_refused(void **state)
{
  (void)state;
  fixture *f = fixture_of(27);
  kg_tape *t = f->tape;
  const kg_tape_mark empty = {0};
  const double zeros[NQ] = {0.0};
  for (int row = 0; row < 4; row++) {
    const kg_value q = kg_input(t, KG_SHAPE(NQ), row == 1 ? zeros : f->q);
    const kg_value v = kg_input(t, KG_SHAPE(NV), f->v), two = kg_input(t, KG_SHAPE(2, NV), NULL);
    const kg_value law = kg_input(t, KG_SHAPE(6), NULL), none = {0};
    const kg_value masses = kg_neg(t, kg_shift(t, kg_input(t, KG_SHAPE(SEGMENTS), NULL), 1));
    const kg_value result =
      row == 0   ? kg_inverse_dynamics(t, f->operators, q, v, two) /* other leading dimensions */
      : row == 1 ? kg_joint_velocities(t, f->operators, q, v)      /* zero quaternions         */
      : row == 2 ? kg_contact_forces(t, f->operators, q, v, law)   /* a layer of no thickness  */
                 : kg_implicit_step(t, f->operators, q, v, v, none, masses, none);
    assert_true(kg_is_null(result));
    assert_int_equal(kg_tape_status(t), row == 0 ? KG_ERR_SHAPE : KG_ERR_UNDEFINED);
    kg_tape_rewind(t, empty);
  }
  release(f);
}

static void failed_creation_leaks_nothing(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_step_def def = kg_step_default_def(body);
  for (int calls = 0;; calls++) {
    failing_heap heap = {.calls_left = calls};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_dynamics_operators *o = NULL;
    def.allocator = &allocator;
    const kg_status status = kg_dynamics_operators_create(&o, &def, 0.01);
    kg_dynamics_operators_destroy(o);
    assert_int_equal(heap.live_bytes, 0);
    if (status == KG_OK) break;
    assert_int_equal(status, KG_ERR_NO_MEMORY);
  }
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(values_equal_plain_calls),
    cmocka_unit_test(smooth_operators_pass_the_gradient_check),
    cmocka_unit_test(contact_and_step_pass_the_gradient_check),
    cmocka_unit_test(so_they_do_on_soft_and_moving_ground),
    cmocka_unit_test(penetration_passes_the_gradient_check),
    cmocka_unit_test(gradients_are_tangent_to_the_sphere),
    cmocka_unit_test(adjoints_equal_complex_steps),
    cmocka_unit_test(forward_adjoint_equals_the_matrices),
    cmocka_unit_test(masses_are_of_one_call),
    cmocka_unit_test(wrong_operands_are_refused),
    cmocka_unit_test(failed_creation_leaks_nothing),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
