/* Matrix operators: shapes checked, kernels told the sizes. The rules are in kernels/matrix.inc. */
#include "autodiff/attributes.h"
#include "autodiff/tape.h"

/* rows and columns of the last two axes, as used */
static void last_two(kg_shape shape, bool transposed, int32_t *rows, int32_t *columns)
{
  *rows = shape.dim[shape.rank - (transposed ? 1 : 2)];
  *columns = shape.dim[shape.rank - (transposed ? 2 : 1)];
}

/* the shape before the last two axes equals the other's */
static bool leading_equal(kg_shape a, kg_shape b)
{
  a.rank -= 2;
  b.rank -= 2;
  return kg_same_shape(a, b);
}

static size_t leading_size(kg_shape shape)
{
  shape.rank -= 2;
  return kg_shape_size(&shape);
}

/* two shapes, and what would fit */
static kg_value refuse_shapes(kg_tape *tape, kg_op op, kg_shape a, kg_shape b, const char *fits)
{
  return kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(op), "shapes %s and %s: %s",
                   kg_shape_print(a).text, kg_shape_print(b).text, fits);
}

static kg_value refuse_inner(kg_tape *tape, kg_shape a, kg_shape b, int flags)
{
  const bool ta = flags & KG_TRANSPOSE_A, tb = flags & KG_TRANSPOSE_B;
  int32_t m, k, other, n;
  last_two(a, ta, &m, &k);
  last_two(b, tb, &other, &n);
  return kg_refuse(tape, KG_ERR_SHAPE, kg_op_name(kg_op_matmul),
                   "shapes %s%s and %s%s: rows of the second must be %d, not %d",
                   kg_shape_print(a).text, ta ? " transposed" : "", kg_shape_print(b).text,
                   tb ? " transposed" : "", (int)k, (int)other);
}

/* -- products ---------------------------------------------------------------------------------- */

/* Many rows times one small matrix: in blocks of rows that stay in the nearest cache while bias,
 * product and its adjoints pass over them. Where the number of rows allows no such block, in
 * one. */
static void divide_rows(kg_product *p)
{
  enum { SMALL = 8192, FEWEST = 32, MOST = 96 };
  if (p->k * p->n > SMALL || p->m <= MOST) return;
  for (size_t rows = MOST; rows >= FEWEST; --rows) {
    if (p->m % rows) continue;
    p->batch = p->m / rows;
    p->m = rows;
    p->step_a = rows * p->k;
    p->step_b = 0;
    p->saved = p->transposed_b ? 0 : p->k * p->n;
    return;
  }
}

static kg_value record_product(kg_tape *tape, kg_op op, int count, const kg_value *operands,
                               kg_shape shape, kg_product *product)
{
  if (product->batch == 1 && !product->transposed_a) divide_rows(product);
  if (product->m > INT32_MAX) { /* what BLAS can count */
    return kg_refuse(tape, KG_ERR_UNSUPPORTED, kg_op_name(op), "more than 2^31 rows");
  }
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = count,
                                      .operands = operands,
                                      .shape = shape,
                                      .attributes = product,
                                      .attribute_bytes = sizeof *product,
                                      .saved = product->saved});
}

kg_value kg_matmul(kg_tape *tape, kg_value a, kg_value b, int flags)
{
  const kg_value operands[2] = {a, b};
  if (!kg_operands_given(tape, 2, operands)) return (kg_value){0};
  const kg_shape sa = kg_shape_of(tape, a), sb = kg_shape_of(tape, b);
  const bool ta = flags & KG_TRANSPOSE_A, tb = flags & KG_TRANSPOSE_B;
  if (sa.rank < 2 || sb.rank < 2) {
    return refuse_shapes(tape, kg_op_matmul, sa, sb, "each needs two axes at least");
  }
  int32_t m, k, other, n;
  last_two(sa, ta, &m, &k);
  last_two(sb, tb, &other, &n);
  if (k != other) return refuse_inner(tape, sa, sb, flags);
  if (sa.rank > 2 && sb.rank > 2 && !leading_equal(sa, sb)) {
    return refuse_shapes(tape, kg_op_matmul, sa, sb,
                         "axes before the last two must be equal, or one be a single matrix");
  }
  kg_shape shape = sa.rank > 2 ? sa : sb;
  shape.dim[shape.rank - 2] = m;
  shape.dim[shape.rank - 1] = n;
  if (!kg_check_shape(tape, kg_op_matmul, shape)) return (kg_value){0};
  kg_product p = {.batch = leading_size(shape), .m = (size_t)m, .n = (size_t)n, .k = (size_t)k};
  p.transposed_a = ta;
  p.transposed_b = tb;
  p.step_a = sa.rank > 2 ? p.m * p.k : 0;
  p.step_b = sb.rank > 2 ? p.k * p.n : 0;
  if (!p.step_b && !ta) { /* the rows of all batches are those of one matrix */
    p.m *= p.batch;
    p.batch = 1;
  }
  return record_product(tape, kg_op_matmul, 2, operands, shape, &p);
}

kg_value kg_affine(kg_tape *tape, kg_value x, kg_value weight, kg_value bias)
{
  const kg_value operands[3] = {x, weight, bias};
  const int count = bias.id ? 3 : 2;
  if (!kg_operands_given(tape, count, operands)) return (kg_value){0};
  kg_shape shape = kg_shape_of(tape, x);
  const kg_shape sw = kg_shape_of(tape, weight), sb = kg_shape_of(tape, bias);
  const int last = shape.rank - 1;
  if (last < 0 || sw.rank != 2 || shape.dim[last] != sw.dim[0] ||
      (bias.id && (sb.rank != 1 || sb.dim[0] != sw.dim[1]))) {
    return kg_refuse(tape, KG_ERR_SHAPE, "affine",
                     "x %s, weight %s, bias %s: (..., k), (k, n) and (n) fit",
                     kg_shape_print(shape).text, kg_shape_print(sw).text,
                     bias.id ? kg_shape_print(sb).text : "none");
  }
  kg_product p = {.batch = 1,
                  .m = kg_shape_size(&shape) / (size_t)sw.dim[0],
                  .n = (size_t)sw.dim[1],
                  .k = (size_t)sw.dim[0]};
  shape.dim[last] = sw.dim[1];
  if (!kg_check_shape(tape, kg_op_affine, shape)) return (kg_value){0};
  return record_product(tape, kg_op_affine, count, operands, shape, &p);
}

/* -- solves ------------------------------------------------------------------------------------ */

static kg_value record_solve(kg_tape *tape, kg_op op, kg_value a, kg_value b, kg_system system)
{
  const kg_value operands[2] = {a, b};
  if (!kg_operands_given(tape, 2, operands)) return (kg_value){0};
  const kg_shape sa = kg_shape_of(tape, a), sb = kg_shape_of(tape, b);
  if (sa.rank < 2 || sb.rank < 2 || sa.dim[sa.rank - 2] != sa.dim[sa.rank - 1] ||
      sa.dim[sa.rank - 1] != sb.dim[sb.rank - 2] || !leading_equal(sa, sb)) {
    return refuse_shapes(tape, op, sa, sb, "(..., n, n) and (..., n, m) fit, equal before that");
  }
  system.batch = leading_size(sa);
  system.n = (size_t)sa.dim[sa.rank - 1];
  system.m = (size_t)sb.dim[sb.rank - 1];
  return kg_record(tape, &(kg_recipe){.op = op,
                                      .count = 2,
                                      .operands = operands,
                                      .shape = sb,
                                      .attributes = &system,
                                      .attribute_bytes = sizeof system,
                                      .saved = system.batch * system.n * (system.n + 1) +
                                               2 * system.n * system.m});
}

kg_value kg_solve(kg_tape *tape, kg_value a, kg_value b, int flags)
{
  const kg_system system = {.transposed = (flags & KG_TRANSPOSE_A) != 0};
  return record_solve(tape, kg_op_solve, a, b, system);
}

kg_value kg_solve_triangular(kg_tape *tape, kg_value a, kg_value b, int flags)
{
  const kg_system system = {.transposed = (flags & KG_TRANSPOSE_A) != 0,
                            .triangular = true,
                            .upper = (flags & KG_UPPER) != 0,
                            .unit = (flags & KG_UNIT) != 0};
  return record_solve(tape, kg_op_solve_triangular, a, b, system);
}
