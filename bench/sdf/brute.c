/* Eight triangles at once.
 *
 *   p         x - a
 *   t_e       place of the closest point on an edge, clamped to [0, 1]
 *   distance  least of those to the three edges and, where x projects into the triangle, to its plane
 *
 * The ray r from x crosses a triangle when it passes on the same side of its three edges, that is when
 * the three volumes r . (p_i x p_j) have one sign. Neighbours compute the same number for their common
 * edge up to its sign (no contraction here), so that no crossing is lost or counted twice. */
#include "bench/sdf/brute.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { LANES = 8 };

typedef double lanes __attribute__((vector_size(8 * LANES)));
typedef int64_t mask __attribute__((vector_size(8 * LANES)));

typedef struct vec {
  lanes x, y, z;
} vec;

typedef struct packet {
  vec a, b, c;
  vec n; /* unit, or zero: no area */
} packet;

struct kg_bench_brute {
  size_t count;
  packet *packets;
};

static inline vec sub(vec a, vec b)
{
  return (vec){a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline lanes dot(vec a, vec b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline vec cross(vec a, vec b)
{
  return (vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static inline vec all(kg_vec3 x)
{
  const lanes zero = {0};
  return (vec){zero + x.x, zero + x.y, zero + x.z};
}

static inline lanes choose(mask m, lanes yes, lanes no)
{
  return (lanes)((m & (mask)yes) | (~m & (mask)no));
}

static inline lanes least(lanes a, lanes b)
{
  return choose(a < b, a, b);
}

static void set_corner(vec *v, int lane, kg_vec3 p)
{
  v->x[lane] = p.x;
  v->y[lane] = p.y;
  v->z[lane] = p.z;
}

kg_bench_brute *kg_bench_brute_make(const kg_bench_surface *s)
{
  kg_bench_brute *brute = malloc(sizeof *brute);
  if (!brute) {
    return NULL;
  }
  brute->count = ((size_t)s->triangle_count + LANES - 1) / LANES;
  brute->packets = aligned_alloc(64, brute->count * sizeof *brute->packets);
  if (!brute->packets) {
    free(brute);
    return NULL;
  }
  for (size_t i = 0; i < brute->count * LANES; i++) { /* the last triangle fills up */
    const size_t t = i < (size_t)s->triangle_count ? i : (size_t)s->triangle_count - 1;
    const bool is_extra = i != t;
    const int *v = &s->triangles[3 * t];
    const kg_vec3 a = s->vertices[v[0]], b = s->vertices[v[is_extra ? 0 : 1]];
    const kg_vec3 c = s->vertices[v[is_extra ? 0 : 2]];
    const kg_vec3 n = kg_vec3_normalized(kg_vec3_cross(kg_vec3_sub(b, a), kg_vec3_sub(c, a)));
    packet *at = &brute->packets[i / LANES];
    set_corner(&at->a, (int)(i % LANES), a);
    set_corner(&at->b, (int)(i % LANES), b);
    set_corner(&at->c, (int)(i % LANES), c);
    set_corner(&at->n, (int)(i % LANES), n);
  }
  return brute;
}

void kg_bench_brute_free(kg_bench_brute *brute)
{
  if (brute) {
    free(brute->packets);
    free(brute);
  }
}

/* squared distance of the end of p from the edge e, both from its start; a point when e is zero */
static inline lanes edge_distance2(vec p, vec e)
{
  const lanes zero = {0}, one = zero + 1.0, ee = dot(e, e);
  lanes t = choose(ee > 0.0, dot(p, e) / ee, zero);
  t = choose(t > zero, least(t, one), zero);
  const vec d = {p.x - t * e.x, p.y - t * e.y, p.z - t * e.z};
  return dot(d, d);
}

double kg_bench_brute_distance(const kg_bench_brute *brute, kg_vec3 x)
{
  const vec point = all(x);
  lanes best = (lanes){0} + INFINITY;
  for (size_t i = 0; i < brute->count; i++) {
    const packet *t = &brute->packets[i];
    const vec p = sub(point, t->a), q = sub(point, t->b), r = sub(point, t->c);
    const vec ab = sub(t->b, t->a), bc = sub(t->c, t->b), ca = sub(t->a, t->c);
    const lanes edges =
      least(edge_distance2(p, ab), least(edge_distance2(q, bc), edge_distance2(r, ca)));
    const mask within = (dot(cross(t->n, ab), p) > 0.0) & (dot(cross(t->n, bc), q) > 0.0) &
                        (dot(cross(t->n, ca), r) > 0.0);
    const lanes height = dot(t->n, p);
    best = least(best, choose(within, height * height, edges));
  }
  double distance2 = INFINITY;
  for (int k = 0; k < LANES; k++) {
    distance2 = fmin(distance2, best[k]);
  }
  return sqrt(distance2);
}

bool kg_bench_brute_inside(const kg_bench_brute *brute, kg_vec3 x)
{
  const vec point = all(x), ray = all(kg_vec3_make(0.0123456, 1.0, 0.0314159));
  mask winding = {0};
  for (size_t i = 0; i < brute->count; i++) {
    const packet *t = &brute->packets[i];
    const vec a = sub(t->a, point), b = sub(t->b, point), c = sub(t->c, point);
    const lanes ab = dot(ray, cross(a, b)), bc = dot(ray, cross(b, c)), ca = dot(ray, cross(c, a));
    const mask out = (ab > 0.0) & (bc > 0.0) & (ca > 0.0);
    const mask in = (ab < 0.0) & (bc < 0.0) & (ca < 0.0);
    /* ahead of x: the crossing (bc a + ca b + ab c) / (ab + bc + ca) along the ray */
    const lanes place = bc * dot(ray, a) + ca * dot(ray, b) + ab * dot(ray, c);
    winding -= out & (place > 0.0); /* a true lane is -1 */
    winding += in & (place < 0.0);
  }
  int64_t sum = 0;
  for (int k = 0; k < LANES; k++) {
    sum += winding[k];
  }
  return sum != 0;
}
