/* Sampling of a field, two layers of nodes after the other, by as many threads as wanted.
 *
 * Of a mesh, packets of 4 x 2 x 2 nodes look for their nearest triangles together, in floats, from
 * what the packet before found; the distance to the triangle found is then taken in double. In floats
 * a triangle can pass for nearer than another by some 1e-7 of the box, so a node's value is never
 * below |Phi| and not above it by more than GRID_SLACK of the diagonal. Where a nearly equal triangle
 * could have another sign (an edge or corner seen from far beside its pseudo-normal) the mesh is asked.
 * A layer's packets begin afresh, so that threads do not show in the result. */
#include "sdf/grid_internal.h"

#include "sdf/feature.h"
#include "sdf/mesh_parts.h"

#include <limits.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>

enum { MOST_THREADS = 64, PACKET_X = 4, PACKET_Y = 2, PACKET_Z = 2 };

/* ---- memory ------------------------------------------------------------------------------------- */

kg_status grid_allocate(kg_grid **grid, kg_vec3 lo, double spacing, const int n[3],
                        const kg_allocator *allocator, kg_error *error)
{
  *grid = NULL;
  const double count = (double)n[0] * n[1] * n[2];
  if (count >= 2147483648.0) {
    return kg_fail(error, KG_ERR_UNSUPPORTED, "", 0, 0, "a grid of %d x %d x %d nodes is too large",
                   n[0], n[1], n[2]);
  }
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_grid *built = KG_ARENA_ARRAY(&arena, kg_grid, 1);
  float *node = kg_arena_take(&arena, (size_t)count * 4 * sizeof(float) + 64, 64);
  if (!built || !node) {
    kg_arena_release(&arena);
    return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a grid of %d x %d x %d nodes",
                   n[0], n[1], n[2]);
  }
  built->arena = arena;
  built->kernels = kg_sdf_kernels_best()->grid;
  built->view = (grid_view){.lo = lo, .spacing = spacing, .node = node};
  memcpy(built->view.n, n, sizeof built->view.n);
  built->hi = grid_place(&built->view, n[0] - 1, n[1] - 1, n[2] - 1);
  built->slack = GRID_SLACK * kg_vec3_norm(kg_vec3_sub(built->hi, lo));
  *grid = built;
  return KG_OK;
}

float *grid_nodes(kg_grid *grid)
{
  return (float *)(uintptr_t)grid->view.node; /* const for everyone else */
}

kg_vec3 grid_place(const grid_view *view, int i, int j, int k)
{
  return kg_vec3_add(view->lo,
                     kg_vec3_make(i * view->spacing, j * view->spacing, k * view->spacing));
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
  (void)mesh_slot(local->mesh, local->slot[triangle], out);
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
    const int middle = first + (end - first) / 2; /* as boxes_build halves */
    fit_node(local, node->first, first, middle);
    fit_node(local, node->first + 1, middle, end);
  }
}

static bool collect_slots(local_mesh *local, kg_arena *arena)
{
  const int slots = mesh_slot_count(local->mesh);
  local->slot = kg_arena_take(arena, (size_t)slots * sizeof *local->slot, 64);
  if (!local->slot) return false;
  for (int slot = 0; slot < slots; slot++) {
    kg_vec3 unused[3];
    if (mesh_slot(local->mesh, slot, unused)) local->slot[local->count++] = slot;
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
  atomic_int next_layer;
  atomic_bool undefined;
} sampling;

static void set_node(sampling *s, int i, int j, int k, kg_sdf_value value)
{
  const grid_view *g = &s->grid->view;
  float *node = grid_nodes(s->grid) +
                4 * (((size_t)k * (size_t)g->n[1] + (size_t)j) * (size_t)g->n[0] + (size_t)i);
  node[0] = (float)value.distance;
  to_floats(node + 1, value.normal);
  if (!isfinite(node[0]) || !isfinite(node[1]) || !isfinite(node[2]) || !isfinite(node[3])) {
    atomic_store(&s->undefined, true);
  }
}

/* node of a lane; at the grid's end the last one again */
static int lane_index(int first, int offset, int n)
{
  return first + offset < n ? first + offset : n - 1;
}

static void place_packet(const grid_view *g, const int first[3], int at[GRID_PACKET][3],
                         grid_packet *packet)
{
  for (int lane = 0; lane < GRID_PACKET; lane++) {
    const int offset[3] = {lane % PACKET_X, lane / PACKET_X % PACKET_Y,
                           lane / (PACKET_X * PACKET_Y)};
    for (int axis = 0; axis < 3; axis++) {
      at[lane][axis] = lane_index(first[axis], offset[axis], g->n[axis]);
      packet->x[axis][lane] = (float)(at[lane][axis] * g->spacing);
    }
    packet->distance2[lane] = INFINITY;
  }
}

/* seeds: some triangles of the packet before, -1 for none */
static void sample_packet(sampling *s, const int first[3], int seeds[4])
{
  const local_mesh *local = s->local;
  const kg_grid_kernels *kernels = s->grid->kernels;
  int at[GRID_PACKET][3];
  grid_packet packet;
  place_packet(&s->grid->view, first, at, &packet);
  for (int k = 0; k < 4 && seeds[k] >= 0; k++) {
    if (k == 0 || seeds[k] != seeds[k - 1])
      kernels->try_triangle(local->triangles, seeds[k], &packet);
  }
  kernels->search(&local->tree, local->around, local->triangles, &packet);
  for (int lane = 0; lane < GRID_PACKET; lane++) {
    const kg_vec3 x = grid_place(&s->grid->view, at[lane][0], at[lane][1], at[lane][2]);
    const int slot = local->slot[local->tree.order[packet.triangle[lane]]];
    kg_sdf_value value;
    if (!mesh_value_on(local->mesh, x, slot, &value)) {
      value = kg_mesh_distance(local->mesh, x);
    }
    set_node(s, at[lane][0], at[lane][1], at[lane][2], value);
  }
  for (int k = 0; k < 4; k++) {
    seeds[k] = packet.triangle[5 * k];
  }
}

static void sample_mesh_layer(sampling *s, int z)
{
  const int *n = s->grid->view.n;
  int seeds[4] = {-1, -1, -1, -1};
  const int columns = (n[0] + PACKET_X - 1) / PACKET_X;
  for (int y = 0; y < n[1]; y += PACKET_Y) {
    for (int c = 0; c < columns; c++) { /* there and back: the packet before is a neighbour */
      const int x = PACKET_X * (y / PACKET_Y % 2 ? columns - 1 - c : c);
      sample_packet(s, (int[3]){x, y, z}, seeds);
    }
  }
}

static void sample_field_layer(sampling *s, int z)
{
  const grid_view *g = &s->grid->view;
  for (int k = z; k < g->n[2] && k < z + PACKET_Z; k++) {
    for (int j = 0; j < g->n[1]; j++) {
      for (int i = 0; i < g->n[0]; i++) {
        set_node(s, i, j, k, grid_ask(&s->grid->source, grid_place(g, i, j, k)));
      }
    }
  }
}

static void *sample_layers(void *user)
{
  sampling *s = user;
  for (;;) {
    const int z = PACKET_Z * atomic_fetch_add(&s->next_layer, 1);
    if (z >= s->grid->view.n[2]) return NULL;
    if (s->local) {
      sample_mesh_layer(s, z);
    } else {
      sample_field_layer(s, z);
    }
  }
}

static void sample(sampling *s, int threads)
{
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
  built->is_continuous = !def->source.mesh || mesh_is_closed(def->source.mesh);
  built->has_closest = def->source.mesh != NULL;
  kg_arena scratch;
  kg_arena_init(&scratch, def->allocator);
  local_mesh local;
  sampling s = {.grid = built};
  if (def->source.mesh && !make_local(&local, def->source.mesh, def->lo, built->slack, &scratch)) {
    status = kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory to build a grid of a mesh");
  } else {
    s.local = def->source.mesh ? &local : NULL;
    sample(&s, def->threads);
    if (atomic_load(&s.undefined)) {
      status = kg_fail(error, KG_ERR_UNDEFINED, "", 0, 0, "the field is not finite at a node");
    }
  }
  kg_arena_release(&scratch);
  if (status != KG_OK) {
    kg_grid_destroy(built);
    built = NULL;
  }
  *grid = built;
  return status;
}
