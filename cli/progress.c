/* Progress line: share, stage, frames per second, time left. At most ten updates a second. */
#include "cli/progress.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "cli/outputs.h"

/* the one terminal this process has: is a progress line on it now? */
static bool line_is_shown;

static double now(void)
{
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static bool is_drawable(void)
{
  const char *term = getenv("TERM");
  return isatty(STDERR_FILENO) && term && strcmp(term, "dumb") != 0;
}

cli_progress cli_progress_start(cli_progress_style style, bool is_quiet, int frames)
{
  cli_progress progress = {.style = style, .frames = frames, .start = now(), .last = -1.0};
  progress.draws =
    !is_quiet && (style == CLI_PROGRESS_JSON || (style == CLI_PROGRESS_AUTO && is_drawable()));
  return progress;
}

void cli_progress_clear(void)
{
  if (line_is_shown) {
    fputs("\r\033[K", stderr);
    line_is_shown = false;
  }
}

static void draw(const cli_progress *progress, double share, const char *stage, double elapsed)
{
  const double done = share * progress->frames;
  const double fps = elapsed > 0.0 ? done / elapsed : 0.0;
  const double left = share > 0.0 ? elapsed * (1.0 - share) / share : 0.0;
  if (progress->style == CLI_PROGRESS_JSON) {
    fprintf(stderr,
            "{\"stage\": \"%s\", \"share\": %.4f, \"frames\": %d, \"frames_done\": %.0f, "
            "\"frames_per_s\": %.1f, \"left_s\": %.1f}\n",
            stage, share, progress->frames, done, fps, left);
    return;
  }
  fprintf(stderr, "\r\033[K%-12s %3.0f %%", stage, 100.0 * share);
  if (progress->frames > 0) {
    fprintf(stderr, "  %.0f/%d frames  %.0f fps", done, progress->frames, fps);
  }
  fprintf(stderr, "  ETA %.0f s", left);
  line_is_shown = true;
}

bool cli_progress_update(double share, const char *stage, void *user)
{
  cli_progress *progress = user;
  const double elapsed = now() - progress->start;
  const bool is_due = progress->last < 0.0 || elapsed - progress->last >= 0.1 || share >= 1.0;
  if (progress->draws && is_due) {
    draw(progress, share, stage, elapsed);
    progress->last = elapsed;
  }
  return !cli_interrupted();
}
