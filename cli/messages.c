/* Messages and exit codes. */
#include "cli/messages.h"

#include <stdarg.h>
#include <stdio.h>

#include "cli/progress.h"

static void print_line(const char *kind, const char *format, va_list args)
{
  cli_progress_clear();
  fprintf(stderr, "kinegrad: %s", kind);
  vfprintf(stderr, format, args);
  fputc('\n', stderr);
}

void cli_message(const char *format, ...)
{
  va_list args;
  va_start(args, format);
  print_line("", format, args);
  va_end(args);
}

void cli_warning(bool is_quiet, const char *format, ...)
{
  if (is_quiet) {
    return;
  }
  va_list args;
  va_start(args, format);
  print_line("warning: ", format, args);
  va_end(args);
}

static int exit_code(kg_status status)
{
  switch (status) {
    case KG_OK:
      return CLI_GOOD;
    case KG_ERR_UNDEFINED:
    case KG_ERR_STALE:
      return CLI_ANSWER_IS_NO;
    case KG_ERR_WRITE:
      return CLI_OUTPUT;
    case KG_ERR_NO_MEMORY: /* the input is larger than this machine can hold */
    case KG_ERR_READ:
    case KG_ERR_FORMAT:
    case KG_ERR_UNMAPPED:
    case KG_ERR_UNSUPPORTED:
    case KG_ERR_SHAPE:
      break;
  }
  return CLI_INPUT;
}

int cli_failed(const kg_error *error)
{
  const char *text = error->text[0] ? error->text : kg_status_text(error->status);
  if (!error->path[0]) {
    cli_message("%s", text);
  } else if (error->line <= 0) {
    cli_message("%s: %s", error->path, text);
  } else if (error->column <= 0) {
    cli_message("%s:%ld: %s", error->path, error->line, text);
  } else {
    cli_message("%s:%ld:%ld: %s", error->path, error->line, error->column, text);
  }
  return exit_code(error->status);
}

int cli_failed_status(kg_status status, const char *what)
{
  cli_message("%s: %s", what, kg_status_text(status));
  return exit_code(status);
}
