/* Status texts, error detail and the failed-assertion report. */
#include "kinegrad/base.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

const char *kg_status_text(kg_status status)
{
  switch (status) {
#define KG_STATUS_CASE(name, value, text)                                                          \
  case name:                                                                                       \
    return text;
    KG_STATUS_LIST(KG_STATUS_CASE)
#undef KG_STATUS_CASE
  }
  return "unknown status";
}

kg_status kg_fail(kg_error *error, kg_status status, const char *path, long line, long column,
                  const char *format, ...)
{
  if (error) {
    *error = (kg_error){.status = status, .line = line, .column = column};
    snprintf(error->path, sizeof error->path, "%s", path ? path : "");
    va_list args;
    va_start(args, format);
    vsnprintf(error->text, sizeof error->text, format, args);
    va_end(args);
  }
  return status;
}

#ifndef NDEBUG
void kg_assert_failed(const char *condition, const char *file, int line)
{
  fprintf(stderr, "kinegrad: %s:%d: assertion failed: %s\n", file, line, condition);
  abort();
}
#endif
