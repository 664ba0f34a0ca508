/* Numbers of a data file, one after the other, with line and column for messages. */
#ifndef BENCH_AUTODIFF_NUMBERS_H
#define BENCH_AUTODIFF_NUMBERS_H

#include "kinegrad/arena.h"
#include "mocap/mocap.h"

typedef struct numbers {
  kg_text text;
  kg_error *error;
  kg_status status; /* of the first failure; later reads do nothing */
} numbers;

/* The content is kept in the arena. */
numbers numbers_open(kg_arena *arena, const char *path, kg_error *error);
/* what: for the message, "a weight" */
void numbers_read(numbers *in, double *values, size_t count, const char *what);
/* A whole number from lowest to highest; lowest after a failure. */
int numbers_count(numbers *in, int lowest, int highest, const char *what);
/* Fails when something is left. */
void numbers_end(numbers *in);

#endif
