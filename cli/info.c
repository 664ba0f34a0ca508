/* kinegrad info: what is in a clip and what was decided about it. Nothing is changed. */
#include <stdlib.h>

#include "cli/commands.h"
#include "cli/json.h"
#include "cli/messages.h"
#include "cli/ranges.h"
#include "cli/reading.h"
#include "kinegrad/arena.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/metrics.h"

typedef struct info_values {
  cli_reading reading;
  cli_talk talk;
  bool joints;
  const char *mjcf;
  const char *json;
} info_values;

/* Frames in which a foot's lowest sole node is within KG_METRIC_SLIP_HEIGHT_M of the scene. */
typedef struct contacts {
  bool *foot[2]; /* (T) */
  int frames[2]; /* how many are true */
} contacts;

static double lowest_node(const kg_subject *subject, int side, const kg_vec3 *p, const kg_mat3 *R)
{
  double lowest = HUGE_VAL;
  for (int i = 0; i < KG_SOLE_NODE_COUNT; i++) {
    const kg_body_point *point = &subject->body->points[side * KG_SOLE_NODE_COUNT + i];
    const kg_vec3 x = kg_vec3_add(p[point->segment], kg_mat3_mul_vec(R[point->segment], point->p));
    lowest = fmin(lowest, kg_scene_distance(&subject->scene, x).distance);
  }
  return lowest;
}

static kg_status find_contacts(contacts *c, kg_arena *arena, const kg_subject *subject)
{
  const int T = subject->frame_count, n = subject->body->segment_count;
  *c = (contacts){{KG_ARENA_ARRAY(arena, bool, T), KG_ARENA_ARRAY(arena, bool, T)}, {0, 0}};
  kg_vec3 *p = KG_ARENA_ARRAY(arena, kg_vec3, n);
  kg_mat3 *R = KG_ARENA_ARRAY(arena, kg_mat3, n);
  kg_dynamics *dynamics = NULL;
  if (kg_arena_failed(arena) || kg_dynamics_create(&dynamics, subject->body, NULL) != KG_OK) {
    return KG_ERR_NO_MEMORY;
  }
  for (int t = 0; t < T && subject->body->sole_node_count > 0; t++) {
    kg_dynamics_pose(dynamics, subject->q + (size_t)t * (size_t)subject->body->nq, p, R);
    for (int side = 0; side < 2; side++) {
      c->foot[side][t] = lowest_node(subject, side, p, R) <= KG_METRIC_SLIP_HEIGHT_M;
      c->frames[side] += c->foot[side][t];
    }
  }
  kg_dynamics_destroy(dynamics);
  return KG_OK;
}

static void print_contacts(FILE *out, const kg_subject *subject, const contacts *c)
{
  for (int side = 0; side < 2; side++) {
    fprintf(out,
            "  %s  on the ground in %.0f %% of frames: ", side == 0 ? "left foot " : "right foot",
            100.0 * c->frames[side] / subject->frame_count);
    cli_print_ranges(out, c->foot[side], subject->frame_count, subject->first_frame, 8);
    fputc('\n', out);
  }
}

static void print_mapping(FILE *out, const kg_clip *clip, const kg_mapping *mapping)
{
  fprintf(out, "  mapping      %s\n", mapping->source);
  for (int role = 0; role < KG_ROLE_COUNT; role++) {
    const int joint = mapping->joint_of_role[role];
    fprintf(out, "    %-12s %s\n", kg_role_name((kg_role)role),
            joint < 0 ? "-" : clip->joints[joint].name);
  }
}

static json_t *contacts_object(const kg_subject *subject, const contacts *c)
{
  json_t *object = json_object();
  cli_json_set_number(object, "height_m", KG_METRIC_SLIP_HEIGHT_M);
  for (int side = 0; side < 2; side++) {
    json_t *foot = json_object();
    cli_json_set_number(foot, "share", (double)c->frames[side] / subject->frame_count);
    json_object_set_new(foot, "frames",
                        cli_json_ranges(c->foot[side], subject->frame_count, subject->first_frame));
    json_object_set_new(object, side == 0 ? "left_foot" : "right_foot", foot);
  }
  return object;
}

static json_t *joints_object(const kg_clip *clip)
{
  json_t *object = json_object(), *names = json_array(), *parents = json_array();
  json_t *offsets = json_array();
  for (int j = 0; j < clip->joint_count; j++) {
    json_array_append_new(names, cli_json_text(clip->joints[j].name));
    json_array_append_new(parents, json_integer(clip->joints[j].parent));
    json_array_append_new(offsets, cli_json_vec3(clip->joints[j].offset));
  }
  json_object_set_new(object, "name", names);
  json_object_set_new(object, "parent", parents);
  json_object_set_new(object, "offset_m", offsets);
  return object;
}

static json_t *segments_object(const kg_body *body)
{
  json_t *object = json_object(), *names = json_array(), *parents = json_array();
  json_t *masses = json_array(), *coms = json_array(), *inertias = json_array();
  for (int i = 0; i < body->segment_count; i++) {
    const kg_segment *segment = &body->segments[i];
    json_array_append_new(names, cli_json_text(segment->name));
    json_array_append_new(parents, json_integer(segment->parent));
    json_array_append_new(masses, cli_json_number(segment->mass));
    json_array_append_new(coms, cli_json_vec3(segment->com));
    json_array_append_new(inertias, cli_json_numbers(segment->inertia, 6));
  }
  json_object_set_new(object, "name", names);
  json_object_set_new(object, "parent", parents);
  json_object_set_new(object, "mass_kg", masses);
  json_object_set_new(object, "com_m", coms);
  json_object_set_new(object, "inertia_xx_yy_zz_xy_xz_yz_kg_m2", inertias);
  return object;
}

static json_t *report(const kg_clip *clip, const kg_subject *subject, const contacts *c)
{
  json_t *root = cli_json_report("info");
  cli_report_source(root, clip, subject);
  json_object_set_new(root, "contacts", contacts_object(subject, c));
  json_object_set_new(root, "joints", joints_object(clip));
  json_object_set_new(root, "segments", segments_object(subject->body));
  return root;
}

/* The hierarchy needs no mapping: this is how one finds the names for --map. */
static int list_joints(const kg_clip *clip, FILE *out)
{
  for (int j = 0; j < clip->joint_count; j++) {
    int depth = 0;
    for (int k = clip->joints[j].parent; k >= 0; k = clip->joints[k].parent) {
      depth++;
    }
    fprintf(out, "%*s%s\n", 2 * depth, "", clip->joints[j].name);
  }
  return CLI_GOOD;
}

static int write_results(const info_values *values, const kg_clip *clip, const kg_subject *subject,
                         const contacts *c, FILE *out)
{
  const char *const inputs[] = {clip->source.path, clip->source.skeleton_path, values->reading.map};
  const int input_count = (int)KG_COUNT_OF(inputs);
  if (cli_is_input("--json", values->json, inputs, input_count) ||
      cli_is_input("--mjcf", values->mjcf, inputs, input_count)) {
    return CLI_USAGE;
  }
  cli_output *json = NULL, *mjcf = NULL;
  if (!cli_json_open(&json, values->json) ||
      (values->mjcf && !(mjcf = cli_outputs_open(values->mjcf)))) {
    return CLI_OUTPUT;
  }
  if (mjcf) {
    kg_error error = {0};
    if (kg_body_write_mjcf(subject->body, &subject->scene, mjcf->temporary, 9.8, &error) != KG_OK) {
      return cli_failed(&error);
    }
  }
  bool is_written = true;
  if (values->json) {
    json_t *root = report(clip, subject, c);
    is_written = cli_json_write(root, json, out);
    json_decref(root);
  }
  if (!is_written) {
    return CLI_OUTPUT;
  }
  if (!cli_json_is_stdout(values->json)) {
    cli_print_source(out, clip, subject);
    print_contacts(out, subject, c);
    print_mapping(out, clip, &subject->mapping);
  }
  return CLI_GOOD;
}

static int describe(const info_values *values, const kg_clip *clip, FILE *out)
{
  kg_subject *subject = NULL;
  int code = cli_create_subject(&subject, clip, &values->reading, NULL);
  if (code != CLI_GOOD) {
    return code;
  }
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  contacts c;
  const kg_status status = find_contacts(&c, &arena, subject);
  code = status == KG_OK ? write_results(values, clip, subject, &c, out)
                         : cli_failed_status(status, clip->source.path);
  kg_arena_release(&arena);
  kg_subject_destroy(subject);
  return code;
}

static int run(const void *values_given, const cli_operands *operands, FILE *out)
{
  const info_values *values = values_given;
  kg_clip *clip = NULL;
  int code = cli_read_clip(&clip, operands->at[0], &values->reading, values->talk.quiet);
  if (code == CLI_GOOD) {
    code = values->joints ? list_joints(clip, out) : describe(values, clip, out);
  }
  kg_clip_destroy(clip);
  return code;
}

static const cli_option result_options[] = {
  {.name = "json",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "everything as one JSON object; - for stdout, in place of the text",
   .details = "SI units in the names of the keys: 'kinegrad help json'.",
   .offset = offsetof(info_values, json)},
  {.name = "mjcf",
   .kind = CLI_PATH,
   .value_name = "FILE",
   .summary = "the body as a MuJoCo model",
   .details = "Free root, ball joints, explicit inertias, ground plane, gravity 9.8 m/s^2.",
   .offset = offsetof(info_values, mjcf)},
  {.name = "joints",
   .kind = CLI_FLAG,
   .summary = "only list the joints, indented by depth",
   .details = "Needs no mapping, so it also works for a skeleton that is not recognised.",
   .offset = offsetof(info_values, joints)},
};

static const cli_group groups[] = {
  {"Results", result_options, KG_COUNT_OF(result_options), 0},
  {"Reading the clip", cli_reading_options, CLI_READING_OPTION_COUNT,
   offsetof(info_values, reading)},
  {"General", cli_talk_options, CLI_QUIET_ONLY, offsetof(info_values, talk)},
};

static const info_values defaults = {.reading = CLI_READING_DEFAULTS};

const cli_command cli_command_info = {
  .name = "info",
  .summary = "what is in a clip: joints, rate, length, units, floor, contacts, mass",
  .usage = "CLIP [options]",
  .details =
    "Reads a clip (BVH, or AMC with its ASF skeleton) and prints what was found in it and what was "
    "decided about it, and why: unit, up axis, inserted T-pose, floor height and tilt, how the "
    "feet "
    "stand, which joint plays which role, the body's mass and stature, and when each foot is on "
    "the ground. Every decision can be overridden; 'kinegrad correct' takes the same options.",
  .examples = (const char *const[]){"kinegrad info walk.bvh",
                                    "kinegrad info walk.bvh --unit 0.056444444 --json -",
                                    "kinegrad info walk.bvh --mjcf body.xml", NULL},
  .groups = groups,
  .group_count = KG_COUNT_OF(groups),
  .operand_count = 1,
  .operands_text = "one clip",
  .defaults = &defaults,
  .values_size = sizeof(info_values),
  .run = run,
};
