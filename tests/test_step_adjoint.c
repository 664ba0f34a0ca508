/* Derivatives of a step: against dense LAPACK on complex steps of an independent residual, in
 * flight, standing, sliding, lying and at the kinks of the contact law; sub-steps; refusals. */
#include "complex_body.h"

#include "kinegrad/dense.h"

#include <stdio.h>

static const double H = 1e-100;
enum { FLIGHT, STANDING, SLIDING, LYING, KINDS };
enum { MATRIX = MAX_NV * MAX_NV, MAX_POINTS = 256 };

static double largest(const double *x, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    size = fmax(size, fabs(x[k]));
  }
  return size;
}

/* largest difference over the largest entry */
static double distance(const double *got, const double *want, int count)
{
  const double size = fmax(largest(want, count), 1e-300);
  double worst = 0.0;
  for (int k = 0; k < count; k++) {
    worst = fmax(worst, fabs(got[k] - want[k]) / size);
    if (isnan(got[k])) return NAN;
  }
  return worst;
}

/* A state of the human near the ground. */
static void human_state(kg_random *random, const kg_body *body, int kind, double *q, double *v)
{
  double d[MAX_NV];
  const double height[KINDS] = {1.8, human_root_height + 0.003, human_root_height + 0.002, 0.092};
  rest_state(body, height[kind], q);
  for (int k = 0; k < body->nv; k++) {
    d[k] = (kind == FLIGHT ? 0.5 : 0.002) * kg_random_normal(random);
    v[k] = (kind == FLIGHT ? 2.0 : kind == STANDING ? 1e-4 : 0.3) * kg_random_normal(random);
  }
  d[1] = 0.0;
  if (kind == LYING) {
    d[3] = -0.5 * 3.14159265358979;
  }
  kg_body_integrate(body, q, q, d);
  if (kind == SLIDING) {
    v[0] += 1.0;
  }
}

static void random_passive(kg_random *random, int n, kg_joint_passive *passive)
{
  for (int i = 0; i < n; i++) {
    passive[i] = (kg_joint_passive){
      .stiffness = 20.0 * kg_random_uniform(random),
      .damping = kg_random_uniform(random),
      .rest = kg_quat_exp(random_vec3(random, 0.3)),
      .limit_low = kg_vec3_make(-0.2, -INFINITY, -0.1),
      .limit_high = kg_vec3_make(0.1, 0.3, INFINITY),
      .limit_stiffness = i % 3 == 2 ? 0.0 : 200.0,
    };
  }
}

/* ---- the reference ----------------------------------------------------------------------------*/

/* dG/dx for one number x, as a column */
static void column_by(complex_step *s, cplx *x, double *column)
{
  cplx G[MAX_NV];
  const int nv = 3 + 3 * s->body.n;
  *x += _Complex_I * H;
  complex_residual(s, G);
  *x = creal(*x);
  for (int r = 0; r < nv; r++) {
    column[r] = cimag(G[r]) / H;
  }
}

/* dG/dx for an array of numbers; A (nv, count) row-major */
static void matrix_by(complex_step *s, cplx *x, int count, double *A)
{
  double column[MAX_NV];
  const int nv = 3 + 3 * s->body.n;
  for (int c = 0; c < count; c++) {
    column_by(s, x + c, column);
    for (int r = 0; r < nv; r++) {
      A[r * count + c] = column[r];
    }
  }
}

/* d(tangent of q')/dx for v_end or turn; (nv, nv) */
static void end_by(complex_step *s, cplx *x, double *A)
{
  const int nv = 3 + 3 * s->body.n;
  double column[MAX_NV];
  for (int c = 0; c < nv; c++) {
    x[c] += _Complex_I * H;
    complex_end_tangent(s, column);
    x[c] = creal(x[c]);
    for (int r = 0; r < nv; r++) {
      A[r * nv + c] = column[r] / H;
    }
  }
}

typedef struct reference {
  complex_step at;
  int nv;
  double J[MATRIX], dv[3][MATRIX], dq[3][MATRIX]; /* by q, v, tau */
  double E[MATRIX], D[MATRIX];
} reference;

/* C = s A B + t C */
static void multiply(int n, double s, const double *A, const double *B, double t, double *C)
{
  for (int i = 0; i < n; i++) {
    for (int j = 0; j < n; j++) {
      double sum = 0.0;
      for (int k = 0; k < n; k++) {
        sum += A[i * n + k] * B[k * n + j];
      }
      C[i * n + j] = s * sum + t * C[i * n + j];
    }
  }
}

extern void dgesvx_(const char *fact, const char *trans, const int *n, const int *nrhs, double *a,
                    const int *lda, double *af, const int *ldaf, int *ipiv, char *equed, double *r,
                    double *c, double *b, const int *ldb, double *x, const int *ldx, double *rcond,
                    double *ferr, double *berr, double *work, int *iwork, int *info,
                    size_t fact_length, size_t trans_length, size_t equed_length);

/* X := J^-1 X (transposed: J^-T X) with equilibration and iterative refinement; X (n, columns)
 * row-major */
static void solve_with_lapack(int n, const double *J, bool transposed, double *X, int columns)
{
  double *a = malloc(sizeof(double) * (size_t)(2 * n * n + 2 * n * columns + 8 * n + 2 * columns));
  assert_non_null(a);
  double *af = a + n * n, *b = af + n * n, *x = b + n * columns, *work = x + n * columns;
  double *r = work + 4 * n, *c = r + n, *ferr = c + n, *berr = ferr + columns, rcond;
  int pivots[MAX_NV], iwork[MAX_NV], info = 0;
  char equed = 'N';
  for (int k = 0; k < n * n; k++) {
    a[k] = J[k];
  }
  for (int i = 0; i < n; i++) {
    for (int j = 0; j < columns; j++) {
      b[j * n + i] = X[i * columns + j];
    }
  }
  /* rows of J are columns for LAPACK */
  dgesvx_("E", transposed ? "N" : "T", &n, &columns, a, &n, af, &n, pivots, &equed, r, c, b, &n, x,
          &n, &rcond, ferr, berr, work, iwork, &info, 1, 1, 1);
  if (info != 0 && info != n + 1) fail_msg("dgesvx: %d", info);
  for (int i = 0; i < n; i++) {
    for (int j = 0; j < columns; j++) {
      X[i * columns + j] = x[j * n + i];
    }
  }
  free(a);
}

/* dv'/dx = -(dG/dv')^-1 dG/dx, dq'/dx = E dv'/dx (+ D) */
static reference *reference_of(const kg_step_def *def, const double *q, const double *v,
                               const double *tau, double dt, const double *v_end,
                               const kg_sdf_shape *ball)
{
  reference *r = calloc(1, sizeof *r);
  assert_non_null(r);
  r->at = complex_step_of(def, q, v, tau, dt, v_end);
  if (ball) {
    r->at.ball = ball->a;
    r->at.radius = ball->radius;
    if (ball->ground > 0) r->at.cover = def->scene->grounds[ball->ground - 1];
  }
  if (ball && ball->place > 0) {
    const kg_place *place = &def->scene->places[ball->place - 1];
    r->at.ball = place->at;
    r->at.ball_velocity = place->velocity;
    r->at.ball_spin = place->spin;
  }
  r->nv = def->body->nv;
  matrix_by(&r->at, r->at.v_end, r->nv, r->J);
  matrix_by(&r->at, r->at.turn, r->nv, r->dv[0]);
  matrix_by(&r->at, r->at.v, r->nv, r->dv[1]);
  matrix_by(&r->at, r->at.tau, r->nv, r->dv[2]);
  end_by(&r->at, r->at.v_end, r->E);
  end_by(&r->at, r->at.turn, r->D);
  for (int k = 0; k < 3; k++) {
    solve_with_lapack(r->nv, r->J, false, r->dv[k], r->nv);
    for (int e = 0; e < r->nv * r->nv; e++) {
      r->dv[k][e] = -r->dv[k][e];
    }
    multiply(r->nv, 1.0, r->E, r->dv[k], 0.0, r->dq[k]);
  }
  for (int e = 0; e < r->nv * r->nv; e++) {
    r->dq[0][e] += r->D[e];
  }
  return r;
}

/* A' x, A (rows, columns) */
static void transposed_product(const double *A, int rows, int columns, const double *x, double s,
                               double *y)
{
  for (int c = 0; c < columns; c++) {
    y[c] = 0.0;
    for (int r = 0; r < rows; r++) {
      y[c] += s * A[r * columns + c] * x[r];
    }
  }
}

/* ---- comparison -------------------------------------------------------------------------------*/

typedef struct gradient_arrays {
  double q[MAX_NV], v[MAX_NV], tau[MAX_NV], contact[6], joint_damping, passive[3 * MAX_NV];
  double mass[MAX_NV], com[MAX_NV], inertia[6 * MAX_NV], offset[MAX_NV], points[3 * MAX_POINTS];
} gradient_arrays;

static kg_step_gradient arrays_of(gradient_arrays *a)
{
  memset(a, 0, sizeof *a);
  return (kg_step_gradient){.q = a->q,
                            .v = a->v,
                            .tau = a->tau,
                            .contact = a->contact,
                            .joint_damping = &a->joint_damping,
                            .passive = a->passive,
                            .body = {.mass = a->mass,
                                     .com = a->com,
                                     .inertia = a->inertia,
                                     .offset = a->offset,
                                     .points = a->points}};
}

/* Gradient by an array of numbers against -lambda' dG/dx; errors over the largest entry, or
 * `least`. */
static double compare_numbers(reference *r, const double *lambda, cplx *x, int count,
                              const double *got, double least)
{
  double *A = malloc(sizeof(double) * (size_t)(count * r->nv));
  double *want = malloc(sizeof(double) * (size_t)count);
  assert_true(A && want);
  matrix_by(&r->at, x, count, A);
  transposed_product(A, r->nv, count, lambda, -1.0, want);
  const double size = largest(want, count);
  const double error = distance(got, want, count) * size / fmax(size, least);
  free(A);
  free(want);
  return error;
}

/* The six numbers of the contact law have different units: effects of a change in proportion, over
 * those of the law's force F on the fastest rate. */
static double compare_law(reference *r, const double *lambda, const double *got)
{
  double error = 0.0, size = creal(r->at.contact[1]) * largest(lambda, r->nv);
  for (int k = 0; k < 6; k++) {
    const double scale = creal(r->at.contact[k]);
    double column[MAX_NV], want = 0.0;
    column_by(&r->at, &r->at.contact[k], column);
    for (int i = 0; i < r->nv; i++) {
      want -= lambda[i] * column[i];
      size = fmax(size, scale * fabs(lambda[i] * column[i]));
    }
    error = fmax(error, scale * fabs(got[k] - want));
  }
  return error / size;
}

/* By all parameters. Arrays of c3 and of six numbers are arrays of complex numbers. */
static double compare_parameters(reference *r, const double *lambda, const gradient_arrays *got)
{
  complex_step *s = &r->at;
  const int n = s->body.n;
  double worst = compare_numbers(r, lambda, s->body.mass, n, got->mass, 1e-300);
  worst = fmax(worst, compare_numbers(r, lambda, &s->body.com[0].x, 3 * n, got->com, 1e-300));
  worst = fmax(worst, compare_numbers(r, lambda, s->body.inertia[0], 6 * n, got->inertia, 1e-300));
  worst = fmax(worst, compare_numbers(r, lambda, &s->body.offset[0].x, 3 * n, got->offset, 1e-300));
  worst =
    fmax(worst, compare_numbers(r, lambda, &s->joint_damping, 1, &got->joint_damping, 1e-300));
  if (largest(got->contact, 6) > 0.0) {
    worst = fmax(worst, compare_law(r, lambda, got->contact));
    const int count = 3 * s->body.point_count;
    worst =
      fmax(worst, compare_numbers(r, lambda, &s->body.point[0].x, count, got->points,
                                  creal(s->contact[1] / s->contact[0]) * largest(lambda, r->nv)));
  }
  for (int i = 1; i < n && s->has_passive; i++) {
    worst = fmax(
      worst, compare_numbers(r, lambda, &s->joint[i].stiffness, 3, got->passive + 3 * i, 1e-300));
  }
  return worst;
}

typedef struct errors {
  double jacobian, adjoint, parameters, dot;
} errors;

/* The step at (q, v, tau, v_end), which must solve it, against the reference. */
static errors compare(kg_step *step, const kg_step_def *def, kg_random *random, const double *q,
                      const double *v, const double *tau, double dt, const double *v_end,
                      const kg_sdf_shape *ball)
{
  static double A[6][MATRIX];
  const int nv = def->body->nv;
  reference *r = reference_of(def, q, v, tau, dt, v_end, ball);
  double q_bar[MAX_NV], v_bar[MAX_NV], want[MAX_NV], part[MAX_NV], lambda[MAX_NV];
  for (int k = 0; k < nv; k++) {
    q_bar[k] = kg_random_normal(random);
    v_bar[k] = kg_random_normal(random);
  }
  const kg_step_jacobian jacobian = {A[0], A[1], A[2], A[3], A[4], A[5]};
  assert_int_equal(kg_step_derivatives(step, &jacobian, q, v, tau, dt, v_end, 1), KG_OK);
  errors e = {0.0, 0.0, 0.0, 0.0};
  for (int k = 0; k < 3; k++) {
    e.jacobian = fmax(e.jacobian, distance(A[k], r->dv[k], nv * nv));
    e.jacobian = fmax(e.jacobian, distance(A[3 + k], r->dq[k], nv * nv));
  }
  for (int k = 0; k < 6; k++) { /* each of them alone is the same */
    static double one[MATRIX];
    double *to[6] = {NULL};
    to[k] = one;
    const kg_step_jacobian alone = {to[0], to[1], to[2], to[3], to[4], to[5]};
    assert_int_equal(kg_step_derivatives(step, &alone, q, v, tau, dt, v_end, 1), KG_OK);
    assert_memory_equal(one, A[k], (size_t)(nv * nv) * sizeof *one);
  }
  gradient_arrays got;
  const kg_step_gradient gradient = arrays_of(&got);
  assert_int_equal(kg_step_vjp(step, &gradient, q, v, tau, dt, v_end, 1, q_bar, v_bar), KG_OK);
  const double *parts[3] = {got.q, got.v, got.tau};
  for (int k = 0; k < 3; k++) {
    transposed_product(r->dv[k], nv, nv, v_bar, 1.0, want);
    transposed_product(r->dq[k], nv, nv, q_bar, 1.0, part);
    double d[MAX_NV], left = 0.0, right = 0.0, size = 0.0;
    for (int c = 0; c < nv; c++) {
      want[c] += part[c];
      d[c] = kg_random_normal(random);
      right += parts[k][c] * d[c];
    }
    e.adjoint = fmax(e.adjoint, distance(parts[k], want, nv));
    /* <(q_bar, v_bar), A d> = <A'(q_bar, v_bar), d> between the library's own two forms */
    for (int i = 0; i < nv; i++) {
      double dv = 0.0, dq = 0.0;
      for (int c = 0; c < nv; c++) {
        dv += A[k][i * nv + c] * d[c];
        dq += A[3 + k][i * nv + c] * d[c];
      }
      left += v_bar[i] * dv + q_bar[i] * dq;
      size += v_bar[i] * v_bar[i] * dv * dv + q_bar[i] * q_bar[i] * dq * dq;
    }
    e.dot = fmax(e.dot, fabs(left - right) / sqrt(size * nv));
  }
  transposed_product(r->E, nv, nv, q_bar, 1.0, lambda);
  for (int k = 0; k < nv; k++) {
    lambda[k] += v_bar[k];
  }
  solve_with_lapack(nv, r->J, true, lambda, 1);
  e.parameters = compare_parameters(r, lambda, &got);
  free(r);
  return e;
}

/* ---- tests ------------------------------------------------------------------------------------*/

static kg_step *create_step(const kg_step_def *def)
{
  kg_step *step = NULL;
  assert_int_equal(kg_step_create(&step, def), KG_OK);
  return step;
}

static void expect(const char *name, errors e)
{
  print_message("%-28s Jacobian %.1e adjoint %.1e parameters %.1e dot test %.1e\n", name,
                e.jacobian, e.adjoint, e.parameters, e.dot);
  assert_at_most(e.jacobian, 1e-9);
  assert_at_most(e.adjoint, 1e-9);
  assert_at_most(e.parameters, 1e-9);
  assert_at_most(e.dot, 1e-12);
}

static const char *const names[KINDS] = {"flight", "standing", "sliding", "lying"};

static void derivatives_equal_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(7);
  kg_body *body = human_body();
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_joint_passive passive[HUMAN_SEGMENTS];
  for (int trial = 0; trial < 3 * KINDS; trial++) {
    const int kind = trial % KINDS;
    kg_step_def def = kg_step_default_def(body);
    def.scene = &scene;
    def.joint_damping = 0.5;
    def.passive = trial >= KINDS ? passive : NULL;
    random_passive(&random, body->segment_count, passive);
    kg_step *step = NULL;
    assert_int_equal(kg_step_create(&step, &def), KG_OK);
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], v_end[MAX_NV];
    human_state(&random, body, kind, q, v);
    for (int k = 0; k < body->nv; k++) {
      v_end[k] = v[k] + (kind == FLIGHT ? 0.3 : 1e-3) * kg_random_normal(&random);
    }
    /* whatever is left of the equation is the force: v_end solves the step */
    kg_step_report report;
    kg_step_residual(step, tau, NULL, v_end, q, v, NULL, 0.01, &report);
    assert_true(kind == FLIGHT ? report.contact_count == 0 : report.contact_count > 3);
    expect(names[kind], compare(step, &def, &random, q, v, tau, 0.01, v_end, NULL));
    kg_step_destroy(step);
  }
  kg_body_destroy(body);
}

/* The human at rest, all sole nodes at the same distance with the same velocity: every contact is
 * on a kink of the law at once, or one part in 1e14 to its sides. */
static void derivatives_hold_at_kinks(void **state)
{
  (void)state;
  kg_body *body = human_body();
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.contact.floor_share =
    0.3; /* by default 58 MN/m there: rounding of the pose alone makes 6e-8 */
  const kg_contact_params *law = &def.contact;
  const struct {
    const char *name;
    double phi, slip, rise;
  } rows[] = {{"stick to slip", 0.5 * law->layer, law->stick, 0.0},
              {"touch-down", law->layer, 2e-4, -0.01},
              {"floor of the law", law->floor_share * law->layer, 0.1, 0.0},
              {"push to part", 0.5 * law->layer, 0.1, 0.9 / law->damping},
              {"part to free", 0.5 * law->layer, 0.1, 1.1 / law->damping}};
  const double side[3] = {-1e-14, 0.0, 1e-14};
  kg_step *step = create_step(&def);
  kg_random random = kg_random_make(8);
  for (size_t k = 0; k < 3 * KG_COUNT_OF(rows); k++) {
    const double near = 1.0 + side[k % 3], dt = 0.01;
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], v_end[MAX_NV] = {0.0};
    v_end[0] = rows[k / 3].slip * near;
    v_end[1] = rows[k / 3].rise * near;
    rest_state(body, human_root_height + rows[k / 3].phi * near - dt * v_end[1], q);
    for (int c = 0; c < body->nv; c++) {
      v[c] = v_end[c] + 0.01 * kg_random_normal(&random);
    }
    kg_step_residual(step, tau, NULL, v_end, q, v, NULL, dt, NULL);
    expect(rows[k / 3].name, compare(step, &def, &random, q, v, tau, dt, v_end, NULL));
  }
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* the answers of the solver itself, one foot on a ball: curved ground */
static void derivatives_of_solved_steps(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .a = {0.07, -0.5, -0.05}, .radius = 0.5005};
  assert_true(kg_scene_add(&scene, &ball));
  int curved = 0;
  kg_random random = kg_random_make(9);
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 2.0;
  kg_step *step = create_step(&def);
  for (int trial = 0; trial < KINDS; trial++) {
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV] = {0.0}, q_end[MAX_NQ], v_end[MAX_NV];
    kg_step_report report;
    human_state(&random, body, trial, q, v);
    for (int k = 6; k < body->nv; k++) {
      tau[k] = kg_random_normal(&random);
    }
    kg_step_advance(step, q_end, v_end, q, v, tau, 1.0 / 120.0, false, &report);
    assert_true(report.converged && report.substeps == 1);
    assert_true((report.contact_count > 0) == (trial != FLIGHT));
    for (int k = 0; k < report.contact_count; k++) {
      curved += report.contacts[k].force.direction.y < 1.0;
    }
    expect(names[trial], compare(step, &def, &random, q, v, tau, 1.0 / 120.0, v_end, &ball));
  }
  assert_true(curved > 0);
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* The same on a mat, with a ball that moves under it, on one foot: pressed into the soft layer, and
 * through to the core. */
static void derivatives_on_soft_and_moving_ground(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_scene scene = {0};
  const kg_ground mat = {.thickness = 0.02, .stiffness = 2e4, .damping = 0.7, .friction = 0.6};
  const kg_place place = {
    .at = {0.07, -0.497, -0.05}, .velocity = {0.2, 0.05, -0.1}, .spin = {0.3, -0.4, 0.5}};
  const kg_sdf_shape floor = {.kind = KG_SHAPE_PLANE, .b = {0.0, 1.0, 0.0}, .ground = 1};
  kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .radius = 0.5005, .place = 1, .ground = 1};
  assert_int_equal(kg_scene_add_ground(&scene, &mat), 1);
  assert_int_equal(kg_scene_add_place(&scene, &place), 1);
  assert_true(kg_scene_add(&scene, &floor) && kg_scene_add(&scene, &ball));
  kg_random random = kg_random_make(19);
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 2.0;
  int soft_only = 0, on_core = 0, carried = 0;
  for (int trial = 0; trial < 4 * KINDS; trial++) {
    if (trial == 2 * KINDS) scene.grounds[0].friction = -1.0; /* that of the law */
    kg_step *step = create_step(&def);
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV] = {0.0}, q_end[MAX_NQ], v_end[MAX_NV];
    kg_step_report report;
    human_state(&random, body, trial % KINDS, q, v);
    if (trial / KINDS % 2 == 1) q[1] += 0.013;
    for (int k = 6; k < body->nv; k++) {
      tau[k] = kg_random_normal(&random);
    }
    kg_step_advance(step, q_end, v_end, q, v, tau, 1.0 / 120.0, false, &report);
    assert_true(report.converged && report.substeps == 1);
    assert_true((report.contact_count > 0) == (trial % KINDS != FLIGHT));
    for (int k = 0; k < report.contact_count; k++) {
      const kg_contact_force *force = &report.contacts[k].force;
      soft_only += force->distance > def.contact.layer;
      on_core += force->distance < def.contact.layer;
      carried += kg_vec3_norm(force->velocity) > 0.0;
    }
    expect(names[trial % KINDS],
           compare(step, &def, &random, q, v, tau, 1.0 / 120.0, v_end, &ball));
    kg_step_destroy(step);
  }
  print_message("%d soft, %d on the core, %d carried\n", soft_only, on_core, carried);
  assert_true(soft_only > 10 && on_core > 10 && carried > 5);
  kg_body_destroy(body);
}

typedef struct trajectory {
  kg_step *step;
  const kg_body *body;
  double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], dt;
  double q_there[MAX_NQ]; /* where tangents of the end are taken */
  double q_bar[MAX_NV], v_bar[MAX_NV];
} trajectory;

/* q_bar . (q' - q'_0) + v_bar . v' for the start moved by s d, v by s e, tau by s f */
static double end_weighed(const trajectory *t, double s, const double *d, int substeps)
{
  double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], moved[MAX_NV] = {0.0}, q_end[MAX_NQ], v_end[MAX_NV];
  const int nv = t->body->nv;
  for (int k = 0; k < nv; k++) {
    moved[k] = s * d[k];
    v[k] = t->v[k] + s * d[nv + k];
    tau[k] = t->tau[k] + s * d[2 * nv + k];
  }
  kg_step_report report;
  kg_body_integrate(t->body, q, t->q, moved);
  kg_step_advance(t->step, q_end, v_end, q, v, tau, t->dt, false, &report);
  assert_true(report.converged && report.substeps == substeps);
  kg_body_difference(t->body, moved, q_end, t->q_there);
  double sum = 0.0;
  for (int k = 0; k < nv; k++) {
    sum += t->q_bar[k] * moved[k] + t->v_bar[k] * v_end[k];
  }
  return sum;
}

/* Differences of the step as it is called, four sizes extrapolated: what users will try first.
 * iterations: so few that steps of this length have to be divided. */
static void compare_with_differences(int iterations, double dt, bool divided)
{
  kg_random random = kg_random_make(10);
  kg_body *body = random_tree(&random, 8, NULL);
  kg_joint_passive passive[8];
  random_passive(&random, 8, passive);
  kg_step_def def = kg_step_default_def(body);
  def.passive = passive;
  def.tolerance = 1e-13;
  def.max_iterations = iterations;
  static trajectory t;
  t = (trajectory){.step = create_step(&def), .body = body, .dt = dt};
  random_state(&random, body, t.q, t.v, t.tau);
  double a[MAX_NV];
  random_state(&random, body, t.q, t.v, a);
  double d[3 * MAX_NV], v_end[MAX_NV], got[3][MAX_NV] = {{0.0}};
  for (int k = 0; k < body->nv; k++) {
    t.q_bar[k] = kg_random_normal(&random);
    t.v_bar[k] = kg_random_normal(&random);
  }
  for (int k = 0; k < 3 * body->nv; k++) {
    d[k] = kg_random_normal(&random);
  }
  kg_step_report report;
  kg_step_advance(t.step, t.q_there, v_end, t.q, t.v, t.tau, t.dt, false, &report);
  const int parts = report.substeps;
  assert_true(report.converged && divided == (parts > 1));
  const kg_step_gradient g = {.q = got[0], .v = got[1], .tau = got[2]};
  assert_int_equal(kg_step_vjp(t.step, &g, t.q, t.v, t.tau, t.dt, v_end, parts, t.q_bar, t.v_bar),
                   KG_OK);
  double slope[4], want = 0.0;
  for (int k = 0; k < 4; k++) {
    const double h = 4e-3 / (1 << k);
    slope[k] = (end_weighed(&t, h, d, parts) - end_weighed(&t, -h, d, parts)) / (2.0 * h);
  }
  for (int level = 1; level < 4; level++) { /* Richardson: errors in even powers of h */
    for (int k = 3; k >= level; k--) {
      slope[k] += (slope[k] - slope[k - 1]) / (pow(4.0, level) - 1.0);
    }
  }
  for (int part = 0; part < 3; part++) {
    for (int k = 0; k < body->nv; k++) {
      want += got[part][k] * d[part * body->nv + k];
    }
  }
  print_message("%d sub-steps: gradient along a direction %.15g, by differences %.15g\n", parts,
                want, slope[3]);
  assert_close(want, slope[3], 1e-9);
  kg_step_destroy(t.step);
  kg_body_destroy(body);
}

static void gradient_equals_differences(void **state)
{
  (void)state;
  compare_with_differences(50, 0.01, false);
  compare_with_differences(2, 0.02, true);
}

/* ---- sub-steps --------------------------------------------------------------------------------*/

/* all of a gradient's numbers times s */
static void scale_arrays(gradient_arrays *a, double s)
{
  double *x = (double *)a;
  for (size_t k = 0; k < sizeof *a / sizeof *x; k++) {
    x[k] *= s;
  }
}

/* Results are added: a second call doubles what the first one left in the arrays. */
static void assert_added(kg_step *step, const double *q, const double *v, const double *tau,
                         double dt, const double *v_end, int substeps, const double *q_bar,
                         const double *v_bar)
{
  static gradient_arrays once, twice;
  kg_step_gradient g = arrays_of(&once);
  assert_int_equal(kg_step_vjp(step, &g, q, v, tau, dt, v_end, substeps, q_bar, v_bar), KG_OK);
  g = arrays_of(&twice);
  for (int call = 0; call < 2; call++) {
    assert_int_equal(kg_step_vjp(step, &g, q, v, tau, dt, v_end, substeps, q_bar, v_bar), KG_OK);
  }
  scale_arrays(&once, 2.0);
  const double *a = (const double *)&once, *b = (const double *)&twice;
  const struct {
    const double *want, *got;
    int count;
  } rows[] = {{once.q, twice.q, MAX_NV},
              {once.v, twice.v, MAX_NV},
              {once.tau, twice.tau, MAX_NV},
              {once.contact, twice.contact, 6},
              {once.mass, twice.mass, MAX_NV},
              {once.com, twice.com, MAX_NV},
              {once.inertia, twice.inertia, 6 * MAX_NV},
              {once.offset, twice.offset, MAX_NV},
              {once.points, twice.points, 3 * MAX_POINTS}};
  for (size_t k = 0; k < KG_COUNT_OF(rows); k++) {
    assert_true(largest(rows[k].want, rows[k].count) > 0.0);
    assert_at_most(distance(rows[k].got, rows[k].want, rows[k].count), 1e-12);
  }
  assert_at_most(distance(b, a, (int)(sizeof once / sizeof *a)), 1e-12);
}

/* Four steps one after the other, and the same as one step in four sub-steps. */
static void substeps_are_gone_back_through(void **state)
{
  (void)state;
  enum { PARTS = 4 };
  static double q[PARTS + 1][MAX_NQ], v[PARTS + 1][MAX_NV];
  static double A[6][MATRIX];
  kg_body *body = human_body();
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *step = create_step(&def);
  kg_random random = kg_random_make(11);
  const int nv = body->nv;
  const double dt = 0.01;
  double tau[MAX_NV], q_bar[PARTS + 1][MAX_NV] = {{0.0}}, v_bar[PARTS + 1][MAX_NV] = {{0.0}};
  human_state(&random, body, STANDING, q[0], v[0]);
  for (int k = 0; k < nv; k++) {
    tau[k] = k < 6 ? 0.0 : kg_random_normal(&random);
    q_bar[PARTS][k] = kg_random_normal(&random);
    v_bar[PARTS][k] = kg_random_normal(&random);
  }
  for (int k = 0; k < PARTS; k++) {
    kg_step_report report;
    kg_step_advance(step, q[k + 1], v[k + 1], q[k], v[k], tau, dt / PARTS, false, &report);
    assert_true(report.converged && report.substeps == 1 && report.contact_count > 0);
  }
  static gradient_arrays want, got;
  kg_step_gradient g = arrays_of(&want);
  for (int k = PARTS - 1; k >= 0; k--) {
    g.q = q_bar[k];
    g.v = v_bar[k];
    assert_int_equal(
      kg_step_vjp(step, &g, q[k], v[k], tau, dt / PARTS, v[k + 1], 1, q_bar[k + 1], v_bar[k + 1]),
      KG_OK);
  }
  g = arrays_of(&got);
  assert_int_equal(
    kg_step_vjp(step, &g, q[0], v[0], tau, dt, v[PARTS], PARTS, q_bar[PARTS], v_bar[PARTS]), KG_OK);
  assert_true(distance(got.q, q_bar[0], nv) < 1e-13 && largest(got.q, nv) > 0.0);
  assert_true(distance(got.v, v_bar[0], nv) < 1e-13);
  assert_true(distance(got.tau, want.tau, nv) < 1e-13);
  assert_true(distance(got.contact, want.contact, 6) < 1e-13 && largest(got.contact, 6) > 0.0);
  assert_true(distance(got.mass, want.mass, body->segment_count) < 1e-13);
  const kg_step_jacobian J = {A[0], A[1], A[2], A[3], A[4], A[5]};
  assert_int_equal(kg_step_derivatives(step, &J, q[0], v[0], tau, dt, v[PARTS], PARTS), KG_OK);
  double *const of[3] = {got.q, got.v, got.tau};
  for (int k = 0; k < 3; k++) {
    double by_v[MAX_NV], by_q[MAX_NV];
    transposed_product(A[k], nv, nv, v_bar[PARTS], 1.0, by_v);
    transposed_product(A[3 + k], nv, nv, q_bar[PARTS], 1.0, by_q);
    for (int c = 0; c < nv; c++) {
      by_v[c] += by_q[c];
    }
    assert_at_most(distance(by_v, of[k], nv), 1e-12);
  }
  assert_added(step, q[0], v[0], tau, dt, v[PARTS], PARTS, q_bar[PARTS], v_bar[PARTS]);
  assert_added(step, q[0], v[0], tau, dt / PARTS, v[1], 1, q_bar[PARTS], v_bar[PARTS]);
  /* a step that was not divided so is refused */
  assert_int_equal(
    kg_step_vjp(step, &g, q[0], v[0], tau, dt, v[PARTS], 1, q_bar[PARTS], v_bar[PARTS]),
    KG_ERR_UNDEFINED);
  assert_int_equal(
    kg_step_vjp(step, &g, q[0], v[0], tau, dt, v[PARTS], 2, q_bar[PARTS], v_bar[PARTS]),
    KG_ERR_UNDEFINED);
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* A rod without inertia about its axis falls without weight: nothing resists a turn about the axis
 * until fins on both sides touch the ground, which they do in the second half of the step. */
static void a_gradient_is_whole_or_nothing(void **state)
{
  (void)state;
  enum { POINTS = 2 };
  kg_segment rod = {.role = -1, .joint = -1, .parent = -1, .mass = 2.0};
  const double inertia[6] = {0.5, 0.5, 1.0, -0.5, 0.0, 0.0}; /* about the axis (1, 1, 0): none */
  memcpy(rod.inertia, inertia, sizeof inertia);
  const kg_body_point fins[POINTS] = {{0, {0.25, -0.25, 0.0}}, {0, {-0.25, 0.25, 0.0}}};
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, &rod, 1, fins, POINTS, NULL), KG_OK);
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 0.0, 1.0));
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.gravity = kg_vec3_make(0.0, 0.0, 0.0);
  kg_step *step = create_step(&def);
  double q[3][7] = {{0.0, 0.0, 0.005 + 1.5 * def.contact.layer, 1.0}}, v[3][6] = {{0, 0, -1.0}};
  const double bar[6] = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0};
  for (int k = 0; k < 2; k++) {
    kg_step_report report;
    kg_step_advance(step, q[k + 1], v[k + 1], q[k], v[k], NULL, 0.005, false, &report);
    assert_true(report.converged && report.substeps == 1);
    assert_int_equal(report.contact_count, k == 0 ? 0 : POINTS);
  }
  static gradient_arrays got, none;
  const kg_step_gradient g = arrays_of(&got);
  /* the second half alone has derivatives, the first has none */
  assert_int_equal(kg_step_vjp(step, &g, q[1], v[1], NULL, 0.005, v[2], 1, bar, bar), KG_OK);
  assert_true(largest(got.tau, 6) > 0.0);
  memset(&got, 0, sizeof got);
  assert_int_equal(kg_step_vjp(step, &g, q[0], v[0], NULL, 0.005, v[1], 1, bar, bar),
                   KG_ERR_UNDEFINED);
  assert_int_equal(kg_step_vjp(step, &g, q[0], v[0], NULL, 0.01, v[2], 2, bar, bar),
                   KG_ERR_UNDEFINED);
  assert_memory_equal(&got, &none, sizeof got);
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* ---- refusals, memory -------------------------------------------------------------------------*/

static void what_is_no_solution_is_refused(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_step_def def = kg_step_default_def(body);
  kg_step *step = create_step(&def);
  kg_random random = kg_random_make(12);
  double q[MAX_NQ], v[MAX_NV], q_end[MAX_NQ], v_end[MAX_NV], bar[MAX_NV] = {1.0};
  double tau[MAX_NV] = {0.0}, none[MAX_NV] = {0.0}, A[MATRIX];
  human_state(&random, body, FLIGHT, q, v);
  kg_step_advance(step, q_end, v_end, q, v, NULL, 0.01, false, NULL);
  const kg_step_gradient g = {.tau = tau};
  const kg_step_jacobian j = {.dv_dq = A};
  assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, v_end, 1, bar, bar), KG_OK);
  assert_true(tau[0] != 0.0);
  const double wrong[2] = {v_end[7] + 1e-5, NAN};
  for (int k = 0; k < 2; k++) {
    memset(tau, 0, sizeof tau);
    v_end[7] = wrong[k];
    assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, v_end, 1, bar, bar), KG_ERR_UNDEFINED);
    assert_int_equal(kg_step_derivatives(step, &j, q, v, NULL, 0.01, v_end, 1), KG_ERR_UNDEFINED);
    assert_memory_equal(tau, none, sizeof tau);
  }
  kg_step_destroy(step);
  kg_body_destroy(body);
}

/* Ten times the tolerance: less is accepted, more is not, of the residual of a plain step and of
 * the end of a divided one. */
static void ten_times_the_tolerance_is_a_solution(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_step_def def = kg_step_default_def(body);
  def.tolerance = 1e-7;
  kg_step *step = create_step(&def);
  kg_random random = kg_random_make(15);
  double q[MAX_NQ], v[MAX_NV], q_end[MAX_NQ], v_end[MAX_NV], near[MAX_NV], G[MAX_NV];
  double tau[MAX_NV] = {0.0}, bar[MAX_NV] = {1.0};
  const kg_step_gradient g = {.tau = tau};
  const double times[4] = {5.0, 9.0, 11.0, 20.0};
  kg_step_report report;
  human_state(&random, body, FLIGHT, q, v);
  kg_step_advance(step, q_end, v_end, q, v, NULL, 0.01, false, &report);
  assert_true(report.converged && report.substeps == 1);
  for (int k = 0; k < 4; k++) {
    double d = 1e-6; /* of one rate; the residual grows in proportion */
    memcpy(near, v_end, sizeof near);
    for (int pass = 0; pass < 4; pass++) {
      near[7] = v_end[7] + d;
      kg_step_residual(step, G, NULL, near, q, v, NULL, 0.01, &report);
      d *= times[k] * def.tolerance / report.residual;
    }
    assert_close(report.residual, times[k] * def.tolerance, 0.02);
    assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, near, 1, bar, bar),
                     times[k] < 10.0 ? KG_OK : KG_ERR_UNDEFINED);
  }
  double q_half[MAX_NQ], v_half[MAX_NV];
  kg_step_advance(step, q_half, v_half, q, v, NULL, 0.005, false, &report);
  kg_step_advance(step, q_end, v_end, q_half, v_half, NULL, 0.005, false, &report);
  for (int k = 0; k < 4; k++) {
    memcpy(near, v_end, sizeof near);
    near[7] += times[k] * def.tolerance * (1.0 + fabs(v_end[7]));
    assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, near, 2, bar, bar),
                     times[k] < 10.0 ? KG_OK : KG_ERR_UNDEFINED);
  }
  kg_step_destroy(step);
  kg_body_destroy(body);
}

static void nothing_is_allocated(void **state)
{
  (void)state;
  static double A[6][MATRIX];
  kg_body *body = human_body();
  const kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_joint_passive passive[HUMAN_SEGMENTS];
  kg_random random = kg_random_make(13);
  random_passive(&random, body->segment_count, passive);
  failing_heap heap = {.calls_left = 1000};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.passive = passive;
  def.allocator = &allocator;
  kg_step *step = create_step(&def);
  const int calls = heap.calls_left;
  double q[MAX_NQ], v[MAX_NV], q_end[MAX_NQ], v_end[MAX_NV], bar[MAX_NV] = {1.0};
  gradient_arrays arrays;
  const kg_step_gradient g = arrays_of(&arrays);
  const kg_step_jacobian j = {A[0], A[1], A[2], A[3], A[4], A[5]};
  human_state(&random, body, LYING, q, v);
  kg_step_report report;
  kg_step_advance(step, q_end, v_end, q, v, NULL, 0.01, false, &report);
  assert_true(report.converged);
  const int parts = report.substeps;
  assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, v_end, parts, bar, bar), KG_OK);
  assert_int_equal(kg_step_derivatives(step, &j, q, v, NULL, 0.01, v_end, parts), KG_OK);
  assert_int_equal(kg_step_vjp(step, &g, q, v, NULL, 0.01, q, 8, bar, bar), KG_ERR_UNDEFINED);
  assert_int_equal(heap.calls_left, calls);
  kg_step_destroy(step);
  assert_int_equal(heap.live_bytes, 0);
  kg_body_destroy(body);
}

/* ---- passive joints ---------------------------------------------------------------------------*/

/* Two segments that do not move: G holds the torque of the joint alone. */
static void passive_torque_is_the_slope_of_its_energy(void **state)
{
  (void)state;
  kg_random random = kg_random_make(14);
  double worst = 0.0;
  for (int trial = 0; trial < 60; trial++) {
    kg_body *body = random_tree(&random, 2, NULL);
    kg_joint_passive passive[2];
    random_passive(&random, 2, passive);
    kg_step_def def = kg_step_default_def(body);
    def.gravity = kg_vec3_make(0.0, 0.0, 0.0);
    def.passive = passive;
    kg_step *step = create_step(&def);
    double q[MAX_NQ], v[MAX_NV] = {0.0}, G[MAX_NV];
    rest_state(body, 0.0, q);
    /* from next to rest to nearly half a turn; every third across the series' end */
    const double angle = trial % 3 == 0   ? 0.7 + 1e-3 * kg_random_normal(&random)
                         : trial % 3 == 1 ? 1e-4
                                          : 2.8 * kg_random_uniform(&random);
    const kg_vec3 axis = kg_vec3_normalized(random_vec3(&random, 1.0));
    const kg_quat at = kg_quat_mul(passive[1].rest, kg_quat_exp(kg_vec3_scale(angle, axis)));
    memcpy(q + 7, &at, sizeof at);
    kg_step_residual(step, G, NULL, v, q, v, NULL, 0.01, NULL);
    for (int k = 0; k < 3; k++) {
      double slope[2];
      for (int level = 0; level < 2; level++) {
        const double h = level == 0 ? 2e-4 : 1e-4;
        kg_vec3 d = {k == 0 ? h : 0.0, k == 1 ? h : 0.0, k == 2 ? h : 0.0};
        const double up = kg_joint_passive_energy(&passive[1], kg_quat_mul(at, kg_quat_exp(d)));
        d = kg_vec3_scale(-1.0, d);
        const double down = kg_joint_passive_energy(&passive[1], kg_quat_mul(at, kg_quat_exp(d)));
        slope[level] = (up - down) / (2.0 * h);
      }
      const double want = slope[1] + (slope[1] - slope[0]) / 3.0;
      const double size = 1.0 + fabs(G[6]) + fabs(G[7]) + fabs(G[8]);
      worst = fmax(worst, fabs(G[6 + k] - want) / size);
    }
    kg_step_destroy(step);
    kg_body_destroy(body);
  }
  print_message("passive torque against the slope of its energy: %.1e\n", worst);
  assert_at_most(worst, 1e-8); /* a limit inside the difference costs third derivatives */
}

/* The default does nothing; no rest is the identity. */
static void passive_joints_without_numbers(void **state)
{
  (void)state;
  kg_random random = kg_random_make(16);
  kg_body *body = random_tree(&random, 2, NULL);
  kg_joint_passive passive[2] = {kg_joint_passive_default(), kg_joint_passive_default()};
  kg_step_def def = kg_step_default_def(body);
  def.gravity = kg_vec3_make(0.0, 0.0, 0.0);
  def.passive = passive;
  kg_step *step = create_step(&def);
  double q[MAX_NQ], v[MAX_NV] = {0.0}, G[MAX_NV];
  rest_state(body, 0.0, q);
  const kg_quat at = kg_quat_exp(kg_vec3_make(0.5, 0.0, 0.0));
  memcpy(q + 7, &at, sizeof at);
  kg_step_residual(step, G, NULL, v, q, v, NULL, 0.01, NULL);
  assert_at_most(largest(G, body->nv), 0.0);
  passive[1].limit_stiffness = 7.0; /* no limits */
  kg_step_residual(step, G, NULL, v, q, v, NULL, 0.01, NULL);
  assert_at_most(largest(G, body->nv), 0.0);
  for (int k = 0; k < 2; k++) {
    const kg_joint_passive spring = {.stiffness = 100.0};
    if (k == 0) {
      passive[1].stiffness = 100.0;
    } else {
      passive[1] = spring; /* all the rest zero, the rotation of rest too */
    }
    kg_step_residual(step, G, NULL, v, q, v, NULL, 0.01, NULL);
    assert_close(G[6], 50.0, 1e-12);
    assert_close(kg_joint_passive_energy(&passive[1], at), 12.5, 1e-12);
  }
  kg_step_destroy(step);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(derivatives_equal_complex_steps),
    cmocka_unit_test(derivatives_hold_at_kinks),
    cmocka_unit_test(derivatives_of_solved_steps),
    cmocka_unit_test(derivatives_on_soft_and_moving_ground),
    cmocka_unit_test(gradient_equals_differences),
    cmocka_unit_test(substeps_are_gone_back_through),
    cmocka_unit_test(a_gradient_is_whole_or_nothing),
    cmocka_unit_test(ten_times_the_tolerance_is_a_solution),
    cmocka_unit_test(passive_joints_without_numbers),
    cmocka_unit_test(what_is_no_solution_is_refused),
    cmocka_unit_test(nothing_is_allocated),
    cmocka_unit_test(passive_torque_is_the_slope_of_its_energy),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
