/* kinegrad/operators.h - the operators of the tape.
 *
 * Conventions. Tensors are row-major; an axis may be counted from the end (-1 is the last).
 * Element-wise operators broadcast: shapes are aligned at the last axis, and an extent of 1 or a
 * missing axis is repeated. KG_ERR_SHAPE with both shapes in the text where they do not fit.
 * Every function returns the null value on failure (tape.h).
 *
 * Not-a-number. A zero adjoint stops: element-wise rules add nothing where the adjoint of the
 * result is zero, even where the partial derivative is infinite or NaN (sqrt at 0). Matrix
 * products, solves and convolutions follow IEEE arithmetic. Where a function has a kink the
 * derivative used is stated.
 *
 * Source of the adjoint rules of matrix operators: M. B. Giles, Collected matrix derivative
 * results for forward and reverse mode algorithmic differentiation, Advances in AD, LNCSE 64
 * (2008). */
#ifndef KINEGRAD_OPERATORS_H
#define KINEGRAD_OPERATORS_H

#include "kinegrad/tape.h"

#ifdef __cplusplus
extern "C" {
#endif

/* -- element-wise, two operands ---------------------------------------------------------------- */

KG_API kg_value kg_add(kg_tape *tape, kg_value a, kg_value b);
KG_API kg_value kg_sub(kg_tape *tape, kg_value a, kg_value b);
KG_API kg_value kg_mul(kg_tape *tape, kg_value a, kg_value b);
KG_API kg_value kg_div(kg_tape *tape, kg_value a, kg_value b);
/* a^b for a > 0 (a = 0 with b > 0 too; the derivative by b there is 0). */
KG_API kg_value kg_pow(kg_tape *tape, kg_value a, kg_value b);
/* Angle of the point (x, y); derivatives 0 at the origin. */
KG_API kg_value kg_atan2(kg_tape *tape, kg_value y, kg_value x);
/* sqrt(a^2 + b^2) without overflow; derivatives 0 at the origin. */
KG_API kg_value kg_hypot(kg_tape *tape, kg_value a, kg_value b);
/* The smaller, the larger; a tie gives value and derivative of a. NaN if either is NaN. */
KG_API kg_value kg_min(kg_tape *tape, kg_value a, kg_value b);
KG_API kg_value kg_max(kg_tape *tape, kg_value a, kg_value b);

/* -- element-wise, one operand ----------------------------------------------------------------- */

KG_API kg_value kg_scale(kg_tape *tape, kg_value a, double factor);
KG_API kg_value kg_shift(kg_tape *tape, kg_value a, double term);
/* a^exponent: any a for an integer exponent, a >= 0 otherwise. */
KG_API kg_value kg_power(kg_tape *tape, kg_value a, double exponent);
/* min(max(a, low), high); derivative 1 for low <= a <= high, 0 outside. NaN stays NaN. */
KG_API kg_value kg_clamp(kg_tape *tape, kg_value a, double low, double high);

KG_API kg_value kg_neg(kg_tape *tape, kg_value a);
KG_API kg_value kg_reciprocal(kg_tape *tape, kg_value a);
KG_API kg_value kg_square(kg_tape *tape, kg_value a);
KG_API kg_value kg_sqrt(kg_tape *tape, kg_value a); /* derivative at 0: +infinity, see the head */
KG_API kg_value kg_abs(kg_tape *tape, kg_value a);  /* derivative at 0: 0 */
KG_API kg_value kg_exp(kg_tape *tape, kg_value a);
KG_API kg_value kg_expm1(kg_tape *tape, kg_value a);
KG_API kg_value kg_log(kg_tape *tape, kg_value a);
KG_API kg_value kg_log1p(kg_tape *tape, kg_value a);
KG_API kg_value kg_sin(kg_tape *tape, kg_value a);
KG_API kg_value kg_cos(kg_tape *tape, kg_value a);
KG_API kg_value kg_tan(kg_tape *tape, kg_value a);
KG_API kg_value kg_asin(kg_tape *tape, kg_value a);
KG_API kg_value kg_acos(kg_tape *tape, kg_value a);
KG_API kg_value kg_atan(kg_tape *tape, kg_value a);
KG_API kg_value kg_sinh(kg_tape *tape, kg_value a);
KG_API kg_value kg_cosh(kg_tape *tape, kg_value a);
KG_API kg_value kg_tanh(kg_tape *tape, kg_value a);
KG_API kg_value kg_sigmoid(kg_tape *tape, kg_value a);  /* 1 / (1 + exp(-a)) */
KG_API kg_value kg_softplus(kg_tape *tape, kg_value a); /* log(1 + exp a)    */
KG_API kg_value kg_relu(kg_tape *tape, kg_value a);     /* max(a, 0); derivative at 0: 0 */

/* -- choice ------------------------------------------------------------------------------------ */

/* 1 where a < b (a <= b), else 0: a mask for kg_where, without derivative. */
KG_API kg_value kg_less(kg_tape *tape, kg_value a, kg_value b);
KG_API kg_value kg_less_equal(kg_tape *tape, kg_value a, kg_value b);

/* a where mask is not 0, else b. The operand not taken receives adjoint 0, whatever it holds. */
KG_API kg_value kg_where(kg_tape *tape, kg_value mask, kg_value a, kg_value b);

/* For an `if` in the recording code: the answer of a < b for two scalars. It is remembered: a
 * frozen program whose new inputs turn it around says so (KG_ERR_STALE) instead of following the
 * recorded branch. False when an operand is null. */
KG_API bool kg_is_less(kg_tape *tape, kg_value a, kg_value b);

/* -- sums and products ------------------------------------------------------------------------- */

/* sum_i factors[i] terms[i], terms of one shape; count >= 1. */
KG_API kg_value kg_combine(kg_tape *tape, int count, const double *factors, const kg_value *terms);

/* Reductions remove their axis. */
KG_API kg_value kg_sum(kg_tape *tape, kg_value a, int axis);
KG_API kg_value kg_sum_all(kg_tape *tape, kg_value a);
KG_API kg_value kg_sum_squares(kg_tape *tape, kg_value a, int axis);
/* Euclidean norm without overflow; derivative at the zero vector: 0. */
KG_API kg_value kg_norm(kg_tape *tape, kg_value a, int axis);
/* sum of a b along the axis; shapes equal. */
KG_API kg_value kg_dot(kg_tape *tape, kg_value a, kg_value b, int axis);
/* Extreme along the axis; the first of equal ones takes the derivative. NaN if there is one. */
KG_API kg_value kg_max_along(kg_tape *tape, kg_value a, int axis);
KG_API kg_value kg_min_along(kg_tape *tape, kg_value a, int axis);
/* log sum exp, shifted by the largest entry. Entries of +infinity share the derivative equally, and
 * so do those of a row of -infinity. */
KG_API kg_value kg_logsumexp(kg_tape *tape, kg_value a, int axis);
/* exp(a - logsumexp a); keeps the axis. */
KG_API kg_value kg_softmax(kg_tape *tape, kg_value a, int axis);

/* -- matrices ---------------------------------------------------------------------------------- */

enum {
  KG_TRANSPOSE_A = 1, /* use the transposes of the last two axes */
  KG_TRANSPOSE_B = 2,
  KG_UPPER = 4, /* the triangle is the upper one (default: lower) */
  KG_UNIT = 8   /* its diagonal is taken as 1                     */
};

/* Product over the last two axes: (..., m, k) (..., k, n) -> (..., m, n). Leading axes are
 * equal, or one operand has rank 2 and serves all. flags: KG_TRANSPOSE_A, KG_TRANSPOSE_B. */
KG_API kg_value kg_matmul(kg_tape *tape, kg_value a, kg_value b, int flags);

/* x W + bias: x (..., m), W (m, n), bias (n) or the null value for none -> (..., n). */
KG_API kg_value kg_affine(kg_tape *tape, kg_value x, kg_value weight, kg_value bias);

/* X with A X = B: A (..., n, n), B (..., n, m), leading axes equal. LU with row exchanges; a
 * pivot that is zero or not finite: KG_ERR_UNDEFINED. flags: KG_TRANSPOSE_A. */
KG_API kg_value kg_solve(kg_tape *tape, kg_value a, kg_value b, int flags);

/* The same for a triangular A, of which the other triangle is not read.
 * flags: KG_TRANSPOSE_A, KG_UPPER, KG_UNIT. */
KG_API kg_value kg_solve_triangular(kg_tape *tape, kg_value a, kg_value b, int flags);

/* -- moving entries ---------------------------------------------------------------------------- */

KG_API kg_value kg_reshape(kg_tape *tape, kg_value a, kg_shape shape);
KG_API kg_value kg_broadcast(kg_tape *tape, kg_value a, kg_shape shape);
/* Exchanges two axes. */
KG_API kg_value kg_transpose(kg_tape *tape, kg_value a, int axis1, int axis2);
KG_API kg_value kg_slice(kg_tape *tape, kg_value a, int axis, int start, int count);
/* Joins along an axis of the operands. */
KG_API kg_value kg_concat(kg_tape *tape, int axis, int count, const kg_value *parts);
/* Scalars to a vector (count). */
KG_API kg_value kg_stack(kg_tape *tape, int count, const kg_value *scalars);
/* One entry as a scalar. */
KG_API kg_value kg_element(kg_tape *tape, kg_value a, size_t index);
/* Entry i of the axis of the result is entry index[i] of a; 0 where index[i] is -1. */
KG_API kg_value kg_gather(kg_tape *tape, kg_value a, int axis, int count, const int32_t *index);
/* The adjoint of gather: entry index[i] of the result, of extent `extent`, is the sum of the
 * entries i of a; index[i] = -1 drops one. */
KG_API kg_value kg_scatter(kg_tape *tape, kg_value a, int axis, int extent, const int32_t *index);

/* -- 3-vectors and rotations: the last axis is 3, or 4 for quaternions (w first) --------------- */

KG_API kg_value kg_cross(kg_tape *tape, kg_value a, kg_value b); /* equal shapes */
/* Hamilton product p q: first q, then p. Equal shapes. */
KG_API kg_value kg_compose(kg_tape *tape, kg_value p, kg_value q);
/* v rotated by the unit quaternion q: q v q*, computed as v + 2 w (u x v) + 2 u x (u x v), and
 * differentiated as this polynomial in q. */
KG_API kg_value kg_rotate(kg_tape *tape, kg_value q, kg_value v);
/* exp: rotation vector to unit quaternion; smooth through zero. */
KG_API kg_value kg_rotation_exp(kg_tape *tape, kg_value r);
/* log: shortest rotation vector of a unit quaternion; q and -q give the same. Differentiated as
 * 2 atan2(|u|, |w|) sign(w) u/|u|, whatever |q|; at w = 0 the derivative is that of w > 0.
 * The zero quaternion gives NaN. */
KG_API kg_value kg_rotation_log(kg_tape *tape, kg_value q);
/* a / |a| along the last axis (any extent); the zero vector gives 0 with derivative 0, as
 * does one too short for its inverse to be a number. */
KG_API kg_value kg_normalize(kg_tape *tape, kg_value a);

/* -- graphs and time --------------------------------------------------------------------------- */

/* A fixed sparse matrix in compressed rows: row r holds column[k] with weight[k],
 * start[r] <= k < start[r+1]. Copied by the operator. */
typedef struct kg_sparse {
  int32_t rows, columns;
  const int32_t *start;  /* (rows + 1), from 0, not decreasing */
  const int32_t *column; /* (start[rows])                      */
  const double *weight;  /* (start[rows])                      */
} kg_sparse;

/* Graph aggregation: x (..., columns, features) -> (..., rows, features). */
KG_API kg_value kg_aggregate(kg_tape *tape, const kg_sparse *matrix, kg_value x);

typedef enum kg_padding {
  KG_PAD_SAME,  /* zeros on both sides, as many frames out as in */
  KG_PAD_CAUSAL /* zeros before the first frame only             */
} kg_padding;

/* Convolution in time (the networks' kind: no reversal): x (batch, time, in), weight (taps, in,
 * out), bias (out) or null -> (batch, time, out):
 *   y[t] = bias + sum_k x[t + (k - c) dilation] weight[k],
 *   c = (taps - 1) / 2, or taps - 1 if causal. */
KG_API kg_value kg_convolve(kg_tape *tape, kg_value x, kg_value weight, kg_value bias,
                            kg_padding padding, int dilation);

#ifdef __cplusplus
}
#endif
#endif
