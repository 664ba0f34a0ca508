/* Time and memory of the process (Linux tells the latter in /proc/self). */
#include "bench/clock.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifdef __GLIBC__
#include <malloc.h>
#endif

static double seconds(clockid_t clock)
{
  struct timespec t = {0, 0};
  clock_gettime(clock, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

kg_bench_time kg_bench_now(void)
{
  return (kg_bench_time){seconds(CLOCK_PROCESS_CPUTIME_ID), seconds(CLOCK_MONOTONIC)};
}

static void *counted_alloc(size_t bytes, void *user)
{
  kg_bench_heap *heap = user;
  void *memory = malloc(bytes);
  if (memory) {
    heap->calls++;
    heap->live += bytes;
    heap->peak = heap->live > heap->peak ? heap->live : heap->peak;
  }
  return memory;
}

static void counted_free(void *memory, size_t bytes, void *user)
{
  kg_bench_heap *heap = user;
  if (memory) {
    heap->live -= bytes;
  }
  free(memory);
}

kg_allocator kg_bench_heap_allocator(kg_bench_heap *heap)
{
  return (kg_allocator){counted_alloc, counted_free, heap};
}

/* a line "KEY:   1234 kB" of /proc/self/status, in bytes */
static double status_line(const char *key)
{
  FILE *file = fopen("/proc/self/status", "r");
  char line[256];
  double kilobytes = NAN;
  const size_t length = strlen(key);
  while (file && fgets(line, sizeof line, file)) {
    if (strncmp(line, key, length) == 0 && line[length] == ':') {
      kilobytes = strtod(line + length + 1, NULL);
    }
  }
  if (file) {
    fclose(file);
  }
  return 1024.0 * kilobytes;
}

double kg_bench_resident(void)
{
  return status_line("VmRSS");
}

void kg_bench_reset_peak(void)
{
#ifdef __GLIBC__
  malloc_trim(0); /* what was freed before must not hide what is taken now */
#endif
  FILE *file = fopen("/proc/self/clear_refs", "w");
  if (file) {
    fputs("5\n", file);
    fclose(file);
  }
}

double kg_bench_peak(void)
{
  return status_line("VmHWM");
}
