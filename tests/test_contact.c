/* The contact law against its definition, its derivatives against differences, and the kinks. */
#include "support.h"

#include "kinegrad/contact.h"

typedef struct probe {
  kg_contact_params params;
  kg_scene scene;
} probe;

static kg_contact_force evaluate(const probe *c, kg_vec3 x, kg_vec3 u)
{
  kg_contact_force f;
  (void)kg_contact_evaluate(&c->params, &c->scene, x, u, true, &f);
  return f;
}

static probe on_plane(void)
{
  return (probe){kg_contact_default_params(), kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0))};
}

static probe on_ball(void)
{
  probe c = {kg_contact_default_params(), {.shape_count = 0}};
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .a = {0.1, -0.2, 0.3}, .radius = 0.25};
  assert_true(kg_scene_add(&c.scene, &ball));
  return c;
}

/* point at distance phi of the ball's surface in a given direction */
static kg_vec3 near_ball(const probe *c, kg_vec3 direction, double phi)
{
  const kg_sdf_shape *ball = &c->scene.shapes[0];
  return kg_vec3_add_scaled(ball->a, ball->radius + phi, kg_vec3_normalized(direction));
}

static void law_has_the_stated_values(void **state)
{
  (void)state;
  const probe c = on_plane();
  const kg_vec3 still = {0.0, 0.0, 0.0};
  const double L = c.params.layer;
  const double shares[] = {0.9, 0.5, 0.382, 0.1, 0.03};
  for (size_t k = 0; k < KG_COUNT_OF(shares); k++) {
    const double phi = shares[k] * L;
    const kg_contact_force f = evaluate(&c, kg_vec3_make(2.0, phi, -1.0), still);
    assert_close(f.f.y, c.params.force * (L - phi) * (L - phi) / (L * phi), 1e-13);
    assert_true(f.f.x == 0.0 && f.f.z == 0.0 && f.normal == f.f.y);
    assert_close(f.distance, phi, 1e-15);
  }
  const double golden = 0.5 * (3.0 - sqrt(5.0)); /* 0.382: where the force is `force` */
  assert_close(evaluate(&c, kg_vec3_make(0.0, golden * L, 0.0), still).normal, c.params.force,
               1e-13);
  /* below the floor: the tangent */
  const double floor = c.params.floor_share * L;
  const double a = evaluate(&c, kg_vec3_make(0.0, floor, 0.0), still).normal;
  const double b = evaluate(&c, kg_vec3_make(0.0, 0.0, 0.0), still).normal;
  const double deep = evaluate(&c, kg_vec3_make(0.0, -floor, 0.0), still).normal;
  assert_close(deep - b, b - a, 1e-12);
  assert_true(b > a);
  /* outside: nothing at all */
  kg_contact_force f;
  assert_false(kg_contact_evaluate(&c.params, &c.scene, kg_vec3_make(0.0, L, 0.0),
                                   kg_vec3_make(1.0, -5.0, 0.0), true, &f));
  assert_true(f.normal == 0.0 && kg_vec3_norm(f.f) == 0.0 && f.df_du.m[0] == 0.0);
  assert_close(f.distance, L, 1e-15);
}

static void force_is_never_adhesive_and_stays_in_the_cone(void **state)
{
  (void)state;
  const probe c = on_ball();
  kg_random random = kg_random_make(21);
  for (int k = 0; k < 5000; k++) {
    const double phi = c.params.layer * (1.5 * kg_random_uniform(&random) - 0.5);
    const kg_vec3 x = near_ball(&c, random_vec3(&random, 1.0), phi);
    const double speed = pow(10.0, 6.0 * kg_random_uniform(&random) - 5.0);
    const kg_vec3 u = random_vec3(&random, speed);
    const kg_contact_force f = evaluate(&c, x, u);
    const double along = kg_vec3_dot(f.f, f.direction);
    const kg_vec3 tangent = kg_vec3_add_scaled(f.f, -along, f.direction);
    const kg_vec3 u_t = kg_vec3_add_scaled(u, -kg_vec3_dot(u, f.direction), f.direction);
    assert_true(f.normal >= 0.0);
    assert_close(along, f.normal, 1e-12);
    assert_at_most(kg_vec3_norm(tangent), c.params.friction * f.normal * (1.0 + 1e-12));
    assert_true(kg_vec3_dot(tangent, u_t) <= 0.0); /* takes energy away */
    if (kg_vec3_norm(u_t) > c.params.stick) {
      assert_close(kg_vec3_norm(tangent), c.params.friction * f.normal, 1e-10);
    }
  }
}

/* Largest relative error of df_dx and df_du against Richardson differences at one point. */
static double derivative_error(const probe *c, kg_vec3 x, kg_vec3 u, double hx, double hu)
{
  const kg_contact_force f = evaluate(c, x, u);
  double worst = 0.0;
  for (int part = 0; part < 2; part++) {
    const kg_mat3 *exact = part == 0 ? &f.df_dx : &f.df_du;
    const double h = part == 0 ? hx : hu;
    double size = 1e-9;
    for (int k = 0; k < 9; k++) {
      size = fmax(size, fabs(exact->m[k]));
    }
    for (int j = 0; j < 3; j++) {
      kg_vec3 slope = {0.0, 0.0, 0.0};
      for (int level = 0; level < 2; level++) {
        const double s = level == 0 ? h : 0.5 * h;
        const kg_vec3 e = {j == 0 ? s : 0.0, j == 1 ? s : 0.0, j == 2 ? s : 0.0};
        const kg_vec3 zero = {0.0, 0.0, 0.0};
        const kg_vec3 dx = part == 0 ? e : zero, du = part == 0 ? zero : e;
        const kg_vec3 plus = evaluate(c, kg_vec3_add(x, dx), kg_vec3_add(u, du)).f;
        const kg_vec3 minus = evaluate(c, kg_vec3_sub(x, dx), kg_vec3_sub(u, du)).f;
        slope = kg_vec3_add_scaled(slope, (level == 0 ? -1.0 : 4.0) / (6.0 * s),
                                   kg_vec3_sub(plus, minus));
      }
      const double d[3] = {slope.x, slope.y, slope.z};
      for (int i = 0; i < 3; i++) {
        worst = fmax(worst, fabs(d[i] - exact->m[3 * i + j]) / size);
      }
    }
  }
  return worst;
}

static void derivatives_match_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(22);
  const probe cases[] = {on_plane(), on_ball()};
  double worst = 0.0;
  for (int k = 0; k < 4000; k++) {
    const probe *c = &cases[k % 2];
    const double L = c->params.layer;
    const double phi = L * (1.2 * kg_random_uniform(&random) - 0.2);
    const kg_vec3 x =
      k % 2 == 0 ? kg_vec3_make(0.3, phi, 0.2) : near_ball(c, random_vec3(&random, 1.0), phi);
    const double speed = k % 3 == 0 ? 1e-4 : (k % 3 == 1 ? 1.0 : 0.02);
    const kg_vec3 u = random_vec3(&random, speed);
    const kg_contact_force f = evaluate(c, x, u);
    const double speed_n = kg_vec3_dot(u, f.direction);
    const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, f.direction);
    const double slip = kg_vec3_norm(u_t);
    const double hx = 0.01 * fmax(fabs(phi), 0.3 * c->params.floor_share * L);
    const double hu = 0.01 * fmin(slip, c->params.stick);
    /* differences must not straddle a kink: those have their own test */
    const double turn = 1.0 - c->params.damping * speed_n;
    const bool kink =
      fabs(phi - L) < 3.0 * hx || fabs(phi - c->params.floor_share * L) < 3.0 * hx ||
      fabs(slip - c->params.stick) < 0.05 * c->params.stick || fabs(fabs(turn) - 0.1) < 0.01;
    if (!kink && phi < L) {
      const double error = derivative_error(c, x, u, hx, hu);
      worst = fmax(worst, error);
      assert_at_most(error, 1e-6);
    }
  }
  print_message("contact derivatives against differences: %.1e\n", worst);
}

/* At a kink the derivative is continuous: the values on both sides agree to first order in the
 * distance to it, and the derivative stated there equals one-sided differences. */
static void assert_smooth_across(const probe *c, kg_vec3 x, kg_vec3 u, kg_vec3 dx, kg_vec3 du)
{
  const kg_contact_force at = evaluate(c, x, u);
  const double h = 1e-6;
  const kg_contact_force plus =
    evaluate(c, kg_vec3_add_scaled(x, h, dx), kg_vec3_add_scaled(u, h, du));
  const kg_contact_force minus =
    evaluate(c, kg_vec3_add_scaled(x, -h, dx), kg_vec3_add_scaled(u, -h, du));
  const kg_vec3 slope = kg_vec3_add(kg_mat3_mul_vec(at.df_dx, dx), kg_mat3_mul_vec(at.df_du, du));
  const kg_vec3 right = kg_vec3_scale(1.0 / h, kg_vec3_sub(plus.f, at.f));
  const kg_vec3 left = kg_vec3_scale(1.0 / h, kg_vec3_sub(at.f, minus.f));
  double size = 1.0;
  for (int k = 0; k < 9; k++) {
    size =
      fmax(size, fabs(at.df_dx.m[k]) * kg_vec3_norm(dx) + fabs(at.df_du.m[k]) * kg_vec3_norm(du));
    assert_at_most(fabs(plus.df_du.m[k] - minus.df_du.m[k]),
                   1e-3 * (fabs(at.df_du.m[k]) + kg_vec3_norm(at.f) / c->params.stick + 1.0));
    assert_at_most(fabs(plus.df_dx.m[k] - minus.df_dx.m[k]),
                   1e-3 * (fabs(at.df_dx.m[k]) + c->params.force / c->params.layer));
  }
  assert_at_most(kg_vec3_norm(kg_vec3_sub(right, slope)), 1e-3 * size);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(left, slope)), 1e-3 * size);
}

static void derivative_is_continuous_at_every_kink(void **state)
{
  (void)state;
  const probe c = on_plane();
  const double L = c.params.layer, stick = c.params.stick;
  const kg_vec3 none = {0.0, 0.0, 0.0};
  const kg_vec3 middle = {0.0, 0.5 * L, 0.0}, slow = {0.4 * stick, -0.1, 0.3 * stick};
  /* layer edge and floor share, crossed at right angles (in units of the layer) */
  assert_smooth_across(&c, kg_vec3_make(0.0, L, 0.0), slow, kg_vec3_make(0.0, L, 0.0), none);
  assert_smooth_across(&c, kg_vec3_make(0.0, c.params.floor_share * L, 0.0), slow,
                       kg_vec3_make(0.0, c.params.floor_share * L, 0.0), none);
  /* saturation of friction and zero slip (in units of the stick velocity) */
  assert_smooth_across(&c, middle, kg_vec3_make(0.6 * stick, 0.0, 0.8 * stick), none,
                       kg_vec3_make(0.6 * stick, 0.0, 0.8 * stick));
  assert_smooth_across(&c, middle, none, none, kg_vec3_make(stick, 0.0, 0.0));
  assert_smooth_across(&c, middle, none, none, kg_vec3_make(0.5 * stick, 0.0, -stick));
  /* both ends of the ramp */
  for (int side = -1; side <= 1; side += 2) {
    const double lift = (1.0 + 0.1 * side) / c.params.damping;
    assert_smooth_across(&c, middle, kg_vec3_make(slow.x, lift, slow.z), none,
                         kg_vec3_make(0.0, 0.1, 0.0));
  }
}

/* ---- soft and moving ground ------------------------------------------------------------------- */

static const kg_ground mat = {.thickness = 0.03, .stiffness = 2e4, .damping = 0.6, .friction = 0.5};

/* a plane under a mat */
static probe on_mat(void)
{
  probe c = {kg_contact_default_params(), {.shape_count = 0}};
  const kg_sdf_shape floor = {.kind = KG_SHAPE_PLANE, .b = {0.0, 1.0, 0.0}, .ground = 1};
  assert_int_equal(kg_scene_add_ground(&c.scene, &mat), 1);
  assert_true(kg_scene_add(&c.scene, &floor));
  return c;
}

/* a soft ellipsoid and a soft blend of two balls that move and turn */
static probe on_moving(bool blend)
{
  probe c = {kg_contact_default_params(), {.shape_count = 0}};
  const kg_place place = {.at = {0.1, 0.2, -0.1},
                          .turn = kg_quat_exp(kg_vec3_make(0.3, -0.2, 0.9)),
                          .velocity = {0.3, -0.2, 0.1},
                          .spin = {0.5, 0.8, -0.4}};
  assert_int_equal(kg_scene_add_ground(&c.scene, &mat), 1);
  assert_int_equal(kg_scene_add_place(&c.scene, &place), 1);
  const kg_sdf_shape shapes[] = {
    {.kind = KG_SHAPE_ELLIPSOID, .b = {0.4, 0.2, 0.3}, .place = 1, .ground = 1},
    {.kind = KG_SHAPE_SPHERE, .a = {-0.15, 0.0, 0.0}, .radius = 0.2},
    {.kind = KG_SHAPE_SPHERE, .a = {0.15, 0.0, 0.0}, .radius = 0.22},
    {.kind = KG_SHAPE_SMOOTH_UNION, .radius = 0.3, .children = {0, 1}, .place = 1, .ground = 1}};
  for (int k = blend ? 1 : 0; k < (blend ? 4 : 1); k++) {
    assert_true(kg_scene_add(&c.scene, &shapes[k]));
  }
  return c;
}

static void soft_law_has_the_stated_values(void **state)
{
  (void)state;
  const probe soft = on_mat(), hard = on_plane();
  const kg_vec3 still = {0.0, 0.0, 0.0};
  const double L = soft.params.layer, h = mat.thickness, k = mat.stiffness;
  const double depths[] = {0.1 * L, 0.5 * L, L, 2.0 * L, h, h + 0.5 * L, h + L, h + 1.5 * L};
  for (size_t i = 0; i < KG_COUNT_OF(depths); i++) {
    const double p = depths[i], phi = h + L - p;
    const double want = p < L ? k * p * p / (2.0 * L) : k * (p - 0.5 * L);
    const kg_contact_force f = evaluate(&soft, kg_vec3_make(2.0, phi, -1.0), still);
    const kg_contact_force bare = evaluate(&hard, kg_vec3_make(2.0, phi, -1.0), still);
    assert_close(f.f.y, want + bare.f.y, 1e-12);
    assert_close(f.distance, phi, 1e-15); /* from the core */
    assert_true(f.ground == &soft.scene.grounds[0]);
  }
  kg_contact_force f;
  assert_false(
    kg_contact_evaluate(&soft.params, &soft.scene, kg_vec3_make(0.0, h + L, 0.0), still, true, &f));
  /* both dampings, each with its own share; friction of the mat */
  const kg_vec3 u = {0.4, -0.05, 0.0};
  const double p = L + h - 0.5 * L;
  const kg_contact_force moving = evaluate(&soft, kg_vec3_make(0.0, 0.5 * L, 0.0), u);
  const kg_contact_force bare = evaluate(&hard, kg_vec3_make(0.0, 0.5 * L, 0.0), u);
  assert_close(moving.normal, bare.normal + k * (p - 0.5 * L) * (1.0 + 0.05 * mat.damping), 1e-12);
  assert_close(moving.f.x, -mat.friction * moving.normal, 1e-12);
}

/* 70 kg on ten points: as docs/theory/contact.md says */
static void a_body_stands_in_the_mat(void **state)
{
  (void)state;
  const probe c = on_mat();
  const double sunk = 0.5 * c.params.layer + 70.0 * 9.8 / 10.0 / mat.stiffness;
  const double phi = mat.thickness + c.params.layer - sunk;
  const kg_vec3 still = {0.0, 0.0, 0.0};
  assert_close(evaluate(&c, kg_vec3_make(0.0, phi, 0.0), still).normal, 68.6, 1e-12);
}

static void a_default_ground_is_the_hard_law(void **state)
{
  (void)state;
  probe covered = on_ball(), bare = on_ball();
  const kg_ground none = kg_ground_default();
  covered.scene.shapes[0].ground = kg_scene_add_ground(&covered.scene, &none);
  kg_random random = kg_random_make(24);
  for (int k = 0; k < 500; k++) {
    const double phi = covered.params.layer * (1.2 * kg_random_uniform(&random) - 0.2);
    const kg_vec3 x = near_ball(&bare, random_vec3(&random, 1.0), phi);
    const kg_vec3 u = random_vec3(&random, k % 2 ? 1.0 : 1e-4), f_bar = random_vec3(&random, 1.0);
    kg_contact_force a = evaluate(&covered, x, u);
    const kg_contact_force b = evaluate(&bare, x, u);
    double by_a[6] = {0.0}, by_b[6] = {0.0};
    if (a.normal > 0.0) {
      kg_contact_params_vjp(&covered.params, &a, u, f_bar, by_a);
      kg_contact_params_vjp(&bare.params, &b, u, f_bar, by_b);
    }
    a.ground = NULL;
    assert_memory_equal(&a, &b, sizeof a);
    assert_memory_equal(by_a, by_b, sizeof by_a);
  }
}

static void soft_moving_derivatives_match_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(25);
  const probe cases[] = {on_mat(), on_moving(false), on_moving(true)};
  double worst = 0.0;
  int checked = 0, blended = 0;
  for (int k = 0; k < 3000; k++) {
    const probe *c = &cases[k % 3];
    const double L = c->params.layer, h = mat.thickness;
    kg_vec3 x = random_vec3(&random, 0.5);
    kg_sdf_value at = kg_scene_distance(&c->scene, x);
    if (at.distance < 0.05) continue;
    const double phi = (L + h) * (1.1 * kg_random_uniform(&random) - 0.1);
    for (int i = 0; i < 20; i++) { /* in a blend Phi is not the distance */
      x = kg_vec3_add_scaled(x, phi - at.distance, kg_vec3_normalized(at.normal));
      at = kg_scene_distance(&c->scene, x);
    }
    assert_close(at.distance, phi, 1e-6);
    const kg_scene_point there = kg_scene_nearest(&c->scene, x);
    const kg_vec3 slow = random_vec3(&random, k % 2 ? 1e-4 : 0.5);
    const kg_vec3 u = kg_vec3_add(there.velocity, slow), n = kg_vec3_normalized(at.normal);
    const double speed_n = kg_vec3_dot(slow, n);
    const double slip = kg_vec3_norm(kg_vec3_add_scaled(slow, -speed_n, n));
    const double hx = 0.005 * fmax(fabs(phi), 0.3 * c->params.floor_share * L);
    const double hu = 0.01 * fmin(slip, c->params.stick);
    const double turns[2] = {1.0 - c->params.damping * speed_n, 1.0 - mat.damping * speed_n};
    bool kink = fabs(slip - c->params.stick) < 0.05 * c->params.stick || slip < 1e-5;
    const double edges[] = {L + h, h, L, c->params.floor_share * L};
    for (int i = 0; i < 4; i++) {
      kink = kink || fabs(phi - edges[i]) < 3.0 * hx;
    }
    for (int i = 0; i < 2; i++) {
      kink = kink || fabs(fabs(turns[i]) - 0.1) < 0.02;
    }
    /* the shape's own turning moves u: by less than the stick velocity */
    if (kink || hx * 1.1 > 0.02 * slip || phi > L + h) continue;
    blended += kg_vec3_norm(at.normal) < 0.99;
    const double error = derivative_error(c, x, u, hx, hu);
    worst = fmax(worst, error);
    assert_at_most(error, 1e-5);
    checked++;
  }
  print_message("%d points, %d in a blend: %.1e\n", checked, blended, worst);
  assert_true(checked > 300 && blended > 20);
}

static void soft_law_is_smooth_at_its_kinks(void **state)
{
  (void)state;
  const probe c = on_mat();
  const double L = c.params.layer, h = mat.thickness, stick = c.params.stick;
  const kg_vec3 none = {0.0, 0.0, 0.0}, slow = {0.4 * stick, -0.1, 0.3 * stick};
  const double edges[] = {L + h, h, L};
  for (size_t k = 0; k < KG_COUNT_OF(edges); k++) {
    assert_smooth_across(&c, kg_vec3_make(0.0, edges[k], 0.0), slow, kg_vec3_make(0.0, L, 0.0),
                         none);
  }
}

/* A point that moves with the shape feels it as one at rest feels a shape at rest. */
static void a_point_that_is_carried_does_not_slip(void **state)
{
  (void)state;
  for (int blend = 0; blend < 2; blend++) {
    const probe c = on_moving(blend);
    probe still = c;
    kg_place *place = &still.scene.places[0];
    kg_random random = kg_random_make(26);
    int touching = 0;
    place->velocity = place->spin = kg_vec3_make(0.0, 0.0, 0.0);
    for (int k = 0; k < 2000; k++) {
      const kg_vec3 x = random_vec3(&random, 0.3), slow = random_vec3(&random, 1e-4);
      const kg_vec3 u = kg_place_velocity(&c.scene.places[0], x);
      const kg_contact_force a = evaluate(&c, x, kg_vec3_add(u, slow));
      const kg_contact_force b = evaluate(&still, x, slow);
      assert_at_most(kg_vec3_norm(kg_vec3_sub(a.f, b.f)), 1e-9 * (1.0 + b.normal));
      touching += b.normal > 0.0;
    }
    assert_true(touching > 100);
  }
}

static void parameter_gradient_matches_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(27);
  int checked = 0;
  for (int k = 0; k < 600; k++) {
    probe c = on_mat();
    if (k % 2) c.scene.grounds[0].friction = -1.0;
    const double L = c.params.layer, h = mat.thickness;
    const double phi = (h + L) * (1.05 * kg_random_uniform(&random) - 0.05);
    const kg_vec3 x = {0.2, phi, 0.1}, u = random_vec3(&random, k % 3 ? 1e-4 : 0.3);
    const kg_vec3 f_bar = random_vec3(&random, 1.0);
    const double edges[] = {h, L, h + L, c.params.floor_share * L};
    const double slip = hypot(u.x, u.z) / c.params.stick;
    bool kink = fabs(slip - 1.0) < 0.02;
    for (int i = 0; i < 4; i++) {
      kink = kink || fabs(phi - edges[i]) < 0.01 * L;
    }
    kg_contact_force f;
    if (kink || !kg_contact_evaluate(&c.params, &c.scene, x, u, false, &f)) continue;
    double bar[6] = {0.0}, size = 0.0, want[6];
    kg_contact_params_vjp(&c.params, &f, u, f_bar, bar);
    double *const numbers[] = {&c.params.layer,   &c.params.force,    &c.params.floor_share,
                               &c.params.damping, &c.params.friction, &c.params.stick};
    for (int i = 0; i < 6; i++) {
      const double was = *numbers[i], step = 1e-3 * was;
      double value[4];
      for (int j = 0; j < 4; j++) {
        *numbers[i] = was + step * (j < 2 ? j - 2 : j - 1);
        value[j] = kg_vec3_dot(f_bar, evaluate(&c, x, u).f);
      }
      *numbers[i] = was;
      want[i] = was * (8.0 * (value[2] - value[1]) - (value[3] - value[0])) / (12.0 * step);
      size = fmax(size, fabs(want[i]));
    }
    for (int i = 0; i < 6; i++) {
      assert_at_most(fabs(bar[i] * *numbers[i] - want[i]), 1e-6 * (size + f.normal));
    }
    checked++;
  }
  assert_true(checked > 300);
}

/* A mat whose core is the floor, and one whose core is below the floor: neither core is entered
 * without a force as large as the hard law's, and the soft layer is felt above. */
static void on_a_mat_upon_a_floor_the_harder_law_acts(void **state)
{
  (void)state;
  for (int below = 0; below < 2; below++) {
    probe c = on_plane();
    const kg_ground soft = {.thickness = 0.05, .stiffness = 1e4, .friction = -1.0};
    const double top = below ? -0.02 : 0.0;
    const int ground = kg_scene_add_ground(&c.scene, &soft);
    const kg_sdf_shape core = {
      .kind = KG_SHAPE_BOX, .a = {0.0, top - 0.5, 0.0}, .b = {1.0, 0.5, 1.0}, .ground = ground};
    assert_true(kg_scene_add(&c.scene, &core));
    const probe hard = on_plane();
    const kg_vec3 still = {0.0, 0.0, 0.0};
    double last = INFINITY;
    for (double y = 0.06; y > -0.01; y -= 1e-5) {
      const kg_vec3 x = {0.1, y, -0.2};
      const double force = evaluate(&c, x, still).normal;
      assert_true(force >= evaluate(&hard, x, still).normal);
      if (y < 0.05 + top && y > 0.0) assert_true(force > 0.0);
      if (isfinite(last)) { /* continuous and growing */
        assert_true(force >= last);
        assert_at_most(force - last, 5e4 * 1e-5 + 0.2 * force);
      }
      last = force;
    }
  }
}

static void zero_slip_divides_by_nothing(void **state)
{
  (void)state;
  const probe c = on_plane();
  const kg_contact_force f =
    evaluate(&c, kg_vec3_make(0.0, 0.5 * c.params.layer, 0.0), kg_vec3_make(0.0, 0.0, 0.0));
  assert_close(f.df_du.m[0], -c.params.friction * f.normal * 2.0 / c.params.stick, 1e-13);
  assert_close(f.df_du.m[8], f.df_du.m[0], 1e-13);
  for (int k = 0; k < 9; k++) {
    assert_true(isfinite(f.df_dx.m[k]) && isfinite(f.df_du.m[k]));
  }
}

static void laws_without_a_meaning_are_not_valid(void **state)
{
  (void)state;
  const kg_contact_params good = kg_contact_default_params();
  assert_true(kg_contact_params_are_valid(&good));
  kg_contact_params bad = good;
  double *const numbers[] = {&bad.layer,   &bad.force,    &bad.floor_share,
                             &bad.damping, &bad.friction, &bad.stick};
  for (size_t k = 0; k < KG_COUNT_OF(numbers); k++) {
    const double values[] = {-1.0, NAN, INFINITY};
    for (size_t j = 0; j < KG_COUNT_OF(values); j++) {
      bad = good;
      *numbers[k] = values[j];
      assert_false(kg_contact_params_are_valid(&bad));
    }
    bad = good;
    *numbers[k] = 0.0;
    const bool may_vanish = k == 1 || k == 3 || k == 4;
    assert_true(kg_contact_params_are_valid(&bad) == may_vanish);
  }
}

/* Soft ground is no way out for a point that is nowhere: as on hard ground its force is no number. */
static void a_point_that_is_nowhere_has_no_force(void **state)
{
  (void)state;
  const kg_contact_params law = kg_contact_default_params();
  const kg_ground soft = {0.02, 1e4, 0.5, -1.0};
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  for (int k = 0; k < 2; k++) {
    kg_contact_force force;
    assert_true(kg_contact_evaluate(&law, &scene, kg_vec3_make(NAN, NAN, 0.0),
                                    kg_vec3_make(0.0, 0.0, 0.0), false, &force));
    assert_true(isnan(force.distance) && isnan(force.f.y));
    scene.shapes[0].ground = kg_scene_add_ground(&scene, &soft);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(law_has_the_stated_values),
    cmocka_unit_test(force_is_never_adhesive_and_stays_in_the_cone),
    cmocka_unit_test(derivatives_match_differences),
    cmocka_unit_test(derivative_is_continuous_at_every_kink),
    cmocka_unit_test(soft_law_has_the_stated_values),
    cmocka_unit_test(a_body_stands_in_the_mat),
    cmocka_unit_test(a_default_ground_is_the_hard_law),
    cmocka_unit_test(soft_moving_derivatives_match_differences),
    cmocka_unit_test(soft_law_is_smooth_at_its_kinks),
    cmocka_unit_test(a_point_that_is_carried_does_not_slip),
    cmocka_unit_test(parameter_gradient_matches_differences),
    cmocka_unit_test(on_a_mat_upon_a_floor_the_harder_law_acts),
    cmocka_unit_test(zero_slip_divides_by_nothing),
    cmocka_unit_test(laws_without_a_meaning_are_not_valid),
    cmocka_unit_test(a_point_that_is_nowhere_has_no_force),
  };
  return cmocka_run_group_tests_name("contact", tests, NULL, NULL);
}
