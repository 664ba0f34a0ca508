/* JSON values for the reports (jansson). A number that is not finite becomes null; keys keep their
 * order; reals have 17 significant digits, so they come back bit-equal. Out of memory ends the
 * command. */
#ifndef CLI_JSON_H
#define CLI_JSON_H

#include <jansson.h>
#include <stdbool.h>

#include "cli/outputs.h"
#include "kinegrad/vec3.h"

void cli_json_init(void);

json_t *cli_json_number(double value);
json_t *cli_json_numbers(const double *values, int count); /* null when values is NULL */
json_t *cli_json_vec3(kg_vec3 a);                          /* [x, y, z] */

json_t *cli_json_text(const char *text); /* bytes that are no UTF-8: ? */

void cli_json_set_number(json_t *object, const char *key, double value);
void cli_json_set_integer(json_t *object, const char *key, long value);
void cli_json_set_text(json_t *object, const char *key, const char *text); /* NULL: null */
void cli_json_set_bool(json_t *object, const char *key, bool value);

/* {"schema": 1, "kinegrad": VERSION, "command": ...} */
json_t *cli_json_report(const char *command);

/* Whether a report goes to stdout ("-"). */
bool cli_json_is_stdout(const char *path);
/* Opens the file of a report; *output stays NULL for "-" and for no report at all. False after a
 * message. */
bool cli_json_open(cli_output **output, const char *path);

/* Writes to the output, or to out when output is NULL. Keys are written as they are: plain words.
 * False after a message. */
bool cli_json_write(json_t *root, cli_output *output, FILE *out);

#endif
