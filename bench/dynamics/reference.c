/* Newton and Euler for every segment, projected on every joint above it (d'Alembert's principle):
 *
 *   tau_j = R_j' sum_i [ n_i + (c_i - p_j) x f_i ],   i in the subtree of j,
 *   f_i = m_i (c_i'' - g),   n_i = R_i (I_i alpha + omega x I_i omega) in segment axes.
 *
 * O(n^2), no recursion of forces, no spatial vectors. Numbers are long double where that is more
 * than double, and solutions with M are refined in them: M is so ill-conditioned that accelerations
 * in double err by 1e-12. */
#include "bench/dynamics/reference.h"

#include <complex.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/dense.h"

typedef long double real;
typedef long double complex number;

typedef struct link {
  number R[3][3];
  number p[3], pp[3]; /* joint and its acceleration  */
  number w[3], ww[3]; /* angular velocity, its rate  */
  number c[3], f[3], n[3];
} link;

static void cross(number *out, const number *a, const number *b)
{
  const number c[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                       a[0] * b[1] - a[1] * b[0]};
  memcpy(out, c, sizeof c);
}

static void rotate(number *out, number R[3][3], const number *a)
{
  for (int i = 0; i < 3; i++) {
    out[i] = R[i][0] * a[0] + R[i][1] * a[1] + R[i][2] * a[2];
  }
}

static void add_cross(number *out, const number *a, const number *b)
{
  number c[3];
  cross(c, a, b);
  for (int k = 0; k < 3; k++) {
    out[k] += c[k];
  }
}

static void matrix_of(number R[3][3], const number *q)
{
  const number w = q[0], x = q[1], y = q[2], z = q[3];
  const number rows[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                             {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                             {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  memcpy(R, rows, sizeof rows);
}

/* Pose, velocity and acceleration of segment i from its parent's (NULL: the root). */
static void move(link *l, const link *parent, const kg_segment *s, int i, const number *q,
                 const number *v, const number *a)
{
  number Q[3][3], omega[3], rate[3];
  matrix_of(Q, q + 3 + 4 * i);
  if (!parent) {
    memcpy(l->R, Q, sizeof Q);
    for (int k = 0; k < 3; k++) {
      l->p[k] = q[k];
      l->pp[k] = a[k];
    }
  } else {
    const number offset[3] = {s->offset.x, s->offset.y, s->offset.z};
    for (int r = 0; r < 3; r++) {
      for (int c = 0; c < 3; c++) {
        l->R[r][c] = 0.0;
        for (int k = 0; k < 3; k++) {
          l->R[r][c] += parent->R[r][k] * Q[k][c];
        }
      }
    }
    number arm[3], turn[3];
    rotate(arm, (number(*)[3])parent->R, offset);
    cross(turn, parent->w, arm);
    for (int k = 0; k < 3; k++) {
      l->p[k] = parent->p[k] + arm[k];
      l->pp[k] = parent->pp[k];
      l->w[k] = parent->w[k];
      l->ww[k] = parent->ww[k];
    }
    add_cross(l->pp, parent->ww, arm);
    add_cross(l->pp, parent->w, turn);
  }
  rotate(omega, l->R, v + 3 + 3 * i);
  rotate(rate, l->R, a + 3 + 3 * i);
  add_cross(l->ww, l->w, omega);
  for (int k = 0; k < 3; k++) {
    l->w[k] += omega[k];
    l->ww[k] += rate[k];
  }
}

/* Force and moment about its centre of mass that segment i needs. */
static void load(link *l, const kg_segment *s, double gravity)
{
  const double *i = s->inertia;
  const double A[3][3] = {{i[0], i[3], i[4]}, {i[3], i[1], i[5]}, {i[4], i[5], i[2]}};
  const number com[3] = {s->com.x, s->com.y, s->com.z};
  number arm[3], turn[3], w[3] = {0}, ww[3] = {0}, h[3] = {0}, n[3] = {0};
  rotate(arm, l->R, com);
  cross(turn, l->w, arm);
  for (int k = 0; k < 3; k++) {
    l->c[k] = l->p[k] + arm[k];
    l->f[k] = l->pp[k] + (k == 1 ? gravity : 0.0);
    for (int r = 0; r < 3; r++) { /* to segment axes */
      w[k] += l->R[r][k] * l->w[r];
      ww[k] += l->R[r][k] * l->ww[r];
    }
  }
  add_cross(l->f, l->ww, arm);
  add_cross(l->f, l->w, turn);
  for (int r = 0; r < 3; r++) {
    l->f[r] *= s->mass;
    for (int k = 0; k < 3; k++) {
      h[r] += A[r][k] * w[k];
      n[r] += A[r][k] * ww[k];
    }
  }
  add_cross(n, w, h);
  rotate(l->n, l->R, n);
}

/* All segments' motion and what they need, g = gravity. */
static void move_all(link *links, const kg_body *body, const number *q, const number *v,
                     const number *a, double gravity)
{
  for (int i = 0; i < body->segment_count; i++) {
    const kg_segment *s = &body->segments[i];
    links[i] = (link){.w = {0.0}};
    move(&links[i], s->parent < 0 ? NULL : &links[s->parent], s, i, q, v, a);
    load(&links[i], s, gravity);
  }
}

static kg_status inverse(const kg_body *body, number *tau, const number *q, const number *v,
                         const number *a, double gravity)
{
  link *links = calloc((size_t)body->segment_count, sizeof *links);
  if (!links) {
    return KG_ERR_NO_MEMORY;
  }
  memset(tau, 0, (size_t)body->nv * sizeof *tau);
  move_all(links, body, q, v, a, gravity);
  for (int i = 0; i < body->segment_count; i++) {
    for (int j = i; j >= 0; j = body->segments[j].parent) {
      number arm[3], n[3];
      for (int k = 0; k < 3; k++) {
        arm[k] = links[i].c[k] - links[j].p[k];
        n[k] = links[i].n[k];
      }
      add_cross(n, arm, links[i].f);
      for (int k = 0; k < 3; k++) {
        for (int r = 0; r < 3; r++) {
          tau[3 + 3 * j + k] += links[j].R[r][k] * n[r];
        }
      }
    }
    for (int k = 0; k < 3; k++) {
      tau[k] += links[i].f[k];
    }
  }
  free(links);
  return KG_OK;
}

/* ---- calls ----------------------------------------------------------------------------------- */

/* q, v, a, tau as complex numbers in one block of memory */
typedef struct arguments {
  number *q, *v, *a, *tau;
} arguments;

static bool take(arguments *x, const kg_body *body, const double *q, const double *v,
                 const double *a)
{
  const size_t nq = (size_t)body->nq, nv = (size_t)body->nv;
  x->q = calloc(nq + 3 * nv, sizeof *x->q);
  if (!x->q) {
    return false;
  }
  x->v = x->q + nq;
  x->a = x->v + nv;
  x->tau = x->a + nv;
  for (size_t k = 0; k < nq; k++) {
    x->q[k] = q[k];
  }
  for (size_t k = 0; k < nv; k++) {
    x->v[k] = v ? v[k] : 0.0;
    x->a[k] = a ? a[k] : 0.0;
  }
  return true;
}

kg_status kg_bench_reference_pose(const kg_body *body, double *p, double *R, const double *q)
{
  arguments x;
  link *links = calloc((size_t)body->segment_count, sizeof *links);
  if (!links || !take(&x, body, q, NULL, NULL)) {
    free(links);
    return KG_ERR_NO_MEMORY;
  }
  move_all(links, body, x.q, x.v, x.a, 0.0);
  for (int i = 0; i < body->segment_count; i++) {
    for (int k = 0; k < 9; k++) {
      R[9 * i + k] = (double)creall(links[i].R[k / 3][k % 3]);
      p[3 * i + k / 3] = (double)creall(links[i].p[k / 3]);
    }
  }
  free(links);
  free(x.q);
  return KG_OK;
}

/* Column c of A from the motion at rest with acceleration e_c, whose forces are then momenta. */
static void momentum_column(double *A, int c, const kg_body *body, const link *links)
{
  number sum[6] = {0.0}, com[3] = {0.0};
  for (int i = 0; i < body->segment_count; i++) {
    for (int k = 0; k < 3; k++) {
      com[k] += body->segments[i].mass / body->mass * links[i].c[k];
    }
  }
  for (int i = 0; i < body->segment_count; i++) {
    const number arm[3] = {links[i].c[0] - com[0], links[i].c[1] - com[1], links[i].c[2] - com[2]};
    for (int k = 0; k < 3; k++) {
      sum[k] += links[i].n[k];
      sum[3 + k] += links[i].f[k];
    }
    add_cross(sum, arm, links[i].f);
  }
  for (int k = 0; k < 6; k++) {
    A[k * body->nv + c] = (double)creall(sum[k]);
  }
}

kg_status kg_bench_reference_centroidal(const kg_body *body, double *A, const double *q)
{
  arguments x;
  link *links = calloc((size_t)body->segment_count, sizeof *links);
  if (!links || !take(&x, body, q, NULL, NULL)) {
    free(links);
    return KG_ERR_NO_MEMORY;
  }
  for (int c = 0; c < body->nv; c++) {
    x.a[c] = 1.0;
    move_all(links, body, x.q, x.v, x.a, 0.0);
    momentum_column(A, c, body, links);
    x.a[c] = 0.0;
  }
  free(links);
  free(x.q);
  return KG_OK;
}

kg_status kg_bench_reference_acceleration(const kg_body *body, double *p_ddot, double *alpha,
                                          const double *q, const double *v, const double *a)
{
  arguments x;
  link *links = calloc((size_t)body->segment_count, sizeof *links);
  if (!links || !take(&x, body, q, v, a)) {
    free(links);
    return KG_ERR_NO_MEMORY;
  }
  move_all(links, body, x.q, x.v, x.a, 0.0);
  for (int k = 0; k < 3 * body->segment_count; k++) {
    p_ddot[k] = (double)creall(links[k / 3].pp[k % 3]);
    alpha[k] = (double)creall(links[k / 3].ww[k % 3]);
  }
  free(links);
  free(x.q);
  return KG_OK;
}

kg_status kg_bench_reference_inverse(const kg_body *body, double *tau, const double *q,
                                     const double *v, const double *a)
{
  arguments x;
  if (!take(&x, body, q, v, a)) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_status status = inverse(body, x.tau, x.q, x.v, x.a, kg_bench_gravity);
  for (int k = 0; k < body->nv && status == KG_OK; k++) {
    tau[k] = (double)creall(x.tau[k]);
  }
  free(x.q);
  return status;
}

kg_status kg_bench_reference_mass(const kg_body *body, double *M, const double *q)
{
  arguments x;
  if (!take(&x, body, q, NULL, NULL)) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status = KG_OK;
  for (int c = 0; c < body->nv && status == KG_OK; c++) {
    x.a[c] = 1.0;
    status = inverse(body, x.tau, x.q, x.v, x.a, 0.0);
    x.a[c] = 0.0;
    for (int r = 0; r < body->nv && status == KG_OK; r++) {
      M[r * body->nv + c] = (double)creall(x.tau[r]);
    }
  }
  free(x.q);
  return status;
}

/* ---- solutions with M ------------------------------------------------------------------------ */

/* M in long double, its Cholesky factor in double, and room for a solution. */
typedef struct mass {
  int nv;
  real *M, *x, *rest;
  double *L, *step;
} mass;

static void mass_close(mass *m)
{
  free(m->M);
  free(m->L);
}

static kg_status mass_open(mass *m, const kg_body *body, const double *q)
{
  const size_t nv = (size_t)body->nv;
  arguments x;
  *m = (mass){.nv = body->nv,
              .M = malloc((nv * nv + 2 * nv) * sizeof *m->M),
              .L = malloc((nv * nv + nv) * sizeof *m->L)};
  if (!m->M || !m->L || !take(&x, body, q, NULL, NULL)) {
    mass_close(m);
    return KG_ERR_NO_MEMORY;
  }
  m->x = m->M + nv * nv;
  m->rest = m->x + nv;
  m->step = m->L + nv * nv;
  kg_status status = KG_OK;
  for (size_t c = 0; c < nv && status == KG_OK; c++) {
    x.a[c] = 1.0;
    status = inverse(body, x.tau, x.q, x.v, x.a, 0.0);
    x.a[c] = 0.0;
    for (size_t r = 0; r < nv; r++) {
      m->M[r * nv + c] = creall(x.tau[r]);
      m->L[r * nv + c] = (double)creall(x.tau[r]);
    }
  }
  free(x.q);
  if (status == KG_OK && !kg_dense_cholesky_factor(m->L, m->nv)) {
    status = KG_ERR_UNDEFINED;
  }
  if (status != KG_OK) {
    mass_close(m);
  }
  return status;
}

/* x with M x = b, for what rest holds on entry: b - M x is solved for in double and added, which
 * gains the digits of a double less those of the condition number each time. */
static void mass_solve(mass *m)
{
  const int nv = m->nv;
  real *b = m->rest;
  memset(m->x, 0, (size_t)nv * sizeof *m->x);
  for (int round = 0; round < 4; round++) {
    for (int k = 0; k < nv; k++) {
      m->step[k] = (double)b[k];
    }
    kg_dense_cholesky_solve(m->L, nv, m->step, 1);
    for (int r = 0; r < nv; r++) {
      m->x[r] += (real)m->step[r];
      for (int c = 0; c < nv; c++) {
        b[r] -= m->M[r * nv + c] * (real)m->step[c];
      }
    }
  }
}

kg_status kg_bench_reference_solve(const kg_body *body, double *x, const double *q)
{
  mass m;
  const kg_status status = mass_open(&m, body, q);
  if (status != KG_OK) {
    return status;
  }
  for (int k = 0; k < body->nv; k++) {
    m.rest[k] = (real)x[k];
  }
  mass_solve(&m);
  for (int k = 0; k < body->nv; k++) {
    x[k] = (double)m.x[k];
  }
  mass_close(&m);
  return KG_OK;
}

/* x = FD(q, v, tau) in m->x */
static kg_status forward(mass *m, const kg_body *body, const double *q, const double *v,
                         const double *tau)
{
  arguments x;
  if (!take(&x, body, q, v, NULL)) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_status status = inverse(body, x.tau, x.q, x.v, x.a, kg_bench_gravity);
  for (int k = 0; k < body->nv; k++) {
    m->rest[k] = (real)tau[k] - creall(x.tau[k]);
  }
  free(x.q);
  mass_solve(m);
  return status;
}

kg_status kg_bench_reference_forward(const kg_body *body, double *a, const double *q,
                                     const double *v, const double *tau)
{
  mass m;
  kg_status status = mass_open(&m, body, q);
  if (status != KG_OK) {
    return status;
  }
  status = forward(&m, body, q, v, tau);
  for (int k = 0; k < body->nv; k++) {
    a[k] = (double)m.x[k];
  }
  mass_close(&m);
  return status;
}

/* The pose with i h in direction k of the tangent space: q_i (1, i h e_k / 2). */
static void lean(number *q, int k, double h)
{
  if (k < 3) {
    q[k] += I * h;
    return;
  }
  number *r = q + 3 + 4 * ((k - 3) / 3);
  const number half = 0.5 * I * h;
  const number w = r[0], x = r[1], y = r[2], z = r[3];
  const number turned[3][4] = {{w - half * x, x + half * w, y + half * z, z - half * y},
                               {w - half * y, x - half * z, y + half * w, z + half * x},
                               {w - half * z, x + half * y, y - half * x, z + half * w}};
  memcpy(r, turned[k % 3], sizeof turned[0]);
}

kg_status kg_bench_reference_point(const kg_body *body, double *J, const double *q, kg_vec3 point)
{
  const double h = 1e-40;
  const number s[3] = {point.x, point.y, point.z};
  link *links = calloc((size_t)body->segment_count, sizeof *links);
  kg_status status = links ? KG_OK : KG_ERR_NO_MEMORY;
  for (int c = 0; c < body->nv && status == KG_OK; c++) {
    arguments x;
    number arm[3];
    if (!take(&x, body, q, NULL, NULL)) {
      status = KG_ERR_NO_MEMORY;
      break;
    }
    lean(x.q, c, h);
    move_all(links, body, x.q, x.v, x.a, 0.0);
    link *last = &links[body->segment_count - 1];
    rotate(arm, last->R, s);
    for (int r = 0; r < 3; r++) {
      J[r * body->nv + c] = (double)cimagl(last->p[r] + arm[r]) / h;
    }
    free(x.q);
  }
  free(links);
  return status;
}

/* Column c of dtau/dq (c < nv) or dtau/dv (c - nv) at x, in imaginary parts of x->tau over h. */
static kg_status derivative_column(const kg_body *body, arguments *x, int c, double h)
{
  const int nv = body->nv;
  if (c >= nv) {
    x->v[c - nv] += I * h;
    const kg_status status = inverse(body, x->tau, x->q, x->v, x->a, kg_bench_gravity);
    x->v[c - nv] = creall(x->v[c - nv]);
    return status;
  }
  number kept[4];
  number *moved = c < 3 ? x->q : x->q + 3 + 4 * ((c - 3) / 3);
  memcpy(kept, moved, sizeof kept);
  lean(x->q, c, h);
  const kg_status status = inverse(body, x->tau, x->q, x->v, x->a, kg_bench_gravity);
  memcpy(moved, kept, sizeof kept);
  return status;
}

static const double tiny = 1e-40;

kg_status kg_bench_reference_derivatives(const kg_body *body, double *dtau_dq, double *dtau_dv,
                                         const double *q, const double *v, const double *a)
{
  const int nv = body->nv;
  arguments x;
  if (!take(&x, body, q, v, a)) {
    return KG_ERR_NO_MEMORY;
  }
  kg_status status = KG_OK;
  for (int c = 0; c < 2 * nv && status == KG_OK; c++) {
    double *out = c < nv ? dtau_dq : dtau_dv;
    status = derivative_column(body, &x, c, tiny);
    for (int r = 0; r < nv && status == KG_OK; r++) {
      out[r * nv + c % nv] = (double)(cimagl(x.tau[r]) / tiny);
    }
  }
  free(x.q);
  return status;
}

/* From those of inverse dynamics at a: -M^-1 dID/dq, -M^-1 dID/dv, M^-1. */
static kg_status forward_columns(mass *m, const kg_body *body, arguments *x, double *const out[3])
{
  const int nv = body->nv;
  kg_status status = KG_OK;
  for (int c = 0; c < 3 * nv && status == KG_OK; c++) {
    if (c < 2 * nv) {
      status = derivative_column(body, x, c, tiny);
    }
    for (int r = 0; r < nv; r++) {
      m->rest[r] = c < 2 * nv ? -cimagl(x->tau[r]) / tiny : r == c % nv;
    }
    mass_solve(m);
    for (int r = 0; r < nv; r++) {
      out[c / nv][r * nv + c % nv] = (double)m->x[r];
    }
  }
  return status;
}

kg_status kg_bench_reference_forward_derivatives(const kg_body *body, double *da_dq, double *da_dv,
                                                 double *da_dtau, const double *q, const double *v,
                                                 const double *tau)
{
  mass m;
  arguments x;
  kg_status status = mass_open(&m, body, q);
  if (status != KG_OK) {
    return status;
  }
  status = take(&x, body, q, v, NULL) ? KG_OK : KG_ERR_NO_MEMORY;
  if (status == KG_OK) {
    double *const out[3] = {da_dq, da_dv, da_dtau};
    status = forward(&m, body, q, v, tau);
    for (int k = 0; k < body->nv; k++) {
      x.a[k] = m.x[k];
    }
    status = status == KG_OK ? forward_columns(&m, body, &x, out) : status;
    free(x.q);
  }
  mass_close(&m);
  return status;
}
