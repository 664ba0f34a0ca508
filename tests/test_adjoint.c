/* The adjoint of inverse dynamics: against complex steps of an independent model, entry by entry in
 * every argument and every number of the body. */
#include "complex_body.h"

enum { TREES = 12 };
static const double H = 1e-100;

typedef struct point_of_trial {
  complex_body body;
  const double *q, *v, *a, *lambda;
} point_of_trial;

/* lambda' ID with tangent d, imaginary parts of v and a in dv, da (NULL: none) */
static cplx weighed(const point_of_trial *t, const complex_body *body, const cplx *d,
                    const cplx *v_in, const cplx *a_in)
{
  complex_pose pose = complex_pose_of(body, t->q);
  cplx v[MAX_NV], a[MAX_NV], tau[MAX_NV], sum = 0.0;
  const int nv = 3 + 3 * body->n;
  for (int k = 0; k < nv; k++) {
    v[k] = v_in ? v_in[k] : t->v[k];
    a[k] = a_in ? a_in[k] : t->a[k];
  }
  if (d) {
    complex_move(body, &pose, 1.0, d);
  }
  complex_place(body, &pose);
  complex_inverse(body, &pose, v, a, tau);
  for (int k = 0; k < nv; k++) {
    sum += t->lambda[k] * tau[k];
  }
  return sum;
}

static double by_state(const point_of_trial *t, int kind, int k)
{
  cplx x[MAX_NV] = {0.0};
  const int nv = 3 + 3 * t->body.n;
  for (int j = 0; j < nv && kind > 0; j++) {
    x[j] = kind == 1 ? t->v[j] : t->a[j];
  }
  x[k] += _Complex_I * H;
  return cimag(
           weighed(t, &t->body, kind == 0 ? x : NULL, kind == 1 ? x : NULL, kind == 2 ? x : NULL)) /
         H;
}

static double by_number(point_of_trial *t, cplx *number)
{
  *number += _Complex_I * H;
  const double slope = cimag(weighed(t, &t->body, NULL, NULL, NULL)) / H;
  *number = creal(*number);
  return slope;
}

static double largest(const double *x, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    size = fmax(size, fabs(x[k]));
  }
  return size;
}

static void assert_same(const double *got, const double *want, int count, double *worst)
{
  const double size = fmax(largest(want, count), 1e-300);
  for (int k = 0; k < count; k++) {
    const double error = fabs(got[k] - want[k]) / size;
    *worst = fmax(*worst, error);
    assert_at_most(error, 1e-12);
  }
}

static void adjoint_equals_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  double worst = 0.0;
  for (int trial = 0; trial < TREES; trial++) {
    kg_body *body = trial == 0 ? human_body() : random_tree(&random, 1 + trial, NULL);
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], lambda[MAX_NV];
    double got[3][MAX_NV] = {{0.0}}, want[6 * MAX_NV];
    double mass[MAX_NV] = {0.0}, com[MAX_NV] = {0.0}, inertia[6 * MAX_NV] = {0.0},
           offset[MAX_NV] = {0.0};
    random_state(&random, body, q, v, a);
    for (int k = 0; k < body->nv; k++) {
      lambda[k] = kg_random_normal(&random);
    }
    kg_dynamics *d = NULL;
    assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
    const kg_body_gradient bar = {.mass = mass, .com = com, .inertia = inertia, .offset = offset};
    kg_dynamics_inverse_vjp(d, got[0], got[1], got[2], &bar, q, v, a, lambda);
    point_of_trial t = {complex_body_of(body), q, v, a, lambda};
    const int n = body->segment_count;
    for (int kind = 0; kind < 3; kind++) {
      for (int k = 0; k < body->nv; k++) {
        want[k] = by_state(&t, kind, k);
      }
      assert_same(got[kind], want, body->nv, &worst);
    }
    for (int i = 0; i < n; i++) {
      want[i] = by_number(&t, &t.body.mass[i]);
    }
    assert_same(mass, want, n, &worst);
    for (int k = 0; k < 3 * n; k++) {
      want[k] = by_number(&t, &t.body.com[k / 3].x + k % 3);
    }
    assert_same(com, want, 3 * n, &worst);
    for (int k = 0; k < 3 * n; k++) {
      want[k] = by_number(&t, &t.body.offset[k / 3].x + k % 3);
    }
    assert_same(offset, want, 3 * n, &worst);
    for (int k = 0; k < 6 * n; k++) {
      want[k] = by_number(&t, &t.body.inertia[k / 6][k % 6]);
    }
    assert_same(inertia, want, 6 * n, &worst);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
  print_message("adjoint of inverse dynamics against complex steps: %.1e\n", worst);
}

/* results are added, and what is not wanted is not written */
static void adjoint_adds_what_is_wanted(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  kg_body *body = random_tree(&random, 9, NULL);
  double q[MAX_NQ], v[MAX_NV], a[MAX_NV], lambda[MAX_NV];
  double once[MAX_NV] = {0.0}, twice[MAX_NV] = {0.0}, mass[MAX_NV] = {0.0};
  random_state(&random, body, q, v, a);
  random_state(&random, body, q, v, lambda);
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_dynamics_inverse_vjp(d, once, NULL, NULL, NULL, q, v, a, lambda);
  kg_dynamics_inverse_vjp(d, twice, NULL, NULL, NULL, q, v, a, lambda);
  kg_dynamics_inverse_vjp(d, twice, NULL, NULL, &(kg_body_gradient){.mass = mass}, q, v, a, lambda);
  for (int k = 0; k < body->nv; k++) {
    assert_true(twice[k] == once[k] + once[k]);
  }
  assert_true(mass[0] != 0.0);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(adjoint_equals_complex_steps),
    cmocka_unit_test(adjoint_adds_what_is_wanted),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
