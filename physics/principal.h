/* Inside physics/: the axes of a symmetric 3x3 matrix, by Jacobi rotations to the last bit. */
#ifndef PHYSICS_PRINCIPAL_H
#define PHYSICS_PRINCIPAL_H

#include "kinegrad/vec3.h"

#include <math.h>

/* One Jacobi rotation that zeroes A(p,q); V collects the rotations. */
static inline void principal_rotate_away(kg_mat3 *A, kg_mat3 *V, int p, int q)
{
  const double apq = A->m[3 * p + q];
  if (apq == 0.0) return;
  const double theta = 0.5 * (A->m[4 * q] - A->m[4 * p]) / apq;
  const double t = (theta >= 0.0 ? 1.0 : -1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
  const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
  kg_mat3 J = kg_mat3_identity();
  J.m[4 * p] = c;
  J.m[4 * q] = c;
  J.m[3 * p + q] = s;
  J.m[3 * q + p] = -s;
  *A = kg_mat3_mul(kg_mat3_transposed(J), kg_mat3_mul(*A, J));
  A->m[3 * p + q] = 0.0;
  A->m[3 * q + p] = 0.0;
  *V = kg_mat3_mul(*V, J);
}

/* A becomes diagonal, V' A V; the columns of V, which is returned, are its axes. */
static inline kg_mat3 principal_diagonalise(kg_mat3 *A)
{
  kg_mat3 V = kg_mat3_identity();
  for (int sweep = 0; sweep < 30; sweep++) {
    principal_rotate_away(A, &V, 0, 1);
    principal_rotate_away(A, &V, 0, 2);
    principal_rotate_away(A, &V, 1, 2);
  }
  return V;
}

#endif
