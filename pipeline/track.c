/* Tracking: the body is simulated; torques from inverse dynamics plus feedback, the root assisted by
 * a wrench that is reported.
 *
 * Every step of h seconds
 *   1. feedback asks for the acceleration  a* = a_ref + kd (v_ref - v) + kp (q_ref (-) q)
 *   2. accelerations a, contact forces f in their friction pyramids and a root wrench w are chosen:
 *        min  1/2 |a - a*|^2_W + 1/2 rho_p |J_p (v + h a) - u_p|^2 / h^2 + 1/2 |w|^2_R + 1/2 eps |f|^2
 *        s.t. w = (M a + c - J'f)_root
 *      (Gauss' principle with contacts; W is the mass matrix with joints made heavier, so that the
 *      body moves as a whole rather than its pelvis alone). J_p, u_p: the planted points and the
 *      velocity they should have, none along the ground when they stand. a is eliminated by
 *      H = W + rho_p J_p'J_p, which leaves a small quadratic over f >= 0, solved by coordinate
 *      descent from the last step's forces. Should H or its small complement fail to factorise, a*
 *      and the last forces stand: the step is solved all the same, and the wrench pays.
 *   3. joint torques by inverse dynamics at the end-of-step state these choices predict; with them
 *      and the wrench the implicit step is solved. Contact there is compliant: the layer gives way
 *      until it carries what the torques press, so the forces found are close to those chosen
 *   4. the SDF loop corrects what still penetrates; a body that lost the reference is set back to it
 *      and the frame reported
 *
 * The wrench is what physics cannot explain: reported per frame, made small by step 2.
 * Gauss' principle: F. E. Udwadia, R. E. Kalaba, Analytical Dynamics, Cambridge 1996, chapter 3;
 * with contacts as a quadratic programme: Y. Abe, M. da Silva, J. Popovic, Multiobjective control
 * with frictional contacts, SCA 2007. */
#include "pipeline/pipeline.h"

#include "kinegrad/correction.h"
#include "kinegrad/dense.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/filter.h"
#include "kinegrad/stage.h"
#include "kinegrad/step.h"

#include <string.h>
#include <time.h>

enum {
  EDGES = 4,         /* of a friction pyramid                                 */
  MAX_CONTACTS = 24, /* points that may carry force in one step               */
  MAX_EDGES = EDGES * MAX_CONTACTS,
  FORCE_SWEEPS = 100
};

static const double PLANTED_WEIGHT = 1e4; /* kg; rho_p                                        */
static const double SPREAD_WEIGHT = 1e-4; /* eps over the mass: spreads force over the points */
static const double CATCH_SHARE = 0.3;    /* of the way to its place, per step, that a planted
                                               point is asked to go while it is in the air      */
static const double REST_SHARE = 0.1; /* of the way to the rest height, per step, once it stands */
static const double KEEP_OUT_SHARE = 0.7; /* of the way out, per step, for what must not touch */
static const double LOST_M = 0.5;         /* of the root from the reference: the body is lost  */
static const double LARGEST_SPEED = 1e3;  /* m/s and rad/s                                     */
static const double FORCE_TOLERANCE_N = 0.01;

/* A point that may carry force in this step. */
typedef struct support {
  int point;
  kg_vec3 x, normal;
  double phi;
  double floor; /* kept out: the least distance asked for, m */
} support;

typedef struct tracker {
  const kg_subject *subject;
  const kg_body *body;
  const kg_correct_def *def;
  const kg_track_params *params;
  const kg_reference *reference;
  kg_correct_result *result;
  double h;
  kg_dynamics *dynamics;
  kg_stage *stage; /* the scene at the end of the step */
  kg_step *step;
  kg_correction *correction;
  double *q, *v, *q_next, *v_next; /* state before and after the step               */
  double *v_ref, *v_ref_before;    /* velocity of the reference in this, last step  */
  double *a;                       /* accelerations: a*, then the choice            */
  double *error, *moved, *tau, *bias, *g, *pair;
  double *stiffness;  /* (nv) added to the metric's diagonal           */
  double *M, *H, *HB; /* (nv, nv) twice; H^-1 B' as (6, nv)            */
  double *last_force; /* (points, EDGES) of the last step, N           */
  kg_vec3 *p;
  kg_mat3 *R;
  bool *is_planted; /* (points) in this step                         */
  bool foot_planted[2];
  double clearance[2]; /* m, of a foot in the air                       */
  int support_count, kept_out_count;
  support supports[MAX_CONTACTS], kept_out[MAX_CONTACTS];
  double edges[6][MAX_EDGES]; /* root wrench of a unit force along each edge   */
  kg_vec3 edge_direction[MAX_EDGES];
  double force[MAX_EDGES]; /* N, chosen                                     */
  int frame, frame_steps;  /* whose record is open, and steps in it         */
  double ms_step, ms_sdf;
} tracker;

static double now_ms(void)
{
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e3 * (double)t.tv_sec + 1e-6 * (double)t.tv_nsec;
}

/* ---- 1. what feedback asks for ---------------------------------------------------------------- */

static void ask_feedback(tracker *s, int k)
{
  const int nv = s->body->nv, nq = s->body->nq;
  const double *q_ref = s->reference->q + (size_t)(k - 1) * (size_t)nq;
  kg_body_difference(s->body, s->error, q_ref, s->q);
  memcpy(s->v_ref_before, s->v_ref, (size_t)nv * sizeof(double));
  kg_body_difference(s->body, s->v_ref, q_ref + nq, q_ref);
  for (int i = 0; i < nv; i++) {
    s->v_ref[i] /= s->h;
    const double omega =
      6.283185307179586 * (i < 6 ? s->params->root_frequency : s->params->joint_frequency);
    const double before = k > 1 ? s->v_ref_before[i] : s->v_ref[i];
    s->a[i] = (s->v_ref[i] - before) / s->h + 2.0 * omega * (before - s->v[i]) +
              omega * omega * s->error[i];
  }
}

/* q_next, v_next = the state at the end of the step if a comes true */
static void predict(tracker *s)
{
  const int nv = s->body->nv;
  for (int i = 0; i < nv; i++) {
    s->v_next[i] = s->v[i] + s->h * s->a[i];
    s->moved[i] = s->h * s->v_next[i];
  }
  kg_body_integrate(s->body, s->q_next, s->q, s->moved);
  kg_dynamics_pose(s->dynamics, s->q_next, s->p, s->R);
}

static kg_vec3 point_at(const tracker *s, int point)
{
  const kg_body_point *b = &s->body->points[point];
  return kg_vec3_add(s->p[b->segment], kg_mat3_mul_vec(s->R[b->segment], b->p));
}

/* ---- 2. the choice of accelerations, forces and wrench ------------------------------------------ */

static int foot_of(const kg_body *body, int segment)
{
  const int role = body->segments[segment].role;
  return role == KG_ROLE_L_ANKLE || role == KG_ROLE_L_TOE   ? 0
         : role == KG_ROLE_R_ANKLE || role == KG_ROLE_R_TOE ? 1
                                                            : -1;
}

/* which points the reference holds in frame k */
static void read_planted(tracker *s, int k)
{
  memset(s->is_planted, 0, (size_t)s->body->point_count * sizeof *s->is_planted);
  s->foot_planted[0] = s->foot_planted[1] = false;
  s->clearance[0] = s->reference->clearance[2 * k];
  s->clearance[1] = s->reference->clearance[2 * k + 1];
  for (int i = 0; i < s->reference->planted_count[k]; i++) {
    const int point = s->reference->planted[k * KG_MAX_PLANTED + i].point;
    if (s->reference->planted[k * KG_MAX_PLANTED + i].rolls) {
      continue;
    }
    const int foot = foot_of(s->body, s->body->points[point].segment);
    s->is_planted[point] = true;
    if (foot >= 0) {
      s->foot_planted[foot] = true;
    }
  }
}

static void add_support(tracker *s, const support *new)
{
  if (s->support_count < MAX_CONTACTS) {
    s->supports[s->support_count++] = *new;
    return;
  }
  int highest = 0;
  for (int i = 1; i < MAX_CONTACTS; i++) {
    highest = s->supports[i].phi > s->supports[highest].phi ? i : highest;
  }
  if (new->phi < s->supports[highest].phi) {
    s->supports[highest] = *new;
  }
}

/* Points of the predicted pose within the contact layer may carry force, of many the lowest. Points
 * of a foot may not unless they are planted: a foot in the air is kept out of the layer instead. */
static void find_supports(tracker *s)
{
  s->support_count = s->kept_out_count = 0;
  for (int k = 0; k < s->body->point_count; k++) {
    support new = {.point = k, .x = point_at(s, k)};
    const kg_sdf_value value = kg_soft_distance(kg_stage_scene(s->stage), new.x);
    new.phi = value.distance;
    new.normal = value.normal;
    const int foot = foot_of(s->body, s->body->points[k].segment);
    const bool in_air = foot >= 0 && !s->foot_planted[foot];
    if (new.phi < s->def->contact.layer && (foot < 0 || s->is_planted[k])) {
      add_support(s, &new);
    }
    /* beside planted points of the same foot: out of the layer; elsewhere: not below rest height */
    new.floor = in_air      ? s->clearance[foot]
                : foot >= 0 ? s->def->contact.layer
                            : s->params->rest_height;
    if (!s->is_planted[k] && new.phi < new.floor && s->kept_out_count < MAX_CONTACTS) {
      s->kept_out[s->kept_out_count++] = new;
    }
  }
}

/* the root's share of a force d at x: force in world axes, moment in root coordinates */
static void root_wrench(const tracker *s, kg_vec3 x, kg_vec3 d, double w[6])
{
  const kg_vec3 n = kg_mat3_mul_vec_t(s->R[0], kg_vec3_cross(kg_vec3_sub(x, s->p[0]), d));
  const double all[6] = {d.x, d.y, d.z, n.x, n.y, n.z};
  memcpy(w, all, sizeof all);
}

static void list_edges(tracker *s)
{
  const double mu = s->params->friction_share * s->def->contact.friction;
  for (int i = 0; i < s->support_count; i++) {
    const support *p = &s->supports[i];
    const kg_vec3 n = p->normal;
    const kg_vec3 other = fabs(n.x) < 0.7 ? kg_vec3_make(1, 0, 0) : kg_vec3_make(0, 0, 1);
    const kg_vec3 t1 = kg_vec3_normalized(kg_vec3_cross(n, other)), t2 = kg_vec3_cross(n, t1);
    const double along[EDGES][2] = {{mu, 0.0}, {-mu, 0.0}, {0.0, mu}, {0.0, -mu}};
    for (int e = 0; e < EDGES; e++) {
      const int at = EDGES * i + e;
      s->edge_direction[at] =
        kg_vec3_add_scaled(kg_vec3_add_scaled(n, along[e][0], t1), along[e][1], t2);
      double w[6];
      root_wrench(s, p->x, s->edge_direction[at], w);
      for (int r = 0; r < 6; r++) {
        s->edges[r][at] = w[r];
      }
      s->force[at] = s->last_force[EDGES * p->point + e];
    }
  }
}

/* Velocity a planted point should have: none once it stands, how deep it sinks into the layer is left
 * to the forces; towards its place while it is in the air. */
static kg_vec3 planted_velocity(const tracker *s, const kg_planted_point *planted, kg_vec3 x,
                                double phi)
{
  if (phi < s->def->contact.layer) {
    return kg_vec3_scale(REST_SHARE / s->h * (s->params->rest_height - phi), planted->normal);
  }
  const kg_vec3 way = kg_vec3_scale(CATCH_SHARE / s->h, kg_vec3_sub(planted->x, x));
  return kg_vec3_scale(fmin(1.0, s->params->catch_speed / fmax(kg_vec3_norm(way), 1e-9)), way);
}

/* H += rho J'J and g += rho J'(u - J v_next)/h of the planted points of frame k */
static void add_planted(tracker *s, int k)
{
  for (int i = 0; i < s->reference->planted_count[k]; i++) {
    const kg_planted_point *planted = &s->reference->planted[k * KG_MAX_PLANTED + i];
    if (planted->rolls) {
      continue;
    }
    const kg_vec3 x = point_at(s, planted->point);
    const double phi = kg_soft_distance(&s->subject->scene, x).distance;
    const kg_vec3 target = planted_velocity(s, planted, x, phi);
    double J[3][KG_PATH_COLUMNS], e[3] = {target.x, target.y, target.z};
    int columns[KG_PATH_COLUMNS];
    const int n =
      kg_point_rows(s->body, s->p, s->R, s->body->points[planted->point].segment, x, J, columns);
    for (int r = 0; r < 3; r++) {
      for (int c = 0; c < n; c++) {
        e[r] -= J[r][c] * s->v_next[columns[c]];
      }
      e[r] /= s->h;
    }
    kg_add_normal_equations(s->H, s->g, s->body->nv, J, columns, n, e, PLANTED_WEIGHT);
  }
}

/* the same for points kept out, along the normal only: n'J (v + h a) = u_n */
static void add_kept_out(tracker *s)
{
  const int nv = s->body->nv;
  for (int i = 0; i < s->kept_out_count; i++) {
    const support *out = &s->kept_out[i];
    double J[3][KG_PATH_COLUMNS], row[KG_PATH_COLUMNS];
    int columns[KG_PATH_COLUMNS];
    const int n =
      kg_point_rows(s->body, s->p, s->R, s->body->points[out->point].segment, out->x, J, columns);
    double e = KEEP_OUT_SHARE / s->h * (out->floor - out->phi) / s->h;
    for (int c = 0; c < n; c++) {
      row[c] = out->normal.x * J[0][c] + out->normal.y * J[1][c] + out->normal.z * J[2][c];
    }
    for (int a = 0; a < n; a++) {
      s->g[columns[a]] += PLANTED_WEIGHT * row[a] * e;
      for (int b = 0; b < n; b++) {
        s->H[(size_t)columns[a] * (size_t)nv + (size_t)columns[b]] +=
          PLANTED_WEIGHT * row[a] * row[b];
      }
    }
  }
}

/* inverse of a symmetric positive definite 6x6 */
static bool invert6(double A[36])
{
  double I[36] = {0.0};
  for (int i = 0; i < 6; i++) {
    I[7 * i] = 1.0;
  }
  if (!kg_dense_cholesky_factor(A, 6)) {
    return false;
  }
  kg_dense_cholesky_solve(A, 6, I, 6);
  memcpy(A, I, sizeof I);
  return true;
}

/* R of the wrench's cost: rho over mass and inertia, moment about the centre of mass */
static void wrench_compliance(tracker *s, const kg_centroid *centroid, double Rinv[36])
{
  const kg_centroid c = *centroid;
  const kg_vec3 arm = kg_mat3_mul_vec_t(s->R[0], kg_vec3_sub(c.com, s->p[0]));
  const kg_mat3 S = kg_mat3_mul(kg_mat3_skew(arm), kg_mat3_transposed(s->R[0]));
  const double inertia = (c.I.m[0] + c.I.m[4] + c.I.m[8]) / 3.0;
  /* w = T (f, n_com): f stays, n_root = n_com + arm x f;  R^-1 = T diag(m/rho_f, I/rho_n) T' */
  double T[6][6] = {{0.0}};
  for (int i = 0; i < 3; i++) {
    T[i][i] = T[3 + i][3 + i] = 1.0;
    for (int j = 0; j < 3; j++) {
      T[3 + i][j] = S.m[3 * i + j];
    }
  }
  const double d[2] = {c.mass / s->params->wrench_weight, inertia / s->params->moment_weight};
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j < 6; j++) {
      double sum = 0.0;
      for (int k = 0; k < 6; k++) {
        sum += T[i][k] * d[k / 3] * T[j][k];
      }
      Rinv[6 * i + j] = sum;
    }
  }
}

/* the wrench that the plan found no contact for, at the root: it is granted, not paid for */
static void granted_wrench(const tracker *s, const kg_centroid *c, int k, double w[6])
{
  const kg_vec3 f = s->reference->missing_force[k];
  const kg_vec3 arm = kg_vec3_sub(c->com, s->p[0]);
  const kg_vec3 n =
    kg_mat3_mul_vec_t(s->R[0], kg_vec3_add(s->reference->missing_moment[k], kg_vec3_cross(arm, f)));
  const double all[6] = {f.x, f.y, f.z, n.x, n.y, n.z};
  memcpy(w, all, sizeof all);
}

/* f >= 0 that minimises 1/2 (r - E f)'K(r - E f) + 1/2 eps |f|^2: coordinate descent */
static void choose_forces(tracker *s, const double K[36], const double r[6], double eps)
{
  const int n = EDGES * s->support_count;
  double KE[MAX_EDGES][6], diagonal[MAX_EDGES], left[6];
  memcpy(left, r, sizeof left);
  for (int e = 0; e < n; e++) {
    diagonal[e] = eps;
    for (int i = 0; i < 6; i++) {
      KE[e][i] = 0.0;
      for (int j = 0; j < 6; j++) {
        KE[e][i] += K[6 * i + j] * s->edges[j][e];
      }
      diagonal[e] += KE[e][i] * s->edges[i][e];
      left[i] -= s->edges[i][e] * s->force[e];
    }
  }
  for (int sweep = 0; sweep < FORCE_SWEEPS; sweep++) {
    double largest = 0.0;
    for (int e = 0; e < n; e++) {
      double slope = -eps * s->force[e];
      for (int i = 0; i < 6; i++) {
        slope += KE[e][i] * left[i];
      }
      const double f = fmax(0.0, s->force[e] + slope / diagonal[e]);
      const double change = f - s->force[e];
      for (int i = 0; i < 6; i++) {
        left[i] -= s->edges[i][e] * change;
      }
      s->force[e] = f;
      largest = fmax(largest, fabs(change));
    }
    if (largest < FORCE_TOLERANCE_N) {
      break;
    }
  }
}

static void remember_forces(tracker *s)
{
  memset(s->last_force, 0, (size_t)(EDGES * s->body->point_count) * sizeof *s->last_force);
  for (int i = 0; i < s->support_count; i++) {
    memcpy(s->last_force + EDGES * s->supports[i].point, s->force + EDGES * i,
           EDGES * sizeof(double));
  }
}

/* a in: a*, out: the choice; forces are left in s->force */
static void choose(tracker *s, int k)
{
  const int nv = s->body->nv;
  const size_t n = (size_t)nv;
  predict(s);
  read_planted(s, k);
  find_supports(s);
  list_edges(s);
  kg_dynamics_mass_matrix(s->dynamics, s->M, s->q_next);
  kg_dynamics_inverse(s->dynamics, s->bias, s->q_next, s->v_next, s->a); /* M a* + c */
  memcpy(s->H, s->M, n * n * sizeof(double));
  memset(s->g, 0, n * sizeof(double));
  for (size_t i = 6; i < n; i++) {
    s->H[i * n + i] += s->stiffness[i];
  }
  add_planted(s, k);
  add_kept_out(s);
  double K[36];
  const kg_centroid c = kg_dynamics_centroid(s->dynamics, s->q_next, NULL);
  wrench_compliance(s, &c, K);
  double granted[6];
  granted_wrench(s, &c, k, granted);
  if (!kg_dense_cholesky_factor(s->H, nv)) {
    return;
  }
  memcpy(s->HB, s->M, 6 * n * sizeof(double)); /* B: the root's rows of M */
  kg_dense_cholesky_solve(s->H, nv, s->HB, 6);
  kg_dense_cholesky_solve(s->H, nv, s->g, 1);

  /* r = r0 + B H^-1 g;  K = (R^-1 + B H^-1 B')^-1 */
  double r[6];
  for (int i = 0; i < 6; i++) {
    const double *B = s->M + (size_t)i * n;
    r[i] = s->bias[i] - granted[i];
    for (size_t j = 0; j < n; j++) {
      r[i] += B[j] * s->g[j];
    }
    for (int l = 0; l < 6; l++) {
      for (size_t j = 0; j < n; j++) {
        K[6 * i + l] += B[j] * s->HB[(size_t)l * n + j];
      }
    }
  }
  if (!invert6(K)) {
    return;
  }
  choose_forces(s, K, r, SPREAD_WEIGHT / s->body->mass);
  remember_forces(s);

  /* lambda = K (r - E f);  a = a* + H^-1 (g - B' lambda) */
  for (int i = 0; i < 6; i++) {
    for (int e = 0; e < EDGES * s->support_count; e++) {
      r[i] -= s->edges[i][e] * s->force[e];
    }
  }
  for (size_t j = 0; j < n; j++) {
    s->a[j] += s->g[j];
    for (int i = 0; i < 6; i++) {
      double lambda = 0.0;
      for (int l = 0; l < 6; l++) {
        lambda += K[6 * i + l] * r[l];
      }
      s->a[j] -= s->HB[(size_t)i * n + j] * lambda;
    }
  }
}

/* tau = ID(q', v', a) - J'f at the predicted state; its root entries are the wrench */
static void find_torques(tracker *s)
{
  predict(s);
  kg_dynamics_inverse(s->dynamics, s->tau, s->q_next, s->v_next, s->a);
  for (int i = 0; i < s->support_count; i++) {
    const kg_body_point *point = &s->body->points[s->supports[i].point];
    kg_vec3 f = {0.0, 0.0, 0.0};
    for (int e = 0; e < EDGES; e++) {
      f = kg_vec3_add_scaled(f, s->force[EDGES * i + e], s->edge_direction[EDGES * i + e]);
    }
    const kg_vec3 x = point_at(s, s->supports[i].point);
    s->tau[0] -= f.x;
    s->tau[1] -= f.y;
    s->tau[2] -= f.z;
    for (int j = point->segment; j >= 0; j = s->body->segments[j].parent) {
      const kg_vec3 n = kg_mat3_mul_vec_t(s->R[j], kg_vec3_cross(kg_vec3_sub(x, s->p[j]), f));
      s->tau[3 + 3 * j] -= n.x;
      s->tau[4 + 3 * j] -= n.y;
      s->tau[5 + 3 * j] -= n.z;
    }
  }
}

/* ---- 3. and 4. the step and the correction ----------------------------------------------------- */

/* sums over the steps of the open frame become means */
static void close_record(tracker *s)
{
  kg_correct_result *out = s->result;
  const int t = s->frame, nv = s->body->nv;
  if (s->frame_steps > 1) {
    const double share = 1.0 / s->frame_steps;
    kg_vec3 *sums[] = {&out->feet[2 * t].force, &out->feet[2 * t + 1].force, &out->other_force[t],
                       &out->residual_force[t], &out->residual_moment[t]};
    for (size_t i = 0; i < KG_COUNT_OF(sums); i++) {
      *sums[i] = kg_vec3_scale(share, *sums[i]);
    }
    out->feet[2 * t].moment *= share;
    out->feet[2 * t + 1].moment *= share;
    out->correction_force[t] *= share;
    for (int i = 0; i < nv; i++) {
      out->tau[(size_t)t * (size_t)nv + (size_t)i] *= share;
    }
  }
  s->frame_steps = 0;
}

static void clear_record(tracker *s, int t)
{
  kg_correct_result *out = s->result;
  memset(out->feet + 2 * t, 0, 2 * sizeof *out->feet);
  memset(out->tau + (size_t)t * (size_t)s->body->nv, 0, (size_t)s->body->nv * sizeof *out->tau);
  out->other_force[t] = out->residual_force[t] = out->residual_moment[t] =
    kg_vec3_make(0.0, 0.0, 0.0);
  out->correction_force[t] = out->penetration[t] = 0.0;
  out->contact_count[t] = 0;
}

/* Sums over the contacts of a step: forces of the feet, and the others, as means over the steps of a
 * frame; the centre of pressure is that of the last loaded step. */
static void record_contacts(tracker *s, int t, const kg_step_report *report)
{
  kg_correct_result *out = s->result;
  kg_foot_force *feet = out->feet + 2 * t;
  kg_vec3 moment[2] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}},
          weighted[2] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  double normal[2] = {0.0, 0.0};
  out->contact_count[t] = report->contact_count;
  for (int c = 0; c < report->contact_count; c++) {
    const kg_step_contact *contact = &report->contacts[c];
    const int foot = foot_of(s->body, s->body->points[contact->point].segment);
    if (foot < 0) {
      out->other_force[t] = kg_vec3_add(out->other_force[t], contact->force.f);
      continue;
    }
    feet[foot].force = kg_vec3_add(feet[foot].force, contact->force.f);
    weighted[foot] = kg_vec3_add_scaled(weighted[foot], contact->force.normal, contact->x);
    normal[foot] += contact->force.normal;
  }
  for (int f = 0; f < 2; f++) {
    if (normal[f] > 0.0) {
      const kg_vec3 cop = kg_vec3_scale(1.0 / normal[f], weighted[f]);
      /* on the ground, not at the height of the nodes */
      const kg_sdf_value ground = kg_soft_distance(kg_stage_scene(s->stage), cop);
      feet[f].cop = kg_vec3_add_scaled(cop, -ground.distance, ground.normal);
      for (int c = 0; c < report->contact_count; c++) {
        const kg_step_contact *contact = &report->contacts[c];
        if (foot_of(s->body, s->body->points[contact->point].segment) == f) {
          moment[f] = kg_vec3_add(
            moment[f], kg_vec3_cross(kg_vec3_sub(contact->x, feet[f].cop), contact->force.f));
        }
      }
      feet[f].moment += kg_vec3_dot(moment[f], ground.normal);
    }
  }
}

static void record_wrench(tracker *s, int t, const double *tau)
{
  const kg_centroid c = kg_dynamics_centroid(s->dynamics, s->q_next, NULL);
  const kg_quat root = kg_quat_make(s->q_next[3], s->q_next[4], s->q_next[5], s->q_next[6]);
  const kg_vec3 f = kg_vec3_make(tau[0], tau[1], tau[2]);
  const kg_vec3 n = kg_quat_rotate(root, kg_vec3_make(tau[3], tau[4], tau[5]));
  const kg_vec3 r = kg_vec3_sub(c.com, kg_vec3_make(s->q_next[0], s->q_next[1], s->q_next[2]));
  kg_correct_result *out = s->result;
  out->residual_force[t] = kg_vec3_add(out->residual_force[t], f);
  out->residual_moment[t] =
    kg_vec3_add(out->residual_moment[t], kg_vec3_sub(n, kg_vec3_cross(r, f)));
  double *tau_t = out->tau + (size_t)t * (size_t)s->body->nv;
  for (int i = 6; i < s->body->nv; i++) { /* the wrench is reported apart */
    tau_t[i] += tau[i];
  }
}

/* the loop's move and change of velocity as a force on the whole body: M dq / h^2 + M dv / h */
static double correction_force(tracker *s, const double *moved, const double *v_before)
{
  const int nv = s->body->nv;
  kg_dynamics_mass_matrix(s->dynamics, s->M, s->q_next);
  double force2 = 0.0;
  for (int i = 0; i < 3; i++) {
    double sum = 0.0;
    for (int j = 0; j < nv; j++) {
      sum += s->M[(size_t)i * (size_t)nv + (size_t)j] *
             (moved[j] / s->h + (s->v_next[j] - v_before[j])) / s->h;
    }
    force2 += sum * sum;
  }
  return sqrt(force2);
}

static void correct_penetration(tracker *s, int t)
{
  double *before = s->g;
  memcpy(before, s->v_next, (size_t)s->body->nv * sizeof *before);
  const kg_correction_report report =
    kg_correction_apply(s->correction, s->q_next, s->v_next, s->moved);
  s->result->sdf_iterations += report.iterations;
  s->result->penetration[t] = fmax(s->result->penetration[t], report.d_pen_after);
  if (report.iterations > 0) {
    s->result->correction_force[t] += correction_force(s, s->moved, before);
  }
}

static bool is_lost(const tracker *s, int k)
{
  const size_t nq = (size_t)s->body->nq;
  const double *ref = s->reference->q + (size_t)k * nq;
  for (size_t i = 0; i < nq; i++) {
    if (!isfinite(s->q_next[i])) {
      return true;
    }
  }
  for (int i = 0; i < s->body->nv; i++) {
    if (!(fabs(s->v_next[i]) < LARGEST_SPEED)) { /* NaN is lost too */
      return true;
    }
  }
  const kg_vec3 away =
    kg_vec3_make(s->q_next[0] - ref[0], s->q_next[1] - ref[1], s->q_next[2] - ref[2]);
  return kg_vec3_norm(away) > LOST_M;
}

/* A simulation that has lost the reference is set back to it: reported as a frame of its own kind, and
 * as the force that such a move would take. The forces of that frame mean nothing and are not given. */
static void set_back(tracker *s, int k, int t)
{
  kg_correct_result *out = s->result;
  const size_t nq = (size_t)s->body->nq, nv = (size_t)s->body->nv;
  memcpy(s->q_next, s->reference->q + (size_t)k * nq, nq * sizeof *s->q_next);
  memcpy(s->v_next, s->v_ref, nv * sizeof *s->v_next);
  memset(s->last_force, 0, (size_t)(EDGES * s->body->point_count) * sizeof *s->last_force);
  const kg_correction_report report =
    kg_correction_apply(s->correction, s->q_next, s->v_next, NULL);
  clear_record(s, t);
  out->penetration[t] = report.d_pen_after;
  out->correction_force[t] = s->body->mass * LOST_M / (s->h * s->h);
  if (out->restart_count == 0 || out->restart_frames[out->restart_count - 1] != t) {
    out->restart_frames[out->restart_count++] = t;
  }
}

static void take_step(tracker *s, int k, int t)
{
  kg_correct_result *out = s->result;
  const double start = now_ms();
  kg_stage_set(s->stage, k * s->h, kg_vec3_make(s->q[0], s->q[1], s->q[2]));
  ask_feedback(s, k);
  choose(s, k);
  find_torques(s);
  /* velocity feedback inside the step: damping c (v_chosen - v') on every joint */
  for (int i = 6; i < s->body->nv; i++) {
    s->tau[i] += s->params->joint_damping * s->v_next[i];
  }

  kg_step_report report;
  kg_step_advance(s->step, s->q_next, s->v_next, s->q, s->v, s->tau, s->h, true, &report);
  for (int i = 6; i < s->body->nv; i++) {
    s->tau[i] -= s->params->joint_damping * s->v_next[i]; /* what the joint really gave */
  }
  out->steps++;
  out->steps_converged += report.converged;
  out->newton_iterations += report.iterations;
  out->newton_residual_max = fmax(out->newton_residual_max, report.residual);
  if (report.substeps > 1) {
    out->steps_substepped++;
    out->substepped_frames[out->substepped_count++] = t;
  }
  record_contacts(s, t, &report);
  record_wrench(s, t, s->tau);
  const double middle = now_ms();
  s->ms_step += middle - start;

  correct_penetration(s, t);
  s->ms_sdf += now_ms() - middle;
}

/* ---- the run ----------------------------------------------------------------------------------- */

/* writes the capture frames that lie in step k, which went from s->q to s->q_next */
static int write_frames(tracker *s, int k, int t)
{
  const kg_correct_result *out = s->result;
  const size_t nq = (size_t)s->body->nq, nv = (size_t)s->body->nv;
  const double frame = s->subject->dt / s->h; /* in steps */
  double *pair = s->pair;                     /* (2, nq) */
  memcpy(pair, s->q, nq * sizeof *pair);
  memcpy(pair + nq, s->q_next, nq * sizeof *pair);
  for (; t < out->frame_count && t * frame <= k + 1e-6; t++) {
    const double x = t * frame - (k - 1);
    kg_states_at(s->body, out->q + (size_t)t * nq, pair, 2, x > 1.0 - 1e-6 ? 1.0 : x);
    memcpy(out->v + (size_t)t * nv, s->v_next, nv * sizeof(double));
  }
  return t;
}

/* frames that no step ended in (a step longer than the frame time) repeat the one before */
static void repeat_record(kg_correct_result *out, int from, int t)
{
  memcpy(out->tau + (size_t)t * (size_t)out->nv, out->tau + (size_t)from * (size_t)out->nv,
         (size_t)out->nv * sizeof *out->tau);
  out->residual_force[t] = out->residual_force[from];
  out->residual_moment[t] = out->residual_moment[from];
  out->feet[2 * t] = out->feet[2 * from];
  out->feet[2 * t + 1] = out->feet[2 * from + 1];
  out->other_force[t] = out->other_force[from];
  out->contact_count[t] = out->contact_count[from];
  out->correction_force[t] = out->correction_force[from];
  out->penetration[t] = out->penetration[from];
}

static void run(tracker *s)
{
  kg_correct_result *out = s->result;
  const size_t nq = (size_t)s->body->nq, nv = (size_t)s->body->nv;
  const double frame = s->subject->dt / s->h;
  memcpy(s->q, s->reference->q, nq * sizeof *s->q);
  const kg_correction_report start = kg_correction_apply(s->correction, s->q, NULL, NULL);
  memcpy(out->q, s->q, nq * sizeof *s->q);
  if (s->reference->count > 1) {
    kg_body_difference(s->body, s->v, s->reference->q + nq, s->reference->q);
    for (size_t i = 0; i < nv; i++) {
      s->v[i] /= s->h;
    }
    memcpy(s->v_ref, s->v, nv * sizeof *s->v);
  }

  int written = 1;
  for (int k = 1; k < s->reference->count; k++) {
    int t = (int)ceil(k / frame - 1e-6);
    t = t < out->frame_count ? t : out->frame_count - 1;
    if (t != s->frame) {
      close_record(s);
      clear_record(s, t);
      s->frame = t;
    }
    s->frame_steps++;
    take_step(s, k, t);
    if (is_lost(s, k)) {
      set_back(s, k, t);
    }
    const int first = written;
    written = write_frames(s, k, written);
    for (int u = first; u < written; u++) {
      if (u != t) {
        repeat_record(out, t, u);
      }
    }
    memcpy(s->q, s->q_next, nq * sizeof *s->q);
    memcpy(s->v, s->v_next, nv * sizeof *s->v);
    if (s->def->progress &&
        !s->def->progress((double)k / s->reference->count, "track", s->def->progress_user)) {
      out->interrupted = true;
      return;
    }
  }
  close_record(s);
  if (out->frame_count > 1) { /* frame 0 is the start: it repeats the first step */
    memcpy(out->v, out->v + nv, nv * sizeof(double));
    repeat_record(out, 1, 0);
  }
  out->penetration[0] = start.d_pen_after; /* its pose is its own */
}

/* ---- memory ------------------------------------------------------------------------------------ */

static kg_status tracker_create(tracker *s, kg_arena *arena)
{
  const size_t nq = (size_t)s->body->nq, nv = (size_t)s->body->nv;
  s->q = KG_ARENA_ARRAY(arena, double, nq);
  s->q_next = KG_ARENA_ARRAY(arena, double, nq);
  s->pair = KG_ARENA_ARRAY(arena, double, 2 * nq);
  double **vectors[] = {&s->v,     &s->v_next, &s->v_ref, &s->v_ref_before, &s->a,
                        &s->error, &s->moved,  &s->tau,   &s->bias,         &s->g};
  for (size_t i = 0; i < KG_COUNT_OF(vectors); i++) {
    *vectors[i] = KG_ARENA_ARRAY(arena, double, nv);
  }
  s->stiffness = KG_ARENA_ARRAY(arena, double, nv);
  s->M = KG_ARENA_ARRAY(arena, double, nv *nv);
  s->H = KG_ARENA_ARRAY(arena, double, nv *nv);
  s->HB = KG_ARENA_ARRAY(arena, double, 6 * nv);
  s->is_planted = KG_ARENA_ARRAY(arena, bool, s->body->point_count);
  s->last_force = KG_ARENA_ARRAY(arena, double, EDGES * s->body->point_count);
  s->p = KG_ARENA_ARRAY(arena, kg_vec3, s->body->segment_count);
  s->R = KG_ARENA_ARRAY(arena, kg_mat3, s->body->segment_count);
  if (kg_arena_failed(arena)) {
    return KG_ERR_NO_MEMORY;
  }
  for (size_t i = 6; i < nv; i++) {
    const int role = s->body->segments[(i - 3) / 3].role;
    s->stiffness[i] = role >= KG_ROLE_L_HIP ? s->params->leg_weight : s->params->trunk_weight;
  }

  const kg_vec3 gravity = kg_vec3_make(0.0, -s->def->gravity, 0.0);
  kg_status status = kg_dynamics_create(&s->dynamics, s->body, arena->allocator);
  if (status == KG_OK) {
    status = kg_stage_create(&s->stage, s->subject, KG_STAGE_ALL, arena->allocator);
  }
  if (status == KG_OK) {
    kg_dynamics_set_gravity(s->dynamics, gravity);
    kg_step_def step = kg_step_default_def(s->body);
    step.scene = kg_stage_scene(s->stage);
    step.contact = s->def->contact;
    step.gravity = gravity;
    step.joint_damping = s->params->joint_damping;
    step.allocator = arena->allocator;
    status = kg_step_create(&s->step, &step);
  }
  if (status == KG_OK) {
    kg_correction_def correction = kg_correction_default_def(s->body, kg_stage_scene(s->stage));
    correction.self = s->subject->self;
    correction.allocator = arena->allocator;
    status = kg_correction_create(&s->correction, &correction);
  }
  return status;
}

static void tracker_destroy(tracker *s)
{
  kg_correction_destroy(s->correction);
  kg_step_destroy(s->step);
  kg_stage_destroy(s->stage);
  kg_dynamics_destroy(s->dynamics);
}

/* of the capture, limbs that overlap led apart first: feedback would press them on each other */
static kg_status create_reference(kg_reference *reference, const tracker *s, kg_arena *arena)
{
  kg_subject apart = *s->subject;
  if (apart.self || apart.other) {
    apart.q = KG_ARENA_ARRAY(arena, double, apart.frame_count *apart.body->nq);
    if (!apart.q) return KG_ERR_NO_MEMORY;
    const kg_status status =
      kg_part_limbs(apart.q, &s->result->interrupted, s->subject, s->def, arena->allocator);
    if (status != KG_OK || s->result->interrupted) return status;
  }
  return kg_reference_create(reference, &apart, &s->def->track, s->h, s->def->gravity,
                             s->def->contact.friction, arena);
}

kg_status kg_correct_track(kg_correct_result *result, const kg_subject *subject,
                           const kg_correct_def *def, kg_arena *arena)
{
  const double start = now_ms();
  kg_arena scratch;
  kg_arena_init(&scratch, arena->allocator);
  const double shortest = def->dt > 0.0 ? def->dt : subject->dt / ceil(subject->dt / 0.0101);
  kg_reference reference;
  tracker s = {.subject = subject,
               .body = subject->body,
               .def = def,
               .params = &def->track,
               .reference = &reference,
               .result = result,
               .h = shortest};
  kg_status status = create_reference(&reference, &s, &scratch);
  if (status == KG_OK && !result->interrupted) {
    result->substepped_frames = KG_ARENA_ARRAY(arena, int, reference.count);
    result->restart_frames = KG_ARENA_ARRAY(arena, int, reference.count);
    status = kg_arena_failed(arena) ? KG_ERR_NO_MEMORY : tracker_create(&s, &scratch);
  }
  if (status == KG_OK && !result->interrupted) {
    run(&s);
    const double frames = result->frame_count;
    result->ms_step = s.ms_step / frames;
    result->ms_sdf = s.ms_sdf / frames;
    result->ms_per_frame = (now_ms() - start) / frames;
    result->ms_policy = result->ms_per_frame - result->ms_step - result->ms_sdf;
  }
  tracker_destroy(&s);
  kg_arena_release(&scratch);
  return status;
}
