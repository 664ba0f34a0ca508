/* Log posterior of a Gaussian mixture with a Wishart prior: the loops that value and gradient share.
 *
 *   L = - n D/2 log(2 pi) + sum_i logsumexp_k(alpha_k + q_k - 1/2 |Q_k (x_i - mu_k)|^2)
 *       - n logsumexp_k(alpha_k) + sum_k [gamma^2/2 |Q_k|_F^2 - m q_k] - K C
 *
 * q_k sum of the log-diagonal of Q_k; the sign of the prior is ADBench's. d diagonal and l strict
 * lower triangle of Q_k (columns one after the other), c = x_i - mu_k, y = Q_k c, t_k the argument
 * of the logsumexp. */
#ifndef BENCH_AUTODIFF_GMM_LOOPS_H
#define BENCH_AUTODIFF_GMM_LOOPS_H

#include <math.h>

#include "bench/autodiff/problems.h"

/* Where the parameters of a theta, or of a gradient, begin. */
typedef struct view {
  const double *alpha, *mu, *icf;
  int D, K, icf_size;
} view;

static inline view view_of(const kg_bench_gmm *gmm, const double *theta)
{
  const int D = gmm->D, K = gmm->K;
  return (view){theta, theta + K, theta + K + K * D, D, K, D * (D + 1) / 2};
}

/* Work memory, as arrays. */
typedef struct scratch {
  double *q;     /* (K)     */
  double *d;     /* (K x D) */
  double *c, *y; /* (K x D) of one point; the value uses the first D only */
  double *t;     /* (K)     */
  double *v;     /* (D)     */
} scratch;

static inline scratch scratch_of(const kg_bench_gmm *gmm, double *work)
{
  const size_t K = (size_t)gmm->K, D = (size_t)gmm->D;
  double *d = work + K, *c = d + K * D, *y = c + K * D, *t = y + K * D;
  return (scratch){work, d, c, y, t, t + K};
}

static inline double log_sum_exp(const double *t, int K)
{
  double largest = t[0];
  for (int k = 1; k < K; k++) {
    largest = t[k] > largest ? t[k] : largest;
  }
  double sum = 0.0;
  for (int k = 0; k < K; k++) {
    sum += exp(t[k] - largest);
  }
  return largest + log(sum);
}

static inline void expand_diagonals(const scratch *s, const view *p)
{
  for (int k = 0; k < p->K; k++) {
    const double *log_d = p->icf + k * p->icf_size;
    s->q[k] = 0.0;
    for (int j = 0; j < p->D; j++) {
      s->q[k] += log_d[j];
      s->d[k * p->D + j] = exp(log_d[j]);
    }
  }
}

/* c = x - mu, y = Q c; returns |y|^2 */
static inline double whiten(double *restrict y, double *restrict c, const double *restrict d,
                            const double *restrict l, const double *restrict x,
                            const double *restrict mu, int D)
{
  for (int j = 0; j < D; j++) {
    c[j] = x[j] - mu[j];
    y[j] = d[j] * c[j];
  }
  for (int j = 0; j < D; j++) {
    for (int i = j + 1; i < D; i++) {
      y[i] += *l++ * c[j];
    }
  }
  double square = 0.0;
  for (int j = 0; j < D; j++) {
    square += y[j] * y[j];
  }
  return square;
}

static inline double prior(const kg_bench_gmm *gmm, const scratch *s, const view *p)
{
  double sum = 0.0;
  for (int k = 0; k < p->K; k++) {
    const double *d = s->d + k * p->D, *l = p->icf + k * p->icf_size + p->D;
    double square = 0.0;
    for (int j = 0; j < p->D; j++) {
      square += d[j] * d[j];
    }
    for (int j = 0; j < p->icf_size - p->D; j++) {
      square += l[j] * l[j];
    }
    sum += 0.5 * gmm->gamma * gmm->gamma * square - gmm->m * s->q[k];
  }
  return sum;
}

#endif
