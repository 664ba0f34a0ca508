/* The derivatives of the upper floors as rows for `kinegrad gradcheck`: rotations, signed
 * distances, contact, dynamics, the step, the penetration loss, operators of the dynamics. Those of the engine are in
 * kg_registry (kinegrad/gradcheck.h). */
#ifndef CLI_GRADCHECK_H
#define CLI_GRADCHECK_H

#include "kinegrad/gradcheck.h"
#include "kinegrad/subject.h"

typedef struct cli_models cli_models;

/* subject: whose body, ground and motion are used; NULL: a small body of our own at random
 * poses. */
KG_MUST_USE kg_status cli_models_create(cli_models **models, const kg_subject *subject);
void cli_models_destroy(cli_models *models);

int cli_models_count(void);
const char *cli_models_name(int i);
/* As kg_registry_check. Rows of a whole body are checked at one point for every 5, operators of the
 * tape at one for every 20. */
kg_status cli_models_check(cli_models *models, int i, int points, const kg_gradcheck_def *def,
                           kg_gradcheck_report *report, kg_error *error);

#endif
