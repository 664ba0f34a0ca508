/* States of the step cases: a body in flight, or settled on springs standing or lying, then pushed. */
#include "bench/dynamics/scenes.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double SETTLING = 1.5;        /* s */
static const double SPRING = 1500.0;       /* N m/rad, while the body settles */
static const double SPRING_DAMPING = 50.0; /* N m s/rad                       */
static const double STRING = 5000.0; /* N/m, holds the root over its place: a body on soft soles
                                              sways */
static const double STRING_DAMPING = 500.0; /* N s/m */
static const double PUSH = 10.0;            /* rad/s^2, standard deviation of the noise */

kg_step_def kg_bench_scene_step_def(const kg_bench_scene *scene, const kg_allocator *allocator)
{
  kg_step_def def = kg_step_default_def(scene->model.body);
  def.scene = &scene->ground;
  def.joint_damping = kg_bench_joint_damping;
  def.allocator = allocator;
  return def;
}

/* All rotations the identity (the pose the skeleton was drawn in), on its back when lying, its
 * lowest point 3 mm above the ground; in flight high above it. */
static void place(const kg_bench_scene *s, kg_dynamics *d)
{
  const kg_body *body = s->model.body;
  memset(s->q, 0, (size_t)body->nq * sizeof *s->q);
  for (int i = 0; i < body->segment_count; i++) {
    s->q[3 + 4 * i] = 1.0;
  }
  if (s->situation == KG_BENCH_LYING) {
    s->q[3] = sqrt(0.5);
    s->q[4] = -sqrt(0.5);
  }
  double low = INFINITY;
  for (int k = 0; k < body->point_count; k++) {
    low = fmin(low, kg_dynamics_point(d, NULL, s->q, body->points[k]).y);
  }
  s->q[1] = s->situation == KG_BENCH_FLIGHT ? 3.0 : 0.003 - low;
}

/* Springs in the joints, strings that keep the root from moving sideways. */
static void pull(const kg_bench_scene *s, const double *rest, double *tau)
{
  kg_body_difference(s->model.body, tau, rest, s->q);
  for (int k = 0; k < s->model.body->nv; k++) {
    const bool is_sideways = k == 0 || k == 2;
    tau[k] *= is_sideways ? STRING : k >= 6 ? SPRING : 0.0;
    tau[k] -= is_sideways ? STRING_DAMPING * s->v[k] : 0.0;
  }
}

/* Lets the body come to rest on springs; tau gets what they pull with in the end. */
static kg_status settle(const kg_bench_scene *s, double *tau)
{
  const kg_body *body = s->model.body;
  const size_t nq = (size_t)body->nq, nv = (size_t)body->nv;
  kg_step_def def = kg_bench_scene_step_def(s, NULL);
  def.joint_damping = SPRING_DAMPING;
  kg_step *step = NULL;
  kg_status status = kg_step_create(&step, &def);
  double *rest = status == KG_OK ? malloc(nq * sizeof *rest) : NULL;
  if (!rest) {
    kg_step_destroy(step);
    return status == KG_OK ? KG_ERR_NO_MEMORY : status;
  }
  memcpy(rest, s->q, nq * sizeof *rest);
  for (int n = 0; n < (int)(SETTLING / s->dt); n++) {
    pull(s, rest, tau);
    kg_step_advance(step, s->q, s->v, s->q, s->v, tau, s->dt, false, NULL);
  }
  memset(s->v, 0, nv * sizeof *s->v);
  kg_step_destroy(step);
  free(rest);
  return KG_OK;
}

/* Noise on every joint in proportion to the inertia it turns, diag(M). */
static kg_status push(const kg_bench_scene *s, kg_dynamics *d, kg_random *random)
{
  const int nv = s->model.body->nv;
  double *M = malloc((size_t)nv * (size_t)nv * sizeof *M);
  if (!M) {
    return KG_ERR_NO_MEMORY;
  }
  kg_dynamics_mass_matrix(d, M, s->q);
  for (int n = KG_BENCH_STEPS - 1; n >= 0; n--) { /* the first row, what holds, changes last */
    for (int k = 0; k < nv; k++) {
      const double size = k < 6 || s->situation == KG_BENCH_HELD ? 0.0 : PUSH;
      const double noise = size * M[k * nv + k] * kg_random_normal(random);
      s->tau[n * nv + k] = s->tau[k] + noise;
    }
  }
  free(M);
  return KG_OK;
}

static kg_status fill(kg_bench_scene *s, kg_dynamics *d)
{
  const kg_body *body = s->model.body;
  kg_random random = kg_random_make(5 + (uint64_t)s->situation);
  place(s, d);
  if (s->situation != KG_BENCH_FLIGHT) {
    const kg_status status = settle(s, s->tau);
    if (status != KG_OK) {
      return status;
    }
  }
  const double speed = s->situation == KG_BENCH_FLIGHT ? 1.0 : 0.02;
  for (int k = 0; k < body->nv; k++) {
    s->v[k] = speed * kg_random_normal(&random);
  }
  s->height = kg_dynamics_centroid(d, s->q, NULL).com.y;
  return push(s, d, &random);
}

kg_status kg_bench_scene_open(kg_bench_scene *s, kg_bench_situation situation,
                              const kg_bench_setting *setting, kg_error *error)
{
  *s = (kg_bench_scene){.situation = situation, .dt = 1.0 / 120.0};
  kg_status status = kg_bench_model_open(&s->model, KG_BENCH_MAPPED, setting->data_folder, error);
  if (status != KG_OK) {
    return status;
  }
  s->ground = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  const size_t nq = (size_t)s->model.body->nq, nv = (size_t)s->model.body->nv;
  s->q = calloc(nq + nv + KG_BENCH_STEPS * nv, sizeof *s->q);
  kg_dynamics *d = NULL;
  status = s->q ? kg_dynamics_create(&d, s->model.body, NULL) : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    s->v = s->q + nq;
    s->tau = s->v + nv;
    status = fill(s, d);
  }
  kg_dynamics_destroy(d);
  if (status != KG_OK) {
    kg_bench_scene_close(s);
  }
  return status;
}

void kg_bench_scene_close(kg_bench_scene *s)
{
  free(s->q);
  kg_bench_model_close(&s->model);
  *s = (kg_bench_scene){.q = NULL};
}
