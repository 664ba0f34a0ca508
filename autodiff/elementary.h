/* Elementary functions for loops: static inline, without branches or tables, so that the compiler
 * turns a loop over an array into vector code (gcc 12: -O3 -fno-math-errno -fno-trapping-math;
 * with -fno-thread-jumps gcc does not follow each case of a clamp through all the rest).
 *
 *   kg_NAME_f64(double), kg_NAME_f32(float) for NAME =
 *   exp expm1 log log1p tanh sigmoid softplus   branch-free over the whole line
 *   sin_near cos_near sincos_near               branch-free, for |x| <= KG_TRIG_LIMIT
 *   sin cos                                     one number; beyond the limit they call libm
 *   sin_array cos_array sincos_array            n numbers, the same bits as sin and cos
 *
 * Same bits everywhere. Only + - * /, comparisons and bit patterns are used, so one number, a
 * vector loop and any instruction set give the same result, on condition that the including file
 * is compiled with -ffp-contract=off and without -ffast-math, under round-to-nearest and with
 * denormals on. Two exceptions: which NaN comes out is not fixed, and beyond KG_TRIG_LIMIT the bits
 * are those of the machine's libm.
 *
 * Special values are those of C11 annex F; results below the normal range lose bits gradually.
 *
 * Method; k is an integer, ulp figures are the largest that tests/test_elementary.c admits:
 *   exp      x = k ln2 + r, |r| <= ln2 / 2, e^r - 1 = r + r^2 Q(r)                           1 ulp
 *   expm1    2^k (e^r - 1) + (2^k - 1), halved on the way so that 2^1024 does not appear     2
 *   log      x = 2^k (1 + f), sqrt(1/2) <= 1 + f < sqrt 2, s = f / (2 + f),
 *            log(1 + f) = 2 atanh s = f - f^2/2 + s (f^2/2 + s^2 L(s^2))                     1
 *   log1p    log of u = fl(1 + x), plus the rounding error of u divided by u                 1
 *   sin cos  x = n pi/2 + r + tail, |r| <= pi/4, pi/2 in three pieces (Cody and Waite 1980,
 *            Software Manual for the Elementary Functions); the first two pieces have 36 bits,
 *            so that n times them is exact for n < 2^17. No double up to the limit is closer
 *            than 2^-60.5 to a multiple of pi/2. sin r = r + r^3 S(r^2),
 *            cos r = 1 - r^2/2 + r^4 C(r^2). The float functions work in double inside.      1
 *   tanh     -t / (2 + t) with t = expm1(-2 |x|), the sign put back                          3
 *   sigmoid  1 / (1 + e) or e / (1 + e) with e = exp(-|x|)                                   3
 *   softplus max(x, 0) + log(1 + exp(-|x|))                                                  3
 *
 * Polynomials: Remez exchange in 70-digit arithmetic, minimising the error relative to the
 * function named, then each coefficient rounded; the bound is that of the rounded polynomial.
 *              double                    float                     interval of its argument
 *   Q / exp    degree 9, 2^-56.3         degree 4, 2^-27.9         |r| <= ln2 / 2
 *   L / log    degree 6, 2^-58.8         degree 2, 2^-30.0         0 <= s^2 <= 0.02945
 *   S / sin    degree 5, 2^-56.3         degree 2, 2^-27.9         0 <= r^2 <= (pi/4)^2
 *   C / cos    degree 5, 2^-59.6         degree 2, 2^-33.0         0 <= r^2 <= (pi/4)^2
 *
 * The file includes itself twice: the part under KG_REAL is the text for one precision. */
#ifndef KG_REAL
#ifndef KG_AUTODIFF_ELEMENTARY_H
#define KG_AUTODIFF_ELEMENTARY_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif

/* largest |x| for which sin and cos reduce their argument themselves */
#define KG_TRIG_LIMIT 1e5

/* a + b x + c x^2 + ... */
#define KG_POLY1(x, a, b) ((a) + (x) * (b))
#define KG_POLY2(x, a, ...) ((a) + (x)*KG_POLY1(x, __VA_ARGS__))
#define KG_POLY3(x, a, ...) ((a) + (x)*KG_POLY2(x, __VA_ARGS__))
#define KG_POLY4(x, a, ...) ((a) + (x)*KG_POLY3(x, __VA_ARGS__))

/* Q, L for double and float; S, C as used by the double and by the float functions. The long ones
 * are even part + odd part: a chain half as long leaves the processor more to do at once. */
#define kg_Q_f64(r)                                                                                \
  (KG_POLY4(r * r, 0x1.000000000000ap-1, 0x1.555555555087dp-5, 0x1.6c16c1842a073p-10,              \
            0x1.a0199a0c67cbcp-16, 0x1.28ad72df49402p-22) +                                        \
   r * KG_POLY4(r * r, 0x1.55555555554fap-3, 0x1.1111111127c1bp-7, 0x1.a01a012a45948p-13,          \
                0x1.71df257997528p-19, 0x1.ad7f330d73d4ap-26))
#define kg_Q_f32(r)                                                                                \
  KG_POLY4(r, 0x1.fffffcp-2f, 0x1.555492p-3f, 0x1.5558f2p-5f, 0x1.1239e2p-7f, 0x1.6a244ap-10f)
#define kg_L_f64(z)                                                                                \
  (KG_POLY3(z * z, 0x1.5555555555592p-1, 0x1.24924941f5297p-2, 0x1.74663fa7d5e93p-3,               \
            0x1.2f0639c88bebp-3) +                                                                 \
   z * KG_POLY2(z * z, 0x1.999999997fd73p-2, 0x1.c71c5205e8d89p-3, 0x1.39a1a66db4b9ap-3))
#define kg_L_f32(z) KG_POLY2(z, 0x1.55557ap-1f, 0x1.995eb6p-2f, 0x1.31e352p-2f)
#define kg_S_f64(z)                                                                                \
  (KG_POLY2(z * z, -0x1.5555555555548p-3, -0x1.a01a019bfd187p-13, -0x1.ae5e59f4b169bp-26) +        \
   z * KG_POLY2(z * z, 0x1.111111110f7cap-7, 0x1.71de356711c24p-19, 0x1.5d8fa2c90d81p-33))
#define kg_S_f32(z) KG_POLY2(z, -0x1.555545249bffcp-3, 0x1.11073a04afd74p-7, -0x1.994385035bfd1p-13)
#define kg_C_f64(z)                                                                                \
  (KG_POLY2(z * z, 0x1.555555555554bp-5, 0x1.a01a019c838ffp-16, 0x1.1ee9d751c64f1p-29) +           \
   z * KG_POLY2(z * z, -0x1.6c16c16c14f8ap-10, -0x1.27e4f7ea36996p-22, -0x1.8fa4657a583b9p-37))
#define kg_C_f32(z) KG_POLY2(z, 0x1.55554a0f9eaa4p-5, -0x1.6c0c329371654p-10, 0x1.99eb4b8627cb2p-16)

/* 2 / pi, and pi/2 = KG_PIO2_1 + KG_PIO2_2 + KG_PIO2_3 */
#define KG_TWO_OVER_PI 0x1.45f306dc9c883p-1
#define KG_PIO2_1 0x1.921fb54440000p+0
#define KG_PIO2_2 0x1.68c234c4c0000p-39
#define KG_PIO2_3 0x1.98a2e03707345p-77

#define KG_REAL double
#define KG_UINT uint64_t
#define KG_(name) kg_##name##_f64
#define KG_LIBM(name) name
#define KG_DIGITS 53
#define KG_BIAS 1023
#define KG_SHIFTER 0x1.8p52
#define KG_LOG2E 0x1.71547652b82fep+0
#define KG_LN2_HI 0x1.62e42fefa2000p-1
#define KG_LN2_LO 0x1.9ef35793c7673p-41
#define KG_EXP_MAX 710.0
#define KG_EXP_MIN (-750.0)
#define KG_EXPM1_MIN (-45.0)
#define KG_TINY 0x1p-54
#define KG_TWO_DIGITS 0x1p54
#define KG_SQRT_HALF 0x1.6a09e667f3bcdp-1
#define KG_MIN_NORMAL 0x1p-1022
#include "elementary.h"

#define KG_REAL float
#define KG_UINT uint32_t
#define KG_(name) kg_##name##_f32
#define KG_LIBM(name) name##f
#define KG_DIGITS 24
#define KG_BIAS 127
#define KG_SHIFTER 0x1.8p23f
#define KG_LOG2E 0x1.715476p+0f
#define KG_LN2_HI 0x1.62e400p-1f
#define KG_LN2_LO 0x1.7f7d1cp-20f
#define KG_EXP_MAX 89.0f
#define KG_EXP_MIN (-105.0f)
#define KG_EXPM1_MIN (-20.0f)
#define KG_TINY 0x1p-25f
#define KG_TWO_DIGITS 0x1p25f
#define KG_SQRT_HALF 0x1.6a09e6p-1f
#define KG_MIN_NORMAL 0x1p-126f
#include "elementary.h"

#endif
#else

static inline KG_UINT KG_(bits)(KG_REAL x)
{
  KG_UINT u;
  memcpy(&u, &x, sizeof u);
  return u;
}

static inline KG_REAL KG_(from_bits)(KG_UINT u)
{
  KG_REAL x;
  memcpy(&x, &u, sizeof x);
  return x;
}

static inline KG_REAL KG_(magnitude)(KG_REAL x)
{
  return KG_(from_bits)(KG_(bits)(x) & ~(KG_UINT)0 >> 1);
}

/* 2^k for an integer 1 - KG_BIAS <= k <= KG_BIAS: the sum leaves k + KG_BIAS in the low bits */
static inline KG_REAL KG_(pow2)(KG_REAL k)
{
  return KG_(from_bits)(KG_(bits)(k + (KG_SHIFTER + KG_BIAS)) << (KG_DIGITS - 1));
}

/* k, and e^r - 1 with r = x - k ln2; x within the range where 2^k can be written as two factors */
typedef struct KG_(exp_parts) {
  KG_REAL k, em1;
} KG_(exp_parts);

static inline KG_(exp_parts) KG_(exp_split)(KG_REAL x)
{
  const KG_REAL k = (x * KG_LOG2E + KG_SHIFTER) - KG_SHIFTER;
  const KG_REAL high = x - k * KG_LN2_HI, low = k * KG_LN2_LO; /* high is exact */
  const KG_REAL r = high - low, tail = (high - r) - low;
  return (KG_(exp_parts)){k, r + (r * r * KG_(Q)(r) + tail)};
}

static inline KG_REAL KG_(exp)(KG_REAL x)
{
  const KG_REAL below = x > KG_EXP_MAX ? KG_EXP_MAX : x;
  const KG_(exp_parts) e = KG_(exp_split)(below < KG_EXP_MIN ? KG_EXP_MIN : below);
  /* two factors: the first product is exact, so a denormal result is rounded once */
  const KG_REAL k1 = (e.k / 2 + KG_SHIFTER) - KG_SHIFTER;
  return (1 + e.em1) * KG_(pow2)(k1) * KG_(pow2)(e.k - k1);
}

static inline KG_REAL KG_(expm1)(KG_REAL x)
{
  const KG_REAL below = x > KG_EXP_MAX ? KG_EXP_MAX : x;
  const KG_(exp_parts) e = KG_(exp_split)(below < KG_EXPM1_MIN ? KG_EXPM1_MIN : below);
  const KG_REAL half_power = KG_(pow2)(e.k - 1);
  const KG_REAL half = half_power * e.em1 + (half_power - (KG_REAL)0.5);
  return KG_(magnitude)(x) < KG_TINY ? x : 2 * half; /* keeps -0 and denormals */
}

/* x = 2^k (1 + f) for a normal positive x; anything else gives some finite k and f */
typedef struct KG_(log_parts) {
  KG_REAL k, f;
} KG_(log_parts);

static inline KG_(log_parts) KG_(log_split)(KG_REAL x)
{
  const KG_UINT root = KG_(bits)(KG_SQRT_HALF), one = KG_(bits)(1);
  const KG_UINT u = KG_(bits)(x) + (one - root), fraction = ((KG_UINT)1 << (KG_DIGITS - 1)) - 1;
  const KG_REAL offset = (KG_UINT)1 << (KG_DIGITS - 1);
  const KG_REAL biased = KG_(from_bits)(u >> (KG_DIGITS - 1) | KG_(bits)(offset));
  return (KG_(log_parts)){biased - (offset + KG_BIAS), KG_(from_bits)((u & fraction) + root) - 1};
}

/* k ln2 + log(1 + f) + tail */
static inline KG_REAL KG_(log_join)(KG_REAL k, KG_REAL f, KG_REAL tail)
{
  const KG_REAL s = f / (2 + f), z = s * s, half_square = f * f / 2;
  const KG_REAL small = s * (half_square + z * KG_(L)(z)) + (k * KG_LN2_LO + tail);
  return k * KG_LN2_HI - ((half_square - small) - f);
}

static inline KG_REAL KG_(log)(KG_REAL x)
{
  const int denormal = x < KG_MIN_NORMAL;
  const KG_(log_parts) p = KG_(log_split)(denormal ? x * KG_TWO_DIGITS : x);
  const KG_REAL y = KG_(log_join)(denormal ? p.k - (KG_DIGITS + 1) : p.k, p.f, 0);
  const KG_REAL finite = x > 0 ? y : x == 0 ? -(KG_REAL)INFINITY : (KG_REAL)NAN;
  return x < (KG_REAL)INFINITY ? finite : x; /* +inf and NaN */
}

static inline KG_REAL KG_(log1p)(KG_REAL x)
{
  const KG_REAL u = 1 + x, lost = x - (u - 1); /* exact where it is large enough to count */
  const KG_(log_parts) p = KG_(log_split)(u);
  /* with k = 0 there is no rounding error to bring back: f is x itself */
  const KG_REAL y = KG_(log_join)(p.k, p.k == 0 ? x : p.f, p.k == 0 ? 0 : lost / u);
  const KG_REAL finite = x > -1 ? y : x == -1 ? -(KG_REAL)INFINITY : (KG_REAL)NAN;
  const KG_REAL kept = x < (KG_REAL)INFINITY ? finite : x;
  return KG_(magnitude)(x) < KG_TINY ? x : kept;
}

static inline KG_REAL KG_(tanh)(KG_REAL x)
{
  const KG_REAL t = KG_(expm1)(-2 * KG_(magnitude)(x));
  const KG_UINT sign = KG_(bits)(x) & ~(~(KG_UINT)0 >> 1);
  return KG_(from_bits)(KG_(bits)(-t / (2 + t)) | sign);
}

static inline KG_REAL KG_(sigmoid)(KG_REAL x)
{
  const KG_REAL e = KG_(exp)(-KG_(magnitude)(x));
  return (x < 0 ? e : 1) / (1 + e);
}

/* log(1 + e) has no special values to look after for 0 <= e <= 1, and k is 0 or 1 */
static inline KG_REAL KG_(softplus)(KG_REAL x)
{
  const KG_REAL e = KG_(exp)(-KG_(magnitude)(x));
  const int doubled = e > 2 * KG_SQRT_HALF - 1;
  const KG_REAL f = doubled ? (e - 1) / 2 : e;
  return (x > 0 ? x : 0) + KG_(log_join)(doubled ? 1 : 0, f, 0);
}

/* sine and cosine of x = n pi/2 + r from those of r; n is in the low bits of `shifted` */
static inline void KG_(turn)(double shifted, double sin_r, double cos_r, KG_REAL *s, KG_REAL *c)
{
  uint64_t n, a, b;
  memcpy(&n, &shifted, sizeof n);
  memcpy(&a, &sin_r, sizeof a);
  memcpy(&b, &cos_r, sizeof b);
  const uint64_t swap = (a ^ b) & (0 - (n & 1));
  a = (a ^ swap) ^ (n & 2) << 62;
  b = (b ^ swap) ^ ((n + 1) & 2) << 62;
  memcpy(&sin_r, &a, sizeof a);
  memcpy(&cos_r, &b, sizeof b);
  *s = (KG_REAL)sin_r;
  *c = (KG_REAL)cos_r;
}

#if KG_DIGITS == 53
static inline void kg_sincos_near_f64(double x, double *s, double *c)
{
  const double shifted = x * KG_TWO_OVER_PI + KG_SHIFTER, n = shifted - KG_SHIFTER;
  const double high = x - n * KG_PIO2_1, low = n * KG_PIO2_2; /* both are exact */
  const double r = high - low, tail = ((high - r) - low) - n * KG_PIO2_3;
  const double z = r * r, half_z = z / 2, w = 1 - half_z;
  const double sin_r = r - ((z * (tail / 2 - r * kg_S_f64(z))) - tail);
  const double cos_r = w + (((1 - w) - half_z) + (z * z * kg_C_f64(z) - r * tail));
  kg_turn_f64(shifted, sin_r, cos_r, s, c);
}
#else
static inline void kg_sincos_near_f32(float x, float *s, float *c)
{
  const double shifted = x * KG_TWO_OVER_PI + 0x1.8p52, n = shifted - 0x1.8p52;
  const double r = (x - n * KG_PIO2_1) - n * KG_PIO2_2, z = r * r;
  kg_turn_f32(shifted, r * (1 + z * kg_S_f32(z)), (1 - z / 2) + z * z * kg_C_f32(z), s, c);
}
#endif

static inline KG_REAL KG_(sin_near)(KG_REAL x)
{
  KG_REAL s, c;
  KG_(sincos_near)(x, &s, &c);
  return s;
}

static inline KG_REAL KG_(cos_near)(KG_REAL x)
{
  KG_REAL s, c;
  KG_(sincos_near)(x, &s, &c);
  return c;
}

static inline KG_REAL KG_(sin)(KG_REAL x)
{
  return KG_(magnitude)(x) <= (KG_REAL)KG_TRIG_LIMIT ? KG_(sin_near)(x) : KG_LIBM(sin)(x);
}

static inline KG_REAL KG_(cos)(KG_REAL x)
{
  return KG_(magnitude)(x) <= (KG_REAL)KG_TRIG_LIMIT ? KG_(cos_near)(x) : KG_LIBM(cos)(x);
}

static inline void KG_(sincos)(KG_REAL x, KG_REAL *s, KG_REAL *c)
{
  *s = KG_(sin)(x);
  *c = KG_(cos)(x);
}

/* The top bit of the result is set when |x| is beyond the limit or x is a NaN. Of magnitudes the
 * bit patterns are ordered as the numbers, and integers can be collected in a vector loop. */
static inline KG_UINT KG_(beyond)(KG_REAL x)
{
  return KG_(bits)((KG_REAL)KG_TRIG_LIMIT) - KG_(bits)(KG_(magnitude)(x));
}

/* y[i] = sin x[i]; x and y do not overlap. The rare large arguments are done again, by libm. */
static inline void KG_(sin_array)(const KG_REAL *restrict x, KG_REAL *restrict y, size_t n)
{
  KG_UINT beyond = 0;
  for (size_t i = 0; i < n; ++i) {
    y[i] = KG_(sin_near)(x[i]);
    beyond |= KG_(beyond)(x[i]);
  }
  for (size_t i = 0; beyond >> (sizeof beyond * 8 - 1) && i < n; ++i) {
    y[i] = KG_(sin)(x[i]);
  }
}

static inline void KG_(cos_array)(const KG_REAL *restrict x, KG_REAL *restrict y, size_t n)
{
  KG_UINT beyond = 0;
  for (size_t i = 0; i < n; ++i) {
    y[i] = KG_(cos_near)(x[i]);
    beyond |= KG_(beyond)(x[i]);
  }
  for (size_t i = 0; beyond >> (sizeof beyond * 8 - 1) && i < n; ++i) {
    y[i] = KG_(cos)(x[i]);
  }
}

static inline void KG_(sincos_array)(const KG_REAL *restrict x, KG_REAL *restrict s,
                                     KG_REAL *restrict c, size_t n)
{
  KG_UINT beyond = 0;
  for (size_t i = 0; i < n; ++i) {
    KG_(sincos_near)(x[i], &s[i], &c[i]);
    beyond |= KG_(beyond)(x[i]);
  }
  for (size_t i = 0; beyond >> (sizeof beyond * 8 - 1) && i < n; ++i) {
    KG_(sincos)(x[i], &s[i], &c[i]);
  }
}

#undef KG_REAL
#undef KG_UINT
#undef KG_
#undef KG_LIBM
#undef KG_DIGITS
#undef KG_BIAS
#undef KG_SHIFTER
#undef KG_LOG2E
#undef KG_LN2_HI
#undef KG_LN2_LO
#undef KG_EXP_MAX
#undef KG_EXP_MIN
#undef KG_EXPM1_MIN
#undef KG_TINY
#undef KG_TWO_DIGITS
#undef KG_SQRT_HALF
#undef KG_MIN_NORMAL
#endif
