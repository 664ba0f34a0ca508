/* Any bytes as an ASF skeleton and its AMC motion. A line of "%%%%" divides the two. */
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  const char *text = (const char *)data;
  size_t asf = size, amc = size; /* end of the one, start of the other */
  for (size_t i = 0; i + 5 <= size; i++) {
    if (memcmp(text + i, "%%%%\n", 5) == 0) {
      asf = i;
      amc = i + 5;
      break;
    }
  }
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error = {.status = KG_OK};
  const kg_status status = kg_clip_read_amc_text(&clip, text, asf, "fuzz.asf", text + amc,
                                                 size - amc, "fuzz.amc", &def, &error);
  fuzz_check_result(status, clip, &error);
  if (status == KG_OK) {
    fuzz_use(clip);
    kg_clip_destroy(clip);
  }
  return 0;
}
