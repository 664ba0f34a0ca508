/* The scene of a subject at a time: places that move on, and the segments of another athlete. */
#include "kinegrad/stage.h"

#include "kinegrad/arena.h"
#include "kinegrad/dynamics.h"
#include "pipeline/pipeline.h"

static const double FREE_WAY_M = 1.0;

/* A pose of the other body. */
typedef struct pose {
  kg_vec3 *p;
  kg_mat3 *R;
} pose;

struct kg_stage {
  const kg_subject *subject;
  const kg_subject *other; /* NULL: none                                */
  kg_scene scene;
  kg_scene start;  /* without the other athlete, at time 0      */
  bool is_moving;  /* some place of `start` has a velocity      */
  int *place_of;   /* (segments of the other) number or 0       */
  int shape_count; /* with the other                            */
  kg_dynamics *dynamics;
  double *q;
  pose before, now, after;
  kg_arena arena;
};

static kg_sdf_shape as_scene_shape(const kg_body_shape *shape, int place)
{
  static const kg_shape_kind kinds[] = {KG_SHAPE_CAPSULE, KG_SHAPE_ELLIPSOID, KG_SHAPE_BOX};
  return (kg_sdf_shape){.kind = kinds[shape->kind],
                        .a = shape->a,
                        .b = shape->b,
                        .radius = shape->radius,
                        .orientation = shape->orientation,
                        .place = place};
}

static int count_places(const kg_body *body)
{
  int count = 0;
  for (int i = 0; i < body->segment_count; i++) {
    bool has = false;
    for (int k = 0; k < body->shape_count; k++) {
      has = has || body->shapes[k].segment == i;
    }
    count += has;
  }
  return count;
}

bool kg_stage_has_room(const kg_scene *scene, const kg_body *body)
{
  return scene->shape_count + body->shape_count <= KG_SCENE_MAX_SHAPES &&
         scene->place_count + count_places(body) <= KG_SCENE_MAX_PLACES;
}

/* one place for every segment that has shapes */
static void add_other(kg_stage *s)
{
  const kg_body *body = s->other->body;
  for (int k = 0; k < body->shape_count; k++) {
    int *place = &s->place_of[body->shapes[k].segment];
    if (*place == 0) {
      const kg_place at_rest = {.turn = {1.0, 0.0, 0.0, 0.0}};
      *place = kg_scene_add_place(&s->scene, &at_rest);
    }
    const kg_sdf_shape shape = as_scene_shape(&body->shapes[k], *place);
    const bool added = *place > 0 && kg_scene_add(&s->scene, &shape);
    KG_ASSERT(added);
    (void)added;
  }
}

static pose make_pose(int segments, kg_arena *arena)
{
  return (pose){KG_ARENA_ARRAY(arena, kg_vec3, segments), KG_ARENA_ARRAY(arena, kg_mat3, segments)};
}

static kg_status create_other(kg_stage *s, kg_arena *arena)
{
  const kg_body *body = s->other->body;
  KG_ASSERT(kg_stage_has_room(&s->scene, body));
  s->place_of = KG_ARENA_ARRAY(arena, int, body->segment_count);
  s->q = KG_ARENA_ARRAY(arena, double, body->nq);
  s->before = make_pose(body->segment_count, arena);
  s->now = make_pose(body->segment_count, arena);
  s->after = make_pose(body->segment_count, arena);
  if (kg_arena_failed(arena)) return KG_ERR_NO_MEMORY;
  add_other(s);
  return kg_dynamics_create(&s->dynamics, body, arena->allocator);
}

kg_status kg_stage_create(kg_stage **stage, const kg_subject *subject, kg_stage_part part,
                          const kg_allocator *allocator)
{
  KG_ASSERT(stage && subject);
  *stage = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_stage *s = KG_ARENA_ARRAY(&arena, kg_stage, 1);
  if (!s) return KG_ERR_NO_MEMORY;
  s->subject = subject;
  s->other = part == KG_STAGE_SCENE_ONLY ? NULL : subject->other;
  if (part != KG_STAGE_OTHER_ONLY) s->scene = subject->scene;
  s->start = s->scene;
  for (int k = 0; k < s->start.place_count; k++) {
    s->is_moving = s->is_moving || kg_place_is_moving(&s->start.places[k]);
  }
  const kg_status status = s->other ? create_other(s, &arena) : KG_OK;
  if (status != KG_OK) {
    kg_arena_release(&arena);
    return status;
  }
  s->shape_count = s->scene.shape_count;
  s->arena = arena;
  kg_stage_set(s, 0.0, kg_vec3_make(subject->q[0], subject->q[1], subject->q[2]));
  *stage = s;
  return KG_OK;
}

void kg_stage_destroy(kg_stage *stage)
{
  if (stage) {
    kg_dynamics_destroy(stage->dynamics);
    kg_arena arena = stage->arena; /* the stage lives in its own arena */
    kg_arena_release(&arena);
  }
}

static void move_places(kg_stage *s, double time)
{
  for (int k = 0; k < s->start.place_count; k++) {
    const kg_place *p = &s->start.places[k];
    const kg_vec3 at = kg_vec3_add_scaled(p->at, time, p->velocity);
    const kg_quat on = kg_quat_exp(kg_vec3_scale(time, p->spin));
    kg_scene_move(&s->scene, k + 1, at, kg_quat_mul(on, kg_quat_normalized(p->turn)), p->velocity,
                  p->spin);
  }
}

/* the other body at its frame x, not whole */
static void pose_other(kg_stage *s, double x, const pose *out)
{
  const kg_subject *other = s->other;
  kg_states_at(other->body, s->q, other->q, other->frame_count, x);
  kg_dynamics_pose(s->dynamics, s->q, out->p, out->R);
}

static bool is_within_reach(const kg_stage *s, kg_vec3 near)
{
  const double most = s->subject->body->stature + s->other->body->stature + FREE_WAY_M;
  return kg_vec3_norm(kg_vec3_sub(s->now.p[0], near)) <= most;
}

/* Poses, and velocities from half a frame before to half a frame after, as far as there are frames. */
static void move_other(kg_stage *s, double x)
{
  const int last = s->other->frame_count - 1;
  const double from = fmax(x - 0.5, 0.0), to = fmin(x + 0.5, last);
  const double rate = to > from ? 1.0 / ((to - from) * s->other->dt) : 0.0;
  pose_other(s, from, &s->before);
  pose_other(s, to, &s->after);
  for (int i = 0; i < s->other->body->segment_count; i++) {
    if (s->place_of[i] == 0) continue;
    const kg_vec3 way = kg_vec3_sub(s->after.p[i], s->before.p[i]);
    const kg_mat3 turned = kg_mat3_mul(s->after.R[i], kg_mat3_transposed(s->before.R[i]));
    const kg_vec3 spin = kg_quat_log(kg_quat_from_matrix(turned));
    kg_scene_move(&s->scene, s->place_of[i], s->now.p[i], kg_quat_from_matrix(s->now.R[i]),
                  kg_vec3_scale(rate, way), kg_vec3_scale(rate, spin));
  }
}

void kg_stage_set(kg_stage *stage, double time, kg_vec3 near)
{
  kg_stage *s = stage;
  if (s->is_moving) move_places(s, time);
  if (!s->other) return;
  const double x = time / s->other->dt, last = s->other->frame_count - 1;
  bool is_there = x >= -1e-6 && x <= last + 1e-6;
  if (is_there) {
    pose_other(s, fmin(fmax(x, 0.0), last), &s->now);
    is_there = is_within_reach(s, near);
  }
  s->scene.shape_count = is_there ? s->shape_count : s->start.shape_count;
  if (is_there) move_other(s, fmin(fmax(x, 0.0), last));
}

const kg_scene *kg_stage_scene(const kg_stage *stage)
{
  return &stage->scene;
}

int kg_stage_other_segment(const kg_stage *stage, int i)
{
  const int k =
    i - stage->start.shape_count; /* they stand behind the others, in the body's order */
  if (!stage->other || k < 0 || i >= stage->shape_count) return -1;
  return stage->other->body->shapes[k].segment;
}
