/* ASF/AMC reader against a second implementation, written here from the format's definition with
 * sscanf and matrices: the ends of all bones must agree. */
#include "mocap_support.h"

#include <unistd.h>

static const double pi = 3.14159265358979323846;

/* ---- the second implementation ------------------------------------------------------------------ */

typedef struct plain_bone {
  char name[64], order[8], dofs[7][8];
  double direction[3], length, axis[3], value[6];
  int dof_count, parent;
} plain_bone;

typedef struct plain_skeleton {
  plain_bone bones[64];
  int count;
  double unit, position[3];
  bool radians;
} plain_skeleton;

static int bone_index(const plain_skeleton *s, const char *name)
{
  for (int b = 0; b < s->count; b++) {
    if (strcmp(s->bones[b].name, name) == 0) {
      return b;
    }
  }
  fail_msg("no bone %s", name);
  return -1;
}

/* copies the next line without its end; NULL at the end of the text */
static const char *next_line(const char *text, char *line, size_t size)
{
  if (*text == '\0') {
    return NULL;
  }
  const size_t n = strcspn(text, "\r\n"), copied = n < size - 1 ? n : size - 1;
  memcpy(line, text, copied);
  line[copied] = '\0';
  return text + n + strspn(text + n, "\r\n");
}

static void parse_asf(plain_skeleton *s, const char *text)
{
  char line[512], key[64], section[64] = "";
  plain_bone *bone = NULL;
  memset(s, 0, sizeof *s);
  strcpy(s->bones[0].name, "root");
  strcpy(s->bones[0].order, "XYZ");
  s->bones[0].parent = -1;
  s->count = 1;
  s->unit = 0.0254;
  while ((text = next_line(text, line, sizeof line)) != NULL) {
    if (sscanf(line, " %63s", key) != 1) continue;
    const char *rest = strstr(line, key) + strlen(key);
    if (key[0] == ':') {
      strcpy(section, key);
    } else if (!strcmp(section, ":units") && !strcmp(key, "length")) {
      s->unit = 0.0254 / atof(rest);
    } else if (!strcmp(section, ":units") && !strcmp(key, "angle")) {
      s->radians = strstr(rest, "rad") != NULL;
    } else if (!strcmp(section, ":hierarchy") && strcmp(key, "begin") && strcmp(key, "end")) {
      const int parent = bone_index(s, key);
      int used;
      for (; sscanf(rest, " %63s%n", key, &used) == 1; rest += used) {
        s->bones[bone_index(s, key)].parent = parent;
      }
    } else if (!strcmp(section, ":bonedata") && !strcmp(key, "begin")) {
      bone = &s->bones[s->count++];
    } else if (!strcmp(section, ":root")) {
      bone = &s->bones[0];
      if (!strcmp(key, "axis")) sscanf(rest, " %7s", bone->order);
      if (!strcmp(key, "position")) {
        sscanf(rest, "%lf %lf %lf", &s->position[0], &s->position[1], &s->position[2]);
      }
      if (!strcmp(key, "orientation")) {
        sscanf(rest, "%lf %lf %lf", &bone->axis[0], &bone->axis[1], &bone->axis[2]);
      }
    } else if (!strcmp(key, "name") && bone) {
      sscanf(rest, " %63s", bone->name);
    } else if (!strcmp(key, "direction")) {
      sscanf(rest, "%lf %lf %lf", &bone->direction[0], &bone->direction[1], &bone->direction[2]);
    } else if (!strcmp(key, "length") && bone) {
      bone->length = atof(rest);
    } else if (!strcmp(key, "axis")) {
      sscanf(rest, "%lf %lf %lf %7s", &bone->axis[0], &bone->axis[1], &bone->axis[2], bone->order);
    }
    if (bone && (!strcmp(key, "dof") || (!strcmp(section, ":root") && !strcmp(key, "order")))) {
      int used;
      for (; sscanf(rest, " %7s%n", key, &used) == 1; rest += used) {
        strcpy(bone->dofs[bone->dof_count++], key);
      }
    }
  }
}

/* reads one frame's values; returns where the next frame starts, NULL when there is none */
static const char *parse_frame(plain_skeleton *s, const char *text)
{
  char line[512], name[64];
  bool inside = false;
  const char *next;
  for (; (next = next_line(text, line, sizeof line)) != NULL; text = next) {
    if (line[0] == '#' || line[0] == ':') continue;
    if (line[0] >= '0' && line[0] <= '9') {
      if (inside) return text;
      inside = true;
      continue;
    }
    int used;
    if (sscanf(line, " %63s%n", name, &used) != 1) continue;
    plain_bone *bone = &s->bones[bone_index(s, name)];
    const char *at = line + used;
    for (int k = 0; k < bone->dof_count; k++, at += used) {
      assert_int_equal(sscanf(at, "%lf%n", &bone->value[k], &used), 1);
    }
  }
  return inside ? text : NULL;
}

static kg_mat3 about(char axis, double a)
{
  const double c = cos(a), s = sin(a);
  const kg_mat3 X = {{1, 0, 0, 0, c, -s, 0, s, c}};
  const kg_mat3 Y = {{c, 0, s, 0, 1, 0, -s, 0, c}};
  const kg_mat3 Z = {{c, -s, 0, s, c, 0, 0, 0, 1}};
  return axis == 'X' ? X : axis == 'Y' ? Y : Z;
}

/* the first axis of the order turns first: it is the factor at the right */
static kg_mat3 ordered(const char *order, const double angle[3])
{
  kg_mat3 R = kg_mat3_identity();
  for (int i = 0; i < 3; i++) {
    R = kg_mat3_mul(about(order[i], angle[order[i] - 'X']), R);
  }
  return R;
}

/* world end of every bone, m; the root's is its position */
static void plain_ends(const plain_skeleton *s, bool amc_radians, kg_vec3 *end)
{
  kg_mat3 W[64];
  bool done[64] = {false};
  for (int left = s->count; left > 0;) {
    for (int b = 0; b < s->count; b++) {
      const plain_bone *bone = &s->bones[b];
      if (done[b] || (b > 0 && !done[bone->parent])) continue;
      double turn[3] = {0}, frame[3], move[3] = {0};
      for (int i = 0; i < 3; i++)
        frame[i] = bone->axis[i] * (s->radians ? 1 : pi / 180);
      for (int k = 0; k < bone->dof_count; k++) {
        const int axis = (bone->dofs[k][1] | 0x20) - 'x';
        if ((bone->dofs[k][0] | 0x20) == 'r') {
          turn[axis] = bone->value[k] * (amc_radians ? 1 : pi / 180);
        } else {
          move[axis] = bone->value[k];
        }
      }
      const kg_mat3 C = ordered(bone->order, frame);
      const kg_mat3 L =
        kg_mat3_mul(C, kg_mat3_mul(ordered(bone->order, turn), kg_mat3_transposed(C)));
      if (b == 0) {
        W[0] = L;
        end[0] =
          kg_vec3_scale(s->unit, kg_vec3_make(s->position[0] + move[0], s->position[1] + move[1],
                                              s->position[2] + move[2]));
      } else {
        const double k = s->unit * bone->length;
        W[b] = kg_mat3_mul(W[bone->parent], L);
        end[b] = kg_vec3_add(
          end[bone->parent],
          kg_mat3_mul_vec(W[b], kg_vec3_make(k * bone->direction[0], k * bone->direction[1],
                                             k * bone->direction[2])));
      }
      done[b] = true;
      left--;
    }
  }
}

/* ---- comparison --------------------------------------------------------------------------------- */

/* largest distance (m) between the ends of bones in the clip and those of the definition */
static double largest_difference(const kg_clip *clip, const char *asf, const char *amc,
                                 bool amc_radians)
{
  plain_skeleton s;
  kg_vec3 end[64], p[64];
  kg_quat R[64];
  double most = 0.0;
  parse_asf(&s, asf);
  assert_int_equal(s.count, clip->joint_count);
  for (int t = 0; t < clip->frame_count; t++) {
    amc = parse_frame(&s, amc);
    assert_non_null(amc);
    plain_ends(&s, amc_radians, end);
    kg_clip_world(clip, t, p, R);
    int compared = 0;
    for (int j = 0; j < clip->joint_count; j++) {
      const kg_joint *joint = &clip->joints[j];
      const int b = bone_index(&s, joint->name);
      const kg_vec3 start = b == 0 ? end[0] : end[s.bones[b].parent];
      most = fmax(most, kg_vec3_norm(kg_vec3_sub(p[j], start)));
      if (joint->has_end_site) {
        const kg_vec3 tip = kg_vec3_add(p[j], kg_quat_rotate(R[j], joint->end_site));
        most = fmax(most, kg_vec3_norm(kg_vec3_sub(tip, end[b])));
        compared++;
      }
    }
    assert_true(compared > 0);
  }
  assert_true(*amc == '\0'); /* no frame left over */
  return most;
}

static kg_clip *back_through_bvh(const kg_clip *clip)
{
  const char *path = KG_TEST_SCRATCH "/amc.bvh";
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = clip->source.unit_m;
  kg_clip *back;
  assert_int_equal(kg_clip_write_bvh(clip, path, NULL), KG_OK);
  assert_int_equal(kg_clip_read(&back, path, &def, NULL), KG_OK);
  unlink(path);
  return back;
}

static const char small_asf[] =
  "# a comment\n:version 1.10\n:name t\n:units\n  mass 1.0\n  length 0.45\n  angle deg\n"
  ":documentation\n free text 1 2 3\n:root\n order TX TY TZ RX RY RZ\n axis XYZ\n position 1 2 -3\n"
  " orientation 10 -20 30\n:bonedata\n begin\n  id 1\n  name thigh\n  direction 0.6 -0.8 0\n  "
  "length "
  "7.5\n  axis 10 20 30 XYZ\n  dof rx ry rz\n  limits (-160.0 20.0)\n         (-70 70)\n         "
  "(-60 "
  "70)\n end\n begin\n  id 2\n  name shank\n  direction 0 -1 0\n  length 7.25\n  axis 0 -45 7 "
  "ZYX\n  "
  "dof rx rz\n end\n begin\n  id 3\n  name foot\n  direction 0 0 1\n  length 2\n  axis 0 0 0 YXZ\n "
  " end\n "
  "begin\n  id 4\n  name toe\n  direction 0 0.28 0.96\n  length 1\n  axis 90 0 5 XZY\n  dof ry\n "
  "end\n "
  "begin\n  id 5\n  name back\n  direction 0 1 0\n  length 9\n  axis 0 0 0 XYZ\n  dof rz rx ry\n "
  "end\n"
  ":hierarchy\n begin\n  root thigh back\n  thigh shank\n  shank foot\n  foot toe\n end\n";

static const char small_amc[] =
  "#!OML:ASF x\n:FULLY-SPECIFIED\n:DEGREES\n1\nroot 1 17 -3 10 20 30\nthigh 11 -22 33\nshank 40 "
  "-5\ntoe 12.5\nback 1 2 3\n2\nback -100 -150 170\nroot 1 17 -3 100 -200 300\nthigh 1 2 3\nshank "
  "4 "
  "5e1\ntoe -7.62852e-016\n";

static kg_clip *read_texts(const char *asf, const char *amc)
{
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error = {.text = ""};
  if (kg_clip_read_amc_text(&clip, asf, strlen(asf), "s.asf", amc, strlen(amc), "m.amc", &def,
                            &error) != KG_OK) {
    fail_msg("%s:%ld:%ld: %s", error.path, error.line, error.column, error.text);
  }
  return clip;
}

static void bone_ends_are_those_of_the_definition(void **state)
{
  (void)state;
  kg_clip *clip = read_texts(small_asf, small_amc);
  assert_int_equal(clip->frame_count, 2);
  assert_string_equal(clip->source.format, "AMC");
  assert_close(clip->frame_time, 1.0 / 120.0, 1e-15);
  assert_false(clip->source.rate_given);
  assert_string_equal(clip->joints[0].name, "root");
  assert_int_equal(clip->joints[0].channel_count, 6);
  kg_clip_destroy(clip);
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.0254 / 0.45;
  def.up_given = true;
  assert_int_equal(kg_clip_read_amc_text(&clip, small_asf, strlen(small_asf), "s", small_amc,
                                         strlen(small_amc), "m", &def, NULL),
                   KG_OK);
  assert_at_most(largest_difference(clip, small_asf, small_amc, false), 1e-9);
  kg_clip *back = back_through_bvh(clip);
  assert_at_most(largest_difference(back, small_asf, small_amc, false), 1e-9);
  kg_clip_destroy(back);
  kg_clip_destroy(clip);
}

/* every `from` in the text becomes `to` */
static char *replaced(const char *text, const char *from, const char *to)
{
  text_buffer out = {0};
  for (const char *p = text; *p != '\0';) {
    const bool here = strncmp(p, from, strlen(from)) == 0;
    text_add(&out, here ? "%s" : "%.1s", here ? to : p);
    p += here ? strlen(from) : 1;
  }
  return out.at;
}

static void variants_of_the_format_mean_the_same(void **state)
{
  (void)state;
  kg_clip *plain = read_texts(small_asf, small_amc);
  char *asf = replaced(small_asf, "\n", "\r\n"), *amc = replaced(small_amc, "\n", " \r\n");
  kg_clip *clip = read_texts(asf, amc);
  assert_memory_equal(clip->values, plain->values,
                      2 * (size_t)plain->channel_count * sizeof(double));
  kg_clip_destroy(clip);
  free(amc);
  /* root values in another order */
  char *other_asf = replaced(small_asf, "order TX TY TZ RX RY RZ", "order RZ TX RY TY RX TZ");
  char *first = replaced(small_amc, "root 1 17 -3 10 20 30", "root 30 1 20 17 10 -3");
  amc = replaced(first, "root 1 17 -3 100 -200 300", "root 300 1 -200 17 100 -3");
  clip = read_texts(other_asf, amc);
  assert_memory_equal(clip->values, plain->values,
                      2 * (size_t)plain->channel_count * sizeof(double));
  kg_clip_destroy(clip);
  free(first);
  free(amc);
  free(other_asf);
  /* radians in the motion, degrees in the skeleton; a stated rate */
  text_buffer radians = {0};
  text_add(&radians,
           ":RADIANS\n:SAMPLES-PER-SECOND 60\n1\nroot 1 17 -3 %.17g %.17g %.17g\nthigh %.17g "
           "%.17g %.17g\nshank %.17g %.17g\ntoe %.17g\nback %.17g %.17g %.17g\n",
           10 * pi / 180, 20 * pi / 180, 30 * pi / 180, 11 * pi / 180, -22 * pi / 180,
           33 * pi / 180, 40 * pi / 180, -5 * pi / 180, 12.5 * pi / 180, 1 * pi / 180, 2 * pi / 180,
           3 * pi / 180);
  clip = read_texts(small_asf, radians.at);
  assert_close(clip->frame_time, 1.0 / 60.0, 1e-15);
  for (int c = 0; c < plain->channel_count; c++) {
    assert_close(clip->values[c], plain->values[c], 1e-8);
  }
  kg_clip_destroy(clip);
  /* radians in both, said only by the skeleton */
  text_buffer both = {0};
  char *asf_radians = replaced(small_asf, "angle deg", "angle rad");
  text_add(&both, "%s", strchr(radians.at + 1, ':')); /* without ":RADIANS" */
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.0254 / 0.45;
  assert_int_equal(kg_clip_read_amc_text(&clip, asf_radians, strlen(asf_radians), "s", both.at,
                                         both.length, "m", &def, NULL),
                   KG_OK);
  assert_at_most(largest_difference(clip, asf_radians, both.at, true), 1e-9);
  kg_clip_destroy(clip);
  free(asf_radians);
  text_free(&both);
  text_free(&radians);
  kg_clip_destroy(plain);
  free(asf);
}

static void incomplete_last_frames_are_left_out(void **state)
{
  (void)state;
  static const char *const ends[] = {"3\n", "3\nroot 1 17 -3 1 2 3\nthigh 1 2 3\n",
                                     "3\nroot 1 17 -3 1 2", "3\nroot 1 17 -3 1 2 3\nthi"};
  for (size_t i = 0; i < KG_COUNT_OF(ends); i++) {
    text_buffer amc = {0};
    text_add(&amc, "%s%s", small_amc, ends[i]);
    kg_clip *clip = read_texts(small_asf, amc.at);
    assert_int_equal(clip->frame_count, 2);
    bool warned = false;
    for (int w = 0; w < clip->source.warning_count; w++) {
      warned |=
        strncmp(clip->source.warnings[w], "m.amc:16:1: the last frame is incomplete", 40) == 0;
    }
    assert_true(warned);
    kg_clip_destroy(clip);
    text_free(&amc);
  }
}

/* ---- refusal ------------------------------------------------------------------------------------ */

static void bad_files_are_refused_where_they_are_bad(void **state)
{
  (void)state;
  static const struct {
    const char *from, *to, *path;
    long line;
    const char *part;
  } cases[] = {
    /* the skeleton */
    {"length 0.45", "length 0", "s.asf", 6, "above 0"},
    {"length 0.45", "length inf", "s.asf", 6, "'inf'"},
    {"direction 0.6 -0.8 0", "direction 0.6 -0.8", "s.asf", 19, "three numbers"},
    {"name shank", "name thigh", "s.asf", 29, "only once"},
    {"name shank", "nome shank", "s.asf", 34, "a name"},
    {"axis 10 20 30 XYZ", "axis 10 20 30 XYX", "s.asf", 21, "order of axes"},
    {"dof rx ry rz", "dof rx rx rz", "s.asf", 22, "once"},
    {"dof rx ry rz", "dof rq", "s.asf", 22, "'rq'"},
    {"  foot toe", "  foot tooe", "s.asf", 63, "'tooe'"},
    {"  foot toe", "  foot thigh", "s.asf", 63, "no parent yet"},
    {"  foot toe", "  foot root", "s.asf", 63, "no parent yet"},
    {"  foot toe", "  fot toe", "s.asf", 63, "'fot'"},
    {"  foot toe", "", "s.asf", 0, "'toe' hangs on no chain"},
    {"root thigh back", "toe thigh\n root back", "s.asf", 0, "hangs on no chain"},
    {":bonedata\n begin", ":bonedata\n bgin", "s.asf", 16, "'begin'"},
    /* the motion */
    {"thigh 11 -22 33", "thigh 11 -22", "m.amc", 6, "each degree of freedom"},
    {"thigh 11 -22 33", "thigh 11 -22 33 44", "m.amc", 6, "end of the line"},
    {"thigh 11 -22 33", "thigh 11 nan 33", "m.amc", 6, "'nan'"},
    {"thigh 11 -22 33", "thigh 11 1e400 33", "m.amc", 6, "too large"},
    {"thigh 11 -22 33", "thick 11 -22 33", "m.amc", 6, "'thick'"},
    {"thigh 11 -22 33", "toe 1\ntoe 1", "m.amc", 7, "once"},
    {"thigh 11 -22 33\n", "", "m.amc", 4, "'thigh'"},
    {"1\nroot 1 17 -3 10", "1 1\nroot 1 17 -3 10", "m.amc", 4, "end of the line"},
    {"1\nroot 1 17 -3 10", "1.5\nroot 1 17 -3 10", "m.amc", 4, "number of a frame"},
    {":DEGREES\n", ":SAMPLES-PER-SECOND -1\n", "m.amc", 3, "rate above 0"},
    {":DEGREES\n", ":bonedata\n", "m.amc", 3, "ASF skeleton"},
  };
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    const kg_clip_def def = kg_clip_default_def();
    const bool in_asf = cases[i].path[0] == 's';
    char *text = replaced(in_asf ? small_asf : small_amc, cases[i].from, cases[i].to);
    const char *asf = in_asf ? text : small_asf, *amc = in_asf ? small_amc : text;
    kg_clip *clip;
    kg_error error = {.text = ""};
    const kg_status status = kg_clip_read_amc_text(&clip, asf, strlen(asf), "s.asf", amc,
                                                   strlen(amc), "m.amc", &def, &error);
    if (status != KG_ERR_FORMAT || clip || strcmp(error.path, cases[i].path) != 0 ||
        (cases[i].line > 0 && error.line != cases[i].line) || !strstr(error.text, cases[i].part) ||
        !strstr(error.text, "expected")) {
      fail_msg("case %zu: status %d, %s:%ld:%ld: %s", i, (int)status, error.path, error.line,
               error.column, error.text);
    }
    free(text);
  }
}

static void empty_and_cut_texts_are_refused(void **state)
{
  (void)state;
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error;
  /* whatever the cut, it ends: with a clip or with a message */
  for (size_t n = 0; n <= sizeof small_asf - 1; n++) {
    const kg_status status = kg_clip_read_amc_text(&clip, small_asf, n, "s.asf", small_amc,
                                                   sizeof small_amc - 1, "m.amc", &def, &error);
    assert_true((status == KG_OK) == (clip != NULL));
    kg_clip_destroy(clip);
  }
  for (size_t n = 0; n <= sizeof small_amc - 1; n++) {
    const kg_status status = kg_clip_read_amc_text(&clip, small_asf, sizeof small_asf - 1, "s.asf",
                                                   small_amc, n, "m.amc", &def, &error);
    assert_true((status == KG_OK) == (clip != NULL));
    if (n < 80) {
      assert_int_equal(status, KG_ERR_FORMAT); /* no complete frame */
    }
    kg_clip_destroy(clip);
  }
}

static void bones_that_change_length_are_unsupported(void **state)
{
  (void)state;
  const kg_clip_def def = kg_clip_default_def();
  char *asf = replaced(small_asf, "dof ry\n", "dof ry l\n");
  kg_clip *clip;
  kg_error error;
  assert_int_equal(kg_clip_read_amc_text(&clip, asf, strlen(asf), "s.asf", small_amc,
                                         strlen(small_amc), "m.amc", &def, &error),
                   KG_ERR_UNSUPPORTED);
  assert_non_null(strstr(error.text, "'toe'"));
  free(asf);
}

static void survives_every_allocation_failure(void **state)
{
  (void)state;
  int allowed = 0;
  for (bool done = false; !done; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_clip_def def = kg_clip_default_def();
    def.allocator = &allocator;
    kg_clip *clip;
    kg_error error = {.status = KG_OK};
    const kg_status status =
      kg_clip_read_amc_text(&clip, small_asf, strlen(small_asf), "s.asf", small_amc,
                            strlen(small_amc), "m.amc", &def, &error);
    assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
    assert_int_equal(error.status, status);
    done = status == KG_OK;
    kg_clip_destroy(clip);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(allowed > 4);
}

/* ---- files -------------------------------------------------------------------------------------- */

static void write_text(const char *path, const char *text)
{
  FILE *file = fopen(path, "wb");
  assert_non_null(file);
  fputs(text, file);
  assert_int_equal(fclose(file), 0);
}

static void finds_the_skeleton_by_name(void **state)
{
  (void)state;
  const char *motion = KG_TEST_SCRATCH "/who_16_03.amc", *skeleton = KG_TEST_SCRATCH "/who_16.asf";
  const char *other = KG_TEST_SCRATCH "/who_1.asf", *named = KG_TEST_SCRATCH "/x.asf";
  kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error;
  write_text(motion, small_amc);
  write_text(other, "not a skeleton");
  assert_int_equal(kg_clip_read(&clip, motion, &def, &error), KG_ERR_READ);
  assert_string_equal(error.path, motion);
  assert_non_null(strstr(error.text, "who_16_03.asf, who_16.asf, who.asf, x.asf"));
  assert_non_null(strstr(error.text, "--asf"));
  write_text(named, small_asf); /* the name in the motion's first line */
  assert_int_equal(kg_clip_read(&clip, motion, &def, &error), KG_OK);
  assert_string_equal(clip->source.skeleton_path, named);
  kg_clip_destroy(clip);
  write_text(skeleton, small_asf);
  assert_int_equal(kg_clip_read(&clip, motion, &def, &error), KG_OK);
  assert_string_equal(clip->source.skeleton_path, skeleton);
  kg_clip_destroy(clip);
  def.asf_path = KG_TEST_SCRATCH "/no such.asf";
  assert_int_equal(kg_clip_read(&clip, motion, &def, &error), KG_ERR_READ);
  assert_string_equal(error.path, def.asf_path);
  def.asf_path = other;
  assert_int_equal(kg_clip_read(&clip, motion, &def, &error), KG_ERR_FORMAT);
  assert_string_equal(error.path, other);
  unlink(motion);
  unlink(skeleton);
  unlink(other);
  unlink(named);
}

static char *file_text(FILE *file)
{
  text_buffer text = {0};
  char chunk[4096];
  size_t n;
  while ((n = fread(chunk, 1, sizeof chunk, file)) > 0) {
    text_add(&text, "%.*s", (int)n, chunk);
  }
  fclose(file);
  return text.at;
}

static void shared_captures_match_the_definition(void **state)
{
  (void)state;
  static const struct {
    const char *asf, *amc;
    int frames;
  } files[] = {
    {"gymnastics/cmu_05.asf", "gymnastics/cmu_05_07.amc", 1191},
    {"gymnastics/cmu_127.asf", "gymnastics/cmu_127_23.amc", 349},
    {"track/cmu_127.asf", "track/cmu_127_03.amc", 332},
    {"track/cmu_127.asf", "track/cmu_127_06.amc", 173},
    {"track/cmu_127.asf", "track/cmu_127_25.amc", 230},
    {"track/cmu_127.asf", "track/cmu_127_26.amc", 246},
    {"track/cmu_16.asf", "track/cmu_16_03.amc", 410},
    {"track/cmu_16.asf", "track/cmu_16_05.amc", 295},
    {"track/cmu_16.asf", "track/cmu_16_09.amc", 496},
    {"track/cmu_16.asf", "track/cmu_16_55.amc", 181},
    {"odd/cmu_127.asf", "odd/cmu_127_33.amc", 205},
  };
  for (size_t i = 0; i < KG_COUNT_OF(files); i++) {
    char asf_path[1024], amc_path[1024];
    FILE *asf_file = open_shared(files[i].asf, asf_path, sizeof asf_path);
    FILE *amc_file = open_shared(files[i].amc, amc_path, sizeof amc_path);
    if (!asf_file || !amc_file) {
      print_message("skipped: no capture at %s\n", amc_path);
      skip();
    }
    char *asf = file_text(asf_file), *amc = file_text(amc_file);
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip;
    assert_int_equal(kg_clip_read(&clip, amc_path, &def, NULL), KG_OK);
    assert_int_equal(clip->frame_count, files[i].frames);
    assert_string_equal(clip->source.skeleton_path, asf_path);
    assert_int_equal(clip->source.first_frame, 0);
    assert_int_equal(clip->source.warning_count, 0);
    assert_close(clip->source.unit_m, 0.0254 / 0.45, 1e-12);
    assert_at_most(largest_difference(clip, asf, amc, false), 1e-9);
    kg_clip *back = back_through_bvh(clip);
    assert_at_most(largest_difference(back, asf, amc, false), 1e-9);
    kg_clip_destroy(back);
    kg_clip_destroy(clip);
    free(asf);
    free(amc);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(bone_ends_are_those_of_the_definition),
    cmocka_unit_test(variants_of_the_format_mean_the_same),
    cmocka_unit_test(incomplete_last_frames_are_left_out),
    cmocka_unit_test(bad_files_are_refused_where_they_are_bad),
    cmocka_unit_test(empty_and_cut_texts_are_refused),
    cmocka_unit_test(bones_that_change_length_are_unsupported),
    cmocka_unit_test(survives_every_allocation_failure),
    cmocka_unit_test(finds_the_skeleton_by_name),
    cmocka_unit_test(shared_captures_match_the_definition),
  };
  return cmocka_run_group_tests_name("amc", tests, NULL, NULL);
}
