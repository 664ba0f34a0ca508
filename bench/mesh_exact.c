/* Distances to meshes against all their triangles in double, and their signs against the crossings of
 * a ray: 5 meshes of about 100 000 triangles and one of a million. Points as in bench/sdf/exact.h.
 *
 *   mesh_exact [POINTS [POINTS_OF_THE_MILLION [SEED]]]      (100000, 10000, 1)
 *
 * Exit code 1: a distance differs by more than 1e-7 of the diagonal, or a sign of a closed mesh is
 * wrong. Several seeds can run side by side. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "bench/sdf/exact.h"

static const double BAR = 1e-7;

static int run(kg_bench_surface_kind kind, int points, uint64_t seed)
{
  kg_bench_tally t;
  kg_bench_exact(&t, kind, points, seed);
  printf("%-40s %7d points, %6d inside, %6d on it: largest difference %.1e of the diagonal, ",
         t.name, t.points, t.inside, t.on_surface, t.worst);
  if (t.is_closed) {
    printf("%d wrong signs\n", t.signs_wrong);
  } else {
    printf("open: signs not compared\n");
  }
  fflush(stdout);
  return !(t.points == points && t.worst <= BAR && t.signs_wrong == 0);
}

int main(int argc, char **argv)
{
  const int points = argc > 1 ? atoi(argv[1]) : 100000,
            of_million = argc > 2 ? atoi(argv[2]) : 10000;
  const uint64_t seed = argc > 3 ? (uint64_t)strtoull(argv[3], NULL, 10) : 1;
  if (points < 1 || of_million < 1 || argc > 4) {
    fprintf(stderr, "usage: mesh_exact [POINTS [POINTS_OF_THE_MILLION [SEED]]]\n");
    return 2;
  }
  int failed = 0;
  for (int kind = 0; kind < KG_BENCH_SURFACES; kind++) {
    failed +=
      run((kg_bench_surface_kind)kind, kind == KG_BENCH_MILLION ? of_million : points, seed);
  }
  return failed > 0;
}
