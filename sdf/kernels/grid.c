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
 * C1. Nodes are read packed, eight bytes each (sdf/kernels/grid.h): random points wait for memory. */
#include "sdf/kernels/grid.h"

#include <math.h>
#include <string.h>

#include "sdf/kernels/lanes.h"

#define KG_PASTE_(a, b) a##b
#define KG_PASTE(a, b) KG_PASTE_(a, b)

/* ---- interpolation ----------------------------------------------------------------------------- */

/* Points are answered LANES at a time, one in each lane. Lanes do not know of each other: an answer
 * does not depend on what is asked with it. */
#if defined(__AVX512F__)
enum { LANES = 16, AHEAD = 2 };
#else
enum { LANES = FLOATS, AHEAD = 4 };
#endif

typedef float numbers __attribute__((vector_size(4 * LANES)));
typedef int32_t words __attribute__((vector_size(4 * LANES)));

enum { ALL = (1 << LANES) - 1 };

/* cells of LANES points */
typedef struct places {
  const int32_t *node[LANES]; /* the cell's first; of lanes that are not known the grid's */
  float t[3][LANES];          /* in it                                                    */
  unsigned known;             /* bit k: in the grid, in a block with nodes                */
} places;

enum { ROW = 2 * GRID_ROW, SLICE = 2 * GRID_SLICE }; /* words */

/* Cells by which rounding may carry a point of the box's face outside: grid_is_fine sees to it. */
#define FACE 1e-6

typedef int32_t ints __attribute__((vector_size(4 * DOUBLES)));
typedef float positions __attribute__((vector_size(4 * DOUBLES)));

/* cell along one axis, of points that are outside the nearest one, and the position from its start */
static inline ints locate_along(doubles x, double lo, double inverse, int n, float *t,
                                double_mask *is_in)
{
  const doubles zero = {0.0}, at = (x - lo) * inverse;
  const doubles in =
    lesser(greater(at, zero), zero + (double)(n - 2)); /* not a number: in cell 0 */
  const ints cell = __builtin_convertvector(in, ints);
  const doubles from = at - __builtin_convertvector(cell, doubles);
  const positions position = __builtin_convertvector(from, positions);
  memcpy(t, &position, sizeof position);
  *is_in &= (from >= -FACE) & (from <= 1.0 + FACE);
  return cell;
}

/* Lanes from `first` on, DOUBLES of them: bits of those that are in the grid; their blocks, and their
 * nodes counted from the block's first, in words. */
static inline unsigned locate_some(const grid_view *g, double inverse, const kg_vec3 *x, int first,
                                   places *p, int32_t *block, int32_t *node)
{
  double_mask is_in = {0};
  is_in = ~is_in;
  doubles u, v, w;
  from_rows(&x[first].x, &u, &v, &w);
  const ints i = locate_along(u, g->lo.x, inverse, g->n[0], &p->t[0][first], &is_in);
  const ints j = locate_along(v, g->lo.y, inverse, g->n[1], &p->t[1][first], &is_in);
  const ints k = locate_along(w, g->lo.z, inverse, g->n[2], &p->t[2][first], &is_in);
  const int mask = GRID_SIDE - 1; /* no index is negative, which / and % would allow for */
  const ints in_block = 2 * ((k & mask) * GRID_SLICE + (j & mask) * GRID_ROW + (i & mask));
  const ints of =
    ((k >> GRID_SHIFT) * g->blocks[1] + (j >> GRID_SHIFT)) * g->blocks[0] + (i >> GRID_SHIFT);
  memcpy(block + first, &of, sizeof of);
  memcpy(node + first, &in_block, sizeof in_block);
  return double_bits(is_in) << first;
}

static inline void locate(const grid_view *g, double inverse, const kg_vec3 *x, places *p)
{
  int32_t block[LANES], node[LANES];
  unsigned is_in = 0;
  for (int first = 0; first < LANES; first += DOUBLES) {
    is_in |= locate_some(g, inverse, x, first, p, block, node);
  }
  p->known = is_in;
  for (int k = 0; k < LANES; k++) {
    const int number = g->block[block[k]];
    const int32_t *at = g->packed;
    if (number >= 0) {
      at += (size_t)number * (2 * GRID_BLOCK_STRIDE) + (size_t)node[k];
    } else {
      p->known &= ~(1u << k);
    }
    p->node[k] = at;
    __builtin_prefetch(at); /* both rows of a slice are 56 bytes: two lines at most */
    __builtin_prefetch(at + ROW + 3);
    __builtin_prefetch(at + SLICE);
    __builtin_prefetch(at + SLICE + ROW + 3);
  }
}

/* Weights along an axis, h = 1. Of the values A_0 = 1 - A_1: only their difference counts. */
typedef struct weights {
  numbers A1, a0, a1, dA1, da0, da1;
} weights;

/* What depends on the grid only: the units of packed slopes times a spacing in those of packed values;
 * what makes m of the interpolant, and a gradient of its derivatives. */
typedef struct units {
  float slope;
  double value, gradient;
} units;

static inline numbers load(const float *p)
{
  numbers out;
  memcpy(&out, p, sizeof out);
  return out;
}

static inline weights weigh(const float *position, float slope)
{
  const numbers t = load(position), s = 1.0f - t, ts = t * s, tt = t * t, twice = ts + ts;
  const numbers scaled = slope * ts;
  return (weights){.A1 = (3.0f - (t + t)) * tt,
                   .a0 = scaled * s,
                   .a1 = -scaled * t,
                   .dA1 = 6.0f * ts,
                   .da0 = slope * (s * s - twice),
                   .da1 = slope * (tt - twice)};
}

/* a quantity between two ends, without slopes there, and its derivative */
static inline numbers mixed(const weights *w, numbers low, numbers high)
{
  return low + w->A1 * (high - low);
}

static inline numbers rise(const weights *w, numbers low, numbers high)
{
  return w->dA1 * (high - low);
}

/* what its slopes at the ends add */
static inline numbers bent(const weights *w, numbers low, numbers high)
{
  return w->a0 * low + w->a1 * high;
}

static inline numbers bent_rise(const weights *w, numbers low, numbers high)
{
  return w->da0 * low + w->da1 * high;
}

/* a row: two nodes */
static inline ints4 load4(const int32_t *p)
{
  ints4 out;
  memcpy(&out, p, sizeof out);
  return out;
}

#if defined(__AVX512F__)
#define FIRSTS(a, b)                                                                               \
  __builtin_shufflevector(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29)
#define LASTS(a, b)                                                                                \
  __builtin_shufflevector(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31)
#define FIRST_PAIRS(a, b)                                                                          \
  __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
#define LAST_PAIRS(a, b)                                                                           \
  __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31)

/* the two nodes of a row in lanes k, k + 4, k + 8 and k + 12 */
static inline words load_row(const places *p, int k, int offset)
{
  const float_mask ab = __builtin_shufflevector(
    load4(p->node[k] + offset), load4(p->node[k + 4] + offset), 0, 1, 2, 3, 4, 5, 6, 7);
  const float_mask cd = __builtin_shufflevector(
    load4(p->node[k + 8] + offset), load4(p->node[k + 12] + offset), 0, 1, 2, 3, 4, 5, 6, 7);
  return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
#elif defined(__AVX2__)
#define FIRSTS(a, b) __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13)
#define LASTS(a, b) __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15)
#define FIRST_PAIRS(a, b) __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
#define LAST_PAIRS(a, b) __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15)

/* the two nodes of a row in lanes k and k + 4 */
static inline words load_row(const places *p, int k, int offset)
{
  return __builtin_shufflevector(load4(p->node[k] + offset), load4(p->node[k + 4] + offset), 0, 1,
                                 2, 3, 4, 5, 6, 7);
}
#else
#define FIRSTS(a, b) __builtin_shufflevector(a, b, 0, 4, 1, 5)
#define LASTS(a, b) __builtin_shufflevector(a, b, 2, 6, 3, 7)
#define FIRST_PAIRS(a, b) __builtin_shufflevector(a, b, 0, 1, 4, 5)
#define LAST_PAIRS(a, b) __builtin_shufflevector(a, b, 2, 3, 6, 7)

static inline words load_row(const places *p, int k, int offset)
{
  return load4(p->node[k] + offset);
}
#endif

/* value and gradient in each lane */
typedef struct nodes {
  numbers f, x, y, z;
} nodes;

/* Of the upper half the lower one is a part too small to count: it was packed so. */
static inline nodes unpacked(words first, words second)
{
  return (nodes){
    __builtin_convertvector(first, numbers), __builtin_convertvector(first << 16, numbers),
    __builtin_convertvector(second, numbers), __builtin_convertvector(second << 16, numbers)};
}

/* f, df/dy, df/dz and their derivatives along x on an edge of the cell along x */
typedef struct edges {
  numbers f, y, z, fx, yx, zx;
} edges;

static inline edges along_x(const places *p, const weights *w, int offset)
{
  const words k0 = load_row(p, 0, offset), k1 = load_row(p, 1, offset);
  const words k2 = load_row(p, 2, offset), k3 = load_row(p, 3, offset);
  const words low01 = FIRSTS(k0, k1), low23 = FIRSTS(k2, k3);
  const words high01 = LASTS(k0, k1), high23 = LASTS(k2, k3);
  const nodes a = unpacked(FIRST_PAIRS(low01, low23), LAST_PAIRS(low01, low23));
  const nodes b = unpacked(FIRST_PAIRS(high01, high23), LAST_PAIRS(high01, high23));
  return (edges){.f = mixed(w, a.f, b.f) + bent(w, a.x, b.x),
                 .y = mixed(w, a.y, b.y),
                 .z = mixed(w, a.z, b.z),
                 .fx = rise(w, a.f, b.f) + bent_rise(w, a.x, b.x),
                 .yx = rise(w, a.y, b.y),
                 .zx = rise(w, a.z, b.z)};
}

/* f, df/dz and their derivatives along x and y on a face of the cell across z */
typedef struct faces {
  numbers f, z, fx, zx, fy, zy;
} faces;

static inline faces along_y(const places *p, const weights *wx, const weights *wy, int offset)
{
  const edges a = along_x(p, wx, offset), b = along_x(p, wx, offset + ROW);
  return (faces){.f = mixed(wy, a.f, b.f) + bent(wy, a.y, b.y),
                 .z = mixed(wy, a.z, b.z),
                 .fx = mixed(wy, a.fx, b.fx) + bent(wy, a.yx, b.yx),
                 .zx = mixed(wy, a.zx, b.zx),
                 .fy = rise(wy, a.f, b.f) + bent_rise(wy, a.y, b.y),
                 .zy = rise(wy, a.z, b.z)};
}

/* in units of packed values, a cell 1 wide */
static inline nodes interpolate_group(const places *p, float slope)
{
  const weights wx = weigh(p->t[0], slope), wy = weigh(p->t[1], slope);
  const weights wz = weigh(p->t[2], slope);
  const faces a = along_y(p, &wx, &wy, 0), b = along_y(p, &wx, &wy, SLICE);
  return (nodes){
    mixed(&wz, a.f, b.f) + bent(&wz, a.z, b.z), mixed(&wz, a.fx, b.fx) + bent(&wz, a.zx, b.zx),
    mixed(&wz, a.fy, b.fy) + bent(&wz, a.zy, b.zy), rise(&wz, a.f, b.f) + bent_rise(&wz, a.z, b.z)};
}

/* the lanes from `first` on, DOUBLES of them */
static inline doubles some(const numbers *a, int first, double unit)
{
  positions part;
  memcpy(&part, (const float *)a + first, sizeof part);
  return unit * __builtin_convertvector(part, doubles);
}

static inline void answer_group(const places *p, const units *u, double *distance,
                                kg_vec3 *gradient)
{
  const nodes v = interpolate_group(p, u->slope);
  for (int first = 0; first < LANES; first += DOUBLES) {
    const doubles value = some(&v.f, first, u->value);
    memcpy(distance + first, &value, sizeof value);
    to_rows(some(&v.x, first, u->gradient), some(&v.y, first, u->gradient),
            some(&v.z, first, u->gradient), &gradient[first].x);
  }
}

/* Answers lanes that are known and lists those of the first n that are not: says how many. */
static int answer_some(const places *p, const units *u, int first, int n, double *distance,
                       kg_vec3 *gradient, int *unknown)
{
  double value[LANES];
  kg_vec3 slope[LANES];
  int unknown_count = 0;
  if (p->known != 0) answer_group(p, u, value, slope);
  for (int k = 0; k < n && k < LANES; k++) {
    if (p->known >> k & 1) {
      distance[first + k] = value[k];
      gradient[first + k] = slope[k];
    } else {
      unknown[unknown_count++] = first + k;
    }
  }
  return unknown_count;
}

/* the last points, fewer than there are lanes */
static void locate_last(const grid_view *g, double inverse, int count, const kg_vec3 *x, places *p)
{
  kg_vec3 padded[LANES];
  for (int k = 0; k < LANES; k++) {
    padded[k] = k < count ? x[k] : (kg_vec3){NAN, NAN, NAN};
  }
  locate(g, inverse, padded, p);
}

/* Groups of points are located, and their nodes fetched, AHEAD groups before they are needed. */
static int interpolate(const grid_view *g, int count, const kg_vec3 *x, double *distance,
                       kg_vec3 *gradient, int *unknown)
{
  const double inverse = 1.0 / g->spacing, value = g->largest / GRID_PACKED;
  const units u = {(float)(g->steepest * g->spacing / g->largest), value, value * inverse};
  places ring[AHEAD];
  int unknown_count = 0;
  for (int first = -AHEAD * LANES; first < count; first += LANES) { /* to be answered */
    places *p = &ring[(first / LANES + AHEAD) % AHEAD];
    if (first >= 0 && p->known == ALL) {
      answer_group(p, &u, distance + first, gradient + first);
    } else if (first >= 0) {
      unknown_count +=
        answer_some(p, &u, first, count - first, distance, gradient, unknown + unknown_count);
    }
    const int next = first + AHEAD * LANES;
    if (next + LANES <= count) {
      locate(g, inverse, x + next, p);
    } else if (next < count) {
      locate_last(g, inverse, count - next, x + next, p);
    }
  }
  return unknown_count;
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

typedef float v16 __attribute__((vector_size(64)));

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
