/* A mesh as sdf/mesh_build.c makes it and sdf/mesh.c reads it. Internal to sdf/. */
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
  kg_vec3 lo, hi;          /* bounding box                                                     */
  bool is_closed;
};

#endif
