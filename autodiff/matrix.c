/* matrix */
#include "autodiff/tape.h"
