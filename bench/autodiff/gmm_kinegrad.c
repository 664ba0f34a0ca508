/* The Gaussian mixture on a kinegrad tape, written in tensors.
 *
 * |Q_k (x_i - mu_k)|^2 is the sum of squares of Q_k x_i - Q_k mu_k: one product serves all k and i:
 *
 *   Y (K, D, n) = [Q_k, -Q_k mu_k] (K, D, D + 1) times the points over a row of ones (D + 1, n). */
#include <stdlib.h>

#include "bench/autodiff/cases.h"
#include "kinegrad/derivatives.h"

typedef struct mixture {
  const kg_bench_gmm *gmm;
  kg_tape *tape;
  kg_value points;       /* (D + 1, n), constant */
  kg_tape_mark recorded; /* the points alone     */
  int32_t *place;        /* (D, D): which entry of [diagonal, triangle] it is, -1 for none */
} mixture;

/* (D + 1, n): the points as columns over a row of ones */
static kg_status record_points(mixture *g)
{
  const size_t D = (size_t)g->gmm->D, n = (size_t)g->gmm->n;
  double *columns = malloc((D + 1) * n * sizeof *columns);
  if (!columns) return KG_ERR_NO_MEMORY;
  for (size_t i = 0; i < n; ++i) {
    for (size_t j = 0; j <= D; ++j) {
      columns[j * n + i] = j < D ? g->gmm->x[i * D + j] : 1;
    }
  }
  g->points = kg_constant(g->tape, KG_SHAPE(g->gmm->D + 1, g->gmm->n), columns);
  g->recorded = kg_tape_mark_of(g->tape);
  free(columns);
  return kg_tape_status(g->tape);
}

static void fill_places(int32_t *place, int D)
{
  int32_t next = D;
  for (int column = 0; column < D; ++column) {
    for (int row = 0; row < D; ++row) {
      int32_t *at = &place[row * D + column];
      *at = row < column ? -1 : row == column ? row : next++;
    }
  }
}

void kg_bench_gmm_tape_destroy(void *state)
{
  mixture *g = state;
  kg_tape_destroy(g->tape);
  free(g->place);
  free(g);
}

kg_status kg_bench_gmm_tape(void **state, const void *data, const kg_allocator *allocator)
{
  const kg_bench_gmm *gmm = data;
  mixture *g = calloc(1, sizeof *g);
  if (!g) return KG_ERR_NO_MEMORY;
  kg_tape_def def = kg_tape_default_def();
  def.allocator = allocator;
  g->gmm = gmm;
  g->place = malloc((size_t)gmm->D * (size_t)gmm->D * sizeof *g->place);
  kg_status status = g->place ? kg_tape_create(&def, &g->tape, NULL) : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    fill_places(g->place, gmm->D);
    status = record_points(g);
  }
  if (status == KG_OK) {
    *state = g;
  } else {
    kg_bench_gmm_tape_destroy(g);
  }
  return status;
}

/* alpha (K), mu (K, D), icf (K, D(D+1)/2) -> L without its constant */
static kg_value objective(const mixture *g, kg_value alpha, kg_value mu, kg_value icf)
{
  kg_tape *t = g->tape;
  const int D = g->gmm->D, K = g->gmm->K, triangle = D * (D - 1) / 2;
  const kg_value log_diagonal = kg_slice(t, icf, 1, 0, D), q = kg_sum(t, log_diagonal, 1);
  const kg_value entries[2] = {kg_exp(t, log_diagonal), kg_slice(t, icf, 1, D, triangle)};
  const kg_value packed = kg_concat(t, 1, 2, entries);
  const kg_value Q = kg_reshape(t, kg_gather(t, packed, 1, D * D, g->place), KG_SHAPE(K, D, D));
  const kg_value centre = kg_matmul(t, Q, kg_reshape(t, mu, KG_SHAPE(K, D, 1)), 0);
  const kg_value columns[2] = {Q, kg_neg(t, centre)};
  const kg_value Y = kg_matmul(t, kg_concat(t, 2, 2, columns), g->points, 0);
  const kg_value height = kg_reshape(t, kg_add(t, alpha, q), KG_SHAPE(K, 1));
  const kg_value exponent = kg_add(t, kg_scale(t, kg_sum_squares(t, Y, 1), -0.5), height);
  const kg_value terms[4] = {kg_sum_all(t, kg_logsumexp(t, exponent, 0)), kg_logsumexp(t, alpha, 0),
                             kg_sum_all(t, kg_square(t, packed)), kg_sum_all(t, q)};
  const double gamma = g->gmm->gamma;
  const double factors[4] = {1, -g->gmm->n, 0.5 * gamma * gamma, -g->gmm->m};
  return kg_combine(t, 4, factors, terms);
}

kg_status kg_bench_gmm_tape_run(void *state, double *answer)
{
  const mixture *g = state;
  kg_tape *t = g->tape;
  const int D = g->gmm->D, K = g->gmm->K;
  const double *theta = g->gmm->theta;
  kg_tape_rewind(t, g->recorded);
  const kg_value inputs[3] = {kg_input(t, KG_SHAPE(K), theta),
                              kg_input(t, KG_SHAPE(K, D), theta + K),
                              kg_input(t, KG_SHAPE(K, D * (D + 1) / 2), theta + K + K * D)};
  const kg_value L = objective(g, inputs[0], inputs[1], inputs[2]);
  double *const gradients[3] = {answer + 1, answer + 1 + K, answer + 1 + K + K * D};
  answer[0] = kg_item(t, L) + kg_bench_gmm_constant(g->gmm);
  return kg_gradient(t, L, 3, inputs, gradients);
}
