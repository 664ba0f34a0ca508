// ADOL-C behind C functions. Formulas and letters as in gmm_loops.h, ba.c and nets.c, on adoubles.
#include "bench/autodiff/adolc_peer.h"

#include <adolc/adolc.h>

#include <cstring>
#include <new>
#include <vector>

namespace
{

typedef std::vector<adouble> adoubles;

enum : short { TAG_RETAPED = 1, TAG_REPLAYED = 2 };

// Every tape carries the whole store of active numbers, which only grows: behind a large tape a small
// one would copy megabytes for each derivative. Changing the kind of store and back empties it.
void empty_store()
{
  setStoreManagerType(ADOLC_LOCATION_SINGLETONS);
  setStoreManagerType(ADOLC_LOCATION_BLOCKS);
}

// A differentiated problem: run fills the answer.
struct peer {
  short tag;
  explicit peer(bool is_replayed) : tag(is_replayed ? TAG_REPLAYED : TAG_RETAPED)
  {
  }
  virtual ~peer()
  {
    removeTape(tag, ADOLC_REMOVE_COMPLETELY);
  }
  virtual void run(double *answer) = 0;
};

// Buffers in memory for about so many operations, so that no tape goes to a file.
void start_tape(short tag, bool keeps_values, size_t operations)
{
  const unsigned n = (unsigned)(operations < 4096 ? 4096 : operations);
  trace_on(tag, keeps_values, n, 4 * n, n, 2 * n, 1);
}

// ---- Gaussian mixture ---------------------------------------------------------------------------

adouble log_sum_exp(const adoubles &t)
{
  double largest = t[0].value();
  for (const adouble &a : t) {
    largest = a.value() > largest ? a.value() : largest;
  }
  adouble sum = 0.0;
  for (const adouble &a : t) {
    sum += exp(a - largest); // the shift cancels, so it may be a number
  }
  return log(sum) + largest;
}

struct gmm_peer : peer {
  const kg_bench_gmm *gmm;
  bool is_replayed;
  double value = 0.0;

  gmm_peer(const kg_bench_gmm *data, bool replays) : peer(replays), gmm(data), is_replayed(replays)
  {
    if (is_replayed) {
      record(false);
    }
  }

  size_t operations() const
  {
    const double D = gmm->D, K = gmm->K;
    return (size_t)(gmm->n * K * (0.5 * D * (D + 1.0) + 4.0 * D + 16.0) +
                    10.0 * gmm->parameter_count + 4096.0);
  }

  adouble square_distance(const double *x, const adouble *mu, const adouble *d, const adouble *l,
                          adoubles &c, adoubles &y) const
  {
    const int D = gmm->D;
    for (int j = 0; j < D; j++) {
      c[j] = x[j] - mu[j];
      y[j] = d[j] * c[j];
    }
    for (int j = 0; j < D; j++) {
      for (int i = j + 1; i < D; i++) {
        y[i] += *l++ * c[j];
      }
    }
    adouble square = 0.0;
    for (int j = 0; j < D; j++) {
      square += y[j] * y[j];
    }
    return square;
  }

  adouble prior(const adoubles &icf, const adoubles &d, const adoubles &q) const
  {
    const int D = gmm->D, S = D * (D + 1) / 2;
    adouble sum = 0.0;
    for (int k = 0; k < gmm->K; k++) {
      adouble square = 0.0;
      for (int j = 0; j < D; j++) {
        square += d[k * D + j] * d[k * D + j];
      }
      for (int j = D; j < S; j++) {
        square += icf[k * S + j] * icf[k * S + j];
      }
      sum += 0.5 * gmm->gamma * gmm->gamma * square - gmm->m * q[k];
    }
    return sum;
  }

  adouble evaluate(const adoubles &alpha, const adoubles &mu, const adoubles &icf) const
  {
    const int D = gmm->D, K = gmm->K, S = D * (D + 1) / 2;
    adoubles q(K), d(K * D), c(D), y(D), t(K);
    for (int k = 0; k < K; k++) {
      q[k] = 0.0;
      for (int j = 0; j < D; j++) {
        q[k] += icf[k * S + j];
        d[k * D + j] = exp(icf[k * S + j]);
      }
    }
    adouble sum = kg_bench_gmm_constant(gmm);
    for (int i = 0; i < gmm->n; i++) {
      for (int k = 0; k < K; k++) {
        t[k] = alpha[k] + q[k] -
               0.5 * square_distance(gmm->x + (size_t)i * D, &mu[k * D], &d[k * D], &icf[k * S + D],
                                     c, y);
      }
      sum += log_sum_exp(t);
    }
    return sum - gmm->n * log_sum_exp(alpha) + prior(icf, d, q);
  }

  void record(bool keeps_values)
  {
    const int K = gmm->K, means = K * gmm->D, S = gmm->D * (gmm->D + 1) / 2;
    const double *theta = gmm->theta;
    start_tape(tag, keeps_values, operations());
    {
      adoubles alpha(K), mu(means), icf(K * S);
      for (adoubles *group : {&alpha, &mu, &icf}) {
        for (adouble &parameter : *group) {
          parameter <<= *theta++;
        }
      }
      adouble L = evaluate(alpha, mu, icf);
      L >>= value;
    }
    trace_off();
  }

  void run(double *answer) override
  {
    double one = 1.0;
    if (is_replayed) {
      zos_forward(tag, 1, gmm->parameter_count, 1, gmm->theta, &value);
    } else {
      record(true);
    }
    fos_reverse(tag, 1, gmm->parameter_count, &one, answer + 1);
    answer[0] = value;
  }
};

// ---- bundle adjustment --------------------------------------------------------------------------

void rotate(adouble Xc[3], const adouble r[3], const adouble v[3])
{
  adouble square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
  adouble a = sqrt(square), s = sin(a), c = cos(a);
  adouble e[3] = {r[0] / a, r[1] / a, r[2] / a};
  adouble along = (e[0] * v[0] + e[1] * v[1] + e[2] * v[2]) * (1.0 - c);
  Xc[0] = v[0] * c + (e[1] * v[2] - e[2] * v[1]) * s + e[0] * along;
  Xc[1] = v[1] * c + (e[2] * v[0] - e[0] * v[2]) * s + e[1] * along;
  Xc[2] = v[2] * c + (e[0] * v[1] - e[1] * v[0]) * s + e[2] * along;
}

template <class number> // of a feature: a parameter of the tape, or a constant
void observe(adouble residual[2], const adouble *camera, const adouble *X, const adouble &w,
             const number feature[2])
{
  adouble v[3], Xc[3], u[2];
  for (int j = 0; j < 3; j++) {
    v[j] = X[j] - camera[3 + j];
  }
  rotate(Xc, camera, v);
  u[0] = Xc[0] / Xc[2];
  u[1] = Xc[1] / Xc[2];
  adouble u2 = u[0] * u[0] + u[1] * u[1];
  adouble fd = camera[6] * (1.0 + u2 * (camera[9] + camera[10] * u2));
  for (int j = 0; j < 2; j++) {
    residual[j] = w * (fd * u[j] + camera[7 + j] - feature[j]);
  }
}

enum { N = KG_BENCH_BA_INPUTS, OPERATIONS = 120 }; // of an observation

// A tape of one observation, its feature being parameters of the tape: out[2] of in[15].
struct observation_peer : peer {
  const kg_bench_ba *ba;
  bool is_replayed;
  double in[N], out[2];

  observation_peer(const kg_bench_ba *data, bool replays)
      : peer(replays), ba(data), is_replayed(replays)
  {
    if (is_replayed) {
      kg_bench_ba_inputs(ba, ba->theta, 0, in);
      record(0, false);
    }
  }

  void record(int i, bool keeps_values)
  {
    start_tape(tag, keeps_values, 4096);
    {
      adouble x[N], residual[2];
      for (int j = 0; j < N; j++) {
        x[j] <<= in[j];
      }
      const double *feature = ba->feature + 2 * (size_t)i;
      if (is_replayed) {
        const pdouble variable[2] = {mkparam(feature[0]), mkparam(feature[1])};
        observe(residual, x, x + KG_BENCH_BA_CAMERA, x[N - 1], variable);
      } else {
        observe(residual, x, x + KG_BENCH_BA_CAMERA, x[N - 1], feature);
      }
      residual[0] >>= out[0];
      residual[1] >>= out[1];
    }
    trace_off();
  }

  void forward(int i)
  {
    kg_bench_ba_inputs(ba, ba->theta, i, in);
    if (is_replayed) {
      set_param_vec(tag, 2, ba->feature + 2 * (size_t)i);
      zos_forward(tag, 2, N, 1, in, out);
    } else {
      record(i, true);
    }
  }

  void run(double *answer) override
  {
    double unit[2][2] = {{1.0, 0.0}, {0.0, 1.0}};
    double *U[2] = {unit[0], unit[1]};
    double *weights = answer + (size_t)ba->p * 2 * N;
    if (!is_replayed) {
      empty_store();
    }
    for (int i = 0; i < ba->p; i++) {
      double *J = answer + (size_t)i * 2 * N;
      double *rows[2] = {J, J + N};
      forward(i);
      fov_reverse(tag, 2, N, 2, U, rows);
      weights[i] = -2.0 * in[N - 1]; // not worth a tape
    }
  }
};

// A tape of all observations, each with 15 inputs of its own: two reverse seeds, one that chooses all
// first residuals and one all second ones, give the whole Jacobian in one sweep.
struct jacobian_peer : peer {
  const kg_bench_ba *ba;
  bool is_replayed;
  std::vector<double> in, out, first, second, rows[2];

  jacobian_peer(const kg_bench_ba *data, bool replays)
      : peer(replays), ba(data), is_replayed(replays), in((size_t)ba->p * N),
        out(2 * (size_t)ba->p), first(out.size()), second(out.size()), rows{in, in}
  {
    for (int i = 0; i < ba->p; i++) {
      first[2 * (size_t)i] = 1.0;
      second[2 * (size_t)i + 1] = 1.0;
    }
    if (is_replayed) {
      load();
      record(false);
    }
  }

  void load()
  {
    for (int i = 0; i < ba->p; i++) {
      kg_bench_ba_inputs(ba, ba->theta, i, &in[(size_t)i * N]);
    }
  }

  void record(bool keeps_values)
  {
    start_tape(tag, keeps_values, (size_t)ba->p * OPERATIONS);
    for (int i = 0; i < ba->p; i++) {
      adouble x[N], residual[2];
      for (int j = 0; j < N; j++) {
        x[j] <<= in[(size_t)i * N + j];
      }
      observe(residual, x, x + KG_BENCH_BA_CAMERA, x[N - 1], ba->feature + 2 * (size_t)i);
      residual[0] >>= out[2 * (size_t)i];
      residual[1] >>= out[2 * (size_t)i + 1];
    }
    trace_off();
  }

  void run(double *answer) override
  {
    const int inputs = ba->p * N, outputs = 2 * ba->p;
    double *U[2] = {first.data(), second.data()}, *Z[2] = {rows[0].data(), rows[1].data()};
    double *weights = answer + (size_t)ba->p * 2 * N;
    load();
    if (is_replayed) {
      zos_forward(tag, outputs, inputs, 1, in.data(), out.data());
    } else {
      empty_store();
      record(true);
    }
    fov_reverse(tag, outputs, inputs, 2, U, Z);
    for (int i = 0; i < ba->p; i++) {
      for (int row = 0; row < 2; row++) {
        std::memcpy(answer + ((size_t)i * 2 + row) * N, Z[row] + (size_t)i * N, N * sizeof *answer);
      }
      weights[i] = -2.0 * in[(size_t)i * N + N - 1]; // not worth a tape
    }
  }
};

// The whole sum on one tape.
struct loss_peer : peer {
  const kg_bench_ba *ba;
  bool is_replayed;
  double loss = 0.0;

  loss_peer(const kg_bench_ba *data, bool replays) : peer(replays), ba(data), is_replayed(replays)
  {
    if (is_replayed) {
      record(false);
    }
  }

  void record(bool keeps_values)
  {
    start_tape(tag, keeps_values, (size_t)ba->p * OPERATIONS + (size_t)ba->parameter_count);
    {
      adoubles theta(ba->parameter_count);
      for (int i = 0; i < ba->parameter_count; i++) {
        theta[i] <<= ba->theta[i];
      }
      const adouble *points = &theta[ba->n * KG_BENCH_BA_CAMERA], *weights = points + ba->m * 3;
      adouble sum = 0.0;
      for (int i = 0; i < ba->p; i++) {
        adouble residual[2];
        observe(residual, &theta[ba->camera[i] * KG_BENCH_BA_CAMERA], points + ba->point[i] * 3,
                weights[i], ba->feature + 2 * (size_t)i);
        adouble weight_residual = 1.0 - weights[i] * weights[i];
        sum +=
          residual[0] * residual[0] + residual[1] * residual[1] + weight_residual * weight_residual;
      }
      sum *= 0.5;
      sum >>= loss;
    }
    trace_off();
  }

  void run(double *answer) override
  {
    double one = 1.0;
    if (is_replayed) {
      zos_forward(tag, 1, ba->parameter_count, 1, ba->theta, &loss);
    } else {
      empty_store();
      record(true);
    }
    fos_reverse(tag, 1, ba->parameter_count, &one, answer + 1);
    answer[0] = loss;
  }
};

// ---- nets ---------------------------------------------------------------------------------------

// A tape of one batch element, its input and target being parameters of the tape.
struct net_peer : peer {
  const kg_bench_net *net;
  bool is_replayed;
  int inputs, targets; // numbers of an element
  double loss = 0.0;
  std::vector<double> theta, data, gradient;

  net_peer(const kg_bench_net *problem, bool replays)
      : peer(replays), net(problem), is_replayed(replays), inputs(net->group * net->width[0]),
        targets(net->group * net->width[KG_BENCH_NET_LAYERS]),
        theta(net->theta, net->theta + net->parameter_count), data(inputs + targets),
        gradient(net->parameter_count)
  {
    if (is_replayed) {
      load(0);
      record(false);
    }
  }

  void load(int b)
  {
    const float *x = net->x + (size_t)b * inputs, *target = net->target + (size_t)b * targets;
    for (int i = 0; i < inputs; i++) {
      data[i] = x[i];
    }
    for (int i = 0; i < targets; i++) {
      data[inputs + i] = target[i];
    }
  }

  size_t operations() const
  {
    size_t products = 0;
    for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
      products += (size_t)net->group * kg_bench_net_inputs(net, l) * kg_bench_net_outputs(net, l);
      products += (size_t)net->group * net->group * kg_bench_net_inputs(net, l);
    }
    return 2 * products + 4 * (size_t)net->parameter_count + 4096;
  }

  adoubles gather(const adoubles &H, int width) const
  {
    const int n = net->group, taps = net->taps;
    adoubles u((size_t)n * taps * width);
    for (int i = 0; i < n; i++) {
      for (int s = 0; s < taps; s++) {
        adouble *ui = &u[((size_t)i * taps + s) * width];
        for (int c = 0; c < width; c++) {
          ui[c] = 0.0;
        }
        for (int j = 0; j < n; j++) {
          const double a = net->kind == KG_BENCH_GCN ? net->adjacency[i * n + j]
                                                     : j == i + (taps == 3 ? s - 1 : 0);
          for (int c = 0; c < width && a != 0.0; c++) {
            if (a == 1.0) {
              ui[c] = H[(size_t)j * width + c];
            } else {
              ui[c] += a * H[(size_t)j * width + c];
            }
          }
        }
      }
    }
    return u;
  }

  adouble activate(const adouble &z) const
  {
    return net->activation == KG_BENCH_RELU ? fmax(z, adouble(0.0)) : tanh(z);
  }

  // act(u W + b); the products are named in the order that lets ADOL-C fuse them into z
  adoubles layer(const adoubles &u, const adouble *W, int n_in, int n_out, bool is_last) const
  {
    const adouble *b = W + (size_t)n_in * n_out;
    adoubles H((size_t)net->group * n_out);
    for (int i = 0; i < net->group; i++) {
      for (int c = 0; c < n_out; c++) {
        adouble z = b[c];
        for (int k = 0; k < n_in; k++) {
          z += u[(size_t)i * n_in + k] * W[(size_t)k * n_out + c];
        }
        H[(size_t)i * n_out + c] = is_last ? z : activate(z);
      }
    }
    return H;
  }

  void record(bool keeps_values)
  {
    start_tape(tag, keeps_values, operations());
    {
      adoubles parameters(net->parameter_count), H(inputs);
      for (int i = 0; i < net->parameter_count; i++) {
        parameters[i] <<= theta[i];
      }
      for (int i = 0; i < inputs; i++) {
        H[i] = is_replayed ? adouble(mkparam(data[i])) : adouble(data[i]);
      }
      const adouble *W = parameters.data();
      for (int l = 0; l < KG_BENCH_NET_LAYERS; l++) {
        const int n_in = kg_bench_net_inputs(net, l), n_out = kg_bench_net_outputs(net, l);
        H = layer(gather(H, net->width[l]), W, n_in, n_out, l == KG_BENCH_NET_LAYERS - 1);
        W += (size_t)(n_in + 1) * n_out;
      }
      adouble sum = 0.0;
      for (int i = 0; i < targets; i++) {
        adouble d =
          H[i] - (is_replayed ? adouble(mkparam(data[inputs + i])) : adouble(data[inputs + i]));
        sum += d * d;
      }
      sum *= 0.5 / net->rows;
      sum >>= loss;
    }
    trace_off();
  }

  void run(double *answer) override
  {
    const int n = net->parameter_count;
    double one = 1.0;
    if (!is_replayed) {
      empty_store();
    }
    std::memset(answer, 0, (1 + (size_t)n) * sizeof *answer);
    for (int b = 0; b < net->batch; b++) {
      load(b);
      if (is_replayed) {
        set_param_vec(tag, inputs + targets, data.data());
        zos_forward(tag, 1, n, 1, theta.data(), &loss);
      } else {
        record(true);
      }
      fos_reverse(tag, 1, n, &one, gradient.data());
      answer[0] += loss;
      for (int i = 0; i < n; i++) {
        answer[1 + i] += gradient[i];
      }
    }
  }
};

template <class made, class... arguments> kg_status make(void **state, arguments... given)
try {
  *state = static_cast<peer *>(new made(given...));
  return KG_OK;
} catch (...) {
  *state = NULL;
  return KG_ERR_NO_MEMORY; // the only thing these constructors can fail for
}

const kg_bench_gmm *gmm_of(const void *data)
{
  return static_cast<const kg_bench_gmm *>(data);
}
const kg_bench_ba *ba_of(const void *data)
{
  return static_cast<const kg_bench_ba *>(data);
}
const kg_bench_net *net_of(const void *data)
{
  return static_cast<const kg_bench_net *>(data);
}

} // namespace

extern "C" {

kg_status kg_adolc_gmm_retaped(void **state, const void *data, const kg_allocator *)
{
  return make<gmm_peer>(state, gmm_of(data), false);
}

kg_status kg_adolc_gmm_replayed(void **state, const void *data, const kg_allocator *)
{
  return make<gmm_peer>(state, gmm_of(data), true);
}

kg_status kg_adolc_ba_jacobian_retaped(void **state, const void *data, const kg_allocator *)
{
  return make<jacobian_peer>(state, ba_of(data), false);
}

kg_status kg_adolc_ba_jacobian_replayed(void **state, const void *data, const kg_allocator *)
{
  return make<jacobian_peer>(state, ba_of(data), true);
}

kg_status kg_adolc_ba_observation_retaped(void **state, const void *data, const kg_allocator *)
{
  return make<observation_peer>(state, ba_of(data), false);
}

kg_status kg_adolc_ba_observation_replayed(void **state, const void *data, const kg_allocator *)
{
  return make<observation_peer>(state, ba_of(data), true);
}

kg_status kg_adolc_ba_loss_retaped(void **state, const void *data, const kg_allocator *)
{
  return make<loss_peer>(state, ba_of(data), false);
}

kg_status kg_adolc_ba_loss_replayed(void **state, const void *data, const kg_allocator *)
{
  return make<loss_peer>(state, ba_of(data), true);
}

kg_status kg_adolc_net_retaped(void **state, const void *data, const kg_allocator *)
{
  return make<net_peer>(state, net_of(data), false);
}

kg_status kg_adolc_net_replayed(void **state, const void *data, const kg_allocator *)
{
  return make<net_peer>(state, net_of(data), true);
}

kg_status kg_adolc_run(void *state, double *answer)
try {
  static_cast<peer *>(state)->run(answer);
  return KG_OK;
} catch (...) {
  return KG_ERR_NO_MEMORY;
}

void kg_adolc_destroy(void *state)
{
  delete static_cast<peer *>(state);
}
}
