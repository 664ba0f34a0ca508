/* kinegrad/newton.h - line-search Newton for a square system G(x) = 0 with its own factorisation.
 *
 * The caller supplies the residual, the Newton direction (so it can use its own sparsity) and a
 * scaling: the merit function is m(x) = |diag(scale) G(x)|_2.  The step length is the largest of
 * 1, 1/2, 1/4, ... with  m(x + alpha p) <= (1 - c1 alpha) m(x)
 * [NW] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, Algorithm 11.4. */
#ifndef KINEGRAD_NEWTON_H
#define KINEGRAD_NEWTON_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* G[n] at x[n]; false where G is undefined: the line search then steps back. */
typedef bool kg_residual_fn(double *G, const double *x, void *user);
/* p[n] with G'(x) p = -G at the x and G of the last accepted point; false when singular. */
typedef bool kg_newton_direction_fn(double *p, const double *x, const double *G, void *user);

/* Start from kg_newton_default_def(n). */
typedef struct kg_newton_def {
  int n;                /* unknowns, >= 1                                                        */
  double tolerance;     /* converged when m <= tolerance; unit of scale * G; default 1e-8        */
  int max_iterations;   /* default 50                                                            */
  int max_halvings;     /* of the step length; default 30                                        */
  double armijo_c1;     /* default 1e-4                                                          */
  double stall_ratio;   /* two steps in a row that leave m above this share: stalled; 0.9999     */
  const kg_allocator *allocator;
} kg_newton_def;

typedef enum kg_newton_stop {
  KG_NEWTON_CONVERGED,
  KG_NEWTON_STALLED,        /* no sufficient decrease within max_halvings, or stall_ratio */
  KG_NEWTON_MAX_ITERATIONS,
  KG_NEWTON_SINGULAR,
  KG_NEWTON_UNDEFINED       /* G undefined or not finite at the start */
} kg_newton_stop;

typedef struct kg_newton_report {
  kg_newton_stop stop;
  int iterations;   /* Newton steps taken                       */
  int evaluations;  /* of G                                     */
  int cuts;         /* halvings of the step length, in all      */
  double residual;  /* m at the returned x                      */
} kg_newton_report;

typedef struct kg_newton kg_newton; /* work memory; one per thread */

KG_API kg_newton_def kg_newton_default_def(int n);
KG_API KG_MUST_USE kg_status kg_newton_create(kg_newton **newton, const kg_newton_def *def);
KG_API void kg_newton_destroy(kg_newton *newton);

/* x[n]: start in, best point out. scale[n] > 0, or NULL for ones. Allocates nothing. */
KG_API kg_newton_report kg_newton_solve(kg_newton *newton, double *x, const double *scale,
                                        kg_residual_fn *residual, kg_newton_direction_fn *direction,
                                        void *user);

#ifdef __cplusplus
}
#endif
#endif
