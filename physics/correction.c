/* Penetration of a pose and its correction; the contract is in kinegrad/correction.h, the derivation
 * in docs/theory/sdf.md.
 *
 *   q0, q    pose at the start and now, q = q0 (+) D
 *   x_k      sample points in the world        Phi_k, n_k   distance and normal there
 *   M        mass matrix at q0, M = L L'       m            total mass
 *   g_k      = d Phi_k / d(tangent) = J_k' n_k
 *
 * The second-order method is sequential quadratic programming with the Hessian of the objective:
 *   min 1/2 D' M D  s.t.  Phi_k(q0 (+) D) >= 0
 * linearised at the current D, a step controlled by the l1 merit function
 *   1/2 D' M D + mu sum_k max(-Phi_k, 0),   mu > max multiplier          [NW] section 18.5, (18.27)
 * [NW] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006. */
#include "kinegrad/correction.h"

#include "kinegrad/dense.h"
#include "physics/physics.h"
#include "solver/least_move.h"

#include <string.h>

enum { ROWS_MAX = 256, SQP_STEPS = 40, SQP_HALVINGS = 8, ESCAPE_STEPS = 400 };

/* Points nearer than this (m) to the surface take part in a step, beside those inside. */
#define NEAR 5e-3
/* A step of the second-order method turns no joint and moves the root by no more (rad, m). */
#define STEP_MAX 0.5
/* The second-order method is done when a step changes the move by less than this share. */
#define STEP_SHARE 1e-2
/* A pose counts as touching when its lowest point is nearer than this (m). */
#define GAP_MAX 1e-4
/* A linearised constraint may be missed by this much (m; m/s for velocities). */
#define ROW_TOLERANCE 1e-9

struct kg_correction {
  kg_correction_def def;
  kg_arena arena;
  kg_dynamics *dynamics;
  int nv, point_count;

  /* the last pose sampled */
  kg_vec3 *p;      /* (n) joints     */
  kg_mat3 *R;      /* (n) rotations  */
  kg_mat3 *Jr;     /* (n) right Jacobians at D */
  kg_vec3 *x;      /* (points)       */
  kg_vec3 *normal; /* (points)       */
  double *phi;     /* (points)       */
  double d_pen, sum_depth, L_coll, lowest;

  /* the move */
  double *q0, *q_now, *q_from;         /* (nq)                                   */
  double *D, *D_trial, *D_best, *goal; /* (nv) moves from q0             */
  double *gradient, *slope;            /* (nv) grad L_coll; direction of descent   */
  double *chol;                        /* (nv, nv) L of M at q0                    */
  double *M;                           /* (nv, nv)                                 */
  bool *pushed;                        /* (points) carries a multiplier            */

  /* the linearised constraints */
  int rows;
  int *point_of_row;      /* (ROWS_MAX)     */
  double *G, *b, *lambda; /* (ROWS_MAX, nv), (ROWS_MAX), (ROWS_MAX) */
  least_move solver;

  /* rates of the pose along a direction */
  kg_vec3 *w, *p_dot;  /* (n) */
  kg_vec3 *f, *moment; /* (n) force and moment about O on each segment */
};

kg_correction_def kg_correction_default_def(const kg_body *body, const kg_scene *scene)
{
  return (kg_correction_def){
    .body = body,
    .scene = scene,
    .method = KG_CORRECTION_SECOND_ORDER,
    .tolerance = 1e-5,
    .eta = 0.1,
    .max_iterations = 200,
  };
}

static void allocate(kg_correction *c, kg_arena *arena)
{
  const kg_body *body = c->def.body;
  const int n = body->segment_count, nv = body->nv, K = body->point_count;
  const size_t square = (size_t)nv * (size_t)nv;
  const int rows = K < ROWS_MAX ? K : ROWS_MAX;
  c->p = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->R = KG_ARENA_ARRAY(arena, kg_mat3, n);
  c->Jr = KG_ARENA_ARRAY(arena, kg_mat3, n);
  c->w = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->p_dot = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->f = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->moment = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->x = KG_ARENA_ARRAY(arena, kg_vec3, K);
  c->normal = KG_ARENA_ARRAY(arena, kg_vec3, K);
  c->phi = KG_ARENA_ARRAY(arena, double, K);
  c->pushed = KG_ARENA_ARRAY(arena, bool, K);
  c->q0 = KG_ARENA_ARRAY(arena, double, body->nq);
  c->q_now = KG_ARENA_ARRAY(arena, double, body->nq);
  c->q_from = KG_ARENA_ARRAY(arena, double, body->nq);
  c->D = KG_ARENA_ARRAY(arena, double, nv);
  c->D_best = KG_ARENA_ARRAY(arena, double, nv);
  c->D_trial = KG_ARENA_ARRAY(arena, double, nv);
  c->goal = KG_ARENA_ARRAY(arena, double, nv);
  c->gradient = KG_ARENA_ARRAY(arena, double, nv);
  c->slope = KG_ARENA_ARRAY(arena, double, nv);
  c->chol = KG_ARENA_ARRAY(arena, double, square);
  c->M = KG_ARENA_ARRAY(arena, double, square);
  c->point_of_row = KG_ARENA_ARRAY(arena, int, rows);
  c->G = KG_ARENA_ARRAY(arena, double, (size_t)rows *(size_t)nv);
  c->b = KG_ARENA_ARRAY(arena, double, rows);
  c->lambda = KG_ARENA_ARRAY(arena, double, rows);
  least_move_init(&c->solver, nv, rows, arena);
}

kg_status kg_correction_create(kg_correction **correction, const kg_correction_def *def)
{
  KG_ASSERT(correction && def && def->body && def->scene && def->tolerance > 0.0);
  *correction = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_correction *c = KG_ARENA_ARRAY(&arena, kg_correction, 1);
  if (!c) return KG_ERR_NO_MEMORY;
  c->def = *def;
  c->nv = def->body->nv;
  c->point_count = def->body->point_count;
  allocate(c, &arena);
  c->arena = arena;
  if (kg_arena_failed(&arena) ||
      kg_dynamics_create(&c->dynamics, def->body, def->allocator) != KG_OK) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  *correction = c;
  return KG_OK;
}

void kg_correction_destroy(kg_correction *correction)
{
  if (correction) {
    kg_dynamics_destroy(correction->dynamics);
    kg_arena arena = correction->arena; /* the object lives in its own arena */
    kg_arena_release(&arena);
  }
}

/* ---- penetration --------------------------------------------------------------------------------*/

/* Distances at the points x, and (9), (10). A NaN anywhere makes d_pen NaN. */
static void measure(kg_correction *c, kg_vec3 shift)
{
  double least = INFINITY, depth = 0.0, square = 0.0;
  bool defined = true;
  for (int k = 0; k < c->point_count; k++) {
    const kg_sdf_value v = kg_scene_distance(c->def.scene, kg_vec3_add(c->x[k], shift));
    c->phi[k] = v.distance;
    c->normal[k] = v.normal;
    if (v.distance < 0.0) {
      depth -= v.distance;
      square += v.distance * v.distance;
    }
    least = v.distance < least ? v.distance : least;
    defined = defined && !isnan(v.distance);
  }
  c->lowest = defined ? least : NAN;
  c->d_pen = defined ? fmax(-least, 0.0) : NAN;
  c->sum_depth = depth;
  c->L_coll = square;
}

static void sample(kg_correction *c, const double *q)
{
  kg_dynamics_pose(c->dynamics, q, c->p, c->R);
  for (int k = 0; k < c->point_count; k++) {
    const kg_body_point *point = &c->def.body->points[k];
    c->x[k] = kg_vec3_add(c->p[point->segment], kg_mat3_mul_vec(c->R[point->segment], point->p));
  }
  measure(c, kg_vec3_make(0.0, 0.0, 0.0));
}

/* grad L_coll = sum_k -2 max(-Phi_k, 0) J_k' n_k: forces at the points, summed from the leaves to
 * the root; the moment about a joint is the entry of its rotation, in segment axes. */
static void collision_gradient(kg_correction *c, double *gradient)
{
  const int n = c->def.body->segment_count;
  const kg_vec3 zero = {0.0, 0.0, 0.0}, o = c->p[0];
  for (int i = 0; i < n; i++) {
    c->f[i] = c->moment[i] = zero;
  }
  for (int k = 0; k < c->point_count; k++) {
    if (!(c->phi[k] < 0.0)) continue;
    const int i = c->def.body->points[k].segment;
    const kg_vec3 f = kg_vec3_scale(2.0 * c->phi[k], c->normal[k]);
    c->f[i] = kg_vec3_add(c->f[i], f);
    c->moment[i] = kg_vec3_add(c->moment[i], kg_vec3_cross(kg_vec3_sub(c->x[k], o), f));
  }
  for (int i = n - 1; i >= 0; i--) {
    const kg_vec3 arm = kg_vec3_sub(c->p[i], o);
    const kg_vec3 about_joint = kg_vec3_sub(c->moment[i], kg_vec3_cross(arm, c->f[i]));
    kg_store3(gradient + 3 + 3 * i, kg_mat3_mul_vec_t(c->R[i], about_joint));
    const int parent = c->def.body->segments[i].parent;
    if (parent >= 0) {
      c->f[parent] = kg_vec3_add(c->f[parent], c->f[i]);
      c->moment[parent] = kg_vec3_add(c->moment[parent], c->moment[i]);
    }
  }
  kg_store3(gradient, c->f[0]);
}

double kg_penetration(kg_correction *correction, const double *q, double *L_coll, double *gradient)
{
  KG_ASSERT(correction && q);
  sample(correction, q);
  if (L_coll) {
    *L_coll = correction->L_coll;
  }
  if (gradient) {
    collision_gradient(correction, gradient);
  }
  return correction->d_pen;
}

/* ---- small algebra ------------------------------------------------------------------------------*/

static double dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++) {
    sum += a[i] * b[i];
  }
  return sum;
}

/* d' M d */
static double metric2(const kg_correction *c, const double *d)
{
  double sum = 0.0;
  for (int i = 0; i < c->nv; i++) {
    sum += d[i] * dot(c->M + (size_t)i * (size_t)c->nv, d, c->nv);
  }
  return sum;
}

/* M and its factor at q. A body with massless ends has a singular M: it gets a small share more. */
static void factor_mass(kg_correction *c, const double *q)
{
  const size_t nv = (size_t)c->nv;
  kg_dynamics_mass_matrix(c->dynamics, c->M, q);
  for (double share = 0.0; share < 1.0; share = share == 0.0 ? 1e-9 : 100.0 * share) {
    memcpy(c->chol, c->M, nv * nv * sizeof *c->M);
    for (size_t i = 0; i < nv; i++) {
      c->chol[i * nv + i] += share * (c->M[0] + c->M[i * nv + i]);
    }
    if (kg_dense_cholesky_factor(c->chol, c->nv)) return;
  }
}

/* q_now = q0 (+) D, sampled */
static void go_to(kg_correction *c, const double *D)
{
  kg_body_integrate(c->def.body, c->q_now, c->q0, D);
  sample(c, c->q_now);
}

/* ---- second order -------------------------------------------------------------------------------*/

/* row = J_k' n_k at the sampled pose: along the chain from the point's segment to the root */
static void point_row(const kg_correction *c, int k, double *row)
{
  memset(row, 0, (size_t)c->nv * sizeof *row);
  const kg_vec3 n = c->normal[k];
  kg_store3(row, n);
  for (int i = c->def.body->points[k].segment; i >= 0; i = c->def.body->segments[i].parent) {
    const kg_vec3 moment = kg_vec3_cross(kg_vec3_sub(c->x[k], c->p[i]), n);
    kg_store3(row + 3 + 3 * i, kg_mat3_mul_vec_t(c->R[i], moment));
  }
}

/* d/dD of q0 (+) D: every rotation's entry times the right Jacobian at D, [SOLA] (143) in quat.h */
static void row_to_move(const kg_correction *c, double *row)
{
  for (int i = 0; i < c->def.body->segment_count; i++) {
    double *r = row + 3 + 3 * i;
    if (r[0] != 0.0 || r[1] != 0.0 || r[2] != 0.0) {
      kg_store3(r, kg_mat3_mul_vec_t(c->Jr[i], kg_load3(r)));
    }
  }
}

static int count_below(const kg_correction *c, double phi)
{
  int count = 0;
  for (int k = 0; k < c->point_count; k++) {
    count += c->phi[k] < phi;
  }
  return count;
}

/* Points below the returned distance take part: those inside and near, the deepest when too many. */
static double nearness(const kg_correction *c)
{
  double high = c->d_pen + NEAR;
  if (count_below(c, high) <= ROWS_MAX) return high;
  double low = c->lowest;
  for (int i = 0; i < 50; i++) {
    const double middle = 0.5 * (low + high);
    if (count_below(c, middle) <= ROWS_MAX) {
      low = middle;
    } else {
      high = middle;
    }
  }
  return low;
}

/* Phi + g' (goal - D) >= 0 for the points that take part, as G goal >= b */
static void linearise(kg_correction *c)
{
  for (int i = 0; i < c->def.body->segment_count; i++) {
    c->Jr[i] = kg_so3_right_jacobian(kg_load3(c->D + 3 + 3 * i));
  }
  const double near = nearness(c);
  c->rows = 0;
  for (int k = 0; k < c->point_count; k++) {
    if (!(c->phi[k] < near)) continue;
    double *row = c->G + (size_t)c->rows * (size_t)c->nv;
    point_row(c, k, row);
    row_to_move(c, row);
    c->b[c->rows] = dot(row, c->D, c->nv) - c->phi[k];
    c->point_of_row[c->rows++] = k;
  }
}

static double merit(const kg_correction *c, const double *D, double mu)
{
  return 0.5 * metric2(c, D) + mu * c->sum_depth;
}

/* share of the way from D to the goal that keeps every joint and the root within STEP_MAX */
static double step_limit(const kg_correction *c)
{
  double largest = STEP_MAX;
  for (int i = 0; i < c->nv; i += 3) {
    largest = fmax(largest, kg_vec3_norm(kg_vec3_sub(kg_load3(c->goal + i), kg_load3(c->D + i))));
  }
  return STEP_MAX / largest;
}

/* Moves D towards the goal until the merit falls; false, D untouched, when it does not. */
static bool step_to_goal(kg_correction *c, double mu)
{
  const double before = merit(c, c->D, mu);
  const double predicted = fmax(before - 0.5 * metric2(c, c->goal), 0.0);
  double alpha = step_limit(c);
  for (int halving = 0; halving <= SQP_HALVINGS; halving++, alpha *= 0.5) {
    for (int i = 0; i < c->nv; i++) {
      c->D_trial[i] = c->D[i] + alpha * (c->goal[i] - c->D[i]);
    }
    go_to(c, c->D_trial);
    if (merit(c, c->D_trial, mu) <= before - 1e-4 * alpha * predicted) {
      memcpy(c->D, c->D_trial, (size_t)c->nv * sizeof *c->D);
      return true;
    }
  }
  return false;
}

static double change2(kg_correction *c)
{
  for (int i = 0; i < c->nv; i++) {
    c->D_trial[i] = c->goal[i] - c->D[i];
  }
  return metric2(c, c->D_trial);
}

/* From D (sampled) towards the least move that satisfies Phi >= 0. D becomes the smallest move met
 * that leaves d_pen within the tolerance; false when there was none. */
static bool second_order(kg_correction *c, int *iterations)
{
  double mu = 0.0, least = INFINITY;
  for (int step = 0; step <= SQP_STEPS; step++) {
    if (c->d_pen <= c->def.tolerance && metric2(c, c->D) < least) {
      least = metric2(c, c->D);
      memcpy(c->D_best, c->D, (size_t)c->nv * sizeof *c->D);
    }
    linearise(c);
    least_move_solve(&c->solver, c->chol, c->G, c->b, c->rows, ROW_TOLERANCE, c->goal, c->lambda);
    for (int r = 0; r < c->rows; r++) {
      c->pushed[c->point_of_row[r]] = c->lambda[r] > 0.0;
      mu = fmax(mu, 1.5 * c->lambda[r]);
    }
    const bool settled = change2(c) <= STEP_SHARE * STEP_SHARE * metric2(c, c->goal);
    if ((settled && c->d_pen <= c->def.tolerance) || step == SQP_STEPS) break;
    if (!step_to_goal(c, mu)) break;
    ++*iterations;
  }
  if (!(least < INFINITY)) return false;
  memcpy(c->D, c->D_best, (size_t)c->nv * sizeof *c->D);
  return true;
}

/* ---- gradient -----------------------------------------------------------------------------------*/

/* slope' H slope with the Gauss-Newton Hessian of L_coll, 2 sum (n_k' J_k slope)^2 over the points
 * inside: from the velocities the points have when the pose moves at the rate `slope` */
static double curvature(kg_correction *c)
{
  const kg_body *body = c->def.body;
  for (int i = 0; i < body->segment_count; i++) {
    const int parent = body->segments[i].parent;
    c->w[i] = kg_mat3_mul_vec(c->R[i], kg_load3(c->slope + 3 + 3 * i));
    c->p_dot[i] = kg_load3(c->slope);
    if (parent >= 0) {
      c->w[i] = kg_vec3_add(c->w[i], c->w[parent]);
      c->p_dot[i] = kg_vec3_add(c->p_dot[parent],
                                kg_vec3_cross(c->w[parent], kg_vec3_sub(c->p[i], c->p[parent])));
    }
  }
  double sum = 0.0;
  for (int k = 0; k < c->point_count; k++) {
    if (!(c->phi[k] < 0.0)) continue;
    const int i = body->points[k].segment;
    const kg_vec3 rate =
      kg_vec3_add(c->p_dot[i], kg_vec3_cross(c->w[i], kg_vec3_sub(c->x[k], c->p[i])));
    const double phi_rate = kg_vec3_dot(c->normal[k], rate);
    sum += 2.0 * phi_rate * phi_rate;
  }
  return sum;
}

/* One step of (11) from q_now (sampled). The gradient is taken in the metric M / m, so that a
 * rotation is weighed against a translation by what it moves. eta is cut to the minimum of the
 * Gauss-Newton model and halved until L_coll falls by half of what the model predicts. False when
 * it does not fall. */
static bool gradient_step(kg_correction *c)
{
  const double L = c->L_coll;
  collision_gradient(c, c->gradient);
  memcpy(c->slope, c->gradient, (size_t)c->nv * sizeof *c->slope);
  kg_dense_cholesky_solve(c->chol, c->nv, c->slope, 1);
  double turn = STEP_MAX;
  for (int i = 0; i < c->nv; i++) {
    c->slope[i] *= c->def.body->mass;
  }
  for (int i = 0; i < c->nv; i += 3) {
    turn = fmax(turn, c->def.eta * kg_vec3_norm(kg_load3(c->slope + i)));
  }
  const double fall = dot(c->gradient, c->slope, c->nv);
  const double bend = curvature(c);
  if (!(fall > 0.0 && bend > 0.0)) return false;
  double eta = fmin(c->def.eta * STEP_MAX / turn, fall / bend);
  memcpy(c->q_from, c->q_now, (size_t)c->def.body->nq * sizeof *c->q_from);
  for (int halving = 0; halving < 30; halving++, eta *= 0.5) {
    for (int i = 0; i < c->nv; i++) {
      c->D_trial[i] = -eta * c->slope[i];
    }
    kg_body_integrate(c->def.body, c->q_now, c->q_from, c->D_trial);
    sample(c, c->q_now);
    if (c->L_coll <= L - 0.5 * (eta * fall - 0.5 * eta * eta * bend)) return true;
  }
  memcpy(c->q_now, c->q_from, (size_t)c->def.body->nq * sizeof *c->q_from);
  sample(c, c->q_now);
  return false;
}

static void descend(kg_correction *c, int *iterations)
{
  while (c->d_pen > 0.9 * c->def.tolerance && *iterations < c->def.max_iterations) {
    if (!gradient_step(c)) return;
    ++*iterations;
  }
}

/* ---- the way out when neither works ---------------------------------------------------------------*/

/* How far the body must go along u to be free; more than `limit`: INFINITY. Phi grows by no more
 * than the way gone, so a step of d_pen never passes the first free place. */
static double way_out(kg_correction *c, kg_vec3 u, double limit)
{
  double way = 0.0;
  for (int step = 0; step < ESCAPE_STEPS && way < limit; step++) {
    measure(c, kg_vec3_scale(way, u));
    if (c->d_pen <= 0.9 * c->def.tolerance) return way;
    way += c->d_pen;
  }
  return INFINITY;
}

/* Carries the pose q_now (sampled) as a whole out of the scene by the shortest of 26 directions. */
static void escape(kg_correction *c, int *iterations)
{
  const double limit = 1e3; /* m */
  kg_vec3 best = {0.0, 0.0, 0.0};
  double least = limit;
  for (int k = 0; k < 27; k++) {
    const kg_vec3 u = kg_vec3_normalized(
      kg_vec3_make(k % 3 - 1.0, (double)(k / 3 % 3) - 1.0, (double)(k / 9) - 1.0));
    const double way = k == 13 ? INFINITY : way_out(c, u, least);
    if (way < least) {
      least = way;
      best = kg_vec3_scale(way, u);
    }
    ++*iterations;
  }
  kg_store3(c->q_now, kg_vec3_add(kg_load3(c->q_now), best));
  sample(c, c->q_now);
}

/* ---- the correction -----------------------------------------------------------------------------*/

/* v + M^-1 G' lambda: the smallest change in the mass metric after which no point in contact moves
 * into the surface. Returns the number of those points. */
static int stop_inward_motion(kg_correction *c, const double *q, double *v)
{
  c->rows = 0;
  int touching = 0;
  for (int k = 0; k < c->point_count; k++) {
    if (!(c->phi[k] <= c->def.tolerance || (c->pushed[k] && c->phi[k] <= GAP_MAX))) continue;
    touching++;
    if (!v || c->rows == c->solver.rows_max) continue;
    double *row = c->G + (size_t)c->rows * (size_t)c->nv;
    point_row(c, k, row);
    c->b[c->rows++] = -dot(row, v, c->nv);
  }
  if (v && c->rows > 0) {
    factor_mass(c, q);
    least_move_solve(&c->solver, c->chol, c->G, c->b, c->rows, ROW_TOLERANCE, c->goal, c->lambda);
    for (int i = 0; i < c->nv; i++) {
      v[i] += c->goal[i];
    }
  }
  return touching;
}

/* A free pose that touches nothing is not the nearest: on the way from q0, which is inside, to q0 (+)
 * D there is one that does. Bisection; the move gets shorter. */
static void pull_back(kg_correction *c)
{
  double inside = 0.0, free = 1.0;
  go_to(c, c->D);
  for (int i = 0; i < 60 && c->lowest > 0.1 * GAP_MAX; i++) {
    const double middle = 0.5 * (inside + free);
    for (int k = 0; k < c->nv; k++) {
      c->D_trial[k] = middle * c->D[k];
    }
    go_to(c, c->D_trial);
    if (c->d_pen <= c->def.tolerance) {
      free = middle;
    } else {
      inside = middle;
      c->lowest = INFINITY; /* go on until a free pose is near enough */
    }
  }
  for (int k = 0; k < c->nv; k++) {
    c->D[k] *= free;
  }
  go_to(c, c->D);
}

/* Second-order steps from D (sampled), and again from where a failed line search left a gap. */
static bool settle(kg_correction *c, int *iterations)
{
  bool free = second_order(c, iterations);
  for (int round = 0; free && round < 2; round++) {
    go_to(c, c->D);
    if (c->lowest <= GAP_MAX) break;
    pull_back(c);
    free = second_order(c, iterations);
  }
  if (free) {
    pull_back(c);
  }
  return free;
}

/* D from q0 to a pose outside the scene, as near as the methods find it */
static void find_move(kg_correction *c, int *iterations)
{
  const size_t bytes = (size_t)c->nv * sizeof *c->D;
  memset(c->D, 0, bytes);
  memset(c->pushed, 0, (size_t)c->point_count * sizeof *c->pushed);
  if (c->def.method == KG_CORRECTION_GRADIENT) {
    descend(c, iterations);
    kg_body_difference(c->def.body, c->D, c->q_now, c->q0);
    go_to(c, c->D);
  }
  /* the gradient's way out is not the shortest: the second-order steps also pull it back */
  if (settle(c, iterations)) return;
  memset(c->D, 0, bytes);
  go_to(c, c->D);
  descend(c, iterations);
  if (c->d_pen > 0.9 * c->def.tolerance) {
    escape(c, iterations);
  }
  kg_body_difference(c->def.body, c->D, c->q_now, c->q0);
  go_to(c, c->D);
  settle(c, iterations);
}

kg_correction_report kg_correction_apply(kg_correction *correction, double *q, double *v,
                                         double *moved)
{
  KG_ASSERT(correction && q);
  kg_correction *c = correction;
  const size_t nq_bytes = (size_t)c->def.body->nq * sizeof *q;
  if (moved) {
    memset(moved, 0, (size_t)c->nv * sizeof *moved);
  }
  sample(c, q);
  kg_correction_report report = {.d_pen_before = c->d_pen,
                                 .d_pen_after = c->d_pen,
                                 .lowest = c->lowest,
                                 .converged = c->d_pen <= c->def.tolerance};
  if (!(c->d_pen > c->def.tolerance)) return report; /* nothing to do, or NaN */
  memcpy(c->q0, q, nq_bytes);
  memcpy(c->q_now, q, nq_bytes);
  factor_mass(c, c->q0);
  find_move(c, &report.iterations);
  go_to(c, c->D);
  if (!(c->d_pen < report.d_pen_before)) return report; /* no better: leave the pose alone */
  memcpy(q, c->q_now, nq_bytes);
  if (moved) {
    memcpy(moved, c->D, (size_t)c->nv * sizeof *moved);
  }
  report.converged = c->d_pen <= c->def.tolerance;
  report.d_pen_after = c->d_pen;
  report.lowest = c->lowest;
  report.displacement = sqrt(metric2(c, c->D));
  report.contact_count = stop_inward_motion(c, q, v);
  return report;
}
