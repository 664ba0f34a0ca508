/* Numbers, 3-vectors and 3x3 matrices of the recursive algorithms, for one kind of number at a time:
 * KG_NUMBER is 1 (double), 8 (eight frames side by side) or 2 (complex, for complex steps in tests).
 *
 * Every array of a call holds KG_NUMBER doubles for each number. Eight frames are taken WIDTH at a
 * time, as many as fit a vector of the instruction set; every lane rounds as a plain double does,
 * because nothing here contracts or reorders. */
#ifndef PHYSICS_KERNELS_NUMBER_H
#define PHYSICS_KERNELS_NUMBER_H

#include <string.h>

#if KG_NUMBER == 1
typedef double real;
enum { WIDTH = 1 };
#elif KG_NUMBER == 2
typedef double _Complex real;
enum { WIDTH = 2 };
#elif KG_NUMBER == 8 && (!defined(__GNUC__) || defined(KG_NO_VECTORS))
typedef double real; /* one frame after the other */
enum { WIDTH = 1 };
#elif KG_NUMBER == 8
#if defined(__AVX512F__)
enum { WIDTH = 8 };
#elif defined(__AVX__)
enum { WIDTH = 4 };
#else
enum { WIDTH = 2 };
#endif
typedef double real __attribute__((vector_size(8 * WIDTH)));
#endif

/* number k of an array */
static inline real load(const double *array, int k)
{
  real r;
  memcpy(&r, array + KG_NUMBER * k, sizeof r);
  return r;
}

static inline void store(double *array, int k, real r)
{
  memcpy(array + KG_NUMBER * k, &r, sizeof r);
}

typedef struct vec3 {
  real x, y, z;
} vec3;

typedef struct mat3 {
  real m[9]; /* row-major */
} mat3;

typedef struct sym3 {
  real xx, yy, zz, xy, xz, yz;
} sym3;

static inline vec3 load3(const double *array, int k)
{
  return (vec3){load(array, k), load(array, k + 1), load(array, k + 2)};
}

static inline void store3(double *array, int k, vec3 a)
{
  store(array, k, a.x);
  store(array, k + 1, a.y);
  store(array, k + 2, a.z);
}

static inline real number(double a)
{
  return a - (real){0};
}

static inline vec3 constant(const double a[3])
{
  return (vec3){number(a[0]), number(a[1]), number(a[2])};
}

static inline vec3 add(vec3 a, vec3 b)
{
  return (vec3){a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline vec3 sub(vec3 a, vec3 b)
{
  return (vec3){a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline vec3 scale(double s, vec3 a)
{
  return (vec3){s * a.x, s * a.y, s * a.z};
}

static inline real dot(vec3 a, vec3 b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline vec3 cross(vec3 a, vec3 b)
{
  return (vec3){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/* M a */
static inline vec3 mul(const mat3 *M, vec3 a)
{
  const real *m = M->m;
  return (vec3){m[0] * a.x + m[1] * a.y + m[2] * a.z, m[3] * a.x + m[4] * a.y + m[5] * a.z,
                m[6] * a.x + m[7] * a.y + m[8] * a.z};
}

/* M' a */
static inline vec3 tmul(const mat3 *M, vec3 a)
{
  const real *m = M->m;
  return (vec3){m[0] * a.x + m[3] * a.y + m[6] * a.z, m[1] * a.x + m[4] * a.y + m[7] * a.z,
                m[2] * a.x + m[5] * a.y + m[8] * a.z};
}

static inline vec3 sym_mul(const sym3 *S, vec3 a)
{
  return (vec3){S->xx * a.x + S->xy * a.y + S->xz * a.z, S->xy * a.x + S->yy * a.y + S->yz * a.z,
                S->xz * a.x + S->yz * a.y + S->zz * a.z};
}

/* inertia of a link, xx yy zz xy xz yz, times a */
static inline vec3 inertia_mul(const double s[6], vec3 a)
{
  return (vec3){s[0] * a.x + s[3] * a.y + s[4] * a.z, s[3] * a.x + s[1] * a.y + s[5] * a.z,
                s[4] * a.x + s[5] * a.y + s[2] * a.z};
}

static inline vec3 cross_constant(const double a[3], vec3 b)
{
  return (vec3){a[1] * b.z - a[2] * b.y, a[2] * b.x - a[0] * b.z, a[0] * b.y - a[1] * b.x};
}

static inline vec3 mul_constant(const mat3 *M, const double a[3])
{
  const real *m = M->m;
  return (vec3){m[0] * a[0] + m[1] * a[1] + m[2] * a[2], m[3] * a[0] + m[4] * a[1] + m[5] * a[2],
                m[6] * a[0] + m[7] * a[1] + m[8] * a[2]};
}

/* s a for a number of each frame */
static inline vec3 times(real s, vec3 a)
{
  return (vec3){s * a.x, s * a.y, s * a.z};
}

static inline vec3 vec3_zero(void)
{
  return (vec3){number(0.0), number(0.0), number(0.0)};
}

/* A B */
static inline mat3 mat_mul(const mat3 *A, const mat3 *B)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    const real *a = A->m + k / 3 * 3, *b = B->m + k % 3;
    C.m[k] = a[0] * b[0] + a[1] * b[3] + a[2] * b[6];
  }
  return C;
}

/* A' B */
static inline mat3 mat_tmul(const mat3 *A, const mat3 *B)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    const real *a = A->m + k / 3, *b = B->m + k % 3;
    C.m[k] = a[0] * b[0] + a[3] * b[3] + a[6] * b[6];
  }
  return C;
}

static inline mat3 mat_add(const mat3 *A, const mat3 *B)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    C.m[k] = A->m[k] + B->m[k];
  }
  return C;
}

static inline mat3 mat_sub(const mat3 *A, const mat3 *B)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    C.m[k] = A->m[k] - B->m[k];
  }
  return C;
}

static inline mat3 mat_times(real s, const mat3 *A)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    C.m[k] = s * A->m[k];
  }
  return C;
}

static inline vec3 negative(vec3 a)
{
  return (vec3){-a.x, -a.y, -a.z};
}

static inline mat3 mat_negative(const mat3 *A)
{
  mat3 C;
  for (int k = 0; k < 9; k++) {
    C.m[k] = -A->m[k];
  }
  return C;
}

static inline mat3 mat_zero(void)
{
  return (mat3){{number(0.0), number(0.0), number(0.0), number(0.0), number(0.0), number(0.0),
                 number(0.0), number(0.0), number(0.0)}};
}

/* [a] B: every column crossed from the left */
static inline mat3 cross_mat(vec3 a, const mat3 *B)
{
  const real *b = B->m;
  return (mat3){{a.y * b[6] - a.z * b[3], a.y * b[7] - a.z * b[4], a.y * b[8] - a.z * b[5],
                 a.z * b[0] - a.x * b[6], a.z * b[1] - a.x * b[7], a.z * b[2] - a.x * b[8],
                 a.x * b[3] - a.y * b[0], a.x * b[4] - a.y * b[1], a.x * b[5] - a.y * b[2]}};
}

/* B [a] */
static inline mat3 mat_cross(const mat3 *B, vec3 a)
{
  const real *b = B->m;
  return (mat3){{b[1] * a.z - b[2] * a.y, b[2] * a.x - b[0] * a.z, b[0] * a.y - b[1] * a.x,
                 b[4] * a.z - b[5] * a.y, b[5] * a.x - b[3] * a.z, b[3] * a.y - b[4] * a.x,
                 b[7] * a.z - b[8] * a.y, b[8] * a.x - b[6] * a.z, b[6] * a.y - b[7] * a.x}};
}

/* S B */
static inline mat3 sym_mat(const sym3 *S, const mat3 *B)
{
  mat3 C;
  for (int j = 0; j < 3; j++) {
    const vec3 c = sym_mul(S, (vec3){B->m[j], B->m[3 + j], B->m[6 + j]});
    C.m[j] = c.x;
    C.m[3 + j] = c.y;
    C.m[6 + j] = c.z;
  }
  return C;
}

static inline sym3 sym_add(const sym3 *a, const sym3 *b)
{
  return (sym3){a->xx + b->xx, a->yy + b->yy, a->zz + b->zz,
                a->xy + b->xy, a->xz + b->xz, a->yz + b->yz};
}

static inline mat3 full(const sym3 *S)
{
  return (mat3){{S->xx, S->xy, S->xz, S->xy, S->yy, S->yz, S->xz, S->yz, S->zz}};
}

/* Block k of an array of 3x3 blocks, or its transpose. */
static inline mat3 load_block(const double *array, int k)
{
  mat3 A;
  for (int e = 0; e < 9; e++) {
    A.m[e] = load(array, 9 * k + e);
  }
  return A;
}

static inline void store_block(double *array, int k, const mat3 *A)
{
  for (int e = 0; e < 9; e++) {
    store(array, 9 * k + e, A->m[e]);
  }
}

static inline void store_transposed(double *array, int k, const mat3 *A)
{
  for (int e = 0; e < 9; e++) {
    store(array, 9 * k + e, A->m[e % 3 * 3 + e / 3]);
  }
}

/* Rotation matrix of the unit quaternion at number k of an array. */
static inline mat3 load_rotation(const double *array, int k)
{
  const real w = load(array, k), x = load(array, k + 1), y = load(array, k + 2),
             z = load(array, k + 3);
  const real x2 = x + x, y2 = y + y, z2 = z + z;
  const real xx = x * x2, yy = y * y2, zz = z * z2, xy = x * y2, xz = x * z2, yz = y * z2;
  const real wx = w * x2, wy = w * y2, wz = w * z2;
  const mat3 R = {{1.0 - (yy + zz), xy - wz, xz + wy, xy + wz, 1.0 - (xx + zz), yz - wx, xz - wy,
                   yz + wx, 1.0 - (xx + yy)}};
  return R;
}

#endif
