/* Kinematics and dynamics against particles and d'Alembert's principle, against differences in
 * space and time, and against conservation laws. */
#include "fixture_body.h"
#include "fixture_step.h"

#include "kinegrad/spatial.h"
#include "physics/kernels/kernels.h"
#include "physics/tree.h"

#include <stdio.h>
#include <time.h>

void dgesv_(const int *n, const int *nrhs, double *a, const int *lda, int *ipiv, double *b,
            const int *ldb, int *info);

static double largest_difference(const double *a, const double *b, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    size = fabs(a[k] - b[k]) > size || isnan(a[k]) ? fabs(a[k] - b[k]) : size;
  }
  return size;
}

/* World position of a point of a segment, by walking up the tree with quaternions. */
static kg_vec3 brute_point(const kg_body *body, const double *q, int segment, kg_vec3 p)
{
  for (int i = segment; i >= 0; i = body->segments[i].parent) {
    const double *c = q + 3 + 4 * i;
    p = kg_quat_rotate(kg_quat_make(c[0], c[1], c[2], c[3]), p);
    p = kg_vec3_add(p, i > 0 ? body->segments[i].offset : kg_vec3_make(q[0], q[1], q[2]));
  }
  return p;
}

static void pose_and_velocity_match_walking_up_the_tree(void **state)
{
  (void)state;
  kg_random random = kg_random_make(11);
  for (int trial = 0; trial < 20; trial++) {
    kg_body *body = random_tree(&random, 1 + trial, NULL);
    kg_dynamics *d = dynamics_of(body);
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], J[3 * MAX_NV];
    kg_vec3 p[MAX_NV], p_dot[MAX_NV], w[MAX_NV];
    kg_mat3 R[MAX_NV];
    random_state(&random, body, q, v, a);
    kg_dynamics_velocity(d, q, v, p, R, p_dot, w);
    for (int i = 0; i < body->segment_count; i++) {
      const kg_vec3 local = random_vec3(&random, 0.5);
      const kg_vec3 x = kg_vec3_add(p[i], kg_mat3_mul_vec(R[i], local));
      const kg_vec3 brute = brute_point(body, q, i, local);
      assert_at_most(kg_vec3_norm(kg_vec3_sub(x, brute)), 1e-14 * 20);
      const kg_vec3 same = kg_dynamics_point(d, J, q, (kg_body_point){i, local});
      assert_at_most(kg_vec3_norm(kg_vec3_sub(same, brute)), 1e-14 * 20);
      /* velocity: by the pose's velocities, by the Jacobian, and by differences in time */
      const kg_vec3 u = kg_vec3_add(p_dot[i], kg_vec3_cross(w[i], kg_mat3_mul_vec(R[i], local)));
      double q1[MAX_NQ], q2[MAX_NQ], step[MAX_NV];
      const double h = 1e-5;
      for (int k = 0; k < body->nv; k++) {
        step[k] = h * v[k];
      }
      kg_body_integrate(body, q1, q, step);
      for (int k = 0; k < body->nv; k++) {
        step[k] = -step[k];
      }
      kg_body_integrate(body, q2, q, step);
      const kg_vec3 slope = kg_vec3_scale(
        0.5 / h, kg_vec3_sub(brute_point(body, q1, i, local), brute_point(body, q2, i, local)));
      assert_at_most(kg_vec3_norm(kg_vec3_sub(u, slope)), 1e-8 * (1.0 + kg_vec3_dot(w[i], w[i])));
      double Jv[3] = {0.0, 0.0, 0.0};
      for (int k = 0; k < 3 * body->nv; k++) {
        Jv[k / body->nv] += J[k] * v[k % body->nv];
      }
      assert_at_most(kg_vec3_norm(kg_vec3_sub(u, kg_vec3_make(Jv[0], Jv[1], Jv[2]))), 1e-12);
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

/* x(t) of one particle, t seconds from now: d = v t + a t^2 / 2 on the right of q. */
static kg_vec3 particle_at(const kg_body *body, const double *q, const double *v, const double *a,
                           double t, int segment, kg_vec3 p)
{
  double later[MAX_NQ], step[MAX_NV];
  for (int k = 0; k < body->nv; k++) {
    step[k] = t * v[k] + 0.5 * t * t * a[k];
  }
  kg_body_integrate(body, later, q, step);
  return brute_point(body, later, segment, p);
}

/* d'Alembert: tau_k = sum over particles of m (x_ddot - g) . dx/dq_k, all by differences. */
static void inverse_dynamics_matches_particles(void **state)
{
  (void)state;
  kg_random random = kg_random_make(12);
  for (int trial = 0; trial < 6; trial++) {
    particle_set particles;
    kg_body *body = random_tree(&random, 1 + trial, &particles);
    kg_dynamics *d = dynamics_of(body);
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], tau[MAX_NV], brute[MAX_NV] = {0.0};
    random_state(&random, body, q, v, a);
    const kg_vec3 g = random_vec3(&random, 9.0);
    kg_dynamics_set_gravity(d, g);
    kg_dynamics_inverse(d, tau, q, v, a);
    for (int i = 0; i < body->segment_count; i++) {
      for (int m = 0; m < PARTICLES; m++) {
        const kg_vec3 p = particles.at[i][m];
        const double h = 2e-3; /* fourth-order second difference */
        const double weight[5] = {-1.0, 16.0, -30.0, 16.0, -1.0};
        kg_vec3 x_ddot = {0.0, 0.0, 0.0};
        for (int s = 0; s < 5; s++) {
          const kg_vec3 x = particle_at(body, q, v, a, (s - 2) * h, i, p);
          x_ddot = kg_vec3_add_scaled(x_ddot, weight[s] / (12.0 * h * h), x);
        }
        const kg_vec3 f = kg_vec3_scale(particles.mass[i][m], kg_vec3_sub(x_ddot, g));
        for (int k = 0; k < body->nv; k++) {
          double step[MAX_NV] = {0.0}, q1[MAX_NQ], q2[MAX_NQ];
          step[k] = 1e-5;
          kg_body_integrate(body, q1, q, step);
          step[k] = -1e-5;
          kg_body_integrate(body, q2, q, step);
          const kg_vec3 dx = kg_vec3_sub(brute_point(body, q1, i, p), brute_point(body, q2, i, p));
          brute[k] += kg_vec3_dot(f, dx) / 2e-5;
        }
      }
    }
    assert_at_most(largest_difference(tau, brute, body->nv), 2e-7 * largest(tau, body->nv));
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

static void mass_matrix_is_linear_part_of_inverse_dynamics(void **state)
{
  (void)state;
  kg_random random = kg_random_make(13);
  for (int trial = 0; trial < 10; trial++) {
    kg_body *body = random_tree(&random, 2 + 2 * trial, NULL);
    kg_dynamics *d = dynamics_of(body);
    kg_dynamics_set_gravity(d, kg_vec3_make(0.0, 0.0, 0.0));
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], e[MAX_NV] = {0.0}, zero[MAX_NV] = {0.0}, tau[MAX_NV];
    double diagonal[MAX_NV];
    static double M[MAX_NV * MAX_NV], M2[MAX_NV * MAX_NV];
    random_state(&random, body, q, v, a);
    const int nv = body->nv;
    kg_dynamics_mass_matrix(d, M, q);
    kg_links_mass_diagonal(d, diagonal);
    kg_dynamics_inverse_derivatives(d, NULL, NULL, M2, NULL, q, v, a);
    assert_at_most(largest_difference(M, M2, nv * nv), 1e-13 * largest(M, nv * nv));
    double energy = 0.0;
    for (int k = 0; k < nv; k++) {
      e[k] = 1.0;
      kg_dynamics_inverse(d, tau, q, zero, e);
      e[k] = 0.0;
      assert_close(diagonal[k], tau[k], 1e-12);
      for (int r = 0; r < nv; r++) {
        assert_close(M[r * nv + k], tau[r], 1e-12);
        assert_true(M[r * nv + k] == M[k * nv + r]);
        energy += 0.5 * v[r] * M[r * nv + k] * v[k];
      }
    }
    assert_close(kg_dynamics_energy(d, q, v), energy, 1e-12);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

typedef struct direction_case {
  kg_dynamics *d;
  const kg_body *body;
  const double *q, *v, *a;
  bool in_q;
  int k;
} direction_case;

static void inverse_at(const direction_case *c, double h, double *tau)
{
  double step[MAX_NV] = {0.0}, q[MAX_NQ], v[MAX_NV];
  memcpy(v, c->v, (size_t)c->body->nv * sizeof *v);
  step[c->k] = c->in_q ? h : 0.0;
  v[c->k] += c->in_q ? 0.0 : h;
  kg_body_integrate(c->body, q, c->q, step);
  kg_dynamics_inverse(c->d, tau, q, v, c->a);
}

/* Richardson: error h^4 */
static void slope_of_inverse(const direction_case *c, double *slope)
{
  double plus[MAX_NV], minus[MAX_NV];
  const double h = 1e-3;
  for (int k = 0; k < c->body->nv; k++) {
    slope[k] = 0.0;
  }
  for (int level = 0; level < 2; level++) {
    const double s = level == 0 ? h : 0.5 * h;
    inverse_at(c, s, plus);
    inverse_at(c, -s, minus);
    for (int k = 0; k < c->body->nv; k++) {
      slope[k] += (level == 0 ? -1.0 : 4.0) / 3.0 * (plus[k] - minus[k]) / (2.0 * s);
    }
  }
}

static void derivatives_match_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(14);
  double worst = 0.0;
  for (int trial = 0; trial < 9; trial++) {
    kg_body *body = trial < 8 ? random_tree(&random, 1 + 2 * trial, NULL) : human_body();
    kg_dynamics *d = dynamics_of(body);
    kg_dynamics_set_gravity(d, random_vec3(&random, 9.0));
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], tau[MAX_NV], tau2[MAX_NV], slope[MAX_NV];
    static double dq[MAX_NV * MAX_NV], dv[MAX_NV * MAX_NV];
    random_state(&random, body, q, v, a);
    const int nv = body->nv;
    kg_dynamics_inverse_derivatives(d, dq, dv, NULL, tau, q, v, a);
    kg_dynamics_inverse(d, tau2, q, v, a);
    assert_memory_equal(tau, tau2, (size_t)nv * sizeof *tau);
    for (int k = 0; k < 2 * nv; k++) {
      const direction_case c = {d, body, q, v, a, k < nv, k % nv};
      slope_of_inverse(&c, slope);
      const double *exact = k < nv ? dq : dv;
      const double size = largest(exact, nv * nv);
      for (int r = 0; r < nv; r++) {
        worst = fmax(worst, fabs(slope[r] - exact[r * nv + c.k]) / size);
        assert_close(slope[r] / size, exact[r * nv + c.k] / size, 2e-9);
      }
    }
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
  print_message("derivatives of inverse dynamics against differences: %.1e\n", worst);
}

/* Newton and Euler for the whole body: root force = m (com_ddot - g), and the root's moment with
 * it gives dL/dt about the centre of mass. */
static void root_wrench_balances_momentum(void **state)
{
  (void)state;
  kg_random random = kg_random_make(15);
  kg_body *body = human_body();
  kg_dynamics *d = dynamics_of(body);
  for (int trial = 0; trial < 10; trial++) {
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], tau[MAX_NV], later[MAX_NQ], v_later[MAX_NV];
    double step[MAX_NV];
    random_state(&random, body, q, v, a);
    kg_centroid c[2];
    const double h = 1e-5;
    for (int side = 0; side < 2; side++) {
      const double t = side == 0 ? h : -h;
      for (int k = 0; k < body->nv; k++) {
        step[k] = t * v[k] + 0.5 * t * t * a[k];
        v_later[k] = v[k] + t * a[k];
      }
      kg_body_integrate(body, later, q, step);
      c[side] = kg_dynamics_centroid(d, later, v_later);
    }
    const kg_centroid now = kg_dynamics_centroid(d, q, v);
    assert_close(now.mass, body->mass, 1e-14);
    kg_dynamics_inverse(d, tau, q, v, a);
    const kg_vec3 force = kg_vec3_make(tau[0], tau[1], tau[2]);
    kg_mat3 R[HUMAN_SEGMENTS];
    kg_dynamics_pose(d, q, NULL, R);
    const kg_vec3 moment = kg_mat3_mul_vec(R[0], kg_vec3_make(tau[3], tau[4], tau[5]));
    kg_vec3 com_ddot = kg_vec3_scale(0.5 / h, kg_vec3_sub(c[0].com_dot, c[1].com_dot));
    const kg_vec3 L_dot = kg_vec3_scale(0.5 / h, kg_vec3_sub(c[0].L, c[1].L));
    com_ddot.y += 9.8;
    assert_at_most(kg_vec3_norm(kg_vec3_sub(force, kg_vec3_scale(now.mass, com_ddot))),
                   1e-6 * kg_vec3_norm(force));
    const kg_vec3 root = kg_vec3_make(q[0], q[1], q[2]);
    const kg_vec3 about_com = kg_vec3_add(moment, kg_vec3_cross(kg_vec3_sub(root, now.com), force));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(about_com, L_dot)), 1e-6 * kg_vec3_norm(about_com));
    /* a body locked in its pose and turned as a whole: L = I w */
    const kg_vec3 w = random_vec3(&random, 1.0);
    memset(v, 0, sizeof v);
    const kg_vec3 own = kg_mat3_mul_vec_t(R[0], w);
    v[3] = own.x;
    v[4] = own.y;
    v[5] = own.z;
    const kg_centroid locked = kg_dynamics_centroid(d, q, v);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(locked.L, kg_mat3_mul_vec(locked.I, w))), 1e-12);
  }
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* power of tau = rate of change of energy */
static void power_is_the_rate_of_energy(void **state)
{
  (void)state;
  kg_random random = kg_random_make(16);
  for (int trial = 0; trial < 10; trial++) {
    kg_body *body = random_tree(&random, 4 + trial, NULL);
    kg_dynamics *d = dynamics_of(body);
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], tau[MAX_NV], later[MAX_NQ], v_later[MAX_NV];
    double step[MAX_NV], energy[2], power = 0.0;
    random_state(&random, body, q, v, a);
    kg_dynamics_inverse(d, tau, q, v, a);
    const double h = 1e-5;
    for (int side = 0; side < 2; side++) {
      const double t = side == 0 ? h : -h;
      for (int k = 0; k < body->nv; k++) {
        step[k] = t * v[k] + 0.5 * t * t * a[k];
        v_later[k] = v[k] + t * a[k];
      }
      kg_body_integrate(body, later, q, step);
      energy[side] = kg_dynamics_energy(d, later, v_later);
    }
    for (int k = 0; k < body->nv; k++) {
      power += tau[k] * v[k];
    }
    assert_close((energy[0] - energy[1]) / (2.0 * h), power, 1e-6);
    kg_dynamics_destroy(d);
    kg_body_destroy(body);
  }
}

static void integrate_and_difference_are_inverse(void **state)
{
  (void)state;
  kg_random random = kg_random_make(17);
  kg_body *body = human_body();
  for (int trial = 0; trial < 20; trial++) {
    double q[MAX_NQ], v[MAX_NV], a[MAX_NV], q2[MAX_NQ], back[MAX_NV];
    random_state(&random, body, q, v, a);
    for (int k = 0; k < body->nv; k++) {
      v[k] *= 0.3;
    }
    for (int k = 3; k < body->nq; k++) {
      q[k] *= 1.0 + 1e-9; /* as after many steps */
    }
    kg_body_integrate(body, q2, q, v);
    kg_body_difference(body, back, q2, q);
    assert_at_most(largest_difference(back, v, body->nv), 1e-13);
    memcpy(a, v, sizeof a);
    for (int i = 0; i < body->segment_count; i++) { /* no drift away from unit length */
      double *r = q2 + 3 + 4 * i;
      assert_close(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3], 1.0, 4e-16 * 4);
    }
    kg_body_integrate(body, q, q, a); /* in place */
    assert_memory_equal(q, q2, (size_t)body->nq * sizeof *q);
  }
  kg_body_destroy(body);
}

/* Pivots inside a diagonal block may vanish, blocks not: leaves need an exchange of rows. */
static void fill_tree_matrix(kg_random *random, const kg_tree *tree, kg_tree_matrix *A)
{
  for (int k = 0; k < tree->size; k++) {
    A->low[k] = kg_random_normal(random);
    A->up[k] = kg_random_normal(random);
  }
  for (int b = 0; b < tree->blocks; b++) {
    kg_mat3 D = kg_mat3_scale(0.1, kg_tree_low(tree, A, b, tree->depth[b]));
    static const int large[2][3] = {{1, 5, 6}, {0, 5, 7}}; /* where the rows have their largest */
    for (int r = 0; r < 3; r++) {
      D.m[large[b % 2][r]] += r == 1 ? -20.0 : 20.0;
    }
    if (b % 2 == 0) { /* without an exchange of rows the first pivot vanishes, or the second */
      D.m[0] = 0.0;
    } else {
      D.m[4] = D.m[1] * D.m[3] / D.m[0];
    }
    kg_tree_set_low(tree, A, b, tree->depth[b], &D);
  }
}

/* The tree's LU, plain and transposed, against LAPACK on random matrices of the tree's pattern. */
static void tree_factors_solve_like_lapack(void **state)
{
  (void)state;
  kg_random random = kg_random_make(18);
  for (int trial = 0; trial < 20; trial++) {
    kg_body *body = random_tree(&random, 1 + trial, NULL);
    const int nv = body->nv;
    kg_arena arena;
    kg_arena_init(&arena, NULL);
    kg_tree tree;
    kg_tree_matrix A;
    kg_tree_init(&tree, body, &arena);
    kg_tree_matrix_init(&A, &tree, &arena);
    fill_tree_matrix(&random, &tree, &A);
    static double dense[MAX_NV * MAX_NV], columns[MAX_NV * MAX_NV];
    kg_tree_to_dense(&tree, &A, dense);
    double b[MAX_NV], x[MAX_NV], y[MAX_NV], x_lapack[MAX_NV], y_lapack[MAX_NV];
    for (int k = 0; k < nv; k++) {
      b[k] = kg_random_normal(&random);
    }
    const size_t bytes = (size_t)nv * sizeof *b;
    memcpy(x, b, bytes);
    memcpy(y, b, bytes);
    memcpy(x_lapack, b, bytes);
    memcpy(y_lapack, b, bytes);
    assert_true(kg_tree_factor(&tree, &A));
    kg_tree_solve(&tree, &A, x);
    kg_tree_solve_transposed(&tree, &A, y);
    const int one = 1;
    int pivots[MAX_NV], info = 0;
    memcpy(columns, dense, sizeof columns); /* row-major is the transpose for Fortran */
    dgesv_(&nv, &one, columns, &nv, pivots, y_lapack, &nv, &info);
    assert_int_equal(info, 0);
    for (int r = 0; r < nv; r++) {
      for (int c = 0; c < nv; c++) {
        columns[c * nv + r] = dense[r * nv + c];
      }
    }
    dgesv_(&nv, &one, columns, &nv, pivots, x_lapack, &nv, &info);
    assert_int_equal(info, 0);
    assert_at_most(largest_difference(x, x_lapack, nv), 1e-11 * fmax(1.0, largest(x, nv)));
    assert_at_most(largest_difference(y, y_lapack, nv), 1e-11 * fmax(1.0, largest(y, nv)));
    memset(A.low, 0, (size_t)tree.size * sizeof *A.low);
    assert_false(kg_tree_factor(&tree, &A)); /* singular is said */
    kg_arena_release(&arena);
    kg_body_destroy(body);
  }
}

/* Right-hand sides on the path of one block: its rows of the solution, the others untouched. */
static void check_solution_within(const kg_tree *tree, const kg_tree_matrix *A, int m)
{
  static double X[MAX_NV * 80], Y[MAX_NV * 80];
  const int b = tree->blocks - 1;
  const int *path = tree->path + tree->start[b];
  bool on_path[MAX_NV] = {false};
  memset(X, 0, sizeof X);
  for (int k = 0; k <= tree->depth[b]; k++) {
    on_path[path[k]] = true;
    for (int j = 0; j < 3 * m; j++) {
      X[3 * path[k] * m + j] = sin(1.0 + 3.0 * k + j);
    }
  }
  memcpy(Y, X, sizeof X);
  for (int k = 0; k < 3 * tree->blocks * m; k++) {
    Y[k] = on_path[k / (3 * m)] ? Y[k] : 17.0;
  }
  kg_tree_solve_many(tree, A, X, m);
  kg_tree_solve_many_within(tree, A, Y, m, path, tree->depth[b] + 1);
  for (int k = 0; k < 3 * tree->blocks * m; k++) {
    const double wanted = on_path[k / (3 * m)] ? X[k] : 17.0;
    assert_true(Y[k] == wanted);
  }
}

/* Many right-hand sides against one at a time; every instruction set gives the same bits. */
static void many_right_hand_sides_are_each_their_own(void **state)
{
  (void)state;
  kg_random random = kg_random_make(20);
  static const int counts[] = {1, 7, 8, 40, 75};
  for (int trial = 0; trial < 12; trial++) {
    kg_body *body = random_tree(&random, 1 + 2 * trial, NULL);
    const int nv = body->nv;
    kg_arena arena;
    kg_arena_init(&arena, NULL);
    kg_tree tree;
    kg_tree_matrix A, B;
    kg_tree_init(&tree, body, &arena);
    kg_tree_matrix_init(&A, &tree, &arena);
    kg_tree_matrix_init(&B, &tree, &arena);
    fill_tree_matrix(&random, &tree, &A);
    const size_t bytes = (size_t)tree.size * sizeof *A.low;
    memcpy(B.low, A.low, bytes);
    memcpy(B.up, A.up, bytes);
    tree.kernels = kg_physics_kernels_of_level(1);
    assert_true(kg_tree_factor(&tree, &A));
    for (int level = 1; level <= 3; level++) {
      if (!kg_physics_kernels_of_level(level)) {
        print_message("no kernels of level %d here\n", level);
        continue;
      }
      tree.kernels = kg_physics_kernels_of_level(level);
      kg_tree_matrix C;
      kg_tree_matrix_init(&C, &tree, &arena);
      memcpy(C.low, B.low, bytes);
      memcpy(C.up, B.up, bytes);
      assert_true(kg_tree_factor(&tree, &C));
      assert_memory_equal(C.low, A.low, bytes);
      assert_memory_equal(C.up, A.up, bytes);
      const int m = counts[trial % 5];
      static double X[MAX_NV * 80], Y[MAX_NV * 80];
      double x[MAX_NV], y[MAX_NV];
      for (int k = 0; k < nv * m; k++) {
        X[k] = Y[k] = kg_random_normal(&random);
      }
      static double start[MAX_NV * 80];
      memcpy(start, X, sizeof start);
      kg_tree_solve_many(&tree, &C, X, m);
      kg_tree_solve_transposed_many(&tree, &C, Y, m);
      check_solution_within(&tree, &C, m);
      for (int j = 0; j < m; j++) {
        for (int k = 0; k < nv; k++) {
          x[k] = y[k] = start[k * m + j];
        }
        kg_tree_solve(&tree, &C, x);
        kg_tree_solve_transposed(&tree, &C, y);
        for (int k = 0; k < nv; k++) {
          assert_at_most(fabs(X[k * m + j] - x[k]), 1e-13 * fmax(1.0, largest(x, nv)));
          assert_at_most(fabs(Y[k * m + j] - y[k]), 1e-13 * fmax(1.0, largest(y, nv)));
        }
      }
    }
    kg_arena_release(&arena);
    kg_body_destroy(body);
  }
}

static void survives_every_allocation_failure(void **state)
{
  (void)state;
  kg_body *body = human_body();
  bool done = false;
  int refused = 0;
  while (!done) {
    failing_heap heap = {.calls_left = refused};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_dynamics *d = (kg_dynamics *)body;
    kg_body *copy = (kg_body *)(void *)&heap;
    kg_status status = kg_body_create(&copy, body->segments, body->segment_count, body->points,
                                      body->point_count, &allocator);
    if (status == KG_OK) {
      status = kg_dynamics_create(&d, copy, &allocator);
      done = status == KG_OK;
      assert_true(done || d == NULL);
      kg_dynamics_destroy(d);
    } else {
      assert_null(copy);
    }
    assert_true(done || status == KG_ERR_NO_MEMORY);
    kg_body_destroy(copy);
    assert_int_equal(heap.live_bytes, 0);
    refused++;
  }
  assert_true(refused > 2);
  kg_dynamics_destroy(NULL);
  kg_body_destroy(NULL);
  kg_body_destroy(body);
}

static double seconds(void)
{
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Prints, claims nothing: microseconds per call on the human. */
static void timings(void **state)
{
  (void)state;
  kg_random random = kg_random_make(19);
  kg_body *body = human_body();
  kg_dynamics *d = dynamics_of(body);
  double q[MAX_NQ], v[MAX_NV], a[MAX_NV], tau[MAX_NV];
  static double dq[MAX_NV * MAX_NV], dv[MAX_NV * MAX_NV], M[MAX_NV * MAX_NV];
  random_state(&random, body, q, v, a);
  const int repeats = 2000;
  double best[3] = {1.0, 1.0, 1.0};
  for (int round = 0; round < 5; round++) {
    double t[4];
    t[0] = seconds();
    for (int k = 0; k < repeats; k++) {
      kg_dynamics_inverse(d, tau, q, v, a);
    }
    t[1] = seconds();
    for (int k = 0; k < repeats / 10; k++) {
      kg_dynamics_mass_matrix(d, M, q);
    }
    t[2] = seconds();
    for (int k = 0; k < repeats / 10; k++) {
      kg_dynamics_inverse_derivatives(d, dq, dv, M, tau, q, v, a);
    }
    t[3] = seconds();
    best[0] = fmin(best[0], (t[1] - t[0]) / repeats);
    best[1] = fmin(best[1], (t[2] - t[1]) / repeats * 10.0);
    best[2] = fmin(best[2], (t[3] - t[2]) / repeats * 10.0);
  }
  print_message("23 segments, us a call: inverse %.2f, mass matrix %.2f, derivatives %.2f\n",
                1e6 * best[0], 1e6 * best[1], 1e6 * best[2]);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(pose_and_velocity_match_walking_up_the_tree),
    cmocka_unit_test(inverse_dynamics_matches_particles),
    cmocka_unit_test(mass_matrix_is_linear_part_of_inverse_dynamics),
    cmocka_unit_test(derivatives_match_differences),
    cmocka_unit_test(root_wrench_balances_momentum),
    cmocka_unit_test(power_is_the_rate_of_energy),
    cmocka_unit_test(integrate_and_difference_are_inverse),
    cmocka_unit_test(tree_factors_solve_like_lapack),
    cmocka_unit_test(many_right_hand_sides_are_each_their_own),
    cmocka_unit_test(survives_every_allocation_failure),
    cmocka_unit_test(timings),
  };
  return cmocka_run_group_tests_name("dynamics", tests, NULL, NULL);
}
