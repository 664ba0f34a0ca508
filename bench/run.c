/* Runs a case: problem, answers and their comparison, then timing in rounds. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/bench.h"
#include "bench/clock.h"

static const double SAMPLE_SECONDS = 0.02; /* a sample repeats a run to last about as long */
static const double SLOW_SECONDS = 0.5;    /* a run longer than this has SLOW_ROUNDS at most */
enum { SLOW_ROUNDS = 3, MAX_REPEATS = 1000000 };

typedef struct runner {
  const kg_bench_case *of;
  const kg_bench_setting *setting;
  kg_bench_result *result;
  kg_error *error;
  size_t answer_count;
  double *reference;
  double *answers[KG_BENCH_MAX_CONTESTANTS];
  void *states[KG_BENCH_MAX_CONTESTANTS];
  bool is_made[KG_BENCH_MAX_CONTESTANTS];
  kg_bench_heap heaps[KG_BENCH_MAX_CONTESTANTS];
  kg_allocator allocators[KG_BENCH_MAX_CONTESTANTS];
  double seconds[KG_BENCH_MAX_CONTESTANTS]; /* of a first run */
  kg_bench_time *samples[KG_BENCH_MAX_CONTESTANTS];
} runner;

/* ---- comparison ------------------------------------------------------------------------------ */

/* Largest difference of a class over the class's largest entry of b; NaN counts as infinite. */
static double class_difference(const double *a, const double *b, size_t first,
                               const kg_bench_part *part)
{
  double difference = 0.0, largest = 0.0;
  for (size_t i = first; i < part->count; i += part->stride) {
    const double d = fabs(a[i] - b[i]);
    difference = d <= difference ? difference : d; /* takes a NaN, and drops it below */
    if (!isfinite(a[i]) || !isfinite(b[i])) {
      return HUGE_VAL;
    }
    largest = fmax(largest, fabs(b[i]));
  }
  return difference == 0.0 ? 0.0 : difference / largest;
}

static double part_difference(const double *a, const double *b, const kg_bench_part *part)
{
  double difference = 0.0;
  for (size_t first = 0; first < part->stride && first < part->count; first++) {
    difference = fmax(difference, class_difference(a, b, first, part));
  }
  return difference;
}

/* Of the parts in the mask; NAN when there are none. */
static double answer_difference(const runner *r, const double *a, const double *b, unsigned mask,
                                int *worst)
{
  double difference = NAN;
  size_t offset = 0;
  for (int i = 0; i < r->result->problem.part_count; i++) {
    const kg_bench_part *part = &r->result->problem.parts[i];
    const double d = mask >> i & 1u ? part_difference(a + offset, b + offset, part) : NAN;
    if (d > difference || (isnan(difference) && !isnan(d))) {
      difference = d;
      *worst = i;
    }
    offset += part->count;
  }
  return difference;
}

/* ---- a contestant's first answer ------------------------------------------------------------- */

static kg_status fail(const runner *r, kg_status status, int i, const char *what)
{
  return kg_fail(r->error, status, NULL, 0, 0, "%s, %s: %s: %s", r->of->name,
                 i < 0 ? "reference" : r->of->contestants[i].name, what, kg_status_text(status));
}

static bool is_there(const runner *r, int i)
{
  return r->of->contestants[i].absent == NULL;
}

static kg_status first_answer(runner *r, int i)
{
  const kg_bench_contestant *contestant = &r->of->contestants[i];
  kg_bench_measure *measure = &r->result->measures[i];
  r->allocators[i] = kg_bench_heap_allocator(&r->heaps[i]);
  const double before = kg_bench_resident();
  kg_bench_reset_peak();
  kg_status status = contestant->create(&r->states[i], r->result->problem.data, &r->allocators[i]);
  if (status != KG_OK) {
    return fail(r, status, i, "cannot be made");
  }
  r->is_made[i] = true;
  const kg_bench_time start = kg_bench_now();
  status = contestant->run(r->states[i], r->answers[i]);
  r->seconds[i] = kg_bench_now().cpu - start.cpu;
  if (status != KG_OK) {
    return fail(r, status, i, "does not run");
  }
  measure->process_bytes = kg_bench_peak() - before;
  measure->allocator_bytes = (double)r->heaps[i].peak;
  measure->difference =
    answer_difference(r, r->answers[i], r->reference, contestant->parts, &measure->worst_part);
  const bool has_answer = contestant->parts != 0; /* bare work to compare times with has none */
  r->result->agrees = r->result->agrees && (!has_answer || measure->difference <= r->of->tolerance);
  return KG_OK;
}

static void compare_pairs(runner *r)
{
  for (int k = 0; k < r->of->pair_count; k++) {
    const kg_bench_pair *pair = &r->of->pairs[k];
    const unsigned common =
      r->of->contestants[pair->ours].parts & r->of->contestants[pair->peer].parts;
    int worst = 0;
    r->result->agreements[k] = NAN;
    if (is_there(r, pair->ours) && is_there(r, pair->peer)) {
      /* a peer that answers only a part, as an objective does, leaves the rest to the reference */
      r->result->agreements[k] =
        fmax(r->result->measures[pair->ours].difference,
             answer_difference(r, r->answers[pair->ours], r->answers[pair->peer], common, &worst));
    }
  }
}

static kg_status check(runner *r)
{
  kg_status status = r->of->reference(r->result->problem.data, r->reference);
  if (status != KG_OK) {
    return fail(r, status, -1, "does not run");
  }
  for (int i = 0; i < r->of->contestant_count && status == KG_OK; i++) {
    if (is_there(r, i)) {
      status = first_answer(r, i);
    }
  }
  if (status == KG_OK) {
    compare_pairs(r);
  }
  return status;
}

/* ---- timing ---------------------------------------------------------------------------------- */

static int repeats_of(double seconds)
{
  const double repeats = ceil(SAMPLE_SECONDS / fmax(seconds, 1e-9));
  return repeats < MAX_REPEATS ? (int)repeats : MAX_REPEATS;
}

static kg_status sample(runner *r, int i, int round)
{
  const kg_bench_contestant *contestant = &r->of->contestants[i];
  const int repeats = r->result->measures[i].repeats;
  kg_status status = KG_OK;
  const kg_bench_time start = kg_bench_now();
  for (int k = 0; k < repeats && status == KG_OK; k++) {
    status = contestant->run(r->states[i], r->answers[i]);
  }
  const kg_bench_time end = kg_bench_now();
  r->samples[i][round] =
    (kg_bench_time){(end.cpu - start.cpu) / repeats, (end.wall - start.wall) / repeats};
  return status == KG_OK ? KG_OK : fail(r, status, i, "does not run again");
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* of sorted values, linear between them */
static double quantile(const double *sorted, int count, double share)
{
  const double at = share * (count - 1);
  const int low = (int)at, high = low + 1 < count ? low + 1 : low;
  return sorted[low] + (at - low) * (sorted[high] - sorted[low]);
}

static kg_status summarize(runner *r, int i)
{
  kg_bench_measure *measure = &r->result->measures[i];
  const int n = measure->rounds;
  double *values = malloc(2 * (size_t)n * sizeof *values);
  if (!values) {
    return fail(r, KG_ERR_NO_MEMORY, i, "times");
  }
  for (int k = 0; k < n; k++) {
    values[k] = r->samples[i][k].cpu;
    values[n + k] = r->samples[i][k].wall;
  }
  qsort(values, (size_t)n, sizeof *values, ascending);
  qsort(values + n, (size_t)n, sizeof *values, ascending);
  measure->cpu = quantile(values, n, 0.5) / r->result->problem.items;
  measure->wall = quantile(values + n, n, 0.5) / r->result->problem.items;
  measure->spread =
    (quantile(values, n, 0.75) - quantile(values, n, 0.25)) / quantile(values, n, 0.5);
  free(values);
  return KG_OK;
}

/* A first run pays for cold memory; a short one is repeated to learn how long it takes. */
static kg_status warm_up(runner *r, int i)
{
  const kg_bench_time start = kg_bench_now();
  const kg_status status = r->of->contestants[i].run(r->states[i], r->answers[i]);
  r->seconds[i] = kg_bench_now().cpu - start.cpu;
  return status == KG_OK ? KG_OK : fail(r, status, i, "does not run again");
}

static kg_status plan(runner *r)
{
  for (int i = 0; i < r->of->contestant_count; i++) {
    if (is_there(r, i) && r->seconds[i] < SAMPLE_SECONDS) {
      const kg_status status = warm_up(r, i);
      if (status != KG_OK) {
        return status;
      }
    }
    kg_bench_measure *measure = &r->result->measures[i];
    const int rounds = r->setting->rounds;
    const bool is_slow = r->seconds[i] > SLOW_SECONDS && rounds > SLOW_ROUNDS;
    measure->rounds = is_there(r, i) ? (is_slow ? SLOW_ROUNDS : rounds) : 0;
    measure->repeats = repeats_of(r->seconds[i]);
    r->samples[i] = calloc((size_t)rounds, sizeof *r->samples[i]);
    if (!r->samples[i]) {
      return fail(r, KG_ERR_NO_MEMORY, i, "times");
    }
  }
  return KG_OK;
}

/* Each round begins with another contestant, so that none always follows the same one. */
static kg_status time_rounds(runner *r)
{
  kg_status status = plan(r);
  const int n = r->of->contestant_count;
  for (int round = 0; round < r->setting->rounds && status == KG_OK; round++) {
    for (int k = 0; k < n && status == KG_OK; k++) {
      const int i = (round + k) % n;
      status = round < r->result->measures[i].rounds ? sample(r, i, round) : KG_OK;
    }
  }
  for (int i = 0; i < n && status == KG_OK; i++) {
    status = r->result->measures[i].rounds > 0 ? summarize(r, i) : KG_OK;
  }
  return status;
}

/* ---- a case ---------------------------------------------------------------------------------- */

static kg_status allocate(runner *r)
{
  for (int i = 0; i < r->result->problem.part_count; i++) {
    r->answer_count += r->result->problem.parts[i].count;
  }
  r->reference = calloc(r->answer_count, sizeof *r->reference);
  bool is_complete = r->reference != NULL;
  for (int i = 0; i < r->of->contestant_count; i++) {
    r->answers[i] = malloc(r->answer_count * sizeof *r->reference);
    is_complete = is_complete && r->answers[i];
    for (size_t k = 0; r->answers[i] && k < r->answer_count; k++) {
      r->answers[i][k] = NAN; /* an entry that is never written must not pass for an answer */
    }
    r->result->measures[i] = (kg_bench_measure){.difference = NAN};
  }
  return is_complete ? KG_OK : fail(r, KG_ERR_NO_MEMORY, -1, "answers");
}

static void release(runner *r)
{
  for (int i = 0; i < r->of->contestant_count; i++) {
    if (r->is_made[i]) {
      r->of->contestants[i].destroy(r->states[i]);
    }
    free(r->answers[i]);
    free(r->samples[i]);
  }
  free(r->reference);
}

kg_status kg_bench_run(kg_bench_result *result, const kg_bench_case *of,
                       const kg_bench_setting *setting, kg_error *error)
{
  KG_ASSERT(of->contestant_count <= KG_BENCH_MAX_CONTESTANTS);
  KG_ASSERT(of->pair_count <= KG_BENCH_MAX_CONTESTANTS);
  *result = (kg_bench_result){.of = of, .agrees = true};
  kg_status status = of->open(&result->problem, setting, of->detail, error);
  if (status != KG_OK) {
    return status;
  }
  runner r = {.of = of, .setting = setting, .result = result, .error = error};
  status = allocate(&r);
  if (status == KG_OK) {
    status = check(&r);
  }
  if (status == KG_OK && result->agrees && !of->is_check_only) {
    status = time_rounds(&r);
  }
  release(&r);
  of->close(&result->problem);
  result->problem.data = NULL;
  return status;
}
