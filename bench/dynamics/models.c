/* The synthetic skeleton is written as BVH text and read back, so that a body is made from it the
 * way it is made from any clip. Proportions: R. Drillis, R. Contini, Body segment parameters,
 * 1966, for 1.74 m. */
#include "bench/dynamics/models.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

/* x to the left, y up, z forward, cm; depth first. Extra joints are those a modelling program adds
 * to turn flesh and fingers with; the canonical skeleton has none of them. */
typedef struct row {
  const char *name;
  int parent;
  double x, y, z;
  bool is_extra;
} row;

static const row skeleton[KG_BENCH_SYNTHETIC_JOINTS] = {
  {"Hips", -1, 0, 0, 0, false},
  {"Spine", 0, 0, 9, -1, false},
  {"Spine1", 1, 0, 12, -1, false},
  {"Spine2", 2, 0, 13, 0, false},
  {"Neck", 3, 0, 17, 1, false},
  {"Neck1", 4, 0, 5, 1, false},
  {"Head", 5, 0, 5, 1, false},
  {"Jaw", 6, 0, 2, 7, true},
  {"LeftShoulder", 3, 3, 13, 0, false},
  {"LeftArm", 8, 15, 0, 0, false},
  {"LeftArmTwist", 9, 14, 0, 0, true},
  {"LeftForeArm", 9, 28, 0, 0, false},
  {"LeftForeArmTwist", 11, 13, 0, 0, true},
  {"LeftHand", 11, 25, 0, 0, false},
  {"LeftHandThumb", 13, 4, -1, 3, true},
  {"LeftHandIndex", 13, 9, 0, 2, true},
  {"LeftHandRing", 13, 9, 0, -1, true},
  {"RightShoulder", 3, -3, 13, 0, false},
  {"RightArm", 17, -15, 0, 0, false},
  {"RightArmTwist", 18, -14, 0, 0, true},
  {"RightForeArm", 18, -28, 0, 0, false},
  {"RightForeArmTwist", 20, -13, 0, 0, true},
  {"RightHand", 20, -25, 0, 0, false},
  {"RightHandThumb", 22, -4, -1, 3, true},
  {"RightHandIndex", 22, -9, 0, 2, true},
  {"RightHandRing", 22, -9, 0, -1, true},
  {"LeftUpLeg", 0, 9, -3, 0, false},
  {"LeftUpLegTwist", 26, 0, -20, 0, true},
  {"LeftLeg", 26, 0, -42, 0, false},
  {"LeftFoot", 28, 0, -42, -2, false},
  {"LeftToeBase", 29, 0, -6, 13, false},
  {"RightUpLeg", 0, -9, -3, 0, false},
  {"RightUpLegTwist", 31, 0, -20, 0, true},
  {"RightLeg", 31, 0, -42, 0, false},
  {"RightFoot", 33, 0, -42, -2, false},
  {"RightToeBase", 34, 0, -6, 13, false},
  {"Tail", 0, 0, -2, -9, true},
};

/* ---- the synthetic clip ---------------------------------------------------------------------- */

typedef struct text {
  char at[16384];
  size_t length;
} text;

static void add(text *t, const char *format, ...) KG_PRINTF(2, 3);
static void add(text *t, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  const int n = vsnprintf(t->at + t->length, sizeof t->at - t->length, format, arguments);
  va_end(arguments);
  t->length += n > 0 ? (size_t)n : 0;
  KG_ASSERT(t->length < sizeof t->at);
}

static bool is_in(int joint, kg_bench_skeleton kind)
{
  return kind == KG_BENCH_EVERY_JOINT || !skeleton[joint].is_extra;
}

/* The joint and all below it. */
static void add_joint(text *t, int joint, kg_bench_skeleton kind, int *count)
{
  const row *r = &skeleton[joint];
  add(t, "%s %s\n{\nOFFSET %g %g %g\n", r->parent < 0 ? "ROOT" : "JOINT", r->name, r->x, r->y,
      r->z);
  add(t, "CHANNELS %s Zrotation Xrotation Yrotation\n",
      r->parent < 0 ? "6 Xposition Yposition Zposition" : "3");
  ++*count;
  bool has_children = false;
  for (int k = joint + 1; k < KG_BENCH_SYNTHETIC_JOINTS; k++) {
    if (skeleton[k].parent == joint && is_in(k, kind)) {
      add_joint(t, k, kind, count);
      has_children = true;
    }
  }
  if (!has_children) {
    const bool is_head = strcmp(r->name, "Head") == 0;
    add(t, "End Site\n{\nOFFSET 0 %d %d\n}\n", is_head ? 18 : 0, is_head ? 0 : 6);
  }
  add(t, "}\n");
}

static kg_status synthetic_clip(kg_clip **clip, kg_bench_skeleton kind, kg_error *error)
{
  text *t = calloc(1, sizeof *t);
  if (!t) {
    return KG_ERR_NO_MEMORY;
  }
  int joints = 0;
  add(t, "HIERARCHY\n");
  add_joint(t, 0, kind, &joints);
  add(t, "MOTION\nFrames: 2\nFrame Time: 0.01\n");
  for (int frame = 0; frame < 2; frame++) {
    add(t, "0 93 0");
    for (int k = 0; k < 3 * joints; k++) {
      add(t, " 0");
    }
    add(t, "\n");
  }
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.01;
  def.up_given = true;
  def.up = KG_UP_Y;
  def.keep_first_frame = true;
  const kg_status status =
    kg_clip_read_bvh_text(clip, t->at, t->length, "synthetic skeleton", &def, error);
  free(t);
  return status;
}

/* ---- bodies ---------------------------------------------------------------------------------- */

/* From the joint to the mean of its children; 5 cm forward where there is none. */
static kg_vec3 bone_of(const kg_clip *clip, int joint)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  int children = 0;
  for (int k = joint + 1; k < clip->joint_count; k++) {
    if (clip->joints[k].parent == joint) {
      sum = kg_vec3_add(sum, clip->joints[k].offset);
      children++;
    }
  }
  return children > 0 ? kg_vec3_scale(1.0 / children, sum) : kg_vec3_make(0.0, 0.0, 0.05);
}

/* A rod along the bone, half its mass as a ball of 5 cm radius. */
static void give_mass(kg_segment *s, kg_vec3 bone, double mass)
{
  const double rod = 0.5 * mass / 12.0, ball = 0.5 * mass * 0.4 * 0.05 * 0.05;
  s->mass = mass;
  s->com = kg_vec3_scale(0.5, bone);
  const double b[3] = {bone.x, bone.y, bone.z}, square = kg_vec3_dot(bone, bone);
  for (int k = 0; k < 3; k++) {
    s->inertia[k] = rod * (square - b[k] * b[k]) + ball;
  }
  s->inertia[3] = -rod * b[0] * b[1];
  s->inertia[4] = -rod * b[0] * b[2];
  s->inertia[5] = -rod * b[1] * b[2];
}

kg_status kg_bench_body_of_every_joint(kg_body **body, const kg_clip *clip)
{
  const double mass = 70.0;
  const int n = clip->joint_count;
  kg_segment *segments = calloc((size_t)n, sizeof *segments);
  if (!segments) {
    return KG_ERR_NO_MEMORY;
  }
  double length = 0.0;
  for (int i = 0; i < n; i++) {
    length += 0.05 + kg_vec3_norm(bone_of(clip, i));
  }
  for (int i = 0; i < n; i++) {
    const kg_vec3 bone = bone_of(clip, i);
    const kg_joint *joint = &clip->joints[i];
    segments[i] =
      (kg_segment){.role = -1, .joint = i, .parent = joint->parent, .offset = joint->offset};
    snprintf(segments[i].name, sizeof segments[i].name, "%.31s", joint->name);
    give_mass(&segments[i], bone, mass * (0.05 + kg_vec3_norm(bone)) / length);
  }
  const kg_status status = kg_body_create(body, segments, n, NULL, 0, NULL);
  free(segments);
  return status;
}

static kg_status make_body(kg_bench_model *model, kg_bench_skeleton skeleton_kind, kg_error *error)
{
  if (skeleton_kind == KG_BENCH_EVERY_JOINT) {
    return kg_bench_body_of_every_joint(&model->body, model->clip);
  }
  kg_mapping mapping;
  const kg_body_def def = kg_body_default_def();
  const kg_status status = kg_mapping_find(&mapping, model->clip, NULL, error);
  return status == KG_OK ? kg_body_from_clip(&model->body, model->clip, &mapping, &def, error)
                         : status;
}

/* The clip that data stand for. */
static void path_of(char *path, size_t size, const char *data, kg_bench_skeleton kind)
{
  struct stat about;
  const bool is_folder = stat(data, &about) == 0 && S_ISDIR(about.st_mode);
  snprintf(path, size, "%s%s", data,
           !is_folder                ? ""
           : kind == KG_BENCH_MAPPED ? "/gymnastics/cmu_49_02.bvh"
                                     : "/gymnastics/snu_backflip.bvh");
}

kg_status kg_bench_model_open(kg_bench_model *model, kg_bench_skeleton skeleton_kind,
                              const char *data, kg_error *error)
{
  char path[1024] = "synthetic skeleton";
  *model = (kg_bench_model){.clip = NULL};
  kg_status status;
  if (data) {
    const kg_clip_def def = kg_clip_default_def();
    path_of(path, sizeof path, data, skeleton_kind);
    status = kg_clip_read(&model->clip, path, &def, error);
  } else {
    status = synthetic_clip(&model->clip, skeleton_kind, error);
  }
  if (status == KG_OK) {
    status = make_body(model, skeleton_kind, error);
  }
  if (status != KG_OK) {
    kg_bench_model_close(model);
    return status;
  }
  const size_t length = strlen(path);
  snprintf(model->source, sizeof model->source, "%.120s, %s%d segments, %d degrees of freedom",
           length > 120 ? path + length - 120 : path,
           skeleton_kind == KG_BENCH_EVERY_JOINT ? "every joint kept, " : "",
           model->body->segment_count, model->body->nv);
  return KG_OK;
}

void kg_bench_model_close(kg_bench_model *model)
{
  kg_body_destroy(model->body);
  kg_clip_destroy(model->clip);
  *model = (kg_bench_model){.clip = NULL};
}

/* ---- states ---------------------------------------------------------------------------------- */

void kg_bench_random_state(kg_random *random, const kg_body *body, double *q, double *v, double *a)
{
  for (int k = 0; k < 3; k++) {
    q[k] = kg_random_normal(random);
  }
  for (int i = 0; i < body->segment_count; i++) {
    kg_quat r;
    double *at[4] = {&r.w, &r.x, &r.y, &r.z};
    for (int k = 0; k < 4; k++) {
      *at[k] = kg_random_normal(random);
    }
    r = kg_quat_normalized(r);
    for (int k = 0; k < 4; k++) {
      q[3 + 4 * i + k] = *at[k];
    }
  }
  for (int k = 0; k < body->nv; k++) {
    v[k] = 3.0 * kg_random_normal(random);
    a[k] = 30.0 * kg_random_normal(random);
  }
}
