/* kinegrad/derivatives.h - gradients and directional derivatives of what a tape has recorded.
 *
 * Arrays are double for tapes of either precision; kg_adjoint_f32 reads a float tape without a
 * copy. Sweeps reuse the tape's memory: after the first of a size, none is allocated. A sweep
 * changes no value, and the same sweep twice gives the same bits. */
#ifndef KINEGRAD_DERIVATIVES_H
#define KINEGRAD_DERIVATIVES_H

#include "kinegrad/operators.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Backward sweep from one value with all its entries seeded by 1 (the gradient, for a scalar). */
KG_API kg_status kg_backward(kg_tape *tape, kg_value output);

/* The adjoint found by the last sweep, (size): valid until the next sweep or rewind. NULL, with the
 * tape's error set, for a constant, a value recorded after the sweep, the other precision, and
 * where the last sweep left no adjoint: it went forward, or backward only to the oldest of the
 * inputs asked for, and the value is older. After several seeds at once: that of the first. */
KG_API const double *kg_adjoint(kg_tape *tape, kg_value value);
KG_API const float *kg_adjoint_f32(kg_tape *tape, kg_value value);
KG_API double kg_adjoint_item(kg_tape *tape, kg_value value); /* entry 0; NaN on failure */

/* gradients[i] (size of inputs[i]) = d output / d inputs[i]; output has one entry. */
KG_API kg_status kg_gradient(kg_tape *tape, kg_value output, int count, const kg_value *inputs,
                             double *const *gradients);

/* Several seeds in one backward sweep.
 * seeds[o]   (directions, size of outputs[o])  the adjoints the sweep starts from
 * results[i] (directions, size of inputs[i])   sum_o (d outputs[o] / d inputs[i])' seeds[o] */
KG_API kg_status kg_vjp(kg_tape *tape, int directions, int output_count, const kg_value *outputs,
                        const double *const *seeds, int input_count, const kg_value *inputs,
                        double *const *results);

/* Several tangents in one forward sweep: results[o] = sum_i (d outputs[o] / d inputs[i])
 * tangents[i]. An input may be an intermediate value: its tangent is added to what the others give
 * it, so that kg_jvp is the transpose of kg_vjp. */
KG_API kg_status kg_jvp(kg_tape *tape, int directions, int input_count, const kg_value *inputs,
                        const double *const *tangents, int output_count, const kg_value *outputs,
                        double *const *results);

/* J (size of output, size of input), by forward sweeps when the input is the smaller, else by
 * backward sweeps. */
KG_API kg_status kg_jacobian(kg_tape *tape, kg_value output, kg_value input, double *J);

/* Columns of a sparse Jacobian that share no row get one colour and one tangent. colour[columns] is
 * filled with 0 .. *colours - 1, greedily, columns of many entries first
 * [A. Curtis, M. Powell, J. Reid, IMA J. Appl. Math. 13 (1974)]. Only the pattern is read. */
KG_API kg_status kg_colour_columns(const kg_sparse *pattern, int32_t *colour, int *colours);

/* The entries of the pattern, in its order: values[k] = J(row, column[k]). KG_ERR_SHAPE for a
 * pattern of other sizes, a colour that is not among 0 .. colours - 1, and two columns of one
 * colour in one row: their entries would be added up. Entries of J outside the pattern are not
 * looked for; they end up in those of their colour. */
KG_API kg_status kg_jacobian_coloured(kg_tape *tape, kg_value output, kg_value input,
                                      const kg_sparse *pattern, const int32_t *colour, int colours,
                                      double *values);

/* H v = d/dh gradient(x + h v) at h = 0 for the inputs together, exact to rounding: the recorded
 * graph is run again in complex arithmetic at x + i h v with h = 1e-100, forwards and backwards.
 * Numbers of the computation between 1e-90 |v| and 1e150 are meant: h is to vanish beside the
 * smallest, and complex divisions square the largest.
 * KG_ERR_UNSUPPORTED names a primitive that has no complex form. */
KG_API kg_status kg_hessian_product(kg_tape *tape, kg_value output, int count,
                                    const kg_value *inputs, const double *const *vectors,
                                    double *const *products);

#ifdef __cplusplus
}
#endif
#endif
