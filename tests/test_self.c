/* A body against itself: which segments are tried, depths against brute force in world coordinates,
 * and what the metrics say of a clip. */
#include "support.h"

#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"
#include "kinegrad/self.h"

enum { SEGMENTS_MAX = 64 };

typedef struct walker {
  kg_clip *clip;
  kg_subject *subject;
  const kg_body *body;
  kg_dynamics *dynamics;
  kg_self *self;
  kg_vec3 p[SEGMENTS_MAX];
  kg_mat3 R[SEGMENTS_MAX];
} walker;

static walker make_walker(void)
{
  walker w = {0};
  const kg_clip_def def = kg_clip_default_def();
  kg_error error = {0};
  if (kg_clip_read(&w.clip, KG_TEST_DATA "/walker.bvh", &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  kg_subject_def subject = kg_subject_default_def();
  subject.self = true;
  if (kg_subject_create(&w.subject, w.clip, &subject, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  w.body = w.subject->body;
  assert_true(w.body->segment_count <= SEGMENTS_MAX);
  assert_int_equal(kg_dynamics_create(&w.dynamics, w.body, NULL), KG_OK);
  assert_int_equal(kg_self_create(&w.self, w.body, NULL, NULL), KG_OK);
  return w;
}

static void release(walker *w)
{
  kg_self_destroy(w->self);
  kg_dynamics_destroy(w->dynamics);
  kg_subject_destroy(w->subject);
  kg_clip_destroy(w->clip);
}

static int segment(const walker *w, kg_role role)
{
  assert_true(w->body->segment_of_role[role] >= 0);
  return w->body->segment_of_role[role];
}

/* every joint of the walker bent at random */
static void random_pose(kg_random *random, const kg_body *body, double bend, double *q)
{
  for (int i = 0; i < 3; i++) {
    q[i] = kg_random_normal(random);
  }
  for (int i = 0; i < body->segment_count; i++) {
    const kg_quat r = kg_quat_exp(random_vec3(random, bend));
    const double quat[4] = {r.w, r.x, r.y, r.z};
    memcpy(q + 3 + 4 * i, quat, sizeof quat);
  }
}

/* ---- brute force ---------------------------------------------------------------------------------*/

/* Distance of x to a shape of the body, the shape itself taken into the world. */
static kg_sdf_value in_world(const walker *w, const kg_body_shape *s, kg_vec3 x)
{
  const kg_mat3 R = w->R[s->segment];
  const kg_vec3 a = kg_vec3_add(w->p[s->segment], kg_mat3_mul_vec(R, s->a));
  const kg_quat turn = kg_quat_mul(kg_quat_from_matrix(R), s->orientation);
  if (s->kind == KG_BODY_ELLIPSOID) return kg_sdf_ellipsoid(a, turn, s->b, x);
  if (s->kind == KG_BODY_BOX) return kg_sdf_box(a, turn, s->b, x);
  const kg_vec3 b = kg_vec3_add(w->p[s->segment], kg_mat3_mul_vec(R, s->b));
  return kg_sdf_capsule(a, b, s->radius, x);
}

static kg_sdf_value nearest_of_all(const walker *w, int point, kg_vec3 x)
{
  kg_sdf_value best = {.distance = INFINITY};
  for (int k = 0; k < w->body->shape_count; k++) {
    const kg_body_shape *s = &w->body->shapes[k];
    if (!kg_self_is_pair(w->self, w->body->points[point].segment, s->segment)) continue;
    const kg_sdf_value v = in_world(w, s, x);
    if (v.distance < best.distance) best = v;
  }
  return best;
}

static void samples_are_those_of_brute_force(void **state)
{
  (void)state;
  walker w = make_walker();
  kg_random random = kg_random_make(71);
  kg_self_touch *touches = calloc((size_t)w.body->point_count, sizeof *touches);
  double *q = calloc((size_t)w.body->nq, sizeof *q);
  const double limits[3] = {0.0, 0.02, 0.5};
  int inside = 0, compared = 0;
  for (int trial = 0; trial < 60; trial++) {
    random_pose(&random, w.body, 0.9, q);
    kg_dynamics_pose(w.dynamics, q, w.p, w.R);
    const double limit = limits[trial % 3];
    const int count = kg_self_sample(w.self, w.p, w.R, limit, touches);
    int expected = 0, found = 0;
    double depth = 0.0;
    for (int k = 0; k < w.body->point_count; k++) {
      const int i = w.body->points[k].segment;
      const kg_vec3 x = kg_vec3_add(w.p[i], kg_mat3_mul_vec(w.R[i], w.body->points[k].p));
      const kg_sdf_value v = nearest_of_all(&w, k, x);
      expected += v.distance < limit;
      depth = fmax(depth, -v.distance);
      for (int t = 0; t < count; t++) {
        if (touches[t].point != k) continue;
        found++;
        assert_close(touches[t].distance, v.distance, 1e-12);
        assert_close(kg_vec3_norm(kg_vec3_sub(touches[t].x, x)), 0.0, 1e-12);
        assert_true(kg_self_is_pair(w.self, i, touches[t].segment));
        /* at the axis of a capsule and between two shapes the way out is not one */
        const kg_vec3 ahead = kg_vec3_add_scaled(x, 1e-6, touches[t].normal);
        double grown = INFINITY;
        for (int s = 0; s < w.body->shape_count; s++) {
          if (w.body->shapes[s].segment != touches[t].segment) continue;
          grown = fmin(grown, in_world(&w, &w.body->shapes[s], ahead).distance);
        }
        compared += fabs(grown - v.distance - 1e-6) < 1e-9;
      }
    }
    assert_int_equal(count, expected);
    assert_int_equal(found, count);
    assert_close(kg_self_depth(w.self, w.p, w.R, touches), depth, 1e-12);
    if (depth > 0.0) assert_close(-touches[0].distance, depth, 1e-12);
    inside += depth > 0.01;
    compared -= (int)(0.98 * count);
  }
  assert_true(inside >= 20);
  assert_true(compared > 0); /* normals: 98 of 100 */
  free(q);
  free(touches);
  release(&w);
}

/* ---- pairs ---------------------------------------------------------------------------------------*/

static void neighbours_are_no_pairs(void **state)
{
  (void)state;
  walker w = make_walker();
  static const struct {
    kg_role a, b;
    bool is_pair;
  } cases[] = {
    {KG_ROLE_L_HIP, KG_ROLE_R_HIP, false},        {KG_ROLE_L_HIP, KG_ROLE_PELVIS, false},
    {KG_ROLE_L_KNEE, KG_ROLE_PELVIS, false},      {KG_ROLE_L_CLAVICLE, KG_ROLE_L_SHOULDER, false},
    {KG_ROLE_L_CLAVICLE, KG_ROLE_L_ELBOW, false}, {KG_ROLE_NECK1, KG_ROLE_HEAD, false},
    {KG_ROLE_L_KNEE, KG_ROLE_R_KNEE, true},       {KG_ROLE_L_KNEE, KG_ROLE_R_HIP, true},
    {KG_ROLE_L_ELBOW, KG_ROLE_R_ELBOW, true},     {KG_ROLE_L_WRIST, KG_ROLE_PELVIS, true},
    {KG_ROLE_R_WRIST, KG_ROLE_HEAD, true},        {KG_ROLE_R_ELBOW, KG_ROLE_L_HIP, true},
    {KG_ROLE_L_ANKLE, KG_ROLE_R_TOE, true},
  };
  for (size_t k = 0; k < KG_COUNT_OF(cases); k++) {
    const int a = segment(&w, cases[k].a), b = segment(&w, cases[k].b);
    assert_int_equal(kg_self_is_pair(w.self, a, b), cases[k].is_pair);
    assert_int_equal(kg_self_is_pair(w.self, b, a), cases[k].is_pair);
  }
  /* nothing is inside in the rest pose; what overlaps in another pose is left out there */
  double *q = calloc((size_t)w.body->nq, sizeof *q);
  for (int i = 0; i < w.body->segment_count; i++) {
    q[3 + 4 * i] = 1.0;
  }
  kg_dynamics_pose(w.dynamics, q, w.p, w.R);
  assert_true(kg_self_depth(w.self, w.p, w.R, NULL) <= KG_SELF_REST_DEPTH_M);
  kg_random random = kg_random_make(72);
  int left_out = 0;
  for (int trial = 0; trial < 20; trial++) {
    kg_self_touch deepest;
    random_pose(&random, w.body, 0.9, q);
    kg_dynamics_pose(w.dynamics, q, w.p, w.R);
    if (!(kg_self_depth(w.self, w.p, w.R, &deepest) > KG_SELF_REST_DEPTH_M)) continue;
    kg_self *bent = NULL;
    assert_int_equal(kg_self_create(&bent, w.body, q, NULL), KG_OK);
    const int at = w.body->points[deepest.point].segment;
    assert_false(kg_self_is_pair(bent, at, deepest.segment));
    assert_false(kg_self_is_pair(bent, deepest.segment, at));
    assert_true(kg_self_depth(bent, w.p, w.R, NULL) <= KG_SELF_REST_DEPTH_M);
    kg_self_destroy(bent);
    left_out++;
  }
  assert_true(left_out >= 5);
  free(q);
  release(&w);
}

/* ---- metrics -------------------------------------------------------------------------------------*/

static void metrics_are_those_of_the_frames(void **state)
{
  (void)state;
  walker w = make_walker();
  const int T = w.subject->frame_count;
  double deepest = 0.0;
  int events = 0;
  for (int t = 0; t < T; t++) {
    kg_dynamics_pose(w.dynamics, w.subject->q + (size_t)t * (size_t)w.body->nq, w.p, w.R);
    double depth = 0.0;
    for (int k = 0; k < w.body->point_count; k++) {
      const int i = w.body->points[k].segment;
      const kg_vec3 x = kg_vec3_add(w.p[i], kg_mat3_mul_vec(w.R[i], w.body->points[k].p));
      depth = fmax(depth, -nearest_of_all(&w, k, x).distance);
    }
    deepest = fmax(deepest, depth);
    events += depth > 1e-3;
  }
  assert_true(events > 0 && events < T && deepest > 0.01);
  kg_metrics *metrics = NULL;
  assert_int_equal(kg_metrics_create(&metrics, w.subject, w.subject->q), KG_OK);
  const kg_motion_metrics *sides[2] = {&metrics->capture, &metrics->output};
  for (int k = 0; k < 2; k++) {
    assert_close(sides[k]->self_penetration_max_m, deepest, 1e-12);
    assert_close(sides[k]->self_penetration_events, (double)events / T, 1e-12);
  }
  kg_metrics_destroy(metrics);
  w.subject->self = false;
  assert_int_equal(kg_metrics_create(&metrics, w.subject, w.subject->q), KG_OK);
  assert_true(isnan(metrics->output.self_penetration_max_m));
  assert_true(isnan(metrics->output.self_penetration_events));
  kg_metrics_destroy(metrics);
  release(&w);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(samples_are_those_of_brute_force),
    cmocka_unit_test(neighbours_are_no_pairs),
    cmocka_unit_test(metrics_are_those_of_the_frames),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
