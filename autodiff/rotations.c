/* 3-vectors and quaternions along the last axis: checks and recipes. */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

static kg_value rotation(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                         kg_shape shape, size_t saved)
{
  return kg_record(
    tape,
    &(kg_recipe){.op = op, .count = count, .operands = operands, .shape = shape, .saved = saved});
}

/* the shape of a with its last axis exchanged for `to` entries; rank 0, with the tape's error set,
 * unless the axis has `from` entries */
static kg_shape with_last(kg_tape *tape, kg_op op, kg_value a, int32_t from, int32_t to)
{
  if (!kg_operands_given(tape, 1, &a)) return KG_SCALAR_SHAPE;
  kg_shape shape = kg_shape_of(tape, a);
  if (shape.rank == 0 || shape.dim[shape.rank - 1] != from) {
    kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op), "shape %s: the last axis must have %d entries",
              kg_shape_print(shape).text, (int)from);
    return KG_SCALAR_SHAPE;
  }
  shape.dim[shape.rank - 1] = to;
  return shape;
}

/* two operands whose last axes have these entries, the other axes equal; the result is like b */
static kg_value pair(kg_tape *tape, kg_op op, kg_value a, int32_t length, kg_value b,
                     int32_t length_b)
{
  const kg_shape shape = with_last(tape, op, a, length, length_b);
  const kg_shape other = with_last(tape, op, b, length_b, length_b);
  if (shape.rank == 0 || other.rank == 0) return (kg_value){0};
  if (!kg_same_shape(shape, other)) {
    return kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op), "shapes %s and %s",
                     kg_shape_print(kg_shape_of(tape, a)).text, kg_shape_print(other).text);
  }
  return rotation(tape, op, 2, (kg_value[]){a, b}, shape, 0);
}

kg_value kg_cross(kg_tape *tape, kg_value a, kg_value b)
{
  return pair(tape, kg_op_cross, a, 3, b, 3);
}

kg_value kg_compose(kg_tape *tape, kg_value p, kg_value q)
{
  return pair(tape, kg_op_compose, p, 4, q, 4);
}

kg_value kg_rotate(kg_tape *tape, kg_value q, kg_value v)
{
  return pair(tape, kg_op_rotate, q, 4, v, 3);
}

kg_value kg_rotation_exp(kg_tape *tape, kg_value r)
{
  const kg_shape shape = with_last(tape, kg_op_rotation_exp, r, 3, 4);
  if (shape.rank == 0) return (kg_value){0};
  return rotation(tape, kg_op_rotation_exp, 1, &r, shape, kg_shape_size(&shape) / 2);
}

kg_value kg_rotation_log(kg_tape *tape, kg_value q)
{
  const kg_shape shape = with_last(tape, kg_op_rotation_log, q, 4, 3);
  if (shape.rank == 0) return (kg_value){0};
  return rotation(tape, kg_op_rotation_log, 1, &q, shape, kg_shape_size(&shape) / 3 * 2);
}

kg_value kg_normalize(kg_tape *tape, kg_value a)
{
  if (!kg_operands_given(tape, 1, &a)) return (kg_value){0};
  const kg_shape shape = kg_shape_of(tape, a);
  const int axis = kg_axis_of(tape, "normalize", shape, -1);
  if (axis < 0) return (kg_value){0};
  const kg_axis_split split = kg_split(shape, axis);
  return kg_record(tape, &(kg_recipe){.op = kg_op_normalize,
                                      .count = 1,
                                      .operands = &a,
                                      .shape = shape,
                                      .attributes = &split,
                                      .attribute_bytes = sizeof split,
                                      .saved = 2 * split.outer});
}
