/* Channel values of one joint to and from a rotation.
 *
 * A joint's rotation is the product, left to right, of rotations about coordinate axes in the
 * order of its channels (Biovision's definition of BVH).
 *
 * Three channels about axes a, b, c, all different: R = Ra(alpha) Rb(beta) Rc(gamma), and with
 * e = +1 for a cyclic order, -1 otherwise,
 *   R_ac = e sin(beta)   R_ab = -e cos(beta) sin(gamma)   R_aa = cos(beta) cos(gamma)
 *   R_bc = -e sin(alpha) cos(beta)                        R_cc = cos(alpha) cos(beta).
 * (alpha + pi, pi - beta, gamma + pi) is the same rotation; the one nearer to the reference is
 * taken. At cos(beta) = 0 only alpha +- gamma is determined and alpha stays at the reference.
 *
 * Two channels: |<q, qa(alpha) qb(beta)>| = |u' M v| with u = (cos alpha/2, sin alpha/2),
 * v = (cos beta/2, sin beta/2) and M = [q.1 q.b; q.a q.(ab)]. It is largest, and the rotation
 * nearest, at M's first pair of singular vectors. One channel: the twist about its axis. */
#include "mocap/mocap.h"

#include <math.h>
#include <string.h>

static const double pi = 3.14159265358979323846;
static const double degree = 0.017453292519943295769;

/* Below this cos(beta) alpha is kept: its own error would be 1e-16 / cos(beta), and leaving it alone
 * costs an angle error of cos(beta) at most. */
static const double gimbal_lock = 1e-11;

/* Channel values of changed rotations are multiples of 1e-9 degrees: exact in the written file. */
static const double grain_per_degree = 1e9;

static kg_quat axis_quat(int axis, double angle)
{
  const double s = sin(0.5 * angle);
  return kg_quat_make(cos(0.5 * angle), axis == 0 ? s : 0.0, axis == 1 ? s : 0.0,
                      axis == 2 ? s : 0.0);
}

/* indices in channels[] of the rotation channels; returns how many */
static int rotation_channels(const kg_joint *joint, int index[6])
{
  int n = 0;
  for (int k = 0; k < joint->channel_count; k++) {
    if (joint->channels[k] >= KG_CHANNEL_X_ROTATION) {
      index[n++] = k;
    }
  }
  return n;
}

static int axis_of(const kg_joint *joint, int channel)
{
  return (int)joint->channels[channel] - (int)KG_CHANNEL_X_ROTATION;
}

kg_quat kg_euler_to_quat(const kg_joint *joint, const double *values)
{
  kg_quat q = kg_quat_identity();
  for (int k = 0; k < joint->channel_count; k++) {
    if (joint->channels[k] >= KG_CHANNEL_X_ROTATION && values[k] != 0.0) {
      /* fmod is exact: thousands of turns lose nothing */
      q = kg_quat_mul(q, axis_quat(axis_of(joint, k), degree * fmod(values[k], 720.0)));
    }
  }
  return kg_quat_normalized(q);
}

/* angle + whole turns, nearest to the reference */
static double near_to(double angle, double reference)
{
  return angle + 2.0 * pi * nearbyint((reference - angle) / (2.0 * pi));
}

static void three_angles(const int axis[3], kg_quat q, const double reference[3], double angle[3])
{
  const int a = axis[0], b = axis[1], c = axis[2];
  const double e = (a + 1) % 3 == b ? 1.0 : -1.0;
  const kg_mat3 M = kg_quat_matrix(q);
  const double cos_beta = hypot(M.m[3 * a + a], M.m[3 * a + b]);
  const double beta = atan2(e * M.m[3 * a + c], cos_beta);
  const double alpha =
    cos_beta > gimbal_lock ? atan2(-e * M.m[3 * b + c], M.m[3 * c + c]) : reference[0];
  double best = INFINITY;
  for (int other = 0; other < 2; other++) {
    const double x = near_to(other ? alpha + pi : alpha, reference[0]);
    const double y = near_to(other ? pi - beta : beta, reference[1]);
    /* gamma from what is left, so that the three always make up q, however near to the lock */
    const kg_quat left =
      kg_quat_mul(kg_quat_conj(kg_quat_mul(axis_quat(a, x), axis_quat(b, y))), q);
    const double part[3] = {left.x, left.y, left.z};
    const double z = near_to(2.0 * atan2(part[c], left.w), reference[2]);
    const double dx = x - reference[0], dy = y - reference[1], dz = z - reference[2];
    const double far = dx * dx + dy * dy + dz * dz;
    if (far < best && (other == 0 || cos_beta > gimbal_lock)) {
      best = far;
      angle[0] = x;
      angle[1] = y;
      angle[2] = z;
    }
  }
}

static void two_angles(const int axis[2], kg_quat q, const double reference[2], double angle[2])
{
  const kg_quat qa = axis_quat(axis[0], pi), qb = axis_quat(axis[1], pi);
  const double m00 = q.w, m01 = kg_quat_dot(q, qb);
  const double m10 = kg_quat_dot(q, qa), m11 = kg_quat_dot(q, kg_quat_mul(qa, qb));
  /* singular vectors of 2x2: the sum and the difference of the two half angles */
  const double sum = atan2(m01 + m10, m00 - m11), difference = atan2(m10 - m01, m00 + m11);
  const double alpha = sum + difference, beta = sum - difference; /* 2 * half angles */
  /* (alpha + 2 pi, beta + 2 pi) is the same rotation, and so is each alone */
  angle[0] = near_to(alpha, reference[0]);
  angle[1] = near_to(beta, reference[1]);
}

static void one_angle(int axis, kg_quat q, double reference, double *angle)
{
  const double part[3] = {q.x, q.y, q.z};
  *angle = near_to(2.0 * atan2(part[axis], q.w), reference);
}

static double rounded_degrees(double angle)
{
  const double x = angle / degree;
  return fabs(x) < 1e6 ? nearbyint(x * grain_per_degree) / grain_per_degree + 0.0 : x;
}

/* the values as they are, when they mean q and are next to the reference */
static bool already_there(int n, const int *index, const kg_joint *joint, kg_quat q,
                          const double *reference, const double *values)
{
  for (int k = 0; k < n; k++) {
    if (fabs(values[index[k]] - reference[index[k]]) > 180.0) {
      return false;
    }
  }
  const kg_quat now = kg_euler_to_quat(joint, values);
  return kg_vec3_norm(kg_quat_log(kg_quat_mul(kg_quat_conj(now), q))) < 1e-12;
}

kg_quat kg_euler_from_quat(const kg_joint *joint, kg_quat q, const double *reference,
                           double *values)
{
  int index[6], axis[3];
  double from[3], to[3];
  const int n = rotation_channels(joint, index);
  KG_ASSERT(n <= 3);
  if (already_there(n, index, joint, q, reference, values)) {
    return q;
  }
  for (int k = 0; k < n; k++) {
    axis[k] = axis_of(joint, index[k]);
    from[k] = reference[index[k]] * degree;
  }
  if (n == 3) {
    three_angles(axis, q, from, to);
  } else if (n == 2) {
    two_angles(axis, q, from, to);
  } else if (n == 1) {
    one_angle(axis[0], q, from[0], to);
  }
  for (int k = 0; k < n; k++) {
    values[index[k]] = rounded_degrees(to[k]);
  }
  return n == 3 ? q : kg_euler_to_quat(joint, values);
}
