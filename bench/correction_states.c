/* How the correction of penetration converges: random poses inside a plane and inside a mesh.
 *
 *   correction_states [--poses N] [--seed S] [--ceres K] [--printed K] [--deepest M] [--scene NAME] CLIP
 *
 * The body is the clip's. A pose: every joint turned from the rest pose about any axis by an angle
 * uniform in [0, limit of its role], the root turned any way (uniform over rotations), set down at
 * a place uniform in 6 x 6 m and lowered until d_pen is a number uniform in (0, 0.3 m] (--deepest).
 * Scenes: the plane y = 0; hills of 100 352 triangles over 10 x 10 m closed from below, 0.25 m high,
 * with facets of 4.5 cm.
 *
 * Both methods correct all N poses, second order also with 12 ways (starts). "Iterations" are all that the
 * report counts, "of the answer" those of the way that led to it.
 *
 * K of the poses, evenly spread, are given to Ceres, a constrained minimum from seven starts: the three
 * answers, no move, two random moves, and the shortest that kinegrad's second-order steps reach from
 * 64 random moves. Ratios of length: an answer over Ceres' from this answer (whether it stands at a
 * minimum), over Ceres' from no move, over the shortest of Ceres' from the answers, no move and the two
 * random moves, and over the shortest known at all, by whoever. A random move: every component of a
 * rotation normal, of a translation a third of it; standard deviation 0.25 rad for Ceres, 0.06 to 0.5 for
 * the 64, every other four of which are around the shortest move so far.
 *
 * K poses (--printed) go through Eq. 11 as printed: q <- q - 0.1 grad L_coll in the plain metric, until
 * d_pen <= 1e-5 m or 20 000 steps. --scene plane or mesh: that one alone. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/clock.h"
#include "bench/correction/least_reference.h"
#include "kinegrad/correction.h"
#include "kinegrad/random.h"
#include "kinegrad/subject.h"
#include "physics/correction.h"

enum {
  NQ = 3 + 4 * KG_ROLE_COUNT,
  NV = 3 + 3 * KG_ROLE_COUNT,
  HILL_CELLS = 224,
  PRINTED_STEPS = 20000,
  METHODS = 3,
  CERES_RANDOM = 2,
  OWN_RANDOM = 64
};

/* rad, from the rest pose, any axis */
static double role_limit(int role)
{
  switch (role) {
    case KG_ROLE_L_SHOULDER:
    case KG_ROLE_R_SHOULDER:
    case KG_ROLE_L_ELBOW:
    case KG_ROLE_R_ELBOW:
    case KG_ROLE_L_HIP:
    case KG_ROLE_R_HIP:
    case KG_ROLE_L_KNEE:
    case KG_ROLE_R_KNEE:
      return 1.0;
    case KG_ROLE_L_WRIST:
    case KG_ROLE_R_WRIST:
    case KG_ROLE_L_ANKLE:
    case KG_ROLE_R_ANKLE:
      return 0.5;
    case KG_ROLE_HEAD:
    case KG_ROLE_L_TOE:
    case KG_ROLE_R_TOE:
      return 0.35;
    default:
      return 0.2;
  }
}

/* ---- scenes --------------------------------------------------------------------------------------*/

static double hill(double x, double z)
{
  return 0.12 * sin(1.3 * x + 0.4) * cos(0.9 * z) + 0.05 * sin(3.1 * z + 1.7 * x) +
         0.02 * sin(6.0 * x - 2.0) * sin(5.0 * z);
}

static void triangle(int **t, int a, int b, int c)
{
  *(*t)++ = a;
  *(*t)++ = b;
  *(*t)++ = c;
}

/* 2 * 224^2 triangles on top, walls to and a fan around one vertex at 2 m depth */
static kg_mesh *make_hills(void)
{
  const int n = HILL_CELLS + 1, count = n * n + 1;
  kg_vec3 *vertices = calloc((size_t)count, sizeof *vertices);
  int *triangles = calloc((size_t)(2 * HILL_CELLS * HILL_CELLS + 4 * HILL_CELLS) * 3, sizeof(int));
  int *t = triangles;
  kg_mesh *mesh = NULL;
  kg_mesh_report report;
  kg_error error = {0};
  if (vertices && triangles) {
    for (int i = 0; i < n * n; i++) {
      const double x = 10.0 * (i % n) / HILL_CELLS - 5.0, z = 10.0 * (i / n) / HILL_CELLS - 5.0;
      vertices[i] = kg_vec3_make(x, hill(x, z), z);
    }
    vertices[n * n] = kg_vec3_make(0.0, -2.0, 0.0);
    for (int i = 0; i < HILL_CELLS * HILL_CELLS; i++) {
      const int a = i / HILL_CELLS * n + i % HILL_CELLS;
      triangle(&t, a, a + n, a + n + 1);
      triangle(&t, a, a + n + 1, a + 1);
    }
    for (int i = 0; i < HILL_CELLS; i++) {
      triangle(&t, i, i + 1, n * n);
      triangle(&t, (n - 1) * n + i + 1, (n - 1) * n + i, n * n);
      triangle(&t, (i + 1) * n, i * n, n * n);
      triangle(&t, i * n + n - 1, (i + 1) * n + n - 1, n * n);
    }
    if (kg_mesh_create(&mesh, vertices, count, triangles, (int)(t - triangles) / 3, &report, NULL,
                       &error) != KG_OK ||
        !report.closed || report.inside_out) {
      fprintf(stderr, "correction_states: hills: %s%s\n", error.text, report.text);
    }
  }
  free(vertices);
  free(triangles);
  return mesh;
}

/* ---- poses ---------------------------------------------------------------------------------------*/

static kg_vec3 random_direction(kg_random *random)
{
  return kg_vec3_normalized(
    kg_vec3_make(kg_random_normal(random), kg_random_normal(random), kg_random_normal(random)));
}

static void set_quat(double *q, int segment, kg_quat r)
{
  const double numbers[4] = {r.w, r.x, r.y, r.z};
  memcpy(q + 3 + 4 * segment, numbers, sizeof numbers);
}

static void random_pose(kg_random *random, const kg_body *body, kg_correction *probe,
                        double deepest, double *q)
{
  set_quat(q, 0,
           kg_quat_normalized(kg_quat_make(kg_random_normal(random), kg_random_normal(random),
                                           kg_random_normal(random), kg_random_normal(random))));
  for (int i = 1; i < body->segment_count; i++) {
    const double angle = role_limit(body->segments[i].role) * kg_random_uniform(random);
    set_quat(q, i, kg_quat_exp(kg_vec3_scale(angle, random_direction(random))));
  }
  q[0] = 6.0 * kg_random_uniform(random) - 3.0;
  q[2] = 6.0 * kg_random_uniform(random) - 3.0;
  const double depth = deepest * (1.0 - kg_random_uniform(random));
  double low = -2.0, high = 4.0; /* of the root */
  for (int i = 0; i < 50; i++) {
    q[1] = 0.5 * (low + high);
    if (kg_penetration(probe, q, NULL, NULL) > depth) {
      low = q[1];
    } else {
      high = q[1];
    }
  }
}

/* ---- numbers -------------------------------------------------------------------------------------*/

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void *numbers(size_t count)
{
  void *memory = calloc(count, sizeof(double));
  if (!memory) {
    fprintf(stderr, "correction_states: out of memory\n");
    exit(1);
  }
  return memory;
}

/* sorts x */
static double quantile(double *x, int count, double share)
{
  if (count == 0) return NAN;
  qsort(x, (size_t)count, sizeof *x, ascending);
  return x[(int)(share * (count - 1))];
}

static double share_at_most(const double *x, int count, double limit)
{
  int good = 0;
  for (int k = 0; k < count; k++) {
    good += x[k] <= limit;
  }
  return count > 0 ? (double)good / count : NAN;
}

static const struct {
  const char *name;
  kg_correction_method method;
  int starts;
} methods[METHODS] = {{"second order", KG_CORRECTION_SECOND_ORDER, 1},
                      {"  of 12 ways", KG_CORRECTION_SECOND_ORDER, 12},
                      {"Eq. 11, safe", KG_CORRECTION_GRADIENT, 1}};

typedef struct experiment {
  const kg_body *body;
  const kg_scene *scene;
  const char *name;
  double *poses;           /* (count, nq)             */
  double *moves[METHODS];  /* (count, nv)             */
  double *length[METHODS]; /* (count)                 */
  double *sample[4];       /* (count) each            */
  int count, ceres_count, printed_count;
} experiment;

static const double *pose_of(const experiment *e, int k)
{
  return e->poses + (size_t)k * (size_t)e->body->nq;
}

static double *move_of(const experiment *e, int method, int k)
{
  return e->moves[method] + (size_t)k * (size_t)e->body->nv;
}

/* ---- the methods ---------------------------------------------------------------------------------*/

static kg_correction *make_correction(const experiment *e, int method)
{
  kg_correction_def def = kg_correction_default_def(e->body, e->scene);
  kg_correction *c = NULL;
  def.method = methods[method].method;
  def.starts = methods[method].starts;
  if (kg_correction_create(&c, &def) != KG_OK) exit(1);
  return c;
}

static void run_method(experiment *e, int method)
{
  const kg_body *body = e->body;
  kg_correction *c = make_correction(e, method);
  double *iterations = e->sample[0], *ms = e->sample[1], *gap = e->sample[2], *own = e->sample[3];
  double by_depth[3] = {0.0}, worst = 0.0;
  int in_depth[3] = {0}, converged = 0;
  for (int k = 0; k < e->count; k++) {
    double q[NQ];
    memcpy(q, pose_of(e, k), (size_t)body->nq * sizeof *q);
    const double start = kg_bench_now().cpu;
    const kg_correction_report report = kg_correction_apply(c, q, NULL, move_of(e, method, k));
    ms[k] = 1e3 * (kg_bench_now().cpu - start);
    iterations[k] = report.iterations;
    own[k] = report.iterations_of_answer;
    gap[k] = report.lowest;
    e->length[method][k] = report.displacement;
    converged += report.converged && report.d_pen_after <= 1e-5;
    worst = fmax(worst, report.d_pen_after);
    const int third = report.d_pen_before < 0.1 ? 0 : report.d_pen_before < 0.2 ? 1 : 2;
    by_depth[third] += report.iterations;
    in_depth[third]++;
  }
  printf("%-6s %-12s %8.2f%% %9.1e %5.0f %5.0f %5.0f  %5.0f %5.0f %5.0f  %5.1f %5.1f %5.1f %10.2e "
         "%7.3f %7.3f\n",
         e->name, methods[method].name, 100.0 * converged / e->count, worst,
         quantile(iterations, e->count, 0.5), quantile(iterations, e->count, 0.95),
         quantile(iterations, e->count, 1.0), quantile(own, e->count, 0.5),
         quantile(own, e->count, 0.95), quantile(own, e->count, 1.0),
         by_depth[0] / fmax(1, in_depth[0]), by_depth[1] / fmax(1, in_depth[1]),
         by_depth[2] / fmax(1, in_depth[2]), quantile(gap, e->count, 1.0),
         quantile(ms, e->count, 0.5), quantile(ms, e->count, 0.95));
  fflush(stdout);
  kg_correction_destroy(c);
}

/* ---- the shortest known --------------------------------------------------------------------------*/

static void random_move(kg_random *random, int nv, double size, const double *around, double *D)
{
  for (int i = 0; i < nv; i++) {
    D[i] = around[i] + size * kg_random_normal(random) * (i < 3 ? 1.0 / 3.0 : 1.0);
  }
}

/* Ceres from D; D becomes its answer. INFINITY when that is not outside. */
static double ceres_length(least_reference *reference, const double *q, double *D)
{
  double depth = INFINITY;
  const double length = least_reference_move(reference, q, D, &depth);
  return depth <= 1e-5 ? length : INFINITY;
}

/* The shortest move that the second-order steps reach from random moves and `best`, which it replaces */
static double shortest_of_many(kg_correction *c, const double *q, kg_random *random, double length,
                               double *best)
{
  static const double sizes[4] = {0.06, 0.15, 0.3, 0.5}, zero[NV] = {0.0};
  for (int k = 0; k < OWN_RANDOM; k++) {
    int iterations = 0;
    (void)correction_begin(c, q);
    random_move(random, c->nv, sizes[k % 4], k / 4 % 2 == 0 ? zero : best, c->D);
    correction_go_to(c, c->D);
    if (!correction_settle(c, INFINITY, &iterations)) continue;
    correction_go_to(c, c->D);
    const double found = sqrt(correction_metric(c, c->D, c->D));
    if (c->d_pen > c->def.tolerance || !(found < length)) continue;
    length = found;
    memcpy(best, c->D, (size_t)c->nv * sizeof *best);
  }
  return length;
}

static void print_ratios(const double *ratio, int n, double *scratch)
{
  memcpy(scratch, ratio, (size_t)n * sizeof *scratch);
  printf("   %8.2f%% %7.4f %7.4f", 100.0 * share_at_most(ratio, n, 1.05), quantile(scratch, n, 0.5),
         quantile(scratch, n, 1.0));
}

static void print_histogram(const char *scene, const char *name, const double *ratio, int n)
{
  static const double up_to[] = {1.001, 1.01, 1.02, 1.05, 1.1, 1.2, 1.5, INFINITY};
  printf("%-6s %-12s", scene, name);
  double below = 0.0;
  for (size_t k = 0; k < sizeof up_to / sizeof *up_to; k++) {
    const double share = share_at_most(ratio, n, up_to[k]);
    printf(" %7.2f%%", 100.0 * (share - below));
    below = share;
  }
  printf("\n");
}

static void run_ceres(experiment *e, uint64_t seed)
{
  enum { LOCAL, COLD, CERES, KNOWN, KINDS };
  const int nv = e->body->nv;
  static const double zero[NV] = {0.0};
  least_reference *reference = least_reference_create(e->body, e->scene);
  kg_correction *c = make_correction(e, 0);
  double *ratio[METHODS][KINDS], *cold = e->sample[0], *scratch = e->sample[1];
  kg_random random = kg_random_make(seed + 1000);
  const int n = e->ceres_count;
  if (!reference) exit(1);
  for (int m = 0; m < METHODS * KINDS; m++) {
    ratio[m / KINDS][m % KINDS] = numbers((size_t)n);
  }
  for (int s = 0; s < n; s++) {
    const int k = (int)((long)s * e->count / n);
    const double *q = pose_of(e, k);
    double D[NV], best[NV], local[METHODS], ceres = INFINITY, known = INFINITY;
    for (int m = 0; m < METHODS; m++) {
      memcpy(D, move_of(e, m, k), (size_t)nv * sizeof *D);
      if (e->length[m][k] < known) {
        known = e->length[m][k];
        memcpy(best, D, (size_t)nv * sizeof *D);
      }
      local[m] = ceres_length(reference, q, D);
      ceres = fmin(ceres, local[m]);
    }
    memset(D, 0, sizeof D);
    const double from_zero = ceres_length(reference, q, D);
    ceres = fmin(ceres, from_zero);
    for (int r = 0; r < CERES_RANDOM; r++) {
      random_move(&random, nv, 0.25, zero, D);
      ceres = fmin(ceres, ceres_length(reference, q, D));
    }
    known = shortest_of_many(c, q, &random, known, best);
    known = fmin(known, fmin(ceres, ceres_length(reference, q, best)));
    for (int m = 0; m < METHODS; m++) {
      ratio[m][LOCAL][s] = e->length[m][k] / local[m];
      ratio[m][COLD][s] = e->length[m][k] / from_zero; /* 0 where Ceres is not outside */
      ratio[m][CERES][s] = e->length[m][k] / ceres;
      ratio[m][KNOWN][s] = e->length[m][k] / known;
    }
    cold[s] = from_zero / known;
  }
  printf("\n%d poses: length over Ceres' from the answer; over Ceres' from no move; over Ceres' "
         "shortest; "
         "over the shortest known: <= 1.05, median, max\n",
         n);
  for (int m = 0; m < METHODS; m++) {
    printf("%-6s %-12s", e->name, methods[m].name);
    for (int kind = 0; kind < KINDS; kind++) {
      print_ratios(ratio[m][kind], n, scratch);
    }
    printf("\n");
  }
  printf(
    "over the shortest known  <= 1.001   <= 1.01  <= 1.02  <= 1.05   <= 1.1   <= 1.2   <= 1.5     "
    "more\n");
  for (int m = 0; m < METHODS; m++) {
    print_histogram(e->name, methods[m].name, ratio[m][KNOWN], n);
  }
  print_histogram(e->name, "Ceres, cold", cold, n);
  fflush(stdout);
  for (int m = 0; m < METHODS * KINDS; m++) {
    free(ratio[m / KINDS][m % KINDS]);
  }
  kg_correction_destroy(c);
  least_reference_destroy(reference);
}

/* Eq. 11 with nothing added */
static void run_printed(experiment *e)
{
  const kg_body *body = e->body;
  const kg_correction_def def = kg_correction_default_def(body, e->scene);
  kg_correction *c = NULL;
  if (kg_correction_create(&c, &def) != KG_OK) exit(1);
  double *steps = e->sample[0], *gap = e->sample[1], *over = e->sample[2];
  int n = 0, ended = 0;
  for (int s = 0; s < e->printed_count; s++, n++) {
    const int k = (int)((long)s * e->count / e->printed_count);
    double q[NQ], g[NV];
    memcpy(q, pose_of(e, k), (size_t)body->nq * sizeof *q);
    const double before = kg_penetration(c, q, NULL, g);
    double d_pen = before;
    int step = 0;
    for (; d_pen > 1e-5 && step < PRINTED_STEPS; step++) {
      for (int i = 0; i < body->nv; i++) {
        g[i] *= -0.1;
      }
      kg_body_integrate(body, q, q, g);
      d_pen = kg_penetration(c, q, NULL, g);
    }
    ended += d_pen <= 1e-5;
    steps[n] = step;
    gap[n] = 0.0; /* lowest point above the surface: distances of the points, by the scene */
    kg_dynamics *dynamics = NULL;
    if (kg_dynamics_create(&dynamics, body, NULL) != KG_OK) exit(1);
    double lowest = INFINITY;
    for (int p = 0; p < body->point_count; p++) {
      lowest = fmin(
        lowest, kg_scene_distance(e->scene, kg_dynamics_point(dynamics, NULL, q, body->points[p]))
                  .distance);
    }
    kg_dynamics_destroy(dynamics);
    gap[n] = fmax(lowest, 0.0);
    over[n] = gap[n] / before;
  }
  printf("%-6s %6d %8.1f%% %7.0f %7.0f %8.1f%% %9.4f %9.4f %9.4f %9.2f\n", e->name, n,
         100.0 * ended / n, quantile(steps, n, 0.5), quantile(steps, n, 0.95),
         100.0 * (1.0 - share_at_most(gap, n, 1e-4)), quantile(gap, n, 0.5), quantile(gap, n, 0.95),
         quantile(gap, n, 1.0), quantile(over, n, 0.5));
  fflush(stdout);
  kg_correction_destroy(c);
}

/* ---- main ----------------------------------------------------------------------------------------*/

static void make_poses(experiment *e, uint64_t seed, double deepest)
{
  const kg_correction_def def = kg_correction_default_def(e->body, e->scene);
  kg_correction *probe = NULL;
  kg_random random = kg_random_make(seed);
  if (kg_correction_create(&probe, &def) != KG_OK) exit(1);
  for (int k = 0; k < e->count; k++) {
    random_pose(&random, e->body, probe, deepest, e->poses + (size_t)k * (size_t)e->body->nq);
  }
  kg_correction_destroy(probe);
}

static void run(const kg_body *body, experiment *e, uint64_t seed, double deepest)
{
  static const char *const head =
    "\nscene  method       converged     depth  iterations          of the answer      mean by "
    "depth"
    "        highest        ms\n"
    "                                  left   med   95%   max    med   95%   max   <.1m  <.2m  <.3m"
    "   lowest p     med     95%\n";
  const size_t n = (size_t)e->count;
  e->body = body;
  e->poses = numbers(n * (size_t)body->nq);
  for (int m = 0; m < METHODS; m++) {
    e->moves[m] = numbers(n * (size_t)body->nv);
    e->length[m] = numbers(n);
  }
  for (int s = 0; s < 4; s++) {
    e->sample[s] = numbers(n);
  }
  make_poses(e, seed, deepest);
  printf("%s", head);
  for (int m = 0; m < METHODS; m++) {
    run_method(e, m);
  }
  if (e->ceres_count > 0) run_ceres(e, seed);
  if (e->printed_count > 0) {
    printf(
      "\nEq. 11 as printed\nscene   poses    ended   steps     95%%  thrown out  gap med, m       "
      "95%%       max  gap/depth\n");
    run_printed(e);
  }
  free(e->poses);
  for (int m = 0; m < METHODS; m++) {
    free(e->moves[m]);
    free(e->length[m]);
  }
  for (int s = 0; s < 4; s++) {
    free(e->sample[s]);
  }
}

int main(int argc, char **argv)
{
  int count = 10000, ceres_count = 0, printed_count = 0;
  double deepest = 0.3;
  uint64_t seed = 1;
  const char *path = NULL, *only = NULL;
  for (int i = 1; i < argc; i++) {
    const bool has_value = i + 1 < argc;
    if (strcmp(argv[i], "--poses") == 0 && has_value) {
      count = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--seed") == 0 && has_value) {
      seed = strtoull(argv[++i], NULL, 10);
    } else if (strcmp(argv[i], "--ceres") == 0 && has_value) {
      ceres_count = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--printed") == 0 && has_value) {
      printed_count = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--deepest") == 0 && has_value) {
      deepest = atof(argv[++i]);
    } else if (strcmp(argv[i], "--scene") == 0 && has_value) {
      only = argv[++i];
    } else {
      path = argv[i];
    }
  }
  if (!path || count < 1 || !(deepest > 0.0)) {
    fprintf(stderr, "usage: correction_states [--poses N] [--seed S] [--ceres K] [--printed K] "
                    "[--deepest M] [--scene NAME] CLIP\n");
    return 2;
  }
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  kg_error error = {0};
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  kg_status status = kg_clip_read(&clip, path, &clip_def, &error);
  if (status == KG_OK) status = kg_subject_create(&subject, clip, &subject_def, &error);
  kg_mesh *hills = status == KG_OK ? make_hills() : NULL;
  if (hills) {
    const kg_scene plane = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
    kg_scene mesh = plane;
    mesh.shapes[0] = (kg_sdf_shape){.kind = KG_SHAPE_MESH, .mesh = hills};
    experiment e[2] = {{.scene = &plane, .name = "plane"}, {.scene = &mesh, .name = "mesh"}};
    printf("%d poses up to %g m deep, seed %llu, body of %d segments and %d points\n", count,
           deepest, (unsigned long long)seed, subject->body->segment_count,
           subject->body->point_count);
    for (int k = 0; k < 2; k++) {
      if (only && strcmp(only, e[k].name) != 0) continue;
      e[k].count = count;
      e[k].ceres_count = ceres_count < count ? ceres_count : count;
      e[k].printed_count = printed_count < count ? printed_count : count;
      run(subject->body, &e[k], seed, deepest);
    }
  } else {
    fprintf(stderr, "correction_states: %s: %s %s\n", path, kg_status_text(status), error.text);
  }
  kg_mesh_destroy(hills);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  return hills ? 0 : 1;
}
