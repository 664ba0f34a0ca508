/* Shapes of trees and states for the tests of the kernels of dynamics, and complex steps through
 * the recursions over complex numbers. */
#ifndef TESTS_FIXTURE_DYNAMICS_H
#define TESTS_FIXTURE_DYNAMICS_H

#include "fixture_body.h"
#include "fixture_step.h"

#include <complex.h>
#undef I

#include "physics/kernels/kernels.h"
#include "physics/tree.h"

/* physics/kernels/numbers.c over double complex, compiled for this test */
extern const kg_number_kernels kg_number_kernels_2_test;
/* and over eight doubles without vectors */
extern const kg_number_kernels kg_number_kernels_8_plain;

enum { BIG_NV = 120, BIG_NQ = 160 };

static inline double largest_difference(const double *a, const double *b, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    const double difference = fabs(a[k] - b[k]);
    size = difference > size || isnan(difference) ? difference : size;
    if (isnan(size)) {
      return size;
    }
  }
  return size;
}

/* ---- bodies -----------------------------------------------------------------------------------*/

typedef enum shape { ONE, CHAIN, STAR, HUMAN, THIRTY_SEVEN, BUSH, MASSLESS, SHAPES } shape;
static const char *const shape_names[SHAPES] = {"one segment", "chain", "star",    "human",
                                                "37 joints",   "bush",  "massless"};

/* A chain, or a star (every segment hangs on the root). */
static inline kg_body *rebuilt(kg_random *random, int n, bool star)
{
  kg_body *body = random_tree(random, n, NULL);
  for (int i = 1; i < n; i++) {
    body->segments[i].parent = star ? 0 : i - 1;
  }
  return body;
}

/* The human with a spine link, a clavicle and a toe that weigh nothing. The toe keeps an inertia:
 * without one its rotation would be free of any force. */
static inline kg_body *massless_body(void)
{
  kg_body *body = human_body();
  const int light[3] = {3, 7, 18};
  for (int k = 0; k < 3; k++) {
    kg_segment *s = &body->segments[light[k]];
    s->mass = 0.0;
    const double own[6] = {1e-4, 2e-4, 1.5e-4, 0.0, 0.0, 0.0};
    for (int c = 0; c < 6; c++) {
      s->inertia[c] = light[k] == 3 ? 0.0 : own[c];
    }
  }
  return body;
}

static inline kg_body *body_of(shape kind, kg_random *random)
{
  switch (kind) {
    case ONE:
      return random_tree(random, 1, NULL);
    case CHAIN:
      return rebuilt(random, 12, false);
    case STAR:
      return rebuilt(random, 20, true);
    case HUMAN:
      return human_body();
    case THIRTY_SEVEN:
      return random_tree(random, 37, NULL);
    case MASSLESS:
      return massless_body();
    default:
      return random_tree(random, 15, NULL);
  }
}

typedef struct state {
  double q[BIG_NQ], v[BIG_NV], a[BIG_NV];
} state;

/* ---- complex steps ----------------------------------------------------------------------------*/

static const double TINY = 1e-40;

typedef struct complex_model {
  kg_model model;
  double complex q[BIG_NQ], v[BIG_NV], x[BIG_NV], out[BIG_NV];
} complex_model;

static inline void complex_open(complex_model *c, const kg_dynamics *d)
{
  c->model = *d->model;
  c->model.scratch = aligned_alloc(64, (size_t)(d->n + 1) * 8192);
  assert_non_null(c->model.scratch);
  assert_true(kg_number_kernels_2_test.scratch <= 8192);
}

static inline void set_point(complex_model *c, const kg_body *body, const state *s, const double *x)
{
  for (int k = 0; k < body->nq; k++) {
    c->q[k] = s->q[k];
  }
  for (int k = 0; k < body->nv; k++) {
    c->v[k] = s->v[k];
    c->x[k] = x[k];
  }
}

/* q (+) i TINY e_k: to first order q_i (1, i TINY/2 e) */
static inline void turn(complex_model *c, const kg_body *body, int k)
{
  (void)body;
  if (k < 3) {
    c->q[k] += TINY * _Complex_I;
    return;
  }
  const int i = (k - 3) / 3, axis = (k - 3) % 3;
  double complex *r = c->q + 3 + 4 * i;
  double e[3] = {0.0, 0.0, 0.0};
  e[axis] = 0.5 * TINY;
  const double w = creal(r[0]), x = creal(r[1]), y = creal(r[2]), z = creal(r[3]);
  r[0] += _Complex_I * (-x * e[0] - y * e[1] - z * e[2]);
  r[1] += _Complex_I * (w * e[0] + y * e[2] - z * e[1]);
  r[2] += _Complex_I * (w * e[1] - x * e[2] + z * e[0]);
  r[3] += _Complex_I * (w * e[2] + x * e[1] - y * e[0]);
}

typedef void number_call(const kg_model *model, double *out, const double *q, const double *x,
                         const double *y);

/* Column k of the derivative by q (which = 0), v (1) or the last argument (2). */
static inline void complex_column(complex_model *c, const kg_body *body, number_call *call,
                                  const state *s, const double *x, int which, int k, double *column)
{
  set_point(c, body, s, x);
  if (which == 0) {
    turn(c, body, k);
  } else {
    (which == 1 ? c->v : c->x)[k] += TINY * _Complex_I;
  }
  call(&c->model, (double *)c->out, (double *)c->q, (double *)c->v, (double *)c->x);
  for (int r = 0; r < body->nv; r++) {
    column[r] = cimag(c->out[r]) / TINY;
  }
}

/* Worst difference over all columns, relative to the largest entry. */
static inline double compare_columns(complex_model *c, const kg_body *body, number_call *call,
                                     const state *s, const double *x, int which,
                                     const double *exact)
{
  const int nv = body->nv;
  double worst = 0.0, column[BIG_NV];
  for (int k = 0; k < nv; k++) {
    complex_column(c, body, call, s, x, which, k, column);
    for (int r = 0; r < nv; r++) {
      const double difference = fabs(column[r] - exact[r * nv + k]);
      worst = difference > worst || isnan(difference) ? difference : worst;
    }
  }
  return worst / largest(exact, nv * nv);
}

/* ---- frames -----------------------------------------------------------------------------------*/

static inline void to_lanes(double *lanes, const double *rows, int width)
{
  for (int k = 0; k < 8 * width; k++) {
    lanes[k] = rows[k % 8 * width + k / 8];
  }
}

#endif
