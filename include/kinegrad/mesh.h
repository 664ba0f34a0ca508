/* kinegrad/mesh.h - triangle meshes and the signed distance to them (sdf/mesh.c; files through
 * OpenMesh in sdf/openmesh_shim.cpp). */
#ifndef KINEGRAD_MESH_H
#define KINEGRAD_MESH_H

#include "kinegrad/base.h"
#include "kinegrad/sdf_value.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_mesh kg_mesh;

/* What was found while building (vertices at the same place count as one); text holds one line per
 * finding, "" when the mesh is clean. */
typedef struct kg_mesh_report {
  int vertices, triangles;
  int boundary_edges;     /* > 0: open; distance is then signed by the nearest side only */
  int non_manifold_edges;
  int inconsistent_edges; /* two faces with opposite orientation                        */
  int degenerate;         /* faces of zero area, removed                                */
  int duplicates;         /* repeated faces, removed                                    */
  bool closed;            /* every edge is walked as often one way as the other         */
  bool inside_out;        /* closed, negative volume; was turned around                 */
  double volume;          /* m^3, when closed                                           */
  char text[1024];
} kg_mesh_report;

/* vertices: (vertex_count) points in m; triangles: (triangle_count, 3) indices, counter-clockwise
 * from outside. Copied into flat arrays with a bounding-volume hierarchy.
 * KG_ERR_FORMAT: an index out of range, a vertex that is not finite, no triangle left. */
KG_API KG_MUST_USE kg_status kg_mesh_create(kg_mesh **mesh, const kg_vec3 *vertices,
                                            int vertex_count, const int *triangles,
                                            int triangle_count, kg_mesh_report *report,
                                            const kg_allocator *allocator, kg_error *error);

/* OBJ, PLY, OFF or STL (by extension) through OpenMesh; polygons, taken as convex, are
 * triangulated; lengths times unit_m. Coordinates are read in single precision (6e-8 of their
 * size). KG_ERR_READ: no such file, or empty. KG_ERR_FORMAT: another extension, a damaged or
 * shortened file, and as kg_mesh_create. KG_ERR_UNSUPPORTED: a PLY list with a 32-bit length. */
KG_API KG_MUST_USE kg_status kg_mesh_read(kg_mesh **mesh, const char *path, double unit_m,
                                          kg_mesh_report *report, const kg_allocator *allocator,
                                          kg_error *error);
KG_API void kg_mesh_destroy(kg_mesh *mesh);

/* Exact signed distance; sign by angle-weighted pseudo-normals [BAER] J. A. Baerentzen, H. Aanaes,
 * Signed distance computation using the angle weighted pseudonormal, IEEE TVCG 11(3), 2005. */
KG_API kg_sdf_value kg_mesh_distance(const kg_mesh *mesh, kg_vec3 x);

#ifdef __cplusplus
}
#endif
#endif
