/* Plain hierarchy of halves over triangles, in boxes along the world's axes. The tree of queries
 * (sdf/bvh.h) serves single points, eight boxes at once, each node's in axes of its own; here what is
 * searched for has an extent: triangles that overlap a box (sdf/crossings.c), or may be nearest to one
 * of many points (sdf/kernels/grid.c). Internal to sdf/. */
#ifndef KG_SDF_BOXES_H
#define KG_SDF_BOXES_H

#include "kinegrad/arena.h"
#include "kinegrad/vec3.h"

enum {
  BOXES_LEAF = 4,  /* triangles of a leaf, at most       */
  BOXES_STACK = 40 /* halves: 29 levels and one more each */
};

typedef struct boxes_box {
  float lo[3], hi[3]; /* rounded outwards */
} boxes_box;

typedef struct boxes_node {
  float lo[3], hi[3]; /* rounded outwards                                              */
  int count;          /* triangles of a leaf from `first` on; 0: children at `first`
                         and `first` + 1                                               */
  int first;
} boxes_node;

typedef struct boxes {
  boxes_node *nodes; /* nodes[0] is the root */
  int *order;        /* (count) triangles    */
} boxes;

boxes_box boxes_around(const kg_vec3 corners[3]);
/* Where a node of the triangles [first, end) is halved. */
static inline int boxes_middle(int first, int end)
{
  return first + (end - first) / 2;
}

/* corners(k, out, user): the three corners of triangle k < count. Memory from arena. False: refused. */
typedef void boxes_corners(int triangle, kg_vec3 out[3], const void *user);
bool boxes_build(boxes *out, int count, boxes_corners *corners, const void *user, kg_arena *arena);

#endif
