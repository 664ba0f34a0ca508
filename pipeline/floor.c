/* Where the ground is, and how each foot stands on it: from the frames in which a foot is at rest.
 *
 * A captured clip has no ground. Its floor is typically off by up to 5 cm and may tilt by a percent,
 * and skeletons differ in where they put the ankle and the toe joint, per foot. So:
 *   1. stance: frames in which a foot's toe joint and ankle are both slow and both low
 *   2. plane: least squares through the toe joints in stance, per-foot height, common slope; the
 *      slope is held down by a prior of 1 %, because a short clip says little about it
 *   3. floor: below each foot's plane by an anthropometric clearance; the lower of the feet counts
 *   4. foot fit: the floor normal in the ankle's and the toe's frame, averaged over stance, and the
 *      height of both joints above the floor
 *
 * Clearances at a stature of 1.75 m: toe (metatarsophalangeal) joint 0.03 m, ankle joint 0.07 m,
 * shoe included; after R. Drillis, R. Contini, Body segment parameters, 1966 (ankle 0.039 of the
 * stature, barefoot). */
#include "pipeline/pipeline.h"

#include "kinegrad/filter.h"

#include <stdlib.h>
#include <string.h>

static const double TOE_CLEARANCE_M = 0.030;
static const double ANKLE_CLEARANCE_M = 0.070;
static const double FEET_DISAGREE_M = 0.040; /* the lower foot may pull the floor down this far  */
static const double SMALLEST_HEIGHT_M = 0.012; /* of a joint above the sole                       */
static const double LARGEST_HEIGHT_M = 0.150;
static const double SLOPE_PRIOR = 0.01;     /* standard deviation of the floor's slope         */
static const double HEIGHT_NOISE_M = 0.008; /* standard deviation of a stance height           */
static const double SLOPE_LIMIT = 0.03;
static const double SMOOTHING_HZ = 12.0;
static const double SLOW_M_PER_S = 0.2;   /* a foot at rest                                  */
static const double SLOWEST_SHARE = 0.04; /* ... or among this share of its slowest frames   */
/* where even those are faster, no foot rests: all frames count, and the low ones are taken */
static const double RESTLESS_M_PER_S = 0.6;
static const double LOW_M = 0.05;    /* above the lowest decile of the slow frames      */
static const double RAISED_M = 0.08; /* a foot that rests this far above the other one  */

/* The path of one foot over the motion frames. Arrays of T. */
typedef struct foot_path {
  int count;
  kg_vec3 *ankle, *toe; /* smoothed world positions, m                    */
  kg_quat *ankle_q, *toe_q;
  double *speed;  /* the faster of ankle and toe, m/s                */
  double *sorted; /* scratch                                         */
  bool *stance;
  int stance_count;
  double mean_height; /* of the toe joint in stance, slope removed       */
  double ankle_above; /* ankle above the toe joint along the normal, m   */
} foot_path;

static int compare_doubles(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* the value below which a share of the n numbers lies; sorts x */
static double quantile(double *x, int n, double share)
{
  qsort(x, (size_t)n, sizeof *x, compare_doubles);
  return x[(int)(share * (n - 1) + 0.5)];
}

static bool foot_path_create(foot_path *path, kg_arena *arena, int count)
{
  *path = (foot_path){.count = count};
  path->ankle = KG_ARENA_ARRAY(arena, kg_vec3, count);
  path->toe = KG_ARENA_ARRAY(arena, kg_vec3, count);
  path->ankle_q = KG_ARENA_ARRAY(arena, kg_quat, count);
  path->toe_q = KG_ARENA_ARRAY(arena, kg_quat, count);
  path->speed = KG_ARENA_ARRAY(arena, double, count);
  path->sorted = KG_ARENA_ARRAY(arena, double, count);
  path->stance = KG_ARENA_ARRAY(arena, bool, count);
  return !kg_arena_failed(arena);
}

static double speed_at(const kg_vec3 *x, int t, int count, double dt)
{
  const int a = t > 0 ? t - 1 : 0;
  const int b = t < count - 1 ? t + 1 : count - 1;
  return b > a ? kg_vec3_norm(kg_vec3_sub(x[b], x[a])) / ((b - a) * dt) : 0.0;
}

/* slow frames, then the low ones among them */
static void find_stance(foot_path *path, double dt)
{
  const int n = path->count;
  for (int t = 0; t < n; t++) {
    path->speed[t] = fmax(speed_at(path->toe, t, n, dt), speed_at(path->ankle, t, n, dt));
    path->sorted[t] = path->speed[t];
  }
  double slow = fmax(SLOW_M_PER_S, quantile(path->sorted, n, SLOWEST_SHARE));
  slow = slow > RESTLESS_M_PER_S ? INFINITY : slow;
  int slow_count = 0;
  for (int t = 0; t < n; t++) {
    if (path->speed[t] <= slow) {
      path->sorted[slow_count++] = path->toe[t].y;
    }
  }
  const double lowest = quantile(path->sorted, slow_count, 0.1);
  path->stance_count = 0;
  for (int t = 0; t < n; t++) {
    path->stance[t] = path->speed[t] <= slow && path->toe[t].y <= lowest + LOW_M;
    path->stance_count += path->stance[t];
  }
}

static double median_toe_height(foot_path *path)
{
  int n = 0;
  for (int t = 0; t < path->count; t++) {
    if (path->stance[t]) {
      path->sorted[n++] = path->toe[t].y;
    }
  }
  return n > 0 ? quantile(path->sorted, n, 0.5) : 0.0;
}

/* A foot held in the air is slow too: where one foot rests far above the other, it never stands. */
static void drop_raised_foot(foot_path feet[2])
{
  const double left = median_toe_height(&feet[0]), right = median_toe_height(&feet[1]);
  if (fabs(left - right) > RAISED_M) {
    foot_path *raised = &feet[left > right ? 0 : 1];
    memset(raised->stance, 0, (size_t)raised->count * sizeof *raised->stance);
    raised->stance_count = 0;
  }
}

/* Solves the symmetric 4x4 system A x = b in place by Gauss-Jordan elimination. A is made positive
 * definite by the priors, so no pivoting is needed. */
static void solve4(double A[4][4], double b[4])
{
  for (int i = 0; i < 4; i++) {
    const double pivot = 1.0 / A[i][i];
    for (int j = 0; j < 4; j++) {
      A[i][j] *= pivot;
    }
    b[i] *= pivot;
    for (int k = 0; k < 4; k++) {
      if (k != i) {
        const double factor = A[k][i];
        for (int j = 0; j < 4; j++) {
          A[k][j] -= factor * A[i][j];
        }
        b[k] -= factor * b[i];
      }
    }
  }
}

/* y = height_foot + sx (x - x0) + sz (z - z0) through the toe joints in stance, slopes with a
 * prior; three rounds of Huber weights against outliers. Writes heights and slopes. */
static void fit_plane(const foot_path feet[2], kg_vec3 center, double heights[2], double slope[2])
{
  heights[0] = heights[1] = slope[0] = slope[1] = 0.0;
  for (int round = 0; round < 4; round++) {
    double A[4][4] = {{0.0}}, b[4] = {0.0};
    A[2][2] = A[3][3] = HEIGHT_NOISE_M * HEIGHT_NOISE_M / (SLOPE_PRIOR * SLOPE_PRIOR);
    for (int f = 0; f < 2; f++) {
      A[f][f] += 1e-9;
      for (int t = 0; t < feet[f].count; t++) {
        if (!feet[f].stance[t]) {
          continue;
        }
        const kg_vec3 p = feet[f].toe[t];
        const double row[4] = {f == 0, f == 1, p.x - center.x, p.z - center.z};
        const double r = fabs(p.y - heights[f] - slope[0] * row[2] - slope[1] * row[3]);
        /* consecutive frames repeat each other: a stance frame counts as a tenth */
        const double weight = round == 0 ? 0.1 : 0.1 * fmin(1.0, HEIGHT_NOISE_M / fmax(r, 1e-9));
        for (int i = 0; i < 4; i++) {
          for (int j = 0; j < 4; j++) {
            A[i][j] += weight * row[i] * row[j];
          }
          b[i] += weight * row[i] * p.y;
        }
      }
    }
    solve4(A, b);
    heights[0] = b[0];
    heights[1] = b[1];
    slope[0] = fmax(-SLOPE_LIMIT, fmin(SLOPE_LIMIT, b[2]));
    slope[1] = fmax(-SLOPE_LIMIT, fmin(SLOPE_LIMIT, b[3]));
  }
}

static double height_above(const kg_floor *floor, kg_vec3 p)
{
  const kg_vec3 point = kg_vec3_make(0.0, floor->height, 0.0);
  return kg_vec3_dot(floor->normal, kg_vec3_sub(p, point));
}

static double clamped(double x, double low, double high)
{
  return fmax(low, fmin(high, x));
}

/* means over the stance frames of one foot; false without any */
static bool fit_foot(kg_foot_fit *fit, foot_path *path, const kg_floor *floor)
{
  kg_vec3 up_ankle = {0}, up_toe = {0}, forward = {0};
  int n = 0;
  for (int t = 0; t < path->count; t++) {
    if (!path->stance[t]) {
      continue;
    }
    const kg_quat to_ankle = kg_quat_conj(path->ankle_q[t]);
    up_ankle = kg_vec3_add(up_ankle, kg_quat_rotate(to_ankle, floor->normal));
    up_toe = kg_vec3_add(up_toe, kg_quat_rotate(kg_quat_conj(path->toe_q[t]), floor->normal));
    forward =
      kg_vec3_add(forward, kg_quat_rotate(to_ankle, kg_vec3_sub(path->toe[t], path->ankle[t])));
    path->sorted[n++] = height_above(floor, path->ankle[t]);
  }
  if (n == 0) {
    return false;
  }
  fit->ankle_height = clamped(quantile(path->sorted, n, 0.5), 0.03, LARGEST_HEIGHT_M);
  n = 0;
  for (int t = 0; t < path->count; t++) {
    if (path->stance[t]) {
      path->sorted[n++] = height_above(floor, path->toe[t]);
    }
  }
  fit->toe_height = clamped(quantile(path->sorted, n, 0.5), SMALLEST_HEIGHT_M, LARGEST_HEIGHT_M);
  fit->up_ankle = kg_vec3_normalized(up_ankle);
  fit->up_toe = kg_vec3_normalized(up_toe);
  forward = kg_vec3_add_scaled(forward, -kg_vec3_dot(forward, fit->up_ankle), fit->up_ankle);
  fit->forward = kg_vec3_normalized(forward);
  return true;
}

static int toe_or_ankle(const kg_mapping *mapping, int side)
{
  const int toe = mapping->joint_of_role[side == 0 ? KG_ROLE_L_TOE : KG_ROLE_R_TOE];
  return toe >= 0 ? toe : mapping->joint_of_role[side == 0 ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE];
}

/* world paths of the four joints, positions smoothed */
static bool read_paths(foot_path feet[2], kg_arena *arena, const kg_clip *clip,
                       const kg_mapping *mapping)
{
  const int first = clip->source.first_frame;
  const int count = clip->frame_count - first;
  kg_vec3 *p = KG_ARENA_ARRAY(arena, kg_vec3, clip->joint_count);
  kg_quat *q = KG_ARENA_ARRAY(arena, kg_quat, clip->joint_count);
  double *work =
    KG_ARENA_ARRAY(arena, double, kg_filter_work_size(count, 1.0 / clip->frame_time, SMOOTHING_HZ));
  if (!foot_path_create(&feet[0], arena, count) || !foot_path_create(&feet[1], arena, count)) {
    return false;
  }
  for (int t = 0; t < count; t++) {
    kg_clip_world(clip, first + t, p, q);
    for (int f = 0; f < 2; f++) {
      const int ankle = mapping->joint_of_role[f == 0 ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE];
      const int toe = toe_or_ankle(mapping, f);
      feet[f].ankle[t] = p[ankle];
      feet[f].ankle_q[t] = q[ankle];
      feet[f].toe[t] = p[toe];
      feet[f].toe_q[t] = q[toe];
    }
  }
  for (int f = 0; f < 2; f++) {
    for (int k = 0; k < 3; k++) {
      kg_filter_lowpass(&feet[f].ankle[0].x + k, count, 3, 1.0 / clip->frame_time, SMOOTHING_HZ,
                        work);
      kg_filter_lowpass(&feet[f].toe[0].x + k, count, 3, 1.0 / clip->frame_time, SMOOTHING_HZ,
                        work);
    }
    find_stance(&feet[f], clip->frame_time);
  }
  drop_raised_foot(feet);
  return true;
}

/* median of the ankle above the toe joint along y in stance */
static double ankle_above_toe(foot_path *path)
{
  int n = 0;
  for (int t = 0; t < path->count; t++) {
    if (path->stance[t]) {
      path->sorted[n++] = path->ankle[t].y - path->toe[t].y;
    }
  }
  return quantile(path->sorted, n, 0.5);
}

/* floor below the toes' plane: deep enough for the clearance of toe and ankle of the lower foot */
static double floor_below(foot_path feet[2], const double heights[2], double scale)
{
  double below[2];
  for (int f = 0; f < 2; f++) {
    if (feet[f].stance_count == 0) {
      below[f] = INFINITY;
      continue;
    }
    below[f] = heights[f] + fmin(-TOE_CLEARANCE_M * scale,
                                 ankle_above_toe(&feet[f]) - ANKLE_CLEARANCE_M * scale);
  }
  const double lower = fmin(below[0], below[1]), higher = fmax(below[0], below[1]);
  return isfinite(higher) ? fmax(lower, higher - FEET_DISAGREE_M) : lower;
}

/* The fit of the other foot, seen in the mirror that takes one leg's rest offsets to the other's. */
static kg_foot_fit mirrored_fit(const kg_foot_fit *fit, const kg_clip *clip,
                                const kg_mapping *mapping)
{
  const kg_vec3 left = clip->joints[toe_or_ankle(mapping, 0)].offset;
  const kg_vec3 right = clip->joints[toe_or_ankle(mapping, 1)].offset;
  const kg_vec3 shank_left = clip->joints[mapping->joint_of_role[KG_ROLE_L_ANKLE]].offset;
  const kg_vec3 shank_right = clip->joints[mapping->joint_of_role[KG_ROLE_R_ANKLE]].offset;
  const kg_vec3 mirrors[4] = {{-1, 1, 1}, {1, 1, 1}, {1, -1, 1}, {1, 1, -1}};
  kg_vec3 best = mirrors[0];
  double least = INFINITY;
  for (int k = 0; k < 4; k++) {
    const kg_vec3 m = mirrors[k];
    const kg_vec3 a = kg_vec3_make(m.x * left.x, m.y * left.y, m.z * left.z);
    const kg_vec3 b = kg_vec3_make(m.x * shank_left.x, m.y * shank_left.y, m.z * shank_left.z);
    const double error =
      kg_vec3_norm(kg_vec3_sub(a, right)) + kg_vec3_norm(kg_vec3_sub(b, shank_right));
    if (error < least) {
      least = error;
      best = m;
    }
  }
  kg_foot_fit out = *fit;
  kg_vec3 *directions[3] = {&out.up_ankle, &out.up_toe, &out.forward};
  for (int k = 0; k < 3; k++) {
    kg_vec3 *d = directions[k];
    *d = kg_vec3_make(best.x * d->x, best.y * d->y, best.z * d->z);
  }
  return out;
}

/* length of the left and right shank over that of a 1.75 m person (0.246 of the stature) */
static double body_scale(const kg_clip *clip, const kg_mapping *mapping, kg_vec3 *p)
{
  kg_clip_world(clip, clip->source.first_frame, p, NULL);
  const int *joint = mapping->joint_of_role;
  const double left =
    kg_vec3_norm(kg_vec3_sub(p[joint[KG_ROLE_L_KNEE]], p[joint[KG_ROLE_L_ANKLE]]));
  const double right =
    kg_vec3_norm(kg_vec3_sub(p[joint[KG_ROLE_R_KNEE]], p[joint[KG_ROLE_R_ANKLE]]));
  return clamped(0.5 * (left + right) / (0.246 * 1.75), 0.5, 1.4);
}

static double median_deviation(const foot_path feet[2], const kg_floor *floor, double *scratch)
{
  int n = 0;
  for (int f = 0; f < 2; f++) {
    for (int t = 0; t < feet[f].count; t++) {
      if (feet[f].stance[t]) {
        scratch[n++] = fabs(height_above(floor, feet[f].toe[t]) - floor->feet[f].toe_height);
      }
    }
  }
  return n > 0 ? quantile(scratch, n, 0.5) : 0.0;
}

kg_status kg_floor_estimate(kg_floor *floor, const kg_clip *clip, const kg_mapping *mapping)
{
  kg_arena arena;
  kg_arena_init(&arena, clip->allocator);
  foot_path feet[2];
  kg_vec3 *p = KG_ARENA_ARRAY(&arena, kg_vec3, clip->joint_count);
  double *scratch = KG_ARENA_ARRAY(&arena, double, 2 * clip->frame_count);
  if (!p || !scratch || !read_paths(feet, &arena, clip, mapping)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }

  /* 2. plane */
  kg_vec3 center = {0};
  floor->stance_frames = 0;
  for (int f = 0; f < 2; f++) {
    for (int t = 0; t < feet[f].count; t++) {
      if (feet[f].stance[t]) {
        center = kg_vec3_add(center, feet[f].toe[t]);
      }
    }
    floor->stance_frames += feet[f].stance_count;
  }
  center = kg_vec3_scale(1.0 / fmax(1, floor->stance_frames), center);
  double heights[2], slope[2];
  fit_plane(feet, center, heights, slope);

  /* 3. floor */
  floor->normal = kg_vec3_make(0.0, 1.0, 0.0);
  if (!floor->given) {
    const double level = floor_below(feet, heights, body_scale(clip, mapping, p));
    floor->height = level - slope[0] * center.x - slope[1] * center.z;
    floor->normal = kg_vec3_normalized(kg_vec3_make(-slope[0], 1.0, -slope[1]));
  }
  floor->tilt = acos(fmin(1.0, floor->normal.y));

  /* 4. feet; one that never stands gets the other's fit */
  const bool left = fit_foot(&floor->feet[0], &feet[0], floor);
  const bool right = fit_foot(&floor->feet[1], &feet[1], floor);
  if (!left && right) {
    floor->feet[0] = mirrored_fit(&floor->feet[1], clip, mapping);
  } else if (!right && left) {
    floor->feet[1] = mirrored_fit(&floor->feet[0], clip, mapping);
  }
  floor->spread = median_deviation(feet, floor, scratch);
  kg_arena_release(&arena);
  return KG_OK;
}
