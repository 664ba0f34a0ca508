/* primitive.h - how primitives are recorded, and what those of the engine itself (implicit.c,
 * checkpoint.c) may use beyond a user's.
 *
 * Every primitive is a block of kg_op_primitive whose attributes say which. Callbacks see doubles
 * of one lane; numbers of another kind pass through the graph's scratch. */
#ifndef AUTODIFF_PRIMITIVE_H
#define AUTODIFF_PRIMITIVE_H

#include "autodiff/tape.h"
#include "kinegrad/primitive.h"

/* Attributes of kg_op_primitive. Two calls are one operator when they are equal, pointers too. */
typedef struct kg_primitive_attributes {
  const kg_primitive *primitive;
  void *user; /* given to its callbacks */
  const char *name;
  kg_checkpointed segment;          /* of a checkpoint, else NULL */
  size_t saved;                     /* numbers a call keeps */
  uint32_t scalars;                 /* bit i: operand i was recorded as a scalar node */
  int32_t outputs;                  /* of a checkpoint */
  kg_shape shape;                   /* of the result */
  kg_shape shapes[KG_MAX_OPERANDS]; /* of the operands; stored as far as used */
} kg_primitive_attributes;

/* What a callback's kg_primitive_call really is. Adjoints it is given to add to are the sums so
 * far. */
typedef struct kg_primitive_frame {
  kg_primitive_call call; /* the first member: callbacks get its address */
  const kg_primitive_attributes *attributes;
  kg_graph *graph;
} kg_primitive_frame;

/* Records a call of attributes' primitive, user, name and segment; the rest is filled in here.
 * known: as in kg_recipe, with attributes' shape then given. */
kg_value kg_record_primitive(kg_tape *tape, kg_primitive_attributes *attributes, int count,
                             const kg_value *operands, const void *known);

/* -- recording within a kernel (checkpoint.c) -------------------------------------------------- */

/* The tape on which this graph's primitives record, of its arithmetic, empty; NULL when memory is
 * refused. Each use begins with this call. */
kg_tape *kg_child_tape(kg_graph *graph);

/* x (size of shape) on the child, as a scalar node or as a tensor, an input or a constant. */
kg_value kg_child_value(kg_tape *child, kg_shape shape, bool scalar, bool active, const double *x);

/* All operands of a call; operand i is an input where wanted[i] is not NULL, else a constant. */
void kg_child_operands(kg_tape *child, const kg_primitive_frame *frame, const double *const *wanted,
                       kg_value *values);

/* Adds seed to the adjoint (tangent) of a value, one direction; reads it. NULL: nothing to do. */
void kg_child_add(kg_tape *child, kg_value value, const double *seed);
void kg_child_read(const kg_tape *child, kg_value value, double *to);

/* What stopped the child becomes the detail of the graph's failure; its status, KG_OK when it did
 * not fail. */
kg_status kg_child_status(kg_graph *graph);

#endif
