/* What the case files of this folder share. */
#ifndef BENCH_AUTODIFF_CASES_H
#define BENCH_AUTODIFF_CASES_H

#include "bench/autodiff/adolc_peer.h"
#include "bench/autodiff/problems.h"
#include "bench/bench.h"

/* ADOL-C's row of a contestants' table; without it in the build the row says so. */
#ifdef KG_BENCH_HAS_ADOLC
#define ADOLC_CONTESTANT(title, mask, create_function)                                             \
  {                                                                                                \
    .name = (title), .parts = (mask), .create = (create_function), .run = kg_adolc_run,            \
    .destroy = kg_adolc_destroy                                                                    \
  }
#else
#define ADOLC_CONTESTANT(title, mask, create_function)                                             \
  {                                                                                                \
    .name = (title), .absent = "ADOL-C was not there at build time", .parts = (mask)               \
  }
#endif

/* kinegrad's own contestants: the tape is recorded anew for every answer */
kg_status kg_bench_gmm_tape(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_bench_gmm_tape_run(void *state, double *answer);
void kg_bench_gmm_tape_destroy(void *state);

kg_status kg_bench_ba_recorded(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_bench_ba_recorded_jacobian(void *state, double *answer);
kg_status kg_bench_ba_recorded_observations(void *state, double *answer); /* features alone */
kg_status kg_bench_ba_jacobian_replayed(void **state, const void *data,
                                        const kg_allocator *allocator);
kg_status kg_bench_ba_replay_jacobian(void *state, double *answer);
kg_status kg_bench_ba_replay_observations(void *state, double *answer);
kg_status kg_bench_ba_loss_replayed(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_bench_ba_replay_loss(void *state, double *answer);
void kg_bench_ba_tape_destroy(void *state);

enum {
  BENCH_GMM_CASES = 6,
  BENCH_BA_CASES = 5,
  BENCH_NET_CASES = 6,
  BENCH_LSTM_CASES = 1,
  BENCH_HAND_CASES = 3,
};

extern const kg_bench_case kg_bench_gmm_cases[BENCH_GMM_CASES];
extern const kg_bench_case kg_bench_ba_cases[BENCH_BA_CASES];
extern const kg_bench_case kg_bench_net_cases[BENCH_NET_CASES];
extern const kg_bench_case kg_bench_lstm_cases[BENCH_LSTM_CASES];
extern const kg_bench_case kg_bench_hand_cases[BENCH_HAND_CASES];

#endif
