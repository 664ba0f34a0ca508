/* Meshes and height fields against the distance to all triangles and the winding number; diagnosis
 * of broken meshes. */
#include "mesh_support.h"

#include "sdf/mesh_internal.h"

#include <stdio.h>

static soup the_soup; /* large: not on the stack */

static soup *fresh_soup(void)
{
  the_soup.vertex_count = the_soup.triangle_count = 0;
  return &the_soup;
}

static kg_sdf_value mesh_phi(kg_vec3 x, const void *user)
{
  return kg_mesh_distance(user, x);
}

/* distance, sign, unit normal, closest point on the surface: at random points near and far */
static void check_against_all_triangles(const soup *s, const kg_mesh *mesh, int count, double size)
{
  kg_random random = kg_random_make(21);
  for (int i = 0; i < count; i++) {
    kg_vec3 x = random_vec3(&random, size);
    if (i % 4 == 0) { /* close to a vertex, an edge or a face */
      const int *t = s->triangles[i % s->triangle_count];
      const double u = i % 3 == 0 ? 0.0 : kg_random_uniform(&random);
      const double v = i % 12 < 8 ? 0.0 : (1.0 - u) * kg_random_uniform(&random);
      const kg_vec3 a = s->vertices[t[0]];
      const kg_vec3 p = kg_vec3_add_scaled(kg_vec3_lerp(a, s->vertices[t[1]], u), v,
                                           kg_vec3_sub(s->vertices[t[2]], a));
      x = kg_vec3_add(p, random_vec3(&random, i % 8 == 0 ? 1e-3 : 1e-6));
    }
    const double exact = brute_distance(s, x);
    const kg_sdf_value v = kg_mesh_distance(mesh, x);
    assert_close(fabs(v.distance), exact, 1e-13);
    assert_true((winding_number(s, x) > 0.5) == (v.distance < 0.0));
    assert_close(kg_vec3_norm(v.normal), 1.0, 1e-12);
    const kg_vec3 c = kg_vec3_add_scaled(x, -v.distance, v.normal);
    assert_at_most(brute_distance(s, c), 1e-9);
  }
}

static void closed_meshes_have_exact_signed_distance(void **state)
{
  (void)state;
  for (int k = 0; k < 4; k++) {
    soup *s = fresh_soup();
    if (k == 0) add_icosphere(s, 2);
    if (k == 1) add_box(s, kg_vec3_make(-0.5, -0.2, -0.3), kg_vec3_make(0.4, 0.7, 0.1));
    if (k == 2) add_spiky(s, 2, 5);
    if (k == 3) { /* two bodies and a cavity, which is a body turned inside out */
      add_box(s, kg_vec3_make(-1.5, -0.2, -0.3), kg_vec3_make(-0.6, 0.7, 0.1));
      add_box(s, kg_vec3_make(-0.5, -0.5, -0.5), kg_vec3_make(0.5, 0.5, 0.5));
      const int first = s->triangle_count;
      add_box(s, kg_vec3_make(-0.3, -0.3, -0.3), kg_vec3_make(0.3, 0.3, 0.3));
      for (int i = first; i < s->triangle_count; i++) {
        const int swap = s->triangles[i][1];
        s->triangles[i][1] = s->triangles[i][2];
        s->triangles[i][2] = swap;
      }
    }
    kg_mesh_report report;
    kg_mesh *mesh = build_mesh(s, &report);
    assert_true(report.closed && !report.inside_out);
    assert_string_equal(report.text, "");
    assert_int_equal(report.triangles, s->triangle_count);
    check_against_all_triangles(s, mesh, 4000, 0.8);
    check_against_all_triangles(s, mesh, 50, 100.0);
    kg_mesh_destroy(mesh);
  }
}

static void gradient_and_hessian_match_differences(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 1, 6);
  kg_mesh *mesh = build_mesh(s, NULL);
  kg_random random = kg_random_make(22);
  int checked = 0, curved = 0;
  for (int i = 0; i < 4000; i++) {
    const kg_vec3 x = random_vec3(&random, 0.9);
    const kg_sdf_value v = kg_mesh_distance(mesh, x);
    if (fabs(v.distance) < 0.02) continue; /* differences need room beside edges and corners */
    const bool done = check_derivatives(mesh_phi, mesh, x, 1e-4, 1e-5);
    checked += done;
    curved += done && fabs(v.hessian[0]) + fabs(v.hessian[1]) + fabs(v.hessian[2]) > 0.0;
  }
  assert_true(checked > 2000);
  assert_true(curved > 500);
  kg_mesh_destroy(mesh);
}

static void distances_have_lipschitz_constant_one(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 2, 7);
  kg_mesh *mesh = build_mesh(s, NULL);
  kg_random random = kg_random_make(23);
  for (int i = 0; i < 20000; i++) {
    const kg_vec3 a = random_vec3(&random, 0.8);
    const kg_vec3 b = kg_vec3_add(a, random_vec3(&random, i % 2 ? 0.01 : 1.0));
    const double change = kg_mesh_distance(mesh, a).distance - kg_mesh_distance(mesh, b).distance;
    assert_at_most(fabs(change), kg_vec3_norm(kg_vec3_sub(a, b)) + 1e-14);
  }
  kg_mesh_destroy(mesh);
}

static void points_on_the_surface_have_a_usable_normal(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_box(s, kg_vec3_make(0, 0, 0), kg_vec3_make(1, 1, 1));
  kg_mesh *mesh = build_mesh(s, NULL);
  /* the pseudo-normals of a cube: along the diagonals, whatever way its faces are cut */
  const kg_vec3 corner = kg_mesh_distance(mesh, kg_vec3_make(1, 1, 1)).normal;
  const kg_vec3 edge = kg_mesh_distance(mesh, kg_vec3_make(1, 1, 0.3)).normal;
  const kg_vec3 face = kg_mesh_distance(mesh, kg_vec3_make(1, 0.4, 0.3)).normal;
  assert_at_most(
    kg_vec3_norm(kg_vec3_sub(corner, kg_vec3_scale(sqrt(1.0 / 3.0), kg_vec3_make(1, 1, 1)))),
    1e-14);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(edge, kg_vec3_scale(sqrt(0.5), kg_vec3_make(1, 1, 0)))),
                 1e-14);
  assert_at_most(kg_vec3_norm(kg_vec3_sub(face, kg_vec3_make(1, 0, 0))), 1e-14);
  assert_true(kg_mesh_distance(mesh, kg_vec3_make(1, 1, 1)).distance == 0.0);
  assert_true(isnan(kg_mesh_distance(mesh, kg_vec3_make(NAN, 1, 1)).distance));
  kg_mesh_destroy(mesh);
}

/* On an edge but for the rounding of its coordinates, a point has the edge's normal, however large they
 * are; a little beside it that of the face. */
static void points_on_edges_far_away_are_on_edges(void **state)
{
  (void)state;
  const double places[] = {0.0, 1e2, 1e4, 1e6};
  kg_random random = kg_random_make(31);
  for (size_t i = 0; i < KG_COUNT_OF(places); i++) {
    soup *s = fresh_soup();
    add_spiky(s, 1, 9);
    for (int k = 0; k < s->vertex_count; k++) {
      s->vertices[k] = kg_vec3_add(s->vertices[k], kg_vec3_make(places[i], 0.7 * places[i], 1.0));
    }
    kg_mesh *mesh = build_mesh(s, NULL);
    const double size = 1.0 + kg_vec3_norm(s->vertices[0]);
    for (int k = 0; k < 3000; k++) {
      const int *t = s->triangles[k % s->triangle_count];
      const kg_vec3 a = s->vertices[t[k % 3]], b = s->vertices[t[(k + 1) % 3]];
      const kg_vec3 c = s->vertices[t[(k + 2) % 3]];
      const kg_vec3 x = kg_vec3_lerp(a, b, 0.1 + 0.8 * kg_random_uniform(&random));
      assert_int_equal(kg_mesh_closest(mesh, x).feature, KG_MESH_EDGE);
      const kg_vec3 beside = kg_vec3_lerp(x, c, 1e-14 * size);
      assert_int_equal(kg_mesh_closest(mesh, beside).feature, KG_MESH_FACE);
    }
    kg_mesh_destroy(mesh);
  }
}

/* Inside a solid, a hair from an edge that opens outwards: the normal points out there too. */
static void normals_near_a_reflex_edge_point_out(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  const double p[6][2] = {{0, 0}, {2, 0}, {2, 1}, {1, 1}, {1, 2}, {0, 2}}; /* an L */
  for (int k = 0; k < 12; k++) {
    add_vertex(s, kg_vec3_make(p[k % 6][0], p[k % 6][1], k < 6 ? 0.0 : 1.0));
  }
  for (int k = 0; k < 6; k++) {
    const int a = k, b = (k + 1) % 6;
    add_triangle(s, a, b, b + 6);
    add_triangle(s, a, b + 6, a + 6);
    if (a == 3 || b == 3) continue;
    add_triangle(s, 3, b, a);
    add_triangle(s, 9, a + 6, b + 6);
  }
  kg_mesh_report report;
  kg_mesh *mesh = build_mesh(s, &report);
  assert_true(report.closed && !report.inside_out);
  assert_close(report.volume, 3.0, 1e-12);
  const kg_vec3 out = kg_vec3_scale(sqrt(0.5), kg_vec3_make(1, 1, 0));
  for (double d = 1e-13; d < 0.1; d *= 10.0) {
    const kg_sdf_value v = kg_mesh_distance(mesh, kg_vec3_make(1.0 - d, 1.0 - d, 0.4));
    assert_close(v.distance, -sqrt(2.0) * d, 1e-15);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(v.normal, out)), 1e-2);
  }
  kg_mesh_destroy(mesh);
}

/* ---- diagnosis -----------------------------------------------------------------------------------*/

/* A box without its lid is a solid with a gap, wherever the other boxes of the mesh are. */
static void gap_in_a_solid_is_named(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_box(s, kg_vec3_make(5, 0, 0), kg_vec3_make(6, 1, 1));
  add_box(s, kg_vec3_make(0, 0, 0), kg_vec3_make(1, 1, 1));
  s->triangle_count -= 2; /* the face z = 1 is missing */
  kg_mesh_report report;
  kg_mesh *mesh = build_mesh(s, &report);
  assert_false(report.closed);
  assert_int_equal(report.boundary_edges, 4);
  assert_int_equal(report.gaps, 1);
  assert_int_equal(report.borders, 0);
  assert_non_null(strstr(report.text, "hole: 1 gap in a surface that is closed but for it"));
  assert_non_null(strstr(report.text, "longest 4 m round at (0.5, 0.5, 1)"));
  assert_null(strstr(report.text, "open:"));
  assert_close(kg_mesh_distance(mesh, kg_vec3_make(0.5, 0.5, -1)).distance, 1.0, 1e-14);
  assert_close(kg_mesh_distance(mesh, kg_vec3_make(0.5, 0.5, 0.25)).distance, -0.25, 1e-14);
  kg_mesh_destroy(mesh);
}

/* A box without its lid, of the side 1 and a height h, encloses 1 / (1 + 4 h) of its area. */
static void gaps_and_borders_part_at_a_quarter(void **state)
{
  (void)state;
  const double shares[] = {0.1, 0.24, 0.2499, 0.2501, 0.26, 0.5};
  for (size_t i = 0; i < KG_COUNT_OF(shares); i++) {
    soup *s = fresh_soup();
    add_box(s, kg_vec3_make(3, -2, 0), kg_vec3_make(4, -1, 0.25 / shares[i] - 0.25));
    s->triangle_count -= 2;
    kg_mesh_report report;
    kg_mesh_destroy(build_mesh(s, &report));
    assert_int_equal(report.gaps, shares[i] < 0.25 ? 1 : 0);
    assert_int_equal(report.borders, shares[i] < 0.25 ? 0 : 1);
  }
}

/* cells of a bumpy sheet of (n, n); those with index skip are left out */
static void add_sheet(soup *s, int n, int skip)
{
  const int first = s->vertex_count;
  for (int k = 0; k < (n + 1) * (n + 1); k++) {
    const int r = k / (n + 1), c = k % (n + 1);
    add_vertex(s, kg_vec3_make(c, 0.2 * sin(1.0 * r) * cos(0.7 * c), r));
  }
  for (int k = 0; k < n * n; k++) {
    const int a = first + (k / n) * (n + 1) + k % n, b = a + n + 1;
    if (k == skip) continue;
    add_triangle(s, a, b, b + 1);
    add_triangle(s, a, b + 1, a + 1);
  }
}

/* Terrain may be open, with a gap in it or not; its sign tells the side. */
static void open_terrain_is_a_sheet(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_sheet(s, 6, 14);
  kg_mesh_report report;
  kg_mesh *mesh = build_mesh(s, &report);
  assert_int_equal(report.boundary_edges, 4 * 6 + 4);
  assert_int_equal(report.borders, 2);
  assert_int_equal(report.gaps, 0);
  assert_non_null(strstr(report.text, "open: 28 edges belong to one triangle only, on 2 borders"));
  assert_null(strstr(report.text, "hole"));
  assert_true(kg_mesh_distance(mesh, kg_vec3_make(3.2, 2.0, 3.1)).distance > 1.5);
  assert_true(kg_mesh_distance(mesh, kg_vec3_make(3.2, -2.0, 3.1)).distance < -1.5);
  kg_mesh_destroy(mesh);
}

/* Two gaps that meet in a corner, and a face turned around beside a gap: every rim is walked. */
static void awkward_rims_are_walked(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_icosphere(s, 3);
  const int *first = s->triangles[0];
  int second = 1; /* it shares the pole, corner 0 of the first, and no edge with it */
  for (bool found = false; !found; second += !found) {
    int pole = 0, others = 0;
    for (int k = 0; k < 3; k++) {
      const int v = s->triangles[second][k];
      pole += v == first[0];
      others += v == first[1] || v == first[2];
    }
    found = pole == 1 && others == 0;
  }
  s->triangles[second][0] = s->triangles[second][1]; /* no face any more */
  s->triangles[0][0] = s->triangles[0][1];
  kg_mesh_report report;
  kg_mesh_destroy(build_mesh(s, &report));
  assert_int_equal(report.boundary_edges, 6);
  assert_in_range(report.gaps, 1, 2); /* one figure of eight, or its two halves */
  assert_int_equal(report.borders, 0);
  for (int i = 0; i < s->triangle_count; i += 7) {
    const int swap = s->triangles[i][0];
    s->triangles[i][0] = s->triangles[i][1];
    s->triangles[i][1] = swap;
  }
  kg_mesh_destroy(build_mesh(s, &report));
  assert_true(report.inconsistent_edges > 100);
  assert_true(report.gaps > 0);
}

static void inside_out_mesh_is_turned_around(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 1, 8);
  kg_mesh_report right, wrong;
  kg_mesh *outwards = build_mesh(s, &right);
  for (int i = 0; i < s->triangle_count; i++) {
    const int swap = s->triangles[i][0];
    s->triangles[i][0] = s->triangles[i][1];
    s->triangles[i][1] = swap;
  }
  kg_mesh *inwards = build_mesh(s, &wrong);
  assert_true(wrong.inside_out && !right.inside_out && wrong.closed);
  assert_non_null(strstr(wrong.text, "inside out"));
  assert_close(wrong.volume, right.volume, 1e-12);
  kg_random random = kg_random_make(24);
  for (int i = 0; i < 500; i++) {
    const kg_vec3 x = random_vec3(&random, 0.8);
    assert_close(kg_mesh_distance(inwards, x).distance, kg_mesh_distance(outwards, x).distance,
                 1e-13);
  }
  kg_mesh_destroy(outwards);
  kg_mesh_destroy(inwards);
}

static void assert_same_value(const kg_sdf_value *a, const kg_sdf_value *b)
{
  assert_memory_equal(&a->distance, &b->distance, sizeof a->distance);
  assert_memory_equal(&a->normal, &b->normal, sizeof a->normal);
  assert_memory_equal(a->hessian, b->hessian, sizeof a->hessian);
}

/* Every way to ask, whatever the hint, gives the bits of kg_mesh_distance. */
static void all_queries_give_the_same_bits(void **state)
{
  (void)state;
  enum { COUNT = 3000 };
  soup *s = fresh_soup();
  add_spiky(s, 3, 9);
  kg_mesh *mesh = build_mesh(s, NULL);
  kg_random random = kg_random_make(26);
  static kg_vec3 x[COUNT];
  static kg_sdf_value cold[COUNT], many[COUNT], warm[COUNT];
  static kg_mesh_hint hints[COUNT];
  for (int i = 0; i < COUNT; i++) {
    x[i] = i % 5 == 0 ? s->vertices[i % s->vertex_count] : random_vec3(&random, 0.7);
    cold[i] = kg_mesh_distance(mesh, x[i]);
    hints[i].triangle = (int)(kg_random_uniform(&random) * (s->triangle_count + 20)) - 10;
  }
  kg_mesh_distance_many(mesh, COUNT, x, NULL, many);
  kg_mesh_distance_many(mesh, COUNT, x, hints, warm);
  for (int i = 0; i < COUNT; i++) {
    assert_same_value(&cold[i], &many[i]);
    assert_same_value(&cold[i], &warm[i]);
    assert_true(hints[i].triangle >= 0);
    const kg_sdf_value again = kg_mesh_distance_from(mesh, x[i], &hints[i]);
    assert_same_value(&cold[i], &again);

    const kg_mesh_hit hit = kg_mesh_closest(mesh, x[i]);
    assert_true(hit.distance == cold[i].distance);
    assert_memory_equal(&hit.normal, &cold[i].normal, sizeof hit.normal);
    assert_close(kg_vec3_norm(kg_vec3_sub(x[i], hit.point)), fabs(hit.distance), 1e-14);
    const int *t = s->triangles[hit.triangle];
    const kg_vec3 a = s->vertices[t[0]], b = s->vertices[t[1]], c = s->vertices[t[2]];
    assert_close(triangle_distance(a, b, c, x[i]), fabs(hit.distance), 1e-13);
    const double to_corners =
      fmin(kg_vec3_norm(kg_vec3_sub(hit.point, a)),
           fmin(kg_vec3_norm(kg_vec3_sub(hit.point, b)), kg_vec3_norm(kg_vec3_sub(hit.point, c))));
    assert_true((hit.feature == KG_MESH_VERTEX) == (to_corners < 1e-12));
    const double to_edges =
      fmin(segment_distance(a, b, hit.point),
           fmin(segment_distance(b, c, hit.point), segment_distance(c, a, hit.point)));
    assert_true((hit.feature == KG_MESH_FACE) == (to_edges > 1e-12));
  }
  kg_mesh_destroy(mesh);
}

/* AVX-512, AVX2 and the code for any processor. */
static void instruction_sets_give_the_same_bits(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 3, 12);
  add_box(s, kg_vec3_make(-2.0, -1.0, -1.0), kg_vec3_make(-1.7, 1.0, 1.0));
  kg_mesh *mesh = build_mesh(s, NULL);
  const kg_sdf_kernels *best = mesh->kernels;
  kg_random random = kg_random_make(29);
  int levels = 0;
  for (int level = 1; level <= 3; level++) {
    const kg_sdf_kernels *other = kg_sdf_kernels_of_level(level);
    levels += other != NULL;
    for (int i = 0; i < 3000 && other; i++) {
      const kg_vec3 x = i % 5 == 0   ? s->vertices[i % s->vertex_count]
                        : i % 7 == 0 ? kg_vec3_make(-1.85, 0.1 * (i % 9), 0.1 * (i % 8))
                                     : random_vec3(&random, i % 2 ? 1.0 : 100.0);
      mesh->kernels = best;
      const kg_sdf_value expected = kg_mesh_distance(mesh, x);
      mesh->kernels = other;
      const kg_sdf_value value = kg_mesh_distance(mesh, x);
      assert_same_value(&expected, &value);
    }
  }
  assert_true(levels > 0);
  kg_mesh_destroy(mesh);
}

/* Strictly nearer than the limit, or not found; a ball touches exactly then. */
static void limits_cut_off_exactly(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 2, 10);
  kg_mesh *mesh = build_mesh(s, NULL);
  kg_random random = kg_random_make(27);
  int found = 0;
  for (int i = 0; i < 4000; i++) {
    const kg_vec3 x = random_vec3(&random, 0.8);
    const double limit = i % 50 == 0 ? 0.0 : 0.6 * kg_random_uniform(&random);
    const kg_sdf_value exact = kg_mesh_distance(mesh, x);
    const kg_sdf_value untouched = {123.0, {4.0, 5.0, 6.0}, {7.0}};
    kg_sdf_value value = untouched;
    kg_mesh_hint hint = {i % 3 == 0 ? -1 : i % s->triangle_count};
    const int before = hint.triangle;
    const bool is_within = kg_mesh_distance_within(mesh, x, limit, &hint, &value);
    assert_true(is_within == (fabs(exact.distance) < limit));
    assert_true(kg_mesh_touches_ball(mesh, x, limit) == is_within);
    assert_same_value(&value, is_within ? &exact : &untouched);
    assert_true(is_within || hint.triangle == before);
    found += is_within;
  }
  assert_in_range(found, 500, 3500);
  kg_sdf_value value;
  assert_false(kg_mesh_distance_within(mesh, s->vertices[0], -1.0, NULL, &value));
  assert_false(kg_mesh_distance_within(mesh, s->vertices[0], NAN, NULL, &value));
  kg_mesh_destroy(mesh);
}

/* Where |Phi| is rounding noise the search may find a little more than the value says. */
static void limits_hold_on_the_surface(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_spiky(s, 2, 10);
  kg_mesh *mesh = build_mesh(s, NULL);
  kg_random random = kg_random_make(28);
  for (int i = 0; i < 3000; i++) {
    const int *k = s->triangles[i % s->triangle_count];
    const double a = kg_random_uniform(&random), b = i % 3 == 0 ? 0.0 : kg_random_uniform(&random);
    const kg_vec3 x = kg_vec3_lerp(kg_vec3_lerp(s->vertices[k[0]], s->vertices[k[1]], a),
                                   s->vertices[k[2]], b);
    const kg_sdf_value exact = kg_mesh_distance(mesh, x);
    kg_sdf_value value = {123.0, {4.0, 5.0, 6.0}, {7.0}};
    assert_true(fabs(exact.distance) < 1e-15);
    assert_false(kg_mesh_distance_within(mesh, x, fabs(exact.distance), NULL, &value));
    assert_true(kg_mesh_distance_within(mesh, x, nextafter(fabs(exact.distance), 1.0), NULL, &value));
    assert_same_value(&value, &exact);
  }
  kg_mesh_destroy(mesh);
}

/* The middle plane of a slab and the centre of a cube: all sides are as near, the triangle of the
 * smallest number counts, in whatever order the hierarchy meets them. */
static void medial_axis_takes_the_smallest_triangle(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  enum { BOXES = 40 };
  for (int i = 0; i < BOXES; i++) { /* so that the sides lie in several packets */
    add_box(s, kg_vec3_make(4.0 * i, -1, -1), kg_vec3_make(4.0 * i + 2.0, 1, 1));
  }
  kg_mesh *mesh = build_mesh(s, NULL);
  for (int i = 0; i < BOXES; i++) {
    const kg_mesh_hit hit = kg_mesh_closest(mesh, kg_vec3_make(4.0 * i + 1.0, 0, 0));
    assert_true(hit.distance == -1.0);
    assert_int_equal(hit.triangle, 12 * i); /* all triangles touch their side's centre */
    for (int k = 0; k + 1 < BOXES && i == 0; k++) {
      const kg_mesh_hit between = kg_mesh_closest(mesh, kg_vec3_make(4.0 * k + 3.0, 0.5, -0.25));
      assert_true(between.distance == 1.0);
      assert_in_range(between.triangle, 12 * k + 2, 12 * k + 3); /* the side x = hi of box k */
    }
  }
  kg_mesh_destroy(mesh);
}

static void check_far_points(const soup *s, const kg_mesh *mesh)
{
  kg_vec3 lo, hi;
  kg_mesh_bounds(mesh, &lo, &hi);
  for (int i = 0; i < s->vertex_count; i++) {
    const kg_vec3 v = s->vertices[i];
    assert_true(v.x >= lo.x && v.y >= lo.y && v.z >= lo.z);
    assert_true(v.x <= hi.x && v.y <= hi.y && v.z <= hi.z);
  }
  kg_random random = kg_random_make(28);
  const double sizes[] = {1e2, 1e3, 1e4, 1e6, 1e8, 1e12, 1e17, 1e18, 1e30, 1e200};
  for (size_t k = 0; k < KG_COUNT_OF(sizes); k++) {
    for (int i = 0; i < 20; i++) {
      const kg_vec3 x = random_vec3(&random, sizes[k]);
      const kg_sdf_value v = kg_mesh_distance(mesh, x);
      const double largest = fmax(fabs(x.x), fmax(fabs(x.y), fabs(x.z)));
      const double norm = largest * kg_vec3_norm(kg_vec3_scale(1.0 / largest, x));
      assert_close(v.distance / norm, sizes[k] < 1e10 ? brute_distance(s, x) / norm : 1.0, 1e-11);
      kg_mesh_hint hint = {37 * i};
      const kg_sdf_value warm = kg_mesh_distance_from(mesh, x, &hint);
      assert_same_value(&v, &warm);
      assert_close(kg_vec3_norm(v.normal), 1.0, 1e-12);
      assert_at_most(1.0 - kg_vec3_dot(v.normal, kg_vec3_scale(1.0 / norm, x)), 1e-3);
    }
  }
}

static void far_points_have_a_value(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_icosphere(s, 3); /* smooth: with axes of their own near the leaves */
  kg_mesh *mesh = build_mesh(s, NULL);
  check_far_points(s, mesh);
  kg_mesh_destroy(mesh);
  s = fresh_soup();
  add_spiky(s, 2, 11);
  mesh = build_mesh(s, NULL);
  check_far_points(s, mesh);
  const kg_sdf_value beyond = kg_mesh_distance(mesh, kg_vec3_make(3.0, -INFINITY, 1.0));
  assert_true(isinf(beyond.distance) && beyond.distance > 0.0 && beyond.normal.y == -1.0);
  /* so far that a box's front and back are equally near, whichever triangle comes first */
  soup *box = fresh_soup();
  add_box(box, kg_vec3_make(0, 0, 0), kg_vec3_make(1, 1, 1));
  kg_mesh *far = build_mesh(box, NULL);
  for (int i = 0; i < 12; i++) { /* over both triangles of a side */
    const int k = i / 2;
    double x[3] = {i % 2 ? 0.2 : 0.7, k / 2 == 0 ? (i % 2 ? 0.2 : 0.7) : 0.4, i % 2 ? 0.7 : 0.2};
    x[k / 2] = k % 2 ? 1e17 : -1e17;
    assert_close(kg_mesh_distance(far, kg_vec3_make(x[0], x[1], x[2])).distance, 1e17, 1e-15);
  }
  kg_mesh_destroy(far);
  kg_sdf_value value = {0.0, {0.0, 0.0, 0.0}, {0.0}};
  assert_true(kg_mesh_distance_within(mesh, kg_vec3_make(0.0, NAN, INFINITY), 1.0, NULL, &value));
  assert_true(isnan(value.distance));
  assert_false(kg_mesh_distance_within(mesh, kg_vec3_make(1e19, 0.0, 0.0), 1.0, NULL, &value));
  assert_int_equal(kg_mesh_closest(mesh, kg_vec3_make(1e19, 0.0, 0.0)).triangle, -1);
  kg_mesh_destroy(mesh);
}

static void volume_is_right(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_box(s, kg_vec3_make(10, 20, 30), kg_vec3_make(10.5, 22, 33));
  kg_mesh_report report;
  kg_mesh_destroy(build_mesh(s, &report));
  assert_close(report.volume, 3.0, 1e-12);
}

static void broken_faces_are_counted_and_named(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_box(s, kg_vec3_make(0, 0, 0), kg_vec3_make(1, 1, 1));
  const int clean = s->triangle_count;
  kg_mesh_report report;

  const int *t = s->triangles[0];
  add_triangle(s, t[1], t[2], t[0]); /* repeated, another corner first */
  add_triangle(s, 3, 3, 5);          /* a corner twice */
  add_vertex(s, kg_vec3_make(0.5, 0, 0));
  kg_mesh_destroy(build_mesh(s, &report));
  assert_int_equal(report.duplicates, 1);
  assert_int_equal(report.degenerate, 1);
  assert_int_equal(report.triangles, clean);
  assert_true(report.closed);
  assert_non_null(strstr(report.text, "1 repeated"));
  assert_non_null(strstr(report.text, "1 triangle without area was removed"));

  s->triangle_count = clean;
  const int swap = s->triangles[3][0]; /* one face turned: its three edges disagree */
  s->triangles[3][0] = s->triangles[3][1];
  s->triangles[3][1] = swap;
  kg_mesh_destroy(build_mesh(s, &report));
  assert_int_equal(report.inconsistent_edges, 3);
  assert_false(report.closed);
  assert_non_null(strstr(report.text, "inconsistent: at 3 edges"));

  s = fresh_soup(); /* a fin on the edge from corner 0 to corner 1 */
  add_box(s, kg_vec3_make(0, 0, 0), kg_vec3_make(1, 1, 1));
  add_triangle(s, 0, 1, add_vertex(s, kg_vec3_make(0.5, -1, -1)));
  kg_mesh_destroy(build_mesh(s, &report));
  assert_int_equal(report.non_manifold_edges, 1);
  assert_int_equal(report.boundary_edges, 2);
  assert_non_null(strstr(report.text, "not manifold: 1 edge belongs"));
}

/* A seam of doubled vertices is no hole; a T-junction's sliver does not spoil the neighbours. */
static void vertices_at_one_place_are_one_vertex(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_box(s, kg_vec3_make(-1, -1, -1), kg_vec3_make(1, 1, 1));
  soup *apart = malloc(sizeof *apart);
  assert_non_null(apart);
  apart->vertex_count = apart->triangle_count = 0;
  for (int i = 0; i < s->triangle_count; i++) {
    int v[3];
    for (int k = 0; k < 3; k++) {
      v[k] = add_vertex(apart, s->vertices[s->triangles[i][k]]);
    }
    add_triangle(apart, v[0], v[1], v[2]);
  }
  kg_mesh_report report;
  kg_mesh *mesh = build_mesh(apart, &report);
  assert_true(report.closed);
  assert_int_equal(report.vertices, 8);
  check_against_all_triangles(s, mesh, 400, 1.0);
  kg_mesh_destroy(mesh);
  free(apart);
}

static void bad_input_is_refused(void **state)
{
  (void)state;
  const kg_vec3 good[3] = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  const kg_vec3 nan[3] = {{0, 0, 0}, {NAN, 0, 0}, {0, 1, 0}};
  const int face[3] = {0, 1, 2}, high[3] = {0, 1, 3}, low[3] = {0, -1, 2}, flat[3] = {0, 1, 1};
  const struct {
    const kg_vec3 *vertices;
    const int *triangles;
    int count;
    const char *word;
  } cases[] = {{nan, face, 1, "vertex 2"},
               {good, high, 1, "uses vertex 4"},
               {good, low, 1, "uses vertex 0"},
               {good, flat, 1, "no triangle"},
               {good, face, 0, "no triangle"}};
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    kg_mesh *mesh = (kg_mesh *)&cases;
    kg_error error = {0};
    assert_int_equal(kg_mesh_create(&mesh, cases[i].vertices, 3, cases[i].triangles, cases[i].count,
                                    NULL, NULL, &error),
                     KG_ERR_FORMAT);
    assert_null(mesh);
    assert_non_null(strstr(error.text, cases[i].word));
  }
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  add_icosphere(s, 2);
  const double heights[6] = {0, 1, 0, 2, 0, 1};
  for (int what = 0; what < 2; what++) {
    int allowed = 0;
    for (bool done = false; !done; allowed++) {
      failing_heap heap = {.calls_left = allowed};
      const kg_allocator allocator = {failing_alloc, failing_free, &heap};
      kg_mesh *mesh = NULL;
      kg_height_field *field = NULL;
      const kg_status status =
        what == 0
          ? kg_mesh_create(&mesh, s->vertices, s->vertex_count, &s->triangles[0][0],
                           s->triangle_count, NULL, &allocator, NULL)
          : kg_height_field_create(&field, heights, 2, 3, 1.0, kg_vec3_make(0, 0, 0), &allocator);
      done = status == KG_OK;
      assert_true(done ? mesh != NULL || field != NULL : mesh == NULL && field == NULL);
      assert_true(done || status == KG_ERR_NO_MEMORY);
      kg_mesh_destroy(mesh);
      kg_height_field_destroy(field);
      assert_int_equal(heap.live_bytes, 0);
    }
    assert_true(allowed > 3);
  }
}

/* All centroids alike, long rows, and random slivers: the tree must still hold every triangle. */
static void awkward_triangles_are_all_found(void **state)
{
  (void)state;
  soup *s = fresh_soup();
  kg_random random = kg_random_make(25);
  for (int i = 0; i < 300; i++) { /* same centroid: a, b, -a-b */
    const kg_vec3 a = random_vec3(&random, 1.0), b = random_vec3(&random, i % 2 ? 1.0 : 1e-4);
    const int first = add_vertex(s, a);
    add_vertex(s, b);
    add_vertex(s, kg_vec3_scale(-1.0, kg_vec3_add(a, b)));
    add_triangle(s, first, first + 1, first + 2);
  }
  for (int i = 0; i < 300; i++) { /* sizes over nine decades */
    const double size = pow(10.0, -6.0 + 9.0 * kg_random_uniform(&random));
    const int first = add_vertex(s, random_vec3(&random, size));
    add_vertex(s, random_vec3(&random, size));
    add_vertex(s, random_vec3(&random, size));
    add_triangle(s, first, first + 1, first + 2);
  }
  kg_mesh *mesh = build_mesh(s, NULL);
  for (int i = 0; i < 2000; i++) {
    const kg_vec3 x = random_vec3(&random, pow(10.0, -3.0 + 5.0 * kg_random_uniform(&random)));
    const double exact = brute_distance(s, x);
    assert_at_most(fabs(fabs(kg_mesh_distance(mesh, x).distance) - exact), 1e-12 * (1.0 + exact));
  }
  kg_mesh_destroy(mesh);
}

/* ---- height fields -------------------------------------------------------------------------------*/

enum { ROWS = 7, COLUMNS = 9 };

static void height_field_is_the_distance_to_its_cells(void **state)
{
  (void)state;
  double heights[ROWS * COLUMNS];
  kg_random random = kg_random_make(26);
  for (int i = 0; i < ROWS * COLUMNS; i++) {
    heights[i] = 0.3 * kg_random_normal(&random);
  }
  const kg_vec3 origin = {-1.0, 0.5, 2.0};
  const double spacing = 0.25;
  kg_height_field *field;
  assert_int_equal(kg_height_field_create(&field, heights, ROWS, COLUMNS, spacing, origin, NULL),
                   KG_OK);
  soup *s = fresh_soup(); /* the cells, and six cells more on each side at the border's heights */
  const int more = 6;
  for (int r = -more; r < ROWS - 1 + more; r++) {
    for (int c = -more; c < COLUMNS - 1 + more; c++) {
      int v[4];
      for (int k = 0; k < 4; k++) {
        const int row = r + k / 2, column = c + k % 2;
        const int at_row = row < 0 ? 0 : row >= ROWS ? ROWS - 1 : row;
        const int at_column = column < 0 ? 0 : column >= COLUMNS ? COLUMNS - 1 : column;
        v[k] = add_vertex(s, kg_vec3_make(origin.x + spacing * column,
                                          origin.y + heights[at_row * COLUMNS + at_column],
                                          origin.z + spacing * row));
      }
      add_triangle(s, v[0], v[2], v[3]);
      add_triangle(s, v[0], v[3], v[1]);
    }
  }
  for (int i = 0; i < 3000; i++) {
    const kg_vec3 x = kg_vec3_make(-1.0 - 0.8 + 3.6 * kg_random_uniform(&random),
                                   0.5 + 0.4 * kg_random_normal(&random),
                                   2.0 - 0.8 + 3.1 * kg_random_uniform(&random));
    const kg_sdf_value v = kg_height_field_distance(field, x);
    const double exact = brute_distance(s, x);
    assert_at_most(exact, 1.5); /* else the cells above would not reach far enough */
    assert_close(fabs(v.distance), exact, 1e-12);
    assert_true(v.normal.y > -1e-12 || v.distance != 0.0);
    /* above or below: cast a ray straight down through all cells */
    bool below = false;
    for (int k = 0; k < s->triangle_count; k++) {
      const kg_vec3 a = s->vertices[s->triangles[k][0]], b = s->vertices[s->triangles[k][1]];
      const kg_vec3 c = s->vertices[s->triangles[k][2]];
      const double det = (b.x - a.x) * (c.z - a.z) - (c.x - a.x) * (b.z - a.z);
      const double p = ((x.x - a.x) * (c.z - a.z) - (c.x - a.x) * (x.z - a.z)) / det;
      const double q = ((b.x - a.x) * (x.z - a.z) - (x.x - a.x) * (b.z - a.z)) / det;
      if (p >= 0.0 && q >= 0.0 && p + q <= 1.0) {
        below = x.y < a.y + p * (b.y - a.y) + q * (c.y - a.y);
      }
    }
    assert_true(below == (v.distance < 0.0));
  }
  /* far outside, the nearest border height counts */
  const double corner = heights[ROWS * COLUMNS - 1] + origin.y;
  const kg_vec3 far[] = {{50.0, corner + 0.7, 60.0}, {1e5, corner + 0.7, 1e6}};
  for (size_t i = 0; i < KG_COUNT_OF(far); i++) {
    const kg_sdf_value v = kg_height_field_distance(field, far[i]);
    assert_close(v.distance, 0.7, 1e-12);
    assert_close(v.normal.y, 1.0, 1e-12);
  }
  kg_height_field_destroy(field);
  heights[5] = NAN;
  assert_int_equal(kg_height_field_create(&field, heights, ROWS, COLUMNS, spacing, origin, NULL),
                   KG_ERR_FORMAT);
  assert_null(field);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(closed_meshes_have_exact_signed_distance),
    cmocka_unit_test(gradient_and_hessian_match_differences),
    cmocka_unit_test(distances_have_lipschitz_constant_one),
    cmocka_unit_test(points_on_the_surface_have_a_usable_normal),
    cmocka_unit_test(points_on_edges_far_away_are_on_edges),
    cmocka_unit_test(normals_near_a_reflex_edge_point_out),
    cmocka_unit_test(gap_in_a_solid_is_named),
    cmocka_unit_test(gaps_and_borders_part_at_a_quarter),
    cmocka_unit_test(open_terrain_is_a_sheet),
    cmocka_unit_test(awkward_rims_are_walked),
    cmocka_unit_test(inside_out_mesh_is_turned_around),
    cmocka_unit_test(all_queries_give_the_same_bits),
    cmocka_unit_test(instruction_sets_give_the_same_bits),
    cmocka_unit_test(limits_cut_off_exactly),
    cmocka_unit_test(limits_hold_on_the_surface),
    cmocka_unit_test(medial_axis_takes_the_smallest_triangle),
    cmocka_unit_test(far_points_have_a_value),
    cmocka_unit_test(volume_is_right),
    cmocka_unit_test(broken_faces_are_counted_and_named),
    cmocka_unit_test(vertices_at_one_place_are_one_vertex),
    cmocka_unit_test(bad_input_is_refused),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
    cmocka_unit_test(awkward_triangles_are_all_found),
    cmocka_unit_test(height_field_is_the_distance_to_its_cells),
  };
  return cmocka_run_group_tests_name("mesh", tests, NULL, NULL);
}
