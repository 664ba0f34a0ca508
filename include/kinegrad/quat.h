/* kinegrad/quat.h - unit quaternions (w first, Hamilton product) and the rotation group SO(3).
 *
 * Rotation vectors are axis times angle, rad. Perturbations are on the right (body side):
 * R exp([d]x), as in docs/theory/dynamics.md: q (+) h v = q * exp(h w), w in body coordinates.
 *
 * [SOLA] J. Sola, J. Deray, D. Atchuthan, A micro Lie theory for state estimation in robotics,
 *        arXiv:1812.01537, 2018: exp (101), log (103), right Jacobian (143). */
#ifndef KINEGRAD_QUAT_H
#define KINEGRAD_QUAT_H

#include "kinegrad/base.h"
#include "kinegrad/vec3.h"

#include <float.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_quat {
  double w, x, y, z;
} kg_quat;

static inline kg_quat kg_quat_make(double w, double x, double y, double z)
{
  kg_quat q;
  q.w = w;
  q.x = x;
  q.y = y;
  q.z = z;
  return q;
}

static inline kg_quat kg_quat_identity(void)
{
  return kg_quat_make(1.0, 0.0, 0.0, 0.0);
}

static inline kg_quat kg_quat_conj(kg_quat q)
{
  return kg_quat_make(q.w, -q.x, -q.y, -q.z);
}

static inline kg_quat kg_quat_mul(kg_quat a, kg_quat b)
{
  return kg_quat_make(a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
                      a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                      a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
                      a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w);
}

static inline double kg_quat_dot(kg_quat a, kg_quat b)
{
  return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z;
}

/* q / |q|; the zero quaternion gives the identity, one whose norm is not a finite number NaN */
static inline kg_quat kg_quat_normalized(kg_quat q)
{
  const double n = sqrt(kg_quat_dot(q, q));
  if (n == 0.0) {
    return kg_quat_identity();
  }
  const double s = n <= DBL_MAX ? 1.0 / n : NAN;
  return kg_quat_make(s * q.w, s * q.x, s * q.y, s * q.z);
}

/* R(q) a */
static inline kg_vec3 kg_quat_rotate(kg_quat q, kg_vec3 a)
{
  const kg_vec3 u = kg_vec3_make(q.x, q.y, q.z);
  const kg_vec3 t = kg_vec3_scale(2.0, kg_vec3_cross(u, a));
  return kg_vec3_add(kg_vec3_add_scaled(a, q.w, t), kg_vec3_cross(u, t));
}

/* Rotation matrix of a unit quaternion: columns are the rotated axes. */
static inline kg_mat3 kg_quat_matrix(kg_quat q)
{
  const double xx = q.x * q.x, yy = q.y * q.y, zz = q.z * q.z;
  const double xy = q.x * q.y, xz = q.x * q.z, yz = q.y * q.z;
  const double wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
  const kg_mat3 R = {{1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy), 2.0 * (xy + wz),
                      1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx), 2.0 * (xz - wy), 2.0 * (yz + wx),
                      1.0 - 2.0 * (xx + yy)}};
  return R;
}

/* Unit quaternion of a rotation matrix, w >= 0. */
KG_API kg_quat kg_quat_from_matrix(kg_mat3 R);

/* exp: rotation vector to unit quaternion. */
KG_API kg_quat kg_quat_exp(kg_vec3 rotation);

/* log: shortest rotation vector of a unit quaternion, |result| <= pi; q and -q give the same. */
KG_API kg_vec3 kg_quat_log(kg_quat q);

/* Smallest rotation that takes direction a to direction b (both non-zero). */
KG_API kg_quat kg_quat_between(kg_vec3 a, kg_vec3 b);

/* Spherical linear interpolation along the shorter arc. */
KG_API kg_quat kg_quat_slerp(kg_quat a, kg_quat b, double t);

/* Right Jacobian Jr(r): exp(r + d) = exp(r) exp(Jr(r) d) + O(d^2)   [SOLA] (143) */
KG_API kg_mat3 kg_so3_right_jacobian(kg_vec3 rotation);

#ifdef __cplusplus
}
#endif
#endif
