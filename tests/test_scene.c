/* Scenes: combinations against sampled surfaces, places against moved points and differences in time,
 * limits and balls against asking every shape. */
#include "sdf_support.h"

enum { SIDE = 5 };

static kg_sdf_value scene_phi(kg_vec3 x, const void *user)
{
  return kg_scene_distance(user, x);
}

/* ---- combinations ------------------------------------------------------------------------------ */

/* shapes 0 and 1, and 2: their combination */
static kg_scene combination(kg_shape_kind kind, double radius)
{
  const kg_sdf_shape parts[] = {
    {.kind = KG_SHAPE_SPHERE, .a = {-0.1, 0.05, 0.0}, .radius = 0.4},
    {.kind = KG_SHAPE_ELLIPSOID,
     .a = {0.25, 0.0, 0.1},
     .b = {0.5, 0.3, 0.25},
     .orientation = kg_quat_exp(kg_vec3_make(0.2, 0.5, -0.4))},
    {.kind = kind, .radius = radius, .children = {0, 1}},
  };
  kg_scene scene = {0};
  for (int k = 0; k < 3; k++) {
    assert_true(kg_scene_add(&scene, &parts[k]));
  }
  return scene;
}

static double part_distance(const kg_scene *scene, int k, kg_vec3 x)
{
  kg_sdf_value v;
  assert_true(kg_scene_shape_distance(scene, k, x, INFINITY, &v));
  return v.distance;
}

/* Point k of n spread evenly over a part's surface */
static kg_vec3 surface_point(const kg_scene *scene, int part, int k, int n)
{
  const kg_sdf_shape *s = &scene->shapes[part];
  const double h = 1.0 - 2.0 * (k + 0.5) / n, a = 2.39996322972865332 * k, r = sqrt(1.0 - h * h);
  const kg_vec3 unit = kg_vec3_make(r * cos(a), h, r * sin(a));
  if (part == 0) return kg_vec3_add_scaled(s->a, s->radius, unit);
  const kg_vec3 p = kg_vec3_make(s->b.x * unit.x, s->b.y * unit.y, s->b.z * unit.z);
  return kg_vec3_add(s->a, kg_quat_rotate(s->orientation, p));
}

/* whether a point of A's (part 0) or B's surface belongs to that of the combination */
static bool belongs(const kg_scene *scene, int part, kg_vec3 c)
{
  const kg_shape_kind kind = scene->shapes[2].kind;
  const double other = part_distance(scene, 1 - part, c);
  if (kind == KG_SHAPE_UNION) return other >= 0.0;
  if (kind == KG_SHAPE_INTERSECTION) return other <= 0.0;
  return part == 0 ? other >= 0.0 : other <= 0.0;
}

static void combinations_are_exact_where_they_say_and_bounds_elsewhere(void **state)
{
  (void)state;
  enum { COUNT = 20000, POINTS = 60 };
  static kg_vec3 surface[2 * COUNT];
  const kg_shape_kind kinds[] = {KG_SHAPE_UNION, KG_SHAPE_INTERSECTION, KG_SHAPE_DIFFERENCE};
  kg_random random = kg_random_make(91);
  for (size_t k = 0; k < KG_COUNT_OF(kinds); k++) {
    const kg_scene scene = combination(kinds[k], 0.0);
    int count = 0, exact = 0, loose = 0;
    for (int i = 0; i < 2 * COUNT; i++) {
      const kg_vec3 c = surface_point(&scene, i % 2, i / 2, COUNT);
      if (belongs(&scene, i % 2, c)) surface[count++] = c;
    }
    for (int i = 0; i < POINTS; i++) {
      const kg_vec3 x = random_vec3(&random, i % 2 ? 0.15 : 0.4);
      const double a = part_distance(&scene, 0, x), b = part_distance(&scene, 1, x);
      const double phi = kg_scene_distance(&scene, x).distance;
      double best = INFINITY;
      for (int j = 0; j < count; j++) {
        best = fmin(best, kg_vec3_norm(kg_vec3_sub(x, surface[j])));
      }
      const bool inside = kinds[k] == KG_SHAPE_UNION          ? a < 0.0 || b < 0.0
                          : kinds[k] == KG_SHAPE_INTERSECTION ? a < 0.0 && b < 0.0
                                                              : a < 0.0 && b > 0.0;
      assert_true((phi < 0.0) == inside);
      assert_at_most(fabs(phi), best + 1e-12);
      const bool is_exact = kinds[k] == KG_SHAPE_UNION ? !(a < 0.0 && b < 0.0) : inside;
      const double gap = best - fabs(phi);
      if (is_exact) assert_at_most(gap, 0.012); /* points of the surface are that far apart */
      exact += is_exact;
      loose += !is_exact && gap > 0.02;
    }
    assert_true(exact > 5 && loose > 0);
  }
}

static void smooth_union_is_the_union_away_from_the_blend(void **state)
{
  (void)state;
  const double r = 0.15;
  const kg_scene smooth = combination(KG_SHAPE_SMOOTH_UNION, r);
  const kg_scene sharp = combination(KG_SHAPE_UNION, 0.0);
  kg_random random = kg_random_make(92);
  int blended = 0;
  for (int i = 0; i < 3000; i++) {
    const kg_vec3 x = random_vec3(&random, 0.5);
    const double a = part_distance(&smooth, 0, x), b = part_distance(&smooth, 1, x);
    const kg_sdf_value v = kg_scene_distance(&smooth, x), w = kg_scene_distance(&sharp, x);
    const double h = fmax(r - fabs(a - b), 0.0) / r;
    assert_close(v.distance, w.distance - r / 6.0 * h * h * h, 1e-15);
    if (h == 0.0) {
      assert_memory_equal(&v, &w, sizeof v);
    } else {
      blended++;
      assert_at_most(kg_vec3_norm(v.normal), 1.0 + 1e-12);
      assert_at_most(v.distance, w.distance);
    }
    const kg_vec3 y = kg_vec3_add(x, random_vec3(&random, 0.1));
    assert_at_most(fabs(v.distance - kg_scene_distance(&smooth, y).distance),
                   kg_vec3_norm(kg_vec3_sub(x, y)) * (1.0 + 1e-12));
  }
  assert_true(blended > 300);
}

/* C2 also where A = B and at the border of the blend */
static void slopes_of_combinations_match_differences(void **state)
{
  (void)state;
  const kg_shape_kind kinds[] = {KG_SHAPE_UNION, KG_SHAPE_INTERSECTION, KG_SHAPE_DIFFERENCE,
                                 KG_SHAPE_SMOOTH_UNION};
  kg_random random = kg_random_make(93);
  for (size_t k = 0; k < KG_COUNT_OF(kinds); k++) {
    const kg_scene scene = combination(kinds[k], 0.3);
    int checked = 0, blended = 0;
    for (int i = 0; i < 1500; i++) {
      const kg_vec3 x = random_vec3(&random, 0.4);
      const double a = part_distance(&scene, 0, x), b = part_distance(&scene, 1, x);
      if (a < -0.25 || b < -0.1) continue; /* near the centres differences lose their digits */
      const bool was = check_slopes(scene_phi, &scene, x, 2e-4, 3e-4);
      checked += was;
      blended += was && fabs(a - b) < 0.3;
    }
    assert_true(checked > 500 && blended > 100);
  }
}

static void smooth_union_has_a_continuous_hessian(void **state)
{
  (void)state;
  const double r = 0.2;
  const kg_scene scene = combination(KG_SHAPE_SMOOTH_UNION, r);
  kg_random random = kg_random_make(94);
  int found = 0;
  for (int i = 0; i < 400; i++) {
    kg_vec3 x = random_vec3(&random, 0.5), y = random_vec3(&random, 0.5);
    const double want = i % 3 == 0 ? 0.0 : i % 3 == 1 ? r : -r; /* of A - B, between x and y */
    const double at_x = part_distance(&scene, 0, x) - part_distance(&scene, 1, x) - want;
    if (at_x * (part_distance(&scene, 0, y) - part_distance(&scene, 1, y) - want) >= 0.0) continue;
    for (int k = 0; k < 50; k++) { /* bisection */
      const kg_vec3 z = kg_vec3_lerp(x, y, 0.5);
      const double at_z = part_distance(&scene, 0, z) - part_distance(&scene, 1, z) - want;
      *(at_x * at_z > 0.0 ? &x : &y) = z;
    }
    if (part_distance(&scene, 1, x) < -0.05) continue; /* the ellipsoid's own kinks */
    const kg_vec3 e = kg_vec3_scale(1e-7, kg_vec3_normalized(random_vec3(&random, 1.0)));
    const kg_sdf_value v = kg_scene_distance(&scene, kg_vec3_add(x, e));
    const kg_sdf_value w = kg_scene_distance(&scene, kg_vec3_sub(x, e));
    for (int k = 0; k < 6; k++) {
      assert_close(v.hessian[k], w.hessian[k], 1e-4);
    }
    found++;
  }
  assert_true(found > 50);
}

/* ---- places ------------------------------------------------------------------------------------ */

typedef struct world {
  kg_mesh *mesh;
  kg_height_field *field;
} world;

static world make_world(void)
{
  const kg_vec3 corners[4] = {
    {-0.4, -0.3, -0.2}, {0.5, -0.2, -0.3}, {0.0, 0.6, 0.1}, {0.1, -0.1, 0.5}};
  const int faces[12] = {0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3};
  double heights[SIDE * SIDE];
  for (int k = 0; k < SIDE * SIDE; k++) {
    heights[k] = 0.1 * sin(1.7 * k);
  }
  world w = {0};
  assert_int_equal(kg_mesh_create(&w.mesh, corners, 4, faces, 4, NULL, NULL, NULL), KG_OK);
  assert_int_equal(
    kg_height_field_create(&w.field, heights, SIDE, SIDE, 0.3, kg_vec3_make(-0.6, 0.0, -0.6), NULL),
    KG_OK);
  return w;
}

static void free_world(world *w)
{
  kg_mesh_destroy(w->mesh);
  kg_height_field_destroy(w->field);
}

enum { KINDS = KG_SHAPE_CYLINDER + 1 };

/* one of every simple kind */
static kg_sdf_shape of_kind(const world *w, int kind)
{
  kg_sdf_shape s = {.kind = (kg_shape_kind)kind,
                    .a = {0.1, 0.05, -0.1},
                    .b = {0.3, 0.25, 0.2},
                    .radius = 0.2,
                    .orientation = kg_quat_exp(kg_vec3_make(0.1, 0.4, -0.2)),
                    .mesh = w->mesh,
                    .field = w->field};
  if (s.kind == KG_SHAPE_PLANE) s.b = kg_vec3_normalized(s.b);
  return s;
}

static kg_place some_place(kg_random *random)
{
  return (kg_place){.at = random_vec3(random, 0.5),
                    .turn = random_quat(random),
                    .velocity = random_vec3(random, 1.0),
                    .spin = random_vec3(random, 2.0)};
}

static kg_scene placed(const kg_sdf_shape *shape, const kg_place *place)
{
  kg_scene scene = {0};
  kg_sdf_shape in_place = *shape;
  in_place.place = kg_scene_add_place(&scene, place);
  assert_int_equal(in_place.place, 1);
  assert_true(kg_scene_add(&scene, &in_place));
  return scene;
}

static void a_place_moves_every_kind_of_shape(void **state)
{
  (void)state;
  world w = make_world();
  kg_random random = kg_random_make(95);
  for (int kind = 0; kind < KINDS; kind++) {
    const kg_sdf_shape shape = of_kind(&w, kind);
    kg_scene still = {0};
    assert_true(kg_scene_add(&still, &shape));
    int checked = 0;
    for (int i = 0; i < 200; i++) {
      const kg_place place = some_place(&random);
      const kg_scene scene = placed(&shape, &place);
      const kg_vec3 x = random_vec3(&random, 0.7);
      const kg_vec3 back = kg_quat_rotate(kg_quat_conj(place.turn), kg_vec3_sub(x, place.at));
      const kg_sdf_value here = kg_scene_distance(&still, back);
      const kg_sdf_value there = kg_scene_distance(&scene, x);
      assert_close(there.distance, here.distance, 1e-13);
      const kg_vec3 turned = kg_quat_rotate(place.turn, here.normal);
      assert_at_most(kg_vec3_norm(kg_vec3_sub(turned, there.normal)), 1e-9);
      double bend = 0.0;
      for (int c = 0; c < 6; c++) {
        bend = fmax(bend, fabs(here.hessian[c]));
      }
      if (bend < 10.0) checked += check_derivatives(scene_phi, &scene, x, 2e-4, 2e-5);
    }
    assert_true(checked > 80);
  }
  free_world(&w);
}

static kg_place after(const kg_place *place, double t)
{
  kg_place out = *place;
  out.at = kg_vec3_add_scaled(place->at, t, place->velocity);
  out.turn = kg_quat_mul(kg_quat_exp(kg_vec3_scale(t, place->spin)), place->turn);
  return out;
}

/* dPhi/dt of a point at rest is -n . velocity of the surface. */
static void velocity_is_that_of_the_surface(void **state)
{
  (void)state;
  world w = make_world();
  kg_random random = kg_random_make(96);
  for (int kind = 0; kind < KINDS; kind++) {
    const kg_sdf_shape shape = of_kind(&w, kind);
    int checked = 0;
    for (int i = 0; i < 60; i++) {
      const kg_place place = some_place(&random);
      const kg_vec3 x = random_vec3(&random, 0.7);
      kg_scene scene = placed(&shape, &place);
      const kg_scene_point at = kg_scene_nearest(&scene, x);
      assert_int_equal(at.shape, 0);
      double phi[4];
      const double h = 1e-4, times[4] = {-2.0 * h, -h, h, 2.0 * h};
      bool kink = false;
      for (int k = 0; k < 4; k++) {
        const kg_place moved = after(&place, times[k]);
        kg_scene_move(&scene, 1, moved.at, moved.turn, moved.velocity, moved.spin);
        const kg_sdf_value v = kg_scene_distance(&scene, x);
        kink = kink || kg_vec3_norm(kg_vec3_sub(v.normal, at.value.normal)) > 0.01;
        phi[k] = v.distance;
      }
      if (kink) continue;
      const double rate = richardson(phi[0], phi[1], phi[2], phi[3], h);
      assert_close(rate, -kg_vec3_dot(at.value.normal, at.velocity), 1e-6);
      checked++;
    }
    assert_true(checked > 30);
  }
  free_world(&w);
}

static void a_shape_in_the_world_is_at_rest_and_hard(void **state)
{
  (void)state;
  const kg_scene scene = kg_scene_ground(0.1, kg_vec3_make(0.0, 1.0, 0.0));
  const kg_scene_point at = kg_scene_nearest(&scene, kg_vec3_make(3.0, 0.3, 1.0));
  assert_int_equal(at.shape, 0);
  assert_true(at.ground == NULL && kg_vec3_norm(at.velocity) == 0.0);
  const kg_scene empty = {0};
  assert_int_equal(kg_scene_nearest(&empty, at.velocity).shape, -1);
  assert_true(kg_scene_surface(&empty, at.velocity) == INFINITY);
}

/* ---- many shapes ------------------------------------------------------------------------------- */

static kg_scene crowded(const world *w, kg_random *random)
{
  kg_scene scene = kg_scene_ground(-0.5, kg_vec3_make(0.1, 1.0, 0.0));
  for (int k = 0; k < 40; k++) {
    const kg_place place = some_place(random);
    assert_int_equal(kg_scene_add_place(&scene, &place), k + 1);
  }
  const kg_ground grounds[] = {{.thickness = 0.05, .stiffness = 1e4, .friction = 0.5},
                               {.thickness = 0.2, .stiffness = 1e3, .friction = -1.0}};
  assert_int_equal(kg_scene_add_ground(&scene, &grounds[0]), 1);
  assert_int_equal(kg_scene_add_ground(&scene, &grounds[1]), 2);
  while (scene.shape_count < KG_SCENE_MAX_SHAPES - 8) {
    const int n = scene.shape_count;
    const int small[] = {KG_SHAPE_SPHERE, KG_SHAPE_BOX, KG_SHAPE_CAPSULE, KG_SHAPE_ELLIPSOID,
                         KG_SHAPE_CYLINDER};
    kg_sdf_shape s = of_kind(w, n == 30  ? KG_SHAPE_HEIGHT_FIELD
                                : n % 31 ? small[n % 5]
                                         : KG_SHAPE_MESH);
    s.a = random_vec3(random, 0.3);
    s.radius = 0.02 + 0.1 * kg_random_uniform(random);
    if (s.kind != KG_SHAPE_CAPSULE && s.kind != KG_SHAPE_CYLINDER) {
      s.b = kg_vec3_make(0.02 + 0.1 * kg_random_uniform(random), 0.1, 0.05);
    } else {
      s.b = random_vec3(random, 0.3);
    }
    s.place = n % 41;
    s.ground = n % 3;
    if (n == 30) s.place = 0;
    s.offset = n == 30 ? -0.8 : n % 4 == 0 ? 0.02 : n % 4 == 1 ? -0.01 : 0.0;
    assert_true(kg_scene_add(&scene, &s));
  }
  for (int k = 0; k < 8; k++) {
    const kg_sdf_shape s = {.kind = (kg_shape_kind)(KG_SHAPE_UNION + k % 4),
                            .radius = 0.1,
                            .children = {10 + 2 * k, 11 + 2 * k},
                            .place = 3 * k,
                            .ground = k % 3};
    assert_true(kg_scene_add(&scene, &s));
  }
  assert_int_equal(scene.shape_count, KG_SCENE_MAX_SHAPES);
  return scene;
}

static void limits_and_balls_change_nothing(void **state)
{
  (void)state;
  world w = make_world();
  kg_random random = kg_random_make(97);
  const kg_scene scene = crowded(&w, &random);
  int seen[KG_SCENE_MAX_SHAPES] = {0};
  for (int i = 0; i < 3000; i++) {
    const kg_vec3 x = random_vec3(&random, 0.6);
    double least = INFINITY, surface = INFINITY;
    int nearest = -1;
    for (int k = 0; k < scene.shape_count; k++) {
      kg_sdf_value v;
      const kg_sdf_shape *s = &scene.shapes[k];
      if (s->part) continue;
      assert_true(kg_scene_shape_distance(&scene, k, x, INFINITY, &v));
      if (v.distance < least) nearest = k;
      least = fmin(least, v.distance);
      const double soft = s->ground ? scene.grounds[s->ground - 1].thickness : 0.0;
      surface = fmin(surface, v.distance - soft);
      kg_sdf_value same;
      const double limit = 0.2 * kg_random_normal(&random);
      const bool near = kg_scene_shape_distance(&scene, k, x, limit, &same);
      assert_true(near == (v.distance <= limit));
      if (near) assert_true(same.distance == v.distance);
    }
    const kg_scene_point at = kg_scene_nearest(&scene, x);
    assert_true(at.value.distance == least && at.shape == nearest);
    assert_true(kg_scene_distance(&scene, x).distance == least);
    assert_true(kg_scene_surface(&scene, x) == surface);
    const int ground = scene.shapes[nearest].ground;
    assert_true(at.ground == (ground ? &scene.grounds[ground - 1] : NULL));
    seen[nearest]++;
  }
  int different = 0;
  for (int k = 0; k < KG_SCENE_MAX_SHAPES; k++) {
    different += seen[k] > 0;
  }
  assert_true(different > 40);
  free_world(&w);
}

/* The same bits, wherever the search begins. */
static void hints_change_nothing(void **state)
{
  (void)state;
  world w = make_world();
  kg_random random = kg_random_make(98);
  kg_scene scene = crowded(&w, &random);
  const kg_sdf_shape twin = scene.shapes[0]; /* equally near: the first counts */
  scene.shapes[40] = twin;
  scene.shapes[40].ground = 1;
  kg_scene_hint hint = {-1, {-1}};
  kg_vec3 x = random_vec3(&random, 0.5);
  int kept = 0;
  for (int i = 0; i < 4000; i++) {
    if (i % 50 == 0) x = random_vec3(&random, 0.5);
    if (i % 31 == 0) hint = (kg_scene_hint){40, {-1}};
    if (i % 97 == 0) hint = (kg_scene_hint){i % 120 - 5, {i % 11 - 3}}; /* nonsense */
    x = kg_vec3_add(x, random_vec3(&random, 0.01));
    const int before = hint.shape;
    const kg_sdf_value with = kg_scene_distance_from(&scene, x, &hint);
    const kg_scene_point without = kg_scene_nearest(&scene, x);
    assert_memory_equal(&with, &without.value, sizeof with);
    assert_int_equal(hint.shape, without.shape);
    kept += before == hint.shape;
  }
  assert_true(kept > 2000 && kept < 4000);
  const kg_scene plane = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  assert_close(kg_scene_distance_from(&plane, kg_vec3_make(1, 2, 3), &hint).distance, 2.0, 1e-15);
  free_world(&w);
}

static void an_offset_rounds(void **state)
{
  (void)state;
  const kg_sdf_shape box = {.kind = KG_SHAPE_BOX, .b = {0.3, 0.2, 0.1}, .offset = 0.05};
  kg_scene scene = {0};
  assert_true(kg_scene_add(&scene, &box));
  const kg_vec3 corner = kg_vec3_make(0.3 + 0.3, 0.2 + 0.2, 0.1 + 0.1);
  assert_close(kg_scene_distance(&scene, corner).distance, sqrt(0.14) - 0.05, 1e-15);
  kg_sdf_value v;
  assert_false(kg_scene_shape_distance(&scene, 0, corner, sqrt(0.14) - 0.051, &v));
  assert_true(kg_scene_shape_distance(&scene, 0, corner, sqrt(0.14) - 0.049, &v));
}

static void a_full_scene_refuses(void **state)
{
  (void)state;
  kg_scene scene = {0};
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .radius = 0.1};
  const kg_place place = {.at = {1.0, 0.0, 0.0}};
  const kg_ground ground = kg_ground_default();
  for (int k = 0; k < KG_SCENE_MAX_SHAPES; k++) {
    assert_true(kg_scene_add(&scene, &ball));
  }
  for (int k = 0; k < KG_SCENE_MAX_PLACES; k++) {
    assert_int_equal(kg_scene_add_place(&scene, &place), k + 1);
  }
  for (int k = 0; k < KG_SCENE_MAX_GROUNDS; k++) {
    assert_int_equal(kg_scene_add_ground(&scene, &ground), k + 1);
  }
  assert_false(kg_scene_add(&scene, &ball));
  assert_int_equal(kg_scene_add_place(&scene, &place), 0);
  assert_int_equal(kg_scene_add_ground(&scene, &ground), 0);
  kg_ground bad = ground;
  bad.thickness = -1.0;
  assert_false(kg_ground_is_valid(&bad));
  bad = ground;
  bad.stiffness = INFINITY;
  assert_false(kg_ground_is_valid(&bad));
  assert_true(kg_ground_is_valid(&ground));
}

/* Where two shapes are equally near the first counts, whatever the hint says. */
static void of_equals_the_first_counts(void **state)
{
  (void)state;
  kg_random random = kg_random_make(94);
  const kg_shape_kind kinds[] = {KG_SHAPE_SPHERE, KG_SHAPE_CAPSULE, KG_SHAPE_CYLINDER,
                                 KG_SHAPE_ELLIPSOID};
  int equals = 0;
  for (int k = 0; k < 4000; k++) {
    const double a = 0.5 + kg_random_uniform(&random),
                 radius = 0.05 + 0.3 * kg_random_uniform(&random);
    kg_sdf_shape left = {.kind = kinds[k % 4], .a = {-a, 0.0, 0.0}, .radius = radius};
    left.b = k % 4 == 3 ? kg_vec3_make(radius, radius, 2.0 * radius) : kg_vec3_make(-a, 0.5, 0.0);
    kg_sdf_shape right = left;
    right.a.x = a;
    right.b.x = k % 4 == 3 ? radius : a;
    kg_scene scene = {0};
    if (k % 8 > 3) { /* in places */
      const kg_place place[2] = {{.at = {-2.0, 0.0, 0.0}}, {.at = {2.0, 0.0, 0.0}}};
      left.place = kg_scene_add_place(&scene, &place[0]);
      right.place = kg_scene_add_place(&scene, &place[1]);
    }
    assert_true(kg_scene_add(&scene, &left) && kg_scene_add(&scene, &right));
    const kg_vec3 x = {0.0, 2.0 * kg_random_uniform(&random) - 1.0, kg_random_uniform(&random)};
    const kg_sdf_value plain = kg_scene_distance(&scene, x);
    for (int first = -1; first < 2; first++) {
      kg_scene_hint hint = {first, {-1}};
      const kg_sdf_value hinted = kg_scene_distance_from(&scene, x, &hint);
      assert_memory_equal(&hinted, &plain, sizeof plain);
    }
    equals += plain.distance == part_distance(&scene, 0, x) &&
              plain.distance == part_distance(&scene, 1, x);
  }
  assert_true(equals > 3000);
}

/* What an offset and a blend add to the outside counts in the ball around a place. */
static void balls_hold_what_sticks_out(void **state)
{
  (void)state;
  kg_scene scene = {0};
  const kg_place rest = {.at = {0.0, 0.0, 0.0}};
  const int first = kg_scene_add_place(&scene, &rest), second = kg_scene_add_place(&scene, &rest);
  const kg_sdf_shape shapes[] = {
    {.kind = KG_SHAPE_SPHERE, .radius = 0.2, .offset = 0.5, .place = first},
    {.kind = KG_SHAPE_SPHERE, .radius = 0.2},
    {.kind = KG_SHAPE_SPHERE, .radius = 0.2},
    {.kind = KG_SHAPE_SMOOTH_UNION, .children = {1, 2}, .radius = 0.6, .place = second},
  };
  for (size_t k = 0; k < KG_COUNT_OF(shapes); k++) {
    assert_true(kg_scene_add(&scene, &shapes[k]));
  }
  kg_sdf_value v;
  assert_true(kg_scene_shape_distance(&scene, 0, kg_vec3_make(0.8, 0.0, 0.0), 0.2, &v));
  assert_close(v.distance, 0.1, 1e-14);
  assert_true(kg_scene_shape_distance(&scene, 3, kg_vec3_make(0.32, 0.0, 0.0), 0.05, &v));
  assert_close(v.distance, 0.02, 1e-14); /* 0.6 / 6 further out than its parts */
  kg_scene plane = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  plane.shapes[0].offset = 0.1;
  assert_close(kg_scene_distance(&plane, kg_vec3_make(0.0, 0.3, 0.0)).distance, 0.2, 1e-15);
  assert_close(kg_scene_nearest(&plane, kg_vec3_make(0.0, 0.3, 0.0)).value.distance, 0.2, 1e-15);
}

/* The ball around a combination must hold a part that has moved since it was added. */
static void parts_that_move_are_found(void **state)
{
  (void)state;
  kg_scene scene = {0};
  const kg_place rest = {.turn = {1.0, 0.0, 0.0, 0.0}};
  const kg_vec3 zero = {0.0, 0.0, 0.0};
  const int whole = kg_scene_add_place(&scene, &rest), own = kg_scene_add_place(&scene, &rest);
  const kg_sdf_shape shapes[] = {
    {.kind = KG_SHAPE_SPHERE, .a = {6.5, 0.0, 0.0}, .radius = 0.5},
    {.kind = KG_SHAPE_SPHERE, .radius = 0.2, .place = own},
    {.kind = KG_SHAPE_SPHERE, .radius = 0.1},
    {.kind = KG_SHAPE_UNION, .children = {1, 2}, .place = whole},
  };
  for (size_t k = 0; k < KG_COUNT_OF(shapes); k++) {
    assert_true(kg_scene_add(&scene, &shapes[k]));
  }
  kg_scene_move(&scene, own, kg_vec3_make(5.0, 0.0, 0.0), kg_quat_identity(), zero, zero);
  const kg_vec3 x = {5.1, 0.0, 0.0};
  kg_sdf_value v;
  assert_true(kg_scene_shape_distance(&scene, 3, x, 0.5, &v));
  assert_close(v.distance, -0.1, 1e-14);
  assert_close(kg_scene_distance(&scene, x).distance, -0.1, 1e-14);
}

/* A shape that is nowhere is not far away, whichever comes first. */
static void what_is_not_a_number_is_not_far_away(void **state)
{
  (void)state;
  const kg_sdf_shape shapes[2] = {
    {.kind = KG_SHAPE_SPHERE, .a = {NAN, 0.0, 0.0}, .radius = 1.0},
    {.kind = KG_SHAPE_SPHERE, .radius = 1.0},
  };
  const kg_ground soft = {0.02, 1e4, 0.5, -1.0};
  const kg_vec3 x = {0.0, 3.0, 0.0};
  for (int k = 0; k < 2; k++) {
    kg_scene scene = {0};
    assert_true(kg_scene_add(&scene, &shapes[k]) && kg_scene_add(&scene, &shapes[1 - k]));
    assert_true(isnan(kg_scene_distance(&scene, x).distance));
    for (int first = -1; first < 2; first++) {
      kg_scene_hint hint = {first, {-1}};
      assert_true(isnan(kg_scene_distance_from(&scene, x, &hint).distance));
    }
    assert_int_equal(kg_scene_add_ground(&scene, &soft), 1);
    assert_true(isnan(kg_scene_surface(&scene, x)));
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(combinations_are_exact_where_they_say_and_bounds_elsewhere),
    cmocka_unit_test(smooth_union_is_the_union_away_from_the_blend),
    cmocka_unit_test(slopes_of_combinations_match_differences),
    cmocka_unit_test(smooth_union_has_a_continuous_hessian),
    cmocka_unit_test(a_place_moves_every_kind_of_shape),
    cmocka_unit_test(velocity_is_that_of_the_surface),
    cmocka_unit_test(a_shape_in_the_world_is_at_rest_and_hard),
    cmocka_unit_test(limits_and_balls_change_nothing),
    cmocka_unit_test(hints_change_nothing),
    cmocka_unit_test(an_offset_rounds),
    cmocka_unit_test(a_full_scene_refuses),
    cmocka_unit_test(of_equals_the_first_counts),
    cmocka_unit_test(balls_hold_what_sticks_out),
    cmocka_unit_test(parts_that_move_are_found),
    cmocka_unit_test(what_is_not_a_number_is_not_far_away),
  };
  return cmocka_run_group_tests_name("scene", tests, NULL, NULL);
}
