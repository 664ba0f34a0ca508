/* MuJoCo on a body's own model (kg_body_write_mjcf): what is timed beside physics/. */
#ifndef BENCH_DYNAMICS_MUJOCO_PEER_H
#define BENCH_DYNAMICS_MUJOCO_PEER_H

#include "kinegrad/body.h"

typedef struct kg_mujoco kg_mujoco;

typedef enum kg_mujoco_integrator {
  KG_MUJOCO_EULER,   /* mjINT_EULER: semi-implicit, damping of joints implicit */
  KG_MUJOCO_IMPLICIT /* mjINT_IMPLICIT: one solve with the derivatives by velocity */
} kg_mujoco_integrator;

typedef struct kg_mujoco_def {
  const kg_body *body;
  bool has_shapes; /* geoms and contact with the ground; else neither, no constraint solver */
  bool has_motors; /* an actuator for every degree of freedom                               */
  double timestep; /* s                                                                     */
  kg_mujoco_integrator integrator;
  double joint_damping; /* N m s/rad on every ball joint                                         */
  double joint_stiffness; /* N m/rad, towards the identity                                       */
  double margin; /* m; contact acts from this distance on, as our layer does              */
} kg_mujoco_def;

/* KG_ERR_FORMAT: MuJoCo does not take the model, what it says is on stderr. */
kg_status kg_mujoco_open(kg_mujoco **mujoco, const kg_mujoco_def *def);
void kg_mujoco_close(kg_mujoco *mujoco);

/* ---- one stage of the pipeline and what it needs; states are copied in, answers out ---------- */

/* tau = ID(q, v, a): mj_kinematics, mj_comPos, mj_comVel, mj_rne. */
void kg_mujoco_rne(kg_mujoco *s, double *tau, const double *q, const double *v, const double *a);
/* The same by mj_inverse, without constraints. */
void kg_mujoco_inverse(kg_mujoco *s, double *tau, const double *q, const double *v,
                       const double *a);
/* M dense: mj_kinematics, mj_comPos, mj_crb, mj_fullM. */
void kg_mujoco_mass_matrix(kg_mujoco *s, double *M, const double *q);
/* J (3 x nv) of a point of the last segment: mj_jac after the stages it builds on */
void kg_mujoco_point(kg_mujoco *s, double *J, const double *q, const double point[3]);
/* x := M^-1 x: mj_kinematics, mj_comPos, mj_crb, mj_factorM, mj_solveM. */
void kg_mujoco_mass_solve(kg_mujoco *s, double *x, const double *q);
/* a = FD(q, v, tau): the stages of the mass matrix and of mj_rne, one mj_solveM. */
void kg_mujoco_smooth_forward(kg_mujoco *s, double *a, const double *q, const double *v,
                              const double *tau);
/* The same by mj_forward, without constraints. */
void kg_mujoco_forward(kg_mujoco *s, double *a, const double *q, const double *v,
                       const double *tau);
/* Positions and rotations (row-major) of the segments: mj_kinematics. */
void kg_mujoco_pose(kg_mujoco *s, double *p, double *R, const double *q);

/* ---- whole steps ----------------------------------------------------------------------------- */

/* Start of a run: no warm start is left over. */
void kg_mujoco_set_state(kg_mujoco *s, const double *q, const double *v);
/* mj_step with these generalised forces. */
void kg_mujoco_step(kg_mujoco *s, const double *tau);
void kg_mujoco_get_state(const kg_mujoco *s, double *q, double *v);
void kg_mujoco_set_timestep(kg_mujoco *s, double timestep);
/* Of the step before: contacts, and the sum of their forces along y, N. */
int kg_mujoco_contacts(const kg_mujoco *s);
double kg_mujoco_support(const kg_mujoco *s);
/* mjd_transitionFD with one-sided differences of 1e-6 at the state that was set: derivatives of the
 * next (q, v) by (q, v), A (2 nv x 2 nv), and by the motors' forces, B (2 nv x nv). */
void kg_mujoco_transition(kg_mujoco *s, double *A, double *B, const double *tau);

#endif
