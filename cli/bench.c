/* kinegrad bench: times beside those of others, in one process, after the answers were compared. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "bench/bench.h"
#include "cli/commands.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/progress.h"
#include "cli/reading.h"

typedef struct bench_values {
  cli_talk talk;
  const char *data;
  const char *filter;
  const char *json;
  int rounds;
} bench_values;

/* A run over the cases that were chosen. */
typedef struct bench_run {
  const kg_bench_suite *suite; /* NULL: all of them */
  const bench_values *values;
  kg_bench_setting setting;
  const kg_bench_suite *data_of; /* the suite whose data the table named last */
  cli_progress progress;
  FILE *table;
  json_t *cases;
  int done, count;
  bool agrees;
} bench_run;

/* ---- which cases ----------------------------------------------------------------------------- */

typedef int visit_fn(bench_run *s, const kg_bench_suite *suite, const kg_bench_case *of);

/* Calls visit for each chosen case until one does not return CLI_GOOD. */
static int each_case(bench_run *s, visit_fn *visit)
{
  int code = CLI_GOOD;
  for (int i = 0; i < kg_bench_suite_count; i++) {
    const kg_bench_suite *suite = &kg_bench_suites[i];
    for (int g = 0; g < suite->group_count && (!s->suite || s->suite == suite); g++) {
      for (int k = 0; k < suite->groups[g].count && code == CLI_GOOD; k++) {
        const kg_bench_case *of = &suite->groups[g].cases[k];
        const char *filter = s->values->filter;
        code = !filter || strstr(of->name, filter) ? visit(s, suite, of) : CLI_GOOD;
      }
    }
  }
  return code;
}

static int count_case(bench_run *s, const kg_bench_suite *suite, const kg_bench_case *of)
{
  (void)suite;
  (void)of;
  s->count++;
  return CLI_GOOD;
}

static int find_suite(const kg_bench_suite **found, const char *name)
{
  char names[256] = "";
  for (int i = 0; i < kg_bench_suite_count; i++) {
    if (strcmp(kg_bench_suites[i].name, name) == 0) {
      *found = &kg_bench_suites[i];
      return CLI_GOOD;
    }
    strncat(names, i > 0 ? ", " : "", sizeof names - strlen(names) - 1);
    strncat(names, kg_bench_suites[i].name, sizeof names - strlen(names) - 1);
  }
  cli_message("unknown suite '%s'; there is: %s", name, names);
  return CLI_USAGE;
}

/* ---- table ----------------------------------------------------------------------------------- */

static void print_processor(FILE *out)
{
  FILE *file = fopen("/proc/cpuinfo", "r");
  char line[256];
  bool is_found = false;
  while (file && !is_found && fgets(line, sizeof line, file)) {
    is_found = strncmp(line, "model name", 10) == 0 && strchr(line, ':');
  }
  if (file) {
    fclose(file);
  }
  fprintf(out, "processor    %s", is_found ? strchr(line, ':') + 2 : "not told by the system\n");
}

static void print_head(const bench_run *s)
{
  print_processor(s->table);
  for (int i = 0; kg_bench_build[i]; i++) {
    fprintf(s->table, "%s\n", kg_bench_build[i]);
  }
}

/* Once a suite. */
static void print_data(bench_run *s, const kg_bench_suite *suite)
{
  if (s->data_of == suite) {
    return;
  }
  s->data_of = suite;
  if (!suite->data) {
    fprintf(s->table, "\n%s: synthetic data\n", suite->name);
  } else if (s->setting.data_folder) {
    fprintf(s->table, "\n%s: data in %s\n", suite->name, s->setting.data_folder);
  } else {
    fprintf(s->table, "\n%s: synthetic data, there is no %s and --data was not given\n",
            suite->name, suite->data);
  }
}

static void print_megabytes(FILE *out, double bytes)
{
  if (bytes > 0.0) {
    fprintf(out, " %9.2f", bytes / 1e6);
  } else {
    fprintf(out, " %9s", "-");
  }
}

static void print_measure(FILE *out, const kg_bench_result *result, int i)
{
  const kg_bench_contestant *contestant = &result->of->contestants[i];
  const kg_bench_measure *m = &result->measures[i];
  const double unit = result->of->unit_seconds;
  fprintf(out, "  %-26s", contestant->name);
  if (contestant->absent) {
    fprintf(out, "  not here: %s\n", contestant->absent);
    return;
  }
  if (m->rounds > 0) {
    fprintf(out, " %10.4g %10.4g %6.1f %% %2d x %-6d", m->cpu / unit, m->wall / unit,
            100.0 * m->spread, m->rounds, m->repeats);
  } else {
    fprintf(out, " %10s %10s %8s %-11s", "-", "-", "-", "  not timed");
  }
  print_megabytes(out, m->allocator_bytes);
  print_megabytes(out, m->process_bytes);
  if (isnan(m->difference)) {
    fprintf(out, "  no answer to compare\n");
  } else {
    fprintf(out, "  %.1e %s\n", m->difference, result->problem.parts[m->worst_part].name);
  }
}

static void print_pair(FILE *out, const kg_bench_result *result, int k)
{
  const kg_bench_case *of = result->of;
  const kg_bench_pair *pair = &of->pairs[k];
  const kg_bench_measure *ours = &result->measures[pair->ours];
  const kg_bench_measure *peer = &result->measures[pair->peer];
  if (ours->rounds == 0 || peer->rounds == 0) {
    return;
  }
  if (pair->ours == pair->peer) {
    fprintf(out, "  %-26s %10.4g %s", pair->name, ours->cpu / of->unit_seconds, of->unit);
  } else {
    fprintf(out, "  %-26s %10.4g times %s", pair->name, ours->cpu / peer->cpu,
            of->contestants[pair->peer].name);
  }
  if (pair->bar > 0.0) {
    fprintf(out, " (aim: %g)", pair->bar);
  }
  fputc('\n', out);
}

static void print_case(FILE *out, const kg_bench_result *result)
{
  char head[2][32];
  snprintf(head[0], sizeof head[0], "CPU %s", result->of->unit);
  snprintf(head[1], sizeof head[1], "wall %s", result->of->unit);
  fprintf(out, "\n%s: %s\n", result->of->name, result->problem.source);
  fprintf(out, "  %-26s %10s %10s %8s %-11s %9s %9s  %s\n", "", head[0], head[1], "spread",
          "rounds", "heap MB", "proc. MB", "largest relative difference");
  for (int i = 0; i < result->of->contestant_count; i++) {
    print_measure(out, result, i);
  }
  for (int k = 0; k < result->of->pair_count; k++) {
    print_pair(out, result, k);
  }
  if (!result->agrees) {
    fprintf(out, "  the answers differ by more than %g, so nothing was timed\n",
            result->of->tolerance);
  }
}

/* ---- report ---------------------------------------------------------------------------------- */

static void add_pair(json_t *cases, const kg_bench_result *result, int k)
{
  const kg_bench_case *of = result->of;
  const kg_bench_pair *pair = &of->pairs[k];
  if (of->contestants[pair->ours].absent || of->contestants[pair->peer].absent) {
    return;
  }
  const kg_bench_measure *ours = &result->measures[pair->ours];
  const kg_bench_measure *peer = &result->measures[pair->peer];
  const bool has_peer = pair->ours != pair->peer;
  const bool is_timed = ours->rounds > 0 && peer->rounds > 0;
  const bool is_ratio = is_timed && has_peer;
  char name[128];
  snprintf(name, sizeof name, "%s %s", of->name, pair->name);
  json_t *row = json_object();
  cli_json_set_text(row, "name", name);
  cli_json_set_number(row, "value", is_timed ? ours->cpu / of->unit_seconds : NAN);
  cli_json_set_text(row, "unit", of->unit);
  cli_json_set_text(row, "peer", has_peer ? of->contestants[pair->peer].name : NULL);
  cli_json_set_number(row, "peer_value", is_ratio ? peer->cpu / of->unit_seconds : NAN);
  cli_json_set_number(row, "ratio", is_ratio ? ours->cpu / peer->cpu : NAN);
  cli_json_set_number(row, "agreement", result->agreements[k]);
  json_array_append_new(cases, row);
}

/* ---- the run --------------------------------------------------------------------------------- */

static const char *data_of(const bench_values *values, const kg_bench_suite *suite)
{
  if (!suite->data) {
    return NULL;
  }
  if (values->data) {
    return values->data;
  }
  return access(suite->data, R_OK) == 0 ? suite->data : NULL;
}

static int run_case(bench_run *s, const kg_bench_suite *suite, const kg_bench_case *of)
{
  s->setting.data_folder = data_of(s->values, suite);
  if (!cli_progress_update((double)s->done / s->count, of->name, &s->progress)) {
    cli_progress_clear();
    cli_message("interrupted; nothing was written");
    return CLI_INTERRUPTED;
  }
  kg_bench_result result;
  kg_error error = {0};
  if (kg_bench_run(&result, of, &s->setting, &error) != KG_OK) {
    return cli_failed(&error);
  }
  print_data(s, suite);
  print_case(s->table, &result);
  for (int k = 0; k < of->pair_count; k++) {
    add_pair(s->cases, &result, k);
  }
  s->agrees = s->agrees && result.agrees;
  s->done++;
  return CLI_GOOD;
}

static int write_report(const bench_run *s, cli_output *json, FILE *out)
{
  json_t *root = cli_json_report("bench");
  json_object_set(root, "cases", s->cases);
  const bool is_written = cli_json_write(root, json, out);
  json_decref(root);
  return is_written ? CLI_GOOD : CLI_OUTPUT;
}

/* All chosen cases, then the report. */
static int run_suite(bench_run *s, cli_output *json, FILE *out)
{
  print_head(s);
  int code = each_case(s, run_case);
  cli_progress_clear();
  if (code == CLI_GOOD && s->values->json) {
    code = write_report(s, json, out);
  }
  if (code == CLI_GOOD && !s->agrees) {
    cli_message("the answers of some cases differ; those were not timed");
    code = CLI_ANSWER_IS_NO;
  }
  return code;
}

static int prepare(bench_run *s, const cli_operands *operands, cli_output **json)
{
  if (operands->count > 0 && find_suite(&s->suite, operands->at[0]) != CLI_GOOD) {
    return CLI_USAGE;
  }
  each_case(s, count_case);
  if (s->count == 0) {
    cli_message("--filter: no case has '%s' in its name", s->values->filter);
    return CLI_USAGE;
  }
  return cli_json_open(json, s->values->json) ? CLI_GOOD : CLI_OUTPUT;
}

static int run(const void *values_given, const cli_operands *operands, FILE *out)
{
  const bench_values *values = values_given;
  bench_run s = {.values = values, .agrees = true};
  s.setting = (kg_bench_setting){.rounds = values->rounds};
  cli_output *json = NULL;
  int code = prepare(&s, operands, &json);
  if (code != CLI_GOOD) {
    return code;
  }
  s.progress = cli_progress_start((cli_progress_style)values->talk.progress, values->talk.quiet, 0);
  s.cases = json_array();
  s.table = cli_json_is_stdout(values->json) ? fopen("/dev/null", "w") : out;
  code = s.table ? run_suite(&s, json, out) : cli_failed_status(KG_ERR_WRITE, "/dev/null");
  if (s.table && s.table != out) {
    fclose(s.table);
  }
  json_decref(s.cases);
  return code;
}

static const cli_option result_options[] = {
  {.name = "json",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the ratios as one JSON object; - for stdout, in place of the table",
   .details = "One object per pair under 'cases': name, value, unit, peer, peer_value, ratio "
              "(value over peer_value, below 1 is faster), agreement (relative difference of the "
              "two answers). What was not timed has null for its times, a time beside no other's "
              "has null for peer, peer_value and ratio.",
   .offset = offsetof(bench_values, json)},
};

static const cli_option run_options[] = {
  {.name = "data",
   .kind = CLI_PATH,
   .value_name = "PATH",
   .default_text = "../shared/adbench, ../shared/data if they are there, else synthetic data",
   .summary = "where a suite's data lie",
   .details =
     "autodiff: folder of ADBench's gmm_d10_K25.txt, gmm_d20_K50.txt, gmm_d32_K25.txt, "
     "ba1.txt, ba5.txt. dynamics, step: a clip, or a folder with "
     "gymnastics/cmu_49_02.bvh and gymnastics/snu_backflip.bvh. sdf: always synthetic. The "
     "table says where each case's data come from.",
   .offset = offsetof(bench_values, data)},
  {.name = "rounds",
   .kind = CLI_INT,
   .value_name = "N",
   .default_text = "9",
   .summary = "how often every contestant is timed; medians are printed",
   .details = "In a round each contestant runs in turn, for 20 ms or once. One that takes longer "
              "than half a second has three rounds at most; the table says how many.",
   .minimum = 1,
   .maximum = 1000,
   .offset = offsetof(bench_values, rounds)},
  {.name = "filter",
   .kind = CLI_PATH,
   .value_name = "TEXT",
   .summary = "only cases with this text in their name",
   .details = "For example gmm, ba1, jacobian, mlp; rnea, derivatives; standing; blob, grid.",
   .offset = offsetof(bench_values, filter)},
};

static const cli_group groups[] = {
  {"Results", result_options, KG_COUNT_OF(result_options), 0},
  {"What is run", run_options, KG_COUNT_OF(run_options), 0},
  {"General", cli_talk_options, CLI_TALK_OPTION_COUNT, offsetof(bench_values, talk)},
};

static const bench_values defaults = {.rounds = 9};

const cli_command cli_command_bench = {
  .name = "bench",
  .summary = "times beside those of other programs, ratios from one run",
  .usage = "[autodiff|dynamics|step|sdf] [options]",
  .details =
    "Runs contestants side by side in one process and prints the medians of their times, the "
    "spread between the quartiles, the memory they took and the ratios, with compiler and flags. "
    "Every answer is compared with an independent one before anything is timed.\n"
    "Heap is what came from the allocator handed to a contestant, proc. the growth of the process "
    "while it was made and ran once.\n"
    "Exit code 1: answers differ; those cases have no times.",
  .examples = (const char *const[]){"kinegrad bench autodiff --filter mlp --rounds 3",
                                    "kinegrad bench dynamics --filter rnea_23 --rounds 3",
                                    "kinegrad bench --filter d10_K25_m2 --json ratios.json", NULL},
  .groups = groups,
  .group_count = KG_COUNT_OF(groups),
  .optional_count = 1,
  .operands_text = "one suite or none",
  .defaults = &defaults,
  .values_size = sizeof(bench_values),
  .run = run,
};
