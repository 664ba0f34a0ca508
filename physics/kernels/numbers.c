/* The recursive algorithms for one kind of number (KG_NUMBER) and one instruction set (KG_ISA), and
 * their table. */
#include "physics/kernels/kernels.h"

#include "physics/kernels/number.h"

#include "physics/kernels/recursive.inc"

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
/* clang-format on */

_Static_assert(sizeof(forward_link) >= sizeof(inverse_link) &&
                 sizeof(forward_link) >= sizeof(moving_link),
               "scratch for the largest");
extern const kg_number_kernels KG_NUMBER_TABLE(KG_NUMBER, KG_ISA);
const kg_number_kernels KG_NUMBER_TABLE(KG_NUMBER, KG_ISA) = {
  .scratch = sizeof(forward_link), /* the largest */
  .inverse = inverse,
  .forward = forward,
  .mass_solve = mass_solve,
  .kinematics = kinematics,
};
