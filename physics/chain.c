/* Motion of a body in the axes of its segments and its adjoint.
 *
 * Equation numbers: docs/theory/dynamics.md, section 7. x_bar: adjoint of x. For y = Q' x and a
 * rotation of Q by theta about the segment's axes, dy = y x theta, so theta gains y_bar x y; for
 * y = R x, dy = R (theta x x), and theta gains x x R' y_bar. */
#include "physics/chain.h"

#include "physics/physics.h"

#include <string.h>

static inline kg_vec3 plus(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_add(a, b);
}

static inline kg_vec3 cross(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_cross(a, b);
}

/* *sum += a */
static inline void gain(kg_vec3 *sum, kg_vec3 a)
{
  *sum = kg_vec3_add(*sum, a);
}

static inline void gain_at(double *sum, int block, kg_vec3 a)
{
  if (!sum) return;
  sum[3 * block] += a.x;
  sum[3 * block + 1] += a.y;
  sum[3 * block + 2] += a.z;
}

/* w x (w x r) */
static inline kg_vec3 centripetal(kg_vec3 w, kg_vec3 r)
{
  return kg_vec3_add_scaled(kg_vec3_scale(kg_vec3_dot(w, r), w), -kg_vec3_dot(w, w), r);
}

/* Adjoint of w in b . w x (w x r) */
static inline kg_vec3 centripetal_by_w(kg_vec3 w, kg_vec3 r, kg_vec3 b)
{
  const kg_vec3 sum = kg_vec3_add_scaled(kg_vec3_scale(kg_vec3_dot(w, r), b), kg_vec3_dot(w, b), r);
  return kg_vec3_add_scaled(sum, -2.0 * kg_vec3_dot(r, b), w);
}

static inline kg_vec3 symmetric_mul(const double s[6], kg_vec3 a)
{
  return kg_vec3_make(s[0] * a.x + s[3] * a.y + s[4] * a.z, s[3] * a.x + s[1] * a.y + s[5] * a.z,
                      s[4] * a.x + s[5] * a.y + s[2] * a.z);
}

void kg_chain_init(kg_chain *chain, const kg_body *body, kg_arena *arena)
{
  *chain = (kg_chain){.body = body, .n = body->segment_count};
  chain->links = KG_ARENA_ARRAY(arena, kg_chain_link, chain->n);
  chain->nu = KG_ARENA_ARRAY(arena, double, body->nv);
}

/* ---- from the root to the leaves --------------------------------------------------------------*/

void kg_chain_pose(kg_chain *chain, const double *q)
{
  for (int i = 0; i < chain->n; i++) {
    const kg_segment *s = &chain->body->segments[i];
    kg_chain_link *l = &chain->links[i];
    l->Q = kg_quat_matrix(kg_state_quat(q, i));
    if (i == 0) {
      l->R = l->Q;
      l->p = kg_load3(q);
    } else {
      const kg_chain_link *up = &chain->links[s->parent];
      l->R = kg_mat3_mul(up->R, l->Q);
      l->p = plus(up->p, kg_mat3_mul_vec(up->R, s->offset));
    }
  }
}

/* (A1) */
void kg_chain_velocity(kg_chain *chain, const double *v)
{
  for (int i = 0; i < chain->n; i++) {
    const kg_segment *s = &chain->body->segments[i];
    kg_chain_link *l = &chain->links[i];
    const kg_vec3 own = kg_load3(v + 3 + 3 * i);
    if (i == 0) {
      l->w_in = kg_vec3_make(0.0, 0.0, 0.0);
      l->w = own;
      l->v = kg_mat3_mul_vec_t(l->Q, kg_load3(v));
    } else {
      const kg_chain_link *up = &chain->links[s->parent];
      l->w_in = kg_mat3_mul_vec_t(l->Q, up->w);
      l->w = plus(l->w_in, own);
      l->v = kg_mat3_mul_vec_t(l->Q, plus(up->v, cross(up->w, s->offset)));
    }
  }
}

/* (A2) */
void kg_chain_acceleration(kg_chain *chain, const double *v, const double *a, kg_vec3 gravity)
{
  for (int i = 0; i < chain->n; i++) {
    const kg_segment *s = &chain->body->segments[i];
    kg_chain_link *l = &chain->links[i];
    const kg_vec3 own = kg_load3(a + 3 + 3 * i);
    if (i == 0) {
      l->alpha_in = kg_vec3_make(0.0, 0.0, 0.0);
      l->alpha = own;
      l->a = kg_mat3_mul_vec_t(l->Q, kg_vec3_sub(kg_load3(a), gravity));
    } else {
      const kg_chain_link *up = &chain->links[s->parent];
      l->alpha_in = kg_mat3_mul_vec_t(l->Q, up->alpha);
      l->alpha = plus(plus(l->alpha_in, own), cross(l->w_in, kg_load3(v + 3 + 3 * i)));
      const kg_vec3 moved =
        plus(up->a, plus(cross(up->alpha, s->offset), centripetal(up->w, s->offset)));
      l->a = kg_mat3_mul_vec_t(l->Q, moved);
    }
  }
}

/* (A3) */
void kg_chain_field(kg_chain *chain, const double *lambda)
{
  for (int i = 0; i < chain->n; i++) {
    const kg_segment *s = &chain->body->segments[i];
    kg_chain_link *l = &chain->links[i];
    const kg_vec3 own = kg_load3(lambda + 3 + 3 * i);
    if (i == 0) {
      l->mu_in = kg_vec3_make(0.0, 0.0, 0.0);
      l->mu = own;
      l->pi = kg_mat3_mul_vec_t(l->Q, kg_load3(lambda));
    } else {
      const kg_chain_link *up = &chain->links[s->parent];
      l->mu_in = kg_mat3_mul_vec_t(l->Q, up->mu);
      l->mu = plus(l->mu_in, own);
      l->pi = kg_mat3_mul_vec_t(l->Q, plus(up->pi, cross(up->mu, s->offset)));
    }
  }
}

/* ---- what is differentiated -------------------------------------------------------------------*/

void kg_chain_clear(kg_chain *chain)
{
  for (int i = 0; i < chain->n; i++) {
    memset(&chain->links[i].bar, 0, sizeof chain->links[i].bar);
  }
}

/* mu . (I alpha + w x I w) by the six numbers of I */
static void inertia_gradient(double *bar, const kg_chain_link *l)
{
  const kg_vec3 m = l->mu, a = l->alpha, w = l->w, x = cross(l->mu, l->w);
  bar[0] += m.x * a.x + x.x * w.x;
  bar[1] += m.y * a.y + x.y * w.y;
  bar[2] += m.z * a.z + x.z * w.z;
  bar[3] += m.x * a.y + m.y * a.x + x.x * w.y + x.y * w.x;
  bar[4] += m.x * a.z + m.z * a.x + x.x * w.z + x.z * w.x;
  bar[5] += m.y * a.z + m.z * a.y + x.y * w.z + x.z * w.y;
}

static void body_gradient(const kg_body_gradient *bar, int i, double mass, const kg_chain_link *l,
                          kg_vec3 c_ddot, kg_vec3 gamma)
{
  if (bar->mass) {
    bar->mass[i] += kg_vec3_dot(gamma, c_ddot);
  }
  const kg_vec3 by_com =
    plus(plus(cross(gamma, l->alpha), centripetal(l->w, gamma)), cross(c_ddot, l->mu));
  gain_at(bar->com, i, kg_vec3_scale(mass, by_com));
  if (bar->inertia) {
    inertia_gradient(bar->inertia + 6 * i, l);
  }
}

/* (A4) phi_i = m gamma . c_ddot + mu . (I alpha + w x I w) */
static void inertial_link(kg_chain_link *l, const kg_segment *s, int i,
                          const kg_body_gradient *body_bar)
{
  const double *I = s->inertia;
  const kg_vec3 c_ddot = plus(l->a, plus(cross(l->alpha, s->com), centripetal(l->w, s->com)));
  const kg_vec3 gamma = plus(l->pi, cross(l->mu, s->com));
  const kg_vec3 F = kg_vec3_scale(s->mass, c_ddot), C = kg_vec3_scale(s->mass, gamma);
  const kg_vec3 Iw = symmetric_mul(I, l->w);
  const kg_vec3 N = plus(symmetric_mul(I, l->alpha), cross(l->w, Iw));
  kg_chain_adjoint *bar = &l->bar;
  gain(&bar->pi, F);
  gain(&bar->mu, plus(N, cross(s->com, F)));
  gain(&bar->a, C);
  gain(&bar->alpha, plus(cross(s->com, C), symmetric_mul(I, l->mu)));
  gain(&bar->w, centripetal_by_w(l->w, s->com, C));
  gain(&bar->w, plus(cross(Iw, l->mu), symmetric_mul(I, cross(l->mu, l->w))));
  if (body_bar) {
    body_gradient(body_bar, i, s->mass, l, c_ddot, gamma);
  }
}

void kg_chain_inertial(kg_chain *chain, const kg_body_gradient *body_bar)
{
  for (int i = 0; i < chain->n; i++) {
    inertial_link(&chain->links[i], &chain->body->segments[i], i, body_bar);
  }
}

/* (A5) x = p + R s, u = R (v + w x s), xi = R (pi + mu x s) */
void kg_chain_point(kg_chain *chain, int i, kg_vec3 s, const kg_vec3 *x_bar, const kg_vec3 *u_bar,
                    const kg_vec3 *xi_bar, double *s_bar)
{
  kg_chain_link *l = &chain->links[i];
  kg_chain_adjoint *bar = &l->bar;
  if (x_bar) {
    const kg_vec3 x = kg_mat3_mul_vec_t(l->R, *x_bar);
    gain(&bar->turn, cross(s, x));
    gain(&bar->p, x);
    gain_at(s_bar, 0, x);
  }
  if (u_bar) {
    const kg_vec3 u = kg_mat3_mul_vec_t(l->R, *u_bar);
    gain(&bar->turn, cross(plus(l->v, cross(l->w, s)), u));
    gain(&bar->v, u);
    gain(&bar->w, cross(s, u));
    gain_at(s_bar, 0, cross(u, l->w));
  }
  if (xi_bar) {
    const kg_vec3 xi = kg_mat3_mul_vec_t(l->R, *xi_bar);
    gain(&bar->turn, cross(plus(l->pi, cross(l->mu, s)), xi));
    gain(&bar->pi, xi);
    gain(&bar->mu, cross(s, xi));
    gain_at(s_bar, 0, cross(xi, l->mu));
  }
}

void kg_chain_joint(kg_chain *chain, int i, const kg_vec3 *p_bar, const kg_vec3 *v_bar,
                    const kg_vec3 *a_bar)
{
  kg_chain_link *l = &chain->links[i];
  if (p_bar) {
    gain(&l->bar.p, kg_mat3_mul_vec_t(l->R, *p_bar));
  }
  if (v_bar) {
    const kg_vec3 v = kg_mat3_mul_vec_t(l->R, *v_bar);
    gain(&l->bar.v, v);
    gain(&l->bar.turn, cross(l->v, v));
  }
  if (a_bar) {
    const kg_vec3 a = kg_mat3_mul_vec_t(l->R, *a_bar);
    gain(&l->bar.a, a);
    gain(&l->bar.turn, cross(l->a, a));
  }
}

void kg_chain_force(kg_chain *chain, int i, kg_vec3 s, kg_vec3 f)
{
  kg_chain_link *l = &chain->links[i];
  const kg_vec3 own = kg_mat3_mul_vec_t(l->R, f);
  gain(&l->bar.pi, own);
  gain(&l->bar.mu, cross(s, own));
}

/* ---- from the leaves to the root --------------------------------------------------------------*/

static void return_field(kg_chain_link *l, kg_chain_link *up, kg_vec3 r, kg_vec3 *turn,
                         kg_vec3 *r_bar)
{
  gain(turn, plus(cross(l->bar.mu, l->mu_in), cross(l->bar.pi, l->pi)));
  const kg_vec3 pi = kg_mat3_mul_vec(l->Q, l->bar.pi);
  gain(&up->bar.pi, pi);
  gain(&up->bar.mu, plus(kg_mat3_mul_vec(l->Q, l->bar.mu), cross(r, pi)));
  gain(r_bar, cross(pi, up->mu));
}

/* own: the joint's angular velocity. bar.w of the link must be complete but for this. */
static void return_acceleration(kg_chain_link *l, kg_chain_link *up, kg_vec3 r, kg_vec3 own,
                                kg_vec3 *turn, kg_vec3 *r_bar)
{
  const kg_vec3 a = kg_mat3_mul_vec(l->Q, l->bar.a), through_joint = cross(own, l->bar.alpha);
  gain(turn, plus(cross(l->bar.alpha, l->alpha_in), cross(l->bar.a, l->a)));
  gain(turn, cross(through_joint, l->w_in));
  gain(&up->bar.a, a);
  gain(&up->bar.alpha, plus(kg_mat3_mul_vec(l->Q, l->bar.alpha), cross(r, a)));
  gain(&up->bar.w, kg_mat3_mul_vec(l->Q, through_joint));
  gain(&up->bar.w, centripetal_by_w(up->w, r, a));
  gain(r_bar, plus(cross(a, up->alpha), centripetal(up->w, a)));
}

static void return_rate(kg_chain_link *l, kg_chain_link *up, kg_vec3 *turn)
{
  gain(turn, cross(l->bar.w, l->w_in));
  gain(&up->bar.w, kg_mat3_mul_vec(l->Q, l->bar.w));
}

static void return_velocity(kg_chain_link *l, kg_chain_link *up, kg_vec3 r, kg_vec3 *turn,
                            kg_vec3 *r_bar)
{
  const kg_vec3 v = kg_mat3_mul_vec(l->Q, l->bar.v);
  gain(turn, cross(l->bar.v, l->v));
  gain(&up->bar.v, v);
  gain(&up->bar.w, cross(r, v));
  gain(r_bar, cross(v, up->w));
}

static void return_pose(kg_chain_link *l, kg_chain_link *up, kg_vec3 r, kg_vec3 *turn,
                        kg_vec3 *r_bar)
{
  const kg_vec3 p = kg_mat3_mul_vec(l->Q, l->bar.p);
  gain(turn, l->bar.turn);
  gain(&up->bar.p, p);
  gain(&up->bar.turn, plus(kg_mat3_mul_vec(l->Q, l->bar.turn), cross(r, p)));
  gain(r_bar, p);
}

/* what joint i adds itself */
static void return_joint(const kg_chain_link *l, int parts, int i, const kg_chain_gradient *out)
{
  if (parts & (KG_CHAIN_VELOCITY | KG_CHAIN_ACCELERATION)) {
    gain_at(out->v, 1 + i, l->bar.w);
  }
  if (parts & KG_CHAIN_ACCELERATION) {
    gain_at(out->v, 1 + i, cross(l->bar.alpha, l->w_in));
    gain_at(out->a, 1 + i, l->bar.alpha);
  }
  if (parts & KG_CHAIN_FIELD) {
    gain_at(out->lambda, 1 + i, l->bar.mu);
  }
}

static void return_root(const kg_chain_link *l, int parts, const kg_chain_gradient *out)
{
  kg_vec3 turn = {0.0, 0.0, 0.0};
  if (parts & KG_CHAIN_POSE) {
    gain(&turn, l->bar.turn);
    gain_at(out->q, 0, kg_mat3_mul_vec(l->Q, l->bar.p));
  }
  if (parts & KG_CHAIN_VELOCITY) {
    gain(&turn, cross(l->bar.v, l->v));
    gain_at(out->v, 0, kg_mat3_mul_vec(l->Q, l->bar.v));
  }
  if (parts & KG_CHAIN_ACCELERATION) {
    gain(&turn, cross(l->bar.a, l->a));
    gain_at(out->a, 0, kg_mat3_mul_vec(l->Q, l->bar.a));
  }
  if (parts & KG_CHAIN_FIELD) {
    gain(&turn, cross(l->bar.pi, l->pi));
    gain_at(out->lambda, 0, kg_mat3_mul_vec(l->Q, l->bar.pi));
  }
  gain_at(out->q, 1, turn);
}

/* (A6) */
void kg_chain_return(kg_chain *chain, int parts, const double *v, const kg_chain_gradient *out)
{
  for (int i = chain->n - 1; i > 0; i--) {
    kg_chain_link *l = &chain->links[i], *up = &chain->links[chain->body->segments[i].parent];
    const kg_vec3 r = chain->body->segments[i].offset;
    kg_vec3 turn = {0.0, 0.0, 0.0}, r_bar = {0.0, 0.0, 0.0};
    if (parts & KG_CHAIN_POSE) return_pose(l, up, r, &turn, &r_bar);
    if (parts & KG_CHAIN_VELOCITY) return_velocity(l, up, r, &turn, &r_bar);
    if (parts & KG_CHAIN_ACCELERATION)
      return_acceleration(l, up, r, kg_load3(v + 3 + 3 * i), &turn, &r_bar);
    if (parts & (KG_CHAIN_VELOCITY | KG_CHAIN_ACCELERATION)) return_rate(l, up, &turn);
    if (parts & KG_CHAIN_FIELD) return_field(l, up, r, &turn, &r_bar);
    return_joint(l, parts, i, out);
    gain_at(out->q, 1 + i, turn);
    gain_at(out->offset, i, r_bar);
  }
  return_joint(&chain->links[0], parts, 0, out);
  return_root(&chain->links[0], parts, out);
}
