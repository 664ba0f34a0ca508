/* kinegrad/correction.h - penetration of a pose and its correction (Eq. 9 to 11; DESIGN section 7).
 *
 *   d_pen  = max_k max(-Phi(x_k), 0)                                                     (9)
 *   L_coll = sum_k max(-Phi(x_k), 0)^2                                                   (10)
 *   q     <- q (+) (-eta grad L_coll), eta limited so that L_coll falls as predicted     (11)
 *
 * Second order: repeat  min 1/2 d' M(q) d  subject to  Phi_k + n_k' J_k d >= 0  and q <- q (+) d. */
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
  kg_correction_method method;   /* default second order                         */
  double tolerance;              /* m, on d_pen; default 1e-5                    */
  double eta;                    /* of Eq. 11, 1/m; default 0.1                  */
  int max_iterations;            /* default 200                                  */
  const kg_allocator *allocator;
} kg_correction_def;

typedef struct kg_correction_report {
  bool converged;          /* d_pen <= tolerance                                   */
  int iterations;
  double d_pen_before;     /* m                                                    */
  double d_pen_after;      /* m                                                    */
  double displacement;     /* sqrt(d' M d) of the whole move, kg^1/2 m             */
  double lowest;           /* smallest Phi at the end, m                           */
  int contact_count;       /* points that were pushed                              */
} kg_correction_report;

typedef struct kg_correction kg_correction; /* one per thread */

KG_API kg_correction_def kg_correction_default_def(const kg_body *body, const kg_scene *scene);
KG_API KG_MUST_USE kg_status kg_correction_create(kg_correction **correction,
                                                  const kg_correction_def *def);
KG_API void kg_correction_destroy(kg_correction *correction);

/* Moves q[nq] out of the scene. v[nv] (NULL allowed) loses its component into the surface at the
 * pushed points (inelastic, mass metric). moved[nv] (NULL allowed) gets q_after (-) q_before. */
KG_API kg_correction_report kg_correction_apply(kg_correction *correction, double *q, double *v,
                                                double *moved);

/* d_pen (m) of a pose, Eq. 9; L_coll (m^2) and its gradient in tangent space [nv], Eq. 10, where
 * not NULL. */
KG_API double kg_penetration(kg_correction *correction, const double *q, double *L_coll,
                             double *gradient);

#ifdef __cplusplus
}
#endif
#endif
