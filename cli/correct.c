/* kinegrad correct: a clip in, the corrected clip, its forces and a report out.
 *
 * The metrics are those of the file that was written: it is read back before anything is published,
 * so that what is reported is what the user gets. */
#include <math.h>
#include <string.h>
#include <strings.h>

#include "cli/around.h"
#include "cli/commands.h"
#include "cli/forces.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/progress.h"
#include "cli/ranges.h"
#include "cli/reading.h"
#include "cli/scores.h"
#include "kinegrad/arena.h"
#include "kinegrad/correct.h"

typedef struct correct_values {
  cli_reading reading;
  cli_talk talk;
  const char *output;
  int method; /* kg_correct_method */
  double dt;  /* s; NAN: not given */
  double gravity;
  cli_around_values around;
  const char *forces;
  const char *json;
  int threads;
} correct_values;

/* Everything one run holds; released in one place. */
typedef struct correction {
  const correct_values *values;
  kg_arena arena;
  cli_output *bvh, *csv, *json;
  cli_around around;
  kg_clip *clip;
  kg_subject *subject;
  kg_correct_def def;
  kg_correct_result *result;
  kg_metrics *metrics;
} correction;

static const char *method_name(const correct_values *values)
{
  return values->method == KG_CORRECT_SDF ? "sdf" : "track";
}

static bool ends_in_bvh(const char *path)
{
  const char *dot = strrchr(path, '.');
  return dot && strcasecmp(dot, ".bvh") == 0;
}

/* Options that would have no effect, or contradict each other. */
static int check_values(const correct_values *values)
{
  if (!values->output) {
    cli_message("'correct' needs a file to write: -o <FILE>.bvh");
    return CLI_USAGE;
  }
  if (!ends_in_bvh(values->output)) {
    cli_message("--output: '%s' does not end in .bvh, the format that is written", values->output);
    return CLI_USAGE;
  }
  if (values->forces && strcmp(values->forces, "-") == 0) {
    cli_message("--forces: expected a file name, stdout holds the table");
    return CLI_USAGE;
  }
  const bool is_sdf = values->method == KG_CORRECT_SDF;
  const char *useless = !is_sdf                   ? NULL
                        : values->forces          ? "forces"
                        : !isnan(values->dt)      ? "dt"
                        : !isnan(values->gravity) ? "gravity"
                                                  : NULL;
  if (useless) {
    cli_message("--%s has no meaning with --method sdf, which moves poses and knows no forces; "
                "expected --method track",
                useless);
    return CLI_USAGE;
  }
  return CLI_GOOD;
}

/* The first `free` of the inputs may be replaced by --output, nothing else by anything. */
static int check_inputs(const correct_values *values, const char *const *inputs, int count,
                        int free)
{
  const bool overwrites = cli_is_input("--json", values->json, inputs, count) ||
                          cli_is_input("--forces", values->forces, inputs, count) ||
                          cli_is_input("--output", values->output, inputs + free, count - free);
  return overwrites ? CLI_USAGE : CLI_GOOD;
}

/* The clip itself may be replaced by its correction; nothing else that is read may be. */
static int check_overwriting(const correct_values *values, const char *clip)
{
  enum { CLIP, ASF, MAP, AROUND };
  const char *inputs[AROUND + CLI_MAX_AROUND_PATHS] = {clip, values->reading.asf,
                                                       values->reading.map};
  return check_inputs(values, inputs, AROUND + cli_around_paths(&values->around, inputs + AROUND),
                      1);
}

/* nor what was found by name, or in a description of a scene */
static int check_overwriting_found(const correction *c)
{
  enum { SKELETON, AROUND };
  const char *inputs[AROUND + CLI_MAX_AROUND_FOUND] = {c->clip->source.skeleton_path};
  return check_inputs(c->values, inputs, AROUND + cli_around_found(&c->around, inputs + AROUND), 0);
}

static int open_outputs(correction *c)
{
  const correct_values *values = c->values;
  if (!(c->bvh = cli_outputs_open(values->output)) ||
      (values->forces && !(c->csv = cli_outputs_open(values->forces))) ||
      !cli_json_open(&c->json, values->json)) {
    return CLI_OUTPUT;
  }
  return CLI_GOOD;
}

static int interrupted(void)
{
  cli_message("interrupted; nothing was written");
  return CLI_INTERRUPTED;
}

static int read_inputs(correction *c, const char *path)
{
  const correct_values *values = c->values;
  int code = cli_read_clip(&c->clip, path, &values->reading, values->talk.quiet);
  if (code == CLI_GOOD) {
    code = cli_around_read(&c->around, &values->around, &values->reading, values->talk.quiet);
  }
  if (code == CLI_GOOD) {
    code = check_overwriting_found(c);
  }
  if (code == CLI_GOOD) {
    code =
      cli_around_subject(&c->subject, &c->around, c->clip, &values->reading, values->talk.quiet);
  }
  return code == CLI_GOOD && cli_interrupted() ? interrupted() : code;
}

static int compute(correction *c)
{
  const correct_values *values = c->values;
  cli_progress progress = cli_progress_start((cli_progress_style)values->talk.progress,
                                             values->talk.quiet, c->subject->frame_count);
  c->def = kg_correct_default_def();
  c->def.method = (kg_correct_method)values->method;
  c->def.dt = isnan(values->dt) ? c->def.dt : values->dt;
  c->def.gravity = isnan(values->gravity) ? c->def.gravity : values->gravity;
  c->def.threads = values->threads;
  c->def.progress = cli_progress_update;
  c->def.progress_user = &progress;

  kg_error error = {0};
  const kg_status status = kg_correct(&c->result, c->subject, &c->def, &error);
  cli_progress_clear();
  if (status != KG_OK) {
    return error.text[0] ? cli_failed(&error) : cli_failed_status(status, c->clip->source.path);
  }
  return c->result->interrupted || cli_interrupted() ? interrupted() : CLI_GOOD;
}

/* Metrics of the file that was written, not of the result in memory. */
static kg_status measure_written(correction *c, kg_error *error)
{
  kg_clip *written = NULL;
  kg_status status = cli_read_output(&written, c->bvh->temporary, c->clip, error);
  if (status != KG_OK) {
    return status;
  }
  const size_t T = (size_t)c->subject->frame_count, nq = (size_t)c->subject->body->nq;
  double *q = KG_ARENA_ARRAY(&c->arena, double, T *nq);
  status = q ? kg_subject_states(c->subject, written, q, error) : KG_ERR_NO_MEMORY;
  kg_clip_destroy(written);
  return status == KG_OK ? kg_metrics_create(&c->metrics, c->subject, q) : status;
}

static int write_and_measure(correction *c)
{
  kg_correct_apply(c->result, c->subject, c->clip);
  kg_error error = {0};
  if (kg_clip_write_bvh(c->clip, c->bvh->temporary, &error) != KG_OK) {
    snprintf(error.path, sizeof error.path, "%s", c->values->output);
    return cli_failed(&error);
  }
  const kg_status status = measure_written(c, &error);
  if (status != KG_OK) {
    cli_message("%s: not written: the result cannot be read back (%s)", c->values->output,
                error.text[0] ? error.text : kg_status_text(status));
    return CLI_OUTPUT;
  }
  return CLI_GOOD;
}

/* ---- report ---------------------------------------------------------------------------------- */

static json_t *vec3_list(const kg_vec3 *a, int count, int stride)
{
  json_t *array = json_array();
  for (int i = 0; i < count; i++) {
    json_array_append_new(array, cli_json_vec3(a[i * stride]));
  }
  return array;
}

static json_t *foot_list(const kg_foot_force *feet, int side, int count)
{
  json_t *array = json_array();
  for (int t = 0; t < count; t++) {
    json_array_append_new(array, cli_json_vec3(feet[2 * t + side].force));
  }
  return array;
}

static json_t *int_list(const int *values, int count, int offset)
{
  json_t *array = json_array();
  for (int i = 0; values && i < count; i++) {
    json_array_append_new(array, json_integer(values[i] + offset));
  }
  return array;
}

static json_t *frames_object(const correction *c)
{
  const kg_correct_result *r = c->result;
  const int T = r->frame_count;
  json_t *frames = cli_frames_object(c->subject, c->metrics);
  json_object_set_new(frames, "contact_count", int_list(r->contact_count, T, 0));
  json_object_set_new(frames, "correction_force_N", cli_json_numbers(r->correction_force, T));
  if (c->def.method == KG_CORRECT_TRACK) {
    json_object_set_new(frames, "residual_force_N", vec3_list(r->residual_force, T, 1));
    json_object_set_new(frames, "residual_moment_Nm", vec3_list(r->residual_moment, T, 1));
    json_object_set_new(frames, "left_grf_N", foot_list(r->feet, 0, T));
    json_object_set_new(frames, "right_grf_N", foot_list(r->feet, 1, T));
    json_object_set_new(frames, "other_force_N", vec3_list(r->other_force, T, 1));
  }
  return frames;
}

/* Largest torque of every joint over the clip, N m: position error alone hides cheats. */
static json_t *torque_peaks(const kg_correct_result *r, int segment_count)
{
  json_t *array = json_array();
  for (int i = 0; i < segment_count; i++) {
    double peak = 0.0;
    for (int t = 0; t < r->frame_count && i > 0; t++) {
      const double *tau = r->tau + (size_t)t * (size_t)r->nv + 3 + 3 * i;
      peak = fmax(peak, sqrt(tau[0] * tau[0] + tau[1] * tau[1] + tau[2] * tau[2]));
    }
    json_array_append_new(array, i > 0 ? cli_json_number(peak) : json_null());
  }
  return array;
}

static json_t *joints_object(const correction *c)
{
  json_t *joints = cli_joints_object(c->subject, c->metrics);
  if (c->def.method == KG_CORRECT_TRACK) {
    json_object_set_new(joints, "torque_peak_Nm",
                        torque_peaks(c->result, c->subject->body->segment_count));
  }
  return joints;
}

static json_t *constants_object(const correction *c)
{
  const kg_contact_params *contact = &c->def.contact;
  json_t *object = cli_constants_object();
  cli_json_set_number(object, "gravity_m_per_s2", c->def.gravity);
  cli_json_set_number(object, "contact_layer_m", contact->layer);
  cli_json_set_number(object, "contact_force_N", contact->force);
  cli_json_set_number(object, "contact_floor_share", contact->floor_share);
  cli_json_set_number(object, "contact_damping_s_per_m", contact->damping);
  cli_json_set_number(object, "contact_friction", contact->friction);
  cli_json_set_number(object, "contact_stick_m_per_s", contact->stick);
  return object;
}

static json_t *newton_object(const correction *c)
{
  const kg_correct_result *r = c->result;
  json_t *object = json_object();
  cli_json_set_integer(object, "steps", r->steps);
  cli_json_set_integer(object, "steps_converged", r->steps_converged);
  cli_json_set_integer(object, "steps_substepped", r->steps_substepped);
  cli_json_set_integer(object, "iterations", r->newton_iterations);
  cli_json_set_number(object, "residual_max_kg_half_m_per_s", r->newton_residual_max);
  json_object_set_new(object, "substepped_frames",
                      int_list(r->substepped_frames, r->substepped_count, c->subject->first_frame));
  return object;
}

static const bool *flag_restarts(const correction *c, kg_arena *arena)
{
  const kg_correct_result *r = c->result;
  bool *flags = KG_ARENA_ARRAY(arena, bool, r->frame_count);
  for (int i = 0; flags && i < r->restart_count; i++) {
    flags[r->restart_frames[i]] = true;
  }
  return flags;
}

static json_t *timing_object(const kg_correct_result *r)
{
  json_t *object = json_object();
  cli_json_set_number(object, "encoder_ms_per_frame", r->ms_encoder);
  cli_json_set_number(object, "policy_ms_per_frame", r->ms_policy);
  cli_json_set_number(object, "step_ms_per_frame", r->ms_step);
  cli_json_set_number(object, "sdf_ms_per_frame", r->ms_sdf);
  return object;
}

/* N; the frames that repeat a step count as often as in residual_force_ratio */
static double residual_force_rms(const kg_correct_result *r)
{
  double sum = 0.0;
  for (int t = 0; t < r->frame_count; t++) {
    sum += kg_vec3_dot(r->residual_force[t], r->residual_force[t]);
  }
  return sqrt(sum / r->frame_count);
}

/* null, not zero, for what a kinematic method has none of */
static void set_residuals(json_t *root, const correction *c)
{
  const kg_correct_result *r = c->result;
  const bool has = c->def.method == KG_CORRECT_TRACK;
  const double rms = has ? residual_force_rms(r) : NAN;
  cli_json_set_number(root, "residual_force_rms_N", rms);
  cli_json_set_number(root, "residual_force_over_weight",
                      rms / (c->subject->body->mass * c->def.gravity));
  cli_json_set_number(root, "residual_force_ratio", has ? r->residual_force_rms : NAN);
  cli_json_set_number(root, "residual_force_ratio_peak", has ? r->residual_force_peak : NAN);
  cli_json_set_number(root, "residual_moment_ratio", has ? r->residual_moment_rms : NAN);
  cli_json_set_number(root, "residual_moment_ratio_peak", has ? r->residual_moment_peak : NAN);
  cli_json_set_number(root, "peak_grf_N", has ? r->peak_grf : NAN);
  cli_json_set_number(root, "correction_force_ratio", r->correction_force_ratio);
  cli_json_set_number(root, "correction_force_ratio_peak", r->correction_force_ratio_peak);
}

static json_t *report(const correction *c)
{
  const kg_correct_result *r = c->result;
  json_t *root = cli_json_report("correct");
  cli_json_set_text(root, "method", method_name(c->values));
  cli_json_set_text(root, "output", c->values->output);
  cli_report_scores(root, c->subject, c->metrics);
  set_residuals(root, c);
  cli_json_set_integer(root, "unexplained_count", r->unexplained_count);
  json_object_set_new(root, "unexplained_frames",
                      cli_json_ranges(r->unexplained, r->frame_count, c->subject->first_frame));
  json_object_set_new(root, "restart_frames",
                      int_list(r->restart_frames, r->restart_count, c->subject->first_frame));
  cli_json_set_number(root, "ms_per_frame", r->ms_per_frame);
  json_object_set_new(root, "timing", timing_object(r));
  json_object_set_new(root, "newton", newton_object(c));
  cli_json_set_integer(root, "sdf_iterations", r->sdf_iterations);
  cli_report_source(root, c->clip, c->subject);
  cli_report_around(root, &c->around, c->subject);
  json_object_set_new(root, "constants", constants_object(c));
  json_object_set_new(root, "joints", joints_object(c));
  json_object_set_new(root, "frames", frames_object(c));
  return root;
}

static void print_table(FILE *out, const correction *c)
{
  const kg_correct_result *r = c->result;
  cli_print_source(out, c->clip, c->subject);
  cli_print_around(out, &c->around, c->subject);
  fprintf(out, "\n%s, --method %s\n", c->values->output, method_name(c->values));
  cli_print_scores(out, c->subject, c->metrics);
  char text[96];
  if (c->def.method == KG_CORRECT_TRACK) {
    snprintf(text, sizeof text, "RMS over peak GRF; peak %.3g", r->residual_force_peak);
    cli_print_score(out, "residual_force_ratio", NAN, r->residual_force_rms, text);
    snprintf(text, sizeof text, "RMS over peak GRF x height; peak %.3g", r->residual_moment_peak);
    cli_print_score(out, "residual_moment_ratio", NAN, r->residual_moment_rms, text);
    snprintf(text, sizeof text, "of %ld steps converged; %ld in sub-steps", r->steps,
             r->steps_substepped);
    cli_print_score(out, "newton steps", NAN, (double)r->steps_converged, text);
  }
  snprintf(text, sizeof text, "RMS over peak GRF; peak %.3g", r->correction_force_ratio_peak);
  cli_print_score(out, "correction_force_ratio", NAN, r->correction_force_ratio, text);
  snprintf(text, sizeof text, "step %.3g, sdf %.3g", r->ms_step, r->ms_sdf);
  cli_print_score(out, "ms_per_frame", NAN, r->ms_per_frame, text);
}

static int write_results(correction *c, FILE *out)
{
  bool is_written = true;
  if (c->csv) {
    FILE *stream = cli_output_stream(c->csv);
    if (stream) {
      cli_write_forces(stream, c->subject, c->result);
    }
    is_written = stream && cli_output_close(c->csv, stream);
  }
  if (is_written && c->values->json) {
    json_t *root = report(c);
    is_written = cli_json_write(root, c->json, out);
    json_decref(root);
  }
  if (is_written && cli_interrupted()) {
    return interrupted();
  }
  if (!is_written) {
    return CLI_OUTPUT;
  }
  if (!cli_json_is_stdout(c->values->json)) {
    print_table(out, c);
  }
  return CLI_GOOD;
}

typedef struct range_text {
  char text[256];
} range_text;

/* "frame 12", "frames 12-40, 55" */
static range_text describe(const correction *c, const bool *flags)
{
  range_text ranges = {""};
  FILE *text = flags ? fmemopen(ranges.text, sizeof ranges.text, "w") : NULL;
  if (text) {
    int count = 0;
    for (int t = 0; t < c->result->frame_count; t++) {
      count += flags[t];
    }
    fputs(count == 1 ? "frame " : "frames ", text);
    cli_print_ranges(text, flags, c->result->frame_count, c->subject->first_frame, 12);
    fclose(text);
  }
  return ranges;
}

/* A correction moves a body by centimetres. Beyond these it is another motion. */
static const double far_mean = 0.3, far_frame = 0.5; /* m */

static int judge_distance(correction *c)
{
  const int T = c->result->frame_count;
  bool *is_far = KG_ARENA_ARRAY(&c->arena, bool, T);
  int count = 0;
  for (int t = 0; t < T && is_far; t++) {
    is_far[t] = c->metrics->mpjpe_frame_m[t] > far_frame;
    count += is_far[t];
  }
  if (count > 0) {
    cli_message("%s: the output leaves the capture by more than %g m in %s; %s was written",
                c->clip->source.path, far_frame, describe(c, is_far).text, c->values->output);
  } else if (c->metrics->mpjpe_m > far_mean) {
    cli_message("%s: the output is %.2f m from the capture in the mean, expected at most %g m; %s "
                "was written",
                c->clip->source.path, c->metrics->mpjpe_m, far_mean, c->values->output);
  } else {
    return CLI_GOOD;
  }
  return CLI_ANSWER_IS_NO;
}

/* What is still inside of something by more than a penetration event. */
static int judge_depth(correction *c)
{
  static const char *const names[KG_OBSTACLE_COUNT] = {"the scene", "the other athlete", "itself"};
  const kg_metrics *m = c->metrics;
  const double *const depths[KG_OBSTACLE_COUNT] = {
    m->penetration_frame_m, m->other_penetration_frame_m, m->self_penetration_frame_m};
  const int T = c->result->frame_count;
  bool *is_deep = KG_ARENA_ARRAY(&c->arena, bool, T);
  int code = CLI_GOOD;
  for (int k = 0; k < KG_OBSTACLE_COUNT; k++) {
    if (!(m->output_deepest[k].depth > KG_METRIC_EVENT_DEPTH_M)) continue;
    for (int t = 0; t < T && is_deep; t++) {
      is_deep[t] = depths[k][t] > KG_METRIC_EVENT_DEPTH_M;
    }
    cli_message("%s: the output is inside %s by more than %g mm in %s, at most by %s; %s was "
                "written",
                c->clip->source.path, names[k], 1e3 * KG_METRIC_EVENT_DEPTH_M,
                describe(c, is_deep).text, cli_deepest_text(c->subject, m, k).text,
                c->values->output);
    code = CLI_ANSWER_IS_NO;
  }
  return code;
}

/* Done, but is the answer yes? Messages are errors: --quiet does not hide them. */
static int judge(correction *c)
{
  const kg_correct_result *r = c->result;
  int code = judge_distance(c);
  if (judge_depth(c) != CLI_GOOD) code = CLI_ANSWER_IS_NO;
  if (r->unexplained_count > 0) {
    cli_message("%s: external support missing in %s: no contact explains the motion there, "
                "so %s was written but is not physical in these frames",
                c->clip->source.path, describe(c, r->unexplained).text, c->values->output);
    code = CLI_ANSWER_IS_NO;
  }
  if (r->restart_count > 0) {
    cli_message("%s: the simulation was lost and set back to the reference in %s; %s was "
                "written",
                c->clip->source.path, describe(c, flag_restarts(c, &c->arena)).text,
                c->values->output);
    code = CLI_ANSWER_IS_NO;
  }
  if (r->steps_converged < r->steps) {
    cli_message("%s: Newton's method missed its tolerance in %ld of %ld steps (worst residual "
                "%.3g kg^1/2 m/s); %s was written",
                c->clip->source.path, r->steps - r->steps_converged, r->steps,
                r->newton_residual_max, c->values->output);
    code = CLI_ANSWER_IS_NO;
  }
  return code;
}

static void release(correction *c)
{
  kg_metrics_destroy(c->metrics);
  kg_correct_result_destroy(c->result);
  kg_subject_destroy(c->subject);
  kg_clip_destroy(c->clip);
  cli_around_release(&c->around);
  kg_arena_release(&c->arena);
}

static int run(const void *values, const cli_operands *operands, FILE *out)
{
  correction c = {.values = values};
  kg_arena_init(&c.arena, NULL);
  int code = check_values(values);
  if (code == CLI_GOOD) {
    code = check_overwriting(values, operands->at[0]);
  }
  if (code == CLI_GOOD) {
    code = open_outputs(&c);
  }
  if (code == CLI_GOOD) {
    code = read_inputs(&c, operands->at[0]);
  }
  if (code == CLI_GOOD) {
    code = compute(&c);
  }
  if (code == CLI_GOOD) {
    code = write_and_measure(&c);
  }
  if (code == CLI_GOOD) {
    code = write_results(&c, out);
  }
  if (code == CLI_GOOD) {
    code = judge(&c);
  }
  release(&c);
  return code;
}

/* ---- options --------------------------------------------------------------------------------- */

static const cli_option result_options[] = {
  {.letter = 'o',
   .name = "output",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the corrected clip, BVH (required)",
   .details = "Same joints, channels, frame count and frame time as the capture; an AMC clip comes "
              "out as BVH. May be the capture itself: a file is replaced only when the new one is "
              "complete.",
   .offset = offsetof(correct_values, output)},
  {.name = "json",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the report as one JSON object; - for stdout, in place of the table",
   .details = "SI units in the names of the keys: 'kinegrad help json'.",
   .offset = offsetof(correct_values, json)},
  {.name = "forces",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "CSV: root residual, ground reaction per foot, joint torques",
   .details = "One line per frame, units in the header. Forces in world axes, torques in the axes "
              "of the joint's segment. Only with --method track.",
   .offset = offsetof(correct_values, forces)},
};

static const cli_option method_options[] = {
  {.name = "method",
   .kind = CLI_CHOICE,
   .value_name = "METHOD",
   .choices = "sdf|track",
   .default_text = "track",
   .summary = "poses only (sdf), or the body simulated (track)",
   .details = "sdf: the smallest smooth change of the poses that takes every point out of the "
              "ground. track: joint torques from inverse dynamics and feedback drive the body "
              "through implicit steps with contact; the root may be helped by a wrench, which is "
              "reported as the residual.",
   .offset = offsetof(correct_values, method)},
  {.name = "dt",
   .kind = CLI_NUMBER,
   .value_name = "S",
   .unit = "s",
   .default_text = "the frame time, or an even share of it of at most 0.01 s",
   .summary = "length of a simulation step",
   .minimum = 1e-5,
   .maximum = 0.1,
   .offset = offsetof(correct_values, dt)},
  {.name = "gravity",
   .kind = CLI_NUMBER,
   .value_name = "G",
   .unit = "m/s^2",
   .default_text = "9.8",
   .summary = "acceleration of gravity, downwards",
   .minimum = 0.0,
   .maximum = 100.0,
   .offset = offsetof(correct_values, gravity)},
  {.name = "threads",
   .kind = CLI_INT,
   .value_name = "N",
   .unit = "threads",
   .default_text = "1",
   .summary = "changes the time, never the result",
   .minimum = 1,
   .maximum = 256,
   .offset = offsetof(correct_values, threads)},
};

static const cli_group groups[] = {
  {"Results", result_options, KG_COUNT_OF(result_options), 0},
  {"Method", method_options, KG_COUNT_OF(method_options), 0},
  {"What is in the way", cli_around_options, CLI_AROUND_OPTION_COUNT,
   offsetof(correct_values, around)},
  {"Reading the clip", cli_reading_options, CLI_READING_OPTION_COUNT,
   offsetof(correct_values, reading)},
  {"General", cli_talk_options, CLI_TALK_OPTION_COUNT, offsetof(correct_values, talk)},
};

static const correct_values defaults = {
  .reading = CLI_READING_DEFAULTS,
  .method = KG_CORRECT_TRACK,
  .dt = NAN,
  .gravity = NAN,
  .around = CLI_AROUND_DEFAULTS,
  .threads = 1,
};

const cli_command cli_command_correct = {
  .name = "correct",
  .summary = "make a captured clip obey physics",
  .usage = "CLIP -o OUT.bvh [options]",
  .details =
    "Reads a clip (BVH, or AMC with its ASF skeleton), corrects it and writes it as BVH. Prints "
    "the metrics of the capture beside those of the file that was written.\n"
    "Exit code 1: the file was written, but in some frames no contact explains the motion, or a "
    "step of the simulation did not converge, a lost simulation was set back, a point is still "
    "more than 1 mm inside the scene, the other athlete or the body itself, or the output is no "
    "longer near the capture (a frame by more than 0.5 m in the mean of its joints, or all frames "
    "by more than 0.3 m in the mean); the message names the frames.",
  .examples =
    (const char *const[]){
      "kinegrad correct walk.bvh -o walk_fixed.bvh",
      "kinegrad correct walk.bvh -o walk_fixed.bvh --method sdf --json report.json",
      "kinegrad correct walk.bvh -o walk_fixed.bvh --forces forces.csv --mass 62",
      "kinegrad correct walk.bvh -o walk_fixed.bvh --scene gym.json",
      "kinegrad correct walk.bvh -o walk_fixed.bvh --self",
      "kinegrad correct walk.bvh -o walk_fixed.bvh --with partner.bvh", NULL},
  .groups = groups,
  .group_count = KG_COUNT_OF(groups),
  .operand_count = 1,
  .operands_text = "one clip",
  .defaults = &defaults,
  .values_size = sizeof(correct_values),
  .run = run,
};
