/* MuJoCo as a contestant: the body written as MJCF and loaded, states copied, its calls behind ours.
 * What each call runs stands in mujoco_peer.h. */
#include "bench/dynamics/mujoco_peer.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <mujoco/mujoco.h>

struct kg_mujoco {
  mjModel *model;
  mjData *data;
  double *work; /* nv */
};

/* ---- model ----------------------------------------------------------------------------------- */

/* MuJoCo's own writes a file into the working folder. */
static void say_nothing(const char *text)
{
  (void)text;
}

/* The model's text with named joints and a motor for each of their directions. A free joint has
 * six, a ball joint three. */
static kg_status add_motors(const char *path, const kg_body *body)
{
  FILE *file = fopen(path, "rb+");
  char *text = calloc(1, 1 << 20);
  if (!file || !text || fread(text, 1, (1 << 20) - 1, file) == 0) {
    free(text);
    if (file) {
      fclose(file);
    }
    return KG_ERR_READ;
  }
  rewind(file);
  int joint = 0;
  const char *at = text, *end = strstr(text, "</mujoco>");
  for (const char *found = strstr(at, "<joint type="); found; found = strstr(at, "<joint type=")) {
    fwrite(at, 1, (size_t)(found - at), file);
    fprintf(file, "<joint name=\"motor_%d\" type=", joint++);
    at = found + strlen("<joint type=");
  }
  fwrite(at, 1, (size_t)(end - at), file);
  fprintf(file, "<actuator>\n");
  for (int k = 0; k < body->nv; k++) {
    const int j = k < 6 ? 0 : (k - 3) / 3, axis = k < 6 ? k : k % 3;
    fprintf(file, "<motor joint=\"motor_%d\" gear=\"%d %d %d %d %d %d\"/>\n", j, axis == 0,
            axis == 1, axis == 2, axis == 3, axis == 4, axis == 5);
  }
  fprintf(file, "</actuator>\n</mujoco>\n");
  free(text);
  return fclose(file) == 0 ? KG_OK : KG_ERR_WRITE;
}

static kg_status load_model(kg_mujoco *s, const kg_mujoco_def *def)
{
  char path[64] = "/tmp/kinegrad-bench-XXXXXX", text[1000] = "";
  const int file = mkstemp(path);
  if (file < 0) {
    return KG_ERR_WRITE;
  }
  close(file);
  kg_body bare = *def->body; /* geoms would cost MuJoCo time where they are not needed */
  bare.shape_count = def->has_shapes ? bare.shape_count : 0;
  kg_status status = kg_body_write_mjcf(&bare, NULL, path, 9.8, NULL);
  if (status == KG_OK && def->has_motors) {
    status = add_motors(path, def->body);
  }
  if (status == KG_OK) {
    s->model = mj_loadXML(path, NULL, text, sizeof text);
    if (!s->model) {
      fprintf(stderr, "MuJoCo: %s\n", text);
      status = KG_ERR_FORMAT;
    }
  }
  (void)remove(path);
  return status;
}

static void set_options(mjModel *m, const kg_mujoco_def *def)
{
  m->opt.timestep = def->timestep;
  m->opt.integrator = def->integrator == KG_MUJOCO_IMPLICIT ? mjINT_IMPLICIT : mjINT_EULER;
  if (!def->has_shapes) {
    m->opt.disableflags |= mjDSBL_CONSTRAINT | mjDSBL_CONTACT;
  }
  for (int k = 6; k < m->nv; k++) {
    m->dof_damping[k] = def->joint_damping;
  }
  for (int k = 1; k < m->njnt; k++) {
    m->jnt_stiffness[k] = def->joint_stiffness;
  }
  for (int k = 0; k < m->ngeom; k++) {
    m->geom_margin[k] = def->margin;
  }
}

kg_status kg_mujoco_open(kg_mujoco **mujoco, const kg_mujoco_def *def)
{
  *mujoco = NULL;
  mju_user_warning = say_nothing;
  kg_mujoco *s = calloc(1, sizeof *s);
  if (!s) {
    return KG_ERR_NO_MEMORY;
  }
  const kg_status status = load_model(s, def);
  if (status != KG_OK) {
    kg_mujoco_close(s);
    return status;
  }
  set_options(s->model, def);
  s->data = mj_makeData(s->model);
  s->work = calloc((size_t)s->model->nv, sizeof *s->work);
  if (!s->data || !s->work) {
    kg_mujoco_close(s);
    return KG_ERR_NO_MEMORY;
  }
  KG_ASSERT(s->model->nq == def->body->nq && s->model->nv == def->body->nv);
  *mujoco = s;
  return KG_OK;
}

void kg_mujoco_close(kg_mujoco *mujoco)
{
  if (mujoco) {
    if (mujoco->data) {
      mj_deleteData(mujoco->data);
    }
    if (mujoco->model) {
      mj_deleteModel(mujoco->model);
    }
    free(mujoco->work);
    free(mujoco);
  }
}

/* ---- stages ---------------------------------------------------------------------------------- */

static void copy(double *to, const double *from, int count)
{
  memcpy(to, from, (size_t)count * sizeof *to);
}

static void set_pose(kg_mujoco *s, const double *q)
{
  copy(s->data->qpos, q, s->model->nq);
  mj_kinematics(s->model, s->data);
  mj_comPos(s->model, s->data);
}

static void set_velocity(kg_mujoco *s, const double *v)
{
  copy(s->data->qvel, v, s->model->nv);
  mj_comVel(s->model, s->data);
}

void kg_mujoco_rne(kg_mujoco *s, double *tau, const double *q, const double *v, const double *a)
{
  set_pose(s, q);
  set_velocity(s, v);
  copy(s->data->qacc, a, s->model->nv);
  mj_rne(s->model, s->data, 1, tau);
}

void kg_mujoco_inverse(kg_mujoco *s, double *tau, const double *q, const double *v, const double *a)
{
  copy(s->data->qpos, q, s->model->nq);
  copy(s->data->qvel, v, s->model->nv);
  copy(s->data->qacc, a, s->model->nv);
  mj_inverse(s->model, s->data);
  copy(tau, s->data->qfrc_inverse, s->model->nv);
}

void kg_mujoco_mass_matrix(kg_mujoco *s, double *M, const double *q)
{
  set_pose(s, q);
  mj_crb(s->model, s->data);
  mj_fullM(s->model, M, s->data->qM);
}

void kg_mujoco_point(kg_mujoco *s, double *J, const double *q, const double point[3])
{
  const int body = s->model->nbody - 1;
  double x[3];
  set_pose(s, q);
  mju_rotVecMat(x, point, s->data->xmat + 9 * body);
  mju_addTo3(x, s->data->xpos + 3 * body);
  mj_jac(s->model, s->data, J, NULL, x, body);
}

void kg_mujoco_mass_solve(kg_mujoco *s, double *x, const double *q)
{
  set_pose(s, q);
  mj_crb(s->model, s->data);
  mj_factorM(s->model, s->data);
  mj_solveM(s->model, s->data, x, x, 1);
}

void kg_mujoco_smooth_forward(kg_mujoco *s, double *a, const double *q, const double *v,
                              const double *tau)
{
  set_pose(s, q);
  mj_crb(s->model, s->data);
  mj_factorM(s->model, s->data);
  set_velocity(s, v);
  mj_rne(s->model, s->data, 0, s->work);
  for (int k = 0; k < s->model->nv; k++) {
    s->work[k] = tau[k] - s->work[k];
  }
  mj_solveM(s->model, s->data, a, s->work, 1);
}

void kg_mujoco_forward(kg_mujoco *s, double *a, const double *q, const double *v, const double *tau)
{
  copy(s->data->qpos, q, s->model->nq);
  copy(s->data->qvel, v, s->model->nv);
  copy(s->data->qfrc_applied, tau, s->model->nv);
  mj_forward(s->model, s->data);
  copy(a, s->data->qacc, s->model->nv);
}

void kg_mujoco_pose(kg_mujoco *s, double *p, double *R, const double *q)
{
  copy(s->data->qpos, q, s->model->nq);
  mj_kinematics(s->model, s->data);
  copy(p, s->data->xpos + 3, 3 * (s->model->nbody - 1));
  copy(R, s->data->xmat + 9, 9 * (s->model->nbody - 1));
}

/* ---- whole steps ----------------------------------------------------------------------------- */

void kg_mujoco_set_state(kg_mujoco *s, const double *q, const double *v)
{
  copy(s->data->qpos, q, s->model->nq);
  copy(s->data->qvel, v, s->model->nv);
  memset(s->data->qacc_warmstart, 0, (size_t)s->model->nv * sizeof(double));
}

void kg_mujoco_step(kg_mujoco *s, const double *tau)
{
  copy(s->data->qfrc_applied, tau, s->model->nv);
  mj_step(s->model, s->data);
}

void kg_mujoco_get_state(const kg_mujoco *s, double *q, double *v)
{
  copy(q, s->data->qpos, s->model->nq);
  copy(v, s->data->qvel, s->model->nv);
}

void kg_mujoco_set_timestep(kg_mujoco *s, double timestep)
{
  s->model->opt.timestep = timestep;
}

int kg_mujoco_contacts(const kg_mujoco *s)
{
  return s->data->ncon;
}

double kg_mujoco_support(const kg_mujoco *s)
{
  double sum = 0.0;
  for (int c = 0; c < s->data->ncon; c++) {
    double force[6]; /* in the contact's frame, whose axes are the rows of frame */
    const double *frame = s->data->contact[c].frame;
    mj_contactForce(s->model, s->data, c, force);
    /* on the second geom; the ground is the first, or the sign turns */
    const int body = s->model->geom_bodyid[s->data->contact[c].geom2];
    const double along = frame[1] * force[0] + frame[4] * force[1] + frame[7] * force[2];
    sum += body > 0 ? along : -along;
  }
  return sum;
}

void kg_mujoco_transition(kg_mujoco *s, double *A, double *B, const double *tau)
{
  copy(s->data->qfrc_applied, tau, s->model->nv);
  mjd_transitionFD(s->model, s->data, 1e-6, 0, A, B, NULL, NULL);
}
