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

/* The one plane, hard and at rest, that is all of the scene, or NULL. */
static inline const kg_sdf_shape *kg_only_plane(const kg_scene *scene)
{
  const kg_sdf_shape *shape = &scene->shapes[0];
  const bool is_plane = scene->shape_count == 1 && shape->kind == KG_SHAPE_PLANE;
  return is_plane && shape->place == 0 && shape->ground == 0 && shape->offset == 0.0 ? shape : NULL;
}

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
bool kg_contact_evaluate_at(const kg_contact_params *params, const kg_contact_site *site, kg_vec3 u,
                            double bound, bool derivatives, kg_contact_force *out);
static inline bool kg_contact_evaluate_bounded(const kg_contact_params *params,
                                               const kg_scene *scene, kg_vec3 x, kg_vec3 u,
                                               double bound, bool derivatives,
                                               kg_contact_force *out)
{
  const kg_contact_site site = kg_contact_find(params, scene, x);
  return kg_contact_evaluate_at(params, &site, u, bound, derivatives, out);
}

/* ---- the law without branches, for one point or for many side by side ---------------------------*/

/* The ramp is smoothed where its argument is between -KG_RAMP and KG_RAMP; at rest it is 1. */
#define KG_RAMP 0.1

typedef struct kg_curve {
  double y, slope;
} kg_curve;

/* (1), (2) force of a point at rest and its derivative by Phi < layer */
static inline kg_curve kg_elastic_at(const kg_contact_params *p, double phi)
{
  const double floor = p->floor_share * p->layer;
  const double at = phi > floor ? phi : floor;
  const double d = p->layer - at;
  const double unit = p->force / p->layer;
  const double y = unit * d * d / at, slope = -unit * d * (d + 2.0 * at) / (at * at);
  return (kg_curve){y + slope * (phi - at), slope}; /* the tangent at the floor, below it */
}

/* (3) max(u, 0), rounded with a parabola between -KG_RAMP and KG_RAMP */
static inline kg_curve kg_ramp_at(double u)
{
  const double s = u + KG_RAMP, low = u > -KG_RAMP ? s * s / (4.0 * KG_RAMP) : 0.0;
  const double low_slope = u > -KG_RAMP ? s / (2.0 * KG_RAMP) : 0.0;
  return (kg_curve){u >= KG_RAMP ? u : low, u >= KG_RAMP ? 1.0 : low_slope};
}

/* (1a) force of the soft layer of the ground and its derivative by Phi < layer + thickness */
static inline kg_curve kg_soft_at(const kg_contact_params *p, double thickness, double stiffness,
                                  double phi)
{
  const double depth = thickness + p->layer - phi, unit = stiffness / p->layer;
  const bool deep = depth >= p->layer;
  return (kg_curve){deep ? stiffness * (depth - 0.5 * p->layer) : 0.5 * unit * depth * depth,
                    deep ? -stiffness : -unit * depth};
}

/* damping: of the soft layer, which a hard ground has none of: thickness and stiffness 0 */
static inline kg_normal_law kg_normal_at(const kg_contact_params *p, double thickness,
                                         double stiffness, double damping, double distance,
                                         double speed)
{
  const kg_curve N = kg_elastic_at(p, distance), r = kg_ramp_at(1.0 - p->damping * speed);
  const kg_curve S = kg_soft_at(p, thickness, stiffness, distance);
  const kg_curve q = kg_ramp_at(1.0 - damping * speed);
  const double hard = distance < p->layer ? 1.0 : 0.0;
  const double soft = distance < p->layer + thickness ? 1.0 : 0.0;
  const double push = distance < p->layer ? N.y * r.y : 0.0; /* far away N.y may be infinite */
  return (kg_normal_law){push + soft * S.y * q.y, hard * N.slope * r.y + soft * S.slope * q.y,
                         hard * -p->damping * N.y * r.slope - soft * damping * S.y * q.slope};
}

/* (5) w(u_t) = g(|u_t| / stick) u_t / |u_t| = factor u_t and its derivative factor 1 - bend u_t u_t' */
typedef struct kg_slip {
  double factor, bend;
} kg_slip;

static inline kg_slip kg_slip_at(const kg_contact_params *p, kg_vec3 u_t)
{
  const double speed = sqrt(kg_vec3_dot(u_t, u_t));
  const bool slides = speed >= p->stick;
  const double inverse = 1.0 / (slides ? speed : p->stick), square = inverse * inverse;
  const double held = speed > 0.0 ? square / speed : 0.0;
  return (kg_slip){(slides ? 1.0 : 2.0 - speed * inverse) * inverse,
                   slides ? square * inverse : held};
}

static inline kg_normal_law kg_contact_normal(const kg_contact_params *params,
                                              const kg_ground *ground, double distance,
                                              double speed)
{
  return ground ? kg_normal_at(params, ground->thickness, ground->stiffness, ground->damping,
                               distance, speed)
                : kg_normal_at(params, 0.0, 0.0, 0.0, distance, speed);
}

#endif
