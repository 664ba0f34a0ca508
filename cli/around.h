/* What is in a clip's way: the options that say so, what they read, and how it is reported. Shared by
 * correct and eval, so that a clip is measured against what it was corrected for. */
#ifndef CLI_AROUND_H
#define CLI_AROUND_H

#include <stdbool.h>
#include <stdio.h>

#include "cli/json.h"
#include "cli/options.h"
#include "cli/reading.h"
#include "cli/scene_file.h"
#include "kinegrad/subject.h"

typedef struct cli_around_values {
  cli_paths scene;
  double scene_unit; /* m per unit of the meshes */
  const char *with;
  bool self;
} cli_around_values;

#define CLI_AROUND_DEFAULTS                                                                        \
  {                                                                                                \
    .scene_unit = 1.0                                                                              \
  }

extern const cli_option cli_around_options[];
enum { CLI_AROUND_OPTION_COUNT = 4 };

typedef struct cli_around {
  const cli_around_values *values;
  cli_scene scene;
  kg_clip *other_clip; /* NULL: nobody */
  kg_subject *other;
} cli_around;

/* Reads scene and other athlete, the latter as the clip itself. CLI_GOOD, or an exit code after a
 * message; release in any case. Borrows the values. */
int cli_around_read(cli_around *around, const cli_around_values *values, const cli_reading *reading,
                    bool is_quiet);
void cli_around_release(cli_around *around);

/* Subject of a clip among all that; warns when one of two clips ends first. */
int cli_around_subject(kg_subject **subject, const cli_around *around, const kg_clip *clip,
                       const cli_reading *reading, bool is_quiet);

/* Files of the options, and those found through them; their number. Some may be NULL. */
enum { CLI_MAX_AROUND_PATHS = 1 + CLI_MAX_PATHS, CLI_MAX_AROUND_FOUND = 1 + CLI_MAX_MESHES };
int cli_around_paths(const cli_around_values *values, const char *paths[CLI_MAX_AROUND_PATHS]);
int cli_around_found(const cli_around *around, const char *paths[CLI_MAX_AROUND_FOUND]);

/* The rows "scene" and "with", of what there is; the objects "scene" and "other". */
void cli_print_around(FILE *out, const cli_around *around, const kg_subject *subject);
void cli_report_around(json_t *root, const cli_around *around, const kg_subject *subject);

#endif
