/* Mesh files: the same cube in every format; damage is refused with its place; polygons, gaps and
 * triangles that cut each other are told in words. */
#include "mesh_support.h"

#include <stdio.h>

static void write_file(char path[1024], const char *name, const char *content, size_t size)
{
  snprintf(path, 1024, KG_TEST_SCRATCH "/mesh_files_%s", name);
  FILE *file = fopen(path, "wb");
  assert_non_null(file);
  assert_int_equal(fwrite(content, 1, size, file), size);
  fclose(file);
}

static kg_mesh *read_text(const char *name, const char *content, kg_mesh_report *report)
{
  char path[1024];
  kg_mesh *mesh;
  kg_error error = {0};
  write_file(path, name, content, strlen(content));
  if (kg_mesh_read(&mesh, path, 1.0, report, NULL, &error) != KG_OK) {
    fail_msg("%s: line %ld: %s", name, error.line, error.text);
  }
  remove(path);
  return mesh;
}

static void every_format_gives_the_same_cube(void **state)
{
  (void)state;
  const char *names[] = {
    "sdf/cube.obj",        "sdf/relative.obj",           "sdf/cube.off",
    "sdf/cube.ply",        "sdf/cube_text.stl",
    "sdf/cube_binary.stl", "fuzz/obj/crlf_comments.obj", "fuzz/obj/continued.obj",
    "fuzz/off/coff.off",   "fuzz/off/crlf.off",          "fuzz/ply/little.ply",
    "fuzz/ply/big.ply",    "fuzz/ply/rich_text.ply",     "fuzz/ply/crlf.ply",
    "fuzz/stl/upper.stl",  "fuzz/stl/solid_binary.stl"};
  for (size_t i = 0; i < KG_COUNT_OF(names); i++) {
    char path[1024];
    snprintf(path, sizeof path, KG_TEST_DATA "/%s", names[i]);
    kg_mesh *mesh;
    kg_mesh_report report;
    kg_error error = {0};
    if (kg_mesh_read(&mesh, path, 0.01, &report, NULL, &error) != KG_OK) {
      fail_msg("%s: line %ld: %s", names[i], error.line, error.text);
    }
    assert_int_equal(report.vertices, 8);
    assert_int_equal(report.triangles, 12);
    assert_true(report.closed);
    assert_close(report.volume, 1e-6, 1e-15);
    assert_string_equal(report.text, "");
    /* 0.01 m cube at the origin */
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(0.013, 0.014, 0.005)).distance, 0.005, 1e-14);
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(0.002, 0.005, 0.005)).distance, -0.002, 1e-14);
    kg_mesh_destroy(mesh);
  }
}

static void check_refusal(const char *path, const char *name, kg_status status, long line,
                          long column, const char *word)
{
  kg_mesh *mesh = (kg_mesh *)&status;
  kg_error error = {0};
  assert_int_equal(kg_mesh_read(&mesh, path, 1.0, NULL, NULL, &error), status);
  assert_null(mesh);
  assert_int_equal(error.status, status);
  assert_non_null(strstr(error.path, name));
  if (!strstr(error.text, word) || error.line != line || error.column != column) {
    fail_msg("%s: line %ld column %ld, expected %ld and %ld: %s, expected %s", name, error.line,
             error.column, line, column, error.text, word);
  }
}

/* No damage passes silently: each file is refused, with its name, the place and what is wrong. */
static void damaged_files_are_refused_and_named(void **state)
{
  (void)state;
  const struct {
    const char *name;
    kg_status status;
    long line, column;
    const char *word;
  } cases[] = {
    {"bad_index.obj", KG_ERR_FORMAT, 14, 9, "vertex 70, expected 1 to 8"},
    {"zero_index.obj", KG_ERR_FORMAT, 14, 9, "vertex 0, expected 1 to 8"},
    {"relative_far.obj", KG_ERR_FORMAT, 14, 12, "expected 1 to 8 back"},
    {"nan_vertex.obj", KG_ERR_FORMAT, 8, 5, "y of a vertex: expected a number"},
    {"text_vertex.obj", KG_ERR_FORMAT, 8, 5, "y of a vertex: expected a number"},
    {"no_faces.obj", KG_ERR_FORMAT, 0, 0, "no faces"},
    {"cut_short.obj", KG_ERR_FORMAT, 15, 6, "three corners"},
    {"empty.obj", KG_ERR_READ, 0, 0, "the mesh file is empty"},
    {"bad_index.off", KG_ERR_FORMAT, 16, 9, "\"60\", expected 0 to 7"},
    {"negative_index.off", KG_ERR_FORMAT, 16, 9, "\"-6\", expected 0 to 7"},
    {"cut_short.off", KG_ERR_FORMAT, 16, 1, "too early: it has 4 of 6 faces"},
    {"huge_counts.off", KG_ERR_FORMAT, 18, 1, "too early: it has 14 of 2000000000 vertices"},
    {"huge_polygon.off", KG_ERR_FORMAT, 16, 19, "2000000000 corners and has 4"},
    {"bad_index.ply", KG_ERR_FORMAT, 23, 9, "expected 0 to 7, found 60"},
    {"cut_short.ply", KG_ERR_FORMAT, 23, 1, "the file ends within face 5 of 6"},
    {"huge_counts.ply", KG_ERR_FORMAT, 25, 1, "the file ends within vertex"},
    {"huge_polygon.ply", KG_ERR_FORMAT, 25, 1, "the file ends within face 5 of 6"},
    {"long_lists.ply", KG_ERR_FORMAT, 25, 1, "the file ends within face 5 of 6"},
    {"no_header.ply", KG_ERR_FORMAT, 1, 1, "not a ply file"},
    {"cut_short_text.stl", KG_ERR_FORMAT, 44, 1, "endsolid"},
    {"cut_short_binary.stl", KG_ERR_FORMAT, 0, 0, "12 triangles at byte 80 and be 684 bytes"},
    {"there_is_no.obj", KG_ERR_READ, 0, 0, "cannot be opened: No such file"},
    {"cube.txt", KG_ERR_FORMAT, 0, 0, "none of obj"},
    {"cube", KG_ERR_FORMAT, 0, 0, "none of obj"},
  };
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    char path[1024];
    snprintf(path, sizeof path, KG_TEST_DATA "/sdf/%s", cases[i].name);
    check_refusal(path, cases[i].name, cases[i].status, cases[i].line, cases[i].column,
                  cases[i].word);
  }
  check_refusal(KG_TEST_DATA "/fuzz/stl/nan_binary.stl", "nan_binary", KG_ERR_FORMAT, 0, 0,
                "byte 100: a corner of triangle 1");
  check_refusal(KG_TEST_DATA "/fuzz/ply/cut_binary.ply", "cut_binary", KG_ERR_FORMAT, 0, 0,
                "the file ends within face 5 of 6");
  check_refusal(KG_TEST_DATA "/fuzz/off/binary.off", "binary", KG_ERR_UNSUPPORTED, 1, 0, "binary");
}

static void bad_lines_are_named(void **state)
{
  (void)state;
  const struct {
    const char *name, *content;
    long line, column;
    const char *word;
  } cases[] = {
    {"a.obj", "v 0 0 0\r\nv 1 0 0\r\nv 0 1\r\nf 1 2 3\r\n", 3, 6, "z of a vertex is missing"},
    {"b.obj", "v 0 0 0\nv 1 0 0\nv 0 1 1e19\n", 3, 7, "below 1e18, found \"1e19\""},
    {"c.obj", "v 0 0 0\nw 1 0 0\n", 2, 1, "\"w\" is no keyword"},
    {"d.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x/1\n", 4, 7, "number of a vertex, found \"x/1\""},
    {"e.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n", 4, 7, "expected 1 to 3"},
    {"f.obj", "v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 0 1 0\n", 3, 9, "1 to 2 back from here"},
    {"g.obj", "v 0 0 0x10\n", 1, 7, "found \"0x10\""},
    {"h.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n", 6, 1, "three or more, found \"2\""},
    {"i.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 2\n", 7, 1, "more lines"},
    {"j.off", "OFF\n3 -1 0\n", 2, 3, "number of faces, found \"-1\""},
    {"k.off", "4OFF\n3 1 0\n", 1, 1, "begins with \"4OFF\""},
    {"l.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n", 5, 1,
     "no faces"},
    {"m.ply",
     "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nelement face 1\n"
     "property list uchar int vertex_indices\nend_header\n",
     8, 1, "x, y and z"},
    {"m2.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float x\n", 5,
     16, "\"x\" is given twice"},
    {"m3.ply",
     "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
     "property float z\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_index\n"
     "end_header\n0 0 0 255\n1 0 0 256\n",
     12, 7, "a value of type uchar, found \"256\""},
    {"n.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty int x\n", 4, 14, "does not fit"},
    {"o.ply", "ply\nformat ascii 2.0\n", 2, 14, "version 1.0"},
    {"p.ply", "ply\nformat ascii 1.0\nelement face 3\n", 3, 9, "expected vertex, then face"},
    {"q.ply", "ply\rformat ascii 1.0\r", 3, 1, "no end"},
    {"q2.ply",
     "ply\rformat ascii 1.0\relement vertex 3\rproperty float x\rproperty float y\r"
     "property float z\relement face 1\rproperty list uchar int vertex_index\rend_header\r",
     10, 1, "line feed"},
    {"q3.ply", "ply\nformat ascii 1.0 x\n", 2, 18, "one word too many"},
    {"r.stl", "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0 nan 0\n", 5, 10,
     "found \"nan\""},
    {"s.stl", "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0 1 0\nendloop\n", 6, 1,
     "expected \"vertex\", found endloop"},
    {"t.stl", "hello\n", 0, 0, "neither"},
  };
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    char path[1024];
    write_file(path, cases[i].name, cases[i].content, strlen(cases[i].content));
    check_refusal(path, cases[i].name, KG_ERR_FORMAT, cases[i].line, cases[i].column,
                  cases[i].word);
    remove(path);
  }
}

/* ---- polygons ----------------------------------------------------------------------------------*/

/* An L of six corners, its notch first, last and between: area 3 whatever corner begins. */
static void concave_polygons_are_cut_inside(void **state)
{
  (void)state;
  const double p[6][2] = {{0, 0}, {2, 0}, {2, 1}, {1, 1}, {1, 2}, {0, 2}};
  for (int start = 0; start < 6; start++) {
    for (int turned = 0; turned < 2; turned++) {
      char text[1024] = "";
      for (int k = 0; k < 6; k++) {
        const double *q = p[turned ? (start - k + 6) % 6 : (start + k) % 6];
        snprintf(text + strlen(text), sizeof text - strlen(text), "v %g %g 3\n", q[0], q[1]);
      }
      strcat(text, "f 1 2 3 4 5 6\n");
      kg_mesh_report report;
      kg_mesh *mesh = read_text("l_shape.obj", text, &report);
      assert_int_equal(report.triangles, 4);
      assert_int_equal(report.bent + report.tangled + report.crossings, 0);
      /* above the missing quarter the nearest point is on the notch, above the rest it is below */
      assert_close(fabs(kg_mesh_distance(mesh, kg_vec3_make(1.5, 1.5, 3)).distance), 0.5, 1e-12);
      const double side = turned ? -1.0 : 1.0;
      assert_close(kg_mesh_distance(mesh, kg_vec3_make(0.6, 1.7, 4)).distance, side, 1e-12);
      assert_close(kg_mesh_distance(mesh, kg_vec3_make(1.7, 0.6, 4)).distance, side, 1e-12);
      kg_mesh_destroy(mesh);
    }
  }
}

/* A comb of many teeth, straight corners between; and a circle of so many corners that only a fan
 * is quick enough. */
static void long_polygons_are_cut(void **state)
{
  (void)state;
  static char text[1 << 17];
  size_t n = 0;
  int corners = 0;
  for (int k = 0; k < 40; k++, corners += 3) { /* teeth upwards */
    n += (size_t)snprintf(text + n, sizeof text - n, "v %d 0.5 0\nv %d 2 0\nv %g 0.5 0\n", 2 * k,
                          2 * k + 1, 2 * k + 1.5);
  }
  for (int k = 40; k >= 0; k -= 4, corners++) { /* back along the bottom */
    n += (size_t)snprintf(text + n, sizeof text - n, "v %d 0 0\n", 2 * k);
  }
  n += (size_t)snprintf(text + n, sizeof text - n, "f");
  for (int k = corners; k > 0; k--) {
    n += (size_t)snprintf(text + n, sizeof text - n, " %d", k);
  }
  kg_mesh_report report;
  kg_mesh *mesh = read_text("comb.obj", text, &report);
  assert_int_equal(report.triangles, corners - 2 - report.degenerate);
  assert_int_equal(report.tangled, 0);
  assert_int_equal(report.crossings, 0);
  assert_close(kg_mesh_distance(mesh, kg_vec3_make(1, 1.9, 1)).distance, 1.0, 1e-9);
  assert_true(kg_mesh_distance(mesh, kg_vec3_make(2, 1.9, 0)).distance > 0.4);
  kg_mesh_destroy(mesh);

  n = 0;
  for (int k = 0; k < 2000; k++) {
    n += (size_t)snprintf(text + n, sizeof text - n, "v %.9g %.9g 0\n", cos(k * acos(-1.0) / 1000),
                          sin(k * acos(-1.0) / 1000));
  }
  n += (size_t)snprintf(text + n, sizeof text - n, "f");
  for (int k = 0; k < 2000; k++) {
    n += (size_t)snprintf(text + n, sizeof text - n, " %d", k + 1);
  }
  mesh = read_text("disc.obj", text, &report);
  assert_int_equal(report.triangles, 1998);
  kg_mesh_destroy(mesh);
}

static void odd_polygons_are_told(void **state)
{
  (void)state;
  kg_mesh_report report;
  kg_mesh_destroy(
    read_text("bent.obj", "v 5 0 0\nv 6 0 0\nv 6 1 0.4\nv 5 1 0\nf 1 2 3 4\n", &report));
  assert_int_equal(report.bent, 1);
  assert_int_equal(report.tangled, 0);
  assert_non_null(strstr(report.text, "bent: 1 polygon is not flat, by up to 0."));
  assert_non_null(strstr(report.text, "the first at (5, 0, 0)"));
  kg_mesh_destroy(read_text("star.obj", /* five corners, two rounds */
                            "v 1 0 0\nv -0.8 0.6 0\nv 0.3 -1 0\nv 0.3 1 0\nv -0.8 -0.6 0\n"
                            "f 1 2 3 4 5\n",
                            &report));
  assert_int_equal(report.tangled, 1);
  assert_non_null(strstr(report.text, "tangled: 1 polygon crosses itself"));
  const char *bow_ties[] = {/* both wings alike, one larger, nearly alike; upright */
                            "v 7 0 0\nv 8 1 0\nv 8 0 0\nv 7 1 0\nf 1 2 3 4\n",
                            "v 7 0 0\nv 8 1 0\nv 8 0 0\nv 7 1.5 0\nf 1 2 3 4\n",
                            "v 7 0 0\nv 7 1 1\nv 7 0 1\nv 7 1.000001 0\nf 1 2 3 4\n"};
  for (size_t i = 0; i < KG_COUNT_OF(bow_ties); i++) {
    kg_mesh_destroy(read_text("bow_tie.obj", bow_ties[i], &report));
    assert_int_equal(report.tangled, 1);
    assert_int_equal(report.gaps, 0); /* nothing is closed but for them */
    assert_int_equal(report.borders, 1);
    assert_non_null(strstr(report.text, "crosses itself, the first at (7, 0, 0)"));
  }
}

/* A square with a square hole, as one outline that goes to the hole and back over a bridge. */
static void bridges_to_holes_are_cut(void **state)
{
  (void)state;
  kg_mesh_report report;
  const char *off = "OFF\n8 1 0\n-2 -2 0\n2 -2 0\n2 2 0\n-2 2 0\n-1 -1 0\n-1 1 0\n1 1 0\n1 -1 0\n"
                    "10 0 1 2 3 0 4 5 6 7 4\n";
  kg_mesh *mesh = read_text("bridge.off", off, &report);
  assert_int_equal(report.triangles, 8);
  assert_int_equal(report.tangled + report.crossings, 0);
  for (int i = 0; i < 100; i++) { /* the way to the frame: from inside the hole, and on the frame */
    const double x = 0.03 * (i % 10) - 0.9 + 0.17 * (i / 10), y = 0.9 - 0.18 * (i % 10);
    const double hole = 1.0 - fmax(fabs(x), fabs(y));
    assert_close(fabs(kg_mesh_distance(mesh, kg_vec3_make(x, y, 0)).distance), hole, 1e-12);
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(1.5, 2 * y, 0.2)).distance, 0.2, 1e-12);
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(-1.5, 2 * y, 0.2)).distance, 0.2, 1e-12);
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(2 * y, 1.5, 0.2)).distance, 0.2, 1e-12);
    assert_close(kg_mesh_distance(mesh, kg_vec3_make(2 * y, -1.5, 0.2)).distance, 0.2, 1e-12);
  }
  kg_mesh_destroy(mesh);
  kg_mesh_destroy(read_text("bridge.obj",
                            "v -2 -2 0\nv 2 -2 0\nv 2 2 0\nv -2 2 0\nv -1 -1 0\nv -1 1 0\nv 1 1 0\n"
                            "v 1 -1 0\nf 1 2 3 4 1 5 6 7 8 5\n",
                            &report));
  assert_non_null(strstr(report.text, "repeated: 2 corners"));
  kg_mesh_destroy(
    read_text("closed.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 1\nf 1 2 2 3\nf 1 2 1\n", &report));
  assert_null(strstr(report.text, "repeated: "));
}

/* Faces whose corners coincide, as exporters leave them, are dropped and counted in every format. */
static void collapsed_faces_are_left_out(void **state)
{
  (void)state;
  const struct {
    const char *name, *text;
  } cases[] = {
    {"collapsed.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 1 2\nf 1 2 3\nf -3 1 -2 2\nf 1 2 2 3 1\n"},
    {"collapsed.off", "OFF\n3 3 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 0 1\n3 1 2 1\n"},
    {"collapsed.ply",
     "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
     "property float z\nelement face 3\nproperty list uchar int vertex_index\n"
     "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 0 1\n3 1 2 1\n"},
    {"collapsed.stl",
     "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
     "endfacet\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0 0 0\nvertex 0 1 0\n"
     "endloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex 1 0 0\nvertex 0 1 0\n"
     "vertex 1.00000001 0 0\nendloop\nendfacet\nendsolid\n"}};
  kg_mesh_report report;
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    kg_mesh_destroy(read_text(cases[i].name, cases[i].text, &report));
    assert_int_equal(report.degenerate, 2);
    assert_non_null(strstr(report.text, i == 0 || i == 3 ? "2 faces have fewer than three different"
                                                         : "2 triangles without area"));
  }
  char bytes[84 + 100] = {0}, path[1024];
  const float corners[2][9] = {{0, 0, 0, 1, 0, 0, 0, 1, 0}, {0, 0, 0, 1, 0, 0, 1, 0, 0}};
  bytes[80] = 2;
  for (int i = 0; i < 2; i++) {
    memcpy(bytes + 84 + 50 * i + 12, corners[i], sizeof corners[i]);
  }
  write_file(path, "collapsed.stl", bytes, sizeof bytes);
  kg_mesh *mesh;
  kg_error error = {0};
  assert_int_equal(kg_mesh_read(&mesh, path, 1.0, &report, NULL, &error), KG_OK);
  assert_int_equal(report.triangles, 1);
  assert_int_equal(report.degenerate, 1);
  kg_mesh_destroy(mesh);
  remove(path);
}

/* Editors of some systems put a byte order mark in front of a text. */
static void byte_order_marks_are_skipped(void **state)
{
  (void)state;
  kg_mesh_report report;
  kg_mesh_destroy(
    read_text("mark.obj", "\xef\xbb\xbfv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", &report));
  assert_int_equal(report.triangles, 1);
  kg_mesh_destroy(
    read_text("mark.off", "\xef\xbb\xbfOFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", &report));
  assert_int_equal(report.triangles, 1);
}

/* ---- triangles that cut each other ---------------------------------------------------------------*/

static void append_box(char *text, size_t room, double lo, double hi, int first)
{
  const int quads[6][4] = {{0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4},
                           {2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6}};
  for (int k = 0; k < 8; k++) {
    snprintf(text + strlen(text), room - strlen(text), "v %.9g %.9g %.9g\n", k & 1 ? hi : lo,
             1.1 * (k & 2 ? hi : lo), 1.3 * (k & 4 ? hi : lo));
  }
  for (int k = 0; k < 6; k++) {
    const int *q = quads[k];
    snprintf(text + strlen(text), room - strlen(text), "f %d %d %d %d\n", first + q[0],
             first + q[1], first + q[2], first + q[3]);
  }
}

static void crossing_triangles_are_told(void **state)
{
  (void)state;
  static char text[1 << 14];
  const struct {
    double lo, hi; /* the second box; the first is from 0 to 1 */
    bool cross;
  } cases[] = {{0.5, 1.5, true},  {1.0, 2.0, false}, {1.01, 2.0, false},
               {0.2, 0.8, false}, {-0.5, 0.4, true}, {0.999, 1.7, true}};
  for (size_t i = 0; i < KG_COUNT_OF(cases); i++) {
    text[0] = '\0';
    append_box(text, sizeof text, 0.0, 1.0, 1);
    append_box(text, sizeof text, cases[i].lo, cases[i].hi, 9);
    kg_mesh_report report;
    kg_mesh_destroy(read_text("boxes.obj", text, &report));
    assert_true((report.crossings > 0) == cases[i].cross);
    assert_true((strstr(report.text, "self-intersection: ") != NULL) == cases[i].cross);
    assert_true(report.closed);
  }
}

/* Count against all pairs of edges and triangles, decided by solving for the point they share. */
static void crossings_are_all_found(void **state)
{
  (void)state;
  static char text[1 << 16];
  static kg_vec3 p[360];
  kg_random random = kg_random_make(31);
  size_t n = 0;
  for (int k = 0; k < 360; k++) {
    const kg_vec3 at =
      k % 3 ? kg_vec3_add(p[k - k % 3], random_vec3(&random, 0.5)) : random_vec3(&random, 0.5);
    p[k] = kg_vec3_make((float)at.x, (float)at.y, (float)at.z);
    n += (size_t)snprintf(text + n, sizeof text - n, "v %.9g %.9g %.9g\n", p[k].x, p[k].y, p[k].z);
    if (k % 3 == 2) n += (size_t)snprintf(text + n, sizeof text - n, "f -3 -2 -1\n");
  }
  int expected = 0;
  for (int i = 0; i < 360; i += 3) {
    for (int j = i + 3; j < 360; j += 3) {
      bool cut = false;
      for (int k = 0; k < 6; k++) {
        const kg_vec3 *edge = k < 3 ? &p[i] : &p[j], *t = k < 3 ? &p[j] : &p[i];
        const kg_vec3 a = edge[k % 3], d = kg_vec3_sub(edge[(k + 1) % 3], a);
        const kg_vec3 u = kg_vec3_sub(t[1], t[0]), v = kg_vec3_sub(t[2], t[0]);
        const kg_vec3 h = kg_vec3_cross(d, v), r = kg_vec3_sub(a, t[0]);
        const double det = kg_vec3_dot(u, h), s = kg_vec3_dot(r, h) / det;
        const kg_vec3 q = kg_vec3_cross(r, u);
        const double w = kg_vec3_dot(d, q) / det, at = kg_vec3_dot(v, q) / det;
        cut = cut || (s > 0 && w > 0 && s + w < 1 && at > 0 && at < 1);
      }
      expected += cut;
    }
  }
  kg_mesh_report report;
  kg_mesh_destroy(read_text("heap.obj", text, &report));
  assert_true(expected > 100);
  assert_int_equal(report.crossings, expected);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(every_format_gives_the_same_cube),
    cmocka_unit_test(damaged_files_are_refused_and_named),
    cmocka_unit_test(bad_lines_are_named),
    cmocka_unit_test(concave_polygons_are_cut_inside),
    cmocka_unit_test(long_polygons_are_cut),
    cmocka_unit_test(odd_polygons_are_told),
    cmocka_unit_test(bridges_to_holes_are_cut),
    cmocka_unit_test(collapsed_faces_are_left_out),
    cmocka_unit_test(byte_order_marks_are_skipped),
    cmocka_unit_test(crossing_triangles_are_told),
    cmocka_unit_test(crossings_are_all_found),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
