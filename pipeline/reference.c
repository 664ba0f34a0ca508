/* The reference a simulation follows: the capture, smoothed, with feet and hands planted.
 *
 *   1. the capture at the simulation's rate (slerp), low-pass filtered without lag
 *   2. planted points: per foot and hand, the points that are slow, low and near its lowest point;
 *      where the centre of mass needs a support and nothing is planted, faster points, then the
 *      slowest low point as a pivot, then whatever the body lies or rolls on
 *   3. displacements: within a stance a planted point's displacement cancels its motion along the
 *      ground and puts it at the rest height; centred, so that the stance as a whole does not move;
 *      between stances the smoothest displacement (least squared second difference) that fades to
 *      zero with the ease time, kept clear of the ground
 *   4. inverse kinematics, frame by frame: the smallest weighted change of the pose that moves the
 *      points by their displacements (damped Gauss-Newton)
 *   5. plan (plan.c): the root moves so that forces at the planted points can explain the momentum,
 *      and inverse kinematics brings the feet back to their places; the last round is a plan, because
 *      moving legs changes the momentum and the simulation holds planted points by itself
 *
 * Symbols: x point in the world, n normal of the ground, Phi distance, d displacement. */
#include "pipeline/pipeline.h"

#include "kinegrad/dense.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/filter.h"

#include <stdlib.h>
#include <string.h>

enum { MAX_GROUPS = 4, IK_ITERATIONS = 4, CLEARANCE_ROUNDS = 4, PLAN_ROUNDS = 3 };

static const double MOST_STEPS = 5e6;       /* of a simulation: hours at 120 Hz                   */
static const double PLANT_HYSTERESIS = 1.5; /* a planted point may be this much faster           */
static const double SHORTEST_PLANT_S = 0.03;
static const double HAND_SOLE_M = 0.005; /* points of a hand this near its lowest carry force  */
static const double NEED_SMOOTHING_HZ = 6.0; /* of the centre of mass                             */
static const double NEEDED_SHARE = 0.35; /* of the weight: less than this is flight            */
static const double FAST_STANCE_SPEED = 0.5; /* m/s                                               */
static const double PIVOT_HEIGHT_M = 0.06; /* of the lowest point of a foot that may carry       */
static const double PIVOT_FLAT_M = 0.012;  /* above it, still a candidate                        */
static const double PIVOT_SPEED = 1.2;     /* m/s                                                */
static const double BODY_HEIGHT_M = 0.10;  /* of a body that lies or rolls                       */
static const double BODY_FLAT_M = 0.01;
static const double BODY_ERROR_M = 2e-3;
static const double DATA_WEIGHT = 1e7;      /* of a stance frame over one that fades              */
static const double POINT_ERROR_M = 5e-4;   /* standard deviations of the inverse kinematics:     */
static const double ROOT_MOVE_M = 0.02;     /* root position                                      */
static const double ROOT_TURN_RAD = 0.05;   /* root orientation and trunk                         */
static const double PLANNED_HOLD = 0.1;     /* share of the root's that is left after planning    */
static const double LONGEST_TURN_RAD = 0.3; /* of a joint in one iteration                        */
static const double IK_SMOOTHING_HZ = 8.0;
static const double LEG_TURN_RAD = 0.3; /* joints of the limb that is planted                 */

/* The points of one foot or hand. Arrays of (N, count). */
typedef struct point_group {
  int count;
  const int *points; /* indices into body->points */
  bool is_hand;
  bool ever_planted; /* nothing is asked of one that never is */
  kg_vec3 *x;        /* m, world                  */
  double *phi;       /* m                         */
  kg_vec3 *normal;
  bool *planted;
  kg_vec3 *along; /* displacement along the ground, m  */
  double *up;     /* displacement along the normal, m  */
} point_group;

typedef struct builder {
  const kg_subject *subject;
  const kg_body *body;
  const kg_track_params *params;
  kg_dynamics *dynamics;
  kg_reference *reference;
  int count; /* N */
  double dt;
  point_group groups[MAX_GROUPS];
  int group_count;
  kg_vec3 *p; /* pose scratch, one per segment */
  kg_mat3 *R;
  bool planned;
  kg_vec3 *com;     /* (N) of the capture, smoothed                         */
  bool *needed;     /* (N) a support is needed                              */
  bool *carried;    /* (N) by something that is neither foot nor hand       */
  double *rise;     /* (N) of the body's lowest points, m                   */
  double *rest_low; /* (N) their distance in the capture, m                 */
  bool *in_group;   /* (segments) foot or hand                              */
  kg_smoother smoother;
  double *work, *weights, *H, *g, *pose;
  double *moved; /* (N, nv) */
} builder;

/* ---- 1. the capture at the simulation's rate ------------------------------------------------- */

static void resample(builder *b)
{
  const int nq = b->body->nq;
  for (int k = 0; k < b->count; k++) {
    kg_states_at(b->body, b->reference->q + (size_t)k * (size_t)nq, b->subject->q,
                 b->subject->frame_count, k * b->dt / b->subject->dt);
  }
}

/* components of the state, quaternions renormalised: signs are continuous over time */
static void smooth_states(builder *b)
{
  const int nq = b->body->nq;
  double *q = b->reference->q;
  for (int k = 0; k < nq; k++) {
    kg_filter_lowpass(q + k, b->count, nq, 1.0 / b->dt, b->params->smoothing_hz, b->work);
  }
  for (int t = 0; t < b->count; t++) {
    for (int i = 0; i < b->body->segment_count; i++) {
      double *r = q + (size_t)t * (size_t)nq + 3 + 4 * i;
      const double s = 1.0 / sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]);
      for (int k = 0; k < 4; k++) {
        r[k] *= s;
      }
    }
  }
}

/* ---- 2. planted points ----------------------------------------------------------------------- */

static kg_vec3 body_point(const builder *b, int k)
{
  const kg_body_point *point = &b->body->points[k];
  return kg_vec3_add(b->p[point->segment], kg_mat3_mul_vec(b->R[point->segment], point->p));
}

static void read_points(builder *b)
{
  for (int t = 0; t < b->count; t++) {
    kg_dynamics_pose(b->dynamics, b->reference->q + (size_t)t * (size_t)b->body->nq, b->p, b->R);
    for (int g = 0; g < b->group_count; g++) {
      point_group *group = &b->groups[g];
      for (int k = 0; k < group->count; k++) {
        const kg_body_point *point = &b->body->points[group->points[k]];
        const int at = t * group->count + k;
        group->x[at] =
          kg_vec3_add(b->p[point->segment], kg_mat3_mul_vec(b->R[point->segment], point->p));
        const kg_sdf_value value = kg_soft_distance(&b->subject->scene, group->x[at]);
        group->phi[at] = value.distance;
        group->normal[at] = value.normal;
      }
    }
  }
}

static double point_speed(const builder *b, const point_group *group, int t, int k)
{
  const int first = t > 0 ? t - 1 : 0, last = t + 1 < b->count ? t + 1 : t;
  if (last == first) {
    return 0.0;
  }
  const kg_vec3 move =
    kg_vec3_sub(group->x[last * group->count + k], group->x[first * group->count + k]);
  return kg_vec3_norm(move) / ((last - first) * b->dt);
}

static double lowest_of_group(const point_group *group, int t)
{
  double lowest = INFINITY;
  for (int k = 0; k < group->count; k++) {
    lowest = fmin(lowest, group->phi[t * group->count + k]);
  }
  return lowest;
}

static bool may_stand(const builder *b, const point_group *group, int t, int k, double lowest,
                      double loose)
{
  const int at = t * group->count + k;
  return group->phi[at] < loose * b->params->plant_height &&
         group->phi[at] - lowest < loose * b->params->plant_flat;
}

static void find_planted(builder *b, point_group *group)
{
  for (int t = 0; t < b->count; t++) {
    const double lowest = lowest_of_group(group, t);
    for (int k = 0; k < group->count; k++) {
      const int at = t * group->count + k;
      const bool before = t > 0 && group->planted[at - group->count];
      const double loose = before ? PLANT_HYSTERESIS : 1.0;
      group->planted[at] = may_stand(b, group, t, k, lowest, loose) &&
                           point_speed(b, group, t, k) < loose * b->params->plant_speed;
    }
  }
}

/* gaps and stances shorter than SHORTEST_PLANT_S are closed and dropped */
static void clean_planted(builder *b, point_group *group)
{
  const int shortest = (int)ceil(SHORTEST_PLANT_S / b->dt);
  for (int pass = 0; pass < 2; pass++) {
    const bool kind = pass == 1; /* first close short gaps, then drop short stances */
    for (int k = 0; k < group->count; k++) {
      for (int t = 0; t < b->count;) {
        int end = t;
        while (end < b->count && group->planted[end * group->count + k] == kind) {
          end++;
        }
        const bool inside = t > 0 && end < b->count;
        if (end > t && end - t < shortest && (inside || kind)) {
          for (int u = t; u < end; u++) {
            group->planted[u * group->count + k] = !kind;
          }
        }
        t = end > t ? end : t + 1;
      }
    }
  }
}

static bool any_planted(const point_group *group, int t)
{
  for (int k = 0; k < group->count; k++) {
    if (group->planted[t * group->count + k]) {
      return true;
    }
  }
  return false;
}

/* Frames in which the captured centre of mass needs a support: its acceleration is far from that of
 * free fall. */
static void find_needed(builder *b, double gravity)
{
  const size_t nq = (size_t)b->body->nq;
  kg_vec3 *com = b->com;
  for (int t = 0; t < b->count; t++) {
    com[t] = kg_dynamics_centroid(b->dynamics, b->reference->q + (size_t)t * nq, NULL).com;
  }
  for (int c = 0; c < 3; c++) {
    kg_filter_lowpass(&com[0].x + c, b->count, 3, 1.0 / b->dt, NEED_SMOOTHING_HZ, b->work);
  }
  for (int t = 0; t < b->count; t++) {
    const int m = t < 1 ? 1 : t + 1 < b->count ? t : b->count - 2;
    double fall = 0.0;
    if (b->count >= 3) {
      fall = (com[m + 1].y - 2.0 * com[m].y + com[m - 1].y) / (b->dt * b->dt);
    }
    b->needed[t] = fall + gravity > NEEDED_SHARE * gravity;
  }
}

static bool anything_planted(const builder *b, int t)
{
  for (int g = 0; g < b->group_count; g++) {
    if (any_planted(&b->groups[g], t)) {
      return true;
    }
  }
  return false;
}

/* A fast stance: where a support is needed and nothing is planted, faster points count too. */
static void find_fast_stances(builder *b)
{
  for (int t = 0; t < b->count; t++) {
    if (!b->needed[t] || anything_planted(b, t)) {
      continue;
    }
    for (int g = 0; g < b->group_count; g++) {
      point_group *group = &b->groups[g];
      const double lowest = lowest_of_group(group, t);
      for (int k = 0; k < group->count; k++) {
        group->planted[t * group->count + k] =
          may_stand(b, group, t, k, lowest, 1.0) && point_speed(b, group, t, k) < FAST_STANCE_SPEED;
      }
    }
  }
  for (int g = 0; g < b->group_count; g++) {
    clean_planted(b, &b->groups[g]);
  }
}

/* A foot that turns on its ball moves, but it carries the body: where a support is needed and nothing
 * is planted, the slowest of the lowest points of the lowest foot or hand becomes the pivot. */
static void find_pivots(builder *b)
{
  for (int t = 0; t < b->count; t++) {
    point_group *lowest = NULL;
    double low = PIVOT_HEIGHT_M;
    const bool held = !b->needed[t] || anything_planted(b, t);
    for (int g = 0; g < b->group_count; g++) {
      const double phi = lowest_of_group(&b->groups[g], t);
      if (phi < low) {
        low = phi;
        lowest = &b->groups[g];
      }
    }
    if (held || !lowest) {
      continue;
    }
    int pivot = -1;
    double slowest = PIVOT_SPEED;
    for (int k = 0; k < lowest->count; k++) {
      const int at = t * lowest->count + k;
      if (lowest->phi[at] < low + PIVOT_FLAT_M) {
        const bool before = t > 0 && lowest->planted[at - lowest->count];
        const double speed = point_speed(b, lowest, t, k) / (before ? PLANT_HYSTERESIS : 1.0);
        pivot = speed < slowest ? k : pivot;
        slowest = fmin(slowest, speed);
      }
    }
    if (pivot >= 0) {
      lowest->planted[t * lowest->count + pivot] = true;
    }
  }
}

/* lowest point of the body apart from feet and hands, at the pose in b->p, b->R */
static double lowest_of_body(const builder *b)
{
  double low = INFINITY;
  for (int k = b->body->sole_node_count; k < b->body->point_count; k++) {
    if (!b->in_group[b->body->points[k].segment]) {
      low = fmin(low, kg_soft_distance(&b->subject->scene, body_point(b, k)).distance);
    }
  }
  return low;
}

/* How far the body must move along the normal so that what it lies or rolls on touches the ground, and
 * so that nothing of it is in the ground; smooth in between. */
static void find_rises(builder *b, double tau4)
{
  for (int t = 0; t < b->count; t++) {
    kg_dynamics_pose(b->dynamics, b->reference->q + (size_t)t * (size_t)b->body->nq, b->p, b->R);
    const double low = lowest_of_body(b);
    const bool held = anything_planted(b, t);
    const double rise = b->params->rest_height - low;
    b->carried[t] = b->needed[t] && !held && low < BODY_HEIGHT_M;
    b->weights[t] = b->carried[t] || rise > 0.0 ? DATA_WEIGHT : 0.0;
    b->rise[t] = b->weights[t] * rise;
    b->rest_low[t] = low;
  }
  kg_smoother_factor(&b->smoother, b->weights, tau4);
  kg_smoother_solve(&b->smoother, b->rise, 1);
}

/* ---- 3. displacements ------------------------------------------------------------------------ */

static kg_vec3 along_ground(kg_vec3 d, kg_vec3 n)
{
  return kg_vec3_add_scaled(d, -kg_vec3_dot(d, n), n);
}

/* mean displacement of the points planted both at t - 1 and t; of those at t - 1 if there are none */
static kg_vec3 carried_displacement(const point_group *group, int t)
{
  kg_vec3 sum = {0}, sum_before = {0};
  int n = 0, n_before = 0;
  for (int k = 0; k < group->count; k++) {
    const int at = t * group->count + k, before = at - group->count;
    if (group->planted[before]) {
      sum_before = kg_vec3_add(sum_before, group->along[before]);
      n_before++;
      if (group->planted[at]) {
        sum = kg_vec3_add(sum, group->along[at]);
        n++;
      }
    }
  }
  return n > 0          ? kg_vec3_scale(1.0 / n, sum)
         : n_before > 0 ? kg_vec3_scale(1.0 / n_before, sum_before)
                        : sum;
}

/* planted points stay where they are along the ground: d(t) = d(t-1) - (x(t) - x(t-1)) */
static void hold_stance(point_group *group, int first, int end)
{
  for (int t = first; t < end; t++) {
    for (int k = 0; k < group->count; k++) {
      const int at = t * group->count + k, before = at - group->count;
      if (t > first && group->planted[at] && group->planted[before]) {
        const kg_vec3 move =
          along_ground(kg_vec3_sub(group->x[at], group->x[before]), group->normal[at]);
        group->along[at] = kg_vec3_sub(group->along[before], move);
      }
    }
    const kg_vec3 carried = t > first ? carried_displacement(group, t) : (kg_vec3){0};
    for (int k = 0; k < group->count; k++) {
      const int at = t * group->count + k;
      if (group->planted[at] && (t == first || !group->planted[at - group->count])) {
        group->along[at] = carried;
      }
    }
  }
}

/* the stance as a whole stays where it was captured */
static void center_stance(point_group *group, int first, int end)
{
  kg_vec3 mean = {0};
  int n = 0;
  for (int at = first * group->count; at < end * group->count; at++) {
    if (group->planted[at]) {
      mean = kg_vec3_add(mean, group->along[at]);
      n++;
    }
  }
  mean = kg_vec3_scale(1.0 / (n > 0 ? n : 1), mean);
  for (int at = first * group->count; at < end * group->count; at++) {
    if (group->planted[at]) {
      group->along[at] = kg_vec3_sub(group->along[at], mean);
    }
  }
}

static void plant_group(builder *b, point_group *group)
{
  for (int t = 0; t < b->count;) {
    int end = t;
    while (end < b->count && any_planted(group, end)) {
      end++;
    }
    hold_stance(group, t, end);
    center_stance(group, t, end);
    t = end > t ? end : t + 1;
  }
}

/* distance that a foot in the air must keep from the ground: full clearance, gained with the
 * clearance speed before and after a stance */
static double air_clearance(const builder *b, int away)
{
  return away == 0 ? 0.0
                   : fmin(b->params->clearance,
                          b->params->rest_height + b->params->clearance_speed * away * b->dt);
}

static double needed_clearance(const builder *b, const point_group *group, const int *away, int t,
                               int k)
{
  if (group->is_hand || group->planted[t * group->count + k]) {
    return 0.0;
  }
  /* another point of the foot may be planted */
  return away[t] == 0 ? 0.5 * b->params->rest_height : air_clearance(b, away[t]);
}

/* frames to the nearest frame in which the group is planted */
static void frames_away(const builder *b, const point_group *group, int *away)
{
  int since = b->count;
  for (int t = 0; t < b->count; t++) {
    since = any_planted(group, t) ? 0 : since + 1;
    away[t] = since;
  }
  since = b->count;
  for (int t = b->count - 1; t >= 0; t--) {
    since = any_planted(group, t) ? 0 : since + 1;
    away[t] = since < away[t] ? since : away[t];
  }
}

/* displacement along the normal: rest height in stance, clearance in the air, smooth in between */
static void fill_up(builder *b, point_group *group, const int *away, double tau4)
{
  double *data = b->work;
  for (int k = 0; k < group->count; k++) {
    for (int t = 0; t < b->count; t++) {
      const int at = t * group->count + k;
      b->weights[t] = group->planted[at] ? DATA_WEIGHT : 0.0;
      data[t] = group->planted[at] ? b->params->rest_height - group->phi[at] : 0.0;
    }
    for (int round = 0; round < CLEARANCE_ROUNDS; round++) {
      double *up = data + b->count;
      memcpy(up, data, (size_t)b->count * sizeof *up);
      kg_smoother_factor(&b->smoother, b->weights, tau4);
      for (int t = 0; t < b->count; t++) {
        up[t] *= b->weights[t];
      }
      kg_smoother_solve(&b->smoother, up, 1);
      bool low = false;
      for (int t = 0; t < b->count; t++) {
        const int at = t * group->count + k;
        const double needed = needed_clearance(b, group, away, t, k) - group->phi[at];
        if (!group->planted[at] && up[t] < needed - 1e-4) {
          data[t] = needed;
          b->weights[t] = 0.01 * DATA_WEIGHT;
          low = true;
        }
        group->up[at] = up[t];
      }
      if (!low) {
        break;
      }
    }
  }
}

static void fill_along(builder *b, point_group *group, double tau4)
{
  for (int k = 0; k < group->count; k++) {
    for (int t = 0; t < b->count; t++) {
      b->weights[t] = group->planted[t * group->count + k] ? DATA_WEIGHT : 0.0;
    }
    kg_smoother_factor(&b->smoother, b->weights, tau4);
    double *first = &group->along[k].x;
    for (int c = 0; c < 3; c++) {
      for (int t = 0; t < b->count; t++) {
        first[3 * t * group->count + c] *= b->weights[t];
      }
      kg_smoother_solve(&b->smoother, first + c, 3 * group->count);
    }
  }
}

static void displace_points(builder *b, int *away)
{
  const double tau4 = pow(b->params->ease_time / b->dt, 4.0);
  for (int g = 0; g < b->group_count; g++) {
    point_group *group = &b->groups[g];
    group->ever_planted = !group->is_hand;
    for (int t = 0; t < b->count && !group->ever_planted; t++) {
      group->ever_planted = any_planted(group, t);
    }
    plant_group(b, group);
    frames_away(b, group, away);
    fill_along(b, group, tau4);
    fill_up(b, group, away, tau4);
    for (int t = 0; t < b->count && !group->is_hand; t++) {
      b->reference->clearance[2 * t + g] = air_clearance(b, away[t]);
    }
  }
}

/* ---- 4. inverse kinematics ------------------------------------------------------------------- */

/* a point at x of a segment should move by e */
static void add_target(builder *b, int segment, kg_vec3 x, kg_vec3 e, double weight)
{
  double J[3][KG_PATH_COLUMNS];
  int columns[KG_PATH_COLUMNS];
  const int n = kg_point_rows(b->body, b->p, b->R, segment, x, J, columns);
  const double error[3] = {e.x, e.y, e.z};
  kg_add_normal_equations(b->H, b->g, b->body->nv, J, columns, n, error, weight);
}

static bool in_leg_or_arm(const kg_body *body, int segment)
{
  const int role = body->segments[segment].role;
  return role >= KG_ROLE_L_HIP || (role >= KG_ROLE_L_CLAVICLE && role <= KG_ROLE_R_WRIST);
}

/* weights of the pose's own change; a planned root is held where it is */
static void add_prior(builder *b, const double *moved)
{
  const int nv = b->body->nv;
  const double hold = b->planned ? PLANNED_HOLD : 1.0;
  for (int i = 0; i < nv; i++) {
    const double sd = i < 3                                 ? hold * ROOT_MOVE_M
                      : in_leg_or_arm(b->body, (i - 3) / 3) ? LEG_TURN_RAD
                                                            : (i < 6 ? hold : 1.0) * ROOT_TURN_RAD;
    b->H[(size_t)i * (size_t)nv + (size_t)i] += 1.0 / (sd * sd);
    b->g[i] -= moved[i] / (sd * sd);
  }
}

static double largest_displacement(const builder *b, int t)
{
  double largest = 0.0;
  for (int g = 0; g < b->group_count; g++) {
    const point_group *group = &b->groups[g];
    for (int k = 0; k < group->count; k++) {
      const int at = t * group->count + k;
      largest = fmax(largest, fmax(kg_vec3_norm(group->along[at]), fabs(group->up[at])));
    }
  }
  return largest;
}

static void assemble_targets(builder *b, const double *q, int t)
{
  kg_dynamics_pose(b->dynamics, q, b->p, b->R);
  for (int g = 0; g < b->group_count; g++) {
    const point_group *group = &b->groups[g];
    for (int k = 0; k < group->count && group->ever_planted; k++) {
      const int at = t * group->count + k;
      const kg_vec3 d = kg_vec3_add_scaled(group->along[at], group->up[at], group->normal[at]);
      const kg_body_point *point = &b->body->points[group->points[k]];
      const kg_vec3 x =
        kg_vec3_add(b->p[point->segment], kg_mat3_mul_vec(b->R[point->segment], point->p));
      const kg_vec3 e = kg_vec3_sub(kg_vec3_add(group->x[at], d), x);
      add_target(b, point->segment, x, e, 1.0 / (POINT_ERROR_M * POINT_ERROR_M));
    }
  }
}

/* the same along the normal only, for the lowest points of the body in a frame that rises */
static void assemble_rise(builder *b, int t)
{
  if (fabs(b->rise[t]) < 1e-4) {
    return;
  }
  const double low = lowest_of_body(b);
  const double target = b->rest_low[t] + b->rise[t]; /* where the lowest point should be */
  for (int k = b->body->sole_node_count; k < b->body->point_count; k++) {
    const int segment = b->body->points[k].segment;
    if (b->in_group[segment]) {
      continue;
    }
    const kg_vec3 x = body_point(b, k);
    const kg_sdf_value value = kg_soft_distance(&b->subject->scene, x);
    if (value.distance < low + BODY_FLAT_M) {
      const kg_vec3 e = kg_vec3_scale(target - low, value.normal);
      add_target(b, segment, x, e, 1.0 / (BODY_ERROR_M * BODY_ERROR_M));
    }
  }
}

/* moved: the change of the pose q[nq] that minimises targets and prior; in: a start, out */
static void solve_pose(builder *b, const double *q, int t, double *moved)
{
  const int nv = b->body->nv;
  double *pose = b->pose;
  for (int round = 0; round < IK_ITERATIONS; round++) {
    kg_body_integrate(b->body, pose, q, moved);
    memset(b->H, 0, (size_t)nv * (size_t)nv * sizeof *b->H);
    memset(b->g, 0, (size_t)nv * sizeof *b->g);
    assemble_targets(b, pose, t);
    assemble_rise(b, t);
    add_prior(b, moved);
    if (!kg_dense_cholesky_factor(b->H, nv)) {
      return;
    }
    kg_dense_cholesky_solve(b->H, nv, b->g, 1);
    /* a long step is cut: near a straight leg the linear model is good for little */
    double longest = 0.0;
    for (int i = 3; i < nv; i++) {
      longest = fmax(longest, fabs(b->g[i]));
    }
    const double scale = fmin(1.0, LONGEST_TURN_RAD / fmax(longest, 1e-12));
    for (int i = 0; i < nv; i++) {
      b->g[i] *= scale;
    }
    kg_body_integrate(b->body, pose, pose, b->g);
    kg_body_difference(b->body, moved, pose, q);
  }
}

/* All frames, each started from the one before. The changes are smoothed over time: a leg near its
 * full length would jerk, and the simulation holds planted points by itself. */
static void solve_poses(builder *b)
{
  const size_t nq = (size_t)b->body->nq, nv = (size_t)b->body->nv;
  for (int t = 0; t < b->count; t++) {
    double *moved = b->moved + (size_t)t * nv;
    if (t > 0) {
      memcpy(moved, moved - nv, nv * sizeof *moved);
    } else {
      memset(moved, 0, nv * sizeof *moved);
    }
    if (b->planned || fabs(b->rise[t]) > 1e-4 || largest_displacement(b, t) > 1e-6) {
      solve_pose(b, b->reference->q + (size_t)t * nq, t, moved);
    } else {
      memset(moved, 0, nv * sizeof *moved);
    }
  }
  for (size_t i = 0; i < nv; i++) {
    kg_filter_lowpass(b->moved + i, b->count, (int)nv, 1.0 / b->dt, IK_SMOOTHING_HZ, b->work);
  }
  for (int t = 0; t < b->count; t++) {
    double *q = b->reference->q + (size_t)t * nq;
    kg_body_integrate(b->body, q, q, b->moved + (size_t)t * nv);
  }
}

/* ---- 5. plan ----------------------------------------------------------------------------------- */

/* The lowest points of a body that lies or rolls: they carry, but nothing holds them. */
static int list_carriers(builder *b, int t, int n)
{
  kg_dynamics_pose(b->dynamics, b->reference->q + (size_t)t * (size_t)b->body->nq, b->p, b->R);
  const double low = lowest_of_body(b);
  for (int k = b->body->sole_node_count; k < b->body->point_count && n < KG_MAX_PLANTED; k++) {
    const kg_vec3 x = body_point(b, k);
    const kg_sdf_value value = kg_soft_distance(&b->subject->scene, x);
    if (!b->in_group[b->body->points[k].segment] && value.distance < low + BODY_FLAT_M) {
      b->reference->planted[t * KG_MAX_PLANTED + n++] =
        (kg_planted_point){.point = k, .x = x, .normal = value.normal, .rolls = true};
    }
  }
  return n;
}

/* The planted points of a frame; of a hand only the lowest, its surface is sampled densely. */
static void list_planted(builder *b)
{
  for (int t = 0; t < b->count; t++) {
    int n = 0;
    for (int g = 0; g < b->group_count; g++) {
      const point_group *group = &b->groups[g];
      const double lowest = lowest_of_group(group, t);
      for (int k = 0; k < group->count; k++) {
        const int at = t * group->count + k;
        const bool carries = !group->is_hand || group->phi[at] < lowest + HAND_SOLE_M;
        if (group->planted[at] && carries && n < KG_MAX_PLANTED) {
          const kg_vec3 d = kg_vec3_add_scaled(group->along[at], group->up[at], group->normal[at]);
          b->reference->planted[t * KG_MAX_PLANTED + n++] = (kg_planted_point){
            group->points[k], kg_vec3_add(group->x[at], d), group->normal[at], false};
        }
      }
    }
    b->reference->planted_count[t] = b->carried[t] ? list_carriers(b, t, n) : n;
  }
}

/* ---- assembly -------------------------------------------------------------------------------- */

static void add_group(builder *b, kg_arena *arena, const int *points, int count, bool is_hand)
{
  if (count == 0) {
    return;
  }
  point_group *group = &b->groups[b->group_count++];
  const size_t n = (size_t)b->count * (size_t)count;
  *group = (point_group){.count = count, .points = points, .is_hand = is_hand};
  group->x = KG_ARENA_ARRAY(arena, kg_vec3, n);
  group->phi = KG_ARENA_ARRAY(arena, double, n);
  group->normal = KG_ARENA_ARRAY(arena, kg_vec3, n);
  group->planted = KG_ARENA_ARRAY(arena, bool, n);
  group->along = KG_ARENA_ARRAY(arena, kg_vec3, n);
  group->up = KG_ARENA_ARRAY(arena, double, n);
}

static void add_groups(builder *b, kg_arena *arena)
{
  const kg_body *body = b->body;
  int *index = KG_ARENA_ARRAY(arena, int, 4 * body->point_count);
  if (!index) {
    return;
  }
  for (int foot = 0; foot < body->sole_node_count / KG_SOLE_NODE_COUNT; foot++) {
    for (int k = 0; k < KG_SOLE_NODE_COUNT; k++) {
      index[k] = foot * KG_SOLE_NODE_COUNT + k;
    }
    add_group(b, arena, index, KG_SOLE_NODE_COUNT, false);
    index += KG_SOLE_NODE_COUNT;
  }
  const kg_role wrists[2] = {KG_ROLE_L_WRIST, KG_ROLE_R_WRIST};
  for (int side = 0; side < 2; side++) {
    int count = 0;
    for (int k = body->sole_node_count; k < body->point_count; k++) {
      if (body->points[k].segment == body->segment_of_role[wrists[side]]) {
        index[count++] = k;
      }
    }
    add_group(b, arena, index, count, true);
    index += count;
  }
}

/* feet, hands, and shanks: the end of a shank is always low when the foot stands, and carries nothing */
static void mark_group_segments(builder *b)
{
  const kg_role roles[] = {KG_ROLE_L_ANKLE, KG_ROLE_L_TOE,   KG_ROLE_R_ANKLE, KG_ROLE_R_TOE,
                           KG_ROLE_L_WRIST, KG_ROLE_R_WRIST, KG_ROLE_L_KNEE,  KG_ROLE_R_KNEE};
  for (size_t i = 0; b->in_group && i < KG_COUNT_OF(roles); i++) {
    const int segment = b->body->segment_of_role[roles[i]];
    if (segment >= 0) {
      b->in_group[segment] = true;
    }
  }
}

static bool builder_create(builder *b, kg_arena *arena)
{
  const size_t N = (size_t)b->count, nq = (size_t)b->body->nq, nv = (size_t)b->body->nv;
  b->p = KG_ARENA_ARRAY(arena, kg_vec3, b->body->segment_count);
  b->R = KG_ARENA_ARRAY(arena, kg_mat3, b->body->segment_count);
  const double lowest_hz = fmin(b->params->smoothing_hz, fmin(IK_SMOOTHING_HZ, NEED_SMOOTHING_HZ));
  const size_t filter = kg_filter_work_size(b->count, 1.0 / b->dt, lowest_hz);
  b->work = KG_ARENA_ARRAY(arena, double, filter > 2 * N ? filter : 2 * N);
  b->weights = KG_ARENA_ARRAY(arena, double, N);
  b->H = KG_ARENA_ARRAY(arena, double, nv *nv);
  b->g = KG_ARENA_ARRAY(arena, double, nv);
  b->pose = KG_ARENA_ARRAY(arena, double, nq);
  b->moved = KG_ARENA_ARRAY(arena, double, N *nv);
  b->com = KG_ARENA_ARRAY(arena, kg_vec3, N);
  b->needed = KG_ARENA_ARRAY(arena, bool, N);
  b->carried = KG_ARENA_ARRAY(arena, bool, N);
  b->rise = KG_ARENA_ARRAY(arena, double, N);
  b->rest_low = KG_ARENA_ARRAY(arena, double, N);
  b->in_group = KG_ARENA_ARRAY(arena, bool, b->body->segment_count);
  kg_smoother_create(&b->smoother, b->count, arena);
  add_groups(b, arena);
  mark_group_segments(b);
  return !kg_arena_failed(arena);
}

kg_status kg_reference_create(kg_reference *reference, const kg_subject *subject,
                              const kg_track_params *params, double dt, double gravity,
                              double friction, kg_arena *arena)
{
  const double duration = (subject->frame_count - 1) * subject->dt;
  if (!(duration / dt < MOST_STEPS)) {
    return KG_ERR_UNSUPPORTED;
  }
  const int count = (int)ceil(duration / dt - 1e-6) + 1;
  *reference = (kg_reference){.count = count, .dt = dt};
  reference->q = KG_ARENA_ARRAY(arena, double, (size_t)count *(size_t)subject->body->nq);
  reference->planted_count = KG_ARENA_ARRAY(arena, int, count);
  reference->planted = KG_ARENA_ARRAY(arena, kg_planted_point, (size_t)count * KG_MAX_PLANTED);

  reference->missing_force = KG_ARENA_ARRAY(arena, kg_vec3, count);
  reference->missing_moment = KG_ARENA_ARRAY(arena, kg_vec3, count);
  reference->clearance = KG_ARENA_ARRAY(arena, double, (size_t)count * 2);

  kg_arena scratch;
  kg_arena_init(&scratch, arena->allocator);
  builder b = {.subject = subject,
               .body = subject->body,
               .params = params,
               .reference = reference,
               .count = count,
               .dt = reference->dt};
  int *away = KG_ARENA_ARRAY(&scratch, int, count);
  kg_status status =
    kg_arena_failed(arena) || !builder_create(&b, &scratch) ? KG_ERR_NO_MEMORY : KG_OK;
  if (status == KG_OK) status = kg_dynamics_create(&b.dynamics, subject->body, arena->allocator);
  if (status == KG_OK) {
    resample(&b);
    smooth_states(&b);
    read_points(&b);
    for (int g = 0; g < b.group_count; g++) {
      find_planted(&b, &b.groups[g]);
      clean_planted(&b, &b.groups[g]);
    }
    find_needed(&b, gravity);
    find_fast_stances(&b);
    find_pivots(&b);
    find_rises(&b, pow(params->ease_time / b.dt, 4.0));
    displace_points(&b, away);
    solve_poses(&b);
    list_planted(&b);
    b.planned = true;
  }
  for (int round = 0; status == KG_OK && round < PLAN_ROUNDS; round++) {
    status = kg_plan_momentum(reference, subject, params, gravity, friction, arena->allocator);
    if (status == KG_OK && round + 1 < PLAN_ROUNDS) {
      solve_poses(&b);
    }
  }
  kg_dynamics_destroy(b.dynamics);
  kg_arena_release(&scratch);
  return status;
}
