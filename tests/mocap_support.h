/* Text of small BVH files for the tests: any skeleton in one table, any scale and axes. */
#ifndef TESTS_MOCAP_SUPPORT_H
#define TESTS_MOCAP_SUPPORT_H

#include "support.h"

#include <stdio.h>

#include "kinegrad/clip.h"

/* Text that grows; freed by text_free. */
typedef struct text_buffer {
  char *at;
  size_t length, capacity;
} text_buffer;

static inline void text_add(text_buffer *text, const char *format, ...) KG_PRINTF(2, 3);
static inline void text_add(text_buffer *text, const char *format, ...)
{
  for (;;) {
    const size_t room = text->capacity - text->length;
    int n = 0;
    if (room > 0) { /* not yet in the first round */
      va_list args;
      va_start(args, format);
      n = vsnprintf(text->at + text->length, room, format, args);
      va_end(args);
      assert_true(n >= 0);
    }
    if ((size_t)n < room) {
      text->length += (size_t)n;
      return;
    }
    text->capacity = 2 * text->capacity + (size_t)n + 4096;
    text->at = realloc(text->at, text->capacity);
    assert_non_null(text->at);
  }
}

static inline void text_free(text_buffer *text)
{
  free(text->at);
  *text = (text_buffer){0};
}

/* One joint of a table: parents first, each child after its parent, depth first. x to the person's
 * left, y up, z forward, metres. */
typedef struct table_joint {
  const char *name;
  int parent;
  double x, y, z;
} table_joint;

/* A standing adult, 1.70 m by Drillis and Contini's proportions, MotionBuilder's names. */
static const table_joint person[] = {
  {"Hips", -1, 0, 0, 0},
  {"Spine", 0, 0, 0.10, 0},
  {"Spine1", 1, 0, 0.12, 0},
  {"Spine2", 2, 0, 0.12, 0},
  {"Neck", 3, 0, 0.15, 0},
  {"Head", 4, 0, 0.10, 0},
  {"LeftShoulder", 3, 0.03, 0.1, 0},
  {"LeftArm", 6, 0.15, 0, 0},
  {"LeftForeArm", 7, 0.30, 0, 0},
  {"LeftHand", 8, 0.25, 0, 0},
  {"RightShoulder", 3, -0.03, 0.1, 0},
  {"RightArm", 10, -0.15, 0, 0},
  {"RightForeArm", 11, -0.30, 0, 0},
  {"RightHand", 12, -0.25, 0, 0},
  {"LeftUpLeg", 0, 0.1, 0, 0},
  {"LeftLeg", 14, 0, -0.4165, 0},
  {"LeftFoot", 15, 0, -0.4182, 0},
  {"LeftToeBase", 16, 0, -0.06, 0.14},
  {"RightUpLeg", 0, -0.1, 0, 0},
  {"RightLeg", 18, 0, -0.4165, 0},
  {"RightFoot", 19, 0, -0.4182, 0},
  {"RightToeBase", 20, 0, -0.06, 0.14},
};
enum { PERSON_JOINTS = (int)KG_COUNT_OF(person) };

/* y up to the wanted axis by a rotation */
static inline kg_vec3 turned(kg_vec3 a, kg_up_axis up)
{
  return up == KG_UP_Y   ? a
         : up == KG_UP_Z ? kg_vec3_make(a.x, -a.z, a.y)
                         : kg_vec3_make(a.y, -a.x, a.z);
}

/* HIERARCHY of a table; every joint has rotations ZXY, roots also XYZ positions. */
static inline void add_hierarchy(text_buffer *text, const table_joint *table, int count,
                                 double units_per_m, kg_up_axis up)
{
  int open[64], depth = 0;
  text_add(text, "HIERARCHY\n");
  for (int j = 0; j < count; j++) {
    while (depth > 0 && open[depth - 1] != table[j].parent) {
      if (open[depth - 1] == j - 1) {
        text_add(text, "End Site { OFFSET 0 0 0 }\n");
      }
      text_add(text, "}\n");
      depth--;
    }
    const kg_vec3 offset =
      kg_vec3_scale(units_per_m, turned(kg_vec3_make(table[j].x, table[j].y, table[j].z), up));
    text_add(text, "%s %s\n{\nOFFSET %.9g %.9g %.9g\nCHANNELS %s\n", depth ? "JOINT" : "ROOT",
             table[j].name, offset.x, offset.y, offset.z,
             depth ? "3 Zrotation Xrotation Yrotation"
                   : "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation");
    open[depth++] = j;
  }
  text_add(text, "End Site { OFFSET 0 0 0 }\n");
  while (depth-- > 0) {
    text_add(text, "}\n");
  }
}

/* A frame: the root stands at height 0.9 m, all rotations are `angle` degrees times a number of
 * each channel's own between -1 and 1. */
static inline void add_person_frame(text_buffer *text, double units_per_m, kg_up_axis up,
                                    double angle)
{
  const kg_vec3 root = kg_vec3_scale(units_per_m, turned(kg_vec3_make(0.2, 0.9, 0.3), up));
  text_add(text, "%.9g %.9g %.9g", root.x, root.y, root.z);
  for (int c = 0; c < 3 * PERSON_JOINTS; c++) {
    text_add(text, " %.6f", c < 3 ? 0.0 : angle * sin(1.0 + 7.0 * c));
  }
  text_add(text, "\n");
}

/* Reads text that must be good. */
static inline kg_clip *clip_of(const char *text, size_t length)
{
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error = {.text = ""};
  if (kg_clip_read_bvh_text(&clip, text, length, "test.bvh", &def, &error) != KG_OK) {
    fail_msg("%s:%ld:%ld: %s", error.path, error.line, error.column, error.text);
  }
  return clip;
}

/* Folder of captures that are not part of the project; NULL when it is not there. */
static inline FILE *open_shared(const char *name, char *path, size_t size)
{
  snprintf(path, size, "%s/../../../shared/data/%s", KG_TEST_DATA, name);
  return fopen(path, "rb");
}

#endif
