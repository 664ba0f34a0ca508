/* Exact distances to meshes beside Embree's point query and CGAL's AABB tree: one query for each
 * point, in the order given. Embree and CGAL answer without a sign.
 *
 * near       anywhere within 5 cm of the surface
 * coherent   64 points under two feet that move by 2 cm a frame
 *
 * Answers: the distances of every SHARE-th point, signed and not. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench/sdf/brute.h"
#include "bench/sdf/cases.h"
#include "kinegrad/mesh.h"
#include "sdf/kernels/kernels.h"
#include "sdf/topology.h"
#ifdef KG_BENCH_HAS_EMBREE
#include "bench/sdf/embree_peer.h"
#endif
#ifdef KG_BENCH_HAS_CGAL
#include "bench/sdf/cgal_peer.h"
#endif

enum { POINTS = 6400, FRAMES = POINTS / KG_BENCH_FOOT_POINTS, SHARE = 16, BUILD_POINTS = 64 };

/* What is asked: parts of an answer. */
enum { UNSIGNED = 1, SIGNED = 2 };

typedef struct query {
  kg_bench_surface_kind surface;
  bool is_coherent;
  int points, share;
} query;

static const query near_terrain = {KG_BENCH_TERRAIN, false, POINTS, SHARE};
static const query near_blob = {KG_BENCH_BLOB, false, POINTS, SHARE};
static const query coherent_terrain = {KG_BENCH_TERRAIN, true, POINTS, SHARE};
static const query coherent_blob = {KG_BENCH_BLOB, true, POINTS, SHARE};
static const query build_terrain = {KG_BENCH_TERRAIN, false, BUILD_POINTS, 1};
static const query build_blob = {KG_BENCH_BLOB, false, BUILD_POINTS, 1};

typedef struct points {
  const query *of;
  kg_bench_surface surface;
  kg_vec3 *at;
  int compared; /* points that the answer is about */
} points;

/* ---- problems -------------------------------------------------------------------------------- */

static void close(kg_bench_problem *problem)
{
  points *p = problem->data;
  kg_bench_surface_free(&p->surface);
  free(p->at);
  free(p);
}

static bool fill(points *p)
{
  p->at = malloc((size_t)p->of->points * sizeof *p->at);
  if (!p->at) {
    return false;
  }
  if (p->of->is_coherent) {
    kg_bench_feet(&p->surface, p->at, FRAMES);
    return true;
  }
  return kg_bench_points_near(&p->surface, p->at, p->of->points, 0.05, 1);
}

static kg_status open(kg_bench_problem *problem, const kg_bench_setting *setting,
                      const void *detail, kg_error *error)
{
  (void)setting;
  points *p = calloc(1, sizeof *p);
  if (!p) {
    return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "no memory for a mesh");
  }
  p->of = detail;
  problem->data = p;
  if (kg_bench_surface_make(&p->surface, p->of->surface) != KG_OK || !fill(p)) {
    close(problem);
    return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "no memory for a mesh");
  }
  p->compared = p->of->points / p->of->share;
  snprintf(problem->source, sizeof problem->source, "%s; %d points %s", p->surface.name,
           p->of->points, p->of->is_coherent ? "under moving feet" : "within 5 cm");
  problem->items = p->of->points;
  problem->parts[0] = (kg_bench_part){"distance", (size_t)p->compared, 1};
  problem->parts[1] = (kg_bench_part){"signed distance", (size_t)p->compared, 1};
  problem->part_count = 2;
  return KG_OK;
}

/* A run of the cases of building is one mesh. */
static kg_status open_build(kg_bench_problem *problem, const kg_bench_setting *setting,
                            const void *detail, kg_error *error)
{
  const kg_status status = open(problem, setting, detail, error);
  if (status == KG_OK) {
    const points *p = problem->data;
    snprintf(problem->source, sizeof problem->source, "%s", p->surface.name);
    problem->items = 1.0;
  }
  return status;
}

static void put(const points *p, double *answer, int i, double distance)
{
  if (i % p->of->share == 0) {
    answer[i / p->of->share] = fabs(distance);
    answer[p->compared + i / p->of->share] = distance;
  }
}

static void put_unsigned(const points *p, double *answer, int i, double distance)
{
  if (i % p->of->share == 0) {
    answer[i / p->of->share] = distance;
  }
}

static kg_status reference(const void *data, double *answer)
{
  const points *p = data;
  kg_bench_brute *brute = kg_bench_brute_make(&p->surface);
  if (!brute) {
    return KG_ERR_NO_MEMORY;
  }
  for (int i = 0; i < p->of->points; i += p->of->share) {
    const double distance = kg_bench_brute_distance(brute, p->at[i]);
    put(p, answer, i, kg_bench_brute_inside(brute, p->at[i]) ? -distance : distance);
  }
  kg_bench_brute_free(brute);
  return KG_OK;
}

/* ---- kinegrad -------------------------------------------------------------------------------- */

typedef struct ours {
  const points *of;
  const kg_allocator *allocator;
  kg_mesh *mesh;
} ours;

static void destroy(void *state)
{
  ours *s = state;
  kg_mesh_destroy(s->mesh);
  free(s);
}

static kg_status create_empty(void **state, const void *data, const kg_allocator *allocator)
{
  ours *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  *s = (ours){.of = data, .allocator = allocator};
  *state = s;
  return KG_OK;
}

static kg_status build(ours *s)
{
  const kg_bench_surface *of = &s->of->surface;
  kg_mesh_destroy(s->mesh);
  return kg_mesh_create(&s->mesh, of->vertices, of->vertex_count, of->triangles, of->triangle_count,
                        NULL, s->allocator, NULL);
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  const kg_status status = create_empty(state, data, allocator);
  return status == KG_OK ? build(*state) : status;
}

static kg_status run(void *state, double *answer)
{
  ours *s = state;
  for (int i = 0; i < s->of->of->points; i++) {
    put(s->of, answer, i, kg_mesh_distance(s->mesh, s->of->at[i]).distance);
  }
  return KG_OK;
}

/* Each point of the feet begins where it was a frame before. */
static kg_status run_hints(void *state, double *answer)
{
  ours *s = state;
  kg_mesh_hint hints[KG_BENCH_FOOT_POINTS];
  for (int k = 0; k < KG_BENCH_FOOT_POINTS; k++) {
    hints[k].triangle = -1;
  }
  for (int i = 0; i < s->of->of->points; i++) {
    kg_mesh_hint *hint = &hints[i % KG_BENCH_FOOT_POINTS];
    put(s->of, answer, i, kg_mesh_distance_from(s->mesh, s->of->at[i], hint).distance);
  }
  return KG_OK;
}

static kg_status run_many(void *state, double *answer)
{
  ours *s = state;
  kg_sdf_value values[KG_BENCH_FOOT_POINTS];
  for (int i = 0; i < s->of->of->points; i += KG_BENCH_FOOT_POINTS) {
    kg_mesh_distance_many(s->mesh, KG_BENCH_FOOT_POINTS, &s->of->at[i], NULL, values);
    for (int k = 0; k < KG_BENCH_FOOT_POINTS; k++) {
      put(s->of, answer, i + k, values[k].distance);
    }
  }
  return KG_OK;
}

static kg_status run_build(void *state, double *answer)
{
  const kg_status status = build(state);
  return status == KG_OK ? run(state, answer) : status;
}

/* ---- the hierarchy alone --------------------------------------------------------------------- */

/* As much as Embree builds: no vertices are merged, no edges found, no pseudo-normals made. */
typedef struct hierarchy {
  const points *of;
  const kg_allocator *allocator;
  kg_arena kept, scratch;
  topology topo;
} hierarchy;

static void destroy_hierarchy(void *state)
{
  hierarchy *s = state;
  kg_arena_release(&s->kept);
  kg_arena_release(&s->scratch);
  free(s);
}

static kg_status create_hierarchy(void **state, const void *data, const kg_allocator *allocator)
{
  hierarchy *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  s->allocator = allocator;
  kg_arena_init(&s->kept, allocator);
  kg_arena_init(&s->scratch, allocator);
  const kg_bench_surface *of = &s->of->surface;
  kg_mesh_report report;
  const kg_status status = topology_build(&s->topo, of->vertices, of->vertex_count, of->triangles,
                                          of->triangle_count, &report, &s->kept, &s->scratch, NULL);
  if (status != KG_OK) {
    destroy_hierarchy(s);
    return status;
  }
  *state = s;
  return KG_OK;
}

static kg_status run_hierarchy(void *state, double *answer)
{
  hierarchy *s = state;
  const topology *topo = &s->topo;
  const bvh_input input = {.vertices = topo->vertices,
                           .corner = (const int(*)[3])topo->corner,
                           .normal = topo->normal,
                           .count = topo->face_count,
                           .lo = topo->lo,
                           .hi = topo->hi};
  kg_arena arena, scratch;
  kg_arena_init(&arena, s->allocator);
  kg_arena_init(&scratch, s->allocator);
  bvh tree;
  const bool is_built = bvh_build(&tree, &input, &arena, &scratch);
  for (int i = 0; i < s->of->of->points && is_built; i++) {
    bvh_best best = {INFINITY, -1};
    kg_sdf_kernels_best()->search(&tree, s->of->at[i], -1, false, &best);
    put_unsigned(s->of, answer, i, sqrt(best.distance2));
  }
  kg_arena_release(&scratch);
  kg_arena_release(&arena);
  return is_built ? KG_OK : KG_ERR_NO_MEMORY;
}

/* ---- Embree ---------------------------------------------------------------------------------- */

#ifdef KG_BENCH_HAS_EMBREE
typedef struct embree {
  const points *of;
  kg_embree *embree;
  int hints[KG_BENCH_FOOT_POINTS];
} embree;

static void destroy_embree(void *state)
{
  embree *s = state;
  kg_embree_close(s->embree);
  free(s);
}

static kg_status create_empty_embree(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  embree *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  const kg_status status = kg_embree_open(&s->embree, &s->of->surface);
  if (status != KG_OK) {
    free(s);
    return status;
  }
  *state = s;
  return KG_OK;
}

static kg_status create_embree(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_empty_embree(state, data, allocator);
  if (status == KG_OK) {
    status = kg_embree_build(((embree *)*state)->embree);
    if (status != KG_OK) {
      destroy_embree(*state);
    }
  }
  return status;
}

static kg_status run_embree(void *state, double *answer)
{
  embree *s = state;
  for (int i = 0; i < s->of->of->points; i++) {
    put_unsigned(s->of, answer, i, kg_embree_distance(s->embree, s->of->at[i], NULL));
  }
  return KG_OK;
}

/* The last frame's triangle gives the first radius. */
static kg_status run_embree_hints(void *state, double *answer)
{
  embree *s = state;
  for (int k = 0; k < KG_BENCH_FOOT_POINTS; k++) {
    s->hints[k] = -1;
  }
  for (int i = 0; i < s->of->of->points; i++) {
    int *hint = &s->hints[i % KG_BENCH_FOOT_POINTS];
    put_unsigned(s->of, answer, i, kg_embree_distance(s->embree, s->of->at[i], hint));
  }
  return KG_OK;
}

static kg_status run_embree_build(void *state, double *answer)
{
  embree *s = state;
  const kg_status status = kg_embree_build(s->embree);
  return status == KG_OK ? run_embree(state, answer) : status;
}

#define EMBREE_CONTESTANT(title, create_function, run_function)                                    \
  {                                                                                                \
    .name = (title), .parts = UNSIGNED, .create = (create_function), .run = (run_function),        \
    .destroy = destroy_embree                                                                      \
  }
#else
#define EMBREE_CONTESTANT(title, create_function, run_function)                                    \
  ABSENT_CONTESTANT(title, "Embree", UNSIGNED)
#endif

/* ---- CGAL ------------------------------------------------------------------------------------ */

#ifdef KG_BENCH_HAS_CGAL
typedef struct cgal {
  const points *of;
  kg_cgal *cgal;
} cgal;

static void destroy_cgal(void *state)
{
  cgal *s = state;
  kg_cgal_close(s->cgal);
  free(s);
}

static kg_status create_empty_cgal(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  cgal *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  const kg_status status = kg_cgal_open(&s->cgal, &s->of->surface);
  if (status != KG_OK) {
    free(s);
    return status;
  }
  *state = s;
  return KG_OK;
}

static kg_status create_cgal(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_empty_cgal(state, data, allocator);
  if (status == KG_OK) {
    status = kg_cgal_build(((cgal *)*state)->cgal);
    if (status != KG_OK) {
      destroy_cgal(*state);
    }
  }
  return status;
}

static kg_status run_cgal(void *state, double *answer)
{
  cgal *s = state;
  for (int i = 0; i < s->of->of->points; i++) {
    put_unsigned(s->of, answer, i, kg_cgal_distance(s->cgal, s->of->at[i]));
  }
  return KG_OK;
}

static kg_status run_cgal_build(void *state, double *answer)
{
  cgal *s = state;
  const kg_status status = kg_cgal_build(s->cgal);
  return status == KG_OK ? run_cgal(state, answer) : status;
}

#define CGAL_CONTESTANT(title, create_function, run_function)                                      \
  {                                                                                                \
    .name = (title), .parts = UNSIGNED, .create = (create_function), .run = (run_function),        \
    .destroy = destroy_cgal                                                                        \
  }
#else
#define CGAL_CONTESTANT(title, create_function, run_function)                                      \
  ABSENT_CONTESTANT(title, "CGAL", UNSIGNED)
#endif

/* ---- the cases ------------------------------------------------------------------------------- */

static const kg_bench_contestant near_contestants[] = {
  {"kinegrad", NULL, UNSIGNED | SIGNED, create, run, destroy},
  EMBREE_CONTESTANT("Embree", create_embree, run_embree),
  CGAL_CONTESTANT("CGAL", create_cgal, run_cgal),
};
static const kg_bench_pair near_pairs[] = {{"kinegrad", 0, 1, 0.8}, {"kinegrad", 0, 2, 0.0}};

enum { COLD, HINTS, MANY, EMBREE, EMBREE_HINTS, CGAL, COHERENT_CONTESTANTS };

static const kg_bench_contestant coherent_contestants[COHERENT_CONTESTANTS] = {
  [COLD] = {"kinegrad", NULL, UNSIGNED | SIGNED, create, run, destroy},
  [HINTS] = {"kinegrad, hints", NULL, UNSIGNED | SIGNED, create, run_hints, destroy},
  [MANY] = {"kinegrad, a frame a call", NULL, UNSIGNED | SIGNED, create, run_many, destroy},
  [EMBREE] = EMBREE_CONTESTANT("Embree", create_embree, run_embree),
  [EMBREE_HINTS] = EMBREE_CONTESTANT("Embree, last triangle", create_embree, run_embree_hints),
  [CGAL] = CGAL_CONTESTANT("CGAL", create_cgal, run_cgal),
};
static const kg_bench_pair coherent_pairs[] = {
  {"kinegrad hints", HINTS, EMBREE, 0.5}, {"kinegrad", COLD, EMBREE, 0.0},
  {"a frame a call", MANY, EMBREE, 0.0},  {"hints against last triangle", HINTS, EMBREE_HINTS, 0.0},
  {"kinegrad hints", HINTS, CGAL, 0.0},
};

enum { WHOLE, HIERARCHY, BUILD_EMBREE, BUILD_CGAL, BUILD_CONTESTANTS };

static const kg_bench_contestant build_contestants[BUILD_CONTESTANTS] = {
  [WHOLE] = {"kinegrad, with topology", NULL, UNSIGNED | SIGNED, create_empty, run_build, destroy},
  [HIERARCHY] = {"kinegrad, hierarchy alone", NULL, UNSIGNED, create_hierarchy, run_hierarchy,
                 destroy_hierarchy},
  [BUILD_EMBREE] =
    EMBREE_CONTESTANT("Embree, medium quality", create_empty_embree, run_embree_build),
  [BUILD_CGAL] = CGAL_CONTESTANT("CGAL", create_empty_cgal, run_cgal_build),
};
static const kg_bench_pair build_pairs[] = {
  {"kinegrad", WHOLE, BUILD_EMBREE, 1.0},
  {"hierarchy", HIERARCHY, BUILD_EMBREE, 1.0},
  {"kinegrad", WHOLE, BUILD_CGAL, 0.0},
};

/* Embree rounds coordinates of 10 m to floats: 5e-7 m of 5 cm. */
/* clang-format off */
#define CASE(title, of, open_function, time_unit, seconds, table, ratios)                          \
  {                                                                                                \
    .name = (title), .unit = (time_unit), .unit_seconds = (seconds), .tolerance = 5e-5,            \
    .detail = (of), .open = (open_function), .close = close, .reference = reference,               \
    .contestants = (table), .contestant_count = KG_COUNT_OF(table), .pairs = (ratios),             \
    .pair_count = KG_COUNT_OF(ratios)                                                              \
  }
/* clang-format on */

const kg_bench_case kg_bench_mesh_cases[BENCH_MESH_CASES] = {
  CASE("near_terrain", &near_terrain, open, "us", 1e-6, near_contestants, near_pairs),
  CASE("near_blob", &near_blob, open, "us", 1e-6, near_contestants, near_pairs),
  CASE("coherent_terrain", &coherent_terrain, open, "us", 1e-6, coherent_contestants,
       coherent_pairs),
  CASE("coherent_blob", &coherent_blob, open, "us", 1e-6, coherent_contestants, coherent_pairs),
  CASE("build_terrain", &build_terrain, open_build, "ms", 1e-3, build_contestants, build_pairs),
  CASE("build_blob", &build_blob, open_build, "ms", 1e-3, build_contestants, build_pairs),
};
