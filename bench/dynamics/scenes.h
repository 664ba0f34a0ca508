/* Short runs of a body in flight, standing and lying, the same for every engine. */
#ifndef BENCH_DYNAMICS_SCENES_H
#define BENCH_DYNAMICS_SCENES_H

#include "bench/dynamics/models.h"
#include "kinegrad/step.h"

typedef enum kg_bench_situation {
  KG_BENCH_FLIGHT,   /* turning and moving every joint, nothing near */
  KG_BENCH_STANDING, /* on its soles, settled, then pushed every step */
  KG_BENCH_HELD,     /* the same without pushes                       */
  KG_BENCH_LYING     /* on its back, likewise                        */
} kg_bench_situation;

enum { KG_BENCH_STEPS = 16 };

typedef struct kg_bench_scene {
  kg_bench_model model;
  kg_bench_situation situation;
  kg_scene ground; /* y = 0 */
  double dt;       /* s */
  double *q, *v;   /* the start                                                               */
  double *tau;     /* (KG_BENCH_STEPS, nv): what holds the pose, and noise of 10 rad/s^2 times the
                      inertia that a joint turns                                              */
  double height;   /* of the centre of mass at the start, m                                   */
} kg_bench_scene;

kg_status kg_bench_scene_open(kg_bench_scene *scene, kg_bench_situation situation,
                              const kg_bench_setting *setting, kg_error *error);
void kg_bench_scene_close(kg_bench_scene *scene);

/* Damping of every joint in all runs, N m s/rad. */
static const double kg_bench_joint_damping = 2.0;

/* The step of a scene: defaults, its ground and the damping. */
kg_step_def kg_bench_scene_step_def(const kg_bench_scene *scene, const kg_allocator *allocator);

#endif
