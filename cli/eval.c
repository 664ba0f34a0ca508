/* kinegrad eval: the metrics of a capture and of an output made from it, for one pair or for the
 * pairs of two folders. Floor and body are the capture's for both. */
#include <dirent.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>

#include "cli/around.h"
#include "cli/commands.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/reading.h"
#include "cli/scores.h"

typedef struct eval_values {
  cli_reading reading;
  cli_talk talk;
  cli_around_values around;
  const char *json;
} eval_values;

typedef struct pair {
  kg_clip *capture;
  kg_subject *subject;
  kg_metrics *metrics;
} pair;

/* Sums over the pairs of two folders, for the last row of the table. */
typedef struct totals {
  int count;
  double mpjpe_m, acceleration_peak_ratio;
  double capture[32], output[32];
} totals;

static void release(pair *p)
{
  kg_metrics_destroy(p->metrics);
  kg_subject_destroy(p->subject);
  kg_clip_destroy(p->capture);
  *p = (pair){NULL, NULL, NULL};
}

static int measure(pair *p, const char *output_path)
{
  kg_clip *output = NULL;
  kg_error error = {0};
  if (cli_read_output(&output, output_path, p->capture, &error) != KG_OK) {
    return cli_failed(&error);
  }
  const size_t T = (size_t)p->subject->frame_count, nq = (size_t)p->subject->body->nq;
  double *q = calloc(T * nq, sizeof *q);
  kg_status status = q ? kg_subject_states(p->subject, output, q, &error) : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    status = kg_metrics_create(&p->metrics, p->subject, q);
  }
  free(q);
  kg_clip_destroy(output);
  if (status != KG_OK && error.text[0]) {
    snprintf(error.path, sizeof error.path, "%s", output_path);
    return cli_failed(&error);
  }
  return status == KG_OK ? CLI_GOOD : cli_failed_status(status, output_path);
}

/* Files that are read, by the command line and by what stands in them, and not written over. */
static bool overwrites(const eval_values *values, const cli_around *around,
                       const char *capture_path, const char *output_path)
{
  const char *given[4 + CLI_MAX_AROUND_PATHS] = {capture_path, output_path, values->reading.asf,
                                                 values->reading.map};
  const char *found[CLI_MAX_AROUND_FOUND];
  return cli_is_input("--json", values->json, given,
                      4 + cli_around_paths(&values->around, given + 4)) ||
         cli_is_input("--json", values->json, found, cli_around_found(around, found));
}

static int load(pair *p, const eval_values *values, const cli_around *around,
                const char *capture_path, const char *output_path)
{
  if (overwrites(values, around, capture_path, output_path)) {
    return CLI_USAGE;
  }
  int code = cli_read_clip(&p->capture, capture_path, &values->reading, values->talk.quiet);
  if (code == CLI_GOOD) {
    code =
      cli_around_subject(&p->subject, around, p->capture, &values->reading, values->talk.quiet);
  }
  return code == CLI_GOOD ? measure(p, output_path) : code;
}

static json_t *pair_object(json_t *object, const pair *p, const cli_around *around,
                           const char *output_path)
{
  cli_json_set_text(object, "output", output_path);
  cli_report_scores(object, p->subject, p->metrics);
  cli_report_source(object, p->capture, p->subject);
  cli_report_around(object, around, p->subject);
  json_object_set_new(object, "constants", cli_constants_object());
  json_object_set_new(object, "joints", cli_joints_object(p->subject, p->metrics));
  json_object_set_new(object, "frames", cli_frames_object(p->subject, p->metrics));
  return object;
}

static int evaluate_pair(const eval_values *values, const cli_around *around,
                         const cli_operands *operands, cli_output *json, FILE *out)
{
  pair p = {NULL, NULL, NULL};
  int code = load(&p, values, around, operands->at[0], operands->at[1]);
  if (code == CLI_GOOD && values->json) {
    json_t *root = pair_object(cli_json_report("eval"), &p, around, operands->at[1]);
    code = cli_json_write(root, json, out) ? CLI_GOOD : CLI_OUTPUT;
    json_decref(root);
  }
  if (code == CLI_GOOD && !cli_json_is_stdout(values->json)) {
    cli_print_source(out, p.capture, p.subject);
    cli_print_around(out, around, p.subject);
    fprintf(out, "\n%s\n", operands->at[1]);
    cli_print_scores(out, p.subject, p.metrics);
  }
  release(&p);
  return code;
}

/* ---- two folders ----------------------------------------------------------------------------- */

static bool is_clip_name(const char *name)
{
  const char *dot = strrchr(name, '.');
  return dot && dot != name && (strcasecmp(dot, ".bvh") == 0 || strcasecmp(dot, ".amc") == 0);
}

static int keep_clips(const struct dirent *entry)
{
  return is_clip_name(entry->d_name);
}

static int by_bytes(const struct dirent **a, const struct dirent **b)
{
  return strcmp((*a)->d_name, (*b)->d_name);
}

/* The output of capture `name`: the same name, or its stem with .bvh. False: there is none. */
static bool find_output(char path[CLI_MAX_PATH], const char *folder, const char *name)
{
  struct stat status;
  snprintf(path, CLI_MAX_PATH, "%s/%s", folder, name);
  if (stat(path, &status) == 0) {
    return true;
  }
  const int stem = (int)(strrchr(name, '.') - name);
  snprintf(path, CLI_MAX_PATH, "%s/%.*s.bvh", folder, stem, name);
  return stat(path, &status) == 0;
}

/* of the two numbers of a score, below its name */
static int row_width(int score)
{
  const int name = (int)strlen(cli_scores[score].key);
  return name > 19 ? name : 19;
}

static void print_row(FILE *out, const char *name, double mpjpe_m, const double *capture,
                      const double *output)
{
  fprintf(out, "%-28s %9.5f", name, mpjpe_m);
  for (int i = 0; i < cli_score_count; i++) {
    if (cli_scores[i].in_summary) {
      fprintf(out, "  %*.4g %9.4g", row_width(i) - 10, capture[i], output[i]);
    }
  }
  fputc('\n', out);
}

static void print_head(FILE *out)
{
  fprintf(out, "%-28s %9s", "capture, output", "mpjpe_m");
  for (int i = 0; i < cli_score_count; i++) {
    if (cli_scores[i].in_summary) {
      fprintf(out, "  %-*s", row_width(i), cli_scores[i].key);
    }
  }
  fputc('\n', out);
}

static void add(totals *sum, const pair *p, const char *name, FILE *out)
{
  double capture[32], output[32];
  for (int i = 0; i < cli_score_count; i++) {
    capture[i] = cli_score_value(&p->metrics->capture, i);
    output[i] = cli_score_value(&p->metrics->output, i);
    sum->capture[i] += capture[i];
    sum->output[i] += output[i];
  }
  sum->count++;
  sum->mpjpe_m += p->metrics->mpjpe_m;
  sum->acceleration_peak_ratio =
    fmax(sum->acceleration_peak_ratio, p->metrics->acceleration_peak_ratio);
  print_row(out, name, p->metrics->mpjpe_m, capture, output);
}

static void divide(totals *sum)
{
  sum->mpjpe_m /= sum->count;
  for (int i = 0; i < cli_score_count; i++) {
    sum->capture[i] /= sum->count;
    sum->output[i] /= sum->count;
  }
}

static void set_means(json_t *root, const totals *mean)
{
  cli_json_set_integer(root, "clip_count", mean->count);
  cli_json_set_number(root, "mpjpe_m", mean->mpjpe_m);
  cli_json_set_number(root, "acceleration_peak_ratio_max", mean->acceleration_peak_ratio);
  json_t *capture = json_object();
  for (int i = 0; i < cli_score_count; i++) {
    cli_json_set_number(root, cli_scores[i].key, mean->output[i]);
    cli_json_set_number(capture, cli_scores[i].key, mean->capture[i]);
  }
  json_object_set_new(root, "capture", capture);
}

/* One capture of the folder; a clip without output is told and counted, not an error. */
static int evaluate_entry(const eval_values *values, const cli_around *around,
                          const cli_operands *operands, const char *name, totals *sum,
                          json_t *clips, json_t *missing, FILE *table)
{
  char capture_path[CLI_MAX_PATH], output_path[CLI_MAX_PATH];
  snprintf(capture_path, sizeof capture_path, "%s/%s", operands->at[0], name);
  if (!find_output(output_path, operands->at[1], name)) {
    cli_message("%s: no output of this clip in %s", capture_path, operands->at[1]);
    json_array_append_new(missing, cli_json_text(capture_path));
    return CLI_GOOD;
  }
  pair p = {NULL, NULL, NULL};
  const int code = load(&p, values, around, capture_path, output_path);
  if (code == CLI_GOOD) {
    add(sum, &p, name, table);
    json_array_append_new(clips, pair_object(json_object(), &p, around, output_path));
  }
  release(&p);
  return code;
}

static int finish_folders(const eval_values *values, totals *sum, json_t *root, cli_output *json,
                          FILE *table, FILE *out)
{
  int code = CLI_GOOD;
  divide(sum);
  print_row(table, "mean", sum->mpjpe_m, sum->capture, sum->output);
  if (values->json) {
    set_means(root, sum);
    code = cli_json_write(root, json, out) ? CLI_GOOD : CLI_OUTPUT;
  }
  return code == CLI_GOOD && json_array_size(json_object_get(root, "missing")) > 0
           ? CLI_ANSWER_IS_NO
           : code;
}

static int evaluate_folders(const eval_values *values, const cli_around *around,
                            const cli_operands *operands, cli_output *json, FILE *out)
{
  struct dirent **entries = NULL;
  const int count = scandir(operands->at[0], &entries, keep_clips, by_bytes);
  FILE *table = cli_json_is_stdout(values->json) ? fopen("/dev/null", "w") : out;
  json_t *root = cli_json_report("eval"), *clips = json_array(), *missing = json_array();
  totals sum = {0};
  int code = table ? CLI_GOOD : CLI_OUTPUT;
  if (table) {
    print_head(table);
  }
  for (int i = 0; i < count; i++) {
    if (code == CLI_GOOD && !cli_interrupted()) {
      code =
        evaluate_entry(values, around, operands, entries[i]->d_name, &sum, clips, missing, table);
    }
    free(entries[i]);
  }
  free(entries);
  if (code == CLI_GOOD && cli_interrupted()) {
    code = CLI_INTERRUPTED;
  } else if (code == CLI_GOOD && sum.count == 0) {
    cli_message("%s: no clip (.bvh, .amc) with an output in %s", operands->at[0], operands->at[1]);
    code = CLI_INPUT;
  } else if (code == CLI_GOOD) {
    json_object_set(root, "clips", clips);
    json_object_set(root, "missing", missing);
    code = finish_folders(values, &sum, root, json, table, out);
  }
  json_decref(missing);
  json_decref(clips);
  json_decref(root);
  if (table && table != out) {
    fclose(table);
  }
  return code;
}

static bool is_folder(const char *path)
{
  struct stat status;
  return stat(path, &status) == 0 && S_ISDIR(status.st_mode);
}

static int run(const void *values_given, const cli_operands *operands, FILE *out)
{
  const eval_values *values = values_given;
  const bool first = is_folder(operands->at[0]), second = is_folder(operands->at[1]);
  if (first != second) {
    cli_message("'eval' compares two clips or two folders, not a clip and a folder");
    return CLI_USAGE;
  }
  if (first && values->around.with) {
    cli_message("--with has no meaning with two folders: another athlete belongs to one clip");
    return CLI_USAGE;
  }
  cli_output *json = NULL;
  if (!cli_json_open(&json, values->json)) {
    return CLI_OUTPUT;
  }
  cli_around around = {0};
  int code = cli_around_read(&around, &values->around, &values->reading, values->talk.quiet);
  if (code == CLI_GOOD) {
    code = (first ? evaluate_folders : evaluate_pair)(values, &around, operands, json, out);
  }
  cli_around_release(&around);
  return code;
}

static const cli_option result_options[] = {
  {.name = "json",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the report as one JSON object; - for stdout, in place of the table",
   .details = "For two folders: the means at top level, one object per pair under 'clips', "
              "captures without output under 'missing'. SI "
              "units in the names of the keys: 'kinegrad help json'.",
   .offset = offsetof(eval_values, json)},
};

static const cli_group groups[] = {
  {"Results", result_options, KG_COUNT_OF(result_options), 0},
  {"What is in the way", cli_around_options, CLI_AROUND_OPTION_COUNT,
   offsetof(eval_values, around)},
  {"Reading the capture", cli_reading_options, CLI_READING_OPTION_COUNT,
   offsetof(eval_values, reading)},
  {"General", cli_talk_options, CLI_QUIET_ONLY, offsetof(eval_values, talk)},
};

static const eval_values defaults = {.reading = CLI_READING_DEFAULTS,
                                     .around = CLI_AROUND_DEFAULTS};

const cli_command cli_command_eval = {
  .name = "eval",
  .summary = "metrics of a capture and its correction, for a pair or two folders",
  .usage = "CAPTURE OUT [options]",
  .details =
    "Measures a clip that was made from a capture, by this program or another: same joints, same "
    "number of frames. Floor and body are estimated from the capture and used for both; --scene, "
    "--with and --self put the same in the way as they do for 'correct', so that its output is "
    "measured against what it was corrected for. Two folders are paired by file name; the output "
    "of an AMC clip has its name with .bvh.\n"
    "Exit code 1: some clips of the first folder have no output in the second.",
  .examples = (const char *const[]){"kinegrad eval walk.bvh walk_fixed.bvh",
                                    "kinegrad eval walk.bvh walk_fixed.bvh --scene gym.json --self",
                                    "kinegrad eval walk.bvh walk_fixed.bvh --with partner.bvh",
                                    "kinegrad eval captures corrected --json scores.json", NULL},
  .groups = groups,
  .group_count = KG_COUNT_OF(groups),
  .operand_count = 2,
  .operands_text = "a capture and an output",
  .defaults = &defaults,
  .values_size = sizeof(eval_values),
  .run = run,
};
