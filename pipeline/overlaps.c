/* Overlaps of a capture: which parts of the body are in each other, or in another athlete, and when.
 *
 * What is led out together is a group. Against the own body: shin, foot and toes, forearm and hand, and
 * every other segment by itself, each pair of groups for itself. Against another athlete: an arm, a leg,
 * and all that is neither, out of all limbs that it is in, for an arm between the other's arm and trunk must
 * not be led out of each into the other. In each frame the points that are deepest, one of each two
 * segments, tell how far out it is along each direction, and ways.c chooses. Directions stand in the axes
 * of the joint that both groups hang from, against another athlete in those of the world. */
#include "pipeline/overlaps.h"

#include "kinegrad/arena.h"
#include "physics/physics.h"
#include "pipeline/ways.h"

#include <string.h>

static const double LEAST_ALONG = 0.5; /* cosine between the nearest way out and that of the pair */

/* A point in another segment, of the own body or of the other's. */
typedef struct overlap {
  int pair, segment, other;
  kg_vec3 x;
  double distance;
} overlap;

struct kg_overlaps {
  const kg_subject *subject;
  const kg_body *body;
  kg_self *self;
  kg_stage *stage;
  kg_dynamics *dynamics;
  kg_ways *ways; /* by pair: own groups, then own and the other's */
  kg_vec3 *p;
  kg_mat3 *R;
  kg_self_touch *touches; /* (points) */
  overlap *found;         /* (2 points) of a frame */
  int found_count;
  bool *is_asked; /* (segments of the other) by limb_of */
  kg_arena arena;
};

/* ---- groups ------------------------------------------------------------------------------------*/

static int own_group(const kg_body *body, int segment)
{
  static const kg_role upper[KG_ROLE_COUNT] = {
    [KG_ROLE_L_WRIST] = KG_ROLE_L_ELBOW, [KG_ROLE_R_WRIST] = KG_ROLE_R_ELBOW,
    [KG_ROLE_L_ANKLE] = KG_ROLE_L_KNEE,  [KG_ROLE_L_TOE] = KG_ROLE_L_KNEE,
    [KG_ROLE_R_ANKLE] = KG_ROLE_R_KNEE,  [KG_ROLE_R_TOE] = KG_ROLE_R_KNEE};
  const int role = body->segments[segment].role;
  if (role < 0 || upper[role] == KG_ROLE_PELVIS) return segment;
  const int first = body->segment_of_role[upper[role]];
  return first < 0 ? segment : first;
}

/* the first segment of the arm or leg, or the root */
static int limb_of(const kg_body *body, int segment)
{
  for (; segment > 0; segment = body->segments[segment].parent) {
    const int role = body->segments[segment].role;
    if (role == KG_ROLE_L_SHOULDER || role == KG_ROLE_R_SHOULDER || role == KG_ROLE_L_HIP ||
        role == KG_ROLE_R_HIP) {
      break;
    }
  }
  return segment;
}

static int own_pair(const kg_body *body, int segment, int other)
{
  const int a = own_group(body, segment), b = own_group(body, other);
  return a < b ? a * body->segment_count + b : b * body->segment_count + a;
}

/* behind the own pairs */
static int pair_with_other(const kg_overlaps *o, int segment)
{
  return o->body->segment_count * o->body->segment_count + limb_of(o->body, segment);
}

static bool is_own(const kg_overlaps *o, int pair)
{
  return pair < o->body->segment_count * o->body->segment_count;
}

/* A direction of a pair in the world, as the way of the segment. */
static kg_vec3 own_way(const kg_overlaps *o, const kg_mat3 *R, int segment, int other, kg_vec3 way)
{
  const kg_vec3 n = kg_mat3_mul_vec(R[kg_meeting_segment(o->body, segment, other)], way);
  return own_group(o->body, segment) < own_group(o->body, other) ? n : kg_vec3_scale(-1.0, n);
}

/* ---- how far out -------------------------------------------------------------------------------*/

/* of the other's limbs that are asked for */
static kg_sdf_value limbs_phi(kg_vec3 x, void *user)
{
  const kg_overlaps *o = user;
  const kg_scene *scene = kg_stage_scene(o->stage);
  const kg_body *body = o->subject->other->body;
  kg_sdf_value best = {.distance = INFINITY, .normal = {0.0, 1.0, 0.0}};
  for (int i = scene->shape_count - body->shape_count; i < scene->shape_count; i++) {
    if (!o->is_asked[limb_of(body, kg_stage_other_segment(o->stage, i))]) continue;
    (void)kg_scene_shape_distance(scene, i, x, best.distance, &best);
  }
  return best;
}

static kg_sdf_value way_out_of_limbs(kg_overlaps *o, kg_vec3 x, kg_vec3 way)
{
  return kg_sdf_way_out(limbs_phi, o, x, way, 2.0 * o->subject->other->body->stature);
}

static void ask_for_none(kg_overlaps *o)
{
  memset(o->is_asked, 0, (size_t)o->subject->other->body->segment_count * sizeof *o->is_asked);
}

/* No other point of the same segment is deeper in the same one of the other's. */
static bool is_deepest(const kg_overlaps *o, const overlap *f)
{
  for (int k = 0; k < o->found_count; k++) {
    const overlap *g = &o->found[k];
    if (g->pair == f->pair && g->segment == f->segment && g->other == f->other &&
        g->distance < f->distance) {
      return false;
    }
  }
  return true;
}

/* asks for the limbs that the pair is in */
static void ask_for_pair(kg_overlaps *o, int pair)
{
  ask_for_none(o);
  for (int k = 0; k < o->found_count; k++) {
    const overlap *f = &o->found[k];
    if (f->pair == pair) o->is_asked[limb_of(o->subject->other->body, f->other)] = true;
  }
}

static void add_way_out(kg_overlaps *o, const overlap *f, double *out)
{
  const kg_vec3 *directions = kg_ways_directions(o->ways);
  if (!is_own(o, f->pair)) ask_for_pair(o, f->pair);
  for (int d = 0; d < KG_WAY_DIRECTIONS; d++) {
    double distance;
    if (is_own(o, f->pair)) {
      const kg_vec3 way = own_way(o, o->R, f->segment, f->other, directions[d]);
      distance = kg_self_way_out(o->self, o->p, o->R, f->other, f->x, way).distance;
    } else {
      distance = way_out_of_limbs(o, f->x, directions[d]).distance;
    }
    out[d] = fmax(out[d], distance);
  }
}

/* ---- the capture -------------------------------------------------------------------------------*/

static void find_own(kg_overlaps *o)
{
  const int count = kg_self_sample(o->self, o->p, o->R, 0.0, o->touches);
  for (int k = 0; k < count; k++) {
    const kg_self_touch *t = &o->touches[k];
    const int segment = o->body->points[t->point].segment;
    o->found[o->found_count++] = (overlap){.pair = own_pair(o->body, segment, t->segment),
                                           .segment = segment,
                                           .other = t->segment,
                                           .x = t->x,
                                           .distance = t->distance};
  }
}

/* points that are nearest to the other athlete, of all that the scene has */
static void find_with_other(kg_overlaps *o)
{
  const kg_scene *scene = kg_stage_scene(o->stage);
  if (kg_stage_other_segment(o->stage, scene->shape_count - 1) < 0) return; /* not there now */
  for (int k = 0; k < o->body->point_count; k++) {
    const kg_body_point *point = &o->body->points[k];
    const kg_vec3 x =
      kg_vec3_add(o->p[point->segment], kg_mat3_mul_vec(o->R[point->segment], point->p));
    const kg_scene_point near = kg_scene_nearest(scene, x);
    const int other = kg_stage_other_segment(o->stage, near.shape);
    if (other < 0 || !(near.value.distance < 0.0)) continue;
    o->found[o->found_count++] = (overlap){.pair = pair_with_other(o, point->segment),
                                           .segment = point->segment,
                                           .other = other,
                                           .x = x,
                                           .distance = near.value.distance};
  }
}

static bool add_frame(kg_overlaps *o, int t)
{
  const double *q = o->subject->q + (size_t)t * (size_t)o->body->nq;
  kg_dynamics_pose(o->dynamics, q, o->p, o->R);
  kg_stage_set(o->stage, t * o->subject->dt, o->p[0]);
  o->found_count = 0;
  if (o->self) find_own(o);
  if (o->subject->other) find_with_other(o);
  for (int k = 0; k < o->found_count; k++) {
    const int pair = o->found[k].pair;
    double out[KG_WAY_DIRECTIONS] = {0.0};
    bool is_first = true;
    for (int m = 0; m < o->found_count && is_first; m++) {
      if (o->found[m].pair != pair) continue;
      is_first = m >= k;
      if (is_first && is_deepest(o, &o->found[m])) add_way_out(o, &o->found[m], out);
    }
    if (is_first && !kg_ways_add(o->ways, pair, t, out)) return false;
  }
  return true;
}

kg_status kg_overlaps_create(kg_overlaps **overlaps, const kg_subject *subject, kg_self *self,
                             kg_stage *stage, kg_dynamics *dynamics, const kg_allocator *allocator)
{
  *overlaps = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  const kg_body *body = subject->body;
  kg_overlaps *o = KG_ARENA_ARRAY(&arena, kg_overlaps, 1);
  if (!o) return KG_ERR_NO_MEMORY;
  *o = (kg_overlaps){
    .subject = subject, .body = body, .self = self, .stage = stage, .dynamics = dynamics};
  o->p = KG_ARENA_ARRAY(&arena, kg_vec3, body->segment_count);
  o->R = KG_ARENA_ARRAY(&arena, kg_mat3, body->segment_count);
  o->touches = KG_ARENA_ARRAY(&arena, kg_self_touch, body->point_count);
  o->found = KG_ARENA_ARRAY(&arena, overlap, 2 * body->point_count);
  if (subject->other)
    o->is_asked = KG_ARENA_ARRAY(&arena, bool, subject->other->body->segment_count);
  kg_status status = kg_arena_failed(&arena) ? KG_ERR_NO_MEMORY : KG_OK;
  if (status == KG_OK) {
    status = kg_ways_create(&o->ways, subject->frame_count, subject->dt, allocator);
  }
  const bool can_overlap = self || subject->other;
  for (int t = 0; can_overlap && status == KG_OK && t < subject->frame_count; t++) {
    if (!add_frame(o, t)) status = KG_ERR_NO_MEMORY;
  }
  if (status == KG_OK) status = kg_ways_choose(o->ways);
  if (status != KG_OK) {
    kg_ways_destroy(o->ways);
    kg_arena_release(&arena);
    return status;
  }
  o->arena = arena;
  *overlaps = o;
  return KG_OK;
}

void kg_overlaps_destroy(kg_overlaps *overlaps)
{
  if (overlaps) {
    kg_ways_destroy(overlaps->ways);
    kg_arena arena = overlaps->arena; /* it lives in its own arena */
    kg_arena_release(&arena);
  }
}

/* ---- touches -----------------------------------------------------------------------------------*/

bool kg_overlaps_turn_self(const kg_overlaps *overlaps, int frame, const kg_vec3 *p,
                           const kg_mat3 *R, kg_self_touch *touch)
{
  const kg_overlaps *o = overlaps;
  const int segment = o->body->points[touch->point].segment, other = touch->segment;
  kg_vec3 way;
  if (!kg_ways_at(o->ways, own_pair(o->body, segment, other), frame, &way)) return true;
  way = own_way(o, R, segment, other, way);
  if (kg_vec3_dot(way, touch->normal) >= LEAST_ALONG) return true;
  if (touch->distance >= 0.0) return false;
  const kg_sdf_value out = kg_self_way_out(o->self, p, R, other, touch->x, way);
  touch->distance = -out.distance * kg_vec3_dot(way, out.normal);
  touch->normal = out.normal;
  return true;
}

bool kg_overlaps_turn_other(kg_overlaps *overlaps, int frame, int segment, int shape, kg_vec3 x,
                            kg_sdf_value *value)
{
  kg_overlaps *o = overlaps;
  const int other = kg_stage_other_segment(o->stage, shape);
  kg_vec3 way;
  if (!kg_ways_at(o->ways, pair_with_other(o, segment), frame, &way)) return true;
  if (kg_vec3_dot(way, value->normal) >= LEAST_ALONG) return true;
  if (value->distance >= 0.0) return false;
  ask_for_none(o);
  o->is_asked[limb_of(o->subject->other->body, other)] = true;
  const kg_sdf_value out = way_out_of_limbs(o, x, way);
  value->distance = -out.distance * kg_vec3_dot(way, out.normal);
  value->normal = out.normal;
  return true;
}
