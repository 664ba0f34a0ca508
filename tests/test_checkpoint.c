/* Checkpoints: gradients of a segmented record against the same record in one piece, bit for bit;
 * memory. */
#include "support.h"

#include "autodiff/tape.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/primitive.h"
#include "kinegrad/program.h"

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  def.precision = precision;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

/* -- a chain: x <- x + h sin(W x) + k x y, y <- y - h sum(x) ----------------------------------- */

enum { N = 6 };

/* So many steps, recorded in pieces; in one when piece is NULL. */
typedef struct chain {
  int steps;
  const struct chain *piece;
} chain;

typedef struct state {
  kg_value x, y; /* (N, 1), scalar */
} state;

static state step(kg_tape *tape, state s, kg_value W, kg_value k)
{
  const kg_value force = kg_sin(tape, kg_matmul(tape, W, s.x, 0));
  const kg_value growth = kg_mul(tape, kg_mul(tape, k, s.y), s.x);
  const kg_value x = kg_add(tape, kg_add(tape, s.x, kg_scale(tape, force, 0.01)), growth);
  const kg_value mean = kg_element(tape, s.x, 2);
  return (state){x, kg_sub(tape, s.y, kg_scale(tape, mean, 0.01))};
}

static kg_status run_chain(kg_tape *tape, const chain *c, const kg_value *in, kg_value *out);

static kg_status chain_segment(kg_tape *tape, void *user, int input_count, const kg_value *inputs,
                               int output_count, kg_value *outputs)
{
  assert_int_equal(input_count, 4);
  assert_int_equal(output_count, 2);
  if (tape->precision == KG_DOUBLE) assert_true(kg_is_scalar_node(inputs[1])); /* as on the tape */
  return run_chain(tape, user, inputs, outputs);
}

/* in: x, y, W, k; out: x, y */
static kg_status run_chain(kg_tape *tape, const chain *c, const kg_value *in, kg_value *out)
{
  state s = {in[0], in[1]};
  for (int t = 0; t < c->steps; t += c->piece ? c->piece->steps : 1) {
    if (!c->piece) {
      s = step(tape, s, in[2], in[3]);
      continue;
    }
    const kg_value inputs[4] = {s.x, s.y, in[2], in[3]};
    kg_value outputs[2];
    const kg_status status =
      kg_checkpoint(tape, chain_segment, (void *)c->piece, 4, inputs, 2, outputs);
    if (status != KG_OK) return status;
    s = (state){outputs[0], outputs[1]};
  }
  out[0] = s.x;
  out[1] = s.y;
  return KG_OK;
}

typedef struct chain_result {
  double value, by_x[N], by_W[N * N], by_y, by_k, tangent;
} chain_result;

static void record_chain(kg_tape *tape, const chain *c, kg_value *in, kg_value *loss)
{
  double x[N], W[N * N];
  kg_random random = kg_random_make(3);
  for (int i = 0; i < N * N; ++i) {
    W[i] = kg_random_normal(&random);
    if (i < N) x[i] = kg_random_normal(&random);
  }
  in[0] = kg_input(tape, KG_SHAPE(N, 1), x);
  in[1] = kg_scalar(tape, 0.5);
  in[2] = kg_input(tape, KG_SHAPE(N, N), W);
  in[3] = kg_scalar(tape, 0.002);
  kg_value out[2];
  assert_int_equal(run_chain(tape, c, in, out), KG_OK);
  const kg_value a = kg_element(tape, out[0], 1), b = kg_element(tape, out[0], 4);
  *loss = kg_add(tape, kg_mul(tape, a, b), kg_mul(tape, out[1], a));
}

static chain_result chain_gradient(kg_tape *tape, chain c)
{
  kg_value in[4], loss;
  chain_result r;
  record_chain(tape, &c, in, &loss);
  r.value = kg_item(tape, loss);
  double *gradients[4] = {r.by_x, &r.by_y, r.by_W, &r.by_k};
  assert_int_equal(kg_gradient(tape, loss, 4, in, gradients), KG_OK);
  double d[N * N];
  for (int i = 0; i < N * N; ++i) {
    d[i] = 1.0 / (1 + i);
  }
  const double *tangents[4] = {d, d, d, d};
  double *result = &r.tangent;
  assert_int_equal(kg_jvp(tape, 1, 4, in, tangents, 1, &loss, &result), KG_OK);
  return r;
}

static kg_tape *narrow_tape(kg_precision precision)
{
  kg_tape_def def = {precision, NULL, 0};
  kg_tape *tape;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static void segments_change_no_bit(void **test_state)
{
  (void)test_state;
  const chain four = {4, NULL}, six = {6, NULL}, twelve = {12, &four};
  const chain whole = {60, NULL}, pieces = {60, &six}, nested = {60, &twelve};
  for (int kind = 0; kind < 4; ++kind) {
    const kg_precision precision = kind % 2 ? KG_FLOAT : KG_DOUBLE;
    kg_tape *tape = kind < 2 ? new_tape(precision) : narrow_tape(precision);
    const chain_result expected = chain_gradient(tape, whole);
    kg_tape_rewind(tape, (kg_tape_mark){0});
    const chain_result once = chain_gradient(tape, pieces);
    kg_tape_rewind(tape, (kg_tape_mark){0});
    const chain_result twice = chain_gradient(tape, nested);
    assert_memory_equal(&once, &expected, sizeof expected);
    assert_memory_equal(&twice, &expected, sizeof expected);
    assert_true(expected.by_W[3] != 0 && expected.by_k != 0 && expected.tangent != 0);
    assert_ptr_equal(tape->graph.child->graph.kernels, tape->graph.kernels); /* for any simd */
    kg_tape_destroy(tape);
  }
}

static double bytes_of_chain(int steps, int piece)
{
  const chain segment = {piece, NULL}, pieces = {steps, &segment}, whole = {steps, NULL};
  kg_tape *tape = new_tape(KG_DOUBLE);
  chain_gradient(tape, piece ? pieces : whole);
  const size_t bytes = kg_tape_bytes(tape);
  kg_tape_destroy(tape);
  return (double)bytes;
}

/* T steps in sqrt(T) pieces: sixteen times the steps in four times the memory, as blocks double in
 * size at most five times */
static void memory_grows_with_the_square_root_of_the_steps(void **test_state)
{
  (void)test_state;
  const double small = bytes_of_chain(256, 16), large = bytes_of_chain(4096, 64);
  const double whole = bytes_of_chain(4096, 0);
  print_message("bytes: 256 steps by 16 %g, 4096 by 64 %g, 4096 in one piece %g\n", small, large,
                whole);
  assert_at_most(large, 5 * small);
  assert_at_most(8 * large, whole);
}

/* -- kinds of outputs -------------------------------------------------------------------------- */

/* outputs: an input as it came, a scalar, a tensor used by the next one, that one, a constant */
static kg_status mixed_segment(kg_tape *tape, void *user, int input_count, const kg_value *inputs,
                               int output_count, kg_value *outputs)
{
  (void)user, (void)input_count, (void)output_count;
  outputs[0] = inputs[0];
  outputs[1] = kg_exp(tape, inputs[1]);
  outputs[2] = kg_mul(tape, inputs[0], outputs[1]);
  outputs[3] = kg_square(tape, outputs[2]);
  outputs[4] = kg_constant_scalar(tape, 3);
  return KG_OK;
}

static void record_mixed(kg_tape *tape, bool checkpoint, kg_value *in, kg_value *out)
{
  const double a[6] = {1, 2, 3, 4, 5, -6};
  in[0] = kg_input(tape, KG_SHAPE(2, 3), a);
  in[1] = kg_scalar(tape, 0.25);
  if (checkpoint) {
    assert_int_equal(kg_checkpoint(tape, mixed_segment, NULL, 2, in, 5, out), KG_OK);
  } else {
    assert_int_equal(mixed_segment(tape, NULL, 2, in, 5, out), KG_OK);
  }
}

static void outputs_keep_their_kind_and_shape(void **test_state)
{
  (void)test_state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  kg_value in[2][2], out[2][5];
  double by_a[2][4 * 6], by_b[2][4];
  for (int k = 0; k < 2; ++k) {
    record_mixed(tape, k, in[k], out[k]);
    double *results[2] = {by_a[k], by_b[k]}, ones[4 * 6];
    for (int i = 0; i < 4 * 6; ++i) {
      ones[i] = i % 7 - 2.5;
    }
    const double *seeds[4] = {ones, ones, ones, ones}; /* four directions */
    assert_int_equal(kg_vjp(tape, 4, 4, out[k], seeds, 2, in[k], results), KG_OK);
  }
  for (int o = 0; o < 5; ++o) {
    assert_true(kg_same_shape(kg_shape_of(tape, out[0][o]), kg_shape_of(tape, out[1][o])));
    assert_int_equal(kg_is_scalar_node(out[0][o]), kg_is_scalar_node(out[1][o]));
    for (size_t i = 0; i < kg_size_of(tape, out[0][o]); ++i) {
      assert_true(kg_item_at(tape, out[0][o], i) == kg_item_at(tape, out[1][o], i));
    }
  }
  assert_memory_equal(by_a[0], by_a[1], sizeof by_a[0]);
  assert_memory_equal(by_b[0], by_b[1], sizeof by_b[0]);
  kg_tape_destroy(tape);
}

/* -- programs ---------------------------------------------------------------------------------- */

static void programs_run_segments_at_new_inputs(void **test_state)
{
  (void)test_state;
  enum { LANES = 3 };
  const chain four = {4, NULL}, pieces = {12, &four}, none = {0, NULL}, whole = {12, NULL};
  kg_tape *tape = new_tape(KG_DOUBLE);
  kg_value in[4], loss;
  record_chain(tape, &pieces, in, &loss);
  kg_program_def def = kg_program_default_def();
  kg_program *program;
  def.lanes = LANES;
  assert_int_equal(kg_program_create(&def, tape, 4, in, 1, &loss, &program, NULL), KG_OK);
  kg_tape_destroy(tape); /* the program stands alone */
  double *k = kg_program_input(program, 3);
  for (int lane = 0; lane < LANES; ++lane) {
    k[lane] = 0.002 * (1 + lane);
  }
  assert_int_equal(kg_program_run(program), KG_OK);
  double *seed = kg_program_seed(program, 0, 1);
  for (int lane = 0; lane < LANES; ++lane) {
    seed[lane] = 1;
  }
  assert_int_equal(kg_program_backward(program, 1), KG_OK);
  for (int lane = 0; lane < LANES; ++lane) {
    tape = new_tape(KG_DOUBLE);
    record_chain(tape, &none, in, &loss);
    const kg_value inputs[4] = {in[0], in[1], in[2], kg_scalar(tape, 0.002 * (1 + lane))};
    kg_value out[2];
    run_chain(tape, &whole, inputs, out);
    const kg_value a = kg_element(tape, out[0], 1), b = kg_element(tape, out[0], 4);
    loss = kg_add(tape, kg_mul(tape, a, b), kg_mul(tape, out[1], a));
    assert_int_equal(kg_backward(tape, loss), KG_OK);
    assert_close(((const double *)kg_program_output(program, 0))[lane], kg_item(tape, loss), 1e-14);
    assert_close(((const double *)kg_program_adjoint(program, 3))[lane],
                 kg_adjoint_item(tape, inputs[3]), 1e-14);
    const double *by_W = kg_adjoint(tape, in[2]), *lanes = kg_program_adjoint(program, 2);
    for (int i = 0; i < N * N; ++i) {
      assert_close(lanes[i * LANES + lane], by_W[i], 1e-14);
    }
    kg_tape_destroy(tape);
  }
  kg_program_destroy(program);
}

/* -- failures ---------------------------------------------------------------------------------- */

/* What goes wrong: 1 an operator, 2 the segment itself, 3 an output left out, 4 a second run that
 * differs, 5 an operator of the second run */
static kg_status faulty_segment(kg_tape *tape, void *user, int input_count, const kg_value *inputs,
                                int output_count, kg_value *outputs)
{
  int *fault = user;
  (void)input_count, (void)output_count;
  kg_tape_tag(tape, "inside");
  if (*fault == 1) kg_matmul(tape, inputs[0], inputs[0], 0);
  if (*fault == 2) return KG_ERR_UNDEFINED;
  if (*fault == 3) return KG_OK;
  outputs[0] = *fault == 5 ? kg_element(tape, inputs[0], 0) : kg_square(tape, inputs[0]);
  if (*fault == 6) kg_matmul(tape, inputs[0], inputs[0], 0);
  if (*fault == 4) *fault = 5;
  if (*fault == 7) *fault = 6;
  return KG_OK;
}

static void expect_fault(int fault, kg_status status, const char *text)
{
  const double a[3] = {1, 2, 3};
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_input(tape, KG_SHAPE(3, 1), a);
  kg_value y = x;
  kg_tape_tag(tape, "outside");
  kg_status found = kg_checkpoint(tape, faulty_segment, &fault, 1, &x, 1, &y);
  if (found == KG_OK) {
    found = kg_backward(tape, y);
  } else {
    assert_true(kg_is_null(y));
  }
  assert_int_equal(found, status);
  assert_string_equal(kg_tape_error(tape)->text, text);
  kg_tape_rewind(tape, (kg_tape_mark){0});
  const kg_value z = kg_scalar(tape, 3);
  fault = 0;
  assert_int_equal(kg_checkpoint(tape, faulty_segment, &fault, 1, &z, 1, &y), KG_OK);
  assert_int_equal(kg_backward(tape, y), KG_OK);
  assert_true(kg_adjoint_item(tape, z) == 6);
  kg_tape_destroy(tape);
}

static void failures_name_both_tags(void **test_state)
{
  (void)test_state;
  const char *const shapes =
    "checkpoint [outside]: matmul [inside]: shapes (3, 1) and (3, 1): rows "
    "of the second must be 1, not 3";
  const char *const undefined =
    "checkpoint [outside]: a function is undefined where its value is needed";
  expect_fault(1, KG_ERR_SHAPE, shapes);
  expect_fault(2, KG_ERR_UNDEFINED, undefined);
  expect_fault(3, KG_ERR_UNDEFINED, "checkpoint [outside]: the segment left an output unset");
  expect_fault(
    4, KG_ERR_SHAPE,
    "checkpoint [outside]: the segment recorded outputs of other sizes than the first time");
  expect_fault(7, KG_ERR_SHAPE, shapes);
}

/* y = x by a primitive whose adjoint fails once */
static kg_status copy_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)user, (void)count;
  *result = shapes[0];
  *saved = 0;
  return KG_OK;
}

static kg_status copy_forward(const kg_primitive_call *call)
{
  *call->out = *call->in[0];
  return KG_OK;
}

static kg_status copy_vjp(const kg_primitive_call *call, const double *adjoint, double *const *to)
{
  bool *fails = call->user;
  const bool failed = *fails;
  *fails = false;
  *to[0] += *adjoint;
  return failed ? KG_ERR_UNDEFINED : KG_OK;
}

static kg_status copy_segment(kg_tape *tape, void *user, int input_count, const kg_value *inputs,
                              int output_count, kg_value *outputs)
{
  (void)output_count;
  outputs[0] = kg_apply(tape, user, input_count, inputs);
  return KG_OK;
}

static void a_failed_sweep_within_leaves_the_tape_usable(void **test_state)
{
  (void)test_state;
  bool fails = true;
  kg_primitive copy = {
    .name = "copy", .user = &fails, .shape = copy_shape, .forward = copy_forward, .vjp = copy_vjp};
  kg_tape *tape = new_tape(KG_DOUBLE);
  kg_value x = kg_scalar(tape, 3), y;
  assert_int_equal(kg_checkpoint(tape, copy_segment, &copy, 1, &x, 1, &y), KG_OK);
  assert_int_equal(kg_backward(tape, y), KG_ERR_UNDEFINED);
  assert_string_equal(kg_tape_error(tape)->text,
                      "checkpoint: copy: a function is undefined where its value is needed");
  kg_tape_rewind(tape, (kg_tape_mark){0});
  x = kg_scalar(tape, 3);
  assert_int_equal(kg_checkpoint(tape, copy_segment, &copy, 1, &x, 1, &y), KG_OK);
  assert_int_equal(kg_backward(tape, y), KG_OK);
  assert_true(kg_adjoint_item(tape, x) == 1);
  kg_tape_destroy(tape);
}

static void counts_out_of_range_are_refused(void **test_state)
{
  (void)test_state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  int fault = 0;
  const kg_value x = kg_scalar(tape, 3);
  kg_value y = x;
  assert_int_equal(kg_checkpoint(tape, faulty_segment, &fault, 0, &x, 1, &y), KG_ERR_SHAPE);
  assert_true(kg_is_null(y));
  assert_string_equal(kg_tape_error(tape)->text,
                      "checkpoint: 0 inputs, 1 outputs; 1 to 32 are possible");
  kg_tape_destroy(tape);
}

/* -- memory ------------------------------------------------------------------------------------ */

static bool survives(int allowed)
{
  failing_heap heap = {.calls_left = allowed};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  def.allocator = &allocator;
  kg_status status = kg_tape_create(&def, &tape, NULL);
  if (status == KG_OK) {
    kg_value in[2], out[5];
    const double a[6] = {0};
    in[0] = kg_input(tape, KG_SHAPE(2, 3), a);
    in[1] = kg_scalar(tape, 0.25);
    status = kg_checkpoint(tape, mixed_segment, NULL, 2, in, 5, out);
    if (status == KG_OK) status = kg_backward(tape, out[3]);
    assert_int_equal(kg_tape_status(tape), status);
  }
  assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
  kg_tape_destroy(tape);
  assert_int_equal(heap.live_bytes, 0);
  return status == KG_OK;
}

static void every_refused_allocation_is_a_status(void **test_state)
{
  (void)test_state;
  int allowed = 0;
  while (!survives(allowed)) {
    assert_at_most(++allowed, 100);
  }
  assert_true(allowed > 8);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(segments_change_no_bit),
    cmocka_unit_test(memory_grows_with_the_square_root_of_the_steps),
    cmocka_unit_test(outputs_keep_their_kind_and_shape),
    cmocka_unit_test(programs_run_segments_at_new_inputs),
    cmocka_unit_test(failures_name_both_tags),
    cmocka_unit_test(a_failed_sweep_within_leaves_the_tape_usable),
    cmocka_unit_test(counts_out_of_range_are_refused),
    cmocka_unit_test(every_refused_allocation_is_a_status),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
