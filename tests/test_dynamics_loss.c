/* L_dyn: against plain calls and cases with a known answer; its gradient by motion, torques and
 * forces against differences. */
#include "fixture_body.h"

#include "kinegrad/derivatives.h"
#include "kinegrad/gradcheck.h"
#include "kinegrad/losses.h"

#include <stdio.h>

enum { FRAMES = 5 };
static const double DT = 1.0 / 50.0;

typedef struct fixture {
  kg_body *body;
  kg_dynamics_operators *operators;
  kg_tape *tape;
} fixture;

static fixture fixture_of(kg_body *body)
{
  fixture f = {.body = body};
  const kg_step_def def = kg_step_default_def(body);
  assert_int_equal(kg_dynamics_operators_create(&f.operators, &def, DT), KG_OK);
  assert_int_equal(kg_tape_create(NULL, &f.tape, NULL), KG_OK);
  return f;
}

static void release(fixture *f)
{
  kg_tape_destroy(f->tape);
  kg_dynamics_operators_destroy(f->operators);
  kg_body_destroy(f->body);
}

/* A smooth motion: q_t = q_0 (+) t dt v (+) (t dt)^2 a / 2 */
static void motion(kg_random *random, const kg_body *body, double *q)
{
  double v[MAX_NV], a[MAX_NV], d[MAX_NV];
  random_state(random, body, q, v, a);
  for (int t = 1; t < FRAMES; t++) {
    const double s = t * DT;
    for (int k = 0; k < body->nv; k++) {
      d[k] = s * v[k] + 0.5 * s * s * a[k];
    }
    kg_body_integrate(body, q + t * body->nq, q, d);
  }
}

/* ---- value ------------------------------------------------------------------------------------*/

/* Eq. 2 written out with the plain calls */
static double plain_loss(const kg_body *body, const double *q, const double *tau, const kg_vec3 *f)
{
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  double sum = 0.0;
  for (int t = 1; t + 1 < FRAMES; t++) {
    const double *now = q + t * body->nq;
    double v[MAX_NV], a[MAX_NV], J[3 * MAX_NV], total[MAX_NV];
    kg_vec3 p[3][MAX_NV], p_ddot[MAX_NV];
    kg_body_difference(body, v, now + body->nq, now - body->nq);
    for (int k = 0; k < body->nv; k++) {
      v[k] /= 2.0 * DT;
      total[k] = tau[t * body->nv + k];
    }
    for (int c = 0; c < body->point_count; c++) {
      const kg_vec3 force = f[t * body->point_count + c];
      kg_dynamics_point(d, J, now, body->points[c]);
      for (int k = 0; k < body->nv; k++) {
        total[k] += J[k] * force.x + J[body->nv + k] * force.y + J[2 * body->nv + k] * force.z;
      }
    }
    kg_dynamics_forward(d, a, now, v, total);
    kg_dynamics_acceleration(d, now, v, a, p_ddot, NULL);
    for (int k = 0; k < 3; k++) {
      kg_dynamics_pose(d, now + (k - 1) * body->nq, p[k], NULL);
    }
    for (int i = 0; i < body->segment_count; i++) {
      kg_vec3 second = kg_vec3_add_scaled(kg_vec3_add(p[0][i], p[2][i]), -2.0, p[1][i]);
      second = kg_vec3_scale(1.0 / (DT * DT), second);
      const kg_vec3 error = kg_vec3_sub(second, p_ddot[i]);
      sum += kg_vec3_dot(error, error);
    }
  }
  kg_dynamics_destroy(d);
  return sum / (FRAMES - 2);
}

static kg_body *tree_with_points(kg_random *random)
{
  kg_body *tree = random_tree(random, 6, NULL), *body = NULL;
  const kg_body_point points[3] = {{0, {0.1, 0.0, 0.0}}, {3, {0, 0.1, 0}}, {5, {0, 0, 0.1}}};
  assert_int_equal(kg_body_create(&body, tree->segments, 6, points, 3, NULL), KG_OK);
  kg_body_destroy(tree);
  return body;
}

static void value_equals_plain_calls(void **state)
{
  (void)state;
  kg_random random = kg_random_make(41);
  fixture f = fixture_of(tree_with_points(&random));
  const int nq = f.body->nq, nv = f.body->nv;
  double q[FRAMES * MAX_NQ], tau[FRAMES * MAX_NV], forces[FRAMES * 9], *two;
  motion(&random, f.body, q);
  for (int k = 0; k < FRAMES * nv; k++) {
    tau[k] = kg_random_normal(&random);
  }
  for (int k = 0; k < FRAMES * 9; k++) {
    forces[k] = 10.0 * kg_random_normal(&random);
  }
  const kg_value Q = kg_input(f.tape, KG_SHAPE(FRAMES, nq), q);
  const kg_value T = kg_input(f.tape, KG_SHAPE(FRAMES, nv), tau);
  const kg_value F = kg_input(f.tape, KG_SHAPE(FRAMES, 3, 3), forces), none = {0};
  const double want = plain_loss(f.body, q, tau, (const kg_vec3 *)(const void *)forces);
  const kg_value loss = kg_dynamics_loss(f.tape, f.operators, DT, Q, none, T, F);
  assert_int_equal(kg_tape_status(f.tape), KG_OK);
  assert_close(kg_item(f.tape, loss), want, 1e-11);
  /* places given: those of another motion count */
  const kg_value P = kg_scale(f.tape, kg_joint_positions(f.tape, f.operators, Q), 1.0);
  assert_close(kg_item(f.tape, kg_dynamics_loss(f.tape, f.operators, DT, Q, P, T, F)), want, 1e-11);
  /* torques without the root's are torques with zeros there */
  for (int t = 0; t < FRAMES; t++) {
    memset(tau + t * nv, 0, 6 * sizeof *tau);
  }
  const kg_value inner = kg_slice(f.tape, T, -1, 6, nv - 6);
  const double unrooted = plain_loss(f.body, q, tau, (const kg_vec3 *)(const void *)forces);
  assert_close(kg_item(f.tape, kg_dynamics_loss(f.tape, f.operators, DT, Q, none, inner, F)),
               unrooted, 1e-11);
  /* two sequences: the mean */
  two = malloc(sizeof(double) * (size_t)(2 * FRAMES * nq));
  assert_non_null(two);
  memcpy(two, q, sizeof(double) * (size_t)(FRAMES * nq));
  memcpy(two + FRAMES * nq, q, sizeof(double) * (size_t)(FRAMES * nq));
  const kg_value both = kg_input(f.tape, KG_SHAPE(2, FRAMES, nq), two);
  const kg_value tau2 = kg_broadcast(f.tape, inner, KG_SHAPE(2, FRAMES, nv - 6));
  const kg_value forces2 = kg_broadcast(f.tape, F, KG_SHAPE(2, FRAMES, 3, 3));
  const kg_value loss2 = kg_dynamics_loss(f.tape, f.operators, DT, both, none, tau2, forces2);
  assert_int_equal(kg_tape_status(f.tape), KG_OK);
  assert_close(kg_item(f.tape, loss2), unrooted, 1e-11);
  free(two);
  release(&f);
}

/* ---- known answers ----------------------------------------------------------------------------*/

/* A box that rests: with the weight on its corners nothing is left, without forces 9.8^2 is. */
static void rest_needs_forces(void **state)
{
  (void)state;
  fixture f = fixture_of(box_body(8.0, kg_vec3_make(0.1, 0.2, 0.3)));
  double q[FRAMES * 7] = {0.0}, tau[FRAMES * 6] = {0.0}, forces[FRAMES * 24] = {0.0};
  for (int t = 0; t < FRAMES; t++) {
    q[7 * t + 3] = 1.0;
    for (int c = 0; c < 8; c++) {
      if (f.body->points[c].p.y < 0.0) forces[24 * t + 3 * c + 1] = 8.0 * 9.8 / 4.0;
    }
  }
  const kg_value Q = kg_input(f.tape, KG_SHAPE(FRAMES, 7), q), none = {0};
  const kg_value T = kg_input(f.tape, KG_SHAPE(FRAMES, 6), tau);
  const kg_value F = kg_input(f.tape, KG_SHAPE(FRAMES, 8, 3), forces);
  const kg_value held = kg_dynamics_loss(f.tape, f.operators, DT, Q, none, T, F);
  const kg_value left = kg_dynamics_loss(f.tape, f.operators, DT, Q, none, T, none);
  assert_int_equal(kg_tape_status(f.tape), KG_OK);
  assert_at_most(kg_item(f.tape, held), 1e-20);
  assert_close(kg_item(f.tape, left), 9.8 * 9.8, 1e-12);
  release(&f);
}

/* A spinning box on a parabola needs neither torque nor force. */
static void flight_needs_nothing(void **state)
{
  (void)state;
  fixture f = fixture_of(box_body(3.0, kg_vec3_make(0.1, 0.1, 0.3)));
  double q[FRAMES * 7], tau[FRAMES * 6] = {0.0};
  for (int t = 0; t < FRAMES; t++) {
    const double s = t * DT;
    const kg_quat turn = kg_quat_exp(kg_vec3_make(0.0, 0.0, 7.0 * s));
    const double row[7] = {2.0 * s, 1.0 + 3.0 * s - 4.9 * s * s, -s, turn.w, turn.x, turn.y,
                           turn.z};
    memcpy(q + 7 * t, row, sizeof row);
  }
  const kg_value Q = kg_input(f.tape, KG_SHAPE(FRAMES, 7), q), none = {0};
  const kg_value T = kg_input(f.tape, KG_SHAPE(FRAMES, 6), tau);
  const kg_value v = kg_motion_velocities(f.tape, f.operators, DT, Q);
  const kg_value loss = kg_dynamics_loss(f.tape, f.operators, DT, Q, none, T, none);
  assert_int_equal(kg_tape_status(f.tape), KG_OK);
  assert_close(kg_item_at(f.tape, v, 6 + 5), 7.0, 1e-12);
  assert_close(kg_item_at(f.tape, v, 6 + 1), 3.0 - 9.8 * 2 * DT, 1e-12);
  assert_at_most(kg_item(f.tape, loss), 1e-18);
  release(&f);
}

/* ---- gradient ---------------------------------------------------------------------------------*/

static kg_value record(kg_tape *tape, kg_value x, void *user)
{
  fixture *f = user;
  const int nq = f->body->nq, nv = f->body->nv;
  const kg_value q = kg_slice(tape, x, 0, 0, FRAMES * nq);
  const kg_value tau = kg_slice(tape, x, 0, FRAMES * nq, FRAMES * nv);
  const kg_value forces = kg_slice(tape, x, 0, FRAMES * (nq + nv), FRAMES * 9);
  return kg_dynamics_loss(tape, f->operators, DT, kg_reshape(tape, q, KG_SHAPE(FRAMES, nq)),
                          (kg_value){0}, kg_reshape(tape, tau, KG_SHAPE(FRAMES, nv)),
                          kg_reshape(tape, forces, KG_SHAPE(FRAMES, 3, 3)));
}

static void gradient_passes_the_check(void **state)
{
  (void)state;
  kg_random random = kg_random_make(42);
  fixture f = fixture_of(tree_with_points(&random));
  const int count = FRAMES * (f.body->nq + f.body->nv + 9);
  double x[FRAMES * (MAX_NQ + MAX_NV + 9)];
  motion(&random, f.body, x);
  for (int k = FRAMES * f.body->nq; k < count; k++) {
    x[k] = 10.0 * kg_random_normal(&random);
  }
  kg_gradcheck_def def = kg_gradcheck_default_def();
  kg_gradcheck_report report;
  kg_error error;
  char row[300];
  assert_int_equal(
    kg_gradcheck_recorded("dynamics loss", record, &f, KG_SHAPE(count), x, &def, &report, &error),
    KG_OK);
  kg_gradcheck_row(&report, row, sizeof row);
  print_message("%s\n", row);
  assert_true(report.passed);
  release(&f);
}

static void too_few_frames_are_refused(void **state)
{
  (void)state;
  fixture f = fixture_of(box_body(3.0, kg_vec3_make(0.1, 0.1, 0.3)));
  const double q[14] = {0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0};
  const kg_value Q = kg_input(f.tape, KG_SHAPE(2, 7), q), none = {0};
  const kg_value T = kg_input(f.tape, KG_SHAPE(2, 6), NULL);
  assert_true(kg_is_null(kg_dynamics_loss(f.tape, f.operators, DT, Q, none, T, none)));
  assert_int_equal(kg_tape_status(f.tape), KG_ERR_SHAPE);
  release(&f);
}

/* Torques and forces have the frames of the motion: not fewer, and not more. */
static void other_frames_are_refused(void **state)
{
  (void)state;
  fixture f = fixture_of(box_body(3.0, kg_vec3_make(0.1, 0.1, 0.3)));
  double q[FRAMES * 7] = {0.0};
  for (int t = 0; t < FRAMES; t++) {
    q[7 * t + 3] = 1.0;
  }
  const kg_tape_mark empty = {0};
  for (int frames = 1; frames <= 2 * FRAMES; frames++) {
    for (int kind = 0; kind < 3; kind++) {
      const kg_value Q = kg_input(f.tape, KG_SHAPE(FRAMES, 7), q), none = {0};
      const int of[3] = {kind == 0 ? frames : FRAMES, kind == 1 ? frames : FRAMES,
                         kind == 2 ? frames : FRAMES};
      const kg_value T = kg_input(f.tape, KG_SHAPE(of[0], 6), NULL);
      const kg_value F = kg_input(f.tape, KG_SHAPE(of[1], 8, 3), NULL);
      const kg_value P = kg_input(f.tape, KG_SHAPE(of[2], 1, 3), NULL);
      const kg_value loss =
        kg_dynamics_loss(f.tape, f.operators, DT, Q, kind == 2 ? P : none, T, F);
      assert_true(kg_is_null(loss) == (frames != FRAMES));
      if (frames != FRAMES) {
        char counts[40];
        (void)snprintf(counts, sizeof counts, "%d frames, q has %d", frames, FRAMES);
        assert_int_equal(kg_tape_status(f.tape), KG_ERR_SHAPE);
        assert_non_null(strstr(kg_tape_error(f.tape)->text, counts));
      }
      kg_tape_rewind(f.tape, empty);
    }
  }
  release(&f);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(value_equals_plain_calls),   cmocka_unit_test(rest_needs_forces),
    cmocka_unit_test(flight_needs_nothing),       cmocka_unit_test(gradient_passes_the_check),
    cmocka_unit_test(too_few_frames_are_refused), cmocka_unit_test(other_frames_are_refused),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
