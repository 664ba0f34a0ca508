/* Dense solvers against systems worked out by hand, and Ceres against known minima. */
#include "support.h"

#include <fcntl.h>
#include <pthread.h>
#include <stdio.h>
#include <sys/stat.h>
#include <unistd.h>

#include "kinegrad/ceres.h"
#include "kinegrad/dense.h"
#include "solver/least_move.h"

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

enum { SIDE = 72, ROUNDS = 4000, THREADS = 3 };

/* A positive definite matrix with its Cholesky factor, LU factor and a solution of each. */
typedef struct solved {
  double L[SIDE * SIDE], LU[SIDE * SIDE], x[SIDE], y[SIDE];
} solved;

static void solve_both(solved *s)
{
  int pivots[SIDE];
  for (int i = 0; i < SIDE; i++) {
    for (int j = 0; j < SIDE; j++) {
      s->L[i * SIDE + j] = cos(0.7 * (i - j)) / (1 + abs(i - j)) + (i == j ? SIDE : 0);
    }
    s->x[i] = s->y[i] = sin(i + 1.0);
  }
  memcpy(s->LU, s->L, sizeof s->LU);
  const bool good = kg_dense_cholesky_factor(s->L, SIDE) && kg_dense_lu_factor(s->LU, pivots, SIDE);
  if (!good) {
    memset(s, 0, sizeof *s);
    return;
  }
  kg_dense_cholesky_solve(s->L, SIDE, s->x, 1);
  kg_dense_lu_solve(s->LU, pivots, SIDE, s->y, 1);
}

typedef struct solver_thread {
  pthread_t thread;
  const solved *expected;
  solved own;
  int wrong;
} solver_thread;

static void *solve_again_and_again(void *user)
{
  solver_thread *t = user;
  for (int k = 0; k < ROUNDS; k++) {
    solve_both(&t->own);
    t->wrong += memcmp(&t->own, t->expected, sizeof t->own) != 0;
  }
  return NULL;
}

/* OpenBLAS' serial build alone does not do that */
static void threads_get_the_same_bits(void **state)
{
  (void)state;
  static solved expected;
  static solver_thread threads[THREADS];
  solve_both(&expected);
  assert_close(expected.x[0], expected.y[0], 1e-14);
  assert_true(expected.x[0] != 0.0);
  for (int i = 0; i < THREADS; i++) {
    threads[i].expected = &expected;
    assert_int_equal(pthread_create(&threads[i].thread, NULL, solve_again_and_again, &threads[i]),
                     0);
  }
  for (int i = 0; i < THREADS; i++) {
    pthread_join(threads[i].thread, NULL);
  }
  for (int i = 0; i < THREADS; i++) {
    assert_int_equal(threads[i].wrong, 0);
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

/* ---- least move under inequalities ---------------------------------------------------------------*/

enum { MOVE_N = 12, MOVE_ROWS = 60 };

static double row_dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++) {
    sum += a[i] * b[i];
  }
  return sum;
}

/* The conditions of optimality are sufficient, for M is positive definite: they are the answer. */
static void least_move_satisfies_the_conditions_of_optimality(void **state)
{
  (void)state;
  kg_random random = kg_random_make(31);
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  least_move work;
  least_move_init(&work, MOVE_N, MOVE_ROWS, &arena);
  assert_false(kg_arena_failed(&arena));
  int active_rows = 0;
  for (int problem = 0; problem < 300; problem++) {
    double B[MOVE_N * MOVE_N], M[MOVE_N * MOVE_N], L[MOVE_N * MOVE_N];
    double G[MOVE_ROWS * MOVE_N], b[MOVE_ROWS], x[MOVE_N], lambda[MOVE_ROWS], inside[MOVE_N];
    for (int i = 0; i < MOVE_N * MOVE_N; i++) {
      B[i] = kg_random_normal(&random);
    }
    for (int i = 0; i < MOVE_N; i++) {
      inside[i] = kg_random_normal(&random);
      for (int j = 0; j < MOVE_N; j++) {
        M[i * MOVE_N + j] = row_dot(B + i * MOVE_N, B + j * MOVE_N, MOVE_N) + (i == j ? 0.1 : 0.0);
      }
    }
    memcpy(L, M, sizeof L);
    assert_true(kg_dense_cholesky_factor(L, MOVE_N));
    for (int r = 0; r < MOVE_ROWS; r++) {
      for (int i = 0; i < MOVE_N; i++) { /* every third row repeats another one, scaled */
        G[r * MOVE_N + i] = r % 3 == 2 ? 2.0 * G[(r - 1) * MOVE_N + i] : kg_random_normal(&random);
      }
      b[r] = row_dot(G + r * MOVE_N, inside, MOVE_N) - 0.5 * kg_random_uniform(&random);
    }
    assert_true(least_move_solve(&work, L, G, b, MOVE_ROWS, 1e-9, x, lambda));
    for (int i = 0; i < MOVE_N; i++) { /* M x = G' lambda */
      double force = 0.0;
      for (int r = 0; r < MOVE_ROWS; r++) {
        force += G[r * MOVE_N + i] * lambda[r];
      }
      assert_close(row_dot(M + i * MOVE_N, x, MOVE_N), force, 1e-6);
    }
    for (int r = 0; r < MOVE_ROWS; r++) {
      const double slack = row_dot(G + r * MOVE_N, x, MOVE_N) - b[r];
      assert_true(lambda[r] >= 0.0);
      assert_at_most(-slack, 1e-8);
      assert_true(lambda[r] == 0.0 || fabs(slack) < 1e-7);
      active_rows += lambda[r] > 0.0;
    }
  }
  assert_true(active_rows > 300);
  kg_arena_release(&arena);
}

static void contradicting_rows_are_reported(void **state)
{
  (void)state;
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  least_move work;
  least_move_init(&work, 2, 2, &arena);
  const double L[4] = {1, 0, 0, 1}, G[4] = {1, 0, -1, 0}, b[2] = {1, 1}; /* x >= 1 and x <= -1 */
  double x[2], lambda[2];
  assert_false(least_move_solve(&work, L, G, b, 2, 1e-9, x, lambda));
  assert_true(isfinite(x[0]) && isfinite(x[1]));
  kg_arena_release(&arena);
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
    cmocka_unit_test(threads_get_the_same_bits),
    cmocka_unit_test(singular_matrices_are_reported),
    cmocka_unit_test(cholesky_reads_the_lower_triangle_only),
    cmocka_unit_test(least_move_satisfies_the_conditions_of_optimality),
    cmocka_unit_test(contradicting_rows_are_reported),
    cmocka_unit_test(finds_the_minimum_with_and_without_a_jacobian),
    cmocka_unit_test(bounds_hold_at_the_minimum),
    cmocka_unit_test(nothing_is_printed_even_when_it_fails),
  };
  return cmocka_run_group_tests_name("dense", tests, NULL, NULL);
}
