/* Runs of frames. */
#include "cli/ranges.h"

bool cli_next_range(const bool *flags, int count, int *first, int *last)
{
  int i = *first;
  while (i < count && !flags[i]) {
    i++;
  }
  *first = i;
  while (i < count && flags[i]) {
    i++;
  }
  *last = i - 1;
  return *first < count;
}

void cli_print_ranges(FILE *out, const bool *flags, int count, int offset, int most)
{
  int printed = 0;
  for (int first = 0, last; cli_next_range(flags, count, &first, &last); first = last + 1) {
    if (printed++ == most) {
      fputs(", ...", out);
      return;
    }
    fprintf(out, "%s%d", printed > 1 ? ", " : "", first + offset);
    if (last > first) {
      fprintf(out, "-%d", last + offset);
    }
  }
}

json_t *cli_json_ranges(const bool *flags, int count, int offset)
{
  json_t *ranges = json_array();
  for (int first = 0, last; cli_next_range(flags, count, &first, &last); first = last + 1) {
    json_t *range = json_array();
    json_array_append_new(range, json_integer(first + offset));
    json_array_append_new(range, json_integer(last + offset));
    json_array_append_new(ranges, range);
  }
  return ranges;
}
