/* Nets on kinegrad's tape: the gradients of plain loops, no memory in the steady state, and what
 * happens when memory is refused. */
#include "support.h"

#include "bench/autodiff/nets_kinegrad.h"

typedef struct contestant {
  kg_status (*create)(void **state, const void *data, const kg_allocator *allocator);
  kg_status (*run)(void *state, double *answer);
} contestant;

static const contestant contestants[] = {{kg_net_recorded_create, kg_net_recorded_run},
                                         {kg_net_replayed_create, kg_net_replayed_run}};

/* widths that fall and rise, so that both orders of graph aggregation are taken */
static const struct {
  kg_bench_net_kind kind;
  kg_bench_activation activation;
  int width[4], batch, group;
} nets[] = {{KG_BENCH_MLP, KG_BENCH_RELU, {3, 5, 4, 2}, 6, 1},
            {KG_BENCH_MLP, KG_BENCH_TANH, {6, 20, 20, 7}, 128, 1},
            {KG_BENCH_TCN, KG_BENCH_RELU, {3, 5, 4, 2}, 2, 5},
            {KG_BENCH_TCN, KG_BENCH_TANH, {3, 5, 6, 3}, 3, 2},
            {KG_BENCH_GCN, KG_BENCH_RELU, {3, 5, 5, 2}, 3, 4},
            {KG_BENCH_GCN, KG_BENCH_TANH, {3, 5, 4, 6}, 30, 5}};

static kg_bench_net *net_of(size_t i)
{
  kg_bench_net *net = NULL;
  assert_int_equal(kg_bench_net_create(&net, nets[i].kind, nets[i].activation, nets[i].width,
                                       nets[i].batch, nets[i].group, 4 + i),
                   KG_OK);
  return net;
}

static double *numbers_of(size_t count)
{
  double *values = calloc(count, sizeof *values);
  assert_non_null(values);
  return values;
}

static void gradients_are_those_of_plain_loops(void **state)
{
  (void)state;
  for (size_t i = 0; i < KG_COUNT_OF(nets) * KG_COUNT_OF(contestants); ++i) {
    const contestant *c = &contestants[i % KG_COUNT_OF(contestants)];
    kg_bench_net *net = net_of(i / KG_COUNT_OF(contestants));
    const size_t count = 1 + (size_t)net->parameter_count;
    double *expected = numbers_of(count), *answer = numbers_of(count), *again = numbers_of(count);
    assert_int_equal(kg_bench_net_gradient(net, expected, expected + 1), KG_OK);
    failing_heap heap = {1000, 0};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    void *model = NULL;
    assert_int_equal(c->create(&model, net, &allocator), KG_OK);
    assert_int_equal(c->run(model, answer), KG_OK);
    assert_int_equal(c->run(model, answer), KG_OK);
    heap.calls_left = 0; /* from here on memory is refused, and none is needed */
    assert_int_equal(c->run(model, again), KG_OK);
    assert_memory_equal(answer, again, count * sizeof *answer);
    for (size_t e = 0; e < count; ++e) {
      assert_close(answer[e], expected[e], 2e-6);
    }
    kg_net_destroy(model);
    assert_int_equal(heap.live_bytes, 0);
    free(expected);
    free(answer);
    free(again);
    kg_bench_net_destroy(net);
  }
}

/* whichever allocation is refused: the failure is reported and nothing is lost */
static void refused_memory_is_reported(void **state)
{
  (void)state;
  for (size_t i = 0; i < KG_COUNT_OF(nets) * KG_COUNT_OF(contestants); ++i) {
    const contestant *c = &contestants[i % KG_COUNT_OF(contestants)];
    kg_bench_net *net = net_of(i / KG_COUNT_OF(contestants));
    double *answer = numbers_of(1 + (size_t)net->parameter_count);
    kg_status status = KG_ERR_NO_MEMORY;
    int allowed = 0;
    for (; status != KG_OK; ++allowed) {
      failing_heap heap = {allowed, 0};
      const kg_allocator allocator = {failing_alloc, failing_free, &heap};
      void *model = NULL;
      status = c->create(&model, net, &allocator);
      if (status == KG_OK) {
        status = c->run(model, answer);
        kg_net_destroy(model);
      }
      assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
      assert_int_equal(heap.live_bytes, 0);
    }
    assert_true(allowed > 3);
    free(answer);
    kg_bench_net_destroy(net);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(gradients_are_those_of_plain_loops),
    cmocka_unit_test(refused_memory_is_reported),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
