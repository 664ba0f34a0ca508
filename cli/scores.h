/* The metrics as a table and as JSON; shared by correct and eval. */
#ifndef CLI_SCORES_H
#define CLI_SCORES_H

#include <stdio.h>

#include "cli/json.h"
#include "kinegrad/metrics.h"

/* One number of kg_motion_metrics: the rows of the table and the keys of the report. */
typedef struct cli_score {
  const char *key;
  const char *text; /* for people */
  size_t offset;
  bool in_summary; /* in the table of two folders */
} cli_score;

extern const cli_score cli_scores[];
extern const int cli_score_count;
double cli_score_value(const kg_motion_metrics *metrics, int score);

/* A row of two columns; - for what is not finite. */
void cli_print_score(FILE *out, const char *key, double capture, double output, const char *text);
/* Two columns, capture and output; below, where the output is deeper than a penetration event. */
void cli_print_scores(FILE *out, const kg_subject *subject, const kg_metrics *metrics);

/* The deepest point of the output in an obstacle it is inside of: "12.3 mm in frame 7 (l_wrist in
 * spine)". The frame's number is the file's. */
typedef struct cli_deepest {
  char text[320];
} cli_deepest;
cli_deepest cli_deepest_text(const kg_subject *subject, const kg_metrics *metrics,
                             kg_obstacle obstacle);

/* Top-level keys, "capture", and "mpjpe_normalized_m". */
void cli_report_scores(json_t *root, const kg_subject *subject, const kg_metrics *metrics);
/* "frames" and "joints": one array per key. Frame numbers are the file's. */
json_t *cli_frames_object(const kg_subject *subject, const kg_metrics *metrics);
json_t *cli_joints_object(const kg_subject *subject, const kg_metrics *metrics);
/* "constants" of the metrics. */
json_t *cli_constants_object(void);

#endif
