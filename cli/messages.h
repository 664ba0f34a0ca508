/* Messages on stderr: "kinegrad: path:line:column: what, and what was expected". */
#ifndef CLI_MESSAGES_H
#define CLI_MESSAGES_H

#include <stdbool.h>

#include "kinegrad/base.h"

/* Exit codes of the command; `kinegrad help exit-codes` explains them. */
enum {
  CLI_GOOD = 0,
  CLI_ANSWER_IS_NO = 1,
  CLI_USAGE = 2,
  CLI_INPUT = 3,
  CLI_OUTPUT = 4,
  CLI_INTERRUPTED = 130
};

/* One line, "kinegrad: " in front. Takes the progress line off the terminal first. */
void cli_message(const char *format, ...) KG_PRINTF(1, 2);
/* The same with "kinegrad: warning: "; nothing when quiet. */
void cli_warning(bool is_quiet, const char *format, ...) KG_PRINTF(2, 3);

/* Prints the error and returns the exit code that belongs to its status. */
int cli_failed(const kg_error *error);
/* The same for a status that came without detail; what: the thing that was tried. */
int cli_failed_status(kg_status status, const char *what);

#endif
