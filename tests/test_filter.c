/* The low-pass filter against its frequency response in closed form. */
#include "support.h"

#include "kinegrad/filter.h"

enum { COUNT = 1200 };

static const double TWO_PI = 6.283185307179586;

typedef struct signal {
  double x[COUNT * 3], work[COUNT + 8000];
} signal;

/* 1 / (1 + (sqrt 2 - 1) (tan(pi f/fs) / tan(pi fc/fs))^4), written out independently */
static double expected_gain(double f, double rate, double cutoff)
{
  const double r = tan(0.5 * TWO_PI * f / rate) / tan(0.5 * TWO_PI * cutoff / rate);
  return 1.0 / (1.0 + (sqrt(2.0) - 1.0) * pow(r, 4.0));
}

static void sines_keep_their_phase_and_get_the_gain_of_the_formula(void **state)
{
  (void)state;
  static signal s;
  const double rates[] = {50.0, 120.0, 240.0}, cutoffs[] = {3.0, 6.0, 20.0};
  const double frequencies[] = {0.5, 3.0, 6.0, 12.0, 20.0, 24.0};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      for (size_t k = 0; k < KG_COUNT_OF(frequencies); k++) {
        const double w = TWO_PI * frequencies[k] / rates[i];
        for (int t = 0; t < COUNT; t++) {
          s.x[t] = sin(w * t + 0.3);
        }
        assert_true(kg_filter_work_size(COUNT, rates[i], cutoffs[j]) <= KG_COUNT_OF(s.work));
        kg_filter_lowpass(s.x, COUNT, 1, rates[i], cutoffs[j], s.work);
        const double gain = expected_gain(frequencies[k], rates[i], cutoffs[j]);
        assert_close(kg_filter_gain(frequencies[k], rates[i], cutoffs[j]), gain, 1e-12);
        for (int t = COUNT / 2 - 50; t < COUNT / 2 + 50; t++) { /* far from the ends */
          assert_close(s.x[t], gain * sin(w * t + 0.3), 1e-9);
        }
      }
    }
  }
  assert_close(kg_filter_gain(20.0, 120.0, 20.0), sqrt(0.5), 1e-14);
}

static void straight_lines_pass_and_strides_are_kept_apart(void **state)
{
  (void)state;
  static signal s;
  const int counts[] = {3, 4, 7, 40, COUNT};
  for (size_t c = 0; c < KG_COUNT_OF(counts); c++) {
    const int n = counts[c];
    for (int t = 0; t < n; t++) {
      s.x[3 * t] = 7.0;
      s.x[3 * t + 1] = 2.0 - 0.3 * t;
      s.x[3 * t + 2] = -1.0;
    }
    kg_filter_lowpass(s.x, n, 3, 120.0, 20.0, s.work);
    kg_filter_lowpass(s.x + 1, n, 3, 120.0, 20.0, s.work);
    for (int t = 0; t < n; t++) {
      assert_close(s.x[3 * t], 7.0, 1e-13);
      assert_close(s.x[3 * t + 1], 2.0 - 0.3 * t, 1e-9);
      assert_true(s.x[3 * t + 2] == -1.0);
    }
  }
}

static void an_even_signal_stays_even_and_short_ones_are_left_alone(void **state)
{
  (void)state;
  static signal s;
  kg_random random = kg_random_make(5);
  for (int t = 0; t <= 100; t++) {
    s.x[t] = s.x[200 - t] = kg_random_normal(&random);
  }
  kg_filter_lowpass(s.x, 201, 1, 120.0, 20.0, s.work);
  for (int t = 0; t <= 100; t++) {
    assert_close(s.x[t], s.x[200 - t], 1e-10);
  }
  double two[2] = {1.0, 5.0};
  kg_filter_lowpass(two, 2, 1, 120.0, 20.0, s.work);
  assert_true(two[0] == 1.0 && two[1] == 5.0);
  kg_filter_lowpass(two, 0, 1, 120.0, 20.0, s.work);
  assert_close(kg_filter_gain(30.0, 60.0 * 0.99, 1e6), expected_gain(30.0, 59.4, 26.73), 1e-12);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(sines_keep_their_phase_and_get_the_gain_of_the_formula),
    cmocka_unit_test(straight_lines_pass_and_strides_are_kept_apart),
    cmocka_unit_test(an_even_signal_stays_even_and_short_ones_are_left_alone),
  };
  return cmocka_run_group_tests_name("filter", tests, NULL, NULL);
}
