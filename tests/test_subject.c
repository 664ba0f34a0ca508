/* From clip to subject and back. */
#include "fixture_clip.h"

#include "kinegrad/dynamics.h"
#include "pipeline/pipeline.h"

static kg_clip *walker(bool keep_first_frame)
{
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.01;
  def.keep_first_frame = keep_first_frame;
  kg_clip *clip;
  kg_error error = {.text = ""};
  if (kg_clip_read(&clip, KG_TEST_DATA "/walker.bvh", &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return clip;
}

/* Every mapped joint of the clip is where the body's state says. */
static void states_are_the_poses_of_the_clip(void **state)
{
  (void)state;
  kg_clip *clip = walker(true);
  kg_subject *subject = subject_of(clip, NULL);
  const kg_body *body = subject->body;
  assert_int_equal(subject->frame_count, clip->frame_count - clip->source.first_frame);
  assert_true(subject->dt == clip->frame_time);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, body, NULL), KG_OK);
  kg_vec3 *joints = calloc((size_t)clip->joint_count, sizeof *joints);
  kg_vec3 *p = calloc((size_t)body->segment_count, sizeof *p);
  kg_mat3 *R = calloc((size_t)body->segment_count, sizeof *R);
  assert_true(joints && p && R);
  for (int t = 0; t < subject->frame_count; t++) {
    kg_clip_world(clip, subject->first_frame + t, joints, NULL);
    kg_dynamics_pose(dynamics, subject->q + (size_t)t * (size_t)body->nq, p, R);
    for (int i = 0; i < body->segment_count; i++) {
      assert_at_most(kg_vec3_norm(kg_vec3_sub(p[i], joints[body->segments[i].joint])), 1e-3);
    }
  }
  free(joints);
  free(p);
  free(R);
  kg_dynamics_destroy(dynamics);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* Changed states, written into a copy of the clip, are read back. */
static void states_survive_the_clip(void **state)
{
  (void)state;
  kg_clip *clip = walker(true), *out;
  kg_subject *subject = subject_of(clip, NULL);
  const kg_body *body = subject->body;
  const size_t nq = (size_t)body->nq, T = (size_t)subject->frame_count;
  kg_random random = kg_random_make(5);
  double *changed = calloc(T * nq, sizeof(double)), *back = calloc(T * nq, sizeof(double));
  double *d = calloc((size_t)body->nv, sizeof(double));
  assert_true(changed && back && d);
  assert_int_equal(kg_clip_copy(&out, clip), KG_OK);
  for (size_t t = 0; t < T; t++) {
    for (int i = 0; i < body->nv; i++) {
      d[i] = 0.1 * kg_random_normal(&random);
    }
    kg_body_integrate(body, changed + t * nq, subject->q + t * nq, d);
    kg_body_state_to_clip(body, changed + t * nq, out, subject->first_frame + (int)t, -1);
  }
  assert_int_equal(kg_subject_states(subject, out, back, NULL), KG_OK);
  for (size_t t = 0; t < T; t++) {
    kg_body_difference(body, d, back + t * nq, changed + t * nq);
    for (int i = 0; i < body->nv; i++) {
      assert_at_most(fabs(d[i]), 1e-9);
    }
  }
  free(changed);
  free(back);
  free(d);
  kg_clip_destroy(out);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void an_inserted_first_frame_is_no_motion(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(6, 0.01);
  clip->source.first_frame = 1;
  pose_standing(clip, 0, 3.0, 0.0, 0.0);
  kg_subject *subject = subject_of(clip, NULL);
  assert_int_equal(subject->first_frame, 1);
  assert_int_equal(subject->frame_count, 5);
  assert_close(subject->q[0], 0.0, 1e-9);
  double q[5 * 200];
  assert_true(subject->body->nq <= 200);
  assert_int_equal(kg_subject_states(subject, clip, q, NULL), KG_OK);
  assert_memory_equal(q, subject->q, 5 * (size_t)subject->body->nq * sizeof(double));
  kg_subject_destroy(subject);

  clip->source.first_frame = 6; /* nothing is left */
  const kg_subject_def def = kg_subject_default_def();
  kg_error error = {.text = ""};
  assert_int_equal(kg_subject_create(&subject, clip, &def, &error), KG_ERR_FORMAT);
  assert_null(subject);
  assert_non_null(strstr(error.text, "no motion frame"));
  kg_clip_destroy(clip);
}

static void other_clips_are_refused(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(6, 0.01), *longer = standing_clip(7, 0.01), *other = walker(true);
  kg_subject *subject = subject_of(clip, NULL);
  double q[1];
  kg_error error = {.text = ""};
  assert_int_equal(kg_subject_states(subject, longer, q, &error), KG_ERR_FORMAT);
  assert_string_equal(error.text, "7 frames, expected the capture's 6");
  other->frame_count = 6;
  assert_int_equal(kg_subject_states(subject, other, q, &error), KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "joints, expected the capture's 22"));
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  kg_clip_destroy(longer);
  kg_clip_destroy(other);
}

static void a_clip_without_legs_is_refused(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(3, 0.01);
  clip->joints[kg_clip_find(clip, "LeftLeg")].name = "stick";
  const kg_subject_def def = kg_subject_default_def();
  kg_subject *subject;
  kg_error error = {.text = ""};
  assert_int_equal(kg_subject_create(&subject, clip, &def, &error), KG_ERR_UNMAPPED);
  assert_null(subject);
  assert_non_null(strstr(error.text, "knee"));
  kg_clip_destroy(clip);
}

/* From the outside of the nearest layer, though its core be further than another shape. */
static void soft_distance_is_from_the_outside_of_layers(void **state)
{
  (void)state;
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  const kg_ground mat = {.thickness = 0.3, .stiffness = 1e4, .friction = -1.0};
  const kg_sdf_shape shapes[] = {
    {.kind = KG_SHAPE_SPHERE, .a = {0.0, 1.0, 0.0}, .radius = 0.2},
    {.kind = KG_SHAPE_SPHERE, .a = {0.0, 1.0, 0.3}, .radius = 0.3},
    {.kind = KG_SHAPE_INTERSECTION,
     .children = {1, 2},
     .ground = kg_scene_add_ground(&scene, &mat)},
  };
  for (size_t k = 0; k < KG_COUNT_OF(shapes); k++) {
    assert_true(kg_scene_add(&scene, &shapes[k]));
  }
  /* the floor is 0.35 m away; the core, the first ball, 0.45 m, its layer 0.15 m */
  const kg_sdf_value v = kg_soft_distance(&scene, kg_vec3_make(0.0, 0.35, 0.0));
  assert_close(v.distance, 0.15, 1e-14);
  assert_close(v.normal.y, -1.0, 1e-14);
  assert_close(kg_scene_surface(&scene, kg_vec3_make(0.0, 0.35, 0.0)), v.distance, 0.0);
  /* the second ball is nearer than the first but a part only */
  assert_close(kg_soft_distance(&scene, kg_vec3_make(0.0, 1.0, 0.8)).distance, 0.3, 1e-14);
}

/* Ten sole nodes at rest: the layer's force at the height carries a tenth of the weight, unless the
 * layer is too soft for that. */
static void soles_rest_in_the_layer(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(6, 0.01);
  const kg_contact_params law = kg_contact_default_params();
  const kg_track_params track = kg_correct_default_def().track;
  const double stiffness[3] = {0.0, 2e4, 10.0};
  for (int k = 0; k < 3; k++) {
    const kg_ground ground = {0.03, stiffness[k], 0.5, -1.0};
    kg_subject_def def = kg_subject_default_def();
    def.ground = k ? &ground : NULL;
    kg_error error = {0};
    kg_subject *subject = NULL;
    if (kg_subject_create(&subject, clip, &def, &error) != KG_OK) fail_msg("%s", error.text);
    const double height = kg_rest_height(subject, &track, &law, 9.8);
    if (k == 1) {
      kg_contact_force force;
      const kg_vec3 at = subject->scene.shapes[0].a, n = subject->scene.shapes[0].b;
      const kg_vec3 x = kg_vec3_add_scaled(at, ground.thickness + height, n);
      assert_true(
        kg_contact_evaluate(&law, &subject->scene, x, kg_vec3_make(0.0, 0.0, 0.0), false, &force));
      assert_close(force.normal, 0.1 * 9.8 * subject->body->mass, 1e-9);
    } else {
      assert_close(height, track.rest_height - (k ? ground.thickness : 0.0), 1e-15);
    }
    kg_subject_destroy(subject);
  }
  kg_clip_destroy(clip);
}

static void shapes_join_the_ground(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(3, 0.01);
  const kg_scene ground = kg_scene_ground(0.4, kg_vec3_make(0, 1, 0));
  kg_scene extra = {.shape_count = 1};
  extra.shapes[0] = ground.shapes[0];
  kg_subject_def def = kg_subject_default_def();
  def.floor_given = true;
  def.floor_height = -0.1;
  def.extra = &extra;
  kg_subject *subject = subject_of(clip, &def);
  assert_int_equal(subject->scene.shape_count, 2);
  assert_close(kg_scene_distance(&subject->scene, kg_vec3_make(0, 1, 0)).distance, 0.6, 1e-12);
  assert_close(subject->body->mass, 70.0, 1e-9);
  kg_subject_destroy(subject);

  /* places, soft layers and combinations come along; their numbers still fit */
  const kg_ground turf = {.thickness = 0.02, .stiffness = 1e4, .friction = -1.0};
  const kg_place place = {.at = {0.0, 3.0, 0.0}};
  kg_scene parts = {0};
  kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE,
                       .radius = 0.5,
                       .place = kg_scene_add_place(&parts, &place),
                       .ground = kg_scene_add_ground(&parts, &turf)};
  assert_true(kg_scene_add(&parts, &ball));
  ball.radius = 0.3;
  assert_true(kg_scene_add(&parts, &ball));
  const kg_sdf_shape shell = {.kind = KG_SHAPE_DIFFERENCE, .children = {0, 1}, .ground = 1};
  assert_true(kg_scene_add(&parts, &shell));
  def.extra = &parts;
  def.ground = &turf;
  subject = subject_of(clip, &def);
  const kg_vec3 points[] = {{0, 3, 0}, {0, 3.4, 0}, {0, 4, 0}, {5, 1, 0}};
  for (int i = 0; i < 4; i++) {
    const kg_scene_point at = kg_scene_nearest(&subject->scene, points[i]);
    const kg_sdf_value alone = kg_scene_distance(&parts, points[i]);
    const double want = i == 3 ? 1.0 + 0.1 + 0.02 : alone.distance; /* the plane's core is lower */
    assert_close(at.value.distance, want, 1e-12);
    assert_true(at.ground && at.ground->thickness == 0.02);
  }
  kg_subject_destroy(subject);
  def.ground = NULL;
  def.extra = &extra;

  extra.shape_count = KG_SCENE_MAX_SHAPES;
  for (int i = 0; i < KG_SCENE_MAX_SHAPES; i++) {
    extra.shapes[i] = ground.shapes[0];
  }
  kg_error error = {.text = ""};
  assert_int_equal(kg_subject_create(&subject, clip, &def, &error), KG_ERR_UNSUPPORTED);
  assert_null(subject);
  assert_non_null(strstr(error.text, "shapes"));
  kg_clip_destroy(clip);
}

/* A state between two: half the way in position and angle; at and beyond the ends the end's bits. */
static void states_between_frames(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(3, 0.01);
  pose_standing(clip, 1, 0.2, 0.1, 0.0);
  pose_leg(clip, 1, 0, kg_vec3_make(0.2, STANDING_HIPS + 0.1, 0),
           kg_vec3_make(0.3, STANDING_ANKLE + 0.4, 0.2), kg_quat_identity());
  kg_subject *subject = subject_of(clip, NULL);
  const kg_body *body = subject->body;
  const size_t nq = (size_t)body->nq;
  double q[200], d[200], whole[200];
  kg_states_at(body, q, subject->q, 3, 0.25);
  kg_body_difference(body, whole, subject->q + nq, subject->q);
  kg_body_difference(body, d, q, subject->q);
  double largest = 0.0;
  for (int i = 0; i < body->nv; i++) {
    assert_close(d[i], 0.25 * whole[i], 1e-12);
    largest = fmax(largest, i >= 3 ? fabs(whole[i]) : 0.0);
  }
  assert_true(largest > 0.5);
  const double at[][2] = {{-1.0, 0}, {0.0, 0}, {1.0, 1}, {2.0, 2}, {7.0, 2}};
  for (size_t i = 0; i < KG_COUNT_OF(at); i++) {
    kg_states_at(body, q, subject->q, 3, at[i][0]);
    assert_memory_equal(q, subject->q + (size_t)at[i][1] * nq, nq * sizeof(double));
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(5, 0.01);
  int allowed = 0;
  for (; allowed < 100; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_subject_def def = kg_subject_default_def();
    def.allocator = &allocator;
    kg_subject *subject;
    kg_error error = {.text = ""};
    const kg_status status = kg_subject_create(&subject, clip, &def, &error);
    if (status == KG_OK) {
      assert_true(heap.live_bytes > 0);
      kg_subject_destroy(subject);
      assert_int_equal(heap.live_bytes, 0);
      break;
    }
    assert_int_equal(status, KG_ERR_NO_MEMORY);
    assert_null(subject);
    assert_int_equal(heap.live_bytes, 0);
    assert_true(error.text[0] != '\0');
  }
  assert_true(allowed > 2 && allowed < 100);
  kg_subject_destroy(NULL);
  kg_clip_destroy(clip);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(states_are_the_poses_of_the_clip),
    cmocka_unit_test(states_survive_the_clip),
    cmocka_unit_test(an_inserted_first_frame_is_no_motion),
    cmocka_unit_test(other_clips_are_refused),
    cmocka_unit_test(a_clip_without_legs_is_refused),
    cmocka_unit_test(shapes_join_the_ground),
    cmocka_unit_test(soft_distance_is_from_the_outside_of_layers),
    cmocka_unit_test(soles_rest_in_the_layer),
    cmocka_unit_test(states_between_frames),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("subject", tests, NULL, NULL);
}
