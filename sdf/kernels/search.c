/* Depth first, nearest box first.
 *
 *   p, q      x - a of a triangle, x - b
 *   n         u x v
 *   s, t, r   barycentric coordinates of x's projection times |n|^2, of b, c and a. Taken from n: from
 *             products of u.u, u.v, v.v they are off by the square of a sliver's slenderness
 *
 * The squared distance to a triangle is that to its plane where x projects into it (s, t, r > 0), else
 * the least of those to its edges. That needs no cases; `mesh.c` finds the feature of the one triangle
 * that counts by the same arithmetic. Without contraction every instruction set rounds alike. */
#include "sdf/kernels/kernels.h"

#include "sdf/kernels/lanes.h"

#include <math.h>

#define NAME_(isa) kg_sdf_kernels_##isa
#define NAME(isa) NAME_(isa)
#define GRID_NAME_(isa) kg_grid_kernels_##isa
#define GRID_NAME(isa) GRID_NAME_(isa)

typedef struct triple {
  doubles x, y, z;
} triple;

static inline triple sub(triple a, triple b)
{
  return (triple){a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline doubles dot(triple a, triple b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline triple cross(triple a, triple b)
{
  return (triple){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static inline triple all(kg_vec3 x)
{
  const doubles zero = {0};
  return (triple){zero + x.x, zero + x.y, zero + x.z};
}

static inline triple load(const double rows[3][BVH_LEAF], int first)
{
  return (triple){*(const doubles *)&rows[0][first], *(const doubles *)&rows[1][first],
                  *(const doubles *)&rows[2][first]};
}

/* from the edge e; p is seen from its start */
static inline doubles edge_distance2(triple p, triple e)
{
  const doubles zero = {0}, t = lesser(greater(dot(p, e) / dot(e, e), zero), zero + 1.0);
  const triple d = {p.x - t * e.x, p.y - t * e.y, p.z - t * e.z};
  return dot(d, d);
}

static inline doubles triangle_distance2(const bvh_packet *packet, int first, triple x)
{
  const triple u = load(packet->u, first), v = load(packet->v, first);
  const triple p = sub(x, load(packet->a, first)), q = sub(p, u), w = sub(v, u);
  const triple n = cross(u, v);
  const doubles nn = dot(n, n), s = dot(n, cross(p, v)), t = dot(n, cross(u, p)), r = nn - s - t;
  const doubles edges =
    lesser(lesser(edge_distance2(p, u), edge_distance2(p, v)), edge_distance2(q, w));
  const doubles height = dot(n, p), zero = {0};
  const double_mask within = (s > zero) & (t > zero) & (r > zero);
  return chosen(within, height * height / nn, edges);
}

static void visit_packet(const bvh *tree, int packet, triple x, bvh_best *best)
{
  __builtin_prefetch(&tree->face[BVH_LEAF * packet]); /* the caller will want to know the face */
  for (int first = 0; first < BVH_LEAF; first += DOUBLES) {
    const doubles zero = {0}, distance2 = triangle_distance2(&tree->packets[packet], first, x);
    unsigned bits = double_bits(distance2 <= zero + best->distance2);
    for (; bits != 0; bits &= bits - 1) {
      const int k = __builtin_ctz(bits), slot = BVH_LEAF * packet + first + k;
      const double d = distance2[k];
      const bool is_tie =
        d == best->distance2 && best->slot >= 0 && tree->face[slot] < tree->face[best->slot];
      if (d < best->distance2 || is_tie) {
        *best = (bvh_best){d, slot};
      }
    }
  }
}

/* Squared distances to the children's boxes, never too large; bit k: child k is within limit. */
static inline unsigned child_distances(const bvh_node *node, kg_vec3 x, float limit,
                                       float distance2[BVH_WIDTH])
{
  const float px = (float)(x.x - node->origin[0]), py = (float)(x.y - node->origin[1]);
  const float pz = (float)(x.z - node->origin[2]);
  const floats4 q = *(const floats4 *)node->turn[0] * px + *(const floats4 *)node->turn[1] * py +
                    *(const floats4 *)node->turn[2] * pz;
  const float slack = BVH_TURNED * (fabsf(px) + fabsf(py) + fabsf(pz));
  const floats4 above = q + slack, below = q - slack;
  const floats zero = {0};
  unsigned bits = 0;
  for (int k = 0; k < BVH_WIDTH; k += FLOATS) {
    floats sum = zero;
    for (int i = 0; i < 3; i++) {
      const floats under = *(const floats *)&node->lo[i][k] - above[i];
      const floats over = below[i] - *(const floats *)&node->hi[i][k];
      const floats gap = greater_floats(greater_floats(under, over), zero);
      sum += gap * gap;
    }
    sum *= BVH_ROUNDED;
    *(floats *)&distance2[k] = sum;
    bits |= bits_of(sum <= limit) << k;
  }
  return bits;
}

typedef struct waiting {
  float distance2; /* in the search from far away: beyond the base */
  int child;
} waiting;

/* a float that is not below value */
static inline float at_least(double value)
{
  return value < 3e38 ? (float)value * 1.0000003f + 1e-44f : 3e38f;
}

/* ---- far away ----------------------------------------------------------------------------------
 *
 * From a thousand sizes of the mesh on its boxes are equally far in floats. What is compared then is
 * the distance beyond `base`, that to the mesh's box, found in double. Axes of a node's own are unit
 * vectors in floats only, too coarse for it: children of such a node count as near as the node. */

#define FAR 1e3

static double distance_to_box(const double lo[3], const double hi[3], const double x[3])
{
  double sum = 0.0;
  for (int i = 0; i < 3; i++) {
    const double under = lo[i] - x[i], over = x[i] - hi[i];
    const double gap = fmax(fmax(under, over), 0.0);
    sum += gap * gap;
  }
  return sqrt(sum);
}

/* distance - base, rounded down: below what the packets' arithmetic gives */
static float beyond(double distance, double base)
{
  const double rest = distance * (1.0 - 1e-14) - base;
  return (float)(rest - 1e-6 * fabs(rest));
}

/* the same of the best so far, rounded up */
static float far_limit(double distance2, double base)
{
  const double rest = sqrt(distance2) * (1.0 + 1e-14) - base;
  return rest < 3e37 ? (float)(rest + 1e-6 * fabs(rest)) : 3e38f;
}

/* of child k of a node that is itself `node_beyond` */
static float child_beyond(const bvh_node *node, int k, const double p[3], double base,
                          float node_beyond)
{
  const double lo[3] = {node->lo[0][k], node->lo[1][k], node->lo[2][k]};
  const double hi[3] = {node->hi[0][k], node->hi[1][k], node->hi[2][k]};
  if (lo[0] > hi[0]) return INFINITY; /* no child */
  const bool is_turned = node->turn[0][0] != 1.0f;
  return is_turned ? node_beyond : beyond(distance_to_box(lo, hi, p), base);
}

static void search_far(const bvh *tree, kg_vec3 x, int packet, bool is_any, bvh_best *best)
{
  const triple point = all(x);
  if (packet >= 0) {
    visit_packet(tree, packet, point, best);
  }
  const double lo[3] = {tree->lo.x, tree->lo.y, tree->lo.z};
  const double hi[3] = {tree->hi.x, tree->hi.y, tree->hi.z};
  const double base = distance_to_box(lo, hi, (const double[3]){x.x, x.y, x.z});
  float limit = far_limit(best->distance2, base);
  waiting stack[BVH_STACK];
  int top = 0;
  stack[top++] = (waiting){beyond(base, base), 0};
  while (top > 0 && !(is_any && best->slot >= 0)) {
    const waiting at = stack[--top];
    if (!(at.distance2 <= limit)) continue;
    if (at.child < 0) {
      visit_packet(tree, ~at.child, point, best);
      limit = far_limit(best->distance2, base);
      continue;
    }
    const bvh_node *node = &tree->nodes[at.child];
    const double p[3] = {x.x - node->origin[0], x.y - node->origin[1], x.z - node->origin[2]};
    for (int k = 0, first = top; k < BVH_WIDTH; k++) {
      const waiting child = {child_beyond(node, k, p, base, at.distance2), node->child[k]};
      if (!(child.distance2 <= limit)) continue;
      int place = top++; /* the nearest on top */
      for (; place > first && stack[place - 1].distance2 < child.distance2; place--) {
        stack[place] = stack[place - 1];
      }
      stack[place] = child;
    }
  }
}

/* ---- the search ------------------------------------------------------------------------------ */

static bool is_far(const bvh *tree, kg_vec3 x)
{
  const kg_vec3 d = kg_vec3_sub(x, kg_vec3_lerp(tree->lo, tree->hi, 0.5));
  const kg_vec3 size = kg_vec3_sub(tree->hi, tree->lo);
  return kg_vec3_dot(d, d) > FAR * FAR * kg_vec3_dot(size, size);
}

static void search(const bvh *tree, kg_vec3 x, int packet, bool is_any, bvh_best *best)
{
  if (is_far(tree, x)) {
    search_far(tree, x, packet, is_any, best);
    return;
  }
  const triple point = all(x);
  if (packet >= 0) {
    visit_packet(tree, packet, point, best);
  }
  float limit = at_least(best->distance2);
  waiting stack[BVH_STACK];
  int top = 0, at = 0;
  for (;;) {
    if (is_any && best->slot >= 0) return;
    if (at < 0) {
      if (~at != packet) {
        visit_packet(tree, ~at, point, best);
        limit = at_least(best->distance2);
      }
    } else {
      const bvh_node *node = &tree->nodes[at];
      float distance2[BVH_WIDTH] __attribute__((aligned(32)));
      unsigned bits = child_distances(node, x, limit, distance2);
      if (bits != 0) {
        int nearest = __builtin_ctz(bits);
        for (bits &= bits - 1; bits != 0; bits &= bits - 1) {
          const int k = __builtin_ctz(bits);
          const bool is_nearer = distance2[k] < distance2[nearest];
          const int other = is_nearer ? nearest : k;
          nearest = is_nearer ? k : nearest;
          stack[top++] = (waiting){distance2[other], node->child[other]};
        }
        at = node->child[nearest];
        continue;
      }
    }
    do {
      if (top == 0) return;
      top--;
    } while (!(stack[top].distance2 <= limit));
    at = stack[top].child;
  }
}

/* ---- angles ---------------------------------------------------------------------------------- */

/* |z| <= tan(pi / 8): the Taylor series, whose first term left out is below 2e-15 */
static inline double small_arctangent(double z)
{
  const double y = z * z;
  double sum = 1.0 / 33.0;
  for (int k = 31; k >= 1; k -= 2) {
    sum = 1.0 / k - y * sum;
  }
  return z * sum;
}

static void angles(int count, const double *restrict sine, const double *restrict cosine,
                   double *restrict angle)
{
  for (int i = 0; i < count; i++) {
    const double s = sine[i], c = fabs(cosine[i]);
    const double least = s < c ? s : c, most = s < c ? c : s;
    const bool is_wide = least > 0.41421356237309503 * most; /* towards pi / 4 */
    const double z = (is_wide ? least - most : least) / (is_wide ? least + most : most);
    const double within = small_arctangent(z) + (is_wide ? 0.25 * SDF_PI : 0.0);
    const double first = s < c ? within : 0.5 * SDF_PI - within;
    angle[i] = cosine[i] < 0.0 ? SDF_PI - first : first;
  }
}

const kg_sdf_kernels NAME(KG_ISA) = {search, angles, &GRID_NAME(KG_ISA)};
