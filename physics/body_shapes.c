/* Sole nodes, shapes and surface samples of a body; sizes and their reasons in docs/theory/body.md.
 *
 * Everything is laid out in the reference posture of body.c and mirrored between left and right.
 * Radii of limbs follow from mass and length at the density of the body. */
#include "physics/body_build.h"

static const double DENSITY = 1050.0; /* kg/m^3 */
static const double PI = 3.14159265358979323846;

static void add_point(kg_build *b, int segment, kg_vec3 local)
{
  if (b->point_count < KG_BUILD_POINTS) {
    b->points[b->point_count++] = (kg_body_point){segment, local};
  }
}

static void add_shape(kg_build *b, const kg_body_shape *shape)
{
  if (b->shape_count < KG_BUILD_SHAPES) {
    b->shapes[b->shape_count++] = *shape;
  }
}

/* ---- capsules -------------------------------------------------------------------------------- */

/* Six points around the axis at a share of its length; the first faces `front`. */
static void add_ring(kg_build *b, int segment, kg_vec3 from, kg_vec3 to, double share,
                     double radius)
{
  const kg_vec3 bone = kg_vec3_sub(to, from);
  const kg_vec3 axis = kg_vec3_norm(bone) > 0.0 ? kg_vec3_normalized(bone) : b->up;
  const kg_vec3 center = kg_vec3_lerp(from, to, share);
  kg_vec3 front, side;
  kg_build_across(axis, b->forward, b->up, &front, &side);
  for (int k = 0; k < 6; k++) {
    const double angle = PI / 3.0 * k;
    kg_vec3 x = kg_vec3_add_scaled(center, radius * cos(angle), front);
    x = kg_vec3_add_scaled(x, radius * sin(angle), side);
    add_point(b, segment, kg_build_to_local(b, segment, x));
  }
}

static void add_capsule(kg_build *b, int segment, kg_vec3 from, kg_vec3 to, double radius)
{
  const kg_body_shape shape = {.kind = KG_BODY_CAPSULE,
                               .segment = segment,
                               .a = kg_build_to_local(b, segment, from),
                               .b = kg_build_to_local(b, segment, to),
                               .radius = radius,
                               .orientation = kg_quat_identity()};
  add_shape(b, &shape);
}

static double clamped(double value, double least, double most)
{
  return fmax(least, fmin(most, value));
}

/* Radius of a limb, held between shares of the stature: the capsule has the segment's volume,
 * m / rho = pi r^2 L + 4/3 pi r^3, found by Newton's method from above (the left side is convex). */
static double limb_radius(const kg_build *b, int segment, double length, double least, double most)
{
  const double V = b->segments[segment].mass / DENSITY, L = length;
  double r = most * b->stature;
  for (int k = 0; k < 20; k++) {
    const double excess = PI * r * r * (L + 4.0 / 3.0 * r) - V;
    r -= excess / (PI * r * (2.0 * L + 4.0 * r));
  }
  return clamped(r, least * b->stature, most * b->stature);
}

/* A limb from its joint to `to`, with rings at three shares of its length. */
static void add_limb_shape(kg_build *b, int segment, kg_vec3 to, double least, double most,
                           double last_ring)
{
  if (segment < 0) {
    return;
  }
  const kg_vec3 from = b->p[segment];
  const double r = limb_radius(b, segment, kg_vec3_norm(kg_vec3_sub(to, from)), least, most);
  add_capsule(b, segment, from, to, r);
  add_ring(b, segment, from, to, 0.15, r);
  add_ring(b, segment, from, to, 0.5 * (0.15 + last_ring), r);
  add_ring(b, segment, from, to, last_ring, r);
}

/* The hand is a flat thing: a thin capsule whose tip is the finger tip. */
static void add_hand(kg_build *b, int segment, kg_vec3 tip)
{
  if (segment < 0) {
    return;
  }
  const kg_vec3 wrist = b->p[segment];
  const kg_vec3 reach = kg_vec3_sub(tip, wrist);
  const double length = kg_vec3_norm(reach);
  const double r = fmin(0.0105 * b->stature, 0.3 * length); /* 18 mm at 1.74 m */
  const kg_vec3 end = kg_vec3_add_scaled(tip, length > 0.0 ? -r / length : 0.0, reach);
  add_capsule(b, segment, wrist, end, r);
  add_ring(b, segment, wrist, end, 0.35, r);
  add_ring(b, segment, wrist, end, 0.7, r);
  add_ring(b, segment, wrist, end, 1.0, r);
  add_point(b, segment, kg_build_to_local(b, segment, tip));
}

static void add_limbs(kg_build *b, int side)
{
  const bool l = side == 0;
  const int shoulder = kg_build_segment(b, l ? KG_ROLE_L_SHOULDER : KG_ROLE_R_SHOULDER);
  const int elbow = kg_build_segment(b, l ? KG_ROLE_L_ELBOW : KG_ROLE_R_ELBOW);
  const int wrist = kg_build_segment(b, l ? KG_ROLE_L_WRIST : KG_ROLE_R_WRIST);
  const int hip = kg_build_segment(b, l ? KG_ROLE_L_HIP : KG_ROLE_R_HIP);
  const int knee = kg_build_segment(b, l ? KG_ROLE_L_KNEE : KG_ROLE_R_KNEE);
  const int ankle = kg_build_segment(b, l ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE);
  const kg_vec3 tip = b->hand_tip[side];
  add_limb_shape(b, shoulder, elbow >= 0 ? b->p[elbow] : tip, 0.018, 0.032, 1.0);
  add_limb_shape(b, elbow, wrist >= 0 ? b->p[wrist] : tip, 0.014, 0.026, 0.9);
  add_hand(b, wrist, tip);
  if (knee >= 0) {
    add_limb_shape(b, hip, b->p[knee], 0.030, 0.055, 1.0);
  }
  if (ankle >= 0) {
    add_limb_shape(b, knee, b->p[ankle], 0.022, 0.036, 0.85);
  }
}

/* ---- trunk and head -------------------------------------------------------------------------- */

/* A capsule across the trunk: deep as the radius, wide as the half width. */
static void add_crossbar(kg_build *b, int segment, kg_vec3 center, double half_width, double radius)
{
  const kg_vec3 from = kg_vec3_add_scaled(center, -(half_width - radius), b->left);
  const kg_vec3 to = kg_vec3_add_scaled(center, half_width - radius, b->left);
  add_capsule(b, segment, from, to, radius);
  for (int k = 0; k < 3; k++) {
    add_ring(b, segment, from, to, 0.5 * k, radius);
  }
  for (int side = -1; side <= 1; side += 2) {
    const kg_vec3 x = kg_vec3_add_scaled(center, side * half_width, b->left);
    add_point(b, segment, kg_build_to_local(b, segment, x));
  }
}

static kg_vec3 above_hips(const kg_build *b, double height)
{
  return kg_vec3_add_scaled(b->mid_hip, height, b->up);
}

static double height_of(const kg_build *b, int segment)
{
  return kg_vec3_dot(kg_vec3_sub(b->p[segment], b->mid_hip), b->up);
}

/* Pelvis and chest are crossbars; spine segments between them that have some length get one too. */
static void add_trunk_shapes(kg_build *b)
{
  static const kg_role SPINE[] = {KG_ROLE_SPINE1, KG_ROLE_SPINE2, KG_ROLE_SPINE3};
  const double H = b->stature, T = b->trunk_length;
  add_crossbar(b, 0, above_hips(b, 0.03 * H), 0.100 * H, 0.062 * H);
  int chest = 0;
  for (int k = 0; k < (int)KG_COUNT_OF(SPINE); k++) {
    const int segment = kg_build_segment(b, SPINE[k]);
    chest = segment >= 0 ? segment : chest;
  }
  for (int k = 0; k < (int)KG_COUNT_OF(SPINE); k++) {
    const int segment = kg_build_segment(b, SPINE[k]);
    if (segment < 0 || segment == chest) {
      continue;
    }
    double top = 0.85 * T; /* of the next spine joint up */
    for (int above = k + 1; above < (int)KG_COUNT_OF(SPINE); above++) {
      const int next = kg_build_segment(b, SPINE[above]);
      if (next >= 0) {
        top = height_of(b, next);
        break;
      }
    }
    const double bottom = height_of(b, segment);
    if (top - bottom > 0.02 * H) {
      add_crossbar(b, segment, above_hips(b, 0.5 * (bottom + top)), 0.080 * H, 0.058 * H);
    }
  }
  if (chest != 0) {
    add_crossbar(b, chest, above_hips(b, 0.76 * T), 0.090 * H, 0.062 * H);
  }
}

static void add_clavicle_and_neck(kg_build *b)
{
  const kg_role clavicles[2] = {KG_ROLE_L_CLAVICLE, KG_ROLE_R_CLAVICLE};
  const kg_role shoulders[2] = {KG_ROLE_L_SHOULDER, KG_ROLE_R_SHOULDER};
  const double H = b->stature;
  for (int side = 0; side < 2; side++) {
    const int segment = kg_build_segment(b, clavicles[side]);
    const int shoulder = kg_build_segment(b, shoulders[side]);
    if (segment >= 0 && shoulder >= 0) {
      add_capsule(b, segment, b->p[segment], b->p[shoulder], 0.028 * H);
      add_ring(b, segment, b->p[segment], b->p[shoulder], 0.6, 0.028 * H);
    }
  }
  const int neck1 = kg_build_segment(b, KG_ROLE_NECK1), neck2 = kg_build_segment(b, KG_ROLE_NECK2);
  const int head = kg_build_segment(b, KG_ROLE_HEAD);
  const int neck = neck2 >= 0 ? neck2 : neck1;
  if (neck1 >= 0 && neck2 >= 0) {
    add_capsule(b, neck1, b->p[neck1], b->p[neck2], 0.034 * H);
  }
  if (neck >= 0 && head >= 0) {
    add_capsule(b, neck, b->p[neck], b->p[head], 0.034 * H);
    add_ring(b, neck, b->p[neck], b->p[head], 0.3, 0.034 * H);
  }
}

/* Ellipsoid with the vertex at its top: 23 cm high, 15 wide and 19 deep at a stature of 1.74 m. */
static void add_head_shape(kg_build *b)
{
  const int head = kg_build_segment(b, KG_ROLE_HEAD);
  if (head < 0) {
    return;
  }
  const double H = b->stature;
  const kg_vec3 half = {0.043 * H, 0.066 * H, 0.055 * H}; /* left, up, front */
  kg_vec3 front, left;
  kg_build_across(b->head_up, b->forward, b->left, &front, &left);
  const kg_vec3 center = kg_vec3_add_scaled(b->vertex, -half.y, b->head_up);
  const kg_mat3 axes = {
    {left.x, b->head_up.x, front.x, left.y, b->head_up.y, front.y, left.z, b->head_up.z, front.z}};
  const kg_body_shape shape = {.kind = KG_BODY_ELLIPSOID,
                               .segment = head,
                               .a = kg_build_to_local(b, head, center),
                               .b = half,
                               .orientation =
                                 kg_quat_mul(kg_quat_conj(b->R[head]), kg_quat_from_matrix(axes))};
  add_shape(b, &shape);

  const double elevations[] = {-0.9, -0.3, 0.3, 0.9}; /* rad */
  for (int e = 0; e < (int)KG_COUNT_OF(elevations); e++) {
    for (int k = 0; k < 6; k++) {
      const double c = cos(elevations[e]), angle = PI / 3.0 * k;
      const kg_vec3 unit = {c * sin(angle), sin(elevations[e]), c * cos(angle)};
      kg_vec3 x = kg_vec3_add_scaled(center, unit.x * half.x, left);
      x = kg_vec3_add_scaled(x, unit.y * half.y, b->head_up);
      x = kg_vec3_add_scaled(x, unit.z * half.z, front);
      add_point(b, head, kg_build_to_local(b, head, x));
    }
  }
  add_point(b, head, kg_build_to_local(b, head, b->vertex));
}

/* ---- feet ------------------------------------------------------------------------------------ */

static kg_vec3 combine(double left, kg_vec3 l, double up, kg_vec3 u, double forward, kg_vec3 f)
{
  return kg_vec3_add_scaled(kg_vec3_add_scaled(kg_vec3_scale(left, l), up, u), forward, f);
}

static kg_vec3 on_ankle(const kg_build_foot *foot, double left, double up, double forward)
{
  return combine(left, foot->left, up, foot->up, forward, foot->forward);
}

static kg_vec3 on_toe(const kg_build_foot *foot, double left, double up, double forward)
{
  return combine(left, foot->toe_left, up, foot->toe_up, forward, foot->toe_forward);
}

/* Order of kg_sole_node. Without a toe segment the tip is on the ankle's. */
static void add_sole(kg_build *b, int side)
{
  const kg_build_foot *foot = &b->feet[side];
  const double lateral = side == 0 ? 1.0 : -1.0; /* the left foot's outer side is to the left */
  const double heel = 0.021 * b->stature, ball = 0.0285 * b->stature; /* half widths */
  const double sole = -foot->ankle_height;
  add_point(b, foot->ankle, on_ankle(foot, -lateral * heel, sole, -foot->heel));
  add_point(b, foot->ankle, on_ankle(foot, lateral * heel, sole, -foot->heel));
  add_point(b, foot->ankle, on_ankle(foot, foot->ball_left - lateral * ball, sole, foot->ball));
  add_point(b, foot->ankle, on_ankle(foot, foot->ball_left + lateral * ball, sole, foot->ball));
  if (foot->toe >= 0) {
    add_point(b, foot->toe, on_toe(foot, 0.0, -foot->toe_height, foot->toe_length));
  } else {
    add_point(b, foot->ankle, on_ankle(foot, foot->ball_left, sole, foot->ball + foot->toe_length));
  }
}

static kg_quat frame_of(kg_vec3 left, kg_vec3 up, kg_vec3 forward)
{
  const kg_mat3 axes = {
    {left.x, up.x, forward.x, left.y, up.y, forward.y, left.z, up.z, forward.z}};
  return kg_quat_from_matrix(axes);
}

/* Boxes from the sole up, for the foot and the toes. Their undersides are what the sole nodes
 * stand for; the samples are the upper edges, so none lies below the sole. */
static void add_foot_shapes(kg_build *b, int side)
{
  const kg_build_foot *foot = &b->feet[side];
  const double half_width = 0.021 * b->stature;
  const double front = foot->toe >= 0 ? foot->ball : foot->ball + foot->toe_length;
  const double top = -0.25 * foot->ankle_height, bottom = -foot->ankle_height;
  const kg_body_shape box = {
    .kind = KG_BODY_BOX,
    .segment = foot->ankle,
    .a = on_ankle(foot, 0.5 * foot->ball_left, 0.5 * (top + bottom), 0.5 * (front - foot->heel)),
    .b = {half_width, 0.5 * fabs(top - bottom), 0.5 * (front + foot->heel)},
    .orientation = frame_of(foot->left, foot->up, foot->forward)};
  add_shape(b, &box);
  for (int k = -1; k <= 1; k += 2) {
    const double left = 0.5 * foot->ball_left + k * half_width;
    add_point(b, foot->ankle, on_ankle(foot, left, top, -foot->heel));
    add_point(b, foot->ankle, on_ankle(foot, left, top, 0.0));
    add_point(b, foot->ankle, on_ankle(foot, left, top, front));
  }
  if (foot->toe < 0) {
    return;
  }
  const double toe_top = 0.0, toe_bottom = -foot->toe_height;
  const kg_body_shape toes = {
    .kind = KG_BODY_BOX,
    .segment = foot->toe,
    .a = on_toe(foot, 0.0, 0.5 * (toe_top + toe_bottom), 0.5 * foot->toe_length),
    .b = {half_width, 0.5 * fabs(toe_top - toe_bottom), 0.5 * foot->toe_length},
    .orientation = frame_of(foot->toe_left, foot->toe_up, foot->toe_forward)};
  add_shape(b, &toes);
  for (int k = -1; k <= 1; k += 2) {
    add_point(b, foot->toe, on_toe(foot, k * half_width, toe_top, 0.7 * foot->toe_length));
  }
}

void kg_build_surface(kg_build *b)
{
  const bool feet = b->feet[0].ankle >= 0 && b->feet[1].ankle >= 0;
  for (int side = 0; side < 2 && feet; side++) {
    add_sole(b, side);
  }
  for (int side = 0; side < 2; side++) {
    if (feet) {
      add_foot_shapes(b, side);
    }
    add_limbs(b, side);
  }
  add_trunk_shapes(b);
  add_clavicle_and_neck(b);
  add_head_shape(b);
}
