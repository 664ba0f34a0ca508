/* Reading text with line and column, and numbers to and from decimals.
 *
 * Numbers: up to 19 digits are gathered in an integer w. When w < 2^53 and the power of ten is at
 * most 10^22 in size, w and the power are both exact doubles and one division or multiplication
 * rounds correctly (W. Clinger, How to read floating point numbers accurately, PLDI 1990). All
 * other numbers go to strtod. Printing inverts the same observation: if r / 10^d == x for an
 * integer r < 2^53, then the decimal text of r with d places reads back as x. */
#include "mocap/mocap.h"

#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LONGEST_NUMBER = 1023 };

static const double powers_of_ten[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                       1e8,  1e9,  1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
                                       1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

static bool is_space(char c)
{
  return c == ' ' || c == '\t' || c == '\v' || c == '\f';
}

static bool is_line_end(char c)
{
  return c == '\n' || c == '\r';
}

static bool is_digit(char c)
{
  return c >= '0' && c <= '9';
}

static char lower(char c)
{
  return c >= 'A' && c <= 'Z' ? (char)(c - 'A' + 'a') : c;
}

/* ---- position -------------------------------------------------------------------------------- */

kg_text kg_text_make(const char *start, size_t length, const char *path)
{
  kg_text text = {.at = start, .end = start + length, .line_start = start, .line = 1, .path = path};
  if (length >= 3 && memcmp(start, "\xef\xbb\xbf", 3) == 0) { /* UTF-8 byte order mark */
    text.at += 3;
  }
  return text;
}

bool kg_text_at_end(const kg_text *text)
{
  return text->at == text->end;
}

bool kg_text_at_line_end(const kg_text *text)
{
  return text->at == text->end || is_line_end(*text->at);
}

void kg_text_skip_spaces(kg_text *text)
{
  while (text->at < text->end && is_space(*text->at)) {
    text->at++;
  }
}

static void skip_line_end(kg_text *text)
{
  if (*text->at == '\r' && text->end - text->at > 1 && text->at[1] == '\n') {
    text->at++;
  }
  text->at++;
  text->line++;
  text->line_start = text->at;
}

void kg_text_skip_blank(kg_text *text)
{
  for (;;) {
    kg_text_skip_spaces(text);
    if (text->at == text->end || !is_line_end(*text->at)) {
      return;
    }
    skip_line_end(text);
  }
}

void kg_text_skip_line(kg_text *text)
{
  while (!kg_text_at_line_end(text)) {
    text->at++;
  }
  if (text->at < text->end) {
    skip_line_end(text);
  }
}

/* ---- words ----------------------------------------------------------------------------------- */

kg_word kg_text_peek(const kg_text *text)
{
  const char *stop = text->at;
  while (stop < text->end && !is_space(*stop) && !is_line_end(*stop)) {
    stop++;
  }
  return (kg_word){text->at, (size_t)(stop - text->at)};
}

kg_word kg_text_next(kg_text *text)
{
  const kg_word word = kg_text_peek(text);
  text->at += word.length;
  return word;
}

kg_word kg_text_rest(kg_text *text, char stop)
{
  kg_text_skip_spaces(text);
  const char *start = text->at;
  while (!kg_text_at_line_end(text) && *text->at != stop) {
    text->at++;
  }
  const char *last = text->at;
  while (last > start && is_space(last[-1])) {
    last--;
  }
  return (kg_word){start, (size_t)(last - start)};
}

bool kg_word_is(kg_word word, const char *name)
{
  for (size_t i = 0; i < word.length; i++) {
    if (name[i] == '\0' || lower(word.start[i]) != lower(name[i])) {
      return false;
    }
  }
  return name[word.length] == '\0';
}

/* ---- numbers --------------------------------------------------------------------------------- */

/* Any number that passed the grammar, correctly rounded; strtod wants its locale's point. */
static double slow_number(const char *start, size_t length)
{
  char buffer[LONGEST_NUMBER + 16];
  size_t n = 0;
  for (size_t i = 0; i < length; i++) {
    if (start[i] != '.') {
      buffer[n++] = start[i];
      continue;
    }
    const char *point = localeconv()->decimal_point;
    for (size_t k = 0; k < 8 && point[k] != '\0'; k++) {
      buffer[n++] = point[k];
    }
  }
  buffer[n] = '\0';
  return strtod(buffer, NULL);
}

/* A decimal number as it is scanned: w 10^power, when exact. */
typedef struct decimal {
  uint64_t w;
  int digits, power; /* digits: in w, without leading zeros */
  bool any, exact;
} decimal;

/* digits before (step 0) or after the point (step 1) */
static const char *scan_digits(decimal *number, const char *p, const char *end, int step)
{
  for (; p < end && is_digit(*p); p++) {
    number->any = true;
    if (number->digits < 19 && number->power > -400) {
      number->w = 10 * number->w + (uint64_t)(*p - '0');
      number->digits += number->w > 0;
      number->power -= step;
    } else {
      number->exact = false;
    }
  }
  return p;
}

/* after the 'e'; NULL when there is no digit */
static const char *scan_exponent(decimal *number, const char *p, const char *end)
{
  const bool down = p < end && *p == '-';
  int exponent = 0;
  if (p < end && (*p == '-' || *p == '+')) {
    p++;
  }
  if (p == end || !is_digit(*p)) {
    return NULL;
  }
  for (; p < end && is_digit(*p); p++) {
    exponent = exponent < 100000 ? 10 * exponent + (*p - '0') : exponent;
  }
  number->power += down ? -exponent : exponent;
  return p;
}

/* [+-] digits [. digits] [e [+-] digits], at least one digit before or after the point; the end of
 * the number, or NULL */
static const char *scan_number(decimal *number, const char *p, const char *end)
{
  if (p < end && (*p == '-' || *p == '+')) {
    p++;
  }
  p = scan_digits(number, p, end, 0);
  if (p < end && *p == '.') {
    p = scan_digits(number, p + 1, end, 1);
  }
  if (number->any && p < end && (*p == 'e' || *p == 'E')) {
    p = scan_exponent(number, p + 1, end);
  }
  const bool ends = p && (p == end || is_space(*p) || is_line_end(*p));
  return number->any && ends ? p : NULL;
}

kg_number_kind kg_text_number(kg_text *text, double *value)
{
  decimal number = {.exact = true};
  const char *end = scan_number(&number, text->at, text->end);
  if (!end || end - text->at > LONGEST_NUMBER) {
    return KG_NUMBER_NONE;
  }
  double x;
  if (number.exact && number.w <= (UINT64_C(1) << 53) && number.power >= -22 &&
      number.power <= 22) {
    const double w = *text->at == '-' ? -(double)number.w : (double)number.w;
    x = number.power < 0 ? w / powers_of_ten[-number.power] : w * powers_of_ten[number.power];
  } else {
    x = slow_number(text->at, (size_t)(end - text->at));
  }
  if (!isfinite(x)) {
    return KG_NUMBER_NOT_FINITE;
  }
  text->at = end;
  *value = x;
  return KG_NUMBER_OK;
}

kg_number_kind kg_text_value(kg_text *text, double *value)
{
  const kg_text before = *text;
  const kg_number_kind kind = kg_text_number(text, value);
  if (kind != KG_NUMBER_OK || fabs(*value) <= 1e12) {
    return kind;
  }
  *text = before;
  return KG_NUMBER_NOT_FINITE;
}

/* r with d decimal places, trailing zeros dropped */
static size_t print_decimal(char *text, uint64_t r, int d, bool negative)
{
  while (d > 0 && r % 10 == 0) {
    r /= 10;
    d--;
  }
  char reversed[KG_NUMBER_TEXT];
  size_t n = 0;
  for (int k = 0; r > 0 || k <= d; k++) { /* at least one digit before the point */
    if (k == d && d > 0) {
      reversed[n++] = '.';
    }
    reversed[n++] = (char)('0' + r % 10);
    r /= 10;
  }
  size_t length = 0;
  if (negative) {
    text[length++] = '-';
  }
  while (n > 0) {
    text[length++] = reversed[--n];
  }
  text[length] = '\0';
  return length;
}

/* The locale's decimal point, of however many bytes, becomes '.'. */
static size_t without_locale(char *text)
{
  size_t length = 0;
  for (const char *p = text; *p != '\0'; p++) {
    if (is_digit(*p) || *p == '-' || *p == '+' || *p == 'e') {
      text[length++] = *p;
    } else if (length > 0 && text[length - 1] != '.') {
      text[length++] = '.';
    }
  }
  text[length] = '\0';
  return length;
}

size_t kg_print_number(char *text, double value)
{
  const double size = fabs(value);
  for (int d = 4; d <= 10; d += d < 6 ? 2 : 3) { /* 4, 6, 9 places */
    const double r = floor(size * powers_of_ten[d] + 0.5);
    if (r <= 0x1p53 && r / powers_of_ten[d] == size) {
      return print_decimal(text, (uint64_t)r, d, signbit(value) != 0);
    }
  }
  for (int digits = 15;; digits++) {
    snprintf(text, KG_NUMBER_TEXT, "%.*g", digits, value);
    const size_t length = without_locale(text);
    kg_text back = kg_text_make(text, length, "");
    double again = 0.0;
    if (digits == 17 || (kg_text_number(&back, &again) == KG_NUMBER_OK && again == value)) {
      return length;
    }
  }
}

/* ---- messages -------------------------------------------------------------------------------- */

/* The word at the text's position, cut and made printable. */
static const char *shown_word(const kg_text *text, char shown[40])
{
  kg_text at = *text;
  kg_text_skip_spaces(&at);
  if (kg_text_at_end(&at)) {
    return "the end of the file";
  }
  if (kg_text_at_line_end(&at)) {
    return "the end of the line";
  }
  const kg_word word = kg_text_peek(&at);
  size_t n = 0;
  shown[n++] = '\'';
  for (size_t i = 0; i < word.length && i < 24; i++) {
    const unsigned char c = (unsigned char)word.start[i];
    shown[n++] = c < 0x20 || c >= 0x7f ? '?' : (char)c;
  }
  snprintf(shown + n, 40 - n, "%s'", word.length > 24 ? "..." : "");
  return shown;
}

kg_status kg_text_fail(const kg_text *text, kg_error *error, const char *wanted)
{
  char shown[40];
  return kg_fail(error, KG_ERR_FORMAT, text->path, text->line,
                 (long)(text->at - text->line_start) + 1, "found %s, expected %s",
                 shown_word(text, shown), wanted);
}

kg_status kg_text_fail_number(const kg_text *text, kg_error *error, kg_number_kind kind,
                              const char *wanted)
{
  if (kind != KG_NUMBER_NOT_FINITE) {
    return kg_text_fail(text, error, wanted);
  }
  char shown[40];
  return kg_fail(error, KG_ERR_FORMAT, text->path, text->line,
                 (long)(text->at - text->line_start) + 1, "%s is too large, expected %s",
                 shown_word(text, shown), wanted);
}
