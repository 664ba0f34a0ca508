/* The commands. A new one is a file with its cli_command and a line here. */
#ifndef CLI_COMMANDS_H
#define CLI_COMMANDS_H

#include "cli/options.h"

/* clang-format off */
#ifdef CLI_HAS_BENCH
#define CLI_BENCH(X) X(bench)
#else
#define CLI_BENCH(X)
#endif
#define CLI_COMMAND_LIST(X)                                                                        \
  X(info)                                                                                          \
  X(correct)                                                                                       \
  X(eval)                                                                                          \
  X(gradcheck)                                                                                     \
  CLI_BENCH(X)
/* clang-format on */

#define CLI_DECLARE(name) extern const cli_command cli_command_##name;
CLI_COMMAND_LIST(CLI_DECLARE)
#undef CLI_DECLARE

#endif
