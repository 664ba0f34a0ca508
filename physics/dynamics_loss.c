/* L_dyn (Eq. 2) and the velocities it needs, composed of operators of the tape.
 *
 * Equation numbers: docs/theory/dynamics.md, section 9. */
#include "kinegrad/losses.h"

#include "autodiff/tape.h"
#include "physics/operators.h"

/* `count` frames from `first` on; frames are `behind` axes before the last */
static kg_value frames(kg_tape *tape, kg_value x, int behind, int first, int count)
{
  return kg_slice(tape, x, -1 - behind, first, count);
}

static int frame_count(const kg_tape *tape, kg_value x, int behind)
{
  const kg_shape shape = kg_shape_of(tape, x);
  return shape.rank > behind ? shape.dim[shape.rank - 1 - behind] : 0;
}

/* the shape of x with other numbers in the last axis */
static kg_shape with_last(const kg_tape *tape, kg_value x, int32_t last)
{
  kg_shape shape = kg_shape_of(tape, x);
  shape.dim[shape.rank - 1] = last;
  return shape;
}

/* (..., 3 + 4 n) -> unit quaternions (..., n, 4) */
static kg_value rotations(kg_tape *tape, const kg_body *body, kg_value q)
{
  const kg_value flat = kg_slice(tape, q, -1, 3, 4 * body->segment_count);
  kg_shape shape = kg_shape_of(tape, flat);
  if (kg_is_null(flat) || shape.rank == KG_MAX_RANK) return (kg_value){0};
  shape.dim[shape.rank - 1] = body->segment_count;
  shape.dim[shape.rank++] = 4;
  return kg_normalize(tape, kg_reshape(tape, flat, shape));
}

/* (C1) */
kg_value kg_motion_velocities(kg_tape *tape, kg_dynamics_operators *operators, double dt,
                              kg_value q)
{
  static const double conjugate[4] = {1.0, -1.0, -1.0, -1.0};
  const kg_body *body = operators->source;
  const int count = frame_count(tape, q, 1) - 2;
  const kg_value before = frames(tape, q, 1, 0, count), after = frames(tape, q, 1, 2, count);
  const kg_value back =
    kg_mul(tape, rotations(tape, body, before), kg_constant(tape, KG_SHAPE(4), conjugate));
  const kg_value turn = kg_rotation_log(tape, kg_compose(tape, back, rotations(tape, body, after)));
  const kg_value moved =
    kg_sub(tape, kg_slice(tape, after, -1, 0, 3), kg_slice(tape, before, -1, 0, 3));
  if (kg_is_null(turn) || kg_is_null(moved)) return (kg_value){0};
  const kg_value turns =
    kg_reshape(tape, turn, with_last(tape, moved, (int32_t)(3 * body->segment_count)));
  return kg_scale(tape, kg_concat(tape, -1, 2, (kg_value[2]){moved, turns}), 0.5 / dt);
}

/* (C2) second difference along the frames */
static kg_value differences(kg_tape *tape, double dt, kg_value p)
{
  const int count = frame_count(tape, p, 2) - 2;
  const double w = 1.0 / (dt * dt), weights[3] = {w, -2.0 * w, w};
  const kg_value terms[3] = {frames(tape, p, 2, 0, count), frames(tape, p, 2, 1, count),
                             frames(tape, p, 2, 2, count)};
  return kg_combine(tape, 3, weights, terms);
}

/* torques of all joints, with zeros for the root where it has none */
static kg_value complete(kg_tape *tape, const kg_body *body, kg_value tau)
{
  const kg_shape shape = kg_shape_of(tape, tau);
  if (kg_is_null(tau) || shape.dim[shape.rank - 1] != body->nv - 6) return tau;
  const kg_value zeros = kg_constant(tape, with_last(tape, tau, 6), NULL);
  return kg_concat(tape, -1, 2, (kg_value[2]){zeros, tau});
}

/* (C3) accelerations of the joints under torques and forces */
static kg_value physical(kg_tape *tape, kg_dynamics_operators *operators, double dt, kg_value q,
                         kg_value tau, kg_value forces)
{
  const int count = frame_count(tape, q, 1) - 2;
  const kg_value at = frames(tape, q, 1, 1, count);
  const kg_value v = kg_motion_velocities(tape, operators, dt, q);
  kg_value total = complete(tape, operators->source, frames(tape, tau, 1, 1, count));
  if (!kg_is_null(forces)) {
    const kg_value inner = frames(tape, forces, 2, 1, count);
    total = kg_add(tape, total, kg_point_forces(tape, operators, at, inner));
  }
  const kg_value a = kg_forward_dynamics(tape, operators, at, v, total);
  return kg_joint_accelerations(tape, operators, at, v, a);
}

/* Whether an operand, if there is one, has as many frames as q; refused otherwise. */
static bool frames_fit(kg_tape *tape, kg_value q, kg_value x, int behind, const char *name)
{
  const int wanted = frame_count(tape, q, 1), count = frame_count(tape, x, behind);
  if (kg_is_null(x) || count == wanted) return true;
  kg_refuse(tape, KG_ERR_SHAPE, "dynamics_loss", "%s has %d frames, q has %d", name, count, wanted);
  return false;
}

kg_value kg_dynamics_loss(kg_tape *tape, kg_dynamics_operators *operators, double dt, kg_value q,
                          kg_value positions, kg_value tau, kg_value forces)
{
  if (kg_is_null(q) || kg_is_null(tau)) return (kg_value){0}; /* the tape holds why */
  if (!frames_fit(tape, q, tau, 1, "tau") || !frames_fit(tape, q, forces, 2, "forces") ||
      !frames_fit(tape, q, positions, 2, "positions")) {
    return (kg_value){0};
  }
  const kg_value places =
    kg_is_null(positions) ? kg_joint_positions(tape, operators, q) : positions;
  const kg_value mocap = differences(tape, dt, places);
  const kg_value model = physical(tape, operators, dt, q, tau, forces);
  const kg_value error = kg_sub(tape, mocap, model);
  const double count = (double)kg_size_of(tape, error) / (3.0 * operators->source->segment_count);
  return kg_scale(tape, kg_sum_all(tape, kg_square(tape, error)), 1.0 / count);
}
