/* Vectors of four and eight doubles for the kernels that work on matrices of the tree: loads and
 * stores at any address, and the few operations the kernels need. GCC and Clang make vector
 * instructions of them, split where the instruction set has narrower ones; the plain form gives the
 * same bits. */
#ifndef PHYSICS_KERNELS_ROWS_H
#define PHYSICS_KERNELS_ROWS_H

#include <string.h>

#if defined(__GNUC__)
typedef double row4 __attribute__((vector_size(32)));
typedef double row8 __attribute__((vector_size(64)));
#define KG_ROW_OPERATIONS(type, count)                                                             \
  static inline type type##_load(const double *p)                                                  \
  {                                                                                                \
    type r;                                                                                        \
    memcpy(&r, p, sizeof r);                                                                       \
    return r;                                                                                      \
  }                                                                                                \
  static inline void type##_store(double *p, type r)                                               \
  {                                                                                                \
    memcpy(p, &r, sizeof r);                                                                       \
  }                                                                                                \
  static inline type type##_add(type a, type b)                                                    \
  {                                                                                                \
    return a + b;                                                                                  \
  }                                                                                                \
  static inline type type##_sub(type a, type b)                                                    \
  {                                                                                                \
    return a - b;                                                                                  \
  }                                                                                                \
  static inline type type##_mul(type a, type b)                                                    \
  {                                                                                                \
    return a * b;                                                                                  \
  }                                                                                                \
  static inline type type##_scale(double s, type b)                                                \
  {                                                                                                \
    return s * b;                                                                                  \
  }
#else
typedef struct row4 {
  double c[4];
} row4;
typedef struct row8 {
  double c[8];
} row8;
#define KG_ROW_LOOP(type, count, expression)                                                       \
  {                                                                                                \
    type r;                                                                                        \
    for (int k = 0; k < count; k++) {                                                              \
      r.c[k] = expression;                                                                         \
    }                                                                                              \
    return r;                                                                                      \
  }
#define KG_ROW_OPERATIONS(type, count)                                                             \
  static inline type type##_load(const double *p)                                                  \
    KG_ROW_LOOP(type, count, p[k]) static inline void type##_store(double *p, type r)              \
  {                                                                                                \
    memcpy(p, r.c, sizeof r.c);                                                                    \
  }                                                                                                \
  static inline type type##_add(type a, type b) KG_ROW_LOOP(                                       \
    type, count, a.c[k] + b.c[k]) static inline type type##_sub(type a, type b)                    \
    KG_ROW_LOOP(type, count, a.c[k] - b.c[k]) static inline type type##_mul(type a, type b)        \
      KG_ROW_LOOP(type, count, a.c[k] * b.c[k]) static inline type type##_scale(double s, type b)  \
        KG_ROW_LOOP(type, count, s *b.c[k])
#endif
/* clang-format off */
KG_ROW_OPERATIONS(row4, 4)
KG_ROW_OPERATIONS(row8, 8)
/* clang-format on */

/* a0 r0 + a1 r1 + a2 r2 */
static inline row4 row4_combine(double a0, row4 r0, double a1, row4 r1, double a2, row4 r2)
{
  return row4_add(row4_add(row4_scale(a0, r0), row4_scale(a1, r1)), row4_scale(a2, r2));
}

static inline row8 row8_combine(double a0, row8 r0, double a1, row8 r1, double a2, row8 r2)
{
  return row8_add(row8_add(row8_scale(a0, r0), row8_scale(a1, r1)), row8_scale(a2, r2));
}

#endif
