/* Where a NaN or an infinity was born: in the values, in the adjoints. */
#include "autodiff/tape.h"

#include <math.h>
#include <string.h>

static double number_at(const void *numbers, size_t i, bool single)
{
  return single ? (double)((const float *)numbers)[i] : ((const double *)numbers)[i];
}

/* index of the first entry that is not finite, n when all are */
static size_t first_bad(const void *numbers, size_t n, bool single)
{
  size_t i = 0;
  while (i < n && isfinite(number_at(numbers, i, single))) {
    ++i;
  }
  return i;
}

static kg_value value_of(const kg_graph *graph, uint32_t index)
{
  return (kg_value){index | (graph->node[index].is_block ? KG_TENSOR : 0)};
}

/* Operands come before results: the first value that is not finite has finite operands. */
kg_trace kg_trace_value(const kg_tape *tape)
{
  const kg_graph *graph = &tape->graph;
  const bool single = tape->precision == KG_FLOAT;
  for (uint32_t i = 1; i < graph->count; ++i) {
    const kg_value value = value_of(graph, i);
    const void *data = kg_node_data(graph, value.id);
    const size_t n = kg_size_of(tape, value), at = first_bad(data, n, single);
    if (at == n) continue;
    return (kg_trace){.value = value,
                      .index = at,
                      .item = number_at(data, at, single),
                      .op = kg_node_name(&graph->node[i]),
                      .tag = kg_tag_at(tape, i)};
  }
  return (kg_trace){0};
}

/* -- adjoints ---------------------------------------------------------------------------------- */

/* adjoints of scalar nodes are double on any tape */
static size_t bytes_of(const kg_graph *graph, kg_value value)
{
  return value.id & KG_TENSOR ? graph->number : sizeof(double);
}

/* entries of all directions */
static size_t entries_of(const kg_tape *tape, kg_value value)
{
  return kg_size_of(tape, value) * (size_t)tape->graph.directions;
}

/* the first entry of a value's adjoint that is not finite; SIZE_MAX when there is none */
static size_t bad_adjoint(const kg_tape *tape, kg_value value)
{
  const void *adjoint = kg_sweep_result(&tape->graph, value.id);
  const size_t n = adjoint ? entries_of(tape, value) : 0;
  const size_t at = first_bad(adjoint, n, bytes_of(&tape->graph, value) == sizeof(float));
  return at < n ? at : SIZE_MAX;
}

static int operands_of(const kg_node *node)
{
  if (node->is_block) return node->is.block->count;
  return node->op == kg_op_input || node->op == kg_op_constant ? 0
         : node->op == kg_op_element                           ? 1
                                                               : 2;
}

static kg_value operand(const kg_node *node, int k)
{
  return (kg_value){node->is_block ? node->is.block->input[k] : node->input[k]};
}

/* Whether the adjoint rule of a block, run alone, gives its operand k something that is not finite.
 * Without memory to try it in: yes. */
static bool block_makes_bad(kg_tape *tape, uint32_t index, int k)
{
  kg_graph *graph = &tape->graph;
  const kg_block *block = graph->node[index].is.block;
  const kg_value to = operand(&graph->node[index], k);
  const size_t n = kg_size_of(tape, to), bytes = bytes_of(graph, to);
  kg_buffer trial = {0};
  if (!kg_buffer_reserve(&trial, graph->allocator, n * bytes)) return true;
  const void **in = graph->pointers.memory;
  void **in_adjoint = (void **)(in + graph->widest + 1);
  const kg_call call = kg_block_call(graph, block, in);
  const char *adjoint = kg_sweep_result(graph, index | KG_TENSOR);
  bool bad = false;
  for (int s = 0; s < graph->directions && !bad; ++s) {
    memset(trial.memory, 0, n * bytes);
    memset(in_adjoint, 0, (size_t)block->count * sizeof *in_adjoint);
    in_adjoint[k] = trial.memory;
    block->kernel->vjp(&call, adjoint + (size_t)s * block->size * graph->number, in_adjoint);
    bad = first_bad(trial.memory, n, bytes == sizeof(float)) < n;
  }
  kg_buffer_release(&trial, graph->allocator);
  return bad;
}

static bool makes_bad(kg_tape *tape, uint32_t index, int k)
{
  const kg_node *node = &tape->graph.node[index];
  if (node->is_block) return block_makes_bad(tape, index, k);
  if (node->op == kg_op_element) return false;
  const double *adjoint = kg_sweep_result(&tape->graph, index);
  for (int s = 0; s < tape->graph.directions; ++s) {
    if (adjoint[s] != 0 && !isfinite(node->partial[k] * adjoint[s])) return true;
  }
  return false;
}

static kg_trace trace_of(const kg_tape *tape, uint32_t index, kg_value to, size_t at)
{
  const kg_graph *graph = &tape->graph;
  const bool single = bytes_of(graph, to) == sizeof(float);
  return (kg_trace){.value = to,
                    .index = at % kg_size_of(tape, to),
                    .item = number_at(kg_sweep_result(graph, to.id), at, single),
                    .op = kg_node_name(&graph->node[index]),
                    .tag = kg_tag_at(tape, index),
                    .adjoint = true};
}

/* An operand may be bad through another of its users: each suspect's rule is run again on its
 * own. */
kg_trace kg_trace_adjoint(kg_tape *tape)
{
  const kg_graph *graph = &tape->graph;
  const bool any = graph->directions && graph->complete != KG_NO_ADJOINTS;
  for (uint32_t i = any ? graph->swept - 1 : 0; i > 0; --i) {
    const kg_node *node = &graph->node[i];
    if (!kg_sweep_result(graph, value_of(graph, i).id)) continue;
    if (bad_adjoint(tape, value_of(graph, i)) != SIZE_MAX) continue;
    for (int k = 0; k < operands_of(node); ++k) {
      const kg_value to = operand(node, k);
      const size_t at = to.id ? bad_adjoint(tape, to) : SIZE_MAX;
      if (at != SIZE_MAX && makes_bad(tape, i, k)) return trace_of(tape, i, to, at);
    }
  }
  return (kg_trace){0};
}
