/* Is a derivative right? One written by hand, and the same with the mistake everybody makes. */
#include <math.h>
#include <stdio.h>

#include "kinegrad/gradcheck.h"

/* [function] */
/* spring: two points p and q in the plane, x = (p, q); f(x) = (|p - q| - 1)^2 / 2 */
static kg_status spring_value(void *user, const double *x, double *f)
{
  const double stretch = hypot(x[0] - x[2], x[1] - x[3]) - 1;
  (void)user;
  *f = stretch * stretch / 2;
  return KG_OK;
}

/* xw = J' w: the gradient times w */
static kg_status spring_vjp(void *user, const double *x, const double *w, double *xw)
{
  const bool *mistaken = user;
  const double length = hypot(x[0] - x[2], x[1] - x[3]);
  const double k = (length - 1) / (*mistaken ? 1 : length); /* the direction must have length 1 */
  for (int i = 0; i < 2; ++i) {
    xw[i] = *w * k * (x[i] - x[i + 2]);
    xw[i + 2] = -xw[i];
  }
  return KG_OK;
}
/* [function] */

static bool check(const char *name, bool mistaken)
{
  char row[200];
  /* [check] */
  const kg_differentiable spring = {.name = name,
                                    .inputs = 4,
                                    .outputs = 1,
                                    .user = &mistaken,
                                    .value = spring_value,
                                    .vjp = spring_vjp};
  const double x[4] = {0.3, 1.9, -0.4, 0.2};
  kg_gradcheck_report report;
  kg_error error;
  if (kg_gradcheck(&spring, x, NULL, &report, &error) != KG_OK) {
    fprintf(stderr, "%s\n", error.text); /* the function itself failed at x */
    return false;
  }
  kg_gradcheck_row(NULL, row, sizeof row);
  printf("%s\n", row);
  kg_gradcheck_row(&report, row, sizeof row);
  printf("%s\n", row);
  /* [check] */
  return report.passed;
}

int main(void)
{
  const bool right = check("spring", false), wrong = check("spring, mistaken", true);
  return right && !wrong ? 0 : 1;
}
