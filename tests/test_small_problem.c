/* The small contact problem inside a step: its kernels against LAPACK and plain loops, how the body
 * yields against differences of its motion, friction with a bound against its potential, the step's
 * end against the square of what was left, and answers found by the fallbacks. */
#include "fixture_body.h"
#include "fixture_step.h"

#include "kinegrad/dense.h"
#include "kinegrad/step.h"

#include "physics/contact_law.h"
#include "physics/kernels/kernels.h"
#include "physics/small_problem.h"

enum { SIZE = 18, STRIDE = 24 };

/* ---- kernels -----------------------------------------------------------------------------------*/

static void fill(kg_random *random, double *a, int count)
{
  for (int k = 0; k < count; k++) {
    a[k] = kg_random_normal(random);
  }
}

/* Rows of three segments, one of them without load: a system as the small problem has it. */
static void small_system(kg_random *random, double *B, double *x)
{
  memset(B, 0, SIZE * STRIDE * sizeof *B);
  for (int r = 0; r < SIZE; r++) {
    for (int c = 0; c < SIZE; c++) {
      const bool loaded = r < 6 || r >= 12;
      B[r * STRIDE + c] = (loaded ? 100.0 * kg_random_normal(random) : 0.0) + (r == c ? 1.0 : 0.0);
    }
    x[r] = kg_random_normal(random);
  }
}

static void dense_solution_is_that_of_lapack(void **state)
{
  (void)state;
  for (int level = 1; level <= 3; level++) {
    const kg_physics_kernels *kernels = kg_physics_kernels_of_level(level);
    if (!kernels) continue;
    kg_random random = kg_random_make(71);
    for (int trial = 0; trial < 50; trial++) {
      double B[SIZE * STRIDE], x[STRIDE], A[SIZE * SIZE], y[SIZE];
      int pivots[SIZE];
      small_system(&random, B, x);
      for (int r = 0; r < SIZE; r++) {
        memcpy(A + r * SIZE, B + r * STRIDE, SIZE * sizeof *A);
        y[r] = x[r];
      }
      assert_true(kg_dense_lu_factor(A, pivots, SIZE));
      kg_dense_lu_solve(A, pivots, SIZE, y, 1);
      assert_true(kernels->solve_dense(B, SIZE, STRIDE, x));
      for (int r = 0; r < SIZE; r++) {
        assert_close(x[r], y[r], 1e-10);
      }
      small_system(&random, B, x); /* two equal rows */
      memcpy(B + 3 * STRIDE, B + 14 * STRIDE, STRIDE * sizeof *B);
      memset(B + 5 * STRIDE, 0, STRIDE * sizeof *B);
      assert_false(kernels->solve_dense(B, SIZE, STRIDE, x));
    }
  }
}

/* All products of a level into one array, to compare levels bit for bit. */
static void run_products(const kg_physics_kernels *kernels, double out[4][8 * STRIDE])
{
  kg_random random = kg_random_make(72);
  double K[48], D[48], xi[6 * STRIDE], nu[6 * STRIDE], Y[3 * STRIDE], h[STRIDE];
  fill(&random, K, 48);
  fill(&random, D, 48);
  fill(&random, xi, 6 * STRIDE);
  fill(&random, nu, 6 * STRIDE);
  fill(&random, Y, 3 * STRIDE);
  fill(&random, h, STRIDE);
  kg_mat63 T;
  fill(&random, T.w.m, 12);
  fill(&random, T.v.m, 12);
  memset(out, 0, 4 * sizeof out[0]);
  kernels->wrench_rows(out[0], K, D, xi, nu, STRIDE);
  kernels->add_motion(out[1], xi, &T, Y, STRIDE);
  kernels->add_motion(out[2], NULL, &T, Y, STRIDE);
  kernels->add_rows(out[3], xi, h, STRIDE);
  for (int r = 0; r < 6; r++) {
    double dot = 0.0;
    for (int c = 0; c < STRIDE; c++) {
      double rows = 0.0, moved = 0.0;
      for (int k = 0; k < 6; k++) {
        rows -= K[8 * r + k] * xi[k * STRIDE + c] + D[8 * r + k] * nu[k * STRIDE + c];
      }
      for (int k = 0; k < 3; k++) {
        moved += (r < 3 ? T.w.m[4 * r + k] : T.v.m[4 * (r - 3) + k]) * Y[k * STRIDE + c];
      }
      dot += xi[r * STRIDE + c] * h[c];
      assert_close(out[0][r * STRIDE + c], rows, 1e-13);
      assert_close(out[1][r * STRIDE + c], xi[r * STRIDE + c] + moved, 1e-13);
      assert_close(out[2][r * STRIDE + c], moved, 1e-13);
    }
    assert_close(out[3][r], dot, 1e-13);
  }
}

static void products_are_those_of_plain_loops_at_every_level(void **state)
{
  (void)state;
  static double first[4][8 * STRIDE], other[4][8 * STRIDE];
  run_products(kg_physics_kernels_of_level(1), first);
  for (int level = 2; level <= 3; level++) {
    const kg_physics_kernels *kernels = kg_physics_kernels_of_level(level);
    if (kernels) {
      run_products(kernels, other);
      assert_memory_equal(first, other, sizeof first);
    }
  }
}

/* K and D of a contact against the wrench of a force that changes by its definition: the point moves
 * by v + w x x, its velocity by that of the change nu and by w x u. */
static void contact_rows_are_the_change_of_the_wrench(void **state)
{
  (void)state;
  kg_random random = kg_random_make(73);
  for (int trial = 0; trial < 20; trial++) {
    double K[48] = {0.0}, D[48] = {0.0}, F[2][9];
    const kg_vec3 x = random_vec3(&random, 1.0), u = random_vec3(&random, 1.0);
    fill(&random, F[0], 9);
    fill(&random, F[1], 9);
    const double at[3] = {x.x, x.y, x.z}, speed[3] = {u.x, u.y, u.z};
    kg_physics_kernels_best()->add_contact(K, D, at, speed, F[0], F[1]);
    kg_mat3 F_x, F_u;
    memcpy(F_x.m, F[0], sizeof F[0]);
    memcpy(F_u.m, F[1], sizeof F[1]);
    for (int c = 0; c < 6; c++) {
      kg_vec3 w = {c == 0, c == 1, c == 2};
      const kg_vec3 v = {c == 3, c == 4, c == 5};
      const kg_vec3 moved = kg_vec3_add(v, kg_vec3_cross(w, x));
      const kg_vec3 f =
        kg_vec3_add(kg_mat3_mul_vec(F_x, moved), kg_mat3_mul_vec(F_u, kg_vec3_cross(w, u)));
      const kg_vec3 g = kg_mat3_mul_vec(F_u, moved);
      const kg_vec3 n = kg_vec3_cross(x, f), m = kg_vec3_cross(x, g);
      const double k_column[6] = {n.x, n.y, n.z, f.x, f.y, f.z};
      const double d_column[6] = {m.x, m.y, m.z, g.x, g.y, g.z};
      for (int r = 0; r < 6; r++) {
        assert_close(K[8 * r + c], k_column[r], 1e-13);
        assert_close(D[8 * r + c], d_column[r], 1e-13);
      }
    }
  }
}

/* ---- the linear body ---------------------------------------------------------------------------*/

typedef struct point_motion {
  kg_vec3 x, u;
} point_motion;

static point_motion point_at(kg_dynamics *d, const kg_body *body, const double *q, const double *v,
                             double dt, kg_body_point point)
{
  double move[MAX_NV], end[MAX_NQ], J[3 * MAX_NV], u[3] = {0.0};
  for (int k = 0; k < body->nv; k++) {
    move[k] = dt * v[k];
  }
  kg_body_integrate(body, end, q, move);
  const kg_vec3 x = kg_dynamics_point(d, J, end, point);
  for (int k = 0; k < 3 * body->nv; k++) {
    u[k / body->nv] += J[k] * v[k % body->nv];
  }
  return (point_motion){x, kg_vec3_make(u[0], u[1], u[2])};
}

/* A unit wrench on a slot changes v' by A^-1 S'; where that takes the slot's points and how fast they
 * go is compared with xi and nu. A comes from the residual of a step without a scene. */
static void compliance_is_how_points_answer_wrenches(void **state)
{
  (void)state;
  static double A[MAX_NV * MAX_NV];
  const double dt = 0.01;
  kg_random random = kg_random_make(74);
  kg_body *body = human_body();
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.joint_damping = 2.0;
  kg_step *in_air = step_of(&def);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[MAX_NQ], v[MAX_NV], v_end[MAX_NV], G[MAX_NV], rhs[MAX_NV];
  int pivots[MAX_NV];
  rest_state(body, human_root_height + 0.008, q);
  fill(&random, v, body->nv);
  for (int k = 0; k < body->nv; k++) {
    v[k] *= 0.1;
    v_end[k] = v[k] + 0.05 * kg_random_normal(&random);
  }
  kg_step_set_problem(s, q, v, NULL, dt);
  kg_step_set_scale(s);
  memset(s->small->force, 0, (size_t)body->point_count * sizeof *s->small->force);
  assert_true(kg_step_evaluate(G, v_end, s));
  assert_true(kg_small_linearize(s, 0.0, rhs));
  const kg_small_problem *p = s->small;
  assert_true(p->slots >= 3 && p->count >= 8);
  kg_step_residual(in_air, G, A, v_end, q, v, NULL, dt, NULL);
  for (int k = 0; k < body->nv; k++) {
    assert_close(rhs[k], -G[k], 1e-9);
  }
  assert_true(kg_dense_lu_factor(A, pivots, body->nv));
  double worst = 0.0;
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    const kg_body_point point = body->points[c->point];
    for (int slot = 0; slot < p->slots; slot++) {
      for (int e = 0; e < 6; e++) {
        const kg_force unit = {{e == 0, e == 1, e == 2}, {e == 3, e == 4, e == 5}};
        double y[MAX_NV] = {0.0}, plus[MAX_NV], minus[MAX_NV];
        kg_small_add_wrench(s, p->segment[slot], unit, y);
        kg_dense_lu_solve(A, pivots, body->nv, y, 1);
        double longest = 0.0;
        for (int j = 0; j < body->nv; j++) {
          longest = fmax(longest, fabs(y[j]));
        }
        const double h = 1e-3 / longest;
        for (int j = 0; j < body->nv; j++) {
          plus[j] = v_end[j] + h * y[j];
          minus[j] = v_end[j] - h * y[j];
        }
        const point_motion a = point_at(d, body, q, plus, dt, point);
        const point_motion b = point_at(d, body, q, minus, dt, point);
        const kg_vec3 dx = kg_vec3_scale(0.5 / h, kg_vec3_sub(a.x, b.x));
        const kg_vec3 du = kg_vec3_scale(0.5 / h, kg_vec3_sub(a.u, b.u));
        double xi[6], nu[6];
        for (int r = 0; r < 6; r++) {
          const int at = ((point.segment + 1) * 6 + r) * p->stride + 6 * slot + e;
          xi[r] = p->xi[at];
          nu[r] = p->nu[at];
        }
        const kg_vec3 w = kg_vec3_make(xi[0], xi[1], xi[2]);
        const kg_vec3 moved =
          kg_vec3_add(kg_vec3_make(xi[3], xi[4], xi[5]), kg_vec3_cross(w, c->trial.x));
        const kg_vec3 turned = kg_vec3_cross(kg_vec3_make(nu[0], nu[1], nu[2]), c->trial.x);
        const kg_vec3 faster = kg_vec3_add(kg_vec3_add(kg_vec3_make(nu[3], nu[4], nu[5]), turned),
                                           kg_vec3_cross(w, c->trial.u));
        const double size = kg_vec3_norm(du) + 1e-2 * longest;
        worst = fmax(worst, kg_vec3_norm(kg_vec3_sub(moved, dx)) / (dt * size));
        worst = fmax(worst, kg_vec3_norm(kg_vec3_sub(faster, du)) / size);
      }
    }
  }
  print_message("compliance of %d slots against differences: %.1e\n", p->slots, worst);
  assert_at_most(worst, 1e-6);
  kg_step_destroy(s);
  kg_step_destroy(in_air);
  kg_dynamics_destroy(d);
  kg_body_destroy(body);
}

/* ---- the law with a bound ----------------------------------------------------------------------*/

static void bounded_friction_is_the_law_where_the_bound_is_the_normal_force(void **state)
{
  (void)state;
  kg_random random = kg_random_make(75);
  kg_scene scene = ground();
  const kg_contact_params params = kg_contact_default_params();
  for (int k = 0; k < 200; k++) {
    const kg_vec3 x = {0.0, params.layer * (1.2 * kg_random_uniform(&random) - 0.2), 0.0};
    const kg_vec3 u = random_vec3(&random, k % 2 ? 1e-4 : 0.3);
    kg_contact_force a, b;
    const bool touches = kg_contact_evaluate(&params, &scene, x, u, false, &a);
    assert_true(touches == kg_contact_evaluate_bounded(&params, &scene, x, u, a.normal, false, &b));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(a.f, b.f)), 1e-12 * (1.0 + a.normal));
    assert_close(kg_contact_normal(&params, NULL, a.distance, u.y).force, a.normal, 1e-14);
  }
}

enum { L = KG_LANES };

/* Everything a group of candidates has, to compare levels bit for bit. */
typedef struct law_lanes {
  double state[9 * L], ground[11 * L], yield[2 * L], bound[L], touches[L]; /* in */
  double f[3 * L], by_x[9 * L], by_u[9 * L], linear[3 * L];                /* out */
  double at[6 * L], settled[L], way[L];
} law_lanes;

static kg_vec3 lane3(const double *lanes, int k)
{
  return kg_vec3_make(lanes[k], lanes[L + k], lanes[2 * L + k]);
}

/* In and above the layer and below the floor of the law, sticking and sliding; the last three lanes
 * have a bound, and the last does not touch. */
static law_lanes lanes_near(kg_random *random, const kg_contact_params *params,
                            const kg_scene *scene, kg_vec3 normal)
{
  law_lanes l = {.bound = {0.0}};
  for (int k = 0; k < L; k++) {
    const double height = params->layer * (2.2 * kg_random_uniform(random) - 0.2);
    const kg_vec3 beside = random_vec3(random, 0.5);
    const kg_vec3 x = kg_vec3_add_scaled(beside, height - kg_vec3_dot(beside, normal), normal);
    const kg_vec3 u = random_vec3(random, k % 2 ? 1e-4 : 0.3), f = random_vec3(random, 100.0);
    const double numbers[9] = {x.x, x.y, x.z, u.x, u.y, u.z, f.x, f.y, f.z};
    for (int c = 0; c < 9; c++) {
      l.state[c * L + k] = numbers[c];
    }
    l.yield[k] = 1e-3 * (0.1 + kg_random_uniform(random));
    l.yield[L + k] = 1e-3 * (0.1 + kg_random_uniform(random));
    l.bound[k] = k < 5 ? -1.0 : 300.0 * kg_random_uniform(random);
    l.touches[k] = k < 7 ? 1.0 : 0.0;
    const kg_contact_site site = kg_contact_find(params, scene, x);
    const kg_ground *soft = site.ground;
    const double rest[7] = {site.velocity.x,
                            site.velocity.y,
                            site.velocity.z,
                            kg_contact_friction(params, soft),
                            soft ? soft->thickness : 0.0,
                            soft ? soft->stiffness : 0.0,
                            soft ? soft->damping : 0.0};
    for (int c = 0; c < 7; c++) {
      l.ground[(4 + c) * L + k] = rest[c];
    }
  }
  return l;
}

static void run_lanes(const kg_physics_kernels *kernels, const kg_contact_params *params, double dt,
                      kg_vec3 normal, law_lanes *l)
{
  const double *u = l->state + 3 * L;
  kernels->plane_ground(l->ground, l->state, kg_vec3_make(0.0, 0.0, 0.0), normal);
  kernels->law_forces(params, l->ground, u, l->bound, l->f);
  kernels->law_derivatives(params, l->ground, u, l->bound, l->touches, l->by_x, l->by_u);
  kernels->settle_points(params, dt, l->state, l->ground, l->yield, l->bound, l->at, l->settled,
                         l->way);
  kernels->linear_forces(l->linear, l->f, l->by_x, l->by_u, l->state, l->at);
}

/* Force, derivatives and linear law of lane k are those of the point alone. */
static void compare_lane(const kg_contact_params *params, const kg_scene *scene, const law_lanes *l,
                         int k)
{
  kg_contact_force one;
  const kg_vec3 x = lane3(l->state, k), u = lane3(l->state + 3 * L, k);
  (void)kg_contact_evaluate_bounded(params, scene, x, u, l->bound[k], true, &one);
  kg_vec3 linear = one.f;
  assert_at_most(kg_vec3_norm(kg_vec3_sub(lane3(l->f, k), one.f)), 1e-9 * (1.0 + one.normal));
  const double on = l->touches[k];
  const kg_mat3 by_x = kg_mat3_scale(on, one.df_dx), by_u = kg_mat3_scale(on, one.df_du);
  double size[2] = {0.0, 0.0};
  for (int c = 0; c < 9; c++) {
    size[0] = fmax(size[0], fabs(by_x.m[c]));
    size[1] = fmax(size[1], fabs(by_u.m[c]));
  }
  for (int c = 0; c < 9; c++) {
    assert_close(l->by_x[c * L + k], by_x.m[c], 1e-9 * (1.0 + size[0]));
    assert_close(l->by_u[c * L + k], by_u.m[c], 1e-9 * (1.0 + size[1]));
  }
  const kg_vec3 dx = kg_vec3_sub(lane3(l->at, k), x), du = kg_vec3_sub(lane3(l->at + 3 * L, k), u);
  linear = kg_vec3_add(linear, kg_vec3_add(kg_mat3_mul_vec(by_x, dx), kg_mat3_mul_vec(by_u, du)));
  assert_at_most(kg_vec3_norm(kg_vec3_sub(lane3(l->linear, k), linear)),
                 1e-9 * (1.0 + one.normal + size[0] + size[1]));
}

/* (16): the point goes by dt y, y of what the law's force there is more than the force it had. */
static void lane_is_settled(const kg_contact_params *params, const kg_scene *scene, kg_vec3 n,
                            double dt, const law_lanes *l, int k)
{
  kg_contact_force there;
  const kg_vec3 x = lane3(l->state, k), u = lane3(l->state + 3 * L, k),
                f = lane3(l->state + 6 * L, k);
  const kg_vec3 x_at = lane3(l->at, k), u_at = lane3(l->at + 3 * L, k);
  const bool touches =
    kg_contact_evaluate_bounded(params, scene, x_at, u_at, l->bound[k], false, &there);
  assert_true((l->settled[k] > 0.0) == (touches && there.normal > 0.0));
  /* a bound holds only a point that touches */
  const kg_vec3 change = kg_vec3_sub(there.normal > 0.0 ? there.f : kg_vec3_make(0, 0, 0), f);
  const double along = kg_vec3_dot(change, n);
  const kg_vec3 across = kg_vec3_add_scaled(change, -along, n);
  const kg_vec3 faster =
    kg_vec3_add(kg_vec3_scale(l->yield[k] * along, n), kg_vec3_scale(l->yield[L + k], across));
  const double way = dt * kg_vec3_dot(change, faster);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(kg_vec3_sub(u_at, u), faster)), 1e-7);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(kg_vec3_sub(x_at, x), kg_vec3_scale(dt, faster))), 1e-9);
  assert_close(l->way[k], way, 1e-6 * (1.0 + way));
}

static void lanes_hold_the_law_of_each_point_at_every_level(void **state)
{
  (void)state;
  kg_random random = kg_random_make(79);
  const kg_contact_params params = kg_contact_default_params();
  const double dt = 1.0 / 120.0;
  const kg_ground mat = {.thickness = 0.004, .stiffness = 2e4, .damping = 0.7, .friction = 0.6};
  const kg_place moving = {.turn = {1.0, 0.0, 0.0, 0.0}, .velocity = {0.2, -0.1, 0.3}};
  int settled = 0;
  for (int trial = 0; trial < 50; trial++) {
    const kg_vec3 normal = kg_vec3_normalized(random_vec3(&random, 1.0));
    kg_scene scene = kg_scene_ground(0.0, normal);
    if (trial % 2) { /* soft, and on its way */
      scene.shapes[0].ground = kg_scene_add_ground(&scene, &mat);
      scene.shapes[0].place = kg_scene_add_place(&scene, &moving);
    }
    const law_lanes in = lanes_near(&random, &params, &scene, normal);
    law_lanes first = in;
    run_lanes(kg_physics_kernels_of_level(1), &params, dt, normal, &first);
    for (int k = 0; k < L; k++) {
      compare_lane(&params, &scene, &first, k);
      lane_is_settled(&params, &scene, normal, dt, &first, k);
      settled += first.settled[k] > 0.0;
    }
    for (int level = 2; level <= 3; level++) {
      const kg_physics_kernels *kernels = kg_physics_kernels_of_level(level);
      if (!kernels) continue;
      law_lanes other = in;
      run_lanes(kernels, &params, dt, normal, &other);
      assert_memory_equal(&other, &first, sizeof other);
    }
  }
  assert_in_range(settled, 100, 50 * L - 50);
}

/* The force is the negative slope of a convex function of u: its derivative is symmetric and does not
 * push, and it agrees with differences. The same for the normal law's derivatives. */
static void bounded_friction_has_a_convex_potential(void **state)
{
  (void)state;
  kg_random random = kg_random_make(76);
  kg_scene scene = ground();
  const kg_contact_params params = kg_contact_default_params();
  for (int k = 0; k < 200; k++) {
    const kg_vec3 x = {0.0, params.layer * (0.05 + 0.9 * kg_random_uniform(&random)), 0.0};
    const kg_vec3 u = random_vec3(&random, k % 2 ? 1e-4 : 0.3), e = random_vec3(&random, 1.0);
    const double bound = 500.0 * kg_random_uniform(&random), h = 1e-9;
    kg_contact_force f, plus, minus;
    assert_true(kg_contact_evaluate_bounded(&params, &scene, x, u, bound, true, &f));
    for (int r = 0; r < 3; r++) {
      for (int c = 0; c < r; c++) {
        assert_close(f.df_du.m[3 * r + c], f.df_du.m[3 * c + r], 1e-9);
      }
    }
    assert_at_most(kg_vec3_dot(e, kg_mat3_mul_vec(f.df_du, e)), 1e-9);
    (void)kg_contact_evaluate_bounded(&params, &scene, x, kg_vec3_add_scaled(u, h, e), bound, false,
                                      &plus);
    (void)kg_contact_evaluate_bounded(&params, &scene, x, kg_vec3_add_scaled(u, -h, e), bound,
                                      false, &minus);
    const kg_vec3 slope = kg_vec3_scale(0.5 / h, kg_vec3_sub(plus.f, minus.f));
    const kg_vec3 exact = kg_mat3_mul_vec(f.df_du, e);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(slope, exact)), 1e-4 * (1e3 + kg_vec3_norm(exact)));
    const kg_normal_law n = kg_contact_normal(&params, NULL, x.y, u.y);
    const double by_x = (kg_contact_normal(&params, NULL, x.y + 1e-9, u.y).force -
                         kg_contact_normal(&params, NULL, x.y - 1e-9, u.y).force) /
                        2e-9;
    const double by_u = (kg_contact_normal(&params, NULL, x.y, u.y + 1e-6).force -
                         kg_contact_normal(&params, NULL, x.y, u.y - 1e-6).force) /
                        2e-6;
    assert_at_most(fabs(n.by_distance - by_x), 1e-5 * (1.0 + fabs(by_x)));
    assert_at_most(fabs(n.by_speed - by_u), 1e-5 * (1.0 + fabs(by_u)));
  }
}

/* ---- convergence -------------------------------------------------------------------------------*/

/* Standing, feet disturbed; it is pushed by joint torques. */
static void shaken_state(kg_random *random, const kg_body *body, double *q, double *v, double *tau)
{
  double move[MAX_NV];
  rest_state(body, human_root_height + 0.003, q);
  for (int k = 0; k < body->nv; k++) {
    move[k] = 0.003 * kg_random_normal(random);
    v[k] = 0.1 * kg_random_normal(random);
    tau[k] = k < 6 ? 0.0 : 10.0 * kg_random_normal(random);
  }
  move[1] = 0.0;
  kg_body_integrate(body, q, q, move);
}

/* Residual after so many iterations at most. */
static double residual_after(kg_step_def def, int most, const double *q, const double *v,
                             const double *tau, kg_step_report *report)
{
  double q_next[MAX_NQ], v_next[MAX_NV];
  def.max_iterations = most;
  def.max_substep_levels = 0;
  def.tolerance = 1e-12; /* as far as it goes */
  kg_step *s = step_of(&def);
  kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, false, report);
  kg_step_destroy(s);
  return report->residual;
}

static void the_end_is_quadratic(void **state)
{
  (void)state;
  kg_random random = kg_random_make(77);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 5.0;
  int pairs = 0;
  double worst = 0.0;
  for (int trial = 0; trial < 100; trial++) {
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], last = INFINITY;
    kg_step_report report;
    shaken_state(&random, body, q, v, tau);
    for (int most = 0; most < 8; most++) {
      const double m = residual_after(def, most, q, v, tau, &report);
      if (last < 1.0 && last > 1e-4) { /* before that: far; after that: rounding */
        worst = fmax(worst, m / (last * last));
        pairs++;
      }
      last = m;
    }
    assert_at_most(last, 1e-9);
  }
  print_message("%d pairs of residuals: the next at most %.1e of the square\n", pairs, worst);
  assert_true(pairs >= 20);
  assert_at_most(worst, 0.1);
  kg_body_destroy(body);
}

/* Cut short, a step keeps the iterate with the least residual, which need not be the last one. */
static void the_best_iterate_is_kept(void **state)
{
  (void)state;
  kg_random random = kg_random_make(79);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 5.0;
  def.max_substep_levels = 0;
  kg_step *fresh = step_of(&def);
  int kept = 0;
  for (int trial = 0; trial < 40; trial++) {
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV], G[MAX_NV];
    double last = INFINITY;
    kg_step_report report, check;
    shaken_state(&random, body, q, v, tau);
    v[1] = -2.0 * kg_random_uniform(&random);
    for (int most = 0; most < 6; most++) {
      def.max_iterations = most;
      kg_step *s = step_of(&def);
      memcpy(v_next, v, sizeof v_next);
      v_next[1] -= 0.2; /* a guess in the ground, or a better one than the first iterate */
      kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, trial % 2 == 0, &report);
      kg_step_residual(fresh, G, NULL, v_next, q, v, tau, 0.01, &check);
      assert_at_most(fabs(check.residual - report.residual), 1e-6 * report.residual + 1e-9);
      kept += !report.converged && report.residual == last;
      last = report.residual;
      kg_step_destroy(s);
    }
  }
  print_message("%d iterates were worse than the one before\n", kept);
  assert_true(kept > 0);
  kg_step_destroy(fresh);
  kg_body_destroy(body);
}

/* In the air from a guess that is far off: steps are cut, and the end is reached. */
static void flight_is_found_from_afar(void **state)
{
  (void)state;
  kg_random random = kg_random_make(80);
  kg_body *body = human_body();
  kg_step_def def = kg_step_default_def(body);
  kg_step *s = step_of(&def);
  int cuts = 0;
  for (int trial = 0; trial < 40; trial++) {
    double q[MAX_NQ], v[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV];
    kg_step_report report;
    rest_state(body, 2.0, q);
    for (int k = 0; k < body->nv; k++) {
      v[k] = 3.0 * kg_random_normal(&random);
      v_next[k] = v[k] + 10.0 * kg_random_normal(&random);
    }
    kg_step_advance(s, q_next, v_next, q, v, NULL, 0.02, true, &report);
    assert_true(report.converged);
    cuts += report.cuts;
  }
  print_message("flight from afar: %d cuts\n", cuts);
  assert_true(cuts > 0);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* Hard landings: every answer obeys the law that was asked for, whatever softer or bounded law showed
 * the way, and some need one. */
static void fallbacks_end_at_the_law_itself(void **state)
{
  (void)state;
  kg_random random = kg_random_make(78);
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 5.0;
  kg_step *s = step_of(&def), *fresh = step_of(&def);
  int fallbacks = 0, plain = 0;
  for (int trial = 0; trial < 150; trial++) {
    double q[MAX_NQ], v[MAX_NV], tau[MAX_NV], q_next[MAX_NQ], v_next[MAX_NV], G[MAX_NV];
    kg_step_report report, check;
    shaken_state(&random, body, q, v, tau);
    for (int k = 3; k < body->nv; k++) {
      v[k] *= 3.0;
    }
    v[1] = -2.0 * kg_random_uniform(&random);
    kg_step_advance(s, q_next, v_next, q, v, tau, 0.01, false, &report);
    assert_true(report.converged);
    assert_true(report.contact_iterations >= report.iterations - 1);
    if (report.substeps > 1) continue;
    kg_step_residual(fresh, G, NULL, v_next, q, v, tau, 0.01, &check);
    assert_at_most(check.residual, def.tolerance);
    assert_int_equal(check.contact_count, report.contact_count);
    fallbacks += report.used_fallback;
    plain += !report.used_fallback;
  }
  print_message("%d landings with a fallback, %d without\n", fallbacks, plain);
  assert_true(fallbacks >= 3 && plain >= 50);
  kg_step_destroy(s);
  kg_step_destroy(fresh);
  kg_body_destroy(body);
}

/* A chain of thirty segments flat on the ground: every one of them is a slot. */
static void any_number_of_segments_may_touch(void **state)
{
  (void)state;
  enum { LINKS = 30 };
  kg_segment segments[LINKS];
  kg_body_point points[2 * LINKS];
  for (int i = 0; i < LINKS; i++) {
    segments[i] = fixture_segment("link", i - 1, kg_vec3_make(i > 0 ? 0.1 : 0.0, 0.0, 0.0), 0.5,
                                  kg_vec3_make(0.05, 0.0, 0.0), kg_vec3_make(0.05, 0.02, 0.02));
    points[2 * i] = (kg_body_point){i, {0.02, -0.02, 0.02}};
    points[2 * i + 1] = (kg_body_point){i, {0.08, -0.02, -0.02}};
  }
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, segments, LINKS, points, 2 * LINKS, NULL), KG_OK);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 0.1;
  kg_step *s = step_of(&def);
  double q[MAX_NQ], v[MAX_NV] = {0.0};
  rest_state(body, 0.024, q);
  kg_step_report report;
  for (int k = 0; k < 40; k++) {
    kg_step_advance(s, q, v, q, v, NULL, 0.01, false, &report);
    assert_true(report.converged && report.substeps == 1);
  }
  double weight = 0.0;
  for (int k = 0; k < report.contact_count; k++) {
    weight += report.contacts[k].force.f.y;
  }
  assert_int_equal(report.contact_count, 2 * LINKS);
  assert_close(weight / (9.8 * body->mass), 1.0, 1e-2);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(dense_solution_is_that_of_lapack),
    cmocka_unit_test(products_are_those_of_plain_loops_at_every_level),
    cmocka_unit_test(contact_rows_are_the_change_of_the_wrench),
    cmocka_unit_test(compliance_is_how_points_answer_wrenches),
    cmocka_unit_test(bounded_friction_is_the_law_where_the_bound_is_the_normal_force),
    cmocka_unit_test(lanes_hold_the_law_of_each_point_at_every_level),
    cmocka_unit_test(bounded_friction_has_a_convex_potential),
    cmocka_unit_test(the_end_is_quadratic),
    cmocka_unit_test(the_best_iterate_is_kept),
    cmocka_unit_test(flight_is_found_from_afar),
    cmocka_unit_test(fallbacks_end_at_the_law_itself),
    cmocka_unit_test(any_number_of_segments_may_touch),
  };
  return cmocka_run_group_tests_name("small problem", tests, NULL, NULL);
}
