/* Any bytes as a BVH file: an error or a clip that can be used, written and read back. */
#include "fuzz.h"

#include <unistd.h>

static void write_and_read_back(const kg_clip *clip)
{
  char path[64];
  kg_clip *back;
  kg_error error = {.status = KG_OK};
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = clip->source.unit_m;
  snprintf(path, sizeof path, "fuzz_bvh_%ld.bvh", (long)getpid());
  FUZZ_CHECK(kg_clip_write_bvh(clip, path, NULL) == KG_OK);
  const kg_status status = kg_clip_read(&back, path, &def, &error);
  unlink(path);
  FUZZ_CHECK(status == KG_OK);
  FUZZ_CHECK(back->frame_count == clip->frame_count && back->frame_time == clip->frame_time);
  FUZZ_CHECK(back->channel_count == clip->channel_count);
  FUZZ_CHECK(memcmp(back->values, clip->values,
                    (size_t)clip->frame_count * (size_t)clip->channel_count * sizeof(double)) == 0);
  kg_clip_destroy(back);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error = {.status = KG_OK};
  const kg_status status =
    kg_clip_read_bvh_text(&clip, (const char *)data, size, "fuzz", &def, &error);
  fuzz_check_result(status, clip, &error);
  if (status == KG_OK) {
    write_and_read_back(clip);
    fuzz_use(clip);
    kg_clip_destroy(clip);
  }
  return 0;
}
