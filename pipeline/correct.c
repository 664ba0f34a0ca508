/* kg_correct: memory of the result, the chosen method, what no contact explains, and the summary. */
#include "pipeline/pipeline.h"

#include "kinegrad/dynamics.h"
#include "kinegrad/filter.h"

#include <string.h>

/* external support is missing where the body needs this share of its weight ... */
static const double UNEXPLAINED_SHARE = 0.5;
/* ... while no point of it is nearer to the scene than this ... */
static const double UNEXPLAINED_HEIGHT_M = 0.10;
/* ... for at least this long */
static const double UNEXPLAINED_TIME_S = 0.08;
static const double COM_SMOOTHING_HZ = 6.0;

kg_track_params kg_track_default_params(void)
{
  return (kg_track_params){
    .smoothing_hz = 6.0,
    .plant_speed = 0.2,
    .plant_height = 0.045,
    .plant_flat = 0.03,
    .rest_height = 0.0023,
    .clearance = 0.0125,
    .clearance_speed = 1.0,
    .ease_time = 0.08,
    .plan_force = 1.0,
    .plan_moment = 2.0,
    .plan_patience = 2.0,
    .catch_speed = 0.3,
    .joint_frequency = 4.0,
    .root_frequency = 3.5,
    .wrench_weight = 2.0,
    .moment_weight = 1.0,
    .joint_damping = 60.0,
    .leg_weight = 0.1,
    .trunk_weight = 10.0,
    .friction_share = 0.85,
  };
}

kg_correct_def kg_correct_default_def(void)
{
  return (kg_correct_def){
    .method = KG_CORRECT_TRACK,
    .track = kg_track_default_params(),
    .gravity = 9.8,
    .contact = kg_contact_default_params(),
    .threads = 1,
  };
}

static bool result_create(kg_correct_result *r, kg_arena *arena, const kg_subject *subject,
                          kg_correct_method method)
{
  const size_t T = (size_t)subject->frame_count;
  r->frame_count = subject->frame_count;
  r->nq = subject->body->nq;
  r->nv = subject->body->nv;
  r->q = KG_ARENA_ARRAY(arena, double, T *(size_t)r->nq);
  r->penetration = KG_ARENA_ARRAY(arena, double, T);
  r->correction_force = KG_ARENA_ARRAY(arena, double, T);
  r->contact_count = KG_ARENA_ARRAY(arena, int, T);
  r->unexplained = KG_ARENA_ARRAY(arena, bool, T);
  if (method == KG_CORRECT_TRACK) {
    r->v = KG_ARENA_ARRAY(arena, double, T *(size_t)r->nv);
    r->tau = KG_ARENA_ARRAY(arena, double, T *(size_t)r->nv);
    r->residual_force = KG_ARENA_ARRAY(arena, kg_vec3, T);
    r->residual_moment = KG_ARENA_ARRAY(arena, kg_vec3, T);
    r->feet = KG_ARENA_ARRAY(arena, kg_foot_force, 2 * T);
    r->other_force = KG_ARENA_ARRAY(arena, kg_vec3, T);
  }
  return !kg_arena_failed(arena);
}

/* ---- what no contact explains ------------------------------------------------------------------ */

static double lowest_point(const kg_subject *subject, kg_dynamics *dynamics, const double *q,
                           kg_vec3 *p, kg_mat3 *R)
{
  const kg_body *body = subject->body;
  double lowest = INFINITY;
  kg_dynamics_pose(dynamics, q, p, R);
  for (int k = 0; k < body->point_count; k++) {
    const kg_body_point *point = &body->points[k];
    const kg_vec3 x = kg_vec3_add(p[point->segment], kg_mat3_mul_vec(R[point->segment], point->p));
    lowest = fmin(lowest, kg_scene_surface(&subject->scene, x));
  }
  return lowest;
}

/* Marks the frames in which the captured centre of mass accelerates as only a support could make it
 * while nothing is near enough to be one. */
static void mark_unexplained(kg_correct_result *r, const kg_subject *subject, double gravity,
                             kg_dynamics *dynamics, kg_vec3 *com, double *work, kg_vec3 *p,
                             kg_mat3 *R)
{
  const int T = r->frame_count;
  const double rate = 1.0 / subject->dt;
  for (int t = 0; t < T; t++) {
    com[t] = kg_dynamics_centroid(dynamics, subject->q + (size_t)t * (size_t)r->nq, NULL).com;
  }
  for (int k = 0; k < 3; k++) {
    kg_filter_lowpass(&com[0].x + k, T, 3, rate, COM_SMOOTHING_HZ, work);
  }
  for (int t = 1; t + 1 < T; t++) {
    const kg_vec3 second =
      kg_vec3_add(kg_vec3_sub(com[t + 1], com[t]), kg_vec3_sub(com[t - 1], com[t]));
    /* upward support per mass; downwards, the capture falls too fast, which is a matter of scale */
    const double needed = rate * rate * second.y + gravity;
    r->unexplained[t] = needed > UNEXPLAINED_SHARE * gravity &&
                        lowest_point(subject, dynamics, subject->q + (size_t)t * (size_t)r->nq, p,
                                     R) > UNEXPLAINED_HEIGHT_M;
  }
  /* runs that are too short are noise */
  const int shortest = (int)ceil(UNEXPLAINED_TIME_S * rate);
  for (int t = 0; t < T;) {
    int end = t;
    while (end < T && r->unexplained[end]) {
      end++;
    }
    if (end - t < shortest) {
      memset(r->unexplained + t, 0, (size_t)(end - t) * sizeof *r->unexplained);
    }
    r->unexplained_count += end - t < shortest ? 0 : end - t;
    t = end > t ? end : t + 1;
  }
}

static kg_status find_unexplained(kg_correct_result *r, const kg_subject *subject, double gravity)
{
  kg_arena scratch;
  kg_arena_init(&scratch, r->allocator);
  kg_dynamics *dynamics = NULL;
  kg_vec3 *com = KG_ARENA_ARRAY(&scratch, kg_vec3, r->frame_count);
  double *work = KG_ARENA_ARRAY(
    &scratch, double, kg_filter_work_size(r->frame_count, 1.0 / subject->dt, COM_SMOOTHING_HZ));
  kg_vec3 *p = KG_ARENA_ARRAY(&scratch, kg_vec3, subject->body->segment_count);
  kg_mat3 *R = KG_ARENA_ARRAY(&scratch, kg_mat3, subject->body->segment_count);
  kg_status status = kg_arena_failed(&scratch) ? KG_ERR_NO_MEMORY : KG_OK;
  if (status == KG_OK) status = kg_dynamics_create(&dynamics, subject->body, r->allocator);
  if (status == KG_OK) {
    mark_unexplained(r, subject, gravity, dynamics, com, work, p, R);
  }
  kg_dynamics_destroy(dynamics);
  kg_arena_release(&scratch);
  return status;
}

/* ---- summary ----------------------------------------------------------------------------------- */

static double height_of_com(const kg_subject *subject, const kg_correct_result *r,
                            kg_dynamics *dynamics)
{
  double sum = 0.0;
  for (int t = 0; t < r->frame_count; t++) {
    const kg_centroid c = kg_dynamics_centroid(dynamics, r->q + (size_t)t * (size_t)r->nq, NULL);
    sum += kg_scene_distance(&subject->scene, c.com).distance;
  }
  return sum / r->frame_count;
}

static void summarize_forces(kg_correct_result *r, double com_height, double weight)
{
  double force2 = 0.0, moment2 = 0.0, correction2 = 0.0, force = 0.0, moment = 0.0,
         correction = 0.0;
  for (int t = 0; t < r->frame_count; t++) {
    const kg_vec3 grf =
      kg_vec3_add(r->other_force[t], kg_vec3_add(r->feet[2 * t].force, r->feet[2 * t + 1].force));
    const double f = kg_vec3_norm(r->residual_force[t]);
    const double n = kg_vec3_norm(r->residual_moment[t]);
    r->peak_grf = fmax(r->peak_grf, kg_vec3_norm(grf));
    force2 += f * f;
    moment2 += n * n;
    correction2 += r->correction_force[t] * r->correction_force[t];
    force = fmax(force, f);
    moment = fmax(moment, n);
    correction = fmax(correction, r->correction_force[t]);
  }
  /* where the ground carries nothing at all, the residual must not look like none */
  const double unit = r->peak_grf > 0.0 ? r->peak_grf : weight;
  if (unit > 0.0) {
    const double per_force = 1.0 / unit, per_moment = 1.0 / (unit * com_height);
    r->residual_force_rms = per_force * sqrt(force2 / r->frame_count);
    r->residual_force_peak = per_force * force;
    r->residual_moment_rms = per_moment * sqrt(moment2 / r->frame_count);
    r->residual_moment_peak = per_moment * moment;
    r->correction_force_ratio = per_force * sqrt(correction2 / r->frame_count);
    r->correction_force_ratio_peak = per_force * correction;
  }
}

static kg_status summarize(kg_correct_result *r, const kg_subject *subject, double gravity)
{
  kg_dynamics *dynamics = NULL;
  const kg_status status = kg_dynamics_create(&dynamics, subject->body, r->allocator);
  if (status == KG_OK) {
    summarize_forces(r, height_of_com(subject, r, dynamics), gravity * subject->body->mass);
  }
  kg_dynamics_destroy(dynamics);
  return status;
}

kg_status kg_correct(kg_correct_result **result, const kg_subject *subject,
                     const kg_correct_def *def, kg_error *error)
{
  KG_ASSERT(result && subject && def);
  *result = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_correct_result *r = KG_ARENA_ARRAY(&arena, kg_correct_result, 1);
  kg_arena *owned = KG_ARENA_ARRAY(&arena, kg_arena, 1);
  kg_status status = KG_ERR_NO_MEMORY;
  if (!kg_arena_failed(&arena)) {
    r->allocator = def->allocator;
    if (result_create(r, &arena, subject, def->method)) {
      kg_correct_def own = *def;
      own.track.rest_height = kg_rest_height(subject, &def->track, &def->contact, def->gravity);
      status = def->method == KG_CORRECT_TRACK ? kg_correct_track(r, subject, &own, &arena)
                                               : kg_correct_sdf(r, subject, def, &arena);
    }
  }
  if (status == KG_OK && !r->interrupted) {
    status = find_unexplained(r, subject, def->gravity);
    if (status == KG_OK && def->method == KG_CORRECT_TRACK) {
      status = summarize(r, subject, def->gravity);
    }
  }
  if (status != KG_OK) {
    kg_arena_release(&arena);
    return kg_fail(error, status, NULL, 0, 0, "%s", kg_status_text(status));
  }
  *owned = arena;
  r->memory = owned;
  *result = r;
  return KG_OK;
}

void kg_correct_result_destroy(kg_correct_result *result)
{
  if (result) {
    kg_arena arena = *(kg_arena *)result->memory; /* the arena holds the result and itself */
    kg_arena_release(&arena);
  }
}

void kg_correct_apply(const kg_correct_result *result, const kg_subject *subject, kg_clip *clip)
{
  KG_ASSERT(clip->frame_count == subject->first_frame + result->frame_count);
  for (int t = 0; t < result->frame_count; t++) {
    const int frame = subject->first_frame + t;
    kg_body_state_to_clip(subject->body, result->q + (size_t)t * (size_t)result->nq, clip, frame,
                          t > 0 ? frame - 1 : -1);
  }
}
