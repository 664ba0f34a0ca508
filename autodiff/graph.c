/* Growing arrays of a graph, and the choice of kernels for the processor. */
#include "autodiff/graph.h"

#include "base/processor.h"

#include <stdlib.h>
#include <string.h>

static void *take(const kg_allocator *allocator, size_t bytes)
{
  return allocator ? allocator->alloc(bytes, allocator->user) : malloc(bytes);
}

static void give_back(const kg_allocator *allocator, void *memory, size_t bytes)
{
  if (!memory) return;
  if (allocator) {
    allocator->free(memory, bytes, allocator->user);
  } else {
    free(memory);
  }
}

bool kg_buffer_reserve(kg_buffer *buffer, const kg_allocator *allocator, size_t bytes)
{
  if (bytes <= buffer->bytes) return true;
  kg_buffer_release(buffer, allocator);
  buffer->memory = take(allocator, bytes);
  buffer->bytes = buffer->memory ? bytes : 0;
  return buffer->memory != NULL;
}

void kg_buffer_release(kg_buffer *buffer, const kg_allocator *allocator)
{
  give_back(allocator, buffer->memory, buffer->bytes);
  *buffer = (kg_buffer){0};
}

bool kg_graph_reserve(kg_graph *graph)
{
  if (graph->count < graph->capacity) return true;
  if (graph->capacity > KG_TENSOR / 2) return false; /* ids have 31 bits */
  const uint32_t capacity = graph->capacity ? 2 * graph->capacity : 256;
  kg_node *node = take(graph->allocator, capacity * sizeof *node);
  if (!node) return false;
  if (graph->count) memcpy(node, graph->node, graph->count * sizeof *node);
  give_back(graph->allocator, graph->node, graph->capacity * sizeof *node);
  graph->node = node;
  graph->capacity = capacity;
  return true;
}

kg_status kg_graph_init(kg_graph *graph, const kg_allocator *allocator)
{
  *graph = (kg_graph){.allocator = allocator, .lanes = 1};
  if (!kg_graph_reserve(graph)) return KG_ERR_NO_MEMORY;
  graph->node[0] = (kg_node){.op = kg_op_constant};
  graph->count = 1;
  return KG_OK;
}

void kg_graph_release(kg_graph *graph)
{
  give_back(graph->allocator, graph->node, graph->capacity * sizeof *graph->node);
  kg_buffer_release(&graph->scalar, graph->allocator);
  kg_buffer_release(&graph->tensor, graph->allocator);
  kg_buffer_release(&graph->pointers, graph->allocator);
  kg_buffer_release(&graph->given, graph->allocator);
  kg_buffer_release(&graph->scratch, graph->allocator);
  kg_tape_destroy(graph->child);
}

size_t kg_shape_size(const kg_shape *shape)
{
  size_t size = 1;
  for (int i = 0; i < shape->rank; ++i) {
    size *= (size_t)shape->dim[i];
  }
  return size;
}

const char *kg_op_name(kg_op op)
{
#define KG_NAME(name, ...) #name,
#define KG_NAME_TENSOR(name) #name,
  static const char *const names[KG_OP_COUNT] = {"input", "constant", "primitive",
                                                 KG_UNARY_LIST(KG_NAME) KG_TRIG_LIST(KG_NAME)
                                                   KG_CLAMP_LIST(KG_NAME) KG_BINARY_LIST(KG_NAME)
                                                     KG_TENSOR_LIST(KG_NAME_TENSOR)};
#undef KG_NAME
#undef KG_NAME_TENSOR
  return names[op];
}

const kg_kernel *kg_kernels_for(kg_arithmetic arithmetic, int simd)
{
  if (arithmetic == KG_C64) return kg_kernels_c64_base;
  const bool f64 = arithmetic == KG_F64;
#ifdef KG_DISPATCH
  const int level = simd < kg_processor_level() ? simd : kg_processor_level();
  if (level >= 3) return f64 ? kg_kernels_f64_v4 : kg_kernels_f32_v4;
  if (level == 2) return f64 ? kg_kernels_f64_v3 : kg_kernels_f32_v3;
#endif
  (void)simd;
  return f64 ? kg_kernels_f64_base : kg_kernels_f32_base;
}
