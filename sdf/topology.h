/* From a heap of triangles to faces, edges and a report of what is wrong. Internal to sdf/. */
#ifndef KG_SDF_TOPOLOGY_H
#define KG_SDF_TOPOLOGY_H

#include "kinegrad/arena.h"
#include "kinegrad/mesh.h"

/* Vertices at the same place are one vertex here. Faces without area are gone, after they have
 * served to find the edges. */
typedef struct topology {
  int vertex_count;
  kg_vec3 *vertices;
  int face_count;
  int (*corner)[3]; /* (face_count) vertices, counter-clockwise from outside */
  int (*edge)[3];   /* (face_count) edges 01, 12, 20                         */
  int *source;      /* (face_count) number of the triangle in the input      */
  int edge_count;
  bool is_closed; /* every edge is walked as often one way as the other */
} topology;

/* Memory from arena. Turns a closed mesh of negative volume around. Errors as kg_mesh_create. */
kg_status topology_build(topology *out, const kg_vec3 *vertices, int vertex_count,
                         const int *triangles, int triangle_count, kg_mesh_report *report,
                         kg_arena *arena, kg_error *error);

#endif
