/* kinegrad/subject.h - everything that is derived from a captured clip before anything is changed:
 * mapping, floor, feet, body, scene, and the motion as body states.
 *
 * The metrics of an output use the subject of its capture, so that both share one floor and one
 * body (docs/theory/metrics.md). */
#ifndef KINEGRAD_SUBJECT_H
#define KINEGRAD_SUBJECT_H

#include "kinegrad/base.h"
#include "kinegrad/body.h"
#include "kinegrad/clip.h"
#include "kinegrad/sdf.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The ground under a capture. Estimated from the frames in which a foot stands still and low. */
typedef struct kg_floor {
  double height;      /* m, of the plane at x = z = 0                                      */
  kg_vec3 normal;     /* unit                                                              */
  double tilt;        /* rad, between normal and the vertical                              */
  bool given;         /* height given by the caller; no tilt then                          */
  int stance_frames;  /* foot-frames the estimate rests on                                 */
  double spread;      /* m, median absolute deviation of the stance heights from the plane */
  kg_foot_fit feet[2];
} kg_floor;

/* Start from kg_subject_default_def(). Pointers are borrowed for the call only, except `extra`
 * meshes and fields, which must outlive the subject. */
typedef struct kg_subject_def {
  const char *map_path;         /* role map, NULL: by names                     */
  bool floor_given;
  double floor_height;          /* m                                            */
  double mass_kg;               /* default 70                                   */
  kg_sex sex;
  const kg_scene *extra;        /* shapes added to the ground plane; NULL: none */
  const kg_ground *ground;      /* what covers the plane; NULL: nothing, it is hard */
  const struct kg_subject *other; /* another athlete in the same world, NULL: none; borrowed by the
                                     subject. kinegrad/stage.h                  */
  bool self;                    /* the body's own segments are in each other's way too, in metrics
                                   and correction; default false. kinegrad/self.h              */
  const kg_allocator *allocator;
} kg_subject_def;

typedef struct kg_subject {
  kg_mapping mapping;
  kg_floor floor;
  kg_scene scene;         /* shape 0 is the ground plane             */
  const struct kg_subject *other; /* borrowed, NULL: none            */
  bool self;              /* of the definition                       */
  kg_body *body;
  int joint_count;        /* of the clip                             */
  int first_frame;        /* of the clip: the first that is motion   */
  int frame_count;        /* T, motion frames                        */
  double dt;              /* s, the clip's frame time                */
  double *q;              /* (T, nq) states of the capture           */
  const kg_allocator *allocator;
  void *memory;
} kg_subject;

KG_API kg_subject_def kg_subject_default_def(void);
KG_API KG_MUST_USE kg_status kg_subject_create(kg_subject **subject, const kg_clip *clip,
                                               const kg_subject_def *def, kg_error *error);
KG_API void kg_subject_destroy(kg_subject *subject);

/* States (T, nq) of another clip with the same joints and frame count (an output), read with the
 * subject's body. KG_ERR_FORMAT when joints or frame count differ; *error says which. */
KG_API KG_MUST_USE kg_status kg_subject_states(const kg_subject *subject, const kg_clip *clip,
                                               double *q, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
