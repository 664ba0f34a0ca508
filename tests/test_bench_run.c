/* The rounds of `kinegrad bench`: answers are compared before anything is timed. */
#include "support.h"

#include <time.h>

#include "bench/bench.h"

enum { FIRST = 1, REST = 2 };

/* What the contestants of the case below give: first entry, then four of two scales. */
static const double TRUTH[5] = {3.0, 1e6, 1.0, -2e6, 0.5};

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  (void)setting;
  (void)error;
  problem->data = (void *)detail;
  problem->items = 2.0;
  problem->parts[0] = (kg_bench_part){"first", 1, 1};
  problem->parts[1] = (kg_bench_part){"rest", 4, 2};
  problem->part_count = 2;
  return KG_OK;
}

static void close(kg_bench_problem *problem)
{
  (void)problem;
}

static kg_status reference(const void *data, double *answer)
{
  (void)data;
  memcpy(answer, TRUTH, sizeof TRUTH);
  return KG_OK;
}

/* a contestant with 1000 bytes from the allocator */
typedef struct counted {
  const kg_allocator *allocator;
  void *memory;
} counted;

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  (void)data;
  counted *c = malloc(sizeof *c);
  assert_non_null(c);
  *c = (counted){allocator, allocator->alloc(1000, allocator->user)};
  *state = c;
  return KG_OK;
}

static void destroy(void *state)
{
  counted *c = state;
  c->allocator->free(c->memory, 1000, c->allocator->user);
  free(c);
}

static void spend(double seconds)
{
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  const double end = (double)t.tv_sec + 1e-9 * (double)t.tv_nsec + seconds;
  do {
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  } while ((double)t.tv_sec + 1e-9 * (double)t.tv_nsec < end);
}

static kg_status right(void *state, double *answer)
{
  (void)state;
  spend(0.002);
  memcpy(answer, TRUTH, sizeof TRUTH);
  return KG_OK;
}

static kg_status first_only(void *state, double *answer)
{
  (void)state;
  spend(0.001);
  answer[0] = TRUTH[0];
  return KG_OK;
}

/* wrong by 1e-6 in the small scale, which the large one would hide */
static kg_status wrong(void *state, double *answer)
{
  right(state, answer);
  answer[4] += 1e-6;
  return KG_OK;
}

static kg_status forgets_an_entry(void *state, double *answer)
{
  (void)state;
  memcpy(answer, TRUTH, 4 * sizeof *TRUTH);
  return KG_OK;
}

static kg_status nothing(void *state, double *answer)
{
  (void)state;
  (void)answer;
  return KG_OK;
}

static kg_status refuses(void *state, double *answer)
{
  (void)state;
  (void)answer;
  return KG_ERR_UNDEFINED;
}

static const kg_bench_pair PAIRS[] = {{"second", 1, 0, 0.0}};

/* A case of two contestants, the first being right. */
static kg_bench_result run(const kg_bench_contestant *second, kg_status expected)
{
  const kg_bench_contestant contestants[] = {{"right", NULL, FIRST | REST, create, right, destroy},
                                             *second};
  const kg_bench_case of = {.name = "case",
                            .unit = "ms",
                            .unit_seconds = 1e-3,
                            .tolerance = 1e-9,
                            .open = open,
                            .close = close,
                            .reference = reference,
                            .contestants = contestants,
                            .contestant_count = 2,
                            .pairs = PAIRS,
                            .pair_count = 1};
  const kg_bench_setting setting = {.rounds = 3};
  kg_bench_result result;
  kg_error error = {0};
  assert_int_equal(kg_bench_run(&result, &of, &setting, &error), expected);
  if (expected != KG_OK) {
    assert_non_null(strstr(error.text, "case, "));
  }
  return result;
}

static void right_answers_are_timed(void **state)
{
  (void)state;
  const kg_bench_contestant second = {"first only", NULL, FIRST, create, first_only, destroy};
  const kg_bench_result result = run(&second, KG_OK);
  assert_true(result.agrees);
  for (int i = 0; i < 2; i++) {
    assert_int_equal(result.measures[i].rounds, 3);
    assert_close(result.measures[i].difference, 0.0, 0.0);
    assert_close(result.measures[i].allocator_bytes, 1000.0, 0.0);
  }
  /* 2 ms and 1 ms a run, and a run covers two items */
  assert_close(result.measures[0].cpu, 0.001, 1e-4);
  assert_close(result.measures[1].cpu / result.measures[0].cpu, 0.5, 0.1);
  assert_at_most(0.999 * result.measures[0].cpu, result.measures[0].wall);
  assert_close(result.agreements[0], 0.0, 0.0);
}

static void a_wrong_answer_is_told_and_nothing_is_timed(void **state)
{
  (void)state;
  const kg_bench_contestant second = {"wrong", NULL, FIRST | REST, create, wrong, destroy};
  const kg_bench_result result = run(&second, KG_OK);
  assert_false(result.agrees);
  assert_close(result.measures[1].difference, 1e-6, 1e-10); /* 1e-6 of 1, not of 2e6 */
  assert_close(result.agreements[0], 1e-6, 1e-10);
  assert_int_equal(result.measures[1].worst_part, 1);
  assert_int_equal(result.measures[0].rounds, 0);
  assert_int_equal(result.measures[1].rounds, 0);
}

static void an_entry_never_written_is_no_answer(void **state)
{
  (void)state;
  const kg_bench_contestant second = {"forgets",        NULL,   FIRST | REST, create,
                                      forgets_an_entry, destroy};
  const kg_bench_result result = run(&second, KG_OK);
  assert_false(result.agrees);
  assert_true(isinf(result.measures[1].difference));
}

static void bare_work_has_no_answer_to_agree(void **state)
{
  (void)state;
  const kg_bench_contestant second = {"bare", NULL, 0, create, nothing, destroy};
  const kg_bench_result result = run(&second, KG_OK);
  assert_true(result.agrees);
  assert_true(isnan(result.measures[1].difference));
  assert_int_equal(result.measures[1].rounds, 3);
}

static void one_that_is_absent_is_left_out(void **state)
{
  (void)state;
  const kg_bench_contestant second = {.name = "absent", .absent = "not here", .parts = FIRST};
  const kg_bench_result result = run(&second, KG_OK);
  assert_true(result.agrees);
  assert_int_equal(result.measures[0].rounds, 3);
  assert_int_equal(result.measures[1].rounds, 0);
  assert_true(isnan(result.agreements[0]));
}

static void one_that_fails_ends_the_case(void **state)
{
  (void)state;
  const kg_bench_contestant second = {"refuses", NULL, FIRST, create, refuses, destroy};
  run(&second, KG_ERR_UNDEFINED);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(right_answers_are_timed),
    cmocka_unit_test(a_wrong_answer_is_told_and_nothing_is_timed),
    cmocka_unit_test(an_entry_never_written_is_no_answer),
    cmocka_unit_test(bare_work_has_no_answer_to_agree),
    cmocka_unit_test(one_that_is_absent_is_left_out),
    cmocka_unit_test(one_that_fails_ends_the_case),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
