/* Derivatives of bundle adjustment: the sparse Jacobian and the gradient of the loss. The data are
 * perturbed, since in ADBench's all cameras, points, weights and features are equal.
 *
 * Answer of a Jacobian case: Jacobian (p x 2 x 15, p), residuals (p x 2, p); entries are compared
 * by column, whose scales differ. Of a loss case: the loss, its gradient by cameras, points,
 * weights. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/cases.h"

enum { JACOBIAN = 1, WEIGHT_JACOBIAN = 2, RESIDUALS = 4 };
enum {
  LOSS = 1,
  CAMERAS = 2,
  POINTS = 4,
  WEIGHTS = 8,
  GRADIENT = LOSS | CAMERAS | POINTS | WEIGHTS
};

typedef struct size {
  const char *file;
  int n, m, p;
} size;

static const size ba1 = {"ba1", 49, 7776, 31843}, ba5 = {"ba5", 257, 65132, 225911};

static kg_status load(kg_bench_ba **ba, kg_bench_problem *problem, const kg_bench_setting *setting,
                      const size *of, kg_error *error)
{
  if (!setting->data_folder) {
    snprintf(problem->source, sizeof problem->source, "synthetic, perturbed");
    return kg_bench_ba_synthetic(ba, of->n, of->m, of->p);
  }
  char path[200];
  snprintf(path, sizeof path, "%s/%s.txt", setting->data_folder, of->file);
  snprintf(problem->source, sizeof problem->source, "%s, perturbed", path);
  return kg_bench_ba_read(ba, path, error);
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  kg_bench_ba *ba = NULL;
  const kg_status status = load(&ba, problem, setting, detail, error);
  if (status == KG_OK) {
    kg_bench_ba_perturb(ba, 1);
    problem->data = ba;
    problem->items = 1.0;
  }
  return status;
}

static kg_status open_jacobian(kg_bench_problem *problem, const kg_bench_setting *setting,
                               const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const size_t p = (size_t)((const kg_bench_ba *)problem->data)->p;
    problem->parts[0] = (kg_bench_part){"Jacobian", 30 * p, 30};
    problem->parts[1] = (kg_bench_part){"Jacobian of the weight residuals", p, 1};
    problem->parts[2] = (kg_bench_part){"residuals", 3 * p, 1};
    problem->part_count = 3;
  }
  return status;
}

/* times are those of one observation */
static kg_status open_observations(kg_bench_problem *problem, const kg_bench_setting *setting,
                                   const void *detail, kg_error *error)
{
  const kg_status status = open_jacobian(problem, setting, detail, error);
  if (status == KG_OK) {
    problem->items = ((const kg_bench_ba *)problem->data)->p;
  }
  return status;
}

static kg_status open_loss(kg_bench_problem *problem, const kg_bench_setting *setting,
                           const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const kg_bench_ba *ba = problem->data;
    problem->parts[0] = (kg_bench_part){"loss", 1, 1};
    problem->parts[1] = (kg_bench_part){"d/d cameras", 11 * (size_t)ba->n, 11};
    problem->parts[2] = (kg_bench_part){"d/d points", 3 * (size_t)ba->m, 3};
    problem->parts[3] = (kg_bench_part){"d/d weights", (size_t)ba->p, 1};
    problem->part_count = 4;
  }
  return status;
}

static void close(kg_bench_problem *problem)
{
  kg_bench_ba_destroy(problem->data);
}

static kg_status reference_jacobian(const void *data, double *answer)
{
  const kg_bench_ba *ba = data;
  kg_bench_ba_reference(ba, ba->theta, answer + 31 * (size_t)ba->p, answer, NULL);
  return KG_OK;
}

static kg_status reference_loss(const void *data, double *answer)
{
  const kg_bench_ba *ba = data;
  const size_t count = 3 * (size_t)ba->p;
  double *residuals = malloc(count * sizeof *residuals);
  if (!residuals) {
    return KG_ERR_NO_MEMORY;
  }
  kg_bench_ba_reference(ba, ba->theta, residuals, NULL, answer + 1);
  answer[0] = 0.0;
  for (size_t i = 0; i < count; i++) {
    answer[0] += 0.5 * residuals[i] * residuals[i];
  }
  free(residuals);
  return KG_OK;
}

/* ---- plain C --------------------------------------------------------------------------------- */

/* the state is the problem itself */
static kg_status create_plain(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  const kg_bench_ba **ba = malloc(sizeof *ba);
  if (!ba) {
    return KG_ERR_NO_MEMORY;
  }
  *ba = data;
  *state = ba;
  return KG_OK;
}

static kg_status run_residuals(void *state, double *answer)
{
  const kg_bench_ba *ba = *(const kg_bench_ba **)state;
  kg_bench_ba_residuals(ba, ba->theta, answer + 31 * (size_t)ba->p);
  return KG_OK;
}

static kg_status run_loss(void *state, double *answer)
{
  const kg_bench_ba *ba = *(const kg_bench_ba **)state;
  answer[0] = kg_bench_ba_loss(ba, ba->theta);
  return KG_OK;
}

/* ---- the cases ------------------------------------------------------------------------------- */

enum { PLAIN, RECORDED, REPLAYED, ADOLC_RETAPED, ADOLC_REPLAYED, CONTESTANTS };

#define PLAIN_RESIDUALS                                                                            \
  {                                                                                                \
    "plain residuals, -O3", NULL, RESIDUALS, create_plain, run_residuals, free                     \
  }
#define KINEGRAD_RECORDED(mask, run)                                                               \
  {                                                                                                \
    "kinegrad, recorded", NULL, mask, kg_bench_ba_recorded, run, kg_bench_ba_tape_destroy          \
  }
#define KINEGRAD_REPLAYED(mask, run)                                                               \
  {                                                                                                \
    "kinegrad, replayed", NULL, mask, kg_bench_ba_jacobian_replayed, run, kg_bench_ba_tape_destroy \
  }

static const kg_bench_contestant jacobians[CONTESTANTS] = {
  [PLAIN] = PLAIN_RESIDUALS,
  [RECORDED] = KINEGRAD_RECORDED(JACOBIAN | WEIGHT_JACOBIAN, kg_bench_ba_recorded_jacobian),
  [REPLAYED] = KINEGRAD_REPLAYED(JACOBIAN | WEIGHT_JACOBIAN, kg_bench_ba_replay_jacobian),
  [ADOLC_RETAPED] =
    ADOLC_CONTESTANT("ADOL-C, retaped", JACOBIAN | WEIGHT_JACOBIAN, kg_adolc_ba_jacobian_retaped),
  [ADOLC_REPLAYED] =
    ADOLC_CONTESTANT("ADOL-C, replayed", JACOBIAN | WEIGHT_JACOBIAN, kg_adolc_ba_jacobian_replayed),
};

static const kg_bench_contestant observations[CONTESTANTS] = {
  [PLAIN] = PLAIN_RESIDUALS,
  [RECORDED] = KINEGRAD_RECORDED(JACOBIAN, kg_bench_ba_recorded_observations),
  [REPLAYED] = KINEGRAD_REPLAYED(JACOBIAN, kg_bench_ba_replay_observations),
  [ADOLC_RETAPED] = ADOLC_CONTESTANT("ADOL-C, retaped", JACOBIAN | WEIGHT_JACOBIAN,
                                     kg_adolc_ba_observation_retaped),
  [ADOLC_REPLAYED] = ADOLC_CONTESTANT("ADOL-C, replayed", JACOBIAN | WEIGHT_JACOBIAN,
                                      kg_adolc_ba_observation_replayed),
};

enum { LOSS_CONTESTANTS = 4 };
static const kg_bench_contestant losses[LOSS_CONTESTANTS] = {
  {"plain loss, -O3", NULL, LOSS, create_plain, run_loss, free},
  {"kinegrad, replayed", NULL, GRADIENT, kg_bench_ba_loss_replayed, kg_bench_ba_replay_loss,
   kg_bench_ba_tape_destroy},
  ADOLC_CONTESTANT("ADOL-C, retaped", GRADIENT, kg_adolc_ba_loss_retaped),
  ADOLC_CONTESTANT("ADOL-C, replayed", GRADIENT, kg_adolc_ba_loss_replayed),
};

static const kg_bench_pair jacobian_pairs[] = {
  {"kinegrad recorded", RECORDED, PLAIN, 0.0},
  {"kinegrad replayed", REPLAYED, PLAIN, 5.0},
  {"ADOL-C retaped", ADOLC_RETAPED, PLAIN, 0.0},
  {"ADOL-C replayed", ADOLC_REPLAYED, PLAIN, 0.0},
  {"kinegrad over ADOL-C", REPLAYED, ADOLC_REPLAYED, 0.1},
};
/* a pair of one with itself: microseconds an observation */
static const kg_bench_pair observation_pairs[] = {
  {"kinegrad recorded, us", RECORDED, RECORDED, 0.6},
  {"kinegrad replayed, us", REPLAYED, REPLAYED, 0.15},
  {"kinegrad over ADOL-C", REPLAYED, ADOLC_REPLAYED, 0.1},
  {"kinegrad over ADOL-C, recorded", RECORDED, ADOLC_RETAPED, 0},
};
static const kg_bench_pair loss_pairs[] = {
  {"kinegrad replayed", 1, 0, 4.0},
  {"ADOL-C retaped", 2, 0, 0.0},
  {"ADOL-C replayed", 3, 0, 0.0},
  {"kinegrad over ADOL-C", 1, 3, 0.1},
};

/* clang-format off */
#define CASE(title, time_unit, seconds, size_of, open_function, reference_function, table, ratios) \
  {                                                                                                \
    .name = (title), .unit = (time_unit), .unit_seconds = (seconds), .tolerance = 1e-10,           \
    .detail = (size_of), .open = (open_function), .close = close,                                  \
    .reference = (reference_function), .contestants = (table),                                     \
    .contestant_count = KG_COUNT_OF(table), .pairs = ratios, .pair_count = KG_COUNT_OF(ratios)     \
  }
/* clang-format on */

const kg_bench_case kg_bench_ba_cases[BENCH_BA_CASES] = {
  CASE("ba1_jacobian", "ms", 1e-3, &ba1, open_jacobian, reference_jacobian, jacobians,
       jacobian_pairs),
  CASE("ba5_jacobian", "ms", 1e-3, &ba5, open_jacobian, reference_jacobian, jacobians,
       jacobian_pairs),
  CASE("ba1_loss", "ms", 1e-3, &ba1, open_loss, reference_loss, losses, loss_pairs),
  CASE("ba5_loss", "ms", 1e-3, &ba5, open_loss, reference_loss, losses, loss_pairs),
  /* latency: the Jacobian of a single observation */
  CASE("ba_observation", "us", 1e-6, &ba1, open_observations, reference_jacobian, observations,
       observation_pairs),
};
