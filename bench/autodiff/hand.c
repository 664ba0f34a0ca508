/* The hand's residuals, in doubles, compiled for speed (bench/CMakeLists.txt). */
#define number double
#include "bench/autodiff/hand_loops.h"

void kg_bench_hand_residuals(const kg_bench_hand *hand, const double *theta, double *residual,
                             double *work)
{
  hand_residuals(hand, theta, residual, work);
}
