/* Embree's point query on a mesh: unsigned distance, in floats. */
#ifndef BENCH_SDF_EMBREE_PEER_H
#define BENCH_SDF_EMBREE_PEER_H

#include "bench/sdf/surfaces.h"

typedef struct kg_embree kg_embree;

/* Takes the vertices over as floats; builds nothing yet. One thread. */
kg_status kg_embree_open(kg_embree **embree, const kg_bench_surface *s);
void kg_embree_close(kg_embree *embree);

/* Builds the hierarchy (medium quality), in place of one that was there. */
kg_status kg_embree_build(kg_embree *embree);

/* Distance of x. hint: NULL, or the triangle to try first (-1: none), which is then replaced by the
 * nearest one. */
double kg_embree_distance(kg_embree *embree, kg_vec3 x, int *hint);

#endif
