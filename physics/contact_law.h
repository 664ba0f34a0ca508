/* Inside physics/: the normal law alone, for solvers that look for a force along a line. */
#ifndef PHYSICS_CONTACT_LAW_H
#define PHYSICS_CONTACT_LAW_H

#include "kinegrad/contact.h"

/* Normal force at a distance and a speed of separation, N; its derivatives, N/m and N s/m. */
typedef struct kg_normal_law {
  double force, by_distance, by_speed;
} kg_normal_law;

/* kg_contact_evaluate with friction f_t = -mu bound w in place of -mu f_n w, whose force is then the
 * slope of a convex function of the velocity; bound < 0: the law itself. */
bool kg_contact_evaluate_bounded(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x,
                                 kg_vec3 u, double bound, bool derivatives, kg_contact_force *out);

kg_normal_law kg_contact_normal(const kg_contact_params *params, double distance, double speed);

#endif
