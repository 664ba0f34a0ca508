/* The bare matrix products of a net's forward and backward pass, by OpenBLAS in single precision.
 *
 * Arrays are row-major; BLAS is column-major and so sees each of them transposed: Y = U W is asked
 * for as Y' = W' U'. */
#include <stdlib.h>

#include "bench/autodiff/problems.h"
#include "kinegrad/random.h"

void sgemm_(const char *transa, const char *transb, const int *m, const int *n, const int *k,
            const float *alpha, const float *a, const int *lda, const float *b, const int *ldb,
            const float *beta, float *c, const int *ldc);

typedef struct layer {
  int inputs, outputs;
  float *u, *W, *y;             /* rows x inputs, inputs x outputs, rows x outputs */
  float *u_bar, *W_bar, *y_bar; /* of the same sizes                               */
} layer;

struct kg_bench_products {
  int rows;
  layer layers[KG_BENCH_NET_LAYERS];
  kg_arena arena;
};

static float *random_array(kg_bench_products *p, int count, kg_random *random)
{
  float *values = KG_ARENA_ARRAY(&p->arena, float, count);
  for (int i = 0; values && i < count; i++) {
    values[i] = (float)kg_random_normal(random);
  }
  return values;
}

kg_status kg_bench_products_create(kg_bench_products **products, const kg_bench_net *net)
{
  *products = NULL;
  kg_bench_products *p = calloc(1, sizeof *p);
  if (!p) {
    return KG_ERR_NO_MEMORY;
  }
  kg_arena_init(&p->arena, NULL);
  kg_random random = kg_random_make(1);
  p->rows = net->rows;
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const int in = kg_bench_net_inputs(net, l), out = kg_bench_net_outputs(net, l), n = net->rows;
    p->layers[l] = (layer){in,
                           out,
                           random_array(p, n * in, &random),
                           random_array(p, in * out, &random),
                           random_array(p, n * out, &random),
                           random_array(p, n * in, &random),
                           random_array(p, in * out, &random),
                           random_array(p, n * out, &random)};
  }
  if (kg_arena_failed(&p->arena)) {
    kg_bench_products_destroy(p);
    return KG_ERR_NO_MEMORY;
  }
  *products = p;
  return KG_OK;
}

void kg_bench_products_destroy(kg_bench_products *products)
{
  if (products) {
    kg_arena_release(&products->arena);
    free(products);
  }
}

void kg_bench_products_run(kg_bench_products *products)
{
  static const float one = 1.0f, zero = 0.0f;
  const int *n = &products->rows;
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const layer *a = &products->layers[l];
    sgemm_("N", "N", &a->outputs, n, &a->inputs, &one, a->W, &a->outputs, a->u, &a->inputs, &zero,
           a->y, &a->outputs);
  }
  for (int l = KG_BENCH_NET_LAYERS - 1; l >= 0; l--) {
    const layer *a = &products->layers[l];
    sgemm_("N", "T", &a->outputs, &a->inputs, n, &one, a->y_bar, &a->outputs, a->u, &a->inputs,
           &zero, a->W_bar, &a->outputs);
    if (l > 0) {
      sgemm_("T", "N", &a->inputs, n, &a->outputs, &one, a->W, &a->outputs, a->y_bar, &a->outputs,
             &zero, a->u_bar, &a->inputs);
    }
  }
}

double kg_bench_products_flops(const kg_bench_products *products)
{
  double flops = 0.0;
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const layer *a = &products->layers[l];
    flops += (l > 0 ? 6.0 : 4.0) * products->rows * a->inputs * a->outputs;
  }
  return flops;
}
