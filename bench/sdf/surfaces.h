/* Triangle meshes and points near them that the suite `sdf` and the tests of distances run on. */
#ifndef BENCH_SDF_SURFACES_H
#define BENCH_SDF_SURFACES_H

#include "kinegrad/base.h"
#include "kinegrad/random.h"
#include "kinegrad/vec3.h"

typedef enum kg_bench_surface_kind {
  KG_BENCH_BLOB,    /* closed, 1.2 m, smooth bumps: 69 620 triangles                       */
  KG_BENCH_TERRAIN, /* open, 10 x 10 m, solid below (y up): 100 352 triangles              */
  KG_BENCH_PLATE,   /* closed, 2 x 2 m, 4 mm thick: 82 940 triangles                       */
  KG_BENCH_SPIKES,  /* closed star of needles, every vertex at a radius of its own: 81 608 */
  KG_BENCH_PART,    /* closed tube, disc and block with slivers of 1 : 20 000: 96 016      */
  KG_BENCH_MILLION, /* the blob with 1 000 000 triangles                                   */
  KG_BENCH_SURFACES
} kg_bench_surface_kind;

typedef struct kg_bench_surface {
  kg_bench_surface_kind kind;
  const char *name;
  int vertex_count, triangle_count;
  kg_vec3 *vertices;
  int *triangles; /* (triangle_count, 3), counter-clockwise from outside */
  bool is_closed;
  double diagonal; /* of the bounding box, m */
} kg_bench_surface;

/* KG_ERR_NO_MEMORY leaves nothing behind. */
kg_status kg_bench_surface_make(kg_bench_surface *s, kg_bench_surface_kind kind);
void kg_bench_surface_free(kg_bench_surface *s);

/* Points on the surface (uniform by area), moved along the face's normal by at most `offset`, either
 * way; those of a terrain stay `offset` away from its border. False: no memory. */
bool kg_bench_points_near(const kg_bench_surface *s, kg_vec3 *points, int count, double offset,
                          uint64_t seed);

/* Soles of two feet, 32 points each on 10 x 26 cm, that slide over a blob or terrain by 2 cm a
 * frame: point k of frame f is points[64 f + k]. */
enum { KG_BENCH_FOOT_POINTS = 64 };
void kg_bench_feet(const kg_bench_surface *s, kg_vec3 *points, int frames);

#endif
