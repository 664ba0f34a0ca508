/* PLY: the header's list of elements and their properties, then every value of every element.
 *
 * A property is a number, or a list: a length and as many numbers. In binary files they stand one
 * after the other without gaps, so that one wrong length makes everything after it nonsense. */
#include "sdf/check.h"

#include "sdf/bytes.h"
#include "sdf/scan.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

typedef struct number_type {
  const char *name, *new_name;
  int bytes;
  bool real, negative; /* may have a fraction, may be below 0 */
} number_type;

static const number_type types[] = {
  {"char", "int8", 1, false, true},    {"uchar", "uint8", 1, false, false},
  {"short", "int16", 2, false, true},  {"ushort", "uint16", 2, false, false},
  {"int", "int32", 4, false, true},    {"uint", "uint32", 4, false, false},
  {"float", "float32", 4, true, true}, {"double", "float64", 8, true, true}};

typedef enum role { OTHER, COORDINATE, CORNERS } role;

typedef struct property {
  const number_type *length, *value; /* length: NULL unless a list */
  role role;
  char name[16]; /* of what is not OTHER */
} property;

enum { MOST_PROPERTIES = 64, MOST_ELEMENTS = 16 };

typedef struct element {
  enum { VERTEX, FACE, SOMETHING } kind;
  long long count;
  int property_count;
  property properties[MOST_PROPERTIES];
} element;

typedef struct ply {
  mesh_file *file;
  scan s;                        /* the header, then the body of a text file          */
  const unsigned char *at, *end; /* the body of a binary file                         */
  bool text, big;                /* big: the most significant byte first              */
  int element_count;
  element elements[MOST_ELEMENTS];
} ply;

/* ---- header ------------------------------------------------------------------------------------*/

static const number_type *type_of(const scan *s)
{
  for (size_t i = 0; i < KG_COUNT_OF(types); i++) {
    if (scan_is(s, types[i].name) || scan_is(s, types[i].new_name)) return &types[i];
  }
  return NULL;
}

static kg_status header_format(ply *p)
{
  scan *s = &p->s;
  if (!scan_word(s)) return scan_fail(s, "the format is missing");
  p->text = scan_is(s, "ascii");
  p->big = scan_is(s, "binary_big_endian");
  if (!p->text && !p->big && !scan_is(s, "binary_little_endian")) {
    return scan_fail(s, "expected ascii, binary_little_endian or binary_big_endian, found \"%s\"",
                     scan_quoted(s).text);
  }
  if (!scan_word(s) || !scan_is(s, "1.0")) return scan_fail(s, "expected version 1.0");
  return KG_OK;
}

/* vertices first, then faces: OpenMesh mixes up a second list of either with the first */
static kg_status header_element(ply *p)
{
  scan *s = &p->s;
  if (p->element_count == MOST_ELEMENTS) {
    return kg_fail(s->error, KG_ERR_UNSUPPORTED, s->path, s->line, 0,
                   "a ply file with more than %d elements is not read", MOST_ELEMENTS);
  }
  element *e = &p->elements[p->element_count];
  *e = (element){.kind = SOMETHING};
  if (!scan_word(s)) return scan_fail(s, "the name of the element is missing");
  if (scan_is(s, "vertex")) e->kind = VERTEX;
  if (scan_is(s, "face")) e->kind = FACE;
  if (p->element_count < 2 ? (int)e->kind != p->element_count : e->kind != SOMETHING) {
    return scan_fail(s, "expected vertex, then face, then other elements, found \"%s\"",
                     scan_quoted(s).text);
  }
  if (!scan_word(s) || !scan_integer(s, &e->count) || e->count < 0 || e->count > INT_MAX) {
    return scan_fail(s, "expected how many of the element there are, found \"%s\"",
                     scan_quoted(s).text);
  }
  p->element_count++;
  return KG_OK;
}

static role role_of(const scan *s, const element *e, bool list)
{
  if (e->kind == VERTEX && !list && (scan_is(s, "x") || scan_is(s, "y") || scan_is(s, "z"))) {
    return COORDINATE;
  }
  return e->kind == FACE && list && (scan_is(s, "vertex_indices") || scan_is(s, "vertex_index"))
           ? CORNERS
           : OTHER;
}

static kg_status header_property(ply *p)
{
  scan *s = &p->s;
  if (p->element_count == 0) return scan_fail(s, "a property comes before its element");
  element *e = &p->elements[p->element_count - 1];
  if (e->property_count == MOST_PROPERTIES) {
    return kg_fail(s->error, KG_ERR_UNSUPPORTED, s->path, s->line, 0,
                   "an element with more than %d properties is not read", MOST_PROPERTIES);
  }
  property *q = &e->properties[e->property_count++];
  *q = (property){0};
  bool read = scan_word(s);
  const bool list = read && scan_is(s, "list");
  if (list) {
    q->length = scan_word(s) ? type_of(s) : NULL;
    if (!q->length || q->length->real) {
      return scan_fail(s, "expected the type of a list's length, found \"%s\"",
                       scan_quoted(s).text);
    }
    read = scan_word(s);
  }
  q->value = read ? type_of(s) : NULL;
  if (!q->value) {
    return scan_fail(s, "expected the type of a property, found \"%s\"", scan_quoted(s).text);
  }
  if (!scan_word(s)) return scan_fail(s, "the property's name is missing");
  q->role = role_of(s, e, list);
  if ((q->role == COORDINATE && !q->value->real) || (q->role == CORNERS && q->value->real)) {
    return scan_fail(s, "\"%s\" has a type that does not fit it", scan_quoted(s).text);
  }
  if (q->role == CORNERS && q->length->bytes == 2 && !p->text) {
    return kg_fail(s->error, KG_ERR_UNSUPPORTED, s->path, s->line, 0,
                   "faces whose number of corners is a %s are not read in binary", q->length->name);
  }
  for (const property *o = e->properties; q->role == COORDINATE && o < q; o++) {
    if (o->role == COORDINATE && scan_is(s, o->name)) {
      return scan_fail(s, "\"%s\" is given twice", o->name);
    }
  }
  if (q->role != OTHER) memcpy(q->name, s->word, s->length); /* the longest has 14 letters */
  return KG_OK;
}

static int roles(const element *e, role wanted)
{
  int count = 0;
  for (int i = 0; i < e->property_count; i++) {
    count += e->properties[i].role == wanted;
  }
  return count;
}

static kg_status header_end(ply *p)
{
  for (int i = 0; i < p->element_count; i++) {
    if (p->elements[i].property_count == 0) {
      return scan_fail(&p->s, "element %d of the ply header has no property", i + 1);
    }
  }
  if (p->element_count < 2) return scan_fail(&p->s, "the ply header announces no faces");
  if (roles(&p->elements[0], COORDINATE) != 3) {
    return scan_fail(&p->s, "the ply header must give vertices x, y and z");
  }
  if (roles(&p->elements[1], CORNERS) != 1) {
    return scan_fail(&p->s, "the ply header must give faces one list vertex_indices");
  }
  p->file->vertices = p->elements[0].count;
  p->file->faces = p->elements[1].count;
  return KG_OK;
}

/* OpenMesh knows line feeds only */
static bool has_lone_return(const mesh_file *file, const char *until)
{
  for (const char *at = file->content; at < until; at++) {
    if (*at == '\r' && (at + 1 == until || at[1] != '\n')) return true;
  }
  return false;
}

static kg_status header_line(ply *p, bool first)
{
  scan *s = &p->s;
  kg_status status = KG_OK;
  if (first != scan_is(s, "format")) {
    return scan_fail(s, "expected %s, found \"%s\"",
                     first ? "format" : "element, property or end_header", scan_quoted(s).text);
  }
  if (scan_is(s, "format"))
    status = header_format(p);
  else if (scan_is(s, "element"))
    status = header_element(p);
  else if (scan_is(s, "property"))
    status = header_property(p);
  else if (scan_is(s, "end_header"))
    status = header_end(p);
  else
    return scan_fail(s, "expected element, property or end_header, found \"%s\"",
                     scan_quoted(s).text);
  if (status == KG_OK && scan_word(s)) {
    return scan_fail(s, "\"%s\" is one word too many", scan_quoted(s).text);
  }
  return status;
}

static kg_status header(ply *p)
{
  scan *s = &p->s;
  bool format = false;
  if (!scan_line(s) || !scan_word(s) || !scan_is(s, "ply")) {
    return scan_fail(s, "not a ply file: it begins with \"%s\"", scan_quoted(s).text);
  }
  while (scan_line(s)) {
    if (!scan_word(s) || (format && (scan_is(s, "comment") || scan_is(s, "obj_info")))) continue;
    const bool last = scan_is(s, "end_header");
    const kg_status status = header_line(p, !format);
    if (status != KG_OK || last) return status;
    format = true;
  }
  return scan_fail(s, "the ply header has no end");
}

/* ---- the plain copy ----------------------------------------------------------------------------
 *
 * OpenMesh gives up on elements it does not know: coordinates and corners alone, in the file's own
 * types and order of bytes. Every word and byte of it was in the file. */

/* Lists may begin with uchar or int, as OpenMesh has it; what was checked fits, and in a text the
 * type does not show. */
static const char *plain_name(const ply *p, const number_type *type, bool length)
{
  if (length && !p->text && type->bytes == 1) return "uchar";
  return (length && p->text) || strcmp(type->name, "uint") == 0 ? "int" : type->name;
}

static void put_header(ply *p)
{
  check_put_text(p->file, "ply\nformat ");
  check_put_text(p->file, p->text  ? "ascii"
                          : p->big ? "binary_big_endian"
                                   : "binary_little_endian");
  check_put_text(p->file, " 1.0\n");
  for (int n = 0; n < 2; n++) {
    const element *e = &p->elements[n];
    char line[64];
    snprintf(line, sizeof line, "element %s %lld\n", n == 0 ? "vertex" : "face", e->count);
    check_put_text(p->file, line);
    for (int k = 0; k < e->property_count; k++) {
      const property *q = &e->properties[k];
      if (q->role == OTHER) continue;
      snprintf(line, sizeof line, "property %s%s%s%s %s\n", q->length ? "list " : "",
               q->length ? plain_name(p, q->length, true) : "", q->length ? " " : "",
               plain_name(p, q->value, false), q->name);
      check_put_text(p->file, line);
    }
  }
  check_put_text(p->file, "end_header\n");
}

/* ---- body --------------------------------------------------------------------------------------*/

static double binary_value(const unsigned char *bytes, const number_type *type, bool big)
{
  const uint64_t bits = bytes_value(bytes, type->bytes, big);
  if (type->real) return type->bytes == 8 ? bytes_double(bits) : (double)bytes_float(bits);
  const double top = ldexp(1.0, 8 * type->bytes);
  const double value = (double)bits;
  return type->negative && value >= 0.5 * top ? value - top : value;
}

static const char *element_name(const element *e)
{
  return e->kind == VERTEX ? "vertex" : e->kind == FACE ? "face" : "element after the faces";
}

static kg_status text_value(ply *p, const element *e, long long i, const number_type *type,
                            bool keep, double *out)
{
  scan *s = &p->s;
  if (!scan_token(s)) {
    return scan_fail(s, "the file ends within %s %lld of %lld", element_name(e), i + 1, e->count);
  }
  long long whole = 0;
  const double top = ldexp(1.0, 8 * type->bytes - (type->negative ? 1 : 0));
  const bool good = type->real ? scan_number(s)
                               : scan_integer(s, &whole) && (double)whole < top &&
                                   (double)whole >= (type->negative ? -top : 0.0);
  if (!good) {
    return scan_fail(s, "%s %lld: expected a value of type %s%s, found \"%s\"", element_name(e),
                     i + 1, type->name, type->real ? " below 1e18" : "", scan_quoted(s).text);
  }
  *out = (double)whole; /* of real numbers only the form counts */
  if (keep) {
    check_put(p->file, s->word, s->length);
    check_put_text(p->file, " ");
  }
  return KG_OK;
}

static long long byte_of(const ply *p)
{
  return (long long)((const char *)p->at - p->file->content);
}

static kg_status binary_next(ply *p, const element *e, long long i, const number_type *type,
                             bool keep, double *out)
{
  if (p->end - p->at < type->bytes) {
    return kg_fail(p->s.error, KG_ERR_FORMAT, p->file->path, 0, 0,
                   "byte %lld: the file ends within %s %lld of %lld", byte_of(p), element_name(e),
                   i + 1, e->count);
  }
  *out = binary_value(p->at, type, p->big);
  if (keep) check_put(p->file, p->at, (size_t)type->bytes);
  p->at += type->bytes;
  return KG_OK;
}

static kg_status next_value(ply *p, const element *e, long long i, const number_type *type,
                            bool keep, double *out)
{
  return p->text ? text_value(p, e, i, type, keep, out) : binary_next(p, e, i, type, keep, out);
}

/* a value that was read but may not stand there */
static kg_status refuse(const ply *p, const number_type *type, const element *e, long long i,
                        const char *what, double value)
{
  if (p->text) return scan_fail(&p->s, "%s %lld %s %.9g", element_name(e), i + 1, what, value);
  return kg_fail(p->s.error, KG_ERR_FORMAT, p->file->path, 0, 0, "byte %lld: %s %lld %s %.9g",
                 byte_of(p) - type->bytes, element_name(e), i + 1, what, value);
}

static kg_status check_corner(const ply *p, const property *q, const element *e, long long i,
                              double value)
{
  if (value >= 0.0 && value < (double)p->file->vertices) return KG_OK;
  char what[80];
  snprintf(what, sizeof what, "uses a vertex, expected 0 to %lld, found", p->file->vertices - 1);
  return refuse(p, q->value, e, i, what, value);
}

static kg_status check_property(ply *p, const property *q, const element *e, long long i)
{
  const bool keep = q->role != OTHER;
  double value, length = 1.0;
  if (q->length) {
    const kg_status status = next_value(p, e, i, q->length, keep, &length);
    if (status != KG_OK) return status;
    if (length < 0.0 || (q->role == CORNERS && length < 3.0)) {
      return refuse(p, q->length, e, i, "has a list of a length that cannot be:", length);
    }
  }
  for (double k = 0.0; k < length; k++) {
    kg_status status = next_value(p, e, i, q->value, keep, &value);
    if (status == KG_OK && q->role == CORNERS) status = check_corner(p, q, e, i, value);
    if (status == KG_OK && q->role == COORDINATE && !(fabs(value) < 1e18)) {
      status = refuse(p, q->value, e, i, "is not a usable point:", value);
    }
    if (status != KG_OK) return status;
  }
  return KG_OK;
}

static kg_status body(ply *p)
{
  for (int n = 0; n < p->element_count; n++) {
    const element *e = &p->elements[n];
    for (long long i = 0; i < e->count; i++) {
      for (int k = 0; k < e->property_count; k++) {
        const kg_status status = check_property(p, &e->properties[k], e, i);
        if (status != KG_OK) return status;
      }
    }
  }
  return KG_OK;
}

kg_status check_ply(mesh_file *file, kg_error *error)
{
  ply p = {.file = file, .s = scan_of(file->path, file->content, file->size, error)};
  p.s.exact = true; /* as OpenMesh has it */
  kg_status status = header(&p);
  if (status != KG_OK) return status;
  file->binary = !p.text;
  scan_line(&p.s); /* the body follows the header's last line end */
  if (has_lone_return(file, p.s.at)) {
    return scan_fail(&p.s, "the lines of a ply header must end with a line feed");
  }
  if (!p.text) {
    p.at = (const unsigned char *)p.s.at;
    p.end = (const unsigned char *)p.s.end;
  }
  put_header(&p);
  return body(&p);
}
