/* Data of the Gaussian mixture: from a file of ADBench, or random numbers like those in it. */
#include <math.h>
#include <stdlib.h>

#include "bench/autodiff/numbers.h"
#include "bench/autodiff/problems.h"
#include "kinegrad/random.h"

enum { LARGEST_D = 1000, LARGEST_K = 10000, LARGEST_N = 10000000, LARGEST_ARRAY = 100000000 };

static kg_bench_gmm *empty(void)
{
  kg_bench_gmm *gmm = calloc(1, sizeof *gmm);
  if (gmm) {
    kg_arena_init(&gmm->arena, NULL);
  }
  return gmm;
}

void kg_bench_gmm_destroy(kg_bench_gmm *gmm)
{
  if (gmm) {
    kg_arena_release(&gmm->arena);
    free(gmm);
  }
}

/* False when the arrays do not fit into memory or an int. */
static bool allocate(kg_bench_gmm *gmm)
{
  const double per_component = 1.0 + gmm->D + 0.5 * gmm->D * (gmm->D + 1.0);
  if (gmm->K * per_component > LARGEST_ARRAY || (double)gmm->n * gmm->D > LARGEST_ARRAY) {
    return false;
  }
  gmm->parameter_count = gmm->K * (int)per_component;
  gmm->theta = KG_ARENA_ARRAY(&gmm->arena, double, gmm->parameter_count);
  gmm->x = KG_ARENA_ARRAY(&gmm->arena, double, gmm->n * gmm->D);
  return !kg_arena_failed(&gmm->arena);
}

static void read_arrays(kg_bench_gmm *gmm, numbers *in)
{
  const size_t D = (size_t)gmm->D, K = (size_t)gmm->K;
  numbers_read(in, gmm->theta, K, "a weight alpha");
  numbers_read(in, gmm->theta + K, K * D, "a coordinate of a mean");
  numbers_read(in, gmm->theta + K + K * D, K * D * (D + 1) / 2, "an entry of icf");
  numbers_read(in, gmm->x, (size_t)gmm->n * D, "a coordinate of a point");
  numbers_read(in, &gmm->gamma, 1, "gamma");
  if (in->status == KG_OK && !(gmm->gamma > 0.0)) {
    in->status = kg_fail(in->error, KG_ERR_FORMAT, in->text.path, in->text.line, 0,
                         "gamma is %g, expected a positive number", gmm->gamma);
  }
  gmm->m = numbers_count(in, 0, 1000000, "m");
  numbers_end(in);
}

kg_status kg_bench_gmm_read(kg_bench_gmm **gmm_out, const char *path, kg_error *error)
{
  *gmm_out = NULL;
  kg_bench_gmm *gmm = empty();
  if (!gmm) {
    return kg_fail(error, KG_ERR_NO_MEMORY, path, 0, 0, "not enough memory");
  }
  kg_arena content;
  kg_arena_init(&content, NULL);
  numbers in = numbers_open(&content, path, error);
  gmm->D = numbers_count(&in, 1, LARGEST_D, "the dimension D");
  gmm->K = numbers_count(&in, 1, LARGEST_K, "the number of components K");
  gmm->n = numbers_count(&in, 1, LARGEST_N, "the number of points n");
  if (in.status == KG_OK && !allocate(gmm)) {
    in.status = kg_fail(error, KG_ERR_NO_MEMORY, path, 1, 0, "not enough memory for D %d K %d n %d",
                        gmm->D, gmm->K, gmm->n);
  }
  if (in.status == KG_OK) {
    read_arrays(gmm, &in);
  }
  kg_arena_release(&content);
  if (in.status != KG_OK) {
    kg_bench_gmm_destroy(gmm);
    return in.status;
  }
  *gmm_out = gmm;
  return KG_OK;
}

kg_status kg_bench_gmm_synthetic(kg_bench_gmm **gmm_out, int D, int K, int n, uint64_t seed)
{
  *gmm_out = NULL;
  kg_bench_gmm *gmm = empty();
  if (!gmm) {
    return KG_ERR_NO_MEMORY;
  }
  gmm->D = D, gmm->K = K, gmm->n = n, gmm->gamma = 1.0;
  if (!allocate(gmm)) {
    kg_bench_gmm_destroy(gmm);
    return KG_ERR_NO_MEMORY;
  }
  kg_random random = kg_random_make(seed);
  for (int i = 0; i < gmm->parameter_count; i++) {
    const bool is_mean = i >= K && i < K + K * D;
    gmm->theta[i] = is_mean ? kg_random_uniform(&random) : kg_random_normal(&random);
  }
  for (int i = 0; i < n * D; i++) {
    gmm->x[i] = kg_random_normal(&random);
  }
  *gmm_out = gmm;
  return KG_OK;
}
