/* Walks over a graph: backward with adjoints, forward with tangents, several directions at once.
 *
 * Scalar nodes need no dispatch: with partials p of the operands,
 *   backward   adjoint(operand) += p adjoint(node)
 *   forward    tangent(node) = sum p tangent(operand)
 * Adjoints of blocks become zero when something first touches them, so parts of the graph that
 * the seeds do not reach cost nothing. A zero adjoint adds nothing, whatever the partial. */
#include "autodiff/attributes.h"

#include <string.h>

enum {
  FEW = 4, /* entries whose tangents are worth a look */
  FAR = 64,
  NEAR = 20 /* nodes before their turn */
};

kg_call kg_block_call(kg_graph *graph, const kg_block *block, const void **in)
{
  for (int i = 0; i < block->count; ++i) {
    in[i] = kg_node_data(graph, block->input[i]);
  }
  return (kg_call){.attributes = block->attributes,
                   .size = block->size,
                   .lanes = graph->lanes,
                   .count = block->count,
                   .in = in,
                   .out = block->data,
                   .saved = block->saved,
                   .graph = graph};
}

bool kg_graph_reserve_pointers(kg_graph *graph)
{
  const size_t one = sizeof(void *) > sizeof(uint64_t) ? sizeof(void *) : sizeof(uint64_t);
  return kg_buffer_reserve(&graph->pointers, graph->allocator,
                           3 * (size_t)(graph->widest + 1) * one);
}

kg_status kg_graph_evaluate(kg_graph *graph, kg_node *node)
{
  kg_block *block = node->is.block;
  if (!block->kernel->forward) return KG_OK; /* input or constant */
  graph->detail = NULL;
  if (!kg_graph_reserve_pointers(graph)) return KG_ERR_NO_MEMORY;
  const kg_call call = kg_block_call(graph, block, graph->pointers.memory);
  return block->kernel->forward(&call);
}

kg_status kg_sweep_begin(kg_graph *graph, int directions)
{
  const size_t s = (size_t)directions;
  graph->directions = 0;
  graph->status = KG_OK;
  graph->detail = NULL;
  if (!kg_buffer_reserve(&graph->scalar, graph->allocator, graph->count * s * sizeof(double)) ||
      !kg_buffer_reserve(&graph->tensor, graph->allocator,
                         graph->adjoint_size * s * graph->lanes * graph->number) ||
      !kg_graph_reserve_pointers(graph)) {
    return KG_ERR_NO_MEMORY;
  }
  memset(graph->scalar.memory, 0, graph->count * s * sizeof(double));
  ++graph->stamp;
  graph->directions = directions;
  graph->swept = graph->count;
  graph->complete = KG_NO_ADJOINTS;
  return KG_OK;
}

static void *block_adjoint(const kg_graph *graph, const kg_block *block)
{
  const size_t row = (size_t)graph->directions * graph->lanes * graph->number;
  return (char *)graph->tensor.memory + block->adjoint * row;
}

static inline bool is_reached(uint64_t reached, int direction)
{
  return reached >> (direction & 63) & 1;
}

static void clear_unreached(const kg_graph *graph, kg_block *block)
{
  const size_t bytes = block->size * graph->lanes * graph->number;
  for (int s = 0; block->reached != KG_ALL && s < graph->directions; ++s) {
    if (is_reached(block->reached, s)) continue;
    memset((char *)block_adjoint(graph, block) + (size_t)s * bytes, 0, bytes);
  }
  block->reached = KG_ALL;
}

void *kg_sweep_seed(kg_graph *graph, uint32_t id)
{
  const kg_node *node = &graph->node[kg_index(id)];
  if (!node->active) return NULL;
  if (!(id & KG_TENSOR)) {
    return kg_scalar_adjoint(graph, id);
  }
  return kg_sweep_touch(graph, node->is.block,
                        (size_t)graph->directions * graph->lanes * graph->number, NULL);
}

void *kg_sweep_result(const kg_graph *graph, uint32_t id)
{
  const kg_node *node = &graph->node[kg_index(id)];
  if (!node->active || !graph->directions || kg_index(id) >= graph->swept) return NULL;
  if (!(id & KG_TENSOR)) {
    return kg_scalar_adjoint(graph, id);
  }
  if (node->is.block->stamp != graph->stamp) return NULL;
  clear_unreached(graph, node->is.block);
  return block_adjoint(graph, node->is.block);
}

/* bytes from one direction of a value's adjoint to the next */
static size_t stride_of(const kg_graph *graph, uint32_t id)
{
  const kg_node *node = &graph->node[kg_index(id)];
  return id & KG_TENSOR ? node->is.block->size * graph->lanes * graph->number : sizeof(double);
}

/* A long record is met in main memory: a block's head, operands, attributes and first numbers,
 * which lie side by side, and then its adjoint, are fetched before their turn. Inlined by force:
 * gcc 12 drops calls of a function that does nothing else. */
static inline __attribute__((always_inline)) void fetch(const kg_graph *graph, const kg_node *node)
{
  if (node - graph->node <= FAR) return;
  const kg_node *far = node - FAR, *near = node - NEAR;
  for (size_t line = 0; far->is_block && line < 5; ++line) {
    __builtin_prefetch((const char *)far->is.block + 64 * line);
  }
  for (size_t line = 0; near->is_block && line < 2; ++line) {
    __builtin_prefetch((const char *)block_adjoint(graph, near->is.block) + 64 * line, 1);
  }
}

bool kg_writes_adjoints(const kg_node *node)
{
  if (node->op < kg_op_neg || node->op > kg_op_max) return false;
  return node->is.block->attribute_bytes == KG_FLAT_BYTES;
}

/* adjoint of operand i; its bit in *fresh, when that is given, says that nothing is there yet */
static void *touch(kg_graph *graph, uint32_t id, unsigned *fresh, int i)
{
  const kg_node *node = &graph->node[kg_index(id)];
  if (!fresh || !node->active || !(id & KG_TENSOR)) return kg_sweep_seed(graph, id);
  const size_t entry = (size_t)graph->directions * graph->lanes * graph->number;
  bool untouched = false;
  void *adjoint = kg_sweep_touch(graph, node->is.block, entry, &untouched);
  *fresh |= (unsigned)untouched << i;
  return adjoint;
}

static void backward_block(kg_graph *graph, const kg_node *node)
{
  const kg_block *block = node->is.block;
  fetch(graph, node);
  if (!node->active || block->stamp != graph->stamp || !block->count) return;
  const void **in = graph->pointers.memory;
  void **in_adjoint = (void **)(in + graph->widest + 1);
  kg_call call = kg_block_call(graph, block, in);
  const char *adjoint = block_adjoint(graph, block);
  const size_t stride = block->size * graph->lanes * graph->number;
  const bool writes = kg_writes_adjoints(node);
  for (int i = 0; i < block->count; ++i) {
    in_adjoint[i] = touch(graph, block->input[i], writes ? &call.fresh : NULL, i);
  }
  for (int s = 0; s < graph->directions; ++s) {
    block->kernel->vjp(&call, adjoint + (size_t)s * stride, in_adjoint);
    for (int i = 0; s + 1 < graph->directions && i < block->count; ++i) {
      if (in_adjoint[i]) in_adjoint[i] = (char *)in_adjoint[i] + stride_of(graph, block->input[i]);
    }
  }
  graph->failed = (uint32_t)(node - graph->node);
}

/* an entry of a tensor became a scalar; the tensor is not touched for nothing */
static void backward_element(kg_graph *graph, const kg_node *node, const double *adjoint)
{
  bool any = false;
  for (int s = 0; s < graph->directions; ++s) {
    any = any || adjoint[s] != 0;
  }
  if (!any) return;
  double *tensor = kg_sweep_seed(graph, node->input[0]);
  const size_t size = graph->node[kg_index(node->input[0])].is.block->size;
  for (size_t s = 0; tensor && s < (size_t)graph->directions; ++s) {
    tensor[s * size + node->input[1]] += adjoint[s];
  }
}

/* blocks, and entries of tensors that became scalars */
static __attribute__((noinline)) void backward_other(kg_graph *graph, const kg_node *node,
                                                     const double *adjoint)
{
  if (node->is_block) {
    backward_block(graph, node);
  } else {
    backward_element(graph, node, adjoint);
  }
}

/* Adjoints of a scalar in one and in two directions. */
typedef double single;
typedef double pair __attribute__((vector_size(16), aligned(8), may_alias));
typedef int64_t pair_mask __attribute__((vector_size(16)));

/* partial adjoint, nothing where the adjoint is zero */
static inline single single_term(double partial, single adjoint)
{
  const single term = partial * adjoint;
  return adjoint != 0 ? term : 0;
}

static inline pair pair_term(double partial, pair adjoint)
{
  const pair term = partial * adjoint;
  return (pair)((pair_mask)(adjoint != 0) & (pair_mask)term);
}

/* From the newest node to node `last`. The node before often waits for what this one adds to it:
 * that is `carried` to it in a register, for memory just written takes long to read. */
#define BACKWARD_ADD(type, k)                                                                      \
  do {                                                                                             \
    const uint32_t to = node->input[k];                                                            \
    const type sum = scalar[to] + type##_term(node->partial[k], adjoint);                          \
    scalar[to] = sum;                                                                              \
    if (to == i - 1) {                                                                             \
      carried = sum;                                                                               \
      carried_to = to;                                                                             \
    }                                                                                              \
  } while (0)
#define BACKWARD(type)                                                                             \
  static void backward_##type(kg_graph *graph, uint32_t last)                                      \
  {                                                                                                \
    type *scalar = graph->scalar.memory, carried = {0};                                            \
    uint32_t carried_to = 0;                                                                       \
    for (uint32_t i = graph->swept - 1; i >= last && i > 0; --i) {                                 \
      const kg_node *node = &graph->node[i];                                                       \
      if ((int32_t)node->input[0] <= 0) {                                                          \
        if (!node->input[0] && !node->is_block) continue; /* a leaf */                             \
        backward_other(graph, node, (const double *)&scalar[i]);                                   \
        if (graph->status != KG_OK) return;                                                        \
        continue;                                                                                  \
      }                                                                                            \
      type adjoint;                                                                                \
      if (carried_to == i) {                                                                       \
        adjoint = carried;                                                                         \
      } else {                                                                                     \
        adjoint = scalar[i];                                                                       \
      }                                                                                            \
      BACKWARD_ADD(type, 0);                                                                       \
      if (node->input[1]) BACKWARD_ADD(type, 1);                                                   \
    }                                                                                              \
  }
BACKWARD(single)
BACKWARD(pair)

/* the same for any number of directions */
static void backward(kg_graph *graph, uint32_t last)
{
  const size_t directions = (size_t)graph->directions;
  double *scalar = graph->scalar.memory;
  for (uint32_t i = graph->swept - 1; i >= last && i > 0; --i) {
    const kg_node *node = &graph->node[i];
    const double *adjoint = scalar + i * directions;
    if ((int32_t)node->input[0] <= 0) {
      if (!node->input[0] && !node->is_block) continue; /* a leaf */
      backward_other(graph, node, adjoint);
      if (graph->status != KG_OK) return;
      continue;
    }
    for (int k = 0; k < 2 && node->input[k]; ++k) {
      double *to = scalar + node->input[k] * directions;
      size_t s = 0;
      for (; s + 2 <= directions; s += 2) {
        *(pair *)(to + s) += pair_term(node->partial[k], *(const pair *)(adjoint + s));
      }
      if (s < directions) to[s] += single_term(node->partial[k], adjoint[s]);
    }
  }
}

void kg_sweep_backward(kg_graph *graph, uint32_t last)
{
  graph->complete = last ? last - 1 : 0;
  switch (graph->directions) {
    case 1:
      backward_single(graph, last);
      break;
    case 2:
      backward_pair(graph, last);
      break;
    default:
      backward(graph, last);
      break;
  }
}

/* the directions of an operand in which its tangent is not known to be zero */
static uint64_t directions_of(const kg_graph *graph, uint32_t id)
{
  const kg_node *node = &graph->node[kg_index(id)];
  if (!node->active) return 0;
  if (id & KG_TENSOR) return node->is.block->stamp == graph->stamp ? node->is.block->reached : 0;
  const double *tangent = kg_scalar_adjoint(graph, id);
  uint64_t reached = 0;
  for (int s = 0; s < graph->directions; ++s) {
    reached |= (uint64_t)(tangent[s] != 0) << (s & 63);
  }
  return reached;
}

static const char *tangent_of(const kg_graph *graph, uint32_t id, int direction)
{
  const char *tangent = id & KG_TENSOR ? block_adjoint(graph, graph->node[kg_index(id)].is.block)
                                       : (const void *)kg_scalar_adjoint(graph, id);
  return tangent + (size_t)direction * stride_of(graph, id);
}

/* Tangents that are zero, of an input or of what was taken out of one, are left alone from here
 * on. */
static void find_reached(const kg_graph *graph, kg_block *block)
{
  const size_t bytes = block->size * graph->lanes * graph->number;
  const char *tangent = block_adjoint(graph, block);
  const uint64_t written = block->reached;
  block->reached = 0;
  for (int s = 0; s < graph->directions; ++s, tangent += bytes) {
    if (!is_reached(written, s)) continue;
    const bool zero = tangent[0] == 0 && memcmp(tangent, tangent + 1, bytes - 1) == 0;
    block->reached |= (uint64_t)!zero << (s & 63);
  }
}

/* An intermediate value was seeded itself: its tangents are put aside, for kernels write. */
static bool put_aside(kg_graph *graph, const kg_block *block)
{
  const size_t bytes = block->size * (size_t)graph->directions * graph->lanes * graph->number;
  const bool fine = kg_buffer_reserve(&graph->given, graph->allocator, bytes);
  if (fine) {
    memcpy(graph->given.memory, block_adjoint(graph, block), bytes);
  } else {
    graph->status = KG_ERR_NO_MEMORY;
  }
  return fine;
}

/* ... and added; complex numbers add like twice as many doubles. */
static void add_given(const kg_graph *graph, size_t start, void *tangent, size_t bytes)
{
  const void *given = (const char *)graph->given.memory + start;
  const size_t number = graph->number == sizeof(float) ? sizeof(float) : sizeof(double);
  for (size_t i = 0; i < bytes / number; ++i) {
    if (graph->number == sizeof(float)) {
      ((float *)tangent)[i] += ((const float *)given)[i];
    } else {
      ((double *)tangent)[i] += ((const double *)given)[i];
    }
  }
}

/* Directions in which no operand moves are left alone: of a chain of joints, for instance, each
 * link is moved by few of all angles. */
static bool forward_block(kg_graph *graph, uint32_t index)
{
  kg_block *block = graph->node[index].is.block;
  const void **in = graph->pointers.memory, **in_tangent = in + graph->widest + 1;
  uint64_t *moved = (uint64_t *)(in_tangent + graph->widest + 1), any = 0;
  for (int i = 0; i < block->count; ++i) {
    moved[i] = directions_of(graph, block->input[i]);
    any |= moved[i];
  }
  if (!any) return true;
  graph->failed = index;
  const bool seeded = block->stamp == graph->stamp;
  if (seeded && !put_aside(graph, block)) return false;
  const kg_call call = kg_block_call(graph, block, in);
  const size_t bytes = block->size * graph->lanes * graph->number;
  block->stamp = graph->stamp;
  block->reached = seeded ? KG_ALL : any;
  for (int s = 0; s < graph->directions; ++s) {
    if (!is_reached(any, s)) continue;
    for (int i = 0; i < block->count; ++i) {
      in_tangent[i] = is_reached(moved[i], s) ? tangent_of(graph, block->input[i], s) : NULL;
    }
    char *tangent = (char *)block_adjoint(graph, block) + (size_t)s * bytes;
    block->kernel->jvp(&call, in_tangent, tangent);
    if (seeded) add_given(graph, (size_t)s * bytes, tangent, bytes);
  }
  if (block->size <= FEW) find_reached(graph, block);
  return graph->status == KG_OK;
}

static void forward_element(const kg_graph *graph, const kg_node *node, double *tangent)
{
  const uint64_t moved = directions_of(graph, node->input[0]);
  for (int s = 0; moved && s < graph->directions; ++s) {
    if (!is_reached(moved, s)) continue;
    tangent[s] +=
      ((const double *)(const void *)tangent_of(graph, node->input[0], s))[node->input[1]];
  }
}

static void forward_scalar(kg_graph *graph, const kg_node *node)
{
  const size_t directions = (size_t)graph->directions;
  double *scalar = graph->scalar.memory;
  double *tangent = scalar + (size_t)(node - graph->node) * directions;
  if (node->input[0] & KG_TENSOR) {
    forward_element(graph, node, tangent);
    return;
  }
  const double *first = scalar + node->input[0] * directions;
  const double *second = scalar + node->input[1] * directions;
  for (size_t s = 0; s < directions; ++s) {
    const double a = first[s] != 0 ? node->partial[0] * first[s] : 0;
    const double b = second[s] != 0 ? node->partial[1] * second[s] : 0;
    tangent[s] += a + b; /* to what it was seeded with */
  }
}

void kg_sweep_forward(kg_graph *graph, uint32_t first)
{
  graph->complete = KG_NO_ADJOINTS;
  for (uint32_t i = first ? first : 1; i < graph->swept; ++i) {
    const kg_node *node = &graph->node[i];
    if (!node->active || (node->op == kg_op_input && !node->is_block)) continue;
    if (node->op == kg_op_input) {
      if (node->is.block->stamp == graph->stamp) find_reached(graph, node->is.block);
    } else if (node->is_block) {
      if (!forward_block(graph, i)) return;
    } else {
      forward_scalar(graph, node);
    }
  }
}
