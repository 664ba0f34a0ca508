/* The dynamics of bodies of 23 and 37 segments against MuJoCo, through the MJCF file that the
 * library writes. Conventions agree: free joint with linear velocity in world axes and angular
 * velocity in the root's, ball joints with relative angular velocity in the child's frame. */
#include "support.h"

#include <stdio.h>
#include <unistd.h>

#include <mujoco/mujoco.h>

#include "bench/dynamics/models.h"
#include "kinegrad/dynamics.h"

enum { STATES = 1000, NV_MAX = 120, NQ_MAX = 160 };

typedef struct both {
  kg_bench_model of;
  const kg_body *body;
  kg_dynamics *dynamics;
  mjModel *model;
  mjData *data;
  double q[NQ_MAX], v[NV_MAX], a[NV_MAX];
} both;

/* data: as in kg_bench_model_open */
static both set_up(kg_bench_skeleton skeleton, const char *data)
{
  both b = {.dynamics = NULL};
  kg_error error = {0};
  const char *path = KG_TEST_SCRATCH "/mujoco.xml";
  if (kg_bench_model_open(&b.of, skeleton, data, &error) != KG_OK ||
      kg_body_write_mjcf(b.of.body, NULL, path, 9.8, &error) != KG_OK ||
      kg_dynamics_create(&b.dynamics, b.of.body, NULL) != KG_OK) {
    fail_msg("%s", error.text);
  }
  b.body = b.of.body;
  assert_in_range(b.body->nv, 1, NV_MAX);
  assert_in_range(b.body->nq, 1, NQ_MAX);
  char text[1000] = "";
  b.model = mj_loadXML(path, NULL, text, sizeof text);
  if (!b.model) {
    fail_msg("%s", text);
  }
  b.model->opt.disableflags |= mjDSBL_CONSTRAINT; /* no contact in these comparisons */
  b.data = mj_makeData(b.model);
  assert_non_null(b.data);
  assert_int_equal(b.model->nq, b.body->nq);
  assert_int_equal(b.model->nv, b.body->nv);
  return b;
}

static void tear_down(both *b)
{
  mj_deleteData(b->data);
  mj_deleteModel(b->model);
  kg_dynamics_destroy(b->dynamics);
  kg_bench_model_close(&b->of);
}

/* Any orientation in every joint, fast motion, large accelerations. */
static void random_state(both *b, kg_random *random)
{
  kg_bench_random_state(random, b->body, b->q, b->v, b->a);
  memcpy(b->data->qpos, b->q, (size_t)b->body->nq * sizeof(double));
  memcpy(b->data->qvel, b->v, (size_t)b->body->nv * sizeof(double));
  memcpy(b->data->qacc, b->a, (size_t)b->body->nv * sizeof(double));
  mj_inverse(b->model, b->data);
}

static double relative_difference(const double *ours, const double *theirs, int n)
{
  double difference = 0.0, size = 0.0;
  for (int k = 0; k < n; k++) {
    difference += (ours[k] - theirs[k]) * (ours[k] - theirs[k]);
    size += theirs[k] * theirs[k];
  }
  assert_true(size > 0.0);
  return sqrt(difference / size);
}

static void compare_dynamics(kg_bench_skeleton skeleton, const char *data, int segments)
{
  both b = set_up(skeleton, data);
  assert_int_equal(b.body->segment_count, segments);
  kg_random random = kg_random_make(2022);
  const int nv = b.body->nv;
  static double M[NV_MAX * NV_MAX], theirs[NV_MAX * NV_MAX];
  double tau[NV_MAX], a[NV_MAX];
  const double zero[NV_MAX] = {0};
  double worst[4] = {0};
  for (int s = 0; s < STATES; s++) {
    random_state(&b, &random);
    kg_dynamics_inverse(b.dynamics, tau, b.q, b.v, b.a);
    worst[0] = fmax(worst[0], relative_difference(tau, b.data->qfrc_inverse, nv));
    memcpy(b.data->qfrc_applied, tau, (size_t)nv * sizeof *tau);
    mj_forward(b.model, b.data);
    kg_dynamics_inverse(b.dynamics, a, b.q, b.v, zero);
    worst[1] = fmax(worst[1], relative_difference(a, b.data->qfrc_bias, nv));
    mj_fullM(b.model, theirs, b.data->qM);
    kg_dynamics_mass_matrix(b.dynamics, M, b.q);
    worst[2] = fmax(worst[2], relative_difference(M, theirs, nv * nv));
    kg_dynamics_forward(b.dynamics, a, b.q, b.v, tau);
    worst[3] = fmax(worst[3], relative_difference(a, b.data->qacc, nv));
  }
  print_message("%s: worst relative difference over %d states: inverse dynamics %.1e, bias %.1e, "
                "M %.1e, forward dynamics %.1e\n",
                b.of.source, STATES, worst[0], worst[1], worst[2], worst[3]);
  for (int k = 0; k < 4; k++) {
    assert_at_most(worst[k], 1e-10);
  }
  tear_down(&b);
}

static void dynamics_agree_with_mujoco(void **state)
{
  (void)state;
  compare_dynamics(KG_BENCH_MAPPED, KG_TEST_DATA "/walker.bvh", 23);
  compare_dynamics(KG_BENCH_MAPPED, NULL, 23);
  compare_dynamics(KG_BENCH_EVERY_JOINT, NULL, 37);
}

static void dynamics_of_captured_skeletons_agree_with_mujoco(void **state)
{
  (void)state;
  if (access(KG_TEST_SHARED "/data", R_OK) != 0) {
    print_message("skipped: %s is not there\n", KG_TEST_SHARED "/data");
    skip();
  }
  compare_dynamics(KG_BENCH_MAPPED, KG_TEST_SHARED "/data", 23);
  compare_dynamics(KG_BENCH_EVERY_JOINT, KG_TEST_SHARED "/data", 37);
}

static void poses_and_momentum_agree_with_mujoco(void **state)
{
  (void)state;
  both b = set_up(KG_BENCH_EVERY_JOINT, NULL);
  kg_random random = kg_random_make(77);
  const int n = b.body->segment_count;
  kg_vec3 p[KG_BENCH_SYNTHETIC_JOINTS];
  kg_mat3 R[KG_BENCH_SYNTHETIC_JOINTS];
  assert_int_equal(n, KG_BENCH_SYNTHETIC_JOINTS);
  for (int s = 0; s < STATES; s++) {
    random_state(&b, &random);
    mj_forward(b.model, b.data);
    mj_subtreeVel(b.model, b.data);
    kg_dynamics_pose(b.dynamics, b.q, p, R);
    for (int i = 0; i < n; i++) {
      const double *x = b.data->xpos + 3 * (i + 1), *m = b.data->xmat + 9 * (i + 1);
      const kg_vec3 d = kg_vec3_sub(p[i], kg_vec3_make(x[0], x[1], x[2]));
      assert_at_most(kg_vec3_norm(d), 1e-12);
      for (int k = 0; k < 9; k++) {
        assert_close(R[i].m[k], m[k], 1e-12);
      }
    }
    const kg_centroid c = kg_dynamics_centroid(b.dynamics, b.q, b.v);
    const double *L = b.data->subtree_angmom + 3, *u = b.data->subtree_linvel + 3;
    assert_close(c.L.x, L[0], 1e-10);
    assert_close(c.L.y, L[1], 1e-10);
    assert_close(c.L.z, L[2], 1e-10);
    assert_close(c.com_dot.x, u[0], 1e-10);
    assert_close(c.com_dot.y, u[1], 1e-10);
    assert_close(c.com_dot.z, u[2], 1e-10);
  }
  tear_down(&b);
}

static void the_model_stands_on_its_ground(void **state)
{
  (void)state;
  both b = set_up(KG_BENCH_MAPPED, KG_TEST_DATA "/walker.bvh");
  b.model->opt.disableflags &= ~mjDSBL_CONSTRAINT;
  kg_body_state_from_clip(b.body, b.of.clip, 0, b.q, NULL);
  b.q[1] -= 0.2; /* well into the floor: MuJoCo must see contacts, and only with the ground */
  memcpy(b.data->qpos, b.q, (size_t)b.body->nq * sizeof(double));
  mj_forward(b.model, b.data);
  assert_true(b.data->ncon > 0);
  const int ground = mj_name2id(b.model, mjOBJ_GEOM, "ground");
  for (int c = 0; c < b.data->ncon; c++) {
    assert_true(b.data->contact[c].geom1 == ground || b.data->contact[c].geom2 == ground);
    assert_true(fabs(b.data->contact[c].frame[1]) > 0.999); /* the normal is vertical */
  }
  tear_down(&b);
}

static void the_model_has_the_planes_of_the_scene(void **state)
{
  (void)state;
  both b = set_up(KG_BENCH_MAPPED, KG_TEST_DATA "/walker.bvh");
  const char *path = KG_TEST_SCRATCH "/mujoco_planes.xml";
  const kg_vec3 normal = kg_vec3_normalized(kg_vec3_make(0.1, 1.0, -0.2));
  kg_scene scene = kg_scene_ground(-0.3, normal);
  const kg_sdf_shape ball = {.kind = KG_SHAPE_SPHERE, .radius = 1.0};
  const kg_sdf_shape wall = {
    .kind = KG_SHAPE_PLANE, .a = kg_vec3_make(0.0, 1.0, -2.0), .b = kg_vec3_make(0.0, 0.0, 1.0)};
  assert_true(kg_scene_add(&scene, &ball) && kg_scene_add(&scene, &wall));
  assert_int_equal(kg_body_write_mjcf(b.body, &scene, path, 9.8, NULL), KG_OK);
  char text[1000] = "";
  mjModel *model = mj_loadXML(path, NULL, text, sizeof text);
  assert_non_null(model);
  mjData *data = mj_makeData(model);
  mj_forward(model, data);
  int planes = 0;
  for (int g = 0; g < model->ngeom; g++) {
    if (model->geom_type[g] != mjGEOM_PLANE) {
      continue;
    }
    const double *x = data->geom_xpos + 3 * g, *R = data->geom_xmat + 9 * g;
    const kg_vec3 n = kg_vec3_make(R[2], R[5], R[8]), other = planes == 0 ? normal : wall.b;
    const kg_vec3 a = planes == 0 ? kg_vec3_make(0.0, -0.3, 0.0) : wall.a;
    assert_at_most(kg_vec3_norm(kg_vec3_sub(n, other)), 1e-12);
    assert_close(kg_vec3_dot(n, kg_vec3_make(x[0], x[1], x[2])), kg_vec3_dot(other, a), 1e-12);
    planes++;
  }
  assert_int_equal(planes, 2);
  mj_deleteData(data);
  mj_deleteModel(model);
  tear_down(&b);
}

/* whether the file has the text */
static bool mentions(const char *path, const char *text)
{
  char line[1000];
  bool found = false;
  FILE *file = fopen(path, "r");
  assert_non_null(file);
  while (fgets(line, sizeof line, file)) {
    found = found || strstr(line, text);
  }
  fclose(file);
  return found;
}

static void the_model_says_what_it_lacks(void **state)
{
  (void)state;
  both b = set_up(KG_BENCH_MAPPED, KG_TEST_DATA "/walker.bvh");
  const char *path = KG_TEST_SCRATCH "/mujoco_lacks.xml";
  kg_scene scene = kg_scene_ground(0.0, kg_vec3_make(0.0, 1.0, 0.0));
  assert_int_equal(kg_body_write_mjcf(b.body, &scene, path, 9.8, NULL), KG_OK);
  assert_false(mentions(path, "Not in this model"));
  const kg_ground mat = {.thickness = 0.05, .stiffness = 1e4, .friction = -1.0};
  const kg_place place = {.at = {1.0, 0.0, 0.0}, .velocity = {1.0, 0.0, 0.0}};
  scene.shapes[0].ground = kg_scene_add_ground(&scene, &mat);
  const kg_sdf_shape ball = {
    .kind = KG_SHAPE_SPHERE, .radius = 1.0, .place = kg_scene_add_place(&scene, &place)};
  assert_true(kg_scene_add(&scene, &ball));
  assert_int_equal(kg_body_write_mjcf(b.body, &scene, path, 9.8, NULL), KG_OK);
  assert_true(mentions(path, "1 shape of the scene that are no plane at rest"));
  assert_true(mentions(path, "(1 in a place that may move); the soft layer of 1 plane -->"));
  tear_down(&b);
}

static void a_path_that_cannot_be_written_is_reported(void **state)
{
  (void)state;
  both b = set_up(KG_BENCH_MAPPED, NULL);
  kg_error error = {0};
  const char *path = KG_TEST_SCRATCH "/no such folder/model.xml";
  assert_int_equal(kg_body_write_mjcf(b.body, NULL, path, 9.8, &error), KG_ERR_WRITE);
  assert_string_equal(error.path, path);
  tear_down(&b);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(dynamics_agree_with_mujoco),
    cmocka_unit_test(dynamics_of_captured_skeletons_agree_with_mujoco),
    cmocka_unit_test(poses_and_momentum_agree_with_mujoco),
    cmocka_unit_test(the_model_stands_on_its_ground),
    cmocka_unit_test(the_model_has_the_planes_of_the_scene),
    cmocka_unit_test(the_model_says_what_it_lacks),
    cmocka_unit_test(a_path_that_cannot_be_written_is_reported),
  };
  return cmocka_run_group_tests_name("mujoco", tests, NULL, NULL);
}
