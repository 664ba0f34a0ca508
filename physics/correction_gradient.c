/* Eq. 11 with a step that cannot overshoot; symbols in correction.h. */
#include "physics/correction.h"

#include "kinegrad/dense.h"

#include <string.h>

/* of the segment's point at x */
static kg_vec3 rate_at(const kg_correction *c, int segment, kg_vec3 x)
{
  const kg_vec3 arm = kg_vec3_sub(x, c->p[segment]);
  return kg_vec3_add(c->p_dot[segment], kg_vec3_cross(c->w[segment], arm));
}

/* slope' H slope with the Gauss-Newton Hessian of L_coll, 2 sum (n_k' J_k slope)^2 over the points
 * inside: from the velocities the points have when the pose moves at the rate `slope` */
static double curvature(kg_correction *c)
{
  const kg_body *body = c->def.body;
  for (int i = 0; i < body->segment_count; i++) {
    const int parent = body->segments[i].parent;
    c->w[i] = kg_mat3_mul_vec(c->R[i], kg_load3(c->slope + 3 + 3 * i));
    c->p_dot[i] = kg_load3(c->slope);
    if (parent >= 0) {
      c->w[i] = kg_vec3_add(c->w[i], c->w[parent]);
      c->p_dot[i] = kg_vec3_add(c->p_dot[parent],
                                kg_vec3_cross(c->w[parent], kg_vec3_sub(c->p[i], c->p[parent])));
    }
  }
  double sum = 0.0;
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    if (!(t->at.distance < 0.0)) continue;
    kg_vec3 rate = rate_at(c, body->points[t->point].segment, t->x);
    if (t->other >= 0) rate = kg_vec3_sub(rate, rate_at(c, t->other, t->x));
    const double phi_rate = kg_vec3_dot(t->at.normal, rate);
    sum += 2.0 * phi_rate * phi_rate;
  }
  return sum;
}

/* One step of (11) from q_now (sampled). The gradient is taken in the metric M / m, so that a
 * rotation is weighed against a translation by what it moves. eta is cut to the minimum of the
 * Gauss-Newton model and halved until L_coll falls by half of what the model predicts. False when
 * it does not fall. */
bool correction_gradient_step(kg_correction *c)
{
  const double L = c->L_coll;
  correction_loss_gradient(c, c->gradient);
  memcpy(c->slope, c->gradient, (size_t)c->nv * sizeof *c->slope);
  kg_dense_cholesky_solve(c->chol, c->nv, c->slope, 1);
  double turn = CORRECTION_STEP_MAX;
  for (int i = 0; i < c->nv; i++) {
    c->slope[i] *= c->def.body->mass;
  }
  for (int i = 0; i < c->nv; i += 3) {
    turn = fmax(turn, c->def.eta * kg_vec3_norm(kg_load3(c->slope + i)));
  }
  const double fall = correction_dot(c->gradient, c->slope, c->nv);
  const double bend = curvature(c);
  if (!(fall > 0.0 && bend > 0.0)) return false;
  double eta = fmin(c->def.eta * CORRECTION_STEP_MAX / turn, fall / bend);
  memcpy(c->q_from, c->q_now, (size_t)c->def.body->nq * sizeof *c->q_from);
  for (int halving = 0; halving < 30; halving++, eta *= 0.5) {
    for (int i = 0; i < c->nv; i++) {
      c->D_trial[i] = -eta * c->slope[i];
    }
    kg_body_integrate(c->def.body, c->q_now, c->q_from, c->D_trial);
    correction_sample(c, c->q_now);
    if (c->L_coll <= L - 0.5 * (eta * fall - 0.5 * eta * eta * bend)) return true;
  }
  memcpy(c->q_now, c->q_from, (size_t)c->def.body->nq * sizeof *c->q_from);
  correction_sample(c, c->q_now);
  return false;
}

void correction_descend(kg_correction *c, int *iterations)
{
  while (c->d_pen > 0.9 * c->def.tolerance && *iterations < c->def.max_iterations) {
    if (!correction_gradient_step(c)) return;
    ++*iterations;
  }
}
