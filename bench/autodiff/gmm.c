/* Log posterior of a Gaussian mixture with a Wishart prior, in straight loops over doubles.
 *
 *   L = - n D/2 log(2 pi) + sum_i logsumexp_k(alpha_k + q_k - 1/2 |Q_k (x_i - mu_k)|^2)
 *       - n logsumexp_k(alpha_k) + sum_k [gamma^2/2 |Q_k|_F^2 - m q_k] - K C
 *   C = (D + m + 1) D (log gamma - 1/2 log 2) - log MultiGamma_D((D + m + 1)/2)
 *   log MultiGamma_D(a) = D(D-1)/4 log pi + sum_{j=1..D} log Gamma(a + (1-j)/2)
 *
 * q_k sum of the log-diagonal of Q_k; the sign of the prior is ADBench's. d diagonal and l strict
 * lower triangle of Q_k (columns one after the other), c = x_i - mu_k, y = Q_k c, t_k the argument
 * of the logsumexp, w its softmax.
 *
 * This file is compiled for speed (bench/CMakeLists.txt): its value is what gradients are timed
 * against. */
#include <math.h>
#include <string.h>

#include "bench/autodiff/problems.h"

static const double PI = 3.14159265358979323846;

/* Where the parameters of a theta, or of a gradient, begin. */
typedef struct view {
  const double *alpha, *mu, *icf;
  int D, K, icf_size;
} view;

static view view_of(const kg_bench_gmm *gmm, const double *theta)
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

static scratch scratch_of(const kg_bench_gmm *gmm, double *work)
{
  const size_t K = (size_t)gmm->K, D = (size_t)gmm->D;
  double *d = work + K, *c = d + K * D, *y = c + K * D, *t = y + K * D;
  return (scratch){work, d, c, y, t, t + K};
}

size_t kg_bench_gmm_work(const kg_bench_gmm *gmm)
{
  const size_t K = (size_t)gmm->K, D = (size_t)gmm->D;
  return 2 * K + 3 * K * D + D;
}

double kg_bench_gmm_constant(const kg_bench_gmm *gmm)
{
  const double D = gmm->D, degrees = D + gmm->m + 1.0;
  double log_gamma = 0.25 * D * (D - 1.0) * log(PI);
  for (int j = 1; j <= gmm->D; j++) {
    log_gamma += lgamma(0.5 * degrees + 0.5 * (1 - j));
  }
  const double C = degrees * D * (log(gmm->gamma) - 0.5 * log(2.0)) - log_gamma;
  return -0.5 * gmm->n * D * log(2.0 * PI) - gmm->K * C;
}

static double log_sum_exp(const double *t, int K)
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

static void expand_diagonals(const scratch *s, const view *p)
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
static double whiten(double *restrict y, double *restrict c, const double *restrict d,
                     const double *restrict l, const double *restrict x, const double *restrict mu,
                     int D)
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

static double prior(const kg_bench_gmm *gmm, const scratch *s, const view *p)
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

double kg_bench_gmm_value(const kg_bench_gmm *gmm, const double *theta, double *work)
{
  const view p = view_of(gmm, theta);
  const scratch s = scratch_of(gmm, work);
  const int D = p.D;
  expand_diagonals(&s, &p);
  double sum = 0.0;
  for (int i = 0; i < gmm->n; i++) {
    for (int k = 0; k < p.K; k++) {
      const double square = whiten(s.y, s.c, s.d + k * D, p.icf + k * p.icf_size + D,
                                   gmm->x + (size_t)i * (size_t)D, p.mu + k * D, D);
      s.t[k] = p.alpha[k] + s.q[k] - 0.5 * square;
    }
    sum += log_sum_exp(s.t, p.K);
  }
  return kg_bench_gmm_constant(gmm) + sum - gmm->n * log_sum_exp(p.alpha, p.K) + prior(gmm, &s, &p);
}

/* ---- the gradient by hand -------------------------------------------------------------------- */

/* Adds w d(-1/2 |Q (x - mu)|^2)/d(mu, log d, l); v: adjoint of y. The adjoint of c goes to mu. */
static void add_whitened(double *restrict mu_bar, double *restrict icf_bar, double *restrict v,
                         const double *restrict y, const double *restrict c,
                         const double *restrict d, const double *restrict l, double w, int D)
{
  for (int j = 0; j < D; j++) {
    v[j] = -w * y[j];
  }
  double *restrict l_bar = icf_bar + D;
  for (int j = 0; j < D; j++) {
    icf_bar[j] += v[j] * c[j] * d[j] + w; /* w: q_k is the sum of log d */
    double c_bar = d[j] * v[j];
    for (int i = j + 1; i < D; i++) {
      *l_bar++ += v[i] * c[j];
      c_bar += *l++ * v[i];
    }
    mu_bar[j] -= c_bar;
  }
}

static void add_prior(const kg_bench_gmm *gmm, const scratch *s, const view *p, double *icf_bar)
{
  const double square = gmm->gamma * gmm->gamma;
  for (int k = 0; k < p->K; k++) {
    const double *d = s->d + k * p->D, *icf = p->icf + k * p->icf_size;
    double *bar = icf_bar + k * p->icf_size;
    for (int j = 0; j < p->D; j++) {
      bar[j] += square * d[j] * d[j] - gmm->m;
    }
    for (int j = p->D; j < p->icf_size; j++) {
      bar[j] += square * icf[j];
    }
  }
}

/* One point: returns its logsumexp, adds its gradient. */
static double add_point(const view *p, const scratch *s, const double *x, double *bar)
{
  const int D = p->D;
  for (int k = 0; k < p->K; k++) {
    const double square = whiten(s->y + k * D, s->c + k * D, s->d + k * D,
                                 p->icf + k * p->icf_size + D, x, p->mu + k * D, D);
    s->t[k] = p->alpha[k] + s->q[k] - 0.5 * square;
  }
  const double value = log_sum_exp(s->t, p->K);
  double *mu_bar = bar + p->K, *icf_bar = mu_bar + p->K * D;
  for (int k = 0; k < p->K; k++) {
    const double w = exp(s->t[k] - value);
    bar[k] += w;
    add_whitened(mu_bar + k * D, icf_bar + k * p->icf_size, s->v, s->y + k * D, s->c + k * D,
                 s->d + k * D, p->icf + k * p->icf_size + D, w, D);
  }
  return value;
}

double kg_bench_gmm_gradient(const kg_bench_gmm *gmm, const double *theta, double *gradient,
                             double *work)
{
  const view p = view_of(gmm, theta);
  const scratch s = scratch_of(gmm, work);
  memset(gradient, 0, (size_t)gmm->parameter_count * sizeof *gradient);
  expand_diagonals(&s, &p);
  double sum = 0.0;
  for (int i = 0; i < gmm->n; i++) {
    sum += add_point(&p, &s, gmm->x + (size_t)i * (size_t)p.D, gradient);
  }
  const double normaliser = log_sum_exp(p.alpha, p.K);
  for (int k = 0; k < p.K; k++) {
    gradient[k] -= gmm->n * exp(p.alpha[k] - normaliser);
  }
  add_prior(gmm, &s, &p, gradient + p.K + p.K * p.D);
  return kg_bench_gmm_constant(gmm) + sum - gmm->n * normaliser + prior(gmm, &s, &p);
}
