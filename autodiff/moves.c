/* moves */
#include "autodiff/tape.h"
