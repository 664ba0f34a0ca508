/* BVH reader.
 *
 *   HIERARCHY            ROOT name { OFFSET x y z  CHANNELS n ...  (JOINT ... | End Site ...)* }
 *   MOTION               Frames: T   Frame Time: s   then T lines of C numbers
 *
 * The tree is read without recursion: the open joint and its parents are the stack. Counts in the
 * file are limits to check: memory is taken for the numbers that are there. A frame starts on a
 * line of its own and may run over several lines. */
#include "mocap/mocap.h"

#include <limits.h>
#include <math.h>
#include <string.h>

enum { MOST_JOINTS = 4096, DEEPEST = 512 };

typedef struct bvh_reader {
  kg_text text;
  kg_arena scratch;
  kg_joint *joints;
  int joint_count, joint_capacity;
  int channel_count;
  int open; /* joint whose braces are open, -1 outside */
  int depth;
  bool *has_offset; /* per joint */
  int end_sites_left_out;
  kg_text end_site_left_out; /* where the first of them stands */
  long declared;
  double frame_time;
  kg_word frame_time_text, hierarchy;
  int frame_count;
  kg_error *error;
} bvh_reader;

static kg_status fail(bvh_reader *reader, const char *wanted)
{
  return kg_text_fail(&reader->text, reader->error, wanted);
}

/* ---- hierarchy ------------------------------------------------------------------------------- */

static kg_status no_memory(bvh_reader *reader)
{
  return kg_fail(reader->error, KG_ERR_NO_MEMORY, reader->text.path, reader->text.line, 0,
                 "not enough memory for the clip");
}

static kg_status expect_word(bvh_reader *reader, const char *name)
{
  kg_text_skip_blank(&reader->text);
  if (!kg_word_is(kg_text_peek(&reader->text), name)) {
    return fail(reader, name);
  }
  (void)kg_text_next(&reader->text);
  return KG_OK;
}

/* '{' may touch the word before or after it */
static kg_status expect_brace(bvh_reader *reader)
{
  kg_text_skip_blank(&reader->text);
  if (kg_text_at_end(&reader->text) || *reader->text.at != '{') {
    return fail(reader, "'{'");
  }
  reader->text.at++;
  return KG_OK;
}

static kg_status expect_closing_brace(bvh_reader *reader)
{
  kg_text_skip_blank(&reader->text);
  if (kg_text_at_end(&reader->text) || *reader->text.at != '}') {
    return fail(reader, "'}'");
  }
  reader->text.at++;
  return KG_OK;
}

static kg_status read_numbers(bvh_reader *reader, double *x, int count, const char *wanted)
{
  for (int i = 0; i < count; i++) {
    kg_text_skip_spaces(&reader->text);
    const kg_number_kind kind = kg_text_value(&reader->text, &x[i]);
    if (kind != KG_NUMBER_OK) {
      return kg_text_fail_number(&reader->text, reader->error, kind, wanted);
    }
  }
  return KG_OK;
}

static kg_status read_offset(bvh_reader *reader, kg_vec3 *offset)
{
  double x[3];
  const kg_status status = read_numbers(reader, x, 3, "the three numbers of an OFFSET");
  if (status == KG_OK) {
    *offset = kg_vec3_make(x[0], x[1], x[2]);
  }
  return status;
}

static bool grow(bvh_reader *reader)
{
  const int capacity = reader->joint_capacity ? 2 * reader->joint_capacity : 64;
  kg_joint *joints = KG_ARENA_ARRAY(&reader->scratch, kg_joint, capacity);
  bool *has_offset = KG_ARENA_ARRAY(&reader->scratch, bool, capacity);
  if (!joints || !has_offset) {
    return false;
  }
  if (reader->joint_count > 0) {
    memcpy(joints, reader->joints, (size_t)reader->joint_count * sizeof *joints);
    memcpy(has_offset, reader->has_offset, (size_t)reader->joint_count * sizeof *has_offset);
  }
  reader->joints = joints;
  reader->has_offset = has_offset;
  reader->joint_capacity = capacity;
  return true;
}

static long column_of(const kg_text *text)
{
  return (long)(text->at - text->line_start) + 1;
}

/* after ROOT or JOINT */
static kg_status open_joint(bvh_reader *reader)
{
  kg_text_skip_spaces(&reader->text);
  const kg_text at = reader->text;
  const kg_word name = kg_text_rest(&reader->text, '{');
  if (name.length == 0) {
    return fail(reader, "the name of the joint");
  }
  if (reader->joint_count == MOST_JOINTS) {
    return kg_fail(reader->error, KG_ERR_FORMAT, at.path, at.line, column_of(&at),
                   "more than %d joints, expected a skeleton", MOST_JOINTS);
  }
  if (reader->depth == DEEPEST) {
    return kg_fail(reader->error, KG_ERR_FORMAT, at.path, at.line, column_of(&at),
                   "joints are nested more than %d deep, expected a skeleton", DEEPEST);
  }
  if (reader->joint_count == reader->joint_capacity && !grow(reader)) {
    return no_memory(reader);
  }
  const kg_joint joint = {
    .name = kg_arena_text(&reader->scratch, name.start, name.length),
    .parent = reader->open,
    .first_channel = reader->channel_count,
  };
  reader->joints[reader->joint_count] = joint;
  reader->open = reader->joint_count++;
  reader->depth++;
  return joint.name ? expect_brace(reader) : no_memory(reader);
}

static kg_status read_channels(bvh_reader *reader)
{
  static const char *const names[] = {"Xposition", "Yposition", "Zposition",
                                      "Xrotation", "Yrotation", "Zrotation"};
  kg_joint *joint = &reader->joints[reader->open];
  double count;
  kg_text_skip_spaces(&reader->text);
  const kg_text at = reader->text;
  kg_status status = read_numbers(reader, &count, 1, "the number of channels, 0 to 6");
  if (status != KG_OK) {
    return status;
  }
  if (joint->channel_count > 0 || !(count >= 0.0 && count <= 6.0) || count != floor(count)) {
    return kg_text_fail(&at, reader->error,
                        joint->channel_count > 0 ? "one CHANNELS line in a joint"
                                                 : "0 to 6 channels");
  }
  for (int i = 0; i < (int)count; i++) {
    kg_text_skip_blank(&reader->text);
    const kg_word word = kg_text_peek(&reader->text);
    int channel = 0;
    while (channel < 6 && !kg_word_is(word, names[channel])) {
      channel++;
    }
    if (channel == 6) {
      return fail(reader, "a channel: Xposition to Zposition or Xrotation to Zrotation");
    }
    for (int k = 0; k < i; k++) {
      if (joint->channels[k] == (kg_channel)channel) {
        return fail(reader, "each channel once in a joint");
      }
    }
    joint->channels[i] = (kg_channel)channel;
    (void)kg_text_next(&reader->text);
  }
  joint->channel_count = (int)count;
  joint->first_channel = reader->channel_count;
  reader->channel_count += joint->channel_count;
  return KG_OK;
}

/* after End; "Site" and anything else up to the brace is not needed */
static kg_status read_end_site(bvh_reader *reader)
{
  kg_joint *joint = &reader->joints[reader->open];
  const kg_text at = reader->text;
  kg_vec3 offset;
  (void)kg_text_rest(&reader->text, '{');
  kg_status status = expect_brace(reader);
  if (status == KG_OK) {
    status = expect_word(reader, "OFFSET");
  }
  if (status == KG_OK) {
    status = read_offset(reader, &offset);
  }
  if (status != KG_OK) {
    return status;
  }
  if (!joint->has_end_site) {
    joint->has_end_site = true;
    joint->end_site = offset;
  } else if (reader->end_sites_left_out++ == 0) {
    reader->end_site_left_out = at;
  }
  return expect_closing_brace(reader);
}

static kg_status close_joint(bvh_reader *reader)
{
  if (!reader->has_offset[reader->open]) {
    return fail(reader, "an OFFSET before the joint ends");
  }
  reader->text.at++;
  reader->open = reader->joints[reader->open].parent;
  reader->depth--;
  return KG_OK;
}

static kg_status read_item_of_joint(bvh_reader *reader)
{
  const kg_word word = kg_text_peek(&reader->text);
  if (word.length > 0 && word.start[0] == '}') {
    return close_joint(reader);
  }
  if (kg_word_is(word, "OFFSET") && !reader->has_offset[reader->open]) {
    (void)kg_text_next(&reader->text);
    reader->has_offset[reader->open] = true;
    return read_offset(reader, &reader->joints[reader->open].offset);
  }
  if (kg_word_is(word, "CHANNELS")) {
    (void)kg_text_next(&reader->text);
    return read_channels(reader);
  }
  if (kg_word_is(word, "JOINT")) {
    (void)kg_text_next(&reader->text);
    return open_joint(reader);
  }
  if (kg_word_is(word, "End")) {
    (void)kg_text_next(&reader->text);
    return read_end_site(reader);
  }
  return fail(reader, "OFFSET (once), CHANNELS, JOINT, End Site or '}'");
}

static kg_status read_hierarchy(bvh_reader *reader)
{
  const char *start = reader->text.at;
  kg_status status = expect_word(reader, "HIERARCHY");
  reader->open = -1;
  while (status == KG_OK) {
    kg_text_skip_blank(&reader->text);
    const kg_word word = kg_text_peek(&reader->text);
    if (reader->open >= 0) {
      status = read_item_of_joint(reader);
    } else if (kg_word_is(word, "ROOT")) {
      (void)kg_text_next(&reader->text);
      status = open_joint(reader);
    } else if (kg_word_is(word, "MOTION") && reader->joint_count > 0) {
      break;
    } else {
      status = fail(reader, reader->joint_count > 0 ? "ROOT or MOTION" : "ROOT");
    }
  }
  if (status == KG_OK && reader->channel_count == 0) {
    status = fail(reader, "at least one joint with CHANNELS before the motion");
  }
  reader->hierarchy = (kg_word){start, (size_t)(reader->text.at - start)};
  return status;
}

/* ---- motion ---------------------------------------------------------------------------------- */

/* "Frames" ":" and the like: words and colon with or without blanks between */
static kg_status expect_label(bvh_reader *reader, const char *first, const char *second,
                              const char *wanted)
{
  const char *const parts[] = {first, second};
  kg_text_skip_blank(&reader->text);
  for (int i = 0; i < 2 && parts[i]; i++) {
    kg_text_skip_spaces(&reader->text);
    const size_t n = strlen(parts[i]);
    if ((size_t)(reader->text.end - reader->text.at) < n ||
        !kg_word_is((kg_word){reader->text.at, n}, parts[i])) {
      return fail(reader, wanted);
    }
    reader->text.at += n;
  }
  kg_text_skip_spaces(&reader->text);
  if (kg_text_at_end(&reader->text) || *reader->text.at != ':') {
    return fail(reader, wanted);
  }
  reader->text.at++;
  kg_text_skip_spaces(&reader->text);
  return KG_OK;
}

static kg_status read_motion_header(bvh_reader *reader)
{
  kg_status status = expect_word(reader, "MOTION");
  if (status == KG_OK) {
    status = expect_label(reader, "Frames", NULL, "'Frames:'");
  }
  kg_text at = reader->text;
  double declared = 0.0;
  if (status == KG_OK) {
    const kg_number_kind kind = kg_text_number(&reader->text, &declared);
    status = kind == KG_NUMBER_OK
               ? KG_OK
               : kg_text_fail_number(&reader->text, reader->error, kind, "the number of frames");
  }
  if (status == KG_OK && (!(declared >= 1.0) || declared != floor(declared))) {
    status = kg_text_fail(&at, reader->error, "at least one frame");
  }
  if (status == KG_OK) {
    status = expect_label(reader, "Frame", "Time", "'Frame Time:'");
  }
  at = reader->text;
  if (status == KG_OK) {
    reader->frame_time_text = kg_text_peek(&reader->text);
    status = read_numbers(reader, &reader->frame_time, 1, "the frame time in seconds");
  }
  if (status == KG_OK && !(reader->frame_time >= 1e-6)) {
    status = kg_text_fail(&at, reader->error, "a frame time above 0 s (at least 1e-6)");
  }
  reader->declared = declared < 1e18 ? (long)declared : LONG_MAX;
  return status;
}

/* words from here to the end of the text */
static size_t count_words(const kg_text *text)
{
  size_t words = 0;
  bool inside = false;
  for (const char *p = text->at; p < text->end; p++) {
    const bool blank = *p == ' ' || (*p >= '\t' && *p <= '\r');
    words += !blank && !inside;
    inside = !blank;
  }
  return words;
}

static kg_status count_frames(bvh_reader *reader)
{
  const size_t present = count_words(&reader->text) / (size_t)reader->channel_count;
  const size_t count = present < (size_t)reader->declared ? present : (size_t)reader->declared;
  kg_text_skip_blank(&reader->text);
  if (count == 0) {
    return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line,
                   (long)(reader->text.at - reader->text.line_start) + 1,
                   "no complete frame, expected %d numbers for each", reader->channel_count);
  }
  if (!kg_clip_size_is_fair(count, reader->joint_count, reader->channel_count,
                            (size_t)(reader->text.end - reader->hierarchy.start))) {
    return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line, 1,
                   "%zu frames of %d joints with %d channels in all, expected channels for most "
                   "joints",
                   count, reader->joint_count, reader->channel_count);
  }
  reader->frame_count = (int)count;
  return KG_OK;
}

/* One frame; it starts at a line's first number and ends with a line. */
static kg_status read_frame(bvh_reader *reader, double *values)
{
  kg_text_skip_blank(&reader->text);
  const kg_text start = reader->text;
  int on_first_line = 0;
  for (int c = 0; c < reader->channel_count; c++) {
    kg_text_skip_blank(&reader->text);
    const kg_number_kind kind = kg_text_value(&reader->text, &values[c]);
    if (kind != KG_NUMBER_OK) {
      return kg_text_fail_number(&reader->text, reader->error, kind, "a number");
    }
    on_first_line += reader->text.line == start.line;
  }
  kg_text_skip_spaces(&reader->text);
  if (kg_text_at_line_end(&reader->text)) {
    return KG_OK;
  }
  if (on_first_line < reader->channel_count) {
    return kg_fail(reader->error, KG_ERR_FORMAT, start.path, start.line, 1,
                   "the frame has %d numbers on its line, expected %d", on_first_line,
                   reader->channel_count);
  }
  return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line,
                 (long)(reader->text.at - reader->text.line_start) + 1,
                 "the frame has more numbers than the %d channels, expected the end of the line",
                 reader->channel_count);
}

/* What stands after the last frame that is used. */
static void warn_about_frames(const bvh_reader *reader, kg_clip *clip)
{
  kg_text rest = reader->text;
  kg_text_skip_blank(&rest);
  if (reader->frame_count < reader->declared) {
    kg_clip_warn(clip, &rest, "%ld frames declared, %d complete ones found: these are used%s",
                 reader->declared, reader->frame_count,
                 kg_text_at_end(&rest) ? "" : "; the partial last one is left out");
  } else if (!kg_text_at_end(&rest)) {
    kg_clip_warn(clip, &rest, "more numbers follow the %ld declared frames: they are left out",
                 reader->declared);
  }
  if (reader->frame_time >= 1.0) {
    kg_clip_warn(clip, NULL, "%s: a frame time of %g s is unusual; is it a rate?",
                 reader->text.path, reader->frame_time);
  }
  if (reader->end_sites_left_out > 0) {
    kg_clip_warn(clip, &reader->end_site_left_out,
                 "%d further End Sites of a joint are kept in the file but not used",
                 reader->end_sites_left_out);
  }
}

static kg_status read_frames(bvh_reader *reader, kg_clip **clip, const kg_clip_def *def)
{
  const bool crlf = memchr(reader->hierarchy.start, '\r', reader->hierarchy.length) != NULL;
  const kg_clip_parts parts = {
    .joints = reader->joints,
    .joint_count = reader->joint_count,
    .channel_count = reader->channel_count,
    .frame_count = reader->frame_count,
    .frame_time = reader->frame_time,
    .frame_time_text = reader->frame_time_text,
    .hierarchy = reader->hierarchy,
    .newline = crlf ? "\r\n" : "\n",
  };
  kg_status status = kg_clip_create(clip, &parts, def->allocator);
  if (status != KG_OK) {
    return no_memory(reader);
  }
  for (int t = 0; t < reader->frame_count && status == KG_OK; t++) {
    status = read_frame(reader, (*clip)->values + (size_t)t * (size_t)reader->channel_count);
  }
  return status;
}

kg_status kg_clip_read_bvh_text(kg_clip **clip, const char *text, size_t length, const char *name,
                                const kg_clip_def *def, kg_error *error)
{
  *clip = NULL;
  bvh_reader reader = {.text = kg_text_make(text, length, name), .error = error};
  kg_arena_init(&reader.scratch, def->allocator);
  kg_text_skip_blank(&reader.text);
  kg_status status = read_hierarchy(&reader);
  if (status == KG_OK) {
    status = read_motion_header(&reader);
  }
  if (status == KG_OK && def->rate_hz > 0.0) {
    status =
      kg_clip_set_rate(&reader.frame_time, &reader.frame_time_text, &reader.scratch, def->rate_hz)
        ? KG_OK
        : no_memory(&reader);
  }
  if (status == KG_OK) {
    status = count_frames(&reader);
  }
  if (status == KG_OK) {
    status = read_frames(&reader, clip, def);
  }
  if (status == KG_OK) {
    kg_clip_label(*clip, "BVH", name, "");
    (*clip)->source.declared_frames = reader.declared;
    (*clip)->source.rate_given = def->rate_hz > 0.0;
    warn_about_frames(&reader, *clip);
    status = kg_clip_estimate(*clip, def, 0.0) == KG_OK ? KG_OK : no_memory(&reader);
  }
  if (status == KG_OK) {
    kg_clip_finish(*clip);
  } else {
    kg_clip_destroy(*clip);
    *clip = NULL;
  }
  kg_arena_release(&reader.scratch);
  return status;
}
