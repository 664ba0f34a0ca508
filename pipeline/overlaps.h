/* Private to pipeline/: a body in itself or in another athlete, and to which side it is led out. */
#ifndef PIPELINE_OVERLAPS_H
#define PIPELINE_OVERLAPS_H

#include "kinegrad/dynamics.h"
#include "kinegrad/self.h"
#include "kinegrad/stage.h"
#include "kinegrad/subject.h"

typedef struct kg_overlaps kg_overlaps;

/* Looks for what overlaps in the capture and chooses the ways (pipeline/ways.h). self: NULL where the
 * body is not in its own way. All are borrowed; the stage is left at the last frame. KG_ERR_NO_MEMORY. */
KG_MUST_USE kg_status kg_overlaps_create(kg_overlaps **overlaps, const kg_subject *subject,
                                         kg_self *self, kg_stage *stage, kg_dynamics *dynamics,
                                         const kg_allocator *allocator);
void kg_overlaps_destroy(kg_overlaps *overlaps);

/* Turns a touch of a frame, pose p, R, to the way of its pair: distance and normal are then those of the
 * place where the point comes out along the way. Nothing is changed where the nearest place is within 60
 * degrees of it. False: the point is outside, on a side to which its pair does not go. */
bool kg_overlaps_turn_self(const kg_overlaps *overlaps, int frame, const kg_vec3 *p,
                           const kg_mat3 *R, kg_self_touch *touch);
/* The same for a point x of a segment whose nearest shape, number `shape` of the stage as it is, belongs
 * to the other athlete. */
bool kg_overlaps_turn_other(kg_overlaps *overlaps, int frame, int segment, int shape, kg_vec3 x,
                            kg_sdf_value *value);

#endif
