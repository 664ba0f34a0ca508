/* Programs frozen from a record: the bits of recording, in one lane; the same answers in many. */
#include "autodiff/frozen.h"
#include "autodiff/tape.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"
#include "support.h"

#include <complex.h>

/* f(x, y, T) with shared, repeated, dead and constant parts; two outputs, a scalar and (2, 3) */
typedef struct formula {
  kg_value in[3], out[2];
} formula;

static formula record(kg_tape *t, double x, double y, const double *numbers)
{
  formula f = {{kg_scalar(t, x), kg_scalar(t, y), kg_input(t, KG_SHAPE(2, 3), numbers)}, {{0}}};
  const kg_value c = kg_mul(t, kg_constant_scalar(t, 3.0), kg_sqrt(t, kg_constant_scalar(t, 2.0)));
  const kg_value s = kg_sin(t, kg_mul(t, f.in[0], f.in[1]));
  const kg_value again = kg_sin(t, kg_mul(t, f.in[0], f.in[1]));
  const kg_value dead = kg_exp(t, kg_add(t, s, f.in[1]));
  const kg_value both = kg_add(t, kg_scale(t, kg_mul(t, s, c), 0.5), kg_div(t, again, f.in[1]));
  const kg_value tensor = kg_mul(t, kg_tanh(t, kg_add(t, f.in[2], both)), kg_exp(t, f.in[2]));
  (void)dead;
  f.out[0] = kg_hypot(t, kg_atan2(t, both, f.in[0]), kg_power(t, f.in[1], 2.5));
  f.out[1] = kg_sub(t, tensor, kg_mul(t, f.out[0], kg_constant_scalar(t, 3.0)));
  return f;
}

static const double seed0 = 0.7, seed1[6] = {1, -2, 0.5, 0.25, 3, -1};

/* value and gradient by recording: (1 + 6), (1 + 1 + 6) */
static void by_recording(kg_tape *t, const double *x, double *value, double *gradient)
{
  kg_tape_rewind(t, (kg_tape_mark){0});
  const formula f = record(t, x[0], x[1], x + 2);
  value[0] = kg_item(t, f.out[0]);
  memcpy(value + 1, kg_data(t, f.out[1]), 6 * sizeof *value);
  const double *const seeds[2] = {&seed0, seed1};
  double *const results[3] = {gradient, gradient + 1, gradient + 2};
  assert_int_equal(kg_vjp(t, 1, 2, f.out, seeds, 3, f.in, results), KG_OK);
}

static kg_program *freeze(const kg_program_def *def, const kg_tape *t, const formula *f)
{
  kg_program *program;
  kg_error error;
  if (kg_program_create(def, t, 3, f->in, 2, f->out, &program, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return program;
}

static void put(kg_program *p, size_t lanes, size_t lane, const double *x)
{
  ((double *)kg_program_input(p, 0))[lane] = x[0];
  ((double *)kg_program_input(p, 1))[lane] = x[1];
  for (size_t e = 0; e < 6; ++e) {
    ((double *)kg_program_input(p, 2))[e * lanes + lane] = x[2 + e];
  }
}

static void random_point(kg_random *random, double *x)
{
  for (int i = 0; i < 8; ++i) {
    x[i] = 0.5 + kg_random_uniform(random);
  }
}

/* The recording tape is gone when the program runs; every lane has a point of its own. */
static void check_against_recording(int lanes, int simd)
{
  const size_t n = (size_t)lanes;
  kg_random random = kg_random_make(3);
  kg_tape *t;
  kg_tape_def tape_def = kg_tape_default_def();
  tape_def.simd = simd;
  assert_int_equal(kg_tape_create(&tape_def, &t, NULL), KG_OK);
  double x[32][8];
  random_point(&random, x[0]);
  const formula f = record(t, x[0][0], x[0][1], x[0] + 2);
  kg_program_def def = kg_program_default_def();
  def.lanes = lanes;
  kg_program *p = freeze(&def, t, &f);
  kg_tape_destroy(t);
  assert_int_equal(kg_tape_create(&tape_def, &t, NULL), KG_OK);
  for (int round = 0; round < 3; ++round) {
    for (size_t lane = 0; lane < n; ++lane) {
      random_point(&random, x[lane]);
      put(p, n, lane, x[lane]);
    }
    assert_int_equal(kg_program_run(p), KG_OK);
    double *seeds[2] = {kg_program_seed(p, 0, 2), kg_program_seed(p, 1, 2)};
    for (size_t lane = 0; lane < n; ++lane) { /* direction 1; direction 0 stays zero */
      seeds[0][n + lane] = seed0;
      for (size_t e = 0; e < 6; ++e) {
        seeds[1][(6 + e) * n + lane] = seed1[e];
      }
    }
    assert_int_equal(kg_program_backward(p, 2), KG_OK);
    for (size_t lane = 0; lane < n; ++lane) {
      double value[7], gradient[8], replayed[7], adjoint[8];
      by_recording(t, x[lane], value, gradient);
      for (size_t e = 0; e < 7; ++e) {
        const double *out = kg_program_output(p, e > 0);
        replayed[e] = e ? out[(e - 1) * n + lane] : out[lane];
      }
      for (size_t e = 0; e < 8; ++e) {
        const int i = e < 2 ? (int)e : 2;
        const size_t size = e < 2 ? 1 : 6, at = e < 2 ? 0 : e - 2;
        const double *both = kg_program_adjoint(p, i);
        assert_true(both[at * n + lane] == 0);
        adjoint[e] = both[(size + at) * n + lane];
      }
      assert_memory_equal(value, replayed, sizeof value);
      if (lanes == 1) assert_memory_equal(gradient, adjoint, sizeof gradient);
      for (size_t e = 0; e < 8; ++e) { /* lanes may take a sum in another order */
        assert_close(gradient[e], adjoint[e], 1e-14);
      }
    }
  }
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

static void test_replay_is_recording_bit_for_bit(void **state)
{
  (void)state;
  check_against_recording(1, 3);
  check_against_recording(1, 2);
  check_against_recording(1, 0);
}

static void test_lanes_are_independent(void **state)
{
  (void)state;
  check_against_recording(2, 3);
  check_against_recording(7, 3);
  check_against_recording(32, 0);
}

static void test_fate_of_every_value(void **state)
{
  (void)state;
  const double x[8] = {0.3, 0.8, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6};
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const formula f = record(t, x[0], x[1], x + 2);
  kg_program *p = freeze(NULL, t, &f);
  const kg_program_info info = kg_program_describe(p);
  assert_int_equal(info.recorded, kg_tape_nodes(t));
  assert_int_equal(info.inputs, 3);
  assert_int_equal(info.outputs, 2);
  assert_int_equal(info.dead, 2);     /* exp(s + y) */
  assert_int_equal(info.constant, 5); /* 3, 2, sqrt, 3 sqrt 2, and 3 once more */
  assert_int_equal(info.shared, 2);   /* x y and its sine */
  assert_int_equal(info.recorded, 3 + info.dead + info.constant + info.shared + info.run);
  assert_true(info.bytes > sizeof(kg_program));
  assert_int_equal(kg_program_input_size(p, 2), 6);
  assert_int_equal(kg_program_output_size(p, 1), 6);
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

static void test_forward_and_backward_agree(void **state)
{
  (void)state;
  enum { LANES = 5 };
  kg_random random = kg_random_make(8);
  const double x[8] = {0.3, 0.8, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6};
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const formula f = record(t, x[0], x[1], x + 2);
  kg_program *p = freeze(&(kg_program_def){.lanes = LANES}, t, &f);
  assert_int_equal(kg_program_run(p), KG_OK);
  double *w = kg_program_seed(p, 1, 1), *d = kg_program_tangent(p, 2, 1);
  for (int i = 0; i < 6 * LANES; ++i) {
    w[i] = kg_random_normal(&random);
    d[i] = kg_random_normal(&random);
  }
  assert_int_equal(kg_program_forward(p, 1), KG_OK);
  double forward = 0, backward = 0, size = 0;
  for (int i = 0; i < 6 * LANES; ++i) {
    const double term = w[i] * ((const double *)kg_program_output_tangent(p, 1))[i];
    forward += term;
    size += fabs(term);
  }
  for (int lane = 0; lane < LANES; ++lane) { /* the scalars do not depend on the tensor */
    assert_true(((const double *)kg_program_output_tangent(p, 0))[lane] == 0);
  }
  assert_int_equal(kg_program_backward(p, 1), KG_OK);
  for (int i = 0; i < 6 * LANES; ++i) {
    backward += d[i] * ((const double *)kg_program_adjoint(p, 2))[i];
  }
  assert_at_most(fabs(forward - backward), 1e-13 * size);
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

/* Outputs that are inputs or constants or one value twice; inputs that nothing reads. */
static void test_odd_ends(void **state)
{
  (void)state;
  enum { LANES = 3 };
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 2), unread = kg_scalar(t, 5), other = kg_scalar(t, 6);
  const kg_value fixed = kg_mul(t, other, kg_constant_scalar(t, 4)); /* no input of the program */
  const kg_value y = kg_mul(t, x, fixed);
  const kg_value in[2] = {unread, x}, out[5] = {y, x, fixed, y, kg_neg(t, kg_neg(t, y))};
  kg_program *p;
  assert_int_equal(kg_program_create(&(kg_program_def){.lanes = LANES}, t, 2, in, 5, out, &p, NULL),
                   KG_OK);
  kg_tape_destroy(t);
  for (int lane = 0; lane < LANES; ++lane) {
    ((double *)kg_program_input(p, 1))[lane] = lane + 1;
  }
  assert_int_equal(kg_program_run(p), KG_OK);
  for (int o = 0; o < 5; ++o) {
    for (int lane = 0; lane < LANES; ++lane) {
      ((double *)kg_program_seed(p, o, 1))[lane] = o == 0 ? 1 : o == 1 ? 10 : o == 2 ? 100 : 1000;
    }
  }
  for (int lane = 0; lane < LANES; ++lane) {
    ((double *)kg_program_tangent(p, 1, 1))[lane] = 1;
    ((double *)kg_program_tangent(p, 0, 1))[lane] = 7;
  }
  assert_int_equal(kg_program_backward(p, 1), KG_OK);
  for (int lane = 0; lane < LANES; ++lane) {
    assert_true(((const double *)kg_program_output(p, 0))[lane] == 24 * (lane + 1));
    assert_true(((const double *)kg_program_output(p, 1))[lane] == lane + 1);
    assert_true(((const double *)kg_program_output(p, 2))[lane] == 24);
    assert_true(((const double *)kg_program_adjoint(p, 1))[lane] == 24 + 10 + 24000 + 24000);
    assert_true(((const double *)kg_program_adjoint(p, 0))[lane] == 0);
  }
  assert_int_equal(kg_program_forward(p, 1), KG_OK);
  const double expected[5] = {24, 1, 0, 24, 24};
  for (int o = 0; o < 5; ++o) {
    for (int lane = 0; lane < LANES; ++lane) {
      assert_true(((const double *)kg_program_output_tangent(p, o))[lane] == expected[o]);
    }
  }
  kg_program_destroy(p);
}

/* Results of a sweep are there after it, not before, and not after one of the other kind. */
static void test_results_of_sweeps_that_were_not_made(void **state)
{
  (void)state;
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 2), y = kg_square(t, x);
  kg_program *p;
  assert_int_equal(kg_program_create(NULL, t, 1, &x, 1, &y, &p, NULL), KG_OK);
  *(double *)kg_program_seed(p, 0, 1) = 3;
  *(double *)kg_program_tangent(p, 0, 1) = 5;
  assert_null(kg_program_adjoint(p, 0));
  assert_null(kg_program_output_tangent(p, 0));
  assert_int_equal(kg_program_run(p), KG_OK);
  assert_null(kg_program_adjoint(p, 0));
  assert_int_equal(kg_program_backward(p, 1), KG_OK);
  assert_true(*(const double *)kg_program_adjoint(p, 0) == 12);
  assert_null(kg_program_output_tangent(p, 0));
  assert_int_equal(kg_program_forward(p, 1), KG_OK);
  assert_null(kg_program_adjoint(p, 0));
  assert_true(*(const double *)kg_program_output_tangent(p, 0) == 20);
  assert_int_equal(kg_program_backward(p, 2), KG_ERR_UNDEFINED); /* no seeds for two */
  assert_null(kg_program_adjoint(p, 0));
  assert_null(kg_program_output_tangent(p, 0));
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

static void test_seeds_stay_until_directions_change(void **state)
{
  (void)state;
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 2), y = kg_square(t, x);
  kg_program *p;
  assert_int_equal(kg_program_create(NULL, t, 1, &x, 1, &y, &p, NULL), KG_OK);
  assert_int_equal(kg_program_backward(p, 1), KG_ERR_UNDEFINED); /* no run yet */
  assert_int_equal(kg_program_run(p), KG_OK);
  assert_int_equal(kg_program_backward(p, 1), KG_ERR_UNDEFINED); /* no seed yet */
  *(double *)kg_program_seed(p, 0, 1) = 3;
  for (int round = 0; round < 2; ++round) {
    assert_int_equal(kg_program_backward(p, 1), KG_OK);
    assert_true(*(const double *)kg_program_adjoint(p, 0) == 12);
    assert_true(*(const double *)kg_program_seed(p, 0, 1) == 3);
  }
  const double *seed = kg_program_seed(p, 0, 2);
  assert_true(seed[0] == 0 && seed[1] == 0);
  assert_int_equal(kg_program_backward(p, 1), KG_ERR_UNDEFINED);
  assert_non_null(strstr(kg_program_error(p)->text, "backward"));
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

/* a comparison that turns around, named by tag and lane; one that depends on no input is dropped */
static void test_stale_comparison(void **state)
{
  (void)state;
  enum { LANES = 9 };
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 1), data = kg_constant_scalar(t, 2), other = kg_scalar(t, 3);
  assert_false(kg_is_less(t, other, kg_constant_scalar(t, 1)));
  kg_tape_tag(t, "friction cone");
  const kg_value square = kg_square(t, x);
  const kg_value y = kg_is_less(t, square, data) ? kg_exp(t, x) : kg_log(t, x);
  kg_tape_tag(t, NULL);
  const kg_value in[2] = {x, data};
  kg_program *p;
  assert_int_equal(kg_program_create(&(kg_program_def){.lanes = LANES}, t, 2, in, 1, &y, &p, NULL),
                   KG_OK);
  kg_tape_destroy(t);
  double *xs = kg_program_input(p, 0), *bounds = kg_program_input(p, 1);
  assert_int_equal(kg_program_run(p), KG_OK);
  xs[7] = 1.5;
  assert_int_equal(kg_program_run(p), KG_ERR_STALE);
  const char *text = kg_program_error(p)->text;
  assert_non_null(strstr(text, "is_less [friction cone]"));
  assert_non_null(strstr(text, "square < input"));
  assert_non_null(strstr(text, "lane 7"));
  assert_int_equal(kg_program_backward(p, 1), KG_ERR_UNDEFINED);
  bounds[7] = 3;
  assert_int_equal(kg_program_run(p), KG_OK);
  bounds[0] = 1;
  assert_int_equal(kg_program_run(p), KG_ERR_STALE);
  assert_non_null(strstr(kg_program_error(p)->text, "lane 0"));
  kg_program_destroy(p);
}

static void test_undefined_names_operator_and_tag(void **state)
{
  (void)state;
  enum { LANES = 2 };
  const double identity[4] = {1, 0, 0, 1};
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value a = kg_input(t, KG_SHAPE(2, 2), identity);
  kg_tape_tag(t, "mass matrix");
  const kg_value x = kg_solve(t, a, kg_constant(t, KG_SHAPE(2, 2), identity), 0);
  kg_program *p;
  assert_int_equal(kg_program_create(&(kg_program_def){.lanes = LANES}, t, 1, &a, 1, &x, &p, NULL),
                   KG_OK);
  assert_int_equal(kg_program_run(p), KG_OK);
  ((double *)kg_program_input(p, 0))[1] = 0; /* entry (0, 0) of lane 1 */
  assert_int_equal(kg_program_run(p), KG_ERR_UNDEFINED);
  assert_non_null(strstr(kg_program_error(p)->text, "solve [mass matrix]"));
  assert_non_null(strstr(kg_program_error(p)->text, "needed, lane 1"));
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

/* Constants of the tape can be inputs too: they vary, and are not differentiated. */
static void test_data_inputs(void **state)
{
  (void)state;
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 2), data = kg_constant_scalar(t, 3);
  const kg_value in[2] = {x, data}, y = kg_mul(t, x, kg_square(t, data));
  kg_program *p;
  assert_int_equal(kg_program_create(NULL, t, 2, in, 1, &y, &p, NULL), KG_OK);
  *(double *)kg_program_input(p, 1) = 5;
  *(double *)kg_program_seed(p, 0, 1) = 1;
  *(double *)kg_program_tangent(p, 0, 1) = 1;
  *(double *)kg_program_tangent(p, 1, 1) = 1000;
  assert_int_equal(kg_program_run(p), KG_OK);
  assert_int_equal(kg_program_backward(p, 1), KG_OK);
  assert_true(*(const double *)kg_program_output(p, 0) == 50);
  assert_true(*(const double *)kg_program_adjoint(p, 0) == 25);
  assert_null(kg_program_adjoint(p, 1));
  assert_int_equal(kg_program_forward(p, 1), KG_OK);
  assert_true(*(const double *)kg_program_output_tangent(p, 0) == 25);
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

static void test_refused_values(void **state)
{
  (void)state;
  kg_tape *t;
  kg_program *p;
  kg_error error;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 2), y = kg_square(t, x), null = {0};
  const kg_value twice[2] = {x, x};
  assert_int_equal(kg_program_create(NULL, t, 1, &y, 1, &y, &p, &error), KG_ERR_UNSUPPORTED);
  assert_non_null(strstr(error.text, "input 0"));
  assert_null(p);
  assert_int_equal(kg_program_create(NULL, t, 2, twice, 1, &y, &p, &error), KG_ERR_UNSUPPORTED);
  assert_int_equal(kg_program_create(NULL, t, 1, &x, 1, &null, &p, &error), KG_ERR_UNDEFINED);
  const double numbers[2] = {1, 2};
  const kg_value a = kg_input(t, KG_SHAPE(2), numbers), b = kg_input(t, KG_SHAPE(3), NULL);
  const kg_value none = kg_add(t, a, b);
  assert_int_equal(kg_program_create(NULL, t, 1, &x, 1, &none, &p, &error), KG_ERR_SHAPE);
  assert_non_null(strstr(error.text, "add")); /* the recording's own failure */
  kg_tape_destroy(t);
}

static void test_memory_refused_anywhere(void **state)
{
  (void)state;
  const double x[8] = {0.3, 0.8, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6};
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const formula f = record(t, x[0], x[1], x + 2);
  int refusals = 0;
  for (kg_status status = KG_ERR_NO_MEMORY; status != KG_OK; ++refusals) {
    failing_heap heap = {refusals, 0};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    const kg_program_def def = {.lanes = 4, .allocator = &allocator};
    kg_program *p;
    kg_error error;
    status = kg_program_create(&def, t, 3, f.in, 2, f.out, &p, &error);
    if (status == KG_OK) {
      assert_int_equal(kg_program_run(p), KG_OK);
      double *seed = kg_program_seed(p, 0, 2);
      status = seed ? kg_program_backward(p, 2) : kg_program_error(p)->status;
    }
    assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
    kg_program_destroy(p);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(refusals > 6);
  kg_tape_destroy(t);
}

static void test_steady_state_allocates_nothing(void **state)
{
  (void)state;
  const double x[8] = {0.3, 0.8, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6};
  failing_heap heap = {1000, 0};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const formula f = record(t, x[0], x[1], x + 2);
  kg_program *p = freeze(&(kg_program_def){.lanes = 8, .allocator = &allocator}, t, &f);
  const int before = heap.calls_left;
  assert_int_equal(kg_program_run(p), KG_OK);
  assert_int_equal(heap.calls_left, before);
  assert_non_null(kg_program_seed(p, 1, 3));
  assert_non_null(kg_program_tangent(p, 1, 3));
  assert_int_equal(kg_program_backward(p, 3), KG_OK);
  heap.calls_left = 0;
  for (int round = 0; round < 3; ++round) {
    assert_int_equal(kg_program_run(p), KG_OK);
    assert_non_null(kg_program_seed(p, 1, 3));
    assert_int_equal(kg_program_backward(p, 3), KG_OK);
    assert_non_null(kg_program_tangent(p, 1, 3));
    assert_int_equal(kg_program_forward(p, 3), KG_OK);
  }
  kg_program_destroy(p);
  kg_tape_destroy(t);
}

/* Im f(x + i h d) / h against the tangents of the same program in real numbers */
static void test_complex_arithmetic(void **state)
{
  (void)state;
  const double x[8] = {0.3, 0.8, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6}, h = 1e-100;
  kg_tape *t;
  assert_int_equal(kg_tape_create(NULL, &t, NULL), KG_OK);
  const formula f = record(t, x[0], x[1], x + 2);
  kg_program *plain = freeze(NULL, t, &f);
  kg_program *analytic = freeze(&(kg_program_def){.lanes = 1, .arithmetic_complex = true}, t, &f);
  kg_random random = kg_random_make(4);
  for (int i = 0; i < 3; ++i) {
    double _Complex *z = kg_program_input(analytic, i);
    double *d = kg_program_tangent(plain, i, 1);
    for (size_t e = 0; e < kg_program_input_size(plain, i); ++e) {
      d[e] = kg_random_normal(&random);
      z[e] += CMPLX(0, h * d[e]);
    }
  }
  assert_int_equal(kg_program_run(plain), KG_OK);
  assert_int_equal(kg_program_run(analytic), KG_OK);
  assert_int_equal(kg_program_forward(plain, 1), KG_OK);
  for (int o = 0; o < 2; ++o) {
    const double _Complex *z = kg_program_output(analytic, o);
    const double *y = kg_program_output(plain, o), *tangent = kg_program_output_tangent(plain, o);
    for (size_t e = 0; e < kg_program_output_size(plain, o); ++e) {
      assert_close(creal(z[e]), y[e], 1e-15);
      assert_close(cimag(z[e]) / h, tangent[e], 1e-14);
    }
  }
  kg_program_destroy(plain);
  kg_program_destroy(analytic);
  kg_tape_destroy(t);
}

static void test_float(void **state)
{
  (void)state;
  enum { LANES = 4 };
  kg_tape_def def = kg_tape_default_def();
  def.precision = KG_FLOAT;
  kg_tape *t;
  assert_int_equal(kg_tape_create(&def, &t, NULL), KG_OK);
  const kg_value x = kg_scalar(t, 0.5), y = kg_mul(t, x, kg_sin(t, x));
  kg_program *p;
  assert_int_equal(kg_program_create(&(kg_program_def){.lanes = LANES}, t, 1, &x, 1, &y, &p, NULL),
                   KG_OK);
  kg_tape_destroy(t);
  float *in = kg_program_input(p, 0), *seed = kg_program_seed(p, 0, 1);
  for (int lane = 0; lane < LANES; ++lane) {
    assert_true(in[lane] == 0.5f);
    in[lane] = 0.25f * (float)lane;
    seed[lane] = 2;
  }
  assert_int_equal(kg_program_run(p), KG_OK);
  assert_int_equal(kg_program_backward(p, 1), KG_OK);
  for (int lane = 0; lane < LANES; ++lane) {
    const double a = in[lane];
    assert_close((double)((const float *)kg_program_output(p, 0))[lane], a * sin(a), 1e-7);
    const double slope = 2 * (sin(a) + a * cos(a));
    assert_close((double)((const float *)kg_program_adjoint(p, 0))[lane], slope, 1e-6);
  }
  kg_program_destroy(p);
}

static void lanes_are_counted_from_one(void **state)
{
  (void)state;
  kg_tape *tape;
  kg_program *program;
  kg_error error;
  assert_int_equal(kg_tape_create(NULL, &tape, NULL), KG_OK);
  const kg_value x = kg_scalar(tape, 2), y = kg_square(tape, x);
  for (int lanes = -1; lanes <= 0; ++lanes) {
    const kg_program_def def = {.lanes = lanes};
    assert_int_equal(kg_program_create(&def, tape, 1, &x, 1, &y, &program, &error), KG_ERR_SHAPE);
    assert_null(program);
    assert_non_null(strstr(error.text, "lanes"));
  }
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(test_replay_is_recording_bit_for_bit),
    cmocka_unit_test(test_lanes_are_independent),
    cmocka_unit_test(test_fate_of_every_value),
    cmocka_unit_test(test_forward_and_backward_agree),
    cmocka_unit_test(test_odd_ends),
    cmocka_unit_test(test_results_of_sweeps_that_were_not_made),
    cmocka_unit_test(test_seeds_stay_until_directions_change),
    cmocka_unit_test(test_stale_comparison),
    cmocka_unit_test(test_undefined_names_operator_and_tag),
    cmocka_unit_test(test_data_inputs),
    cmocka_unit_test(test_refused_values),
    cmocka_unit_test(test_memory_refused_anywhere),
    cmocka_unit_test(test_steady_state_allocates_nothing),
    cmocka_unit_test(test_complex_arithmetic),
    cmocka_unit_test(lanes_are_counted_from_one),
    cmocka_unit_test(test_float),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
