/* Residuals of a hand's pose, ADBench's HAND: a skinned mesh on a tree of bones, in straight loops
 * over `number`, which the including file defines (double, double complex).
 *
 *   world_b = world_parent base_b R(angles of b),  skin_b = world_b inverse_b   (4 x 4)
 *   v = R(global) sum_b weight_b skin_b (point, 1) + translation
 *   residual = target - v of its vertex; complicated: of the point (s, t, 1 - s - t) of its triangle */
#include <tgmath.h>

#include "bench/autodiff/problems.h"

/* C = A B, 4 x 4 */
static inline void product(number *restrict c, const number *restrict a, const number *restrict b)
{
  for (int i = 0; i < 4; i++) {
    for (int j = 0; j < 4; j++) {
      number sum = 0.0;
      for (int k = 0; k < 4; k++) {
        sum += a[4 * i + k] * b[4 * k + j];
      }
      c[4 * i + j] = sum;
    }
  }
}

static inline void product_by(number *restrict c, const number *restrict a,
                              const double *restrict constant)
{
  number b[16];
  for (int i = 0; i < 16; i++) {
    b[i] = constant[i];
  }
  product(c, a, b);
}

/* rotation about x, then about y */
static inline void turn(number *restrict R, number x, number y)
{
  const number cx = cos(x), sx = sin(x), cy = cos(y), sy = sin(y);
  const number rows[16] = {cy,  sx * sy, cx * sy, 0, 0, cx, -sx, 0,
                           -sy, sx * cy, cx * cy, 0, 0, 0,  0,   1};
  for (int i = 0; i < 16; i++) {
    R[i] = rows[i];
  }
}

/* world (16 a bone) and skin (12 a bone) */
static inline void pose_bones(const kg_bench_hand *hand, const number *theta, number *world,
                              number *skin)
{
  for (int b = 0; b < hand->bones; b++) {
    const int *angle = hand->angle + 2 * b, parent = hand->parent[b];
    number R[16], base[16], relative[16], whole[16];
    turn(R, angle[0] < 0 ? 0.0 : theta[angle[0]], angle[1] < 0 ? 0.0 : theta[angle[1]]);
    for (int i = 0; i < 16; i++) {
      base[i] = hand->base[16 * b + i];
    }
    product(relative, base, R);
    if (parent < 0) {
      for (int i = 0; i < 16; i++) {
        world[16 * b + i] = relative[i];
      }
    } else {
      product(world + 16 * b, world + 16 * parent, relative);
    }
    product_by(whole, world + 16 * b, hand->inverse + 16 * b);
    for (int i = 0; i < 12; i++) {
      skin[12 * b + i] = whole[i];
    }
  }
}

/* v (3, n) += weight_b skin_b point */
static inline void add_bone(size_t n, const double *restrict points, const double *restrict weight,
                            const number *restrict skin, number *restrict v)
{
  for (size_t i = 0; i < 3; i++) {
    const number *row = skin + 4 * i;
    for (size_t p = 0; p < n; p++) {
      v[i * n + p] += weight[p] * (row[0] * points[p] + row[1] * points[n + p] +
                                   row[2] * points[2 * n + p] + row[3]);
    }
  }
}

/* v (3, n): turned by the rotation vector r, moved */
static inline void move_all(size_t n, const number *restrict r, const number *restrict move,
                            number *restrict v)
{
  const number a = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]), s = sin(a) / a;
  const number c = cos(a), d = (1.0 - c) / (a * a);
  for (size_t p = 0; p < n; p++) {
    const number x = v[p], y = v[n + p], z = v[2 * n + p];
    const number along = d * (r[0] * x + r[1] * y + r[2] * z);
    v[p] = c * x + s * (r[1] * z - r[2] * y) + r[0] * along + move[0];
    v[n + p] = c * y + s * (r[2] * x - r[0] * z) + r[1] * along + move[1];
    v[2 * n + p] = c * z + s * (r[0] * y - r[1] * x) + r[2] * along + move[2];
  }
}

/* theta: pose, and where `complicated` s and t of every correspondence. residual: (correspondences, 3).
 * work: 28 numbers a bone, 3 a vertex */
static inline void hand_residuals(const kg_bench_hand *hand, const number *theta, number *residual,
                                  number *work)
{
  const size_t n = (size_t)hand->vertices, bones = (size_t)hand->bones;
  number *skin = work + 16 * bones, *v = skin + 12 * bones;
  pose_bones(hand, theta, work, skin);
  for (size_t i = 0; i < 3 * n; i++) {
    v[i] = 0.0;
  }
  for (size_t b = 0; b < bones; b++) {
    add_bone(n, hand->points, hand->weight + b * n, skin + 12 * b, v);
  }
  move_all(n, theta, theta + 3, v);
  for (int k = 0; k < hand->correspondences; k++) {
    const int32_t *corner = hand->corner + 3 * k;
    const number *s = theta + KG_BENCH_HAND_POSE + 2 * k;
    for (int i = 0; i < 3; i++) {
      const number *row = v + (size_t)i * n;
      const number at = hand->complicated ? s[0] * row[corner[0]] + s[1] * row[corner[1]] +
                                              (1.0 - s[0] - s[1]) * row[corner[2]]
                                          : row[corner[0]];
      residual[3 * k + i] = hand->target[3 * k + i] - at;
    }
  }
}
