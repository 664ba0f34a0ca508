/* From a heap of triangles to faces, edges and a report of what is wrong, and on to a mesh. Internal to
 * sdf/. */
#ifndef KG_SDF_TOPOLOGY_H
#define KG_SDF_TOPOLOGY_H

#include "kinegrad/arena.h"
#include "kinegrad/mesh.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Vertices at the same place are one vertex here. Faces without area are gone, after they have
 * served to find the edges. */
typedef struct topology {
  int vertex_count;
  kg_vec3 *vertices;
  int face_count;
  int (*corner)[3]; /* (face_count) vertices, counter-clockwise from outside              */
  int (*across)[3]; /* (face_count) the face on the other side of the edges 01, 12, 20: itself at a
                       border, ~k at odd edge k                                           */
  int *source;      /* (face_count) number of the triangle in the input                   */
  kg_vec3 *normal;  /* (face_count) unit                                                  */
  int odd_count;    /* edges of more than two faces                                       */
  kg_vec3 *odd_normals; /* (odd_count) sum of those faces' normals                        */
  kg_vec3 lo, hi;       /* bounds of the faces                                            */
  bool is_closed;       /* every edge is walked as often one way as the other             */
  int boundary_count;
  int (*boundary)[2]; /* (boundary_count) edges with one face, in that face's direction */
  /* a place for each kind of finding, of the first one in the order of faces or edges */
  kg_vec3 degenerate_at, duplicate_at, non_manifold_at, inconsistent_at;
} topology;

/* The vertices are from scratch, all that belongs to faces and edges from arena. Turns a closed mesh
 * of negative volume around. Errors as kg_mesh_create, without a text for KG_ERR_NO_MEMORY. */
kg_status topology_build(topology *out, const kg_vec3 *vertices, int vertex_count,
                         const int *triangles, int triangle_count, kg_mesh_report *report,
                         kg_arena *arena, kg_arena *scratch, kg_error *error);

/* Adds a sentence to the report. */
void report_say(kg_mesh_report *report, const char *format, ...) KG_PRINTF(2, 3);

/* The word that goes with a count. */
static inline const char *word_for(long long count, const char *one, const char *more)
{
  return count == 1 ? one : more;
}

/* Gaps and borders (sdf/boundary.c): counts them and says what they are. False: no memory. */
bool boundary_describe(const topology *topo, kg_mesh_report *report, kg_arena *arena);

/* Triangles that cut through each other (sdf/crossings.c): pairs without a common corner of which one
 * is cut by an edge of the other, beyond rounding; pairs that only touch or lie in one plane are none.
 * Work is bounded: when it runs out, the rest of the triangles is left unsearched and the report says
 * so. False: no memory. */
bool crossings_describe(const topology *topo, kg_mesh_report *report, kg_arena *arena);

/* kg_mesh_create (sdf/mesh_build.c), and if wanted that search, which takes longer. */
kg_status mesh_create(kg_mesh **mesh, const kg_vec3 *vertices, int vertex_count,
                      const int *triangles, int triangle_count, bool search_crossings,
                      kg_mesh_report *report, const kg_allocator *allocator, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
