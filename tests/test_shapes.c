/* Shapes and scenes against distances to densely sampled surfaces, closed forms and differences. */
#include "sdf_support.h"

static kg_sdf_value shape_phi(kg_vec3 x, const void *user)
{
  return kg_scene_distance(user, x);
}

static kg_scene scene_of(kg_sdf_shape shape)
{
  kg_scene scene = {0};
  assert_true(kg_scene_add(&scene, &shape));
  return scene;
}

static kg_sdf_shape tilted_box(void)
{
  const kg_quat turn = kg_quat_exp(kg_vec3_make(0.4, -0.9, 0.3));
  return (kg_sdf_shape){
    .kind = KG_SHAPE_BOX, .a = {0.3, -0.2, 0.5}, .b = {0.5, 0.2, 0.35}, .orientation = turn};
}

static kg_sdf_shape some_shape(int k)
{
  const kg_sdf_shape shapes[] = {
    {.kind = KG_SHAPE_PLANE, .a = {0.1, 0.2, 0.3}, .b = {0.6, 0.0, 0.8}},
    {.kind = KG_SHAPE_SPHERE, .a = {0.2, 0.1, -0.3}, .radius = 0.7},
    {.kind = KG_SHAPE_CAPSULE, .a = {-0.4, 0.1, 0.0}, .b = {0.5, 0.3, 0.2}, .radius = 0.25},
    {.kind = KG_SHAPE_CAPSULE, .a = {0.1, 0.1, 0.0}, .b = {0.1, 0.1, 0.0}, .radius = 0.25},
  };
  return k < 4 ? shapes[k] : tilted_box();
}
enum { SOME_SHAPES = 5 };

static void gradient_and_hessian_match_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(11);
  for (int k = 0; k < SOME_SHAPES; k++) {
    const kg_scene scene = scene_of(some_shape(k));
    int checked = 0;
    for (int i = 0; i < 2000; i++) {
      const kg_vec3 x = random_vec3(&random, 0.6);
      if (k == 2 || k == 3) { /* differences lose their digits at the skeleton itself */
        const kg_sdf_value near = kg_scene_distance(&scene, x);
        if (near.distance + 0.25 < 0.05) continue;
      }
      checked += check_derivatives(shape_phi, &scene, x, 2e-4, 2e-6);
    }
    assert_true(checked > 1500);
  }
}

static void distances_have_lipschitz_constant_one(void **state)
{
  (void)state;
  kg_random random = kg_random_make(12);
  for (int k = 0; k < SOME_SHAPES; k++) {
    const kg_scene scene = scene_of(some_shape(k));
    for (int i = 0; i < 5000; i++) {
      const kg_vec3 a = random_vec3(&random, 0.8), b = random_vec3(&random, 0.8);
      const double change =
        kg_scene_distance(&scene, a).distance - kg_scene_distance(&scene, b).distance;
      assert_at_most(fabs(change), kg_vec3_norm(kg_vec3_sub(a, b)) * (1.0 + 1e-12));
    }
  }
}

/* Walking Phi along the normal lands on the surface and the distance is the way walked. */
static void closest_point_lies_on_the_surface(void **state)
{
  (void)state;
  kg_random random = kg_random_make(13);
  for (int k = 0; k < SOME_SHAPES; k++) {
    const kg_scene scene = scene_of(some_shape(k));
    for (int i = 0; i < 2000; i++) {
      const kg_vec3 x = random_vec3(&random, 1.0);
      const kg_sdf_value v = kg_scene_distance(&scene, x);
      const kg_vec3 c = kg_vec3_add_scaled(x, -v.distance, v.normal);
      assert_at_most(fabs(kg_scene_distance(&scene, c).distance), 1e-12);
    }
  }
}

static void box_agrees_with_its_sampled_surface(void **state)
{
  (void)state;
  const kg_sdf_shape box = tilted_box();
  const kg_scene scene = scene_of(box);
  const double half[3] = {box.b.x, box.b.y, box.b.z};
  kg_random random = kg_random_make(14);
  enum { GRID = 120 };
  for (int i = 0; i < 20; i++) {
    const kg_vec3 x = random_vec3(&random, 0.5);
    double best = INFINITY;
    for (int face = 0; face < 6; face++) {
      const int axis = face / 2, u = (axis + 1) % 3, v = (axis + 2) % 3;
      for (int k = 0; k <= GRID * GRID + 2 * GRID; k++) {
        double p[3];
        p[axis] = face % 2 ? half[axis] : -half[axis];
        p[u] = half[u] * (2.0 * (k % (GRID + 1)) / GRID - 1.0);
        p[v] = half[v] * (2.0 * (int)(k / (GRID + 1)) / GRID - 1.0);
        const kg_vec3 world =
          kg_vec3_add(box.a, kg_quat_rotate(box.orientation, kg_vec3_make(p[0], p[1], p[2])));
        best = fmin(best, kg_vec3_norm(kg_vec3_sub(x, world)));
      }
    }
    const kg_vec3 local = kg_quat_rotate(kg_quat_conj(box.orientation), kg_vec3_sub(x, box.a));
    const bool inside =
      fabs(local.x) < half[0] && fabs(local.y) < half[1] && fabs(local.z) < half[2];
    const double exact = kg_scene_distance(&scene, x).distance;
    assert_true(inside == (exact < 0.0));
    /* sampling misses the closest point by at most half a cell diagonal */
    assert_at_most(fabs(exact), best + 1e-12);
    assert_at_most(best, hypot(fabs(exact), 0.5 * hypot(1.0, 0.7) / GRID) + 1e-12);
  }
}

static void shapes_have_their_closed_forms(void **state)
{
  (void)state;
  const kg_vec3 a = {1.0, 0.0, 0.0}, b = {1.0, 2.0, 0.0}, up = {0.0, 1.0, 0.0};
  assert_close(kg_sdf_plane(a, up, kg_vec3_make(7.0, -0.25, 3.0)).distance, -0.25, 1e-15);
  assert_close(kg_sdf_sphere(a, 0.5, kg_vec3_make(4.0, 4.0, 0.0)).distance, 4.5, 1e-15);
  assert_close(kg_sdf_capsule(a, b, 0.5, kg_vec3_make(4.0, 1.0, 0.0)).distance, 2.5, 1e-15);
  assert_close(kg_sdf_capsule(a, b, 0.5, kg_vec3_make(4.0, 6.0, 0.0)).distance, 4.5, 1e-15);
  assert_close(kg_sdf_capsule(a, b, 0.5, kg_vec3_make(1.0, -3.0, 0.0)).distance, 2.5, 1e-15);
  const kg_vec3 half = {1.0, 2.0, 3.0}, zero = {0.0, 0.0, 0.0};
  const kg_quat none = kg_quat_identity();
  assert_close(kg_sdf_box(zero, none, half, kg_vec3_make(2.0, 3.0, 4.0)).distance, sqrt(3.0),
               1e-15);
  assert_close(kg_sdf_box(zero, none, half, kg_vec3_make(0.9, 1.0, 0.0)).distance, -0.1, 1e-15);
}

/* On the skeleton itself there is no gradient, but still a unit normal along which Phi grows. */
static void special_points_have_a_usable_normal(void **state)
{
  (void)state;
  for (int k = 1; k < SOME_SHAPES; k++) {
    const kg_sdf_shape shape = some_shape(k);
    const kg_scene scene = scene_of(shape);
    const kg_vec3 middle = kg_vec3_lerp(shape.a, shape.b, 0.5);
    const kg_vec3 points[] = {shape.a, shape.kind == KG_SHAPE_CAPSULE ? shape.b : shape.a,
                              shape.kind == KG_SHAPE_CAPSULE ? middle : shape.a};
    for (size_t i = 0; i < KG_COUNT_OF(points); i++) {
      const kg_sdf_value v = kg_scene_distance(&scene, points[i]);
      assert_close(kg_vec3_norm(v.normal), 1.0, 1e-12);
      const kg_vec3 further = kg_vec3_add_scaled(points[i], 1e-3, v.normal);
      assert_close(kg_scene_distance(&scene, further).distance, v.distance + 1e-3, 1e-9);
      for (int c = 0; c < 6; c++) {
        assert_true(isfinite(v.hessian[c]));
      }
    }
  }
}

static void scene_is_the_union_of_its_shapes(void **state)
{
  (void)state;
  kg_scene scene = kg_scene_ground(0.1, kg_vec3_make(0.0, 5.0, 0.0));
  assert_close(kg_scene_distance(&scene, kg_vec3_make(3.0, 0.3, 1.0)).distance, 0.2, 1e-15);
  for (int k = 0; k < SOME_SHAPES; k++) {
    const kg_sdf_shape shape = some_shape(k);
    assert_true(kg_scene_add(&scene, &shape));
  }
  kg_random random = kg_random_make(15);
  for (int i = 0; i < 1000; i++) {
    const kg_vec3 x = random_vec3(&random, 1.0);
    double least = x.y - 0.1;
    for (int k = 0; k < SOME_SHAPES; k++) {
      const kg_scene one = scene_of(some_shape(k));
      least = fmin(least, kg_scene_distance(&one, x).distance);
    }
    assert_close(kg_scene_distance(&scene, x).distance, least, 1e-15);
  }
  const kg_sdf_shape ball = some_shape(1);
  while (scene.shape_count < KG_SCENE_MAX_SHAPES) {
    assert_true(kg_scene_add(&scene, &ball));
  }
  assert_false(kg_scene_add(&scene, &ball));
  assert_int_equal(scene.shape_count, KG_SCENE_MAX_SHAPES);
  const kg_scene empty = {0};
  assert_true(kg_scene_distance(&empty, ball.a).distance == INFINITY);
  assert_true(isnan(kg_scene_distance(&scene, kg_vec3_make(NAN, 0.0, 0.0)).distance));
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(gradient_and_hessian_match_differences),
    cmocka_unit_test(distances_have_lipschitz_constant_one),
    cmocka_unit_test(closest_point_lies_on_the_surface),
    cmocka_unit_test(box_agrees_with_its_sampled_surface),
    cmocka_unit_test(shapes_have_their_closed_forms),
    cmocka_unit_test(special_points_have_a_usable_normal),
    cmocka_unit_test(scene_is_the_union_of_its_shapes),
  };
  return cmocka_run_group_tests_name("shapes", tests, NULL, NULL);
}
