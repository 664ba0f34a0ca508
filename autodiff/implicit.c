/* Solutions x(p) of F(x, p) = 0, differentiated by the implicit function theorem
 *   (dF/dx)' lambda = x_adjoint      p_adjoint += (dF/dp)' (-lambda)
 *   (dF/dx) x_tangent = -(dF/dp) p_tangent
 * with F and its products given by the user (kg_implicit), or F recorded on the graph's child tape
 * (kg_root). */
#include "autodiff/primitive.h"

#include "kinegrad/derivatives.h"

#include <float.h>
#include <math.h>
#include <string.h>

static size_t size_of_result(const kg_primitive_call *call)
{
  return kg_shape_size(&call->shape);
}

static void negate(double *x, size_t n)
{
  for (size_t i = 0; i < n; ++i) {
    x[i] = -x[i];
  }
}

static kg_status because(const kg_primitive_call *call, const char *detail)
{
  ((const kg_primitive_frame *)call)->graph->detail = detail;
  return KG_ERR_UNDEFINED;
}

/* refuses what is no solution; a NaN or an infinity never is */
static kg_status check_residual(const kg_primitive_call *call, const double *residual,
                                double tolerance)
{
  const double most = tolerance > 0 ? tolerance : DBL_MAX;
  for (size_t i = 0; i < size_of_result(call); ++i) {
    if (!(fabs(residual[i]) <= most))
      return because(call, "the residual at the solution is too large");
  }
  return KG_OK;
}

/* -- given by the user: saved holds lambda (n), then the user's own numbers -------------------- */

static kg_primitive_call inner_call(const kg_primitive_call *call)
{
  const kg_implicit *problem = call->user;
  kg_primitive_call inner = *call;
  inner.user = problem->user;
  inner.saved = call->saved + size_of_result(call);
  return inner;
}

static kg_status implicit_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                                size_t *saved)
{
  const kg_implicit *problem = user;
  const kg_status status = problem->shape(problem->user, count, shapes, result, saved);
  if (status == KG_OK && kg_shape_is_valid(*result)) *saved += kg_shape_size(result);
  return status;
}

static kg_status implicit_forward(const kg_primitive_call *call)
{
  const kg_implicit *problem = call->user;
  const kg_primitive_call inner = inner_call(call);
  kg_status status = problem->solve(&inner);
  if (status == KG_OK) status = problem->residual(&inner, call->saved);
  return status == KG_OK ? check_residual(call, call->saved, problem->tolerance) : status;
}

static kg_status implicit_vjp(const kg_primitive_call *call, const double *adjoint,
                              double *const *in_adjoints)
{
  const kg_implicit *problem = call->user;
  const kg_primitive_call inner = inner_call(call);
  double *lambda = call->saved;
  const kg_status status = problem->transposed_solve(&inner, adjoint, lambda);
  if (status != KG_OK) return status;
  negate(lambda, size_of_result(call));
  return problem->residual_vjp(&inner, lambda, in_adjoints);
}

static kg_status implicit_jvp(const kg_primitive_call *call, const double *const *tangents,
                              double *out_tangent)
{
  const kg_implicit *problem = call->user;
  const kg_primitive_call inner = inner_call(call);
  const size_t n = size_of_result(call);
  double *rhs = call->saved;
  memset(rhs, 0, n * sizeof *rhs);
  const kg_status status = problem->residual_jvp(&inner, tangents, rhs);
  if (status != KG_OK) return status;
  negate(rhs, n);
  return problem->forward_solve(&inner, rhs, out_tangent);
}

static const kg_primitive backward_only = {
  .shape = implicit_shape, .forward = implicit_forward, .vjp = implicit_vjp};
static const kg_primitive both_ways = {
  .shape = implicit_shape, .forward = implicit_forward, .vjp = implicit_vjp, .jvp = implicit_jvp};

kg_value kg_solve_implicit(kg_tape *tape, const kg_implicit *problem, int count,
                           const kg_value *parameters)
{
  const bool forward_mode = problem->forward_solve && problem->residual_jvp;
  kg_primitive_attributes attributes = {.primitive = forward_mode ? &both_ways : &backward_only,
                                        .user = (void *)problem,
                                        .name = problem->name};
  return kg_record_primitive(tape, &attributes, count, parameters, NULL);
}

/* -- recorded ---------------------------------------------------------------------------------- */

/* LAPACK stores columns: it sees the transpose of our rows. Character arguments have a hidden
 * length. */
extern void dgetrf_(const int *m, const int *n, double *a, const int *lda, int *ipiv, int *info);
extern void dgetrs_(const char *trans, const int *n, const int *nrhs, const double *a,
                    const int *lda, const int *ipiv, double *b, const int *ldb, int *info,
                    size_t trans_length);

/* dF/dx at the solution, factorised when a sweep first needs it, and room for lambda */
typedef struct factors {
  double *lambda, *matrix, *made; /* (n), (n, n), 0 or 1 */
  int *pivots;                    /* (n) */
  int n;
} factors;

static factors factors_of(const kg_primitive_call *call)
{
  const size_t n = size_of_result(call);
  double *saved = call->saved;
  return (factors){.made = saved,
                   .lambda = saved + 1,
                   .matrix = saved + 1 + n,
                   .pivots = (int *)(saved + 1 + n + n * n),
                   .n = (int)n};
}

static kg_status root_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)count, (void)shapes;
  *result = ((const kg_root *)user)->shape;
  if (!kg_shape_is_valid(*result)) return KG_ERR_SHAPE;
  const size_t n = kg_shape_size(result);
  *saved = 1 + 2 * n + n * n;
  return n <= 30000 ? KG_OK : KG_ERR_SHAPE; /* the matrix has n^2 entries, LAPACK counts in int */
}

/* F on the child tape */
typedef struct recorded {
  kg_tape *tape;
  kg_value x, residual, parameters[KG_MAX_OPERANDS];
} recorded;

/* F(x, p) with x an input or a constant and the parameters inputs where wanted */
static kg_status record_residual(const kg_primitive_call *call, bool by_x,
                                 const double *const *wanted, recorded *r)
{
  const kg_primitive_frame *frame = (const kg_primitive_frame *)call;
  const kg_root *root = call->user;
  r->tape = kg_child_tape(frame->graph);
  if (!r->tape) return KG_ERR_NO_MEMORY;
  r->x = kg_child_value(r->tape, call->shape, call->shape.rank == 0, by_x, call->out);
  kg_child_operands(r->tape, frame, wanted, r->parameters);
  r->residual = root->residual(r->tape, r->x, call->count, r->parameters, root->user);
  const kg_status status = kg_child_status(frame->graph);
  if (status != KG_OK) return status;
  if (kg_size_of(r->tape, r->residual) == size_of_result(call)) return KG_OK;
  kg_refuse(
    r->tape, KG_ERR_SHAPE, "residual", "shape %s for a solution of shape %s: as many entries",
    kg_shape_print(kg_shape_of(r->tape, r->residual)).text, kg_shape_print(call->shape).text);
  return kg_child_status(frame->graph);
}

static kg_status factorise(const kg_primitive_call *call)
{
  const factors f = factors_of(call);
  recorded r;
  if (*f.made != 0) return KG_OK;
  kg_status status = record_residual(call, true, NULL, &r);
  if (status != KG_OK) return status;
  kg_jacobian(r.tape, r.residual, r.x, f.matrix);
  status = kg_child_status(((const kg_primitive_frame *)call)->graph);
  if (status != KG_OK) return status;
  int info = 0;
  dgetrf_(&f.n, &f.n, f.matrix, &f.n, f.pivots, &info);
  for (int i = 0; i < f.n && info == 0; ++i) {
    info = !isfinite(f.matrix[(size_t)i * (size_t)f.n + (size_t)i]);
  }
  *f.made = info == 0;
  return info == 0 ? KG_OK : because(call, "dF/dx is singular at the solution");
}

/* b := -(dF/dx)^-1 b, or by the transpose */
static void solve_negated(const factors *f, bool transposed, double *b)
{
  const int one = 1;
  int info = 0;
  negate(b, (size_t)f->n);
  dgetrs_(transposed ? "N" : "T", &f->n, &one, f->matrix, &f->n, f->pivots, b, &f->n, &info, 1);
}

static kg_status root_forward(const kg_primitive_call *call)
{
  const kg_root *root = call->user;
  const factors f = factors_of(call);
  const size_t n = size_of_result(call);
  recorded r;
  *f.made = 0;
  memset(call->out, 0, n * sizeof(double));
  kg_status status = root->solve(root->user, call->count, call->shapes, call->in, call->out);
  if (status != KG_OK) return status;
  status = record_residual(call, false, NULL, &r);
  for (size_t i = 0; status == KG_OK && i < n; ++i) {
    f.lambda[i] = kg_item_at(r.tape, r.residual, i);
  }
  return status == KG_OK ? check_residual(call, f.lambda, root->tolerance) : status;
}

static kg_status root_vjp(const kg_primitive_call *call, const double *adjoint,
                          double *const *in_adjoints)
{
  const factors f = factors_of(call);
  recorded r;
  kg_status status = factorise(call);
  if (status != KG_OK) return status;
  memcpy(f.lambda, adjoint, (size_t)f.n * sizeof(double));
  solve_negated(&f, true, f.lambda);
  status = record_residual(call, false, (const double *const *)in_adjoints, &r);
  if (status != KG_OK) return status;
  if (kg_sweep_begin(&r.tape->graph, 1) != KG_OK) return KG_ERR_NO_MEMORY;
  kg_child_add(r.tape, r.residual, f.lambda);
  for (int i = 0; i < call->count; ++i) {
    kg_child_add(r.tape, r.parameters[i], in_adjoints[i]);
  }
  kg_sweep_backward(&r.tape->graph, 1);
  for (int i = 0; i < call->count; ++i) {
    kg_child_read(r.tape, r.parameters[i], in_adjoints[i]);
  }
  return kg_child_status(((const kg_primitive_frame *)call)->graph);
}

static kg_status root_jvp(const kg_primitive_call *call, const double *const *tangents,
                          double *out_tangent)
{
  const factors f = factors_of(call);
  recorded r;
  kg_status status = factorise(call);
  if (status == KG_OK) status = record_residual(call, false, tangents, &r);
  if (status != KG_OK) return status;
  if (kg_sweep_begin(&r.tape->graph, 1) != KG_OK) return KG_ERR_NO_MEMORY;
  for (int i = 0; i < call->count; ++i) {
    kg_child_add(r.tape, r.parameters[i], tangents[i]);
  }
  kg_sweep_forward(&r.tape->graph, 1);
  kg_child_read(r.tape, r.residual, out_tangent);
  solve_negated(&f, false, out_tangent);
  return kg_child_status(((const kg_primitive_frame *)call)->graph);
}

static const kg_primitive root_primitive = {
  .shape = root_shape, .forward = root_forward, .vjp = root_vjp, .jvp = root_jvp};

kg_value kg_differentiate_root(kg_tape *tape, const kg_root *root, int count,
                               const kg_value *parameters)
{
  kg_primitive_attributes attributes = {
    .primitive = &root_primitive, .user = (void *)root, .name = root->name};
  return kg_record_primitive(tape, &attributes, count, parameters, NULL);
}
