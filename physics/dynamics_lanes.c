/* Kinematics and dynamics of eight frames at once, and of many frames by eights. */
#include "kinegrad/dynamics_lanes.h"

#include "physics/kernels/kernels.h"
#include "physics/physics.h"
#include "physics/tree.h"

#include <math.h>
#include <string.h>

/* low and up as in kernels/tree_numbers.inc. M is symmetric and has no upper blocks. */
struct kg_lanes_matrix {
  const kg_dynamics *dynamics;
  double *low, *up;
  bool symmetric, factored;
  kg_arena arena;
};

/* ---- matrices ---------------------------------------------------------------------------------*/

kg_status kg_lanes_matrix_create(kg_lanes_matrix **matrix, const kg_dynamics *dynamics,
                                 const kg_allocator *allocator)
{
  *matrix = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  const size_t numbers = (size_t)dynamics->tree.entries * 72;
  kg_lanes_matrix *m = KG_ARENA_ARRAY(&arena, kg_lanes_matrix, 1);
  const kg_lanes_matrix made = {.dynamics = dynamics,
                                .low = KG_ARENA_ARRAY(&arena, double, numbers),
                                .up = KG_ARENA_ARRAY(&arena, double, numbers)};
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  *m = made;
  m->arena = arena;
  *matrix = m;
  return KG_OK;
}

void kg_lanes_matrix_destroy(kg_lanes_matrix *matrix)
{
  if (matrix) {
    kg_arena arena = matrix->arena; /* the arena holds the object itself */
    kg_arena_release(&arena);
  }
}

const double *kg_lanes_matrix_block(const kg_lanes_matrix *matrix, int row, int column)
{
  const kg_tree *tree = &matrix->dynamics->tree;
  KG_ASSERT(row >= 0 && row < tree->blocks && column >= 0 && column < tree->blocks);
  if (kg_tree_is_above(tree, column, row)) {
    return matrix->low + 72 * (size_t)(tree->start[row] + tree->depth[column]);
  }
  if (!matrix->symmetric && kg_tree_is_above(tree, row, column)) {
    return matrix->up + 72 * (size_t)(tree->start[column] + tree->depth[row]);
  }
  return NULL;
}

/* Blocks (b, path) and (path, b) of a frame. */
static void scatter_row(const kg_lanes_matrix *m, int b, int frame, double *out)
{
  const kg_tree *tree = &m->dynamics->tree;
  const size_t nv = (size_t)(3 * tree->blocks);
  for (int k = 0; k <= tree->depth[b]; k++) {
    const int a = tree->path[tree->start[b] + k];
    const size_t at = 72 * (size_t)(tree->start[b] + k) + (size_t)frame;
    for (int e = 0; e < 9; e++) {
      const size_t r = (size_t)(e / 3), c = (size_t)(e % 3), A = 3 * (size_t)a, B = 3 * (size_t)b;
      const double low = m->low[at + 8 * (size_t)e];
      out[(B + r) * nv + A + c] = low;
      if (k < tree->depth[b] && m->symmetric) {
        out[(A + c) * nv + B + r] = low;
      } else if (k < tree->depth[b]) {
        out[(A + r) * nv + B + c] = m->up[at + 8 * (size_t)e];
      }
    }
  }
}

void kg_lanes_matrix_dense(const kg_lanes_matrix *matrix, int frame, double *out)
{
  KG_ASSERT(frame >= 0 && frame < 8 && !matrix->factored);
  const kg_tree *tree = &matrix->dynamics->tree;
  memset(out, 0, (size_t)(9 * tree->blocks) * (size_t)tree->blocks * sizeof *out);
  for (int b = 0; b < tree->blocks; b++) {
    scatter_row(matrix, b, frame, out);
  }
}

/* A pivot that is no inertia: its inverse has a diagonal that is not positive or not finite. */
static unsigned irregular_frames(const kg_lanes_matrix *m)
{
  const kg_tree *tree = &m->dynamics->tree;
  unsigned irregular = 0;
  for (int b = 0; b < tree->blocks; b++) {
    const double *pivot = m->low + 72 * (size_t)(tree->start[b] + tree->depth[b]);
    for (int k = 0; k < 24; k++) {
      const double d = pivot[8 * (k / 8 * 4) + k % 8];
      irregular |= d > 0.0 && isfinite(d) ? 0u : 1u << (k % 8);
    }
  }
  return irregular;
}

unsigned kg_lanes_matrix_factor(kg_lanes_matrix *matrix)
{
  KG_ASSERT(matrix->symmetric && !matrix->factored);
  const kg_dynamics *d = matrix->dynamics;
  d->kernels->eight->factor(&d->tree, matrix->low);
  matrix->factored = true;
  return irregular_frames(matrix);
}

void kg_lanes_matrix_solve(const kg_lanes_matrix *matrix, double *x)
{
  KG_ASSERT(matrix->factored);
  const kg_dynamics *d = matrix->dynamics;
  d->kernels->eight->factor_solve(&d->tree, matrix->low, x);
}

/* ---- eight frames -----------------------------------------------------------------------------*/

void kg_dynamics_inverse_lanes(kg_dynamics *dynamics, double *tau, const double *q, const double *v,
                               const double *a)
{
  dynamics->kernels->eight->inverse(dynamics->model, tau, q, v, a);
}

void kg_dynamics_forward_lanes(kg_dynamics *dynamics, double *a, const double *q, const double *v,
                               const double *tau)
{
  dynamics->kernels->eight->forward(dynamics->model, a, q, v, tau);
}

void kg_dynamics_mass_solve_lanes(kg_dynamics *dynamics, double *x, const double *q)
{
  dynamics->kernels->eight->mass_solve(dynamics->model, x, q, NULL, x);
}

/* count numbers of eight frames out of the motion; NULL: not wanted */
static void copy_motion(const kg_dynamics *d, double *out, int from, int count)
{
  if (out) {
    memcpy(out, d->motion + 8 * from, 8 * (size_t)count * sizeof *out);
  }
}

void kg_dynamics_velocity_lanes(kg_dynamics *dynamics, const double *q, const double *v, double *p,
                                double *R, double *p_dot, double *w)
{
  KG_ASSERT(v || (!p_dot && !w));
  kg_dynamics *d = dynamics;
  const int n = d->n;
  d->kernels->eight->kinematics(d->model, d->motion, q, p_dot || w ? v : NULL, NULL);
  copy_motion(d, p, 0, 3 * n);
  copy_motion(d, R, 3 * n, 9 * n);
  copy_motion(d, p_dot, 12 * n, 3 * n);
  copy_motion(d, w, 15 * n, 3 * n);
}

void kg_dynamics_acceleration_lanes(kg_dynamics *dynamics, const double *q, const double *v,
                                    const double *a, double *p_ddot, double *alpha)
{
  kg_dynamics *d = dynamics;
  d->kernels->eight->acceleration(d->model, d->motion, q, v, a);
  copy_motion(d, p_ddot, 0, 3 * d->n);
  copy_motion(d, alpha, 3 * d->n, 3 * d->n);
}

void kg_dynamics_centroid_lanes(kg_dynamics *dynamics, kg_centroid_lanes *centroid, const double *q,
                                const double *v)
{
  kg_dynamics *d = dynamics;
  d->kernels->eight->centroid(d->model, d->motion, q, v, NULL);
  centroid->mass = kg_links_mass(d);
  copy_motion(d, centroid->com, 0, 3);
  copy_motion(d, centroid->com_dot, 3, 3);
  copy_motion(d, centroid->L, 6, 3);
  copy_motion(d, centroid->I, 9, 9);
}

void kg_dynamics_centroidal_matrix_lanes(kg_dynamics *dynamics, double *A, const double *q)
{
  dynamics->kernels->eight->centroidal_matrix(dynamics->model, A, q, NULL, NULL);
}

void kg_dynamics_point_lanes(kg_dynamics *dynamics, double *x, double *J, const double *q,
                             kg_body_point point)
{
  KG_ASSERT(point.segment >= 0 && point.segment < dynamics->n);
  const double s[3] = {point.p.x, point.p.y, point.p.z};
  dynamics->kernels->eight->point(dynamics->model, x, J, q, point.segment, s);
}

static void set_kind(kg_lanes_matrix *matrix, bool symmetric)
{
  if (matrix) {
    matrix->symmetric = symmetric;
    matrix->factored = false;
  }
}

void kg_dynamics_mass_matrix_lanes(kg_dynamics *dynamics, kg_lanes_matrix *M, const double *q)
{
  KG_ASSERT(M->dynamics->body == dynamics->body);
  dynamics->kernels->eight->mass_matrix(dynamics->model, &dynamics->tree, M->low, q);
  set_kind(M, true);
}

void kg_dynamics_inverse_derivatives_lanes(kg_dynamics *dynamics, kg_lanes_matrix *dtau_dq,
                                           kg_lanes_matrix *dtau_dv, kg_lanes_matrix *M,
                                           double *tau, const double *q, const double *v,
                                           const double *a)
{
  kg_dynamics *d = dynamics;
  KG_ASSERT(!dtau_dq || dtau_dq->dynamics->body == d->body);
  KG_ASSERT(!dtau_dv || dtau_dv->dynamics->body == d->body);
  KG_ASSERT(!M || M->dynamics->body == d->body);
  const kg_lanes_outputs out = {dtau_dq ? dtau_dq->low : NULL, dtau_dq ? dtau_dq->up : NULL,
                                dtau_dv ? dtau_dv->low : NULL, dtau_dv ? dtau_dv->up : NULL,
                                M ? M->low : NULL};
  d->kernels->eight->inverse_derivatives(d->model, &d->tree, &out, q, v, a);
  set_kind(dtau_dq, false);
  set_kind(dtau_dv, false);
  set_kind(M, true);
  if (tau) {
    kg_dynamics_inverse_lanes(d, tau, q, v, a);
  }
}

void kg_dynamics_forward_derivatives_lanes(kg_dynamics *dynamics, double *da_dq, double *da_dv,
                                           double *da_dtau, double *a, const double *q,
                                           const double *v, const double *tau)
{
  kg_dynamics *d = dynamics;
  const kg_lanes_dense out = {da_dq, da_dv, da_dtau};
  double *forward = d->lanes[3];
  kg_dynamics_forward_lanes(d, forward, q, v, tau);
  d->kernels->eight->forward_derivatives(d->model, &d->tree, &out, q, v, forward, tau);
  if (a) {
    memcpy(a, forward, 8 * (size_t)d->body->nv * sizeof *a);
  }
}

/* ---- frames one after the other ---------------------------------------------------------------*/

/* Eight frames of width numbers; the lanes left over repeat the last frame. */
static void load_lanes(const kg_dynamics *d, double *lanes, const double *rows, int width,
                       int frames)
{
  const double *row[8];
  for (int f = 0; f < 8; f++) {
    row[f] = rows + (size_t)(f < frames ? f : frames - 1) * (size_t)width;
  }
  d->kernels->to_lanes(lanes, row, width);
}

/* Lanes that repeat a frame go nowhere. */
static void store_lanes(const kg_dynamics *d, double *rows, const double *lanes, int width,
                        int frames)
{
  double *row[8];
  for (int f = 0; f < 8; f++) {
    row[f] = f < frames ? rows + (size_t)f * (size_t)width : d->spare;
  }
  d->kernels->from_lanes(row, lanes, width);
}

/* Eight at a time, the last ones singly when they are few. */
static void run_many(kg_dynamics *d, kg_frame_kernel *one, kg_frame_kernel *eight, int count,
                     double *out, const double *q, const double *x, const double *y)
{
  const int nq = d->body->nq, nv = d->body->nv;
  for (int first = 0; first < count;) {
    const int left = count - first;
    const size_t at_q = (size_t)first * (size_t)nq, at_v = (size_t)first * (size_t)nv;
    if (left < 3) {
      one(d->model, out + at_v, q + at_q, x + at_v, y + at_v);
      first++;
      continue;
    }
    const int frames = left < 8 ? left : 8;
    load_lanes(d, d->lanes[0], q + at_q, nq, frames);
    load_lanes(d, d->lanes[1], x + at_v, nv, frames);
    load_lanes(d, d->lanes[2], y + at_v, nv, frames);
    eight(d->model, d->lanes[3], d->lanes[0], d->lanes[1], d->lanes[2]);
    store_lanes(d, out + at_v, d->lanes[3], nv, frames);
    first += frames;
  }
}

void kg_dynamics_inverse_many(kg_dynamics *dynamics, int count, double *tau, const double *q,
                              const double *v, const double *a)
{
  const kg_physics_kernels *k = dynamics->kernels;
  run_many(dynamics, kg_inverse_of_one(k), k->eight->inverse, count, tau, q, v, a);
}

void kg_dynamics_forward_many(kg_dynamics *dynamics, int count, double *a, const double *q,
                              const double *v, const double *tau)
{
  const kg_physics_kernels *k = dynamics->kernels;
  run_many(dynamics, k->one->forward, k->eight->forward, count, a, q, v, tau);
}

/* One output of up to eight frames, width numbers a frame, from its place in the lanes. */
static void store_motion(const kg_dynamics *d, void *out, int first, int frames, int from,
                         int width)
{
  if (out) {
    store_lanes(d, (double *)out + (size_t)first * (size_t)width, d->motion + 8 * from, width,
                frames);
  }
}

void kg_dynamics_velocity_many(kg_dynamics *dynamics, int count, const double *q, const double *v,
                               kg_vec3 *p, kg_mat3 *R, kg_vec3 *p_dot, kg_vec3 *w)
{
  KG_ASSERT(v || (!p_dot && !w));
  kg_dynamics *d = dynamics;
  const int n = d->n, nq = d->body->nq, nv = d->body->nv;
  const bool moving = p_dot || w;
  int first = 0;
  for (; count - first >= 3; first += 8) {
    const int frames = count - first < 8 ? count - first : 8;
    load_lanes(d, d->lanes[0], q + (size_t)first * (size_t)nq, nq, frames);
    if (moving) {
      load_lanes(d, d->lanes[1], v + (size_t)first * (size_t)nv, nv, frames);
    }
    d->kernels->eight->kinematics(d->model, d->motion, d->lanes[0], moving ? d->lanes[1] : NULL,
                                  NULL);
    store_motion(d, p, first, frames, 0, 3 * n);
    store_motion(d, R, first, frames, 3 * n, 9 * n);
    store_motion(d, p_dot, first, frames, 12 * n, 3 * n);
    store_motion(d, w, first, frames, 15 * n, 3 * n);
  }
  for (; first < count; first++) {
    const size_t at = (size_t)first * (size_t)n;
    kg_dynamics_velocity(d, q + (size_t)first * (size_t)nq, v ? v + (size_t)first * (size_t)nv : v,
                         p ? p + at : p, R ? R + at : R, p_dot ? p_dot + at : p_dot,
                         w ? w + at : w);
  }
}
