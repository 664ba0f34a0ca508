/* What gradients are compared with: ADOL-C against derivatives that are known, the nets' plain
 * gradient against differences. */
#include "support.h"

#include "bench/autodiff/problems.h"
#include "bench/clock.h"
#ifdef KG_BENCH_HAS_ADOLC
#include "bench/autodiff/adolc_peer.h"
#endif

static double *numbers_of(size_t count)
{
  double *values = calloc(count, sizeof *values);
  assert_non_null(values);
  return values;
}

static const struct {
  kg_bench_net_kind kind;
  kg_bench_activation activation;
  int batch, group;
} NETS[] = {{KG_BENCH_MLP, KG_BENCH_RELU, 6, 1},
            {KG_BENCH_MLP, KG_BENCH_TANH, 6, 1},
            {KG_BENCH_TCN, KG_BENCH_TANH, 2, 5},
            {KG_BENCH_GCN, KG_BENCH_TANH, 3, 4},
            {KG_BENCH_GCN, KG_BENCH_RELU, 3, 4}};
static const int WIDTH[4] = {3, 5, 4, 2};

static kg_bench_net *net_of(size_t i)
{
  kg_bench_net *net = NULL;
  assert_int_equal(kg_bench_net_create(&net, NETS[i].kind, NETS[i].activation, WIDTH, NETS[i].batch,
                                       NETS[i].group, 4 + i),
                   KG_OK);
  return net;
}

static void the_nets_gradient_is_the_derivative_of_their_loss(void **state)
{
  (void)state;
  for (size_t i = 0; i < KG_COUNT_OF(NETS); i++) {
    kg_bench_net *net = net_of(i);
    double *gradient = numbers_of((size_t)net->parameter_count), loss, up, down;
    double *unused = numbers_of((size_t)net->parameter_count);
    assert_int_equal(kg_bench_net_gradient(net, &loss, gradient), KG_OK);
    for (int j = 0; j < net->parameter_count; j++) {
      const float at = net->theta[j], h = 1.0f / 4096.0f;
      net->theta[j] = at + h;
      const double above = (double)net->theta[j];
      assert_int_equal(kg_bench_net_gradient(net, &up, unused), KG_OK);
      net->theta[j] = at - h;
      assert_int_equal(kg_bench_net_gradient(net, &down, unused), KG_OK);
      assert_close(gradient[j], (up - down) / (above - (double)net->theta[j]), 1e-6);
      net->theta[j] = at;
    }
    free(unused);
    free(gradient);
    kg_bench_net_destroy(net);
  }
}

/* one layer of each kind, by hand: only the first column of W_0 matters */
static void the_nets_mix_rows_as_they_say(void **state)
{
  (void)state;
  kg_bench_net *net = net_of(3); /* graph */
  for (int i = 0; i < net->group; i++) {
    double row = 0.0, degree = 0.0;
    for (int j = 0; j < net->group; j++) {
      const double a = (double)net->adjacency[i * net->group + j];
      assert_close(a, (double)net->adjacency[j * net->group + i], 0.0);
      degree += a != 0.0;
      row += a > 0.0 ? a : 0.0;
    }
    assert_close((double)net->adjacency[i * net->group + i], 1.0 / degree, 1e-6);
    assert_true(row > 0.5);
  }
  kg_bench_net_destroy(net);
  net = net_of(2);
  assert_int_equal(kg_bench_net_inputs(net, 1), 15);
  kg_bench_net_destroy(net);
}

static void products_count_their_operations(void **state)
{
  (void)state;
  kg_bench_net *net = net_of(0);
  kg_bench_products *products = NULL;
  assert_int_equal(kg_bench_products_create(&products, net), KG_OK);
  kg_bench_products_run(products);
  assert_close(kg_bench_products_flops(products), 6.0 * (4.0 * 3 * 5 + 6.0 * 5 * 4 + 6.0 * 4 * 2),
               0.0);
  kg_bench_products_destroy(products);
  kg_bench_net_destroy(net);
}

static void the_heap_keeps_count(void **state)
{
  (void)state;
  kg_bench_heap heap = {0, 0, 0};
  const kg_allocator allocator = kg_bench_heap_allocator(&heap);
  void *a = allocator.alloc(1000, allocator.user), *b = allocator.alloc(500, allocator.user);
  allocator.free(a, 1000, allocator.user);
  void *c = allocator.alloc(700, allocator.user);
  assert_int_equal(heap.peak, 1500);
  assert_int_equal(heap.live, 1200);
  assert_int_equal(heap.calls, 3);
  allocator.free(b, 500, allocator.user);
  allocator.free(c, 700, allocator.user);
  assert_int_equal(heap.live, 0);
}

#ifdef KG_BENCH_HAS_ADOLC

typedef kg_status create_fn(void **state, const void *data, const kg_allocator *allocator);

/* Two answers of the peer, the second with what the first left behind, equal expected[count]. */
static void answers(create_fn *create, const void *data, const double *expected, size_t count)
{
  void *peer = NULL;
  double *answer = numbers_of(count);
  assert_int_equal(create(&peer, data, NULL), KG_OK);
  for (int call = 0; call < 2; call++) {
    memset(answer, 0xff, count * sizeof *answer);
    assert_int_equal(kg_adolc_run(peer, answer), KG_OK);
    for (size_t i = 0; i < count; i++) {
      assert_close(answer[i], expected[i], 1e-11);
    }
  }
  kg_adolc_destroy(peer);
  free(answer);
}

static void adolc_gives_the_gradient_of_the_mixture(void **state)
{
  (void)state;
  kg_bench_gmm *gmm = NULL;
  assert_int_equal(kg_bench_gmm_synthetic(&gmm, 3, 4, 20, 9), KG_OK);
  gmm->gamma = 0.7;
  gmm->m = 2;
  double *expected = numbers_of(1 + (size_t)gmm->parameter_count);
  double *work = numbers_of(kg_bench_gmm_work(gmm));
  expected[0] = kg_bench_gmm_gradient(gmm, gmm->theta, expected + 1, work);
  answers(kg_adolc_gmm_retaped, gmm, expected, 1 + (size_t)gmm->parameter_count);
  answers(kg_adolc_gmm_replayed, gmm, expected, 1 + (size_t)gmm->parameter_count);
  free(work);
  free(expected);
  kg_bench_gmm_destroy(gmm);
}

static void adolc_gives_the_derivatives_of_bundle_adjustment(void **state)
{
  (void)state;
  kg_bench_ba *ba = NULL;
  assert_int_equal(kg_bench_ba_synthetic(&ba, 3, 5, 12), KG_OK);
  kg_bench_ba_perturb(ba, 8);
  double *jacobian = numbers_of(12 * 31);
  double *loss = numbers_of(1 + (size_t)ba->parameter_count);
  kg_bench_ba_reference(ba, ba->theta, NULL, jacobian, loss + 1);
  loss[0] = kg_bench_ba_loss(ba, ba->theta);
  answers(kg_adolc_ba_jacobian_retaped, ba, jacobian, 12 * 31);
  answers(kg_adolc_ba_jacobian_replayed, ba, jacobian, 12 * 31);
  answers(kg_adolc_ba_observation_retaped, ba, jacobian, 12 * 31);
  answers(kg_adolc_ba_observation_replayed, ba, jacobian, 12 * 31);
  answers(kg_adolc_ba_loss_retaped, ba, loss, 1 + (size_t)ba->parameter_count);
  answers(kg_adolc_ba_loss_replayed, ba, loss, 1 + (size_t)ba->parameter_count);
  free(loss);
  free(jacobian);
  kg_bench_ba_destroy(ba);
}

static void adolc_gives_the_gradients_of_the_nets(void **state)
{
  (void)state;
  for (size_t i = 0; i < KG_COUNT_OF(NETS); i++) {
    kg_bench_net *net = net_of(i);
    double *expected = numbers_of(1 + (size_t)net->parameter_count);
    assert_int_equal(kg_bench_net_gradient(net, &expected[0], expected + 1), KG_OK);
    answers(kg_adolc_net_retaped, net, expected, 1 + (size_t)net->parameter_count);
    answers(kg_adolc_net_replayed, net, expected, 1 + (size_t)net->parameter_count);
    free(expected);
    kg_bench_net_destroy(net);
  }
}

#endif

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(the_nets_gradient_is_the_derivative_of_their_loss),
    cmocka_unit_test(the_nets_mix_rows_as_they_say),
    cmocka_unit_test(products_count_their_operations),
    cmocka_unit_test(the_heap_keeps_count),
#ifdef KG_BENCH_HAS_ADOLC
    cmocka_unit_test(adolc_gives_the_gradient_of_the_mixture),
    cmocka_unit_test(adolc_gives_the_derivatives_of_bundle_adjustment),
    cmocka_unit_test(adolc_gives_the_gradients_of_the_nets),
#endif
  };
#ifndef KG_BENCH_HAS_ADOLC
  print_message("skipped: ADOL-C is not installed\n");
#endif
  return cmocka_run_group_tests(tests, NULL, NULL);
}
