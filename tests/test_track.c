/* The tracking method of kg_correct on motions whose forces are known. */
#include "fixture_clip.h"

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"

#include <stdio.h>

static const double DT = 1.0 / 60.0;

static kg_correct_result *tracked(const kg_subject *subject, const kg_correct_def *given)
{
  const kg_correct_def def = given ? *given : kg_correct_default_def();
  kg_correct_result *result;
  kg_error error = {.text = ""};
  if (kg_correct(&result, subject, &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return result;
}

static kg_vec3 total_force(const kg_correct_result *r, int t)
{
  return kg_vec3_add(r->other_force[t],
                     kg_vec3_add(r->feet[2 * t].force, r->feet[2 * t + 1].force));
}

/* mean of what acts upwards on the body over frames [first, T): the ground, and the residual if
 * `all` */
static double mean_support(const kg_correct_result *r, int first, bool all)
{
  double sum = 0.0;
  for (int t = first; t < r->frame_count; t++) {
    sum += total_force(r, t).y + (all ? r->residual_force[t].y : 0.0);
  }
  return sum / (r->frame_count - first);
}

static double lowest_point(const kg_subject *subject, kg_dynamics *dynamics, const double *q)
{
  double least = INFINITY;
  for (int k = 0; k < subject->body->point_count; k++) {
    const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q, subject->body->points[k]);
    least = fmin(least, kg_scene_distance(&subject->scene, x).distance);
  }
  return least;
}

/* every number of a result, and unit quaternions */
static void assert_finite(const kg_correct_result *r)
{
  const size_t T = (size_t)r->frame_count;
  for (size_t i = 0; i < T * (size_t)r->nq; i++) {
    assert_true(isfinite(r->q[i]));
  }
  for (size_t i = 0; i < T * (size_t)r->nv; i++) {
    assert_true(isfinite(r->v[i]) && isfinite(r->tau[i]));
  }
  for (int t = 0; t < r->frame_count; t++) {
    assert_true(isfinite(kg_vec3_norm(r->residual_force[t])));
    assert_true(isfinite(kg_vec3_norm(r->residual_moment[t])));
    assert_true(isfinite(kg_vec3_norm(total_force(r, t))));
    assert_true(isfinite(r->penetration[t]) && isfinite(r->correction_force[t]));
    for (int i = 3; i + 4 <= r->nq; i += 4) {
      const double *q = r->q + (size_t)t * (size_t)r->nq + i;
      assert_close(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], 1.0, 1e-9);
    }
  }
}

/* Squats once and rises again, swaying a little. */
static kg_clip *squatting_clip(int T)
{
  kg_clip *clip = person_clip(T, DT);
  for (int t = 0; t < T; t++) {
    const double s = 0.5 - 0.5 * cos(6.283185307179586 * t / (T - 1.0));
    pose_person(clip, t, kg_vec3_make(0.01 * s, STANDING_HIPS - 0.12 * s, -0.02 * s),
                kg_vec3_make(0.1, STANDING_ANKLE, 0.0), kg_vec3_make(-0.1, STANDING_ANKLE, 0.0));
  }
  return clip;
}

/* Standing with 0.3 mm of noise on the hips: the ground carries the weight, and nothing else acts. */
static void standing_is_carried_by_the_ground(void **state)
{
  (void)state;
  enum { T = 60 };
  kg_clip *clip = standing_clip(T, DT);
  kg_random random = kg_random_make(3);
  for (int t = 0; t < T; t++) {
    const kg_vec3 noise = random_vec3(&random, 3e-4);
    pose_person(clip, t, kg_vec3_add(kg_vec3_make(0, STANDING_HIPS, 0), noise),
                kg_vec3_make(0.1, STANDING_ANKLE, 0), kg_vec3_make(-0.1, STANDING_ANKLE, 0));
  }
  kg_subject *subject = subject_of(clip, NULL);
  kg_correct_result *r = tracked(subject, NULL);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  const double weight = 9.8 * subject->body->mass;
  assert_finite(r);
  assert_int_equal(r->frame_count, T);
  assert_true(r->steps >= T - 1);
  assert_int_equal(r->steps_converged, r->steps);
  assert_int_equal(r->unexplained_count, 0);
  assert_close(mean_support(r, 15, false) / weight, 1.0, 0.01);
  assert_at_most(r->peak_grf, 1.5 * weight);
  assert_at_most(r->residual_force_rms, 0.02);
  assert_at_most(r->residual_moment_rms, 0.02);

  const size_t nq = (size_t)r->nq;
  for (int t = 0; t < T; t++) {
    const double *q = r->q + (size_t)t * nq;
    assert_at_most(-lowest_point(subject, dynamics, q), 1e-5);
    assert_at_most(r->penetration[t], 1e-5);
    /* both feet carry, at places under the feet */
    for (int f = 0; f < 2 && t >= 15; f++) {
      const kg_foot_force *foot = &r->feet[2 * t + f];
      assert_true(foot->force.y > 0.25 * weight && foot->force.y < 0.75 * weight);
      assert_at_most(fabs(foot->cop.x - (f == 0 ? 0.1 : -0.1)), 0.06);
      assert_true(foot->cop.z > -0.1 && foot->cop.z < 0.25);
      assert_at_most(fabs(foot->cop.y), 1e-9);
    }
  }
  /* the soles stay where they are */
  for (int k = 0; k < subject->body->sole_node_count; k++) {
    const kg_body_point node = subject->body->points[k];
    const kg_vec3 first = kg_dynamics_point(dynamics, NULL, r->q + 15 * nq, node);
    const kg_vec3 last = kg_dynamics_point(dynamics, NULL, r->q + (T - 1) * nq, node);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(first, last)), 1e-3);
  }
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* Newton's second law over the whole squat: the impulse of all forces is the change of momentum. */
static void forces_explain_the_momentum(void **state)
{
  (void)state;
  enum { T = 60 };
  kg_clip *clip = squatting_clip(T);
  kg_subject *subject = subject_of(clip, NULL);
  kg_correct_result *r = tracked(subject, NULL);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  const double mass = subject->body->mass;
  const size_t nq = (size_t)r->nq, nv = (size_t)r->nv;
  assert_int_equal(r->steps_converged, r->steps);
  assert_int_equal(r->steps % (T - 1), 0);
  double worst = 0.0, moved = 0.0;
  kg_vec3 impulse = {0.0, 0.0, 0.0};
  for (int t = 11; t < T; t++) {
    const kg_vec3 f = kg_vec3_add(total_force(r, t), r->residual_force[t]);
    impulse = kg_vec3_add_scaled(impulse, DT, kg_vec3_add(f, kg_vec3_make(0, -9.8 * mass, 0)));
    const kg_centroid a = kg_dynamics_centroid(dynamics, r->q + 10 * nq, r->v + 10 * nv);
    const kg_centroid b =
      kg_dynamics_centroid(dynamics, r->q + (size_t)t * nq, r->v + (size_t)t * nv);
    const kg_vec3 change = kg_vec3_scale(mass, kg_vec3_sub(b.com_dot, a.com_dot));
    worst = fmax(worst, kg_vec3_norm(kg_vec3_sub(impulse, change)));
    moved = fmax(moved, kg_vec3_norm(change));
  }
  assert_true(moved > 10.0); /* kg m/s: the premise, it does move */
  assert_at_most(worst, 0.1 * moved);
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void assert_same(const kg_correct_result *a, const kg_correct_result *b)
{
  const size_t T = (size_t)a->frame_count, nq = (size_t)a->nq, nv = (size_t)a->nv;
  assert_int_equal(a->frame_count, b->frame_count);
  assert_memory_equal(a->q, b->q, T * nq * sizeof(double));
  assert_memory_equal(a->v, b->v, T * nv * sizeof(double));
  assert_memory_equal(a->tau, b->tau, T * nv * sizeof(double));
  assert_memory_equal(a->residual_force, b->residual_force, T * sizeof(kg_vec3));
  assert_memory_equal(a->residual_moment, b->residual_moment, T * sizeof(kg_vec3));
  assert_memory_equal(a->feet, b->feet, 2 * T * sizeof(kg_foot_force));
  assert_memory_equal(a->penetration, b->penetration, T * sizeof(double));
  assert_int_equal(a->newton_iterations, b->newton_iterations);
}

static void runs_are_equal_to_the_bit(void **state)
{
  (void)state;
  kg_clip *clip = squatting_clip(25);
  kg_subject *subject = subject_of(clip, NULL), *again = subject_of(clip, NULL);
  kg_correct_def two = kg_correct_default_def();
  two.threads = 2;
  kg_correct_result *a = tracked(subject, NULL), *b = tracked(again, NULL);
  kg_correct_result *c = tracked(subject, &two);
  assert_same(a, b);
  assert_same(a, c);
  kg_correct_result_destroy(a);
  kg_correct_result_destroy(b);
  kg_correct_result_destroy(c);
  kg_subject_destroy(subject);
  kg_subject_destroy(again);
  kg_clip_destroy(clip);
}

/* Longer and shorter steps than the frame: as many frames as before, close to the capture. */
static void any_step_gives_every_frame(void **state)
{
  (void)state;
  enum { T = 30 };
  kg_clip *clip = squatting_clip(T);
  kg_subject *subject = subject_of(clip, NULL);
  const double steps[] = {0.02, DT / 2.0, DT, 0.007};
  for (size_t i = 0; i < KG_COUNT_OF(steps); i++) {
    kg_correct_def def = kg_correct_default_def();
    def.dt = steps[i];
    kg_correct_result *r = tracked(subject, &def);
    assert_int_equal(r->frame_count, T);
    assert_finite(r);
    assert_in_range(r->steps, (long)floor((T - 1) * DT / steps[i] - 1e-6),
                    (long)ceil((T - 1) * DT / steps[i] + 1e-6));
    for (int t = 0; t < T; t++) {
      const size_t at = (size_t)t * (size_t)r->nq;
      for (int k = 0; k < 3; k++) {
        assert_close(r->q[at + (size_t)k], subject->q[at + (size_t)k], 0.03);
      }
      /* the deepest unweighting leaves 200 N: a frame without force was forgotten */
      assert_true(total_force(r, t).y > 100.0);
      assert_true(r->contact_count[t] > 0);
    }
    assert_close(mean_support(r, 2, true) / (9.8 * subject->body->mass), 1.0, 0.1);
    kg_correct_result_destroy(r);
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void gravity_sets_the_ground_reaction(void **state)
{
  (void)state;
  enum { T = 40 };
  kg_clip *clip = standing_clip(T, DT);
  kg_subject *subject = subject_of(clip, NULL);
  const double weight = 9.8 * subject->body->mass;
  const double gravity[] = {7.0, 19.6};
  for (int i = 0; i < 2; i++) {
    kg_correct_def def = kg_correct_default_def();
    def.gravity = gravity[i];
    kg_correct_result *r = tracked(subject, &def);
    assert_finite(r);
    assert_close(mean_support(r, 15, false) / weight, gravity[i] / 9.8, 0.01);
    kg_correct_result_destroy(r);
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static bool stop(double share, const char *stage, void *user)
{
  assert_true(share > 0.0 && share < 1.0);
  assert_non_null(stage);
  ++*(int *)user;
  return false;
}

static void progress_may_stop_it(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(80, DT);
  kg_subject *subject = subject_of(clip, NULL);
  int calls = 0;
  kg_correct_def def = kg_correct_default_def();
  def.progress = stop;
  def.progress_user = &calls;
  kg_correct_result *r = tracked(subject, &def);
  assert_true(r->interrupted);
  assert_int_equal(calls, 1);
  assert_int_equal(r->steps, 1); /* a step may take a second: it is asked after each */
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* The capture's feet are 2 cm in the ground in every frame, the first included. */
static void sunken_feet_are_raised(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(20, DT);
  kg_subject *subject = subject_of(clip, NULL);
  subject->scene = kg_scene_ground(0.02, kg_vec3_make(0, 1, 0));
  kg_correct_result *r = tracked(subject, NULL);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  assert_at_most(lowest_point(subject, dynamics, subject->q), -0.015);
  for (int t = 0; t < 20; t++) {
    const double *q = r->q + (size_t)t * (size_t)r->nq;
    assert_at_most(-lowest_point(subject, dynamics, q), 1e-5);
  }
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* Mats of three stiffnesses: the soles stand in the layer where the law says ten nodes carry the
 * weight, on the softest through to the core, which is not entered. */
static void soles_stand_in_a_soft_floor(void **state)
{
  (void)state;
  enum { T = 150 };
  const double stiffness[] = {5e4, 1e4, 1e2};
  kg_clip *clip = standing_clip(T, DT);
  for (size_t k = 0; k < KG_COUNT_OF(stiffness); k++) {
    const kg_ground mat = {
      .thickness = 0.03, .stiffness = stiffness[k], .damping = 0.5, .friction = -1.0};
    kg_subject_def def = kg_subject_default_def();
    def.floor_given = true;
    def.ground = &mat;
    kg_subject *subject = subject_of(clip, &def);
    assert_close(kg_scene_distance(&subject->scene, kg_vec3_make(1, 1, 1)).distance, 1.03, 1e-12);
    assert_close(kg_scene_surface(&subject->scene, kg_vec3_make(1, 1, 1)), 1.0, 1e-12);
    kg_correct_result *r = tracked(subject, NULL);
    kg_dynamics *dynamics;
    assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
    const double *q_end = r->q + (size_t)(T - 1) * (size_t)r->nq;
    const double lowest = lowest_point(subject, dynamics, q_end);
    const kg_contact_params law = kg_contact_default_params();
    double held = 0.0; /* by the law, at rest where the nodes are */
    for (int i = 0; i < 2 * KG_SOLE_NODE_COUNT; i++) {
      const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q_end, subject->body->points[i]);
      kg_contact_force f;
      (void)kg_contact_evaluate(&law, &subject->scene, x, kg_vec3_make(0, 0, 0), false, &f);
      held += f.normal;
    }
    const double weight = subject->body->mass * 9.8;
    const double carried = r->feet[2 * T - 2].force.y + r->feet[2 * T - 1].force.y;
    print_message("%g N/m: lowest point %.2f mm above the core; carries %.1f of %.1f N, by the law "
                  "%.1f N; residual %.1f %%\n",
                  stiffness[k], 1e3 * lowest, carried, weight, held, 1e2 * r->residual_force_rms);
    assert_true(lowest > 0.0);
    if (k < 2) assert_true(lowest > 2.0 * law.layer && lowest < mat.thickness + 0.5 * law.layer);
    if (k == 2) assert_true(lowest < law.layer); /* on the core */
    assert_at_most(fabs(held / weight - 1.0), 0.03);
    assert_at_most(fabs(carried / weight - 1.0), 0.05);
    assert_at_most(r->residual_force_rms, 0.05);
    for (int t = 0; t < T; t++) {
      assert_true(r->penetration[t] <= 1e-5);
    }
    kg_dynamics_destroy(dynamics);
    kg_correct_result_destroy(r);
    kg_subject_destroy(subject);
  }
  kg_clip_destroy(clip);
}

/* A ball that the chest is in from the start: it is left in every frame, the first included. */
static void an_obstacle_is_left_in_the_first_frame(void **state)
{
  (void)state;
  enum { T = 12 };
  kg_clip *clip = standing_clip(T, DT);
  kg_subject *subject = subject_of(clip, NULL);
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .a = {0.0, 1.25, 0.2}, .radius = 0.12};
  assert_true(kg_scene_add(&subject->scene, &ball));
  kg_correct_result *r = tracked(subject, NULL);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  assert_at_most(lowest_point(subject, dynamics, subject->q), -0.005);
  for (int t = 0; t < T; t++) {
    assert_at_most(-lowest_point(subject, dynamics, r->q + (size_t)t * (size_t)r->nq), 1e-5);
  }
  assert_finite(r);
  kg_dynamics_destroy(dynamics);
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void the_shortest_clips_are_tracked(void **state)
{
  (void)state;
  for (int T = 1; T <= 3; T++) {
    kg_clip *clip = standing_clip(T, DT), *out;
    kg_subject *subject = subject_of(clip, NULL);
    kg_correct_result *r = tracked(subject, NULL);
    assert_int_equal(r->frame_count, T);
    assert_finite(r);
    for (int i = 0; i < 3 * T; i++) {
      const size_t at = (size_t)(i / 3) * (size_t)r->nq + (size_t)(i % 3);
      assert_close(r->q[at], subject->q[at], 0.01);
    }
    assert_int_equal(kg_clip_copy(&out, clip), KG_OK);
    kg_correct_apply(r, subject, out);
    for (int i = 0; i < T * out->channel_count; i++) {
      assert_true(isfinite(out->values[i]));
    }
    kg_clip_destroy(out);
    kg_correct_result_destroy(r);
    kg_subject_destroy(subject);
    kg_clip_destroy(clip);
  }
}

/* Motionless a metre up, something must hold the body; in free fall nothing must. */
static void what_no_contact_explains_is_marked(void **state)
{
  (void)state;
  enum { T = 40 };
  const kg_vec3 up = {0.0, 1.0, 0.0};
  kg_clip *clip = standing_clip(T, DT);
  for (int t = 0; t < T; t++) { /* leans: the centre of mass is not above the root */
    kg_clip_set_rotation(clip, t, kg_clip_find(clip, "Spine"), turn_about(0.7, 0.0, 0.0), -1);
  }
  kg_subject *subject = subject_of(clip, NULL);
  subject->scene = kg_scene_ground(-1.0, up);
  kg_correct_result *r = tracked(subject, NULL);
  assert_in_range(r->unexplained_count, T - 4, T);
  int marked = 0;
  for (int t = 0; t < T; t++) {
    marked += r->unexplained[t];
  }
  assert_int_equal(marked, r->unexplained_count);
  /* the residual holds it, and says so: as much as the weight */
  assert_true(r->peak_grf == 0.0);
  assert_close(r->residual_force_rms, 1.0, 0.15);
  double moment = 0.0; /* a force at the centre of mass is nearly all it takes */
  for (int t = 15; t < T; t++) {
    moment += kg_vec3_norm(r->residual_moment[t]) / (T - 15);
  }
  assert_at_most(moment, 30.0); /* N m; about the root it would be 60 */
  for (int t = 0; t < T; t++) {
    kg_clip_set_rotation(clip, t, kg_clip_find(clip, "Spine"), kg_quat_identity(), -1);
  }
  kg_correct_result_destroy(r);
  kg_subject_destroy(subject);

  for (int t = 0; t < T; t++) {
    const double s = t * DT;
    pose_standing(clip, t, 0.5 * s, 3.2 * s - 4.9 * s * s, 0.0);
  }
  subject = subject_on(clip, 0.0);
  subject->scene = kg_scene_ground(-1.0, up);
  const double steps[] = {0.0, 0.02};
  for (int i = 0; i < 2; i++) {
    kg_correct_def def = kg_correct_default_def();
    def.dt = steps[i];
    r = tracked(subject, &def);
    assert_int_equal(r->unexplained_count, 0);
    /* nobody touches anything: the body falls freely, hardly helped, and is where the parabola is, also
     * between steps (a frame late would be 5 cm) */
    for (int t = 5; t < T - 5; t++) {
      assert_at_most(kg_vec3_norm(total_force(r, t)), 0.0);
      /* reading the capture between its frames costs some */
      assert_at_most(kg_vec3_norm(r->residual_force[t]),
                     (i == 0 ? 0.06 : 0.15) * 9.8 * subject->body->mass);
      const double s = t * DT;
      const double *q = r->q + (size_t)t * (size_t)r->nq;
      assert_close(q[0], 0.5 * s, 0.005);
      assert_close(q[1] - STANDING_HIPS, 3.2 * s - 4.9 * s * s, 0.01);
    }
    kg_correct_result_destroy(r);
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* A coarse sweep: there are many allocations. */
static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_clip *clip = standing_clip(3, DT);
  kg_subject *subject = subject_of(clip, NULL);
  int allowed = 0, refused = 0;
  for (; allowed < 4000; allowed += 1 + allowed / 16) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_correct_def def = kg_correct_default_def();
    def.allocator = &allocator;
    kg_correct_result *result;
    kg_error error = {.text = ""};
    const kg_status status = kg_correct(&result, subject, &def, &error);
    if (status == KG_OK) {
      assert_true(heap.live_bytes > 0);
      kg_correct_result_destroy(result);
      assert_int_equal(heap.live_bytes, 0);
      break;
    }
    refused++;
    assert_int_equal(status, KG_ERR_NO_MEMORY);
    assert_null(result);
    assert_int_equal(heap.live_bytes, 0);
    assert_true(error.text[0] != '\0');
  }
  assert_true(refused > 10 && allowed < 4000);
  kg_correct_result_destroy(NULL);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(standing_is_carried_by_the_ground),
    cmocka_unit_test(forces_explain_the_momentum),
    cmocka_unit_test(runs_are_equal_to_the_bit),
    cmocka_unit_test(any_step_gives_every_frame),
    cmocka_unit_test(gravity_sets_the_ground_reaction),
    cmocka_unit_test(progress_may_stop_it),
    cmocka_unit_test(sunken_feet_are_raised),
    cmocka_unit_test(soles_stand_in_a_soft_floor),
    cmocka_unit_test(an_obstacle_is_left_in_the_first_frame),
    cmocka_unit_test(the_shortest_clips_are_tracked),
    cmocka_unit_test(what_no_contact_explains_is_marked),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("track", tests, NULL, NULL);
}
