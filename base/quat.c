/* Quaternion functions that are too long to inline: conversions, exp, log, slerp, right Jacobian. */
#include "kinegrad/quat.h"

#include "base/rotation_series.h"

/* Largest of the four squared components first, so that the division is never by a small number. */
kg_quat kg_quat_from_matrix(kg_mat3 R)
{
  const double *m = R.m;
  const double trace = m[0] + m[4] + m[8];
  kg_quat q;
  if (trace > 0.0) {
    const double s = 2.0 * sqrt(1.0 + trace);
    q = kg_quat_make(0.25 * s, (m[7] - m[5]) / s, (m[2] - m[6]) / s, (m[3] - m[1]) / s);
  } else if (m[0] > m[4] && m[0] > m[8]) {
    const double s = 2.0 * sqrt(1.0 + m[0] - m[4] - m[8]);
    q = kg_quat_make((m[7] - m[5]) / s, 0.25 * s, (m[1] + m[3]) / s, (m[2] + m[6]) / s);
  } else if (m[4] > m[8]) {
    const double s = 2.0 * sqrt(1.0 + m[4] - m[0] - m[8]);
    q = kg_quat_make((m[2] - m[6]) / s, (m[1] + m[3]) / s, 0.25 * s, (m[5] + m[7]) / s);
  } else {
    const double s = 2.0 * sqrt(1.0 + m[8] - m[0] - m[4]);
    q = kg_quat_make((m[3] - m[1]) / s, (m[2] + m[6]) / s, (m[5] + m[7]) / s, 0.25 * s);
  }
  if (q.w < 0.0) {
    q = kg_quat_make(-q.w, -q.x, -q.y, -q.z);
  }
  return kg_quat_normalized(q);
}

kg_quat kg_quat_exp(kg_vec3 r)
{
  const double angle2 = kg_vec3_dot(r, r);
  double c, s;        /* cos(angle / 2), sin(angle / 2) / angle */
  if (angle2 < 1.0) { /* the next terms are (angle / 2)^16 / 16! and / 17!, below 1e-18 */
    c = kg_series(kg_series_even, 8, 0.25 * angle2);
    s = 0.5 * kg_series(kg_series_odd, 8, 0.25 * angle2);
  } else {
    const double angle = sqrt(angle2);
    c = cos(0.5 * angle);
    s = sin(0.5 * angle) / angle;
  }
  return kg_quat_make(c, s * r.x, s * r.y, s * r.z);
}

kg_vec3 kg_quat_log(kg_quat q)
{
  if (q.w < 0.0) {
    q = kg_quat_make(-q.w, -q.x, -q.y, -q.z);
  }
  const kg_vec3 u = kg_vec3_make(q.x, q.y, q.z);
  const double s = kg_vec3_norm(u); /* sin(angle / 2) */
  /* angle / s: below 1e-4, 2/w (1 - (s/w)^2 / 3) errs by 2/5 (s/w)^4 < 1e-16 */
  const double k =
    s < 1e-4 ? 2.0 / q.w * (1.0 - s * s / (3.0 * q.w * q.w)) : 2.0 * atan2(s, q.w) / s;
  return kg_vec3_scale(k, u);
}

kg_quat kg_quat_between(kg_vec3 a, kg_vec3 b)
{
  a = kg_vec3_normalized(a);
  b = kg_vec3_normalized(b);
  const double c = kg_vec3_dot(a, b);
  if (c < -1.0 + 1e-12) { /* opposite: half a turn about any axis across a */
    const kg_vec3 other = fabs(a.x) < 0.6 ? kg_vec3_make(1, 0, 0) : kg_vec3_make(0, 1, 0);
    const kg_vec3 axis = kg_vec3_normalized(kg_vec3_cross(a, other));
    return kg_quat_make(0.0, axis.x, axis.y, axis.z);
  }
  const kg_vec3 axis = kg_vec3_cross(a, b);
  return kg_quat_normalized(kg_quat_make(1.0 + c, axis.x, axis.y, axis.z));
}

kg_quat kg_quat_slerp(kg_quat a, kg_quat b, double t)
{
  const kg_vec3 r = kg_quat_log(kg_quat_mul(kg_quat_conj(a), b));
  return kg_quat_mul(a, kg_quat_exp(kg_vec3_scale(t, r)));
}

/* Jr = I - (1 - cos a) / a^2 [r]x + (a - sin a) / a^3 [r]x^2,  a = |r| */
kg_mat3 kg_so3_right_jacobian(kg_vec3 r)
{
  const double a2 = kg_vec3_dot(r, r);
  double b, c;
  if (a2 < 0.25) { /* the next terms are a^14 / 16! and a^14 / 17!, below 3e-18 */
    b = kg_series(kg_series_even + 1, 7, a2);
    c = kg_series(kg_series_odd + 1, 7, a2);
  } else {
    const double a = sqrt(a2);
    const double h = sin(0.5 * a);
    b = 2.0 * h * h / a2;
    c = (a - sin(a)) / (a2 * a);
  }
  /* 1 - b [r] + c (r r' - r.r 1), number by number: this is called for every joint of every step */
  const double xx = c * r.x * r.x, yy = c * r.y * r.y, zz = c * r.z * r.z;
  const double xy = c * r.x * r.y, xz = c * r.x * r.z, yz = c * r.y * r.z;
  const kg_mat3 Jr = {{1.0 - (yy + zz), xy + b * r.z, xz - b * r.y, xy - b * r.z, 1.0 - (xx + zz),
                       yz + b * r.x, xz + b * r.y, yz - b * r.x, 1.0 - (xx + yy)}};
  return Jr;
}
