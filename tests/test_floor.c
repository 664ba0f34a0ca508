/* Floor and feet of clips whose floor is known. */
#include "fixture_clip.h"

#include "pipeline/pipeline.h"

static kg_floor floor_of(const kg_clip *clip, kg_floor floor)
{
  kg_mapping mapping;
  kg_error error = {.text = ""};
  if (kg_mapping_find(&mapping, clip, NULL, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  assert_int_equal(kg_floor_estimate(&floor, clip, &mapping), KG_OK);
  return floor;
}

/* Stands still at (x[i], z[i]) for HOLD frames and goes smoothly to the next place in HURRY frames,
 * feet up to 0.15 above the ground. height(x, z) of the ground. */
enum { HOLD = 16, HURRY = 24 };
static kg_clip *wanderer(const double *x, const double *z, int places,
                         double (*height)(double x, double z))
{
  const int period = HOLD + HURRY, T = places * period;
  kg_clip *clip = person_clip(T, 0.02);
  for (int t = 0; t < T; t++) {
    const int i = t / period, next = i + 1 < places ? i + 1 : i;
    const double u = fmax(0.0, (t % period - HOLD + 1) / (HURRY + 1.0));
    const double s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
    const double cx = x[i] + s * (x[next] - x[i]), cz = z[i] + s * (z[next] - z[i]);
    const double lift = 0.15 * 16.0 * s * s * (1.0 - s) * (1.0 - s);
    pose_person(clip, t, kg_vec3_make(cx, STANDING_HIPS + lift + height(cx, cz), cz),
                kg_vec3_make(cx + 0.1, STANDING_ANKLE + lift + height(cx + 0.1, cz + 0.14), cz),
                kg_vec3_make(cx - 0.1, STANDING_ANKLE + lift + height(cx - 0.1, cz + 0.14), cz));
  }
  return clip;
}

static double level(double x, double z)
{
  (void)x, (void)z;
  return 0.27;
}

static double tilted(double x, double z)
{
  return -0.04 + 0.010 * x - 0.006 * z;
}

static const double places_x[] = {-2.0, 1.5, 0.3, -1.0, 2.0, 0.0, -1.8, 1.9};
static const double places_z[] = {1.7, 2.0, -1.6, 0.2, -2.0, 1.2, -1.9, 0.1};
enum { PLACES = (int)KG_COUNT_OF(places_x) };

static void a_level_floor_is_found(void **state)
{
  (void)state;
  kg_clip *clip = wanderer(places_x, places_z, PLACES, level);
  const kg_floor floor = floor_of(clip, (kg_floor){0});
  assert_close(floor.height, 0.27, 1e-3);
  assert_at_most(floor.tilt, 1e-4);
  assert_at_most(floor.spread, 5e-4);
  /* the hurried frames are no stance, nearly all of the others are */
  const int still = PLACES * HOLD + HURRY; /* the last place is not left */
  assert_in_range(floor.stance_frames, 2 * still * 8 / 10, 2 * still * 11 / 10);
  for (int f = 0; f < 2; f++) {
    assert_close(floor.feet[f].toe_height, STANDING_TOE, 1e-3);
    assert_close(floor.feet[f].ankle_height, STANDING_ANKLE, 1e-3);
    assert_close(floor.feet[f].up_ankle.y, 1.0, 1e-6);
    assert_close(floor.feet[f].up_toe.y, 1.0, 1e-6);
    assert_close(floor.feet[f].forward.z, 1.0, 1e-6);
  }
  kg_clip_destroy(clip);
}

static void a_tilted_floor_is_found(void **state)
{
  (void)state;
  kg_clip *clip = wanderer(places_x, places_z, PLACES, tilted);
  const kg_floor floor = floor_of(clip, (kg_floor){0});
  const double slope_x = -floor.normal.x / floor.normal.y;
  const double slope_z = -floor.normal.z / floor.normal.y;
  /* the prior pulls a slope over 4 m down by a few per cent */
  assert_true(slope_x > 0.0093 && slope_x < 0.0103);
  assert_true(slope_z < -0.0055 && slope_z > -0.0063);
  assert_close(floor.tilt, atan(hypot(slope_x, slope_z)), 1e-9);
  assert_close(floor.height, -0.04, 1e-3); /* at x = z = 0 */
  assert_close(kg_vec3_norm(floor.normal), 1.0, 1e-12);
  kg_clip_destroy(clip);
}

/* One place says nothing about a slope: a foot that is 8 mm higher has a thicker sole. */
static void each_foot_has_its_own_height(void **state)
{
  (void)state;
  kg_clip *clip = person_clip(60, 0.01);
  for (int t = 0; t < 60; t++) {
    pose_person(clip, t, kg_vec3_make(0, STANDING_HIPS, 0),
                kg_vec3_make(0.1, STANDING_ANKLE + 0.008, 0),
                kg_vec3_make(-0.1, STANDING_ANKLE, 0));
  }
  const kg_floor floor = floor_of(clip, (kg_floor){0});
  assert_close(floor.height, 0.0, 2e-4);
  assert_at_most(floor.tilt, 1e-3);
  assert_close(floor.feet[0].toe_height, STANDING_TOE + 0.008, 3e-4);
  assert_close(floor.feet[1].toe_height, STANDING_TOE, 3e-4);
  assert_close(floor.feet[0].ankle_height - floor.feet[1].ankle_height, 0.008, 3e-4);
  kg_clip_destroy(clip);
}

/* A foot held up all the time is no stance; it gets the other foot's fit, mirrored. */
static void a_raised_foot_does_not_stand(void **state)
{
  (void)state;
  enum { T = 40 };
  kg_clip *clip = person_clip(T, 0.01);
  const kg_vec3 hips = kg_vec3_make(0, STANDING_HIPS, 0);
  for (int t = 0; t < T; t++) {
    pose_person(clip, t, hips, kg_vec3_make(0.1, STANDING_ANKLE + 0.25, 0.1),
                kg_vec3_make(-0.1, STANDING_ANKLE, 0));
    pose_leg(clip, t, 1, hips, kg_vec3_make(-0.1, STANDING_ANKLE, 0), turn_about(0, 0, 0.2));
  }
  const kg_floor floor = floor_of(clip, (kg_floor){0});
  assert_int_equal(floor.stance_frames, T);
  /* the foot rolls about z by 0.2: its toe joint, straight ahead of the ankle, sinks no further
   * than 0.06 cos 0.2 below it */
  const double toe = STANDING_ANKLE - 0.06 * cos(0.2);
  assert_close(floor.height, toe - STANDING_TOE, 2e-4);
  const kg_foot_fit *left = &floor.feet[0], *right = &floor.feet[1];
  assert_close(right->up_ankle.x, sin(0.2), 1e-6);
  assert_close(left->up_ankle.x, -right->up_ankle.x, 1e-12);
  assert_close(left->up_ankle.y, right->up_ankle.y, 1e-12);
  assert_close(left->up_toe.x, -right->up_toe.x, 1e-12);
  assert_close(left->forward.x, -right->forward.x, 1e-12);
  assert_close(left->forward.z, right->forward.z, 1e-12);
  assert_close(left->toe_height, right->toe_height, 0.0);
  kg_clip_destroy(clip);
}

static void a_given_height_is_kept(void **state)
{
  (void)state;
  kg_clip *clip = wanderer(places_x, places_z, PLACES, tilted);
  const kg_floor floor = floor_of(clip, (kg_floor){.given = true, .height = -0.065});
  assert_true(floor.height == -0.065 && floor.given);
  assert_true(floor.normal.x == 0.0 && floor.normal.y == 1.0 && floor.normal.z == 0.0);
  assert_true(floor.tilt == 0.0);
  /* the feet are fitted to the given floor: on average they stand 0.025 above it */
  assert_close(floor.feet[0].toe_height, STANDING_TOE + 0.025, 0.01);
  kg_clip_destroy(clip);
}

static void one_frame_is_enough(void **state)
{
  (void)state;
  for (int T = 1; T <= 3; T++) {
    kg_clip *clip = standing_clip(T, 0.01);
    const kg_floor floor = floor_of(clip, (kg_floor){0});
    assert_close(floor.height, 0.0, 1e-4);
    assert_int_equal(floor.stance_frames, 2 * T);
    assert_close(floor.feet[1].ankle_height, STANDING_ANKLE, 1e-4);
    kg_clip_destroy(clip);
  }
}

/* Sinking at 1 m/s, no frame is slow: the floor is near the lowest place of the feet. */
static void without_stance_the_lowest_foot_counts(void **state)
{
  (void)state;
  enum { T = 120 };
  kg_clip *clip = person_clip(T, 0.01);
  for (int t = 0; t < T; t++) {
    pose_standing(clip, t, 0.0, 1.5 - 0.01 * t, 0.0);
  }
  const double lowest = 1.5 - 0.01 * (T - 1);
  const kg_floor floor = floor_of(clip, (kg_floor){0});
  assert_true(floor.height > lowest - 0.01 && floor.height < lowest + 0.15);
  assert_close(floor.normal.y, 1.0, 1e-3);
  for (int f = 0; f < 2; f++) {
    assert_true(floor.feet[f].toe_height > 0.0 && floor.feet[f].toe_height <= 0.15);
    assert_close(kg_vec3_norm(floor.feet[f].up_ankle), 1.0, 1e-12);
  }
  kg_clip_destroy(clip);
}

static void refused_memory_is_reported(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(20, 0.01);
  kg_mapping mapping;
  assert_int_equal(kg_mapping_find(&mapping, clip, NULL, NULL), KG_OK);
  const kg_allocator *own = clip->allocator;
  int allowed = 0;
  for (; allowed < 50; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_floor floor = {0};
    clip->allocator = &allocator;
    const kg_status status = kg_floor_estimate(&floor, clip, &mapping);
    clip->allocator = own;
    assert_int_equal(heap.live_bytes, 0);
    if (status == KG_OK) {
      break;
    }
    assert_int_equal(status, KG_ERR_NO_MEMORY);
  }
  assert_true(allowed > 0 && allowed < 50);
  kg_clip_destroy(clip);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(a_level_floor_is_found),
    cmocka_unit_test(a_tilted_floor_is_found),
    cmocka_unit_test(each_foot_has_its_own_height),
    cmocka_unit_test(a_raised_foot_does_not_stand),
    cmocka_unit_test(a_given_height_is_kept),
    cmocka_unit_test(one_frame_is_enough),
    cmocka_unit_test(without_stance_the_lowest_foot_counts),
    cmocka_unit_test(refused_memory_is_reported),
  };
  return cmocka_run_group_tests_name("floor", tests, NULL, NULL);
}
