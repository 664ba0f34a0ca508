/* What every operator of dynamics_operators.h computes for one item, and its adjoint. */
#include "physics/operators.h"
#include "physics/physics.h"

#include <string.h>

static const kg_body *body_of(const kg_rule_item *item)
{
  return item->operators->body;
}

/* arrays of 3-vectors as they lie on the tape */
static kg_vec3 *vectors(double *x)
{
  return (kg_vec3 *)(void *)x;
}

static const kg_vec3 *const_vectors(const double *x)
{
  return (const kg_vec3 *)(const void *)x;
}

static kg_status finite_or_undefined(const double *x, int count)
{
  for (int k = 0; k < count; k++) {
    if (!isfinite(x[k])) return KG_ERR_UNDEFINED;
  }
  return KG_OK;
}

/* ---- dynamics ---------------------------------------------------------------------------------*/

static kg_status inverse(const kg_rule_item *i)
{
  kg_dynamics_inverse(i->operators->dynamics, i->out, i->in[0], i->in[1], i->in[2]);
  return KG_OK;
}

static kg_status inverse_vjp(const kg_rule_item *i)
{
  kg_dynamics_inverse_vjp(i->operators->dynamics, i->bar[0], i->bar[1], i->bar[2], NULL, i->in[0],
                          i->in[1], i->in[2], i->out_bar);
  return KG_OK;
}

static kg_status forward(const kg_rule_item *i)
{
  kg_dynamics_forward(i->operators->dynamics, i->out, i->in[0], i->in[1], i->in[2]);
  return finite_or_undefined(i->out, body_of(i)->nv);
}

static kg_status forward_vjp(const kg_rule_item *i)
{
  kg_dynamics_forward_vjp(i->operators->dynamics, i->bar[0], i->bar[1], i->bar[2], i->in[0],
                          i->in[1], i->out, i->out_bar);
  return KG_OK;
}

/* ---- kinematics -------------------------------------------------------------------------------*/

static kg_status positions(const kg_rule_item *i)
{
  kg_dynamics_pose(i->operators->dynamics, i->in[0], vectors(i->out), NULL);
  return KG_OK;
}

static kg_status positions_vjp(const kg_rule_item *i)
{
  kg_dynamics_motion_vjp(i->operators->dynamics, i->bar[0], NULL, NULL, NULL, i->in[0], NULL, NULL,
                         const_vectors(i->out_bar), NULL, NULL);
  return KG_OK;
}

static kg_status velocities(const kg_rule_item *i)
{
  kg_dynamics_velocity(i->operators->dynamics, i->in[0], i->in[1], NULL, NULL, vectors(i->out),
                       NULL);
  return KG_OK;
}

static kg_status velocities_vjp(const kg_rule_item *i)
{
  kg_dynamics_motion_vjp(i->operators->dynamics, i->bar[0], i->bar[1], NULL, NULL, i->in[0],
                         i->in[1], NULL, NULL, const_vectors(i->out_bar), NULL);
  return KG_OK;
}

static kg_status accelerations(const kg_rule_item *i)
{
  kg_dynamics_acceleration(i->operators->dynamics, i->in[0], i->in[1], i->in[2], vectors(i->out),
                           NULL);
  return KG_OK;
}

static kg_status accelerations_vjp(const kg_rule_item *i)
{
  kg_dynamics_motion_vjp(i->operators->dynamics, i->bar[0], i->bar[1], i->bar[2], NULL, i->in[0],
                         i->in[1], i->in[2], NULL, NULL, const_vectors(i->out_bar));
  return KG_OK;
}

static kg_status point_positions(const kg_rule_item *i)
{
  kg_dynamics_points(i->operators->dynamics, vectors(i->out), NULL, i->in[0], NULL);
  return KG_OK;
}

static kg_status point_positions_vjp(const kg_rule_item *i)
{
  kg_dynamics_points_vjp(i->operators->dynamics, i->bar[0], NULL, i->in[0], NULL,
                         const_vectors(i->out_bar), NULL);
  return KG_OK;
}

/* ---- forces -----------------------------------------------------------------------------------*/

static kg_status point_forces(const kg_rule_item *i)
{
  kg_dynamics_point_forces(i->operators->dynamics, i->out, i->in[0], const_vectors(i->in[1]));
  return KG_OK;
}

static kg_status point_forces_vjp(const kg_rule_item *i)
{
  kg_dynamics_point_forces_vjp(i->operators->dynamics, i->bar[0],
                               i->bar[1] ? vectors(i->bar[1]) : NULL, i->in[0],
                               const_vectors(i->in[1]), i->out_bar);
  return KG_OK;
}

/* the six numbers of a law, or the step's own */
static kg_status law_of(const kg_rule_item *i, const double *law, kg_contact_params *params)
{
  *params = i->operators->law;
  if (!law) return KG_OK;
  *params = (kg_contact_params){law[0], law[1], law[2], law[3], law[4], law[5]};
  return kg_contact_params_are_valid(params) ? KG_OK : KG_ERR_UNDEFINED;
}

static kg_status contact_forces(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  kg_contact_params law;
  const kg_status status = law_of(i, i->in[2], &law);
  if (status != KG_OK) return status;
  kg_dynamics_points(o->dynamics, o->x, o->u, i->in[0], i->in[1]);
  for (int k = 0; k < o->body->point_count; k++) {
    kg_contact_force c;
    (void)kg_contact_evaluate(&law, &o->scene, o->x[k], o->u[k], false, &c);
    vectors(i->out)[k] = c.f;
  }
  return KG_OK;
}

static kg_status contact_forces_vjp(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  const kg_vec3 none = {0.0, 0.0, 0.0};
  kg_contact_params law;
  const kg_status status = law_of(i, i->in[2], &law);
  if (status != KG_OK) return status;
  kg_dynamics_points(o->dynamics, o->x, o->u, i->in[0], i->in[1]);
  for (int k = 0; k < o->body->point_count; k++) {
    const kg_vec3 f_bar = const_vectors(i->out_bar)[k], u = o->u[k];
    kg_contact_force c;
    o->u[k] = none; /* from here on adjoints */
    if (kg_contact_evaluate(&law, &o->scene, o->x[k], u, true, &c)) {
      if (i->bar[2]) kg_contact_params_vjp(&law, &c, u, f_bar, i->bar[2]);
      o->x[k] = kg_mat3_mul_vec_t(c.df_dx, f_bar);
      o->u[k] = kg_mat3_mul_vec_t(c.df_du, f_bar);
    } else {
      o->x[k] = none;
    }
  }
  kg_dynamics_points_vjp(o->dynamics, i->bar[0], i->bar[1], i->in[0], i->in[1], o->x, o->u);
  return KG_OK;
}

/* ---- the step ---------------------------------------------------------------------------------*/

/* The numbers of the call into the step: contact law (3), masses (4), offsets (5). */
static kg_status prepare_step(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  kg_contact_params law;
  const kg_status status = law_of(i, i->in[3], &law);
  if (status != KG_OK) return status;
  kg_step_set_contact(o->step, &law);
  const bool changes = i->in[4] || i->in[5];
  if (!changes && !o->changed) return KG_OK;
  o->changed = true; /* also when a mass is refused half-way */
  for (int s = 0; s < o->body->segment_count; s++) {
    kg_segment *segment = &o->body->segments[s];
    segment->mass = i->in[4] ? i->in[4][s] : o->source->segments[s].mass;
    segment->offset = i->in[5] ? kg_load3(i->in[5] + 3 * s) : o->source->segments[s].offset;
    if (!(segment->mass >= 0.0)) return KG_ERR_UNDEFINED;
  }
  o->changed = changes;
  kg_step_refresh(o->step);
  return KG_OK;
}

static kg_status step(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  const kg_status status = prepare_step(i);
  if (status != KG_OK) return status;
  kg_step_report report;
  kg_step_advance(o->step, i->out, i->out + o->body->nq, i->in[0], i->in[1], i->in[2], o->dt, false,
                  &report);
  *i->saved = report.substeps;
  return report.converged ? KG_OK : KG_ERR_UNDEFINED;
}

/* Adjoint of q' by its numbers, turned into the tangent: q' exp(d) changes by q' (0, d/2). */
static void to_tangent(const kg_body *body, const double *q, const double *bar, double *tangent)
{
  memcpy(tangent, bar, 3 * sizeof *bar);
  for (int k = 0; k < body->segment_count; k++) {
    const kg_quat turn = kg_quat_mul(kg_quat_conj(kg_state_quat(q, k)), kg_state_quat(bar, k));
    kg_store3(tangent + 3 + 3 * k, kg_vec3_scale(0.5, kg_vec3_make(turn.x, turn.y, turn.z)));
  }
}

static kg_status step_vjp(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  const kg_status status = prepare_step(i);
  if (status != KG_OK) return status;
  to_tangent(o->body, i->out, i->out_bar, o->end_bar);
  const kg_step_gradient gradient = {.q = i->bar[0],
                                     .v = i->bar[1],
                                     .tau = i->bar[2],
                                     .contact = i->bar[3],
                                     .body = {.mass = i->bar[4], .offset = i->bar[5]}};
  return kg_step_vjp(o->step, &gradient, i->in[0], i->in[1], i->in[2], o->dt, i->out + o->body->nq,
                     (int)*i->saved, o->end_bar, i->out_bar + o->body->nq);
}

/* ---- penetration ------------------------------------------------------------------------------*/

/* the conditions of the least move must hold to this, kg^1/2 m, or its derivative is not one */
#define CORRECTION_RESIDUAL 1e-8

static kg_status collision(const kg_rule_item *i)
{
  (void)kg_penetration(i->operators->correction, i->in[0], i->out, NULL);
  return finite_or_undefined(i->out, 1);
}

static kg_status collision_vjp(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  (void)kg_penetration(o->correction, i->in[0], NULL, o->end_bar);
  for (int k = 0; k < o->body->nv; k++) {
    i->bar[0][k] += i->out_bar[0] * o->end_bar[k];
  }
  return KG_OK;
}

static kg_status correction(const kg_rule_item *i)
{
  memcpy(i->out, i->in[0], (size_t)body_of(i)->nq * sizeof *i->out);
  const kg_correction_report report =
    kg_correction_apply(i->operators->correction, i->out, NULL, NULL);
  const bool moved = report.displacement > 0.0;
  return report.converged && !(moved && report.kkt_residual > CORRECTION_RESIDUAL)
           ? KG_OK
           : KG_ERR_UNDEFINED;
}

static kg_status correction_vjp(const kg_rule_item *i)
{
  kg_dynamics_operators *o = i->operators;
  to_tangent(o->body, i->out, i->out_bar, o->end_bar);
  return kg_correction_vjp(o->correction, i->in[0], i->out, o->end_bar, i->bar[0])
           ? KG_OK
           : KG_ERR_UNDEFINED;
}

const kg_rule kg_rules[KG_RULE_COUNT] = {
  [KG_RULE_INVERSE] = {"inverse_dynamics",
                       {KG_RULE_STATE, KG_RULE_RATE, KG_RULE_RATE},
                       KG_RULE_RATE,
                       inverse,
                       inverse_vjp},
  [KG_RULE_FORWARD] = {"forward_dynamics",
                       {KG_RULE_STATE, KG_RULE_RATE, KG_RULE_RATE},
                       KG_RULE_RATE,
                       forward,
                       forward_vjp},
  [KG_RULE_POSITIONS] =
    {"joint_positions", {KG_RULE_STATE}, KG_RULE_JOINTS, positions, positions_vjp},
  [KG_RULE_VELOCITIES] =
    {"joint_velocities", {KG_RULE_STATE, KG_RULE_RATE}, KG_RULE_JOINTS, velocities, velocities_vjp},
  [KG_RULE_ACCELERATIONS] = {"joint_accelerations",
                             {KG_RULE_STATE, KG_RULE_RATE, KG_RULE_RATE},
                             KG_RULE_JOINTS,
                             accelerations,
                             accelerations_vjp},
  [KG_RULE_POINT_POSITIONS] =
    {"point_positions", {KG_RULE_STATE}, KG_RULE_POINTS, point_positions, point_positions_vjp},
  [KG_RULE_POINT_FORCES] =
    {"point_forces", {KG_RULE_STATE, KG_RULE_POINTS}, KG_RULE_RATE, point_forces, point_forces_vjp},
  [KG_RULE_CONTACT_FORCES] = {"contact_forces",
                              {KG_RULE_STATE, KG_RULE_RATE, KG_RULE_LAW},
                              KG_RULE_POINTS,
                              contact_forces,
                              contact_forces_vjp},
  [KG_RULE_STEP] = {"implicit_step",
                    {KG_RULE_STATE, KG_RULE_RATE, KG_RULE_RATE, KG_RULE_LAW, KG_RULE_MASSES,
                     KG_RULE_OFFSETS},
                    KG_RULE_BOTH,
                    step,
                    step_vjp},
  [KG_RULE_COLLISION] = {"collision_loss", {KG_RULE_STATE}, KG_RULE_ONE, collision, collision_vjp},
  [KG_RULE_CORRECTION] =
    {"corrected_pose", {KG_RULE_STATE}, KG_RULE_STATE, correction, correction_vjp},
};
