/* Points of every kind, one after another. */
#include "bench/sdf/exact.h"

#include "bench/sdf/brute.h"
#include "kinegrad/mesh.h"

#include <math.h>
#include <stdlib.h>

static const double ON_SURFACE = 1e-12;

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

static void check(kg_bench_tally *t, const kg_bench_surface *s, const kg_mesh *mesh,
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

static void check_all(kg_bench_tally *t, const kg_bench_surface *s, const kg_mesh *mesh, int points,
                      uint64_t seed)
{
  const int near_count = points / 3 + 1;
  kg_bench_brute *brute = kg_bench_brute_make(s);
  kg_vec3 *near = malloc((size_t)near_count * sizeof *near);
  if (brute && near && kg_bench_points_near(s, near, near_count, 0.05, seed)) {
    kg_random random = kg_random_make(seed + 1000);
    t->worst = 0.0;
    for (int i = 0; i < points; i++) {
      check(t, s, mesh, brute, next_point(s, mesh, near, i, &random));
    }
  }
  free(near);
  kg_bench_brute_free(brute);
}

void kg_bench_exact(kg_bench_tally *tally, kg_bench_surface_kind kind, int points, uint64_t seed)
{
  *tally = (kg_bench_tally){.worst = NAN};
  kg_bench_surface s;
  if (kg_bench_surface_make(&s, kind) != KG_OK) return;
  tally->name = s.name;
  tally->is_closed = s.is_closed;
  kg_mesh *mesh;
  if (kg_mesh_create(&mesh, s.vertices, s.vertex_count, s.triangles, s.triangle_count, NULL, NULL,
                     NULL) == KG_OK) {
    check_all(tally, &s, mesh, points, seed);
    kg_mesh_destroy(mesh);
  }
  kg_bench_surface_free(&s);
}
