/* Penetration of a pose and its correction: the calls, and what is tried in which order. The contract
 * is in kinegrad/correction.h, the derivation in docs/theory/sdf.md, the parts in
 * physics/correction.h. */
#include "physics/correction.h"

#include "kinegrad/dense.h"

#include <string.h>

enum { ESCAPE_STEPS = 400 };

kg_correction_def kg_correction_default_def(const kg_body *body, const kg_scene *scene)
{
  return (kg_correction_def){
    .body = body,
    .scene = scene,
    .method = KG_CORRECTION_SECOND_ORDER,
    .tolerance = 1e-5,
    .eta = 0.1,
    .max_iterations = 200,
    .starts = 1,
  };
}

static void allocate(kg_correction *c, kg_arena *arena)
{
  const kg_body *body = c->def.body;
  const int n = body->segment_count, nv = body->nv;
  const size_t square = (size_t)nv * (size_t)nv;
  const int keys = c->key_count;
  const int rows = keys < CORRECTION_ROWS_MAX ? keys : CORRECTION_ROWS_MAX;
  c->p = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->R = KG_ARENA_ARRAY(arena, kg_mat3, n);
  c->Jr = KG_ARENA_ARRAY(arena, kg_mat3, n);
  c->w = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->p_dot = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->f = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->moment = KG_ARENA_ARRAY(arena, kg_vec3, n);
  c->virial = KG_ARENA_ARRAY(arena, kg_mat3, n);
  c->multiplier = KG_ARENA_ARRAY(arena, double, keys);
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
  c->touch_of_row = KG_ARENA_ARRAY(arena, int, rows);
  c->G = KG_ARENA_ARRAY(arena, double, (size_t)rows *(size_t)nv);
  c->C = KG_ARENA_ARRAY(arena, double, square);
  c->W = KG_ARENA_ARRAY(arena, double, square);
  c->center = KG_ARENA_ARRAY(arena, double, nv);
  c->b = KG_ARENA_ARRAY(arena, double, rows);
  c->yield = KG_ARENA_ARRAY(arena, double, rows);
  c->lambda = KG_ARENA_ARRAY(arena, double, rows);
  correction_pose_init(c, arena);
  least_move_init(&c->solver, nv, rows, arena);
  correction_starts_init(c, arena);
  correction_vjp_init(c, arena);
}

kg_status kg_correction_create(kg_correction **correction, const kg_correction_def *def)
{
  KG_ASSERT(correction && def && def->body && def->scene && def->tolerance > 0.0);
  KG_ASSERT(def->starts >= 1);
  *correction = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_correction *c = KG_ARENA_ARRAY(&arena, kg_correction, 1);
  if (!c) return KG_ERR_NO_MEMORY;
  c->def = *def;
  c->nv = def->body->nv;
  c->key_count = (def->self ? 2 : 1) * def->body->point_count;
  allocate(c, &arena);
  c->arena = arena;
  kg_status status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : KG_OK;
  if (status == KG_OK && def->self) {
    status = kg_self_create(&c->self, def->body, NULL, def->allocator);
  }
  if (status == KG_OK) status = kg_dynamics_create(&c->dynamics, def->body, def->allocator);
  if (status != KG_OK) {
    kg_self_destroy(c->self);
    kg_arena_release(&arena);
    return status;
  }
  kg_dynamics_set_gravity(c->dynamics, kg_vec3_make(0.0, 0.0, 0.0)); /* its inverse: M a alone */
  *correction = c;
  return KG_OK;
}

void kg_correction_destroy(kg_correction *correction)
{
  if (correction) {
    kg_dynamics_destroy(correction->dynamics);
    kg_self_destroy(correction->self);
    kg_arena arena = correction->arena; /* the object lives in its own arena */
    kg_arena_release(&arena);
  }
}

double kg_penetration(kg_correction *correction, const double *q, double *L_coll, double *gradient)
{
  KG_ASSERT(correction && q);
  correction_sample(correction, q);
  if (L_coll) {
    *L_coll = correction->L_coll;
  }
  if (gradient) {
    correction_loss_gradient(correction, gradient);
  }
  return correction->d_pen;
}

/* M and its factor at q. A body with massless ends has a singular M: it gets a small share more. */
void correction_factor_mass(kg_correction *c, const double *q)
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

/* ---- the way out when neither works ---------------------------------------------------------------*/

/* How far the body must go along u to be free; more than `limit`: INFINITY. Phi grows by no more
 * than the way gone, so a step of d_pen never passes the first free place. */
static double way_out(kg_correction *c, kg_vec3 u, double limit)
{
  double way = 0.0;
  for (int step = 0; step < ESCAPE_STEPS && way < limit; step++) {
    correction_measure(c, kg_vec3_scale(way, u));
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
  correction_sample(c, c->q_now);
}

/* ---- the correction -----------------------------------------------------------------------------*/

/* v + M^-1 G' lambda: the smallest change in the mass metric after which no point in contact moves
 * into the surface. Returns the number of those points. */
static int stop_inward_motion(kg_correction *c, const double *q, double *v)
{
  c->rows = 0;
  int touching = 0;
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    const double reach = c->multiplier[t->key] > 0.0 ? CORRECTION_GAP_MAX : c->def.tolerance;
    if (!(t->at.distance <= reach)) continue;
    touching++;
    if (!v || c->rows == c->solver.rows_max) continue;
    double *row = c->G + (size_t)c->rows * (size_t)c->nv;
    correction_row(c, t, row);
    c->b[c->rows++] = -correction_dot(row, v, c->nv);
  }
  if (v && c->rows > 0) {
    correction_factor_mass(c, q);
    least_move_solve(&c->solver, c->chol, c->G, c->b, c->rows, CORRECTION_ROW_TOLERANCE, c->goal,
                     c->lambda);
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
  correction_go_to(c, c->D);
  for (int i = 0; i < 60 && c->lowest > 0.1 * CORRECTION_GAP_MAX; i++) {
    const double middle = 0.5 * (inside + free);
    for (int k = 0; k < c->nv; k++) {
      c->D_trial[k] = middle * c->D[k];
    }
    correction_go_to(c, c->D_trial);
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
  correction_go_to(c, c->D);
}

bool correction_settle(kg_correction *c, double limit, int *iterations)
{
  bool free = correction_least_move(c, limit, iterations);
  for (int round = 0; free && round < 2; round++) {
    correction_go_to(c, c->D);
    if (c->lowest <= CORRECTION_GAP_MAX) break;
    pull_back(c);
    free = correction_least_move(c, limit, iterations);
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
  if (c->def.method == KG_CORRECTION_GRADIENT) {
    correction_descend(c, iterations);
    kg_body_difference(c->def.body, c->D, c->q_now, c->q0);
    correction_go_to(c, c->D);
  }
  /* the gradient's way out is not the shortest: the second-order steps also pull it back */
  if (correction_settle(c, INFINITY, iterations)) return;
  memset(c->D, 0, bytes);
  correction_go_to(c, c->D);
  /* between two segments of the body the gradients hold each other; the second order sees past them */
  if (c->self && c->def.method == KG_CORRECTION_GRADIENT) {
    memset(c->multiplier, 0, (size_t)c->key_count * sizeof *c->multiplier);
    if (correction_settle(c, INFINITY, iterations)) return;
    memset(c->D, 0, bytes);
    correction_go_to(c, c->D);
  }
  correction_descend(c, iterations);
  if (c->d_pen > 0.9 * c->def.tolerance) {
    escape(c, iterations);
  }
  kg_body_difference(c->def.body, c->D, c->q_now, c->q0);
  correction_go_to(c, c->D);
  (void)correction_settle(c, INFINITY, iterations);
}

bool correction_begin(kg_correction *c, const double *q)
{
  const size_t nq_bytes = (size_t)c->def.body->nq * sizeof *q;
  c->near = CORRECTION_NEAR;
  correction_sample(c, q);
  if (!(c->d_pen > c->def.tolerance)) return false;
  c->near += CORRECTION_NEAR_SHARE * c->d_pen;
  memcpy(c->q0, q, nq_bytes);
  memcpy(c->q_now, q, nq_bytes);
  correction_sample(c, q);
  correction_factor_mass(c, c->q0);
  memset(c->D, 0, (size_t)c->nv * sizeof *c->D);
  memset(c->multiplier, 0, (size_t)c->key_count * sizeof *c->multiplier);
  return true;
}

kg_correction_report kg_correction_apply(kg_correction *correction, double *q, double *v,
                                         double *moved)
{
  KG_ASSERT(correction && q);
  kg_correction *c = correction;
  if (moved) {
    memset(moved, 0, (size_t)c->nv * sizeof *moved);
  }
  const bool is_inside = correction_begin(c, q);
  kg_correction_report report = {.d_pen_before = c->d_pen,
                                 .d_pen_after = c->d_pen,
                                 .lowest = c->lowest,
                                 .kkt_residual = NAN,
                                 .converged = c->d_pen <= c->def.tolerance};
  if (!is_inside) return report;
  report.starts = 1;
  find_move(c, &report.iterations);
  report.iterations_of_answer = report.iterations;
  if (c->def.method == KG_CORRECTION_SECOND_ORDER && c->def.starts > 1) {
    correction_try_starts(c, &report);
  }
  if (c->def.kkt_tolerance > 0.0) {
    int iterations = 0;
    report.kkt_residual = correction_polish(c, &iterations);
    report.iterations += iterations;
    report.iterations_of_answer += iterations;
  }
  correction_go_to(c, c->D);
  if (!(c->d_pen < report.d_pen_before)) return report; /* no better: leave the pose alone */
  memcpy(q, c->q_now, (size_t)c->def.body->nq * sizeof *q);
  if (moved) {
    memcpy(moved, c->D, (size_t)c->nv * sizeof *moved);
  }
  report.converged = c->d_pen <= c->def.tolerance;
  report.d_pen_after = c->d_pen;
  report.lowest = c->lowest;
  report.displacement = sqrt(correction_metric(c, c->D, c->D));
  report.contact_count = stop_inward_motion(c, q, v);
  return report;
}

double kg_correction_step(kg_correction *correction, double *q)
{
  KG_ASSERT(correction && q);
  kg_correction *c = correction;
  if (!correction_begin(c, q)) return c->d_pen;
  if (c->def.method == KG_CORRECTION_GRADIENT) {
    (void)correction_gradient_step(c);
  } else {
    correction_least_step(c);
    correction_go_to(c, c->D);
  }
  memcpy(q, c->q_now, (size_t)c->def.body->nq * sizeof *q);
  return c->d_pen;
}
