/* Help of a command, generated from its option table. */
#include <string.h>

#include "cli/options.h"

enum { WIDTH = 78 };

/* text wrapped at WIDTH behind indent blanks; a newline in text starts a new line */
static void print_wrapped(FILE *out, const char *text, int indent)
{
  int column = 0;
  while (*text) {
    if (*text == '\n') {
      fputc('\n', out);
      column = 0;
      text++;
      continue;
    }
    const int length = (int)strcspn(text, " \n");
    if (column == 0) {
      fprintf(out, "%*s", indent, "");
      column = indent;
    } else if (column + 1 + length > WIDTH) {
      fprintf(out, "\n%*s", indent, "");
      column = indent;
    } else {
      fputc(' ', out);
      column++;
    }
    fwrite(text, 1, (size_t)length, out);
    column += length;
    text += length;
    text += *text == ' ';
  }
  fputc('\n', out);
}

static void head(char *text, size_t size, const cli_option *option)
{
  char letter[8] = "    ";
  if (option->letter) {
    snprintf(letter, sizeof letter, "-%c, ", option->letter);
  }
  if (option->value_name) {
    snprintf(text, size, "%s--%s <%s>", letter, option->name, option->value_name);
  } else {
    snprintf(text, size, "%s--%s", letter, option->name);
  }
}

static void print_row(FILE *out, const cli_option *option)
{
  char text[80];
  head(text, sizeof text, option);
  fprintf(out, "  %-28s  %s\n", text, option->summary);
}

static void print_paragraph(FILE *out, const cli_option *option)
{
  char text[80];
  head(text, sizeof text, option);
  fprintf(out, "  %s\n", text);
  print_wrapped(out, option->summary, 10);
  if (option->details) {
    print_wrapped(out, option->details, 10);
  }
  if (option->choices) {
    fprintf(out, "%10sone of: %s\n", "", option->choices);
  }
  if (option->kind == CLI_NUMBER || option->kind == CLI_INT) {
    fprintf(out, "%10sunit: %s; range: %g to %g\n", "", option->unit ? option->unit : "none",
            option->minimum, option->maximum);
  }
  if (option->kind == CLI_PATHS) {
    fprintf(out, "%10smay be given up to %d times\n", "", CLI_MAX_PATHS);
  }
  if (option->default_text) {
    fprintf(out, "%10sdefault: %s\n", "", option->default_text);
  }
  fputc('\n', out);
}

static void print_examples(FILE *out, const cli_command *command)
{
  fputs("Examples:\n", out);
  for (int i = 0; command->examples[i]; i++) {
    fprintf(out, "  %s\n", command->examples[i]);
  }
}

void cli_print_help(FILE *out, const cli_command *command, bool is_long)
{
  static const cli_option help_row = {
    .letter = 'h', .name = "help", .summary = "-h: one line each; --help: everything"};

  fprintf(out, "kinegrad %s: %s\n\nUsage: kinegrad %s %s\n\n", command->name, command->summary,
          command->name, command->usage);
  if (is_long) {
    print_wrapped(out, command->details, 0);
    fputc('\n', out);
  }
  for (int g = 0; g < command->group_count; g++) {
    const cli_group *group = &command->groups[g];
    fprintf(out, "%s:\n", group->title);
    for (int i = 0; i < group->count; i++) {
      (is_long ? print_paragraph : print_row)(out, &group->options[i]);
    }
    if (g + 1 == command->group_count) {
      (is_long ? print_paragraph : print_row)(out, &help_row);
    }
    if (!is_long) {
      fputc('\n', out);
    }
  }
  print_examples(out, command);
}
