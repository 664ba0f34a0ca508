/* The metrics against motions whose numbers are known in closed form. */
#include "support.h"

#include <time.h>

#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"
#include "kinegrad/step.h"

/* ---- non-negative least squares -------------------------------------------------------------- */

/* The weights of the validity score from Table 2 of the paper (docs/theory/metrics.md): events, change of angular momentum
 * (kg m^2/s), slip (mm), score. */
static void nnls_finds_the_weights_of_table_2(void **state)
{
  (void)state;
  const double A[15] = {0.87, 5.62, 12.4, 0.0, 0.31, 1.2,  0.12, 1.85,
                        3.8,  0.04, 1.12, 2.9, 0.01, 0.52, 1.8};
  const double b[5] = {0.69, 0.05, 0.24, 0.16, 0.08};
  double x[3], work[100];
  assert_true(kg_nnls_work_size(5, 3) <= KG_COUNT_OF(work));
  const double norm = kg_nnls(x, A, b, 5, 3, work);
  assert_true(x[0] == 0.0);
  assert_close(x[1], KG_METRIC_VALIDITY_B, 5e-5);
  assert_close(x[2], KG_METRIC_VALIDITY_C, 5e-5);
  double worst = 0.0, sum = 0.0;
  for (int i = 0; i < 5; i++) {
    const double r = b[i] - A[3 * i] * x[0] - A[3 * i + 1] * x[1] - A[3 * i + 2] * x[2];
    worst = fmax(worst, fabs(r));
    sum += r * r;
  }
  assert_true(worst > 0.016 && worst < 0.0175); /* "residual up to 0.017" */
  assert_close(norm, sqrt(sum), 1e-14);
}

/* Karush, Kuhn, Tucker: x >= 0, w = A'(b - Ax) <= 0, w = 0 where x > 0. The problem is convex, so
 * these are the minimum, whatever found it. */
static void nnls_meets_the_conditions_of_a_minimum(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  double A[6 * 80], b[6], x[80], work[1000];
  int at_zero = 0, free = 0;
  for (int trial = 0; trial < 500; trial++) {
    const int m = 1 + trial % 6, n = 1 + (trial * 7) % 80;
    assert_true(kg_nnls_work_size(m, n) <= KG_COUNT_OF(work));
    for (int k = 0; k < m * n; k++) {
      A[k] = kg_random_normal(&random) + (trial % 3 == 0 ? 1.0 : 0.0);
    }
    for (int j = 1; j < n && trial % 5 == 0; j += 2) { /* twin columns */
      for (int i = 0; i < m; i++) {
        A[i * n + j] = A[i * n + j - 1];
      }
    }
    double size = 0.0;
    for (int i = 0; i < m; i++) {
      b[i] = 700.0 * kg_random_normal(&random);
      size += fabs(b[i]);
    }
    const double norm = kg_nnls(x, A, b, m, n, work);
    double r[6], sum = 0.0;
    for (int i = 0; i < m; i++) {
      r[i] = b[i];
      for (int j = 0; j < n; j++) {
        r[i] -= A[i * n + j] * x[j];
      }
      sum += r[i] * r[i];
    }
    assert_at_most(fabs(norm - sqrt(sum)), 1e-9 * size);
    for (int j = 0; j < n; j++) {
      double w = 0.0;
      for (int i = 0; i < m; i++) {
        w += A[i * n + j] * r[i];
      }
      assert_true(x[j] >= 0.0);
      assert_at_most(w, 1e-8 * size);
      if (x[j] > 0.0) {
        assert_at_most(fabs(w), 1e-8 * size);
      }
      at_zero += x[j] == 0.0;
      free += x[j] > 0.0;
    }
  }
  assert_true(at_zero > 1000 && free > 500);
}

static void validity_is_clipped(void **state)
{
  (void)state;
  assert_close(kg_metric_validity(0.52, 1.8e-3), 1.0 - 0.0731 * 0.52 - 0.0231 * 1.8, 1e-15);
  assert_true(kg_metric_validity(100.0, 0.0) == 0.0 && kg_metric_validity(0.0, 0.0) == 1.0);
}

/* ---- a rigid brick --------------------------------------------------------------------------- */

/* One segment with ten nodes on its underside (they count as soles), and on top a ring of eight
 * points after four that lie 1 cm lower and to one side. */
typedef struct scene {
  kg_subject subject;
  kg_body *body;
  double *q, *out; /* (T, nq) capture and output */
} scene;

enum { BRICK_POINTS = 22 };
static const double BRICK_MASS = 60.0;
static const double BRICK_I[3] = {9.0, 2.0, 10.0};

static scene brick_scene(int T, double dt)
{
  kg_segment segment = {.name = "brick", .role = -1, .joint = -1, .parent = -1, .mass = BRICK_MASS};
  segment.inertia[0] = BRICK_I[0];
  segment.inertia[1] = BRICK_I[1];
  segment.inertia[2] = BRICK_I[2];
  kg_body_point points[BRICK_POINTS] = {{0}};
  for (int k = 0; k < 10; k++) { /* a ring of radius 0.2, 0.9 below the centre of mass */
    const double a = 0.6283185307179586 * k;
    points[k].p = kg_vec3_make(0.2 * cos(a), -0.9, 0.2 * sin(a));
  }
  for (int k = 0; k < 4; k++) {
    points[10 + k].p = kg_vec3_make(0.1, 0.79, 0.01 * k);
  }
  for (int k = 0; k < 8; k++) {
    const double a = 0.7853981633974483 * k;
    points[14 + k].p = kg_vec3_make(0.1 * cos(a), 0.8, 0.1 * sin(a));
  }
  scene s = {0};
  assert_int_equal(kg_body_create(&s.body, &segment, 1, points, BRICK_POINTS, NULL), KG_OK);
  s.body->sole_node_count = 10;
  s.q = calloc((size_t)T * 7, sizeof(double));
  s.out = calloc((size_t)T * 7, sizeof(double));
  assert_true(s.q && s.out);
  s.subject = (kg_subject){.body = s.body,
                           .scene = kg_scene_ground(0.0, kg_vec3_make(0, 1, 0)),
                           .frame_count = T,
                           .dt = dt,
                           .q = s.q};
  return s;
}

static void put(double *q, int t, kg_vec3 x, kg_quat r)
{
  const double state[7] = {x.x, x.y, x.z, r.w, r.x, r.y, r.z};
  memcpy(q + 7 * t, state, sizeof state);
}

static kg_metrics *metrics_of(scene *s)
{
  kg_metrics *m;
  assert_int_equal(kg_metrics_create(&m, &s->subject, s->out), KG_OK);
  const double *sides[2] = {(const double *)&m->capture, (const double *)&m->output};
  const size_t alone = offsetof(kg_motion_metrics, other_penetration_events) / sizeof(double);
  for (size_t k = 0; k < sizeof(kg_motion_metrics) / sizeof(double); k++) {
    /* the struct is all doubles; there is no other athlete */
    assert_true(isfinite(sides[0][k]) == (k < alone) && isfinite(sides[1][k]) == (k < alone));
  }
  return m;
}

static void release(scene *s, kg_metrics *m)
{
  kg_metrics_destroy(m);
  kg_body_destroy(s->body);
  free(s->q);
  free(s->out);
}

/* Capture: stands 5 mm above the ground. Output: slides at 0.3 m/s, 3 mm deep in the first half. */
static void sliding_and_sinking_are_measured(void **state)
{
  (void)state;
  const int T = 241;
  const double dt = 1.0 / 120.0, speed = 0.3;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0, 0.905, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(speed * dt * t, t < 120 ? 0.897 : 0.905, 0), kg_quat_identity());
  }
  kg_metrics *m = metrics_of(&s);
  assert_close(m->capture.penetration_events, 0.0, 1e-15);
  assert_close(m->output.penetration_events, 120.0 / T, 1e-12);
  assert_close(m->output.penetration_max_m, 0.003, 1e-12);
  assert_close(m->output.penetration_mean_m, 0.003, 1e-12);
  assert_true(m->capture.penetration_mean_m == 0.0);
  assert_int_equal(m->output_deepest[KG_OBSTACLE_SCENE].frame, 0); /* the first of 120 */
  const kg_deepest *none = &m->capture_deepest[KG_OBSTACLE_SCENE];
  assert_true(none->depth == 0.0 && none->frame == -1 && none->segment == -1);
  assert_close(m->penetration_frame_m[119], 0.003, 1e-12);
  assert_true(m->penetration_frame_m[120] == 0.0);
  assert_true(m->capture.slip_m == 0.0 && m->capture.foot_skate_ratio == 0.0);
  assert_close(m->output.slip_m, speed * dt, 1e-12);
  assert_close(m->output.slip_m_per_s, speed, 1e-12);
  assert_close(m->output.slip_50hz_m, speed * 0.02, 1e-12);
  assert_close(m->output.foot_skate_ratio, 1.0, 1e-12);
  assert_close(m->output.validity, 1.0 - 23.1 * speed * 0.02, 1e-12);
  assert_close(m->capture.validity, 1.0, 1e-12);
  /* error of frame t: sideways and down */
  double sum = 0.0;
  for (int t = 0; t < T; t++) {
    const double e = hypot(speed * dt * t, t < 120 ? 0.008 : 0.0);
    assert_close(m->mpjpe_frame_m[t], e, 1e-13);
    sum += e / T;
  }
  assert_close(m->mpjpe_m, sum, 1e-12);
  assert_close(m->mpjpe_joint_m[0], sum, 1e-12);
  assert_close(m->mpjpe_max_m, speed * dt * (T - 1), 1e-12);
  assert_close(m->mpjpe_normalized_m[99], m->mpjpe_frame_m[T - 1], 1e-12);
  assert_close(m->mpjpe_normalized_m[66], speed * dt * (66.0 / 99.0 * (T - 1)), 1e-12);
  release(&s, m);
}

/* A slab that rises at 0.2 m/s from 10 mm below who stands still: the scene of a frame is that of its
 * time, for what is deep and for what carries. */
static void a_scene_that_moves_is_where_it_is_then(void **state)
{
  (void)state;
  const int T = 61;
  const double dt = 1.0 / 60.0, rise = 0.2, gap = 0.01;
  scene s = brick_scene(T, dt);
  s.subject.scene = kg_scene_ground(-5.0, kg_vec3_make(0, 1, 0));
  const kg_place place = {.at = {0.0, -0.5 - gap, 0.0}, .velocity = {0.0, rise, 0.0}};
  const kg_sdf_shape slab = {.kind = KG_SHAPE_BOX,
                             .b = {1.0, 0.5, 1.0},
                             .orientation = kg_quat_identity(),
                             .place = kg_scene_add_place(&s.subject.scene, &place)};
  assert_true(kg_scene_add(&s.subject.scene, &slab));
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0, 0.9, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(0, 0.9 + rise * t * dt, 0), kg_quat_identity()); /* stands on it */
  }
  kg_metrics *m = metrics_of(&s);
  const double last = rise * (T - 1) * dt - gap;
  assert_close(m->capture.penetration_max_m, last, 1e-12);
  assert_close(m->capture.penetration_events, 57.0 / T, 1e-12); /* from frame 4 on, 3.3 mm */
  assert_true(m->output.penetration_max_m == 0.0);
  for (int t = 0; t < T; t++) {
    assert_true(m->penetration_frame_m[t] == 0.0);
  }
  assert_at_most(m->output.force_balance, 1e-6); /* carried all the way up */
  release(&s, m);
}

/* Nodes above 10 mm do not count, on a tilted plane the motion along it does. */
static void slip_counts_low_nodes_along_the_surface(void **state)
{
  (void)state;
  const int T = 61;
  const double dt = 1.0 / 60.0, slope = 0.2;
  scene s = brick_scene(T, dt);
  const kg_vec3 normal = {-sin(slope), cos(slope), 0.0};
  s.subject.scene = kg_scene_ground(0.0, normal);
  const kg_quat tilt = kg_quat_exp(kg_vec3_make(0, 0, slope));
  const kg_vec3 along = kg_quat_rotate(tilt, kg_vec3_make(0.05, 0, 0));
  for (int t = 0; t < T; t++) {
    const kg_vec3 base = kg_vec3_scale(0.905, normal), high = kg_vec3_scale(0.911, normal);
    put(s.q, t, kg_vec3_add_scaled(base, t * dt, along), tilt);
    put(s.out, t, kg_vec3_add_scaled(high, t * dt, along), tilt);
  }
  kg_metrics *m = metrics_of(&s);
  assert_close(m->capture.slip_m_per_s, 0.05, 1e-12);
  assert_true(m->capture.foot_skate_ratio == 0.0); /* slower than 0.1 m/s */
  assert_true(m->output.slip_m == 0.0 && m->output.slip_50hz_m == 0.0);
  assert_close(m->mpjpe_m, 0.006, 1e-12);
  release(&s, m);
}

/* A node must be low in both frames: one that hops every other frame never slips. */
static void a_hopping_node_does_not_slip(void **state)
{
  (void)state;
  const int T = 60;
  scene s = brick_scene(T, 1.0 / 50.0);
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0.01 * t, t % 2 ? 0.905 : 0.915, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(0.01 * t, 0.905, 0), kg_quat_identity());
  }
  kg_metrics *m = metrics_of(&s);
  assert_true(m->capture.slip_m == 0.0 && m->capture.slip_50hz_m == 0.0);
  assert_close(m->output.slip_m, 0.01, 1e-12);
  release(&s, m);
}

/* At rest, then in the air with a steady spin: the drift of the whole motion is that spin, the
 * drift in flight is none, although the velocity of the first frame in the air looks back. */
static void take_off_is_not_drift_in_flight(void **state)
{
  (void)state;
  const int T = 120;
  const double dt = 1.0 / 120.0;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    const bool air = t >= 60;
    put(s.q, t, kg_vec3_make(0, air ? 3.0 : 0.905, 0),
        kg_quat_exp(kg_vec3_make(0, 0, air ? 2.0 * (t - 60) * dt : 0.0)));
  }
  memcpy(s.out, s.q, (size_t)T * 7 * sizeof(double));
  kg_metrics *m = metrics_of(&s);
  assert_at_most(m->capture.angular_momentum_drift_flight, 1e-9);
  assert_close(m->capture.angular_momentum_drift, BRICK_I[2] * 2.0 * (59.0 + 0.5) / T, 1e-9);
  release(&s, m);
}

/* Jitter above the cutoff is not taken for force: 0.5 mm at 60 Hz would be 1728 N, 1 mrad at 40 Hz
 * 69 N m. Both bricks hover, so nothing else can explain it. */
static void jitter_is_smoothed_before_it_is_differentiated(void **state)
{
  (void)state;
  const int T = 240;
  const double dt = 1.0 / 120.0, w = 6.283185307179586 * 40.0;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0, t % 2 ? 3.0005 : 2.9995, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(0, 3.0, 0),
        kg_quat_exp(kg_vec3_make(0, 0, 1e-3 * sin(w * t * dt + 0.5))));
  }
  kg_metrics *m = metrics_of(&s);
  assert_close(m->capture.force_balance, BRICK_MASS * 9.8, 1e-6);
  assert_true(m->output.momentum_balance > 0.5 && m->output.momentum_balance < 3.0);
  release(&s, m);
}

/* Upside down on the ring of eight: it carries the weight although the four points beside it come
 * first and could not. */
static void the_lowest_points_of_a_segment_carry_it(void **state)
{
  (void)state;
  const int T = 61;
  scene s = brick_scene(T, 1.0 / 120.0);
  const kg_quat over = kg_quat_exp(kg_vec3_make(0, 0, 3.141592653589793));
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0, 0.805, 0), over);
    put(s.out, t, kg_vec3_make(0, 0.805, 0), over);
  }
  kg_metrics *m = metrics_of(&s);
  assert_at_most(m->capture.force_balance + m->capture.momentum_balance, 1e-6);
  release(&s, m);
}

/* Capture: free flight with a steady spin about a principal axis. Output: the spin gains. */
static void flight_keeps_its_momentum(void **state)
{
  (void)state;
  const int T = 181;
  const double dt = 1.0 / 120.0, spin = 3.0, gain = 1.5;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    const double x = t * dt;
    const kg_vec3 p = {0.4 * x, 30.0 + 7.0 * x - 4.9 * x * x, -0.2 * x};
    put(s.q, t, p, kg_quat_exp(kg_vec3_make(0, 0, spin * x)));
    put(s.out, t, p, kg_quat_exp(kg_vec3_make(0, 0, spin * x + 0.5 * gain * x * x)));
  }
  kg_metrics *m = metrics_of(&s);
  assert_at_most(m->capture.angular_momentum_change, 1e-9);
  assert_at_most(m->capture.angular_momentum_drift, 1e-9);
  assert_at_most(m->capture.angular_momentum_drift_flight, 1e-9);
  assert_at_most(m->capture.momentum_balance, 1e-6);
  assert_at_most(m->capture.force_balance, 0.002); /* of 588 N; the ends of the filter */
  assert_close(m->capture.validity, 1.0, 1e-9);
  /* dL = I gain dt: uniform but for the one-sided velocities of the two end frames */
  assert_close(m->output.angular_momentum_change, BRICK_I[2] * gain * 0.02, 0.01);
  assert_close(m->output.momentum_balance, BRICK_I[2] * gain, 1e-4);
  assert_close(m->output.angular_momentum_drift_flight, BRICK_I[2] * gain * dt * (T - 2) / 2.0,
               1e-6);
  assert_at_most(m->mpjpe_m, 1e-12);
  assert_true(m->output.slip_m == 0.0);
  release(&s, m);
}

/* Standing: the ground carries it, exactly, as long as the centre of mass is above the soles.
 * The output hovers beyond the reach of any contact: weight is missing, and nothing else. */
static void standing_is_balanced_and_hovering_is_not(void **state)
{
  (void)state;
  const int T = 121;
  scene s = brick_scene(T, 1.0 / 120.0);
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(0.7, 0.915, 0.1), kg_quat_identity());
    put(s.out, t, kg_vec3_make(0.7, 0.93, 0.1), kg_quat_identity());
  }
  kg_metrics *m = metrics_of(&s);
  assert_at_most(m->capture.force_balance, 1e-6);
  assert_at_most(m->capture.momentum_balance, 1e-6);
  assert_close(m->output.force_balance, BRICK_MASS * 9.8, 1e-9);
  assert_at_most(m->output.momentum_balance, 1e-9);
  assert_at_most(m->capture.angular_momentum_drift, 1e-12);
  assert_true(m->capture.spectral_arc_length == 0.0 && m->capture.jerk_rms == 0.0);
  assert_close(m->acceleration_peak_ratio, 1.0, 1e-12);
  release(&s, m);
}

/* Sideways acceleration a: friction 0.9 can push up to 0.9 g, or a little less between the edges
 * of the pyramid, but only with the foot's moment arm: half the width 0.2 over the height 0.9. */
static void the_friction_cone_and_the_sole_bound_the_force(void **state)
{
  (void)state;
  const int T = 121;
  const double dt = 1.0 / 120.0;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    const double x = t * dt;
    put(s.q, t, kg_vec3_make(0.5 * 1.5 * x * x, 0.905, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(0.5 * 6.0 * x * x, 0.905, 0), kg_quat_identity());
  }
  kg_metrics *m = metrics_of(&s);
  /* 1.5 / 9.8 = 0.153 < 0.2 / 0.9 = 0.222: explained. 6.0 / 9.8 is far outside: not. */
  assert_at_most(m->capture.force_balance, 0.02);
  assert_at_most(m->capture.momentum_balance, 0.02);
  assert_true(m->output.force_balance + m->output.momentum_balance > 50.0);
  release(&s, m);
}

/* A force m a at the ground, 0.9 below the centre of mass, turns the brick forward by 0.9 m a / I.
 * A motion that does both needs no moment from the spread of the sole; friction allows up to 0.9 g
 * cos(22.5 degrees) in every direction of the pyramid. The huge inertia keeps the brick upright. */
static void force_and_moment_go_together(void **state)
{
  (void)state;
  const int T = 61;
  const double dt = 1.0 / 120.0, I = 1e4, accelerations[2] = {7.9, 14.0};
  scene s = brick_scene(T, dt);
  for (int k = 0; k < 3; k++) {
    s.body->segments[0].inertia[k] = I;
  }
  for (int t = 0; t < T; t++) {
    for (int k = 0; k < 2; k++) {
      const double x = t * dt, a = accelerations[k], turn = 0.905 * BRICK_MASS * a / I;
      put(k == 0 ? s.q : s.out, t, kg_vec3_make(0.5 * a * x * x, 0.905, 0),
          kg_quat_exp(kg_vec3_make(0, 0, 0.5 * turn * x * x)));
    }
  }
  kg_metrics *m = metrics_of(&s);
  assert_at_most(m->capture.force_balance + m->capture.momentum_balance, 0.1);
  assert_true(m->output.force_balance + m->output.momentum_balance > 100.0); /* it would slide */
  release(&s, m);
}

/* A joint at rest counts as accelerated at 1 m/s^2: noise below that is no peak. */
static void acceleration_peaks_of_a_still_capture(void **state)
{
  (void)state;
  const int T = 40;
  const double dt = 0.01, kicks[2] = {2e-5, 2e-4}, expected[2] = {1.0, 4.0}; /* 2 kick / dt^2 */
  for (int k = 0; k < 2; k++) {
    scene s = brick_scene(T, dt);
    for (int t = 0; t < T; t++) {
      put(s.q, t, kg_vec3_make(0.0, 2.0, 0.0), kg_quat_identity());
      put(s.out, t, kg_vec3_make(0.0, t == 20 ? 2.0 + kicks[k] : 2.0, 0.0), kg_quat_identity());
    }
    kg_metrics *m = metrics_of(&s);
    assert_close(m->acceleration_peak_ratio, expected[k], 1e-8);
    release(&s, m);
  }
}

/* x = j t^3 / 6 has jerk j at every frame; a single displaced frame has a known acceleration. */
static void jerk_and_acceleration_peaks_are_those_of_the_formula(void **state)
{
  (void)state;
  const int T = 100;
  const double dt = 0.01, jerk = 5.0, kick = 0.002;
  scene s = brick_scene(T, dt);
  for (int t = 0; t < T; t++) {
    const double x = t * dt;
    const kg_vec3 p = {jerk * x * x * x / 6.0, 2.0, 0.0};
    put(s.q, t, p, kg_quat_identity());
    put(s.out, t, kg_vec3_make(p.x, p.y + (t == 40 ? kick : 0.0), 0.0), kg_quat_identity());
  }
  kg_metrics *m = metrics_of(&s);
  assert_close(m->capture.jerk_rms, jerk, 1e-6);
  /* capture's peak: jerk times the second-last instant; output's: 2 kick / dt^2, up */
  const double before = jerk * (T - 2) * dt;
  const double after = hypot(2.0 * kick / (dt * dt), jerk * 40 * dt);
  assert_close(m->acceleration_peak_ratio, after / before, 1e-8);
  assert_int_equal(m->acceleration_peak_joint, 0);
  assert_true(m->output.jerk_rms > 100.0 * jerk);
  release(&s, m);
}

/* Arc length written out with a plain Fourier sum over the same frequencies. */
static double arc_by_hand(const double *speed, int count, double dt)
{
  int n = 16;
  while (n < 16 * (count + 1)) {
    n *= 2;
  }
  static double magnitude[4096];
  const int bins = (int)(20.0 * n * dt) + 1;
  assert_true(bins <= 4096);
  double largest = 0.0;
  for (int k = 0; k < bins; k++) {
    double re = 0.0, im = 0.0;
    for (int t = 0; t < count; t++) {
      re += speed[t] * cos(6.283185307179586 * k * t / n);
      im += speed[t] * sin(6.283185307179586 * k * t / n);
    }
    magnitude[k] = hypot(re, im);
    largest = fmax(largest, magnitude[k]);
  }
  int last = 0;
  for (int k = 0; k < bins; k++) {
    last = magnitude[k] >= 0.05 * largest ? k : last;
  }
  double arc = 0.0;
  for (int k = 1; k <= last; k++) {
    arc += hypot(1.0 / last, (magnitude[k] - magnitude[k - 1]) / largest);
  }
  return -arc;
}

static void spectral_arc_length_is_the_published_one(void **state)
{
  (void)state;
  const int T = 201;
  const double dt = 0.01;
  scene s = brick_scene(T, dt);
  double speed[2][200], x[2] = {0.0, 0.0};
  for (int t = 0; t < T; t++) {
    put(s.q, t, kg_vec3_make(x[0], 2, 0), kg_quat_identity());
    put(s.out, t, kg_vec3_make(x[1], 2, 0), kg_quat_identity());
    if (t < T - 1) {
      const double u = (t * dt - 1.0) / 0.25; /* a bell, and a bell with tremor */
      speed[0][t] = exp(-0.5 * u * u);
      speed[1][t] = speed[0][t] * (1.0 + 0.8 * sin(6.283185307179586 * 6.0 * t * dt));
      x[0] += speed[0][t] * dt;
      x[1] += speed[1][t] * dt;
    }
  }
  kg_metrics *m = metrics_of(&s);
  assert_close(m->capture.spectral_arc_length, arc_by_hand(speed[0], 200, dt), 1e-9);
  assert_close(m->output.spectral_arc_length, arc_by_hand(speed[1], 200, dt), 1e-9);
  assert_true(m->capture.spectral_arc_length > -1.6); /* a bell is about as smooth as it gets */
  assert_true(m->output.spectral_arc_length < m->capture.spectral_arc_length - 0.3);
  release(&s, m);
}

/* Clips of any length, down to a single frame, have finite metrics. */
static void short_clips_are_measured_too(void **state)
{
  (void)state;
  for (int T = 1; T < 30; T++) {
    scene s = brick_scene(T, 1.0 / 120.0);
    for (int t = 0; t < T; t++) {
      put(s.q, t, kg_vec3_make(0, 0.9, 0), kg_quat_identity());
      put(s.out, t, kg_vec3_make(0.001 * t, 0.9, 0), kg_quat_exp(kg_vec3_make(0, 0.01 * t, 0)));
    }
    kg_metrics *m = metrics_of(&s);
    assert_true(isfinite(m->mpjpe_m) && isfinite(m->acceleration_peak_ratio));
    assert_true(isfinite(m->mpjpe_normalized_m[0]) && isfinite(m->mpjpe_normalized_m[99]));
    release(&s, m);
  }
}

/* ---- a whole body ---------------------------------------------------------------------------- */

static scene walker_scene(int *T, kg_clip **clip)
{
  kg_error error = {0};
  kg_clip_def clip_def = kg_clip_default_def();
  clip_def.unit_m = 0.01;
  kg_mapping mapping;
  const kg_body_def def = kg_body_default_def();
  scene s = {0};
  if (kg_clip_read(clip, KG_TEST_DATA "/walker.bvh", &clip_def, &error) != KG_OK ||
      kg_mapping_find(&mapping, *clip, NULL, &error) != KG_OK ||
      kg_body_from_clip(&s.body, *clip, &mapping, &def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  *T = (*clip)->frame_count;
  const size_t size = (size_t)*T * (size_t)s.body->nq;
  s.q = calloc(size, sizeof(double));
  s.out = calloc(size, sizeof(double));
  assert_true(s.q && s.out);
  for (int t = 0; t < *T; t++) {
    double *q = s.q + t * s.body->nq;
    kg_body_state_from_clip(s.body, *clip, t, q, t > 0 ? q - s.body->nq : NULL);
  }
  s.subject = (kg_subject){.body = s.body,
                           .scene = kg_scene_ground(0.0, kg_vec3_make(0, 1, 0)),
                           .frame_count = *T,
                           .dt = (*clip)->frame_time,
                           .q = s.q};
  return s;
}

/* d_pen by a plain loop over all points: the probe skips segments that are far away. */
static void penetration_is_the_deepest_of_all_points(void **state)
{
  (void)state;
  int T;
  kg_clip *clip;
  scene s = walker_scene(&T, &clip);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, s.body, NULL), KG_OK);
  kg_random random = kg_random_make(8);
  for (int t = 0; t < T; t++) { /* tumbling around the ground */
    double *q = s.out + t * s.body->nq;
    memcpy(q, s.q + t * s.body->nq, (size_t)s.body->nq * sizeof(double));
    const kg_quat r = random_quat(&random);
    const double turn[4] = {r.w, r.x, r.y, r.z};
    memcpy(q + 3, turn, sizeof turn);
    q[1] = 0.3 + 0.6 * kg_random_uniform(&random);
  }
  kg_metrics *m = metrics_of(&s);
  int above = 0, inside = 0;
  double sum = 0.0;
  kg_deepest deepest = {.frame = -1};
  for (int t = 0; t < T; t++) {
    double lowest = 1e9;
    for (int k = 0; k < s.body->point_count; k++) {
      const double *q = s.out + t * s.body->nq;
      const double y = kg_dynamics_point(dynamics, NULL, q, s.body->points[k]).y;
      lowest = fmin(lowest, y);
      if (-y > deepest.depth) deepest = (kg_deepest){-y, t, s.body->points[k].segment, -1};
    }
    assert_close(m->penetration_frame_m[t], fmax(-lowest, 0.0), 1e-12);
    above += lowest > 0.0;
    inside += -lowest > KG_METRIC_TOUCH_DEPTH_M;
    sum += -lowest > KG_METRIC_TOUCH_DEPTH_M ? -lowest : 0.0;
  }
  assert_true(above > 0 && above < T);
  assert_close(m->output.penetration_mean_m, sum / inside, 1e-12);
  const kg_deepest *found = &m->output_deepest[KG_OBSTACLE_SCENE];
  assert_close(found->depth, deepest.depth, 1e-12);
  assert_int_equal(found->frame, deepest.frame);
  assert_int_equal(found->segment, deepest.segment);
  assert_int_equal(found->entered, -1);
  kg_dynamics_destroy(dynamics);
  kg_clip_destroy(clip);
  release(&s, m);
}

static void identical_motions_differ_by_nothing(void **state)
{
  (void)state;
  int T;
  kg_clip *clip;
  scene s = walker_scene(&T, &clip);
  memcpy(s.out, s.q, (size_t)T * (size_t)s.body->nq * sizeof(double));
  kg_metrics *m = metrics_of(&s);
  assert_true(m->mpjpe_m == 0.0 && m->mpjpe_max_m == 0.0);
  assert_close(m->acceleration_peak_ratio, 1.0, 1e-15);
  assert_memory_equal(&m->capture, &m->output, sizeof m->capture);
  kg_metrics *again = metrics_of(&s);
  assert_memory_equal(&m->capture, &again->capture, sizeof m->capture);
  kg_metrics_destroy(again);

  const int runs = 5;
  const clock_t start = clock();
  for (int k = 0; k < runs; k++) {
    kg_metrics *timed;
    assert_int_equal(kg_metrics_create(&timed, &s.subject, s.out), KG_OK);
    kg_metrics_destroy(timed);
  }
  const double seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
  print_message("metrics of a pair: %.1f us a frame\n", 1e6 * seconds / (runs * T));
  kg_clip_destroy(clip);
  release(&s, m);
}

/* A limp body dropped on the ground by the implicit step: every force on it is gravity or contact,
 * so the fit must find next to nothing left, landing included. */
static void a_simulated_fall_is_balanced(void **state)
{
  (void)state;
  int T;
  kg_clip *clip;
  scene s = walker_scene(&T, &clip);
  kg_step_def def = kg_step_default_def(s.body);
  def.scene = &s.subject.scene;
  def.joint_damping = 5.0;
  kg_step *step;
  assert_int_equal(kg_step_create(&step, &def), KG_OK);
  const int frames = 150, nq = s.body->nq;
  double *q = calloc((size_t)(frames * nq), sizeof(double));
  double v[75] = {0}, next[75] = {0};
  const double tau[75] = {0};
  assert_true(q && s.body->nv <= 75);
  memcpy(q, s.q, (size_t)nq * sizeof(double));
  q[1] += 0.3;
  for (int t = 1; t < frames; t++) {
    kg_step_report report;
    kg_step_advance(step, q + t * nq, next, q + (t - 1) * nq, v, tau, s.subject.dt, true, &report);
    assert_true(report.converged);
    memcpy(v, next, sizeof v);
  }
  s.subject.frame_count = frames;
  s.subject.q = q;
  free(s.out);
  s.out = q;
  kg_metrics *m = metrics_of(&s);
  print_message("simulated fall: %.2f N m, %.2f N left\n", m->output.momentum_balance,
                m->output.force_balance);
  assert_at_most(m->output.momentum_balance, 1.0);
  assert_at_most(m->output.force_balance, 4.0);
  assert_at_most(m->output.penetration_max_m, 1e-5);
  kg_step_destroy(step);
  kg_clip_destroy(clip);
  release(&s, m);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  int T;
  kg_clip *clip;
  scene s = walker_scene(&T, &clip);
  memcpy(s.out, s.q, (size_t)T * (size_t)s.body->nq * sizeof(double));
  int allowed = 0;
  for (; allowed < 200; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    s.subject.allocator = &allocator;
    kg_metrics *m;
    const kg_status status = kg_metrics_create(&m, &s.subject, s.out);
    if (status == KG_OK) {
      kg_metrics_destroy(m);
      assert_int_equal(heap.live_bytes, 0);
      break;
    }
    assert_int_equal(status, KG_ERR_NO_MEMORY);
    assert_null(m);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(allowed > 2 && allowed < 200);
  s.subject.allocator = NULL;
  kg_clip_destroy(clip);
  release(&s, NULL);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(nnls_finds_the_weights_of_table_2),
    cmocka_unit_test(nnls_meets_the_conditions_of_a_minimum),
    cmocka_unit_test(validity_is_clipped),
    cmocka_unit_test(sliding_and_sinking_are_measured),
    cmocka_unit_test(a_scene_that_moves_is_where_it_is_then),
    cmocka_unit_test(slip_counts_low_nodes_along_the_surface),
    cmocka_unit_test(flight_keeps_its_momentum),
    cmocka_unit_test(standing_is_balanced_and_hovering_is_not),
    cmocka_unit_test(the_friction_cone_and_the_sole_bound_the_force),
    cmocka_unit_test(a_hopping_node_does_not_slip),
    cmocka_unit_test(take_off_is_not_drift_in_flight),
    cmocka_unit_test(jitter_is_smoothed_before_it_is_differentiated),
    cmocka_unit_test(the_lowest_points_of_a_segment_carry_it),
    cmocka_unit_test(force_and_moment_go_together),
    cmocka_unit_test(acceleration_peaks_of_a_still_capture),
    cmocka_unit_test(jerk_and_acceleration_peaks_are_those_of_the_formula),
    cmocka_unit_test(spectral_arc_length_is_the_published_one),
    cmocka_unit_test(short_clips_are_measured_too),
    cmocka_unit_test(penetration_is_the_deepest_of_all_points),
    cmocka_unit_test(identical_motions_differ_by_nothing),
    cmocka_unit_test(a_simulated_fall_is_balanced),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("metrics", tests, NULL, NULL);
}
