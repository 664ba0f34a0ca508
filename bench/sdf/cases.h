/* What the case files of this folder share. */
#ifndef BENCH_SDF_CASES_H
#define BENCH_SDF_CASES_H

#include "bench/bench.h"
#include "bench/sdf/surfaces.h"

/* The row of a peer that was not installed at build time. */
#define ABSENT_CONTESTANT(title, package, mask)                                                    \
  {                                                                                                \
    .name = (title), .absent = package " was not there at build time", .parts = (mask)             \
  }

enum { BENCH_MESH_CASES = 6, BENCH_GRID_CASES = 2 };

extern const kg_bench_case kg_bench_mesh_cases[BENCH_MESH_CASES];
extern const kg_bench_case kg_bench_grid_cases[BENCH_GRID_CASES];

#endif
