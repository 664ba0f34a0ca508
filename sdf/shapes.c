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

/* ---- ellipsoid ---------------------------------------------------------------------------------
 *
 * In its own axes, semi-axes e_i with e_2 the smallest, for y_i = |x_i| [EBER]: the closest point is
 *   c_i = r_i y_i / (t + r_i - 1),  r_i = (e_i / e_2)^2,
 * t > 0 the largest root of  g(t) = sum (r_i z_i / (t + r_i - 1))^2 = 1,  z_i = y_i / e_i. Then
 *   x - c = (t - 1) e_2^2 grad,  grad_i = c_i / e_i^2,   Phi = (t - 1) e_2^2 |grad|
 * and with the curvatures W = P diag(1 / e^2) P / |grad| at c, P = 1 - n n',
 *   H = W (1 + Phi W)^-1.
 * With t in place of Eberly's t - 1 nothing cancels when x is near the plane of the larger axes.
 * [EBER] D. Eberly, Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid,
 *        Geometric Tools, 2013, section 3. */

enum { ROOT_ITERATIONS = 60 };

/* g(t) - 1 and its slope; where a denominator is zero so is the numerator's z */
static double root_function(const double z[3], const double r[3], double t, double *slope)
{
  double sum = -1.0;
  *slope = 0.0;
  for (int i = 0; i < 3; i++) {
    const double down = t + (r[i] - 1.0);
    const double ratio = z[i] > 0.0 ? r[i] * z[i] / down : 0.0;
    sum += ratio * ratio;
    *slope -= z[i] > 0.0 ? 2.0 * ratio * ratio / down : 0.0;
  }
  return sum;
}

/* The root, 0 when c_2 is not determined by y_2 = 0. g falls and is convex, and the start is left of
 * the root, at most a factor of three above 1: Newton's method rises to it. */
static double largest_root(const double z[3], const double r[3])
{
  double t = 0.0;
  for (int i = 0; i < 3; i++) { /* no term alone exceeds 1 at the root */
    t = fmax(t, r[i] * z[i] - (r[i] - 1.0));
  }
  for (int k = 0; k < ROOT_ITERATIONS; k++) {
    double slope;
    const double g = root_function(z, r, t, &slope);
    if (!(g > 0.0)) break;
    const double next = t - g / slope;
    if (!(next > t)) break;
    t = next;
  }
  return t;
}

/* Closest point c >= 0 of y >= 0; returns t. `low`: the smallest semi-axis */
static double closest_of_ellipsoid(const double e[3], int low, const double y[3], double c[3])
{
  double z[3], r[3], rest = 1.0;
  for (int i = 0; i < 3; i++) {
    z[i] = y[i] / e[i];
    r[i] = i == low ? 1.0 : (e[i] / e[low]) * (e[i] / e[low]);
  }
  const double t = largest_root(z, r);
  for (int i = 0; i < 3; i++) {
    const double down = t + (r[i] - 1.0);
    c[i] = down > 0.0 ? r[i] * y[i] / down : 0.0;
    rest -= i == low ? 0.0 : (c[i] / e[i]) * (c[i] / e[i]);
  }
  if (y[low] == 0.0 && t <= 0.0) c[low] = e[low] * sqrt(fmax(rest, 0.0));
  return t;
}

/* H = T w (1 + Phi w)^-1 T' with T two unit vectors across n and w = T' diag(1 / e^2) T / |grad| */
static void curved_hessian(double hessian[6], kg_vec3 n, kg_vec3 curve, double distance)
{
  const kg_vec3 s = any_orthogonal(n), u = kg_vec3_cross(n, s);
  const kg_vec3 Ds = kg_vec3_make(curve.x * s.x, curve.y * s.y, curve.z * s.z);
  const kg_vec3 Du = kg_vec3_make(curve.x * u.x, curve.y * u.y, curve.z * u.z);
  const double a = kg_vec3_dot(s, Ds), b = kg_vec3_dot(s, Du), d = kg_vec3_dot(u, Du);
  const double w = a * d - b * b;
  const double det = 1.0 + distance * (a + d) + distance * distance * w;
  if (!(det > 1e-12)) return; /* a focal point: the curvature has no bound */
  const double p = (a + distance * w) / det, q = b / det, v = (d + distance * w) / det;
  const kg_vec3 hs = kg_vec3_add_scaled(kg_vec3_scale(p, s), q, u);
  const kg_vec3 hu = kg_vec3_add_scaled(kg_vec3_scale(q, s), v, u);
  hessian[0] = hs.x * s.x + hu.x * u.x;
  hessian[1] = hs.y * s.y + hu.y * u.y;
  hessian[2] = hs.z * s.z + hu.z * u.z;
  hessian[3] = hs.x * s.y + hu.x * u.y;
  hessian[4] = hs.x * s.z + hu.x * u.z;
  hessian[5] = hs.y * s.z + hu.y * u.z;
}

kg_sdf_value kg_sdf_ellipsoid(kg_vec3 center, kg_quat orientation, kg_vec3 semi, kg_vec3 x)
{
  KG_ASSERT(semi.x > 0.0 && semi.y > 0.0 && semi.z > 0.0);
  const kg_mat3 R = kg_quat_matrix(orientation);
  const kg_vec3 local = kg_mat3_mul_vec_t(R, kg_vec3_sub(x, center));
  const double e[3] = {semi.x, semi.y, semi.z};
  const double y[3] = {fabs(local.x), fabs(local.y), fabs(local.z)};
  const int low = e[0] <= e[1] ? (e[0] <= e[2] ? 0 : 2) : (e[1] <= e[2] ? 1 : 2);
  double c[3];
  const double t = closest_of_ellipsoid(e, low, y, c);
  const kg_vec3 grad =
    kg_vec3_make(copysign(c[0] / (e[0] * e[0]), local.x), copysign(c[1] / (e[1] * e[1]), local.y),
                 copysign(c[2] / (e[2] * e[2]), local.z));
  const double size = kg_vec3_norm(grad);
  kg_sdf_value out = {(t - 1.0) * (e[low] * e[low]) * size, kg_vec3_scale(1.0 / size, grad), {0.0}};
  const kg_vec3 curve = kg_vec3_make(1.0 / (e[0] * e[0] * size), 1.0 / (e[1] * e[1] * size),
                                     1.0 / (e[2] * e[2] * size));
  curved_hessian(out.hessian, out.normal, curve, out.distance);
  return rotate_value(R, out);
}

/* ---- cylinder ----------------------------------------------------------------------------------
 *
 * rho, h: distance from the axis, height above the middle; e_r, e_c, t: unit vectors outwards, around
 * and along. What the rest of the plane (rho, h) says is a rectangle's distance; going around the
 * axis turns e_r, which adds (n . e_r) / rho in the direction e_c. */

kg_sdf_value kg_sdf_cylinder(kg_vec3 a, kg_vec3 b, double radius, kg_vec3 x)
{
  const kg_vec3 axis = kg_vec3_sub(b, a), from = kg_vec3_sub(x, kg_vec3_lerp(a, b, 0.5));
  const double length = kg_vec3_norm(axis);
  KG_ASSERT(length > 0.0 && radius > 0.0);
  const kg_vec3 t = kg_vec3_scale(1.0 / length, axis);
  const double h = kg_vec3_dot(from, t);
  const kg_vec3 across = kg_vec3_add_scaled(from, -h, t);
  const double rho = kg_vec3_norm(across);
  const kg_vec3 out_r = rho > FEATURE_TINY ? kg_vec3_scale(1.0 / rho, across) : any_orthogonal(t);
  const kg_vec3 out_h = kg_vec3_scale(copysign(1.0, h), t);
  const double er = rho - radius, eh = fabs(h) - 0.5 * length;
  const bool rim = er > 0.0 && eh > 0.0, side = er >= eh;
  const double r = rim ? hypot(er, eh) : side ? er : eh;
  const double nr = rim ? er / r : side ? 1.0 : 0.0, nh = rim ? eh / r : side ? 0.0 : 1.0;
  kg_sdf_value out = {r, kg_vec3_add_scaled(kg_vec3_scale(nr, out_r), nh, out_h), {0.0}};
  const kg_vec3 around = kg_vec3_cross(out_r, t);
  const kg_vec3 along = kg_vec3_add_scaled(kg_vec3_scale(-nh, out_r), nr, out_h); /* across n */
  const double bend = rho > FEATURE_TINY ? nr / rho : 0.0, turn = rim ? 1.0 / r : 0.0;
  const kg_vec3 ba = kg_vec3_scale(bend, around), tl = kg_vec3_scale(turn, along);
  out.hessian[0] = ba.x * around.x + tl.x * along.x;
  out.hessian[1] = ba.y * around.y + tl.y * along.y;
  out.hessian[2] = ba.z * around.z + tl.z * along.z;
  out.hessian[3] = ba.x * around.y + tl.x * along.y;
  out.hessian[4] = ba.x * around.z + tl.x * along.z;
  out.hessian[5] = ba.y * around.z + tl.y * along.z;
  return out;
}

kg_sdf_value kg_sdf_way_out(kg_sdf_fn *field, void *user, kg_vec3 x, kg_vec3 way, double far)
{
  static const double ENOUGH_M = 1e-9;
  enum { ITERATIONS = 30 };
  kg_sdf_value value;
  double along = far;
  for (int k = 0; k < ITERATIONS; k++) {
    value = field(kg_vec3_add_scaled(x, along, way), user);
    if (!(value.distance > ENOUGH_M) || !(along > 0.0)) break;
    const double slope = kg_vec3_dot(value.normal, way);
    along = fmax(along - (slope > 0.0 ? value.distance / slope : value.distance), 0.0);
  }
  value.distance = along;
  return value;
}
