/* One backward Euler step of a body with contact: residual, exact Jacobian, Newton, sub-steps.
 *
 * Equation numbers: docs/theory/dynamics.md for (1) to (19), docs/theory/contact.md where "contact"
 * is written before the number. */
#include "kinegrad/step.h"

#include "physics/physics.h"
#include "physics/rows.h"
#include "physics/tree.h"

#include <string.h>

/* kg m^2: keeps the scale finite for a joint that moves nothing. */
static const double SMALLEST_INERTIA = 1e-12;

/* What plain Newton does not solve at once is solved by continuation: the contact law is made soft,
 * solved roughly, and hardened to what it is (docs/theory/contact.md, section 4). */
static const double SOFT_FLOOR_SHARE = 0.9;
static const double SOFT_STICK = 1.0;     /* m/s                                             */
static const double ROUGH = 0.1;          /* kg^1/2 m/s; tolerance on the way                */
static const double FIRST_HARDNESS = 0.6; /* between soft (0) and hard (1)                   */
static const double FIRST_STRIDE = 0.4;   /* of hardness                                     */
static const double SMALLEST_STRIDE = 0.01;
enum { PLAIN_ITERATIONS = 2, ROUGH_ITERATIONS = 12 };

/* The points of one segment and a ball around them, to dismiss them all with one distance. */
typedef struct point_group {
  int first, count; /* in kg_step.order */
  kg_vec3 centre;   /* in the segment frame */
  double radius;
} point_group;

struct kg_step {
  kg_step_def def;
  kg_dynamics *dynamics;
  kg_newton *newton;         /* to the tolerance                                     */
  kg_newton *plain;          /* the same with few iterations: the first attempt      */
  kg_newton *rough;          /* to ROUGH: stages of the continuation                  */
  kg_contact_params contact; /* of the stage */
  int *order;                /* points sorted by segment */
  point_group *groups;
  kg_step_contact *contacts;
  int contact_count;
  kg_tree_matrix J;
  double *scale;     /* of the residual: diag(M)^-1/2 dt */
  double *q_end, *a; /* at the last evaluated v'         */
  double *v_end;     /* the v' the links were last evaluated at; only with evaluated */
  bool evaluated;
  double *G;                 /* of a repeated evaluation     */
  double *x_start, *x_good;  /* the guess; last solution on the way to the hard law */
  double *q_sub, *v_sub, *x; /* state inside a sequence of sub-steps, unknowns */
  /* the step being solved */
  const double *q, *v, *tau;
  double dt;
  kg_arena arena;
};

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

/* Ball around the points of a group: centre of their bounding box, not the smallest ball. */
static void bound_group(point_group *g, const int *order, const kg_body *body)
{
  kg_vec3 low = {INFINITY, INFINITY, INFINITY}, high = {-INFINITY, -INFINITY, -INFINITY};
  for (int k = g->first; k < g->first + g->count; k++) {
    const kg_vec3 p = body->points[order[k]].p;
    low = kg_vec3_make(fmin(low.x, p.x), fmin(low.y, p.y), fmin(low.z, p.z));
    high = kg_vec3_make(fmax(high.x, p.x), fmax(high.y, p.y), fmax(high.z, p.z));
  }
  g->centre = kg_vec3_lerp(low, high, 0.5);
  for (int k = g->first; k < g->first + g->count; k++) {
    const kg_vec3 arm = kg_vec3_sub(body->points[order[k]].p, g->centre);
    g->radius = fmax(g->radius, kg_vec3_norm(arm));
  }
}

static void group_points(kg_step *s)
{
  const kg_body *body = s->def.body;
  int placed = 0;
  for (int i = 0; i < body->segment_count; i++) {
    point_group *g = &s->groups[i];
    g->first = placed;
    for (int k = 0; k < body->point_count; k++) {
      if (body->points[k].segment == i) {
        s->order[placed++] = k;
      }
    }
    g->count = placed - g->first;
    if (g->count > 0) {
      bound_group(g, s->order, body);
    }
  }
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
  group_points(&made);
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

/* ---- contact ----------------------------------------------------------------------------------*/

/* velocity of the point x (relative to O) of a segment */
static kg_vec3 point_velocity(const kg_link *l, kg_vec3 x)
{
  return kg_vec3_add(l->p_dot, kg_vec3_cross(l->w, kg_vec3_sub(x, l->p)));
}

static void collide_group(kg_step *s, int i)
{
  const kg_body *body = s->def.body;
  const kg_vec3 O = s->dynamics->origin;
  const point_group *g = &s->groups[i];
  kg_link *l = &s->dynamics->links[i];
  for (int k = g->first; k < g->first + g->count; k++) {
    const int point = s->order[k];
    const kg_vec3 x = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, body->points[point].p));
    kg_step_contact *c = &s->contacts[s->contact_count];
    c->x = kg_vec3_add(O, x);
    if (kg_contact_evaluate(&s->contact, s->def.scene, c->x, point_velocity(l, x), false,
                            &c->force)) {
      c->point = point;
      s->contact_count++;
      l->external.n = kg_vec3_add(l->external.n, kg_vec3_cross(x, c->force.f));
      l->external.f = kg_vec3_add(l->external.f, c->force.f);
    }
  }
}

/* Contact list and external forces of the links at their pose and velocity. */
static void collide(kg_step *s)
{
  s->contact_count = 0;
  for (int i = 0; i < s->dynamics->n; i++) {
    const point_group *g = &s->groups[i];
    kg_link *l = &s->dynamics->links[i];
    l->external = (kg_force){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    if (g->count == 0 || !s->def.scene) {
      continue;
    }
    const kg_vec3 centre = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, g->centre));
    const kg_sdf_value far =
      kg_scene_distance(s->def.scene, kg_vec3_add(s->dynamics->origin, centre));
    /* Phi changes by no more than the distance moved */
    if (!(far.distance > g->radius + s->contact.layer)) {
      collide_group(s, i);
    }
  }
}

static void add_mat3(kg_mat3 *A, double s, kg_mat3 B)
{
  for (int k = 0; k < 9; k++) {
    A->m[k] += s * B.m[k];
  }
}

/* K += P' A P with P = [-[x] 1]: the change of the wrench by A for a change of the point */
static void add_congruent(kg_mat66 *K, kg_mat3 A, kg_mat3 X)
{
  const kg_mat3 XA = kg_mat3_mul(X, A), AX = kg_mat3_mul(A, X);
  add_mat3(&K->ww, -1.0, kg_mat3_mul(XA, X));
  add_mat3(&K->wv, 1.0, XA);
  add_mat3(&K->vw, -1.0, AX);
  add_mat3(&K->vv, 1.0, A);
}

/* K and D of a segment gain a contact (contact (9) to (11)). */
static void linearize_contact(kg_step *s, kg_step_contact *c)
{
  const int segment = s->def.body->points[c->point].segment;
  const kg_link *l = &s->dynamics->links[segment];
  kg_composite *sum = &s->dynamics->sum[segment + 1];
  const kg_vec3 x = kg_vec3_sub(c->x, s->dynamics->origin);
  const kg_vec3 u = point_velocity(l, x);
  (void)kg_contact_evaluate(&s->contact, s->def.scene, c->x, u, true, &c->force);
  if (!sum->loaded) {
    memset(&sum->K, 0, sizeof sum->K);
    memset(&sum->D, 0, sizeof sum->D);
    sum->loaded = true;
    sum->external = l->external;
  }
  const kg_mat3 X = kg_mat3_skew(x), F = kg_mat3_skew(c->force.f);
  add_congruent(&sum->K, c->force.df_dx, X);
  /* turning the body turns u: df_du (theta x u) */
  const kg_mat3 turned = kg_mat3_mul(c->force.df_du, kg_mat3_skew(u));
  add_mat3(&sum->K.ww, -1.0, kg_mat3_mul(X, turned));
  add_mat3(&sum->K.vw, -1.0, turned);
  /* moving the point moves the arm of f: dx x f */
  add_mat3(&sum->K.ww, 1.0, kg_mat3_mul(F, X));
  add_mat3(&sum->K.wv, -1.0, F);
  add_congruent(&sum->D, c->force.df_du, X);
}

/* ---- residual and Jacobian --------------------------------------------------------------------*/

static void set_problem(kg_step *s, const double *q, const double *v, const double *tau, double dt)
{
  s->q = q;
  s->v = v;
  s->tau = tau;
  s->dt = dt;
  s->evaluated = false;
}

/* diag(M(q))^-1/2 dt */
static void set_scale(kg_step *s)
{
  kg_links_pose(s->dynamics, s->q);
  kg_links_mass_diagonal(s->dynamics, s->scale);
  for (int k = 0; k < s->def.body->nv; k++) {
    s->scale[k] = s->dt / sqrt(fmax(s->scale[k], SMALLEST_INERTIA));
  }
}

/* (17) G(v') */
static bool residual(double *G, const double *v_end, void *user)
{
  kg_step *s = user;
  const kg_body *body = s->def.body;
  kg_dynamics *d = s->dynamics;
  for (int k = 0; k < body->nv; k++) {
    s->v_end[k] = v_end[k];
    G[k] = s->dt * v_end[k];
    s->a[k] = (v_end[k] - s->v[k]) / s->dt;
  }
  s->evaluated = true;
  kg_body_integrate(body, s->q_end, s->q, G);
  kg_links_pose(d, s->q_end);
  kg_links_velocity(d, v_end);
  kg_links_acceleration(d, v_end, s->a);
  kg_links_inertial(d);
  collide(s);
  kg_links_project(d, G);
  for (int k = 0; k < body->nv && s->tau; k++) {
    G[k] -= s->tau[k];
  }
  for (int k = 6; k < body->nv; k++) {
    G[k] += s->def.joint_damping * v_end[k];
  }
  return true;
}

static kg_mat63 times(const kg_mat63 *A, const kg_mat3 *E)
{
  const rows3 e = load_rows(E);
  kg_mat63 C = {{{0.0}}, {{0.0}}};
  for (int i = 0; i < 9; i += 3) {
    add_row(C.w.m + i, A->w.m[i], A->w.m[i + 1], A->w.m[i + 2], &e);
    add_row(C.v.m + i, A->v.m[i], A->v.m[i + 1], A->v.m[i + 2], &e);
  }
  return C;
}

/* A += s B */
static void add63(kg_mat63 *A, double s, const kg_mat63 *B)
{
  add_mat3(&A->w, s, B->w);
  add_mat3(&A->v, s, B->v);
}

/* (18) the pencil of v': the pose moves by dt Jr(dt w), the acceleration by 1/dt */
static void make_pencil(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  for (int b = 0; b <= d->n; b++) {
    kg_pencil *p = &d->pencil[b];
    const kg_vec3 turn = kg_vec3_scale(s->dt, kg_load3(s->v_end + 3 * b));
    const kg_mat3 E =
      kg_mat3_scale(s->dt, b == 0 ? kg_mat3_identity() : kg_so3_right_jacobian(turn));
    p->T = times(&d->S[b], &E);
    p->U = times(&d->psi[b], &E);
    p->W = times(&d->psi_dot[b], &E);
    add63(&p->U, 1.0, &d->S[b]);
    add63(&p->W, 1.0, &d->psi[b]);
    add63(&p->W, 1.0, &d->S_dot[b]);
    add63(&p->W, 1.0 / s->dt, &d->S[b]);
  }
}

/* dG/dv' at the point of the last call of residual */
static void jacobian(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  kg_tree_clear_external(d);
  for (int k = 0; k < s->contact_count; k++) {
    linearize_contact(s, &s->contacts[k]);
  }
  kg_tree_prepare(d);
  make_pencil(s);
  kg_tree_jacobian(d, &s->J);
  for (int b = 2; b <= d->n; b++) {
    kg_mat3 *own = &s->J.low[d->tree.start[b] + d->tree.depth[b]];
    for (int k = 0; k < 9; k += 4) {
      own->m[k] += s->def.joint_damping;
    }
  }
}

/* The links are where Newton left them, unless it ended on a rejected point. */
static void ensure_evaluated(kg_step *s, const double *x)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  if (!s->evaluated || memcmp(x, s->v_end, bytes) != 0) {
    (void)residual(s->G, x, s);
  }
}

static bool direction(double *p, const double *x, const double *G, void *user)
{
  kg_step *s = user;
  const int nv = s->def.body->nv;
  ensure_evaluated(s, x);
  jacobian(s);
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

/* |diag(M)^-1/2 G dt|, dynamics (19) */
static double merit(const kg_step *s, const double *G)
{
  double sum = 0.0;
  for (int k = 0; k < s->def.body->nv; k++) {
    sum += s->scale[k] * G[k] * s->scale[k] * G[k];
  }
  return sqrt(sum);
}

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
  *r = kg_newton_solve(hardness < 1.0 ? s->rough : s->newton, x, s->scale, residual, direction, s);
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
  (void)residual(s->G, x, s);
  return merit(s, s->G);
}

/* One plain step from (q, v) into (q_end, x); x: starting guess in. */
static bool solve_once(kg_step *s, const double *q, const double *v, double dt, double *x,
                       kg_step_report *report, double *worst)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  set_problem(s, q, v, s->tau, dt);
  set_scale(s);
  memcpy(s->x_start, x, bytes);
  kg_newton_report r =
    kg_newton_solve(s->def.scene ? s->plain : s->newton, x, s->scale, residual, direction, s);
  count_newton(report, &r);
  if (r.stop == KG_NEWTON_MAX_ITERATIONS && s->contact_count == 0) { /* in the air: go on */
    r = kg_newton_solve(s->newton, x, s->scale, residual, direction, s);
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
  for (int k = 0; k < count && (good || last); k++) {
    memcpy(s->x, s->v_sub, (size_t)body->nv * sizeof *v);
    good = solve_once(s, s->q_sub, s->v_sub, dt / count, s->x, report, &worst) && good;
    ensure_evaluated(s, s->x);
    memcpy(s->q_sub, s->q_end, (size_t)body->nq * sizeof *q);
    memcpy(s->v_sub, s->x, (size_t)body->nv * sizeof *v);
  }
  report->substeps = count;
  report->residual = worst;
  return good;
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
  ensure_evaluated(s, s->x);
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
  set_problem(s, q, v, tau, dt);
  if (report) {
    set_scale(s);
  }
  (void)residual(G, v_next, s);
  if (dG_dv_next) {
    jacobian(s);
    kg_tree_to_dense(&s->dynamics->tree, &s->J, dG_dv_next);
  }
  if (report) {
    *report = (kg_step_report){.substeps = 1,
                               .residual = merit(s, G),
                               .contact_count = s->contact_count,
                               .contacts = s->contacts};
    report->converged = report->residual <= s->def.tolerance;
  }
}
