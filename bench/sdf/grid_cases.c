/* Grids of the blob, 128 nodes along its longest side, beside OpenVDB's of the same spacing: building,
 * and 64 000 points within two voxels of the surface. OpenVDB answers with a distance, kinegrad with
 * a distance and a gradient.
 *
 * Answers: the distances of every SHARE-th point against those to all triangles; how far grids are
 * off is what bench/grid_errors prints. Every contestant uses one thread. Both build a band: kinegrad
 * the blocks that reach within two spacings of the surface, OpenVDB the three voxels on both sides of it
 * that it is made for. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "bench/sdf/brute.h"
#include "bench/sdf/cases.h"
#include "kinegrad/grid.h"
#ifdef KG_BENCH_HAS_OPENVDB
#include "bench/sdf/openvdb_peer.h"
#endif

enum { POINTS = 64000, SHARE = 640, COMPARED = POINTS / SHARE, NODES = 128 };

/* A grid is off by some mm near creases; the largest distance is two voxels, 20 mm. */
#define TOLERANCE 0.2

typedef struct cloud {
  kg_bench_surface surface;
  kg_mesh *mesh;
  kg_grid_def def;
  kg_vec3 *at, *gradient;
  double *distance;
} cloud;

static void close_cloud(kg_bench_problem *problem)
{
  cloud *c = problem->data;
  kg_mesh_destroy(c->mesh);
  kg_bench_surface_free(&c->surface);
  free(c->at);
  free(c->gradient);
  free(c->distance);
  free(c);
}

static bool fill(cloud *c)
{
  const kg_bench_surface *s = &c->surface;
  c->at = malloc(POINTS * sizeof *c->at);
  c->gradient = malloc(POINTS * sizeof *c->gradient);
  c->distance = malloc(POINTS * sizeof *c->distance);
  if (!c->at || !c->gradient || !c->distance ||
      kg_mesh_create(&c->mesh, s->vertices, s->vertex_count, s->triangles, s->triangle_count, NULL,
                     NULL, NULL) != KG_OK) {
    return false;
  }
  c->def = kg_grid_mesh_def(c->mesh, NODES);
  return kg_bench_points_near(s, c->at, POINTS, 2.0 * c->def.spacing, 1);
}

static kg_status open_cloud(kg_bench_problem *problem, const kg_bench_setting *setting,
                            const void *detail, kg_error *error)
{
  (void)setting;
  const bool is_build = *(const bool *)detail;
  cloud *c = calloc(1, sizeof *c);
  problem->data = c;
  if (!c || kg_bench_surface_make(&c->surface, KG_BENCH_BLOB) != KG_OK || !fill(c)) {
    if (c) {
      close_cloud(problem);
    }
    return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "no memory for a grid");
  }
  snprintf(problem->source, sizeof problem->source, "%s; %d nodes along a side; %d points near",
           c->surface.name, NODES, POINTS);
  problem->items = is_build ? 1.0 : POINTS;
  problem->parts[0] = (kg_bench_part){"distance", COMPARED, 1};
  problem->part_count = 1;
  return KG_OK;
}

static kg_status reference(const void *data, double *answer)
{
  const cloud *c = data;
  kg_bench_brute *brute = kg_bench_brute_make(&c->surface);
  if (!brute) {
    return KG_ERR_NO_MEMORY;
  }
  for (int i = 0; i < COMPARED; i++) {
    const kg_vec3 x = c->at[SHARE * i];
    const double distance = kg_bench_brute_distance(brute, x);
    answer[i] = kg_bench_brute_inside(brute, x) ? -distance : distance;
  }
  kg_bench_brute_free(brute);
  return KG_OK;
}

static void pick(const cloud *c, double *answer)
{
  for (int i = 0; i < COMPARED; i++) {
    answer[i] = c->distance[SHARE * i];
  }
}

/* ---- kinegrad -------------------------------------------------------------------------------- */

typedef struct ours {
  const cloud *of;
  kg_grid_def def;
  kg_grid *grid;
} ours;

static kg_status create_empty(void **state, const void *data, const kg_allocator *allocator)
{
  ours *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  s->def = s->of->def;
  s->def.allocator = allocator;
  *state = s;
  return KG_OK;
}

static kg_status build(ours *s)
{
  kg_grid_destroy(s->grid);
  return kg_grid_create(&s->grid, &s->def, NULL);
}

static kg_status create(void **state, const void *data, const kg_allocator *allocator)
{
  const kg_status status = create_empty(state, data, allocator);
  return status == KG_OK ? build(*state) : status;
}

static kg_status run(void *state, double *answer)
{
  ours *s = state;
  kg_grid_distance_many(s->grid, POINTS, s->of->at, s->of->distance, s->of->gradient);
  pick(s->of, answer);
  return KG_OK;
}

static kg_status run_build(void *state, double *answer)
{
  const kg_status status = build(state);
  return status == KG_OK ? run(state, answer) : status;
}

static void destroy(void *state)
{
  ours *s = state;
  kg_grid_destroy(s->grid);
  free(s);
}

/* ---- OpenVDB --------------------------------------------------------------------------------- */

#ifdef KG_BENCH_HAS_OPENVDB
typedef struct openvdb {
  const cloud *of;
  kg_openvdb *vdb;
} openvdb;

static void destroy_vdb(void *state)
{
  openvdb *s = state;
  kg_openvdb_close(s->vdb);
  free(s);
}

static kg_status create_empty_vdb(void **state, const void *data, const kg_allocator *allocator)
{
  (void)allocator;
  openvdb *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  s->of = data;
  const kg_status status = kg_openvdb_open(&s->vdb, &s->of->surface, s->of->def.spacing);
  if (status != KG_OK) {
    free(s);
    return status;
  }
  *state = s;
  return KG_OK;
}

static kg_status create_vdb(void **state, const void *data, const kg_allocator *allocator)
{
  kg_status status = create_empty_vdb(state, data, allocator);
  if (status == KG_OK) {
    status = kg_openvdb_build(((openvdb *)*state)->vdb, 3.0);
    if (status != KG_OK) {
      destroy_vdb(*state);
    }
  }
  return status;
}

static kg_status run_vdb(void *state, double *answer)
{
  openvdb *s = state;
  kg_openvdb_distances(s->vdb, POINTS, s->of->at, s->of->distance);
  pick(s->of, answer);
  return KG_OK;
}

static kg_status run_band(void *state, double *answer)
{
  const kg_status status = kg_openvdb_build(((openvdb *)state)->vdb, 3.0);
  return status == KG_OK ? run_vdb(state, answer) : status;
}

#define VDB_CONTESTANT(title, create_function, run_function)                                       \
  {                                                                                                \
    .name = (title), .parts = 1, .create = (create_function), .run = (run_function),               \
    .destroy = destroy_vdb                                                                         \
  }
#else
#define VDB_CONTESTANT(title, create_function, run_function) ABSENT_CONTESTANT(title, "OpenVDB", 1)
#endif

/* ---- the cases ------------------------------------------------------------------------------- */

static const kg_bench_contestant build_contestants[] = {
  {"kinegrad, 2 spacings around", NULL, 1, create_empty, run_build, destroy},
  VDB_CONTESTANT("OpenVDB, 3 voxels around", create_empty_vdb, run_band),
};
static const kg_bench_pair build_pairs[] = {{"kinegrad", 0, 1, 1.0}};

static const kg_bench_contestant query_contestants[] = {
  {"kinegrad, C1 and gradient", NULL, 1, create, run, destroy},
  VDB_CONTESTANT("OpenVDB, trilinear value", create_vdb, run_vdb),
};
static const kg_bench_pair query_pairs[] = {{"kinegrad", 0, 1, 1.0}};

static const bool is_build = true, is_query = false;

const kg_bench_case kg_bench_grid_cases[BENCH_GRID_CASES] = {
  {.name = "grid_build_blob",
   .unit = "ms",
   .unit_seconds = 1e-3,
   .tolerance = TOLERANCE,
   .detail = &is_build,
   .open = open_cloud,
   .close = close_cloud,
   .reference = reference,
   .contestants = build_contestants,
   .contestant_count = KG_COUNT_OF(build_contestants),
   .pairs = build_pairs,
   .pair_count = KG_COUNT_OF(build_pairs)},
  {.name = "grid_query_blob",
   .unit = "ns",
   .unit_seconds = 1e-9,
   .tolerance = TOLERANCE,
   .detail = &is_query,
   .open = open_cloud,
   .close = close_cloud,
   .reference = reference,
   .contestants = query_contestants,
   .contestant_count = KG_COUNT_OF(query_contestants),
   .pairs = query_pairs,
   .pair_count = KG_COUNT_OF(query_pairs)},
};
