/* Vectors as wide as the instruction set has them: what the compiler's own vectors lack. */
#ifndef SDF_KERNELS_LANES_H
#define SDF_KERNELS_LANES_H

#include <stdint.h>
#include <string.h>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
enum { DOUBLES = 8, FLOATS = 8 };
#elif defined(__AVX2__)
enum { DOUBLES = 4, FLOATS = 8 };
#else
enum { DOUBLES = 2, FLOATS = 4 };
#endif

typedef double doubles __attribute__((vector_size(8 * DOUBLES)));
typedef int64_t double_mask __attribute__((vector_size(8 * DOUBLES)));
typedef float floats __attribute__((vector_size(4 * FLOATS)));
typedef int32_t float_mask __attribute__((vector_size(4 * FLOATS)));
typedef float floats4 __attribute__((vector_size(16)));
typedef int32_t ints4 __attribute__((vector_size(16)));

static inline doubles chosen(double_mask m, doubles yes, doubles no)
{
  return (doubles)((m & (double_mask)yes) | (~m & (double_mask)no));
}

/* Rows of three: x, y, z of the first lane, then of the next. */
static inline void from_rows(const double *rows, doubles *x, doubles *y, doubles *z)
{
  doubles a, b, c;
  memcpy(&a, rows, sizeof a);
  memcpy(&b, rows + DOUBLES, sizeof b);
  memcpy(&c, rows + 2 * DOUBLES, sizeof c);
#if defined(__AVX512F__)
  const doubles x2 = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 0, 0);
  const doubles y2 = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 0, 0, 0);
  const doubles z2 = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 0, 0, 0);
  *x = __builtin_shufflevector(x2, c, 0, 1, 2, 3, 4, 5, 10, 13);
  *y = __builtin_shufflevector(y2, c, 0, 1, 2, 3, 4, 8, 11, 14);
  *z = __builtin_shufflevector(z2, c, 0, 1, 2, 3, 4, 9, 12, 15);
#elif defined(__AVX2__)
  const doubles ab = __builtin_shufflevector(a, b, 0, 1, 6, 3);
  const doubles ba = __builtin_shufflevector(b, a, 0, 5, 2, 3);
  const doubles b2 = __builtin_shufflevector(a, b, 0, 5, 2, 3);
  const doubles x2 = __builtin_shufflevector(ab, c, 0, 5, 2, 3); /* 0 3 2 1 */
  const doubles y2 = __builtin_shufflevector(ba, c, 0, 1, 6, 3); /* 1 0 3 2 */
  const doubles z2 = __builtin_shufflevector(b2, c, 4, 1, 2, 7); /* 2 1 0 3 */
  *x = __builtin_shufflevector(x2, x2, 0, 3, 2, 1);
  *y = __builtin_shufflevector(y2, y2, 1, 0, 3, 2);
  *z = __builtin_shufflevector(z2, z2, 2, 1, 0, 3);
#else
  *x = __builtin_shufflevector(a, b, 0, 3);
  *y = __builtin_shufflevector(a, c, 1, 2);
  *z = __builtin_shufflevector(b, c, 0, 3);
#endif
}

static inline void to_rows(doubles x, doubles y, doubles z, double *rows)
{
#if defined(__AVX512F__)
  const doubles a2 = __builtin_shufflevector(x, y, 0, 8, 0, 1, 9, 0, 2, 10);
  const doubles b2 = __builtin_shufflevector(x, y, 0, 3, 11, 0, 4, 12, 0, 5);
  const doubles c2 = __builtin_shufflevector(x, y, 13, 0, 6, 14, 0, 7, 15, 0);
  const doubles a = __builtin_shufflevector(a2, z, 0, 1, 8, 3, 4, 9, 6, 7);
  const doubles b = __builtin_shufflevector(b2, z, 10, 1, 2, 11, 4, 5, 12, 7);
  const doubles c = __builtin_shufflevector(c2, z, 0, 13, 2, 3, 14, 5, 6, 15);
#elif defined(__AVX2__)
  const doubles x2 = __builtin_shufflevector(x, x, 0, 3, 2, 1);
  const doubles y2 = __builtin_shufflevector(y, y, 1, 0, 3, 2);
  const doubles z2 = __builtin_shufflevector(z, z, 2, 1, 0, 3);
  const doubles xy = __builtin_shufflevector(x2, y2, 0, 5, 2, 3);
  const doubles yx = __builtin_shufflevector(y2, x2, 0, 1, 6, 3);
  const doubles zx = __builtin_shufflevector(z2, x2, 0, 5, 2, 3);
  const doubles a = __builtin_shufflevector(xy, z2, 0, 1, 6, 3);
  const doubles b = __builtin_shufflevector(yx, z2, 0, 5, 2, 3);
  const doubles c = __builtin_shufflevector(zx, y2, 0, 1, 6, 3);
#else
  const doubles a = __builtin_shufflevector(x, y, 0, 2);
  const doubles b = __builtin_shufflevector(z, x, 0, 3);
  const doubles c = __builtin_shufflevector(y, z, 1, 3);
#endif
  memcpy(rows, &a, sizeof a);
  memcpy(rows + DOUBLES, &b, sizeof b);
  memcpy(rows + 2 * DOUBLES, &c, sizeof c);
}

/* bit k: lane k is true */
static inline unsigned double_bits(double_mask m)
{
#if defined(__AVX512DQ__)
  return (unsigned)_mm512_movepi64_mask((__m512i)m);
#elif defined(__AVX2__)
  return (unsigned)_mm256_movemask_pd((__m256d)m);
#elif defined(__SSE2__)
  return (unsigned)_mm_movemask_pd((__m128d)m);
#else
  return (m[0] != 0 ? 1u : 0u) | (m[1] != 0 ? 2u : 0u);
#endif
}

#if defined(__AVX512F__)
static inline doubles lesser(doubles a, doubles b)
{
  return _mm512_min_pd(a, b);
}

static inline doubles greater(doubles a, doubles b)
{
  return _mm512_max_pd(a, b);
}
#elif defined(__AVX2__)
static inline doubles lesser(doubles a, doubles b)
{
  return _mm256_min_pd(a, b);
}

static inline doubles greater(doubles a, doubles b)
{
  return _mm256_max_pd(a, b);
}
#elif defined(__SSE2__)
static inline doubles lesser(doubles a, doubles b)
{
  return _mm_min_pd(a, b);
}

static inline doubles greater(doubles a, doubles b)
{
  return _mm_max_pd(a, b);
}
#else
static inline doubles lesser(doubles a, doubles b)
{
  return chosen(a < b, a, b);
}

static inline doubles greater(doubles a, doubles b)
{
  return chosen(a > b, a, b);
}
#endif

#if defined(__SSE2__)
static inline floats4 lesser4(floats4 a, floats4 b)
{
  return _mm_min_ps(a, b);
}

static inline floats4 greater4(floats4 a, floats4 b)
{
  return _mm_max_ps(a, b);
}
#else
static inline floats4 lesser4(floats4 a, floats4 b)
{
  const ints4 m = a < b;
  return (floats4)((m & (ints4)a) | (~m & (ints4)b));
}

static inline floats4 greater4(floats4 a, floats4 b)
{
  const ints4 m = a > b;
  return (floats4)((m & (ints4)a) | (~m & (ints4)b));
}
#endif

#if defined(__AVX2__)
static inline floats greater_floats(floats a, floats b)
{
  return _mm256_max_ps(a, b);
}

/* bit k: lane k is true */
static inline unsigned bits_of(float_mask m)
{
  return (unsigned)_mm256_movemask_ps((__m256)m);
}
#elif defined(__SSE2__)
static inline floats greater_floats(floats a, floats b)
{
  return greater4(a, b);
}

static inline unsigned bits_of(float_mask m)
{
  return (unsigned)_mm_movemask_ps((__m128)m);
}
#else
static inline floats greater_floats(floats a, floats b)
{
  return greater4(a, b);
}

static inline unsigned bits_of(float_mask m)
{
  return ((unsigned)m[0] & 1u) | ((unsigned)m[1] & 2u) | ((unsigned)m[2] & 4u) |
         ((unsigned)m[3] & 8u);
}
#endif

#endif
