/* The metrics as a table and as JSON. The rows stand in one list. */
#include "cli/scores.h"

#include <math.h>

#define ROW(key, in_summary, text)                                                                 \
  {                                                                                                \
#key, text, offsetof(kg_motion_metrics, key), in_summary                                       \
  }

/* clang-format off */
const cli_score cli_scores[] = {
  ROW(penetration_events,            true, "share of frames deeper than 1 mm"),
  ROW(penetration_max_m,             true, "deepest point below the surface, m"),
  ROW(penetration_mean_m,            false, "mean over the frames inside, m"),
  ROW(slip_m,                        true, "sliding of grounded sole nodes per frame, m"),
  ROW(slip_m_per_s,                  true, "the same per second, m/s"),
  ROW(slip_50hz_m,                   false, "the same at 50 Hz, m"),
  ROW(angular_momentum_change,       true, "kg m^2/s per 0.02 s"),
  ROW(angular_momentum_drift,        false, "kg m^2/s against the first frame"),
  ROW(angular_momentum_drift_flight, false, "kg m^2/s in flight, against take-off"),
  ROW(validity,                      true, "0 to 1"),
  ROW(momentum_balance,              true, "moment that contact cannot explain, N m"),
  ROW(force_balance,                 false, "force that contact cannot explain, N"),
  ROW(jerk_rms,                      false, "m/s^3"),
  ROW(spectral_arc_length,           false, "smoothness, nearer to 0 is smoother"),
  ROW(foot_skate_ratio,              false, "share of grounded node-frames above 0.1 m/s"),
  ROW(other_penetration_events,      false, "share of frames deeper than 1 mm in the other athlete"),
  ROW(other_penetration_max_m,       false, "deepest point in the other athlete, m"),
  ROW(other_penetration_mean_m,      false, "mean over the frames inside, m"),
  ROW(other_frames,                  false, "frames with a point inside the other athlete"),
  ROW(self_penetration_events,       false, "share of frames deeper than 1 mm in the body itself"),
  ROW(self_penetration_max_m,        false, "deepest point in a segment of the same body, m"),
  ROW(self_penetration_mean_m,       false, "mean over the frames inside, m"),
};
/* clang-format on */
const int cli_score_count = (int)KG_COUNT_OF(cli_scores);

double cli_score_value(const kg_motion_metrics *metrics, int score)
{
  return *(const double *)(const void *)((const char *)metrics + cli_scores[score].offset);
}

static void print_cell(FILE *out, double value)
{
  if (isfinite(value)) {
    fprintf(out, " %11.5g", value);
  } else {
    fprintf(out, " %11s", "-");
  }
}

void cli_print_score(FILE *out, const char *key, double capture, double output, const char *text)
{
  fprintf(out, "  %-30s", key);
  print_cell(out, capture);
  print_cell(out, output);
  fprintf(out, "  %s\n", text);
}

/* ---- the deepest point ------------------------------------------------------------------------- */

static const char *const obstacle_keys[KG_OBSTACLE_COUNT] = {"penetration", "other_penetration",
                                                             "self_penetration"};

/* Names of the segments: whose point it is, and what is entered (NULL: the scene). */
static void name_segments(const kg_subject *subject, kg_obstacle obstacle,
                          const kg_deepest *deepest, const char *names[2])
{
  const kg_body *entered = obstacle == KG_OBSTACLE_OTHER ? subject->other->body : subject->body;
  names[0] = subject->body->segments[deepest->segment].name;
  names[1] = deepest->entered < 0 ? NULL : entered->segments[deepest->entered].name;
}

cli_deepest cli_deepest_text(const kg_subject *subject, const kg_metrics *metrics,
                             kg_obstacle obstacle)
{
  const kg_deepest *deepest = &metrics->output_deepest[obstacle];
  const char *names[2];
  cli_deepest out;
  name_segments(subject, obstacle, deepest, names);
  snprintf(out.text, sizeof out.text, "%.1f mm in frame %d (%s%s%s)", 1e3 * deepest->depth,
           deepest->frame + subject->first_frame, names[0], names[1] ? " in " : "",
           names[1] ? names[1] : "");
  return out;
}

static void print_deepest(FILE *out, const kg_subject *subject, const kg_metrics *metrics)
{
  for (int k = 0; k < KG_OBSTACLE_COUNT; k++) {
    if (!(metrics->output_deepest[k].depth > KG_METRIC_EVENT_DEPTH_M)) continue;
    fprintf(out, "  output's %s_max_m: %s\n", obstacle_keys[k],
            cli_deepest_text(subject, metrics, k).text);
  }
}

/* null where nothing is inside */
static void set_deepest(json_t *object, const kg_subject *subject, const kg_deepest *deepest)
{
  for (int k = 0; k < KG_OBSTACLE_COUNT; k++) {
    const bool is_inside = deepest[k].frame >= 0;
    json_t *segments = is_inside ? json_array() : json_null();
    const char *names[2] = {NULL, NULL};
    if (is_inside) name_segments(subject, k, &deepest[k], names);
    for (int i = 0; i < 2 && names[i]; i++) {
      json_array_append_new(segments, cli_json_text(names[i]));
    }
    char key[64];
    snprintf(key, sizeof key, "%s_frame", obstacle_keys[k]);
    json_object_set_new(
      object, key, is_inside ? json_integer(deepest[k].frame + subject->first_frame) : json_null());
    snprintf(key, sizeof key, "%s_segments", obstacle_keys[k]);
    json_object_set_new(object, key, segments);
  }
}

/* ---- tables and reports ------------------------------------------------------------------------ */

void cli_print_scores(FILE *out, const kg_subject *subject, const kg_metrics *metrics)
{
  fprintf(out, "  %-30s %11s %11s\n", "", "capture", "output");
  cli_print_score(out, "mpjpe_m", NAN, metrics->mpjpe_m, "mean distance of joints, m");
  cli_print_score(out, "mpjpe_max_m", NAN, metrics->mpjpe_max_m, "the worst, m");
  cli_print_score(out, "acceleration_peak_ratio", 1.0, metrics->acceleration_peak_ratio,
                  "worst joint, output over capture");
  for (int i = 0; i < cli_score_count; i++) {
    const double capture = cli_score_value(&metrics->capture, i);
    const double output = cli_score_value(&metrics->output, i);
    if (isnan(capture) && isnan(output)) continue; /* of what is not there */
    cli_print_score(out, cli_scores[i].key, capture, output, cli_scores[i].text);
  }
  print_deepest(out, subject, metrics);
}

static void set_scores(json_t *object, const kg_subject *subject, const kg_motion_metrics *metrics,
                       const kg_deepest *deepest)
{
  for (int i = 0; i < cli_score_count; i++) {
    cli_json_set_number(object, cli_scores[i].key, cli_score_value(metrics, i));
  }
  set_deepest(object, subject, deepest);
}

void cli_report_scores(json_t *root, const kg_subject *subject, const kg_metrics *metrics)
{
  cli_json_set_number(root, "mpjpe_m", metrics->mpjpe_m);
  cli_json_set_number(root, "mpjpe_max_m", metrics->mpjpe_max_m);
  cli_json_set_number(root, "acceleration_peak_ratio", metrics->acceleration_peak_ratio);
  set_scores(root, subject, &metrics->output, metrics->output_deepest);
  json_t *capture = json_object();
  set_scores(capture, subject, &metrics->capture, metrics->capture_deepest);
  json_object_set_new(root, "capture", capture);
  json_object_set_new(root, "mpjpe_normalized_m",
                      cli_json_numbers(metrics->mpjpe_normalized_m, KG_METRIC_NORMALIZED_FRAMES));
}

json_t *cli_frames_object(const kg_subject *subject, const kg_metrics *metrics)
{
  json_t *object = json_object(), *numbers = json_array(), *times = json_array();
  for (int t = 0; t < metrics->frame_count; t++) {
    const int frame = t + subject->first_frame;
    json_array_append_new(numbers, json_integer(frame));
    json_array_append_new(times, cli_json_number(frame * subject->dt));
  }
  json_object_set_new(object, "frame", numbers);
  json_object_set_new(object, "time_s", times);
  json_object_set_new(object, "mpjpe_m",
                      cli_json_numbers(metrics->mpjpe_frame_m, metrics->frame_count));
  json_object_set_new(object, "penetration_m",
                      cli_json_numbers(metrics->penetration_frame_m, metrics->frame_count));
  if (subject->other) {
    json_object_set_new(object, "other_penetration_m",
                        cli_json_numbers(metrics->other_penetration_frame_m, metrics->frame_count));
  }
  if (subject->self) {
    json_object_set_new(object, "self_penetration_m",
                        cli_json_numbers(metrics->self_penetration_frame_m, metrics->frame_count));
  }
  return object;
}

json_t *cli_joints_object(const kg_subject *subject, const kg_metrics *metrics)
{
  json_t *object = json_object(), *names = json_array();
  for (int i = 0; i < metrics->joint_count; i++) {
    json_array_append_new(names, cli_json_text(subject->body->segments[i].name));
  }
  json_object_set_new(object, "name", names);
  json_object_set_new(object, "mpjpe_m",
                      cli_json_numbers(metrics->mpjpe_joint_m, metrics->joint_count));
  return object;
}

json_t *cli_constants_object(void)
{
  json_t *object = json_object();
  cli_json_set_number(object, "event_depth_m", KG_METRIC_EVENT_DEPTH_M);
  cli_json_set_number(object, "touch_depth_m", KG_METRIC_TOUCH_DEPTH_M);
  cli_json_set_number(object, "slip_height_m", KG_METRIC_SLIP_HEIGHT_M);
  cli_json_set_number(object, "momentum_dt_s", KG_METRIC_MOMENTUM_DT_S);
  cli_json_set_number(object, "smoothing_hz", KG_METRIC_SMOOTHING_HZ);
  cli_json_set_number(object, "balance_height_m", KG_METRIC_BALANCE_HEIGHT_M);
  cli_json_set_number(object, "balance_friction", KG_METRIC_FRICTION);
  cli_json_set_number(object, "balance_gravity_m_per_s2", KG_METRIC_GRAVITY);
  cli_json_set_number(object, "skate_speed_m_per_s", KG_METRIC_SKATE_SPEED);
  cli_json_set_number(object, "least_acceleration_m_per_s2", KG_METRIC_LEAST_ACCELERATION);
  cli_json_set_number(object, "validity_a", 0.0);
  cli_json_set_number(object, "validity_b_per_kg_m2_per_s", KG_METRIC_VALIDITY_B);
  cli_json_set_number(object, "validity_c_per_mm", KG_METRIC_VALIDITY_C);
  return object;
}
