/* Eight frames at once: every lane against the plain call and against the same source over plain
 * doubles, on every instruction set and without vectors; derivatives against complex steps; frames
 * that do not touch each other. */
#include "fixture_dynamics.h"

#include "kinegrad/dynamics_lanes.h"

#include <float.h>

void dgesv_(const int *n, const int *nrhs, double *a, const int *lda, int *ipiv, double *b,
            const int *ldb, int *info);

enum { BIG_N = 40, DENSE = BIG_NV * BIG_NV };

/* Eight states, frame after frame and side by side. */
typedef struct eight {
  double q[8 * BIG_NQ], v[8 * BIG_NV], a[8 * BIG_NV];
  double lanes_q[8 * BIG_NQ], lanes_v[8 * BIG_NV], lanes_a[8 * BIG_NV];
} eight;

static void put_in_lanes(const kg_body *body, eight *e)
{
  to_lanes(e->lanes_q, e->q, body->nq);
  to_lanes(e->lanes_v, e->v, body->nv);
  to_lanes(e->lanes_a, e->a, body->nv);
}

static void random_eight(kg_random *random, const kg_body *body, eight *e)
{
  for (int f = 0; f < 8; f++) {
    random_state(random, body, e->q + f * body->nq, e->v + f * body->nv, e->a + f * body->nv);
  }
  put_in_lanes(body, e);
}

/* Frame f of lanes. */
static void frame_of(double *row, const double *lanes, int count, int f)
{
  for (int k = 0; k < count; k++) {
    row[k] = lanes[8 * k + f];
  }
}

static double relative_difference(const double *a, const double *b, int count)
{
  const double size = largest(b, count);
  return largest_difference(a, b, count) / (size > 0.0 ? size : 1.0);
}

/* ---- every output of the calls in lanes -------------------------------------------------------*/

typedef struct results {
  double p[8 * 3 * BIG_N], R[8 * 9 * BIG_N], p_dot[8 * 3 * BIG_N], w[8 * 3 * BIG_N];
  double p_ddot[8 * 3 * BIG_N], alpha[8 * 3 * BIG_N];
  double x[24], J[8 * 3 * BIG_NV];
  double solved[8 * BIG_NV], factored[8 * BIG_NV], forward[8 * BIG_NV], inverse[8 * BIG_NV];
  kg_centroid_lanes centroid;
  double A[8 * 6 * BIG_NV];
  double M[8][DENSE], by_q[8][DENSE], by_v[8][DENSE], by_a[8][DENSE];
  double da[3][8 * DENSE];
} results;

static kg_body_point point_of(const kg_body *body)
{
  return (kg_body_point){body->segment_count - 1, {0.03, -0.12, 0.07}};
}

static void run_all(kg_dynamics *d, const eight *e, results *r)
{
  const kg_body *body = d->body;
  kg_lanes_matrix *m[3];
  memset(r, 0, sizeof *r);
  for (int k = 0; k < 3; k++) {
    assert_int_equal(kg_lanes_matrix_create(&m[k], d, NULL), KG_OK);
  }
  kg_dynamics_velocity_lanes(d, e->lanes_q, e->lanes_v, r->p, r->R, r->p_dot, r->w);
  kg_dynamics_acceleration_lanes(d, e->lanes_q, e->lanes_v, e->lanes_a, r->p_ddot, r->alpha);
  kg_dynamics_point_lanes(d, r->x, r->J, e->lanes_q, point_of(body));
  kg_dynamics_centroid_lanes(d, &r->centroid, e->lanes_q, e->lanes_v);
  kg_dynamics_centroidal_matrix_lanes(d, r->A, e->lanes_q);
  memcpy(r->solved, e->lanes_a, sizeof r->solved);
  memcpy(r->factored, e->lanes_a, sizeof r->factored);
  kg_dynamics_mass_solve_lanes(d, r->solved, e->lanes_q);
  kg_dynamics_mass_matrix_lanes(d, m[0], e->lanes_q);
  for (int f = 0; f < 8; f++) {
    kg_lanes_matrix_dense(m[0], f, r->M[f]);
  }
  assert_int_equal(kg_lanes_matrix_factor(m[0]), 0);
  kg_lanes_matrix_solve(m[0], r->factored);
  kg_dynamics_inverse_derivatives_lanes(d, m[0], m[1], m[2], r->inverse, e->lanes_q, e->lanes_v,
                                        e->lanes_a);
  for (int f = 0; f < 8; f++) {
    kg_lanes_matrix_dense(m[0], f, r->by_q[f]);
    kg_lanes_matrix_dense(m[1], f, r->by_v[f]);
    kg_lanes_matrix_dense(m[2], f, r->by_a[f]);
  }
  kg_dynamics_forward_derivatives_lanes(d, r->da[0], r->da[1], r->da[2], r->forward, e->lanes_q,
                                        e->lanes_v, e->lanes_a);
  for (int k = 0; k < 3; k++) {
    kg_lanes_matrix_destroy(m[k]);
  }
}

/* ---- against the plain calls ------------------------------------------------------------------*/

static void check_equal(const double *lanes, const double *row, int count, int f)
{
  for (int k = 0; k < count; k++) {
    assert_true(lanes[8 * k + f] == row[k]);
  }
}

/* Calls whose bits are those of the plain ones. */
static void check_motion(kg_dynamics *d, const eight *e, const results *r, int f)
{
  const kg_body *body = d->body;
  const int n = body->segment_count, nv = body->nv;
  const double *q = e->q + f * body->nq, *v = e->v + f * nv, *a = e->a + f * nv;
  static kg_vec3 p[BIG_N], p_dot[BIG_N], w[BIG_N], p_ddot[BIG_N], alpha[BIG_N];
  static kg_mat3 R[BIG_N];
  static double J[3 * BIG_NV], x[BIG_NV];
  kg_dynamics_velocity(d, q, v, p, R, p_dot, w);
  kg_dynamics_acceleration(d, q, v, a, p_ddot, alpha);
  check_equal(r->p, &p->x, 3 * n, f);
  check_equal(r->R, R->m, 9 * n, f);
  check_equal(r->p_dot, &p_dot->x, 3 * n, f);
  check_equal(r->w, &w->x, 3 * n, f);
  check_equal(r->p_ddot, &p_ddot->x, 3 * n, f);
  check_equal(r->alpha, &alpha->x, 3 * n, f);
  const kg_vec3 at = kg_dynamics_point(d, J, q, point_of(body));
  check_equal(r->x, &at.x, 3, f);
  check_equal(r->J, J, 3 * nv, f);
  memcpy(x, a, (size_t)nv * sizeof *x);
  kg_dynamics_mass_solve(d, x, q);
  check_equal(r->solved, x, nv, f);
  kg_dynamics_inverse(d, x, q, v, a);
  check_equal(r->inverse, x, nv, f);
  kg_dynamics_forward(d, x, q, v, a);
  check_equal(r->forward, x, nv, f);
}

typedef struct errors {
  double centroid, mass, factored, inverse, forward;
} errors;

static void grow(double *worst, double by)
{
  *worst = by > *worst || isnan(by) ? by : *worst;
}

static void check_centroid(kg_dynamics *d, const eight *e, const results *r, int f, errors *worst)
{
  const kg_body *body = d->body;
  static double A[6 * BIG_NV], lane[6 * BIG_NV];
  const kg_centroid c = kg_dynamics_centroid(d, e->q + f * body->nq, e->v + f * body->nv);
  const kg_centroid_lanes *l = &r->centroid;
  assert_at_most(fabs(l->mass - c.mass), 1e-14 * c.mass);
  frame_of(lane, l->com, 3, f);
  grow(&worst->centroid, relative_difference(lane, &c.com.x, 3));
  frame_of(lane, l->com_dot, 3, f);
  grow(&worst->centroid, relative_difference(lane, &c.com_dot.x, 3));
  frame_of(lane, l->L, 3, f);
  grow(&worst->centroid, relative_difference(lane, &c.L.x, 3));
  frame_of(lane, l->I, 9, f);
  grow(&worst->centroid, relative_difference(lane, c.I.m, 9));
  kg_dynamics_centroidal_matrix(d, A, e->q + f * body->nq);
  frame_of(lane, r->A, 6 * body->nv, f);
  for (int half = 0; half < 2; half++) {
    const int at = 3 * half * body->nv;
    grow(&worst->centroid, relative_difference(lane + at, A + at, 3 * body->nv));
  }
}

static void check_matrices(kg_dynamics *d, const eight *e, const results *r, int f, errors *worst)
{
  const int nv = d->body->nv, all = nv * nv, one = 1;
  const double *q = e->q + f * d->body->nq, *v = e->v + f * nv, *a = e->a + f * nv;
  static double D[3][DENSE], lane[DENSE], x[BIG_NV], y[BIG_NV];
  int pivots[BIG_NV], info = 0;
  kg_dynamics_inverse_derivatives(d, D[0], D[1], D[2], NULL, q, v, a);
  grow(&worst->mass, relative_difference(r->M[f], D[2], all));
  assert_memory_equal(r->by_a[f], r->M[f], (size_t)all * sizeof(double));
  grow(&worst->inverse, relative_difference(r->by_q[f], D[0], all));
  grow(&worst->inverse, relative_difference(r->by_v[f], D[1], all));
  memcpy(x, a, (size_t)nv * sizeof *x);
  dgesv_(&nv, &one, D[2], &nv, pivots, x, &nv, &info);
  assert_int_equal(info, 0);
  frame_of(y, r->factored, nv, f);
  grow(&worst->factored, relative_difference(y, x, nv));
  kg_dynamics_forward_derivatives(d, D[0], D[1], D[2], NULL, q, v, a);
  for (int k = 0; k < 3; k++) {
    frame_of(lane, r->da[k], all, f);
    grow(&worst->forward, relative_difference(lane, D[k], all));
  }
}

static void lanes_equal_the_plain_calls(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(61);
  static eight e;
  static results r;
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    errors worst = {0.0, 0.0, 0.0, 0.0, 0.0};
    kg_dynamics_set_gravity(d, random_vec3(&random, 9.0));
    random_eight(&random, body, &e);
    run_all(d, &e, &r);
    for (int f = 0; f < 8; f++) {
      check_motion(d, &e, &r, f);
      check_centroid(d, &e, &r, f, &worst);
      check_matrices(d, &e, &r, f, &worst);
    }
    print_message("%-11s momentum %.1e, M %.1e, M^-1 x %.1e, dID %.1e, dFD %.1e\n",
                  shape_names[kind], worst.centroid, worst.mass, worst.factored, worst.inverse,
                  worst.forward);
    assert_at_most(worst.centroid, 1e-13);
    assert_at_most(worst.mass, 1e-14);
    assert_at_most(worst.factored, 1e-10);
    assert_at_most(worst.inverse, 1e-13);
    assert_at_most(worst.forward, 1e-11); /* the rounding of the plain call */
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* ---- instruction sets -------------------------------------------------------------------------*/

static void results_do_not_depend_on_the_instruction_set(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(62);
  static eight e;
  static results first, other;
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    random_eight(&random, body, &e);
    d->kernels = kg_physics_kernels_of_level(1);
    run_all(d, &e, &first);
    for (int level = 2; level <= 3; level++) {
      d->kernels = kg_physics_kernels_of_level(level);
      if (!d->kernels) {
        print_message("no kernels of level %d here\n", level);
        continue;
      }
      run_all(d, &e, &other);
      assert_memory_equal(&other, &first, sizeof first);
    }
    kg_physics_kernels without = *kg_physics_kernels_of_level(1);
    without.eight = &kg_number_kernels_8_plain;
    d->kernels = &without;
    run_all(d, &e, &other);
    assert_memory_equal(&other, &first, sizeof first);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* ---- the same source over doubles -------------------------------------------------------------*/

static void lanes_equal_one_number_bit_for_bit(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(63);
  static eight e;
  static results r;
  static double one[3][DENSE], lane[3][DENSE], x[BIG_NV];
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    const kg_number_kernels *plain = d->kernels->one;
    const int nv = body->nv;
    random_eight(&random, body, &e);
    run_all(d, &e, &r);
    for (int f = 0; f < 8; f++) {
      const double *q = e.q + f * body->nq, *v = e.v + f * nv, *tau = e.a + f * nv;
      const kg_lanes_dense out = {one[0], one[1], one[2]};
      frame_of(x, r.forward, nv, f);
      plain->forward_derivatives(d->model, &d->tree, &out, q, v, x, tau);
      for (int k = 0; k < 3; k++) {
        frame_of(lane[k], r.da[k], nv * nv, f);
        assert_memory_equal(lane[k], one[k], (size_t)(nv * nv) * sizeof(double));
      }
      memcpy(x, tau, (size_t)nv * sizeof *x);
      plain->mass_matrix(d->model, &d->tree, one[0], q);
      plain->factor(&d->tree, one[0]);
      plain->factor_solve(&d->tree, one[0], x);
      check_equal(r.factored, x, nv, f);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* ---- complex steps ----------------------------------------------------------------------------*/

/* Worst difference of the derivatives of a frame, over the largest entry. */
static double against_complex(complex_model *c, const kg_body *body, number_call *call,
                              const eight *e, int f, const double *x, const double *exact[3])
{
  static state s;
  double worst = 0.0;
  memcpy(s.q, e->q + f * body->nq, (size_t)body->nq * sizeof(double));
  memcpy(s.v, e->v + f * body->nv, (size_t)body->nv * sizeof(double));
  for (int which = 0; which < 3; which++) {
    grow(&worst, compare_columns(c, body, call, &s, x, which, exact[which]));
  }
  return worst;
}

static void derivatives_in_lanes_match_complex_steps(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(64);
  static eight e;
  static results r;
  static double lane[3][DENSE];
  static complex_model c;
  for (int kind = 0; kind < SHAPES; kind++) {
    double inverse = 0.0, forward = 0.0;
    for (int trial = 0; trial < 2; trial++) {
      kg_body *body = body_of(kind, &random);
      kg_dynamics *d = dynamics_of(body);
      const int nv = body->nv;
      kg_dynamics_set_gravity(d, random_vec3(&random, 9.0));
      complex_open(&c, d);
      random_eight(&random, body, &e);
      for (int f = 0; f < 8; f++) { /* torques of accelerations of 10 rad/s^2 */
        double tau[BIG_NV];
        kg_dynamics_inverse(d, tau, e.q + f * body->nq, e.v + f * nv, e.a + f * nv);
        memcpy(e.a + f * nv, tau, (size_t)nv * sizeof *tau);
      }
      put_in_lanes(body, &e);
      run_all(d, &e, &r);
      for (int f = trial; f < 8; f += 7) {
        const double *tau = e.a + f * nv;
        const double *by[3] = {r.by_q[f], r.by_v[f], r.by_a[f]};
        grow(&inverse, against_complex(&c, body, kg_number_kernels_2_test.inverse, &e, f, tau, by));
        for (int k = 0; k < 3; k++) {
          frame_of(lane[k], r.da[k], nv * nv, f);
          by[k] = lane[k];
        }
        grow(&forward, against_complex(&c, body, kg_number_kernels_2_test.forward, &e, f, tau, by));
      }
      free(c.model.scratch);
      kg_dynamics_destroy(d);
      kg_body_destroy(body);
    }
    print_message("%-11s inverse dynamics %.1e, forward dynamics %.1e\n", shape_names[kind],
                  inverse, forward);
    assert_at_most(inverse, 1e-12);
    assert_at_most(forward, 1e-12);
  }
}

/* ---- frames are alone -------------------------------------------------------------------------*/

static void bad_frames_leave_the_others_alone(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(65);
  static eight e, bad;
  static results good, broken;
  kg_body *body = body_of(BUSH, &random);
  kg_dynamics *d = dynamics_of(body);
  const int nv = body->nv;
  random_eight(&random, body, &e);
  run_all(d, &e, &good);
  for (int f = 0; f < 8; f++) {
    bad = e;
    kg_lanes_matrix *M = NULL;
    assert_int_equal(kg_lanes_matrix_create(&M, d, NULL), KG_OK);
    bad.lanes_q[8 * 3 + f] = NAN;
    bad.lanes_v[8 * 4 + f] = INFINITY;
    kg_dynamics_forward_derivatives_lanes(d, broken.da[0], broken.da[1], broken.da[2],
                                          broken.forward, bad.lanes_q, bad.lanes_v, bad.lanes_a);
    kg_dynamics_centroidal_matrix_lanes(d, broken.A, bad.lanes_q);
    kg_dynamics_acceleration_lanes(d, bad.lanes_q, bad.lanes_v, bad.lanes_a, broken.p_ddot, NULL);
    memcpy(broken.factored, e.lanes_a, sizeof broken.factored);
    kg_dynamics_mass_matrix_lanes(d, M, bad.lanes_q);
    assert_int_equal(kg_lanes_matrix_factor(M), 1u << f);
    kg_lanes_matrix_solve(M, broken.factored);
    kg_lanes_matrix_destroy(M);
    for (int k = 0; k < 8 * nv * nv; k++) {
      if (k % 8 != f) {
        assert_true(broken.da[0][k] == good.da[0][k] && broken.da[1][k] == good.da[1][k]);
        assert_true(broken.da[2][k] == good.da[2][k]);
      }
    }
    for (int k = 0; k < 8 * nv; k++) {
      if (k % 8 != f) {
        assert_true(broken.factored[k] == good.factored[k] && broken.A[k] == good.A[k]);
        assert_true(broken.forward[k] == good.forward[k]);
      }
    }
    for (int k = 0; k < 8 * 3 * body->segment_count; k++) {
      assert_true(k % 8 == f || broken.p_ddot[k] == good.p_ddot[k]);
    }
    assert_true(isnan(broken.da[0][8 * 6 * nv + 8 * 4 + f]) && isnan(broken.factored[f]));
  }
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* Outputs that are not wanted change nothing of the others. */
static void outputs_are_optional(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(66);
  static eight e;
  static results all;
  static double alone[8 * DENSE], dense[DENSE];
  kg_body *body = human_body();
  kg_dynamics *d = dynamics_of(body);
  const size_t bytes = 8 * (size_t)(body->nv * body->nv) * sizeof *alone;
  random_eight(&random, body, &e);
  run_all(d, &e, &all);
  for (int k = 0; k < 3; k++) {
    kg_dynamics_forward_derivatives_lanes(d, k == 0 ? alone : NULL, k == 1 ? alone : NULL,
                                          k == 2 ? alone : NULL, NULL, e.lanes_q, e.lanes_v,
                                          e.lanes_a);
    assert_memory_equal(alone, all.da[k], bytes);
    kg_lanes_matrix *m = NULL;
    assert_int_equal(kg_lanes_matrix_create(&m, d, NULL), KG_OK);
    kg_dynamics_inverse_derivatives_lanes(d, k == 0 ? m : NULL, k == 1 ? m : NULL,
                                          k == 2 ? m : NULL, NULL, e.lanes_q, e.lanes_v, e.lanes_a);
    kg_lanes_matrix_dense(m, 3, dense);
    assert_memory_equal(dense,
                        k == 0   ? all.by_q[3]
                        : k == 1 ? all.by_v[3]
                                 : all.by_a[3],
                        bytes / 8);
    const double *own = kg_lanes_matrix_block(m, 5, 2), *above = kg_lanes_matrix_block(m, 2, 5);
    assert_true(own[8 * 5 + 3] == dense[(15 + 1) * body->nv + 6 + 2]);
    assert_true(k == 2 ? above == NULL : above[8 * 5 + 3] == dense[(6 + 1) * body->nv + 15 + 2]);
    assert_null(kg_lanes_matrix_block(m, 16, 10)); /* a leg and an arm */
    kg_lanes_matrix_destroy(m);
  }
  kg_centroid_lanes still;
  kg_dynamics_centroid_lanes(d, &still, e.lanes_q, NULL);
  assert_memory_equal(still.I, all.centroid.I, sizeof still.I);
  assert_memory_equal(still.com, all.centroid.com, sizeof still.com);
  for (int k = 0; k < 24; k++) {
    assert_true(still.com_dot[k] == 0.0 && still.L[k] == 0.0);
  }
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* A toe without mass and inertia: M is singular in every frame, and the factor says so. */
static void singular_mass_is_reported(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(67);
  static eight e;
  kg_body *body = human_body();
  body->segments[22].mass = 0.0;
  memset(body->segments[22].inertia, 0, sizeof body->segments[22].inertia);
  kg_dynamics *d = dynamics_of(body);
  kg_lanes_matrix *M = NULL;
  assert_int_equal(kg_lanes_matrix_create(&M, d, NULL), KG_OK);
  random_eight(&random, body, &e);
  kg_dynamics_mass_matrix_lanes(d, M, e.lanes_q);
  assert_int_equal(kg_lanes_matrix_factor(M), 255);
  const double none[2] = {-0.01, 1e-104}; /* a pivot below zero; one whose inverse is too large */
  for (int k = 0; k < 6; k++) {
    body->segments[22].inertia[k % 3] = none[k / 3];
    if (k % 3 < 2) continue;
    kg_dynamics_refresh(d);
    kg_dynamics_mass_matrix_lanes(d, M, e.lanes_q);
    assert_int_equal(kg_lanes_matrix_factor(M), 255);
  }
  kg_lanes_matrix_destroy(M);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* ---- memory -----------------------------------------------------------------------------------*/

static void calls_take_no_memory(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(68);
  kg_body *body = human_body();
  failing_heap heap = {.calls_left = 1000};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_dynamics *d = NULL;
  kg_lanes_matrix *m[3] = {NULL, NULL, NULL};
  static eight e;
  static results r;
  assert_int_equal(kg_dynamics_create(&d, body, &allocator), KG_OK);
  for (int k = 0; k < 3; k++) {
    assert_int_equal(kg_lanes_matrix_create(&m[k], d, &allocator), KG_OK);
  }
  const int left = heap.calls_left;
  random_eight(&random, body, &e);
  kg_dynamics_velocity_lanes(d, e.lanes_q, e.lanes_v, r.p, r.R, r.p_dot, r.w);
  kg_dynamics_acceleration_lanes(d, e.lanes_q, e.lanes_v, e.lanes_a, r.p_ddot, r.alpha);
  kg_dynamics_point_lanes(d, r.x, r.J, e.lanes_q, point_of(body));
  kg_dynamics_centroid_lanes(d, &r.centroid, e.lanes_q, e.lanes_v);
  kg_dynamics_centroidal_matrix_lanes(d, r.A, e.lanes_q);
  kg_dynamics_mass_solve_lanes(d, r.solved, e.lanes_q);
  kg_dynamics_mass_matrix_lanes(d, m[0], e.lanes_q);
  assert_int_equal(kg_lanes_matrix_factor(m[0]), 0);
  kg_lanes_matrix_solve(m[0], r.solved);
  kg_dynamics_inverse_derivatives_lanes(d, m[0], m[1], m[2], r.inverse, e.lanes_q, e.lanes_v,
                                        e.lanes_a);
  kg_dynamics_forward_derivatives_lanes(d, r.da[0], r.da[1], r.da[2], r.forward, e.lanes_q,
                                        e.lanes_v, e.lanes_a);
  assert_int_equal(heap.calls_left, left);
  for (int k = 0; k < 3; k++) {
    kg_lanes_matrix_destroy(m[k]);
  }
  heap.calls_left = 0;
  assert_int_equal(kg_lanes_matrix_create(&m[0], d, &allocator), KG_ERR_NO_MEMORY);
  assert_null(m[0]);
  kg_dynamics_destroy(d);
  assert_int_equal(heap.live_bytes, 0);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(lanes_equal_the_plain_calls),
    cmocka_unit_test(results_do_not_depend_on_the_instruction_set),
    cmocka_unit_test(lanes_equal_one_number_bit_for_bit),
    cmocka_unit_test(derivatives_in_lanes_match_complex_steps),
    cmocka_unit_test(bad_frames_leave_the_others_alone),
    cmocka_unit_test(outputs_are_optional),
    cmocka_unit_test(singular_mass_is_reported),
    cmocka_unit_test(calls_take_no_memory),
  };
  return cmocka_run_group_tests_name("dynamics_lanes", tests, NULL, NULL);
}
