/* Which kernels this processor runs. */
#include "sdf/kernels/kernels.h"

const kg_sdf_kernels *kg_sdf_kernels_of_level(int level)
{
#ifdef KG_DISPATCH
  __builtin_cpu_init();
  const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                  __builtin_cpu_supports("bmi2");
  const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                  __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
                  __builtin_cpu_supports("avx512cd");
  if (level == 3) return v4 ? &kg_sdf_kernels_v4 : NULL;
  if (level == 2) return v3 ? &kg_sdf_kernels_v3 : NULL;
#endif
  return level == 1 ? &kg_sdf_kernels_base : NULL;
}

const kg_sdf_kernels *kg_sdf_kernels_best(void)
{
  const kg_sdf_kernels *best = NULL;
  for (int level = 3; level >= 1 && !best; level--) {
    best = kg_sdf_kernels_of_level(level);
  }
  return best;
}
