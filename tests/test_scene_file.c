/* Combinations in descriptions of scenes, against the formulas of their parts. What the reader says is
 * caught here; the rest of it is tested from outside, in test_cli.sh. */
#include "support.h"

#include <unistd.h>

#include "cli/messages.h"
#include "cli/scene_file.h"

static kg_error told;

int cli_failed(const kg_error *error)
{
  told = *error;
  return CLI_INPUT;
}

void cli_warning(bool is_quiet, const char *format, ...)
{
  fail_msg("a warning%s: %s", is_quiet ? ", quiet" : "", format);
}

void cli_message(const char *format, ...)
{
  fail_msg("a message: %s", format);
}

static cli_scene scene; /* large */

/* the exit code; the scene is left empty when it is not CLI_GOOD */
static int read_scene(const char *text)
{
  static const char path[] = KG_TEST_SCRATCH "/scene_file.json";
  FILE *file = fopen(path, "w");
  assert_non_null(file);
  assert_true(fputs(text, file) >= 0 && fclose(file) == 0);
  scene = (cli_scene){.floor_file = NULL};
  told = (kg_error){.status = KG_OK};
  const int code = cli_scene_add(&scene, path, 1.0, true);
  unlink(path);
  return code;
}

/* the parts of the cases below, as the file says them and as the library knows them */
#define BOX                                                                                        \
  "{\"type\": \"box\", \"center_m\": [0.1, 0, 0], \"size_m\": [1, 0.6, 0.8], \"rotation_deg\": "   \
  "[0, 0, 90]}"
#define BALL "{\"type\": \"sphere\", \"center_m\": [0.4, 0.3, 0.1], \"radius_m\": 0.4}"
#define BAR                                                                                        \
  "{\"type\": \"capsule\", \"from_m\": [-1, 0.2, 0], \"to_m\": [1, 0.1, 0], \"radius_m\": 0.15}"
#define PLACED ", \"at_m\": [1, 2, 3], \"rotation_deg\": [0, 60, 0]"

typedef struct distances {
  double box, ball, bar;
} distances;

static distances parts_at(kg_vec3 x)
{
  const kg_quat turn = kg_quat_exp(kg_vec3_make(0, 0, acos(0.0)));
  return (distances){
    kg_sdf_box(kg_vec3_make(0.1, 0, 0), turn, kg_vec3_make(0.5, 0.3, 0.4), x).distance,
    kg_vec3_norm(kg_vec3_sub(x, kg_vec3_make(0.4, 0.3, 0.1))) - 0.4,
    kg_sdf_capsule(kg_vec3_make(-1, 0.2, 0), kg_vec3_make(1, 0.1, 0), 0.15, x).distance};
}

static double union_of(distances d)
{
  return fmin(fmin(d.box, d.ball), d.bar);
}

static double intersection_of(distances d)
{
  return fmax(fmax(d.box, d.ball), d.bar);
}

static double box_without_the_others(distances d)
{
  return fmax(fmax(d.box, -d.ball), -d.bar);
}

static double smooth(double a, double b)
{
  const double r = 0.3, left = fmax(1.0 - fabs(a - b) / r, 0.0);
  return fmin(a, b) - r / 6.0 * left * left * left;
}

static double smooth_union_of(distances d)
{
  return smooth(smooth(d.box, d.ball), d.bar);
}

static double nested_of(distances d)
{
  return fmax(fmin(d.box, d.bar), d.ball);
}

static void combinations_are_those_of_their_parts(void **state)
{
  (void)state;
  static const struct {
    const char *text;
    double (*of)(distances d);
  } cases[] = {
    {"{\"type\": \"union\", \"of\": [" BOX "," BALL "," BAR "]" PLACED "}", union_of},
    {"{\"type\": \"intersection\", \"of\": [" BOX "," BALL "," BAR "]" PLACED "}", intersection_of},
    {"{\"type\": \"difference\", \"of\": [" BOX "," BALL "," BAR "]" PLACED "}",
     box_without_the_others},
    {"{\"type\": \"smooth_union\", \"radius_m\": 0.3, \"of\": [" BOX "," BALL "," BAR "]" PLACED
     "}",
     smooth_union_of},
    {"{\"type\": \"intersection\", \"of\": [{\"type\": \"union\", \"of\": [" BOX "," BAR "]}," BALL
     "]" PLACED "}",
     nested_of},
  };
  kg_random random = kg_random_make(31);
  const double angle = acos(0.5);
  for (size_t k = 0; k < KG_COUNT_OF(cases); k++) {
    char text[2048];
    snprintf(text, sizeof text, "{\"shapes\": [%s]}", cases[k].text);
    if (read_scene(text) != CLI_GOOD) fail_msg("case %zu: %s", k, told.text);
    int inside = 0;
    for (int i = 0; i < 2000; i++) {
      const kg_vec3 y =
        kg_vec3_make(1.5 * kg_random_uniform(&random) - 0.6, 1.5 * kg_random_uniform(&random) - 0.7,
                     1.5 * kg_random_uniform(&random) - 0.7);
      const kg_vec3 x = kg_vec3_make(1.0 + cos(angle) * y.x + sin(angle) * y.z, 2.0 + y.y,
                                     3.0 - sin(angle) * y.x + cos(angle) * y.z);
      const double expected = cases[k].of(parts_at(y));
      assert_close(kg_scene_distance(&scene.scene, x).distance, expected, 1e-12);
      inside += expected < 0.0;
    }
    assert_true(inside > 10 && inside < 1990);
    cli_scene_release(&scene);
  }
}

static void a_combination_moves_as_a_whole(void **state)
{
  (void)state;
  assert_int_equal(
    read_scene("{\"shapes\": [{\"type\": \"difference\", \"of\": [" BOX "," BALL "]" PLACED
               ", \"velocity_m_per_s\": [0, 0, 2], \"spin_rad_per_s\": [0, 3, 0]}]}"),
    CLI_GOOD);
  const kg_scene_point at = kg_scene_nearest(&scene.scene, kg_vec3_make(2.0, 2.0, 3.0));
  assert_close(at.velocity.x, 0.0, 1e-12);
  assert_close(at.velocity.z, 2.0 - 3.0 * 1.0, 1e-12); /* spin about at_m, which is 1 m away */
  cli_scene_release(&scene);
}

/* a mesh has a place of its own in the combination's */
static void a_mesh_may_be_a_part(void **state)
{
  (void)state;
  static const char *const solids[] = {
    "{\"type\": \"mesh\", \"file\": \"" KG_TEST_DATA "/sdf/cube.obj\", \"at_m\": [0.2, 0, 0]}",
    "{\"type\": \"box\", \"center_m\": [0.7, 0.5, 0.5], \"size_m\": [1, 1, 1]}"};
  kg_random random = kg_random_make(32);
  double found[2][300];
  for (int k = 0; k < 2; k++) {
    char text[1024];
    snprintf(text, sizeof text,
             "{\"shapes\": [{\"type\": \"intersection\", \"of\": [%s, {\"type\": \"sphere\", "
             "\"center_m\": [1, 1, 1], \"radius_m\": 0.9}]" PLACED "}]}",
             solids[k]);
    if (read_scene(text) != CLI_GOOD) fail_msg("%s", told.text);
    random = kg_random_make(32);
    for (int i = 0; i < 300; i++) {
      const kg_vec3 x =
        kg_vec3_make(4.0 * kg_random_uniform(&random), 4.0 * kg_random_uniform(&random),
                     1.0 + 4.0 * kg_random_uniform(&random));
      found[k][i] = kg_scene_distance(&scene.scene, x).distance;
    }
    cli_scene_release(&scene);
  }
  for (int i = 0; i < 300; i++) {
    assert_close(found[0][i], found[1][i], 1e-6);
  }
}

static void refuse(const char *shape, long column, const char *words)
{
  char text[4096];
  snprintf(text, sizeof text, "{\"shapes\": [\n%s]}", shape);
  assert_int_equal(read_scene(text), CLI_INPUT);
  if (!strstr(told.text, words) || told.line != 2 || told.column != column) {
    fail_msg("%s: %ld:%ld: %s", shape, told.line, told.column, told.text);
  }
  cli_scene_release(&scene);
}

static void mistakes_are_told_where_they_are(void **state)
{
  (void)state;
  refuse("{\"type\": \"union\"}", 1, "\"of\" is missing: expected an array of two shapes or more");
  refuse("{\"type\": \"union\", \"of\": [" BALL "]}", 25, "\"of\": expected an array of two");
  refuse("{\"type\": \"smooth_union\", \"of\": [" BALL "," BALL "]}", 1, "\"radius_m\" is missing");
  refuse("{\"type\": \"union\", \"of\": [" BALL ", {\"type\": \"mat\"}]}", 101,
         "parts are not soft");
  refuse("{\"type\": \"union\", \"of\": [" BALL ", 3]}", 92, "expected an object");
  refuse("{\"type\": \"union\", \"soft\": {}, \"of\": [" BALL "," BALL "]}", 19,
         "unknown member \"soft\"");
  refuse("{\"type\": \"union\", \"of\": [{\"spin_rad_per_s\": [0, 0, 0], \"type\": \"box\"}]}", 25,
         "two");
  refuse("{\"type\": \"union\", \"of\": [{\"spin_rad_per_s\": [0, 0, 0], \"type\": \"box\"}, 3]}",
         27, "unknown member \"spin_rad_per_s\"");
}

/* `most` deep: union of (union of (...)) and a ball */
static int read_nested(int most)
{
  char text[4096] = "{\"shapes\": [";
  for (int k = 0; k < most; k++) {
    strcat(text, "{\"type\": \"union\", \"of\": [");
  }
  strcat(text, BALL);
  for (int k = 0; k < most; k++) {
    strcat(text, ", " BALL "]}");
  }
  strcat(text, "]}");
  const int code = read_scene(text);
  cli_scene_release(&scene);
  return code;
}

static int read_wide(int parts)
{
  static char text[64 * 128];
  strcpy(text, "{\"shapes\": [{\"type\": \"union\", \"of\": [");
  for (int k = 0; k < parts; k++) {
    strcat(text, k > 0 ? ", " BALL : BALL);
  }
  strcat(text, "]}]}");
  const int code = read_scene(text);
  cli_scene_release(&scene);
  return code;
}

static void limits_are_told(void **state)
{
  (void)state;
  assert_int_equal(read_nested(8), CLI_GOOD);
  assert_int_equal(read_nested(9), CLI_INPUT);
  assert_non_null(strstr(told.text, "combinations no more than 8 deep"));
  assert_int_equal(read_wide(48), CLI_GOOD); /* and 47 joints: 95 */
  assert_int_equal(scene.scene.shape_count, 95);
  assert_int_equal(read_wide(49), CLI_INPUT);
  assert_non_null(strstr(told.text, "more than 95 shapes"));
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(combinations_are_those_of_their_parts),
    cmocka_unit_test(a_combination_moves_as_a_whole),
    cmocka_unit_test(a_mesh_may_be_a_part),
    cmocka_unit_test(mistakes_are_told_where_they_are),
    cmocka_unit_test(limits_are_told),
  };
  return cmocka_run_group_tests_name("scene file", tests, NULL, NULL);
}
