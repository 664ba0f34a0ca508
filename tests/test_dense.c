/* Dense solvers against systems worked out by hand, and Ceres against known minima. */
#include "support.h"

#include <fcntl.h>
#include <stdio.h>
#include <sys/stat.h>
#include <unistd.h>

#include "kinegrad/ceres.h"
#include "kinegrad/dense.h"

/* ---- LAPACK --------------------------------------------------------------------------------------*/

static void lu_solves_a_system_worked_by_hand(void **state)
{
  (void)state;
  /* zero first pivot, not symmetric: rows must be exchanged and A must not be taken for A' */
  double A[9] = {0, 2, 1, 1, -2, -3, -1, 1, 2};
  int pivots[3];
  assert_true(kg_dense_lu_factor(A, pivots, 3));
  /* A (1, 2, 3)' = (7, -12, 7)'   A (-1, 0, 2)' = (2, -7, 5)'   A' (1, 2, 3)' = (-1, 1, 1)' */
  double b[6] = {7, -12, 7, 2, -7, 5};
  kg_dense_lu_solve(A, pivots, 3, b, 2);
  const double expected[6] = {1, 2, 3, -1, 0, 2};
  for (int i = 0; i < 6; i++) {
    assert_close(b[i], expected[i], 1e-14);
  }
  double c[3] = {-1, 1, 1};
  kg_dense_lu_solve_transposed(A, pivots, 3, c, 1);
  for (int i = 0; i < 3; i++) {
    assert_close(c[i], i + 1.0, 1e-14);
  }
}

static void singular_matrices_are_reported(void **state)
{
  (void)state;
  int pivots[2];
  double singular[4] = {1, 2, 2, 4}, undefined[4] = {1, NAN, 2, 4};
  assert_false(kg_dense_lu_factor(singular, pivots, 2));
  assert_false(kg_dense_lu_factor(undefined, pivots, 2));
  double indefinite[4] = {1, 2, 2, 1}, no_number[4] = {NAN, 0, 0, 1};
  assert_false(kg_dense_cholesky_factor(indefinite, 2));
  assert_false(kg_dense_cholesky_factor(no_number, 2));
}

static void cholesky_reads_the_lower_triangle_only(void **state)
{
  (void)state;
  /* L = [2 0 0; 1 3 0; -1 2 1], A = L L' = [4 2 -2; 2 10 5; -2 5 6] */
  double A[9] = {4, 777, NAN, 2, 10, 888, -2, 5, 6};
  assert_true(kg_dense_cholesky_factor(A, 3));
  const double L[9] = {2, 777, NAN, 1, 3, 888, -1, 2, 1};
  for (int i = 0; i < 9; i++) {
    assert_true(i == 2 ? isnan(A[i]) : fabs(A[i] - L[i]) < 1e-14);
  }
  double b[3] = {4 + 4 - 6, 2 + 20 + 15, -2 + 10 + 18}; /* A (1, 2, 3)' */
  kg_dense_cholesky_solve(A, 3, b, 1);
  for (int i = 0; i < 3; i++) {
    assert_close(b[i], i + 1.0, 1e-14);
  }
}

/* ---- Ceres ---------------------------------------------------------------------------------------*/

static bool rosenbrock_r(double *r, const double *x, void *user)
{
  (void)user;
  r[0] = 10.0 * (x[1] - x[0] * x[0]);
  r[1] = 1.0 - x[0];
  return true;
}

static bool rosenbrock_J(double *J, const double *x, void *user)
{
  ++*(int *)user;
  J[0] = -20.0 * x[0];
  J[1] = 10.0;
  J[2] = -1.0;
  J[3] = 0.0;
  return true;
}

static void finds_the_minimum_with_and_without_a_jacobian(void **state)
{
  (void)state;
  for (int own = 0; own < 2; own++) {
    int calls = 0;
    kg_ceres_def def = kg_ceres_default_def(2, 2);
    def.residual = rosenbrock_r;
    def.jacobian = own ? rosenbrock_J : NULL;
    def.user = &calls;
    double x[2] = {-1.2, 1.0};
    kg_ceres_report report;
    assert_int_equal(kg_ceres_minimize(&def, x, &report), KG_OK);
    assert_true(report.converged);
    assert_close(report.cost_before, 0.5 * (4.4 * 4.4 + 2.2 * 2.2), 1e-14);
    assert_at_most(report.cost, 1e-20);
    assert_close(x[0], 1.0, 1e-9);
    assert_close(x[1], 1.0, 1e-9);
    assert_int_equal(calls > 0, own);
    assert_true(strlen(report.text) > 0);
  }
}

static void bounds_hold_at_the_minimum(void **state)
{
  (void)state;
  kg_ceres_def def = kg_ceres_default_def(2, 2);
  def.residual = rosenbrock_r;
  const double lower[2] = {1.5, -INFINITY}, upper[2] = {INFINITY, 2.0};
  def.lower = lower;
  def.upper = upper;
  double x[2] = {-1.2, 1.0}; /* outside: moved to the bound first */
  kg_ceres_report report;
  assert_int_equal(kg_ceres_minimize(&def, x, &report), KG_OK);
  /* x = 1.5 and y = 2 are both active: the cost falls towards y = 2.25 and towards x = 1 */
  assert_close(x[0], 1.5, 1e-9);
  assert_close(x[1], 2.0, 1e-9);
}

static bool sometimes_nan_r(double *r, const double *x, void *user)
{
  r[0] = log(x[0]) + 2.0; /* NaN left of zero */
  return *(const bool *)user || x[0] > 0.0;
}

/* Everything that reaches descriptor fd while it is redirected to a file. */
static int redirect(int fd, const char *path)
{
  fflush(NULL);
  const int saved = dup(fd);
  const int file = open(path, O_CREAT | O_TRUNC | O_WRONLY, 0600);
  assert_true(saved >= 0 && file >= 0);
  assert_true(dup2(file, fd) >= 0);
  close(file);
  return saved;
}

static void nothing_is_printed_even_when_it_fails(void **state)
{
  (void)state;
  const char *paths[2] = {KG_TEST_SCRATCH "/ceres_stdout.txt", KG_TEST_SCRATCH "/ceres_stderr.txt"};
  const int saved[2] = {redirect(STDOUT_FILENO, paths[0]), redirect(STDERR_FILENO, paths[1])};
  kg_status statuses[4];
  double roots[2];
  for (int quiet = 0; quiet < 2; quiet++) {
    bool user = quiet == 1;
    kg_ceres_def def = kg_ceres_default_def(1, 1);
    def.residual = sometimes_nan_r;
    def.user = &user;
    kg_ceres_report report;
    double x = -1.0;
    statuses[2 * quiet] = kg_ceres_minimize(&def, &x, &report);
    roots[quiet] = 30.0;
    statuses[2 * quiet + 1] = kg_ceres_minimize(&def, &roots[quiet], &report);
  }
  fflush(NULL);
  for (int k = 0; k < 2; k++) {
    dup2(saved[k], k == 0 ? STDOUT_FILENO : STDERR_FILENO);
    close(saved[k]);
  }
  for (int k = 0; k < 2; k++) {
    struct stat file;
    assert_int_equal(stat(paths[k], &file), 0);
    assert_int_equal(file.st_size, 0);
    assert_int_equal(statuses[2 * k], KG_ERR_UNDEFINED);
    assert_int_equal(statuses[2 * k + 1], KG_OK);
    assert_close(roots[k], exp(-2.0), 1e-8);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(lu_solves_a_system_worked_by_hand),
    cmocka_unit_test(singular_matrices_are_reported),
    cmocka_unit_test(cholesky_reads_the_lower_triangle_only),
    cmocka_unit_test(finds_the_minimum_with_and_without_a_jacobian),
    cmocka_unit_test(bounds_hold_at_the_minimum),
    cmocka_unit_test(nothing_is_printed_even_when_it_fails),
  };
  return cmocka_run_group_tests_name("dense", tests, NULL, NULL);
}
