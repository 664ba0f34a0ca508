/* The small problem: forces on the candidates that obey the law where the linear body puts them.
 * Symbols and numbers: docs/theory/contact.md, section 4.
 *
 * Newton's method on  f - P(f) = 0,  P(f) the force of the law where a candidate alone would come to
 * rest between what the body says and what the law says. The law is linearised there, so neither its
 * pole nor the narrow stick zone throws the iteration off. Where that fails, the law is softened and
 * hardened again; where that fails, friction is bounded by given forces, which is a convex problem,
 * and the bounds follow the normal forces. */
#include "physics/small_problem.h"

#include "physics/contact_law.h"
#include "physics/kernels/kernels.h"

#include <string.h>

enum {
  PLAIN_ITERATIONS = 25,   /* at the law itself, before anything else  */
  PATH_ITERATIONS = 25,    /* for each law on the way                  */
  BOUNDED_ITERATIONS = 60, /* for each set of bounds                   */
  CLOSING_ITERATIONS = 15, /* at the law itself, from a bounded answer */
  BOUNDS = 40,
  LOCAL_ITERATIONS = 40,
  HALVINGS = 14,
  MEMORY = 4 /* iterates a new one is compared with */
};

static const double ARMIJO = 1e-4;
static const double TINY_WAY = 1e-8; /* kg^1/2 m/s; rounding                                     */
static const double ROUGH = 1.0;     /* kg^1/2 m/s; tolerance for softer laws                    */
static const double BOUNDED = 1e-3;  /* kg^1/2 m/s; tolerance with bounded friction              */
/* of the body's error: what the next iteration finds of that is of second order, and the forces'
 * share of it is found with it */
static const double TOLERATED = 0.1;
static const double SOFT_FLOOR_SHARE = 0.9;
static const double SOFT_STICK = 1.0; /* m/s                                              */
static const double FIRST_STRIDE = 0.5, SMALLEST_STRIDE = 0.005; /* of hardness           */

/* ---- one candidate alone -----------------------------------------------------------------------*/

/* The normal force f = N at the distance phi + dt y (f - f0) and speed + y (f - f0). The right side
 * falls with f, so f lies between any trial and its right side. */
static double local_normal(const kg_step *s, const kg_contact_site *at, double speed, double f0,
                           double y)
{
  double low = 0.0, high = INFINITY, f = fmax(f0, 0.0);
  for (int k = 0; k < LOCAL_ITERATIONS; k++) {
    const double move = y * (f - f0);
    const kg_normal_law n =
      kg_contact_normal(&s->contact, at->ground, at->value.distance + s->dt * move, speed + move);
    const double g = f - n.force;
    const double below = g < 0.0 ? f : n.force, above = g < 0.0 ? n.force : f;
    low = low > below ? low : below;
    high = high < above ? high : above;
    if (fabs(g) <= 1e-13 * f || high - low <= 1e-15 * high) break;
    f -= g / (1.0 - y * (s->dt * n.by_distance + n.by_speed));
    if (!(f >= low && f <= high)) f = 0.5 * (low + high);
  }
  return f;
}

/* Speed s after friction of a point that would slide at y: s + a g(s / v_s) = y with g of (4). */
static double local_slip(const kg_contact_params *law, double y, double a)
{
  const double v = law->stick;
  if (y >= v + a) return y - a;
  const double b = 1.0 + 2.0 * a / v, q = a / (v * v); /* b s - q s^2 = y */
  return 2.0 * y / (b + sqrt(fmax(b * b - 4.0 * q * y, 0.0)));
}

/* Where the candidate alone would come to rest; returns the square of the way there, kg (m/s)^2. */
static double project(const kg_step *s, kg_candidate *c)
{
  const kg_contact_params *law = &s->contact;
  const kg_contact_site at =
    kg_contact_find(law, s->def.scene, kg_vec3_add(s->dynamics->origin, c->now.x));
  const kg_vec3 n = at.value.normal, u = kg_vec3_sub(c->now.u, at.velocity);
  const double f0 = kg_vec3_dot(n, c->now.f), speed = kg_vec3_dot(n, u);
  const double f = local_normal(s, &at, speed, f0, c->yield_n);
  const double move = c->yield_n * (f - f0);
  const kg_vec3 f_t = kg_vec3_add_scaled(c->now.f, -f0, n);
  c->touches = f > 0.0;
  if (!c->touches && f0 == 0.0 && kg_vec3_dot(f_t, f_t) == 0.0) {
    c->x_law = c->now.x;
    c->u_law = c->now.u;
    return 0.0;
  }
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed, n);
  const kg_vec3 free = kg_vec3_add_scaled(u_t, -c->yield_t, f_t); /* without friction */
  const double size = kg_vec3_norm(free);
  const double bound = c->bound < 0.0 || !c->touches ? f : c->bound;
  const double most = c->yield_t * kg_contact_friction(law, at.ground) * bound;
  const kg_vec3 slip = kg_vec3_scale(size > 0.0 ? local_slip(law, size, most) / size : 0.0, free);
  const kg_vec3 held = kg_vec3_sub(slip, u_t);
  c->u_law = kg_vec3_add(kg_vec3_add_scaled(slip, speed + move, n), at.velocity);
  c->x_law = kg_vec3_add_scaled(kg_vec3_add_scaled(c->now.x, s->dt * move, n), s->dt, held);
  return s->dt * ((f - f0) * move + kg_vec3_dot(held, held) / c->yield_t);
}

static double project_all(kg_step *s)
{
  kg_small_problem *p = s->small;
  double sum = 0.0;
  for (int k = 0; k < p->count; k++) {
    sum += project(s, &p->candidates[k]);
  }
  return sqrt(sum);
}

static void evaluate_law(const kg_step *s, const kg_candidate *c, kg_vec3 x, kg_vec3 u,
                         bool derivatives, kg_contact_force *law)
{
  (void)kg_contact_evaluate_bounded(&s->contact, s->def.scene, kg_vec3_add(s->dynamics->origin, x),
                                    u, c->bound, derivatives, law);
}

/* ---- one iteration -----------------------------------------------------------------------------*/

/* The linear law at a place and velocity */
static kg_vec3 linear_law(const kg_candidate *c, kg_vec3 x, kg_vec3 u)
{
  if (!(c->law.normal > 0.0)) return c->law.f;
  const kg_vec3 by_x = kg_mat3_mul_vec(c->law.df_dx, kg_vec3_sub(x, c->x_law));
  const kg_vec3 by_u = kg_mat3_mul_vec(c->law.df_du, kg_vec3_sub(u, c->u_law));
  return kg_vec3_add(c->law.f, kg_vec3_add(by_x, by_u));
}

static void add_to(double *h, kg_vec3 moment, kg_vec3 force)
{
  const double a[6] = {moment.x, moment.y, moment.z, force.x, force.y, force.z};
  for (int k = 0; k < 6; k++) {
    h[k] += a[k];
  }
}

/* K, D of all slots, and h := the wrenches of the linear law without any motion */
static void linearize_law(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_physics_kernels *kernels = s->dynamics->kernels;
  memset(p->K, 0, (size_t)p->slots * sizeof *p->K);
  memset(p->D, 0, (size_t)p->slots * sizeof *p->D);
  memset(p->h, 0, (size_t)p->stride * sizeof *p->h);
  for (int k = 0; k < p->count; k++) {
    kg_candidate *c = &p->candidates[k];
    if (c->touches) {
      evaluate_law(s, c, c->x_law, c->u_law, true, &c->law);
    } else {
      c->law.normal = 0.0;
      c->law.f = kg_vec3_make(0.0, 0.0, 0.0);
    }
    const kg_vec3 f = kg_vec3_sub(linear_law(c, c->trial.x, c->trial.u), c->trial.f);
    add_to(p->h + 6 * c->slot, kg_vec3_cross(c->trial.x, f), f);
    if (c->law.normal > 0.0) {
      const double x[3] = {c->trial.x.x, c->trial.x.y, c->trial.x.z};
      const double u[3] = {c->trial.u.x, c->trial.u.y, c->trial.u.z};
      kernels->add_contact(p->K[c->slot].m, p->D[c->slot].m, x, u, c->law.df_dx.m, c->law.df_du.m);
    }
  }
}

/* h += A m */
static void add_times_motion(const kg_physics_kernels *kernels, double *h, const kg_small_block *A,
                             kg_motion m)
{
  const double x[8] = {m.w.x, m.w.y, m.w.z, m.v.x, m.v.y, m.v.z};
  kernels->add_rows(h, A->m, x, 8);
}

/* (15) (1 - K C_xi - D C_nu) h = ... + K xi0 + D nu0 */
static bool solve_wrenches(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_physics_kernels *kernels = s->dynamics->kernels;
  const int stride = p->stride;
  for (int j = 0; j < p->slots; j++) {
    const int rows = (p->segment[j] + 1) * 6 * stride;
    double *B = p->B + 6 * j * stride;
    add_times_motion(kernels, p->h + 6 * j, &p->K[j], p->xi0[j]);
    add_times_motion(kernels, p->h + 6 * j, &p->D[j], p->nu0[j]);
    kernels->wrench_rows(B, p->K[j].m, p->D[j].m, p->xi + rows, p->nu + rows, stride);
    for (int r = 0; r < 6; r++) {
      B[r * stride + 6 * j + r] += 1.0;
    }
  }
  return kernels->solve_dense(p->B, 6 * p->slots, stride, p->h);
}

static kg_motion slot_motion(const kg_step *s, int slot, kg_motion m, const double *C)
{
  const kg_small_problem *p = s->small;
  double x[6] = {m.w.x, m.w.y, m.w.z, m.v.x, m.v.y, m.v.z};
  C += (p->segment[slot] + 1) * 6 * p->stride;
  s->dynamics->kernels->add_rows(x, C, p->h, p->stride);
  return (kg_motion){kg_vec3_make(x[0], x[1], x[2]), kg_vec3_make(x[3], x[4], x[5])};
}

/* next: places and velocities under the wrenches h, forces of the linear law there */
static void find_next(kg_step *s)
{
  kg_small_problem *p = s->small;
  kg_motion *xi = p->xi_now, *nu = p->nu_now;
  for (int j = 0; j < p->slots; j++) {
    xi[j] = slot_motion(s, j, p->xi0[j], p->xi);
    nu[j] = slot_motion(s, j, p->nu0[j], p->nu);
  }
  for (int k = 0; k < p->count; k++) {
    kg_candidate *c = &p->candidates[k];
    const kg_point_state *t = &c->trial;
    const kg_motion a = xi[c->slot], b = nu[c->slot];
    const kg_vec3 turned = kg_vec3_cross(a.w, t->u);
    c->next.x = kg_vec3_add(t->x, kg_vec3_add(a.v, kg_vec3_cross(a.w, t->x)));
    c->next.u = kg_vec3_add(t->u, kg_vec3_add(turned, kg_vec3_add(b.v, kg_vec3_cross(b.w, t->x))));
    c->next.f = linear_law(c, c->next.x, c->next.u);
  }
}

/* |diag(M)^-1/2 dt S'(law - f)|: the residual of the step, were the body linear */
static double mismatch(kg_step *s)
{
  kg_small_problem *p = s->small;
  memset(p->rest, 0, (size_t)(6 * p->slots) * sizeof *p->rest);
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    kg_contact_force law;
    evaluate_law(s, c, c->now.x, c->now.u, false, &law);
    const kg_vec3 f = kg_vec3_sub(law.f, c->now.f);
    add_to(p->rest + 6 * c->slot, kg_vec3_cross(c->trial.x, f), f);
  }
  memset(p->G, 0, (size_t)s->def.body->nv * sizeof *p->G);
  kg_small_add_wrenches(s, p->rest, p->G);
  return kg_step_merit(s, p->G);
}

static kg_point_state blend(const kg_point_state *a, const kg_point_state *b, double t)
{
  return (kg_point_state){kg_vec3_lerp(a->x, b->x, t), kg_vec3_lerp(a->u, b->u, t),
                          kg_vec3_lerp(a->f, b->f, t)};
}

/* now := the largest share of the way from old to next that comes closer to the law than the farthest
 * of the last iterates; false when there is none */
static bool line_search(kg_step *s, const double ways[MEMORY], double *way, double *alpha,
                        kg_small_report *report)
{
  kg_small_problem *p = s->small;
  double farthest = 0.0;
  for (int k = 0; k < MEMORY; k++) {
    farthest = fmax(farthest, ways[k]);
  }
  for (int k = 0; k < p->count; k++) {
    p->candidates[k].old = p->candidates[k].now;
  }
  *alpha = 1.0;
  for (int halving = 0; halving <= HALVINGS; halving++, *alpha *= 0.5) {
    report->cuts += halving > 0;
    for (int k = 0; k < p->count; k++) {
      kg_candidate *c = &p->candidates[k];
      c->now = blend(&c->old, &c->next, *alpha);
    }
    *way = project_all(s);
    if (*way <= (1.0 - ARMIJO * *alpha) * farthest || *way <= TINY_WAY) return true;
  }
  return false;
}

/* Newton at the law as it stands, from `now`. */
static bool solve_law(kg_step *s, double tolerance, int most, kg_small_report *report)
{
  double way = project_all(s), alpha, ways[MEMORY] = {0.0};
  for (int k = 0; k < most; k++) {
    ways[k % MEMORY] = way;
    linearize_law(s);
    if (!solve_wrenches(s)) return false;
    report->iterations++;
    find_next(s);
    if (!line_search(s, ways, &way, &alpha, report)) return false;
    /* the way is shorter than the residual of the point alone */
    if (alpha == 1.0 && way <= tolerance && mismatch(s) <= tolerance) return true;
  }
  return false;
}

/* ---- ways to an answer -------------------------------------------------------------------------*/

/* now: the forces the body was linearised with, and where they lead */
static void start(kg_step *s)
{
  kg_small_problem *p = s->small;
  memset(p->h, 0, (size_t)p->stride * sizeof *p->h);
  for (int k = 0; k < p->count; k++) {
    kg_candidate *c = &p->candidates[k];
    c->law.normal = 0.0;
    c->law.f = c->trial.f;
    c->bound = -1.0;
  }
  find_next(s);
  for (int k = 0; k < p->count; k++) {
    p->candidates[k].now = p->candidates[k].next;
  }
}

static void keep(kg_small_problem *p)
{
  for (int k = 0; k < p->count; k++) {
    p->candidates[k].good = p->candidates[k].now;
  }
}

static void take_back(kg_small_problem *p)
{
  for (int k = 0; k < p->count; k++) {
    p->candidates[k].now = p->candidates[k].good;
  }
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
}

/* From a soft law to the true one with strides as long as Newton can follow. */
static bool solve_hardening(kg_step *s, kg_small_report *report)
{
  double done = 0.0, stride = FIRST_STRIDE;
  start(s);
  set_hardness(s, 0.0);
  bool good = solve_law(s, ROUGH, PATH_ITERATIONS, report);
  while (good && done < 1.0 && stride > SMALLEST_STRIDE) {
    const double target = fmin(1.0, done + stride);
    keep(s->small);
    set_hardness(s, target);
    if (solve_law(s, target < 1.0 ? ROUGH : s->small->tolerance, PATH_ITERATIONS, report)) {
      done = target;
      stride *= 1.5;
    } else {
      take_back(s->small);
      stride *= 0.4;
    }
  }
  set_hardness(s, 1.0);
  return good && done >= 1.0;
}

/* The next bound of a candidate: its normal force, and beyond it when the search keeps going the same
 * way, short of it when it turns back. */
static void move_bound(const kg_step *s, kg_candidate *c, int round)
{
  const kg_vec3 at = kg_vec3_add(s->dynamics->origin, c->now.x);
  const kg_vec3 n = kg_contact_find(&s->contact, s->def.scene, at).value.normal;
  const double change = fmax(kg_vec3_dot(n, c->now.f), 0.0) - c->bound;
  c->gain = round <= 2 ? 1.0 : c->gain * (change * c->change > 0.0 ? 1.5 : 0.5);
  c->change = change;
  c->next_bound = fmax(c->bound + c->gain * change, 0.0);
}

/* With friction bounded by fixed forces, at first none, then by the normal forces of the last answer.
 * `good` ends as the last answer of such a problem. */
static kg_small_result solve_bounded(kg_step *s, kg_small_report *report)
{
  kg_small_problem *p = s->small;
  kg_small_result result = KG_SMALL_FAILED;
  start(s);
  for (int k = 0; k < p->count; k++) {
    p->candidates[k].next_bound = 0.0;
  }
  for (int round = 0; round < BOUNDS; round++) {
    for (int k = 0; k < p->count; k++) {
      p->candidates[k].bound = p->candidates[k].next_bound;
    }
    if (!solve_law(s, BOUNDED, BOUNDED_ITERATIONS, report)) break;
    result = KG_SMALL_BOUNDED;
    keep(p);
    for (int k = 0; k < p->count; k++) {
      move_bound(s, &p->candidates[k], round);
      p->candidates[k].bound = -1.0;
    }
    if (round > 0 && solve_law(s, p->tolerance, CLOSING_ITERATIONS, report)) {
      return KG_SMALL_SOLVED;
    }
    take_back(p);
  }
  return result;
}

static kg_small_result solve(kg_step *s, kg_small_report *report)
{
  start(s);
  if (solve_law(s, s->small->tolerance, PLAIN_ITERATIONS, report)) return KG_SMALL_SOLVED;
  report->fallback = true;
  if (solve_hardening(s, report)) return KG_SMALL_SOLVED;
  const kg_small_result result = solve_bounded(s, report);
  if (result == KG_SMALL_BOUNDED) {
    take_back(s->small);
  }
  return result;
}

/* ---- the direction -----------------------------------------------------------------------------*/

/* h := wrenches of the forces of the iterate */
static void sum_forces(kg_small_problem *p)
{
  memset(p->h, 0, (size_t)p->stride * sizeof *p->h);
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    const kg_vec3 f = kg_vec3_sub(c->now.f, c->trial.f);
    add_to(p->h + 6 * c->slot, kg_vec3_cross(c->trial.x, f), f);
  }
}

/* d of the change of wrenches, and the forces that go with it */
static void take_answer(kg_step *s, double *d)
{
  kg_small_problem *p = s->small;
  kg_small_add_wrenches(s, p->h, d);
  for (int k = 0; k < p->count; k++) {
    p->force[p->candidates[k].point] = p->candidates[k].now.f;
  }
  kg_tree_solve(&s->dynamics->tree, &s->J, d);
}

bool kg_small_direction(kg_step *s, double *d, const double *x, double damping,
                        kg_small_report *report)
{
  kg_small_problem *p = s->small;
  kg_step_ensure_evaluated(s, x);
  report->exact = true;
  if (!kg_small_linearize(s, damping, d)) return false;
  if (p->slots > 0) {
    const double least = 0.1 * s->def.tolerance, error = p->body_error;
    p->tolerance = fmax(TOLERATED * fmin(error * error, error), least);
    const kg_small_result result = solve(s, report);
    if (result == KG_SMALL_FAILED) return false;
    report->exact = result == KG_SMALL_SOLVED;
    if (!report->exact) { /* else h is there, with less rounding than in the stiff law's forces */
      sum_forces(p);
    }
  }
  take_answer(s, d);
  return true;
}

bool kg_small_chord(kg_step *s, double *d, const double *x, kg_small_report *report)
{
  kg_small_problem *p = s->small;
  kg_step_ensure_evaluated(s, x);
  if (p->slots == 0) {
    for (int k = 0; k < s->def.body->nv; k++) {
      d[k] = -s->G[k];
    }
    kg_tree_solve(&s->dynamics->tree, &s->J, d);
    return true;
  }
  kg_small_move_on(s, d);
  p->tolerance = 0.1 * s->def.tolerance;
  start(s);
  if (!solve_law(s, p->tolerance, CLOSING_ITERATIONS, report)) return false;
  take_answer(s, d);
  return true;
}
