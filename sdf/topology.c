/* Cleaning and diagnosis of a triangle mesh: equal vertices by a hash table, edges by their lower
 * vertex, and counts. */
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

static uint64_t bits_of(double value)
{
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  return bits;
}

/* the last step of MurmurHash3, public domain */
static uint64_t mixed(uint64_t h)
{
  h = (h ^ (h >> 33)) * 0xff51afd7ed558ccdu;
  h = (h ^ (h >> 33)) * 0xc4ceb9fe1a85ec53u;
  return h ^ (h >> 33);
}

/* + 0.0 makes -0 and 0 one place */
static uint64_t hash_of(kg_vec3 p)
{
  return mixed(bits_of(p.x + 0.0) + 3 * mixed(bits_of(p.y + 0.0) + 3 * mixed(bits_of(p.z + 0.0))));
}

static size_t table_size(size_t count)
{
  size_t size = 16;
  while (size < 2 * count) {
    size *= 2;
  }
  return size;
}

/* merged[i] = the vertex that stands for vertex i: numbered by first appearance in the file */
static bool merge_vertices(topology *out, int *merged, const kg_vec3 *vertices, int count,
                           kg_arena *scratch)
{
  const size_t size = table_size((size_t)count);
  int *table = KG_ARENA_ARRAY(scratch, int, size); /* 1 + vertex; 0: free */
  if (!table) return false;
  out->vertex_count = 0;
  for (int i = 0; i < count; i++) {
    const kg_vec3 p = vertices[i];
    size_t at = hash_of(p) & (size - 1);
    for (; table[at] != 0; at = (at + 1) & (size - 1)) {
      const kg_vec3 q = out->vertices[table[at] - 1];
      if (q.x == p.x && q.y == p.y && q.z == p.z) break;
    }
    if (table[at] == 0) {
      out->vertices[out->vertex_count++] = p;
      table[at] = out->vertex_count;
    }
    merged[i] = table[at] - 1;
  }
  return true;
}

/* ---- faces -------------------------------------------------------------------------------------*/

static kg_vec3 middle(const topology *topo, const int *v, int count)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int k = 0; k < count; k++) {
    sum = kg_vec3_add_scaled(sum, 1.0 / count, topo->vertices[v[k]]);
  }
  return sum;
}

/* Faces with three different corners, in the order given. */
static bool collect_faces(topology *out, const kg_vec3 *vertices, int vertex_count,
                          const int *triangles, int count, kg_mesh_report *report, kg_arena *arena,
                          kg_arena *scratch)
{
  int *merged = kg_arena_take(scratch, (size_t)vertex_count * sizeof *merged, 64);
  if (!merged || !merge_vertices(out, merged, vertices, vertex_count, scratch)) return false;
  const size_t bytes = (size_t)count * sizeof *out->corner;
  out->corner = kg_arena_take(arena, bytes, 64);
  out->across = kg_arena_take(arena, bytes, 64);
  out->source = kg_arena_take(arena, (size_t)count * sizeof *out->source, 64);
  if (kg_arena_failed(arena)) return false;
  out->face_count = 0;
  for (int i = 0; i < count; i++) {
    const int *t = &triangles[3 * (size_t)i];
    const int a = merged[t[0]], b = merged[t[1]], c = merged[t[2]];
    if (a == b || b == c || c == a) {
      if (report->degenerate++ == 0) out->degenerate_at = out->vertices[a];
      continue;
    }
    int *corner = out->corner[out->face_count];
    corner[0] = a;
    corner[1] = b;
    corner[2] = c;
    out->source[out->face_count++] = i;
  }
  return true;
}

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

/* Keeps face `from` as face `to` <= from. */
static void keep_face(topology *topo, int to, int from)
{
  memmove(topo->corner[to], topo->corner[from], sizeof *topo->corner);
  memmove(topo->across[to], topo->across[from], sizeof *topo->across);
  topo->source[to] = topo->source[from];
}

/* Each face once, the first one in the order given. */
static bool remove_duplicates(topology *topo, kg_mesh_report *report, kg_arena *scratch)
{
  const int count = topo->face_count;
  sorted_face *sorted = kg_arena_take(scratch, (size_t)count * sizeof *sorted, 64);
  bool *dropped = KG_ARENA_ARRAY(scratch, bool, count);
  if (kg_arena_failed(scratch)) return false;
  for (int i = 0; i < count; i++) {
    sorted[i] = rotate_face(topo->corner[i], i);
  }
  qsort(sorted, (size_t)count, sizeof *sorted, compare_faces);
  for (int k = 1; k < count; k++) {
    const bool same = memcmp(sorted[k].v, sorted[k - 1].v, sizeof sorted[k].v) == 0;
    dropped[sorted[k].index] = same;
    if (same && report->duplicates++ == 0) topo->duplicate_at = middle(topo, sorted[k].v, 3);
  }
  topo->face_count = 0;
  for (int i = 0; i < count; i++) {
    if (!dropped[i]) {
      keep_face(topo, topo->face_count++, i);
    }
  }
  return true;
}

/* ---- edges -------------------------------------------------------------------------------------
 *
 * Half-edges are put together by their lower vertex; the few of one vertex are compared with each
 * other. */

typedef struct half_edge {
  int high; /* vertex                                    */
  int of;   /* 2 (3 face + side) + (low to high ? 1 : 0) */
} half_edge;

enum { MANY_AT_A_VERTEX = 48 };

static int compare_edges(const void *left, const void *right)
{
  const half_edge *a = left, *b = right;
  if (a->high != b->high) return a->high < b->high ? -1 : 1;
  return (a->of > b->of) - (a->of < b->of);
}

/* first[v]: the first of the half-edges whose lower vertex is v; they end where those of v + 1
 * begin */
static void sort_half_edges(const topology *topo, half_edge *halves, int *first)
{
  for (int i = 0; i < topo->face_count; i++) {
    const int *c = topo->corner[i];
    for (int k = 0; k < 3; k++) {
      const int from = c[k], to = c[k == 2 ? 0 : k + 1];
      first[(from < to ? from : to) + 1]++;
    }
  }
  for (int v = 0; v < topo->vertex_count; v++) {
    first[v + 1] += first[v];
  }
  for (int i = topo->face_count - 1; i >= 0; i--) { /* from behind: first[v + 1] counts down */
    const int *c = topo->corner[i];
    for (int k = 2; k >= 0; k--) {
      const int from = c[k], to = c[k == 2 ? 0 : k + 1];
      const bool forward = from < to;
      halves[--first[(forward ? from : to) + 1]] =
        (half_edge){forward ? to : from, 2 * (3 * i + k) + forward};
    }
  }
}

/* What the half-edges [0, count) of one edge say. */
static void join_edge(const half_edge *halves, int count, int low, topology *out,
                      kg_mesh_report *report, bool *has_repeated)
{
  const int ends[2] = {low, halves[0].high};
  int forward = 0;
  for (int i = 0; i < count; i++) {
    const int half = halves[i].of / 2, other = halves[count == 2 ? 1 - i : i].of / 2;
    forward += halves[i].of & 1;
    out->across[half / 3][half % 3] = count > 2 ? ~out->odd_count : other / 3;
  }
  out->odd_count += count > 2;
  report->boundary_edges += count == 1;
  if (count > 2 && report->non_manifold_edges++ == 0) out->non_manifold_at = middle(out, ends, 2);
  if (count == 2 && forward != 1 && report->inconsistent_edges++ == 0) {
    out->inconsistent_at = middle(out, ends, 2);
  }
  out->is_closed = out->is_closed && 2 * forward == count;
  *has_repeated = *has_repeated || forward > 1 || count - forward > 1;
}

/* The half-edges [0, count) of one lower vertex, edge by edge. */
static void join_edges_of(half_edge *halves, int count, int low, topology *out,
                          kg_mesh_report *report, bool *has_repeated)
{
  if (count > MANY_AT_A_VERTEX) {
    qsort(halves, (size_t)count, sizeof *halves, compare_edges);
  }
  for (int k = 0, end; k < count; k = end) {
    end = k + 1;
    for (int i = end; i < count; i++) {
      if (halves[i].high == halves[k].high) {
        const half_edge same = halves[i];
        halves[i] = halves[end];
        halves[end++] = same;
      } else if (count > MANY_AT_A_VERTEX) {
        break; /* sorted */
      }
    }
    join_edge(&halves[k], end - k, low, out, report, has_repeated);
  }
}

/* has_repeated: some edge is walked twice the same way, as by repeated faces */
static bool join_edges(topology *out, kg_mesh_report *report, bool *has_repeated, kg_arena *scratch)
{
  half_edge *halves = kg_arena_take(scratch, 3 * (size_t)out->face_count * sizeof *halves, 64);
  int *first = KG_ARENA_ARRAY(scratch, int, out->vertex_count + 2);
  if (kg_arena_failed(scratch)) return false;
  sort_half_edges(out, halves, first);
  report->boundary_edges = report->non_manifold_edges = report->inconsistent_edges = 0;
  *has_repeated = false;
  out->is_closed = true; /* every edge walked as often one way as the other encloses a volume */
  out->odd_count = 0;
  for (int v = 0; v < out->vertex_count; v++) {
    const int begin = first[v + 1];
    const int end = v + 1 < out->vertex_count ? first[v + 2] : 3 * out->face_count;
    join_edges_of(&halves[begin], end - begin, v, out, report, has_repeated);
  }
  return true;
}

/* An edge with one face has that face on both sides. */
static bool collect_boundary(topology *out, int count, kg_arena *arena)
{
  out->boundary = kg_arena_alloc(arena, (size_t)count, sizeof *out->boundary);
  if (!out->boundary) return false;
  for (int i = 0; i < out->face_count && count > 0; i++) {
    for (int k = 0; k < 3; k++) {
      if (out->across[i][k] == i) {
        int *edge = out->boundary[out->boundary_count++];
        edge[0] = out->corner[i][k];
        edge[1] = out->corner[i][(k + 1) % 3];
      }
    }
  }
  return true;
}

/* Edges; repeated faces, which show in them, are removed first. */
static bool join_faces(topology *out, kg_mesh_report *report, kg_arena *arena, kg_arena *scratch)
{
  bool has_repeated;
  if (!join_edges(out, report, &has_repeated, scratch)) return false;
  if (has_repeated) {
    if (!remove_duplicates(out, report, scratch)) return false;
    if (report->duplicates > 0 && !join_edges(out, report, &has_repeated, scratch)) return false;
  }
  report->closed = out->is_closed;
  return collect_boundary(out, report->boundary_edges, arena);
}

/* ---- shape -------------------------------------------------------------------------------------*/

static void turn_around(topology *topo)
{
  for (int i = 0; i < topo->face_count; i++) {
    int *corner = topo->corner[i], *across = topo->across[i];
    const int c = corner[1], f = across[0];
    corner[1] = corner[2]; /* 0 2 1: edges 02, 21, 10 */
    corner[2] = c;
    across[0] = across[2];
    across[2] = f;
    topo->normal[i] = kg_vec3_scale(-1.0, topo->normal[i]);
  }
}

static inline kg_vec3 lower(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(a.x < b.x ? a.x : b.x, a.y < b.y ? a.y : b.y, a.z < b.z ? a.z : b.z);
}

static inline kg_vec3 upper(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(a.x > b.x ? a.x : b.x, a.y > b.y ? a.y : b.y, a.z > b.z ? a.z : b.z);
}

/* Of a face: its unit normal; its share in bounds and in six times the volume, a sum of tetrahedra
 * from the first vertex, which keeps the numbers small far from the origin. False when it has no
 * area. */
static bool measure_face(topology *topo, int face, kg_vec3 *normal, double *six_volumes)
{
  const int *k = topo->corner[face];
  const kg_vec3 a = topo->vertices[k[0]], b = topo->vertices[k[1]], c = topo->vertices[k[2]];
  const kg_vec3 u = kg_vec3_sub(b, a), v = kg_vec3_sub(c, a), w = kg_vec3_sub(c, b);
  const double longest2 = fmax(kg_vec3_dot(u, u), fmax(kg_vec3_dot(v, v), kg_vec3_dot(w, w)));
  const kg_vec3 n = kg_vec3_cross(u, v);
  const double norm = kg_vec3_norm(n);
  if (!(norm > SLIVER * longest2)) {
    return false;
  }
  *normal = kg_vec3_scale(1.0 / norm, n);
  *six_volumes += kg_vec3_dot(n, kg_vec3_sub(a, topo->vertices[0]));
  topo->lo = lower(topo->lo, lower(a, lower(b, c)));
  topo->hi = upper(topo->hi, upper(a, upper(b, c)));
  return true;
}

/* After faces have gone: new numbers; across an edge to one that is gone lies the face itself. */
static void renumber(topology *topo, const int *number)
{
  for (int i = 0; i < topo->face_count; i++) {
    for (int k = 0; k < 3; k++) {
      int *across = &topo->across[i][k];
      if (*across >= 0) {
        *across = number[*across] >= 0 ? number[*across] : i;
      }
    }
  }
}

/* Measures the faces; those without area are removed. */
static bool measure_faces(topology *topo, kg_mesh_report *report, double *six_volumes,
                          kg_arena *arena, kg_arena *scratch)
{
  const int count = topo->face_count;
  topo->normal = kg_arena_take(arena, (size_t)count * sizeof *topo->normal, 64);
  int *number = kg_arena_take(scratch, (size_t)count * sizeof *number, 64);
  if (kg_arena_failed(arena) || kg_arena_failed(scratch)) return false;
  topo->lo = kg_vec3_make(INFINITY, INFINITY, INFINITY);
  topo->hi = kg_vec3_scale(-1.0, topo->lo);
  *six_volumes = 0.0;
  int kept = 0;
  for (int i = 0; i < count; i++) {
    const bool has_area = measure_face(topo, i, &topo->normal[kept], six_volumes);
    number[i] = has_area ? kept : -1;
    if (!has_area && report->degenerate++ == 0) {
      topo->degenerate_at = middle(topo, topo->corner[i], 3);
    }
    if (has_area && kept != i) {
      keep_face(topo, kept, i);
    }
    kept += has_area;
  }
  topo->face_count = kept;
  if (kept < count) {
    renumber(topo, number);
  }
  return true;
}

/* Sums of the normals at the edges of more than two faces. */
static bool sum_odd_edges(topology *topo, kg_arena *arena)
{
  topo->odd_normals = KG_ARENA_ARRAY(arena, kg_vec3, topo->odd_count);
  if (!topo->odd_normals) return false;
  for (int i = 0; i < topo->face_count && topo->odd_count > 0; i++) {
    for (int k = 0; k < 3; k++) {
      if (topo->across[i][k] < 0) {
        kg_vec3 *sum = &topo->odd_normals[~topo->across[i][k]];
        *sum = kg_vec3_add(*sum, topo->normal[i]);
      }
    }
  }
  return true;
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
    report_say(
      report, "%d %s removed, the first at (%.4g, %.4g, %.4g)\n", report->degenerate,
      word_for(report->degenerate, "triangle without area was", "triangles without area were"),
      at.x, at.y, at.z);
  }
  at = topo->duplicate_at;
  if (report->duplicates > 0) {
    report_say(report, "%d repeated %s removed, the first at (%.4g, %.4g, %.4g)\n",
               report->duplicates, word_for(report->duplicates, "triangle was", "triangles were"),
               at.x, at.y, at.z);
  }
  at = topo->non_manifold_at;
  if (report->non_manifold_edges > 0) {
    report_say(
      report, "not manifold: %d %s to more than two triangles, the first at (%.4g, %.4g, %.4g)%s\n",
      report->non_manifold_edges,
      word_for(report->non_manifold_edges, "edge belongs", "edges belong"), at.x, at.y, at.z,
      report->closed ? "" : "; the sign nearby may be wrong");
  }
  at = topo->inconsistent_at;
  if (report->inconsistent_edges > 0) {
    report_say(report,
               "inconsistent: at %d %s the two triangles face opposite ways, the first at "
               "(%.4g, %.4g, %.4g); the sign nearby may be wrong\n",
               report->inconsistent_edges, word_for(report->inconsistent_edges, "edge", "edges"),
               at.x, at.y, at.z);
  }
  if (report->inside_out) {
    report_say(report, "inside out: the triangles faced inwards and were turned around\n");
  }
}

static kg_status check_input(const kg_vec3 *vertices, int vertex_count, const int *triangles,
                             int triangle_count, kg_error *error)
{
  if (triangle_count > INT_MAX / 8) {
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
                         kg_arena *arena, kg_arena *scratch, kg_error *error)
{
  *report = (kg_mesh_report){0};
  *out = (topology){0};
  const kg_status status = check_input(vertices, vertex_count, triangles, triangle_count, error);
  if (status != KG_OK) return status;
  out->vertices = kg_arena_take(scratch, (size_t)vertex_count * sizeof *out->vertices, 64);
  const kg_arena_mark mark = kg_arena_mark_of(scratch);
  double six_volumes;
  if (!out->vertices ||
      !collect_faces(out, vertices, vertex_count, triangles, triangle_count, report, arena,
                     scratch) ||
      !join_faces(out, report, arena, scratch) ||
      !measure_faces(out, report, &six_volumes, arena, scratch)) {
    return KG_ERR_NO_MEMORY;
  }
  kg_arena_rewind(scratch, mark);
  if (out->face_count == 0) {
    return kg_fail(error, KG_ERR_FORMAT, "", 0, 0, "no triangle with an area is left of %d",
                   triangle_count);
  }
  if (report->closed) {
    report->volume = fabs(six_volumes) / 6.0;
    report->inside_out = six_volumes < 0.0;
  }
  if (report->inside_out) {
    turn_around(out);
  }
  if (!sum_odd_edges(out, arena)) return KG_ERR_NO_MEMORY;
  report->vertices = out->vertex_count;
  report->triangles = out->face_count;
  describe(out, report);
  return boundary_describe(out, report, scratch) ? KG_OK : KG_ERR_NO_MEMORY;
}
