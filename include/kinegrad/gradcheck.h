/* kinegrad/gradcheck.h - is this derivative right? Any function, four independent questions.
 *
 *   value of the derivative   the gradient against numerical differentiation, entry by entry: complex step where
 *                             the function can be run in complex numbers, else Ridders' extrapolated
 *                             central differences with their own error estimate
 *   Taylor order              |f(x + h d) - f(x)| falls like h, |f(x + h d) - f(x) - h J d| like h^2, along a random d
 *   dot test                  <w, J d> = <J' w, d>, where both products exist
 *   repeatability             a second and third call return the same bits
 *
 * [Ridders] C. J. F. Ridders, Accurate computation of F'(x) and F'(x) F''(x), Advances in Engineering
 * Software 4 (1982). [CS] W. Squire, G. Trapp, SIAM Review 40 (1998). */
#ifndef KINEGRAD_GRADCHECK_H
#define KINEGRAD_GRADCHECK_H

#include "kinegrad/operators.h"

#ifdef __cplusplus
extern "C" {
#endif

/* A function R^inputs -> R^outputs with derivatives, written in any way. */
typedef struct kg_differentiable {
  const char *name;
  size_t inputs, outputs;
  void *user;
  kg_status (*value)(void *user, const double *x, double *y);
  kg_status (*vjp)(void *user, const double *x, const double *w, double *xw); /* xw = J' w */
  kg_status (*jvp)(void *user, const double *x, const double *d, double *yd); /* optional: yd = J d */
  /* Optional: imaginary part of value(x + i h d), divided by h. */
  kg_status (*complex_step)(void *user, const double *x, const double *d, double *yd);
} kg_differentiable;

/* The same from a recording function: values, products and the complex step come from the tape. */
typedef kg_value (*kg_recorded)(kg_tape *tape, kg_value x, void *user);

typedef struct kg_gradcheck_def {
  double tolerance;       /* 1e-7; 1e-12 is used where a complex step exists: largest error over the largest entry */
  double dot_tolerance;   /* 1e-13, of the product of the norms */
  double step;            /* 1e-2: first step of Ridders' table, times max(1, |x|) */
  int directions;         /* 3: random directions for Taylor and dot tests */
  bool taylor;            /* true; off where the function is known to have kinks nearby */
  uint64_t seed;          /* 1 */
  const kg_allocator *allocator;
} kg_gradcheck_def;

KG_API kg_gradcheck_def kg_gradcheck_default_def(void);

typedef struct kg_gradcheck_report {
  const char *name;
  bool passed;
  const char *method;       /* "complex step" or "Ridders" */
  double max_relative_error;
  size_t worst_output, worst_input; /* where */
  double worst_analytic, worst_numeric;
  double error_estimate;    /* of the numerical derivative itself, relative; 0 for a complex step */
  double dot_test;          /* largest |<w, J d> - <J' w, d>| / (|w| |J d| + |J' w| |d|); NaN: no jvp  */
  double taylor_order;      /* least order of the remainder found, 2 is right; NaN: not measured; +inf: exact */
  bool repeatable;
} kg_gradcheck_report;

/* KG_OK when the check could be made, whatever its answer; a failure of the function itself is returned. */
KG_API kg_status kg_gradcheck(const kg_differentiable *function, const double *x,
                              const kg_gradcheck_def *def, kg_gradcheck_report *report,
                              kg_error *error);
KG_API kg_status kg_gradcheck_recorded(const char *name, kg_recorded function, void *user,
                                       kg_shape shape, const double *x, const kg_gradcheck_def *def,
                                       kg_gradcheck_report *report, kg_error *error);

/* One line of a table for a terminal, without newline; index < 0 writes the heading. Returns the length as snprintf. */
KG_API int kg_gradcheck_row(const kg_gradcheck_report *report, char *text, size_t size);

/* -- the registry: every operator and primitive of the library, with its sample points --------------- */

KG_API int kg_registry_count(void);
KG_API const char *kg_registry_name(int i);
/* Checks entry i at `points` random points of its domain and beside its kinks; the worst is reported. */
KG_API kg_status kg_registry_check(int i, int points, const kg_gradcheck_def *def,
                                   kg_gradcheck_report *report, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
