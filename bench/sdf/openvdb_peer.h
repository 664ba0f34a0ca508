/* OpenVDB's grids of distances to a mesh, in floats, trilinear between voxels. */
#ifndef BENCH_SDF_OPENVDB_PEER_H
#define BENCH_SDF_OPENVDB_PEER_H

#include "bench/sdf/surfaces.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_openvdb kg_openvdb;

/* Takes the mesh over; builds nothing yet. One thread. */
kg_status kg_openvdb_open(kg_openvdb **vdb, const kg_bench_surface *s, double spacing);
void kg_openvdb_close(kg_openvdb *vdb);

/* Distances within `band` voxels on both sides (meshToLevelSet up to 3, which is its habit, else
 * meshToSignedDistanceField), in place of those that were there. */
kg_status kg_openvdb_build(kg_openvdb *vdb, double band);

/* Distances alone: its sampler of gradients costs several times as much. */
void kg_openvdb_distances(const kg_openvdb *vdb, int count, const kg_vec3 *x, double *distance);

#ifdef __cplusplus
}
#endif
#endif
