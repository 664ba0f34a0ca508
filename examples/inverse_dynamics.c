/* The forces behind a captured motion: inverse dynamics of a BVH file, and forward dynamics back.
 * Explained in docs/guide/dynamics-of-a-clip.md.                inverse_dynamics [CAPTURE.bvh]  */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "kinegrad/dynamics.h"
#include "kinegrad/subject.h"

static void print_forces(kg_dynamics *dynamics, const kg_subject *s, double *v, double *a,
                         double *tau, double *again)
{
  const int nq = s->body->nq, nv = s->body->nv, count = s->frame_count - 2;
  /* [forces] */
  for (int t = 0; t < count; ++t) { /* frames 1 .. frame_count - 2 */
    const double *q = s->q + (size_t)(t + 1) * (size_t)nq;
    double *v_t = v + (size_t)t * (size_t)nv, *a_t = a + (size_t)t * (size_t)nv;
    kg_body_difference(s->body, a_t, q, q - nq); /* the way here */
    kg_body_difference(s->body, v_t, q + nq, q); /* the way on   */
    for (int i = 0; i < nv; ++i) {
      const double here = a_t[i] / s->dt, on = v_t[i] / s->dt;
      v_t[i] = (here + on) / 2;
      a_t[i] = (on - here) / s->dt;
    }
  }
  kg_dynamics_inverse_many(dynamics, count, tau, s->q + nq, v, a);
  kg_dynamics_forward_many(dynamics, count, again, s->q + nq, v, tau);
  /* [forces] */
  int quiet = 0, strong = 6;
  double up = 0, least = INFINITY, miss = 0;
  for (int t = 0; t < count; ++t) {
    double motion = 0;
    for (int k = t * nv; k < (t + 1) * nv; ++k) {
      motion += a[k] * a[k];
      miss = fmax(miss, fabs(again[k] - a[k]));
      if (k - t * nv > 5 && fabs(tau[k]) > fabs(tau[strong])) strong = k;
    }
    up += tau[t * nv + 1] / count;
    if (motion < least) least = motion, quiet = t * nv;
  }
  const double *w = tau + quiet;
  printf("weight %.0f N, mean vertical force at the root %.0f N\n", 9.8 * s->body->mass, up);
  printf("quietest, frame %d: force %.0f %.0f %.0f N, moment %.0f %.0f %.0f N m\n", 1 + quiet / nv,
         w[0], w[1], w[2], w[3], w[4], w[5]);
  printf("largest torque: %.0f N m, %s, frame %d\n", fabs(tau[strong]),
         s->body->segments[strong % nv / 3 - 1].name, 1 + strong / nv);
  printf("forward dynamics gives the acceleration back: %s\n", miss < 1e-6 ? "yes" : "no");
}

int main(int argc, char **argv)
{
  const char *capture = argc > 1 ? argv[1] : "tests/data/walker.bvh";
  /* [subject] */
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def(); /* 70 kg */
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  kg_dynamics *dynamics = NULL;
  kg_error error = {0};
  kg_status status = kg_clip_read(&clip, capture, &clip_def, &error);
  if (status == KG_OK) status = kg_subject_create(&subject, clip, &subject_def, &error);
  if (status == KG_OK && subject->frame_count < 3) status = KG_ERR_UNSUPPORTED;
  if (status == KG_OK) status = kg_dynamics_create(&dynamics, subject->body, NULL);
  /* [subject] */
  const size_t size = status == KG_OK ? (size_t)(subject->frame_count * subject->body->nv) : 0;
  double *work = size ? malloc(4 * size * sizeof *work) : NULL;
  if (work) print_forces(dynamics, subject, work, work + size, work + 2 * size, work + 3 * size);
  if (status != KG_OK) {
    fprintf(stderr, "%s: %s\n", capture, error.text[0] ? error.text : "no memory or too short");
  }
  free(work);
  kg_dynamics_destroy(dynamics);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  return work ? 0 : 1;
}
