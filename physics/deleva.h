/* Segment inertia parameters of de Leva (1996) in the form the body builder uses; see deleva.c. */
#ifndef PHYSICS_DELEVA_H
#define PHYSICS_DELEVA_H

#include "kinegrad/body.h"

typedef enum kg_part {
  KG_PART_HEAD,      /* vertex to cervicale: head and neck                     */
  KG_PART_UPPER,     /* upper part of the trunk: cervicale to xiphion          */
  KG_PART_MIDDLE,    /* middle part: xiphion to omphalion                      */
  KG_PART_LOWER,     /* lower part: omphalion to mid-hip                       */
  KG_PART_UPPER_ARM, /* shoulder to elbow                                      */
  KG_PART_FOREARM,   /* elbow to wrist                                         */
  KG_PART_HAND,      /* wrist to tip of the third finger                       */
  KG_PART_THIGH,     /* hip to knee                                            */
  KG_PART_SHANK,     /* knee to ankle                                          */
  KG_PART_FOOT,      /* heel to tip of the longest toe                         */
  KG_PART_COUNT
} kg_part;

/* A part as a bar: uniform along its length, the same section everywhere, with the mass, centre of
 * mass and three radii of gyration of the table. Lengths are shares of the part's length, from its
 * first end point named above; `sagittal` is the spread along the mediolateral axis and so on. */
typedef struct kg_part_bar {
  double mass;         /* share of the body's                                    */
  double centre;       /* of mass, from the first end point                      */
  double half;         /* half of the bar's extent along the part                */
  double spread_left;  /* variance across, along the mediolateral axis           */
  double spread_front; /* variance across, along the anteroposterior axis        */
  double length_m;     /* of the table's subjects                                */
} kg_part_bar;

/* Masses sum to 1 over the body (paired parts counted twice). */
kg_part_bar kg_deleva_bar(kg_part part, kg_sex sex);

/* Stature of the table's subjects, m. */
double kg_deleva_stature(kg_sex sex);

#endif
