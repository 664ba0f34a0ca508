/* Smallest move in the metric of a matrix that satisfies linear inequalities. Internal.
 *
 *   minimise  1/2 x' M x   subject to  G x >= b                                             (1)
 *
 * Its dual is a non-negative least squares problem, solved by the active-set method of
 * [LH] C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, SIAM 1995, chapter 23, in the
 * form that needs the Gram matrix only. */
#ifndef KG_SOLVER_LEAST_MOVE_H
#define KG_SOLVER_LEAST_MOVE_H

#include "kinegrad/arena.h"

typedef struct least_move {
  int n;           /* unknowns                                      */
  int most;        /* active rows, at most: n + 1                   */
  int rows_max;    /* inequalities, at most                         */
  double *Z;       /* (most, n) M^-1 g of the active rows           */
  double *A;       /* (most, most) g' M^-1 g of the active rows     */
  double *factor;  /* (most, most) Cholesky factor of A             */
  double *trial;   /* (most) multipliers that make them equalities  */
  double *rest;    /* (most) what is left of b for the refinement   */
  int *active;     /* (most) row numbers, in the order they came    */
  bool *is_active; /* (rows_max)                                    */
} least_move;

/* Memory from the arena; check kg_arena_failed. */
void least_move_init(least_move *w, int n, int rows_max, kg_arena *arena);

/* L: Cholesky factor of M (kg_dense_cholesky_factor). G (rows, n), b (rows). x[n] and the
 * multipliers lambda[rows] >= 0, x = M^-1 G' lambda, come out. A row counts as satisfied when it
 * misses b by no more than tolerance. False when the rows contradict each other (or nearly so): x is
 * then a compromise. Allocates nothing. */
bool least_move_solve(least_move *w, const double *L, const double *G, const double *b, int rows,
                      double tolerance, double *x, double *lambda);

#endif
