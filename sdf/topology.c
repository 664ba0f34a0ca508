/* Cleaning and diagnosis of a triangle mesh: sort vertices, faces and edges, and count. */
#include "sdf/topology.h"

#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* A face is without area when its height is below this share of its longest edge: its normal would
 * be rounding noise. */
#define SLIVER 1e-8

/* ---- vertices ----------------------------------------------------------------------------------*/

typedef struct placed_vertex {
  double p[3];
  int index;
} placed_vertex;

static int compare_places(const placed_vertex *a, const placed_vertex *b)
{
  for (int i = 0; i < 3; i++) {
    if (a->p[i] != b->p[i]) return a->p[i] < b->p[i] ? -1 : 1;
  }
  return 0;
}

static int compare_vertices(const void *left, const void *right)
{
  const placed_vertex *a = left, *b = right;
  const int order = compare_places(a, b);
  return order != 0 ? order : (a->index > b->index) - (a->index < b->index);
}

/* merged[i] = the vertex that stands for vertex i: numbered by first appearance in the file */
static bool merge_vertices(topology *out, int *merged, const kg_vec3 *vertices, int count,
                           kg_arena *arena)
{
  placed_vertex *sorted = KG_ARENA_ARRAY(arena, placed_vertex, count);
  int *first = KG_ARENA_ARRAY(arena, int, count);
  out->vertices = KG_ARENA_ARRAY(arena, kg_vec3, count);
  if (kg_arena_failed(arena)) return false;
  for (int i = 0; i < count; i++) { /* + 0.0 makes -0 and 0 one place */
    sorted[i] = (placed_vertex){{vertices[i].x + 0.0, vertices[i].y + 0.0, vertices[i].z + 0.0}, i};
  }
  qsort(sorted, (size_t)count, sizeof *sorted, compare_vertices);
  for (int k = 0; k < count; k++) {
    const bool same = k > 0 && compare_places(&sorted[k - 1], &sorted[k]) == 0;
    first[sorted[k].index] = same ? first[sorted[k - 1].index] : sorted[k].index;
  }
  out->vertex_count = 0;
  for (int i = 0; i < count; i++) {
    if (first[i] == i) {
      out->vertices[out->vertex_count] = vertices[i];
      merged[i] = out->vertex_count++;
    } else {
      merged[i] = merged[first[i]];
    }
  }
  return true;
}

/* ---- faces -------------------------------------------------------------------------------------*/

typedef struct sorted_face {
  int v[3]; /* rotated so that the smallest comes first: orientation kept */
  int index;
} sorted_face;

static int compare_faces(const void *left, const void *right)
{
  const sorted_face *a = left, *b = right;
  for (int i = 0; i < 3; i++) {
    if (a->v[i] != b->v[i]) return a->v[i] < b->v[i] ? -1 : 1;
  }
  return (a->index > b->index) - (a->index < b->index);
}

static sorted_face rotate_face(const int v[3], int index)
{
  const int k = v[0] < v[1] ? (v[0] < v[2] ? 0 : 2) : (v[1] < v[2] ? 1 : 2);
  return (sorted_face){{v[k], v[(k + 1) % 3], v[(k + 2) % 3]}, index};
}

static kg_vec3 middle(const topology *topo, const int *v, int count)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int k = 0; k < count; k++) {
    sum = kg_vec3_add_scaled(sum, 1.0 / count, topo->vertices[v[k]]);
  }
  return sum;
}

/* Faces with three different corners, each once, in the order given. */
static bool collect_faces(topology *out, const int *merged, const int *triangles, int count,
                          kg_mesh_report *report, kg_arena *arena)
{
  sorted_face *sorted = KG_ARENA_ARRAY(arena, sorted_face, count);
  bool *dropped = KG_ARENA_ARRAY(arena, bool, count);
  out->corner = kg_arena_alloc(arena, (size_t)count, sizeof *out->corner);
  out->edge = kg_arena_alloc(arena, (size_t)count, sizeof *out->edge);
  out->source = KG_ARENA_ARRAY(arena, int, count);
  if (kg_arena_failed(arena)) return false;
  for (int i = 0; i < count; i++) {
    const int *t = &triangles[3 * (size_t)i];
    const int v[3] = {merged[t[0]], merged[t[1]], merged[t[2]]};
    sorted[i] = rotate_face(v, i);
    dropped[i] = v[0] == v[1] || v[1] == v[2] || v[2] == v[0];
    if (dropped[i] && report->degenerate++ == 0) out->degenerate_at = out->vertices[v[0]];
  }
  qsort(sorted, (size_t)count, sizeof *sorted, compare_faces);
  for (int k = 1; k < count; k++) {
    const bool same = memcmp(sorted[k].v, sorted[k - 1].v, sizeof sorted[k].v) == 0;
    if (same && !dropped[sorted[k].index]) {
      dropped[sorted[k].index] = true;
      if (report->duplicates++ == 0) out->duplicate_at = middle(out, sorted[k].v, 3);
    }
  }
  out->face_count = 0;
  for (int i = 0; i < count; i++) {
    if (!dropped[i]) {
      out->source[out->face_count] = i;
      int *corner = out->corner[out->face_count++];
      for (int k = 0; k < 3; k++) {
        corner[k] = merged[triangles[3 * (size_t)i + (size_t)k]];
      }
    }
  }
  return true;
}

/* ---- edges -------------------------------------------------------------------------------------*/

typedef struct half_edge {
  int low, high; /* vertices */
  int face, side;
  bool forward; /* from low to high */
} half_edge;

static int compare_edges(const void *left, const void *right)
{
  const half_edge *a = left, *b = right;
  if (a->low != b->low) return a->low < b->low ? -1 : 1;
  if (a->high != b->high) return a->high < b->high ? -1 : 1;
  if (a->face != b->face) return a->face < b->face ? -1 : 1;
  return (a->side > b->side) - (a->side < b->side);
}

/* an edge with its first half, how many there are and how many of them run from low to high */
static void count_edge(topology *out, kg_mesh_report *report, const half_edge *half, int uses,
                       int forward)
{
  const int ends[2] = {half->low, half->high};
  report->boundary_edges += uses == 1;
  if (uses > 2 && report->non_manifold_edges++ == 0) out->non_manifold_at = middle(out, ends, 2);
  if (uses == 2 && forward != 1 && report->inconsistent_edges++ == 0) {
    out->inconsistent_at = middle(out, ends, 2);
  }
}

static bool collect_boundary(topology *out, const half_edge *halves, size_t count, int edges,
                             kg_arena *arena)
{
  out->boundary = kg_arena_alloc(arena, (size_t)edges, sizeof *out->boundary);
  if (!out->boundary) return false;
  for (size_t k = 0; k < count; k++) {
    const half_edge *h = &halves[k];
    const bool alone = (k == 0 || h[-1].low != h->low || h[-1].high != h->high) &&
                       (k + 1 == count || h[1].low != h->low || h[1].high != h->high);
    if (alone) {
      int *edge = out->boundary[out->boundary_count++];
      edge[0] = h->forward ? h->low : h->high;
      edge[1] = h->forward ? h->high : h->low;
    }
  }
  return true;
}

static bool number_edges(topology *out, kg_mesh_report *report, kg_arena *arena)
{
  const size_t count = 3 * (size_t)out->face_count;
  half_edge *halves = KG_ARENA_ARRAY(arena, half_edge, count);
  if (!halves) return false;
  for (size_t k = 0; k < count; k++) {
    const int face = (int)(k / 3), side = (int)(k % 3);
    const int from = out->corner[face][side], to = out->corner[face][(side + 1) % 3];
    const bool forward = from < to;
    halves[k] = (half_edge){forward ? from : to, forward ? to : from, face, side, forward};
  }
  qsort(halves, count, sizeof *halves, compare_edges);
  bool balanced = true;
  out->edge_count = 0;
  for (size_t k = 0, end; k < count; k = end) {
    int forward = 0;
    for (end = k;
         end < count && halves[end].low == halves[k].low && halves[end].high == halves[k].high;
         end++) {
      forward += halves[end].forward;
      out->edge[halves[end].face][halves[end].side] = out->edge_count;
    }
    const int uses = (int)(end - k);
    count_edge(out, report, &halves[k], uses, forward);
    balanced = balanced && 2 * forward == uses;
    out->edge_count++;
  }
  /* every edge walked as often one way as the other: the faces enclose a volume */
  report->closed = out->is_closed = balanced;
  return collect_boundary(out, halves, count, report->boundary_edges, arena);
}

/* ---- shape -------------------------------------------------------------------------------------*/

/* sum of the tetrahedra from the first vertex, which keeps the numbers small far from the origin */
static double volume_of(const topology *topo)
{
  const kg_vec3 o = topo->vertices[0];
  double six = 0.0;
  for (int i = 0; i < topo->face_count; i++) {
    const int *k = topo->corner[i];
    const kg_vec3 a = kg_vec3_sub(topo->vertices[k[0]], o);
    const kg_vec3 b = kg_vec3_sub(topo->vertices[k[1]], o);
    six += kg_vec3_dot(kg_vec3_cross(a, b), kg_vec3_sub(topo->vertices[k[2]], o));
  }
  return six / 6.0;
}

static void turn_around(topology *topo)
{
  for (int i = 0; i < topo->face_count; i++) {
    int *corner = topo->corner[i], *edge = topo->edge[i];
    const int c = corner[1], e = edge[0];
    corner[1] = corner[2]; /* 0 2 1: edges 02, 21, 10 */
    corner[2] = c;
    edge[0] = edge[2];
    edge[2] = e;
  }
}

static bool is_sliver(const topology *topo, int face)
{
  const int *k = topo->corner[face];
  const kg_vec3 a = topo->vertices[k[0]], b = topo->vertices[k[1]], c = topo->vertices[k[2]];
  const kg_vec3 u = kg_vec3_sub(b, a), v = kg_vec3_sub(c, a), w = kg_vec3_sub(c, b);
  const double longest2 = fmax(kg_vec3_dot(u, u), fmax(kg_vec3_dot(v, v), kg_vec3_dot(w, w)));
  return !(kg_vec3_norm(kg_vec3_cross(u, v)) > SLIVER * longest2);
}

static void remove_slivers(topology *topo, kg_mesh_report *report)
{
  int kept = 0;
  for (int i = 0; i < topo->face_count; i++) {
    if (is_sliver(topo, i)) {
      if (report->degenerate++ == 0) topo->degenerate_at = middle(topo, topo->corner[i], 3);
      continue;
    }
    memmove(topo->corner[kept], topo->corner[i], sizeof *topo->corner);
    memmove(topo->edge[kept], topo->edge[i], sizeof *topo->edge);
    topo->source[kept] = topo->source[i];
    kept++;
  }
  topo->face_count = kept;
}

/* ---- report ------------------------------------------------------------------------------------*/

void report_say(kg_mesh_report *report, const char *format, ...)
{
  const size_t used = strlen(report->text);
  va_list args;
  va_start(args, format);
  vsnprintf(report->text + used, sizeof report->text - used, format, args);
  va_end(args);
}

static void describe(const topology *topo, kg_mesh_report *report)
{
  kg_vec3 at = topo->degenerate_at;
  if (report->degenerate > 0) {
    report_say(report, "%d triangles without area were removed, the first at (%.4g, %.4g, %.4g)\n",
               report->degenerate, at.x, at.y, at.z);
  }
  at = topo->duplicate_at;
  if (report->duplicates > 0) {
    report_say(report, "%d repeated triangles were removed, the first at (%.4g, %.4g, %.4g)\n",
               report->duplicates, at.x, at.y, at.z);
  }
  at = topo->non_manifold_at;
  if (report->non_manifold_edges > 0) {
    report_say(report,
               "not manifold: %d edges belong to more than two triangles, the first at (%.4g, "
               "%.4g, %.4g)%s\n",
               report->non_manifold_edges, at.x, at.y, at.z,
               report->closed ? "" : "; the sign near them may be wrong");
  }
  at = topo->inconsistent_at;
  if (report->inconsistent_edges > 0) {
    report_say(report,
               "inconsistent: at %d edges the two triangles face opposite ways, the first at "
               "(%.4g, %.4g, %.4g); the sign near them may be wrong\n",
               report->inconsistent_edges, at.x, at.y, at.z);
  }
  if (report->inside_out) {
    report_say(report, "inside out: the triangles faced inwards and were turned around\n");
  }
}

static kg_status check_input(const kg_vec3 *vertices, int vertex_count, const int *triangles,
                             int triangle_count, kg_error *error)
{
  if (triangle_count > INT_MAX / 4) {
    return kg_fail(error, KG_ERR_UNSUPPORTED, "", 0, 0, "%d triangles are too many",
                   triangle_count);
  }
  for (int i = 0; i < vertex_count; i++) {
    const kg_vec3 p = vertices[i];
    /* squares of distances must not overflow in floats either */
    if (!(fabs(p.x) < 1e18 && fabs(p.y) < 1e18 && fabs(p.z) < 1e18)) {
      return kg_fail(error, KG_ERR_FORMAT, "", 0, 0,
                     "vertex %d is not a usable point: (%g, %g, %g)", i + 1, p.x, p.y, p.z);
    }
  }
  for (size_t k = 0; k < 3 * (size_t)triangle_count; k++) {
    if (triangles[k] < 0 || triangles[k] >= vertex_count) {
      return kg_fail(error, KG_ERR_FORMAT, "", 0, 0,
                     "triangle %zu uses vertex %lld, expected 1 to %d (counted from 1)", k / 3 + 1,
                     (long long)triangles[k] + 1, vertex_count);
    }
  }
  return KG_OK;
}

kg_status topology_build(topology *out, const kg_vec3 *vertices, int vertex_count,
                         const int *triangles, int triangle_count, kg_mesh_report *report,
                         kg_arena *arena, kg_error *error)
{
  *report = (kg_mesh_report){0};
  *out = (topology){0};
  const kg_status status = check_input(vertices, vertex_count, triangles, triangle_count, error);
  if (status != KG_OK) return status;
  int *merged = KG_ARENA_ARRAY(arena, int, vertex_count);
  if (!merged || !merge_vertices(out, merged, vertices, vertex_count, arena) ||
      !collect_faces(out, merged, triangles, triangle_count, report, arena) ||
      !number_edges(out, report, arena)) {
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a mesh of %d triangles",
                   triangle_count);
  }
  remove_slivers(out, report);
  if (out->face_count == 0) {
    return kg_fail(error, KG_ERR_FORMAT, "", 0, 0, "no triangle with an area is left of %d",
                   triangle_count);
  }
  if (report->closed) {
    report->volume = volume_of(out);
    report->inside_out = report->volume < 0.0;
  }
  if (report->inside_out) {
    report->volume = -report->volume;
    turn_around(out);
  }
  report->vertices = out->vertex_count;
  report->triangles = out->face_count;
  describe(out, report);
  if (!boundary_describe(out, report, arena)) {
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a mesh of %d triangles",
                   triangle_count);
  }
  return KG_OK;
}
