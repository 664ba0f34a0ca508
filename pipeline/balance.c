/* How much of a motion's change of momentum contact forces can explain.
 *
 * From the centre of mass c and the angular momentum L about it, both smoothed (zero-lag
 * Butterworth, 20 Hz):   F = mass (c'' - g),   N = L'.
 * Points near the surface may push with any force in a pyramid of eight edges inside the friction
 * cone; non-negative weights x of the edges e_k at x_k are fitted to
 *   sum x_k e_k = F,   sum x_k (x_k - c) x e_k / reach = N / reach
 * by least squares, reach being a length that makes moments comparable with forces. What the fit
 * leaves is the balance: |F - fit| in N and |N - fit| in N m, mean over frames. */
#include "kinegrad/filter.h"
#include "pipeline/measure.h"

static const double REACH = 0.9; /* m, about the height of the centre of mass */
static const double PI = 3.14159265358979323846;

static void smooth(kg_measure *m, kg_vec3 *x)
{
  const double rate = 1.0 / m->dt;
  kg_filter_lowpass(&x->x, m->T, 3, rate, KG_METRIC_SMOOTHING_HZ, m->filter_work);
  kg_filter_lowpass(&x->y, m->T, 3, rate, KG_METRIC_SMOOTHING_HZ, m->filter_work);
  kg_filter_lowpass(&x->z, m->T, 3, rate, KG_METRIC_SMOOTHING_HZ, m->filter_work);
}

/* Columns of the edges of one point's friction pyramid. */
static void fill_columns(double *A, int columns, int first, const kg_probe_point *point,
                         kg_vec3 com)
{
  const kg_vec3 n = point->normal;
  const kg_vec3 other = fabs(n.x) < 0.6 ? kg_vec3_make(1, 0, 0) : kg_vec3_make(0, 0, 1);
  const kg_vec3 t1 = kg_vec3_normalized(kg_vec3_cross(n, other)), t2 = kg_vec3_cross(n, t1);
  const kg_vec3 arm = kg_vec3_scale(1.0 / REACH, kg_vec3_sub(point->x, com));
  for (int k = 0; k < KG_FRICTION_EDGES; k++) {
    const double angle = 2.0 * PI * k / KG_FRICTION_EDGES;
    kg_vec3 e = kg_vec3_add_scaled(n, KG_METRIC_FRICTION * cos(angle), t1);
    e = kg_vec3_add_scaled(e, KG_METRIC_FRICTION * sin(angle), t2);
    const kg_vec3 moment = kg_vec3_cross(arm, e);
    const double column[6] = {moment.x, moment.y, moment.z, e.x, e.y, e.z};
    for (int i = 0; i < 6; i++) {
      A[(ptrdiff_t)i * columns + first + k] = column[i];
    }
  }
}

/* What the carriers of the probe cannot give of (N / reach, F), left in wrench. */
static void subtract_best(kg_measure *m, const kg_probe *probe, kg_vec3 com, double wrench[6])
{
  const int columns = probe->carrier_count * KG_FRICTION_EDGES;
  if (columns == 0) {
    return;
  }
  for (int k = 0; k < probe->carrier_count; k++) {
    fill_columns(m->A, columns, k * KG_FRICTION_EDGES, &probe->carriers[k], com);
  }
  kg_nnls(m->x, m->A, wrench, 6, columns, m->nnls_work);
  for (int i = 0; i < 6; i++) {
    for (int k = 0; k < columns; k++) {
      wrench[i] -= m->A[(ptrdiff_t)i * columns + k] * m->x[k];
    }
  }
}

void kg_measure_balance(kg_measure *m, const double *q, kg_motion_metrics *out)
{
  const kg_body *body = m->subject->body;
  smooth(m, m->com);
  smooth(m, m->L);
  /* reflection bends the ends: two cutoff periods on either side are left out where that leaves
   * half of the clip or more */
  int margin = (int)ceil(2.0 / (KG_METRIC_SMOOTHING_HZ * m->dt));
  margin = 4 * margin <= m->T ? margin : m->T / 4;
  margin = margin > 1 ? margin : 1;
  const double dt = m->dt;
  double moment = 0.0, force = 0.0;
  int count = 0;
  for (int t = margin; t < m->T - margin; t++, count++) {
    const kg_vec3 *c = &m->com[t];
    const kg_vec3 bend = kg_vec3_add(kg_vec3_sub(c[1], c[0]), kg_vec3_sub(c[-1], c[0]));
    kg_vec3 F = kg_vec3_scale(body->mass / (dt * dt), bend);
    F.y += body->mass * KG_METRIC_GRAVITY;
    const kg_vec3 N = kg_vec3_scale(0.5 / dt, kg_vec3_sub(m->L[t + 1], m->L[t - 1]));
    double wrench[6] = {N.x / REACH, N.y / REACH, N.z / REACH, F.x, F.y, F.z};
    kg_measure_probe(m, q + (ptrdiff_t)t * body->nq, &m->probe[0]);
    subtract_best(m, &m->probe[0], *c, wrench);
    moment += REACH * kg_vec3_norm(kg_vec3_make(wrench[0], wrench[1], wrench[2]));
    force += kg_vec3_norm(kg_vec3_make(wrench[3], wrench[4], wrench[5]));
  }
  out->momentum_balance = count > 0 ? moment / count : 0.0;
  out->force_balance = count > 0 ? force / count : 0.0;
}
