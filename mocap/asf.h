/* mocap/asf.h - the skeleton of an ASF file, for the AMC reader; private to this folder.
 *
 * Bones have global rest directions. With C the rotation of a bone's axis frame and M that of its
 * degrees of freedom in a frame of motion, the bone turns by L = C M C^-1 against its parent, and
 * its end lies at (product of the L from the root) * direction * length from its start, which is
 * its parent's end. J. Lander, Working with Motion Capture File Formats, Game Developer, January
 * 1998. */
#ifndef MOCAP_ASF_H
#define MOCAP_ASF_H

#include "mocap/mocap.h"

typedef enum asf_dof { ASF_TX, ASF_TY, ASF_TZ, ASF_RX, ASF_RY, ASF_RZ } asf_dof;

typedef struct asf_bone {
  kg_word name;    /* "root" for bone 0                                      */
  kg_vec3 vector;  /* direction * length, file units; zero for the root      */
  double angle[3]; /* of the axis frame, as in the file, about x, y, z       */
  int order[3];    /* axes in the order of rotation: the first turns first   */
  kg_quat C;
  int dof_count;
  asf_dof dof[6];                                    /* in the order of the values in the AMC */
  int parent, first_child, last_child, next_sibling; /* -1: none */
} asf_bone;

typedef struct asf_skeleton {
  asf_bone *bones;
  int count;
  double length_unit; /* `length` of :units, 0 when not stated */
  bool radians;
  kg_vec3 position; /* of the root, file units */
} asf_skeleton;

/* Names point into the text. KG_ERR_FORMAT, KG_ERR_UNSUPPORTED, KG_ERR_NO_MEMORY. */
kg_status asf_read(asf_skeleton *skeleton, kg_arena *arena, const char *text, size_t length,
                   const char *path, kg_error *error);

/* Rotation by angle[i] (rad) about axis i, the axis order[0] first. */
kg_quat asf_rotation(const int order[3], const double angle[3]);

int asf_find(const asf_skeleton *skeleton, kg_word name); /* -1: none */

#endif
