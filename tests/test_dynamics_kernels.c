/* Forward dynamics against LAPACK and against inverse dynamics; derivatives against complex steps
 * through the same recursion over complex numbers; eight frames and every instruction set against
 * the plain call, bit for bit. */
#include "fixture_dynamics.h"

#include "kinegrad/dynamics_lanes.h"

#include "physics/physics.h"

void dgesv_(const int *n, const int *nrhs, double *a, const int *lda, int *ipiv, double *b,
            const int *ldb, int *info);

enum { FRAMES = 17 };

/* ---- values -----------------------------------------------------------------------------------*/

static void forward_dynamics_solves_the_equations_of_motion(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(41);
  double worst[3] = {0.0, 0.0, 0.0};
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    kg_dynamics_set_gravity(d, random_vec3(&random, 9.0));
    const int nv = body->nv, one = 1;
    for (int trial = 0; trial < 5; trial++) {
      state s;
      static double M[BIG_NV * BIG_NV];
      double tau[BIG_NV], back[BIG_NV], bias[BIG_NV], x[BIG_NV], zero[BIG_NV] = {0.0};
      random_state(&random, body, s.q, s.v, s.a);
      kg_dynamics_inverse(d, tau, s.q, s.v, s.a);
      kg_dynamics_forward(d, back, s.q, s.v, tau);
      const double size = largest(s.a, nv);
      worst[0] = fmax(worst[0], largest_difference(back, s.a, nv) / size);
      assert_at_most(largest_difference(back, s.a, nv), 1e-10 * size);
      kg_dynamics_inverse(d, bias, s.q, s.v, zero);
      kg_dynamics_mass_matrix(d, M, s.q);
      int pivots[BIG_NV], info = 0;
      for (int k = 0; k < nv; k++) {
        bias[k] = tau[k] - bias[k];
        x[k] = bias[k];
      }
      dgesv_(&nv, &one, M, &nv, pivots, bias, &nv, &info);
      assert_int_equal(info, 0);
      worst[1] = fmax(worst[1], largest_difference(back, bias, nv) / size);
      assert_at_most(largest_difference(back, bias, nv), 1e-10 * size);
      kg_dynamics_mass_solve(d, x, s.q);
      worst[2] = fmax(worst[2], largest_difference(x, bias, nv) / size);
      assert_at_most(largest_difference(x, bias, nv), 1e-10 * size);
      kg_dynamics_forward(d, tau, s.q, s.v, tau); /* in place */
      assert_memory_equal(tau, back, (size_t)nv * sizeof *tau);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
  print_message("forward dynamics: against ID %.1e, against LAPACK %.1e; M^-1 x %.1e\n", worst[0],
                worst[1], worst[2]);
}

/* A segment whose rotation moves no mass: numbers that are not finite, no trap. */
static void free_rotation_is_not_hidden(void **unused)
{
  (void)unused;
  kg_body *body = human_body();
  body->segments[22].mass = 0.0;
  memset(body->segments[22].inertia, 0, sizeof body->segments[22].inertia);
  kg_dynamics *d = dynamics_of(body);
  state s;
  double a[BIG_NV];
  static double da[BIG_NV * BIG_NV];
  kg_random random = kg_random_make(42);
  random_state(&random, body, s.q, s.v, s.a);
  kg_dynamics_forward_derivatives(d, da, NULL, NULL, a, s.q, s.v, s.a);
  bool finite = true;
  for (int k = 0; k < body->nv; k++) {
    finite = finite && isfinite(a[k]);
  }
  assert_false(finite);
  assert_true(isnan(da[0]));
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

static void accelerations_are_rates_of_velocities(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(43);
  kg_body *body = human_body();
  kg_dynamics *d = dynamics_of(body);
  const int nv = body->nv;
  for (int trial = 0; trial < 5; trial++) {
    state s;
    kg_vec3 p_ddot[40], alpha[40], p_dot[2][40], w[2][40];
    random_state(&random, body, s.q, s.v, s.a);
    kg_dynamics_acceleration(d, s.q, s.v, s.a, p_ddot, alpha);
    const double h = 1e-5;
    for (int side = 0; side < 2; side++) {
      const double t = side == 0 ? h : -h;
      double later[BIG_NQ], v[BIG_NV], step[BIG_NV];
      for (int k = 0; k < nv; k++) {
        step[k] = t * s.v[k] + 0.5 * t * t * s.a[k];
        v[k] = s.v[k] + t * s.a[k];
      }
      kg_body_integrate(body, later, s.q, step);
      kg_dynamics_velocity(d, later, v, NULL, NULL, p_dot[side], w[side]);
    }
    for (int i = 0; i < body->segment_count; i++) {
      const kg_vec3 p = kg_vec3_scale(0.5 / h, kg_vec3_sub(p_dot[0][i], p_dot[1][i]));
      const kg_vec3 r = kg_vec3_scale(0.5 / h, kg_vec3_sub(w[0][i], w[1][i]));
      assert_at_most(kg_vec3_norm(kg_vec3_sub(p, p_ddot[i])), 1e-6 * (1.0 + kg_vec3_norm(p)));
      assert_at_most(kg_vec3_norm(kg_vec3_sub(r, alpha[i])), 1e-6 * (1.0 + kg_vec3_norm(r)));
    }
  }
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

static void centroidal_matrix_gives_momentum(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(44);
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    state s;
    static double A[6 * BIG_NV];
    random_state(&random, body, s.q, s.v, s.a);
    kg_dynamics_centroidal_matrix(d, A, s.q);
    const kg_centroid c = kg_dynamics_centroid(d, s.q, s.v);
    const kg_vec3 p = kg_vec3_scale(c.mass, c.com_dot);
    const double truth[6] = {c.L.x, c.L.y, c.L.z, p.x, p.y, p.z};
    for (int r = 0; r < 6; r++) {
      double sum = 0.0;
      for (int k = 0; k < body->nv; k++) {
        sum += A[r * body->nv + k] * s.v[k];
      }
      assert_at_most(fabs(sum - truth[r]), 1e-12 * (1.0 + largest(truth, 6)));
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* ---- complex steps ----------------------------------------------------------------------------*/

static void derivatives_match_complex_steps(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(45);
  static double D[3][BIG_NV * BIG_NV];
  static complex_model c;
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    kg_dynamics_set_gravity(d, random_vec3(&random, 9.0));
    complex_open(&c, d);
    double worst[2] = {0.0, 0.0};
    for (int trial = 0; trial < 3; trial++) {
      state s;
      double tau[BIG_NV], a[BIG_NV];
      random_state(&random, body, s.q, s.v, s.a);
      kg_dynamics_inverse_derivatives(d, D[0], D[1], D[2], tau, s.q, s.v, s.a);
      for (int which = 0; which < 3; which++) {
        const double e =
          compare_columns(&c, body, kg_number_kernels_2_test.inverse, &s, s.a, which, D[which]);
        assert_at_most(e, 1e-12);
        worst[0] = fmax(worst[0], e);
      }
      kg_dynamics_forward_derivatives(d, D[0], D[1], D[2], a, s.q, s.v, tau);
      for (int which = 0; which < 3; which++) {
        const double e =
          compare_columns(&c, body, kg_number_kernels_2_test.forward, &s, tau, which, D[which]);
        assert_at_most(e, 1e-12);
        worst[1] = fmax(worst[1], e);
      }
    }
    print_message("%-11s inverse dynamics %.1e, forward dynamics %.1e\n", shape_names[kind],
                  worst[0], worst[1]);
    free(c.model.scratch);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* Joints inside a chain alone: each entry against its own size, so that no large entry elsewhere
 * hides a wrong one. */
static void ball_joints_inside_the_tree_have_exact_derivatives(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(46);
  static double D[2][BIG_NV * BIG_NV];
  static complex_model c;
  double worst = 0.0;
  for (int trial = 0; trial < 10; trial++) {
    kg_body *body = rebuilt(&random, 6, false);
    kg_dynamics *d = dynamics_of(body);
    complex_open(&c, d);
    state s;
    random_state(&random, body, s.q, s.v, s.a);
    kg_dynamics_inverse_derivatives(d, D[0], D[1], NULL, NULL, s.q, s.v, s.a);
    const int nv = body->nv;
    for (int which = 0; which < 2; which++) {
      for (int k = 6; k < nv - 3; k++) {
        double column[BIG_NV];
        complex_column(&c, body, kg_number_kernels_2_test.inverse, &s, s.a, which, k, column);
        for (int r = 0; r < nv; r++) { /* a block of three against its own length */
          const double *block = column + r / 3 * 3;
          const double size = fabs(block[0]) + fabs(block[1]) + fabs(block[2]);
          const double e = fabs(column[r] - D[which][r * nv + k]) / (size > 0.0 ? size : 1.0);
          assert_at_most(e, 1e-11);
          worst = fmax(worst, e);
        }
      }
    }
    free(c.model.scratch);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
  print_message("joints inside a chain, each block by its own size: %.1e\n", worst);
}

/* ---- frames and instruction sets --------------------------------------------------------------*/

typedef struct clip {
  double q[FRAMES * BIG_NQ], v[FRAMES * BIG_NV], a[FRAMES * BIG_NV];
} clip;

static void random_clip(kg_random *random, const kg_body *body, clip *c)
{
  for (int f = 0; f < FRAMES; f++) {
    random_state(random, body, c->q + f * body->nq, c->v + f * body->nv, c->a + f * body->nv);
  }
}

/* All calls of many frames against the plain calls of level 1. */
static void check_frames(kg_dynamics *d, const clip *c, const double *tau, const double *a)
{
  const kg_body *body = d->body;
  const int nv = body->nv;
  static double out[FRAMES * BIG_NV], q[8 * BIG_NQ], v[8 * BIG_NV], x[8 * BIG_NV], y[8 * BIG_NV];
  for (int count = 0; count <= FRAMES; count++) {
    const size_t bytes = (size_t)(count * nv) * sizeof *out;
    memset(out, 0, sizeof out);
    kg_dynamics_inverse_many(d, count, out, c->q, c->v, c->a);
    assert_memory_equal(out, tau, bytes);
    kg_dynamics_forward_many(d, count, out, c->q, c->v, c->a);
    assert_memory_equal(out, a, bytes);
    for (int k = count * nv; k < FRAMES * nv; k++) {
      assert_true(out[k] == 0.0); /* not beyond its end */
    }
  }
  to_lanes(q, c->q, body->nq);
  to_lanes(v, c->v, nv);
  to_lanes(x, c->a, nv);
  kg_dynamics_inverse_lanes(d, y, q, v, x);
  for (int k = 0; k < 8 * nv; k++) {
    assert_true(y[k] == tau[k % 8 * nv + k / 8]);
  }
  kg_dynamics_forward_lanes(d, y, q, v, x);
  for (int k = 0; k < 8 * nv; k++) {
    assert_true(y[k] == a[k % 8 * nv + k / 8]);
  }
}

static void check_kinematics(kg_dynamics *d, const clip *c)
{
  enum { N = 40 };
  const kg_body *body = d->body;
  const int n = body->segment_count;
  static kg_vec3 p[FRAMES * N], p_dot[FRAMES * N], w[FRAMES * N], one[3][N];
  static kg_mat3 R[FRAMES * N], one_R[N];
  for (int count = 0; count <= FRAMES; count++) {
    memset(R, 0, sizeof R);
    kg_dynamics_velocity_many(d, count, c->q, c->v, p, R, p_dot, w);
    for (int f = 0; f < count; f++) {
      const size_t vectors = (size_t)n * sizeof *p;
      kg_dynamics_velocity(d, c->q + f * body->nq, c->v + f * body->nv, one[0], one_R, one[1],
                           one[2]);
      assert_memory_equal(p + f * n, one[0], vectors);
      assert_memory_equal(p_dot + f * n, one[1], vectors);
      assert_memory_equal(w + f * n, one[2], vectors);
      assert_memory_equal(R + f * n, one_R, (size_t)n * sizeof *R);
    }
    assert_true(count * n == FRAMES * N || R[count * n].m[0] == 0.0); /* not beyond its end */
    memset(p, 0, sizeof p);
    kg_dynamics_velocity_many(d, count, c->q, NULL, p, NULL, NULL, NULL);
    if (count > 0) { /* the last frame, poses alone */
      kg_dynamics_pose(d, c->q + (count - 1) * body->nq, one[0], NULL);
      assert_memory_equal(p + (count - 1) * n, one[0], (size_t)n * sizeof *p);
    }
  }
}

static void eight_frames_equal_one_bit_for_bit(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(47);
  static clip c;
  static double tau[FRAMES * BIG_NV], a[FRAMES * BIG_NV];
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    random_clip(&random, body, &c);
    d->kernels = kg_physics_kernels_of_level(1);
    for (int f = 0; f < FRAMES; f++) {
      const int at = f * body->nv;
      kg_dynamics_inverse(d, tau + at, c.q + f * body->nq, c.v + at, c.a + at);
      kg_dynamics_forward(d, a + at, c.q + f * body->nq, c.v + at, c.a + at);
    }
    for (int level = 1; level <= 3; level++) {
      const kg_physics_kernels *kernels = kg_physics_kernels_of_level(level);
      if (!kernels) {
        print_message("no kernels of level %d here\n", level);
        continue;
      }
      d->kernels = kernels;
      check_frames(d, &c, tau, a);
      check_kinematics(d, &c);
      kg_physics_kernels without = *kernels; /* as a compiler without vectors has them */
      without.eight = &kg_number_kernels_8_plain;
      d->kernels = &without;
      check_frames(d, &c, tau, a);
      check_kinematics(d, &c);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* Matrices of every instruction set, bit for bit. */
static void matrices_do_not_depend_on_the_instruction_set(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(48);
  static double D[2][6][BIG_NV * BIG_NV], M[BIG_NV * BIG_NV];
  for (int kind = 0; kind < SHAPES; kind++) {
    kg_body *body = body_of(kind, &random);
    kg_dynamics *d = dynamics_of(body);
    state s;
    const size_t bytes = (size_t)(body->nv * body->nv) * sizeof(double);
    random_state(&random, body, s.q, s.v, s.a);
    for (int level = 1; level <= 3; level++) {
      const int side = level > 1;
      d->kernels = d->tree.kernels = kg_physics_kernels_of_level(level);
      if (!d->kernels) {
        print_message("no kernels of level %d here\n", level);
        d->kernels = d->tree.kernels = kg_physics_kernels_of_level(1);
        continue;
      }
      kg_dynamics_inverse_derivatives(d, D[side][0], D[side][1], D[side][2], NULL, s.q, s.v, s.a);
      kg_dynamics_forward_derivatives(d, D[side][3], D[side][4], D[side][5], NULL, s.q, s.v, s.a);
      for (int k = 0; k < 6 && side == 1; k++) {
        assert_memory_equal(D[1][k], D[0][k], bytes);
      }
      kg_dynamics_mass_matrix(d, M, s.q);
      assert_memory_equal(M, D[side][2], bytes);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* Turns of many joints at once, bit for bit as one by one: small ones, and on both sides of where the
 * series end. */
static void rotations_of_eight_joints_equal_one(void **unused)
{
  (void)unused;
  enum { JOINTS = 23 };
  kg_random random = kg_random_make(50);
  const double dt = 0.01;
  int beyond = 0;
  for (int trial = 0; trial < 600; trial++) {
    const kg_physics_kernels *kernels = kg_physics_kernels_of_level(1 + trial % 3);
    if (!kernels) {
      print_message("no kernels of level %d here\n", 1 + trial % 3);
      continue;
    }
    double q[4 * JOINTS], d[3 * JOINTS], w[3 * JOINTS], got[4 * JOINTS], want[4];
    kg_mat3 E[JOINTS];
    const int count = 1 + trial % JOINTS;
    for (int i = 0; i < JOINTS; i++) {
      const kg_quat at = kg_quat_exp(random_vec3(&random, 2.0));
      memcpy(q + 4 * i, &at, sizeof at);
      const kg_vec3 turn = random_vec3(&random, trial % 4 == 0 ? 1.0 : 0.3);
      kg_store3(d + 3 * i, turn);
      kg_store3(w + 3 * i, kg_vec3_scale(1.0 / dt, turn));
    }
    kernels->integrate_joints(got, q, d, count);
    kernels->turns_by_rate(E, w, dt, count);
    for (int i = 0; i < count; i++) {
      kg_joint_turn(want, q + 4 * i, d + 3 * i);
      assert_memory_equal(got + 4 * i, want, sizeof want);
      const kg_vec3 turn = kg_vec3_scale(dt, kg_load3(w + 3 * i));
      const kg_mat3 one = kg_mat3_scale(dt, kg_so3_right_jacobian(turn));
      assert_memory_equal(&E[i], &one, sizeof one);
      beyond += kg_vec3_dot(turn, turn) > 1.0;
    }
  }
  assert_true(beyond > 100);
}

/* After creation no call takes memory: the allocator is not asked again. */
static void calls_take_no_memory(void **unused)
{
  (void)unused;
  kg_random random = kg_random_make(49);
  kg_body *body = human_body();
  failing_heap heap = {.calls_left = 1000};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, &allocator), KG_OK);
  const int left = heap.calls_left;
  static clip c;
  static double D[3][BIG_NV * BIG_NV], out[FRAMES * BIG_NV];
  static kg_vec3 p[FRAMES * 40], w[FRAMES * 40];
  random_clip(&random, body, &c);
  kg_dynamics_inverse(d, out, c.q, c.v, c.a);
  kg_dynamics_forward(d, out, c.q, c.v, c.a);
  kg_dynamics_mass_solve(d, out, c.q);
  kg_dynamics_mass_matrix(d, D[0], c.q);
  kg_dynamics_inverse_derivatives(d, D[0], D[1], D[2], out, c.q, c.v, c.a);
  kg_dynamics_forward_derivatives(d, D[0], D[1], D[2], out, c.q, c.v, c.a);
  kg_dynamics_inverse_many(d, FRAMES, out, c.q, c.v, c.a);
  kg_dynamics_forward_many(d, FRAMES, out, c.q, c.v, c.a);
  kg_dynamics_velocity_many(d, FRAMES, c.q, c.v, p, NULL, NULL, w);
  kg_dynamics_acceleration(d, c.q, c.v, c.a, p, w);
  kg_dynamics_centroidal_matrix(d, D[0], c.q);
  assert_int_equal(heap.calls_left, left);
  kg_dynamics_destroy(d);
  assert_int_equal(heap.live_bytes, 0);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(forward_dynamics_solves_the_equations_of_motion),
    cmocka_unit_test(free_rotation_is_not_hidden),
    cmocka_unit_test(accelerations_are_rates_of_velocities),
    cmocka_unit_test(centroidal_matrix_gives_momentum),
    cmocka_unit_test(derivatives_match_complex_steps),
    cmocka_unit_test(ball_joints_inside_the_tree_have_exact_derivatives),
    cmocka_unit_test(eight_frames_equal_one_bit_for_bit),
    cmocka_unit_test(matrices_do_not_depend_on_the_instruction_set),
    cmocka_unit_test(rotations_of_eight_joints_equal_one),
    cmocka_unit_test(calls_take_no_memory),
  };
  return cmocka_run_group_tests_name("dynamics_kernels", tests, NULL, NULL);
}
