/* Scores a method on clips: one line of metrics per clip, for tuning and for the tables in docs/design.
 *
 *   score_clips [--sdf] [--csv] [name=value ...] CLIP...
 *
 * name is a member of kg_track_params, contact.X, or dt. --csv prints comma-separated values under one
 * line of names (SI units); scripts/cross-validate reads them.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "kinegrad/correct.h"
#include "kinegrad/metrics.h"

typedef struct setting {
  const char *name;
  size_t offset;
} setting;

#define TRACK(member)                                                                              \
  {                                                                                                \
#member, offsetof(kg_correct_def, track.member)                                                \
  }
#define CONTACT(member)                                                                            \
  {                                                                                                \
    "contact." #member, offsetof(kg_correct_def, contact.member)                                   \
  }

static const setting SETTINGS[] = {
  TRACK(smoothing_hz),    TRACK(plant_speed),   TRACK(plant_height),
  TRACK(plant_flat),      TRACK(rest_height),   TRACK(clearance),
  TRACK(clearance_speed), TRACK(ease_time),     TRACK(joint_frequency),
  TRACK(root_frequency),  TRACK(wrench_weight), TRACK(moment_weight),
  TRACK(friction_share),  TRACK(leg_weight),    TRACK(joint_damping),
  TRACK(plan_patience),   TRACK(catch_speed),   TRACK(plan_force),
  TRACK(plan_moment),     TRACK(trunk_weight),  CONTACT(layer),
  CONTACT(floor_share),   CONTACT(force),       CONTACT(damping),
  CONTACT(friction),      CONTACT(stick),       {"dt", offsetof(kg_correct_def, dt)},
};

static int set_value(kg_correct_def *def, const char *text)
{
  const char *equal = strchr(text, '=');
  for (size_t i = 0; i < KG_COUNT_OF(SETTINGS); i++) {
    const size_t n = strlen(SETTINGS[i].name);
    if ((size_t)(equal - text) == n && strncmp(text, SETTINGS[i].name, n) == 0) {
      *(double *)((char *)def + SETTINGS[i].offset) = strtod(equal + 1, NULL);
      return 1;
    }
  }
  fprintf(stderr, "score_clips: no setting in \"%s\"\n", text);
  return 0;
}

static void print_line(const char *path, const kg_subject *subject, const kg_correct_result *result,
                       const kg_metrics *metrics)
{
  const kg_motion_metrics *a = &metrics->capture, *b = &metrics->output;
  const char *name = strrchr(path, '/');
  printf(
    "%-20s %5d mpjpe %5.2f/%5.2f pen %.1e ev %.3f slip %.3f>%.3f mm %.3f>%.3f m/s amc %.2f>%.2f "
    "val %.2f>%.2f mb %5.2f>%5.2f fb %4.0f>%4.0f acc %.2f(%s) res %.3f/%.2f mom %.3f/%.2f "
    "corr %.4f/%.3f newton %ld/%ld it %.2f un %d ms %.2f (step %.2f sdf %.2f) grf %.0f\n",
    name ? name + 1 : path, result->frame_count, 100 * metrics->mpjpe_m, 100 * metrics->mpjpe_max_m,
    b->penetration_max_m, b->penetration_events, 1e3 * a->slip_m, 1e3 * b->slip_m, a->slip_m_per_s,
    b->slip_m_per_s, a->angular_momentum_change, b->angular_momentum_change, a->validity,
    b->validity, a->momentum_balance, b->momentum_balance, a->force_balance, b->force_balance,
    metrics->acceleration_peak_ratio,
    subject->body->segments[metrics->acceleration_peak_joint].name, result->residual_force_rms,
    result->residual_force_peak, result->residual_moment_rms, result->residual_moment_peak,
    result->correction_force_ratio, result->correction_force_ratio_peak, result->steps_converged,
    result->steps,
    result->steps > 0 ? (double)result->newton_iterations / (double)result->steps : 0.0,
    result->unexplained_count, result->ms_per_frame, result->ms_step, result->ms_sdf,
    result->peak_grf);
  fflush(stdout);
}

static void print_csv_names(void)
{
  printf("clip,frames,mpjpe_m,mpjpe_max_m,penetration_max_m,slip_m_per_s,slip_capture_m_per_s,"
         "balance,balance_capture,residual_rms,residual_peak,correction_ratio,peak_ratio,"
         "steps_failed_share,ms_per_frame\n");
}

static void print_csv(const char *path, const kg_correct_result *result, const kg_metrics *metrics)
{
  const kg_motion_metrics *a = &metrics->capture, *b = &metrics->output;
  const char *name = strrchr(path, '/');
  const double failed =
    result->steps > 0 ? 1.0 - (double)result->steps_converged / (double)result->steps : 0.0;
  printf("%s,%d,%.6f,%.6f,%.3e,%.6f,%.6f,%.4f,%.4f,%.5f,%.4f,%.6f,%.4f,%.6f,%.3f\n",
         name ? name + 1 : path, result->frame_count, metrics->mpjpe_m, metrics->mpjpe_max_m,
         b->penetration_max_m, b->slip_m_per_s, a->slip_m_per_s, b->momentum_balance,
         a->momentum_balance, result->residual_force_rms, result->residual_force_peak,
         result->correction_force_ratio, metrics->acceleration_peak_ratio, failed,
         result->ms_per_frame);
  fflush(stdout);
}

static int score(const char *path, const kg_correct_def *def, int csv)
{
  kg_clip *clip = NULL;
  kg_subject *subject = NULL;
  kg_correct_result *result = NULL;
  kg_metrics *metrics = NULL;
  kg_error error = {0};
  const kg_clip_def clip_def = kg_clip_default_def();
  const kg_subject_def subject_def = kg_subject_default_def();
  kg_status status = kg_clip_read(&clip, path, &clip_def, &error);
  if (status == KG_OK) status = kg_subject_create(&subject, clip, &subject_def, &error);
  if (status == KG_OK) status = kg_correct(&result, subject, def, &error);
  if (status == KG_OK) status = kg_metrics_create(&metrics, subject, result->q);
  if (status == KG_OK) {
    if (csv) {
      print_csv(path, result, metrics);
    } else {
      print_line(path, subject, result, metrics);
    }
  } else {
    fprintf(stderr, "%s: %s %s\n", path, kg_status_text(status), error.text);
  }
  kg_metrics_destroy(metrics);
  kg_correct_result_destroy(result);
  kg_subject_destroy(subject);
  kg_clip_destroy(clip);
  return status == KG_OK;
}

int main(int argc, char **argv)
{
  kg_correct_def def = kg_correct_default_def();
  int good = 1, csv = 0;
  for (int i = 1; i < argc; i++) {
    if (strcmp(argv[i], "--sdf") == 0) {
      def.method = KG_CORRECT_SDF;
    } else if (strcmp(argv[i], "--csv") == 0) {
      csv = 1;
      print_csv_names();
    } else if (strchr(argv[i], '=')) {
      good = set_value(&def, argv[i]) && good;
    } else {
      good = score(argv[i], &def, csv) && good;
    }
  }
  return good ? 0 : 1;
}
