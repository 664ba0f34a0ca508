/* A hand with random numbers, and its Jacobian by complex steps. */
#include <complex.h>
#include <stdlib.h>

#define number double complex
#include "bench/autodiff/hand_loops.h"
#include "kinegrad/random.h"

enum { FINGERS = 5, BONES_OF_FINGER = 4 };

size_t kg_bench_hand_work(const kg_bench_hand *hand)
{
  return 28 * (size_t)hand->bones + 3 * (size_t)hand->vertices;
}

int kg_bench_hand_columns(const kg_bench_hand *hand)
{
  return KG_BENCH_HAND_POSE + (hand->complicated ? 2 : 0);
}

static bool take(kg_bench_hand *hand)
{
  kg_arena *arena = &hand->arena;
  const size_t bones = (size_t)hand->bones, n = (size_t)hand->vertices;
  const size_t count = (size_t)hand->correspondences;
  hand->parent = KG_ARENA_ARRAY(arena, int, bones);
  hand->angle = KG_ARENA_ARRAY(arena, int, 2 * bones);
  hand->base = KG_ARENA_ARRAY(arena, double, 16 * bones);
  hand->inverse = KG_ARENA_ARRAY(arena, double, 16 * bones);
  hand->weight = KG_ARENA_ARRAY(arena, double, bones *n);
  hand->points = KG_ARENA_ARRAY(arena, double, 4 * n);
  hand->theta = KG_ARENA_ARRAY(arena, double, KG_BENCH_HAND_POSE + 2 * count);
  hand->corner = KG_ARENA_ARRAY(arena, int32_t, 3 * count);
  hand->target = KG_ARENA_ARRAY(arena, double, 3 * count);
  return !kg_arena_failed(arena);
}

/* two bones of the arm, then fingers of four: the first of a finger turns about two axes, the next
 * two about one, the tip about none */
static void join_bones(kg_bench_hand *hand)
{
  for (int b = 0; b < hand->bones; b++) {
    const int finger = (b - 2) / BONES_OF_FINGER, joint = b < 2 ? 3 : (b - 2) % BONES_OF_FINGER;
    hand->parent[b] = b >= 2 && joint == 0 ? 1 : b - 1;
    hand->angle[2 * b] = joint == 3 ? -1 : 6 + 4 * finger + joint + (joint > 0);
    hand->angle[2 * b + 1] = joint == 0 ? 7 + 4 * finger : -1;
  }
}

static void fill_normal(kg_random *random, double size, double *x, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    x[i] = size * kg_random_normal(random);
  }
}

/* the last row of 4 x 4 matrices, and the fourth coordinate of points */
static void make_homogeneous(kg_bench_hand *hand)
{
  for (int b = 0; b < hand->bones; b++) {
    for (int i = 12; i < 16; i++) {
      hand->base[16 * b + i] = hand->inverse[16 * b + i] = i == 15;
    }
  }
  for (int p = 0; p < hand->vertices; p++) {
    hand->points[3 * hand->vertices + p] = 1.0;
  }
}

kg_status kg_bench_hand_create(kg_bench_hand **hand_out, int vertices, int correspondences,
                               bool complicated, uint64_t seed)
{
  *hand_out = NULL;
  kg_bench_hand *hand = calloc(1, sizeof *hand);
  if (!hand) return KG_ERR_NO_MEMORY;
  kg_arena_init(&hand->arena, NULL);
  hand->bones = 2 + FINGERS * BONES_OF_FINGER;
  hand->vertices = vertices, hand->correspondences = correspondences;
  hand->complicated = complicated;
  if (!take(hand)) {
    kg_bench_hand_destroy(hand);
    return KG_ERR_NO_MEMORY;
  }
  const size_t bones = (size_t)hand->bones, n = (size_t)vertices, count = (size_t)correspondences;
  kg_random random = kg_random_make(seed);
  join_bones(hand);
  fill_normal(&random, 0.6, hand->base, 16 * bones);
  fill_normal(&random, 0.6, hand->inverse, 16 * bones);
  fill_normal(&random, 1.0, hand->points, 3 * n);
  fill_normal(&random, 0.5, hand->theta, KG_BENCH_HAND_POSE + 2 * count);
  fill_normal(&random, 1.0, hand->target, 3 * count);
  make_homogeneous(hand);
  for (size_t i = 0; i < bones * n; i++) {
    hand->weight[i] = kg_random_uniform(&random) / hand->bones;
  }
  for (size_t i = 0; i < 3 * count; i++) {
    hand->corner[i] = (int32_t)(kg_random_bits(&random) % n);
  }
  *hand_out = hand;
  return KG_OK;
}

void kg_bench_hand_destroy(kg_bench_hand *hand)
{
  if (hand) kg_arena_release(&hand->arena);
  free(hand);
}

/* a column of s or t holds, for every residual, the derivative by its own one */
kg_status kg_bench_hand_reference(const kg_bench_hand *hand, double *residual, double *J)
{
  const size_t count = (size_t)hand->correspondences, rows = 3 * count;
  const size_t parameters = KG_BENCH_HAND_POSE + 2 * count;
  const int columns = kg_bench_hand_columns(hand);
  number *theta = malloc((parameters + rows + kg_bench_hand_work(hand)) * sizeof *theta);
  if (!theta) return KG_ERR_NO_MEMORY;
  number *result = theta + parameters;
  for (int c = 0; c < columns; c++) {
    for (size_t i = 0; i < parameters; i++) {
      const bool moves = i < KG_BENCH_HAND_POSE ? (int)i == c : 26 + (int)i % 2 == c;
      theta[i] = hand->theta[i] + (moves ? 1e-100 : 0.0) * I;
    }
    hand_residuals(hand, theta, result, result + rows);
    for (size_t r = 0; r < rows; r++) {
      residual[r] = creal(result[r]);
      J[r * (size_t)columns + (size_t)c] = cimag(result[r]) / 1e-100;
    }
  }
  free(theta);
  return KG_OK;
}
