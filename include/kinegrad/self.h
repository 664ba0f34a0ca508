/* kinegrad/self.h - a body against itself: arms, legs and trunk that pass through each other.
 *
 * The sample points of a segment are held against the shapes of other segments of the same body, each
 * in the axes of its segment. Which segments are tried is decided once, by kg_self_create: the point's
 * and the other lie KG_SELF_LEAST_JOINTS joints apart along the tree or more, not both belong to the column of
 * pelvis, spine, neck, head and clavicles, and in the rest pose neither has a point in the other (docs/theory/sdf.md, "The body against itself"). */
#ifndef KINEGRAD_SELF_H
#define KINEGRAD_SELF_H

#include "kinegrad/base.h"
#include "kinegrad/body.h"
#include "kinegrad/sdf_value.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Segments with fewer joints between them along the tree are neighbours: upper arm and chest, forearm
 * and clavicle, both thighs, shin and pelvis touch by the shape of a body, not by its motion. */
enum { KG_SELF_LEAST_JOINTS = 3 };
/* Pairs that are deeper in each other than this in the rest pose are left out (m). */
#define KG_SELF_REST_DEPTH_M 1e-3

typedef struct kg_self kg_self; /* one per thread */

/* A point of the body in or near a segment that is not its own. */
typedef struct kg_self_touch {
  int point;       /* of the body                                      */
  int segment;     /* the other                                        */
  kg_vec3 x;       /* of the point, world                              */
  double distance; /* to the other's shapes, m; negative inside        */
  kg_vec3 normal;  /* unit, world: the way out of the other            */
} kg_self_touch;

/* rest[nq]: the pose in which overlaps are none of the motion's making; NULL: all rotations the
 * identity, the skeleton's own rest pose. The body must outlive it. */
KG_API KG_MUST_USE kg_status kg_self_create(kg_self **self, const kg_body *body, const double *rest,
                                            const kg_allocator *allocator);
KG_API void kg_self_destroy(kg_self *self);

/* Whether points of one segment are held against the shapes of another. Symmetric. */
KG_API bool kg_self_is_pair(const kg_self *self, int segment, int other);

/* Points nearer than `limit` (m) to another segment of their pairs, each with the nearest of them, for
 * the pose p[n], R[n] of kg_dynamics_pose. touches: room for all points of the body. Returns how many.
 * Allocates nothing. */
KG_API int kg_self_sample(kg_self *self, const kg_vec3 *p, const kg_mat3 *R, double limit,
                          kg_self_touch *touches);

/* How far x, a point in the shapes of a segment, has to go along the unit vector `way` to be out of
 * them, m, in `distance`; in `normal` the normal of the surface there (kg_sdf_way_out). World axes. */
KG_API kg_sdf_value kg_self_way_out(const kg_self *self, const kg_vec3 *p, const kg_mat3 *R,
                                    int segment, kg_vec3 x, kg_vec3 way);

/* Depth of the deepest point (m), 0 when none is inside; *deepest, where not NULL and the depth is
 * above 0, says which. */
KG_API double kg_self_depth(kg_self *self, const kg_vec3 *p, const kg_mat3 *R,
                            kg_self_touch *deepest);

#ifdef __cplusplus
}
#endif
#endif
