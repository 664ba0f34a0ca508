/* Runs a fuzz target over the files of a folder, as an ordinary test: replay FOLDER. With
 * --mutate N also over N random changes of each file; same program, same changes. */
#include "fuzz.h"

#include <dirent.h>

#include "kinegrad/random.h"

enum { MOST_BYTES = 1 << 20 };

static size_t read_all(const char *path, uint8_t *data)
{
  FILE *file = fopen(path, "rb");
  if (!file) {
    return 0;
  }
  const size_t size = fread(data, 1, MOST_BYTES, file);
  fclose(file);
  return size;
}

/* exact size, so that the sanitizers see every byte read beyond the end */
static void run_once(const uint8_t *data, size_t size)
{
  uint8_t *copy = malloc(size > 0 ? size : 1);
  FUZZ_CHECK(copy != NULL);
  memcpy(copy, data, size);
  LLVMFuzzerTestOneInput(copy, size);
  free(copy);
}

/* bytes changed, dropped or doubled, the end cut off */
static size_t mutate(uint8_t *out, const uint8_t *data, size_t size, kg_random *random)
{
  static const char alphabet[] = "0123456789.-+eE{}:#% \t\r\nXYZxnaif";
  size_t n = 0;
  const double rate = 3.0 / (double)(size + 1);
  for (size_t i = 0; i < size && n + 2 < MOST_BYTES; i++) {
    const double u = kg_random_uniform(random);
    const uint64_t pick = kg_random_bits(random);
    if (u < rate) {
      out[n++] = (uint8_t)alphabet[pick % (sizeof alphabet - 1)];
    } else if (u < 1.3 * rate) {
      continue;
    } else if (u < 1.6 * rate) {
      out[n++] = data[i];
      out[n++] = data[i];
    } else {
      out[n++] = data[i];
    }
  }
  return kg_random_bits(random) % 4 ? n : kg_random_bits(random) % (n + 1);
}

int main(int argc, char **argv)
{
  static uint8_t data[MOST_BYTES], changed[MOST_BYTES];
  const int mutations = argc > 3 && strcmp(argv[2], "--mutate") == 0 ? atoi(argv[3]) : 0;
  DIR *folder = argc > 1 ? opendir(argv[1]) : NULL;
  kg_random random = kg_random_make(5);
  int files = 0;
  if (!folder) {
    fprintf(stderr, "usage: %s FOLDER [--mutate N]\n", argv[0]);
    return 2;
  }
  for (struct dirent *entry; (entry = readdir(folder)) != NULL;) {
    char path[1024];
    if (entry->d_name[0] == '.') {
      continue;
    }
    snprintf(path, sizeof path, "%s/%s", argv[1], entry->d_name);
    const size_t size = read_all(path, data);
    run_once(data, size);
    for (int m = 0; m < mutations; m++) {
      run_once(changed, mutate(changed, data, size, &random));
    }
    files++;
  }
  closedir(folder);
  printf("%d files\n", files);
  return files > 0 ? 0 : 1;
}
