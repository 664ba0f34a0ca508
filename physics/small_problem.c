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
  HALVINGS = 14,
  MEMORY = 4 /* iterates a new one is compared with */
};

static const double ARMIJO = 1e-4;
static const double TINY_WAY = 1e-8; /* kg^1/2 m/s; rounding                                     */
static const double ROUGH = 1.0;     /* kg^1/2 m/s; tolerance for softer laws                    */
static const double BOUNDED = 1e-3;  /* kg^1/2 m/s; tolerance with bounded friction              */
/* of the body's error e, of 30 e^2 when it is small: the next iteration finds both again, what was
 * left of the contact and what the body errs in second order */
static const double TOLERATED = 0.3;
static const double SOFT_FLOOR_SHARE = 0.9;
static const double SOFT_STICK = 1.0; /* m/s                                              */
static const double FIRST_STRIDE = 0.5, SMALLEST_STRIDE = 0.005; /* of hardness           */

/* ---- candidates in lanes -----------------------------------------------------------------------*/

static kg_vec3 get3(const double *lanes, int component, int k)
{
  lanes += component * KG_LANES + k;
  return kg_vec3_make(lanes[0], lanes[KG_LANES], lanes[2 * KG_LANES]);
}

static void put3(double *lanes, int component, int k, kg_vec3 a)
{
  lanes += component * KG_LANES + k;
  lanes[0] = a.x;
  lanes[KG_LANES] = a.y;
  lanes[2 * KG_LANES] = a.z;
}

enum { X = 0, U = 3, F = 6 }; /* components of a state */

/* Candidate k of the problem is lane k % 8 of group k / 8. */
static kg_candidate_lanes *lanes_of(const kg_small_problem *p, int k)
{
  return &p->lanes[k / KG_LANES];
}

/* What is at a lane: a hard ground far away and at rest, or that of a site. */
static void put_site(const kg_contact_params *law, double *ground, int k,
                     const kg_contact_site *site)
{
  const kg_ground hard = {0.0, 0.0, 0.0, -1.0}, *soft = site && site->ground ? site->ground : &hard;
  const kg_vec3 up = {0.0, 1.0, 0.0}, rest = {0.0, 0.0, 0.0};
  ground[k] = site ? site->value.distance : 1e3 * law->layer;
  put3(ground, 1, k, site ? site->value.normal : up);
  put3(ground, 4, k, site ? site->velocity : rest);
  ground[7 * KG_LANES + k] = kg_contact_friction(law, soft);
  ground[8 * KG_LANES + k] = soft->thickness;
  ground[9 * KG_LANES + k] = soft->stiffness;
  ground[10 * KG_LANES + k] = soft->damping;
}

/* What acts at places of a group; sites, where not NULL: the same of each candidate, but on a plane that
 * is all of the scene. */
static void find_ground(const kg_step *s, int group, const double *x, double *ground,
                        kg_contact_site *sites)
{
  const kg_small_problem *p = s->small;
  const kg_sdf_shape *plane = kg_only_plane(s->def.scene);
  const kg_vec3 O = s->dynamics->origin;
  const int count = p->count - group * KG_LANES;
  if (plane) {
    s->dynamics->kernels->plane_ground(ground, x, kg_vec3_sub(plane->a, O), plane->b);
  }
  for (int k = 0; k < KG_LANES; k++) {
    if (k >= count) {
      put_site(&s->contact, ground, k, NULL);
    } else if (!plane) {
      const kg_contact_site site =
        kg_contact_find(&s->contact, s->def.scene, kg_vec3_add(O, get3(x, X, k)));
      put_site(&s->contact, ground, k, &site);
      if (sites) sites[k] = site;
    }
  }
}

/* Where each candidate alone would come to rest; returns (17). */
static double project_all(kg_step *s)
{
  kg_small_problem *p = s->small;
  double sum = 0.0;
  for (int g = 0; g < p->groups; g++) {
    kg_candidate_lanes *l = &p->lanes[g];
    find_ground(s, g, l->now, l->ground, NULL);
    s->dynamics->kernels->settle_points(&s->contact, s->dt, l->now, l->ground, l->yield, l->bound,
                                        l->at, l->touches, l->way);
  }
  for (int k = 0; k < p->count; k++) {
    sum += lanes_of(p, k)->way[k % KG_LANES];
  }
  return sqrt(sum);
}

/* The law and its derivatives where the ground may be curved, one by one */
static void differentiate_curved(const kg_step *s, int group, const kg_contact_site *sites)
{
  kg_small_problem *p = s->small;
  kg_candidate_lanes *l = &p->lanes[group];
  for (int k = 0; k < KG_LANES && group * KG_LANES + k < p->count; k++) {
    if (!(l->touches[k] > 0.0)) continue;
    kg_contact_force law;
    if (kg_contact_evaluate_at(&s->contact, &sites[k], get3(l->at, U, k), l->bound[k], true,
                               &law)) {
      for (int c = 0; c < 9; c++) {
        l->by_x[c * KG_LANES + k] = law.df_dx.m[c];
        l->by_u[c * KG_LANES + k] = law.df_du.m[c];
      }
    }
  }
}

/* The law of a group where its candidates alone would come to rest */
static void linearize_group(const kg_step *s, int group)
{
  const kg_physics_kernels *kernels = s->dynamics->kernels;
  kg_candidate_lanes *l = &s->small->lanes[group];
  kg_contact_site sites[KG_LANES];
  find_ground(s, group, l->at, l->there, sites);
  const double *u = l->at + U * KG_LANES;
  kernels->law_forces(&s->contact, l->there, u, l->bound, l->law);
  for (int k = 0; k < 3 * KG_LANES; k++) {
    l->law[k] *= l->touches[k % KG_LANES];
  }
  kernels->law_derivatives(&s->contact, l->there, u, l->bound, l->touches, l->by_x, l->by_u);
  if (!kg_only_plane(s->def.scene)) {
    differentiate_curved(s, group, sites);
  }
}

/* ---- one iteration -----------------------------------------------------------------------------*/

static void add_to(double *h, kg_vec3 moment, kg_vec3 force)
{
  const double a[6] = {moment.x, moment.y, moment.z, force.x, force.y, force.z};
  for (int k = 0; k < 6; k++) {
    h[k] += a[k];
  }
}

static kg_mat3 get33(const double *lanes, int k)
{
  kg_mat3 A;
  for (int c = 0; c < 9; c++) {
    A.m[c] = lanes[c * KG_LANES + k];
  }
  return A;
}

/* K, D of all slots, and h := the wrenches of the linear law without any motion */
static void linearize_law(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_physics_kernels *kernels = s->dynamics->kernels;
  double f[3 * KG_LANES];
  memset(p->K, 0, (size_t)p->slots * sizeof *p->K);
  memset(p->D, 0, (size_t)p->slots * sizeof *p->D);
  memset(p->h, 0, (size_t)p->stride * sizeof *p->h);
  memset(p->touching, 0, (size_t)p->slots * sizeof *p->touching);
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    const int lane = k % KG_LANES;
    kg_candidate_lanes *l = lanes_of(p, k);
    if (lane == 0) {
      linearize_group(s, k / KG_LANES);
      kernels->linear_forces(f, l->law, l->by_x, l->by_u, l->at, l->trial);
    }
    const kg_vec3 change = kg_vec3_sub(get3(f, 0, lane), c->trial.f);
    add_to(p->h + 6 * c->slot, kg_vec3_cross(c->trial.x, change), change);
    if (l->touches[lane] > 0.0) {
      p->touching[c->slot] = true;
      const double x[3] = {c->trial.x.x, c->trial.x.y, c->trial.x.z};
      const double u[3] = {c->trial.u.x, c->trial.u.y, c->trial.u.z};
      const kg_mat3 by_x = get33(l->by_x, lane), by_u = get33(l->by_u, lane);
      kernels->add_contact(p->K[c->slot].m, p->D[c->slot].m, x, u, by_x.m, by_u.m);
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

/* Rows of (15) of the slot j, into B and h: 1 - K C_xi - D C_nu, ... + K xi0 + D nu0 */
static void fill_rows(const kg_step *s, int j, double *B)
{
  const kg_small_problem *p = s->small;
  const kg_physics_kernels *kernels = s->dynamics->kernels;
  const int stride = p->stride, rows = (p->segment[j] + 1) * 6 * stride;
  add_times_motion(kernels, p->h + 6 * j, &p->K[j], p->xi0[j]);
  add_times_motion(kernels, p->h + 6 * j, &p->D[j], p->nu0[j]);
  kernels->wrench_rows(B, p->K[j].m, p->D[j].m, p->xi + rows, p->nu + rows, stride);
  for (int r = 0; r < 6; r++) {
    B[r * stride + 6 * j + r] += 1.0;
  }
}

/* The columns of the touching slots alone, `width` apart, and the right-hand side for these: what the
 * others have is known. In place: nothing moves to the right. */
static void leave_out_idle(kg_small_problem *p, int rows, int width, double *rhs)
{
  for (int r = 0; r < rows; r++) {
    const double *from = p->B + r * p->stride;
    double *to = p->B + r * width;
    double known = 0.0;
    for (int j = 0; j < p->slots; j++) {
      for (int k = 6 * j; k < 6 * j + 6 && !p->touching[j]; k++) {
        known += from[k] * p->h[k];
      }
    }
    for (int j = 0; j < p->slots; j++) {
      if (!p->touching[j]) continue;
      memmove(to, from + 6 * j, 6 * sizeof *to);
      to += 6;
    }
    rhs[r] -= known;
  }
}

/* (15). A slot that nothing touches keeps its right-hand side. */
static bool solve_wrenches(kg_step *s)
{
  kg_small_problem *p = s->small;
  double *x = p->rest;
  int rows = 0;
  for (int j = 0; j < p->slots; j++) {
    if (!p->touching[j]) continue;
    fill_rows(s, j, p->B + rows * p->stride);
    memcpy(x + rows, p->h + 6 * j, 6 * sizeof *x);
    rows += 6;
  }
  int width = p->stride;
  if (rows < 6 * p->slots) {
    width = (rows + 7) / 8 * 8;
    leave_out_idle(p, rows, width, x);
  }
  if (!s->dynamics->kernels->solve_dense(p->B, rows, width, x)) return false;
  for (int j = 0, row = 0; j < p->slots; j++) {
    if (!p->touching[j]) continue;
    memcpy(p->h + 6 * j, x + row, 6 * sizeof *x);
    row += 6;
  }
  return true;
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
    const kg_candidate *c = &p->candidates[k];
    const kg_point_state *t = &c->trial;
    double *next = lanes_of(p, k)->next;
    const int lane = k % KG_LANES;
    const kg_motion a = xi[c->slot], b = nu[c->slot];
    const kg_vec3 turned = kg_vec3_cross(a.w, t->u);
    put3(next, X, lane, kg_vec3_add(t->x, kg_vec3_add(a.v, kg_vec3_cross(a.w, t->x))));
    put3(next, U, lane,
         kg_vec3_add(t->u, kg_vec3_add(turned, kg_vec3_add(b.v, kg_vec3_cross(b.w, t->x)))));
  }
  for (int g = 0; g < p->groups; g++) {
    kg_candidate_lanes *l = &p->lanes[g];
    s->dynamics->kernels->linear_forces(l->next + F * KG_LANES, l->law, l->by_x, l->by_u, l->at,
                                        l->next);
  }
}

/* |diag(M)^-1/2 dt S'(law - f)|: the residual of the step, were the body linear */
static double mismatch(kg_step *s)
{
  kg_small_problem *p = s->small;
  double f[3 * KG_LANES];
  memset(p->rest, 0, (size_t)(6 * p->slots) * sizeof *p->rest);
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    const kg_candidate_lanes *l = lanes_of(p, k);
    const int lane = k % KG_LANES;
    if (lane == 0) {
      s->dynamics->kernels->law_forces(&s->contact, l->ground, l->now + U * KG_LANES, l->bound, f);
    }
    const kg_vec3 change = kg_vec3_sub(get3(f, 0, lane), get3(l->now, F, lane));
    add_to(p->rest + 6 * c->slot, kg_vec3_cross(c->trial.x, change), change);
  }
  memset(p->G, 0, (size_t)s->def.body->nv * sizeof *p->G);
  kg_small_add_wrenches(s, p->rest, p->G);
  return kg_step_merit(s, p->G);
}

/* now := the share t of the way from old to next */
static void blend(kg_small_problem *p, double t)
{
  for (int g = 0; g < p->groups; g++) {
    kg_candidate_lanes *l = &p->lanes[g];
    for (int k = 0; k < 9 * KG_LANES; k++) {
      l->now[k] = l->old[k] + t * (l->next[k] - l->old[k]);
    }
  }
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
  for (int g = 0; g < p->groups; g++) {
    memcpy(p->lanes[g].old, p->lanes[g].now, sizeof p->lanes[g].old);
  }
  *alpha = 1.0;
  for (int halving = 0; halving <= HALVINGS; halving++, *alpha *= 0.5) {
    report->cuts += halving > 0;
    blend(p, *alpha);
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

static void set_bounds(kg_small_problem *p, double bound)
{
  for (int g = 0; g < p->groups; g++) {
    for (int k = 0; k < KG_LANES; k++) {
      p->lanes[g].bound[k] = bound;
    }
  }
}

/* The candidates of a group side by side. */
static void fill_lanes(kg_small_problem *p, const kg_contact_params *law, int group)
{
  kg_candidate_lanes *l = &p->lanes[group];
  memset(l, 0, sizeof *l);
  for (int k = 0; k < KG_LANES; k++) {
    const kg_candidate *c = &p->candidates[group * KG_LANES + k];
    const bool is_one = group * KG_LANES + k < p->count;
    put_site(law, l->ground, k, NULL);
    put_site(law, l->there, k, NULL);
    l->yield[k] = is_one ? c->yield_n : 1.0;
    l->yield[KG_LANES + k] = is_one ? c->yield_t : 1.0;
    if (is_one) {
      put3(l->trial, X, k, c->trial.x);
      put3(l->trial, U, k, c->trial.u);
      put3(l->trial, F, k, c->trial.f);
      put3(l->law, 0, k, c->trial.f);
    }
  }
}

/* now: the forces the body was linearised with, and where they lead */
static void start(kg_step *s)
{
  kg_small_problem *p = s->small;
  memset(p->h, 0, (size_t)p->stride * sizeof *p->h);
  for (int g = 0; g < p->groups; g++) {
    fill_lanes(p, &s->contact, g);
  }
  set_bounds(p, -1.0);
  find_next(s);
  for (int g = 0; g < p->groups; g++) {
    memcpy(p->lanes[g].now, p->lanes[g].next, sizeof p->lanes[g].now);
  }
}

static void keep(kg_small_problem *p)
{
  for (int g = 0; g < p->groups; g++) {
    memcpy(p->lanes[g].good, p->lanes[g].now, sizeof p->lanes[g].good);
  }
}

static void take_back(kg_small_problem *p)
{
  for (int g = 0; g < p->groups; g++) {
    memcpy(p->lanes[g].now, p->lanes[g].good, sizeof p->lanes[g].now);
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
static void move_bound(const kg_step *s, int candidate, int round)
{
  const kg_small_problem *p = s->small;
  kg_candidate *c = &p->candidates[candidate];
  const kg_candidate_lanes *l = lanes_of(p, candidate);
  const int k = candidate % KG_LANES;
  const double normal = kg_vec3_dot(get3(l->ground, 1, k), get3(l->now, F, k));
  const double change = fmax(normal, 0.0) - l->bound[k];
  c->gain = round <= 2 ? 1.0 : c->gain * (change * c->change > 0.0 ? 1.5 : 0.5);
  c->change = change;
  c->next_bound = fmax(l->bound[k] + c->gain * change, 0.0);
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
      lanes_of(p, k)->bound[k % KG_LANES] = p->candidates[k].next_bound;
    }
    if (!solve_law(s, BOUNDED, BOUNDED_ITERATIONS, report)) break;
    result = KG_SMALL_BOUNDED;
    keep(p);
    for (int k = 0; k < p->count; k++) {
      move_bound(s, k, round);
    }
    set_bounds(p, -1.0);
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
    const kg_vec3 now = get3(lanes_of(p, k)->now, F, k % KG_LANES);
    const kg_vec3 f = kg_vec3_sub(now, c->trial.f);
    add_to(p->h + 6 * c->slot, kg_vec3_cross(c->trial.x, f), f);
  }
}

/* d of the change of wrenches, and the forces that go with it */
static void take_answer(kg_step *s, double *d)
{
  kg_small_problem *p = s->small;
  const int nv = s->def.body->nv;
  memset(d, 0, (size_t)nv * sizeof *d);
  kg_small_add_wrenches(s, p->h, d);
  for (int k = 0; k < p->count; k++) {
    p->force[p->candidates[k].point] = get3(lanes_of(p, k)->now, F, k % KG_LANES);
  }
  kg_tree_solve_from(&s->dynamics->tree, &s->J, d, p->blocks, p->block_count);
  for (int k = 0; k < nv; k++) {
    d[k] += p->free[k];
  }
}

bool kg_small_direction(kg_step *s, double *d, const double *x, double damping,
                        kg_small_report *report)
{
  kg_small_problem *p = s->small;
  kg_step_ensure_evaluated(s, x);
  report->exact = true;
  if (!kg_small_linearize(s, damping, d)) return false;
  if (p->slots == 0) {
    kg_tree_solve(&s->dynamics->tree, &s->J, d);
  } else {
    const double least = 0.1 * s->def.tolerance, error = p->body_error;
    p->tolerance = fmax(fmin(TOLERATED * error * fmin(30.0 * error, 1.0), ROUGH), least);
    const kg_small_result result = solve(s, report);
    if (result == KG_SMALL_FAILED) return false;
    report->exact = result == KG_SMALL_SOLVED;
    if (!report->exact) { /* else h is there, with less rounding than in the stiff law's forces */
      sum_forces(p);
    }
    take_answer(s, d);
  }
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
