/* An operator of one's own: a curve given by a table, with its derivative; used and checked. */
#include <math.h>
#include <stdio.h>

#include "kinegrad/derivatives.h"
#include "kinegrad/gradcheck.h"
#include "kinegrad/primitive.h"

/* [table] */
/* y at x = 0, step, 2 step, ...; between them a cubic, its slopes by central differences */
typedef struct table {
  int count;
  double step;
  const double *y;
} table;

/* value and slope at x; false outside the inner points */
static bool look_up(const table *t, double x, double *value, double *slope)
{
  const double at = x / t->step, first = floor(at);
  if (!(first >= 1 && first + 2 < t->count)) return false;
  const double *y = t->y + (int)first, s = at - first;
  const double m0 = (y[1] - y[-1]) / 2, m1 = (y[2] - y[0]) / 2, d = y[1] - y[0];
  const double c2 = 3 * d - 2 * m0 - m1, c3 = m0 + m1 - 2 * d;
  *value = y[0] + s * (m0 + s * (c2 + s * c3));
  *slope = (m0 + s * (2 * c2 + s * 3 * c3)) / t->step;
  return true;
}
/* [table] */

/* [callbacks] */
/* one operand of any shape, a result of the same; one number kept for every entry: the slope */
static kg_status curve_shape(void *user, int count, const kg_shape *shapes, kg_shape *result,
                             size_t *saved)
{
  (void)user;
  if (count != 1) return KG_ERR_SHAPE;
  *result = shapes[0];
  *saved = kg_shape_size(&shapes[0]);
  return KG_OK;
}

static kg_status curve_forward(const kg_primitive_call *call)
{
  for (size_t i = 0; i < kg_shape_size(&call->shape); ++i) {
    if (!look_up(call->user, call->in[0][i], &call->out[i], &call->saved[i]))
      return KG_ERR_UNDEFINED;
  }
  return KG_OK;
}

/* adds: the operand may be used elsewhere too */
static kg_status curve_vjp(const kg_primitive_call *call, const double *adjoint,
                           double *const *in_adjoints)
{
  for (size_t i = 0; in_adjoints[0] && i < kg_shape_size(&call->shape); ++i) {
    in_adjoints[0][i] += call->saved[i] * adjoint[i];
  }
  return KG_OK;
}

static kg_status curve_jvp(const kg_primitive_call *call, const double *const *tangents,
                           double *out_tangent)
{
  for (size_t i = 0; tangents[0] && i < kg_shape_size(&call->shape); ++i) {
    out_tangent[i] += call->saved[i] * tangents[0][i];
  }
  return KG_OK;
}
/* [callbacks] */

/* [check] */
static kg_value record(kg_tape *tape, kg_value x, void *curve)
{
  return kg_apply(tape, curve, 1, &x);
}

static bool check(kg_primitive *curve)
{
  const double x[3] = {0.7, 1.21, 1.9};
  kg_gradcheck_report report;
  kg_error error;
  char row[200];
  if (kg_gradcheck_recorded("curve", record, curve, KG_SHAPE(3), x, NULL, &report, &error) !=
      KG_OK) {
    fprintf(stderr, "%s\n", error.text);
    return false;
  }
  kg_gradcheck_row(&report, row, sizeof row);
  fprintf(stderr, "%s\n", row);
  return report.passed;
}
/* [check] */

int main(void)
{
  /* [use] */
  static const double y[] = {0, 0.5, 0.9, 1.1, 1.2, 1.25}; /* at 0, 0.5, ..., 2.5 */
  static table torque = {.count = 6, .step = 0.5, .y = y};
  static kg_primitive curve = {.name = "curve",
                               .user = &torque,
                               .shape = curve_shape,
                               .forward = curve_forward,
                               .vjp = curve_vjp,
                               .jvp = curve_jvp};
  const double angles[3] = {0.7, 1.21, 1.9};
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return 1;
  const kg_value x = kg_input(tape, KG_SHAPE(3), angles);
  const kg_value work = kg_sum_all(tape, kg_mul(tape, x, kg_apply(tape, &curve, 1, &x)));
  if (kg_backward(tape, work) != KG_OK) fprintf(stderr, "%s\n", kg_tape_error(tape)->text);
  const double *slope = kg_adjoint(tape, x);
  if (slope)
    printf("work %.5f, gradient %.5f %.5f %.5f\n", kg_item(tape, work), slope[0], slope[1],
           slope[2]);
  kg_tape_destroy(tape);
  /* [use] */
  const bool passed = check(&curve);
  printf("derivative of the curve: %s\n", passed ? "right" : "wrong");
  return slope && passed ? 0 : 1;
}
