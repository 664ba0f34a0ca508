/* number.h - one arithmetic per translation unit: KG_ARITHMETIC is 64, 32 or 128 (complex),
 * KG_ISA the instruction set's suffix. Kernels are written in `real`, and named by KG_NAME.
 *
 * Complex numbers serve complex steps: f(x + i h d) with h so small that h^2 vanishes carries
 * the derivative in its imaginary part. So every function here is the analytic continuation of
 * its real form beside the real axis, and comparisons look at the real part: ABS is -z left of
 * zero, not the modulus. */
#ifndef AUTODIFF_KERNELS_NUMBER_H
#define AUTODIFF_KERNELS_NUMBER_H

#include <math.h>

#define KG_PASTE_(a, b, c) a##b##c
#define KG_PASTE(a, b, c) KG_PASTE_(a, b, c)

#include "autodiff/elementary.h"

#if KG_ARITHMETIC == 64
typedef double real;
#define KG_TYPE f64
#define FN(name) name
#define OWN(name) kg_##name##_f64 /* elementary.h: same bits for one number and in loops */
#elif KG_ARITHMETIC == 32
typedef float real;
#define KG_TYPE f32
#define FN(name) name##f
#define OWN(name) kg_##name##_f32
#else
#include <complex.h>
#undef I
#ifndef CMPLX /* not known to clang with older C libraries */
#define CMPLX(x, y) __builtin_complex((double)(x), (double)(y))
#endif
#ifndef CMPLX /* glibc offers it to gcc alone */
#define CMPLX(re, im) __builtin_complex((double)(re), (double)(im))
#endif
typedef double _Complex real;
#define KG_TYPE c64
#define FN(name) c##name
#define OWN(name) FN(name)
#endif

#define KG_TABLE_(type, isa) kg_kernels_##type##_##isa
#define KG_TABLE(type, isa) KG_TABLE_(type, isa)

#define KG_ZERO ((real)0)
#define KG_ONE ((real)1)
#define HALF ((real)0.5)

#define SQRT(a) FN(sqrt)(a)
#define EXP(a) OWN(exp)(a)
#define LOG(a) OWN(log)(a)
#define SIN(a) OWN(sin)(a)
#define COS(a) OWN(cos)(a)
#define TAN(a) FN(tan)(a)
#define ASIN(a) FN(asin)(a)
#define ACOS(a) FN(acos)(a)
#define ATAN(a) FN(atan)(a)
#define SINH(a) FN(sinh)(a)
#define COSH(a) FN(cosh)(a)

#if KG_ARITHMETIC != 128
typedef real part; /* what comparisons look at */
#define RE(a) (a)
#define ABS(a) FN(fabs)(a)
#define EXPM1(a) OWN(expm1)(a)
#define LOG1P(a) OWN(log1p)(a)
#define TANH(a) OWN(tanh)(a)
#define SIGMOID(a) OWN(sigmoid)(a)
#define SOFTPLUS(a) OWN(softplus)(a)
#define POW(a, b) FN(pow)(a, b)
#define ATAN2(a, b) FN(atan2)(a, b)
#define HYPOT(a, b) FN(hypot)(a, b)
#else
typedef double part;
#define RE(a) creal(a)
#define ABS(a) (creal(a) < 0 ? -(a) : (a))
#define EXPM1(a) kg_expm1_of(a)
#define LOG1P(a) kg_log1p_of(a)
#define TANH(a) kg_tanh_of(a)
#define SIGMOID(a) kg_sigmoid_of(a)
#define SOFTPLUS(a) kg_softplus_of(a)
#define POW(a, b) kg_pow_of(a, b)
#define ATAN2(a, b) kg_atan2_of(a, b)
#define HYPOT(a, b) kg_hypot_of(a, b)

/* exp(x + i y) - 1 = expm1 x cos y - 2 sin^2(y/2) + i exp x sin y */
static inline real kg_expm1_of(real a)
{
  const double x = creal(a), y = cimag(a), s = sin(y / 2);
  return CMPLX(expm1(x) * cos(y) - 2 * s * s, exp(x) * sin(y));
}

/* log(1 + x + i y) for tiny y */
static inline real kg_log1p_of(real a)
{
  return CMPLX(log1p(creal(a)), cimag(clog(1 + a)));
}

/* e2 = expm1(-2 a) on the side where it cannot overflow: tanh a = -e2 / (2 + e2) */
static inline real kg_tanh_of(real a)
{
  const real e = kg_expm1_of(creal(a) >= 0 ? -2 * a : 2 * a);
  return creal(a) >= 0 ? -e / (2 + e) : e / (2 + e);
}

static inline real kg_sigmoid_of(real a)
{
  const real e = cexp(creal(a) >= 0 ? -a : a);
  return creal(a) >= 0 ? 1 / (1 + e) : e / (1 + e);
}

static inline real kg_softplus_of(real a)
{
  return creal(a) >= 0 ? a + kg_log1p_of(cexp(-a)) : kg_log1p_of(cexp(a));
}

/* a^b; a negative base goes with a whole exponent: (-a)^b times (-1)^b */
static inline real kg_pow_of(real a, real b)
{
  if (creal(a) == 0) {
    return creal(b) == 0 ? 1 : creal(b) == 1 ? a : creal(b) == 2 ? a * a : 0 * a;
  }
  const real power = cexp(b * clog(ABS(a)));
  return creal(a) < 0 && fmod(creal(b), 2) != 0 ? -power : power;
}

/* the angle of (x, y): an arc tangent of the smaller over the larger coordinate */
static inline real kg_atan2_of(real y, real x)
{
  if (creal(x) == 0 && creal(y) == 0) return 0;
  if (fabs(creal(x)) >= fabs(creal(y))) {
    const double turn = creal(x) < 0 ? copysign(acos(-1), creal(y)) : 0;
    return catan(y / x) + turn;
  }
  return copysign(acos(-1) / 2, creal(y)) - catan(x / y);
}

static inline real kg_hypot_of(real a, real b)
{
  const double scale = fmax(fabs(creal(a)), fabs(creal(b)));
  if (scale == 0) return 0;
  return scale * csqrt((a / scale) * (a / scale) + (b / scale) * (b / scale));
}
#endif

/* derivative of a^b by a; finite at a = 0 wherever it exists */
static inline real kg_power_slope(real a, real b)
{
  if (RE(b) == 0) return 0;
  return b * POW(a, b - 1);
}

#define POWER_SLOPE(a, b) kg_power_slope(a, b)
#define SIGN(a) (RE(a) > 0 ? KG_ONE : RE(a) < 0 ? -KG_ONE : KG_ZERO)
#define CLAMP(a, p, q) MIN(MAX(a, p), q)
/* d atan2(a, b) = (b da - a db) / (a^2 + b^2): c is the coordinate on top */
#define ATAN2_SLOPE(c, a, b) kg_atan2_slope(c, a, b)
#define HYPOT_SLOPE(c, y) (RE(y) == 0 ? KG_ZERO : (c) / (y))
#define MIN(a, b) (RE(a) <= RE(b) || RE(a) != RE(a) ? (a) : (b))
#define MAX(a, b) (RE(a) >= RE(b) || RE(a) != RE(a) ? (a) : (b))

static inline real kg_atan2_slope(real c, real a, real b)
{
  const real r = HYPOT(a, b);
  return RE(r) == 0 ? KG_ZERO : c / r / r;
}

#endif
