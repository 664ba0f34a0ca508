/* Building a mesh from a file's triangles. Internal to sdf/. */
#ifndef KG_SDF_MESH_CREATE_H
#define KG_SDF_MESH_CREATE_H

#include "sdf/topology.h"

#ifdef __cplusplus
extern "C" {
#endif

/* kg_mesh_create, and if wanted a search for triangles that cut each other, which takes longer. */
kg_status mesh_create(kg_mesh **mesh, const kg_vec3 *vertices, int vertex_count,
                      const int *triangles, int triangle_count, bool search_crossings,
                      kg_mesh_report *report, const kg_allocator *allocator, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
