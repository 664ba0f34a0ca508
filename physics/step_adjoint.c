/* Derivatives of a step by the implicit function theorem: products with the transposed Jacobian,
 * and the whole Jacobian. Newton's iterations are not differentiated.
 *
 * Equation numbers: docs/theory/dynamics.md, section 8. */
#include "physics/chain.h"
#include "physics/passive.h"
#include "physics/physics.h"
#include "physics/step_problem.h"

#include <string.h>

/* A residual this many times the tolerance is still a solution: the tolerance was met when v' was
 * found, but not necessarily on this machine. */
static const double SLACK = 10.0;

static size_t bytes_of(const kg_step *s)
{
  return (size_t)s->def.body->nv * sizeof(double);
}

/* Scratch number k, nv numbers: 0 and 1 belong to one step, the others to a sequence of them. */
static double *returned(const kg_step *s, int k)
{
  KG_ASSERT(k < KG_STEP_RETURNED);
  return s->returned + k * s->def.body->nv;
}

/* s->J = dG/dv' at a v' that solves the step */
static kg_status linearize_at(kg_step *s, const double *q, const double *v, const double *tau,
                              double dt, const double *v_next)
{
  s->contact = s->def.contact;
  kg_step_set_problem(s, q, v, tau, dt);
  kg_step_set_scale(s);
  (void)kg_step_evaluate(s->G, v_next, s);
  if (!(kg_step_merit(s, s->G) <= SLACK * s->def.tolerance)) return KG_ERR_UNDEFINED;
  kg_step_linearize(s);
  return KG_OK;
}

/* The same with J factorised: all that can fail on the way back through a step. */
static kg_status factor_at(kg_step *s, const double *q, const double *v, const double *tau,
                           double dt, const double *v_next)
{
  const kg_status status = linearize_at(s, q, v, tau, dt, v_next);
  if (status != KG_OK) return status;
  return kg_tree_factor(&s->dynamics->tree, &s->J) ? KG_OK : KG_ERR_UNDEFINED;
}

/* ---- one step ---------------------------------------------------------------------------------*/

/* phi -= sum of xi . f (B2) */
static void return_contacts(kg_step *s, const kg_step_gradient *g)
{
  kg_chain *chain = &s->dynamics->chain;
  for (int k = 0; k < s->contact_count; k++) {
    const kg_step_contact *c = &s->contacts[k];
    const kg_body_point *point = &s->def.body->points[c->point];
    const kg_chain_link *l = &chain->links[point->segment];
    const kg_vec3 xi = kg_mat3_mul_vec(l->R, kg_vec3_add(l->pi, kg_vec3_cross(l->mu, point->p)));
    const kg_vec3 u = kg_mat3_mul_vec(l->R, kg_vec3_add(l->v, kg_vec3_cross(l->w, point->p)));
    const kg_vec3 f_bar = kg_vec3_scale(-1.0, xi), xi_bar = kg_vec3_scale(-1.0, c->force.f);
    const kg_vec3 x_bar = kg_mat3_mul_vec_t(c->force.df_dx, f_bar);
    const kg_vec3 u_bar = kg_mat3_mul_vec_t(c->force.df_du, f_bar);
    kg_chain_point(chain, point->segment, point->p, &x_bar, &u_bar, &xi_bar,
                   g->body.points ? g->body.points + 3 * c->point : NULL);
    if (g->contact) {
      kg_contact_params_vjp(&s->contact, &c->force, u, f_bar, g->contact);
    }
  }
}

static void return_passive(kg_step *s, const kg_step_gradient *g, const double *nu, double *q_bar)
{
  const kg_body *body = s->def.body;
  for (int k = 6; k < body->nv && g->joint_damping; k++) {
    *g->joint_damping += nu[k] * s->v_end[k];
  }
  for (int i = 1; i < body->segment_count && s->def.passive; i++) {
    const kg_joint_passive *p = &s->def.passive[i];
    const kg_quat q = kg_state_quat(s->q_end, i);
    const kg_vec3 own = kg_load3(nu + 3 + 3 * i);
    kg_mat3 by_turn;
    (void)kg_passive_torque(p, q, &by_turn);
    double *bar = q_bar + 3 + 3 * i;
    kg_store3(bar, kg_vec3_add(kg_load3(bar), kg_mat3_mul_vec_t(by_turn, own)));
    if (g->passive) {
      kg_passive_gradient(p, q, kg_load3(s->v_end + 3 + 3 * i), own, g->passive + 3 * i);
    }
  }
}

/* Gradient of nu' G by q', a and the parameters: adds to q_bar, a_bar and *g. */
static void return_residual(kg_step *s, const kg_step_gradient *g, const double *nu, double *q_bar,
                            double *a_bar)
{
  kg_chain *chain = &s->dynamics->chain;
  const bool touching = s->contact_count > 0;
  const int parts =
    KG_CHAIN_ACCELERATION | KG_CHAIN_FIELD | (touching ? KG_CHAIN_POSE | KG_CHAIN_VELOCITY : 0);
  const kg_chain_gradient out = {.q = q_bar, .a = a_bar, .offset = g->body.offset};
  kg_chain_pose(chain, s->q_end);
  kg_chain_velocity(chain, s->v_end);
  kg_chain_acceleration(chain, s->v_end, s->a, s->def.gravity);
  kg_chain_field(chain, nu);
  kg_chain_clear(chain);
  kg_chain_inertial(chain, &g->body);
  return_contacts(s, g);
  kg_chain_return(chain, parts, s->v_end, &out);
  return_passive(s, g, nu, q_bar);
}

/* (B1) nu = -(dG/dv')^-T (v_bar' + E' q_bar') */
static void solve_for_multiplier(kg_step *s, const double *q_bar, const double *v_bar, double *nu)
{
  const kg_tree *tree = &s->dynamics->tree;
  for (int b = 0; b < tree->blocks; b++) {
    const kg_mat3 E = kg_step_turn_by_rate(s, b);
    const kg_vec3 pulled = kg_mat3_mul_vec_t(E, kg_load3(q_bar + 3 * b));
    kg_store3(nu + 3 * b, kg_vec3_scale(-1.0, kg_vec3_add(kg_load3(v_bar + 3 * b), pulled)));
  }
  kg_tree_solve_transposed(tree, &s->J, nu);
}

/* (B3) q' = q exp(d) exp(dt w) = q exp(dt w) exp(d'), d' = R(dt w)' d */
static kg_mat3 carried(const kg_step *s, int b)
{
  if (b == 0) return kg_mat3_identity();
  return kg_quat_matrix(kg_quat_exp(kg_vec3_scale(s->dt, kg_load3(s->v_end + 3 * b))));
}

/* One plain step; q_bar, v_bar [nv]: adjoints of its end. Adds to *g. */
static kg_status return_step(kg_step *s, const kg_step_gradient *g, const double *q,
                             const double *v, const double *tau, double dt, const double *v_next,
                             const double *q_bar, const double *v_bar)
{
  const int nv = s->def.body->nv;
  double *nu = returned(s, 0), *q_end_bar = returned(s, 1), *a_bar = returned(s, 2);
  const kg_status status = factor_at(s, q, v, tau, dt, v_next);
  if (status != KG_OK) return status;
  solve_for_multiplier(s, q_bar, v_bar, nu);
  memcpy(q_end_bar, q_bar, bytes_of(s));
  memset(a_bar, 0, bytes_of(s));
  return_residual(s, g, nu, q_end_bar, a_bar);
  for (int b = 0; b < s->dynamics->tree.blocks && g->q; b++) {
    const kg_mat3 R = carried(s, b);
    double *own = g->q + 3 * b;
    kg_store3(own, kg_vec3_add(kg_load3(own), kg_mat3_mul_vec(R, kg_load3(q_end_bar + 3 * b))));
  }
  for (int k = 0; k < nv && g->v; k++) {
    g->v[k] -= a_bar[k] / dt;
  }
  for (int k = 0; k < nv && g->tau; k++) {
    g->tau[k] -= nu[k];
  }
  return KG_OK;
}

/* ---- sub-steps --------------------------------------------------------------------------------*/

/* Leaves the states between the sub-steps in the trace; they must end where the step did, and each
 * must have derivatives: asked beforehand, so that what is added is whole. */
static kg_status trace(kg_step *s, const double *q, const double *v, const double *tau, double dt,
                       const double *v_next, int substeps)
{
  const int nv = s->def.body->nv;
  if (substeps > 1 << s->def.max_substep_levels || !kg_step_trace(s, q, v, tau, dt, substeps)) {
    return KG_ERR_UNDEFINED;
  }
  const double *end = s->trace_v + substeps * nv;
  for (int k = 0; k < nv; k++) {
    if (!(fabs(end[k] - v_next[k]) <= SLACK * s->def.tolerance * (1.0 + fabs(end[k])))) {
      return KG_ERR_UNDEFINED;
    }
  }
  kg_status status = KG_OK;
  for (int k = 0; k < substeps && status == KG_OK; k++) {
    status = factor_at(s, s->trace_q + k * s->def.body->nq, s->trace_v + k * nv, tau, dt / substeps,
                       s->trace_v + (k + 1) * nv);
  }
  return status;
}

/* Back through the sub-steps in the trace. */
static kg_status return_trace(kg_step *s, const kg_step_gradient *g, const double *tau, double dt,
                              int substeps, const double *q_bar, const double *v_bar)
{
  const int nq = s->def.body->nq, nv = s->def.body->nv;
  double *q_now = returned(s, 3), *v_now = returned(s, 4);
  double *q_then = returned(s, 5), *v_then = returned(s, 6);
  memcpy(q_then, q_bar, bytes_of(s));
  memcpy(v_then, v_bar, bytes_of(s));
  for (int k = substeps - 1; k >= 0; k--) {
    memcpy(q_now, q_then, bytes_of(s));
    memcpy(v_now, v_then, bytes_of(s));
    memset(q_then, 0, bytes_of(s));
    memset(v_then, 0, bytes_of(s));
    kg_step_gradient part = *g;
    part.q = q_then;
    part.v = v_then;
    const kg_status status = return_step(s, &part, s->trace_q + k * nq, s->trace_v + k * nv, tau,
                                         dt / substeps, s->trace_v + (k + 1) * nv, q_now, v_now);
    if (status != KG_OK) return status;
  }
  for (int k = 0; k < nv && g->q; k++) {
    g->q[k] += q_then[k];
  }
  for (int k = 0; k < nv && g->v; k++) {
    g->v[k] += v_then[k];
  }
  return KG_OK;
}

kg_status kg_step_vjp(kg_step *step, const kg_step_gradient *gradient, const double *q,
                      const double *v, const double *tau, double dt, const double *v_next,
                      int substeps, const double *q_next_bar, const double *v_next_bar)
{
  KG_ASSERT(dt > 0.0 && substeps > 0);
  if (substeps == 1) {
    return return_step(step, gradient, q, v, tau, dt, v_next, q_next_bar, v_next_bar);
  }
  const kg_status status = trace(step, q, v, tau, dt, v_next, substeps);
  return status == KG_OK ? return_trace(step, gradient, tau, dt, substeps, q_next_bar, v_next_bar)
                         : status;
}

/* ---- the whole Jacobian -----------------------------------------------------------------------*/

static void get_block(const double *A, int nv, int r, int c, kg_mat3 *block)
{
  for (int i = 0; i < 3; i++) {
    memcpy(block->m + 3 * i, A + (size_t)(3 * r + i) * (size_t)nv + 3 * c, 3 * sizeof *A);
  }
}

static void set_block(double *A, int nv, int r, int c, const kg_mat3 *block)
{
  for (int i = 0; i < 3; i++) {
    memcpy(A + (size_t)(3 * r + i) * (size_t)nv + 3 * c, block->m + 3 * i, 3 * sizeof *A);
  }
}

/* column blocks of A times -R(dt w)', where A is not zero */
static void carry_columns(const kg_step *s, double *A)
{
  const int nv = s->def.body->nv;
  for (int c = 0; 3 * c < nv; c++) {
    const kg_mat3 R = kg_mat3_scale(-1.0, kg_mat3_transposed(carried(s, c)));
    for (int r = 0; 3 * r < nv; r++) {
      kg_mat3 block;
      get_block(A, nv, r, c, &block);
      block = kg_mat3_mul(block, R);
      set_block(A, nv, r, c, &block);
    }
  }
}

/* (B4) out = E in (+ R(dt w)'), in may be out */
static void carry_rows(const kg_step *s, double *out, const double *in, bool add_carried)
{
  const int nv = s->def.body->nv;
  for (int r = 0; 3 * r < nv; r++) {
    const kg_mat3 E = kg_step_turn_by_rate(s, r);
    for (int c = 0; c < nv; c++) {
      double *to = out + (size_t)(3 * r) * (size_t)nv + c;
      const double *from = in + (size_t)(3 * r) * (size_t)nv + c;
      const kg_vec3 y =
        kg_mat3_mul_vec(E, kg_vec3_make(from[0], from[(size_t)nv], from[2 * (size_t)nv]));
      to[0] = y.x;
      to[(size_t)nv] = y.y;
      to[2 * (size_t)nv] = y.z;
    }
    if (add_carried) {
      kg_mat3 block;
      get_block(out, nv, r, r, &block);
      block = kg_mat3_add(block, kg_mat3_transposed(carried(s, r)));
      set_block(out, nv, r, r, &block);
    }
  }
}

/* X: -dG/dx in, dv'/dx out, for x = q, v or tau; then dq'/dx where wanted, which may be X
 * itself. */
static void solve_part(kg_step *s, double *X, double *dq, bool by_pose)
{
  kg_tree_solve_many(&s->dynamics->tree, &s->J, X, s->def.body->nv);
  if (dq) {
    carry_rows(s, dq, X, by_pose);
  }
}

static void derivatives_by_pose(kg_step *s, double *X, double *dq)
{
  kg_tree_matrix *P = &s->dynamics->A;
  kg_step_linearize_pose(s, P);
  kg_tree_to_dense(&s->dynamics->tree, P, X);
  carry_columns(s, X);
  solve_part(s, X, dq, true);
}

static void derivatives_by_rate(kg_step *s, double *X, double *dq)
{
  kg_tree_matrix *M = &s->dynamics->A;
  const size_t count = (size_t)s->def.body->nv * (size_t)s->def.body->nv;
  kg_step_mass(s, M);
  kg_tree_to_dense(&s->dynamics->tree, M, X);
  for (size_t k = 0; k < count; k++) {
    X[k] /= s->dt;
  }
  solve_part(s, X, dq, false);
}

static void derivatives_by_force(kg_step *s, double *X, double *dq)
{
  const size_t nv = (size_t)s->def.body->nv;
  memset(X, 0, nv * bytes_of(s));
  for (size_t k = 0; k < nv; k++) {
    X[k * nv + k] = 1.0;
  }
  solve_part(s, X, dq, false);
}

static kg_status differentiate_step(kg_step *s, const kg_step_jacobian *j, const double *q,
                                    const double *v, const double *tau, double dt,
                                    const double *v_next)
{
  const kg_status status = factor_at(s, q, v, tau, dt, v_next);
  if (status != KG_OK) return status;
  if (j->dv_dq || j->dq_dq) derivatives_by_pose(s, j->dv_dq ? j->dv_dq : j->dq_dq, j->dq_dq);
  if (j->dv_dv || j->dq_dv) derivatives_by_rate(s, j->dv_dv ? j->dv_dv : j->dq_dv, j->dq_dv);
  if (j->dv_dtau || j->dq_dtau)
    derivatives_by_force(s, j->dv_dtau ? j->dv_dtau : j->dq_dtau, j->dq_dtau);
  return KG_OK;
}

/* row r of a matrix, or NULL */
static double *cleared_row(const kg_step *s, double *A, int r)
{
  if (!A) return NULL;
  double *row = A + (size_t)r * (size_t)s->def.body->nv;
  memset(row, 0, bytes_of(s));
  return row;
}

/* Row by row, each a gradient through all sub-steps of the trace: sub-steps are rare. */
static kg_status differentiate_trace(kg_step *s, const kg_step_jacobian *j, const double *tau,
                                     double dt, int substeps)
{
  double *unit = returned(s, 7), *zero = returned(s, 8);
  memset(zero, 0, bytes_of(s));
  for (int r = 0; r < s->def.body->nv; r++) {
    memset(unit, 0, bytes_of(s));
    unit[r] = 1.0;
    const kg_step_gradient of_v = {.q = cleared_row(s, j->dv_dq, r),
                                   .v = cleared_row(s, j->dv_dv, r),
                                   .tau = cleared_row(s, j->dv_dtau, r)};
    const kg_step_gradient of_q = {.q = cleared_row(s, j->dq_dq, r),
                                   .v = cleared_row(s, j->dq_dv, r),
                                   .tau = cleared_row(s, j->dq_dtau, r)};
    kg_status status = return_trace(s, &of_v, tau, dt, substeps, zero, unit);
    if (status == KG_OK) status = return_trace(s, &of_q, tau, dt, substeps, unit, zero);
    if (status != KG_OK) return status;
  }
  return KG_OK;
}

kg_status kg_step_derivatives(kg_step *step, const kg_step_jacobian *jacobian, const double *q,
                              const double *v, const double *tau, double dt, const double *v_next,
                              int substeps)
{
  KG_ASSERT(dt > 0.0 && substeps > 0);
  if (substeps == 1) return differentiate_step(step, jacobian, q, v, tau, dt, v_next);
  const kg_status status = trace(step, q, v, tau, dt, v_next, substeps);
  return status == KG_OK ? differentiate_trace(step, jacobian, tau, dt, substeps) : status;
}
