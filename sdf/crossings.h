/* Triangles that cut through each other. Internal to sdf/. */
#ifndef KG_SDF_CROSSINGS_H
#define KG_SDF_CROSSINGS_H

#include "sdf/topology.h"

/* Pairs without a common corner of which one is cut by an edge of the other, beyond rounding; pairs
 * that only touch or lie in one plane are none. Work is bounded: when it runs out, the rest of the
 * triangles is left unsearched and the report says so. False: no memory. */
bool crossings_describe(const topology *topo, kg_mesh_report *report, kg_arena *arena);

#endif
