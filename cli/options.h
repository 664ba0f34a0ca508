/* Options of a command as a table. Parser, -h, --help and the tests read the same rows, so none of
 * them can fall behind the others. Why not a library: docs/design/options.md. */
#ifndef CLI_OPTIONS_H
#define CLI_OPTIONS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

typedef enum cli_kind {
  CLI_FLAG,   /* bool                                                        */
  CLI_INT,    /* int                                                         */
  CLI_NUMBER, /* double; NAN in the defaults stands for "not given"          */
  CLI_PATH,   /* const char *, borrowed from argv                            */
  CLI_PATHS,  /* cli_paths: the option may be repeated                       */
  CLI_CHOICE  /* int, index into choices                                     */
} cli_kind;

enum { CLI_MAX_PATHS = 16 };

typedef struct cli_paths {
  int count;
  const char *path[CLI_MAX_PATHS];
} cli_paths;

typedef struct cli_option {
  char letter;      /* 0: long name only                                   */
  const char *name; /* without the dashes                                  */
  cli_kind kind;
  const char *value_name;   /* shown as <FILE>; NULL for a flag                    */
  const char *unit;         /* "s", "Hz", "m"; NULL when there is none             */
  const char *default_text; /* as the user would type it, or what happens; or NULL */
  const char *summary;      /* one line for -h                                     */
  const char *details;      /* paragraph for --help                                */
  const char *choices;      /* "sdf|track" for CLI_CHOICE                          */
  double minimum, maximum;  /* of numbers, both allowed                            */
  size_t offset;            /* into the values struct of the group                 */
} cli_option;

/* Rows under one heading; commands share groups. */
typedef struct cli_group {
  const char *title;
  const cli_option *options;
  int count;
  size_t offset; /* of the group's values in the command's values */
} cli_group;

enum { CLI_MAX_OPERANDS = 64 };

typedef struct cli_operands {
  int count;
  const char *at[CLI_MAX_OPERANDS];
} cli_operands;

typedef struct cli_command {
  const char *name;
  const char *summary;         /* one line                                       */
  const char *usage;           /* what follows "kinegrad NAME"                   */
  const char *details;         /* paragraphs for --help                          */
  const char *const *examples; /* NULL-terminated; a test runs every line        */
  const cli_group *groups;
  int group_count;
  int operand_count;         /* so many files at least                         */
  int optional_count;        /* and so many more at most                       */
  const char *operands_text; /* "one clip", for the message when there are not */
  const void *defaults;      /* values struct, copied before parsing           */
  size_t values_size;
  int (*run)(const void *values, const cli_operands *operands, FILE *out);
} cli_command;

typedef enum cli_parsed { CLI_PARSED, CLI_WANTS_SHORT_HELP, CLI_WANTS_HELP, CLI_WRONG } cli_parsed;

/* Fills values (values_size bytes, start from the defaults) and operands from argv[0..argc), the
 * words after the command's name. CLI_WRONG: one message has been printed. */
cli_parsed cli_parse(const cli_command *command, int argc, char *const *argv, void *values,
                     cli_operands *operands);

/* One line per option (short), or paragraphs with unit, default, choices and examples. */
void cli_print_help(FILE *out, const cli_command *command, bool is_long);

/* The word in names[count] nearest to what was typed, NULL when none is near enough. */
const char *cli_nearest(const char *typed, const char *const *names, int count);

#endif
