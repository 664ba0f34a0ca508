/* The two inner loops of grids, compiled for each instruction set (sdf/kernels/grid.c). */
#ifndef SDF_KERNELS_GRID_H
#define SDF_KERNELS_GRID_H

#include <stdint.h>

#include "kinegrad/vec3.h"
#include "sdf/boxes.h"

/* Blocks of SIDE^3 cells. Each holds the nodes on its faces itself: a cell's eight are near to each
 * other, on one page of memory. */
enum {
  GRID_SHIFT = 2,
  GRID_SIDE = 1 << GRID_SHIFT,
  GRID_ROW = GRID_SIDE + 1,
  GRID_SLICE = GRID_ROW * GRID_ROW,
  GRID_BLOCK_NODES = GRID_SLICE * GRID_ROW,
  GRID_BLOCK_STRIDE = 128 /* nodes: 2048 bytes, packed 1024 */
};

/* A packed node is four numbers of 16 bits in two words, (value, g_x) and (g_y, g_z), the first one in
 * the upper half: what the interpolant is read from. A word as a whole is the upper number times
 * GRID_PACKED over the largest of its kind, to half a unit of the upper half. */
#define GRID_PACKED 2147418112.0 /* 32767 * 65536 */

/* A node, or a block's center: value and gradient of the field. All of them x first, then y, then z.
 * Nodes of a block beyond the last of the grid are zero. */
typedef struct grid_view {
  kg_vec3 lo;          /* of node 0                                                    */
  double spacing;      /* m                                                            */
  int n[3];            /* nodes along x, y, z, two or more                             */
  int blocks[3];       /* that cover the cells; the last ones may stand out of them    */
  const float *center; /* (blocks[2], blocks[1], blocks[0], 4)                         */
  const int *block;    /* (blocks[2], blocks[1], blocks[0]): its place in node, or -1  */
  const float *node;   /* (count, GRID_BLOCK_STRIDE, 4), of blocks near to the surface */
  const int32_t *packed; /* (count, GRID_BLOCK_STRIDE, 2)                              */
  double largest;        /* m: no value in packed is larger, one spacing or more       */
  double steepest;       /* no part of a gradient in packed is, 1 or more              */
  int count;
} grid_view;

static inline size_t grid_block_at(const grid_view *g, int i, int j, int k)
{
  return ((size_t)k * (size_t)g->blocks[1] + (size_t)j) * (size_t)g->blocks[0] + (size_t)i;
}

/* of a block that has nodes; i, j, k from its first one, up to GRID_SIDE */
static inline size_t grid_node_at(int block, int i, int j, int k)
{
  return (size_t)block * GRID_BLOCK_STRIDE + (size_t)(k * GRID_SLICE + j * GRID_ROW + i);
}

/* A triangle in the grid's coordinates (from its node 0): edges u = b - a, v = c - a, w = c - b, unit
 * normal n, and for each edge the unit vector m in the plane across it, inwards. */
typedef struct grid_triangle {
  float a[3], u[3], v[3], w[3], n[3];
  float m_ab[3], m_ca[3], m_bc[3];
  float inverse_uu, inverse_vv, inverse_ww, unused;
} grid_triangle;

/* Box around the triangles of a node of the tree, in axes of its own: those of the grid, or turned so
 * that the surface is flat in them. Boxes around slanted triangles would be thick, and a point above
 * them would be near to all of them. */
typedef struct grid_box {
  float center[3], axis[3][3], half[3], unused;
} grid_box;

enum { GRID_PACKET = 16 };

/* Nodes of which the nearest triangles are searched together; the first is the lowest along all axes,
 * the last the highest. */
typedef struct grid_packet {
  float x[3][GRID_PACKET];
  float distance2[GRID_PACKET]; /* in: what is known, INFINITY at first */
  int triangle[GRID_PACKET];    /* of `triangles`                       */
} grid_packet;

typedef struct kg_grid_kernels {
  /* distance[i], gradient[i] of the interpolant at x[i], neither outside of the grid and in blocks
   * without nodes: says how many points are there, and in unknown[] which */
  int (*interpolate)(const grid_view *grid, int count, const kg_vec3 *x, double *distance,
                     kg_vec3 *gradient, int *unknown);
  /* The nearest of all triangles for each node, but for rounding in floats. */
  void (*search)(const boxes *tree, const grid_box *around, const grid_triangle *triangles,
                 grid_packet *packet);
  void (*try_triangle)(const grid_triangle *triangles, int k, grid_packet *packet);
} kg_grid_kernels;

extern const kg_grid_kernels kg_grid_kernels_base, kg_grid_kernels_v3, kg_grid_kernels_v4;

#endif
