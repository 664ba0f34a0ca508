/* kinegrad/correct.h - correction of a captured clip: from clip to clip.
 *
 *   KG_CORRECT_SDF    kinematic: the smallest smooth change of the poses that removes penetration
 *   KG_CORRECT_TRACK  the body is simulated; torques from inverse dynamics plus feedback, the root
 *                     assisted by a wrench that is reported as the residual
 *
 * Reference for both: docs/theory/track.md. */
#ifndef KINEGRAD_CORRECT_H
#define KINEGRAD_CORRECT_H

#include "kinegrad/base.h"
#include "kinegrad/contact.h"
#include "kinegrad/subject.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum kg_correct_method { KG_CORRECT_SDF, KG_CORRECT_TRACK } kg_correct_method;

/* Called with the share done, 0 to 1: by track after every step, by sdf now and then. Returning false stops
 * (result->interrupted). */
typedef bool kg_progress_fn(double share, const char *stage, void *user);

/* Everything that was tuned, in one place; defaults in kg_track_default_params(). How they were
 * chosen, and their scores on clips they were not tuned on: docs/design/003-track.md. */
typedef struct kg_track_params {
  double smoothing_hz;    /* zero-lag low-pass of the capture before anything else          */
  double plant_speed;     /* m/s; a point slower than this and low is planted               */
  double plant_height;    /* m; above the ground, in the capture                            */
  double plant_flat;      /* m; above the lowest point of its foot                          */
  double rest_height;     /* m; Phi of a planted point in the reference                     */
  double clearance;       /* m; of a foot in the air                                        */
  double clearance_speed; /* m/s; at which the clearance is gained                          */
  double ease_time;       /* s; over which the feet's corrections fade                      */
  double plan_force;      /* m/s^2; residual force over mass that weighs as much in the plan as
                                moving the body by 2 cm                                        */
  double plan_moment;     /* rad/s^2; residual moment over inertia, the same                */
  double plan_patience;   /* of both together, beyond which the plan gives a frame up       */
  double catch_speed;     /* m/s; fastest way of a planted point to its place               */
  double joint_frequency; /* Hz; feedback of the joints, critically damped                  */
  double root_frequency;  /* Hz; feedback of the root, critically damped                    */
  double wrench_weight;   /* cost of the root wrench over that of the same acceleration     */
  double moment_weight;   /* the same for its moment                                        */
  double joint_damping;   /* N m s/rad; implicit velocity feedback of every joint           */
  double leg_weight;      /* kg m^2; cost of a leg joint's deviation, beside its inertia    */
  double trunk_weight;    /* kg m^2; the same for the other joints                          */
  double friction_share;  /* of the friction cone that plan and controller may use          */
} kg_track_params;

KG_API kg_track_params kg_track_default_params(void);

/* Start from kg_correct_default_def(). */
typedef struct kg_correct_def {
  kg_correct_method method; /* default track                                             */
  kg_track_params track;
  double dt;      /* s, simulation step; 0: the frame time, or an even share of it
                                    at most 0.01                                              */
  double gravity; /* m/s^2, default 9.8                                        */
  kg_contact_params contact;
  int threads;              /* default 1, at most 16; used where frames do not depend on each
                               other (sdf); results do not depend on it                     */
  kg_progress_fn *progress; /* NULL: none                                                */
  void *progress_user;
  const kg_allocator *allocator;
} kg_correct_def;

/* Ground reaction on one foot in one frame. */
typedef struct kg_foot_force {
  kg_vec3 force; /* N, world                                              */
  kg_vec3 cop;   /* centre of pressure on the ground, m; zero when unloaded */
  double moment; /* N m, free moment about the ground's normal             */
} kg_foot_force;

/* Everything per motion frame t in [0, T). Torques and forces are those of the step that ends at
 * frame t (frame 0 repeats frame 1). */
typedef struct kg_correct_result {
  int frame_count; /* T                                                          */
  int nq, nv;
  double *q;                /* (T, nq) corrected states                                   */
  double *v;                /* (T, nv) velocities; NULL for sdf                           */
  double *tau;              /* (T, nv) joint torques, N m; root entries zero; NULL for sdf */
  kg_vec3 *residual_force;  /* (T) root wrench, world axes, N; NULL for sdf               */
  kg_vec3 *residual_moment; /* (T) about the body's centre of mass, world axes, N m       */
  kg_foot_force *feet;      /* (T, 2) left, right; NULL for sdf                           */
  kg_vec3 *other_force;     /* (T) contact on anything but the feet, N; NULL for sdf      */
  double *penetration;      /* (T) d_pen, m                                               */
  double *correction_force; /* (T) M dq / dt^2 and M dv / dt of the SDF loop as a force, N */
  int *contact_count;       /* (T)                                                        */
  bool *unexplained;        /* (T) no contact explains the motion: external support missing */

  /* residuals (docs/theory/metrics.md) */
  double peak_grf;                                  /* N                                        */
  double residual_force_rms, residual_force_peak;   /* over peak_grf, or the weight if that is 0 */
  double residual_moment_rms, residual_moment_peak; /* over peak_grf * com height               */
  double correction_force_ratio;                    /* RMS over peak_grf                        */
  double correction_force_ratio_peak;
  int unexplained_count;

  /* solver */
  long steps, steps_converged, steps_substepped, newton_iterations;
  double newton_residual_max; /* kg^1/2 m/s                               */
  int *substepped_frames;     /* (substepped_count) motion frame numbers  */
  int substepped_count;
  int *restart_frames;           /* (restart_count) motion frames in which the simulation was
                                    lost and set back to the reference; NULL for sdf          */
  int restart_count;
  int sdf_iterations; /* of the correction loop                   */

  /* wall time per output frame, ms (Fig. 3) */
  double ms_encoder, ms_policy, ms_step, ms_sdf, ms_per_frame;

  bool interrupted;
  const kg_allocator *allocator;
  void *memory;
} kg_correct_result;

KG_API kg_correct_def kg_correct_default_def(void);
KG_API KG_MUST_USE kg_status kg_correct(kg_correct_result **result, const kg_subject *subject,
                                        const kg_correct_def *def, kg_error *error);
KG_API void kg_correct_result_destroy(kg_correct_result *result);

/* Writes the corrected states into clip (the capture, or a copy of it), motion frames only. */
KG_API void kg_correct_apply(const kg_correct_result *result, const kg_subject *subject,
                             kg_clip *clip);

#ifdef __cplusplus
}
#endif
#endif
