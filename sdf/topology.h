/* From a heap of triangles to faces, edges and a report of what is wrong. Internal to sdf/. */
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

/* The vertices are from scratch, all that belongs to faces and edges from arena. Turns a closed mesh of negative volume around. Errors as kg_mesh_create. */
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

#ifdef __cplusplus
}
#endif
#endif
