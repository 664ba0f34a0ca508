/* kinegrad/gradcheck.h - is this derivative right? Any function, four independent questions.
 *
 *   entries          J' e_i and J e_j against numerical differentiation, entry by entry: complex
 *                    step [CS] where the function can be run in complex numbers, else extrapolated
 *                    central differences with their own error estimate [Ridders]
 *   Taylor order     |f(x + h d) - f(x) - h J d| falls like h^2 along random directions d
 *   dot test         <w, J d> = <J' w, d>
 *   repeatability    a second and a third call return the same bits, other points in between
 *
 * How an entry is judged. Its error is put over the largest entry of J. Where the differences
 * resolve more, it is put over the entry itself: in 1e8 x_0 + sin x_1 the wrong sign of the small
 * entry is found. Entries that would change f by less than 1e-5 of itself (1e-2 with a complex
 * step) over max(1, |x_j|) count as that large. A numerical derivative whose own error is larger
 * than the tolerance decides nothing (f is noisy, or its second derivative jumps nearby): that is
 * not a pass, and the row says "undecided".
 *
 * [Ridders] C. J. F. Ridders, Accurate computation of F'(x) and F'(x) F''(x), Advances in
 * Engineering Software 4 (1982). [CS] W. Squire, G. Trapp, SIAM Review 40 (1998). */
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
  /* Optional: yd = J d. */
  kg_status (*jvp)(void *user, const double *x, const double *d, double *yd);
  /* Optional: imaginary part of value(x + i h d), divided by h. */
  kg_status (*complex_step)(void *user, const double *x, const double *d, double *yd);
} kg_differentiable;

/* The same from a recording function: values, products and the complex step come from the tape. */
typedef kg_value (*kg_recorded)(kg_tape *tape, kg_value x, void *user);

typedef struct kg_gradcheck_def {
  double tolerance;         /* 1e-7: error of an entry against differences        */
  double complex_tolerance; /* 1e-12: against a complex step                      */
  double dot_tolerance;     /* 1e-13: of the product of the norms                 */
  /* 1e-2: first step of the differences, times max(1, |x_j|); smaller where they do not settle. */
  double step;
  int directions; /* 3: random directions for Taylor and dot tests      */
  bool taylor;    /* true; off where the function is known to have kinks nearby */
  uint64_t seed;  /* 1 */
  const kg_allocator *allocator;
} kg_gradcheck_def;

KG_API kg_gradcheck_def kg_gradcheck_default_def(void);

typedef struct kg_gradcheck_report {
  const char *name;
  bool passed;
  /* Not passed, but only because a numerical derivative is not good enough to tell. */
  bool undecided;
  const char *method;               /* "complex step" or "differences" */
  double tolerance;                 /* the one in force                */
  double max_relative_error;        /* of an entry; NaN where a value or product is not a number */
  size_t worst_output, worst_input; /* where, and both numbers */
  double worst_analytic, worst_numeric;
  bool not_a_number; /* y[worst_output] itself, then worst_analytic, is NaN or infinite */
  /* Largest relative error of the numerical derivative itself; 0: complex step. */
  double error_estimate;
  /* Largest |<w, J d> - <J' w, d>| / (|w| |J d| + |J' w| |d|). Without a jvp, J d is put together
   * from the rows J' e_i, which tests that J' w is linear in w. */
  double dot_test;
  /* Least of all outputs and directions: 2 is right, below 1.5 fails; +inf: remainder at rounding,
   * NaN: not measured. */
  double taylor_order;
  bool repeatable;
} kg_gradcheck_report;

/* KG_OK when the check could be made, whatever its answer; a failure of the function itself at x is
 * returned, and KG_ERR_UNDEFINED for a function without value or vjp. Steps to points where it is
 * undefined (KG_ERR_UNDEFINED or not finite) are made smaller. */
KG_API kg_status kg_gradcheck(const kg_differentiable *function, const double *x,
                              const kg_gradcheck_def *def, kg_gradcheck_report *report,
                              kg_error *error);
KG_API kg_status kg_gradcheck_recorded(const char *name, kg_recorded function, void *user,
                                       kg_shape shape, const double *x, const kg_gradcheck_def *def,
                                       kg_gradcheck_report *report, kg_error *error);

/* A primitive at `points` points of its own sample callback, which it must have; the worst is
 * reported. Without a JVP or a complex form it is compared by its VJP and by differences. */
struct kg_primitive;
KG_API kg_status kg_gradcheck_primitive(const struct kg_primitive *primitive, int points,
                                        const kg_gradcheck_def *def, kg_gradcheck_report *worst,
                                        kg_error *error);

/* Adds what another point showed: *worst keeps the larger error with its place, the larger dot
 * test, the lower order. */
KG_API void kg_gradcheck_merge(kg_gradcheck_report *worst, const kg_gradcheck_report *report);

/* One line of a table for a terminal, without newline; report == NULL: the heading. Returns the
 * length as snprintf. */
KG_API int kg_gradcheck_row(const kg_gradcheck_report *report, char *text, size_t size);

/* -- the registry: every operator and kind of primitive, with its sample points ---------------- */

KG_API int kg_registry_count(void);
KG_API const char *kg_registry_name(int i);
/* Checks entry i at `points` random points of its domain and beside its kinks; the worst is
 * reported. */
KG_API kg_status kg_registry_check(int i, int points, const kg_gradcheck_def *def,
                                   kg_gradcheck_report *report, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
