/* Parsing of a command's words by its option table.
 *
 * --name VALUE, --name=VALUE, -x VALUE, -xVALUE; options and files in any order; -- ends options.
 * Numbers are read with strtod in the C locale: the program never calls setlocale. */
#include "cli/options.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "cli/messages.h"

enum { MAX_WORD = 64, MAX_NAMES = 64 };

typedef struct match {
  const cli_option *option; /* NULL: no such option */
  void *value;
} match;

typedef struct parser {
  const cli_command *command;
  int argc;
  char *const *argv;
  int next; /* word to be read */
  void *values;
} parser;

static int smallest(int a, int b, int c)
{
  const int ab = a < b ? a : b;
  return ab < c ? ab : c;
}

/* Edits (insert, delete, replace, swap of neighbours) that turn a into b: optimal string alignment.
 * Words longer than MAX_WORD are infinitely far. */
static int edit_distance(const char *a, const char *b)
{
  const size_t m = strlen(a), n = strlen(b);
  if (m >= MAX_WORD || n >= MAX_WORD) {
    return MAX_WORD;
  }
  int d[MAX_WORD + 1][MAX_WORD + 1];
  for (size_t i = 0; i <= m; i++) {
    d[i][0] = (int)i;
  }
  for (size_t j = 0; j <= n; j++) {
    d[0][j] = (int)j;
  }
  for (size_t i = 1; i <= m; i++) {
    for (size_t j = 1; j <= n; j++) {
      const int change = a[i - 1] != b[j - 1];
      d[i][j] = smallest(d[i - 1][j] + 1, d[i][j - 1] + 1, d[i - 1][j - 1] + change);
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1]) {
        d[i][j] = smallest(d[i][j], d[i - 2][j - 2] + 1, d[i][j]);
      }
    }
  }
  return d[m][n];
}

const char *cli_nearest(const char *typed, const char *const *names, int count)
{
  const char *best = NULL;
  int best_distance = strlen(typed) > 3 ? 3 : 2; /* must be smaller */
  for (int i = 0; i < count; i++) {
    const int distance = edit_distance(typed, names[i]);
    if (distance < best_distance) {
      best_distance = distance;
      best = names[i];
    }
  }
  const size_t length = strlen(typed);
  for (int i = 0; !best && length > 2 && i < count; i++) { /* an abbreviation */
    if (names[i] && strncmp(typed, names[i], length) == 0) {
      best = names[i];
    }
  }
  return best;
}

static match find(const parser *p, const char *name, size_t length, char letter)
{
  for (int g = 0; g < p->command->group_count; g++) {
    const cli_group *group = &p->command->groups[g];
    for (int i = 0; i < group->count; i++) {
      const cli_option *option = &group->options[i];
      const bool is_named =
        name && strlen(option->name) == length && strncmp(option->name, name, length) == 0;
      if (is_named || (!name && option->letter == letter)) {
        return (match){option, (char *)p->values + group->offset + option->offset};
      }
    }
  }
  return (match){NULL, NULL};
}

static cli_parsed unknown_option(const parser *p, const char *name, size_t length)
{
  const char *names[MAX_NAMES] = {"help"};
  int count = 1;
  for (int g = 0; g < p->command->group_count; g++) {
    for (int i = 0; i < p->command->groups[g].count && count < MAX_NAMES; i++) {
      names[count++] = p->command->groups[g].options[i].name;
    }
  }
  char word[MAX_WORD];
  snprintf(word, sizeof word, "%.*s", (int)(length < MAX_WORD ? length : MAX_WORD - 1), name);
  const char *nearest = cli_nearest(word, names, count);
  if (nearest) {
    cli_message("unknown option --%s of '%s'; did you mean --%s?", word, p->command->name, nearest);
  } else {
    cli_message("unknown option --%s of '%s'; 'kinegrad %s -h' lists the options", word,
                p->command->name, p->command->name);
  }
  return CLI_WRONG;
}

static const char *unit_text(const cli_option *option)
{
  return option->unit ? option->unit : "no unit";
}

static bool read_number(const cli_option *option, const char *text, double *number)
{
  char *end = NULL;
  *number = strtod(text, &end);
  const bool is_plain = strspn(text, "0123456789+-.eE") == strlen(text); /* no hex, no "inf" */
  if (end == text || *end != '\0' || !is_plain || !isfinite(*number)) {
    cli_message("--%s: '%s' is not a number (%s)", option->name, text, unit_text(option));
    return false;
  }
  if (!(*number >= option->minimum && *number <= option->maximum)) {
    cli_message("--%s: %s is out of range, expected %g to %g (%s)", option->name, text,
                option->minimum, option->maximum, unit_text(option));
    return false;
  }
  return true;
}

static bool read_int(const cli_option *option, const char *text, int *number)
{
  char *end = NULL;
  errno = 0;
  const long value = strtol(text, &end, 10);
  if (end == text || *end != '\0' || strspn(text, "0123456789+-") != strlen(text)) {
    cli_message("--%s: '%s' is not a whole number", option->name, text);
    return false;
  }
  if (errno == ERANGE || (double)value < option->minimum || (double)value > option->maximum) {
    cli_message("--%s: %s is out of range, expected %g to %g", option->name, text, option->minimum,
                option->maximum);
    return false;
  }
  *number = (int)value;
  return true;
}

static bool read_choice(const cli_option *option, const char *text, int *index)
{
  const size_t length = strlen(text);
  const char *word = option->choices;
  for (int i = 0; word; i++) {
    const size_t word_length = strcspn(word, "|");
    if (word_length == length && strncmp(word, text, length) == 0) {
      *index = i;
      return true;
    }
    word = word[word_length] ? word + word_length + 1 : NULL;
  }
  cli_message("--%s: '%s' is none of %s", option->name, text, option->choices);
  return false;
}

static bool add_path(const cli_option *option, const char *text, cli_paths *paths)
{
  if (paths->count == CLI_MAX_PATHS) {
    cli_message("--%s: given more than %d times", option->name, CLI_MAX_PATHS);
    return false;
  }
  paths->path[paths->count++] = text;
  return true;
}

static bool store(const match *found, const char *text)
{
  switch (found->option->kind) {
    case CLI_FLAG:
      *(bool *)found->value = true;
      return true;
    case CLI_INT:
      return read_int(found->option, text, found->value);
    case CLI_NUMBER:
      return read_number(found->option, text, found->value);
    case CLI_PATH:
      *(const char **)found->value = text;
      return true;
    case CLI_PATHS:
      return add_path(found->option, text, found->value);
    case CLI_CHOICE:
      return read_choice(found->option, text, found->value);
  }
  return false;
}

/* attached: what stands behind = or right behind the letter, NULL when nothing does */
static bool take(parser *p, const match *found, const char *attached)
{
  const cli_option *option = found->option;
  if (option->kind == CLI_FLAG) {
    if (attached) {
      cli_message("--%s takes no value", option->name);
      return false;
    }
    return store(found, NULL);
  }
  const bool is_path = option->kind == CLI_PATH || option->kind == CLI_PATHS;
  if (!attached) {
    const char *word = p->next < p->argc ? p->argv[p->next] : NULL;
    if (!word || (is_path && word[0] == '-' && word[1] != '\0')) {
      cli_message("--%s needs a value: --%s <%s>", option->name, option->name, option->value_name);
      return false;
    }
    attached = word;
    p->next++;
  }
  if (is_path && attached[0] == '\0') {
    cli_message("--%s: the file name is empty", option->name);
    return false;
  }
  return store(found, attached);
}

static cli_parsed parse_long(parser *p, const char *word)
{
  const size_t length = strcspn(word, "=");
  if (strcmp(word, "help") == 0) {
    return CLI_WANTS_HELP;
  }
  const match found = find(p, word, length, 0);
  if (!found.option) {
    return unknown_option(p, word, length);
  }
  return take(p, &found, word[length] ? word + length + 1 : NULL) ? CLI_PARSED : CLI_WRONG;
}

static cli_parsed parse_letter(parser *p, const char *word)
{
  if (strcmp(word, "h") == 0) {
    return CLI_WANTS_SHORT_HELP;
  }
  const match found = find(p, NULL, 0, word[0]);
  if (!found.option && word[1]) { /* -dt for --dt */
    return unknown_option(p, word, strcspn(word, "="));
  }
  if (!found.option) {
    cli_message("unknown option -%c of '%s'; 'kinegrad %s -h' lists the options", word[0],
                p->command->name, p->command->name);
    return CLI_WRONG;
  }
  return take(p, &found, word[1] ? word + 1 : NULL) ? CLI_PARSED : CLI_WRONG;
}

static cli_parsed add_operand(const parser *p, const char *word, cli_operands *operands)
{
  if (word[0] == '\0') {
    cli_message("'%s': a file name is empty", p->command->name);
    return CLI_WRONG;
  }
  if (operands->count < CLI_MAX_OPERANDS) {
    operands->at[operands->count] = word;
  }
  operands->count++;
  return CLI_PARSED;
}

cli_parsed cli_parse(const cli_command *command, int argc, char *const *argv, void *values,
                     cli_operands *operands)
{
  parser p = {.command = command, .argc = argc, .argv = argv, .values = values};
  memcpy(values, command->defaults, command->values_size);
  *operands = (cli_operands){0};

  bool is_options_over = false;
  while (p.next < argc) {
    const char *word = argv[p.next++];
    cli_parsed parsed = CLI_PARSED;
    if (is_options_over || word[0] != '-' || word[1] == '\0') {
      parsed = add_operand(&p, word, operands);
    } else if (strcmp(word, "--") == 0) {
      is_options_over = true;
    } else if (word[1] == '-') {
      parsed = parse_long(&p, word + 2);
    } else {
      parsed = parse_letter(&p, word + 1);
    }
    if (parsed != CLI_PARSED) {
      return parsed;
    }
  }
  if (operands->count < command->operand_count ||
      operands->count > command->operand_count + command->optional_count) {
    cli_message("'%s' takes %s, %d given; usage: kinegrad %s %s", command->name,
                command->operands_text, operands->count, command->name, command->usage);
    return CLI_WRONG;
  }
  return CLI_PARSED;
}
