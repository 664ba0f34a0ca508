/* The corrected pose by the pose before; symbols in correction.h.
 *
 * At the least move, with the touches that carry a multiplier,
 *   s = M(q0) D - sum lambda grad_D Phi(q0 (+) D) = 0,    Phi(q0 (+) D) = 0.                  (27)
 * A change e of q0 (tangent) changes the end by eta = T e + P dD, T = exp(-D) and P = Jr(D) for every
 * rotation, and D by
 *   K (dD, dlambda) = (-s_e e, Phi_e e),    K = (W, -G'; -G, 0),                              (28)
 *   s_e = d(M D)/dq0 - P' Gamma T,    Phi_e = g T,
 * Gamma the derivative of sum lambda g in the tangent at the end. K is symmetric, so the adjoint needs
 * one solution with it and the adjoint of inverse dynamics at rest, tau = M(q0) D. */
#include "physics/correction.h"

#include "kinegrad/dense.h"

#include <string.h>

/* A multiplier below this share of the largest is none. */
#define LEAST_MULTIPLIER 1e-9
/* A row counts as a combination of others when less than this share of it is its own. */
#define OWN_SHARE 1e-9
/* The move is the least one when what the multipliers leave of it is below this share. */
#define LEAST_SHARE 1e-2

void correction_vjp_init(kg_correction *c, kg_arena *arena)
{
  const size_t nv = (size_t)c->nv, most = (size_t)c->solver.most, size = nv + most;
  correction_adjoint *a = &c->adjoint;
  a->K = KG_ARENA_ARRAY(arena, double, size *size);
  a->pivots = KG_ARENA_ARRAY(arena, int, size);
  a->u = KG_ARENA_ARRAY(arena, double, size);
  a->rows = KG_ARENA_ARRAY(arena, double, most *nv);
  a->gamma = KG_ARENA_ARRAY(arena, double, nv *nv);
  a->zero = KG_ARENA_ARRAY(arena, double, nv);
  a->end = KG_ARENA_ARRAY(arena, double, nv);
  a->E = KG_ARENA_ARRAY(arena, kg_mat3, c->def.body->segment_count);
}

/* Multipliers by point from D alone: M D = G' lambda over what touches. False when no multipliers
 * make D the least move. */
static bool find_multipliers(kg_correction *c)
{
  /* the residual counts distances with the root of the mass */
  const double kept = c->def.kkt_tolerance / sqrt(c->def.body->mass);
  const double reach = c->def.kkt_tolerance > 0.0 ? fmax(1e-8, kept) : c->def.tolerance;
  double largest = 0.0;
  c->rows = 0;
  for (int k = 0; k < c->touch_count && c->rows < c->solver.rows_max; k++) {
    const touch *t = &c->touches[k];
    if (!(t->at.distance <= reach)) continue;
    double *row = c->G + (size_t)c->rows * (size_t)c->nv;
    correction_row(c, t, row);
    correction_to_move(c, row);
    c->b[c->rows] = correction_dot(row, c->D, c->nv);
    c->touch_of_row[c->rows++] = k;
  }
  (void)least_move_solve(&c->solver, c->chol, c->G, c->b, c->rows, CORRECTION_ROW_TOLERANCE,
                         c->goal, c->lambda);
  for (int r = 0; r < c->rows; r++) {
    largest = fmax(largest, c->lambda[r]);
  }
  memset(c->multiplier, 0, (size_t)c->key_count * sizeof *c->multiplier);
  for (int r = 0; r < c->rows; r++) {
    const bool carries = c->lambda[r] > LEAST_MULTIPLIER * largest;
    c->multiplier[correction_touch_of(c, r)->key] = carries ? c->lambda[r] : 0.0;
  }
  for (int i = 0; i < c->nv; i++) {
    c->goal[i] -= c->D[i];
  }
  return correction_metric(c, c->goal, c->goal) <=
         LEAST_SHARE * LEAST_SHARE * correction_metric(c, c->D, c->D);
}

/* Whether row r is no combination of those kept: modified Gram-Schmidt in the norm of M^-1. The
 * orthonormal rows are kept in the solver's scratch, each as M^-1 g beside g. */
static bool is_independent(kg_correction *c, int r, int kept)
{
  const int nv = c->nv;
  double *own = c->solver.A + (size_t)kept * (size_t)nv;
  double *solved = c->solver.Z + (size_t)kept * (size_t)nv;
  memcpy(own, c->G + (size_t)r * (size_t)nv, (size_t)nv * sizeof *own);
  memcpy(solved, own, (size_t)nv * sizeof *own);
  kg_dense_cholesky_solve(c->chol, nv, solved, 1);
  const double all = correction_dot(own, solved, nv);
  for (int pass = 0; pass < 2; pass++) {
    for (int k = 0; k < kept; k++) {
      const double *g = c->solver.A + (size_t)k * (size_t)nv;
      const double *z = c->solver.Z + (size_t)k * (size_t)nv;
      const double share = correction_dot(own, z, nv);
      for (int i = 0; i < nv; i++) {
        own[i] -= share * g[i];
        solved[i] -= share * z[i];
      }
    }
  }
  const double left = correction_dot(own, solved, nv);
  if (!(left > OWN_SHARE * OWN_SHARE * all)) return false;
  for (int i = 0; i < nv; i++) {
    own[i] /= sqrt(left);
    solved[i] /= sqrt(left);
  }
  return true;
}

/* K of (28) and the rows g of the touches kept; false when it has no inverse */
static bool factor_system(kg_correction *c)
{
  correction_adjoint *a = &c->adjoint;
  const int nv = c->nv;
  int kept[CORRECTION_ROWS_MAX];
  a->count = 0;
  for (int r = 0; r < c->rows && a->count < nv; r++) {
    if (c->multiplier[correction_touch_of(c, r)->key] > 0.0 && is_independent(c, r, a->count)) {
      kept[a->count++] = r;
    }
  }
  const int size = nv + a->count;
  memset(a->K, 0, (size_t)size * (size_t)size * sizeof *a->K);
  for (int i = 0; i < nv; i++) {
    for (int j = 0; j < nv; j++) {
      a->K[i * size + j] = c->M[i * nv + j] - c->C[i * nv + j];
    }
  }
  for (int k = 0; k < a->count; k++) {
    correction_row(c, correction_touch_of(c, kept[k]), a->rows + (size_t)k * (size_t)nv);
    for (int i = 0; i < nv; i++) {
      a->K[(nv + k) * size + i] = a->K[i * size + nv + k] = -c->G[kept[k] * nv + i];
    }
  }
  return kg_dense_lu_factor(a->K, a->pivots, size);
}

/* gamma: correction_curvature makes it symmetric by what the exponential map bends at D = 0, -1/2 [g]
 * for every joint; this takes that back */
static void make_gamma(kg_correction *c)
{
  correction_adjoint *a = &c->adjoint;
  double *D = c->D;
  c->D = a->zero;
  correction_tangents(c, c->D);
  correction_curvature(c, c->multiplier, a->gamma);
  c->D = D;
  correction_tangents(c, c->D);
  double *g = c->goal;
  memset(g, 0, (size_t)c->nv * sizeof *g);
  for (int k = 0; k < c->touch_count; k++) {
    const double l = c->multiplier[c->touches[k].key];
    if (l == 0.0) continue;
    correction_row(c, &c->touches[k], c->slope);
    for (int i = 0; i < c->nv; i++) {
      g[i] += l * c->slope[i];
    }
  }
  for (int i = 3; i < c->nv; i += 3) {
    const kg_mat3 half = kg_mat3_scale(0.5, kg_mat3_skew(kg_load3(g + i)));
    for (int k = 0; k < 9; k++) {
      a->gamma[(size_t)(i + k / 3) * (size_t)c->nv + (size_t)(i + k % 3)] += half.m[k];
    }
  }
}

/* Whether the body's own segments carry: their second derivatives are not at hand. */
static bool is_held_by_itself(const kg_correction *c)
{
  bool held = false;
  for (int k = c->def.body->point_count; k < c->key_count; k++) {
    held = held || c->multiplier[k] > 0.0;
  }
  return held;
}

static bool is_same(const kg_body *body, const double *q, const double *r)
{
  return memcmp(q, r, (size_t)body->nq * sizeof *q) == 0;
}

static bool prepare(kg_correction *c, const double *q_before, const double *q_after)
{
  const kg_body *body = c->def.body;
  correction_adjoint *a = &c->adjoint;
  a->untouched = is_same(body, q_before, q_after);
  if (a->untouched) return true;
  c->near = CORRECTION_NEAR;
  memcpy(c->q0, q_before, (size_t)body->nq * sizeof *q_before);
  kg_body_difference(body, c->D, q_after, q_before);
  correction_factor_mass(c, c->q0);
  correction_go_to(c, c->D);
  correction_tangents(c, c->D);
  for (int i = 0; i < body->segment_count; i++) {
    a->E[i] = kg_quat_matrix(kg_quat_exp(kg_load3(c->D + 3 + 3 * i)));
  }
  if (!find_multipliers(c) || is_held_by_itself(c)) return false;
  correction_curvature(c, c->multiplier, c->C);
  if (!factor_system(c)) return false;
  make_gamma(c);
  return true;
}

/* end = bar + Gamma' P u + g' mu */
static void end_adjoint(kg_correction *c, const double *after_bar)
{
  correction_adjoint *a = &c->adjoint;
  const int nv = c->nv;
  double *w = c->slope;
  memcpy(w, a->u, (size_t)nv * sizeof *w);
  for (int i = 0; i < c->def.body->segment_count; i++) {
    kg_store3(w + 3 + 3 * i, kg_mat3_mul_vec(c->Jr[i], kg_load3(w + 3 + 3 * i)));
  }
  memcpy(a->end, after_bar, (size_t)nv * sizeof *w);
  for (int i = 0; i < nv; i++) {
    for (int j = 0; j < nv; j++) {
      a->end[j] += a->gamma[i * nv + j] * w[i];
    }
  }
  for (int k = 0; k < a->count; k++) {
    for (int j = 0; j < nv; j++) {
      a->end[j] += a->rows[k * nv + j] * a->u[nv + k];
    }
  }
}

static void pull(kg_correction *c, const double *after_bar, double *before_bar)
{
  correction_adjoint *a = &c->adjoint;
  const int nv = c->nv;
  if (a->untouched) {
    for (int i = 0; i < nv; i++) {
      before_bar[i] += after_bar[i];
    }
    return;
  }
  memset(a->u, 0, (size_t)(nv + a->count) * sizeof *a->u);
  memcpy(a->u, after_bar, (size_t)nv * sizeof *a->u);
  correction_to_move(c, a->u);
  kg_dense_lu_solve(a->K, a->pivots, nv + a->count, a->u, 1);
  end_adjoint(c, after_bar);
  /* - d(u' M D)/dq0: the adjoint of inverse dynamics at rest, without gravity, by -u */
  for (int i = 0; i < nv; i++) {
    c->gradient[i] = -a->u[i];
  }
  kg_dynamics_inverse_vjp(c->dynamics, before_bar, NULL, NULL, NULL, c->q0, a->zero, c->D,
                          c->gradient);
  for (int i = 0; i < 3; i++) {
    before_bar[i] += a->end[i];
  }
  for (int i = 0; i < c->def.body->segment_count; i++) {
    double *bar = before_bar + 3 + 3 * i;
    kg_store3(bar,
              kg_vec3_add(kg_load3(bar), kg_mat3_mul_vec(a->E[i], kg_load3(a->end + 3 + 3 * i))));
  }
}

bool kg_correction_vjp(kg_correction *correction, const double *q_before, const double *q_after,
                       const double *after_bar, double *before_bar)
{
  KG_ASSERT(correction && q_before && q_after && after_bar && before_bar);
  if (!prepare(correction, q_before, q_after)) return false;
  pull(correction, after_bar, before_bar);
  return true;
}

bool kg_correction_jacobian(kg_correction *correction, const double *q_before,
                            const double *q_after, double *J)
{
  KG_ASSERT(correction && q_before && q_after && J);
  kg_correction *c = correction;
  if (!prepare(c, q_before, q_after)) return false;
  memset(J, 0, (size_t)c->nv * (size_t)c->nv * sizeof *J);
  for (int i = 0; i < c->nv; i++) {
    double *unit = c->D_trial;
    memset(unit, 0, (size_t)c->nv * sizeof *unit);
    unit[i] = 1.0;
    pull(c, unit, J + (size_t)i * (size_t)c->nv);
  }
  return true;
}
