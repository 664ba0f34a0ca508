/* Augmented Lagrangian on Ceres; the contract is in least_reference.h.
 *
 * Residuals: L' D with M = L L', and sqrt(rho) max(0, lambda_k / rho - Phi_k); after every round
 * lambda_k = max(0, lambda_k - rho Phi_k) (Nocedal and Wright, Numerical Optimization, 2006, section
 * 17.4). */
#include "bench/correction/least_reference.h"

#include "kinegrad/arena.h"
#include "kinegrad/ceres.h"
#include "kinegrad/dense.h"

#include <string.h>

enum { ROUNDS = 20, STEPS_A_ROUND = 60 };

struct least_reference {
  const kg_body *body;
  const kg_scene *scene;
  kg_dynamics *dynamics;
  kg_arena arena;
  const double *q0;
  double *M, *factor;  /* (nv, nv); factor: lower   */
  double *q, *J, *row; /* (nq), (3, nv), (nv)       */
  double *lambda, *phi;
  kg_vec3 *x, *normal, *p;
  kg_mat3 *R;
  double rho;
};

least_reference *least_reference_create(const kg_body *body, const kg_scene *scene)
{
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  least_reference *r = KG_ARENA_ARRAY(&arena, least_reference, 1);
  if (!r) return NULL;
  const int nv = body->nv, K = body->point_count, n = body->segment_count;
  *r = (least_reference){.body = body, .scene = scene};
  r->M = KG_ARENA_ARRAY(&arena, double, nv *nv);
  r->factor = KG_ARENA_ARRAY(&arena, double, nv *nv);
  r->q = KG_ARENA_ARRAY(&arena, double, body->nq);
  r->J = KG_ARENA_ARRAY(&arena, double, 3 * nv);
  r->row = KG_ARENA_ARRAY(&arena, double, nv);
  r->lambda = KG_ARENA_ARRAY(&arena, double, K);
  r->phi = KG_ARENA_ARRAY(&arena, double, K);
  r->x = KG_ARENA_ARRAY(&arena, kg_vec3, K);
  r->normal = KG_ARENA_ARRAY(&arena, kg_vec3, K);
  r->p = KG_ARENA_ARRAY(&arena, kg_vec3, n);
  r->R = KG_ARENA_ARRAY(&arena, kg_mat3, n);
  if (kg_arena_failed(&arena) || kg_dynamics_create(&r->dynamics, body, NULL) != KG_OK) {
    kg_arena_release(&arena);
    return NULL;
  }
  r->arena = arena;
  return r;
}

void least_reference_destroy(least_reference *reference)
{
  if (reference) {
    kg_dynamics_destroy(reference->dynamics);
    kg_arena arena = reference->arena; /* the object lives in its own arena */
    kg_arena_release(&arena);
  }
}

static void measure(least_reference *r, const double *D)
{
  kg_body_integrate(r->body, r->q, r->q0, D);
  kg_dynamics_pose(r->dynamics, r->q, r->p, r->R);
  for (int k = 0; k < r->body->point_count; k++) {
    const kg_body_point *point = &r->body->points[k];
    r->x[k] = kg_vec3_add(r->p[point->segment], kg_mat3_mul_vec(r->R[point->segment], point->p));
    const kg_sdf_value v = kg_scene_distance(r->scene, r->x[k]);
    r->phi[k] = v.distance;
    r->normal[k] = v.normal;
  }
}

static double wanting(const least_reference *r, int k)
{
  return fmax(0.0, r->lambda[k] / r->rho - r->phi[k]);
}

static bool residual(double *out, const double *D, void *user)
{
  least_reference *r = user;
  const int nv = r->body->nv;
  for (int j = 0; j < nv; j++) { /* L' D */
    out[j] = 0.0;
    for (int i = j; i < nv; i++) {
      out[j] += r->factor[i * nv + j] * D[i];
    }
  }
  measure(r, D);
  for (int k = 0; k < r->body->point_count; k++) {
    out[nv + k] = sqrt(r->rho) * wanting(r, k);
  }
  return true;
}

/* row = n' J of point k by D: through the general Jacobian of a point and the right Jacobians */
static void constraint_row(least_reference *r, int k, const double *D)
{
  const int nv = r->body->nv;
  (void)kg_dynamics_point(r->dynamics, r->J, r->q, r->body->points[k]);
  const kg_vec3 n = r->normal[k];
  for (int i = 0; i < nv; i++) {
    r->row[i] = n.x * r->J[i] + n.y * r->J[nv + i] + n.z * r->J[2 * nv + i];
  }
  for (int i = 3; i < nv; i += 3) {
    const kg_mat3 Jr = kg_so3_right_jacobian(kg_vec3_make(D[i], D[i + 1], D[i + 2]));
    const kg_vec3 g = kg_mat3_mul_vec_t(Jr, kg_vec3_make(r->row[i], r->row[i + 1], r->row[i + 2]));
    r->row[i] = g.x;
    r->row[i + 1] = g.y;
    r->row[i + 2] = g.z;
  }
}

static bool jacobian(double *J, const double *D, void *user)
{
  least_reference *r = user;
  const int nv = r->body->nv;
  memset(J, 0, (size_t)(nv + r->body->point_count) * (size_t)nv * sizeof *J);
  for (int j = 0; j < nv; j++) {
    for (int i = j; i < nv; i++) {
      J[j * nv + i] = r->factor[i * nv + j];
    }
  }
  measure(r, D);
  for (int k = 0; k < r->body->point_count; k++) {
    if (!(wanting(r, k) > 0.0)) continue;
    constraint_row(r, k, D);
    for (int i = 0; i < nv; i++) {
      J[(nv + k) * nv + i] = -sqrt(r->rho) * r->row[i];
    }
  }
  return true;
}

double least_reference_move(least_reference *reference, const double *q0, double *D, double *depth)
{
  least_reference *r = reference;
  const int nv = r->body->nv, K = r->body->point_count;
  r->q0 = q0;
  kg_dynamics_mass_matrix(r->dynamics, r->M, q0);
  memcpy(r->factor, r->M, (size_t)nv * (size_t)nv * sizeof *r->M);
  if (!kg_dense_cholesky_factor(r->factor, nv)) return NAN;
  memset(r->lambda, 0, (size_t)K * sizeof *r->lambda);
  r->rho = 1e4;
  for (int round = 0; round < ROUNDS; round++) {
    kg_ceres_def def = kg_ceres_default_def(nv, nv + K);
    kg_ceres_report report;
    def.residual = residual;
    def.jacobian = jacobian;
    def.user = r;
    def.max_iterations = STEPS_A_ROUND;
    def.function_tolerance = 1e-12;
    if (kg_ceres_minimize(&def, D, &report) != KG_OK) return NAN;
    measure(r, D);
    *depth = 0.0;
    for (int k = 0; k < K; k++) {
      r->lambda[k] = fmax(0.0, r->lambda[k] - r->rho * r->phi[k]);
      *depth = fmax(*depth, -r->phi[k]);
    }
    if (*depth < 1e-6) break;
    r->rho = fmin(2.0 * r->rho, 1e6);
  }
  double sum = 0.0;
  for (int i = 0; i < nv; i++) {
    for (int j = 0; j < nv; j++) {
      sum += D[i] * r->M[i * nv + j] * D[j];
    }
  }
  return sqrt(sum);
}
