/* Triangle meshes: building, and exact signed distance through a hierarchy of boxes.
 *
 *   a, u, v   corner of a triangle and its edges u = b - a, v = c - a
 *   n         unit face normal, u x v / |u x v|
 *   c(x)      closest point of the surface; the feature it lies on: a corner, an edge or the face
 *   N         pseudo-normal of the feature: a face's n, the sum of n over an edge's faces, the sum
 *             of (corner angle) n over a vertex' faces
 *   Phi       = sign(N . (x - c)) |x - c|                                            [BAER]
 *
 * Closest point: Voronoi regions of the triangle from the six products of x - corner with u and v
 * [ERIC] C. Ericson, Real-Time Collision Detection, Morgan Kaufmann 2005, section 5.1.5. */
#include "kinegrad/mesh.h"

#include "sdf/bvh.h"
#include "sdf/crossings.h"
#include "sdf/feature.h"
#include "sdf/mesh_create.h"
#include "sdf/topology.h"

#include <string.h>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

/* What the closest-point test reads; two cache lines. */
typedef struct triangle {
  kg_vec3 a, u, v, n;
  double uu, uv, vv; /* u.u, u.v, v.v */
  double unused;
} triangle;

typedef enum feature {
  CORNER_A,
  CORNER_B,
  CORNER_C, /* in the order of topology.corner */
  EDGE_AB,
  EDGE_BC,
  EDGE_CA, /* in the order of topology.edge   */
  FACE
} feature;

struct kg_mesh {
  kg_arena arena;
  int triangle_count;
  triangle *triangles; /* (triangle_count) in leaf order                    */
  int (*corner)[3];    /* (triangle_count) vertex of each corner            */
  int (*edge)[3];      /* (triangle_count) edges ab, bc, ca                 */
  int *source;         /* (triangle_count) number in the input              */
  kg_vec3 lo, hi;      /* bounding box                                      */
  bool is_closed;
  kg_vec3 *vertex_normals; /* pseudo-normals, unit or zero                      */
  kg_vec3 *edge_normals;
  bvh tree;
};

/* ---- queries ---------------------------------------------------------------------------------- */

typedef struct closest {
  double distance2;
  int triangle; /* -1: none yet */
  feature on;
  kg_vec3 d; /* x - c(x)     */
} closest;

/* x - c and the feature c lies on */
static feature closest_on_triangle(const triangle *t, kg_vec3 x, kg_vec3 *d)
{
  const kg_vec3 p = kg_vec3_sub(x, t->a);
  const double d1 = kg_vec3_dot(t->u, p), d2 = kg_vec3_dot(t->v, p); /* seen from a */
  if (d1 <= 0.0 && d2 <= 0.0) {
    *d = p;
    return CORNER_A;
  }
  const double d3 = d1 - t->uu, d4 = d2 - t->uv; /* from b */
  if (d3 >= 0.0 && d4 <= d3) {
    *d = kg_vec3_sub(p, t->u);
    return CORNER_B;
  }
  if (d1 * d4 - d3 * d2 <= 0.0 && d1 >= 0.0 && d3 <= 0.0) {
    *d = kg_vec3_add_scaled(p, -d1 / t->uu, t->u);
    return EDGE_AB;
  }
  const double d5 = d1 - t->uv, d6 = d2 - t->vv; /* from c */
  if (d6 >= 0.0 && d5 <= d6) {
    *d = kg_vec3_sub(p, t->v);
    return CORNER_C;
  }
  if (d5 * d2 - d1 * d6 <= 0.0 && d2 >= 0.0 && d6 <= 0.0) {
    *d = kg_vec3_add_scaled(p, -d2 / t->vv, t->v);
    return EDGE_CA;
  }
  const double to_c = d4 - d3, to_b = d5 - d6; /* along bc, from b and from c */
  if (d3 * d6 - d5 * d4 <= 0.0 && to_c >= 0.0 && to_b >= 0.0) {
    const kg_vec3 w = kg_vec3_sub(t->v, t->u);
    *d = kg_vec3_add_scaled(kg_vec3_sub(p, t->u), -to_c / (to_c + to_b), w);
    return EDGE_BC;
  }
  *d = kg_vec3_scale(kg_vec3_dot(t->n, p), t->n);
  return FACE;
}

/* Among equals the smallest number of the input counts, whatever the order they are met in. */
static void keep_closer(const kg_mesh *mesh, closest *best, const closest *other)
{
  const bool tie = other->distance2 == best->distance2 && best->triangle >= 0 &&
                   mesh->source[other->triangle] < mesh->source[best->triangle];
  if (other->distance2 < best->distance2 || tie) {
    *best = *other;
  }
}

static void visit_leaf(const kg_mesh *mesh, int first, int count, kg_vec3 x, closest *best)
{
  for (int k = first; k < first + count; k++) {
    kg_vec3 d;
    const feature on = closest_on_triangle(&mesh->triangles[k], x, &d);
    keep_closer(mesh, best, &(closest){kg_vec3_dot(d, d), k, on, d});
  }
}

/* From here on (m) a mesh is a point. */
#define FAR_AWAY 1e18

/* The roundings of a squared distance in floats add up to less than 5e-7 of it. */
#define ROUNDED 0.9999990f

/* x as an interval of floats, and the squared distances to four boxes, never too large */
typedef struct float_point {
  float lo[3], hi[3];
} float_point;

static float_point as_floats(kg_vec3 x)
{
  const double v[3] = {x.x, x.y, x.z};
  float_point out;
  for (int i = 0; i < 3; i++) {
    const float f = (float)v[i], slack = 1.2e-7f * fabsf(f) + 1e-37f; /* over one rounding */
    out.lo[i] = f - slack;
    out.hi[i] = f + slack;
  }
  return out;
}

#if defined(__SSE2__)
static inline void box_distances(const bvh_node *node, const float_point *x, float out[BVH_WIDTH])
{
  __m128 sum = _mm_setzero_ps();
  for (int i = 0; i < 3; i++) {
    const __m128 under = _mm_sub_ps(_mm_load_ps(node->lo[i]), _mm_set1_ps(x->hi[i]));
    const __m128 over = _mm_sub_ps(_mm_set1_ps(x->lo[i]), _mm_load_ps(node->hi[i]));
    const __m128 outside = _mm_max_ps(_mm_max_ps(under, over), _mm_setzero_ps());
    sum = _mm_add_ps(sum, _mm_mul_ps(outside, outside));
  }
  _mm_storeu_ps(out, _mm_mul_ps(_mm_set1_ps(ROUNDED), sum));
}
#else
static inline void box_distances(const bvh_node *node, const float_point *x, float out[BVH_WIDTH])
{
  for (int k = 0; k < BVH_WIDTH; k++) {
    float sum = 0.0f;
    for (int i = 0; i < 3; i++) {
      const float under = node->lo[i][k] - x->hi[i], over = x->lo[i] - node->hi[i][k];
      const float gap = under > over ? under : over;
      const float outside = gap > 0.0f ? gap : 0.0f;
      sum += outside * outside;
    }
    out[k] = ROUNDED * sum;
  }
}
#endif

typedef struct waiting {
  float distance2;
  int child, count;
} waiting;

/* Depth first, nearest box first. best: what is known already. */
static closest find_closest(const kg_mesh *mesh, kg_vec3 x, closest best)
{
  const float_point point = as_floats(x);
  waiting stack[BVH_STACK];
  int top = 0;
  stack[top++] = (waiting){0.0f, 0, 0};
  while (top > 0) {
    const waiting item = stack[--top];
    if (!((double)item.distance2 <= best.distance2)) continue;
    if (item.count > 0) {
      visit_leaf(mesh, item.child, item.count, x, &best);
      continue;
    }
    const bvh_node *node = &mesh->tree.nodes[item.child];
    float distance2[BVH_WIDTH];
    box_distances(node, &point, distance2);
    const int base = top;
    for (int k = 0; k < BVH_WIDTH; k++) {
      if (node->count[k] < 0 || !((double)distance2[k] <= best.distance2)) continue;
      int at = top++; /* keep the nearest on top */
      for (; at > base && stack[at - 1].distance2 < distance2[k]; at--) {
        stack[at] = stack[at - 1];
      }
      stack[at] = (waiting){distance2[k], node->child[k], node->count[k]};
    }
  }
  return best;
}

static kg_vec3 edge_direction(const triangle *t, feature on)
{
  const kg_vec3 e = on == EDGE_AB ? t->u : on == EDGE_CA ? t->v : kg_vec3_sub(t->v, t->u);
  return kg_vec3_normalized(e);
}

static closest nothing_within(double limit)
{
  return (closest){limit * limit, -1, FACE, {0.0, 0.0, 0.0}};
}

/* The distance to one triangle is a first bound. */
static void try_hint(const kg_mesh *mesh, kg_vec3 x, const kg_mesh_hint *hint, closest *best)
{
  if (hint && hint->triangle >= 0 && hint->triangle < mesh->triangle_count) {
    visit_leaf(mesh, hint->triangle, 1, x, best);
  }
}

static bool is_searchable(kg_vec3 x)
{
  /* squares of distances must not overflow in floats */
  return fabs(x.x) < FAR_AWAY && fabs(x.y) < FAR_AWAY && fabs(x.z) < FAR_AWAY;
}

static double far_component(double c, double largest)
{
  return isinf(largest) ? (isinf(c) ? copysign(1.0, c) : 0.0) : c / largest;
}

/* Value of a point that is not searchable. */
static kg_sdf_value far_value(kg_vec3 x)
{
  if (isnan(x.x) || isnan(x.y) || isnan(x.z)) {
    return (kg_sdf_value){NAN, {0.0, 1.0, 0.0}, {0.0}};
  }
  const double largest = fmax(fabs(x.x), fmax(fabs(x.y), fabs(x.z)));
  const kg_vec3 d = {far_component(x.x, largest), far_component(x.y, largest),
                     far_component(x.z, largest)};
  return (kg_sdf_value){largest * kg_vec3_norm(d), kg_vec3_normalized(d), {0.0}};
}

/* Beside its box a closed mesh has no inside. From afar all triangles are equally near but for
 * rounding, and the side of any one says nothing. */
static bool is_surely_outside(const kg_mesh *mesh, kg_vec3 x)
{
  const kg_vec3 lo = mesh->lo, hi = mesh->hi;
  return mesh->is_closed &&
         (x.x < lo.x || x.y < lo.y || x.z < lo.z || x.x > hi.x || x.y > hi.y || x.z > hi.z);
}

static kg_sdf_value negated(kg_sdf_value v)
{
  v.distance = -v.distance;
  v.normal = kg_vec3_scale(-1.0, v.normal);
  for (int i = 0; i < 6; i++) {
    v.hessian[i] = -v.hessian[i];
  }
  return v;
}

/* Value at x, whose closest point is known. */
static kg_sdf_value value_of(const kg_mesh *mesh, kg_vec3 x, const closest *best)
{
  const triangle *t = &mesh->triangles[best->triangle];
  if (best->on == FACE) {
    const double height = kg_vec3_dot(t->n, kg_vec3_sub(x, t->a));
    const kg_sdf_value out = {height, t->n, {0.0}};
    return height < 0.0 && is_surely_outside(mesh, x) ? negated(out) : out;
  }
  const bool edge = best->on >= EDGE_AB;
  const kg_vec3 N = edge ? mesh->edge_normals[mesh->edge[best->triangle][best->on - EDGE_AB]]
                         : mesh->vertex_normals[mesh->corner[best->triangle][best->on - CORNER_A]];
  const kg_vec3 along = edge ? edge_direction(t, best->on) : kg_vec3_make(0.0, 0.0, 0.0);
  const kg_sdf_value out = edge_feature(best->d, along, kg_vec3_dot(N, N) > 0.0 ? N : t->n);
  if (!(kg_vec3_dot(N, best->d) < 0.0) || is_surely_outside(mesh, x)) {
    return out;
  }
  if (out.distance < FEATURE_TINY) { /* the fallback normal already points outwards */
    return (kg_sdf_value){-out.distance, out.normal, {0.0}};
  }
  return negated(out);
}

bool kg_mesh_distance_within(const kg_mesh *mesh, kg_vec3 x, double limit, kg_mesh_hint *hint,
                             kg_sdf_value *value)
{
  if (!(limit > 0.0)) {
    return false;
  }
  if (!is_searchable(x)) {
    const kg_sdf_value far = far_value(x);
    const bool is_within = !(far.distance >= limit) || isinf(limit);
    if (is_within) {
      *value = far;
    }
    return is_within;
  }
  closest best = nothing_within(limit);
  try_hint(mesh, x, hint, &best);
  best = find_closest(mesh, x, best);
  if (best.triangle < 0) {
    return false;
  }
  if (hint) {
    hint->triangle = best.triangle;
  }
  *value = value_of(mesh, x, &best);
  return true;
}

kg_sdf_value kg_mesh_distance_from(const kg_mesh *mesh, kg_vec3 x, kg_mesh_hint *hint)
{
  kg_sdf_value value = {NAN, {0.0, 1.0, 0.0}, {0.0}};
  const bool is_found = kg_mesh_distance_within(mesh, x, INFINITY, hint, &value);
  KG_ASSERT(is_found || !is_searchable(x));
  (void)is_found;
  return value;
}

kg_sdf_value kg_mesh_distance(const kg_mesh *mesh, kg_vec3 x)
{
  return kg_mesh_distance_from(mesh, x, NULL);
}

void kg_mesh_distance_many(const kg_mesh *mesh, int count, const kg_vec3 *x, kg_mesh_hint *hints,
                           kg_sdf_value *values)
{
  for (int i = 0; i < count; i++) {
    values[i] = kg_mesh_distance_from(mesh, x[i], hints ? &hints[i] : NULL);
  }
}

kg_mesh_hit kg_mesh_closest(const kg_mesh *mesh, kg_vec3 x)
{
  if (!is_searchable(x)) {
    const kg_sdf_value far = far_value(x);
    return (kg_mesh_hit){far.distance, {0.0, 0.0, 0.0}, far.normal, -1, KG_MESH_VERTEX};
  }
  const closest best = find_closest(mesh, x, nothing_within(INFINITY));
  const kg_sdf_value value = value_of(mesh, x, &best);
  const kg_mesh_feature on = best.on == FACE      ? KG_MESH_FACE
                             : best.on >= EDGE_AB ? KG_MESH_EDGE
                                                  : KG_MESH_VERTEX;
  return (kg_mesh_hit){value.distance, kg_vec3_sub(x, best.d), value.normal,
                       mesh->source[best.triangle], on};
}

bool kg_mesh_touches_ball(const kg_mesh *mesh, kg_vec3 center, double radius)
{
  kg_sdf_value value;
  return kg_mesh_distance_within(mesh, center, radius, NULL, &value);
}

void kg_mesh_bounds(const kg_mesh *mesh, kg_vec3 *lo, kg_vec3 *hi)
{
  *lo = mesh->lo;
  *hi = mesh->hi;
}

/* ---- building --------------------------------------------------------------------------------- */

static void fill_triangle(triangle *t, const topology *topo, int face)
{
  const int *k = topo->corner[face];
  const kg_vec3 a = topo->vertices[k[0]];
  const kg_vec3 u = kg_vec3_sub(topo->vertices[k[1]], a);
  const kg_vec3 v = kg_vec3_sub(topo->vertices[k[2]], a);
  *t = (triangle){.a = a, .u = u, .v = v, .n = kg_vec3_normalized(kg_vec3_cross(u, v))};
  t->uu = kg_vec3_dot(u, u);
  t->uv = kg_vec3_dot(u, v);
  t->vv = kg_vec3_dot(v, v);
}

static double angle_between(kg_vec3 a, kg_vec3 b)
{
  return atan2(kg_vec3_norm(kg_vec3_cross(a, b)), kg_vec3_dot(a, b));
}

/* [BAER] section 3: every face counts once for its edges, with its angle for its corners */
static void add_pseudo_normals(kg_mesh *mesh, const triangle *t, int k)
{
  const kg_vec3 w = kg_vec3_sub(t->v, t->u), back = kg_vec3_scale(-1.0, t->u);
  const double angle[3] = {angle_between(t->u, t->v), angle_between(back, w), 0.0};
  for (int i = 0; i < 3; i++) {
    const double share = i < 2 ? angle[i] : acos(-1.0) - angle[0] - angle[1];
    kg_vec3 *at = &mesh->vertex_normals[mesh->corner[k][i]];
    *at = kg_vec3_add_scaled(*at, share, t->n);
    at = &mesh->edge_normals[mesh->edge[k][i]];
    *at = kg_vec3_add(*at, t->n);
  }
}

static kg_vec3 lower(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(fmin(a.x, b.x), fmin(a.y, b.y), fmin(a.z, b.z));
}

static kg_vec3 upper(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_make(fmax(a.x, b.x), fmax(a.y, b.y), fmax(a.z, b.z));
}

static bvh_box triangle_box(const topology *topo, int face)
{
  const kg_vec3 a = topo->vertices[topo->corner[face][0]];
  bvh_box box = {a, a};
  for (int i = 1; i < 3; i++) {
    const kg_vec3 b = topo->vertices[topo->corner[face][i]];
    box.lo = lower(box.lo, b);
    box.hi = upper(box.hi, b);
  }
  return box;
}

static bool build_tree(kg_mesh *mesh, const topology *topo, kg_arena *scratch)
{
  bvh_box *boxes = KG_ARENA_ARRAY(scratch, bvh_box, topo->face_count);
  if (!boxes) return false;
  for (int i = 0; i < topo->face_count; i++) {
    boxes[i] = triangle_box(topo, i);
    mesh->lo = i == 0 ? boxes[i].lo : lower(mesh->lo, boxes[i].lo);
    mesh->hi = i == 0 ? boxes[i].hi : upper(mesh->hi, boxes[i].hi);
  }
  return bvh_build(&mesh->tree, boxes, topo->face_count, &mesh->arena, scratch);
}

static bool fill_mesh(kg_mesh *mesh, const topology *topo, kg_arena *scratch)
{
  mesh->is_closed = topo->is_closed;
  const int count = topo->face_count;
  mesh->triangle_count = count;
  mesh->triangles = KG_ARENA_ARRAY(&mesh->arena, triangle, count);
  mesh->corner = kg_arena_alloc(&mesh->arena, (size_t)count, sizeof *mesh->corner);
  mesh->edge = kg_arena_alloc(&mesh->arena, (size_t)count, sizeof *mesh->edge);
  mesh->source = KG_ARENA_ARRAY(&mesh->arena, int, count);
  mesh->vertex_normals = KG_ARENA_ARRAY(&mesh->arena, kg_vec3, topo->vertex_count);
  mesh->edge_normals = KG_ARENA_ARRAY(&mesh->arena, kg_vec3, topo->edge_count);
  if (kg_arena_failed(&mesh->arena) || !build_tree(mesh, topo, scratch)) return false;
  for (int k = 0; k < count; k++) {
    const int face = mesh->tree.order[k];
    memcpy(mesh->corner[k], topo->corner[face], sizeof *mesh->corner);
    memcpy(mesh->edge[k], topo->edge[face], sizeof *mesh->edge);
    mesh->source[k] = topo->source[face];
    fill_triangle(&mesh->triangles[k], topo, face);
    add_pseudo_normals(mesh, &mesh->triangles[k], k);
  }
  for (int i = 0; i < topo->vertex_count; i++) {
    mesh->vertex_normals[i] = kg_vec3_normalized(mesh->vertex_normals[i]);
  }
  for (int i = 0; i < topo->edge_count; i++) {
    mesh->edge_normals[i] = kg_vec3_normalized(mesh->edge_normals[i]);
  }
  return true;
}

kg_status mesh_create(kg_mesh **mesh, const kg_vec3 *vertices, int vertex_count,
                      const int *triangles, int triangle_count, bool search_crossings,
                      kg_mesh_report *report, const kg_allocator *allocator, kg_error *error)
{
  *mesh = NULL;
  kg_arena arena, scratch;
  kg_arena_init(&arena, allocator);
  kg_arena_init(&scratch, allocator);
  topology topo;
  kg_status status = topology_build(&topo, vertices, vertex_count, triangles, triangle_count,
                                    report, &scratch, error);
  if (status == KG_OK) {
    kg_mesh *built = KG_ARENA_ARRAY(&arena, kg_mesh, 1);
    if (built) {
      built->arena = arena;
    }
    if (built && fill_mesh(built, &topo, &scratch) &&
        (!search_crossings || crossings_describe(&topo, report, &scratch))) {
      *mesh = built;
    } else {
      status = kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a mesh of %d triangles",
                       triangle_count);
      if (built) {
        arena = built->arena;
      }
      kg_arena_release(&arena);
    }
  }
  kg_arena_release(&scratch);
  return status;
}

kg_status kg_mesh_create(kg_mesh **mesh, const kg_vec3 *vertices, int vertex_count,
                         const int *triangles, int triangle_count, kg_mesh_report *report,
                         const kg_allocator *allocator, kg_error *error)
{
  KG_ASSERT(mesh && vertex_count >= 0 && triangle_count >= 0);
  kg_mesh_report unused;
  return mesh_create(mesh, vertices, vertex_count, triangles, triangle_count, false,
                     report ? report : &unused, allocator, error);
}

void kg_mesh_destroy(kg_mesh *mesh)
{
  if (mesh) {
    kg_arena arena = mesh->arena; /* the mesh lives in its own arena */
    kg_arena_release(&arena);
  }
}
