/* rotations */
#include "autodiff/tape.h"
