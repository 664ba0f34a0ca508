/* The plain objectives that gradients are timed against: published values, independent evaluation,
 * derivatives by differences and complex steps; and the readers of their data files. */
#include "support.h"

#include <stdio.h>
#include <unistd.h>

#include "bench/autodiff/problems.h"

#define ADBENCH KG_TEST_SHARED "/adbench/"

static bool has_file(const char *path)
{
  if (access(path, R_OK) == 0) {
    return true;
  }
  print_message("skipped: %s is not there\n", path);
  return false;
}

static double *numbers_of(size_t count)
{
  double *values = calloc(count, sizeof *values);
  assert_non_null(values);
  return values;
}

/* ---- Gaussian mixture ------------------------------------------------------------------------ */

static double value_of(const kg_bench_gmm *gmm)
{
  double *work = numbers_of(kg_bench_gmm_work(gmm));
  const double value = kg_bench_gmm_value(gmm, gmm->theta, work);
  free(work);
  return value;
}

static void gmm_values_are_the_published_ones(void **state)
{
  (void)state;
  static const struct {
    const char *path;
    double value;
  } files[] = {{ADBENCH "gmm_d2_K5.txt", -5240.590562549577},
               {ADBENCH "gmm_d10_K25.txt", -25649.6526211973},
               {ADBENCH "gmm_d20_K50.txt", -65629.50687126734},
               {ADBENCH "gmm_d32_K25.txt", -225816.3101841442}};
  for (size_t i = 0; i < KG_COUNT_OF(files); i++) {
    if (!has_file(files[i].path)) {
      continue;
    }
    kg_bench_gmm *gmm = NULL;
    kg_error error = {0};
    assert_int_equal(kg_bench_gmm_read(&gmm, files[i].path, &error), KG_OK);
    assert_int_equal(gmm->m, 0);
    assert_close(gmm->gamma, 1.0, 0.0);
    assert_close(value_of(gmm), files[i].value, 1e-14);
    kg_bench_gmm_destroy(gmm);
  }
}

/* the mixture of tests/data/bench/gmm_prior.py */
static kg_bench_gmm *small_mixture(void)
{
  kg_bench_gmm *gmm = NULL;
  assert_int_equal(kg_bench_gmm_synthetic(&gmm, 3, 2, 4, 1), KG_OK);
  assert_int_equal(gmm->parameter_count, 2 * (1 + 3 + 6));
  gmm->gamma = 0.7;
  gmm->m = 2;
  double *mu = gmm->theta + 2, *icf = mu + 6;
  for (int k = 0; k < 2; k++) {
    gmm->theta[k] = (k + 1) / 8.0;
    for (int j = 0; j < 3; j++) {
      mu[3 * k + j] = (5 * k + 3 * j) % 7 / 4.0 - 0.5;
    }
    for (int j = 0; j < 6; j++) {
      icf[6 * k + j] = (3 * k + 5 * j) % 11 / 16.0 - 0.25;
    }
  }
  for (int i = 0; i < 4; i++) {
    for (int j = 0; j < 3; j++) {
      gmm->x[3 * i + j] = (7 * i + 2 * j) % 9 / 4.0 - 1.0;
    }
  }
  return gmm;
}

static void gmm_prior_holds_for_other_m_and_gamma(void **state)
{
  (void)state;
  kg_bench_gmm *gmm = small_mixture();
  assert_close(value_of(gmm), 16.025414578754351065, 1e-15); /* python3 gmm_prior.py */
  kg_bench_gmm_destroy(gmm);
}

/* fourth-order central difference along coordinate j */
static double difference(const kg_bench_gmm *gmm, double *theta, int j, double *work)
{
  static const double weight[4] = {1.0 / 12.0, -8.0 / 12.0, 8.0 / 12.0, -1.0 / 12.0};
  static const int steps[4] = {-2, -1, 1, 2};
  const double h = 3e-4, at = theta[j]; /* near eps^(1/5): balances h^4 and rounding */
  double sum = 0.0;
  for (int s = 0; s < 4; s++) {
    theta[j] = at + steps[s] * h;
    sum += weight[s] * kg_bench_gmm_value(gmm, theta, work) / h;
  }
  theta[j] = at;
  return sum;
}

static void gmm_gradient_is_the_derivative_of_the_value(void **state)
{
  (void)state;
  kg_bench_gmm *gmm = NULL;
  assert_int_equal(kg_bench_gmm_synthetic(&gmm, 4, 3, 50, 5), KG_OK);
  gmm->gamma = 0.7;
  gmm->m = 2;
  double *work = numbers_of(kg_bench_gmm_work(gmm));
  double *gradient = numbers_of((size_t)gmm->parameter_count);
  const double value = kg_bench_gmm_gradient(gmm, gmm->theta, gradient, work);
  assert_close(value, value_of(gmm), 1e-15);
  for (int j = 0; j < gmm->parameter_count; j++) {
    assert_close(gradient[j], difference(gmm, gmm->theta, j, work), 1e-8);
  }
  free(gradient);
  free(work);
  kg_bench_gmm_destroy(gmm);
}

/* ---- bundle adjustment ----------------------------------------------------------------------- */

static kg_bench_ba *perturbed(int n, int m, int p)
{
  kg_bench_ba *ba = NULL;
  assert_int_equal(kg_bench_ba_synthetic(&ba, n, m, p), KG_OK);
  kg_bench_ba_perturb(ba, 3);
  return ba;
}

static void ba_residuals_equal_an_independent_evaluation(void **state)
{
  (void)state;
  kg_bench_ba *ba = perturbed(7, 30, 110);
  double *plain = numbers_of(330), *independent = numbers_of(330);
  kg_bench_ba_residuals(ba, ba->theta, plain);
  kg_bench_ba_reference(ba, ba->theta, independent, NULL, NULL);
  double half_square = 0.0;
  for (int i = 0; i < 330; i++) {
    assert_close(plain[i], independent[i], 1e-12);
    half_square += 0.5 * independent[i] * independent[i];
  }
  assert_close(kg_bench_ba_loss(ba, ba->theta), half_square, 1e-12);
  free(independent);
  free(plain);
  kg_bench_ba_destroy(ba);
}

static void ba_without_rotation_is_a_pinhole_camera(void **state)
{
  (void)state;
  kg_bench_ba *ba = NULL;
  assert_int_equal(kg_bench_ba_synthetic(&ba, 1, 1, 1), KG_OK);
  /* r = 0, C = 0, f = 2, x0 = (1, -1), k = (0.5, 0.25); X = (2, 4, 4): u = (1/2, 1), |u|^2 = 5/4 */
  const double theta[15] = {0, 0, 0, 0, 0, 0, 2, 1, -1, 0.5, 0.25, 2, 4, 4, 3};
  memcpy(ba->theta, theta, sizeof theta);
  ba->feature[0] = 0.5, ba->feature[1] = 0.25;
  const double d = 1.0 + 0.5 * 1.25 + 0.25 * 1.25 * 1.25;
  double plain[3], independent[3];
  kg_bench_ba_residuals(ba, ba->theta, plain);
  kg_bench_ba_reference(ba, ba->theta, independent, NULL, NULL);
  const double expected[3] = {3.0 * (d + 1.0 - 0.5), 3.0 * (2.0 * d - 1.0 - 0.25), -8.0};
  for (int i = 0; i < 3; i++) {
    assert_close(plain[i], expected[i], 1e-15);
    assert_close(independent[i], expected[i], 1e-15);
  }
  /* where the feature is met, what is left of the loss is 1/2 (1 - w^2)^2 */
  ba->feature[0] = d + 1.0, ba->feature[1] = 2.0 * d - 1.0;
  double gradient[15];
  kg_bench_ba_reference(ba, ba->theta, NULL, NULL, gradient);
  assert_close(gradient[14], -2.0 * 3.0 * (1.0 - 9.0), 1e-14);
  assert_close(kg_bench_ba_loss(ba, ba->theta), 32.0, 1e-14);
  kg_bench_ba_destroy(ba);
}

static void every_number_of_perturbed_data_is_different(void **state)
{
  (void)state;
  kg_bench_ba *ba = perturbed(5, 9, 20), *same = perturbed(5, 9, 20);
  for (int i = 0; i < ba->parameter_count; i++) {
    assert_true(ba->theta[i] == same->theta[i]);
    for (int j = 0; j < i; j++) {
      assert_true(ba->theta[i] != ba->theta[j]);
    }
  }
  assert_true(ba->feature[0] != ba->feature[2]);
  kg_bench_ba_destroy(same);
  kg_bench_ba_destroy(ba);
}

static void ba_reference_derivatives_agree_with_differences(void **state)
{
  (void)state;
  kg_bench_ba *ba = perturbed(2, 3, 6);
  double *up = numbers_of(18), *down = numbers_of(18), *jacobian = numbers_of(6 * 31);
  double *gradient = numbers_of((size_t)ba->parameter_count), *theta = ba->theta;
  kg_bench_ba_reference(ba, theta, NULL, jacobian, gradient);
  for (int j = 0; j < ba->parameter_count; j++) {
    const double at = theta[j], h = 1e-5 * fmax(fabs(at), 1e-2);
    theta[j] = at + h;
    kg_bench_ba_residuals(ba, theta, up);
    const double loss_up = kg_bench_ba_loss(ba, theta);
    theta[j] = at - h;
    kg_bench_ba_residuals(ba, theta, down);
    assert_close(gradient[j], (loss_up - kg_bench_ba_loss(ba, theta)) / (2.0 * h), 2e-4);
    theta[j] = at;
    for (int i = 0; i < 6; i++) { /* the entry of the block, or zero */
      const int camera = j - 11 * ba->camera[i], point = j - 22 - 3 * ba->point[i];
      int column = camera >= 0 && camera < 11 && j < 22 ? camera : -1;
      column = j >= 22 && j < 31 && point >= 0 && point < 3 ? 11 + point : column;
      column = j == 31 + i ? 14 : column;
      for (int row = 0; row < 2; row++) {
        const double entry = column < 0 ? 0.0 : jacobian[30 * i + 15 * row + column];
        assert_close(entry, (up[2 * i + row] - down[2 * i + row]) / (2.0 * h), 2e-5);
      }
      const double weight_entry = j == 31 + i ? jacobian[180 + i] : 0.0;
      assert_close(weight_entry, (up[12 + i] - down[12 + i]) / (2.0 * h), 1e-8);
    }
  }
  free(gradient);
  free(jacobian);
  free(down);
  free(up);
  kg_bench_ba_destroy(ba);
}

/* ---- readers --------------------------------------------------------------------------------- */

static const char *write_text(const char *text)
{
  static const char path[] = KG_TEST_SCRATCH "/test_bench_objectives.txt";
  FILE *file = fopen(path, "w");
  assert_non_null(file);
  fputs(text, file);
  assert_int_equal(fclose(file), 0);
  return path;
}

static void ba_file_gives_sizes_and_the_one_observation(void **state)
{
  (void)state;
  kg_bench_ba *ba = NULL;
  kg_error error = {0};
  const char *path = write_text("2 3 4\n1 2 3 4 5 6 7 8 9 10 11\n12 13 14\n15\n16 17\n");
  assert_int_equal(kg_bench_ba_read(&ba, path, &error), KG_OK);
  assert_int_equal(ba->parameter_count, 22 + 9 + 4);
  double inputs[15];
  kg_bench_ba_inputs(ba, ba->theta, 3, inputs);
  for (int j = 0; j < 15; j++) {
    assert_close(inputs[j], j + 1.0, 0.0);
  }
  assert_int_equal(ba->camera[3], 1);
  assert_int_equal(ba->point[3], 0);
  assert_close(ba->feature[7], 17.0, 0.0);
  kg_bench_ba_destroy(ba);
  if (has_file(ADBENCH "ba1.txt")) {
    assert_int_equal(kg_bench_ba_read(&ba, ADBENCH "ba1.txt", &error), KG_OK);
    assert_int_equal(ba->n, 49);
    assert_int_equal(ba->m, 7776);
    assert_int_equal(ba->p, 31843);
    kg_bench_ba_destroy(ba);
  }
}

/* The text is refused at this line, with these words. */
static void refused(const char *text, bool is_gmm, long line, const char *words)
{
  kg_bench_gmm *gmm = NULL;
  kg_bench_ba *ba = NULL;
  kg_error error = {0};
  const char *path = write_text(text);
  const kg_status status =
    is_gmm ? kg_bench_gmm_read(&gmm, path, &error) : kg_bench_ba_read(&ba, path, &error);
  assert_int_equal(status, KG_ERR_FORMAT);
  assert_null(gmm);
  assert_null(ba);
  assert_int_equal(error.line, line);
  assert_string_equal(error.path, path);
  if (!strstr(error.text, words)) {
    fail_msg("\"%s\" does not say \"%s\"", error.text, words);
  }
}

static void malformed_files_are_refused_with_line_and_reason(void **state)
{
  (void)state;
  refused("", true, 1, "the dimension D");
  refused("1 1.5 1\n", true, 1, "the number of components K, a whole number");
  refused("1 1 -4\n", true, 1, "the number of points n, a whole number");
  refused("1 1 2\n0.5\n1\nx\n", true, 4, "found 'x', expected an entry of icf");
  refused("1 1 2\n0.5\n1\n0\n1\n2\n0 0\n", true, 7, "gamma is 0");
  refused("1 1 2\n0.5\n1\n0\n1\n2\n1 0\n3\n", true, 8, "the end of the file");
  refused("1 1 2\n0.5\n1\n0\n1\n", true, 6, "found the end of the file, expected a coordinate");
  refused("2 3 4\n1 2 3 4 5 6 7 8 9 10 11\n12 13 nan\n", false, 3, "a coordinate of the point");
  refused("0 3 4\n", false, 1, "the number of cameras n, a whole number from 1");
  refused("2 3 4\n1 2 3 4 5 6 7 8 9 10 11\n12 13 14\n15\n16 17\n18", false, 6, "end of the file");
  kg_bench_gmm *gmm = NULL;
  kg_error error = {0};
  assert_int_equal(kg_bench_gmm_read(&gmm, "no such file", &error), KG_ERR_READ);
  assert_null(gmm);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(gmm_values_are_the_published_ones),
    cmocka_unit_test(gmm_prior_holds_for_other_m_and_gamma),
    cmocka_unit_test(gmm_gradient_is_the_derivative_of_the_value),
    cmocka_unit_test(ba_residuals_equal_an_independent_evaluation),
    cmocka_unit_test(ba_without_rotation_is_a_pinhole_camera),
    cmocka_unit_test(every_number_of_perturbed_data_is_different),
    cmocka_unit_test(ba_reference_derivatives_agree_with_differences),
    cmocka_unit_test(ba_file_gives_sizes_and_the_one_observation),
    cmocka_unit_test(malformed_files_are_refused_with_line_and_reason),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
