/* Bodies made by hand for the tests of physics/: a 23-segment human with box feet, a single box,
 * chains, and random trees built from particles (so that their inertia is known independently). */
#ifndef TESTS_FIXTURE_BODY_H
#define TESTS_FIXTURE_BODY_H

#include "support.h"

#include "kinegrad/body.h"
#include "kinegrad/dynamics.h"

enum {
  HUMAN_SEGMENTS = 23,
  HUMAN_LEFT_ANKLE = 17,
  HUMAN_RIGHT_ANKLE = 21,
  MAX_NV = 96,
  MAX_NQ = 128
};

/* Height of the human's root when it stands on y = 0 with all rotations the identity, m. */
static const double human_root_height = 0.96;

static inline kg_segment fixture_segment(const char *name, int parent, kg_vec3 offset, double mass,
                                         kg_vec3 com, kg_vec3 half)
{
  kg_segment s = {
    .role = -1, .joint = -1, .parent = parent, .offset = offset, .mass = mass, .com = com};
  strncpy(s.name, name, sizeof s.name - 1);
  /* a solid box, slightly turned so that no product of inertia is zero */
  s.inertia[0] = mass / 3.0 * (half.y * half.y + half.z * half.z) + 2e-4;
  s.inertia[1] = mass / 3.0 * (half.x * half.x + half.z * half.z) + 2e-4;
  s.inertia[2] = mass / 3.0 * (half.x * half.x + half.y * half.y) + 2e-4;
  const double small = 0.05 * fmin(s.inertia[0], fmin(s.inertia[1], s.inertia[2]));
  s.inertia[3] = small;
  s.inertia[4] = -0.5 * small;
  s.inertia[5] = 0.7 * small;
  return s;
}

/* x to the left, y up, z forward. Ten sole nodes first (left foot, right foot), then the corners
 * of a box around every segment. 74 kg. */
static inline kg_body *human_body(void)
{
  struct row {
    const char *name;
    int parent;
    double offset[3], mass, com[3], half[3];
  };
  /* clang-format off */
  static const struct row rows[HUMAN_SEGMENTS] = {
    {"pelvis",     -1, { 0.00,  0.00,  0.00}, 8.0, { 0.00,  0.02,  0.00}, {0.13, 0.08, 0.09}},
    {"spine",       0, { 0.00,  0.10,  0.00}, 7.0, { 0.00,  0.06,  0.01}, {0.12, 0.06, 0.09}},
    {"spine1",      1, { 0.00,  0.12,  0.00}, 7.0, { 0.00,  0.06,  0.01}, {0.13, 0.06, 0.10}},
    {"spine2",      2, { 0.00,  0.12,  0.00}, 10., { 0.00,  0.08,  0.00}, {0.15, 0.09, 0.11}},
    {"neck",        3, { 0.00,  0.18,  0.00}, 0.8, { 0.00,  0.03,  0.00}, {0.05, 0.03, 0.05}},
    {"neck1",       4, { 0.00,  0.06,  0.00}, 0.6, { 0.00,  0.03,  0.01}, {0.05, 0.03, 0.05}},
    {"head",        5, { 0.00,  0.06,  0.01}, 4.4, { 0.00,  0.11,  0.02}, {0.07, 0.11, 0.09}},
    {"l_clavicle",  3, { 0.03,  0.15,  0.00}, 0.7, { 0.06,  0.00,  0.00}, {0.07, 0.04, 0.04}},
    {"l_shoulder",  7, { 0.14,  0.00,  0.00}, 2.0, { 0.00, -0.15,  0.00}, {0.05, 0.15, 0.05}},
    {"l_elbow",     8, { 0.00, -0.29,  0.00}, 1.2, { 0.00, -0.12,  0.00}, {0.04, 0.13, 0.04}},
    {"l_wrist",     9, { 0.00, -0.26,  0.00}, 0.5, { 0.00, -0.08,  0.00}, {0.04, 0.09, 0.02}},
    {"r_clavicle",  3, {-0.03,  0.15,  0.00}, 0.7, {-0.06,  0.00,  0.00}, {0.07, 0.04, 0.04}},
    {"r_shoulder", 11, {-0.14,  0.00,  0.00}, 2.0, { 0.00, -0.15,  0.00}, {0.05, 0.15, 0.05}},
    {"r_elbow",    12, { 0.00, -0.29,  0.00}, 1.2, { 0.00, -0.12,  0.00}, {0.04, 0.13, 0.04}},
    {"r_wrist",    13, { 0.00, -0.26,  0.00}, 0.5, { 0.00, -0.08,  0.00}, {0.04, 0.09, 0.02}},
    {"l_hip",       0, { 0.09, -0.05,  0.00}, 9.0, { 0.00, -0.19,  0.00}, {0.08, 0.21, 0.08}},
    {"l_knee",     15, { 0.00, -0.42,  0.00}, 3.2, { 0.00, -0.18,  0.00}, {0.05, 0.20, 0.05}},
    {"l_ankle",    16, { 0.00, -0.41,  0.00}, 0.9, { 0.00, -0.05,  0.04}, {0.04, 0.04, 0.095}},
    {"l_toe",      17, { 0.00, -0.05,  0.13}, 0.2, { 0.00, -0.015, 0.03}, {0.04, 0.015, 0.04}},
    {"r_hip",       0, {-0.09, -0.05,  0.00}, 9.0, { 0.00, -0.19,  0.00}, {0.08, 0.21, 0.08}},
    {"r_knee",     19, { 0.00, -0.42,  0.00}, 3.2, { 0.00, -0.18,  0.00}, {0.05, 0.20, 0.05}},
    {"r_ankle",    20, { 0.00, -0.41,  0.00}, 0.9, { 0.00, -0.05,  0.04}, {0.04, 0.04, 0.095}},
    {"r_toe",      21, { 0.00, -0.05,  0.13}, 0.2, { 0.00, -0.015, 0.03}, {0.04, 0.015, 0.04}},
  };
  /* clang-format on */
  kg_segment segments[HUMAN_SEGMENTS];
  kg_body_point points[10 + 8 * HUMAN_SEGMENTS];
  int count = 0;
  for (int side = 0; side < 2; side++) {
    const int ankle = side == 0 ? HUMAN_LEFT_ANKLE : HUMAN_RIGHT_ANKLE;
    points[count++] = (kg_body_point){ankle, {-0.03, -0.08, -0.05}};
    points[count++] = (kg_body_point){ankle, {0.03, -0.08, -0.05}};
    points[count++] = (kg_body_point){ankle, {-0.04, -0.08, 0.12}};
    points[count++] = (kg_body_point){ankle, {0.04, -0.08, 0.12}};
    points[count++] = (kg_body_point){ankle + 1, {0.0, -0.03, 0.07}};
  }
  for (int i = 0; i < HUMAN_SEGMENTS; i++) {
    const struct row *r = &rows[i];
    const kg_vec3 com = {r->com[0], r->com[1], r->com[2]};
    const kg_vec3 half = {r->half[0], r->half[1], r->half[2]};
    segments[i] =
      fixture_segment(r->name, r->parent, kg_vec3_make(r->offset[0], r->offset[1], r->offset[2]),
                      r->mass, com, half);
    for (int corner = 0; corner < 8; corner++) {
      const kg_vec3 p = {com.x + (corner & 1 ? half.x : -half.x),
                         com.y + (corner & 2 ? half.y : -half.y),
                         com.z + (corner & 4 ? half.z : -half.z)};
      points[count++] = (kg_body_point){i, p};
    }
  }
  /* the boxes of the feet end 10 mm above the sole, so that only the nodes carry weight in stance */
  for (int k = 10; k < count; k++) {
    const int s = points[k].segment;
    if (s == HUMAN_LEFT_ANKLE || s == HUMAN_RIGHT_ANKLE) {
      points[k].p.y = fmax(points[k].p.y, -0.07);
    } else if (s == HUMAN_LEFT_ANKLE + 1 || s == HUMAN_RIGHT_ANKLE + 1) {
      points[k].p.y = fmax(points[k].p.y, -0.02);
    }
  }
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, segments, HUMAN_SEGMENTS, points, count, NULL), KG_OK);
  body->sole_node_count = 10;
  return body;
}

/* One rigid box with half sizes half, centre of mass at the origin of the frame, corners as
 * points. */
static inline kg_body *box_body(double mass, kg_vec3 half)
{
  kg_segment s = fixture_segment("box", -1, kg_vec3_make(0.0, 0.0, 0.0), mass,
                                 kg_vec3_make(0.0, 0.0, 0.0), half);
  s.inertia[3] = s.inertia[4] = s.inertia[5] = 0.0;
  kg_body_point points[8];
  for (int corner = 0; corner < 8; corner++) {
    points[corner].segment = 0;
    points[corner].p = kg_vec3_make(corner & 1 ? half.x : -half.x, corner & 2 ? half.y : -half.y,
                                    corner & 4 ? half.z : -half.z);
  }
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, &s, 1, points, 8, NULL), KG_OK);
  return body;
}

/* Particles that make up the segments of a random tree: the independent model of its inertia. */
enum { PARTICLES = 6 };
typedef struct particle_set {
  double mass[MAX_NV][PARTICLES];
  kg_vec3 at[MAX_NV][PARTICLES]; /* in the segment frame */
} particle_set;

/* Mass, centre of mass and inertia of particles, from their definitions. */
static inline void segment_from_particles(kg_segment *s, const double *mass, const kg_vec3 *at)
{
  s->mass = 0.0;
  s->com = kg_vec3_make(0.0, 0.0, 0.0);
  for (int k = 0; k < PARTICLES; k++) {
    s->mass += mass[k];
    s->com = kg_vec3_add_scaled(s->com, mass[k], at[k]);
  }
  s->com = kg_vec3_scale(1.0 / s->mass, s->com);
  memset(s->inertia, 0, sizeof s->inertia);
  for (int k = 0; k < PARTICLES; k++) {
    const kg_vec3 r = kg_vec3_sub(at[k], s->com);
    s->inertia[0] += mass[k] * (r.y * r.y + r.z * r.z);
    s->inertia[1] += mass[k] * (r.x * r.x + r.z * r.z);
    s->inertia[2] += mass[k] * (r.x * r.x + r.y * r.y);
    s->inertia[3] -= mass[k] * r.x * r.y;
    s->inertia[4] -= mass[k] * r.x * r.z;
    s->inertia[5] -= mass[k] * r.y * r.z;
  }
}

/* Random tree of n segments, parents at random: long chains and bushes, ball joints inside. */
static inline kg_body *random_tree(kg_random *random, int n, particle_set *particles)
{
  kg_segment segments[MAX_NV];
  particle_set own;
  particle_set *set = particles ? particles : &own;
  for (int i = 0; i < n; i++) {
    const int back = (int)(3.0 * kg_random_uniform(random));
    const int parent = i == 0 ? -1 : (i - 1 - back >= 0 ? i - 1 - back : 0);
    segments[i] = (kg_segment){.role = -1, .joint = -1, .parent = parent};
    segments[i].offset = random_vec3(random, 0.3);
    for (int k = 0; k < PARTICLES; k++) {
      set->mass[i][k] = 0.1 + kg_random_uniform(random);
      set->at[i][k] = random_vec3(random, 0.2);
    }
    segment_from_particles(&segments[i], set->mass[i], set->at[i]);
  }
  kg_body *body = NULL;
  assert_int_equal(kg_body_create(&body, segments, n, NULL, 0, NULL), KG_OK);
  return body;
}

static inline void random_state(kg_random *random, const kg_body *body, double *q, double *v,
                                double *a)
{
  const kg_vec3 x = random_vec3(random, 1.0);
  q[0] = x.x;
  q[1] = x.y;
  q[2] = x.z;
  for (int i = 0; i < body->segment_count; i++) {
    const kg_quat r = random_quat(random);
    q[3 + 4 * i] = r.w;
    q[4 + 4 * i] = r.x;
    q[5 + 4 * i] = r.y;
    q[6 + 4 * i] = r.z;
  }
  for (int k = 0; k < body->nv; k++) {
    v[k] = 2.0 * kg_random_normal(random);
    a[k] = 10.0 * kg_random_normal(random);
  }
}

/* All rotations the identity, root at (0, height, 0). */
static inline void rest_state(const kg_body *body, double height, double *q)
{
  memset(q, 0, (size_t)body->nq * sizeof *q);
  q[1] = height;
  for (int i = 0; i < body->segment_count; i++) {
    q[3 + 4 * i] = 1.0;
  }
}

#endif
