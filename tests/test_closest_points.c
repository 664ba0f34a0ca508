/* Ellipsoids and cylinders against the closest of the points of their surface, found by sampling it
 * and searching on from every local minimum. */
#include "sdf_support.h"

static const double PI = 3.14159265358979323846;

/* A piece of a surface: (u, v) in [0, 1]^2 to a point */
typedef kg_vec3 patch_fn(const kg_sdf_shape *shape, double u, double v);

static kg_vec3 ellipsoid_patch(const kg_sdf_shape *s, double u, double v)
{
  const double a = 2.0 * PI * u, b = PI * v;
  const kg_vec3 p =
    kg_vec3_make(s->b.x * sin(b) * cos(a), s->b.y * sin(b) * sin(a), s->b.z * cos(b));
  return kg_vec3_add(s->a, kg_quat_rotate(s->orientation, p));
}

/* point of the disc of radius r around the axis of a cylinder, at the share h of its length */
static kg_vec3 around_axis(const kg_sdf_shape *s, double turn, double r, double h)
{
  const kg_vec3 t = kg_vec3_normalized(kg_vec3_sub(s->b, s->a));
  const kg_vec3 other = fabs(t.x) < 0.5 ? kg_vec3_make(1, 0, 0) : kg_vec3_make(0, 0, 1);
  const kg_vec3 e = kg_vec3_normalized(kg_vec3_cross(t, other)), f = kg_vec3_cross(t, e);
  const double a = 2.0 * PI * turn;
  const kg_vec3 p = kg_vec3_add_scaled(kg_vec3_lerp(s->a, s->b, h), r * cos(a), e);
  return kg_vec3_add_scaled(p, r * sin(a), f);
}

static kg_vec3 side_patch(const kg_sdf_shape *s, double u, double v)
{
  return around_axis(s, u, s->radius, v);
}

static kg_vec3 cap_a_patch(const kg_sdf_shape *s, double u, double v)
{
  return around_axis(s, u, s->radius * v, 0.0);
}

static kg_vec3 cap_b_patch(const kg_sdf_shape *s, double u, double v)
{
  return around_axis(s, u, s->radius * v, 1.0);
}

enum { GRID = 40 };

static double way2(const kg_sdf_shape *s, patch_fn *patch, kg_vec3 x, double u, double v)
{
  v = fmin(fmax(v, 0.0), 1.0);
  const kg_vec3 d = kg_vec3_sub(x, patch(s, u, v));
  return kg_vec3_dot(d, d);
}

/* the least way from (u, v) on: eight neighbours at a stride that halves */
static double search_on(const kg_sdf_shape *s, patch_fn *patch, kg_vec3 x, double u, double v)
{
  double best = way2(s, patch, x, u, v);
  for (double stride = 0.5 / GRID; stride > 1e-11;) {
    bool moved = false;
    for (int k = 0; k < 9; k++) {
      const double p = u + stride * (k % 3 - 1), q = v + stride * (k / 3 - 1);
      const double there = way2(s, patch, x, p, q);
      if (there < best) {
        best = there;
        u = p;
        v = q;
        moved = true;
        break;
      }
    }
    if (!moved) stride *= 0.5;
  }
  return best;
}

static double nearest_on_patch(const kg_sdf_shape *s, patch_fn *patch, kg_vec3 x)
{
  static double way[GRID + 1][GRID + 1];
  double best = INFINITY, best_of_grid = INFINITY;
  for (int i = 0; i <= GRID; i++) {
    for (int j = 0; j <= GRID; j++) {
      way[i][j] = way2(s, patch, x, (double)i / GRID, (double)j / GRID);
      best_of_grid = fmin(best_of_grid, sqrt(way[i][j]));
    }
  }
  for (int i = 0; i <= GRID; i++) {
    for (int j = 0; j <= GRID; j++) {
      bool least = true;
      for (int k = 0; k < 9; k++) {
        const int a = i + k % 3 - 1, b = j + k / 3 - 1;
        const bool on_grid = a >= 0 && b >= 0 && a <= GRID && b <= GRID;
        if (on_grid && way[a][b] < way[i][j]) least = false;
      }
      if (least && sqrt(way[i][j]) < best_of_grid + 0.1) {
        best = fmin(best, search_on(s, patch, x, (double)i / GRID, (double)j / GRID));
      }
      if (best == 0.0) return 0.0;
    }
  }
  return sqrt(best);
}

static double brute_force(const kg_sdf_shape *s, kg_vec3 x)
{
  if (s->kind == KG_SHAPE_ELLIPSOID) return nearest_on_patch(s, ellipsoid_patch, x);
  const double side = nearest_on_patch(s, side_patch, x);
  return fmin(side, fmin(nearest_on_patch(s, cap_a_patch, x), nearest_on_patch(s, cap_b_patch, x)));
}

static bool is_inside(const kg_sdf_shape *s, kg_vec3 x)
{
  if (s->kind == KG_SHAPE_ELLIPSOID) {
    const kg_vec3 p = kg_quat_rotate(kg_quat_conj(s->orientation), kg_vec3_sub(x, s->a));
    const kg_vec3 z = kg_vec3_make(p.x / s->b.x, p.y / s->b.y, p.z / s->b.z);
    return kg_vec3_dot(z, z) < 1.0;
  }
  const kg_vec3 axis = kg_vec3_sub(s->b, s->a), d = kg_vec3_sub(x, s->a);
  const double share = kg_vec3_dot(d, axis) / kg_vec3_dot(axis, axis);
  const kg_vec3 across = kg_vec3_add_scaled(d, -share, axis);
  return share > 0.0 && share < 1.0 && kg_vec3_norm(across) < s->radius;
}

static kg_sdf_shape round_shape(int k)
{
  const kg_quat turn = kg_quat_exp(kg_vec3_make(0.4, -0.9, 0.3));
  const kg_vec3 semi[] = {{0.5, 0.3, 0.2},   {0.2, 0.5, 0.3},       {0.5, 0.4, 1e-3},
                          {1e-2, 0.6, 1e-2}, {0.3, 0.3, 0.3},       {0.4, 0.1, 0.4},
                          {0.1, 0.45, 0.1},  {0.3, 0.3, 0.2999999}, {1.0, 1e-2, 0.1}};
  const kg_vec3 ends[][2] = {{{-0.4, 0.1, 0.0}, {0.5, 0.3, 0.2}},
                             {{0.0, -0.5, 0.0}, {0.0, 0.5, 0.0}},
                             {{0.1, 0.0, 0.1}, {0.1, 0.003, 0.1}}};
  const double radius[] = {0.25, 4e-3, 0.4};
  if (k < (int)KG_COUNT_OF(semi)) {
    return (kg_sdf_shape){
      .kind = KG_SHAPE_ELLIPSOID, .a = {0.1, -0.2, 0.05}, .b = semi[k], .orientation = turn};
  }
  k -= (int)KG_COUNT_OF(semi);
  return (kg_sdf_shape){
    .kind = KG_SHAPE_CYLINDER, .a = ends[k][0], .b = ends[k][1], .radius = radius[k]};
}
enum { ROUND_SHAPES = 12 };

static kg_sdf_value distance(const kg_sdf_shape *s, kg_vec3 x)
{
  return s->kind == KG_SHAPE_ELLIPSOID ? kg_sdf_ellipsoid(s->a, s->orientation, s->b, x)
                                       : kg_sdf_cylinder(s->a, s->b, s->radius, x);
}

/* own axes of the shape: columns */
static kg_mat3 axes_of(const kg_sdf_shape *s)
{
  const kg_vec3 up = {0.0, 1.0, 0.0};
  return kg_quat_matrix(
    s->kind == KG_SHAPE_ELLIPSOID ? s->orientation : kg_quat_between(up, kg_vec3_sub(s->b, s->a)));
}

static kg_vec3 middle_of(const kg_sdf_shape *s)
{
  return s->kind == KG_SHAPE_ELLIPSOID ? s->a : kg_vec3_lerp(s->a, s->b, 0.5);
}

/* Around, inside, near the surface, on the axes and their planes, in the middle, far away */
static kg_vec3 some_point(const kg_sdf_shape *s, int i, kg_random *random)
{
  const kg_vec3 wide = random_vec3(random, 0.8), small = random_vec3(random, 1e-4);
  kg_vec3 p = wide;
  if (i % 8 == 1) p = kg_vec3_scale(0.05, wide);
  if (i % 8 == 2) p.x = 0.0;
  if (i % 8 == 3) p.y = p.z = 0.0;
  if (i % 8 == 4) p.x = p.z = 0.0;
  if (i % 8 == 5) p.z = 0.0;
  if (i % 8 == 6) p = kg_vec3_scale(100.0, wide);
  if (i == 7) p = kg_vec3_make(0.0, 0.0, 0.0);
  const kg_vec3 x = kg_vec3_add(middle_of(s), kg_mat3_mul_vec(axes_of(s), p));
  if (i % 8 != 7 || i == 7) return x;
  const kg_vec3 c = s->kind == KG_SHAPE_ELLIPSOID ? ellipsoid_patch(s, wide.x, 0.5 + 0.6 * wide.y)
                                                  : side_patch(s, wide.x, 0.5 + 0.6 * wide.y);
  return kg_vec3_add(c, small);
}

static void distances_are_those_of_brute_force(void **state)
{
  (void)state;
  kg_random random = kg_random_make(81);
  double worst = 0.0;
  int inside = 0;
  for (int k = 0; k < ROUND_SHAPES; k++) {
    const kg_sdf_shape shape = round_shape(k);
    for (int i = 0; i < 24; i++) {
      const kg_vec3 x = some_point(&shape, i, &random);
      const double found = distance(&shape, x).distance, best = brute_force(&shape, x);
      const double error = fabs(fabs(found) - best) / (1.0 + best);
      if (error > 1e-9) print_message("shape %d, point %d: %.15g, %.15g\n", k, i, found, best);
      assert_at_most(error, 1e-9);
      worst = fmax(worst, error);
      if (best > 1e-9) assert_true((found < 0.0) == is_inside(&shape, x));
      inside += found < 0.0;
    }
  }
  assert_true(inside > 60);
  print_message("distances against brute force: %.1e\n", worst);
}

static kg_sdf_value shape_phi(kg_vec3 x, const void *user)
{
  return distance(user, x);
}

static void gradient_and_hessian_match_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(82);
  for (int k = 0; k < ROUND_SHAPES; k++) {
    const kg_sdf_shape shape = round_shape(k);
    int checked = 0;
    for (int i = 0; i < 1000; i++) {
      const kg_vec3 x = kg_vec3_add(middle_of(&shape), random_vec3(&random, 0.8));
      const kg_sdf_value at = distance(&shape, x);
      double bend = 0.0; /* differences need steps below the radius of curvature */
      for (int c = 0; c < 6; c++) {
        bend = fmax(bend, fabs(at.hessian[c]));
      }
      if (bend > 20.0) continue;
      checked += check_derivatives(shape_phi, &shape, x, 2e-4, 2e-5);
    }
    if (checked < 300) print_message("shape %d: %d\n", k, checked);
    assert_true(checked >= 300);
  }
}

/* Sharp: next to the surface of a flat ellipsoid the Hessian is its curvature, and goes with Phi as
 * W (1 + Phi W)^-1. */
static void curvature_of_an_ellipsoid_is_the_known_one(void **state)
{
  (void)state;
  const kg_vec3 semi = {0.5, 0.3, 0.2}, zero = {0.0, 0.0, 0.0};
  const double depths[] = {0.0, 0.4, -0.07, 1e-7};
  for (size_t k = 0; k < KG_COUNT_OF(depths); k++) { /* at the end of the x axis */
    const double phi = depths[k], ky = 0.5 / (0.3 * 0.3), kz = 0.5 / (0.2 * 0.2);
    const kg_sdf_value v =
      kg_sdf_ellipsoid(zero, kg_quat_identity(), semi, kg_vec3_make(0.5 + phi, 0.0, 0.0));
    assert_close(v.distance, phi, 1e-15);
    assert_close(v.hessian[0], 0.0, 1e-12);
    assert_close(v.hessian[1], ky / (1.0 + phi * ky), 1e-12);
    assert_close(v.hessian[2], kz / (1.0 + phi * kz), 1e-12);
  }
}

static void distances_have_lipschitz_constant_one(void **state)
{
  (void)state;
  kg_random random = kg_random_make(83);
  for (int k = 0; k < ROUND_SHAPES; k++) {
    const kg_sdf_shape shape = round_shape(k);
    for (int i = 0; i < 5000; i++) {
      const kg_vec3 a = random_vec3(&random, 0.8);
      const kg_vec3 b = kg_vec3_add(a, random_vec3(&random, i % 2 ? 0.5 : 1e-3));
      const double change = distance(&shape, a).distance - distance(&shape, b).distance;
      assert_at_most(fabs(change), kg_vec3_norm(kg_vec3_sub(a, b)) * (1.0 + 1e-9) + 1e-15);
    }
  }
}

/* Walking Phi along the normal lands on the surface, from everywhere. */
static void closest_point_lies_on_the_surface(void **state)
{
  (void)state;
  kg_random random = kg_random_make(84);
  for (int k = 0; k < ROUND_SHAPES; k++) {
    const kg_sdf_shape shape = round_shape(k);
    for (int i = 0; i < 2000; i++) {
      const kg_vec3 x = some_point(&shape, i, &random);
      const kg_sdf_value v = distance(&shape, x);
      assert_close(kg_vec3_norm(v.normal), 1.0, 1e-12);
      const kg_vec3 c = kg_vec3_add_scaled(x, -v.distance, v.normal);
      assert_at_most(fabs(distance(&shape, c).distance), 1e-13 * (1.0 + fabs(v.distance)));
      for (int h = 0; h < 6; h++) {
        assert_true(isfinite(v.hessian[h]));
      }
    }
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(distances_are_those_of_brute_force),
    cmocka_unit_test(gradient_and_hessian_match_differences),
    cmocka_unit_test(curvature_of_an_ellipsoid_is_the_known_one),
    cmocka_unit_test(distances_have_lipschitz_constant_one),
    cmocka_unit_test(closest_point_lies_on_the_surface),
  };
  return cmocka_run_group_tests_name("closest points", tests, NULL, NULL);
}
