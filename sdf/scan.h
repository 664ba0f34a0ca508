/* Words, lines and numbers of a mesh file in memory, with the place of each for error messages.
 * Internal to sdf/. */
#ifndef KG_SDF_SCAN_H
#define KG_SDF_SCAN_H

#include "kinegrad/base.h"

/* Lines end with \n, \r\n or \r. */
typedef struct scan {
  const char *path;
  const char *at, *end; /* what is left of the file              */
  long line;            /* 0 before the first scan_line          */
  const char *line_begin;
  const char *word; /* the last one found; at the end of a line: where it was missed */
  size_t length;    /* 0 there                                                       */
  bool comments;    /* # begins one                                                  */
  bool exact;       /* scan_is tells capitals from small letters                     */
  bool continues;   /* a backslash before the end of a line continues it             */
  kg_error *error;
} scan;

scan scan_of(const char *path, const char *content, size_t size, kg_error *error);
/* To the beginning of the next line; false at the end of the file. */
bool scan_line(scan *s);
/* The next word of this line, or of this file. */
bool scan_word(scan *s);
bool scan_token(scan *s);
/* Same letters; capital or not, unless `exact`. */
bool scan_is(const scan *s, const char *word);
/* KG_ERR_FORMAT at the last word. */
kg_status scan_fail(const scan *s, const char *format, ...) KG_PRINTF(2, 3);
/* The last word as text for a message: short, printable; in one of the caller's buffers. */
typedef struct scan_text {
  char text[40];
} scan_text;
scan_text scan_quoted(const scan *s);

/* The last word as a decimal number below 1e18 in size (squares of distances fit floats), or as an
 * integer; integers that are too large are cut to 1e17. */
bool scan_number(const scan *s);
bool scan_integer(const scan *s, long long *out);
/* as scan_integer, of the first part of the word up to a slash */
bool scan_index(const scan *s, long long *out, size_t *length);

#endif
