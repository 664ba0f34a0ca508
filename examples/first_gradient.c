/* A first gradient: of a formula in scalars, then of one in tensors. */
#include <stdio.h>

#include "kinegrad/derivatives.h"

/* gradient of Rosenbrock's function (1 - x)^2 + 100 (y - x^2)^2 at (-1.2, 1) */
static kg_status scalars(void)
{
  /* [scalars] */
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return KG_ERR_NO_MEMORY;
  const kg_value x = kg_scalar(tape, -1.2), y = kg_scalar(tape, 1);
  const kg_value a = kg_square(tape, kg_shift(tape, x, -1));
  const kg_value b = kg_square(tape, kg_sub(tape, y, kg_square(tape, x)));
  const kg_value f = kg_add(tape, a, kg_scale(tape, b, 100));
  const kg_status status = kg_backward(tape, f);
  printf("f = %.4f, df/dx = %.4f, df/dy = %.4f\n", kg_item(tape, f), kg_adjoint_item(tape, x),
         kg_adjoint_item(tape, y));
  kg_tape_destroy(tape);
  /* [scalars] */
  return status;
}

/* three steps of gradient descent on the weights W of tanh(X W) against targets */
static kg_status tensors(void)
{
  static const double X[4 * 2] = {0, 1, 1, 0, 1, 1, -1, 2}, target[4] = {0.5, -0.5, 0, 0.9};
  double W[2] = {0, 0};
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return KG_ERR_NO_MEMORY;
  for (int step = 0; step < 3 && kg_tape_status(tape) == KG_OK; ++step) {
    /* [tensors] */
    kg_tape_rewind(tape, (kg_tape_mark){0});
    const kg_value weight = kg_input(tape, KG_SHAPE(2, 1), W);
    const kg_value x = kg_constant(tape, KG_SHAPE(4, 2), X);
    const kg_value y = kg_tanh(tape, kg_matmul(tape, x, weight, 0));
    const kg_value miss = kg_sub(tape, y, kg_constant(tape, KG_SHAPE(4, 1), target));
    const kg_value loss = kg_sum_all(tape, kg_square(tape, miss));
    if (kg_backward(tape, loss) != KG_OK) break;
    const double *slope = kg_adjoint(tape, weight);
    for (int i = 0; i < 2; ++i) {
      W[i] -= 0.1 * slope[i];
    }
    printf("loss %.6f\n", kg_item(tape, loss));
    /* [tensors] */
  }
  if (kg_tape_status(tape) != KG_OK) fprintf(stderr, "%s\n", kg_tape_error(tape)->text);
  const kg_status status = kg_tape_status(tape);
  kg_tape_destroy(tape);
  return status;
}

/* [failure] */
static void failure(kg_tape *tape)
{
  kg_tape_tag(tape, "hip");
  const kg_value a = kg_input(tape, KG_SHAPE(3, 4), NULL), b = kg_input(tape, KG_SHAPE(3), NULL);
  kg_exp(tape, kg_mul(tape, a, b)); /* null in, null out: checked once, below */
  if (kg_tape_status(tape) != KG_OK) printf("%s\n", kg_tape_error(tape)->text);
}
/* [failure] */

int main(void)
{
  if (scalars() != KG_OK || tensors() != KG_OK) return 1;
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return 1;
  failure(tape);
  kg_tape_destroy(tape);
  return 0;
}
