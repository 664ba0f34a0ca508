/* Jacobians and products with the Hessian against closed forms; colourings against what they are. */
#include "kinegrad/derivatives.h"
#include "support.h"

static kg_tape *new_tape(kg_precision precision)
{
  kg_tape_def def = kg_tape_default_def();
  def.precision = precision;
  kg_tape *tape;
  assert_int_equal(kg_tape_create(&def, &tape, NULL), KG_OK);
  return tape;
}

static void fill(double *x, int n, uint64_t seed)
{
  kg_random random = kg_random_make(seed);
  for (int i = 0; i < n; ++i) {
    x[i] = kg_random_normal(&random);
  }
}

/* -- dense ------------------------------------------------------------------------------------- */

/* y = A sin x: J = A diag(cos x) */
static void check_dense(kg_precision precision, int m, int n, double tolerance)
{
  kg_tape *t = new_tape(precision);
  double A[40 * 40], x[40], J[40 * 40];
  fill(A, m * n, 1);
  fill(x, n, 2);
  const kg_value in = kg_input(t, KG_SHAPE(n, 1), x);
  const kg_value y = kg_matmul(t, kg_constant(t, KG_SHAPE(m, n), A), kg_sin(t, in), 0);
  for (int round = 0; round < 2; ++round) {
    memset(J, 0xff, sizeof J);
    assert_int_equal(kg_jacobian(t, y, in, J), KG_OK);
    for (int i = 0; i < m; ++i) {
      for (int j = 0; j < n; ++j) {
        assert_close(J[i * n + j], A[i * n + j] * cos(x[j]), tolerance);
      }
    }
  }
  kg_tape_destroy(t);
}

static void test_dense(void **state)
{
  (void)state;
  check_dense(KG_DOUBLE, 3, 5, 1e-15);   /* backward, one sweep      */
  check_dense(KG_DOUBLE, 5, 3, 1e-15);   /* forward                  */
  check_dense(KG_DOUBLE, 33, 40, 1e-15); /* backward, in three parts */
  check_dense(KG_DOUBLE, 40, 33, 1e-15); /* forward, in three parts  */
  check_dense(KG_DOUBLE, 1, 1, 1e-15);
  check_dense(KG_FLOAT, 17, 20, 1e-6);
  check_dense(KG_FLOAT, 20, 17, 1e-6);
}

static void test_scalars_and_independent_values(void **state)
{
  (void)state;
  kg_tape *t = new_tape(KG_DOUBLE);
  double J[3];
  const kg_value x = kg_scalar(t, 2), other = kg_input(t, KG_SHAPE(3), NULL);
  assert_int_equal(kg_jacobian(t, kg_power(t, x, 3), x, J), KG_OK);
  assert_true(J[0] == 12);
  memset(J, 0xff, sizeof J);
  assert_int_equal(kg_jacobian(t, kg_square(t, x), other, J), KG_OK); /* does not depend on it */
  assert_true(J[0] == 0 && J[1] == 0 && J[2] == 0);
  const kg_value constant = kg_constant_scalar(t, 1);
  memset(J, 0xff, sizeof J);
  assert_int_equal(kg_jacobian(t, constant, other, J), KG_OK);
  assert_true(J[0] == 0 && J[1] == 0 && J[2] == 0);
  assert_int_equal(kg_jacobian(t, x, constant, J), KG_ERR_UNDEFINED);
  assert_non_null(strstr(kg_tape_error(t)->text, "jacobian"));
  kg_tape_destroy(t);
}

/* -- colouring --------------------------------------------------------------------------------- */

enum { MOST = 64 };

typedef struct pattern {
  int32_t start[MOST + 1], column[MOST * MOST];
  kg_sparse sparse;
} pattern;

static void begin_pattern(pattern *p, int columns)
{
  p->start[0] = 0;
  p->sparse = (kg_sparse){0, columns, p->start, p->column, NULL};
}

static void add_entry(pattern *p, int column)
{
  p->column[p->start[p->sparse.rows]++] = column;
}

static void begin_row(pattern *p)
{
  p->start[p->sparse.rows + 1] = p->start[p->sparse.rows];
  ++p->sparse.rows;
}

/* row i: columns i - 1, i, i + 1 within bounds */
static void tridiagonal(pattern *p, int n)
{
  begin_pattern(p, n);
  for (int i = 0; i < n; ++i) {
    begin_row(p);
    for (int j = i - 1; j <= i + 1; ++j) {
      if (j >= 0 && j < n) add_entry(p, j);
    }
  }
}

/* no colour twice in a row; every colour in use; returns the longest row */
static int check_colouring(const kg_sparse *s, const int32_t *colour, int colours)
{
  bool used[MOST] = {false};
  int longest = 0;
  for (int r = 0; r < s->rows; ++r) {
    bool taken[MOST] = {false};
    for (int k = s->start[r]; k < s->start[r + 1]; ++k) {
      const int c = colour[s->column[k]];
      assert_true(c >= 0 && c < colours && !taken[c]);
      taken[c] = true;
    }
    longest = s->start[r + 1] - s->start[r] > longest ? s->start[r + 1] - s->start[r] : longest;
  }
  for (int j = 0; j < s->columns; ++j) {
    used[colour[j]] = true;
  }
  for (int c = 0; c < colours; ++c) {
    assert_true(used[c]);
  }
  return longest;
}

static void test_colouring(void **state)
{
  (void)state;
  static pattern p;
  int32_t colour[MOST];
  int colours;
  tridiagonal(&p, 50);
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
  assert_int_equal(colours, 3);
  check_colouring(&p.sparse, colour, colours);
  kg_random random = kg_random_make(5);
  for (int trial = 0; trial < 200; ++trial) {
    const int n = 1 + (int)(kg_random_bits(&random) % MOST);
    begin_pattern(&p, n);
    for (int r = 0; r < 1 + trial % MOST; ++r) {
      begin_row(&p);
      for (int j = 0; j < n; ++j) {
        if (kg_random_uniform(&random) < 0.1) add_entry(&p, j);
      }
    }
    assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
    assert_at_most(check_colouring(&p.sparse, colour, colours), colours);
  }
}

/* A star: its hub, the last column, is coloured first. */
static void test_columns_of_many_entries_first(void **state)
{
  (void)state;
  static pattern p;
  int32_t colour[MOST];
  int colours;
  enum { HUB = 9 };
  begin_pattern(&p, HUB + 1);
  for (int j = 0; j < HUB; ++j) {
    begin_row(&p);
    add_entry(&p, j);
    add_entry(&p, HUB);
  }
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
  assert_int_equal(colours, 2);
  assert_int_equal(colour[HUB], 0);
}

static void test_malformed_patterns(void **state)
{
  (void)state;
  static pattern p;
  int32_t colour[MOST] = {0};
  int colours;
  double values[MOST * 3], x[4] = {1, 2, 3, 4};
  kg_tape *t = new_tape(KG_DOUBLE);
  const kg_value in = kg_input(t, KG_SHAPE(4), x), y = kg_square(t, in);
  const kg_tape_mark mark = kg_tape_mark_of(t);
  tridiagonal(&p, 4);
  p.column[3] = 4;
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_ERR_SHAPE);
  p.column[3] = -1;
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_ERR_SHAPE);
  assert_int_equal(kg_jacobian_coloured(t, y, in, &p.sparse, colour, 3, values), KG_ERR_SHAPE);
  kg_tape_rewind(t, mark);
  tridiagonal(&p, 4);
  p.start[2] = 1;
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_ERR_SHAPE);
  tridiagonal(&p, 4);
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
  colour[2] = 3; /* no such colour */
  assert_int_equal(kg_jacobian_coloured(t, y, in, &p.sparse, colour, 3, values), KG_ERR_SHAPE);
  assert_string_equal(kg_tape_error(t)->text,
                      "jacobian: column 2 has colour 3; there are 3, from 0");
  kg_tape_rewind(t, mark);
  for (int j = 0; j < 4; ++j) {
    colour[j] = j % 2; /* columns 0 and 2 meet in row 1 */
  }
  assert_int_equal(kg_jacobian_coloured(t, y, in, &p.sparse, colour, 3, values), KG_ERR_SHAPE);
  assert_string_equal(kg_tape_error(t)->text,
                      "jacobian: columns 0 and 2 share colour 0, and both have an entry in row 1");
  kg_tape_rewind(t, mark);
  tridiagonal(&p, 5); /* of another size */
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
  assert_int_equal(kg_jacobian_coloured(t, y, in, &p.sparse, colour, 3, values), KG_ERR_SHAPE);
  assert_non_null(strstr(kg_tape_error(t)->text, "5 rows"));
  kg_tape_destroy(t);
}

/* y_i = sin(x_i) x_(i-1) + x_(i+1)^2, zeros beyond the ends */
static kg_value chain(kg_tape *t, kg_value x, int n)
{
  int32_t before[MOST], after[MOST];
  for (int i = 0; i < n; ++i) {
    before[i] = i - 1;
    after[i] = i + 1 < n ? i + 1 : -1;
  }
  const kg_value left = kg_gather(t, x, 0, n, before), right = kg_gather(t, x, 0, n, after);
  return kg_add(t, kg_mul(t, kg_sin(t, x), left), kg_square(t, right));
}

static void check_coloured(kg_precision precision, const int32_t *colour, int colours, int n,
                           const kg_sparse *sparse, double tolerance)
{
  double x[MOST], values[3 * MOST];
  fill(x, n, 7);
  kg_tape *t = new_tape(precision);
  const kg_value in = kg_input(t, KG_SHAPE(n), x), y = chain(t, in, n);
  memset(values, 0xff, sizeof values);
  assert_int_equal(kg_jacobian_coloured(t, y, in, sparse, colour, colours, values), KG_OK);
  for (int i = 0; i < n; ++i) {
    for (int k = sparse->start[i]; k < sparse->start[i + 1]; ++k) {
      const int j = sparse->column[k];
      const double left = i > 0 ? x[i - 1] : 0;
      const double expected = j < i ? sin(x[i]) : j == i ? cos(x[i]) * left : 2 * x[j];
      assert_close(values[k], expected, tolerance);
    }
  }
  kg_tape_destroy(t);
}

static void test_coloured_jacobian(void **state)
{
  (void)state;
  enum { N = 50 };
  static pattern p;
  int32_t colour[N], own[N];
  int colours;
  tridiagonal(&p, N);
  assert_int_equal(kg_colour_columns(&p.sparse, colour, &colours), KG_OK);
  check_coloured(KG_DOUBLE, colour, colours, N, &p.sparse, 1e-15);
  check_coloured(KG_FLOAT, colour, colours, N, &p.sparse, 1e-6);
  for (int j = 0; j < N; ++j) {
    own[j] = j; /* a colour for each: more than one sweep takes */
  }
  check_coloured(KG_DOUBLE, own, N, N, &p.sparse, 1e-15);
}

/* -- products with the Hessian ----------------------------------------------------------------- */

/* f = logsumexp(x) + 1/2 s^2 |x|^2: by x and s,
 *   H = [diag p - p p' + s^2 I, 2 s x; 2 s x', |x|^2] */
static void test_hessian_product(void **state)
{
  (void)state;
  enum { N = 6 };
  double x[N], v[N], p[N], hx[N], hs, sum = 0, xx = 0, xv = 0, pv = 0;
  const double s = 0.7, vs = -1.3;
  fill(x, N, 3);
  fill(v, N, 4);
  kg_tape *t = new_tape(KG_DOUBLE);
  const kg_value in[2] = {kg_input(t, KG_SHAPE(N), x), kg_scalar(t, s)};
  const kg_value half = kg_scale(t, kg_square(t, in[1]), 0.5);
  const kg_value square = kg_sum_squares(t, in[0], 0);
  /* a branch of the recording code does not stand in the way */
  assert_true(kg_is_less(t, in[1], kg_constant_scalar(t, 1)));
  const kg_value f = kg_add(t, kg_logsumexp(t, in[0], 0), kg_mul(t, half, square));
  const double *const vectors[2] = {v, &vs};
  double *const products[2] = {hx, &hs};
  for (int i = 0; i < N; ++i) {
    sum += exp(x[i]);
  }
  for (int i = 0; i < N; ++i) {
    p[i] = exp(x[i]) / sum;
    xx += x[i] * x[i];
    xv += x[i] * v[i];
    pv += p[i] * v[i];
  }
  for (int round = 0; round < 2; ++round) {
    assert_int_equal(kg_hessian_product(t, f, 2, in, vectors, products), KG_OK);
    for (int i = 0; i < N; ++i) {
      assert_close(hx[i], p[i] * v[i] - p[i] * pv + s * s * v[i] + 2 * s * x[i] * vs, 1e-14);
    }
    assert_close(hs, 2 * s * xv + xx * vs, 1e-14);
  }
  kg_tape_destroy(t);
}

/* In complex arithmetic functions may round the other way: comparisons are not asked again. */
static void test_hessian_product_beside_a_branch(void **state)
{
  (void)state;
  kg_tape *t = new_tape(KG_DOUBLE);
  for (int i = 1; i < 200; ++i) {
    kg_tape_rewind(t, (kg_tape_mark){0});
    const double v = 1, *const vectors[1] = {&v};
    double h, *const products[1] = {&h};
    const kg_value x = kg_scalar(t, i / 100.0), y = kg_tanh(t, kg_exp(t, kg_neg(t, x)));
    const kg_value bound = kg_constant_scalar(t, kg_item(t, y));
    assert_false(kg_is_less(t, y, bound));
    assert_false(kg_is_less(t, bound, y));
    assert_int_equal(kg_hessian_product(t, kg_power(t, x, 3), 1, &x, vectors, products), KG_OK);
    assert_close(h, 6 * i / 100.0, 1e-15);
  }
  kg_tape_destroy(t);
}

static void test_hessian_by_a_constant(void **state)
{
  (void)state;
  kg_tape *t = new_tape(KG_DOUBLE);
  const kg_value x = kg_scalar(t, 2), c = kg_constant_scalar(t, 3), y = kg_mul(t, x, c);
  const kg_value inputs[2] = {x, c};
  const double v = 1, *const vectors[2] = {&v, &v};
  double a, b, *const products[2] = {&a, &b};
  assert_int_equal(kg_hessian_product(t, y, 2, inputs, vectors, products), KG_ERR_UNDEFINED);
  assert_string_equal(kg_tape_error(t)->text,
                      "hessian: input 1 does not depend on a differentiable input");
  kg_tape_destroy(t);
}

static void test_hessian_refusals(void **state)
{
  (void)state;
  failing_heap heap = {1000, 0};
  const kg_allocator allocator = {failing_alloc, failing_free, &heap};
  kg_tape_def def = kg_tape_default_def();
  def.allocator = &allocator;
  kg_tape *t;
  assert_int_equal(kg_tape_create(&def, &t, NULL), KG_OK);
  const kg_value x = kg_input(t, KG_SHAPE(2), NULL), y = kg_square(t, x), f = kg_sum_all(t, y);
  const kg_tape_mark mark = kg_tape_mark_of(t);
  const double v[2] = {1, 2}, *const vectors[1] = {v};
  double h[2], *const products[1] = {h};
  assert_int_equal(kg_hessian_product(t, y, 1, &x, vectors, products), KG_ERR_SHAPE);
  assert_non_null(strstr(kg_tape_error(t)->text, "hessian: of a value of shape (2)"));
  kg_tape_rewind(t, mark);
  int refusals = 0;
  kg_status status = KG_ERR_NO_MEMORY;
  for (; status != KG_OK; ++refusals) {
    heap.calls_left = refusals;
    status = kg_hessian_product(t, f, 1, &x, vectors, products);
    assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
    kg_tape_rewind(t, mark);
  }
  assert_true(refusals > 3);
  assert_close(h[0], 2, 1e-15);
  assert_close(h[1], 4, 1e-15);
  kg_tape_destroy(t);
  assert_int_equal(heap.live_bytes, 0);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(test_dense),
    cmocka_unit_test(test_scalars_and_independent_values),
    cmocka_unit_test(test_colouring),
    cmocka_unit_test(test_columns_of_many_entries_first),
    cmocka_unit_test(test_malformed_patterns),
    cmocka_unit_test(test_coloured_jacobian),
    cmocka_unit_test(test_hessian_product),
    cmocka_unit_test(test_hessian_product_beside_a_branch),
    cmocka_unit_test(test_hessian_by_a_constant),
    cmocka_unit_test(test_hessian_refusals),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
