/* Primitives of the user's own, implicit solutions and differentiated solvers, against closed forms
 * and complex steps. */
#include "support.h"

#include "autodiff/tape.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/primitive.h"

#include <complex.h>

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  def.precision = precision;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

/* -- a custom primitive: both eigenvalues of (a b; b c), the larger first ---------------------- */

/* m = (a + c)/2, d = (a - c)/2, r = sqrt(d^2 + b^2): the eigenvalues are m + r and m - r */
static kg_status eigenvalue_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                                  size_t *saved)
{
  (void)user;
  for (int i = 0; i < count; ++i) {
    if (shapes[i].rank != 0) return KG_ERR_SHAPE;
  }
  *result = KG_SHAPE(2);
  *saved = 2; /* d/r and b/r */
  return count == 3 ? KG_OK : KG_ERR_SHAPE;
}

static kg_status eigenvalue_forward(const kg_primitive_call *call)
{
  const double a = *call->in[0], b = *call->in[1], c = *call->in[2];
  const double m = (a + c) / 2, d = (a - c) / 2, r = hypot(d, b);
  if (r == 0) return KG_ERR_UNDEFINED; /* a double eigenvalue has no derivative */
  call->out[0] = m + r;
  call->out[1] = m - r;
  call->saved[0] = d / r;
  call->saved[1] = b / r;
  return KG_OK;
}

/* d(m +- r) = (da + dc)/2 +- (cos (da - dc)/2 + sin db) */
static kg_status eigenvalue_vjp(const kg_primitive_call *call, const double *adjoint,
                                double *const *in_adjoints)
{
  const double sum = adjoint[0] + adjoint[1], difference = adjoint[0] - adjoint[1];
  const double by[3] = {(sum + call->saved[0] * difference) / 2, call->saved[1] * difference,
                        (sum - call->saved[0] * difference) / 2};
  for (int i = 0; i < 3; ++i) {
    if (in_adjoints[i]) *in_adjoints[i] += by[i];
  }
  return KG_OK;
}

static kg_status eigenvalue_jvp(const kg_primitive_call *call, const double *const *tangents,
                                double *out_tangent)
{
  const double da = tangents[0] ? *tangents[0] : 0, db = tangents[1] ? *tangents[1] : 0;
  const double dc = tangents[2] ? *tangents[2] : 0;
  const double turn = call->saved[0] * (da - dc) / 2 + call->saved[1] * db;
  out_tangent[0] += (da + dc) / 2 + turn;
  out_tangent[1] += (da + dc) / 2 - turn;
  return KG_OK;
}

static const kg_primitive eigenvalues = {.name = "eigenvalues",
                                         .shape = eigenvalue_shape,
                                         .forward = eigenvalue_forward,
                                         .vjp = eigenvalue_vjp,
                                         .jvp = eigenvalue_jvp};

/* eigenvalue k, with complex entries */
static double complex eigenvalue(double complex a, double complex b, double complex c, int k)
{
  const double complex d = (a - c) / 2, r = csqrt(d * d + b * b);
  return (a + c) / 2 + (k ? -r : r);
}

/* w . eigenvalues of (sin p, p q, exp q) */
static double complex eigenvalue_formula(double complex p, double complex q, const double *w)
{
  return w[0] * eigenvalue(csin(p), p * q, cexp(q), 0) +
         w[1] * eigenvalue(csin(p), p * q, cexp(q), 1);
}

static kg_value record_eigenvalues(kg_tape *tape, kg_value p, kg_value q)
{
  const kg_value operands[3] = {kg_sin(tape, p), kg_mul(tape, p, q), kg_exp(tape, q)};
  return kg_apply(tape, &eigenvalues, 3, operands);
}

static void custom_primitive_equals_complex_steps(void **state)
{
  (void)state;
  kg_random random = kg_random_make(2);
  kg_tape *tape = new_tape(KG_DOUBLE);
  for (int n = 0; n < 100; ++n) {
    double w[2], d[2], x[2], gradient[2], tangent[2];
    for (int i = 0; i < 2; ++i) {
      w[i] = kg_random_normal(&random);
      d[i] = kg_random_normal(&random);
      x[i] = kg_random_normal(&random);
    }
    kg_tape_rewind(tape, (kg_tape_mark){0});
    const kg_value input[2] = {kg_scalar(tape, x[0]), kg_scalar(tape, x[1])};
    const kg_value output = record_eigenvalues(tape, input[0], input[1]);
    assert_int_equal(kg_size_of(tape, output), 2);
    assert_close(kg_item_at(tape, output, 1),
                 creal(eigenvalue(sin(x[0]), x[0] * x[1], exp(x[1]), 1)), 1e-15);
    const double *seed = w;
    double *results[2] = {&gradient[0], &gradient[1]};
    assert_int_equal(kg_vjp(tape, 1, 1, &output, &seed, 2, input, results), KG_OK);
    const double h = 1e-100;
    assert_close(gradient[0], cimag(eigenvalue_formula(CMPLX(x[0], h), x[1], w)) / h, 1e-12);
    assert_close(gradient[1], cimag(eigenvalue_formula(x[0], CMPLX(x[1], h), w)) / h, 1e-12);
    const double *tangents[2] = {&d[0], &d[1]};
    double *out = tangent;
    assert_int_equal(kg_jvp(tape, 1, 2, input, tangents, 1, &output, &out), KG_OK);
    const double forward = w[0] * tangent[0] + w[1] * tangent[1];
    const double backward = gradient[0] * d[0] + gradient[1] * d[1];
    assert_at_most(fabs(forward - backward),
                   1e-13 * (hypot(w[0], w[1]) * hypot(tangent[0], tangent[1])));
  }
  kg_tape_destroy(tape);
}

/* several seeds at once, each like one alone */
static void custom_primitive_takes_several_directions(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value input[2] = {kg_scalar(tape, 0.3), kg_scalar(tape, -0.8)};
  const kg_value output = record_eigenvalues(tape, input[0], input[1]);
  const double seeds[6] = {1, 0, 0, 1, 2, -3};
  const double *seed = seeds;
  double p[3], q[3], *results[2] = {p, q};
  assert_int_equal(kg_vjp(tape, 3, 1, &output, &seed, 2, input, results), KG_OK);
  assert_close(p[2], 2 * p[0] - 3 * p[1], 1e-15);
  assert_close(q[2], 2 * q[0] - 3 * q[1], 1e-15);
  const double tangents_p[2] = {1, 0}, tangents_q[2] = {0, 1};
  const double *tangents[2] = {tangents_p, tangents_q};
  double columns[4], *out = columns;
  assert_int_equal(kg_jvp(tape, 2, 2, input, tangents, 1, &output, &out), KG_OK);
  assert_close(columns[0], p[0], 1e-15);
  assert_close(columns[1], p[1], 1e-15);
  assert_close(columns[2], q[0], 1e-15);
  assert_close(columns[3], q[1], 1e-15);
  kg_tape_destroy(tape);
}

static void float_tapes_convert_operands(void **state)
{
  (void)state;
  kg_tape *tape[2] = {new_tape(KG_DOUBLE), new_tape(KG_FLOAT)};
  double value[2], gradient[2];
  for (int i = 0; i < 2; ++i) {
    const kg_value p = kg_scalar(tape[i], 0.3), q = kg_scalar(tape[i], -0.8);
    const kg_value output = record_eigenvalues(tape[i], p, q);
    value[i] = kg_item_at(tape[i], output, 1);
    assert_int_equal(kg_backward(tape[i], output), KG_OK);
    gradient[i] = kg_adjoint_item(tape[i], q);
    kg_tape_destroy(tape[i]);
  }
  assert_true(value[0] != value[1]);
  assert_close(value[0], value[1], 1e-6);
  assert_close(gradient[0], gradient[1], 1e-6);
}

/* The kernels themselves, on lanes, in each arithmetic: lane for lane what one lane gives. */
static void lanes_are_called_one_by_one(void **state)
{
  (void)state;
  enum { LANES = 3 };
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value output = record_eigenvalues(tape, kg_scalar(tape, 0.3), kg_scalar(tape, -0.8));
  const kg_block *block = kg_node_of(tape, output)->is.block;
  const double in[3][LANES] = {{1, 2, 3}, {0.5, -1, 2}, {-1, 4, 0.25}};
  const double seed[2 * LANES] = {1, 2, 3, 4, 5, 6};
  double out[2 * LANES], saved[2 * LANES], in_adjoint[3][LANES] = {{10, 20, 30}};
  const void *operands[3] = {in[0], in[1], in[2]};
  void *sums[3] = {in_adjoint[0], in_adjoint[1], NULL};
  const kg_call call = {block->attributes, 2, LANES, 3, operands, out, saved, &tape->graph, 0};
  assert_int_equal(block->kernel->forward(&call), KG_OK);
  block->kernel->vjp(&call, seed, sums);
  double tangent[2 * LANES] = {7, 7, 7, 7, 7, 7}; /* written, not added to */
  const void *directions[3] = {in[2], NULL, in[1]};
  block->kernel->jvp(&call, directions, tangent);
  for (int lane = 0; lane < LANES; ++lane) {
    const double x[3] = {in[0][lane], in[1][lane], in[2][lane]}, h = 1e-100;
    for (int k = 0; k < 2; ++k) {
      const double complex y = eigenvalue(CMPLX(x[0], h * x[2]), x[1], CMPLX(x[2], h * x[1]), k);
      assert_close(tangent[k * LANES + lane], cimag(y) / h, 1e-14);
    }
    for (int k = 0; k < 2; ++k) {
      assert_close(out[k * LANES + lane], creal(eigenvalue(x[0], x[1], x[2], k)), 1e-15);
    }
    double by_a = 10 * (lane + 1), by_b = 0;
    for (int k = 0; k < 2; ++k) {
      by_a += seed[k * LANES + lane] * cimag(eigenvalue(CMPLX(x[0], h), x[1], x[2], k)) / h;
      by_b += seed[k * LANES + lane] * cimag(eigenvalue(x[0], CMPLX(x[1], h), x[2], k)) / h;
    }
    assert_close(in_adjoint[0][lane], by_a, 1e-14);
    assert_close(in_adjoint[1][lane], by_b, 1e-14);
  }
  kg_tape_destroy(tape);
}

/* -- complex arithmetic ------------------------------------------------------------------------ */

/* y = x^3, with or without a complex form; saved: x^2 */
static kg_status cube_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)user;
  *result = shapes[0];
  *saved = 1;
  return count == 1 ? KG_OK : KG_ERR_SHAPE;
}

static kg_status cube_forward(const kg_primitive_call *call)
{
  call->saved[0] = *call->in[0] * *call->in[0];
  call->out[0] = call->saved[0] * *call->in[0];
  return KG_OK;
}

static kg_status cube_vjp(const kg_primitive_call *call, const double *adjoint, double *const *to)
{
  if (to[0]) *to[0] += 3 * call->saved[0] * *adjoint;
  return KG_OK;
}

static kg_status cube_jvp(const kg_primitive_call *call, const double *const *tangents, double *out)
{
  *out += 3 * call->saved[0] * *tangents[0];
  return KG_OK;
}

static kg_status complex_cube(const kg_primitive_call *call)
{
  const double complex x = CMPLX(call->in[0][0], call->in[0][1]), square = x * x;
  memcpy(call->saved, &square, sizeof square);
  const double complex y = square * x;
  memcpy(call->out, &y, sizeof y);
  return KG_OK;
}

static kg_status complex_cube_vjp(const kg_primitive_call *call, const double *adjoint,
                                  double *const *to)
{
  const double complex term =
    3 * CMPLX(call->saved[0], call->saved[1]) * CMPLX(adjoint[0], adjoint[1]);
  to[0][0] += creal(term);
  to[0][1] += cimag(term);
  return KG_OK;
}

/* One call of a cube in complex numbers on two lanes: value and adjoint. */
static kg_status run_complex(const kg_primitive *primitive, const double complex *x,
                             const double complex *seed, double complex *y, double complex *sum,
                             const char **detail)
{
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value operand = kg_scalar(tape, 1), output = kg_apply(tape, primitive, 1, &operand);
  const kg_block *block = kg_node_of(tape, output)->is.block;
  double complex saved[2];
  const void *in = x;
  void *to = sum;
  kg_graph graph = {.number = 2 * sizeof(double), .lanes = 2};
  const kg_call call = {block->attributes, 1, 2, 1, &in, y, saved, &graph, 0};
  kg_status status = kg_kernels_c64_base[kg_op_primitive].forward(&call);
  if (status == KG_OK) {
    kg_kernels_c64_base[kg_op_primitive].vjp(&call, seed, &to);
    status = graph.status;
  }
  *detail = graph.detail;
  kg_buffer_release(&graph.scratch, NULL);
  kg_tape_destroy(tape);
  return status;
}

static void complex_arithmetic_uses_the_complex_form_or_the_jvp(void **state)
{
  (void)state;
  kg_primitive cube = {
    .name = "cube", .shape = cube_shape, .forward = cube_forward, .vjp = cube_vjp};
  const double complex x[2] = {CMPLX(1.5, 1e-100), CMPLX(-0.5, 2e-100)};
  const double complex seed[2] = {CMPLX(2, 3e-100), CMPLX(1, 0)};
  double complex y[2], sum[2] = {0};
  const char *detail;
  assert_int_equal(run_complex(&cube, x, seed, y, sum, &detail), KG_ERR_UNSUPPORTED);
  assert_string_equal(detail, "has neither a complex form nor a JVP");
  cube.jvp = cube_jvp;
  assert_int_equal(run_complex(&cube, x, seed, y, sum, &detail), KG_ERR_UNSUPPORTED);
  assert_string_equal(detail, "has no complex form");
  for (int i = 0; i < 2; ++i) {
    assert_close(creal(y[i]), creal(x[i] * x[i] * x[i]), 1e-15);
    assert_close(cimag(y[i]) * 1e100, cimag(x[i] * x[i] * x[i]) * 1e100, 1e-15);
  }
  cube.complex_forward = complex_cube;
  cube.complex_vjp = complex_cube_vjp;
  assert_int_equal(run_complex(&cube, x, seed, y, sum, &detail), KG_OK);
  for (int i = 0; i < 2; ++i) { /* imaginary part: the second derivative 6 x along the step */
    const double step = cimag(x[i]) * 1e100;
    const double expected = 6 * creal(x[i]) * step * creal(seed[i]) +
                            3 * creal(x[i]) * creal(x[i]) * cimag(seed[i]) * 1e100;
    assert_close(cimag(sum[i]) * 1e100, expected, 1e-14);
    assert_close(creal(sum[i]), 3 * creal(x[i]) * creal(x[i]) * creal(seed[i]), 1e-14);
  }
}

/* f = sin x cube x: f'' = -sin x x^3 + 6 x^2 cos x + 6 x sin x */
static void hessian_products_need_the_complex_form(void **state)
{
  (void)state;
  kg_primitive cube = {.name = "cube",
                       .shape = cube_shape,
                       .forward = cube_forward,
                       .vjp = cube_vjp,
                       .jvp = cube_jvp,
                       .complex_forward = complex_cube,
                       .complex_vjp = complex_cube_vjp};
  kg_tape *tape = new_tape(KG_DOUBLE);
  const double x = 1.3, v = -0.4, *vector = &v;
  const kg_value input = kg_scalar(tape, x);
  kg_tape_tag(tape, "volume");
  const kg_value f = kg_mul(tape, kg_sin(tape, input), kg_apply(tape, &cube, 1, &input));
  double product, *products = &product;
  assert_int_equal(kg_hessian_product(tape, f, 1, &input, &vector, &products), KG_OK);
  assert_close(product, v * (-sin(x) * x * x * x + 6 * x * x * cos(x) + 6 * x * sin(x)), 1e-14);
  cube.complex_forward = NULL;
  assert_int_equal(kg_hessian_product(tape, f, 1, &input, &vector, &products), KG_ERR_UNSUPPORTED);
  assert_non_null(strstr(kg_tape_error(tape)->text, "cube [volume]: has no complex form"));
  kg_tape_destroy(tape);
}

/* -- failures ---------------------------------------------------------------------------------- */

static void failures_name_the_primitive_and_the_tag(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value one = kg_scalar(tape, 1), zero = kg_constant_scalar(tape, 0);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  kg_tape_tag(tape, "inertia");
  const kg_value degenerate[3] = {one, zero, one};
  assert_true(kg_is_null(kg_apply(tape, &eigenvalues, 3, degenerate)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_UNDEFINED);
  assert_string_equal(kg_tape_error(tape)->text,
                      "eigenvalues [inertia]: a function is undefined where its value is needed");
  kg_tape_rewind(tape, mark);
  assert_true(kg_is_null(kg_apply(tape, &eigenvalues, 2, degenerate)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
  assert_string_equal(
    kg_tape_error(tape)->text,
    "eigenvalues: operands of shapes (), (): operands whose shapes do not fit together");
  kg_tape_rewind(tape, mark);
  assert_true(kg_is_null(kg_apply(tape, &eigenvalues, 0, degenerate)));
  assert_string_equal(kg_tape_error(tape)->text, "eigenvalues: 0 operands; 1 to 32 are possible");
  kg_tape_rewind(tape, mark);
  const kg_value sound[3] = {one, one, zero}; /* (1 1; 1 0): the golden ratio */
  const kg_value output = kg_apply(tape, &eigenvalues, 3, sound);
  assert_close(kg_item(tape, output), (1 + sqrt(5)) / 2, 1e-15);
  kg_tape_destroy(tape);
}

static kg_status no_vjp(const kg_primitive_call *call, const double *adjoint, double *const *to)
{
  (void)call, (void)adjoint, (void)to;
  return KG_ERR_UNDEFINED;
}

static void sweeps_stop_where_a_primitive_fails(void **state)
{
  (void)state;
  const kg_primitive cube = {
    .name = "cube", .shape = cube_shape, .forward = cube_forward, .vjp = no_vjp};
  kg_tape *tape = new_tape(KG_DOUBLE);
  const double two = 2;
  const kg_value x = kg_input(tape, KG_SHAPE(1), &two), before = kg_scale(tape, x, 1);
  kg_tape_tag(tape, "volume");
  const kg_value y = kg_apply(tape, &cube, 1, &before);
  kg_tape_tag(tape, NULL);
  const kg_value z = kg_square(tape, y);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  assert_int_equal(kg_backward(tape, z), KG_ERR_UNDEFINED);
  assert_string_equal(kg_tape_error(tape)->text,
                      "cube [volume]: a function is undefined where its value is needed");
  kg_tape_rewind(tape, mark);
  const double one = 1, *tangent = &one;
  double result, *results = &result;
  assert_int_equal(kg_jvp(tape, 1, 1, &x, &tangent, 1, &z, &results), KG_ERR_UNSUPPORTED);
  assert_string_equal(kg_tape_error(tape)->text, "cube [volume]: has no JVP");
  kg_tape_rewind(tape, mark);
  const kg_value w = kg_square(tape, x); /* does not pass the cube */
  assert_int_equal(kg_backward(tape, w), KG_OK);
  assert_close(kg_adjoint_item(tape, x), 4, 0);
  kg_tape_destroy(tape);
}

/* -- implicit: Kepler's equation --------------------------------------------------------------- */

/* E - e sin E = M by Newton's method; dE/dM = 1/(1 - e cos E), dE/de = sin E/(1 - e cos E) */
static double eccentric_anomaly(double e, double M)
{
  double E = e > 0.8 ? acos(-1) : M;
  for (int i = 0; i < 50; ++i) {
    E -= (E - e * sin(E) - M) / (1 - e * cos(E));
  }
  return E;
}

static kg_status kepler_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                              size_t *saved)
{
  (void)user, (void)shapes;
  *result = KG_SCALAR_SHAPE;
  *saved = 1; /* dF/dE */
  return count == 2 ? KG_OK : KG_ERR_SHAPE;
}

static kg_status kepler_solve(const kg_primitive_call *call)
{
  const double e = *call->in[0];
  *call->out = eccentric_anomaly(e, *call->in[1]);
  if (call->user) *call->out += *(const double *)call->user; /* a spoilt solver */
  *call->saved = 1 - e * cos(*call->out);
  return KG_OK;
}

static kg_status kepler_residual(const kg_primitive_call *call, double *residual)
{
  *residual = *call->out - *call->in[0] * sin(*call->out) - *call->in[1];
  return KG_OK;
}

static kg_status kepler_solve_linear(const kg_primitive_call *call, const double *rhs, double *out)
{
  *out = *rhs / *call->saved;
  return KG_OK;
}

static kg_status kepler_residual_vjp(const kg_primitive_call *call, const double *lambda,
                                     double *const *to)
{
  if (to[0]) *to[0] += -sin(*call->out) * *lambda;
  if (to[1]) *to[1] += -*lambda;
  return KG_OK;
}

static kg_status kepler_residual_jvp(const kg_primitive_call *call, const double *const *tangents,
                                     double *out)
{
  if (tangents[0]) *out += -sin(*call->out) * *tangents[0];
  if (tangents[1]) *out += -*tangents[1];
  return KG_OK;
}

static const kg_implicit kepler = {.name = "kepler",
                                   .shape = kepler_shape,
                                   .solve = kepler_solve,
                                   .residual = kepler_residual,
                                   .tolerance = 1e-12,
                                   .transposed_solve = kepler_solve_linear,
                                   .residual_vjp = kepler_residual_vjp,
                                   .forward_solve = kepler_solve_linear,
                                   .residual_jvp = kepler_residual_jvp};

/* the same from its residual alone */
static kg_value kepler_recorded(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)count, (void)user;
  const kg_value turn = kg_mul(tape, p[0], kg_sin(tape, x));
  return kg_sub(tape, kg_sub(tape, x, turn), p[1]);
}

static kg_status kepler_root_solve(void *user, int count, const kg_shape *shapes,
                                   const double *const *parameters, double *x)
{
  (void)count, (void)shapes;
  assert_true(*x == 0);
  *x = eccentric_anomaly(*parameters[0], *parameters[1]) + (user ? *(const double *)user : 0);
  return KG_OK;
}

static const kg_root kepler_root = {
  .name = "kepler", .residual = kepler_recorded, .solve = kepler_root_solve, .tolerance = 1e-12};

static void check_kepler(kg_tape *tape, bool recorded, double e, double M)
{
  kg_tape_rewind(tape, (kg_tape_mark){0});
  const kg_value p[2] = {kg_scalar(tape, e), kg_scalar(tape, M)};
  const kg_value E = recorded ? kg_differentiate_root(tape, &kepler_root, 2, p)
                              : kg_solve_implicit(tape, &kepler, 2, p);
  const double x = kg_item(tape, E), by_M = 1 / (1 - e * cos(x)), by_e = sin(x) * by_M;
  assert_close(x - e * sin(x), M, 1e-14);
  const kg_value y = kg_sin(tape, kg_add(tape, E, p[1]));
  assert_int_equal(kg_backward(tape, y), KG_OK);
  const double slope = cos(x + M);
  assert_close(kg_adjoint_item(tape, p[0]), slope * by_e, 1e-13);
  assert_close(kg_adjoint_item(tape, p[1]), slope * (by_M + 1), 1e-13);
  const double d[2] = {0.3, -0.7}, *tangents[2] = {&d[0], &d[1]};
  double result, *results = &result;
  assert_int_equal(kg_jvp(tape, 1, 2, p, tangents, 1, &y, &results), KG_OK);
  assert_close(result, slope * (by_e * d[0] + (by_M + 1) * d[1]), 1e-13);
}

static void kepler_is_differentiated_at_its_solution(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  kg_tape *tape = new_tape(KG_DOUBLE);
  for (int n = 0; n < 100; ++n) {
    const double e = 0.95 * kg_random_uniform(&random), M = 6 * kg_random_uniform(&random);
    check_kepler(tape, false, e, M);
    check_kepler(tape, true, e, M);
  }
  kg_tape_destroy(tape);
}

static void a_false_solution_is_refused(void **state)
{
  (void)state;
  double error = 1e-3;
  kg_implicit spoilt = kepler;
  kg_root spoilt_root = kepler_root;
  spoilt.user = spoilt_root.user = &error;
  kg_tape *tape = new_tape(KG_DOUBLE);
  kg_tape_tag(tape, "orbit");
  kg_tape_mark mark = kg_tape_mark_of(tape);
  for (int n = 0; n < 4; ++n) {
    const kg_value p[2] = {kg_scalar(tape, 0.1), kg_scalar(tape, 1)};
    const kg_value E = n % 2 ? kg_solve_implicit(tape, &spoilt, 2, p)
                             : kg_differentiate_root(tape, &spoilt_root, 2, p);
    assert_true(kg_is_null(E));
    assert_int_equal(kg_tape_status(tape), KG_ERR_UNDEFINED);
    assert_string_equal(kg_tape_error(tape)->text,
                        "kepler [orbit]: the residual at the solution is too large");
    kg_tape_rewind(tape, mark);
    error = NAN; /* refused without a tolerance too */
    spoilt.tolerance = spoilt_root.tolerance = 0;
  }
  kg_tape_destroy(tape);
}

static void without_its_forward_pair_an_implicit_primitive_has_no_jvp(void **state)
{
  (void)state;
  kg_implicit backward = kepler;
  backward.forward_solve = NULL;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value p[2] = {kg_scalar(tape, 0.1), kg_scalar(tape, 1)};
  const kg_value E = kg_solve_implicit(tape, &backward, 2, p);
  const double one = 1, *tangent = &one;
  double result, *results = &result;
  assert_int_equal(kg_jvp(tape, 1, 1, p, &tangent, 1, &E, &results), KG_ERR_UNSUPPORTED);
  assert_string_equal(kg_tape_error(tape)->text, "kepler: has no JVP");
  kg_tape_destroy(tape);
}

/* -- differentiated solvers -------------------------------------------------------------------- */

/* A x = b, x (n): with lambda = A^-T w the gradients of w'x are -lambda x' and lambda. */
static kg_value linear_residual(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)count, (void)user;
  const int32_t n = kg_shape_of(tape, x).dim[0];
  return kg_sub(tape, kg_matmul(tape, p[0], kg_reshape(tape, x, KG_SHAPE(n, 1)), 0),
                kg_reshape(tape, p[1], KG_SHAPE(n, 1)));
}

/* by Gauss-Jordan elimination without exchanges: the matrices have a large diagonal */
static void eliminate(int n, const double *A, const double *b, double *x)
{
  double M[10][11];
  for (int i = 0; i < n; ++i) {
    memcpy(M[i], A + i * n, (size_t)n * sizeof(double));
    M[i][n] = b[i];
  }
  for (int k = 0; k < n; ++k) {
    for (int i = 0; i < n; ++i) {
      const double factor = M[i][k] / M[k][k];
      for (int j = k; j <= n && i != k; ++j) {
        M[i][j] -= factor * M[k][j];
      }
    }
  }
  for (int i = 0; i < n; ++i) {
    x[i] = M[i][n] / M[i][i];
  }
}

static kg_status linear_solve(void *user, int count, const kg_shape *shapes,
                              const double *const *parameters, double *x)
{
  (void)user, (void)count;
  eliminate(shapes[1].dim[0], parameters[0], parameters[1], x);
  return KG_OK;
}

static void random_system(kg_random *random, int n, double *A, double *transposed, double *b)
{
  for (int i = 0; i < n; ++i) {
    b[i] = kg_random_normal(random);
    for (int j = 0; j < n; ++j) {
      A[i * n + j] = kg_random_normal(random) + (i == j ? 6 : 0);
      transposed[j * n + i] = A[i * n + j];
    }
  }
}

static void a_linear_solver_has_the_adjoint_of_the_linear_system(void **state)
{
  (void)state;
  enum { N = 8 };
  const kg_root root = {.name = "linear",
                        .shape = KG_SHAPE(N),
                        .residual = linear_residual,
                        .solve = linear_solve,
                        .tolerance = 1e-10};
  kg_random random = kg_random_make(6);
  double A[N * N], transposed[N * N], b[N], w[N], x[N], lambda[N], by_A[N * N], by_b[N];
  random_system(&random, N, A, transposed, b);
  for (int i = 0; i < N; ++i) {
    w[i] = kg_random_normal(&random);
  }
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value p[2] = {kg_input(tape, KG_SHAPE(N, N), A), kg_input(tape, KG_SHAPE(N), b)};
  const kg_value solution = kg_differentiate_root(tape, &root, 2, p);
  const double *seed = w;
  double *results[2] = {by_A, by_b};
  assert_int_equal(kg_vjp(tape, 1, 1, &solution, &seed, 2, p, results), KG_OK);
  eliminate(N, A, b, x);
  eliminate(N, transposed, w, lambda);
  for (int i = 0; i < N; ++i) {
    assert_close(by_b[i], lambda[i], 1e-13);
    for (int j = 0; j < N; ++j) {
      assert_close(by_A[i * N + j], -lambda[i] * x[j], 1e-13);
    }
  }
  double dx[N], expected[N], *tangent = dx; /* along b in w: A dx = w */
  const double *direction = w;
  assert_int_equal(kg_jvp(tape, 1, 1, &p[1], &direction, 1, &solution, &tangent), KG_OK);
  eliminate(N, A, w, expected);
  for (int i = 0; i < N; ++i) {
    assert_close(dx[i], expected[i], 1e-13);
  }
  kg_tape_destroy(tape);
}

/* Cardano's root of x^3 + p x + q = 0 for p > 0, with complex parameters */
static double complex cardano(double complex p, double complex q)
{
  const double complex s = csqrt(q * q / 4 + p * p * p / 27);
  const double complex u = cpow(s - q / 2, 1.0 / 3);
  return u - p / (3 * u);
}

static kg_value cubic_residual(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)count, (void)user;
  return kg_add(tape, kg_add(tape, kg_power(tape, x, 3), kg_mul(tape, p[0], x)), p[1]);
}

static kg_status cubic_solve(void *user, int count, const kg_shape *shapes,
                             const double *const *parameters, double *x)
{
  (void)user, (void)count, (void)shapes;
  for (int i = 0; i < 60; ++i) {
    const double f = *x * *x * *x + *parameters[0] * *x + *parameters[1];
    *x -= f / (3 * *x * *x + *parameters[0]);
  }
  return KG_OK;
}

static const kg_root cubic = {
  .name = "cubic", .residual = cubic_residual, .solve = cubic_solve, .tolerance = 1e-12};

static void a_cubic_root_equals_complex_steps_of_cardano(void **state)
{
  (void)state;
  kg_random random = kg_random_make(7);
  kg_tape *tape = new_tape(KG_DOUBLE);
  for (int n = 0; n < 100; ++n) {
    const double p = 0.5 + kg_random_uniform(&random), q = -0.1 - kg_random_uniform(&random),
                 h = 1e-100;
    kg_tape_rewind(tape, (kg_tape_mark){0});
    const kg_value inputs[2] = {kg_scalar(tape, p), kg_scalar(tape, q)};
    const kg_value root = kg_differentiate_root(tape, &cubic, 2, inputs);
    assert_close(kg_item(tape, root), creal(cardano(p, q)), 1e-14);
    assert_int_equal(kg_backward(tape, root), KG_OK);
    assert_close(kg_adjoint_item(tape, inputs[0]), cimag(cardano(CMPLX(p, h), q)) / h, 1e-12);
    assert_close(kg_adjoint_item(tape, inputs[1]), cimag(cardano(p, CMPLX(q, h))) / h, 1e-12);
  }
  kg_tape_destroy(tape);
}

/* The point of the ellipsoid x^2/a^2 + y^2/b^2 = 1 at the angle t: x = a cos t, y = b sin t, given
 * by two equations in (x, y): the ellipse, and a y cos t = b x sin t. */
static kg_value ellipse_residual(kg_tape *tape, kg_value point, int count, const kg_value *p,
                                 void *user)
{
  (void)count, (void)user;
  const kg_value x = kg_element(tape, point, 0), y = kg_element(tape, point, 1);
  const kg_value on = kg_shift(
    tape,
    kg_add(tape, kg_square(tape, kg_div(tape, x, p[0])), kg_square(tape, kg_div(tape, y, p[1]))),
    -1);
  const kg_value along = kg_sub(tape, kg_mul(tape, kg_mul(tape, p[0], y), kg_cos(tape, p[2])),
                                kg_mul(tape, kg_mul(tape, p[1], x), kg_sin(tape, p[2])));
  const kg_value both[2] = {on, along};
  return kg_stack(tape, 2, both);
}

static kg_status ellipse_solve(void *user, int count, const kg_shape *shapes,
                               const double *const *p, double *x)
{
  (void)user, (void)count, (void)shapes;
  x[0] = *p[0] * cos(*p[2]);
  x[1] = *p[1] * sin(*p[2]);
  return KG_OK;
}

static void an_implicit_curve_of_three_parameters(void **state)
{
  (void)state;
  const kg_root root = {.name = "ellipse",
                        .shape = KG_SHAPE(2),
                        .residual = ellipse_residual,
                        .solve = ellipse_solve,
                        .tolerance = 1e-12};
  const double a = 1.7, b = 0.6, t = 0.9;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value p[3] = {kg_scalar(tape, a), kg_scalar(tape, b), kg_scalar(tape, t)};
  const kg_value point = kg_differentiate_root(tape, &root, 3, p);
  const double seeds[4] = {1, 0, 0, 1}, *seed = seeds;
  double by[3][2], *results[3] = {by[0], by[1], by[2]};
  assert_int_equal(kg_vjp(tape, 2, 1, &point, &seed, 3, p, results), KG_OK);
  const double expected[3][2] = {{cos(t), 0}, {0, sin(t)}, {-a * sin(t), b * cos(t)}};
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 2; ++k) {
      assert_close(by[i][k], expected[i][k], 1e-13);
    }
  }
  kg_tape_destroy(tape);
}

/* what a solver cannot give is said */
static kg_value no_x_residual(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)x, (void)count, (void)user;
  return kg_sub(tape, p[0], p[0]);
}

static kg_value wrong_residual(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)x, (void)count, (void)user;
  return kg_matmul(tape, p[0], p[0], 0); /* scalars have no rows */
}

static void failures_of_a_residual_are_passed_on(void **state)
{
  (void)state;
  kg_root root = cubic;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value p[2] = {kg_scalar(tape, 1), kg_scalar(tape, -1)};
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  root.residual = wrong_residual;
  assert_true(kg_is_null(kg_differentiate_root(tape, &root, 2, p)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
  assert_non_null(strstr(kg_tape_error(tape)->text, "cubic: matmul: "));
  kg_tape_rewind(tape, mark);
  root.residual = no_x_residual;
  const kg_value x = kg_differentiate_root(tape, &root, 2, p);
  assert_int_equal(kg_backward(tape, x), KG_ERR_UNDEFINED);
  assert_string_equal(kg_tape_error(tape)->text, "cubic: dF/dx is singular at the solution");
  kg_tape_rewind(tape, mark);
  root.shape = KG_SHAPE(2);
  assert_true(kg_is_null(kg_differentiate_root(tape, &root, 2, p)));
  assert_string_equal(kg_tape_error(tape)->text,
                      "cubic: residual: shape () for a solution of shape (2): as many entries");
  kg_tape_destroy(tape);
}

/* The k-th allocation is refused, for every k: a status, and nothing is lost. */
static bool survives(int allowed)
{
  failing_heap heap = {.calls_left = allowed};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  def.allocator = &allocator;
  kg_status status = kg_tape_create(&def, &tape, NULL);
  if (status == KG_OK) {
    const kg_value p[2] = {kg_scalar(tape, 0.3), kg_scalar(tape, 1)};
    const kg_value E = kg_differentiate_root(tape, &kepler_root, 2, p);
    const kg_value y = kg_add(tape, E, record_eigenvalues(tape, p[0], p[1]));
    status = kg_backward(tape, y);
    assert_int_equal(kg_tape_status(tape), status);
  }
  assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
  kg_tape_destroy(tape);
  assert_int_equal(heap.live_bytes, 0);
  return status == KG_OK;
}

static void every_refused_allocation_is_a_status(void **state)
{
  (void)state;
  int allowed = 0;
  while (!survives(allowed)) {
    assert_at_most(++allowed, 100);
  }
  assert_true(allowed > 8);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(custom_primitive_equals_complex_steps),
    cmocka_unit_test(custom_primitive_takes_several_directions),
    cmocka_unit_test(float_tapes_convert_operands),
    cmocka_unit_test(lanes_are_called_one_by_one),
    cmocka_unit_test(complex_arithmetic_uses_the_complex_form_or_the_jvp),
    cmocka_unit_test(hessian_products_need_the_complex_form),
    cmocka_unit_test(failures_name_the_primitive_and_the_tag),
    cmocka_unit_test(sweeps_stop_where_a_primitive_fails),
    cmocka_unit_test(kepler_is_differentiated_at_its_solution),
    cmocka_unit_test(a_false_solution_is_refused),
    cmocka_unit_test(without_its_forward_pair_an_implicit_primitive_has_no_jvp),
    cmocka_unit_test(a_linear_solver_has_the_adjoint_of_the_linear_system),
    cmocka_unit_test(a_cubic_root_equals_complex_steps_of_cardano),
    cmocka_unit_test(an_implicit_curve_of_three_parameters),
    cmocka_unit_test(failures_of_a_residual_are_passed_on),
    cmocka_unit_test(every_refused_allocation_is_a_status),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
