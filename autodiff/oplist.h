/* oplist.h - every operator, once. The enum, the names in messages, the kernel tables and the
 * registry of checks are made from these lists.
 *
 * Element-wise rules are written once, for scalars and tensors, float, double and complex
 * numbers. In a rule
 *   a, b   operands      y   the result      p, q   the operator's constants
 * and capitals are the functions of the number type (kernels/number.h). Comparisons look at real
 * parts. */
#ifndef AUTODIFF_OPLIST_H
#define AUTODIFF_OPLIST_H

/* clang-format off */

/* name, value, derivative by a */
#define KG_UNARY_LIST(X)                                                                           \
  X(neg,        -a,                     -(KG_ONE))                                                 \
  X(reciprocal, KG_ONE / a,             -(y * y))                                                  \
  X(square,     a * a,                  a + a)                                                     \
  X(sqrt,       SQRT(a),                HALF / y)                                                  \
  X(abs,        ABS(a),                 SIGN(a))                                                   \
  X(exp,        EXP(a),                 y)                                                         \
  X(expm1,      EXPM1(a),               y + KG_ONE)                                                \
  X(log,        LOG(a),                 KG_ONE / a)                                                \
  X(log1p,      LOG1P(a),               KG_ONE / (KG_ONE + a))                                     \
  X(tan,        TAN(a),                 KG_ONE + y * y)                                            \
  X(asin,       ASIN(a),                KG_ONE / SQRT((KG_ONE - a) * (KG_ONE + a)))                \
  X(acos,       ACOS(a),                -KG_ONE / SQRT((KG_ONE - a) * (KG_ONE + a)))               \
  X(atan,       ATAN(a),                KG_ONE / (KG_ONE + a * a))                                 \
  X(sinh,       SINH(a),                COSH(a))                                                   \
  X(cosh,       COSH(a),                SINH(a))                                                   \
  X(tanh,       TANH(a),                (KG_ONE - y) * (KG_ONE + y))                               \
  X(sigmoid,    SIGMOID(a),             y * (KG_ONE - y))                                          \
  X(softplus,   SOFTPLUS(a),            SIGMOID(a))                                                \
  X(relu,       RE(a) <= 0 ? KG_ZERO : a, RE(a) <= 0 ? KG_ZERO : KG_ONE)                           \
  X(scale,      p * a,                  p)                                                         \
  X(shift,      a + p,                  KG_ONE)                                                    \
  X(power,      POW(a, p),              POWER_SLOPE(a, p))

/* whose loops have a form of their own (elementary.h) */
#define KG_TRIG_LIST(X)                                                                            \
  X(sin,        SIN(a),                 COS(a))                                                    \
  X(cos,        COS(a),                 -SIN(a))

/* of two constants: tensors only, a scalar's is made of min and max */
#define KG_CLAMP_LIST(X)                                                                           \
  X(clamp,      CLAMP(a, p, q),         RE(a) >= RE(p) && RE(a) <= RE(q) ? KG_ONE : KG_ZERO)

/* name, value, derivative by a, derivative by b */
#define KG_BINARY_LIST(X)                                                                          \
  X(add,   a + b,       KG_ONE,                    KG_ONE)                                         \
  X(sub,   a - b,       KG_ONE,                    -(KG_ONE))                                      \
  X(mul,   a * b,       b,                         a)                                              \
  X(div,   a / b,       KG_ONE / b,                -(y / b))                                       \
  X(pow,   POW(a, b),   POWER_SLOPE(a, b),         RE(a) > 0 ? y * LOG(a) : KG_ZERO)               \
  X(atan2, ATAN2(a, b), ATAN2_SLOPE(b, a, b),      -ATAN2_SLOPE(a, a, b))                          \
  X(hypot, HYPOT(a, b), HYPOT_SLOPE(a, y),         HYPOT_SLOPE(b, y))                              \
  X(min,   MIN(a, b),   RE(a) <= RE(b) ? KG_ONE : KG_ZERO, RE(a) <= RE(b) ? KG_ZERO : KG_ONE)      \
  X(max,   MAX(a, b),   RE(a) >= RE(b) ? KG_ONE : KG_ZERO, RE(a) >= RE(b) ? KG_ZERO : KG_ONE)

/* operators with kernels of their own, by the file that holds them */
#define KG_CHOICE_LIST(X) X(less) X(less_equal) X(is_less) X(where)
#define KG_REDUCTION_LIST(X)                                                                       \
  X(combine) X(sum) X(sum_squares) X(norm) X(dot) X(max_along) X(min_along) X(logsumexp) X(softmax)
#define KG_MATRIX_LIST(X) X(matmul) X(affine) X(solve) X(solve_triangular)
#define KG_MOVE_LIST(X)                                                                            \
  X(reshape) X(broadcast) X(transpose) X(slice) X(concat) X(element) X(gather) X(scatter)
#define KG_ROTATION_LIST(X)                                                                        \
  X(cross) X(compose) X(rotate) X(rotation_exp) X(rotation_log) X(normalize)
#define KG_NETWORK_LIST(X) X(aggregate) X(convolve)

#define KG_TENSOR_LIST(X)                                                                          \
  KG_CHOICE_LIST(X) KG_REDUCTION_LIST(X) KG_MATRIX_LIST(X) KG_MOVE_LIST(X) KG_ROTATION_LIST(X)     \
  KG_NETWORK_LIST(X)

#define KG_ENUM(name, ...) kg_op_##name,
#define KG_ENUM_TENSOR(name) kg_op_##name,
typedef enum kg_op {
  kg_op_input, kg_op_constant, kg_op_primitive,
  KG_UNARY_LIST(KG_ENUM) KG_TRIG_LIST(KG_ENUM) KG_CLAMP_LIST(KG_ENUM) KG_BINARY_LIST(KG_ENUM)
  KG_TENSOR_LIST(KG_ENUM_TENSOR)
  KG_OP_COUNT
} kg_op;
#undef KG_ENUM
#undef KG_ENUM_TENSOR
/* clang-format on */

/* "matmul", for messages; the primitive's own name is in its attributes */
const char *kg_op_name(kg_op op);

#endif
