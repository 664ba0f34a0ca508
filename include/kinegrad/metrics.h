/* kinegrad/metrics.h - the numbers of a motion, and every constant they rest on.
 * Definitions, choices and the paper that is cited: docs/theory/metrics.md. */
#ifndef KINEGRAD_METRICS_H
#define KINEGRAD_METRICS_H

#include "kinegrad/base.h"
#include "kinegrad/contact.h"
#include "kinegrad/subject.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Constants of the metrics: printed in every report, changed nowhere else. */
#define KG_METRIC_EVENT_DEPTH_M 1e-3       /* penetration event: d_pen above this               */
#define KG_METRIC_TOUCH_DEPTH_M 1e-5       /* a frame is inside, or touches: d_pen above this   */
#define KG_METRIC_SLIP_HEIGHT_M 0.010      /* a node slips when Phi <= this in both frames      */
#define KG_METRIC_MOMENTUM_DT_S 0.02       /* resampling for angular_momentum_change            */
#define KG_METRIC_SMOOTHING_HZ 20.0        /* zero-lag Butterworth, order 4, before derivatives */
#define KG_METRIC_BALANCE_HEIGHT_M 0.020   /* points that may carry force in momentum_balance   */
#define KG_METRIC_FRICTION 0.9             /* of the force fit                                  */
#define KG_METRIC_VALIDITY_B 0.0731        /* per kg m^2/s; non-negative least squares on the   */
#define KG_METRIC_VALIDITY_C 0.0231        /* per mm at 50 Hz; five rows of the paper's Table 2 */
#define KG_METRIC_GRAVITY 9.8              /* m/s^2, of the force fit                           */
#define KG_METRIC_SKATE_SPEED 0.1          /* m/s; foot_skate_ratio                             */
#define KG_METRIC_LEAST_ACCELERATION 1.0   /* m/s^2; lower bound of both peaks in their ratio   */
#define KG_METRIC_NORMALIZED_FRAMES 100    /* of mpjpe against normalised time                  */

/* What a body may be inside of. */
typedef enum kg_obstacle {
  KG_OBSTACLE_SCENE, /* floor and shapes                        */
  KG_OBSTACLE_OTHER, /* the other athlete (subject->other)      */
  KG_OBSTACLE_SELF,  /* segments of its own (kinegrad/self.h)   */
  KG_OBSTACLE_COUNT
} kg_obstacle;

/* The deepest point of a motion in one of them; depth 0 and -1 for the rest when none is inside. */
typedef struct kg_deepest {
  double depth; /* m                                                          */
  int frame;    /* motion frame, the first of equals                          */
  int segment;  /* whose point it is                                          */
  int entered;  /* segment it is in, of the other or its own; -1 in the scene */
} kg_deepest;

/* Metrics of one motion (the capture or the output) under the subject's body and scene. */
typedef struct kg_motion_metrics {
  double penetration_events;        /* share of frames                        */
  double penetration_max_m;
  double penetration_mean_m;        /* over frames deeper than KG_METRIC_TOUCH_DEPTH_M; 0: none */
  double slip_m;                    /* per frame at the clip's own rate       */
  double slip_m_per_s;
  double slip_50hz_m;               /* the one validity uses                  */
  double angular_momentum_change;   /* kg m^2/s at 50 Hz                      */
  double angular_momentum_drift;    /* kg m^2/s, against frame 0              */
  double angular_momentum_drift_flight; /* in flight only, against its start; 0 without flight */
  double validity;                  /* 0 to 1                                 */
  double momentum_balance;          /* N m, mean norm of dL/dt - best moment contacts can give */
  double force_balance;             /* N, the same for dP/dt                  */
  double jerk_rms;                  /* m/s^3 over joints and frames           */
  double spectral_arc_length;       /* of the mean joint speed, dimensionless */
  double foot_skate_ratio;          /* share of node-frames at Phi <= 10 mm faster than 0.1 m/s */
  /* of the body's points in the other athlete's (subject->other); NAN without one. The first three
     numbers of this struct are of the scene alone */
  double other_penetration_events;  /* share of frames                        */
  double other_penetration_max_m;
  double other_penetration_mean_m;
  double other_frames;              /* frames in which a point is inside by more than 0.01 mm */
  /* of the body's points in segments of its own (kinegrad/self.h); NAN unless subject->self */
  double self_penetration_events;   /* share of frames deeper than KG_METRIC_EVENT_DEPTH_M    */
  double self_penetration_max_m;
  double self_penetration_mean_m;
} kg_motion_metrics;

typedef struct kg_metrics {
  int frame_count, joint_count;     /* T motion frames, n segments                     */
  double mpjpe_m;                   /* mean                                            */
  double mpjpe_max_m;               /* worst joint-frame                               */
  double *mpjpe_joint_m;            /* (n)                                             */
  double *mpjpe_frame_m;            /* (T)                                             */
  double mpjpe_normalized_m[KG_METRIC_NORMALIZED_FRAMES];
  double acceleration_peak_ratio;   /* worst over joints: peak acceleration of the output over the
                                       capture's; second differences at the clip's rate        */
  int acceleration_peak_joint;      /* segment where it occurs                         */
  double *penetration_frame_m;      /* (T) d_pen of the output                         */
  double *other_penetration_frame_m; /* (T) of the output in the other athlete; zero without one */
  double *self_penetration_frame_m; /* (T) of the output in itself; zero unless subject->self */
  kg_motion_metrics capture, output;
  kg_deepest capture_deepest[KG_OBSTACLE_COUNT], output_deepest[KG_OBSTACLE_COUNT];
  const kg_allocator *allocator;
  void *memory;
} kg_metrics;

/* q_out: (T, nq) states of the output; the capture's are the subject's own. */
KG_API KG_MUST_USE kg_status kg_metrics_create(kg_metrics **metrics, const kg_subject *subject,
                                               const double *q_out);
KG_API void kg_metrics_destroy(kg_metrics *metrics);

/* validity = 1 - b * change - c * slip, clipped to [0, 1] (a = 0: events carry no weight). */
KG_API double kg_metric_validity(double angular_momentum_change, double slip_50hz_m);

/* Non-negative least squares: x >= 0 that minimises |A x - b|_2; A (m, n) row-major.
 * [LH] C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, 1974, algorithm NNLS. work holds
 * kg_nnls_work_size(m, n) doubles. Returns the residual norm. */
KG_API size_t kg_nnls_work_size(int m, int n);
KG_API double kg_nnls(double *x, const double *A, const double *b, int m, int n, double *work);

#ifdef __cplusplus
}
#endif
#endif
