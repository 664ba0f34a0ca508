/* Newton's method against roots known in closed form, and its behaviour where no root is reached. */
#include "support.h"

#include "kinegrad/newton.h"

/* Small systems G(x) = 0 in one struct: the scalar ones use x[0] only. */
typedef struct problem {
  int evaluations;
  double history[64]; /* |x - root| of the accepted points, scalar problems */
  double root;
  int steps;
} problem;

static kg_newton *make(int n, kg_newton_def *def)
{
  kg_newton *newton;
  if (!def) {
    kg_newton_def standard = kg_newton_default_def(n);
    assert_int_equal(kg_newton_create(&newton, &standard), KG_OK);
  } else {
    assert_int_equal(kg_newton_create(&newton, def), KG_OK);
  }
  return newton;
}

/* ---- circle meets hyperbola: x^2 + y^2 = 4, x y = 1 ---------------------------------------------*/

static bool circle_G(double *G, const double *x, void *user)
{
  (void)user;
  G[0] = x[0] * x[0] + x[1] * x[1] - 4.0;
  G[1] = x[0] * x[1] - 1.0;
  return true;
}

static bool circle_p(double *p, const double *x, const double *G, void *user)
{
  (void)user;
  const double det = 2.0 * (x[0] * x[0] - x[1] * x[1]);
  p[0] = -(x[0] * G[0] - 2.0 * x[1] * G[1]) / det;
  p[1] = -(-x[1] * G[0] + 2.0 * x[0] * G[1]) / det;
  return det != 0.0;
}

static void finds_the_root_of_a_pair_of_equations(void **state)
{
  (void)state;
  kg_newton *newton = make(2, NULL);
  double x[2] = {3.0, 0.1};
  const kg_newton_report report = kg_newton_solve(newton, x, NULL, circle_G, circle_p, NULL);
  assert_int_equal(report.stop, KG_NEWTON_CONVERGED);
  assert_at_most(report.residual, 1e-8);
  assert_in_range(report.iterations, 2, 8);
  /* x + y = sqrt(6), x - y = sqrt(2) */
  assert_close(x[0], 0.5 * (sqrt(6.0) + sqrt(2.0)), 1e-9);
  assert_close(x[1], 0.5 * (sqrt(6.0) - sqrt(2.0)), 1e-9);
  kg_newton_destroy(newton);
}

/* ---- cube root of 2: the error squares at every step --------------------------------------------*/

static bool cube_G(double *G, const double *x, void *user)
{
  (void)user;
  G[0] = x[0] * x[0] * x[0] - 2.0;
  return true;
}

static bool cube_p(double *p, const double *x, const double *G, void *user)
{
  problem *s = user;
  s->history[s->steps++] = fabs(x[0] - cbrt(2.0));
  p[0] = -G[0] / (3.0 * x[0] * x[0]);
  return true;
}

static void error_squares_near_the_root(void **state)
{
  (void)state;
  kg_newton_def def = kg_newton_default_def(1);
  def.tolerance = 1e-13;
  kg_newton *newton = make(1, &def);
  problem s = {0};
  double x = 2.0;
  const kg_newton_report report = kg_newton_solve(newton, &x, NULL, cube_G, cube_p, &s);
  assert_int_equal(report.stop, KG_NEWTON_CONVERGED);
  assert_int_equal(report.cuts, 0);
  assert_int_equal(report.iterations, s.steps);
  for (int k = 1; k < s.steps; k++) {
    /* e' -> e^2 G'' / (2 G') = e^2 / root */
    assert_at_most(s.history[k], 1.05 / cbrt(2.0) * s.history[k - 1] * s.history[k - 1] + 4e-16);
  }
  assert_true(s.steps >= 4);
  kg_newton_destroy(newton);
}

/* ---- arctangent: whole steps diverge from |x| > 1.3917, so the line search must work ------------*/

static bool atan_G(double *G, const double *x, void *user)
{
  ((problem *)user)->evaluations++;
  G[0] = atan(x[0]);
  return true;
}

static bool atan_p(double *p, const double *x, const double *G, void *user)
{
  (void)user;
  p[0] = -G[0] * (1.0 + x[0] * x[0]);
  return true;
}

static void line_search_saves_a_diverging_iteration(void **state)
{
  (void)state;
  kg_newton *newton = make(1, NULL);
  problem s = {0};
  double x = 30.0;
  const kg_newton_report report = kg_newton_solve(newton, &x, NULL, atan_G, atan_p, &s);
  assert_int_equal(report.stop, KG_NEWTON_CONVERGED);
  assert_true(report.cuts > 0);
  assert_int_equal(report.evaluations, s.evaluations);
  assert_int_equal(report.evaluations, 1 + report.iterations + report.cuts);
  assert_at_most(fabs(x), 1e-8);
  kg_newton_destroy(newton);

  kg_newton_def def = kg_newton_default_def(1);
  def.max_halvings = 0; /* whole steps only: the iteration must stop, and x stay */
  newton = make(1, &def);
  x = 30.0;
  const kg_newton_report plain = kg_newton_solve(newton, &x, NULL, atan_G, atan_p, &s);
  assert_int_equal(plain.stop, KG_NEWTON_STALLED);
  assert_int_equal(plain.iterations, 0);
  assert_true(x == 30.0);
  assert_close(plain.residual, atan(30.0), 1e-15);
  kg_newton_destroy(newton);
}

/* ---- log x = -2, undefined for x <= 0 -----------------------------------------------------------*/

static bool log_G(double *G, const double *x, void *user)
{
  const bool say_so = *(const bool *)user;
  if (say_so && !(x[0] > 0.0)) return false;
  G[0] = log(x[0]) + 2.0; /* NaN or -infinity where it is undefined */
  return true;
}

static bool log_p(double *p, const double *x, const double *G, void *user)
{
  (void)user;
  p[0] = -G[0] * x[0];
  return true;
}

static void steps_back_where_the_residual_is_undefined(void **state)
{
  (void)state;
  kg_newton *newton = make(1, NULL);
  for (int say_so = 0; say_so < 2; say_so++) { /* by returning false; by a value that is NaN */
    bool user = say_so == 1;
    double x = 3.0; /* the first whole step goes to 3 (1 - log 3 - 2) < 0 */
    const kg_newton_report report = kg_newton_solve(newton, &x, NULL, log_G, log_p, &user);
    assert_int_equal(report.stop, KG_NEWTON_CONVERGED);
    assert_true(report.cuts > 0);
    assert_close(x, exp(-2.0), 1e-9);

    x = -1.0;
    const kg_newton_report bad = kg_newton_solve(newton, &x, NULL, log_G, log_p, &user);
    assert_int_equal(bad.stop, KG_NEWTON_UNDEFINED);
    assert_int_equal(bad.iterations, 0);
    assert_true(x == -1.0);
  }
  kg_newton_destroy(newton);
}

/* ---- ends that are not a root -------------------------------------------------------------------*/

static bool parabola_G(double *G, const double *x, void *user)
{
  G[0] = x[0] * x[0] + *(const double *)user;
  return true;
}

static bool parabola_p(double *p, const double *x, const double *G, void *user)
{
  (void)user;
  p[0] = -G[0] / (2.0 * x[0]);
  return x[0] != 0.0;
}

static bool nan_p(double *p, const double *x, const double *G, void *user)
{
  (void)x, (void)G, (void)user;
  p[0] = NAN;
  return true;
}

static bool creeping_p(double *p, const double *x, const double *G, void *user)
{
  (void)user;
  p[0] = -1e-3 * G[0] / (2.0 * x[0]);
  return true;
}

static void says_why_it_stopped(void **state)
{
  (void)state;
  kg_newton *newton = make(1, NULL);
  double one = 1.0, minus_four = -4.0;

  double x = 0.7; /* x^2 + 1 has no root: the best point is near its minimum, 1 */
  kg_newton_report report = kg_newton_solve(newton, &x, NULL, parabola_G, parabola_p, &one);
  assert_true(report.stop == KG_NEWTON_STALLED || report.stop == KG_NEWTON_SINGULAR);
  assert_at_most(report.residual, 1.49);
  assert_close(report.residual, x * x + 1.0, 1e-15);

  x = 0.0;
  report = kg_newton_solve(newton, &x, NULL, parabola_G, parabola_p, &one);
  assert_int_equal(report.stop, KG_NEWTON_SINGULAR);
  report = kg_newton_solve(newton, &x, NULL, parabola_G, nan_p, &one);
  assert_int_equal(report.stop, KG_NEWTON_SINGULAR);
  assert_true(x == 0.0);

  x = 2.0; /* at the root: no step, no direction */
  report = kg_newton_solve(newton, &x, NULL, parabola_G, nan_p, &minus_four);
  assert_int_equal(report.stop, KG_NEWTON_CONVERGED);
  assert_int_equal(report.iterations, 0);
  kg_newton_destroy(newton);

  kg_newton_def def = kg_newton_default_def(1);
  def.max_iterations = 3;
  newton = make(1, &def);
  x = 1000.0;
  report = kg_newton_solve(newton, &x, NULL, parabola_G, parabola_p, &minus_four);
  assert_int_equal(report.stop, KG_NEWTON_MAX_ITERATIONS);
  assert_int_equal(report.iterations, 3);
  kg_newton_destroy(newton);

  def = kg_newton_default_def(1);
  def.stall_ratio = 0.99; /* each step leaves 99.9 % of the residual */
  newton = make(1, &def);
  x = 3.0;
  report = kg_newton_solve(newton, &x, NULL, parabola_G, creeping_p, &minus_four);
  assert_int_equal(report.stop, KG_NEWTON_STALLED);
  assert_int_equal(report.iterations, 2);
  assert_at_most(report.residual, 5.0 * 0.999);
  kg_newton_destroy(newton);
}

/* ---- scaling ------------------------------------------------------------------------------------*/

static void scale_enters_the_merit(void **state)
{
  (void)state;
  kg_newton_def def = kg_newton_default_def(2);
  def.max_iterations = 0;
  kg_newton *newton = make(2, &def);
  const double scale[2] = {3.0, 0.5};
  double x[2] = {1.0, 3.0}; /* G = (6, 2) */
  const kg_newton_report report = kg_newton_solve(newton, x, scale, circle_G, circle_p, NULL);
  assert_int_equal(report.stop, KG_NEWTON_MAX_ITERATIONS);
  assert_close(report.residual, hypot(18.0, 1.0), 1e-15);
  kg_newton_destroy(newton);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_newton_def def = kg_newton_default_def(1000);
  int allowed = 0;
  for (bool done = false; !done; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    def.allocator = &allocator;
    kg_newton *newton;
    const kg_status status = kg_newton_create(&newton, &def);
    done = status == KG_OK;
    assert_true(done ? newton != NULL : (newton == NULL && status == KG_ERR_NO_MEMORY));
    kg_newton_destroy(newton);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(allowed > 1);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(finds_the_root_of_a_pair_of_equations),
    cmocka_unit_test(error_squares_near_the_root),
    cmocka_unit_test(line_search_saves_a_diverging_iteration),
    cmocka_unit_test(steps_back_where_the_residual_is_undefined),
    cmocka_unit_test(says_why_it_stopped),
    cmocka_unit_test(scale_enters_the_merit),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("newton", tests, NULL, NULL);
}
