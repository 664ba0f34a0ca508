/* A mesh as sdf/mesh_build.c makes it and sdf/mesh.c reads it, and its single triangles for those who
 * search in their own way. Internal to sdf/. */
#ifndef KG_SDF_MESH_INTERNAL_H
#define KG_SDF_MESH_INTERNAL_H

#include "kinegrad/arena.h"
#include "kinegrad/mesh.h"
#include "sdf/kernels/kernels.h"

struct kg_mesh {
  kg_arena arena;
  const kg_sdf_kernels *kernels;
  bvh tree;
  int (*corner)[3];        /* of a face: its vertices                                          */
  int (*across)[3];        /* ... the faces across its edges ab, bc, ca: itself at a border, ~k at
                              odd edge k                                                       */
  int *source;             /* ... number in the input                                          */
  kg_vec3 *normal;         /* ... unit normal                                                  */
  kg_vec3 *vertex_normals; /* pseudo-normals, unit or zero                                     */
  kg_vec3 *odd_normals;    /* the same of the edges of more than two faces, any length         */
  bool is_closed;
};

/* Corners of the triangle in a slot of the tree, counter-clockwise from outside. */
void mesh_corners(const kg_mesh *mesh, int slot, kg_vec3 out[3]);
/* Value at x as if the triangle in this slot were the nearest. False when another one that is nearer
 * by rounding could have the other sign: x lies far beside the pseudo-normal of an edge or corner.
 * Coordinates below 1e18. */
bool mesh_value_on(const kg_mesh *mesh, kg_vec3 x, int slot, kg_sdf_value *out);

#endif
