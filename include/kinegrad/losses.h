/* kinegrad/losses.h - losses of the paper on the tape, with exact gradients. */
#ifndef KINEGRAD_LOSSES_H
#define KINEGRAD_LOSSES_H

#include "kinegrad/dynamics_operators.h"

#ifdef __cplusplus
extern "C" {
#endif

/* L_dyn (Eq. 2; docs/theory/dynamics.md, section 9): how far a motion is from what torques and
 * contact forces make of the body,
 *   L_dyn = mean over frames t of |a_mocap_t - a_phy_t|^2   ((m/s^2)^2),
 * both the accelerations of all n joints in the world.
 *   a_mocap  second difference of the joints' places, over dt^2
 *   a_phy    of the joints, for generalised accelerations FD(q_t, v_t, tau_t + sum_k J_k' f_tk) by
 *            the operators' gravity; v_t as kg_motion_velocities
 * over the inner frames 1 .. T-2 of each sequence, T >= 3.
 *
 * q         (..., T, nq)   the motion, smoothed by the caller: second differences make noise of
 *                          1/dt^2 times its size
 * positions (..., T, n, 3) joints' places for a_mocap; null: those of q
 * tau       (..., T, nv), or (..., T, nv - 6): then nothing acts on the root, which no muscle moves
 * forces    (..., T, point_count, 3) in the world on the body's points; null: none
 * Entries of the first and last frame of tau and forces are not used. At most one leading dimension. */
KG_API kg_value kg_dynamics_loss(kg_tape *tape, kg_dynamics_operators *operators, double dt,
                                 kg_value q, kg_value positions, kg_value tau, kg_value forces);

#ifdef __cplusplus
}
#endif
#endif
