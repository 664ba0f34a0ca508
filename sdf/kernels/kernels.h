/* The search for the closest triangle and the loops of grids, compiled for each instruction set. Which one a mesh uses is
 * decided when it is created; all give the same bits. */
#ifndef SDF_KERNELS_KERNELS_H
#define SDF_KERNELS_KERNELS_H

#include "sdf/bvh.h"
#include "sdf/kernels/grid.h"

#define SDF_PI 3.14159265358979323846

typedef struct bvh_best {
  double distance2; /* at first what counts as near enough to be found, exclusive; INFINITY: all */
  int slot;         /* -1: none yet                                                              */
} bvh_best;

typedef struct kg_sdf_kernels {
  /* The closest triangle; among equals that of the smallest face. packet: one to look at first, or
   * -1. is_any: the first one near enough will do. Coordinates of x below 1e18. */
  void (*search)(const bvh *tree, kg_vec3 x, int packet, bool is_any, bvh_best *best);
  /* angle[i], in (0, pi), of the direction (cosine[i], sine[i] > 0) of any length; to 1e-15 */
  void (*angles)(int count, const double *sine, const double *cosine, double *angle);
  const kg_grid_kernels *grid;
} kg_sdf_kernels;

extern const kg_sdf_kernels kg_sdf_kernels_base, kg_sdf_kernels_v3, kg_sdf_kernels_v4;

/* Level 1: any processor; 2: x86-64-v3 (AVX2); 3: x86-64-v4 (AVX-512). NULL: not on this one. */
const kg_sdf_kernels *kg_sdf_kernels_of_level(int level);
const kg_sdf_kernels *kg_sdf_kernels_best(void);

#endif
