/* What the fuzz targets share. A target that finds a broken promise stops the program. */
#ifndef TESTS_FUZZ_H
#define TESTS_FUZZ_H

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/clip.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define FUZZ_CHECK(condition)                                                                      \
  do {                                                                                             \
    if (!(condition)) {                                                                            \
      fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition);                \
      abort();                                                                                     \
    }                                                                                              \
  } while (0)

/* An error has a place and words; a clip has its shape and numbers that are numbers. */
static inline void fuzz_check_result(kg_status status, const kg_clip *clip, const kg_error *error)
{
  if (status != KG_OK) {
    FUZZ_CHECK(!clip && error->status == status && error->text[0] != '\0');
    FUZZ_CHECK(memchr(error->text, '\n', sizeof error->text) == NULL);
    return;
  }
  FUZZ_CHECK(clip->joint_count > 0 && clip->frame_count > 0 && clip->frame_time > 0.0);
  FUZZ_CHECK(clip->source.unit_m > 0.0);
  for (int j = 0; j < clip->joint_count; j++) {
    const kg_joint *joint = &clip->joints[j];
    FUZZ_CHECK(joint->parent < j && joint->parent >= -1);
    FUZZ_CHECK(joint->first_channel + joint->channel_count <= clip->channel_count);
  }
  const size_t poses = (size_t)clip->frame_count * (size_t)clip->joint_count;
  for (size_t k = 0; k < poses; k++) {
    const kg_quat q = clip->rotations[k];
    const kg_vec3 p = clip->translations[k];
    FUZZ_CHECK(isfinite(p.x) && isfinite(p.y) && isfinite(p.z));
    FUZZ_CHECK(fabs(kg_quat_dot(q, q) - 1.0) < 1e-9);
  }
}

/* Use of a clip: mapping, a changed pose, a copy. */
static inline void fuzz_use(kg_clip *clip)
{
  kg_mapping mapping;
  kg_clip *copy;
  const int last = clip->frame_count - 1;
  FUZZ_CHECK(kg_mapping_find(&mapping, clip, NULL, NULL) != KG_ERR_FORMAT);
  for (int j = 0; j < clip->joint_count; j++) {
    const kg_quat turn = kg_quat_exp(kg_vec3_make(0.3, 1.5 * j, -0.2));
    kg_clip_set_rotation(clip, last, j, turn, last - 1);
    kg_clip_set_translation(clip, last, j, kg_vec3_make(1.0, 0.1 * j, 2.0));
  }
  if (kg_clip_resample(&copy, clip, 0.77 * clip->frame_time) == KG_OK) {
    kg_clip_destroy(copy);
  }
}

#endif
