/* Distances to meshes against all their triangles in double, and their signs against the crossings of
 * a ray: 5 meshes of about 100 000 triangles and one of a million.
 *
 *   mesh_exact [POINTS [POINTS_OF_THE_MILLION [SEED]]]      (100000, 10000, 1)
 *
 * Points: a third near the surface (a tenth of a millimetre to 5 cm), a third anywhere in twice the
 * box, a third on vertices and edges and within 1e-7 m of them. Exit code 1: a distance differs by
 * more than 1e-7 of the diagonal, or a sign of a closed mesh is wrong at a point that is not on the
 * surface. Points with 1e-12 of the diagonal count as on it. Several seeds can run side by side. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "bench/sdf/brute.h"
#include "kinegrad/mesh.h"

static const double DISTANCE_BAR = 1e-7, ON_SURFACE = 1e-12;

typedef struct tally {
  int points, inside, on_surface, signs_wrong;
  double worst; /* |difference| over the diagonal */
} tally;

/* a point on an edge of a random triangle, or its end, moved by at most `offset` along each axis */
static kg_vec3 at_edge(const kg_bench_surface *s, kg_random *random, double offset)
{
  const int t = (int)(kg_random_uniform(random) * s->triangle_count);
  const int k = (int)(3.0 * kg_random_uniform(random));
  const int *v = &s->triangles[3 * (size_t)t];
  const double u = kg_random_uniform(random) < 0.5 ? 0.0 : kg_random_uniform(random);
  const kg_vec3 p = kg_vec3_lerp(s->vertices[v[k]], s->vertices[v[(k + 1) % 3]], u);
  const kg_vec3 d = {2.0 * kg_random_uniform(random) - 1.0, 2.0 * kg_random_uniform(random) - 1.0,
                     2.0 * kg_random_uniform(random) - 1.0};
  return kg_vec3_add_scaled(p, offset, d);
}

static kg_vec3 anywhere(const kg_mesh *mesh, kg_random *random)
{
  kg_vec3 lo, hi;
  kg_mesh_bounds(mesh, &lo, &hi);
  const kg_vec3 size = kg_vec3_sub(hi, lo);
  return kg_vec3_make(lo.x + size.x * (2.0 * kg_random_uniform(random) - 0.5),
                      lo.y + size.y * (2.0 * kg_random_uniform(random) - 0.5),
                      lo.z + size.z * (2.0 * kg_random_uniform(random) - 0.5));
}

static kg_vec3 next_point(const kg_bench_surface *s, const kg_mesh *mesh, const kg_vec3 *near,
                          int i, kg_random *random)
{
  static const double offsets[4] = {0.0, 1e-12, 1e-9, 1e-7};
  switch (i % 3) {
    case 0:
      return near[i / 3];
    case 1:
      return anywhere(mesh, random);
    default:
      return at_edge(s, random, offsets[i / 3 % 4]);
  }
}

static void check(tally *t, const kg_bench_surface *s, const kg_mesh *mesh,
                  const kg_bench_brute *brute, kg_vec3 x)
{
  const double exact = kg_bench_brute_distance(brute, x);
  const double distance = kg_mesh_distance(mesh, x).distance;
  const double difference = fabs(fabs(distance) - exact) / s->diagonal;
  t->worst = difference <= t->worst ? t->worst : difference; /* takes a NaN */
  t->points++;
  t->inside += distance < 0.0;
  if (exact <= ON_SURFACE * s->diagonal) {
    t->on_surface++;
  } else if (s->is_closed) {
    t->signs_wrong += kg_bench_brute_inside(brute, x) != (distance < 0.0);
  }
}

static int run(kg_bench_surface_kind kind, int points, uint64_t seed)
{
  kg_bench_surface s;
  if (kg_bench_surface_make(&s, kind) != KG_OK) return 1;
  kg_mesh *mesh;
  if (kg_mesh_create(&mesh, s.vertices, s.vertex_count, s.triangles, s.triangle_count, NULL, NULL,
                     NULL) != KG_OK) {
    kg_bench_surface_free(&s);
    return 1;
  }
  kg_bench_brute *brute = kg_bench_brute_make(&s);
  kg_vec3 *near = malloc(((size_t)points / 3 + 1) * sizeof *near);
  tally t = {.worst = brute && near ? 0.0 : NAN};
  if (brute && near && kg_bench_points_near(&s, near, points / 3 + 1, 0.05, seed)) {
    kg_random random = kg_random_make(seed + 1000);
    for (int i = 0; i < points; i++) {
      check(&t, &s, mesh, brute, next_point(&s, mesh, near, i, &random));
    }
  }
  printf(
    "%-40s %7d points, %6d inside, %6d on it: largest difference %.1e of the diagonal, %d wrong "
    "signs%s\n",
    s.name, t.points, t.inside, t.on_surface, t.worst, t.signs_wrong,
    s.is_closed ? "" : " (open: not compared)");
  fflush(stdout);
  free(near);
  kg_bench_brute_free(brute);
  kg_mesh_destroy(mesh);
  kg_bench_surface_free(&s);
  return !(t.points == points && t.worst <= DISTANCE_BAR && t.signs_wrong == 0);
}

int main(int argc, char **argv)
{
  const int points = argc > 1 ? atoi(argv[1]) : 100000,
            of_million = argc > 2 ? atoi(argv[2]) : 10000;
  const uint64_t seed = argc > 3 ? (uint64_t)strtoull(argv[3], NULL, 10) : 1;
  if (points < 1 || of_million < 1 || argc > 4) {
    fprintf(stderr, "usage: mesh_exact [POINTS [POINTS_OF_THE_MILLION [SEED]]]\n");
    return 2;
  }
  int failed = 0;
  for (int kind = 0; kind < KG_BENCH_SURFACES; kind++) {
    failed +=
      run((kg_bench_surface_kind)kind, kind == KG_BENCH_MILLION ? of_million : points, seed);
  }
  return failed > 0;
}
