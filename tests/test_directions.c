/* Many directions in one forward sweep, most of which move little: results are those of single
 * directions, bit for bit, on a tape and in a program, and an outside truth's. */
#include "kinegrad/program.h"
#include "tape_support.h"

enum { JOINTS = 6, LINKS = JOINTS - 1, MANY = 70, POINTS = 5 };

/* joint j turns everything after it: R(a_0) R(a_1) ... R(a_j) points, summed over j; joint 5 scales */
static kg_value record_chain(kg_tape *t, kg_value angles, const double *points)
{
  const kg_value p = kg_constant(t, KG_SHAPE(2, POINTS), points);
  kg_value frame = {0}, parts[LINKS];
  double ones[LINKS];
  for (int j = 0; j < LINKS; ++j) {
    const kg_value a = kg_element(t, angles, (size_t)j), c = kg_cos(t, a), s = kg_sin(t, a);
    const kg_value entries[4] = {c, kg_neg(t, s), s, c};
    const kg_value turn = kg_reshape(t, kg_stack(t, 4, entries), KG_SHAPE(2, 2));
    frame = j ? kg_matmul(t, frame, turn, 0) : turn;
    parts[j] = kg_matmul(t, frame, p, 0);
    ones[j] = 1;
  }
  const kg_value sum = kg_combine(t, LINKS, ones, parts);
  return kg_mul(t, sum, kg_slice(t, angles, 0, LINKS, 1));
}

static void plain_chain(const complex_number *angle, const double *points, complex_number *out)
{
  complex_number total = 0;
  memset(out, 0, 2 * POINTS * sizeof *out);
  for (int j = 0; j < LINKS; ++j) {
    total += angle[j];
    for (int i = 0; i < POINTS; ++i) {
      const double x = points[i], y = points[POINTS + i];
      out[i] += (ccos(total) * x - csin(total) * y) * angle[LINKS];
      out[POINTS + i] += (csin(total) * x + ccos(total) * y) * angle[LINKS];
    }
  }
}

/* direction s moves one angle; every seventh moves none, every eleventh all */
static void fill_tangents(double *tangents)
{
  memset(tangents, 0, MANY * JOINTS * sizeof *tangents);
  for (int s = 0; s < MANY; ++s) {
    if (s % 7 != 6) tangents[s * JOINTS + s % JOINTS] = 1 + 0.1 * s;
    for (int j = 0; s % 11 == 10 && j < JOINTS; ++j) {
      tangents[s * JOINTS + j] = 0.3 * j - 1;
    }
  }
}

static void check_against_steps(const double *angles, const double *points, const double *tangents,
                                const double *results)
{
  for (int s = 0; s < MANY; ++s) {
    complex_number at[JOINTS], out[2 * POINTS];
    for (int j = 0; j < JOINTS; ++j) {
      at[j] = CMPLX(angles[j], 1e-100 * tangents[s * JOINTS + j]);
    }
    plain_chain(at, points, out);
    for (int i = 0; i < 2 * POINTS; ++i) {
      assert_at_most(fabs(results[s * 2 * POINTS + i] - cimag(out[i]) / 1e-100), 1e-12);
    }
  }
}

static void directions_are_independent(void **state)
{
  (void)state;
  kg_random random = kg_random_make(11);
  double *angles = random_numbers(&random, JOINTS), *points = random_numbers(&random, 2 * POINTS);
  double tangents[MANY * JOINTS], results[MANY * 2 * POINTS], one[2 * POINTS];
  const double *from = tangents;
  double *to = results;
  fill_tangents(tangents);
  kg_tape *tape;
  assert_int_equal(kg_tape_create(NULL, &tape, NULL), KG_OK);
  const kg_value in = kg_input(tape, KG_SHAPE(JOINTS), angles);
  const kg_value out = record_chain(tape, in, points);
  memset(results, 0x7f, sizeof results); /* what is not written shows */
  assert_int_equal(kg_jvp(tape, MANY, 1, &in, &from, 1, &out, &to), KG_OK);
  check_against_steps(angles, points, tangents, results);
  kg_program *program;
  assert_int_equal(kg_program_create(NULL, tape, 1, &in, 1, &out, &program, NULL), KG_OK);
  assert_int_equal(kg_program_run(program), KG_OK);
  memcpy(kg_program_tangent(program, 0, MANY), tangents, sizeof tangents);
  assert_int_equal(kg_program_forward(program, MANY), KG_OK);
  assert_memory_equal(kg_program_output_tangent(program, 0), results, sizeof results);
  for (int s = 0; s < MANY; ++s) {
    from = tangents + s * JOINTS;
    to = one;
    assert_int_equal(kg_jvp(tape, 1, 1, &in, &from, 1, &out, &to), KG_OK);
    assert_memory_equal(one, results + s * 2 * POINTS, sizeof one);
  }
  kg_program_destroy(program);
  kg_tape_destroy(tape);
  free(angles);
  free(points);
}

int main(void)
{
  const struct CMUnitTest tests[] = {cmocka_unit_test(directions_are_independent)};
  return cmocka_run_group_tests(tests, NULL, NULL);
}
