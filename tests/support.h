/* Helpers shared by the tests: comparison with a tolerance, failing allocator, random vectors. */
#ifndef TESTS_SUPPORT_H
#define TESTS_SUPPORT_H

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/base.h"
#include "kinegrad/quat.h"
#include "kinegrad/random.h"
#include "kinegrad/vec3.h"

#ifdef __clang__ /* glibc offers it to gcc alone */
#define CMPLX(re, im) __builtin_complex((double)(re), (double)(im))
#endif

/* |a - b| <= tol * max(1, |a|, |b|), both values in the message when it does not hold */
#define assert_close(a, b, tol)                                                                    \
  do {                                                                                             \
    const double a_ = (a), b_ = (b), tol_ = (tol);                                                 \
    if (!(fabs(a_ - b_) <= tol_ * fmax(1.0, fmax(fabs(a_), fabs(b_))))) {                          \
      fail_msg("%s = %.17g, %s = %.17g, difference %.3g, tolerance %.3g", #a, a_, #b, b_, a_ - b_, \
               tol_);                                                                              \
    }                                                                                              \
  } while (0)

/* a <= b, both values in the message when it does not hold */
#define assert_at_most(a, b)                                                                       \
  do {                                                                                             \
    const double a_ = (a), b_ = (b);                                                               \
    if (!(a_ <= b_)) {                                                                             \
      fail_msg("%s = %.17g is more than %s = %.17g", #a, a_, #b, b_);                              \
    }                                                                                              \
  } while (0)

/* Allocator that counts live bytes and refuses from the k-th call on. */
typedef struct failing_heap {
  int calls_left;
  size_t live_bytes;
} failing_heap;

static inline void *failing_alloc(size_t bytes, void *user)
{
  failing_heap *heap = user;
  if (heap->calls_left-- <= 0) {
    return NULL;
  }
  void *memory = malloc(bytes);
  assert_non_null(memory);
  heap->live_bytes += bytes;
  return memory;
}

static inline void failing_free(void *memory, size_t bytes, void *user)
{
  failing_heap *heap = user;
  heap->live_bytes -= bytes;
  free(memory);
}

static inline kg_vec3 random_vec3(kg_random *random, double size)
{
  const double x = kg_random_normal(random), y = kg_random_normal(random);
  return kg_vec3_scale(size, kg_vec3_make(x, y, kg_random_normal(random)));
}

static inline kg_quat random_quat(kg_random *random)
{
  const double w = kg_random_normal(random), x = kg_random_normal(random);
  const double y = kg_random_normal(random);
  return kg_quat_normalized(kg_quat_make(w, x, y, kg_random_normal(random)));
}

#endif
