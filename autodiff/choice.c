/* choice */
#include "autodiff/tape.h"
