/* gradcheck.h - what the registry needs beyond kinegrad/gradcheck.h. */
#ifndef AUTODIFF_GRADCHECK_H
#define AUTODIFF_GRADCHECK_H

#include "autodiff/oplist.h"
#include "kinegrad/gradcheck.h"

/* What a recorded function is compared with: complex steps of `reference`, which must have its
 * values too, at the point `at`; NULL: a derivative of zero. */
typedef struct kg_gradcheck_truth {
  kg_recorded reference;
  const double *at;
} kg_gradcheck_truth;

kg_status kg_gradcheck_against(const char *name, kg_recorded function, void *user, kg_shape shape,
                               const double *x, const kg_gradcheck_truth *truth,
                               const kg_gradcheck_def *def, kg_gradcheck_report *report,
                               kg_error *error);

/* the operator that entry i of the registry checks */
kg_op kg_registry_op(int i);

#endif
