/* kinegrad/clip.h - captured motion in memory, and its readers and writers.
 *
 * A clip has a skeleton of J joints in depth-first order (parents before children), T frames and a
 * frame time. It holds the motion twice: as the file's own channel values (kept verbatim, so that
 * what was not changed is written back as it came) and as local rotations and translations in SI
 * units with Y up. kg_clip_set_* keep the two in step.
 *
 * Local frames: world rotation of joint j is R_parent * rotation[j]; world position is p_parent +
 * R_parent * translation[j]. For a joint without position channels translation is its offset;
 * position channels replace the offset, each its own component. Up-axis and unit conversion touch
 * only root joints' frames and all lengths; the other joints' local frames are the file's. */
#ifndef KINEGRAD_CLIP_H
#define KINEGRAD_CLIP_H

#include "kinegrad/base.h"
#include "kinegrad/quat.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum kg_channel {
  KG_CHANNEL_X_POSITION,
  KG_CHANNEL_Y_POSITION,
  KG_CHANNEL_Z_POSITION,
  KG_CHANNEL_X_ROTATION,
  KG_CHANNEL_Y_ROTATION,
  KG_CHANNEL_Z_ROTATION
} kg_channel;

typedef struct kg_joint {
  const char *name;
  int parent;             /* index, -1 for a root; always less than the joint's own index */
  kg_vec3 offset;         /* m, in the parent's frame                                      */
  bool has_end_site;
  kg_vec3 end_site;       /* m, in the joint's frame                                       */
  int channel_count;      /* 0 to 6                                                        */
  kg_channel channels[6]; /* in file order; rotations multiply left to right               */
  int first_channel;      /* index of channels[0] in a frame's values                      */
} kg_joint;

typedef enum kg_up_axis { KG_UP_Y, KG_UP_Z, KG_UP_X } kg_up_axis;

/* What the reader decided, and whether it was told or found out; `info` prints all of it. */
typedef struct kg_clip_source {
  char format[8];          /* "BVH" or "AMC"                                              */
  char path[512];
  char skeleton_path[512]; /* the ASF; "" for BVH                                         */
  double unit_m;           /* metres per file unit                                        */
  bool unit_given;         /* by the caller; else estimated from the size of the skeleton */
  char unit_reason[96];    /* e.g. "CMU (1/0.45 inch): stature 1.74 m"                    */
  kg_up_axis up;
  bool up_given;
  bool rate_given;         /* AMC states no rate: 120 Hz unless given                     */
  int first_frame;         /* 1 when frame 0 is an inserted T-pose, else 0                */
  char first_frame_reason[96];
  long declared_frames;    /* in the header; frames present may be fewer                  */
  int warning_count;
  char warnings[8][256];   /* "path:line:column: ..."                                     */
} kg_clip_source;

typedef struct kg_clip {
  int joint_count;         /* J                                                   */
  kg_joint *joints;
  int frame_count;         /* T, the inserted T-pose included                     */
  double frame_time;       /* s, as given in the file                             */
  int channel_count;       /* C                                                   */
  double *values;          /* (T, C) file units and degrees                       */
  kg_quat *rotations;      /* (T, J) local, unit, sign-continuous over time       */
  kg_vec3 *translations;   /* (T, J) local, m                                     */
  kg_clip_source source;
  const kg_allocator *allocator;
  void *memory;            /* owned by the clip                                   */
} kg_clip;

/* Start from kg_clip_default_def(). */
typedef struct kg_clip_def {
  double unit_m;                 /* metres per file unit; 0: estimate                       */
  bool up_given;                 /* use `up` instead of estimating it                       */
  kg_up_axis up;
  bool keep_first_frame;         /* treat frame 0 as motion even if it looks inserted       */
  const char *asf_path;          /* skeleton of an AMC; NULL: find it by name beside it     */
  double rate_hz;                /* of an AMC, or to override a BVH's; 0: 120 / the file's  */
  const kg_allocator *allocator; /* NULL: malloc and free                                   */
} kg_clip_def;

KG_API kg_clip_def kg_clip_default_def(void);

/* Reads BVH or AMC, recognised by content. Counts in the file are checked, memory follows the data:
 * frames that are declared but missing, a last frame that was cut off and frames beyond the
 * declared number are left out with a warning. Limits: 4096 joints (ASF: 1024), nested 512 deep,
 * 6 different channels each, numbers up to 1e12, frame times from 1e-6 s. On failure *clip is NULL,
 * nothing stays allocated, and *error has path, line, column and one sentence.
 * KG_ERR_READ: missing or unreadable file, skeleton of an AMC not found.  KG_ERR_FORMAT: malformed
 * content.  KG_ERR_UNSUPPORTED: an ASF whose bones change their length.  KG_ERR_NO_MEMORY. */
KG_API KG_MUST_USE kg_status kg_clip_read(kg_clip **clip, const char *path, const kg_clip_def *def,
                                          kg_error *error);

/* The same from memory (BVH only); name stands for the path in messages. text need not be
 * zero-terminated. */
KG_API KG_MUST_USE kg_status kg_clip_read_bvh_text(kg_clip **clip, const char *text, size_t length,
                                                   const char *name, const kg_clip_def *def,
                                                   kg_error *error);

/* ASF skeleton and AMC motion from memory. */
KG_API KG_MUST_USE kg_status kg_clip_read_amc_text(kg_clip **clip, const char *asf,
                                                   size_t asf_length, const char *asf_name,
                                                   const char *amc, size_t amc_length,
                                                   const char *amc_name, const kg_clip_def *def,
                                                   kg_error *error);

/* Writes BVH: hierarchy, channel order and frame time as read (an AMC gets a hierarchy of its own),
 * all frames, and every channel value so that it reads back as the same double. Written beside the
 * target and renamed, so an existing file is replaced only when the new one is complete.
 * KG_ERR_WRITE. */
KG_API KG_MUST_USE kg_status kg_clip_write_bvh(const kg_clip *clip, const char *path,
                                               kg_error *error);

/* Deep copy with the same frames. */
KG_API KG_MUST_USE kg_status kg_clip_copy(kg_clip **copy, const kg_clip *clip);

/* Resampled copy at the given frame time (s): slerp and linear interpolation, first frame kept at
 * time 0; the inserted T-pose is dropped. */
KG_API KG_MUST_USE kg_status kg_clip_resample(kg_clip **copy, const kg_clip *clip,
                                              double frame_time);

KG_API void kg_clip_destroy(kg_clip *clip); /* NULL is allowed */

/* Sets the local rotation (translation, m) of a joint in a frame and updates its channel values:
 * Euler angles nearest to those of `previous_frame` (-1: nearest to the frame's own values),
 * rounded to 1e-9 of a degree or unit. Values that say the same already stay as they are. A joint
 * with fewer than three rotation channels gets the nearest rotation it can express; a position
 * component without a channel keeps the offset's value. */
KG_API void kg_clip_set_rotation(kg_clip *clip, int frame, int joint, kg_quat rotation,
                                 int previous_frame);
KG_API void kg_clip_set_translation(kg_clip *clip, int frame, int joint, kg_vec3 translation);

/* World positions (m) and rotations of all joints in a frame; either may be NULL. Arrays of J. */
KG_API void kg_clip_world(const kg_clip *clip, int frame, kg_vec3 *positions, kg_quat *rotations);

/* Index of the joint with this name (exact), or -1. */
KG_API int kg_clip_find(const kg_clip *clip, const char *name);

/* ---- the canonical skeleton of 23 joints ----------------------------------------------------- */

/* clang-format off */
#define KG_ROLE_LIST(X)                                                                            \
  X(PELVIS, "pelvis", -1)                                                                          \
  X(SPINE1, "spine1", KG_ROLE_PELVIS)         X(SPINE2, "spine2", KG_ROLE_SPINE1)                  \
  X(SPINE3, "spine3", KG_ROLE_SPINE2)         X(NECK1, "neck1", KG_ROLE_SPINE3)                    \
  X(NECK2, "neck2", KG_ROLE_NECK1)            X(HEAD, "head", KG_ROLE_NECK2)                       \
  X(L_CLAVICLE, "l_clavicle", KG_ROLE_SPINE3) X(L_SHOULDER, "l_shoulder", KG_ROLE_L_CLAVICLE)      \
  X(L_ELBOW, "l_elbow", KG_ROLE_L_SHOULDER)   X(L_WRIST, "l_wrist", KG_ROLE_L_ELBOW)               \
  X(R_CLAVICLE, "r_clavicle", KG_ROLE_SPINE3) X(R_SHOULDER, "r_shoulder", KG_ROLE_R_CLAVICLE)      \
  X(R_ELBOW, "r_elbow", KG_ROLE_R_SHOULDER)   X(R_WRIST, "r_wrist", KG_ROLE_R_ELBOW)               \
  X(L_HIP, "l_hip", KG_ROLE_PELVIS)           X(L_KNEE, "l_knee", KG_ROLE_L_HIP)                   \
  X(L_ANKLE, "l_ankle", KG_ROLE_L_KNEE)       X(L_TOE, "l_toe", KG_ROLE_L_ANKLE)                   \
  X(R_HIP, "r_hip", KG_ROLE_PELVIS)           X(R_KNEE, "r_knee", KG_ROLE_R_HIP)                   \
  X(R_ANKLE, "r_ankle", KG_ROLE_R_KNEE)       X(R_TOE, "r_toe", KG_ROLE_R_ANKLE)
/* clang-format on */

#define KG_ROLE_ENUM(id, text, parent) KG_ROLE_##id,
typedef enum kg_role { KG_ROLE_LIST(KG_ROLE_ENUM) KG_ROLE_COUNT } kg_role;
#undef KG_ROLE_ENUM

/* "pelvis", ...; NULL outside the list */
KG_API const char *kg_role_name(kg_role role);
/* Role of the parent in the full skeleton; -1 for the pelvis. */
KG_API int kg_role_parent(kg_role role);

/* Which joint of a clip plays which role; -1 where the skeleton has none. */
typedef struct kg_mapping {
  int joint_of_role[KG_ROLE_COUNT];
  char source[64]; /* "CMU", "ASF", "MotionBuilder/Mixamo", "Xsens", "SNU", "file PATH", ... */
} kg_mapping;

/* Maps by names (namespaces such as "mixamorig:" and case are ignored). map_path, when not NULL,
 * is a text file with one "role = joint name" per line, '#' comments; it overrides the names.
 * A role may stay empty where the skeleton has no such joint, but pelvis, at least one of the
 * spine, head, both shoulders, elbows, hips, knees and ankles are required, and each mapped joint
 * must descend from its parent role's joint (or the nearest mapped role above).
 * KG_ERR_UNMAPPED: *error lists the roles that found no joint and says how to supply a map.
 * KG_ERR_READ, KG_ERR_FORMAT: the map file. */
KG_API KG_MUST_USE kg_status kg_mapping_find(kg_mapping *mapping, const kg_clip *clip,
                                             const char *map_path, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
