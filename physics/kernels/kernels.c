/* All kernels of physics/ for one instruction set (KG_ISA) and their table. */
#include "physics/kernels/kernels.h"

#include "base/rotation_series.h"

#include "physics/contact_law.h"
#include "physics/physics.h"

#include "physics/kernels/rows.h"

#include <math.h>

#include "physics/kernels/factor.inc"
#include "physics/kernels/jacobian.inc"
#include "physics/kernels/lanes.inc"
#include "physics/kernels/law.inc"
#include "physics/kernels/links.inc"
#ifdef KG_ROW4_IS_VECTOR
#include "physics/kernels/inverse_rows.inc"
#else
typedef char inverse_rows; /* takes no scratch */
#endif
#include "physics/kernels/rotations.inc"
#include "physics/kernels/wrenches.inc"

extern const kg_number_kernels KG_NUMBER_TABLE(1, KG_ISA);
extern const kg_number_kernels KG_NUMBER_TABLE(8, KG_ISA);

#define KG_PASTE_(a, b) a##b
#define KG_PASTE(a, b) KG_PASTE_(a, b)

const kg_physics_kernels KG_PASTE(kg_physics_kernels_, KG_ISA) = {
  .factor = factor,
  .solve = solve,
  .solve_from = solve_from,
  .solve_transposed = solve_transposed,
  .solve_many = solve_many,
  .solve_transposed_many = solve_transposed_many,
  .link_scratch = sizeof(link_rows) > sizeof(inverse_rows) ? sizeof(link_rows)
                                                           : sizeof(inverse_rows),
  .move = move_links,
  .prepare = prepare,
  .prepare_mass = prepare_mass,
  .pencil = make_pencil,
  .jacobian = jacobian,
  .derivatives = derivatives,
  .dense_mass = dense_mass,
  .to_lanes = to_lanes,
  .from_lanes = from_lanes,
#ifdef KG_ROW4_IS_VECTOR
  .inverse = inverse_rows_frame,
#endif
  .integrate_joints = integrate_joints,
  .turns_by_rate = turns_by_rate,
  .add_motion = add_motion,
  .wrench_rows = wrench_rows,
  .add_contact = add_contact,
  .add_rows = add_rows,
  .solve_dense = solve_dense,
  .plane_ground = plane_ground,
  .settle_points = settle_points,
  .law_forces = law_forces,
  .law_derivatives = law_derivatives,
  .linear_forces = linear_forces,
  .one = &KG_NUMBER_TABLE(1, KG_ISA),
  .eight = &KG_NUMBER_TABLE(8, KG_ISA),
};
