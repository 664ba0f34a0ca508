/* Other ways out of a scene; symbols in correction.h.
 *
 * (24) has many minima in deep poses, and steps from no move end at the one that the first
 * linearisation points to. Most of the shorter ones they miss have one segment turned far about an
 * axis about which it is light: a foot that rolls about its length instead of being lifted with the
 * leg. So ways begin there, too: with the least move that turns one segment, which is inside, by an
 * angle a about an axis u of the world,
 *   D = a M^-1 J'u / u'A u,    A = J M^-1 J',    |D|^2 = a^2 / u'A u,                            (32)
 * J (3, nv) the Jacobian of the segment's angular velocity at q0, u an eigenvector of A. */
#include "physics/correction.h"

#include "kinegrad/dense.h"
#include "physics/principal.h"

#include <string.h>

/* Axes of A that are tried, those about which the segment is lightest; each both ways. */
enum { AXES = 2 };

/* a at the start (rad) */
#define TURN 1.7
/* A move shorter than the answer turns the segment about u by less than |answer| (u'A u)^1/2. When that
 * is below LEAST_TURN (rad) there is nothing to look for; above MOST_TURN the turn is nothing beside
 * the answer: a toe under a lying body. */
#define LEAST_TURN 1.0
#define MOST_TURN 10.0
/* A way is given up when its steps lead to a move longer than this many times the answer. */
#define SLACK 1.2
/* A segment whose turn makes the answer shorter than this share stays turned on the ways that follow. */
#define GAIN 0.98

void correction_starts_init(kg_correction *c, kg_arena *arena)
{
  const int nv = c->nv, segments = c->def.body->segment_count;
  const bool are_tried = c->def.method == KG_CORRECTION_SECOND_ORDER && c->def.starts > 1;
  const int most = are_tried ? 2 * AXES * segments : 0;
  c->starts = KG_ARENA_ARRAY(arena, correction_start, most);
  double *D = KG_ARENA_ARRAY(arena, double, (size_t)most *(size_t)nv);
  c->turns = KG_ARENA_ARRAY(arena, double, 3 * nv);
  c->turned = KG_ARENA_ARRAY(arena, double, 3 * nv);
  c->is_inside = KG_ARENA_ARRAY(arena, bool, segments);
  c->answer.D = KG_ARENA_ARRAY(arena, double, nv);
  c->answer.multiplier = KG_ARENA_ARRAY(arena, double, c->key_count);
  for (int k = 0; k < most && !kg_arena_failed(arena); k++) {
    c->starts[k].D = D + (size_t)k * (size_t)nv;
  }
}

/* D, sampled, becomes the answer when it is free and shorter. */
static void take_answer(kg_correction *c, int iterations, kg_correction_report *report)
{
  const double length = sqrt(correction_metric(c, c->D, c->D));
  if (!(c->d_pen <= c->def.tolerance && length < c->answer.length)) return;
  c->answer.length = length;
  memcpy(c->answer.D, c->D, (size_t)c->nv * sizeof *c->D);
  memcpy(c->answer.multiplier, c->multiplier, (size_t)c->key_count * sizeof *c->multiplier);
  report->iterations_of_answer = iterations;
}

static void give_answer(kg_correction *c)
{
  memcpy(c->D, c->answer.D, (size_t)c->nv * sizeof *c->D);
  memcpy(c->multiplier, c->answer.multiplier, (size_t)c->key_count * sizeof *c->multiplier);
}

/* A of a segment at q0, which is sampled; c->turns: J, c->turned: J M^-1 */
static kg_mat3 mobility(kg_correction *c, int segment)
{
  const int nv = c->nv;
  memset(c->turns, 0, 3 * (size_t)nv * sizeof *c->turns);
  for (int i = segment; i >= 0; i = c->def.body->segments[i].parent) {
    for (int k = 0; k < 9; k++) {
      c->turns[k / 3 * nv + 3 + 3 * i + k % 3] = c->R[i].m[k];
    }
  }
  memcpy(c->turned, c->turns, 3 * (size_t)nv * sizeof *c->turns);
  kg_mat3 A;
  for (int a = 0; a < 3; a++) {
    kg_dense_cholesky_solve(c->chol, nv, c->turned + a * nv, 1);
    for (int b = 0; b <= a; b++) {
      A.m[3 * a + b] = A.m[3 * b + a] = correction_dot(c->turned + a * nv, c->turns + b * nv, nv);
    }
  }
  return A;
}

/* Axis with the next smaller yield; `used` gets it. */
static int next_axis(const kg_mat3 *yield, bool used[3])
{
  int axis = -1;
  for (int a = 0; a < 3; a++) {
    if (!used[a] && (axis < 0 || yield->m[4 * a] > yield->m[4 * axis])) axis = a;
  }
  used[axis] = true;
  return axis;
}

/* Appends the turns of a segment that may lead to a shorter move. */
static int add_turns(kg_correction *c, int segment, int count)
{
  const int nv = c->nv;
  kg_mat3 A = mobility(c, segment);
  const kg_mat3 V = principal_diagonalise(&A);
  bool used[3] = {false, false, false};
  for (int rank = 0; rank < AXES; rank++) {
    const int u = next_axis(&A, used);
    const double yield = A.m[4 * u], reach = c->answer.length * sqrt(yield);
    if (!(reach > LEAST_TURN && reach < MOST_TURN)) continue;
    for (int side = -1; side <= 1; side += 2) {
      correction_start *s = &c->starts[count++];
      s->segment = segment;
      for (int i = 0; i < nv; i++) {
        s->D[i] = side * TURN / yield *
                  (V.m[u] * c->turned[i] + V.m[3 + u] * c->turned[nv + i] +
                   V.m[6 + u] * c->turned[2 * nv + i]);
      }
    }
  }
  return count;
}

static int find_starts(kg_correction *c)
{
  int count = 0;
  const int segments = c->def.body->segment_count;
  memset(c->is_inside, 0, (size_t)segments * sizeof *c->is_inside);
  memset(c->D, 0, (size_t)c->nv * sizeof *c->D);
  correction_go_to(c, c->D);
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    if (t->at.distance < 0.0) c->is_inside[c->def.body->points[t->point].segment] = true;
  }
  for (int i = 0; i < segments; i++) {
    if (c->is_inside[i]) count = add_turns(c, i, count);
  }
  return count;
}

static void begin_at(kg_correction *c, const correction_start *s)
{
  memcpy(c->D, s->D, (size_t)c->nv * sizeof *c->D);
  memset(c->multiplier, 0, (size_t)c->key_count * sizeof *c->multiplier);
  correction_go_to(c, c->D);
}

/* Takes the start that promises the shortest move to the end of the list. */
static const correction_start *take_next(kg_correction *c, int count)
{
  int next = 0;
  for (int k = 1; k < count; k++) {
    if (c->starts[k].length < c->starts[next].length) next = k;
  }
  const correction_start start = c->starts[next];
  c->starts[next] = c->starts[count - 1];
  c->starts[count - 1] = start;
  return &c->starts[count - 1];
}

static bool is_on_path(const kg_body *body, int segment, int to_root_from)
{
  int i = to_root_from;
  while (i > segment) {
    i = body->segments[i].parent;
  }
  return i == segment;
}

/* The starts left that turn what neither bears nor hangs from a good start's segment: with its turn. */
static void add_to_others(kg_correction *c, const correction_start *good, int count)
{
  const kg_body *body = c->def.body;
  for (int k = 0; k < count; k++) {
    correction_start *s = &c->starts[k];
    if (is_on_path(body, s->segment, good->segment)) continue;
    if (is_on_path(body, good->segment, s->segment)) continue;
    for (int i = 0; i < c->nv; i++) {
      s->D[i] += good->D[i];
    }
  }
}

void correction_try_starts(kg_correction *c, kg_correction_report *report)
{
  c->answer.length = INFINITY;
  correction_go_to(c, c->D);
  take_answer(c, report->iterations, report);
  if (!(c->answer.length < INFINITY)) return;
  int count = find_starts(c);
  for (int k = 0; k < count; k++) {
    begin_at(c, &c->starts[k]);
    c->starts[k].length = correction_promise(c);
  }
  report->iterations += count;
  for (; count > 0 && report->starts < c->def.starts; count--, report->starts++) {
    const correction_start *start = take_next(c, count);
    const double before = c->answer.length;
    int iterations = 0;
    begin_at(c, start);
    if (correction_settle(c, SLACK * before, &iterations)) {
      take_answer(c, iterations + 1, report);
    }
    if (c->answer.length < GAIN * before) add_to_others(c, start, count - 1);
    report->iterations += iterations;
  }
  give_answer(c);
}
