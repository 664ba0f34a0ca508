/* kinegrad/program.h - a recorded graph, frozen: run again at new inputs without recording.
 *
 * Freezing keeps what the outputs need (dead code goes), computes once what depends on no input,
 * and shares the values of equal subexpressions. The numbers stay bit for bit those of recording:
 * equal subexpressions share their value and keep their own adjoints, summed in the recorded order.
 *
 * Lanes. A program runs `lanes` independent instances side by side: each number becomes a row of
 * `lanes` numbers, (entry, lane) with the lane fastest, so scalar formulas run at vector speed.
 * lanes = 1 is plain row-major data.
 *
 * Choices. min, max, clamp, where and the like choose anew on every run. An `if` of the recording
 * code (kg_is_less) cannot: when a run's inputs turn one around, kg_program_run returns
 * KG_ERR_STALE, and kg_program_error names the operands' operator, the tag and the lane. The
 * outputs are then not to be used.
 *
 * A program does not refer to its tape once made. Not shared between threads: one copy for each. */
#ifndef KINEGRAD_PROGRAM_H
#define KINEGRAD_PROGRAM_H

#include "kinegrad/operators.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_program kg_program;

typedef struct kg_program_def {
  int lanes;      /* 1 */
  bool arithmetic_complex; /* false; true: numbers are C's double complex, for complex steps */
  const kg_allocator *allocator; /* NULL: malloc and free */
} kg_program_def;

KG_API kg_program_def kg_program_default_def(void);

/* Freezes the part of the tape between inputs and outputs. Inputs are values made by kg_input or
 * kg_scalar, or by kg_constant or kg_constant_scalar: data that change from run to run and are not
 * differentiated. All other inputs of the tape are constants of the program. def == NULL: the
 * default. */
KG_API KG_MUST_USE kg_status kg_program_create(const kg_program_def *def, const kg_tape *tape,
                                               int input_count, const kg_value *inputs,
                                               int output_count, const kg_value *outputs,
                                               kg_program **program, kg_error *error);
KG_API void kg_program_destroy(kg_program *program);

typedef struct kg_program_info {
  int inputs, outputs, lanes;
  size_t recorded;  /* values between inputs and outputs on the tape, dead code included */
  size_t dead;      /* of them, not needed by any output                                 */
  size_t constant;  /* of the rest, computed while freezing                              */
  size_t shared;    /* of the rest, equal to an earlier one                              */
  size_t run;       /* operators of one run                                              */
  size_t bytes;     /* memory held                                                       */
} kg_program_info;
KG_API kg_program_info kg_program_describe(const kg_program *program);

/* Where to write input i before a run: (size, lanes) numbers of the program's kind (double; float
 * of a float tape; double complex if asked). Starts with the recorded numbers in every lane. Owned
 * by the program. */
KG_API void *kg_program_input(kg_program *program, int i);
/* Output o after a run, (size, lanes). */
KG_API const void *kg_program_output(const kg_program *program, int o);
KG_API size_t kg_program_input_size(const kg_program *program, int i);  /* without lanes */
KG_API size_t kg_program_output_size(const kg_program *program, int o); /* without lanes */

KG_API kg_status kg_program_run(kg_program *program);
/* Text of the last failure. */
KG_API const kg_error *kg_program_error(const kg_program *program);

/* Where to write the adjoint of output o before kg_program_backward:
 * (directions, size, lanes). The space belongs to the program and is zeroed by this call when the
 * number of directions changes. NULL when memory is refused. */
KG_API void *kg_program_seed(kg_program *program, int o, int directions);

/* Backward from the seeds, at the last run. The inputs must still hold what was run: the sweep
 * reads them again. */
KG_API kg_status kg_program_backward(kg_program *program, int directions);
/* The adjoint of input i, (directions, size, lanes), until the next sweep. NULL when the input was
 * made as a constant, and when the last sweep failed, went forward or was not there at all. */
KG_API const void *kg_program_adjoint(const kg_program *program, int i);

/* Where to write the tangent of input i before kg_program_forward, (directions, size, lanes); as
 * kg_program_seed. */
KG_API void *kg_program_tangent(kg_program *program, int i, int directions);
/* Forward along the tangents, at the last run; likewise. */
KG_API kg_status kg_program_forward(kg_program *program, int directions);
/* The tangent of output o, (directions, size, lanes), until the next sweep; NULL unless the last
 * one went forward and succeeded. */
KG_API const void *kg_program_output_tangent(const kg_program *program, int o);

#ifdef __cplusplus
}
#endif
#endif
