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
/* Ellipsoid with the given semi-axes (m, above zero), centre and orientation: exact distance, from
 * the closest point. */
KG_API kg_sdf_value kg_sdf_ellipsoid(kg_vec3 center, kg_quat orientation, kg_vec3 semi, kg_vec3 x);
/* Cylinder with flat ends around the segment from a to b, a not b. */
KG_API kg_sdf_value kg_sdf_cylinder(kg_vec3 a, kg_vec3 b, double radius, kg_vec3 x);

/* Where a ray from x along the unit vector `way` is outside of a convex field for good: the distance to
 * go, m, and the field's normal there; 0 and the normal at x where it is outside at once. `far`: a
 * distance at which the ray is outside. Newton's method from there on Phi along the ray, which is convex,
 * so that no iterate goes too far; of a union the last way out, or a farther one. */
KG_API kg_sdf_value kg_sdf_way_out(kg_sdf_fn *field, void *user, kg_vec3 x, kg_vec3 way, double far);

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

/* Exact: Phi is the distance. Bound: |Phi| is at most the distance, the sign is right. */
typedef enum kg_shape_kind {
  KG_SHAPE_PLANE,
  KG_SHAPE_SPHERE,
  KG_SHAPE_BOX,
  KG_SHAPE_CAPSULE,
  KG_SHAPE_HEIGHT_FIELD,
  KG_SHAPE_MESH,
  KG_SHAPE_ELLIPSOID,
  KG_SHAPE_CYLINDER,
  KG_SHAPE_UNION,        /* min(A, B): exact outside and where no solids overlap, else a bound    */
  KG_SHAPE_INTERSECTION, /* max(A, B): exact inside, a bound outside                              */
  KG_SHAPE_DIFFERENCE,   /* max(A, -B), A without B: as the intersection                          */
  KG_SHAPE_SMOOTH_UNION  /* with radius r: min(A, B) where |A - B| >= r; between, lower by up to
                            r/6, C2, a bound, and its gradient is shorter than 1                  */
} kg_shape_kind;

typedef struct kg_sdf_shape {
  kg_shape_kind kind;
  kg_vec3 a, b;         /* plane: point, unit normal; sphere: centre, -; box: centre, half sizes;
                           ellipsoid: centre, semi-axes; capsule, cylinder: both ends            */
  double radius;        /* sphere, capsule, cylinder; smooth union: r, m                         */
  kg_quat orientation;  /* box, ellipsoid                                                        */
  const kg_height_field *field; /* borrowed */
  const kg_mesh *mesh;          /* borrowed */
  double offset;        /* m; the surface moves outwards by this: Phi - offset. Rounds edges     */
  int children[2];      /* A, B of a combination: numbers of shapes before it                    */
  bool part;            /* of a combination, and nothing by itself; kg_scene_add sets it         */
  int place;            /* number of a place of the scene; 0: the world, at rest                 */
  int ground;           /* number of a ground of the scene; 0: hard                              */
} kg_sdf_shape;

/* Where shapes that move together are, at the time of the query, and how they move: a point p of
 * such a shape is at  at + turn p.  Parts of a combination are placed within the combination's own
 * place, at rest there. */
typedef struct kg_place {
  kg_vec3 at;       /* m                                                                       */
  kg_quat turn;     /* unit; all zero is taken for the identity                                */
  kg_vec3 velocity; /* of `at`, m/s                                                            */
  kg_vec3 spin;     /* rad/s, world axes                                                       */
  double reach;     /* m; radius of a ball around `at` that holds its shapes; 0: not known.
                       kg_scene_add keeps it                                                   */
} kg_place;

static inline bool kg_place_is_moving(const kg_place *place)
{
  return kg_vec3_norm(place->velocity) + kg_vec3_norm(place->spin) > 0.0;
}

/* Velocity of the rigid body that moves with the place, at x. */
static inline kg_vec3 kg_place_velocity(const kg_place *place, kg_vec3 x)
{
  return kg_vec3_add(place->velocity, kg_vec3_cross(place->spin, kg_vec3_sub(x, place->at)));
}

/* What covers the rigid shape: a mat, turf. The shape is the rigid core, Phi is measured from it,
 * and the soft layer reaches to Phi = thickness. docs/theory/contact.md has the law. */
typedef struct kg_ground {
  double thickness; /* m; with 0 and no stiffness the ground is hard                 */
  double stiffness; /* N/m of a sample point pressed into the layer                  */
  double damping;   /* s/m; share of extra force per approach speed, of the layer    */
  double friction;  /* Coulomb coefficient; negative: that of the contact law        */
} kg_ground;

/* Hard, with the friction of the contact law: as number 0. */
KG_API kg_ground kg_ground_default(void);
/* Finite; thickness, stiffness and damping not negative. */
KG_API bool kg_ground_is_valid(const kg_ground *ground);

enum { KG_SCENE_MAX_SHAPES = 96, KG_SCENE_MAX_PLACES = 48, KG_SCENE_MAX_GROUNDS = 16 };

/* A scene is the union of its shapes: Phi = min over shapes. A plain value of about 20 kB; copies
 * share the borrowed meshes and fields. Number k of a place or ground is in element k - 1. */
typedef struct kg_scene {
  int shape_count, place_count, ground_count;
  kg_sdf_shape shapes[KG_SCENE_MAX_SHAPES];
  kg_place places[KG_SCENE_MAX_PLACES];
  kg_ground grounds[KG_SCENE_MAX_GROUNDS];
} kg_scene;

/* Scene with one plane through (0, height, 0), normal given (need not be unit). */
KG_API kg_scene kg_scene_ground(double height, kg_vec3 normal);
/* False when the scene is full. Numbers in the shape must be those of children, place and ground
 * that are there already. */
KG_API bool kg_scene_add(kg_scene *scene, const kg_sdf_shape *shape);
/* Their numbers, for shapes; 0 when there is no room. */
KG_API int kg_scene_add_place(kg_scene *scene, const kg_place *place);
KG_API int kg_scene_add_ground(kg_scene *scene, const kg_ground *ground);
/* Moves a place; its shapes go with it. */
KG_API void kg_scene_move(kg_scene *scene, int place, kg_vec3 at, kg_quat turn, kg_vec3 velocity,
                          kg_vec3 spin);

KG_API kg_sdf_value kg_scene_distance(const kg_scene *scene, kg_vec3 x);

/* Where a search begins: the nearest shape of an earlier query nearby, and where on it if it is a
 * mesh. {-1, {-1}} is none; anything else costs time at worst. One for every point that moves. */
typedef struct kg_scene_hint {
  int shape;
  kg_mesh_hint mesh;
} kg_scene_hint;

/* The same number as kg_scene_distance, faster after a small move where the scene has meshes or many
 * shapes. hint: in and out. */
KG_API kg_sdf_value kg_scene_distance_from(const kg_scene *scene, kg_vec3 x, kg_scene_hint *hint);

/* Of shape number i (an index, from 0) alone; false, and nothing written, when it is further than
 * `limit`. Parts of combinations count as any other shape here. */
KG_API bool kg_scene_shape_distance(const kg_scene *scene, int i, kg_vec3 x, double limit,
                                    kg_sdf_value *value);

typedef struct kg_scene_point {
  kg_sdf_value value;      /* as kg_scene_distance                                              */
  int shape;               /* index of the nearest, -1 in an empty scene                        */
  kg_vec3 velocity;        /* m/s; of that shape as a rigid body, at x                          */
  const kg_ground *ground; /* of that shape, in the scene; NULL: number 0                       */
} kg_scene_point;

KG_API kg_scene_point kg_scene_nearest(const kg_scene *scene, kg_vec3 x);

/* Distance to the outside of the soft layers, min over shapes of Phi - thickness: where a capture's
 * soles touch. Equal to Phi where all is hard. */
KG_API double kg_scene_surface(const kg_scene *scene, kg_vec3 x);

#ifdef __cplusplus
}
#endif
#endif
