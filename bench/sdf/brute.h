/* Distance to every triangle of a mesh, and the winding number by a ray, in double: what the answers
 * of the suite `sdf` are compared with. Shares nothing with sdf/. */
#ifndef BENCH_SDF_BRUTE_H
#define BENCH_SDF_BRUTE_H

#include "bench/sdf/surfaces.h"

typedef struct kg_bench_brute kg_bench_brute;

/* NULL: no memory. */
kg_bench_brute *kg_bench_brute_make(const kg_bench_surface *s);
void kg_bench_brute_free(kg_bench_brute *brute);

/* Least distance of x from a triangle. */
double kg_bench_brute_distance(const kg_bench_brute *brute, kg_vec3 x);
/* Is x within a closed mesh; below an open one (terrain)? Crossings of the ray from x to +y, a little
 * tilted, each counted with its direction. */
bool kg_bench_brute_inside(const kg_bench_brute *brute, kg_vec3 x);

#endif
