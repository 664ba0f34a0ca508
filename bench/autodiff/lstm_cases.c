/* Gradient of the recurrent net's loss by all its weights. An answer is the loss and the gradient by
 * the cells and by the input's and output's parameters. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/cases.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"

enum { LOSS = 1, GRADIENT = 7 };

enum { BITS = 14, LAYERS = 2, LENGTH = 1024 };

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  (void)setting, (void)detail;
  kg_bench_lstm *lstm = NULL;
  if (kg_bench_lstm_create(&lstm, BITS, LAYERS, LENGTH, 1) != KG_OK) {
    return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "not enough memory for a recurrent net");
  }
  snprintf(problem->source, sizeof problem->source, "random, %d layers of %d bits, %d characters",
           LAYERS, BITS, LENGTH);
  problem->parts[0] = (kg_bench_part){"loss", 1, 1};
  problem->parts[1] = (kg_bench_part){"d/d cells", LAYERS * 8 * BITS, 1};
  problem->parts[2] = (kg_bench_part){"d/d input and output", 3 * BITS, 1};
  problem->part_count = 3;
  problem->items = 1.0;
  problem->data = lstm;
  return KG_OK;
}

static void close(kg_bench_problem *problem)
{
  kg_bench_lstm_destroy(problem->data);
}

static kg_status reference(const void *data, double *answer)
{
  return kg_bench_lstm_reference(data, answer, answer + 1);
}

/* ---- plain C --------------------------------------------------------------------------------- */

typedef struct plain {
  const kg_bench_lstm *lstm;
  double work[];
} plain;

static kg_status create_plain(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  plain *p = malloc(sizeof *p + kg_bench_lstm_work(data) * sizeof(double));
  if (!p) return KG_ERR_NO_MEMORY;
  p->lstm = data;
  *state = p;
  return KG_OK;
}

static kg_status run_plain(void *state, double *answer)
{
  plain *p = state;
  answer[0] = kg_bench_lstm_loss(p->lstm, p->lstm->theta, p->work);
  return KG_OK;
}

/* ---- kinegrad -------------------------------------------------------------------------------- */

typedef struct net {
  const kg_bench_lstm *lstm;
  kg_tape *tape;
  kg_program *program; /* of the second contestant */
  kg_tape_mark recorded;
  kg_value state[2 * LAYERS], text[LENGTH];
} net;

static void destroy_net(void *state)
{
  net *n = state;
  kg_program_destroy(n->program);
  kg_tape_destroy(n->tape);
  free(n);
}

static kg_status create_net(void **state, const void *data, const kg_allocator *allocator)
{
  net *n = calloc(1, sizeof *n);
  if (!n) return KG_ERR_NO_MEMORY;
  kg_tape_def def = kg_tape_default_def();
  def.allocator = allocator;
  n->lstm = data;
  const kg_status status = kg_tape_create(&def, &n->tape, NULL);
  if (status != KG_OK) {
    destroy_net(n);
    return status;
  }
  for (int i = 0; i < 2 * LAYERS; i++) {
    n->state[i] = kg_constant(n->tape, KG_SHAPE(BITS), n->lstm->state + i * BITS);
  }
  for (int t = 0; t < LENGTH; t++) {
    n->text[t] = kg_constant(n->tape, KG_SHAPE(BITS), n->lstm->text + t * BITS);
  }
  n->recorded = kg_tape_mark_of(n->tape);
  *state = n;
  return kg_tape_status(n->tape);
}

/* the rows of a matrix, each a vector */
static void take_rows(kg_tape *t, kg_value matrix, int count, kg_value *rows)
{
  for (int i = 0; i < count; i++) {
    rows[i] = kg_reshape(t, kg_slice(t, matrix, 0, i, 1), KG_SHAPE(BITS));
  }
}

static kg_value scaled(kg_tape *t, kg_value x, kg_value factor, kg_value term)
{
  return kg_add(t, kg_mul(t, x, factor), term);
}

static void step_cell(kg_tape *t, const kg_value *w, kg_value x, kg_value *state)
{
  const kg_value *b = w + 4;
  const kg_value forget = kg_sigmoid(t, scaled(t, x, w[0], b[0]));
  const kg_value in = kg_sigmoid(t, scaled(t, state[0], w[1], b[1]));
  const kg_value out = kg_sigmoid(t, scaled(t, x, w[2], b[2]));
  const kg_value change = kg_tanh(t, scaled(t, state[0], w[3], b[3]));
  state[1] = kg_add(t, kg_mul(t, state[1], forget), kg_mul(t, in, change));
  state[0] = kg_mul(t, out, kg_tanh(t, state[1]));
}

static kg_value record_loss(const net *n, kg_value cells, kg_value extra)
{
  kg_tape *t = n->tape;
  kg_value state[2 * LAYERS], w[LAYERS * 8], e[3], terms[LENGTH - 1];
  double factors[LENGTH - 1];
  take_rows(t, cells, LAYERS * 8, w);
  take_rows(t, extra, 3, e);
  for (int i = 0; i < 2 * LAYERS; i++) {
    state[i] = n->state[i];
  }
  for (int i = 0; i + 1 < LENGTH; i++) {
    kg_value x = kg_mul(t, n->text[i], e[0]);
    for (int l = 0; l < LAYERS; l++) {
      step_cell(t, w + l * 8, x, state + 2 * l);
      x = state[2 * l];
    }
    x = scaled(t, x, e[1], e[2]);
    const kg_value height = kg_log(t, kg_shift(t, kg_sum(t, kg_exp(t, x), 0), 2));
    terms[i] = kg_dot(t, n->text[i + 1], kg_sub(t, x, height), 0);
    factors[i] = -1.0 / ((LENGTH - 1) * BITS);
  }
  return kg_combine(t, LENGTH - 1, factors, terms);
}

static kg_value record_inputs(const net *n, kg_value inputs[2])
{
  kg_tape_rewind(n->tape, n->recorded);
  inputs[0] = kg_input(n->tape, KG_SHAPE(LAYERS * 8, BITS), n->lstm->theta);
  inputs[1] = kg_input(n->tape, KG_SHAPE(3, BITS), n->lstm->theta + LAYERS * 8 * BITS);
  return record_loss(n, inputs[0], inputs[1]);
}

static kg_status run_tape(void *state, double *answer)
{
  const net *n = state;
  kg_value inputs[2];
  const kg_value loss = record_inputs(n, inputs);
  double *const gradients[2] = {answer + 1, answer + 1 + LAYERS * 8 * BITS};
  answer[0] = kg_item(n->tape, loss);
  return kg_gradient(n->tape, loss, 2, inputs, gradients);
}

static kg_status create_program(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_net(state, data, allocator);
  if (status != KG_OK) return status;
  net *n = *state;
  kg_value inputs[2];
  const kg_value loss = record_inputs(n, inputs);
  kg_program_def def = kg_program_default_def();
  def.allocator = allocator;
  status = kg_program_create(&def, n->tape, 2, inputs, 1, &loss, &n->program, NULL);
  kg_tape_destroy(n->tape);
  n->tape = NULL;
  return status;
}

static kg_status run_program(void *state, double *answer)
{
  kg_program *p = ((net *)state)->program;
  const double *theta = ((net *)state)->lstm->theta;
  const size_t sizes[2] = {LAYERS * 8 * BITS, 3 * BITS};
  memcpy(kg_program_input(p, 0), theta, sizes[0] * sizeof *theta);
  memcpy(kg_program_input(p, 1), theta + sizes[0], sizes[1] * sizeof *theta);
  kg_status status = kg_program_run(p);
  double *seed = kg_program_seed(p, 0, 1);
  if (status != KG_OK || !seed) return status != KG_OK ? status : KG_ERR_NO_MEMORY;
  answer[0] = *(const double *)kg_program_output(p, 0);
  *seed = 1.0;
  status = kg_program_backward(p, 1);
  if (status != KG_OK) return status;
  memcpy(answer + 1, kg_program_adjoint(p, 0), sizes[0] * sizeof *theta);
  memcpy(answer + 1 + sizes[0], kg_program_adjoint(p, 1), sizes[1] * sizeof *theta);
  return KG_OK;
}

/* ---- the case -------------------------------------------------------------------------------- */

enum { PLAIN, TAPE, PROGRAM, CONTESTANTS };

static const kg_bench_contestant contestants[CONTESTANTS] = {
  [PLAIN] = {"plain loss, -O3", NULL, LOSS, create_plain, run_plain, free},
  [TAPE] = {"kinegrad tape", NULL, GRADIENT, create_net, run_tape, destroy_net},
  [PROGRAM] = {"kinegrad program", NULL, GRADIENT, create_program, run_program, destroy_net},
};

static const kg_bench_pair pairs[] = {{"kinegrad tape", TAPE, PLAIN, 4.0},
                                      {"kinegrad program", PROGRAM, PLAIN, 4.0}};

const kg_bench_case kg_bench_lstm_cases[BENCH_LSTM_CASES] = {
  {.name = "lstm_l2_c1024",
   .unit = "ms",
   .unit_seconds = 1e-3,
   .tolerance = 1e-11,
   .open = open,
   .close = close,
   .reference = reference,
   .contestants = contestants,
   .contestant_count = CONTESTANTS,
   .pairs = pairs,
   .pair_count = KG_COUNT_OF(pairs)},
};
