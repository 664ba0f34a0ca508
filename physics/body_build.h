/* The body under construction: shared by body.c (segments, masses) and body_shapes.c (surface). */
#ifndef PHYSICS_BODY_BUILD_H
#define PHYSICS_BODY_BUILD_H

#include "kinegrad/body.h"

enum { KG_BUILD_SHAPES = 48, KG_BUILD_POINTS = 512 };

/* A sole in its own frames: ankle and toe segment coordinates. */
typedef struct kg_build_foot {
  int ankle, toe;            /* segments; toe -1: everything is on the ankle           */
  kg_vec3 up, forward, left; /* ankle frame, orthonormal                               */
  kg_vec3 toe_up, toe_forward, toe_left; /* toe frame; the ankle's when there is no toe   */
  double ankle_height, toe_height;
  double heel;       /* heel behind the ankle joint, m                         */
  double ball;       /* toe joint's line in front of the ankle joint, m        */
  double ball_left;  /* sideways offset of the ball's middle                   */
  double toe_length; /* tip in front of the toe joint, m                       */
  double length;     /* anthropometric length of the foot, m                   */
} kg_build_foot;

typedef struct kg_build {
  const kg_body_def *def;
  int n;
  kg_segment segments[KG_ROLE_COUNT];
  int segment_of_role[KG_ROLE_COUNT];

  /* reference posture: mean relative rotation of every segment over the motion, root frame */
  kg_vec3 p[KG_ROLE_COUNT];
  kg_quat R[KG_ROLE_COUNT];
  kg_vec3 up, left, forward; /* of the trunk */
  kg_vec3 mid_hip, mid_shoulder;
  kg_vec3 neck;    /* cervicale: top of the trunk */
  kg_vec3 head_up; /* towards the vertex          */
  kg_vec3 vertex;  /* top of the head             */
  kg_vec3 hand_tip[2];
  double trunk_length; /* mid-hip to cervicale, m     */
  double stature;
  kg_build_foot feet[2];

  int shape_count, point_count;
  kg_body_shape shapes[KG_BUILD_SHAPES];
  kg_body_point points[KG_BUILD_POINTS];
} kg_build;

/* Segment that plays the role, or -1. */
static inline int kg_build_segment(const kg_build *b, kg_role role)
{
  return b->segment_of_role[role];
}

/* Point and direction of the reference posture in a segment's frame. */
static inline kg_vec3 kg_build_to_local(const kg_build *b, int segment, kg_vec3 x)
{
  return kg_quat_rotate(kg_quat_conj(b->R[segment]), kg_vec3_sub(x, b->p[segment]));
}

static inline kg_vec3 kg_build_turn_local(const kg_build *b, int segment, kg_vec3 d)
{
  return kg_quat_rotate(kg_quat_conj(b->R[segment]), d);
}

/* Two directions that complete the unit vector axis to a right-handed frame (front, side, axis);
 * front is as close to `front` as it can be, or to `other` where that is along the axis. */
void kg_build_across(kg_vec3 axis, kg_vec3 front, kg_vec3 other, kg_vec3 *a, kg_vec3 *b);

/* Sole nodes, shapes and samples of a body whose segments are complete. */
void kg_build_surface(kg_build *b);

#endif
