/* Checkpoints: a segment of the record is kept as its inputs and outputs, and recorded anew on a
 * child tape when a sweep arrives. T steps in sqrt(T) segments take memory for sqrt(T) states and
 * one segment.
 *
 * The outputs of a segment are one block, end to end; the segment's adjoints go on from the sums so
 * far, so that every sum is taken in the order of the unsegmented record. */
#include "autodiff/primitive.h"

#include <string.h>

/* -- recording within a kernel ----------------------------------------------------------------- */

kg_tape *kg_child_tape(kg_graph *graph)
{
  if (!graph->child) {
    const bool single = graph->number == sizeof(float);
    kg_tape_def def = kg_tape_default_def();
    def.precision = single ? KG_FLOAT : KG_DOUBLE;
    def.allocator = graph->allocator;
    if (kg_tape_create(&def, &graph->child, NULL) != KG_OK) return NULL;
    if (graph->number <= sizeof(double)) graph->child->graph.kernels = graph->kernels;
  }
  kg_tape_rewind(graph->child, (kg_tape_mark){0});
  return graph->child;
}

kg_value kg_child_value(kg_tape *child, kg_shape shape, bool scalar, bool active, const double *x)
{
  if (scalar) return active ? kg_scalar(child, *x) : kg_constant_scalar(child, *x);
  return active ? kg_input(child, shape, x) : kg_constant(child, shape, x);
}

void kg_child_operands(kg_tape *child, const kg_primitive_frame *frame, const double *const *wanted,
                       kg_value *values)
{
  for (int i = 0; i < frame->call.count; ++i) {
    const bool scalar = frame->attributes->scalars >> i & 1;
    values[i] =
      kg_child_value(child, frame->call.shapes[i], scalar, wanted && wanted[i], frame->call.in[i]);
  }
}

void kg_child_add(kg_tape *child, kg_value value, const double *seed)
{
  void *to = seed ? kg_sweep_seed(&child->graph, value.id) : NULL;
  if (to) kg_add_numbers(child, value, to, seed, kg_size_of(child, value));
}

void kg_child_read(const kg_tape *child, kg_value value, double *to)
{
  const void *from = kg_sweep_result(&child->graph, value.id);
  if (to) kg_copy_numbers(child, value, from, to, kg_size_of(child, value));
}

kg_status kg_child_status(kg_graph *graph)
{
  const kg_status status = kg_sweep_status(graph->child);
  if (status != KG_OK) graph->detail = graph->child->error.text;
  return status;
}

/* -- the segment ------------------------------------------------------------------------------- */

/* the attributes' user */
typedef struct recording {
  kg_tape *tape;
  kg_value inputs[KG_MAX_OPERANDS], outputs[KG_MAX_OPERANDS];
  size_t size; /* of all outputs */
} recording;

/* Runs the segment on the child tape, its inputs being there. */
static kg_status run_segment(kg_graph *graph, kg_checkpointed segment, void *user, int input_count,
                             int output_count, recording *r)
{
  for (int o = 0; o < output_count; ++o) {
    r->outputs[o] = (kg_value){0};
  }
  const kg_status answer = segment(r->tape, user, input_count, r->inputs, output_count, r->outputs);
  kg_status status = kg_child_status(graph);
  r->size = 0;
  for (int o = 0; o < output_count; ++o) {
    r->size += kg_size_of(r->tape, r->outputs[o]);
    if (status == KG_OK && answer == KG_OK && kg_is_null(r->outputs[o])) {
      graph->detail = "the segment left an output unset";
      status = KG_ERR_UNDEFINED;
    }
  }
  return status != KG_OK ? status : answer;
}

/* Records the segment of a call anew. */
static kg_status record_again(const kg_primitive_call *call, const double *const *wanted,
                              recording *r)
{
  const kg_primitive_frame *frame = (const kg_primitive_frame *)call;
  const kg_primitive_attributes *a = frame->attributes;
  r->tape = kg_child_tape(frame->graph);
  if (!r->tape) return KG_ERR_NO_MEMORY;
  kg_child_operands(r->tape, frame, wanted, r->inputs);
  const kg_status status =
    run_segment(frame->graph, a->segment, call->user, call->count, a->outputs, r);
  if (status != KG_OK || r->size == kg_shape_size(&call->shape)) return status;
  frame->graph->detail = "the segment recorded outputs of other sizes than the first time";
  return KG_ERR_SHAPE;
}

/* in a program, whose inputs change */
static kg_status checkpoint_forward(const kg_primitive_call *call)
{
  const kg_primitive_attributes *a = ((const kg_primitive_frame *)call)->attributes;
  recording r;
  const kg_status status = record_again(call, NULL, &r);
  double *out = call->out;
  for (int o = 0; status == KG_OK && o < a->outputs; ++o) {
    for (size_t i = 0; i < kg_size_of(r.tape, r.outputs[o]); ++i) {
      *out++ = kg_item_at(r.tape, r.outputs[o], i);
    }
  }
  return status;
}

static kg_status checkpoint_vjp(const kg_primitive_call *call, const double *adjoint,
                                double *const *in_adjoints)
{
  const kg_primitive_frame *frame = (const kg_primitive_frame *)call;
  recording r;
  const kg_status status = record_again(call, (const double *const *)in_adjoints, &r);
  if (status != KG_OK) return status;
  if (kg_sweep_begin(&r.tape->graph, 1) != KG_OK) return KG_ERR_NO_MEMORY;
  for (int i = 0; i < call->count; ++i) {
    kg_child_add(r.tape, r.inputs[i], in_adjoints[i]);
  }
  for (int o = 0; o < frame->attributes->outputs; ++o) {
    kg_child_add(r.tape, r.outputs[o], adjoint);
    adjoint += kg_size_of(r.tape, r.outputs[o]);
  }
  kg_sweep_backward(&r.tape->graph, 1);
  for (int i = 0; i < call->count; ++i) {
    kg_child_read(r.tape, r.inputs[i], in_adjoints[i]);
  }
  return kg_child_status(frame->graph);
}

static kg_status checkpoint_jvp(const kg_primitive_call *call, const double *const *tangents,
                                double *out_tangent)
{
  const kg_primitive_frame *frame = (const kg_primitive_frame *)call;
  recording r;
  const kg_status status = record_again(call, tangents, &r);
  if (status != KG_OK) return status;
  if (kg_sweep_begin(&r.tape->graph, 1) != KG_OK) return KG_ERR_NO_MEMORY;
  for (int i = 0; i < call->count; ++i) {
    kg_child_add(r.tape, r.inputs[i], tangents[i]);
  }
  kg_sweep_forward(&r.tape->graph, 1);
  for (int o = 0; o < frame->attributes->outputs; ++o) {
    kg_child_read(r.tape, r.outputs[o], out_tangent);
    out_tangent += kg_size_of(r.tape, r.outputs[o]);
  }
  return kg_child_status(frame->graph);
}

static const kg_primitive checkpoint_primitive = {
  .forward = checkpoint_forward, .vjp = checkpoint_vjp, .jvp = checkpoint_jvp};

/* -- recording on the tape --------------------------------------------------------------------- */

/* the segment run for the first time, at the values of the tape */
static kg_status run_first(kg_tape *tape, kg_checkpointed segment, void *user, int input_count,
                           const kg_value *inputs, int output_count, recording *r)
{
  r->tape = kg_child_tape(&tape->graph);
  if (!r->tape) return KG_ERR_NO_MEMORY;
  for (int i = 0; i < input_count; ++i) {
    const void *data = kg_node_data(&tape->graph, inputs[i].id);
    const kg_shape shape = kg_shape_of(tape, inputs[i]);
    r->inputs[i] = tape->precision == KG_FLOAT
                     ? kg_constant_f32(r->tape, shape, data)
                     : kg_child_value(r->tape, shape, kg_is_scalar_node(inputs[i]), false, data);
  }
  return run_segment(&tape->graph, segment, user, input_count, output_count, r);
}

/* the outputs end to end in the scratch, as the tape's numbers; NULL when memory is refused */
static const void *pack(kg_graph *graph, int count, const recording *r)
{
  if (!kg_buffer_reserve(&graph->scratch, graph->allocator, r->size * graph->number)) return NULL;
  char *to = graph->scratch.memory;
  for (int o = 0; o < count; ++o) {
    const size_t bytes = kg_size_of(r->tape, r->outputs[o]) * graph->number;
    memcpy(to, kg_node_data(&r->tape->graph, r->outputs[o].id), bytes);
    to += bytes;
  }
  return graph->scratch.memory;
}

/* output o of the child, out of the packed block of the tape: the same kind of value */
static kg_value unpack(kg_tape *tape, const recording *r, int o, kg_value packed, size_t start)
{
  const kg_value output = r->outputs[o];
  if (kg_is_scalar_node(output)) return kg_element(tape, packed, start);
  if (kg_size_of(r->tape, output) == r->size) {
    return kg_reshape(tape, packed, kg_shape_of(r->tape, output));
  }
  const int size = (int)kg_size_of(r->tape, output);
  return kg_reshape(tape, kg_slice(tape, packed, 0, (int)start, size),
                    kg_shape_of(r->tape, output));
}

kg_status kg_checkpoint(kg_tape *tape, kg_checkpointed segment, void *user, int input_count,
                        const kg_value *inputs, int output_count, kg_value *outputs)
{
  recording r;
  for (int o = 0; o < output_count; ++o) {
    outputs[o] = (kg_value){0};
  }
  if (tape->error.status != KG_OK || !kg_operands_given(tape, input_count, inputs)) {
    return tape->error.status;
  }
  if (input_count < 1 || input_count > KG_MAX_OPERANDS || output_count < 1 ||
      output_count > KG_MAX_OPERANDS) {
    kg_refuse(tape, KG_ERR_SHAPE, "checkpoint", "%d inputs, %d outputs; 1 to %d are possible",
              input_count, output_count, KG_MAX_OPERANDS);
    return tape->error.status;
  }
  tape->graph.detail = NULL;
  kg_status status = run_first(tape, segment, user, input_count, inputs, output_count, &r);
  const void *packed_numbers = status == KG_OK ? pack(&tape->graph, output_count, &r) : NULL;
  if (!packed_numbers) {
    status = status != KG_OK ? status : KG_ERR_NO_MEMORY;
    kg_refuse(tape, status, "checkpoint", "%s",
              tape->graph.detail ? tape->graph.detail : kg_status_text(status));
    return status;
  }
  kg_primitive_attributes attributes = {.primitive = &checkpoint_primitive,
                                        .user = user,
                                        .name = "checkpoint",
                                        .segment = segment,
                                        .outputs = output_count,
                                        .shape = KG_SHAPE((int32_t)r.size)};
  const kg_value packed =
    kg_record_primitive(tape, &attributes, input_count, inputs, packed_numbers);
  size_t start = 0;
  for (int o = 0; !kg_is_null(packed) && o < output_count; ++o) {
    outputs[o] = unpack(tape, &r, o, packed, start);
    start += kg_size_of(r.tape, r.outputs[o]);
  }
  return tape->error.status;
}
