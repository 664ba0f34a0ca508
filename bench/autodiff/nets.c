/* Three nets and their gradient in plain double loops.
 *
 * H input of a layer, u = G(H), z = u W + b, x_bar the adjoint of x. Layers work on one batch element
 * (group rows) at a time. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/problems.h"
#include "kinegrad/random.h"

/* ---- data ------------------------------------------------------------------------------------ */

int kg_bench_net_inputs(const kg_bench_net *net, int l)
{
  return net->taps * net->width[l];
}

int kg_bench_net_outputs(const kg_bench_net *net, int l)
{
  return net->width[l + 1];
}

static void fill(float *values, int count, double scale, kg_random *random)
{
  for (int i = 0; i < count; i++) {
    values[i] = (float)(scale * kg_random_normal(random));
  }
}

/* weights of variance 1 / inputs, so that values keep their size from layer to layer */
static void fill_theta(kg_bench_net *net, kg_random *random)
{
  float *at = net->theta;
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const int inputs = kg_bench_net_inputs(net, l), outputs = kg_bench_net_outputs(net, l);
    fill(at, inputs * outputs, 1.0 / sqrt(inputs), random);
    fill(at + inputs * outputs, outputs, 0.1, random);
    at += (inputs + 1) * outputs;
  }
}

/* T. Kipf, M. Welling, Semi-supervised classification with graph convolutional networks, 2017 */
static void fill_adjacency(kg_bench_net *net, kg_random *random)
{
  const int n = net->group;
  float *A = net->adjacency;
  for (int i = 0; i < n; i++) {
    A[i * n + i] = 1.0f;
    if (i > 0) {
      const int parent = (int)(kg_random_uniform(random) * i);
      A[i * n + parent] = A[parent * n + i] = 1.0f;
    }
  }
  float degree[256] = {0};
  for (int i = 0; i < n * n; i++) {
    degree[i / n] += A[i];
  }
  for (int i = 0; i < n * n; i++) {
    A[i] /= sqrtf(degree[i / n] * degree[i % n]);
  }
}

void kg_bench_net_destroy(kg_bench_net *net)
{
  if (net) {
    kg_arena_release(&net->arena);
    free(net);
  }
}

static bool allocate(kg_bench_net *net)
{
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    net->parameter_count += (kg_bench_net_inputs(net, l) + 1) * kg_bench_net_outputs(net, l);
  }
  net->theta = KG_ARENA_ARRAY(&net->arena, float, net->parameter_count);
  net->x = KG_ARENA_ARRAY(&net->arena, float, net->rows * net->width[0]);
  net->target = KG_ARENA_ARRAY(&net->arena, float, net->rows * net->width[KG_BENCH_NET_LAYERS]);
  net->adjacency = KG_ARENA_ARRAY(&net->arena, float, net->group * net->group);
  return !kg_arena_failed(&net->arena);
}

kg_status kg_bench_net_create(kg_bench_net **net_out, kg_bench_net_kind kind,
                              kg_bench_activation activation,
                              const int width[KG_BENCH_NET_LAYERS + 1], int batch, int group,
                              uint64_t seed)
{
  KG_ASSERT(group >= 1 && group <= 256 && batch >= 1);
  *net_out = NULL;
  kg_bench_net *net = calloc(1, sizeof *net);
  if (!net) {
    return KG_ERR_NO_MEMORY;
  }
  kg_arena_init(&net->arena, NULL);
  net->kind = kind, net->activation = activation;
  memcpy(net->width, width, sizeof net->width);
  net->batch = batch, net->group = group, net->rows = batch * group;
  net->taps = kind == KG_BENCH_TCN ? 3 : 1;
  if (!allocate(net)) {
    kg_bench_net_destroy(net);
    return KG_ERR_NO_MEMORY;
  }
  kg_random random = kg_random_make(seed);
  fill_theta(net, &random);
  fill(net->x, net->rows * width[0], 1.0, &random);
  fill(net->target, net->rows * width[KG_BENCH_NET_LAYERS], 1.0, &random);
  if (kind == KG_BENCH_GCN) {
    fill_adjacency(net, &random);
  }
  *net_out = net;
  return KG_OK;
}

/* ---- gradient -------------------------------------------------------------------------------- */

/* weight of row j of H, tap s, in row i of u */
static double mixing(const kg_bench_net *net, int i, int j, int s)
{
  if (net->kind == KG_BENCH_GCN) {
    return net->adjacency[i * net->group + j];
  }
  return net->kind == KG_BENCH_TCN ? j == i + s - 1 : j == i;
}

/* u = G(H), or with `back` H += G'(u) */
static void gather(const kg_bench_net *net, int width, double *u, double *H, bool back)
{
  for (int i = 0; i < net->group; i++) {
    for (int s = 0; s < net->taps; s++) {
      for (int j = 0; j < net->group; j++) {
        const double a = mixing(net, i, j, s);
        double *ui = u + (i * net->taps + s) * width, *Hj = H + j * width;
        for (int c = 0; c < width && a != 0.0; c++) {
          if (back) {
            Hj[c] += a * ui[c];
          } else {
            ui[c] += a * Hj[c];
          }
        }
      }
    }
  }
}

/* H = act(u W + b) */
static void forward(double *H, const double *u, const float *W, int rows, int inputs, int outputs,
                    bool is_last, kg_bench_activation activation)
{
  const float *b = W + inputs * outputs;
  for (int i = 0; i < rows; i++) {
    for (int c = 0; c < outputs; c++) {
      double z = b[c];
      for (int k = 0; k < inputs; k++) {
        z += u[i * inputs + k] * W[k * outputs + c];
      }
      const double active = activation == KG_BENCH_RELU ? (z > 0.0 ? z : 0.0) : tanh(z);
      H[i * outputs + c] = is_last ? z : active;
    }
  }
}

/* H_bar becomes z_bar; the slopes follow from the values H */
static void through_activation(double *H_bar, const double *H, int count,
                               kg_bench_activation activation)
{
  for (int i = 0; i < count; i++) {
    H_bar[i] *= activation == KG_BENCH_RELU ? H[i] > 0.0 : 1.0 - H[i] * H[i];
  }
}

/* W_bar += u' z_bar, b_bar += sum of z_bar, u_bar = z_bar W' */
static void backward(double *W_bar, double *u_bar, const double *z_bar, const double *u,
                     const float *W, int rows, int inputs, int outputs)
{
  double *b_bar = W_bar + inputs * outputs;
  for (int i = 0; i < rows; i++) {
    for (int c = 0; c < outputs; c++) {
      b_bar[c] += z_bar[i * outputs + c];
    }
    for (int k = 0; k < inputs; k++) {
      double sum = 0.0;
      for (int c = 0; c < outputs; c++) {
        W_bar[k * outputs + c] += u[i * inputs + k] * z_bar[i * outputs + c];
        sum += W[k * outputs + c] * z_bar[i * outputs + c];
      }
      u_bar[i * inputs + k] = sum;
    }
  }
}

/* Values of one element: H[l] (group x width_l), u[l] (group x inputs_l), and their adjoints. */
typedef struct element {
  double *H[KG_BENCH_NET_LAYERS + 1], *u[KG_BENCH_NET_LAYERS];
  double *H_bar[KG_BENCH_NET_LAYERS + 1], *u_bar[KG_BENCH_NET_LAYERS];
} element;

static element element_make(const kg_bench_net *net, kg_arena *arena)
{
  element e;
  for (int l = 0; l <= KG_BENCH_NET_LAYERS; l++) {
    e.H[l] = KG_ARENA_ARRAY(arena, double, net->group * net->width[l]);
    e.H_bar[l] = KG_ARENA_ARRAY(arena, double, net->group * net->width[l]);
  }
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    e.u[l] = KG_ARENA_ARRAY(arena, double, net->group *kg_bench_net_inputs(net, l));
    e.u_bar[l] = KG_ARENA_ARRAY(arena, double, net->group *kg_bench_net_inputs(net, l));
  }
  return e;
}

static void run_forward(const kg_bench_net *net, element *e, const float *x)
{
  for (int i = 0; i < net->group * net->width[0]; i++) {
    e->H[0][i] = x[i];
  }
  const float *W = net->theta;
  for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
    const int inputs = kg_bench_net_inputs(net, l), outputs = kg_bench_net_outputs(net, l);
    memset(e->u[l], 0, (size_t)(net->group * inputs) * sizeof(double));
    gather(net, net->width[l], e->u[l], e->H[l], false);
    forward(e->H[l + 1], e->u[l], W, net->group, inputs, outputs, l == KG_BENCH_NET_LAYERS - 1,
            net->activation);
    W += (inputs + 1) * outputs;
  }
}

static double start_backward(const kg_bench_net *net, element *e, const float *target)
{
  const int last = KG_BENCH_NET_LAYERS;
  double loss = 0.0;
  for (int i = 0; i < net->group * net->width[last]; i++) {
    const double d = e->H[last][i] - target[i];
    e->H_bar[last][i] = d / net->rows;
    loss += 0.5 * d * d / net->rows;
  }
  return loss;
}

static void run_backward(const kg_bench_net *net, element *e, double *gradient)
{
  int offset = net->parameter_count;
  for (int l = KG_BENCH_NET_LAYERS - 1; l >= 0; l--) {
    const int inputs = kg_bench_net_inputs(net, l), outputs = kg_bench_net_outputs(net, l);
    offset -= (inputs + 1) * outputs;
    if (l < KG_BENCH_NET_LAYERS - 1) {
      through_activation(e->H_bar[l + 1], e->H[l + 1], net->group * outputs, net->activation);
    }
    backward(gradient + offset, e->u_bar[l], e->H_bar[l + 1], e->u[l], net->theta + offset,
             net->group, inputs, outputs);
    memset(e->H_bar[l], 0, (size_t)(net->group * net->width[l]) * sizeof(double));
    gather(net, net->width[l], e->u_bar[l], e->H_bar[l], true);
  }
}

kg_status kg_bench_net_gradient(const kg_bench_net *net, double *loss, double *gradient)
{
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  element e = element_make(net, &arena);
  const bool has_memory = !kg_arena_failed(&arena);
  *loss = 0.0;
  memset(gradient, 0, (size_t)net->parameter_count * sizeof *gradient);
  for (int b = 0; b < net->batch && has_memory; b++) {
    run_forward(net, &e, net->x + b * net->group * net->width[0]);
    *loss +=
      start_backward(net, &e, net->target + b * net->group * net->width[KG_BENCH_NET_LAYERS]);
    run_backward(net, &e, gradient);
  }
  kg_arena_release(&arena);
  return has_memory ? KG_OK : KG_ERR_NO_MEMORY;
}
