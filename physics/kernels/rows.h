/* Vectors of four and eight doubles for the kernels that work on matrices of the tree: loads and
 * stores at any address, and the few operations the kernels need. Where the instruction set has
 * narrower vectors they are made of halves (left to itself GCC 12 moves such vectors through memory);
 * every form gives the same bits. */
#ifndef PHYSICS_KERNELS_ROWS_H
#define PHYSICS_KERNELS_ROWS_H

#include <string.h>

#if defined(__GNUC__) && defined(__AVX__)
typedef double row4 __attribute__((vector_size(32)));
#define KG_ROW4_IS_VECTOR
#elif defined(__GNUC__)
typedef double pair __attribute__((vector_size(16)));
#endif
#if defined(__GNUC__) && defined(__AVX512F__)
typedef double row8 __attribute__((vector_size(64)));
#define KG_ROW8_IS_VECTOR
#endif

/* A type that is one vector. */
#define KG_VECTOR_OPERATIONS(type)                                                                 \
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

/* A type of two halves. */
#define KG_HALVES_OPERATIONS(type, half)                                                           \
  typedef struct type {                                                                            \
    half a, b;                                                                                     \
  } type;                                                                                          \
  static inline type type##_load(const double *p)                                                  \
  {                                                                                                \
    return (type){half##_load(p), half##_load(p + sizeof(half) / sizeof(double))};                 \
  }                                                                                                \
  static inline void type##_store(double *p, type r)                                               \
  {                                                                                                \
    half##_store(p, r.a);                                                                          \
    half##_store(p + sizeof(half) / sizeof(double), r.b);                                          \
  }                                                                                                \
  static inline type type##_add(type x, type y)                                                    \
  {                                                                                                \
    return (type){half##_add(x.a, y.a), half##_add(x.b, y.b)};                                     \
  }                                                                                                \
  static inline type type##_sub(type x, type y)                                                    \
  {                                                                                                \
    return (type){half##_sub(x.a, y.a), half##_sub(x.b, y.b)};                                     \
  }                                                                                                \
  static inline type type##_mul(type x, type y)                                                    \
  {                                                                                                \
    return (type){half##_mul(x.a, y.a), half##_mul(x.b, y.b)};                                     \
  }                                                                                                \
  static inline type type##_scale(double s, type y)                                                \
  {                                                                                                \
    return (type){half##_scale(s, y.a), half##_scale(s, y.b)};                                     \
  }

/* clang-format off */
#if !defined(__GNUC__)
typedef double single;
static inline single single_load(const double *p) { return *p; }
static inline void single_store(double *p, single r) { *p = r; }
static inline single single_add(single a, single b) { return a + b; }
static inline single single_sub(single a, single b) { return a - b; }
static inline single single_mul(single a, single b) { return a * b; }
static inline single single_scale(double s, single b) { return s * b; }
KG_HALVES_OPERATIONS(pair, single)
#elif !defined(KG_ROW4_IS_VECTOR)
KG_VECTOR_OPERATIONS(pair)
#endif
#ifdef KG_ROW4_IS_VECTOR
KG_VECTOR_OPERATIONS(row4)
#else
KG_HALVES_OPERATIONS(row4, pair)
#endif
#ifdef KG_ROW8_IS_VECTOR
KG_VECTOR_OPERATIONS(row8)
#else
KG_HALVES_OPERATIONS(row8, row4)
#endif
/* clang-format on */

/* (y, z, x) and the fourth number */
static inline row4 row4_turn(row4 a)
{
#ifdef KG_ROW4_IS_VECTOR
  return __builtin_shufflevector(a, a, 1, 2, 0, 3);
#elif defined(__GNUC__)
  return (row4){__builtin_shufflevector(a.a, a.b, 1, 2), __builtin_shufflevector(a.a, a.b, 0, 3)};
#else
  return (row4){{a.a.b, a.b.a}, {a.a.a, a.b.b}};
#endif
}

/* a x b = (b turned . a - a turned . b) turned, where turned is (y, z, x) */
static inline row4 row4_cross(row4 a, row4 b)
{
  return row4_turn(row4_sub(row4_mul(a, row4_turn(b)), row4_mul(row4_turn(a), b)));
}

/* Rows and columns exchanged. */
static inline void row4_transpose(row4 r[4])
{
#ifdef KG_ROW4_IS_VECTOR
  const row4 a = __builtin_shufflevector(r[0], r[1], 0, 4, 2, 6);
  const row4 b = __builtin_shufflevector(r[0], r[1], 1, 5, 3, 7);
  const row4 c = __builtin_shufflevector(r[2], r[3], 0, 4, 2, 6);
  const row4 d = __builtin_shufflevector(r[2], r[3], 1, 5, 3, 7);
  r[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5);
  r[1] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
  r[2] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
  r[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
#else
  double all[4][4];
  for (int i = 0; i < 4; i++) {
    row4_store(all[i], r[i]);
  }
  for (int i = 0; i < 4; i++) {
    const double column[4] = {all[0][i], all[1][i], all[2][i], all[3][i]};
    r[i] = row4_load(column);
  }
#endif
}

/* Three numbers; the fourth is zero. */
static inline row4 row4_load3(const double *p)
{
#ifdef KG_ROW4_IS_VECTOR
  return (row4){p[0], p[1], p[2], 0.0}; /* not through memory: loads would wait for its stores */
#else
  const double four[4] = {p[0], p[1], p[2], 0.0};
  return row4_load(four);
#endif
}

/* First half and second half added up. */
static inline row4 row8_fold(row8 a)
{
#ifdef KG_ROW8_IS_VECTOR
  return row4_add(__builtin_shufflevector(a, a, 0, 1, 2, 3),
                  __builtin_shufflevector(a, a, 4, 5, 6, 7));
#else
  return row4_add(a.a, a.b);
#endif
}

/* Sums of the numbers of four rows. */
static inline row4 row4_sums(row4 r0, row4 r1, row4 r2, row4 r3)
{
  row4 r[4] = {r0, r1, r2, r3};
  row4_transpose(r);
  return row4_add(row4_add(r[0], r[1]), row4_add(r[2], r[3]));
}

/* Six numbers and two zeros. */
static inline row8 row8_make6(double a, double b, double c, double d, double e, double f)
{
#if defined(KG_ROW8_IS_VECTOR)
  return (row8){a, b, c, d, e, f, 0.0, 0.0}; /* not through memory, as above */
#elif defined(KG_ROW4_IS_VECTOR)
  return (row8){{a, b, c, d}, {e, f, 0.0, 0.0}};
#else
  const double eight[8] = {a, b, c, d, e, f, 0.0, 0.0};
  return row8_load(eight);
#endif
}

/* The first three numbers alone. */
static inline void row4_store3(double *p, row4 a)
{
#ifdef KG_ROW4_IS_VECTOR
  typedef double pair __attribute__((vector_size(16)));
  const pair two = __builtin_shufflevector(a, a, 0, 1);
  memcpy(p, &two, sizeof two);
  p[2] = a[2];
#elif defined(__GNUC__)
  pair_store(p, a.a);
  p[2] = a.b[0];
#else
  pair_store(p, a.a);
  p[2] = a.b.a;
#endif
}

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
