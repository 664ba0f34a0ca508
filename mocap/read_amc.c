/* ASF skeleton and AMC motion. */
#include "mocap/mocap.h"
kg_status kg_clip_read_amc(kg_clip **clip, const char *amc, size_t amc_length, const char *path,
                           const kg_clip_def *def, kg_error *error)
{
  (void)amc;
  (void)amc_length;
  (void)def;
  *clip = NULL;
  return kg_fail(error, KG_ERR_UNSUPPORTED, path, 0, 0, "AMC motion is not read by this version");
}
