/* Matrix operators: values against plain loops, derivatives against complex steps. */
#include "tape_support.h"

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape *tape;
  const kg_tape_def def = {.precision = precision, .simd = 3};
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static kg_value random_input(kg_tape *tape, kg_shape shape, kg_random *random)
{
  double *x = random_numbers(random, kg_shape_size(&shape));
  const kg_value value = kg_input(tape, shape, x);
  free(x);
  return value;
}

/* entry (i, j) of matrix number `batch`, transposed if asked; rank 2 serves every batch */
static double at(const kg_tape *tape, kg_value a, size_t batch, size_t i, size_t j, bool transposed)
{
  const kg_shape shape = kg_shape_of(tape, a);
  const size_t rows = (size_t)shape.dim[shape.rank - 2],
               columns = (size_t)shape.dim[shape.rank - 1];
  const size_t start = shape.rank > 2 ? batch * rows * columns : 0;
  return kg_item_at(tape, a, start + (transposed ? j * columns + i : i * columns + j));
}

static size_t extent(const kg_tape *tape, kg_value a, int from_last)
{
  const kg_shape shape = kg_shape_of(tape, a);
  return (size_t)shape.dim[shape.rank - from_last];
}

/* y = op(a) op(b), to tolerance of the sum of absolute products */
static void check_product(const kg_tape *tape, kg_value a, kg_value b, int flags, kg_value y,
                          double tolerance)
{
  const bool ta = flags & KG_TRANSPOSE_A, tb = flags & KG_TRANSPOSE_B;
  const size_t m = extent(tape, y, 2), n = extent(tape, y, 1), k = extent(tape, b, tb ? 1 : 2);
  for (size_t e = 0; e < kg_size_of(tape, y); ++e) {
    const size_t batch = e / (m * n), i = e / n % m, j = e % n;
    double sum = 0, size = 0;
    for (size_t p = 0; p < k; ++p) {
      const double term = at(tape, a, batch, i, p, ta) * at(tape, b, batch, p, j, tb);
      sum += term;
      size += fabs(term);
    }
    assert_at_most(fabs(kg_item_at(tape, y, e) - sum), tolerance * size);
  }
}

static const struct product_case {
  kg_shape a, b;
  int flags;
} products[] = {{{2, {3, 4}}, {2, {4, 5}}, 0},
                {{2, {4, 3}}, {2, {4, 5}}, KG_TRANSPOSE_A},
                {{2, {3, 4}}, {2, {5, 4}}, KG_TRANSPOSE_B},
                {{2, {4, 3}}, {2, {5, 4}}, KG_TRANSPOSE_A | KG_TRANSPOSE_B},
                {{3, {2, 3, 4}}, {3, {2, 4, 5}}, 0},
                {{4, {2, 3, 4, 2}}, {4, {2, 3, 5, 2}}, KG_TRANSPOSE_B},
                {{3, {2, 3, 4}}, {2, {4, 5}}, 0},
                {{3, {2, 3, 4}}, {2, {5, 4}}, KG_TRANSPOSE_B},
                {{3, {2, 4, 3}}, {2, {4, 5}}, KG_TRANSPOSE_A},
                {{2, {3, 4}}, {3, {2, 4, 5}}, 0},
                {{2, {4, 3}}, {3, {2, 5, 4}}, KG_TRANSPOSE_A | KG_TRANSPOSE_B},
                {{2, {1, 1}}, {2, {1, 1}}, 0},
                {{2, {1, 30}}, {2, {30, 1}}, 0},
                {{2, {33, 20}}, {2, {20, 17}}, 0},
                {{3, {4, 50, 6}}, {2, {6, 5}}, 0}, /* many rows: in blocks */
                {{3, {1, 128, 6}}, {3, {1, 5, 6}}, KG_TRANSPOSE_B},
                {{2, {101, 6}}, {2, {6, 5}}, 0}, /* which 101 does not divide into */
                {{2, {6, 128}}, {2, {6, 5}}, KG_TRANSPOSE_A}};

static void products_are_sums_of_products(void **state)
{
  (void)state;
  kg_random random = kg_random_make(1);
  for (size_t c = 0; c < KG_COUNT_OF(products); ++c) {
    for (int precision = 0; precision < 2; ++precision) {
      kg_tape *tape = new_tape(precision ? KG_FLOAT : KG_DOUBLE);
      const kg_value v[2] = {random_input(tape, products[c].a, &random),
                             random_input(tape, products[c].b, &random)};
      const kg_value y = kg_matmul(tape, v[0], v[1], products[c].flags);
      assert_false(kg_is_null(y));
      check_product(tape, v[0], v[1], products[c].flags, y, precision ? 1e-6 : 1e-15);
      if (!precision) {
        check_operator(tape, 2, v, y, &random, 1e-13);
        check_lanes(tape, y, &random);
      }
      kg_tape_destroy(tape);
    }
  }
}

static void affine_adds_the_bias_to_every_row(void **state)
{
  (void)state;
  static const kg_shape shapes[] = {{1, {6}}, {2, {5, 6}}, {3, {2, 3, 6}}, {2, {192, 6}}};
  kg_random random = kg_random_make(2);
  for (size_t c = 0; c < KG_COUNT_OF(shapes); ++c) {
    for (int biased = 0; biased < 2; ++biased) {
      kg_tape *tape = new_tape(KG_DOUBLE);
      const kg_value v[3] = {random_input(tape, shapes[c], &random),
                             random_input(tape, KG_SHAPE(6, 4), &random),
                             random_input(tape, KG_SHAPE(4), &random)};
      const kg_value bias = biased ? v[2] : (kg_value){0};
      const kg_value y = kg_affine(tape, v[0], v[1], bias);
      assert_false(kg_is_null(y));
      assert_int_equal(kg_shape_of(tape, y).rank, shapes[c].rank);
      for (size_t e = 0; e < kg_size_of(tape, y); ++e) {
        double sum = biased ? kg_item_at(tape, bias, e % 4) : 0;
        for (size_t p = 0; p < 6; ++p) {
          sum += kg_item_at(tape, v[0], e / 4 * 6 + p) * kg_item_at(tape, v[1], p * 4 + e % 4);
        }
        assert_close(kg_item_at(tape, y, e), sum, 1e-14);
      }
      check_operator(tape, biased ? 3 : 2, v, y, &random, 1e-13);
      check_lanes(tape, y, &random);
      kg_tape_destroy(tape);
    }
  }
}

/* a product of a constant spends nothing on it, and the other operand's adjoint is the same */
static void constants_receive_no_adjoint(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  for (int which = 0; which < 2; ++which) {
    kg_tape *tape = new_tape(KG_DOUBLE);
    double *x[2] = {random_numbers(&random, 12), random_numbers(&random, 20)};
    const kg_shape shapes[2] = {KG_SHAPE(3, 4), KG_SHAPE(4, 5)};
    kg_value v[2];
    for (int k = 0; k < 2; ++k) {
      v[k] = k == which ? kg_constant(tape, shapes[k], x[k]) : kg_input(tape, shapes[k], x[k]);
      free(x[k]);
    }
    const kg_value y = kg_matmul(tape, v[0], v[1], 0);
    check_operator(tape, 1, &v[1 - which], y, &random, 1e-13);
    assert_null(kg_adjoint(tape, v[which]));
    kg_tape_destroy(tape);
  }
}

static const struct solve_case {
  kg_shape a, b;
  int flags;
  bool triangular;
} solves[] = {{{2, {1, 1}}, {2, {1, 1}}, 0, false},
              {{2, {4, 4}}, {2, {4, 1}}, 0, false},
              {{2, {4, 4}}, {2, {4, 3}}, KG_TRANSPOSE_A, false},
              {{3, {3, 5, 5}}, {3, {3, 5, 2}}, 0, false},
              {{4, {2, 2, 3, 3}}, {4, {2, 2, 3, 4}}, KG_TRANSPOSE_A, false},
              {{2, {1, 1}}, {2, {1, 2}}, KG_UNIT, true},
              {{2, {4, 4}}, {2, {4, 3}}, 0, true},
              {{2, {4, 4}}, {2, {4, 3}}, KG_UPPER, true},
              {{2, {4, 4}}, {2, {4, 3}}, KG_TRANSPOSE_A, true},
              {{2, {4, 4}}, {2, {4, 3}}, KG_TRANSPOSE_A | KG_UPPER, true},
              {{3, {2, 5, 5}}, {3, {2, 5, 2}}, KG_UNIT, true},
              {{3, {2, 5, 5}}, {3, {2, 5, 2}}, KG_UNIT | KG_UPPER, true},
              {{2, {5, 5}}, {2, {5, 1}}, KG_UNIT | KG_UPPER | KG_TRANSPOSE_A, true}};

/* random matrices whose first row, without an exchange, would be a bad pivot; as triangles their
 * diagonal is far from zero and what must not be read is NaN */
static kg_value random_matrices(kg_tape *tape, const struct solve_case *c, kg_random *random)
{
  const size_t size = kg_shape_size(&c->a), n = (size_t)c->a.dim[c->a.rank - 1];
  double *x = random_numbers(random, size);
  for (size_t e = 0; e < size; ++e) {
    const size_t i = e / n % n, j = e % n;
    if (!c->triangular) {
      x[e] = i == 0 && j == 0 && n > 1 ? 1e-9 : x[e] + ((i + 1) % n == j ? 4 : 0);
    } else if (i == j) {
      x[e] = c->flags & KG_UNIT ? NAN : 2 + fabs(x[e]);
    } else if ((j > i) != ((c->flags & KG_UPPER) != 0)) {
      x[e] = NAN;
    }
  }
  const kg_value a = kg_input(tape, c->a, x);
  free(x);
  return a;
}

/* entry (i, j) of the matrix that is meant */
static double meant(const kg_tape *tape, const struct solve_case *c, kg_value a, size_t batch,
                    size_t i, size_t j)
{
  const bool transposed = c->flags & KG_TRANSPOSE_A;
  const size_t row = transposed ? j : i, column = transposed ? i : j;
  if (c->triangular && row == column && c->flags & KG_UNIT) return 1;
  if (c->triangular && row != column && (column > row) != ((c->flags & KG_UPPER) != 0)) return 0;
  return at(tape, a, batch, row, column, false);
}

static void solutions_satisfy_their_equations(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  for (size_t k = 0; k < KG_COUNT_OF(solves) * 2; ++k) {
    const struct solve_case *c = &solves[k / 2];
    const double tolerance = k % 2 ? 2e-5 : 1e-13;
    kg_tape *tape = new_tape(k % 2 ? KG_FLOAT : KG_DOUBLE);
    const kg_value v[2] = {random_matrices(tape, c, &random), random_input(tape, c->b, &random)};
    const kg_value x = c->triangular ? kg_solve_triangular(tape, v[0], v[1], c->flags)
                                     : kg_solve(tape, v[0], v[1], c->flags);
    assert_false(kg_is_null(x));
    const size_t n = extent(tape, x, 2), m = extent(tape, x, 1);
    for (size_t e = 0; e < kg_size_of(tape, x); ++e) {
      double sum = 0;
      for (size_t j = 0; j < n; ++j) {
        sum += meant(tape, c, v[0], e / (n * m), e / m % n, j) *
               at(tape, x, e / (n * m), j, e % m, false);
      }
      assert_close(sum, kg_item_at(tape, v[1], e), tolerance);
    }
    if (k % 2 == 0) {
      check_operator(tape, 2, v, x, &random, 1e-12);
      check_lanes(tape, x, &random);
    }
    kg_tape_destroy(tape);
  }
}

static void matrices_without_inverse_have_no_solution(void **state)
{
  (void)state;
  static const struct {
    double a[4];
    int flags; /* negative: a full matrix */
    kg_status status;
  } cases[] = {{{1, 2, 2, 4}, -1, KG_ERR_UNDEFINED},
               {{0, 0, 0, 0}, -1, KG_ERR_UNDEFINED},
               {{0, 1, 1, 0}, -1, KG_OK},
               {{NAN, 1, 1, 0}, -1, KG_ERR_UNDEFINED},
               {{INFINITY, 1, 1, 2}, -1, KG_ERR_UNDEFINED},
               {{1, 0, 3, 0}, 0, KG_ERR_UNDEFINED},
               {{INFINITY, 0, 3, 1}, 0, KG_ERR_UNDEFINED},
               {{1, 0, 3, 0}, KG_UNIT, KG_OK},
               {{0, NAN, 3, NAN}, KG_UNIT, KG_OK}};
  for (int precision = 0; precision < 2; ++precision) {
    kg_tape *tape = new_tape(precision ? KG_FLOAT : KG_DOUBLE);
    for (size_t c = 0; c < KG_COUNT_OF(cases); ++c) {
      const kg_value a = kg_input(tape, KG_SHAPE(2, 2), cases[c].a);
      const kg_value b = kg_input(tape, KG_SHAPE(2, 1), (double[]){1, 2});
      const bool full = cases[c].flags < 0;
      const kg_value x =
        full ? kg_solve(tape, a, b, 0) : kg_solve_triangular(tape, a, b, cases[c].flags);
      assert_int_equal(kg_tape_status(tape), cases[c].status);
      assert_int_equal(kg_is_null(x), cases[c].status != KG_OK);
      if (kg_is_null(x)) {
        const char *name = full ? "solve: " : "solve_triangular: ";
        assert_memory_equal(kg_tape_error(tape)->text, name, strlen(name));
      }
      kg_tape_rewind(tape, (kg_tape_mark){0});
    }
    kg_tape_destroy(tape);
  }
}

/* seven directions in one sweep are seven sweeps: what a solve keeps is not used up */
static void directions_of_a_sweep_are_independent(void **state)
{
  (void)state;
  enum { DIRECTIONS = 7, N = 4, M = 3 };
  kg_random random = kg_random_make(5);
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_value v[2] = {random_matrices(tape, &solves[2], &random),
                         random_input(tape, solves[2].b, &random)};
  const kg_value x = kg_solve(tape, v[0], v[1], KG_TRANSPOSE_A);
  double *seeds = random_numbers(&random, DIRECTIONS * N * M);
  double a[DIRECTIONS][N * N], b[DIRECTIONS][N * M], a1[N * N], b1[N * M];
  const double *const all = seeds;
  assert_int_equal(
    kg_vjp(tape, DIRECTIONS, 1, &x, &all, 2, v, (double *const[]){&a[0][0], &b[0][0]}), KG_OK);
  for (size_t d = 0; d < DIRECTIONS; ++d) {
    const double *const one = seeds + d * N * M;
    assert_int_equal(kg_vjp(tape, 1, 1, &x, &one, 2, v, (double *const[]){a1, b1}), KG_OK);
    assert_memory_equal(a[d], a1, sizeof a1);
    assert_memory_equal(b[d], b1, sizeof b1);
  }
  free(seeds);
  kg_tape_destroy(tape);
}

/* what an operand used several times receives adds up */
static void adjoints_of_shared_operands_add_up(void **state)
{
  (void)state;
  kg_random random = kg_random_make(6);
  for (int flags = 0; flags <= (KG_TRANSPOSE_A | KG_TRANSPOSE_B); ++flags) {
    kg_tape *tape = new_tape(KG_DOUBLE);
    const struct solve_case square = {{2, {3, 3}}, {2, {3, 3}}, 0, false};
    const kg_value v[3] = {random_matrices(tape, &square, &random),
                           random_input(tape, square.b, &random),
                           random_input(tape, KG_SHAPE(3), &random)};
    const kg_value product = kg_matmul(tape, kg_matmul(tape, v[0], v[1], flags), v[0], flags);
    check_operator(tape, 2, v, kg_add(tape, product, v[1]), &random, 1e-12);
    const kg_value layer = kg_affine(tape, kg_affine(tape, v[0], v[1], v[2]), v[1], v[2]);
    check_operator(tape, 3, v, kg_add(tape, layer, kg_mul(tape, v[0], v[2])), &random, 1e-12);
    const int half = flags & KG_TRANSPOSE_A;
    const kg_value x = kg_solve(tape, v[0], kg_solve(tape, v[0], v[1], half), half);
    check_operator(tape, 2, v, kg_add(tape, x, v[1]), &random, 1e-11);
    kg_tape_destroy(tape);
  }
}

static void shapes_that_do_not_fit_are_named(void **state)
{
  (void)state;
  kg_tape *tape = new_tape(KG_DOUBLE);
  const kg_tape_mark empty = {0};
  static const struct {
    kg_shape a, b;
    int flags;
    const char *text;
  } wrong[] = {
    {{2, {3, 4}},
     {2, {5, 4}},
     0,
     "matmul: shapes (3, 4) and (5, 4): rows of the second must be 4, not 5"},
    {{2, {3, 4}},
     {2, {4, 5}},
     KG_TRANSPOSE_A,
     "matmul: shapes (3, 4) transposed and (4, 5): rows of the second must be 3, "
     "not 4"},
    {{1, {4}}, {2, {4, 5}}, 0, "matmul: shapes (4) and (4, 5): each needs two axes at least"},
    {{3, {2, 3, 4}},
     {3, {3, 4, 5}},
     0,
     "matmul: shapes (2, 3, 4) and (3, 4, 5): axes before the last two must be equal, or one be "
     "a single matrix"}};
  for (size_t c = 0; c < KG_COUNT_OF(wrong); ++c) {
    const kg_value a = kg_input(tape, wrong[c].a, NULL), b = kg_input(tape, wrong[c].b, NULL);
    assert_true(kg_is_null(kg_matmul(tape, a, b, wrong[c].flags)));
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
    assert_string_equal(kg_tape_error(tape)->text, wrong[c].text);
    kg_tape_rewind(tape, empty);
  }
  const kg_value x = kg_input(tape, KG_SHAPE(2, 6), NULL), w = kg_input(tape, KG_SHAPE(6, 4), NULL);
  const kg_value bias = kg_input(tape, KG_SHAPE(6), NULL);
  assert_true(kg_is_null(kg_affine(tape, x, w, bias)));
  assert_string_equal(kg_tape_error(tape)->text,
                      "affine: x (2, 6), weight (6, 4), bias (6): (..., k), (k, n) and (n) fit");
  kg_tape_rewind(tape, empty);
  static const kg_shape systems[][2] = {{{2, {3, 4}}, {2, {3, 1}}},
                                        {{2, {3, 3}}, {2, {4, 1}}},
                                        {{3, {2, 3, 3}}, {2, {3, 1}}},
                                        {{2, {3, 3}}, {1, {3}}}};
  for (size_t c = 0; c < KG_COUNT_OF(systems); ++c) {
    const kg_value a = kg_input(tape, systems[c][0], NULL), b = kg_input(tape, systems[c][1], NULL);
    assert_true(kg_is_null(kg_solve(tape, a, b, 0)));
    assert_int_equal(kg_tape_status(tape), KG_ERR_SHAPE);
    if (c == 0) {
      assert_string_equal(kg_tape_error(tape)->text,
                          "solve: shapes (3, 4) and (3, 1): (..., n, n) and (..., n, m) fit, equal "
                          "before that");
    }
    kg_tape_rewind(tape, empty);
  }
  kg_tape_destroy(tape);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(products_are_sums_of_products),
    cmocka_unit_test(affine_adds_the_bias_to_every_row),
    cmocka_unit_test(constants_receive_no_adjoint),
    cmocka_unit_test(solutions_satisfy_their_equations),
    cmocka_unit_test(matrices_without_inverse_have_no_solution),
    cmocka_unit_test(directions_of_a_sweep_are_independent),
    cmocka_unit_test(adjoints_of_shared_operands_add_up),
    cmocka_unit_test(shapes_that_do_not_fit_are_named),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
