/* The options that say how a clip is read and whose body it is; shared by all commands. */
#ifndef CLI_READING_H
#define CLI_READING_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

#include "cli/json.h"
#include "cli/options.h"
#include "cli/progress.h"
#include "kinegrad/clip.h"
#include "kinegrad/subject.h"

typedef struct cli_reading {
  const char *asf;
  double rate;  /* Hz                                  */
  double unit;  /* m per file unit                     */
  int up;       /* index into "auto|y|z|x"             */
  double floor; /* m                                   */
  bool keep_first_frame;
  const char *map;
  double mass; /* kg                                  */
  int sex;     /* index into "mean|female|male"       */
} cli_reading;

/* Messages and progress, shared by all commands. */
typedef struct cli_talk {
  bool quiet;
  int progress; /* cli_progress_style */
} cli_talk;

#define CLI_READING_DEFAULTS                                                                       \
  {                                                                                                \
    .rate = NAN, .unit = NAN, .floor = NAN, .mass = 70.0                                           \
  }

extern const cli_option cli_reading_options[];
enum { CLI_READING_OPTION_COUNT = 9 };

extern const cli_option cli_talk_options[];
enum { CLI_QUIET_ONLY = 1, CLI_TALK_OPTION_COUNT = 2 };

/* Reads the clip and prints its warnings. CLI_GOOD, or an exit code after a message. */
int cli_read_clip(kg_clip **clip, const char *path, const cli_reading *reading, bool is_quiet);
/* The same file read the way the capture was: its unit, axes and first frame are not guessed
 * anew. */
kg_status cli_read_output(kg_clip **clip, const char *path, const kg_clip *capture,
                          kg_error *error);
/* Subject of a clip; of `around` the scene (extra, ground), the other athlete and self, NULL: none. */
int cli_create_subject(kg_subject **subject, const kg_clip *clip, const cli_reading *reading,
                       const kg_subject_def *around);

/* What was found out about the clip: as text, and as the objects "clip", "floor", "feet", "body",
 * "mapping". */
void cli_print_source(FILE *out, const kg_clip *clip, const kg_subject *subject);
void cli_report_source(json_t *root, const kg_clip *clip, const kg_subject *subject);

#endif
