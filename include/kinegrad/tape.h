/* kinegrad/tape.h - reverse-mode automatic differentiation: the tape and its values.
 *
 *   kg_tape *tape;
 *   if (kg_tape_create(NULL, &tape, NULL) != KG_OK) ...
 *   const kg_value x = kg_scalar(tape, 2.0);
 *   const kg_value y = kg_mul(tape, x, kg_sin(tape, x));       y = x sin x
 *   kg_backward(tape, y);
 *   kg_adjoint_item(tape, x);                                  dy/dx = sin x + x cos x
 *   kg_tape_destroy(tape);
 *
 * Recording evaluates: every operator of operators.h computes its result at once and remembers
 * how it was made. derivatives.h walks the record backwards (gradients) or forwards (directional
 * derivatives), program.h freezes it for other inputs, primitive.h adds operators of your own.
 *
 * A tape is an ordinary object: any number may exist, each used by one thread at a time.
 *
 * Errors. An operator that fails returns the null value, and a null operand makes the null
 * value, so a formula may be written out and checked once: kg_tape_status holds the first
 * failure, kg_tape_error its text, which names the operator, the tag in force and the shapes.
 * Every call that returns a kg_status reports it too. kg_tape_rewind clears it. An operand that was
 * rewound or belongs to another tape is a mistake of the caller's that is not looked for.
 *
 * Memory. Values live until the tape is rewound past them or destroyed. Rewinding keeps the
 * memory: a loop that rewinds and records the same sizes again allocates nothing after its first
 * round. */
#ifndef KINEGRAD_TAPE_H
#define KINEGRAD_TAPE_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_tape kg_tape;

/* One recorded value: a scalar or a dense row-major tensor. Passed by value, owned by its tape.
 * All zero bits: the null value, the result of an operator that failed. */
typedef struct kg_value {
  uint32_t id;
} kg_value;

enum { KG_MAX_RANK = 4 };

/* Extents, the slowest first. Rank 0 is a scalar. Every extent is at least 1. */
typedef struct kg_shape {
  int32_t rank;
  int32_t dim[KG_MAX_RANK];
} kg_shape;

/* KG_SHAPE(64, 48): 64 rows of 48. KG_SCALAR_SHAPE: rank 0. */
#define KG_SHAPE(...)                                                                              \
  ((kg_shape){(int32_t)(sizeof((int32_t[]){__VA_ARGS__}) / sizeof(int32_t)), {__VA_ARGS__}})
#define KG_SCALAR_SHAPE ((kg_shape){0, {0}})
KG_API size_t kg_shape_size(const kg_shape *shape); /* entries */

/* The arithmetic of a whole tape. Float is for networks. */
typedef enum kg_precision { KG_DOUBLE, KG_FLOAT } kg_precision;

typedef struct kg_tape_def {
  kg_precision precision;        /* KG_DOUBLE */
  const kg_allocator *allocator; /* NULL: malloc and free; must outlive the tape */
  /* The widest instructions used: 0 plain x86-64, 2 AVX2, 3 AVX-512; default 3, and never more
   * than the processor has. Element-wise results do not depend on it; sums along contiguous
   * memory and matrix products may, in the last bits. */
  int simd;
} kg_tape_def;

KG_API kg_tape_def kg_tape_default_def(void);

/* def == NULL: the default. On failure *tape is NULL and *error says why. */
KG_API KG_MUST_USE kg_status kg_tape_create(const kg_tape_def *def, kg_tape **tape,
                                            kg_error *error);
KG_API void kg_tape_destroy(kg_tape *tape);

/* -- inputs ------------------------------------------------------------------------------------ */

/* A differentiable input. data (row-major, as many numbers as the shape has entries) is copied;
 * NULL gives zeros. */
KG_API kg_value kg_input(kg_tape *tape, kg_shape shape, const double *data);
KG_API kg_value kg_input_f32(kg_tape *tape, kg_shape shape, const float *data);
KG_API kg_value kg_scalar(kg_tape *tape, double x);
/* count of them: values[i] holds x[i]; all null on failure. */
KG_API void kg_scalars(kg_tape *tape, int count, const double *x, kg_value *values);

/* The same, never differentiated: no work is spent on its adjoint, and kg_adjoint refuses it. */
KG_API kg_value kg_constant(kg_tape *tape, kg_shape shape, const double *data);
KG_API kg_value kg_constant_f32(kg_tape *tape, kg_shape shape, const float *data);
KG_API kg_value kg_constant_scalar(kg_tape *tape, double x);

/* -- reading ----------------------------------------------------------------------------------- */

KG_API bool kg_is_null(kg_value value);
KG_API kg_shape kg_shape_of(const kg_tape *tape, kg_value value); /* rank 0 for the null value */
KG_API size_t kg_size_of(const kg_tape *tape, kg_value value);    /* 0 for the null value */

/* The numbers of a tensor: valid until the tape is rewound past it. Of a scalar: valid until the
 * next operator. NULL for the null value and for a tape of the other precision. */
KG_API const double *kg_data(const kg_tape *tape, kg_value value);
KG_API const float *kg_data_f32(const kg_tape *tape, kg_value value);

/* Entry number index, in any precision; NaN for the null value. */
KG_API double kg_item_at(const kg_tape *tape, kg_value value, size_t index);
KG_API double kg_item(const kg_tape *tape, kg_value value); /* entry 0 */

/* -- life of the record ------------------------------------------------------------------------ */

typedef struct kg_tape_mark {
  uint32_t nodes;
  size_t adjoints;
  struct kg_arena_block *block;
  size_t used;
  size_t tags;
} kg_tape_mark;

/* Everything recorded after the mark is forgotten by the rewind; everything before it,
 * parameters for instance, stays valid with its value. A zero-initialised mark is the empty
 * tape. Clears the error. */
KG_API kg_tape_mark kg_tape_mark_of(const kg_tape *tape);
KG_API void kg_tape_rewind(kg_tape *tape, kg_tape_mark mark);

/* Operators recorded from here on carry this name in errors and traces, until the next call; NULL
 * for none. The text is not copied and must outlive the record. */
KG_API void kg_tape_tag(kg_tape *tape, const char *tag);

/* KG_OK, or the first failure since creation or the last rewind. */
KG_API kg_status kg_tape_status(const kg_tape *tape);
KG_API const kg_error *kg_tape_error(const kg_tape *tape);

KG_API size_t kg_tape_nodes(const kg_tape *tape); /* values recorded */
KG_API size_t kg_tape_bytes(const kg_tape *tape); /* memory held     */

/* -- not-a-number ------------------------------------------------------------------------------ */

/* The first operator, in recorded order, whose result holds a NaN or an infinity although its
 * operands hold none (inputs and constants count as operators without operands). */
typedef struct kg_trace {
  kg_value value;  /* null when every value is finite        */
  size_t index;    /* the first offending entry              */
  double item;     /* NaN or infinity                        */
  const char *op;  /* operator, "input" or "constant"        */
  const char *tag; /* the user's tag, NULL when there was none */
  bool adjoint;    /* found by kg_trace_adjoint              */
} kg_trace;

KG_API kg_trace kg_trace_value(const kg_tape *tape);

/* After a backward sweep: the operator nearest the seed whose adjoint rule made a NaN or an
 * infinity out of a finite adjoint of its result; value is the operand that received it, index and
 * item say where. Rules of suspects are run again. */
KG_API kg_trace kg_trace_adjoint(kg_tape *tape);

#ifdef __cplusplus
}
#endif
#endif
