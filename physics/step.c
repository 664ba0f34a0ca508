/* One backward Euler step of a body with contact: Newton, continuation, sub-steps.
 *
 * Equation numbers: docs/theory/dynamics.md for (1) to (19), docs/theory/contact.md where "contact"
 * is written before the number. */
#include "physics/step_problem.h"

#include <string.h>

/* What plain Newton does not solve at once is solved by continuation: the contact law is made soft,
 * solved roughly, and hardened to what it is (docs/theory/contact.md, section 4). */
static const double SOFT_FLOOR_SHARE = 0.9;
static const double SOFT_STICK = 1.0;     /* m/s                                             */
static const double ROUGH = 0.1;          /* kg^1/2 m/s; tolerance on the way                */
static const double FIRST_HARDNESS = 0.6; /* between soft (0) and hard (1)                   */
static const double FIRST_STRIDE = 0.4;   /* of hardness                                     */
static const double SMALLEST_STRIDE = 0.01;
enum { PLAIN_ITERATIONS = 2, ROUGH_ITERATIONS = 12 };

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
  kg_status status = kg_dynamics_create(&s->dynamics, def->body, def->allocator);
  if (status != KG_OK) return status;
  kg_dynamics_set_gravity(s->dynamics, def->gravity);
  kg_newton_def newton = kg_newton_default_def(def->body->nv);
  newton.tolerance = def->tolerance;
  newton.max_iterations = def->max_iterations;
  newton.allocator = def->allocator;
  status = kg_newton_create(&s->newton, &newton);
  if (status != KG_OK) return status;
  newton.max_iterations =
    def->max_iterations < PLAIN_ITERATIONS ? def->max_iterations : PLAIN_ITERATIONS;
  status = kg_newton_create(&s->plain, &newton);
  if (status != KG_OK) return status;
  newton.tolerance = fmax(ROUGH, def->tolerance);
  newton.max_iterations = ROUGH_ITERATIONS;
  return kg_newton_create(&s->rough, &newton);
}

kg_status kg_step_create(kg_step **step, const kg_step_def *def)
{
  KG_ASSERT(def->body && def->tolerance > 0.0 && def->max_substep_levels >= 0);
  *step = NULL;
  const kg_body *body = def->body;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_step *s = KG_ARENA_ARRAY(&arena, kg_step, 1);
  kg_step made = {.def = *def, .contact = def->contact};
  made.order = KG_ARENA_ARRAY(&arena, int, body->point_count);
  made.groups = KG_ARENA_ARRAY(&arena, point_group, body->segment_count);
  made.contacts = KG_ARENA_ARRAY(&arena, kg_step_contact, body->point_count);
  made.scale = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.q_end = KG_ARENA_ARRAY(&arena, double, body->nq);
  made.a = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.G = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x_start = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x_good = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.v_end = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.q_sub = KG_ARENA_ARRAY(&arena, double, body->nq);
  made.v_sub = KG_ARENA_ARRAY(&arena, double, body->nv);
  made.x = KG_ARENA_ARRAY(&arena, double, body->nv);
  const int states = (1 << def->max_substep_levels) + 1;
  made.trace_q = KG_ARENA_ARRAY(&arena, double, (size_t)states * (size_t)body->nq);
  made.trace_v = KG_ARENA_ARRAY(&arena, double, (size_t)states * (size_t)body->nv);
  made.returned = KG_ARENA_ARRAY(&arena, double, KG_STEP_RETURNED * body->nv);
  kg_status status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : create_parts(&made);
  if (status == KG_OK) {
    kg_tree_matrix_init(&made.J, &made.dynamics->tree, &arena);
    status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : KG_OK;
  }
  if (status != KG_OK) {
    kg_newton_destroy(made.rough);
    kg_newton_destroy(made.plain);
    kg_newton_destroy(made.newton);
    kg_dynamics_destroy(made.dynamics);
    kg_arena_release(&arena);
    return status;
  }
  kg_step_group_points(&made);
  made.arena = arena;
  *s = made;
  *step = s;
  return KG_OK;
}

void kg_step_destroy(kg_step *step)
{
  if (step) {
    kg_newton_destroy(step->rough);
    kg_newton_destroy(step->plain);
    kg_newton_destroy(step->newton);
    kg_dynamics_destroy(step->dynamics);
    kg_arena arena = step->arena; /* the arena holds the object itself */
    kg_arena_release(&arena);
  }
}
static bool direction(double *p, const double *x, const double *G, void *user)
{
  kg_step *s = user;
  const int nv = s->def.body->nv;
  kg_step_ensure_evaluated(s, x);
  kg_step_linearize(s);
  if (!kg_tree_factor(&s->dynamics->tree, &s->J)) {
    return false;
  }
  for (int k = 0; k < nv; k++) {
    p[k] = -G[k];
  }
  kg_tree_solve(&s->dynamics->tree, &s->J, p);
  return true;
}
/* ---- steps ------------------------------------------------------------------------------------*/

static void count_newton(kg_step_report *report, const kg_newton_report *r)
{
  report->iterations += r->iterations;
  report->cuts += r->cuts;
}

/* The law at a hardness between 0 and 1, in equal ratios. */
static void set_hardness(kg_step *s, double hardness)
{
  const kg_contact_params *hard = &s->def.contact;
  s->contact = *hard;
  if (hardness < 1.0) {
    const double floor = fmax(SOFT_FLOOR_SHARE, hard->floor_share);
    const double stick = fmax(SOFT_STICK, hard->stick);
    s->contact.floor_share = floor * pow(hard->floor_share / floor, hardness);
    s->contact.stick = stick * pow(hard->stick / stick, hardness);
  }
  s->evaluated = false; /* the links and contacts belong to the law before */
}

/* Newton at one hardness. */
static bool solve_at(kg_step *s, double hardness, double *x, kg_newton_report *r,
                     kg_step_report *report)
{
  set_hardness(s, hardness);
  *r = kg_newton_solve(hardness < 1.0 ? s->rough : s->newton, x, s->scale, kg_step_evaluate,
                       direction, s);
  count_newton(report, r);
  return r->stop == KG_NEWTON_CONVERGED;
}

/* From a softer law to the true one with strides as long as Newton can follow. x: starting guess in,
 * best point out. */
static kg_newton_report solve_hardening(kg_step *s, double *x, kg_step_report *report)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  kg_newton_report r;
  double done = FIRST_HARDNESS, stride = FIRST_STRIDE;
  bool started = solve_at(s, done, x, &r, report);
  if (!started) { /* as soft as it gets, and from a start that exists */
    memcpy(x, s->v, bytes);
    done = 0.0;
    started = solve_at(s, done, x, &r, report);
  }
  while (started && done < 1.0 && stride > SMALLEST_STRIDE) {
    memcpy(s->x_good, x, bytes);
    const double target = fmin(1.0, done + stride);
    if (solve_at(s, target, x, &r, report)) {
      done = target;
      stride *= 1.5;
    } else {
      stride *= 0.4;
      if (stride > SMALLEST_STRIDE) {
        memcpy(x, s->x_good, bytes);
      }
    }
  }
  set_hardness(s, 1.0);
  return r;
}

/* What is left of G under the true law, for a point found under a softer one. */
static double true_residual(kg_step *s, const double *x)
{
  (void)kg_step_evaluate(s->G, x, s);
  return kg_step_merit(s, s->G);
}

/* One plain step from (q, v) into (q_end, x); x: starting guess in. */
static bool solve_once(kg_step *s, const double *q, const double *v, double dt, double *x,
                       kg_step_report *report, double *worst)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  kg_step_set_problem(s, q, v, s->tau, dt);
  kg_step_set_scale(s);
  memcpy(s->x_start, x, bytes);
  kg_newton_report r = kg_newton_solve(s->def.scene ? s->plain : s->newton, x, s->scale,
                                       kg_step_evaluate, direction, s);
  count_newton(report, &r);
  if (r.stop == KG_NEWTON_MAX_ITERATIONS && s->contact_count == 0) { /* in the air: go on */
    r = kg_newton_solve(s->newton, x, s->scale, kg_step_evaluate, direction, s);
    count_newton(report, &r);
  }
  if (r.stop != KG_NEWTON_CONVERGED && s->def.scene) {
    memcpy(x, s->x_start, bytes);
    r = solve_hardening(s, x, report);
    r.residual = r.stop == KG_NEWTON_CONVERGED ? r.residual : true_residual(s, x);
  }
  *worst = fmax(*worst, r.residual);
  return r.stop == KG_NEWTON_CONVERGED;
}

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
    kg_step_ensure_evaluated(s, s->x);
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
  kg_step_ensure_evaluated(s, s->x);
  for (int level = 1; level <= s->def.max_substep_levels && !own.converged; level++) {
    const bool last = level == s->def.max_substep_levels;
    own.converged = solve_divided(s, q, v, dt, level, last, &own);
  }
  memcpy(v_next, s->x, v_bytes);
  memcpy(q_next, s->q_end, (size_t)body->nq * sizeof *q);
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
