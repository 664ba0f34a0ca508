/* Inside physics/: how a body moves, in the axes of its segments, and the way back: the adjoints of
 * poses, velocities, accelerations and of a second field of velocities lambda.
 *
 * Virtual power turns products with Jacobians into such fields: lambda' ID = sum over segments of
 * the motion lambda gives them times their rate of momentum, lambda' J_c' f = sum of x_dot(lambda)
 * . f. So the gradient of either needs one pass from the root to the leaves and one back, and no
 * matrix.
 *
 * Equation numbers: docs/theory/dynamics.md, section 7. */
#ifndef PHYSICS_CHAIN_H
#define PHYSICS_CHAIN_H

#include "kinegrad/arena.h"
#include "kinegrad/dynamics.h"

/* Adjoints, each of the quantity of the same letter in kg_chain_link, in the segment's axes. */
typedef struct kg_chain_adjoint {
  kg_vec3 turn; /* of R: by a rotation about the segment's own axes */
  kg_vec3 p;    /* of the joint's place in the world               */
  kg_vec3 w, v;
  kg_vec3 alpha, a;
  kg_vec3 mu, pi;
} kg_chain_adjoint;

/* A segment; vectors in its own axes. "in": what comes from the parent, before the joint adds its
 * own. */
typedef struct kg_chain_link {
  kg_mat3 Q, R;            /* relative to the parent (root: to the world); to the world */
  kg_vec3 p;               /* joint, world                                              */
  kg_vec3 w_in, w, v;      /* angular velocity; velocity of the joint                   */
  kg_vec3 alpha_in, alpha; /* angular acceleration                                      */
  kg_vec3 a;               /* acceleration of the joint minus gravity                   */
  kg_vec3 mu_in, mu, pi;   /* the field lambda: angular, linear at the joint            */
  kg_chain_adjoint bar;
} kg_chain_link;

/* What the way back carries; the others are neither read nor written. */
enum {
  KG_CHAIN_POSE = 1,         /* turn, p  */
  KG_CHAIN_VELOCITY = 2,     /* w, v     */
  KG_CHAIN_ACCELERATION = 4, /* w, alpha, a */
  KG_CHAIN_FIELD = 8         /* mu, pi   */
};

typedef struct kg_chain {
  const kg_body *body;
  int n;
  kg_chain_link *links;
  double *nu; /* nv */
} kg_chain;

/* Memory from the arena; check kg_arena_failed afterwards. */
void kg_chain_init(kg_chain *chain, const kg_body *body, kg_arena *arena);

/* Each uses what the ones before it left. q is normalised: its quaternions are unit. */
void kg_chain_pose(kg_chain *chain, const double *q);
void kg_chain_velocity(kg_chain *chain, const double *v);
void kg_chain_acceleration(kg_chain *chain, const double *v, const double *a, kg_vec3 gravity);
void kg_chain_field(kg_chain *chain, const double *lambda);

void kg_chain_clear(kg_chain *chain);
/* The rates of momentum: phi += lambda' ID, for POSE-free parts ACCELERATION and FIELD. Adds the
 * gradient by masses, centres of mass and inertias where wanted. */
void kg_chain_inertial(kg_chain *chain, const kg_body_gradient *body_bar);
/* A point s of segment i with the world adjoints of its place (needs POSE), its velocity (POSE,
 * VELOCITY) and its velocity in the field (POSE, FIELD); NULL: none. Adds to s_bar where wanted. */
void kg_chain_point(kg_chain *chain, int i, kg_vec3 s, const kg_vec3 *x_bar, const kg_vec3 *u_bar,
                    const kg_vec3 *xi_bar, double *s_bar);
/* The world adjoints of place, velocity and acceleration of joint i; NULL: none. A place needs
 * POSE, a velocity VELOCITY besides, an acceleration POSE and ACCELERATION with no gravity. */
void kg_chain_joint(kg_chain *chain, int i, const kg_vec3 *p_bar, const kg_vec3 *v_bar,
                    const kg_vec3 *a_bar);
/* A force f (world) on the point s of segment i: phi += lambda' J' f for lambda_bar alone. */
void kg_chain_force(kg_chain *chain, int i, kg_vec3 s, kg_vec3 f);

/* From the leaves to the root. NULL: not wanted. Results are added. */
typedef struct kg_chain_gradient {
  double *q, *v, *a, *lambda; /* nv; q in tangent space */
  double *offset;             /* 3 n */
} kg_chain_gradient;
void kg_chain_return(kg_chain *chain, int parts, const double *v, const kg_chain_gradient *out);

#endif
