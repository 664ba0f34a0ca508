/* reductions */
#include "autodiff/tape.h"
