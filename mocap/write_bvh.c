/* BVH writer: the HIERARCHY section as it came, the motion from the clip's channel values. Every
 * number reads back as the same double (kg_print_number). */
#include "mocap/mocap.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static void write_motion(const kg_clip *clip, FILE *file)
{
  const kg_clip_memory *memory = kg_clip_private(clip);
  const char *newline = memory->newline;
  fprintf(file, "MOTION%sFrames: %d%sFrame Time: %s%s", newline, clip->frame_count, newline,
          memory->frame_time_text, newline);
  const size_t C = (size_t)clip->channel_count;
  for (size_t t = 0; t < (size_t)clip->frame_count; t++) {
    for (size_t c = 0; c < C; c++) {
      char text[KG_NUMBER_TEXT + 1];
      size_t length = kg_print_number(text, clip->values[t * C + c]);
      if (c + 1 < C) {
        text[length++] = ' ';
      }
      fwrite(text, 1, length, file);
    }
    fputs(newline, file);
  }
}

static bool write_all(const kg_clip *clip, FILE *file)
{
  const kg_word hierarchy = kg_clip_private(clip)->hierarchy;
  fwrite(hierarchy.start, 1, hierarchy.length, file);
  write_motion(clip, file);
  const bool good = fflush(file) == 0 && !ferror(file);
  return fclose(file) == 0 && good;
}

/* A new file beside the target with ordinary permissions (mkstemp's are private); -1 on failure. */
static int open_beside(const char *path, char *temporary, size_t size)
{
  for (int attempt = 0; attempt < 100; attempt++) {
    const int length = snprintf(temporary, size, "%s.part%d", path, attempt);
    if (length < 0 || (size_t)length >= size) {
      errno = ENAMETOOLONG;
      return -1;
    }
    const int descriptor = open(temporary, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
    if (descriptor >= 0 || errno != EEXIST) {
      return descriptor;
    }
  }
  return -1;
}

static bool is_special(const char *path)
{
  struct stat status;
  return stat(path, &status) == 0 && !S_ISREG(status.st_mode);
}

kg_status kg_clip_write_bvh(const kg_clip *clip, const char *path, kg_error *error)
{
  /* a pipe or device is written to; only an ordinary file can be replaced. */
  const bool replace = !is_special(path);
  char temporary[4096];
  const int descriptor =
    replace ? open_beside(path, temporary, sizeof temporary) : open(path, O_WRONLY | O_CLOEXEC);
  if (descriptor < 0) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be created: %s", strerror(errno));
  }
  FILE *file = fdopen(descriptor, "wb");
  errno = file ? 0 : errno;
  if (!file) {
    close(descriptor);
  }
  if (!file || !write_all(clip, file) || (replace && rename(temporary, path) != 0)) {
    const int reason = errno;
    if (replace) {
      unlink(temporary);
    }
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be written: %s", strerror(reason));
  }
  return KG_OK;
}
