/* kinegrad/correction.h - penetration of a pose and its correction (docs/theory/sdf.md).
 *
 *   d_pen  = max_k max(-Phi(x_k), 0)                                                     (9)
 *   L_coll = sum_k max(-Phi(x_k), 0)^2                                                   (10)
 *   q     <- q (+) (-eta grad L_coll), eta limited so that L_coll falls as predicted     (11)
 *
 * The gradient is taken in the metric of the mass matrix over the total mass, which for a move of
 * the whole body is the plain one.
 *
 * Second order: the least move D in the mass metric of the start, min 1/2 D' M(q_0) D subject to
 * Phi_k(q_0 (+) D) >= 0, by sequential quadratic programming. That problem has many minima in deep
 * poses; from each start the steps lead to one, and the shortest of them is the answer. The
 * gradient method ends with the same steps, so that both leave the body at the surface. (9) to (11)
 * are equations of the paper cited there. */
#ifndef KINEGRAD_CORRECTION_H
#define KINEGRAD_CORRECTION_H

#include "kinegrad/body.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/sdf.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum kg_correction_method {
  KG_CORRECTION_GRADIENT,    /* Eq. 11 with a safe step                   */
  KG_CORRECTION_SECOND_ORDER /* constrained minimum in the mass metric    */
} kg_correction_method;

/* Start from kg_correction_default_def(body, scene). Borrowed pointers outlive the correction. */
typedef struct kg_correction_def {
  const kg_body *body;
  const kg_scene *scene;
  kg_correction_method method; /* default second order                         */
  double tolerance;            /* m, on d_pen; default 1e-5                    */
  double eta;                  /* of Eq. 11, an upper limit; default 0.1       */
  int max_iterations;          /* of the gradient; default 200                 */
  int starts;                  /* of the second order: ways out that are followed at most, >= 1. Default 1,
                                  the one that begins with no move: the same way in neighbouring poses,
                                  and not the shortest in half of the deep ones. 12 find the shortest in
                                  99 of 100, at seven times the time; shallow poses have no other way */
  double kkt_tolerance;        /* kg^1/2 m: the conditions of the least move hold to it, and D is
                                  differentiable; default 0: within a few percent of the least */
  bool self;                   /* points of the body are also kept out of its own segments, by the
                                  pairs of kinegrad/self.h; d_pen and L_coll count them. Default
                                  false                                        */
  const kg_allocator *allocator;
} kg_correction_def;

typedef struct kg_correction_report {
  bool converged;           /* d_pen <= tolerance                                   */
  int iterations;           /* all steps: of every way, whether followed to its end or given up, and
                               one for every start that was only looked at          */
  int iterations_of_answer; /* of the way that led to the answer                    */
  int starts;               /* ways followed; 0: the pose was left as it is         */
  double d_pen_before;      /* m                                                    */
  double d_pen_after;       /* m                                                    */
  double displacement;      /* sqrt(d' M d) of the whole move, kg^1/2 m             */
  double lowest;            /* smallest Phi at the end, m                           */
  int contact_count;        /* points that touch after the push                     */
  double kkt_residual;      /* of the least move, kg^1/2 m; NaN unless asked for    */
} kg_correction_report;

typedef struct kg_correction kg_correction; /* one per thread */

KG_API kg_correction_def kg_correction_default_def(const kg_body *body, const kg_scene *scene);
/* The body must not change from here on: its masses, lengths and points are taken over. The scene
 * may. KG_ERR_NO_MEMORY. */
KG_API KG_MUST_USE kg_status kg_correction_create(kg_correction **correction,
                                                  const kg_correction_def *def);
KG_API void kg_correction_destroy(kg_correction *correction);

/* Moves q[nq] out of the scene. v[nv] (NULL allowed) loses its component into the surface at the
 * points that touch after the push (inelastic, mass metric). moved[nv] (NULL allowed) gets the move
 * D, q_after = q_before (+) D. A pose within the tolerance is left bit for bit as it is. Allocates
 * nothing. */
KG_API kg_correction_report kg_correction_apply(kg_correction *correction, double *q, double *v,
                                                double *moved);

/* d_pen (m) of a pose, Eq. 9; L_coll (m^2) and its gradient in tangent space [nv], Eq. 10, where
 * not NULL. */
KG_API double kg_penetration(kg_correction *correction, const double *q, double *L_coll,
                             double *gradient);

/* One step of the method from q and no more, to look at how it converges. Returns d_pen after it; q
 * stays where no step is found. */
KG_API double kg_correction_step(kg_correction *correction, double *q);

/* ---- derivative of the corrected pose --------------------------------------------------------
 *
 * By the implicit function theorem at the least move, for both methods, which end there: q_after is
 * what kg_correction_apply made of q_before, with kkt_tolerance set (1e-10 say). Tangent spaces at
 * both poses.
 * The corrected pose has a kink where a point begins or ceases to carry: there the derivative is that
 * of the side on which it does not. At the tolerance, where the correction sets in, it jumps by up
 * to the tolerance. A pose that was left as it is has the identity. False, and nothing written or
 * added, where q_after is not the least move to a hundredth of its length (kkt_tolerance not set or
 * not reached), where the system has no inverse (two least moves meet), and where the body's own
 * segments carry (def.self): the second derivatives of those are not at hand. */

/* Adds J' after_bar to before_bar; [nv] each. */
KG_API bool kg_correction_vjp(kg_correction *correction, const double *q_before,
                              const double *q_after, const double *after_bar, double *before_bar);
/* J[nv*nv] = d q_after / d q_before, row-major */
KG_API bool kg_correction_jacobian(kg_correction *correction, const double *q_before,
                                   const double *q_after, double *J);

#ifdef __cplusplus
}
#endif
#endif
