/* bench/bench.h - timing of contestants side by side.
 *
 * A case is one problem and the contestants that answer it. All of them are made, each answers once
 * and is compared with an independent reference; only then are they timed, in rounds: every round
 * runs each contestant in turn, so that whatever else the machine does hits all of them alike.
 * Times are medians over the rounds, of CPU time and of wall time. */
#ifndef BENCH_BENCH_H
#define BENCH_BENCH_H

#include "kinegrad/base.h"

/* A piece of an answer. Entries are compared with the largest entry of their class, entry i being of
 * class i mod stride: derivatives by a focal length and by an angle have scales of their own. */
typedef struct kg_bench_part {
  const char *name;
  size_t count, stride; /* stride >= 1 */
} kg_bench_part;

enum { KG_BENCH_MAX_PARTS = 8 };

/* A case's problem while the case runs. */
typedef struct kg_bench_problem {
  void *data;       /* what contestants get                    */
  char source[256]; /* where the data come from, for the table */
  double items;     /* times are given per item; 1: of a run   */
  int part_count;
  kg_bench_part parts[KG_BENCH_MAX_PARTS];
} kg_bench_problem;

typedef struct kg_bench_contestant {
  const char *name;
  const char *absent; /* why it is not in this build; NULL: it is   */
  unsigned parts;     /* bit i: its answer has part i of the answer */
  /* Everything that need not be repeated for another answer. Memory comes from the allocator where
   * the contestant can use one. */
  kg_status (*create)(void **state, const void *data, const kg_allocator *allocator);
  /* answer: all parts in a row; those it has are written. */
  kg_status (*run)(void *state, double *answer);
  void (*destroy)(void *state);
} kg_bench_contestant;

/* What is compared: contestants by index. bar: the ratio, or for a pair of one with itself the
 * value, that is aimed at; 0 when there is none. */
typedef struct kg_bench_pair {
  const char *name;
  int ours, peer;
  double bar;
} kg_bench_pair;

typedef struct kg_bench_setting {
  const char *data_folder; /* NULL: synthetic data; for some suites a file may stand in its place */
  int rounds;              /* >= 1                 */
} kg_bench_setting;

typedef struct kg_bench_case {
  const char *name;
  const char *unit;    /* "ms"                               */
  double unit_seconds; /* 1e-3                               */
  double tolerance;    /* largest difference from the reference */
  bool is_check_only;  /* answers are compared, nothing is timed */
  const void *detail;  /* for open                           */
  kg_status (*open)(kg_bench_problem *problem, const kg_bench_setting *setting, const void *detail,
                    kg_error *error);
  void (*close)(kg_bench_problem *problem);
  kg_status (*reference)(const void *data, double *answer); /* all parts */
  const kg_bench_contestant *contestants;
  int contestant_count;
  const kg_bench_pair *pairs;
  int pair_count;
} kg_bench_case;

typedef struct kg_bench_group {
  const kg_bench_case *cases;
  int count;
} kg_bench_group;

typedef struct kg_bench_suite {
  const char *name;
  const char *summary;
  /* where its data lie when nothing is said; synthetic ones if that is not there, or always: NULL */
  const char *data;
  const kg_bench_group *groups;
  int group_count;
} kg_bench_suite;

extern const kg_bench_suite kg_bench_suites[];
extern const int kg_bench_suite_count;

/* Compiler and flags, a line each, for the head of a table; ends with NULL. */
extern const char *const kg_bench_build[];

/* ---- results --------------------------------------------------------------------------------- */

enum { KG_BENCH_MAX_CONTESTANTS = 12 };

/* What one contestant did. */
typedef struct kg_bench_measure {
  double difference;      /* from the reference; NAN: not compared, it has nothing in common */
  int worst_part;         /* where that is                                                  */
  double cpu, wall;       /* s a run, medians                                               */
  double spread;          /* (third - first quartile) / median of the CPU time              */
  int rounds, repeats;    /* so many rounds of so many runs; 0 rounds: not timed            */
  double allocator_bytes; /* most that was held at once through the allocator; 0: not used  */
  double process_bytes;   /* growth of the process while it was made and ran; NAN: unknown  */
} kg_bench_measure;

typedef struct kg_bench_result {
  const kg_bench_case *of;
  kg_bench_problem problem; /* closed: no data */
  kg_bench_measure measures[KG_BENCH_MAX_CONTESTANTS];
  /* of each pair: the difference of the two answers, and of ours from the reference if larger */
  double agreements[KG_BENCH_MAX_CONTESTANTS];
  bool agrees;
} kg_bench_result;

/* Runs one case. KG_OK with agrees false when an answer differs; then nothing is timed. */
kg_status kg_bench_run(kg_bench_result *result, const kg_bench_case *of,
                       const kg_bench_setting *setting, kg_error *error);
#endif
