/* The equation of one backward Euler step: contacts, residual and exact Jacobian.
 *
 * Equation numbers: docs/theory/dynamics.md for (1) to (19), docs/theory/contact.md where "contact"
 * is written before the number. */
#include "physics/step_problem.h"

#include "physics/kernels/kernels.h"
#include "physics/passive.h"
#include "physics/physics.h"

#include <string.h>

/* kg m^2: keeps the scale finite for a joint that moves nothing. */
static const double SMALLEST_INERTIA = 1e-12;

void kg_step_set_contact(kg_step *step, const kg_contact_params *contact)
{
  KG_ASSERT(kg_contact_params_are_valid(contact));
  step->def.contact = step->contact = *contact;
  step->evaluated = false;
}

void kg_step_refresh(kg_step *step)
{
  kg_dynamics_refresh(step->dynamics);
  near_points_refresh(&step->points, step->def.body);
  step->evaluated = false;
}

/* ---- contact ----------------------------------------------------------------------------------*/

kg_link_height kg_step_link_height(const kg_step *s, int i)
{
  const kg_link *l = &s->dynamics->links[i];
  const kg_sdf_shape *plane = kg_only_plane(s->def.scene);
  if (!plane) return (kg_link_height){-INFINITY, {0.0, 0.0, 0.0}};
  const kg_vec3 p = kg_vec3_add(s->dynamics->origin, l->p);
  return (kg_link_height){kg_vec3_dot(plane->b, kg_vec3_sub(p, plane->a)),
                          kg_mat3_mul_vec_t(l->R, plane->b)};
}

static void collide_points(kg_step *s, const segment_ball *ball, const kg_link_height *height)
{
  const kg_body *body = s->def.body;
  const kg_vec3 O = s->dynamics->origin;
  kg_link *l = &s->dynamics->links[ball->segment];
  for (int k = ball->first; k < ball->first + ball->count; k++) {
    const int point = s->points.points[k];
    if (kg_is_above(height, body->points[point].p, s->contact.layer)) continue;
    const kg_vec3 x = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, body->points[point].p));
    kg_step_contact *c = &s->contacts[s->contact_count];
    c->x = kg_vec3_add(O, x);
    if (kg_contact_evaluate(&s->contact, s->def.scene, c->x, kg_point_velocity(l, x), false,
                            &c->force)) {
      c->point = point;
      s->contact_count++;
      l->external.n = kg_vec3_add(l->external.n, kg_vec3_cross(x, c->force.f));
      l->external.f = kg_vec3_add(l->external.f, c->force.f);
    }
  }
}

bool kg_step_is_far(const kg_step *s, const segment_ball *ball, const kg_link_height *height,
                    double margin)
{
  const kg_link *l = &s->dynamics->links[ball->segment];
  if (kg_only_plane(s->def.scene)) {
    return kg_is_above(height, ball->center, ball->radius + s->contact.layer + margin);
  }
  const kg_vec3 center = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, ball->center));
  const double way = kg_scene_surface(s->def.scene, kg_vec3_add(s->dynamics->origin, center));
  /* Phi changes by no more than the distance moved */
  return way > ball->radius + s->contact.layer + margin;
}

/* Contact list and external forces of the links at their pose and velocity. */
static void collide(kg_step *s)
{
  s->contact_count = 0;
  for (int i = 0; i < s->dynamics->n; i++) {
    s->dynamics->links[i].external = (kg_force){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  }
  for (int b = 0; b < s->points.count && s->def.scene; b++) {
    const segment_ball *ball = &s->points.balls[b];
    const kg_link_height height = kg_step_link_height(s, ball->segment);
    if (!kg_step_is_far(s, ball, &height, 0.0)) {
      collide_points(s, ball, &height);
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
  kg_composite *sum = kg_tree_load(s->dynamics, segment);
  const kg_vec3 x = kg_vec3_sub(c->x, s->dynamics->origin);
  const kg_vec3 u = kg_point_velocity(l, x);
  (void)kg_contact_evaluate(&s->contact, s->def.scene, c->x, u, true, &c->force);
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

void kg_step_set_problem(kg_step *s, const double *q, const double *v, const double *tau, double dt)
{
  s->q = q;
  s->v = v;
  s->tau = tau;
  s->dt = dt;
  s->evaluated = false;
}

/* diag(M(q))^-1/2 dt */
void kg_step_set_scale(kg_step *s)
{
  s->evaluated = false;
  kg_links_pose(s->dynamics, s->q);
  kg_links_mass_diagonal(s->dynamics, s->scale);
  for (int k = 0; k < s->def.body->nv; k++) {
    const double inertia = s->scale[k]; /* one that is not a number stays one */
    s->scale[k] = s->dt / sqrt(inertia < SMALLEST_INERTIA ? SMALLEST_INERTIA : inertia);
  }
}

/* (17) G(v') */
bool kg_step_evaluate(double *G, const double *v_end, void *user)
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
  kg_store3(s->q_end, kg_vec3_add(kg_load3(s->q), kg_load3(G)));
  d->kernels->integrate_joints(s->q_end + 3, s->q + 3, G + 3, body->segment_count);
  kg_links_move(d, s->q_end, v_end, s->a);
  collide(s);
  kg_step_project(s, G);
  return true;
}

/* G += passive torques of the ball joints at q_end, v_end */
static void add_passive(const kg_step *s, double *G)
{
  for (int k = 6; k < s->def.body->nv; k++) {
    G[k] += s->def.joint_damping * s->v_end[k];
  }
  for (int i = 1; i < s->def.body->segment_count && s->def.passive; i++) {
    const kg_joint_passive *p = &s->def.passive[i];
    double *own = G + 3 + 3 * i;
    const kg_vec3 w = kg_load3(s->v_end + 3 + 3 * i);
    const kg_vec3 spring = kg_passive_torque(p, kg_state_quat(s->q_end, i), NULL);
    kg_store3(own, kg_vec3_add(kg_load3(own), kg_vec3_add_scaled(spring, p->damping, w)));
  }
}

void kg_step_evaluate_start(kg_step *s)
{
  s->evaluated = false;
  kg_links_velocity(s->dynamics, s->v);
  collide(s);
}

/* G of the links' inertial and external forces */
void kg_step_project(kg_step *s, double *G)
{
  kg_links_project(s->dynamics, G);
  for (int k = 0; k < s->def.body->nv && s->tau; k++) {
    G[k] -= s->tau[k];
  }
  add_passive(s, G);
}

kg_mat3 kg_step_turn_by_rate(const kg_step *s, int b)
{
  if (b == 0) return kg_mat3_scale(s->dt, kg_mat3_identity());
  const kg_vec3 turn = kg_vec3_scale(s->dt, kg_load3(s->v_end + 3 * b));
  return kg_mat3_scale(s->dt, kg_so3_right_jacobian(turn));
}

/* (18) the pencil of v': the pose moves by dt Jr(dt w), the acceleration by 1/dt */
static void make_pencil(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  s->turns[0] = kg_step_turn_by_rate(s, 0);
  d->kernels->turns_by_rate(s->turns + 1, s->v_end + 3, s->dt, d->n);
  for (int b = 0; b <= d->n; b++) {
    kg_tree_pencil(d, b, &s->turns[b], 1.0, 1.0 / s->dt);
  }
}

/* J += the passive torques' part, diagonal blocks */
static void linearize_passive(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  const kg_mat3 one = kg_mat3_identity();
  for (int i = 1; i < d->n; i++) {
    if (s->def.joint_damping != 0.0) {
      kg_tree_add_diagonal(&d->tree, &s->J, i + 1, s->def.joint_damping, &one);
    }
    if (!s->def.passive) continue;
    const kg_joint_passive *p = &s->def.passive[i];
    kg_mat3 by_turn;
    (void)kg_passive_torque(p, kg_state_quat(s->q_end, i), &by_turn);
    const kg_mat3 by_rate = kg_mat3_mul(by_turn, kg_step_turn_by_rate(s, i + 1));
    kg_tree_add_diagonal(&d->tree, &s->J, i + 1, 1.0, &by_rate);
    kg_tree_add_diagonal(&d->tree, &s->J, i + 1, p->damping, &one);
  }
}

/* dG/dv' at the point of the last call of residual */
void kg_step_linearize(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  kg_tree_clear_external(d);
  for (int k = 0; k < s->contact_count; k++) {
    linearize_contact(s, &s->contacts[k]);
  }
  kg_step_assemble(s);
}

/* s->J from the links and from what the segments' sums hold of external forces */
void kg_step_assemble(kg_step *s)
{
  kg_dynamics *d = s->dynamics;
  kg_tree_prepare(d);
  make_pencil(s);
  kg_tree_jacobian(d, &s->J);
  linearize_passive(s);
}

void kg_step_linearize_pose(kg_step *s, kg_tree_matrix *P)
{
  kg_dynamics *d = s->dynamics;
  for (int b = 0; b <= d->n; b++) {
    d->pencil[b] = (kg_pencil){d->S[b], d->psi[b], d->psi_dot[b]};
  }
  kg_tree_jacobian(d, P);
  for (int i = 1; i < d->n && s->def.passive; i++) {
    kg_mat3 by_turn;
    (void)kg_passive_torque(&s->def.passive[i], kg_state_quat(s->q_end, i), &by_turn);
    kg_tree_add_diagonal(&d->tree, P, i + 1, 1.0, &by_turn);
  }
}

void kg_step_mass(kg_step *s, kg_tree_matrix *M)
{
  kg_dynamics *d = s->dynamics;
  for (int b = 0; b <= d->n; b++) {
    d->pencil[b] = (kg_pencil){.W = d->S[b]};
  }
  kg_tree_jacobian(d, M);
}

/* The links are where Newton left them, unless it ended on a rejected point. */
void kg_step_ensure_evaluated(kg_step *s, const double *x)
{
  const size_t bytes = (size_t)s->def.body->nv * sizeof *x;
  if (!s->evaluated || memcmp(x, s->v_end, bytes) != 0) {
    (void)kg_step_evaluate(s->G, x, s);
  }
}

/* |diag(M)^-1/2 G dt|, dynamics (19) */
double kg_step_merit(const kg_step *s, const double *G)
{
  double sum[3] = {0.0, 0.0, 0.0}; /* side by side: one would wait for itself */
  for (int k = 0; k < s->def.body->nv; k += 3) {
    for (int c = 0; c < 3; c++) {
      const double r = s->scale[k + c] * G[k + c];
      sum[c] += r * r;
    }
  }
  return sqrt(sum[0] + sum[1] + sum[2]);
}
