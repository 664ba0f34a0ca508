/* Choices between values (masks, where) and between branches of the recording code (is_less). */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

kg_value kg_less(kg_tape *tape, kg_value a, kg_value b)
{
  const kg_value operands[2] = {a, b};
  return kg_record_elementwise(tape, kg_op_less, 2, operands, 0, 0, true);
}

kg_value kg_less_equal(kg_tape *tape, kg_value a, kg_value b)
{
  const kg_value operands[2] = {a, b};
  return kg_record_elementwise(tape, kg_op_less_equal, 2, operands, 0, 0, true);
}

kg_value kg_where(kg_tape *tape, kg_value mask, kg_value a, kg_value b)
{
  const kg_value operands[3] = {mask, a, b};
  return kg_record_elementwise(tape, kg_op_where, 3, operands, 0, 0, false);
}

/* The guard is a node whose value nobody reads. It is kept between constants too: a program may
 * change them. */
bool kg_is_less(kg_tape *tape, kg_value a, kg_value b)
{
  const kg_value operands[2] = {a, b};
  if (!kg_operands_given(tape, 2, operands)) return false;
  if (kg_size_of(tape, a) != 1 || kg_size_of(tape, b) != 1) {
    kg_refuse(tape, KG_ERR_SHAPE, "is_less", "shapes %s and %s: two scalars are compared",
              kg_shape_print(kg_shape_of(tape, a)).text, kg_shape_print(kg_shape_of(tape, b)).text);
    return false;
  }
  const bool answer = kg_item(tape, a) < kg_item(tape, b);
  const kg_guard guard = {answer};
  const kg_value node = kg_record(tape, &(kg_recipe){.op = kg_op_is_less,
                                                     .count = 2,
                                                     .operands = operands,
                                                     .shape = KG_SCALAR_SHAPE,
                                                     .attributes = &guard,
                                                     .attribute_bytes = sizeof guard,
                                                     .constant = true});
  return answer && !kg_is_null(node);
}
