/* Metrics of a capture and an output: both under the capture's body and scene, plus what can only
 * be said of the pair. */
#include "kinegrad/metrics.h"

#include "pipeline/measure.h"

double kg_metric_validity(double angular_momentum_change, double slip_50hz_m)
{
  const double value =
    1.0 - KG_METRIC_VALIDITY_B * angular_momentum_change - KG_METRIC_VALIDITY_C * 1e3 * slip_50hz_m;
  return fmax(0.0, fmin(1.0, value));
}

/* ---- position error -------------------------------------------------------------------------- */

static void measure_error(kg_metrics *m, const kg_vec3 *capture, const kg_vec3 *output)
{
  const int n = m->joint_count, T = m->frame_count;
  double sum = 0.0;
  for (int t = 0; t < T; t++) {
    double frame = 0.0;
    for (int i = 0; i < n; i++) {
      const ptrdiff_t k = (ptrdiff_t)t * n + i;
      const double error = kg_vec3_norm(kg_vec3_sub(output[k], capture[k]));
      frame += error;
      m->mpjpe_joint_m[i] += error / T;
      m->mpjpe_max_m = fmax(m->mpjpe_max_m, error);
    }
    m->mpjpe_frame_m[t] = frame / n;
    sum += frame / n;
  }
  m->mpjpe_m = T > 0 ? sum / T : 0.0;
  for (int k = 0; k < KG_METRIC_NORMALIZED_FRAMES && T > 0; k++) {
    const double x = (double)k * (T - 1) / (KG_METRIC_NORMALIZED_FRAMES - 1);
    const int t = x < T - 1 ? (int)x : T - 1, next = t + 1 < T ? t + 1 : t;
    m->mpjpe_normalized_m[k] =
      m->mpjpe_frame_m[t] + (x - t) * (m->mpjpe_frame_m[next] - m->mpjpe_frame_m[t]);
  }
}

/* ---- acceleration peaks ---------------------------------------------------------------------- */

static double peak_acceleration(const kg_vec3 *joints, int joint, int n, int T, double dt)
{
  double peak = 0.0;
  for (int t = 1; t + 1 < T; t++) {
    const kg_vec3 *p = joints + (ptrdiff_t)t * n + joint;
    const kg_vec3 bend = kg_vec3_add(kg_vec3_sub(p[n], p[0]), kg_vec3_sub(p[-n], p[0]));
    peak = fmax(peak, kg_vec3_norm(bend));
  }
  return peak / (dt * dt);
}

/* A joint at rest in the capture is compared with KG_METRIC_LEAST_ACCELERATION. */
static void measure_peaks(kg_metrics *m, const kg_vec3 *capture, const kg_vec3 *output, double dt)
{
  const int n = m->joint_count, T = m->frame_count;
  m->acceleration_peak_ratio = 0.0;
  for (int i = 0; i < n; i++) {
    const double before =
      fmax(peak_acceleration(capture, i, n, T, dt), KG_METRIC_LEAST_ACCELERATION);
    const double after = fmax(peak_acceleration(output, i, n, T, dt), KG_METRIC_LEAST_ACCELERATION);
    if (after / before > m->acceleration_peak_ratio) {
      m->acceleration_peak_ratio = after / before;
      m->acceleration_peak_joint = i;
    }
  }
}

/* ---- the whole ------------------------------------------------------------------------------- */

/* A metrics object is one arena, which holds its own handle. */
static kg_metrics *allocate(const kg_subject *subject)
{
  kg_arena arena;
  kg_arena_init(&arena, subject->allocator);
  kg_metrics *m = KG_ARENA_ARRAY(&arena, kg_metrics, 1);
  kg_arena *owner = KG_ARENA_ARRAY(&arena, kg_arena, 1);
  const int n = subject->body->segment_count, T = subject->frame_count;
  double *joint = KG_ARENA_ARRAY(&arena, double, n), *frame = KG_ARENA_ARRAY(&arena, double, T);
  double *penetration = KG_ARENA_ARRAY(&arena, double, T);
  double *in_other = KG_ARENA_ARRAY(&arena, double, T);
  double *in_self = KG_ARENA_ARRAY(&arena, double, T);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return NULL;
  }
  *owner = arena;
  *m = (kg_metrics){.frame_count = T,
                    .joint_count = n,
                    .mpjpe_joint_m = joint,
                    .mpjpe_frame_m = frame,
                    .penetration_frame_m = penetration,
                    .other_penetration_frame_m = in_other,
                    .self_penetration_frame_m = in_self,
                    .allocator = subject->allocator,
                    .memory = owner};
  return m;
}

kg_status kg_metrics_create(kg_metrics **metrics, const kg_subject *subject, const double *q_out)
{
  *metrics = NULL;
  kg_metrics *m = allocate(subject);
  if (!m) {
    return KG_ERR_NO_MEMORY;
  }
  kg_arena scratch;
  kg_arena_init(&scratch, subject->allocator);
  const size_t size = (size_t)m->frame_count * (size_t)m->joint_count;
  kg_vec3 *capture = KG_ARENA_ARRAY(&scratch, kg_vec3, size);
  kg_vec3 *output = KG_ARENA_ARRAY(&scratch, kg_vec3, size);
  kg_measure measure;
  const bool ready = kg_measure_create(&measure, subject, &scratch);
  if (ready) {
    double *const depths[KG_OBSTACLE_COUNT] = {m->penetration_frame_m, m->other_penetration_frame_m,
                                               m->self_penetration_frame_m};
    m->capture = kg_measure_motion(&measure, subject->q, capture, NULL, m->capture_deepest);
    m->output = kg_measure_motion(&measure, q_out, output, depths, m->output_deepest);
    measure_error(m, capture, output);
    measure_peaks(m, capture, output, subject->dt);
  }
  kg_measure_release(&measure);
  kg_arena_release(&scratch);
  if (!ready) {
    kg_metrics_destroy(m);
    return KG_ERR_NO_MEMORY;
  }
  *metrics = m;
  return KG_OK;
}

void kg_metrics_destroy(kg_metrics *metrics)
{
  if (metrics) {
    kg_arena arena = *(kg_arena *)metrics->memory; /* the arena holds itself */
    kg_arena_release(&arena);
  }
}
