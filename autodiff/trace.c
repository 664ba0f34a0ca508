/* trace */
#include "autodiff/tape.h"
