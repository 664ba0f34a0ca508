/* Building of the hierarchy: two-way splits by the surface area heuristic over bins of centroids
 * [WALD] I. Wald, On fast construction of SAH-based bounding volume hierarchies, IEEE Symposium on
 * Interactive Ray Tracing, 2007. A side costs its area times its packets of eight triangles. The
 * widest part of a node is split until it has eight; nodes wait on a stack of their own.
 *
 * Parts are ranges of an array of boxes in floats, 32 bytes each, that is divided in place. */
#include "sdf/bvh.h"

#include "sdf/feature.h"
#include "sdf/kernels/lanes.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
  BINS = 16,
  FEW = 64, /* triangles that are sorted into FEW_BINS only                           */
  FEW_BINS = 8,
  SHORT = 32,  /* triangles that are cut across their longest axis without a look at the */
  LONG = 512,  /* others: SHORT and fewer, more than LONG                                */
  TURNED = 512 /* triangles under a node that gets axes of its own, at most             */
};

/* The mean of unit normals is at least that long where axes of its own can pay. */
#define FLAT 0.5

/* ... and no nearer to an axis of the world than that (cosine). */
#define STRAIGHT 0.95

/* Lane 3 of lo holds the face's number, that of hi nothing. */
typedef struct item {
  floats4 lo, hi;
} item;

typedef struct box {
  floats4 lo, hi;
} box;

/* items [first, first + count) at this depth of two-way splits */
typedef struct part {
  int first, count, depth;
  float area; /* half the surface of its box */
  box bounds;
} part;

typedef struct waiting_node {
  int node;
  part of;
} waiting_node;

/* items [first, first + count) of a packet */
typedef struct leaf {
  int first, count;
} leaf;

typedef struct builder {
  const bvh_input *input;
  kg_arena *scratch;
  kg_vec3 middle;      /* of the mesh; items are seen from there */
  item *items, *moved; /* (count) each                           */
  bvh_node *nodes;
  leaf *leaves;
  int node_count, node_capacity, leaf_count, leaf_capacity;
  waiting_node waiting[BVH_STACK];
  int waiting_count;
} builder;

/* ---- boxes ----------------------------------------------------------------------------------- */

static inline box empty_box(void)
{
  const floats4 zero = {0};
  return (box){zero + INFINITY, zero - INFINITY};
}

static inline void grow(box *b, floats4 lo, floats4 hi)
{
  b->lo = lesser4(b->lo, lo);
  b->hi = greater4(b->hi, hi);
}

/* half the surface; 0 of an empty box */
static inline float half_area(const box *b)
{
  const floats4 d = b->hi - b->lo;
  return d[0] >= 0.0f ? d[0] * d[1] + d[1] * d[2] + d[2] * d[0] : 0.0f;
}

/* twice the centre */
static inline floats4 centroid(const item *t)
{
  const ints4 three = {-1, -1, -1, 0};
  return (floats4)((ints4)t->lo & three) + (floats4)((ints4)t->hi & three);
}

static inline int face_of(const item *t)
{
  return ((ints4)t->lo)[3];
}

static inline floats4 seen_from(kg_vec3 p, kg_vec3 origin)
{
  return (floats4){(float)(p.x - origin.x), (float)(p.y - origin.y), (float)(p.z - origin.z), 0.0f};
}

/* Boxes of rounded corners. */
static void fill_items(builder *b)
{
  for (int i = 0; i < b->input->count; i++) {
    const int *v = b->input->corner[i];
    const floats4 p = seen_from(b->input->vertices[v[0]], b->middle);
    box bounds = {p, p};
    for (int k = 1; k < 3; k++) {
      const floats4 q = seen_from(b->input->vertices[v[k]], b->middle);
      grow(&bounds, q, q);
    }
    ints4 lo = (ints4)bounds.lo;
    lo[3] = i;
    b->items[i] = (item){(floats4)lo, bounds.hi};
  }
}

/* ---- splits ---------------------------------------------------------------------------------- */

typedef struct bin {
  box bounds;
  int count;
} bin;

typedef struct split {
  float cost;
  int axis, bin; /* the first bin of the right side */
  int left_count;
  box left, right;
} split;

/* bin = (centroid - origin) * scale on each axis */
typedef struct bin_scale {
  floats4 origin, scale;
} bin_scale;

static inline ints4 bins_of(const bin_scale *s, const item *t)
{
  return __builtin_convertvector((centroid(t) - s->origin) * s->scale, ints4);
}

/* False when all centroids are alike, or so nearly that bins cannot tell them apart. */
static bool scale_bins(bin_scale *s, const item *items, int count, int bins)
{
  box centroids = empty_box();
  for (int i = 0; i < count; i++) {
    const floats4 c = centroid(&items[i]);
    grow(&centroids, c, c);
  }
  const floats4 extent = centroids.hi - centroids.lo;
  bool is_wide = false;
  *s = (bin_scale){.origin = centroids.lo};
  for (int axis = 0; axis < 3; axis++) {
    const float scale = (float)bins * 0.9999f / extent[axis];
    const bool is_usable = extent[axis] > 0.0f && scale < FLT_MAX;
    s->scale[axis] = is_usable ? scale : 0.0f;
    is_wide = is_wide || is_usable;
  }
  return is_wide;
}

static inline float packets_of(int count)
{
  return (float)((count + BVH_LEAF - 1) / BVH_LEAF);
}

/* cheapest plane between the bins of one axis */
static void try_axis(const bin *bins, int count, int axis, split *best)
{
  box left[BINS];
  int left_count[BINS];
  box side = empty_box();
  for (int k = 0, n = 0; k < count - 1; k++) {
    grow(&side, bins[k].bounds.lo, bins[k].bounds.hi);
    n += bins[k].count;
    left[k] = side;
    left_count[k] = n;
  }
  side = empty_box();
  for (int k = count - 1, n = 0; k > 0; k--) {
    grow(&side, bins[k].bounds.lo, bins[k].bounds.hi);
    n += bins[k].count;
    if (n == 0 || left_count[k - 1] == 0) continue;
    const float cost =
      half_area(&left[k - 1]) * packets_of(left_count[k - 1]) + half_area(&side) * packets_of(n);
    if (cost < best->cost) {
      *best = (split){cost, axis, k, left_count[k - 1], left[k - 1], side};
    }
  }
}

/* the axis along which the centroids lie farthest apart */
static int longest_axis(const bin_scale *s)
{
  int axis = 0;
  for (int i = 1; i < 3; i++) { /* scale is the inverse of the extent, or zero */
    const bool is_longer = s->scale[axis] == 0.0f || s->scale[i] < s->scale[axis];
    axis = s->scale[i] > 0.0f && is_longer ? i : axis;
  }
  return axis;
}

static void fill_bins(bin *bins, int bin_count, const bin_scale *scale, int axis, const item *items,
                      int count)
{
  for (int k = 0; k < bin_count; k++) {
    bins[k] = (bin){empty_box(), 0};
  }
  for (int i = 0; i < count; i++) {
    bin *b = &bins[bins_of(scale, &items[i])[axis]];
    grow(&b->bounds, items[i].lo, items[i].hi);
    b->count++;
  }
}

static void find_split(split *best, const bin_scale *scale, const item *items, int count,
                       int bin_count)
{
  bin bins[BINS];
  const int only = count <= SHORT || count > LONG ? longest_axis(scale) : -1;
  for (int axis = 0; axis < 3; axis++) {
    if (scale->scale[axis] > 0.0f && (only < 0 || axis == only)) {
      fill_bins(bins, bin_count, scale, axis, items, count);
      try_axis(bins, bin_count, axis, best);
    }
  }
}

/* Items of the left side first, each side in the order it was in. */
static void move_items(builder *b, const part *of, const bin_scale *scale, const split *by)
{
  item *left = &b->items[of->first], *right = b->moved;
  for (int i = 0; i < of->count; i++) {
    const item t = b->items[of->first + i];
    const int is_left = bins_of(scale, &t)[by->axis] < by->bin;
    *left = t;
    *right = t;
    left += is_left;
    right += 1 - is_left;
  }
  memcpy(left, b->moved, (size_t)(right - b->moved) * sizeof *right);
}

static part make_part(int first, int count, int depth, const box *bounds)
{
  return (part){first, count, depth, half_area(bounds), *bounds};
}

static box bounds_of(const item *items, int count)
{
  box bounds = empty_box();
  for (int i = 0; i < count; i++) {
    grow(&bounds, items[i].lo, items[i].hi);
  }
  return bounds;
}

static void halve(const builder *b, const part *of, part *left, part *right)
{
  const int half = of->count / 2, rest = of->count - half;
  const box first = bounds_of(&b->items[of->first], half);
  const box second = bounds_of(&b->items[of->first + half], rest);
  *left = make_part(of->first, half, of->depth + 1, &first);
  *right = make_part(of->first + half, rest, of->depth + 1, &second);
}

static void divide(builder *b, const part *of, part *left, part *right)
{
  const item *items = &b->items[of->first];
  const int bins = of->count <= FEW ? FEW_BINS : BINS;
  bin_scale scale;
  split best = {.cost = INFINITY};
  if (of->depth < BVH_SAH_DEPTH && scale_bins(&scale, items, of->count, bins)) {
    find_split(&best, &scale, items, of->count, bins);
  }
  if (!(best.cost < INFINITY)) { /* all centroids alike, or deep enough */
    halve(b, of, left, right);
    return;
  }
  move_items(b, of, &scale, &best);
  *left = make_part(of->first, best.left_count, of->depth + 1, &best.left);
  *right =
    make_part(of->first + best.left_count, of->count - best.left_count, of->depth + 1, &best.right);
}

/* The parts that become the children of a node. */
static int eight_parts(builder *b, const part *of, part parts[BVH_WIDTH])
{
  int count = 1;
  parts[0] = *of;
  while (count < BVH_WIDTH) {
    int widest = -1;
    for (int k = 0; k < count; k++) {
      if (parts[k].count > BVH_LEAF && (widest < 0 || parts[k].area > parts[widest].area)) {
        widest = k;
      }
    }
    if (widest < 0) break;
    const part whole = parts[widest];
    divide(b, &whole, &parts[widest], &parts[count++]);
  }
  return count;
}

/* ---- nodes ----------------------------------------------------------------------------------- */

static const float WORLD[3][4] = {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}};

/* Axes whose third one is the mean normal; false when there is none. */
static bool mean_axes(const builder *b, const part *of, float turn[3][4])
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int i = of->first; i < of->first + of->count; i++) {
    sum = kg_vec3_add(sum, b->input->normal[face_of(&b->items[i])]);
  }
  const kg_vec3 n = kg_vec3_normalized(sum);
  const double straightness = fmax(fabs(n.x), fmax(fabs(n.y), fabs(n.z)));
  if (!(kg_vec3_norm(sum) > FLAT * of->count && straightness < STRAIGHT)) return false;
  const kg_vec3 s = any_orthogonal(n), t = kg_vec3_cross(n, s);
  const float columns[3][4] = {{(float)s.x, (float)t.x, (float)n.x, 0.0f},
                               {(float)s.y, (float)t.y, (float)n.y, 0.0f},
                               {(float)s.z, (float)t.z, (float)n.z, 0.0f}};
  memcpy(turn, columns, sizeof columns);
  return true;
}

static inline float sum_of_sizes(floats4 p)
{
  return fabsf(p[0]) + fabsf(p[1]) + fabsf(p[2]);
}

/* In the world's axes: corners were rounded once, and are once more when the origin moves. */
static box world_bounds(const part *of, floats4 origin)
{
  const float slack = BVH_TURNED * fmaxf(sum_of_sizes(of->bounds.lo), sum_of_sizes(of->bounds.hi));
  return (box){of->bounds.lo - origin - slack, of->bounds.hi - origin + slack};
}

/* In a node's axes, wide enough for the roundings on the way there. */
static box turned_bounds(const builder *b, const part *of, const bvh_node *node)
{
  const floats4 X = *(const floats4 *)node->turn[0], Y = *(const floats4 *)node->turn[1];
  const floats4 Z = *(const floats4 *)node->turn[2];
  const kg_vec3 origin = {node->origin[0], node->origin[1], node->origin[2]};
  box bounds = empty_box(), straight = empty_box();
  for (int i = of->first; i < of->first + of->count; i++) {
    const int *corner = b->input->corner[face_of(&b->items[i])];
    for (int k = 0; k < 3; k++) {
      const floats4 p = seen_from(b->input->vertices[corner[k]], origin);
      const floats4 q = X * p[0] + Y * p[1] + Z * p[2];
      grow(&bounds, q, q);
      grow(&straight, p, p);
    }
  }
  const floats4 reach = greater4(straight.hi, -straight.lo); /* of a corner: below their sum */
  const float slack = BVH_TURNED * sum_of_sizes(reach);
  return (box){bounds.lo - slack, bounds.hi + slack};
}

static void set_boxes(bvh_node *node, const box *bounds, int count)
{
  for (int k = 0; k < BVH_WIDTH; k++) {
    for (int axis = 0; axis < 3; axis++) {
      node->lo[axis][k] = k < count ? bounds[k].lo[axis] : INFINITY;
      node->hi[axis][k] = k < count ? bounds[k].hi[axis] : -INFINITY;
    }
  }
}

/* Turned axes where the surface is rather flat and the children's boxes get smaller by them. */
static void set_axes(const builder *b, const part *of, const part *parts, int count, bvh_node *node)
{
  const floats4 middle = 0.5f * of->bounds.lo + 0.5f * of->bounds.hi;
  node->origin[0] = b->middle.x + middle[0];
  node->origin[1] = b->middle.y + middle[1];
  node->origin[2] = b->middle.z + middle[2];
  box bounds[BVH_WIDTH], turned[BVH_WIDTH];
  float area = 0.0f, turned_area = 0.0f;
  for (int k = 0; k < count; k++) {
    bounds[k] = world_bounds(&parts[k], middle);
    area += half_area(&bounds[k]);
  }
  bool is_turned = of->count <= TURNED && mean_axes(b, of, node->turn);
  for (int k = 0; k < count && is_turned; k++) {
    turned[k] = turned_bounds(b, &parts[k], node);
    turned_area += half_area(&turned[k]);
    is_turned = turned_area < area;
  }
  if (!is_turned) {
    memcpy(node->turn, WORLD, sizeof WORLD);
  }
  set_boxes(node, is_turned ? turned : bounds, count);
}

/* ---- the whole tree -------------------------------------------------------------------------- */

/* Room for `more` elements behind `count`; what there was moves. NULL when memory is refused. */
static void *with_room(void *array, int count, int *capacity, int more, size_t size,
                       kg_arena *scratch)
{
  if (count + more <= *capacity) return array;
  const int larger = 2 * *capacity + more;
  void *room = kg_arena_take(scratch, (size_t)larger * size, 64);
  if (room) {
    memcpy(room, array, (size_t)count * size);
    *capacity = larger;
  }
  return room;
}

static bool make_room(builder *b)
{
  bvh_node *nodes =
    with_room(b->nodes, b->node_count, &b->node_capacity, BVH_WIDTH, sizeof *b->nodes, b->scratch);
  leaf *leaves = with_room(b->leaves, b->leaf_count, &b->leaf_capacity, BVH_WIDTH,
                           sizeof *b->leaves, b->scratch);
  b->nodes = nodes;
  b->leaves = leaves;
  return nodes && leaves;
}

static bool fill_node(builder *b, int index, const part *of)
{
  if (!make_room(b)) return false;
  part parts[BVH_WIDTH];
  const int count = eight_parts(b, of, parts);
  bvh_node *node = &b->nodes[index];
  *node = (bvh_node){.child = {0}};
  set_axes(b, of, parts, count, node);
  for (int k = 0; k < count; k++) {
    if (parts[k].count <= BVH_LEAF) {
      node->child[k] = ~b->leaf_count;
      b->leaves[b->leaf_count++] = (leaf){parts[k].first, parts[k].count};
      continue;
    }
    node->child[k] = b->node_count++;
    KG_ASSERT(b->waiting_count < BVH_STACK);
    b->waiting[b->waiting_count++] = (waiting_node){node->child[k], parts[k]};
  }
  return true;
}

static bool fill_nodes(builder *b)
{
  const box bounds = bounds_of(b->items, b->input->count);
  const part whole = make_part(0, b->input->count, 0, &bounds);
  b->node_count = 1;
  bool is_good = fill_node(b, 0, &whole);
  while (b->waiting_count > 0 && is_good) {
    const waiting_node next = b->waiting[--b->waiting_count];
    is_good = fill_node(b, next.node, &next.of);
  }
  return is_good;
}

static void set_triangle(bvh_packet *packet, int k, const bvh_input *input, int face)
{
  const int *v = input->corner[face];
  const kg_vec3 a = input->vertices[v[0]];
  const kg_vec3 u = kg_vec3_sub(input->vertices[v[1]], a);
  const kg_vec3 w = kg_vec3_sub(input->vertices[v[2]], a);
  const double rows[3][3] = {{a.x, a.y, a.z}, {u.x, u.y, u.z}, {w.x, w.y, w.z}};
  for (int axis = 0; axis < 3; axis++) {
    packet->a[axis][k] = rows[0][axis];
    packet->u[axis][k] = rows[1][axis];
    packet->v[axis][k] = rows[2][axis];
  }
}

static void fill_packets(bvh *out, const builder *b)
{
  for (int i = 0; i < b->leaf_count; i++) {
    const leaf *of = &b->leaves[i];
    for (int k = 0; k < BVH_LEAF; k++) {
      const int place = k < of->count ? k : of->count - 1;
      const int face = face_of(&b->items[of->first + place]);
      out->face[BVH_LEAF * i + k] = face;
      set_triangle(&out->packets[i], k, b->input, face);
    }
  }
}

static bool keep_result(bvh *out, const builder *b, kg_arena *arena)
{
  const size_t nodes = (size_t)b->node_count, packets = (size_t)b->leaf_count;
  *out = (bvh){kg_arena_take(arena, nodes * sizeof *out->nodes, 64),
               kg_arena_take(arena, packets * sizeof *out->packets, 64),
               kg_arena_take(arena, packets * BVH_LEAF * sizeof *out->face, 64),
               b->node_count,
               b->leaf_count,
               b->input->lo,
               b->input->hi};
  if (kg_arena_failed(arena)) return false;
  memcpy(out->nodes, b->nodes, nodes * sizeof *out->nodes);
  fill_packets(out, b);
  return true;
}

bool bvh_build(bvh *out, const bvh_input *input, kg_arena *arena, kg_arena *scratch)
{
  KG_ASSERT(input->count > 0);
  const size_t count = (size_t)input->count;
  builder *b = KG_ARENA_ARRAY(scratch, builder, 1);
  if (!b) return false;
  b->input = input;
  b->scratch = scratch;
  b->middle = kg_vec3_lerp(input->lo, input->hi, 0.5);
  b->items = kg_arena_take(scratch, count * sizeof *b->items, 64);
  b->moved = kg_arena_take(scratch, count * sizeof *b->moved, 64);
  b->node_capacity = input->count / 24 + BVH_WIDTH;
  b->leaf_capacity = input->count / 4 + BVH_WIDTH;
  b->nodes = kg_arena_take(scratch, (size_t)b->node_capacity * sizeof *b->nodes, 64);
  b->leaves = kg_arena_take(scratch, (size_t)b->leaf_capacity * sizeof *b->leaves, 64);
  if (kg_arena_failed(scratch)) return false;
  fill_items(b);
  return fill_nodes(b) && keep_result(out, b, arena);
}
