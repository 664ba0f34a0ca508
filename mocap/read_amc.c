/* AMC reader: motion for an ASF skeleton, made into a clip with the hierarchy of a BVH.
 *
 * The joint of a bone sits at the bone's start, so its offset is its parent bone's vector, and it
 * turns by the bone's L = C M C^-1 (asf.h). Rest directions are global in an ASF, so all rest
 * orientations are the identity, as a BVH wants them. Leaf bones end in an End Site. */
#include "mocap/asf.h"

#include "base/read_file.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

static const double usual_rate = 120.0; /* Hz; an AMC does not have to state one */

typedef struct amc_reader {
  kg_text text;
  kg_arena *scratch;
  asf_skeleton skeleton;
  int *joint_of_bone;
  kg_joint *joints; /* raw, file units; joint_of_bone[0] == 0 */
  int *bone_of_joint;
  kg_word hierarchy;
  size_t hierarchy_capacity;
  bool radians;
  double stated_rate; /* Hz, 0: none */
  long frames_found;
  bool gap_in_numbers;
  kg_text gap_at;
  /* of the frame being read */
  double (*angle)[3]; /* per bone, rad */
  kg_vec3 position;
  long *seen; /* per bone: the frame that last had it, from 1 */
  kg_error *error;
} amc_reader;

/* ---- hierarchy -------------------------------------------------------------------------------- */

static void append(amc_reader *reader, const char *text, size_t length)
{
  kg_word *all = &reader->hierarchy;
  if (all->length + length > reader->hierarchy_capacity) {
    const size_t capacity = 2 * (all->length + length) + 4096;
    char *larger = KG_ARENA_ARRAY(reader->scratch, char, capacity);
    if (!larger) {
      return; /* the arena remembers */
    }
    if (all->length > 0) {
      memcpy(larger, all->start, all->length);
    }
    all->start = larger;
    reader->hierarchy_capacity = capacity;
  }
  memcpy((char *)all->start + all->length, text, length);
  all->length += length;
}

static void append_line(amc_reader *reader, int depth, const char *text)
{
  for (int i = 0; i < depth; i++) {
    append(reader, "\t", 1);
  }
  append(reader, text, strlen(text));
  append(reader, "\n", 1);
}

static void append_offset(amc_reader *reader, int depth, kg_vec3 offset)
{
  const double x[3] = {offset.x, offset.y, offset.z};
  char line[3 * KG_NUMBER_TEXT + 16] = "OFFSET";
  size_t n = strlen(line);
  for (int i = 0; i < 3; i++) {
    line[n++] = ' ';
    n += kg_print_number(line + n, x[i]);
  }
  append_line(reader, depth, line);
}

static kg_joint make_joint(amc_reader *reader, int bone, int index)
{
  static const kg_channel channels[] = {KG_CHANNEL_X_POSITION, KG_CHANNEL_Y_POSITION,
                                        KG_CHANNEL_Z_POSITION, KG_CHANNEL_Z_ROTATION,
                                        KG_CHANNEL_Y_ROTATION, KG_CHANNEL_X_ROTATION};
  const asf_bone *of = &reader->skeleton.bones[bone];
  kg_joint joint = {
    .name = kg_arena_text(reader->scratch, of->name.start, of->name.length),
    .parent = of->parent < 0 ? -1 : reader->joint_of_bone[of->parent],
    .offset =
      of->parent < 0 ? reader->skeleton.position : reader->skeleton.bones[of->parent].vector,
    .has_end_site = of->first_child < 0,
    .end_site = of->first_child < 0 ? of->vector : kg_vec3_make(0.0, 0.0, 0.0),
    .channel_count = of->parent < 0 ? 6 : 3,
    .first_channel = of->parent < 0 ? 0 : 3 + 3 * index,
  };
  const size_t n = (size_t)joint.channel_count;
  memcpy(joint.channels, channels + 6 - n, n * sizeof channels[0]);
  return joint;
}

static void append_joint(amc_reader *reader, const kg_joint *joint, int depth)
{
  char line[256];
  snprintf(line, sizeof line, "%s %s", joint->parent < 0 ? "ROOT" : "JOINT", joint->name);
  append_line(reader, depth, line);
  append_line(reader, depth, "{");
  append_offset(reader, depth + 1, joint->offset);
  append_line(reader, depth + 1,
              joint->parent < 0
                ? "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"
                : "CHANNELS 3 Zrotation Yrotation Xrotation");
  if (joint->has_end_site) {
    append_line(reader, depth + 1, "End Site");
    append_line(reader, depth + 1, "{");
    append_offset(reader, depth + 2, joint->end_site);
    append_line(reader, depth + 1, "}");
  }
}

/* bones depth first, children in the order of the file, without recursion */
static kg_status make_joints(amc_reader *reader)
{
  const asf_bone *bones = reader->skeleton.bones;
  const int count = reader->skeleton.count;
  reader->joint_of_bone = KG_ARENA_ARRAY(reader->scratch, int, count);
  reader->bone_of_joint = KG_ARENA_ARRAY(reader->scratch, int, count);
  reader->joints = KG_ARENA_ARRAY(reader->scratch, kg_joint, count);
  reader->angle = kg_arena_alloc(reader->scratch, (size_t)count, sizeof *reader->angle);
  reader->seen = KG_ARENA_ARRAY(reader->scratch, long, count);
  int bone = 0, depth = 0;
  append_line(reader, 0, "HIERARCHY");
  for (int j = 0; j < count && !kg_arena_failed(reader->scratch); j++) {
    reader->joint_of_bone[bone] = j;
    reader->bone_of_joint[j] = bone;
    reader->joints[j] = make_joint(reader, bone, j);
    if (!reader->joints[j].name) {
      break;
    }
    append_joint(reader, &reader->joints[j], depth);
    if (bones[bone].first_child >= 0) {
      bone = bones[bone].first_child;
      depth++;
      continue;
    }
    while (bone >= 0 && bones[bone].next_sibling < 0) { /* up to the next branch */
      append_line(reader, depth--, "}");
      bone = bones[bone].parent;
    }
    if (bone >= 0) {
      append_line(reader, depth, "}");
      bone = bones[bone].next_sibling;
    }
  }
  return kg_arena_failed(reader->scratch)
           ? kg_fail(reader->error, KG_ERR_NO_MEMORY, reader->text.path, 0, 0,
                     "not enough memory for the skeleton")
           : KG_OK;
}

/* ---- motion ----------------------------------------------------------------------------------- */

static kg_status fail(amc_reader *reader, const char *wanted)
{
  return kg_text_fail(&reader->text, reader->error, wanted);
}

/* comments, ":FULLY-SPECIFIED", ":DEGREES", ":RADIANS", ":SAMPLES-PER-SECOND 120" */
static kg_status read_header(amc_reader *reader)
{
  reader->radians = reader->skeleton.radians;
  kg_text_skip_blank(&reader->text);
  while (!kg_text_at_end(&reader->text) && (*reader->text.at == '#' || *reader->text.at == ':')) {
    const kg_word key = kg_text_next(&reader->text);
    if (kg_word_is(key, ":degrees")) {
      reader->radians = false;
    } else if (kg_word_is(key, ":radians")) {
      reader->radians = true;
    } else if (kg_word_is(key, ":samples-per-second")) {
      kg_text_skip_spaces(&reader->text);
      if (kg_text_number(&reader->text, &reader->stated_rate) != KG_NUMBER_OK ||
          !(reader->stated_rate > 0.0 && reader->stated_rate <= 1e6)) {
        return fail(reader, "a rate above 0");
      }
    } else if (kg_word_is(key, ":bonedata") || kg_word_is(key, ":hierarchy") ||
               kg_word_is(key, ":root")) {
      return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line, 1,
                     "this is an ASF skeleton, expected the AMC motion that goes with it");
    }
    kg_text_skip_line(&reader->text);
    kg_text_skip_blank(&reader->text);
  }
  return KG_OK;
}

/* frames there may be: lines that start with a digit */
static size_t count_frames(kg_text text)
{
  size_t count = 0;
  for (kg_text_skip_blank(&text); !kg_text_at_end(&text); kg_text_skip_blank(&text)) {
    count += *text.at >= '0' && *text.at <= '9';
    kg_text_skip_line(&text);
  }
  return count;
}

/* Bones mostly come in the same order in each frame: look at `guess` first. */
static int find_bone(const amc_reader *reader, kg_word name, int guess)
{
  if (guess < reader->skeleton.count) {
    const kg_word other = reader->skeleton.bones[guess].name;
    if (other.length == name.length && memcmp(other.start, name.start, name.length) == 0) {
      return guess;
    }
  }
  return asf_find(&reader->skeleton, name);
}

static kg_status read_bone_line(amc_reader *reader, long frame, int *guess)
{
  const double to_rad = reader->radians ? 1.0 : 0.017453292519943295769;
  const int b = find_bone(reader, kg_text_peek(&reader->text), *guess);
  if (b < 0) {
    return fail(reader, "the name of a bone of the skeleton or the number of a frame");
  }
  if (reader->seen[b] == frame) {
    return fail(reader, "each bone once in a frame");
  }
  reader->seen[b] = frame;
  *guess = b + 1;
  (void)kg_text_next(&reader->text);
  const asf_bone *bone = &reader->skeleton.bones[b];
  double position[3] = {0.0, 0.0, 0.0};
  for (int k = 0; k < bone->dof_count; k++) {
    double x;
    kg_text_skip_spaces(&reader->text);
    const kg_number_kind kind = kg_text_value(&reader->text, &x);
    if (kind != KG_NUMBER_OK) {
      return kg_text_fail_number(&reader->text, reader->error, kind,
                                 "a number for each degree of freedom of the bone");
    }
    if (bone->dof[k] <= ASF_TZ) {
      position[bone->dof[k] - ASF_TX] = x;
    } else {
      reader->angle[b][bone->dof[k] - ASF_RX] = to_rad * x;
    }
  }
  if (b == 0) {
    reader->position =
      kg_vec3_add(reader->skeleton.position, kg_vec3_make(position[0], position[1], position[2]));
  }
  kg_text_skip_spaces(&reader->text);
  return kg_text_at_line_end(&reader->text) ? KG_OK : fail(reader, "the end of the line");
}

/* first bone with degrees of freedom that the frame did not have, -1: complete */
static int missing_bone(const amc_reader *reader, long frame)
{
  for (int b = 0; b < reader->skeleton.count; b++) {
    if (reader->skeleton.bones[b].dof_count > 0 && reader->seen[b] != frame) {
      return b;
    }
  }
  return -1;
}

static kg_status read_frame_number(amc_reader *reader)
{
  double number;
  const kg_text at = reader->text;
  const kg_number_kind kind = kg_text_number(&reader->text, &number);
  if (kind != KG_NUMBER_OK || number != floor(number)) {
    return kg_text_fail(&at, reader->error, "the number of a frame");
  }
  kg_text_skip_spaces(&reader->text);
  if (!kg_text_at_line_end(&reader->text)) {
    return fail(reader, "the end of the line after the number of a frame");
  }
  if (reader->frames_found > 0 && number != (double)reader->frames_found + 1.0 &&
      !reader->gap_in_numbers) {
    reader->gap_in_numbers = true;
    reader->gap_at = at;
  }
  reader->frames_found++;
  return KG_OK;
}

/* The text ends within the word where reading stopped: a file that was cut off. A last word that
 * could never have become a number or a name ("nan") is an error all the same. */
static bool is_cut_off(const amc_reader *reader, const char *line_start)
{
  const kg_word word = kg_text_peek(&reader->text);
  if (word.start + word.length != reader->text.end) {
    return false;
  }
  for (size_t i = 0; i < word.length && word.start != line_start; i++) {
    if (!strchr("0123456789.+-eE", word.start[i])) {
      return false;
    }
  }
  return true;
}

/* The bones of one frame; *complete is false when the text ended within it. */
static kg_status read_frame(amc_reader *reader, bool *complete)
{
  const kg_text start = reader->text;
  const long frame = reader->frames_found + 1;
  int guess = 0;
  kg_status status = read_frame_number(reader);
  for (kg_text_skip_blank(&reader->text); status == KG_OK && !kg_text_at_end(&reader->text) &&
                                          !(*reader->text.at >= '0' && *reader->text.at <= '9');
       kg_text_skip_blank(&reader->text)) {
    const char *line = reader->text.at;
    status = read_bone_line(reader, frame, &guess);
    if (status == KG_ERR_FORMAT && is_cut_off(reader, line)) {
      *complete = false;
      return KG_OK;
    }
  }
  const int missing = status == KG_OK ? missing_bone(reader, frame) : -1;
  *complete = missing < 0;
  if (missing >= 0 && !kg_text_at_end(&reader->text)) {
    const kg_word name = reader->skeleton.bones[missing].name;
    return kg_fail(reader->error, KG_ERR_FORMAT, start.path, start.line, 1,
                   "the frame has no values for bone '%.*s', expected all bones that have degrees "
                   "of freedom",
                   (int)(name.length < 60 ? name.length : 60), name.start);
  }
  return status;
}

static void store_frame(const amc_reader *reader, kg_clip *clip, int t)
{
  const size_t C = (size_t)clip->channel_count;
  double *values = clip->values + (size_t)t * C;
  const double *before = t > 0 ? values - C : values;
  values[0] = reader->position.x;
  values[1] = reader->position.y;
  values[2] = reader->position.z;
  for (int j = 0; j < clip->joint_count; j++) {
    const int b = reader->bone_of_joint[j];
    const asf_bone *bone = &reader->skeleton.bones[b];
    const kg_joint *joint = &clip->joints[j];
    if (bone->dof_count == 0) {
      continue; /* never turns */
    }
    const kg_quat M = asf_rotation(bone->order, reader->angle[b]);
    const kg_quat L = kg_quat_mul(bone->C, kg_quat_mul(M, kg_quat_conj(bone->C)));
    (void)kg_euler_from_quat(joint, kg_quat_normalized(L), before + joint->first_channel,
                             values + joint->first_channel);
  }
}

static kg_status read_frames(amc_reader *reader, kg_clip *clip)
{
  kg_status status = KG_OK;
  const int most = clip->frame_count;
  int t = 0;
  bool complete = true;
  kg_text at = reader->text;
  for (; status == KG_OK && t < most && complete; t++) {
    at = reader->text;
    status = read_frame(reader, &complete);
    if (status == KG_OK && complete) {
      store_frame(reader, clip, t);
    }
  }
  if (status != KG_OK) {
    return status;
  }
  clip->frame_count = complete ? t : t - 1;
  if (clip->frame_count == 0) {
    return kg_text_fail(&at, reader->error, "at least one frame with values for all bones");
  }
  if (!complete) {
    kg_clip_warn(clip, &at, "the last frame is incomplete: the %d complete frames are used",
                 clip->frame_count);
  }
  if (reader->gap_in_numbers) {
    kg_clip_warn(clip, &reader->gap_at,
                 "frame numbers are not consecutive: frames are taken as evenly spaced");
  }
  return KG_OK;
}

static kg_status create_clip(amc_reader *reader, kg_clip **clip, const kg_clip_def *def)
{
  const size_t count = count_frames(reader->text);
  const int J = reader->skeleton.count;
  const double rate = def->rate_hz > 0.0          ? def->rate_hz
                      : reader->stated_rate > 0.0 ? reader->stated_rate
                                                  : usual_rate;
  if (count == 0) {
    return fail(reader, "the number of the first frame");
  }
  if (!kg_clip_size_is_fair(count, J, 3 + 3 * J, (size_t)(reader->text.end - reader->text.at))) {
    return kg_fail(reader->error, KG_ERR_FORMAT, reader->text.path, reader->text.line, 1,
                   "%zu frames of %d bones in so small a file, expected values for most bones",
                   count, J);
  }
  kg_clip_parts parts = {
    .joints = reader->joints,
    .joint_count = J,
    .channel_count = 3 + 3 * J,
    .frame_count = (int)count,
    .hierarchy = reader->hierarchy,
    .newline = "\n",
  };
  if (!kg_clip_set_rate(&parts.frame_time, &parts.frame_time_text, reader->scratch, rate) ||
      kg_clip_create(clip, &parts, def->allocator) != KG_OK) {
    return kg_fail(reader->error, KG_ERR_NO_MEMORY, reader->text.path, 0, 0,
                   "not enough memory for the clip");
  }
  return KG_OK;
}

kg_status kg_clip_read_amc_text(kg_clip **clip, const char *asf, size_t asf_length,
                                const char *asf_name, const char *amc, size_t amc_length,
                                const char *amc_name, const kg_clip_def *def, kg_error *error)
{
  *clip = NULL;
  kg_arena scratch;
  kg_arena_init(&scratch, def->allocator);
  amc_reader reader = {
    .text = kg_text_make(amc, amc_length, amc_name), .scratch = &scratch, .error = error};
  kg_status status = asf_read(&reader.skeleton, &scratch, asf, asf_length, asf_name, error);
  if (status == KG_OK) {
    status = make_joints(&reader);
  }
  if (status == KG_OK) {
    status = read_header(&reader);
  }
  if (status == KG_OK) {
    status = create_clip(&reader, clip, def);
  }
  if (status == KG_OK) {
    kg_clip_label(*clip, "AMC", amc_name, asf_name);
    (*clip)->source.rate_given = def->rate_hz > 0.0;
    status = read_frames(&reader, *clip);
  }
  if (status == KG_OK) {
    const double unit = reader.skeleton.length_unit;
    (*clip)->source.declared_frames = (*clip)->frame_count;
    status = kg_clip_estimate(*clip, def, unit > 0.0 ? 0.0254 / unit : 0.0);
  }
  if (status == KG_OK) {
    kg_clip_finish(*clip);
  } else {
    kg_clip_destroy(*clip);
    *clip = NULL;
  }
  if (status == KG_ERR_NO_MEMORY) {
    kg_fail(error, status, amc_name, 0, 0, "not enough memory for the clip");
  }
  kg_arena_release(&scratch);
  return status;
}

/* ---- finding the skeleton ---------------------------------------------------------------------- */

typedef struct search_for_asf {
  char directory[512]; /* with its '/' */
  char found[1024];
  char tried[256]; /* names, for the message */
} search_for_asf;

static bool exists(const char *path)
{
  FILE *file = fopen(path, "rb");
  if (file) {
    fclose(file);
  }
  return file != NULL;
}

static bool try_asf(search_for_asf *search, const char *stem, size_t length)
{
  static const char *const endings[] = {".asf", ".ASF"};
  const size_t n = strlen(search->tried);
  const int width = length < 200 ? (int)length : 200;
  snprintf(search->tried + n, sizeof search->tried - n, "%s%.*s.asf", n > 0 ? ", " : "", width,
           stem);
  for (size_t i = 0; i < KG_COUNT_OF(endings); i++) {
    snprintf(search->found, sizeof search->found, "%s%.*s%s", search->directory, width, stem,
             endings[i]);
    if (exists(search->found)) {
      return true;
    }
  }
  return false;
}

/* the skeleton named in the first line, "#!OML:ASF F:\DIR\NAME.ASF" */
static bool try_named_asf(search_for_asf *search, const char *amc, size_t amc_length)
{
  kg_text text = kg_text_make(amc, amc_length, "");
  const kg_word line = kg_text_rest(&text, '\0');
  if (line.length < 10 || !kg_word_is((kg_word){line.start, 9}, "#!OML:ASF")) {
    return false;
  }
  size_t start = 9, end = line.length;
  for (size_t i = 9; i < line.length; i++) {
    const char c = line.start[i];
    start = c == '/' || c == '\\' || c == ' ' ? i + 1 : start;
    end = c == '.' ? i : end;
  }
  return end > start && try_asf(search, line.start + start, end - start);
}

/* NAME_A_B.amc: NAME_A_B.asf, NAME_A.asf, NAME.asf, then the name in the AMC's first line */
static bool find_asf(search_for_asf *search, const char *path, const char *amc, size_t amc_length)
{
  const char *slash = strrchr(path, '/');
  const char *stem = slash ? slash + 1 : path;
  const char *dot = strrchr(stem, '.');
  size_t length = dot && dot > stem ? (size_t)(dot - stem) : strlen(stem);
  *search = (search_for_asf){{0}, {0}, {0}};
  if ((size_t)(stem - path) >= sizeof search->directory) {
    return false;
  }
  memcpy(search->directory, path, (size_t)(stem - path));
  while (length > 0) {
    if (try_asf(search, stem, length)) {
      return true;
    }
    do {
      length--;
    } while (length > 0 && !strchr("_-. ", stem[length]));
  }
  return try_named_asf(search, amc, amc_length);
}

kg_status kg_clip_read_amc(kg_clip **clip, const char *amc, size_t amc_length, const char *path,
                           const kg_clip_def *def, kg_error *error)
{
  search_for_asf search;
  const char *asf_path = def->asf_path;
  *clip = NULL;
  if (!asf_path) {
    if (!find_asf(&search, path, amc, amc_length)) {
      return kg_fail(error, KG_ERR_READ, path, 0, 0,
                     "the skeleton of this AMC motion was not found: looked beside it for %s; give "
                     "it with --asf FILE",
                     search.tried);
    }
    asf_path = search.found;
  }
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  char *asf;
  size_t asf_length;
  kg_status status = kg_read_file(&asf, &asf_length, &arena, asf_path, error);
  if (status == KG_OK) {
    status =
      kg_clip_read_amc_text(clip, asf, asf_length, asf_path, amc, amc_length, path, def, error);
  }
  kg_arena_release(&arena);
  return status;
}
