/* The least move out of a scene by sequential quadratic programming; symbols in correction.h.
 *
 *   min 1/2 D' M D  s.t.  Phi(q0 (+) D) >= 0                                             (24)
 *
 * linearised at the current D, with the Hessian of the Lagrangian W = M - sum lambda Hess Phi as far
 * as it is positive definite, a step controlled by the l1 merit function
 *   1/2 D' M D + mu sum max(-Phi, 0),   mu > max multiplier              [NW] section 18.5, (18.27)
 * [NW] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006. */
#include "physics/correction.h"

#include "kinegrad/dense.h"

#include <string.h>

enum { STEPS = 40, HALVINGS = 8, POLISH_STEPS = 30, PATIENCE = 2 };

/* Done when a step changes the move by less than this share, */
#define STEP_SHARE 1e-2
/* ... or when the model promises to shorten it by no more than this share. */
#define GAIN_SHARE 5e-3
/* The curvature of the constraints is given up below this share. */
#define LEAST_CURVATURE 0.1
/* Weight of active rows added to W, over that of M in their direction. */
#define ROW_WEIGHT 10.0

/* ---- the model ---------------------------------------------------------------------------------*/

static int count_below(const kg_correction *c, double phi)
{
  int count = 0;
  for (int k = 0; k < c->touch_count; k++) {
    count += c->touches[k].at.distance < phi;
  }
  return count;
}

/* Points below the returned distance take part: those inside and near, the deepest when too many. */
static double nearness(const kg_correction *c)
{
  double high = c->d_pen + c->near;
  if (count_below(c, high) <= CORRECTION_ROWS_MAX) return high;
  double low = c->lowest;
  for (int i = 0; i < 50; i++) {
    const double middle = 0.5 * (low + high);
    if (count_below(c, middle) <= CORRECTION_ROWS_MAX) {
      low = middle;
    } else {
      high = middle;
    }
  }
  return low;
}

static double *row_at(const kg_correction *c, int r)
{
  return c->G + (size_t)r * (size_t)c->nv;
}

/* Rows G of the points that take part */
static void linearise(kg_correction *c)
{
  correction_tangents(c, c->D);
  const double near = nearness(c);
  c->rows = 0;
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    if (!(t->at.distance < near)) continue;
    correction_row(c, t, row_at(c, c->rows));
    correction_to_move(c, row_at(c, c->rows));
    c->touch_of_row[c->rows++] = k;
  }
}

static void set_model(kg_correction *c, double share)
{
  const size_t square = (size_t)c->nv * (size_t)c->nv;
  for (size_t i = 0; i < square; i++) {
    c->W[i] = c->M[i] - share * c->C[i];
  }
}

static bool carries(const kg_correction *c, int r)
{
  return c->multiplier[correction_touch_of(c, r)->key] > 0.0;
}

static void find_yields(kg_correction *c)
{
  for (int r = 0; r < c->rows; r++) {
    if (!carries(c, r)) continue;
    memcpy(c->center, row_at(c, r), (size_t)c->nv * sizeof *c->center);
    kg_dense_cholesky_solve(c->chol, c->nv, c->center, 1);
    c->yield[r] = correction_dot(row_at(c, r), c->center, c->nv);
  }
}

/* W += weight g g' / (g' M^-1 g) of the rows that carry a multiplier: nothing changes in a problem
 * that makes them equalities, and W need only be positive definite along them. */
static void stiffen_rows(kg_correction *c, double weight)
{
  for (int r = 0; r < c->rows; r++) {
    if (!carries(c, r)) continue;
    const double *g = row_at(c, r), scale = weight / c->yield[r];
    for (int i = 0; i < c->nv; i++) {
      for (int j = 0; j <= i; j++) {
        c->W[(size_t)i * (size_t)c->nv + (size_t)j] += scale * g[i] * g[j];
      }
    }
  }
}

/* W: factor of the Hessian of the Lagrangian, with as much of the constraints' curvature as leaves it
 * positive definite; with `stiff`, all of it wherever that is so along the active rows. Returns the
 * weight with which active rows were added. */
static double make_model(kg_correction *c, bool stiff)
{
  bool curved = false;
  for (int k = 0; k < c->key_count; k++) {
    curved = curved || c->multiplier[k] != 0.0;
  }
  if (curved) {
    correction_curvature(c, c->multiplier, c->C);
    set_model(c, 1.0);
    if (kg_dense_cholesky_factor(c->W, c->nv)) return 0.0;
    if (stiff) find_yields(c);
    for (double weight = ROW_WEIGHT; stiff && weight <= 1e4 * ROW_WEIGHT; weight *= 10.0) {
      set_model(c, 1.0);
      stiffen_rows(c, weight);
      if (kg_dense_cholesky_factor(c->W, c->nv)) return weight;
    }
    for (double share = 0.5; share > LEAST_CURVATURE; share *= 0.5) {
      set_model(c, share);
      if (kg_dense_cholesky_factor(c->W, c->nv)) return 0.0;
    }
  }
  memcpy(c->W, c->chol, (size_t)c->nv * (size_t)c->nv * sizeof *c->W);
  return 0.0;
}

/* What the stiff rows' own minimum, g (D' - D) = -phi, adds to the gradient of the model */
static void stiff_gradient(kg_correction *c, double weight, double *gradient)
{
  for (int r = 0; r < c->rows && weight > 0.0; r++) {
    if (!carries(c, r)) continue;
    const double *g = row_at(c, r);
    const double scale = weight * correction_touch_of(c, r)->at.distance / c->yield[r];
    for (int i = 0; i < c->nv; i++) {
      gradient[i] += scale * g[i];
    }
  }
}

/* goal: min over D' of 1/2 (D' - D)' W (D' - D) + (M D)' (D' - D)  s.t.  phi + G (D' - D) >= 0  (25) */
static void solve_model(kg_correction *c, double weight)
{
  correction_times_mass(c, c->D, c->center);
  stiff_gradient(c, weight, c->center);
  kg_dense_cholesky_solve(c->W, c->nv, c->center, 1);
  for (int r = 0; r < c->rows; r++) {
    c->b[r] =
      correction_dot(row_at(c, r), c->center, c->nv) - correction_touch_of(c, r)->at.distance;
  }
  least_move_solve(&c->solver, c->W, c->G, c->b, c->rows, CORRECTION_ROW_TOLERANCE, c->goal,
                   c->lambda);
  for (int i = 0; i < c->nv; i++) {
    c->goal[i] += c->D[i] - c->center[i];
  }
  memset(c->multiplier, 0, (size_t)c->key_count * sizeof *c->multiplier);
  for (int r = 0; r < c->rows; r++) {
    c->multiplier[correction_touch_of(c, r)->key] = c->lambda[r];
  }
}

/* ---- steps -------------------------------------------------------------------------------------*/

static double merit(const kg_correction *c, const double *D, double mu)
{
  return 0.5 * correction_metric(c, D, D) + mu * c->sum_depth;
}

/* share of the way from D to the goal that keeps every joint and the root within the limit */
static double step_limit(const kg_correction *c)
{
  double largest = CORRECTION_STEP_MAX;
  for (int i = 0; i < c->nv; i += 3) {
    largest = fmax(largest, kg_vec3_norm(kg_vec3_sub(kg_load3(c->goal + i), kg_load3(c->D + i))));
  }
  return CORRECTION_STEP_MAX / largest;
}

/* Moves D towards the goal until the merit falls; false, D untouched, when it does not. */
static bool step_to_goal(kg_correction *c, double mu)
{
  const double before = merit(c, c->D, mu);
  const double predicted = fmax(before - 0.5 * correction_metric(c, c->goal, c->goal), 0.0);
  double alpha = step_limit(c);
  for (int halving = 0; halving <= HALVINGS; halving++, alpha *= 0.5) {
    for (int i = 0; i < c->nv; i++) {
      c->D_trial[i] = c->D[i] + alpha * (c->goal[i] - c->D[i]);
    }
    correction_go_to(c, c->D_trial);
    if (merit(c, c->D_trial, mu) <= before - 1e-4 * alpha * predicted) {
      memcpy(c->D, c->D_trial, (size_t)c->nv * sizeof *c->D);
      return true;
    }
  }
  return false;
}

/* Nothing to gain from D, which is free: the step is short, or the model promises little:
 * -(M D)'d - 1/2 d'W d, d = goal - D. */
static bool is_settled(kg_correction *c)
{
  double *d = c->D_trial;
  for (int i = 0; i < c->nv; i++) {
    d[i] = c->goal[i] - c->D[i];
  }
  const double length2 = correction_metric(c, c->goal, c->goal);
  if (correction_metric(c, d, d) <= STEP_SHARE * STEP_SHARE * length2) return true;
  double bend = 0.0; /* |L'd|^2 */
  for (int j = 0; j < c->nv; j++) {
    double sum = 0.0;
    for (int i = j; i < c->nv; i++) {
      sum += c->W[(size_t)i * (size_t)c->nv + (size_t)j] * d[i];
    }
    bend += sum * sum;
  }
  return -correction_metric(c, c->D, d) - 0.5 * bend <=
         GAIN_SHARE * correction_metric(c, c->D, c->D);
}

/* goal from D, which is sampled; mu grows with the multipliers. */
static void find_goal(kg_correction *c, double *mu)
{
  linearise(c);
  (void)make_model(c, false);
  solve_model(c, 0.0);
  for (int r = 0; r < c->rows; r++) {
    *mu = fmax(*mu, 1.5 * c->lambda[r]);
  }
}

double correction_promise(kg_correction *c)
{
  double mu = 0.0;
  find_goal(c, &mu);
  return sqrt(correction_metric(c, c->goal, c->goal));
}

bool correction_least_move(kg_correction *c, double limit, int *iterations)
{
  double mu = 0.0, least = INFINITY;
  for (int step = 0; step <= STEPS; step++) {
    const double length2 = correction_metric(c, c->D, c->D);
    if (c->d_pen <= c->def.tolerance && length2 < least) {
      least = length2;
      memcpy(c->D_best, c->D, (size_t)c->nv * sizeof *c->D);
    }
    find_goal(c, &mu);
    /* the first goals can be far too long: the linearised distances of a turned limb mislead */
    if (step >= PATIENCE && correction_metric(c, c->goal, c->goal) > limit * limit) return false;
    if ((c->d_pen <= c->def.tolerance && is_settled(c)) || step == STEPS) break;
    if (!step_to_goal(c, mu)) break;
    ++*iterations;
  }
  if (!(least < INFINITY)) return false;
  memcpy(c->D, c->D_best, (size_t)c->nv * sizeof *c->D);
  return true;
}

void correction_least_step(kg_correction *c)
{
  double mu = 0.0;
  find_goal(c, &mu);
  (void)step_to_goal(c, mu);
}

/* ---- to the last digit -------------------------------------------------------------------------*/

/* |M D - G' lambda| in the norm of M^-1 and the distances of the rows that carry a multiplier or are
 * inside, at D, which is linearised. The sum is over touches of one kind of unit only: kg^1/2 m, a
 * distance counts with the root of the total mass. */
static double kkt_residual(kg_correction *c)
{
  double *r = c->center, miss = 0.0;
  correction_times_mass(c, c->D, r);
  for (int k = 0; k < c->rows; k++) {
    const touch *t = correction_touch_of(c, k);
    const double l = c->multiplier[t->key], phi = t->at.distance;
    miss = fmax(miss, l > 0.0 ? fabs(phi) : -phi);
    for (int i = 0; i < c->nv; i++) {
      r[i] -= l * row_at(c, k)[i];
    }
  }
  memcpy(c->goal, r, (size_t)c->nv * sizeof *r);
  kg_dense_cholesky_solve(c->chol, c->nv, c->goal, 1);
  return sqrt(fmax(0.0, correction_dot(r, c->goal, c->nv))) + sqrt(c->def.body->mass) * miss;
}

double correction_polish(kg_correction *c, int *iterations)
{
  double least = INFINITY;
  correction_go_to(c, c->D);
  const bool was_free = c->d_pen <= c->def.tolerance;
  memcpy(c->D_best, c->D, (size_t)c->nv * sizeof *c->D);
  for (int step = 0; step <= POLISH_STEPS; step++) {
    linearise(c);
    const double residual = step == 0 ? INFINITY : kkt_residual(c);
    const bool is_free = c->d_pen <= c->def.tolerance;
    if (residual < least && (is_free || !was_free)) {
      least = residual;
      memcpy(c->D_best, c->D, (size_t)c->nv * sizeof *c->D);
    }
    if (least <= c->def.kkt_tolerance || step == POLISH_STEPS) break;
    const double weight = make_model(c, true);
    solve_model(c, weight);
    const double alpha = step_limit(c);
    for (int i = 0; i < c->nv; i++) {
      c->D[i] += fmin(alpha, 1.0) * (c->goal[i] - c->D[i]);
    }
    correction_go_to(c, c->D);
    ++*iterations;
  }
  memcpy(c->D, c->D_best, (size_t)c->nv * sizeof *c->D);
  return least;
}
