/* Triangle meshes: from triangles to flat arrays, hierarchy and pseudo-normals. */
#include "sdf/mesh_internal.h"

#include "sdf/topology.h"

enum { AT_ONCE = 256 };

/* [BAER] section 3: every face counts with its angle for its corners. */
typedef struct corner_angles {
  double sine[2][AT_ONCE], cosine[2][AT_ONCE], angle[2][AT_ONCE];
} corner_angles;

/* Angles at corners a and b of the faces [first, first + count). */
static void find_angles(corner_angles *c, const kg_mesh *mesh, const topology *topo, int first,
                        int count)
{
  for (int i = 0; i < count; i++) {
    const int *k = topo->corner[first + i];
    const kg_vec3 a = topo->vertices[k[0]], b = topo->vertices[k[1]];
    const kg_vec3 u = kg_vec3_sub(b, a), v = kg_vec3_sub(topo->vertices[k[2]], a);
    /* |u x v|, the same for all corners */
    const double sine = kg_vec3_dot(topo->normal[first + i], kg_vec3_cross(u, v));
    c->sine[0][i] = c->sine[1][i] = sine;
    c->cosine[0][i] = kg_vec3_dot(u, v);
    c->cosine[1][i] = kg_vec3_dot(u, kg_vec3_sub(u, v));
  }
  for (int k = 0; k < 2; k++) {
    mesh->kernels->angles(count, c->sine[k], c->cosine[k], c->angle[k]);
  }
}

static void set_vertex_normals(kg_mesh *mesh, const topology *topo)
{
  corner_angles c;
  for (int first = 0; first < topo->face_count; first += AT_ONCE) {
    const int rest = topo->face_count - first, count = rest < AT_ONCE ? rest : AT_ONCE;
    find_angles(&c, mesh, topo, first, count);
    for (int i = 0; i < count; i++) {
      const int *k = topo->corner[first + i];
      const kg_vec3 n = topo->normal[first + i];
      const double a = c.angle[0][i], b = c.angle[1][i], angle[3] = {a, b, SDF_PI - a - b};
      for (int j = 0; j < 3; j++) {
        kg_vec3 *at = &mesh->vertex_normals[k[j]];
        *at = kg_vec3_add_scaled(*at, angle[j], n);
      }
    }
  }
  for (int i = 0; i < topo->vertex_count; i++) {
    mesh->vertex_normals[i] = kg_vec3_normalized(mesh->vertex_normals[i]);
  }
}

static bool fill_mesh(kg_mesh *mesh, const topology *topo, kg_arena *scratch)
{
  mesh->kernels = kg_sdf_kernels_best();
  mesh->is_closed = topo->is_closed;
  mesh->corner = topo->corner;
  mesh->across = topo->across;
  mesh->source = topo->source;
  mesh->normal = topo->normal;
  mesh->odd_normals = topo->odd_normals;
  mesh->vertex_normals = KG_ARENA_ARRAY(&mesh->arena, kg_vec3, topo->vertex_count);
  if (!mesh->vertex_normals) return false;
  set_vertex_normals(mesh, topo);
  const bvh_input input = {.vertices = topo->vertices,
                           .corner = (const int(*)[3])topo->corner,
                           .normal = topo->normal,
                           .count = topo->face_count,
                           .lo = topo->lo,
                           .hi = topo->hi};
  return bvh_build(&mesh->tree, &input, &mesh->arena, scratch);
}

/* bytes a triangle, of the mesh and while it is built, when there are half as many vertices */
enum { KEPT = 200, BUILDING = 150 };

/* One block for what will be taken: blocks that grow by doubling would be twice as large, and new
 * pages of memory cost time. Refused, it is asked for in parts. */
static void reserve(kg_arena *arena, size_t bytes)
{
  const kg_arena_mark empty = kg_arena_mark_of(arena);
  (void)kg_arena_take(arena, bytes, 64);
  kg_arena_rewind(arena, empty);
}

kg_status mesh_create(kg_mesh **mesh, const kg_vec3 *vertices, int vertex_count,
                      const int *triangles, int triangle_count, bool search_crossings,
                      kg_mesh_report *report, const kg_allocator *allocator, kg_error *error)
{
  *mesh = NULL;
  kg_arena arena, scratch;
  kg_arena_init(&arena, allocator);
  kg_arena_init(&scratch, allocator);
  reserve(&arena, KEPT * (size_t)triangle_count);
  reserve(&scratch, BUILDING * (size_t)triangle_count);
  topology topo;
  kg_status status = topology_build(&topo, vertices, vertex_count, triangles, triangle_count,
                                    report, &arena, &scratch, error);
  kg_mesh *built = status == KG_OK ? KG_ARENA_ARRAY(&arena, kg_mesh, 1) : NULL;
  if (built) {
    built->arena = arena;
    if (fill_mesh(built, &topo, &scratch) &&
        (!search_crossings || crossings_describe(&topo, report, &scratch))) {
      *mesh = built;
    }
    arena = built->arena;
  }
  if (!*mesh) {
    kg_arena_release(&arena);
  }
  kg_arena_release(&scratch);
  if (!*mesh && (status == KG_OK || status == KG_ERR_NO_MEMORY)) {
    status = kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a mesh of %d triangles",
                     triangle_count);
  }
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
