/* Kinematics and dynamics of a body of ball joints: recursive Newton-Euler, mass matrix, momentum
 * and the analytic derivatives of inverse dynamics.
 *
 * Equation numbers refer to docs/theory/dynamics.md.
 * [RBDA] R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008.
 * [SRW]  S. Singh, R. P. Russell, P. M. Wensing, Efficient analytical derivatives of rigid-body
 *        dynamics using spatial vector algebra, IEEE RA-L 7(2), 2022.
 *
 * World axes; all spatial quantities about O, the root position of the call's q, which does not
 * move while differentiating. [a] is the matrix of the cross product with a, R' the transpose. */
#include "physics/kernels/kernels.h"
#include "physics/physics.h"
#include "physics/tree.h"

#include <string.h>

/* ---- small matrices ---------------------------------------------------------------------------*/

static inline kg_mat3 symmetric(const double s[6])
{
  const kg_mat3 A = {{s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]}};
  return A;
}

static inline kg_vec3 symmetric_mul(const double s[6], kg_vec3 a)
{
  return kg_vec3_make(s[0] * a.x + s[3] * a.y + s[4] * a.z, s[3] * a.x + s[1] * a.y + s[5] * a.z,
                      s[4] * a.x + s[5] * a.y + s[2] * a.z);
}

/* ---- object -----------------------------------------------------------------------------------*/

/* Moments about the joint: I = I_com + m (c.c 1 - c c'). */
static void copy_model(kg_model *model, const kg_body *body)
{
  for (int i = 0; i < body->segment_count; i++) {
    const kg_segment *s = &body->segments[i];
    const kg_vec3 c = s->com, h = kg_vec3_scale(s->mass, c);
    kg_link_model *l = &model->links[i];
    l->parent = s->parent;
    l->mass = s->mass;
    kg_store3(l->h, h);
    kg_store3(l->offset, i == 0 ? kg_vec3_make(0.0, 0.0, 0.0) : s->offset);
    const double own[6] = {h.y * c.y + h.z * c.z,
                           h.x * c.x + h.z * c.z,
                           h.x * c.x + h.y * c.y,
                           -h.x * c.y,
                           -h.x * c.z,
                           -h.y * c.z};
    for (int k = 0; k < 6; k++) {
      l->inertia[k] = s->inertia[k] + own[k];
    }
    const kg_mat3 I = symmetric(l->inertia);
    for (int k = 0; k < 9; k++) {
      l->columns[k / 3 * 4 + k % 3] = I.m[k];
    }
  }
}

static size_t larger(size_t a, size_t b)
{
  return a > b ? a : b;
}

static size_t scratch_of(const kg_physics_kernels *kernels)
{
  return larger(kernels->eight->scratch, larger(kernels->one->scratch, kernels->link_scratch));
}

static kg_model *create_model(const kg_body *body, const kg_physics_kernels *kernels,
                              kg_arena *arena)
{
  const int n = body->segment_count;
  kg_model *model = KG_ARENA_ARRAY(arena, kg_model, 1);
  const kg_model made = {.n = n,
                         .links = KG_ARENA_ARRAY(arena, kg_link_model, n),
                         .scratch = kg_arena_alloc(arena, (size_t)n + 3, scratch_of(kernels))};
  if (kg_arena_failed(arena)) {
    return NULL;
  }
  *model = made;
  copy_model(model, body);
  return model;
}

static void copy_segments(kg_dynamics *d, const kg_body *body)
{
  for (int i = 0; i < body->segment_count; i++) {
    const kg_segment *s = &body->segments[i];
    kg_link *l = &d->links[i];
    l->parent = s->parent;
    l->mass = s->mass;
    l->offset = i == 0 ? kg_vec3_make(0.0, 0.0, 0.0) : s->offset;
    l->com = s->com;
    memcpy(l->inertia, s->inertia, sizeof l->inertia);
  }
}

void kg_dynamics_refresh(kg_dynamics *dynamics)
{
  copy_model(dynamics->model, dynamics->body);
  copy_segments(dynamics, dynamics->body);
}

kg_status kg_dynamics_create(kg_dynamics **dynamics, const kg_body *body,
                             const kg_allocator *allocator)
{
  *dynamics = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  const int n = body->segment_count;
  kg_dynamics *d = KG_ARENA_ARRAY(&arena, kg_dynamics, 1);
  kg_dynamics made = {.body = body, .n = n, .kernels = kg_physics_kernels_best()};
  made.model = create_model(body, made.kernels, &arena);
  made.motion = KG_ARENA_ARRAY(&arena, double, 8 * 18 * n);
  made.spare = KG_ARENA_ARRAY(&arena, double, 9 * n);
  for (int k = 0; k < 4; k++) {
    made.lanes[k] = KG_ARENA_ARRAY(&arena, double, 8 * body->nq);
  }
  made.links = KG_ARENA_ARRAY(&arena, kg_link, n);
  made.S = KG_ARENA_ARRAY(&arena, kg_mat63, n + 1);
  made.psi = KG_ARENA_ARRAY(&arena, kg_mat63, n + 1);
  made.psi_dot = KG_ARENA_ARRAY(&arena, kg_mat63, n + 1);
  made.moved = KG_ARENA_ARRAY(&arena, kg_mat63, n + 1);
  made.sum = KG_ARENA_ARRAY(&arena, kg_composite, n + 1);
  made.pencil = KG_ARENA_ARRAY(&arena, kg_pencil, n + 1);
  made.G = KG_ARENA_ARRAY(&arena, kg_rows, n + 1);
  kg_tree_init(&made.tree, body, &arena);
  kg_chain_init(&made.chain, body, &arena);
  kg_tree_matrix_init(&made.A, &made.tree, &arena);
  made.forward = KG_ARENA_ARRAY(&arena, double, body->nv);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  for (int k = 0; k < 3; k++) { /* block 0 moves the root along the world's axes */
    made.S[0].v.m[5 * k] = 1.0;
  }
  made.arena = arena;
  *d = made;
  copy_segments(d, body);
  kg_dynamics_set_gravity(d, kg_vec3_make(0.0, -9.8, 0.0));
  *dynamics = d;
  return KG_OK;
}

void kg_dynamics_destroy(kg_dynamics *dynamics)
{
  if (dynamics) {
    kg_arena arena = dynamics->arena; /* the arena holds the object itself */
    kg_arena_release(&arena);
  }
}

void kg_dynamics_set_gravity(kg_dynamics *dynamics, kg_vec3 gravity)
{
  dynamics->gravity = gravity;
  kg_store3(dynamics->model->gravity, gravity);
}

/* ---- stages of inverse dynamics ---------------------------------------------------------------*/

/* (1) R_i = R_parent Q_i, p_i = p_parent + R_parent offset_i, c_i = p_i + R_i com_i */
void kg_links_pose(kg_dynamics *d, const double *q)
{
  d->origin = kg_load3(q);
  for (int i = 0; i < d->n; i++) {
    kg_link *l = &d->links[i];
    l->R = kg_quat_matrix(kg_state_quat(q, i));
    if (i > 0) {
      const kg_link *up = &d->links[l->parent];
      l->R = kg_mat3_mul(up->R, l->R);
      l->p = kg_vec3_add(up->p, kg_mat3_mul_vec(up->R, l->offset));
    }
    l->c = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, l->com));
  }
}

/* (2) */
void kg_links_velocity(kg_dynamics *d, const double *v)
{
  for (int i = 0; i < d->n; i++) {
    kg_link *l = &d->links[i];
    l->w = kg_mat3_mul_vec(l->R, kg_load3(v + 3 + 3 * i));
    l->p_dot = kg_load3(v);
    if (i > 0) {
      const kg_link *up = &d->links[l->parent];
      l->w = kg_vec3_add(l->w, up->w);
      l->p_dot = kg_vec3_add(up->p_dot, kg_vec3_cross(up->w, kg_vec3_sub(l->p, up->p)));
    }
  }
}

void kg_links_move(kg_dynamics *d, const double *q, const double *v, const double *a)
{
  d->kernels->move(d, q, v, a);
}

/* (5) tau_i = R_i' (n_i - p_i x f_i) of the forces summed over the subtree; f at the root */
void kg_links_project(const kg_dynamics *d, double *tau)
{
  memset(tau, 0, (size_t)(3 + 3 * d->n) * sizeof *tau);
  /* the sums are kept where they will be projected; the linear part needs a place of its own */
  kg_composite *sum = d->sum + 1;
  for (int i = 0; i < d->n; i++) {
    sum[i].inertial = kg_force_sub(d->links[i].inertial, d->links[i].external);
  }
  for (int i = d->n - 1; i >= 0; i--) {
    const kg_link *l = &d->links[i];
    const kg_force f = sum[i].inertial;
    const kg_vec3 moment = kg_vec3_sub(f.n, kg_vec3_cross(l->p, f.f));
    kg_store3(tau + 3 + 3 * i, kg_mat3_mul_vec_t(l->R, moment));
    if (i > 0) {
      sum[l->parent].inertial = kg_force_add(sum[l->parent].inertial, f);
    }
  }
  kg_store3(tau, sum[0].inertial.f);
}

/* ---- composites and derivatives ---------------------------------------------------------------*/

double kg_links_mass(const kg_dynamics *d)
{
  double sum = 0.0;
  for (int i = 0; i < d->n; i++) {
    sum += d->links[i].mass;
  }
  return sum;
}

void kg_tree_clear_external(kg_dynamics *d)
{
  for (int b = 0; b <= d->n; b++) {
    d->sum[b].loaded = false;
    d->sum[b].external = (kg_force){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  }
}

kg_composite *kg_tree_load(kg_dynamics *d, int segment)
{
  kg_composite *sum = &d->sum[segment + 1];
  if (!sum->loaded) {
    memset(&sum->K, 0, sizeof sum->K);
    memset(&sum->D, 0, sizeof sum->D);
    sum->loaded = true;
    sum->external = d->links[segment].external;
  }
  return sum;
}

void kg_tree_prepare(kg_dynamics *d)
{
  d->kernels->prepare(d);
}

void kg_tree_pencil(kg_dynamics *d, int b, const kg_mat3 *E, double rate, double acceleration)
{
  d->kernels->pencil(d, b, E, rate, acceleration);
}

void kg_tree_jacobian(const kg_dynamics *d, kg_tree_matrix *A)
{
  d->kernels->jacobian(d, A);
}

/* Momentum about O of the subtree of block b per unit of its velocity: I S. */
static void subtree_momentum(const kg_dynamics *d, int b, kg_mat3 *n, kg_mat3 *f)
{
  for (int k = 0; k < 3; k++) {
    const double *w = d->S[b].w.m + k, *v = d->S[b].v.m + k;
    const kg_motion unit = {kg_vec3_make(w[0], w[4], w[8]), kg_vec3_make(v[0], v[4], v[8])};
    const kg_force h = kg_inertia_mul(&d->sum[b].I, unit);
    n->m[k] = h.n.x;
    n->m[3 + k] = h.n.y;
    n->m[6 + k] = h.n.z;
    f->m[k] = h.f.x;
    f->m[3 + k] = h.f.y;
    f->m[6 + k] = h.f.z;
  }
}

void kg_links_mass_diagonal(kg_dynamics *d, double *diagonal)
{
  d->kernels->prepare_mass(d);
  for (int b = 0; b <= d->n; b++) {
    kg_mat3 n, f;
    subtree_momentum(d, b, &n, &f);
    for (int k = 0; k < 3; k++) {
      double sum = 0.0;
      for (int r = 0; r < 3; r++) {
        sum += n.m[3 * r + k] * d->S[b].w.m[4 * r + k] + f.m[3 * r + k] * d->S[b].v.m[4 * r + k];
      }
      diagonal[3 * b + k] = sum;
    }
  }
}

/* ---- public calls -----------------------------------------------------------------------------*/

void kg_dynamics_pose(kg_dynamics *dynamics, const double *q, kg_vec3 *p, kg_mat3 *R)
{
  kg_dynamics_velocity(dynamics, q, NULL, p, R, NULL, NULL);
}

void kg_dynamics_velocity(kg_dynamics *dynamics, const double *q, const double *v, kg_vec3 *p,
                          kg_mat3 *R, kg_vec3 *p_dot, kg_vec3 *w)
{
  KG_ASSERT(v || (!p_dot && !w));
  kg_links_pose(dynamics, q);
  if (p_dot || w) {
    kg_links_velocity(dynamics, v);
  }
  for (int i = 0; i < dynamics->n; i++) {
    const kg_link *l = &dynamics->links[i];
    if (p) {
      p[i] = kg_vec3_add(dynamics->origin, l->p);
    }
    if (R) {
      R[i] = l->R;
    }
    if (p_dot) {
      p_dot[i] = l->p_dot;
    }
    if (w) {
      w[i] = l->w;
    }
  }
}

static void clear_link_external(kg_dynamics *d)
{
  for (int i = 0; i < d->n; i++) {
    d->links[i].external = (kg_force){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  }
}

static void run_inverse(kg_dynamics *d, const double *q, const double *v, const double *a)
{
  kg_links_move(d, q, v, a);
  clear_link_external(d);
}

void kg_dynamics_inverse(kg_dynamics *dynamics, double *tau, const double *q, const double *v,
                         const double *a)
{
  kg_inverse_of_one(dynamics->kernels)(dynamics->model, tau, q, v, a);
}

void kg_dynamics_forward(kg_dynamics *dynamics, double *a, const double *q, const double *v,
                         const double *tau)
{
  dynamics->kernels->one->forward(dynamics->model, a, q, v, tau);
}

void kg_dynamics_mass_solve(kg_dynamics *dynamics, double *x, const double *q)
{
  dynamics->kernels->one->mass_solve(dynamics->model, x, q, NULL, x);
}

void kg_dynamics_acceleration(kg_dynamics *dynamics, const double *q, const double *v,
                              const double *a, kg_vec3 *p_ddot, kg_vec3 *alpha)
{
  kg_dynamics *d = dynamics;
  kg_links_move(d, q, v, a);
  for (int i = 0; i < d->n; i++) {
    if (p_ddot) {
      p_ddot[i] = kg_vec3_add(d->links[i].p_ddot, d->gravity);
    }
    if (alpha) {
      alpha[i] = d->links[i].alpha;
    }
  }
}

void kg_dynamics_mass_matrix(kg_dynamics *dynamics, double *M, const double *q)
{
  kg_links_pose(dynamics, q);
  dynamics->kernels->prepare_mass(dynamics);
  dynamics->kernels->dense_mass(dynamics, M);
}

static void prepare_derivatives(kg_dynamics *d, const double *q, const double *v, const double *a)
{
  run_inverse(d, q, v, a);
  kg_tree_clear_external(d);
  kg_tree_prepare(d);
}

void kg_dynamics_inverse_derivatives(kg_dynamics *dynamics, double *dtau_dq, double *dtau_dv,
                                     double *M, double *tau, const double *q, const double *v,
                                     const double *a)
{
  kg_dynamics *d = dynamics;
  if (tau) {
    kg_dynamics_inverse(d, tau, q, v, a);
  }
  prepare_derivatives(d, q, v, a);
  d->kernels->derivatives(d, dtau_dq, dtau_dv, M);
}

/* The articulated-body algorithm differentiated (theory, section 4b); -M^-1 dID would lose the condition
 * of M. */
void kg_dynamics_forward_derivatives(kg_dynamics *dynamics, double *da_dq, double *da_dv,
                                     double *da_dtau, double *a, const double *q, const double *v,
                                     const double *tau)
{
  kg_dynamics *d = dynamics;
  const int nv = d->body->nv;
  const kg_lanes_dense out = {da_dq, da_dv, da_dtau};
  kg_dynamics_forward(d, d->forward, q, v, tau);
  d->kernels->one->forward_derivatives(d->model, &d->tree, &out, q, v, d->forward, tau);
  bool regular = true;
  for (int k = 0; k < nv; k++) {
    regular = regular && isfinite(d->forward[k]);
  }
  double *outputs[3] = {da_dq, da_dv, da_dtau};
  for (int k = 0; k < 3 * nv * nv && !regular; k++) { /* M is singular: no derivative */
    if (outputs[k / (nv * nv)]) {
      outputs[k / (nv * nv)][k % (nv * nv)] = NAN;
    }
  }
  if (a) {
    memcpy(a, d->forward, (size_t)nv * sizeof *a);
  }
}

kg_centroid kg_dynamics_centroid(kg_dynamics *dynamics, const double *q, const double *v)
{
  kg_dynamics *d = dynamics;
  kg_links_pose(d, q);
  d->kernels->prepare_mass(d);
  const kg_inertia J = d->sum[0].I;
  kg_force momentum = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}}; /* about O */
  for (int b = 0; b <= d->n && v; b++) {
    kg_mat3 n, f;
    subtree_momentum(d, b, &n, &f);
    const kg_vec3 u = kg_load3(v + 3 * b);
    momentum.n = kg_vec3_add(momentum.n, kg_mat3_mul_vec(n, u));
    momentum.f = kg_vec3_add(momentum.f, kg_mat3_mul_vec(f, u));
  }
  kg_centroid out = {.mass = J.mass};
  const double per_mass = J.mass > 0.0 ? 1.0 / J.mass : 0.0;
  const kg_vec3 c = kg_vec3_scale(per_mass, J.h);
  out.com = kg_vec3_add(d->origin, c);
  out.com_dot = kg_vec3_scale(per_mass, momentum.f);
  out.L = kg_vec3_sub(momentum.n, kg_vec3_cross(c, momentum.f));
  const double hc = kg_vec3_dot(J.h, c);
  out.I = kg_mat3_add(symmetric(J.I), kg_mat3_outer(J.h, c));
  for (int k = 0; k < 9; k += 4) {
    out.I.m[k] -= hc;
  }
  return out;
}

void kg_dynamics_centroidal_matrix(kg_dynamics *dynamics, double *A, const double *q)
{
  kg_dynamics *d = dynamics;
  const int nv = d->body->nv;
  kg_links_pose(d, q);
  d->kernels->prepare_mass(d);
  const kg_inertia *whole = &d->sum[0].I;
  const kg_vec3 c = kg_vec3_scale(whole->mass > 0.0 ? 1.0 / whole->mass : 0.0, whole->h);
  for (int b = 0; b <= d->n; b++) {
    kg_mat3 n, f;
    subtree_momentum(d, b, &n, &f);
    n = kg_mat3_add(n, kg_mat3_scale(-1.0, kg_mat3_mul(kg_mat3_skew(c), f)));
    for (int r = 0; r < 3; r++) {
      memcpy(A + r * nv + 3 * b, n.m + 3 * r, 3 * sizeof *A);
      memcpy(A + (3 + r) * nv + 3 * b, f.m + 3 * r, 3 * sizeof *A);
    }
  }
}

kg_vec3 kg_dynamics_point(kg_dynamics *dynamics, double *J, const double *q, kg_body_point point)
{
  kg_dynamics *d = dynamics;
  KG_ASSERT(point.segment >= 0 && point.segment < d->n);
  kg_links_pose(d, q);
  const kg_link *l = &d->links[point.segment];
  const kg_vec3 x = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, point.p));
  if (J) {
    const int nv = 3 + 3 * d->n;
    memset(J, 0, 3 * (size_t)nv * sizeof *J);
    for (int r = 0; r < 3; r++) {
      J[r * nv + r] = 1.0;
    }
    for (int i = point.segment; i >= 0; i = d->links[i].parent) { /* (9) */
      const kg_mat3 B = kg_mat3_mul(kg_mat3_skew(kg_vec3_sub(d->links[i].p, x)), d->links[i].R);
      for (int r = 0; r < 3; r++) {
        memcpy(J + r * nv + 3 + 3 * i, B.m + 3 * r, 3 * sizeof *J);
      }
    }
  }
  return kg_vec3_add(d->origin, x);
}

double kg_dynamics_energy(kg_dynamics *dynamics, const double *q, const double *v)
{
  kg_dynamics *d = dynamics;
  kg_links_pose(d, q);
  kg_links_velocity(d, v);
  double twice_kinetic = 0.0, potential = 0.0;
  for (int i = 0; i < d->n; i++) {
    const kg_link *l = &d->links[i];
    const kg_vec3 c_dot = kg_vec3_add(l->p_dot, kg_vec3_cross(l->w, kg_vec3_sub(l->c, l->p)));
    const kg_vec3 w = kg_mat3_mul_vec_t(l->R, l->w);
    twice_kinetic +=
      l->mass * kg_vec3_dot(c_dot, c_dot) + kg_vec3_dot(w, symmetric_mul(l->inertia, w));
    potential -= l->mass * kg_vec3_dot(d->gravity, kg_vec3_add(d->origin, l->c));
  }
  return 0.5 * twice_kinetic + potential;
}
