/* The body of a clip: masses by hand, symmetry, bounds, soles, and states to the clip and back. */
#include "support.h"

#include <stdio.h>

#include "kinegrad/body.h"
#include "kinegrad/dynamics.h"

static kg_clip *read_clip(const char *path)
{
  kg_clip *clip;
  kg_error error = {0};
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 0.01;
  if (kg_clip_read(&clip, path, &def, &error) != KG_OK) {
    fail_msg("%s:%ld: %s", error.path, error.line, error.text);
  }
  return clip;
}

static kg_clip *clip_of_text(const char *text)
{
  kg_clip *clip;
  kg_error error = {0};
  kg_clip_def def = kg_clip_default_def();
  def.unit_m = 1.0;
  def.keep_first_frame = true;
  def.up_given = true;
  if (kg_clip_read_bvh_text(&clip, text, strlen(text), "text.bvh", &def, &error) != KG_OK) {
    fail_msg("%ld: %s", error.line, error.text);
  }
  return clip;
}

static kg_body *body_of(const kg_clip *clip, const kg_body_def *def)
{
  kg_mapping mapping;
  kg_error error = {0};
  kg_body *body;
  if (kg_mapping_find(&mapping, clip, NULL, &error) != KG_OK ||
      kg_body_from_clip(&body, clip, &mapping, def, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return body;
}

/* ---- masses by hand -------------------------------------------------------------------------- */

/* The simplest upright skeleton with the lengths of de Leva's mean subject: arms hang down, toes
 * point along z; no neck, clavicle or toe joints, so that every row of the table is used whole. */
static const double H = 1.738, THIGH = 0.395, SHANK = 0.4397614, ARM = 0.2784, FOREARM = 0.2666;
static const double HAND = 0.178, TRUNK = 0.60905;

static kg_clip *plain_clip(void)
{
  char text[6000];
  char leg[2][700], arm[2][700];
  for (int s = 0; s < 2; s++) {
    const char *name = s == 0 ? "Left" : "Right";
    const double x = s == 0 ? 1.0 : -1.0;
    snprintf(leg[s], sizeof leg[s],
             "JOINT %sUpLeg\n{\nOFFSET %.17g 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "JOINT %sLeg\n{\nOFFSET 0 %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "JOINT %sFoot\n{\nOFFSET 0 %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "End Site\n{\nOFFSET 0 -0.05 0.1\n}\n}\n}\n}\n",
             name, 0.085 * x, name, -THIGH, name, -SHANK);
    snprintf(arm[s], sizeof arm[s],
             "JOINT %sArm\n{\nOFFSET %.17g %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "JOINT %sForeArm\n{\nOFFSET 0 %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "JOINT %sHand\n{\nOFFSET 0 %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
             "End Site\n{\nOFFSET 0 %.17g 0\n}\n}\n}\n}\n",
             name, 0.19 * x, TRUNK / 1.202 - 0.2, name, -ARM, name, -FOREARM, -HAND);
  }
  snprintf(text, sizeof text,
           "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\n"
           "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation\n%s%s"
           "JOINT Spine\n{\nOFFSET 0 0.2 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
           "JOINT Head\n{\nOFFSET 0 %.17g 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
           "End Site\n{\nOFFSET 0 %.17g 0\n}\n}\n%s%s}\n}\nMOTION\nFrames: 2\nFrame Time: 0.01\n",
           leg[0], leg[1], TRUNK - 0.2 + 0.05, 0.14 * H - 0.05, arm[0], arm[1]);
  for (int t = 0; t < 2; t++) {
    strcat(text, "0 0.9 0");
    for (int k = 0; k < 3 * 15; k++) {
      strcat(text, " 0");
    }
    strcat(text, "\n");
  }
  return clip_of_text(text);
}

/* A row of Table 4, mean of the sexes, as a rigid body: mass per cent, position of its centre of
 * mass, length, radii of gyration in per cent about the front, the left and the long axis. */
typedef struct hand_part {
  double mass;
  kg_vec3 com;
  double length, r_front, r_left, r_long;
  bool lying; /* the foot: long axis forward, its "front" axis up */
} hand_part;

static int parts_by_hand(hand_part *parts)
{
  int n = 0;
  const double cerv = TRUNK, vert = TRUNK + 0.14 * H;
  const double upper = 0.23505, middle = 0.2104, lower = 0.1636;
  parts[n++] = (hand_part){6.81, {0, vert - 0.49215 * 0.14 * H, 0}, 0.14 * H, 28.7, 30.5, 26.1, 0};
  parts[n++] = (hand_part){15.705, {0, cerv - 0.5058 * upper, 0}, upper, 48.55, 31.7, 45.7, 0};
  parts[n++] =
    (hand_part){15.49, {0, cerv - upper - 0.4507 * middle, 0}, middle, 45.75, 36.85, 44.15, 0};
  parts[n++] = (hand_part){
    11.82, {0, cerv - upper - middle - 0.55175 * lower, 0}, lower, 52.4, 47.65, 51.55, 0};
  for (int s = -1; s <= 1; s += 2) {
    const double shoulder = TRUNK / 1.202, elbow = shoulder - ARM, wrist = elbow - FOREARM;
    const double F = 0.152 * H, ankle = -THIGH - SHANK;
    const double sole = 0.039 * H + 0.01, toes = 0.02 * H;
    const double slope = atan2(0.5 * toes - 0.5 * sole, F); /* of the foot's axis */
    const double c = 0.42145 * F;
    parts[n++] =
      (hand_part){2.63, {0.19 * s, shoulder - 0.5763 * ARM, 0}, ARM, 28.15, 26.45, 15.3, 0};
    parts[n++] =
      (hand_part){1.5, {0.19 * s, elbow - 0.45665 * FOREARM, 0}, FOREARM, 26.85, 26.1, 10.75, 0};
    parts[n++] =
      (hand_part){0.585, {0.19 * s, wrist - 0.35255 * HAND, 0}, HAND, 26.6, 22.15, 16.9, 0};
    parts[n++] = (hand_part){14.47, {0.085 * s, -0.38535 * THIGH, 0}, THIGH, 34.9, 34.65, 15.55, 0};
    parts[n++] =
      (hand_part){4.57, {0.085 * s, -THIGH - 0.43735 * SHANK, 0}, SHANK, 25.9, 25.45, 9.7, 0};
    parts[n++] = (hand_part){
      1.33, {0.085 * s, ankle - 0.5 * sole + c * sin(slope), -0.27 * F + c * cos(slope)},
      F,    27.8,
      26.2, 13.15,
      true};
  }
  return n;
}

/* In the posture of the clip the table gives the body's centre of mass and inertia directly. The
 * foot's axis slopes by 6 degrees; its own inertia is turned accordingly. */
static void mass_com_and_inertia_are_the_tables(void **state)
{
  (void)state;
  kg_clip *clip = plain_clip();
  kg_body_def def = kg_body_default_def();
  def.mass_kg = 62.5;
  def.min_inertia = 0.0;
  kg_body *body = body_of(clip, &def);
  assert_close(body->stature, H, 1e-12);

  hand_part parts[16];
  const int n = parts_by_hand(parts);
  double total = 0.0;
  kg_vec3 com = {0, 0, 0};
  for (int k = 0; k < n; k++) {
    total += parts[k].mass;
    com = kg_vec3_add_scaled(com, parts[k].mass, parts[k].com);
  }
  com = kg_vec3_scale(1.0 / total, com);
  assert_close(total, 99.995, 1e-12);
  kg_mat3 I = kg_mat3_scale(0.0, kg_mat3_identity());
  for (int k = 0; k < n; k++) {
    const double m = def.mass_kg * parts[k].mass / total;
    const double L2 = parts[k].length * parts[k].length * 1e-4;
    const double front = m * L2 * parts[k].r_front * parts[k].r_front;
    const double left = m * L2 * parts[k].r_left * parts[k].r_left;
    const double along = m * L2 * parts[k].r_long * parts[k].r_long;
    const kg_vec3 d = kg_vec3_sub(parts[k].com, com);
    I = kg_mat3_add(I, kg_mat3_scale(m * kg_vec3_dot(d, d), kg_mat3_identity()));
    I = kg_mat3_add(I, kg_mat3_scale(-m, kg_mat3_outer(d, d)));
    kg_vec3 axis = {0, 1, 0}, ahead = {0, 0, 1};
    if (parts[k].lying) {
      const double slope = atan2(0.01 * H - 0.5 * (0.039 * H + 0.01), 0.152 * H);
      axis = kg_vec3_make(0, sin(slope), cos(slope));
      ahead = kg_vec3_make(0, cos(slope), -sin(slope));
    }
    const kg_vec3 x = {1, 0, 0};
    I = kg_mat3_add(I, kg_mat3_scale(along, kg_mat3_outer(axis, axis)));
    I = kg_mat3_add(I, kg_mat3_scale(front, kg_mat3_outer(ahead, ahead)));
    I = kg_mat3_add(I, kg_mat3_scale(left, kg_mat3_outer(x, x)));
  }

  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, body, NULL), KG_OK);
  double q[200];
  kg_body_state_from_clip(body, clip, 0, q, NULL);
  const kg_centroid c = kg_dynamics_centroid(dynamics, q, NULL);
  assert_close(c.mass, def.mass_kg, 1e-15);
  assert_close(c.com.x, com.x, 1e-12);
  assert_close(c.com.y, com.y + 0.9, 1e-12);
  assert_close(c.com.z, com.z, 1e-12);
  for (int k = 0; k < 9; k++) {
    assert_close(c.I.m[k], I.m[k], 1e-11);
  }
  /* sanity against the literature: about 15 kg m^2 across and 1.2 along, standing [12, 17] */
  assert_true(c.I.m[0] > 9.0 && c.I.m[0] < 16.0 && c.I.m[4] > 0.5 && c.I.m[4] < 2.0);
  kg_dynamics_destroy(dynamics);
  kg_body_destroy(body);
  kg_clip_destroy(clip);
}

/* ---- every body ------------------------------------------------------------------------------ */

static void smallest_and_largest(const double I[6], double *smallest, double *largest)
{
  /* power iteration on I and on tr(I) - I: independent of the formula in the library */
  const kg_mat3 A = {{I[0], I[3], I[4], I[3], I[1], I[5], I[4], I[5], I[2]}};
  const double trace = I[0] + I[1] + I[2];
  const kg_mat3 B = kg_mat3_add(kg_mat3_scale(trace, kg_mat3_identity()), kg_mat3_scale(-1.0, A));
  kg_vec3 a = {0.3, 0.7, 0.64}, b = {0.3, 0.7, 0.64};
  for (int k = 0; k < 20000; k++) {
    a = kg_vec3_normalized(kg_mat3_mul_vec(A, a));
    b = kg_vec3_normalized(kg_mat3_mul_vec(B, b));
  }
  *largest = kg_vec3_dot(a, kg_mat3_mul_vec(A, a));
  *smallest = trace - kg_vec3_dot(b, kg_mat3_mul_vec(B, b));
}

static void inertias_are_bounded_and_possible(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  const double bounds[] = {2e-4, 2e-3};
  for (int k = 0; k < 2; k++) {
    kg_body_def def = kg_body_default_def();
    def.min_inertia = bounds[k];
    kg_body *body = body_of(clip, &def);
    assert_int_equal(body->segment_count, 23);
    double mass = 0.0;
    bool raised = false;
    for (int i = 0; i < body->segment_count; i++) {
      const kg_segment *s = &body->segments[i];
      double least, most;
      smallest_and_largest(s->inertia, &least, &most);
      const double trace = s->inertia[0] + s->inertia[1] + s->inertia[2];
      assert_true(least >= def.min_inertia * (1.0 - 1e-7));
      assert_true(trace - most >= most * (1.0 - 1e-7)); /* A + B >= C */
      raised = raised || least < def.min_inertia * (1.0 + 1e-6);
      assert_true(s->mass >= 0.9e-3 * def.mass_kg);
      assert_true(kg_vec3_norm(s->com) < 0.3);
      mass += s->mass;
    }
    assert_true(raised); /* the bound is felt somewhere */
    assert_true(fabs(mass - def.mass_kg) <= 2e-14 * def.mass_kg && body->mass == def.mass_kg);
    kg_body_destroy(body);
  }
  kg_clip_destroy(clip);
}

static void left_and_right_are_mirror_images(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  for (int t = 0; t < clip->frame_count; t++) { /* every frame in the rest pose */
    for (int j = 0; j < clip->joint_count; j++) {
      kg_clip_set_rotation(clip, t, j, kg_quat_identity(), -1);
    }
  }
  const kg_body_def def = kg_body_default_def();
  kg_body *body = body_of(clip, &def);
  int pairs = 0;
  for (int i = 0; i < body->segment_count; i++) {
    const kg_segment *l = &body->segments[i];
    if (l->name[0] != 'l' || l->name[1] != '_') {
      continue;
    }
    for (int j = 0; j < body->segment_count; j++) {
      const kg_segment *r = &body->segments[j];
      if (r->name[0] != 'r' || strcmp(l->name + 1, r->name + 1) != 0) {
        continue;
      }
      const double sign[6] = {1, 1, 1, -1, -1, 1};
      pairs++;
      assert_close(l->mass, r->mass, 1e-13);
      assert_close(l->com.x, -r->com.x, 1e-13);
      assert_close(l->com.y, r->com.y, 1e-13);
      assert_close(l->com.z, r->com.z, 1e-13);
      for (int k = 0; k < 6; k++) {
        assert_close(l->inertia[k], sign[k] * r->inertia[k], 1e-13);
      }
      for (int p = 0; p < body->point_count; p++) { /* each sample has its twin */
        if (body->points[p].segment != i) {
          continue;
        }
        double best = 1.0;
        const kg_vec3 a = body->points[p].p;
        for (int o = 0; o < body->point_count; o++) {
          const kg_vec3 b = body->points[o].p;
          if (body->points[o].segment == j) {
            best = fmin(best, kg_vec3_norm(kg_vec3_make(a.x + b.x, a.y - b.y, a.z - b.z)));
          }
        }
        assert_at_most(best, 1e-12);
      }
    }
  }
  assert_int_equal(pairs, 8);
  assert_true(body->point_count >= 200 && body->point_count <= 400);
  kg_body_destroy(body);
  kg_clip_destroy(clip);
}

/* ---- feet ------------------------------------------------------------------------------------ */

static void soles_lie_where_the_fit_says(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  kg_body_def def = kg_body_default_def();
  def.has_feet = true;
  for (int side = 0; side < 2; side++) {
    def.feet[side] = (kg_foot_fit){.up_ankle = kg_vec3_normalized(kg_vec3_make(0.05, 1.0, 0.1)),
                                   .up_toe = kg_vec3_normalized(kg_vec3_make(-0.02, 1.0, 0.04)),
                                   .forward = {0.05, 0.3, 1.0},
                                   .ankle_height = 0.071,
                                   .toe_height = 0.022};
  }
  kg_body *body = body_of(clip, &def);
  assert_int_equal(body->sole_node_count, 10);
  for (int side = 0; side < 2; side++) {
    const kg_role ankle = side == 0 ? KG_ROLE_L_ANKLE : KG_ROLE_R_ANKLE;
    const kg_role toe = side == 0 ? KG_ROLE_L_TOE : KG_ROLE_R_TOE;
    const kg_body_point *nodes = body->points + side * KG_SOLE_NODE_COUNT;
    const kg_foot_fit *fit = &def.feet[side];
    for (int k = 0; k < KG_SOLE_TOE_TIP; k++) {
      assert_int_equal(nodes[k].segment, body->segment_of_role[ankle]);
      assert_close(kg_vec3_dot(nodes[k].p, fit->up_ankle), -0.071, 1e-14);
    }
    assert_int_equal(nodes[KG_SOLE_TOE_TIP].segment, body->segment_of_role[toe]);
    assert_close(kg_vec3_dot(nodes[KG_SOLE_TOE_TIP].p, fit->up_toe), -0.022, 1e-14);
    /* medial is inwards, heel behind the ankle, balls ahead of it, tip ahead of the toe joint */
    const double inwards = side == 0 ? -1.0 : 1.0;
    const kg_vec3 across = kg_vec3_sub(nodes[KG_SOLE_BALL_MEDIAL].p, nodes[KG_SOLE_BALL_LATERAL].p);
    assert_true(inwards * across.x > 0.08);
    assert_true(inwards * (nodes[KG_SOLE_HEEL_MEDIAL].p.x - nodes[KG_SOLE_HEEL_LATERAL].p.x) >
                0.06);
    assert_true(nodes[KG_SOLE_HEEL_MEDIAL].p.z < -0.05 && nodes[KG_SOLE_BALL_MEDIAL].p.z > 0.1);
    assert_true(nodes[KG_SOLE_TOE_TIP].p.z > 0.05);
    for (int p = 10; p < body->point_count; p++) { /* no sample below the sole */
      const kg_body_point *x = &body->points[p];
      if (x->segment == body->segment_of_role[ankle]) {
        assert_true(kg_vec3_dot(x->p, fit->up_ankle) > -0.071);
      } else if (x->segment == body->segment_of_role[toe]) {
        assert_true(kg_vec3_dot(x->p, fit->up_toe) > -0.022);
      }
    }
  }
  kg_body_destroy(body);
  kg_clip_destroy(clip);
}

/* ---- states ---------------------------------------------------------------------------------- */

/* Joint positions of the clip against the pose of the state, frame by frame. */
static void assert_same_pose(const kg_body *body, kg_dynamics *dynamics, const kg_clip *clip,
                             int frame, const double *q)
{
  kg_vec3 world[64], p[KG_ROLE_COUNT];
  kg_quat R[64];
  kg_mat3 Q[KG_ROLE_COUNT];
  assert_true(clip->joint_count <= 64);
  kg_clip_world(clip, frame, world, R);
  kg_dynamics_pose(dynamics, q, p, Q);
  for (int i = 0; i < body->segment_count; i++) {
    const int j = body->segments[i].joint;
    assert_at_most(kg_vec3_norm(kg_vec3_sub(world[j], p[i])), 1e-9);
    const kg_mat3 M = kg_quat_matrix(R[j]);
    for (int k = 0; k < 9; k++) {
      assert_close(M.m[k], Q[i].m[k], 1e-9);
    }
  }
}

static void check_states(const char *path)
{
  kg_clip *clip = read_clip(path), *copy;
  assert_int_equal(kg_clip_copy(&copy, clip), KG_OK);
  const kg_body_def def = kg_body_default_def();
  kg_body *body = body_of(clip, &def);
  kg_dynamics *dynamics;
  assert_int_equal(kg_dynamics_create(&dynamics, body, NULL), KG_OK);
  kg_random random = kg_random_make(11);
  double q[100], previous[100], back[100], d[75];
  assert_true(body->nq <= 100 && body->nv <= 75);
  const size_t C = (size_t)clip->channel_count;
  for (int t = 0; t < clip->frame_count; t++) {
    kg_body_state_from_clip(body, clip, t, q, t > 0 ? previous : NULL);
    assert_same_pose(body, dynamics, clip, t, q);
    for (int k = 3; t > 0 && k < body->nq; k += 4) {
      assert_true(q[k] * previous[k] + q[k + 1] * previous[k + 1] + q[k + 2] * previous[k + 2] +
                    q[k + 3] * previous[k + 3] >
                  0.0);
    }
    memcpy(previous, q, sizeof q);

    /* unchanged states leave every number as it is */
    kg_body_state_to_clip(body, q, copy, t, t - 1);
    assert_memory_equal(copy->values + (size_t)t * C, clip->values + (size_t)t * C,
                        C * sizeof(double));
    /* changed states arrive, and come back */
    for (int k = 0; k < body->nv; k++) {
      d[k] = 0.3 * kg_random_normal(&random);
    }
    kg_body_integrate(body, q, q, d);
    kg_body_state_to_clip(body, q, copy, t, t - 1);
    kg_body_state_from_clip(body, copy, t, back, q);
    kg_body_difference(body, d, back, q);
    for (int k = 0; k < body->nv; k++) {
      assert_at_most(fabs(d[k]), 1e-9);
    }
    assert_same_pose(body, dynamics, copy, t, q);
    for (int j = 0; j < clip->joint_count; j++) { /* others keep theirs, to the last bit */
      bool mapped = false;
      for (int i = 0; i < body->segment_count; i++) {
        mapped = mapped || body->segments[i].joint == j;
      }
      const kg_joint *joint = &clip->joints[j];
      if (!mapped && joint->parent >= 0) {
        assert_memory_equal(copy->values + (size_t)t * C + joint->first_channel,
                            clip->values + (size_t)t * C + joint->first_channel,
                            (size_t)joint->channel_count * sizeof(double));
      }
    }
  }
  kg_dynamics_destroy(dynamics);
  kg_body_destroy(body);
  kg_clip_destroy(copy);
  kg_clip_destroy(clip);
}

static void states_go_to_the_clip_and_back(void **state)
{
  (void)state;
  check_states(KG_TEST_DATA "/walker.bvh");
}

/* The same motion under a root that is not the pelvis, with rotations of its own. */
static void a_root_above_the_pelvis_carries_the_position(void **state)
{
  (void)state;
  FILE *in = fopen(KG_TEST_DATA "/walker.bvh", "rb");
  assert_non_null(in);
  static char text[100000], made[100000];
  text[fread(text, 1, sizeof text - 1, in)] = '\0';
  fclose(in);
  char *root = strstr(text, "ROOT Hips"), *motion = strstr(text, "MOTION");
  char *channels = strstr(text, "CHANNELS 6"), *rows = strstr(text, "Frame Time");
  assert_true(root && motion && channels && rows);
  *channels = *motion = '\0';
  channels = strchr(channels + 1, '\n'); /* rest of the hierarchy */
  size_t n = (size_t)snprintf(
    made, sizeof made,
    "HIERARCHY\nROOT Reference\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition "
    "Zrotation Yrotation Xrotation\nJOINT Hips\n{\nOFFSET 3 4 5\n"
    "CHANNELS 3 Zrotation Yrotation Xrotation%s}\nM%s",
    channels, motion + 1);
  /* each row has six numbers of the root first: its rotation also serves as the pelvis' */
  char *row = strchr(strstr(made, "Frame Time"), '\n') + 1;
  static char result[120000];
  size_t used = (size_t)(row - made);
  memcpy(result, made, used);
  while (*row) {
    char *end = strchr(row, '\n');
    char *cut = row;
    for (int k = 0; k < 3; k++) {
      cut = strchr(cut, ' ') + 1;
    }
    used += (size_t)snprintf(result + used, sizeof result - used, "%.*s 11 22 33 %.*s\n",
                             (int)(cut - row - 1), row, (int)(end - cut), cut);
    row = end + 1;
  }
  assert_true(n < sizeof made && used < sizeof result);
  FILE *out = fopen(KG_TEST_SCRATCH "/walker_under_root.bvh", "wb");
  assert_non_null(out);
  assert_int_equal(fwrite(result, 1, used, out), used);
  fclose(out);
  check_states(KG_TEST_SCRATCH "/walker_under_root.bvh");
}

/* Real skeletons of every kind at hand: bones of zero length, missing joints, odd end sites. */
static void captured_skeletons_make_sound_bodies(void **state)
{
  (void)state;
  const char *names[] = {"basketball/cmu_06_02.bvh",  "basketball/snu_s_003_6_1.bvh",
                         "gymnastics/cmu_49_06.bvh",  "gymnastics/snu_backflip.bvh",
                         "gymnastics/cmu_127_23.amc", "track/cmu_16_03.amc",
                         "track/cmu_09_01.bvh"};
  for (size_t k = 0; k < KG_COUNT_OF(names); k++) {
    char path[1024];
    snprintf(path, sizeof path, "%s/../../../shared/data/%s", KG_TEST_DATA, names[k]);
    FILE *file = fopen(path, "rb");
    if (!file) {
      print_message("skipped: no capture at %s\n", path);
      skip();
    }
    fclose(file);
    kg_clip *clip;
    const kg_clip_def clip_def = kg_clip_default_def();
    assert_int_equal(kg_clip_read(&clip, path, &clip_def, NULL), KG_OK);
    const kg_body_def def = kg_body_default_def();
    kg_body *body = body_of(clip, &def);
    assert_true(body->stature > 1.6 && body->stature < 1.9);
    assert_true(body->point_count >= 200 && body->sole_node_count == 10);
    for (int i = 0; i < body->segment_count; i++) {
      const kg_segment *s = &body->segments[i];
      double least, most;
      smallest_and_largest(s->inertia, &least, &most);
      const double trace = s->inertia[0] + s->inertia[1] + s->inertia[2];
      assert_true(least >= def.min_inertia * (1.0 - 1e-7) && trace - most >= most * (1.0 - 1e-7));
      assert_true(kg_vec3_norm(s->com) < 0.3);
    }
    kg_clip *copy;
    double q[100], before[100];
    assert_int_equal(kg_clip_copy(&copy, clip), KG_OK);
    for (int t = 0; t < clip->frame_count; t++) {
      kg_body_state_from_clip(body, clip, t, q, t > 0 ? before : NULL);
      memcpy(before, q, sizeof q);
      kg_body_state_to_clip(body, q, copy, t, t - 1);
    }
    const size_t size = (size_t)clip->frame_count * (size_t)clip->channel_count;
    assert_memory_equal(copy->values, clip->values, size * sizeof(double));
    kg_clip_destroy(copy);
    kg_body_destroy(body);
    kg_clip_destroy(clip);
  }
}

static void a_senseless_sole_is_replaced(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  kg_body_def def = kg_body_default_def();
  kg_body *rest = body_of(clip, &def);
  def.has_feet = true;
  def.feet[0].up_ankle.y = NAN; /* and the right foot all zeros */
  kg_body *body = body_of(clip, &def);
  for (int k = 0; k < 10; k++) {
    assert_memory_equal(&body->points[k].p, &rest->points[k].p, sizeof(kg_vec3));
  }
  kg_body_destroy(body);
  kg_body_destroy(rest);
  kg_clip_destroy(clip);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  kg_mapping mapping;
  assert_int_equal(kg_mapping_find(&mapping, clip, NULL, NULL), KG_OK);
  for (int allowed = 0; allowed < 100; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_body_def def = kg_body_default_def();
    def.allocator = &allocator;
    kg_body *body;
    const kg_status status = kg_body_from_clip(&body, clip, &mapping, &def, NULL);
    if (status == KG_OK) {
      assert_true(allowed > 0);
      kg_body_destroy(body);
      assert_int_equal(heap.live_bytes, 0);
      break;
    }
    assert_int_equal(status, KG_ERR_NO_MEMORY);
    assert_null(body);
    assert_int_equal(heap.live_bytes, 0);
  }
  kg_clip_destroy(clip);
}

static void a_skeleton_without_size_is_refused(void **state)
{
  (void)state;
  kg_clip *clip = read_clip(KG_TEST_DATA "/walker.bvh");
  kg_mapping mapping;
  assert_int_equal(kg_mapping_find(&mapping, clip, NULL, NULL), KG_OK);
  const kg_body_def def = kg_body_default_def();
  kg_body *body;
  kg_error error = {0};
  clip->translations[clip->joint_count * 5 + 3].y = NAN;
  assert_int_equal(kg_body_from_clip(&body, clip, &mapping, &def, &error), KG_ERR_FORMAT);
  assert_null(body);
  assert_non_null(strstr(error.text, "finite"));
  for (int k = 0; k < clip->joint_count * clip->frame_count; k++) {
    clip->translations[k] = kg_vec3_make(0.0, 0.0, 0.0);
  }
  assert_int_equal(kg_body_from_clip(&body, clip, &mapping, &def, &error), KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "zero"));
  kg_clip_destroy(clip);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(mass_com_and_inertia_are_the_tables),
    cmocka_unit_test(inertias_are_bounded_and_possible),
    cmocka_unit_test(left_and_right_are_mirror_images),
    cmocka_unit_test(soles_lie_where_the_fit_says),
    cmocka_unit_test(states_go_to_the_clip_and_back),
    cmocka_unit_test(a_root_above_the_pelvis_carries_the_position),
    cmocka_unit_test(a_senseless_sole_is_replaced),
    cmocka_unit_test(captured_skeletons_make_sound_bodies),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
    cmocka_unit_test(a_skeleton_without_size_is_refused),
  };
  return cmocka_run_group_tests_name("body", tests, NULL, NULL);
}
