/* The kinematic method: the smallest smooth change of the poses that removes penetration.
 *
 * Unknown is the change D_t in R^nv of every frame, measured from the capture:
 *   min  1/2 sum_t |D_t|^2_W + tau^4/dt^4 |D_{t-1} - 2 D_t + D_{t+1}|^2_W
 *   s.t. Phi(x_k(q_t (+) D_t)) >= 0   for every point k and frame t
 * and, where the subject's body is in its own way, the same against the segments of kinegrad/self.h.
 * W is the diagonal of the mass matrix in the first frame, light joints made heavier and the
 * root's position lighter. The second differences are why nothing
 * pops: a change is eased in and out over about tau before and after a contact. Limbs that overlap, of one
 * body or of two, go to the side that pipeline/overlaps.h has chosen for all frames of the overlap.
 *
 * Linearised in D (rows g = n'J), the dual is a quadratic over y >= 0 with the operator
 *   G (A kron W)^-1 G',   A = I + tau4 D2'D2 (smoother.c),
 * and is solved by the accelerated projected gradient of [BT] with a step for each row, which starts from
 * the answer of the last linearisation: few steps are enough. Of all changes the one whose deepest point is
 * least deep is kept: near corners linearisations can go round in a circle. What is left,
 * fractions of a millimetre that change faster than tau, is removed frame by frame by the correction
 * of kinegrad/correction.h, down to its tolerance.
 *
 * [BT] A. Beck, M. Teboulle, A fast iterative shrinkage-thresholding algorithm, SIAM J. Imaging
 *      Sciences 2(1), 2009, (4.1) to (4.3). */
#include "pipeline/pipeline.h"

#include "kinegrad/correction.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/self.h"
#include "kinegrad/stage.h"
#include "physics/near_points.h"
#include "physics/physics.h"
#include "pipeline/overlaps.h"

#include <pthread.h>
#include <string.h>
#include <time.h>

enum { LINEARISATIONS = 10, MOST_LINEARISATIONS = 20, DUAL_ITERATIONS = 20, MAX_THREADS = 16 };

static const double EASE_TIME_S = 0.1;
static const double NEAR_M = 0.004; /* points nearer than this get a row        */
/* and these between limbs: without a row a touch that one linearisation parts is back in the next */
static const double LIMB_NEAR_M = 0.03;
static const double LEAST_WEIGHT = 0.1; /* kg m^2; of a light joint: legs move, not toes alone */
static const double ROOT_SHARE =
  0.1; /* the body rises rather than folds straight legs, whose knees jerk */
static const double DUAL_M = 2e-6;    /* miss of a row at which the dual is solved  */
static const double SHALLOW_M = 1e-3; /* what the last pass takes away without a pop */
static const double AIM_M = 2e-5;     /* distance asked for, above the tolerance  */
static const double PART_M = 0.005;   /* the same between limbs that a simulation will follow */

static const double LEAST_ARM_M =
  1e-3; /* shorter ones cannot move a point out of the body itself */

/* Columns on the way of a segment to the root, the root's position first; of two segments, on both
 * ways to where they meet, which itself moves both alike. */
typedef struct path {
  int count;
  int *column;  /* of v                                            */
  int *compact; /* among the columns that the rows have            */
  bool used;    /* by a row                                        */
} path;

/* One constraint: point k in frame t. Its row is stored over the columns of its path. */
typedef struct row {
  int frame;
  int key; /* point, or point + number of points against the body itself */
  path *path;
  size_t first; /* of its entries in `entries`, in the order of the path */
  double scale; /* its bound times this is the distance, m^-1 kg^-1/2    */
  double bound; /* g D >= bound                                               */
  double step;  /* of the dual                                                */
  double y, z;  /* dual variable and its extrapolation                        */
} row;

typedef struct smoothing {
  const kg_subject *subject;
  const kg_body *body;
  kg_dynamics *dynamics;
  kg_stage *stage;
  kg_correct_result *result;
  double *q;          /* (T, nq) scratch, and the answer */
  kg_stage_part part; /* of the scene                    */
  double self_aim;    /* distance asked for between parts of the body, m */
  int T, nv;
  double *D;    /* (T, nv) change                                              */
  double *best; /* (T, nv) the change with the least depth so far     */
  double depth; /* of the deepest point, m */
  double *W;    /* (nv)                                                        */
  path *paths;  /* (path_count) of segments, then of pairs of them; empty where no point can be
                      near                                                        */
  int path_count, key_count;
  kg_self *self;               /* NULL: the body is not in its own way */
  kg_self_touch *self_touches; /* (points)                             */
  kg_overlaps *overlaps;       /* with itself and with another athlete */
  int *column_of;              /* (width) column of v; -1: padding                            */
  int *compact_of;             /* (nv) and back; -1: not among them                     */
  int width;                   /* columns that the rows have, padded to whole blocks    */
  double *trial;               /* (T, width) A^-1 W^-1 G' z                                   */
  near_points near;
  double *force;       /* (T, keys) y of the last linearisation, rows not normalised */
  double *other_start; /* (MAX_THREADS, nq) of the workers at the end              */
  kg_arena row_memory; /* of rows and entries */
  row *rows;
  size_t row_count, row_room;
  double *entries;
  size_t entry_count, entry_room;
  kg_smoother smoother;
  kg_vec3 *p;
  kg_mat3 *R;
  kg_scene_hint *hints; /* (points) of the frame before */
} smoothing;

/* n'J of x on a segment, over the joints from there to `end`, which is left out */
static double *write_chain(const smoothing *s, double *g, int segment, int end, kg_vec3 x,
                           kg_vec3 normal)
{
  for (int i = segment; i != end; i = s->body->segments[i].parent) {
    /* n' (R e_k x (x - p)) = e_k' R' ((x - p) x n) */
    kg_store3(g, kg_mat3_mul_vec_t(s->R[i], kg_vec3_cross(kg_vec3_sub(x, s->p[i]), normal)));
    g += 3;
  }
  return g;
}

/* the row times numbers of its frame; over columns of v, or over the compact ones */
static double row_dot(const double *g, const int *columns, int count, const double *d)
{
  double sum = 0.0;
  for (int k = 0; k < count; k++) {
    sum += g[k] * d[columns[k]];
  }
  return sum;
}

static double row_trial(const smoothing *s, const row *r)
{
  const path *p = r->path;
  return row_dot(s->entries + r->first, p->compact, p->count,
                 s->trial + (size_t)r->frame * (size_t)s->width);
}

static void row_add(const smoothing *s, const row *r, double y, double *d)
{
  const path *p = r->path;
  const double *g = s->entries + r->first;
  for (int k = 0; k < p->count; k++) {
    d[p->compact[k]] += y * g[k];
  }
}

/* the pose of frame t at q (+) D, and the scene then */
static void pose_frame(smoothing *s, int t)
{
  const size_t nq = (size_t)s->body->nq;
  double *q = s->q + (size_t)t * nq;
  kg_body_integrate(s->body, q, s->subject->q + (size_t)t * nq, s->D + (size_t)t * (size_t)s->nv);
  kg_dynamics_pose(s->dynamics, q, s->p, s->R);
  kg_stage_set(s->stage, t * s->subject->dt, s->p[0]);
}

/* Room for one row more, of `entries` numbers; false without memory. */
static bool has_room(smoothing *s, size_t entries)
{
  if (s->row_count == s->row_room) {
    const size_t room = s->row_room ? 2 * s->row_room : (size_t)s->T;
    row *rows = KG_ARENA_ARRAY(&s->row_memory, row, room);
    if (rows && s->row_count) memcpy(rows, s->rows, s->row_count * sizeof *rows);
    s->rows = rows;
    s->row_room = rows ? room : s->row_count;
  }
  if (s->entry_count + entries > s->entry_room) {
    const size_t room = 2 * s->entry_room + 16 * (size_t)s->T + entries;
    double *numbers = KG_ARENA_ARRAY(&s->row_memory, double, room);
    if (numbers && s->entry_count) {
      memcpy(numbers, s->entries, s->entry_count * sizeof *numbers);
    }
    s->entries = numbers;
    s->entry_room = numbers ? room : s->entry_count;
  }
  return !kg_arena_failed(&s->row_memory);
}

/* The row of frame t whose entries are written, behind the others. */
static void add_row(smoothing *s, int t, int key, path *p, double distance, double aim)
{
  const double *D = s->D + (size_t)t * (size_t)s->nv;
  const size_t first = s->entry_count;
  s->rows[s->row_count++] = (row){
    .frame = t,
    .key = key,
    .path = p,
    .first = first,
    .bound = aim - distance + row_dot(s->entries + first, p->column, p->count, D),
  };
  s->entry_count += (size_t)p->count;
}

static void count_depth(smoothing *s, double distance)
{
  s->depth = fmax(s->depth, -distance);
}

/* of the nearest shape; that of another athlete counts from farther away, and by the way of its pair */
static bool is_near(smoothing *s, int t, int segment, kg_vec3 x, kg_scene_hint *hint,
                    kg_sdf_value *value)
{
  const kg_scene *scene = kg_stage_scene(s->stage);
  *value = kg_scene_distance_from(scene, x, hint);
  if (value->distance >= (s->subject->other ? LIMB_NEAR_M : NEAR_M)) return false;
  count_depth(s, value->distance);
  const int shape = hint->shape < scene->shape_count ? hint->shape : -1;
  if (kg_stage_other_segment(s->stage, shape) < 0) return value->distance < NEAR_M;
  return kg_overlaps_turn_other(s->overlaps, t, segment, shape, x, value);
}

static void pass_point(smoothing *s, int t, int k)
{
  const kg_body_point *point = &s->body->points[k];
  path *p = &s->paths[point->segment];
  const kg_vec3 x =
    kg_vec3_add(s->p[point->segment], kg_mat3_mul_vec(s->R[point->segment], point->p));
  kg_sdf_value value;
  if (!is_near(s, t, point->segment, x, &s->hints[k], &value) || !has_room(s, (size_t)p->count)) {
    return;
  }
  double *g = s->entries + s->entry_count;
  kg_store3(g, value.normal);
  (void)write_chain(s, g + 3, point->segment, -1, x, value.normal);
  add_row(s, t, k, p, value.distance, AIM_M);
}

static path *path_of_pair(const smoothing *s, int segment, int other)
{
  const int n = s->body->segment_count;
  return &s->paths[n + segment * n + other];
}

/* n' (J of the point - J of the other segment at the point) */
static void pass_self_touch(smoothing *s, int t, const kg_self_touch *touch)
{
  const int segment = s->body->points[touch->point].segment;
  const int end = kg_meeting_segment(s->body, segment, touch->segment);
  path *p = path_of_pair(s, segment, touch->segment);
  if (!has_room(s, (size_t)p->count)) return;
  double *g = s->entries + s->entry_count;
  double *half = write_chain(s, g, segment, end, touch->x, touch->normal);
  (void)write_chain(s, half, touch->segment, end, touch->x, kg_vec3_scale(-1.0, touch->normal));
  double size2 = 0.0;
  for (int k = 0; k < p->count; k++) {
    size2 += g[k] * g[k];
  }
  if (size2 < LEAST_ARM_M * LEAST_ARM_M) return;
  add_row(s, t, s->body->point_count + touch->point, p, touch->distance, s->self_aim);
}

static void pass_self(smoothing *s, int t)
{
  const int count = kg_self_sample(s->self, s->p, s->R, LIMB_NEAR_M, s->self_touches);
  for (int k = 0; k < count; k++) {
    kg_self_touch touch = s->self_touches[k];
    count_depth(s, touch.distance);
    if (kg_overlaps_turn_self(s->overlaps, t, s->p, s->R, &touch)) pass_self_touch(s, t, &touch);
  }
}

/* Rows of the points that are near, over all frames. Bounds are for the whole change, not for its
 * increment. *low: something penetrates. False without memory. */
static bool linearise(smoothing *s)
{
  s->row_count = s->entry_count = 0;
  s->depth = 0.0;
  const double near = s->subject->other ? LIMB_NEAR_M : NEAR_M;
  for (int t = 0; t < s->T && !kg_arena_failed(&s->row_memory); t++) {
    pose_frame(s, t);
    (void)near_points_sort(&s->near, kg_stage_scene(s->stage), s->p, s->R,
                           kg_vec3_make(0.0, 0.0, 0.0));
    for (int b = 0; b < s->near.count && s->near.balls[b].bound < near; b++) {
      const segment_ball *ball = &s->near.balls[b];
      for (int k = ball->first; k < ball->first + ball->count; k++) {
        pass_point(s, t, s->near.points[k]);
      }
    }
    if (s->self) pass_self(s, t);
  }
  return !kg_arena_failed(&s->row_memory);
}

/* The columns that the rows have: those on the way of a segment with one. The others stay zero. */
static void number_columns(smoothing *s)
{
  for (int j = 0; j < s->nv; j++) {
    s->compact_of[j] = -1;
  }
  for (int i = 0; i < s->path_count; i++) {
    s->paths[i].used = false;
  }
  s->width = 0;
  for (size_t i = 0; i < s->row_count; i++) {
    path *p = s->rows[i].path;
    for (int k = 0; k < p->count && !p->used; k++) {
      int *compact = &s->compact_of[p->column[k]];
      if (*compact < 0) {
        s->column_of[s->width] = p->column[k];
        *compact = s->width++;
      }
      p->compact[k] = *compact;
    }
    p->used = true;
  }
  while (s->width % KG_SMOOTHER_COLUMNS != 0) {
    s->column_of[s->width++] = -1;
  }
}

/* trial = (A kron W)^-1 G' z, or y */
static void apply_inverse(smoothing *s, bool extrapolated)
{
  const size_t width = (size_t)s->width;
  memset(s->trial, 0, (size_t)s->T * width * sizeof *s->trial);
  for (size_t i = 0; i < s->row_count; i++) {
    const row *r = &s->rows[i];
    const double y = extrapolated ? r->z : r->y;
    if (y != 0.0) row_add(s, r, y, s->trial + (size_t)r->frame * width);
  }
  for (int j = 0; j < s->width; j++) {
    const double share = s->column_of[j] < 0 ? 0.0 : 1.0 / s->W[s->column_of[j]];
    for (size_t t = 0; t < (size_t)s->T; t++) {
      s->trial[t * width + (size_t)j] *= share;
    }
  }
  kg_smoother_solve_rows(&s->smoother, s->trial, s->width);
}

/* Rows scaled to g W^-1 g' = 1: points on light segments must not set the step of all others. */
static void normalise_rows(smoothing *s)
{
  for (size_t i = 0; i < s->row_count; i++) {
    row *r = &s->rows[i];
    const path *p = r->path;
    double *g = s->entries + r->first, size2 = 0.0;
    for (int k = 0; k < p->count; k++) {
      size2 += g[k] * g[k] / s->W[p->column[k]];
    }
    r->scale = 1.0 / sqrt(size2);
    for (int k = 0; k < p->count; k++) {
      g[k] *= r->scale;
    }
    r->bound *= r->scale;
  }
}

/* A bound of the dual operator for every row: A^-1 <= 1, so that it is at most the blocks G_t W^-1 G_t'
 * of the frames, and these, symmetric, at most the diagonal of their row sums. Rows are stored frame by
 * frame. */
static void set_steps(smoothing *s)
{
  double *probe = s->trial; /* one frame's worth of scratch */
  for (size_t first = 0; first < s->row_count;) {
    size_t end = first;
    while (end < s->row_count && s->rows[end].frame == s->rows[first].frame) {
      end++;
    }
    for (size_t i = first; i < end; i++) {
      memset(probe, 0, (size_t)s->width * sizeof *probe);
      row_add(s, &s->rows[i], 1.0, probe);
      for (int j = 0; j < s->width; j++) {
        probe[j] /= s->column_of[j] < 0 ? 1.0 : s->W[s->column_of[j]];
      }
      double sum = 0.0;
      for (size_t k = first; k < end; k++) {
        const path *p = s->rows[k].path;
        sum += fabs(row_dot(s->entries + s->rows[k].first, p->compact, p->count, probe));
      }
      s->rows[i].step = 1.0 / sum;
    }
    first = end;
  }
}

static double *force_of(const smoothing *s, const row *r)
{
  return &s->force[(size_t)r->frame * (size_t)s->key_count + (size_t)r->key];
}

/* [BT] (4.1)-(4.3) on the dual: y+ = max(0, z + (bound - g D(z)) / L), with restart on ascent; done
 * when no row would move by more than DUAL_M for its own step */
static void solve_dual(smoothing *s)
{
  number_columns(s);
  normalise_rows(s);
  set_steps(s);
  double momentum = 1.0, change = INFINITY;
  for (size_t i = 0; i < s->row_count; i++) { /* from the last linearisation's answer */
    row *r = &s->rows[i];
    r->y = r->z = *force_of(s, r) / r->scale;
  }
  for (int round = 0; round < DUAL_ITERATIONS && change > DUAL_M; round++) {
    apply_inverse(s, true);
    const double next = 0.5 * (1.0 + sqrt(1.0 + 4.0 * momentum * momentum));
    const double beta = (momentum - 1.0) / next;
    double against = 0.0;
    change = 0.0;
    for (size_t i = 0; i < s->row_count; i++) {
      row *r = &s->rows[i];
      const double y = fmax(0.0, r->z + r->step * (r->bound - row_trial(s, r)));
      change = fmax(change, fabs(y - r->z) / (r->step * r->scale));
      against += (r->z - y) * (y - r->y) / r->step;
      r->z = y + beta * (y - r->y);
      r->y = y;
    }
    momentum = against > 0.0 ? 1.0 : next;
  }
  apply_inverse(s, false);
  memset(s->force, 0, (size_t)s->T * (size_t)s->key_count * sizeof *s->force);
  for (size_t i = 0; i < s->row_count; i++) {
    *force_of(s, &s->rows[i]) = s->rows[i].y * s->rows[i].scale;
  }
  memset(s->D, 0, (size_t)s->T * (size_t)s->nv * sizeof *s->D);
  for (size_t t = 0; t < (size_t)s->T; t++) {
    for (int j = 0; j < s->width; j++) {
      if (s->column_of[j] < 0) continue;
      s->D[t * (size_t)s->nv + (size_t)s->column_of[j]] =
        s->trial[t * (size_t)s->width + (size_t)j];
    }
  }
}

static bool is_zero(const double *x, int n)
{
  for (int i = 0; i < n; i++) {
    if (x[i] != 0.0) {
      return false;
    }
  }
  return true;
}

/* Frame t of the answer: the capture changed by D; bit for bit as it is where D is zero, no renormalised
 * quaternions. */
static void write_frame(const smoothing *s, int t)
{
  const size_t nq = (size_t)s->body->nq;
  const double *captured = s->subject->q + (size_t)t * nq, *D = s->D + (size_t)t * (size_t)s->nv;
  double *q = s->q + (size_t)t * nq;
  if (is_zero(D, s->nv)) {
    memcpy(q, captured, nq * sizeof *q);
  } else {
    kg_body_integrate(s->body, q, captured, D);
  }
}

/* A share of the frames, corrected one by one; each worker has its own. */
typedef struct finisher {
  const smoothing *s;
  const kg_correct_def *def;
  kg_stage *stage;
  kg_correction *correction;
  double *q; /* (nq) another start */
  int first, end;
  bool reports; /* progress comes from the calling thread only */
  bool interrupted;
  int iterations;
  pthread_t thread;
} finisher;

/* Moves q, frame t with its change, out of what it touches; returns the depth that is left. Limbs that
 * are deep in each other can have points on both sides of the other's axis, which hold each other: the
 * changes of the frames around, and at last none, are other places to start from. */
static double correct_frame(finisher *f, int t, double *q)
{
  static const int around[] = {-1, 1, -2, 2, -4, 4};
  const smoothing *s = f->s;
  const size_t nq = (size_t)s->body->nq;
  const double *captured = s->subject->q + (size_t)t * nq;
  kg_correction_report report = kg_correction_apply(f->correction, q, NULL, NULL);
  double depth = report.d_pen_after;
  f->iterations += report.iterations;
  for (int k = 0; k <= (int)KG_COUNT_OF(around) && s->self && !report.converged; k++) {
    const bool is_last = k == (int)KG_COUNT_OF(around);
    const int from = is_last ? t : t + around[k];
    if (from < 0 || from >= s->T) continue;
    memcpy(f->q, captured, nq * sizeof *q);
    if (!is_last) kg_body_integrate(s->body, f->q, captured, s->D + (size_t)from * (size_t)s->nv);
    report = kg_correction_apply(f->correction, f->q, NULL, NULL);
    f->iterations += report.iterations;
    if (!(report.d_pen_after < depth)) continue;
    depth = report.d_pen_after;
    memcpy(q, f->q, nq * sizeof *q);
  }
  return depth;
}

static void *finish_share(void *user)
{
  finisher *f = user;
  const smoothing *s = f->s;
  const size_t nq = (size_t)s->body->nq;
  for (int t = f->first; t < f->end; t++) {
    double *q = s->q + (size_t)t * nq;
    write_frame(s, t);
    kg_stage_set(f->stage, t * s->subject->dt, kg_vec3_make(q[0], q[1], q[2]));
    s->result->penetration[t] = correct_frame(f, t, q);
    if (f->reports && t % 64 == 0 &&
        !f->def->progress(0.8 + 0.2 * (t - f->first) / (f->end - f->first), "sdf",
                          f->def->progress_user)) {
      f->interrupted = true;
      break;
    }
  }
  return NULL;
}

/* Frames do not depend on each other here, so the number of threads does not show in the result. */
static kg_status finish_frames(smoothing *s, const kg_correct_def *def)
{
  finisher workers[MAX_THREADS] = {{0}};
  const int count = def->threads < 1 ? 1 : def->threads > MAX_THREADS ? MAX_THREADS : def->threads;
  kg_status status = KG_OK;
  for (int i = 0; i < count && status == KG_OK; i++) {
    workers[i] = (finisher){.s = s,
                            .def = def,
                            .reports = i == 0 && def->progress,
                            .first = (int)((long)s->T * i / count),
                            .end = (int)((long)s->T * (i + 1) / count)};
    workers[i].q = s->other_start + (size_t)i * (size_t)s->body->nq;
    status = kg_stage_create(&workers[i].stage, s->subject, KG_STAGE_ALL, def->allocator);
    if (status != KG_OK) break;
    kg_correction_def cd = kg_correction_default_def(s->body, kg_stage_scene(workers[i].stage));
    cd.self = s->subject->self;
    cd.allocator = def->allocator;
    status = kg_correction_create(&workers[i].correction, &cd);
  }
  int started = 1;
  while (status == KG_OK && started < count &&
         pthread_create(&workers[started].thread, NULL, finish_share, &workers[started]) == 0) {
    started++;
  }
  if (status == KG_OK) {
    (void)finish_share(&workers[0]);
    for (int i = started; i < count; i++) { /* no thread was to be had: done here */
      (void)finish_share(&workers[i]);
    }
  }
  for (int i = 1; i < started && status == KG_OK; i++) {
    pthread_join(workers[i].thread, NULL);
  }
  for (int i = 0; i < count; i++) {
    s->result->sdf_iterations += workers[i].iterations;
    s->result->interrupted = s->result->interrupted || workers[i].interrupted;
    kg_correction_destroy(workers[i].correction);
    kg_stage_destroy(workers[i].stage);
  }
  return status;
}

/* The path's next columns: three of every joint from a segment to `end`, which is left out. */
static void add_columns(const kg_body *body, path *p, int segment, int end)
{
  for (int i = segment; i != end; i = body->segments[i].parent) {
    for (int k = 0; k < 3; k++) {
      p->column[p->count++] = 3 + 3 * i + k;
    }
  }
}

/* room for `joints` joints and the root's position */
static bool make_path(path *p, int joints, kg_arena *arena)
{
  p->column = KG_ARENA_ARRAY(arena, int, 3 + 3 * joints);
  p->compact = KG_ARENA_ARRAY(arena, int, 3 + 3 * joints);
  return !kg_arena_failed(arena);
}

static void make_pair_paths(smoothing *s, kg_arena *arena)
{
  const kg_body *body = s->body;
  for (int i = 0; i < body->segment_count; i++) {
    for (int j = 0; j < body->segment_count; j++) {
      if (!kg_self_is_pair(s->self, i, j)) continue;
      const int end = kg_meeting_segment(body, i, j);
      path *p = path_of_pair(s, i, j);
      if (!make_path(p, kg_joints_above(body, i, end) + kg_joints_above(body, j, end), arena))
        return;
      add_columns(body, p, i, end);
      add_columns(body, p, j, end);
    }
  }
}

static void make_paths(smoothing *s, kg_arena *arena)
{
  const kg_body *body = s->body;
  const int n = body->segment_count;
  s->path_count = s->self ? n + n * n : n;
  s->paths = KG_ARENA_ARRAY(arena, path, s->path_count);
  s->column_of = KG_ARENA_ARRAY(arena, int, s->nv + KG_SMOOTHER_COLUMNS);
  s->compact_of = KG_ARENA_ARRAY(arena, int, s->nv);
  for (int b = 0; b < s->near.count && !kg_arena_failed(arena); b++) {
    const int segment = s->near.balls[b].segment;
    path *p = &s->paths[segment];
    if (!make_path(p, kg_joints_above(body, segment, -1), arena)) return;
    for (int k = 0; k < 3; k++) {
      p->column[p->count++] = k;
    }
    add_columns(body, p, segment, -1);
  }
  if (s->self && !kg_arena_failed(arena)) make_pair_paths(s, arena);
}

static kg_status smoothing_create(smoothing *s, kg_arena *arena)
{
  const size_t T = (size_t)s->T, nv = (size_t)s->nv;
  kg_arena_init(&s->row_memory, arena->allocator);
  s->D = KG_ARENA_ARRAY(arena, double, T *nv);
  s->best = KG_ARENA_ARRAY(arena, double, T *nv);
  s->W = KG_ARENA_ARRAY(arena, double, nv);
  s->other_start = KG_ARENA_ARRAY(arena, double, MAX_THREADS *(size_t)s->body->nq);
  s->p = KG_ARENA_ARRAY(arena, kg_vec3, s->body->segment_count);
  s->R = KG_ARENA_ARRAY(arena, kg_mat3, s->body->segment_count);
  s->hints = KG_ARENA_ARRAY(arena, kg_scene_hint, s->body->point_count);
  double *M = KG_ARENA_ARRAY(arena, double, nv *nv);
  near_points_init(&s->near, s->body, arena);
  s->key_count = (s->subject->self ? 2 : 1) * s->body->point_count;
  s->force = KG_ARENA_ARRAY(arena, double, T *(size_t)s->key_count);
  s->self_touches = KG_ARENA_ARRAY(arena, kg_self_touch, s->body->point_count);
  if (s->subject->self && kg_self_create(&s->self, s->body, NULL, arena->allocator) != KG_OK) {
    return KG_ERR_NO_MEMORY;
  }
  kg_smoother_create(&s->smoother, s->T, arena);
  if (!kg_arena_failed(arena)) make_paths(s, arena);
  s->trial = KG_ARENA_ARRAY(arena, double, T *(nv + KG_SMOOTHER_COLUMNS));
  if (kg_arena_failed(arena)) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status = kg_dynamics_create(&s->dynamics, s->body, arena->allocator);
  if (status == KG_OK) {
    status = kg_stage_create(&s->stage, s->subject, s->part, arena->allocator);
  }
  if (status == KG_OK) {
    kg_dynamics_mass_matrix(s->dynamics, M, s->subject->q);
    for (size_t j = 0; j < nv; j++) {
      s->W[j] = fmax(M[j * nv + j], LEAST_WEIGHT) * (j < 3 ? ROOT_SHARE : 1.0);
    }
    kg_smoother_factor(&s->smoother, NULL, pow(EASE_TIME_S / s->subject->dt, 4.0));
    status = kg_overlaps_create(&s->overlaps, s->subject, s->self, s->stage, s->dynamics,
                                arena->allocator);
  }
  return status;
}

static void smoothing_destroy(smoothing *s)
{
  kg_stage_destroy(s->stage);
  kg_dynamics_destroy(s->dynamics);
  kg_overlaps_destroy(s->overlaps);
  kg_self_destroy(s->self);
  kg_arena_release(&s->row_memory);
}

/* D, once smoothing_create has made it all, in at most `most` linearisations; *interrupted: by the progress
 * of def, which counts to `share` */
static kg_status smooth(smoothing *s, const kg_correct_def *def, int most, double share,
                        bool *interrupted)
{
  const size_t size = (size_t)s->T * (size_t)s->nv * sizeof *s->D;
  double least = INFINITY;
  for (int round = 0; round <= most && !*interrupted; round++) {
    if (!linearise(s)) return KG_ERR_NO_MEMORY;
    if (s->depth < least) {
      least = s->depth;
      memcpy(s->best, s->D, size);
    }
    if (s->depth == 0.0 || round == most) break;
    if (round >= LINEARISATIONS && least < SHALLOW_M) break;
    solve_dual(s);
    *interrupted =
      def->progress && !def->progress(share * (round + 1) / most, "sdf", def->progress_user);
  }
  memcpy(s->D, s->best, size);
  return KG_OK;
}

static smoothing make_smoothing(const kg_subject *subject, double *q, kg_stage_part part,
                                double self_aim)
{
  return (smoothing){.subject = subject,
                     .body = subject->body,
                     .q = q,
                     .part = part,
                     .self_aim = self_aim,
                     .T = subject->frame_count,
                     .nv = subject->body->nv};
}

kg_status kg_correct_sdf(kg_correct_result *result, const kg_subject *subject,
                         const kg_correct_def *def, kg_arena *arena)
{
  struct timespec start, end;
  clock_gettime(CLOCK_MONOTONIC, &start);
  kg_arena scratch;
  kg_arena_init(&scratch, arena->allocator);
  smoothing s = make_smoothing(subject, result->q, KG_STAGE_ALL, AIM_M);
  s.result = result;
  kg_status status = smoothing_create(&s, &scratch);
  const int most = subject->self || subject->other ? MOST_LINEARISATIONS : LINEARISATIONS;
  if (status == KG_OK) status = smooth(&s, def, most, 0.8, &result->interrupted);
  if (status == KG_OK && !result->interrupted) status = finish_frames(&s, def);
  smoothing_destroy(&s);
  kg_arena_release(&scratch);
  clock_gettime(CLOCK_MONOTONIC, &end);
  result->ms_sdf =
    (1e3 * (double)(end.tv_sec - start.tv_sec) + 1e-6 * (double)(end.tv_nsec - start.tv_nsec)) /
    result->frame_count;
  result->ms_per_frame = result->ms_sdf;
  return status;
}

kg_status kg_part_limbs(double *q, bool *interrupted, const kg_subject *subject,
                        const kg_correct_def *def, const kg_allocator *allocator)
{
  kg_arena scratch;
  kg_arena_init(&scratch, allocator);
  smoothing s = make_smoothing(subject, q, KG_STAGE_OTHER_ONLY, PART_M);
  kg_status status = smoothing_create(&s, &scratch);
  if (status == KG_OK) status = smooth(&s, def, LINEARISATIONS, 0.0, interrupted);
  for (int t = 0; status == KG_OK && t < s.T; t++) {
    write_frame(&s, t);
  }
  smoothing_destroy(&s);
  kg_arena_release(&scratch);
  return status;
}
