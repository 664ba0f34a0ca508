/* Corrects a clip with the library: reads a BVH, simulates the body, writes the result.
 *
 *   correct_clip CAPTURE.bvh OUT.bvh                                                             */
#include <stdio.h>

#include "kinegrad/correct.h"

int main(int argc, char **argv)
{
  const char *capture = argc > 1 ? argv[1] : "walk.bvh";
  const char *out = argc > 2 ? argv[2] : "walk_fixed.bvh";

  /* [readme] */
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  const kg_correct_def def = kg_correct_default_def();
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  kg_correct_result *result = NULL;
  kg_error error = {0};

  kg_status status = kg_clip_read(&clip, capture, &clip_def, &error);
  if (status == KG_OK) {
    status = kg_subject_create(&subject, clip, &subject_def, &error);
  }
  if (status == KG_OK) {
    status = kg_correct(&result, subject, &def, &error);
  }
  if (status == KG_OK) {
    kg_correct_apply(result, subject, clip);
    status = kg_clip_write_bvh(clip, out, &error);
  }
  /* [readme] */

  if (status != KG_OK) {
    fprintf(stderr, "%s: %s\n", error.path, error.text);
  } else {
    printf("%d frames, residual force %.3f of the peak ground reaction\n", result->frame_count,
           result->residual_force_rms);
  }
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  return status == KG_OK ? 0 : 1;
}
