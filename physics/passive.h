/* Inside physics/: the passive torque of a ball joint (kg_joint_passive), exact derivative
 * included.
 *
 * Equation numbers: docs/theory/dynamics.md, section 5. */
#ifndef PHYSICS_PASSIVE_H
#define PHYSICS_PASSIVE_H

#include "kinegrad/step.h"

/* Gradient of the potential by a turn of the joint (on the right, segment axes), (P3); by_turn,
 * when not NULL: its derivative by another such turn, (P4). Without damping. */
kg_vec3 kg_passive_torque(const kg_joint_passive *passive, kg_quat q, kg_mat3 *by_turn);

/* Adds lambda' times the derivatives of the torque by stiffness, damping and limit stiffness. */
void kg_passive_gradient(const kg_joint_passive *passive, kg_quat q, kg_vec3 w, kg_vec3 lambda,
                         double bar[3]);

#endif
