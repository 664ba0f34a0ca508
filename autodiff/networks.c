/* networks */
#include "autodiff/tape.h"
