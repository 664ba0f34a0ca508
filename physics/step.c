/* One backward Euler step of a body with contact: Newton's method and sub-steps.
 *
 * Every iteration linearises the body and solves contact with the linear body on its own
 * (small_problem.c). Equation numbers: docs/theory/dynamics.md for (1) to (19),
 * docs/theory/contact.md where "contact" is written before the number. */
#include "physics/small_problem.h"

#include <string.h>

enum {
  HALVINGS = 30,
  DAMPINGS = 5,
  MOST_STALLED = 6, /* iterations in a row without a new least residual    */
  MOST_BOUNDED = 3  /* iterations that only bounded friction gave an answer */
};
static const double ARMIJO = 1e-4;
static const double FIRST_DAMPING = 0.5;
static const double CHORD_RATE = 10.0; /* in contact, over the last iteration's */
static const double MOST_TURN = 0.4;   /* rad, of a joint within an iteration */

kg_step_def kg_step_default_def(const kg_body *body)
{
  const kg_step_def def = {.body = body,
                           .contact = kg_contact_default_params(),
                           .gravity = {0.0, -9.8, 0.0},
                           .tolerance = 1e-8,
                           .max_iterations = 50,
                           .max_substep_levels = 6};
  return def;
}

static kg_status create_parts(kg_step *s)
{
  const kg_step_def *def = &s->def;
  const kg_status status = kg_dynamics_create(&s->dynamics, def->body, def->allocator);
  if (status == KG_OK) {
    kg_dynamics_set_gravity(s->dynamics, def->gravity);
  }
  return status;
}

kg_status kg_step_create(kg_step **step, const kg_step_def *def)
{
  KG_ASSERT(def->body && def->tolerance > 0.0 && def->max_substep_levels >= 0);
  KG_ASSERT(kg_contact_params_are_valid(&def->contact));
  *step = NULL;
  const kg_body *body = def->body;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_step *s = KG_ARENA_ARRAY(&arena, kg_step, 1);
  kg_step made = {.def = *def, .contact = def->contact};
  near_points_init(&made.points, body, &arena);
  made.contacts = KG_ARENA_ARRAY(&arena, kg_step_contact, body->point_count);
  made.turns = KG_ARENA_ARRAY(&arena, kg_mat3, body->segment_count + 1);
  made.scale = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.q_end = KG_ARENA_ARRAY(&arena, double, body->nq);
  made.a = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.G = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.d = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x_best = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x_trial = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.v_end = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.q_sub = KG_ARENA_ARRAY(&arena, double, body->nq);
  made.v_sub = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.small = kg_small_create(body, &arena);
  const int states = (1 << def->max_substep_levels) + 1;
  made.trace_q = KG_ARENA_ARRAY(&arena, double, (size_t)states *(size_t)body->nq);
  made.trace_v = KG_ARENA_ARRAY(&arena, double, (size_t)states *(size_t)body->nv);
  made.returned = KG_ARENA_ARRAY(&arena, double, KG_STEP_RETURNED * body->nv);
  kg_status status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : create_parts(&made);
  if (status == KG_OK) {
    kg_tree_matrix_init(&made.J, &made.dynamics->tree, &arena);
    status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : KG_OK;
  }
  if (status != KG_OK) {
    kg_dynamics_destroy(made.dynamics);
    kg_arena_release(&arena);
    return status;
  }
  made.arena = arena;
  *s = made;
  *step = s;
  return KG_OK;
}

void kg_step_destroy(kg_step *step)
{
  if (step) {
    kg_dynamics_destroy(step->dynamics);
    kg_arena arena = step->arena; /* the arena holds the object itself */
    kg_arena_release(&arena);
  }
}

/* ---- Newton's method --------------------------------------------------------------------------*/

/* G and the residual (19) at x; infinite where it is not a number */
static double residual_at(kg_step *s, const double *x)
{
  (void)kg_step_evaluate(s->G, x, s);
  const double m = kg_step_merit(s, s->G);
  return isfinite(m) ? m : INFINITY;
}

/* The share of d that turns no joint by more than MOST_TURN: what a linear body says beyond means
 * little. */
static double longest_share(const kg_step *s)
{
  double turn = 0.0;
  for (int k = 3; k < s->def.body->nv; k += 3) {
    turn = fmax(turn, s->dt * kg_vec3_norm(kg_vec3_make(s->d[k], s->d[k + 1], s->d[k + 2])));
  }
  return turn > MOST_TURN ? MOST_TURN / turn : 1.0;
}

/* x += alpha d. Where nothing can touch, alpha is the largest of 1, 1/2, ... that lowers the residual
 * enough [NW, algorithm 11.4]; with contact alpha = 1: the small problem has its own line search, and
 * what the residual does between two answers of a law this stiff tells nothing. Returns the residual;
 * infinite, and x untouched, where no step is good. */
static double move(kg_step *s, double *x, double m, kg_step_report *report)
{
  const int nv = s->def.body->nv;
  double alpha = longest_share(s);
  for (int halving = 0; halving <= HALVINGS; halving++, alpha *= 0.5) {
    report->cuts += halving > 0;
    for (int k = 0; k < nv; k++) {
      s->x_trial[k] = x[k] + alpha * s->d[k];
    }
    const double m_trial = residual_at(s, s->x_trial);
    const bool good =
      s->small->slots > 0 || m_trial <= (1.0 - ARMIJO * alpha) * m || m_trial <= s->def.tolerance;
    if (isfinite(m_trial) && good) {
      memcpy(x, s->x_trial, (size_t)nv * sizeof *x);
      return m_trial;
    }
  }
  return INFINITY;
}

/* s->d at x. Where the linear body would turn a joint too far or contact with it has no answer, it is
 * made heavier until neither happens; the next iteration starts with less. False when contact was
 * solved with bounded friction only, or not at all (d is zero then). */
static bool find_direction(kg_step *s, const double *x, double *damping, kg_step_report *report)
{
  kg_small_report small = {0};
  bool found = false;
  for (int trial = 0; trial < DAMPINGS; trial++) {
    found = kg_small_direction(s, s->d, x, *damping, &small);
    report->iterations++;
    if (s->small->slots == 0) break; /* in the air the step is cut instead */
    if (found && small.exact && longest_share(s) >= 1.0) break;
    *damping = fmax(FIRST_DAMPING, 4.0 * *damping);
  }
  *damping = *damping > FIRST_DAMPING ? *damping / 8.0 : 0.0;
  report->contact_iterations += small.iterations;
  report->cuts += small.cuts;
  report->used_fallback = report->used_fallback || small.fallback;
  if (!found) {
    memset(s->d, 0, (size_t)s->def.body->nv * sizeof *s->d);
  }
  return found && small.exact;
}

/* More steps with the factors of the last Jacobian, as long as they promise to reach the tolerance in
 * a few: in the air such a step costs a fifth of one with a new Jacobian, in contact a third. `rate`:
 * what one of them is thought to leave of the residual. Returns the residual. */
static double refine(kg_step *s, double *x, double m, double rate, kg_step_report *report)
{
  const int nv = s->def.body->nv;
  while (m > s->def.tolerance && m * rate * rate * rate <= s->def.tolerance) {
    kg_small_report small = {0};
    const bool found = kg_small_chord(s, s->d, x, &small);
    report->chord_steps++;
    report->contact_iterations += small.iterations;
    report->cuts += small.cuts;
    for (int k = 0; k < nv; k++) {
      s->x_trial[k] = x[k] + s->d[k];
    }
    const double m_trial = found ? residual_at(s, s->x_trial) : INFINITY;
    rate = m_trial / m;
    if (!(rate < 0.5)) { /* also when not a number */
      kg_step_ensure_evaluated(s, x);
      return m;
    }
    memcpy(x, s->x_trial, (size_t)nv * sizeof *x);
    m = m_trial;
  }
  return m;
}

/* Newton from x, which ends as the iterate with the least residual; links and contacts are left there.
 * Returns that residual. */
static double iterate(kg_step *s, double *x, kg_step_report *report)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  double m = residual_at(s, x), best = INFINITY;
  double damping = 0.0;
  int stalled = 0, bounded = 0;
  for (int k = 0; isfinite(m); k++) {
    stalled = m < best ? 0 : stalled + 1;
    if (m < best) {
      best = m;
      memcpy(s->x_best, x, bytes);
    }
    if (m <= s->def.tolerance || k == s->def.max_iterations || stalled == MOST_STALLED) break;
    bounded += !find_direction(s, x, &damping, report);
    if (bounded > MOST_BOUNDED) break;
    const double before = m;
    m = move(s, x, m, report);
    if (damping == 0.0 && isfinite(m)) {
      m = refine(s, x, m, s->small->slots > 0 ? CHORD_RATE * m / before : 0.0, report);
    }
  }
  if (isfinite(best)) {
    memcpy(x, s->x_best, bytes);
  }
  kg_step_ensure_evaluated(s, x);
  return best;
}

/* The links at q, the scale of the residual and the forces to start from, before x is looked at: one
 * pose serves both. */
static void begin(kg_step *s)
{
  kg_step_set_scale(s);
  if (s->def.scene) {
    kg_small_begin(s);
  }
}

/* One step from (q, v) into (q_end, x); x: starting guess in. */
static bool solve_once(kg_step *s, const double *q, const double *v, double dt, double *x,
                       kg_step_report *report, double *worst)
{
  kg_step_set_problem(s, q, v, s->tau, dt);
  begin(s);
  const bool guessed = memcmp(x, v, (size_t)s->def.body->nv * sizeof *x) != 0;
  double m = iterate(s, x, report);
  if (!(m <= s->def.tolerance) && guessed) { /* a guess may be worse than none */
    memcpy(x, v, (size_t)s->def.body->nv * sizeof *x);
    begin(s);
    m = iterate(s, x, report);
  }
  *worst = fmax(*worst, m);
  return m <= s->def.tolerance;
}

/* ---- steps ------------------------------------------------------------------------------------*/

/* The state a sub-step starts from, or the last one ends at. */
static void keep_state(kg_step *s, int k)
{
  const kg_body *body = s->def.body;
  memcpy(s->trace_q + k * body->nq, s->q_sub, (size_t)body->nq * sizeof(double));
  memcpy(s->trace_v + k * body->nv, s->v_sub, (size_t)body->nv * sizeof(double));
}

/* 2^level sub-steps; q_end and v_sub hold the end. Gives up at the first failure unless `last`. */
static bool solve_divided(kg_step *s, const double *q, const double *v, double dt, int level,
                          bool last, kg_step_report *report)
{
  const kg_body *body = s->def.body;
  const int count = 1 << level;
  bool good = true;
  double worst = 0.0;
  memcpy(s->q_sub, q, (size_t)body->nq * sizeof *q);
  memcpy(s->v_sub, v, (size_t)body->nv * sizeof *v);
  keep_state(s, 0);
  for (int k = 0; k < count && (good || last); k++) {
    memcpy(s->x, s->v_sub, (size_t)body->nv * sizeof *v);
    good = solve_once(s, s->q_sub, s->v_sub, dt / count, s->x, report, &worst) && good;
    memcpy(s->q_sub, s->q_end, (size_t)body->nq * sizeof *q);
    memcpy(s->v_sub, s->x, (size_t)body->nv * sizeof *v);
    keep_state(s, k + 1);
  }
  report->substeps = count;
  report->residual = worst;
  return good;
}

bool kg_step_trace(kg_step *s, const double *q, const double *v, const double *tau, double dt,
                   int substeps)
{
  kg_step_report report = {.substeps = 1};
  int level = 0;
  while (1 << level < substeps) {
    level++;
  }
  KG_ASSERT(1 << level == substeps && level <= s->def.max_substep_levels);
  s->tau = tau;
  return solve_divided(s, q, v, dt, level, false, &report);
}

void kg_step_advance(kg_step *step, double *q_next, double *v_next, const double *q,
                     const double *v, const double *tau, double dt, bool use_guess,
                     kg_step_report *report)
{
  KG_ASSERT(dt > 0.0);
  kg_step *s = step;
  const kg_body *body = s->def.body;
  const size_t v_bytes = (size_t)body->nv * sizeof *v;
  kg_step_report own = {.substeps = 1};
  s->tau = tau;
  memcpy(s->x, use_guess ? v_next : v, v_bytes);
  own.converged = solve_once(s, q, v, dt, s->x, &own, &own.residual);
  for (int level = 1; level <= s->def.max_substep_levels && !own.converged; level++) {
    const bool last = level == s->def.max_substep_levels;
    own.converged = solve_divided(s, q, v, dt, level, last, &own);
  }
  memcpy(v_next, s->x, v_bytes);
  memcpy(q_next, s->q_end, (size_t)body->nq * sizeof *q);
  for (int k = 0; k < 3; k++) { /* in the air no residual depends on the place */
    own.converged = own.converged && isfinite(q_next[k]);
  }
  own.contact_count = s->contact_count;
  own.contacts = s->contacts;
  if (report) {
    *report = own;
  }
}

void kg_step_residual(kg_step *step, double *G, double *dG_dv_next, const double *v_next,
                      const double *q, const double *v, const double *tau, double dt,
                      kg_step_report *report)
{
  KG_ASSERT(dt > 0.0);
  kg_step *s = step;
  kg_step_set_problem(s, q, v, tau, dt);
  if (report) {
    kg_step_set_scale(s);
  }
  (void)kg_step_evaluate(G, v_next, s);
  if (dG_dv_next) {
    kg_step_linearize(s);
    kg_tree_to_dense(&s->dynamics->tree, &s->J, dG_dv_next);
  }
  if (report) {
    *report = (kg_step_report){.substeps = 1,
                               .residual = kg_step_merit(s, G),
                               .contact_count = s->contact_count,
                               .contacts = s->contacts};
    report->converged = report->residual <= s->def.tolerance;
  }
}
