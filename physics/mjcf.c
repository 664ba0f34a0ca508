/* A body as a MuJoCo model (MJCF). Numbers have 17 digits; no locale is ever set in this library,
 * so the decimal point is a point.
 *
 * Inertias are diagonalised here to the last bit (physics/principal.h): MuJoCo's own
 * diagonalisation of a full inertia stops at an absolute 1e-12. */
#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "kinegrad/body.h"
#include "physics/principal.h"

typedef struct principal {
  double moments[3];
  kg_quat axes;
} principal;

static principal principal_axes(const double I[6])
{
  kg_mat3 A = {{I[0], I[3], I[4], I[3], I[1], I[5], I[4], I[5], I[2]}};
  const kg_mat3 V = principal_diagonalise(&A);
  principal p = {{A.m[0], A.m[4], A.m[8]}, kg_quat_from_matrix(V)};
  /* a flat body has A + B = C, which rounding must not turn into A + B < C */
  for (int k = 0; k < 3; k++) {
    const double others = p.moments[(k + 1) % 3] + p.moments[(k + 2) % 3];
    if (p.moments[k] > others && p.moments[k] < others * (1.0 + 1e-12)) {
      p.moments[k] = others;
    }
  }
  return p;
}

static void print_vec3(FILE *file, const char *name, kg_vec3 a)
{
  fprintf(file, " %s=\"%.17g %.17g %.17g\"", name, a.x, a.y, a.z);
}

static void print_quat(FILE *file, kg_quat q)
{
  fprintf(file, " quat=\"%.17g %.17g %.17g %.17g\"", q.w, q.x, q.y, q.z);
}

/* Names must be unique and XML; a doubtful one gets the segment's number instead. */
static void print_name(FILE *file, const kg_body *body, int segment)
{
  const char *name = body->segments[segment].name;
  bool good = name[0] != '\0' && strcspn(name, "&<>\"'") == strlen(name);
  for (int i = 0; i < body->segment_count; i++) {
    good = good && (i == segment || strcmp(name, body->segments[i].name) != 0);
  }
  if (good) {
    fprintf(file, "name=\"%s\"", name);
  } else {
    fprintf(file, "name=\"segment_%d\"", segment);
  }
}

static void print_shape(FILE *file, const kg_body_shape *shape, int indent)
{
  fprintf(file, "%*s<geom", indent, "");
  const bool ball = kg_vec3_norm(kg_vec3_sub(shape->a, shape->b)) < 1e-6;
  if (shape->kind == KG_BODY_CAPSULE && !ball) {
    fprintf(file, " type=\"capsule\" fromto=\"%.17g %.17g %.17g %.17g %.17g %.17g\" size=\"%.17g\"",
            shape->a.x, shape->a.y, shape->a.z, shape->b.x, shape->b.y, shape->b.z, shape->radius);
  } else if (shape->kind == KG_BODY_CAPSULE) {
    fprintf(file, " type=\"sphere\" size=\"%.17g\"", shape->radius);
    print_vec3(file, "pos", shape->a);
  } else {
    fprintf(file, " type=\"%s\"", shape->kind == KG_BODY_BOX ? "box" : "ellipsoid");
    print_vec3(file, "size", shape->b);
    print_vec3(file, "pos", shape->a);
    print_quat(file, shape->orientation);
  }
  fprintf(file, "/>\n");
}

/* Opening of a segment's element: place, mass, joint, shapes. */
static void print_segment(FILE *file, const kg_body *body, int segment, int indent)
{
  const kg_segment *s = &body->segments[segment];
  const principal inertia = principal_axes(s->inertia);
  fprintf(file, "%*s<body ", indent, "");
  print_name(file, body, segment);
  if (s->parent >= 0) {
    print_vec3(file, "pos", s->offset);
  }
  fprintf(file, ">\n%*s<inertial mass=\"%.17g\"", indent + 2, "", s->mass);
  print_vec3(file, "pos", s->com);
  print_quat(file, inertia.axes);
  fprintf(file, " diaginertia=\"%.17g %.17g %.17g\"/>\n", inertia.moments[0], inertia.moments[1],
          inertia.moments[2]);
  fprintf(file, "%*s<joint type=\"%s\"/>\n", indent + 2, "", s->parent < 0 ? "free" : "ball");
  for (int k = 0; k < body->shape_count; k++) {
    if (body->shapes[k].segment == segment) {
      print_shape(file, &body->shapes[k], indent + 2);
    }
  }
}

static int depth_of(const kg_body *body, int segment)
{
  int depth = 0;
  for (int k = body->segments[segment].parent; k >= 0; k = body->segments[k].parent) {
    depth++;
  }
  return depth;
}

/* Depth-first order of the segments: then MuJoCo numbers its joints as we do. */
static bool print_tree(FILE *file, const kg_body *body)
{
  int open = -1; /* the innermost open element */
  for (int i = 0; i < body->segment_count; i++) {
    while (open != body->segments[i].parent) {
      if (open < 0) {
        return false;
      }
      fprintf(file, "%*s</body>\n", 4 + 2 * depth_of(body, open), "");
      open = body->segments[open].parent;
    }
    print_segment(file, body, i, 4 + 2 * depth_of(body, i));
    open = i;
  }
  for (; open >= 0; open = body->segments[open].parent) {
    fprintf(file, "%*s</body>\n", 4 + 2 * depth_of(body, open), "");
  }
  return true;
}

static bool is_exported(const kg_sdf_shape *s)
{
  return s->kind == KG_SHAPE_PLANE && s->place == 0 && !s->part;
}

/* What of the scene the model has no counterpart for */
static void print_what_is_missing(FILE *file, const kg_scene *scene)
{
  int shapes = 0, soft = 0, moving = 0;
  for (int i = 0; i < scene->shape_count; i++) {
    const kg_sdf_shape *s = &scene->shapes[i];
    if (s->part) continue;
    shapes += !is_exported(s);
    soft += is_exported(s) && s->ground > 0;
    moving += s->place > 0;
  }
  if (shapes + soft == 0) return;
  fprintf(file, "    <!-- Not in this model:");
  if (shapes > 0)
    fprintf(file, " %d shape%s of the scene that are no plane at rest", shapes,
            shapes > 1 ? "s" : "");
  if (moving > 0) fprintf(file, " (%d in a place that may move)", moving);
  if (soft > 0)
    fprintf(file, "%s the soft layer of %d plane%s", shapes > 0 ? ";" : "", soft,
            soft > 1 ? "s" : "");
  fprintf(file, " -->\n");
}

/* MuJoCo's plane lies across its own z */
static void print_planes(FILE *file, const kg_scene *scene)
{
  bool first = true;
  for (int i = 0; i < scene->shape_count; i++) {
    const kg_sdf_shape *s = &scene->shapes[i];
    if (!is_exported(s)) continue;
    const kg_vec3 at = kg_vec3_add_scaled(s->a, s->offset, s->b);
    const kg_quat turn = kg_quat_between(kg_vec3_make(0.0, 0.0, 1.0), s->b);
    fprintf(
      file,
      "    <geom%s type=\"plane\" size=\"10 10 0.1\" contype=\"0\" conaffinity=\"1\""
      " pos=\"%.17g %.17g %.17g\" quat=\"%.17g %.17g %.17g %.17g\" rgba=\"0.4 0.5 0.5 1\"/>\n",
      first ? " name=\"ground\"" : "", at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z);
    first = false;
  }
}

static bool print_model(FILE *file, const kg_body *body, const kg_scene *scene, double gravity)
{
  fprintf(file,
          "<mujoco model=\"kinegrad\">\n"
          "  <!-- Y up. qpos and qvel are kinegrad's q and v: root position, then one quaternion\n"
          "       (angular velocity in its own frame) per segment. -->\n"
          "  <compiler angle=\"radian\" inertiafromgeom=\"false\" balanceinertia=\"false\"/>\n"
          "  <option timestep=\"0.005\" gravity=\"0 %.17g 0\"/>\n"
          "  <default>\n"
          "    <joint armature=\"0\" damping=\"0\" stiffness=\"0\" limited=\"false\"/>\n"
          "    <geom contype=\"1\" conaffinity=\"0\" friction=\"0.9\" rgba=\"0.7 0.6 0.5 1\"/>\n"
          "  </default>\n"
          "  <worldbody>\n"
          "    <light pos=\"0 5 2\" dir=\"0 -1 -0.4\"/>\n",
          -gravity);
  const kg_scene level = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  print_planes(file, scene ? scene : &level);
  if (scene) print_what_is_missing(file, scene);
  if (!print_tree(file, body)) {
    return false;
  }
  fprintf(file, "  </worldbody>\n</mujoco>\n");
  return true;
}

kg_status kg_body_write_mjcf(const kg_body *body, const kg_scene *scene, const char *path,
                             double gravity, kg_error *error)
{
  char temporary[4096];
  const int length = snprintf(temporary, sizeof temporary, "%s.part", path);
  if (length < 0 || (size_t)length >= sizeof temporary) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be created: the path is too long");
  }
  FILE *file = fopen(temporary, "wb");
  if (!file) {
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be created: %s", strerror(errno));
  }
  const bool in_order = print_model(file, body, scene, gravity);
  bool written = fflush(file) == 0 && !ferror(file);
  written = fclose(file) == 0 && written;
  if (!in_order) {
    (void)remove(temporary);
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0,
                   "the body's segments are not in depth-first order, which MJCF needs");
  }
  if (!written || rename(temporary, path) != 0) {
    const int reason = errno;
    (void)remove(temporary);
    return kg_fail(error, KG_ERR_WRITE, path, 0, 0, "cannot be written: %s", strerror(reason));
  }
  return KG_OK;
}
