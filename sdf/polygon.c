/* Ear clipping [MEIS] G. H. Meisters, Polygons have ears, Amer. Math. Monthly 82, 1975, in the plane
 * of Newell's normal (the sum of cross products along the outline, twice the area of its shadow). */
#include "sdf/polygon.h"

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

static void measure(polygon_cut *cut, const kg_vec3 *p, int n, kg_vec3 normal)
{
  double mean = 0.0, low = INFINITY, high = -INFINITY;
  for (int k = 0; k < n; k++) {
    const kg_vec3 d = kg_vec3_sub(p[k], p[0]);
    const double height = kg_vec3_dot(d, normal);
    mean += height / n;
    low = fmin(low, height);
    high = fmax(high, height);
    cut->size = fmax(cut->size, kg_vec3_norm(d));
  }
  cut->bent = fmax(high - mean, mean - low);
}

polygon_cut polygon_triangles(int *triangles, int *work, const kg_vec3 *corners, int n)
{
  polygon_cut cut = {0};
  const kg_vec3 normal = newell_normal(corners, n);
  const double area = kg_vec3_norm(normal);
  outline o = {.p = corners, .next = work};
  bool fan = n == 3 || !(area > 0.0) || !isfinite(area);
  if (!fan) {
    const kg_vec3 unit = kg_vec3_scale(1.0 / area, normal);
    const kg_vec3 side =
      fabs(unit.x) < 0.6 ? kg_vec3_make(1.0, 0.0, 0.0) : kg_vec3_make(0.0, 1.0, 0.0);
    o.e1 = kg_vec3_normalized(kg_vec3_cross(side, unit));
    o.e2 = kg_vec3_cross(unit, o.e1);
    measure(&cut, corners, n, unit);
    o.straight = ROUNDING * cut.size * cut.size;
    fan = is_convex(&o, n);
    cut.too_long = !fan && n > POLYGON_MOST_CONCAVE;
  }
  if (fan || cut.too_long) {
    for (int k = 2; k < n; k++) {
      triangles[3 * (k - 2)] = 0;
      triangles[3 * (k - 2) + 1] = k - 1;
      triangles[3 * (k - 2) + 2] = k;
    }
  } else {
    cut.tangled = !clip_ears(&o, triangles, n);
  }
  return cut;
}
