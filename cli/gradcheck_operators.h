/* Rows of `kinegrad gradcheck` for the operators of kinegrad/dynamics_operators.h and losses.h: recorded functions
 * of small changes about a state. */
#ifndef CLI_GRADCHECK_OPERATORS_H
#define CLI_GRADCHECK_OPERATORS_H

#include "kinegrad/dynamics_operators.h"
#include "kinegrad/gradcheck.h"

typedef struct cli_operators cli_operators;

/* scene is copied, body borrowed. */
KG_MUST_USE kg_status cli_operators_create(cli_operators **operators, const kg_body *body,
                                           const kg_scene *scene, double dt);
void cli_operators_destroy(cli_operators *operators);

int cli_operators_count(void);
const char *cli_operators_name(int i);
/* What kind of state a row wants: anything, or near the ground and slow. */
bool cli_operators_in_contact(int i);

/* Row i at one state. */
kg_status cli_operators_check(cli_operators *operators, int i, const double *q, const double *v,
                              const double *a, const kg_gradcheck_def *def,
                              kg_gradcheck_report *report, kg_error *error);

#endif
