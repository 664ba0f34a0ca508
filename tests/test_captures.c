/* Both methods of kg_correct on whole clips: the synthetic walker of tests/data, and captures where
 * they are installed (Debian: assimp-testmodels) or lie beside the project. */
#include "fixture_clip.h"

#include "kinegrad/correct.h"
#include "kinegrad/dynamics.h"

#include <stdio.h>

enum { LONGEST = 72 }; /* frames that are looked at */

#define ASSIMP "/usr/share/assimp/models/BVH/"
#define BESIDE KG_TEST_DATA "/../../../shared/data/"

/* Opens the clip, or says that it is not there and skips the test. */
static kg_clip *clip_or_skip(const char *path)
{
  FILE *file = fopen(path, "rb");
  if (!file) {
    print_message("skipped: %s is not there\n", path);
    skip();
  }
  fclose(file);
  const kg_clip_def def = kg_clip_default_def();
  kg_clip *clip;
  kg_error error = {.text = ""};
  if (kg_clip_read(&clip, path, &def, &error) != KG_OK) {
    fail_msg("%s: %s", path, error.text);
  }
  if (clip->frame_count > LONGEST) {
    clip->frame_count = LONGEST;
  }
  return clip;
}

static double lowest_point(const kg_subject *subject, kg_dynamics *dynamics, const double *q)
{
  double least = INFINITY;
  for (int k = 0; k < subject->body->point_count; k++) {
    const kg_vec3 x = kg_dynamics_point(dynamics, NULL, q, subject->body->points[k]);
    least = fmin(least, kg_scene_distance(&subject->scene, x).distance);
  }
  return least;
}

/* The result is finite and above the ground, in the states and in the clip they are written to. */
static void check(const kg_clip *clip, const kg_subject *subject, const kg_correct_result *r)
{
  const size_t T = (size_t)r->frame_count, nq = (size_t)r->nq;
  kg_dynamics *dynamics;
  kg_clip *out;
  assert_int_equal(kg_dynamics_create(&dynamics, subject->body, NULL), KG_OK);
  double *back = calloc(T * nq, sizeof(double));
  assert_non_null(back);
  assert_int_equal(kg_clip_copy(&out, clip), KG_OK);
  kg_correct_apply(r, subject, out);
  assert_int_equal(kg_subject_states(subject, out, back, NULL), KG_OK);
  assert_int_equal(r->frame_count, clip->frame_count - clip->source.first_frame);
  for (size_t t = 0; t < T; t++) {
    for (size_t i = 0; i < nq; i++) {
      assert_true(isfinite(r->q[t * nq + i]));
    }
    const double low = lowest_point(subject, dynamics, r->q + t * nq);
    assert_at_most(-low, 1e-5);
    assert_close(r->penetration[t], fmax(0.0, -low), 1e-9);
    assert_at_most(-lowest_point(subject, dynamics, back + t * nq), 2e-5);
    /* the root stays near the capture */
    const double *a = r->q + t * nq, *b = subject->q + t * nq;
    assert_at_most(hypot(hypot(a[0] - b[0], a[1] - b[1]), a[2] - b[2]), 0.15);
  }
  free(back);
  kg_clip_destroy(out);
  kg_dynamics_destroy(dynamics);
}

/* stands: its feet rest on the ground now and then */
static void correct_both_ways(const char *path, bool stands)
{
  kg_clip *clip = clip_or_skip(path);
  kg_subject *subject = subject_of(clip, NULL);
  const kg_correct_method methods[] = {KG_CORRECT_SDF, KG_CORRECT_TRACK};
  for (int i = 0; i < 2; i++) {
    kg_correct_def def = kg_correct_default_def();
    def.method = methods[i];
    kg_correct_result *r;
    kg_error error = {.text = ""};
    if (kg_correct(&r, subject, &def, &error) != KG_OK) {
      fail_msg("%s", error.text);
    }
    check(clip, subject, r);
    if (methods[i] == KG_CORRECT_TRACK) {
      assert_int_equal(r->steps_converged, r->steps);
      assert_true(r->steps >= r->frame_count - 1);
      for (size_t k = 0; k < (size_t)r->frame_count * (size_t)r->nv; k++) {
        assert_true(isfinite(r->v[k]) && isfinite(r->tau[k]));
      }
      if (stands) {
        assert_true(r->peak_grf > 0.9 * 9.8 * subject->body->mass);
        assert_at_most(r->residual_force_rms, 0.3);
      } else { /* held by the residual, which must not be hidden */
        assert_true(r->residual_force_rms > 0.3);
      }
    }
    kg_correct_result_destroy(r);
  }
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
}

static void the_walker(void **state)
{
  (void)state;
  correct_both_ways(KG_TEST_DATA "/walker.bvh", false);
}

static void boxing(void **state)
{
  (void)state;
  correct_both_ways(ASSIMP "Boxing_Toes.bvh", true);
}

static void a_forward_jump(void **state)
{
  (void)state;
  correct_both_ways(ASSIMP "01_01.bvh", true);
}

static void a_run(void **state)
{
  (void)state;
  correct_both_ways(BESIDE "track/cmu_09_01.bvh", true);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(the_walker),
    cmocka_unit_test(boxing),
    cmocka_unit_test(a_forward_jump),
    cmocka_unit_test(a_run),
  };
  return cmocka_run_group_tests_name("captures", tests, NULL, NULL);
}
