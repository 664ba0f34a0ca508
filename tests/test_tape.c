/* The tape's life: marks and rewinding, errors, null values, NaN and its traces, repeated calls,
 * memory, threads. */
#include "support.h"

#include "autodiff/tape.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/primitive.h"
#include "kinegrad/program.h"

#include <pthread.h>

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  def.precision = precision;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

/* -- a record with something of everything ----------------------------------------------------- */

enum { ROWS = 5, COLUMNS = 7 };

typedef struct model {
  kg_value weight, scale; /* (COLUMNS, ROWS), scalar */
} model;

static model record_model(kg_tape *tape)
{
  double w[COLUMNS * ROWS];
  kg_random random = kg_random_make(11);
  for (size_t i = 0; i < KG_COUNT_OF(w); ++i) {
    w[i] = kg_random_normal(&random);
  }
  return (model){kg_input(tape, KG_SHAPE(COLUMNS, ROWS), w), kg_scalar(tape, 0.7)};
}

/* y = tanh x by a segment */
static kg_status squash(kg_tape *tape, void *user, int input_count, const kg_value *inputs,
                        int output_count, kg_value *outputs)
{
  (void)user, (void)input_count, (void)output_count;
  outputs[0] = kg_tanh(tape, inputs[0]);
  return KG_OK;
}

/* x^2 = p */
static kg_value root_residual(kg_tape *tape, kg_value x, int count, const kg_value *p, void *user)
{
  (void)count, (void)user;
  return kg_sub(tape, kg_square(tape, x), p[0]);
}

static kg_status root_solve(void *user, int count, const kg_shape *shapes,
                            const double *const *parameters, double *x)
{
  (void)user, (void)count, (void)shapes;
  *x = sqrt(*parameters[0]);
  return KG_OK;
}

static const kg_root square_root = {
  .name = "root", .residual = root_residual, .solve = root_solve, .tolerance = 1e-12};

static kg_value record_loss(kg_tape *tape, model m, int frame)
{
  double x[ROWS * COLUMNS];
  for (size_t i = 0; i < KG_COUNT_OF(x); ++i) {
    x[i] = sin((double)i + frame);
  }
  kg_tape_tag(tape, "forward");
  const kg_value data = kg_constant(tape, KG_SHAPE(ROWS, COLUMNS), x);
  const kg_value product = kg_matmul(tape, data, m.weight, 0);
  kg_value squashed = product;
  kg_checkpoint(tape, squash, NULL, 1, &product, 1, &squashed);
  kg_tape_tag(tape, "loss");
  kg_value sum = kg_differentiate_root(tape, &square_root, 1, &m.scale);
  for (int i = 0; i < 20; ++i) {
    const kg_value item = kg_element(tape, squashed, (size_t)i);
    sum = kg_add(tape, sum, kg_mul(tape, kg_sin(tape, item), m.scale));
  }
  return sum;
}

/* -- marks ------------------------------------------------------------------------------------- */

static void rewinding_keeps_what_lies_before_the_mark(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const model m = record_model(tape);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  const size_t nodes = kg_tape_nodes(tape);
  const double *weights = kg_data(tape, m.weight), first = weights[0];
  double values[3], by_scale[3];
  for (int frame = 0; frame < 3; ++frame) {
    const kg_value loss = record_loss(tape, m, frame);
    assert_int_equal(kg_backward(tape, loss), KG_OK);
    values[frame] = kg_item(tape, loss);
    by_scale[frame] = kg_adjoint_item(tape, m.scale);
    kg_tape_rewind(tape, mark);
    assert_int_equal(kg_tape_nodes(tape), nodes);
    assert_ptr_equal(kg_data(tape, m.weight), weights);
    assert_true(weights[0] == first);
  }
  kg_tape *fresh = new_tape(KG_DOUBLE); /* the same, never rewound */
  const model other = record_model(fresh);
  const kg_value loss = record_loss(fresh, other, 2);
  assert_int_equal(kg_backward(fresh, loss), KG_OK);
  assert_true(kg_item(fresh, loss) == values[2]);
  assert_true(kg_adjoint_item(fresh, other.scale) == by_scale[2]);
  assert_true(values[0] != values[2]);
  kg_tape_destroy(fresh);
  kg_tape_rewind(tape, (kg_tape_mark){0});
  assert_int_equal(kg_tape_nodes(tape), 0);
  kg_tape_destroy(tape);
  kg_tape_destroy(NULL);
}

/* refused with this text; the tape forgets the error and nothing else */
static void expect_no_adjoint(kg_tape *tape, kg_value value, kg_status status, const char *text)
{
  assert_null(kg_adjoint(tape, value));
  assert_int_equal(kg_tape_status(tape), status);
  assert_string_equal(kg_tape_error(tape)->text, text);
  kg_tape_rewind(tape, kg_tape_mark_of(tape));
}

static void adjoints_belong_to_the_last_sweep(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_scalar(tape, 3), c = kg_constant_scalar(tape, 2);
  const kg_value y = kg_mul(tape, x, c), unrelated = kg_scalar(tape, 1);
  expect_no_adjoint(tape, x, KG_ERR_UNSUPPORTED,
                    "adjoint: no sweep since the tape was made, or the last one failed");
  assert_int_equal(kg_backward(tape, y), KG_OK);
  assert_true(kg_adjoint_item(tape, x) == 2);
  assert_true(kg_adjoint_item(tape, unrelated) == 0);
  const kg_value late = kg_square(tape, x);
  expect_no_adjoint(tape, late, KG_ERR_UNSUPPORTED,
                    "adjoint: recorded after the last backward sweep");
  expect_no_adjoint(tape, c, KG_ERR_UNDEFINED,
                    "adjoint: of a constant, or of what constants alone make");
  assert_null(kg_adjoint_f32(tape, x));
  assert_string_equal(kg_tape_error(tape)->text,
                      "adjoint: numbers of double precision: kg_adjoint reads them");
  kg_tape_destroy(tape);
  tape = new_tape(KG_FLOAT);
  const kg_value single = kg_input(tape, KG_SHAPE(2), NULL);
  assert_int_equal(kg_backward(tape, single), KG_OK);
  expect_no_adjoint(tape, single, KG_ERR_UNSUPPORTED,
                    "adjoint: numbers of single precision: kg_adjoint_f32 reads them");
  assert_true(kg_adjoint_f32(tape, single)[1] == 1);
  kg_tape_destroy(tape);
}

/* -- errors ------------------------------------------------------------------------------------ */

static void the_first_failure_stays_until_the_rewind(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const double a[6] = {1, 2, 3, 4, 5, 6};
  const kg_value x = kg_input(tape, KG_SHAPE(2, 3), a);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  kg_tape_tag(tape, "torso");
  const kg_value y = kg_add(tape, x, kg_constant(tape, KG_SHAPE(2, 2), NULL));
  assert_true(kg_is_null(y));
  assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
  const char *const text = "add [torso]: shapes (2, 3), (2, 2) do not broadcast";
  assert_string_equal(kg_tape_error(tape)->text, text);
  kg_tape_tag(tape, "arm");
  assert_true(kg_is_null(kg_matmul(tape, x, x, 0)));
  assert_true(kg_is_null(kg_sin(tape, y)));
  assert_true(kg_is_null(kg_scalar(tape, 1)));
  assert_true(kg_is_null(kg_square(tape, x))); /* a failed tape records no more */
  assert_int_equal(kg_backward(tape, x), KG_ERR_SHAPE);
  assert_string_equal(kg_tape_error(tape)->text, text);
  kg_tape_rewind(tape, mark);
  assert_int_equal(kg_tape_status(tape), KG_OK);
  assert_true(kg_is_null(kg_matmul(tape, x, x, 0))); /* the tag went with the rewind */
  assert_string_equal(kg_tape_error(tape)->text,
                      "matmul: shapes (2, 3) and (2, 3): rows of the second must be 3, not 2");
  kg_tape_rewind(tape, mark);
  assert_int_equal(kg_backward(tape, kg_sum_squares(tape, x, 1)), KG_OK);
  assert_true(kg_adjoint(tape, x)[5] == 12);
  kg_tape_destroy(tape);
}

static void null_values_are_harmless(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value null = {0};
  assert_true(kg_is_null(null));
  assert_int_equal(kg_size_of(tape, null), 0);
  assert_int_equal(kg_shape_of(tape, null).rank, 0);
  assert_null(kg_data(tape, null));
  assert_true(isnan(kg_item(tape, null)));
  const kg_value x = kg_scalar(tape, 1);
  assert_null(kg_data_f32(tape, x)); /* of the other precision */
  assert_true(kg_is_null(kg_mul(tape, x, null)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_UNDEFINED);
  kg_tape_rewind(tape, kg_tape_mark_of(tape));
  assert_true(kg_is_null(kg_sin(tape, null)));
  kg_tape_rewind(tape, kg_tape_mark_of(tape));
  assert_int_equal(kg_backward(tape, null), KG_ERR_UNDEFINED);
  kg_tape_rewind(tape, kg_tape_mark_of(tape));
  assert_true(isnan(kg_adjoint_item(tape, null)));
  kg_tape_destroy(tape);
}

static void scalars_come_many_at_once(void **state)
{
  (void)state;
  const double x[3] = {2, 3, 5};
  for (int precision = KG_DOUBLE; precision <= KG_FLOAT; ++precision) {
    kg_tape_def def = kg_tape_default_def();
    def.precision = (kg_precision)precision;
    kg_tape *tape;
    kg_value v[3];
    assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
    kg_scalars(tape, 3, x, v);
    const kg_value y = kg_mul(tape, kg_mul(tape, v[0], v[1]), v[2]);
    assert_int_equal(kg_backward(tape, y), KG_OK);
    for (int i = 0; i < 3; ++i) {
      assert_close(kg_item(tape, v[i]), x[i], 0);
      assert_close(kg_adjoint_item(tape, v[i]), 30 / x[i], 0);
    }
    kg_add(tape, kg_input(tape, KG_SHAPE(2), x), kg_input(tape, KG_SHAPE(3), x));
    kg_scalars(tape, 3, x, v); /* after a failure */
    assert_true(kg_is_null(v[0]) && kg_is_null(v[1]) && kg_is_null(v[2]));
    kg_tape_destroy(tape);
  }
}

static void malformed_shapes_are_refused(void **state)
{
  (void)state;
  const kg_shape shapes[] = {{.rank = 5},
                             {.rank = -1},
                             {.rank = 2, .dim = {3, 0}},
                             {.rank = 4, .dim = {INT32_MAX, INT32_MAX, INT32_MAX, INT32_MAX}}};
  kg_tape *tape = new_tape(KG_DOUBLE);
  for (size_t i = 0; i < KG_COUNT_OF(shapes); ++i) {
    assert_true(kg_is_null(kg_input(tape, shapes[i], NULL)));
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
    kg_tape_rewind(tape, (kg_tape_mark){0});
  }
  kg_tape_destroy(tape);
}

/* -- not-a-number ------------------------------------------------------------------------------ */

/* a zero adjoint stops, even at an infinite slope */
static void a_zero_adjoint_stops(void **state)
{
  (void)state;
  for (int tensor = 0; tensor < 2; ++tensor) {
    kg_tape *tape = new_tape(KG_DOUBLE);
    const double zero[3] = {0, 4, 0}, mask[3] = {0, 1, 0};
    const kg_value x = tensor ? kg_input(tape, KG_SHAPE(3), zero) : kg_scalar(tape, 0);
    const kg_value root = kg_sqrt(tape, x);
    const kg_value m = tensor ? kg_constant(tape, KG_SHAPE(3), mask) : kg_constant_scalar(tape, 0);
    assert_int_equal(kg_backward(tape, kg_mul(tape, root, m)), KG_OK);
    assert_true(kg_adjoint_item(tape, x) == 0);
    if (tensor) assert_true(kg_adjoint(tape, x)[1] == 0.25);
    assert_true(kg_is_null(kg_trace_adjoint(tape).value));
    assert_int_equal(kg_backward(tape, root), KG_OK); /* and a nonzero one does not */
    assert_true(isinf(kg_adjoint_item(tape, x)));
    kg_tape_destroy(tape);
  }
}

/* ... nor do zeros among several seeds or tangents: d sqrt(x) is infinite at 0 */
static void a_zero_direction_stops(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_scalar(tape, 0), root = kg_sqrt(tape, x);
  const double seeds[4] = {0, 2, 0, 0}, *const seed = seeds;
  for (int directions = 1; directions <= 4; ++directions) {
    double result[4], *const results = result;
    assert_int_equal(kg_vjp(tape, directions, 1, &root, &seed, 1, &x, &results), KG_OK);
    for (int s = 0; s < directions; ++s) {
      assert_true(s == 1 ? isinf(result[s]) : result[s] == 0);
    }
    assert_int_equal(kg_jvp(tape, directions, 1, &x, &seed, 1, &root, &results), KG_OK);
    for (int s = 0; s < directions; ++s) {
      assert_true(s == 1 ? isinf(result[s]) : result[s] == 0);
    }
  }
  const kg_value operands[2] = {kg_scalar(tape, 1), kg_scalar(tape, 0)}; /* both slopes infinite */
  const kg_value ratio = kg_div(tape, operands[0], operands[1]);
  const double by_a[3] = {1, 0, 0}, by_b[3] = {0, 1, 0}, *const tangents[2] = {by_a, by_b};
  double moved[3], *const results = moved;
  assert_int_equal(kg_jvp(tape, 3, 2, operands, tangents, 1, &ratio, &results), KG_OK);
  assert_true(moved[0] == HUGE_VAL && moved[1] == -HUGE_VAL && moved[2] == 0);
  kg_tape_destroy(tape);
}

static void the_trace_names_the_first_bad_value(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const double a[4] = {1, 2, -3, 4};
  const kg_value x = kg_input(tape, KG_SHAPE(4), a);
  kg_tape_tag(tape, "spine");
  const kg_value y = kg_exp(tape, x);
  assert_true(kg_is_null(kg_trace_value(tape).value));
  kg_tape_tag(tape, "knee");
  const kg_value bad = kg_log(tape, x);
  kg_tape_tag(tape, "foot");
  kg_sum_all(tape, kg_mul(tape, y, bad));
  kg_trace trace = kg_trace_value(tape);
  assert_int_equal(trace.value.id, bad.id);
  assert_int_equal(trace.index, 2);
  assert_true(isnan(trace.item));
  assert_string_equal(trace.op, "log");
  assert_string_equal(trace.tag, "knee");
  assert_false(trace.adjoint);
  kg_tape_rewind(tape, (kg_tape_mark){0});
  const kg_value input = kg_scalar(tape, INFINITY);
  kg_sin(tape, input);
  trace = kg_trace_value(tape);
  assert_int_equal(trace.value.id, input.id);
  assert_string_equal(trace.op, "input");
  assert_null(trace.tag);
  assert_true(isinf(trace.item));
  kg_tape_destroy(tape);
}

/* 1/x */
static kg_status pole_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                            size_t *saved)
{
  (void)user, (void)count;
  *result = shapes[0];
  *saved = 0;
  return KG_OK;
}

static kg_status pole_forward(const kg_primitive_call *call)
{
  *call->out = 1 / *call->in[0];
  return KG_OK;
}

static kg_status pole_vjp(const kg_primitive_call *call, const double *adjoint, double *const *to)
{
  *to[0] -= *adjoint * *call->out * *call->out;
  return KG_OK;
}

static void primitives_are_traced_by_name(void **state)
{
  (void)state;
  const kg_primitive pole = {
    .name = "pole", .shape = pole_shape, .forward = pole_forward, .vjp = pole_vjp};
  kg_tape *tape = new_tape(KG_DOUBLE);
  kg_tape_tag(tape, "hip");
  const kg_value zero = kg_scalar(tape, 0), y = kg_sin(tape, kg_apply(tape, &pole, 1, &zero));
  assert_false(kg_is_null(y));
  assert_string_equal(kg_trace_value(tape).op, "pole");
  assert_string_equal(kg_trace_value(tape).tag, "hip");
  assert_true(isinf(kg_trace_value(tape).item));
  const kg_value small = kg_scalar(tape, 1e-200),
                 x = kg_square(tape, kg_apply(tape, &pole, 1, &small));
  assert_true(isinf(kg_item(tape, x)));
  const kg_value large = kg_apply(tape, &pole, 1, &small);
  assert_int_equal(kg_backward(tape, large), KG_OK);
  const kg_trace trace = kg_trace_adjoint(tape);
  assert_int_equal(trace.value.id, small.id);
  assert_string_equal(trace.op, "pole");
  assert_string_equal(trace.tag, "hip");
  kg_tape_destroy(tape);
}

/* x is used by a harmless operator after, and by one before, the rule that makes the infinity */
static kg_value record_blame(kg_tape *tape, kg_value x, kg_value *y)
{
  kg_tape_tag(tape, "before");
  const kg_value a = kg_cos(tape, x);
  kg_tape_tag(tape, "culprit");
  const kg_value b = kg_sqrt(tape, x);
  kg_tape_tag(tape, "after");
  const kg_value c = kg_exp(tape, x);
  kg_tape_tag(tape, "sum");
  *y = kg_add(tape, kg_add(tape, a, b), c);
  return x;
}

static void check_blame(kg_tape *tape, kg_value x, size_t index)
{
  kg_value y;
  record_blame(tape, x, &y);
  assert_int_equal(kg_backward(tape, y), KG_OK);
  const kg_trace trace = kg_trace_adjoint(tape);
  assert_int_equal(trace.value.id, x.id);
  assert_int_equal(trace.index, index);
  assert_true(isinf(trace.item) && trace.adjoint);
  assert_string_equal(trace.op, "sqrt");
  assert_string_equal(trace.tag, "culprit");
}

/* memory that holds NaN until something is written */
static void *nan_alloc(size_t bytes, void *user)
{
  (void)user;
  void *memory = malloc(bytes);
  return memory ? memset(memory, 0xff, bytes) : NULL;
}

static void plain_free(void *memory, size_t bytes, void *user)
{
  (void)bytes, (void)user;
  free(memory);
}

static void the_adjoint_trace_blames_the_rule_that_did_it(void **state)
{
  (void)state;
  const double a[3] = {1, 0, 2};
  const kg_allocator allocator = {nan_alloc, plain_free, NULL};
  const kg_tape_def def = {KG_DOUBLE, &allocator, 3};
  kg_tape *tape;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  check_blame(tape, kg_scalar(tape, 0), 0);
  check_blame(tape, kg_input(tape, KG_SHAPE(3), a), 1);
  kg_tape *single = new_tape(KG_FLOAT);
  check_blame(single, kg_input(single, KG_SHAPE(3), a), 1);
  const kg_value fine = kg_square(single, kg_input(single, KG_SHAPE(3), a));
  assert_int_equal(kg_backward(single, fine), KG_OK);
  assert_true(kg_is_null(kg_trace_adjoint(single).value));
  kg_tape_destroy(single);
  kg_tape_destroy(tape);
}

/* what reaches a rule as zero, or as an infinity, is not its work; the entry counts within its
 * direction */
static void the_adjoint_trace_acquits(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_scalar(tape, 0), reciprocal = kg_reciprocal(tape, x);
  const kg_value innocent = kg_scale(tape, kg_sqrt(tape, x), 0);
  assert_int_equal(kg_backward(tape, kg_add(tape, innocent, reciprocal)), KG_OK);
  assert_string_equal(kg_trace_adjoint(tape).op, "reciprocal");
  const kg_value y = kg_scale(tape, kg_square(tape, kg_scalar(tape, 3)), 2);
  const double infinite[2] = {INFINITY, 1}, *seed = infinite;
  double gradient[6], *result = gradient;
  assert_int_equal(kg_vjp(tape, 1, 1, &y, &seed, 1, &x, &result), KG_OK);
  assert_true(kg_is_null(kg_trace_adjoint(tape).value));
  const double a[3] = {1, 2, 0}, seeds[6] = {1, 1, 0, 1, 1, 1};
  const kg_value b = kg_input(tape, KG_SHAPE(3), a), root = kg_sqrt(tape, b);
  seed = seeds;
  assert_int_equal(kg_vjp(tape, 2, 1, &root, &seed, 1, &b, &result), KG_OK);
  assert_int_equal(kg_trace_adjoint(tape).index, 2);
  kg_tape_destroy(tape);
}

/* -- repeated calls ---------------------------------------------------------------------------- */

static void the_third_call_equals_the_first(void **state)
{
  (void)state;
  double gradient[6][COLUMNS * ROWS];
  kg_tape *tape = new_tape(KG_DOUBLE);
  const model m = record_model(tape);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  for (int call = 0; call < 6; ++call) { /* each record is swept twice */
    if (call % 2 == 0) kg_tape_rewind(tape, mark);
    static kg_value loss;
    if (call % 2 == 0) loss = record_loss(tape, m, 1);
    double *result = gradient[call];
    assert_int_equal(kg_gradient(tape, loss, 1, &m.weight, &result), KG_OK);
    assert_memory_equal(gradient[call], gradient[0], sizeof gradient[0]);
  }
  assert_true(gradient[0][3] != 0);
  kg_tape_destroy(tape);
}

/* -- memory ------------------------------------------------------------------------------------ */

typedef struct counting_heap {
  int calls;
} counting_heap;

static void *counting_alloc(size_t bytes, void *user)
{
  ++((counting_heap *)user)->calls;
  return malloc(bytes);
}

static void counting_free(void *memory, size_t bytes, void *user)
{
  (void)bytes, (void)user;
  free(memory);
}

/* record, gradient, several seeds, tangents */
static kg_status one_round(kg_tape *tape, model m, int frame)
{
  const kg_value loss = record_loss(tape, m, frame);
  double by_weight[3 * COLUMNS * ROWS] = {0}, tangent[2];
  const double seeds[3] = {1, 2, 3}, *seed = seeds, *direction = by_weight;
  double *result = by_weight, *out = tangent;
  kg_status status = kg_backward(tape, loss);
  if (status == KG_OK) status = kg_vjp(tape, 3, 1, &loss, &seed, 1, &m.weight, &result);
  if (status == KG_OK) status = kg_jvp(tape, 2, 1, &m.weight, &direction, 1, &loss, &out);
  return status;
}

static void the_steady_state_allocates_nothing(void **state)
{
  (void)state;
  for (int precision = KG_DOUBLE; precision <= KG_FLOAT; ++precision) {
    counting_heap heap = {0};
    const kg_allocator allocator = {counting_alloc, counting_free, &heap};
    kg_tape_def def = {(kg_precision)precision, &allocator, 3};
    kg_tape *tape;
    assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
    const model m = record_model(tape);
    const kg_tape_mark mark = kg_tape_mark_of(tape);
    int after_first = 0;
    for (int round = 0; round < 50; ++round) {
      assert_int_equal(one_round(tape, m, round), KG_OK);
      kg_tape_rewind(tape, mark);
      after_first = round == 0 ? heap.calls : after_first;
    }
    assert_true(after_first > 5);
    assert_int_equal(heap.calls, after_first);
    kg_tape_destroy(tape);
  }
}

static bool survives(int allowed)
{
  failing_heap heap = {.calls_left = allowed};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_tape_def def = kg_tape_default_def();
  kg_tape *tape;
  kg_error error;
  def.allocator = &allocator;
  kg_status status = kg_tape_create(&def, &tape, &error);
  if (status == KG_OK) {
    const model m = record_model(tape);
    status = one_round(tape, m, 0);
    assert_int_equal(kg_tape_status(tape), status);
    if (status != KG_OK) { /* the tape can be used on with what it has got */
      assert_true(strlen(kg_tape_error(tape)->text) > 0);
      heap.calls_left = 1000;
      kg_tape_rewind(tape, (kg_tape_mark){0});
      assert_int_equal(one_round(tape, record_model(tape), 0), KG_OK);
    }
  } else {
    assert_null(tape);
    assert_int_equal(error.status, KG_ERR_NO_MEMORY);
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
    assert_at_most(++allowed, 200);
  }
  assert_true(allowed > 10);
}

/* -- threads ----------------------------------------------------------------------------------- */

enum { THREADS = 8, ROUNDS = 20 };

typedef struct worker {
  pthread_t thread;
  double gradient[ROUNDS][COLUMNS * ROWS], frozen[COLUMNS * ROWS];
  kg_status status;
} worker;

/* the gradient of the first frame by a program of the thread's own */
static kg_status run_frozen(kg_tape *tape, model m, double *gradient)
{
  kg_program *program;
  const kg_value loss = record_loss(tape, m, 0);
  kg_status status = kg_program_create(NULL, tape, 1, &m.weight, 1, &loss, &program, NULL);
  if (status != KG_OK) return status;
  status = kg_program_run(program);
  *(double *)kg_program_seed(program, 0, 1) = 1;
  if (status == KG_OK) status = kg_program_backward(program, 1);
  memcpy(gradient, kg_program_adjoint(program, 0), COLUMNS * ROWS * sizeof *gradient);
  kg_program_destroy(program);
  return status;
}

static void *work(void *data)
{
  worker *w = data;
  kg_tape *tape;
  w->status = kg_tape_create(NULL, &tape, NULL);
  if (w->status != KG_OK) return NULL;
  const model m = record_model(tape);
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  for (int round = 0; round < ROUNDS && w->status == KG_OK; ++round) {
    double *result = w->gradient[round];
    w->status = kg_gradient(tape, record_loss(tape, m, round), 1, &m.weight, &result);
    kg_tape_rewind(tape, mark);
  }
  if (w->status == KG_OK) w->status = run_frozen(tape, m, w->frozen);
  kg_tape_destroy(tape);
  return NULL;
}

static void tapes_in_threads_do_not_meet(void **state)
{
  (void)state;
  static worker workers[THREADS], alone;
  for (int i = 0; i < THREADS; ++i) {
    assert_int_equal(pthread_create(&workers[i].thread, NULL, work, &workers[i]), 0);
  }
  for (int i = 0; i < THREADS; ++i) {
    pthread_join(workers[i].thread, NULL);
  }
  work(&alone);
  assert_int_equal(alone.status, KG_OK);
  for (int i = 0; i < THREADS; ++i) {
    assert_int_equal(workers[i].status, KG_OK);
    assert_memory_equal(workers[i].gradient, alone.gradient, sizeof alone.gradient);
    assert_memory_equal(workers[i].frozen, alone.gradient[0], sizeof alone.frozen);
  }
}

/* -- adjoints and tangents that are not there, and those of intermediate values ------------------ */

static kg_value chain_of_sines(kg_tape *tape, kg_value x, int length)
{
  for (int i = 0; i < length; ++i) {
    x = kg_sin(tape, x);
  }
  return x;
}

/* values of the old record had these ids; the second has far more numbers than the sweep had room for */
static void a_rewound_sweep_has_no_adjoints(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_tape_mark empty = kg_tape_mark_of(tape);
  assert_int_equal(kg_backward(tape, chain_of_sines(tape, kg_scalar(tape, 2), 100)), KG_OK);
  kg_tape_rewind(tape, empty);
  kg_scalar(tape, 1);
  assert_null(kg_trace_adjoint(tape).op);
  assert_null(kg_adjoint(tape, kg_scalar(tape, 1)));
  kg_tape_rewind(tape, empty);
  assert_null(kg_adjoint(tape, kg_input(tape, KG_SHAPE(100000), NULL)));
  assert_int_equal(kg_tape_status(tape), KG_ERR_UNSUPPORTED);
  kg_tape_destroy(tape);
}

static void adjoints_a_sweep_left_out_are_refused(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value x = kg_scalar(tape, 2), y = kg_square(tape, x), z = kg_mul(tape, y, x);
  const double one = 1, *const tangent = &one;
  double result, *const results = &result;
  assert_int_equal(kg_gradient(tape, z, 1, &y, &results), KG_OK);
  assert_close(kg_adjoint_item(tape, y), 2, 0);
  assert_true(isnan(kg_adjoint_item(tape, x))); /* the way through y is missing */
  kg_tape_rewind(tape, kg_tape_mark_of(tape));
  expect_no_adjoint(tape, x, KG_ERR_UNSUPPORTED,
                    "adjoint: older than the inputs for which the last sweep was made");
  assert_int_equal(kg_gradient(tape, z, 1, &x, &results), KG_OK);
  assert_close(kg_adjoint_item(tape, x), 12, 0);
  assert_int_equal(kg_jvp(tape, 1, 1, &x, &tangent, 1, &z, &results), KG_OK);
  assert_null(kg_trace_adjoint(tape).op);
  expect_no_adjoint(tape, z, KG_ERR_UNSUPPORTED, "adjoint: the last sweep went forward");
  kg_tape_destroy(tape);
}

/* z = sin y, y = x^2: dz = cos y (dy + 2 x dx), for dx and dy of two directions */
static void check_intermediate_tangents(kg_precision precision, kg_value x_of(kg_tape *, double))
{
  kg_tape *tape = new_tape(precision);
  const kg_value x = x_of(tape, 0.75), y = kg_square(tape, x), z = kg_sin(tape, y);
  const double dx[] = {1, 0}, dy[] = {0.5, 2}, *const tangents[] = {dx, dy};
  const kg_value both[] = {x, y};
  double dz[2], dyy[2], *const results[] = {dz, dyy};
  const kg_value outputs[] = {z, y};
  const double tolerance = precision == KG_DOUBLE ? 1e-15 : 1e-6;
  assert_int_equal(kg_jvp(tape, 2, 2, both, tangents, 2, outputs, results), KG_OK);
  for (int s = 0; s < 2; ++s) {
    assert_close(dyy[s], dy[s] + 1.5 * dx[s], tolerance);
    assert_close(dz[s], cos(0.5625) * (dy[s] + 1.5 * dx[s]), tolerance);
  }
  assert_int_equal(kg_jvp(tape, 2, 1, &y, &tangents[1], 1, &z, results), KG_OK);
  assert_close(dz[1], cos(0.5625) * 2, tolerance);
  kg_tape_destroy(tape);
}

static kg_value a_scalar(kg_tape *tape, double x)
{
  return kg_scalar(tape, x);
}

static kg_value a_vector(kg_tape *tape, double x)
{
  return kg_input(tape, KG_SHAPE(1), &x);
}

static void intermediate_values_have_tangents_of_their_own(void **state)
{
  (void)state;
  check_intermediate_tangents(KG_DOUBLE, a_scalar);
  check_intermediate_tangents(KG_DOUBLE, a_vector);
  check_intermediate_tangents(KG_FLOAT, a_vector);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(rewinding_keeps_what_lies_before_the_mark),
    cmocka_unit_test(adjoints_belong_to_the_last_sweep),
    cmocka_unit_test(the_first_failure_stays_until_the_rewind),
    cmocka_unit_test(null_values_are_harmless),
    cmocka_unit_test(scalars_come_many_at_once),
    cmocka_unit_test(malformed_shapes_are_refused),
    cmocka_unit_test(a_zero_adjoint_stops),
    cmocka_unit_test(a_zero_direction_stops),
    cmocka_unit_test(the_trace_names_the_first_bad_value),
    cmocka_unit_test(primitives_are_traced_by_name),
    cmocka_unit_test(the_adjoint_trace_blames_the_rule_that_did_it),
    cmocka_unit_test(the_adjoint_trace_acquits),
    cmocka_unit_test(the_third_call_equals_the_first),
    cmocka_unit_test(the_steady_state_allocates_nothing),
    cmocka_unit_test(every_refused_allocation_is_a_status),
    cmocka_unit_test(tapes_in_threads_do_not_meet),
    cmocka_unit_test(a_rewound_sweep_has_no_adjoints),
    cmocka_unit_test(adjoints_a_sweep_left_out_are_refused),
    cmocka_unit_test(intermediate_values_have_tangents_of_their_own),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
