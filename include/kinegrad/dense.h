/* kinegrad/dense.h - dense linear systems through LAPACK, for row-major matrices.
 *
 * The library's own solvers use the sparsity of the problem; these are for small systems without
 * structure and as the independent answer the others are checked against. Nothing is allocated. */
#ifndef KINEGRAD_DENSE_H
#define KINEGRAD_DENSE_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* P A = L U with row exchanges: A[n*n] is overwritten, pivots[n] filled. False when a pivot is zero
 * or not finite; A must then not be used to solve. */
KG_API KG_MUST_USE bool kg_dense_lu_factor(double *A, int *pivots, int n);

/* Solves A x = b (or A' x = b) for `count` right-hand sides: b is (count, n), one after the other,
 * replaced by the solutions. LU and pivots from kg_dense_lu_factor. */
KG_API void kg_dense_lu_solve(const double *LU, const int *pivots, int n, double *b, int count);
KG_API void kg_dense_lu_solve_transposed(const double *LU, const int *pivots, int n, double *b,
                                         int count);

/* A = L L' of a symmetric positive definite A: reads the lower triangle and overwrites it with L;
 * the strict upper triangle is neither read nor written. False when A is not positive definite. */
KG_API KG_MUST_USE bool kg_dense_cholesky_factor(double *A, int n);

/* Solves A x = b for (count, n) right-hand sides as above. L from kg_dense_cholesky_factor. */
KG_API void kg_dense_cholesky_solve(const double *L, int n, double *b, int count);

/* Solves A x = b for a symmetric positive definite band matrix with `below` sub-diagonals:
 * A(j + i, j) is band[j * (below + 1) + i], i = 0 .. below. band and b[n] are overwritten (b by x).
 * False when A is not positive definite. */
KG_API KG_MUST_USE bool kg_band_cholesky_solve(double *band, int n, int below, double *b);

#ifdef __cplusplus
}
#endif
#endif
