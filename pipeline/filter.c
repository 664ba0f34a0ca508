/* Zero-lag Butterworth filter by bilinear transform with prewarped cutoff; see filter.h. */
#include "kinegrad/filter.h"

#include <math.h>

static const double PI = 3.14159265358979323846;

/* y_k = b (x_k + 2 x_{k-1} + x_{k-2}) - a1 y_{k-1} - a2 y_{k-2} */
typedef struct biquad {
  double b, a1, a2;
} biquad;

static double clamped_cutoff(double rate_hz, double cutoff_hz)
{
  return fmin(cutoff_hz, 0.45 * rate_hz);
}

/* Prewarped cutoff of one pass: two passes multiply gains, so W^4 is divided by sqrt(2) - 1. */
static double single_pass_cutoff(double rate_hz, double cutoff_hz)
{
  const double correction = pow(sqrt(2.0) - 1.0, 0.25);
  return tan(PI * clamped_cutoff(rate_hz, cutoff_hz) / rate_hz) / correction;
}

static biquad butterworth(double rate_hz, double cutoff_hz)
{
  const double W = single_pass_cutoff(rate_hz, cutoff_hz);
  const double norm = 1.0 / (1.0 + sqrt(2.0) * W + W * W);
  const biquad f = {W * W * norm, 2.0 * (W * W - 1.0) * norm, (1.0 - sqrt(2.0) * W + W * W) * norm};
  return f;
}

/* Samples before and after the signal in which the start-up transient dies out: it falls as
 * exp(-sqrt(2) pi k cutoff / rate), below 1e-11 after six cutoff periods. */
static int padding(double rate_hz, double cutoff_hz)
{
  return (int)fmin(ceil(6.0 * rate_hz / clamped_cutoff(rate_hz, cutoff_hz)), 1e6) + 2;
}

size_t kg_filter_work_size(int count, double rate_hz, double cutoff_hz)
{
  return (size_t)count + 2 * (size_t)padding(rate_hz, cutoff_hz);
}

/* Odd reflection at both ends, any k: the signal of period 2 (n - 1) on top of its own trend. */
static double extended(const double *x, int count, int stride, int k)
{
  const int period = 2 * (count - 1);
  const int turns = k >= 0 ? k / period : -((period - 1 - k) / period);
  const int r = k - turns * period;
  const double first = x[0];
  const double last = x[(ptrdiff_t)(count - 1) * stride];
  const double value =
    r < count ? x[(ptrdiff_t)r * stride] : 2.0 * last - x[(ptrdiff_t)(period - r) * stride];
  return value + 2.0 * turns * (last - first);
}

/* One pass over y[0], y[step], ...; starts as if the first value had always been there. */
static void run(const biquad *f, double *y, int count, int step)
{
  double x1 = y[0], x2 = y[0], y1 = y[0], y2 = y[0];
  for (int k = 0; k < count; k++, y += step) {
    const double x0 = *y;
    const double y0 = f->b * (x0 + 2.0 * x1 + x2) - f->a1 * y1 - f->a2 * y2;
    x2 = x1;
    x1 = x0;
    y2 = y1;
    y1 = y0;
    *y = y0;
  }
}

void kg_filter_lowpass(double *x, int count, int stride, double rate_hz, double cutoff_hz,
                       double *work)
{
  KG_ASSERT(rate_hz > 0.0 && cutoff_hz > 0.0);
  if (count < 3) {
    return;
  }
  const biquad f = butterworth(rate_hz, cutoff_hz);
  const int pad = padding(rate_hz, cutoff_hz);
  const int length = count + 2 * pad;
  for (int k = 0; k < length; k++) {
    work[k] = extended(x, count, stride, k - pad);
  }
  run(&f, work, length, 1);
  run(&f, work + length - 1, length, -1);
  for (int k = 0; k < count; k++) {
    x[(ptrdiff_t)k * stride] = work[pad + k];
  }
}

double kg_filter_gain(double frequency_hz, double rate_hz, double cutoff_hz)
{
  const double ratio = tan(PI * frequency_hz / rate_hz) / single_pass_cutoff(rate_hz, cutoff_hz);
  return 1.0 / (1.0 + ratio * ratio * ratio * ratio);
}
