/* Single triangles of a mesh, for those who search in their own way. Internal to sdf/. */
#ifndef KG_SDF_MESH_PARTS_H
#define KG_SDF_MESH_PARTS_H

#include "kinegrad/mesh.h"

/* Triangles are in slots. */
int mesh_slot_count(const kg_mesh *mesh);
/* Corners of the one in this slot, counter-clockwise from outside. False: the slot before has the
 * same one. */
bool mesh_slot(const kg_mesh *mesh, int slot, kg_vec3 out[3]);
bool mesh_is_closed(const kg_mesh *mesh);
/* Value at x as if the triangle in this slot were the nearest. False when another one that is nearer
 * by rounding could have the other sign: x lies far beside the pseudo-normal of an edge or corner.
 * Coordinates below 1e18. */
bool mesh_value_on(const kg_mesh *mesh, kg_vec3 x, int slot, kg_sdf_value *out);

#endif
