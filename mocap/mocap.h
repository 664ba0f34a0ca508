/* mocap/mocap.h - what the readers, the writer and the clip share; private to this folder. */
#ifndef MOCAP_MOCAP_H
#define MOCAP_MOCAP_H

#include "kinegrad/arena.h"
#include "kinegrad/clip.h"

/* ---- text.c: characters with line and column ------------------------------------------------- */

/* A position in text that is not zero-terminated. Lines end with LF, CRLF or CR. */
typedef struct kg_text {
  const char *at, *end, *line_start;
  long line;        /* from 1 */
  const char *path; /* for messages */
} kg_text;

/* A piece of the text; not zero-terminated. */
typedef struct kg_word {
  const char *start;
  size_t length;
} kg_word;

typedef enum kg_number_kind { KG_NUMBER_OK, KG_NUMBER_NONE, KG_NUMBER_NOT_FINITE } kg_number_kind;

kg_text kg_text_make(const char *start, size_t length, const char *path);
bool kg_text_at_end(const kg_text *text);
bool kg_text_at_line_end(const kg_text *text); /* the end of the text included */
void kg_text_skip_spaces(kg_text *text);       /* within the line              */
void kg_text_skip_blank(kg_text *text);        /* over line ends too           */
void kg_text_skip_line(kg_text *text);
/* Up to the next white space; empty at the end of the text. Peek does not move. */
kg_word kg_text_peek(const kg_text *text);
kg_word kg_text_next(kg_text *text);
/* To the end of the line, or to `stop`, without blanks at either side. */
kg_word kg_text_rest(kg_text *text, char stop);
/* Moves only on KG_NUMBER_OK. A number ends at white space or at the end. */
kg_number_kind kg_text_number(kg_text *text, double *value);
/* A number of a motion: beyond 1e12 in size, in whatever unit, it counts as not finite. */
kg_number_kind kg_text_value(kg_text *text, double *value);
/* Fails at the text's position: "... but found 'WORD'". `wanted` says what should stand here. */
kg_status kg_text_fail(const kg_text *text, kg_error *error, const char *wanted);
kg_status kg_text_fail_number(const kg_text *text, kg_error *error, kg_number_kind kind,
                              const char *wanted);

bool kg_word_is(kg_word word, const char *name); /* without regard to case */

/* Longest text kg_print_number can make, terminator included. */
enum { KG_NUMBER_TEXT = 32 };
/* Shortest of a few forms that reads back as the same double; independent of the locale. Returns
 * the length. */
size_t kg_print_number(char *text, double value);

/* ---- euler.c: channel values of one joint ---------------------------------------------------- */

/* Angles in degrees, in the order of the channels. */
kg_quat kg_euler_to_quat(const kg_joint *joint, const double *values);
/* Rotation channels of values[] become those of q, or of the nearest rotation the joint can
 * express, which is returned. Of all equal choices the one nearest to reference[] (same layout). */
kg_quat kg_euler_from_quat(const kg_joint *joint, kg_quat q, const double *reference,
                           double *values);

/* ---- clip.c ---------------------------------------------------------------------------------- */

/* Behind kg_clip.memory. */
typedef struct kg_clip_memory {
  kg_arena arena;
  kg_clip clip;
  kg_word hierarchy;   /* text of the BVH's HIERARCHY section up to MOTION, as it came */
  const char *newline; /* "\n" or "\r\n"                                               */
  char frame_time_text[KG_NUMBER_TEXT];
  kg_quat up; /* file's axes to ours: root frames are up * file's, scaled  */
} kg_clip_memory;

/* What a reader hands over; strings are copied. Offsets are in file units and file axes. */
typedef struct kg_clip_parts {
  const kg_joint *joints;
  int joint_count;
  int channel_count;
  int frame_count;
  double frame_time;
  kg_word frame_time_text;
  kg_word hierarchy;
  const char *newline;
} kg_clip_parts;

/* Memory for a clip; values, rotations and translations are zero. */
kg_status kg_clip_create(kg_clip **clip, const kg_clip_parts *parts, const kg_allocator *allocator);
/* Position channels replace the offset, each its own component; units of the arguments. */
kg_vec3 kg_joint_translation(const kg_joint *joint, kg_vec3 offset, const double *values);
kg_clip_memory *kg_clip_private(const kg_clip *clip);
/* Fills rotations and translations from values, and moves joints to metres and Y up. */
void kg_clip_finish(kg_clip *clip);
/* Poses and values take memory for every joint and frame, text only for what it states: false when
 * a file of so many bytes asks for absurdly much, or for more frames than an int counts. */
bool kg_clip_size_is_fair(size_t frames, int joints, int channels, size_t file_bytes);
/* source.format, .path and .skeleton_path; long paths keep their end */
void kg_clip_label(kg_clip *clip, const char *format, const char *path, const char *skeleton_path);
/* 1 / rate_hz and its text, in arena memory; false when there is no memory */
bool kg_clip_set_rate(double *frame_time, kg_word *text, kg_arena *arena, double rate_hz);
void kg_clip_warn(kg_clip *clip, const kg_text *where, const char *format, ...) KG_PRINTF(3, 4);

/* ---- read.c: both formats -------------------------------------------------------------------- */

/* Finds the ASF of an AMC by name and reads both. */
kg_status kg_clip_read_amc(kg_clip **clip, const char *amc, size_t amc_length, const char *path,
                           const kg_clip_def *def, kg_error *error);

/* ---- estimate.c ------------------------------------------------------------------------------ */

/* Decides unit, up axis and inserted first frame from raw joints and values; fills clip->source
 * and the private up rotation. stated_unit_m: what the file itself says, 0 when nothing.
 * KG_ERR_NO_MEMORY. */
kg_status kg_clip_estimate(kg_clip *clip, const kg_clip_def *def, double stated_unit_m);

#endif
