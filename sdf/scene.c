/* Union of shapes: Phi = min over the shapes. The minimum of signed distances is the exact distance
 * outside; inside an overlap of shapes it is a lower bound of the depth. */
#include "kinegrad/sdf.h"

kg_scene kg_scene_ground(double height, kg_vec3 normal)
{
  KG_ASSERT(kg_vec3_norm(normal) > 0.0);
  kg_scene scene = {.shape_count = 1};
  scene.shapes[0] = (kg_sdf_shape){
    .kind = KG_SHAPE_PLANE, .a = kg_vec3_make(0.0, height, 0.0), .b = kg_vec3_normalized(normal)};
  return scene;
}

bool kg_scene_add(kg_scene *scene, const kg_sdf_shape *shape)
{
  if (scene->shape_count >= KG_SCENE_MAX_SHAPES) return false;
  scene->shapes[scene->shape_count++] = *shape;
  return true;
}

static kg_sdf_value shape_distance(const kg_sdf_shape *shape, kg_vec3 x)
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
    case KG_SHAPE_HEIGHT_FIELD:
      return kg_height_field_distance(shape->field, x);
    case KG_SHAPE_MESH:
      return kg_mesh_distance(shape->mesh, x);
  }
  return (kg_sdf_value){INFINITY, {0.0, 1.0, 0.0}, {0.0}};
}

kg_sdf_value kg_scene_distance(const kg_scene *scene, kg_vec3 x)
{
  /* one plane is the usual scene, and it is asked for hundreds of points every frame */
  if (scene->shape_count == 1 && scene->shapes[0].kind == KG_SHAPE_PLANE) {
    return kg_sdf_plane(scene->shapes[0].a, scene->shapes[0].b, x);
  }
  kg_sdf_value best = {INFINITY, {0.0, 1.0, 0.0}, {0.0}}; /* an empty scene is infinitely far */
  for (int i = 0; i < scene->shape_count; i++) {
    const kg_sdf_value value = shape_distance(&scene->shapes[i], x);
    if (!(value.distance >= best.distance)) { /* so that NaN is not taken for far away */
      best = value;
    }
  }
  return best;
}
