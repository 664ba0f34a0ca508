/* Operators that move entries: the checks and the recipes; indices are looked at here, once, so
 * that the kernels need not. */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

#include <string.h>

static kg_value move(kg_tape *tape, kg_op op, kg_value a, kg_shape shape, const void *attributes,
                     size_t bytes)
{
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = 1,
                                      .operands = &a,
                                      .shape = shape,
                                      .attributes = attributes,
                                      .attribute_bytes = bytes});
}

/* The result shares the operand's numbers; not a scalar's: they move when the tape grows. */
kg_value kg_reshape(kg_tape *tape, kg_value a, kg_shape shape)
{
  if (!kg_operands_given(tape, 1, &a) || !kg_check_shape(tape, kg_op_reshape, shape))
    return (kg_value){0};
  if (kg_shape_size(&shape) != kg_size_of(tape, a)) {
    return kg_refuse(tape, KG_ERR_SHAPE, "reshape", "%s has %zu entries, %s has %zu",
                     kg_shape_print(kg_shape_of(tape, a)).text, kg_size_of(tape, a),
                     kg_shape_print(shape).text, kg_shape_size(&shape));
  }
  const void *alias = kg_is_scalar_node(a) ? NULL : kg_node_data(&tape->graph, a.id);
  return kg_record(
    tape,
    &(kg_recipe){.op = kg_op_reshape, .count = 1, .operands = &a, .shape = shape, .alias = alias});
}

static bool broadcasts(kg_shape from, kg_shape to)
{
  bool fits = from.rank <= to.rank;
  for (int i = 0; fits && i < from.rank; ++i) {
    fits = from.dim[i] == 1 || from.dim[i] == to.dim[to.rank - from.rank + i];
  }
  return fits;
}

kg_value kg_broadcast(kg_tape *tape, kg_value a, kg_shape shape)
{
  if (!kg_operands_given(tape, 1, &a) || !kg_check_shape(tape, kg_op_broadcast, shape)) {
    return (kg_value){0};
  }
  const kg_shape from = kg_shape_of(tape, a);
  if (!broadcasts(from, shape)) {
    return kg_refuse(tape, KG_ERR_SHAPE, "broadcast", "%s to %s", kg_shape_print(from).text,
                     kg_shape_print(shape).text);
  }
  const kg_elementwise plan = kg_plan_elementwise(1, &from, shape);
  return move(tape, kg_op_broadcast, a, shape, &plan, sizeof plan);
}

kg_value kg_transpose(kg_tape *tape, kg_value a, int axis1, int axis2)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, a);
  axis1 = kg_axis_of(tape, "transpose", shape, axis1);
  axis2 = axis1 < 0 ? -1 : kg_axis_of(tape, "transpose", shape, axis2);
  if (axis1 < 0 || axis2 < 0) return (kg_value){0};
  if (axis1 == axis2) return kg_reshape(tape, a, shape);
  const int first = axis1 < axis2 ? axis1 : axis2, second = axis1 < axis2 ? axis2 : axis1;
  const kg_axis_split one = kg_split(shape, first), two = kg_split(shape, second);
  const kg_exchange exchange = {.outer = one.outer,
                                .rows = one.length,
                                .between = one.inner / two.length / two.inner,
                                .columns = two.length,
                                .inner = two.inner};
  shape.dim[first] = (int32_t)two.length;
  shape.dim[second] = (int32_t)one.length;
  return move(tape, kg_op_transpose, a, shape, &exchange, sizeof exchange);
}

/* One window shares the operand's numbers; a scalar has no axis to cut. */
kg_value kg_slice(kg_tape *tape, kg_value a, int axis, int start, int count)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, a);
  if ((axis = kg_axis_of(tape, "slice", shape, axis)) < 0) return (kg_value){0};
  if (start < 0 || count < 1 || start > shape.dim[axis] - count) {
    return kg_refuse(tape, KG_ERR_SHAPE, "slice", "%d entries from %d of axis %d of shape %s",
                     count, start, axis, kg_shape_print(shape).text);
  }
  const kg_axis_split split = kg_split(shape, axis);
  const kg_window window = {.outer = split.outer,
                            .row = split.length * split.inner,
                            .start = (size_t)start * split.inner,
                            .width = (size_t)count * split.inner};
  shape.dim[axis] = count;
  const char *data = kg_node_data(&tape->graph, a.id);
  return kg_record(
    tape,
    &(kg_recipe){.op = kg_op_slice,
                 .count = 1,
                 .operands = &a,
                 .shape = shape,
                 .attributes = &window,
                 .attribute_bytes = sizeof window,
                 .alias = split.outer == 1 ? data + window.start * tape->graph.number : NULL});
}

/* -- joining ----------------------------------------------------------------------------------- */

/* `count` parts of (outer, length of its own, inner); sum of the lengths in shape */
static kg_value join(kg_tape *tape, int count, const kg_value *parts, kg_shape shape, size_t outer)
{
  const size_t bytes = sizeof(kg_join) + ((size_t)count + 1) * sizeof(size_t);
  kg_join *joined = kg_take_attributes(tape, kg_op_concat, bytes);
  if (!joined) return (kg_value){0};
  joined->outer = outer;
  joined->start[0] = 0;
  for (int k = 0; k < count; ++k) {
    joined->start[k + 1] = joined->start[k] + kg_size_of(tape, parts[k]) / outer;
  }
  joined->row = joined->start[count];
  return kg_record(tape, &(kg_recipe){.op = kg_op_concat,
                                      .count = count,
                                      .operands = parts,
                                      .shape = shape,
                                      .attributes = joined,
                                      .attribute_bytes = bytes,
                                      .attributes_taken = true});
}

kg_value kg_concat(kg_tape *tape, int axis, int count, const kg_value *parts)
{
  if (count < 1) return kg_refuse(tape, KG_ERR_SHAPE, "concat", "%d parts", count);
  if (!kg_operands_given(tape, count, parts)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, parts[0]);
  if ((axis = kg_axis_of(tape, "concat", shape, axis)) < 0) return (kg_value){0};
  int64_t length = shape.dim[axis];
  for (int k = 1; k < count; ++k) {
    kg_shape other = kg_shape_of(tape, parts[k]);
    length += axis < other.rank ? other.dim[axis] : 0;
    if (axis < other.rank) other.dim[axis] = shape.dim[axis];
    if (!kg_same_shape(shape, other) || length > INT32_MAX) {
      return kg_refuse(tape, KG_ERR_SHAPE, "concat", "part %d of shape %s after %s along axis %d",
                       k, kg_shape_print(kg_shape_of(tape, parts[k])).text,
                       kg_shape_print(shape).text, axis);
    }
  }
  const size_t outer = kg_split(shape, axis).outer;
  shape.dim[axis] = (int32_t)length;
  return join(tape, count, parts, shape, outer);
}

kg_value kg_stack(kg_tape *tape, int count, const kg_value *scalars)
{
  if (count < 1) return kg_refuse(tape, KG_ERR_SHAPE, "stack", "%d scalars", count);
  if (!kg_operands_given(tape, count, scalars)) return (kg_value){0};
  for (int k = 0; k < count; ++k) {
    const kg_shape shape = kg_shape_of(tape, scalars[k]);
    if (shape.rank != 0) {
      return kg_refuse(tape, KG_ERR_SHAPE, "stack", "entry %d of shape %s is not a scalar", k,
                       kg_shape_print(shape).text);
    }
  }
  return join(tape, count, scalars, KG_SHAPE(count), 1);
}

/* -- entries by index -------------------------------------------------------------------------- */

/* On double tapes a scalar node whose operand is the tensor; in place of a second one the index. */
kg_value kg_element(kg_tape *tape, kg_value a, size_t index)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  if (index >= kg_size_of(tape, a) || index > UINT32_MAX) {
    return kg_refuse(tape, KG_ERR_SHAPE, "element", "entry %zu of shape %s", index,
                     kg_shape_print(kg_shape_of(tape, a)).text);
  }
  if (kg_is_scalar_node(a)) return a;
  if (tape->precision != KG_DOUBLE) {
    return move(tape, kg_op_element, a, KG_SCALAR_SHAPE, &index, sizeof index);
  }
  kg_graph *graph = &tape->graph;
  if (!kg_graph_reserve(graph)) return kg_refuse(tape, KG_ERR_NO_MEMORY, "element", "no memory");
  graph->node[graph->count] = (kg_node){.is.value = kg_data(tape, a)[index],
                                        .input = {a.id, (uint32_t)index},
                                        .op = kg_op_element,
                                        .active = kg_node_of(tape, a)->active};
  return (kg_value){graph->count++};
}

/* gather takes entries of an axis of `extent` into one of `count`, scatter back: a has the shape of
 * the source, shape that of the result */
static kg_value by_index(kg_tape *tape, kg_op op, kg_value a, int axis, kg_shape shape, int extent,
                         int count, const int32_t *index)
{
  for (int i = 0; i < count; ++i) {
    if (index[i] < -1 || index[i] >= extent) {
      return kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op),
                       "index[%d] = %d for an axis of extent %d", i, (int)index[i], extent);
    }
  }
  const size_t bytes = sizeof(kg_pick) + (size_t)count * sizeof *index;
  kg_pick *pick = kg_take_attributes(tape, op, bytes);
  if (!pick) return (kg_value){0};
  const kg_axis_split split = kg_split(shape, axis);
  *pick = (kg_pick){split.outer, (size_t)extent, (size_t)count, split.inner};
  memcpy(pick->index, index, (size_t)count * sizeof *index);
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = 1,
                                      .operands = &a,
                                      .shape = shape,
                                      .attributes = pick,
                                      .attribute_bytes = bytes,
                                      .attributes_taken = true});
}

kg_value kg_gather(kg_tape *tape, kg_value a, int axis, int count, const int32_t *index)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, a);
  if ((axis = kg_axis_of(tape, "gather", shape, axis)) < 0) return (kg_value){0};
  const int extent = shape.dim[axis];
  shape.dim[axis] = count;
  if (!kg_check_shape(tape, kg_op_gather, shape)) return (kg_value){0};
  return by_index(tape, kg_op_gather, a, axis, shape, extent, count, index);
}

kg_value kg_scatter(kg_tape *tape, kg_value a, int axis, int extent, const int32_t *index)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, a);
  if ((axis = kg_axis_of(tape, "scatter", shape, axis)) < 0) return (kg_value){0};
  const int count = shape.dim[axis];
  shape.dim[axis] = extent;
  if (!kg_check_shape(tape, kg_op_scatter, shape)) return (kg_value){0};
  return by_index(tape, kg_op_scatter, a, axis, shape, extent, count, index);
}
