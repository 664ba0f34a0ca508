/* Inside the library: inverse factorials of even and odd numbers: cos x and sin x / x are sums of
 * (-x^2)^k times these. Small angles, the increments of a motion, do without trigonometry. */
#ifndef BASE_ROTATION_SERIES_H
#define BASE_ROTATION_SERIES_H

static const double kg_series_even[8] = {
  1.0,           1.0 / 2.0,       1.0 / 24.0,        1.0 / 720.0,
  1.0 / 40320.0, 1.0 / 3628800.0, 1.0 / 479001600.0, 1.0 / 87178291200.0};
static const double kg_series_odd[8] = {1.0,
                                        1.0 / 6.0,
                                        1.0 / 120.0,
                                        1.0 / 5040.0,
                                        1.0 / 362880.0,
                                        1.0 / 39916800.0,
                                        1.0 / 6227020800.0,
                                        1.0 / 1307674368000.0};

/* c[0] - c[1] x + c[2] x^2 - ... */
static inline double kg_series(const double *c, int count, double x)
{
  double sum = c[count - 1];
  for (int k = count - 2; k >= 0; k--) {
    sum = c[k] - sum * x;
  }
  return sum;
}

#endif
