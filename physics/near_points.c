/* Balls around the points of segments; the contract is in near_points.h. */
#include "physics/near_points.h"

/* Around the box of a segment's points: not the smallest ball, near enough. */
static void bound_points(segment_ball *ball, const int *points, const kg_body *body)
{
  points += ball->first;
  kg_vec3 low = body->points[points[0]].p, high = low;
  for (int k = 1; k < ball->count; k++) {
    const kg_vec3 p = body->points[points[k]].p;
    low = kg_vec3_make(fmin(low.x, p.x), fmin(low.y, p.y), fmin(low.z, p.z));
    high = kg_vec3_make(fmax(high.x, p.x), fmax(high.y, p.y), fmax(high.z, p.z));
  }
  ball->center = kg_vec3_scale(0.5, kg_vec3_add(low, high));
  ball->radius = 0.0;
  for (int k = 0; k < ball->count; k++) {
    const double r = kg_vec3_norm(kg_vec3_sub(body->points[points[k]].p, ball->center));
    ball->radius = fmax(ball->radius, r * (1.0 + 1e-12));
  }
}

void near_points_refresh(near_points *near, const kg_body *body)
{
  for (int b = 0; b < near->count; b++) {
    bound_points(&near->balls[b], near->points, body);
  }
}

void near_points_init(near_points *near, const kg_body *body, kg_arena *arena)
{
  int filled = 0;
  *near = (near_points){.balls = KG_ARENA_ARRAY(arena, segment_ball, body->segment_count),
                        .points = KG_ARENA_ARRAY(arena, int, body->point_count)};
  for (int i = 0; i < body->segment_count && !kg_arena_failed(arena); i++) {
    const int first = filled;
    for (int k = 0; k < body->point_count; k++) {
      if (body->points[k].segment == i) near->points[filled++] = k;
    }
    if (filled == first) continue;
    near->balls[near->count++] =
      (segment_ball){.segment = i, .first = first, .count = filled - first};
  }
  near_points_refresh(near, body);
}

static bool comes_before(const segment_ball *a, const segment_ball *b)
{
  return a->bound < b->bound || (a->bound == b->bound && a->segment < b->segment);
}

bool near_points_sort(near_points *near, const kg_scene *scene, const kg_vec3 *p, const kg_mat3 *R,
                      kg_vec3 shift)
{
  bool defined = true;
  for (int b = 0; b < near->count; b++) {
    segment_ball ball = near->balls[b];
    const kg_vec3 center =
      kg_vec3_add(p[ball.segment], kg_mat3_mul_vec(R[ball.segment], ball.center));
    ball.bound =
      kg_scene_distance_from(scene, kg_vec3_add(center, shift), &ball.hint).distance - ball.radius;
    defined = defined && !isnan(ball.bound);
    int at = b;
    for (; at > 0 && comes_before(&ball, &near->balls[at - 1]); at--) {
      near->balls[at] = near->balls[at - 1];
    }
    near->balls[at] = ball;
  }
  return defined;
}
