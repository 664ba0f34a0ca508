/* The least move out of a scene as Ceres finds it: the independent answer to kinegrad/correction.h.
 *
 *   min 1/2 D' M(q0) D   subject to   Phi_k(q0 (+) D) >= 0
 *
 * by an augmented Lagrangian, every round of which is a least squares problem. Nothing is shared
 * with physics/correction.c but the distance itself. */
#ifndef BENCH_CORRECTION_LEAST_REFERENCE_H
#define BENCH_CORRECTION_LEAST_REFERENCE_H

#include "kinegrad/body.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/sdf.h"

typedef struct least_reference least_reference;

/* NULL without memory. Borrows both. */
least_reference *least_reference_create(const kg_body *body, const kg_scene *scene);
void least_reference_destroy(least_reference *reference);

/* D[nv]: start in, constrained minimum out. Returns its length sqrt(D' M D); *depth: what is left,
 * m. NaN when Ceres refuses. */
double least_reference_move(least_reference *reference, const double *q0, double *D, double *depth);

#endif
