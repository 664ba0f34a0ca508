/* kinegrad/filter.h - zero-lag low-pass filter of a uniformly sampled signal.
 *
 * A second-order Butterworth filter is run forwards and backwards: no phase, order 4 in all. The
 * cutoff of the single pass is raised so that the double pass has gain 1/sqrt(2) at cutoff_hz:
 *   gain(f) = 1 / (1 + (sqrt(2) - 1) (tan(pi f / rate) / tan(pi cutoff / rate))^4)
 * Both ends are continued by odd reflection (2 x_0 - x_k): constants and straight lines pass
 * unchanged.
 *
 * [WINTER] D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., Wiley 2009,
 *          section 3.4.4.2. */
#ifndef KINEGRAD_FILTER_H
#define KINEGRAD_FILTER_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Doubles of work memory for one call; any stride. */
KG_API size_t kg_filter_work_size(int count, double rate_hz, double cutoff_hz);

/* Filters x[0], x[stride], ..., count >= 0 values, in place. rate_hz and cutoff_hz > 0; a cutoff
 * above 0.45 rate_hz is taken as 0.45 rate_hz. Fewer than three values are left alone. */
KG_API void kg_filter_lowpass(double *x, int count, int stride, double rate_hz, double cutoff_hz,
                              double *work);

/* Gain at frequency_hz of the filter above, the clamp of the cutoff included. */
KG_API double kg_filter_gain(double frequency_hz, double rate_hz, double cutoff_hz);

#ifdef __cplusplus
}
#endif
#endif
