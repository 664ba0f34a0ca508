/* ASF reader (Acclaim skeleton). The file is a list of sections, each opened by a line with ':';
 * within a section every line starts with a keyword. What is not understood (limits, masses,
 * documentation, skin) is passed over. */
#include "mocap/asf.h"

#include <string.h>

enum { MOST_BONES = 1024, DEEPEST = 512 };

typedef struct asf_reader {
  kg_text text;
  kg_arena *arena;
  asf_skeleton *skeleton;
  int capacity;
  kg_error *error;
} asf_reader;

static const asf_bone no_bone = {
  .order = {0, 1, 2}, .parent = -1, .first_child = -1, .last_child = -1, .next_sibling = -1};

/* ---- small pieces ----------------------------------------------------------------------------- */

kg_quat asf_rotation(const int order[3], const double angle[3])
{
  kg_quat q = kg_quat_identity();
  for (int i = 0; i < 3; i++) {
    double r[3] = {0.0, 0.0, 0.0};
    r[order[i]] = angle[order[i]];
    q = kg_quat_mul(kg_quat_exp(kg_vec3_make(r[0], r[1], r[2])), q);
  }
  return q;
}

int asf_find(const asf_skeleton *skeleton, kg_word name)
{
  for (int b = 0; b < skeleton->count; b++) {
    const kg_word other = skeleton->bones[b].name;
    if (other.length == name.length && memcmp(other.start, name.start, name.length) == 0) {
      return b;
    }
  }
  return -1;
}

static kg_status fail(asf_reader *reader, const char *wanted)
{
  return kg_text_fail(&reader->text, reader->error, wanted);
}

static kg_status no_memory(asf_reader *reader)
{
  return kg_fail(reader->error, KG_ERR_NO_MEMORY, reader->text.path, reader->text.line, 0,
                 "not enough memory for the skeleton");
}

/* the next word of the line, empty at its end */
static kg_word next_word(asf_reader *reader)
{
  kg_text_skip_spaces(&reader->text);
  return kg_text_next(&reader->text);
}

static kg_status read_number(asf_reader *reader, double *x, const char *wanted)
{
  kg_text_skip_spaces(&reader->text);
  const kg_number_kind kind = kg_text_value(&reader->text, x);
  return kind == KG_NUMBER_OK ? KG_OK
                              : kg_text_fail_number(&reader->text, reader->error, kind, wanted);
}

static kg_status read_three(asf_reader *reader, double x[3], const char *wanted)
{
  kg_status status = KG_OK;
  for (int i = 0; i < 3 && status == KG_OK; i++) {
    status = read_number(reader, &x[i], wanted);
  }
  return status;
}

/* XYZ, ZYX, ...; stays as it is when the line has ended */
static kg_status read_order(asf_reader *reader, int order[3])
{
  kg_text_skip_spaces(&reader->text);
  const kg_word word = kg_text_peek(&reader->text);
  int seen = 0, found[3] = {0, 1, 2};
  if (word.length == 0) {
    return KG_OK;
  }
  for (size_t i = 0; word.length == 3 && i < 3; i++) {
    found[i] = (word.start[i] | 0x20) - 'x';
    seen |= found[i] >= 0 && found[i] < 3 ? 1 << found[i] : 8;
  }
  if (seen != 7) {
    return fail(reader, "an order of axes such as XYZ");
  }
  memcpy(order, found, sizeof found);
  (void)kg_text_next(&reader->text);
  return KG_OK;
}

static kg_status read_dofs(asf_reader *reader, asf_bone *bone, bool is_root)
{
  static const char *const names[] = {"tx", "ty", "tz", "rx", "ry", "rz"};
  bone->dof_count = 0;
  for (;;) {
    kg_text_skip_spaces(&reader->text);
    const kg_word word = kg_text_peek(&reader->text);
    int dof = 0;
    if (word.length == 0) {
      return KG_OK;
    }
    while (dof < 6 && !kg_word_is(word, names[dof])) {
      dof++;
    }
    if (dof == 6 && !kg_word_is(word, "l")) {
      return fail(reader, "degrees of freedom: rx, ry, rz (and tx, ty, tz for the root)");
    }
    if (dof == 6 || (dof <= ASF_TZ && !is_root)) {
      return kg_fail(reader->error, KG_ERR_UNSUPPORTED, reader->text.path, reader->text.line,
                     (long)(reader->text.at - reader->text.line_start) + 1,
                     "bone '%.*s' changes its length or moves, which is not handled",
                     (int)(bone->name.length < 60 ? bone->name.length : 60), bone->name.start);
    }
    for (int k = 0; k < bone->dof_count; k++) {
      if (bone->dof[k] == (asf_dof)dof) {
        return fail(reader, "each degree of freedom once");
      }
    }
    bone->dof[bone->dof_count++] = (asf_dof)dof;
    (void)kg_text_next(&reader->text);
  }
}

/* moves to the next line that has a word; false at a new section or at the end of the text */
static bool next_line_of_section(asf_reader *reader)
{
  kg_text_skip_line(&reader->text);
  kg_text_skip_blank(&reader->text);
  while (!kg_text_at_end(&reader->text) && *reader->text.at == '#') {
    kg_text_skip_line(&reader->text);
    kg_text_skip_blank(&reader->text);
  }
  return !kg_text_at_end(&reader->text) && *reader->text.at != ':';
}

/* ---- sections --------------------------------------------------------------------------------- */

static kg_status read_units(asf_reader *reader)
{
  kg_status status = KG_OK;
  while (status == KG_OK && next_line_of_section(reader)) {
    const kg_word key = next_word(reader);
    if (kg_word_is(key, "length")) {
      const kg_text at = reader->text;
      status = read_number(reader, &reader->skeleton->length_unit, "the unit of length");
      if (status == KG_OK && !(reader->skeleton->length_unit > 0.0)) {
        status = kg_text_fail(&at, reader->error, "a unit of length above 0");
      }
    } else if (kg_word_is(key, "angle")) {
      const kg_word word = next_word(reader);
      reader->skeleton->radians = word.length >= 3 && kg_word_is((kg_word){word.start, 3}, "rad");
    }
  }
  return status;
}

static kg_status read_root(asf_reader *reader)
{
  asf_bone *root = &reader->skeleton->bones[0];
  double x[3];
  kg_status status = KG_OK;
  while (status == KG_OK && next_line_of_section(reader)) {
    const kg_word key = next_word(reader);
    if (kg_word_is(key, "order")) {
      status = read_dofs(reader, root, true);
    } else if (kg_word_is(key, "axis")) {
      status = read_order(reader, root->order);
    } else if (kg_word_is(key, "position")) {
      status = read_three(reader, x, "the root's position, three numbers");
      reader->skeleton->position =
        status == KG_OK ? kg_vec3_make(x[0], x[1], x[2]) : reader->skeleton->position;
    } else if (kg_word_is(key, "orientation")) {
      status = read_three(reader, root->angle, "the root's orientation, three angles");
    }
  }
  return status;
}

static kg_status add_bone(asf_reader *reader)
{
  asf_skeleton *skeleton = reader->skeleton;
  if (skeleton->count == MOST_BONES) {
    return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line, 0,
                   "more than %d bones, expected a skeleton", MOST_BONES);
  }
  if (skeleton->count == reader->capacity) {
    const int capacity = reader->capacity ? 2 * reader->capacity : 64;
    asf_bone *bones = KG_ARENA_ARRAY(reader->arena, asf_bone, capacity);
    if (!bones) {
      return no_memory(reader);
    }
    if (skeleton->count > 0) {
      memcpy(bones, skeleton->bones, (size_t)skeleton->count * sizeof *bones);
    }
    skeleton->bones = bones;
    reader->capacity = capacity;
  }
  skeleton->bones[skeleton->count++] = no_bone;
  return KG_OK;
}

static kg_status read_bone_name(asf_reader *reader, asf_bone *bone)
{
  kg_text_skip_spaces(&reader->text);
  const kg_word name = kg_text_peek(&reader->text);
  if (name.length == 0 || name.length > 200 || asf_find(reader->skeleton, name) >= 0) {
    return fail(reader, "the name of the bone, used only once");
  }
  bone->name = kg_text_next(&reader->text);
  return KG_OK;
}

/* the lines from begin to end */
static kg_status read_bone(asf_reader *reader)
{
  kg_status status = add_bone(reader);
  if (status != KG_OK) {
    return status;
  }
  asf_bone *bone = &reader->skeleton->bones[reader->skeleton->count - 1];
  double direction[3] = {0.0, 0.0, 0.0}, length = 0.0;
  while (status == KG_OK) {
    if (!next_line_of_section(reader)) {
      return fail(reader, "'end' of the bone");
    }
    const kg_word key = next_word(reader);
    if (kg_word_is(key, "end")) {
      break;
    }
    if (kg_word_is(key, "name")) {
      status = read_bone_name(reader, bone);
    } else if (kg_word_is(key, "direction")) {
      status = read_three(reader, direction, "the bone's direction, three numbers");
    } else if (kg_word_is(key, "length")) {
      status = read_number(reader, &length, "the bone's length");
    } else if (kg_word_is(key, "axis")) {
      status = read_three(reader, bone->angle, "the bone's axis, three angles and an order");
      status = status == KG_OK ? read_order(reader, bone->order) : status;
    } else if (kg_word_is(key, "dof")) {
      status = read_dofs(reader, bone, false);
    }
  }
  bone->vector = kg_vec3_scale(length, kg_vec3_make(direction[0], direction[1], direction[2]));
  if (status == KG_OK && bone->name.length == 0) {
    return fail(reader, "a name in the bone before its 'end'");
  }
  return status;
}

static kg_status read_bones(asf_reader *reader)
{
  kg_status status = KG_OK;
  while (status == KG_OK && next_line_of_section(reader)) {
    const kg_text at = reader->text;
    status = kg_word_is(next_word(reader), "begin")
               ? read_bone(reader)
               : kg_text_fail(&at, reader->error, "'begin' of a bone");
  }
  return status;
}

static kg_status attach(asf_reader *reader, int parent)
{
  asf_bone *bones = reader->skeleton->bones;
  kg_text_skip_spaces(&reader->text);
  const int child = asf_find(reader->skeleton, kg_text_peek(&reader->text));
  if (child <= 0 || bones[child].parent >= 0 || child == parent) {
    return fail(reader, "the name of a bone that has no parent yet");
  }
  bones[child].parent = parent;
  if (bones[parent].last_child >= 0) {
    bones[bones[parent].last_child].next_sibling = child;
  } else {
    bones[parent].first_child = child;
  }
  bones[parent].last_child = child;
  (void)kg_text_next(&reader->text);
  return KG_OK;
}

/* lines "parent child child ..." between begin and end */
static kg_status read_tree(asf_reader *reader)
{
  kg_status status = KG_OK;
  while (status == KG_OK && next_line_of_section(reader)) {
    const kg_text at = reader->text;
    const kg_word name = next_word(reader);
    if (kg_word_is(name, "begin") || kg_word_is(name, "end")) {
      continue;
    }
    const int parent = asf_find(reader->skeleton, name);
    if (parent < 0) {
      return kg_text_fail(&at, reader->error, "the name of a bone");
    }
    for (kg_text_skip_spaces(&reader->text); status == KG_OK && !kg_text_at_line_end(&reader->text);
         kg_text_skip_spaces(&reader->text)) {
      status = attach(reader, parent);
    }
  }
  return status;
}

/* ---- the whole file ---------------------------------------------------------------------------- */

static kg_status read_section(asf_reader *reader)
{
  const kg_word key = kg_text_next(&reader->text);
  if (kg_word_is(key, ":units")) {
    return read_units(reader);
  }
  if (kg_word_is(key, ":root")) {
    return read_root(reader);
  }
  if (kg_word_is(key, ":bonedata")) {
    return read_bones(reader);
  }
  if (kg_word_is(key, ":hierarchy")) {
    return read_tree(reader);
  }
  while (next_line_of_section(reader)) {
  }
  return KG_OK;
}

/* every bone hangs on the root, not too deep, and turns its axis frame into a quaternion */
static kg_status finish(asf_reader *reader)
{
  asf_skeleton *skeleton = reader->skeleton;
  const double to_rad = skeleton->radians ? 1.0 : 0.017453292519943295769;
  if (skeleton->count < 2) {
    return fail(reader, ":bonedata with at least one bone");
  }
  for (int b = 0; b < skeleton->count; b++) {
    asf_bone *bone = &skeleton->bones[b];
    int depth = 0, above = b;
    while (skeleton->bones[above].parent >= 0 && depth <= DEEPEST) {
      above = skeleton->bones[above].parent;
      depth++;
    }
    if (above != 0) {
      return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line, 0,
                     "bone '%.*s' hangs on no chain of at most %d bones from the root, expected "
                     "it in :hierarchy",
                     (int)(bone->name.length < 60 ? bone->name.length : 60), bone->name.start,
                     DEEPEST);
    }
    const double angle[3] = {to_rad * bone->angle[0], to_rad * bone->angle[1],
                             to_rad * bone->angle[2]};
    bone->C = asf_rotation(bone->order, angle);
  }
  return KG_OK;
}

kg_status asf_read(asf_skeleton *skeleton, kg_arena *arena, const char *text, size_t length,
                   const char *path, kg_error *error)
{
  static const asf_dof usual_order[] = {ASF_TX, ASF_TY, ASF_TZ, ASF_RX, ASF_RY, ASF_RZ};
  asf_reader reader = {
    .text = kg_text_make(text, length, path),
    .arena = arena,
    .skeleton = skeleton,
    .error = error,
  };
  *skeleton = (asf_skeleton){0};
  kg_status status = add_bone(&reader);
  if (status != KG_OK) {
    return status;
  }
  skeleton->bones[0].name = (kg_word){"root", 4};
  skeleton->bones[0].dof_count = 6;
  memcpy(skeleton->bones[0].dof, usual_order, sizeof usual_order);
  kg_text_skip_blank(&reader.text);
  while (status == KG_OK && !kg_text_at_end(&reader.text)) {
    if (*reader.text.at == ':') {
      status = read_section(&reader);
    } else if (*reader.text.at == '#') {
      kg_text_skip_line(&reader.text);
      kg_text_skip_blank(&reader.text);
    } else {
      status = fail(&reader, "a section of an ASF skeleton, which starts with ':'");
    }
  }
  return status == KG_OK ? finish(&reader) : status;
}
