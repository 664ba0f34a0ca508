/* How a clip is read: options, and what was decided about the file, as text and as JSON. */
#include "cli/reading.h"

#include <string.h>

#include "cli/messages.h"

const cli_option cli_reading_options[] = {
  {.name = "asf",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .default_text = "found by name",
   .summary = "skeleton of an AMC clip",
   .details = "An AMC file has no skeleton of its own. Left out, the ASF file beside it is used "
              "whose name is the longest beginning of the clip's (16.asf for 16_03.amc).",
   .offset = offsetof(cli_reading, asf)},
  {.name = "rate",
   .kind = CLI_NUMBER,
   .value_name = "HZ",
   .unit = "frames per second",
   .default_text = "the file's; 120 for AMC, which states none",
   .summary = "frame rate of the clip, where the file says none or a wrong one",
   .minimum = 1.0,
   .maximum = 10000.0,
   .offset = offsetof(cli_reading, rate)},
  {.name = "unit",
   .kind = CLI_NUMBER,
   .value_name = "M",
   .unit = "m per unit of the file",
   .default_text = "estimated from the size of the skeleton",
   .summary = "length of one unit of the file",
   .details = "0.01 for centimetres, 0.0254 for inches, 0.056444444 for CMU files.",
   .minimum = 1e-6,
   .maximum = 1000.0,
   .offset = offsetof(cli_reading, unit)},
  {.name = "up",
   .kind = CLI_CHOICE,
   .value_name = "AXIS",
   .choices = "auto|y|z|x",
   .default_text = "auto",
   .summary = "axis of the file that points up",
   .offset = offsetof(cli_reading, up)},
  {.name = "floor",
   .kind = CLI_NUMBER,
   .value_name = "H",
   .unit = "m",
   .default_text = "height and tilt estimated from standing feet",
   .summary = "height of a level floor",
   .details = "Height in the clip's world, after conversion to metres. A given floor is level.",
   .minimum = -1000.0,
   .maximum = 1000.0,
   .offset = offsetof(cli_reading, floor)},
  {.name = "keep-first-frame",
   .kind = CLI_FLAG,
   .default_text = "an inserted T-pose is recognised and left out",
   .summary = "frame 0 is motion, even if it looks like an inserted T-pose",
   .offset = offsetof(cli_reading, keep_first_frame)},
  {.name = "map",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .default_text = "by joint names",
   .summary = "which joint plays which role: lines 'role = joint name'",
   .details = "Overrides the names. 'kinegrad info --joints' lists the joints of a file, "
              "'kinegrad help roles' the roles.",
   .offset = offsetof(cli_reading, map)},
  {.name = "mass",
   .kind = CLI_NUMBER,
   .value_name = "KG",
   .unit = "kg",
   .default_text = "70",
   .summary = "body mass",
   .minimum = 1.0,
   .maximum = 1000.0,
   .offset = offsetof(cli_reading, mass)},
  {.name = "sex",
   .kind = CLI_CHOICE,
   .value_name = "SEX",
   .choices = "mean|female|male",
   .default_text = "mean",
   .summary = "which table of segment masses",
   .details = "Segment masses, centres of mass and inertias are de Leva's (1996).",
   .offset = offsetof(cli_reading, sex)},
};
_Static_assert(KG_COUNT_OF(cli_reading_options) == CLI_READING_OPTION_COUNT, "rows and count");

const cli_option cli_talk_options[] = {
  {.letter = 'q',
   .name = "quiet",
   .kind = CLI_FLAG,
   .summary = "no warnings and no progress; errors are still told",
   .offset = offsetof(cli_talk, quiet)},
  {.name = "progress",
   .kind = CLI_CHOICE,
   .value_name = "HOW",
   .choices = "auto|json|none",
   .default_text = "auto: one line on a terminal, nothing otherwise",
   .summary = "how progress is told on stderr",
   .details = "json writes one object per line: stage, share, frames, frames_done, frames_per_s, "
              "left_s.",
   .offset = offsetof(cli_talk, progress)},
};
_Static_assert(KG_COUNT_OF(cli_talk_options) == CLI_TALK_OPTION_COUNT, "rows and count");

int cli_read_clip(kg_clip **clip, const char *path, const cli_reading *reading, bool is_quiet)
{
  static const kg_up_axis axes[] = {KG_UP_Y, KG_UP_Y, KG_UP_Z, KG_UP_X}; /* auto y z x */
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = isnan(reading->unit) ? 0.0 : reading->unit;
  def.up_given = reading->up > 0;
  def.up = axes[reading->up];
  def.keep_first_frame = reading->keep_first_frame;
  def.asf_path = reading->asf;
  def.rate_hz = isnan(reading->rate) ? 0.0 : reading->rate;

  kg_error error = {0};
  if (kg_clip_read(clip, path, &def, &error) != KG_OK) {
    return cli_failed(&error);
  }
  const kg_clip_source *source = &(*clip)->source;
  for (int i = 0; i < source->warning_count; i++) {
    cli_warning(is_quiet, "%s", source->warnings[i]);
  }
  return CLI_GOOD;
}

kg_status cli_read_output(kg_clip **clip, const char *path, const kg_clip *capture, kg_error *error)
{
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = capture->source.unit_m;
  def.up_given = true;
  def.up = capture->source.up;
  def.keep_first_frame = capture->source.first_frame == 0;
  return kg_clip_read(clip, path, &def, error);
}

int cli_create_subject(kg_subject **subject, const kg_clip *clip, const cli_reading *reading,
                       const kg_subject_def *around)
{
  kg_subject_def def = around ? *around : kg_subject_default_def();
  def.map_path = reading->map;
  def.floor_given = !isnan(reading->floor);
  def.floor_height = def.floor_given ? reading->floor : 0.0;
  def.mass_kg = reading->mass;
  def.sex = (kg_sex)reading->sex;
  kg_error error = {0};
  if (kg_subject_create(subject, clip, &def, &error) == KG_OK) {
    return CLI_GOOD;
  }
  if (!error.path[0]) {
    snprintf(error.path, sizeof error.path, "%s", clip->source.path);
  }
  return cli_failed(&error);
}

static const char *up_name(kg_up_axis up)
{
  return up == KG_UP_Y ? "y" : up == KG_UP_Z ? "z" : "x";
}

static double degrees(double rad)
{
  return rad * (180.0 / 3.14159265358979323846);
}

static void print_file(FILE *out, const kg_clip *clip, const kg_subject *subject)
{
  const kg_clip_source *source = &clip->source;
  fprintf(out, "%s: %s, %d joints, %d frames at %.6g Hz, %.3f s of motion\n", source->path,
          source->format, clip->joint_count, clip->frame_count, 1.0 / clip->frame_time,
          (subject->frame_count - 1) * clip->frame_time);
  if (source->skeleton_path[0]) {
    fprintf(out, "  skeleton     %s\n", source->skeleton_path);
  }
  if (strcmp(source->format, "AMC") == 0 && !source->rate_given) {
    fprintf(out, "  rate         120 Hz is assumed: AMC states none (--rate)\n");
  }
  fprintf(out, "  unit         %.9g m%s%s\n", source->unit_m,
          source->unit_given ? ", given" : ", estimated: ",
          source->unit_given ? "" : source->unit_reason);
  fprintf(out, "  up axis      %s, %s\n", up_name(source->up),
          source->up_given ? "given" : "estimated");
  fprintf(out, "  first frame  %s%s%s\n",
          source->first_frame ? "an inserted T-pose, left out" : "motion",
          source->first_frame_reason[0] ? ": " : "", source->first_frame_reason);
}

static void print_floor(FILE *out, const kg_subject *subject)
{
  const kg_floor *floor = &subject->floor;
  if (floor->given) {
    fprintf(out, "  floor        height %.4f m, given, level\n", floor->height);
  } else {
    fprintf(out,
            "  floor        height %.4f m, tilt %.2f deg, from %d standing foot-frames "
            "(spread %.1f mm)\n",
            floor->height, degrees(floor->tilt), floor->stance_frames, 1e3 * floor->spread);
  }
  for (int side = 0; side < 2; side++) {
    fprintf(out, "  %s   ankle %.1f mm and toe joint %.1f mm above the sole\n",
            side == 0 ? "left sole " : "right sole", 1e3 * floor->feet[side].ankle_height,
            1e3 * floor->feet[side].toe_height);
  }
}

void cli_print_source(FILE *out, const kg_clip *clip, const kg_subject *subject)
{
  print_file(out, clip, subject);
  print_floor(out, subject);
  fprintf(out, "  body         %d segments, %.2f kg, stature %.2f m\n",
          subject->body->segment_count, subject->body->mass, subject->body->stature);
}

static json_t *clip_object(const kg_clip *clip, const kg_subject *subject)
{
  const kg_clip_source *source = &clip->source;
  json_t *object = json_object();
  cli_json_set_text(object, "path", source->path);
  cli_json_set_text(object, "format", source->format);
  cli_json_set_text(object, "skeleton_path", source->skeleton_path);
  cli_json_set_integer(object, "joint_count", clip->joint_count);
  cli_json_set_integer(object, "frame_count", clip->frame_count);
  cli_json_set_integer(object, "declared_frames", source->declared_frames);
  cli_json_set_integer(object, "first_motion_frame", subject->first_frame);
  cli_json_set_text(object, "first_frame_reason", source->first_frame_reason);
  cli_json_set_number(object, "frame_time_s", clip->frame_time);
  cli_json_set_number(object, "rate_hz", 1.0 / clip->frame_time);
  cli_json_set_bool(object, "rate_given", source->rate_given);
  cli_json_set_number(object, "duration_s", (subject->frame_count - 1) * clip->frame_time);
  cli_json_set_number(object, "unit_m", source->unit_m);
  cli_json_set_bool(object, "unit_given", source->unit_given);
  cli_json_set_text(object, "unit_reason", source->unit_reason);
  cli_json_set_text(object, "up_axis", up_name(source->up));
  cli_json_set_bool(object, "up_given", source->up_given);
  json_t *warnings = json_array();
  for (int i = 0; i < source->warning_count; i++) {
    json_array_append_new(warnings, cli_json_text(source->warnings[i]));
  }
  json_object_set_new(object, "warnings", warnings);
  return object;
}

static json_t *foot_object(const kg_foot_fit *foot)
{
  json_t *object = json_object();
  cli_json_set_number(object, "ankle_height_m", foot->ankle_height);
  cli_json_set_number(object, "toe_height_m", foot->toe_height);
  return object;
}

static json_t *floor_object(const kg_floor *floor)
{
  json_t *object = json_object();
  cli_json_set_number(object, "height_m", floor->height);
  json_object_set_new(object, "normal", cli_json_vec3(floor->normal));
  cli_json_set_number(object, "tilt_rad", floor->tilt);
  cli_json_set_bool(object, "given", floor->given);
  cli_json_set_integer(object, "stance_foot_frames", floor->stance_frames);
  cli_json_set_number(object, "spread_m", floor->spread);
  json_object_set_new(object, "left_sole", foot_object(&floor->feet[0]));
  json_object_set_new(object, "right_sole", foot_object(&floor->feet[1]));
  return object;
}

static json_t *body_object(const kg_body *body)
{
  json_t *object = json_object();
  cli_json_set_integer(object, "segment_count", body->segment_count);
  cli_json_set_number(object, "mass_kg", body->mass);
  cli_json_set_number(object, "stature_m", body->stature);
  cli_json_set_integer(object, "surface_point_count", body->point_count);
  return object;
}

static json_t *mapping_object(const kg_clip *clip, const kg_mapping *mapping)
{
  json_t *object = json_object();
  cli_json_set_text(object, "source", mapping->source);
  for (int role = 0; role < KG_ROLE_COUNT; role++) {
    const int joint = mapping->joint_of_role[role];
    json_t *name = joint < 0 ? json_null() : cli_json_text(clip->joints[joint].name);
    json_object_set_new(object, kg_role_name((kg_role)role), name);
  }
  return object;
}

void cli_report_source(json_t *root, const kg_clip *clip, const kg_subject *subject)
{
  json_object_set_new(root, "clip", clip_object(clip, subject));
  json_object_set_new(root, "floor", floor_object(&subject->floor));
  json_object_set_new(root, "body", body_object(subject->body));
  json_object_set_new(root, "mapping", mapping_object(clip, &subject->mapping));
}
