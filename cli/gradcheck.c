/* kinegrad gradcheck: every operator, primitive and loss against numerical differentiation, as a
 * table. */
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "cli/commands.h"
#include "cli/gradcheck.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/reading.h"

typedef struct gradcheck_values {
  cli_reading reading;
  cli_talk talk;
  const char *json;
  const char *filter;
  int seed, points;
} gradcheck_values;

/* The rows of the engine first, then those of the models. */
typedef struct rows {
  const gradcheck_values *values;
  cli_models *models;
  kg_gradcheck_def def;
} rows;

static int row_count(void)
{
  return kg_registry_count() + cli_models_count();
}

static const char *row_name(int i)
{
  return i < kg_registry_count() ? kg_registry_name(i) : cli_models_name(i - kg_registry_count());
}

static kg_status check_row(const rows *r, int i, kg_gradcheck_report *report, kg_error *error)
{
  const int first = kg_registry_count(), points = r->values->points;
  if (i < first) return kg_registry_check(i, points, &r->def, report, error);
  return cli_models_check(r->models, i - first, points, &r->def, report, error);
}

/* The words of a filter are separated by commas; empty ones do not count. Returns how long the next
 * one is and moves *filter to its start; 0 behind the last. */
static size_t next_word(const char **filter)
{
  *filter += strspn(*filter, ",");
  return strcspn(*filter, ",");
}

static bool name_has(const char *name, const char *word, size_t length)
{
  for (; *name; name++) {
    if (strncasecmp(name, word, length) == 0) {
      return true;
    }
  }
  return false;
}

static bool row_is_wanted(const rows *r, int i)
{
  const char *word = r->values->filter;
  bool is_wanted = !word;
  for (size_t n; word && !is_wanted && (n = next_word(&word)) > 0; word += n) {
    is_wanted = name_has(row_name(i), word, n);
  }
  return is_wanted;
}

static json_t *check_object(const kg_gradcheck_report *r)
{
  json_t *object = json_object();
  cli_json_set_text(object, "name", r->name);
  cli_json_set_text(object, "method", r->method);
  cli_json_set_number(object, "max_relative_error", r->max_relative_error);
  cli_json_set_number(object, "error_estimate", r->error_estimate);
  cli_json_set_number(object, "tolerance", r->tolerance);
  cli_json_set_number(object, "dot_test", r->dot_test);
  cli_json_set_number(object, "taylor_order", r->taylor_order);
  cli_json_set_bool(object, "repeatable", r->repeatable);
  cli_json_set_bool(object, "passed", r->passed);
  return object;
}

static void print_row(FILE *out, const kg_gradcheck_report *report)
{
  char text[512];
  kg_gradcheck_row(report, text, sizeof text);
  fprintf(out, "%s\n", text);
}

/* CLI_GOOD, CLI_ANSWER_IS_NO when a row failed, or another code after a message */
static int check_all(const rows *r, json_t *checks, FILE *table)
{
  int failed = 0, count = 0;
  print_row(table, NULL);
  for (int i = 0; i < row_count(); i++) {
    if (!row_is_wanted(r, i)) {
      continue;
    }
    kg_gradcheck_report report;
    kg_error error = {0};
    if (check_row(r, i, &report, &error) != KG_OK) {
      return cli_failed(&error);
    }
    count++;
    failed += !report.passed;
    print_row(table, &report);
    json_array_append_new(checks, check_object(&report));
    if (cli_interrupted()) {
      return CLI_INTERRUPTED;
    }
  }
  fprintf(table, "%d of %d passed\n", count - failed, count);
  return failed ? CLI_ANSWER_IS_NO : CLI_GOOD;
}

static int write_report(const gradcheck_values *values, json_t *checks, int code, cli_output *json,
                        FILE *out)
{
  json_t *root = cli_json_report("gradcheck");
  cli_json_set_integer(root, "seed", values->seed);
  cli_json_set_integer(root, "points", values->points);
  json_object_set(root, "checks", checks);
  const bool is_written = cli_json_write(root, json, out);
  json_decref(root);
  return is_written ? code : CLI_OUTPUT;
}

static int check_and_report(const rows *r, cli_output *json, FILE *out)
{
  const bool is_stdout = cli_json_is_stdout(r->values->json);
  FILE *table = is_stdout ? fopen("/dev/null", "w") : out;
  if (!table) {
    return cli_failed_status(KG_ERR_WRITE, "/dev/null");
  }
  json_t *checks = json_array();
  int code = check_all(r, checks, table);
  if (r->values->json && (code == CLI_GOOD || code == CLI_ANSWER_IS_NO)) {
    code = write_report(r->values, checks, code, json, out);
  }
  json_decref(checks);
  if (is_stdout) {
    fclose(table);
  }
  return code;
}

static bool any_row_has(const char *word, size_t length)
{
  for (int i = 0; i < row_count(); i++) {
    if (name_has(row_name(i), word, length)) {
      return true;
    }
  }
  return false;
}

/* A word that finds nothing is a slip of the pen: what was meant would go unchecked. */
static bool filter_is_good(const char *filter)
{
  if (!filter) {
    return true;
  }
  const char *word = filter;
  size_t n = next_word(&word);
  bool is_good = n > 0;
  while (n > 0 && is_good) {
    is_good = any_row_has(word, n);
    word += is_good ? n : 0;
    n = next_word(&word);
  }
  if (!is_good) {
    cli_message("--filter: no check has '%.*s' in its name; 'kinegrad gradcheck' lists them",
                (int)n, word);
  }
  return is_good;
}

static int check_with(const gradcheck_values *values, const kg_subject *subject, FILE *out)
{
  rows r = {.values = values, .def = kg_gradcheck_default_def()};
  cli_output *json = NULL;
  r.def.seed = (uint64_t)values->seed;
  if (!filter_is_good(values->filter)) {
    return CLI_USAGE;
  }
  if (!cli_json_open(&json, values->json)) {
    return CLI_OUTPUT;
  }
  const kg_status status = cli_models_create(&r.models, subject);
  const int code =
    status == KG_OK ? check_and_report(&r, json, out) : cli_failed_status(status, "gradcheck");
  cli_models_destroy(r.models);
  return code;
}

static int check_with_clip(const gradcheck_values *values, const char *path, FILE *out)
{
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  int code = cli_read_clip(&clip, path, &values->reading, values->talk.quiet);
  if (code == CLI_GOOD) {
    const char *const inputs[] = {path, clip->source.skeleton_path, values->reading.map};
    code = cli_is_input("--json", values->json, inputs, (int)KG_COUNT_OF(inputs))
             ? CLI_USAGE
             : cli_create_subject(&subject, clip, &values->reading, NULL);
  }
  if (code == CLI_GOOD) {
    code = check_with(values, subject, out);
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  return code;
}

static int run(const void *values_given, const cli_operands *operands, FILE *out)
{
  const gradcheck_values *values = values_given;
  return operands->count ? check_with_clip(values, operands->at[0], out)
                         : check_with(values, NULL, out);
}

static const cli_option check_options[] = {
  {.name = "filter",
   .kind = CLI_PATH,
   .value_name = "TEXT",
   .summary = "only checks whose name contains TEXT",
   .details =
     "Several, separated by commas; small and capital letters are the same. A text that no "
     "name contains is an error.",
   .offset = offsetof(gradcheck_values, filter)},
  {.name = "points",
   .kind = CLI_INT,
   .value_name = "COUNT",
   .default_text = "100",
   .summary = "random points for each check",
   .details = "Points at and beside the kinks come on top. Rows of a whole body are checked at one "
              "point for "
              "every 5, operators of the dynamics at one for every 20.",
   .minimum = 1,
   .maximum = 1e6,
   .offset = offsetof(gradcheck_values, points)},
  {.name = "seed",
   .kind = CLI_INT,
   .value_name = "NUMBER",
   .default_text = "1",
   .summary = "of the random points; the same seed gives the same report",
   .minimum = 0,
   .maximum = 2147483647,
   .offset = offsetof(gradcheck_values, seed)},
  {.name = "json",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the table as one JSON object; - for stdout, in place of the text",
   .details = "{\"checks\": [{\"name\", \"max_relative_error\", \"dot_test\", \"taylor_order\", "
              "\"passed\", ...}]}; what is infinite or was not measured is null.",
   .offset = offsetof(gradcheck_values, json)},
};

static const cli_group groups[] = {
  {"Checks", check_options, KG_COUNT_OF(check_options), 0},
  {"Reading the clip", cli_reading_options, CLI_READING_OPTION_COUNT,
   offsetof(gradcheck_values, reading)},
  {"General", cli_talk_options, CLI_QUIET_ONLY, offsetof(gradcheck_values, talk)},
};

static const gradcheck_values defaults = {
  .reading = CLI_READING_DEFAULTS, .seed = 1, .points = 100};

const cli_command cli_command_gradcheck = {
  .name = "gradcheck",
  .summary = "derivatives of operators, losses, dynamics and the step against numerical ones",
  .usage = "[CLIP] [options]",
  .details = "Checks the derivative of every operator and primitive of the engine and of every "
             "model and loss "
             "that brings its own: entry by entry against complex steps, or against extrapolated "
             "differences "
             "with their own error where a function has no complex form; the dot test of the two "
             "products; the "
             "order of the Taylor remainder along random directions; and that a repeated call "
             "gives the same "
             "bits. With a clip the rows of a whole body use its body, ground and motion.\n"
             "Exit code 1: a check failed, or could not decide.",
  .examples = (const char *const[]){"kinegrad gradcheck", "kinegrad gradcheck walk.bvh --points 20",
                                    "kinegrad gradcheck --filter step,contact --json -", NULL},
  .groups = groups,
  .group_count = KG_COUNT_OF(groups),
  .operand_count = 0,
  .optional_count = 1,
  .operands_text = "at most one clip",
  .defaults = &defaults,
  .values_size = sizeof(gradcheck_values),
  .run = run,
};
