/* Time and memory of the process. */
#ifndef BENCH_CLOCK_H
#define BENCH_CLOCK_H

#include "kinegrad/base.h"

typedef struct kg_bench_time {
  double cpu, wall; /* s */
} kg_bench_time;

kg_bench_time kg_bench_now(void);

/* An allocator over malloc that keeps count. */
typedef struct kg_bench_heap {
  size_t live, peak; /* bytes */
  long calls;        /* allocations */
} kg_bench_heap;

kg_allocator kg_bench_heap_allocator(kg_bench_heap *heap);

/* Memory the process holds, bytes; NAN where the system does not tell. */
double kg_bench_resident(void);
/* The most it has held since kg_bench_reset_peak(); NAN where the peak cannot be set back. */
void kg_bench_reset_peak(void);
double kg_bench_peak(void);

#endif
