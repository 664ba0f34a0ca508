/* Bodies and states that the suites `dynamics` and `step` are run on. */
#ifndef BENCH_DYNAMICS_MODELS_H
#define BENCH_DYNAMICS_MODELS_H

#include "kinegrad/body.h"
#include "kinegrad/random.h"

#include "bench/bench.h"

/* Which joints of a skeleton become segments. */
typedef enum kg_bench_skeleton {
  KG_BENCH_MAPPED,     /* the canonical ones, 23 at most                     */
  KG_BENCH_EVERY_JOINT /* all there are, 37 in the synthetic skeleton's case */
} kg_bench_skeleton;

/* Joints of the synthetic skeleton when all of them are kept. */
enum { KG_BENCH_SYNTHETIC_JOINTS = 37 };

typedef struct kg_bench_model {
  kg_clip *clip;
  kg_body *body;
  char source[200]; /* for the table */
} kg_bench_model;

/* data: NULL for the synthetic skeleton, a clip's file, or a folder that has gymnastics/
 * cmu_49_02.bvh (mapped) and gymnastics/snu_backflip.bvh (every joint). On failure nothing stays
 * allocated. */
kg_status kg_bench_model_open(kg_bench_model *model, kg_bench_skeleton skeleton, const char *data,
                              kg_error *error);
void kg_bench_model_close(kg_bench_model *model);

/* Every joint of a clip as a segment of 70 kg in all: rods from joint to joint, a ball of the same
 * mass around each, so that the inertia is regular. Ends without children are 5 cm long. */
kg_status kg_bench_body_of_every_joint(kg_body **body, const kg_clip *clip);

/* Any orientation of every joint, velocities of 3, accelerations of 30 (normal, SI units). */
void kg_bench_random_state(kg_random *random, const kg_body *body, double *q, double *v, double *a);

#endif
