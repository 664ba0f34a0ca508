/* Dynamics of a body from the definitions, for comparison: slow, dense, over complex numbers, so
 * that an imaginary step gives derivatives to the last digits. Shares no code with physics/. */
#ifndef BENCH_DYNAMICS_REFERENCE_H
#define BENCH_DYNAMICS_REFERENCE_H

#include "kinegrad/body.h"

/* Gravity of all comparisons, m/s^2 along -Y. */
static const double kg_bench_gravity = 9.8;

/* Positions of the joints, 3 n, and rotations of the segments, row-major, 9 n. */
kg_status kg_bench_reference_pose(const kg_body *body, double *p, double *R, const double *q);
/* A (6 x nv): angular momentum about the centre of mass and linear momentum are A v. */
kg_status kg_bench_reference_centroidal(const kg_body *body, double *A, const double *q);
/* p_ddot (3 n), alpha (3 n) in the world, without gravity. */
kg_status kg_bench_reference_acceleration(const kg_body *body, double *p_ddot, double *alpha,
                                          const double *q, const double *v, const double *a);
/* J (3 x nv) of a point of the last segment, by complex steps. */
kg_status kg_bench_reference_point(const kg_body *body, double *J, const double *q, kg_vec3 point);
/* tau[nv] = ID(q, v, a) */
kg_status kg_bench_reference_inverse(const kg_body *body, double *tau, const double *q,
                                     const double *v, const double *a);
/* M[nv*nv], column k the inverse dynamics of a = e_k at rest without gravity. */
kg_status kg_bench_reference_mass(const kg_body *body, double *M, const double *q);
/* x := M^-1 x, by Cholesky, refined in long double; so are the next and their derivatives. */
kg_status kg_bench_reference_solve(const kg_body *body, double *x, const double *q);
/* a[nv] = M^-1 (tau - ID(q, v, 0)) */
kg_status kg_bench_reference_forward(const kg_body *body, double *a, const double *q,
                                     const double *v, const double *tau);
/* dtau/dq in the tangent space (right perturbation), dtau/dv; nv*nv row-major. */
kg_status kg_bench_reference_derivatives(const kg_body *body, double *dtau_dq, double *dtau_dv,
                                         const double *q, const double *v, const double *a);
/* da/dq, da/dv, da/dtau at a = FD(q, v, tau); nv*nv row-major. */
kg_status kg_bench_reference_forward_derivatives(const kg_body *body, double *da_dq, double *da_dv,
                                                 double *da_dtau, const double *q, const double *v,
                                                 const double *tau);

#endif
