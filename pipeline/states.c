/* Motions as arrays of states; Jacobians of points of the body. */
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

int kg_point_rows(const kg_body *body, const kg_vec3 *p, const kg_mat3 *R, int segment, kg_vec3 x,
                  double J[3][KG_PATH_COLUMNS], int columns[KG_PATH_COLUMNS])
{
  KG_ASSERT(body->segment_count <= KG_ROLE_COUNT);
  int n = 0;
  for (int k = 0; k < 3; k++, n++) {
    columns[n] = k;
    for (int r = 0; r < 3; r++) {
      J[r][n] = r == k;
    }
  }
  for (int i = segment; i >= 0; i = body->segments[i].parent) {
    /* d x = R d x (x - p) = -[x - p] R d */
    const kg_mat3 arm = kg_mat3_mul(kg_mat3_skew(kg_vec3_sub(p[i], x)), R[i]);
    for (int k = 0; k < 3; k++, n++) {
      columns[n] = 3 + 3 * i + k;
      for (int r = 0; r < 3; r++) {
        J[r][n] = arm.m[3 * r + k];
      }
    }
  }
  return n;
}

void kg_add_normal_equations(double *H, double *g, int nv, double J[3][KG_PATH_COLUMNS],
                             const int *columns, int n, const double e[3], double weight)
{
  for (int a = 0; a < n; a++) {
    double *row = H + (size_t)columns[a] * (size_t)nv;
    g[columns[a]] += weight * (J[0][a] * e[0] + J[1][a] * e[1] + J[2][a] * e[2]);
    for (int b = 0; b < n; b++) {
      row[columns[b]] += weight * (J[0][a] * J[0][b] + J[1][a] * J[1][b] + J[2][a] * J[2][b]);
    }
  }
}
