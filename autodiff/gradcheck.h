/* gradcheck.h - what the registry needs beyond kinegrad/gradcheck.h. */
#ifndef AUTODIFF_GRADCHECK_H
#define AUTODIFF_GRADCHECK_H

#include "autodiff/oplist.h"
#include "kinegrad/gradcheck.h"

/* kg_gradcheck_recorded with the derivative at x compared to complex steps at another point, the side of a kink;
 * NULL: to zero. */
kg_status kg_gradcheck_beside(const char *name, kg_recorded function, void *user, kg_shape shape,
                              const double *x, const double *beside, const kg_gradcheck_def *def,
                              kg_gradcheck_report *report, kg_error *error);

/* the operator that entry i of the registry checks */
kg_op kg_registry_op(int i);

#endif
