/* Motions as arrays of states. */
#include "pipeline/pipeline.h"

#include <string.h>

static void interpolate_state(const kg_body *body, double *q, const double *a, const double *b,
                              double s)
{
  for (int k = 0; k < 3; k++) {
    q[k] = a[k] + s * (b[k] - a[k]);
  }
  for (int i = 0; i < body->segment_count; i++) {
    const double *ai = a + 3 + 4 * i, *bi = b + 3 + 4 * i;
    const kg_quat r = kg_quat_slerp(kg_quat_make(ai[0], ai[1], ai[2], ai[3]),
                                    kg_quat_make(bi[0], bi[1], bi[2], bi[3]), s);
    double *qi = q + 3 + 4 * i;
    qi[0] = r.w;
    qi[1] = r.x;
    qi[2] = r.y;
    qi[3] = r.z;
  }
}

void kg_states_at(const kg_body *body, double *q, const double *states, int count, double x)
{
  const size_t nq = (size_t)body->nq;
  x = fmin(fmax(x, 0.0), count - 1.0);
  int t = (int)floor(x + 1e-9);
  const double s = x - t;
  if (t + 1 >= count || s < 1e-9) {
    t = t < count ? t : count - 1;
    memcpy(q, states + (size_t)t * nq, nq * sizeof *q);
  } else {
    interpolate_state(body, q, states + (size_t)t * nq, states + (size_t)(t + 1) * nq, s);
  }
}
