/* What the case files of this folder share. */
#ifndef BENCH_DYNAMICS_CASES_H
#define BENCH_DYNAMICS_CASES_H

#include "bench/bench.h"
#include "bench/dynamics/models.h"
#include "bench/dynamics/mujoco_peer.h"

/* MuJoCo's row of a contestants' table; without it in the build the row says so. */
#ifdef KG_BENCH_HAS_MUJOCO
#define MUJOCO_CONTESTANT(title, mask, create_function, run_function, destroy_function)            \
  {                                                                                                \
    .name = (title), .parts = (mask), .create = (create_function), .run = (run_function),          \
    .destroy = (destroy_function)                                                                  \
  }
#else
#define MUJOCO_CONTESTANT(title, mask, create_function, run_function, destroy_function)            \
  {                                                                                                \
    .name = (title), .absent = "MuJoCo was not there at build time", .parts = (mask)               \
  }
#endif

enum {
  BENCH_KERNEL_CASES = 20,
  BENCH_STEP_CASES = 4,
  BENCH_DERIVATIVE_CASES = 3,
  BENCH_ROLLOUT_CASES = 2
};

extern const kg_bench_case kg_bench_kernel_cases[BENCH_KERNEL_CASES];
extern const kg_bench_case kg_bench_step_cases[BENCH_STEP_CASES];
extern const kg_bench_case kg_bench_derivative_cases[BENCH_DERIVATIVE_CASES];
extern const kg_bench_case kg_bench_rollout_cases[BENCH_ROLLOUT_CASES];

#endif
