/* Value of the Gaussian mixture in straight loops: what gradients are timed against. Compiled twice
 * (bench/CMakeLists.txt): with -O3 as kg_bench_gmm_value, and with -O2 as kg_bench_gmm_value_O2,
 * because gcc 12 makes the short triangular loops slower when it vectorises them. */
#include "bench/autodiff/gmm_loops.h"

#ifndef KG_BENCH_GMM_VALUE
#define KG_BENCH_GMM_VALUE kg_bench_gmm_value
#endif

double KG_BENCH_GMM_VALUE(const kg_bench_gmm *gmm, const double *theta, double *work)
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
