/* Triangle meshes: exact signed distance through a hierarchy of boxes (sdf/bvh.h); building is in
 * sdf/mesh_build.c.
 *
 *   a, u, v   corner of a triangle and its edges u = b - a, v = c - a
 *   n         face normal, u x v
 *   c(x)      closest point of the surface; the feature it lies on: a corner, an edge or the face
 *   N         pseudo-normal of the feature: a face's unit n, the sum of those over an edge's faces,
 *             the sum of (corner angle) times them over a vertex' faces
 *   Phi       = sign(N . (x - c)) |x - c|                                            [BAER]
 *
 * sdf/kernels/search.c finds the closest triangle. */
#include "sdf/feature.h"
#include "sdf/mesh_internal.h"

/* From here on (m) a mesh is a point. */
#define FAR_AWAY 1e18

/* Where the smallest barycentric coordinate is above that, edges need no look. */
#define NEAR_EDGE 1e-6

/* A point within 2e-16 of the coordinates from an edge is on it (squared). */
#define ON_EDGE 4e-32

/* Sums of unit normals below that are rounding noise. */
#define FOLDED 1e-14

typedef enum feature {
  CORNER_A,
  CORNER_B,
  CORNER_C, /* in the order of corner[] */
  EDGE_AB,
  EDGE_BC,
  EDGE_CA, /* in the order of edge[]   */
  FACE
} feature;

/* ---- the closest triangle -------------------------------------------------------------------- */

typedef struct triangle {
  kg_vec3 a, u, v;
} triangle;

typedef struct closest {
  int slot;
  triangle of;
  feature on;
  kg_vec3 d; /* x - c(x) */
} closest;

static triangle triangle_in(const bvh *tree, int slot)
{
  const bvh_packet *p = &tree->packets[slot / BVH_LEAF];
  const int k = slot % BVH_LEAF;
  return (triangle){{p->a[0][k], p->a[1][k], p->a[2][k]},
                    {p->u[0][k], p->u[1][k], p->u[2][k]},
                    {p->v[0][k], p->v[1][k], p->v[2][k]}};
}

/* To an edge e from p, which is seen from the edge's start; its ends count as corners. */
static double try_edge(closest *c, kg_vec3 p, kg_vec3 e, const feature on[3], double least)
{
  const double t = fmin(fmax(kg_vec3_dot(p, e) / kg_vec3_dot(e, e), 0.0), 1.0);
  const kg_vec3 d = kg_vec3_sub(p, kg_vec3_scale(t, e));
  const double distance2 = kg_vec3_dot(d, d);
  if (!(distance2 < least)) {
    return least;
  }
  c->d = d;
  c->on = t <= 0.0 ? on[0] : t >= 1.0 ? on[2] : on[1];
  return distance2;
}

/* The closest point of a triangle, by the arithmetic of the search. */
static closest closest_in(const kg_mesh *mesh, int slot, kg_vec3 x)
{
  static const feature ab[3] = {CORNER_A, EDGE_AB, CORNER_B}, ac[3] = {CORNER_A, EDGE_CA, CORNER_C},
                       bc[3] = {CORNER_B, EDGE_BC, CORNER_C};
  closest c = {.slot = slot, .of = triangle_in(&mesh->tree, slot)};
  const kg_vec3 u = c.of.u, v = c.of.v, p = kg_vec3_sub(x, c.of.a);
  const kg_vec3 n = kg_vec3_cross(u, v);
  const double nn = kg_vec3_dot(n, n), s = kg_vec3_dot(n, kg_vec3_cross(p, v));
  const double t = kg_vec3_dot(n, kg_vec3_cross(u, p));
  const double nearest = fmin(fmin(s, t), nn - s - t); /* to leaving the face */
  double least = INFINITY;
  if (!(nearest > NEAR_EDGE * nn)) {
    least = try_edge(&c, p, u, ab, least);
    least = try_edge(&c, p, v, ac, least);
    least = try_edge(&c, kg_vec3_sub(p, u), kg_vec3_sub(v, u), bc, least);
  }
  const double size2 = kg_vec3_dot(x, x) + kg_vec3_dot(u, u) + kg_vec3_dot(v, v);
  if (nearest > 0.0 && least > ON_EDGE * size2) {
    c.on = FACE;
    c.d = kg_vec3_scale(kg_vec3_dot(n, p) / nn, n);
  }
  return c;
}

static kg_vec3 edge_direction(const closest *c)
{
  const triangle *t = &c->of;
  const kg_vec3 e = c->on == EDGE_AB ? t->u : c->on == EDGE_CA ? t->v : kg_vec3_sub(t->v, t->u);
  return kg_vec3_normalized(e);
}

/* ---- its value ------------------------------------------------------------------------------- */

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
  const kg_vec3 lo = mesh->tree.lo, hi = mesh->tree.hi;
  return mesh->is_closed &&
         (x.x < lo.x || x.y < lo.y || x.z < lo.z || x.x > hi.x || x.y > hi.y || x.z > hi.z);
}

static kg_vec3 edge_normal(const kg_mesh *mesh, int face, int side)
{
  const int across = mesh->across[face][side];
  return across < 0 ? mesh->odd_normals[~across]
                    : kg_vec3_add(mesh->normal[face], mesh->normal[across]);
}

/* Of an edge or a corner. */
static kg_vec3 pseudo_normal(const kg_mesh *mesh, const closest *c)
{
  const int face = mesh->tree.face[c->slot];
  return c->on >= EDGE_AB ? edge_normal(mesh, face, (int)(c->on - EDGE_AB))
                          : mesh->vertex_normals[mesh->corner[face][c->on - CORNER_A]];
}

/* Value at x, whose closest point is known. */
static kg_sdf_value value_of(const kg_mesh *mesh, kg_vec3 x, const closest *c)
{
  const kg_vec3 n = kg_vec3_normalized(kg_vec3_cross(c->of.u, c->of.v));
  if (c->on == FACE) {
    const double height = kg_vec3_dot(n, kg_vec3_sub(x, c->of.a));
    const kg_sdf_value out = {height, n, {0.0}};
    return height < 0.0 && is_surely_outside(mesh, x) ? negated_value(out) : out;
  }
  const bool edge = c->on >= EDGE_AB;
  const kg_vec3 N = pseudo_normal(mesh, c);
  const kg_vec3 along = edge ? edge_direction(c) : kg_vec3_make(0.0, 0.0, 0.0);
  const double size = kg_vec3_norm(N); /* 0: faces that are folded onto each other */
  const kg_vec3 fallback = size > FOLDED ? kg_vec3_scale(1.0 / size, N) : n;
  const kg_sdf_value out = edge_feature(c->d, along, fallback);
  if (!(kg_vec3_dot(N, c->d) < 0.0) || is_surely_outside(mesh, x)) {
    return out;
  }
  if (out.distance < FEATURE_TINY) { /* the fallback normal already points outwards */
    return (kg_sdf_value){-out.distance, out.normal, {0.0}};
  }
  return negated_value(out);
}

/* ---- queries --------------------------------------------------------------------------------- */

/* How far the distance of the search and that of the value may be apart: they round differently. */
static double rounding(const kg_mesh *mesh, kg_vec3 x)
{
  return 1e-15 * (kg_vec3_norm(x) + kg_vec3_norm(mesh->tree.lo) + kg_vec3_norm(mesh->tree.hi));
}

/* Slot of the closest triangle, or -1. Looks a little beyond limit; the value decides. */
static int search(const kg_mesh *mesh, kg_vec3 x, double limit, const kg_mesh_hint *hint,
                  bool is_any)
{
  const bool is_usable =
    hint && hint->triangle >= 0 && hint->triangle / BVH_LEAF < mesh->tree.packet_count;
  const double reach = is_any ? limit : limit * (1.0 + 1e-12) + rounding(mesh, x);
  bvh_best best = {reach * reach, -1};
  mesh->kernels->search(&mesh->tree, x, is_usable ? hint->triangle / BVH_LEAF : -1, is_any, &best);
  return best.slot;
}

bool kg_mesh_distance_within(const kg_mesh *mesh, kg_vec3 x, double limit, kg_mesh_hint *hint,
                             kg_sdf_value *value)
{
  if (!(limit > 0.0)) {
    return false;
  }
  const bool is_far = !is_searchable(x);
  const int slot = is_far ? -1 : search(mesh, x, limit, hint, false);
  if (!is_far && slot < 0) {
    return false;
  }
  const closest c = is_far ? (closest){0} : closest_in(mesh, slot, x);
  const kg_sdf_value found = is_far ? far_value(x) : value_of(mesh, x, &c);
  if (fabs(found.distance) >= limit && !isinf(limit)) {
    return false;
  }
  if (hint && !is_far) {
    hint->triangle = slot;
  }
  *value = found;
  return true;
}

kg_sdf_value kg_mesh_distance_from(const kg_mesh *mesh, kg_vec3 x, kg_mesh_hint *hint)
{
  if (!is_searchable(x)) {
    return far_value(x);
  }
  const int slot = search(mesh, x, INFINITY, hint, false);
  KG_ASSERT(slot >= 0);
  if (hint) {
    hint->triangle = slot;
  }
  const closest c = closest_in(mesh, slot, x);
  return value_of(mesh, x, &c);
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
  const closest c = closest_in(mesh, search(mesh, x, INFINITY, NULL, false), x);
  const kg_sdf_value value = value_of(mesh, x, &c);
  const kg_mesh_feature on = c.on == FACE      ? KG_MESH_FACE
                             : c.on >= EDGE_AB ? KG_MESH_EDGE
                                               : KG_MESH_VERTEX;
  return (kg_mesh_hit){value.distance, kg_vec3_sub(x, c.d), value.normal,
                       mesh->source[mesh->tree.face[c.slot]], on};
}

bool kg_mesh_touches_ball(const kg_mesh *mesh, kg_vec3 center, double radius)
{
  return radius > 0.0 && is_searchable(center) && search(mesh, center, radius, NULL, true) >= 0;
}

void kg_mesh_bounds(const kg_mesh *mesh, kg_vec3 *lo, kg_vec3 *hi)
{
  *lo = mesh->tree.lo;
  *hi = mesh->tree.hi;
}

/* ---- single triangles ------------------------------------------------------------------------ */

/* Cosine of the angle from a pseudo-normal beyond which a near miss could change the side: two
 * triangles whose distances differ by 1e-6 of them differ by 1e-3 in direction. */
#define SURE_SIDE 0.02

void mesh_corners(const kg_mesh *mesh, int slot, kg_vec3 out[3])
{
  const triangle t = triangle_in(&mesh->tree, slot);
  out[0] = t.a;
  out[1] = kg_vec3_add(t.a, t.u);
  out[2] = kg_vec3_add(t.a, t.v);
}

bool mesh_value_on(const kg_mesh *mesh, kg_vec3 x, int slot, kg_sdf_value *out)
{
  const closest c = closest_in(mesh, slot, x);
  *out = value_of(mesh, x, &c);
  if (c.on == FACE) {
    return true;
  }
  const kg_vec3 N = pseudo_normal(mesh, &c);
  const double along = kg_vec3_dot(N, c.d);
  return along * along > SURE_SIDE * SURE_SIDE * kg_vec3_dot(N, N) * kg_vec3_dot(c.d, c.d);
}
