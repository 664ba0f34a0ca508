/* kinegrad/sdf_value.h - what a signed distance field says of a point. */
#ifndef KINEGRAD_SDF_VALUE_H
#define KINEGRAD_SDF_VALUE_H

#include "kinegrad/vec3.h"

#include <stdbool.h>

/* Value and derivatives of Phi at a point. Where Phi has no gradient (medial axis, a vertex hit
 * exactly) normal is one of the directions in which Phi grows fastest. */
typedef struct kg_sdf_value {
  double distance;  /* m                                                   */
  kg_vec3 normal;   /* gradient; unit, but shorter in the blend of a smooth union */
  double hessian[6]; /* second derivatives, 1/m: xx yy zz xy xz yz; exact almost everywhere */
} kg_sdf_value;

/* A field: the distance changes by no more than the way gone (Lipschitz constant 1). */
typedef kg_sdf_value kg_sdf_fn(kg_vec3 x, void *user);

static inline kg_mat3 kg_sdf_hessian(const kg_sdf_value *value)
{
  const double *h = value->hessian;
  const kg_mat3 H = {{h[0], h[3], h[4], h[3], h[1], h[5], h[4], h[5], h[2]}};
  return H;
}

/* All second derivatives are zero. */
static inline bool kg_sdf_is_flat(const kg_sdf_value *value)
{
  bool flat = true;
  for (int k = 0; k < 6; k++) {
    flat = flat && value->hessian[k] == 0.0;
  }
  return flat;
}

#endif
