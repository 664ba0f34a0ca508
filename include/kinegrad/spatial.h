/* kinegrad/spatial.h - spatial (6-D) vectors: motions, forces, rigid-body inertia.
 *
 * Angular part first, as in [RBDA] R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008.
 * All quantities of one formula share one frame: axes of the world, origin at one fixed point O.
 * A motion is (angular velocity, linear velocity of the body-fixed point now at O); a force is
 * (moment about O, force). */
#ifndef KINEGRAD_SPATIAL_H
#define KINEGRAD_SPATIAL_H

#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_motion {
  kg_vec3 w; /* rad/s (or rad/s^2) */
  kg_vec3 v; /* m/s   (or m/s^2)   */
} kg_motion;

typedef struct kg_force {
  kg_vec3 n; /* N m, about O */
  kg_vec3 f; /* N            */
} kg_force;

/* Rigid-body inertia about O: mass, h = mass * centre of mass, I = rotational inertia about O,
 * symmetric: xx yy zz xy xz yz. */
typedef struct kg_inertia {
  double mass;
  kg_vec3 h;
  double I[6];
} kg_inertia;

static inline kg_motion kg_motion_add(kg_motion a, kg_motion b)
{
  const kg_motion c = {kg_vec3_add(a.w, b.w), kg_vec3_add(a.v, b.v)};
  return c;
}

static inline kg_motion kg_motion_sub(kg_motion a, kg_motion b)
{
  const kg_motion c = {kg_vec3_sub(a.w, b.w), kg_vec3_sub(a.v, b.v)};
  return c;
}

static inline kg_motion kg_motion_scale(double s, kg_motion a)
{
  const kg_motion c = {kg_vec3_scale(s, a.w), kg_vec3_scale(s, a.v)};
  return c;
}

static inline kg_force kg_force_add(kg_force a, kg_force b)
{
  const kg_force c = {kg_vec3_add(a.n, b.n), kg_vec3_add(a.f, b.f)};
  return c;
}

static inline kg_force kg_force_sub(kg_force a, kg_force b)
{
  const kg_force c = {kg_vec3_sub(a.n, b.n), kg_vec3_sub(a.f, b.f)};
  return c;
}

/* m x a   [RBDA] (2.31) */
static inline kg_motion kg_motion_cross(kg_motion m, kg_motion a)
{
  const kg_motion c = {kg_vec3_cross(m.w, a.w),
                       kg_vec3_add(kg_vec3_cross(m.w, a.v), kg_vec3_cross(m.v, a.w))};
  return c;
}

/* m x* f   [RBDA] (2.32) */
static inline kg_force kg_motion_cross_force(kg_motion m, kg_force f)
{
  const kg_force c = {kg_vec3_add(kg_vec3_cross(m.w, f.n), kg_vec3_cross(m.v, f.f)),
                      kg_vec3_cross(m.w, f.f)};
  return c;
}

/* power of a force on a motion */
static inline double kg_motion_dot(kg_motion m, kg_force f)
{
  return kg_vec3_dot(m.w, f.n) + kg_vec3_dot(m.v, f.f);
}

static inline kg_vec3 kg_inertia_rotational(const kg_inertia *J, kg_vec3 w)
{
  return kg_vec3_make(J->I[0] * w.x + J->I[3] * w.y + J->I[4] * w.z,
                      J->I[3] * w.x + J->I[1] * w.y + J->I[5] * w.z,
                      J->I[4] * w.x + J->I[5] * w.y + J->I[2] * w.z);
}

/* I m = (I w + h x v, mass v - h x w)   [RBDA] (2.63) */
static inline kg_force kg_inertia_mul(const kg_inertia *J, kg_motion m)
{
  const kg_force f = {kg_vec3_add(kg_inertia_rotational(J, m.w), kg_vec3_cross(J->h, m.v)),
                      kg_vec3_sub(kg_vec3_scale(J->mass, m.v), kg_vec3_cross(J->h, m.w))};
  return f;
}

static inline void kg_inertia_add(kg_inertia *A, const kg_inertia *B)
{
  A->mass += B->mass;
  A->h = kg_vec3_add(A->h, B->h);
  for (int k = 0; k < 6; k++) {
    A->I[k] += B->I[k];
  }
}

#ifdef __cplusplus
}
#endif
#endif
