/* Shared by the files of physics/: how a body holds its memory. */
#ifndef PHYSICS_PHYSICS_H
#define PHYSICS_PHYSICS_H

#include "kinegrad/arena.h"
#include "kinegrad/body.h"

/* A body with room for the given counts, everything zero, roles absent (-1); the caller fills it
 * and frees it with kg_body_destroy. NULL when memory is refused. */
kg_body *kg_body_allocate(int segment_count, int shape_count, int point_count,
                          const kg_allocator *allocator);

/* Sums the mass and checks the rules of kg_body_create (debug builds). */
void kg_body_finish(kg_body *body);

static inline kg_quat kg_state_quat(const double *q, int segment)
{
  const double *p = q + 3 + 4 * segment;
  return kg_quat_make(p[0], p[1], p[2], p[3]);
}

static inline void kg_state_set_quat(double *q, int segment, kg_quat r)
{
  double *p = q + 3 + 4 * segment;
  p[0] = r.w;
  p[1] = r.x;
  p[2] = r.y;
  p[3] = r.z;
}

/* q_out = q exp(d), normalised: a joint of kg_body_integrate */
void kg_joint_turn(double *q_out, const double *q, const double *d);

/* Three consecutive numbers: the root position of q, or a block of v. */
static inline kg_vec3 kg_load3(const double *p)
{
  return kg_vec3_make(p[0], p[1], p[2]);
}

/* The segment that both hang from, or the one of them that the other hangs from: a parent comes before
 * its children. */
static inline int kg_meeting_segment(const kg_body *body, int a, int b)
{
  while (a != b) {
    if (a > b) {
      a = body->segments[a].parent;
    } else {
      b = body->segments[b].parent;
    }
  }
  return a;
}

/* joints from a segment up to `end`, which it hangs from; -1: the world, the root's joint with the others */
static inline int kg_joints_above(const kg_body *body, int segment, int end)
{
  int joints = 0;
  for (; segment != end; segment = body->segments[segment].parent) {
    joints++;
  }
  return joints;
}

static inline void kg_store3(double *p, kg_vec3 a)
{
  p[0] = a.x;
  p[1] = a.y;
  p[2] = a.z;
}

#endif
