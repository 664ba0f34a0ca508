/* Loss of a recurrent net that predicts the next character, ADBench's LSTM: diagonal cells, in
 * straight loops over `number`, which the including file defines (double, double complex).
 *
 *   f, o = sigmoid(w x + b),  i = sigmoid(w h + b),  c = tanh(w h + b)
 *   m <- m f + i c,  h <- o tanh m,  h is the next layer's x
 *   loss = - sum gold (y - log(2 + sum exp y)) / count */
#include <string.h>
#include <tgmath.h>

#include "bench/autodiff/problems.h"

static inline number sigmoid(number a)
{
  return 1.0 / (1.0 + exp(-a));
}

/* w: 4 rows of weights and 4 of biases: forget, in, out, change */
static inline void step_cell(size_t n, const number *restrict w, const number *restrict x,
                             number *restrict hidden, number *restrict memory)
{
  const number *b = w + 4 * n;
  for (size_t j = 0; j < n; j++) {
    const number forget = sigmoid(x[j] * w[j] + b[j]);
    const number in = sigmoid(hidden[j] * w[n + j] + b[n + j]);
    const number out = sigmoid(x[j] * w[2 * n + j] + b[2 * n + j]);
    const number change = tanh(hidden[j] * w[3 * n + j] + b[3 * n + j]);
    memory[j] = memory[j] * forget + in * change;
    hidden[j] = out * tanh(memory[j]);
  }
}

/* sum of gold (y - log(2 + sum exp y)) */
static inline number agreement(size_t n, const number *restrict y, const double *restrict gold)
{
  number sum = 2.0, total = 0.0;
  for (size_t j = 0; j < n; j++) {
    sum += exp(y[j]);
  }
  const number height = log(sum);
  for (size_t j = 0; j < n; j++) {
    total += gold[j] * (y[j] - height);
  }
  return total;
}

/* work: 2 layers + 1 rows of n */
static inline number lstm_loss(const kg_bench_lstm *lstm, const number *restrict theta,
                               number *restrict work)
{
  const size_t n = (size_t)lstm->bits, layers = (size_t)lstm->layers;
  const number *extra = theta + layers * 8 * n;
  number *x = work + 2 * layers * n, total = 0.0;
  for (size_t j = 0; j < 2 * layers * n; j++) {
    work[j] = lstm->state[j];
  }
  for (size_t t = 0; t + 1 < (size_t)lstm->length; t++) {
    for (size_t j = 0; j < n; j++) {
      x[j] = lstm->text[t * n + j] * extra[j];
    }
    for (size_t l = 0; l < layers; l++) {
      step_cell(n, theta + l * 8 * n, x, work + 2 * l * n, work + (2 * l + 1) * n);
      memcpy(x, work + 2 * l * n, n * sizeof *x);
    }
    for (size_t j = 0; j < n; j++) {
      x[j] = x[j] * extra[n + j] + extra[2 * n + j];
    }
    total += agreement(n, x, lstm->text + (t + 1) * n);
  }
  return -total / (double)((size_t)(lstm->length - 1) * n);
}
