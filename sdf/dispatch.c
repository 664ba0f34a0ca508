/* Which kernels this processor runs. */
#include "sdf/kernels/kernels.h"

#include "base/processor.h"

const kg_sdf_kernels *kg_sdf_kernels_of_level(int level)
{
#ifdef KG_DISPATCH
  if (level > kg_processor_level()) return NULL;
  if (level == 3) return &kg_sdf_kernels_v4;
  if (level == 2) return &kg_sdf_kernels_v3;
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
