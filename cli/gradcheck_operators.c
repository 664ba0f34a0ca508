/* Dynamics on the tape as rows of the gradient check. Every row is a function of changes x, zero where it is checked;
 * they are measured in units that make them alike: contact layers, stick velocities, shares of a mass. */
#include "cli/gradcheck_operators.h"

#include <math.h>
#include <string.h>

#include "kinegrad/arena.h"
#include "kinegrad/losses.h"

enum { FORCES = 4, LOSS_FRAMES = 3 };

struct cli_operators {
  kg_arena arena;
  const kg_body *body;
  kg_joint_passive *passive;
  kg_contact_params law;
  kg_dynamics_operators *operators;
  double dt;
  double *numbers;         /* 4 (n + point_count), and a motion: what constants are made of */
  const double *q, *v, *a; /* of the point */
  int row, at;             /* being recorded: row, entries of x used up */
};

/* ---- pieces of x -------------------------------------------------------------------------------------------- */

/* base + unit times the next entries of x */
static kg_value changed(cli_operators *o, kg_tape *tape, kg_value x, kg_shape shape,
                        const double *base, double unit)
{
  const int count = (int)kg_shape_size(&shape);
  const kg_value piece = kg_reshape(tape, kg_slice(tape, x, 0, o->at, count), shape);
  o->at += count;
  return kg_add(tape, kg_constant(tape, shape, base), kg_scale(tape, piece, unit));
}

static kg_value state(cli_operators *o, kg_tape *tape, kg_value x, double unit)
{
  return changed(o, tape, x, KG_SHAPE(o->body->nq), o->q, unit);
}

static kg_value rate(cli_operators *o, kg_tape *tape, kg_value x, const double *base, double unit)
{
  return changed(o, tape, x, KG_SHAPE(o->body->nv), base, unit);
}

/* forces on the first points, in 10 N; the others have none */
static kg_value forces(cli_operators *o, kg_tape *tape, kg_value x)
{
  const int points = o->body->point_count, moved = points < FORCES ? points : FORCES;
  for (int k = 0; k < 3 * moved; k++) {
    o->numbers[k] = 10.0 * sin(k + 1.0);
  }
  const kg_value first = changed(o, tape, x, KG_SHAPE(moved, 3), o->numbers, 10.0);
  if (moved == points) return first;
  const kg_value rest = kg_constant(tape, KG_SHAPE(points - moved, 3), NULL);
  return kg_concat(tape, 0, 2, (kg_value[2]){first, rest});
}

static kg_value law(cli_operators *o, kg_tape *tape, kg_value x)
{
  const kg_contact_params *p = &o->law;
  const double numbers[6] = {p->layer, p->force, p->floor_share, p->damping, p->friction, p->stick};
  const kg_value share = kg_shift(tape, kg_scale(tape, kg_slice(tape, x, 0, o->at, 6), 0.1), 1.0);
  o->at += 6;
  return kg_mul(tape, kg_constant(tape, KG_SHAPE(6), numbers), share);
}

static kg_value masses(cli_operators *o, kg_tape *tape, kg_value x)
{
  const int n = o->body->segment_count;
  for (int i = 0; i < n; i++) {
    o->numbers[i] = o->body->segments[i].mass;
  }
  return changed(o, tape, x, KG_SHAPE(n), o->numbers, 0.1);
}

static kg_value offsets(cli_operators *o, kg_tape *tape, kg_value x)
{
  const int n = o->body->segment_count;
  for (int i = 0; i < n; i++) {
    memcpy(o->numbers + 3 * i, &o->body->segments[i].offset, sizeof(kg_vec3));
  }
  return changed(o, tape, x, KG_SHAPE(n, 3), o->numbers, 0.1 * o->law.layer);
}

/* ---- the rows ----------------------------------------------------------------------------------------------- */

static kg_value inverse(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 1.0), v = rate(o, t, x, o->v, 1.0);
  return kg_inverse_dynamics(t, o->operators, q, v, rate(o, t, x, o->a, 1.0));
}

static kg_value forward(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 1.0), v = rate(o, t, x, o->v, 1.0);
  return kg_forward_dynamics(t, o->operators, q, v, rate(o, t, x, o->a, 1.0));
}

static kg_value positions(cli_operators *o, kg_tape *t, kg_value x)
{
  return kg_joint_positions(t, o->operators, state(o, t, x, 1.0));
}

static kg_value velocities(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 1.0);
  return kg_joint_velocities(t, o->operators, q, rate(o, t, x, o->v, 1.0));
}

static kg_value accelerations(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 1.0), v = rate(o, t, x, o->v, 1.0);
  return kg_joint_accelerations(t, o->operators, q, v, rate(o, t, x, o->a, 1.0));
}

static kg_value points(cli_operators *o, kg_tape *t, kg_value x)
{
  return kg_point_positions(t, o->operators, state(o, t, x, 1.0));
}

static kg_value generalised(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 1.0);
  return kg_point_forces(t, o->operators, q, forces(o, t, x));
}

static kg_value contacts(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, o->law.layer), v = rate(o, t, x, o->v, o->law.stick);
  return kg_contact_forces(t, o->operators, q, v, law(o, t, x));
}

static kg_value step_in_contact(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, 0.1 * o->law.layer), v = rate(o, t, x, o->v, o->law.stick);
  const kg_value tau = rate(o, t, x, NULL, 0.01), p = law(o, t, x), m = masses(o, t, x);
  return kg_implicit_step(t, o->operators, q, v, tau, p, m, offsets(o, t, x));
}

static kg_value step_in_flight(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value none = {0};
  const kg_value q = state(o, t, x, 0.01), v = rate(o, t, x, o->v, 0.1);
  const kg_value tau = rate(o, t, x, NULL, 0.1), m = masses(o, t, x);
  return kg_implicit_step(t, o->operators, q, v, tau, none, m, offsets(o, t, x));
}

/* 3 cm lower than where it touches */
static kg_value sunk(cli_operators *o, kg_tape *t, kg_value x)
{
  const kg_value q = state(o, t, x, o->law.layer);
  memset(o->numbers, 0, (size_t)o->body->nq * sizeof *o->numbers);
  o->numbers[1] = -0.03;
  return kg_add(t, q, kg_constant(t, KG_SHAPE(o->body->nq), o->numbers));
}

static kg_value collision(cli_operators *o, kg_tape *t, kg_value x)
{
  return kg_scale(t, kg_collision_loss(t, o->operators, sunk(o, t, x)), 1e3);
}

static kg_value corrected(cli_operators *o, kg_tape *t, kg_value x)
{
  return kg_corrected_pose(t, o->operators, sunk(o, t, x));
}

/* the state three times, moved a little, with torques and forces in the middle */
static kg_value loss(cli_operators *o, kg_tape *t, kg_value x)
{
  const int nq = o->body->nq, nv = o->body->nv, points_count = o->body->point_count;
  for (int k = 0; k < LOSS_FRAMES; k++) {
    double *q = o->numbers + k * nq, *d = o->numbers + LOSS_FRAMES * nq;
    for (int c = 0; c < nv; c++) {
      d[c] = k * o->dt * o->v[c] + 0.5 * k * k * o->dt * o->dt * o->a[c];
    }
    kg_body_integrate(o->body, q, o->q, d);
  }
  const kg_value q = changed(o, t, x, KG_SHAPE(LOSS_FRAMES, nq), o->numbers, 0.1 * o->dt);
  const kg_value tau = kg_reshape(t, rate(o, t, x, o->a, 1.0), KG_SHAPE(1, nv));
  const kg_value f = kg_reshape(t, forces(o, t, x), KG_SHAPE(1, points_count, 3));
  return kg_dynamics_loss(t, o->operators, o->dt, q, (kg_value){0},
                          kg_broadcast(t, tau, KG_SHAPE(LOSS_FRAMES, nv)),
                          kg_broadcast(t, f, KG_SHAPE(LOSS_FRAMES, points_count, 3)));
}

/* inputs by letter: q nq; v, a, t nv; f forces; l law; m masses; o offsets; Q a motion. slack: feet that stick make
 * systems of condition 1e8, and an entry is judged by its own size however large its neighbours are. */
typedef struct row {
  const char *name, *inputs;
  bool in_contact;
  double slack; /* times the tolerances */
  kg_value (*record)(cli_operators *o, kg_tape *tape, kg_value x);
} row;

static const row table[] = {
  {"inverse_dynamics", "qva", false, 1, inverse},
  {"forward_dynamics", "qvt", false, 1, forward},
  {"joint_positions", "q", false, 1, positions},
  {"joint_velocities", "qv", false, 1, velocities},
  {"joint_accelerations", "qva", false, 1, accelerations},
  {"point_positions", "q", false, 1, points},
  {"point_forces", "qf", false, 1, generalised},
  {"contact_forces", "qvl", true, 1, contacts},
  {"implicit_step in contact", "qvtlmo", true, 20, step_in_contact},
  {"implicit_step in flight", "qvtmo", false, 1, step_in_flight},
  {"collision_loss", "q", true, 1, collision},
  {"corrected_pose", "q", true, 1, corrected},
  {"dynamics_loss", "Qtf", false, 1, loss},
};

int cli_operators_count(void)
{
  return (int)KG_COUNT_OF(table);
}

const char *cli_operators_name(int i)
{
  return table[i].name;
}

bool cli_operators_in_contact(int i)
{
  return table[i].in_contact;
}

static int inputs_of(const cli_operators *o, const char *letters)
{
  const kg_body *b = o->body;
  int count = 0;
  for (; *letters; letters++) {
    const int moved = b->point_count < FORCES ? b->point_count : FORCES;
    count += *letters == 'q'   ? b->nq
             : *letters == 'Q' ? LOSS_FRAMES * b->nq
             : *letters == 'f' ? 3 * moved
             : *letters == 'l' ? KG_CONTACT_PARAM_COUNT
             : *letters == 'm' ? b->segment_count
             : *letters == 'o' ? 3 * b->segment_count
                               : b->nv;
  }
  return count;
}

static kg_value record(kg_tape *tape, kg_value x, void *operators)
{
  cli_operators *o = operators;
  o->at = 0;
  const kg_value y = table[o->row].record(o, tape, x);
  return kg_reshape(tape, y, KG_SHAPE((int32_t)(kg_is_null(y) ? 1 : kg_size_of(tape, y))));
}

kg_status cli_operators_check(cli_operators *operators, int i, const double *q, const double *v,
                              const double *a, const kg_gradcheck_def *def,
                              kg_gradcheck_report *report, kg_error *error)
{
  cli_operators *o = operators;
  const int count = inputs_of(o, table[i].inputs);
  const kg_arena_mark mark = kg_arena_mark_of(&o->arena);
  const double *x = KG_ARENA_ARRAY(&o->arena, double, count);
  kg_gradcheck_def own = *def;
  own.tolerance *= table[i].slack;
  own.dot_tolerance *= table[i].slack;
  o->row = i;
  o->q = q;
  o->v = v;
  o->a = a;
  const kg_status status =
    x ? kg_gradcheck_recorded(table[i].name, record, o, KG_SHAPE(count), x, &own, report, error)
      : KG_ERR_NO_MEMORY;
  kg_arena_rewind(&o->arena, mark);
  return status;
}

/* ---- object ------------------------------------------------------------------------------------------------- */

static void set_passive(cli_operators *o)
{
  for (int i = 0; i < o->body->segment_count; i++) {
    o->passive[i] = (kg_joint_passive){.stiffness = 3.0,
                                       .damping = 0.1,
                                       .rest = kg_quat_exp(kg_vec3_make(0.1, -0.2, 0.1 * i)),
                                       .limit_low = {-0.3, -0.4, -0.2},
                                       .limit_high = {0.2, 0.1, 0.3},
                                       .limit_stiffness = 10.0};
  }
}

/* Solved more tightly than usual, so that differences are those of the function. */
static kg_status create_step_operators(cli_operators *o, const kg_scene *scene)
{
  kg_step_def def = kg_step_default_def(o->body);
  def.scene = scene;
  def.passive = o->passive;
  def.joint_damping = 0.5;
  def.tolerance = 1e-11;
  def.contact.stick = 3e-3; /* ten times softer: its steps have a tenth of the condition */
  o->law = def.contact;
  return kg_dynamics_operators_create(&o->operators, &def, o->dt);
}

kg_status cli_operators_create(cli_operators **operators, const kg_body *body,
                               const kg_scene *scene, double dt)
{
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  *operators = NULL;
  cli_operators *o = KG_ARENA_ARRAY(&arena, cli_operators, 1);
  kg_joint_passive *passive = KG_ARENA_ARRAY(&arena, kg_joint_passive, body->segment_count);
  const int most = LOSS_FRAMES * body->nq + body->nv + 3 * FORCES;
  double *numbers = KG_ARENA_ARRAY(&arena, double, most);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  *o = (cli_operators){.body = body, .dt = dt, .passive = passive, .numbers = numbers};
  o->arena = arena;
  set_passive(o);
  const kg_status status = create_step_operators(o, scene);
  if (status != KG_OK) {
    cli_operators_destroy(o);
    return status;
  }
  *operators = o;
  return KG_OK;
}

void cli_operators_destroy(cli_operators *operators)
{
  if (!operators) return;
  kg_dynamics_operators_destroy(operators->operators);
  kg_arena arena = operators->arena; /* the arena holds the object itself */
  kg_arena_release(&arena);
}
