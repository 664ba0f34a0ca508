/* Bundle adjustment by another road than ba.c, to check it and every derivative: the rotation from
 * its unit quaternion, derivatives by complex steps (W. Squire, G. Trapp, Using complex variables to
 * estimate derivatives of real functions, SIAM Rev. 40 (1998)): df/dx = Im f(x + ih) / h, exact to
 * rounding since nothing is subtracted. */
#include <complex.h>
#include <string.h>

#include "bench/autodiff/problems.h"

typedef double complex cplx;

static const double STEP = 1e-100; /* its square vanishes beside 1 */

void kg_bench_ba_inputs(const kg_bench_ba *ba, const double *theta, int i, double *inputs)
{
  const double *points = theta + (size_t)ba->n * KG_BENCH_BA_CAMERA;
  const double *weights = points + (size_t)ba->m * 3;
  memcpy(inputs, theta + ba->camera[i] * KG_BENCH_BA_CAMERA, KG_BENCH_BA_CAMERA * sizeof *inputs);
  memcpy(inputs + KG_BENCH_BA_CAMERA, points + ba->point[i] * 3, 3 * sizeof *inputs);
  inputs[KG_BENCH_BA_INPUTS - 1] = weights[i];
}

/* R(q) for q = (cos(a/2), sin(a/2) r/a) */
static void rotation(cplx R[3][3], const cplx *r)
{
  const cplx a = csqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
  const cplx w = ccos(0.5 * a), s = a == 0.0 ? 0.5 : csin(0.5 * a) / a;
  const cplx x = s * r[0], y = s * r[1], z = s * r[2];
  const cplx rows[3][3] = {
    {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)},
    {2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)},
    {2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)}};
  memcpy(R, rows, sizeof rows);
}

static void observe(cplx residual[2], const cplx *in, const double *feature)
{
  const cplx *C = in + 3, *X = in + KG_BENCH_BA_CAMERA;
  cplx R[3][3], Xc[3];
  rotation(R, in);
  for (int j = 0; j < 3; j++) {
    Xc[j] = R[j][0] * (X[0] - C[0]) + R[j][1] * (X[1] - C[1]) + R[j][2] * (X[2] - C[2]);
  }
  const cplx square = (Xc[0] * Xc[0] + Xc[1] * Xc[1]) / (Xc[2] * Xc[2]);
  const cplx distortion = 1.0 + square * (in[9] + square * in[10]);
  for (int j = 0; j < 2; j++) {
    const cplx projected = in[6] * distortion * Xc[j] / Xc[2] + in[7 + j];
    residual[j] = in[14] * (projected - feature[j]);
  }
}

/* residual and J (2 x 15) of observation i */
static void differentiate(const kg_bench_ba *ba, const double *theta, int i, double residual[2],
                          double J[2][KG_BENCH_BA_INPUTS])
{
  double inputs[KG_BENCH_BA_INPUTS];
  kg_bench_ba_inputs(ba, theta, i, inputs);
  cplx in[KG_BENCH_BA_INPUTS], out[2];
  for (int j = 0; j < KG_BENCH_BA_INPUTS; j++) {
    in[j] = inputs[j];
  }
  for (int j = 0; j < KG_BENCH_BA_INPUTS; j++) {
    in[j] = inputs[j] + STEP * I;
    observe(out, in, ba->feature + 2 * (size_t)i);
    in[j] = inputs[j];
    J[0][j] = cimag(out[0]) / STEP;
    J[1][j] = cimag(out[1]) / STEP;
  }
  residual[0] = creal(out[0]);
  residual[1] = creal(out[1]);
}

/* gradient += J' residual of observation i, and the part of its weight residual */
static void add_gradient(const kg_bench_ba *ba, int i, double w, const double residual[2],
                         double J[2][KG_BENCH_BA_INPUTS], double *gradient)
{
  double *camera = gradient + ba->camera[i] * KG_BENCH_BA_CAMERA;
  double *point = gradient + (size_t)ba->n * KG_BENCH_BA_CAMERA + ba->point[i] * 3;
  double *weight = gradient + (size_t)ba->n * KG_BENCH_BA_CAMERA + (size_t)ba->m * 3 + i;
  for (int row = 0; row < 2; row++) {
    for (int j = 0; j < KG_BENCH_BA_CAMERA; j++) {
      camera[j] += J[row][j] * residual[row];
    }
    for (int j = 0; j < 3; j++) {
      point[j] += J[row][KG_BENCH_BA_CAMERA + j] * residual[row];
    }
    *weight += J[row][KG_BENCH_BA_INPUTS - 1] * residual[row];
  }
  *weight -= 2.0 * w * (1.0 - w * w);
}

void kg_bench_ba_reference(const kg_bench_ba *ba, const double *theta, double *residuals,
                           double *jacobian, double *gradient)
{
  const size_t p = (size_t)ba->p;
  const double *weights = theta + (size_t)ba->n * KG_BENCH_BA_CAMERA + (size_t)ba->m * 3;
  if (gradient) {
    memset(gradient, 0, (size_t)ba->parameter_count * sizeof *gradient);
  }
  for (int i = 0; i < ba->p; i++) {
    double residual[2], J[2][KG_BENCH_BA_INPUTS];
    differentiate(ba, theta, i, residual, J);
    if (residuals) {
      memcpy(residuals + 2 * (size_t)i, residual, sizeof residual);
      residuals[2 * p + (size_t)i] = 1.0 - weights[i] * weights[i];
    }
    if (jacobian) {
      memcpy(jacobian + (size_t)i * 2 * KG_BENCH_BA_INPUTS, J, sizeof J);
      jacobian[p * 2 * KG_BENCH_BA_INPUTS + (size_t)i] = -2.0 * weights[i];
    }
    if (gradient) {
      add_gradient(ba, i, weights[i], residual, J, gradient);
    }
  }
}
