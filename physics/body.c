/* The body of a captured clip: segments, lengths, masses, inertias. docs/theory/body.md has the
 * table of shares and the reasons.
 *
 * All geometry is decided in one reference posture, in which every segment has its mean rotation
 * (over the motion) relative to its parent; so no convention about local frames or rest poses is
 * needed. Parts of de Leva's table are uniform bars (deleva.h) laid along the reference posture;
 * a bar that spans several segments is cut, and each segment collects the moments
 *   m = int dm,   s = int x dm,   S = int x x' dm
 * of its slices, from which com = s / m and I = tr(C) E - C with C = S - m com com'. */
#include "physics/body_build.h"

#include <stdio.h>
#include <string.h>

#include "physics/deleva.h"
#include "physics/physics.h"

/* shares of our own: what the table does not have */
static const double NECK_SHARE = 0.20;     /* of the head-and-neck bar, its lower end            */
static const double CLAVICLE_SHARE = 0.10; /* of the upper trunk's mass, each side               */
static const double LEAST_SHARE = 1e-3;    /* of the body's mass, for a segment without extent   */

/* anthropometric ratios, mean of the sexes of the table unless said otherwise */
static const double LEG_OF_STATURE = 0.4803;     /* hip to knee to ankle joint centre            */
static const double UPRIGHT_OF_STATURE = 0.9708; /* leg, mid-hip to cervicale to vertex         */
static const double TRUNK_OF_STATURE = 0.3504;   /* mid-hip to cervicale                         */
static const double ANKLE_OF_STATURE = 0.039;    /* malleolus above the ground [WINTER, Fig. 4.1] */
static const double HAND_OF_STATURE = 0.103;     /* wrist to fingertip                           */
static const double HEAD_OF_STATURE = 0.140;     /* cervicale to vertex                          */
static const double TRUNK_OF_SHOULDERS =
  1.202;                                     /* mid-hip to cervicale over mid-hip to mid-shoulder */
static const double FOOT_OF_STATURE = 0.152; /* [WINTER, Fig. 4.1] */
static const double HEEL_OF_FOOT = 0.27;     /* heel behind the ankle joint                  */
static const double BALL_OF_FOOT = 0.73;     /* heel to the metatarsal heads                 */

typedef struct moments {
  double m;
  kg_vec3 s;
  kg_mat3 S;
} moments;

/* ---- segments and the reference posture ------------------------------------------------------ */

static int nearest_segment_above(const kg_build *b, const kg_clip *clip, int joint)
{
  for (int j = clip->joints[joint].parent; j >= 0; j = clip->joints[j].parent) {
    for (int i = 0; i < b->n; i++) {
      if (b->segments[i].joint == j) {
        return i;
      }
    }
  }
  return -1;
}

/* Clip joints come in depth-first order, and so do the segments. */
static kg_status collect_segments(kg_build *b, const kg_clip *clip, const kg_mapping *mapping,
                                  kg_error *error)
{
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    b->segment_of_role[r] = -1;
  }
  for (int j = 0; j < clip->joint_count; j++) {
    for (int r = 0; r < KG_ROLE_COUNT; r++) {
      if (mapping->joint_of_role[r] != j) {
        continue;
      }
      const int parent = nearest_segment_above(b, clip, j);
      if (parent < 0 && b->n > 0) {
        return kg_fail(error, KG_ERR_UNMAPPED, clip->source.path, 0, 0,
                       "joint \"%s\" (%s) does not descend from joint \"%s\" (%s)",
                       clip->joints[j].name, kg_role_name((kg_role)r),
                       clip->joints[b->segments[0].joint].name, b->segments[0].name);
      }
      kg_segment *segment = &b->segments[b->n];
      *segment = (kg_segment){.role = r, .joint = j, .parent = parent};
      snprintf(segment->name, sizeof segment->name, "%s", kg_role_name((kg_role)r));
      b->segment_of_role[r] = b->n++;
      break;
    }
  }
  return KG_OK;
}

/* Mean offset and rotation of every segment relative to its parent over the motion frames. The
 * mean rotation is the normalised sum of sign-aligned quaternions. */
static kg_status measure_posture(kg_build *b, const kg_clip *clip, kg_error *error)
{
  const int first = clip->source.first_frame < clip->frame_count ? clip->source.first_frame : 0;
  double longest = 0.0;
  for (int i = 0; i < b->n; i++) {
    kg_segment *segment = &b->segments[i];
    const int top = segment->parent < 0 ? -1 : b->segments[segment->parent].joint;
    kg_vec3 sum = {0.0, 0.0, 0.0};
    kg_quat turn = {0.0, 0.0, 0.0, 0.0};
    for (int t = first; t < clip->frame_count; t++) {
      const kg_quat *r = clip->rotations + (ptrdiff_t)t * clip->joint_count;
      const kg_vec3 *p = clip->translations + (ptrdiff_t)t * clip->joint_count;
      kg_vec3 position = {0.0, 0.0, 0.0};
      kg_quat rotation = kg_quat_identity();
      for (int j = segment->joint; j != top && j >= 0; j = clip->joints[j].parent) {
        position = kg_vec3_add(p[j], kg_quat_rotate(r[j], position));
        rotation = kg_quat_mul(r[j], rotation);
      }
      sum = kg_vec3_add(sum, position);
      const double sign = kg_quat_dot(rotation, turn) < 0.0 ? -1.0 : 1.0;
      turn = kg_quat_make(turn.w + sign * rotation.w, turn.x + sign * rotation.x,
                          turn.y + sign * rotation.y, turn.z + sign * rotation.z);
    }
    if (i == 0) {
      b->p[0] = kg_vec3_make(0.0, 0.0, 0.0);
      b->R[0] = kg_quat_identity();
      continue;
    }
    segment->offset = kg_vec3_scale(1.0 / (clip->frame_count - first), sum);
    const int parent = segment->parent;
    b->p[i] = kg_vec3_add(b->p[parent], kg_quat_rotate(b->R[parent], segment->offset));
    b->R[i] = kg_quat_normalized(kg_quat_mul(b->R[parent], kg_quat_normalized(turn)));
    const double length = kg_vec3_norm(segment->offset);
    if (!isfinite(length)) {
      return kg_fail(error, KG_ERR_FORMAT, clip->source.path, 0, 0,
                     "the distance from \"%s\" to its parent is not a finite number",
                     clip->joints[segment->joint].name);
    }
    longest = fmax(longest, length);
  }
  if (!(longest > 0.0)) {
    return kg_fail(error, KG_ERR_FORMAT, clip->source.path, 0, 0,
                   "every bone has length zero; a skeleton with offsets was expected");
  }
  return KG_OK;
}

void kg_build_across(kg_vec3 axis, kg_vec3 front, kg_vec3 other, kg_vec3 *a, kg_vec3 *side)
{
  kg_vec3 f = kg_vec3_add_scaled(front, -kg_vec3_dot(front, axis), axis);
  if (kg_vec3_norm(f) < 0.2) {
    f = kg_vec3_add_scaled(other, -kg_vec3_dot(other, axis), axis);
  }
  *a = kg_vec3_normalized(f);
  *side = kg_vec3_cross(axis, *a);
}

static kg_vec3 middle(kg_vec3 a, kg_vec3 b)
{
  return kg_vec3_lerp(a, b, 0.5);
}

static double length_between(const kg_build *b, kg_role from, kg_role to)
{
  const int i = kg_build_segment(b, from), j = kg_build_segment(b, to);
  return i < 0 || j < 0 ? 0.0 : kg_vec3_norm(kg_vec3_sub(b->p[j], b->p[i]));
}

static kg_vec3 joint_of(const kg_build *b, kg_role role, kg_vec3 otherwise)
{
  const int i = kg_build_segment(b, role);
  return i < 0 ? otherwise : b->p[i];
}

/* Farthest end of the hierarchy below a joint with all rotations at rest, in the joint's frame. */
static kg_vec3 farthest_below(const kg_clip *clip, int joint)
{
  kg_vec3 far = {0.0, 0.0, 0.0};
  double best = 0.0;
  for (int j = joint; j < clip->joint_count; j++) {
    kg_vec3 p = clip->joints[j].has_end_site ? clip->joints[j].end_site : far;
    if (!clip->joints[j].has_end_site) {
      p = kg_vec3_make(0.0, 0.0, 0.0);
    }
    int k = j;
    for (; k > joint; k = clip->joints[k].parent) {
      p = kg_vec3_add(p, clip->joints[k].offset);
    }
    const double d = kg_vec3_norm(p);
    if (k == joint && d > best) { /* a descendant, or the joint itself */
      best = d;
      far = p;
    }
  }
  return far;
}

static void measure_trunk(kg_build *b)
{
  const kg_vec3 root = b->p[0];
  const kg_vec3 l_hip = joint_of(b, KG_ROLE_L_HIP, root), r_hip = joint_of(b, KG_ROLE_R_HIP, root);
  const kg_vec3 l_arm = joint_of(b, KG_ROLE_L_SHOULDER, root);
  const kg_vec3 r_arm = joint_of(b, KG_ROLE_R_SHOULDER, root);
  b->mid_hip = middle(l_hip, r_hip);
  b->mid_shoulder = middle(l_arm, r_arm);
  const kg_vec3 spine = kg_vec3_sub(b->mid_shoulder, b->mid_hip);
  const double length = kg_vec3_norm(spine);
  b->up = length > 1e-6 ? kg_vec3_scale(1.0 / length, spine) : kg_vec3_make(0.0, 1.0, 0.0);
  const kg_vec3 across = kg_vec3_add(kg_vec3_sub(l_hip, r_hip), kg_vec3_sub(l_arm, r_arm));
  kg_build_across(b->up, across, kg_vec3_make(1.0, 0.0, 0.0), &b->left, &b->forward);
  b->forward = kg_vec3_cross(b->left, b->up);
  b->trunk_length = TRUNK_OF_SHOULDERS * length;
  b->neck = kg_vec3_add_scaled(b->mid_hip, b->trunk_length, b->up);
}

/* The larger of two estimates: from the legs alone, and from legs, trunk and head together.
 * Capture skeletons lose length (coinciding joints, a head without end) and seldom gain any. */
static void estimate_stature(kg_build *b, const kg_clip *clip)
{
  const double left = length_between(b, KG_ROLE_L_HIP, KG_ROLE_L_KNEE) +
                      length_between(b, KG_ROLE_L_KNEE, KG_ROLE_L_ANKLE);
  const double right = length_between(b, KG_ROLE_R_HIP, KG_ROLE_R_KNEE) +
                       length_between(b, KG_ROLE_R_KNEE, KG_ROLE_R_ANKLE);
  const double leg = 0.5 * (left + right);
  const double from_leg = leg / LEG_OF_STATURE;
  const double head_length = HEAD_OF_STATURE * from_leg;
  double upper = b->trunk_length + head_length;
  const int head = kg_build_segment(b, KG_ROLE_HEAD);
  if (head >= 0) {
    const double end = kg_vec3_norm(farthest_below(clip, b->segments[head].joint));
    const double neck = kg_vec3_norm(kg_vec3_sub(b->p[head], b->mid_hip));
    upper = fmax(b->trunk_length, neck + fmin(end, head_length));
  }
  const double whole = (leg + upper) / UPRIGHT_OF_STATURE;
  b->stature = fmax(from_leg, fmin(whole, 1.25 * from_leg));
  if (!(b->stature > 0.0)) {
    b->stature = b->trunk_length / TRUNK_OF_STATURE;
  }
}

/* From the head joint to its end site when that is believable, else upwards. */
static void measure_head(kg_build *b, const kg_clip *clip)
{
  const double H = b->stature;
  b->head_up = b->up;
  b->vertex = kg_vec3_add_scaled(b->neck, HEAD_OF_STATURE * H, b->up);
  const int head = kg_build_segment(b, KG_ROLE_HEAD);
  if (head < 0) {
    return;
  }
  const kg_vec3 end = farthest_below(clip, b->segments[head].joint);
  const double length = kg_vec3_norm(end);
  if (length > 0.04 * H && length < 0.16 * H) {
    b->head_up = kg_vec3_normalized(kg_quat_rotate(b->R[head], end));
    b->vertex = kg_vec3_add_scaled(b->p[head], length, b->head_up);
  } else {
    b->vertex = kg_vec3_add_scaled(b->p[head], 0.115 * H, b->up);
  }
}

static void measure_hand(kg_build *b, const kg_clip *clip, int side)
{
  const int wrist = kg_build_segment(b, side == 0 ? KG_ROLE_L_WRIST : KG_ROLE_R_WRIST);
  const int elbow = kg_build_segment(b, side == 0 ? KG_ROLE_L_ELBOW : KG_ROLE_R_ELBOW);
  const double usual = HAND_OF_STATURE * b->stature;
  if (wrist < 0) {
    b->hand_tip[side] = elbow >= 0 ? b->p[elbow] : b->mid_shoulder;
    return;
  }
  kg_vec3 reach = kg_quat_rotate(b->R[wrist], farthest_below(clip, b->segments[wrist].joint));
  const double length = kg_vec3_norm(reach);
  if (length > 0.3 * usual && length < 2.0 * usual) {
    reach = kg_vec3_scale(fmin(length, usual) / length, reach);
  } else { /* missing or implausible: straight on from the forearm */
    const kg_vec3 forearm = elbow >= 0 ? kg_vec3_sub(b->p[wrist], b->p[elbow]) : b->left;
    reach = kg_vec3_scale(usual, kg_vec3_normalized(forearm));
  }
  b->hand_tip[side] = kg_vec3_add(b->p[wrist], reach);
}

/* Without a fitted sole: the floor's normal is the rest pose's vertical, unless the shin says that
 * rest pose and posture have nothing in common (frames laid along the bones). */
static kg_foot_fit foot_at_rest(const kg_build *b, int ankle, int knee, int toe)
{
  kg_foot_fit fit = {.up_ankle = {0.0, 1.0, 0.0}, .up_toe = {0.0, 1.0, 0.0}};
  const kg_vec3 shin = kg_build_turn_local(
    b, ankle, knee >= 0 ? kg_vec3_normalized(kg_vec3_sub(b->p[knee], b->p[ankle])) : b->up);
  if (kg_vec3_dot(shin, fit.up_ankle) < 0.6) {
    fit.up_ankle = shin;
    fit.up_toe = toe < 0 ? shin : kg_build_turn_local(b, toe, kg_quat_rotate(b->R[ankle], shin));
  }
  fit.forward = toe >= 0 ? b->segments[toe].offset : kg_build_turn_local(b, ankle, b->forward);
  fit.ankle_height = ANKLE_OF_STATURE * b->stature + 0.01;
  fit.toe_height = 0.02 * b->stature;
  return fit;
}

/* Unit-like normals and heights within reason; anything else falls back on the rest pose. */
static bool usable(const kg_foot_fit *fit, double stature)
{
  const double size = kg_vec3_norm(fit->up_ankle) * kg_vec3_norm(fit->up_toe);
  return size > 0.25 && size < 4.0 && isfinite(kg_vec3_norm(fit->forward)) &&
         fabs(fit->ankle_height) < 0.2 * stature && fabs(fit->toe_height) < 0.2 * stature;
}

static void measure_foot(kg_build *b, const kg_clip *clip, int side)
{
  kg_build_foot *foot = &b->feet[side];
  foot->ankle = kg_build_segment(b, side == 0 ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE);
  foot->toe = kg_build_segment(b, side == 0 ? KG_ROLE_L_TOE : KG_ROLE_R_TOE);
  if (foot->ankle < 0) {
    return;
  }
  const int knee = kg_build_segment(b, side == 0 ? KG_ROLE_L_KNEE : KG_ROLE_R_KNEE);
  const bool given = b->def->has_feet && usable(&b->def->feet[side], b->stature);
  const kg_foot_fit fit =
    given ? b->def->feet[side] : foot_at_rest(b, foot->ankle, knee, foot->toe);
  const kg_vec3 front = kg_build_turn_local(b, foot->ankle, b->forward);
  const kg_vec3 across = kg_build_turn_local(b, foot->ankle, b->left);
  foot->up = kg_vec3_normalized(fit.up_ankle);
  kg_vec3 unused;
  kg_build_across(foot->up,
                  kg_vec3_norm(fit.forward) > 0.0 ? kg_vec3_normalized(fit.forward) : front, front,
                  &foot->forward, &unused);
  if (!(kg_vec3_norm(foot->forward) > 0.5)) {
    foot->forward = kg_vec3_normalized(kg_vec3_cross(across, foot->up));
  }
  foot->left = kg_vec3_cross(foot->up, foot->forward);
  foot->length = FOOT_OF_STATURE * b->stature;
  foot->heel = HEEL_OF_FOOT * foot->length;
  foot->ankle_height = fit.ankle_height;
  foot->ball = (BALL_OF_FOOT - HEEL_OF_FOOT) * foot->length;
  foot->toe_length = (1.0 - BALL_OF_FOOT) * foot->length;
  foot->toe_up = foot->up;
  foot->toe_forward = foot->forward;
  foot->toe_left = foot->left;
  foot->toe_height = fit.toe_height;
  if (foot->toe < 0) {
    return;
  }

  const kg_vec3 offset = b->segments[foot->toe].offset;
  const double ball = kg_vec3_dot(offset, foot->forward);
  if (ball > 0.3 * foot->ball && ball < 2.0 * foot->ball) {
    foot->ball = ball;
    foot->ball_left = fmax(-0.15 * ball, fmin(0.15 * ball, kg_vec3_dot(offset, foot->left)));
  }
  /* the toe's own frame: forward to its end when that is believable, else the foot's forward */
  const kg_vec3 end = farthest_below(clip, b->segments[foot->toe].joint);
  const double length = kg_vec3_norm(end);
  const bool plausible = length > 0.08 * foot->length && length < 0.6 * foot->length;
  const kg_vec3 ahead =
    kg_build_turn_local(b, foot->toe, kg_quat_rotate(b->R[foot->ankle], foot->forward));
  const kg_vec3 sideways =
    kg_build_turn_local(b, foot->toe, kg_quat_rotate(b->R[foot->ankle], foot->left));
  foot->toe_up = kg_vec3_normalized(fit.up_toe);
  kg_build_across(foot->toe_up, plausible ? kg_vec3_scale(1.0 / length, end) : ahead, ahead,
                  &foot->toe_forward, &unused);
  if (!(kg_vec3_norm(foot->toe_forward) > 0.5)) {
    foot->toe_forward = kg_vec3_normalized(kg_vec3_cross(sideways, foot->toe_up));
  }
  foot->toe_left = kg_vec3_cross(foot->toe_up, foot->toe_forward);
  if (plausible) {
    foot->toe_length = fmax(0.5 * length, kg_vec3_dot(end, foot->toe_forward));
  }
}

/* ---- masses ---------------------------------------------------------------------------------- */

/* A bar laid in the reference posture. */
typedef struct laid_bar {
  double mass;
  kg_vec3 origin, axis;             /* of the part: its first end point, unit direction      */
  kg_vec3 left, front;              /* unit, across                                          */
  double centre, half;              /* m along the axis                                      */
  double spread_left, spread_front; /* m^2                                              */
} laid_bar;

static void add_mass(moments *sum, double m, kg_vec3 x, kg_vec3 a, double a2, kg_vec3 b, double b2,
                     kg_vec3 c, double c2)
{
  kg_mat3 C = kg_mat3_outer(x, x);
  C = kg_mat3_add(C, kg_mat3_scale(a2, kg_mat3_outer(a, a)));
  C = kg_mat3_add(C, kg_mat3_scale(b2, kg_mat3_outer(b, b)));
  C = kg_mat3_add(C, kg_mat3_scale(c2, kg_mat3_outer(c, c)));
  sum->m += m;
  sum->s = kg_vec3_add_scaled(sum->s, m, x);
  sum->S = kg_mat3_add(sum->S, kg_mat3_scale(m, C));
}

/* The slice of a bar between two positions along its axis. */
static void add_slice(moments *sum, const laid_bar *bar, double from, double to)
{
  const double lo = fmax(from, bar->centre - bar->half), hi = fmin(to, bar->centre + bar->half);
  if (!(hi > lo)) {
    return;
  }
  const double length = hi - lo;
  add_mass(sum, bar->mass * length / (2.0 * bar->half),
           kg_vec3_add_scaled(bar->origin, 0.5 * (lo + hi), bar->axis), bar->axis,
           length * length / 12.0, bar->left, bar->spread_left, bar->front, bar->spread_front);
}

/* A part of the table from `origin` along `axis`: lengths along it times `length`, across it times
 * `girth`. front: direction of the part's anteroposterior axis. */
static laid_bar lay(const kg_build *b, kg_part part, kg_vec3 origin, kg_vec3 axis, double length,
                    double girth, kg_vec3 front, kg_vec3 other)
{
  const kg_part_bar t = kg_deleva_bar(part, b->def->sex);
  laid_bar bar = {.mass = t.mass * b->def->mass_kg,
                  .origin = origin,
                  .axis = axis,
                  .centre = t.centre * length,
                  .half = t.half * length,
                  .spread_left = t.spread_left * girth * girth,
                  .spread_front = t.spread_front * girth * girth};
  kg_build_across(axis, front, other, &bar.front, &bar.left);
  return bar;
}

/* A limb that belongs to one segment as a whole. */
static void add_limb(const kg_build *b, moments *sums, kg_part part, int segment, kg_vec3 end)
{
  if (segment < 0) {
    return;
  }
  const kg_vec3 bone = kg_vec3_sub(end, b->p[segment]);
  const double length = kg_vec3_norm(bone);
  const kg_vec3 axis =
    length > 0.0 ? kg_vec3_scale(1.0 / length, bone) : kg_vec3_scale(-1.0, b->up);
  const laid_bar bar = lay(b, part, b->p[segment], axis, length, length, b->forward, b->up);
  add_slice(&sums[segment], &bar, -INFINITY, INFINITY);
}

static const kg_role SPINE[] = {KG_ROLE_PELVIS, KG_ROLE_SPINE1, KG_ROLE_SPINE2, KG_ROLE_SPINE3};

/* Lower, middle and upper trunk from mid-hip to cervicale; each trunk segment takes what lies
 * between its joint and the next one up. Girths follow the stature, not the length: captured
 * spines are often too short. */
static void add_trunk(const kg_build *b, moments *sums)
{
  static const kg_part PARTS[] = {KG_PART_UPPER, KG_PART_MIDDLE, KG_PART_LOWER};
  const kg_sex sex = b->def->sex;
  const double scale = b->stature / kg_deleva_stature(sex);
  double table_length = 0.0;
  for (int k = 0; k < 3; k++) {
    table_length += kg_deleva_bar(PARTS[k], sex).length_m;
  }
  const double stretch = b->trunk_length / table_length;
  const kg_vec3 down = kg_vec3_scale(-1.0, b->up);
  const bool clavicles =
    kg_build_segment(b, KG_ROLE_L_CLAVICLE) >= 0 && kg_build_segment(b, KG_ROLE_R_CLAVICLE) >= 0;
  double start = 0.0; /* of the part, below cervicale */
  for (int k = 0; k < 3; k++) {
    const double table = kg_deleva_bar(PARTS[k], sex).length_m;
    laid_bar bar = lay(b, PARTS[k], kg_vec3_add_scaled(b->neck, start, down), down, stretch * table,
                       scale * table, b->forward, b->left);
    if (PARTS[k] == KG_PART_UPPER && clavicles) {
      bar.mass *= 1.0 - 2.0 * CLAVICLE_SHARE;
    }
    double bottom = INFINITY; /* of the segment's interval, as a depth below the part's start */
    for (int s = 0; s < (int)KG_COUNT_OF(SPINE); s++) {
      const int segment = kg_build_segment(b, SPINE[s]);
      double top = -INFINITY;
      for (int above = s + 1; above < (int)KG_COUNT_OF(SPINE); above++) {
        const int next = kg_build_segment(b, SPINE[above]);
        if (next >= 0) {
          top = fmin(bottom, kg_vec3_dot(kg_vec3_sub(b->p[next], bar.origin), down));
          break;
        }
      }
      if (segment >= 0) {
        add_slice(&sums[segment], &bar, top, bottom);
        bottom = top;
      }
    }
    start += stretch * table;
  }
}

/* Collar bone, shoulder blade and their muscles: a bar from the clavicle's joint to the shoulder. */
static void add_clavicles(const kg_build *b, moments *sums)
{
  const int left = kg_build_segment(b, KG_ROLE_L_CLAVICLE);
  const int right = kg_build_segment(b, KG_ROLE_R_CLAVICLE);
  if (left < 0 || right < 0) {
    return;
  }
  const double m =
    CLAVICLE_SHARE * b->def->mass_kg * kg_deleva_bar(KG_PART_UPPER, b->def->sex).mass;
  const double girth = 0.023 * b->stature; /* 4 cm at 1.74 m */
  for (int side = 0; side < 2; side++) {
    const int segment = side == 0 ? left : right;
    const kg_vec3 end =
      joint_of(b, side == 0 ? KG_ROLE_L_SHOULDER : KG_ROLE_R_SHOULDER, b->p[segment]);
    const kg_vec3 bone = kg_vec3_sub(end, b->p[segment]);
    const double length = kg_vec3_norm(bone);
    const kg_vec3 axis = length > 0.0 ? kg_vec3_scale(1.0 / length, bone) : b->left;
    kg_vec3 a, c;
    kg_build_across(axis, b->forward, b->up, &a, &c);
    add_mass(&sums[segment], m, middle(b->p[segment], end), axis, length * length / 12.0, a,
             girth * girth, c, girth * girth);
  }
}

/* Head and neck from the vertex down; the lower end of the bar belongs to the neck segments, in
 * equal shares. Without neck segments all of it is the head's. */
static void add_head(const kg_build *b, moments *sums)
{
  const int neck1 = kg_build_segment(b, KG_ROLE_NECK1), neck2 = kg_build_segment(b, KG_ROLE_NECK2);
  int head = kg_build_segment(b, KG_ROLE_HEAD);
  if (head < 0) {
    head = neck2 >= 0 ? neck2 : neck1 >= 0 ? neck1 : 0;
  }
  const double length = HEAD_OF_STATURE * b->stature;
  const laid_bar bar = lay(b, KG_PART_HEAD, b->vertex, kg_vec3_scale(-1.0, b->head_up), length,
                           length, b->forward, b->left);
  const double bottom = bar.centre + bar.half, slice = NECK_SHARE * 2.0 * bar.half;
  const int upper = neck2 >= 0 ? neck2 : neck1 >= 0 ? neck1 : head;
  const int lower = neck1 >= 0 ? neck1 : upper;
  add_slice(&sums[head], &bar, -INFINITY, bottom - slice);
  add_slice(&sums[upper], &bar, bottom - slice, bottom - 0.5 * slice);
  add_slice(&sums[lower], &bar, bottom - 0.5 * slice, INFINITY);
}

/* The foot from heel to toe tip, half as high above the sole as ankle and toe joint are, cut at the
 * toe joint. */
static void add_foot(const kg_build *b, moments *sums, const kg_build_foot *foot)
{
  if (foot->ankle < 0) {
    return;
  }
  const kg_quat R = b->R[foot->ankle];
  const kg_vec3 forward = kg_quat_rotate(R, foot->forward), up = kg_quat_rotate(R, foot->up);
  const double length = foot->heel + foot->ball + foot->toe_length;
  const double sole = -foot->ankle_height;
  kg_vec3 heel = kg_vec3_add_scaled(b->p[foot->ankle], -foot->heel, forward);
  heel = kg_vec3_add_scaled(heel, 0.5 * sole, up); /* half way down to the sole */
  kg_vec3 tip = kg_vec3_add_scaled(b->p[foot->ankle], length - foot->heel, forward);
  tip = kg_vec3_add_scaled(tip, sole + 0.5 * foot->toe_height, up);
  const kg_vec3 axis = kg_vec3_normalized(kg_vec3_sub(tip, heel));
  const laid_bar bar = lay(b, KG_PART_FOOT, heel, axis, length, length, up, up);
  const double cut = foot->toe >= 0 ? foot->heel + foot->ball : INFINITY;
  add_slice(&sums[foot->ankle], &bar, -INFINITY, cut);
  if (foot->toe >= 0) {
    add_slice(&sums[foot->toe], &bar, cut, INFINITY);
  }
}

/* Smallest eigenvalue of a symmetric matrix (xx yy zz xy xz yz), by the trigonometric formula. */
static double smallest_eigenvalue(const double I[6])
{
  const double mean = (I[0] + I[1] + I[2]) / 3.0;
  const double a = I[0] - mean, b = I[1] - mean, c = I[2] - mean;
  const double off = I[3] * I[3] + I[4] * I[4] + I[5] * I[5];
  const double p = sqrt((a * a + b * b + c * c + 2.0 * off) / 6.0);
  if (!(p > 1e-300)) {
    return mean;
  }
  const double det =
    a * (b * c - I[5] * I[5]) - I[3] * (I[3] * c - I[5] * I[4]) + I[4] * (I[3] * I[5] - b * I[4]);
  const double r = fmax(-1.0, fmin(1.0, 0.5 * det / (p * p * p)));
  return mean + 2.0 * p * cos(acos(r) / 3.0 + 2.0943951023931953);
}

/* Mass, centre of mass and inertia from the moments; principal inertias below the bound are raised
 * by the same amount in every direction, which keeps each at most the sum of the other two. */
static void finish_segment(kg_build *b, int i, const moments *sum)
{
  kg_segment *segment = &b->segments[i];
  segment->mass = sum->m;
  kg_vec3 com = sum->m > 0.0 ? kg_vec3_scale(1.0 / sum->m, sum->s) : b->p[i];
  kg_mat3 C = kg_mat3_add(sum->S, kg_mat3_scale(-sum->m, kg_mat3_outer(com, com)));
  segment->com = kg_build_to_local(b, i, com);

  const kg_mat3 R = kg_quat_matrix(b->R[i]);
  C = kg_mat3_mul(kg_mat3_transposed(R), kg_mat3_mul(C, R));
  double *I = segment->inertia;
  I[0] = C.m[4] + C.m[8];
  I[1] = C.m[0] + C.m[8];
  I[2] = C.m[0] + C.m[4];
  I[3] = -0.5 * (C.m[1] + C.m[3]);
  I[4] = -0.5 * (C.m[2] + C.m[6]);
  I[5] = -0.5 * (C.m[5] + C.m[7]);
  const double lift = fmax(0.0, b->def->min_inertia - smallest_eigenvalue(I));
  for (int k = 0; k < 3; k++) {
    I[k] += lift;
  }
}

/* Scales everything to the body mass; a segment too light to simulate gets a small mass at its
 * joint (twin joints of zero-length bones). */
static void distribute_mass(kg_build *b)
{
  moments sums[KG_ROLE_COUNT];
  memset(sums, 0, sizeof sums);
  add_trunk(b, sums);
  add_clavicles(b, sums);
  add_head(b, sums);
  for (int side = 0; side < 2; side++) {
    const bool l = side == 0;
    const int shoulder = kg_build_segment(b, l ? KG_ROLE_L_SHOULDER : KG_ROLE_R_SHOULDER);
    const int elbow = kg_build_segment(b, l ? KG_ROLE_L_ELBOW : KG_ROLE_R_ELBOW);
    const int wrist = kg_build_segment(b, l ? KG_ROLE_L_WRIST : KG_ROLE_R_WRIST);
    const int hip = kg_build_segment(b, l ? KG_ROLE_L_HIP : KG_ROLE_R_HIP);
    const int knee = kg_build_segment(b, l ? KG_ROLE_L_KNEE : KG_ROLE_R_KNEE);
    const int ankle = kg_build_segment(b, l ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE);
    add_limb(b, sums, KG_PART_UPPER_ARM, shoulder, elbow >= 0 ? b->p[elbow] : b->hand_tip[side]);
    add_limb(b, sums, KG_PART_FOREARM, elbow, wrist >= 0 ? b->p[wrist] : b->hand_tip[side]);
    add_limb(b, sums, KG_PART_HAND, wrist >= 0 ? wrist : elbow, b->hand_tip[side]);
    add_limb(b, sums, KG_PART_THIGH, hip, knee >= 0 ? b->p[knee] : b->p[0]);
    add_limb(b, sums, KG_PART_SHANK, knee, ankle >= 0 ? b->p[ankle] : b->p[0]);
    add_foot(b, sums, &b->feet[side]);
  }

  double total = 0.0;
  for (int i = 0; i < b->n; i++) {
    const double missing = LEAST_SHARE * b->def->mass_kg - sums[i].m;
    if (missing > 0.0) {
      const kg_vec3 none = {0.0, 0.0, 0.0};
      add_mass(&sums[i], missing, b->p[i], none, 0.0, none, 0.0, none, 0.0);
    }
    total += sums[i].m;
  }
  const double scale = b->def->mass_kg / total;
  int heaviest = 0;
  double rest = b->def->mass_kg;
  for (int i = 0; i < b->n; i++) {
    sums[i].m *= scale;
    sums[i].s = kg_vec3_scale(scale, sums[i].s);
    sums[i].S = kg_mat3_scale(scale, sums[i].S);
    finish_segment(b, i, &sums[i]);
    rest -= b->segments[i].mass;
    heaviest = b->segments[i].mass > b->segments[heaviest].mass ? i : heaviest;
  }
  b->segments[heaviest].mass += rest; /* rounding */
}

/* ---- the whole ------------------------------------------------------------------------------- */

kg_body_def kg_body_default_def(void)
{
  return (kg_body_def){.mass_kg = 70.0, .sex = KG_SEX_MEAN, .min_inertia = 2e-4};
}

static kg_status copy_to_body(kg_body **body, const kg_build *b)
{
  kg_body *made = kg_body_allocate(b->n, b->shape_count, b->point_count, b->def->allocator);
  if (!made) {
    return KG_ERR_NO_MEMORY;
  }
  memcpy(made->segments, b->segments, (size_t)b->n * sizeof *b->segments);
  memcpy(made->shapes, b->shapes, (size_t)b->shape_count * sizeof *b->shapes);
  memcpy(made->points, b->points, (size_t)b->point_count * sizeof *b->points);
  memcpy(made->segment_of_role, b->segment_of_role, sizeof b->segment_of_role);
  kg_body_finish(made);
  made->mass = b->def->mass_kg;
  made->stature = b->stature;
  made->sole_node_count =
    b->feet[0].ankle >= 0 && b->feet[1].ankle >= 0 ? 2 * KG_SOLE_NODE_COUNT : 0;
  *body = made;
  return KG_OK;
}

kg_status kg_body_from_clip(kg_body **body, const kg_clip *clip, const kg_mapping *mapping,
                            const kg_body_def *def, kg_error *error)
{
  *body = NULL;
  KG_ASSERT(def->mass_kg > 0.0 && def->min_inertia >= 0.0);
  kg_build b = {.def = def};
  kg_status status = collect_segments(&b, clip, mapping, error);
  if (status == KG_OK && (b.n == 0 || clip->frame_count == 0)) {
    status = kg_fail(error, KG_ERR_UNMAPPED, clip->source.path, 0, 0,
                     "no joint of the skeleton has a role in the body, or there is no frame");
  }
  if (status == KG_OK) {
    status = measure_posture(&b, clip, error);
  }
  if (status != KG_OK) {
    return status;
  }
  measure_trunk(&b);
  estimate_stature(&b, clip);
  measure_head(&b, clip);
  for (int side = 0; side < 2; side++) {
    measure_hand(&b, clip, side);
    measure_foot(&b, clip, side);
  }
  distribute_mass(&b);
  kg_build_surface(&b);
  status = copy_to_body(body, &b);
  return status == KG_OK ? status : kg_fail(error, status, "", 0, 0, "%s", kg_status_text(status));
}
