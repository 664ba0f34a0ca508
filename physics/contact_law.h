/* Inside physics/: the normal law alone, for solvers that look for a force along a line. */
#ifndef PHYSICS_CONTACT_LAW_H
#define PHYSICS_CONTACT_LAW_H

#include "kinegrad/contact.h"

/* What of the scene acts on a point: of all shapes the one that would push hardest at rest, or, where
 * none pushes, the one whose layer is nearest. Between shapes of the same ground that is the nearest. */
typedef struct kg_contact_site {
  kg_sdf_value value;      /* normal: unit                                                   */
  double slope;            /* |grad Phi|, 1 but in the blend of a smooth union               */
  kg_vec3 velocity, spin;  /* of the shape, at the point                                     */
  const kg_ground *ground; /* NULL: hard                                                     */
} kg_contact_site;

kg_contact_site kg_contact_find(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x);
/* Force begins at this Phi. */
double kg_contact_reach(const kg_contact_params *params, const kg_ground *ground);
double kg_contact_friction(const kg_contact_params *params, const kg_ground *ground);

/* Normal force at a distance and a speed of separation, N; its derivatives, N/m and N s/m. */
typedef struct kg_normal_law {
  double force, by_distance, by_speed;
} kg_normal_law;

/* kg_contact_evaluate with friction f_t = -mu bound w in place of -mu f_n w, whose force is then the
 * slope of a convex function of the velocity; bound < 0: the law itself. */
bool kg_contact_evaluate_bounded(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x,
                                 kg_vec3 u, double bound, bool derivatives, kg_contact_force *out);

kg_normal_law kg_contact_normal(const kg_contact_params *params, const kg_ground *ground,
                                double distance, double speed);

#endif
