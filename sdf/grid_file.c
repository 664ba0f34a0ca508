/* Grids in files: docs/formats/grid.md. Numbers are written byte by byte, the least significant
 * first, on every machine. */
#include "sdf/grid_internal.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { HEADER = 64, NODE = 16, CHECKSUM = 8, VERSION = 1, CHUNK = 4096 /* nodes */ };
enum { FLAG_CONTINUOUS = 1, FLAG_CLOSEST = 2 };

static const char magic[8] = {'K', 'G', 'G', 'R', 'I', 'D', '\r', '\n'};

/* [FNV] G. Fowler, L. C. Noll, P. Vo: FNV-1a of 64 bits */
static const uint64_t fnv_start = 14695981039346656037u;

static uint64_t fnv(uint64_t sum, const unsigned char *bytes, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    sum = (sum ^ bytes[i]) * 1099511628211u;
  }
  return sum;
}

static void put(unsigned char *out, uint64_t value, int bytes)
{
  for (int k = 0; k < bytes; k++) {
    out[k] = (unsigned char)(value >> (8 * k));
  }
}

static uint64_t get(const unsigned char *in, int bytes)
{
  uint64_t value = 0;
  for (int k = bytes; k-- > 0;) {
    value = value << 8 | in[k];
  }
  return value;
}

static void put_double(unsigned char *out, double value)
{
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  put(out, bits, 8);
}

static double get_double(const unsigned char *in)
{
  const uint64_t bits = get(in, 8);
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static void put_floats(unsigned char *out, const float *values, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    uint32_t bits;
    memcpy(&bits, &values[i], sizeof bits);
    put(out + 4 * i, bits, 4);
  }
}

static void get_floats(float *values, const unsigned char *in, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    const uint32_t bits = (uint32_t)get(in + 4 * i, 4);
    memcpy(&values[i], &bits, sizeof bits);
  }
}

static size_t node_total(const int n[3])
{
  return (size_t)n[0] * (size_t)n[1] * (size_t)n[2];
}

/* ---- writing ----------------------------------------------------------------------------------- */

static void make_header(unsigned char out[HEADER], const kg_grid *grid)
{
  const grid_view *g = &grid->view;
  memset(out, 0, HEADER);
  memcpy(out, magic, sizeof magic);
  put(out + 8, VERSION, 4);
  put(out + 12,
      (grid->is_continuous ? FLAG_CONTINUOUS : 0u) | (grid->has_closest ? FLAG_CLOSEST : 0u), 4);
  put_double(out + 16, g->lo.x);
  put_double(out + 24, g->lo.y);
  put_double(out + 32, g->lo.z);
  put_double(out + 40, g->spacing);
  for (int k = 0; k < 3; k++) {
    put(out + 48 + 4 * k, (uint64_t)g->n[k], 4);
  }
}

static bool write_all(FILE *file, const kg_grid *grid)
{
  unsigned char bytes[CHUNK * NODE], header[HEADER], end[CHECKSUM];
  const size_t total = node_total(grid->view.n);
  make_header(header, grid);
  uint64_t sum = fnv(fnv_start, header, HEADER);
  if (fwrite(header, 1, HEADER, file) != HEADER) return false;
  for (size_t first = 0; first < total; first += CHUNK) {
    const size_t count = total - first < CHUNK ? total - first : CHUNK;
    put_floats(bytes, grid->view.node + 4 * first, 4 * count);
    sum = fnv(sum, bytes, count * NODE);
    if (fwrite(bytes, NODE, count, file) != count) return false;
  }
  put(end, sum, CHECKSUM);
  return fwrite(end, 1, CHECKSUM, file) == CHECKSUM;
}

kg_status kg_grid_save(const kg_grid *grid, const char *path, kg_error *error)
{
  char partial[4096];
  if (snprintf(partial, sizeof partial, "%s.part", path) >= (int)sizeof partial) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "the path is too long");
  }
  FILE *file = fopen(partial, "wb");
  if (!file) return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "%s", strerror(errno));
  bool written = write_all(file, grid);
  written = fclose(file) == 0 && written;
  if (!written || rename(partial, path) != 0) {
    const int why = errno;
    remove(partial);
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "%s", strerror(why));
  }
  return KG_OK;
}

/* ---- reading ------------------------------------------------------------------------------------ */

typedef struct reader {
  FILE *file;
  const char *path;
  kg_error *error;
  uint64_t sum;
} reader;

typedef struct header {
  unsigned flags;
  kg_vec3 lo;
  double spacing;
  int n[3];
} header;

#define REFUSE(r, ...) kg_fail((r)->error, KG_ERR_FORMAT, (r)->path, 0, 0, __VA_ARGS__)

static bool is_place(double v)
{
  return fabs(v) < 1e17; /* false for NaN */
}

static kg_status check_header(const reader *r, const unsigned char *bytes, header *out)
{
  if (memcmp(bytes, magic, sizeof magic) != 0) return REFUSE(r, "not a grid file of kinegrad");
  const unsigned version = (unsigned)get(bytes + 8, 4);
  if (version != VERSION) {
    return kg_fail(r->error, KG_ERR_UNSUPPORTED, r->path, 0, 0,
                   "byte 8: version %u of the format, expected %d", version, VERSION);
  }
  *out = (header){.flags = (unsigned)get(bytes + 12, 4),
                  .lo = {get_double(bytes + 16), get_double(bytes + 24), get_double(bytes + 32)},
                  .spacing = get_double(bytes + 40)};
  if (out->flags > (FLAG_CONTINUOUS | FLAG_CLOSEST) || get(bytes + 60, 4) != 0) {
    return REFUSE(r, "byte 12 or 60: flags that version %d does not know", VERSION);
  }
  if (!is_place(out->lo.x) || !is_place(out->lo.y) || !is_place(out->lo.z)) {
    return REFUSE(r, "byte 16: the first node is not a usable point: (%g, %g, %g)", out->lo.x,
                  out->lo.y, out->lo.z);
  }
  double total = 1.0;
  for (int k = 0; k < 3; k++) {
    const uint64_t n = get(bytes + 48 + 4 * k, 4);
    if (n < 2 || n > INT_MAX) {
      return REFUSE(r, "byte %d: %llu nodes along an axis, expected two or more", 48 + 4 * k,
                    (unsigned long long)n);
    }
    out->n[k] = (int)n;
    total *= (double)n;
    if (!(out->spacing > 1e-17) || !is_place(out->spacing * (double)n)) {
      return REFUSE(r, "byte 40: a spacing of %g m", out->spacing);
    }
  }
  if (!grid_is_fine(out->lo, out->spacing, out->n)) {
    return REFUSE(r, "byte 40: a spacing of %g m, too little so far from the origin", out->spacing);
  }
  if (total >= 2147483648.0)
    return REFUSE(r, "byte 48: %.0f nodes, expected less than 2^31", total);
  return KG_OK;
}

/* exactly as long as the header says, before memory is taken for it */
static kg_status check_length(const reader *r, const int n[3])
{
  const double expected = HEADER + (double)node_total(n) * NODE + CHECKSUM;
  const long at = ftell(r->file);
  if (at < 0 || fseek(r->file, 0, SEEK_END) != 0) return REFUSE(r, "the file cannot be measured");
  const long size = ftell(r->file);
  if ((double)size != expected) {
    return REFUSE(r, "the file has %ld bytes, its %d x %d x %d nodes take %.0f", size, n[0], n[1],
                  n[2], expected);
  }
  return fseek(r->file, at, SEEK_SET) == 0 ? KG_OK : REFUSE(r, "the file cannot be read");
}

static kg_status read_nodes(reader *r, kg_grid *grid)
{
  unsigned char bytes[CHUNK * NODE];
  const size_t total = node_total(grid->view.n);
  float *node = grid_nodes(grid);
  for (size_t first = 0; first < total; first += CHUNK) {
    const size_t count = total - first < CHUNK ? total - first : CHUNK;
    if (fread(bytes, NODE, count, r->file) != count) {
      return REFUSE(r, "byte %zu: the file ends here", HEADER + NODE * first);
    }
    r->sum = fnv(r->sum, bytes, count * NODE);
    get_floats(node + 4 * first, bytes, 4 * count);
  }
  if (fread(bytes, 1, CHECKSUM, r->file) != CHECKSUM || get(bytes, CHECKSUM) != r->sum) {
    return REFUSE(r, "byte %zu: the checksum does not fit: the file is damaged",
                  HEADER + NODE * total);
  }
  return KG_OK;
}

/* The bounds rest on it: neighbours' distances differ by no more than the way between them. */
static kg_status check_nodes(const reader *r, const kg_grid *grid)
{
  const grid_view *g = &grid->view;
  const size_t step[3] = {1, (size_t)g->n[0], (size_t)g->n[0] * (size_t)g->n[1]};
  const double most = g->spacing * (1.0 + 1e-6) + 2.0 * grid->slack;
  size_t at = 0;
  for (int k = 0; k < g->n[2]; k++) {
    for (int j = 0; j < g->n[1]; j++) {
      for (int i = 0; i < g->n[0]; i++, at++) {
        const float *v = g->node + 4 * at;
        const double size2 =
          (double)v[1] * (double)v[1] + (double)v[2] * (double)v[2] + (double)v[3] * (double)v[3];
        if (!(fabs((double)v[0]) < 1e18) || !(size2 < 1.0 + 1e-4)) {
          return REFUSE(r, "byte %zu: node (%d, %d, %d) is not a value and gradient of a distance",
                        HEADER + NODE * at, i, j, k);
        }
        const bool has_next[3] = {i + 1 < g->n[0], j + 1 < g->n[1], k + 1 < g->n[2]};
        for (int axis = 0; axis < 3; axis++) {
          if (!has_next[axis]) continue;
          const double a = (double)v[0], b = (double)g->node[4 * (at + step[axis])];
          const double change = grid->is_continuous ? fabs(a - b) : fabs(fabs(a) - fabs(b));
          if (!(change <= most)) {
            return REFUSE(r, "byte %zu: node (%d, %d, %d) and the next differ by %g m over %g m",
                          HEADER + NODE * at, i, j, k, change, g->spacing);
          }
        }
      }
    }
  }
  return KG_OK;
}

/* some nodes, spread over the grid */
static kg_status check_source(const reader *r, const kg_grid *grid)
{
  enum { SAMPLES = 64 };
  const grid_view *g = &grid->view;
  const size_t total = node_total(g->n);
  for (size_t s = 0; s < SAMPLES; s++) {
    const size_t at = s * (total - 1) / (SAMPLES - 1);
    const size_t row = (size_t)g->n[0], slice = row * (size_t)g->n[1];
    const kg_vec3 x = grid_place(g, (int)(at % row), (int)(at % slice / row), (int)(at / slice));
    const double asked = grid_ask(&grid->source, x).distance, stored = (double)g->node[4 * at];
    if (!(fabs(asked - stored) <= 2.0 * grid->slack + 1e-6 * fabs(asked))) {
      return REFUSE(r,
                    "byte %zu: a distance of %g m, the source has %g m: a grid of something else",
                    HEADER + NODE * at, stored, asked);
    }
  }
  return KG_OK;
}

static kg_status read_grid(reader *r, kg_grid **grid, const kg_grid_source *source,
                           const kg_allocator *allocator)
{
  unsigned char bytes[HEADER];
  header h;
  if (fread(bytes, 1, HEADER, r->file) != HEADER) return REFUSE(r, "not a grid file of kinegrad");
  r->sum = fnv(fnv_start, bytes, HEADER);
  kg_status status = check_header(r, bytes, &h);
  if (status == KG_OK) status = check_length(r, h.n);
  if (status == KG_OK) status = grid_allocate(grid, h.lo, h.spacing, h.n, allocator, r->error);
  if (status != KG_OK) return status;
  (*grid)->is_continuous = (h.flags & FLAG_CONTINUOUS) != 0;
  (*grid)->has_closest = (h.flags & FLAG_CLOSEST) != 0;
  status = read_nodes(r, *grid);
  if (status == KG_OK) status = check_nodes(r, *grid);
  if (status == KG_OK && source) {
    (*grid)->source = *source;
    status = check_source(r, *grid);
  }
  if (status != KG_OK) {
    kg_grid_destroy(*grid);
    *grid = NULL;
  }
  return status;
}

kg_status kg_grid_load(kg_grid **grid, const char *path, const kg_grid_source *source,
                       const kg_allocator *allocator, kg_error *error)
{
  KG_ASSERT(grid && path && (!source || !source->mesh == !!source->field));
  *grid = NULL;
  reader r = {fopen(path, "rb"), path, error, 0};
  if (!r.file) return kg_fail(error, KG_ERR_READ, path, 0, 0, "%s", strerror(errno));
  kg_status status = read_grid(&r, grid, source, allocator);
  if (status != KG_OK && error && error->path[0] == '\0') {
    snprintf(error->path, sizeof error->path, "%s", path);
  }
  fclose(r.file);
  return status;
}
