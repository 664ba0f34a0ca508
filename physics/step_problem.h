/* Inside physics/: the equation of one backward Euler step, G(v') = 0, at a trial v' and its
 * Jacobian. step.c solves it; step_problem.c assembles it.
 *
 * Equation numbers: docs/theory/dynamics.md. */
#ifndef PHYSICS_STEP_PROBLEM_H
#define PHYSICS_STEP_PROBLEM_H

#include "kinegrad/step.h"

#include "physics/contact_law.h"
#include "physics/near_points.h"
#include "physics/tree.h"

enum { KG_STEP_RETURNED = 9 };

struct kg_step {
  kg_step_def def;
  kg_dynamics *dynamics;
  kg_contact_params contact; /* the law as it stands: def.contact, softer while a way is sought */
  near_points points;        /* in the order of the segments */
  kg_step_contact *contacts;
  int contact_count;
  kg_tree_matrix J;
  kg_mat3 *turns;    /* (n + 1) kg_step_turn_by_rate of every block */
  double *scale;     /* of the residual: diag(M)^-1/2 dt */
  double *q_end, *a; /* at the last evaluated v'         */
  double *v_end;     /* the v' the links were last evaluated at; only with evaluated */
  bool evaluated;
  double *G;          /* of a repeated evaluation     */
  double *d, *x_best; /* Newton's direction; iterate with the least residual */
  double *x_trial;
  double *q_sub, *v_sub, *x; /* state inside a sequence of sub-steps, unknowns */
  double *trace_q, *trace_v; /* states between the sub-steps of the last divided step */
  double *returned;          /* KG_STEP_RETURNED arrays of nv for the adjoint */
  /* the step being solved */
  const double *q, *v, *tau;
  double dt;
  struct kg_small_problem *small;
  kg_arena arena;
};

/* The step to be solved; the arrays are borrowed. */
void kg_step_set_problem(kg_step *s, const double *q, const double *v, const double *tau,
                         double dt);
/* diag(M(q))^-1/2 dt; leaves the links at the pose q. */
void kg_step_set_scale(kg_step *s);
/* |diag(M)^-1/2 G dt|, (19) */
double kg_step_merit(const kg_step *s, const double *G);

/* G(v_end), (17), a kg_residual_fn: user is the step. Leaves links and contacts there. */
bool kg_step_evaluate(double *G, const double *v_end, void *user);
/* Evaluates at x unless that is where the links are. */
void kg_step_ensure_evaluated(kg_step *s, const double *x);
/* Contact list and links at (q, v), the start of the step; after kg_step_set_scale. */
void kg_step_evaluate_start(kg_step *s);
/* G at the point of the last evaluation, for whatever external forces the links now have. */
void kg_step_project(kg_step *s, double *G);
/* s->J = dG/dv', (18), at the point of the last evaluation. */
void kg_step_linearize(kg_step *s);
/* The same with whatever external forces, K and D the segments' sums now have (kg_tree_prepare). */
void kg_step_assemble(kg_step *s);

/* After kg_step_linearize: P = dG/dq' (by a turn of q', v' held), M = dG/da. */
void kg_step_linearize_pose(kg_step *s, kg_tree_matrix *P);
void kg_step_mass(kg_step *s, kg_tree_matrix *M);
/* How v' moves the tangent of q': dt Jr(dt w) for block b > 0, dt 1 for the root's place. */
kg_mat3 kg_step_turn_by_rate(const kg_step *s, int b);

/* Repeats a step in so many equal sub-steps and leaves the states between them in trace_q, trace_v;
 * false when one of them does not converge. */
bool kg_step_trace(kg_step *s, const double *q, const double *v, const double *tau, double dt,
                   int substeps);

/* Distances of the points of a link from the ground, where a plane is all of the scene; a lower bound
 * elsewhere: above + across . p for the point p in the link's axes. */
typedef struct kg_link_height {
  double above;
  kg_vec3 across;
} kg_link_height;

kg_link_height kg_step_link_height(const kg_step *s, int i);
/* The point is farther than `distance` from the ground for sure. */
static inline bool kg_is_above(const kg_link_height *h, kg_vec3 p, double distance)
{
  const double rounding = 1e-9; /* m */
  return h->above + kg_vec3_dot(h->across, p) > distance + rounding;
}

/* No point of the ball's segment, which is at that height, is within the layer or `margin` beyond it,
 * as far as the ball tells. */
bool kg_step_is_far(const kg_step *s, const segment_ball *ball, const kg_link_height *height,
                    double margin);

/* Velocity of the point x (relative to O) of a segment. */
static inline kg_vec3 kg_point_velocity(const kg_link *l, kg_vec3 x)
{
  return kg_vec3_add(l->p_dot, kg_vec3_cross(l->w, kg_vec3_sub(x, l->p)));
}

#endif
