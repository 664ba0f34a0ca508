/* Progress of a long computation on stderr: one line redrawn on a terminal, or JSON Lines. */
#ifndef CLI_PROGRESS_H
#define CLI_PROGRESS_H

#include <stdbool.h>

typedef enum cli_progress_style {
  CLI_PROGRESS_AUTO, /* the line when stderr is a terminal, else nothing */
  CLI_PROGRESS_JSON,
  CLI_PROGRESS_NONE
} cli_progress_style;

typedef struct cli_progress {
  cli_progress_style style; /* AUTO is resolved by cli_progress_start */
  bool draws;
  int frames;         /* of the whole clip; 0: there is none */
  double start, last; /* s, monotonic      */
} cli_progress;

cli_progress cli_progress_start(cli_progress_style style, bool is_quiet, int frames);
/* A kg_progress_fn; user is the cli_progress. False once the program was interrupted. */
bool cli_progress_update(double share, const char *stage, void *user);
/* Takes the line off the terminal, when one is there. */
void cli_progress_clear(void);

#endif
