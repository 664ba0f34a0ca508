/* kinegrad/step.h - one backward Euler step of a body with contact (docs/theory/dynamics.md).
 *
 * Solves for the end-of-step velocity v':
 *   G(v') = ID(q', v', (v' - v)/dt) + passive(q', v') - tau - J_c(q')' f_c(q', v') = 0,
 *   q' = q (+) dt v'
 * to |diag(M(q))^-1/2 G dt| <= tolerance (kg^1/2 m/s) by Newton's method: the body is linearised
 * exactly (sparse LU along the tree, leaf to root, no fill-in) and contact is solved with the
 * linear body on its own, three iterations for a step in the mean. What does not converge is
 * repeated in 2, 4, ... sub-steps and counted. Contact: docs/theory/contact.md, section 4. */
#ifndef KINEGRAD_STEP_H
#define KINEGRAD_STEP_H

#include "kinegrad/body.h"
#include "kinegrad/contact.h"
#include "kinegrad/dynamics.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_step kg_step; /* one per thread */

/* Passive torque of a ball joint, implicit: a spring about rest, damping, and one-sided springs at
 * limits of the three components of the rotation vector r = log(rest^-1 q). All but the damping has
 * the potential
 *   E = stiffness |r|^2 / 2 + limit_stiffness / 3 sum_k excess_k(r)^3,
 * so the torque is C1 at the limits. r is unique below half a turn, where limits have to be; across
 * half a turn it jumps to -r, and the torque with it, to the other side: choose rest so that the
 * joint stays away from there. docs/theory/dynamics.md, section 5. Start from
 * kg_joint_passive_default(). */
typedef struct kg_joint_passive {
  double stiffness;              /* N m/rad                                     */
  double damping;                /* N m s/rad, beside the step's joint_damping  */
  kg_quat rest;                  /* unit; all zero is taken for the identity    */
  kg_vec3 limit_low, limit_high; /* rad; -INFINITY, INFINITY: none              */
  double limit_stiffness;        /* N m/rad^2; 0: no limits                     */
} kg_joint_passive;

/* No spring, no damping, no limits; rest is the identity. */
KG_API kg_joint_passive kg_joint_passive_default(void);
/* J; without damping, which has none */
KG_API double kg_joint_passive_energy(const kg_joint_passive *passive, kg_quat q);

/* Start from kg_step_default_def(body). Pointers are borrowed and must outlive the step. */
typedef struct kg_step_def {
  const kg_body *body;
  const kg_scene *scene;      /* NULL: no contact                                             */
  kg_contact_params contact;
  kg_vec3 gravity;            /* default (0, -9.8, 0) m/s^2                                   */
  double joint_damping;       /* N m s/rad on every ball joint, implicit; default 0           */
  const kg_joint_passive *passive; /* one per segment, that of the root is not used; NULL: none */
  double tolerance;           /* kg^1/2 m/s; default 1e-8                                     */
  int max_iterations;         /* of Newton's method, each (sub-)step; default 50              */
  int max_substep_levels;     /* 2^levels sub-steps at most; default 6                        */
  const kg_allocator *allocator;
} kg_step_def;

typedef struct kg_step_contact {
  int point;                  /* index into body->points                                      */
  kg_vec3 x;                  /* position at the end of the step, m                           */
  kg_contact_force force;     /* derivatives are filled only where the step needed them       */
} kg_step_contact;

typedef struct kg_step_report {
  bool converged;             /* every (sub-)step reached the tolerance                       */
  int substeps;               /* 1 when the plain step converged                              */
  int iterations;             /* Newton's: factorisations of the body's Jacobian, all attempts
                                 and sub-steps                                                */
  int chord_steps;            /* with the factors of an iteration once more                   */
  int contact_iterations;     /* of the small contact problem inside these                    */
  int cuts;                   /* line-search halvings, of both                                */
  bool used_fallback;         /* softened contact or lagged normal forces had to show the way */
  double residual;            /* worst final residual, kg^1/2 m/s                             */
  int contact_count;          /* points inside the layer at the end                           */
  const kg_step_contact *contacts; /* owned by the step, valid until its next call            */
} kg_step_report;

KG_API kg_step_def kg_step_default_def(const kg_body *body);
KG_API KG_MUST_USE kg_status kg_step_create(kg_step **step, const kg_step_def *def);
KG_API void kg_step_destroy(kg_step *step);
/* Another contact law from here on. */
KG_API void kg_step_set_contact(kg_step *step, const kg_contact_params *contact);
/* Call it after masses, inertias, centres of mass, offsets or contact points of the body's segments
 * have changed. body->mass is not read. */
KG_API void kg_step_refresh(kg_step *step);

/* One step of dt seconds. q_next[nq], v_next[nv]: out; v_next is also the starting guess when
 * use_guess. tau[nv]: generalised force, root entries (force in world axes, moment in root
 * coordinates) included. In sub-steps tau is held. Allocates nothing. */
KG_API void kg_step_advance(kg_step *step, double *q_next, double *v_next, const double *q,
                            const double *v, const double *tau, double dt, bool use_guess,
                            kg_step_report *report);

/* G(v_next) with tau = 0 when tau is NULL, and its exact Jacobian dG/dv_next (nv*nv row-major, NULL
 * allowed; total derivative, through q' too). report, when not NULL: contact list, residual, and
 * whether that is within the tolerance. */
KG_API void kg_step_residual(kg_step *step, double *G, double *dG_dv_next, const double *v_next,
                             const double *q, const double *v, const double *tau, double dt,
                             kg_step_report *report);

/* ---- derivatives of the step (docs/theory/dynamics.md, section 8) ---------------------------- */

/* Where a gradient goes; NULL: not wanted. Results are added. */
typedef struct kg_step_gradient {
  double *q, *v, *tau;   /* nv; q in tangent space                                            */
  double *contact;       /* KG_CONTACT_PARAM_COUNT, order of kg_contact_params                 */
  double *joint_damping; /* 1                                                                  */
  double *passive;       /* 3 n: stiffness, damping, limit_stiffness of every joint            */
  kg_body_gradient body;
} kg_step_gradient;

/* Gradient of q_next_bar . q_next + v_next_bar . v_next (q_next_bar in the tangent space of q_next;
 * nv each) for the step from (q, v) that ended at v_next, by the implicit function theorem: one
 * transposed solve with the exact Jacobian at v_next, however v_next was found. substeps: as
 * reported by kg_step_advance; with more than one the sub-steps are repeated and gone back through.
 * KG_ERR_UNDEFINED: v_next does not solve the step to ten times the tolerance, or the Jacobian is
 * singular, at the end of any sub-step; nothing is added then. The gradient's arrays must not
 * overlap the arguments. Allocates nothing. */
KG_API KG_MUST_USE kg_status kg_step_vjp(kg_step *step, const kg_step_gradient *gradient,
                                         const double *q, const double *v, const double *tau,
                                         double dt, const double *v_next, int substeps,
                                         const double *q_next_bar, const double *v_next_bar);

/* nv*nv row-major each, q and q_next in their tangent spaces; NULL: not wanted. */
typedef struct kg_step_jacobian {
  double *dv_dq, *dv_dv, *dv_dtau; /* of v_next */
  double *dq_dq, *dq_dv, *dq_dtau; /* of q_next */
} kg_step_jacobian;

/* All derivatives of a step by its state and forces. Arguments and status as in kg_step_vjp. */
KG_API KG_MUST_USE kg_status kg_step_derivatives(kg_step *step, const kg_step_jacobian *jacobian,
                                                 const double *q, const double *v,
                                                 const double *tau, double dt,
                                                 const double *v_next, int substeps);

#ifdef __cplusplus
}
#endif
#endif
