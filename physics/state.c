/* Bodies from given segments, and the state space q (+) d of body.h: R^3 times one rotation group
 * SO(3) per segment, perturbed on the right. */
#include "physics/physics.h"

#include <string.h>

kg_body *kg_body_allocate(int segment_count, int shape_count, int point_count,
                          const kg_allocator *allocator)
{
  KG_ASSERT(segment_count > 0 && shape_count >= 0 && point_count >= 0);
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_body *body = KG_ARENA_ARRAY(&arena, kg_body, 1);
  kg_arena *owner = KG_ARENA_ARRAY(&arena, kg_arena, 1);
  kg_segment *segments = KG_ARENA_ARRAY(&arena, kg_segment, segment_count);
  kg_body_shape *shapes = KG_ARENA_ARRAY(&arena, kg_body_shape, shape_count);
  kg_body_point *points = KG_ARENA_ARRAY(&arena, kg_body_point, point_count);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return NULL;
  }
  *owner = arena;
  body->segment_count = segment_count;
  body->nq = 3 + 4 * segment_count;
  body->nv = 3 + 3 * segment_count;
  body->segments = segments;
  body->shape_count = shape_count;
  body->shapes = shapes;
  body->point_count = point_count;
  body->points = points;
  body->allocator = allocator;
  body->memory = owner;
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    body->segment_of_role[r] = -1;
  }
  return body;
}

void kg_body_finish(kg_body *body)
{
  body->mass = 0.0;
  for (int i = 0; i < body->segment_count; i++) {
    KG_ASSERT(body->segments[i].mass >= 0.0);
    KG_ASSERT(i == 0 ? body->segments[i].parent == -1
                     : body->segments[i].parent >= 0 && body->segments[i].parent < i);
    body->mass += body->segments[i].mass;
  }
}

/* Height of joints and points with every rotation the identity: the only posture that is known. */
static double height_at_rest(const kg_body *body)
{
  double low = 0.0, high = 0.0;
  for (int i = 0; i < body->segment_count; i++) {
    double y = 0.0;
    for (int k = i; k > 0; k = body->segments[k].parent) {
      y += body->segments[k].offset.y;
    }
    low = fmin(low, y);
    high = fmax(high, y);
    for (int k = 0; k < body->point_count; k++) {
      if (body->points[k].segment == i) {
        low = fmin(low, y + body->points[k].p.y);
        high = fmax(high, y + body->points[k].p.y);
      }
    }
  }
  return high - low;
}

kg_status kg_body_create(kg_body **body, const kg_segment *segments, int segment_count,
                         const kg_body_point *points, int point_count,
                         const kg_allocator *allocator)
{
  *body = NULL;
  kg_body *made = kg_body_allocate(segment_count, 0, point_count, allocator);
  if (!made) {
    return KG_ERR_NO_MEMORY;
  }
  memcpy(made->segments, segments, (size_t)segment_count * sizeof *segments);
  if (point_count > 0) {
    memcpy(made->points, points, (size_t)point_count * sizeof *points);
  }
  for (int i = 0; i < segment_count; i++) {
    const int role = segments[i].role;
    if (role >= 0 && role < KG_ROLE_COUNT) {
      made->segment_of_role[role] = i;
    }
  }
  kg_body_finish(made);
  made->stature = height_at_rest(made);
  *body = made;
  return KG_OK;
}

void kg_body_destroy(kg_body *body)
{
  if (body) {
    kg_arena arena = *(kg_arena *)body->memory; /* the arena holds itself */
    kg_arena_release(&arena);
  }
}

void kg_joint_turn(double *q_out, const double *q, const double *d)
{
  const kg_quat turn = kg_quat_exp(kg_load3(d));
  const kg_quat r = kg_quat_normalized(kg_quat_mul(kg_quat_make(q[0], q[1], q[2], q[3]), turn));
  q_out[0] = r.w;
  q_out[1] = r.x;
  q_out[2] = r.y;
  q_out[3] = r.z;
}

void kg_body_integrate(const kg_body *body, double *q_out, const double *q, const double *d)
{
  kg_store3(q_out, kg_vec3_add(kg_load3(q), kg_load3(d)));
  for (int i = 0; i < body->segment_count; i++) {
    kg_joint_turn(q_out + 3 + 4 * i, q + 3 + 4 * i, d + 3 + 3 * i);
  }
}

void kg_body_difference(const kg_body *body, double *d, const double *q_b, const double *q_a)
{
  kg_store3(d, kg_vec3_sub(kg_load3(q_b), kg_load3(q_a)));
  for (int i = 0; i < body->segment_count; i++) {
    const kg_quat turn = kg_quat_mul(kg_quat_conj(kg_state_quat(q_a, i)), kg_state_quat(q_b, i));
    kg_store3(d + 3 + 3 * i, kg_quat_log(turn));
  }
}
