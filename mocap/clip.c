/* The clip: its memory, world poses, changed poses, copies.
 *
 * A clip is one arena; kg_clip_memory at its start holds the public struct. Files keep their own
 * axes: with U the rotation from the file's axes to ours (Y up) and s metres per unit, a root's
 * local rotation and translation are U R_file and s U p_file; all other joints' are R_file and
 * s p_file. */
#include "mocap/mocap.h"

#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

/* ---- memory ---------------------------------------------------------------------------------- */

kg_clip_memory *kg_clip_private(const kg_clip *clip)
{
  return clip->memory;
}

static kg_word copied_word(kg_arena *arena, kg_word word)
{
  return (kg_word){kg_arena_text(arena, word.start, word.length), word.length};
}

static void copy_joints(kg_clip_memory *memory, const kg_clip_parts *parts)
{
  memory->clip.joints = KG_ARENA_ARRAY(&memory->arena, kg_joint, parts->joint_count);
  for (int j = 0; j < parts->joint_count && !kg_arena_failed(&memory->arena); j++) {
    const char *name = parts->joints[j].name;
    memory->clip.joints[j] = parts->joints[j];
    memory->clip.joints[j].name = kg_arena_text(&memory->arena, name, strlen(name));
  }
}

kg_status kg_clip_create(kg_clip **clip, const kg_clip_parts *parts, const kg_allocator *allocator)
{
  *clip = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_clip_memory *memory = KG_ARENA_ARRAY(&arena, kg_clip_memory, 1);
  if (!memory) {
    return KG_ERR_NO_MEMORY;
  }
  const size_t T = (size_t)parts->frame_count, J = (size_t)parts->joint_count;
  const size_t C = (size_t)parts->channel_count;
  memory->arena = arena;
  memory->up = kg_quat_identity();
  memory->newline = parts->newline;
  memory->hierarchy = copied_word(&memory->arena, parts->hierarchy);
  if (parts->frame_time_text.length < KG_NUMBER_TEXT) {
    memcpy(memory->frame_time_text, parts->frame_time_text.start, parts->frame_time_text.length);
  } else { /* more digits than a double has */
    kg_print_number(memory->frame_time_text, parts->frame_time);
  }
  copy_joints(memory, parts);
  memory->clip.joint_count = parts->joint_count;
  memory->clip.frame_count = parts->frame_count;
  memory->clip.channel_count = parts->channel_count;
  memory->clip.frame_time = parts->frame_time;
  memory->clip.values = KG_ARENA_ARRAY(&memory->arena, double, T *C);
  memory->clip.rotations = KG_ARENA_ARRAY(&memory->arena, kg_quat, T * J);
  memory->clip.translations = KG_ARENA_ARRAY(&memory->arena, kg_vec3, T * J);
  memory->clip.allocator = allocator;
  memory->clip.memory = memory;
  if (kg_arena_failed(&memory->arena)) {
    kg_clip_destroy(&memory->clip);
    return KG_ERR_NO_MEMORY;
  }
  *clip = &memory->clip;
  return KG_OK;
}

void kg_clip_destroy(kg_clip *clip)
{
  if (clip) {
    kg_arena arena = kg_clip_private(clip)->arena; /* the arena holds itself */
    kg_arena_release(&arena);
  }
}

bool kg_clip_size_is_fair(size_t frames, int joints, int channels, size_t file_bytes)
{
  const double most_bytes_per_byte = 64.0, always_allowed = 256e6;
  const double bytes =
    (double)frames * ((double)joints * (double)(sizeof(kg_quat) + sizeof(kg_vec3)) +
                      (double)channels * (double)sizeof(double));
  return frames <= INT_MAX && bytes <= always_allowed + most_bytes_per_byte * (double)file_bytes;
}

static void copy_tail(char *to, size_t size, const char *path)
{
  const size_t length = strlen(path);
  memcpy(to, path + (length < size ? 0 : length - size + 1), length < size ? length + 1 : size);
}

void kg_clip_label(kg_clip *clip, const char *format, const char *path, const char *skeleton_path)
{
  copy_tail(clip->source.format, sizeof clip->source.format, format);
  copy_tail(clip->source.path, sizeof clip->source.path, path);
  copy_tail(clip->source.skeleton_path, sizeof clip->source.skeleton_path, skeleton_path);
}

bool kg_clip_set_rate(double *frame_time, kg_word *text, kg_arena *arena, double rate_hz)
{
  char *copy = KG_ARENA_ARRAY(arena, char, KG_NUMBER_TEXT);
  *frame_time = 1.0 / rate_hz;
  if (copy) {
    *text = (kg_word){copy, kg_print_number(copy, *frame_time)};
  }
  return copy != NULL;
}

void kg_clip_warn(kg_clip *clip, const kg_text *where, const char *format, ...)
{
  kg_clip_source *source = &clip->source;
  const int most = (int)KG_COUNT_OF(source->warnings);
  if (source->warning_count == most) {
    snprintf(source->warnings[most - 1], sizeof source->warnings[0], "further warnings left out");
    return;
  }
  char *text = source->warnings[source->warning_count++];
  size_t n = 0;
  if (where) {
    /* a long path keeps its end */
    const size_t length = strlen(where->path);
    const char *path = where->path + (length > 120 ? length - 120 : 0);
    n = (size_t)snprintf(text, sizeof source->warnings[0], "%s:%ld:%ld: ", path, where->line,
                         (long)(where->at - where->line_start) + 1);
  }
  va_list args;
  va_start(args, format);
  vsnprintf(text + n, sizeof source->warnings[0] - n, format, args);
  va_end(args);
}

/* ---- poses from channel values --------------------------------------------------------------- */

kg_vec3 kg_joint_translation(const kg_joint *joint, kg_vec3 offset, const double *values)
{
  double p[3] = {offset.x, offset.y, offset.z};
  for (int k = 0; k < joint->channel_count; k++) {
    if (joint->channels[k] <= KG_CHANNEL_Z_POSITION) {
      p[joint->channels[k]] = values[k];
    }
  }
  return kg_vec3_make(p[0], p[1], p[2]);
}

/* of the two quaternions of a rotation, the one nearer to that of the frame before */
static kg_quat continuous(const kg_clip *clip, int frame, int joint, kg_quat q)
{
  const kg_quat before =
    frame > 0 ? clip->rotations[(size_t)(frame - 1) * (size_t)clip->joint_count + (size_t)joint]
              : kg_quat_identity();
  return kg_quat_dot(before, q) < 0.0 ? kg_quat_make(-q.w, -q.x, -q.y, -q.z) : q;
}

void kg_clip_finish(kg_clip *clip)
{
  const double unit = clip->source.unit_m;
  const kg_quat up = kg_clip_private(clip)->up;
  const size_t J = (size_t)clip->joint_count;
  for (int t = 0; t < clip->frame_count; t++) {
    for (int j = 0; j < clip->joint_count; j++) {
      const kg_joint *joint = &clip->joints[j];
      const double *values =
        clip->values + (size_t)t * (size_t)clip->channel_count + joint->first_channel;
      kg_quat q = kg_euler_to_quat(joint, values);
      kg_vec3 p = kg_vec3_scale(unit, kg_joint_translation(joint, joint->offset, values));
      if (joint->parent < 0) {
        q = kg_quat_mul(up, q);
        p = kg_quat_rotate(up, p);
      }
      clip->rotations[(size_t)t * J + (size_t)j] = continuous(clip, t, j, q);
      clip->translations[(size_t)t * J + (size_t)j] = p;
    }
  }
  for (int j = 0; j < clip->joint_count; j++) {
    kg_joint *joint = &clip->joints[j];
    joint->offset = kg_vec3_scale(unit, joint->offset);
    joint->end_site = kg_vec3_scale(unit, joint->end_site);
    if (joint->parent < 0) {
      joint->offset = kg_quat_rotate(up, joint->offset);
    }
  }
}

/* ---- changes --------------------------------------------------------------------------------- */

static void make_continuous_with_next(kg_clip *clip, int frame, int joint)
{
  const size_t J = (size_t)clip->joint_count;
  for (int t = frame + 1; t < clip->frame_count; t++) {
    kg_quat *q = &clip->rotations[(size_t)t * J + (size_t)joint];
    const kg_quat now = continuous(clip, t, joint, *q);
    if (now.w == q->w && now.x == q->x && now.y == q->y && now.z == q->z) {
      return;
    }
    *q = now;
  }
}

void kg_clip_set_rotation(kg_clip *clip, int frame, int joint, kg_quat rotation, int previous_frame)
{
  KG_ASSERT(frame >= 0 && frame < clip->frame_count && joint >= 0 && joint < clip->joint_count);
  KG_ASSERT(previous_frame >= -1 && previous_frame < clip->frame_count);
  const kg_joint *of = &clip->joints[joint];
  const size_t C = (size_t)clip->channel_count, first = (size_t)of->first_channel;
  const int reference_frame = previous_frame < 0 ? frame : previous_frame;
  const kg_quat up = kg_clip_private(clip)->up;
  kg_quat q = kg_quat_normalized(rotation);
  double reference[6];
  memcpy(reference, clip->values + (size_t)reference_frame * C + first,
         (size_t)of->channel_count * sizeof reference[0]);
  if (of->parent < 0) {
    q = kg_quat_mul(kg_quat_conj(up), q);
  }
  q = kg_euler_from_quat(of, q, reference, clip->values + (size_t)frame * C + first);
  if (of->parent < 0) {
    q = kg_quat_mul(up, q);
  }
  clip->rotations[(size_t)frame * (size_t)clip->joint_count + (size_t)joint] =
    continuous(clip, frame, joint, q);
  make_continuous_with_next(clip, frame, joint);
}

void kg_clip_set_translation(kg_clip *clip, int frame, int joint, kg_vec3 translation)
{
  KG_ASSERT(frame >= 0 && frame < clip->frame_count && joint >= 0 && joint < clip->joint_count);
  const kg_joint *of = &clip->joints[joint];
  const double unit = clip->source.unit_m;
  const kg_quat up = of->parent < 0 ? kg_clip_private(clip)->up : kg_quat_identity();
  const size_t at = (size_t)frame * (size_t)clip->joint_count + (size_t)joint;
  double *values = clip->values + (size_t)frame * (size_t)clip->channel_count + of->first_channel;
  const kg_vec3 p = kg_vec3_scale(1.0 / unit, kg_quat_rotate(kg_quat_conj(up), translation));
  const double wanted[3] = {p.x, p.y, p.z};
  int changed = 0;
  for (int k = 0; k < of->channel_count; k++) {
    if (of->channels[k] <= KG_CHANNEL_Z_POSITION) {
      const double x = wanted[of->channels[k]];
      /* rounding of the conversion must not touch a value that was not changed */
      if (!(fabs(x - values[k]) <= 1e-13 * fmax(1.0, fabs(x)))) {
        values[k] = fabs(x) < 4e6 ? nearbyint(x * 1e9) / 1e9 + 0.0 : x;
      }
      changed++;
    }
  }
  if (changed == 3) {
    clip->translations[at] = translation;
    return;
  }
  /* what the channels do not carry stays as the offset has it */
  const kg_vec3 offset = kg_vec3_scale(1.0 / unit, kg_quat_rotate(kg_quat_conj(up), of->offset));
  clip->translations[at] =
    kg_quat_rotate(up, kg_vec3_scale(unit, kg_joint_translation(of, offset, values)));
}

/* ---- questions ------------------------------------------------------------------------------- */

void kg_clip_world(const kg_clip *clip, int frame, kg_vec3 *positions, kg_quat *rotations)
{
  KG_ASSERT(frame >= 0 && frame < clip->frame_count);
  const size_t start = (size_t)frame * (size_t)clip->joint_count;
  const kg_quat *R = clip->rotations + start;
  const kg_vec3 *p = clip->translations + start;
  for (int j = 0; j < clip->joint_count; j++) {
    const int parent = clip->joints[j].parent;
    /* without an array of rotations, climb: trees are shallow and nothing is allocated */
    kg_quat parent_rotation = kg_quat_identity();
    if (rotations && parent >= 0) {
      parent_rotation = rotations[parent];
    } else {
      for (int a = parent; a >= 0; a = clip->joints[a].parent) {
        parent_rotation = kg_quat_mul(R[a], parent_rotation);
      }
    }
    if (rotations) {
      rotations[j] = kg_quat_mul(parent_rotation, R[j]);
    }
    if (positions) {
      const kg_vec3 arm = kg_quat_rotate(parent_rotation, p[j]);
      positions[j] = parent < 0 ? p[j] : kg_vec3_add(positions[parent], arm);
    }
  }
}

int kg_clip_find(const kg_clip *clip, const char *name)
{
  for (int j = 0; j < clip->joint_count; j++) {
    if (strcmp(clip->joints[j].name, name) == 0) {
      return j;
    }
  }
  return -1;
}

/* ---- copies ---------------------------------------------------------------------------------- */

/* same skeleton and source, room for frame_count frames */
static kg_status like(kg_clip **copy, const kg_clip *clip, int frame_count, double frame_time,
                      kg_word frame_time_text)
{
  const kg_clip_memory *memory = kg_clip_private(clip);
  const kg_clip_parts parts = {
    .joints = clip->joints,
    .joint_count = clip->joint_count,
    .channel_count = clip->channel_count,
    .frame_count = frame_count,
    .frame_time = frame_time,
    .frame_time_text = frame_time_text,
    .hierarchy = memory->hierarchy,
    .newline = memory->newline,
  };
  const kg_status status = kg_clip_create(copy, &parts, clip->allocator);
  if (status == KG_OK) {
    (*copy)->source = clip->source;
    kg_clip_private(*copy)->up = memory->up;
  }
  return status;
}

kg_status kg_clip_copy(kg_clip **copy, const kg_clip *clip)
{
  const char *text = kg_clip_private(clip)->frame_time_text;
  const kg_status status =
    like(copy, clip, clip->frame_count, clip->frame_time, (kg_word){text, strlen(text)});
  if (status == KG_OK) {
    const size_t T = (size_t)clip->frame_count, J = (size_t)clip->joint_count;
    memcpy((*copy)->values, clip->values, T * (size_t)clip->channel_count * sizeof clip->values[0]);
    memcpy((*copy)->rotations, clip->rotations, T * J * sizeof clip->rotations[0]);
    memcpy((*copy)->translations, clip->translations, T * J * sizeof clip->translations[0]);
  }
  return status;
}

/* pose of `clip` between frames `from` and from + 1 into frame t of the copy */
static void interpolate(kg_clip *copy, int t, const kg_clip *clip, int from, double share)
{
  const size_t J = (size_t)clip->joint_count, C = (size_t)clip->channel_count;
  const size_t a = (size_t)from * J;
  const size_t b = from + 1 < clip->frame_count ? a + J : a;
  memcpy(copy->values + (size_t)t * C, clip->values + (size_t)from * C, C * sizeof(double));
  for (int j = 0; j < clip->joint_count; j++) {
    const size_t k = (size_t)j;
    if (share == 0.0) { /* a frame of the source: its own values, untouched */
      copy->rotations[(size_t)t * J + k] = clip->rotations[a + k];
      copy->translations[(size_t)t * J + k] = clip->translations[a + k];
      continue;
    }
    const kg_quat q = kg_quat_slerp(clip->rotations[a + k], clip->rotations[b + k], share);
    const kg_vec3 p = kg_vec3_lerp(clip->translations[a + k], clip->translations[b + k], share);
    kg_clip_set_rotation(copy, t, j, q, t > 0 ? t - 1 : -1);
    kg_clip_set_translation(copy, t, j, p);
  }
}

kg_status kg_clip_resample(kg_clip **copy, const kg_clip *clip, double frame_time)
{
  KG_ASSERT(frame_time > 0.0);
  const int first = clip->source.first_frame;
  const int last = clip->frame_count - 1;
  const double ratio = frame_time / clip->frame_time;
  /* a last frame that is missed only by rounding counts */
  const double count = floor((double)(last - first) / ratio + 1e-6) + 1.0;
  *copy = NULL;
  if (!(count >= 1.0 && count < 1e9)) {
    return KG_ERR_NO_MEMORY;
  }
  char text[KG_NUMBER_TEXT];
  const size_t length = kg_print_number(text, frame_time);
  const kg_status status = like(copy, clip, (int)count, frame_time, (kg_word){text, length});
  if (status != KG_OK) {
    return status;
  }
  for (int t = 0; t < (*copy)->frame_count; t++) {
    const double at = first + t * ratio;
    const int from = at + 1e-6 < last ? (int)floor(at + 1e-6) : last;
    const double share = at - from > 1e-6 && from < last ? at - from : 0.0;
    interpolate(*copy, t, clip, from, share);
  }
  (*copy)->source.first_frame = 0;
  (*copy)->source.declared_frames = (*copy)->frame_count;
  return KG_OK;
}
