/* Private to pipeline/: which way solids that overlap are led apart, over time. */
#ifndef PIPELINE_WAYS_H
#define PIPELINE_WAYS_H

#include "kinegrad/base.h"
#include "kinegrad/vec3.h"

enum { KG_WAY_DIRECTIONS = 42 };

typedef struct kg_ways kg_ways;

/* For a motion of frame_count frames, dt seconds apart. */
KG_MUST_USE kg_status kg_ways_create(kg_ways **ways, int frame_count, double dt,
                                     const kg_allocator *allocator);
void kg_ways_destroy(kg_ways *ways);

/* (KG_WAY_DIRECTIONS) unit vectors, in axes of the caller's choice, the same in all frames of a pair. */
const kg_vec3 *kg_ways_directions(const kg_ways *ways);

/* In this frame the pair is in each other, and apart after way_out (KG_WAY_DIRECTIONS) m along each
 * direction. At most once for every pair and frame. False without memory. */
bool kg_ways_add(kg_ways *ways, int pair, int frame, const double *way_out);
/* Chooses, when all is added. KG_ERR_NO_MEMORY. */
KG_MUST_USE kg_status kg_ways_choose(kg_ways *ways);

/* *way: unit vector along which the pair is led apart; false in frames without. */
bool kg_ways_at(const kg_ways *ways, int pair, int frame, kg_vec3 *way);

#endif
