/* Hierarchy of axis-aligned boxes, four children a node. Internal to sdf/.
 *
 * Bounds are floats rounded outwards and the query point is an interval of floats, so that the
 * distance to a box never exceeds the true one: culling is safe, the answer is left to the caller's
 * double arithmetic. */
#ifndef KG_SDF_BVH_H
#define KG_SDF_BVH_H

#include "kinegrad/arena.h"
#include "kinegrad/vec3.h"

enum {
  BVH_WIDTH = 4,
  BVH_LEAF = 4,       /* items in a leaf, at most                                     */
  BVH_SAH_DEPTH = 24, /* of two-way splits; below, halves: the depth stays under 56   */
  BVH_STACK = 128     /* at most 3 waiting children a level of 4-way splits, 28 levels */
};

typedef struct bvh_box {
  kg_vec3 lo, hi;
} bvh_box;

typedef struct bvh_node {
  float lo[3][BVH_WIDTH], hi[3][BVH_WIDTH];
  int child[BVH_WIDTH]; /* node, or first item of a leaf                            */
  int count[BVH_WIDTH]; /* items of a leaf; 0: child is a node; -1: no child here    */
} bvh_node;

typedef struct bvh {
  bvh_node *nodes; /* nodes[0] is the root */
  int node_count;
  int *order; /* (count) item at each leaf position */
} bvh;

/* nodes and order from `arena`, scratch memory from `scratch`. False when memory is refused. */
bool bvh_build(bvh *out, const bvh_box *boxes, int count, kg_arena *arena, kg_arena *scratch);

#endif
