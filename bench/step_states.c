/* How the implicit step converges: on every step of clips as the tracker takes them, and on random
 * states within reach of these.
 *
 *   step_states [--random N] [--seed S] [--save FILE] [--load FILE] [--every K] [--tails K] CLIP...
 *
 * The steps of the clips are taken by the tracker itself: its calls of kg_step_advance come through
 * the wrapper below (the linker's --wrap), which writes down what was asked and what came of it.
 * --save keeps them, --load solves what was kept again instead of tracking, every K-th of them, and
 * says how far the answers are from those kept; the clips must be the same in the same order.
 * A random state is a step of the clips with pose and velocity disturbed, half of them set down with
 * the lowest point in or near the layer; it is solved from v, without a guess. --tails prints the
 * residuals of K steps of the clips after each of Newton's iterations. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/random.h"
#include "kinegrad/step.h"

enum {
  MAX_CLIPS = 64,
  MAX_ITERATIONS = 2000,
  NQ = 3 + 4 * KG_ROLE_COUNT,
  NV = 3 + 3 * KG_ROLE_COUNT
};

typedef enum step_class { FLIGHT, STANDING, SLIDING, LYING, LANDING, CLASS_COUNT } step_class;
static const char *const CLASS_NAMES[CLASS_COUNT] = {"flight", "standing", "sliding", "lying",
                                                     "landing"};
static const double SLIDING_SPEED = 0.02; /* m/s of a loaded point                       */
static const double LANDING_SPEED = 0.3;  /* m/s towards the ground, lost within the step */
static const double LOADED = 1.0;         /* N                                           */

/* A step as it was asked for, and the answer. */
typedef struct step_record {
  int clip;
  bool use_guess;
  double dt;
  double q[NQ], v[NV], tau[NV], guess[NV], answer[NV];
} step_record;

typedef struct clip_data {
  kg_clip *clip;
  kg_subject *subject;
  kg_step_def def; /* of the tracker's step, pointers to the subject's parts */
} clip_data;

/* What came of a set of steps. */
typedef struct statistics {
  long count, converged, substepped, fallback, iterations, cuts, chord_steps, contact_iterations;
  int most;
  double residual;
  long histogram[MAX_ITERATIONS + 1];
} statistics;

typedef struct run {
  clip_data clips[MAX_CLIPS];
  int clip_count;
  step_record *records;
  size_t count, capacity;
  statistics of[CLASS_COUNT];
} run;

/* The wrappers have no argument to find these by. */
static run the_run;
static bool is_recording;

/* ---- classes and statistics --------------------------------------------------------------------*/

static kg_vec3 speed_at(kg_dynamics *d, const kg_body *body, const double *q, const double *v,
                        int point)
{
  static double J[3 * NV];
  double u[3] = {0.0};
  (void)kg_dynamics_point(d, J, q, body->points[point]);
  for (int k = 0; k < 3 * body->nv; k++) {
    u[k / body->nv] += J[k] * v[k % body->nv];
  }
  return kg_vec3_make(u[0], u[1], u[2]);
}

/* By what the loaded points do; d is of the clip's body. */
static step_class classify(kg_dynamics *d, const kg_body *body, const double *q_before,
                           const double *v_before, const double *q, const double *v,
                           const kg_step_report *report)
{
  int loaded = 0, slides = 0, lands = 0, lies = 0;
  for (int k = 0; k < report->contact_count; k++) {
    const kg_step_contact *c = &report->contacts[k];
    if (c->force.normal < LOADED) continue;
    const kg_vec3 n = c->force.direction;
    const kg_vec3 u = speed_at(d, body, q, v, c->point);
    const kg_vec3 before = speed_at(d, body, q_before, v_before, c->point);
    const double speed_n = kg_vec3_dot(n, u);
    const int role = body->segments[body->points[c->point].segment].role;
    loaded++;
    slides += kg_vec3_norm(kg_vec3_add_scaled(u, -speed_n, n)) > SLIDING_SPEED;
    lands += kg_vec3_dot(n, before) < -LANDING_SPEED;
    lies += role < KG_ROLE_L_KNEE || role == KG_ROLE_R_HIP;
  }
  if (loaded == 0) return FLIGHT;
  if (lands > 0) return LANDING;
  if (lies > 2) return LYING;
  return slides > 0 ? SLIDING : STANDING;
}

static void count_step(statistics *s, const kg_step_report *report)
{
  s->count++;
  s->converged += report->converged;
  s->substepped += report->substeps > 1;
  s->fallback += report->used_fallback;
  s->iterations += report->iterations;
  s->chord_steps += report->chord_steps;
  s->contact_iterations += report->contact_iterations;
  s->cuts += report->cuts;
  s->most = report->iterations > s->most ? report->iterations : s->most;
  s->residual = fmax(s->residual, report->residual);
  s->histogram[report->iterations < MAX_ITERATIONS ? report->iterations : MAX_ITERATIONS]++;
}

static int quantile(const statistics *s, double share)
{
  long below = 0;
  for (int k = 0; k <= MAX_ITERATIONS; k++) {
    below += s->histogram[k];
    if ((double)below >= share * (double)s->count) return k;
  }
  return MAX_ITERATIONS;
}

static void add_statistics(statistics *sum, const statistics *s)
{
  sum->count += s->count;
  sum->converged += s->converged;
  sum->substepped += s->substepped;
  sum->fallback += s->fallback;
  sum->iterations += s->iterations;
  sum->chord_steps += s->chord_steps;
  sum->contact_iterations += s->contact_iterations;
  sum->cuts += s->cuts;
  sum->most = s->most > sum->most ? s->most : sum->most;
  sum->residual = fmax(sum->residual, s->residual);
  for (int k = 0; k <= MAX_ITERATIONS; k++) {
    sum->histogram[k] += s->histogram[k];
  }
}

static void print_line(const char *name, const statistics *s)
{
  if (s->count == 0) return;
  const double n = (double)s->count;
  printf("%-9s %7ld %9.3f%% %9.3f%% %8.3f%% %6.2f %4d %4d %5d %6.2f %8.2f %6.2f %9.1e\n", name,
         s->count, 100.0 * (double)s->converged / n, 100.0 * (double)s->substepped / n,
         100.0 * (double)s->fallback / n, (double)s->iterations / n, quantile(s, 0.5),
         quantile(s, 0.95), s->most, (double)s->chord_steps / n, (double)s->contact_iterations / n,
         (double)s->cuts / n, s->residual);
}

static void print_table(const char *title, const statistics of[CLASS_COUNT])
{
  static statistics all;
  memset(&all, 0, sizeof all);
  printf("\n%s\n%-9s %7s %10s %10s %9s %6s %4s %4s %5s %6s %8s %6s %9s\n", title, "", "steps",
         "converged", "substepped", "fallback", "mean", "med", "95%", "most", "chord", "contact",
         "cuts", "residual");
  for (int k = 0; k < CLASS_COUNT; k++) {
    print_line(CLASS_NAMES[k], &of[k]);
    add_statistics(&all, &of[k]);
  }
  print_line("all", &all);
  fflush(stdout);
}

/* ---- recording ---------------------------------------------------------------------------------*/

kg_status __real_kg_step_create(kg_step **step, const kg_step_def *def);
kg_status __wrap_kg_step_create(kg_step **step, const kg_step_def *def);
void __real_kg_step_advance(kg_step *step, double *q_next, double *v_next, const double *q,
                            const double *v, const double *tau, double dt, bool use_guess,
                            kg_step_report *report);
void __wrap_kg_step_advance(kg_step *step, double *q_next, double *v_next, const double *q,
                            const double *v, const double *tau, double dt, bool use_guess,
                            kg_step_report *report);

kg_status __wrap_kg_step_create(kg_step **step, const kg_step_def *def)
{
  if (is_recording) {
    the_run.clips[the_run.clip_count].def = *def;
  }
  return __real_kg_step_create(step, def);
}

static step_record *new_record(run *r)
{
  if (r->count == r->capacity) {
    r->capacity = r->capacity ? 2 * r->capacity : 4096;
    r->records = realloc(r->records, r->capacity * sizeof *r->records);
    if (!r->records) {
      fprintf(stderr, "step_states: out of memory\n");
      exit(1);
    }
  }
  memset(&r->records[r->count], 0, sizeof *r->records);
  return &r->records[r->count++];
}

void __wrap_kg_step_advance(kg_step *step, double *q_next, double *v_next, const double *q,
                            const double *v, const double *tau, double dt, bool use_guess,
                            kg_step_report *report)
{
  if (!is_recording) {
    __real_kg_step_advance(step, q_next, v_next, q, v, tau, dt, use_guess, report);
    return;
  }
  const kg_body *body = the_run.clips[the_run.clip_count].def.body;
  const size_t v_bytes = (size_t)body->nv * sizeof *v;
  step_record *r = new_record(&the_run);
  r->clip = the_run.clip_count;
  r->dt = dt;
  r->use_guess = use_guess;
  memcpy(r->q, q, (size_t)body->nq * sizeof *q);
  memcpy(r->v, v, v_bytes);
  memcpy(r->tau, tau, v_bytes);
  memcpy(r->guess, v_next, v_bytes);
  __real_kg_step_advance(step, q_next, v_next, q, v, tau, dt, use_guess, report);
  memcpy(r->answer, v_next, v_bytes);
  kg_dynamics *d = NULL;
  if (kg_dynamics_create(&d, body, NULL) == KG_OK) {
    count_step(&the_run.of[classify(d, body, r->q, r->v, q_next, v_next, report)], report);
    kg_dynamics_destroy(d);
  }
}

static bool open_clip(clip_data *c, const char *path)
{
  kg_error error = {0};
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  kg_status status = kg_clip_read(&c->clip, path, &clip_def, &error);
  if (status == KG_OK) status = kg_subject_create(&c->subject, c->clip, &subject_def, &error);
  if (status != KG_OK) {
    fprintf(stderr, "step_states: %s: %s %s\n", path, kg_status_text(status), error.text);
  }
  return status == KG_OK;
}

static bool track_clip(run *r, const char *path)
{
  clip_data *c = &r->clips[r->clip_count];
  kg_error error = {0};
  kg_correct_result *result = NULL;
  const kg_correct_def def = kg_correct_default_def();
  is_recording = true;
  const kg_status status = kg_correct(&result, c->subject, &def, &error);
  is_recording = false;
  c->def.scene = &c->subject->scene; /* the tracker's own copy went with the tracker */
  if (status != KG_OK) {
    fprintf(stderr, "step_states: %s: %s %s\n", path, kg_status_text(status), error.text);
    return false;
  }
  printf("%-55s %6ld steps, %ld in sub-steps, %.2f iterations\n", path, result->steps,
         result->steps_substepped, (double)result->newton_iterations / (double)result->steps);
  fflush(stdout);
  kg_correct_result_destroy(result);
  return true;
}

/* ---- keeping -----------------------------------------------------------------------------------*/

static bool save(const run *r, const char *path)
{
  FILE *f = fopen(path, "wb");
  bool good = f != NULL;
  good = good && fwrite(&r->count, sizeof r->count, 1, f) == 1;
  for (int k = 0; k < r->clip_count; k++) {
    good = good && fwrite(&r->clips[k].def, sizeof(kg_step_def), 1, f) == 1;
  }
  good = good && fwrite(r->records, sizeof *r->records, r->count, f) == r->count;
  return f && fclose(f) == 0 && good;
}

static bool load(run *r, const char *path)
{
  FILE *f = fopen(path, "rb");
  bool good = f && fread(&r->count, sizeof r->count, 1, f) == 1;
  for (int k = 0; k < r->clip_count; k++) {
    kg_step_def *def = &r->clips[k].def;
    good = good && fread(def, sizeof *def, 1, f) == 1;
    def->body = r->clips[k].subject->body;
    def->scene = &r->clips[k].subject->scene;
    def->allocator = NULL;
  }
  r->records = good ? malloc(r->count * sizeof *r->records) : NULL;
  good = r->records && fread(r->records, sizeof *r->records, r->count, f) == r->count;
  if (f) (void)fclose(f);
  return good;
}

/* ---- solving again -----------------------------------------------------------------------------*/

/* Solver and dynamics of the clip a record belongs to, made anew when the clip changes. */
typedef struct bench {
  int clip;
  kg_step *step;
  kg_dynamics *dynamics;
  double scale[NV]; /* sqrt of diag(M) */
} bench;

static void close_bench(bench *b)
{
  kg_step_destroy(b->step);
  kg_dynamics_destroy(b->dynamics);
  b->step = NULL;
  b->dynamics = NULL;
}

static void use_clip(bench *b, const run *r, int clip)
{
  if (b->step && b->clip == clip) return;
  close_bench(b);
  b->clip = clip;
  const kg_step_def *def = &r->clips[clip].def;
  if (kg_step_create(&b->step, def) != KG_OK ||
      kg_dynamics_create(&b->dynamics, def->body, NULL) != KG_OK) {
    fprintf(stderr, "step_states: out of memory\n");
    exit(1);
  }
}

static double difference(bench *b, const kg_body *body, const double *q, const double *x,
                         const double *y)
{
  static double M[NV * NV];
  double worst = 0.0;
  kg_dynamics_mass_matrix(b->dynamics, M, q);
  for (int k = 0; k < body->nv; k++) {
    worst = fmax(worst, sqrt(M[k * body->nv + k]) * fabs(x[k] - y[k]));
  }
  return worst;
}

/* Solves a record into v; counts it. */
static void solve_record(const run *r, bench *b, const step_record *record, bool use_guess,
                         double *v, statistics of[CLASS_COUNT], const char *complain)
{
  double q_next[NQ];
  kg_step_report report;
  use_clip(b, r, record->clip);
  const kg_body *body = r->clips[record->clip].def.body;
  memcpy(v, record->guess, sizeof record->guess);
  kg_step_advance(b->step, q_next, v, record->q, record->v, record->tau, record->dt, use_guess,
                  &report);
  if (complain && (!report.converged || report.substeps > 1)) {
    printf("  %s of clip %d: %s, %d sub-steps, %d iterations, residual %.1e\n", complain,
           record->clip, report.converged ? "divided" : "FAILED", report.substeps,
           report.iterations, report.residual);
  }
  count_step(&of[classify(b->dynamics, body, record->q, record->v, q_next, v, &report)], &report);
}

static void replay(const run *r, int every)
{
  static statistics of[CLASS_COUNT];
  bench b = {0};
  double worst = 0.0, v[NV];
  long apart = 0;
  for (size_t k = 0; k < r->count; k += (size_t)every) {
    const step_record *record = &r->records[k];
    solve_record(r, &b, record, record->use_guess, v, of, "step");
    const double d = difference(&b, r->clips[record->clip].def.body, record->q, v, record->answer);
    worst = fmax(worst, d);
    apart += d > 1e-6;
  }
  close_bench(&b);
  print_table("steps of the clips, solved again", of);
  printf("from the answers kept: at most %.1e kg^1/2 m/s, %ld further than 1e-6\n", worst, apart);
}

/* ---- random states -----------------------------------------------------------------------------*/

static void set_down(kg_dynamics *d, const kg_step_def *def, double height, double *q)
{
  double low = INFINITY;
  kg_vec3 n = {0.0, 1.0, 0.0};
  for (int k = 0; k < def->body->point_count; k++) {
    const kg_sdf_value s =
      kg_scene_distance(def->scene, kg_dynamics_point(d, NULL, q, def->body->points[k]));
    if (s.distance < low) {
      low = s.distance;
      n = s.normal;
    }
  }
  q[0] += (height - low) * n.x;
  q[1] += (height - low) * n.y;
  q[2] += (height - low) * n.z;
}

/* One state in ten lies: it is turned as a whole, any way, and set down slowly. */
static void turn_over(kg_random *random, kg_dynamics *d, const kg_step_def *def,
                      step_record *record)
{
  double turn[NV] = {0.0};
  for (int k = 0; k < def->body->nv; k++) {
    turn[k] = k >= 3 && k < 6 ? 1.5 * kg_random_normal(random) : 0.0;
    record->v[k] *= 0.2;
  }
  kg_body_integrate(def->body, record->q, record->q, turn);
  set_down(d, def, def->contact.layer * kg_random_uniform(random), record->q);
}

/* joints by up to 0.05 rad, the root by up to 5 mm, rates by up to 0.5 rad/s and 0.5 m/s (one sigma) */
static void disturb(kg_random *random, kg_dynamics *d, const kg_step_def *def, step_record *record)
{
  const double size = kg_random_uniform(random);
  double move[NV];
  for (int k = 0; k < def->body->nv; k++) {
    move[k] = size * (k < 3 ? 0.005 : 0.05) * kg_random_normal(random);
    record->v[k] += size * 0.5 * kg_random_normal(random);
  }
  kg_body_integrate(def->body, record->q, record->q, move);
  if (kg_random_uniform(random) < 0.1) {
    turn_over(random, d, def, record);
  } else if (kg_random_uniform(random) < 0.5) {
    set_down(d, def, def->contact.layer * (2.0 * kg_random_uniform(random) - 0.5), record->q);
  }
}

static void solve_random(const run *r, int count, uint64_t seed)
{
  static statistics of[CLASS_COUNT];
  kg_random random = kg_random_make(seed);
  bench b = {0};
  size_t *order = malloc((size_t)count * sizeof *order);
  for (int k = 0; k < count && order; k++) { /* in the order of the clips: solvers are made once */
    order[k] = (size_t)(((double)k + kg_random_uniform(&random)) / count * (double)r->count);
  }
  for (int k = 0; k < count && order; k++) {
    step_record record = r->records[order[k] < r->count ? order[k] : r->count - 1];
    double v[NV];
    use_clip(&b, r, record.clip);
    disturb(&random, b.dynamics, &r->clips[record.clip].def, &record);
    solve_record(r, &b, &record, false, v, of, "random state");
  }
  free(order);
  close_bench(&b);
  print_table("random states", of);
}

/* ---- how fast the end is -----------------------------------------------------------------------*/

/* Residual after the first `most` iterations of a whole step. */
static double residual_after(const run *r, const step_record *record, int most, bool *done)
{
  kg_step_def def = r->clips[record->clip].def;
  kg_step *step = NULL;
  kg_step_report report;
  double q_next[NQ], v[NV];
  def.max_iterations = most;
  def.max_substep_levels = 0;
  if (kg_step_create(&step, &def) != KG_OK) exit(1);
  memcpy(v, record->guess, sizeof v);
  kg_step_advance(step, q_next, v, record->q, record->v, record->tau, record->dt, record->use_guess,
                  &report);
  kg_step_destroy(step);
  *done = report.converged;
  return report.residual;
}

/* Least residual so far, after 0, 1, 2, ... iterations, and from one to the next r' / r^2. */
static void print_tails(const run *r, int count)
{
  printf(
    "\nresiduals after each iteration (kg^1/2 m/s), in brackets over the square of the last\n");
  for (int k = 0; k < count; k++) {
    const step_record *record = &r->records[(2 * (size_t)k + 1) * r->count / (2 * (size_t)count)];
    bool done = false;
    double last = 0.0;
    for (int most = 0; !done && most < 10; most++) {
      const double m = residual_after(r, record, most, &done);
      printf(most > 0 ? " %9.2e (%7.1e)" : " %9.2e", m, m / (last * last));
      last = m;
    }
    printf("\n");
  }
}

/* ---- main --------------------------------------------------------------------------------------*/

int main(int argc, char **argv)
{
  run *r = &the_run;
  const char *save_path = NULL, *load_path = NULL;
  int random_count = 0, every = 1, tails = 0;
  uint64_t seed = 1;
  for (int i = 1; i < argc; i++) {
    const bool has_value = i + 1 < argc;
    if (strcmp(argv[i], "--random") == 0 && has_value) {
      random_count = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--seed") == 0 && has_value) {
      seed = strtoull(argv[++i], NULL, 10);
    } else if (strcmp(argv[i], "--every") == 0 && has_value) {
      every = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--tails") == 0 && has_value) {
      tails = atoi(argv[++i]);
    } else if (strcmp(argv[i], "--save") == 0 && has_value) {
      save_path = argv[++i];
    } else if (strcmp(argv[i], "--load") == 0 && has_value) {
      load_path = argv[++i];
    } else if (r->clip_count < MAX_CLIPS && open_clip(&r->clips[r->clip_count], argv[i])) {
      if (!load_path && !track_clip(r, argv[i])) return 1;
      r->clip_count++;
    } else {
      return 2;
    }
  }
  if (load_path && !load(r, load_path)) {
    fprintf(stderr, "step_states: %s does not hold the steps of these clips\n", load_path);
    return 2;
  }
  if (load_path) {
    replay(r, every > 0 ? every : 1);
  } else {
    print_table("steps of the clips", r->of);
  }
  if (save_path && !save(r, save_path)) {
    fprintf(stderr, "step_states: cannot write %s\n", save_path);
    return 2;
  }
  if (tails > 0 && r->count > 0) print_tails(r, tails);
  if (random_count > 0 && r->count > 0) solve_random(r, random_count, seed);
  for (int k = 0; k < r->clip_count; k++) {
    kg_subject_destroy(r->clips[k].subject);
    kg_clip_destroy(r->clips[k].clip);
  }
  free(r->records);
  return 0;
}
