/* The kinegrad command: dispatch, help topics, version.
 *
 * stdout gets the result of a command in one piece, and only when there is one (exit code 0 or 1);
 * then the files it wrote take their names.
 * The program never calls setlocale: numbers are read and written with a point everywhere. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "cli/commands.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/outputs.h"
#include "cli/topics.h"

#define CLI_ADDRESS(name) &cli_command_##name,
static const cli_command *const commands[] = {CLI_COMMAND_LIST(CLI_ADDRESS)};
#undef CLI_ADDRESS
enum { COMMAND_COUNT = KG_COUNT_OF(commands), MAX_WORDS = 32 };

static const cli_command *find_command(const char *name)
{
  for (int i = 0; i < COMMAND_COUNT; i++) {
    if (strcmp(commands[i]->name, name) == 0) {
      return commands[i];
    }
  }
  return NULL;
}

static void print_overview(FILE *out)
{
  fputs("kinegrad: captured sports motion in, motion that obeys physics out.\n\n"
        "Usage: kinegrad <command> [options] <file>...\n\n",
        out);
  for (int i = 0; i < COMMAND_COUNT; i++) {
    fprintf(out, "  %-9s  %s\n", commands[i]->name, commands[i]->summary);
  }
  fputs("\nExamples:\n"
        "  kinegrad info walk.bvh\n"
        "  kinegrad correct walk.bvh -o walk_fixed.bvh --json report.json\n"
        "  kinegrad eval walk.bvh walk_fixed.bvh\n\n"
        "kinegrad <command> -h lists its options, --help explains them.\n"
        "kinegrad help <topic> for",
        out);
  for (int i = 0; i < cli_topic_count; i++) {
    fprintf(out, "%s %s", i > 0 ? "," : "", cli_topics[i].name);
  }
  fputs(".\nkinegrad --version\n", out);
}

/* Commands, topics and the words in front of them, for did-you-mean. */
static int unknown(const char *kind, const char *name, bool with_topics)
{
  const char *words[MAX_WORDS] = {"help"};
  int count = 1;
  for (int i = 0; i < COMMAND_COUNT; i++) {
    words[count++] = commands[i]->name;
  }
  for (int i = 0; with_topics && i < cli_topic_count; i++) {
    words[count++] = cli_topics[i].name;
  }
  const char *nearest = cli_nearest(name, words, count);
  if (nearest) {
    cli_message("unknown %s '%s'; did you mean '%s'?", kind, name, nearest);
  } else {
    cli_message("unknown %s '%s'; 'kinegrad --help' lists what there is", kind, name);
  }
  return CLI_USAGE;
}

static int help(int argc, char *const *argv, FILE *out)
{
  if (argc == 0 || strcmp(argv[0], "help") == 0) {
    print_overview(out);
    return CLI_GOOD;
  }
  const cli_command *command = find_command(argv[0]);
  if (command) {
    cli_print_help(out, command, true);
    return CLI_GOOD;
  }
  for (int i = 0; i < cli_topic_count; i++) {
    if (strcmp(cli_topics[i].name, argv[0]) == 0) {
      cli_topics[i].print(out);
      return CLI_GOOD;
    }
  }
  return unknown("topic", argv[0], true);
}

static int run_command(const cli_command *command, int argc, char *const *argv, FILE *out)
{
  cli_operands operands;
  void *values = malloc(command->values_size);
  if (!values) {
    return cli_failed_status(KG_ERR_NO_MEMORY, command->name);
  }
  const cli_parsed parsed = cli_parse(command, argc, argv, values, &operands);
  int code = CLI_USAGE;
  if (parsed == CLI_PARSED) {
    code = command->run(values, &operands, out);
  } else if (parsed != CLI_WRONG) {
    cli_print_help(out, command, parsed == CLI_WANTS_HELP);
    code = CLI_GOOD;
  }
  free(values);
  return code;
}

static int dispatch(int argc, char *const *argv, FILE *out)
{
  if (argc < 2) {
    cli_message("a command is missing; 'kinegrad --help' lists them");
    return CLI_USAGE;
  }
  const char *word = argv[1];
  if (strcmp(word, "--help") == 0 || strcmp(word, "-h") == 0) {
    print_overview(out);
    return CLI_GOOD;
  }
  if (strcmp(word, "--version") == 0) {
    fprintf(out, "kinegrad %s\n", KG_VERSION);
    return CLI_GOOD;
  }
  if (strcmp(word, "help") == 0) {
    return help(argc - 2, argv + 2, out);
  }
  if (word[0] == '-') {
    cli_message("unknown option %s; a command comes first: kinegrad <command> [options]", word);
    return CLI_USAGE;
  }
  const cli_command *command = find_command(word);
  return command ? run_command(command, argc - 2, argv + 2, out) : unknown("command", word, false);
}

/* A closed pipe is no error: its reader has seen enough. */
static bool print_result(const char *text, size_t length)
{
  if (fwrite(text, 1, length, stdout) == length && fflush(stdout) == 0) {
    return true;
  }
  const int why = errno;
  if (why != EPIPE) {
    cli_message("standard output cannot be written: %s", strerror(why));
  }
  return why == EPIPE;
}

int main(int argc, char **argv)
{
  cli_outputs_init();
  cli_json_init();
  char *text = NULL;
  size_t length = 0;
  FILE *out = open_memstream(&text, &length);
  if (!out) {
    return cli_failed_status(KG_ERR_NO_MEMORY, "kinegrad");
  }
  int code = dispatch(argc, argv, out);
  if (fclose(out) != 0) {
    code = cli_failed_status(KG_ERR_NO_MEMORY, "kinegrad");
  }
  const bool is_done = code == CLI_GOOD || code == CLI_ANSWER_IS_NO;
  if (is_done && (!print_result(text, length) || !cli_outputs_publish())) {
    code = CLI_OUTPUT;
  }
  cli_outputs_discard();
  free(text);
  return code;
}
