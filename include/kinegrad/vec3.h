/* kinegrad/vec3.h - 3-vectors and 3x3 matrices passed and returned by value, so that formulas read
 * as they are written. Matrices are row-major: m[3*row + column]. */
#ifndef KINEGRAD_VEC3_H
#define KINEGRAD_VEC3_H

#include <math.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_vec3 {
  double x, y, z;
} kg_vec3;

typedef struct kg_mat3 {
  double m[9];
} kg_mat3;

static inline kg_vec3 kg_vec3_make(double x, double y, double z)
{
  kg_vec3 a;
  a.x = x;
  a.y = y;
  a.z = z;
  return a;
}

static inline kg_vec3 kg_vec3_add(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(a.x + b.x, a.y + b.y, a.z + b.z);
}

static inline kg_vec3 kg_vec3_sub(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(a.x - b.x, a.y - b.y, a.z - b.z);
}

static inline kg_vec3 kg_vec3_scale(double s, kg_vec3 a)
{
  return kg_vec3_make(s * a.x, s * a.y, s * a.z);
}

/* a + s b */
static inline kg_vec3 kg_vec3_add_scaled(kg_vec3 a, double s, kg_vec3 b)
{
  return kg_vec3_make(a.x + s * b.x, a.y + s * b.y, a.z + s * b.z);
}

static inline double kg_vec3_dot(kg_vec3 a, kg_vec3 b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline kg_vec3 kg_vec3_cross(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

static inline double kg_vec3_norm(kg_vec3 a)
{
  return sqrt(kg_vec3_dot(a, a));
}

/* a / |a|; zero stays zero */
static inline kg_vec3 kg_vec3_normalized(kg_vec3 a)
{
  const double n = kg_vec3_norm(a);
  return n > 0.0 ? kg_vec3_scale(1.0 / n, a) : a;
}

static inline kg_vec3 kg_vec3_lerp(kg_vec3 a, kg_vec3 b, double t)
{
  return kg_vec3_add_scaled(a, t, kg_vec3_sub(b, a));
}

/* M a */
static inline kg_vec3 kg_mat3_mul_vec(kg_mat3 M, kg_vec3 a)
{
  return kg_vec3_make(M.m[0] * a.x + M.m[1] * a.y + M.m[2] * a.z,
                      M.m[3] * a.x + M.m[4] * a.y + M.m[5] * a.z,
                      M.m[6] * a.x + M.m[7] * a.y + M.m[8] * a.z);
}

/* M' a */
static inline kg_vec3 kg_mat3_mul_vec_t(kg_mat3 M, kg_vec3 a)
{
  return kg_vec3_make(M.m[0] * a.x + M.m[3] * a.y + M.m[6] * a.z,
                      M.m[1] * a.x + M.m[4] * a.y + M.m[7] * a.z,
                      M.m[2] * a.x + M.m[5] * a.y + M.m[8] * a.z);
}

/* A B */
static inline kg_mat3 kg_mat3_mul(kg_mat3 A, kg_mat3 B)
{
  kg_mat3 C;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      C.m[3 * i + j] =
        A.m[3 * i] * B.m[j] + A.m[3 * i + 1] * B.m[3 + j] + A.m[3 * i + 2] * B.m[6 + j];
    }
  }
  return C;
}

static inline kg_mat3 kg_mat3_transposed(kg_mat3 A)
{
  const kg_mat3 T = {
    {A.m[0], A.m[3], A.m[6], A.m[1], A.m[4], A.m[7], A.m[2], A.m[5], A.m[8]}};
  return T;
}

static inline kg_mat3 kg_mat3_add(kg_mat3 A, kg_mat3 B)
{
  for (int k = 0; k < 9; k++) {
    A.m[k] += B.m[k];
  }
  return A;
}

static inline kg_mat3 kg_mat3_scale(double s, kg_mat3 A)
{
  for (int k = 0; k < 9; k++) {
    A.m[k] *= s;
  }
  return A;
}

static inline kg_mat3 kg_mat3_identity(void)
{
  const kg_mat3 I = {{1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}};
  return I;
}

/* [a]x with [a]x b = a x b */
static inline kg_mat3 kg_mat3_skew(kg_vec3 a)
{
  const kg_mat3 S = {{0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0}};
  return S;
}

/* a b' */
static inline kg_mat3 kg_mat3_outer(kg_vec3 a, kg_vec3 b)
{
  const kg_mat3 O = {{a.x * b.x, a.x * b.y, a.x * b.z, a.y * b.x, a.y * b.y, a.y * b.z, a.z * b.x,
                      a.z * b.y, a.z * b.z}};
  return O;
}

#ifdef __cplusplus
}
#endif
#endif
