/* Non-negative least squares by the active-set method of [LH], chapter 23, algorithm NNLS.
 *
 * Names follow [LH]: the passive set P holds the variables that are free, z the least-squares
 * solution over P, w = A'(b - A x) the negative gradient. P never has more than m columns, and the
 * least-squares problem over it is solved afresh by Householder QR: made for few rows. */
#include <math.h>

#include "kinegrad/metrics.h"

typedef struct nnls {
  const double *A, *b;
  int m, n, most; /* most: largest size of P */
  int count;      /* of P                    */
  double *P;      /* columns in P            */
  double *state;  /* per column: IN_P, ...   */
  double *w;
  double *QR;  /* (m, most), by columns   */
  double *rhs; /* m                       */
  double *z;   /* most                    */
} nnls;

enum { AT_ZERO = 0, IN_P = 1, REFUSED = 2 };

static int at_most(int m, int n)
{
  return m < n ? m : n;
}

size_t kg_nnls_work_size(int m, int n)
{
  const size_t k = (size_t)at_most(m, n);
  return (size_t)m * k + 2 * k + (size_t)m + 2 * (size_t)n;
}

static nnls set_up(const double *A, const double *b, int m, int n, double *work)
{
  const int k = at_most(m, n);
  nnls s = {.A = A, .b = b, .m = m, .n = n, .most = k};
  s.QR = work;
  s.P = s.QR + (ptrdiff_t)m * k;
  s.z = s.P + k;
  s.rhs = s.z + k;
  s.w = s.rhs + m;
  s.state = s.w + n;
  for (int j = 0; j < n; j++) {
    s.state[j] = AT_ZERO;
  }
  return s;
}

/* rhs = b - A x over the passive set; returns its norm */
static double residual(nnls *s, const double *x)
{
  double sum = 0.0;
  for (int i = 0; i < s->m; i++) {
    double r = s->b[i];
    for (int k = 0; k < s->count; k++) {
      const int j = (int)s->P[k];
      r -= s->A[(ptrdiff_t)i * s->n + j] * x[j];
    }
    s->rhs[i] = r;
    sum += r * r;
  }
  return sqrt(sum);
}

/* w = A' rhs, and the column at zero with the steepest descent per unit of its length; -1: none
 * above the tolerance. */
static int steepest(nnls *s, double tolerance)
{
  for (int j = 0; j < s->n; j++) {
    s->w[j] = 0.0;
  }
  for (int i = 0; i < s->m; i++) {
    const double r = s->rhs[i];
    const double *row = s->A + (ptrdiff_t)i * s->n;
    for (int j = 0; j < s->n; j++) {
      s->w[j] += row[j] * r;
    }
  }
  int best = -1;
  double largest = tolerance;
  for (int j = 0; j < s->n; j++) {
    if (s->state[j] == AT_ZERO && s->w[j] > largest) {
      largest = s->w[j];
      best = j;
    }
  }
  return best;
}

/* z = argmin |A_P z - b| by Householder reflections; false when the columns are dependent. */
static bool solve_passive(nnls *s)
{
  const int m = s->m, k = s->count;
  for (int c = 0; c < k; c++) {
    const int j = (int)s->P[c];
    for (int i = 0; i < m; i++) {
      s->QR[c * m + i] = s->A[(ptrdiff_t)i * s->n + j];
    }
  }
  for (int i = 0; i < m; i++) {
    s->rhs[i] = s->b[i];
  }
  for (int c = 0; c < k; c++) {
    double *v = s->QR + c * m;
    double norm2 = 0.0, whole2 = 0.0;
    for (int i = 0; i < m; i++) {
      whole2 += v[i] * v[i];
      norm2 += i >= c ? v[i] * v[i] : 0.0;
    }
    if (!(norm2 > 1e-24 * whole2)) {
      return false;
    }
    const double alpha = v[c] > 0.0 ? -sqrt(norm2) : sqrt(norm2);
    const double beta = 1.0 / (norm2 - alpha * v[c]); /* 2 / |u|^2 with u = v - alpha e_c */
    v[c] -= alpha;
    for (int d = c + 1; d <= k; d++) { /* d = k: the right-hand side */
      double *y = d < k ? s->QR + d * m : s->rhs;
      double dot = 0.0;
      for (int i = c; i < m; i++) {
        dot += v[i] * y[i];
      }
      for (int i = c; i < m; i++) {
        y[i] -= beta * dot * v[i];
      }
    }
    v[c] = alpha; /* the diagonal of R; the reflector is not needed again */
  }
  for (int c = k - 1; c >= 0; c--) {
    double sum = s->rhs[c];
    for (int d = c + 1; d < k; d++) {
      sum -= s->QR[d * m + c] * s->z[d];
    }
    s->z[c] = sum / s->QR[c * m + c];
  }
  return true;
}

static void drop(nnls *s, int place, double *x)
{
  const int j = (int)s->P[place];
  x[j] = 0.0;
  s->state[j] = AT_ZERO;
  for (int k = place; k + 1 < s->count; k++) {
    s->P[k] = s->P[k + 1];
  }
  s->count--;
}

/* Moves x towards z until the first variable reaches zero, drops it, and solves again; ends with a
 * feasible z in x. */
static void make_feasible(nnls *s, double *x)
{
  for (;;) {
    double alpha = 1.0;
    int blocking = -1;
    for (int k = 0; k < s->count; k++) {
      const double xk = x[(int)s->P[k]];
      if (s->z[k] <= 0.0 && xk / (xk - s->z[k]) < alpha) {
        alpha = xk / (xk - s->z[k]);
        blocking = k;
      }
    }
    for (int k = 0; k < s->count; k++) {
      const int j = (int)s->P[k];
      x[j] += alpha * (s->z[k] - x[j]);
    }
    if (blocking < 0) {
      return;
    }
    drop(s, blocking, x);
    for (int k = s->count - 1; k >= 0; k--) { /* others that got there at the same time */
      if (x[(int)s->P[k]] <= 0.0) {
        drop(s, k, x);
      }
    }
    if (!solve_passive(s)) {
      return; /* cannot happen for a subset of independent columns */
    }
  }
}

double kg_nnls(double *x, const double *A, const double *b, int m, int n, double *work)
{
  KG_ASSERT(m > 0 && n >= 0);
  nnls s = set_up(A, b, m, n, work);
  double size = 0.0;
  for (int j = 0; j < n; j++) {
    x[j] = 0.0;
    double column = 0.0;
    for (int i = 0; i < m; i++) {
      column += A[(ptrdiff_t)i * n + j] * A[(ptrdiff_t)i * n + j];
    }
    size = fmax(size, sqrt(column));
  }
  double norm = residual(&s, x);
  const double tolerance = 1e-12 * size * norm;
  for (int iteration = 0; iteration < 3 * n + 30; iteration++) {
    const int j = s.count < s.most ? steepest(&s, tolerance) : -1;
    if (j < 0) {
      break;
    }
    s.P[s.count++] = j;
    s.state[j] = IN_P;
    if (!solve_passive(&s) || !(s.z[s.count - 1] > 0.0)) {
      /* dependent on P, or descent by rounding only: not to be tried again at this point */
      s.count--;
      s.state[j] = REFUSED;
      residual(&s, x);
      continue;
    }
    make_feasible(&s, x);
    norm = residual(&s, x);
    for (int k = 0; k < n; k++) {
      s.state[k] = s.state[k] == REFUSED ? AT_ZERO : s.state[k];
    }
  }
  return norm;
}
