/* Least squares over time with squared second differences: a pentadiagonal LDL' factor. */
#include "pipeline/pipeline.h"

void kg_smoother_create(kg_smoother *smoother, int count, kg_arena *arena)
{
  smoother->count = count;
  smoother->D = KG_ARENA_ARRAY(arena, double, count);
  smoother->L1 = KG_ARENA_ARRAY(arena, double, count);
  smoother->L2 = KG_ARENA_ARRAY(arena, double, count);
}

void kg_smoother_factor(kg_smoother *smoother, const double *weight, double tau4)
{
  const int n = smoother->count;
  double D1 = 1.0, D2 = 1.0, L1_before = 0.0; /* D(t-1), D(t-2), L(t-1,t-2) */
  for (int t = 0; t < n; t++) {
    /* second differences centred at t-1, t and t+1, where they exist, touch y_t and its neighbours:
     * A(t,t) gets 1, 4, 1 of them, A(t,t-1) gets -2 of those centred at t-1 and t, A(t,t-2) one */
    const int before = t >= 2, here = t >= 1 && t + 1 < n, after = t + 2 < n;
    const double L2 = before ? tau4 / D2 : 0.0;
    const double below = -2.0 * tau4 * (before + here);
    const double L1 = t >= 1 ? (below - L2 * L1_before * D2) / D1 : 0.0;
    const double own = 1.0 + (weight ? weight[t] : 0.0) + tau4 * (before + 4 * here + after);
    const double D = own - L1 * L1 * D1 - L2 * L2 * D2;
    smoother->D[t] = D;
    smoother->L1[t] = L1;
    smoother->L2[t] = L2;
    D2 = D1;
    D1 = D;
    L1_before = L1;
  }
}

void kg_smoother_solve(const kg_smoother *smoother, double *y, int stride)
{
  const int n = smoother->count;
  const double *D = smoother->D, *L1 = smoother->L1, *L2 = smoother->L2;
  double before = 0.0, before2 = 0.0;
  for (int t = 0; t < n; t++) { /* L z = y */
    const double z = y[t * stride] - L1[t] * before - L2[t] * before2;
    y[t * stride] = z;
    before2 = before;
    before = z;
  }
  double after = 0.0, after2 = 0.0;
  for (int t = n - 1; t >= 0; t--) { /* D L' x = z */
    double x = y[t * stride] / D[t];
    x -= (t + 1 < n ? L1[t + 1] * after : 0.0) + (t + 2 < n ? L2[t + 2] * after2 : 0.0);
    y[t * stride] = x;
    after2 = after;
    after = x;
  }
}

/* Eight columns at a time: their recurrences do not wait for each other. */
static void solve_eight(const kg_smoother *smoother, double *y, size_t stride)
{
  enum { E = KG_SMOOTHER_COLUMNS };
  const int n = smoother->count;
  double before[E] = {0.0}, before2[E] = {0.0};
  for (int t = 0; t < n; t++) { /* L z = y */
    const double L1 = smoother->L1[t], L2 = smoother->L2[t];
    double *row = y + (size_t)t * stride, z[E];
    for (int j = 0; j < E; j++) {
      z[j] = row[j] - L1 * before[j] - L2 * before2[j];
    }
    for (int j = 0; j < E; j++) {
      before2[j] = before[j];
      before[j] = row[j] = z[j];
    }
  }
  double after[E] = {0.0}, after2[E] = {0.0};
  for (int t = n - 1; t >= 0; t--) { /* D L' x = z */
    const double share = 1.0 / smoother->D[t];
    const double L1 = t + 1 < n ? smoother->L1[t + 1] : 0.0;
    const double L2 = t + 2 < n ? smoother->L2[t + 2] : 0.0;
    double *row = y + (size_t)t * stride, x[E];
    for (int j = 0; j < E; j++) {
      x[j] = share * row[j] - L1 * after[j] - L2 * after2[j];
    }
    for (int j = 0; j < E; j++) {
      after2[j] = after[j];
      after[j] = row[j] = x[j];
    }
  }
}

void kg_smoother_solve_rows(const kg_smoother *smoother, double *y, int width)
{
  KG_ASSERT(width % KG_SMOOTHER_COLUMNS == 0);
  for (int j = 0; j < width; j += KG_SMOOTHER_COLUMNS) {
    solve_eight(smoother, y + j, (size_t)width);
  }
}
