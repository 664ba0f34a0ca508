/* Sampling of a field, by as many threads as wanted: first the centers of all blocks, then the nodes of
 * those near to the surface, two layers after the other.
 *
 * Of a mesh, packets of 4 x 2 x 2 nodes look for their nearest triangles together, in floats, from
 * what the packet before found; the distance to the triangle found is then taken in double. In floats
 * a triangle can pass for nearer than another by some 1e-7 of the box, so a node's value is never
 * below |Phi| and not above it by more than GRID_SLACK of the diagonal. Where a nearly equal triangle
 * could have another sign (an edge or corner seen from far beside its pseudo-normal) the mesh is asked.
 * A layer's packets begin afresh, so that threads do not show in the result.
 *
 * A block is asked for its first GRID_SIDE^3 nodes only; those on its other faces are the first ones of
 * the blocks behind them, and every block that holds a node is given it. */
#include "sdf/grid_internal.h"

#include "sdf/feature.h"
#include "sdf/mesh_internal.h"

#include <limits.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>

enum { MOST_THREADS = 64, PACKET_X = 4, PACKET_Y = 2, PACKET_Z = 2 };

/* ---- memory ------------------------------------------------------------------------------------- */

size_t grid_block_total(const grid_view *view)
{
  return (size_t)view->blocks[0] * (size_t)view->blocks[1] * (size_t)view->blocks[2];
}

kg_status grid_allocate(kg_grid **grid, kg_vec3 lo, double spacing, const int n[3],
                        const kg_allocator *allocator, kg_error *error)
{
  *grid = NULL;
  const double count = (double)n[0] * n[1] * n[2];
  if (count >= GRID_MOST_NODES) {
    return kg_fail(error, KG_ERR_UNSUPPORTED, "", 0, 0, "a grid of %d x %d x %d nodes is too large",
                   n[0], n[1], n[2]);
  }
  const grid_view view = {
    .lo = lo,
    .spacing = spacing,
    .n = {n[0], n[1], n[2]},
    .blocks = {grid_block_count(n[0]), grid_block_count(n[1]), grid_block_count(n[2])}};
  const size_t blocks = grid_block_total(&view);
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_grid *built = KG_ARENA_ARRAY(&arena, kg_grid, 1);
  float *center = kg_arena_take(&arena, blocks * 4 * sizeof(float), 64);
  int *block = kg_arena_take(&arena, blocks * sizeof *block, 64);
  if (!built || !center || !block) {
    kg_arena_release(&arena);
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a grid of %d x %d x %d nodes",
                   n[0], n[1], n[2]);
  }
  built->arena = arena;
  built->kernels = kg_sdf_kernels_best()->grid;
  built->view = view;
  built->view.center = center;
  built->view.block = block;
  built->hi = grid_place(&view, n[0] - 1, n[1] - 1, n[2] - 1);
  built->slack = GRID_SLACK * kg_vec3_norm(kg_vec3_sub(built->hi, lo));
  *grid = built;
  return KG_OK;
}

/* The view is const for everyone else. */
float *grid_nodes(kg_grid *grid)
{
  return (float *)(uintptr_t)grid->view.node;
}

float *grid_centers(kg_grid *grid)
{
  return (float *)(uintptr_t)grid->view.center;
}

/* No point of a block is farther from its center than half a diagonal. */
int grid_choose_blocks(kg_grid *grid)
{
  grid_view *g = &grid->view;
  const double half = 0.5 * GRID_SIDE * 1.7320508075688772;
  const double reach = (GRID_BAND + half) * g->spacing + grid->slack;
  const size_t total = grid_block_total(g);
  int *block = (int *)(uintptr_t)g->block;
  g->count = 0;
  for (size_t at = 0; at < total; at++) {
    block[at] = fabs((double)g->center[4 * at]) <= reach ? g->count++ : -1;
  }
  return g->count;
}

kg_status grid_allocate_nodes(kg_grid *grid, kg_error *error)
{
  const size_t stride = GRID_BLOCK_STRIDE * 4 * sizeof(float);
  const size_t packed_stride = GRID_BLOCK_STRIDE * 2 * sizeof(int32_t);
  const size_t bytes = (size_t)grid->view.count * stride;
  const size_t packed_bytes = (size_t)grid->view.count * packed_stride;
  char *memory = kg_arena_take(&grid->arena, bytes + packed_bytes + stride, 64);
  if (!memory) {
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for %d blocks of a grid",
                   grid->view.count);
  }
  memory += -(uintptr_t)memory % stride; /* no block on two pages */
  memset(memory, 0, bytes);
  grid->view.node = (const float *)(const void *)memory;
  grid->view.packed = (const int32_t *)(const void *)(memory + bytes);
  return KG_OK;
}

/* See GRID_PACKED. upper, lower: in [-1, 1] */
static int32_t packed_word(double upper, double lower)
{
  const int low = (int)lrint(32767.0 * lower) & 0xffff;
  const int high = (int)floor((GRID_PACKED * upper - low) / 65536.0 + 0.5);
  return high * 65536 + low;
}

void grid_pack_nodes(kg_grid *grid)
{
  grid_view *g = &grid->view;
  const size_t count = (size_t)g->count * GRID_BLOCK_STRIDE;
  float largest = (float)g->spacing, steepest = 1.0f;
  for (size_t i = 0; i < count; i++) {
    const float *v = g->node + 4 * i;
    const float slope = fmaxf(fabsf(v[1]), fmaxf(fabsf(v[2]), fabsf(v[3])));
    largest = fmaxf(largest, fabsf(v[0]));
    steepest = fmaxf(steepest, slope);
  }
  g->largest = (double)largest;
  g->steepest = (double)steepest;
  const double of_value = 1.0 / g->largest, of_slope = 1.0 / g->steepest;
  int32_t *packed = (int32_t *)(uintptr_t)g->packed;
  for (size_t i = 0; i < count; i++) {
    const float *v = g->node + 4 * i;
    packed[2 * i] = packed_word(of_value * (double)v[0], of_slope * (double)v[1]);
    packed[2 * i + 1] = packed_word(of_slope * (double)v[2], of_slope * (double)v[3]);
  }
}

/* number of the block, -1 without nodes or beyond the grid */
static int number_of(const grid_view *g, int i, int j, int k)
{
  const bool is_in =
    i >= 0 && j >= 0 && k >= 0 && i < g->blocks[0] && j < g->blocks[1] && k < g->blocks[2];
  return is_in ? g->block[grid_block_at(g, i, j, k)] : -1;
}

/* In each block a node of its own, or the last one of the block before. */
int grid_copies(const grid_view *view, const int at[3], size_t places[8])
{
  int count = 0;
  for (int corner = 0; corner < 8; corner++) {
    const int before[3] = {corner % 2, corner / 2 % 2, corner / 4};
    int block[3], local[3];
    bool holds = true;
    for (int axis = 0; axis < 3; axis++) {
      block[axis] = at[axis] / GRID_SIDE - before[axis];
      local[axis] = at[axis] - GRID_SIDE * block[axis];
      holds = holds && local[axis] <= GRID_SIDE;
    }
    const int number = holds ? number_of(view, block[0], block[1], block[2]) : -1;
    if (number >= 0) places[count++] = grid_node_at(number, local[0], local[1], local[2]);
  }
  return count;
}

kg_vec3 grid_place(const grid_view *view, int i, int j, int k)
{
  return kg_vec3_add(view->lo,
                     kg_vec3_make(i * view->spacing, j * view->spacing, k * view->spacing));
}

static double center_along(double lo, double spacing, int block, int nodes)
{
  const int middle = block * GRID_SIDE + GRID_SIDE / 2;
  return lo + spacing * (middle < nodes ? middle : nodes - 1);
}

kg_vec3 grid_center_place(const grid_view *view, int i, int j, int k)
{
  return kg_vec3_make(center_along(view->lo.x, view->spacing, i, view->n[0]),
                      center_along(view->lo.y, view->spacing, j, view->n[1]),
                      center_along(view->lo.z, view->spacing, k, view->n[2]));
}

void kg_grid_destroy(kg_grid *grid)
{
  if (grid) {
    kg_arena arena = grid->arena; /* the grid lives in its own arena */
    kg_arena_release(&arena);
  }
}

bool grid_is_fine(kg_vec3 lo, double spacing, const int n[3])
{
  const double corner[6] = {
    lo.x, lo.y, lo.z, lo.x + spacing * n[0], lo.y + spacing * n[1], lo.z + spacing * n[2]};
  double largest = 0.0;
  for (int k = 0; k < 6; k++) {
    largest = fmax(largest, fabs(corner[k]));
  }
  return spacing > 0.0 && spacing >= 1e-9 * largest;
}

/* ---- triangles in the grid's coordinates -------------------------------------------------------- */

typedef struct local_mesh {
  const kg_mesh *mesh;
  kg_vec3 origin;
  int count;
  int *slot; /* (count) of each triangle in the mesh */
  boxes tree;
  grid_box *around;         /* of each node of the tree  */
  grid_triangle *triangles; /* in the order of the tree  */
  float slack;              /* m: rounding in the test of a box */
} local_mesh;

static void local_corners(int triangle, kg_vec3 out[3], const void *user)
{
  const local_mesh *local = user;
  mesh_corners(local->mesh, local->slot[triangle], out);
  for (int k = 0; k < 3; k++) {
    out[k] = kg_vec3_sub(out[k], local->origin);
  }
}

static void to_floats(float out[3], kg_vec3 v)
{
  out[0] = (float)v.x;
  out[1] = (float)v.y;
  out[2] = (float)v.z;
}

/* 1 / |e|^2; 0 for an edge too short for floats, whose end will do for all of it */
static float inverse_square(kg_vec3 e)
{
  const double square = kg_vec3_dot(e, e);
  return square > 1e-30 ? (float)(1.0 / square) : 0.0f;
}

static grid_triangle make_triangle(const kg_vec3 p[3])
{
  const kg_vec3 u = kg_vec3_sub(p[1], p[0]), v = kg_vec3_sub(p[2], p[0]),
                w = kg_vec3_sub(p[2], p[1]);
  const kg_vec3 n = kg_vec3_normalized(kg_vec3_cross(u, v));
  grid_triangle t = {.inverse_uu = inverse_square(u),
                     .inverse_vv = inverse_square(v),
                     .inverse_ww = inverse_square(w)};
  to_floats(t.a, p[0]);
  to_floats(t.u, u);
  to_floats(t.v, v);
  to_floats(t.w, w);
  to_floats(t.n, n);
  to_floats(t.m_ab, kg_vec3_normalized(kg_vec3_cross(n, u)));
  to_floats(t.m_ca, kg_vec3_normalized(kg_vec3_cross(v, n)));
  to_floats(t.m_bc, kg_vec3_normalized(kg_vec3_cross(n, w)));
  return t;
}

typedef struct axes {
  kg_vec3 e[3];
} axes;

static void grow(const grid_triangle *t, const axes *in, double lo[3], double hi[3])
{
  const kg_vec3 a = {(double)t->a[0], (double)t->a[1], (double)t->a[2]};
  const kg_vec3 u = {(double)t->u[0], (double)t->u[1], (double)t->u[2]};
  const kg_vec3 v = {(double)t->v[0], (double)t->v[1], (double)t->v[2]};
  for (int i = 0; i < 3; i++) {
    const double at = kg_vec3_dot(a, in->e[i]);
    const double du = kg_vec3_dot(u, in->e[i]), dv = kg_vec3_dot(v, in->e[i]);
    lo[i] = fmin(lo[i], at + fmin(0.0, fmin(du, dv)));
    hi[i] = fmax(hi[i], at + fmax(0.0, fmax(du, dv)));
  }
}

/* box of triangles [first, end) in these axes; its half surface */
static double fit_box(const local_mesh *local, int first, int end, const axes *in, grid_box *out)
{
  double lo[3] = {INFINITY, INFINITY, INFINITY}, hi[3] = {-INFINITY, -INFINITY, -INFINITY};
  for (int k = first; k < end; k++) {
    grow(&local->triangles[k], in, lo, hi);
  }
  kg_vec3 center = {0.0, 0.0, 0.0};
  *out = (grid_box){.unused = 0.0f};
  for (int i = 0; i < 3; i++) {
    center = kg_vec3_add_scaled(center, 0.5 * (lo[i] + hi[i]), in->e[i]);
    out->half[i] = (float)(0.5 * (hi[i] - lo[i])) + local->slack;
    to_floats(out->axis[i], in->e[i]);
  }
  to_floats(out->center, center);
  const double x = hi[0] - lo[0], y = hi[1] - lo[1], z = hi[2] - lo[2];
  return x * y + y * z + z * x;
}

/* the first axis along the mean normal */
static axes flat_axes(const local_mesh *local, int first, int end)
{
  kg_vec3 sum = {0.0, 0.0, 0.0};
  for (int k = first; k < end; k++) {
    const grid_triangle *t = &local->triangles[k];
    const kg_vec3 u = {(double)t->u[0], (double)t->u[1], (double)t->u[2]};
    const kg_vec3 v = {(double)t->v[0], (double)t->v[1], (double)t->v[2]};
    sum = kg_vec3_add(sum, kg_vec3_cross(u, v));
  }
  const double size = kg_vec3_norm(sum);
  const kg_vec3 n = size > 0.0 ? kg_vec3_scale(1.0 / size, sum) : kg_vec3_make(1.0, 0.0, 0.0);
  const kg_vec3 e = any_orthogonal(n);
  return (axes){{n, e, kg_vec3_cross(n, e)}};
}

enum { MOST_TURNED = 512 }; /* triangles of a node; larger ones are hardly flat */

/* Triangles of the node: those of its leaves follow one another. */
static void fit_node(const local_mesh *local, int index, int first, int end)
{
  static const axes world = {{{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
  grid_box *box = &local->around[index], turned;
  const double area = fit_box(local, first, end, &world, box);
  if (end - first <= MOST_TURNED) {
    const axes flat = flat_axes(local, first, end);
    if (fit_box(local, first, end, &flat, &turned) < area) *box = turned;
  }
  const boxes_node *node = &local->tree.nodes[index];
  if (node->count == 0) {
    const int middle = boxes_middle(first, end);
    fit_node(local, node->first, first, middle);
    fit_node(local, node->first + 1, middle, end);
  }
}

/* Each triangle once: a packet that is not full repeats its last one. */
static bool collect_slots(local_mesh *local, kg_arena *arena)
{
  const bvh *tree = &local->mesh->tree;
  const int slots = BVH_LEAF * tree->packet_count;
  local->slot = kg_arena_take(arena, (size_t)slots * sizeof *local->slot, 64);
  if (!local->slot) return false;
  for (int slot = 0; slot < slots; slot++) {
    const bool repeats = slot % BVH_LEAF > 0 && tree->face[slot] == tree->face[slot - 1];
    if (!repeats) local->slot[local->count++] = slot;
  }
  return true;
}

static bool make_local(local_mesh *local, const kg_mesh *mesh, kg_vec3 origin, double slack,
                       kg_arena *arena)
{
  *local = (local_mesh){.mesh = mesh, .origin = origin, .slack = (float)(0.3 * slack)};
  if (!collect_slots(local, arena)) return false;
  const size_t count = (size_t)local->count;
  local->around = kg_arena_take(arena, (count + 1) * sizeof *local->around, 64);
  local->triangles = kg_arena_take(arena, count * sizeof *local->triangles, 64);
  if (!local->triangles || !local->around ||
      !boxes_build(&local->tree, local->count, local_corners, local, arena)) {
    return false;
  }
  for (int k = 0; k < local->count; k++) {
    kg_vec3 p[3];
    local_corners(local->tree.order[k], p, local);
    local->triangles[k] = make_triangle(p);
  }
  fit_node(local, 0, 0, local->count);
  return true;
}

/* ---- nodes -------------------------------------------------------------------------------------- */

typedef struct sampling {
  kg_grid *grid;
  const local_mesh *local; /* NULL: of a field */
  bool of_centers;
  int layers;
  atomic_int next_layer;
  atomic_bool undefined;
} sampling;

static void set_values(sampling *s, float *node, const kg_sdf_value *value)
{
  node[0] = (float)value->distance;
  to_floats(node + 1, value->normal);
  if (!isfinite(node[0]) || !isfinite(node[1]) || !isfinite(node[2]) || !isfinite(node[3])) {
    atomic_store(&s->undefined, true);
  }
}

static void set_node(sampling *s, const int at[3], const kg_sdf_value *value)
{
  size_t places[8];
  const int count = grid_copies(&s->grid->view, at, places);
  for (int k = 0; k < count; k++) {
    set_values(s, grid_nodes(s->grid) + 4 * places[k], value);
  }
}

/* a center or a node */
static kg_vec3 place_of(const sampling *s, const int at[3])
{
  const grid_view *g = &s->grid->view;
  return s->of_centers ? grid_center_place(g, at[0], at[1], at[2])
                       : grid_place(g, at[0], at[1], at[2]);
}

static void set(sampling *s, const int at[3], const kg_sdf_value *value)
{
  if (s->of_centers) {
    const size_t block = grid_block_at(&s->grid->view, at[0], at[1], at[2]);
    set_values(s, grid_centers(s->grid) + 4 * block, value);
  } else {
    set_node(s, at, value);
  }
}

/* how many there are along an axis */
static int sample_count(const sampling *s, int axis)
{
  return s->of_centers ? s->grid->view.blocks[axis] : s->grid->view.n[axis];
}

static void place_packet(const sampling *s, const int first[3], int at[GRID_PACKET][3],
                         grid_packet *packet)
{
  for (int lane = 0; lane < GRID_PACKET; lane++) {
    const int offset[3] = {lane % PACKET_X, lane / PACKET_X % PACKET_Y,
                           lane / (PACKET_X * PACKET_Y)};
    for (int axis = 0; axis < 3; axis++) { /* at the end the last one again */
      const int last = sample_count(s, axis) - 1, index = first[axis] + offset[axis];
      at[lane][axis] = index < last ? index : last;
    }
    float x[3];
    to_floats(x, kg_vec3_sub(place_of(s, at[lane]), s->grid->view.lo));
    for (int axis = 0; axis < 3; axis++) {
      packet->x[axis][lane] = x[axis];
    }
    packet->distance2[lane] = INFINITY;
  }
}

/* seeds: some triangles of the packet before, -1 for none */
static void sample_mesh(sampling *s, const int at[GRID_PACKET][3], grid_packet *packet,
                        int seeds[4])
{
  const local_mesh *local = s->local;
  const kg_grid_kernels *kernels = s->grid->kernels;
  for (int k = 0; k < 4 && seeds[k] >= 0; k++) {
    if (k == 0 || seeds[k] != seeds[k - 1])
      kernels->try_triangle(local->triangles, seeds[k], packet);
  }
  kernels->search(&local->tree, local->around, local->triangles, packet);
  for (int lane = 0; lane < GRID_PACKET; lane++) {
    const kg_vec3 x = place_of(s, at[lane]);
    const int slot = local->slot[local->tree.order[packet->triangle[lane]]];
    kg_sdf_value value;
    if (!mesh_value_on(local->mesh, x, slot, &value)) {
      value = kg_mesh_distance(local->mesh, x);
    }
    set(s, at[lane], &value);
  }
  for (int k = 0; k < 4; k++) {
    seeds[k] = packet->triangle[5 * k];
  }
}

static void sample_packet(sampling *s, const int first[3], int seeds[4])
{
  int at[GRID_PACKET][3];
  grid_packet packet;
  place_packet(s, first, at, &packet);
  if (s->local) {
    sample_mesh(s, (const int(*)[3])at, &packet, seeds);
    return;
  }
  for (int lane = 0; lane < GRID_PACKET; lane++) {
    const kg_sdf_value value = grid_ask(&s->grid->source, place_of(s, at[lane]));
    set(s, at[lane], &value);
  }
}

/* Does a block hold a node of the packet? A packet is as long as a block along x. */
static bool is_wanted(const sampling *s, const int first[3])
{
  if (s->of_centers) return true;
  const int back_y = first[1] % GRID_SIDE == 0, back_z = first[2] % GRID_SIDE == 0;
  for (int k = first[2] / GRID_SIDE - back_z; k <= first[2] / GRID_SIDE; k++) {
    for (int j = first[1] / GRID_SIDE - back_y; j <= first[1] / GRID_SIDE; j++) {
      for (int i = first[0] / GRID_SIDE - 1; i <= first[0] / GRID_SIDE; i++) {
        if (number_of(&s->grid->view, i, j, k) >= 0) return true;
      }
    }
  }
  return false;
}

static void sample_layer(sampling *s, int z)
{
  int seeds[4] = {-1, -1, -1, -1};
  const int columns = (sample_count(s, 0) + PACKET_X - 1) / PACKET_X;
  for (int y = 0; y < sample_count(s, 1); y += PACKET_Y) {
    for (int c = 0; c < columns; c++) { /* there and back: the packet before is a neighbour */
      const int x = PACKET_X * (y / PACKET_Y % 2 ? columns - 1 - c : c);
      const int first[3] = {x, y, z};
      if (is_wanted(s, first)) sample_packet(s, first, seeds);
    }
  }
}

static void *sample_layers(void *user)
{
  sampling *s = user;
  for (;;) {
    const int layer = atomic_fetch_add(&s->next_layer, 1);
    if (layer >= s->layers) return NULL;
    sample_layer(s, PACKET_Z * layer);
  }
}

static void sample(sampling *s, bool of_centers, int threads)
{
  s->of_centers = of_centers;
  s->layers = (sample_count(s, 2) + PACKET_Z - 1) / PACKET_Z;
  atomic_store(&s->next_layer, 0);
  pthread_t workers[MOST_THREADS];
  int started = 0;
  while (started + 1 < threads && started + 1 < MOST_THREADS &&
         pthread_create(&workers[started], NULL, sample_layers, s) == 0) {
    started++;
  }
  (void)sample_layers(s); /* and all of it when no thread is to be had */
  for (int i = 0; i < started; i++) {
    pthread_join(workers[i], NULL);
  }
}

/* ---- definition --------------------------------------------------------------------------------- */

static double longest_side(kg_vec3 lo, kg_vec3 hi)
{
  return fmax(hi.x - lo.x, fmax(hi.y - lo.y, hi.z - lo.z));
}

kg_grid_def kg_grid_mesh_def(const kg_mesh *mesh, int nodes)
{
  KG_ASSERT(mesh && nodes >= 2);
  kg_vec3 lo, hi;
  kg_mesh_bounds(mesh, &lo, &hi);
  const double margin = 0.05 * longest_side(lo, hi);
  const kg_vec3 around = kg_vec3_make(margin, margin, margin);
  kg_grid_def def = {.source = {.mesh = mesh}, .threads = 1};
  def.lo = kg_vec3_sub(lo, around);
  def.hi = kg_vec3_add(hi, around);
  def.spacing = longest_side(def.lo, def.hi) / (nodes - 1);
  return def;
}

kg_grid_def kg_grid_field_def(kg_sdf_fn *field, void *user, kg_vec3 lo, kg_vec3 hi, int nodes)
{
  KG_ASSERT(field && nodes >= 2);
  return (kg_grid_def){.source = {.field = field, .user = user},
                       .lo = lo,
                       .hi = hi,
                       .spacing = longest_side(lo, hi) / (nodes - 1),
                       .threads = 1};
}

/* intervals that cover a side; one that rounding has made a little longer than a whole number of them
 * gets no more */
static int node_count(double side, double spacing)
{
  const double intervals = ceil(side / spacing - 1e-6);
  return intervals < 1.0 ? 2 : intervals < INT_MAX / 2 ? (int)intervals + 1 : INT_MAX / 2;
}

kg_status kg_grid_create(kg_grid **grid, const kg_grid_def *def, kg_error *error)
{
  KG_ASSERT(grid && def && !def->source.mesh == !!def->source.field);
  KG_ASSERT(def->spacing > 0.0 && def->hi.x >= def->lo.x && def->hi.y >= def->lo.y &&
            def->hi.z >= def->lo.z && kg_vec3_norm(def->lo) < 1e17 && kg_vec3_norm(def->hi) < 1e17);
  const int n[3] = {node_count(def->hi.x - def->lo.x, def->spacing),
                    node_count(def->hi.y - def->lo.y, def->spacing),
                    node_count(def->hi.z - def->lo.z, def->spacing)};
  KG_ASSERT(grid_is_fine(def->lo, def->spacing, n));
  kg_grid *built;
  kg_status status = grid_allocate(&built, def->lo, def->spacing, n, def->allocator, error);
  if (status != KG_OK) {
    *grid = NULL;
    return status;
  }
  built->source = def->source;
  built->is_continuous = !def->source.mesh || def->source.mesh->is_closed;
  built->has_closest = def->source.mesh != NULL;
  kg_arena scratch;
  kg_arena_init(&scratch, def->allocator);
  local_mesh local;
  sampling s = {.grid = built};
  if (def->source.mesh && !make_local(&local, def->source.mesh, def->lo, built->slack, &scratch)) {
    status = kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory to build a grid of a mesh");
  } else {
    s.local = def->source.mesh ? &local : NULL;
    sample(&s, true, def->threads);
    (void)grid_choose_blocks(built);
    status = grid_allocate_nodes(built, error);
    if (status == KG_OK) sample(&s, false, def->threads);
    if (status == KG_OK && atomic_load(&s.undefined)) {
      status = kg_fail(error, KG_ERR_UNDEFINED, "", 0, 0, "the field is not finite at a node");
    }
  }
  kg_arena_release(&scratch);
  if (status == KG_OK) {
    grid_pack_nodes(built);
  } else {
    kg_grid_destroy(built);
    built = NULL;
  }
  *grid = built;
  return status;
}
