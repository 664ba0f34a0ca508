/* Scene files: JSON through jansson, which checks the syntax but keeps no positions of values. So every
 * value is read beside its place in the text, found by a second, plain walk. */
#include "cli/scene_file.h"

#include <jansson.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "cli/messages.h"
#include "cli/options.h"
#include "kinegrad/mesh.h"

static const double DEFAULT_STIFFNESS = 2e4; /* N/m a point */
static const double DEFAULT_DAMPING = 0.5;   /* s/m         */
static const double MAT_CORE_M = 0.3;        /* m; of the rigid core under a mat */
static const double LARGEST_M = 1e4, LARGEST_RATE = 1e3, LARGEST_STIFFNESS = 1e9;
enum { LARGEST_FILE = 1 << 22 };
/* of a scene beside the floor, which is a shape and may be soft */
enum { MOST_SHAPES = KG_SCENE_MAX_SHAPES - 1, MOST_GROUNDS = KG_SCENE_MAX_GROUNDS - 1 };
enum { MOST_NESTED = 8 }; /* combinations in combinations */

/* A value and where it stands in the text. */
typedef struct node {
  json_t *json;
  const char *text;
} node;

typedef struct file {
  const char *path;
  char *text;
  json_t *root;
  cli_scene *scene;
  double unit_m;
  bool is_quiet;
  int code; /* of the first failure */
} file;

/* ---- places in the text; the syntax is known to be right -------------------------------------- */

static const char *skip_space(const char *c)
{
  return c + strspn(c, " \t\r\n");
}

static const char *skip_string(const char *c)
{
  for (c++; *c != '"'; c++) {
    c += *c == '\\';
  }
  return c + 1;
}

/* behind the value at c */
static const char *skip_value(const char *c)
{
  if (*c == '"') return skip_string(c);
  if (*c != '{' && *c != '[') return c + strcspn(c, " \t\r\n,]}");
  int depth = 0;
  do {
    if (*c == '"') {
      c = skip_string(c);
      continue;
    }
    depth += (*c == '{' || *c == '[') - (*c == '}' || *c == ']');
    c++;
  } while (depth > 0);
  return c;
}

/* the next item behind one, or NULL */
static const char *next_item(const char *behind)
{
  const char *c = skip_space(behind);
  return *c == ',' ? skip_space(c + 1) : NULL;
}

/* the last member of that name (duplicates are refused before), its key or its value */
static const char *find_member(const char *object, const char *key, bool value)
{
  const size_t length = strlen(key);
  const char *c = skip_space(object + 1);
  for (c = *c == '}' ? NULL : c; c;) {
    const char *behind = skip_string(c), *colon = skip_space(behind);
    const char *at = skip_space(colon + 1);
    const bool same = (size_t)(behind - c) == length + 2 && strncmp(c + 1, key, length) == 0;
    if (same) return value ? at : c;
    c = next_item(skip_value(at));
  }
  return object;
}

static const char *find_item(const char *array, size_t index)
{
  const char *c = skip_space(array + 1);
  for (; index > 0 && c; index--) {
    c = next_item(skip_value(c));
  }
  return c ? c : array;
}

static node member(node object, const char *key)
{
  return (node){json_object_get(object.json, key), find_member(object.text, key, true)};
}

static node item(node array, size_t index)
{
  return (node){json_array_get(array.json, index), find_item(array.text, index)};
}

/* ---- values ------------------------------------------------------------------------------------ */

/* at: in the text; NULL: the file as a whole */
static bool fail(file *f, const char *at, const char *what)
{
  if (f->code != CLI_GOOD) return false;
  long line = at ? 1 : 0, column = line;
  for (const char *c = f->text; at && c < at; c++) {
    line += *c == '\n';
    column = *c == '\n' ? 1 : column + 1;
  }
  kg_error error = {0};
  (void)kg_fail(&error, KG_ERR_FORMAT, f->path, line, column, "%s", what);
  f->code = cli_failed(&error);
  return false;
}

/* Of all files of a run together. */
static bool fail_limit(file *f, const char *at, int most, const char *what)
{
  char text[128];
  snprintf(text, sizeof text, "the scene has more than %d %s", most, what);
  return fail(f, at, text);
}

static bool add_shape(file *f, const char *at, const kg_sdf_shape *shape)
{
  kg_scene *scene = &f->scene->scene;
  return (scene->shape_count < MOST_SHAPES && kg_scene_add(scene, shape)) ||
         fail_limit(f, at, MOST_SHAPES, "shapes beside the floor");
}

/* key: of a member of `of`, for the message and the place */
static bool fail_at(file *f, node of, const char *key, const char *expected)
{
  char text[256];
  const bool is_there = json_object_get(of.json, key) != NULL;
  snprintf(text, sizeof text, is_there ? "\"%s\": expected %s" : "\"%s\" is missing: expected %s",
           key, expected);
  return fail(f, is_there ? find_member(of.text, key, true) : of.text, text);
}

static bool is_number_within(const json_t *json, double low, double high)
{
  return json_is_number(json) && json_number_value(json) >= low && json_number_value(json) <= high;
}

/* *out stays where the member is missing, unless it is needed */
static bool read_number(file *f, node of, const char *key, bool needed, double low, double high,
                        double *out)
{
  const json_t *json = json_object_get(of.json, key);
  if (!json && !needed) return true;
  if (!is_number_within(json, low, high)) {
    char text[96];
    snprintf(text, sizeof text, "a number from %g to %g", low, high);
    return fail_at(f, of, key, text);
  }
  *out = json_number_value(json);
  return true;
}

static bool read_vector(file *f, node of, const char *key, bool needed, double low, double high,
                        kg_vec3 *out)
{
  const json_t *json = json_object_get(of.json, key);
  if (!json && !needed) return true;
  bool good = json_is_array(json) && json_array_size(json) == 3;
  double v[3] = {0.0, 0.0, 0.0};
  for (size_t k = 0; k < 3 && good; k++) {
    good = is_number_within(json_array_get(json, k), low, high);
    v[k] = json_number_value(json_array_get(json, k));
  }
  if (!good) {
    char text[96];
    snprintf(text, sizeof text, "[x, y, z], each from %g to %g", low, high);
    return fail_at(f, of, key, text);
  }
  *out = kg_vec3_make(v[0], v[1], v[2]);
  return true;
}

/* Text of the file for a message of one line. */
static void copy_printable(char *out, size_t room, const char *text)
{
  size_t n = 0;
  for (; n + 1 < room && text[n]; n++) {
    out[n] = (char)(text[n] >= ' ' && text[n] <= '~' ? text[n] : '?');
  }
  out[n] = '\0';
}

/* Every member is one of names[count]. */
static bool check_members(file *f, node of, const char *const *names, int count)
{
  const char *key;
  json_t *value;
  json_object_foreach(of.json, key, value)
  {
    bool known = false;
    for (int k = 0; k < count; k++) {
      known = known || strcmp(key, names[k]) == 0;
    }
    if (known) continue;
    const char *nearest = cli_nearest(key, names, count);
    char text[256], name[64];
    copy_printable(name, sizeof name, key);
    snprintf(text, sizeof text, "unknown member \"%s\"%s%s%s", name,
             nearest ? "; did you mean \"" : "", nearest ? nearest : "", nearest ? "\"?" : "");
    return fail(f, find_member(of.text, key, false), text);
  }
  return true;
}

/* ---- shapes ------------------------------------------------------------------------------------ */

enum { MOST_OWN_MEMBERS = 4 };

typedef struct type {
  const char *name;
  kg_shape_kind kind;
  const char *members[MOST_OWN_MEMBERS]; /* beside those of every shape */
} type;

static const type types[] = {
  {"box", KG_SHAPE_BOX, {"center_m", "size_m", "rotation_deg"}},
  {"mat", KG_SHAPE_BOX, {"center_m", "size_m", "rotation_deg"}},
  {"sphere", KG_SHAPE_SPHERE, {"center_m", "radius_m"}},
  {"ellipsoid", KG_SHAPE_ELLIPSOID, {"center_m", "semi_axes_m", "rotation_deg"}},
  {"capsule", KG_SHAPE_CAPSULE, {"from_m", "to_m", "radius_m"}},
  {"cylinder", KG_SHAPE_CYLINDER, {"from_m", "to_m", "radius_m"}},
  {"plane", KG_SHAPE_PLANE, {"point_m", "normal"}},
  {"mesh", KG_SHAPE_MESH, {"file", "unit_m", "at_m", "rotation_deg"}},
  {"union", KG_SHAPE_UNION, {"of", "at_m", "rotation_deg"}},
  {"intersection", KG_SHAPE_INTERSECTION, {"of", "at_m", "rotation_deg"}},
  {"difference", KG_SHAPE_DIFFERENCE, {"of", "at_m", "rotation_deg"}},
  {"smooth_union", KG_SHAPE_SMOOTH_UNION, {"of", "radius_m", "at_m", "rotation_deg"}},
};
enum { TYPES = KG_COUNT_OF(types) };

static bool is_combination(const kg_sdf_shape *shape)
{
  return shape->kind >= KG_SHAPE_UNION;
}

static const type *read_type(file *f, node of)
{
  const char *name = json_string_value(json_object_get(of.json, "type")), *names[TYPES];
  for (int k = 0; k < TYPES; k++) {
    names[k] = types[k].name;
    if (name && strcmp(name, types[k].name) == 0) return &types[k];
  }
  const char *nearest = name ? cli_nearest(name, names, TYPES) : NULL;
  char text[160] = "box, mat, sphere, ellipsoid, capsule, cylinder, plane, mesh, union, "
                   "intersection, difference or smooth_union";
  if (nearest) {
    snprintf(text, sizeof text, "a type of shape; did you mean \"%s\"?", nearest);
  }
  (void)fail_at(f, of, "type", text);
  return NULL;
}

static bool read_soft(file *f, node of, kg_ground *ground)
{
  static const char *const names[] = {"thickness_m", "stiffness_N_per_m", "damping_s_per_m",
                                      "friction"};
  *ground = kg_ground_default();
  ground->stiffness = DEFAULT_STIFFNESS;
  ground->damping = DEFAULT_DAMPING;
  if (!json_is_object(of.json)) return fail(f, of.text, "expected an object with \"thickness_m\"");
  return check_members(f, of, names, KG_COUNT_OF(names)) &&
         read_number(f, of, "thickness_m", true, 0.0, 2.0, &ground->thickness) &&
         read_number(f, of, "stiffness_N_per_m", false, 0.0, LARGEST_STIFFNESS,
                     &ground->stiffness) &&
         read_number(f, of, "damping_s_per_m", false, 0.0, LARGEST_RATE, &ground->damping) &&
         read_number(f, of, "friction", false, 0.0, 10.0, &ground->friction);
}

static bool read_rotation(file *f, node of, kg_quat *out)
{
  kg_vec3 degrees = {0.0, 0.0, 0.0};
  if (!read_vector(f, of, "rotation_deg", false, -360.0, 360.0, &degrees)) return false;
  *out = kg_quat_exp(kg_vec3_scale(3.14159265358979323846 / 180.0, degrees));
  return true;
}

/* A mesh by the path as it is opened. */
static bool load_mesh(file *f, const char *path, double unit, kg_sdf_shape *shape)
{
  cli_scene *s = f->scene;
  kg_mesh_report report = {0};
  kg_error error = {0};
  KG_ASSERT(s->mesh_count < CLI_MAX_MESHES);
  char *copy = strdup(path);
  const kg_status status =
    copy ? kg_mesh_read(&s->meshes[s->mesh_count], path, unit, &report, NULL, &error)
         : kg_fail(&error, KG_ERR_NO_MEMORY, path, 0, 0, "no memory for the mesh");
  if (status != KG_OK) {
    free(copy);
    f->code = cli_failed(&error);
    return false;
  }
  for (const char *line = report.text; *line;) {
    const int length = (int)strcspn(line, "\n");
    cli_warning(f->is_quiet, "%s: %.*s", path, length, line);
    line += length + (line[length] == '\n');
  }
  s->mesh_paths[s->mesh_count] = copy;
  shape->mesh = s->meshes[s->mesh_count++];
  return true;
}

static bool read_mesh(file *f, node of, kg_sdf_shape *shape)
{
  const char *name = json_string_value(json_object_get(of.json, "file"));
  if (!name || !*name) return fail_at(f, of, "file", "the name of a mesh file");
  double unit = f->unit_m;
  if (!read_number(f, of, "unit_m", false, 1e-6, 1000.0, &unit)) return false;
  char path[2048];
  const char *slash = strrchr(f->path, '/');
  const int folder = slash && *name != '/' ? (int)(slash - f->path) + 1 : 0;
  if (snprintf(path, sizeof path, "%.*s%s", folder, f->path, name) >= (int)sizeof path) {
    return fail_at(f, of, "file", "a shorter name");
  }
  return load_mesh(f, path, unit, shape);
}

/* A shape around its own middle, which is `at`; `turn` is for what has no orientation of its own. */
static bool read_geometry(file *f, node of, kg_sdf_shape *s, kg_vec3 *at, kg_quat *turn)
{
  const double far = LARGEST_M, tiny = 1e-6;
  kg_vec3 a = {0.0, 0.0, 0.0}, b = a;
  *at = a;
  *turn = kg_quat_identity();
  switch (s->kind) {
    case KG_SHAPE_BOX:
      if (!read_vector(f, of, "size_m", true, tiny, far, &b)) return false;
      s->b = kg_vec3_scale(0.5, b);
      return read_vector(f, of, "center_m", true, -far, far, at) &&
             read_rotation(f, of, &s->orientation);
    case KG_SHAPE_ELLIPSOID:
      return read_vector(f, of, "semi_axes_m", true, tiny, far, &s->b) &&
             read_vector(f, of, "center_m", true, -far, far, at) &&
             read_rotation(f, of, &s->orientation);
    case KG_SHAPE_SPHERE:
      return read_number(f, of, "radius_m", true, tiny, far, &s->radius) &&
             read_vector(f, of, "center_m", true, -far, far, at);
    case KG_SHAPE_PLANE:
      if (!read_vector(f, of, "point_m", true, -far, far, at) ||
          !read_vector(f, of, "normal", true, -far, far, &b)) {
        return false;
      }
      if (!(kg_vec3_norm(b) > 0.0)) return fail_at(f, of, "normal", "a direction");
      s->b = kg_vec3_normalized(b);
      return true;
    case KG_SHAPE_MESH:
      return read_vector(f, of, "at_m", false, -far, far, at) && read_rotation(f, of, turn) &&
             read_mesh(f, of, s);
    case KG_SHAPE_SMOOTH_UNION:
      if (!read_number(f, of, "radius_m", true, tiny, far, &s->radius)) return false;
      /* fall through */
    case KG_SHAPE_UNION:
    case KG_SHAPE_INTERSECTION:
    case KG_SHAPE_DIFFERENCE:
      return read_vector(f, of, "at_m", false, -far, far, at) && read_rotation(f, of, turn);
    default: /* capsule, cylinder */
      if (!read_vector(f, of, "from_m", true, -far, far, &a) ||
          !read_vector(f, of, "to_m", true, -far, far, &b) ||
          !read_number(f, of, "radius_m", true, tiny, far, &s->radius)) {
        return false;
      }
      if (s->kind == KG_SHAPE_CYLINDER && !(kg_vec3_norm(kg_vec3_sub(b, a)) > tiny)) {
        return fail_at(f, of, "to_m", "another point than \"from_m\"");
      }
      *at = kg_vec3_lerp(a, b, 0.5);
      s->a = kg_vec3_sub(a, *at);
      s->b = kg_vec3_sub(b, *at);
      return true;
  }
}

/* What is drawn is the outside of the soft layer, h thick: the core is that much smaller. False when
 * nothing is left of it. */
static bool take_off(kg_sdf_shape *s, double h, bool is_mat)
{
  const kg_vec3 inward = kg_vec3_make(h, h, h);
  if (is_mat) { /* soft on top and at the sides; rigid below, as far as it may take */
    const double top = s->b.y - h, half = 0.5 * MAT_CORE_M + fmax(s->b.y - 0.5 * h, 0.0);
    const kg_vec3 down = kg_vec3_make(0.0, top - half, 0.0);
    s->a = kg_vec3_add(s->a, kg_quat_rotate(s->orientation, down));
    s->b = kg_vec3_make(s->b.x - h, half, s->b.z - h);
    return s->b.x > 0.0 && s->b.z > 0.0;
  }
  switch (s->kind) {
    case KG_SHAPE_BOX:
      s->b = kg_vec3_sub(s->b, inward);
      return s->b.x > 0.0 && s->b.y > 0.0 && s->b.z > 0.0;
    case KG_SHAPE_SPHERE:
    case KG_SHAPE_CAPSULE:
      s->radius -= h;
      return s->radius > 0.0;
    case KG_SHAPE_CYLINDER: {
      const double half = kg_vec3_norm(s->b), share = 1.0 - h / half; /* around the middle */
      s->a = kg_vec3_scale(share, s->a);
      s->b = kg_vec3_scale(share, s->b);
      s->radius -= h;
      return s->radius > 0.0 && share > 0.0;
    }
    case KG_SHAPE_ELLIPSOID:
      s->offset = -h;
      return h < fmin(fmin(s->b.x, s->b.y), s->b.z);
    default:
      s->offset = -h;
      return true;
  }
}

static bool read_cover(file *f, node of, kg_sdf_shape *s, bool is_mat)
{
  const node soft = member(of, "soft");
  if (!soft.json) return !is_mat || fail_at(f, of, "soft", "what the mat is made of");
  kg_ground ground;
  if (!read_soft(f, soft, &ground)) return false;
  if (is_mat && !(ground.thickness <= 2.0 * s->b.y)) {
    return fail_at(f, soft, "thickness_m", "no more than the height of the mat, size_m[1]");
  }
  if (!take_off(s, ground.thickness, is_mat)) {
    return fail_at(f, soft, "thickness_m",
                   is_mat ? "less than half of the mat's length and breadth"
                          : "a layer that leaves a rigid core; a soft slab is a \"mat\"");
  }
  if (f->scene->scene.ground_count >= MOST_GROUNDS) {
    return fail_limit(f, soft.text, MOST_GROUNDS, "shapes with \"soft\" beside the floor");
  }
  s->ground = kg_scene_add_ground(&f->scene->scene, &ground);
  return true;
}

/* Puts the shape where it is: into a place when it moves, or must be turned as a whole. Parts of a
 * combination move with it alone. */
static bool put(file *f, node of, kg_sdf_shape *s, kg_vec3 at, kg_quat turn)
{
  kg_scene *scene = &f->scene->scene;
  kg_place place = {.at = at, .turn = turn};
  if (!read_vector(f, of, "velocity_m_per_s", false, -LARGEST_RATE, LARGEST_RATE,
                   &place.velocity) ||
      !read_vector(f, of, "spin_rad_per_s", false, -LARGEST_RATE, LARGEST_RATE, &place.spin)) {
    return false;
  }
  if (kg_place_is_moving(&place) || s->kind == KG_SHAPE_MESH || is_combination(s)) {
    s->place = kg_scene_add_place(scene, &place);
    if (s->place == 0) {
      return fail_limit(f, of.text, KG_SCENE_MAX_PLACES,
                        "shapes that move, are meshes or combinations");
    }
  } else {
    s->a = kg_vec3_add(s->a, at);
    if (s->kind == KG_SHAPE_CAPSULE || s->kind == KG_SHAPE_CYLINDER) s->b = kg_vec3_add(s->b, at);
  }
  return add_shape(f, of.text, s);
}

static bool read_shape(file *f, node of, int depth);

/* Adds the parts; two at a time are joined until *s has two children. */
static bool read_parts(file *f, node of, int depth, kg_sdf_shape *s)
{
  const node parts = member(of, "of");
  const size_t count = json_array_size(parts.json);
  if (count < 2) return fail_at(f, of, "of", "an array of two shapes or more");
  if (depth == MOST_NESTED) return fail_at(f, of, "of", "combinations no more than 8 deep");
  for (size_t i = 0; i < count; i++) {
    if (!read_shape(f, item(parts, i), depth + 1)) return false;
    s->children[i > 0] = f->scene->scene.shape_count - 1;
    if (i == 0 || i + 1 == count) continue;
    if (!add_shape(f, of.text, s)) return false;
    s->children[0] = f->scene->scene.shape_count - 1;
  }
  return true;
}

/* depth: 0, or in how many combinations the shape is a part. Then it has no motion and no cover of its
 * own, and a combination has no cover: how thick it is where is not known. */
static bool read_shape(file *f, node of, int depth)
{
  if (!json_is_object(of.json)) return fail(f, of.text, "expected an object with a \"type\"");
  const type *kind = read_type(f, of);
  if (!kind) return false;
  const bool is_mat = strcmp(kind->name, "mat") == 0;
  if (is_mat && depth > 0) return fail_at(f, of, "type", "a rigid shape: parts are not soft");
  kg_sdf_shape shape = {.kind = kind->kind};
  const char *names[4 + MOST_OWN_MEMBERS] = {"type", "velocity_m_per_s", "spin_rad_per_s", "soft"};
  int count = depth > 0 ? 1 : is_combination(&shape) ? 3 : 4;
  for (int k = 0; k < MOST_OWN_MEMBERS && kind->members[k]; k++) {
    names[count++] = kind->members[k];
  }
  kg_vec3 at;
  kg_quat turn;
  return check_members(f, of, names, count) && read_geometry(f, of, &shape, &at, &turn) &&
         (!is_combination(&shape) || read_parts(f, of, depth, &shape)) &&
         read_cover(f, of, &shape, is_mat) && put(f, of, &shape, at, turn);
}

static bool fail_floor(file *f, const char *at)
{
  char text[256];
  snprintf(text, sizeof text,
           "\"floor\" stands in %.120s too: expected it in one of the scene files",
           f->scene->floor_file);
  return fail(f, at, text);
}

static bool read_root(file *f)
{
  static const char *const names[] = {"floor", "shapes"}, *const covers[] = {"soft"};
  const node root = {f->root, skip_space(f->text)};
  if (!json_is_object(root.json)) {
    return fail(f, root.text, "expected an object with \"floor\" or \"shapes\"");
  }
  if (!check_members(f, root, names, KG_COUNT_OF(names))) return false;
  const node floor = member(root, "floor"), shapes = member(root, "shapes");
  if (floor.json) {
    if (!json_is_object(floor.json) || !check_members(f, floor, covers, 1)) {
      return fail_at(f, root, "floor", "an object with \"soft\"");
    }
    const node soft = member(floor, "soft");
    if (!soft.json) return fail_at(f, floor, "soft", "what covers the floor");
    if (f->scene->floor_file) return fail_floor(f, floor.text);
    f->scene->floor_file = f->path;
    if (!read_soft(f, soft, &f->scene->floor)) return false;
  }
  if (shapes.json && !json_is_array(shapes.json)) return fail_at(f, root, "shapes", "an array");
  for (size_t i = 0; i < json_array_size(shapes.json); i++) {
    if (!read_shape(f, item(shapes, i), 0)) return false;
  }
  return true;
}

/* ---- files ------------------------------------------------------------------------------------- */

/* NULL after a message in f->code */
static char *read_text(file *f)
{
  kg_error error = {0};
  FILE *stream = fopen(f->path, "rb");
  char *text = stream ? malloc(LARGEST_FILE + 1) : NULL;
  const size_t length = text ? fread(text, 1, LARGEST_FILE + 1, stream) : 0;
  const bool failed = !text || ferror(stream) || length > LARGEST_FILE;
  if (stream) fclose(stream);
  if (failed) {
    (void)kg_fail(&error, KG_ERR_READ, f->path, 0, 0,
                  !stream                 ? "cannot be opened"
                  : length > LARGEST_FILE ? "is larger than 4 MB, too large for a scene file"
                                          : "cannot be read");
    f->code = cli_failed(&error);
    free(text);
    return NULL;
  }
  for (size_t k = 0; k < length; k++) { /* the parser would take the first for the end */
    text[k] = (char)(text[k] == '\0' ? '\x01' : text[k]);
  }
  const size_t mark = length >= 3 && memcmp(text, "\xef\xbb\xbf", 3) == 0 ? 3 : 0;
  memmove(text, text + mark, length - mark); /* of the order of bytes; some editors write it */
  text[length - mark] = '\0';
  return text;
}

static int read_description(file *f)
{
  if (!(f->text = read_text(f))) return f->code;
  json_error_t at;
  f->root = json_loads(f->text, JSON_REJECT_DUPLICATES | JSON_DECODE_ANY, &at);
  if (!f->root) {
    kg_error error = {0};
    char text[sizeof at.text];
    copy_printable(text, sizeof text, at.text);
    (void)kg_fail(&error, KG_ERR_FORMAT, f->path, at.line, at.column, "not JSON: %s", text);
    f->code = cli_failed(&error);
  } else if (!read_root(f) && f->code == CLI_GOOD) {
    f->code = CLI_INPUT; /* not reached: every failure has told itself */
  }
  json_decref(f->root);
  free(f->text);
  return f->code;
}

static bool is_description(const char *path)
{
  const char *dot = strrchr(path, '.');
  return dot && strcasecmp(dot, ".json") == 0;
}

int cli_scene_add(cli_scene *scene, const char *path, double unit_m, bool is_quiet)
{
  file f = {.path = path, .scene = scene, .unit_m = unit_m, .is_quiet = is_quiet};
  if (is_description(path)) return read_description(&f);
  kg_sdf_shape shape = {.kind = KG_SHAPE_MESH};
  if (load_mesh(&f, path, unit_m, &shape)) (void)add_shape(&f, NULL, &shape);
  return f.code;
}

void cli_scene_release(cli_scene *scene)
{
  for (int i = 0; i < scene->mesh_count; i++) {
    kg_mesh_destroy(scene->meshes[i]);
    free(scene->mesh_paths[i]);
  }
}

/* ---- help -------------------------------------------------------------------------------------- */

void cli_print_scene_types(FILE *out)
{
  for (int k = 0; k < TYPES; k++) {
    fprintf(out, "  %-12s", types[k].name);
    for (int m = 0; m < MOST_OWN_MEMBERS && types[k].members[m]; m++) {
      fprintf(out, "%s%s", m > 0 ? ", " : " ", types[k].members[m]);
    }
    fputc('\n', out);
  }
}

void cli_print_scene_limits(FILE *out)
{
  fprintf(out,
          "At most %d shapes, %d of them moving, meshes of a description or combinations, %d with\n"
          "soft. A combination of n parts counts as n - 1 beside them.\n",
          MOST_SHAPES, KG_SCENE_MAX_PLACES, MOST_GROUNDS);
}
