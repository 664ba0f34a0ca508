/* Data of bundle adjustment: from a file of ADBench, or made up; and its perturbation. */
#include <math.h>
#include <stdlib.h>

#include "bench/autodiff/numbers.h"
#include "bench/autodiff/problems.h"
#include "kinegrad/random.h"

enum { LARGEST = 10000000 };

/* What all cameras, points, weights and features equal. */
typedef struct model {
  double camera[KG_BENCH_BA_CAMERA], point[3], weight, feature[2];
} model;

void kg_bench_ba_destroy(kg_bench_ba *ba)
{
  if (ba) {
    kg_arena_release(&ba->arena);
    free(ba);
  }
}

static void fill(kg_bench_ba *ba, const model *one)
{
  double *point = ba->theta + (size_t)ba->n * KG_BENCH_BA_CAMERA;
  double *weight = point + (size_t)ba->m * 3;
  for (int i = 0; i < ba->n * KG_BENCH_BA_CAMERA; i++) {
    ba->theta[i] = one->camera[i % KG_BENCH_BA_CAMERA];
  }
  for (int i = 0; i < ba->m * 3; i++) {
    point[i] = one->point[i % 3];
  }
  for (int i = 0; i < ba->p; i++) {
    weight[i] = one->weight;
    ba->feature[2 * i] = one->feature[0];
    ba->feature[2 * i + 1] = one->feature[1];
    ba->camera[i] = i % ba->n;
    ba->point[i] = i % ba->m;
  }
}

static kg_status create(kg_bench_ba **ba_out, int n, int m, int p, const model *one)
{
  *ba_out = NULL;
  kg_bench_ba *ba = calloc(1, sizeof *ba);
  if (!ba) {
    return KG_ERR_NO_MEMORY;
  }
  kg_arena_init(&ba->arena, NULL);
  ba->n = n, ba->m = m, ba->p = p;
  ba->parameter_count = n * KG_BENCH_BA_CAMERA + m * 3 + p;
  ba->theta = KG_ARENA_ARRAY(&ba->arena, double, ba->parameter_count);
  ba->feature = KG_ARENA_ARRAY(&ba->arena, double, 2 * (size_t)p);
  ba->camera = KG_ARENA_ARRAY(&ba->arena, int, p);
  ba->point = KG_ARENA_ARRAY(&ba->arena, int, p);
  if (kg_arena_failed(&ba->arena)) {
    kg_bench_ba_destroy(ba);
    return KG_ERR_NO_MEMORY;
  }
  fill(ba, one);
  *ba_out = ba;
  return KG_OK;
}

kg_status kg_bench_ba_read(kg_bench_ba **ba, const char *path, kg_error *error)
{
  *ba = NULL;
  kg_arena content;
  kg_arena_init(&content, NULL);
  numbers in = numbers_open(&content, path, error);
  const int n = numbers_count(&in, 1, LARGEST, "the number of cameras n");
  const int m = numbers_count(&in, 1, LARGEST, "the number of points m");
  const int p = numbers_count(&in, 1, LARGEST, "the number of observations p");
  model one;
  numbers_read(&in, one.camera, KG_BENCH_BA_CAMERA, "a number of the camera");
  numbers_read(&in, one.point, 3, "a coordinate of the point");
  numbers_read(&in, &one.weight, 1, "the weight");
  numbers_read(&in, one.feature, 2, "a coordinate of the feature");
  numbers_end(&in);
  kg_arena_release(&content);
  if (in.status == KG_OK && create(ba, n, m, p, &one) != KG_OK) {
    in.status =
      kg_fail(error, KG_ERR_NO_MEMORY, path, 1, 0, "not enough memory for n %d m %d p %d", n, m, p);
  }
  return in.status;
}

kg_status kg_bench_ba_synthetic(kg_bench_ba **ba, int n, int m, int p)
{
  /* a camera 70 units away, turned by about 1.6 rad, that sees the point off its axis */
  const model one = {.camera = {-0.8, -1.1, -0.8, 35.0, 40.0, 54.0, 420.0, 6.0, -8.0, 0.09, 0.003},
                     .point = {7.0, 0.5, 3.0},
                     .weight = 0.4,
                     .feature = {270.0, 830.0}};
  return create(ba, n, m, p, &one);
}

static void perturb(double *values, int count, kg_random *random)
{
  for (int i = 0; i < count; i++) {
    const double size = fmax(0.02 * fabs(values[i]), 1e-3);
    values[i] += size * (2.0 * kg_random_uniform(random) - 1.0);
  }
}

void kg_bench_ba_perturb(kg_bench_ba *ba, uint64_t seed)
{
  kg_random random = kg_random_make(seed);
  perturb(ba->theta, ba->parameter_count, &random);
  perturb(ba->feature, 2 * ba->p, &random);
}
