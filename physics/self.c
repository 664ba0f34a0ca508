/* A body against itself; the contract is in kinegrad/self.h.
 *
 * A pair of segments is dismissed by the balls around the one's points and the other's shapes, a point
 * by the other's ball: distances grow by no more than the way gone. */
#include "kinegrad/self.h"

#include "kinegrad/arena.h"
#include "kinegrad/sdf.h"
#include "physics/near_points.h"
#include "physics/physics.h"

#include <string.h>

/* The shapes of a segment, and a ball around them in its frame. */
typedef struct solid {
  int first, count; /* in kg_self.shapes */
  kg_vec3 center;
  double radius;
} solid;

typedef struct pair {
  int ball;  /* of near_points: the points' segment */
  int other; /* segment of the shapes               */
} pair;

struct kg_self {
  const kg_body *body;
  near_points near;
  solid *solids; /* (n)                             */
  int *shapes;   /* (shapes) segment by segment     */
  pair *pairs;
  int pair_count;
  bool *is_pair;          /* (n, n)                          */
  int *touch_of;          /* (points) in the answer, or -1   */
  kg_self_touch *touches; /* (points) of kg_self_depth */
  kg_arena arena;
};

/* ---- shapes ------------------------------------------------------------------------------------*/

static kg_sdf_value shape_distance(const kg_body_shape *s, kg_vec3 y)
{
  switch (s->kind) {
    case KG_BODY_CAPSULE:
      return kg_sdf_capsule(s->a, s->b, s->radius, y);
    case KG_BODY_ELLIPSOID:
      return kg_sdf_ellipsoid(s->a, s->orientation, s->b, y);
    case KG_BODY_BOX:
      break;
  }
  return kg_sdf_box(s->a, s->orientation, s->b, y);
}

static kg_vec3 shape_center(const kg_body_shape *s)
{
  return s->kind == KG_BODY_CAPSULE ? kg_vec3_lerp(s->a, s->b, 0.5) : s->a;
}

static double shape_reach(const kg_body_shape *s)
{
  switch (s->kind) {
    case KG_BODY_CAPSULE:
      return 0.5 * kg_vec3_norm(kg_vec3_sub(s->b, s->a)) + s->radius;
    case KG_BODY_ELLIPSOID:
      return fmax(s->b.x, fmax(s->b.y, s->b.z));
    case KG_BODY_BOX:
      break;
  }
  return kg_vec3_norm(s->b);
}

static void collect_solid(kg_self *self, int segment, int *filled)
{
  const kg_body *body = self->body;
  solid *s = &self->solids[segment];
  s->first = *filled;
  for (int k = 0; k < body->shape_count; k++) {
    if (body->shapes[k].segment != segment) continue;
    self->shapes[(*filled)++] = k;
    s->center = kg_vec3_add(s->center, shape_center(&body->shapes[k]));
  }
  s->count = *filled - s->first;
  s->center = kg_vec3_scale(s->count > 0 ? 1.0 / s->count : 0.0, s->center);
  for (int k = s->first; k < *filled; k++) {
    const kg_body_shape *shape = &body->shapes[self->shapes[k]];
    const double way = kg_vec3_norm(kg_vec3_sub(shape_center(shape), s->center));
    s->radius = fmax(s->radius, (way + shape_reach(shape)) * (1.0 + 1e-12));
  }
}

/* Nearest shape of the segment to y in its frame; distance `limit` when none is nearer. */
static kg_sdf_value solid_distance(const kg_self *self, int segment, kg_vec3 y, double limit)
{
  const solid *s = &self->solids[segment];
  kg_sdf_value best = {.distance = limit};
  if (kg_vec3_norm(kg_vec3_sub(y, s->center)) - s->radius >= limit) return best;
  for (int k = s->first; k < s->first + s->count; k++) {
    const kg_sdf_value value = shape_distance(&self->body->shapes[self->shapes[k]], y);
    if (value.distance < best.distance) best = value;
  }
  return best;
}

/* ---- a pose ------------------------------------------------------------------------------------*/

static void sample_pair(kg_self *self, const pair *tried, const kg_vec3 *p, const kg_mat3 *R,
                        double limit, kg_self_touch *touches, int *count)
{
  const segment_ball *ball = &self->near.balls[tried->ball];
  const solid *s = &self->solids[tried->other];
  const int i = ball->segment, j = tried->other;
  const kg_vec3 points_at = kg_vec3_add(p[i], kg_mat3_mul_vec(R[i], ball->center));
  const kg_vec3 shapes_at = kg_vec3_add(p[j], kg_mat3_mul_vec(R[j], s->center));
  const double apart = kg_vec3_norm(kg_vec3_sub(points_at, shapes_at));
  if (apart - ball->radius - s->radius >= limit) return;
  for (int k = ball->first; k < ball->first + ball->count; k++) {
    const int point = self->near.points[k];
    int *touch = &self->touch_of[point];
    const kg_vec3 x = kg_vec3_add(p[i], kg_mat3_mul_vec(R[i], self->body->points[point].p));
    const kg_vec3 y = kg_mat3_mul_vec_t(R[j], kg_vec3_sub(x, p[j]));
    const double bound = *touch < 0 ? limit : touches[*touch].distance;
    const kg_sdf_value value = solid_distance(self, j, y, bound);
    if (!(value.distance < bound)) continue;
    if (*touch < 0) *touch = (*count)++;
    touches[*touch] = (kg_self_touch){.point = point,
                                      .segment = j,
                                      .x = x,
                                      .distance = value.distance,
                                      .normal = kg_mat3_mul_vec(R[j], value.normal)};
  }
}

int kg_self_sample(kg_self *self, const kg_vec3 *p, const kg_mat3 *R, double limit,
                   kg_self_touch *touches)
{
  KG_ASSERT(self && p && R && touches);
  int count = 0;
  for (int k = 0; k < self->body->point_count; k++) {
    self->touch_of[k] = -1;
  }
  for (int k = 0; k < self->pair_count; k++) {
    sample_pair(self, &self->pairs[k], p, R, limit, touches, &count);
  }
  return count;
}

typedef struct solid_field {
  const kg_self *self;
  int segment;
} solid_field;

static kg_sdf_value solid_phi(kg_vec3 y, void *user)
{
  const solid_field *f = user;
  return solid_distance(f->self, f->segment, y, INFINITY);
}

kg_sdf_value kg_self_way_out(const kg_self *self, const kg_vec3 *p, const kg_mat3 *R, int segment,
                             kg_vec3 x, kg_vec3 way)
{
  const kg_vec3 y = kg_mat3_mul_vec_t(R[segment], kg_vec3_sub(x, p[segment]));
  const solid *s = &self->solids[segment];
  solid_field field = {self, segment};
  kg_sdf_value out = kg_sdf_way_out(solid_phi, &field, y, kg_mat3_mul_vec_t(R[segment], way),
                                    kg_vec3_norm(kg_vec3_sub(y, s->center)) + s->radius);
  out.normal = kg_mat3_mul_vec(R[segment], out.normal);
  return out;
}

double kg_self_depth(kg_self *self, const kg_vec3 *p, const kg_mat3 *R, kg_self_touch *deepest)
{
  double depth = 0.0;
  const int count = kg_self_sample(self, p, R, 0.0, self->touches);
  for (int k = 0; k < count; k++) {
    if (!(-self->touches[k].distance > depth)) continue;
    depth = -self->touches[k].distance;
    if (deepest) *deepest = self->touches[k];
  }
  return depth;
}

/* ---- pairs -------------------------------------------------------------------------------------*/

/* joints along the tree from one segment to another */
static int joints_between(const kg_body *body, int a, int b)
{
  const int end = kg_meeting_segment(body, a, b);
  return kg_joints_above(body, a, end) + kg_joints_above(body, b, end);
}

static void pose_at(const kg_body *body, const double *q, kg_vec3 *p, kg_mat3 *R)
{
  for (int i = 0; i < body->segment_count; i++) {
    const double *r = q ? q + 3 + 4 * i : NULL;
    const kg_mat3 turn =
      r ? kg_quat_matrix(kg_quat_make(r[0], r[1], r[2], r[3])) : kg_mat3_identity();
    const int parent = body->segments[i].parent;
    p[i] = kg_vec3_make(0.0, 0.0, 0.0);
    R[i] = turn;
    if (parent < 0) continue;
    p[i] = kg_vec3_add(p[parent], kg_mat3_mul_vec(R[parent], body->segments[i].offset));
    R[i] = kg_mat3_mul(R[parent], turn);
  }
}

static void list_pairs(kg_self *self)
{
  const int n = self->body->segment_count;
  self->pair_count = 0;
  for (int b = 0; b < self->near.count; b++) {
    const int i = self->near.balls[b].segment;
    for (int j = 0; j < n; j++) {
      if (!self->is_pair[i * n + j] || self->solids[j].count == 0) continue;
      self->pairs[self->pair_count++] = (pair){.ball = b, .other = j};
    }
  }
}

/* Pelvis, spine, neck, head and clavicles are one column of flesh, which bending presses together. */
static bool is_of_trunk(const kg_body *body, int segment)
{
  const int role = body->segments[segment].role;
  return (role >= KG_ROLE_PELVIS && role <= KG_ROLE_HEAD) || role == KG_ROLE_L_CLAVICLE ||
         role == KG_ROLE_R_CLAVICLE;
}

/* Pairs far enough along the tree; of these out go those in each other in the rest pose, either way. */
static void choose_pairs(kg_self *self, const double *rest, kg_vec3 *p, kg_mat3 *R)
{
  const int n = self->body->segment_count;
  for (int i = 0; i < n; i++) {
    for (int j = 0; j < n; j++) {
      self->is_pair[i * n + j] = joints_between(self->body, i, j) >= KG_SELF_LEAST_JOINTS &&
                                 !(is_of_trunk(self->body, i) && is_of_trunk(self->body, j));
    }
  }
  list_pairs(self);
  pose_at(self->body, rest, p, R);
  for (int k = 0; k < self->pair_count; k++) {
    int count = 0;
    for (int m = 0; m < self->body->point_count; m++) {
      self->touch_of[m] = -1;
    }
    sample_pair(self, &self->pairs[k], p, R, -KG_SELF_REST_DEPTH_M, self->touches, &count);
    const int i = self->near.balls[self->pairs[k].ball].segment, j = self->pairs[k].other;
    if (count > 0) self->is_pair[i * n + j] = self->is_pair[j * n + i] = false;
  }
  list_pairs(self);
}

kg_status kg_self_create(kg_self **self, const kg_body *body, const double *rest,
                         const kg_allocator *allocator)
{
  KG_ASSERT(self && body);
  *self = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  const size_t n = (size_t)body->segment_count;
  kg_self *s = KG_ARENA_ARRAY(&arena, kg_self, 1);
  if (!s) return KG_ERR_NO_MEMORY;
  s->body = body;
  near_points_init(&s->near, body, &arena);
  s->solids = KG_ARENA_ARRAY(&arena, solid, n);
  s->shapes = KG_ARENA_ARRAY(&arena, int, body->shape_count);
  s->pairs = KG_ARENA_ARRAY(&arena, pair, n * n);
  s->is_pair = KG_ARENA_ARRAY(&arena, bool, n *n);
  s->touch_of = KG_ARENA_ARRAY(&arena, int, body->point_count);
  s->touches = KG_ARENA_ARRAY(&arena, kg_self_touch, body->point_count);
  kg_vec3 *p = KG_ARENA_ARRAY(&arena, kg_vec3, n);
  kg_mat3 *R = KG_ARENA_ARRAY(&arena, kg_mat3, n);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  for (int i = 0, filled = 0; i < body->segment_count; i++) {
    collect_solid(s, i, &filled);
  }
  choose_pairs(s, rest, p, R);
  s->arena = arena;
  *self = s;
  return KG_OK;
}

void kg_self_destroy(kg_self *self)
{
  if (self) {
    kg_arena arena = self->arena; /* the object lives in its own arena */
    kg_arena_release(&arena);
  }
}

bool kg_self_is_pair(const kg_self *self, int segment, int other)
{
  const int n = self->body->segment_count;
  KG_ASSERT(segment >= 0 && segment < n && other >= 0 && other < n);
  return self->is_pair[segment * n + other];
}
