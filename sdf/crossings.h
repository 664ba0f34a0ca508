/* Triangles that cut through each other. Internal to sdf/. */
#ifndef KG_SDF_CROSSINGS_H
#define KG_SDF_CROSSINGS_H

#include "sdf/bvh.h"
#include "sdf/topology.h"

/* Pairs without a common corner of which one is cut by an edge of the other, beyond rounding; pairs
 * that only touch or lie in one plane are none. Work is bounded: when it runs out, the rest of the
 * triangles is left unsearched and the report says so. tree: over the faces of topo. */
void crossings_describe(const topology *topo, const bvh *tree, kg_mesh_report *report);

#endif
