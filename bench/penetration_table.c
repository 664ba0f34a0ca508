/* Table 1 of the paper (docs/theory/sdf.md): mean depth of torso, thigh, calf and foot before the
 * correction, after one step of it and after convergence.
 *
 *   penetration_table [--noise M] [--sink M] [--seed S] CLIP...
 *
 * A segment's depth in a frame is the largest of its sample points, max(-Phi, 0), in the ground
 * plane estimated from the capture. A row is the mean over the frames and segments of its kind that
 * penetrate before the correction (depth above 0), at every stage over the same ones.
 *
 * --noise: every segment that carries others is turned by a normal vector of sigma = M over the mean
 * distance of these, so that the next joint is moved by about M in each direction across it; the
 * root's place gets M in each direction. --sink lowers the root. Frames are changed independently. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/correction.h"
#include "kinegrad/random.h"
#include "kinegrad/subject.h"

enum { NQ = 3 + 4 * KG_ROLE_COUNT, NV = 3 + 3 * KG_ROLE_COUNT };

typedef enum kind { TORSO, THIGH, CALF, FOOT, KIND_COUNT } kind;
static const char *const KIND_NAMES[KIND_COUNT] = {"torso", "thigh", "calf", "foot"};
static const double PAPER[KIND_COUNT][3] = {
  {3.2, 0.8, 0.02}, {4.5, 1.2, 0.03}, {5.1, 1.5, 0.04}, {6.3, 2.0, 0.05}};

typedef enum stage {
  BEFORE,
  ONE_GRADIENT,
  ONE_SECOND,
  END_GRADIENT,
  END_SECOND,
  STAGE_COUNT
} stage;

typedef struct table {
  double sum[KIND_COUNT][STAGE_COUNT]; /* m */
  double most[KIND_COUNT][STAGE_COUNT];
  long count[KIND_COUNT];
  long frames, penetrating, failed;
} table;

static int kind_of(int role)
{
  switch (role) {
    case KG_ROLE_PELVIS:
    case KG_ROLE_SPINE1:
    case KG_ROLE_SPINE2:
    case KG_ROLE_SPINE3:
      return TORSO;
    case KG_ROLE_L_HIP:
    case KG_ROLE_R_HIP:
      return THIGH;
    case KG_ROLE_L_KNEE:
    case KG_ROLE_R_KNEE:
      return CALF;
    case KG_ROLE_L_ANKLE:
    case KG_ROLE_R_ANKLE:
    case KG_ROLE_L_TOE:
    case KG_ROLE_R_TOE:
      return FOOT;
    default:
      return -1;
  }
}

static void segment_depths(kg_dynamics *dynamics, const kg_subject *s, const double *q,
                           double depth[KG_ROLE_COUNT])
{
  kg_vec3 p[KG_ROLE_COUNT];
  kg_mat3 R[KG_ROLE_COUNT];
  const kg_body *body = s->body;
  memset(depth, 0, KG_ROLE_COUNT * sizeof *depth);
  kg_dynamics_pose(dynamics, q, p, R);
  for (int k = 0; k < body->point_count; k++) {
    const int i = body->points[k].segment;
    const kg_vec3 x = kg_vec3_add(p[i], kg_mat3_mul_vec(R[i], body->points[k].p));
    depth[i] = fmax(depth[i], -kg_scene_distance(&s->scene, x).distance);
  }
}

static void disturb(kg_random *random, const kg_body *body, double noise, double sink, double *q)
{
  double d[NV] = {0.0};
  for (int i = 0; i < body->segment_count; i++) {
    double length = 0.0;
    int carried = 0;
    for (int j = i + 1; j < body->segment_count; j++) {
      if (body->segments[j].parent != i) continue;
      length += kg_vec3_norm(body->segments[j].offset);
      carried++;
    }
    if (!(length > 0.0)) continue;
    for (int k = 0; k < 3; k++) {
      d[3 + 3 * i + k] = noise * carried / length * kg_random_normal(random);
    }
  }
  for (int k = 0; k < 3; k++) {
    d[k] = noise * kg_random_normal(random) - (k == 1 ? sink : 0.0);
  }
  kg_body_integrate(body, q, q, d);
}

typedef struct tools {
  kg_dynamics *dynamics;
  kg_correction *of[2];
} tools;

static void add_frame(table *t, const tools *tool, const kg_subject *s, const double *q)
{
  const kg_body *body = s->body;
  double depth[STAGE_COUNT][KG_ROLE_COUNT], end[NQ];
  const size_t bytes = (size_t)body->nq * sizeof *q;
  segment_depths(tool->dynamics, s, q, depth[BEFORE]);
  bool penetrates = false;
  for (int i = 0; i < body->segment_count; i++) {
    penetrates = penetrates || depth[BEFORE][i] > 0.0;
  }
  t->frames++;
  if (!penetrates) return;
  t->penetrating++;
  for (int method = 0; method < 2; method++) {
    memcpy(end, q, bytes);
    kg_correction_step(tool->of[method], end);
    segment_depths(tool->dynamics, s, end, depth[ONE_GRADIENT + method]);
    memcpy(end, q, bytes);
    t->failed += !kg_correction_apply(tool->of[method], end, NULL, NULL).converged;
    segment_depths(tool->dynamics, s, end, depth[END_GRADIENT + method]);
  }
  for (int i = 0; i < body->segment_count; i++) {
    const int k = kind_of(body->segments[i].role);
    if (k < 0 || !(depth[BEFORE][i] > 0.0)) continue;
    t->count[k]++;
    for (int at = 0; at < STAGE_COUNT; at++) {
      t->sum[k][at] += depth[at][i];
      t->most[k][at] = fmax(t->most[k][at], depth[at][i]);
    }
  }
}

static bool add_clip(table *t, const char *path, kg_random *random, double noise, double sink)
{
  kg_clip *clip = NULL;
  kg_subject *s = NULL;
  kg_error error = {0};
  tools tool = {0};
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  kg_status status = kg_clip_read(&clip, path, &clip_def, &error);
  if (status == KG_OK) status = kg_subject_create(&s, clip, &subject_def, &error);
  if (status == KG_OK) status = kg_dynamics_create(&tool.dynamics, s->body, NULL);
  for (int method = 0; method < 2 && status == KG_OK; method++) {
    kg_correction_def def = kg_correction_default_def(s->body, &s->scene);
    def.method = (kg_correction_method)method;
    status = kg_correction_create(&tool.of[method], &def);
  }
  for (int f = 0; status == KG_OK && f < s->frame_count; f++) {
    double q[NQ];
    memcpy(q, s->q + (size_t)f * (size_t)s->body->nq, (size_t)s->body->nq * sizeof *q);
    if (noise > 0.0 || sink != 0.0) disturb(random, s->body, noise, sink, q);
    add_frame(t, &tool, s, q);
  }
  if (status != KG_OK) {
    fprintf(stderr, "penetration_table: %s: %s %s\n", path, kg_status_text(status), error.text);
  }
  kg_correction_destroy(tool.of[0]);
  kg_correction_destroy(tool.of[1]);
  kg_dynamics_destroy(tool.dynamics);
  kg_subject_destroy(s);
  kg_clip_destroy(clip);
  return status == KG_OK;
}

static void print_table(const table *t)
{
  printf("%ld frames, %ld penetrate, %ld corrections above 1e-5 m at the end\n", t->frames,
         t->penetrating, t->failed);
  printf(
    "mean depth, mm            one step              converged             deepest converged     "
    "paper\n");
  printf(
    "segment   count   before  Eq. 11   2nd order    Eq. 11    2nd order   Eq. 11    2nd order   "
    "before  one   converged\n");
  for (int k = 0; k < KIND_COUNT; k++) {
    const double scale = t->count[k] > 0 ? 1e3 / (double)t->count[k] : 0.0;
    const double *m = t->sum[k], *most = t->most[k];
    printf("%-7s %7ld %8.3f %8.4f %8.4f %12.6f %10.6f %10.6f %10.6f %10.1f %5.1f %7.2f\n",
           KIND_NAMES[k], t->count[k], scale * m[BEFORE], scale * m[ONE_GRADIENT],
           scale * m[ONE_SECOND], scale * m[END_GRADIENT], scale * m[END_SECOND],
           1e3 * most[END_GRADIENT], 1e3 * most[END_SECOND], PAPER[k][0], PAPER[k][1], PAPER[k][2]);
  }
}

int main(int argc, char **argv)
{
  double noise = 0.0, sink = 0.0;
  uint64_t seed = 1;
  kg_random random = kg_random_make(seed);
  table t = {0};
  bool good = true;
  for (int i = 1; i < argc; i++) {
    const bool has_value = i + 1 < argc;
    if (strcmp(argv[i], "--noise") == 0 && has_value) {
      noise = atof(argv[++i]);
    } else if (strcmp(argv[i], "--sink") == 0 && has_value) {
      sink = atof(argv[++i]);
    } else if (strcmp(argv[i], "--seed") == 0 && has_value) {
      seed = strtoull(argv[++i], NULL, 10);
      random = kg_random_make(seed);
    } else {
      good = add_clip(&t, argv[i], &random, noise, sink) && good;
    }
  }
  printf("noise %g m, lowered by %g m, seed %llu\n", noise, sink, (unsigned long long)seed);
  print_table(&t);
  return good ? 0 : 1;
}
