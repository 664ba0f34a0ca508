/* All kernels for one arithmetic and one instruction set, and their table. Compiled once for
 * each pair (CMakeLists.txt); which table a tape uses is decided when it is created
 * (kg_kernels_for).
 *
 * Every operator has name_forward, name_vjp and name_jvp; see kg_kernel in graph.h for what they
 * do. */
#include "autodiff/attributes.h"

#include <float.h>
#include <string.h>

#include "autodiff/kernels/number.h"

#include "autodiff/kernels/elementwise.inc"
#include "autodiff/kernels/choice.inc"
#include "autodiff/kernels/reductions.inc"
#include "autodiff/kernels/matrix.inc"
#include "autodiff/kernels/moves.inc"
#include "autodiff/kernels/rotations.inc"
#include "autodiff/kernels/networks.inc"

/* clang-format off */
#define ROW(name, ...) [kg_op_##name] = {name##_forward, name##_vjp, name##_jvp},
#define TENSOR_ROW(name) ROW(name, 0)
#define PRIMITIVE_ROW                                                                              \
  [kg_op_primitive] = {kg_primitive_forward, kg_primitive_vjp, kg_primitive_jvp},
const kg_kernel KG_TABLE(KG_TYPE, KG_ISA)[KG_OP_COUNT] = {
  PRIMITIVE_ROW KG_UNARY_LIST(ROW) KG_TRIG_LIST(ROW) KG_CLAMP_LIST(ROW) KG_BINARY_LIST(ROW)
  CHOICE_ROWS REDUCTION_ROWS MATRIX_ROWS MOVE_ROWS ROTATION_ROWS NETWORK_ROWS
};
/* clang-format on */
