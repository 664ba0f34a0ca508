/* OBJ, OFF and STL: every vertex, face and index, one line at a time. */
#include "sdf/check.h"

#include "sdf/bytes.h"
#include "sdf/scan.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

/* ---- the plain copy ----------------------------------------------------------------------------*/

/* Words take one blank or line end each, as they did in the file: the copy is no longer than it. */
static void put_word(mesh_file *file, const char *text, size_t length, bool first)
{
  if (!first) check_put(file, " ", 1);
  check_put(file, text, length);
}

static kg_status number(scan *s, mesh_file *file, const char *what, bool first)
{
  if (!scan_word(s)) return scan_fail(s, "%s is missing here", what);
  if (!scan_number(s)) {
    return scan_fail(s, "%s: expected a number below 1e18, found \"%s\"", what,
                     scan_quoted(s).text);
  }
  put_word(file, s->word, s->length, first);
  return KG_OK;
}

static kg_status vertex(scan *s, mesh_file *file, bool first)
{
  const char *axes[3] = {"x of a vertex", "y of a vertex", "z of a vertex"};
  for (int i = 0; i < 3; i++) {
    const kg_status status = number(s, file, axes[i], first && i == 0);
    if (status != KG_OK) return status;
  }
  check_put_text(file, "\n");
  return KG_OK;
}

/* ---- OBJ ---------------------------------------------------------------------------------------*/

/* Keywords of the format and of common writers that hold no vertex and no face. */
static const char *const obj_others[] = {
  "vt",        "vn",     "vp",     "g",     "o",        "s",        "mg",   "usemtl",
  "mtllib",    "usemap", "maplib", "l",     "p",        "deg",      "bmat", "step",
  "cstype",    "curv",   "curv2",  "surf",  "parm",     "trim",     "hole", "scrv",
  "sp",        "end",    "con",    "bevel", "c_interp", "d_interp", "lod",  "shadow_obj",
  "trace_obj", "ctech",  "stech",  "call",  "csh"};

/* v is a corner of a face that is neither of the two met before; first[]: those, or 0 */
static bool is_third(long long first[2], long long v)
{
  if (first[0] == 0) first[0] = v;
  if (v == first[0]) return false;
  if (first[1] == 0) first[1] = v;
  return v != first[1];
}

static kg_status obj_face(scan *s, mesh_file *file, long long seen)
{
  int corners = 0;
  long long first[2] = {0, 0}, last = 0, changes = 0;
  bool is_face = false;
  check_put_text(file, "f");
  while (scan_word(s)) {
    long long index;
    size_t length;
    if (!scan_index(s, &index, &length)) {
      return scan_fail(s, "expected the number of a vertex, found \"%s\"", scan_quoted(s).text);
    }
    if (index < 0 ? -index > seen : index < 1 || index > file->vertices) {
      return scan_fail(s, "a face uses vertex %lld, expected 1 to %lld%s", index,
                       index < 0 ? seen : file->vertices, index < 0 ? " back from here" : "");
    }
    put_word(file, s->word, length, false);
    const long long v = index < 0 ? seen + 1 + index : index;
    is_face = is_third(first, v) || is_face;
    changes += v != last;
    last = v;
    corners++;
  }
  if (corners < 3) return scan_fail(s, "a face needs three corners, found %d", corners);
  check_put_text(file, "\n");
  file->faces += is_face;
  file->collapsed += !is_face;
  file->corners += is_face ? changes - (last == first[0]) : 0;
  return KG_OK;
}

static kg_status obj_other(const scan *s)
{
  for (size_t i = 0; i < KG_COUNT_OF(obj_others); i++) {
    if (scan_is(s, obj_others[i])) return KG_OK;
  }
  return scan_fail(s, "\"%s\" is no keyword of the format", scan_quoted(s).text);
}

static scan obj_scan(const mesh_file *file, kg_error *error)
{
  scan s = scan_of(file->path, file->content, file->size, error);
  s.comments = s.continues = true;
  return s;
}

kg_status check_obj(mesh_file *file, kg_error *error)
{
  file->vertices = file->faces = 0;
  for (scan s = obj_scan(file, error); scan_line(&s);) { /* faces may come first */
    file->vertices += scan_word(&s) && scan_is(&s, "v");
  }
  long long seen = 0;
  for (scan s = obj_scan(file, error); scan_line(&s);) {
    kg_status status = KG_OK;
    if (!scan_word(&s)) continue;
    if (scan_is(&s, "v")) {
      check_put_text(file, "v");
      status = vertex(&s, file, false);
      seen++;
    } else if (scan_is(&s, "f") || scan_is(&s, "fo")) {
      status = obj_face(&s, file, seen);
    } else {
      status = obj_other(&s);
    }
    if (status != KG_OK) return status;
  }
  return KG_OK;
}

/* ---- OFF ---------------------------------------------------------------------------------------*/

/* the next line with a word on it, and that word */
static bool filled_line(scan *s)
{
  while (scan_line(s)) {
    if (scan_word(s)) return true;
  }
  return false;
}

static kg_status off_count(scan *s, long long *out, const char *what)
{
  if (!scan_word(s) && !(filled_line(s))) {
    return scan_fail(s, "the off file ends before the number of its %s", what);
  }
  if (!scan_integer(s, out) || *out < 0 || *out > INT_MAX) {
    return scan_fail(s, "expected the number of %s, found \"%s\"", what, scan_quoted(s).text);
  }
  return KG_OK;
}

/* letters before OFF tell what stands behind the coordinates of a vertex: ST, C, N */
static kg_status off_header(scan *s, mesh_file *file)
{
  if (!filled_line(s) || !(scan_is(s, "OFF") || scan_is(s, "COFF") || scan_is(s, "NOFF") ||
                           scan_is(s, "CNOFF") || scan_is(s, "STOFF") || scan_is(s, "STCOFF") ||
                           scan_is(s, "STNOFF") || scan_is(s, "STCNOFF"))) {
    return scan_fail(s, "not an off file: it begins with \"%s\"", scan_quoted(s).text);
  }
  const scan after = *s;
  if (scan_word(s) && scan_is(s, "BINARY")) {
    return kg_fail(s->error, KG_ERR_UNSUPPORTED, s->path, s->line, 0,
                   "off files in binary are not read; ply and stl in binary are");
  }
  *s = after;
  kg_status status = off_count(s, &file->vertices, "vertices");
  if (status == KG_OK) status = off_count(s, &file->faces, "faces");
  if (status != KG_OK) return status;
  file->plain_size +=
    (size_t)snprintf(file->plain, 64, "OFF\n%lld %lld 0\n", file->vertices, file->faces);
  return KG_OK;
}

static kg_status off_face(scan *s, mesh_file *file)
{
  long long corners;
  if (!scan_integer(s, &corners) || corners < 3 || corners > INT_MAX) {
    return scan_fail(s, "expected the number of corners of a face, three or more, found \"%s\"",
                     scan_quoted(s).text);
  }
  put_word(file, s->word, s->length, true);
  for (long long k = 0; k < corners; k++) {
    long long index;
    if (!scan_word(s)) {
      return scan_fail(s, "a face announces %lld corners and has %lld", corners, k);
    }
    if (!scan_integer(s, &index) || index < 0 || index >= file->vertices) {
      return scan_fail(s, "a face uses vertex \"%s\", expected 0 to %lld", scan_quoted(s).text,
                       file->vertices - 1);
    }
    put_word(file, s->word, s->length, false);
  }
  check_put_text(file, "\n");
  return KG_OK;
}

kg_status check_off(mesh_file *file, kg_error *error)
{
  scan s = scan_of(file->path, file->content, file->size, error);
  s.comments = true;
  kg_status status = off_header(&s, file);
  for (long long i = 0; status == KG_OK && i < file->vertices + file->faces; i++) {
    const bool face = i >= file->vertices;
    if (!filled_line(&s)) {
      return scan_fail(&s, "the file ends too early: it has %lld of %lld %s",
                       face ? i - file->vertices : i, face ? file->faces : file->vertices,
                       face ? "faces" : "vertices");
    }
    if (face) {
      status = off_face(&s, file);
    } else {
      s.at = s.word; /* the word again, as a number */
      status = vertex(&s, file, true);
    }
  }
  if (status == KG_OK && filled_line(&s)) {
    return scan_fail(&s, "more lines than the %lld vertices and %lld faces announced",
                     file->vertices, file->faces);
  }
  return status;
}

/* ---- STL ---------------------------------------------------------------------------------------*/

enum { STL_HEADER = 84, STL_FACET = 50, STL_CORNERS = 12 };

/* OpenMesh puts corners together whose coordinates differ by FLT_MIN at most. */
static bool is_collapsed(const float *p)
{
  for (int k = 0; k < 3; k++) {
    const float *a = p + 3 * k, *b = p + 3 * ((k + 1) % 3);
    if (fabsf(a[0] - b[0]) <= FLT_MIN && fabsf(a[1] - b[1]) <= FLT_MIN &&
        fabsf(a[2] - b[2]) <= FLT_MIN) {
      return true;
    }
  }
  return false;
}

static kg_status stl_binary(mesh_file *file, kg_error *error)
{
  file->binary = true;
  for (long long i = 0; i < file->faces; i++) {
    float corners[9];
    const size_t begin = STL_HEADER + (size_t)i * STL_FACET + STL_CORNERS;
    for (size_t k = 0; k < 9; k++) {
      corners[k] = bytes_float(bytes_little(file->content + begin + 4 * k, 4));
      if (!(fabsf(corners[k]) < 1e18f)) {
        return kg_fail(error, KG_ERR_FORMAT, file->path, 0, 0,
                       "byte %zu: a corner of triangle %lld is not a usable point: %g",
                       begin + 4 * k, i + 1, (double)corners[k]);
      }
    }
    file->collapsed += is_collapsed(corners);
  }
  file->faces -= file->collapsed;
  return KG_OK;
}

/* The line must be these words; with coordinates a vertex. */
static kg_status stl_line(scan *s, const char *first, const char *second, bool ended)
{
  if (ended || !scan_is(s, first) || (second && !(scan_word(s) && scan_is(s, second)))) {
    return scan_fail(s, "expected \"%s%s%s\", found %s", first, second ? " " : "",
                     second ? second : "", ended ? "the end of the file" : scan_quoted(s).text);
  }
  return KG_OK;
}

/* The coordinates of a vertex as they were put at `from` in the copy. */
static void take_corner(const mesh_file *file, size_t from, float *p)
{
  const char *at = file->plain + from;
  for (int i = 0; i < 3; i++) {
    char *end;
    p[i] = strtof(at, &end);
    at = end;
  }
}

static kg_status stl_facet(scan *s, mesh_file *file)
{
  float corners[9] = {0};
  kg_status status = stl_line(s, "facet", "normal", false);
  if (status == KG_OK) status = stl_line(s, "outer", "loop", !filled_line(s));
  check_put_text(file, "facet normal 0 0 1\nouter loop\n");
  for (int k = 0; k < 3 && status == KG_OK; k++) {
    status = stl_line(s, "vertex", NULL, !filled_line(s));
    check_put_text(file, "vertex");
    const size_t from = file->plain_size;
    if (status == KG_OK) status = vertex(s, file, false);
    if (status == KG_OK) take_corner(file, from, corners + 3 * k);
  }
  check_put_text(file, "endloop\nendfacet\n");
  if (status == KG_OK) status = stl_line(s, "endloop", NULL, !filled_line(s));
  if (status == KG_OK) status = stl_line(s, "endfacet", NULL, !filled_line(s));
  const bool collapsed = is_collapsed(corners);
  file->faces += !collapsed;
  file->collapsed += collapsed;
  return status;
}

/* one solid after another */
static kg_status stl_text(mesh_file *file, kg_error *error)
{
  scan s = scan_of(file->path, file->content, file->size, error);
  bool inside = false;
  file->faces = 0;
  check_put_text(file, "solid\n");
  while (filled_line(&s)) {
    kg_status status = KG_OK;
    if (!inside) {
      status = stl_line(&s, "solid", NULL, false);
      inside = true;
    } else if (scan_is(&s, "endsolid")) {
      inside = false;
    } else {
      status = stl_facet(&s, file);
    }
    if (status != KG_OK) return status;
  }
  check_put_text(file, "endsolid\n");
  return inside ? scan_fail(&s, "the text STL ends without endsolid") : KG_OK;
}

kg_status check_stl(mesh_file *file, kg_error *error)
{
  scan first = scan_of(file->path, file->content, file->size, error);
  const bool text = scan_token(&first) && scan_is(&first, "solid");
  file->vertices = -1;
  if (file->size >= STL_HEADER) {
    file->faces = (long long)bytes_little(file->content + STL_HEADER - 4, 4);
    if ((long long)((file->size - STL_HEADER) / STL_FACET) == file->faces) {
      return stl_binary(file, error);
    }
    if (!text) {
      return kg_fail(error, KG_ERR_FORMAT, file->path, 0, 0,
                     "neither a text STL nor a binary one: that would announce %lld triangles at "
                     "byte 80 and be %lld bytes long, not %zu",
                     file->faces, STL_HEADER + STL_FACET * file->faces, file->size);
    }
  }
  if (text) return stl_text(file, error);
  return kg_fail(error, KG_ERR_FORMAT, file->path, 0, 0,
                 "neither a text STL, which begins with solid, nor a binary one, which has more "
                 "than %d bytes",
                 STL_HEADER);
}
