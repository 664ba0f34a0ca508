/* bench/autodiff/nets_kinegrad.h - gradients of the nets by kinegrad, in single precision, written
 * as a user writes them: create, run and destroy of kg_bench_contestant; data: kg_bench_net;
 * answer: loss, gradient.
 * "recorded": parameters stay on the tape, everything behind them is recorded anew for each answer.
 * "replayed": recorded once and frozen; an answer is a run and a backward sweep. */
#ifndef BENCH_AUTODIFF_NETS_KINEGRAD_H
#define BENCH_AUTODIFF_NETS_KINEGRAD_H

#include "bench/autodiff/problems.h"

kg_status kg_net_recorded_create(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_net_recorded_run(void *state, double *answer);
kg_status kg_net_replayed_create(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_net_replayed_run(void *state, double *answer);
void kg_net_destroy(void *state);

#endif
