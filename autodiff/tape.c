/* The tape: creation, inputs, recording, marks, errors, reading. */
#include "autodiff/tape.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* -- life -------------------------------------------------------------------------------------- */

kg_tape_def kg_tape_default_def(void)
{
  return (kg_tape_def){.precision = KG_DOUBLE, .simd = 3};
}

kg_status kg_tape_create(const kg_tape_def *def, kg_tape **tape, kg_error *error)
{
  const kg_tape_def settings = def ? *def : kg_tape_default_def();
  const kg_allocator *allocator = settings.allocator;
  *tape = NULL;
  kg_tape *t = allocator ? allocator->alloc(sizeof *t, allocator->user) : malloc(sizeof *t);
  if (!t) return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a tape");
  *t = (kg_tape){.precision = settings.precision, .simd = settings.simd};
  kg_arena_init(&t->arena, allocator);
  if (kg_graph_init(&t->graph, allocator) != KG_OK) {
    kg_tape_destroy(t);
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a tape");
  }
  t->graph.number = settings.precision == KG_DOUBLE ? sizeof(double) : sizeof(float);
  t->graph.kernels =
    kg_kernels_for(settings.precision == KG_DOUBLE ? KG_F64 : KG_F32, settings.simd);
  *tape = t;
  return KG_OK;
}

static void free_tags(kg_tape *tape)
{
  kg_buffer tags = {tape->tags, tape->tag_capacity * sizeof *tape->tags};
  kg_buffer_release(&tags, tape->graph.allocator);
}

void kg_tape_destroy(kg_tape *tape)
{
  if (!tape) return;
  const kg_allocator *allocator = tape->graph.allocator;
  free_tags(tape);
  kg_graph_release(&tape->graph);
  kg_arena_release(&tape->arena);
  kg_buffer self = {tape, sizeof *tape};
  kg_buffer_release(&self, allocator);
}

kg_tape_mark kg_tape_mark_of(const kg_tape *tape)
{
  const kg_arena_mark mark = kg_arena_mark_of(&tape->arena);
  return (kg_tape_mark){tape->graph.count, tape->graph.adjoint_size, mark.last, mark.used,
                        tape->tag_count};
}

void kg_tape_rewind(kg_tape *tape, kg_tape_mark mark)
{
  KG_ASSERT(mark.nodes <= tape->graph.count);
  tape->graph.count = mark.nodes ? mark.nodes : 1;
  if (tape->graph.swept > tape->graph.count) tape->graph.swept = tape->graph.count;
  tape->graph.adjoint_size = mark.adjoints;
  tape->tag_count = mark.tags;
  kg_arena_rewind(&tape->arena, (kg_arena_mark){mark.block, mark.used});
  tape->error.status = KG_OK;
  tape->error.text[0] = 0;
  tape->graph.status = KG_OK;
}

size_t kg_tape_nodes(const kg_tape *tape)
{
  return tape->graph.count - 1;
}

size_t kg_tape_bytes(const kg_tape *tape)
{
  const kg_graph *graph = &tape->graph;
  return sizeof *tape + kg_arena_bytes(&tape->arena) + graph->capacity * sizeof *graph->node +
         graph->scalar.bytes + graph->tensor.bytes + graph->pointers.bytes + graph->given.bytes +
         graph->scratch.bytes + tape->tag_capacity * sizeof *tape->tags +
         (graph->child ? kg_tape_bytes(graph->child) : 0);
}

/* -- errors and tags --------------------------------------------------------------------------- */

static bool grow_tags(kg_tape *tape)
{
  if (tape->tag_count < tape->tag_capacity) return true;
  const size_t capacity = tape->tag_capacity ? 2 * tape->tag_capacity : 16;
  kg_buffer larger = {0};
  if (!kg_buffer_reserve(&larger, tape->graph.allocator, capacity * sizeof *tape->tags)) {
    return false;
  }
  if (tape->tag_count) {
    memcpy(larger.memory, tape->tags, tape->tag_count * sizeof *tape->tags);
  }
  free_tags(tape);
  tape->tags = larger.memory;
  tape->tag_capacity = capacity;
  return true;
}

void kg_tape_tag(kg_tape *tape, const char *tag)
{
  kg_tag_range *last = tape->tag_count ? &tape->tags[tape->tag_count - 1] : NULL;
  if (last && last->first == tape->graph.count) {
    last->text = tag;
  } else if (grow_tags(tape)) {
    tape->tags[tape->tag_count++] = (kg_tag_range){tape->graph.count, tag};
  } else {
    kg_refuse(tape, KG_ERR_NO_MEMORY, "tag", "no memory");
  }
}

const char *kg_tag_at(const kg_tape *tape, uint32_t node)
{
  size_t low = 0, high = tape->tag_count; /* the last range that starts at or before node */
  while (low < high) {
    const size_t middle = (low + high) / 2;
    if (tape->tags[middle].first <= node) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low ? tape->tags[low - 1].text : NULL;
}

static void set_error(kg_tape *tape, uint32_t node, kg_status status, const char *name,
                      const char *text)
{
  const char *tag = kg_tag_at(tape, node);
  kg_fail(&tape->error, status, "", 0, 0, "%s%s%s%s: %.400s", name, tag ? " [" : "", tag ? tag : "",
          tag ? "]" : "", text);
}

kg_value kg_refuse(kg_tape *tape, kg_status status, const char *operator_name, const char *format,
                   ...)
{
  if (tape->error.status != KG_OK) return (kg_value){0};
  char text[sizeof tape->error.text];
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(text, sizeof text, format, arguments);
  va_end(arguments);
  set_error(tape, tape->graph.count, status, operator_name, text);
  return (kg_value){0};
}

void kg_refuse_node(kg_tape *tape, uint32_t node, kg_status status)
{
  if (tape->error.status != KG_OK) return;
  const char *detail = tape->graph.detail;
  set_error(tape, node, status, kg_node_name(&tape->graph.node[node]),
            detail ? detail : kg_status_text(status));
}

kg_status kg_sweep_status(kg_tape *tape)
{
  if (tape->graph.status != KG_OK) kg_refuse_node(tape, tape->graph.failed, tape->graph.status);
  return tape->error.status;
}

kg_status kg_tape_status(const kg_tape *tape)
{
  return tape->error.status;
}

const kg_error *kg_tape_error(const kg_tape *tape)
{
  return &tape->error;
}

/* -- shapes ------------------------------------------------------------------------------------ */

kg_shape_text kg_shape_print(kg_shape shape)
{
  kg_shape_text out = {"("};
  size_t used = 1;
  for (int i = 0; i < shape.rank && i < KG_MAX_RANK; ++i) {
    used += (size_t)snprintf(out.text + used, sizeof out.text - used, "%s%d", i ? ", " : "",
                             (int)shape.dim[i]);
  }
  snprintf(out.text + used, sizeof out.text - used, ")");
  return out;
}

bool kg_same_shape(kg_shape a, kg_shape b)
{
  for (int i = 0; a.rank == b.rank && i < a.rank; ++i) {
    if (a.dim[i] != b.dim[i]) return false;
  }
  return a.rank == b.rank;
}

bool kg_shape_is_valid(kg_shape shape)
{
  if (shape.rank < 0 || shape.rank > KG_MAX_RANK) return false;
  size_t size = 1;
  for (int i = 0; i < shape.rank; ++i) {
    if (shape.dim[i] < 1 || size > SIZE_MAX / 64 / (size_t)shape.dim[i]) return false;
    size *= (size_t)shape.dim[i];
  }
  return true;
}

bool kg_check_shape(kg_tape *tape, kg_op op, kg_shape shape)
{
  if (kg_shape_is_valid(shape)) return true;
  kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op),
            "shape %s of rank %d: ranks 0 to %d, extents from 1, entries that can be counted",
            kg_shape_print(shape).text, (int)shape.rank, KG_MAX_RANK);
  return false;
}

int kg_axis_of(kg_tape *tape, const char *operator_name, kg_shape shape, int axis)
{
  const int from_front = axis < 0 ? axis + shape.rank : axis;
  if (from_front < 0 || from_front >= shape.rank) {
    kg_refuse(tape, KG_ERR_SHAPE, operator_name, "axis %d of a tensor of shape %s", axis,
              kg_shape_print(shape).text);
    return -1;
  }
  return from_front;
}

kg_axis_split kg_split(kg_shape shape, int axis)
{
  kg_axis_split split = {1, (size_t)shape.dim[axis], 1};
  for (int i = 0; i < axis; ++i) {
    split.outer *= (size_t)shape.dim[i];
  }
  for (int i = axis + 1; i < shape.rank; ++i) {
    split.inner *= (size_t)shape.dim[i];
  }
  return split;
}

kg_shape kg_without_axis(kg_shape shape, int axis)
{
  for (int i = axis; i + 1 < shape.rank; ++i) {
    shape.dim[i] = shape.dim[i + 1];
  }
  shape.dim[--shape.rank] = 0;
  return shape;
}

bool kg_operands_given(kg_tape *tape, int count, const kg_value *values)
{
  for (int i = 0; i < count; ++i) {
    KG_ASSERT(kg_index(values[i].id) < tape->graph.count);
    if (!values[i].id) {
      kg_refuse(tape, KG_ERR_UNDEFINED, "operand", "the null value, from no failed operator");
      return false;
    }
  }
  return true;
}

/* -- recording --------------------------------------------------------------------------------- */

static size_t round_up(size_t bytes, size_t multiple)
{
  return (bytes + multiple - 1) / multiple * multiple;
}

/* block, operands and attributes in one piece, numbers aligned for vectors in a second */
static kg_block *new_block(kg_tape *tape, const kg_recipe *recipe)
{
  const size_t head = round_up(sizeof(kg_block), 8);
  const size_t operands = round_up((size_t)recipe->count * sizeof(uint32_t), 8);
  const size_t attributes = recipe->attributes_taken ? 0 : round_up(recipe->attribute_bytes, 8);
  const size_t size = kg_shape_size(&recipe->shape), number = tape->graph.number;
  const size_t align = size * number >= 1024 ? 64 : 16; /* of small ones no room is lost */
  char *memory = kg_arena_take(&tape->arena, head + operands + attributes, 16);
  char *data = recipe->alias ? NULL : kg_arena_take(&tape->arena, size * number, align);
  char *saved = recipe->saved ? kg_arena_take(&tape->arena, recipe->saved * number, align) : NULL;
  if (kg_arena_failed(&tape->arena)) return NULL;
  kg_block *block = (kg_block *)memory;
  *block = (kg_block){.kernel = &tape->graph.kernels[recipe->op],
                      .shape = recipe->shape,
                      .count = recipe->count,
                      .input = (uint32_t *)(memory + head),
                      .attributes = attributes ? memory + head + operands : recipe->attributes,
                      .attribute_bytes = recipe->attribute_bytes,
                      .size = size,
                      .saved_size = recipe->saved,
                      .data = data,
                      .saved = saved};
  if (attributes) memcpy(memory + head + operands, recipe->attributes, recipe->attribute_bytes);
  return block;
}

/* copies the operands' ids; true when one of them is active */
static bool connect(kg_tape *tape, kg_block *block, const kg_recipe *recipe)
{
  uint32_t *input = (uint32_t *)block->input;
  bool active = false;
  for (int i = 0; i < recipe->count; ++i) {
    input[i] = recipe->operands[i].id;
    active = active || kg_node_of(tape, recipe->operands[i])->active;
  }
  return active;
}

/* a block as the newest node, not evaluated; NULL when memory is refused */
static kg_node *push_block(kg_tape *tape, const kg_recipe *recipe)
{
  kg_graph *graph = &tape->graph;
  const kg_arena_mark mark = kg_arena_mark_of(&tape->arena);
  kg_block *block = new_block(tape, recipe);
  if (!block || !kg_graph_reserve(graph)) {
    kg_arena_rewind(&tape->arena, mark);
    kg_refuse(tape, KG_ERR_NO_MEMORY, kg_operator_name(recipe->op, recipe->attributes),
              "no memory for a result of shape %s", kg_shape_print(recipe->shape).text);
    return NULL;
  }
  const bool active = connect(tape, block, recipe);
  if (recipe->alias) block->data = (void *)recipe->alias;
  kg_node *node = &graph->node[graph->count++];
  *node = (kg_node){.is.block = block,
                    .op = (uint16_t)recipe->op,
                    .is_block = true,
                    .active = active && !recipe->constant};
  block->adjoint = graph->adjoint_size;
  if (node->active) graph->adjoint_size += block->size;
  if (recipe->count > graph->widest) graph->widest = recipe->count;
  return node;
}

void *kg_take_attributes(kg_tape *tape, kg_op op, size_t bytes)
{
  if (tape->error.status != KG_OK) return NULL;
  const kg_arena_mark mark = kg_arena_mark_of(&tape->arena);
  void *memory = kg_arena_take(&tape->arena, bytes, 16);
  if (!memory) {
    kg_arena_rewind(&tape->arena, mark);
    kg_refuse(tape, KG_ERR_NO_MEMORY, kg_op_name(op), "no memory for its %zu bytes of indices",
              bytes);
  }
  return memory;
}

kg_value kg_record(kg_tape *tape, const kg_recipe *recipe)
{
  if (tape->error.status != KG_OK) return (kg_value){0};
  kg_node *node = push_block(tape, recipe);
  if (!node) return (kg_value){0};
  if (recipe->known) {
    memcpy(node->is.block->data, recipe->known, node->is.block->size * tape->graph.number);
  } else if (!recipe->alias) {
    const kg_status status = kg_graph_evaluate(&tape->graph, node);
    if (status != KG_OK) {
      kg_refuse_node(tape, --tape->graph.count, status);
      return (kg_value){0};
    }
  }
  return (kg_value){(tape->graph.count - 1) | KG_TENSOR};
}

/* -- inputs ------------------------------------------------------------------------------------ */

static kg_block *leaf(kg_tape *tape, kg_op op, kg_shape shape, kg_value *value)
{
  *value = (kg_value){0};
  if (tape->error.status != KG_OK) return NULL;
  if (!kg_check_shape(tape, op, shape)) return NULL;
  kg_node *node = push_block(tape, &(kg_recipe){.op = op, .shape = shape});
  if (!node) return NULL;
  node->active = op == kg_op_input;
  if (node->active) tape->graph.adjoint_size += node->is.block->size;
  *value = (kg_value){(tape->graph.count - 1) | KG_TENSOR};
  return node->is.block;
}

static kg_value leaf_f64(kg_tape *tape, kg_op op, kg_shape shape, const double *data)
{
  kg_value value;
  kg_block *block = leaf(tape, op, shape, &value);
  for (size_t i = 0; block && i < block->size; ++i) {
    const double x = data ? data[i] : 0;
    if (tape->precision == KG_DOUBLE) {
      ((double *)block->data)[i] = x;
    } else {
      ((float *)block->data)[i] = (float)x;
    }
  }
  return value;
}

static kg_value leaf_f32(kg_tape *tape, kg_op op, kg_shape shape, const float *data)
{
  kg_value value;
  kg_block *block = leaf(tape, op, shape, &value);
  for (size_t i = 0; block && i < block->size; ++i) {
    const float x = data ? data[i] : 0;
    if (tape->precision == KG_DOUBLE) {
      ((double *)block->data)[i] = x;
    } else {
      ((float *)block->data)[i] = x;
    }
  }
  return value;
}

kg_value kg_input(kg_tape *tape, kg_shape shape, const double *data)
{
  return leaf_f64(tape, kg_op_input, shape, data);
}

kg_value kg_input_f32(kg_tape *tape, kg_shape shape, const float *data)
{
  return leaf_f32(tape, kg_op_input, shape, data);
}

kg_value kg_constant(kg_tape *tape, kg_shape shape, const double *data)
{
  return leaf_f64(tape, kg_op_constant, shape, data);
}

kg_value kg_constant_f32(kg_tape *tape, kg_shape shape, const float *data)
{
  return leaf_f32(tape, kg_op_constant, shape, data);
}

static inline kg_value scalar_leaf(kg_tape *tape, kg_op op, double x)
{
  if (tape->precision != KG_DOUBLE) return leaf_f64(tape, op, KG_SCALAR_SHAPE, &x);
  kg_graph *graph = &tape->graph;
  if (tape->error.status != KG_OK) return (kg_value){0};
  if (graph->count == graph->capacity && !kg_graph_reserve(graph)) {
    return kg_refuse(tape, KG_ERR_NO_MEMORY, kg_op_name(op), "no memory");
  }
  kg_node *node = &graph->node[graph->count];
  node->is.value = x;
  node->partial[0] = node->partial[1] = 0;
  node->input[0] = node->input[1] = 0;
  node->op = (uint16_t)op;
  node->is_block = false;
  node->active = op == kg_op_input;
  return (kg_value){graph->count++};
}

kg_value kg_scalar(kg_tape *tape, double x)
{
  return scalar_leaf(tape, kg_op_input, x);
}

void kg_scalars(kg_tape *tape, int count, const double *x, kg_value *values)
{
  for (int i = 0; i < count; ++i) {
    values[i] = scalar_leaf(tape, kg_op_input, x[i]);
  }
  for (int i = 0; tape->error.status != KG_OK && i < count; ++i) {
    values[i] = (kg_value){0};
  }
}

kg_value kg_constant_scalar(kg_tape *tape, double x)
{
  return scalar_leaf(tape, kg_op_constant, x);
}

/* -- reading ----------------------------------------------------------------------------------- */

bool kg_is_null(kg_value value)
{
  return value.id == 0;
}

kg_shape kg_shape_of(const kg_tape *tape, kg_value value)
{
  return value.id & KG_TENSOR ? kg_node_of(tape, value)->is.block->shape : KG_SCALAR_SHAPE;
}

size_t kg_size_of(const kg_tape *tape, kg_value value)
{
  if (!value.id) return 0;
  return value.id & KG_TENSOR ? kg_node_of(tape, value)->is.block->size : 1;
}

const double *kg_data(const kg_tape *tape, kg_value value)
{
  return value.id && tape->precision == KG_DOUBLE ? kg_node_data(&tape->graph, value.id) : NULL;
}

const float *kg_data_f32(const kg_tape *tape, kg_value value)
{
  return value.id && tape->precision == KG_FLOAT ? kg_node_data(&tape->graph, value.id) : NULL;
}

double kg_item_at(const kg_tape *tape, kg_value value, size_t index)
{
  if (!value.id) return NAN;
  KG_ASSERT(index < kg_size_of(tape, value));
  const void *data = kg_node_data(&tape->graph, value.id);
  return tape->precision == KG_DOUBLE ? ((const double *)data)[index]
                                      : ((const float *)data)[index];
}

double kg_item(const kg_tape *tape, kg_value value)
{
  return kg_item_at(tape, value, 0);
}
