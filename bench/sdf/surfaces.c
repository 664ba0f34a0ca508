/* Generators of the meshes. */
#include "bench/sdf/surfaces.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double PI = 3.14159265358979323846;

static const char *const NAMES[KG_BENCH_SURFACES] = {
  "blob, 69 620 triangles, 1.2 m",       "terrain, 100 352 triangles, 10 x 10 m",
  "plate, 82 940 triangles, 2 m x 4 mm", "spikes, 81 608 triangles",
  "part, 96 016 triangles with slivers", "blob, 1 000 000 triangles, 1.2 m"};

/* Arrays that were made large enough for what is added. */
static int add_vertex(kg_bench_surface *s, double x, double y, double z)
{
  s->vertices[s->vertex_count] = kg_vec3_make(x, y, z);
  return s->vertex_count++;
}

static void add_triangle(kg_bench_surface *s, int a, int b, int c)
{
  int *t = &s->triangles[3 * (size_t)s->triangle_count++];
  t[0] = a;
  t[1] = b;
  t[2] = c;
}

static void add_quad(kg_bench_surface *s, int a, int b, int c, int d)
{
  add_triangle(s, a, b, c);
  add_triangle(s, a, c, d);
}

static kg_status reserve(kg_bench_surface *s, size_t vertices, size_t triangles)
{
  s->vertices = malloc(vertices * sizeof *s->vertices);
  s->triangles = malloc(3 * triangles * sizeof *s->triangles);
  if (s->vertices && s->triangles) {
    return KG_OK;
  }
  kg_bench_surface_free(s);
  return KG_ERR_NO_MEMORY;
}

/* ---- blob ------------------------------------------------------------------------------------ */

/* radius of the blob in a unit direction */
static double blob_radius(kg_vec3 d)
{
  return 0.52 + 0.05 * sin(5.0 * d.x + 1.0) * sin(4.0 * d.y) + 0.04 * cos(7.0 * d.z + 2.0 * d.x) +
         0.01 * sin(19.0 * d.y) * sin(17.0 * d.x + 1.0) * sin(23.0 * d.z);
}

static kg_vec3 direction(double polar, double turn)
{
  return kg_vec3_make(sin(polar) * cos(turn), cos(polar), sin(polar) * sin(turn));
}

/* rings of `columns` vertices between two poles */
static kg_status make_blob(kg_bench_surface *s, int columns, int rings)
{
  const size_t n = (size_t)columns * (size_t)rings;
  const kg_status status = reserve(s, n + 2, 2 * n);
  if (status != KG_OK) {
    return status;
  }
  for (int i = 0; i < rings; i++) {
    for (int k = 0; k < columns; k++) {
      const kg_vec3 d = direction(PI * (i + 1) / (rings + 1), 2.0 * PI * k / columns);
      const double r = blob_radius(d);
      add_vertex(s, r * d.x, r * d.y, r * d.z);
    }
  }
  const int top = add_vertex(s, 0.0, blob_radius(direction(0.0, 0.0)), 0.0);
  const int bottom = add_vertex(s, 0.0, -blob_radius(direction(PI, 0.0)), 0.0);
  for (int k = 0; k < columns; k++) {
    const int next = (k + 1) % columns, last = (rings - 1) * columns;
    add_triangle(s, top, next, k);
    for (int i = 0; i + 1 < rings; i++) {
      const int a = i * columns, b = a + columns;
      add_quad(s, a + k, a + next, b + next, b + k);
    }
    add_triangle(s, bottom, last + k, last + next);
  }
  return KG_OK;
}

/* ---- terrain --------------------------------------------------------------------------------- */

static double terrain_height(double x, double z)
{
  return 0.4 * sin(0.9 * x) * cos(0.7 * z) + 0.12 * sin(3.1 * x + 1.7 * z) +
         0.03 * sin(11.0 * x) * sin(9.0 * z) + 0.01 * sin(37.0 * x + 29.0 * z);
}

static kg_status make_terrain(kg_bench_surface *s)
{
  enum { N = 224 };
  const kg_status status = reserve(s, (N + 1) * (N + 1), 2 * N * N);
  if (status != KG_OK) {
    return status;
  }
  for (int i = 0; i <= N; i++) {
    for (int k = 0; k <= N; k++) {
      const double x = 10.0 * k / N - 5.0, z = 10.0 * i / N - 5.0;
      add_vertex(s, x, terrain_height(x, z), z);
    }
  }
  for (int i = 0; i < N; i++) {
    for (int k = 0; k < N; k++) {
      const int a = i * (N + 1) + k;
      add_quad(s, a, a + N + 1, a + N + 2, a + 1);
    }
  }
  return KG_OK;
}

/* ---- plate ----------------------------------------------------------------------------------- */

static kg_status make_plate(kg_bench_surface *s)
{
  enum { N = 143, ROW = N + 1 };
  const double half = 1.0, thick = 0.002;
  const kg_status status = reserve(s, 2 * ROW * ROW, 4 * N * N + 8 * N);
  if (status != KG_OK) {
    return status;
  }
  for (int side = 0; side < 2; side++) {
    for (int i = 0; i <= N; i++) {
      for (int k = 0; k <= N; k++) {
        const double x = 2.0 * half * k / N - half, z = 2.0 * half * i / N - half;
        add_vertex(s, x, side == 0 ? thick : -thick, z);
      }
    }
  }
  const int under = ROW * ROW;
  for (int i = 0; i < N; i++) {
    for (int k = 0; k < N; k++) {
      const int a = i * ROW + k, b = under + a;
      add_quad(s, a, a + ROW, a + ROW + 1, a + 1);
      add_quad(s, b, b + 1, b + ROW + 1, b + ROW);
    }
  }
  for (int k = 0; k < N; k++) {
    const int near = k, far = N * ROW + k, left = k * ROW, right = k * ROW + N;
    add_quad(s, near, near + 1, under + near + 1, under + near);
    add_quad(s, far + 1, far, under + far, under + far + 1);
    add_quad(s, left + ROW, left, under + left, under + left + ROW);
    add_quad(s, right, right + ROW, under + right + ROW, under + right);
  }
  return KG_OK;
}

/* ---- spikes ---------------------------------------------------------------------------------- */

/* An octahedron whose eight faces are divided into a triangular grid of N rows; the vertices go to
 * the sphere, then each to a radius of its own. Vertex of a face's grid: barycentric (i, j, k),
 * i + j + k = N; shared ones are found by the integer place (+-i, +-j, +-k). */
enum { SPIKE_ROWS = 101, SPIKE_SIDE = 2 * SPIKE_ROWS + 1 };

static int spike_vertex(kg_bench_surface *s, int *numbers, kg_random *random, int x, int y, int z)
{
  /* x, y and the sign of z name a place of the octahedron |x| + |y| + |z| = N */
  int *number = &numbers[((x + SPIKE_ROWS) * SPIKE_SIDE + y + SPIKE_ROWS) * 2 + (z < 0)];
  if (*number == 0) {
    const double needle = pow(kg_random_uniform(random), 3.0);
    const kg_vec3 d = kg_vec3_normalized(kg_vec3_make(x, y, z));
    const double r = 0.4 + 0.6 * needle;
    *number = 1 + add_vertex(s, r * d.x, r * d.y, r * d.z);
  }
  return *number - 1;
}

static void add_octant(kg_bench_surface *s, int *numbers, kg_random *random, int sx, int sy, int sz)
{
  const int N = SPIKE_ROWS;
  const bool is_turned = sx * sy * sz < 0;
  for (int i = 0; i < N; i++) {
    for (int j = 0; j < N - i; j++) {
      const int k = N - i - j;
      const int a = spike_vertex(s, numbers, random, sx * i, sy * j, sz * k);
      const int b = spike_vertex(s, numbers, random, sx * (i + 1), sy * j, sz * (k - 1));
      const int c = spike_vertex(s, numbers, random, sx * i, sy * (j + 1), sz * (k - 1));
      add_triangle(s, a, is_turned ? c : b, is_turned ? b : c);
      if (k > 1) {
        const int d = spike_vertex(s, numbers, random, sx * (i + 1), sy * (j + 1), sz * (k - 2));
        add_triangle(s, b, is_turned ? c : d, is_turned ? d : c);
      }
    }
  }
}

static kg_status make_spikes(kg_bench_surface *s)
{
  const size_t rows = SPIKE_ROWS;
  const kg_status status = reserve(s, 4 * rows * rows + 2, 8 * rows * rows);
  int *numbers = calloc(2 * SPIKE_SIDE * SPIKE_SIDE, sizeof *numbers);
  if (status != KG_OK || !numbers) {
    kg_bench_surface_free(s);
    free(numbers);
    return KG_ERR_NO_MEMORY;
  }
  kg_random random = kg_random_make(7);
  for (int octant = 0; octant < 8; octant++) {
    add_octant(s, numbers, &random, octant & 1 ? -1 : 1, octant & 2 ? -1 : 1, octant & 4 ? -1 : 1);
  }
  free(numbers);
  return KG_OK;
}

/* ---- part ------------------------------------------------------------------------------------ */

static int add_ring(kg_bench_surface *s, int count, double radius, double y, double at)
{
  const int first = s->vertex_count;
  for (int k = 0; k < count; k++) {
    const double turn = 2.0 * PI * k / count;
    add_vertex(s, at + radius * cos(turn), y, radius * sin(turn));
  }
  return first;
}

/* strip between two rings: seen from outside, b lies above a when the strip faces outwards */
static void add_strip(kg_bench_surface *s, int count, int a, int b)
{
  for (int k = 0; k < count; k++) {
    const int next = (k + 1) % count;
    add_quad(s, a + k, b + k, b + next, a + next);
  }
}

/* all triangles of a cap meet in its first vertex, as meshers of drawings leave them */
static void add_cap(kg_bench_surface *s, int count, int ring, bool is_top)
{
  for (int k = 1; k + 1 < count; k++) {
    add_triangle(s, ring, ring + (is_top ? k + 1 : k), ring + (is_top ? k : k + 1));
  }
}

static void add_block(kg_bench_surface *s, kg_vec3 lo, kg_vec3 hi)
{
  int v[8];
  for (int k = 0; k < 8; k++) {
    v[k] = add_vertex(s, k & 1 ? hi.x : lo.x, k & 2 ? hi.y : lo.y, k & 4 ? hi.z : lo.z);
  }
  add_quad(s, v[0], v[4], v[6], v[2]);
  add_quad(s, v[1], v[3], v[7], v[5]);
  add_quad(s, v[0], v[1], v[5], v[4]);
  add_quad(s, v[2], v[6], v[7], v[3]);
  add_quad(s, v[0], v[2], v[3], v[1]);
  add_quad(s, v[4], v[5], v[7], v[6]);
}

static kg_status make_part(kg_bench_surface *s)
{
  enum { TUBE = 6001, DISC = 12000 };
  const kg_status status = reserve(s, 4 * TUBE + 2 * DISC + 8, 8 * TUBE + 4 * DISC + 12);
  if (status != KG_OK) {
    return status;
  }
  const int outer_low = add_ring(s, TUBE, 0.2, -1.0, 0.0),
            outer_high = add_ring(s, TUBE, 0.2, 1.0, 0.0);
  const int inner_low = add_ring(s, TUBE, 0.19, -1.0, 0.0),
            inner_high = add_ring(s, TUBE, 0.19, 1.0, 0.0);
  add_strip(s, TUBE, outer_low, outer_high);
  add_strip(s, TUBE, inner_high, inner_low);
  add_strip(s, TUBE, outer_high, inner_high);
  add_strip(s, TUBE, inner_low, outer_low);
  const int low = add_ring(s, DISC, 0.5, -0.01, 0.8), high = add_ring(s, DISC, 0.5, 0.01, 0.8);
  add_strip(s, DISC, low, high);
  add_cap(s, DISC, high, true);
  add_cap(s, DISC, low, false);
  add_block(s, kg_vec3_make(-0.8, -0.5, -0.1), kg_vec3_make(-0.4, 0.5, -0.1 + 1e-4));
  return KG_OK;
}

/* ---- all of them ----------------------------------------------------------------------------- */

static double diagonal_of(const kg_bench_surface *s)
{
  kg_vec3 lo = s->vertices[0], hi = lo;
  for (int i = 1; i < s->vertex_count; i++) {
    const kg_vec3 p = s->vertices[i];
    lo = kg_vec3_make(fmin(lo.x, p.x), fmin(lo.y, p.y), fmin(lo.z, p.z));
    hi = kg_vec3_make(fmax(hi.x, p.x), fmax(hi.y, p.y), fmax(hi.z, p.z));
  }
  return kg_vec3_norm(kg_vec3_sub(hi, lo));
}

static kg_status make(kg_bench_surface *s, kg_bench_surface_kind kind)
{
  switch (kind) {
    case KG_BENCH_BLOB:
      return make_blob(s, 295, 118);
    case KG_BENCH_TERRAIN:
      return make_terrain(s);
    case KG_BENCH_PLATE:
      return make_plate(s);
    case KG_BENCH_SPIKES:
      return make_spikes(s);
    case KG_BENCH_PART:
      return make_part(s);
    case KG_BENCH_MILLION:
      return make_blob(s, 1000, 500);
    case KG_BENCH_SURFACES:
      break;
  }
  return KG_ERR_UNSUPPORTED;
}

kg_status kg_bench_surface_make(kg_bench_surface *s, kg_bench_surface_kind kind)
{
  *s = (kg_bench_surface){.kind = kind, .name = NAMES[kind], .is_closed = kind != KG_BENCH_TERRAIN};
  const kg_status status = make(s, kind);
  if (status == KG_OK) {
    s->diagonal = diagonal_of(s);
  }
  return status;
}

void kg_bench_surface_free(kg_bench_surface *s)
{
  free(s->vertices);
  free(s->triangles);
  s->vertices = NULL;
  s->triangles = NULL;
}

/* ---- points ---------------------------------------------------------------------------------- */

static kg_vec3 corner(const kg_bench_surface *s, int triangle, int k)
{
  return s->vertices[s->triangles[3 * (size_t)triangle + (size_t)k]];
}

/* twice the area times the unit normal */
static kg_vec3 area_vector(const kg_bench_surface *s, int triangle)
{
  const kg_vec3 a = corner(s, triangle, 0);
  return kg_vec3_cross(kg_vec3_sub(corner(s, triangle, 1), a),
                       kg_vec3_sub(corner(s, triangle, 2), a));
}

static int find_share(const double *sums, int count, double share)
{
  int low = 0, high = count - 1;
  while (low < high) {
    const int middle = (low + high) / 2;
    if (sums[middle] > share) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  return low;
}

static bool is_inside_border(const kg_bench_surface *s, kg_vec3 p, double margin)
{
  return s->kind != KG_BENCH_TERRAIN || fmax(fabs(p.x), fabs(p.z)) < 5.0 - 2.0 * margin;
}

bool kg_bench_points_near(const kg_bench_surface *s, kg_vec3 *points, int count, double offset,
                          uint64_t seed)
{
  double *sums = malloc((size_t)s->triangle_count * sizeof *sums), sum = 0.0;
  if (!sums) {
    return false;
  }
  for (int i = 0; i < s->triangle_count; i++) {
    sums[i] = sum += kg_vec3_norm(area_vector(s, i));
  }
  kg_random random = kg_random_make(seed);
  for (int i = 0; i < count;) {
    const int t = find_share(sums, s->triangle_count, sum * kg_random_uniform(&random));
    double u = kg_random_uniform(&random), v = kg_random_uniform(&random);
    if (u + v > 1.0) {
      u = 1.0 - u;
      v = 1.0 - v;
    }
    const kg_vec3 a = corner(s, t, 0);
    kg_vec3 p = kg_vec3_add_scaled(a, u, kg_vec3_sub(corner(s, t, 1), a));
    p = kg_vec3_add_scaled(p, v, kg_vec3_sub(corner(s, t, 2), a));
    const double height = offset * (2.0 * kg_random_uniform(&random) - 1.0);
    points[i] = kg_vec3_add_scaled(p, height, kg_vec3_normalized(area_vector(s, t)));
    i += is_inside_border(s, p, offset);
  }
  free(sums);
  return true;
}

/* the surface at arc s of a path, with its tangents */
static void foot_frame(const kg_bench_surface *s, double arc, double aside, kg_vec3 *at,
                       kg_vec3 *along, kg_vec3 *across)
{
  if (s->kind == KG_BENCH_TERRAIN) {
    const double x = -3.0 + arc * cos(0.5) - aside * sin(0.5);
    const double z = -2.0 + arc * sin(0.5) + aside * cos(0.5);
    *at = kg_vec3_make(x, terrain_height(x, z) + 0.01, z);
    *along = kg_vec3_make(cos(0.5), 0.0, sin(0.5));
    *across = kg_vec3_make(-sin(0.5), 0.0, cos(0.5));
    return;
  }
  const double turn = arc / 0.55, tilt = aside / 0.55;
  const kg_vec3 d = kg_vec3_make(cos(tilt) * cos(turn), sin(tilt), cos(tilt) * sin(turn));
  *at = kg_vec3_scale(blob_radius(d) + 0.005, d);
  *along = kg_vec3_make(-sin(turn), 0.0, cos(turn));
  *across = kg_vec3_cross(*along, d);
}

void kg_bench_feet(const kg_bench_surface *s, kg_vec3 *points, int frames)
{
  for (int f = 0; f < frames; f++) {
    for (int k = 0; k < KG_BENCH_FOOT_POINTS; k++) {
      const int foot = k / 32, row = k % 32 / 4, column = k % 4;
      kg_vec3 at, along, across;
      foot_frame(s, 0.02 * f + 0.3 * foot, foot == 0 ? -0.1 : 0.1, &at, &along, &across);
      at = kg_vec3_add_scaled(at, 0.26 * (row / 7.0 - 0.5), along);
      points[KG_BENCH_FOOT_POINTS * f + k] =
        kg_vec3_add_scaled(at, 0.1 * (column / 3.0 - 0.5), across);
    }
  }
}
