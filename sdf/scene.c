/* Scenes: unions of shapes that may be placed, combined and covered.
 *
 * Phi = min over the shapes. A shape is asked with a limit, the least Phi so far: whether it is
 * further is often seen without its closest point. */
#include "kinegrad/sdf.h"

#include "sdf/feature.h"

kg_ground kg_ground_default(void)
{
  return (kg_ground){.thickness = 0.0, .stiffness = 0.0, .damping = 0.0, .friction = -1.0};
}

bool kg_ground_is_valid(const kg_ground *ground)
{
  const kg_ground *g = ground;
  return g->thickness >= 0.0 && g->stiffness >= 0.0 && g->damping >= 0.0 &&
         isfinite(g->thickness + g->stiffness + g->damping + g->friction);
}

/* ---- building ---------------------------------------------------------------------------------- */

kg_scene kg_scene_ground(double height, kg_vec3 normal)
{
  KG_ASSERT(kg_vec3_norm(normal) > 0.0);
  kg_scene scene = {.shape_count = 1};
  scene.shapes[0] = (kg_sdf_shape){
    .kind = KG_SHAPE_PLANE, .a = kg_vec3_make(0.0, height, 0.0), .b = kg_vec3_normalized(normal)};
  return scene;
}

static bool is_combination(const kg_sdf_shape *shape)
{
  return shape->kind >= KG_SHAPE_UNION;
}

/* Radius of a ball around the origin of the shape's place that holds it; infinite where not known */
static double reach_of(const kg_scene *scene, const kg_sdf_shape *s)
{
  const double a = kg_vec3_norm(s->a), b = kg_vec3_norm(s->b);
  double reach = INFINITY;
  if (s->kind == KG_SHAPE_SPHERE) {
    reach = a + s->radius;
  } else if (s->kind == KG_SHAPE_BOX) {
    reach = a + b;
  } else if (s->kind == KG_SHAPE_ELLIPSOID) {
    reach = a + fmax(fmax(s->b.x, s->b.y), s->b.z);
  } else if (s->kind == KG_SHAPE_CAPSULE || s->kind == KG_SHAPE_CYLINDER) {
    reach = fmax(a, b) + s->radius;
  } else if (is_combination(s)) {
    reach = 0.0;
    for (int k = 0; k < 2; k++) { /* a place of its own may be moved */
      const kg_sdf_shape *child = &scene->shapes[s->children[k]];
      reach = fmax(reach, child->place ? INFINITY : reach_of(scene, child));
    }
    reach += s->kind == KG_SHAPE_SMOOTH_UNION ? s->radius : 0.0;
  }
  return reach + fmax(s->offset, 0.0);
}

bool kg_scene_add(kg_scene *scene, const kg_sdf_shape *shape)
{
  const int count = scene->shape_count;
  KG_ASSERT(shape->place >= 0 && shape->place <= scene->place_count);
  KG_ASSERT(shape->ground >= 0 && shape->ground <= scene->ground_count);
  if (count >= KG_SCENE_MAX_SHAPES) return false;
  for (int k = 0; k < 2 && is_combination(shape); k++) {
    KG_ASSERT(shape->children[k] >= 0 && shape->children[k] < count);
    scene->shapes[shape->children[k]].part = true;
  }
  scene->shapes[scene->shape_count++] = *shape;
  if (shape->place > 0) {
    kg_place *place = &scene->places[shape->place - 1];
    place->reach = fmax(place->reach, reach_of(scene, shape));
  }
  return true;
}

int kg_scene_add_place(kg_scene *scene, const kg_place *place)
{
  if (scene->place_count >= KG_SCENE_MAX_PLACES) return 0;
  scene->places[scene->place_count] = *place;
  return ++scene->place_count;
}

int kg_scene_add_ground(kg_scene *scene, const kg_ground *ground)
{
  KG_ASSERT(kg_ground_is_valid(ground));
  if (scene->ground_count >= KG_SCENE_MAX_GROUNDS) return 0;
  scene->grounds[scene->ground_count] = *ground;
  return ++scene->ground_count;
}

void kg_scene_move(kg_scene *scene, int place, kg_vec3 at, kg_quat turn, kg_vec3 velocity,
                   kg_vec3 spin)
{
  KG_ASSERT(place > 0 && place <= scene->place_count);
  kg_place *p = &scene->places[place - 1];
  *p = (kg_place){at, turn, velocity, spin, p->reach};
}

/* ---- one shape --------------------------------------------------------------------------------- */

static double squared(kg_vec3 d)
{
  return kg_vec3_dot(d, d);
}

/* Whether a ball of this radius whose centre is d away is further than the limit, by more than
 * rounding: what is as near as the limit must be seen, for of equals the first counts. */
static bool ball_is_beyond(kg_vec3 d, double radius, double limit)
{
  const double most = limit + radius, rounding = 1e-14 * (fabs(limit) + radius);
  return most + rounding < 0.0 || squared(d) > (most + rounding) * (most + rounding);
}

/* x - closest point of the segment */
static kg_vec3 from_segment(kg_vec3 a, kg_vec3 b, kg_vec3 x)
{
  const kg_vec3 axis = kg_vec3_sub(b, a), d = kg_vec3_sub(x, a);
  const double along = kg_vec3_dot(d, axis), length2 = kg_vec3_dot(axis, axis);
  const double t = along <= 0.0 ? 0.0 : along >= length2 ? 1.0 : along / length2;
  return kg_vec3_add_scaled(d, -t, axis);
}

/* Seen without much work to be further than the limit; false for what is not a number. */
static bool is_beyond(const kg_sdf_shape *s, kg_vec3 x, double limit)
{
  switch (s->kind) {
    case KG_SHAPE_SPHERE:
      return ball_is_beyond(kg_vec3_sub(x, s->a), s->radius, limit);
    case KG_SHAPE_BOX:
      return ball_is_beyond(kg_vec3_sub(x, s->a), kg_vec3_norm(s->b), limit);
    case KG_SHAPE_ELLIPSOID:
      return ball_is_beyond(kg_vec3_sub(x, s->a), fmax(fmax(s->b.x, s->b.y), s->b.z), limit);
    case KG_SHAPE_CAPSULE:
    case KG_SHAPE_CYLINDER: /* lies in the capsule */
      return ball_is_beyond(from_segment(s->a, s->b, x), s->radius, limit);
    default:
      return false;
  }
}

/* hint: of a mesh, or NULL */
static kg_sdf_value simple_value(const kg_sdf_shape *shape, kg_vec3 x, kg_mesh_hint *hint)
{
  switch (shape->kind) {
    case KG_SHAPE_PLANE:
      return kg_sdf_plane(shape->a, shape->b, x);
    case KG_SHAPE_SPHERE:
      return kg_sdf_sphere(shape->a, shape->radius, x);
    case KG_SHAPE_BOX:
      return kg_sdf_box(shape->a, shape->orientation, shape->b, x);
    case KG_SHAPE_CAPSULE:
      return kg_sdf_capsule(shape->a, shape->b, shape->radius, x);
    case KG_SHAPE_ELLIPSOID:
      return kg_sdf_ellipsoid(shape->a, shape->orientation, shape->b, x);
    case KG_SHAPE_CYLINDER:
      return kg_sdf_cylinder(shape->a, shape->b, shape->radius, x);
    case KG_SHAPE_HEIGHT_FIELD:
      return kg_height_field_distance(shape->field, x);
    case KG_SHAPE_MESH:
      return hint ? kg_mesh_distance_from(shape->mesh, x, hint) : kg_mesh_distance(shape->mesh, x);
    default: /* combinations are not simple */
      return (kg_sdf_value){INFINITY, {0.0, 1.0, 0.0}, {0.0}};
  }
}

/* docs/theory/sdf.md (31): (A + B)/2 + psi(|A - B|), psi(s) = -s/2 - r/6 (1 - s/r)^3, for s < r */
static kg_sdf_value blend(const kg_sdf_value *a, const kg_sdf_value *b, double r)
{
  const double d = a->distance - b->distance, left = 1.0 - fabs(d) / r;
  const double slope = copysign(0.5 * (1.0 - left * left), -d); /* psi' sign(d) */
  const double wa = 0.5 + slope, wb = 0.5 - slope, bend = -left / r;
  const kg_vec3 e = kg_vec3_sub(a->normal, b->normal);
  kg_sdf_value out;
  out.distance = fmin(a->distance, b->distance) - r / 6.0 * left * left * left;
  out.normal = kg_vec3_add(kg_vec3_scale(wa, a->normal), kg_vec3_scale(wb, b->normal));
  const double ee[6] = {e.x * e.x, e.y * e.y, e.z * e.z, e.x * e.y, e.x * e.z, e.y * e.z};
  for (int k = 0; k < 6; k++) {
    out.hessian[k] = wa * a->hessian[k] + wb * b->hessian[k] + bend * ee[k];
  }
  return out;
}

static bool hinted_value(const kg_scene *scene, const kg_sdf_shape *s, kg_vec3 x, double limit,
                         kg_mesh_hint *hint, kg_sdf_value *out);

static bool shape_value(const kg_scene *scene, const kg_sdf_shape *s, kg_vec3 x, double limit,
                        kg_sdf_value *out)
{
  return hinted_value(scene, s, x, limit, NULL, out);
}

static bool combined_value(const kg_scene *scene, const kg_sdf_shape *s, kg_vec3 x, double limit,
                           kg_sdf_value *out)
{
  const kg_sdf_shape *A = &scene->shapes[s->children[0]], *B = &scene->shapes[s->children[1]];
  kg_sdf_value a, b;
  if (s->kind == KG_SHAPE_UNION) {
    const bool near_a = shape_value(scene, A, x, limit, &a);
    const bool near_b = shape_value(scene, B, x, near_a ? a.distance : limit, &b);
    if (near_a || near_b) *out = near_b && !(near_a && a.distance <= b.distance) ? b : a;
    return near_a || near_b;
  }
  if (s->kind == KG_SHAPE_SMOOTH_UNION) {
    (void)shape_value(scene, A, x, INFINITY, &a);
    const bool near_b = shape_value(scene, B, x, a.distance + s->radius, &b);
    *out = !near_b                                         ? a
           : !(fabs(a.distance - b.distance) >= s->radius) ? blend(&a, &b, s->radius)
           : a.distance <= b.distance                      ? a
                                                           : b;
    return true;
  }
  if (!shape_value(scene, A, x, limit, &a)) return false;
  if (!shape_value(scene, B, x, s->kind == KG_SHAPE_INTERSECTION ? limit : INFINITY, &b)) {
    return false;
  }
  if (s->kind == KG_SHAPE_DIFFERENCE) b = negated_value(b);
  *out = a.distance >= b.distance ? a : b;
  return true;
}

/* within the place of the shape */
static bool local_value(const kg_scene *scene, const kg_sdf_shape *s, kg_vec3 x, double limit,
                        kg_mesh_hint *hint, kg_sdf_value *out)
{
  limit += s->offset;
  if (is_combination(s)) {
    if (!combined_value(scene, s, x, limit, out)) return false;
  } else {
    if (is_beyond(s, x, limit)) return false;
    *out = simple_value(s, x, hint);
  }
  out->distance -= s->offset;
  return true;
}

/* Phi of the shape, unless that is seen to be further than the limit. */
static bool hinted_value(const kg_scene *scene, const kg_sdf_shape *s, kg_vec3 x, double limit,
                         kg_mesh_hint *hint, kg_sdf_value *out)
{
  if (s->place == 0) return local_value(scene, s, x, limit, hint, out);
  const kg_place *place = &scene->places[s->place - 1];
  const kg_vec3 d = kg_vec3_sub(x, place->at);
  if (place->reach > 0.0 && ball_is_beyond(d, place->reach, limit)) return false;
  const kg_vec3 local = kg_quat_rotate(kg_quat_conj(place->turn), d);
  if (!local_value(scene, s, local, limit, hint, out)) return false;
  *out = rotate_value(kg_quat_matrix(place->turn), *out);
  return true;
}

bool kg_scene_shape_distance(const kg_scene *scene, int i, kg_vec3 x, double limit,
                             kg_sdf_value *value)
{
  KG_ASSERT(i >= 0 && i < scene->shape_count);
  kg_sdf_value v;
  if (!shape_value(scene, &scene->shapes[i], x, limit, &v) || v.distance > limit) return false;
  *value = v;
  return true;
}

/* ---- scenes ------------------------------------------------------------------------------------ */

static bool is_one_plane(const kg_scene *scene)
{
  const kg_sdf_shape *s = &scene->shapes[0];
  return scene->shape_count == 1 && s->kind == KG_SHAPE_PLANE && s->place == 0 && s->offset == 0.0;
}

static int find_nearest(const kg_scene *scene, kg_vec3 x, kg_sdf_value *best)
{
  int nearest = -1;
  *best = (kg_sdf_value){INFINITY, {0.0, 1.0, 0.0}, {0.0}}; /* an empty scene is infinitely far */
  for (int i = 0; i < scene->shape_count && !isnan(best->distance); i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    kg_sdf_value value;
    if (shape->part || !shape_value(scene, shape, x, best->distance, &value)) continue;
    if (!(value.distance >= best->distance)) { /* so that NaN is not taken for far away */
      *best = value;
      nearest = i;
    }
  }
  return nearest;
}

kg_sdf_value kg_scene_distance(const kg_scene *scene, kg_vec3 x)
{
  /* one plane is the usual scene, and it is asked for hundreds of points every frame */
  if (is_one_plane(scene)) return kg_sdf_plane(scene->shapes[0].a, scene->shapes[0].b, x);
  kg_sdf_value best;
  (void)find_nearest(scene, x, &best);
  return best;
}

/* The hinted shape first: its Phi is a limit for the others. Of equally near ones the first counts, as
 * in find_nearest. */
kg_sdf_value kg_scene_distance_from(const kg_scene *scene, kg_vec3 x, kg_scene_hint *hint)
{
  if (is_one_plane(scene)) return kg_sdf_plane(scene->shapes[0].a, scene->shapes[0].b, x);
  const int first = hint->shape;
  const bool known = first >= 0 && first < scene->shape_count && !scene->shapes[first].part;
  kg_sdf_value best = {INFINITY, {0.0, 1.0, 0.0}, {0.0}}, value;
  int nearest = -1;
  if (known && hinted_value(scene, &scene->shapes[first], x, INFINITY, &hint->mesh, &value)) {
    best = value;
    nearest = first;
  }
  for (int i = 0; i < scene->shape_count && !isnan(best.distance); i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    kg_mesh_hint own = {-1};
    if (shape->part || (known && i == first)) continue;
    if (!hinted_value(scene, shape, x, best.distance, &own, &value)) continue;
    const bool same = value.distance == best.distance;
    if (same ? i < nearest : !(value.distance >= best.distance)) {
      best = value;
      nearest = i;
      hint->mesh = own;
    }
  }
  hint->shape = nearest;
  return best;
}

kg_scene_point kg_scene_nearest(const kg_scene *scene, kg_vec3 x)
{
  kg_scene_point out = {.shape = -1, .velocity = {0.0, 0.0, 0.0}, .ground = NULL};
  if (is_one_plane(scene)) {
    out.value = kg_sdf_plane(scene->shapes[0].a, scene->shapes[0].b, x);
    out.shape = 0;
  } else {
    out.shape = find_nearest(scene, x, &out.value);
    if (out.shape < 0) return out;
  }
  const kg_sdf_shape *shape = &scene->shapes[out.shape];
  if (shape->place > 0) out.velocity = kg_place_velocity(&scene->places[shape->place - 1], x);
  if (shape->ground > 0) out.ground = &scene->grounds[shape->ground - 1];
  return out;
}

double kg_scene_surface(const kg_scene *scene, kg_vec3 x)
{
  if (scene->ground_count == 0) return kg_scene_distance(scene, x).distance;
  double least = INFINITY;
  for (int i = 0; i < scene->shape_count && !isnan(least); i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    const double soft = shape->ground > 0 ? scene->grounds[shape->ground - 1].thickness : 0.0;
    kg_sdf_value value;
    if (shape->part || !shape_value(scene, shape, x, least + soft, &value)) continue;
    if (!(value.distance - soft >= least)) least = value.distance - soft;
  }
  return least;
}
