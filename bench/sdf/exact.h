/* Distances of kinegrad against all triangles of a mesh, and signs against a ray's crossings. */
#ifndef BENCH_SDF_EXACT_H
#define BENCH_SDF_EXACT_H

#include "bench/sdf/surfaces.h"

typedef struct kg_bench_tally {
  const char *name;
  bool is_closed; /* else signs are not compared                                          */
  int points, inside, on_surface, signs_wrong;
  double worst; /* |difference| over the diagonal; NaN: an answer was, or no memory      */
} kg_bench_tally;

/* A third of the points near the surface (up to 5 cm), a third anywhere in twice the box, a third on
 * vertices and edges and within 1e-7 m of them. Signs count where the point is not on the surface,
 * within 1e-12 of the diagonal. */
void kg_bench_exact(kg_bench_tally *tally, kg_bench_surface_kind kind, int points, uint64_t seed);

#endif
