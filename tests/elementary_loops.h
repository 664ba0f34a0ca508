/* The functions of autodiff/elementary.h as array functions, one table per instruction set:
 * elementary_loops.c is compiled once for each. */
#ifndef TESTS_ELEMENTARY_LOOPS_H
#define TESTS_ELEMENTARY_LOOPS_H

#include <stddef.h>

#define KG_ELEMENTARY(X)                                                                           \
  X(exp) X(expm1) X(log) X(log1p) X(tanh) X(sigmoid) X(softplus) X(sin) X(cos)
#define KG_COUNT_ONE(name) +1
enum { ELEMENTARY_COUNT = 0 KG_ELEMENTARY(KG_COUNT_ONE) };

typedef void loop_f64(const double *x, double *y, size_t n);
typedef void loop_f32(const float *x, float *y, size_t n);

typedef struct elementary_loops {
  loop_f64 *f64[ELEMENTARY_COUNT];
  loop_f32 *f32[ELEMENTARY_COUNT];
  void (*sincos_f64)(const double *x, double *s, double *c, size_t n);
  void (*sincos_f32)(const float *x, float *s, float *c, size_t n);
} elementary_loops;

extern const elementary_loops elementary_loops_base, elementary_loops_v3, elementary_loops_v4;

#endif
