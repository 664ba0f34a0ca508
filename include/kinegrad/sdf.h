/* kinegrad/sdf.h - signed distance fields: shapes, and scenes made of them and of meshes.
 *
 * Phi(x) in metres: positive outside the solid, negative inside, zero on the surface (the paper
 * of docs/theory/sdf.md, section III.C). All points in world coordinates unless said otherwise. */
#ifndef KINEGRAD_SDF_H
#define KINEGRAD_SDF_H

#include "kinegrad/base.h"
#include "kinegrad/mesh.h"
#include "kinegrad/quat.h"
#include "kinegrad/sdf_value.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

/* ---- single shapes (sdf/shapes.c) ------------------------------------------------------------ */

/* Half-space below the plane through point with unit normal. */
KG_API kg_sdf_value kg_sdf_plane(kg_vec3 point, kg_vec3 normal, kg_vec3 x);
KG_API kg_sdf_value kg_sdf_sphere(kg_vec3 center, double radius, kg_vec3 x);
/* Box with the given half sizes (m), centre and orientation. */
KG_API kg_sdf_value kg_sdf_box(kg_vec3 center, kg_quat orientation, kg_vec3 half, kg_vec3 x);
/* Capsule around the segment from a to b; a may equal b: a ball. */
KG_API kg_sdf_value kg_sdf_capsule(kg_vec3 a, kg_vec3 b, double radius, kg_vec3 x);

/* Height field: ground y = height(x, z) on a regular grid, bilinear cells split into two
 * triangles (lower-left to upper-right diagonal); solid below. Exact distance to the triangles.
 * Outside the grid the border heights continue outwards. */
typedef struct kg_height_field kg_height_field;

/* heights: (rows, columns), two each at least, row index along z, column along x; spacing > 0 in m.
 * origin: world position of heights[0] at height 0. Copied.
 * KG_ERR_FORMAT: a height that is not finite. KG_ERR_UNSUPPORTED: more than 1.3e8 heights. */
KG_API KG_MUST_USE kg_status kg_height_field_create(kg_height_field **field, const double *heights,
                                                    int rows, int columns, double spacing,
                                                    kg_vec3 origin, const kg_allocator *allocator);
KG_API void kg_height_field_destroy(kg_height_field *field);
KG_API kg_sdf_value kg_height_field_distance(const kg_height_field *field, kg_vec3 x);

/* ---- scenes ---------------------------------------------------------------------------------- */

typedef enum kg_shape_kind {
  KG_SHAPE_PLANE,
  KG_SHAPE_SPHERE,
  KG_SHAPE_BOX,
  KG_SHAPE_CAPSULE,
  KG_SHAPE_HEIGHT_FIELD,
  KG_SHAPE_MESH
} kg_shape_kind;

typedef struct kg_sdf_shape {
  kg_shape_kind kind;
  kg_vec3 a, b;         /* plane: point, unit normal; sphere: centre, -; box: centre, half sizes;
                           capsule: both ends                                                  */
  double radius;        /* sphere, capsule                                                     */
  kg_quat orientation;  /* box                                                                 */
  const kg_height_field *field; /* borrowed */
  const kg_mesh *mesh;          /* borrowed */
} kg_sdf_shape;

enum { KG_SCENE_MAX_SHAPES = 32 };

/* A scene is the union of its shapes: Phi = min over shapes. A plain value; copies share the
 * borrowed meshes and fields. */
typedef struct kg_scene {
  int shape_count;
  kg_sdf_shape shapes[KG_SCENE_MAX_SHAPES];
} kg_scene;

/* Scene with one plane through (0, height, 0), normal given (need not be unit). */
KG_API kg_scene kg_scene_ground(double height, kg_vec3 normal);
/* False when the scene is full. */
KG_API bool kg_scene_add(kg_scene *scene, const kg_sdf_shape *shape);
KG_API kg_sdf_value kg_scene_distance(const kg_scene *scene, kg_vec3 x);

#ifdef __cplusplus
}
#endif
#endif
