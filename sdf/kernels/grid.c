/* Interpolation and the search for nearest triangles.
 *
 * The interpolant on a cell is the tensor product of cubic Hermite polynomials whose mixed
 * derivatives are zero at the nodes: with t = (x - x_0) / h in [0, 1] and, along each axis,
 *
 *   A_0 = (1 + 2t)(1 - t)^2    A_1 = t^2 (3 - 2t)      weights of values
 *   a_0 = h t (1 - t)^2        a_1 = -h t^2 (1 - t)    weights of slopes
 *
 *   f = sum over the eight nodes of  v ABC + g_x aBC + g_y AbC + g_z ABc
 *
 * (B, b along y, C, c along z). Neighbouring cells share values and slopes on their common face: f is
 * C1. A node's four numbers lie together, and so do the nodes at both ends of an edge along x. */
#include "sdf/kernels/grid.h"

#include <math.h>
#include <string.h>

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#define KG_PASTE_(a, b) a##b
#define KG_PASTE(a, b) KG_PASTE_(a, b)

/* ---- interpolation ----------------------------------------------------------------------------- */

typedef float v4 __attribute__((vector_size(16)));
typedef float v8 __attribute__((vector_size(32)));
typedef float v16 __attribute__((vector_size(64)));

enum { AHEAD = 16 };

typedef struct place {
  size_t node; /* the cell's first */
  v4 t;        /* in it; lane 3: 0 */
} place;

/* Cells by which rounding may carry a point of the box's face outside: grid_is_fine sees to it. */
#define FACE 1e-6

/* cell and position in it along one axis; false: outside, or not a number */
static inline bool locate(double offset, double inverse, int n, int *cell, float *t)
{
  const double at = offset * inverse;
  if (!(at >= -FACE && at <= n - 1 + FACE)) return false;
  const int i = (int)at;
  *cell = i < n - 1 ? i : n - 2;
  *t = (float)(at - *cell);
  return true;
}

/* false: not in a block with nodes */
static inline bool find_place(const grid_view *g, double inverse, kg_vec3 x, place *out)
{
  int i, j, k;
  float t[3];
  if (!locate(x.x - g->lo.x, inverse, g->n[0], &i, &t[0]) ||
      !locate(x.y - g->lo.y, inverse, g->n[1], &j, &t[1]) ||
      !locate(x.z - g->lo.z, inverse, g->n[2], &k, &t[2])) {
    return false;
  }
  const int mask = GRID_SIDE - 1; /* no index is negative, which / and % would allow for */
  const int block = g->block[grid_block_at(g, i >> GRID_SHIFT, j >> GRID_SHIFT, k >> GRID_SHIFT)];
  if (block < 0) return false;
  out->node = grid_node_at(block, i & mask, j & mask, k & mask);
  out->t = (v4){t[0], t[1], t[2], 0.0f};
  return true;
}

static inline v8 load8(const float *p)
{
  v8 out;
  memcpy(&out, p, sizeof out);
  return out;
}

/* sums of the four lanes of each */
static inline v4 sums(v4 a, v4 b, v4 c, v4 d)
{
  const v4 ab =
    __builtin_shufflevector(a, b, 0, 4, 1, 5) + __builtin_shufflevector(a, b, 2, 6, 3, 7);
  const v4 cd =
    __builtin_shufflevector(c, d, 0, 4, 1, 5) + __builtin_shufflevector(c, d, 2, 6, 3, 7);
  return __builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
}

enum { ROW = 4 * GRID_ROW, SLICE = 4 * GRID_SLICE }; /* floats */

/* What depends on the spacing only. */
typedef struct constants {
  float h, inverse; /* m, 1/m */
} constants;

/* weights of a node's value and gradient for one end of an axis: V but s at the axis' own slope */
#define ALONG_X(V, s) __builtin_shufflevector(V, s, 0, 4, 0, 0)
#define ALONG_Y(V, s) __builtin_shufflevector(V, s, 1, 1, 5, 1)
#define ALONG_Z(V, s) __builtin_shufflevector(V, s, 2, 2, 2, 6)

static inline v8 pair(v4 low, v4 high)
{
  return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
}

static inline v8 twice(v4 a)
{
  return pair(a, a);
}

static inline v4 folded(v8 a)
{
  return __builtin_shufflevector(a, a, 0, 1, 2, 3) + __builtin_shufflevector(a, a, 4, 5, 6, 7);
}

/* value and gradient */
static inline v4 interpolate_one(const grid_view *g, const place *p, const constants *c)
{
  const float *at = g->node + 4 * p->node;
  const v8 r00 = load8(at), r10 = load8(at + ROW); /* y, z: 0 or 1 */
  const v8 r01 = load8(at + SLICE), r11 = load8(at + SLICE + ROW);

  const v4 t = p->t, s = 1.0f - t, ss = s * s, tt = t * t, ts = t * s;
  const v4 A0 = (1.0f + 2.0f * t) * ss, A1 = (3.0f - 2.0f * t) * tt;
  const v4 a0 = c->h * t * ss, a1 = -c->h * s * tt;
  const v4 dA1 = 6.0f * c->inverse * ts, dA0 = -dA1;
  const v4 da0 = ss - 2.0f * ts, da1 = tt - 2.0f * ts;

  const v8 Z0 = twice(ALONG_Z(A0, a0)), Z1 = twice(ALONG_Z(A1, a1));
  const v8 dZ0 = twice(ALONG_Z(dA0, da0)), dZ1 = twice(ALONG_Z(dA1, da1));
  const v8 f0 = r00 * Z0 + r01 * Z1, f1 = r10 * Z0 + r11 * Z1;
  const v8 z0 = r00 * dZ0 + r01 * dZ1, z1 = r10 * dZ0 + r11 * dZ1;

  const v8 Y0 = twice(ALONG_Y(A0, a0)), Y1 = twice(ALONG_Y(A1, a1));
  const v8 f = f0 * Y0 + f1 * Y1, fz = z0 * Y0 + z1 * Y1;
  const v8 fy = f0 * twice(ALONG_Y(dA0, da0)) + f1 * twice(ALONG_Y(dA1, da1));

  const v8 X = pair(ALONG_X(A0, a0), ALONG_X(A1, a1));
  const v8 dX = pair(ALONG_X(dA0, da0), ALONG_X(dA1, da1));
  return sums(folded(f * X), folded(f * dX), folded(fy * X), folded(fz * X));
}

/* Points are located and their nodes fetched AHEAD points before they are needed. */
static void interpolate(const grid_view *g, int count, const kg_vec3 *x, double *distance,
                        kg_vec3 *gradient, bool *inside)
{
  const double inverse = 1.0 / g->spacing;
  const constants c = {(float)g->spacing, (float)inverse};
  place ring[AHEAD];
  for (int i = 0; i < count + AHEAD; i++) {
    place *p = &ring[i % AHEAD];
    if (i >= AHEAD && inside[i - AHEAD]) {
      const v4 out = interpolate_one(g, p, &c);
      distance[i - AHEAD] = (double)out[0];
      gradient[i - AHEAD] = (kg_vec3){(double)out[1], (double)out[2], (double)out[3]};
    }
    if (i < count && (inside[i] = find_place(g, inverse, x[i], p))) {
      const float *at = g->node + 4 * p->node;
      __builtin_prefetch(
        at); /* the rows at both ends in y: their first or last number, as lines go */
      __builtin_prefetch(at + ROW + 7);
      __builtin_prefetch(at + SLICE);
      __builtin_prefetch(at + SLICE + ROW + 7);
    }
  }
}

/* ---- nearest triangles -------------------------------------------------------------------------- */

static inline float clamped(float t)
{
  t = t > 0.0f ? t : 0.0f;
  return t < 1.0f ? t : 1.0f;
}

static inline float squared(float x, float y, float z)
{
  return x * x + y * y + z * z;
}

/* Inside the three planes across the edges the distance is that to the triangle's plane, else that to
 * the nearest edge. Wrong by roundings of the coordinates only, for slivers too: nothing is divided
 * by the area. */
static void try_triangle(const grid_triangle *triangles, int k, grid_packet *p)
{
  const grid_triangle t = triangles[k];
  for (int i = 0; i < GRID_PACKET; i++) {
    const float x = p->x[0][i] - t.a[0], y = p->x[1][i] - t.a[1], z = p->x[2][i] - t.a[2];
    const float rx = x - t.u[0], ry = y - t.u[1], rz = z - t.u[2]; /* from b */
    const float along_u = clamped((x * t.u[0] + y * t.u[1] + z * t.u[2]) * t.inverse_uu);
    const float along_v = clamped((x * t.v[0] + y * t.v[1] + z * t.v[2]) * t.inverse_vv);
    const float along_w = clamped((rx * t.w[0] + ry * t.w[1] + rz * t.w[2]) * t.inverse_ww);
    const float ab = squared(x - along_u * t.u[0], y - along_u * t.u[1], z - along_u * t.u[2]);
    const float ca = squared(x - along_v * t.v[0], y - along_v * t.v[1], z - along_v * t.v[2]);
    const float bc = squared(rx - along_w * t.w[0], ry - along_w * t.w[1], rz - along_w * t.w[2]);
    const float in_ab = x * t.m_ab[0] + y * t.m_ab[1] + z * t.m_ab[2];
    const float in_ca = x * t.m_ca[0] + y * t.m_ca[1] + z * t.m_ca[2];
    const float in_bc = rx * t.m_bc[0] + ry * t.m_bc[1] + rz * t.m_bc[2];
    const float height = x * t.n[0] + y * t.n[1] + z * t.n[2];
    const float two = in_ab < in_ca ? in_ab : in_ca;
    const float least = two < in_bc ? two : in_bc;
    const float edge1 = ab < ca ? ab : ca;
    const float edge = edge1 < bc ? edge1 : bc;
    const float distance2 = least >= 0.0f ? height * height : edge;
    p->triangle[i] = distance2 < p->distance2[i] ? k : p->triangle[i];
    p->distance2[i] = distance2 < p->distance2[i] ? distance2 : p->distance2[i];
  }
}

/* the larger of each two, a > b anywhere, the largest of all */
#if defined(__AVX512F__)
static inline v16 larger(v16 a, v16 b)
{
  return (v16)_mm512_max_ps((__m512)a, (__m512)b);
}

static inline bool any_larger(v16 a, v16 b)
{
  return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ) != 0;
}

static inline float largest(v16 a)
{
  return _mm512_reduce_max_ps((__m512)a);
}
#else
static inline v16 larger(v16 a, v16 b)
{
  for (int i = 0; i < GRID_PACKET; i++) {
    a[i] = a[i] > b[i] ? a[i] : b[i];
  }
  return a;
}

static inline bool any_larger(v16 a, v16 b)
{
  int any = 0;
  for (int i = 0; i < GRID_PACKET; i++) {
    any |= a[i] > b[i];
  }
  return any;
}

static inline float largest(v16 a)
{
  float most = a[0];
  for (int i = 1; i < GRID_PACKET; i++) {
    most = a[i] > most ? a[i] : most;
  }
  return most;
}
#endif

static inline v16 load16(const float *p)
{
  v16 out;
  memcpy(&out, p, sizeof out);
  return out;
}

typedef struct bounds {
  float lo[3], hi[3]; /* of the packet */
} bounds;

/* lane 0 is its lowest node, the last one its highest */
static bounds bounds_of(const grid_packet *p)
{
  bounds b;
  for (int k = 0; k < 3; k++) {
    b.lo[k] = p->x[k][0];
    b.hi[k] = p->x[k][GRID_PACKET - 1];
  }
  return b;
}

static inline float box_distance2(const bounds *b, const boxes_node *node)
{
  float sum = 0.0f;
  for (int k = 0; k < 3; k++) {
    const float under = node->lo[k] - b->hi[k], over = b->lo[k] - node->hi[k];
    const float gap = under > over ? under : over;
    const float outside = gap > 0.0f ? gap : 0.0f;
    sum += outside * outside;
  }
  return sum;
}

/* Is the box nearer to any node than what that one knows? */
static inline bool any_nearer(const grid_packet *p, const grid_box *box)
{
  const v16 x = load16(p->x[0]) - box->center[0], y = load16(p->x[1]) - box->center[1];
  const v16 z = load16(p->x[2]) - box->center[2], zero = {0.0f};
  v16 sum = zero;
  for (int k = 0; k < 3; k++) {
    const v16 along = x * box->axis[k][0] + y * box->axis[k][1] + z * box->axis[k][2];
    const v16 outside = larger(larger(along, -along) - box->half[k], zero);
    sum += outside * outside;
  }
  return any_larger(load16(p->distance2), sum);
}

/* Depth first, the nearer half first. */
static void search(const boxes *tree, const grid_box *around, const grid_triangle *triangles,
                   grid_packet *p)
{
  struct {
    int node;
    float distance2;
  } stack[BOXES_STACK];
  const bounds b = bounds_of(p);
  float farthest2 = largest(load16(p->distance2));
  int top = 0;
  stack[top].node = 0;
  stack[top++].distance2 = 0.0f;
  while (top > 0) {
    top--;
    if (!(stack[top].distance2 < farthest2)) continue;
    const boxes_node *node = &tree->nodes[stack[top].node];
    if (!any_nearer(p, &around[stack[top].node])) continue;
    if (node->count > 0) {
      for (int k = 0; k < node->count; k++) {
        try_triangle(triangles, node->first + k, p);
      }
      farthest2 = largest(load16(p->distance2));
      continue;
    }
    const float left = box_distance2(&b, &tree->nodes[node->first]);
    const float right = box_distance2(&b, &tree->nodes[node->first + 1]);
    const int nearer = left <= right ? 0 : 1;
    stack[top].node = node->first + 1 - nearer;
    stack[top++].distance2 = nearer == 0 ? right : left;
    stack[top].node = node->first + nearer;
    stack[top++].distance2 = nearer == 0 ? left : right;
  }
}

const kg_grid_kernels KG_PASTE(kg_grid_kernels_, KG_ISA) = {interpolate, search, try_triangle};
