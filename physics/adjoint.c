/* Vector-Jacobian products of inverse and forward dynamics, kinematics and point forces, without a
 * matrix (chain.h).
 *
 * Equation numbers: docs/theory/dynamics.md, section 7. */
#include "physics/chain.h"
#include "physics/tree.h"

#include <string.h>

void kg_dynamics_inverse_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar, double *a_bar,
                             const kg_body_gradient *body_bar, const double *q, const double *v,
                             const double *a, const double *lambda)
{
  kg_chain *chain = &dynamics->chain;
  const kg_chain_gradient out = {
    .q = q_bar, .v = v_bar, .a = a_bar, .offset = body_bar ? body_bar->offset : NULL};
  kg_chain_pose(chain, q);
  kg_chain_velocity(chain, v);
  kg_chain_acceleration(chain, v, a, dynamics->gravity);
  kg_chain_field(chain, lambda);
  kg_chain_clear(chain);
  kg_chain_inertial(chain, body_bar);
  kg_chain_return(chain, KG_CHAIN_ACCELERATION | KG_CHAIN_FIELD, v, &out);
}

void kg_dynamics_forward_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar, double *tau_bar,
                             const double *q, const double *v, const double *a, const double *a_bar)
{
  kg_chain *chain = &dynamics->chain;
  const int nv = dynamics->body->nv;
  memcpy(chain->nu, a_bar, (size_t)nv * sizeof *a_bar);
  kg_dynamics_mass_solve(dynamics, chain->nu, q);
  for (int k = 0; k < nv; k++) {
    if (tau_bar) tau_bar[k] += chain->nu[k];
    chain->nu[k] = -chain->nu[k]; /* ID(q, v, FD) = tau: d a = -M^-1 d ID */
  }
  kg_dynamics_inverse_vjp(dynamics, q_bar, v_bar, NULL, NULL, q, v, a, chain->nu);
}

void kg_dynamics_motion_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar, double *a_bar,
                            double *offset_bar, const double *q, const double *v, const double *a,
                            const kg_vec3 *place_bar, const kg_vec3 *velocity_bar,
                            const kg_vec3 *acceleration_bar)
{
  kg_chain *chain = &dynamics->chain;
  const kg_chain_gradient out = {.q = q_bar, .v = v_bar, .a = a_bar, .offset = offset_bar};
  int parts = KG_CHAIN_POSE;
  kg_chain_pose(chain, q);
  if (velocity_bar || acceleration_bar) {
    kg_chain_velocity(chain, v);
    parts |= KG_CHAIN_VELOCITY;
  }
  if (acceleration_bar) {
    kg_chain_acceleration(chain, v, a, kg_vec3_make(0.0, 0.0, 0.0));
    parts |= KG_CHAIN_ACCELERATION;
  }
  kg_chain_clear(chain);
  for (int i = 0; i < chain->n; i++) {
    kg_chain_joint(chain, i, place_bar ? &place_bar[i] : NULL,
                   velocity_bar ? &velocity_bar[i] : NULL,
                   acceleration_bar ? &acceleration_bar[i] : NULL);
  }
  kg_chain_return(chain, parts, v, &out);
}

void kg_dynamics_point_forces(kg_dynamics *dynamics, double *tau, const double *q, const kg_vec3 *f)
{
  kg_chain *chain = &dynamics->chain;
  const kg_body *body = dynamics->body;
  memset(tau, 0, (size_t)body->nv * sizeof *tau);
  memset(chain->nu, 0, (size_t)body->nv * sizeof *tau);
  kg_chain_pose(chain, q);
  kg_chain_field(chain, chain->nu);
  kg_chain_clear(chain);
  for (int k = 0; k < body->point_count; k++) {
    kg_chain_force(chain, body->points[k].segment, body->points[k].p, f[k]);
  }
  kg_chain_return(chain, KG_CHAIN_FIELD, NULL, &(kg_chain_gradient){.lambda = tau});
}

void kg_dynamics_point_forces_vjp(kg_dynamics *dynamics, double *q_bar, kg_vec3 *f_bar,
                                  const double *q, const kg_vec3 *f, const double *tau_bar)
{
  kg_chain *chain = &dynamics->chain;
  const kg_body *body = dynamics->body;
  kg_chain_pose(chain, q);
  kg_chain_field(chain, tau_bar);
  kg_chain_clear(chain);
  for (int k = 0; k < body->point_count; k++) {
    const kg_body_point *point = &body->points[k];
    const kg_chain_link *l = &chain->links[point->segment];
    kg_chain_point(chain, point->segment, point->p, NULL, NULL, &f[k], NULL);
    if (f_bar) {
      const kg_vec3 xi = kg_vec3_add(l->pi, kg_vec3_cross(l->mu, point->p));
      f_bar[k] = kg_vec3_add(f_bar[k], kg_mat3_mul_vec(l->R, xi));
    }
  }
  kg_chain_return(chain, KG_CHAIN_POSE | KG_CHAIN_FIELD, NULL, &(kg_chain_gradient){.q = q_bar});
}

void kg_dynamics_points(kg_dynamics *dynamics, kg_vec3 *x, kg_vec3 *x_dot, const double *q,
                        const double *v)
{
  const kg_chain *chain = &dynamics->chain;
  const kg_body *body = dynamics->body;
  kg_chain_pose(&dynamics->chain, q);
  if (x_dot) {
    kg_chain_velocity(&dynamics->chain, v);
  }
  for (int k = 0; k < body->point_count; k++) {
    const kg_chain_link *l = &chain->links[body->points[k].segment];
    const kg_vec3 p = body->points[k].p;
    x[k] = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, p));
    if (x_dot) {
      x_dot[k] = kg_mat3_mul_vec(l->R, kg_vec3_add(l->v, kg_vec3_cross(l->w, p)));
    }
  }
}

void kg_dynamics_points_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar, const double *q,
                            const double *v, const kg_vec3 *x_bar, const kg_vec3 *x_dot_bar)
{
  kg_chain *chain = &dynamics->chain;
  const kg_chain_gradient out = {.q = q_bar, .v = v_bar};
  kg_chain_pose(chain, q);
  if (x_dot_bar) {
    kg_chain_velocity(chain, v);
  }
  kg_chain_clear(chain);
  for (int k = 0; k < dynamics->body->point_count; k++) {
    const kg_body_point *point = &dynamics->body->points[k];
    kg_chain_point(chain, point->segment, point->p, &x_bar[k], x_dot_bar ? &x_dot_bar[k] : NULL,
                   NULL, NULL);
  }
  kg_chain_return(chain, KG_CHAIN_POSE | (x_dot_bar ? KG_CHAIN_VELOCITY : 0), v, &out);
}
