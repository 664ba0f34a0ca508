/* kinegrad/body.h - the articulated body: segments, inertias, shapes, surface samples.
 *
 * A body is a tree of rigid segments, one per joint; segment i turns about joint i by a ball joint.
 * Segment 0 is the root, free in space. Segment frames are the joint frames of the clip.
 *
 * State (docs/theory/dynamics.md):
 *   q  (nq = 3 + 4 n)  root position in the world, then one unit quaternion (w x y z) per segment:
 *                      the root's in the world, the others' relative to the parent
 *   v  (nv = 3 + 3 n)  root linear velocity in world axes, then one angular velocity per segment,
 *                      relative to the parent, in the segment's own coordinates
 * so segment i has its quaternion at q[3 + 4 i] and its angular velocity at v[3 + 3 i].
 *
 * [LEVA] P. de Leva, Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, Journal of
 *        Biomechanics 29(9), 1996, Table 4. */
#ifndef KINEGRAD_BODY_H
#define KINEGRAD_BODY_H

#include "kinegrad/base.h"
#include "kinegrad/clip.h"
#include "kinegrad/quat.h"
#include "kinegrad/sdf.h"
#include "kinegrad/vec3.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_segment {
  char name[32];      /* role name, or the joint's                                          */
  int role;           /* kg_role, or -1                                                     */
  int joint;          /* joint of the clip it came from, or -1                              */
  int parent;         /* segment index, -1 for the root; always less than its own index     */
  kg_vec3 offset;     /* joint position in the parent's frame, m; ignored for the root      */
  double mass;        /* kg                                                                 */
  kg_vec3 com;        /* centre of mass in the segment frame, m                             */
  double inertia[6];  /* about the centre of mass, segment axes, kg m^2: xx yy zz xy xz yz  */
} kg_segment;

typedef enum kg_body_shape_kind {
  KG_BODY_CAPSULE,   /* from a to b, radius            */
  KG_BODY_ELLIPSOID, /* centre a, semi-axes b          */
  KG_BODY_BOX        /* centre a, half sizes b         */
} kg_body_shape_kind;

typedef struct kg_body_shape {
  kg_body_shape_kind kind;
  int segment;
  kg_vec3 a, b;        /* in the segment frame, m */
  double radius;
  kg_quat orientation; /* of ellipsoid and box in the segment frame */
} kg_body_shape;

/* Contact nodes of a sole, in this order. */
typedef enum kg_sole_node {
  KG_SOLE_HEEL_MEDIAL,
  KG_SOLE_HEEL_LATERAL,
  KG_SOLE_BALL_MEDIAL,  /* first metatarsal head  */
  KG_SOLE_BALL_LATERAL, /* fifth metatarsal head  */
  KG_SOLE_TOE_TIP,
  KG_SOLE_NODE_COUNT
} kg_sole_node;

/* A point of the body's surface. The first 2 * KG_SOLE_NODE_COUNT points of a body with feet are
 * the sole nodes, left foot first; the others are samples of the shapes. */
typedef struct kg_body_point {
  int segment;
  kg_vec3 p; /* in the segment frame, m */
} kg_body_point;

/* How a foot stands: found from stance frames of the clip (docs/theory/track.md, section 1). */
typedef struct kg_foot_fit {
  kg_vec3 up_ankle;     /* unit: floor normal in the ankle segment's frame when the foot is flat */
  kg_vec3 up_toe;       /* the same in the toe segment's frame                                   */
  kg_vec3 forward;      /* unit, orthogonal to up_ankle, in the ankle frame: heel to toe         */
  double ankle_height;  /* ankle joint above the sole, m                                         */
  double toe_height;    /* toe joint above the sole, m                                           */
} kg_foot_fit;

typedef struct kg_body {
  int segment_count;    /* n            */
  int nq, nv;           /* 3+4n, 3+3n   */
  kg_segment *segments;
  int shape_count;
  kg_body_shape *shapes;
  int point_count;      /* sole nodes and surface samples */
  kg_body_point *points;
  int sole_node_count;  /* 10, or 0 for a body without feet */
  double mass;          /* kg */
  double stature;       /* m, estimated from the segments */
  int segment_of_role[KG_ROLE_COUNT]; /* -1 where absent */
  const kg_allocator *allocator;
  void *memory;         /* owned */
} kg_body;

typedef enum kg_sex { KG_SEX_MEAN, KG_SEX_FEMALE, KG_SEX_MALE } kg_sex;

/* Start from kg_body_default_def(). */
typedef struct kg_body_def {
  double mass_kg;                 /* default 70                                                  */
  kg_sex sex;                     /* default the mean of both                                    */
  double min_inertia;             /* lower bound of every principal inertia, kg m^2; 2e-4 */
  bool has_feet;                  /* use `feet`; else, and where a fit makes no sense (zero or NaN
                                     normals), soles from anthropometry and the rest pose         */
  kg_foot_fit feet[2];            /* left, right                                                 */
  const kg_allocator *allocator;
} kg_body_def;

KG_API kg_body_def kg_body_default_def(void);

/* Body of the mapped joints of a clip; lengths are the mean over the clip's motion frames.
 * KG_ERR_FORMAT: lengths that are not finite or all zero. */
KG_API KG_MUST_USE kg_status kg_body_from_clip(kg_body **body, const kg_clip *clip,
                                               const kg_mapping *mapping, const kg_body_def *def,
                                               kg_error *error);

/* Body from given segments (copied) and points (copied; may be 0): for tests, and for models that
 * do not come from a clip. Masses >= 0, parents before children, segment 0 the root. */
KG_API KG_MUST_USE kg_status kg_body_create(kg_body **body, const kg_segment *segments,
                                            int segment_count, const kg_body_point *points,
                                            int point_count, const kg_allocator *allocator);
KG_API void kg_body_destroy(kg_body *body);

/* q of a clip's frame; consecutive frames sign-continuous when q_previous (or NULL) is given. */
KG_API void kg_body_state_from_clip(const kg_body *body, const kg_clip *clip, int frame, double *q,
                                    const double *q_previous);

/* Writes q into a frame of a clip: mapped joints get the body's world rotations (unmapped joints in
 * between keep their captured local rotation), the root its world position; all other joints are
 * untouched. previous_frame as in kg_clip_set_rotation. */
KG_API void kg_body_state_to_clip(const kg_body *body, const double *q, kg_clip *clip, int frame,
                                  int previous_frame);

/* q_out = q (+) d: exponential map on every rotation. d[nv]; q_out may be q. */
KG_API void kg_body_integrate(const kg_body *body, double *q_out, const double *q, const double *d);

/* d = q_b (-) q_a, so that q_a (+) d = q_b. */
KG_API void kg_body_difference(const kg_body *body, double *d, const double *q_b,
                               const double *q_a);

/* The body as a MuJoCo model: free root, ball joints, explicit inertias, and the planes of the scene
 * at rest (NULL: the plane y = 0). A comment in the file counts what is left out: other shapes, soft
 * layers. KG_ERR_WRITE. gravity in m/s^2. The joints' coordinates agree with ours up to MuJoCo's order
 * of qpos (root position, root quaternion, ball quaternions in segment order). Segments must be in
 * depth-first order, as kg_body_from_clip makes them; MuJoCo wants masses and inertias above
 * zero. */
KG_API KG_MUST_USE kg_status kg_body_write_mjcf(const kg_body *body, const kg_scene *scene,
                                                const char *path, double gravity, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif
