/* The reference of a simulation: planted feet, and the plan of its momentum. */
#include "fixture_clip.h"

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"
#include "pipeline/pipeline.h"

static const double DT = 0.01;

typedef struct reference_scene {
  kg_clip *clip;
  kg_subject *subject;
  kg_dynamics *dynamics;
  kg_arena arena;
  kg_reference reference;
} reference_scene;

/* reference of a clip on a floor at height 0, made for the given gravity; takes the clip */
static reference_scene *reference_of(kg_clip *clip, const kg_track_params *params, double gravity)
{
  reference_scene *s = calloc(1, sizeof *s);
  assert_non_null(s);
  s->clip = clip;
  s->subject = subject_on(clip, 0.0);
  kg_arena_init(&s->arena, NULL);
  const kg_track_params defaults = kg_track_default_params();
  assert_int_equal(kg_reference_create(&s->reference, s->subject, params ? params : &defaults, DT,
                                       gravity, 0.9, &s->arena),
                   KG_OK);
  assert_int_equal(kg_dynamics_create(&s->dynamics, s->subject->body, NULL), KG_OK);
  return s;
}

static void release(reference_scene *s)
{
  kg_dynamics_destroy(s->dynamics);
  kg_arena_release(&s->arena);
  kg_subject_destroy(s->subject);
  kg_clip_destroy(s->clip);
  free(s);
}

static kg_vec3 node_at(const reference_scene *s, const double *q, int point)
{
  return kg_dynamics_point(s->dynamics, NULL, q, s->subject->body->points[point]);
}

static double *frame(const reference_scene *s, int k)
{
  return s->reference.q + (size_t)k * (size_t)s->subject->body->nq;
}

/* A stance that slides 3 cm forwards in 0.8 s: while the heel is planted it stays at one place. */
static void a_sliding_stance_is_held(void **state)
{
  (void)state;
  enum { T = 80 };
  kg_clip *clip = person_clip(T, DT);
  for (int t = 0; t < T; t++) {
    pose_person(clip, t, kg_vec3_make(0.0, STANDING_HIPS - 0.1, 0.0),
                kg_vec3_make(0.1, STANDING_ANKLE, 0.03 * t / (T - 1.0)),
                kg_vec3_make(-0.1, STANDING_ANKLE, 0.0));
  }
  reference_scene *s = reference_of(clip, NULL, 9.8);
  assert_int_equal(s->reference.count, T);
  const kg_track_params params = kg_track_default_params();
  int planted[2] = {0, 0};
  for (int side = 0; side < 2; side++) {
    kg_vec3 low = {INFINITY, INFINITY, INFINITY}, high = {-INFINITY, -INFINITY, -INFINITY};
    const int node = side * KG_SOLE_NODE_COUNT + KG_SOLE_BALL_MEDIAL;
    for (int k = 0; k < T; k++) {
      for (int i = 0; i < s->reference.planted_count[k]; i++) {
        const kg_planted_point *p = &s->reference.planted[k * KG_MAX_PLANTED + i];
        if (p->point != node || p->rolls) {
          continue;
        }
        planted[side]++;
        const kg_vec3 x = node_at(s, frame(s, k), node);
        low = kg_vec3_make(fmin(low.x, x.x), fmin(low.y, x.y), fmin(low.z, x.z));
        high = kg_vec3_make(fmax(high.x, x.x), fmax(high.y, x.y), fmax(high.z, x.z));
        assert_at_most(kg_vec3_norm(kg_vec3_sub(x, p->x)), 1e-3);
        assert_close(x.y, params.rest_height, 1e-3);
        assert_close(p->normal.y, 1.0, 1e-12);
      }
    }
    assert_true(planted[side] > T / 2);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(high, low)), 1e-3);
  }
  /* centred: the place is in the middle of the slide */
  const kg_vec3 held = node_at(s, frame(s, T / 2), KG_SOLE_BALL_MEDIAL);
  const kg_vec3 captured =
    node_at(s, s->subject->q + (size_t)(T / 2) * (size_t)s->subject->body->nq, KG_SOLE_BALL_MEDIAL);
  assert_at_most(fabs(held.z - captured.z), 5e-3);
  release(s);
}

/* A step: the right foot leaves the ground, comes down to `lowest` in mid-swing, and lands. Swings
 * in the frames from SWING to SWING_END. */
enum { SWING = 30, SWING_END = 70, T_STEP = 95 };
static kg_clip *stepping_clip(double lowest)
{
  kg_clip *clip = person_clip(T_STEP, DT);
  for (int t = 0; t < T_STEP; t++) {
    const double s = fmin(1.0, fmax(0.0, (t - SWING) / (double)(SWING_END - SWING)));
    const double lobes = sin(6.283185307179586 * s), one = sin(3.141592653589793 * s);
    pose_person(clip, t, kg_vec3_make(0.0, STANDING_HIPS - 0.1, 0.0),
                kg_vec3_make(0.1, STANDING_ANKLE, 0.0),
                kg_vec3_make(-0.1, STANDING_ANKLE + 0.06 * lobes * lobes + lowest * one * one,
                             -0.3 + 0.6 * s * s * (3.0 - 2.0 * s)));
  }
  return clip;
}

/* Its sole 4 mm above the ground, or in the capture even 2 cm below it: the reference keeps it out of
 * the contact layer, where it would be braked. */
static void a_swinging_foot_keeps_clear(void **state)
{
  (void)state;
  const double lowest[] = {0.004, -0.02};
  for (int i = 0; i < 2; i++) {
    reference_scene *s = reference_of(stepping_clip(lowest[i]), NULL, 9.8);
    double captured = INFINITY, kept = INFINITY, standing = INFINITY;
    const int middle = (SWING + SWING_END) / 2;
    for (int k = middle - 8; k <= middle + 8; k++) {
      const double *q = s->subject->q + (size_t)k * (size_t)s->subject->body->nq;
      for (int n = 0; n < KG_SOLE_NODE_COUNT; n++) {
        captured = fmin(captured, node_at(s, q, KG_SOLE_NODE_COUNT + n).y);
        kept = fmin(kept, node_at(s, frame(s, k), KG_SOLE_NODE_COUNT + n).y);
        standing = fmin(standing, node_at(s, frame(s, k), n).y);
      }
      assert_true(s->reference.planted_count[k] > 0);
      for (int p = 0; p < s->reference.planted_count[k]; p++) {
        assert_true(s->reference.planted[k * KG_MAX_PLANTED + p].point < KG_SOLE_NODE_COUNT);
      }
    }
    assert_close(captured, lowest[i], 2e-3);
    assert_true(kept > 0.006 && kept < 0.03);
    assert_true(standing > 0.0 && standing < 0.005);
    release(s);
  }
}

/* Both feet 2 cm in the ground all the time: raised, and planted. */
static void sunken_feet_stand_on_the_ground(void **state)
{
  (void)state;
  enum { T = 40 };
  kg_clip *clip = standing_clip(T, DT);
  kg_subject *subject = subject_on(clip, 0.0);
  subject->scene = kg_scene_ground(0.02, kg_vec3_make(0, 1, 0));
  kg_dynamics *dynamics;
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  kg_reference reference;
  const kg_track_params params = kg_track_default_params();
  assert_int_equal(kg_reference_create(&reference, subject, &params, DT, 9.8, 0.9, &arena), KG_OK);
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  for (int k = 0; k < T; k++) {
    const double *q = reference.q + (size_t)k * (size_t)subject->body->nq;
    assert_true(reference.planted_count[k] >= 4);
    for (int n = 0; n < subject->body->sole_node_count; n++) {
      const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q, subject->body->points[n]);
      assert_true(x.y > 0.02);
      assert_at_most(x.y, 0.03);
    }
  }
  kg_dynamics_destroy(dynamics);
  kg_arena_release(&arena);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

/* ---- plan ------------------------------------------------------------------------------------ */

/* A jump in closed form: crouch, push-off, flight in a fixed pose under `fall`, landing. The hips
 * rise by a constant acceleration from DEPTH below the height of take-off. */
enum { STAND = 30 };
static const double DEPTH = 0.15, SPEED = 1.9; /* m, m/s at take-off */

static int flight_frames(double fall)
{
  return (int)floor(2.0 * SPEED / fall / DT);
}

static kg_clip *jumping_clip(double fall, int *first, int *end)
{
  const double push = DEPTH / (0.5 * SPEED); /* s, from rest to take-off */
  const int pushing = (int)floor(push / DT), flying = flight_frames(fall);
  const int T = 2 * (STAND + pushing) + flying;
  *first = STAND + pushing + 1;
  *end = *first + flying - 1;
  kg_clip *clip = person_clip(T, DT);
  const double a = SPEED / push, flight = 2.0 * SPEED / fall, takeoff = STAND * DT + push;
  for (int t = 0; t < T; t++) {
    const double since = t * DT - takeoff, left = takeoff + flight + push - t * DT;
    double y, lift = 0.0; /* of the hips above take-off height; of the feet */
    if (since < 0.0) {
      const double s = fmax(0.0, since + push);
      y = -DEPTH + 0.5 * a * s * s;
    } else if (since < flight) {
      y = lift = SPEED * since - 0.5 * fall * since * since;
    } else {
      const double s = fmax(0.0, left);
      y = -DEPTH + 0.5 * a * s * s;
    }
    pose_person(clip, t, kg_vec3_make(0.0, STANDING_HIPS - 0.02 + y, 0.0),
                kg_vec3_make(0.1, STANDING_ANKLE + lift, 0.0),
                kg_vec3_make(-0.1, STANDING_ANKLE + lift, 0.0));
  }
  return clip;
}

/* mean downward acceleration of the centre of mass over frames [first, end) of states */
static double mean_fall(const reference_scene *s, const double *states, int first, int end)
{
  const size_t nq = (size_t)s->subject->body->nq;
  double y[3], sum = 0.0;
  for (int k = first + 1; k + 1 < end; k++) {
    for (int i = 0; i < 3; i++) {
      y[i] = kg_dynamics_centroid(s->dynamics, states + (size_t)(k - 1 + i) * nq, NULL).com.y;
    }
    sum -= (y[0] - 2.0 * y[1] + y[2]) / (DT * DT);
  }
  return sum / (end - first - 2);
}

/* The capture falls at 10.3 m/s^2 (a skeleton that is too large): the reference falls at 9.8. */
static void a_jump_falls_as_gravity_says(void **state)
{
  (void)state;
  int first, end;
  kg_clip *clip = jumping_clip(10.3, &first, &end);
  reference_scene *s = reference_of(clip, NULL, 9.8);
  assert_true(end - first > 30);
  assert_close(mean_fall(s, s->subject->q, first + 4, end - 4), 10.3, 0.005);
  assert_close(mean_fall(s, s->reference.q, first + 4, end - 4), 9.8, 0.02);
  for (int k = first + 5; k < end - 5; k++) { /* nothing stands in flight */
    assert_int_equal(s->reference.planted_count[k], 0);
  }
  release(s);
}

/* Under the gravity of another place the same jump is bent towards that. */
static void the_plan_knows_its_gravity(void **state)
{
  (void)state;
  int first, end;
  kg_clip *clip = jumping_clip(9.8, &first, &end);
  reference_scene *s = reference_of(clip, NULL, 9.2);
  assert_close(mean_fall(s, s->subject->q, first + 4, end - 4), 9.8, 0.005);
  assert_close(mean_fall(s, s->reference.q, first + 4, end - 4), 9.2, 0.02);
  release(s);
}

/* Mean over the frames of the norm of the wrench, scaled by mass and by inertia, that forces at the
 * planted points cannot give: by the library's non-negative least squares. Second differences of the
 * states as an implicit step takes them. */
static double unexplained_wrench(const reference_scene *s, const kg_reference *r)
{
  const kg_body *body = s->subject->body;
  const size_t nv = (size_t)body->nv, nq = (size_t)body->nq;
  enum { EDGES = 4 * KG_MAX_PLANTED };
  double *v = calloc(2 * nv, sizeof(double)), *work = calloc(kg_nnls_work_size(6, EDGES), 8);
  double sum = 0.0;
  assert_true(v && work);
  for (int k = 2; k < r->count; k++) {
    kg_centroid c[2];
    for (int i = 0; i < 2; i++) { /* momentum after step k-1 and after step k */
      const double *q = r->q + (size_t)(k - 1 + i) * nq;
      kg_body_difference(body, v + (size_t)i * nv, q, q - nq);
      for (size_t j = 0; j < nv; j++) {
        v[(size_t)i * nv + j] /= r->dt;
      }
      c[i] = kg_dynamics_centroid(s->dynamics, q, v + (size_t)i * nv);
    }
    const double mass = c[1].mass, inertia = (c[1].I.m[0] + c[1].I.m[4] + c[1].I.m[8]) / 3.0;
    const kg_vec3 a = kg_vec3_scale(1.0 / r->dt, kg_vec3_sub(c[1].com_dot, c[0].com_dot));
    const kg_vec3 N = kg_vec3_scale(1.0 / (inertia * r->dt), kg_vec3_sub(c[1].L, c[0].L));
    const double w[6] = {a.x, a.y + 9.8, a.z, N.x, N.y, N.z};
    double A[6 * EDGES], x[EDGES];
    const int n = 4 * r->planted_count[k];
    for (int e = 0; e < n; e++) {
      const int point = r->planted[k * KG_MAX_PLANTED + e / 4].point;
      const double mu = 0.9 * (e % 2 == 0 ? 1.0 : -1.0);
      const kg_vec3 f = kg_vec3_make(e % 4 < 2 ? mu : 0.0, 1.0, e % 4 < 2 ? 0.0 : mu);
      const kg_vec3 arm = kg_vec3_sub(node_at(s, r->q + (size_t)k * nq, point), c[1].com);
      const kg_vec3 m = kg_vec3_cross(arm, f);
      const double column[6] = {f.x / mass,    f.y / mass,    f.z / mass,
                                m.x / inertia, m.y / inertia, m.z / inertia};
      for (int i = 0; i < 6; i++) {
        A[i * n + e] = column[i];
      }
    }
    double norm = 0.0;
    for (int i = 0; i < 6; i++) {
      norm += w[i] * w[i];
    }
    sum += n > 0 ? kg_nnls(x, A, w, 6, n, work) : sqrt(norm);
  }
  free(v);
  free(work);
  return sum / (r->count - 2);
}

/* The plan makes smaller what no force at the planted points explains; compared with the reference
 * of parameters to which residuals cost nothing, so that nothing is planned. */
static void the_plan_explains_more(void **state)
{
  (void)state;
  int first, end;
  kg_clip *clip = jumping_clip(10.3, &first, &end), *same = jumping_clip(10.3, &first, &end);
  kg_track_params stubborn = kg_track_default_params();
  stubborn.plan_force = stubborn.plan_moment = 1e6; /* residuals cost nothing: no plan */
  reference_scene *planned = reference_of(clip, NULL, 9.8);
  reference_scene *plain = reference_of(same, &stubborn, 9.8);
  const double before = unexplained_wrench(plain, &plain->reference);
  const double after = unexplained_wrench(planned, &planned->reference);
  assert_true(before > 0.2);
  assert_at_most(after, 0.5 * before);
  release(planned);
  release(plain);
}

/* planned once more in place: what is planned already stays nearly as it is */
static void planning_again_changes_little(void **state)
{
  (void)state;
  int first, end;
  reference_scene *s = reference_of(jumping_clip(9.8, &first, &end), NULL, 9.8);
  const kg_track_params params = kg_track_default_params();
  const size_t size = (size_t)s->reference.count * (size_t)s->subject->body->nq;
  double *before = malloc(size * sizeof(double));
  assert_non_null(before);
  memcpy(before, s->reference.q, size * sizeof(double));
  assert_int_equal(kg_plan_momentum(&s->reference, s->subject, &params, 9.8, 0.9, NULL), KG_OK);
  double largest = 0.0;
  for (int k = 0; k < s->reference.count; k++) {
    for (int i = 0; i < 3; i++) {
      largest = fmax(largest, fabs(frame(s, k)[i] -
                                   before[(size_t)k * (size_t)s->subject->body->nq + (size_t)i]));
    }
  }
  assert_at_most(largest, 0.01);
  free(before);
  release(s);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(a_sliding_stance_is_held),
    cmocka_unit_test(a_swinging_foot_keeps_clear),
    cmocka_unit_test(sunken_feet_stand_on_the_ground),
    cmocka_unit_test(a_jump_falls_as_gravity_says),
    cmocka_unit_test(the_plan_knows_its_gravity),
    cmocka_unit_test(the_plan_explains_more),
    cmocka_unit_test(planning_again_changes_little),
  };
  return cmocka_run_group_tests_name("reference", tests, NULL, NULL);
}
