/* Custom primitives: recording a call, and the kernels that hand its numbers to the user's
 * callbacks. */
#include "autodiff/primitive.h"

#include <stddef.h>
#include <stdio.h>
#include <string.h>

/* -- recording --------------------------------------------------------------------------------- */

/* "(3), (64, 48)" as far as it fits */
static void print_shapes(char *text, size_t size, int count, const kg_shape *shapes)
{
  size_t used = 0;
  text[0] = 0;
  for (int i = 0; i < count && used < size; ++i) {
    used += (size_t)snprintf(text + used, size - used, "%s%s", i ? ", " : "",
                             kg_shape_print(shapes[i]).text);
  }
}

static bool shape_result(kg_tape *tape, kg_primitive_attributes *a, int count)
{
  const kg_status status = a->primitive->shape(a->user, count, a->shapes, &a->shape, &a->saved);
  if (status == KG_OK && kg_shape_is_valid(a->shape)) return true;
  char text[256];
  print_shapes(text, sizeof text, count, a->shapes);
  kg_refuse(
    tape, status != KG_OK ? status : KG_ERR_SHAPE, a->name, "operands of shapes %s: %s", text,
    status != KG_OK ? kg_status_text(status) : "the primitive gives its result no valid shape");
  return false;
}

kg_value kg_record_primitive(kg_tape *tape, kg_primitive_attributes *a, int count,
                             const kg_value *operands, const void *known)
{
  if (count < 1 || count > KG_MAX_OPERANDS) {
    return kg_refuse(tape, KG_ERR_SHAPE, a->name, "%d operands; 1 to %d are possible", count,
                     KG_MAX_OPERANDS);
  }
  if (!kg_operands_given(tape, count, operands)) return (kg_value){0};
  for (int i = 0; i < count; ++i) {
    a->shapes[i] = kg_shape_of(tape, operands[i]);
    a->scalars |= kg_is_scalar_node(operands[i]) ? 1u << i : 0;
  }
  if (!known && !shape_result(tape, a, count)) return (kg_value){0};
  const size_t head = offsetof(kg_primitive_attributes, shapes);
  return kg_record(tape, &(kg_recipe){
                           .op = kg_op_primitive,
                           .count = count,
                           .operands = operands,
                           .shape = a->shape,
                           .attributes = a,
                           .attribute_bytes = head + (size_t)count * sizeof(kg_shape),
                           .saved = a->saved * sizeof(double) / tape->graph.number,
                           .known = known,
                         });
}

kg_value kg_apply(kg_tape *tape, const kg_primitive *primitive, int count, const kg_value *operands)
{
  kg_primitive_attributes attributes = {
    .primitive = primitive, .user = primitive->user, .name = primitive->name};
  return kg_record_primitive(tape, &attributes, count, operands, NULL);
}

const char *kg_operator_name(kg_op op, const void *attributes)
{
  if (op != kg_op_primitive) return kg_op_name(op);
  return ((const kg_primitive_attributes *)attributes)->name;
}

const char *kg_node_name(const kg_node *node)
{
  return kg_operator_name(node->op, node->is_block ? node->is.block->attributes : NULL);
}

/* -- numbers for the callbacks ----------------------------------------------------------------- */

/* An entry of the graph is `number` bytes: a float, a double, or two for a complex one. Of it,
 * `width` doubles from number `first` on are handed over. */
typedef struct exchange {
  kg_primitive_frame frame; /* the first member */
  const kg_call *of;
  size_t lane, first, width;
  bool direct; /* the graph's numbers are what callbacks expect: no copies */
  double *scratch;
  const double *in[KG_MAX_OPERANDS];
  double *in_adjoint[KG_MAX_OPERANDS];
} exchange;

static bool has_complex_form(const kg_call *call)
{
  const kg_primitive_attributes *a = call->attributes;
  return call->graph->number == 2 * sizeof(double) && a->primitive->complex_forward;
}

static size_t operand_entries(const kg_call *call)
{
  const kg_primitive_attributes *a = call->attributes;
  size_t entries = 0;
  for (int i = 0; i < call->count; ++i) {
    entries += kg_shape_size(&a->shapes[i]);
  }
  return entries;
}

/* false when memory is refused */
static bool open_exchange(exchange *e, const kg_call *call)
{
  const size_t width = has_complex_form(call) ? 2 : 1;
  kg_graph *graph = call->graph;
  *e = (exchange){.of = call, .width = width};
  e->direct = call->lanes == 1 && graph->number == width * sizeof(double);
  e->frame.attributes = call->attributes;
  e->frame.graph = graph;
  graph->failed_lane = KG_NO_LANE;
  const size_t numbers = 2 * (operand_entries(call) + call->size) * width;
  return e->direct ||
         kg_buffer_reserve(&graph->scratch, graph->allocator, numbers * sizeof(double));
}

static double *place_of(const exchange *e, const void *array, size_t i, size_t j)
{
  const size_t entry = i * e->of->lanes + e->lane;
  return (double *)array + entry * (e->frame.graph->number / sizeof(double)) + e->first + j;
}

static double *load(exchange *e, const void *array, size_t n)
{
  if (e->direct) return (double *)array;
  double *to = e->scratch;
  e->scratch += n * e->width;
  for (size_t i = 0; i < n * e->width; ++i) {
    to[i] = e->frame.graph->number == sizeof(float)
              ? (double)((const float *)array)[i * e->of->lanes + e->lane]
              : *place_of(e, array, i / e->width, i % e->width);
  }
  return to;
}

static void store(const exchange *e, const double *from, void *array, size_t n)
{
  for (size_t i = 0; !e->direct && i < n * e->width; ++i) {
    if (e->frame.graph->number == sizeof(float)) {
      ((float *)array)[i * e->of->lanes + e->lane] = (float)from[i];
    } else {
      *place_of(e, array, i / e->width, i % e->width) = from[i];
    }
  }
}

/* the call of one lane: operands and result as they are */
static const kg_primitive_call *load_call(exchange *e, size_t lane)
{
  const kg_primitive_attributes *a = e->frame.attributes;
  e->lane = lane;
  e->frame.graph->failed_lane = lane; /* should it fail */
  e->scratch = e->frame.graph->scratch.memory;
  for (int i = 0; i < e->of->count; ++i) {
    e->in[i] = load(e, e->of->in[i], kg_shape_size(&a->shapes[i]));
  }
  const size_t per_number = e->frame.graph->number > sizeof(double) ? 2 : 1;
  e->frame.call =
    (kg_primitive_call){.user = a->user,
                        .count = e->of->count,
                        .shapes = a->shapes,
                        .in = e->in,
                        .shape = a->shape,
                        .out = load(e, e->of->out, e->of->size),
                        .saved = (double *)e->of->saved + lane * a->saved * per_number};
  return &e->frame.call;
}

/* the arrays that go with the operands: adjoints or tangents, NULL where they are */
static double *const *load_operands(exchange *e, const void *const *arrays)
{
  for (int i = 0; i < e->of->count; ++i) {
    const size_t n = kg_shape_size(&e->frame.attributes->shapes[i]);
    e->in_adjoint[i] = arrays[i] ? load(e, arrays[i], n) : NULL;
  }
  return e->in_adjoint;
}

/* -- kernels ----------------------------------------------------------------------------------- */

static kg_status missing(kg_graph *graph, const char *detail)
{
  graph->detail = detail;
  graph->failed_lane = KG_NO_LANE;
  return KG_ERR_UNSUPPORTED;
}

/* f(x + i h d) = f(x) + i h J d while h^2 vanishes beside 1: a complex step needs no more than the
 * JVP */
static kg_status step_forward(exchange *e, size_t lane)
{
  const kg_primitive *primitive = e->frame.attributes->primitive;
  if (!primitive->jvp) return missing(e->frame.graph, "has neither a complex form nor a JVP");
  const kg_primitive_call *call = load_call(e, lane);
  kg_status status = primitive->forward(call);
  if (status != KG_OK) return status;
  store(e, call->out, e->of->out, e->of->size);
  e->first = 1;
  const double *const *tangents = (const double *const *)load_operands(e, e->of->in);
  double *tangent = load(e, e->of->out, e->of->size);
  memset(tangent, 0, e->of->size * sizeof *tangent);
  status = primitive->jvp(call, tangents, tangent);
  store(e, tangent, e->of->out, e->of->size);
  e->first = 0;
  return status;
}

static kg_status plain_forward(exchange *e, size_t lane)
{
  const kg_primitive *primitive = e->frame.attributes->primitive;
  const kg_primitive_call *call = load_call(e, lane);
  const kg_status status =
    e->width == 2 ? primitive->complex_forward(call) : primitive->forward(call);
  store(e, call->out, e->of->out, e->of->size);
  return status;
}

kg_status kg_primitive_forward(const kg_call *call)
{
  exchange e;
  if (!open_exchange(&e, call)) return KG_ERR_NO_MEMORY;
  const bool step = call->graph->number > sizeof(double) && e.width == 1;
  kg_status status = KG_OK;
  for (size_t lane = 0; lane < call->lanes && status == KG_OK; ++lane) {
    status = step ? step_forward(&e, lane) : plain_forward(&e, lane);
  }
  return status;
}

static kg_status vjp_of_lane(exchange *e, size_t lane, const void *adjoint, void *const *in_adjoint)
{
  const kg_primitive *primitive = e->frame.attributes->primitive;
  const kg_primitive_call *call = load_call(e, lane);
  const double *seed = load(e, adjoint, e->of->size);
  double *const *sums = load_operands(e, (const void *const *)in_adjoint);
  const kg_status status =
    e->width == 2 ? primitive->complex_vjp(call, seed, sums) : primitive->vjp(call, seed, sums);
  for (int i = 0; i < e->of->count; ++i) {
    if (sums[i]) store(e, sums[i], in_adjoint[i], kg_shape_size(&e->frame.attributes->shapes[i]));
  }
  return status;
}

void kg_primitive_vjp(const kg_call *call, const void *adjoint, void *const *in_adjoint)
{
  exchange e;
  kg_graph *graph = call->graph;
  if (!open_exchange(&e, call)) {
    graph->status = KG_ERR_NO_MEMORY;
  } else if (graph->number > sizeof(double) &&
             !(e.width == 2 && e.frame.attributes->primitive->complex_vjp)) {
    graph->status = missing(graph, "has no complex form");
  }
  for (size_t lane = 0; lane < call->lanes && graph->status == KG_OK; ++lane) {
    graph->status = vjp_of_lane(&e, lane, adjoint, in_adjoint);
  }
}

static kg_status jvp_of_lane(exchange *e, size_t lane, const void *const *in_tangent, void *tangent)
{
  const kg_primitive_call *call = load_call(e, lane);
  const double *const *tangents = (const double *const *)load_operands(e, in_tangent);
  double *sum = load(e, tangent, e->of->size);
  memset(sum, 0, e->of->size * sizeof *sum);
  const kg_status status = e->frame.attributes->primitive->jvp(call, tangents, sum);
  store(e, sum, tangent, e->of->size);
  return status;
}

void kg_primitive_jvp(const kg_call *call, const void *const *in_tangent, void *tangent)
{
  exchange e;
  kg_graph *graph = call->graph;
  const kg_primitive_attributes *a = call->attributes;
  if (graph->number > sizeof(double) || !a->primitive->jvp) {
    graph->status = missing(graph, a->primitive->jvp ? "has no complex JVP" : "has no JVP");
  } else if (!open_exchange(&e, call)) {
    graph->status = KG_ERR_NO_MEMORY;
  }
  for (size_t lane = 0; lane < call->lanes && graph->status == KG_OK; ++lane) {
    graph->status = jvp_of_lane(&e, lane, in_tangent, tangent);
  }
}
