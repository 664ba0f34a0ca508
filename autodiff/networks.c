/* Operators of networks: graph aggregation by a fixed sparse matrix, and convolution in time. */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

#include <string.h>

/* -- aggregation ------------------------------------------------------------------------------- */

/* NULL when the matrix is sound, else what is wrong with it */
static const char *fault_of(const kg_sparse *matrix)
{
  if (matrix->rows < 1 || matrix->columns < 1) return "no rows or no columns";
  if (matrix->start[0] != 0) return "rows do not start from 0";
  for (int32_t r = 0; r < matrix->rows; ++r) {
    if (matrix->start[r + 1] < matrix->start[r]) return "starts of rows decrease";
  }
  for (int32_t k = 0; k < matrix->start[matrix->rows]; ++k) {
    if (matrix->column[k] < 0 || matrix->column[k] >= matrix->columns) return "column out of range";
  }
  return NULL;
}

/* the matrix behind its sizes, in memory that lasts until the tape is rewound */
static kg_aggregation *copy_matrix(kg_tape *tape, const kg_sparse *matrix, size_t *bytes)
{
  const size_t entries = (size_t)matrix->start[matrix->rows], rows = (size_t)matrix->rows;
  *bytes =
    sizeof(kg_aggregation) + entries * sizeof(double) + (rows + 1 + entries) * sizeof(int32_t);
  kg_aggregation *copy = kg_arena_take(&tape->arena, *bytes, 16);
  if (!copy) return NULL;
  *copy = (kg_aggregation){.rows = rows, .entries = entries};
  if (entries) memcpy(copy->weight, matrix->weight, entries * sizeof(double));
  int32_t *start = (int32_t *)kg_aggregation_start(copy);
  memcpy(start, matrix->start, (rows + 1) * sizeof(int32_t));
  if (entries) memcpy(start + rows + 1, matrix->column, entries * sizeof(int32_t));
  return copy;
}

kg_value kg_aggregate(kg_tape *tape, const kg_sparse *matrix, kg_value x)
{
  if (!kg_operands_given(tape, 1, &x)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, x);
  const char *fault = fault_of(matrix);
  if (fault) return kg_refuse(tape, KG_ERR_SHAPE, "aggregate", "matrix: %s", fault);
  const int nodes = shape.rank - 2;
  if (nodes < 0 || shape.dim[nodes] != matrix->columns) {
    return kg_refuse(tape, KG_ERR_SHAPE, "aggregate", "a matrix of shape (%d, %d) and x %s",
                     (int)matrix->rows, (int)matrix->columns, kg_shape_print(shape).text);
  }
  size_t bytes;
  kg_aggregation *attributes = copy_matrix(tape, matrix, &bytes);
  if (!attributes)
    return kg_refuse(tape, KG_ERR_NO_MEMORY, "aggregate", "no memory for the matrix");
  const kg_axis_split split = kg_split(shape, nodes);
  attributes->outer = split.outer;
  attributes->columns = split.length;
  attributes->features = split.inner;
  shape.dim[nodes] = matrix->rows;
  if (!kg_check_shape(tape, kg_op_aggregate, shape)) return (kg_value){0};
  return kg_record(tape, &(kg_recipe){.op = kg_op_aggregate,
                                      .count = 1,
                                      .operands = &x,
                                      .shape = shape,
                                      .attributes = attributes,
                                      .attribute_bytes = bytes});
}

/* -- convolution ------------------------------------------------------------------------------- */

kg_value kg_convolve(kg_tape *tape, kg_value x, kg_value weight, kg_value bias, kg_padding padding,
                     int dilation)
{
  const kg_value operands[3] = {x, weight, bias};
  const int count = bias.id ? 3 : 2;
  if (!kg_operands_given(tape, count, operands)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, x);
  const kg_shape sw = kg_shape_of(tape, weight), sb = kg_shape_of(tape, bias);
  if (shape.rank != 3 || sw.rank != 3 || shape.dim[2] != sw.dim[1] || dilation < 1 ||
      (bias.id && (sb.rank != 1 || sb.dim[0] != sw.dim[2]))) {
    return kg_refuse(tape, KG_ERR_SHAPE, "convolve", "x %s, weight %s, bias %s, dilation %d",
                     kg_shape_print(shape).text, kg_shape_print(sw).text,
                     bias.id ? kg_shape_print(sb).text : "none", dilation);
  }
  const int64_t before = padding == KG_PAD_CAUSAL ? sw.dim[0] - 1 : (sw.dim[0] - 1) / 2;
  const kg_convolution attributes = {.batch = (size_t)shape.dim[0],
                                     .time = shape.dim[1],
                                     .in = (size_t)sw.dim[1],
                                     .out = (size_t)sw.dim[2],
                                     .taps = sw.dim[0],
                                     .before = before,
                                     .dilation = dilation};
  shape.dim[2] = sw.dim[2];
  if (!kg_check_shape(tape, kg_op_convolve, shape)) return (kg_value){0};
  return kg_record(tape, &(kg_recipe){.op = kg_op_convolve,
                                      .count = count,
                                      .operands = operands,
                                      .shape = shape,
                                      .attributes = &attributes,
                                      .attribute_bytes = sizeof attributes,
                                      .saved = attributes.in * attributes.out});
}
