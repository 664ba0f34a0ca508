/* Clips made by hand: the person of mocap_support.h, its hips and ankles put where a test wants them.
 *
 * Lengths in metres, x to the person's left, y up, z forward. Standing on y = 0 the ankle joints are
 * at STANDING_ANKLE and the toe joints 0.06 below them: the floor of pipeline/floor.c lies 0.03 of a
 * 1.75 m person below the toe joints, and the person's shank says 0.9714 of that. */
#ifndef TESTS_FIXTURE_CLIP_H
#define TESTS_FIXTURE_CLIP_H

#include "mocap_support.h"

#include "kinegrad/clip.h"
#include "kinegrad/subject.h"

#define THIGH 0.4165
#define SHANK 0.4182
#define STANDING_TOE (0.030 * SHANK / (0.246 * 1.75))
#define STANDING_ANKLE (STANDING_TOE + 0.06)
#define STANDING_HIPS (STANDING_ANKLE + 0.82) /* knees a little bent */

static inline kg_quat turn_about(double x, double y, double z)
{
  return kg_quat_exp(kg_vec3_make(x, y, z));
}

/* T frames of the person with all rotations zero. */
static inline kg_clip *person_clip(int T, double dt)
{
  text_buffer text = {0};
  add_hierarchy(&text, person, PERSON_JOINTS, 1.0, KG_UP_Y);
  text_add(&text, "MOTION\nFrames: %d\nFrame Time: %.9g\n", T, dt);
  for (int t = 0; t < T; t++) {
    text_add(&text, "0 0.9 0");
    for (int c = 0; c < 3 * PERSON_JOINTS; c++) {
      text_add(&text, " 0");
    }
    text_add(&text, "\n");
  }
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 1.0;
  def.up_given = true;
  def.keep_first_frame = true;
  kg_clip *clip;
  kg_error error = {.text = ""};
  if (kg_clip_read_bvh_text(&clip, text.at, text.length, "person.bvh", &def, &error) != KG_OK) {
    fail_msg("%s:%ld:%ld: %s", error.path, error.line, error.column, error.text);
  }
  text_free(&text);
  assert_int_equal(clip->frame_count, T);
  return clip;
}

/* Hips (not turned) at `hips`, ankle joint of one leg at `ankle`, its foot turned by `foot` from the
 * rest pose. A leg that is too short is stretched towards the ankle. */
static inline void pose_leg(kg_clip *clip, int t, int side, kg_vec3 hips, kg_vec3 ankle,
                            kg_quat foot)
{
  const int up_leg = kg_clip_find(clip, side == 0 ? "LeftUpLeg" : "RightUpLeg");
  const kg_vec3 down = {0.0, -1.0, 0.0};
  const kg_vec3 way = kg_vec3_sub(ankle, kg_vec3_add(hips, clip->joints[up_leg].offset));
  const double d = fmin(kg_vec3_norm(way), THIGH + SHANK);
  /* law of cosines: the knee's bend, then the thigh's share of it */
  const double bend =
    acos(fmax(-1.0, fmin(1.0, (d * d - THIGH * THIGH - SHANK * SHANK) / (2.0 * THIGH * SHANK))));
  const double share = atan2(SHANK * sin(bend), THIGH + SHANK * cos(bend));
  const kg_quat thigh =
    kg_quat_mul(kg_quat_between(down, kg_vec3_normalized(way)), turn_about(-share, 0.0, 0.0));
  const kg_quat knee = turn_about(bend, 0.0, 0.0);
  kg_clip_set_rotation(clip, t, up_leg, thigh, -1);
  kg_clip_set_rotation(clip, t, up_leg + 1, knee, -1);
  kg_clip_set_rotation(clip, t, up_leg + 2,
                       kg_quat_mul(kg_quat_conj(kg_quat_mul(thigh, knee)), foot), -1);
}

/* Both legs, feet flat. */
static inline void pose_person(kg_clip *clip, int t, kg_vec3 hips, kg_vec3 left, kg_vec3 right)
{
  kg_clip_set_translation(clip, t, 0, hips);
  pose_leg(clip, t, 0, hips, left, kg_quat_identity());
  pose_leg(clip, t, 1, hips, right, kg_quat_identity());
}

/* Standing on y = height over (x, z), still. */
static inline void pose_standing(kg_clip *clip, int t, double x, double height, double z)
{
  pose_person(clip, t, kg_vec3_make(x, STANDING_HIPS + height, z),
              kg_vec3_make(x + 0.1, STANDING_ANKLE + height, z),
              kg_vec3_make(x - 0.1, STANDING_ANKLE + height, z));
}

static inline kg_clip *standing_clip(int T, double dt)
{
  kg_clip *clip = person_clip(T, dt);
  for (int t = 0; t < T; t++) {
    pose_standing(clip, t, 0.0, 0.0, 0.0);
  }
  return clip;
}

static inline kg_subject *subject_of(const kg_clip *clip, const kg_subject_def *given)
{
  const kg_subject_def def = given ? *given : kg_subject_default_def();
  kg_subject *subject;
  kg_error error = {.text = ""};
  if (kg_subject_create(&subject, clip, &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return subject;
}

/* subject of a clip on a floor of known height */
static inline kg_subject *subject_on(const kg_clip *clip, double height)
{
  kg_subject_def def = kg_subject_default_def();
  def.floor_given = true;
  def.floor_height = height;
  return subject_of(clip, &def);
}

#endif
