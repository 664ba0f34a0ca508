/* kinegrad/grid.h - a signed distance field sampled on a grid: to cull, to draw, to look up often.
 *
 * Nodes near to the surface hold value and gradient of the field, floats; between them a C1 interpolant
 * with its exact gradient. They come in blocks of 4 x 4 x 4 cells: every point of the box within two
 * spacings of the surface is in a block with nodes. The interpolant is that of the nodes rounded to 16
 * bits: values to 1.4e-4 of the spacing, gradients to 1.6e-5. Bounds and files have the nodes themselves.
 * The other blocks hold the field at their center,
 * which is enough for bounds; there, as outside of the box, distances are asked of the source. A grid is never the last word on contact: its error near the surface is about a
 * hundredth of the spacing on smooth parts and grows to a third of it at sharp edges. Ask
 * kg_grid_lower_bound or kg_grid_distance_within, which are certain, and the field itself where it
 * matters. Theory and figures: docs/theory/sdf.md, docs/design/008-grid.md. */
#ifndef KINEGRAD_GRID_H
#define KINEGRAD_GRID_H

#include "kinegrad/base.h"
#include "kinegrad/mesh.h"
#include "kinegrad/sdf_value.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_grid kg_grid;

/* What a grid samples (fields from several threads at once when it is built with more than one), and
 * asks outside of its box and in blocks without nodes: a mesh, or a field with its user pointer. Borrowed:
 * must outlive the grid. */
typedef struct kg_grid_source {
  const kg_mesh *mesh;
  kg_sdf_fn *field;
  void *user;
} kg_grid_source;

typedef struct kg_grid_def {
  kg_grid_source source;
  kg_vec3 lo,
    hi; /* box to cover, m: nodes at lo + spacing (i, j, k), up to hi or just beyond      */
  double
    spacing;   /* m                                                                              */
  int threads; /* default 1, at most 64; the result does not depend on it                        */
  const kg_allocator
    *allocator; /* NULL: malloc and free                                           */
} kg_grid_def;

/* Box of the mesh and a twentieth of its longest side around it, `nodes` (two or more) along that
 * side. */
KG_API kg_grid_def kg_grid_mesh_def(const kg_mesh *mesh, int nodes);
/* spacing of `nodes` along the longest side of the box. */
KG_API kg_grid_def kg_grid_field_def(kg_sdf_fn *field, void *user, kg_vec3 lo, kg_vec3 hi,
                                     int nodes);

/* 3 KB a block near to the surface, 20 bytes every other; while building from a mesh 150 a triangle.
 * Of a mesh every value is the distance to a triangle that is the nearest one but for 1e-6 of
 * the box's diagonal, in double; of a field what it returns.
 * KG_ERR_UNDEFINED: the field is not finite at a node or center. KG_ERR_UNSUPPORTED: n of
 * kg_grid_info would multiply to 2^31 or more. */
KG_API KG_MUST_USE kg_status kg_grid_create(kg_grid **grid, const kg_grid_def *def,
                                            kg_error *error);
KG_API void kg_grid_destroy(kg_grid *grid);

typedef struct kg_grid_info {
  kg_vec3 lo, hi; /* of the nodes, m */
  double spacing;
  int n[3]; /* nodes along x, y, z                                                             */
  double
    slack; /* m: what rounding can add to the values that are held; part of every bound       */
} kg_grid_info;

KG_API kg_grid_info kg_grid_describe(const kg_grid *grid);

/* ---- queries: allocate nothing, any number of threads at once --------------------------------- */

typedef struct kg_grid_value {
  double distance;  /* m                                                                 */
  kg_vec3 gradient; /* of the interpolant, not quite a unit vector                       */
  double error;     /* m: |distance - Phi(x)| is not larger; of the order of the spacing */
  bool is_exact;    /* asked of the source                                               */
} kg_grid_value;

/* Outside of the box and in blocks without nodes the source is asked; where they meet blocks with nodes
 * the distance jumps by the interpolant's error. A grid that was loaded without source answers in such a
 * block by the plane through its center, outside of the box with the value at the nearest point of the
 * box plus the way to it, and says so in `error`.
 * `error` is from what is known of the eight nodes around x, or the center: docs/theory/sdf.md. */
KG_API kg_grid_value kg_grid_distance(const kg_grid *grid, kg_vec3 x);
/* distance[i] and gradient[i] at x[i], i < count, without bounds of the error. */
KG_API void kg_grid_distance_many(const kg_grid *grid, int count, const kg_vec3 *x,
                                  double *distance, kg_vec3 *gradient);

/* |Phi(x)| is at least this: the nearest node's or center's value less the way to it; 0 when that says nothing.
 * Everywhere, with or without a source. */
KG_API double kg_grid_lower_bound(const kg_grid *grid, kg_vec3 x);
/* False when |Phi(x)| >= limit, which the grid often shows without asking the source; else true and
 * the source's value. Needs a source. */
KG_API bool kg_grid_distance_within(const kg_grid *grid, kg_vec3 x, double limit,
                                    kg_sdf_value *value);

/* ---- files: docs/formats/grid.md ---------------------------------------------------------------- */

/* KG_ERR_WRITE. An existing file is replaced only when the new one is complete. */
KG_API KG_MUST_USE kg_status kg_grid_save(const kg_grid *grid, const char *path, kg_error *error);
/* source: what to ask where the grid does not know, NULL for nothing; compared with the file at some
 * centers and nodes.
 * KG_ERR_READ: no such file. KG_ERR_FORMAT: not such a file, damaged, not a distance field, or not of
 * this source; the byte is in the text. KG_ERR_UNSUPPORTED: another version. */
KG_API KG_MUST_USE kg_status kg_grid_load(kg_grid **grid, const char *path,
                                          const kg_grid_source *source,
                                          const kg_allocator *allocator, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
