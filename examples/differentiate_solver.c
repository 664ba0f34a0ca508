/* How does the solution of a solver move with its parameters? A weight hangs between two springs;
 * Newton's method finds where. The formula of the forces, written once, serves the solver and the
 * derivative. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "kinegrad/dense.h"
#include "kinegrad/derivatives.h"
#include "kinegrad/newton.h"
#include "kinegrad/primitive.h"

/* [residual] */
/* F(x, k): forces on the weight at x (2), of springs of length 1 and stiffness k, and gravity */
static kg_value forces(kg_tape *tape, kg_value x, int count, const kg_value *k, void *user)
{
  static const double hook[2][2] = {{-1, 0}, {1, 0}}, weight[2] = {0, 1};
  kg_value sum = kg_constant(tape, KG_SHAPE(2), weight);
  (void)user;
  for (int i = 0; i < count; ++i) {
    const kg_value d = kg_sub(tape, x, kg_constant(tape, KG_SHAPE(2), hook[i]));
    const kg_value length = kg_norm(tape, d, 0);
    const kg_value tension = kg_mul(tape, k[i], kg_shift(tape, length, -1));
    sum = kg_sub(tape, sum, kg_mul(tape, kg_div(tape, tension, length), d));
  }
  return sum;
}
/* [residual] */

/* The solver's own tape gives F and dF/dx at any x. */
typedef struct solver {
  kg_newton *newton;
  kg_tape *tape;
  const double *const *k;
  kg_value x, residual;
} solver;

static void record(solver *s, const double *x)
{
  kg_tape_rewind(s->tape, (kg_tape_mark){0});
  const kg_value k[2] = {kg_constant_scalar(s->tape, *s->k[0]),
                         kg_constant_scalar(s->tape, *s->k[1])};
  s->x = kg_input(s->tape, KG_SHAPE(2), x);
  s->residual = forces(s->tape, s->x, 2, k, NULL);
}

static bool newton_residual(double *F, const double *x, void *user)
{
  solver *s = user;
  record(s, x);
  if (kg_tape_status(s->tape) != KG_OK) return false;
  memcpy(F, kg_data(s->tape, s->residual), 2 * sizeof *F);
  return true;
}

static bool newton_direction(double *p, const double *x, const double *F, void *user)
{
  solver *s = user;
  double J[4];
  int pivots[2];
  record(s, x);
  if (kg_jacobian(s->tape, s->residual, s->x, J) != KG_OK) return false;
  if (!kg_dense_lu_factor(J, pivots, 2)) return false;
  p[0] = -F[0];
  p[1] = -F[1];
  kg_dense_lu_solve(J, pivots, 2, p, 1);
  return true;
}

/* [solve] */
static kg_status solve(void *user, int count, const kg_shape *shapes, const double *const *k,
                       double *x)
{
  solver *s = user;
  (void)count, (void)shapes;
  s->k = k;
  x[1] = 1; /* below the hooks: y points down */
  const kg_newton_report report =
    kg_newton_solve(s->newton, x, NULL, newton_residual, newton_direction, s);
  return report.stop == KG_NEWTON_CONVERGED ? KG_OK : KG_ERR_UNDEFINED;
}
/* [solve] */

/* height y of the weight, and its derivatives by the stiffnesses where by_k is not NULL */
static double height(solver *s, double k0, double k1, double *by_k)
{
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return NAN;
  /* [use] */
  const kg_root balance = {.name = "balance",
                           .user = s,
                           .shape = KG_SHAPE(2),
                           .residual = forces,
                           .solve = solve,
                           .tolerance = 1e-8};
  const kg_value k[2] = {kg_scalar(tape, k0), kg_scalar(tape, k1)};
  const kg_value x = kg_differentiate_root(tape, &balance, 2, k);
  const kg_value y = kg_element(tape, x, 1);
  if (by_k && kg_backward(tape, y) == KG_OK) {
    by_k[0] = kg_adjoint_item(tape, k[0]);
    by_k[1] = kg_adjoint_item(tape, k[1]);
  }
  /* [use] */
  if (kg_tape_status(tape) != KG_OK) fprintf(stderr, "%s\n", kg_tape_error(tape)->text);
  const double value = kg_item(tape, y);
  kg_tape_destroy(tape);
  return value;
}

int main(void)
{
  kg_newton_def def = kg_newton_default_def(2);
  solver s = {0};
  def.tolerance = 1e-12;
  double by_k[2] = {NAN, NAN}, h = 1e-5, difference = NAN;
  if (kg_newton_create(&s.newton, &def) == KG_OK && kg_tape_create(NULL, &s.tape, NULL) == KG_OK) {
    printf("the weight hangs %.6f below the hooks\n", height(&s, 3, 5, by_k));
    difference = (height(&s, 3 + h, 5, NULL) - height(&s, 3 - h, 5, NULL)) / (2 * h);
    printf("dy/dk0 = %.9f, by central differences %.9f\n", by_k[0], difference);
  }
  kg_newton_destroy(s.newton);
  kg_tape_destroy(s.tape);
  return fabs(by_k[0] - difference) < 1e-8 ? 0 : 1;
}
