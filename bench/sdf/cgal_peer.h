/* CGAL's AABB tree on a mesh: unsigned distance, in double without exact predicates. */
#ifndef BENCH_SDF_CGAL_PEER_H
#define BENCH_SDF_CGAL_PEER_H

#include "bench/sdf/surfaces.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_cgal kg_cgal;

/* Takes the triangles over; builds nothing yet. */
kg_status kg_cgal_open(kg_cgal **cgal, const kg_bench_surface *s);
void kg_cgal_close(kg_cgal *cgal);

/* Builds the tree and what speeds its distances up, in place of what was there. */
kg_status kg_cgal_build(kg_cgal *cgal);

double kg_cgal_distance(const kg_cgal *cgal, kg_vec3 x);

#ifdef __cplusplus
}
#endif
#endif
