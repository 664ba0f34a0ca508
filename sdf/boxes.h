/* Plain hierarchy of axis-aligned boxes over triangles, for searches that the tree of queries
 * (sdf/bvh.h) is not made for: which triangles overlap a box, or may be nearest to a group of points.
 * Internal to sdf/. */
#ifndef KG_SDF_BOXES_H
#define KG_SDF_BOXES_H

#include "kinegrad/arena.h"
#include "kinegrad/vec3.h"

enum {
  BOXES_LEAF = 4,  /* triangles of a leaf, at most       */
  BOXES_STACK = 40 /* halves: 29 levels and one more each */
};

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

/* corners(k, out, user): the three corners of triangle k < count. Memory from arena. False: refused. */
typedef void boxes_corners(int triangle, kg_vec3 out[3], const void *user);
bool boxes_build(boxes *out, int count, boxes_corners *corners, const void *user, kg_arena *arena);

#endif
