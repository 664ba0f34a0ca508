/* Loops over autodiff/elementary.h, optimised for the instruction set in the compiler's options;
 * KG_LOOPS is the name of the table. */
#include "elementary_loops.h"

#include "autodiff/elementary.h"

#define LOOP(name, type, suffix)                                                                   \
  static void name##_loop_##suffix(const type *restrict x, type *restrict y, size_t n)             \
  {                                                                                                \
    for (size_t i = 0; i < n; ++i) {                                                               \
      y[i] = kg_##name##_##suffix(x[i]);                                                           \
    }                                                                                              \
  }
#define LOOPS(name) LOOP(name, double, f64) LOOP(name, float, f32)
LOOPS(exp)
LOOPS(expm1)
LOOPS(log)
LOOPS(log1p)
LOOPS(tanh)
LOOPS(sigmoid)
LOOPS(softplus)

#define sin_loop_f64 kg_sin_array_f64
#define cos_loop_f64 kg_cos_array_f64
#define sin_loop_f32 kg_sin_array_f32
#define cos_loop_f32 kg_cos_array_f32
#define ENTRY_F64(name) name##_loop_f64,
#define ENTRY_F32(name) name##_loop_f32,

const elementary_loops KG_LOOPS = {
  {KG_ELEMENTARY(ENTRY_F64)}, {KG_ELEMENTARY(ENTRY_F32)}, kg_sincos_array_f64, kg_sincos_array_f32};
