/* The registry of checks: every operator and kind of primitive with shapes, domains and kinks, so
 * that none is left unchecked (a test compares with oplist.h).
 *
 * A row records its operator from one packed vector x, which is cut into the operands of a
 * variant's shapes. At a kink the derivative must be the one operators.h states: that of the
 * function on a stated side, taken by a complex step from a point moved there by 1e-13, or zero. */
#include "autodiff/gradcheck.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/primitive.h"

#include <math.h>

enum { OPERANDS = 3, MOST = 256 /* numbers of one packed point */ };

/* Shapes of the operands of one variant; count in each set. NODE: a scalar node. */
typedef struct operand_shapes {
  kg_shape of[OPERANDS];
} operand_shapes;

typedef kg_value recording(kg_tape *tape, const kg_value *operands, int variant);

typedef struct row {
  const char *name;
  kg_op op;
  int operands;
  recording *record;
  const operand_shapes *variants;
  int variant_count;
  double low, high;     /* entries are uniform in between */
  recording *reference; /* the same function by other means; NULL: itself */
  bool dominant;        /* square matrices of operand 0 get a heavy diagonal */
} row;

/* -- shapes ------------------------------------------------------------------------------------ */

/* clang-format off */
#define NODE {-1, {0}}
#define V(a) {1, {a}}
#define M(a, b) {2, {a, b}}
#define T3(a, b, c) {3, {a, b, c}}
#define T4(a, b, c, d) {4, {a, b, c, d}}

static const operand_shapes one[] = {{{NODE}}, {{V(5)}}, {{T3(2, 1, 3)}}};
static const operand_shapes two[] = {
  {{NODE, NODE}}, {{V(5), V(5)}}, {{M(3, 4), V(4)}}, {{NODE, M(2, 3)}}, {{M(3, 1), NODE}},
  {{M(3, 1), M(1, 2)}}, {{T4(2, 1, 2, 1), T3(3, 1, 2)}}};
static const operand_shapes choice[] = {{{V(6), V(6)}}, {{M(3, 2), V(2)}}, {{NODE, M(3, 2)}}};
static const operand_shapes nodes[] = {{{NODE, NODE}}};
static const operand_shapes terms[] = {
  {{NODE, NODE, NODE}}, {{V(4), V(4), V(4)}}, {{M(2, 3), M(2, 3), M(2, 3)}}};
static const operand_shapes along[] = {{{T3(3, 4, 2)}}, {{T3(3, 4, 2)}}, {{V(5)}}, {{M(2, 19)}}};
static const operand_shapes along_both[] = {
  {{T3(3, 4, 2), T3(3, 4, 2)}}, {{T3(3, 4, 2), T3(3, 4, 2)}}, {{V(5), V(5)}},
  {{M(2, 19), M(2, 19)}}};
static const operand_shapes products[] = {
  {{M(3, 4), M(4, 2)}}, {{M(4, 3), M(4, 2)}}, {{M(3, 4), M(2, 4)}}, {{M(4, 3), M(2, 4)}},
  {{T3(2, 3, 4), T3(2, 4, 2)}}, {{T3(2, 3, 4), M(4, 2)}}, {{M(3, 4), T3(2, 4, 2)}},
  {{T3(2, 4, 3), T3(2, 2, 4)}}};
static const int product_flags[] = {
  0, KG_TRANSPOSE_A, KG_TRANSPOSE_B, KG_TRANSPOSE_A | KG_TRANSPOSE_B, 0, 0, 0,
  KG_TRANSPOSE_A | KG_TRANSPOSE_B};
static const operand_shapes affine[] = {
  {{M(3, 4), M(4, 5), V(5)}}, {{T3(2, 3, 4), M(4, 2), V(2)}}, {{V(4), M(4, 2), V(2)}}};
static const operand_shapes systems[] = {
  {{M(3, 3), M(3, 2)}}, {{M(4, 4), M(4, 1)}}, {{T3(2, 3, 3), T3(2, 3, 2)}},
  {{T3(2, 3, 3), T3(2, 3, 2)}}};
static const int triangle_flags[] = {
  0, KG_UPPER | KG_UNIT, KG_TRANSPOSE_A, KG_TRANSPOSE_A | KG_UPPER};
static const operand_shapes matrix[] = {{{M(3, 4)}}};
static const operand_shapes tensor[] = {{{T3(3, 4, 2)}}, {{T3(3, 4, 2)}}, {{T3(3, 4, 2)}}};
static const operand_shapes spread[] = {{{V(4)}}, {{M(3, 1)}}, {{NODE}}};
static const operand_shapes parts[] = {
  {{M(2, 3), M(1, 3), M(4, 3)}}, {{M(3, 2), M(3, 1), M(3, 4)}}, {{V(2), V(3), V(1)}}};
static const operand_shapes vectors[] = {{{V(3)}}, {{M(4, 3)}}, {{T3(2, 2, 3)}}};
static const operand_shapes vector_pairs[] = {{{V(3), V(3)}}, {{M(4, 3), M(4, 3)}}};
static const operand_shapes quaternions[] = {{{V(4)}}, {{M(3, 4)}}};
static const operand_shapes quaternion_pairs[] = {{{V(4), V(4)}}, {{M(3, 4), M(3, 4)}}};
static const operand_shapes rotations[] = {{{V(4), V(3)}}, {{M(3, 4), M(3, 3)}}};
static const operand_shapes graphs[] = {{{M(4, 3)}}, {{T3(2, 4, 2)}}};
static const operand_shapes pair[] = {{{V(5), V(5)}}}, matrix_pair[] = {{{M(3, 3), M(3, 3)}}};
static const operand_shapes signals[] = {
  {{T3(2, 5, 2), T3(3, 2, 3), V(3)}}, {{T3(1, 6, 2), T3(2, 2, 2), V(2)}},
  {{T3(2, 7, 1), T3(3, 1, 2), V(2)}}};
/* clang-format on */

/* -- recording --------------------------------------------------------------------------------- */

#define ONE(name)                                                                                  \
  static kg_value record_##name(kg_tape *t, const kg_value *v, int variant)                        \
  {                                                                                                \
    (void)variant;                                                                                 \
    return kg_##name(t, v[0]);                                                                     \
  }
#define TWO(name)                                                                                  \
  static kg_value record_##name(kg_tape *t, const kg_value *v, int variant)                        \
  {                                                                                                \
    (void)variant;                                                                                 \
    return kg_##name(t, v[0], v[1]);                                                               \
  }
/* name, call of t (tape), v (operands), i (variant) */
#define RECORD(name, call)                                                                         \
  static kg_value record_##name(kg_tape *t, const kg_value *v, int i)                              \
  {                                                                                                \
    (void)i;                                                                                       \
    return call;                                                                                   \
  }

/* clang-format off */
/* name, domain */
#define UNARY(X)                                                                                   \
  X(neg, -3, 3)        X(reciprocal, 0.2, 3) X(square, -3, 3)     X(sqrt, 0.01, 4)                 \
  X(abs, -3, 3)        X(exp, -4, 4)         X(expm1, -4, 4)      X(log, 0.01, 5)                  \
  X(log1p, -0.9, 4)    X(sin, -9, 9)         X(cos, -9, 9)        X(tan, -1.4, 1.4)                \
  X(asin, -0.95, 0.95) X(acos, -0.95, 0.95)  X(atan, -5, 5)       X(sinh, -3, 3)                   \
  X(cosh, -3, 3)       X(tanh, -3, 3)        X(sigmoid, -5, 5)    X(softplus, -5, 5)               \
  X(relu, -3, 3)
#define BINARY(X)                                                                                  \
  X(add, -3, 3) X(sub, -3, 3) X(mul, -3, 3) X(div, 0.3, 3) X(pow, 0.1, 3) X(atan2, -3, 3)          \
  X(hypot, -3, 3) X(min, -3, 3) X(max, -3, 3)
#define UNARY_RECORD(name, low, high) ONE(name)
#define BINARY_RECORD(name, low, high) TWO(name)
UNARY(UNARY_RECORD)
BINARY(BINARY_RECORD)
TWO(cross) TWO(compose) TWO(rotate)
ONE(rotation_exp) ONE(rotation_log) ONE(normalize) ONE(sum_all)

static const int axes[] = {0, 1, -1, -1};
RECORD(scale, kg_scale(t, v[0], -1.7))
RECORD(shift, kg_shift(t, v[0], 0.3))
RECORD(cube, kg_power(t, v[0], 3))
RECORD(root, kg_power(t, v[0], 0.7))
RECORD(inverse_square, kg_power(t, v[0], -2))
RECORD(clamp, kg_clamp(t, v[0], -0.5, 0.5))
RECORD(less, kg_mul(t, kg_less(t, v[0], v[1]), v[0]))
RECORD(less_equal, kg_mul(t, kg_less_equal(t, v[0], v[1]), v[1]))
RECORD(where, kg_where(t, kg_less(t, v[0], v[1]), kg_square(t, v[0]), v[1]))
RECORD(is_less, kg_is_less(t, v[0], v[1]) ? kg_mul(t, v[0], v[1]) : kg_square(t, v[0]))
RECORD(combine, kg_combine(t, 3, (const double[]){2, -0.5, 1}, v))
RECORD(combine_same, kg_combine(t, 2, (const double[]){2, -0.5}, (const kg_value[]){v[0], v[0]}))
RECORD(sum, kg_sum(t, v[0], axes[i]))
RECORD(sum_squares, kg_sum_squares(t, v[0], axes[i]))
RECORD(norm, kg_norm(t, v[0], axes[i]))
RECORD(dot, kg_dot(t, v[0], v[1], axes[i]))
RECORD(max_along, kg_max_along(t, v[0], axes[i]))
RECORD(min_along, kg_min_along(t, v[0], axes[i]))
RECORD(logsumexp, kg_logsumexp(t, v[0], axes[i]))
RECORD(softmax, kg_softmax(t, v[0], axes[i]))
RECORD(matmul, kg_matmul(t, v[0], v[1], product_flags[i]))
RECORD(gram, kg_matmul(t, v[0], v[0], KG_TRANSPOSE_B))
RECORD(affine, kg_affine(t, v[0], v[1], v[2]))
RECORD(affine_bare, kg_affine(t, v[0], v[1], (kg_value){0}))
RECORD(solve, kg_solve(t, v[0], v[1], i % 2 ? KG_TRANSPOSE_A : 0))
RECORD(solve_triangular, kg_solve_triangular(t, v[0], v[1], triangle_flags[i]))
RECORD(reshape, kg_reshape(t, v[0], KG_SHAPE(2, 6)))
RECORD(broadcast, kg_broadcast(t, v[0], KG_SHAPE(2, 3, 4)))
RECORD(transpose, kg_transpose(t, v[0], i == 2 ? 0 : i, i == 2 ? -1 : i + 1))
RECORD(slice, kg_slice(t, v[0], i, 1, i == 1 ? 2 : 1))
RECORD(concat, kg_concat(t, i == 1 ? -1 : 0, 3, v))
RECORD(stack, kg_stack(t, 2, v))
RECORD(element, kg_element(t, v[0], 7))
RECORD(gather, kg_gather(t, v[0], i, 5, (const int32_t[]){1, -1, 0, 1, 1}))
RECORD(scatter, kg_scatter(t, v[0], 1, 3, (const int32_t[]){2, 0, -1, 2}))
RECORD(aggregate, kg_aggregate(t, &(kg_sparse){3, 4, (const int32_t[]){0, 2, 2, 5},
                                               (const int32_t[]){1, 3, 0, 1, 2},
                                               (const double[]){0.5, -1, 2, 0.3, 1}}, v[0]))
RECORD(convolve, kg_convolve(t, v[0], v[1], v[2], i == 1 ? KG_PAD_CAUSAL : KG_PAD_SAME,
                             i == 2 ? 2 : 1))
RECORD(convolve_bare, kg_convolve(t, v[0], v[1], (kg_value){0}, KG_PAD_CAUSAL, 2))

/* clang-format on */

/* -- primitives: one of each kind, and the same function by operators -------------------------- */

static kg_status like_first(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)user, (void)count;
  *result = shapes[0];
  *saved = 0;
  for (int i = 0; i < shapes[0].rank; ++i) {
    *saved = (*saved ? *saved : 1) * (size_t)shapes[0].dim[i];
  }
  return KG_OK;
}

/* y = a sin b; the cosine is kept */
static kg_status sine_forward(const kg_primitive_call *call)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    call->out[i] = call->in[0][i] * sin(call->in[1][i]);
    call->saved[i] = cos(call->in[1][i]);
  }
  return KG_OK;
}

static kg_status sine_vjp(const kg_primitive_call *call, const double *adjoint,
                          double *const *in_adjoints)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    if (in_adjoints[0]) in_adjoints[0][i] += sin(call->in[1][i]) * adjoint[i];
    if (in_adjoints[1]) in_adjoints[1][i] += call->in[0][i] * call->saved[i] * adjoint[i];
  }
  return KG_OK;
}

static kg_status sine_jvp(const kg_primitive_call *call, const double *const *tangents,
                          double *out_tangent)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    if (tangents[0]) out_tangent[i] += sin(call->in[1][i]) * tangents[0][i];
    if (tangents[1]) out_tangent[i] += call->in[0][i] * call->saved[i] * tangents[1][i];
  }
  return KG_OK;
}

static const kg_primitive sine = {
  .name = "sine", .shape = like_first, .forward = sine_forward, .vjp = sine_vjp, .jvp = sine_jvp};
RECORD(custom, kg_apply(t, &sine, 2, v))
RECORD(custom_by_operators, kg_mul(t, v[0], kg_sin(t, v[1])))

/* x^3 + p x = q for p > 0, entry by entry, by Newton's method */
static kg_status solve_cubic(void *user, int count, const kg_shape *shapes,
                             const double *const *parameters, double *x)
{
  (void)user, (void)count;
  for (int i = 0; i < shapes[0].dim[0]; ++i) {
    const double p = parameters[0][i], q = parameters[1][i];
    x[i] = q;
    for (int k = 0; k < 60; ++k) {
      x[i] -= (x[i] * x[i] * x[i] + p * x[i] - q) / (3 * x[i] * x[i] + p);
    }
  }
  return KG_OK;
}

static kg_status cubic_solve(const kg_primitive_call *call)
{
  const kg_status status = solve_cubic(NULL, 2, call->shapes, call->in, call->out);
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    call->saved[i] = 3 * call->out[i] * call->out[i] + call->in[0][i]; /* dF/dx */
  }
  return status;
}

static kg_status cubic_residual(const kg_primitive_call *call, double *residual)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    const double x = call->out[i];
    residual[i] = x * x * x + call->in[0][i] * x - call->in[1][i];
  }
  return KG_OK;
}

static kg_status cubic_slope_solve(const kg_primitive_call *call, const double *rhs, double *out)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    out[i] = rhs[i] / call->saved[i];
  }
  return KG_OK;
}

static kg_status cubic_vjp(const kg_primitive_call *call, const double *lambda,
                           double *const *in_adjoints)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    if (in_adjoints[0]) in_adjoints[0][i] += call->out[i] * lambda[i];
    if (in_adjoints[1]) in_adjoints[1][i] -= lambda[i];
  }
  return KG_OK;
}

static kg_status cubic_jvp(const kg_primitive_call *call, const double *const *tangents,
                           double *out)
{
  for (int i = 0; i < call->shape.dim[0]; ++i) {
    if (tangents[0]) out[i] += call->out[i] * tangents[0][i];
    if (tangents[1]) out[i] -= tangents[1][i];
  }
  return KG_OK;
}

static const kg_implicit cubic = {.name = "cubic",
                                  .shape = like_first,
                                  .solve = cubic_solve,
                                  .residual = cubic_residual,
                                  .tolerance = 1e-12,
                                  .transposed_solve = cubic_slope_solve,
                                  .residual_vjp = cubic_vjp,
                                  .forward_solve = cubic_slope_solve,
                                  .residual_jvp = cubic_jvp};
RECORD(implicit, kg_solve_implicit(t, &cubic, 2, v))

static kg_value cubic_by_operators(kg_tape *t, kg_value x, int count, const kg_value *v, void *user)
{
  (void)user, (void)count;
  return kg_sub(t, kg_add(t, kg_power(t, x, 3), kg_mul(t, v[0], x)), v[1]);
}

static const kg_root cubic_root = {.name = "cubic root",
                                   .shape = V(5),
                                   .residual = cubic_by_operators,
                                   .solve = solve_cubic,
                                   .tolerance = 1e-12};
RECORD(solved, kg_differentiate_root(t, &cubic_root, 2, v))

/* x = u - p / (3 u) with u^3 = q/2 + sqrt((q/2)^2 + (p/3)^3) [Cardano] */
static kg_value record_cardano(kg_tape *t, const kg_value *v, int variant)
{
  (void)variant;
  const kg_value third = kg_scale(t, v[0], 1.0 / 3), half = kg_scale(t, v[1], 0.5);
  const kg_value root = kg_sqrt(t, kg_add(t, kg_square(t, half), kg_power(t, third, 3)));
  const kg_value u = kg_power(t, kg_add(t, half, root), 1.0 / 3);
  return kg_sub(t, u, kg_div(t, third, u));
}

static kg_status segment(kg_tape *t, void *user, int input_count, const kg_value *inputs,
                         int output_count, kg_value *outputs)
{
  (void)user, (void)input_count, (void)output_count;
  outputs[0] = kg_tanh(t, kg_matmul(t, inputs[0], inputs[1], 0));
  outputs[1] = kg_mul(t, inputs[0], kg_sum_all(t, outputs[0]));
  return kg_tape_status(t);
}

static kg_value both_outputs(kg_tape *t, const kg_value *outputs)
{
  return kg_add(t, kg_sum_all(t, outputs[0]), outputs[1]);
}

static kg_value record_checkpoint(kg_tape *t, const kg_value *v, int variant)
{
  kg_value outputs[2] = {{0}, {0}};
  (void)variant;
  kg_checkpoint(t, segment, NULL, 2, v, 2, outputs);
  return both_outputs(t, outputs);
}

static kg_value record_segment(kg_tape *t, const kg_value *v, int variant)
{
  kg_value outputs[2] = {{0}, {0}};
  (void)variant;
  segment(t, NULL, 2, v, 2, outputs);
  return both_outputs(t, outputs);
}

/* -- the table --------------------------------------------------------------------------------- */

/* clang-format off */
#define SET(set) set, (int)KG_COUNT_OF(set)
#define UNARY_ROW(name, low, high)                                                                 \
  {#name, kg_op_##name, 1, record_##name, SET(one), low, high, NULL, false},
#define BINARY_ROW(name, low, high)                                                                \
  {#name, kg_op_##name, 2, record_##name, SET(two), low, high, NULL, false},
#define ROW(name, operands, set)                                                                   \
  {#name, kg_op_##name, operands, record_##name, SET(set), -2, 2, NULL, false},
#define PRIMITIVE(text, name, set, reference)                                                      \
  {text, kg_op_primitive, 2, record_##name, SET(set), 0.3, 2, reference, false},
#define ROW_OF(text, op, name, operands, set, low, high)                                           \
  {text, kg_op_##op, operands, record_##name, SET(set), low, high, NULL, false},

static const row rows[] = {
  UNARY(UNARY_ROW) BINARY(BINARY_ROW)
  ROW(scale, 1, one) ROW(shift, 1, one) ROW(clamp, 1, one)
  ROW_OF("power a^3", power, cube, 1, one, -2, 2)
  ROW_OF("power a^0.7", power, root, 1, one, 0.1, 3)
  ROW_OF("power a^-2", power, inverse_square, 1, one, -3, -0.3)
  ROW(less, 2, choice) ROW(less_equal, 2, choice) ROW(where, 2, choice) ROW(is_less, 2, nodes)
  ROW(combine, 3, terms) ROW_OF("combine, one term twice", combine, combine_same, 1, one, -2, 2)
  ROW(sum, 1, along) ROW_OF("sum_all", sum, sum_all, 1, along, -2, 2) ROW(sum_squares, 1, along)
  ROW(norm, 1, along) ROW(dot, 2, along_both) ROW(max_along, 1, along) ROW(min_along, 1, along)
  ROW(logsumexp, 1, along) ROW(softmax, 1, along)
  ROW(matmul, 2, products) ROW_OF("matmul A A'", matmul, gram, 1, matrix, -2, 2)
  ROW(affine, 3, affine) ROW_OF("affine without bias", affine, affine_bare, 2, affine, -2, 2)
  {"solve", kg_op_solve, 2, record_solve, SET(systems), -1, 1, NULL, true},
  {"solve_triangular", kg_op_solve_triangular, 2, record_solve_triangular, SET(systems), -1, 1,
   NULL, true},
  ROW(reshape, 1, matrix) ROW(broadcast, 1, spread) ROW(transpose, 1, tensor) ROW(slice, 1, tensor)
  ROW(concat, 3, parts) ROW_OF("stack", concat, stack, 2, nodes, -2, 2)
  ROW(element, 1, matrix) ROW(gather, 1, tensor) ROW(scatter, 1, matrix)
  ROW(cross, 2, vector_pairs) ROW(compose, 2, quaternion_pairs) ROW(rotate, 2, rotations)
  ROW(rotation_exp, 1, vectors) ROW(rotation_log, 1, quaternions) ROW(normalize, 1, vectors)
  ROW(aggregate, 1, graphs)
  ROW(convolve, 3, signals)
  ROW_OF("convolve without bias", convolve, convolve_bare, 2, signals, -2, 2)
  PRIMITIVE("custom primitive", custom, pair, record_custom_by_operators)
  PRIMITIVE("implicit primitive", implicit, pair, record_cardano)
  PRIMITIVE("differentiated root", solved, pair, record_cardano)
  PRIMITIVE("checkpoint", checkpoint, matrix_pair, record_segment)
};
/* clang-format on */

/* -- kinks ------------------------------------------------------------------------------------- */

enum { BOTH, ABOVE };
enum { SIDE, ZERO };

/* Operand 0 is filled with a[0 .. period), over and over, operand 1 with b. The derivative there is
 * that of the point moved by 1e-13 of the side: side_a[], plus by_index times the number of the
 * entry; side_b. */
typedef struct kink {
  recording *record;
  int period;
  double a[4], b;
  int expected; /* SIDE, or ZERO */
  double side_a[4], by_index, side_b;
  int neighbours; /* BOTH sides are in the domain, or only those ABOVE */
} kink;

static const kink kinks[] = {
  {.record = record_abs, .period = 1, .expected = ZERO},
  {.record = record_relu, .period = 1, .side_a = {-1}},
  {.record = record_sqrt, .period = 1, .a = {1e-9}, .neighbours = ABOVE},
  {.record = record_log, .period = 1, .a = {1e-9}, .neighbours = ABOVE},
  {.record = record_clamp, .period = 1, .a = {-0.5}, .side_a = {1}},
  {.record = record_clamp, .period = 1, .a = {0.5}, .side_a = {-1}},
  {.record = record_pow, .period = 1, .b = 2, .neighbours = ABOVE},
  {.record = record_pow, .period = 1, .b = 1, .neighbours = ABOVE},
  {.record = record_cube, .period = 1},
  {.record = record_atan2, .period = 1, .expected = ZERO},
  {.record = record_atan2, .period = 1, .b = -1},
  {.record = record_atan2, .period = 1, .a = {1}},
  {.record = record_atan2, .period = 1, .a = {1}, .b = 1},
  {.record = record_hypot, .period = 1, .expected = ZERO},
  {.record = record_min, .period = 1, .a = {1}, .b = 1, .side_a = {-1}},
  {.record = record_max, .period = 1, .a = {1}, .b = 1, .side_a = {1}},
  {.record = record_less, .period = 1, .a = {1}, .b = 1},
  {.record = record_less_equal, .period = 1, .a = {1}, .b = 1},
  {.record = record_where, .period = 1, .a = {1}, .b = 1, .side_b = -1},
  {.record = record_is_less, .period = 1, .a = {1}, .b = 1, .side_b = -1},
  {.record = record_norm, .period = 1, .expected = ZERO},
  {.record = record_max_along, .period = 1, .a = {1}, .by_index = -1},
  {.record = record_min_along, .period = 1, .a = {1}, .by_index = 1},
  {.record = record_logsumexp, .period = 1, .a = {1}},
  {.record = record_rotation_exp, .period = 1},
  {.record = record_rotation_log, .period = 4, .a = {0, 0.6, 0.8, 0}, .side_a = {1}},
  {.record = record_rotation_log, .period = 4, .a = {1}},
  {.record = record_rotation_log, .period = 4, .a = {-1}},
  {.record = record_normalize, .period = 1, .expected = ZERO},
};

/* -- points ------------------------------------------------------------------------------------ */

/* One packed point; the user of kg_recorded. */
typedef struct point {
  const row *row;
  int variant;
  int active;                    /* the only operand that is no constant; -1: all are active */
  size_t n, first[OPERANDS + 1]; /* where each operand starts */
  double x[MOST], beside[MOST];
} point;

static size_t size_of(kg_shape shape)
{
  size_t size = 1;
  for (int i = 0; i < shape.rank; ++i) {
    size *= (size_t)shape.dim[i];
  }
  return size;
}

/* operand k out of x, or a constant that does not follow x */
static kg_value unpack(kg_tape *tape, kg_value x, const point *p, int k)
{
  const kg_shape shape = p->row->variants[p->variant].of[k];
  const bool constant = p->active >= 0 && p->active != k;
  const size_t first = p->first[k];
  if (shape.rank < 0) {
    return constant ? kg_constant_scalar(tape, p->x[first]) : kg_element(tape, x, first);
  }
  if (constant) return kg_constant(tape, shape, &p->x[first]);
  return kg_reshape(tape, kg_slice(tape, x, 0, (int)first, (int)size_of(shape)), shape);
}

static kg_value record_with(recording *record, const point *p, kg_tape *tape, kg_value x)
{
  kg_value operands[OPERANDS];
  for (int k = 0; k < p->row->operands; ++k) {
    operands[k] = unpack(tape, x, p, k);
  }
  return record(tape, operands, p->variant);
}

static kg_value record_point(kg_tape *tape, kg_value x, void *user)
{
  const point *p = user;
  return record_with(p->row->record, p, tape, x);
}

static kg_value record_reference(kg_tape *tape, kg_value x, void *user)
{
  const point *p = user;
  return record_with(p->row->reference ? p->row->reference : p->row->record, p, tape, x);
}

static point point_of(const row *r, int variant)
{
  point p = {.row = r, .variant = variant, .active = -1};
  for (int k = 0; k < r->operands; ++k) {
    p.first[k + 1] = p.first[k] + size_of(r->variants[variant].of[k]);
  }
  p.n = p.first[r->operands];
  return p;
}

static void add_diagonal(const point *p, double *x)
{
  const kg_shape shape = p->row->variants[p->variant].of[0];
  const size_t k = (size_t)shape.dim[shape.rank - 1];
  for (size_t i = 0; i < p->first[1]; ++i) {
    if (i / k % k == i % k) x[i] += 4;
  }
}

static point random_point(const row *r, int variant, kg_random *random)
{
  point p = point_of(r, variant);
  for (size_t i = 0; i < p.n; ++i) {
    p.x[i] = r->low + (r->high - r->low) * kg_random_uniform(random);
  }
  if (r->dominant) add_diagonal(&p, p.x);
  return p;
}

/* the kink itself, and beside it where its derivative is taken */
static point kink_point(const row *r, int variant, const kink *k)
{
  point p = point_of(r, variant);
  for (size_t i = 0; i < p.n; ++i) {
    const bool a = i < p.first[1];
    const size_t e = i % (size_t)k->period;
    p.x[i] = a ? k->a[e] : k->b;
    p.beside[i] = p.x[i] + 1e-13 * (a ? k->side_a[e] + k->by_index * (double)i : k->side_b);
  }
  return p;
}

/* -- checks ------------------------------------------------------------------------------------ */

typedef struct walk {
  const row *row;
  kg_gradcheck_def def;
  kg_gradcheck_report *worst;
  kg_error *error;
  kg_random random;
} walk;

/* derivative: where the complex step is taken, NULL for a derivative of zero */
static kg_status check_point(walk *w, point *p, const double *derivative, bool taylor)
{
  kg_gradcheck_report report;
  kg_gradcheck_def def = w->def;
  def.taylor = def.taylor && taylor;
  def.seed = kg_random_bits(&w->random);
  const kg_gradcheck_truth truth = {record_reference, derivative};
  const kg_status status =
    kg_gradcheck_against(w->row->name, record_point, p, (kg_shape){1, {(int32_t)p->n}}, p->x,
                         &truth, &def, &report, w->error);
  if (status == KG_OK) kg_gradcheck_merge(w->worst, &report);
  return status;
}

static kg_status check_neighbours(walk *w, const kink *k, int variant)
{
  kg_status status = KG_OK;
  for (int side = 0; side < 6 && status == KG_OK; ++side) {
    const double h = (side % 2 ? -1 : 1) * pow(10, -3 - 3 * (side / 2)); /* 1e-3, 1e-6, 1e-9 */
    point p = kink_point(w->row, variant, k);
    for (size_t i = 0; i < p.n; ++i) {
      const double d = kg_random_normal(&w->random);
      p.x[i] += k->neighbours == ABOVE ? fabs(h * d) : h * d;
    }
    status = check_point(w, &p, p.x, false);
  }
  return status;
}

static kg_status check_kink(walk *w, const kink *k)
{
  kg_status status = KG_OK;
  for (int variant = 0; variant < w->row->variant_count && status == KG_OK; ++variant) {
    point p = kink_point(w->row, variant, k);
    status = check_point(w, &p, k->expected == ZERO ? NULL : p.beside, false);
    if (status == KG_OK) status = check_neighbours(w, k, variant);
  }
  return status;
}

static kg_status check_row(walk *w, int points)
{
  kg_status status = KG_OK;
  for (int i = 0; i < points && status == KG_OK; ++i) {
    const int round = i / w->row->variant_count;
    point p = random_point(w->row, i % w->row->variant_count, &w->random);
    if (w->row->operands > 1) p.active = round % (w->row->operands + 1) - 1;
    status = check_point(w, &p, p.x, round < 2);
  }
  for (size_t i = 0; i < KG_COUNT_OF(kinks) && status == KG_OK; ++i) {
    if (kinks[i].record == w->row->record) status = check_kink(w, &kinks[i]);
  }
  return status;
}

int kg_registry_count(void)
{
  return (int)KG_COUNT_OF(rows);
}

const char *kg_registry_name(int i)
{
  return rows[i].name;
}

kg_op kg_registry_op(int i)
{
  return rows[i].op;
}

kg_status kg_registry_check(int i, int points, const kg_gradcheck_def *def,
                            kg_gradcheck_report *report, kg_error *error)
{
  walk w = {.row = &rows[i],
            .def = def ? *def : kg_gradcheck_default_def(),
            .worst = report,
            .error = error};
  w.random = kg_random_make(w.def.seed + (uint64_t)i);
  *report = (kg_gradcheck_report){.name = rows[i].name,
                                  .passed = true,
                                  .method = "complex step",
                                  .tolerance = w.def.complex_tolerance,
                                  .taylor_order = NAN,
                                  .repeatable = true};
  const kg_status status = check_row(&w, points);
  report->passed = report->passed && status == KG_OK;
  return status;
}
