/* tape.h - inside of a tape, and what the files that make operators share. */
#ifndef AUTODIFF_TAPE_H
#define AUTODIFF_TAPE_H

#include "autodiff/attributes.h"
#include "kinegrad/operators.h"

typedef struct kg_tag_range {
  uint32_t first; /* node from which on the tag holds */
  const char *text;
} kg_tag_range;

struct kg_tape {
  kg_graph graph;
  kg_arena arena; /* blocks and their numbers */
  kg_precision precision;
  int simd;
  kg_tag_range *tags;
  size_t tag_count, tag_capacity;
  kg_error error;
};

/* What an operator's function hands over once shapes are checked. */
typedef struct kg_recipe {
  kg_op op;
  int count; /* operands */
  const kg_value *operands;
  kg_shape shape;
  const void *attributes; /* copied; zero padding: equal bytes must mean equal operators */
  size_t attribute_bytes;
  bool attributes_taken;   /* attributes come from kg_take_attributes: not copied */
  size_t saved;            /* entries to keep between the sweeps */
  bool constant;           /* without derivative whatever the operands are */
  const void
    *alias; /* the result's numbers when they are an operand's (reshape, slice), else NULL */
  const void *known; /* the result when it is known already, copied; NULL: evaluated */
} kg_recipe;

/* Records a block and evaluates it; the null value on failure, with the tape's error set. */
kg_value kg_record(kg_tape *tape, const kg_recipe *recipe);

/* Room in the tape for attributes of any length, as part of the next recipe; NULL, with the tape's
 * error set, when the tape has failed or memory is refused. */
void *kg_take_attributes(kg_tape *tape, kg_op op, size_t bytes);

/* An element-wise operator of up to three operands, broadcast (elementwise.c). */
kg_value kg_record_elementwise(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                               double p, double q, bool constant);

/* The walk over a result of this shape, to which the operands' shapes broadcast (elementwise.c). */
struct kg_elementwise kg_plan_elementwise(int count, const kg_shape *shapes, kg_shape result);

/* Sets the tape's error unless one is set ("operator: ..." with the tag), and returns the null
 * value. */
kg_value kg_refuse(kg_tape *tape, kg_status status, const char *operator_name, const char *format,
                   ...) KG_PRINTF(4, 5);

/* The same for a node whose kernel failed; and when one has in the last sweep: the status. */
void kg_refuse_node(kg_tape *tape, uint32_t node, kg_status status);
kg_status kg_sweep_status(kg_tape *tape);

bool kg_shape_is_valid(kg_shape shape);

/* "(64, 48)" into text; returns text */
typedef struct kg_shape_text {
  char text[64];
} kg_shape_text;
kg_shape_text kg_shape_print(kg_shape shape);

/* false, quietly, when one of the values is null; asserts that they belong to the tape */
bool kg_operands_given(kg_tape *tape, int count, const kg_value *values);

/* axis counted from the front, -1 when out of range (the tape's error is set) */
int kg_axis_of(kg_tape *tape, const char *operator_name, kg_shape shape, int axis);

/* sizes of what lies before, along and after the axis; the shape without it */
kg_axis_split kg_split(kg_shape shape, int axis);
kg_shape kg_without_axis(kg_shape shape, int axis);
bool kg_same_shape(kg_shape a, kg_shape b);

/* false, with the tape's error set, unless rank and extents are within bounds and the size can be
 * counted */
bool kg_check_shape(kg_tape *tape, kg_op op, kg_shape shape);

/* -- calls on a record (derivatives.c) --------------------------------------------------------- */

/* Otherwise the tape's error, by the call's name. */
bool kg_values_usable(kg_tape *tape, const char *call, int count, const kg_value *values);
bool kg_values_differentiable(kg_tape *tape, const char *call, int count, const kg_value *values);
kg_status kg_begin_sweep(kg_tape *tape, const char *call, int directions);

/* Between doubles and the n numbers of a value's adjoint or tangent; from NULL: zeros. */
void kg_add_numbers(const kg_tape *tape, kg_value value, void *to, const double *from, size_t n);
void kg_copy_numbers(const kg_tape *tape, kg_value value, const void *from, double *to, size_t n);

const char *kg_tag_at(const kg_tape *tape, uint32_t node);

static inline bool kg_is_scalar_node(kg_value value)
{
  return value.id != 0 && !(value.id & KG_TENSOR);
}

static inline const kg_node *kg_node_of(const kg_tape *tape, kg_value value)
{
  return &tape->graph.node[kg_index(value.id)];
}

#endif
