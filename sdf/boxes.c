/* Halves at the median of the centres along the longest side, down to a few triangles. */
#include "sdf/boxes.h"

#include <float.h>
#include <math.h>

typedef struct builder {
  const boxes_box *items; /* of the triangles */
  boxes *out;
  int node_count;
} builder;

static float below(double value)
{
  const float f = (float)value;
  return (double)f > value ? nextafterf(f, -FLT_MAX) : f;
}

static float above(double value)
{
  const float f = (float)value;
  return (double)f < value ? nextafterf(f, FLT_MAX) : f;
}

boxes_box boxes_around(const kg_vec3 p[3])
{
  const double v[3][3] = {
    {p[0].x, p[1].x, p[2].x}, {p[0].y, p[1].y, p[2].y}, {p[0].z, p[1].z, p[2].z}};
  boxes_box out;
  for (int i = 0; i < 3; i++) {
    out.lo[i] = below(fmin(v[i][0], fmin(v[i][1], v[i][2])));
    out.hi[i] = above(fmax(v[i][0], fmax(v[i][1], v[i][2])));
  }
  return out;
}

/* twice the centre */
static float center(const builder *b, int position, int axis)
{
  const boxes_box *t = &b->items[b->out->order[position]];
  return t->lo[axis] + t->hi[axis];
}

/* in the order of the centres; triangles with the same one in the order of their numbers */
static bool comes_before(const builder *b, int axis, float key, int number, int position)
{
  const float at = center(b, position, axis);
  return key < at || (key == at && number < b->out->order[position]);
}

static bool comes_after(const builder *b, int axis, float key, int number, int position)
{
  const float at = center(b, position, axis);
  return key > at || (key == at && number > b->out->order[position]);
}

/* Hoare's selection: afterwards [first, middle) holds the smaller ones. */
static void split_at(builder *b, int axis, int first, int end, int middle)
{
  int *order = b->out->order;
  int low = first, high = end - 1;
  while (low < high) {
    const int pivot = low + (high - low) / 2, number = order[pivot];
    const float key = center(b, pivot, axis);
    int i = low, j = high;
    while (i <= j) {
      while (comes_after(b, axis, key, number, i)) {
        i++;
      }
      while (comes_before(b, axis, key, number, j)) {
        j--;
      }
      if (i <= j) {
        const int swap = order[i];
        order[i++] = order[j];
        order[j--] = swap;
      }
    }
    if (middle <= j) {
      high = j;
    } else if (middle >= i) {
      low = i;
    } else {
      return;
    }
  }
}

static int longest_axis(const builder *b, int first, int end)
{
  float lo[3] = {INFINITY, INFINITY, INFINITY}, hi[3] = {-INFINITY, -INFINITY, -INFINITY};
  for (int k = first; k < end; k++) {
    for (int i = 0; i < 3; i++) {
      lo[i] = fminf(lo[i], center(b, k, i));
      hi[i] = fmaxf(hi[i], center(b, k, i));
    }
  }
  const float x = hi[0] - lo[0], y = hi[1] - lo[1], z = hi[2] - lo[2];
  return x >= y && x >= z ? 0 : y >= z ? 1 : 2;
}

static void set_box(boxes_node *node, const builder *b, int first, int end)
{
  for (int i = 0; i < 3; i++) {
    node->lo[i] = INFINITY;
    node->hi[i] = -INFINITY;
  }
  for (int k = first; k < end; k++) {
    const boxes_box *t = &b->items[b->out->order[k]];
    for (int i = 0; i < 3; i++) {
      node->lo[i] = fminf(node->lo[i], t->lo[i]);
      node->hi[i] = fmaxf(node->hi[i], t->hi[i]);
    }
  }
}

static void build_node(builder *b, int index, int first, int end)
{
  boxes_node *node = &b->out->nodes[index];
  set_box(node, b, first, end);
  if (end - first <= BOXES_LEAF) {
    node->count = end - first;
    node->first = first;
    return;
  }
  const int middle = boxes_middle(first, end);
  split_at(b, longest_axis(b, first, end), first, end, middle);
  node->count = 0;
  node->first = b->node_count;
  b->node_count += 2;
  build_node(b, node->first, first, middle);
  build_node(b, node->first + 1, middle, end);
}

bool boxes_build(boxes *out, int count, boxes_corners *corners, const void *user, kg_arena *arena)
{
  KG_ASSERT(count > 0);
  boxes_box *items = KG_ARENA_ARRAY(arena, boxes_box, count);
  out->order = KG_ARENA_ARRAY(arena, int, count);
  /* leaves hold at least two triangles, but for a root that is one */
  out->nodes = KG_ARENA_ARRAY(arena, boxes_node, count + 1);
  if (!items || !out->order || !out->nodes) return false;
  for (int k = 0; k < count; k++) {
    kg_vec3 p[3];
    corners(k, p, user);
    items[k] = boxes_around(p);
    out->order[k] = k;
  }
  builder b = {items, out, 1};
  build_node(&b, 0, 0, count);
  return true;
}
