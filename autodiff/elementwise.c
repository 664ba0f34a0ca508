/* Element-wise operators: scalars are recorded here and now with their partial derivatives, by
 * the same rules as the tensors' kernels (oplist.h); tensors get their broadcast walk. */
#define KG_ARITHMETIC 64
#define KG_ISA base
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

#include "autodiff/kernels/number.h"

/* -- scalars ----------------------------------------------------------------------------------- */

static kg_value push_grown(kg_tape *tape, kg_op op, kg_value a, kg_value b, double y, double by_a,
                           double by_b) __attribute__((noinline));

/* The shortest path: everything that calls a function is elsewhere, so that nothing is saved or
 * restored. */
static inline kg_value push_scalar(kg_tape *tape, kg_op op, kg_value a, kg_value b, double y,
                                   double by_a, double by_b)
{
  kg_graph *graph = &tape->graph;
  if (graph->count == graph->capacity) return push_grown(tape, op, a, b, y, by_a, by_b);
  kg_node *node = &graph->node[graph->count];
  node->is.value = y;
  node->partial[0] = by_a;
  node->partial[1] = by_b;
  node->input[0] = a.id;
  node->input[1] = b.id;
  node->op = (uint16_t)op;
  node->is_block = false;
  node->active = graph->node[a.id].active | graph->node[b.id].active;
  return (kg_value){graph->count++};
}

static kg_value push_grown(kg_tape *tape, kg_op op, kg_value a, kg_value b, double y, double by_a,
                           double by_b)
{
  if (!kg_graph_reserve(&tape->graph)) {
    return kg_refuse(tape, KG_ERR_NO_MEMORY, kg_op_name(op), "no memory");
  }
  return push_scalar(tape, op, a, b, y, by_a, by_b);
}

static inline double scalar_value(const kg_tape *tape, kg_value a)
{
  return tape->graph.node[a.id].is.value;
}

/* -- tensors ----------------------------------------------------------------------------------- */

/* entries from one index of axis i (of `rank`, counted for the result) to the next; 0 repeats */
static size_t stride_along(kg_shape shape, int rank, int i)
{
  const int own = i - (rank - shape.rank);
  return own < 0 || shape.dim[own] == 1 ? 0 : kg_split(shape, own).inner;
}

static bool broadcast_shape(int count, const kg_shape *shapes, kg_shape *result)
{
  *result = (kg_shape){0};
  for (int k = 0; k < count; ++k) {
    result->rank = shapes[k].rank > result->rank ? shapes[k].rank : result->rank;
  }
  for (int i = 0; i < result->rank; ++i) {
    result->dim[i] = 1;
    for (int k = 0; k < count; ++k) {
      const int own = i - (result->rank - shapes[k].rank);
      const int32_t extent = own < 0 ? 1 : shapes[k].dim[own];
      if (extent != 1 && result->dim[i] != 1 && extent != result->dim[i]) return false;
      result->dim[i] = extent != 1 ? extent : result->dim[i];
    }
  }
  return true;
}

/* true when axis i + 1 of every operand continues axis i, the last axis kept */
static bool continues(const kg_elementwise *e, int count, const size_t *stride, size_t extent)
{
  const int last = (int)e->rank - 1;
  for (int k = 0; k < count; ++k) {
    if (e->stride[k][last] != stride[k] * extent) return false;
  }
  return true;
}

/* axes are merged where the operands allow */
kg_elementwise kg_plan_elementwise(int count, const kg_shape *shapes, kg_shape result)
{
  kg_elementwise e = {0};
  for (int i = 0; i < result.rank; ++i) {
    if (result.dim[i] == 1) continue;
    size_t stride[3] = {0};
    for (int k = 0; k < count; ++k) {
      stride[k] = stride_along(shapes[k], result.rank, i);
    }
    const size_t extent = (size_t)result.dim[i];
    const bool merged = e.rank > 0 && continues(&e, count, stride, extent);
    const int at = (int)(merged ? e.rank - 1 : e.rank++);
    e.dim[at] = merged ? e.dim[at] * extent : extent;
    for (int k = 0; k < count; ++k) {
      e.stride[k][at] = stride[k];
    }
  }
  if (e.rank == 0) {
    e.rank = 1;
    e.dim[0] = 1;
  }
  return e;
}

/* the usual case: nothing to broadcast */
static bool all_equal(int count, const kg_shape *shapes)
{
  bool equal = true;
  for (int k = 1; k < count; ++k) {
    equal = equal && kg_same_shape(shapes[0], shapes[k]);
  }
  return equal;
}

kg_value kg_record_elementwise(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                               double p, double q, bool constant)
{
  kg_shape shapes[3] = {0}, result;
  if (!kg_operands_given(tape, count, operands)) return (kg_value){0};
  for (int k = 0; k < count; ++k) {
    shapes[k] = kg_shape_of(tape, operands[k]);
  }
  const bool equal = all_equal(count, shapes);
  result = shapes[0];
  if (!equal && !broadcast_shape(count, shapes, &result)) {
    return kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op), "shapes %s, %s%s%s do not broadcast",
                     kg_shape_print(shapes[0]).text, kg_shape_print(shapes[1]).text,
                     count > 2 ? ", " : "", count > 2 ? kg_shape_print(shapes[2]).text : "");
  }
  if (!equal && !kg_check_shape(tape, op, result)) return (kg_value){0};
  kg_elementwise e;
  e.rank = 0;
  if (!equal) e = kg_plan_elementwise(count, shapes, result);
  e.p = p;
  e.q = q;
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = count,
                                      .operands = operands,
                                      .shape = result,
                                      .attributes = &e,
                                      .attribute_bytes = equal ? KG_FLAT_BYTES : sizeof e,
                                      .constant = constant});
}

/* -- the operators ----------------------------------------------------------------------------- */

static __attribute__((noinline)) kg_value record_unary(kg_tape *tape, kg_op op, kg_value a,
                                                       double p)
{
  return kg_record_elementwise(tape, op, 1, &a, p, 0, false);
}

static __attribute__((noinline)) kg_value record_binary(kg_tape *tape, kg_op op, kg_value a,
                                                        kg_value b)
{
  const kg_value operands[2] = {a, b};
  return kg_record_elementwise(tape, op, 2, operands, 0, 0, false);
}

/* a scalar's constant p is kept where a second operand's partial would be */
#define UNARY_SCALAR(name, value_rule, slope_rule)                                                 \
  static kg_value record_##name(kg_tape *tape, kg_value operand, double p)                         \
  {                                                                                                \
    if (!kg_is_scalar_node(operand)) {                                                             \
      return record_unary(tape, kg_op_##name, operand, p);                                         \
    }                                                                                              \
    const double a = scalar_value(tape, operand), y = value_rule;                                  \
    (void)y;                                                                                       \
    return push_scalar(tape, kg_op_##name, operand, (kg_value){0}, y, slope_rule, p);              \
  }
KG_UNARY_LIST(UNARY_SCALAR)
KG_TRIG_LIST(UNARY_SCALAR)

#define UNARY_FUNCTION(name)                                                                       \
  kg_value kg_##name(kg_tape *tape, kg_value a)                                                    \
  {                                                                                                \
    return record_##name(tape, a, 0);                                                              \
  }
UNARY_FUNCTION(neg)
UNARY_FUNCTION(reciprocal)
UNARY_FUNCTION(square)
UNARY_FUNCTION(sqrt)
UNARY_FUNCTION(abs)
UNARY_FUNCTION(exp)
UNARY_FUNCTION(expm1)
UNARY_FUNCTION(log)
UNARY_FUNCTION(log1p)
UNARY_FUNCTION(sin)
UNARY_FUNCTION(cos)
UNARY_FUNCTION(tan)
UNARY_FUNCTION(asin)
UNARY_FUNCTION(acos)
UNARY_FUNCTION(atan)
UNARY_FUNCTION(sinh)
UNARY_FUNCTION(cosh)
UNARY_FUNCTION(tanh)
UNARY_FUNCTION(sigmoid)
UNARY_FUNCTION(softplus)
UNARY_FUNCTION(relu)

kg_value kg_scale(kg_tape *tape, kg_value a, double factor)
{
  return record_scale(tape, a, factor);
}

kg_value kg_shift(kg_tape *tape, kg_value a, double term)
{
  return record_shift(tape, a, term);
}

kg_value kg_power(kg_tape *tape, kg_value a, double exponent)
{
  return record_power(tape, a, exponent);
}

/* a scalar node has room for one constant: its clamp is made of the two choices */
kg_value kg_clamp(kg_tape *tape, kg_value a, double low, double high)
{
  if (!kg_is_scalar_node(a)) {
    return kg_record_elementwise(tape, kg_op_clamp, 1, &a, low, high, false);
  }
  const kg_value above = kg_max(tape, a, kg_constant_scalar(tape, low));
  return kg_min(tape, above, kg_constant_scalar(tape, high));
}

#define BINARY_FUNCTION(name, value_rule, slope_a, slope_b)                                        \
  kg_value kg_##name(kg_tape *tape, kg_value first, kg_value second)                               \
  {                                                                                                \
    if (!kg_is_scalar_node(first) || !kg_is_scalar_node(second)) {                                 \
      return record_binary(tape, kg_op_##name, first, second);                                     \
    }                                                                                              \
    const double a = scalar_value(tape, first), b = scalar_value(tape, second), y = value_rule;    \
    return push_scalar(tape, kg_op_##name, first, second, y, slope_a, slope_b);                    \
  }
KG_BINARY_LIST(BINARY_FUNCTION)
