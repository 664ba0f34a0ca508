/* Jacobians, dense and by coloured columns, and products with the Hessian.
 *
 * A Jacobian is taken a few columns (forward) or rows (backward) at a time, so that the memory of
 * the sweep does not grow with it. */
#include "autodiff/frozen.h"
#include "autodiff/tape.h"

#include "kinegrad/derivatives.h"

#include <string.h>

enum { MOST_DIRECTIONS = 32 };

/* -- dense ------------------------------------------------------------------------------------- */

/* entry i of a value's adjoint or tangent, as a double */
static double number_at(const kg_tape *tape, kg_value value, const void *numbers, size_t i)
{
  const size_t bytes = value.id & KG_TENSOR ? tape->graph.number : sizeof(double);
  double x;
  kg_copy_numbers(tape, value, (const char *)numbers + i * bytes, &x, 1);
  return x;
}

static void add_one(const kg_tape *tape, kg_value value, void *numbers, size_t i)
{
  const size_t bytes = value.id & KG_TENSOR ? tape->graph.number : sizeof(double);
  const double one = 1;
  kg_add_numbers(tape, value, (char *)numbers + i * bytes, &one, 1);
}

/* Rows (backward) or columns (forward) from `start` on, as many as `directions`. */
static kg_status sweep_units(kg_tape *tape, kg_value from, kg_value to, bool backward, size_t start,
                             size_t directions, double *J)
{
  const size_t n = kg_size_of(tape, from), m = kg_size_of(tape, to);
  if (kg_begin_sweep(tape, "jacobian", (int)directions) != KG_OK) return tape->error.status;
  void *seed = kg_sweep_seed(&tape->graph, from.id);
  for (size_t s = 0; seed && s < directions; ++s) {
    add_one(tape, from, seed, s * n + start + s);
  }
  if (backward) {
    kg_sweep_backward(&tape->graph, kg_index(to.id) + 1);
  } else {
    kg_sweep_forward(&tape->graph, kg_index(from.id));
  }
  if (kg_sweep_status(tape) != KG_OK) return tape->error.status;
  const void *result = kg_sweep_result(&tape->graph, to.id);
  for (size_t s = 0; s < directions; ++s) {
    for (size_t e = 0; e < m; ++e) {
      double *entry = backward ? &J[(start + s) * m + e] : &J[e * n + start + s];
      *entry = result ? number_at(tape, to, result, s * m + e) : 0;
    }
  }
  return KG_OK;
}

kg_status kg_jacobian(kg_tape *tape, kg_value output, kg_value input, double *J)
{
  if (!kg_values_usable(tape, "jacobian", 1, &output) ||
      !kg_values_usable(tape, "jacobian", 1, &input) ||
      !kg_values_differentiable(tape, "jacobian", 1, &input)) {
    return tape->error.status;
  }
  const bool backward = kg_size_of(tape, output) <= kg_size_of(tape, input);
  const kg_value from = backward ? output : input, to = backward ? input : output;
  const size_t units = kg_size_of(tape, from);
  for (size_t start = 0; start < units; start += MOST_DIRECTIONS) {
    const size_t left = units - start;
    if (sweep_units(tape, from, to, backward, start,
                    left < MOST_DIRECTIONS ? left : MOST_DIRECTIONS, J) != KG_OK) {
      break;
    }
  }
  return tape->error.status;
}

/* -- coloured columns -------------------------------------------------------------------------- */

static bool pattern_is_valid(const kg_sparse *pattern)
{
  if (pattern->rows < 0 || pattern->columns < 0 || pattern->start[0] != 0) return false;
  for (int32_t r = 0; r < pattern->rows; ++r) {
    if (pattern->start[r + 1] < pattern->start[r]) return false;
    for (int32_t k = pattern->start[r]; k < pattern->start[r + 1]; ++k) {
      if (pattern->column[k] < 0 || pattern->column[k] >= pattern->columns) return false;
    }
  }
  return true;
}

/* The pattern by columns, and the columns by their number of entries. */
typedef struct columns {
  int32_t *start; /* (columns + 1) */
  int32_t *row;   /* (entries)     */
  int32_t *order; /* (columns) columns of many entries first */
  int32_t *taken; /* (columns) the last column that a colour was forbidden to, + 1 */
} columns;

static bool take_columns(const kg_sparse *pattern, kg_arena *arena, columns *c)
{
  c->start = KG_ARENA_ARRAY(arena, int32_t, pattern->columns + 1);
  c->row = KG_ARENA_ARRAY(arena, int32_t, pattern->start[pattern->rows]);
  c->order = KG_ARENA_ARRAY(arena, int32_t, pattern->columns);
  c->taken = KG_ARENA_ARRAY(arena, int32_t, pattern->columns);
  return !kg_arena_failed(arena);
}

/* counting sort of the entries; `order` serves as each column's next free place */
static void sort_entries(const kg_sparse *pattern, columns *c)
{
  for (int32_t k = 0; k < pattern->start[pattern->rows]; ++k) {
    ++c->start[pattern->column[k] + 1];
  }
  for (int32_t j = 0; j < pattern->columns; ++j) {
    c->start[j + 1] += c->start[j];
    c->order[j] = c->start[j];
  }
  for (int32_t r = 0; r < pattern->rows; ++r) {
    for (int32_t k = pattern->start[r]; k < pattern->start[r + 1]; ++k) {
      c->row[c->order[pattern->column[k]]++] = r;
    }
  }
}

/* counting sort of the columns; a column has at most `rows` entries when none is given twice */
static bool sort_columns(const kg_sparse *pattern, kg_arena *arena, columns *c)
{
  const int32_t entries = pattern->start[pattern->rows];
  int32_t *place = KG_ARENA_ARRAY(arena, int32_t, entries + 2);
  if (!place) return false;
  for (int32_t j = 0; j < pattern->columns; ++j) {
    ++place[entries - (c->start[j + 1] - c->start[j]) + 1];
  }
  for (int32_t i = 0; i <= entries; ++i) {
    place[i + 1] += place[i];
  }
  for (int32_t j = 0; j < pattern->columns; ++j) {
    c->order[place[entries - (c->start[j + 1] - c->start[j])]++] = j;
  }
  return true;
}

static int32_t least_free_colour(const kg_sparse *pattern, const columns *c, const int32_t *colour,
                                 int32_t j)
{
  for (int32_t i = c->start[j]; i < c->start[j + 1]; ++i) {
    const int32_t r = c->row[i];
    for (int32_t k = pattern->start[r]; k < pattern->start[r + 1]; ++k) {
      const int32_t other = colour[pattern->column[k]];
      if (other >= 0) c->taken[other] = j + 1;
    }
  }
  int32_t free = 0;
  while (c->taken[free] == j + 1) {
    ++free;
  }
  return free;
}

kg_status kg_colour_columns(const kg_sparse *pattern, int32_t *colour, int *colours)
{
  *colours = 0;
  if (!pattern_is_valid(pattern)) return KG_ERR_SHAPE;
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  columns c;
  bool fine = take_columns(pattern, &arena, &c);
  if (fine) sort_entries(pattern, &c);
  fine = fine && sort_columns(pattern, &arena, &c);
  for (int32_t j = 0; j < pattern->columns; ++j) {
    colour[j] = -1;
  }
  for (int32_t i = 0; fine && i < pattern->columns; ++i) {
    const int32_t j = c.order[i];
    colour[j] = least_free_colour(pattern, &c, colour, j);
    *colours = colour[j] < *colours ? *colours : colour[j] + 1;
  }
  kg_arena_release(&arena);
  return fine ? KG_OK : KG_ERR_NO_MEMORY;
}

static kg_status sweep_colours(kg_tape *tape, kg_value output, kg_value input,
                               const kg_sparse *pattern, const int32_t *colour, int first,
                               int directions, double *values)
{
  const size_t n = (size_t)pattern->columns, m = (size_t)pattern->rows;
  if (kg_begin_sweep(tape, "jacobian", directions) != KG_OK) return tape->error.status;
  void *seed = kg_sweep_seed(&tape->graph, input.id);
  for (size_t j = 0; j < n; ++j) {
    const int s = colour[j] - first;
    if (s >= 0 && s < directions) add_one(tape, input, seed, (size_t)s * n + j);
  }
  kg_sweep_forward(&tape->graph, kg_index(input.id));
  if (kg_sweep_status(tape) != KG_OK) return tape->error.status;
  const void *result = kg_sweep_result(&tape->graph, output.id);
  for (size_t r = 0; r < m; ++r) {
    for (int32_t k = pattern->start[r]; k < pattern->start[r + 1]; ++k) {
      const int s = colour[pattern->column[k]] - first;
      if (s < 0 || s >= directions) continue;
      values[k] = result ? number_at(tape, output, result, (size_t)s * m + r) : 0;
    }
  }
  return KG_OK;
}

static bool refuse_colour(kg_tape *tape, int32_t column, int32_t colour, int colours)
{
  kg_refuse(tape, KG_ERR_SHAPE, "jacobian", "column %d has colour %d; there are %d, from 0",
            (int)column, (int)colour, colours);
  return false;
}

static bool refuse_pair(kg_tape *tape, int32_t row, int32_t one, int32_t other, int32_t colour)
{
  kg_refuse(tape, KG_ERR_SHAPE, "jacobian",
            "columns %d and %d share colour %d, and both have an entry in row %d", (int)one,
            (int)other, (int)colour, (int)row);
  return false;
}

/* Every column has one of the colours, and no row meets one of them in two columns. Otherwise
 * false, with the tape's error saying where. */
static bool colours_fit(kg_tape *tape, const kg_sparse *pattern, const int32_t *colour, int colours)
{
  for (int32_t j = 0; j < pattern->columns; ++j) {
    if (colour[j] < 0 || colour[j] >= colours) return refuse_colour(tape, j, colour[j], colours);
  }
  kg_graph *graph = &tape->graph;
  const size_t count = colours > 0 ? (size_t)colours : 0;
  if (!kg_buffer_reserve(&graph->scratch, graph->allocator, 2 * count * sizeof(int32_t))) {
    kg_refuse(tape, KG_ERR_NO_MEMORY, "jacobian", "no memory for %d colours", colours);
    return false;
  }
  int32_t *row = graph->scratch.memory, *column = row + count; /* where a colour was met last */
  for (size_t c = 0; c < count; ++c) {
    row[c] = -1;
  }
  for (int32_t r = 0; r < pattern->rows; ++r) {
    for (int32_t k = pattern->start[r]; k < pattern->start[r + 1]; ++k) {
      const int32_t j = pattern->column[k], c = colour[j];
      if (row[c] == r && column[c] != j) return refuse_pair(tape, r, column[c], j, c);
      row[c] = r;
      column[c] = j;
    }
  }
  return true;
}

kg_status kg_jacobian_coloured(kg_tape *tape, kg_value output, kg_value input,
                               const kg_sparse *pattern, const int32_t *colour, int colours,
                               double *values)
{
  if (!kg_values_usable(tape, "jacobian", 1, &output) ||
      !kg_values_usable(tape, "jacobian", 1, &input) ||
      !kg_values_differentiable(tape, "jacobian", 1, &input)) {
    return tape->error.status;
  }
  const size_t m = kg_size_of(tape, output), n = kg_size_of(tape, input);
  if (!pattern_is_valid(pattern) || (size_t)pattern->rows != m || (size_t)pattern->columns != n) {
    kg_refuse(tape, KG_ERR_SHAPE, "jacobian",
              "a pattern of %d rows and %d columns for %zu by %zu entries, or malformed",
              (int)pattern->rows, (int)pattern->columns, m, n);
    return tape->error.status;
  }
  if (!colours_fit(tape, pattern, colour, colours)) return tape->error.status;
  for (int first = 0; first < colours && tape->error.status == KG_OK; first += MOST_DIRECTIONS) {
    const int left = colours - first;
    sweep_colours(tape, output, input, pattern, colour, first,
                  left < MOST_DIRECTIONS ? left : MOST_DIRECTIONS, values);
  }
  return tape->error.status;
}

/* -- second derivatives ------------------------------------------------------------------------ */

/* gradient at x + i h v: h times its derivative along v, in the imaginary part */
static const double step = 1e-100;

static kg_status differentiate_gradient(kg_program *program, int count,
                                        const double *const *vectors, double *const *products)
{
  for (int i = 0; i < count; ++i) {
    double *x = kg_program_input(program, i);
    for (size_t e = 0; e < kg_program_input_size(program, i); ++e) {
      x[2 * e + 1] = step * vectors[i][e];
    }
  }
  kg_status status = kg_program_run(program);
  double *seed = kg_program_seed(program, 0, 1);
  if (status != KG_OK) return status;
  if (!seed) return KG_ERR_NO_MEMORY;
  seed[0] = 1;
  status = kg_program_backward(program, 1);
  for (int i = 0; i < count && status == KG_OK; ++i) {
    const double *adjoint = kg_program_adjoint(program, i);
    for (size_t e = 0; e < kg_program_input_size(program, i); ++e) {
      products[i][e] = adjoint[2 * e + 1] / step;
    }
  }
  return status;
}

kg_status kg_hessian_product(kg_tape *tape, kg_value output, int count, const kg_value *inputs,
                             const double *const *vectors, double *const *products)
{
  if (!kg_values_usable(tape, "hessian", 1, &output) ||
      !kg_values_usable(tape, "hessian", count, inputs) ||
      !kg_values_differentiable(tape, "hessian", count, inputs)) {
    return tape->error.status;
  }
  if (kg_size_of(tape, output) != 1) {
    kg_refuse(tape, KG_ERR_SHAPE, "hessian", "of a value of shape %s; it must have one entry",
              kg_shape_print(kg_shape_of(tape, output)).text);
    return tape->error.status;
  }
  kg_program_def def = kg_program_default_def();
  def.arithmetic_complex = true;
  def.allocator = tape->graph.allocator;
  kg_program *program;
  kg_error error;
  kg_status status = kg_freeze(&def, false, tape, count, inputs, 1, &output, &program, &error);
  if (status == KG_OK) {
    status = differentiate_gradient(program, count, vectors, products);
    error = program->error;
  }
  if (status != KG_OK) kg_refuse(tape, status, "hessian", "%s", error.text);
  kg_program_destroy(program);
  return tape->error.status;
}
