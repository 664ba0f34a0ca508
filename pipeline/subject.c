/* From clip to subject: mapping, floor and feet, body, scene, states. */
#include "kinegrad/stage.h"
#include "pipeline/pipeline.h"

#include <string.h>

kg_subject_def kg_subject_default_def(void)
{
  return (kg_subject_def){.mass_kg = 70.0, .sex = KG_SEX_MEAN};
}

/* The shapes of `extra` behind the plane, with its places and grounds: only numbers of children
 * shift. The cover of the plane comes last. */
static kg_status build_scene(kg_subject *subject, const kg_subject_def *def, kg_error *error)
{
  kg_scene *scene = &subject->scene;
  *scene = kg_scene_ground(subject->floor.height, subject->floor.normal);
  const kg_scene *extra = def->extra;
  if (extra) {
    scene->place_count = extra->place_count;
    scene->ground_count = extra->ground_count;
    memcpy(scene->places, extra->places, sizeof scene->places);
    memcpy(scene->grounds, extra->grounds, sizeof scene->grounds);
  }
  for (int i = 0; extra && i < extra->shape_count; i++) {
    kg_sdf_shape shape = extra->shapes[i];
    shape.children[0]++;
    shape.children[1]++;
    if (!kg_scene_add(scene, &shape)) {
      return kg_fail(error, KG_ERR_UNSUPPORTED, NULL, 0, 0, "the scene has more than %d shapes",
                     KG_SCENE_MAX_SHAPES);
    }
  }
  if (def->ground && !(scene->shapes[0].ground = kg_scene_add_ground(scene, def->ground))) {
    return kg_fail(error, KG_ERR_UNSUPPORTED, NULL, 0, 0, "the scene has more than %d soft layers",
                   KG_SCENE_MAX_GROUNDS);
  }
  if (def->ground) { /* the soles stood on the layer: the core is below */
    kg_sdf_shape *plane = &scene->shapes[0];
    plane->a = kg_vec3_add_scaled(plane->a, -def->ground->thickness, plane->b);
  }
  if (def->other && !kg_stage_has_room(scene, def->other->body)) {
    return kg_fail(error, KG_ERR_UNSUPPORTED, NULL, 0, 0,
                   "the scene has no room for the %d shapes of the other athlete",
                   def->other->body->shape_count);
  }
  subject->other = def->other;
  subject->self = def->self;
  return KG_OK;
}

kg_sdf_value kg_soft_distance(const kg_scene *scene, kg_vec3 x)
{
  if (scene->ground_count == 0) return kg_scene_distance(scene, x);
  kg_sdf_value best = {INFINITY, {0.0, 1.0, 0.0}, {0.0}};
  for (int i = 0; i < scene->shape_count && !isnan(best.distance); i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    const double soft = shape->ground > 0 ? scene->grounds[shape->ground - 1].thickness : 0.0;
    kg_sdf_value value;
    if (shape->part || !kg_scene_shape_distance(scene, i, x, best.distance + soft, &value))
      continue;
    value.distance -= soft;
    if (!(value.distance >= best.distance)) best = value; /* NaN is not far away */
  }
  return best;
}

double kg_rest_height(const kg_subject *subject, const kg_track_params *params,
                      const kg_contact_params *contact, double gravity)
{
  const int number = subject->scene.shapes[0].ground;
  if (number == 0) return params->rest_height;
  const kg_ground *ground = &subject->scene.grounds[number - 1];
  const double load = subject->body->mass * gravity / (2 * KG_SOLE_NODE_COUNT);
  const double sunk = 0.5 * contact->layer + load / fmax(ground->stiffness, 1.0);
  /* through a layer this soft the core carries, as on hard ground */
  return fmax(contact->layer - sunk, params->rest_height - ground->thickness);
}

static kg_status build_body(kg_subject *subject, const kg_clip *clip, const kg_subject_def *def,
                            kg_error *error)
{
  kg_body_def body_def = kg_body_default_def();
  body_def.mass_kg = def->mass_kg;
  body_def.sex = def->sex;
  body_def.has_feet = true;
  body_def.feet[0] = subject->floor.feet[0];
  body_def.feet[1] = subject->floor.feet[1];
  body_def.allocator = def->allocator;
  return kg_body_from_clip(&subject->body, clip, &subject->mapping, &body_def, error);
}

static void read_states(const kg_body *body, const kg_clip *clip, int first, int count, double *q)
{
  for (int t = 0; t < count; t++) {
    double *q_t = q + (size_t)t * (size_t)body->nq;
    kg_body_state_from_clip(body, clip, first + t, q_t, t > 0 ? q_t - body->nq : NULL);
  }
}

static kg_status no_memory(kg_error *error)
{
  return kg_fail(error, KG_ERR_NO_MEMORY, NULL, 0, 0, "out of memory");
}

kg_status kg_subject_create(kg_subject **subject, const kg_clip *clip, const kg_subject_def *def,
                            kg_error *error)
{
  KG_ASSERT(subject && clip && def);
  *subject = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_subject *s = KG_ARENA_ARRAY(&arena, kg_subject, 1);
  kg_arena *owned = KG_ARENA_ARRAY(&arena, kg_arena, 1);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return no_memory(error);
  }
  s->allocator = def->allocator;
  s->joint_count = clip->joint_count;
  s->first_frame = clip->source.first_frame;
  s->frame_count = clip->frame_count - s->first_frame;
  s->dt = clip->frame_time;
  s->floor = (kg_floor){.given = def->floor_given, .height = def->floor_height};

  kg_status status = KG_OK;
  if (s->frame_count < 1) {
    status = kg_fail(error, KG_ERR_FORMAT, clip->source.path, 0, 0,
                     "no motion frame beside the inserted first frame");
  }
  if (status == KG_OK) status = kg_mapping_find(&s->mapping, clip, def->map_path, error);
  if (status == KG_OK && kg_floor_estimate(&s->floor, clip, &s->mapping) != KG_OK) {
    status = no_memory(error);
  }
  if (status == KG_OK) status = build_scene(s, def, error);
  if (status == KG_OK) status = build_body(s, clip, def, error);
  if (status == KG_OK) {
    s->q = KG_ARENA_ARRAY(&arena, double, (size_t)s->frame_count *(size_t)s->body->nq);
    if (s->q) {
      read_states(s->body, clip, s->first_frame, s->frame_count, s->q);
    } else {
      status = no_memory(error);
    }
  }

  *owned = arena;
  s->memory = owned;
  if (status != KG_OK) {
    kg_subject_destroy(s);
    return status;
  }
  *subject = s;
  return KG_OK;
}

void kg_subject_destroy(kg_subject *subject)
{
  if (subject) {
    kg_body_destroy(subject->body);
    kg_arena arena = *(kg_arena *)subject->memory; /* the arena holds the subject and itself */
    kg_arena_release(&arena);
  }
}

kg_status kg_subject_states(const kg_subject *subject, const kg_clip *clip, double *q,
                            kg_error *error)
{
  const int frames = subject->first_frame + subject->frame_count;
  if (clip->frame_count != frames) {
    return kg_fail(error, KG_ERR_FORMAT, clip->source.path, 0, 0,
                   "%d frames, expected the capture's %d", clip->frame_count, frames);
  }
  if (clip->joint_count != subject->joint_count) {
    return kg_fail(error, KG_ERR_FORMAT, clip->source.path, 0, 0,
                   "%d joints, expected the capture's %d", clip->joint_count, subject->joint_count);
  }
  read_states(subject->body, clip, subject->first_frame, subject->frame_count, q);
  return KG_OK;
}
