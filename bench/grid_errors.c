/* How far grids of 128 nodes along a side are off: kinegrad's beside OpenVDB's of the same spacing, at
 * 100 000 points within 5 cm and within two voxels of the surface of the blob. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "bench/sdf/surfaces.h"
#include "kinegrad/grid.h"
#ifdef KG_BENCH_HAS_OPENVDB
#include "bench/sdf/openvdb_peer.h"
#endif

enum { POINTS = 100000, NODES = 128 };

static kg_vec3 at[POINTS], gradient[POINTS];
static double exact[POINTS], distance[POINTS];

static void print_errors(const char *name, double band)
{
  double sum = 0.0, most = 0.0;
  for (int i = 0; i < POINTS; i++) {
    const double error = fabs(distance[i] - exact[i]);
    sum += error * error;
    most = fmax(most, error);
  }
  printf("%-28s within %4.1f mm   rms %.4f mm   max %.3f mm\n", name, 1e3 * band,
         1e3 * sqrt(sum / POINTS), 1e3 * most);
}

static void compare(const kg_bench_surface *s, const kg_mesh *mesh, const kg_grid *grid,
                    double band, double spacing)
{
  if (!kg_bench_points_near(s, at, POINTS, band, 1)) {
    return;
  }
  for (int i = 0; i < POINTS; i++) {
    exact[i] = kg_mesh_distance(mesh, at[i]).distance;
  }
  kg_grid_distance_many(grid, POINTS, at, distance, gradient);
  print_errors("kinegrad, C1", band);
#ifdef KG_BENCH_HAS_OPENVDB
  kg_openvdb *vdb;
  if (kg_openvdb_open(&vdb, s, spacing) == KG_OK) {
    if (kg_openvdb_build(vdb, ceil(band / spacing) + 2.0) == KG_OK) {
      kg_openvdb_distances(vdb, POINTS, at, distance);
      print_errors("OpenVDB, trilinear", band);
    }
    kg_openvdb_close(vdb);
  }
#else
  (void)spacing;
#endif
}

int main(void)
{
  kg_bench_surface s;
  kg_mesh *mesh = NULL;
  kg_grid *grid = NULL;
  if (kg_bench_surface_make(&s, KG_BENCH_BLOB) != KG_OK) {
    return 1;
  }
  int code = 1;
  if (kg_mesh_create(&mesh, s.vertices, s.vertex_count, s.triangles, s.triangle_count, NULL, NULL,
                     NULL) == KG_OK) {
    const kg_grid_def def = kg_grid_mesh_def(mesh, NODES);
    if (kg_grid_create(&grid, &def, NULL) == KG_OK) {
      compare(&s, mesh, grid, 0.05, def.spacing);
      compare(&s, mesh, grid, 2.0 * def.spacing, def.spacing);
      code = 0;
    }
  }
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
  kg_bench_surface_free(&s);
  return code;
}
