/* Numbers of a data file. */
#include "bench/autodiff/numbers.h"

#include "base/read_file.h"

#include <math.h>
#include <stdio.h>

numbers numbers_open(kg_arena *arena, const char *path, kg_error *error)
{
  numbers in = {.error = error};
  char *content = NULL;
  size_t length = 0;
  in.status = kg_read_file(&content, &length, arena, path, error);
  in.text = kg_text_make(content ? content : "", in.status == KG_OK ? length : 0, path);
  return in;
}

void numbers_read(numbers *in, double *values, size_t count, const char *what)
{
  for (size_t i = 0; i < count && in->status == KG_OK; i++) {
    kg_text_skip_blank(&in->text);
    const kg_number_kind kind = kg_text_number(&in->text, &values[i]);
    if (kind != KG_NUMBER_OK) {
      in->status = kg_text_fail_number(&in->text, in->error, kind, what);
    }
  }
}

int numbers_count(numbers *in, int lowest, int highest, const char *what)
{
  double value = lowest;
  kg_text_skip_blank(&in->text);
  const kg_text before = in->text;
  numbers_read(in, &value, 1, what);
  if (in->status == KG_OK && !(value >= lowest && value <= highest && value == floor(value))) {
    char wanted[160];
    snprintf(wanted, sizeof wanted, "%s, a whole number from %d to %d", what, lowest, highest);
    in->status = kg_text_fail(&before, in->error, wanted);
  }
  return in->status == KG_OK ? (int)value : lowest;
}

void numbers_end(numbers *in)
{
  if (in->status == KG_OK) {
    kg_text_skip_blank(&in->text);
    if (!kg_text_at_end(&in->text)) {
      in->status = kg_text_fail(&in->text, in->error, "the end of the file");
    }
  }
}
