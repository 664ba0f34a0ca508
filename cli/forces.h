/* The --forces table of `kinegrad correct`. */
#ifndef CLI_FORCES_H
#define CLI_FORCES_H

#include <stdio.h>

#include "kinegrad/correct.h"

/* CSV: one line per motion frame, the unit at the end of each column's name. */
void cli_write_forces(FILE *stream, const kg_subject *subject, const kg_correct_result *result);

#endif
