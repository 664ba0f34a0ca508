/* Hand-made triangle meshes, and a distance to all triangles by other means than the library's. */
#ifndef TESTS_MESH_SUPPORT_H
#define TESTS_MESH_SUPPORT_H

#include "sdf_support.h"

typedef struct soup {
  int vertex_count, triangle_count;
  kg_vec3 vertices[4000];
  int triangles[8000][3];
} soup;

static inline int add_vertex(soup *s, kg_vec3 p)
{
  assert_true(s->vertex_count < (int)KG_COUNT_OF(s->vertices));
  s->vertices[s->vertex_count] = p;
  return s->vertex_count++;
}

static inline void add_triangle(soup *s, int a, int b, int c)
{
  assert_true(s->triangle_count < (int)KG_COUNT_OF(s->triangles));
  int *t = s->triangles[s->triangle_count++];
  t[0] = a;
  t[1] = b;
  t[2] = c;
}

/* index of the vertex at p, added when new */
static inline int vertex_at(soup *s, kg_vec3 p)
{
  for (int i = 0; i < s->vertex_count; i++) {
    if (kg_vec3_norm(kg_vec3_sub(s->vertices[i], p)) < 1e-9) return i;
  }
  return add_vertex(s, p);
}

/* Axis-aligned box, 12 triangles facing outwards. */
static inline void add_box(soup *s, kg_vec3 lo, kg_vec3 hi)
{
  int v[8];
  for (int k = 0; k < 8; k++) {
    v[k] =
      add_vertex(s, kg_vec3_make(k & 1 ? hi.x : lo.x, k & 2 ? hi.y : lo.y, k & 4 ? hi.z : lo.z));
  }
  const int quads[6][4] = {{0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4},
                           {2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6}};
  for (int k = 0; k < 6; k++) {
    const int *q = quads[k];
    add_triangle(s, v[q[0]], v[q[1]], v[q[2]]);
    add_triangle(s, v[q[0]], v[q[2]], v[q[3]]);
  }
}

/* Icosahedron whose faces are split `levels` times, vertices pushed out to the unit sphere. */
static inline void add_icosphere(soup *s, int levels)
{
  const double g = 0.5 * (1.0 + sqrt(5.0));
  const double p[12][3] = {{-1, g, 0}, {1, g, 0}, {-1, -g, 0}, {1, -g, 0},
                           {0, -1, g}, {0, 1, g}, {0, -1, -g}, {0, 1, -g},
                           {g, 0, -1}, {g, 0, 1}, {-g, 0, -1}, {-g, 0, 1}};
  const int f[20][3] = {{0, 11, 5}, {0, 5, 1},  {0, 1, 7},   {0, 7, 10}, {0, 10, 11},
                        {1, 5, 9},  {5, 11, 4}, {11, 10, 2}, {10, 7, 6}, {7, 1, 8},
                        {3, 9, 4},  {3, 4, 2},  {3, 2, 6},   {3, 6, 8},  {3, 8, 9},
                        {4, 9, 5},  {2, 4, 11}, {6, 2, 10},  {8, 6, 7},  {9, 8, 1}};
  for (int i = 0; i < 12; i++) {
    add_vertex(s, kg_vec3_normalized(kg_vec3_make(p[i][0], p[i][1], p[i][2])));
  }
  for (int i = 0; i < 20; i++) {
    add_triangle(s, f[i][0], f[i][1], f[i][2]);
  }
  for (int level = 0; level < levels; level++) {
    const int count = s->triangle_count;
    for (int i = 0; i < count; i++) {
      int *t = s->triangles[i];
      int m[3];
      for (int k = 0; k < 3; k++) {
        const kg_vec3 a = s->vertices[t[k]], b = s->vertices[t[(k + 1) % 3]];
        m[k] = vertex_at(s, kg_vec3_normalized(kg_vec3_lerp(a, b, 0.5)));
      }
      add_triangle(s, t[0], m[0], m[2]);
      add_triangle(s, m[0], t[1], m[1]);
      add_triangle(s, m[2], m[1], t[2]);
      t[0] = m[0];
      t[1] = m[1];
      t[2] = m[2];
    }
  }
}

/* Icosphere whose radius varies by vertex: needles, valleys, acute edges. */
static inline void add_spiky(soup *s, int levels, uint64_t seed)
{
  add_icosphere(s, levels);
  kg_random random = kg_random_make(seed);
  for (int i = 0; i < s->vertex_count; i++) {
    const double radius = 0.3 + 1.2 * kg_random_uniform(&random);
    s->vertices[i] = kg_vec3_scale(radius, s->vertices[i]);
  }
}

static inline kg_mesh *build_mesh(const soup *s, kg_mesh_report *report)
{
  kg_mesh *mesh;
  kg_error error;
  assert_int_equal(kg_mesh_create(&mesh, s->vertices, s->vertex_count, &s->triangles[0][0],
                                  s->triangle_count, report, NULL, &error),
                   KG_OK);
  return mesh;
}

static inline double segment_distance(kg_vec3 a, kg_vec3 b, kg_vec3 x)
{
  const kg_vec3 e = kg_vec3_sub(b, a);
  const double t = kg_vec3_dot(kg_vec3_sub(x, a), e) / kg_vec3_dot(e, e);
  return kg_vec3_norm(kg_vec3_sub(x, kg_vec3_lerp(a, b, fmin(1.0, fmax(0.0, t)))));
}

/* Least of the three sides and, when x projects into the triangle, of its plane. */
static inline double triangle_distance(kg_vec3 a, kg_vec3 b, kg_vec3 c, kg_vec3 x)
{
  const kg_vec3 n = kg_vec3_normalized(kg_vec3_cross(kg_vec3_sub(b, a), kg_vec3_sub(c, a)));
  const kg_vec3 corner[3] = {a, b, c};
  bool within = true;
  double least = INFINITY;
  for (int k = 0; k < 3; k++) {
    const kg_vec3 p = corner[k], q = corner[(k + 1) % 3];
    const kg_vec3 inward = kg_vec3_cross(n, kg_vec3_sub(q, p));
    within = within && kg_vec3_dot(inward, kg_vec3_sub(x, p)) >= 0.0;
    least = fmin(least, segment_distance(p, q, x));
  }
  return within ? fabs(kg_vec3_dot(n, kg_vec3_sub(x, a))) : least;
}

static inline double brute_distance(const soup *s, kg_vec3 x)
{
  double least = INFINITY;
  for (int i = 0; i < s->triangle_count; i++) {
    const int *t = s->triangles[i];
    least =
      fmin(least, triangle_distance(s->vertices[t[0]], s->vertices[t[1]], s->vertices[t[2]], x));
  }
  return least;
}

/* Solid angle of the surface seen from x over 4 pi: 1 inside, 0 outside of a closed mesh.
 * A. van Oosterom, J. Strackee, The solid angle of a plane triangle, IEEE TBME 30(2), 1983. */
static inline double winding_number(const soup *s, kg_vec3 x)
{
  double sum = 0.0;
  for (int i = 0; i < s->triangle_count; i++) {
    const int *t = s->triangles[i];
    const kg_vec3 a = kg_vec3_sub(s->vertices[t[0]], x), b = kg_vec3_sub(s->vertices[t[1]], x);
    const kg_vec3 c = kg_vec3_sub(s->vertices[t[2]], x);
    const double la = kg_vec3_norm(a), lb = kg_vec3_norm(b), lc = kg_vec3_norm(c);
    sum += 2.0 * atan2(kg_vec3_dot(a, kg_vec3_cross(b, c)), la * lb * lc + kg_vec3_dot(a, b) * lc +
                                                              kg_vec3_dot(b, c) * la +
                                                              kg_vec3_dot(c, a) * lb);
  }
  return sum / (4.0 * acos(-1.0));
}

#endif
