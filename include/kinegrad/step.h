/* kinegrad/step.h - one backward Euler step of a body with contact (docs/theory/dynamics.md).
 *
 * Solves for the end-of-step velocity v':
 *   G(v') = ID(q', v', (v' - v)/dt) + c v'_joint - tau - J_c(q')' f_c(q', v') = 0,
 *   q' = q (+) dt v'
 * by Newton's method with line search on |diag(M(q))^-1/2 G dt| (kg^1/2 m/s), exact Jacobian,
 * sparse LU along the tree (leaf to root, no fill-in). Where Newton fails from the starting guess,
 * the step is solved with a softened contact law first and followed to the true one; where that
 * fails too, it is repeated in 2, 4, ... sub-steps and counted. Contact: docs/theory/contact.md. */
#ifndef KINEGRAD_STEP_H
#define KINEGRAD_STEP_H

#include "kinegrad/body.h"
#include "kinegrad/contact.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/newton.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_step kg_step; /* one per thread */

/* Start from kg_step_default_def(body). Pointers are borrowed and must outlive the step. */
typedef struct kg_step_def {
  const kg_body *body;
  const kg_scene *scene;      /* NULL: no contact                                             */
  kg_contact_params contact;
  kg_vec3 gravity;            /* default (0, -9.8, 0) m/s^2                                   */
  double joint_damping;       /* N m s/rad on every ball joint, implicit; default 0           */
  double tolerance;           /* kg^1/2 m/s; default 1e-8                                     */
  int max_iterations;         /* default 50                                                   */
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
  int iterations;             /* Newton iterations of all attempts and sub-steps              */
  int cuts;                   /* line-search halvings                                         */
  double residual;            /* worst final residual, kg^1/2 m/s                             */
  int contact_count;          /* points inside the layer at the end                           */
  const kg_step_contact *contacts; /* owned by the step, valid until its next call            */
} kg_step_report;

KG_API kg_step_def kg_step_default_def(const kg_body *body);
KG_API KG_MUST_USE kg_status kg_step_create(kg_step **step, const kg_step_def *def);
KG_API void kg_step_destroy(kg_step *step);

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

#ifdef __cplusplus
}
#endif
#endif
