/* kinegrad/dynamics_lanes.h - kinematics and dynamics of eight frames (or environments) at once.
 *
 * Structure of arrays: number k of frame f lies at x[8 * k + f], for every array here. Frames do not
 * touch each other: one with numbers that are none leaves the other seven alone. The same bits on
 * every instruction set. Meaning, units and conventions as in dynamics.h; nothing is allocated.
 *
 * Equal to the plain call bit for bit: inverse, forward, mass_solve, velocity, acceleration, point.
 * The others come by other formulas (docs/theory/dynamics.md, sections 4a, 4b) and agree to
 * rounding. */
#ifndef KINEGRAD_DYNAMICS_LANES_H
#define KINEGRAD_DYNAMICS_LANES_H

#include "kinegrad/dynamics.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Eight matrices (nv, nv) in blocks of 3x3, kept only where one joint is an ancestor of the other:
 * block 0 is the root's velocity, block 1 + i the rotation of segment i. 23 segments: 132 blocks of
 * 300 on and below the diagonal, 76 kB for eight frames where dense ones take 332 kB. */
typedef struct kg_lanes_matrix kg_lanes_matrix;

/* For results of this dynamics object, or of another of the same body; it must live as long. */
KG_API KG_MUST_USE kg_status kg_lanes_matrix_create(kg_lanes_matrix **matrix,
                                                    const kg_dynamics *dynamics,
                                                    const kg_allocator *allocator);
KG_API void kg_lanes_matrix_destroy(kg_lanes_matrix *matrix);

/* Block (row, column): nine numbers, row by row, each of eight frames; NULL where it is zero. Of a
 * mass matrix only blocks on and below the diagonal are kept: NULL above it too. */
KG_API const double *kg_lanes_matrix_block(const kg_lanes_matrix *matrix, int row, int column);

/* out[nv*nv] row-major: the matrix of one frame, not factored. */
KG_API void kg_lanes_matrix_dense(const kg_lanes_matrix *matrix, int frame, double *out);

/* M = U' D U in place, from the leaves to the root, no fill-in [RBDA, section 6.4]. Bit f is set in
 * the result when a pivot of frame f is not a finite positive one: its solutions are no numbers to
 * use. */
KG_API KG_MUST_USE unsigned kg_lanes_matrix_factor(kg_lanes_matrix *M);
/* x := M^-1 x with the factors, x[8*nv] */
KG_API void kg_lanes_matrix_solve(const kg_lanes_matrix *M, double *x);

KG_API void kg_dynamics_inverse_lanes(kg_dynamics *dynamics, double *tau, const double *q,
                                      const double *v, const double *a);
KG_API void kg_dynamics_forward_lanes(kg_dynamics *dynamics, double *a, const double *q,
                                      const double *v, const double *tau);
/* x := M(q)^-1 x without M: for one right-hand side; for more, kg_lanes_matrix_factor. */
KG_API void kg_dynamics_mass_solve_lanes(kg_dynamics *dynamics, double *x, const double *q);

/* p, p_dot, w [8 * 3 n], R [8 * 9 n] (row by row); each may be NULL, and v where no rate is asked. */
KG_API void kg_dynamics_velocity_lanes(kg_dynamics *dynamics, const double *q, const double *v,
                                       double *p, double *R, double *p_dot, double *w);
/* p_ddot, alpha [8 * 3 n], each may be NULL */
KG_API void kg_dynamics_acceleration_lanes(kg_dynamics *dynamics, const double *q, const double *v,
                                           const double *a, double *p_ddot, double *alpha);

/* kg_centroid of eight frames */
typedef struct kg_centroid_lanes {
  double mass;
  double com[24], com_dot[24], L[24];
  double I[72];
} kg_centroid_lanes;

/* v may be NULL: then com_dot and L are zero. */
KG_API void kg_dynamics_centroid_lanes(kg_dynamics *dynamics, kg_centroid_lanes *centroid,
                                       const double *q, const double *v);
/* A[8 * 6 nv] */
KG_API void kg_dynamics_centroidal_matrix_lanes(kg_dynamics *dynamics, double *A, const double *q);
/* World places x[8 * 3] of one point of the body, and J[8 * 3 nv] where not NULL. */
KG_API void kg_dynamics_point_lanes(kg_dynamics *dynamics, double *x, double *J, const double *q,
                                    kg_body_point point);

KG_API void kg_dynamics_mass_matrix_lanes(kg_dynamics *dynamics, kg_lanes_matrix *M,
                                          const double *q);
/* Each output may be NULL; tau[8*nv]. */
KG_API void kg_dynamics_inverse_derivatives_lanes(kg_dynamics *dynamics, kg_lanes_matrix *dtau_dq,
                                                  kg_lanes_matrix *dtau_dv, kg_lanes_matrix *M,
                                                  double *tau, const double *q, const double *v,
                                                  const double *a);
/* These have no zeros along the tree: each [8 * nv*nv], dense, row-major, or NULL; a[8*nv] or
 * NULL. */
KG_API void kg_dynamics_forward_derivatives_lanes(kg_dynamics *dynamics, double *da_dq,
                                                  double *da_dv, double *da_dtau, double *a,
                                                  const double *q, const double *v,
                                                  const double *tau);

#ifdef __cplusplus
}
#endif
#endif
