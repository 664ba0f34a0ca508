/* The implicit step against mechanics: closed forms of flight, tops and pendulums, blocks that
 * stand, slide, stick, fall and bounce, the order of the integrator. Every number that a test
 * claims is printed. */
#include "fixture_body.h"
#include "fixture_step.h"

#include "kinegrad/step.h"

#include <stdio.h>

static const double g = 9.8; /* m/s^2, the step's default */

/* count steps in place; every one must converge without sub-steps. The report is the last one's. */
static kg_step_report advance(kg_step *s, double *q, double *v, const double *tau, double dt,
                              int count)
{
  kg_step_report report = {0};
  for (int k = 0; k < count; k++) {
    kg_step_advance(s, q, v, q, v, tau, dt, false, &report);
    assert_true(report.converged);
    assert_int_equal(report.substeps, 1);
  }
  return report;
}

static kg_vec3 at(const double *x)
{
  return kg_vec3_make(x[0], x[1], x[2]);
}

/* Sum of the contact forces of a report. */
static kg_vec3 total_force(const kg_step_report *report)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int k = 0; k < report->contact_count; k++) {
    sum = kg_vec3_add(sum, report->contacts[k].force.f);
  }
  return sum;
}

/* Prints the error of each of a series of runs whose step halves, and the orders between them,
 * which must be one to a tenth, and the last to a hundredth: an error that does not go to zero
 * shows. */
static void assert_first_order(const char *what, const double *error, int count)
{
  print_message("%s: errors", what);
  for (int k = 0; k < count; k++) {
    print_message(" %.3e", error[k]);
  }
  print_message(", orders");
  for (int k = 1; k < count; k++) {
    print_message(" %.3f", log2(error[k - 1] / error[k]));
  }
  print_message("\n");
  for (int k = 1; k < count; k++) {
    assert_at_most(fabs(log2(error[k - 1] / error[k]) - 1.0), k + 1 < count ? 0.1 : 0.01);
  }
}

/* ---- flight -----------------------------------------------------------------------------------*/

typedef struct flight_error {
  double linear, angular, energy;
} flight_error;

/* One second of free flight: change of momentum against gravity's impulse, and of energy. */
static flight_error fly(const kg_body *body, const double *q0, const double *v0, int steps)
{
  kg_step_def def = kg_step_default_def(body);
  kg_step *s = step_of(&def);
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  double q[MAX_NQ], v[MAX_NV];
  memcpy(q, q0, sizeof q);
  memcpy(v, v0, sizeof v);
  const kg_centroid before = kg_dynamics_centroid(d, q, v);
  const double energy = kg_dynamics_energy(d, q, v);
  for (int k = 0; k < steps; k++) {
    kg_step_report report;
    kg_step_advance(s, q, v, q, v, NULL, 1.0 / steps, false, &report);
    assert_true(report.converged && report.substeps == 1);
  }
  const kg_centroid after = kg_dynamics_centroid(d, q, v);
  kg_vec3 gained = kg_vec3_sub(after.com_dot, before.com_dot);
  gained.y += 9.8;
  const flight_error error = {body->mass * kg_vec3_norm(gained),
                              kg_vec3_norm(kg_vec3_sub(after.L, before.L)),
                              fabs(kg_dynamics_energy(d, q, v) - energy)};
  kg_step_destroy(s);
  kg_dynamics_destroy(d);
  return error;
}

static void flight_keeps_momentum_to_first_order(void **state)
{
  (void)state;
  kg_random random = kg_random_make(36);
  kg_body *body = human_body();
  double q[MAX_NQ] = {0.0}, v[MAX_NV] = {0.0};
  rest_state(body, 2.0, q);
  for (int k = 0; k < body->nv; k++) {
    v[k] = (k < 6 ? 1.0 : 0.3) * kg_random_normal(&random);
  }
  flight_error last = {0.0, 0.0, 0.0};
  for (int steps = 400; steps <= 1600; steps *= 2) {
    const flight_error e = fly(body, q, v, steps);
    print_message(
      "flight, %4d steps of 1 s: linear %.2e kg m/s, angular %.2e kg m^2/s, energy %.2e J", steps,
      e.linear, e.angular, e.energy);
    if (steps > 400) {
      const double order[3] = {log2(last.linear / e.linear), log2(last.angular / e.angular),
                               log2(last.energy / e.energy)};
      print_message(", orders %.3f %.3f %.3f", order[0], order[1], order[2]);
      assert_at_most(fabs(order[0] - 1.0), 0.1);
      assert_at_most(fabs(order[1] - 1.0), 0.1);
      assert_at_most(fabs(order[2] - 1.0), 0.15);
    }
    print_message("\n");
    last = e;
  }
  kg_body_destroy(body);
  /* one rigid body whose origin is its centre of mass: nothing but gravity moves it */
  kg_body *box = box_body(3.0, kg_vec3_make(0.1, 0.2, 0.3));
  rest_state(box, 1.0, q);
  for (int k = 0; k < 6; k++) {
    v[k] = 2.0 * kg_random_normal(&random);
  }
  assert_at_most(fly(box, q, v, 100).linear, 1e-10);
  kg_body_destroy(box);
}

/* Backward Euler under gravity alone: v_n = v_0 - n g h, x_n = x_0 + n h v_0 - g h^2 n (n + 1) / 2,
 * for a body that does not turn, of any shape and number of joints. */
static void ballistic_flight_is_exact(void **state)
{
  (void)state;
  kg_body *bodies[2] = {box_body(3.0, kg_vec3_make(0.1, 0.2, 0.3)), human_body()};
  for (int b = 0; b < 2; b++) {
    const kg_body *body = bodies[b];
    kg_step_def def = kg_step_default_def(body);
    kg_step *s = step_of(&def);
    double q[MAX_NQ], v[MAX_NV] = {1.5, 4.0, -2.0}, worst = 0.0;
    const double h = 1.0 / 120.0;
    rest_state(body, 2.0, q);
    for (int n = 1; n <= 240; n++) {
      (void)advance(s, q, v, NULL, h, 1);
      const kg_vec3 expected = {n * h * 1.5, 2.0 + n * h * 4.0 - g * h * h * n * (n + 1) / 2.0,
                                n * h * -2.0};
      worst = fmax(worst, kg_vec3_norm(kg_vec3_sub(at(q), expected)));
      worst = fmax(worst, fabs(v[1] - (4.0 - n * g * h)));
      for (int k = 3; k < body->nv; k++) {
        worst = fmax(worst, fabs(v[k]));
      }
    }
    print_message(
      "ballistic flight of %d segments, 240 steps: largest error %.1e (m, m/s, rad/s)\n",
      body->segment_count, worst);
    assert_at_most(worst, 1e-10);
    kg_step_destroy(s);
    kg_body_destroy(bodies[b]);
  }
}

/* ---- tops -------------------------------------------------------------------------------------*/

/* Symmetric about the y axis of its frame, moment A across and C along; centre of mass `length` up
 * that axis. On a base so heavy that nothing moves it, or free when the base is left out. */
static kg_body *top_body(double mass, double A, double C, double length, bool has_base)
{
  kg_segment s[2] = {{.role = -1, .joint = -1, .parent = -1}, {.role = -1, .joint = -1}};
  strcpy(s[0].name, "base");
  s[0].mass = 1e9;
  s[0].inertia[0] = s[0].inertia[1] = s[0].inertia[2] = 1e9;
  kg_segment *top = &s[has_base ? 1 : 0];
  strcpy(top->name, "top");
  top->mass = mass;
  top->com = kg_vec3_make(0.0, length, 0.0);
  top->inertia[0] = top->inertia[2] = A;
  top->inertia[1] = C;
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, s, has_base ? 2 : 1, NULL, 0, NULL), KG_OK);
  return body;
}

static double angle_between(kg_vec3 a, kg_vec3 b)
{
  return atan2(kg_vec3_norm(kg_vec3_cross(a, b)), kg_vec3_dot(a, b));
}

/* A free top: its axis turns about the angular momentum at |L| / A, in its own frame the angular
 * velocity turns about the axis at (A - C) w_axis / A. */
static void free_top_precesses(void **state)
{
  (void)state;
  const double A = 0.08, C = 0.03, time = 0.5;
  kg_body *body = top_body(2.0, A, C, 0.0, false);
  kg_step_def def = kg_step_default_def(body);
  def.gravity = kg_vec3_make(0.0, 0.0, 0.0);
  kg_step *s = step_of(&def);
  kg_dynamics *d = dynamics_of(body);
  const kg_vec3 w = {0.9, 6.0, -0.5};
  const double none[6] = {0.0};
  double q0[7], v0[6] = {0.0, 0.0, 0.0, w.x, w.y, w.z}, a[6], error[4];
  rest_state(body, 0.0, q0);
  kg_dynamics_set_gravity(d, kg_vec3_make(0.0, 0.0, 0.0));
  kg_dynamics_forward(d, a, q0, v0, none);
  const double rate = (A - C) / A * w.y; /* Euler: A w_x' = (A - C) w_y w_z and so on */
  assert_close(a[3], -rate * w.z, 1e-12);
  assert_close(a[4], 0.0, 1e-12);
  assert_close(a[5], rate * w.x, 1e-12);
  const kg_vec3 L = {A * w.x, C * w.y, A * w.z}, about = kg_vec3_normalized(L);
  const kg_quat turn = kg_quat_exp(kg_vec3_scale(kg_vec3_norm(L) / A * time, about));
  const kg_vec3 expected = kg_quat_rotate(turn, kg_vec3_make(0.0, 1.0, 0.0));
  for (int level = 0; level < 4; level++) {
    const int steps = 400 << level;
    double q[7], v[6];
    memcpy(q, q0, sizeof q);
    memcpy(v, v0, sizeof v);
    (void)advance(s, q, v, NULL, time / steps, steps);
    const kg_vec3 axis =
      kg_quat_rotate(kg_quat_make(q[3], q[4], q[5], q[6]), kg_vec3_make(0.0, 1.0, 0.0));
    error[level] = angle_between(axis, expected);
  }
  assert_first_order("free top, axis after 0.5 s of 2.47 rad/s about L, rad", error, 4);
  assert_at_most(error[3], 5e-3);
  kg_dynamics_destroy(d);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* A top on a fixed point, tilted by theta, precesses steadily at the smaller root p of
 *   (A + m l^2) p^2 cos(theta) - C w p + m g l = 0,   w the spin about its own axis in space;
 * the torque that turns L is m g l sin(theta). */
static void top_on_a_point_precesses(void **state)
{
  (void)state;
  const double mass = 0.5, A = 1.2e-3, C = 0.8e-3, length = 0.06, theta = 0.4, w = 180.0;
  kg_body *body = top_body(mass, A, C, length, true);
  kg_step_def def = kg_step_default_def(body);
  kg_step *s = step_of(&def);
  kg_dynamics *d = dynamics_of(body);
  const double a = (A + mass * length * length) * cos(theta), b = C * w, c = mass * g * length;
  const double p = (b - sqrt(b * b - 4.0 * a * c)) / (2.0 * a);
  /* axis (sin, cos, 0): turned about -z; the angular velocity is p up plus a spin along the axis */
  double q0[11], v0[9] = {0.0}, tau[9] = {0.0}, acceleration[9];
  rest_state(body, 0.0, q0);
  const kg_quat tilt = kg_quat_exp(kg_vec3_make(0.0, 0.0, -theta));
  const double parts[4] = {tilt.w, tilt.x, tilt.y, tilt.z};
  memcpy(q0 + 7, parts, sizeof parts);
  const double spin = w - p * cos(theta);
  v0[6] = -p * sin(theta);
  v0[7] = w;
  tau[1] = body->segments[0].mass * g;
  kg_dynamics_forward(d, acceleration, q0, v0, tau);
  /* in space the angular velocity turns about the vertical: its rate is p up x spin along the axis,
   * here p spin sin(theta) along -z, which the frame turned about z sees unchanged */
  assert_close(acceleration[6], 0.0, 1e-6 * p * spin);
  assert_close(acceleration[7], 0.0, 1e-6 * p * spin);
  assert_close(acceleration[8] / (-p * spin * sin(theta)), 1.0, 1e-7);
  const double time = 0.25 / p; /* a quarter of a radian about the vertical */
  const kg_vec3 expected = {sin(theta) * cos(0.25), cos(theta), -sin(theta) * sin(0.25)};
  double error[4];
  for (int level = 0; level < 4; level++) {
    const int steps = 2000 << level;
    double q[11], v[9];
    memcpy(q, q0, sizeof q);
    memcpy(v, v0, sizeof v);
    (void)advance(s, q, v, tau, time / steps, steps);
    const kg_vec3 axis =
      kg_quat_rotate(kg_quat_make(q[7], q[8], q[9], q[10]), kg_vec3_make(0.0, 1.0, 0.0));
    error[level] = angle_between(axis, expected);
  }
  print_message("top on a point: precession %.4f rad/s\n", p);
  assert_first_order("its axis after 0.25 rad, rad", error, 4);
  kg_dynamics_destroy(d);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* ---- double pendulum --------------------------------------------------------------------------*/

/* Two rods in the plane z = 0 under a base that nothing moves; angles from hanging down, both
 * against the vertical. */
typedef struct pendulum {
  double m1, I1, c1, l1, m2, I2, c2; /* masses, moments and places of the centres, length */
} pendulum;

static const pendulum rods = {1.3, 0.02, 0.2, 0.45, 0.8, 0.012, 0.17};

/* The textbook's equations (Lagrange). */
static void pendulum_accelerations(const pendulum *p, const double angle[2], const double rate[2],
                                   double out[2])
{
  const double c = cos(angle[0] - angle[1]), s = sin(angle[0] - angle[1]);
  const double k = p->m2 * p->l1 * p->c2;
  const double M11 = p->I1 + p->m1 * p->c1 * p->c1 + p->m2 * p->l1 * p->l1, M12 = k * c;
  const double M22 = p->I2 + p->m2 * p->c2 * p->c2;
  const double b1 =
    -k * s * rate[1] * rate[1] - (p->m1 * p->c1 + p->m2 * p->l1) * g * sin(angle[0]);
  const double b2 = k * s * rate[0] * rate[0] - p->m2 * p->c2 * g * sin(angle[1]);
  const double det = M11 * M22 - M12 * M12;
  out[0] = (M22 * b1 - M12 * b2) / det;
  out[1] = (M11 * b2 - M12 * b1) / det;
}

static double pendulum_energy(const pendulum *p, const double angle[2], const double rate[2])
{
  const double M11 = p->I1 + p->m1 * p->c1 * p->c1 + p->m2 * p->l1 * p->l1;
  const double M22 = p->I2 + p->m2 * p->c2 * p->c2;
  const double M12 = p->m2 * p->l1 * p->c2 * cos(angle[0] - angle[1]);
  const double kinetic =
    0.5 * (M11 * rate[0] * rate[0] + M22 * rate[1] * rate[1]) + M12 * rate[0] * rate[1];
  return kinetic - (p->m1 * p->c1 + p->m2 * p->l1) * g * cos(angle[0]) -
         p->m2 * p->c2 * g * cos(angle[1]);
}

/* Classical Runge-Kutta with many steps: the independent solution. */
static void pendulum_solve(const pendulum *p, double angle[2], double rate[2], double time)
{
  const int steps = 20000;
  const double h = time / steps;
  for (int n = 0; n < steps; n++) {
    double ka[4][2], kr[4][2];
    for (int stage = 0; stage < 4; stage++) {
      const double share = stage == 0 ? 0.0 : stage == 3 ? h : 0.5 * h;
      double at_angle[2], at_rate[2];
      for (int i = 0; i < 2; i++) {
        at_angle[i] = angle[i] + (stage > 0 ? share * ka[stage - 1][i] : 0.0);
        at_rate[i] = rate[i] + (stage > 0 ? share * kr[stage - 1][i] : 0.0);
        ka[stage][i] = at_rate[i];
      }
      pendulum_accelerations(p, at_angle, at_rate, kr[stage]);
    }
    for (int i = 0; i < 2; i++) {
      angle[i] += h / 6.0 * (ka[0][i] + 2.0 * ka[1][i] + 2.0 * ka[2][i] + ka[3][i]);
      rate[i] += h / 6.0 * (kr[0][i] + 2.0 * kr[1][i] + 2.0 * kr[2][i] + kr[3][i]);
    }
  }
}

static kg_body *pendulum_body(const pendulum *p)
{
  kg_segment s[3] = {{.role = -1, .joint = -1, .parent = -1},
                     {.role = -1, .joint = -1, .parent = 0},
                     {.role = -1, .joint = -1, .parent = 1, .offset = {0.0, -p->l1, 0.0}}};
  const double mass[3] = {1e9, p->m1, p->m2}, moment[3] = {1e9, p->I1, p->I2};
  for (int i = 0; i < 3; i++) {
    snprintf(s[i].name, sizeof s[i].name, "rod%d", i);
    s[i].mass = mass[i];
    s[i].com = kg_vec3_make(0.0, i == 0 ? 0.0 : i == 1 ? -p->c1 : -p->c2, 0.0);
    for (int k = 0; k < 3; k++) {
      s[i].inertia[k] = moment[i];
    }
  }
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, s, 3, NULL, 0, NULL), KG_OK);
  return body;
}

static void pendulum_state(const double angle[2], const double rate[2], double *q, double *v)
{
  memset(q, 0, 15 * sizeof *q);
  memset(v, 0, 12 * sizeof *v);
  q[3] = 1.0;
  for (int i = 0; i < 2; i++) {
    const double turn = i == 0 ? angle[0] : angle[1] - angle[0];
    q[7 + 4 * i] = cos(0.5 * turn);
    q[10 + 4 * i] = sin(0.5 * turn);
    v[8 + 3 * i] = i == 0 ? rate[0] : rate[1] - rate[0];
  }
}

static void double_pendulum_follows_the_textbook(void **state)
{
  (void)state;
  kg_random random = kg_random_make(61);
  kg_body *body = pendulum_body(&rods);
  kg_dynamics *d = dynamics_of(body);
  kg_step_def def = kg_step_default_def(body);
  kg_step *s = step_of(&def);
  double q[15], v[12], a[12], tau[12] = {0.0}, worst = 0.0;
  tau[1] = body->segments[0].mass * g;
  for (int trial = 0; trial < 100; trial++) {
    double angle[2], rate[2], expected[2];
    for (int i = 0; i < 2; i++) {
      angle[i] = 6.0 * kg_random_uniform(&random);
      rate[i] = 5.0 * kg_random_normal(&random);
    }
    pendulum_state(angle, rate, q, v);
    kg_dynamics_forward(d, a, q, v, tau);
    pendulum_accelerations(&rods, angle, rate, expected);
    worst = fmax(worst, fabs(a[8] - expected[0]) / (1.0 + fabs(expected[0])));
    worst = fmax(worst, fabs(a[8] + a[11] - expected[1]) / (1.0 + fabs(expected[1])));
  }
  print_message("double pendulum: accelerations to %.1e\n", worst);
  assert_at_most(worst, 1e-6); /* the base weighs 1e9 kg: rounding of M */
  const double time = 0.6, angle0[2] = {1.9, 1.2}, rate0[2] = {0.5, -1.0};
  double angle[2] = {1.9, 1.2}, rate[2] = {0.5, -1.0}, error[4], energy[4];
  pendulum_solve(&rods, angle, rate, time);
  assert_close(pendulum_energy(&rods, angle, rate), pendulum_energy(&rods, angle0, rate0), 1e-9);
  for (int level = 0; level < 4; level++) {
    const int steps = 1000 << level;
    pendulum_state(angle0, rate0, q, v);
    (void)advance(s, q, v, tau, time / steps, steps);
    const double reached[2] = {2.0 * atan2(q[10], q[7]),
                               2.0 * atan2(q[10], q[7]) + 2.0 * atan2(q[14], q[11])};
    const double rates[2] = {v[8], v[8] + v[11]};
    error[level] = hypot(sin(0.5 * (reached[0] - angle[0])), sin(0.5 * (reached[1] - angle[1])));
    energy[level] =
      fabs(pendulum_energy(&rods, reached, rates) - pendulum_energy(&rods, angle0, rate0));
  }
  assert_first_order("double pendulum, angles, rad", error, 4);
  assert_first_order("double pendulum, energy, J", energy, 4);
  kg_dynamics_destroy(d);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* ---- blocks -----------------------------------------------------------------------------------*/

static void box_stands_still(void **state)
{
  (void)state;
  kg_body *body = box_body(70.0, kg_vec3_make(0.15, 0.3, 0.1));
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[7], v[6] = {0.0};
  rest_state(body, 0.303, q);
  kg_step_report report;
  for (int k = 0; k < 120; k++) { /* falls into place */
    kg_step_advance(s, q, v, q, v, NULL, 1.0 / 120.0, false, &report);
    assert_true(report.converged);
  }
  const kg_vec3 start = kg_vec3_make(q[0], q[1], q[2]);
  for (int k = 0; k < 600; k++) {
    kg_step_advance(s, q, v, q, v, NULL, 1.0 / 120.0, false, &report);
    assert_true(report.converged);
    assert_at_most(fabs(total_force(&report).y / (70.0 * 9.8) - 1.0), 1e-6);
  }
  assert_int_equal(report.contact_count, 4);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(kg_vec3_make(q[0], q[1], q[2]), start)), 1e-6);
  for (int k = 0; k < 4; k++) { /* weight is carried outside the surface */
    assert_true(report.contacts[k].force.distance > 0.0);
  }
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* Joints held by springs from outside the step (explicit) and damping inside it (implicit). */
static void human_stands_still(void **state)
{
  (void)state;
  kg_body *body = human_body();
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.joint_damping = 50.0;
  kg_step *s = step_of(&def);
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  double q[MAX_NQ], v[MAX_NV] = {0.0}, tau[MAX_NV], rest[MAX_NQ], e[MAX_NV];
  rest_state(body, human_root_height + 0.003, q);
  rest_state(body, human_root_height + 0.003, rest);
  kg_vec3 start = {0.0, 0.0, 0.0}, foot = {0.0, 0.0, 0.0};
  const kg_body_point heel = body->points[0];
  kg_step_report report;
  double worst_weight = 0.0, worst_drift = 0.0, worst_slip = 0.0;
  int iterations = 0;
  for (int k = 0; k < 120 * 8; k++) {
    kg_body_difference(body, e, rest, q);
    for (int i = 0; i < body->nv; i++) {
      tau[i] = i < 6 ? 0.0 : 1500.0 * e[i];
    }
    /* the soft sole lets the body sway; the ankles push against it */
    const double sway = kg_dynamics_centroid(d, q, v).com_dot.z;
    tau[3 + 3 * HUMAN_LEFT_ANKLE] += 200.0 * sway;
    tau[3 + 3 * HUMAN_RIGHT_ANKLE] += 200.0 * sway;
    kg_step_advance(s, q, v, q, v, tau, 1.0 / 120.0, false, &report);
    assert_true(report.converged);
    iterations += report.iterations;
    const kg_vec3 com = kg_dynamics_centroid(d, q, NULL).com;
    const kg_vec3 at = kg_dynamics_point(d, NULL, q, heel);
    if (k == 120 * 3) { /* the springs have found their length */
      start = com;
      foot = at;
    } else if (k > 120 * 3) {
      worst_weight = fmax(worst_weight, fabs(total_force(&report).y / (body->mass * 9.8) - 1.0));
      worst_drift = fmax(worst_drift, kg_vec3_norm(kg_vec3_sub(com, start)));
      worst_slip = fmax(worst_slip, kg_vec3_norm(kg_vec3_sub(at, foot)));
    }
  }
  print_message("human standing 5 s: weight to %.1e, centre of mass %.2e m, heel %.2e m, %.2f "
                "iterations a step\n",
                worst_weight, worst_drift, worst_slip, iterations / 960.0);
  assert_at_most(worst_weight, 1e-6);
  assert_at_most(worst_drift, 1e-3);
  assert_at_most(worst_slip, 1e-3);
  kg_dynamics_destroy(d);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

static void sliding_block_decelerates_by_mu_g(void **state)
{
  (void)state;
  kg_body *body = box_body(10.0, kg_vec3_make(0.2, 0.03, 0.2));
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.contact.friction = 0.5;
  kg_step *s = step_of(&def);
  double q[7], v[6] = {0.0};
  rest_state(body, 0.033, q);
  for (int k = 0; k < 240; k++) {
    v[0] = v[2] = 0.0;
    kg_step_advance(s, q, v, q, v, NULL, 0.005, false, NULL);
  }
  v[0] = 3.0;
  v[2] = 4.0;
  double speed[81];
  for (int k = 0; k <= 80; k++) {
    kg_step_report report;
    speed[k] = hypot(v[0], v[2]);
    kg_step_advance(s, q, v, q, v, NULL, 0.005, false, &report);
    assert_true(report.converged);
  }
  const double slowing = (speed[40] - speed[80]) / (40 * 0.005);
  print_message("sliding block: %.6f m/s^2, mu g = %.6f\n", slowing, 0.5 * 9.8);
  assert_at_most(fabs(slowing / (0.5 * 9.8) - 1.0), 1e-3);
  assert_close(v[2] / v[0], 4.0 / 3.0, 1e-3); /* straight on */
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* A block dropped on a mat that moves: it ends at the floor's speed, sunk as deep as its weight
 * presses the four corners. */
/* The rigid core is farther from the block than the block is large: the layer counts. */
static void a_small_block_feels_a_thick_mat(void **state)
{
  (void)state;
  kg_body *body = box_body(1.0, kg_vec3_make(0.02, 0.02, 0.02));
  const kg_ground mat = {.thickness = 0.15, .stiffness = 2e3, .damping = 2.0, .friction = -1.0};
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  scene.shapes[0].ground = kg_scene_add_ground(&scene, &mat);
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[7], v[6] = {0.0};
  kg_step_report report;
  rest_state(body, 0.02 + 0.15, q);
  for (int k = 0; k < 300; k++) {
    kg_step_advance(s, q, v, q, v, NULL, 0.005, false, &report);
    assert_true(report.converged && report.contact_count == 4);
  }
  /* (1a) for p < layer: k p^2 / (2 layer) on each of four corners */
  const double p = sqrt(2.0 * def.contact.layer * 9.8 / 4.0 / mat.stiffness);
  assert_true(p < def.contact.layer);
  assert_close(q[1] - 0.02, mat.thickness + def.contact.layer - p, 1e-6);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

static void a_moving_mat_carries_a_block(void **state)
{
  (void)state;
  const double mass = 10.0, speed = 0.8;
  kg_body *body = box_body(mass, kg_vec3_make(0.2, 0.03, 0.2));
  const kg_ground mat = {.thickness = 0.04, .stiffness = 2e3, .damping = 2.0, .friction = 0.4};
  const kg_place place = {.velocity = {speed, 0.0, 0.0}};
  kg_scene scene = {0};
  const kg_sdf_shape floor = {.kind = KG_SHAPE_PLANE,
                              .b = {0.0, 1.0, 0.0},
                              .place = kg_scene_add_place(&scene, &place),
                              .ground = kg_scene_add_ground(&scene, &mat)};
  assert_true(kg_scene_add(&scene, &floor));
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[7], v[6] = {0.0};
  kg_step_report report;
  rest_state(body, 0.03 + 0.05, q);
  for (int k = 0; k < 600; k++) {
    const double was = v[0];
    kg_step_advance(s, q, v, q, v, NULL, 0.005, false, &report);
    assert_true(report.converged && report.substeps == 1);
    double normal = 0.0;
    for (int c = 0; c < report.contact_count; c++) {
      normal += report.contacts[c].force.normal;
    }
    const double most = mat.friction * normal / mass * 0.005; /* of the mat, not of the law */
    if (was > 0.9 * speed) continue;
    assert_close(v[0] - was, most, 1e-6); /* it slides */
  }
  const double sunk = 0.5 * def.contact.layer + mass * 9.8 / report.contact_count / mat.stiffness;
  assert_close(v[0], speed, 1e-6);
  assert_close(report.contacts[0].force.distance, mat.thickness + def.contact.layer - sunk, 1e-6);
  assert_int_equal(report.contact_count, 4);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

static void block_sticks_on_a_slope(void **state)
{
  (void)state;
  kg_body *body = box_body(10.0, kg_vec3_make(0.2, 0.03, 0.2));
  kg_step_def def = kg_step_default_def(body);
  const double angle = atan(0.8 * def.contact.friction);
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(-sin(angle), cos(angle), 0.0));
  def.scene = &scene;
  kg_step *s = step_of(&def);
  double q[7], v[6] = {0.0}, turn[6] = {0.0};
  rest_state(body, 0.0, q);
  turn[0] = -0.034 * sin(angle);
  turn[1] = 0.034 * cos(angle);
  turn[5] = angle;
  kg_body_integrate(body, q, q, turn);
  kg_step_report report;
  for (int k = 0; k < 120; k++) {
    kg_step_advance(s, q, v, q, v, NULL, 1.0 / 120.0, false, &report);
    assert_true(report.converged);
  }
  const kg_vec3 start = kg_vec3_make(q[0], q[1], q[2]);
  for (int k = 0; k < 600; k++) {
    kg_step_advance(s, q, v, q, v, NULL, 1.0 / 120.0, false, &report);
    assert_true(report.converged);
  }
  const double drift = kg_vec3_norm(kg_vec3_sub(kg_vec3_make(q[0], q[1], q[2]), start));
  /* 2 s - s^2 = 0.8 */
  const double expected = 5.0 * def.contact.stick * (1.0 - sqrt(0.2));
  print_message("slope at 80 %% of the cone, 5 s: drift %.3e m, the law says %.3e\n", drift,
                expected);
  assert_at_most(drift, 1e-3);
  assert_at_most(fabs(drift - expected), 0.02 * expected);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

/* ---- impacts ----------------------------------------------------------------------------------*/

/* Elastic energy of a point at distance Phi: the integral of the force at rest from Phi to the edge
 * of the layer (contact.md, (1) and (2)). */
static double layer_energy(const kg_contact_params *c, double Phi)
{
  const double edge = c->layer, floor = c->floor_share * c->layer;
  if (Phi >= edge) {
    return 0.0;
  }
  const double x = fmax(Phi, floor), gap = edge - x;
  double energy =
    c->force / edge * (edge * log(edge / x) - 2.0 * gap + (edge * edge - x * x) / (2.0 * edge));
  if (Phi < floor) {
    const double N = c->force * gap * gap / (edge * x);
    const double slope = c->force / edge * (1.0 - edge * edge / (x * x));
    energy += N * (floor - Phi) - 0.5 * slope * (floor - Phi) * (floor - Phi);
  }
  return edge * energy;
}

static double total_energy(kg_dynamics *d, const kg_step_def *def, const double *q, const double *v)
{
  double energy = kg_dynamics_energy(d, q, v);
  for (int k = 0; k < def->body->point_count; k++) {
    const double height = kg_dynamics_point(d, NULL, q, def->body->points[k]).y;
    energy += layer_energy(&def->contact, height);
  }
  return energy;
}

/* Where four points carry the weight: F (delta - Phi)^2 / (delta Phi) = m g / 4. */
static double resting_height(const kg_contact_params *c, double weight)
{
  const double k = weight / (4.0 * c->force) * c->layer;
  const double b = 2.0 * c->layer + k;
  return 0.5 * (b - sqrt(b * b - 4.0 * c->layer * c->layer));
}

/* A fall until all is quiet: energy, and momentum against the impulse of the reported forces. */
typedef struct fall {
  double gain;      /* J, sum of all steps in which energy grew       */
  double start;     /* J above the energy at rest                     */
  double balance;   /* kg m/s, largest |dp - impulse| of a step       */
  double end_speed; /* m/s and rad/s                                  */
  int touching;     /* contacts at the end                            */
  int divided;      /* steps that took sub-steps                      */
  double apex[4];   /* m, highest points between impacts, falling     */
  int apexes;
} fall;

static fall let_fall(const kg_step_def *def, double *q, double *v, double dt, int steps)
{
  kg_step *s = step_of(def);
  kg_dynamics *d = dynamics_of(def->body);
  fall f = {0};
  const double first = total_energy(d, def, q, v);
  double energy = first;
  bool rises = false;
  for (int k = 0; k < steps; k++) {
    double before[6];
    kg_step_report report;
    memcpy(before, v, sizeof before);
    kg_step_advance(s, q, v, q, v, NULL, dt, false, &report);
    assert_true(report.converged);
    f.divided += report.substeps > 1;
    const double now = total_energy(d, def, q, v);
    f.gain += fmax(0.0, now - energy);
    energy = now;
    /* of a single body whose origin is its centre of mass; forces at the end act all through a step
     * that was not divided */
    kg_vec3 impulse = kg_vec3_scale(dt, total_force(&report));
    impulse.y -= dt * def->body->mass * g;
    const kg_vec3 change = kg_vec3_scale(def->body->mass, kg_vec3_sub(at(v), at(before)));
    if (report.substeps == 1) {
      f.balance = fmax(f.balance, kg_vec3_norm(kg_vec3_sub(change, impulse)));
    }
    if (rises && v[1] <= 0.0 && report.contact_count == 0 && f.apexes < 4) {
      f.apex[f.apexes++] = q[1];
    }
    rises = v[1] > 0.0;
    f.touching = report.contact_count;
  }
  f.start = first - energy;
  f.end_speed = kg_vec3_norm(at(v)) + kg_vec3_norm(at(v + 3));
  kg_step_destroy(s);
  kg_dynamics_destroy(d);
  return f;
}

/* From above, tilted, sliding and turning, with short steps and with the longest in use. */
static void drop_rod(double dt)
{
  const kg_vec3 half = {0.5, 0.02, 0.03};
  kg_body *body = box_body(4.0, half);
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.tolerance = 1e-10;
  double q[7], v[6] = {0.3, 0.0, 0.1, 0.0, 0.0, 1.0};
  double turn[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.5};
  rest_state(body, 0.6, q);
  kg_body_integrate(body, q, q, turn);
  const fall f = let_fall(&def, q, v, dt, (int)(4.0 / dt));
  const double height = half.y + resting_height(&def.contact, body->mass * g);
  print_message(
    "dropped rod, steps of %.4f s: %.2f J lost, energy grew by %.1e J in all, momentum "
    "against impulse %.1e kg m/s, %d divided steps, rests at %.7f m (%.7f), speed %.1e\n",
    dt, f.start, f.gain, f.balance, f.divided, q[1], height, f.end_speed);
  assert_int_equal(f.divided, 0);
  assert_at_most(f.gain, 1e-9 * f.start);
  assert_at_most(f.balance, 1e-9);
  assert_int_equal(f.touching, 4);
  assert_close(q[1], height, 1e-9);
  assert_at_most(f.end_speed, 1e-5);
  const kg_vec3 side =
    kg_quat_rotate(kg_quat_make(q[3], q[4], q[5], q[6]), kg_vec3_make(1.0, 0.0, 0.0));
  assert_at_most(fabs(side.y), 1e-5); /* it lies */
  kg_body_destroy(body);
}

static void dropped_rod_comes_to_rest(void **state)
{
  (void)state;
  drop_rod(1.0 / 480.0);
  drop_rod(1.0 / 120.0);
  drop_rod(0.02);
}

static void bouncing_block_gains_nothing(void **state)
{
  (void)state;
  kg_body *body = box_body(5.0, kg_vec3_make(0.1, 0.05, 0.1));
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.tolerance = 1e-10;
  def.contact.damping = 0.0; /* nothing but the step itself takes energy */
  double q[7], v[6] = {0.0};
  const double start = 0.35;
  rest_state(body, start, q);
  const fall f = let_fall(&def, q, v, 1.0 / 4000.0, 4000);
  print_message("bouncing block from %.3f m: apexes", start);
  double last = start;
  assert_true(f.apexes >= 2);
  for (int k = 0; k < f.apexes; k++) {
    print_message(" %.4f", f.apex[k]);
    assert_true(f.apex[k] < last);
    last = f.apex[k];
  }
  print_message(" m; energy grew by %.1e J in all, momentum against impulse %.1e kg m/s\n", f.gain,
                f.balance);
  assert_true(f.apex[0] > 0.1); /* it does bounce */
  assert_at_most(f.gain, 1e-9);
  assert_at_most(f.balance, 1e-9);
  assert_int_equal(f.divided, 0);
  kg_body_destroy(body);
}

/* ---- order in contact -------------------------------------------------------------------------*/

/* A box that slides, bobs and rocks without leaving the layer, for 20 ms: the distance between the
 * ends of runs whose step halves falls like the step. */
static void integrator_is_of_first_order_in_contact(void **state)
{
  (void)state;
  kg_body *body = box_body(10.0, kg_vec3_make(0.2, 0.05, 0.2));
  kg_scene scene = ground();
  kg_step_def def = kg_step_default_def(body);
  def.scene = &scene;
  def.contact.friction = 0.3;
  kg_step *s = step_of(&def);
  enum { LEVELS = 6 };
  double end[LEVELS][6], error[LEVELS - 1];
  double start[7];
  const double settled = 0.05 + resting_height(&def.contact, 98.0);
  rest_state(body, settled, start);
  for (int level = 0; level < LEVELS; level++) {
    const int steps = 1000 << level;
    double q[7], v[6] = {2.0, -0.03, 0.7, 0.1, 0.0, -0.05};
    memcpy(q, start, sizeof q);
    const kg_step_report report = advance(s, q, v, NULL, 0.02 / steps, steps);
    assert_int_equal(report.contact_count, 4);
    kg_body_difference(body, end[level], q, start);
  }
  for (int level = 0; level + 1 < LEVELS; level++) {
    double square = 0.0;
    for (int k = 0; k < 6; k++) {
      const double difference = end[level][k] - end[level + 1][k];
      square += difference * difference;
    }
    error[level] = sqrt(square);
  }
  assert_first_order("sliding and rocking in contact, m and rad", error, LEVELS - 1);
  kg_step_destroy(s);
  kg_body_destroy(body);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(flight_keeps_momentum_to_first_order),
    cmocka_unit_test(ballistic_flight_is_exact),
    cmocka_unit_test(free_top_precesses),
    cmocka_unit_test(top_on_a_point_precesses),
    cmocka_unit_test(double_pendulum_follows_the_textbook),
    cmocka_unit_test(box_stands_still),
    cmocka_unit_test(human_stands_still),
    cmocka_unit_test(sliding_block_decelerates_by_mu_g),
    cmocka_unit_test(a_small_block_feels_a_thick_mat),
    cmocka_unit_test(a_moving_mat_carries_a_block),
    cmocka_unit_test(block_sticks_on_a_slope),
    cmocka_unit_test(dropped_rod_comes_to_rest),
    cmocka_unit_test(bouncing_block_gains_nothing),
    cmocka_unit_test(integrator_is_of_first_order_in_contact),
  };
  return cmocka_run_group_tests_name("step physics", tests, NULL, NULL);
}
