/* Inside physics/: a pose that is moved out of what it touches (kinegrad/correction.h). correction.c
 * has the calls and their order, correction_pose.c what is touched and its derivatives,
 * correction_gradient.c Eq. 11, correction_least.c the least move, correction_starts.c other ways to it,
 * correction_vjp.c the derivative of the corrected pose.
 *
 *   q0, q    pose at the start and now, q = q0 (+) D
 *   x_t      sample point of touch t in the world      Phi_t, n_t, H_t   distance and derivatives
 *   M        mass matrix at q0, M = L L'               m                 total mass
 *   g_t      = d Phi_t / d(tangent) = J_t' n_t, and (J_t - J_o)' n_t against another segment o of the
 *              body, J_o that of its point at x_t
 *
 * Equation numbers: docs/theory/sdf.md. */
#ifndef PHYSICS_CORRECTION_H
#define PHYSICS_CORRECTION_H

#include "kinegrad/arena.h"
#include "kinegrad/correction.h"
#include "kinegrad/self.h"
#include "physics/near_points.h"
#include "physics/physics.h"
#include "solver/least_move.h"

enum { CORRECTION_ROWS_MAX = 256 };

/* Points nearer than this (m) and this share of the first depth take part in a step, beside those
 * inside: while the body comes out others can go in. */
#define CORRECTION_NEAR 5e-3
#define CORRECTION_NEAR_SHARE 0.5
/* A step turns no joint and moves the root by no more (rad, m). */
#define CORRECTION_STEP_MAX 1.5
/* A pose counts as touching when its lowest point is nearer than this (m). */
#define CORRECTION_GAP_MAX 1e-4
/* A linearised constraint may be missed by this much (m; m/s for velocities). */
#define CORRECTION_ROW_TOLERANCE 1e-9

/* A point that is inside or near. */
typedef struct touch {
  int point;
  int key;   /* of its multiplier: point, or point + number of points against the body itself */
  int other; /* segment of the body that is touched, -1: the scene                            */
  kg_vec3 x;
  kg_sdf_value at; /* no second derivatives against the body itself */
} touch;

/* What correction_vjp.c keeps from prepare to pull. */
typedef struct correction_adjoint {
  bool untouched; /* the pose was within the tolerance: the identity        */
  int count;      /* independent touches that carry a multiplier            */
  double *K;      /* (nv + count, nv + count) LU                            */
  int *pivots;    /* (nv + count)                                           */
  double *u;      /* (nv + count) adjoints of D and of the multipliers      */
  double *rows;   /* (count, nv) g at the end                               */
  double *gamma;  /* (nv, nv)                                               */
  double *zero;   /* (nv) zeros                                             */
  double *end;    /* (nv) adjoint of the end with D held                    */
  kg_mat3 *E;     /* (n) exp(D) of every rotation                           */
} correction_adjoint;

/* The least move found so far. */
typedef struct correction_answer {
  double length;      /* kg^1/2 m, INFINITY: none                        */
  double *D;          /* (nv)                                            */
  double *multiplier; /* (keys)                                          */
} correction_answer;

/* Where another way begins: no move but the lightest that turns one segment. */
typedef struct correction_start {
  int segment;
  double length; /* of the move that it promises, kg^1/2 m */
  double *D;     /* (nv)                                    */
} correction_start;

struct kg_correction {
  kg_correction_def def;
  kg_arena arena;
  kg_dynamics *dynamics;
  int nv, key_count;

  near_points near_points;
  kg_self *self;               /* NULL: the body is not in its own way */
  kg_self_touch *self_touches; /* (points)                             */
  kg_scene_hint *hints;        /* (points) of the pose before */

  /* the last pose sampled */
  kg_vec3 *p;     /* (n) joints                   */
  kg_mat3 *R;     /* (n) rotations                */
  kg_mat3 *Jr;    /* (n) right Jacobians at D     */
  touch *touches; /* (keys) those nearer than d_pen + near, and a few more */
  int touch_count;
  double near; /* points further than d_pen + near are no touches */
  double d_pen, sum_depth, L_coll, lowest;

  /* the move */
  double *q0, *q_now, *q_from;         /* (nq)                                   */
  double *D, *D_trial, *D_best, *goal; /* (nv) moves from q0             */
  double *gradient, *slope;            /* (nv) grad L_coll; direction of descent   */
  double *chol;                        /* (nv, nv) L of M at q0                    */
  double *M;                           /* (nv, nv)                                 */

  /* the linearised constraints */
  int rows;
  int *touch_of_row;      /* (rows) of the pose linearised, which is the one sampled */
  double *G, *b, *lambda; /* (rows, nv), (rows), (rows)                      */
  double *yield;          /* (rows) g' M^-1 g of those that carry            */
  double *multiplier;     /* (keys) of the last solution                    */
  double *C, *W;          /* (nv, nv) sum of lambda Hess Phi; model's factor */
  double *center;         /* (nv) minimum of the model without constraints  */
  least_move solver;
  correction_answer answer;
  correction_start *starts; /* (4 n), none when only one way is followed */
  double *turns, *turned;   /* (3, nv) J and J M^-1 of (32)              */
  bool *is_inside;          /* (n) at q0                                 */
  correction_adjoint adjoint;

  /* rates of the pose along a direction; forces on it */
  kg_vec3 *w, *p_dot;  /* (n) */
  kg_vec3 *f, *moment; /* (n) force and moment about O on each segment */
  kg_mat3 *virial;     /* (n) sum of (x - O) f' on each segment        */
};

/* correction_pose.c */
void correction_pose_init(kg_correction *c, kg_arena *arena);
/* p, R, touches, d_pen, sum_depth, L_coll, lowest of a pose. A NaN anywhere makes d_pen NaN. */
void correction_sample(kg_correction *c, const double *q);
/* The same for the pose already sampled, carried by `shift` as a whole, against the scene alone: touches
 * are of the shifted pose, p stays. */
void correction_measure(kg_correction *c, kg_vec3 shift);
/* q_now = q0 (+) D, sampled */
void correction_go_to(kg_correction *c, const double *D);
/* grad L_coll in the tangent space of the pose sampled */
void correction_loss_gradient(kg_correction *c, double *gradient);
/* row[nv] = J' n of a touch at the pose sampled */
void correction_row(const kg_correction *c, const touch *t, double *row);
/* Jr at D */
void correction_tangents(kg_correction *c, const double *D);
/* A derivative by the tangent of the pose sampled made one by D. */
void correction_to_move(const kg_correction *c, double *row);
/* C[nv*nv] = sum over touches of the scene of multiplier Hess_D Phi, at D = c->D, which is sampled, with
 * correction_tangents done. */
void correction_curvature(kg_correction *c, const double *multiplier, double *C);
/* out[nv] = M a */
void correction_times_mass(const kg_correction *c, const double *a, double *out);
/* a' M b */
double correction_metric(const kg_correction *c, const double *a, const double *b);

/* correction.c: M and its factor at q */
void correction_factor_mass(kg_correction *c, const double *q);

/* correction_starts.c: more ways than the one that led to D; D becomes the least move found. */
void correction_starts_init(kg_correction *c, kg_arena *arena);
void correction_try_starts(kg_correction *c, kg_correction_report *report);

/* correction.c: samples q and, where it is inside, starts there: q0 = q, D = 0, no multipliers. False:
 * nothing to do, or NaN. */
bool correction_begin(kg_correction *c, const double *q);
/* Second-order steps from D (sampled), and again from where a failed line search left a gap. False: no
 * way outside was found, or only to a move longer than `limit`. */
bool correction_settle(kg_correction *c, double limit, int *iterations);

/* correction_vjp.c */
void correction_vjp_init(kg_correction *c, kg_arena *arena); /* the solver first */

/* correction_gradient.c: one step from q_now (sampled); false, nothing changed, when L_coll does not
 * fall. */
bool correction_gradient_step(kg_correction *c);
/* Steps of it from q_now (sampled) until d_pen is within the tolerance or no step makes
 * L_coll fall. */
void correction_descend(kg_correction *c, int *iterations);

/* correction_least.c: from D (sampled) towards the least move that satisfies Phi >= 0. D becomes the
 * smallest move met that leaves d_pen within the tolerance; false when there was none, or when the
 * steps are seen to lead to one longer than `limit`. */
bool correction_least_move(kg_correction *c, double limit, int *iterations);
/* Full steps of (25) from D until the conditions of (24) hold to def.kkt_tolerance or steps run out.
 * D becomes the best met; returns its residual. */
double correction_polish(kg_correction *c, int *iterations);
/* Length of the move that the next step from D (sampled), without multipliers, leads to. */
double correction_promise(kg_correction *c);
/* One step from D = 0, which is sampled. */
void correction_least_step(kg_correction *c);

/* The touch of a row, while the pose linearised is the one sampled. */
static inline const touch *correction_touch_of(const kg_correction *c, int row)
{
  return &c->touches[c->touch_of_row[row]];
}

static inline double correction_dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  for (int i = 0; i < n; i++) {
    sum += a[i] * b[i];
  }
  return sum;
}

#endif
