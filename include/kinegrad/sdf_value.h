/* kinegrad/sdf_value.h - what a signed distance field says of a point. */
#ifndef KINEGRAD_SDF_VALUE_H
#define KINEGRAD_SDF_VALUE_H

#include "kinegrad/vec3.h"

/* Value and derivatives of Phi at a point. Where Phi has no gradient (medial axis, a vertex hit
 * exactly) normal is one of the directions in which Phi grows fastest. */
typedef struct kg_sdf_value {
  double distance;  /* m                                                   */
  kg_vec3 normal;   /* gradient; unit, but shorter in the blend of a smooth union */
  double hessian[6]; /* second derivatives, 1/m: xx yy zz xy xz yz; exact almost everywhere */
} kg_sdf_value;

#endif
