/* What tests of the dynamics and the step share: a ground, objects made from a body. */
#ifndef TESTS_FIXTURE_STEP_H
#define TESTS_FIXTURE_STEP_H

#include "support.h"

#include "kinegrad/dynamics.h"
#include "kinegrad/step.h"

#include <math.h>

static inline kg_scene ground(void)
{
  return kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
}

static inline kg_step *step_of(const kg_step_def *def)
{
  kg_step *s = NULL;
  assert_int_equal(kg_step_create(&s, def), KG_OK);
  return s;
}

static inline kg_dynamics *dynamics_of(const kg_body *body)
{
  kg_dynamics *d = NULL;
  assert_int_equal(kg_dynamics_create(&d, body, NULL), KG_OK);
  return d;
}

static inline double largest(const double *a, int count)
{
  double size = 0.0;
  for (int k = 0; k < count; k++) {
    size = fmax(size, fabs(a[k]));
  }
  return size;
}

#endif
