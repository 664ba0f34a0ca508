/* 3-vectors and rotations: values against base/quat.h, derivatives against complex steps, the right
 * Jacobian of SO(3) and long double series, with the angles near zero, near pi and beyond. */
#include "tape_support.h"

#define PI 3.14159265358979323846

enum { POINTS = 100 };

static kg_tape *new_tape(kg_precision precision, int simd)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = simd};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static kg_vec3 item_vec3(const kg_tape *tape, kg_value a, size_t i)
{
  const double *x = kg_data(tape, a) + 3 * i;
  return kg_vec3_make(x[0], x[1], x[2]);
}

static kg_quat item_quat(const kg_tape *tape, kg_value a, size_t i)
{
  const double *x = kg_data(tape, a) + 4 * i;
  return kg_quat_make(x[0], x[1], x[2], x[3]);
}

static void assert_vec3(kg_vec3 a, kg_vec3 b, double tolerance)
{
  assert_close(a.x, b.x, tolerance);
  assert_close(a.y, b.y, tolerance);
  assert_close(a.z, b.z, tolerance);
}

static void assert_quat(kg_quat a, kg_quat b, double tolerance)
{
  assert_close(a.w, b.w, tolerance);
  assert_vec3(kg_vec3_make(a.x, a.y, a.z), kg_vec3_make(b.x, b.y, b.z), tolerance);
}

/* 100 items of normal numbers, shape (20, 5, components) */
static kg_value items(kg_tape *tape, int components, kg_random *random)
{
  double *x = random_numbers(random, (size_t)(POINTS * components));
  const kg_value a = kg_input(tape, KG_SHAPE(20, 5, components), x);
  free(x);
  return a;
}

static void products_equal_the_quaternion_algebra(void **state)
{
  (void)state;
  kg_random random = kg_random_make(1);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = items(tape, 3, &random), b = items(tape, 3, &random);
  const kg_value p = items(tape, 4, &random), q = items(tape, 4, &random);
  const kg_value cross = kg_cross(tape, a, b);
  check_operator(tape, 2, (kg_value[]){a, b}, cross, &random, 1e-14);
  check_lanes(tape, cross, &random);
  const kg_value product = kg_compose(tape, p, q);
  check_operator(tape, 2, (kg_value[]){p, q}, product, &random, 1e-14);
  check_lanes(tape, product, &random);
  const kg_value moved = kg_rotate(tape, q, a);
  check_operator(tape, 2, (kg_value[]){q, a}, moved, &random, 1e-14);
  check_lanes(tape, moved, &random);
  for (size_t i = 0; i < POINTS; ++i) {
    const kg_vec3 x = item_vec3(tape, a, i);
    assert_vec3(item_vec3(tape, cross, i), kg_vec3_cross(x, item_vec3(tape, b, i)), 1e-15);
    assert_quat(item_quat(tape, product, i),
                kg_quat_mul(item_quat(tape, p, i), item_quat(tape, q, i)), 1e-15);
    assert_vec3(item_vec3(tape, moved, i), kg_quat_rotate(item_quat(tape, q, i), x), 1e-14);
  }
  kg_tape_destroy(tape);
}

/* one value as both operands: both parts of the derivative arrive */
static void an_operand_may_be_used_twice(void **state)
{
  (void)state;
  kg_random random = kg_random_make(2);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = items(tape, 3, &random), q = items(tape, 4, &random);
  const kg_value none = kg_cross(tape, a, a), square = kg_compose(tape, q, q);
  check_operator(tape, 1, &q, square, &random, 1e-14);
  assert_int_equal(kg_backward(tape, none), KG_OK);
  for (size_t i = 0; i < 3 * POINTS; ++i) {
    assert_close(kg_item_at(tape, none, i), 0, 0);
    assert_close(kg_adjoint(tape, a)[i], 0, 1e-15);
  }
  kg_tape_destroy(tape);
}

/* angles: zero, near it, around the end of the series, near pi and 2 pi, and large */
static const double angles[] = {
  0,         1e-160, 1e-12,     1e-9, 1e-8,          1e-7,   1e-6,     1e-5, 1e-4, 1e-3,
  1e-2,      0.1,    0.5,       0.9,  0.999999,      1,      1.000001, 1.5,  2.5,  PI - 1e-3,
  PI - 1e-8, PI,     PI + 1e-8, 4,    2 * PI - 1e-6, 2 * PI, 7,        20};

/* sum y^k / (2k+1)!, and its derivative, in long double with many more terms than the kernels' */
static long double sinc_series(long double y, long double *slope)
{
  long double term = 1, value = 0;
  *slope = 0;
  for (int k = 0; k < 40; ++k) {
    value += term;
    const long double next = term / ((2 * k + 2) * (2 * k + 3));
    *slope += (k + 1) * next;
    term = next * y;
  }
  return value;
}

static void exp_is_smooth_through_zero(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  for (size_t c = 0; c < KG_COUNT_OF(angles); ++c) {
    const kg_vec3 axis = kg_vec3_normalized(random_vec3(&random, 1));
    const kg_vec3 rotation = kg_vec3_scale(angles[c], axis);
    const double x[3] = {rotation.x, rotation.y, rotation.z};
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const kg_value r = kg_input(tape, KG_SHAPE(3), x), q = kg_rotation_exp(tape, r);
    const double tolerance = 1e-15 * fmax(angles[c], 1);
    assert_quat(item_quat(tape, q, 0), kg_quat_exp(rotation), tolerance);
    check_operator(tape, 1, &r, q, &random, 1e-14);
    const kg_mat3 right = kg_so3_right_jacobian(rotation);
    for (int j = 0; j < 3; ++j) { /* dq = q (0, Jr dr) / 2 */
      double d[3] = {0}, dq[4];
      d[j] = 1;
      assert_int_equal(kg_jvp(tape, 1, 1, &r, (const double *[]){d}, 1, &q, (double *[]){dq}),
                       KG_OK);
      const kg_quat half = kg_quat_make(0, right.m[j] / 2, right.m[3 + j] / 2, right.m[6 + j] / 2);
      assert_quat(kg_quat_make(dq[0], dq[1], dq[2], dq[3]),
                  kg_quat_mul(kg_quat_exp(rotation), half), tolerance);
      if (angles[c] > 3) continue; /* the series below would lose digits */
      const long double y =
        -((long double)x[0] * x[0] + (long double)x[1] * x[1] + (long double)x[2] * x[2]) / 4;
      long double slope, sinc = sinc_series(y, &slope);
      for (int i = 0; i < 3; ++i) { /* every entry, not the largest alone */
        const double mixed = (double)(-slope / 4 * x[i] * x[j]),
                     own = i == j ? (double)sinc / 2 : 0;
        assert_at_most(fabs(dq[i + 1] - (mixed + own)), 1e-14 * (fabs(mixed) + fabs(own)));
      }
      assert_at_most(fabs(dq[0] + (double)(sinc / 4 * x[j])),
                     1e-14 * fabs((double)(sinc / 4 * x[j])));
    }
    kg_tape_destroy(tape);
  }
}

static void exp_and_log_at_100_points(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  double x[3 * POINTS];
  for (size_t i = 0; i < POINTS; ++i) {
    const kg_vec3 axis = kg_vec3_normalized(random_vec3(&random, 1));
    const double angle =
      i % 4 ? 3.1 * kg_random_uniform(&random) : pow(10, -12.0 * (double)i / POINTS);
    memcpy(x + 3 * i, (double[]){angle * axis.x, angle * axis.y, angle * axis.z}, 3 * sizeof *x);
  }
  const kg_value r = kg_input(tape, KG_SHAPE(POINTS, 3), x), q = kg_rotation_exp(tape, r);
  check_operator(tape, 1, &r, q, &random, 1e-14);
  check_lanes(tape, q, &random);
  const kg_value back = kg_rotation_log(tape, q), turned = kg_rotation_log(tape, kg_neg(tape, q));
  check_operator(tape, 1, &r, back, &random, 1e-13);
  check_lanes(tape, back, &random);
  for (size_t i = 0; i < 3 * POINTS; ++i) {
    assert_close(kg_item_at(tape, back, i), x[i], 1e-15);
    assert_close(kg_item_at(tape, turned, i), kg_item_at(tape, back, i), 0);
  }
  for (size_t i = 0; i < POINTS; ++i) {
    assert_quat(item_quat(tape, q, i), kg_quat_exp(item_vec3(tape, r, i)), 1e-15);
  }
  kg_tape_destroy(tape);
  tape = new_tape(KG_DOUBLE, 3); /* any quaternion, of any length */
  const kg_value any = items(tape, 4, &random), log = kg_rotation_log(tape, any);
  check_operator(tape, 1, &any, log, &random, 1e-14);
  check_lanes(tape, log, &random);
  kg_tape_destroy(tape);
}

/* f = 2 atan2(u, w) / u for w > 0, and (df/du) / u, in long double */
static long double log_factor(long double w, long double u, long double *slope)
{
  const long double y = -u * u / (w * w);
  if (u >= 0.1L * w) {
    const long double f = 2 * atan2l(u, w) / u;
    *slope = (2 * w / (w * w + u * u) - f) / (u * u);
    return f;
  }
  long double power = 1, value = 0;
  *slope = 0;
  for (int k = 0; k < 40; ++k) {
    value += power / (2 * k + 1);
    *slope -= 4 / (w * w * w) * (k + 1) * power / (2 * k + 3);
    power *= y;
  }
  return 2 * value / w;
}

static void log_near_zero_near_pi_and_on_both_sheets(void **state)
{
  (void)state;
  kg_random random = kg_random_make(5);
  for (size_t c = 0; c < 2 * KG_COUNT_OF(angles); ++c) {
    const double angle = fmin(angles[c / 2], PI), sheet = c % 2 ? -1 : 1;
    const kg_vec3 axis = kg_vec3_normalized(random_vec3(&random, 1));
    const double sine = sheet * sin(angle / 2);
    const double w = angle == PI ? 0 : sheet * cos(angle / 2);
    const double x[4] = {w, sine * axis.x, sine * axis.y, sine * axis.z};
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const kg_value q = kg_input(tape, KG_SHAPE(4), x), r = kg_rotation_log(tape, q);
    assert_vec3(item_vec3(tape, r, 0), kg_quat_log(item_quat(tape, q, 0)), 1e-15 * 4);
    check_operator(tape, 1, &q, r, &random, 1e-14);
    const long double ux = x[1], uy = x[2], uz = x[3], u = sqrtl(ux * ux + uy * uy + uz * uz);
    const long double sign = w < 0 ? -1 : 1;
    long double slope, f = log_factor(sign * w, u, &slope);
    for (int j = 0; j < 4; ++j) {
      double d[4] = {0}, dr[3];
      d[j] = 1;
      assert_int_equal(kg_jvp(tape, 1, 1, &q, (const double *[]){d}, 1, &r, (double *[]){dr}),
                       KG_OK);
      for (int i = 0; i < 3; ++i) {
        const long double mixed =
          j == 0 ? -2 / (w * w + u * u) * x[i + 1] : sign * slope * x[i + 1] * x[j];
        const long double own = i + 1 == j ? sign * f : 0;
        assert_at_most(fabs(dr[i] - (double)(mixed + own)),
                       1e-14 * (double)(fabsl(mixed) + fabsl(own)));
      }
    }
    kg_tape_destroy(tape);
  }
}

/* at w = 0 the value and the derivative are those of w > 0; -0 is 0 */
static void log_at_half_a_turn(void **state)
{
  (void)state;
  for (int negative = 0; negative < 2; ++negative) {
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const double x[4] = {negative ? -0.0 : 0.0, 0.6, 0, 0.8}, w[3] = {1, 1, 1};
    double g[4];
    const kg_value q = kg_input(tape, KG_SHAPE(4), x), r = kg_rotation_log(tape, q);
    assert_vec3(item_vec3(tape, r, 0), kg_vec3_make(0.6 * PI, 0, 0.8 * PI), 1e-15);
    assert_int_equal(kg_vjp(tape, 1, 1, &r, (const double *[]){w}, 1, &q, (double *[]){g}), KG_OK);
    assert_close(g[0], -2 * 1.4, 1e-15); /* -2 (1,1,1).u / |q|^2 */
    assert_close(g[2], PI, 1e-15);       /* f */
    kg_tape_destroy(tape);
  }
}

/* against plain loops, along an axis of any extent; the zero vector */
static void normalize_divides_by_the_length(void **state)
{
  (void)state;
  static const kg_shape shapes[] = {
    {1, {3}}, {2, {100, 3}}, {3, {5, 20, 4}}, {2, {3, 1}}, {2, {4, 75}}};
  kg_random random = kg_random_make(6);
  for (size_t c = 0; c < KG_COUNT_OF(shapes); ++c) {
    const size_t n = (size_t)shapes[c].dim[shapes[c].rank - 1], size = kg_shape_size(&shapes[c]);
    double *x = random_numbers(&random, size);
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const kg_value a = kg_input(tape, shapes[c], x), y = kg_normalize(tape, a);
    for (size_t i = 0; i < size; ++i) {
      long double sum = 0;
      for (size_t j = i / n * n; j < i / n * n + n; ++j) {
        sum += (long double)x[j] * x[j];
      }
      assert_close(kg_item_at(tape, y, i), (double)(x[i] / sqrtl(sum)), 1e-15);
    }
    if (n > 1) check_operator(tape, 1, &a, y, &random, 1e-14); /* of a sign it is rounding alone */
    check_lanes(tape, y, &random);
    kg_tape_destroy(tape);
    free(x);
  }
}

static void normalize_of_zero_tiny_and_huge(void **state)
{
  (void)state;
  const double x[5][3] = {
    {0, 0, 0}, {3e-200, 0, 4e-200}, {3e200, 4e200, 0}, {0, 1e-320, 0}, {1, 2, 2}};
  const double w[15] = {1, 2, 3, 1, 2, 3, 1, 2, 3, 1, 2, 3, 1, 2, 3};
  double g[15], t[15];
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = kg_input(tape, KG_SHAPE(5, 3), &x[0][0]), y = kg_normalize(tape, a);
  const double expected[15] = {0, 0, 0, 0.6, 0, 0.8, 0.6, 0.8, 0, 0, 0, 0, 1 / 3., 2 / 3., 2 / 3.};
  assert_int_equal(kg_vjp(tape, 1, 1, &y, (const double *[]){w}, 1, &a, (double *[]){g}), KG_OK);
  assert_int_equal(kg_jvp(tape, 1, 1, &a, (const double *[]){w}, 1, &y, (double *[]){t}), KG_OK);
  for (size_t i = 0; i < 15; ++i) {
    assert_close(kg_item_at(tape, y, i), expected[i], 2e-16);
    assert_close(g[i], t[i], 0); /* the matrix is symmetric */
  }
  for (size_t i = 0; i < 3; ++i) {
    assert_close(g[i], 0, 0);
    assert_close(g[9 + i], 0, 0);
  }
  assert_close(g[4] / 1e200 * 5, 2 * 10 / 10., 1e-15); /* w - y (y w) = (-0.8, 2, 0.6), / 5e-200 */
  assert_close(g[3] / 1e200 * 5, (1 - 0.6 * 3) * 1., 1e-15);
  kg_random random = kg_random_make(8);
  check_lanes(tape, y, &random);
  kg_tape_destroy(tape);
}

/* An item without a derivative does not spoil a sweep that does not ask for it. */
static void a_zero_adjoint_stops(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const double v[6] = {INFINITY, NAN, 1, 1, 2, 3}, p[8] = {0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5};
  const double n[8] = {NAN, 1, INFINITY, 0, 0.5, 0.5, 0.5, 0.5};
  const kg_value a = kg_input(tape, KG_SHAPE(2, 3), v), q = kg_input(tape, KG_SHAPE(2, 4), p);
  const kg_value m = kg_input(tape, KG_SHAPE(2, 4), n);
  const kg_value y[] = {kg_cross(tape, a, a),     kg_rotate(tape, m, a),
                        kg_compose(tape, m, m),   kg_rotation_exp(tape, a),
                        kg_rotation_log(tape, q), kg_rotation_log(tape, m),
                        kg_normalize(tape, a),    kg_normalize(tape, m)};
  for (size_t c = 0; c < KG_COUNT_OF(y); ++c) {
    const kg_value inputs[3] = {a, q, m};
    double w[8] = {0}, d[3][8] = {{0}}, g[3][8], t[8];
    const size_t half = kg_size_of(tape, y[c]) / 2;
    for (size_t i = half; i < 2 * half; ++i) {
      w[i] = 1;
    }
    assert_int_equal(
      kg_vjp(tape, 1, 1, &y[c], (const double *[]){w}, 3, inputs, (double *[]){g[0], g[1], g[2]}),
      KG_OK);
    for (int k = 0; k < 3; ++k) { /* the second item alone */
      const size_t size = kg_size_of(tape, inputs[k]);
      for (size_t i = 0; i < size; ++i) {
        assert_true(isfinite(g[k][i]));
        if (i < size / 2) assert_close(g[k][i], 0, 0);
        d[k][i] = i < size / 2 ? 0 : 1;
      }
    }
    assert_int_equal(
      kg_jvp(tape, 1, 3, inputs, (const double *[]){d[0], d[1], d[2]}, 1, &y[c], (double *[]){t}),
      KG_OK);
    for (size_t i = 0; i < 2 * half; ++i) {
      assert_true(isfinite(t[i]));
      if (i < half) assert_close(t[i], 0, 0);
    }
  }
  assert_true(isnan(kg_item_at(tape, y[4], 0))); /* the zero quaternion is no rotation */
  kg_tape_destroy(tape);
}

/* all six, one after the other */
static kg_value chain(kg_tape *tape, kg_value r, kg_value v)
{
  const kg_value q = kg_rotation_exp(tape, r), p = kg_normalize(tape, kg_compose(tape, q, q));
  return kg_cross(tape, kg_rotate(tape, p, v), kg_rotation_log(tape, q));
}

static void precisions_and_instructions_agree(void **state)
{
  (void)state;
  enum { N = 3 * 1000 };
  static double x[2][N], value[5][N], gradient[5][2][N], w[N];
  kg_random random = kg_random_make(9);
  for (size_t i = 0; i < N; ++i) {
    x[0][i] = 0.7 * kg_random_normal(&random);
    x[1][i] = kg_random_normal(&random);
    w[i] = kg_random_normal(&random);
  }
  for (int c = 0; c < 5; ++c) {
    static const int simd[] = {0, 2, 3, 0, 3};
    kg_tape *tape = new_tape(c < 3 ? KG_DOUBLE : KG_FLOAT, simd[c]);
    const kg_value in[2] = {kg_input(tape, KG_SHAPE(N / 3, 3), x[0]),
                            kg_input(tape, KG_SHAPE(N / 3, 3), x[1])};
    const kg_value y = chain(tape, in[0], in[1]);
    assert_int_equal(kg_vjp(tape, 1, 1, &y, (const double *[]){w}, 2, in,
                            (double *[]){gradient[c][0], gradient[c][1]}),
                     KG_OK);
    for (size_t i = 0; i < N; ++i) {
      value[c][i] = kg_item_at(tape, y, i);
      if (c < 3) continue;
      assert_close(value[c][i], value[0][i], 1e-5);
      assert_close(gradient[c][0][i], gradient[0][0][i], 1e-4);
    }
    kg_tape_destroy(tape);
  }
  for (int c = 1; c < 5; ++c) {
    const int same = c < 3 ? 0 : 3;
    assert_memory_equal(value[c], value[same], sizeof value[0]);
    assert_memory_equal(gradient[c], gradient[same], sizeof gradient[0]);
  }
}

#define REFUSED(call, words)                                                                       \
  do {                                                                                             \
    assert_true(kg_is_null(call));                                                                 \
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);                                          \
    if (!strstr(kg_tape_error(tape)->text, words)) fail_msg("%s", kg_tape_error(tape)->text);      \
    kg_tape_rewind(tape, mark);                                                                    \
  } while (0)

static void what_does_not_fit_is_refused_in_words(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value s = kg_scalar(tape, 1), v = kg_input(tape, KG_SHAPE(2, 3), NULL);
  const kg_value q = kg_input(tape, KG_SHAPE(2, 4), NULL), one = kg_input(tape, KG_SHAPE(3), NULL);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  REFUSED(kg_cross(tape, v, q), "cross: shape (2, 4): the last axis must have 3 entries");
  REFUSED(kg_cross(tape, s, v), "cross: shape (): the last axis");
  REFUSED(kg_cross(tape, v, one), "cross: shapes (2, 3) and (3)");
  REFUSED(kg_compose(tape, q, v), "compose: shape (2, 3): the last axis must have 4 entries");
  REFUSED(kg_rotate(tape, v, q), "rotate: shape (2, 3): the last axis must have 4 entries");
  REFUSED(kg_rotate(tape, q, one), "rotate: shapes (2, 4) and (3)");
  REFUSED(kg_rotation_exp(tape, q), "rotation_exp: shape (2, 4)");
  REFUSED(kg_rotation_log(tape, v), "rotation_log: shape (2, 3)");
  REFUSED(kg_normalize(tape, s), "normalize: axis -1 of a tensor of shape ()");
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(products_equal_the_quaternion_algebra),
    cmocka_unit_test(an_operand_may_be_used_twice),
    cmocka_unit_test(exp_is_smooth_through_zero),
    cmocka_unit_test(exp_and_log_at_100_points),
    cmocka_unit_test(log_near_zero_near_pi_and_on_both_sheets),
    cmocka_unit_test(log_at_half_a_turn),
    cmocka_unit_test(normalize_divides_by_the_length),
    cmocka_unit_test(normalize_of_zero_tiny_and_huge),
    cmocka_unit_test(a_zero_adjoint_stops),
    cmocka_unit_test(precisions_and_instructions_agree),
    cmocka_unit_test(what_does_not_fit_is_refused_in_words),
  };
  return cmocka_run_group_tests_name("rotations", tests, NULL, NULL);
}
