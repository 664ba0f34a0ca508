/* A box slides to rest; how far, and by what would that change? Twice: as a run of steps with its
 * gradient, and step by step on the tape. Explained in docs/guide/differentiate-a-simulation.md. */
#include <stdio.h>
#include <stdlib.h>

#include "kinegrad/derivatives.h"
#include "kinegrad/dynamics_operators.h"
#include "kinegrad/rollout.h"

enum { NQ = 7, NV = 6, STEPS = 100 };
static const double DT = 0.005;

/* 8 kg, 40 x 20 x 40 cm, corners as contact points */
static kg_status create_box(kg_body **body)
{
  const kg_segment box = {
    .name = "box", .parent = -1, .mass = 8, .inertia = {0.133, 0.213, 0.133, 0, 0, 0}};
  kg_body_point corners[8];
  for (int k = 0; k < 8; ++k) {
    corners[k] = (kg_body_point){0, {k & 1 ? 0.2 : -0.2, k & 2 ? 0.1 : -0.1, k & 4 ? 0.2 : -0.2}};
  }
  return kg_body_create(body, &box, 1, corners, 8, NULL);
}

/* [cost] */
/* the place of the box along x after the last step */
static void at_the_end(void *user, int t, const double *q, const double *v, double *q_bar,
                       double *v_bar)
{
  (void)user, (void)q, (void)v, (void)v_bar;
  if (t == STEPS) q_bar[0] += 1;
}
/* [cost] */

static kg_status slide(kg_step *step, const double *q, const double *v)
{
  static const double tau[STEPS * NV]; /* nothing pushes */
  /* [run] */
  const kg_rollout_def def = {.step = step, .max_steps = STEPS, .dt = DT, .checkpoints = true};
  kg_rollout *rollout;
  kg_status status = kg_rollout_create(&rollout, &def);
  if (status != KG_OK) return status;
  double *path = malloc((STEPS + 1) * NQ * sizeof *path);
  double by_v[NV] = {0}, by_law[KG_CONTACT_PARAM_COUNT] = {0};
  const kg_rollout_gradient gradient = {.v = by_v, .contact = by_law};
  status = kg_rollout_run(rollout, STEPS, q, v, tau, path, NULL, NULL);
  if (status == KG_OK) status = kg_rollout_vjp(rollout, &gradient, at_the_end, NULL);
  /* [run] */
  if (status == KG_OK) {
    printf("slides %.3f m; by its speed %.3f s, by the friction %.3f m\n",
           path ? path[STEPS * NQ] : 0, by_v[0], by_law[4]);
  }
  free(path);
  kg_rollout_destroy(rollout);
  return status;
}

static kg_status slide_on_tape(kg_tape *tape, const kg_step_def *def, const double *q0,
                               const double *v0)
{
  kg_dynamics_operators *operators;
  const kg_status status = kg_dynamics_operators_create(&operators, def, DT);
  if (status != KG_OK) return status;
  /* [tape] */
  const kg_value start = kg_input(tape, KG_SHAPE(NV), v0), none = {0};
  const kg_value rest = kg_constant(tape, KG_SHAPE(NV), NULL);
  kg_value q = kg_constant(tape, KG_SHAPE(NQ), q0), v = start;
  for (int t = 0; t < STEPS; ++t) {
    const kg_value next = kg_implicit_step(tape, operators, q, v, rest, none, none, none);
    q = kg_slice(tape, next, 0, 0, NQ);
    v = kg_slice(tape, next, 0, NQ, NV);
  }
  if (kg_backward(tape, kg_element(tape, q, 0)) != KG_OK)
    fprintf(stderr, "%s\n", kg_tape_error(tape)->text);
  else
    printf("on the tape: %.3f m, by its speed %.3f s\n", kg_item(tape, q),
           kg_adjoint_item(tape, start));
  /* [tape] */
  const kg_status recorded = kg_tape_status(tape);
  kg_dynamics_operators_destroy(operators);
  return recorded;
}

int main(void)
{
  const double q[NQ] = {0, 0.1035, 0, 1, 0, 0, 0}, v[NV] = {1.5};
  const double mu = 0.5, g = 9.8;
  const kg_scene floor = kg_scene_ground(0, kg_vec3_make(0, 1, 0));
  kg_body *body = NULL;
  kg_step *step = NULL;
  kg_tape *tape = NULL;
  kg_status status = create_box(&body);
  if (status == KG_OK) {
    kg_step_def def = kg_step_default_def(body);
    def.scene = &floor;
    def.contact.friction = mu;
    status = kg_step_create(&step, &def);
    if (status == KG_OK) status = slide(step, q, v);
    if (status == KG_OK) status = kg_tape_create(NULL, &tape, NULL);
    if (status == KG_OK) status = slide_on_tape(tape, &def, q, v);
  }
  printf("by the textbook, v^2 / (2 mu g): %.3f m; %.3f s, %.3f m\n", v[0] * v[0] / (2 * mu * g),
         v[0] / (mu * g), -v[0] * v[0] / (2 * mu * mu * g));
  kg_tape_destroy(tape);
  kg_step_destroy(step);
  kg_body_destroy(body);
  return status == KG_OK ? 0 : 1;
}
