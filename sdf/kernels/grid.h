/* The two inner loops of grids, compiled for each instruction set (sdf/kernels/grid.c). */
#ifndef SDF_KERNELS_GRID_H
#define SDF_KERNELS_GRID_H

#include "kinegrad/vec3.h"
#include "sdf/boxes.h"

/* Nodes of a grid: value and gradient of the field, x first, then y, then z. */
typedef struct grid_view {
  kg_vec3 lo;        /* of node 0                        */
  double spacing;    /* m                                */
  int n[3];          /* nodes along x, y, z, two or more */
  const float *node; /* (n[2], n[1], n[0], 4)            */
} grid_view;

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
  /* distance[i], gradient[i] of the interpolant at x[i]; false and neither outside of the grid */
  void (*interpolate)(const grid_view *grid, int count, const kg_vec3 *x, double *distance,
                      kg_vec3 *gradient, bool *inside);
  /* The nearest of all triangles for each node, but for rounding in floats. */
  void (*search)(const boxes *tree, const grid_box *around, const grid_triangle *triangles,
                 grid_packet *packet);
  void (*try_triangle)(const grid_triangle *triangles, int k, grid_packet *packet);
} kg_grid_kernels;

extern const kg_grid_kernels kg_grid_kernels_base, kg_grid_kernels_v3, kg_grid_kernels_v4;

#endif
