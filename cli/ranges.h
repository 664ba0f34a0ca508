/* Runs of frames: "12-40, 55". Frame numbers are the file's, counted from 0. */
#ifndef CLI_RANGES_H
#define CLI_RANGES_H

#include <jansson.h>
#include <stdbool.h>
#include <stdio.h>

/* Next run of true in flags[count] at or behind *first; false when there is none. [first, last]. */
bool cli_next_range(const bool *flags, int count, int *first, int *last);

/* At most `most` runs ("..." for the rest); offset is added to every number. */
void cli_print_ranges(FILE *out, const bool *flags, int count, int offset, int most);

/* [[first, last], ...] */
json_t *cli_json_ranges(const bool *flags, int count, int offset);

#endif
