/* Masses, centres of mass and radii of gyration of body parts.
 *
 * [LEVA] P. de Leva, Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, Journal of
 *        Biomechanics 29(9), 1223-1230, 1996, Table 4 (end points vertex-cervicale for head and
 *        neck, cervicale-xiphion for the upper trunk, wrist-dactylion for the hand, knee-ankle
 *        joint centres for the shank).
 *
 * Radii of gyration r (shares of the length L) and the bar they are turned into: with variances
 * C_l along the part, C_m along the mediolateral and C_a along the anteroposterior axis of the
 * mass distribution,
 *   r_sagittal^2     = C_l + C_m   (about the anteroposterior axis)
 *   r_transverse^2   = C_l + C_a   (about the mediolateral axis)
 *   r_longitudinal^2 = C_m + C_a
 * which is solved for the three variances; a uniform bar of half length h has C_l = h^2 / 3. */
#include "physics/deleva.h"

#include <math.h>

typedef struct table_row {
  double mass, com, sagittal, transverse, longitudinal, length_mm;
} table_row;

/* clang-format off */
/* per cent of body mass; per cent of the length for the rest; female, then male */
static const table_row TABLE[KG_PART_COUNT][2] = {
  [KG_PART_HEAD]      = {{ 6.68, 48.41, 27.1, 29.5, 26.1, 243.7}, { 6.94, 50.02, 30.3, 31.5, 26.1, 242.9}},
  [KG_PART_UPPER]     = {{15.45, 50.50, 46.6, 31.4, 44.9, 228.0}, {15.96, 50.66, 50.5, 32.0, 46.5, 242.1}},
  [KG_PART_MIDDLE]    = {{14.65, 45.12, 43.3, 35.4, 41.5, 205.3}, {16.33, 45.02, 48.2, 38.3, 46.8, 215.5}},
  [KG_PART_LOWER]     = {{12.47, 49.20, 43.3, 40.2, 44.4, 181.5}, {11.17, 61.15, 61.5, 55.1, 58.7, 145.7}},
  [KG_PART_UPPER_ARM] = {{ 2.55, 57.54, 27.8, 26.0, 14.8, 275.1}, { 2.71, 57.72, 28.5, 26.9, 15.8, 281.7}},
  [KG_PART_FOREARM]   = {{ 1.38, 45.59, 26.1, 25.7,  9.4, 264.3}, { 1.62, 45.74, 27.6, 26.5, 12.1, 268.9}},
  [KG_PART_HAND]      = {{ 0.56, 34.27, 24.4, 20.8, 15.4, 170.1}, { 0.61, 36.24, 28.8, 23.5, 18.4, 187.9}},
  [KG_PART_THIGH]     = {{14.78, 36.12, 36.9, 36.4, 16.2, 368.5}, {14.16, 40.95, 32.9, 32.9, 14.9, 422.2}},
  [KG_PART_SHANK]     = {{ 4.81, 43.52, 26.7, 26.3,  9.2, 438.6}, { 4.33, 43.95, 25.1, 24.6, 10.2, 440.3}},
  [KG_PART_FOOT]      = {{ 1.29, 40.14, 29.9, 27.9, 13.9, 228.3}, { 1.37, 44.15, 25.7, 24.5, 12.4, 258.1}},
};
/* clang-format on */

static const double STATURE[2] = {1.735, 1.741}; /* female, male; [LEVA], Table 4 */

static table_row mean_row(const table_row *f, const table_row *m)
{
  const table_row r = {0.5 * (f->mass + m->mass),
                       0.5 * (f->com + m->com),
                       0.5 * (f->sagittal + m->sagittal),
                       0.5 * (f->transverse + m->transverse),
                       0.5 * (f->longitudinal + m->longitudinal),
                       0.5 * (f->length_mm + m->length_mm)};
  return r;
}

static table_row row_of(kg_part part, kg_sex sex)
{
  const table_row *rows = TABLE[part];
  return sex == KG_SEX_FEMALE ? rows[0]
         : sex == KG_SEX_MALE ? rows[1]
                              : mean_row(&rows[0], &rows[1]);
}

/* 99.99 (female) or 100.00 (male) in the table: rounding */
static double total_mass(kg_sex sex)
{
  double sum = 0.0;
  for (int part = 0; part < KG_PART_COUNT; part++) {
    sum += (part >= KG_PART_UPPER_ARM ? 2.0 : 1.0) * row_of((kg_part)part, sex).mass;
  }
  return sum;
}

kg_part_bar kg_deleva_bar(kg_part part, kg_sex sex)
{
  const table_row row = row_of(part, sex);
  const double S = 1e-4 * row.sagittal * row.sagittal;
  const double T = 1e-4 * row.transverse * row.transverse;
  const double L = 1e-4 * row.longitudinal * row.longitudinal;
  const kg_part_bar bar = {.mass = row.mass / total_mass(sex),
                           .centre = 1e-2 * row.com,
                           .half = sqrt(1.5 * (S + T - L)),
                           .spread_left = 0.5 * (S + L - T),
                           .spread_front = 0.5 * (T + L - S),
                           .length_m = 1e-3 * row.length_mm};
  return bar;
}

double kg_deleva_stature(kg_sex sex)
{
  return sex == KG_SEX_FEMALE ? STATURE[0]
         : sex == KG_SEX_MALE ? STATURE[1]
                              : 0.5 * (STATURE[0] + STATURE[1]);
}
