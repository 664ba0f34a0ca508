/* Inside physics/: one Newton iteration of the step with contact solved on its own
 * (docs/theory/contact.md, section 4; equation numbers from there). The body is linearised about a
 * trial v'; what is left is a small non-linear problem in the wrenches on the few segments near the
 * ground, its slots.
 *
 * small_body.c: the slots and how they yield. small_problem.c: the law and the solution. */
#ifndef PHYSICS_SMALL_PROBLEM_H
#define PHYSICS_SMALL_PROBLEM_H

#include "physics/step_problem.h"

/* Where a point is, how fast, and the force on it; x relative to O. */
typedef struct kg_point_state {
  kg_vec3 x, u, f;
} kg_point_state;

/* A point that may touch. */
typedef struct kg_candidate {
  int point, slot;
  kg_point_state trial;            /* at the trial v'; f: what the body was linearised with     */
  kg_vec3 normal;                  /* of the ground, at the trial v'                            */
  double yield_n, yield_t;         /* velocity per force of the point alone, m/s per N          */
  double next_bound, change, gain; /* search for the bounds that are normal forces       */
} kg_candidate;

/* Eight candidates side by side: number k + 8 c is component c of candidate k. Lanes without one are
 * far from any ground. */
typedef struct kg_candidate_lanes {
  double trial[72];          /* x, u, f as in kg_point_state                                    */
  double now[72];            /* iterate: x and u follow from all f by the linear body           */
  double old[72], next[72];  /* the iterate before; a whole iteration on                        */
  double good[72];           /* solution of an easier problem                                   */
  double ground[88];         /* at `now`: distance, normal, velocity, friction, and the soft
                                layer's thickness, stiffness, damping, as in kg_contact_site    */
  double at[48], there[88];  /* where the law is linearised, x and u, and the ground there      */
  double touches[8], way[8]; /* the law is not zero there; (17) of each                         */
  double law[24];            /* its force there                                                 */
  double by_x[72], by_u[72]; /* and derivatives                                                 */
  double yield[16];          /* yield_n, yield_t                                                */
  double bound[8];           /* of friction over mu, N; < 0: the normal force                   */
} kg_candidate_lanes;

/* 6x6, rows of eight numbers, the last two zero */
typedef struct kg_small_block {
  double m[48];
} kg_small_block;

typedef struct kg_small_problem {
  int slots, count;
  int stride;                /* of rows of 6 * slots numbers, a multiple of 8                  */
  int *segment;              /* of a slot                                                      */
  int *slot_of;              /* (n) or -1                                                      */
  int *blocks, block_count;  /* on the paths to the slots, ascending                           */
  bool *on_path;             /* (n + 1)                                                        */
  kg_candidate *candidates;  /* (points)                                                       */
  kg_candidate_lanes *lanes; /* (groups) of the candidates, eight by eight                     */
  int groups;
  kg_vec3 *force;             /* (points) to linearise with                                     */
  double *Y;                  /* (nv, stride) A^-1 S' of unit wrenches on the slots             */
  double *xi, *nu;            /* (n + 1, 6, stride) what these do: twist, change of velocity    */
  kg_motion *xi0, *nu0;       /* (slots) without any change of wrenches                         */
  kg_motion *xi_now, *nu_now; /* (slots) scratch                                              */
  kg_small_block *K, *D;      /* (slots) (10), (11) of the law                                */
  bool *touching;             /* (slots) with a point that touches where the law is linearised  */
  double *B;                  /* (6 slots, stride) Jacobian of the small problem                */
  double *h;                  /* (6 slots) change of the wrenches                               */
  double *rest;               /* (6 slots) scratch                                              */
  double *free, *G;           /* (nv) change of v' without h; scratch                           */
  double body_error;          /* residual (19) at the trial v' under the forces assumed         */
  double tolerance;           /* kg^1/2 m/s                                                     */
} kg_small_problem;

/* Memory from the arena; check kg_arena_failed. */
kg_small_problem *kg_small_create(const kg_body *body, kg_arena *arena);

/* ---- small_body.c ---- */

/* Forces to start from: those at (q, v) of the step. Leaves the links there; after
 * kg_step_set_scale. */
void kg_small_begin(kg_step *s);
/* Lists slots and candidates about x, where the step must be evaluated, and linearises the body there
 * with the forces p->force; s->J holds the factors, rhs[nv] the right-hand side without h. False:
 * singular. damping: of diag(M) / dt, added to the Jacobian. */
bool kg_small_linearize(kg_step *s, double damping, double *rhs);
/* The same at another v' with the factors, subspaces and compliance of the last linearisation. */
void kg_small_move_on(kg_step *s, double *rhs);
/* S'h of the slots added to rhs[nv]. */
void kg_small_add_wrenches(const kg_step *s, const double *h, double *rhs);
/* The same of one wrench. */
void kg_small_add_wrench(const kg_step *s, int segment, kg_force wrench, double *rhs);

/* ---- small_problem.c ---- */

typedef enum kg_small_result {
  KG_SMALL_SOLVED,
  KG_SMALL_BOUNDED, /* with friction bounded by other forces than the normal ones */
  KG_SMALL_FAILED
} kg_small_result;

typedef struct kg_small_report {
  int iterations; /* of the small problem                              */
  int cuts;       /* halvings of its steps                             */
  bool fallback;  /* softer laws or bounded friction were needed       */
  bool exact;     /* the law itself was solved; else bounded friction  */
} kg_small_report;

/* d[nv]: change of v' from x. False: no direction. Adds to the report, `exact` is set. */
bool kg_small_direction(kg_step *s, double *d, const double *x, double damping,
                        kg_small_report *report);
/* The same with the factors of the last direction, at the law itself without a fallback. */
bool kg_small_chord(kg_step *s, double *d, const double *x, kg_small_report *report);

#endif
