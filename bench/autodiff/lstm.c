/* The recurrent net's loss, in doubles, compiled for speed (bench/CMakeLists.txt). */
#define number double
#include "bench/autodiff/lstm_loops.h"

double kg_bench_lstm_loss(const kg_bench_lstm *lstm, const double *theta, double *work)
{
  return lstm_loss(lstm, theta, work);
}
