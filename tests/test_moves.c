/* Operators that move entries: values against index arithmetic written out, complex steps, lanes,
 * float tapes, every refused argument. */
#include "tape_support.h"

static kg_tape *new_tape(kg_precision precision, int simd)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = simd};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

/* an input of this shape whose entries are first, first + 1, ... */
static kg_value counting(kg_tape *tape, kg_shape shape, double first)
{
  const size_t n = kg_shape_size(&shape);
  double *x = malloc(n * sizeof *x);
  assert_non_null(x);
  for (size_t i = 0; i < n; ++i) {
    x[i] = first + (double)i;
  }
  const kg_value a = kg_input(tape, shape, x);
  free(x);
  return a;
}

/* the entry at these indices */
static double entry(const kg_tape *tape, kg_value a, const int *at)
{
  const kg_shape shape = kg_shape_of(tape, a);
  size_t index = 0;
  for (int i = 0; i < shape.rank; ++i) {
    assert_in_range(at[i], 0, shape.dim[i] - 1);
    index = index * (size_t)shape.dim[i] + (size_t)at[i];
  }
  return kg_item_at(tape, a, index);
}

/* the indices of entry number e */
static void indices(kg_shape shape, size_t e, int *at)
{
  for (int i = shape.rank - 1; i >= 0; --i) {
    at[i] = (int)(e % (size_t)shape.dim[i]);
    e /= (size_t)shape.dim[i];
  }
}

static void assert_shape(const kg_tape *tape, kg_value a, kg_shape shape)
{
  if (!a.id) fail_msg("%s", kg_tape_error(tape)->text);
  if (!kg_same_shape(kg_shape_of(tape, a), shape)) {
    fail_msg("shape %s, not %s", kg_shape_print(kg_shape_of(tape, a)).text,
             kg_shape_print(shape).text);
  }
}

/* derivatives and lanes of y, recorded from a alone */
static void check(kg_tape *tape, kg_value a, kg_value y)
{
  kg_random random = kg_random_make(7);
  check_operator(tape, 1, &a, y, &random, 1e-14);
  check_lanes(tape, y, &random);
  kg_tape_destroy(tape);
}

static void reshape_keeps_order_and_shares_numbers(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value a = counting(tape, KG_SHAPE(3, 8), 1), y = kg_reshape(tape, a, KG_SHAPE(2, 3, 4));
  assert_shape(tape, y, KG_SHAPE(2, 3, 4));
  assert_ptr_equal(kg_data(tape, a), kg_data(tape, y));
  check(tape, a, y);
  tape = new_tape(KG_DOUBLE, 3);
  const kg_value s = kg_scalar(tape, 5), v = kg_reshape(tape, s, KG_SHAPE(1, 1));
  for (int i = 0; i < 1000; ++i) { /* the scalar's node moves when the tape grows */
    kg_scalar(tape, 0);
  }
  assert_close(kg_item(tape, v), 5, 0);
  kg_random random = kg_random_make(6);
  check_operator(tape, 1, &s, v, &random, 1e-14);
  kg_tape_destroy(tape);
}

static void broadcast_repeats(void **state)
{
  (void)state;
  static const kg_shape shapes[][2] = {{{1, {4}}, {2, {3, 4}}},
                                       {{2, {3, 1}}, {2, {3, 5}}},
                                       {{0, {0}}, {3, {2, 2, 9}}},
                                       {{1, {1}}, {1, {1000}}},
                                       {{3, {2, 1, 3}}, {3, {2, 4, 3}}},
                                       {{2, {1, 3}}, {4, {2, 2, 5, 3}}},
                                       {{4, {2, 1, 3, 1}}, {4, {2, 3, 3, 2}}},
                                       {{1, {7}}, {1, {7}}}};
  for (size_t c = 0; c < KG_COUNT_OF(shapes); ++c) {
    const kg_shape from = shapes[c][0], to = shapes[c][1];
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const kg_value a = counting(tape, from, 1), y = kg_broadcast(tape, a, to);
    assert_shape(tape, y, to);
    for (size_t e = 0; e < kg_shape_size(&to); ++e) {
      int at[KG_MAX_RANK], own[KG_MAX_RANK];
      indices(to, e, at);
      for (int i = 0; i < from.rank; ++i) {
        own[i] = from.dim[i] == 1 ? 0 : at[i + to.rank - from.rank];
      }
      assert_close(kg_item_at(tape, y, e), entry(tape, a, own), 0);
    }
    check(tape, a, y);
  }
}

static void transpose_exchanges_any_two_axes(void **state)
{
  (void)state;
  static const kg_shape shapes[] = {
    {2, {3, 5}}, {2, {1, 4}}, {2, {37, 50}}, {3, {2, 3, 4}}, {4, {2, 3, 4, 5}}};
  for (size_t c = 0; c < KG_COUNT_OF(shapes); ++c) {
    for (int i = 0; i < shapes[c].rank; ++i) {
      for (int j = 0; j < shapes[c].rank; ++j) {
        kg_tape *tape = new_tape(KG_DOUBLE, 3);
        const kg_value a = counting(tape, shapes[c], 1);
        const kg_value y = kg_transpose(tape, a, i, j - shapes[c].rank);
        kg_shape shape = shapes[c];
        shape.dim[i] = shapes[c].dim[j];
        shape.dim[j] = shapes[c].dim[i];
        assert_shape(tape, y, shape);
        for (size_t e = 0; e < kg_shape_size(&shape); ++e) {
          int at[KG_MAX_RANK];
          indices(shape, e, at);
          const int swapped = at[i];
          at[i] = at[j];
          at[j] = swapped;
          assert_close(kg_item_at(tape, y, e), entry(tape, a, at), 0);
        }
        check(tape, a, y);
      }
    }
  }
}

static void slice_takes_a_window(void **state)
{
  (void)state;
  static const struct {
    int axis, start, count;
  } windows[] = {{0, 0, 1}, {0, 1, 2}, {1, 2, 2}, {1, 0, 4}, {2, 4, 1}, {-1, 1, 3}, {-3, 2, 1}};
  for (size_t c = 0; c < KG_COUNT_OF(windows); ++c) {
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    const int axis = (windows[c].axis + 3) % 3;
    kg_shape shape = KG_SHAPE(3, 4, 5);
    const kg_value a = counting(tape, shape, 1);
    const kg_value y = kg_slice(tape, a, windows[c].axis, windows[c].start, windows[c].count);
    shape.dim[axis] = windows[c].count;
    assert_shape(tape, y, shape);
    for (size_t e = 0; e < kg_shape_size(&shape); ++e) {
      int at[KG_MAX_RANK];
      indices(shape, e, at);
      at[axis] += windows[c].start;
      assert_close(kg_item_at(tape, y, e), entry(tape, a, at), 0);
    }
    check(tape, a, y);
  }
}

static void concat_joins_along_any_axis(void **state)
{
  (void)state;
  for (int axis = 0; axis < 3; ++axis) {
    static const int lengths[] = {2, 1, 4};
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    kg_value parts[4];
    for (int k = 0; k < 3; ++k) {
      kg_shape shape = KG_SHAPE(2, 3, 2);
      shape.dim[axis] = lengths[k];
      parts[k] = counting(tape, shape, 100 * k);
    }
    parts[3] = parts[1]; /* twice the same operand */
    const kg_value y = kg_concat(tape, axis - 3, 4, parts);
    kg_shape shape = KG_SHAPE(2, 3, 2);
    shape.dim[axis] = 8;
    assert_shape(tape, y, shape);
    for (size_t e = 0; e < kg_shape_size(&shape); ++e) {
      int at[KG_MAX_RANK], k = 0;
      indices(shape, e, at);
      for (; k < 3 && at[axis] >= lengths[k]; ++k) {
        at[axis] -= lengths[k];
      }
      assert_close(kg_item_at(tape, y, e), entry(tape, parts[k], at), 0);
    }
    kg_random random = kg_random_make(8);
    check_operator(tape, 3, parts, y, &random, 1e-14);
    check_operator(tape, 1, &parts[1], y, &random, 1e-14); /* no tangent for the others */
    check_lanes(tape, y, &random);
    kg_tape_destroy(tape);
  }
}

/* y = sum of w_i x_i, taken apart and put together */
static void scalars_become_a_vector_and_back(void **state)
{
  (void)state;
  for (int precision = KG_DOUBLE; precision <= KG_FLOAT; ++precision) {
    kg_tape *tape = new_tape((kg_precision)precision, 3);
    kg_value x[40], back[40];
    for (int i = 0; i < 40; ++i) {
      x[i] = kg_scalar(tape, i + 0.5);
    }
    x[7] = kg_reshape(tape, x[7], KG_SCALAR_SHAPE); /* of rank 0, but no scalar node */
    const kg_value v = kg_stack(tape, 40, x);
    assert_shape(tape, v, KG_SHAPE(40));
    for (int i = 0; i < 40; ++i) {
      back[i] = kg_element(tape, v, (size_t)(39 - i));
      assert_shape(tape, back[i], KG_SCALAR_SHAPE);
      assert_close(kg_item(tape, back[i]), 39 - i + 0.5, 0);
      assert_int_equal(kg_is_scalar_node(back[i]), precision == KG_DOUBLE);
    }
    assert_int_equal(kg_element(tape, back[3], 0).id == back[3].id, precision == KG_DOUBLE);
    const kg_value y = kg_mul(tape, back[3], kg_mul(tape, back[3], back[5])); /* x36^2 x34 */
    assert_int_equal(kg_backward(tape, y), KG_OK);
    assert_close(kg_adjoint_item(tape, x[36]), 2 * 36.5 * 34.5, 1e-14);
    assert_close(kg_adjoint_item(tape, x[34]), 36.5 * 36.5, 1e-14);
    assert_close(kg_adjoint_item(tape, x[7]), 0, 0);
    if (precision == KG_DOUBLE) {
      kg_random random = kg_random_make(9);
      check_operator(tape, 4, (kg_value[]){x[7], x[8], x[34], x[36]}, y, &random, 1e-13);
      check_operator(tape, 2, (kg_value[]){x[0], x[39]}, v, &random, 1e-14);
    }
    kg_tape_destroy(tape);
  }
}

static void element_of_a_tensor_in_lanes(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_FLOAT, 3);
  const kg_value y = kg_element(tape, counting(tape, KG_SHAPE(2, 3), 1), 4);
  const kg_block *block = kg_node_of(tape, y)->is.block;
  const float in[12] = {0, 0, 0, 0, 0, 0, 0, 0, 5, 6}, adjoint[2] = {7, 8};
  const float expected[12] = {0, 0, 0, 0, 0, 0, 0, 0, 7, 8};
  float out[2], in_adjoint[12] = {0};
  const kg_call call = {block->attributes, 1, 2, 1, (const void *[]){in}, out, NULL, NULL, 0};
  assert_int_equal(block->kernel->forward(&call), KG_OK);
  assert_memory_equal(out, in + 8, sizeof out);
  block->kernel->vjp(&call, adjoint, (void *[]){in_adjoint});
  assert_memory_equal(in_adjoint, expected, sizeof expected);
  kg_tape_destroy(tape);
}

static void gather_and_scatter_follow_their_indices(void **state)
{
  (void)state;
  static const int32_t index[] = {2, -1, 0, 2, 3, -1, 2};
  enum { COUNT = KG_COUNT_OF(index) };
  for (int axis = 0; axis < 3; ++axis) {
    kg_tape *tape = new_tape(KG_DOUBLE, 3);
    kg_shape shape = KG_SHAPE(3, 2, 3);
    shape.dim[axis] = 4;
    kg_value a = counting(tape, shape, 1), y = kg_gather(tape, a, axis, COUNT, index);
    shape.dim[axis] = COUNT;
    assert_shape(tape, y, shape);
    for (size_t e = 0; e < kg_shape_size(&shape); ++e) {
      int at[KG_MAX_RANK];
      indices(shape, e, at);
      at[axis] = index[at[axis]];
      assert_close(kg_item_at(tape, y, e), at[axis] < 0 ? 0 : entry(tape, a, at), 0);
    }
    check(tape, a, y);

    tape = new_tape(KG_DOUBLE, 3);
    a = counting(tape, shape, 1);
    y = kg_scatter(tape, a, axis - 3, 5, index);
    shape.dim[axis] = 5;
    assert_shape(tape, y, shape);
    for (size_t e = 0; e < kg_shape_size(&shape); ++e) {
      int at[KG_MAX_RANK];
      indices(shape, e, at);
      const int target = at[axis];
      double sum = 0;
      for (at[axis] = 0; at[axis] < COUNT; ++at[axis]) {
        sum += index[at[axis]] == target ? entry(tape, a, at) : 0;
      }
      assert_close(kg_item_at(tape, y, e), sum, 0);
    }
    check(tape, a, y);
  }
}

/* the callers' index array is not needed after recording */
static void indices_are_copied(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  int32_t index[3] = {1, 1, 0};
  const kg_value a = counting(tape, KG_SHAPE(2), 1), y = kg_gather(tape, a, 0, 3, index);
  index[0] = index[1] = index[2] = 1000000;
  assert_int_equal(kg_backward(tape, y), KG_OK);
  assert_close(kg_adjoint(tape, a)[0], 1, 0);
  assert_close(kg_adjoint(tape, a)[1], 2, 0);
  kg_tape_destroy(tape);
}

/* float and every instruction set: moves are exact, so all agree in every bit */
static void precisions_and_instructions_agree(void **state)
{
  (void)state;
  static const int32_t index[] = {4, -1, 0, 0, 3, 4, 2, 1};
  double values[5][4 * 5 * 8], gradients[5][5 * 33];
  for (int c = 0; c < 5; ++c) {
    static const int simd[] = {0, 2, 3, 0, 3};
    kg_tape *tape = new_tape(c < 3 ? KG_DOUBLE : KG_FLOAT, simd[c]);
    const kg_value a = counting(tape, KG_SHAPE(5, 33), 1);
    kg_value y = kg_transpose(tape, kg_slice(tape, a, 1, 3, 5), 0, 1);
    y = kg_concat(tape, 0, 2,
                  (kg_value[]){y, kg_scatter(tape, y, 0, 3, (int32_t[]){2, 0, -1, 1, 2})});
    y = kg_gather(tape, y, 1, KG_COUNT_OF(index), index);
    y = kg_add(tape, y, kg_broadcast(tape, kg_slice(tape, y, 0, 0, 1), KG_SHAPE(8, 8)));
    assert_shape(tape, y, KG_SHAPE(8, 8));
    double seed[64];
    for (int i = 0; i < 64; ++i) {
      values[c][i] = kg_item_at(tape, y, (size_t)i);
      seed[i] = i % 7 - 3;
    }
    assert_int_equal(
      kg_vjp(tape, 1, 1, &y, (const double *[]){seed}, 1, &a, (double *[]){gradients[c]}), KG_OK);
    assert_memory_equal(values[c], values[0], 64 * sizeof(double));
    assert_memory_equal(gradients[c], gradients[0], sizeof gradients[0]);
    kg_tape_destroy(tape);
  }
}

/* Each call must fail with KG_ERR_SHAPE, and the text must hold this. */
#define REFUSED(call, words)                                                                       \
  do {                                                                                             \
    assert_true(kg_is_null(call));                                                                 \
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);                                          \
    if (!strstr(kg_tape_error(tape)->text, words)) fail_msg("%s", kg_tape_error(tape)->text);      \
    kg_tape_rewind(tape, mark);                                                                    \
  } while (0)

static void what_does_not_fit_is_refused_in_words(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE, 3);
  const kg_value s = kg_scalar(tape, 1), a = counting(tape, KG_SHAPE(3, 4), 1);
  const kg_value b = counting(tape, KG_SHAPE(3), 1), null = {0};
  const kg_tape_mark mark = kg_tape_mark_of(tape);
  REFUSED(kg_reshape(tape, a, KG_SHAPE(5, 2)), "reshape: (3, 4) has 12 entries, (5, 2) has 10");
  REFUSED(kg_reshape(tape, a, ((kg_shape){5, {12}})), "reshape: shape (12, 0, 0, 0) of rank 5");
  REFUSED(kg_reshape(tape, a, KG_SHAPE(-3, -4)), "reshape: shape (-3, -4)");
  REFUSED(kg_broadcast(tape, a, KG_SHAPE(4, 3)), "broadcast: (3, 4) to (4, 3)");
  REFUSED(kg_broadcast(tape, a, KG_SHAPE(4)), "broadcast: (3, 4) to (4)");
  REFUSED(kg_broadcast(tape, b, KG_SHAPE(0, 3)), "broadcast: shape (0, 3)");
  REFUSED(kg_transpose(tape, a, 0, 2), "transpose: axis 2 of a tensor of shape (3, 4)");
  REFUSED(kg_transpose(tape, a, -3, 1), "transpose: axis -3");
  REFUSED(kg_slice(tape, a, 1, 2, 3), "slice: 3 entries from 2 of axis 1 of shape (3, 4)");
  REFUSED(kg_slice(tape, a, 1, -1, 2), "slice: 2 entries from -1");
  REFUSED(kg_slice(tape, a, 1, 0, 0), "slice: 0 entries");
  REFUSED(kg_slice(tape, a, 1, INT32_MAX, INT32_MAX), "slice: 2147483647 entries");
  REFUSED(kg_slice(tape, s, 0, 0, 1), "slice: axis 0 of a tensor of shape ()");
  REFUSED(kg_concat(tape, 0, 2, ((kg_value[]){a, b})), "concat: part 1 of shape (3) after (3, 4)");
  REFUSED(kg_concat(tape, 0, 2, ((kg_value[]){b, a})), "concat: part 1 of shape (3, 4) after (3)");
  REFUSED(kg_concat(tape, 2, 1, &a), "concat: axis 2");
  REFUSED(kg_concat(tape, 0, 0, NULL), "concat: 0 parts");
  REFUSED(kg_stack(tape, 0, NULL), "stack: 0 scalars");
  REFUSED(kg_stack(tape, 2, ((kg_value[]){s, b})), "stack: entry 1 of shape (3)");
  REFUSED(kg_element(tape, a, 12), "element: entry 12 of shape (3, 4)");
  REFUSED(kg_element(tape, s, 1), "element: entry 1 of shape ()");
  REFUSED(kg_gather(tape, a, 1, 3, ((int32_t[]){0, 4, 1})),
          "gather: index[1] = 4 for an axis of extent 4");
  REFUSED(kg_gather(tape, a, 0, 2, ((int32_t[]){0, -2})),
          "gather: index[1] = -2 for an axis of extent 3");
  REFUSED(kg_gather(tape, a, 0, 0, NULL), "gather: shape (0, 4)");
  REFUSED(kg_scatter(tape, a, 0, 2, ((int32_t[]){0, 1, 2})),
          "scatter: index[2] = 2 for an axis of extent 2");
  REFUSED(kg_scatter(tape, b, 0, -1, ((int32_t[]){0, 0, 0})), "scatter: shape (-1)");
  kg_tape_tag(tape, "knee");
  REFUSED(kg_gather(tape, a, -1, 1, ((int32_t[]){9})), "gather [knee]: index[0] = 9");
  assert_true(kg_is_null(kg_concat(tape, 0, 2, (kg_value[]){a, null})));
  assert_int_equal(kg_tape_status(tape), KG_ERR_UNDEFINED);
  kg_tape_destroy(tape);
}

/* memory refused at any allocation is a status, and a rewound tape takes none */
static void memory(void **state)
{
  (void)state;
  static int32_t index[3000];
  kg_status status = KG_ERR_NO_MEMORY;
  for (int allowed = 0; status != KG_OK; ++allowed) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_tape *tape;
    if ((status = kg_tape_create(&(kg_tape_def){.allocator = &allocator}, &tape, NULL)) != KG_OK) {
      continue;
    }
    for (int round = 0; round < 3 && status == KG_OK; ++round) {
      const kg_value a = counting(tape, KG_SHAPE(10, 10), 1), s = kg_scalar(tape, 1);
      kg_value y = kg_gather(tape, a, 0, KG_COUNT_OF(index), index);
      y = kg_concat(tape, 0, 2, (kg_value[]){y, a});
      const kg_value e[2] = {kg_element(tape, y, 77), s};
      kg_backward(tape, kg_stack(tape, 2, e));
      status = kg_tape_status(tape);
      assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
      if (status == KG_OK) heap.calls_left = 0;
      kg_tape_rewind(tape, (kg_tape_mark){0});
    }
    kg_tape_destroy(tape);
    assert_int_equal(heap.live_bytes, 0);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(reshape_keeps_order_and_shares_numbers),
    cmocka_unit_test(broadcast_repeats),
    cmocka_unit_test(transpose_exchanges_any_two_axes),
    cmocka_unit_test(slice_takes_a_window),
    cmocka_unit_test(concat_joins_along_any_axis),
    cmocka_unit_test(scalars_become_a_vector_and_back),
    cmocka_unit_test(element_of_a_tensor_in_lanes),
    cmocka_unit_test(gather_and_scatter_follow_their_indices),
    cmocka_unit_test(indices_are_copied),
    cmocka_unit_test(precisions_and_instructions_agree),
    cmocka_unit_test(what_does_not_fit_is_refused_in_words),
    cmocka_unit_test(memory),
  };
  return cmocka_run_group_tests_name("moves", tests, NULL, NULL);
}
