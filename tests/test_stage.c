/* Another athlete in the scene: where its shapes are and how they move, and both methods of
 * correction against it. */
#include "support.h"

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"
#include "kinegrad/stage.h"

typedef struct athlete {
  kg_clip *clip;
  kg_subject *subject;
} athlete;

/* the walker, moved along x, every `stride`-th frame of it */
static athlete walker(double x, int stride, const kg_subject *other)
{
  athlete a = {0};
  const kg_clip_def def = kg_clip_default_def();
  kg_error error = {0};
  if (kg_clip_read(&a.clip, KG_TEST_DATA "/walker.bvh", &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  kg_clip *whole = a.clip;
  assert_int_equal(kg_clip_resample(&a.clip, whole, stride * whole->frame_time), KG_OK);
  kg_clip_destroy(whole);
  kg_clip *clip = a.clip;
  for (int t = 0; t < clip->frame_count; t++) {
    const kg_vec3 at = clip->translations[(size_t)t * (size_t)clip->joint_count];
    kg_clip_set_translation(clip, t, 0, kg_vec3_make(at.x + x, at.y, at.z));
  }
  kg_subject_def subject = kg_subject_default_def();
  subject.other = other;
  if (kg_subject_create(&a.subject, clip, &subject, &error) != KG_OK) fail_msg("%s", error.text);
  return a;
}

static void release(athlete *a)
{
  kg_subject_destroy(a->subject);
  kg_clip_destroy(a->clip);
}

static const double *state(const kg_subject *s, int t)
{
  return s->q + (size_t)t * (size_t)s->body->nq;
}

static kg_vec3 root_of(const kg_subject *s, int t)
{
  const double *q = state(s, t);
  return kg_vec3_make(q[0], q[1], q[2]);
}

/* On a frame of the other clip its shapes are where kg_dynamics_pose puts its segments: every shape
 * is asked by itself, in the axes of its segment. */
static void shapes_are_where_the_other_body_is(void **state_)
{
  (void)state_;
  athlete b = walker(0.5, 1, NULL), a = walker(0.0, 1, b.subject);
  const kg_body *body = b.subject->body;
  kg_stage *stage = NULL;
  assert_int_equal(kg_stage_create(&stage, a.subject, KG_STAGE_OTHER_ONLY, NULL), KG_OK);
  kg_dynamics *dynamics = NULL;
  assert_int_equal(kg_dynamics_create(&dynamics, body, NULL), KG_OK);
  kg_vec3 p[64];
  kg_mat3 R[64];
  kg_random random = kg_random_make(1);
  for (int t = 0; t < b.subject->frame_count; t += 5) {
    kg_stage_set(stage, t * b.subject->dt, root_of(a.subject, t));
    const kg_scene *scene = kg_stage_scene(stage);
    assert_int_equal(scene->shape_count, body->shape_count);
    kg_dynamics_pose(dynamics, state(b.subject, t), p, R);
    for (int i = 0; i < 50; i++) {
      const kg_vec3 x = kg_vec3_add(root_of(b.subject, t), random_vec3(&random, 0.4));
      double least = INFINITY;
      for (int k = 0; k < body->shape_count; k++) {
        const kg_body_shape *s = &body->shapes[k];
        const kg_vec3 y = kg_mat3_mul_vec_t(R[s->segment], kg_vec3_sub(x, p[s->segment]));
        const kg_sdf_value v = s->kind == KG_BODY_CAPSULE ? kg_sdf_capsule(s->a, s->b, s->radius, y)
                               : s->kind == KG_BODY_ELLIPSOID
                                 ? kg_sdf_ellipsoid(s->a, s->orientation, s->b, y)
                                 : kg_sdf_box(s->a, s->orientation, s->b, y);
        least = fmin(least, v.distance);
      }
      assert_close(kg_scene_distance(scene, x).distance, least, 1e-12);
    }
  }
  kg_dynamics_destroy(dynamics);
  kg_stage_destroy(stage);
  release(&a);
  release(&b);
}

/* dPhi/dt of points at rest against the velocity of the surface. */
static void shapes_move_as_they_say(void **state_)
{
  (void)state_;
  athlete b = walker(0.5, 2, NULL), a = walker(0.0, 1, b.subject);
  kg_stage *stage = NULL;
  assert_int_equal(kg_stage_create(&stage, a.subject, KG_STAGE_OTHER_ONLY, NULL), KG_OK);
  kg_random random = kg_random_make(2);
  int checked = 0;
  for (int i = 0; i < 300; i++) {
    const double frame = 3.0 + 15.0 * kg_random_uniform(&random), dt = b.subject->dt;
    const kg_vec3 root = root_of(a.subject, (int)(2.0 * frame));
    const kg_vec3 x = kg_vec3_add(root_of(b.subject, (int)frame), random_vec3(&random, 0.4));
    kg_stage_set(stage, frame * dt, root);
    const kg_scene_point at = kg_scene_nearest(kg_stage_scene(stage), x);
    /* the velocity is that over a whole frame */
    double phi[2];
    kg_vec3 turned[2];
    for (int k = 0; k < 2; k++) {
      kg_stage_set(stage, (frame + (k ? 0.5 : -0.5)) * dt, root);
      const kg_scene_point then = kg_scene_nearest(kg_stage_scene(stage), x);
      phi[k] = then.value.distance;
      turned[k] = kg_vec3_sub(then.value.normal, at.value.normal);
    }
    if (kg_vec3_norm(turned[0]) + kg_vec3_norm(turned[1]) > 0.1) continue;
    const double rate = (phi[1] - phi[0]) / dt, speed = kg_vec3_norm(at.velocity);
    assert_at_most(fabs(rate + kg_vec3_dot(at.value.normal, at.velocity)), 0.05 * (speed + 0.1));
    checked++;
  }
  assert_true(checked > 80);
  kg_stage_destroy(stage);
  release(&a);
  release(&b);
}

/* Half its frame rate: between two of its frames it is in the middle; after its end it is gone, and
 * far away as well. */
static void time_is_that_of_the_clips(void **state_)
{
  (void)state_;
  athlete b = walker(0.5, 2, NULL), a = walker(0.0, 1, b.subject);
  assert_close(b.subject->dt, 2.0 * a.subject->dt, 1e-12);
  kg_stage *stage = NULL;
  assert_int_equal(kg_stage_create(&stage, a.subject, KG_STAGE_ALL, NULL), KG_OK);
  const kg_scene *scene = kg_stage_scene(stage);
  const int own = a.subject->scene.shape_count, all = own + b.subject->body->shape_count;
  const double end = (b.subject->frame_count - 1) * b.subject->dt;
  kg_stage_set(stage, 7.0 * a.subject->dt, root_of(a.subject, 7));
  assert_int_equal(scene->shape_count, all);
  int root = 0; /* a shape of the root */
  while (b.subject->body->shapes[root].segment != 0) {
    root++;
  }
  const int pelvis = scene->shapes[own + root].place;
  const kg_vec3 middle = kg_vec3_lerp(root_of(b.subject, 3), root_of(b.subject, 4), 0.5);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(scene->places[pelvis - 1].at, middle)), 1e-12);
  kg_stage_set(stage, end, root_of(a.subject, 0));
  assert_int_equal(scene->shape_count, all);
  kg_stage_set(stage, end + 0.5 * a.subject->dt, root_of(a.subject, 0));
  assert_int_equal(scene->shape_count, own);
  kg_stage_set(stage, -0.5 * a.subject->dt, root_of(a.subject, 0));
  assert_int_equal(scene->shape_count, own);
  kg_stage_set(stage, 0.0, root_of(a.subject, 0));
  assert_int_equal(scene->shape_count, all);
  kg_stage_set(stage, -0.5 * a.subject->dt, root_of(a.subject, 0));
  assert_int_equal(scene->shape_count, own);
  /* within reach: as far as both are tall, one lying towards the other */
  const double tall = a.subject->body->stature + b.subject->body->stature;
  kg_vec3 beside = root_of(b.subject, 0);
  beside.x += tall;
  kg_stage_set(stage, 0.0, beside);
  assert_int_equal(scene->shape_count, all);
  kg_stage_set(stage, 0.0, kg_vec3_make(30.0, 1.0, 0.0));
  assert_int_equal(scene->shape_count, own);
  kg_stage_destroy(stage);
  release(&a);
  release(&b);
}

/* A scene has room for all shapes of a body, with a place for each segment that has any, or none. */
static void room_is_counted(void **state_)
{
  (void)state_;
  athlete a = walker(0.0, 1, NULL);
  const kg_body *body = a.subject->body;
  bool has[64] = {false};
  int places = 0;
  for (int k = 0; k < body->shape_count; k++) {
    places += !has[body->shapes[k].segment];
    has[body->shapes[k].segment] = true;
  }
  assert_true(places > 1 && places <= body->shape_count);
  kg_scene scene = {.shape_count = KG_SCENE_MAX_SHAPES - body->shape_count,
                    .place_count = KG_SCENE_MAX_PLACES - places};
  assert_true(kg_stage_has_room(&scene, body));
  scene.shape_count++;
  assert_false(kg_stage_has_room(&scene, body));
  scene.shape_count--;
  scene.place_count++;
  assert_false(kg_stage_has_room(&scene, body));
  release(&a);
}

/* Places of the scene itself go on with their velocity. */
static void a_ball_flies_on(void **state_)
{
  (void)state_;
  athlete a = walker(0.0, 1, NULL);
  kg_scene *scene = &a.subject->scene;
  const kg_place place = {.at = {1.0, 2.0, 3.0},
                          .turn = kg_quat_exp(kg_vec3_make(0.0, 0.0, 0.5 * 3.14159265358979323846)),
                          .velocity = {0.5, 0.0, -1.0},
                          .spin = {0.0, 2.0, 0.0}};
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE,
                             .a = {0.0, -0.3, 0.0}, /* by the turn: (0.3, 0, 0) */
                             .radius = 0.1,
                             .place = kg_scene_add_place(scene, &place)};
  assert_true(kg_scene_add(scene, &ball));
  kg_stage *stage = NULL;
  assert_int_equal(kg_stage_create(&stage, a.subject, KG_STAGE_ALL, NULL), KG_OK);
  kg_stage_set(stage, 0.5, root_of(a.subject, 0));
  /* turned by 1 rad about y, 0.25 m and -0.5 m on */
  const kg_vec3 centre = kg_vec3_make(1.25 + 0.3 * cos(1.0), 2.0, 2.5 - 0.3 * sin(1.0));
  assert_close(kg_scene_distance(kg_stage_scene(stage), centre).distance, -0.1, 1e-12);
  kg_stage_destroy(stage);
  release(&a);
}

/* What spins goes on from the way the file turned it: the spin is about the world's axes. */
static void a_turned_place_spins_on(void **state_)
{
  (void)state_;
  athlete a = walker(0.0, 1, NULL);
  kg_scene *scene = &a.subject->scene;
  const double right = 0.5 * acos(-1.0);
  const kg_place place = {.at = {1.0, 2.0, 3.0},
                          .turn = kg_quat_exp(kg_vec3_make(0.0, 0.0, right)),
                          .spin = {right, 0.0, 0.0}};
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE,
                             .a = {0.3, 0.0, 0.0},
                             .radius = 0.1,
                             .place = kg_scene_add_place(scene, &place)};
  assert_true(kg_scene_add(scene, &ball));
  kg_stage *stage = NULL;
  assert_int_equal(kg_stage_create(&stage, a.subject, KG_STAGE_ALL, NULL), KG_OK);
  kg_stage_set(stage, 1.0, root_of(a.subject, 0)); /* x to y by the turn, y to z by the spin */
  assert_close(kg_scene_distance(kg_stage_scene(stage), kg_vec3_make(1.0, 2.0, 3.3)).distance, -0.1,
               1e-12);
  kg_stage_destroy(stage);
  release(&a);
}

/* Deepest point of a state in the other's shapes, by plain loops; *worst, where it is deeper. */
static double depth(kg_stage *stage, const kg_subject *subject, kg_dynamics *dynamics,
                    const double *q, int t, kg_deepest *worst)
{
  double deepest = 0.0;
  kg_stage_set(stage, t * subject->dt, kg_vec3_make(q[0], q[1], q[2]));
  for (int k = 0; k < subject->body->point_count; k++) {
    const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q, subject->body->points[k]);
    for (int i = 0; i < kg_stage_scene(stage)->shape_count; i++) {
      kg_sdf_value v;
      assert_true(kg_scene_shape_distance(kg_stage_scene(stage), i, x, INFINITY, &v));
      deepest = fmax(deepest, -v.distance);
      if (-v.distance > worst->depth) {
        *worst = (kg_deepest){-v.distance, t, subject->body->points[k].segment,
                              subject->other->body->shapes[i].segment};
      }
    }
  }
  return deepest;
}

static void both_methods_lead_out(void **state_)
{
  (void)state_;
  athlete b = walker(0.62, 2, NULL), a = walker(0.0, 1, b.subject);
  const kg_subject *s = a.subject;
  kg_stage *stage = NULL;
  kg_dynamics *dynamics = NULL;
  assert_int_equal(kg_stage_create(&stage, s, KG_STAGE_OTHER_ONLY, NULL), KG_OK);
  assert_int_equal(kg_dynamics_create(&dynamics, s->body, NULL), KG_OK);
  for (int method = 0; method < 2; method++) {
    kg_correct_def def = kg_correct_default_def();
    def.method = method == 0 ? KG_CORRECT_SDF : KG_CORRECT_TRACK;
    kg_correct_result *result = NULL;
    kg_error error = {0};
    if (kg_correct(&result, s, &def, &error) != KG_OK) fail_msg("%s", error.text);
    kg_metrics *metrics = NULL;
    assert_int_equal(kg_metrics_create(&metrics, s, result->q), KG_OK);
    double before = 0.0, after = 0.0, sum = 0.0;
    int frames = 0, events = 0;
    kg_deepest worst = {.depth = 0.0}, worst_left = {.depth = 0.0};
    for (int t = 0; t < s->frame_count; t++) {
      const double *out = result->q + (size_t)t * (size_t)result->nq;
      const double d = depth(stage, s, dynamics, state(s, t), t, &worst);
      const double left = depth(stage, s, dynamics, out, t, &worst_left);
      before = fmax(before, d);
      after = fmax(after, left);
      frames += d > KG_METRIC_TOUCH_DEPTH_M;
      sum += d > KG_METRIC_TOUCH_DEPTH_M ? d : 0.0;
      events += d > KG_METRIC_EVENT_DEPTH_M;
      assert_close(metrics->other_penetration_frame_m[t], left, 1e-12);
    }
    print_message("%s: %d frames, %.1f mm deep before, %.4f mm after; moved %.1f mm, %.1f at most, "
                  "acceleration %.1f\n",
                  method == 0 ? "sdf" : "track", frames, 1e3 * before, 1e3 * after,
                  1e3 * metrics->mpjpe_m, 1e3 * metrics->mpjpe_max_m,
                  metrics->acceleration_peak_ratio);
    assert_true(frames > 5 && before > 0.02);
    assert_at_most(after, KG_METRIC_TOUCH_DEPTH_M);
    assert_close(metrics->capture.other_penetration_max_m, before, 1e-12);
    assert_close(metrics->capture.other_penetration_mean_m, sum / frames, 1e-12);
    const kg_deepest *found = &metrics->capture_deepest[KG_OBSTACLE_OTHER];
    assert_close(found->depth, worst.depth, 1e-12);
    assert_int_equal(found->frame, worst.frame);
    assert_int_equal(found->segment, worst.segment);
    assert_int_equal(found->entered, worst.entered);
    assert_close(metrics->output_deepest[KG_OBSTACLE_OTHER].depth, worst_left.depth, 1e-12);
    assert_close(metrics->capture.other_frames, frames, 1e-12);
    assert_close(metrics->capture.other_penetration_events, (double)events / s->frame_count, 1e-12);
    assert_close(metrics->output.other_frames, 0.0, 1e-12);
    assert_at_most(metrics->output.penetration_max_m, 1.1e-5); /* and not into the floor */
    assert_at_most(metrics->mpjpe_m, method == 0 ? 0.12 : 0.16);
    assert_at_most(metrics->mpjpe_max_m, method == 0 ? 0.3 : 0.45);
    kg_metrics_destroy(metrics);
    kg_correct_result_destroy(result);
  }
  kg_dynamics_destroy(dynamics);
  kg_stage_destroy(stage);
  release(&a);
  release(&b);
}

/* An athlete who is never near changes nothing. */
static void a_distant_athlete_changes_no_bit(void **state_)
{
  (void)state_;
  athlete b = walker(40.0, 1, NULL), a = walker(0.0, 1, b.subject), alone = walker(0.0, 1, NULL);
  for (int method = 0; method < 2; method++) {
    kg_correct_def def = kg_correct_default_def();
    def.method = method == 0 ? KG_CORRECT_SDF : KG_CORRECT_TRACK;
    kg_correct_result *x = NULL, *y = NULL;
    assert_int_equal(kg_correct(&x, a.subject, &def, NULL), KG_OK);
    assert_int_equal(kg_correct(&y, alone.subject, &def, NULL), KG_OK);
    assert_memory_equal(x->q, y->q, (size_t)(x->frame_count * x->nq) * sizeof *x->q);
    kg_correct_result_destroy(x);
    kg_correct_result_destroy(y);
  }
  release(&a);
  release(&b);
  release(&alone);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(shapes_are_where_the_other_body_is),
    cmocka_unit_test(shapes_move_as_they_say),
    cmocka_unit_test(time_is_that_of_the_clips),
    cmocka_unit_test(room_is_counted),
    cmocka_unit_test(a_ball_flies_on),
    cmocka_unit_test(a_turned_place_spins_on),
    cmocka_unit_test(both_methods_lead_out),
    cmocka_unit_test(a_distant_athlete_changes_no_bit),
  };
  return cmocka_run_group_tests_name("stage", tests, NULL, NULL);
}
