/* kinegrad/dynamics.h - kinematics and dynamics of a body: RNEA, CRBA, momentum and derivatives.
 *
 * Spatial quantities are in world axes about the origin O = root position of the call's q, which is
 * held fixed while differentiating. Units SI. Gravity acts along -Y unless set otherwise.
 *
 * [RBDA] R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008.
 * [SRW]  S. Singh, R. P. Russell, P. M. Wensing, Efficient analytical derivatives of rigid-body
 *        dynamics using spatial vector algebra, IEEE RA-L 7(2), 2022. */
#ifndef KINEGRAD_DYNAMICS_H
#define KINEGRAD_DYNAMICS_H

#include "kinegrad/body.h"
#include "kinegrad/spatial.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Per-body results of a call and scratch. One per thread. */
typedef struct kg_dynamics kg_dynamics;

KG_API KG_MUST_USE kg_status kg_dynamics_create(kg_dynamics **dynamics, const kg_body *body,
                                                const kg_allocator *allocator);
KG_API void kg_dynamics_destroy(kg_dynamics *dynamics);
/* Call it after masses, inertias, centres of mass or offsets of the body have changed. */
KG_API void kg_dynamics_refresh(kg_dynamics *dynamics);
/* default (0, -9.8, 0) m/s^2 */
KG_API void kg_dynamics_set_gravity(kg_dynamics *dynamics, kg_vec3 gravity);

/* World pose of every segment: joint positions p[n] (m) and rotations R[n]; either may be NULL. */
KG_API void kg_dynamics_pose(kg_dynamics *dynamics, const double *q, kg_vec3 *p, kg_mat3 *R);

/* Velocities of the joints' origins (world, m/s) and angular velocities of the segments (world,
 * rad/s), with the pose; any output may be NULL. */
KG_API void kg_dynamics_velocity(kg_dynamics *dynamics, const double *q, const double *v,
                                 kg_vec3 *p, kg_mat3 *R, kg_vec3 *p_dot, kg_vec3 *w);

/* tau[nv] = ID(q, v, a): forces that produce a under gravity, no contact [RBDA, Table 5.1]. */
KG_API void kg_dynamics_inverse(kg_dynamics *dynamics, double *tau, const double *q,
                                const double *v, const double *a);

/* a[nv] = FD(q, v, tau): articulated-body algorithm [RBDA, Table 7.1]; a may be tau. A segment that
 * can turn without moving any mass (docs/theory/dynamics.md, section 6) gives numbers that are not
 * finite. */
KG_API void kg_dynamics_forward(kg_dynamics *dynamics, double *a, const double *q, const double *v,
                                const double *tau);
/* x := M(q)^-1 x, x[nv], in O(n): forward dynamics without motion and gravity. */
KG_API void kg_dynamics_mass_solve(kg_dynamics *dynamics, double *x, const double *q);

/* count frames, one after the other: q (count, nq), the others (count, nv), row-major. Every frame
 * gets the numbers of the plain call, bit for bit. */
KG_API void kg_dynamics_inverse_many(kg_dynamics *dynamics, int count, double *tau, const double *q,
                                     const double *v, const double *a);
KG_API void kg_dynamics_forward_many(kg_dynamics *dynamics, int count, double *a, const double *q,
                                     const double *v, const double *tau);

/* Poses, and velocities when p_dot or w is given (else v may be NULL): p, p_dot, w (count, n) and R
 * (count, n), each may be NULL. */
KG_API void kg_dynamics_velocity_many(kg_dynamics *dynamics, int count, const double *q,
                                      const double *v, kg_vec3 *p, kg_mat3 *R, kg_vec3 *p_dot,
                                      kg_vec3 *w);

/* Accelerations in the world: of the joints' origins, p_ddot[n] (m/s^2, without gravity), and of
 * the segments' rotation, alpha[n] (rad/s^2); either may be NULL. */
KG_API void kg_dynamics_acceleration(kg_dynamics *dynamics, const double *q, const double *v,
                                     const double *a, kg_vec3 *p_ddot, kg_vec3 *alpha);

/* M[nv*nv], row-major, full symmetric [RBDA, Table 6.2]. */
KG_API void kg_dynamics_mass_matrix(kg_dynamics *dynamics, double *M, const double *q);

/* dtau/dq (tangent space, right perturbation), dtau/dv, dtau/da = M; each nv*nv row-major, each may
 * be NULL. Also tau when not NULL. [SRW, Table I] */
KG_API void kg_dynamics_inverse_derivatives(kg_dynamics *dynamics, double *dtau_dq, double *dtau_dv,
                                            double *M, double *tau, const double *q,
                                            const double *v, const double *a);

/* Where a gradient by the numbers of a body goes; NULL: not wanted. The offset of the root is not
 * used by the dynamics, its gradient stays. */
typedef struct kg_body_gradient {
  double *mass;    /* n                                                       */
  double *com;     /* 3 n                                                     */
  double *inertia; /* 6 n, order of kg_segment: xx yy zz xy xz yz             */
  double *offset;  /* 3 n: lengths                                            */
  double *points;  /* 3 point_count: in segment frames; only contacts move it */
} kg_body_gradient;

/* Gradient of lambda' ID(q, v, a), lambda held: adds to q_bar (tangent space), v_bar, a_bar [nv]
 * and body_bar, each may be NULL. O(n), no matrix: docs/theory/dynamics.md, section 7. */
KG_API void kg_dynamics_inverse_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar,
                                    double *a_bar, const kg_body_gradient *body_bar,
                                    const double *q, const double *v, const double *a,
                                    const double *lambda);

/* da/dq (tangent space), da/dv, da/dtau = M^-1 at a = FD(q, v, tau); each nv*nv row-major, each may
 * be NULL; a too when not NULL. -M^-1 times the derivatives of inverse dynamics at a. */
KG_API void kg_dynamics_forward_derivatives(kg_dynamics *dynamics, double *da_dq, double *da_dv,
                                            double *da_dtau, double *a, const double *q,
                                            const double *v, const double *tau);

/* Gradient of a_bar . a for a = FD(q, v, tau), which is given: adds to the others. One solve with M
 * and one adjoint of inverse dynamics. */
KG_API void kg_dynamics_forward_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar,
                                    double *tau_bar, const double *q, const double *v,
                                    const double *a, const double *a_bar);

/* World adjoints, one for each joint, of its place, velocity and acceleration
 * (kg_dynamics_pose, _velocity, _acceleration): adds the gradient to q_bar (tangent space), v_bar,
 * a_bar [nv] and offset_bar[3 n]. NULL: not wanted, or no such adjoint; v and a may be NULL where
 * no adjoint needs them. */
KG_API void kg_dynamics_motion_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar,
                                   double *a_bar, double *offset_bar, const double *q,
                                   const double *v, const double *a, const kg_vec3 *place_bar,
                                   const kg_vec3 *velocity_bar, const kg_vec3 *acceleration_bar);

/* tau[nv] = sum of J_k' f_k: the generalised force of world forces f[point_count] on the body's
 * points. */
KG_API void kg_dynamics_point_forces(kg_dynamics *dynamics, double *tau, const double *q,
                                     const kg_vec3 *f);
/* Gradient of tau_bar . tau: adds to q_bar (tangent space) and f_bar[point_count]. */
KG_API void kg_dynamics_point_forces_vjp(kg_dynamics *dynamics, double *q_bar, kg_vec3 *f_bar,
                                         const double *q, const kg_vec3 *f, const double *tau_bar);

/* World places x[point_count] of the body's points and, where not NULL, their velocities for v. */
KG_API void kg_dynamics_points(kg_dynamics *dynamics, kg_vec3 *x, kg_vec3 *x_dot, const double *q,
                               const double *v);
/* Gradient for adjoints of both (x_dot_bar may be NULL, and v with it): adds to q_bar (tangent
 * space) and v_bar. */
KG_API void kg_dynamics_points_vjp(kg_dynamics *dynamics, double *q_bar, double *v_bar,
                                   const double *q, const double *v, const kg_vec3 *x_bar,
                                   const kg_vec3 *x_dot_bar);

typedef struct kg_centroid {
  double mass;     /* kg                                             */
  kg_vec3 com;     /* world, m                                       */
  kg_vec3 com_dot; /* m/s                                            */
  kg_vec3 L;       /* angular momentum about the com, kg m^2/s       */
  kg_mat3 I;       /* rotational inertia of the locked body about the com, world axes, kg m^2 */
} kg_centroid;

/* v may be NULL: then com_dot and L are zero. */
KG_API kg_centroid kg_dynamics_centroid(kg_dynamics *dynamics, const double *q, const double *v);

/* A[6*nv] row-major: angular momentum about the centre of mass (three rows), then linear momentum,
 * both in world axes, are A v. [D. E. Orin, A. Goswami, S.-H. Lee, Centroidal dynamics of a
 * humanoid robot, Autonomous Robots 35, 2013] */
KG_API void kg_dynamics_centroidal_matrix(kg_dynamics *dynamics, double *A, const double *q);

/* World position of a body point; J (3*nv row-major, may be NULL) with p_dot = J v. */
KG_API kg_vec3 kg_dynamics_point(kg_dynamics *dynamics, double *J, const double *q,
                                 kg_body_point point);

/* Kinetic plus potential energy, J (potential zero at height 0). */
KG_API double kg_dynamics_energy(kg_dynamics *dynamics, const double *q, const double *v);

#ifdef __cplusplus
}
#endif
#endif
