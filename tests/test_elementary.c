/* autodiff/elementary.h: error in units in the last place against the long double functions of
 * libm, special values, and the same bits from one number and from vector loops for each
 * instruction set the machine has. */
#include "support.h"

#include "autodiff/elementary.h"
#include "elementary_loops.h"

#define LN2 0.693147180559945309
#define PIO2 1.57079632679489662

enum { RANDOM_POINTS = 120000, POINTS = RANDOM_POINTS + 2000, CHUNK = 1009 };

static long double sigmoidl(long double x)
{
  return x < 0 ? expl(x) / (1 + expl(x)) : 1 / (1 + expl(-x));
}

static long double softplusl(long double x)
{
  return (x > 0 ? x : 0) + log1pl(expl(-fabsl(x))) + (isnan(x) ? x : 0);
}

/* sign of zero and infinities: as in C11 annex F, in the table of specials below */
typedef struct function {
  const char *name;
  double (*f64)(double);
  float (*f32)(float);
  long double (*truth)(long double);
  double most_f64, most_f32; /* units in the last place */
  double low, high;          /* random points are drawn evenly here too, besides all bit patterns */
  double at_zero, at_infinity, at_minus_infinity;
} function;

#define F(name) #name, kg_##name##_f64, kg_##name##_f32, name##l
static const function functions[ELEMENTARY_COUNT] = {
  {F(exp), 1, 1, -746, 711, 1, INFINITY, 0},
  {F(expm1), 2, 2, -40, 3, 0, INFINITY, -1},
  {F(log), 1, 1, 0.4, 2.5, -INFINITY, INFINITY, NAN},
  {F(log1p), 1, 1, -1, 2, 0, INFINITY, NAN},
  {F(tanh), 3, 3, -22, 22, 0, 1, -1},
  {F(sigmoid), 3, 3, -746, 40, 0.5, 1, 0},
  {F(softplus), 3, 3, -746, 40, LN2, INFINITY, 0},
  {F(sin), 1, 1, -1.001e5, 1.001e5, 0, NAN, NAN},
  {F(cos), 1, 1, -1.001e5, 1.001e5, 1, NAN, NAN},
};

/* Points where something changes: limits, ties of the reduction, ends of the range. */
static const double boundaries[] = {0,
                                    DBL_TRUE_MIN,
                                    DBL_MIN,
                                    FLT_MIN,
                                    1e-45,
                                    0x1p-54,
                                    0x1p-25,
                                    0x1p-27,
                                    0x1p-12,
                                    LN2 / 2,
                                    LN2,
                                    LN2 * 1.5,
                                    0.70710678118654752,
                                    1.41421356237309505,
                                    0.29289322,
                                    0.41421356,
                                    0.5,
                                    1,
                                    2,
                                    20,
                                    22,
                                    37,
                                    40,
                                    45,
                                    87.33654,
                                    88.0,
                                    88.722839,
                                    89,
                                    103.972084,
                                    105,
                                    708.39641853,
                                    709.7827128,
                                    710,
                                    744.44007192,
                                    745.13321910,
                                    746,
                                    750,
                                    PIO2 / 2,
                                    PIO2,
                                    2 * PIO2,
                                    1.5 * PIO2,
                                    29 * PIO2,
                                    161.0,
                                    252.89822,
                                    1e5,
                                    0x1p17,
                                    0x1p24,
                                    0x1p53,
                                    0x1p64,
                                    0x1p100,
                                    FLT_MAX,
                                    DBL_MAX};
enum { BOUNDARIES = sizeof boundaries / sizeof boundaries[0] };

static double random_pattern(kg_random *random)
{
  return kg_from_bits_f64(kg_random_bits(random));
}

/* POINTS arguments for one function: neighbours of boundaries, then random ones */
static double *draw(const function *f)
{
  double *x = malloc(POINTS * sizeof *x);
  assert_non_null(x);
  kg_random random = kg_random_make(7);
  size_t n = 0;
  for (size_t i = 0; i < BOUNDARIES; ++i) {
    for (int step = -4; step <= 4; ++step) {
      const uint64_t bits = kg_bits_f64(boundaries[i]) + (uint64_t)(int64_t)step;
      x[n++] = kg_from_bits_f64(bits);
      x[n++] = -kg_from_bits_f64(bits);
    }
  }
  assert_true(n + RANDOM_POINTS <= POINTS);
  while (n < POINTS) {
    x[n++] = random_pattern(&random);
    if (n < POINTS) x[n++] = f->low + (f->high - f->low) * kg_random_uniform(&random);
    if (n < POINTS) x[n++] = 4 * kg_random_normal(&random);
  }
  return x;
}

/* the same as floats; every third point is one of all float bit patterns */
static float *draw_f32(const function *f)
{
  double *x = draw(f);
  float *y = malloc(POINTS * sizeof *y);
  assert_non_null(y);
  kg_random random = kg_random_make(8);
  for (size_t i = 0; i < POINTS; ++i) {
    const int any = i >= POINTS - RANDOM_POINTS && i % 3 == 0;
    y[i] = any ? kg_from_bits_f32((uint32_t)(kg_random_bits(&random) >> 32))
               : (float)fmax(-FLT_MAX, fmin(FLT_MAX, x[i]));
  }
  free(x);
  return y;
}

/* |y - truth| in units of the last of `digits` digits of truth, at least the smallest denormal;
 * 0 for two NaNs or when both overflow, infinite when only one is infinite or a NaN */
static double ulps(double y, long double truth, int digits, int min_exponent, long double overflow)
{
  if (isnan(y) || isnan(truth)) return isnan(y) && isnan(truth) ? 0 : INFINITY;
  if (isinf(y)) return fabsl(truth) >= overflow && (truth > 0) == (y > 0) ? 0 : INFINITY;
  if (isinf(truth)) return INFINITY;
  int exponent = min_exponent;
  if (truth != 0) frexpl(truth, &exponent);
  exponent = exponent < min_exponent ? min_exponent : exponent;
  return (double)ldexpl(fabsl(y - truth), digits - exponent);
}

static double ulps_f64(double y, long double truth)
{
  return ulps(y, truth, 53, -1021, (long double)DBL_MAX * (1 + 0x1p-54L));
}

static double ulps_f32(float y, long double truth)
{
  return ulps((double)y, truth, 24, -125, (long double)FLT_MAX * (1 + 0x1p-25L));
}

static void test_error_f64(void **state)
{
  (void)state;
  for (const function *f = functions; f < functions + ELEMENTARY_COUNT; ++f) {
    double *x = draw(f), worst = 0, where = 0;
    for (size_t i = 0; i < POINTS; ++i) {
      const double error = ulps_f64(f->f64(x[i]), f->truth(x[i]));
      if (error > worst) worst = error, where = x[i];
    }
    print_message("%-8s f64 %.3f ulp at %a\n", f->name, worst, where);
    assert_at_most(worst, f->most_f64);
    free(x);
  }
}

static void test_error_f32(void **state)
{
  (void)state;
  for (const function *f = functions; f < functions + ELEMENTARY_COUNT; ++f) {
    float *x = draw_f32(f);
    double worst = 0, where = 0;
    for (size_t i = 0; i < POINTS; ++i) {
      const double error = ulps_f32(f->f32(x[i]), f->truth((long double)x[i]));
      if (error > worst) worst = error, where = (double)x[i];
    }
    print_message("%-8s f32 %.3f ulp at %a\n", f->name, worst, where);
    assert_at_most(worst, f->most_f32);
    free(x);
  }
}

/* the doubles and floats nearest to n pi/2, where the reduction cancels most */
static void test_sin_cos_near_their_zeros(void **state)
{
  (void)state;
  for (int n = 1; n * PIO2 <= 1e5; ++n) {
    const double x = (double)(n * 1.57079632679489661923L);
    const float xf = (float)x;
    assert_at_most(ulps_f64(kg_sin_f64(x), sinl(x)), 1);
    assert_at_most(ulps_f64(kg_cos_f64(-x), cosl(-x)), 1);
    assert_at_most(ulps_f32(kg_sin_f32(-xf), sinl((long double)-xf)), 1);
    assert_at_most(ulps_f32(kg_cos_f32(xf), cosl((long double)xf)), 1);
  }
}

/* equal, with the sign of zero; any NaN equals any other */
static int same_f64(double a, double b)
{
  return (isnan(a) && isnan(b)) || kg_bits_f64(a) == kg_bits_f64(b);
}

static int same_f32(float a, float b)
{
  return (isnan(a) && isnan(b)) || kg_bits_f32(a) == kg_bits_f32(b);
}

static void assert_value(const function *f, double x, double y)
{
  if (!same_f64(f->f64(x), y) || !same_f32(f->f32((float)x), (float)y)) {
    fail_msg("%s(%g) = %g and %g, expected %g", f->name, x, f->f64(x), (double)f->f32((float)x), y);
  }
}

static void test_special_values(void **state)
{
  (void)state;
  for (const function *f = functions; f < functions + ELEMENTARY_COUNT; ++f) {
    assert_value(f, 0.0, f->at_zero);
    assert_value(f, -0.0, f->at_zero == 0 ? -0.0 : f->at_zero); /* odd about zero */
    assert_value(f, INFINITY, f->at_infinity);
    assert_value(f, -INFINITY, f->at_minus_infinity);
    assert_value(f, NAN, NAN);
  }
  assert_value(&functions[2], 1, 0.0);         /* log, not -0 */
  assert_value(&functions[2], -1, NAN);        /* log */
  assert_value(&functions[3], -1, -INFINITY);  /* log1p */
  assert_value(&functions[3], -1.5, NAN);      /* log1p */
  assert_value(&functions[0], 1000, INFINITY); /* exp */
  assert_value(&functions[0], -1000, 0);       /* exp */
}

static void compare_f64(const char *isa, const elementary_loops *loops, int which, const double *x)
{
  static double y[CHUNK];
  for (size_t start = 0; start < POINTS; start += CHUNK) {
    const size_t n = POINTS - start < CHUNK ? POINTS - start : CHUNK;
    loops->f64[which](x + start, y, n);
    for (size_t i = 0; i < n; ++i) {
      const double one = functions[which].f64(x[start + i]);
      if (!same_f64(y[i], one)) {
        fail_msg("%s f64, %s: x = %a: %a in the loop, %a alone", functions[which].name, isa,
                 x[start + i], y[i], one);
      }
    }
  }
}

static void compare_f32(const char *isa, const elementary_loops *loops, int which, const float *x)
{
  static float y[CHUNK];
  for (size_t start = 0; start < POINTS; start += CHUNK) {
    const size_t n = POINTS - start < CHUNK ? POINTS - start : CHUNK;
    loops->f32[which](x + start, y, n);
    for (size_t i = 0; i < n; ++i) {
      const float one = functions[which].f32(x[start + i]);
      if (!same_f32(y[i], one)) {
        fail_msg("%s f32, %s: x = %a: %a in the loop, %a alone", functions[which].name, isa,
                 (double)x[start + i], (double)y[i], (double)one);
      }
    }
  }
}

static void compare_sincos(const elementary_loops *loops, const double *x, const float *xf)
{
  static double s[CHUNK], c[CHUNK];
  static float sf[CHUNK], cf[CHUNK];
  loops->sincos_f64(x, s, c, CHUNK);
  loops->sincos_f32(xf, sf, cf, CHUNK);
  for (size_t i = 0; i < CHUNK; ++i) {
    assert_true(same_f64(s[i], kg_sin_f64(x[i])) && same_f64(c[i], kg_cos_f64(x[i])));
    assert_true(same_f32(sf[i], kg_sin_f32(xf[i])) && same_f32(cf[i], kg_cos_f32(xf[i])));
  }
}

static void compare_loops(const char *isa, const elementary_loops *loops)
{
  for (int which = 0; which < ELEMENTARY_COUNT; ++which) {
    double *x = draw(&functions[which]);
    float *xf = draw_f32(&functions[which]);
    compare_f64(isa, loops, which, x);
    compare_f32(isa, loops, which, xf);
    compare_sincos(loops, x + 10 * CHUNK, xf + 10 * CHUNK);
    free(x);
    free(xf);
  }
}

static void test_base_loops_give_same_bits(void **state)
{
  (void)state;
  compare_loops("base", &elementary_loops_base);
}

#ifdef KG_TEST_X86_LEVELS
static void test_v3_loops_give_same_bits(void **state)
{
  (void)state;
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma")) {
    print_message("this machine has no AVX2\n");
    skip();
  }
  compare_loops("x86-64-v3", &elementary_loops_v3);
}

static void test_v4_loops_give_same_bits(void **state)
{
  (void)state;
  if (!__builtin_cpu_supports("avx512vl") || !__builtin_cpu_supports("avx512dq") ||
      !__builtin_cpu_supports("avx512bw")) {
    print_message("this machine has no AVX-512\n");
    skip();
  }
  compare_loops("x86-64-v4", &elementary_loops_v4);
}
#endif

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(test_error_f64),
    cmocka_unit_test(test_error_f32),
    cmocka_unit_test(test_sin_cos_near_their_zeros),
    cmocka_unit_test(test_special_values),
    cmocka_unit_test(test_base_loops_give_same_bits),
#ifdef KG_TEST_X86_LEVELS
    cmocka_unit_test(test_v3_loops_give_same_bits),
    cmocka_unit_test(test_v4_loops_give_same_bits),
#endif
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
