/* Vectors as wide as the instruction set has them: what the compiler's own vectors lack. */
#ifndef SDF_KERNELS_LANES_H
#define SDF_KERNELS_LANES_H

#include <stdint.h>

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
