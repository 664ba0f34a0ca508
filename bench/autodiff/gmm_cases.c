/* Gradients of the Gaussian mixture. An answer is the value and the gradient by alpha, mu and icf. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/autodiff/cases.h"

enum { VALUE = 1, ALPHA = 2, MU = 4, ICF = 8, ALL = VALUE | ALPHA | MU | ICF };

typedef struct size {
  int D, K;
  double gamma; /* 0: as in the file */
  int m;
} size;

static kg_status load(kg_bench_gmm **gmm, kg_bench_problem *problem,
                      const kg_bench_setting *setting, const size *of, kg_error *error)
{
  if (!setting->data_folder) {
    snprintf(problem->source, sizeof problem->source, "synthetic, 1000 points");
    return kg_bench_gmm_synthetic(gmm, of->D, of->K, 1000, 1);
  }
  snprintf(problem->source, sizeof problem->source, "%s/gmm_d%d_K%d.txt", setting->data_folder,
           of->D, of->K);
  return kg_bench_gmm_read(gmm, problem->source, error);
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  const size *of = detail;
  kg_bench_gmm *gmm = NULL;
  const kg_status status = load(&gmm, problem, setting, of, error);
  if (status != KG_OK) {
    return status;
  }
  if (of->gamma > 0.0) {
    gmm->gamma = of->gamma;
    gmm->m = of->m;
  }
  const size_t K = (size_t)gmm->K, D = (size_t)gmm->D;
  const kg_bench_part parts[4] = {{"value", 1, 1},
                                  {"d/d alpha", K, 1},
                                  {"d/d mu", K * D, 1},
                                  {"d/d icf", K * D * (D + 1) / 2, 1}};
  memcpy(problem->parts, parts, sizeof parts);
  problem->part_count = 4;
  problem->items = 1.0;
  problem->data = gmm;
  return KG_OK;
}

static void close(kg_bench_problem *problem)
{
  kg_bench_gmm_destroy(problem->data);
}

static kg_status reference(const void *data, double *answer)
{
  const kg_bench_gmm *gmm = data;
  double *work = malloc(kg_bench_gmm_work(gmm) * sizeof *work);
  if (work) {
    answer[0] = kg_bench_gmm_gradient(gmm, gmm->theta, answer + 1, work);
  }
  free(work);
  return work ? KG_OK : KG_ERR_NO_MEMORY;
}

/* ---- plain C --------------------------------------------------------------------------------- */

typedef struct plain {
  const kg_bench_gmm *gmm;
  double *work;
} plain;

static kg_status create_plain(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  plain *p = malloc(sizeof *p);
  double *work = malloc(kg_bench_gmm_work(data) * sizeof *work);
  if (!p || !work) {
    free(p);
    free(work);
    return KG_ERR_NO_MEMORY;
  }
  *p = (plain){data, work};
  *state = p;
  return KG_OK;
}

static void destroy_plain(void *state)
{
  free(((plain *)state)->work);
  free(state);
}

static kg_status run_value(void *state, double *answer)
{
  const plain *p = state;
  answer[0] = kg_bench_gmm_value(p->gmm, p->gmm->theta, p->work);
  return KG_OK;
}

static kg_status run_value_O2(void *state, double *answer)
{
  const plain *p = state;
  answer[0] = kg_bench_gmm_value_O2(p->gmm, p->gmm->theta, p->work);
  return KG_OK;
}

static kg_status run_gradient(void *state, double *answer)
{
  const plain *p = state;
  answer[0] = kg_bench_gmm_gradient(p->gmm, p->gmm->theta, answer + 1, p->work);
  return KG_OK;
}

/* ---- the cases ------------------------------------------------------------------------------- */

enum { PLAIN, PLAIN_O2, BY_HAND, KINEGRAD, ADOLC_RETAPED, ADOLC_REPLAYED, CONTESTANTS };

static const kg_bench_contestant contestants[CONTESTANTS] = {
  [PLAIN] = {"plain objective, -O3", NULL, VALUE, create_plain, run_value, destroy_plain},
  [PLAIN_O2] = {"plain objective, -O2", NULL, VALUE, create_plain, run_value_O2, destroy_plain},
  [BY_HAND] = {"gradient by hand, -O3", NULL, ALL, create_plain, run_gradient, destroy_plain},
  [KINEGRAD] = {"kinegrad tape", NULL, ALL, kg_bench_gmm_tape, kg_bench_gmm_tape_run,
                kg_bench_gmm_tape_destroy},
  [ADOLC_RETAPED] = ADOLC_CONTESTANT("ADOL-C, retaped", ALL, kg_adolc_gmm_retaped),
  [ADOLC_REPLAYED] = ADOLC_CONTESTANT("ADOL-C, replayed", ALL, kg_adolc_gmm_replayed),
};

/* the plain objective in the faster of its two forms is a bar as well */
#define PAIRS(name, aim)                                                                           \
  static const kg_bench_pair name[] = {{"kinegrad", KINEGRAD, PLAIN, aim},                         \
                                       {"kinegrad", KINEGRAD, PLAIN_O2, aim},                      \
                                       {"by hand", BY_HAND, PLAIN, 0.0},                           \
                                       {"ADOL-C retaped", ADOLC_RETAPED, PLAIN, 0.0},              \
                                       {"ADOL-C replayed", ADOLC_REPLAYED, PLAIN, 0.0},            \
                                       {"kinegrad over ADOL-C", KINEGRAD, ADOLC_REPLAYED, 0.1}}
PAIRS(small, 1.2);
PAIRS(large, 1.5);

static const size sizes[BENCH_GMM_CASES] = {
  {10, 25, 0.0, 0}, {20, 50, 0.0, 0}, {32, 25, 0.0, 0},
  {10, 25, 0.7, 2}, {20, 50, 0.7, 2}, {32, 25, 0.7, 2},
};

/* clang-format off */
#define CASE(i, title, pairs_of, only_checked)                                                     \
  {                                                                                                \
    .name = (title), .unit = "ms", .unit_seconds = 1e-3, .tolerance = 1e-11,                       \
    .is_check_only = (only_checked), .detail = &sizes[i], .open = open, .close = close,            \
    .reference = reference, .contestants = contestants, .contestant_count = CONTESTANTS,           \
    .pairs = pairs_of, .pair_count = KG_COUNT_OF(pairs_of)                                         \
  }
/* clang-format on */

const kg_bench_case kg_bench_gmm_cases[BENCH_GMM_CASES] = {
  CASE(0, "gmm_d10_K25", small, false),
  CASE(1, "gmm_d20_K50", large, false),
  CASE(2, "gmm_d32_K25", large, false),
  CASE(3, "gmm_d10_K25_m2", small, true), /* the files' m = 0, gamma = 1 would hide a wrong prior */
  CASE(4, "gmm_d20_K50_m2", large, true),
  CASE(5, "gmm_d32_K25_m2", large, true),
};
