/* The smoother over time against a dense solve of the matrix its header defines. */
#include "support.h"

#include "kinegrad/arena.h"
#include "kinegrad/dense.h"
#include "pipeline/pipeline.h"

enum { LARGEST = 60 };

/* A = I + diag(weight) + tau4 D2'D2, row by row of D2 */
static void dense_matrix(double *A, int n, const double *weight, double tau4)
{
  memset(A, 0, (size_t)(n * n) * sizeof *A);
  for (int t = 0; t < n; t++) {
    A[t * n + t] = 1.0 + (weight ? weight[t] : 0.0);
  }
  const double row[3] = {1.0, -2.0, 1.0};
  for (int t = 1; t + 1 < n; t++) {
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) {
        A[(t - 1 + i) * n + t - 1 + j] += tau4 * row[i] * row[j];
      }
    }
  }
}

static void compare(int n, const double *weight, double tau4, kg_random *random)
{
  enum { STRIDE = 3 };
  double A[LARGEST * LARGEST], x[LARGEST], y[STRIDE * LARGEST], before[STRIDE * LARGEST];
  int pivots[LARGEST];
  for (int i = 0; i < STRIDE * n; i++) {
    before[i] = y[i] = kg_random_normal(random);
  }
  for (int t = 0; t < n; t++) {
    x[t] = y[STRIDE * t + 1];
  }
  dense_matrix(A, n, weight, tau4);
  assert_true(kg_dense_lu_factor(A, pivots, n));
  kg_dense_lu_solve(A, pivots, n, x, 1);

  kg_arena arena;
  kg_arena_init(&arena, NULL);
  kg_smoother smoother;
  kg_smoother_create(&smoother, n, &arena);
  assert_false(kg_arena_failed(&arena));
  kg_smoother_factor(&smoother, weight, tau4);
  kg_smoother_solve(&smoother, y + 1, STRIDE);
  /* the condition of A is about 1 + 16 tau4: what rounding may do */
  const double tolerance = 1e-13 + 1e-15 * tau4;
  for (int t = 0; t < n; t++) {
    assert_close(y[STRIDE * t + 1], x[t], tolerance);
    assert_true(y[STRIDE * t] == before[STRIDE * t]); /* the neighbours are others' */
    assert_true(y[STRIDE * t + 2] == before[STRIDE * t + 2]);
  }
  kg_arena_release(&arena);
}

static void equals_the_dense_solve(void **state)
{
  (void)state;
  kg_random random = kg_random_make(11);
  const double stiffness[] = {0.0, 1e-3, 1.0, 50.0, 2e4};
  const int sizes[] = {1, 2, 3, 4, 5, 6, 17, LARGEST};
  double weight[LARGEST];
  for (size_t i = 0; i < KG_COUNT_OF(sizes); i++) {
    for (size_t k = 0; k < KG_COUNT_OF(stiffness); k++) {
      compare(sizes[i], NULL, stiffness[k], &random);
      for (int t = 0; t < sizes[i]; t++) { /* some frames held, others free */
        weight[t] = t % 3 == 0 ? 0.0 : exp(3.0 * kg_random_normal(&random));
      }
      compare(sizes[i], weight, stiffness[k], &random);
    }
  }
}

/* The header's promise: a jump is rounded over tau. Half of the rise of a step happens within a
 * window of tau around it, and a line is not bent. */
static void a_jump_is_rounded_over_tau(void **state)
{
  (void)state;
  enum { N = 400, TAU = 10 };
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  kg_smoother smoother;
  kg_smoother_create(&smoother, N, &arena);
  kg_smoother_factor(&smoother, NULL, pow(TAU, 4.0));
  double y[N];
  for (int t = 0; t < N; t++) {
    y[t] = t < N / 2 ? 0.0 : 1.0;
  }
  kg_smoother_solve(&smoother, y, 1);
  const double rise = y[N / 2 + TAU / 2] - y[N / 2 - TAU / 2];
  assert_true(rise > 0.25 && rise < 0.75);
  assert_close(y[N / 2 - 1] + y[N / 2], 1.0, 1e-9);
  assert_at_most(fabs(y[N / 4]), 1e-3); /* ten tau away: exp(-10 / sqrt 2) */
  for (int t = 0; t < N; t++) {
    y[t] = 0.3 - 0.01 * t;
  }
  kg_smoother_solve(&smoother, y, 1);
  for (int t = 0; t < N; t++) {
    assert_close(y[t], 0.3 - 0.01 * t, 1e-10);
  }
  kg_arena_release(&arena);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(equals_the_dense_solve),
    cmocka_unit_test(a_jump_is_rounded_over_tau),
  };
  return cmocka_run_group_tests_name("smoother", tests, NULL, NULL);
}
