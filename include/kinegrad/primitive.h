/* kinegrad/primitive.h - operators of your own on the tape: custom, implicit, checkpointed.
 *
 * A custom primitive brings a function and its vector-Jacobian product (VJP); an implicit one
 * the equation its result solves; a checkpoint trades memory for recomputation. */
#ifndef KINEGRAD_PRIMITIVE_H
#define KINEGRAD_PRIMITIVE_H

#include "kinegrad/arena.h"
#include "kinegrad/operators.h"
#include "kinegrad/random.h"

#ifdef __cplusplus
extern "C" {
#endif

/* -- custom primitives ------------------------------------------------------------------------- */

enum { KG_MAX_OPERANDS = 32 };

/* One evaluation, as the callbacks see it: operands and result in double, row-major. */
typedef struct kg_primitive_call {
  void *user;              /* of the primitive */
  int count;               /* operands         */
  const kg_shape *shapes;  /* of the operands  */
  const double *const *in; /* operands         */
  kg_shape shape;          /* of the result    */
  double *out;             /* the result: written by forward, read by the others */
  double *saved; /* `saved` numbers of the call's own: written by forward, read by the others */
} kg_primitive_call;

typedef struct kg_primitive {
  const char *name;
  void *user; /* handed to every callback; must outlive tapes and programs that use it */

  /* Shape of the result, and how many numbers to keep between the sweeps, from the operands'
   * shapes. KG_ERR_SHAPE refuses. */
  kg_status (*shape)(void *user, int count, const kg_shape *shapes, kg_shape *result,
                     size_t *saved);
  /* Writes call->out. KG_ERR_UNDEFINED where the function has no value. */
  kg_status (*forward)(const kg_primitive_call *call);
  /* Adds (d out / d in[i])' adjoint to in_adjoints[i]; NULL entries are not wanted. */
  kg_status (*vjp)(const kg_primitive_call *call, const double *adjoint,
                   double *const *in_adjoints);
  /* Optional. Adds sum_i (d out / d in[i]) tangents[i] to out_tangent, which comes zeroed; NULL
   * entries are zero. Without it forward sweeps, kg_jacobian's too, are KG_ERR_UNSUPPORTED. */
  kg_status (*jvp)(const kg_primitive_call *call, const double *const *tangents,
                   double *out_tangent);
  /* Optional. Operands for test number `index` (derivatives exist there): shapes and numbers in
   * in[i], at most KG_MAX_OPERANDS, from the arena; returns how many operands, negative on
   * failure. */
  int (*sample)(void *user, kg_random *random, int index, kg_arena *arena, kg_shape *shapes,
                double **in);
  /* Optional: forward and vjp in complex arithmetic, the analytic continuation (no conjugates). All
   * numbers, saved ones too, are then pairs (re, im), laid out as C's double complex. Hessian
   * products need both; a complex step goes through jvp where there is no complex form. */
  kg_status (*complex_forward)(const kg_primitive_call *call);
  kg_status (*complex_vjp)(const kg_primitive_call *call, const double *adjoint,
                           double *const *in_adjoints);
} kg_primitive;

/* Records one call. The primitive must outlive the tape and every program frozen from it. It runs
 * on double tapes; on a float tape its operands are converted. In a program with lanes it is called
 * once a lane. */
KG_API kg_value kg_apply(kg_tape *tape, const kg_primitive *primitive, int count,
                         const kg_value *operands);

/* Implicit primitives, differentiated solvers and checkpoints go through complex steps by their
 * JVP; Hessian products through them are refused by name. */

/* -- implicit primitives ----------------------------------------------------------------------- */

/* x(p) defined by F(x, p) = 0, by the implicit function theorem:
 *   (dF/dx)' lambda = x_adjoint,   p_adjoint -= (dF/dp)' lambda.
 * However x was found, its iterations are never differentiated. */
typedef struct kg_implicit {
  const char *name;
  void *user;
  /* Shape of x and numbers to keep (a factorisation, for instance), as in kg_primitive. */
  kg_status (*shape)(void *user, int count, const kg_shape *shapes, kg_shape *result,
                     size_t *saved);
  /* Finds x; call->saved may keep the factorised dF/dx at x. */
  kg_status (*solve)(const kg_primitive_call *call);
  /* residual (size of x) = F(x, p), with x in call->out. Used to check, never to differentiate: a
   * solution whose largest residual is not a number or exceeds tolerance (0: no limit) is refused,
   * KG_ERR_UNDEFINED. */
  kg_status (*residual)(const kg_primitive_call *call, double *residual);
  double tolerance;
  /* lambda = (dF/dx)^-T adjoint. */
  kg_status (*transposed_solve)(const kg_primitive_call *call, const double *adjoint,
                                double *lambda);
  /* Adds (dF/dp[i])' lambda to in_adjoints[i], NULL entries are not wanted. */
  kg_status (*residual_vjp)(const kg_primitive_call *call, const double *lambda,
                            double *const *in_adjoints);
  /* Optional pair for forward mode: out = (dF/dx)^-1 rhs; and out += sum_i (dF/dp[i])
   * tangents[i]. */
  kg_status (*forward_solve)(const kg_primitive_call *call, const double *rhs, double *out);
  kg_status (*residual_jvp)(const kg_primitive_call *call, const double *const *tangents,
                            double *out);
} kg_implicit;

/* Records the solution; the description must outlive the tape and its programs. */
KG_API kg_value kg_solve_implicit(kg_tape *tape, const kg_implicit *problem, int count,
                                  const kg_value *parameters);

/* -- a solver, from its residual alone --------------------------------------------------------- */

/* residual: records F(x, p) on the tape it is given (same size as x).
 * solve: fills x from the parameters, by any means, x holds a starting point (zeros).
 * tolerance: as in kg_implicit.
 * dF/dx and dF/dp come from the recorded residual; dF/dx is factorised densely. */
typedef struct kg_root {
  const char *name;
  void *user;
  kg_shape shape; /* of x */
  kg_value (*residual)(kg_tape *tape, kg_value x, int count, const kg_value *parameters,
                       void *user);
  kg_status (*solve)(void *user, int count, const kg_shape *shapes, const double *const *parameters,
                     double *x);
  double tolerance;
} kg_root;

KG_API kg_value kg_differentiate_root(kg_tape *tape, const kg_root *root, int count,
                                      const kg_value *parameters);

/* -- checkpoints ------------------------------------------------------------------------------- */

/* Records outputs from inputs on the tape it is given. Called again, with equal numbers, when the
 * backward sweep arrives: it must record the same operators both times. */
typedef kg_status (*kg_checkpointed)(kg_tape *tape, void *user, int input_count,
                                     const kg_value *inputs, int output_count, kg_value *outputs);

/* Runs the segment and keeps only its inputs and outputs; the sweeps record it anew on a tape of
 * their own, whose memory all checkpoints of this tape share. Only the inputs passed are
 * differentiated. user must stay valid until the last sweep. Nesting is allowed. A sweep of several
 * directions records the segment once for each. */
KG_API kg_status kg_checkpoint(kg_tape *tape, kg_checkpointed segment, void *user, int input_count,
                               const kg_value *inputs, int output_count, kg_value *outputs);

#ifdef __cplusplus
}
#endif
#endif
