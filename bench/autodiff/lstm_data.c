/* A recurrent net with random numbers, and its gradient by complex steps. */
#include <complex.h>
#include <stdlib.h>

#define number double complex
#include "bench/autodiff/lstm_loops.h"
#include "kinegrad/random.h"

size_t kg_bench_lstm_work(const kg_bench_lstm *lstm)
{
  return (2 * (size_t)lstm->layers + 1) * (size_t)lstm->bits;
}

kg_status kg_bench_lstm_create(kg_bench_lstm **lstm_out, int bits, int layers, int length,
                               uint64_t seed)
{
  *lstm_out = NULL;
  kg_bench_lstm *lstm = calloc(1, sizeof *lstm);
  if (!lstm) return KG_ERR_NO_MEMORY;
  kg_arena_init(&lstm->arena, NULL);
  *lstm = (kg_bench_lstm){bits, layers, length, .arena = lstm->arena};
  const size_t state = 2 * (size_t)layers * (size_t)bits, text = (size_t)length * (size_t)bits;
  lstm->parameter_count = (8 * layers + 3) * bits;
  lstm->theta = KG_ARENA_ARRAY(&lstm->arena, double, lstm->parameter_count);
  lstm->state = KG_ARENA_ARRAY(&lstm->arena, double, state);
  lstm->text = KG_ARENA_ARRAY(&lstm->arena, double, text);
  if (kg_arena_failed(&lstm->arena)) {
    kg_bench_lstm_destroy(lstm);
    return KG_ERR_NO_MEMORY;
  }
  kg_random random = kg_random_make(seed);
  for (int i = 0; i < lstm->parameter_count; i++) {
    lstm->theta[i] = kg_random_normal(&random);
  }
  for (size_t i = 0; i < state; i++) {
    lstm->state[i] = kg_random_normal(&random);
  }
  for (size_t i = 0; i < text; i++) {
    lstm->text[i] = kg_random_uniform(&random) < 0.5;
  }
  *lstm_out = lstm;
  return KG_OK;
}

void kg_bench_lstm_destroy(kg_bench_lstm *lstm)
{
  if (lstm) kg_arena_release(&lstm->arena);
  free(lstm);
}

kg_status kg_bench_lstm_reference(const kg_bench_lstm *lstm, double *loss, double *gradient)
{
  const size_t count = (size_t)lstm->parameter_count;
  number *theta = malloc((count + kg_bench_lstm_work(lstm)) * sizeof *theta);
  if (!theta) return KG_ERR_NO_MEMORY;
  for (size_t i = 0; i < count; i++) {
    theta[i] = lstm->theta[i];
  }
  for (size_t i = 0; i < count; i++) {
    theta[i] = lstm->theta[i] + 1e-100 * I;
    const number at = lstm_loss(lstm, theta, theta + count);
    theta[i] = lstm->theta[i];
    *loss = creal(at);
    gradient[i] = cimag(at) / 1e-100;
  }
  free(theta);
  return KG_OK;
}
