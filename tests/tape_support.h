/* Checks of recorded operators against answers that do not use their adjoint rules.
 *
 *   check_operator   VJP and JVP against complex steps through the complex kernels, entry by entry, and the
 *                    dot test
 *   check_lanes      each kernel run on several lanes gives, lane for lane, the numbers of one lane (sums may
 *                    be taken in another order)
 *
 * Both take a tape on which `output` was recorded from `inputs`. */
#ifndef TESTS_TAPE_SUPPORT_H
#define TESTS_TAPE_SUPPORT_H

#include "autodiff/attributes.h"
#include "autodiff/tape.h"
#include "kinegrad/derivatives.h"
#include "support.h"

#include <complex.h>

typedef double _Complex complex_number;

/* the elementwise attributes of a scalar node: one entry and its constant */
static inline kg_elementwise scalar_attributes(const kg_node *node)
{
  return (kg_elementwise){.p = node->partial[1]};
}

static inline size_t node_size(const kg_node *node)
{
  return node->is_block ? node->is.block->size : 1;
}

/* One node evaluated again, in any arithmetic and any number of lanes, from operand arrays. */
static inline kg_status run_node(const kg_node *node, const kg_kernel *kernels, size_t number,
                                 size_t lanes, void *const *numbers, void *out, void *saved,
                                 kg_call *call, const void **in)
{
  static kg_elementwise scalar[2];
  scalar[0] = scalar_attributes(node);
  *call = (kg_call){
    .attributes = &scalar[0], .size = 1, .lanes = lanes, .in = in, .out = out, .saved = saved};
  if (node->is_block) {
    const kg_block *block = node->is.block;
    call->attributes = block->attributes;
    call->size = block->size;
    call->count = block->count;
    for (int i = 0; i < block->count; ++i) {
      in[i] = numbers[kg_index(block->input[i])];
    }
  } else {
    call->count = node->input[1] ? 2 : 1;
    in[0] = numbers[kg_index(node->input[0])];
    in[1] = numbers[kg_index(node->input[1])];
    if (node->op == kg_op_element) { /* the index is not an operand */
      static size_t index;
      index = node->input[1];
      call->attributes = &index;
      call->count = 1;
    }
  }
  (void)number;
  return kernels[node->op].forward(call);
}

static inline bool is_leaf(const kg_node *node)
{
  return node->op == kg_op_input || node->op == kg_op_constant;
}

/* Im f(x + i h d) / h of `output` along tangents d of the inputs, into derivative */
static inline void complex_step(const kg_tape *tape, int count, const kg_value *inputs,
                                double *const *tangents, kg_value output, double *derivative)
{
  const double h = 1e-100;
  const kg_graph *graph = &tape->graph;
  complex_number **numbers = calloc(graph->count, sizeof *numbers);
  const void **in = calloc((size_t)graph->widest + 2, sizeof *in);
  assert_non_null(numbers);
  assert_non_null(in);
  for (uint32_t i = 0; i <= kg_index(output.id); ++i) {
    const kg_node *node = &graph->node[i];
    const size_t size = node_size(node);
    const size_t saved_size = node->is_block ? node->is.block->saved_size : 0;
    numbers[i] = calloc(size + 1, sizeof *numbers[i]);
    complex_number *saved = calloc(saved_size + 1, sizeof *saved);
    if (i == 0 || is_leaf(node)) {
      const double *data = kg_node_data(graph, node->is_block ? i | KG_TENSOR : i);
      for (size_t e = 0; e < size; ++e) {
        numbers[i][e] = data[e];
      }
      for (int k = 0; k < count; ++k) {
        for (size_t e = 0; i && kg_index(inputs[k].id) == i && e < size; ++e) {
          numbers[i][e] += CMPLX(0, h * tangents[k][e]);
        }
      }
    } else {
      kg_call call;
      assert_int_equal(run_node(node, kg_kernels_c64_base, sizeof(complex_number), 1,
                                (void *const *)numbers, numbers[i], saved, &call, in),
                       KG_OK);
    }
    free(saved);
  }
  for (size_t e = 0; e < kg_size_of(tape, output); ++e) {
    derivative[e] = cimag(numbers[kg_index(output.id)][e]) / h;
  }
  for (uint32_t i = 0; i < graph->count; ++i) {
    free(numbers[i]);
  }
  free(numbers);
  free(in);
}

static inline double *random_numbers(kg_random *random, size_t n)
{
  double *x = malloc((n + 1) * sizeof *x);
  assert_non_null(x);
  for (size_t i = 0; i < n; ++i) {
    x[i] = kg_random_normal(random);
  }
  return x;
}

static inline double inner(const double *a, const double *b, size_t n)
{
  double sum = 0;
  for (size_t i = 0; i < n; ++i) {
    sum += a[i] * b[i];
  }
  return sum;
}

static inline double largest(const double *a, size_t n)
{
  double most = 0;
  for (size_t i = 0; i < n; ++i) {
    most = fmax(most, fabs(a[i]));
  }
  return most;
}

/* JVP along a random direction, and up to `entries` random entries of the VJP, within tolerance of the
 * largest entry; the dot test to 1e-13 of the product of the norms. */
static inline void check_operator(kg_tape *tape, int count, const kg_value *inputs, kg_value output,
                                  kg_random *random, double tolerance)
{
  enum { MOST = 16, ENTRIES = 40 };
  if (!output.id) fail_msg("%s", kg_tape_error(tape)->text);
  assert_true(count <= MOST);
  const size_t m = kg_size_of(tape, output);
  double *d[MOST], *xw[MOST], *zero[MOST], *w = random_numbers(random, m);
  double *yd = malloc((m + 1) * sizeof *yd), *step = malloc((m + 1) * sizeof *step);
  for (int k = 0; k < count; ++k) {
    const size_t n = kg_size_of(tape, inputs[k]);
    d[k] = random_numbers(random, n);
    xw[k] = calloc(n + 1, sizeof *xw[k]);
    zero[k] = calloc(n + 1, sizeof *zero[k]);
  }
  assert_int_equal(kg_jvp(tape, 1, count, inputs, (const double *const *)d, 1, &output, &yd),
                   KG_OK);
  complex_step(tape, count, inputs, d, output, step);
  for (size_t e = 0; e < m; ++e) {
    if (!(fabs(yd[e] - step[e]) <= tolerance * fmax(largest(step, m), 1e-300))) {
      fail_msg("JVP entry %zu: %.17g, complex step %.17g", e, yd[e], step[e]);
    }
  }
  assert_int_equal(kg_vjp(tape, 1, 1, &output, (const double *const *)&w, count, inputs, xw),
                   KG_OK);
  double forward = inner(w, yd, m), backward = 0, size = sqrt(inner(w, w, m) * inner(yd, yd, m));
  for (int k = 0; k < count; ++k) {
    const size_t n = kg_size_of(tape, inputs[k]);
    backward += inner(xw[k], d[k], n);
    size += sqrt(inner(xw[k], xw[k], n) * inner(d[k], d[k], n));
    for (size_t tried = 0; tried < n && tried < ENTRIES; ++tried) {
      const size_t e = n <= ENTRIES ? tried : (size_t)(kg_random_uniform(random) * (double)n);
      zero[k][e] = 1;
      complex_step(tape, count, inputs, zero, output, step);
      zero[k][e] = 0;
      const double expected = inner(w, step, m);
      const double scale = fmax(largest(xw[k], n), largest(w, m) * largest(step, m));
      if (!(fabs(xw[k][e] - expected) <= tolerance * fmax(scale, 1e-300))) {
        fail_msg("VJP of input %d, entry %zu: %.17g, complex step %.17g", k, e, xw[k][e], expected);
      }
    }
  }
  if (!(fabs(forward - backward) <= 1e-13 * size)) {
    fail_msg("dot test: %.17g against %.17g, norms %g", forward, backward, size);
  }
  for (int k = 0; k < count; ++k) {
    free(d[k]);
    free(xw[k]);
    free(zero[k]);
  }
  free(w);
  free(yd);
  free(step);
}

/* The node of output, run on LANES lanes with different numbers in each. */
static inline void check_lanes(const kg_tape *tape, kg_value output, kg_random *random)
{
  enum { LANES = 3, MOST = 16 };
  const kg_graph *graph = &tape->graph;
  const kg_node *node = &graph->node[kg_index(output.id)];
  assert_true(node->is_block);
  const kg_block *block = node->is.block;
  assert_true(block->count <= MOST);
  const size_t m = block->size;
  size_t terms = m; /* of a sum, at most: its rounding error grows with their root */
  double *wide[MOST], *one[MOST], *wide_adjoint[MOST], *one_adjoint[MOST];
  double *wide_tangent[MOST], *one_tangent[MOST];
  const void *in[MOST];
  size_t n[MOST];
  double *out = calloc(m * LANES + 1, sizeof *out), *out_one = calloc(m + 1, sizeof *out_one);
  double *saved = calloc(block->saved_size * LANES + 1, sizeof *saved);
  double *t = random_numbers(random, m * LANES), *t_one = random_numbers(random, m);
  double *w = random_numbers(random, m * LANES), *w_one = calloc(m + 1, sizeof *w_one);
  for (int k = 0; k < block->count; ++k) {
    const kg_node *operand = &graph->node[kg_index(block->input[k])];
    const double *data = kg_node_data(graph, block->input[k]);
    n[k] = node_size(operand);
    terms = n[k] > terms ? n[k] : terms;
    wide[k] = malloc((n[k] * LANES + 1) * sizeof(double));
    one[k] = calloc(n[k] + 1, sizeof(double));
    wide_adjoint[k] = calloc(n[k] * LANES + 1, sizeof(double));
    one_adjoint[k] = calloc(n[k] + 1, sizeof(double));
    wide_tangent[k] = random_numbers(random, n[k] * LANES);
    one_tangent[k] = calloc(n[k] + 1, sizeof(double));
    for (size_t i = 0; i < n[k] * LANES; ++i) {
      const bool mask = data[i / LANES] == 0 || data[i / LANES] == 1;
      wide[k][i] = data[i / LANES] * (mask ? 1 : 1 + 0.01 * kg_random_uniform(random));
    }
  }
  const kg_kernel *kernel = &graph->kernels[node->op];
  const double tolerance = 1e-14 * sqrt((double)terms);
  kg_call call = {block->attributes, m, LANES, block->count, in, out, saved, NULL, 0};
  for (int k = 0; k < block->count; ++k) {
    in[k] = wide[k];
  }
  assert_int_equal(kernel->forward(&call), KG_OK);
  kernel->vjp(&call, w, (void *const *)wide_adjoint);
  kernel->jvp(&call, (const void *const *)wide_tangent, t);
  for (size_t lane = 0; lane < LANES; ++lane) {
    kg_call single = {block->attributes, m, 1, block->count, in, out_one, saved, NULL, 0};
    for (int k = 0; k < block->count; ++k) {
      for (size_t e = 0; e < n[k]; ++e) {
        one[k][e] = wide[k][e * LANES + lane];
        one_tangent[k][e] = wide_tangent[k][e * LANES + lane];
        one_adjoint[k][e] = 0;
      }
      in[k] = one[k];
    }
    for (size_t e = 0; e < m; ++e) {
      w_one[e] = w[e * LANES + lane];
    }
    assert_int_equal(kernel->forward(&single), KG_OK);
    kernel->vjp(&single, w_one, (void *const *)one_adjoint);
    kernel->jvp(&single, (const void *const *)one_tangent, t_one);
    for (size_t e = 0; e < m; ++e) {
      const double difference = fabs(out[e * LANES + lane] - out_one[e]);
      const double moved = fabs(t[e * LANES + lane] - t_one[e]);
      assert_at_most(difference, tolerance * fmax(largest(out_one, m), 1e-300));
      assert_at_most(moved, tolerance * fmax(largest(t_one, m), 1e-300));
    }
    for (int k = 0; k < block->count; ++k) {
      for (size_t e = 0; e < n[k]; ++e) {
        const double difference = fabs(wide_adjoint[k][e * LANES + lane] - one_adjoint[k][e]);
        assert_at_most(difference, tolerance * fmax(largest(one_adjoint[k], n[k]), 1e-300));
      }
    }
  }
  for (int k = 0; k < block->count; ++k) {
    free(wide[k]);
    free(one[k]);
    free(wide_adjoint[k]);
    free(one_adjoint[k]);
    free(wide_tangent[k]);
    free(one_tangent[k]);
  }
  free(out);
  free(t);
  free(t_one);
  free(out_one);
  free(saved);
  free(w);
  free(w_one);
}

#endif
