/* A second opinion on the equations of motion, for complex steps: Newton and Euler for every
 * segment in world axes, in double complex, by the textbook; generalised forces by virtual power
 * with explicit Jacobians. Shares no code and no formula in segment axes with the library. Every
 * number that is differentiated by is a complex one: pose, velocities, masses, lengths, the law of
 * contact.
 *
 * Functions that are only piecewise analytic choose their branch by real parts, so that a complex
 * step gives the derivative of the branch: one-sided at a kink. */
#ifndef TESTS_COMPLEX_BODY_H
#define TESTS_COMPLEX_BODY_H

#include "fixture_body.h"

#include "kinegrad/step.h"

#include <complex.h>
#undef I /* an inertia in the formulas; the imaginary unit is _Complex_I */

typedef double complex cplx;
typedef struct c3 {
  cplx x, y, z;
} c3;
typedef struct c33 {
  cplx m[9];
} c33;

static inline c3 c_real(kg_vec3 a)
{
  return (c3){a.x, a.y, a.z};
}

static inline c3 c_load(const cplx *p)
{
  return (c3){p[0], p[1], p[2]};
}

static inline c3 c_add(c3 a, c3 b)
{
  return (c3){a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline c3 c_scale(cplx s, c3 a)
{
  return (c3){s * a.x, s * a.y, s * a.z};
}

static inline c3 c_sub(c3 a, c3 b)
{
  return c_add(a, c_scale(-1.0, b));
}

static inline cplx c_dot(c3 a, c3 b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline c3 c_cross(c3 a, c3 b)
{
  return (c3){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static inline c3 c_apply(const c33 *A, c3 a)
{
  const cplx *m = A->m;
  return (c3){m[0] * a.x + m[1] * a.y + m[2] * a.z, m[3] * a.x + m[4] * a.y + m[5] * a.z,
              m[6] * a.x + m[7] * a.y + m[8] * a.z};
}

static inline c33 c_transposed(const c33 *A)
{
  const cplx *m = A->m;
  return (c33){{m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]}};
}

static inline c33 c_product(const c33 *A, const c33 *B)
{
  c33 C;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      C.m[3 * i + j] = 0.0;
      for (int k = 0; k < 3; k++) {
        C.m[3 * i + j] += A->m[3 * i + k] * B->m[3 * k + j];
      }
    }
  }
  return C;
}

/* exp([r]) by scaling and squaring of the power series: nothing to divide by at zero */
static inline c33 c_exp(c3 r)
{
  const cplx s = 1.0 / 64.0;
  const c33 X = {{0.0, -s * r.z, s * r.y, s * r.z, 0.0, -s * r.x, -s * r.y, s * r.x, 0.0}};
  c33 sum = {{1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}}, term = sum;
  for (int k = 1; k < 14; k++) {
    term = c_product(&term, &X);
    for (int e = 0; e < 9; e++) {
      term.m[e] /= k;
      sum.m[e] += term.m[e];
    }
  }
  for (int k = 0; k < 6; k++) {
    sum = c_product(&sum, &sum);
  }
  return sum;
}

/* Everything a residual depends on. The pose is given by matrices; `turn` moves it: Q
 * exp([turn]). */
typedef struct complex_body {
  int n, point_count;
  int parent[MAX_NV];
  cplx mass[MAX_NV];
  c3 com[MAX_NV], offset[MAX_NV];
  cplx inertia[MAX_NV][6];
  int segment[256];
  c3 point[256];
  c3 gravity;
} complex_body;

static inline complex_body complex_body_of(const kg_body *body)
{
  complex_body c = {.n = body->segment_count, .point_count = body->point_count};
  c.gravity = (c3){0.0, -9.8, 0.0};
  assert_true(c.point_count <= 256);
  for (int i = 0; i < c.n; i++) {
    const kg_segment *s = &body->segments[i];
    c.parent[i] = s->parent;
    c.mass[i] = s->mass;
    c.com[i] = c_real(s->com);
    c.offset[i] = c_real(s->offset);
    for (int k = 0; k < 6; k++) {
      c.inertia[i][k] = s->inertia[k];
    }
  }
  for (int k = 0; k < c.point_count; k++) {
    c.segment[k] = body->points[k].segment;
    c.point[k] = c_real(body->points[k].p);
  }
  return c;
}

typedef struct complex_pose {
  c3 root;
  c33 Q[MAX_NV], R[MAX_NV];
  c3 p[MAX_NV];
} complex_pose;

static inline c33 c_quat(const double *q)
{
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  return (c33){{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
                2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
                2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}};
}

static inline complex_pose complex_pose_of(const complex_body *b, const double *q)
{
  complex_pose s;
  s.root = (c3){q[0], q[1], q[2]};
  for (int i = 0; i < b->n; i++) {
    s.Q[i] = c_quat(q + 3 + 4 * i);
  }
  return s;
}

/* s (+) scale d, then places in the world */
static inline void complex_move(const complex_body *b, complex_pose *s, cplx scale, const cplx *d)
{
  s->root = c_add(s->root, c_scale(scale, c_load(d)));
  for (int i = 0; i < b->n; i++) {
    const c33 turn = c_exp(c_scale(scale, c_load(d + 3 + 3 * i)));
    s->Q[i] = c_product(&s->Q[i], &turn);
  }
}

static inline void complex_place(const complex_body *b, complex_pose *s)
{
  for (int i = 0; i < b->n; i++) {
    const int up = b->parent[i];
    s->R[i] = i == 0 ? s->Q[0] : c_product(&s->R[up], &s->Q[i]);
    s->p[i] = i == 0 ? s->root : c_add(s->p[up], c_apply(&s->R[up], b->offset[i]));
  }
}

/* angular velocity of every segment and velocity of every joint, in the world, for rates v */
static inline void complex_rates(const complex_body *b, const complex_pose *s, const cplx *v, c3 *w,
                                 c3 *p_dot)
{
  for (int i = 0; i < b->n; i++) {
    const int up = b->parent[i];
    w[i] = c_apply(&s->R[i], c_load(v + 3 + 3 * i));
    p_dot[i] = c_load(v);
    if (i > 0) {
      w[i] = c_add(w[i], w[up]);
      p_dot[i] = c_add(p_dot[up], c_cross(w[up], c_sub(s->p[i], s->p[up])));
    }
  }
}

/* true accelerations of joints and segments in the world */
static inline void complex_accelerations(const complex_body *b, const complex_pose *s,
                                         const cplx *v, const cplx *a, c3 *alpha, c3 *p_ddot)
{
  c3 w[MAX_NV], p_dot[MAX_NV];
  complex_rates(b, s, v, w, p_dot);
  for (int i = 0; i < b->n; i++) {
    const int up = b->parent[i];
    alpha[i] = c_apply(&s->R[i], c_load(a + 3 + 3 * i));
    p_ddot[i] = c_load(a);
    if (i > 0) {
      const c3 arm = c_sub(s->p[i], s->p[up]);
      const c3 own = c_apply(&s->R[i], c_load(v + 3 + 3 * i));
      /* d/dt (R_i omega) = R_i omega_dot + w_i x R_i omega, and omega x omega = 0 */
      alpha[i] = c_add(c_add(alpha[up], alpha[i]), c_cross(w[up], own));
      p_ddot[i] =
        c_add(p_ddot[up], c_add(c_cross(alpha[up], arm), c_cross(w[up], c_cross(w[up], arm))));
    }
  }
}

/* out[nv] += sign * J' (force f at world point x of segment i, moment n): along the path to the
 * root */
static inline void complex_project(const complex_body *b, const complex_pose *s, int i, c3 x, c3 f,
                                   c3 n, double sign, cplx *out)
{
  out[0] += sign * f.x;
  out[1] += sign * f.y;
  out[2] += sign * f.z;
  for (int k = i; k >= 0; k = b->parent[k]) {
    const c33 Rt = c_transposed(&s->R[k]);
    const c3 t = c_apply(&Rt, c_add(n, c_cross(c_sub(x, s->p[k]), f)));
    out[3 + 3 * k] += sign * t.x;
    out[4 + 3 * k] += sign * t.y;
    out[5 + 3 * k] += sign * t.z;
    if (k == 0) break;
  }
}

static inline void complex_inverse(const complex_body *b, const complex_pose *s, const cplx *v,
                                   const cplx *a, cplx *tau)
{
  c3 w[MAX_NV], p_dot[MAX_NV], alpha[MAX_NV], p_ddot[MAX_NV];
  complex_rates(b, s, v, w, p_dot);
  complex_accelerations(b, s, v, a, alpha, p_ddot);
  for (int k = 0; k < 3 + 3 * b->n; k++) {
    tau[k] = 0.0;
  }
  for (int i = 0; i < b->n; i++) {
    const cplx *I = b->inertia[i];
    const c33 J = {{I[0], I[3], I[4], I[3], I[1], I[5], I[4], I[5], I[2]}};
    const c33 Rt = c_transposed(&s->R[i]);
    const c33 RJ = c_product(&s->R[i], &J), world = c_product(&RJ, &Rt);
    const c3 arm = c_apply(&s->R[i], b->com[i]);
    c3 c_ddot = c_add(p_ddot[i], c_add(c_cross(alpha[i], arm), c_cross(w[i], c_cross(w[i], arm))));
    c_ddot = c_sub(c_ddot, b->gravity);
    const c3 momentum = c_apply(&world, w[i]);
    const c3 moment = c_add(c_apply(&world, alpha[i]), c_cross(w[i], momentum));
    complex_project(b, s, i, c_add(s->p[i], arm), c_scale(b->mass[i], c_ddot), moment, 1.0, tau);
  }
}

/* ---- the equation of a step -------------------------------------------------------------------*/

typedef struct complex_joint {
  cplx stiffness, damping, limit_stiffness;
  kg_quat rest;
  double low[3], high[3];
} complex_joint;

/* G and all it depends on. Ground: the plane y = 0 and, with a radius, a ball that may move; both
 * covered. */
typedef struct complex_step {
  complex_body body;
  const double *q;
  cplx turn[MAX_NV]; /* moves q */
  cplx v[MAX_NV], tau[MAX_NV], v_end[MAX_NV];
  double dt;
  cplx contact[6];
  kg_vec3 ball;
  double radius;
  kg_vec3 ball_velocity, ball_spin; /* of and about its centre */
  kg_ground cover;
  cplx joint_damping;
  bool has_passive;
  complex_joint joint[MAX_NV];
} complex_step;

typedef struct complex_surface {
  cplx phi;
  c3 normal, velocity;
} complex_surface;

static inline complex_surface complex_distance(const complex_step *s, c3 x)
{
  complex_surface near = {x.y, {0.0, 1.0, 0.0}, {0.0, 0.0, 0.0}};
  if (s->radius > 0.0) {
    const c3 r = c_sub(x, c_real(s->ball));
    const cplx length = csqrt(c_dot(r, r));
    if (creal(length) - s->radius < creal(near.phi)) {
      near = (complex_surface){length - s->radius, c_scale(1.0 / length, r),
                               c_add(c_real(s->ball_velocity), c_cross(c_real(s->ball_spin), r))};
    }
  }
  return near;
}

/* docs/theory/contact.md, (1) to (5) with (1a), written from there */
static inline cplx complex_ramp(cplx y)
{
  return creal(y) >= 0.1 ? y : creal(y) <= -0.1 ? 0.0 : (y + 0.1) * (y + 0.1) / 0.4;
}

static inline cplx complex_soft_force(const complex_step *s, cplx phi)
{
  const cplx layer = s->contact[0], p = s->cover.thickness + layer - phi;
  return creal(p) < creal(layer) ? s->cover.stiffness * p * p / (2.0 * layer)
                                 : s->cover.stiffness * (p - layer / 2.0);
}

static inline cplx complex_hard_force(const complex_step *s, cplx phi)
{
  const cplx layer = s->contact[0], F = s->contact[1], share = s->contact[2];
  if (creal(phi) >= creal(layer)) return 0.0;
  if (creal(phi) >= creal(share * layer)) return F * (layer - phi) * (layer - phi) / (layer * phi);
  const cplx p = share * layer, d = layer - p;
  const cplx slope = F / layer * (-2.0 * d / p - d * d / (p * p));
  return F * d * d / (layer * p) + slope * (phi - p);
}

static inline c3 complex_contact(const complex_step *s, c3 x, c3 u)
{
  const kg_ground *g = &s->cover;
  const cplx stick = s->contact[5], mu = g->friction >= 0.0 ? g->friction : s->contact[4];
  const complex_surface at = complex_distance(s, x);
  if (creal(at.phi) >= creal(s->contact[0]) + g->thickness) return (c3){0.0, 0.0, 0.0};
  u = c_sub(u, at.velocity);
  const cplx phi_dot = c_dot(at.normal, u);
  const cplx hard = complex_hard_force(s, at.phi) * complex_ramp(1.0 - s->contact[3] * phi_dot);
  const cplx soft = complex_soft_force(s, at.phi) * complex_ramp(1.0 - g->damping * phi_dot);
  const c3 u_t = c_sub(u, c_scale(phi_dot, at.normal));
  const cplx speed = csqrt(c_dot(u_t, u_t));
  const cplx z = speed / stick;
  const cplx k = creal(z) < 1.0 ? (2.0 - z) / stick : 1.0 / speed;
  return c_scale(hard + soft, c_sub(at.normal, c_scale(mu * k, u_t)));
}

/* Rotation vector of the matrix, below half a turn: from its antisymmetric part and its trace */
static inline c3 c_log(const c33 *R)
{
  const cplx *m = R->m;
  const c3 twice_sine = {m[7] - m[5], m[2] - m[6], m[3] - m[1]};
  const cplx cosine = 0.5 * (m[0] + m[4] + m[8] - 1.0);
  const cplx sine = 0.5 * csqrt(c_dot(twice_sine, twice_sine));
  /* of a complex sine and cosine to first order in the imaginary parts, which are tiny: da = cos ds
   * - sin dc */
  const double sn = creal(sine), cs = creal(cosine);
  const cplx angle = atan2(sn, cs) + _Complex_I * (cs * cimag(sine) - sn * cimag(cosine));
  return c_scale(0.5 * angle / sine, twice_sine);
}

/* dE/dr of kg_joint_passive */
static inline c3 complex_spring(const complex_joint *j, c3 r)
{
  cplx g[3] = {r.x, r.y, r.z};
  for (int k = 0; k < 3; k++) {
    const cplx x = g[k];
    g[k] = j->stiffness * x;
    if (creal(x) > j->high[k]) g[k] += j->limit_stiffness * (x - j->high[k]) * (x - j->high[k]);
    if (creal(x) < j->low[k]) g[k] -= j->limit_stiffness * (x - j->low[k]) * (x - j->low[k]);
  }
  return (c3){g[0], g[1], g[2]};
}

/* Torque t with t . d = dE for a turn d of the joint: g' dr/dd by the left-invariant series
 * ad / (1 - exp(-ad)) = 1 + ad / 2 + ad^2 / 12 - ..., summed by solving Jr(r) (dr/dd) = 1 for
 * Jr = sum (-ad)^k / (k+1)!. */
static inline c3 complex_passive(const complex_joint *j, const c33 *Q)
{
  const double rest[4] = {j->rest.w, j->rest.x, j->rest.y, j->rest.z};
  const c33 at_rest = c_quat(rest), back = c_transposed(&at_rest);
  const c33 relative = c_product(&back, Q);
  const c3 r = c_log(&relative);
  const c3 g = complex_spring(j, r);
  const c33 ad = {{0.0, r.z, -r.y, -r.z, 0.0, r.x, r.y, -r.x, 0.0}}; /* -[r] */
  c33 Jr = {{1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}}, term = Jr;
  for (int k = 1; k < 30; k++) {
    term = c_product(&term, &ad);
    for (int e = 0; e < 9; e++) {
      term.m[e] /= k + 1;
      Jr.m[e] += term.m[e];
    }
  }
  /* Jr' t = g by Cramer's rule: rows of Jr' are columns of Jr */
  const c3 a = {Jr.m[0], Jr.m[1], Jr.m[2]}, b = {Jr.m[3], Jr.m[4], Jr.m[5]},
           c = {Jr.m[6], Jr.m[7], Jr.m[8]};
  const cplx det = c_dot(a, c_cross(b, c));
  return (c3){c_dot(g, c_cross(b, c)) / det, c_dot(g, c_cross(c, a)) / det,
              c_dot(g, c_cross(a, b)) / det};
}

static inline void complex_residual(const complex_step *s, cplx *G)
{
  static complex_pose pose; /* large */
  const complex_body *b = &s->body;
  cplx a[MAX_NV];
  c3 w[MAX_NV], p_dot[MAX_NV];
  const int nv = 3 + 3 * b->n;
  pose = complex_pose_of(b, s->q);
  complex_move(b, &pose, 1.0, s->turn);
  complex_move(b, &pose, s->dt, s->v_end);
  complex_place(b, &pose);
  for (int k = 0; k < nv; k++) {
    a[k] = (s->v_end[k] - s->v[k]) / s->dt;
  }
  complex_inverse(b, &pose, s->v_end, a, G);
  for (int k = 0; k < nv; k++) {
    G[k] -= s->tau[k];
    G[k] += k >= 6 ? s->joint_damping * s->v_end[k] : 0.0;
  }
  complex_rates(b, &pose, s->v_end, w, p_dot);
  for (int k = 0; k < b->point_count; k++) {
    const int i = b->segment[k];
    const c3 arm = c_apply(&pose.R[i], b->point[k]), x = c_add(pose.p[i], arm);
    const c3 f = complex_contact(s, x, c_add(p_dot[i], c_cross(w[i], arm)));
    complex_project(b, &pose, i, x, f, (c3){0.0, 0.0, 0.0}, -1.0, G);
  }
  for (int i = 1; i < b->n && s->has_passive; i++) {
    const complex_joint *j = &s->joint[i];
    const c3 t = complex_passive(j, &pose.Q[i]);
    G[3 + 3 * i] += t.x + j->damping * s->v_end[3 + 3 * i];
    G[4 + 3 * i] += t.y + j->damping * s->v_end[4 + 3 * i];
    G[5 + 3 * i] += t.z + j->damping * s->v_end[5 + 3 * i];
  }
}

/* Tangent of q' = q (+) turn (+) dt v_end at its real value: imaginary parts only. */
static inline void complex_end_tangent(const complex_step *s, double *out)
{
  static complex_pose pose, real_pose;
  const complex_body *b = &s->body;
  cplx real_end[MAX_NV];
  for (int k = 0; k < 3 + 3 * b->n; k++) {
    real_end[k] = creal(s->v_end[k]);
  }
  pose = real_pose = complex_pose_of(b, s->q);
  complex_move(b, &pose, 1.0, s->turn);
  complex_move(b, &pose, s->dt, s->v_end);
  complex_move(b, &real_pose, s->dt, real_end);
  out[0] = cimag(pose.root.x);
  out[1] = cimag(pose.root.y);
  out[2] = cimag(pose.root.z);
  for (int i = 0; i < b->n; i++) {
    const c33 back = c_transposed(&real_pose.Q[i]);
    const c33 turn = c_product(&back, &pose.Q[i]);
    out[3 + 3 * i] = cimag(turn.m[7]);
    out[4 + 3 * i] = cimag(turn.m[2]);
    out[5 + 3 * i] = cimag(turn.m[3]);
  }
}

static inline complex_step complex_step_of(const kg_step_def *def, const double *q, const double *v,
                                           const double *tau, double dt, const double *v_end)
{
  complex_step s = {.body = complex_body_of(def->body), .q = q, .dt = dt};
  const kg_contact_params *c = &def->contact;
  const cplx law[6] = {c->layer, c->force, c->floor_share, c->damping, c->friction, c->stick};
  memcpy(s.contact, law, sizeof law);
  s.cover = kg_ground_default();
  s.joint_damping = def->joint_damping;
  s.body.gravity = c_real(def->gravity);
  for (int k = 0; k < def->body->nv; k++) {
    s.v[k] = v[k];
    s.tau[k] = tau ? tau[k] : 0.0;
    s.v_end[k] = v_end[k];
  }
  for (int i = 0; i < s.body.n && def->passive; i++) {
    const kg_joint_passive *p = &def->passive[i];
    s.has_passive = true;
    s.joint[i] = (complex_joint){p->stiffness,
                                 p->damping,
                                 p->limit_stiffness,
                                 p->rest,
                                 {p->limit_low.x, p->limit_low.y, p->limit_low.z},
                                 {p->limit_high.x, p->limit_high.y, p->limit_high.z}};
  }
  return s;
}

#endif
