/* What a pose touches, and the derivatives of that; symbols in correction.h. */
#include "physics/correction.h"

#include <string.h>

void correction_pose_init(kg_correction *c, kg_arena *arena)
{
  near_points_init(&c->near_points, c->def.body, arena);
  c->hints = KG_ARENA_ARRAY(arena, kg_scene_hint, c->def.body->point_count);
  c->touches = KG_ARENA_ARRAY(arena, touch, c->key_count);
  c->self_touches = KG_ARENA_ARRAY(arena, kg_self_touch, c->def.body->point_count);
}

/* ---- penetration -------------------------------------------------------------------------------*/

/* A distance into the sums of the pose */
static void count_depth(kg_correction *c, double phi)
{
  if (phi < 0.0) {
    c->sum_depth -= phi;
    c->L_coll += phi * phi;
  }
  c->lowest = phi < c->lowest || isnan(phi) ? phi : c->lowest;
}

static void measure_points(kg_correction *c, const segment_ball *ball, kg_vec3 shift)
{
  const kg_vec3 p = kg_vec3_add(c->p[ball->segment], shift);
  for (int k = ball->first; k < ball->first + ball->count; k++) {
    touch *t = &c->touches[c->touch_count];
    t->point = c->near_points.points[k];
    t->x = kg_vec3_add(p, kg_mat3_mul_vec(c->R[ball->segment], c->def.body->points[t->point].p));
    t->at = kg_scene_distance_from(c->def.scene, t->x, &c->hints[t->point]);
    t->key = t->point;
    t->other = -1;
    const double phi = t->at.distance;
    count_depth(c, phi);
    if (!(phi > c->near + fmax(-c->lowest, 0.0))) c->touch_count++;
  }
}

void correction_measure(kg_correction *c, kg_vec3 shift)
{
  near_points *near = &c->near_points;
  const bool defined = near_points_sort(near, c->def.scene, c->p, c->R, shift);
  c->touch_count = 0;
  c->sum_depth = c->L_coll = 0.0;
  c->lowest = INFINITY;
  for (int b = 0; b < near->count && defined && !isnan(c->lowest); b++) {
    const double wanted = fmax(c->lowest, c->near + fmax(-c->lowest, 0.0));
    if (near->balls[b].bound > wanted) break;
    measure_points(c, &near->balls[b], shift);
  }
  if (!defined) c->lowest = NAN;
  c->d_pen = isnan(c->lowest) ? NAN : fmax(-c->lowest, 0.0);
}

/* The same of the body against itself, beside the touches of the scene */
static void measure_self(kg_correction *c)
{
  const int points = c->def.body->point_count;
  const int count =
    kg_self_sample(c->self, c->p, c->R, c->near + fmax(-c->lowest, 0.0), c->self_touches);
  for (int k = 0; k < count; k++) {
    const kg_self_touch *t = &c->self_touches[k];
    c->touches[c->touch_count++] = (touch){.point = t->point,
                                           .key = points + t->point,
                                           .other = t->segment,
                                           .x = t->x,
                                           .at = {.distance = t->distance, .normal = t->normal}};
    count_depth(c, t->distance);
  }
  c->d_pen = isnan(c->lowest) ? NAN : fmax(-c->lowest, 0.0);
}

void correction_sample(kg_correction *c, const double *q)
{
  kg_dynamics_pose(c->dynamics, q, c->p, c->R);
  correction_measure(c, kg_vec3_make(0.0, 0.0, 0.0));
  if (c->self && !isnan(c->lowest)) measure_self(c);
}

void correction_go_to(kg_correction *c, const double *D)
{
  kg_body_integrate(c->def.body, c->q_now, c->q0, D);
  correction_sample(c, c->q_now);
}

/* ---- first derivatives -------------------------------------------------------------------------*/

/* Forces at the points, summed from the leaves to the root; the moment about a joint is the entry
 * of its rotation, in segment axes. */
static void clear_forces(kg_correction *c)
{
  const size_t n = (size_t)c->def.body->segment_count;
  memset(c->f, 0, n * sizeof *c->f);
  memset(c->moment, 0, n * sizeof *c->moment);
}

static void add_force(kg_correction *c, int segment, kg_vec3 x, kg_vec3 f)
{
  c->f[segment] = kg_vec3_add(c->f[segment], f);
  c->moment[segment] = kg_vec3_add(c->moment[segment], kg_vec3_cross(kg_vec3_sub(x, c->p[0]), f));
}

static void sum_forces(kg_correction *c, double *tau)
{
  for (int i = c->def.body->segment_count - 1; i >= 0; i--) {
    const kg_vec3 arm = kg_vec3_sub(c->p[i], c->p[0]);
    const kg_vec3 about_joint = kg_vec3_sub(c->moment[i], kg_vec3_cross(arm, c->f[i]));
    kg_store3(tau + 3 + 3 * i, kg_mat3_mul_vec_t(c->R[i], about_joint));
    const int parent = c->def.body->segments[i].parent;
    if (parent >= 0) {
      c->f[parent] = kg_vec3_add(c->f[parent], c->f[i]);
      c->moment[parent] = kg_vec3_add(c->moment[parent], c->moment[i]);
    }
  }
  kg_store3(tau, c->f[0]);
}

/* grad L_coll = sum -2 max(-Phi, 0) J' n */
void correction_loss_gradient(kg_correction *c, double *gradient)
{
  clear_forces(c);
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    if (!(t->at.distance < 0.0)) continue;
    const kg_vec3 f = kg_vec3_scale(2.0 * t->at.distance, t->at.normal);
    add_force(c, c->def.body->points[t->point].segment, t->x, f);
    if (t->other >= 0) add_force(c, t->other, t->x, kg_vec3_scale(-1.0, f));
  }
  sum_forces(c, gradient);
}

static void add_to3(double *row, kg_vec3 a)
{
  kg_store3(row, kg_vec3_add(kg_load3(row), a));
}

/* row += J' n: along the chain from the segment of x to the root */
static void add_chain(const kg_correction *c, int segment, kg_vec3 x, kg_vec3 n, double *row)
{
  add_to3(row, n);
  for (int i = segment; i >= 0; i = c->def.body->segments[i].parent) {
    const kg_vec3 moment = kg_vec3_cross(kg_vec3_sub(x, c->p[i]), n);
    add_to3(row + 3 + 3 * i, kg_mat3_mul_vec_t(c->R[i], moment));
  }
}

void correction_row(const kg_correction *c, const touch *t, double *row)
{
  memset(row, 0, (size_t)c->nv * sizeof *row);
  add_chain(c, c->def.body->points[t->point].segment, t->x, t->at.normal, row);
  /* above the joint that both segments hang from the two cancel to the last bit */
  if (t->other >= 0) add_chain(c, t->other, t->x, kg_vec3_scale(-1.0, t->at.normal), row);
}

void correction_tangents(kg_correction *c, const double *D)
{
  for (int i = 0; i < c->def.body->segment_count; i++) {
    c->Jr[i] = kg_so3_right_jacobian(kg_load3(D + 3 + 3 * i));
  }
}

/* d/dD of q0 (+) D: every rotation's entry times the right Jacobian at D, [SOLA] (143) in quat.h */
void correction_to_move(const kg_correction *c, double *row)
{
  for (int i = 0; i < c->def.body->segment_count; i++) {
    double *r = row + 3 + 3 * i;
    if (r[0] != 0.0 || r[1] != 0.0 || r[2] != 0.0) {
      kg_store3(r, kg_mat3_mul_vec_t(c->Jr[i], kg_load3(r)));
    }
  }
}

/* ---- second derivatives ------------------------------------------------------------------------*/

/* d/dr (Jr(r)' g) at g held, with Jr(r)' g = g + b r x g + c r x (r x g): b = (1 - cos a) / a^2,
 * c = (a - sin a) / a^3, a = |r|, and db/dr = b1 r, dc/dr = c1 r */
static kg_mat3 tangent_bend(kg_vec3 r, kg_vec3 g)
{
  const double a2 = kg_vec3_dot(r, r);
  double b, c, b1, c1;
  if (a2 < 0.04) { /* the next terms are below 1e-17 */
    b = 1.0 / 2 - a2 * (1.0 / 24 - a2 * (1.0 / 720 - a2 * (1.0 / 40320 - a2 / 3628800)));
    c = 1.0 / 6 - a2 * (1.0 / 120 - a2 * (1.0 / 5040 - a2 * (1.0 / 362880 - a2 / 39916800)));
    b1 = -1.0 / 12 + a2 * (1.0 / 180 - a2 * (1.0 / 6720 - a2 * (1.0 / 453600 - a2 / 47900160)));
    c1 = -1.0 / 60 + a2 * (1.0 / 1260 - a2 * (1.0 / 60480 - a2 * (1.0 / 4989600 - a2 / 622702080)));
  } else {
    const double a = sqrt(a2), s = sin(a), half = sin(0.5 * a);
    b = 2.0 * half * half / a2;
    c = (a - s) / (a2 * a);
    b1 = (s / a - 2.0 * b) / a2;
    c1 = (b - 3.0 * c) / a2;
  }
  const kg_vec3 rg = kg_vec3_cross(r, g), rrg = kg_vec3_cross(r, rg);
  /* d(r x g) = -[g] dr;  d(r x (r x g)) = (r g' + (r . g) 1 - 2 g r') dr */
  kg_mat3 T = kg_mat3_scale(-b, kg_mat3_skew(g));
  kg_mat3 U = kg_mat3_add(kg_mat3_outer(r, g), kg_mat3_scale(-2.0, kg_mat3_outer(g, r)));
  U = kg_mat3_add(U, kg_mat3_scale(kg_vec3_dot(r, g), kg_mat3_identity()));
  T = kg_mat3_add(T, kg_mat3_scale(c, U));
  T = kg_mat3_add(T, kg_mat3_scale(b1, kg_mat3_outer(rg, r)));
  return kg_mat3_add(T, kg_mat3_scale(c1, kg_mat3_outer(rrg, r)));
}

static void add_block(double *C, int nv, int i, int j, kg_mat3 block)
{
  for (int a = 0; a < 3; a++) {
    for (int b = 0; b < 3; b++) {
      C[(size_t)(3 + 3 * i + a) * (size_t)nv + (size_t)(3 + 3 * j + b)] += block.m[3 * a + b];
    }
  }
}

/* The part of held forces f at the points: for j on the path from i to the root
 *   d/d(delta_j) of R_i' sum (x - p_i) x f  =  R_i' (B_i' - tr B_i) R_j,   B_i = sum (x - p_i) f'  (26)
 * and what the right Jacobians change with D. Lower blocks (i, j <= i). */
static void add_chain_bend(kg_correction *c, double *C)
{
  const kg_body *body = c->def.body;
  for (int i = body->segment_count - 1; i >= 0; i--) {
    const kg_vec3 arm = kg_vec3_sub(c->p[i], c->p[0]);
    kg_mat3 B = kg_mat3_add(c->virial[i], kg_mat3_scale(-1.0, kg_mat3_outer(arm, c->f[i])));
    const kg_vec3 g =
      kg_mat3_mul_vec_t(c->R[i], kg_vec3_sub(c->moment[i], kg_vec3_cross(arm, c->f[i])));
    const double trace = B.m[0] + B.m[4] + B.m[8];
    B = kg_mat3_add(kg_mat3_transposed(B), kg_mat3_scale(-trace, kg_mat3_identity()));
    const kg_mat3 left = kg_mat3_mul(kg_mat3_transposed(kg_mat3_mul(c->R[i], c->Jr[i])), B);
    for (int j = i; j >= 0; j = body->segments[j].parent) {
      add_block(C, c->nv, i, j, kg_mat3_mul(left, kg_mat3_mul(c->R[j], c->Jr[j])));
    }
    add_block(C, c->nv, i, i, tangent_bend(kg_load3(c->D + 3 + 3 * i), g));
    const int parent = body->segments[i].parent;
    if (parent >= 0) {
      c->f[parent] = kg_vec3_add(c->f[parent], c->f[i]);
      c->moment[parent] = kg_vec3_add(c->moment[parent], c->moment[i]);
      c->virial[parent] = kg_mat3_add(c->virial[parent], c->virial[i]);
    }
  }
}

/* multiplier J' H J of a touch: columns of J are along the path to the root, by D. Lower blocks. */
static void add_surface_bend(kg_correction *c, const touch *t, double multiplier, double *C)
{
  const kg_mat3 mH = kg_mat3_scale(multiplier, kg_sdf_hessian(&t->at));
  const int segment = c->def.body->points[t->point].segment;
  for (int i = segment; i >= -1; i = i < 0 ? -2 : c->def.body->segments[i].parent) {
    /* column of joint i: -[x - p_i] R_i Jr_i; of the root's position (block -1): 1 */
    kg_mat3 left = mH;
    if (i >= 0) {
      const kg_mat3 J =
        kg_mat3_mul(kg_mat3_skew(kg_vec3_sub(c->p[i], t->x)), kg_mat3_mul(c->R[i], c->Jr[i]));
      left = kg_mat3_mul(kg_mat3_transposed(J), mH);
    }
    for (int j = i; j >= -1; j = j < 0 ? -2 : c->def.body->segments[j].parent) {
      kg_mat3 block = left;
      if (j >= 0) {
        block = kg_mat3_mul(left, kg_mat3_mul(kg_mat3_skew(kg_vec3_sub(c->p[j], t->x)),
                                              kg_mat3_mul(c->R[j], c->Jr[j])));
      }
      add_block(C, c->nv, i, j, block);
    }
  }
}

void correction_curvature(kg_correction *c, const double *multiplier, double *C)
{
  const int nv = c->nv, n = c->def.body->segment_count;
  memset(C, 0, (size_t)nv * (size_t)nv * sizeof *C);
  memset(c->virial, 0, (size_t)n * sizeof *c->virial);
  clear_forces(c);
  for (int k = 0; k < c->touch_count; k++) {
    const touch *t = &c->touches[k];
    const double l = multiplier[t->key];
    if (l == 0.0 || t->other >= 0) continue;
    const int segment = c->def.body->points[t->point].segment;
    const kg_vec3 f = kg_vec3_scale(l, t->at.normal);
    add_force(c, segment, t->x, f);
    c->virial[segment] =
      kg_mat3_add(c->virial[segment], kg_mat3_outer(kg_vec3_sub(t->x, c->p[0]), f));
    if (!kg_sdf_is_flat(&t->at)) add_surface_bend(c, t, l, C);
  }
  add_chain_bend(c, C);
  /* blocks (i, j) with j <= i are there; a diagonal block is symmetric up to rounding */
  for (int i = 0; i < nv; i++) {
    for (int j = 0; j < i; j++) {
      double *low = &C[(size_t)i * (size_t)nv + (size_t)j],
             *high = &C[(size_t)j * (size_t)nv + (size_t)i];
      *low = i / 3 == j / 3 ? 0.5 * (*low + *high) : *low;
      *high = *low;
    }
  }
}

void correction_times_mass(const kg_correction *c, const double *a, double *out)
{
  for (int i = 0; i < c->nv; i++) {
    out[i] = correction_dot(c->M + (size_t)i * (size_t)c->nv, a, c->nv);
  }
}

double correction_metric(const kg_correction *c, const double *a, const double *b)
{
  double sum = 0.0;
  for (int i = 0; i < c->nv; i++) {
    sum += a[i] * correction_dot(c->M + (size_t)i * (size_t)c->nv, b, c->nv);
  }
  return sum;
}
