/* kinegrad/contact.h - compliant contact in a thin layer outside the rigid surface.
 *
 * The layer (docs/theory/contact.md): force starts at Phi = layer and grows without bound towards
 * the surface, so weight is carried at Phi > 0 and the rigid sample points stay out of the ground.
 *
 * Normal force of a point at distance Phi that moves at Phi_dot, with d = layer - Phi > 0:
 *   f_n = f_layer * d^2 / (layer * Phi) * ramp(1 - damping * Phi_dot)       for Phi >= floor
 * and its C1 linear continuation below floor = floor_share * layer (inside the ground as well);
 * exactly zero for Phi >= layer; ramp(u) = max(u, 0) smoothed to C1, so never adhesive.
 * On soft ground (kg_ground: thickness h, stiffness k, damping c_g) the layer is h + layer thick and
 *   f_n += s * ramp(1 - c_g Phi_dot),  s = k p^2 / (2 layer) for p = h + layer - Phi < layer,
 *                                      s = k (p - layer / 2) for more:
 * Phi is the distance from the rigid core, which the first term keeps the point out of.
 * u, Phi_dot: relative to the shape (kg_place) where it moves.
 * Friction: f_t = -mu f_n g(|u_t| / stick) u_t / |u_t|,  g(s) = 2 s - s^2 for s < 1, else 1.
 * C1 everywhere; the derivation and the choice of law are in docs/theory/contact.md. */
#ifndef KINEGRAD_CONTACT_H
#define KINEGRAD_CONTACT_H

#include "kinegrad/base.h"
#include "kinegrad/sdf.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_contact_params {
  double layer;        /* m; thickness of sole and soft tissue; default 0.006                     */
  double force;        /* N; f_layer, the force of a point at rest at Phi = 0.382 layer; 140      */
  double floor_share;  /* of the layer; below it the law is continued linearly; default 0.02      */
  double damping;      /* s/m; share of extra force per approach speed; default 1.0               */
  double friction;     /* Coulomb coefficient; default 0.9                                        */
  double stick;        /* m/s; stick velocity of the regularised friction; default 3e-4           */
} kg_contact_params;

KG_API kg_contact_params kg_contact_default_params(void);
/* Finite; layer, stick and floor_share above zero, floor_share below one, the others not negative:
 * what every call here and kg_step ask for. */
KG_API bool kg_contact_params_are_valid(const kg_contact_params *params);

typedef struct kg_contact_force {
  kg_vec3 f;         /* N, on the body, world axes                            */
  double normal;     /* N, >= 0                                               */
  double distance;   /* Phi, m                                                */
  kg_vec3 direction; /* unit normal of the surface                            */
  kg_vec3 velocity;  /* m/s, of the shape there                               */
  const kg_ground *ground; /* of the shape, in the scene; NULL: hard          */
  kg_mat3 df_dx;     /* exact derivatives: position, N/m                      */
  kg_mat3 df_du;     /* velocity, N s/m                                       */
} kg_contact_force;

/* Force on a body point at x that moves at u (m, m/s). False when the point is outside the layer, and
 * *out zero then apart from distance, direction, velocity and ground. Derivatives only when asked
 * for. With several grounds in the scene the shape that would push hardest at rest acts. */
KG_API bool kg_contact_evaluate(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x,
                                kg_vec3 u, bool derivatives, kg_contact_force *out);

enum { KG_CONTACT_PARAM_COUNT = 6 };

/* Gradient of f_bar . f by the six parameters (order of kg_contact_params), of a force inside the
 * layer, as kg_contact_evaluate left it for the velocity u: adds to params_bar[6]. */
KG_API void kg_contact_params_vjp(const kg_contact_params *params, const kg_contact_force *force,
                                  kg_vec3 u, kg_vec3 f_bar, double *params_bar);

#ifdef __cplusplus
}
#endif
#endif
