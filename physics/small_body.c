/* The body as the small problem sees it: which points may touch, and how the segments they are on
 * yield to wrenches once the body is linearised. Symbols and numbers: docs/theory/contact.md,
 * sections 3 and 4. */
#include "physics/small_problem.h"

#include "physics/contact_law.h"
#include "physics/kernels/kernels.h"

#include <string.h>

/* m; points this far outside the layer take part */
static const double REACH = 0.006;
/* N/kg; contact at the start that pushes harder tells nothing about the end of the step */
static const double LARGEST_LOAD = 100.0;

kg_small_problem *kg_small_create(const kg_body *body, kg_arena *arena)
{
  const int n = body->segment_count, blocks = n + 1, size = (6 * n + 7) / 8 * 8;
  kg_small_problem *p = KG_ARENA_ARRAY(arena, kg_small_problem, 1);
  if (!p) return NULL;
  p->segment = KG_ARENA_ARRAY(arena, int, n);
  p->slot_of = KG_ARENA_ARRAY(arena, int, n);
  p->blocks = KG_ARENA_ARRAY(arena, int, blocks);
  p->on_path = KG_ARENA_ARRAY(arena, bool, blocks);
  p->candidates = KG_ARENA_ARRAY(arena, kg_candidate, body->point_count);
  p->lanes =
    KG_ARENA_ARRAY(arena, kg_candidate_lanes, (body->point_count + KG_LANES - 1) / KG_LANES);
  p->force = KG_ARENA_ARRAY(arena, kg_vec3, body->point_count);
  p->Y = KG_ARENA_ARRAY(arena, double, body->nv *size);
  p->xi = KG_ARENA_ARRAY(arena, double, 6 * blocks * size);
  p->nu = KG_ARENA_ARRAY(arena, double, 6 * blocks * size);
  p->xi0 = KG_ARENA_ARRAY(arena, kg_motion, n);
  p->nu0 = KG_ARENA_ARRAY(arena, kg_motion, n);
  p->xi_now = KG_ARENA_ARRAY(arena, kg_motion, n);
  p->nu_now = KG_ARENA_ARRAY(arena, kg_motion, n);
  p->K = KG_ARENA_ARRAY(arena, kg_small_block, n);
  p->D = KG_ARENA_ARRAY(arena, kg_small_block, n);
  p->touching = KG_ARENA_ARRAY(arena, bool, n);
  p->B = KG_ARENA_ARRAY(arena, double, size *size);
  p->h = KG_ARENA_ARRAY(arena, double, size);
  p->rest = KG_ARENA_ARRAY(arena, double, size);
  p->free = KG_ARENA_ARRAY(arena, double, body->nv);
  p->G = KG_ARENA_ARRAY(arena, double, body->nv);
  return p;
}

void kg_small_begin(kg_step *s)
{
  kg_small_problem *p = s->small;
  memset(p->force, 0, (size_t)s->def.body->point_count * sizeof *p->force);
  kg_step_evaluate_start(s);
  double load = 0.0;
  const double heaviest = LARGEST_LOAD * kg_links_mass(s->dynamics);
  for (int k = 0; k < s->contact_count; k++) {
    load += s->contacts[k].force.normal;
  }
  for (int k = 0; k < s->contact_count && load < heaviest; k++) {
    p->force[s->contacts[k].point] = s->contacts[k].force.f;
  }
}

/* ---- candidates --------------------------------------------------------------------------------*/

static void take_slot(kg_step *s, int i)
{
  kg_small_problem *p = s->small;
  const kg_tree *tree = &s->dynamics->tree;
  p->segment[p->slots] = i;
  p->slot_of[i] = p->slots++;
  for (int e = tree->start[i + 1]; e <= tree->start[i + 1] + tree->depth[i + 1]; e++) {
    p->on_path[tree->path[e]] = true;
  }
}

static void list_points(kg_step *s, const segment_ball *ball, const kg_link_height *height)
{
  kg_small_problem *p = s->small;
  const int i = ball->segment;
  const kg_link *l = &s->dynamics->links[i];
  for (int k = ball->first; k < ball->first + ball->count; k++) {
    const int point = s->points.points[k];
    if (kg_is_above(height, s->def.body->points[point].p, s->contact.layer + REACH)) continue;
    const kg_vec3 x = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, s->def.body->points[point].p));
    const kg_contact_site at =
      kg_contact_find(&s->contact, s->def.scene, kg_vec3_add(s->dynamics->origin, x));
    if (!(at.value.distance <= kg_contact_reach(&s->contact, at.ground) + REACH)) continue;
    if (p->slot_of[i] < 0) {
      take_slot(s, i);
    }
    kg_candidate *c = &p->candidates[p->count++];
    c->point = point;
    c->slot = p->slot_of[i];
    c->trial = (kg_point_state){x, kg_point_velocity(l, x), p->force[point]};
    c->normal = at.value.normal;
  }
}

static void list_candidates(kg_step *s)
{
  kg_small_problem *p = s->small;
  const int n = s->def.body->segment_count;
  p->slots = p->count = p->block_count = 0;
  memset(p->on_path, 0, (size_t)(n + 1) * sizeof *p->on_path);
  for (int i = 0; i < n; i++) {
    p->slot_of[i] = -1;
  }
  for (int b = 0; b < s->points.count && s->def.scene; b++) {
    const segment_ball *ball = &s->points.balls[b];
    const kg_link_height height = kg_step_link_height(s, ball->segment);
    if (!kg_step_is_far(s, ball, &height, REACH)) {
      list_points(s, ball, &height);
    }
  }
  for (int b = 0; b <= n; b++) {
    if (p->on_path[b]) p->blocks[p->block_count++] = b;
  }
  p->stride = (6 * p->slots + 7) / 8 * 8;
  p->groups = (p->count + KG_LANES - 1) / KG_LANES;
}

/* ---- linear body -------------------------------------------------------------------------------*/

static void add_product(kg_mat3 *C, double s, const kg_mat3 *A, const kg_mat3 *B)
{
  const kg_mat3 P = kg_mat3_mul(*A, *B);
  for (int k = 0; k < 9; k++) {
    C->m[k] += s * P.m[k];
  }
}

/* The assumed forces on the links, in place of those of the law; rhs = -G. */
static void assume_forces(kg_step *s, double *rhs)
{
  kg_small_problem *p = s->small;
  kg_dynamics *d = s->dynamics;
  for (int i = 0; i < d->n; i++) {
    d->links[i].external = (kg_force){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  }
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    kg_force *external = &d->links[p->segment[c->slot]].external;
    const kg_force wrench = {kg_vec3_cross(c->trial.x, c->trial.f), c->trial.f};
    *external = kg_force_add(*external, wrench);
  }
  s->evaluated = false;
  kg_step_project(s, rhs);
  p->body_error = kg_step_merit(s, rhs);
  for (int k = 0; k < s->def.body->nv; k++) {
    p->free[k] = rhs[k] = -rhs[k];
  }
}

/* The assumed forces in the sums; of their change, only the turning of their arms is in K. */
static void linearize_forces(kg_step *s)
{
  const kg_small_problem *p = s->small;
  kg_dynamics *d = s->dynamics;
  kg_tree_clear_external(d);
  for (int k = 0; k < p->count; k++) {
    const kg_candidate *c = &p->candidates[k];
    kg_composite *sum = kg_tree_load(d, p->segment[c->slot]);
    const kg_mat3 X = kg_mat3_skew(c->trial.x), F = kg_mat3_skew(c->trial.f);
    add_product(&sum->K.ww, 1.0, &F, &X);
    for (int j = 0; j < 9; j++) {
      sum->K.wv.m[j] -= F.m[j];
    }
  }
}

/* A'a and A a of three rows */
static kg_vec3 rows_mul_t(const kg_rows *A, kg_vec3 a)
{
  const double *m = A->m;
  return kg_vec3_make(m[0] * a.x + m[4] * a.y + m[8] * a.z, m[1] * a.x + m[5] * a.y + m[9] * a.z,
                      m[2] * a.x + m[6] * a.y + m[10] * a.z);
}

static kg_vec3 rows_mul(const kg_rows *A, kg_vec3 a)
{
  const double *m = A->m;
  return kg_vec3_make(m[0] * a.x + m[1] * a.y + m[2] * a.z, m[4] * a.x + m[5] * a.y + m[6] * a.z,
                      m[8] * a.x + m[9] * a.y + m[10] * a.z);
}

/* S_b'w */
static kg_vec3 along_joint(const kg_mat63 *S, kg_force w)
{
  return kg_vec3_add(rows_mul_t(&S->w, w.n), rows_mul_t(&S->v, w.f));
}

void kg_small_add_wrench(const kg_step *s, int segment, kg_force wrench, double *rhs)
{
  const kg_tree *tree = &s->dynamics->tree;
  const int leaf = segment + 1;
  for (int e = tree->start[leaf]; e <= tree->start[leaf] + tree->depth[leaf]; e++) {
    const int b = tree->path[e];
    const kg_vec3 t = along_joint(&s->dynamics->S[b], wrench);
    rhs[3 * b] += t.x;
    rhs[3 * b + 1] += t.y;
    rhs[3 * b + 2] += t.z;
  }
}

void kg_small_add_wrenches(const kg_step *s, const double *h, double *rhs)
{
  const kg_small_problem *p = s->small;
  for (int j = 0; j < p->slots; j++, h += 6) {
    const kg_force wrench = {kg_vec3_make(h[0], h[1], h[2]), kg_vec3_make(h[3], h[4], h[5])};
    kg_small_add_wrench(s, p->segment[j], wrench, rhs);
  }
}

/* Y = A^-1 S' for the six unit wrenches on every slot */
static void solve_unit_wrenches(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_tree *tree = &s->dynamics->tree;
  for (int k = 0; k < p->block_count; k++) {
    memset(p->Y + 3 * p->blocks[k] * p->stride, 0, 3 * (size_t)p->stride * sizeof *p->Y);
  }
  for (int j = 0; j < p->slots; j++) {
    const int leaf = p->segment[j] + 1;
    for (int e = tree->start[leaf]; e <= tree->start[leaf] + tree->depth[leaf]; e++) {
      const int b = tree->path[e];
      const kg_mat63 *S = &s->dynamics->S[b];
      for (int k = 0; k < 9; k++) { /* transposed */
        double *at = p->Y + (3 * b + k % 3) * p->stride + 6 * j + k / 3;
        at[0] = S->w.m[k / 3 * 4 + k % 3];
        at[3] = S->v.m[k / 3 * 4 + k % 3];
      }
    }
  }
  kg_tree_solve_many_within(tree, &s->J, p->Y, p->stride, p->blocks, p->block_count);
}

/* xi, nu = sums of T Y, U Y from the root to every block on a path */
static void find_compliance(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_dynamics *d = s->dynamics;
  const kg_tree *tree = &d->tree;
  const int size = 6 * p->stride;
  solve_unit_wrenches(s);
  for (int k = 0; k < p->block_count; k++) {
    const int b = p->blocks[k];
    const double *Y = p->Y + 3 * b * p->stride;
    const int up = b > 0 ? tree->path[tree->start[b] + tree->depth[b] - 1] : -1;
    tree->kernels->add_motion(p->xi + b * size, up < 0 ? NULL : p->xi + up * size, &d->pencil[b].T,
                              Y, p->stride);
    tree->kernels->add_motion(p->nu + b * size, up < 0 ? NULL : p->nu + up * size, &d->pencil[b].U,
                              Y, p->stride);
  }
}

static kg_motion joint_motion(const kg_mat63 *A, kg_vec3 x)
{
  return (kg_motion){rows_mul(&A->w, x), rows_mul(&A->v, x)};
}

static void find_free_motion(kg_step *s)
{
  kg_small_problem *p = s->small;
  const kg_dynamics *d = s->dynamics;
  const kg_tree *tree = &d->tree;
  for (int j = 0; j < p->slots; j++) {
    const int leaf = p->segment[j] + 1;
    kg_motion xi = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}}, nu = xi;
    for (int e = tree->start[leaf]; e <= tree->start[leaf] + tree->depth[leaf]; e++) {
      const int b = tree->path[e];
      const double *x = p->free + 3 * b;
      const kg_vec3 y = kg_vec3_make(x[0], x[1], x[2]);
      xi = kg_motion_add(xi, joint_motion(&d->pencil[b].T, y));
      nu = kg_motion_add(nu, joint_motion(&d->pencil[b].U, y));
    }
    p->xi0[j] = xi;
    p->nu0[j] = nu;
  }
}

/* f' P C_nu P' f: how fast the force f moves its point along itself */
static double yield_along(const double *C, int stride, kg_vec3 x, kg_vec3 f)
{
  const kg_vec3 n = kg_vec3_cross(x, f);
  const double w[6] = {n.x, n.y, n.z, f.x, f.y, f.z};
  double row[6] = {0.0}; /* w'C: sums side by side */
  for (int r = 0; r < 6; r++) {
    for (int k = 0; k < 6; k++) {
      row[k] += w[r] * C[r * stride + k];
    }
  }
  return row[0] * w[0] + row[1] * w[1] + row[2] * w[2] + row[3] * w[3] + row[4] * w[4] +
         row[5] * w[5];
}

/* trace of P C_nu P': the sum of the above over three directions, whichever they are */
static double yield_of_all(const double *C, int stride, kg_vec3 x)
{
  const double X[9] = {0.0, -x.z, x.y, x.z, 0.0, -x.x, -x.y, x.x, 0.0}; /* [x] */
  double sum = 0.0;
  for (int k = 0; k < 3; k++) {
    const double *own = C + (3 + k) * stride;
    double part = own[3 + k];
    for (int i = 1; i < 3; i++) { /* column k of [x] has two numbers */
      const int r = (k + i) % 3;
      const double by_r = C[r * stride + r] * X[3 * r + k];
      const int o = 3 - r - k;
      part +=
        X[3 * r + k] * (by_r + C[r * stride + o] * X[3 * o + k] + C[r * stride + 3 + k] + own[r]);
    }
    sum += part;
  }
  return sum;
}

static void find_yields(kg_step *s)
{
  kg_small_problem *p = s->small;
  const double least = s->dt / kg_links_mass(s->dynamics); /* of the body in one piece */
  for (int k = 0; k < p->count; k++) {
    kg_candidate *c = &p->candidates[k];
    const double *C = p->nu + (p->segment[c->slot] + 1) * 6 * p->stride + 6 * c->slot;
    const double normal = yield_along(C, p->stride, c->trial.x, c->normal);
    const double all = yield_of_all(C, p->stride, c->trial.x);
    c->yield_n = fmax(normal, least);
    c->yield_t = fmax(0.5 * (all - normal), least);
  }
}

/* J += damping diag(M) / dt */
static void damp(kg_step *s, double damping)
{
  for (int b = 0; b <= s->dynamics->n; b++) {
    kg_mat3 own = {{0.0}};
    for (int k = 0; k < 3; k++) {
      const double scale = s->scale[3 * b + k];
      own.m[4 * k] = s->dt / (scale * scale);
    }
    kg_tree_add_diagonal(&s->dynamics->tree, &s->J, b, damping, &own);
  }
}

bool kg_small_linearize(kg_step *s, double damping, double *rhs)
{
  kg_small_problem *p = s->small;
  const kg_tree *tree = &s->dynamics->tree;
  list_candidates(s);
  assume_forces(s, rhs);
  linearize_forces(s);
  kg_step_assemble(s);
  if (damping > 0.0) {
    damp(s, damping);
  }
  if (!kg_tree_factor(tree, &s->J)) return false;
  if (p->slots == 0) return true;
  kg_tree_solve(tree, &s->J, p->free);
  find_free_motion(s);
  find_compliance(s);
  find_yields(s);
  return true;
}

void kg_small_move_on(kg_step *s, double *rhs)
{
  kg_small_problem *p = s->small;
  for (int k = 0; k < p->count; k++) {
    kg_candidate *c = &p->candidates[k];
    const kg_link *l = &s->dynamics->links[p->segment[c->slot]];
    const kg_vec3 x = kg_vec3_add(l->p, kg_mat3_mul_vec(l->R, s->def.body->points[c->point].p));
    c->trial = (kg_point_state){x, kg_point_velocity(l, x), p->force[c->point]};
  }
  assume_forces(s, rhs);
  kg_tree_solve(&s->dynamics->tree, &s->J, p->free);
  find_free_motion(s);
}
