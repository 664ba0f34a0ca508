/* Residuals of bundle adjustment, in straight loops over doubles.
 *
 *   Xc = R(r) (X - C),  u = Xc.xy / Xc.z,  d = 1 + k1 |u|^2 + k2 |u|^4
 *   residual = w (f d u + x0 - feature),   weight residual = 1 - w^2
 *   R(r) v = v cos a + (e x v) sin a + e (e . v) (1 - cos a),  a = |r|, e = r / a
 *
 * This file is compiled for speed (bench/CMakeLists.txt): its value is what derivatives are timed
 * against. */
#include <math.h>

#include "bench/autodiff/problems.h"

static void rotate(double *restrict Xc, const double *restrict r, const double *restrict v)
{
  const double square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
  if (square == 0.0) {
    Xc[0] = v[0], Xc[1] = v[1], Xc[2] = v[2];
    return;
  }
  const double a = sqrt(square), s = sin(a), c = cos(a);
  const double e[3] = {r[0] / a, r[1] / a, r[2] / a};
  const double along = (e[0] * v[0] + e[1] * v[1] + e[2] * v[2]) * (1.0 - c);
  Xc[0] = v[0] * c + (e[1] * v[2] - e[2] * v[1]) * s + e[0] * along;
  Xc[1] = v[1] * c + (e[2] * v[0] - e[0] * v[2]) * s + e[1] * along;
  Xc[2] = v[2] * c + (e[0] * v[1] - e[1] * v[0]) * s + e[2] * along;
}

static void observe(double *restrict residual, const double *restrict camera,
                    const double *restrict X, double w, const double *restrict feature)
{
  const double *r = camera, *C = camera + 3, f = camera[6], *x0 = camera + 7, *k = camera + 9;
  const double v[3] = {X[0] - C[0], X[1] - C[1], X[2] - C[2]};
  double Xc[3];
  rotate(Xc, r, v);
  const double u[2] = {Xc[0] / Xc[2], Xc[1] / Xc[2]};
  const double u2 = u[0] * u[0] + u[1] * u[1];
  const double fd = f * (1.0 + k[0] * u2 + k[1] * u2 * u2);
  residual[0] = w * (fd * u[0] + x0[0] - feature[0]);
  residual[1] = w * (fd * u[1] + x0[1] - feature[1]);
}

void kg_bench_ba_residuals(const kg_bench_ba *ba, const double *theta, double *residuals)
{
  const double *points = theta + (size_t)ba->n * KG_BENCH_BA_CAMERA;
  const double *weights = points + (size_t)ba->m * 3;
  double *weight_residuals = residuals + 2 * (size_t)ba->p;
  for (int i = 0; i < ba->p; i++) {
    observe(residuals + 2 * (size_t)i, theta + ba->camera[i] * KG_BENCH_BA_CAMERA,
            points + ba->point[i] * 3, weights[i], ba->feature + 2 * (size_t)i);
  }
  for (int i = 0; i < ba->p; i++) {
    weight_residuals[i] = 1.0 - weights[i] * weights[i];
  }
}

double kg_bench_ba_loss(const kg_bench_ba *ba, const double *theta)
{
  const double *points = theta + (size_t)ba->n * KG_BENCH_BA_CAMERA;
  const double *weights = points + (size_t)ba->m * 3;
  double sum = 0.0;
  for (int i = 0; i < ba->p; i++) {
    double residual[2];
    observe(residual, theta + ba->camera[i] * KG_BENCH_BA_CAMERA, points + ba->point[i] * 3,
            weights[i], ba->feature + 2 * (size_t)i);
    const double weight_residual = 1.0 - weights[i] * weights[i];
    sum +=
      residual[0] * residual[0] + residual[1] * residual[1] + weight_residual * weight_residual;
  }
  return 0.5 * sum;
}
