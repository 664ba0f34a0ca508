/* Newton's method with a backtracking line search; the contract is in kinegrad/newton.h.
 *
 *   G  residual           p  Newton direction, G'(x) p = -G
 *   m  = |diag(s) G|_2    merit; along p its slope at alpha = 0 is -m, whatever s > 0, so p is
 *                         always a descent direction and the test reads
 *   m(x + alpha p) <= (1 - c1 alpha) m(x)                                   [NW] Algorithm 11.4
 *
 * A comparison with NaN is false, so a trial point whose merit is not a number is never taken. */
#include "kinegrad/newton.h"

#include "kinegrad/arena.h"

#include <math.h>
#include <string.h>

struct kg_newton {
  kg_newton_def def;
  kg_arena arena;
  double *G;       /* (n) at x         */
  double *G_trial; /* (n) at x_trial   */
  double *p;       /* (n)              */
  double *x_trial; /* (n) x + alpha p  */
};

/* one call of kg_newton_solve */
typedef struct solve {
  kg_newton *w;
  const double *scale; /* may be NULL */
  kg_residual_fn *residual;
  kg_newton_direction_fn *direction;
  void *user;
  kg_newton_report report;
} solve;

kg_newton_def kg_newton_default_def(int n)
{
  return (kg_newton_def){
    .n = n,
    .tolerance = 1e-8,
    .max_iterations = 50,
    .max_halvings = 30,
    .armijo_c1 = 1e-4,
    .stall_ratio = 0.9999,
  };
}

kg_status kg_newton_create(kg_newton **newton, const kg_newton_def *def)
{
  KG_ASSERT(newton && def && def->n >= 1 && def->max_iterations >= 0 && def->max_halvings >= 0);
  *newton = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  const int n = def->n;
  kg_newton *w = KG_ARENA_ARRAY(&arena, kg_newton, 1);
  double *G = KG_ARENA_ARRAY(&arena, double, n);
  double *G_trial = KG_ARENA_ARRAY(&arena, double, n);
  double *p = KG_ARENA_ARRAY(&arena, double, n);
  double *x_trial = KG_ARENA_ARRAY(&arena, double, n);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  *w = (kg_newton){*def, arena, G, G_trial, p, x_trial};
  *newton = w;
  return KG_OK;
}

void kg_newton_destroy(kg_newton *newton)
{
  if (newton) {
    kg_arena arena = newton->arena; /* the object lives in its own arena */
    kg_arena_release(&arena);
  }
}

/* m of a residual; infinite or NaN when G is */
static double merit(const double *G, const double *scale, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++) {
    const double g = scale ? scale[i] * G[i] : G[i];
    sum += g * g;
  }
  return sqrt(sum);
}

/* m at x with G filled; NaN where the residual is undefined */
static double evaluate(solve *s, double *G, const double *x)
{
  s->report.evaluations++;
  return s->residual(G, x, s->user) ? merit(G, s->scale, s->w->def.n) : NAN;
}

static bool all_finite(const double *a, int n)
{
  for (int i = 0; i < n; i++) {
    if (!isfinite(a[i])) return false;
  }
  return true;
}

/* Finds alpha and moves x there. False, x untouched, when no alpha lowers m enough. */
static bool line_search(solve *s, double *x)
{
  kg_newton *w = s->w;
  const int n = w->def.n;
  const double m = s->report.residual;
  double alpha = 1.0;
  for (int halving = 0; halving <= w->def.max_halvings; halving++, alpha *= 0.5) {
    if (halving > 0) {
      s->report.cuts++;
    }
    for (int i = 0; i < n; i++) {
      w->x_trial[i] = x[i] + alpha * w->p[i];
    }
    const double m_trial = evaluate(s, w->G_trial, w->x_trial);
    /* near the limit of precision a converged point may miss the Armijo test: it counts too */
    if (m_trial <= (1.0 - w->def.armijo_c1 * alpha) * m || m_trial <= w->def.tolerance) {
      memcpy(x, w->x_trial, (size_t)n * sizeof *x);
      double *G = w->G;
      w->G = w->G_trial;
      w->G_trial = G;
      s->report.residual = m_trial;
      return true;
    }
  }
  return false;
}

static kg_newton_stop iterate(solve *s, double *x)
{
  kg_newton *w = s->w;
  kg_newton_report *report = &s->report;
  int slow_steps = 0; /* in a row */
  for (;;) {
    if (report->residual <= w->def.tolerance) return KG_NEWTON_CONVERGED;
    if (slow_steps == 2) return KG_NEWTON_STALLED;
    if (report->iterations == w->def.max_iterations) return KG_NEWTON_MAX_ITERATIONS;
    if (!s->direction(w->p, x, w->G, s->user) || !all_finite(w->p, w->def.n)) {
      return KG_NEWTON_SINGULAR;
    }
    const double m = report->residual;
    if (!line_search(s, x)) return KG_NEWTON_STALLED;
    report->iterations++;
    slow_steps = report->residual > w->def.stall_ratio * m ? slow_steps + 1 : 0;
  }
}

kg_newton_report kg_newton_solve(kg_newton *newton, double *x, const double *scale,
                                 kg_residual_fn *residual, kg_newton_direction_fn *direction,
                                 void *user)
{
  KG_ASSERT(newton && x && residual && direction);
  solve s = {newton, scale, residual, direction, user, {.residual = INFINITY}};
  const double m = evaluate(&s, newton->G, x);
  if (!isfinite(m)) {
    s.report.stop = KG_NEWTON_UNDEFINED;
    return s.report;
  }
  s.report.residual = m;
  s.report.stop = iterate(&s, x);
  return s.report;
}
