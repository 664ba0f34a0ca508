/* Inside the library: the sample points of a body segment by segment, and which can be near a scene.
 *
 * Distances grow by no more than the way gone, so a ball around a segment's points dismisses them
 * all when its centre is far enough. */
#ifndef PHYSICS_NEAR_POINTS_H
#define PHYSICS_NEAR_POINTS_H

#include "kinegrad/arena.h"
#include "kinegrad/body.h"

/* A ball around the points of a segment, and what it says of them. */
typedef struct segment_ball {
  int segment;
  int first, count; /* of its points in near_points.points */
  kg_vec3 center;   /* in the segment frame                */
  double radius;
  double bound;       /* no point of the segment is nearer   */
  kg_scene_hint hint; /* of its centre                    */
} segment_ball;

typedef struct near_points {
  segment_ball *balls; /* (count), nearest first since near_points_sort */
  int count;           /* segments that have points    */
  int *points;         /* numbers of the body's points, segment by segment */
} near_points;

/* Memory from the arena; check kg_arena_failed. Balls are in the order of their segments. */
void near_points_init(near_points *near, const kg_body *body, kg_arena *arena);
/* Balls anew, after points moved within their segments. */
void near_points_refresh(near_points *near, const kg_body *body);

/* Bounds for the pose p, R of the segments, moved by shift; nearest first. From one pose to the next
 * the order hardly changes, and it depends on the pose alone. False when a bound is no number. */
bool near_points_sort(near_points *near, const kg_scene *scene, const kg_vec3 *p, const kg_mat3 *R,
                      kg_vec3 shift);

#endif
