/* bench/autodiff/problems.h - the problems on which gradients are timed: four objectives of ADBench
 * (F. Srajer, Z. Kukelova, A. Fitzgibbon, A benchmark of selected algorithmic differentiation tools
 * on some problems in computer vision and machine learning, Optim. Methods Softw. 33 (2018)) and
 * three nets; each with a plain evaluation, in straight loops, that knows nothing of the library. */
#ifndef BENCH_AUTODIFF_PROBLEMS_H
#define BENCH_AUTODIFF_PROBLEMS_H

#include "kinegrad/arena.h"

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Gaussian mixture ------------------------------------------------------------------------ */

/* theta: weights alpha (K), means mu (K x D), icf (K x D(D+1)/2), each row the D logarithms of the
 * diagonal of Q_k and then its strict lower triangle column by column. */
typedef struct kg_bench_gmm {
  int D, K, n;
  double gamma; /* of the Wishart prior */
  int m;
  int parameter_count;
  double *theta; /* (parameter_count) */
  double *x;     /* (n x D)           */
  kg_arena arena;
} kg_bench_gmm;

/* Reads "D K n", theta, x, "gamma m". On failure *gmm is NULL. */
kg_status kg_bench_gmm_read(kg_bench_gmm **gmm, const char *path, kg_error *error);
/* Random numbers of the same distribution and size, with gamma = 1, m = 0. */
kg_status kg_bench_gmm_synthetic(kg_bench_gmm **gmm, int D, int K, int n, uint64_t seed);
void kg_bench_gmm_destroy(kg_bench_gmm *gmm);

/* Numbers of work memory that the two functions below need. */
size_t kg_bench_gmm_work(const kg_bench_gmm *gmm);
/* The log posterior at theta. */
double kg_bench_gmm_value(const kg_bench_gmm *gmm, const double *theta, double *work);
/* The same, compiled with -O2: the faster of the two where D is small. */
double kg_bench_gmm_value_O2(const kg_bench_gmm *gmm, const double *theta, double *work);
/* The same and its gradient (parameter_count), derived by hand. */
double kg_bench_gmm_gradient(const kg_bench_gmm *gmm, const double *theta, double *gradient,
                             double *work);
/* The part of it that depends on no parameter: - n D/2 log(2 pi) - K C. */
double kg_bench_gmm_constant(const kg_bench_gmm *gmm);

/* ---- bundle adjustment ----------------------------------------------------------------------- */

enum { KG_BENCH_BA_CAMERA = 11, KG_BENCH_BA_INPUTS = 15 };

/* theta: cameras (n x 11: r 3, C 3, f, x0 2, k 2), points (m x 3), weights (p). */
typedef struct kg_bench_ba {
  int n, m, p;
  int parameter_count;
  double *theta;       /* (parameter_count)               */
  double *feature;     /* (p x 2)                         */
  int *camera, *point; /* (p) which ones an observation joins */
  kg_arena arena;
} kg_bench_ba;

/* Reads "n m p", one camera, point, weight and feature, which all of them equal. */
kg_status kg_bench_ba_read(kg_bench_ba **ba, const char *path, kg_error *error);
kg_status kg_bench_ba_synthetic(kg_bench_ba **ba, int n, int m, int p);
/* Changes every number by up to 2 % of its size (at least 1e-3), each differently, so that a wrong
 * index shows in the answer. */
void kg_bench_ba_perturb(kg_bench_ba *ba, uint64_t seed);
void kg_bench_ba_destroy(kg_bench_ba *ba);

/* The 15 inputs of observation i: camera, point, weight. */
void kg_bench_ba_inputs(const kg_bench_ba *ba, const double *theta, int i, double *inputs);
/* residuals: (p x 2) of the features, then (p) of the weights. */
void kg_bench_ba_residuals(const kg_bench_ba *ba, const double *theta, double *residuals);
/* Half the sum of the squares of all residuals. */
double kg_bench_ba_loss(const kg_bench_ba *ba, const double *theta);

/* The same by another road, with complex steps: slow, exact to rounding.
 *   residuals (3 p) as above; jacobian: (p x 2 x 15), then (p) of the weights; gradient: of the
 *   loss (parameter_count). Each may be NULL. */
void kg_bench_ba_reference(const kg_bench_ba *ba, const double *theta, double *residuals,
                           double *jacobian, double *gradient);

/* ---- nets ------------------------------------------------------------------------------------ */

enum { KG_BENCH_NET_LAYERS = 3 };

typedef enum kg_bench_net_kind {
  KG_BENCH_MLP, /* a row is a sample                                                            */
  KG_BENCH_TCN, /* rows of an element are frames; a frame sees itself and its two neighbours,
                   zeros beyond the ends                                                        */
  KG_BENCH_GCN  /* rows of an element are the nodes of a tree, mixed by the adjacency           */
} kg_bench_net_kind;

typedef enum kg_bench_activation { KG_BENCH_RELU, KG_BENCH_TANH } kg_bench_activation;

/* Layer l: H <- act(G(H) W_l + b_l), the last one without act; G as the kind says. Loss: the sum of
 * the squares of output - target over 2 x rows. Everything row-major and float. */
typedef struct kg_bench_net {
  kg_bench_net_kind kind;
  kg_bench_activation activation;
  int width[KG_BENCH_NET_LAYERS + 1]; /* of the input and of the layers             */
  int batch, group;                   /* elements, rows of an element               */
  int rows;                           /* batch x group                              */
  int taps;                           /* of G: inputs of a layer are taps x width   */
  int parameter_count;
  float *theta;     /* W_0 (taps width_0 x width_1), b_0, W_1, b_1, ...               */
  float *x;         /* (rows x width_0)                                               */
  float *target;    /* (rows x width_3)                                               */
  float *adjacency; /* GCN: (group x group), D^-1/2 (A + I) D^-1/2 of a random tree   */
  kg_arena arena;
} kg_bench_net;

kg_status kg_bench_net_create(kg_bench_net **net, kg_bench_net_kind kind,
                              kg_bench_activation activation,
                              const int width[KG_BENCH_NET_LAYERS + 1], int batch, int group,
                              uint64_t seed);
void kg_bench_net_destroy(kg_bench_net *net);
/* Inputs and outputs of layer l. */
int kg_bench_net_inputs(const kg_bench_net *net, int l);
int kg_bench_net_outputs(const kg_bench_net *net, int l);

/* Loss and gradient (parameter_count) in plain double loops, element by element. */
kg_status kg_bench_net_gradient(const kg_bench_net *net, double *loss, double *gradient);

/* The matrix products of a forward and backward pass and nothing else, by OpenBLAS: per layer
 * y = u W, dW = u' dy and, but for the first layer, whose input needs no derivative, du = dy W'. */
typedef struct kg_bench_products kg_bench_products;
kg_status kg_bench_products_create(kg_bench_products **products, const kg_bench_net *net);
void kg_bench_products_run(kg_bench_products *products);
void kg_bench_products_destroy(kg_bench_products *products);
/* Floating-point operations of one run. */
double kg_bench_products_flops(const kg_bench_products *products);

/* ---- recurrent net --------------------------------------------------------------------------- */

/* theta: of each layer 4 rows of weights and 4 of biases, (layers x 8 x bits); then 3 rows: factors
 * of the input, factors and terms of the output. All numbers random (lstm_loops.h has the formulas). */
typedef struct kg_bench_lstm {
  int bits, layers, length;
  int parameter_count;
  double *theta; /* (parameter_count)                       */
  double *state; /* (layers x 2 x bits) hidden, memory       */
  double *text;  /* (length x bits) of zeros and ones        */
  kg_arena arena;
} kg_bench_lstm;

kg_status kg_bench_lstm_create(kg_bench_lstm **lstm, int bits, int layers, int length,
                               uint64_t seed);
void kg_bench_lstm_destroy(kg_bench_lstm *lstm);
/* Numbers of work memory. */
size_t kg_bench_lstm_work(const kg_bench_lstm *lstm);
double kg_bench_lstm_loss(const kg_bench_lstm *lstm, const double *theta, double *work);
/* Loss and gradient by complex steps: slow, exact to rounding. */
kg_status kg_bench_lstm_reference(const kg_bench_lstm *lstm, double *loss, double *gradient);

/* ---- hand ------------------------------------------------------------------------------------ */

enum { KG_BENCH_HAND_POSE = 26 }; /* rotation vector, translation, 4 angles of each finger */

/* All numbers random (hand_loops.h has the formulas). */
typedef struct kg_bench_hand {
  int bones, vertices, correspondences;
  bool complicated;       /* residuals of points on triangles, two parameters for each */
  int *parent;            /* (bones) -1 for the first                                  */
  int *angle;             /* (bones x 2) entries of theta: about x, y; -1 for none     */
  double *base, *inverse; /* (bones x 4 x 4)                                  */
  double *points;         /* (4 x vertices), the last row ones                */
  double *weight;         /* (bones x vertices)                               */
  double *theta;          /* pose, (correspondences x 2)                      */
  int32_t *corner;        /* (correspondences x 3) vertices                   */
  double *target;         /* (correspondences x 3)                            */
  kg_arena arena;
} kg_bench_hand;

kg_status kg_bench_hand_create(kg_bench_hand **hand, int vertices, int correspondences,
                               bool complicated, uint64_t seed);
void kg_bench_hand_destroy(kg_bench_hand *hand);
size_t kg_bench_hand_work(const kg_bench_hand *hand);
/* of the Jacobian: the pose, and where complicated a residual's own two parameters */
int kg_bench_hand_columns(const kg_bench_hand *hand);
void kg_bench_hand_residuals(const kg_bench_hand *hand, const double *theta, double *residual,
                             double *work);
/* residual (3 correspondences), J (3 correspondences x columns) by complex steps. */
kg_status kg_bench_hand_reference(const kg_bench_hand *hand, double *residual, double *J);

#ifdef __cplusplus
}
#endif
#endif
