/* Checks that hold for every signed distance: derivatives against Richardson differences. */
#ifndef TESTS_SDF_SUPPORT_H
#define TESTS_SDF_SUPPORT_H

#include "support.h"

#include "kinegrad/sdf.h"

typedef kg_sdf_value sdf_fn(kg_vec3 x, const void *user);

static inline kg_vec3 axis_step(int i, double h)
{
  return kg_vec3_make(i == 0 ? h : 0.0, i == 1 ? h : 0.0, i == 2 ? h : 0.0);
}

/* Central difference of order 4: (4 D(h) - D(2h)) / 3 */
static inline double richardson(double minus2, double minus1, double plus1, double plus2, double h)
{
  return (8.0 * (plus1 - minus1) - (plus2 - minus2)) / (12.0 * h);
}

/* Gradient and Hessian of `phi` at x against differences of value and gradient; the gradient need not
 * be a unit vector. False, and nothing checked, when a kink lies within the stencil (it jumps). */
static inline bool check_slopes(sdf_fn *phi, const void *user, kg_vec3 x, double h, double tol)
{
  const kg_sdf_value at = phi(x, user);
  kg_sdf_value v[3][4];
  const double steps[4] = {-2.0 * h, -h, h, 2.0 * h};
  for (int i = 0; i < 3; i++) {
    for (int k = 0; k < 4; k++) {
      v[i][k] = phi(kg_vec3_add(x, axis_step(i, steps[k])), user);
      double jump = 0.0; /* the largest Hessian change a stencil without a kink may show */
      for (int c = 0; c < 6; c++) {
        jump = fmax(jump, fabs(v[i][k].hessian[c] - at.hessian[c]));
      }
      if (kg_vec3_norm(kg_vec3_sub(v[i][k].normal, at.normal)) > 0.05 ||
          jump > 0.2 / fmax(fabs(at.distance), 1e-3)) {
        return false;
      }
    }
  }
  const double n[3] = {at.normal.x, at.normal.y, at.normal.z};
  const double *H = at.hessian;
  const double full[9] = {H[0], H[3], H[4], H[3], H[1], H[5], H[4], H[5], H[2]};
  for (int i = 0; i < 3; i++) {
    const kg_sdf_value *s = v[i];
    assert_close(richardson(s[0].distance, s[1].distance, s[2].distance, s[3].distance, h), n[i],
                 tol);
    assert_close(richardson(s[0].normal.x, s[1].normal.x, s[2].normal.x, s[3].normal.x, h), full[i],
                 tol);
    assert_close(richardson(s[0].normal.y, s[1].normal.y, s[2].normal.y, s[3].normal.y, h),
                 full[3 + i], tol);
    assert_close(richardson(s[0].normal.z, s[1].normal.z, s[2].normal.z, s[3].normal.z, h),
                 full[6 + i], tol);
  }
  return true;
}

/* The same of a distance: the gradient is a unit vector. */
static inline bool check_derivatives(sdf_fn *phi, const void *user, kg_vec3 x, double h, double tol)
{
  assert_close(kg_vec3_norm(phi(x, user).normal), 1.0, 1e-12);
  return check_slopes(phi, user, x, h, tol);
}

#endif
