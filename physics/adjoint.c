/* Vector-Jacobian products of inverse dynamics, without a matrix (chain.h).
 *
 * Equation numbers: docs/theory/dynamics.md, section 7. */
#include "physics/chain.h"
#include "physics/tree.h"

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
