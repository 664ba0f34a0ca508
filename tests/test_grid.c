/* Grids of distances against the fields they sample: nodes, interpolant, bounds, threads, files. */
#include "mesh_support.h"

#include "kinegrad/grid.h"
#include "sdf/grid_internal.h"

#include <stdio.h>

static soup the_soup; /* large: not on the stack */

typedef enum surface { SPIKY, BOXES, SHEET, SURFACES } surface;

static kg_mesh *make_mesh(surface kind)
{
  soup *s = &the_soup;
  s->vertex_count = s->triangle_count = 0;
  if (kind == SPIKY) add_spiky(s, 3, 5);
  if (kind == BOXES) { /* a thin plate beside a cube */
    add_box(s, kg_vec3_make(-0.5, -0.2, -0.3), kg_vec3_make(0.4, 0.7, 0.1));
    add_box(s, kg_vec3_make(0.6, -0.5, -0.5), kg_vec3_make(0.61, 0.5, 0.5));
  }
  if (kind == SHEET) { /* open, and far from the origin */
    for (int k = 0; k < 49; k++) {
      const double x = k % 7 / 3.0 + 20.0, z = k / 7 / 3.0 - 30.0;
      add_vertex(s, kg_vec3_make(x, 0.2 * sin(3.0 * x) * cos(2.0 * z), z));
    }
    for (int k = 0; k < 36; k++) {
      const int a = k / 6 * 7 + k % 6, b = a + 7;
      add_triangle(s, a, b, b + 1);
      add_triangle(s, a, b + 1, a + 1);
    }
  }
  return build_mesh(s, NULL);
}

static kg_grid *make_grid(const kg_grid_def *def)
{
  kg_grid *grid;
  kg_error error = {0};
  if (kg_grid_create(&grid, def, &error) != KG_OK) fail_msg("%s", error.text);
  return grid;
}

static kg_grid *grid_of(const kg_mesh *mesh, int nodes)
{
  const kg_grid_def def = kg_grid_mesh_def(mesh, nodes);
  return make_grid(&def);
}

/* a smooth field: the ball, but for its centre */
static kg_sdf_value ball(kg_vec3 x, void *user)
{
  const double radius = *(const double *)user;
  return (kg_sdf_value){kg_vec3_norm(x) - radius, kg_vec3_normalized(x), {0.0}};
}

static double random_in(kg_random *random, double lo, double hi)
{
  return lo + (hi - lo) * kg_random_uniform(random);
}

/* in the box of the nodes, blown up by a factor */
static kg_vec3 random_place(kg_random *random, const kg_grid_info *info, double blow)
{
  const kg_vec3 middle = kg_vec3_lerp(info->lo, info->hi, 0.5);
  const kg_vec3 d = kg_vec3_scale(0.5 * blow, kg_vec3_sub(info->hi, info->lo));
  const double x = random_in(random, -d.x, d.x), y = random_in(random, -d.y, d.y);
  return kg_vec3_add(middle, kg_vec3_make(x, y, random_in(random, -d.z, d.z)));
}

/* ---- nodes --------------------------------------------------------------------------------------*/

/* a number of half a word, out of the largest of its kind: half a unit of it, and floats */
static double rounding_of(double largest)
{
  return 0.51 / 32767.0 * largest;
}

/* the node as it is held in every block that has it, read back from what is packed too */
static void assert_node(const kg_grid *grid, const int at[3], kg_grid_value *v)
{
  const grid_view *g = &grid->view;
  size_t places[8];
  const int copies = grid_copies(g, at, places);
  assert_true(copies > 0);
  const float *node = g->node + 4 * places[0];
  for (int i = 0; i < copies; i++) {
    assert_memory_equal(g->node + 4 * places[i], node, 4 * sizeof *node);
    assert_memory_equal(g->packed + 2 * places[i], g->packed + 2 * places[0], 2 * sizeof(int32_t));
  }
  const double value_rounding = rounding_of(g->largest), slope_rounding = rounding_of(g->steepest);
  const kg_vec3 n = {(double)node[1], (double)node[2], (double)node[3]};
  const kg_vec3 off = kg_vec3_sub(v->gradient, n);
  assert_at_most(g->largest, 9.0 * g->spacing);
  assert_at_most(fabs(v->distance - (double)node[0]), value_rounding);
  assert_at_most(fmax(fabs(off.x), fmax(fabs(off.y), fabs(off.z))), slope_rounding + 1e-6);
  v->distance = (double)node[0];
  v->gradient = n;
}

static void every_node_holds_the_exact_distance(void **state)
{
  (void)state;
  for (int kind = 0; kind < SURFACES; kind++) {
    kg_mesh *mesh = make_mesh((surface)kind);
    kg_grid *grid = grid_of(mesh, 23); /* no multiple of a packet along any side */
    const kg_grid_info info = kg_grid_describe(grid);
    for (int k = 0; k < info.n[2]; k++) {
      for (int j = 0; j < info.n[1]; j++) {
        for (int i = 0; i < info.n[0]; i++) {
          const kg_vec3 x = kg_vec3_add(
            info.lo, kg_vec3_make(i * info.spacing, j * info.spacing, k * info.spacing));
          kg_grid_value v = kg_grid_distance(grid, x);
          if (!v.is_exact) assert_node(grid, (const int[3]){i, j, k}, &v);
          const kg_sdf_value exact = kg_mesh_distance(mesh, x);
          assert_at_most(fabs(v.distance - exact.distance), info.slack);
          assert_at_most(fabs(brute_distance(&the_soup, x) - fabs(v.distance)), info.slack);
          assert_at_most(fabs(kg_vec3_norm(v.gradient) - 1.0), 1e-5);
          /* the gradient leads to the surface */
          const kg_vec3 c = kg_vec3_add_scaled(x, -v.distance, v.gradient);
          assert_at_most(brute_distance(&the_soup, c), 4.0 * info.slack + 1e-6 * fabs(v.distance));
        }
      }
    }
    kg_grid_destroy(grid);
    kg_mesh_destroy(mesh);
  }
}

static void box_and_spacing_are_covered(void **state)
{
  (void)state;
  double radius = 0.5;
  const kg_grid_def def = kg_grid_field_def(ball, &radius, kg_vec3_make(-1.0, -0.9, -0.31),
                                            kg_vec3_make(1.0, 0.9, 0.3), 41);
  kg_grid *grid = make_grid(&def);
  const kg_grid_info info = kg_grid_describe(grid);
  assert_int_equal(info.n[0], 41);
  assert_int_equal(info.n[1], 37);
  assert_int_equal(info.n[2], 14); /* 0.61 / 0.05 rounded up, and one */
  assert_close(info.hi.x, 1.0, 1e-12);
  assert_true(info.hi.z >= 0.3 && info.hi.z < 0.35);
  kg_grid_destroy(grid);
}

/* ---- the interpolant ----------------------------------------------------------------------------*/

/* weights of both ends: value, slope; w[2], w[3] of the slopes */
static void hermite(double t, double h, double w[4], double dw[4])
{
  w[0] = 1.0 - t * t * (3.0 - 2.0 * t);
  w[1] = t * t * (3.0 - 2.0 * t);
  w[2] = h * (t - 2.0 * t * t + t * t * t);
  w[3] = h * (t * t * t - t * t);
  dw[1] = 6.0 * t * (1.0 - t) / h;
  dw[0] = -dw[1];
  dw[2] = 1.0 - 4.0 * t + 3.0 * t * t;
  dw[3] = 3.0 * t * t - 2.0 * t;
}

/* number of a packed node, as sdf/kernels/grid.h says: value, gradient */
static double unpacked(const grid_view *g, size_t node, int part)
{
  const int32_t word = g->packed[2 * node + (size_t)part / 2];
  const double largest = part == 0 ? g->largest : g->steepest;
  const int low = (int)((uint32_t)word & 0xffff);
  const double half = low < 32768 ? low : low - 65536;
  return largest * (part % 2 == 0 ? word / GRID_PACKED : half / 32767.0);
}

/* the formula of sdf/kernels/grid.c, node by node in double; false: x is in a block without nodes */
static bool plain_interpolant(const kg_grid *grid, kg_vec3 x, double out[4])
{
  const grid_view *g = &grid->view;
  const double offset[3] = {x.x - g->lo.x, x.y - g->lo.y, x.z - g->lo.z};
  double w[3][4], dw[3][4];
  int cell[3];
  for (int a = 0; a < 3; a++) {
    const double at = offset[a] / g->spacing;
    cell[a] = (int)fmin(floor(at), g->n[a] - 2);
    hermite(at - cell[a], g->spacing, w[a], dw[a]);
  }
  memset(out, 0, 4 * sizeof *out);
  const int block =
    g->block[(cell[2] / 4 * g->blocks[1] + cell[1] / 4) * g->blocks[0] + cell[0] / 4];
  if (block < 0) return false;
  for (int corner = 0; corner < 8; corner++) {
    const int c[3] = {corner & 1, corner >> 1 & 1, corner >> 2};
    const size_t at = (size_t)(128 * block + (cell[2] % 4 + c[2]) * 25 + (cell[1] % 4 + c[1]) * 5 +
                               cell[0] % 4 + c[0]);
    for (int part = 0; part < 4; part++) {      /* value, gradient */
      for (int slope = 0; slope < 4; slope++) { /* of which of them */
        double product = unpacked(g, at, part);
        for (int a = 0; a < 3; a++) {
          const int which = c[a] + (part == a + 1 ? 2 : 0);
          product *= slope == a + 1 ? dw[a][which] : w[a][which];
        }
        out[slope] += product;
      }
    }
  }
  return true;
}

static void interpolant_is_the_documented_one(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(SPIKY);
  kg_grid *grid = grid_of(mesh, 50);
  const kg_grid_info info = kg_grid_describe(grid);
  kg_random random = kg_random_make(41);
  int known = 0;
  for (int i = 0; i < 3000; i++) {
    const kg_vec3 x = random_place(&random, &info, 1.0);
    double plain[4];
    const bool is_known = plain_interpolant(grid, x, plain);
    known += is_known;
    for (int level = 1; level <= 3; level++) {
      const kg_sdf_kernels *kernels = kg_sdf_kernels_of_level(level);
      double distance = NAN;
      kg_vec3 gradient = {NAN, NAN, NAN};
      int unknown = -1;
      if (!kernels) continue; /* this processor does not have it */
      const int unknown_count =
        kernels->grid->interpolate(&grid->view, 1, &x, &distance, &gradient, &unknown);
      assert_true(unknown_count == (is_known ? 0 : 1) && unknown == (is_known ? -1 : 0));
      if (!is_known) continue;
      assert_close(distance, plain[0], 2e-6);
      assert_close(gradient.x, plain[1], 2e-5);
      assert_close(gradient.y, plain[2], 2e-5);
      assert_close(gradient.z, plain[3], 2e-5);
    }
  }
  assert_true(known > 500 && known < 2500);
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
}

/* Value and gradient from both sides of a face between cells, edges and corners included. */
static void value_and_gradient_are_continuous(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(SPIKY);
  kg_grid *grid = grid_of(mesh, 20);
  const kg_grid_info info = kg_grid_describe(grid);
  kg_random random = kg_random_make(42);
  double jump = 0.0;
  int pairs = 0;
  for (int i = 0; i < 4000; i++) {
    kg_vec3 x = random_place(&random, &info, 0.9), beside = x;
    double *along[3] = {&x.x, &x.y, &x.z}, *other[3] = {&beside.x, &beside.y, &beside.z};
    const double lo[3] = {info.lo.x, info.lo.y, info.lo.z};
    for (int a = 0; a <= i % 3; a++) { /* to the next plane of nodes, and hardly beyond it */
      const double plane = lo[a] + info.spacing * floor((*along[a] - lo[a]) / info.spacing);
      *along[a] = plane - 1e-7 * info.spacing;
      *other[a] = plane + 1e-7 * info.spacing;
    }
    const kg_grid_value v = kg_grid_distance(grid, x), w = kg_grid_distance(grid, beside);
    if (v.is_exact || w.is_exact) continue; /* a block without nodes */
    pairs++;
    assert_at_most(fabs(v.distance - w.distance), 2e-6);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(v.gradient, w.gradient)), 5e-5);
    jump = fmax(jump, fabs(v.distance - w.distance));
  }
  assert_true(pairs > 2000);
  assert_true(jump > 0.0); /* the two sides were not one point */
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
}

static void gradient_is_that_of_the_interpolant(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(BOXES);
  kg_grid *grid = grid_of(mesh, 24);
  const kg_grid_info info = kg_grid_describe(grid);
  kg_random random = kg_random_make(43);
  for (int i = 0; i < 2000; i++) {
    const kg_vec3 x = random_place(&random, &info, 0.95);
    const kg_vec3 d = kg_vec3_normalized(random_vec3(&random, 1.0));
    const double step = 0.02 * info.spacing; /* values are floats */
    const double ahead = kg_grid_distance(grid, kg_vec3_add_scaled(x, step, d)).distance;
    const double behind = kg_grid_distance(grid, kg_vec3_add_scaled(x, -step, d)).distance;
    const double slope = kg_vec3_dot(kg_grid_distance(grid, x).gradient, d);
    assert_close(slope, (ahead - behind) / (2.0 * step), 4e-3);
  }
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
}

/* On a smooth field halving the spacing takes the error down at least with the spacing's square. */
static void error_falls_with_the_spacing(void **state)
{
  (void)state;
  double radius = 0.5, before = 0.0;
  for (int nodes = 16; nodes <= 64; nodes *= 2) {
    const kg_grid_def def = kg_grid_field_def(ball, &radius, kg_vec3_make(-0.8, -0.8, -0.8),
                                              kg_vec3_make(0.8, 0.8, 0.8), nodes);
    kg_grid *grid = make_grid(&def);
    kg_random random = kg_random_make(44);
    double sum = 0.0;
    for (int i = 0; i < 4000; i++) {
      const kg_vec3 n = kg_vec3_normalized(random_vec3(&random, 1.0));
      const double r = random_in(&random, 0.4, 0.6);
      const double error = kg_grid_distance(grid, kg_vec3_scale(r, n)).distance - (r - radius);
      sum += error * error;
    }
    const double rms = sqrt(sum / 4000);
    assert_at_most(rms, 0.01 * def.spacing);
    if (before > 0.0) assert_at_most(rms, 0.25 * before);
    before = rms;
    kg_grid_destroy(grid);
  }
}

/* ---- what is certain ----------------------------------------------------------------------------*/

static void bounds_hold_everywhere(void **state)
{
  (void)state;
  for (int kind = 0; kind < SURFACES; kind++) {
    kg_mesh *mesh = make_mesh((surface)kind);
    kg_grid *grid = grid_of(mesh, 60);
    kg_grid *alone = grid_of(mesh, 60);
    alone->source = (kg_grid_source){NULL, NULL, NULL};
    const kg_grid_info info = kg_grid_describe(grid);
    kg_random random = kg_random_make(45);
    double errors = 0.0, certain = 0.0, all = 0.0;
    int beside = 0, far = 0; /* in the box, but in no block with nodes */
    for (int i = 0; i < 8000; i++) {
      const kg_vec3 x = random_place(&random, &info, i % 2 ? 1.0 : 3.0);
      const double exact = kg_mesh_distance(mesh, x).distance;
      const kg_grid_value v = kg_grid_distance(grid, x), w = kg_grid_distance(alone, x);
      assert_at_most(fabs(v.distance - exact), v.error);
      assert_at_most(fabs(w.distance - exact), w.error);
      assert_false(w.is_exact);
      if (v.is_exact) {
        assert_true(v.distance == exact);
        beside++;
      } else {
        errors += v.error / 8000;
      }
      const bool is_in = i % 2 == 1;
      if (is_in && fabs(exact) < 2.0 * info.spacing) assert_false(v.is_exact);
      far += is_in && v.is_exact;
      const double bound = kg_grid_lower_bound(grid, x);
      assert_at_most(bound, fabs(exact));
      certain += is_in ? bound : 0.0;
      all += is_in ? fabs(exact) : 0.0;
    }
    assert_true(beside > 2000 && far > 500);
    if (kind != SHEET) assert_at_most(errors, info.spacing);
    assert_at_most(0.5 * all, certain); /* culling is worth something */
    kg_grid_destroy(grid);
    kg_grid_destroy(alone);
    kg_mesh_destroy(mesh);
  }
}

static void within_is_the_source_or_far(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(SPIKY);
  kg_grid *grid = grid_of(mesh, 24);
  double radius = 0.4;
  const kg_grid_def def =
    kg_grid_field_def(ball, &radius, kg_vec3_make(-1, -1, -1), kg_vec3_make(1, 1, 1), 12);
  kg_grid *round = make_grid(&def);
  const kg_grid_info info = kg_grid_describe(grid);
  kg_random random = kg_random_make(46);
  int near = 0;
  for (int i = 0; i < 4000; i++) {
    const kg_vec3 x = random_place(&random, &info, 1.2);
    kg_sdf_value value = {NAN, {0.0, 0.0, 0.0}, {0.0}};
    const double exact = kg_mesh_distance(mesh, x).distance;
    const bool is_near = kg_grid_distance_within(grid, x, 0.05, &value);
    assert_true(is_near == (fabs(exact) < 0.05));
    assert_true(is_near ? value.distance == exact : isnan(value.distance));
    near += is_near;
    const double r = kg_vec3_norm(x) - radius;
    assert_true(kg_grid_distance_within(round, x, 0.05, &value) == (fabs(r) < 0.05));
  }
  assert_true(near > 200);
  assert_false(kg_grid_distance_within(grid, info.lo, 0.0, &(kg_sdf_value){0}));
  kg_grid_destroy(round);
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
}

/* One answer at a time and many at once, inside, outside and at no place at all; with every instruction
 * set. */
static void many_points_are_each_point(void **state)
{
  (void)state;
  enum { MANY = 1000 };
  static kg_vec3 x[MANY], gradient[MANY];
  static double distance[MANY + 1];
  kg_mesh *mesh = make_mesh(BOXES);
  kg_grid *grid = grid_of(mesh, 20);
  const kg_grid_info info = kg_grid_describe(grid);
  kg_random random = kg_random_make(47);
  for (int i = 0; i < MANY; i++) {
    x[i] = random_place(&random, &info, i % 3 ? 1.0 : 2.0);
  }
  x[17] = kg_vec3_make(NAN, 0.0, 0.0);
  x[18] = info.lo;
  x[19] = info.hi;
  x[20] = kg_vec3_make(-INFINITY, 0.0, 1e300);
  for (int level = 1; level <= 3; level++) {
    const kg_sdf_kernels *kernels = kg_sdf_kernels_of_level(level);
    if (!kernels) continue; /* this processor does not have it */
    for (int count = 0; count <= MANY; count = count < 40 ? count + 1 : count + 320) {
      grid->kernels = kernels->grid;
      distance[count] = -7.0;
      kg_grid_distance_many(grid, count, x, distance, gradient);
      assert_true(distance[count] == -7.0);
      grid->kernels = kg_sdf_kernels_best()->grid;
      for (int i = 0; i < count; i++) {
        const kg_grid_value v = kg_grid_distance(grid, x[i]);
        assert_memory_equal(&distance[i], &v.distance, sizeof v.distance);
        assert_memory_equal(&gradient[i], &v.gradient, sizeof v.gradient);
      }
    }
  }
  assert_true(isnan(distance[17]));
  assert_true(isinf(distance[20]) && distance[20] > 0.0);
  assert_false(kg_grid_distance(grid, info.hi).is_exact);
  assert_true(kg_grid_lower_bound(grid, x[17]) == 0.0);
  kg_grid_destroy(grid);
  kg_mesh_destroy(mesh);
}

/* On each face of the box the interpolant answers, a thousandth of a cell outside the source. */
static void the_box_ends_at_its_faces(void **state)
{
  (void)state;
  double radius = 0.95; /* near to the middle of every face */
  const kg_grid_def def =
    kg_grid_field_def(ball, &radius, kg_vec3_make(-1, -1, -1), kg_vec3_make(1, 1, 1), 12);
  kg_grid *grid = make_grid(&def);
  const kg_grid_info info = kg_grid_describe(grid);
  const double lo[3] = {info.lo.x, info.lo.y, info.lo.z}, hi[3] = {info.hi.x, info.hi.y, info.hi.z};
  kg_random random = kg_random_make(55);
  for (int k = 0; k < 60; k++) {
    const int axis = k % 3, side = k / 3 % 2 ? 1 : -1, is_outside = k / 6 % 2;
    double at[3];
    for (int a = 0; a < 3; a++) {
      at[a] = random_in(&random, -0.1, 0.1);
    }
    at[axis] = (side > 0 ? hi : lo)[axis] + side * is_outside * 1e-3 * info.spacing;
    const kg_vec3 x = kg_vec3_make(at[0], at[1], at[2]);
    const double exact = kg_vec3_norm(x) - radius;
    const kg_grid_value v = kg_grid_distance(grid, x);
    assert_int_equal(v.is_exact, is_outside);
    assert_close(v.distance, exact, is_outside ? 1e-15 : 1e-2);
  }
  kg_grid_destroy(grid);
}

/* ---- files and threads --------------------------------------------------------------------------*/

static char *path_of(char path[1024], const char *name)
{
  snprintf(path, 1024, KG_TEST_SCRATCH "/%s.kggrid", name);
  return path;
}

static unsigned char *file_bytes(const char *path, size_t *size)
{
  FILE *file = fopen(path, "rb");
  assert_non_null(file);
  fseek(file, 0, SEEK_END);
  *size = (size_t)ftell(file);
  rewind(file);
  unsigned char *bytes = malloc(*size);
  assert_non_null(bytes);
  assert_int_equal(fread(bytes, 1, *size, file), *size);
  fclose(file);
  return bytes;
}

static void save_grid(const kg_grid *grid, const char *path)
{
  kg_error error = {0};
  if (kg_grid_save(grid, path, &error) != KG_OK) fail_msg("%s", error.text);
}

static void threads_do_not_show(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(SPIKY);
  double radius = 0.7;
  for (int kind = 0; kind < 2; kind++) {
    kg_grid_def def = kind == 0 ? kg_grid_mesh_def(mesh, 33)
                                : kg_grid_field_def(ball, &radius, kg_vec3_make(-1, -1, -1),
                                                    kg_vec3_make(1, 1, 1), 33);
    char path[1024];
    unsigned char *first = NULL;
    size_t size, first_size = 0;
    for (int threads = 0; threads <= 100; threads = 2 * threads + 1) {
      def.threads = threads;
      kg_grid *grid = make_grid(&def);
      save_grid(grid, path_of(path, "threads"));
      kg_grid_destroy(grid);
      unsigned char *bytes = file_bytes(path, &size);
      if (first) {
        assert_int_equal(size, first_size);
        assert_memory_equal(bytes, first, size);
        free(bytes);
      } else {
        first = bytes;
        first_size = size;
      }
    }
    free(first);
    remove(path);
  }
  kg_mesh_destroy(mesh);
}

static void saved_and_loaded_is_the_same(void **state)
{
  (void)state;
  for (int kind = 0; kind < SURFACES; kind++) {
    kg_mesh *mesh = make_mesh((surface)kind);
    kg_grid *grid = grid_of(mesh, 40), *loaded;
    char path[1024], again[1024];
    kg_error error = {0};
    const kg_grid_source source = {.mesh = mesh};
    save_grid(grid, path_of(path, "saved"));
    if (kg_grid_load(&loaded, path, &source, NULL, &error) != KG_OK) fail_msg("%s", error.text);
    const kg_grid_info a = kg_grid_describe(grid), b = kg_grid_describe(loaded);
    assert_memory_equal(a.n, b.n, sizeof a.n);
    assert_true(a.spacing == b.spacing && a.slack == b.slack);
    assert_memory_equal(&a.lo, &b.lo, sizeof a.lo);
    kg_random random = kg_random_make(48);
    for (int i = 0; i < 2000; i++) {
      const kg_vec3 x = random_place(&random, &a, 1.5);
      const kg_grid_value v = kg_grid_distance(grid, x), w = kg_grid_distance(loaded, x);
      assert_true(v.distance == w.distance && v.error == w.error && v.is_exact == w.is_exact);
      assert_memory_equal(&v.gradient, &w.gradient, sizeof v.gradient);
      assert_true(kg_grid_lower_bound(grid, x) == kg_grid_lower_bound(loaded, x));
    }
    save_grid(loaded, path_of(again, "again"));
    size_t size, size_again;
    unsigned char *bytes = file_bytes(path, &size), *bytes_again = file_bytes(again, &size_again);
    assert_int_equal(size, size_again);
    const int blocks = ((a.n[0] + 2) / 4) * ((a.n[1] + 2) / 4) * ((a.n[2] + 2) / 4);
    assert_true(grid->view.count > 0 && grid->view.count < blocks);
    assert_int_equal(size, 64 + 16 * (blocks + 125 * grid->view.count) + 8);
    assert_memory_equal(bytes, bytes_again, size);
    free(bytes);
    free(bytes_again);
    kg_grid_destroy(grid);
    kg_grid_destroy(loaded);
    kg_mesh_destroy(mesh);
    remove(path);
    remove(again);
  }
}

/* Written by hand from docs/formats/grid.md: values 0 and 1 at x = 0 and x = 1, gradient along x.
 * One block, whose center is the last of the box's eight nodes. */
static void format_is_the_documented_one(void **state)
{
  (void)state;
  unsigned char bytes[64 + 16 + 125 * 16 + 8] = "KGGRID\r\n\2\0\0\0\1";
  bytes[46] = 0xf0; /* spacing 1.0 */
  bytes[47] = 0x3f;
  bytes[48] = bytes[52] = bytes[56] = 2;
  bytes[60] = 1;
  for (int k = -1; k < 8; k++) {
    const int at = k < 0 ? -1 : k % 2 + k / 2 % 2 * 5 + k / 4 * 25;
    unsigned char *node = bytes + 80 + 16 * at;
    if (k % 2 != 0) { /* value */
      node[2] = 0x80;
      node[3] = 0x3f;
    }
    node[6] = 0x80; /* gradient (1, 0, 0) */
    node[7] = 0x3f;
  }
  uint64_t sum = 14695981039346656037u;
  for (size_t i = 0; i < sizeof bytes - 8; i++) {
    sum = (sum ^ bytes[i]) * 1099511628211u;
  }
  for (size_t i = 0; i < 8; i++) {
    bytes[sizeof bytes - 8 + i] = (unsigned char)(sum >> 8 * i);
  }
  char path[1024];
  FILE *file = fopen(path_of(path, "by_hand"), "wb");
  assert_non_null(file);
  assert_int_equal(fwrite(bytes, 1, sizeof bytes, file), sizeof bytes);
  fclose(file);
  kg_grid *grid;
  kg_error error = {0};
  if (kg_grid_load(&grid, path, NULL, NULL, &error) != KG_OK) fail_msg("%s", error.text);
  const kg_grid_value v = kg_grid_distance(grid, kg_vec3_make(0.3, 0.4, 0.9));
  assert_close(v.distance, 0.3, rounding_of(1.0));
  assert_close(v.gradient.x, 1.0, 2.0 * rounding_of(1.0));
  assert_at_most(fabs(v.gradient.y) + fabs(v.gradient.z), 1e-6);
  kg_grid_destroy(grid);
  remove(path);
}

static kg_status load_bytes(const unsigned char *bytes, size_t size, kg_error *error)
{
  char path[1024];
  FILE *file = fopen(path_of(path, "damaged"), "wb");
  assert_non_null(file);
  assert_int_equal(fwrite(bytes, 1, size, file), size);
  fclose(file);
  kg_grid *grid = (kg_grid *)path;
  *error = (kg_error){0};
  const kg_status status = kg_grid_load(&grid, path, NULL, NULL, error);
  assert_true((status == KG_OK) == (grid != NULL));
  if (status != KG_OK) assert_non_null(strstr(error->path, "damaged"));
  kg_grid_destroy(grid);
  remove(path);
  return status;
}

static void damaged_files_are_refused(void **state)
{
  (void)state;
  size_t size;
  unsigned char *bytes = file_bytes(KG_TEST_DATA "/fuzz/grid/ball", &size);
  kg_error error;
  assert_int_equal(load_bytes(bytes, size, &error), KG_OK);
  for (size_t k = 0; k < size; k++) { /* every single byte */
    bytes[k] ^= 0x40;
    const kg_status status = load_bytes(bytes, size, &error);
    assert_true(status == KG_ERR_FORMAT || (status == KG_ERR_UNSUPPORTED && k >= 8 && k < 12));
    assert_true(error.text[0] != '\0');
    bytes[k] ^= 0x40;
  }
  for (size_t cut = 0; cut < size; cut += cut < 90 ? 1 : 37) {
    assert_int_equal(load_bytes(bytes, cut, &error), KG_ERR_FORMAT);
  }
  free(bytes);
  const char *names[] = {"cut", "huge", "nan", "far", "blocks", "torn", "beyond"};
  const char *words[] = {"the file has 200 bytes",
                         "nodes, expected less",
                         "checksum",
                         "too little so far from the origin",
                         "2147483647 blocks near the surface",
                         "differs from the same one in another block",
                         "a node beyond the grid that is not zero"};
  for (int i = 0; i < (int)KG_COUNT_OF(names); i++) {
    char path[1024];
    kg_grid *grid;
    snprintf(path, sizeof path, KG_TEST_DATA "/fuzz/grid/%s", names[i]);
    assert_int_equal(kg_grid_load(&grid, path, NULL, NULL, &error), KG_ERR_FORMAT);
    if (!strstr(error.text, words[i])) fail_msg("%s: %s", names[i], error.text);
  }
  kg_grid *grid;
  assert_int_equal(kg_grid_load(&grid, KG_TEST_DATA "/there_is_no_grid", NULL, NULL, &error),
                   KG_ERR_READ);
  assert_null(grid);
}

static kg_sdf_value steep(kg_vec3 x, void *user)
{
  (void)user;
  return (kg_sdf_value){3.0 * x.x, {1.0, 0.0, 0.0}, {0.0}};
}

/* A field that is no distance would break the bounds; another surface's too. */
static void foreign_grids_are_refused(void **state)
{
  (void)state;
  const kg_vec3 lo = {-1, -1, -1}, hi = {1, 1, 1};
  char path[1024];
  kg_error error;
  double radius = 0.5, other = 0.51;
  kg_grid_def def = kg_grid_field_def(steep, NULL, lo, hi, 5);
  kg_grid *grid = make_grid(&def), *loaded;
  save_grid(grid, path_of(path, "foreign"));
  kg_grid_destroy(grid);
  assert_int_equal(kg_grid_load(&loaded, path, NULL, NULL, &error), KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "and the next differ by 3 m over 1.73205 m"));
  def = kg_grid_field_def(ball, &radius, lo, hi, 6);
  grid = make_grid(&def);
  save_grid(grid, path);
  kg_grid_destroy(grid);
  kg_grid_source source = {.field = ball, .user = &other};
  assert_int_equal(kg_grid_load(&loaded, path, &source, NULL, &error), KG_ERR_FORMAT);
  assert_non_null(strstr(error.text, "of something else"));
  source.user = &radius;
  assert_int_equal(kg_grid_load(&loaded, path, &source, NULL, &error), KG_OK);
  kg_grid_destroy(loaded);
  remove(path);
  def = kg_grid_field_def(ball, &radius, lo, hi, 3);
  grid = make_grid(&def);
  assert_int_equal(kg_grid_save(grid, KG_TEST_DATA "/no_folder/grid", &error), KG_ERR_WRITE);
  kg_grid_destroy(grid);
}

static kg_sdf_value nowhere(kg_vec3 x, void *user)
{
  (void)user;
  return (kg_sdf_value){
    fabs(x.x) < 0.1 && x.y > 0.9 && x.z > 0.9 ? NAN : x.x, {1.0, 0.0, 0.0}, {0.0}};
}

static void impossible_grids_are_refused(void **state)
{
  (void)state;
  kg_error error;
  kg_grid *grid;
  kg_grid_def def =
    kg_grid_field_def(nowhere, NULL, kg_vec3_make(-1, -1, -1), kg_vec3_make(1, 1, 1), 9);
  assert_int_equal(kg_grid_create(&grid, &def, &error), KG_ERR_UNDEFINED);
  assert_null(grid);
  def.spacing = 1e-3;
  assert_int_equal(kg_grid_create(&grid, &def, &error), KG_ERR_UNSUPPORTED);
  assert_non_null(strstr(error.text, "2001 x 2001 x 2001"));
  assert_null(grid);
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  kg_mesh *mesh = make_mesh(BOXES);
  for (int what = 0; what < 2; what++) {
    int allowed = 0;
    for (bool done = false; !done; allowed++) {
      failing_heap heap = {.calls_left = allowed};
      const kg_allocator allocator = {failing_alloc, failing_free, &heap};
      kg_grid *grid = NULL;
      kg_grid_def def = kg_grid_mesh_def(mesh, 8);
      def.allocator = &allocator;
      const kg_status status =
        what == 0 ? kg_grid_create(&grid, &def, NULL)
                  : kg_grid_load(&grid, KG_TEST_DATA "/fuzz/grid/ball", NULL, &allocator, NULL);
      done = status == KG_OK;
      assert_true(done ? grid != NULL : grid == NULL && status == KG_ERR_NO_MEMORY);
      kg_grid_destroy(grid);
      assert_int_equal(heap.live_bytes, 0);
    }
    assert_true(allowed >= (what == 0 ? 3 : 2));
  }
  kg_mesh_destroy(mesh);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(every_node_holds_the_exact_distance),
    cmocka_unit_test(box_and_spacing_are_covered),
    cmocka_unit_test(interpolant_is_the_documented_one),
    cmocka_unit_test(value_and_gradient_are_continuous),
    cmocka_unit_test(gradient_is_that_of_the_interpolant),
    cmocka_unit_test(error_falls_with_the_spacing),
    cmocka_unit_test(bounds_hold_everywhere),
    cmocka_unit_test(within_is_the_source_or_far),
    cmocka_unit_test(many_points_are_each_point),
    cmocka_unit_test(the_box_ends_at_its_faces),
    cmocka_unit_test(threads_do_not_show),
    cmocka_unit_test(saved_and_loaded_is_the_same),
    cmocka_unit_test(format_is_the_documented_one),
    cmocka_unit_test(damaged_files_are_refused),
    cmocka_unit_test(foreign_grids_are_refused),
    cmocka_unit_test(impossible_grids_are_refused),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests_name("grid", tests, NULL, NULL);
}
