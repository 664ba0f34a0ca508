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
 * finding with its number, the place of the first (m) and what follows from it, "" when the mesh is
 * clean. */
typedef struct kg_mesh_report {
  int vertices, triangles;
  int boundary_edges; /* > 0: open; distance is then signed by the nearest side only          */
  int gaps;           /* rims of holes in parts that are closed but for them                  */
  int borders;        /* rims of parts that are sheets, such as terrain                       */
  int non_manifold_edges;
  int inconsistent_edges; /* two faces with opposite orientation                                  */
  int degenerate;         /* faces of zero area, removed                                          */
  int duplicates;         /* repeated faces, removed                                              */
  bool closed;            /* every edge is walked as often one way as the other                   */
  bool inside_out;        /* closed, negative volume; was turned around                           */
  double volume;          /* m^3, when closed                                                     */
  /* kg_mesh_read only */
  int bent;      /* polygons that are not flat within a hundredth of their size          */
  int tangled;   /* polygons whose outline crosses itself                                */
  int crossings; /* pairs of triangles that cut through each other, at least             */
  char text[2048];
} kg_mesh_report;

/* vertices: (vertex_count) points in m; triangles: (triangle_count, 3) indices, counter-clockwise
 * from outside. Copied into flat arrays with a bounding-volume hierarchy.
 * KG_ERR_FORMAT: an index out of range, a vertex that is not finite, no triangle left. */
KG_API KG_MUST_USE kg_status kg_mesh_create(kg_mesh **mesh, const kg_vec3 *vertices,
                                            int vertex_count, const int *triangles,
                                            int triangle_count, kg_mesh_report *report,
                                            const kg_allocator *allocator, kg_error *error);

/* OBJ, PLY, OFF or STL (by extension) through OpenMesh, PLY and STL in text or binary; polygons are
 * triangulated, concave ones too; lengths times unit_m. Coordinates are read in single precision
 * (6e-8 of their size). The report also tells of polygons that are not flat or cross themselves and
 * of triangles that cut through each other.
 * KG_ERR_READ: no such file, or empty. KG_ERR_FORMAT: another extension; a damaged or shortened
 * file, with line and column, or with the byte in the text where the file is binary; and as
 * kg_mesh_create. KG_ERR_UNSUPPORTED: OFF in binary; a PLY file of more than 16 elements or 64
 * properties, or in binary with 16-bit numbers of corners; a concave polygon of more than 512
 * corners. */
KG_API KG_MUST_USE kg_status kg_mesh_read(kg_mesh **mesh, const char *path, double unit_m,
                                          kg_mesh_report *report, const kg_allocator *allocator,
                                          kg_error *error);
KG_API void kg_mesh_destroy(kg_mesh *mesh);

/* Bounding box of the triangles. */
KG_API void kg_mesh_bounds(const kg_mesh *mesh, kg_vec3 *lo, kg_vec3 *hi);

/* ---- distance --------------------------------------------------------------------------------
 *
 * Exact signed distance to the nearest triangle, as a look at all of them in double arithmetic
 * gives it; sign by angle-weighted pseudo-normals [BAER] J. A. Baerentzen, H. Aanaes, Signed
 * distance computation using the angle weighted pseudonormal, IEEE TVCG 11(3), 2005.
 * Answers depend on the mesh and the point alone: hints, limits, other points of a batch, threads
 * and the processor's instruction set do not change a bit. A mesh is only read: any number of
 * threads may ask at once.
 *
 * Defined everywhere. On the medial axis one of the nearest triangles counts, that of the smallest
 * number. Outside the box of a closed mesh the sign is positive, however far away. Where a
 * coordinate reaches 1e18 m the mesh is a point at the origin: value |x|, normal x / |x|. A
 * coordinate that is NaN gives a distance of NaN. */

/* Part of the surface that the closest point lies on. */
typedef enum kg_mesh_feature { KG_MESH_FACE, KG_MESH_EDGE, KG_MESH_VERTEX } kg_mesh_feature;

typedef struct kg_mesh_hit {
  double distance; /* signed, m                                                       */
  kg_vec3 point;   /* closest point of the surface                                    */
  kg_vec3 normal;  /* unit gradient of the distance at x                              */
  int triangle;    /* the closest one, in the numbering given to kg_mesh_create; -1: x is not finite
                      or 1e18 m away                                                  */
  kg_mesh_feature feature;
} kg_mesh_hit;

/* Where the search begins: what an earlier query nearby left here saves most of it. {-1} is none;
 * anything else, from another mesh too, costs time at worst. */
typedef struct kg_mesh_hint {
  int triangle; /* in a numbering of the mesh's own */
} kg_mesh_hint;

KG_API kg_sdf_value kg_mesh_distance(const kg_mesh *mesh, kg_vec3 x);
/* The same number, faster after a small move. hint: in and out. */
KG_API kg_sdf_value kg_mesh_distance_from(const kg_mesh *mesh, kg_vec3 x, kg_mesh_hint *hint);
/* values[i] at x[i], i < count; hints: NULL or (count). */
KG_API void kg_mesh_distance_many(const kg_mesh *mesh, int count, const kg_vec3 *x,
                                  kg_mesh_hint *hints, kg_sdf_value *values);
KG_API kg_mesh_hit kg_mesh_closest(const kg_mesh *mesh, kg_vec3 x);

/* False, soon, when |Phi(x)| >= limit; value and hint stay as they are. Else true and the value; at a
 * point that is NaN too. A point deep inside has a large |Phi| as well. limit INFINITY: none. hint may be NULL. */
KG_API bool kg_mesh_distance_within(const kg_mesh *mesh, kg_vec3 x, double limit,
                                    kg_mesh_hint *hint, kg_sdf_value *value);
/* Is any triangle nearer than radius to center? Ends with the first one found. */
KG_API bool kg_mesh_touches_ball(const kg_mesh *mesh, kg_vec3 center, double radius);

#ifdef __cplusplus
}
#endif
#endif
