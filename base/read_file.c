/* Files and pipes, read to their end. */
#include "base/read_file.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <string.h>

static kg_status read_stream(char **content, size_t *length, kg_arena *arena, FILE *file)
{
  size_t capacity = 0, n = 0;
  if (fseek(file, 0, SEEK_END) == 0) { /* a pipe has no size: grow as it comes */
    const long size = ftell(file);
    capacity = size > 0 && size < LONG_MAX / 2 ? (size_t)size + 1 : 0;
    rewind(file);
  }
  capacity = capacity > 65536 ? capacity : 65536;
  char *buffer = KG_ARENA_ARRAY(arena, char, capacity);
  while (buffer) {
    n += fread(buffer + n, 1, capacity - n, file);
    if (n < capacity) {
      break;
    }
    char *larger = KG_ARENA_ARRAY(arena, char, 2 * capacity);
    if (larger) {
      memcpy(larger, buffer, n);
    }
    buffer = larger;
    capacity *= 2;
  }
  *content = buffer;
  *length = n;
  return buffer ? KG_OK : KG_ERR_NO_MEMORY;
}

kg_status kg_read_file(char **content, size_t *length, kg_arena *arena, const char *path,
                       kg_error *error)
{
  errno = 0;
  FILE *file = fopen(path, "rb");
  if (!file) {
    return kg_fail(error, KG_ERR_READ, path, 0, 0, "cannot be opened: %s", strerror(errno));
  }
  const kg_status status = read_stream(content, length, arena, file);
  const bool broken = ferror(file) != 0;
  const int reason = errno;
  fclose(file);
  if (broken) {
    return kg_fail(error, KG_ERR_READ, path, 0, 0, "cannot be read: %s", strerror(reason));
  }
  return status == KG_OK ? KG_OK
                         : kg_fail(error, status, path, 0, 0, "not enough memory for the file");
}
