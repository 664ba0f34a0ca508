/* A grid as sdf/grid_build.c and sdf/grid_file.c make it and sdf/grid.c reads it. Internal to sdf/. */
#ifndef KG_SDF_GRID_INTERNAL_H
#define KG_SDF_GRID_INTERNAL_H

#include "kinegrad/arena.h"
#include "kinegrad/grid.h"
#include "sdf/kernels/kernels.h"

/* share of the box's diagonal that rounding can add to a node's value */
#define GRID_SLACK 1e-6

enum { GRID_BAND = 2 }; /* spacings */

struct kg_grid {
  kg_arena arena;
  const kg_grid_kernels *kernels;
  kg_grid_source source; /* all NULL: none                                                   */
  grid_view view;
  kg_vec3 hi;
  double slack;
  bool is_continuous; /* the sign too: no border of an open mesh behind which it jumps        */
  bool has_closest;   /* x - Phi n is a point of the surface at every node                    */
};

/* nodes in all, exclusive: what is counted of them fits an int */
#define GRID_MOST_NODES 2147483648.0

/* blocks that cover an axis of so many nodes */
static inline int grid_block_count(int nodes)
{
  return (nodes - 1 + GRID_SIDE - 1) / GRID_SIDE;
}

/* A grid without values, and without nodes. NULL and a status when memory is refused. */
kg_status grid_allocate(kg_grid **grid, kg_vec3 lo, double spacing, const int n[3],
                        const kg_allocator *allocator, kg_error *error);
float *grid_centers(kg_grid *grid);
size_t grid_block_total(const grid_view *view);
/* The places in view->node of the grid's node at[]: one in every block with nodes that touches it,
 * eight at most. Returns how many. */
int grid_copies(const grid_view *view, const int at[3], size_t places[8]);
/* The values of the centers are set: says which blocks have nodes, those that can hold a point within
 * GRID_BAND spacings of the surface, and how many they are. */
int grid_choose_blocks(kg_grid *grid);
/* Memory for their nodes, all zero. */
kg_status grid_allocate_nodes(kg_grid *grid, kg_error *error);
float *grid_nodes(kg_grid *grid);
/* The nodes are set: packs them. */
void grid_pack_nodes(kg_grid *grid);
kg_vec3 grid_place(const grid_view *view, int i, int j, int k);
/* of a block; of one that stands out of the box, the nearest point of the box */
kg_vec3 grid_center_place(const grid_view *view, int i, int j, int k);
/* Neighbours can be told apart: a spacing of a billionth of the coordinates or more. */
bool grid_is_fine(kg_vec3 lo, double spacing, const int n[3]);
/* the source's value; there is one */
kg_sdf_value grid_ask(const kg_grid_source *source, kg_vec3 x);

#endif
