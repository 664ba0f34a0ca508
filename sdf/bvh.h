/* Hierarchy of boxes over triangles, eight children a node, and its leaves as packets of eight
 * triangles. Internal to sdf/.
 *
 * The boxes of a node's children lie in axes of the node's own: those of the world, or, near the
 * leaves, turned so that the surface is flat in them; boxes around slanted triangles would be thick,
 * and a point above them would be near to all of them. A query point is moved to the node's origin in
 * double and turned in floats. Boxes are rounded outwards and the turned point is an interval
 * (BVH_TURNED), so that the distance to a box is never taken for larger than it is: culling is safe,
 * and the answer is left to the double arithmetic of the packets. */
#ifndef KG_SDF_BVH_H
#define KG_SDF_BVH_H

#include "kinegrad/arena.h"
#include "kinegrad/vec3.h"

enum {
  BVH_WIDTH = 8,      /* children of a node                                                  */
  BVH_LEAF = 8,       /* triangles of a packet                                               */
  BVH_SAH_DEPTH = 28, /* of two-way splits; below, halves: the depth stays under 60          */
  BVH_STACK = 480     /* at most 7 waiting children a level, and no more levels than splits  */
};

/* Rounding of (float)(x - origin) and of three products and two sums, and of boxes made the same
 * way, as a share of the sum of its coordinates: below 2^-24 (1 + 3). */
#define BVH_TURNED 4e-7f
/* Squares of the gaps and their sum, and columns of `turn` that are unit vectors but for rounding:
 * together below 1.2e-6 of a squared distance. */
#define BVH_ROUNDED 0.999998f

typedef struct bvh_node {
  _Alignas(64) float lo[3][BVH_WIDTH]; /* infinite where there is no child */
  float hi[3][BVH_WIDTH];
  int child[BVH_WIDTH]; /* node, or ~packet                                      */
  double origin[4];
  float turn[3][4]; /* column i: the i-th axis of the world, in the node's   */
} bvh_node;

/* Triangle k: corner a, edges u and v from it; the last one of a packet may be there twice. */
typedef struct bvh_packet {
  _Alignas(64) double a[3][BVH_LEAF], u[3][BVH_LEAF], v[3][BVH_LEAF];
} bvh_packet;

/* Slot 8 p + k is triangle k of packet p. */
typedef struct bvh {
  bvh_node *nodes; /* nodes[0] is the root */
  bvh_packet *packets;
  int *face; /* (8 packet_count) the triangle in each slot */
  int node_count, packet_count;
  kg_vec3 lo, hi; /* bounds */
} bvh;

/* What the tree is made of. */
typedef struct bvh_input {
  const kg_vec3 *vertices;
  const int (*corner)[3]; /* (count)           */
  const kg_vec3 *normal;  /* (count) unit ones */
  int count;              /* > 0               */
  kg_vec3 lo, hi;         /* bounds            */
} bvh_input;

/* Memory from `arena`, scratch memory from `scratch`. False when memory is refused. */
bool bvh_build(bvh *out, const bvh_input *input, kg_arena *arena, kg_arena *scratch);

#endif
