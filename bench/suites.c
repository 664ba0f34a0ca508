/* The suites, and how this program was built. */
#include "bench/autodiff/cases.h"
#include "bench/bench.h"
#include "bench/dynamics/cases.h"
#include "bench/sdf/cases.h"

static const kg_bench_group autodiff[] = {
  {kg_bench_gmm_cases, BENCH_GMM_CASES},   {kg_bench_ba_cases, BENCH_BA_CASES},
  {kg_bench_net_cases, BENCH_NET_CASES},   {kg_bench_lstm_cases, BENCH_LSTM_CASES},
  {kg_bench_hand_cases, BENCH_HAND_CASES},
};

static const kg_bench_group dynamics[] = {
  {kg_bench_kernel_cases, BENCH_KERNEL_CASES},
};

static const kg_bench_group step[] = {
  {kg_bench_step_cases, BENCH_STEP_CASES},
  {kg_bench_derivative_cases, BENCH_DERIVATIVE_CASES},
  {kg_bench_rollout_cases, BENCH_ROLLOUT_CASES},
};

static const kg_bench_group sdf[] = {
  {kg_bench_mesh_cases, BENCH_MESH_CASES},
  {kg_bench_grid_cases, BENCH_GRID_CASES},
};

const kg_bench_suite kg_bench_suites[] = {
  {"autodiff", "gradients and Jacobians beside plain C and ADOL-C", "../shared/adbench", autodiff,
   KG_COUNT_OF(autodiff)},
  {"dynamics", "kinematics and dynamics of a body beside MuJoCo", "../shared/data", dynamics,
   KG_COUNT_OF(dynamics)},
  {"step", "implicit steps of a body and their derivatives beside MuJoCo", "../shared/data", step,
   KG_COUNT_OF(step)},
  {"sdf", "distances to meshes beside Embree and CGAL, grids beside OpenVDB", NULL, sdf,
   KG_COUNT_OF(sdf)},
};
const int kg_bench_suite_count = (int)KG_COUNT_OF(kg_bench_suites);

const char *const kg_bench_build[] = {
  "compiler     " KG_BENCH_COMPILER,
  "library      " KG_BENCH_LIBRARY_FLAGS,
  "plain C      -O3 or -O2 as its name says, " KG_BENCH_PLAIN_FLAGS,
  NULL,
};
