/* Building of the hierarchy: two-way splits by the surface area heuristic over bins of centroids
 * [WALD] I. Wald, On fast construction of SAH-based bounding volume hierarchies, IEEE Symposium on
 * Interactive Ray Tracing, 2007; two levels of them make one node with four children. */
#include "sdf/bvh.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum { BINS = 16 };

typedef struct builder {
  const bvh_box *boxes;
  int *order;
  bvh_node *nodes;
  int node_count;
} builder;

/* items [first, first + count) of order, at this depth of two-way splits */
typedef struct range {
  int first, count, depth;
} range;

static bvh_box empty_box(void)
{
  return (bvh_box){{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};
}

static void grow(bvh_box *box, const bvh_box *by)
{
  box->lo =
    kg_vec3_make(fmin(box->lo.x, by->lo.x), fmin(box->lo.y, by->lo.y), fmin(box->lo.z, by->lo.z));
  box->hi =
    kg_vec3_make(fmax(box->hi.x, by->hi.x), fmax(box->hi.y, by->hi.y), fmax(box->hi.z, by->hi.z));
}

/* half the surface; 0 of an empty box */
static double half_area(const bvh_box *box)
{
  const kg_vec3 d = kg_vec3_sub(box->hi, box->lo);
  return d.x >= 0.0 ? d.x * d.y + d.y * d.z + d.z * d.x : 0.0;
}

static double along(kg_vec3 a, int axis)
{
  return axis == 0 ? a.x : axis == 1 ? a.y : a.z;
}

/* twice the centre */
static double centroid(const builder *b, int position, int axis)
{
  const bvh_box *box = &b->boxes[b->order[position]];
  return along(box->lo, axis) + along(box->hi, axis);
}

typedef struct split {
  int axis;
  double cost, origin, scale; /* bin = (centroid - origin) * scale */
  int bin;                    /* the first bin of the right side   */
} split;

static int bin_of(const split *s, double value)
{
  const int bin = (int)((value - s->origin) * s->scale);
  return bin < 0 ? 0 : bin >= BINS ? BINS - 1 : bin;
}

/* cheapest plane on one axis: sum over both sides of area times items */
static void try_axis(const builder *b, range r, int axis, split *best)
{
  double lo = INFINITY, hi = -INFINITY;
  for (int i = r.first; i < r.first + r.count; i++) {
    lo = fmin(lo, centroid(b, i, axis));
    hi = fmax(hi, centroid(b, i, axis));
  }
  split s = {axis, INFINITY, lo, BINS * (1.0 - 1e-9) / (hi - lo), 0};
  if (!(hi > lo) || !isfinite(s.scale)) return;
  bvh_box bins[BINS];
  int counts[BINS] = {0};
  for (int k = 0; k < BINS; k++) {
    bins[k] = empty_box();
  }
  for (int i = r.first; i < r.first + r.count; i++) {
    const int k = bin_of(&s, centroid(b, i, axis));
    counts[k]++;
    grow(&bins[k], &b->boxes[b->order[i]]);
  }
  double left_cost[BINS];
  bvh_box side = empty_box();
  for (int k = 0, n = 0; k < BINS - 1; k++) {
    grow(&side, &bins[k]);
    n += counts[k];
    left_cost[k] = n > 0 ? half_area(&side) * n : INFINITY;
  }
  side = empty_box();
  for (int k = BINS - 1, n = 0; k > 0; k--) {
    grow(&side, &bins[k]);
    n += counts[k];
    const double cost = n > 0 ? left_cost[k - 1] + half_area(&side) * n : INFINITY;
    if (cost < best->cost) {
      *best = (split){axis, cost, s.origin, s.scale, k};
    }
  }
}

/* Divides the items of r between two sides; returns the items on the left. */
static int divide(builder *b, range r)
{
  split s = {.cost = INFINITY};
  if (r.depth < BVH_SAH_DEPTH) {
    for (int axis = 0; axis < 3; axis++) {
      try_axis(b, r, axis, &s);
    }
  }
  if (!isfinite(s.cost)) return r.count / 2; /* all centroids alike, or deep enough */
  int left = r.first, right = r.first + r.count;
  while (left < right) {
    if (bin_of(&s, centroid(b, left, s.axis)) < s.bin) {
      left++;
    } else {
      const int moved = b->order[--right];
      b->order[right] = b->order[left];
      b->order[left] = moved;
    }
  }
  return left - r.first;
}

static bvh_box range_box(const builder *b, range r)
{
  bvh_box box = empty_box();
  for (int i = r.first; i < r.first + r.count; i++) {
    grow(&box, &b->boxes[b->order[i]]);
  }
  return box;
}

/* floats below and above a double */
static float below(double value)
{
  const float f = (float)value;
  return f > value ? nextafterf(f, -FLT_MAX) : f;
}

static float above(double value)
{
  const float f = (float)value;
  return f < value ? nextafterf(f, FLT_MAX) : f;
}

static void set_child(bvh_node *node, int k, const bvh_box *box, int child, int count)
{
  for (int axis = 0; axis < 3; axis++) {
    node->lo[axis][k] = below(along(box->lo, axis));
    node->hi[axis][k] = above(along(box->hi, axis));
  }
  node->child[k] = child;
  node->count[k] = count;
}

/* up to four parts of r, by two rounds of two-way splits */
static int four_parts(builder *b, range r, range parts[BVH_WIDTH])
{
  int count = 1;
  parts[0] = r;
  for (int round = 0; round < 2; round++) {
    for (int k = count - 1; k >= 0; k--) {
      const range part = parts[k];
      if (part.count <= BVH_LEAF && count > 1) continue;
      if (part.count < 2) continue;
      const int left = divide(b, part);
      parts[k] = (range){part.first, left, part.depth + 1};
      parts[count++] = (range){part.first + left, part.count - left, part.depth + 1};
    }
  }
  return count;
}

static int build_node(builder *b, range r)
{
  const int index = b->node_count++;
  range parts[BVH_WIDTH];
  const int count = four_parts(b, r, parts);
  for (int k = 0; k < BVH_WIDTH; k++) {
    if (k >= count) {
      const bvh_box nowhere = empty_box();
      set_child(&b->nodes[index], k, &nowhere, 0, -1);
      continue;
    }
    const bvh_box box = range_box(b, parts[k]);
    const bool leaf = parts[k].count <= BVH_LEAF;
    const int child = leaf ? parts[k].first : build_node(b, parts[k]);
    set_child(&b->nodes[index], k, &box, child, leaf ? parts[k].count : 0);
  }
  return index;
}

bool bvh_build(bvh *out, const bvh_box *boxes, int count, kg_arena *arena, kg_arena *scratch)
{
  KG_ASSERT(count > 0);
  /* an inner node has at least two children and every leaf at least one item */
  bvh_node *nodes = KG_ARENA_ARRAY(scratch, bvh_node, count);
  int *order = KG_ARENA_ARRAY(arena, int, count);
  if (!nodes || !order) return false;
  for (int i = 0; i < count; i++) {
    order[i] = i;
  }
  builder b = {boxes, order, nodes, 0};
  build_node(&b, (range){0, count, 0});
  bvh_node *kept = KG_ARENA_ARRAY(arena, bvh_node, b.node_count);
  if (!kept) return false;
  memcpy(kept, nodes, (size_t)b.node_count * sizeof *nodes);
  *out = (bvh){kept, b.node_count, order};
  return true;
}
