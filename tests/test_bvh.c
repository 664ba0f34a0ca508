/* BVH reader and writer, the clip's poses: against definitions written out here, hand-made files
 * and their own output. */
#include "mocap_support.h"

#include <locale.h>
#include <signal.h>
#include <sys/resource.h>
#include <unistd.h>

#include "mocap/mocap.h"

static const double pi = 3.14159265358979323846;

/* ---- numbers ---------------------------------------------------------------------------------- */

static void assert_number_is_strtod(const char *string)
{
  kg_text text = kg_text_make(string, strlen(string), "");
  double ours = -1.0;
  const double theirs = strtod(string, NULL);
  const kg_number_kind kind = kg_text_number(&text, &ours);
  if (kind != (isfinite(theirs) ? KG_NUMBER_OK : KG_NUMBER_NOT_FINITE) ||
      (kind == KG_NUMBER_OK && memcmp(&ours, &theirs, sizeof ours) != 0)) {
    fail_msg("'%s': kind %d, %.17g, strtod has %.17g", string, (int)kind, ours, theirs);
  }
}

static void reads_numbers_as_strtod_does(void **state)
{
  (void)state;
  static const char *const special[] = {
    "0",
    "-0",
    "+1",
    ".5",
    "5.",
    "-.0083333",
    "1e22",
    "1e23",
    "1e-22",
    "1e-23",
    "1e400",
    "-1e400",
    "1e-400",
    "5e-324",
    "2.2250738585072011e-308",
    "9007199254740993",
    "9007199254740992.5",
    "9007199254740993.00000000000000000000001",
    "0.1e-6",
    "-7.15625e-015",
    "1.7976931348623157e308",
    "1.7976931348623159e308",
    "123456789012345678901234567890",
    "0.000000000000000000000000000001",
    "8.41e+021",
    "00000000000000000000000000012.5",
    "1e99999999999999999999",
    "0e99999999999",
    "0.00000000000000000000000000000000000000000000000000012345678901234567890123e60"};
  for (size_t i = 0; i < KG_COUNT_OF(special); i++) {
    assert_number_is_strtod(special[i]);
  }
  char zeros[460] = "0."; /* beyond any count of places: 0.0...01e402 is 1 */
  memset(zeros + 2, '0', 401);
  strcpy(zeros + 403, "1e402");
  assert_number_is_strtod(zeros);
  kg_random random = kg_random_make(11);
  for (int i = 0; i < 200000; i++) {
    char string[80];
    size_t n = 0;
    const uint64_t bits = kg_random_bits(&random);
    const int before = (int)(bits % 12), after = (int)(bits / 16 % 24);
    if (bits & (1ull << 40)) string[n++] = '-';
    for (int k = 0; k < before; k++)
      string[n++] = (char)('0' + kg_random_bits(&random) % 10);
    if (after > 0 || before == 0) string[n++] = '.';
    for (int k = 0; k < after + (before == 0); k++) {
      string[n++] = (char)('0' + kg_random_bits(&random) % 10);
    }
    string[n] = '\0';
    if (bits & (1ull << 41)) {
      snprintf(string + n, sizeof string - n, "e%d", (int)(kg_random_bits(&random) % 640) - 320);
    }
    assert_number_is_strtod(string);
  }
}

static void refuses_what_is_no_number(void **state)
{
  (void)state;
  static const char *const bad[] = {"",    "-",   ".",      "e5",    "1e",   "1e+",
                                    "nan", "inf", "-inf",   "1.2.3", "12a",  "0x10",
                                    "1,5", "--1", "1.#IND", "+-1",   "1e5.5"};
  for (size_t i = 0; i < KG_COUNT_OF(bad); i++) {
    kg_text text = kg_text_make(bad[i], strlen(bad[i]), "");
    double x;
    assert_int_equal(kg_text_number(&text, &x), KG_NUMBER_NONE);
    assert_ptr_equal(text.at, bad[i]);
  }
  char *digits = malloc(5000); /* longer than anyone writes: refused, not cut */
  memset(digits, '1', 5000);
  kg_text text = kg_text_make(digits, 5000, "");
  double x;
  assert_int_equal(kg_text_number(&text, &x), KG_NUMBER_NONE);
  free(digits);
}

static void the_locale_does_not_matter(void **state)
{
  (void)state;
  static const char *const names[] = {"de_DE.UTF-8", "de_DE.utf8", "fr_FR.UTF-8", "de_DE", "ps_AF"};
  size_t i = 0;
  while (i < KG_COUNT_OF(names) && !setlocale(LC_NUMERIC, names[i]))
    i++;
  if (i == KG_COUNT_OF(names)) {
    print_message("skipped: no locale with a decimal comma is installed\n");
    skip();
  }
  char text[KG_NUMBER_TEXT];
  const size_t length = kg_print_number(text, 0.1 + 0.2);
  kg_text at = kg_text_make("0.30000000000000004440892098500626 ", 35, ""),
          back = kg_text_make(text, length, "");
  double x = 0.0, y = 0.0;
  const kg_number_kind read = kg_text_number(&at, &x), again = kg_text_number(&back, &y);
  setlocale(LC_NUMERIC, "C");
  assert_int_equal(read, KG_NUMBER_OK);
  assert_int_equal(again, KG_NUMBER_OK);
  assert_true(x == 0.1 + 0.2 && y == x);
  assert_string_equal(text, "0.30000000000000004");
}

static void printed_numbers_come_back_bit_equal(void **state)
{
  (void)state;
  kg_random random = kg_random_make(12);
  for (int i = 0; i < 200000; i++) {
    double x;
    const uint64_t bits = kg_random_bits(&random);
    if (i % 4 == 0) {
      memcpy(&x, &bits, sizeof x);
    } else if (i % 4 == 1) {
      x = 180.0 * kg_random_normal(&random);
    } else {
      x = (double)((int64_t)(bits >> 20) - (INT64_C(1) << 43)) / (i % 4 == 2 ? 1e4 : 1e9);
    }
    if (!isfinite(x)) {
      continue;
    }
    char text[KG_NUMBER_TEXT];
    const size_t length = kg_print_number(text, x);
    assert_int_equal(strlen(text), length);
    const double back = strtod(text, NULL);
    if (memcmp(&x, &back, sizeof x) != 0) {
      fail_msg("%.17g was printed as %s", x, text);
    }
  }
  char text[KG_NUMBER_TEXT];
  kg_print_number(text, -80.2592);
  assert_string_equal(text, "-80.2592");
  kg_print_number(text, 0.0);
  assert_string_equal(text, "0");
  kg_print_number(text, -0.5);
  assert_string_equal(text, "-0.5");
}

/* ---- poses ------------------------------------------------------------------------------------ */

static kg_mat3 about(int axis, double degrees)
{
  const double a = degrees * pi / 180.0, c = cos(a), s = sin(a);
  const int i = (axis + 1) % 3, j = (axis + 2) % 3;
  kg_mat3 R = kg_mat3_identity();
  R.m[3 * i + i] = c;
  R.m[3 * i + j] = -s;
  R.m[3 * j + i] = s;
  R.m[3 * j + j] = c;
  return R;
}

static double matrix_distance(kg_mat3 A, kg_mat3 B)
{
  double most = 0.0;
  for (int k = 0; k < 9; k++) {
    most = fmax(most, fabs(A.m[k] - B.m[k]));
  }
  return most;
}

static const int orders[6][3] = {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {2, 1, 0}, {0, 2, 1}, {1, 0, 2}};

/* root and child with the given rotation channels, `frames` frames of zeros */
static void make_two_joints(text_buffer *text, const int *axes, int count, int frames)
{
  text_add(text, "HIERARCHY\nROOT a\n{\n OFFSET 0 0 0\n CHANNELS %d Xposition Yposition Zposition",
           3 + count);
  for (int k = 0; k < count; k++)
    text_add(text, " %crotation", "XYZ"[axes[k]]);
  text_add(text, "\n JOINT b\n {\n  OFFSET 0 100 0\n  CHANNELS %d", count);
  for (int k = 0; k < count; k++)
    text_add(text, " %crotation", "XYZ"[axes[k]]);
  text_add(text, "\n  End Site\n  {\n   OFFSET 0 70 0\n  }\n }\n}\nMOTION\nFrames: %d\n", frames);
  text_add(text, "Frame Time: 0.01\n");
  for (int t = 0; t < frames; t++) {
    for (int c = 0; c < 3 + 2 * count; c++)
      text_add(text, "0 ");
    text_add(text, "\n");
  }
}

static void channels_multiply_left_to_right(void **state)
{
  (void)state;
  for (int o = 0; o < 6; o++) {
    const int *axes = orders[o];
    text_buffer text = {0};
    text_add(&text,
             "HIERARCHY ROOT a { OFFSET 1 2 3 CHANNELS 3 %crotation %crotation %crotation "
             "JOINT b { OFFSET 0 100 0 CHANNELS 3 %crotation %crotation %crotation } }\n"
             "MOTION\nFrames: 1\nFrame Time: 1e-2\n10 -20 30 200 45.5 -77\n",
             "XYZ"[axes[0]], "XYZ"[axes[1]], "XYZ"[axes[2]], "XYZ"[axes[0]], "XYZ"[axes[1]],
             "XYZ"[axes[2]]);
    kg_clip *clip = clip_of(text.at, text.length);
    const kg_mat3 A =
      kg_mat3_mul(about(axes[0], 10), kg_mat3_mul(about(axes[1], -20), about(axes[2], 30)));
    const kg_mat3 B =
      kg_mat3_mul(about(axes[0], 200), kg_mat3_mul(about(axes[1], 45.5), about(axes[2], -77)));
    assert_at_most(matrix_distance(kg_quat_matrix(clip->rotations[0]), A), 1e-14);
    assert_at_most(matrix_distance(kg_quat_matrix(clip->rotations[1]), B), 1e-14);
    kg_vec3 p[2], p_alone[2];
    kg_quat R[2];
    kg_clip_world(clip, 0, p, R);
    kg_clip_world(clip, 0, p_alone, NULL);
    assert_at_most(matrix_distance(kg_quat_matrix(R[1]), kg_mat3_mul(A, B)), 1e-14);
    const double s = clip->source.unit_m;
    const kg_vec3 tip =
      kg_vec3_add(kg_vec3_make(s, 2 * s, 3 * s), kg_mat3_mul_vec(A, kg_vec3_make(0, 100 * s, 0)));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(p[1], tip)), 1e-14);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(p_alone[1], tip)), 1e-14);
    kg_clip_destroy(clip);
    text_free(&text);
  }
}

static void position_channels_replace_the_offset(void **state)
{
  (void)state;
  static const char text[] =
    "HIERARCHY\nROOT a { OFFSET 5 5 5 CHANNELS 3 Zposition Xposition Yposition\n"
    "JOINT b { OFFSET 10 20 30 CHANNELS 2 Zposition Xrotation\n"
    "JOINT c { OFFSET 1 2 3 } } }\nMOTION\nFrames: 1\nFrame Time: 0.5\n3 1 2 33 90\n";
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.5;
  kg_clip *clip;
  assert_int_equal(kg_clip_read_bvh_text(&clip, text, sizeof text - 1, "t", &def, NULL), KG_OK);
  kg_vec3 p[3];
  kg_clip_world(clip, 0, p, NULL);
  assert_close(p[0].x, 0.5, 1e-15);
  assert_close(p[0].y, 1.0, 1e-15);
  assert_close(p[0].z, 1.5, 1e-15);
  assert_close(p[1].x, 0.5 + 5.0, 1e-15);
  assert_close(p[1].y, 1.0 + 10.0, 1e-15);
  assert_close(p[1].z, 1.5 + 16.5, 1e-15); /* the channel, not the offset's 30 */
  assert_close(p[2].x, 5.5 + 0.5, 1e-14);
  assert_close(p[2].y, 11.0 - 1.5, 1e-14); /* a quarter turn about x */
  assert_close(p[2].z, 18.0 + 1.0, 1e-14);
  assert_true(clip->source.unit_given);
  /* only what has a channel changes */
  kg_clip_set_translation(clip, 0, 1, kg_vec3_make(100, 200, 300));
  assert_close(clip->translations[1].x, 5.0, 1e-15);
  assert_close(clip->translations[1].y, 10.0, 1e-15);
  assert_close(clip->translations[1].z, 300.0, 1e-15);
  assert_close(clip->values[3], 600.0, 1e-12);
  kg_clip_set_translation(clip, 0, 2, kg_vec3_make(7, 7, 7));
  assert_close(clip->translations[2].x, 0.5, 1e-15);
  kg_clip_destroy(clip);
}

static void a_changed_frame_keeps_the_signs_of_all_later_ones(void **state)
{
  (void)state;
  const int axes[] = {0};
  text_buffer text = {0};
  make_two_joints(&text, axes, 1, 1);
  text.length = (size_t)(strstr(text.at, "Frames") - text.at);
  text_add(&text, "Frames: 50\nFrame Time: .01\n");
  for (int t = 0; t < 50; t++)
    text_add(&text, "0 0 0 0 %d\n", 200 + t);
  kg_clip *clip = clip_of(text.at, text.length);
  kg_clip_set_rotation(clip, 0, 1, kg_quat_exp(kg_vec3_make(170 * pi / 180, 0, 0)), -1);
  for (int t = 1; t < 50; t++) {
    assert_true(kg_quat_dot(clip->rotations[2 * t + 1], clip->rotations[2 * t - 1]) > 0.9);
  }
  kg_clip_destroy(clip);
  text_free(&text);
}

static void quaternions_do_not_jump(void **state)
{
  (void)state;
  const int axes[] = {0};
  text_buffer text = {0};
  make_two_joints(&text, axes, 1, 1);
  text.length = (size_t)(strstr(text.at, "Frames") - text.at);
  text_add(&text, "Frames: 200\nFrame Time: .01\n");
  for (int t = 0; t < 200; t++)
    text_add(&text, "0 0 0 %d %d\n", 7 * t, -11 * t);
  kg_clip *clip = clip_of(text.at, text.length);
  for (int k = 2; k < 400; k++) {
    assert_true(kg_quat_dot(clip->rotations[k], clip->rotations[k - 2]) > 0.99);
  }
  /* also after a change in the middle by a whole turn in quaternion space */
  kg_quat q = clip->rotations[2 * 100 + 1];
  kg_clip_set_rotation(clip, 100, 1, kg_quat_make(-q.w, -q.x, -q.y, -q.z), 99);
  for (int k = 2; k < 400; k++) {
    assert_true(kg_quat_dot(clip->rotations[k], clip->rotations[k - 2]) > 0.99);
  }
  kg_clip_destroy(clip);
  text_free(&text);
}

/* ---- tolerance -------------------------------------------------------------------------------- */

static const char plain_file[] =
  "HIERARCHY\nROOT Hips\n{\n\tOFFSET 0 0 0\n\tCHANNELS 6 Xposition Yposition Zposition Zrotation "
  "Xrotation Yrotation\n\tJOINT Left Arm\n\t{\n\t\tOFFSET 0 100 0\n\t\tCHANNELS 3 Yrotation "
  "Zrotation Xrotation\n\t\tEnd Site\n\t\t{\n\t\t\tOFFSET 0 72 0\n\t\t}\n\t}\n}\nMOTION\nFrames: "
  "2\nFrame Time: 0.025\n1 2 3 4 5 6 7 8 9\n1.5 -2 3 0.004 5 6 7 -0.00000000000000715625 9\n";

static void assert_same_as_plain(const char *text, size_t length)
{
  kg_clip *a = clip_of(plain_file, sizeof plain_file - 1), *b = clip_of(text, length);
  assert_int_equal(b->joint_count, 2);
  assert_int_equal(b->frame_count, 2);
  assert_int_equal(b->channel_count, 9);
  assert_string_equal(b->joints[1].name, "Left Arm");
  assert_true(b->joints[1].has_end_site);
  assert_true(b->frame_time == 0.025);
  assert_memory_equal(a->values, b->values, 18 * sizeof(double));
  assert_memory_equal(a->rotations, b->rotations, 4 * sizeof(kg_quat));
  assert_int_equal(b->source.warning_count, a->source.warning_count);
  kg_clip_destroy(a);
  kg_clip_destroy(b);
}

static void reads_the_variants_of_the_format(void **state)
{
  (void)state;
  assert_same_as_plain(plain_file, sizeof plain_file - 1);
  static const char *const variants[] = {
    /* a byte order mark, no final newline, trailing blanks, exponents, several spaces */
    "\xef\xbb\xbfHIERARCHY  \nROOT Hips  \n{ \n OFFSET 0 0.0 -0 \n CHANNELS  6  Xposition "
    "Yposition Zposition Zrotation Xrotation Yrotation \n JOINT   Left Arm\t\n {\n OFFSET 0 1e2 "
    "0\n "
    "CHANNELS 3 Yrotation Zrotation Xrotation\nEnd Site \n { \n OFFSET 0 7.2e+001 0 \n}\n}\n}\n"
    "MOTION \nFrames:\t2\nFrame Time:\t.025\n\n 1 2  3\t4 5 6 7 8 9 \t\n1.5 -2 +3 4E-3 5 6 7 "
    "-7.15625e-015 9",
    /* other case, braces on the line, CHANNELS before OFFSET, CR, labels with blanks */
    "hierarchy\rroot Hips{\rchannels 6 XPOSITION yposition Zposition zrotation Xrotation "
    "Yrotation\rOFFSET 0 0 0\rjoint Left Arm {\roffset 0 100 0\rChannels 3 Yrotation Zrotation "
    "Xrotation\rEND SITE{\rOffset 0 72 0\r}}}\rmotion\rFRAMES : 2\rframe   time : 25e-3\r1 2 3 4 5 "
    "6 7 8 9\r1.5 -2 3 0.004 5 6 7 -7.15625E-15 9\r",
    /* frames over several lines, "End Effector" */
    "HIERARCHY ROOT Hips { OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation "
    "Xrotation "
    "Yrotation JOINT Left Arm { OFFSET 0 100 0 CHANNELS 3 Yrotation Zrotation Xrotation End "
    "Effector "
    "{ OFFSET 0 72 0 } } } MOTION Frames: 2 Frame Time: 0.025\n1 2 3 4 5 6\n7 8 9\n1.5 -2 3\n0.004 "
    "5 6 7 -7.15625e-15 9\n",
  };
  for (size_t i = 0; i < KG_COUNT_OF(variants); i++) {
    assert_same_as_plain(variants[i], strlen(variants[i]));
  }
  text_buffer crlf = {0};
  for (const char *p = plain_file; *p != '\0'; p++) {
    text_add(&crlf, *p == '\n' ? "\r\n" : "%c", *p);
  }
  assert_same_as_plain(crlf.at, crlf.length);
  text_free(&crlf);
}

typedef struct peak_heap {
  size_t live, peak;
} peak_heap;

static void *peak_alloc(size_t bytes, void *user)
{
  peak_heap *heap = user;
  heap->live += bytes;
  heap->peak = heap->live > heap->peak ? heap->live : heap->peak;
  return malloc(bytes);
}

static void peak_free(void *memory, size_t bytes, void *user)
{
  ((peak_heap *)user)->live -= bytes;
  free(memory);
}

static void memory_follows_the_data_and_not_the_header(void **state)
{
  (void)state;
  static const char *const counts[] = {"1000000000", "99999999999999999999999", "3"};
  for (size_t i = 0; i < KG_COUNT_OF(counts); i++) {
    text_buffer text = {0};
    text_add(&text,
             "HIERARCHY ROOT a { OFFSET 0 1 0 CHANNELS 1 Xrotation }\nMOTION\nFrames: %s\n"
             "Frame Time: 0.01\n1\n2\n",
             counts[i]);
    peak_heap heap = {0, 0};
    const kg_allocator allocator = {peak_alloc, peak_free, &heap};
    kg_clip_def def = kg_clip_default_def();
    def.allocator = &allocator;
    kg_clip *clip;
    assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "x.bvh", &def, NULL),
                     KG_OK);
    assert_int_equal(clip->frame_count, 2);
    assert_true(clip->source.warning_count > 0);
    assert_non_null(strstr(clip->source.warnings[0], "x.bvh:7:1: "));
    assert_non_null(strstr(clip->source.warnings[0], "2 complete ones"));
    kg_clip_destroy(clip);
    assert_at_most((double)heap.peak, 1e6);
    assert_int_equal(heap.live, 0);
    text_free(&text);
  }
}

static void partial_and_surplus_frames_are_left_out_with_a_warning(void **state)
{
  (void)state;
  static const char head[] = "HIERARCHY ROOT a { OFFSET 0 1 0 CHANNELS 3 Xrotation Yrotation "
                             "Zrotation }\nMOTION\nFrames: 3\nFrame Time: 0.01\n";
  static const struct {
    const char *frames;
    int count;
    const char *warning;
  } cases[] = {
    {"1 2 3\n4 5 6\n7 8", 2, "p.bvh:7:1: 3 frames declared, 2 complete ones"},
    {"1 2 3\n4 5 6\n7 8 9\n1 2 3\n", 3, "p.bvh:8:1: more numbers follow the 3 declared"},
    {"1 2 3\n4 5 6\n7 8 9\n\n \n", 3, NULL},
  };
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    text_buffer text = {0};
    text_add(&text, "%s%s", head, cases[i].frames);
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip;
    assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "p.bvh", &def, NULL),
                     KG_OK);
    assert_int_equal(clip->frame_count, cases[i].count);
    assert_int_equal(clip->source.declared_frames, 3);
    assert_true(clip->values[3 * cases[i].count - 1] == 3.0 * cases[i].count);
    bool found = false;
    for (int w = 0; w < clip->source.warning_count; w++) {
      found |= cases[i].warning &&
               strncmp(clip->source.warnings[w], cases[i].warning, strlen(cases[i].warning)) == 0;
      assert_true(cases[i].warning || !strstr(clip->source.warnings[w], "frames"));
    }
    assert_int_equal(found, cases[i].warning != NULL);
    kg_clip_destroy(clip);
    text_free(&text);
  }
}

/* ---- refusal ---------------------------------------------------------------------------------- */

#define GOOD_HEAD "HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 2 Xrotation Yrotation\n}\nMOTION\n"
#define GOOD_MOTION GOOD_HEAD "Frames: 2\nFrame Time: 0.01\n"

static void bad_files_are_refused_where_they_are_bad(void **state)
{
  (void)state;
  static const struct {
    const char *text;
    long line, column;
    const char *part;
  } cases[] = {
    {"", 1, 1, "end of the file"},
    {"\x89PNG\r\n\x1a\n", 1, 1, "expected HIERARCHY"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1", 4, 11, "three numbers"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\n", 5, 1, "end of the file"},
    {"HIERARCHY\nMOTION\n", 2, 1, "ROOT"},
    {"HIERARCHY\nROOT \n{", 2, 6, "name of the joint"},
    {"HIERARCHY\nROOT a\n{\n}\n", 4, 1, "an OFFSET"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nOFFSET 0 1 0\n", 5, 1, "once"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 x 0\n", 4, 10, "'x'"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 7 Xposition\n", 5, 10, "0 to 6"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS -1\n", 5, 10, "0 to 6"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 1.5 Xposition\n", 5, 10, "0 to 6"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 2 Xrotation Xrotation\n", 5, 22, "once"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 2 Xrotation Wrotation\n", 5, 22, "Wrotation"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\n}\nMOTION\n", 6, 1, "at least one joint with CHANNELS"},
    {"HIERARCHY\nROOT a\n{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\nEnd Site\n{\n}\n", 8, 1, "OFFSET"},
    {GOOD_HEAD "Frame Time: 0.01\n", 8, 1, "'Frames:'"},
    {GOOD_HEAD "Frames: x\n", 8, 9, "number of frames"},
    {GOOD_HEAD "Frames: 0\n", 8, 9, "at least one frame"},
    {GOOD_HEAD "Frames: -5\n", 8, 9, "at least one frame"},
    {GOOD_HEAD "Frames: 2\n0 0\n", 9, 1, "'Frame Time:'"},
    {GOOD_HEAD "Frames: 2\nFrame Time: 0\n", 9, 13, "above 0"},
    {GOOD_HEAD "Frames: 2\nFrame Time: -0.01\n", 9, 13, "above 0"},
    {GOOD_HEAD "Frames: 2\nFrame Time: nan\n", 9, 13, "frame time"},
    {GOOD_MOTION, 10, 1, "no complete frame"},
    {GOOD_MOTION "1\n", 10, 1, "no complete frame"},
    {GOOD_MOTION "1 2\n3 nan\n", 11, 3, "'nan'"},
    {GOOD_MOTION "1 2\n3 -inf\n", 11, 3, "'-inf'"},
    {GOOD_MOTION "1 2\n1e400 4\n", 11, 1, "too large"},
    {GOOD_MOTION "1 2\n4 -1e13\n", 11, 3, "too large"},
    {GOOD_HEAD "Frames: 2\nFrame Time: 1e-300\n", 9, 13, "above 0"},
    {GOOD_MOTION "1 2 3\n4\n", 10, 5, "more numbers"},
    {GOOD_HEAD "Frames: 3\nFrame Time: 0.01\n1 2\n3\n4 5\n6 7\n", 11, 1, "has 1 numbers"},
  };
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip = (kg_clip *)&def; /* must become NULL */
    kg_error error;
    const kg_status status =
      kg_clip_read_bvh_text(&clip, cases[i].text, strlen(cases[i].text), "bad.bvh", &def, &error);
    assert_int_equal(status, KG_ERR_FORMAT);
    assert_null(clip);
    assert_int_equal(error.status, KG_ERR_FORMAT);
    assert_string_equal(error.path, "bad.bvh");
    if (error.line != cases[i].line || error.column != cases[i].column ||
        !strstr(error.text, cases[i].part) || !strstr(error.text, "expected")) {
      fail_msg("case %zu: %ld:%ld: %s", i, error.line, error.column, error.text);
    }
  }
}

static void line_numbers_count_every_kind_of_line_end(void **state)
{
  (void)state;
  static const char *const ends[] = {"\n", "\r\n", "\r"};
  for (size_t i = 0; i < KG_COUNT_OF(ends); i++) {
    text_buffer text = {0};
    for (const char *p = GOOD_MOTION "1 2\n\n3 x\n"; *p != '\0'; p++) {
      text_add(&text, *p == '\n' ? "%s" : "%.1s", *p == '\n' ? ends[i] : p);
    }
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip;
    kg_error error;
    assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "a", &def, &error),
                     KG_ERR_FORMAT);
    assert_int_equal(error.line, 12);
    assert_int_equal(error.column, 3);
    text_free(&text);
  }
}

static void nesting_without_end_is_refused(void **state)
{
  (void)state;
  text_buffer text = {0};
  text_add(&text, "HIERARCHY\n");
  for (int i = 0; i < 100000; i++) {
    text_add(&text, "%s j\n{\nOFFSET 0 0 0\n", i ? "JOINT" : "ROOT");
  }
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error;
  assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "deep", &def, &error),
                   KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "nested more than 512 deep"));
  assert_int_equal(error.line, 2 + 3 * 512);
  assert_int_equal(error.column, 7); /* of the name after JOINT */
  text_free(&text);
  /* joints without channels must not multiply a small file into much memory */
  text_add(&text, "HIERARCHY\nROOT r {OFFSET 0 0 0\nCHANNELS 1 Xrotation\n");
  for (int i = 0; i < 4000; i++)
    text_add(&text, "JOINT j {OFFSET 0 0 0 }\n");
  text_add(&text, "}\nMOTION\nFrames: 100000\nFrame Time: 1\n");
  for (int i = 0; i < 100000; i++)
    text_add(&text, "1\n");
  assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "wide", &def, &error),
                   KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "4001 joints"));
  text_free(&text);
}

static void files_that_cannot_be_opened_say_so(void **state)
{
  (void)state;
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error;
  assert_int_equal(kg_clip_read(&clip, KG_TEST_SCRATCH "/not there.bvh", &def, &error),
                   KG_ERR_READ);
  assert_string_equal(error.path, KG_TEST_SCRATCH "/not there.bvh");
  assert_int_equal(kg_clip_read(&clip, KG_TEST_SCRATCH, &def, &error), KG_ERR_READ);
  const char *empty = KG_TEST_SCRATCH "/empty.bvh";
  fclose(fopen(empty, "wb"));
  assert_int_equal(kg_clip_read(&clip, empty, &def, &error), KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "empty"));
  FILE *file = fopen(empty, "wb");
  fwrite("\x89PNG\r\n\x1a\n\0\0\0\rIHDR", 1, 16, file);
  fclose(file);
  assert_int_equal(kg_clip_read(&clip, empty, &def, &error), KG_ERR_FORMAT);
  assert_int_equal(error.line, 1);
  unlink(empty);
}

/* ---- writer ----------------------------------------------------------------------------------- */

static kg_clip *written_and_read(const kg_clip *clip, const char *name)
{
  char path[512];
  kg_clip *back;
  kg_error error = {.text = ""};
  const kg_clip_def def = kg_clip_default_def();
  snprintf(path, sizeof path, "%s/%s", KG_TEST_SCRATCH, name);
  if (kg_clip_write_bvh(clip, path, &error) != KG_OK ||
      kg_clip_read(&back, path, &def, &error) != KG_OK) {
    fail_msg("%s: %s", error.path, error.text);
  }
  unlink(path);
  return back;
}

static void unchanged_files_come_back_as_they_were(void **state)
{
  (void)state;
  const char *path = KG_TEST_SCRATCH "/same.bvh";
  static const char text[] =
    "HIERARCHY\r\nROOT My Hips\r\n{\r\n  OFFSET 0.10000 0 0 \r\n  CHANNELS 4 Yposition Zrotation "
    "Xposition Xrotation\r\n  End Site { OFFSET 0 1 0 }\r\n  End Site { OFFSET 0 2 0 }\r\n}\r\n"
    "MOTION\r\nFrames: 2\r\nFrame Time: .0083333\r\n1.25 -2 1e-15 720.5\r\n-0.0001 0 3 "
    "0.123456789012345\r\n";
  kg_clip *clip = clip_of(text, sizeof text - 1);
  assert_int_equal(kg_clip_write_bvh(clip, path, NULL), KG_OK);
  kg_clip_destroy(clip);
  char back[sizeof text + 100];
  FILE *file = fopen(path, "rb");
  const size_t n = fread(back, 1, sizeof back, file);
  fclose(file);
  unlink(path);
  back[n] = '\0';
  assert_string_equal(back, text); /* down to the byte */
}

static void a_frame_time_of_many_digits_comes_back(void **state)
{
  (void)state;
  static const char text[] =
    "HIERARCHY ROOT a { OFFSET 0 1 0 CHANNELS 1 Xrotation }\nMOTION\nFrames: 1\n"
    "Frame Time: 0.0083333333333333333333333333333333333333333e1\n5\n";
  kg_clip *clip = clip_of(text, sizeof text - 1), *back = written_and_read(clip, "digits.bvh");
  assert_close(clip->frame_time, 1.0 / 12.0, 1e-15);
  assert_true(back->frame_time == clip->frame_time);
  kg_clip_destroy(clip);
  kg_clip_destroy(back);
}

static void failed_writes_leave_the_old_file(void **state)
{
  (void)state;
  kg_clip *clip = clip_of(plain_file, sizeof plain_file - 1);
  kg_error error;
  assert_int_equal(kg_clip_write_bvh(clip, KG_TEST_SCRATCH "/no such folder/a.bvh", &error),
                   KG_ERR_WRITE);
  assert_string_equal(error.path, KG_TEST_SCRATCH "/no such folder/a.bvh");
  assert_int_equal(kg_clip_write_bvh(clip, KG_TEST_SCRATCH, &error), KG_ERR_WRITE);
  /* a device that is always full: nothing must be left beside it, and it must stay a device */
  if (access("/dev/full", W_OK) == 0) {
    assert_int_equal(kg_clip_write_bvh(clip, "/dev/full", &error), KG_ERR_WRITE);
    assert_int_not_equal(access("/dev/full.part0", F_OK), 0);
    assert_int_equal(access("/dev/full", F_OK), 0);
  }
  /* a disk that is full half way */
  const char *path = KG_TEST_SCRATCH "/old.bvh";
  struct rlimit old_limit, small = {.rlim_cur = 100};
  char back[16] = "";
  FILE *file = fopen(path, "wb");
  fputs("old", file);
  fclose(file);
  assert_int_equal(getrlimit(RLIMIT_FSIZE, &old_limit), 0);
  small.rlim_max = old_limit.rlim_max;
  unlink(KG_TEST_SCRATCH "/old.bvh.part0"); /* of a run that was killed */
  void (*old_handler)(int) = signal(SIGXFSZ, SIG_IGN);
  assert_int_equal(setrlimit(RLIMIT_FSIZE, &small), 0);
  const kg_status status = kg_clip_write_bvh(clip, path, &error);
  assert_int_equal(setrlimit(RLIMIT_FSIZE, &old_limit), 0);
  signal(SIGXFSZ, old_handler);
  assert_int_equal(status, KG_ERR_WRITE);
  assert_int_not_equal(access(KG_TEST_SCRATCH "/old.bvh.part0", F_OK), 0);
  file = fopen(path, "rb");
  assert_int_equal(fread(back, 1, sizeof back, file), 3);
  fclose(file);
  unlink(path);
  assert_string_equal(back, "old");
  kg_clip_destroy(clip);
}

static void set_rotations_survive_the_file_in_every_channel_order(void **state)
{
  (void)state;
  kg_random random = kg_random_make(21);
  for (int o = 0; o < 6; o++) {
    enum { FRAMES = 400 };
    text_buffer text = {0};
    make_two_joints(&text, orders[o], 3, FRAMES);
    kg_clip *clip = clip_of(text.at, text.length);
    kg_quat wanted[2 * FRAMES];
    for (int t = 0; t < FRAMES; t++) {
      for (int j = 0; j < 2; j++) {
        wanted[2 * t + j] = random_quat(&random);
        if (t % 4 == 0) { /* at and beside gimbal lock */
          const double off = t % 8 ? 0.0 : pow(10.0, -3.0 - t % 10);
          const kg_mat3 M =
            kg_mat3_mul(about(orders[o][0], 360 * kg_random_uniform(&random)),
                        kg_mat3_mul(about(orders[o][1], (t % 16 ? 90 : -90) + off),
                                    about(orders[o][2], 360 * kg_random_uniform(&random))));
          wanted[2 * t + j] = kg_quat_from_matrix(M);
        }
        kg_clip_set_rotation(clip, t, j, wanted[2 * t + j], t - 1);
      }
      kg_clip_set_translation(clip, t, 0, kg_vec3_make(0.001 * t, 1.0, -2.0 / 3.0));
    }
    for (size_t k = 0; k < (size_t)clip->channel_count * FRAMES; k++) {
      /* unwrapped: never more than a half turn from the frame before, bar the middle angle's branch */
      const size_t c = k % (size_t)clip->channel_count;
      if (k >= (size_t)clip->channel_count && c >= 3) {
        assert_at_most(fabs(clip->values[k] - clip->values[k - (size_t)clip->channel_count]),
                       180.0 + 1e-9);
      }
    }
    kg_clip *back = written_and_read(clip, "orders.bvh");
    assert_int_equal(back->frame_count, FRAMES);
    for (int k = 0; k < 2 * FRAMES; k++) {
      const kg_quat d = kg_quat_mul(kg_quat_conj(wanted[k]), back->rotations[k]);
      assert_at_most(kg_vec3_norm(kg_quat_log(d)), 1e-9);
      assert_at_most(kg_vec3_norm(kg_vec3_sub(back->translations[k], clip->translations[k])),
                     1e-10);
    }
    kg_clip_destroy(back);
    kg_clip_destroy(clip);
    text_free(&text);
  }
}

static void smooth_motion_has_smooth_angles_through_gimbal_lock(void **state)
{
  (void)state;
  enum { FRAMES = 500 };
  text_buffer text = {0};
  make_two_joints(&text, orders[3], 3, FRAMES); /* ZYX, locks at Y = +-90 */
  kg_clip *clip = clip_of(text.at, text.length);
  for (int t = 0; t < FRAMES; t++) {
    /* the middle axis turns through the lock again and again: the angles follow without a flip */
    kg_clip_set_rotation(clip, t, 1, kg_quat_exp(kg_vec3_make(0, 0.05 * t, 0)), t - 1);
  }
  for (int t = 1; t < FRAMES; t++) {
    const double *now = clip->values + 9 * t + 6, *before = now - 9;
    assert_close(now[1] - before[1], 0.05 * 180 / pi, 1e-6);
    assert_at_most(fabs(now[0]) + fabs(now[2]), 1e-6);
  }
  kg_clip_destroy(clip);
  text_free(&text);
}

/* largest |<q, q'>| over all angles of the channels, by search */
static double best_overlap(kg_quat q, const int *axes, int count)
{
  double best = 0.0, at[2] = {0.0, 0.0}, step = 10.0;
  double centre[2] = {0.0, 0.0}, reach = 180.0;
  for (int round = 0; round < 6; round++) {
    for (double x = centre[0] - reach; x <= centre[0] + reach; x += step) {
      for (double y = centre[1] - (count > 1 ? reach : 0); y <= centre[1] + (count > 1 ? reach : 0);
           y += step) {
        kg_mat3 M = about(axes[0], x);
        if (count > 1) M = kg_mat3_mul(M, about(axes[1], y));
        const double overlap = fabs(kg_quat_dot(q, kg_quat_from_matrix(M)));
        if (overlap > best) {
          best = overlap;
          at[0] = x;
          at[1] = y;
        }
      }
    }
    centre[0] = at[0];
    centre[1] = at[1];
    reach = step;
    step /= 10.0;
  }
  return best;
}

static void joints_with_one_or_two_channels_take_the_nearest_rotation(void **state)
{
  (void)state;
  static const int pairs[9][2] = {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {1, 0},
                                  {0, 2}, {2, 0}, {1, 2}, {2, 1}};
  kg_random random = kg_random_make(22);
  for (int p = 0; p < 9; p++) {
    const int count = p < 3 ? 1 : 2;
    text_buffer text = {0};
    make_two_joints(&text, pairs[p], count, 2);
    kg_clip *clip = clip_of(text.at, text.length);
    for (int i = 0; i < 8; i++) {
      const kg_quat q = random_quat(&random);
      kg_clip_set_rotation(clip, 1, 1, q, 0);
      const kg_quat got = clip->rotations[3];
      assert_close(fabs(kg_quat_dot(got, q)), best_overlap(q, pairs[p], count), 1e-8);
      kg_mat3 M = about(pairs[p][0], clip->values[(3 + 2 * count) + 3 + count]);
      if (count > 1)
        M = kg_mat3_mul(M, about(pairs[p][1], clip->values[(3 + 2 * count) + 4 + count]));
      assert_at_most(matrix_distance(kg_quat_matrix(got), M), 1e-12); /* values agree with it */
    }
    kg_clip_destroy(clip);
    text_free(&text);
  }
}

static void setting_what_is_there_changes_no_value(void **state)
{
  (void)state;
  kg_clip *clip = clip_of(plain_file, sizeof plain_file - 1);
  double before[18];
  memcpy(before, clip->values, sizeof before);
  for (int t = 0; t < 2; t++) {
    for (int j = 0; j < 2; j++) {
      kg_clip_set_rotation(clip, t, j, clip->rotations[2 * t + j], t - 1);
      kg_clip_set_translation(clip, t, j, clip->translations[2 * t + j]);
    }
  }
  assert_memory_equal(before, clip->values, sizeof before);
  clip->values[0] = before[0] = 1.123456789012345; /* more places than a changed value gets */
  kg_clip_set_translation(clip, 0, 0,
                          kg_vec3_scale(clip->source.unit_m, kg_vec3_make(before[0], 2, 3)));
  assert_memory_equal(before, clip->values, sizeof before);
  /* unless the frame before has gone a whole turn further */
  clip->values[6] += 360.0;
  kg_clip_set_rotation(clip, 1, 1, clip->rotations[3], 0);
  assert_close(clip->values[9 + 6], before[9 + 6] + 360.0, 1e-8);
  kg_clip_destroy(clip);
}

/* ---- copies ----------------------------------------------------------------------------------- */

static void resampling_follows_constant_motion_exactly(void **state)
{
  (void)state;
  text_buffer text = {0};
  make_two_joints(&text, orders[0], 3, 1);
  text.length = (size_t)(strstr(text.at, "Frames") - text.at);
  text_add(&text, "Frames: 61\nFrame Time: 0.01\n");
  for (int t = 0; t < 61; t++)
    text_add(&text, "%d 0 0 %d 0 0 0 0 %d\n", 2 * t, 3 * t, -5 * t);
  kg_clip *clip = clip_of(text.at, text.length), *copy;
  assert_int_equal(kg_clip_resample(&copy, clip, 0.0075), KG_OK);
  assert_int_equal(copy->frame_count, 81); /* 0.6 s / 0.0075 s + 1 */
  assert_true(copy->frame_time == 0.0075);
  for (int t = 0; t < 81; t++) {
    const double at = 0.75 * t; /* in frames of the source */
    const kg_quat turn = kg_quat_exp(kg_vec3_make(3 * at * pi / 180, 0, 0));
    const kg_quat d = kg_quat_mul(kg_quat_conj(turn), copy->rotations[2 * t]);
    assert_at_most(kg_vec3_norm(kg_quat_log(d)), 1e-12);
    assert_close(copy->translations[2 * t].x, 2 * at * copy->source.unit_m, 1e-12);
    assert_close(copy->values[9 * t + 3], 3 * at, 1e-7); /* unwrapped all the way */
    assert_close(copy->values[9 * t + 8], -5 * at, 1e-7);
  }
  kg_clip *back = written_and_read(copy, "resampled.bvh");
  assert_int_equal(back->frame_count, 81);
  assert_true(back->frame_time == 0.0075);
  kg_clip_destroy(back);
  kg_clip_destroy(copy);
  /* a last frame missed by rounding alone is there */
  assert_int_equal(kg_clip_resample(&copy, clip, 0.02 * (1.0 + 1e-9)), KG_OK);
  assert_int_equal(copy->frame_count, 31);
  kg_clip_destroy(copy);
  assert_int_equal(kg_clip_copy(&copy, clip), KG_OK);
  kg_clip_set_rotation(copy, 5, 1, kg_quat_exp(kg_vec3_make(1, 0, 0)), 4);
  assert_true(clip->values[9 * 5 + 8] == -25.0); /* the original stays */
  assert_true(copy->values[9 * 5 + 8] != -25.0);
  assert_string_equal(copy->joints[1].name, "b");
  kg_clip_destroy(clip);
  kg_vec3 p[2];
  kg_clip_world(copy, 60, p, NULL); /* the copy owns all it needs */
  assert_int_equal(kg_clip_find(copy, "b"), 1);
  assert_int_equal(kg_clip_find(copy, "B"), -1);
  kg_clip_destroy(copy);
  kg_clip_destroy(NULL);
  text_free(&text);
}

static void survives_every_allocation_failure(void **state)
{
  (void)state;
  text_buffer text = {0};
  add_hierarchy(&text, person, PERSON_JOINTS, 100.0, KG_UP_Y);
  text_add(&text, "MOTION\nFrames: 3\nFrame Time: 0.01\n");
  for (int t = 0; t < 3; t++)
    add_person_frame(&text, 100.0, KG_UP_Y, t);
  int allowed = 0;
  for (bool done = false; !done; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_clip_def def = kg_clip_default_def();
    def.allocator = &allocator;
    def.rate_hz = 60.0;
    kg_clip *clip, *copy = NULL;
    kg_status status = kg_clip_read_bvh_text(&clip, text.at, text.length, "a", &def, NULL);
    if (status == KG_OK) {
      kg_mapping mapping;
      status = kg_mapping_find(&mapping, clip, NULL, NULL);
      status = status == KG_OK ? kg_clip_copy(&copy, clip) : status;
    }
    assert_true(status == KG_OK || status == KG_ERR_NO_MEMORY);
    done = status == KG_OK;
    kg_clip_destroy(clip);
    kg_clip_destroy(copy);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(allowed > 5);
  text_free(&text);
}

/* ---- estimates -------------------------------------------------------------------------------- */

static kg_clip *person_clip(double units_per_m, kg_up_axis up, const double *angles, int count)
{
  text_buffer text = {0};
  add_hierarchy(&text, person, PERSON_JOINTS, units_per_m, up);
  text_add(&text, "MOTION\nFrames: %d\nFrame Time: 0.01\n", count);
  for (int t = 0; t < count; t++)
    add_person_frame(&text, units_per_m, up, angles[t]);
  kg_clip *clip = clip_of(text.at, text.length);
  text_free(&text);
  return clip;
}

static void finds_unit_and_up_axis(void **state)
{
  (void)state;
  static const double units[] = {1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45, 0.1};
  const double angles[] = {1, 2, 3, 4, 5, 6};
  kg_vec3 first[PERSON_JOINTS], now[PERSON_JOINTS];
  kg_clip *reference = person_clip(1.0, KG_UP_Y, angles, 6);
  kg_clip_world(reference, 0, first, NULL);
  assert_close(first[0].y, 0.9, 1e-6);
  for (size_t u = 0; u < KG_COUNT_OF(units); u++) {
    for (int up = 0; up < 3; up++) {
      kg_clip *clip = person_clip(1.0 / units[u], (kg_up_axis)up, angles, 6);
      assert_close(clip->source.unit_m, units[u], 1e-12);
      assert_non_null(strstr(clip->source.unit_reason, "1.70 m"));
      assert_int_equal(clip->source.up, up);
      assert_int_equal(clip->source.warning_count, 0);
      kg_clip_world(clip, 0, now, NULL);
      assert_close(now[0].x, 0.2, 1e-6);
      assert_close(now[0].y, 0.9, 1e-6);
      assert_close(now[0].z, 0.3, 1e-6);
      /* the same person whatever the axes: lengths agree, and back through the file */
      assert_at_most(now[5].y, 1.7);
      assert_true(now[5].y > now[0].y + 0.5);
      kg_vec3 with_rotations[PERSON_JOINTS];
      kg_quat R[PERSON_JOINTS];
      kg_clip_world(clip, 5, now, NULL);
      kg_clip_world(clip, 5, with_rotations, R);
      for (int j = 0; j < PERSON_JOINTS; j++) {
        assert_at_most(kg_vec3_norm(kg_vec3_sub(now[j], with_rotations[j])), 1e-12);
      }
      kg_clip_set_translation(clip, 0, 0, kg_vec3_make(1.0, 2.0, 3.0));
      const kg_quat wanted = kg_quat_exp(kg_vec3_make(0.1, 0.2, 0.3));
      kg_clip_set_rotation(clip, 0, 0, wanted, -1);
      kg_clip *back = written_and_read(clip, "axes.bvh");
      assert_int_equal(back->source.up, up);
      const kg_quat miss = kg_quat_mul(kg_quat_conj(wanted), back->rotations[0]);
      assert_at_most(kg_vec3_norm(kg_quat_log(miss)), 1e-9);
      assert_close(back->translations[0].y, 2.0, 1e-8);
      assert_close(back->translations[0].z, 3.0, 1e-8);
      for (int j = 0; j < PERSON_JOINTS; j++) {
        assert_at_most(kg_vec3_norm(kg_vec3_sub(back->translations[j], clip->translations[j])),
                       1e-9);
        const kg_quat d = kg_quat_mul(kg_quat_conj(clip->rotations[j]), back->rotations[j]);
        assert_at_most(kg_vec3_norm(kg_quat_log(d)), 1e-9);
      }
      kg_clip_destroy(back);
      kg_clip_destroy(clip);
    }
  }
  kg_clip_destroy(reference);
}

/* The rest pose is y up, and the root stands or lies at `root` with a quarter turn about x. */
static kg_clip *turned_person(double x, double y, double z, double turn)
{
  text_buffer text = {0};
  add_hierarchy(&text, person, PERSON_JOINTS, 1.0, KG_UP_Y);
  text_add(&text, "MOTION\nFrames: 5\nFrame Time: 0.01\n");
  for (int t = 0; t < 5; t++) {
    text_add(&text, "%g %g %g 0 %g 0", x, y, z, turn);
    for (int c = 3; c < 3 * PERSON_JOINTS; c++)
      text_add(&text, " 0");
    text_add(&text, "\n");
  }
  kg_clip *clip = clip_of(text.at, text.length);
  text_free(&text);
  return clip;
}

static void tells_z_up_from_lying_on_the_floor(void **state)
{
  (void)state;
  kg_clip *standing = turned_person(2.0, 3.0, 0.9, 90.0);
  kg_clip *lying = turned_person(2.0, 0.1, 4.0, 90.0);
  kg_clip *lying_the_other_way = turned_person(2.0, 0.1, -0.9, -90.0);
  assert_int_equal(lying_the_other_way->source.up, KG_UP_Y);
  kg_clip_destroy(lying_the_other_way);
  assert_int_equal(standing->source.up, KG_UP_Z);
  assert_int_equal(lying->source.up, KG_UP_Y);
  assert_non_null(strstr(standing->source.warnings[0], "disagree on the up axis; Z is taken"));
  assert_non_null(strstr(lying->source.warnings[0], "disagree on the up axis; Y is taken"));
  kg_vec3 p[PERSON_JOINTS];
  kg_clip_world(standing, 2, p, NULL);
  assert_close(p[0].y, 0.9, 1e-12);
  assert_close(p[5].y, 0.9 + 0.59, 1e-12); /* the head above */
  kg_clip_destroy(standing);
  kg_clip_destroy(lying);
}

static void odd_statures_are_read_with_a_warning(void **state)
{
  (void)state;
  const double angles[] = {1, 2, 3};
  kg_clip *clip = person_clip(0.5, KG_UP_Y, angles, 3); /* 0.85 m if in m */
  assert_close(clip->source.unit_m, 1.0, 1e-12);
  assert_true(clip->source.warning_count > 0);
  kg_clip_destroy(clip);
}

static void finds_an_inserted_pose_only_where_there_is_one(void **state)
{
  (void)state;
  const double inserted[] = {0, 40, 40.5, 41, 41.4, 41.6, 41.7, 41.9};
  const double smooth[] = {0, 0.5, 1.5, 3, 5, 7.5, 10, 13};
  const double still[] = {0, 0, 0, 0, 0, 0, 0, 0};
  const double fast[] = {0, 20, 40, 20, 0, 20, 40, 20};
  const double burst[] = {0, 30, 55, 60, 60, 60, 60, 60}; /* mostly still: the median is nothing */
  const int wanted[] = {1, 0, 0, 0, 0};
  const double *const all[] = {inserted, smooth, still, fast, burst};
  for (int i = 0; i < 5; i++) {
    kg_clip *clip = person_clip(100.0, KG_UP_Y, all[i], 8);
    assert_int_equal(clip->source.first_frame, wanted[i]);
    kg_clip_destroy(clip);
  }
  /* dropped by resampling, kept on demand */
  kg_clip *clip = person_clip(100.0, KG_UP_Y, inserted, 8), *copy;
  assert_int_equal(kg_clip_resample(&copy, clip, 0.01), KG_OK);
  assert_int_equal(copy->frame_count, 7);
  assert_int_equal(copy->source.first_frame, 0);
  assert_memory_equal(copy->values, clip->values + clip->channel_count,
                      7 * (size_t)clip->channel_count * sizeof(double));
  kg_clip_destroy(copy);
  kg_clip_destroy(clip);
  text_buffer text = {0};
  add_hierarchy(&text, person, PERSON_JOINTS, 100.0, KG_UP_Y);
  text_add(&text, "MOTION\nFrames: 8\nFrame Time: 0.01\n");
  for (int t = 0; t < 8; t++)
    add_person_frame(&text, 100.0, KG_UP_Y, inserted[t]);
  kg_clip_def def = kg_clip_default_def();
  def.keep_first_frame = true;
  def.rate_hz = 50.0;
  def.up_given = true;
  def.up = KG_UP_Z;
  assert_int_equal(kg_clip_read_bvh_text(&clip, text.at, text.length, "a", &def, NULL), KG_OK);
  assert_int_equal(clip->source.first_frame, 0);
  assert_true(clip->source.up_given && clip->source.rate_given);
  assert_int_equal(clip->source.up, KG_UP_Z);
  assert_true(clip->frame_time == 0.02);
  kg_clip_destroy(clip);
  text_free(&text);
}

/* ---- captures --------------------------------------------------------------------------------- */

static void reads_and_returns_the_shared_captures(void **state)
{
  (void)state;
  static const struct {
    const char *name;
    int joints, frames, first_frame;
    double unit;
  } files[] = {
    {"basketball/cmu_06_02.bvh", 31, 722, 1, 0.0254 / 0.45},
    {"basketball/cmu_06_13.bvh", 31, 4906, 1, 0.0254 / 0.45},
    {"basketball/snu_s_003_6_1.bvh", 22, 766, 0, 0.01},
    {"gymnastics/cmu_05_13.bvh", 31, 1096, 1, 0.0254 / 0.45},
    {"gymnastics/cmu_49_02.bvh", 31, 2086, 1, 0.0254 / 0.45},
    {"gymnastics/cmu_49_04.bvh", 31, 252, 1, 0.0254 / 0.45},
    {"gymnastics/cmu_49_06.bvh", 31, 482, 1, 0.0254 / 0.45},
    {"gymnastics/cmu_49_08.bvh", 31, 576, 1, 0.0254 / 0.45},
    {"gymnastics/cmu_49_18.bvh", 31, 1103, 1, 0.0254 / 0.45},
    {"gymnastics/snu_backflip.bvh", 37, 199, 0, 0.01},
    {"gymnastics/snu_pirouette.bvh", 37, 485, 0, 0.01},
    {"track/cmu_02_04.bvh", 31, 484, 1, 0.0254 / 0.45},
    {"track/cmu_09_01.bvh", 31, 149, 1, 0.0254 / 0.45},
  };
  for (size_t i = 0; i < KG_COUNT_OF(files); i++) {
    char path[1024];
    FILE *file = open_shared(files[i].name, path, sizeof path);
    if (!file) {
      print_message("skipped: no capture at %s\n", path);
      skip();
    }
    fclose(file);
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip;
    kg_error error;
    assert_int_equal(kg_clip_read(&clip, path, &def, &error), KG_OK);
    assert_int_equal(clip->joint_count, files[i].joints);
    assert_int_equal(clip->frame_count, files[i].frames);
    assert_int_equal(clip->source.first_frame, files[i].first_frame);
    assert_close(clip->source.unit_m, files[i].unit, 1e-12);
    assert_int_equal(clip->source.up, KG_UP_Y);
    assert_int_equal(clip->source.warning_count, 0);
    kg_clip *back = written_and_read(clip, "capture.bvh");
    assert_true(back->frame_time == clip->frame_time);
    assert_memory_equal(back->values, clip->values,
                        (size_t)clip->frame_count * (size_t)clip->channel_count * sizeof(double));
    kg_clip_destroy(back);
    kg_clip_destroy(clip);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(reads_numbers_as_strtod_does),
    cmocka_unit_test(refuses_what_is_no_number),
    cmocka_unit_test(the_locale_does_not_matter),
    cmocka_unit_test(printed_numbers_come_back_bit_equal),
    cmocka_unit_test(channels_multiply_left_to_right),
    cmocka_unit_test(position_channels_replace_the_offset),
    cmocka_unit_test(a_changed_frame_keeps_the_signs_of_all_later_ones),
    cmocka_unit_test(quaternions_do_not_jump),
    cmocka_unit_test(reads_the_variants_of_the_format),
    cmocka_unit_test(memory_follows_the_data_and_not_the_header),
    cmocka_unit_test(partial_and_surplus_frames_are_left_out_with_a_warning),
    cmocka_unit_test(bad_files_are_refused_where_they_are_bad),
    cmocka_unit_test(line_numbers_count_every_kind_of_line_end),
    cmocka_unit_test(nesting_without_end_is_refused),
    cmocka_unit_test(files_that_cannot_be_opened_say_so),
    cmocka_unit_test(unchanged_files_come_back_as_they_were),
    cmocka_unit_test(a_frame_time_of_many_digits_comes_back),
    cmocka_unit_test(failed_writes_leave_the_old_file),
    cmocka_unit_test(set_rotations_survive_the_file_in_every_channel_order),
    cmocka_unit_test(smooth_motion_has_smooth_angles_through_gimbal_lock),
    cmocka_unit_test(joints_with_one_or_two_channels_take_the_nearest_rotation),
    cmocka_unit_test(setting_what_is_there_changes_no_value),
    cmocka_unit_test(resampling_follows_constant_motion_exactly),
    cmocka_unit_test(survives_every_allocation_failure),
    cmocka_unit_test(finds_unit_and_up_axis),
    cmocka_unit_test(tells_z_up_from_lying_on_the_floor),
    cmocka_unit_test(odd_statures_are_read_with_a_warning),
    cmocka_unit_test(finds_an_inserted_pose_only_where_there_is_one),
    cmocka_unit_test(reads_and_returns_the_shared_captures),
  };
  return cmocka_run_group_tests_name("bvh", tests, NULL, NULL);
}
