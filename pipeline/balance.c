/* How much of a motion's change of momentum contact forces can explain.
 *
 * From the centre of mass c and the angular momentum L about it, both smoothed (zero-lag
 * Butterworth, 20 Hz):   F = mass (c'' - g),   N = L'.
 * Points near the surface may push with any force in a pyramid of eight edges inside the friction
 * cone; non-negative weights x of the edges e_k at x_k are fitted to
 *   sum x_k e_k = F,   sum x_k (x_k - c) x e_k / reach = N / reach
 * by least squares, reach being a length that makes moments comparable with forces. What the fit
 * leaves is the balance: |F - fit| in N and |N - fit| in N m, mean over frames.
 *
 * The smoothing spreads a contact's force over half a period of the cutoff to either side, so a
 * point may push in a frame when it is near the surface within that time; it acts where it is. */
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

int kg_measure_balance_reach(double dt)
{
  return (int)fmin(floor(0.5 / (KG_METRIC_SMOOTHING_HZ * dt)), 32.0);
}

/* Carriers of the frames around t, each point once, the nearest frames first, where they are in
 * frame t. Frame k is kept in window[k mod (2 reach + 1)]. */
static int collect_carriers(kg_measure *m, const double *q, int t, kg_probe_point *carriers)
{
  const kg_body *body = m->subject->body;
  const int size = 2 * m->reach + 1;
  int count = 0;
  kg_dynamics_pose(m->dynamics, q + (ptrdiff_t)t * body->nq, m->p, m->R);
  for (int k = 0; k < size; k++) {
    const int frame = t + (k % 2 ? (k + 1) / 2 : -(k / 2));
    if (frame < 0 || frame >= m->T) {
      continue;
    }
    const kg_probe *probe = &m->window[frame % size];
    for (int c = 0; c < probe->carrier_count && count < KG_PROBE_CARRIERS; c++) {
      kg_probe_point point = probe->carriers[c];
      if (m->stamp[point.point] != t + 1) {
        m->stamp[point.point] = t + 1;
        const kg_vec3 arm = kg_mat3_mul_vec(m->R[point.segment], body->points[point.point].p);
        point.x = kg_vec3_add(m->p[point.segment], arm);
        carriers[count++] = point;
      }
    }
  }
  return count;
}

/* What the carriers cannot give of (N / reach, F), left in wrench. */
static void subtract_best(kg_measure *m, const kg_probe_point *carriers, int count, kg_vec3 com,
                          double wrench[6])
{
  const int columns = count * KG_FRICTION_EDGES;
  if (columns == 0) {
    return;
  }
  for (int k = 0; k < count; k++) {
    fill_columns(m->A, columns, k * KG_FRICTION_EDGES, &carriers[k], com);
  }
  kg_nnls(m->x, m->A, wrench, 6, columns, m->nnls_work);
  for (int i = 0; i < 6; i++) {
    for (int k = 0; k < columns; k++) {
      wrench[i] -= m->A[(ptrdiff_t)i * columns + k] * m->x[k];
    }
  }
}

/* Probes the frames up to t + reach that are not in the window yet; returns the next to probe. */
static int look_ahead(kg_measure *m, const double *q, int next, int t)
{
  const int size = 2 * m->reach + 1;
  for (; next <= t + m->reach && next < m->T; next++) {
    kg_measure_probe(m, q + (ptrdiff_t)next * m->subject->body->nq, next * m->dt,
                     &m->window[next % size]);
  }
  return next;
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
  int count = 0, next = margin > m->reach ? margin - m->reach : 0;
  kg_probe_point carriers[KG_PROBE_CARRIERS];
  for (int k = 0; k < body->point_count; k++) {
    m->stamp[k] = 0;
  }
  for (int t = margin; t < m->T - margin; t++, count++) {
    const kg_vec3 *c = &m->com[t];
    const kg_vec3 bend = kg_vec3_add(kg_vec3_sub(c[1], c[0]), kg_vec3_sub(c[-1], c[0]));
    kg_vec3 F = kg_vec3_scale(body->mass / (dt * dt), bend);
    F.y += body->mass * KG_METRIC_GRAVITY;
    const kg_vec3 N = kg_vec3_scale(0.5 / dt, kg_vec3_sub(m->L[t + 1], m->L[t - 1]));
    double wrench[6] = {N.x / REACH, N.y / REACH, N.z / REACH, F.x, F.y, F.z};
    next = look_ahead(m, q, next, t);
    subtract_best(m, carriers, collect_carriers(m, q, t, carriers), *c, wrench);
    moment += REACH * kg_vec3_norm(kg_vec3_make(wrench[0], wrench[1], wrench[2]));
    force += kg_vec3_norm(kg_vec3_make(wrench[3], wrench[4], wrench[5]));
  }
  out->momentum_balance = count > 0 ? moment / count : 0.0;
  out->force_balance = count > 0 ? force / count : 0.0;
}
