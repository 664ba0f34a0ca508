/* Metrics of one motion: penetration, slip, angular momentum (definitions and choices:
 * docs/theory/metrics.md).
 *
 * Velocities are central differences of states, v_t = (q_{t+1} (-) q_{t-1}) / 2 dt, one-sided at the
 * ends. Every division is by a count that is checked first: an absent quantity is 0, never NaN. */
#include "pipeline/measure.h"

#include "pipeline/pipeline.h"

#include "kinegrad/filter.h"

bool kg_measure_create(kg_measure *m, const kg_subject *subject, kg_arena *arena)
{
  const kg_body *body = subject->body;
  const size_t n = (size_t)body->segment_count, T = (size_t)subject->frame_count;
  *m = (kg_measure){.subject = subject, .T = subject->frame_count, .dt = subject->dt};
  m->fft_size = kg_measure_fft_size(m->T);
  m->bounds = KG_ARENA_ARRAY(arena, kg_ball, n);
  m->p = KG_ARENA_ARRAY(arena, kg_vec3, n);
  m->R = KG_ARENA_ARRAY(arena, kg_mat3, n);
  m->v = KG_ARENA_ARRAY(arena, double, body->nv);
  for (int k = 0; k < 3; k++) {
    m->q[k] = KG_ARENA_ARRAY(arena, double, body->nq);
  }
  m->com = KG_ARENA_ARRAY(arena, kg_vec3, T);
  m->L = KG_ARENA_ARRAY(arena, kg_vec3, T);
  m->flight = KG_ARENA_ARRAY(arena, bool, T);
  m->series = KG_ARENA_ARRAY(arena, double, T);
  m->filter_work =
    KG_ARENA_ARRAY(arena, double, kg_filter_work_size(m->T, 1.0 / m->dt, KG_METRIC_SMOOTHING_HZ));
  m->spectrum = KG_ARENA_ARRAY(arena, double, 2 * (size_t)m->fft_size);
  const int columns = KG_PROBE_CARRIERS * KG_FRICTION_EDGES;
  m->A = KG_ARENA_ARRAY(arena, double, 6 * columns);
  m->x = KG_ARENA_ARRAY(arena, double, columns);
  m->nnls_work = KG_ARENA_ARRAY(arena, double, kg_nnls_work_size(6, columns));
  m->reach = kg_measure_balance_reach(m->dt);
  m->window = KG_ARENA_ARRAY(arena, kg_probe, 2 * m->reach + 1);
  m->stamp = KG_ARENA_ARRAY(arena, long, body->point_count);
  m->hints = KG_ARENA_ARRAY(arena, kg_scene_hint, body->point_count);
  if (kg_arena_failed(arena) ||
      kg_dynamics_create(&m->dynamics, body, subject->allocator) != KG_OK) {
    return false;
  }
  if (kg_stage_create(&m->scene, subject, KG_STAGE_SCENE_ONLY, subject->allocator) != KG_OK) {
    return false;
  }
  if (subject->other &&
      kg_stage_create(&m->other, subject, KG_STAGE_OTHER_ONLY, subject->allocator) != KG_OK) {
    return false;
  }
  if (subject->self && kg_self_create(&m->self, body, NULL, subject->allocator) != KG_OK) {
    return false;
  }
  for (int i = 0; i < body->segment_count; i++) {
    int count = 0;
    for (int k = 0; k < body->point_count; k++) {
      if (body->points[k].segment == i) {
        m->bounds[i].center = kg_vec3_add(m->bounds[i].center, body->points[k].p);
        count++;
      }
    }
    m->bounds[i].center = kg_vec3_scale(count > 0 ? 1.0 / count : 0.0, m->bounds[i].center);
    m->bounds[i].radius = count > 0 ? 0.0 : -1.0; /* -1: no points */
    for (int k = 0; k < body->point_count; k++) {
      if (body->points[k].segment == i) {
        const kg_vec3 d = kg_vec3_sub(body->points[k].p, m->bounds[i].center);
        m->bounds[i].radius = fmax(m->bounds[i].radius, kg_vec3_norm(d));
      }
    }
  }
  return true;
}

void kg_measure_release(kg_measure *m)
{
  kg_stage_destroy(m->other);
  kg_stage_destroy(m->scene);
  kg_dynamics_destroy(m->dynamics);
  kg_self_destroy(m->self);
  m->other = m->scene = NULL;
  m->self = NULL;
  m->dynamics = NULL;
}

/* ---- one pose against the scene -------------------------------------------------------------- */

/* Sole nodes always; of a segment's other points only the lowest few stay. */
static void add_carrier(kg_probe *probe, const kg_probe_point *point, bool node)
{
  int same = 0, highest = -1;
  for (int k = probe->carrier_nodes; !node && k < probe->carrier_count; k++) {
    if (probe->carriers[k].segment == point->segment) {
      same++;
      if (highest < 0 || probe->carriers[k].distance > probe->carriers[highest].distance) {
        highest = k;
      }
    }
  }
  if (same >= KG_PROBE_PER_SEGMENT) {
    if (point->distance < probe->carriers[highest].distance) {
      probe->carriers[highest] = *point;
    }
  } else if (probe->carrier_count < KG_PROBE_CARRIERS) {
    probe->carriers[probe->carrier_count++] = *point;
    probe->carrier_nodes += node;
  }
}

/* Phi grows by at most 1 per metre: points of a segment whose bounding ball is farther away than
 * the balance height need no query. */
void kg_measure_probe(kg_measure *m, const double *q, double time, kg_probe *probe)
{
  const kg_body *body = m->subject->body;
  const kg_scene *scene = kg_stage_scene(m->scene);
  kg_dynamics_pose(m->dynamics, q, m->p, m->R);
  kg_stage_set(m->scene, time, m->p[0]);
  probe->lowest = probe->lowest_soft = INFINITY;
  probe->lowest_segment = -1;
  probe->carrier_count = 0;
  probe->carrier_nodes = 0;
  probe->node_count =
    body->sole_node_count < KG_PROBE_NODES ? body->sole_node_count : KG_PROBE_NODES;
  int segment = -1;
  bool near = false;
  for (int k = 0; k < body->point_count; k++) {
    const kg_body_point *point = &body->points[k];
    if (point->segment != segment) { /* points of a segment follow each other, mostly */
      segment = point->segment;
      const kg_vec3 center =
        kg_vec3_add(m->p[segment], kg_mat3_mul_vec(m->R[segment], m->bounds[segment].center));
      near =
        kg_scene_surface(scene, center) - m->bounds[segment].radius <= KG_METRIC_BALANCE_HEIGHT_M;
    }
    kg_probe_point at = {.segment = segment, .point = k, .distance = INFINITY};
    if (near) {
      at.x = kg_vec3_add(m->p[segment], kg_mat3_mul_vec(m->R[segment], point->p));
      const kg_sdf_value rigid = kg_scene_distance_from(scene, at.x, &m->hints[k]);
      const kg_sdf_value phi = scene->ground_count > 0 ? kg_soft_distance(scene, at.x) : rigid;
      at.normal = phi.normal;
      at.distance = phi.distance;
      if (rigid.distance < probe->lowest) {
        probe->lowest = rigid.distance;
        probe->lowest_segment = segment;
      }
      probe->lowest_soft = fmin(probe->lowest_soft, phi.distance);
      if (phi.distance <= KG_METRIC_BALANCE_HEIGHT_M) {
        add_carrier(probe, &at, k < probe->node_count);
      }
    }
    if (k < probe->node_count) {
      probe->nodes[k] = at;
    }
  }
}

/* ---- how deep -------------------------------------------------------------------------------- */

/* A motion in one obstacle, frame by frame. */
typedef struct depth_sum {
  double *frames; /* (T) d_pen, or NULL */
  int events, inside;
  double sum; /* m, over the frames inside */
  kg_deepest deepest;
} depth_sum;

static const kg_deepest nowhere = {.depth = 0.0, .frame = -1, .segment = -1, .entered = -1};

static kg_deepest depth_in_scene(const kg_probe *probe, int t)
{
  if (!(probe->lowest < 0.0)) return nowhere;
  return (kg_deepest){-probe->lowest, t, probe->lowest_segment, -1};
}

/* of the pose in m->p and m->R, frame t */
static kg_deepest depth_in_other(kg_measure *m, int t)
{
  const kg_body *body = m->subject->body;
  const kg_scene *scene = kg_stage_scene(m->other);
  kg_stage_set(m->other, t * m->dt, m->p[0]);
  kg_deepest deepest = nowhere;
  for (int k = 0; k < body->point_count && scene->shape_count > 0; k++) {
    const int i = body->points[k].segment;
    const kg_vec3 x = kg_vec3_add(m->p[i], kg_mat3_mul_vec(m->R[i], body->points[k].p));
    const kg_scene_point near = kg_scene_nearest(scene, x);
    if (!(-near.value.distance > deepest.depth)) continue;
    const int entered = m->subject->other->body->shapes[near.shape].segment;
    deepest = (kg_deepest){-near.value.distance, t, i, entered};
  }
  return deepest;
}

static kg_deepest depth_in_self(kg_measure *m, int t)
{
  kg_self_touch touch;
  const double depth = kg_self_depth(m->self, m->p, m->R, &touch);
  if (!(depth > 0.0)) return nowhere;
  const int segment = m->subject->body->points[touch.point].segment;
  return (kg_deepest){depth, t, segment, touch.segment};
}

static void add_depth(depth_sum *sum, int t, kg_deepest now)
{
  if (sum->frames) sum->frames[t] = now.depth;
  if (now.depth > sum->deepest.depth) sum->deepest = now;
  sum->events += now.depth > KG_METRIC_EVENT_DEPTH_M;
  if (now.depth > KG_METRIC_TOUCH_DEPTH_M) {
    sum->inside++;
    sum->sum += now.depth;
  }
}

static double mean_depth(const depth_sum *sum)
{
  return sum->inside > 0 ? sum->sum / sum->inside : 0.0;
}

static void set_depths(const kg_measure *m, const depth_sum sums[KG_OBSTACLE_COUNT],
                       kg_motion_metrics *out)
{
  const depth_sum *scene = &sums[KG_OBSTACLE_SCENE], *other = &sums[KG_OBSTACLE_OTHER],
                  *self = &sums[KG_OBSTACLE_SELF];
  const double T = fmax(m->T, 1.0);
  out->penetration_events = scene->events / T;
  out->penetration_max_m = scene->deepest.depth;
  out->penetration_mean_m = mean_depth(scene);
  out->other_penetration_events = m->other ? other->events / T : NAN;
  out->other_penetration_max_m = m->other ? other->deepest.depth : NAN;
  out->other_penetration_mean_m = m->other ? mean_depth(other) : NAN;
  out->other_frames = m->other ? (double)other->inside : NAN;
  out->self_penetration_events = m->self ? self->events / T : NAN;
  out->self_penetration_max_m = m->self ? self->deepest.depth : NAN;
  out->self_penetration_mean_m = m->self ? mean_depth(self) : NAN;
}

/* ---- slip ------------------------------------------------------------------------------------ */

typedef struct slip_sum {
  double distance; /* m, over node-frames           */
  long pairs;      /* node-frames low in both frames */
  long fast;       /* of these, faster than 0.1 m/s  */
} slip_sum;

static void add_slip(slip_sum *sum, const kg_probe *before, const kg_probe *now, double dt)
{
  for (int k = 0; k < now->node_count; k++) {
    const kg_probe_point *a = &before->nodes[k], *b = &now->nodes[k];
    if (!(a->distance <= KG_METRIC_SLIP_HEIGHT_M && b->distance <= KG_METRIC_SLIP_HEIGHT_M)) {
      continue;
    }
    const kg_vec3 move = kg_vec3_sub(b->x, a->x);
    const kg_vec3 along = kg_vec3_add_scaled(move, -kg_vec3_dot(move, b->normal), b->normal);
    const double distance = kg_vec3_norm(along);
    sum->distance += distance;
    sum->pairs++;
    sum->fast += distance > KG_METRIC_SKATE_SPEED * dt;
  }
}

static double mean_slip(const slip_sum *sum)
{
  return sum->pairs > 0 ? sum->distance / (double)sum->pairs : 0.0;
}

/* ---- the capture's own rate ------------------------------------------------------------------ */

/* com and L of frame `now` with the velocity from one state to another, `span` seconds apart. */
static kg_centroid centroid_between(kg_measure *m, const double *before, const double *now,
                                    const double *after, double span)
{
  const int nv = m->subject->body->nv;
  kg_body_difference(m->subject->body, m->v, after, before);
  for (int k = 0; k < nv; k++) {
    m->v[k] = span > 0.0 ? m->v[k] / span : 0.0;
  }
  return kg_dynamics_centroid(m->dynamics, now, m->v);
}

static void measure_frames(kg_measure *m, const double *q, kg_vec3 *joints,
                           depth_sum sums[KG_OBSTACLE_COUNT], kg_motion_metrics *out)
{
  const kg_body *body = m->subject->body;
  const size_t n = (size_t)body->segment_count, nq = (size_t)body->nq;
  slip_sum slip = {0};
  for (int t = 0; t < m->T; t++) {
    kg_probe *now = &m->probe[t & 1];
    const double *state = q + (size_t)t * nq;
    kg_measure_probe(m, state, t * m->dt, now);
    for (size_t i = 0; i < n; i++) {
      joints[(size_t)t * n + i] = m->p[i];
    }
    add_depth(&sums[KG_OBSTACLE_SCENE], t, depth_in_scene(now, t));
    if (m->other) add_depth(&sums[KG_OBSTACLE_OTHER], t, depth_in_other(m, t));
    if (m->self) add_depth(&sums[KG_OBSTACLE_SELF], t, depth_in_self(m, t));
    m->flight[t] = now->lowest_soft > KG_METRIC_BALANCE_HEIGHT_M;
    if (t > 0) {
      add_slip(&slip, &m->probe[(t - 1) & 1], now, m->dt);
    }
    const int before = t > 0 ? t - 1 : t, after = t + 1 < m->T ? t + 1 : t;
    const kg_centroid c = centroid_between(m, q + (size_t)before * nq, state,
                                           q + (size_t)after * nq, (after - before) * m->dt);
    m->com[t] = c.com;
    m->L[t] = c.L;
  }
  out->slip_m = mean_slip(&slip);
  out->slip_m_per_s = out->slip_m / m->dt;
  out->foot_skate_ratio = slip.pairs > 0 ? (double)slip.fast / (double)slip.pairs : 0.0;
}

/* ---- angular momentum ------------------------------------------------------------------------ */

/* Drift against frame 0, and in flight against the start of that flight. The first and the last
 * frame of a flight are left out: their velocities look across take-off and landing. */
static void measure_drift(const kg_measure *m, kg_motion_metrics *out)
{
  double sum = 0.0, flight_sum = 0.0;
  int flight_frames = 0, start = -1;
  for (int t = 0; t < m->T; t++) {
    sum += kg_vec3_norm(kg_vec3_sub(m->L[t], m->L[0]));
    const bool inside =
      t > 0 && t + 1 < m->T && m->flight[t - 1] && m->flight[t] && m->flight[t + 1];
    if (!inside) {
      start = -1;
    } else if (start < 0) {
      start = t;
    } else {
      flight_sum += kg_vec3_norm(kg_vec3_sub(m->L[t], m->L[start]));
      flight_frames++;
    }
  }
  out->angular_momentum_drift = m->T > 0 ? sum / m->T : 0.0;
  out->angular_momentum_drift_flight = flight_frames > 0 ? flight_sum / flight_frames : 0.0;
}

/* State at time x frames: linear and spherical linear interpolation. */
static void state_at(const kg_measure *m, double *out, const double *q, double x)
{
  const kg_body *body = m->subject->body;
  const int last = m->T - 1;
  const int t = x < last ? (int)x : last;
  const double share = t < last ? x - t : 0.0;
  const double *a = q + (ptrdiff_t)t * body->nq, *b = t < last ? a + body->nq : a;
  for (int k = 0; k < 3; k++) {
    out[k] = a[k] + share * (b[k] - a[k]);
  }
  for (int k = 3; k < body->nq; k += 4) {
    const kg_quat r = kg_quat_slerp(kg_quat_make(a[k], a[k + 1], a[k + 2], a[k + 3]),
                                    kg_quat_make(b[k], b[k + 1], b[k + 2], b[k + 3]), share);
    out[k] = r.w;
    out[k + 1] = r.x;
    out[k + 2] = r.y;
    out[k + 3] = r.z;
  }
}

/* Change of L and slip on the motion resampled to 0.02 s. A window of three states moves along. */
static void measure_resampled(kg_measure *m, const double *q, kg_motion_metrics *out)
{
  const double step = KG_METRIC_MOMENTUM_DT_S / m->dt;
  const int count = (int)((m->T - 1) / step + 1e-9) + 1;
  if (count < 2) {
    return;
  }
  slip_sum slip = {0};
  double change = 0.0;
  kg_vec3 L_before = {0.0, 0.0, 0.0};
  double *before = m->q[0], *now = m->q[1], *after = m->q[2];
  state_at(m, now, q, 0.0);
  state_at(m, before, q, 0.0);
  for (int k = 0; k < count; k++) {
    const bool last = k + 1 == count;
    state_at(m, after, q, (last ? k : k + 1) * step);
    const double span = (k == 0 || last ? 1.0 : 2.0) * KG_METRIC_MOMENTUM_DT_S;
    const kg_vec3 L = centroid_between(m, before, now, after, span).L;
    kg_measure_probe(m, now, k * KG_METRIC_MOMENTUM_DT_S, &m->probe[k & 1]);
    if (k > 0) {
      change += kg_vec3_norm(kg_vec3_sub(L, L_before));
      add_slip(&slip, &m->probe[(k - 1) & 1], &m->probe[k & 1], KG_METRIC_MOMENTUM_DT_S);
    }
    L_before = L;
    double *oldest = before;
    before = now;
    now = after;
    after = oldest;
  }
  out->angular_momentum_change = change / (count - 1);
  out->slip_50hz_m = mean_slip(&slip);
}

kg_motion_metrics kg_measure_motion(kg_measure *m, const double *q, kg_vec3 *joints,
                                    double *const depths[KG_OBSTACLE_COUNT],
                                    kg_deepest deepest[KG_OBSTACLE_COUNT])
{
  kg_motion_metrics out = {0};
  depth_sum sums[KG_OBSTACLE_COUNT];
  for (int k = 0; k < KG_OBSTACLE_COUNT; k++) {
    sums[k] = (depth_sum){.frames = depths ? depths[k] : NULL, .deepest = nowhere};
  }
  measure_frames(m, q, joints, sums, &out);
  set_depths(m, sums, &out);
  for (int k = 0; k < KG_OBSTACLE_COUNT; k++) {
    deepest[k] = sums[k].deepest;
  }
  measure_drift(m, &out);
  measure_resampled(m, q, &out);
  out.validity = kg_metric_validity(out.angular_momentum_change, out.slip_50hz_m);
  kg_measure_smoothness(m, joints, &out);
  kg_measure_balance(m, q, &out);
  return out;
}
