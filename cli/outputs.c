/* Output files that appear complete or not at all, and the signals that interrupt writing them. */
#include "cli/outputs.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "cli/messages.h"

/* State of the process, not of a library: what a signal handler must be able to remove. */
static cli_output outputs[CLI_MAX_OUTPUTS];
static volatile sig_atomic_t output_count;
static volatile sig_atomic_t interrupt_count;

void cli_outputs_discard(void)
{
  for (int i = 0; i < output_count; i++) {
    if (!outputs[i].is_device && outputs[i].temporary[0]) {
      unlink(outputs[i].temporary);
    }
  }
  output_count = 0;
}

/* unlink and _exit are async-signal-safe */
static void on_signal(int signal)
{
  (void)signal;
  interrupt_count++;
  if (interrupt_count > 1) {
    cli_outputs_discard();
    _exit(CLI_INTERRUPTED);
  }
}

void cli_outputs_init(void)
{
  struct sigaction action = {.sa_handler = on_signal};
  sigemptyset(&action.sa_mask);
  sigaction(SIGINT, &action, NULL);
  sigaction(SIGTERM, &action, NULL);
  sigaction(SIGHUP, &action, NULL);
  action.sa_handler = SIG_IGN; /* a reader that has seen enough is not an error */
  sigaction(SIGPIPE, &action, NULL);
}

bool cli_interrupted(void)
{
  return interrupt_count > 0;
}

static cli_output *refuse(const char *path, const char *why)
{
  cli_message("%s: cannot be written: %s", path, why);
  return NULL;
}

/* target: path, or where its symbolic links lead. False when the name is too long. */
static bool resolve(char target[CLI_MAX_PATH], const char *path)
{
  char *real = realpath(path, NULL);
  const int length = snprintf(target, CLI_MAX_PATH, "%s", real ? real : path);
  free(real);
  return length > 0 && length < CLI_MAX_PATH - 64;
}

/* Creates the empty file beside the target. */
static bool create_temporary(cli_output *output)
{
  char *name = output->temporary;
  memcpy(name, output->target, sizeof output->temporary);
  char *slash = strrchr(name, '/');
  char *file = slash ? slash + 1 : name;
  snprintf(file, 64, ".kinegrad-%ld-%d", (long)getpid(), (int)output_count); /* see resolve */
  unlink(output->temporary); /* left by a process of the same number that was killed */
  const int fd = open(output->temporary, O_WRONLY | O_CREAT | O_EXCL, 0666);
  if (fd >= 0) {
    close(fd);
  }
  return fd >= 0;
}

cli_output *cli_outputs_open(const char *path)
{
  cli_output *output = &outputs[output_count];
  *output = (cli_output){0};
  if (!resolve(output->target, path)) {
    return refuse(path, "the name is too long");
  }
  for (int i = 0; i < output_count; i++) {
    if (strcmp(outputs[i].target, output->target) == 0) {
      return refuse(path, "it is named for two outputs");
    }
  }
  struct stat status;
  const bool exists = stat(output->target, &status) == 0;
  if (exists && S_ISDIR(status.st_mode)) {
    return refuse(path, "it is a folder, expected a file name");
  }
  if (exists && access(output->target, W_OK) != 0) {
    return refuse(path, strerror(errno));
  }
  output->is_device = exists && !S_ISREG(status.st_mode);
  if (output->is_device) {
    memcpy(output->temporary, output->target, sizeof output->temporary);
  } else if (!create_temporary(output)) {
    return refuse(path, strerror(errno));
  }
  output_count++;
  return output;
}

bool cli_is_input(const char *option, const char *path, const char *const *inputs, int count)
{
  struct stat out, in;
  if (!path || stat(path, &out) != 0 || !S_ISREG(out.st_mode)) {
    return false;
  }
  for (int i = 0; i < count; i++) {
    if (inputs[i] && stat(inputs[i], &in) == 0 && in.st_dev == out.st_dev &&
        in.st_ino == out.st_ino) {
      cli_message("%s: '%s' is read by this run, expected a file of its own", option, path);
      return true;
    }
  }
  return false;
}

FILE *cli_output_stream(cli_output *output)
{
  FILE *stream = fopen(output->temporary, "wb");
  if (!stream) {
    refuse(output->target, strerror(errno));
  }
  return stream;
}

bool cli_output_close(cli_output *output, FILE *stream)
{
  const bool is_good = fflush(stream) == 0 && !ferror(stream);
  const int why = errno;
  const bool is_closed = fclose(stream) == 0;
  if (!is_good || !is_closed) {
    refuse(output->target, strerror(is_good ? errno : why));
    return false;
  }
  return true;
}

bool cli_outputs_publish(void)
{
  for (int i = 0; i < output_count; i++) {
    if (!outputs[i].is_device && rename(outputs[i].temporary, outputs[i].target) != 0) {
      refuse(outputs[i].target, strerror(errno));
      for (int k = 0; k < i; k++) {
        if (!outputs[k].is_device) {
          unlink(outputs[k].target);
        }
      }
      cli_outputs_discard();
      return false;
    }
    outputs[i].temporary[0] = '\0';
  }
  output_count = 0;
  return true;
}
