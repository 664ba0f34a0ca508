/* Words and numbers of a text file, by hand: streams and sscanf do not tell where they stopped. */
#include "sdf/scan.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

scan scan_of(const char *path, const char *content, size_t size, kg_error *error)
{
  static const char mark[] = "\xef\xbb\xbf"; /* of the order of bytes; some editors write it */
  const bool marked = size >= 3 && memcmp(content, mark, 3) == 0;
  const char *begin = content + (marked ? 3 : 0);
  return (scan){.path = path,
                .at = begin,
                .end = content + size,
                .line_begin = begin,
                .word = begin,
                .error = error};
}

static bool ends_line(char c)
{
  return c == '\n' || c == '\r';
}

/* past the end of the line that s->at stands on */
static void skip_end(scan *s)
{
  const bool cr = *s->at == '\r';
  s->at++;
  if (cr && s->at < s->end && *s->at == '\n') s->at++;
  s->line++;
  s->line_begin = s->at;
}

bool scan_line(scan *s)
{
  if (s->line == 0) {
    s->line = 1;
  } else {
    while (s->at < s->end && !ends_line(*s->at)) {
      s->at++;
    }
    if (s->at < s->end) skip_end(s);
  }
  s->word = s->at;
  s->length = 0;
  return s->at < s->end;
}

static bool is_blank(char c)
{
  return c == ' ' || c == '\t' || c == '\v' || c == '\f';
}

bool scan_word(scan *s)
{
  for (; s->at < s->end; s->at++) {
    if (s->continues && *s->at == '\\' && s->at + 1 < s->end && ends_line(s->at[1])) {
      s->at++;
      skip_end(s);
      s->at--; /* the loop steps over it */
    } else if (!is_blank(*s->at)) {
      break;
    }
  }
  s->word = s->at;
  s->length = 0;
  if (s->at < s->end && s->comments && *s->at == '#') return false;
  while (s->at < s->end && !is_blank(*s->at) && !ends_line(*s->at) &&
         !(s->comments && *s->at == '#') &&
         !(s->continues && *s->at == '\\' && s->at + 1 < s->end && ends_line(s->at[1]))) {
    s->at++;
  }
  s->length = (size_t)(s->at - s->word);
  return s->length > 0;
}

bool scan_token(scan *s)
{
  while (!scan_word(s)) {
    if (!scan_line(s)) return false;
  }
  return true;
}

bool scan_is(const scan *s, const char *word)
{
  if (strlen(word) != s->length) return false;
  return (s->exact ? memcmp(s->word, word, s->length) : strncasecmp(s->word, word, s->length)) == 0;
}

scan_text scan_quoted(const scan *s)
{
  scan_text out;
  const size_t room = sizeof out.text - 4;
  const size_t n = s->length < room ? s->length : room;
  for (size_t i = 0; i < n; i++) {
    const char c = s->word[i];
    out.text[i] = c >= ' ' && c <= '~' ? c : '?';
  }
  memcpy(out.text + n, s->length > room ? "..." : "", s->length > room ? 4 : 1);
  return out;
}

kg_status scan_fail(const scan *s, const char *format, ...)
{
  char text[sizeof s->error->text];
  va_list args;
  va_start(args, format);
  vsnprintf(text, sizeof text, format, args);
  va_end(args);
  return kg_fail(s->error, KG_ERR_FORMAT, s->path, s->line, (long)(s->word - s->line_begin) + 1,
                 "%s", text);
}

/* digits, a point, an exponent: what every reader of numbers takes alike, unlike nan, inf or 0x1 */
bool scan_number(const scan *s)
{
  char buffer[64];
  if (s->length == 0 || s->length >= sizeof buffer) return false;
  memcpy(buffer, s->word, s->length);
  buffer[s->length] = '\0';
  if (strspn(buffer, "0123456789+-.eE") != s->length) return false;
  char *end;
  const double value = strtod(buffer, &end);
  return *end == '\0' && fabs(value) < 1e18;
}

static bool integer(const char *word, size_t length, long long *out)
{
  const size_t sign = length > 0 && (word[0] == '-' || word[0] == '+');
  long long value = 0;
  if (length == sign) return false;
  for (size_t i = sign; i < length; i++) {
    if (word[i] < '0' || word[i] > '9') return false;
    value = 10 * value + (word[i] - '0');
    if (value > 100000000000000000) value = 100000000000000000;
  }
  *out = word[0] == '-' ? -value : value;
  return true;
}

bool scan_integer(const scan *s, long long *out)
{
  return integer(s->word, s->length, out);
}

bool scan_index(const scan *s, long long *out, size_t *length)
{
  const char *slash = s->length > 0 ? memchr(s->word, '/', s->length) : NULL;
  *length = slash ? (size_t)(slash - s->word) : s->length;
  return integer(s->word, *length, out);
}
