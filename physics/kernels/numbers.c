/* The recursive algorithms for one kind of number (KG_NUMBER) and one instruction set (KG_ISA), and
 * their table. */
#include "physics/kernels/kernels.h"

#include "physics/kernels/number.h"

#include "physics/kernels/recursive.inc"
#include "physics/kernels/world.inc"
#include "physics/kernels/tree_numbers.inc"
#include "physics/kernels/forward_derivatives.inc"

/* All frames of a call, WIDTH at a time. */
#define IN_PARTS(name)                                                                             \
  static void name(const kg_model *model, double *out, const double *q, const double *x,           \
                   const double *y)                                                                \
  {                                                                                                \
    for (int k = 0; k < KG_NUMBER; k += WIDTH) {                                                   \
      name##_frames(model, out + k, q + k, x ? x + k : x, y ? y + k : y);                          \
    }                                                                                              \
  }
/* clang-format off */
IN_PARTS(inverse)
IN_PARTS(forward)
IN_PARTS(mass_solve)
IN_PARTS(kinematics)
IN_PARTS(acceleration)
IN_PARTS(centroid)
IN_PARTS(centroidal_matrix)
/* clang-format on */

static double *part(double *array, int k)
{
  return array ? array + k : array;
}

static void point(const kg_model *model, double *x, double *J, const double *q, int segment,
                  const double s[3])
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    point_frames(model, x + k, part(J, k), q + k, segment, s);
  }
}

static void mass_matrix(const kg_model *model, const kg_tree *tree, double *low, const double *q)
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    mass_matrix_frames(model, tree, low + k, q + k);
  }
}

static void factor(const kg_tree *tree, double *low)
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    factor_frames(tree, low + k);
  }
}

static void factor_solve(const kg_tree *tree, const double *low, double *x)
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    factor_solve_frames(tree, low + k, x + k);
  }
}

static void inverse_derivatives(const kg_model *model, const kg_tree *tree,
                                const kg_lanes_outputs *out, const double *q, const double *v,
                                const double *a)
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    const kg_lanes_outputs at = {part(out->q_low, k), part(out->q_up, k), part(out->v_low, k),
                                 part(out->v_up, k), part(out->mass, k)};
    inverse_derivatives_frames(model, tree, &at, q + k, v + k, a + k);
  }
}

static void forward_derivatives(const kg_model *model, const kg_tree *tree,
                                const kg_lanes_dense *out, const double *q, const double *v,
                                const double *a, const double *tau)
{
  for (int k = 0; k < KG_NUMBER; k += WIDTH) {
    const kg_lanes_dense at = {part(out->by_q, k), part(out->by_v, k), part(out->by_tau, k)};
    forward_derivatives_frames(model, tree, &at, q + k, v + k, a + k, tau + k);
  }
}

enum { DERIVATIVES_SCRATCH = sizeof(world_link) + sizeof(articulated) + sizeof(response) };
_Static_assert(sizeof(forward_link) >= sizeof(inverse_link) &&
                 sizeof(forward_link) >= sizeof(moving_link) &&
                 sizeof(forward_link) <= (size_t)DERIVATIVES_SCRATCH,
               "scratch for the largest");
extern const kg_number_kernels KG_NUMBER_TABLE(KG_NUMBER, KG_ISA);
const kg_number_kernels KG_NUMBER_TABLE(KG_NUMBER, KG_ISA) = {
  .scratch = DERIVATIVES_SCRATCH, /* the largest */
  .inverse = inverse,
  .forward = forward,
  .mass_solve = mass_solve,
  .kinematics = kinematics,
  .acceleration = acceleration,
  .centroid = centroid,
  .centroidal_matrix = centroidal_matrix,
  .point = point,
  .mass_matrix = mass_matrix,
  .factor = factor,
  .factor_solve = factor_solve,
  .inverse_derivatives = inverse_derivatives,
  .forward_derivatives = forward_derivatives,
};
