/* kinegrad/stage.h - the scene of a subject at a time: its shapes, those that move, and another
 * athlete in the middle of them.
 *
 * Time 0 is the first motion frame of both clips. The other athlete's segments carry the shapes of
 * its body (kg_body_shape), posed by its own clip: linear and spherical linear interpolation between
 * frames, velocities by differences over one of them. Before and after its clip it is not there.
 * Places of the scene that have a velocity go on with it: at + velocity t, exp(spin t) turn. */
#ifndef KINEGRAD_STAGE_H
#define KINEGRAD_STAGE_H

#include "kinegrad/subject.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_stage kg_stage; /* one per thread */

typedef enum kg_stage_part {
  KG_STAGE_ALL,        /* subject->scene and subject->other                                   */
  KG_STAGE_SCENE_ONLY, /* subject->scene alone                                                */
  KG_STAGE_OTHER_ONLY  /* subject->other alone: shape k is that of other->body->shapes[k]     */
} kg_stage_part;

/* The subject is borrowed. KG_ERR_NO_MEMORY. */
KG_API KG_MUST_USE kg_status kg_stage_create(kg_stage **stage, const kg_subject *subject,
                                             kg_stage_part part, const kg_allocator *allocator);
KG_API void kg_stage_destroy(kg_stage *stage);

/* Moves everything to a time (s). near: where the subject's root is; the other athlete is left out
 * where it is further than both can reach and a metre more. Allocates nothing. */
KG_API void kg_stage_set(kg_stage *stage, double time, kg_vec3 near);
/* The scene as it is now: always at the same address, so that a step or a correction may keep it. */
KG_API const kg_scene *kg_stage_scene(const kg_stage *stage);

/* Of the other athlete's body: the segment that carries shape number i of the scene; -1 for shapes that
 * are none of its. */
KG_API int kg_stage_other_segment(const kg_stage *stage, int i);

/* Whether a scene has room for the shapes of a body. */
KG_API bool kg_stage_has_room(const kg_scene *scene, const kg_body *body);

#ifdef __cplusplus
}
#endif
#endif
