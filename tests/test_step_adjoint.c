/* Derivatives of a step: against dense LAPACK on complex steps of an independent residual, in flight,
 * standing, sliding, lying and at the kinks of the contact law; sub-steps; refusals. */
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

/* ---- the reference -----------------------------------------------------------------------------*/

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

/* X := J^-1 X (transposed: J^-T X) with equilibration and iterative refinement; X (n, columns) row-major */
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
                               const double *tau, double dt, const double *v_end)
{
  reference *r = calloc(1, sizeof *r);
  assert_non_null(r);
  r->at = complex_step_of(def, q, v, tau, dt, v_end);
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

/* ---- comparison --------------------------------------------------------------------------------*/

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

/* -lambda' dG/dx for numbers that lie `stride` complex numbers apart, in groups of `width` */
static double compare_numbers(reference *r, const double *lambda, cplx *x, int count,
                              const double *got)
{
  double *A = malloc(sizeof(double) * (size_t)(count * r->nv));
  double *want = malloc(sizeof(double) * (size_t)count);
  assert_true(A && want);
  matrix_by(&r->at, x, count, A);
  transposed_product(A, r->nv, count, lambda, -1.0, want);
  const double error = distance(got, want, count);
  free(A);
  free(want);
  return error;
}

/* By all parameters. Arrays of c3 and of six numbers are arrays of complex numbers. */
static double compare_parameters(reference *r, const double *lambda, const gradient_arrays *got)
{
  complex_step *s = &r->at;
  const int n = s->body.n;
  double worst = compare_numbers(r, lambda, s->body.mass, n, got->mass);
  worst = fmax(worst, compare_numbers(r, lambda, &s->body.com[0].x, 3 * n, got->com));
  worst = fmax(worst, compare_numbers(r, lambda, s->body.inertia[0], 6 * n, got->inertia));
  worst = fmax(worst, compare_numbers(r, lambda, &s->body.offset[0].x, 3 * n, got->offset));
  worst = fmax(worst, compare_numbers(r, lambda, &s->joint_damping, 1, &got->joint_damping));
  if (largest(got->contact, 6) > 0.0) {
    for (int k = 0; k < 6;
         k++) { /* of very different sizes: one by one, against the largest effect */
      const double scale = fabs(creal(s->contact[k]));
      double column[MAX_NV], want = 0.0, parts = 0.0;
      column_by(s, &s->contact[k], column);
      for (int i = 0; i < r->nv; i++) {
        want -= lambda[i] * column[i];
        parts += fabs(lambda[i] * column[i]);
      }
      const double error = fabs(got->contact[k] - want) / fmax(parts, 1e-300);
      worst = fmax(worst, parts * scale > 0.0 ? error : fabs(got->contact[k]));
    }
    const int count = 3 * s->body.point_count;
    worst = fmax(worst, compare_numbers(r, lambda, &s->body.point[0].x, count, got->points));
  }
  for (int i = 1; i < n && s->has_passive; i++) {
    worst =
      fmax(worst, compare_numbers(r, lambda, &s->joint[i].stiffness, 3, got->passive + 3 * i));
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
  reference *r = reference_of(def, q, v, tau, dt, v_end);
  if (ball) { /* the reference again, with the ball */
    free(r);
    r = calloc(1, sizeof *r);
    assert_non_null(r);
  }
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

/* ---- tests -------------------------------------------------------------------------------------*/

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
    const errors e = compare(step, &def, &random, q, v, tau, 0.01, v_end, NULL);
    print_message("%-8s Jacobian %.1e adjoint %.1e parameters %.1e dot test %.1e\n", names[kind],
                  e.jacobian, e.adjoint, e.parameters, e.dot);
    assert_at_most(e.jacobian, 1e-9);
    assert_at_most(e.adjoint, 1e-9);
    assert_at_most(e.parameters, 1e-9);
    assert_at_most(e.dot, 1e-12);
    kg_step_destroy(step);
  }
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(derivatives_equal_complex_steps),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
