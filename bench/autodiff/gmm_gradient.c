/* Gradient of the Gaussian mixture, derived by hand, in straight loops; and what value and gradient
 * have in common that takes no time.
 *
 *   C = (D + m + 1) D (log gamma - 1/2 log 2) - log MultiGamma_D((D + m + 1)/2)
 *   log MultiGamma_D(a) = D(D-1)/4 log pi + sum_{j=1..D} log Gamma(a + (1-j)/2)
 *
 * w softmax of t, x_bar the adjoint of x. */
#include <string.h>

#include "bench/autodiff/gmm_loops.h"

static const double PI = 3.14159265358979323846;

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
