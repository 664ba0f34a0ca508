/* Grids in files: docs/formats/grid.md. */
#include "sdf/bytes.h"
#include "sdf/grid_internal.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { HEADER = 64, NODE = 16, CHECKSUM = 8, VERSION = 2, CHUNK = 4096 /* nodes */ };
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

static void put_double(unsigned char *out, double value)
{
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  bytes_put_little(out, bits, 8);
}

static double get_double(const unsigned char *in)
{
  return bytes_double(bytes_little(in, 8));
}

static void put_floats(unsigned char *out, const float *values, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    uint32_t bits;
    memcpy(&bits, &values[i], sizeof bits);
    bytes_put_little(out + 4 * i, bits, 4);
  }
}

static void get_floats(float *values, const unsigned char *in, size_t count)
{
  for (size_t i = 0; i < count; i++) {
    values[i] = bytes_float(bytes_little(in + 4 * i, 4));
  }
}

/* byte of the node */
static size_t byte_of(const grid_view *g, int block, int i, int j, int k)
{
  const size_t before = grid_block_total(g) + (size_t)block * GRID_BLOCK_NODES;
  return HEADER + NODE * (before + grid_node_at(0, i, j, k));
}

/* ---- writing ----------------------------------------------------------------------------------- */

static void make_header(unsigned char out[HEADER], const kg_grid *grid)
{
  const grid_view *g = &grid->view;
  memset(out, 0, HEADER);
  memcpy(out, magic, sizeof magic);
  bytes_put_little(out + 8, VERSION, 4);
  bytes_put_little(
    out + 12,
    (grid->is_continuous ? FLAG_CONTINUOUS : 0u) | (grid->has_closest ? FLAG_CLOSEST : 0u), 4);
  put_double(out + 16, g->lo.x);
  put_double(out + 24, g->lo.y);
  put_double(out + 32, g->lo.z);
  put_double(out + 40, g->spacing);
  for (int k = 0; k < 3; k++) {
    bytes_put_little(out + 48 + 4 * k, (uint64_t)g->n[k], 4);
  }
  bytes_put_little(out + 60, (uint64_t)g->count, 4);
}

static bool write_nodes(FILE *file, const float *node, size_t total, uint64_t *sum)
{
  unsigned char bytes[CHUNK * NODE];
  for (size_t first = 0; first < total; first += CHUNK) {
    const size_t count = total - first < CHUNK ? total - first : CHUNK;
    put_floats(bytes, node + 4 * first, 4 * count);
    *sum = fnv(*sum, bytes, count * NODE);
    if (fwrite(bytes, NODE, count, file) != count) return false;
  }
  return true;
}

static bool write_all(FILE *file, const kg_grid *grid)
{
  unsigned char header[HEADER], end[CHECKSUM];
  const grid_view *g = &grid->view;
  make_header(header, grid);
  uint64_t sum = fnv(fnv_start, header, HEADER);
  if (fwrite(header, 1, HEADER, file) != HEADER) return false;
  if (!write_nodes(file, g->center, grid_block_total(g), &sum)) return false;
  for (int block = 0; block < g->count; block++) {
    const float *node = g->node + 4 * grid_node_at(block, 0, 0, 0);
    if (!write_nodes(file, node, GRID_BLOCK_NODES, &sum)) return false;
  }
  bytes_put_little(end, sum, CHECKSUM);
  return fwrite(end, 1, CHECKSUM, file) == CHECKSUM;
}

kg_status kg_grid_save(const kg_grid *grid, const char *path, kg_error *error)
{
  char partial[4096];
  if (snprintf(partial, sizeof partial, "%s.part", path) >= (int)sizeof partial) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "the path is too long");
  }
  FILE *file = fopen(partial, "wb");
  if (!file) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be created: %s", strerror(errno));
  }
  bool written = write_all(file, grid);
  written = fclose(file) == 0 && written;
  if (!written || rename(partial, path) != 0) {
    const int why = errno;
    remove(partial);
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be written: %s", strerror(why));
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
  int count; /* blocks with nodes */
} header;

#define REFUSE(r, ...) kg_fail((r)->error, KG_ERR_FORMAT, (r)->path, 0, 0, __VA_ARGS__)

static bool is_place(double v)
{
  return fabs(v) < 1e17; /* false for NaN */
}

static kg_status check_header(const reader *r, const unsigned char *bytes, header *out)
{
  if (memcmp(bytes, magic, sizeof magic) != 0) return REFUSE(r, "not a grid file of kinegrad");
  const unsigned version = (unsigned)bytes_little(bytes + 8, 4);
  if (version != VERSION) {
    return kg_fail(r->error, KG_ERR_UNSUPPORTED, r->path, 0, 0,
                   "byte 8: version %u of the format, expected %d", version, VERSION);
  }
  *out = (header){.flags = (unsigned)bytes_little(bytes + 12, 4),
                  .lo = {get_double(bytes + 16), get_double(bytes + 24), get_double(bytes + 32)},
                  .spacing = get_double(bytes + 40)};
  if (out->flags > (FLAG_CONTINUOUS | FLAG_CLOSEST)) {
    return REFUSE(r, "byte 12: flags that version %d does not know", VERSION);
  }
  if (!is_place(out->lo.x) || !is_place(out->lo.y) || !is_place(out->lo.z)) {
    return REFUSE(r, "byte 16: the first node is not a usable point: (%g, %g, %g)", out->lo.x,
                  out->lo.y, out->lo.z);
  }
  double total = 1.0;
  for (int k = 0; k < 3; k++) {
    const uint64_t n = bytes_little(bytes + 48 + 4 * k, 4);
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
  if (total >= GRID_MOST_NODES) {
    return REFUSE(r, "byte 48: %.0f nodes, expected less than 2^31", total);
  }
  const uint64_t count = bytes_little(bytes + 60, 4);
  if (count > INT_MAX) {
    return REFUSE(r, "byte 60: %llu blocks with nodes", (unsigned long long)count);
  }
  out->count = (int)count;
  return KG_OK;
}

/* exactly as long as the header says, before memory is taken for it */
static kg_status check_length(const reader *r, const header *h)
{
  double blocks = 1.0;
  for (int k = 0; k < 3; k++) {
    blocks *= grid_block_count(h->n[k]);
  }
  const double expected = HEADER + (blocks + (double)h->count * GRID_BLOCK_NODES) * NODE + CHECKSUM;
  const long at = ftell(r->file);
  if (at < 0 || fseek(r->file, 0, SEEK_END) != 0) return REFUSE(r, "the file cannot be measured");
  const long size = ftell(r->file);
  if ((double)size != expected) {
    return REFUSE(r,
                  "the file has %ld bytes, its %d x %d x %d nodes with %d blocks near the surface "
                  "take %.0f",
                  size, h->n[0], h->n[1], h->n[2], h->count, expected);
  }
  return fseek(r->file, at, SEEK_SET) == 0 ? KG_OK : REFUSE(r, "the file cannot be read");
}

/* byte: where they begin in the file */
static kg_status read_nodes(reader *r, float *node, size_t total, size_t byte)
{
  unsigned char bytes[CHUNK * NODE];
  for (size_t first = 0; first < total; first += CHUNK) {
    const size_t count = total - first < CHUNK ? total - first : CHUNK;
    if (fread(bytes, NODE, count, r->file) != count) {
      return REFUSE(r, "byte %zu: the file ends here", byte + NODE * first);
    }
    r->sum = fnv(r->sum, bytes, count * NODE);
    get_floats(node + 4 * first, bytes, 4 * count);
  }
  return KG_OK;
}

static kg_status read_checksum(const reader *r, const grid_view *g)
{
  unsigned char bytes[CHECKSUM];
  if (fread(bytes, 1, CHECKSUM, r->file) != CHECKSUM || bytes_little(bytes, CHECKSUM) != r->sum) {
    return REFUSE(r, "byte %zu: the checksum does not fit: the file is damaged",
                  byte_of(g, g->count, 0, 0, 0));
  }
  return KG_OK;
}

/* The centers say which blocks have nodes. */
static kg_status read_values(reader *r, kg_grid *grid, int count)
{
  const grid_view *g = &grid->view;
  kg_status status = read_nodes(r, grid_centers(grid), grid_block_total(g), HEADER);
  if (status != KG_OK) return status;
  if (grid_choose_blocks(grid) != count) {
    return REFUSE(r, "byte 60: %d blocks with nodes, the distances at their centers say %d", count,
                  g->count);
  }
  status = grid_allocate_nodes(grid, r->error);
  for (int block = 0; block < count && status == KG_OK; block++) {
    float *node = grid_nodes(grid) + 4 * grid_node_at(block, 0, 0, 0);
    status = read_nodes(r, node, GRID_BLOCK_NODES, byte_of(g, block, 0, 0, 0));
  }
  return status == KG_OK ? read_checksum(r, g) : status;
}

static bool is_value(const float *v)
{
  const double size2 =
    (double)v[1] * (double)v[1] + (double)v[2] * (double)v[2] + (double)v[3] * (double)v[3];
  return fabs((double)v[0]) < 1e18 && size2 < 1.0 + 1e-4;
}

/* The bounds rest on it: distances differ by no more than the way between them. */
static kg_status check_change(const reader *r, const kg_grid *grid, const float *a, const float *b,
                              double way, size_t byte)
{
  const double u = (double)*a, v = (double)*b;
  const double change = grid->is_continuous ? fabs(u - v) : fabs(fabs(u) - fabs(v));
  if (change <= way * (1.0 + 1e-6) + 2.0 * grid->slack) return KG_OK;
  return REFUSE(r, "byte %zu: this distance and the next differ by %g m over %g m", byte, change,
                way);
}

/* A node against the block's center and the ones before it in the block. */
static kg_status check_node(const reader *r, const kg_grid *grid, const int block[3],
                            const int at[3])
{
  const grid_view *g = &grid->view;
  const size_t center = grid_block_at(g, block[0], block[1], block[2]);
  const size_t step[3] = {1, GRID_ROW, GRID_SLICE};
  const int number = g->block[center];
  const size_t node = grid_node_at(number, at[0], at[1], at[2]);
  const size_t byte = byte_of(g, number, at[0], at[1], at[2]);
  const float *v = g->node + 4 * node;
  if (!is_value(v)) {
    return REFUSE(r, "byte %zu: not a value and gradient of a distance", byte);
  }
  const kg_vec3 x = grid_place(g, GRID_SIDE * block[0] + at[0], GRID_SIDE * block[1] + at[1],
                               GRID_SIDE * block[2] + at[2]);
  const kg_vec3 to = kg_vec3_sub(grid_center_place(g, block[0], block[1], block[2]), x);
  kg_status status = check_change(r, grid, v, g->center + 4 * center, kg_vec3_norm(to), byte);
  for (int axis = 0; axis < 3 && status == KG_OK; axis++) {
    if (at[axis] > 0) {
      status = check_change(r, grid, v, g->node + 4 * (node - step[axis]), g->spacing, byte);
    }
  }
  return status;
}

/* the block's last node along an axis that the grid has */
static int last_node(const grid_view *g, int axis, int block)
{
  const int left = g->n[axis] - 1 - GRID_SIDE * block;
  return left < GRID_SIDE ? left : GRID_SIDE;
}

/* A node that other blocks hold too is the same there: the interpolant is C1 across them. */
static kg_status check_shared(const reader *r, const grid_view *g, const int block[3],
                              const int at[3])
{
  const int number = g->block[grid_block_at(g, block[0], block[1], block[2])];
  const float *v = g->node + 4 * grid_node_at(number, at[0], at[1], at[2]);
  const int node[3] = {GRID_SIDE * block[0] + at[0], GRID_SIDE * block[1] + at[1],
                       GRID_SIDE * block[2] + at[2]};
  size_t places[8];
  const int count = grid_copies(g, node, places);
  for (int k = 0; k < count; k++) {
    if (memcmp(v, g->node + 4 * places[k], 4 * sizeof *v) != 0) {
      return REFUSE(r, "byte %zu: a node differs from the same one in another block",
                    byte_of(g, number, at[0], at[1], at[2]));
    }
  }
  return KG_OK;
}

static kg_status check_beyond(const reader *r, const grid_view *g, int number, const int at[3])
{
  static const float zero[4] = {0.0f};
  const float *v = g->node + 4 * grid_node_at(number, at[0], at[1], at[2]);
  if (memcmp(v, zero, sizeof zero) == 0) return KG_OK;
  return REFUSE(r, "byte %zu: a node beyond the grid that is not zero",
                byte_of(g, number, at[0], at[1], at[2]));
}

static kg_status check_block(const reader *r, const kg_grid *grid, const int block[3])
{
  const grid_view *g = &grid->view;
  const int number = g->block[grid_block_at(g, block[0], block[1], block[2])];
  const int last[3] = {last_node(g, 0, block[0]), last_node(g, 1, block[1]),
                       last_node(g, 2, block[2])};
  kg_status status = KG_OK;
  for (int n = 0; n < GRID_BLOCK_NODES && status == KG_OK; n++) {
    const int at[3] = {n % GRID_ROW, n / GRID_ROW % GRID_ROW, n / GRID_SLICE};
    if (at[0] > last[0] || at[1] > last[1] || at[2] > last[2]) {
      status = check_beyond(r, g, number, at);
      continue;
    }
    status = check_node(r, grid, block, at);
    if (status == KG_OK) status = check_shared(r, g, block, at);
  }
  return status;
}

static kg_status check_center(const reader *r, const kg_grid *grid, const int block[3])
{
  const grid_view *g = &grid->view;
  const size_t at = grid_block_at(g, block[0], block[1], block[2]);
  const size_t step[3] = {1, (size_t)g->blocks[0], (size_t)g->blocks[0] * (size_t)g->blocks[1]};
  const size_t byte = HEADER + NODE * at;
  const float *v = g->center + 4 * at;
  if (!is_value(v)) {
    return REFUSE(r, "byte %zu: not a value and gradient of a distance", byte);
  }
  kg_status status = KG_OK;
  for (int axis = 0; axis < 3 && status == KG_OK; axis++) {
    if (block[axis] > 0) {
      status =
        check_change(r, grid, v, g->center + 4 * (at - step[axis]), GRID_SIDE * g->spacing, byte);
    }
  }
  return status;
}

static kg_status check_values(const reader *r, const kg_grid *grid)
{
  const grid_view *g = &grid->view;
  kg_status status = KG_OK;
  for (int k = 0; k < g->blocks[2]; k++) {
    for (int j = 0; j < g->blocks[1]; j++) {
      for (int i = 0; i < g->blocks[0] && status == KG_OK; i++) {
        const int block[3] = {i, j, k};
        status = check_center(r, grid, block);
        if (status == KG_OK && g->block[grid_block_at(g, i, j, k)] >= 0) {
          status = check_block(r, grid, block);
        }
      }
    }
  }
  return status;
}

static kg_status check_asked(const reader *r, const kg_grid *grid, kg_vec3 x, const float *node,
                             size_t byte)
{
  const double asked = grid_ask(&grid->source, x).distance, stored = (double)*node;
  if (fabs(asked - stored) <= 2.0 * grid->slack + 1e-6 * fabs(asked)) return KG_OK;
  return REFUSE(r, "byte %zu: a distance of %g m, the source has %g m: a grid of something else",
                byte, stored, asked);
}

/* some centers, spread over the grid, and the first node of their blocks */
static kg_status check_source(const reader *r, const kg_grid *grid)
{
  enum { SAMPLES = 64 };
  const grid_view *g = &grid->view;
  const size_t total = grid_block_total(g);
  kg_status status = KG_OK;
  for (size_t s = 0; s < SAMPLES && status == KG_OK; s++) {
    const size_t at = s * (total - 1) / (SAMPLES - 1);
    const size_t row = (size_t)g->blocks[0], slice = row * (size_t)g->blocks[1];
    const int i = (int)(at % row), j = (int)(at % slice / row), k = (int)(at / slice);
    status =
      check_asked(r, grid, grid_center_place(g, i, j, k), g->center + 4 * at, HEADER + NODE * at);
    if (status == KG_OK && g->block[at] >= 0) {
      status = check_asked(r, grid, grid_place(g, GRID_SIDE * i, GRID_SIDE * j, GRID_SIDE * k),
                           g->node + 4 * grid_node_at(g->block[at], 0, 0, 0),
                           byte_of(g, g->block[at], 0, 0, 0));
    }
  }
  return status;
}

static kg_status read_grid(reader *r, kg_grid **grid, const kg_grid_source *source,
                           const kg_allocator *allocator)
{
  unsigned char bytes[HEADER];
  header h;
  if (fread(bytes, 1, HEADER, r->file) != HEADER) return REFUSE(r, "not a grid file of kinegrad");
  r->sum = fnv(fnv_start, bytes, HEADER);
  kg_status status = check_header(r, bytes, &h);
  if (status == KG_OK) status = check_length(r, &h);
  if (status == KG_OK) status = grid_allocate(grid, h.lo, h.spacing, h.n, allocator, r->error);
  if (status != KG_OK) return status;
  (*grid)->is_continuous = (h.flags & FLAG_CONTINUOUS) != 0;
  (*grid)->has_closest = (h.flags & FLAG_CLOSEST) != 0;
  status = read_values(r, *grid, h.count);
  if (status == KG_OK) status = check_values(r, *grid);
  if (status == KG_OK && source) {
    (*grid)->source = *source;
    status = check_source(r, *grid);
  }
  if (status == KG_OK) {
    grid_pack_nodes(*grid);
  } else {
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
  if (!r.file) {
    return kg_fail(error, KG_ERR_READ, path, 0, 0, "cannot be opened: %s", strerror(errno));
  }
  kg_status status = read_grid(&r, grid, source, allocator);
  if (status != KG_OK && error && error->path[0] == '\0') {
    snprintf(error->path, sizeof error->path, "%s", path);
  }
  fclose(r.file);
  return status;
}
