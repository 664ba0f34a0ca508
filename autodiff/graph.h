/* graph.h - the record itself: nodes, the kernels that evaluate them, and the sweeps over them.
 *
 * Tape and program are both a kg_graph. A node is of one of two kinds:
 *
 *   scalar   one double with its partial derivatives by at most two scalar operands, in 40 bytes;
 *            swept without looking at the operator. Double tapes only.
 *   block    any operator on tensors: a kg_block with operands, attributes, data and kernels
 *
 * An id is the node's index, with KG_TENSOR set when the node is a block. Node 0 is the sink: the
 * null value, and the second operand of scalar operators that have one.
 *
 * Lanes: entry e of lane l lies at e * lanes + l, in values, saved numbers and adjoints alike. */
#ifndef AUTODIFF_GRAPH_H
#define AUTODIFF_GRAPH_H

#include "autodiff/oplist.h"
#include "kinegrad/arena.h"
#include "kinegrad/tape.h"

#include <string.h>

#define KG_TENSOR 0x80000000u
#define KG_NO_ADJOINTS UINT32_MAX
#define KG_NO_LANE SIZE_MAX
#define KG_ALL UINT64_MAX /* directions */

static inline uint32_t kg_index(uint32_t id)
{
  return id & ~KG_TENSOR;
}

typedef struct kg_graph kg_graph;

/* What a kernel is given. Sizes and strides it needs are in the attributes. */
typedef struct kg_call {
  const void *attributes; /* of the operator */
  size_t size;            /* entries of the result, without lanes */
  size_t lanes;
  int count;             /* operands */
  const void *const *in; /* (count) */
  void *out;
  void *saved;     /* numbers kept from forward for the other two, and their scratch */
  kg_graph *graph; /* for primitives, which need more: its arithmetic, scratch, child */
  unsigned fresh;  /* vjp: bit i: in_adjoint[i] is to be written, not added to */
} kg_call;

typedef struct kg_kernel {
  /* writes out; KG_ERR_UNDEFINED: no value there, KG_ERR_STALE: a comparison turned around */
  kg_status (*forward)(const kg_call *call);
  /* adds (d out / d in[i])' adjoint to in_adjoint[i] where that is not NULL */
  void (*vjp)(const kg_call *call, const void *adjoint, void *const *in_adjoint);
  /* writes sum_i (d out / d in[i]) in_tangent[i] to tangent; NULL tangents are zero */
  void (*jvp)(const kg_call *call, const void *const *in_tangent, void *tangent);
} kg_kernel;

typedef struct kg_block {
  const kg_kernel *kernel;
  kg_shape shape;
  int32_t count;          /* operands */
  const uint32_t *input;  /* their ids */
  const void *attributes; /* plain bytes, padding zeroed: equal bytes, equal operator */
  size_t attribute_bytes;
  size_t size;       /* entries */
  size_t saved_size; /* entries */
  void *data;
  void *saved;
  size_t adjoint;   /* first entry in the sweep's memory, per direction and lane */
  uint32_t stamp;   /* of the last sweep that reached it */
  uint64_t reached; /* directions of it, modulo 64, in which the adjoint or tangent was written */
} kg_block;

typedef struct kg_node {
  union {
    double value;
    kg_block *block;
  } is;
  double partial[2];
  uint32_t input[2];
  uint16_t op;
  bool is_block;
  bool active; /* depends on a differentiable input */
} kg_node;

/* Memory that only grows, kept between sweeps. */
typedef struct kg_buffer {
  void *memory;
  size_t bytes;
} kg_buffer;

struct kg_graph {
  const kg_allocator *allocator;
  const kg_kernel *kernels; /* by operator, of the graph's arithmetic */
  size_t number;            /* bytes of one number: 4 float, 8 double, 16 complex */
  size_t lanes;
  kg_node *node;
  uint32_t count, capacity;
  size_t adjoint_size; /* entries of all active blocks */
  int widest;          /* most operands of a block */
  /* sweeps */
  uint32_t stamp;
  int directions;     /* of the last sweep; 0: none */
  uint32_t swept;     /* nodes there were */
  uint32_t complete;  /* from this node on the adjoints are; KG_NO_ADJOINTS: tangents */
  kg_buffer scalar;   /* (count, directions) doubles */
  kg_buffer tensor;   /* (adjoint_size, directions, lanes) numbers, a block's directions slowest */
  kg_buffer pointers; /* (3, widest) */
  kg_buffer given;    /* the tangent an intermediate block was seeded with */
  /* primitives (primitive.h) */
  kg_tape *child;     /* where they record; NULL until one does */
  kg_buffer scratch;  /* of the one at work */
  const char *detail; /* text of the last failure, NULL: that of its status */
  kg_status status;   /* first failure within the last sweep */
  uint32_t failed;    /* its node */
  size_t failed_lane; /* and lane; KG_NO_LANE where it is not of one */
};

kg_status kg_graph_init(kg_graph *graph, const kg_allocator *allocator);
void kg_graph_release(kg_graph *graph);

/* Room for one more node; false when memory is refused. */
bool kg_graph_reserve(kg_graph *graph);

/* memory of at least bytes, old content lost; false when refused */
bool kg_buffer_reserve(kg_buffer *buffer, const kg_allocator *allocator, size_t bytes);
void kg_buffer_release(kg_buffer *buffer, const kg_allocator *allocator);

static inline const void *kg_node_data(const kg_graph *graph, uint32_t id)
{
  const kg_node *node = &graph->node[kg_index(id)];
  return id & KG_TENSOR ? node->is.block->data : (const void *)&node->is.value;
}

/* "matmul"; of a primitive its own name. attributes: of a block. */
const char *kg_operator_name(kg_op op, const void *attributes);
const char *kg_node_name(const kg_node *node);

/* Primitives of any arithmetic (primitive.c). */
kg_status kg_primitive_forward(const kg_call *call);
void kg_primitive_vjp(const kg_call *call, const void *adjoint, void *const *in_adjoint);
void kg_primitive_jvp(const kg_call *call, const void *const *in_tangent, void *tangent);

/* -- sweeps (sweep.c) -------------------------------------------------------------------------- */

/* Room for the operands of the widest block; false when memory is refused. */
bool kg_graph_reserve_pointers(kg_graph *graph);
/* Evaluates block `node` again; its operands' data are current. */
kg_status kg_graph_evaluate(kg_graph *graph, kg_node *node);

/* Starts a backward or forward sweep of so many directions: all adjoints (tangents) are zero. */
kg_status kg_sweep_begin(kg_graph *graph, int directions);
/* The adjoint of an active block; entry: bytes of one entry, of all directions and lanes. One that
 * was untouched is made zero, or left as it is, *fresh saying so, when fresh is given. */
static inline void *kg_sweep_touch(const kg_graph *graph, kg_block *block, size_t entry,
                                   bool *fresh)
{
  void *adjoint = (char *)graph->tensor.memory + block->adjoint * entry;
  if (block->stamp == graph->stamp) return adjoint;
  block->stamp = graph->stamp;
  block->reached = KG_ALL;
  if (fresh) {
    *fresh = true;
  } else {
    memset(adjoint, 0, block->size * entry);
  }
  return adjoint;
}
/* True when the node's vjp heeds kg_call's fresh: element-wise operators, operands of one shape. */
bool kg_writes_adjoints(const kg_node *node);
/* The adjoint or tangent of a value, (directions, size, lanes), made zero when it was untouched;
 * NULL for a constant. */
void *kg_sweep_seed(kg_graph *graph, uint32_t id);
/* The same, NULL when untouched; directions that were not reached become zero. */
void *kg_sweep_result(const kg_graph *graph, uint32_t id);
/* Of an active scalar: (directions). */
static inline double *kg_scalar_adjoint(const kg_graph *graph, uint32_t id)
{
  return (double *)graph->scalar.memory + (size_t)id * (size_t)graph->directions;
}
/* From the newest node down to node `last`; or from node `first` up to the newest. A primitive that
 * fails ends the sweep: graph->status, failed and detail say so. */
void kg_sweep_backward(kg_graph *graph, uint32_t last);
void kg_sweep_forward(kg_graph *graph, uint32_t first);
/* What the kernels of one block are called with; in has room for its operands. */
kg_call kg_block_call(kg_graph *graph, const kg_block *block, const void **in);

/* -- kernels (kernels/) ------------------------------------------------------------------------ */

extern const kg_kernel kg_kernels_f64_base[KG_OP_COUNT], kg_kernels_f32_base[KG_OP_COUNT];
extern const kg_kernel kg_kernels_c64_base[KG_OP_COUNT];
#ifdef KG_DISPATCH
extern const kg_kernel kg_kernels_f64_v3[KG_OP_COUNT], kg_kernels_f64_v4[KG_OP_COUNT];
extern const kg_kernel kg_kernels_f32_v3[KG_OP_COUNT], kg_kernels_f32_v4[KG_OP_COUNT];
#endif

typedef enum kg_arithmetic { KG_F64, KG_F32, KG_C64 } kg_arithmetic;

/* The table for this processor, no wider than simd (kg_tape_def). */
const kg_kernel *kg_kernels_for(kg_arithmetic arithmetic, int simd);

#endif
