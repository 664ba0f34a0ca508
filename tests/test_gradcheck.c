/* The checker of derivatives is itself checked: functions whose derivative is right must pass, however badly scaled,
 * and every kind of mistake must be found. */
#include "support.h"

#include "autodiff/gradcheck.h"
#include "kinegrad/primitive.h"

enum { MOST = 64 };

/* What is wrong with the derivative of a function below. */
typedef enum fault {
  NONE,
  WRONG_SIGN,
  MISSING_TERM,
  WRONG_FACTOR, /* 1 + 1e-6 */
  TRANSPOSED,
  NOT_A_NUMBER,
  JVP_DIFFERS,
  NOT_LINEAR, /* the product forgets the size of its seed */
  STATEFUL_VALUE,
  STATEFUL_PRODUCT,
  STALE_CACHE /* the product belongs to the first point ever asked for */
} fault;

/* y = A x + B sin(s x) entry by entry, A and B dense, inputs scaled by s: J = A + B diag(s cos(s x)) */
typedef struct dense {
  size_t n, m;
  double A[MOST], B[MOST], s[MOST];
  fault fault;
  int calls;
} dense;

static double jacobian(const dense *f, const double *x, size_t o, size_t j)
{
  if (f->fault == TRANSPOSED && f->n == f->m) {
    return f->A[j * f->n + o] + f->B[j * f->n + o] * f->s[j] * cos(f->s[j] * x[j]);
  }
  const size_t at = o * f->n + j;
  const bool here = o == f->m - 1 && j == f->n - 1;
  const double slope = f->B[at] * f->s[j] * cos(f->s[j] * x[j]);
  if (here && f->fault == WRONG_SIGN) return f->A[at] - slope;
  if (here && f->fault == MISSING_TERM) return slope;
  if (here && f->fault == WRONG_FACTOR) return (1 + 1e-6) * (f->A[at] + slope);
  if (at == 0 && f->fault == NOT_A_NUMBER) return NAN;
  return f->A[at] + slope;
}

static kg_status dense_value(void *user, const double *x, double *y)
{
  dense *f = user;
  ++f->calls;
  for (size_t o = 0; o < f->m; ++o) {
    y[o] = 0;
    for (size_t j = 0; j < f->n; ++j) {
      y[o] += f->A[o * f->n + j] * x[j] + f->B[o * f->n + j] * sin(f->s[j] * x[j]);
    }
    if (f->fault == STATEFUL_VALUE) y[o] *= 1 + 1e-15 * f->calls;
  }
  return KG_OK;
}

static kg_status dense_vjp(void *user, const double *x, const double *w, double *xw)
{
  dense *f = user;
  ++f->calls;
  for (size_t j = 0; j < f->n; ++j) {
    xw[j] = 0;
    for (size_t o = 0; o < f->m; ++o) {
      const double seed = f->fault == NOT_LINEAR ? (w[o] > 0) - (w[o] < 0) : w[o];
      xw[j] += jacobian(f, x, o, j) * seed;
    }
    if (f->fault == STATEFUL_PRODUCT) xw[j] *= 1 + 1e-15 * f->calls;
  }
  return KG_OK;
}

static kg_status dense_jvp(void *user, const double *x, const double *d, double *yd)
{
  const dense *f = user;
  for (size_t o = 0; o < f->m; ++o) {
    yd[o] = 0;
    for (size_t j = 0; j < f->n; ++j) {
      yd[o] += jacobian(f, x, o, j) * d[j];
    }
    if (f->fault == JVP_DIFFERS && o == 0) yd[o] *= 1 + 1e-10;
  }
  return KG_OK;
}

/* Im f(x + i h d) / h by hand: sin(s (x + i h d)) has the imaginary part cos(s x) sinh(s h d) */
static kg_status dense_complex_step(void *user, const double *x, const double *d, double *yd)
{
  const dense *f = user;
  const double h = 1e-30;
  for (size_t o = 0; o < f->m; ++o) {
    yd[o] = 0;
    for (size_t j = 0; j < f->n; ++j) {
      const size_t at = o * f->n + j;
      yd[o] +=
        (f->A[at] * h * d[j] + f->B[at] * cos(f->s[j] * x[j]) * sinh(f->s[j] * h * d[j])) / h;
    }
  }
  return KG_OK;
}

/* sin x + 1e9, and the slope A[0] cos x */
static kg_status offset_value(void *user, const double *x, double *y)
{
  (void)user;
  *y = 1e9 + sin(x[0]);
  return KG_OK;
}

static kg_status offset_vjp(void *user, const double *x, const double *w, double *xw)
{
  *xw = *w * ((const dense *)user)->A[0] * cos(x[0]);
  return KG_OK;
}

static kg_status offset_complex_step(void *user, const double *x, const double *d, double *yd)
{
  (void)user;
  *yd = cos(x[0]) * *d;
  return KG_OK;
}

/* the rows of a dense function, an error of 1e-17 in one that is zero */
static kg_status rounded_vjp(void *user, const double *x, const double *w, double *xw)
{
  (void)user, (void)x;
  xw[0] = w[0];
  xw[1] = 1e-17 * w[1];
  return KG_OK;
}

static kg_differentiable differentiable(dense *f)
{
  return (kg_differentiable){.name = "dense",
                             .inputs = f->n,
                             .outputs = f->m,
                             .user = f,
                             .value = dense_value,
                             .vjp = dense_vjp};
}

static dense random_dense(kg_random *random, size_t n, size_t m)
{
  dense f = {.n = n, .m = m};
  for (size_t i = 0; i < n * m; ++i) {
    f.A[i] = kg_random_normal(random);
    f.B[i] = kg_random_normal(random);
  }
  for (size_t j = 0; j < n; ++j) {
    f.s[j] = 1;
  }
  return f;
}

static kg_gradcheck_report check(const kg_differentiable *f, const double *x,
                                 const kg_gradcheck_def *def)
{
  kg_gradcheck_report report;
  kg_error error = {0};
  if (kg_gradcheck(f, x, def, &report, &error) != KG_OK) fail_msg("%s", error.text);
  return report;
}

static void expect_pass(const kg_gradcheck_report *r)
{
  char text[512];
  kg_gradcheck_row(r, text, sizeof text);
  if (!r->passed) fail_msg("false alarm: %s", text);
}

enum { WITH_JVP = 1, WITH_COMPLEX_STEP = 2 };

static kg_gradcheck_report check_dense(dense *f, const double *x, int with)
{
  kg_differentiable g = differentiable(f);
  if (with & WITH_JVP) g.jvp = dense_jvp;
  if (with & WITH_COMPLEX_STEP) g.complex_step = dense_complex_step;
  return check(&g, x, NULL);
}

static void right_derivatives_pass(void **state)
{
  (void)state;
  kg_random random = kg_random_make(1);
  for (int round = 0; round < 40; ++round) {
    dense f = random_dense(&random, 1 + (size_t)round % 5, 1 + (size_t)round % 4);
    double x[MOST];
    for (size_t j = 0; j < f.n; ++j) {
      x[j] = 2 * kg_random_normal(&random);
    }
    for (int with = 0; with < 4; ++with) {
      const kg_gradcheck_report r = check_dense(&f, x, with);
      expect_pass(&r);
      assert_true(r.taylor_order > 1.8 && r.taylor_order < 3.5);
      assert_true(r.tolerance == (with & WITH_COMPLEX_STEP ? 1e-12 : 1e-7));
      assert_at_most(r.max_relative_error, with & WITH_COMPLEX_STEP ? 1e-14 : 1e-9);
    }
  }
}

static void each_fault_is_found(void **state)
{
  (void)state;
  kg_random random = kg_random_make(2);
  for (fault kind = WRONG_SIGN; kind <= STALE_CACHE; ++kind) {
    if (kind == STALE_CACHE) continue; /* below */
    for (int round = 0; round < 10; ++round) {
      dense f = random_dense(&random, 3, 3);
      const double x[3] = {0.3 + 0.01 * round, -0.8, 0.5};
      f.fault = kind;
      for (int with = 0; with < 4; ++with) {
        if (kind == JVP_DIFFERS && !(with & WITH_JVP)) continue;
        const kg_gradcheck_report r = check_dense(&f, x, with);
        if (r.passed) fail_msg("fault %d passed with %d", (int)kind, with);
        const bool entry = kind == WRONG_SIGN || kind == MISSING_TERM || kind == WRONG_FACTOR;
        if (entry && (r.worst_output != 2 || r.worst_input != 2)) {
          fail_msg("fault %d is reported at %zu, %zu", (int)kind, r.worst_output, r.worst_input);
        }
        if (entry) assert_true(fabs(r.worst_analytic - r.worst_numeric) > 1e-8);
        if (kind == NOT_A_NUMBER) assert_true(isnan(r.max_relative_error));
        assert_true(r.repeatable == (kind != STATEFUL_VALUE && kind != STATEFUL_PRODUCT));
      }
    }
  }
}

/* the other tests switched off: the columns J e_j are held against the differences too */
static void a_wrong_jvp_is_found_entry_by_entry(void **state)
{
  (void)state;
  kg_random random = kg_random_make(8);
  dense f = random_dense(&random, 3, 3);
  const double x[3] = {0.3, -0.8, 0.5};
  kg_differentiable g = differentiable(&f);
  g.jvp = dense_jvp;
  g.complex_step = dense_complex_step;
  kg_gradcheck_def def = kg_gradcheck_default_def();
  def.dot_tolerance = 1;
  kg_gradcheck_report r = check(&g, x, &def);
  expect_pass(&r);
  f.fault = JVP_DIFFERS;
  r = check(&g, x, &def);
  assert_false(r.passed);
  assert_true(r.worst_output == 0);
}

/* beside a large value a small derivative still counts */
static void an_offset_hides_nothing(void **state)
{
  (void)state;
  dense f = {.n = 2, .m = 1, .A = {1, 1e9}, .B = {1, 0}, .s = {1, 1}};
  const double x[2] = {0.3, 1};
  kg_differentiable g = differentiable(&f);
  g.inputs = 1; /* x[1] stays: an offset of 1e9 */
  g.complex_step = offset_complex_step;
  g.value = offset_value;
  g.vjp = offset_vjp;
  kg_gradcheck_def def = kg_gradcheck_default_def();
  def.taylor = false;
  kg_gradcheck_report r = check(&g, x, &def);
  expect_pass(&r);
  f.A[0] = 1.001; /* of the product only */
  r = check(&g, x, &def);
  assert_false(r.passed);
}

/* rounding errors in an entry that is zero are none of the derivative's */
static void rounding_in_a_zero_entry_passes(void **state)
{
  (void)state;
  dense f = {.n = 2, .m = 2, .A = {1, 0, 1e-16, 0}, .s = {1, 1}};
  const double x[2] = {1, 0.5};
  const kg_gradcheck_report r = check_dense(&f, x, 0);
  expect_pass(&r);
  f.A[2] = 0;
  kg_differentiable g = differentiable(&f);
  g.vjp = rounded_vjp;
  const kg_gradcheck_report rounded = check(&g, x, NULL);
  expect_pass(&rounded);
}

static void taylor_order_tells_a_wrong_derivative_alone(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  dense f = random_dense(&random, 3, 3);
  const double x[3] = {0.3, -0.8, 0.5};
  f.fault = WRONG_FACTOR;
  const kg_gradcheck_report r = check_dense(&f, x, 0);
  assert_true(r.taylor_order < 1.5);
}

/* small entries beside large ones: each is held to its own size where the differences resolve it */
static void small_entries_count_beside_large_ones(void **state)
{
  (void)state;
  dense f = {.n = 2, .m = 1, .A = {1e8, 0}, .B = {0, 1}, .s = {1, 1}};
  const double x[2] = {0.7, 0.4};
  kg_gradcheck_report r = check_dense(&f, x, WITH_JVP);
  expect_pass(&r);
  f.fault = WRONG_SIGN;
  r = check_dense(&f, x, WITH_JVP);
  assert_false(r.passed);
  assert_int_equal(r.worst_input, 1);
}

static void badly_scaled_inputs_raise_no_alarm(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  static const double scales[][3] = {
    {1e-8, 1, 1e8}, {1e8, 1e8, 1e8}, {1e-8, 1e-8, 1e-8}, {1e4, 1e-4, 1}};
  for (size_t k = 0; k < KG_COUNT_OF(scales); ++k) {
    for (int round = 0; round < 10; ++round) {
      dense f = random_dense(&random, 3, 2);
      double x[3];
      for (size_t j = 0; j < 3; ++j) {
        x[j] = scales[k][j] * (0.3 + kg_random_uniform(&random));
        f.s[j] = 1 / scales[k][j];
        f.A[j] /= scales[k][j];
        f.A[3 + j] /= scales[k][j];
      }
      for (int with = 0; with < 4; ++with) {
        kg_gradcheck_report r = check_dense(&f, x, with);
        expect_pass(&r);
        f.fault = WRONG_SIGN;
        r = check_dense(&f, x, with);
        /* under entries 1e16 times as large it is below rounding */
        if (k && k != 3) assert_false(r.passed);
        f.fault = NONE;
      }
    }
  }
}

static void linear_constant_and_zero_functions_pass(void **state)
{
  (void)state;
  kg_random random = kg_random_make(5);
  const double x[3] = {0.3, -70, 5e3};
  for (int with = 0; with < 4; ++with) {
    dense linear = random_dense(&random, 3, 3);
    memset(linear.B, 0, sizeof linear.B);
    kg_gradcheck_report r = check_dense(&linear, x, with);
    expect_pass(&r);
    assert_true(isinf(r.taylor_order));
    dense zero = {.n = 3, .m = 2, .s = {1, 1, 1}};
    r = check_dense(&zero, x, with);
    expect_pass(&r);
    assert_true(r.max_relative_error == 0 && r.dot_test == 0);
  }
}

/* sin^2 + cos^2: the true gradient is 0, what is computed is rounding */
static kg_status circle_value(void *user, const double *x, double *y)
{
  const double scale = *(const double *)user;
  *y = scale * (sin(x[0]) * sin(x[0]) + cos(x[0]) * cos(x[0]));
  return KG_OK;
}

static kg_status circle_vjp(void *user, const double *x, const double *w, double *xw)
{
  const double scale = *(const double *)user;
  *xw = *w * scale * (2 * sin(x[0]) * cos(x[0]) * (1 + 1e-16) - 2 * cos(x[0]) * sin(x[0]) + 1e-17);
  return KG_OK;
}

static kg_status circle_wrong(void *user, const double *x, const double *w, double *xw)
{
  (void)x;
  *xw = *w * 1e-4 * *(const double *)user;
  return KG_OK;
}

static void zero_gradients_pass_and_are_not_a_licence(void **state)
{
  (void)state;
  double scale = 1;
  for (int round = 0; round < 12; ++round, scale *= round % 2 ? 1e3 : 1e-5) {
    kg_differentiable f = {"circle", 1, 1, &scale, circle_value, circle_vjp, NULL, NULL};
    const double x = 0.1 + 0.37 * round;
    kg_gradcheck_report r = check(&f, &x, NULL);
    expect_pass(&r);
    f.vjp = circle_wrong;
    r = check(&f, &x, NULL);
    assert_false(r.passed);
  }
}

/* exp(-1/x^2)-like domains: log(x) near 0, where a first step would leave the domain */
static kg_status log_value(void *user, const double *x, double *y)
{
  (void)user;
  if (!(x[0] > 0)) return KG_ERR_UNDEFINED;
  *y = log(x[0]);
  return KG_OK;
}

static kg_status log_vjp(void *user, const double *x, const double *w, double *xw)
{
  *xw = *w / x[0] * *(const double *)user;
  return KG_OK;
}

static void steps_stay_inside_the_domain(void **state)
{
  (void)state;
  for (double x = 1e-7; x < 1e7; x *= 10) {
    double factor = 1;
    kg_differentiable f = {"log", 1, 1, &factor, log_value, log_vjp, NULL, NULL};
    kg_gradcheck_report r = check(&f, &x, NULL);
    expect_pass(&r);
    factor = 1 + 1e-5;
    r = check(&f, &x, NULL);
    assert_false(r.passed);
  }
  const double outside = -1;
  double factor = 1;
  const kg_differentiable f = {"log", 1, 1, &factor, log_value, log_vjp, NULL, NULL};
  kg_gradcheck_report r;
  kg_error error = {0};
  assert_int_equal(kg_gradcheck(&f, &outside, NULL, &r, &error), KG_ERR_UNDEFINED);
  assert_non_null(strstr(error.text, "log"));
}

/* a value with noise of 1e-6: nothing can be said to 1e-7, and nothing is */
static kg_status noisy_value(void *user, const double *x, double *y)
{
  (void)user;
  *y = sin(x[0]) + 1e-6 * sin(1e17 * x[0]);
  return KG_OK;
}

static kg_status cosine_vjp(void *user, const double *x, const double *w, double *xw)
{
  (void)user;
  *xw = *w * cos(x[0]);
  return KG_OK;
}

static kg_status cosine_step(void *user, const double *x, const double *d, double *yd)
{
  (void)user;
  *yd = cos(x[0]) * *d;
  return KG_OK;
}

static void what_cannot_be_decided_is_said_to_be_so(void **state)
{
  (void)state;
  const kg_differentiable f = {"noisy", 1, 1, NULL, noisy_value, cosine_vjp, NULL, NULL};
  const double x = 0.7;
  kg_gradcheck_def def = kg_gradcheck_default_def();
  def.taylor = false;
  kg_gradcheck_report r = check(&f, &x, &def);
  assert_false(r.passed);
  assert_true(r.error_estimate > r.tolerance);
  char text[512];
  kg_gradcheck_row(&r, text, sizeof text);
  assert_non_null(strstr(text, "undecided"));
  def.tolerance = 1e-2;
  r = check(&f, &x, &def);
  expect_pass(&r);
  int lucky = 0; /* agrees by chance, which is not enough */
  for (def.tolerance = 1e-9; def.tolerance < 1e-2; def.tolerance *= 1.3) {
    r = check(&f, &x, &def);
    assert_true(!r.passed || r.error_estimate <= r.tolerance);
    lucky += !r.passed && r.max_relative_error <= r.tolerance;
  }
  assert_true(lucky > 0);
}

/* what is extrapolated has far smaller errors than central differences, and knows it */
static void differences_are_extrapolated(void **state)
{
  (void)state;
  double factor = 1;
  const kg_differentiable f = {"log", 1, 1, &factor, log_value, log_vjp, NULL, NULL};
  const double x = 3;
  const kg_gradcheck_report r = check(&f, &x, NULL);
  expect_pass(&r);
  assert_at_most(r.max_relative_error, 2e-12);
  assert_at_most(r.error_estimate, 2e-11);
}

/* exp(-(x / 1e-6)^2) looks constant from afar: the first steps skip it */
static kg_status narrow_value(void *user, const double *x, double *y)
{
  (void)user;
  *y = exp(-x[0] * x[0] * 1e12);
  return KG_OK;
}

static kg_status narrow_vjp(void *user, const double *x, const double *w, double *xw)
{
  *xw = *w * *(const double *)user * -2e12 * x[0] * exp(-x[0] * x[0] * 1e12);
  return KG_OK;
}

static void narrow_features_are_not_skipped(void **state)
{
  (void)state;
  double factor = 1;
  const double x = 0.6e-6;
  const kg_differentiable f = {"narrow", 1, 1, &factor, narrow_value, narrow_vjp, NULL, NULL};
  kg_gradcheck_report r = check(&f, &x, NULL);
  expect_pass(&r);
  factor = 1.001;
  r = check(&f, &x, NULL);
  assert_false(r.passed);
  factor = 0; /* agrees with what the large steps see */
  r = check(&f, &x, NULL);
  assert_false(r.passed);
}

/* a product cached at the first point; then at x it answers for that point */
typedef struct cached {
  bool filled;
  double slope;
} cached;

static kg_status square_value(void *user, const double *x, double *y)
{
  cached *cache = user;
  *y = x[0] * x[0];
  cache->slope = 2 * x[0]; /* of whatever point was evaluated last */
  return KG_OK;
}

static kg_status square_vjp(void *user, const double *x, const double *w, double *xw)
{
  (void)x;
  *xw = *w * ((cached *)user)->slope;
  return KG_OK;
}

static void leftovers_of_other_points_are_found(void **state)
{
  (void)state;
  cached cache = {0};
  const kg_differentiable f = {"square", 1, 1, &cache, square_value, square_vjp, NULL, NULL};
  const double x = 0.7;
  const kg_gradcheck_report r = check(&f, &x, NULL);
  assert_false(r.passed);
}

static kg_status not_a_number(void *user, const double *x, double *y)
{
  (void)user, (void)x;
  *y = NAN;
  return KG_OK;
}

static kg_status second_is_infinite(void *user, const double *x, double *y)
{
  (void)user;
  y[0] = sin(x[0]);
  y[1] = HUGE_VAL;
  return KG_OK;
}

static kg_status two_cosines_vjp(void *user, const double *x, const double *w, double *xw)
{
  (void)user;
  *xw = (w[0] + w[1]) * cos(x[0]);
  return KG_OK;
}

/* the row of the table ends so, whatever room there is for it */
static void assert_says(const kg_gradcheck_report *r, const char *text)
{
  char row[256], cut[100];
  const int length = kg_gradcheck_row(r, row, sizeof row);
  assert_int_equal(length, strlen(row));
  if (!strstr(row, text)) fail_msg("'%s' is not in '%s'", text, row);
  assert_int_equal(kg_gradcheck_row(r, cut, sizeof cut), length);
  assert_memory_equal(cut, row, strlen(cut));
}

static void values_that_are_not_numbers_fail(void **state)
{
  (void)state;
  const kg_differentiable f = {"nan", 1, 1, NULL, not_a_number, cosine_vjp, NULL, NULL};
  const double x = 0.7;
  const kg_gradcheck_report r = check(&f, &x, NULL);
  assert_false(r.passed);
  assert_true(isnan(r.max_relative_error));
  assert_says(&r, "FAILED: the value y[0] is not a number");
  kg_differentiable g = {"nan", 1, 1, NULL, not_a_number, cosine_vjp, NULL, cosine_step};
  const kg_gradcheck_report exact = check(&g, &x, NULL); /* the derivative alone is right */
  assert_false(exact.passed);
  const kg_differentiable h = {"inf", 1, 2, NULL, second_is_infinite, two_cosines_vjp, NULL, NULL};
  const kg_gradcheck_report second = check(&h, &x, NULL);
  assert_false(second.passed);
  assert_says(&second, "FAILED: the value y[1] is infinite");
  kg_random random = kg_random_make(7);
  dense wrong = random_dense(&random, 2, 2); /* its value is a number, a derivative is not */
  wrong.fault = NOT_A_NUMBER;
  const double at[2] = {1, 2};
  const kg_gradcheck_report entry = check_dense(&wrong, at, WITH_JVP);
  assert_says(&entry, "FAILED: dy[0]/dx[0] is given as ");
}

static void what_is_not_there_is_missed_by_name(void **state)
{
  (void)state;
  const kg_differentiable no_value = {"pendulum", 1, 1, NULL, NULL, cosine_vjp, NULL, NULL};
  const kg_differentiable no_vjp = {"pendulum", 1, 1, NULL, not_a_number, NULL, NULL, NULL};
  const double x = 0.7;
  kg_gradcheck_report report;
  kg_error error;
  assert_int_equal(kg_gradcheck(&no_value, &x, NULL, &report, &error), KG_ERR_UNDEFINED);
  assert_string_equal(error.text, "pendulum: brings no value, which a check needs");
  assert_int_equal(kg_gradcheck(&no_vjp, &x, NULL, &report, &error), KG_ERR_UNDEFINED);
  assert_string_equal(error.text, "pendulum: brings no vjp, which a check needs");
  assert_false(report.passed);
}

static void of_two_reports_the_worse_is_kept(void **state)
{
  (void)state;
  const kg_gradcheck_report good = {.name = "good",
                                    .passed = true,
                                    .tolerance = 1e-7,
                                    .max_relative_error = 1e-9,
                                    .error_estimate = 1e-10,
                                    .dot_test = 1e-16,
                                    .taylor_order = 2,
                                    .repeatable = true};
  kg_gradcheck_report bad = good;
  bad.passed = bad.repeatable = false;
  bad.worst_input = 3;
  bad.max_relative_error = bad.error_estimate = bad.dot_test = 1;
  bad.taylor_order = 1;
  for (int nan = 0; nan < 2; ++nan) {
    if (nan) bad.max_relative_error = bad.dot_test = NAN;
    for (int order = 0; order < 2; ++order) {
      kg_gradcheck_report sum = order ? bad : good;
      sum.name = "sum";
      kg_gradcheck_merge(&sum, order ? &good : &bad);
      assert_string_equal(sum.name, "sum");
      assert_true(!sum.passed && !sum.repeatable && sum.worst_input == 3);
      assert_true(nan ? isnan(sum.max_relative_error) : sum.max_relative_error == 1);
      assert_true(nan ? isnan(sum.dot_test) : sum.dot_test == 1);
      assert_true(sum.taylor_order == 1 && sum.error_estimate == 1 && !sum.undecided);
    }
  }
}

static void memory_that_is_refused_is_reported(void **state)
{
  (void)state;
  kg_random random = kg_random_make(6);
  dense f = random_dense(&random, 4, 4);
  const double x[4] = {1, 2, 3, 4};
  const kg_differentiable g = differentiable(&f);
  int calls = 0;
  for (kg_status status = KG_ERR_NO_MEMORY; status != KG_OK; ++calls) {
    failing_heap heap = {.calls_left = calls};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_gradcheck_def def = kg_gradcheck_default_def();
    def.allocator = &allocator;
    kg_gradcheck_report r;
    status = kg_gradcheck(&g, x, &def, &r, NULL);
    assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(calls > 1);
}

static void rows_of_the_table_line_up(void **state)
{
  (void)state;
  kg_random random = kg_random_make(7);
  dense f = random_dense(&random, 2, 2);
  const double x[2] = {1, 2};
  const kg_gradcheck_report r = check_dense(&f, x, WITH_JVP);
  char head[256], row[256], cut[16];
  kg_gradcheck_row(NULL, head, sizeof head);
  const int length = kg_gradcheck_row(&r, row, sizeof row);
  assert_int_equal(length, strlen(row));
  assert_ptr_equal(strstr(head, "verdict") - head, strstr(row, "ok") - row);
  assert_int_equal(kg_gradcheck_row(&r, cut, sizeof cut), length);
  assert_memory_equal(cut, row, sizeof cut - 1);
  assert_int_equal(cut[sizeof cut - 1], 0);
}

/* -- recorded functions ------------------------------------------------------------------------ */

/* sum over the entries of x sin x, or with the derivative of the last entry lost */
static kg_value recorded_function(kg_tape *tape, kg_value x, void *user)
{
  const kg_value s = kg_sin(tape, x);
  if (*(const bool *)user) { /* a constant in place of sin x */
    return kg_mul(tape, x, kg_constant(tape, kg_shape_of(tape, s), kg_data(tape, s)));
  }
  return kg_mul(tape, x, s);
}

static void recorded_functions_are_checked(void **state)
{
  (void)state;
  const double x[6] = {0.1, 0.7, -2, 3, 0, 1e-3};
  for (int lost = 0; lost < 2; ++lost) {
    bool user = lost;
    kg_gradcheck_report r;
    kg_error error = {0};
    assert_int_equal(kg_gradcheck_recorded("x sin x", recorded_function, &user, KG_SHAPE(2, 3), x,
                                           NULL, &r, &error),
                     KG_OK);
    if (!lost) expect_pass(&r);
    assert_true(r.passed == !lost);
  }
}

static kg_value with_offset(kg_tape *tape, kg_value x, void *user)
{
  return kg_shift(tape, recorded_function(tape, x, user), 1e-9);
}

static void a_reference_must_have_the_values_too(void **state)
{
  (void)state;
  const double x[3] = {0.1, 0.7, -2};
  bool user = false;
  kg_gradcheck_report r;
  for (int other = 0; other < 2; ++other) {
    const kg_gradcheck_truth truth = {other ? with_offset : recorded_function, x};
    assert_int_equal(kg_gradcheck_against("x sin x", recorded_function, &user, KG_SHAPE(3), x,
                                          &truth, NULL, &r, NULL),
                     KG_OK);
    assert_true(r.passed == !other);
  }
}

static kg_value refused(kg_tape *tape, kg_value x, void *user)
{
  (void)user;
  return kg_add(tape, x, kg_constant(tape, KG_SHAPE(7), NULL));
}

static void refused_recordings_say_why(void **state)
{
  (void)state;
  const double x[6] = {0};
  kg_gradcheck_report r;
  kg_error error = {0};
  assert_int_equal(
    kg_gradcheck_recorded("refused", refused, NULL, KG_SHAPE(2, 3), x, NULL, &r, &error),
    KG_ERR_SHAPE);
  assert_non_null(strstr(error.text, "refused: add"));
}

/* y_i = a_i^3 b, b a scalar; *user is a factor on the adjoint of b: 1 is right */
static kg_status cube_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)user, (void)saved;
  *result = shapes[0];
  return count == 2 && shapes[1].rank == 0 ? KG_OK : KG_ERR_SHAPE;
}

static kg_status cube(const kg_primitive_call *call)
{
  for (size_t i = 0; i < kg_shape_size(&call->shape); ++i) {
    call->out[i] = pow(call->in[0][i], 3) * call->in[1][0];
  }
  return KG_OK;
}

static kg_status cube_vjp(const kg_primitive_call *call, const double *g, double *const *sums)
{
  for (size_t i = 0; i < kg_shape_size(&call->shape); ++i) {
    const double a = call->in[0][i];
    if (sums[0]) sums[0][i] += 3 * a * a * call->in[1][0] * g[i];
    if (sums[1]) sums[1][0] += *(const double *)call->user * a * a * a * g[i];
  }
  return KG_OK;
}

static int cube_sample(void *user, kg_random *random, int index, kg_arena *arena, kg_shape *shapes,
                       double **in)
{
  (void)user;
  shapes[0] = KG_SHAPE(2, 1 + index % 3);
  shapes[1] = KG_SCALAR_SHAPE;
  for (int k = 0; k < 2; ++k) {
    in[k] = KG_ARENA_ARRAY(arena, double, kg_shape_size(&shapes[k]));
    for (size_t i = 0; i < kg_shape_size(&shapes[k]); ++i) {
      in[k][i] = 1 + kg_random_uniform(random);
    }
  }
  return 2;
}

static void primitives_are_checked_at_their_samples(void **state)
{
  (void)state;
  double factor = 1;
  const kg_primitive primitive = {.name = "cube",
                                  .user = &factor,
                                  .shape = cube_shape,
                                  .forward = cube,
                                  .vjp = cube_vjp,
                                  .sample = cube_sample};
  kg_gradcheck_report report;
  assert_int_equal(kg_gradcheck_primitive(&primitive, 5, NULL, &report, NULL), KG_OK);
  assert_true(report.passed);
  assert_string_equal(report.method, "differences");
  factor = 1 + 1e-5;
  assert_int_equal(kg_gradcheck_primitive(&primitive, 5, NULL, &report, NULL), KG_OK);
  assert_false(report.passed);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(right_derivatives_pass),
    cmocka_unit_test(each_fault_is_found),
    cmocka_unit_test(a_wrong_jvp_is_found_entry_by_entry),
    cmocka_unit_test(an_offset_hides_nothing),
    cmocka_unit_test(rounding_in_a_zero_entry_passes),
    cmocka_unit_test(taylor_order_tells_a_wrong_derivative_alone),
    cmocka_unit_test(small_entries_count_beside_large_ones),
    cmocka_unit_test(badly_scaled_inputs_raise_no_alarm),
    cmocka_unit_test(linear_constant_and_zero_functions_pass),
    cmocka_unit_test(zero_gradients_pass_and_are_not_a_licence),
    cmocka_unit_test(steps_stay_inside_the_domain),
    cmocka_unit_test(differences_are_extrapolated),
    cmocka_unit_test(what_cannot_be_decided_is_said_to_be_so),
    cmocka_unit_test(narrow_features_are_not_skipped),
    cmocka_unit_test(leftovers_of_other_points_are_found),
    cmocka_unit_test(values_that_are_not_numbers_fail),
    cmocka_unit_test(what_is_not_there_is_missed_by_name),
    cmocka_unit_test(of_two_reports_the_worse_is_kept),
    cmocka_unit_test(memory_that_is_refused_is_reported),
    cmocka_unit_test(rows_of_the_table_line_up),
    cmocka_unit_test(recorded_functions_are_checked),
    cmocka_unit_test(a_reference_must_have_the_values_too),
    cmocka_unit_test(primitives_are_checked_at_their_samples),
    cmocka_unit_test(refused_recordings_say_why),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
