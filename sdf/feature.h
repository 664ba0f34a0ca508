/* Distance to a point and to a straight edge, and values seen from elsewhere: shared by shapes, meshes
 * and scenes. Internal to sdf/. */
#ifndef KG_SDF_FEATURE_H
#define KG_SDF_FEATURE_H

#include "kinegrad/sdf.h"

/* Below this distance (m) of a point from a feature the direction is rounding noise. */
#define FEATURE_TINY 1e-10

/* Some unit vector across the unit vector a. */
static inline kg_vec3 any_orthogonal(kg_vec3 a)
{
  const kg_vec3 other = fabs(a.x) < 0.6 ? kg_vec3_make(1, 0, 0) : kg_vec3_make(0, 1, 0);
  return kg_vec3_normalized(kg_vec3_cross(a, other));
}

/* hessian = s (I - n n' - t t'); t = 0 for a point */
static inline void feature_hessian(double hessian[6], double s, kg_vec3 n, kg_vec3 t)
{
  hessian[0] = s * (1.0 - n.x * n.x - t.x * t.x);
  hessian[1] = s * (1.0 - n.y * n.y - t.y * t.y);
  hessian[2] = s * (1.0 - n.z * n.z - t.z * t.z);
  hessian[3] = s * (-n.x * n.y - t.x * t.y);
  hessian[4] = s * (-n.x * n.z - t.x * t.z);
  hessian[5] = s * (-n.y * n.z - t.y * t.z);
}

/* d = x - edge, across the edge's unit direction t. `fallback`: normal when x lies on the edge. */
static inline kg_sdf_value edge_feature(kg_vec3 d, kg_vec3 t, kg_vec3 fallback)
{
  const double r = kg_vec3_norm(d);
  if (r < FEATURE_TINY) {
    return (kg_sdf_value){r, fallback, {0.0}};
  }
  kg_sdf_value out = {r, kg_vec3_scale(1.0 / r, d), {0.0}};
  feature_hessian(out.hessian, 1.0 / r, out.normal, t);
  return out;
}

/* d = x - point. */
static inline kg_sdf_value point_feature(kg_vec3 d, kg_vec3 fallback)
{
  return edge_feature(d, kg_vec3_make(0.0, 0.0, 0.0), fallback);
}

/* of -Phi: the same surface from its other side */
static inline kg_sdf_value negated_value(kg_sdf_value v)
{
  v.distance = -v.distance;
  v.normal = kg_vec3_scale(-1.0, v.normal);
  for (int k = 0; k < 6; k++) {
    v.hessian[k] = -v.hessian[k];
  }
  return v;
}

/* value given in axes whose columns are R, expressed in the outer axes: n -> R n, H -> R H R' */
static inline kg_sdf_value rotate_value(kg_mat3 R, kg_sdf_value value)
{
  const double *h = value.hessian;
  const kg_mat3 H = {{h[0], h[3], h[4], h[3], h[1], h[5], h[4], h[5], h[2]}};
  const kg_mat3 K = kg_mat3_mul(kg_mat3_mul(R, H), kg_mat3_transposed(R));
  return (kg_sdf_value){value.distance,
                        kg_mat3_mul_vec(R, value.normal),
                        {K.m[0], K.m[4], K.m[8], K.m[1], K.m[2], K.m[5]}};
}

#endif
