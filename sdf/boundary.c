/* The rims of an open mesh: gaps in a solid, or the borders of a sheet.
 *
 *   A   = sum n dA over a part of the surface: zero when it is closed, and what its rims enclose (with
 *         the other sign) when it is not: a terrain's is nearly its whole area
 *   rim = edges with one face, chained from corner to corner; it encloses 1/2 sum p x p'
 *
 * A part (triangles connected over corners) whose rims enclose little of its own area is a solid
 * with gaps. A box without its lid: 1/5; a half ball: 1/2. */
#include "sdf/topology.h"

#include <stdlib.h>

#define GAP_SHARE 0.25

typedef struct part {
  double area, enclosed; /* m^2: of the triangles, within the rims */
  int faces;
} part;

typedef struct rim {
  int vertex; /* one of its own */
  double length, enclosed;
  kg_vec3 center;
} rim;

static int find_root(int *parent, int v)
{
  while (parent[v] != v) {
    parent[v] = parent[parent[v]];
    v = parent[v];
  }
  return v;
}

static void join_corners(const topology *topo, int *parent)
{
  for (int v = 0; v < topo->vertex_count; v++) {
    parent[v] = v;
  }
  for (int i = 0; i < topo->face_count; i++) {
    const int root = find_root(parent, topo->corner[i][0]);
    for (int k = 1; k < 3; k++) {
      parent[find_root(parent, topo->corner[i][k])] = root;
    }
  }
}

static int compare_starts(const void *left, const void *right)
{
  const int *a = left, *b = right;
  if (a[0] != b[0]) return a[0] < b[0] ? -1 : 1;
  return (a[1] > b[1]) - (a[1] < b[1]);
}

/* first edge that starts at v, or boundary_count */
static int first_from(const topology *topo, int v)
{
  int low = 0, high = topo->boundary_count;
  while (low < high) {
    const int mid = low + (high - low) / 2;
    if (topo->boundary[mid][0] < v) {
      low = mid + 1;
    } else {
      high = mid;
    }
  }
  return low;
}

/* Edges that start at the same corner are used up in order: taken[first] counts them. */
static int take_from(const topology *topo, int *taken, int v)
{
  const int first = first_from(topo, v);
  if (first >= topo->boundary_count || topo->boundary[first][0] != v) return -1;
  const int edge = first + taken[first];
  if (edge >= topo->boundary_count || topo->boundary[edge][0] != v) return -1;
  taken[first]++;
  return edge;
}

/* From corner to corner along edges not used yet, until there is none. */
static rim walk(const topology *topo, int *taken, int edge)
{
  rim out = {.vertex = topo->boundary[edge][0]};
  const kg_vec3 o = topo->vertices[out.vertex];
  kg_vec3 doubled = {0.0, 0.0, 0.0}, sum = {0.0, 0.0, 0.0};
  do {
    const kg_vec3 a = kg_vec3_sub(topo->vertices[topo->boundary[edge][0]], o);
    const kg_vec3 b = kg_vec3_sub(topo->vertices[topo->boundary[edge][1]], o);
    const double length = kg_vec3_norm(kg_vec3_sub(b, a));
    out.length += length;
    sum = kg_vec3_add_scaled(sum, 0.5 * length, kg_vec3_add(a, b));
    doubled = kg_vec3_add(doubled, kg_vec3_cross(a, b));
    edge =
      topo->boundary[edge][1] == out.vertex ? -1 : take_from(topo, taken, topo->boundary[edge][1]);
  } while (edge >= 0);
  out.center = out.length > 0.0 ? kg_vec3_add_scaled(o, 1.0 / out.length, sum) : o;
  out.enclosed = 0.5 * kg_vec3_norm(doubled);
  return out;
}

static int collect_rims(const topology *topo, rim *rims, int *taken)
{
  int count = 0;
  qsort(topo->boundary, (size_t)topo->boundary_count, sizeof *topo->boundary, compare_starts);
  for (int k = 0; k < topo->boundary_count; k++) {
    for (int edge; (edge = take_from(topo, taken, topo->boundary[k][0])) >= 0;) {
      rims[count++] = walk(topo, taken, edge);
    }
  }
  return count;
}

static void add_faces(const topology *topo, int *parent, part *parts)
{
  for (int i = 0; i < topo->face_count; i++) {
    const int *k = topo->corner[i];
    const kg_vec3 a = topo->vertices[k[0]];
    part *of = &parts[find_root(parent, k[0])];
    of->area += 0.5 * kg_vec3_norm(kg_vec3_cross(kg_vec3_sub(topo->vertices[k[1]], a),
                                                 kg_vec3_sub(topo->vertices[k[2]], a)));
    of->faces++;
  }
}

/* A solid with gaps has three faces at least; two that are folded onto each other enclose nothing. */
static bool is_solid(const part *p)
{
  return p->faces > 2 && p->enclosed < GAP_SHARE * p->area;
}

static void say_rims(kg_mesh_report *report, const rim *gap, const rim *border)
{
  if (gap) {
    report_say(
      report,
      "hole: %d %s in a surface that is closed but for %s, the longest %.4g m round at "
      "(%.4g, %.4g, %.4g); until %s closed there is no inside, and nearby the sign, the side of "
      "the nearest triangle, may be wrong\n",
      report->gaps, word_for(report->gaps, "gap", "gaps"), word_for(report->gaps, "it", "them"),
      gap->length, gap->center.x, gap->center.y, gap->center.z,
      word_for(report->gaps, "it is", "they are"));
  }
  if (border) {
    report_say(report,
               "open: %d %s to one triangle only, on %d %s, the longest %.4g m round "
               "(%.4g, %.4g, %.4g); such a mesh has no inside, and the sign tells the side of the "
               "nearest triangle\n",
               report->boundary_edges,
               word_for(report->boundary_edges, "edge belongs", "edges belong"), report->borders,
               word_for(report->borders, "border", "borders"), border->length, border->center.x,
               border->center.y, border->center.z);
  }
}

bool boundary_describe(const topology *topo, kg_mesh_report *report, kg_arena *arena)
{
  if (topo->boundary_count == 0) return true;
  int *parent = KG_ARENA_ARRAY(arena, int, topo->vertex_count);
  part *parts = KG_ARENA_ARRAY(arena, part, topo->vertex_count);
  rim *rims = KG_ARENA_ARRAY(arena, rim, topo->boundary_count);
  int *taken = KG_ARENA_ARRAY(arena, int, topo->boundary_count);
  if (kg_arena_failed(arena)) return false;
  join_corners(topo, parent);
  add_faces(topo, parent, parts);
  const int count = collect_rims(topo, rims, taken);
  for (int k = 0; k < count; k++) {
    parts[find_root(parent, rims[k].vertex)].enclosed += rims[k].enclosed;
  }
  const rim *gap = NULL, *border = NULL;
  for (int k = 0; k < count; k++) {
    const bool solid = is_solid(&parts[find_root(parent, rims[k].vertex)]);
    const rim **longest = solid ? &gap : &border;
    report->gaps += solid;
    report->borders += !solid;
    if (!*longest || rims[k].length > (*longest)->length) *longest = &rims[k];
  }
  say_rims(report, gap, border);
  return true;
}
