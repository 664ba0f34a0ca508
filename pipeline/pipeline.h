/* Private to pipeline/: what its files share. */
#ifndef PIPELINE_PIPELINE_H
#define PIPELINE_PIPELINE_H

#include "kinegrad/arena.h"
#include "kinegrad/clip.h"
#include "kinegrad/correct.h"
#include "kinegrad/subject.h"

/* ---- floor.c --------------------------------------------------------------------------------- */

/* Estimates floor and feet from the motion frames of a clip. *floor's `given` and `height` are read
 * when given is true. KG_ERR_NO_MEMORY only: a clip without any stance gets a floor from its lowest
 * foot position. */
KG_MUST_USE kg_status kg_floor_estimate(kg_floor *floor, const kg_clip *clip,
                                        const kg_mapping *mapping);

/* ---- subject.c ------------------------------------------------------------------------------- */

/* As kg_scene_distance, but from the outside of the soft layers: where soles stand. */
kg_sdf_value kg_soft_distance(const kg_scene *scene, kg_vec3 x);
/* params->rest_height, or, on a soft floor, where ten sole nodes carry the weight: below the outside. */
double kg_rest_height(const kg_subject *subject, const kg_track_params *params,
                      const kg_contact_params *contact, double gravity);

/* ---- states.c -------------------------------------------------------------------------------- */

/* q[nq] at frame number x (not whole: slerp and linear) of a motion (count, nq). */
void kg_states_at(const kg_body *body, double *q, const double *states, int count, double x);

/* A mapped body has at most 23 segments, so a path to the root at most this many columns. */
enum { KG_PATH_COLUMNS = 3 + 3 * KG_ROLE_COUNT };

/* Jacobian of the world position x of a point of a segment, at the pose p, R: J (3, n) over the
 * columns[n] of its path, the root's position first; returns n. */
int kg_point_rows(const kg_body *body, const kg_vec3 *p, const kg_mat3 *R, int segment, kg_vec3 x,
                  double J[3][KG_PATH_COLUMNS], int columns[KG_PATH_COLUMNS]);

/* H (nv, nv) += weight J'J, lower triangle and upper, and g += weight J'e. */
void kg_add_normal_equations(double *H, double *g, int nv, double J[3][KG_PATH_COLUMNS],
                             const int *columns, int n, const double e[3], double weight);

/* ---- smoother.c ------------------------------------------------------------------------------ */

/* Factor of the pentadiagonal A of  y'A y = sum_t (1 + weight_t) y_t^2 + tau4 (y_{t-1} - 2 y_t + y_{t+1})^2,
 * that is A = I + diag(weight) + tau4 D2'D2.  With tau4 = (tau / dt)^4 a jump is rounded over the
 * time tau. */
typedef struct kg_smoother {
  int count;
  double *D, *L1, *L2; /* A = L diag(D) L', L unit lower with two sub-diagonals */
} kg_smoother;

/* Arrays from the arena (check kg_arena_failed). */
void kg_smoother_create(kg_smoother *smoother, int count, kg_arena *arena);
void kg_smoother_factor(kg_smoother *smoother, const double *weight, double tau4); /* NULL: zeros */
/* y <- A^-1 y, over every stride-th number. */
void kg_smoother_solve(const kg_smoother *smoother, double *y, int stride);
/* The same for every column of y (count, width); width a multiple of KG_SMOOTHER_COLUMNS. */
enum { KG_SMOOTHER_COLUMNS = 8 };
void kg_smoother_solve_rows(const kg_smoother *smoother, double *y, int width);

/* ---- reference.c ----------------------------------------------------------------------------- */

/* A point of the body that the reference holds still on the ground. */
typedef struct kg_planted_point {
  int point;      /* index into body->points */
  kg_vec3 x;      /* where it is held, m     */
  kg_vec3 normal; /* of the ground           */
  bool rolls;     /* carries, but is not held: part of a body that lies or rolls */
} kg_planted_point;

enum { KG_MAX_PLANTED = 16 };

/* The kinematic reference of a simulation: the capture, smoothed, with its feet planted. */
typedef struct kg_reference {
  int count;                 /* N simulation frames; frame k is at time k dt              */
  double dt;                 /* s, simulation step                                        */
  double *q;                 /* (N, nq)                                                      */
  int *planted_count;        /* (N)                                               */
  kg_planted_point *planted; /* (N, KG_MAX_PLANTED)                               */
  double *clearance;         /* (N, 2) what a foot in the air must keep from the ground, m */
  kg_vec3 *missing_force;    /* (N) of the wrench the plan found no contact for, N and N m */
  kg_vec3 *missing_moment;   /* (N) about the centre of mass                               */
} kg_reference;

/* Arrays come from the arena. KG_ERR_NO_MEMORY; KG_ERR_UNSUPPORTED for more than 5e6 steps. */
KG_MUST_USE kg_status kg_reference_create(kg_reference *reference, const kg_subject *subject,
                                          const kg_track_params *params, double dt, double gravity,
                                          double friction, kg_arena *arena);

/* ---- plan.c ---------------------------------------------------------------------------------- */

/* Moves the root of the reference so that forces at its planted points can explain its momentum.
 * KG_ERR_NO_MEMORY. */
KG_MUST_USE kg_status kg_plan_momentum(kg_reference *reference, const kg_subject *subject,
                                       const kg_track_params *params, double gravity,
                                       double friction, const kg_allocator *allocator);

/* ---- track.c, smooth.c: the methods of kg_correct ---------------------------------------------- */

KG_MUST_USE kg_status kg_correct_track(kg_correct_result *result, const kg_subject *subject,
                                       const kg_correct_def *def, kg_arena *arena);
KG_MUST_USE kg_status kg_correct_sdf(kg_correct_result *result, const kg_subject *subject,
                                     const kg_correct_def *def, kg_arena *arena);
/* q (frames, nq) = the capture with limbs that are in each other or in another athlete led apart by the
 * smooth method, ground and scene left out, as far as it gets: millimetres can remain. *interrupted: set
 * when def's progress asks for it, which is told of no progress yet. KG_ERR_NO_MEMORY. */
KG_MUST_USE kg_status kg_part_limbs(double *q, bool *interrupted, const kg_subject *subject,
                                    const kg_correct_def *def, const kg_allocator *allocator);

#endif
