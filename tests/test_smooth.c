/* The kinematic method of kg_correct: what goes into the ground comes out of it, smoothly. */
#include "fixture_clip.h"
#include "mesh_support.h"

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"

/* One rate for all: the ease time of pipeline/smooth.c is 0.1 s, five frames. */
static const double DT = 0.02;
static const double EASE_S = 0.1;
static const double DIP_M = 0.03;
enum { DIP_FIRST = 40, DIP_END = 50, LIFT_FIRST = 70, T_DIP = 230 };

/* Stands; the left foot jumps DIP_M down for 0.2 s (a glitch of the capture, from one frame to the
 * next); from LIFT_FIRST on the whole body is 0.3 m up. */
static kg_clip *dipping_clip(void)
{
  kg_clip *clip = person_clip(T_DIP, DT);
  for (int t = 0; t < T_DIP; t++) {
    const double up = t >= LIFT_FIRST ? 0.3 : 0.0;
    const double dip = t >= DIP_FIRST && t < DIP_END ? DIP_M : 0.0;
    pose_person(clip, t, kg_vec3_make(0.0, STANDING_HIPS + up - 0.15, 0.0),
                kg_vec3_make(0.1, STANDING_ANKLE + up - dip, 0.0),
                kg_vec3_make(-0.1, STANDING_ANKLE + up, 0.0));
  }
  return clip;
}

static kg_correct_result *sdf_result(const kg_subject *subject)
{
  kg_correct_def def = kg_correct_default_def();
  def.method = KG_CORRECT_SDF;
  kg_correct_result *result;
  kg_error error = {.text = ""};
  if (kg_correct(&result, subject, &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return result;
}

/* heights above the scene of every point, by a plain loop; returns the least */
static double point_heights(const kg_subject *subject, kg_dynamics *dynamics, const double *q,
                            double *phi)
{
  const kg_body *body = subject->body;
  double least = INFINITY;
  for (int k = 0; k < body->point_count; k++) {
    const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q, body->points[k]);
    const double distance = kg_scene_distance(&subject->scene, x).distance;
    if (phi) {
      phi[k] = distance;
    }
    least = fmin(least, distance);
  }
  return least;
}

/* sole node 0 of the left foot, height */
static double heel_height(const kg_subject *subject, kg_dynamics *dynamics, const double *q)
{
  const kg_body_point *heel = &subject->body->points[0];
  return kg_dynamics_point(dynamics, NULL, q, *heel).y;
}

static void a_dip_is_removed_without_a_pop(void **state)
{
  (void)state;
  kg_clip *clip = dipping_clip();
  kg_subject *subject = subject_on(clip, 0.0);
  kg_correct_result *result = sdf_result(subject);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  const size_t nq = (size_t)subject->body->nq;
  const double deepest = point_heights(subject, dynamics, subject->q + DIP_FIRST * nq, NULL);
  assert_true(deepest < -0.9 * DIP_M); /* the test's own premise */

  double change[T_DIP];
  for (int t = 0; t < T_DIP; t++) {
    const double *q = result->q + (size_t)t * nq, *q0 = subject->q + (size_t)t * nq;
    const double low = point_heights(subject, dynamics, q, NULL);
    assert_at_most(-low, 1e-5);
    assert_close(result->penetration[t], fmax(0.0, -low), 1e-9);
    change[t] = heel_height(subject, dynamics, q) - heel_height(subject, dynamics, q0);
  }
  /* out of the ground, and not much further */
  assert_true(change[DIP_FIRST + 4] > 0.95 * DIP_M && change[DIP_FIRST + 4] < 1.3 * DIP_M);
  /* eased in and out: held at h and free outside, the least |D|^2 + tau^4 |D''|^2 bends by h/tau^2 at
   * the ends; a correction of each frame alone would bend by h/dt^2, 25 times more */
  double sharpest = 0.0;
  for (int t = 1; t + 1 < T_DIP; t++) {
    sharpest = fmax(sharpest, fabs(change[t - 1] - 2.0 * change[t] + change[t + 1]) / (DT * DT));
  }
  assert_at_most(sharpest, 3.0 * DIP_M / (EASE_S * EASE_S));
  assert_true(sharpest > 0.3 * DIP_M / (EASE_S * EASE_S));

  /* far away in time nothing has changed */
  double moved[3 + 3 * 64];
  for (int t = T_DIP - 30; t < T_DIP; t++) {
    kg_body_difference(subject->body, moved, result->q + (size_t)t * nq,
                       subject->q + (size_t)t * nq);
    for (int i = 0; i < subject->body->nv; i++) {
      assert_at_most(fabs(moved[i]), 1e-9);
    }
  }
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* Waves of a mesh of small faces, 2 m along x and 1 m wide. */
static kg_mesh *waves(double height, double length)
{
  enum { COLUMNS = 50, ROWS = 24 };
  static soup s;
  s.vertex_count = s.triangle_count = 0;
  for (int i = 0; i <= ROWS; i++) {
    for (int j = 0; j <= COLUMNS; j++) {
      const double x = 2.0 * j / COLUMNS - 1.0, z = 1.0 * i / ROWS - 0.5;
      (void)add_vertex(&s, kg_vec3_make(x, height * sin(6.283185307179586 * x / length), z));
    }
  }
  for (int i = 0; i < ROWS; i++) {
    for (int j = 0; j < COLUMNS; j++) {
      const int a = i * (COLUMNS + 1) + j, b = a + COLUMNS + 1;
      add_triangle(&s, a, b, a + 1);
      add_triangle(&s, a + 1, b, b + 1);
    }
  }
  return build_mesh(&s, NULL);
}

/* A body that glides over the edges of a mesh goes up and down with its waves, not with its faces. */
static void faces_of_a_mesh_are_not_felt(void **state)
{
  (void)state;
  enum { T = 60 };
  const double HEIGHT = 0.01, LENGTH = 0.8, SPEED = 0.6;
  kg_mesh *mesh = waves(HEIGHT, LENGTH);
  kg_clip *clip = person_clip(T, DT);
  for (int t = 0; t < T; t++) {
    pose_standing(clip, t, SPEED * DT * t - 0.4, 0.0, 0.0);
  }
  kg_subject *subject = subject_on(clip, 0.0);
  subject->scene.shape_count = 0;
  const kg_sdf_shape shape = {.kind = KG_SHAPE_MESH, .mesh = mesh};
  assert_true(kg_scene_add(&subject->scene, &shape));
  kg_correct_result *result = sdf_result(subject);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  const size_t nq = (size_t)subject->body->nq;
  double before = 0.0, sharpest = 0.0;
  for (int t = 0; t < T; t++) {
    before = fmax(before, -point_heights(subject, dynamics, subject->q + (size_t)t * nq, NULL));
    assert_at_most(-point_heights(subject, dynamics, result->q + (size_t)t * nq, NULL), 1e-5);
    if (t == 0 || t + 1 == T) continue;
    const double *q = result->q + (size_t)t * nq;
    for (int side = 0; side < 2; side++) {
      const kg_body_point *heel = &subject->body->points[side * KG_SOLE_NODE_COUNT];
      const double h[3] = {kg_dynamics_point(dynamics, NULL, q - nq, *heel).y,
                           kg_dynamics_point(dynamics, NULL, q, *heel).y,
                           kg_dynamics_point(dynamics, NULL, q + nq, *heel).y};
      sharpest = fmax(sharpest, fabs(h[0] - 2.0 * h[1] + h[2]) / (DT * DT));
    }
  }
  print_message("  %.1f mm deep, %.2f m/s2 at most\n", 1e3 * before, sharpest);
  assert_true(before > 0.8 * HEIGHT);
  /* the ease's own, and that of the waves */
  const double turn = 6.283185307179586 * SPEED / LENGTH;
  assert_at_most(sharpest, HEIGHT / (EASE_S * EASE_S) + HEIGHT * turn * turn);
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  kg_mesh_destroy(mesh);
}

/* The body is raised a little and the left leg folded a little: the right foot is not simply lifted
 * together with the left one. */
static void the_other_foot_moves_less(void **state)
{
  (void)state;
  kg_clip *clip = dipping_clip();
  kg_subject *subject = subject_on(clip, 0.0);
  kg_correct_result *result = sdf_result(subject);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  const kg_body_point *heel = &subject->body->points[KG_SOLE_NODE_COUNT];
  for (int t = DIP_FIRST; t < DIP_END; t++) {
    const size_t at = (size_t)t * (size_t)subject->body->nq;
    const kg_vec3 x = kg_dynamics_point(dynamics, NULL, result->q + at, *heel);
    const kg_vec3 x0 = kg_dynamics_point(dynamics, NULL, subject->q + at, *heel);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(x, x0)), 0.7 * DIP_M);
  }
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void motion_above_the_ground_is_left_alone(void **state)
{
  (void)state;
  kg_clip *clip = dipping_clip(), *out;
  kg_random random = kg_random_make(8); /* quaternions that renormalising would change */
  for (int t = 0; t < T_DIP; t++) {
    for (int j = 1; j < 14; j++) { /* trunk, head and arms */
      kg_clip_set_rotation(clip, t, j, kg_quat_exp(random_vec3(&random, 0.1)), -1);
    }
  }
  kg_subject *subject = subject_on(clip, 0.0);
  subject->scene = kg_scene_ground(-0.05, kg_vec3_make(0, 1, 0));
  kg_correct_result *result = sdf_result(subject);
  const size_t states = (size_t)subject->frame_count * (size_t)subject->body->nq;
  assert_memory_equal(result->q, subject->q, states * sizeof(double));
  assert_int_equal(kg_clip_copy(&out, clip), KG_OK);
  kg_correct_apply(result, subject, out);
  assert_memory_equal(out->values, clip->values,
                      (size_t)clip->frame_count * (size_t)clip->channel_count * sizeof(double));
  assert_null(result->tau);
  assert_null(result->feet);
  kg_clip_destroy(out);
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void short_clips_are_corrected_too(void **state)
{
  (void)state;
  for (int T = 1; T <= 3; T++) {
    kg_clip *clip = standing_clip(T, DT);
    kg_subject *subject = subject_on(clip, 0.0);
    subject->scene = kg_scene_ground(0.02, kg_vec3_make(0, 1, 0)); /* the feet are 2 cm deep */
    kg_correct_result *result = sdf_result(subject);
    kg_dynamics *dynamics;
    assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
    assert_int_equal(result->frame_count, T);
    for (int t = 0; t < T; t++) {
      const size_t at = (size_t)t * (size_t)subject->body->nq;
      assert_at_most(point_heights(subject, dynamics, subject->q + at, NULL), -0.015);
      assert_at_most(-point_heights(subject, dynamics, result->q + at, NULL), 1e-5);
    }
    kg_dynamics_destroy(dynamics);
    kg_correct_result_destroy(result);
    kg_subject_destroy(subject);
    kg_clip_destroy(clip);
  }
}

static bool refuse(double share, const char *stage, void *user)
{
  assert_true(share >= 0.0 && share <= 1.0);
  assert_non_null(stage);
  ++*(int *)user;
  return false;
}

static void progress_may_stop_it(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(5, DT);
  kg_subject *subject = subject_on(clip, 0.0);
  subject->scene = kg_scene_ground(0.02, kg_vec3_make(0, 1, 0));
  int calls = 0;
  kg_correct_def def = kg_correct_default_def();
  def.method = KG_CORRECT_SDF;
  def.progress = refuse;
  def.progress_user = &calls;
  kg_correct_result *result;
  assert_int_equal(kg_correct(&result, subject, &def, NULL), KG_OK);
  assert_true(result->interrupted);
  assert_int_equal(calls, 1); /* not asked again */
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void refuse_memory(bool self)
{
  kg_clip *clip = standing_clip(4, DT);
  kg_subject *subject = subject_on(clip, 0.0);
  subject->scene = kg_scene_ground(0.02, kg_vec3_make(0, 1, 0));
  subject->self = self;
  int allowed = 0;
  for (; allowed < 200; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_correct_def def = kg_correct_default_def();
    def.method = KG_CORRECT_SDF;
    def.allocator = &allocator;
    kg_correct_result *result;
    kg_error error = {.text = ""};
    const kg_status status = kg_correct(&result, subject, &def, &error);
    if (status == KG_OK) {
      kg_correct_result_destroy(result);
      assert_int_equal(heap.live_bytes, 0);
      break;
    }
    assert_int_equal(status, KG_ERR_NO_MEMORY);
    assert_null(result);
    assert_int_equal(heap.live_bytes, 0);
    assert_true(error.text[0] != '\0');
  }
  assert_true(allowed > 3 && allowed < 200);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  refuse_memory(false);
  refuse_memory(true);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(a_dip_is_removed_without_a_pop),
    cmocka_unit_test(faces_of_a_mesh_are_not_felt),
    cmocka_unit_test(the_other_foot_moves_less),
    cmocka_unit_test(motion_above_the_ground_is_left_alone),
    cmocka_unit_test(short_clips_are_corrected_too),
    cmocka_unit_test(progress_may_stop_it),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("smooth", tests, NULL, NULL);
}
