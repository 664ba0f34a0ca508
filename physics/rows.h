/* Products of 3x3 matrices, row by row, two columns at a time: what the kernels spend their time on.
 * GCC and Clang turn the vectors of two into SSE2 or NEON; the plain form gives the same bits. */
#ifndef PHYSICS_ROWS_H
#define PHYSICS_ROWS_H

#include "kinegrad/vec3.h"

#include <string.h>

#if defined(__GNUC__)
typedef double pair __attribute__((vector_size(16)));
#else
typedef struct pair_of_columns {
  double c[2];
} pair;
#endif

/* A matrix held as three rows of (first two columns, third column). */
typedef struct rows3 {
  pair two[3];
  double one[3];
} rows3;

static inline rows3 load_rows(const kg_mat3 *B)
{
  rows3 r;
  for (int i = 0; i < 3; i++) {
    memcpy(&r.two[i], B->m + 3 * i, sizeof r.two[i]);
    r.one[i] = B->m[3 * i + 2];
  }
  return r;
}

/* c[3] += a0 row0 + a1 row1 + a2 row2 */
static inline void add_row(double *c, double a0, double a1, double a2, const rows3 *b)
{
#if defined(__GNUC__)
  const pair x0 = {a0, a0}, x1 = {a1, a1}, x2 = {a2, a2};
  pair sum;
  memcpy(&sum, c, sizeof sum);
  sum += x0 * b->two[0] + x1 * b->two[1] + x2 * b->two[2];
  memcpy(c, &sum, sizeof sum);
#else
  for (int k = 0; k < 2; k++) {
    c[k] += a0 * b->two[0].c[k] + a1 * b->two[1].c[k] + a2 * b->two[2].c[k];
  }
#endif
  c[2] += a0 * b->one[0] + a1 * b->one[1] + a2 * b->one[2];
}

#endif
