/* Signed distance, unit gradient and Hessian of single shapes, in closed form.
 *
 *   x    query point                         c    closest point of the skeleton or surface
 *   r    = |x - c|                           n    = (x - c) / r, unit gradient of |x - c|
 *   Phi  signed distance, m                  H    = d2 Phi / dx2, 1/m
 *
 * The distance to a set whose closest point stays on a fixed feature has
 *   point     H = (I - n n') / r
 *   segment   H = (I - n n' - t t') / r       t = unit direction of the segment
 *   face      H = 0
 * (differentiate n = (x - c(x)) / r, where c(x) moves along the feature only). Adding a radius
 * changes Phi, not n or H. */
#include "kinegrad/sdf.h"

#include "sdf/feature.h"

kg_sdf_value kg_sdf_plane(kg_vec3 point, kg_vec3 normal, kg_vec3 x)
{
  return (kg_sdf_value){kg_vec3_dot(normal, kg_vec3_sub(x, point)), normal, {0.0}};
}

kg_sdf_value kg_sdf_sphere(kg_vec3 center, double radius, kg_vec3 x)
{
  kg_sdf_value out = point_feature(kg_vec3_sub(x, center), kg_vec3_make(0.0, 1.0, 0.0));
  out.distance -= radius;
  return out;
}

kg_sdf_value kg_sdf_capsule(kg_vec3 a, kg_vec3 b, double radius, kg_vec3 x)
{
  const kg_vec3 axis = kg_vec3_sub(b, a);
  const double length2 = kg_vec3_dot(axis, axis);
  const double along = kg_vec3_dot(kg_vec3_sub(x, a), axis);
  kg_sdf_value out;
  if (length2 > 0.0 && along > 0.0 && along < length2) {
    const kg_vec3 t = kg_vec3_scale(1.0 / sqrt(length2), axis);
    const kg_vec3 c = kg_vec3_add_scaled(a, along / length2, axis);
    out = edge_feature(kg_vec3_sub(x, c), t, any_orthogonal(t));
  } else {
    const kg_vec3 end = along > 0.0 ? b : a; /* a ball: a == b, along == 0 */
    const kg_vec3 outward = length2 > 0.0 ? kg_vec3_normalized(axis) : kg_vec3_make(0.0, 1.0, 0.0);
    out = point_feature(kg_vec3_sub(x, end), kg_vec3_scale(along > 0.0 ? 1.0 : -1.0, outward));
  }
  out.distance -= radius;
  return out;
}

/* Box in its own axes, outside: the closest point clamps each coordinate; the clamped coordinates
 * span the feature's normal space. e[i] > 0 is the excess of |x_i| over the half size. */
static kg_sdf_value box_outside(const double e[3], const double sign[3])
{
  const double d[3] = {e[0] > 0.0 ? sign[0] * e[0] : 0.0, e[1] > 0.0 ? sign[1] * e[1] : 0.0,
                       e[2] > 0.0 ? sign[2] * e[2] : 0.0};
  const double r = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  const double n[3] = {d[0] / r, d[1] / r, d[2] / r};
  const int clamped = (e[0] > 0.0) + (e[1] > 0.0) + (e[2] > 0.0);
  kg_sdf_value out = {r, kg_vec3_make(n[0], n[1], n[2]), {0.0}};
  if (clamped > 1) { /* edge or corner; on a face H = 0 */
    for (int i = 0; i < 3; i++) {
      out.hessian[i] = e[i] > 0.0 ? (1.0 - n[i] * n[i]) / r : 0.0;
    }
    out.hessian[3] = -n[0] * n[1] / r;
    out.hessian[4] = -n[0] * n[2] / r;
    out.hessian[5] = -n[1] * n[2] / r;
  }
  return out;
}

kg_sdf_value kg_sdf_box(kg_vec3 center, kg_quat orientation, kg_vec3 half, kg_vec3 x)
{
  const kg_mat3 R = kg_quat_matrix(orientation);
  const kg_vec3 local = kg_mat3_mul_vec_t(R, kg_vec3_sub(x, center));
  const double sign[3] = {copysign(1.0, local.x), copysign(1.0, local.y), copysign(1.0, local.z)};
  const double e[3] = {fabs(local.x) - half.x, fabs(local.y) - half.y, fabs(local.z) - half.z};
  kg_sdf_value out;
  if (e[0] > 0.0 || e[1] > 0.0 || e[2] > 0.0) {
    out = box_outside(e, sign);
  } else { /* inside: the nearest face */
    const int i = e[0] >= e[1] ? (e[0] >= e[2] ? 0 : 2) : (e[1] >= e[2] ? 1 : 2);
    const kg_vec3 n =
      kg_vec3_make(i == 0 ? sign[0] : 0.0, i == 1 ? sign[1] : 0.0, i == 2 ? sign[2] : 0.0);
    out = (kg_sdf_value){e[i], n, {0.0}};
  }
  return rotate_value(R, out);
}
