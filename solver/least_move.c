/* Active-set solution of the least move problem; symbols in least_move.h.
 *
 * Optimal when  x = M^-1 G' l,  l >= 0,  G x >= b,  l' (G x - b) = 0. Rows enter one at a time, the
 * most violated first; the multipliers of the active rows P solve A_PP l_P = b_P; a row whose
 * multiplier would turn negative leaves. A_PP carries a relative shift so that rows that say the
 * same (three points of one flat sole too many) do not make it singular. */
#include "solver/least_move.h"

#include "kinegrad/dense.h"

#include <math.h>
#include <string.h>

#define SHIFT 1e-11

void least_move_init(least_move *w, int n, int rows_max, kg_arena *arena)
{
  const int most = n + 1; /* n rows fix x; one more enters before another leaves */
  const size_t square = (size_t)most * (size_t)most;
  *w = (least_move){.n = n, .most = most, .rows_max = rows_max};
  w->Z = KG_ARENA_ARRAY(arena, double, square);
  w->A = KG_ARENA_ARRAY(arena, double, square);
  w->factor = KG_ARENA_ARRAY(arena, double, square);
  w->trial = KG_ARENA_ARRAY(arena, double, most);
  w->rest = KG_ARENA_ARRAY(arena, double, most);
  w->active = KG_ARENA_ARRAY(arena, int, most);
  w->is_active = KG_ARENA_ARRAY(arena, bool, rows_max);
}

static double dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++) {
    sum += a[i] * b[i];
  }
  return sum;
}

static const double *row_of(const least_move *w, const double *G, int row)
{
  return G + (size_t)row * (size_t)w->n;
}

/* x = sum of lambda Z over the active rows */
static void compose(const least_move *w, int count, const double *lambda, double *x)
{
  memset(x, 0, (size_t)w->n * sizeof *x);
  for (int p = 0; p < count; p++) {
    const double *z = w->Z + (size_t)p * (size_t)w->n, l = lambda[w->active[p]];
    for (int i = 0; i < w->n; i++) {
      x[i] += l * z[i];
    }
  }
}

/* the inactive row that x violates most, or -1; *active_miss: what the active rows, which should be
 * equalities, are violated by */
static int most_violated(const least_move *w, const double *G, const double *b, int rows,
                         double tolerance, const double *x, double *active_miss)
{
  int worst = -1;
  double most = tolerance;
  *active_miss = 0.0;
  for (int r = 0; r < rows; r++) {
    const double miss = b[r] - dot(row_of(w, G, r), x, w->n);
    if (w->is_active[r]) {
      *active_miss = fmax(*active_miss, miss);
    } else if (miss > most) {
      most = miss;
      worst = r;
    }
  }
  return worst;
}

static void enter(least_move *w, const double *L, const double *G, int row, int count)
{
  const int n = w->n;
  double *z = w->Z + (size_t)count * (size_t)n;
  memcpy(z, row_of(w, G, row), (size_t)n * sizeof *z);
  kg_dense_cholesky_solve(L, n, z, 1);
  w->active[count] = row;
  w->is_active[row] = true;
  for (int p = 0; p <= count; p++) { /* lower triangle suffices */
    w->A[(size_t)count * (size_t)w->most + (size_t)p] = dot(row_of(w, G, w->active[p]), z, n);
  }
}

/* takes active position p out: rows and columns behind it move up */
static void leave(least_move *w, int p, int count)
{
  const size_t n = (size_t)w->n, most = (size_t)w->most;
  w->is_active[w->active[p]] = false;
  for (int i = p + 1; i < count; i++) {
    const size_t to = (size_t)i - 1;
    w->active[to] = w->active[i];
    memcpy(w->Z + to * n, w->Z + (to + 1) * n, n * sizeof *w->Z);
    for (int j = 0, k = 0; j <= i; j++) {
      if (j != p) {
        w->A[to * most + (size_t)k++] = w->A[(to + 1) * most + (size_t)j];
      }
    }
  }
}

/* (A_PP l)_i; A holds its lower triangle */
static double gram_row(const least_move *w, int i, const double *l, int count)
{
  const size_t n = (size_t)w->most;
  double sum = 0.0;
  for (int j = 0; j < count; j++) {
    sum += l[j] * (j <= i ? w->A[(size_t)i * n + (size_t)j] : w->A[(size_t)j * n + (size_t)i]);
  }
  return sum;
}

/* trial = A_PP^-1 b_P; the shift of the factor is taken back by iterative refinement, which works
 * wherever the rows agree. False when A_PP is not positive definite even with its shift. */
static bool solve_active(least_move *w, const double *b, int count)
{
  double largest = 0.0;
  for (int i = 0; i < count; i++) {
    largest = fmax(largest, w->A[(size_t)i * (size_t)w->most + (size_t)i]);
  }
  for (int i = 0; i < count; i++) {
    const double *from = w->A + (size_t)i * (size_t)w->most;
    double *to = w->factor + (size_t)i * (size_t)count;
    memcpy(to, from, (size_t)(i + 1) * sizeof *to);
    to[i] += SHIFT * largest;
    w->trial[i] = 0.0;
  }
  if (!kg_dense_cholesky_factor(w->factor, count)) return false;
  for (int round = 0; round < 3; round++) {
    for (int i = 0; i < count; i++) {
      w->rest[i] = b[w->active[i]] - gram_row(w, i, w->trial, count);
    }
    kg_dense_cholesky_solve(w->factor, count, w->rest, 1);
    for (int i = 0; i < count; i++) {
      w->trial[i] += w->rest[i];
    }
  }
  return true;
}

/* Moves lambda towards the trial as far as it stays >= 0; rows that reach zero leave until the
 * trial itself is non-negative. Returns the number of active rows, -1 on failure. */
static int settle(least_move *w, const double *b, int count, double *lambda)
{
  while (count > 0) {
    if (!solve_active(w, b, count)) return -1;
    double step = 1.0;
    int first_out = -1;
    for (int p = 0; p < count; p++) {
      const double l = lambda[w->active[p]];
      if (w->trial[p] <= 0.0 && l / (l - w->trial[p]) < step) {
        step = l / (l - w->trial[p]);
        first_out = p;
      } else if (w->trial[p] <= 0.0 && l <= 0.0) { /* 0 / 0: entered and turned back at once */
        step = 0.0;
        first_out = p;
      }
    }
    for (int p = 0; p < count; p++) {
      double *l = &lambda[w->active[p]];
      *l += step * (w->trial[p] - *l);
    }
    if (first_out < 0) return count;
    lambda[w->active[first_out]] = 0.0;
    leave(w, first_out, count--);
  }
  return 0;
}

bool least_move_solve(least_move *w, const double *L, const double *G, const double *b, int rows,
                      double tolerance, double *x, double *lambda)
{
  KG_ASSERT(rows >= 0 && rows <= w->rows_max);
  memset(w->is_active, 0, (size_t)rows * sizeof *w->is_active);
  memset(lambda, 0, (size_t)rows * sizeof *lambda);
  memset(x, 0, (size_t)w->n * sizeof *x);
  int count = 0;
  for (int pass = 0; pass < 10 * w->n; pass++) {
    double active_miss;
    const int row = most_violated(w, G, b, rows, tolerance, x, &active_miss);
    if (row < 0) return active_miss <= 10.0 * tolerance;
    if (count == w->most) return false;
    enter(w, L, G, row, count++);
    count = settle(w, b, count, lambda);
    if (count < 0) return false;
    compose(w, count, lambda, x);
  }
  return false;
}
