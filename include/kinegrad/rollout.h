/* kinegrad/rollout.h - a run of implicit steps and the gradient through all of it.
 *
 *   x_{t+1} = step(x_t, tau_t; parameters),  t = 0 .. T-1,   x = (q, v)
 *   L = sum over t of l_t(x_t)   ->   dL/dx_0, dL/dtau_t, dL/dparameters
 *
 * Backward takes one transposed solve a step (kg_step_vjp). Memory: every state, or with
 * checkpoints about 2 sqrt(T) of them, at the price of running once more; the gradient is the same,
 * bit for bit. Gradients of long runs grow where the motion is unstable or undamped: cut the
 * horizon, or damp. */
#ifndef KINEGRAD_ROLLOUT_H
#define KINEGRAD_ROLLOUT_H

#include "kinegrad/step.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_rollout kg_rollout;

typedef struct kg_rollout_def {
  kg_step *step;       /* borrowed, used by every call                              */
  int max_steps;       /* T at most                                                 */
  double dt;           /* s                                                         */
  bool checkpoints;    /* memory for about 2 sqrt(max_steps) states instead of all  */
  const kg_allocator *allocator;
} kg_rollout_def;

KG_API KG_MUST_USE kg_status kg_rollout_create(kg_rollout **rollout, const kg_rollout_def *def);
KG_API void kg_rollout_destroy(kg_rollout *rollout);

typedef struct kg_rollout_report {
  int steps;       /* that converged: all, or up to the first that did not */
  int substepped;  /* steps that were divided                              */
  int iterations;  /* Newton iterations of all steps                       */
  double residual; /* the worst, kg^1/2 m/s                                */
} kg_rollout_report;

/* Runs T = steps steps, 1 to max_steps, from (q, v) under tau (steps, nv), which is borrowed until
 * the last gradient of this run. KG_ERR_SHAPE: another number of steps; nothing is run.
 * q_out (steps + 1, nq), v_out (steps + 1, nv), report: NULL where not wanted.
 * KG_ERR_UNDEFINED: a step did not converge; what came before it is written. Allocates nothing. */
KG_API KG_MUST_USE kg_status kg_rollout_run(kg_rollout *rollout, int steps, const double *q,
                                            const double *v, const double *tau, double *q_out,
                                            double *v_out, kg_rollout_report *report);

/* Adds dl_t/dx_t at state t (0 .. T) to q_bar (tangent space) and v_bar [nv]. */
typedef void kg_rollout_cotangent(void *user, int t, const double *q, const double *v,
                                  double *q_bar, double *v_bar);

/* A kg_rollout_cotangent whose user is a kg_rollout_arrays: (T + 1, nv) each, NULL: zero. */
typedef struct kg_rollout_arrays {
  int nv;
  const double *q_bar, *v_bar;
} kg_rollout_arrays;
KG_API void kg_rollout_add_arrays(void *arrays, int t, const double *q, const double *v,
                                  double *q_bar, double *v_bar);

/* Where a gradient goes; NULL: not wanted. Results are added. q, v: of the first state, nv; tau
 * (steps, nv); the others as in kg_step_gradient. */
typedef struct kg_rollout_gradient {
  double *q, *v, *tau;
  double *contact, *joint_damping, *passive;
  kg_body_gradient body;
} kg_rollout_gradient;

/* Gradient of the last run. May be called again. Between the run and here the step's contact law,
 * its body, its passive joints and tau must stay as they are. KG_ERR_UNDEFINED: there was no run, or
 * it did not converge; what is repeated does not converge or ends elsewhere (something changed); a
 * step has no derivatives (kg_step_vjp). In the first case nothing is added, in the others the steps
 * behind the failure have been added to tau and the parameters, and nothing to q and v: discard
 * them. Allocates nothing. */
KG_API KG_MUST_USE kg_status kg_rollout_vjp(kg_rollout *rollout,
                                            const kg_rollout_gradient *gradient,
                                            kg_rollout_cotangent *cotangent, void *user);

#ifdef __cplusplus
}
#endif
#endif
