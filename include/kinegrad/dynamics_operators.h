/* kinegrad/dynamics_operators.h - dynamics, contact and the implicit step as operators on the tape.
 *
 * Operands are the arrays of body.h with any leading dimensions: q (..., nq), v (..., nv), and so
 * on; the leading dimensions of all operands of a call are the same. The quaternions of q need not
 * be unit: they are normalised inside, so that a gradient by q is orthogonal to each of them (and
 * the gradient by an optimiser's q leaves lengths alone).
 *
 * Derivatives are exact: adjoints without matrices for dynamics and kinematics, the implicit
 * function theorem for the step (docs/theory/dynamics.md, sections 7 and 8). Backward mode only. */
#ifndef KINEGRAD_DYNAMICS_OPERATORS_H
#define KINEGRAD_DYNAMICS_OPERATORS_H

#include "kinegrad/operators.h"
#include "kinegrad/step.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The operators of one body: one thread at a time, and must outlive tapes and programs that use
 * them. */
typedef struct kg_dynamics_operators kg_dynamics_operators;

/* step: body, gravity, ground, contact law, passive joints, as for kg_step_create; dt: of
 * kg_implicit_step, s. Body and scene are copied (later changes are not seen). step->passive and the
 * scene's meshes are borrowed: they must outlive the operators. */
KG_API KG_MUST_USE kg_status kg_dynamics_operators_create(kg_dynamics_operators **operators,
                                                          const kg_step_def *step, double dt);
KG_API void kg_dynamics_operators_destroy(kg_dynamics_operators *operators);

/* (q, v, a) -> tau (..., nv) */
KG_API kg_value kg_inverse_dynamics(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                    kg_value v, kg_value a);
/* (q, v, tau) -> a (..., nv) */
KG_API kg_value kg_forward_dynamics(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                    kg_value v, kg_value tau);

/* Joints in the world: places (..., n, 3), m; velocities, m/s; accelerations without gravity,
 * m/s^2. */
KG_API kg_value kg_joint_positions(kg_tape *tape, kg_dynamics_operators *operators, kg_value q);
KG_API kg_value kg_joint_velocities(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                    kg_value v);
KG_API kg_value kg_joint_accelerations(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                       kg_value v, kg_value a);
/* Points of the body in the world (..., point_count, 3), m */
KG_API kg_value kg_point_positions(kg_tape *tape, kg_dynamics_operators *operators, kg_value q);

/* Velocities of a motion q (..., T, nq) with frames dt apart: central differences of its inner
 * frames, (q_{t+1} - q_{t-1}) / (2 dt) in the tangent space -> (..., T - 2, nv). T >= 3. */
KG_API kg_value kg_motion_velocities(kg_tape *tape, kg_dynamics_operators *operators, double dt,
                                     kg_value q);

/* Forces f (..., point_count, 3) in the world on the body's points -> generalised forces (...,
 * nv) */
KG_API kg_value kg_point_forces(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                kg_value f);
/* Forces of the ground on the body's points (..., point_count, 3); law (6): numbers of
 * kg_contact_params in their order, for all leading dimensions, or null: the step's. */
KG_API kg_value kg_contact_forces(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                  kg_value v, kg_value law);

/* The implicit step: (q, v, tau) -> q' and v' end to end (..., nq + nv). law (6), masses (n) and
 * offsets (n, 3) of the segments are shared by all leading dimensions; null: the step's own. A step
 * that does not converge has no value: KG_ERR_UNDEFINED. */
KG_API kg_value kg_implicit_step(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                 kg_value v, kg_value tau, kg_value law, kg_value masses,
                                 kg_value offsets);

/* L_coll of a pose, Eq. 10 (correction.h), in the step's scene -> (..., 1), m^2. */
KG_API kg_value kg_collision_loss(kg_tape *tape, kg_dynamics_operators *operators, kg_value q);

/* The pose carried out of the scene by the least move (correction.h) -> (..., nq). Where a point
 * begins or ceases to carry the gradient is one-sided. A pose that does not come out, or not by a
 * move that is the least to 1e-8 kg^1/2 m, has no value: KG_ERR_UNDEFINED. */
KG_API kg_value kg_corrected_pose(kg_tape *tape, kg_dynamics_operators *operators, kg_value q);

#ifdef __cplusplus
}
#endif
#endif
