/* A body against itself: which segments are tried, depths against brute force in world coordinates,
 * what the metrics say of a clip; gradients against differences, the way out, and both methods. */
#include "support.h"

#include "kinegrad/correct.h"
#include "kinegrad/correction.h"

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

static int segment_of(const walker *w, kg_role role)
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

/* *segment: whose shape it is */
static kg_sdf_value nearest_of_all(const walker *w, int point, kg_vec3 x, int *segment)
{
  kg_sdf_value best = {.distance = INFINITY};
  for (int k = 0; k < w->body->shape_count; k++) {
    const kg_body_shape *s = &w->body->shapes[k];
    if (!kg_self_is_pair(w->self, w->body->points[point].segment, s->segment)) continue;
    const kg_sdf_value v = in_world(w, s, x);
    if (!(v.distance < best.distance)) continue;
    best = v;
    *segment = s->segment;
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
      int other = -1;
      const kg_sdf_value v = nearest_of_all(&w, k, x, &other);
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
    const int a = segment_of(&w, cases[k].a), b = segment_of(&w, cases[k].b);
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
  kg_deepest deepest = {.depth = 0.0};
  double *frames = calloc((size_t)T, sizeof *frames), sum = 0.0;
  int events = 0, inside = 0;
  assert_non_null(frames);
  for (int t = 0; t < T; t++) {
    kg_dynamics_pose(w.dynamics, w.subject->q + (size_t)t * (size_t)w.body->nq, w.p, w.R);
    for (int k = 0; k < w.body->point_count; k++) {
      const int i = w.body->points[k].segment;
      const kg_vec3 x = kg_vec3_add(w.p[i], kg_mat3_mul_vec(w.R[i], w.body->points[k].p));
      int other = -1;
      const double depth = -nearest_of_all(&w, k, x, &other).distance;
      frames[t] = fmax(frames[t], depth);
      if (depth > deepest.depth) deepest = (kg_deepest){depth, t, i, other};
    }
    events += frames[t] > 1e-3;
    inside += frames[t] > 1e-5;
    sum += frames[t] > 1e-5 ? frames[t] : 0.0;
  }
  assert_true(events > 0 && inside < T && deepest.depth > 0.01);
  kg_metrics *metrics = NULL;
  assert_int_equal(kg_metrics_create(&metrics, w.subject, w.subject->q), KG_OK);
  const kg_motion_metrics *sides[2] = {&metrics->capture, &metrics->output};
  for (int k = 0; k < 2; k++) {
    assert_close(sides[k]->self_penetration_max_m, deepest.depth, 1e-12);
    assert_close(sides[k]->self_penetration_mean_m, sum / inside, 1e-12);
    assert_close(sides[k]->self_penetration_events, (double)events / T, 1e-12);
  }
  const kg_deepest *found = &metrics->output_deepest[KG_OBSTACLE_SELF];
  assert_int_equal(found->frame, deepest.frame);
  assert_int_equal(found->segment, deepest.segment);
  assert_int_equal(found->entered, deepest.entered);
  for (int t = 0; t < T; t++) {
    assert_close(metrics->self_penetration_frame_m[t], frames[t], 1e-12);
  }
  free(frames);
  kg_metrics_destroy(metrics);
  w.subject->self = false;
  assert_int_equal(kg_metrics_create(&metrics, w.subject, w.subject->q), KG_OK);
  assert_true(isnan(metrics->output.self_penetration_max_m));
  assert_true(isnan(metrics->output.self_penetration_events));
  kg_metrics_destroy(metrics);
  release(&w);
}

/* ---- the way out ---------------------------------------------------------------------------------*/

/* the body's points against all shapes they can meet, shape by shape */
static double brute_depth(walker *w, const double *q)
{
  kg_dynamics_pose(w->dynamics, q, w->p, w->R);
  double depth = 0.0;
  for (int k = 0; k < w->body->point_count; k++) {
    const int i = w->body->points[k].segment;
    const kg_vec3 x = kg_vec3_add(w->p[i], kg_mat3_mul_vec(w->R[i], w->body->points[k].p));
    int other = -1;
    depth = fmax(depth, -nearest_of_all(w, k, x, &other).distance);
  }
  return depth;
}

static bool is_of_arm(const walker *w, int segment)
{
  return segment == segment_of(w, KG_ROLE_L_ELBOW) || segment == segment_of(w, KG_ROLE_R_ELBOW) ||
         segment == segment_of(w, KG_ROLE_L_WRIST) || segment == segment_of(w, KG_ROLE_R_WRIST);
}

static bool is_of_trunk(const walker *w, int segment)
{
  bool is = segment == segment_of(w, KG_ROLE_PELVIS);
  for (int role = KG_ROLE_PELVIS; role <= KG_ROLE_SPINE3; role++) {
    is = is || segment == w->body->segment_of_role[role];
  }
  return is;
}

/* Arms bent at random until a forearm or a hand is through the trunk, 1 to 8 cm deep. */
static void arm_in_trunk(kg_random *random, walker *w, double *q)
{
  static const kg_role arms[] = {KG_ROLE_L_SHOULDER, KG_ROLE_L_ELBOW, KG_ROLE_R_SHOULDER,
                                 KG_ROLE_R_ELBOW};
  for (int trial = 0; trial < 10000; trial++) {
    random_pose(random, w->body, 0.05, q);
    for (size_t k = 0; k < KG_COUNT_OF(arms); k++) {
      const kg_quat r = kg_quat_exp(random_vec3(random, 1.0));
      const double quat[4] = {r.w, r.x, r.y, r.z};
      memcpy(q + 3 + 4 * segment_of(w, arms[k]), quat, sizeof quat);
    }
    kg_self_touch deepest;
    kg_dynamics_pose(w->dynamics, q, w->p, w->R);
    const double depth = kg_self_depth(w->self, w->p, w->R, &deepest);
    if (!(depth > 0.01 && depth < 0.08)) continue;
    if (is_of_arm(w, w->body->points[deepest.point].segment) && is_of_trunk(w, deepest.segment)) {
      return;
    }
  }
  fail_msg("no such pose");
}

static kg_correction *make_correction(const walker *w, const kg_scene *scene,
                                      kg_correction_method method)
{
  kg_correction *c = NULL;
  kg_correction_def def = kg_correction_default_def(w->body, scene);
  def.self = true;
  def.method = method;
  assert_int_equal(kg_correction_create(&c, &def), KG_OK);
  return c;
}

static void gradients_are_those_of_differences(void **state)
{
  (void)state;
  walker w = make_walker();
  const kg_scene scene = kg_scene_ground(-100.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_correction *c = make_correction(&w, &scene, KG_CORRECTION_SECOND_ORDER);
  kg_random random = kg_random_make(73);
  const int nv = w.body->nv;
  double *q = calloc((size_t)w.body->nq, sizeof *q), *near = calloc((size_t)w.body->nq, sizeof *q);
  double *gradient = calloc((size_t)nv, sizeof *q), *d = calloc((size_t)nv, sizeof *q);
  for (int trial = 0; trial < 10; trial++) {
    arm_in_trunk(&random, &w, q);
    double L = 0.0, largest = 0.0;
    assert_close(kg_penetration(c, q, &L, gradient), brute_depth(&w, q), 1e-12);
    for (int i = 0; i < nv; i++) {
      largest = fmax(largest, fabs(gradient[i]));
    }
    assert_true(largest > 1e-4);
    for (int i = 0; i < nv; i++) {
      double side[2];
      for (int k = 0; k < 2; k++) {
        d[i] = k ? 1e-5 : -1e-5;
        kg_body_integrate(w.body, near, q, d);
        (void)kg_penetration(c, near, &side[k], NULL);
      }
      d[i] = 0.0;
      assert_close(gradient[i], (side[1] - side[0]) / 2e-5, 1e-5 * largest);
    }
    for (int i = 0; i < 3; i++) {
      assert_close(gradient[i], 0.0, 1e-15); /* moving the whole changes nothing */
    }
  }
  free(d);
  free(gradient);
  free(near);
  free(q);
  kg_correction_destroy(c);
  release(&w);
}

static void an_arm_comes_out_of_the_trunk(void **state)
{
  (void)state;
  walker w = make_walker();
  const kg_scene scene = kg_scene_ground(-100.0, kg_vec3_make(0.0, 1.0, 0.0));
  const size_t nq = (size_t)w.body->nq, nv = (size_t)w.body->nv;
  double *q = calloc(nq, sizeof *q), *before = calloc(nq, sizeof *q), *v = calloc(nv, sizeof *q);
  double *D = calloc(nv, sizeof *q);
  for (int method = 0; method < 2; method++) {
    kg_correction *c = make_correction(&w, &scene, (kg_correction_method)method);
    kg_random random = kg_random_make(74);
    for (int trial = 0; trial < 20; trial++) {
      arm_in_trunk(&random, &w, before);
      memcpy(q, before, nq * sizeof *q);
      for (size_t i = 0; i < nv; i++) {
        v[i] = kg_random_normal(&random);
      }
      const double depth = brute_depth(&w, q);
      const kg_correction_report r = kg_correction_apply(c, q, v, D);
      assert_true(r.converged);
      assert_close(r.d_pen_before, depth, 1e-12);
      assert_close(r.d_pen_after, brute_depth(&w, q), 1e-12);
      assert_true(r.d_pen_after <= 1e-5);
      assert_true(r.lowest < 1e-4); /* at the surface, no further */
      /* no momentum from nowhere: the forces are inner ones, the centre of mass stays to first order */
      const kg_vec3 com[2] = {kg_dynamics_centroid(w.dynamics, before, NULL).com,
                              kg_dynamics_centroid(w.dynamics, q, NULL).com};
      assert_true(kg_vec3_norm(kg_vec3_sub(com[1], com[0])) < 0.01);
      /* after the push no touching point moves into what it touches */
      double *next = before; /* done with */
      for (size_t i = 0; i < nv; i++) {
        D[i] = 1e-6 * v[i];
      }
      const double start = brute_depth(&w, q);
      kg_body_integrate(w.body, next, q, D);
      assert_true(brute_depth(&w, next) < start + 1e-9);
    }
    kg_correction_destroy(c);
  }
  free(q);
  free(before);
  free(v);
  free(D);
  release(&w);
}

/* One correction and its adjoint of all ones added to zeros; what kg_correction_vjp says. */
static bool pull_back(const walker *w, const kg_scene *scene, bool self, const double *before,
                      double *out)
{
  const size_t nq = (size_t)w->body->nq, nv = (size_t)w->body->nv;
  kg_correction_def def = kg_correction_default_def(w->body, scene);
  def.self = self;
  def.kkt_tolerance = 1e-10;
  kg_correction *c = NULL;
  assert_int_equal(kg_correction_create(&c, &def), KG_OK);
  double *q = calloc(nq, sizeof *q), *bar = calloc(nv, sizeof *q);
  memcpy(q, before, nq * sizeof *q);
  for (size_t i = 0; i < nv; i++) {
    bar[i] = 1.0;
    out[i] = 0.0;
  }
  const kg_correction_report r = kg_correction_apply(c, q, NULL, NULL);
  assert_true(r.converged);
  assert_true(r.d_pen_before > 1e-3);
  /* the move is the least one: not for want of that is there no derivative */
  assert_true(r.kkt_residual < 1e-3 * r.displacement);
  const bool has = kg_correction_vjp(c, before, q, bar, out);
  free(bar);
  free(q);
  kg_correction_destroy(c);
  return has;
}

/* Where the body's own segments carry there is no derivative, and that is said; where the ground alone
 * does, it is that of the ground alone. */
static void derivatives_are_refused_where_it_holds_itself(void **state)
{
  (void)state;
  walker w = make_walker();
  const size_t nv = (size_t)w.body->nv;
  kg_scene scene = kg_scene_ground(-100.0, kg_vec3_make(0.0, 1.0, 0.0));
  kg_random random = kg_random_make(75);
  double *q = calloc((size_t)w.body->nq, sizeof *q);
  double *out = calloc(nv, sizeof *q), *alone = calloc(nv, sizeof *q);
  arm_in_trunk(&random, &w, q);
  assert_false(pull_back(&w, &scene, true, q, out));
  for (size_t i = 0; i < nv; i++) {
    assert_true(out[i] == 0.0);
  }
  random_pose(&random, w.body, 0.02, q);
  assert_true(brute_depth(&w, q) == 0.0);
  double lowest = INFINITY;
  for (int k = 0; k < w.body->point_count; k++) {
    const int i = w.body->points[k].segment;
    lowest = fmin(lowest, w.p[i].y + kg_mat3_mul_vec(w.R[i], w.body->points[k].p).y);
  }
  scene = kg_scene_ground(lowest + 0.01, kg_vec3_make(0.0, 1.0, 0.0));
  assert_true(pull_back(&w, &scene, true, q, out));
  assert_true(pull_back(&w, &scene, false, q, alone));
  for (size_t i = 0; i < nv; i++) {
    assert_close(out[i], alone[i], 1e-12);
  }
  free(alone);
  free(out);
  free(q);
  release(&w);
}

/* The walker by one method; metrics with the rows of the body itself */
static kg_metrics *correct_walker(walker *w, kg_correct_method method, bool self, int threads,
                                  double *q)
{
  kg_correct_def def = kg_correct_default_def();
  def.method = method;
  def.threads = threads;
  kg_correct_result *result = NULL;
  kg_error error = {0};
  w->subject->self = self;
  assert_int_equal(kg_correct(&result, w->subject, &def, &error), KG_OK);
  const size_t size = (size_t)result->frame_count * (size_t)result->nq;
  memcpy(q, result->q, size * sizeof *q);
  w->subject->self = true;
  kg_metrics *metrics = NULL;
  assert_int_equal(kg_metrics_create(&metrics, w->subject, q), KG_OK);
  kg_correct_result_destroy(result);
  return metrics;
}

static void clips_come_out_of_themselves(void **state)
{
  (void)state;
  walker w = make_walker();
  const size_t nq = (size_t)w.body->nq, T = (size_t)w.subject->frame_count;
  double *q = calloc(T * nq, sizeof *q), *again = calloc(T * nq, sizeof *q);
  static const kg_correct_method methods[] = {KG_CORRECT_SDF, KG_CORRECT_TRACK};
  for (size_t k = 0; k < KG_COUNT_OF(methods); k++) {
    kg_metrics *alone = correct_walker(&w, methods[k], false, 1, q);
    assert_true(alone->output.self_penetration_max_m > 0.01);
    kg_metrics *metrics = correct_walker(&w, methods[k], true, 1, q);
    for (size_t t = 0; t < T; t++) {
      assert_true(brute_depth(&w, q + t * nq) <= 1e-5);
    }
    assert_true(metrics->output.self_penetration_max_m <= 1e-5);
    assert_true(metrics->output.self_penetration_events == 0.0);
    assert_true(metrics->output.penetration_max_m <= 1e-5);
    assert_true(metrics->mpjpe_m < alone->mpjpe_m + 0.01);
    kg_metrics_destroy(metrics);
    kg_metrics_destroy(alone);
  }
  kg_metrics_destroy(correct_walker(&w, KG_CORRECT_SDF, true, 1, q));
  kg_metrics_destroy(correct_walker(&w, KG_CORRECT_SDF, true, 3, again));
  assert_memory_equal(q, again, T * nq * sizeof *q);
  free(again);
  free(q);
  release(&w);
}

/* The pose `from` turned by d at the middle of the clip, eased in and out, is what the subject does. */
static void act(walker *w, const double *from, const double *d)
{
  const int nq = w->body->nq, nv = w->body->nv, T = w->subject->frame_count;
  double *now = calloc((size_t)nv, sizeof *now);
  for (int t = 0; t < T; t++) {
    const double share = sin(3.14159265358979 * t / (T - 1));
    for (int i = 0; i < nv; i++) {
      now[i] = share * share * d[i];
    }
    kg_body_integrate(w->body, w->subject->q + (ptrdiff_t)t * nq, from, now);
  }
  free(now);
}

/* all rotations the identity, 10 m above the ground */
static void stand_in_the_air(const walker *w, double *q)
{
  const double none[4] = {1.0, 0.0, 0.0, 0.0};
  memset(q, 0, 3 * sizeof *q);
  q[1] = 10.0;
  for (int i = 0; i < w->body->segment_count; i++) {
    memcpy(q + 3 + 4 * i, none, sizeof none);
  }
}

/* An arm that sinks into the trunk over half a second and comes back is led around it: the change is
 * eased in and out, not made frame by frame. */
static void the_way_around_is_smooth(void **state)
{
  (void)state;
  walker w = make_walker();
  kg_random random = kg_random_make(76);
  const size_t nq = (size_t)w.body->nq, T = (size_t)w.subject->frame_count;
  double *deep = calloc(nq, sizeof *deep), *rest = calloc(nq, sizeof *deep);
  double *way = calloc((size_t)w.body->nv, sizeof *deep), *q = calloc(T * nq, sizeof *q);
  do {
    arm_in_trunk(&random, &w, deep);
  } while (brute_depth(&w, deep) > 0.03);
  deep[1] = 10.0;
  stand_in_the_air(&w, rest);
  memcpy(rest, deep, 7 * sizeof *rest);
  kg_body_difference(w.body, way, deep, rest);
  act(&w, rest, way);
  kg_metrics *metrics = correct_walker(&w, KG_CORRECT_SDF, true, 1, q);
  assert_true(metrics->capture.self_penetration_max_m > 0.01);
  assert_true(metrics->output.self_penetration_max_m <= 1e-5);
  assert_true(metrics->acceleration_peak_ratio < 1.5);
  kg_metrics_destroy(metrics);
  free(q);
  free(way);
  free(rest);
  free(deep);
  release(&w);
}

/* A leg swings through the other one, axis through axis, into it or out on its other side, and back: it goes around,
 * for the nearest way out turns round in the middle of the other. */
static void a_leg_goes_around_the_other(void **state)
{
  (void)state;
  walker w = make_walker();
  const size_t nq = (size_t)w.body->nq, nv = (size_t)w.body->nv;
  double *rest = calloc(nq, sizeof *rest), *way = calloc(nv, sizeof *way);
  double *q = calloc((size_t)w.subject->frame_count * nq, sizeof *q);
  stand_in_the_air(&w, rest);
  const int hip = segment_of(&w, KG_ROLE_L_HIP);
  static const double angles[] = {-0.9, -0.5, 0.5}, most[] = {20.0, 4.0, 1.1};
  int crossed = 0;
  for (size_t k = 0; k < KG_COUNT_OF(angles); k++) {
    memset(way, 0, nv * sizeof *way);
    way[3 + 3 * hip + 2] = angles[k];
    act(&w, rest, way);
    kg_metrics *metrics = correct_walker(&w, KG_CORRECT_SDF, true, 1, q);
    print_message("  %.1f mm deep, moved %.1f mm, acceleration %.2f\n",
                  1e3 * metrics->capture.self_penetration_max_m, 1e3 * metrics->mpjpe_m,
                  metrics->acceleration_peak_ratio);
    crossed += metrics->capture.self_penetration_max_m > 0.03;
    assert_true(metrics->output.self_penetration_max_m <= 1e-5);
    assert_true(metrics->acceleration_peak_ratio < most[k]);
    kg_metrics_destroy(metrics);
  }
  assert_int_equal(crossed, 2); /* inwards */
  free(q);
  free(way);
  free(rest);
  release(&w);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(samples_are_those_of_brute_force),
    cmocka_unit_test(neighbours_are_no_pairs),
    cmocka_unit_test(metrics_are_those_of_the_frames),
    cmocka_unit_test(gradients_are_those_of_differences),
    cmocka_unit_test(an_arm_comes_out_of_the_trunk),
    cmocka_unit_test(derivatives_are_refused_where_it_holds_itself),
    cmocka_unit_test(clips_come_out_of_themselves),
    cmocka_unit_test(the_way_around_is_smooth),
    cmocka_unit_test(a_leg_goes_around_the_other),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
