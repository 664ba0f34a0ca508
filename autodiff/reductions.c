/* Reductions and linear combinations: shapes checked, kernels told the sizes
 * (kernels/reductions.inc). */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

kg_value kg_combine(kg_tape *tape, int count, const double *factors, const kg_value *terms)
{
  if (count < 1) return kg_refuse(tape, KG_ERR_SHAPE, "combine", "%d terms", count);
  if (!kg_operands_given(tape, count, terms)) return (kg_value){0};
  const kg_shape shape = kg_shape_of(tape, terms[0]);
  for (int i = 1; i < count; ++i) {
    const kg_shape other = kg_shape_of(tape, terms[i]);
    if (!kg_same_shape(shape, other)) {
      return kg_refuse(tape, KG_ERR_SHAPE, "combine", "term 0 of shape %s, term %d of shape %s",
                       kg_shape_print(shape).text, i, kg_shape_print(other).text);
    }
  }
  return kg_record(tape, &(kg_recipe){.op = kg_op_combine,
                                      .count = count,
                                      .operands = terms,
                                      .shape = shape,
                                      .attributes = factors,
                                      .attribute_bytes = (size_t)count * sizeof *factors});
}

static kg_value record_split(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                             kg_shape shape, kg_axis_split split, size_t saved)
{
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = count,
                                      .operands = operands,
                                      .shape = shape,
                                      .attributes = &split,
                                      .attribute_bytes = sizeof split,
                                      .saved = saved});
}

static kg_value record_reduction(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                                 int axis, bool keeps_axis)
{
  if (!kg_operands_given(tape, count, operands)) return (kg_value){0};
  const kg_shape shape = kg_shape_of(tape, operands[0]);
  const int at = kg_axis_of(tape, kg_op_name(op), shape, axis);
  if (at < 0) return (kg_value){0};
  const kg_axis_split split = kg_split(shape, at);
  const size_t results = split.outer * split.inner;
  const size_t saved = op == kg_op_logsumexp ? results * (split.length + 1)
                       : op == kg_op_max_along || op == kg_op_min_along ? results
                                                                        : 0;
  return record_split(tape, op, count, operands, keeps_axis ? shape : kg_without_axis(shape, at),
                      split, saved);
}

#define REDUCTION(name, keeps_axis)                                                                \
  kg_value kg_##name(kg_tape *tape, kg_value a, int axis)                                          \
  {                                                                                                \
    return record_reduction(tape, kg_op_##name, 1, &a, axis, keeps_axis);                          \
  }
REDUCTION(sum, false)
REDUCTION(sum_squares, false)
REDUCTION(norm, false)
REDUCTION(max_along, false)
REDUCTION(min_along, false)
REDUCTION(logsumexp, false)
REDUCTION(softmax, true)

kg_value kg_sum_all(kg_tape *tape, kg_value a)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  const kg_axis_split split = {1, kg_size_of(tape, a), 1};
  return record_split(tape, kg_op_sum, 1, &a, KG_SCALAR_SHAPE, split, 0);
}

kg_value kg_dot(kg_tape *tape, kg_value a, kg_value b, int axis)
{
  const kg_value operands[2] = {a, b};
  if (!kg_operands_given(tape, 2, operands)) return (kg_value){0};
  const kg_shape shape = kg_shape_of(tape, a), other = kg_shape_of(tape, b);
  if (!kg_same_shape(shape, other)) {
    return kg_refuse(tape, KG_ERR_SHAPE, "dot", "shapes %s and %s", kg_shape_print(shape).text,
                     kg_shape_print(other).text);
  }
  return record_reduction(tape, kg_op_dot, 2, operands, axis, false);
}
