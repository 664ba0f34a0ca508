/* Private to the metrics: what metrics.c, measure.c, balance.c and smoothness.c share. */
#ifndef PIPELINE_MEASURE_H
#define PIPELINE_MEASURE_H

#include "kinegrad/arena.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"
#include "kinegrad/self.h"
#include "kinegrad/stage.h"

enum {
  KG_PROBE_PER_SEGMENT = 8, /* lowest samples of a segment that may carry force, sole nodes apart */
  KG_PROBE_CARRIERS = 64,   /* in all */
  KG_PROBE_NODES = 2 * KG_SOLE_NODE_COUNT,
  KG_FRICTION_EDGES = 8
};

/* A point of the body near the scene's surface. */
typedef struct kg_probe_point {
  int segment, point;
  kg_vec3 x, normal;
  double distance; /* from the outside of soft layers; INFINITY when the point is farther than the
                      probe looks */
} kg_probe_point;

/* One pose against the scene. */
typedef struct kg_probe {
  double lowest;                        /* smallest Phi seen, INFINITY when none is near  */
  double lowest_soft;                   /* the same from the outside of soft layers       */
  int lowest_segment;                   /* whose Phi the smallest is, -1: none is near    */
  kg_probe_point nodes[KG_PROBE_NODES]; /* of the soles                                   */
  int node_count;
  kg_probe_point carriers[KG_PROBE_CARRIERS]; /* points with Phi <= KG_METRIC_BALANCE_HEIGHT_M */
  int carrier_count;
  int carrier_nodes; /* of the carriers, how many are sole nodes; they come first */
} kg_probe;

typedef struct kg_ball {
  kg_vec3 center; /* segment frame */
  double radius;
} kg_ball;

/* Everything a measurement needs; one per call of kg_metrics_create. */
typedef struct kg_measure {
  const kg_subject *subject;
  kg_dynamics *dynamics;
  kg_stage *scene; /* without the other athlete           */
  kg_stage *other; /* the other athlete alone, NULL: none */
  kg_self *self;   /* NULL: not asked for                 */
  int T;           /* motion frames                       */
  double dt;       /* s                                   */
  kg_ball *bounds; /* (n) around the points of a segment  */
  kg_vec3 *p;      /* (n) pose scratch                    */
  kg_mat3 *R;      /* (n)                                 */
  double *v;       /* (nv)                                */
  double *q[3];    /* (nq) resampled states               */
  kg_probe probe[2];
  kg_vec3 *com;   /* (T) m                               */
  kg_vec3 *L;     /* (T) about the com, kg m^2/s         */
  bool *flight;   /* (T) no point within the balance height */
  double *series; /* (T)                                 */
  double *filter_work;
  double *spectrum; /* (2 * fft_size)                      */
  int fft_size;
  double *A, *x, *nnls_work;
  int reach;        /* frames the smoothing looks to either side */
  kg_probe *window; /* (2 reach + 1)                             */
  kg_scene_hint *hints; /* (points) of the pose before   */
  long *stamp;      /* (points) last frame a point was taken     */
} kg_measure;

/* False when memory is refused; release in any case. */
bool kg_measure_create(kg_measure *measure, const kg_subject *subject, kg_arena *arena);
void kg_measure_release(kg_measure *measure);

/* All metrics of a motion (T, nq). joints (T, n): world positions of the joints, out. depths: NULL, or
 * for every obstacle (T) d_pen in it, out, zero where it is not there. deepest: out. */
kg_motion_metrics kg_measure_motion(kg_measure *measure, const double *q, kg_vec3 *joints,
                                    double *const depths[KG_OBSTACLE_COUNT],
                                    kg_deepest deepest[KG_OBSTACLE_COUNT]);

/* The pose against the scene as it is at `time` (s); fills probe, leaves the pose in measure->p and
 * R. */
void kg_measure_probe(kg_measure *measure, const double *q, double time, kg_probe *probe);

/* Frames to either side whose contacts the smoothed forces of a frame contain. */
int kg_measure_balance_reach(double dt);

/* momentum_balance and force_balance of a motion whose com and L are in measure (both are smoothed
 * in place). */
void kg_measure_balance(kg_measure *measure, const double *q, kg_motion_metrics *out);

/* jerk_rms and spectral_arc_length from joint positions (T, n). */
void kg_measure_smoothness(kg_measure *measure, const kg_vec3 *joints, kg_motion_metrics *out);

/* Doubles of transform length for the spectral arc length of T frames. */
int kg_measure_fft_size(int T);

#endif
