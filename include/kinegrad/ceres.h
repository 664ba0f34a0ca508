/* kinegrad/ceres.h - dense nonlinear least squares through Ceres: the independent answer to the
 * problems our own solvers solve.
 *
 *   minimise  1/2 |r(x)|^2   subject to  lower <= x <= upper
 *
 * Nothing is printed, on stdout or stderr, and no exception leaves the call. A square system
 * G(x) = 0 is the case residual_count = n. */
#ifndef KINEGRAD_CERES_H
#define KINEGRAD_CERES_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* r[m] at x[n]; false where it is undefined: the step is then shortened. */
typedef bool kg_ceres_residual_fn(double *r, const double *x, void *user);
/* J[m*n] row-major, dr/dx at x. */
typedef bool kg_ceres_jacobian_fn(double *J, const double *x, void *user);

/* Start from kg_ceres_default_def(n, m). */
typedef struct kg_ceres_def {
  int n;                          /* unknowns, >= 1                                              */
  int residual_count;             /* m >= 1                                                      */
  kg_ceres_residual_fn *residual;
  kg_ceres_jacobian_fn *jacobian; /* NULL: differences of order 4, four evaluations an unknown;
                                     they may leave the bounds                                   */
  void *user;
  const double *lower, *upper;    /* [n] each, or NULL; the start is moved between them          */
  int max_iterations;             /* default 200                                                 */
  double gradient_tolerance;      /* on max|J'r|, absolute; default 1e-12                        */
  double function_tolerance;      /* relative change of the cost; default 1e-16                  */
  double parameter_tolerance;     /* relative change of x; default 1e-15                         */
} kg_ceres_def;

typedef struct kg_ceres_report {
  bool converged;     /* one of the tolerances was met              */
  int iterations;     /* steps tried                                */
  double cost_before; /* 1/2 |r|^2                                  */
  double cost;
  char text[256];     /* why it stopped, in Ceres' words            */
} kg_ceres_report;

KG_API kg_ceres_def kg_ceres_default_def(int n, int residual_count);

/* x[n]: start in, best point out.
 * KG_ERR_UNDEFINED: r is undefined or not finite at the start. KG_ERR_NO_MEMORY. */
KG_API KG_MUST_USE kg_status kg_ceres_minimize(const kg_ceres_def *def, double *x,
                                               kg_ceres_report *report);

#ifdef __cplusplus
}
#endif
#endif
