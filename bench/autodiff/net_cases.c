/* Gradients of nets in single precision, beside the bare matrix products they cannot do without.
 * An answer is the loss and the gradient by every weight matrix and bias. */
#include <stdio.h>
#include <string.h>

#include "bench/autodiff/cases.h"
#include "bench/autodiff/nets_kinegrad.h"

enum { ALL = (1 << (1 + 2 * KG_BENCH_NET_LAYERS)) - 1 };

typedef struct shape {
  kg_bench_net_kind kind;
  kg_bench_activation activation;
  int width[KG_BENCH_NET_LAYERS + 1], batch, group;
} shape;

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  (void)setting;
  const shape *of = detail;
  kg_bench_net *net = NULL;
  const kg_status status =
    kg_bench_net_create(&net, of->kind, of->activation, of->width, of->batch, of->group, 1);
  if (status != KG_OK) {
    return kg_fail(error, status, NULL, 0, 0, "not enough memory for a net");
  }
  snprintf(problem->source, sizeof problem->source, "random, %d-%d-%d-%d, batch %d of %d rows, %s",
           of->width[0], of->width[1], of->width[2], of->width[3], of->batch, of->group,
           of->activation == KG_BENCH_RELU ? "ReLU" : "tanh");
  static const char *const names[2 * KG_BENCH_NET_LAYERS] = {"d/d W1", "d/d b1", "d/d W2",
                                                             "d/d b2", "d/d W3", "d/d b3"};
  problem->parts[0] = (kg_bench_part){"loss", 1, 1};
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const size_t in = (size_t)kg_bench_net_inputs(net, l);
    const size_t out = (size_t)kg_bench_net_outputs(net, l);
    problem->parts[1 + 2 * l] = (kg_bench_part){names[2 * l], in * out, 1};
    problem->parts[2 + 2 * l] = (kg_bench_part){names[2 * l + 1], out, 1};
  }
  problem->part_count = 1 + 2 * KG_BENCH_NET_LAYERS;
  problem->items = 1.0;
  problem->data = net;
  return KG_OK;
}

static void close(kg_bench_problem *problem)
{
  kg_bench_net_destroy(problem->data);
}

static kg_status reference(const void *data, double *answer)
{
  return kg_bench_net_gradient(data, &answer[0], answer + 1);
}

/* ---- bare products --------------------------------------------------------------------------- */

static kg_status create_products(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  kg_bench_products *products = NULL;
  const kg_status status = kg_bench_products_create(&products, data);
  *state = products;
  return status;
}

static kg_status run_products(void *state, double *answer)
{
  (void)answer; /* they have none */
  kg_bench_products_run(state);
  return KG_OK;
}

static void destroy_products(void *state)
{
  kg_bench_products_destroy(state);
}

/* ---- the cases ------------------------------------------------------------------------------- */

enum { PRODUCTS, RECORDED, REPLAYED, ADOLC_RETAPED, ADOLC_REPLAYED, CONTESTANTS };

static const kg_bench_contestant contestants[CONTESTANTS] = {
  [PRODUCTS] = {"bare products, sgemm", NULL, 0, create_products, run_products, destroy_products},
  [RECORDED] = {"kinegrad, recorded", NULL, ALL, kg_net_recorded_create, kg_net_recorded_run,
                kg_net_destroy},
  [REPLAYED] = {"kinegrad, replayed", NULL, ALL, kg_net_replayed_create, kg_net_replayed_run,
                kg_net_destroy},
  [ADOLC_RETAPED] = ADOLC_CONTESTANT("ADOL-C, retaped, double", ALL, kg_adolc_net_retaped),
  [ADOLC_REPLAYED] = ADOLC_CONTESTANT("ADOL-C, replayed, double", ALL, kg_adolc_net_replayed),
};

/* the perceptron is to be as fast as that, the other nets to be that close to the bare products */
enum { PAIRS = 4 };
#define PAIRS_OF(name, milliseconds, ratio)                                                        \
  static const kg_bench_pair name[PAIRS] = {                                                       \
    {"recorded", RECORDED, RECORDED, milliseconds},                                                \
    {"recorded over products", RECORDED, PRODUCTS, ratio},                                         \
    {"replayed over products", REPLAYED, PRODUCTS, ratio},                                         \
    {"recorded over ADOL-C", RECORDED, ADOLC_REPLAYED, 0.1},                                       \
  }
PAIRS_OF(mlp_pairs, 0.15, 0.0);
PAIRS_OF(tcn_pairs, 0.0, 1.3);
PAIRS_OF(gcn_pairs, 0.0, 1.5);

static const shape shapes[BENCH_NET_CASES] = {
  {KG_BENCH_MLP, KG_BENCH_RELU, {48, 64, 64, 12}, 64, 1},
  {KG_BENCH_TCN, KG_BENCH_RELU, {32, 64, 64, 32}, 16, 64},
  {KG_BENCH_GCN, KG_BENCH_RELU, {16, 64, 64, 8}, 64, 24},
  {KG_BENCH_MLP, KG_BENCH_TANH, {48, 64, 64, 12}, 64, 1},
  {KG_BENCH_TCN, KG_BENCH_TANH, {32, 64, 64, 32}, 16, 64},
  {KG_BENCH_GCN, KG_BENCH_TANH, {16, 64, 64, 8}, 64, 24},
};

/* the tolerance is that of single precision, 6e-8, over sums of up to 1536 terms */
/* clang-format off */
#define CASE(i, title, pairs_of_it)                                                                \
  {                                                                                                \
    .name = (title), .unit = "ms", .unit_seconds = 1e-3, .tolerance = 1e-5, .detail = &shapes[i],  \
    .open = open, .close = close, .reference = reference, .contestants = contestants,              \
    .contestant_count = CONTESTANTS, .pairs = pairs_of_it, .pair_count = PAIRS                     \
  }
/* clang-format on */

const kg_bench_case kg_bench_net_cases[BENCH_NET_CASES] = {
  CASE(0, "mlp_relu", mlp_pairs), CASE(1, "tcn_relu", tcn_pairs), CASE(2, "gcn_relu", gcn_pairs),
  CASE(3, "mlp_tanh", mlp_pairs), CASE(4, "tcn_tanh", tcn_pairs), CASE(5, "gcn_tanh", gcn_pairs),
};
