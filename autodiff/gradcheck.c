/* Is this derivative right? Numerical derivatives with their error, the judgement of entries,
 * Taylor orders, dot tests, repeated calls (kinegrad/gradcheck.h says what is judged how).
 *
 *   n, m   inputs, outputs of f       J (m, n)   analytic, row o by f's J' e_o
 *   N, E (m, n)   numerical derivative and the estimate of its error */
#include "autodiff/gradcheck.h"
#include "autodiff/primitive.h"

#include "kinegrad/arena.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"
#include "kinegrad/random.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
  ROWS = 12,    /* of a table of extrapolations                       */
  SCALES = 6,   /* tables tried, each from a step 1/50 of the one before */
  HALVINGS = 48 /* of the step in a Taylor test                       */
};
static const double ratio = 1.5;       /* of the steps of neighbouring rows       */
static const double trust = 1000;      /* an estimate may be so many times too small */
static const double least_order = 1.5; /* between a wrong derivative and a right one */

typedef struct check {
  const kg_differentiable *f;
  const kg_gradcheck_def *def;
  const double *x;
  size_t n, m;
  kg_random random;
  kg_arena arena;
  kg_error *error;
  kg_gradcheck_report *report;
  double tolerance;
  double size, largest; /* of the values, of the entries of J */
  double *J, *forward;  /* (m, n); forward: by J e_j, NULL without a jvp */
  double *N, *E;
  double *reach;                 /* (n) step from which differences settled, over def->step */
  double *y, *noise;             /* (m) f(x), and the size of its rounding errors */
  double *point, *d, *xw;        /* (n) scratch */
  double *w, *plus, *minus;      /* (m) scratch */
  double *table[2];              /* (ROWS, m) */
  double *derivative, *estimate; /* (m) of one table */
  double *remainder;             /* (HALVINGS, m) */
} check;

static double *numbers(check *c, size_t count)
{
  return KG_ARENA_ARRAY(&c->arena, double, count);
}

static bool reserve(check *c)
{
  const size_t n = c->n, m = c->m;
  double **const of_n[] = {&c->reach, &c->point, &c->d, &c->xw};
  double **const of_m[] = {&c->y,     &c->noise,      &c->w,       &c->plus,
                           &c->minus, &c->derivative, &c->estimate};
  double **const of_both[] = {&c->J, &c->N, &c->E, &c->forward};
  for (size_t i = 0; i < KG_COUNT_OF(of_n); ++i) {
    *of_n[i] = numbers(c, n);
  }
  for (size_t i = 0; i < KG_COUNT_OF(of_m); ++i) {
    *of_m[i] = numbers(c, m);
  }
  for (size_t i = 0; i < KG_COUNT_OF(of_both); ++i) {
    *of_both[i] = numbers(c, m * n);
  }
  c->table[0] = numbers(c, ROWS * m);
  c->table[1] = numbers(c, ROWS * m);
  c->remainder = numbers(c, HALVINGS * m);
  return !kg_arena_failed(&c->arena);
}

/* -- the function ------------------------------------------------------------------------------ */

static kg_status failed(const check *c, kg_status status, const char *what)
{
  if (status == KG_OK) return KG_OK;
  return kg_fail(c->error, status, "", 0, 0, "%s: its %s failed: %s", c->f->name, what,
                 kg_status_text(status));
}

static kg_status value(const check *c, const double *x, double *y)
{
  return failed(c, c->f->value(c->f->user, x, y), "value");
}

static kg_status vjp(const check *c, const double *w, double *xw)
{
  return failed(c, c->f->vjp(c->f->user, c->x, w, xw), "vjp");
}

static kg_status jvp(const check *c, const double *d, double *yd)
{
  return failed(c, c->f->jvp(c->f->user, c->x, d, yd), "jvp");
}

/* f beside x: not a number where it is undefined */
static kg_status value_near(const check *c, const double *x, double *y)
{
  const kg_status status = c->f->value(c->f->user, x, y);
  for (size_t o = 0; status == KG_ERR_UNDEFINED && o < c->m; ++o) {
    y[o] = NAN;
  }
  return status == KG_ERR_UNDEFINED ? KG_OK : failed(c, status, "value");
}

static double dot(const double *a, const double *b, size_t n)
{
  double sum = 0;
  for (size_t i = 0; i < n; ++i) {
    sum += a[i] * b[i];
  }
  return sum;
}

static void random_direction(check *c, double *d, size_t n)
{
  for (size_t i = 0; i < n; ++i) {
    d[i] = kg_random_normal(&c->random);
  }
}

/* as far as x_j itself goes, or the smallest entry of x where it is zero */
static double own_reach(const check *c, size_t j)
{
  double least = HUGE_VAL;
  for (size_t k = 0; k < c->n; ++k) {
    least = c->x[k] != 0 ? fmin(least, fabs(c->x[k])) : least;
  }
  return c->x[j] != 0 ? fabs(c->x[j]) : least < HUGE_VAL ? least : 1;
}

static double unit_of(const check *c, size_t j)
{
  return fmax(1, fabs(c->x[j]));
}

/* -- the analytic derivative ------------------------------------------------------------------- */

static double largest_of(const double *a, size_t count, double largest)
{
  for (size_t i = 0; i < count; ++i) {
    largest = fmax(largest, fabs(a[i]));
  }
  return largest;
}

static kg_status analytic_rows(check *c)
{
  kg_status status = KG_OK;
  for (size_t o = 0; o < c->m && status == KG_OK; ++o) {
    memset(c->w, 0, c->m * sizeof *c->w);
    c->w[o] = 1;
    status = vjp(c, c->w, c->J + o * c->n);
    c->largest = largest_of(c->J + o * c->n, c->n, c->largest);
  }
  return status;
}

static kg_status analytic_columns(check *c)
{
  kg_status status = KG_OK;
  for (size_t j = 0; j < c->n && status == KG_OK; ++j) {
    memset(c->d, 0, c->n * sizeof *c->d);
    c->d[j] = 1;
    status = jvp(c, c->d, c->plus);
    for (size_t o = 0; o < c->m; ++o) {
      c->forward[o * c->n + j] = c->plus[o];
    }
  }
  return status;
}

/* -- the numerical derivative ------------------------------------------------------------------ */

static kg_status complex_column(check *c, size_t j)
{
  memset(c->d, 0, c->n * sizeof *c->d);
  c->d[j] = 1;
  const kg_status status =
    failed(c, c->f->complex_step(c->f->user, c->x, c->d, c->plus), "complex step");
  for (size_t o = 0; o < c->m; ++o) {
    c->N[o * c->n + j] = c->plus[o];
  }
  return status;
}

/* Rounding errors of f: its sixth differences along d, over steps of h reach so short that their
 * sixth power vanishes. */
static kg_status measure_noise(check *c, double h)
{
  enum { POINTS = 9, DIFFERENCES = 6 };
  const double spread = 20; /* of the sum of 7 errors with binomial weights */
  const double least = DBL_EPSILON * c->def->step * c->size; /* of J, times a step */
  kg_status status = KG_OK;
  random_direction(c, c->d, c->n);
  for (int i = 0; i < POINTS && status == KG_OK; ++i) {
    for (size_t j = 0; j < c->n; ++j) {
      c->point[j] = c->x[j] + i * h * c->reach[j] * c->d[j];
    }
    status = value_near(c, c->point, c->table[0] + (size_t)i * c->m);
  }
  for (int k = 1; k <= DIFFERENCES; ++k) {
    for (size_t i = 0; i < (size_t)(POINTS - k) * c->m; ++i) {
      c->table[0][i] = c->table[0][i + c->m] - c->table[0][i];
    }
  }
  for (size_t i = 0; i < (POINTS - DIFFERENCES) * c->m; ++i) {
    double *noise = &c->noise[i % c->m];
    *noise = fmax(fmax(*noise, least), fabs(c->table[0][i]) / spread);
  }
  return status;
}

/* before the reach of f is known: as far as x itself goes */
static kg_status measure_first_noise(check *c)
{
  for (size_t j = 0; j < c->n; ++j) {
    c->reach[j] = own_reach(c, j);
  }
  for (size_t o = 0; o < c->m; ++o) {
    c->noise[o] = 4 * DBL_EPSILON * fabs(c->y[o]);
  }
  kg_status status = measure_noise(c, ldexp(1, -44));
  return status == KG_OK ? measure_noise(c, ldexp(1, -22)) : status;
}

/* (f(x + h e_j) - f(x - h e_j)) / 2h of all outputs */
static kg_status central_difference(check *c, size_t j, double h, double *difference)
{
  memcpy(c->point, c->x, c->n * sizeof *c->x);
  c->point[j] = c->x[j] + h;
  kg_status status = value_near(c, c->point, c->plus);
  const double above = c->point[j];
  c->point[j] = c->x[j] - h;
  if (status == KG_OK) status = value_near(c, c->point, c->minus);
  for (size_t o = 0; o < c->m; ++o) {
    difference[o] = (c->plus[o] - c->minus[o]) / (above - c->point[j]);
  }
  return status;
}

/* One row of the table for output o: column k is free of the error terms up to h^2k. The best entry
 * so far and its error, the larger of its distances to the two it was made from, are kept
 * [Ridders]. */
static void extrapolate(check *c, const double *above, double *row, int i, size_t o, double h)
{
  double factor = ratio * ratio;
  for (int k = 1; k <= i; ++k, factor *= ratio * ratio) {
    const double from = row[(size_t)(k - 1) * c->m + o], coarse = above[(size_t)(k - 1) * c->m + o];
    const double to = (from * factor - coarse) / (factor - 1);
    row[(size_t)k * c->m + o] = to;
    const double change = fmax(fabs(to - from), fabs(to - coarse));
    const double estimate = change + c->noise[o] / h;
    if (isfinite(to) && isfinite(coarse) && estimate <= c->estimate[o]) {
      c->estimate[o] = estimate;
      c->derivative[o] = to;
    }
  }
}

static kg_status extrapolated_differences(check *c, size_t j, double h)
{
  for (size_t o = 0; o < c->m; ++o) {
    c->derivative[o] = NAN;
    c->estimate[o] = HUGE_VAL;
  }
  kg_status status = KG_OK;
  for (int i = 0; i < ROWS && status == KG_OK; ++i, h /= ratio) {
    double *row = c->table[i % 2];
    status = central_difference(c, j, h, row);
    for (size_t o = 0; o < c->m; ++o) {
      extrapolate(c, c->table[(i + 1) % 2], row, i, o, h);
    }
  }
  return status;
}

/* Takes the table's answer where it is the surer one, and where it clearly contradicts that of the
 * larger steps: they skipped something. */
static bool keep_better(check *c, size_t j)
{
  bool kept = false;
  for (size_t o = 0; o < c->m; ++o) {
    double *N = &c->N[o * c->n + j], *E = &c->E[o * c->n + j];
    const double apart = fabs(c->derivative[o] - *N);
    if (!(*E <= c->estimate[o]) || apart > trust * (*E + c->estimate[o])) {
      *N = c->derivative[o];
      *E = c->estimate[o];
      kept = true;
    }
  }
  return kept;
}

/* No reason to look closer: analytic and numerical entries agree, and the estimate is good
 * enough. */
static bool settled(const check *c, size_t j)
{
  for (size_t o = 0; o < c->m; ++o) {
    const double a = c->J[o * c->n + j], N = c->N[o * c->n + j], E = c->E[o * c->n + j];
    const double size = fmax(fabs(a), fabs(N));
    if (!(fabs(a - N) <= fmax(c->tolerance * size, trust * E)) ||
        !(trust * E <= c->tolerance * fmax(size, c->largest))) {
      return false;
    }
  }
  return true;
}

static kg_status difference_column(check *c, size_t j)
{
  for (size_t o = 0; o < c->m; ++o) {
    c->N[o * c->n + j] = NAN;
    c->E[o * c->n + j] = HUGE_VAL;
  }
  kg_status status = KG_OK;
  double reach = unit_of(c, j);
  for (int scale = 0; scale < SCALES && status == KG_OK; ++scale, reach /= 50) {
    status = extrapolated_differences(c, j, c->def->step * reach);
    if (keep_better(c, j)) c->reach[j] = reach;
    if (settled(c, j)) break;
  }
  return status;
}

/* -- judgement of the entries ------------------------------------------------------------------ */

static double over(double error, double size)
{
  return error == 0 ? 0 : error / size;
}

/* what the error of entry (o, j) is put over */
static double size_of_entry(const check *c, size_t o, size_t j, double a)
{
  const double N = c->N[o * c->n + j], E = c->E[o * c->n + j];
  const bool exact = c->f->complex_step != NULL;
  const double least = (exact ? 1e-2 : 1e-5) * c->size / unit_of(c, j);
  const double largest = fmax(fmax(c->largest, fabs(N)), least);
  return exact ? largest : fmax(fmax(fabs(a), fabs(N)), fmin(largest, trust * E / c->tolerance));
}

static void judge(check *c, size_t o, size_t j, double a, double N, double size)
{
  kg_gradcheck_report *r = c->report;
  const double error = over(fabs(a - N), size);
  if (isnan(r->max_relative_error) || error <= r->max_relative_error) return;
  r->max_relative_error = error;
  r->worst_output = o;
  r->worst_input = j;
  r->worst_analytic = a;
  r->worst_numeric = N;
}

static void judge_entry(check *c, size_t o, size_t j)
{
  const size_t at = o * c->n + j;
  const double size = size_of_entry(c, o, j, c->J[at]);
  const double estimate = over(c->E[at], size);
  judge(c, o, j, c->J[at], c->N[at], size);
  if (c->f->jvp) judge(c, o, j, c->forward[at], c->N[at], size_of_entry(c, o, j, c->forward[at]));
  if (!(estimate <= c->report->error_estimate)) c->report->error_estimate = estimate;
}

/* f(x) itself is NaN or infinite: no entry means anything beside it */
static void judge_value(check *c, size_t o)
{
  c->report->not_a_number = true;
  judge(c, o, 0, c->y[o], NAN, 1);
}

static kg_status check_entries(check *c)
{
  kg_status status = analytic_rows(c);
  if (status == KG_OK && c->f->jvp) status = analytic_columns(c);
  for (size_t j = 0; j < c->n && status == KG_OK; ++j) {
    c->reach[j] = own_reach(c, j);
    status = c->f->complex_step ? complex_column(c, j) : difference_column(c, j);
  }
  for (size_t o = 0; o < c->m && status == KG_OK; ++o) {
    if (!isfinite(c->y[o])) judge_value(c, o);
  }
  for (size_t o = 0; o < c->m && status == KG_OK; ++o) {
    for (size_t j = 0; j < c->n; ++j) {
      judge_entry(c, o, j);
    }
  }
  return status;
}

/* -- dot test ---------------------------------------------------------------------------------- */

static kg_status dot_test(check *c)
{
  random_direction(c, c->d, c->n);
  random_direction(c, c->w, c->m);
  for (size_t o = 0; o < c->m; ++o) {
    c->plus[o] = dot(c->J + o * c->n, c->d, c->n);
  }
  kg_status status = c->f->jvp ? jvp(c, c->d, c->plus) : KG_OK;
  if (status == KG_OK) status = vjp(c, c->w, c->xw);
  const double one = dot(c->w, c->plus, c->m), other = dot(c->xw, c->d, c->n);
  const double size = sqrt(dot(c->w, c->w, c->m) * dot(c->plus, c->plus, c->m)) +
                      sqrt(dot(c->xw, c->xw, c->n) * dot(c->d, c->d, c->n));
  const double difference = over(fabs(one - other), size);
  if (!(difference <= c->report->dot_test)) c->report->dot_test = difference;
  return status;
}

/* -- Taylor orders ----------------------------------------------------------------------------- */

static double median(double *a, int count)
{
  for (int i = 1; i < count; ++i) {
    for (int k = i; k > 0 && a[k] < a[k - 1]; --k) {
      const double swap = a[k];
      a[k] = a[k - 1];
      a[k - 1] = swap;
    }
  }
  return a[count / 2];
}

/* Median order over the last five halvings whose remainders stand clear of the rounding errors: of
 * those measured, and of what is left nine halvings later, where even order 1 leaves 1/512. +inf
 * when there are fewer than five, or when the remainder falls to rounding all at once: f is linear
 * from there on. */
static double order_of(const check *c, size_t o)
{
  enum { LATER = 9, NEEDED = 5 };
  double order[NEEDED], noise = c->noise[o];
  int count = 0;
  for (int k = HALVINGS - 1; k >= 0 && count < NEEDED; --k) {
    const double *R = c->remainder + (size_t)k * c->m + o;
    if (k + LATER < HALVINGS) noise = fmax(noise, R[LATER * c->m]);
    if (k + 2 * LATER >= HALVINGS) continue;
    const double coarse = R[0], fine = R[c->m], next = R[2 * c->m];
    const bool clear = fine > 50 * noise && coarse > 50 * noise && coarse < HUGE_VAL;
    if (clear && count == 0 && fine > 1000 * fmax(next, noise)) return HUGE_VAL;
    if (clear) order[count++] = log2(coarse / fine);
    if (!clear && count) break;
  }
  return count < NEEDED ? HUGE_VAL : median(order, count);
}

/* along d, which is scaled to the steps that settled */
static kg_status taylor_remainders(check *c)
{
  kg_status status = KG_OK;
  for (int k = 0; k < HALVINGS && status == KG_OK; ++k) {
    const double h = ldexp(c->def->step, -k);
    for (size_t j = 0; j < c->n; ++j) {
      c->point[j] = c->x[j] + h * c->reach[j] * c->d[j];
    }
    status = value_near(c, c->point, c->plus);
    for (size_t j = 0; j < c->n; ++j) {
      c->point[j] -= c->x[j]; /* the move that was made, rounded as it was */
    }
    for (size_t o = 0; o < c->m; ++o) {
      const double linear = dot(c->J + o * c->n, c->point, c->n);
      c->remainder[(size_t)k * c->m + o] = fabs(c->plus[o] - c->y[o] - linear);
    }
  }
  return status;
}

/* *order: the least of all outputs along one direction */
static kg_status taylor_order(check *c, double *order)
{
  kg_status status = measure_noise(c, ldexp(c->def->step, -18));
  if (status == KG_OK) status = taylor_remainders(c);
  *order = HUGE_VAL;
  for (size_t o = 0; o < c->m && status == KG_OK; ++o) {
    *order = fmin(*order, order_of(c, o));
  }
  return status;
}

/* A direction in which the derivative looks wrong is followed by another: a wrong derivative is
 * wrong along all of them, one that bends at a place nearby is not. */
static kg_status taylor_test(check *c)
{
  double order, another;
  kg_status status = taylor_order(c, &order);
  if (status == KG_OK && order < least_order) {
    status = taylor_order(c, &another);
    order = fmax(order, another);
  }
  c->report->taylor_order = fmin(c->report->taylor_order, order);
  return status;
}

static kg_status check_directions(check *c)
{
  if (c->def->taylor) c->report->taylor_order = HUGE_VAL;
  kg_status status = KG_OK;
  for (int k = 0; k < c->def->directions && status == KG_OK; ++k) {
    status = dot_test(c);
    if (status == KG_OK && c->def->taylor) status = taylor_test(c);
  }
  return status;
}

/* -- repeated calls ---------------------------------------------------------------------------- */

typedef struct answers {
  double *y, *xw, *yd;
} answers;

/* value, vjp and jvp at x, with the same seeds every time */
static kg_status ask(check *c, answers *a)
{
  kg_random random = kg_random_make(c->def->seed ^ 0x5eed);
  for (size_t i = 0; i < c->m; ++i) {
    c->w[i] = kg_random_normal(&random);
  }
  for (size_t i = 0; i < c->n; ++i) {
    c->d[i] = kg_random_normal(&random);
  }
  kg_status status = value(c, c->x, a->y);
  if (status == KG_OK) status = vjp(c, c->w, a->xw);
  return status == KG_OK && c->f->jvp ? jvp(c, c->d, a->yd) : status;
}

static answers make_answers(check *c)
{
  return (answers){numbers(c, c->m), numbers(c, c->n), numbers(c, c->m)};
}

static void compare(check *c, const answers *a, const answers *b)
{
  const size_t m = c->m * sizeof *a->y, n = c->n * sizeof *a->xw;
  if (memcmp(a->y, b->y, m) != 0 || memcmp(a->xw, b->xw, n) != 0 || memcmp(a->yd, b->yd, m) != 0) {
    c->report->repeatable = false;
  }
}

/* -- the check --------------------------------------------------------------------------------- */

kg_gradcheck_def kg_gradcheck_default_def(void)
{
  return (kg_gradcheck_def){.tolerance = 1e-7,
                            .complex_tolerance = 1e-12,
                            .dot_tolerance = 1e-13,
                            .step = 1e-2,
                            .directions = 3,
                            .taylor = true,
                            .seed = 1};
}

static void decide(const check *c, kg_gradcheck_report *r)
{
  const bool entries = r->max_relative_error <= c->tolerance && r->error_estimate <= c->tolerance;
  const bool others =
    r->dot_test <= c->def->dot_tolerance && !(r->taylor_order < least_order) && r->repeatable;
  r->passed = entries && others;
  r->undecided = others && !entries && r->max_relative_error <= trust * r->error_estimate;
}

static kg_status run(check *c)
{
  answers first = make_answers(c), again = make_answers(c);
  if (!reserve(c)) {
    return kg_fail(c->error, KG_ERR_NO_MEMORY, "", 0, 0, "%s: no memory to check it", c->f->name);
  }
  kg_status status = ask(c, &first);
  if (status == KG_OK) status = ask(c, &again);
  if (status != KG_OK) return status;
  compare(c, &first, &again);
  memcpy(c->y, first.y, c->m * sizeof *c->y);
  c->size = largest_of(c->y, c->m, 0);
  status = measure_first_noise(c);
  if (status == KG_OK) status = check_entries(c);
  if (status == KG_OK) status = check_directions(c);
  if (status == KG_OK) status = ask(c, &again); /* after other points were asked for */
  if (status == KG_OK) compare(c, &first, &again);
  if (status == KG_OK) decide(c, c->report);
  return status;
}

static kg_status refuse_incomplete(const kg_differentiable *f, kg_error *error)
{
  if (f->value && f->vjp) return KG_OK;
  return kg_fail(error, KG_ERR_UNDEFINED, "", 0, 0, "%s: brings no %s, which a check needs",
                 f->name, f->value ? "vjp" : "value");
}

kg_status kg_gradcheck(const kg_differentiable *function, const double *x,
                       const kg_gradcheck_def *def, kg_gradcheck_report *report, kg_error *error)
{
  const kg_gradcheck_def settings = def ? *def : kg_gradcheck_default_def();
  const bool exact = function->complex_step != NULL;
  check c = {.f = function,
             .def = &settings,
             .x = x,
             .n = function->inputs,
             .m = function->outputs,
             .random = kg_random_make(settings.seed),
             .error = error,
             .report = report,
             .tolerance = exact ? settings.complex_tolerance : settings.tolerance};
  *report = (kg_gradcheck_report){.name = function->name,
                                  .method = exact ? "complex step" : "differences",
                                  .tolerance = c.tolerance,
                                  .taylor_order = NAN,
                                  .repeatable = true};
  kg_status status = refuse_incomplete(function, error);
  if (status != KG_OK) return status;
  kg_arena_init(&c.arena, settings.allocator);
  status = run(&c);
  kg_arena_release(&c.arena);
  return status;
}

static double worse(double a, double b)
{
  return isnan(a) || a >= b ? a : b;
}

void kg_gradcheck_merge(kg_gradcheck_report *worst, const kg_gradcheck_report *r)
{
  const double known = worst->max_relative_error / worst->tolerance;
  const bool keep = isnan(known) || known >= r->max_relative_error / r->tolerance;
  kg_gradcheck_report sum = keep ? *worst : *r;
  sum.name = worst->name;
  sum.passed = worst->passed && r->passed;
  sum.undecided = !sum.passed && (worst->passed || worst->undecided) && (r->passed || r->undecided);
  sum.error_estimate = worse(worst->error_estimate, r->error_estimate);
  sum.dot_test = worse(worst->dot_test, r->dot_test);
  sum.taylor_order = fmin(worst->taylor_order, r->taylor_order);
  sum.repeatable = worst->repeatable && r->repeatable;
  *worst = sum;
}

/* -- recorded functions ------------------------------------------------------------------------ */

typedef struct recorded {
  kg_tape *tape;
  kg_recorded function;
  void *user;
  kg_shape shape;
  kg_value x, y;
  kg_gradcheck_truth truth;
  kg_program *program; /* of the truth, in complex arithmetic */
} recorded;

static kg_status record(recorded *r, kg_recorded function, const double *x)
{
  kg_tape_rewind(r->tape, (kg_tape_mark){0});
  r->x = kg_input(r->tape, r->shape, x);
  r->y = function(r->tape, r->x, r->user);
  const kg_status status = kg_tape_status(r->tape);
  return status == KG_OK && kg_is_null(r->y) ? KG_ERR_UNDEFINED : status;
}

static kg_status recorded_value(void *user, const double *x, double *y)
{
  recorded *r = user;
  const kg_status status = record(r, r->function, x);
  if (status == KG_OK) {
    memcpy(y, kg_data(r->tape, r->y), kg_size_of(r->tape, r->y) * sizeof *y);
  }
  return status;
}

static kg_status recorded_vjp(void *user, const double *x, const double *w, double *xw)
{
  recorded *r = user;
  const kg_status status = record(r, r->function, x);
  return status == KG_OK ? kg_vjp(r->tape, 1, 1, &r->y, &w, 1, &r->x, &xw) : status;
}

static kg_status recorded_jvp(void *user, const double *x, const double *d, double *yd)
{
  recorded *r = user;
  const kg_status status = record(r, r->function, x);
  return status == KG_OK ? kg_jvp(r->tape, 1, 1, &r->x, &d, 1, &r->y, &yd) : status;
}

/* complex numbers are pairs of doubles */
static kg_status recorded_complex_step(void *user, const double *x, const double *d, double *yd)
{
  (void)x;
  const double h = 1e-100;
  recorded *r = user;
  double *in = kg_program_input(r->program, 0);
  for (size_t i = 0; i < kg_program_input_size(r->program, 0); ++i) {
    in[2 * i] = r->truth.at[i];
    in[2 * i + 1] = h * d[i];
  }
  const kg_status status = kg_program_run(r->program);
  const double *out = kg_program_output(r->program, 0);
  for (size_t o = 0; o < kg_program_output_size(r->program, 0); ++o) {
    yd[o] = out[2 * o + 1] / h;
  }
  return status;
}

static kg_status no_slope(void *user, const double *x, const double *d, double *yd)
{
  const recorded *r = user;
  (void)x, (void)d;
  memset(yd, 0, kg_size_of(r->tape, r->y) * sizeof *yd);
  return KG_OK;
}

static kg_status record_or_say(recorded *r, kg_recorded function, const char *name, const double *x,
                               kg_error *error)
{
  const kg_status status = record(r, function, x);
  if (status == KG_OK) return KG_OK;
  return kg_fail(error, status, "", 0, 0, "%s: %s", name, kg_tape_error(r->tape)->text);
}

/* A primitive without complex form takes its JVP for a complex step: no independent answer. */
static bool has_complex_form(const kg_tape *tape)
{
  for (uint32_t i = 0; i < tape->graph.count; ++i) {
    const kg_node *node = &tape->graph.node[i];
    if (node->op != kg_op_primitive) continue;
    const kg_primitive_attributes *a = node->is.block->attributes;
    if (!a->primitive->complex_forward) return false;
  }
  return true;
}

static bool has_jvp(const kg_tape *tape)
{
  for (uint32_t i = 0; i < tape->graph.count; ++i) {
    const kg_node *node = &tape->graph.node[i];
    if (node->op != kg_op_primitive) continue;
    const kg_primitive_attributes *a = node->is.block->attributes;
    if (!a->primitive->jvp) return false;
  }
  return true;
}

/* the program stays NULL when something in the record has no complex form */
static kg_status freeze_truth(recorded *r, const char *name, kg_error *error)
{
  kg_status status = record_or_say(r, r->truth.reference, name, r->truth.at, error);
  if (status != KG_OK || !has_complex_form(r->tape)) return status;
  kg_program_def def = kg_program_default_def();
  def.arithmetic_complex = true;
  def.allocator = r->tape->graph.allocator;
  return kg_program_create(&def, r->tape, 1, &r->x, 1, &r->y, &r->program, error);
}

/* the truth's values at x, real parts of the last complex step, against those of the function */
static kg_status compare_values(recorded *r, const double *x, kg_gradcheck_report *report)
{
  const double *reference = kg_program_output(r->program, 0);
  const size_t m = kg_program_output_size(r->program, 0);
  const kg_status status = record(r, r->function, x);
  double largest = 0, difference = 0;
  for (size_t o = 0; status == KG_OK && o < m; ++o) {
    largest = fmax(largest, fabs(reference[2 * o]));
    difference = fmax(difference, fabs(reference[2 * o] - kg_item_at(r->tape, r->y, o)));
  }
  if (!(difference <= report->tolerance * largest)) {
    report->passed = report->undecided = false;
    report->max_relative_error = fmax(report->max_relative_error, over(difference, largest));
  }
  return status;
}

static kg_status check_recorded(recorded *r, const char *name, const double *x,
                                const kg_gradcheck_def *def, kg_gradcheck_report *report,
                                kg_error *error)
{
  kg_status status = r->truth.at ? freeze_truth(r, name, error) : KG_OK;
  if (status == KG_OK) status = record_or_say(r, r->function, name, x, error);
  if (status != KG_OK) return status;
  const kg_differentiable f = {.name = name,
                               .inputs = kg_size_of(r->tape, r->x),
                               .outputs = kg_size_of(r->tape, r->y),
                               .user = r,
                               .value = recorded_value,
                               .vjp = recorded_vjp,
                               .jvp = has_jvp(r->tape) ? recorded_jvp : NULL,
                               .complex_step = r->program     ? recorded_complex_step
                                               : !r->truth.at ? no_slope
                                                              : NULL};
  status = kg_gradcheck(&f, x, def, report, error);
  return status == KG_OK && r->program && r->truth.at == x ? compare_values(r, x, report) : status;
}

kg_status kg_gradcheck_against(const char *name, kg_recorded function, void *user, kg_shape shape,
                               const double *x, const kg_gradcheck_truth *truth,
                               const kg_gradcheck_def *def, kg_gradcheck_report *report,
                               kg_error *error)
{
  recorded r = {.function = function, .user = user, .shape = shape, .truth = *truth};
  kg_tape_def settings = kg_tape_default_def();
  settings.allocator = def ? def->allocator : NULL;
  kg_status status = kg_tape_create(&settings, &r.tape, error);
  if (status == KG_OK) status = check_recorded(&r, name, x, def, report, error);
  kg_program_destroy(r.program);
  kg_tape_destroy(r.tape);
  return status;
}

kg_status kg_gradcheck_recorded(const char *name, kg_recorded function, void *user, kg_shape shape,
                                const double *x, const kg_gradcheck_def *def,
                                kg_gradcheck_report *report, kg_error *error)
{
  const kg_gradcheck_truth itself = {function, x};
  return kg_gradcheck_against(name, function, user, shape, x, &itself, def, report, error);
}

/* -- primitives at their own samples ----------------------------------------------------------- */

typedef struct sampled {
  const kg_primitive *primitive;
  int count;
  kg_shape shapes[KG_MAX_OPERANDS];
  double *in[KG_MAX_OPERANDS];
} sampled;

/* the operands cut out of x, which holds them end to end */
static kg_value apply_sampled(kg_tape *tape, kg_value x, void *user)
{
  const sampled *s = user;
  kg_value operands[KG_MAX_OPERANDS];
  int start = 0;
  for (int k = 0; k < s->count; ++k) {
    const int size = (int)kg_shape_size(&s->shapes[k]);
    operands[k] = kg_reshape(tape, kg_slice(tape, x, 0, start, size), s->shapes[k]);
    start += size;
  }
  return kg_apply(tape, s->primitive, s->count, operands);
}

static kg_status check_sample(const kg_primitive *primitive, int index, kg_random *random,
                              kg_arena *arena, const kg_gradcheck_def *def,
                              kg_gradcheck_report *report, kg_error *error)
{
  sampled s = {.primitive = primitive};
  s.count = primitive->sample(primitive->user, random, index, arena, s.shapes, s.in);
  size_t size = 0;
  for (int k = 0; k < s.count; ++k) {
    size += kg_shape_size(&s.shapes[k]);
  }
  double *x = s.count > 0 ? KG_ARENA_ARRAY(arena, double, size) : NULL;
  if (!x) {
    return kg_fail(error, s.count > 0 ? KG_ERR_NO_MEMORY : KG_ERR_UNDEFINED, "", 0, 0,
                   "%s: sample %d gave no operands", primitive->name, index);
  }
  for (int k = 0, at = 0; k < s.count; at += (int)kg_shape_size(&s.shapes[k]), ++k) {
    memcpy(x + at, s.in[k], kg_shape_size(&s.shapes[k]) * sizeof *x);
  }
  return kg_gradcheck_recorded(primitive->name, apply_sampled, &s, KG_SHAPE((int32_t)size), x, def,
                               report, error);
}

kg_status kg_gradcheck_primitive(const kg_primitive *primitive, int points,
                                 const kg_gradcheck_def *def, kg_gradcheck_report *worst,
                                 kg_error *error)
{
  KG_ASSERT(primitive->sample && points > 0);
  kg_random random = kg_random_make(def ? def->seed : 1);
  kg_arena arena;
  kg_arena_init(&arena, def ? def->allocator : NULL);
  kg_status status = KG_OK;
  for (int i = 0; i < points && status == KG_OK; ++i) {
    kg_gradcheck_report report;
    const kg_arena_mark mark = kg_arena_mark_of(&arena);
    status = check_sample(primitive, i, &random, &arena, def, &report, error);
    kg_arena_rewind(&arena, mark);
    if (status != KG_OK) break;
    if (i == 0) {
      *worst = report;
    } else {
      kg_gradcheck_merge(worst, &report);
    }
  }
  kg_arena_release(&arena);
  return status;
}

/* -- a table for a terminal -------------------------------------------------------------------- */

/* where the largest error is, and what it is */
static int explain(const kg_gradcheck_report *r, char *text, size_t size)
{
  if (r->not_a_number) {
    return snprintf(text, size, ": the value y[%zu] is %s", r->worst_output,
                    isnan(r->worst_analytic) ? "not a number" : "infinite");
  }
  return snprintf(text, size, ": dy[%zu]/dx[%zu] is given as %.9g, found %.9g", r->worst_output,
                  r->worst_input, r->worst_analytic, r->worst_numeric);
}

int kg_gradcheck_row(const kg_gradcheck_report *r, char *text, size_t size)
{
  if (!r) {
    return snprintf(text, size, "%-28s %-12s %9s %9s %9s %6s  %s", "function", "method", "error",
                    "+-", "dot test", "order", "verdict");
  }
  int length = snprintf(text, size, "%-28s %-12s %9.1e %9.1e %9.1e %6.2f  %s%s", r->name, r->method,
                        r->max_relative_error, r->error_estimate, r->dot_test, r->taylor_order,
                        r->passed      ? "ok"
                        : r->undecided ? "undecided"
                                       : "FAILED",
                        r->repeatable ? "" : ", not repeatable");
  if (!(r->max_relative_error <= r->tolerance) && length >= 0) {
    const size_t used = (size_t)length < size ? (size_t)length : size;
    length += explain(r, size ? text + used : NULL, size - used);
  }
  return length;
}
