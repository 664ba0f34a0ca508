/* What a motion file does not say: the unit of length, which axis is up, and whether frame 0 is a
 * pose that an exporter put in front of the motion.
 *
 * Unit: thigh and shank make up 0.491 of an adult's stature (R. Drillis, R. Contini, Body segment
 * parameters, 1966, as in D. Winter, Biomechanics and Motor Control of Human Movement, fig. 4.1:
 * thigh 0.245, shank 0.246). The common units are far enough apart that at most one of them gives
 * a stature between 1.4 and 2.1 m.
 *
 * Up: the mean direction from the feet to the head over the motion, which is a world axis for
 * anyone who mostly stands, beside the same direction in the rest pose.
 *
 * Inserted frame: the step from frame 0 to frame 1 is far larger than the steps after it and than
 * the median step. A
 * motion that starts in a T-pose and leaves it smoothly has no such step. */
#include "mocap/mocap.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double leg_per_stature = 0.491;
static const double least_stature = 1.4, greatest_stature = 2.1, usual_stature = 1.7; /* m */

typedef struct unit_choice {
  double metres;
  const char *name;
} unit_choice;

static const unit_choice units[] = {
  {1.0, "m"},       {0.01, "cm"}, {0.001, "mm"},
  {0.0254, "inch"}, {0.1, "dm"},  {0.0254 / 0.45, "CMU (1/0.45 inch)"},
};

/* Raw clip: joints' offsets and values as in the file. */
typedef struct body_joints {
  int head, hip[2], knee[2], ankle[2];
} body_joints;

/* KG_ERR_UNMAPPED: no known body */
static kg_status find_body(body_joints *body, const kg_clip *clip)
{
  kg_mapping mapping;
  const kg_status status = kg_mapping_find(&mapping, clip, NULL, NULL);
  const int *joint = mapping.joint_of_role;
  *body = (body_joints){joint[KG_ROLE_HEAD],
                        {joint[KG_ROLE_L_HIP], joint[KG_ROLE_R_HIP]},
                        {joint[KG_ROLE_L_KNEE], joint[KG_ROLE_R_KNEE]},
                        {joint[KG_ROLE_L_ANKLE], joint[KG_ROLE_R_ANKLE]}};
  return status;
}

/* ---- poses in file units and axes ------------------------------------------------------------- */

/* position of one joint; frame -1 is the rest pose (no rotations, offsets only) */
static kg_vec3 raw_position(const kg_clip *clip, int frame, int joint)
{
  kg_vec3 p = kg_vec3_make(0.0, 0.0, 0.0);
  for (int j = joint; j >= 0; j = clip->joints[j].parent) {
    const kg_joint *of = &clip->joints[j];
    if (frame < 0) {
      p = kg_vec3_add(p, of->offset);
      continue;
    }
    const double *values =
      clip->values + (size_t)frame * (size_t)clip->channel_count + of->first_channel;
    if (j != joint) {
      p = kg_quat_rotate(kg_euler_to_quat(of, values), p);
    }
    p = kg_vec3_add(p, kg_joint_translation(of, of->offset, values));
  }
  return p;
}

static kg_vec3 between_feet(const kg_clip *clip, const body_joints *body, int frame)
{
  const kg_vec3 l = raw_position(clip, frame, body->ankle[0]);
  return kg_vec3_lerp(l, raw_position(clip, frame, body->ankle[1]), 0.5);
}

/* ---- unit ------------------------------------------------------------------------------------- */

/* length of the chain from a joint up to one of its ancestors, in the rest pose */
static double chain_length(const kg_clip *clip, int joint, int ancestor)
{
  double length = 0.0;
  for (int j = joint; j >= 0 && j != ancestor; j = clip->joints[j].parent) {
    length += kg_vec3_norm(clip->joints[j].offset);
  }
  return length;
}

/* in file units; without a mapping, the largest side of the box around the rest pose */
static double stature_in_units(const kg_clip *clip, const body_joints *body)
{
  if (body) {
    double legs = 0.0;
    for (int i = 0; i < 2; i++) {
      legs += chain_length(clip, body->ankle[i], body->hip[i]);
    }
    return 0.5 * legs / leg_per_stature;
  }
  kg_vec3 low = kg_vec3_make(0.0, 0.0, 0.0), high = low;
  for (int j = 0; j < clip->joint_count; j++) {
    const kg_vec3 p = kg_vec3_sub(raw_position(clip, -1, j), raw_position(clip, -1, 0));
    low = kg_vec3_make(fmin(low.x, p.x), fmin(low.y, p.y), fmin(low.z, p.z));
    high = kg_vec3_make(fmax(high.x, p.x), fmax(high.y, p.y), fmax(high.z, p.z));
  }
  const kg_vec3 size = kg_vec3_sub(high, low);
  return fmax(size.x, fmax(size.y, size.z));
}

static bool is_plausible(double stature_m)
{
  return stature_m >= least_stature && stature_m <= greatest_stature;
}

static const unit_choice *nearest_unit(double stature)
{
  const unit_choice *best = &units[0];
  for (size_t i = 1; i < KG_COUNT_OF(units); i++) {
    if (fabs(log(stature * units[i].metres / usual_stature)) <
        fabs(log(stature * best->metres / usual_stature))) {
      best = &units[i];
    }
  }
  return best;
}

static void choose_unit(kg_clip *clip, const kg_clip_def *def, const body_joints *body,
                        double stated)
{
  kg_clip_source *source = &clip->source;
  const double stature = stature_in_units(clip, body);
  char *reason = source->unit_reason;
  const size_t size = sizeof source->unit_reason;
  if (def->unit_m > 0.0) {
    source->unit_m = def->unit_m;
    source->unit_given = true;
    snprintf(reason, size, "given: stature %.2f m", stature * def->unit_m);
    return;
  }
  if (stated > 0.0 && (is_plausible(stature * stated) || !(stature > 0.0))) {
    source->unit_m = stated;
    snprintf(reason, size, "stated in the skeleton (1/%.4g inch): stature %.2f m", 0.0254 / stated,
             stature * stated);
    return;
  }
  if (!(stature > 0.0) || !isfinite(stature)) {
    source->unit_m = 0.01;
    snprintf(reason, size, "cm assumed: the skeleton has no size");
    kg_clip_warn(clip, NULL, "%s: the skeleton has no size; the unit is taken as cm", source->path);
    return;
  }
  const unit_choice *unit = nearest_unit(stature);
  source->unit_m = unit->metres;
  snprintf(reason, size, "%s: stature %.2f m", unit->name, stature * unit->metres);
  if (!is_plausible(stature * unit->metres)) {
    kg_clip_warn(clip, NULL,
                 "%s: no common unit gives an adult's stature; %s gives %.2f m; is it right?",
                 source->path, unit->name, stature * unit->metres);
  }
}

/* ---- up axis ---------------------------------------------------------------------------------- */

static kg_up_axis dominant_axis(kg_vec3 v)
{
  const double x = fabs(v.x), y = fabs(v.y), z = fabs(v.z);
  return y >= x && y >= z ? KG_UP_Y : z >= x ? KG_UP_Z : KG_UP_X;
}

static double along(kg_vec3 v, kg_up_axis axis)
{
  return axis == KG_UP_Y ? v.y : axis == KG_UP_Z ? v.z : v.x;
}

/* Mean over frames of the unit vector from feet to head, and the lowest ankle along each axis. */
static kg_vec3 mean_upright(const kg_clip *clip, const body_joints *body, double lowest[3])
{
  const int stride = 1 + (clip->frame_count - 1) / 500;
  kg_vec3 sum = kg_vec3_make(0.0, 0.0, 0.0);
  int count = 0;
  lowest[0] = lowest[1] = lowest[2] = INFINITY;
  for (int t = clip->frame_count > 1 ? 1 : 0; t < clip->frame_count; t += stride, count++) {
    const kg_vec3 feet = between_feet(clip, body, t);
    const kg_vec3 head = raw_position(clip, t, body->head);
    sum = kg_vec3_add(sum, kg_vec3_normalized(kg_vec3_sub(head, feet)));
    for (int axis = 0; axis < 3; axis++) {
      lowest[axis] = fmin(lowest[axis], along(feet, (kg_up_axis)axis));
    }
  }
  return kg_vec3_scale(1.0 / count, sum);
}

static void choose_up(kg_clip *clip, const kg_clip_def *def, const body_joints *body)
{
  kg_clip_source *source = &clip->source;
  source->up = KG_UP_Y;
  source->up_given = def->up_given;
  if (def->up_given) {
    source->up = def->up;
    return;
  }
  if (!body) {
    return; /* BVH is Y up by custom */
  }
  const kg_vec3 rest =
    kg_vec3_sub(raw_position(clip, -1, body->head), between_feet(clip, body, -1));
  double lowest[3];
  const kg_vec3 mean = mean_upright(clip, body, lowest);
  const kg_up_axis in_rest = dominant_axis(rest), in_motion = dominant_axis(mean);
  source->up = in_rest;
  if (in_motion == in_rest) {
    if (along(mean, in_rest) < -0.5) {
      kg_clip_warn(clip, NULL, "%s: the head is below the feet; is the up axis right?",
                   source->path);
    }
    return;
  }
  /* Lying down for a whole clip, or another up axis than in the rest pose? Someone who stands has
   * feet near the ground plane and a steady direction. */
  const double stature = stature_in_units(clip, body);
  if (along(mean, in_motion) > 0.8 && fabs(lowest[in_motion]) < 0.25 * stature) {
    source->up = in_motion;
  }
  if (source->up != KG_UP_Y || in_rest == KG_UP_Y) { /* y is the custom: nothing to say */
    kg_clip_warn(clip, NULL, "%s: rest pose and motion disagree on the up axis; %c is taken",
                 source->path, "YZX"[source->up]);
  }
}

static kg_quat rotation_to_y_up(kg_up_axis up)
{
  const double h = 0.70710678118654752440; /* quarter turns: z to y about x, x to y about z */
  return up == KG_UP_Y   ? kg_quat_identity()
         : up == KG_UP_Z ? kg_quat_make(h, -h, 0.0, 0.0)
                         : kg_quat_make(h, 0.0, 0.0, h);
}

/* ---- inserted first frame --------------------------------------------------------------------- */

/* mean angle (rad) by which the joints below the roots turn from frame t to t + 1 */
static double mean_turn(const kg_clip *clip, int t)
{
  const size_t C = (size_t)clip->channel_count;
  double sum = 0.0;
  int count = 0;
  for (int j = 0; j < clip->joint_count; j++) {
    const kg_joint *joint = &clip->joints[j];
    if (joint->parent < 0 || joint->channel_count == 0) {
      continue;
    }
    const double *values = clip->values + (size_t)t * C + joint->first_channel;
    const kg_quat a = kg_euler_to_quat(joint, values), b = kg_euler_to_quat(joint, values + C);
    sum += kg_vec3_norm(kg_quat_log(kg_quat_mul(kg_quat_conj(a), b)));
    count++;
  }
  return count > 0 ? sum / count : 0.0;
}

static int compare_doubles(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void find_inserted_frame(kg_clip *clip, const kg_clip_def *def)
{
  enum { MOST_STEPS = 200, LEAST_STEPS = 3, NEXT_STEPS = 5 };
  const double least_jump = 0.1, times_usual = 4.0; /* rad, mean over joints */
  kg_clip_source *source = &clip->source;
  const int steps = clip->frame_count - 2; /* those after the first */
  source->first_frame = 0;
  if (def->keep_first_frame) {
    snprintf(source->first_frame_reason, sizeof source->first_frame_reason, "kept as given");
    return;
  }
  if (steps < LEAST_STEPS) {
    snprintf(source->first_frame_reason, sizeof source->first_frame_reason, "too short to tell");
    return;
  }
  double turn[MOST_STEPS], next = 0.0;
  const int count = steps < MOST_STEPS ? steps : MOST_STEPS;
  for (int k = 0; k < count; k++) {
    turn[k] = mean_turn(clip, 1 + (int)((long)k * (steps - 1) / (count > 1 ? count - 1 : 1)));
  }
  qsort(turn, (size_t)count, sizeof turn[0], compare_doubles);
  for (int t = 1; t <= steps && t <= NEXT_STEPS; t++) {
    next = fmax(next, mean_turn(clip, t));
  }
  const double usual = fmax(turn[count / 2], next), jump = mean_turn(clip, 0);
  if (jump > least_jump && jump > times_usual * usual) {
    source->first_frame = 1;
  }
  snprintf(source->first_frame_reason, sizeof source->first_frame_reason,
           "joints turn %.2g deg to frame 1, then at most %.2g", jump * 57.29577951308232,
           usual * 57.29577951308232);
}

kg_status kg_clip_estimate(kg_clip *clip, const kg_clip_def *def, double stated_unit_m)
{
  body_joints body;
  const kg_status status = find_body(&body, clip);
  const body_joints *found = status == KG_OK ? &body : NULL;
  if (status == KG_ERR_NO_MEMORY) {
    return status;
  }
  choose_unit(clip, def, found, stated_unit_m);
  choose_up(clip, def, found);
  kg_clip_private(clip)->up = rotation_to_y_up(clip->source.up);
  find_inserted_frame(clip, def);
  return KG_OK;
}
