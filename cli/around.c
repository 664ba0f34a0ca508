/* What is in a clip's way: scene, another athlete, the body itself. */
#include "cli/around.h"

#include "cli/messages.h"

const cli_option cli_around_options[] = {
  {.name = "scene",
   .kind = CLI_PATHS,
   .value_name = "FILE",
   .summary = "a solid beside the ground: OBJ, PLY, OFF or STL; or a scene: JSON",
   .details = "In the clip's world, Y up. What is wrong with a mesh (open, inside out) is said. A "
              "file whose name ends in .json describes boxes, mats, capsules and other shapes, "
              "meshes, what is soft and what moves: docs/guide/scenes.md.",
   .offset = offsetof(cli_around_values, scene)},
  {.name = "scene-unit",
   .kind = CLI_NUMBER,
   .value_name = "M",
   .unit = "m per unit of the mesh",
   .default_text = "1",
   .summary = "length of one unit of the meshes",
   .minimum = 1e-6,
   .maximum = 1000.0,
   .offset = offsetof(cli_around_values, scene_unit)},
  {.name = "with",
   .kind = CLI_PATH,
   .value_name = "CLIP",
   .summary = "another athlete's clip of the same session, who is in the way",
   .details = "Read as the clip itself is, in the same world; time 0 is the first motion frame of "
              "both, frame rates may differ. Its body is a moving part of the scene: it is touched "
              "and kept out of, but not changed. The report has the other_ rows then.",
   .offset = offsetof(cli_around_values, with)},
  {.name = "self",
   .kind = CLI_FLAG,
   .summary = "the body's own arms, legs and trunk are in each other's way",
   .details =
     "Points of a segment are held against the shapes of segments three joints away or "
     "more, as far as these do not overlap in the skeleton's rest pose. The report has the "
     "self_ rows then.",
   .offset = offsetof(cli_around_values, self)},
};
_Static_assert(KG_COUNT_OF(cli_around_options) == CLI_AROUND_OPTION_COUNT, "rows and count");

/* ---- reading ----------------------------------------------------------------------------------- */

static int read_other(cli_around *around, const cli_reading *reading, bool is_quiet)
{
  const int code = cli_read_clip(&around->other_clip, around->values->with, reading, is_quiet);
  return code == CLI_GOOD ? cli_create_subject(&around->other, around->other_clip, reading, NULL)
                          : code;
}

int cli_around_read(cli_around *around, const cli_around_values *values, const cli_reading *reading,
                    bool is_quiet)
{
  int code = CLI_GOOD;
  around->values = values;
  for (int i = 0; i < values->scene.count && code == CLI_GOOD; i++) {
    code = cli_scene_add(&around->scene, values->scene.path[i], values->scene_unit, is_quiet);
  }
  return code == CLI_GOOD && values->with ? read_other(around, reading, is_quiet) : code;
}

void cli_around_release(cli_around *around)
{
  kg_subject_destroy(around->other);
  kg_clip_destroy(around->other_clip);
  cli_scene_release(&around->scene);
}

/* What happens when one of the clips ends first */
static void tell_ends(const cli_around *around, const kg_clip *clip, const kg_subject *subject,
                      bool is_quiet)
{
  const double own = (subject->frame_count - 1) * subject->dt;
  const double other = (around->other->frame_count - 1) * around->other->dt;
  if (other < own - 0.5 * subject->dt) {
    cli_warning(is_quiet,
                "%s ends at %.3f s, %s at %.3f s: from then on the other athlete is not there",
                around->values->with, other, clip->source.path, own);
  } else if (other > own + 0.5 * around->other->dt) {
    cli_warning(is_quiet, "%s ends at %.3f s, %s at %.3f s: the rest of it is not used",
                clip->source.path, own, around->values->with, other);
  }
}

int cli_around_subject(kg_subject **subject, const cli_around *around, const kg_clip *clip,
                       const cli_reading *reading, bool is_quiet)
{
  kg_subject_def def = kg_subject_default_def();
  def.extra = &around->scene.scene;
  def.ground = around->scene.floor_file ? &around->scene.floor : NULL;
  def.other = around->other;
  def.self = around->values->self;
  const int code = cli_create_subject(subject, clip, reading, &def);
  if (code == CLI_GOOD && around->other) {
    tell_ends(around, clip, *subject, is_quiet);
  }
  return code;
}

/* ---- files ------------------------------------------------------------------------------------- */

int cli_around_paths(const cli_around_values *values, const char *paths[CLI_MAX_AROUND_PATHS])
{
  paths[0] = values->with;
  for (int i = 0; i < values->scene.count; i++) {
    paths[1 + i] = values->scene.path[i];
  }
  return 1 + values->scene.count;
}

int cli_around_found(const cli_around *around, const char *paths[CLI_MAX_AROUND_FOUND])
{
  paths[0] = around->other_clip ? around->other_clip->source.skeleton_path : NULL;
  for (int i = 0; i < around->scene.mesh_count; i++) {
    paths[1 + i] = around->scene.mesh_paths[i];
  }
  return 1 + around->scene.mesh_count;
}

/* ---- telling ----------------------------------------------------------------------------------- */

/* of all shapes, the floor among them; a combination is one */
typedef struct scene_counts {
  int shapes, soft, moving;
} scene_counts;

static scene_counts count_scene(const kg_scene *scene)
{
  scene_counts counts = {0, 0, 0};
  for (int i = 0; i < scene->shape_count; i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    if (shape->part) continue;
    counts.shapes++;
    const kg_place *place = shape->place > 0 ? &scene->places[shape->place - 1] : NULL;
    counts.soft += shape->ground > 0;
    counts.moving += place && kg_place_is_moving(place);
  }
  return counts;
}

void cli_print_around(FILE *out, const cli_around *around, const kg_subject *subject)
{
  const scene_counts counts = count_scene(&subject->scene);
  const bool has_soft_floor = around->scene.floor_file != NULL;
  if (counts.shapes > 1 || has_soft_floor) {
    fprintf(out, "  scene        %s", has_soft_floor ? "soft floor" : "floor");
    if (counts.shapes > 1) {
      fprintf(out, " and %d %s, %d soft, %d moving", counts.shapes - 1,
              counts.shapes > 2 ? "shapes" : "shape", counts.soft - has_soft_floor, counts.moving);
    }
    fputc('\n', out);
  }
  if (around->other) {
    fprintf(out, "  with         %s, %d frames at %.6g Hz\n", around->values->with,
            around->other->frame_count, 1.0 / around->other->dt);
  }
}

static json_t *scene_object(const cli_around *around, const kg_subject *subject)
{
  const scene_counts counts = count_scene(&subject->scene);
  json_t *object = json_object(), *files = json_array();
  for (int i = 0; i < around->values->scene.count; i++) {
    json_array_append_new(files, cli_json_text(around->values->scene.path[i]));
  }
  json_object_set_new(object, "files", files);
  cli_json_set_integer(object, "shape_count", counts.shapes);
  cli_json_set_integer(object, "soft_count", counts.soft);
  cli_json_set_integer(object, "moving_count", counts.moving);
  cli_json_set_number(object, "floor_thickness_m",
                      around->scene.floor_file ? around->scene.floor.thickness : 0.0);
  return object;
}

void cli_report_around(json_t *root, const cli_around *around, const kg_subject *subject)
{
  json_object_set_new(root, "scene", scene_object(around, subject));
  if (around->other) {
    json_t *other = json_object();
    cli_report_source(other, around->other_clip, around->other);
    json_object_set_new(root, "other", other);
  }
}
