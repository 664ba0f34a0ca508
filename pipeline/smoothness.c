/* Smoothness of a motion: RMS jerk of the joints and spectral arc length of their mean speed.
 *
 * [SPARC] S. Balasubramanian, A. Melendez-Calderon, A. Roby-Brami, E. Burdet, On the analysis of
 *         movement smoothness, Journal of NeuroEngineering and Rehabilitation 12:112, 2015:
 *         the arc of the normalised magnitude spectrum up to 20 Hz or the last frequency where it
 *         exceeds 0.05, whichever is lower; zero-padded to 2^4 times the next power of two. */
#include "pipeline/measure.h"

static const double PI = 3.14159265358979323846;
static const double HIGHEST_HZ = 20.0, THRESHOLD = 0.05;
enum { PADDING_LEVEL = 4, LARGEST_FFT = 1 << 22 };

int kg_measure_fft_size(int T)
{
  int size = 1;
  while (size < T) {
    size *= 2;
  }
  return size < LARGEST_FFT >> PADDING_LEVEL ? size << PADDING_LEVEL : size;
}

/* ---- radix-2 transform, in place; x holds (re, im) pairs --------------------------------------- */

static void reverse_bits(double *x, int n)
{
  for (int i = 1, j = 0; i < n; i++) {
    int bit = n >> 1;
    for (; j & bit; bit >>= 1) {
      j ^= bit;
    }
    j ^= bit;
    if (i < j) {
      const double re = x[2 * i], im = x[2 * i + 1];
      x[2 * i] = x[2 * j];
      x[2 * i + 1] = x[2 * j + 1];
      x[2 * j] = re;
      x[2 * j + 1] = im;
    }
  }
}

static void transform(double *x, int n)
{
  reverse_bits(x, n);
  for (int half = 1; half < n; half *= 2) {
    for (int k = 0; k < half; k++) {
      const double c = cos(PI * k / half), s = -sin(PI * k / half);
      for (int i = k; i < n; i += 2 * half) {
        double *a = x + 2 * (ptrdiff_t)i, *b = x + 2 * (ptrdiff_t)(i + half);
        const double re = c * b[0] - s * b[1], im = c * b[1] + s * b[0];
        b[0] = a[0] - re;
        b[1] = a[1] - im;
        a[0] += re;
        a[1] += im;
      }
    }
  }
}

/* ---- the two numbers ------------------------------------------------------------------------- */

/* Arc of the spectrum of series[count] sampled every dt seconds; 0 for a motion at rest. */
static double spectral_arc_length(kg_measure *m, int count)
{
  double *x = m->spectrum;
  const int n = m->fft_size;
  for (int k = 0; k < n; k++) {
    x[2 * k] = k < count ? m->series[k] : 0.0;
    x[2 * k + 1] = 0.0;
  }
  transform(x, n);
  const double df = 1.0 / (n * m->dt);
  int bins = (int)(HIGHEST_HZ / df) + 1;
  bins = bins < n / 2 + 1 ? bins : n / 2 + 1;
  double largest = 0.0;
  for (int k = 0; k <= n / 2; k++) {
    x[k] = hypot(x[2 * k], x[2 * k + 1]); /* place k is read before it is overwritten */
    largest = fmax(largest, x[k]);
  }
  int last = 0; /* the last bin above the threshold */
  for (int k = 0; k < bins; k++) {
    last = x[k] >= THRESHOLD * largest ? k : last;
  }
  if (!(largest > 1e-12) || last == 0) {
    return 0.0;
  }
  double arc = 0.0;
  for (int k = 1; k <= last; k++) {
    const double rise = (x[k] - x[k - 1]) / largest;
    arc += sqrt(1.0 / ((double)last * last) + rise * rise);
  }
  return -arc;
}

static void mean_joint_speed(kg_measure *m, const kg_vec3 *joints, int n)
{
  for (int t = 0; t + 1 < m->T; t++) {
    double sum = 0.0;
    for (int i = 0; i < n; i++) {
      const kg_vec3 *p = joints + (ptrdiff_t)t * n + i;
      sum += kg_vec3_norm(kg_vec3_sub(p[n], p[0]));
    }
    m->series[t] = sum / (n * m->dt);
  }
}

void kg_measure_smoothness(kg_measure *m, const kg_vec3 *joints, kg_motion_metrics *out)
{
  const int n = m->subject->body->segment_count;
  double sum = 0.0;
  for (int t = 0; t + 3 < m->T; t++) {
    for (int i = 0; i < n; i++) {
      const kg_vec3 *p = joints + (ptrdiff_t)t * n + i;
      const kg_vec3 d =
        kg_vec3_add_scaled(kg_vec3_sub(p[3 * n], p[0]), -3.0, kg_vec3_sub(p[2 * n], p[n]));
      sum += kg_vec3_dot(d, d);
    }
  }
  const double count = (double)n * (m->T - 3);
  out->jerk_rms = m->T > 3 ? sqrt(sum / count) / (m->dt * m->dt * m->dt) : 0.0;
  if (m->T > 2) {
    mean_joint_speed(m, joints, n);
    out->spectral_arc_length = spectral_arc_length(m, m->T - 1);
  }
}
