/* The files a command writes: all of them appear complete, or none does.
 *
 * cli_outputs_open() makes an empty file beside each target, so that a path that cannot be written
 * is found out before the computation. The command writes to these; main() renames them with
 * cli_outputs_publish(), or removes them when the command failed or was interrupted. */
#ifndef CLI_OUTPUTS_H
#define CLI_OUTPUTS_H

#include <stdbool.h>
#include <stdio.h>

enum { CLI_MAX_OUTPUTS = 4, CLI_MAX_PATH = 4096 };

typedef struct cli_output {
  char target[CLI_MAX_PATH];    /* symbolic links resolved                              */
  char temporary[CLI_MAX_PATH]; /* beside it; the target itself for a pipe or a device  */
  bool is_device;
} cli_output;

/* Catches SIGINT, SIGTERM and SIGHUP. The first is noted, the second ends the process at once. */
void cli_outputs_init(void);
bool cli_interrupted(void);

/* NULL after a message: the path cannot be written. */
cli_output *cli_outputs_open(const char *path);
/* True after a message: what `option` writes to is one of the regular files that are read, by
 * whatever name. path and inputs may be NULL. */
bool cli_is_input(const char *option, const char *path, const char *const *inputs, int count);
/* A stream on the temporary; cli_outputs_close is false after a message when not all was
 * written. */
FILE *cli_output_stream(cli_output *output);
bool cli_output_close(cli_output *output, FILE *stream);
/* False after a message; then no output remains. */
bool cli_outputs_publish(void);
/* Removes what was not published. */
void cli_outputs_discard(void);

#endif
