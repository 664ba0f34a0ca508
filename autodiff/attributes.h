/* attributes.h - what an operator knows besides its operands: written by the function that
 * records it, read by its kernels. Plain bytes without pointers to outside; padding zero. */
#ifndef AUTODIFF_ATTRIBUTES_H
#define AUTODIFF_ATTRIBUTES_H

#include "autodiff/graph.h"

/* Element-wise operators: the result's axes, merged where all operands run on, and the strides
 * of the operands along them; 0 repeats. Operands of one shape need no axes: rank 0, and only
 * KG_FLAT_BYTES are kept. */
typedef struct kg_elementwise {
  double p, q;             /* constants of the rule */
  int64_t rank;            /* 0 .. KG_MAX_RANK */
  size_t dim[KG_MAX_RANK]; /* the slowest first */
  size_t stride[3][KG_MAX_RANK];
} kg_elementwise;

#define KG_FLAT_BYTES offsetof(kg_elementwise, dim)

/* is_less: what the comparison said when it was recorded. */
typedef struct kg_guard {
  int64_t answer;
} kg_guard;

/* Operators along an axis: sizes of what lies before, along and after it. */
typedef struct kg_axis_split {
  size_t outer, length, inner;
} kg_axis_split;

/* Products of matrices: (m, k) (k, n), batch times. */
typedef struct kg_product {
  size_t batch, m, n, k;
  size_t step_a, step_b; /* entries from one matrix of the batch to the next; 0: one serves all */
  int64_t transposed_a, transposed_b;
  size_t saved; /* room for B', where its adjoint rule meets B again and again */
} kg_product;

/* op(A) X = B: A (batch, n, n), B (batch, n, m). Saved: of every A its factors (n, n) and n row
 * exchanges, a right-hand side of one lane, one of all lanes. */
typedef struct kg_system {
  size_t batch, n, m;
  int32_t transposed, triangular, upper, unit;
} kg_system;

/* Sparse matrix (rows, columns) applied to x (outer, columns, features). Behind the weights lie
 * start (rows + 1) and column (entries), of 32 bits. */
typedef struct kg_aggregation {
  size_t outer, rows, columns, features, entries;
  double weight[];
} kg_aggregation;

static inline const int32_t *kg_aggregation_start(const kg_aggregation *a)
{
  return (const int32_t *)(a->weight + a->entries);
}

/* x (batch, time, in), weight (taps, in, out); tap k sees frame t + (k - before) dilation. */
typedef struct kg_convolution {
  size_t batch, in, out;
  int64_t time, taps, before, dilation;
} kg_convolution;

/* Moves. Sizes count entries; the axis concerned lies between `outer` and `inner`. */

/* slice: of each row of `row` entries, `width` from `start` */
typedef struct kg_window {
  size_t outer, row, start, width;
} kg_window;

/* concat: operand k fills entries start[k] .. start[k + 1] of each row of `row` */
typedef struct kg_join {
  size_t outer, row;
  size_t start[]; /* (operands + 1) */
} kg_join;

/* transpose: (outer, rows, between, columns, inner) -> (outer, columns, between, rows, inner) */
typedef struct kg_exchange {
  size_t outer, rows, between, columns, inner;
} kg_exchange;

/* gather: (outer, extent, inner) -> (outer, count, inner); scatter: the other way */
typedef struct kg_pick {
  size_t outer, extent, count, inner;
  int32_t index[]; /* (count), -1: none */
} kg_pick;

#endif
