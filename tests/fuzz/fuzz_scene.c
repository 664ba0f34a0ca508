/* Any bytes as the description of a scene: an error at a place of the file, or a scene whose distances are
 * numbers that change by no more than the way gone. What the reader says is caught here. */
#include "fuzz.h"

#include <unistd.h>

#include "cli/messages.h"
#include "cli/scene_file.h"

static kg_error told;

int cli_failed(const kg_error *error)
{
  FUZZ_CHECK(told.status == KG_OK &&
             error->status != KG_OK); /* the first failure ends the reading */
  told = *error;
  return CLI_INPUT;
}

void cli_warning(bool is_quiet, const char *format, ...)
{
  FUZZ_CHECK(is_quiet && format);
}

void cli_message(const char *format, ...)
{
  FUZZ_CHECK(!format); /* of the options, which are not read here */
}

static void check_error(const uint8_t *data, size_t size)
{
  long lines = 1;
  for (size_t i = 0; i < size; i++) {
    lines += data[i] == '\n';
  }
  FUZZ_CHECK(told.status != KG_OK && told.text[0] != '\0');
  FUZZ_CHECK(memchr(told.text, '\n', sizeof told.text) == NULL);
  FUZZ_CHECK(told.line >= 0 && told.line <= lines);
}

static void use(const cli_scene *read)
{
  const kg_scene *scene = &read->scene;
  kg_vec3 before = {0.0, 0.0, 0.0};
  double distance_before = kg_scene_distance(scene, before).distance;
  for (int i = 0; i < 12; i++) {
    const kg_vec3 x = kg_vec3_make(0.9 * (i % 5) - 2.0, 0.31 * i, 1.7 - 0.4 * (i % 7));
    const kg_sdf_value v = kg_scene_distance(scene, x);
    const double way = kg_vec3_norm(kg_vec3_sub(x, before));
    FUZZ_CHECK(!isnan(v.distance) && kg_vec3_norm(v.normal) <= 1.0 + 1e-6);
    FUZZ_CHECK((scene->shape_count == 0) == isinf(v.distance));
    FUZZ_CHECK(isinf(v.distance) ||
               fabs(v.distance - distance_before) <= way + 1e-7 * (1.0 + fabs(v.distance)));
    FUZZ_CHECK(kg_scene_surface(scene, x) <= v.distance);
    before = x;
    distance_before = v.distance;
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  char path[64];
  snprintf(path, sizeof path, "fuzz_scene_%ld.json", (long)getpid());
  FILE *file = fopen(path, "wb");
  FUZZ_CHECK(file != NULL);
  FUZZ_CHECK(fwrite(data, 1, size, file) == size);
  fclose(file);
  static cli_scene scene; /* large */
  scene = (cli_scene){.floor_file = NULL};
  told = (kg_error){.status = KG_OK};
  const int code = cli_scene_add(&scene, path, 1.0, true);
  unlink(path);
  if (code == CLI_GOOD) {
    FUZZ_CHECK(told.status == KG_OK);
    use(&scene);
  } else {
    check_error(data, size);
  }
  cli_scene_release(&scene);
  return 0;
}
