/* bench/autodiff/adolc_peer.h - derivatives by ADOL-C, each in the way that is fastest for it.
 *
 * "retaped": recorded anew for every derivative, as a program must whose branches may change; the
 * values for the reverse sweep are kept while recording. "replayed": recorded once, then a forward
 * and a reverse sweep over the tape at the new inputs.
 * The names are create, run and destroy functions of kg_bench_contestant; ADOL-C's tapes are global,
 * so only one object of each kind may exist at a time. */
#ifndef BENCH_AUTODIFF_ADOLC_PEER_H
#define BENCH_AUTODIFF_ADOLC_PEER_H

#include "bench/autodiff/problems.h"

#ifdef __cplusplus
extern "C" {
#endif

/* answer: value, gradient. data: kg_bench_gmm. */
kg_status kg_adolc_gmm_retaped(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_adolc_gmm_replayed(void **state, const void *data, const kg_allocator *allocator);

/* answer: Jacobian (p x 2 x 15), (p) of the weights. data: kg_bench_ba. "jacobian": all observations
 * on one tape; "observation": a tape of one observation, again and again. */
kg_status kg_adolc_ba_jacobian_retaped(void **state, const void *data,
                                       const kg_allocator *allocator);
kg_status kg_adolc_ba_jacobian_replayed(void **state, const void *data,
                                        const kg_allocator *allocator);
kg_status kg_adolc_ba_observation_retaped(void **state, const void *data,
                                          const kg_allocator *allocator);
kg_status kg_adolc_ba_observation_replayed(void **state, const void *data,
                                           const kg_allocator *allocator);

/* answer: loss, gradient; the whole sum on one tape. */
kg_status kg_adolc_ba_loss_retaped(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_adolc_ba_loss_replayed(void **state, const void *data, const kg_allocator *allocator);

/* answer: loss, gradient; in double; a tape of one batch element. data: kg_bench_net. */
kg_status kg_adolc_net_retaped(void **state, const void *data, const kg_allocator *allocator);
kg_status kg_adolc_net_replayed(void **state, const void *data, const kg_allocator *allocator);

kg_status kg_adolc_run(void *state, double *answer);
void kg_adolc_destroy(void *state);

#ifdef __cplusplus
}
#endif
#endif
