/* Ear clipping [MEIS] G. H. Meisters, Polygons have ears, Amer. Math. Monthly 82, 1975, in the plane
 * of Newell's normal (the sum of cross products along the outline, twice the area of its shadow). */
#include "sdf/polygon.h"

#include "sdf/feature.h"

#include <math.h>

/* the polygon seen against its normal, so that it turns left */
typedef struct outline {
  const kg_vec3 *p;
  kg_vec3 e1, e2; /* axes of the plane */
  int *next;      /* (n) corners that are left, in a ring */
  int left;
  double straight; /* turns smaller than this are rounding of the coordinates, which were floats */
} outline;

#define ROUNDING 1e-7 /* of the square of the size */

static kg_vec3 newell_normal(const kg_vec3 *p, int n)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int k = 1; k + 1 < n; k++) {
    sum = kg_vec3_add(sum, kg_vec3_cross(kg_vec3_sub(p[k], p[0]), kg_vec3_sub(p[k + 1], p[0])));
  }
  return sum;
}

/* twice the signed area of a triangle of corners */
static double turn(const outline *o, int a, int b, int c)
{
  const kg_vec3 u = kg_vec3_sub(o->p[b], o->p[a]), v = kg_vec3_sub(o->p[c], o->p[a]);
  return kg_vec3_dot(u, o->e1) * kg_vec3_dot(v, o->e2) -
         kg_vec3_dot(u, o->e2) * kg_vec3_dot(v, o->e1);
}

static bool is_convex(const outline *o, int n)
{
  for (int k = 0; k < n; k++) {
    if (turn(o, k, (k + 1) % n, (k + 2) % n) < -o->straight) return false;
    if (k > 0 && k + 1 < n && turn(o, 0, k, k + 1) < -o->straight) return false;
  }
  return true;
}

static bool same_place(kg_vec3 a, kg_vec3 b)
{
  return a.x == b.x && a.y == b.y && a.z == b.z;
}

/* b may be cut off: its corner turns left and no other corner lies in the triangle a b c */
static bool is_ear(const outline *o, int a, int b, int c)
{
  if (!(turn(o, a, b, c) > o->straight)) return false;
  for (int k = o->next[c]; k != a; k = o->next[k]) {
    const kg_vec3 p = o->p[k];
    if (same_place(p, o->p[a]) || same_place(p, o->p[b]) || same_place(p, o->p[c])) continue;
    if (turn(o, a, b, k) >= 0.0 && turn(o, b, c, k) >= 0.0 && turn(o, c, a, k) >= 0.0) {
      return false;
    }
  }
  return true;
}

/* A corner before one that can go: an ear, else one on a straight line, else none. */
static int before_next_cut(const outline *o, int start)
{
  int straight = -1, a = start;
  for (int k = 0; k < o->left; k++, a = o->next[a]) {
    const int b = o->next[a], c = o->next[b];
    if (is_ear(o, a, b, c)) return a;
    if (fabs(turn(o, a, b, c)) <= o->straight) straight = a;
  }
  return straight;
}

/* false: at some point no corner could be cut off as it should */
static bool clip_ears(outline *o, int *triangles, int n)
{
  bool good = true;
  for (int k = 0; k < n; k++) {
    o->next[k] = (k + 1) % n;
  }
  int at = n - 1;
  for (o->left = n; o->left > 2; o->left--) {
    int a = before_next_cut(o, at);
    if (a < 0) {
      good = false;
      a = at;
    }
    const int b = o->next[a], c = o->next[b];
    *triangles++ = a;
    *triangles++ = b;
    *triangles++ = c;
    o->next[a] = c;
    at = a;
  }
  return good;
}

static double farthest(const kg_vec3 *p, int n)
{
  double most = 0.0;
  for (int k = 1; k < n; k++) {
    most = fmax(most, kg_vec3_norm(kg_vec3_sub(p[k], p[0])));
  }
  return most;
}

static double bend(const kg_vec3 *p, int n, kg_vec3 normal)
{
  double mean = 0.0, low = INFINITY, high = -INFINITY;
  for (int k = 0; k < n; k++) {
    const double height = kg_vec3_dot(kg_vec3_sub(p[k], p[0]), normal);
    mean += height / n;
    low = fmin(low, height);
    high = fmax(high, height);
  }
  return fmax(high - mean, mean - low);
}

/* The triangles of the fan cancel: some have an area although all together have none. */
static bool is_bow_tie(const kg_vec3 *p, int n, double straight)
{
  for (int k = 1; k + 1 < n; k++) {
    const kg_vec3 cross = kg_vec3_cross(kg_vec3_sub(p[k], p[0]), kg_vec3_sub(p[k + 1], p[0]));
    if (kg_vec3_norm(cross) > straight) return n > 3;
  }
  return false;
}

static void cut_fan(int *triangles, int n)
{
  for (int k = 2; k < n; k++) {
    triangles[3 * (k - 2)] = 0;
    triangles[3 * (k - 2) + 1] = k - 1;
    triangles[3 * (k - 2) + 2] = k;
  }
}

polygon_cut polygon_triangles(int *triangles, int *work, const kg_vec3 *corners, int n)
{
  const double size = farthest(corners, n);
  polygon_cut cut = {.size = size};
  outline o = {.p = corners, .next = work, .straight = ROUNDING * size * size};
  const kg_vec3 normal = newell_normal(corners, n);
  const double area = kg_vec3_norm(normal);
  const bool has_plane = area > o.straight && isfinite(area);
  if (n > 3 && has_plane) {
    const kg_vec3 unit = kg_vec3_scale(1.0 / area, normal);
    o.e1 = any_orthogonal(unit);
    o.e2 = kg_vec3_cross(unit, o.e1);
    cut.bent = bend(corners, n, unit);
    const bool is_concave = !is_convex(&o, n);
    cut.too_long = is_concave && n > POLYGON_MOST_CONCAVE;
    if (is_concave && !cut.too_long) {
      cut.tangled = !clip_ears(&o, triangles, n);
      return cut;
    }
  }
  cut.tangled = !has_plane && is_bow_tie(corners, n, o.straight);
  cut_fan(triangles, n);
  return cut;
}
