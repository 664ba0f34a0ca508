/* Rules for one item (operators.h) as primitives of the tape: leading dimensions, unit quaternions,
 * operands that may be left out. */
#include "physics/operators.h"
#include "physics/physics.h"

#include <string.h>

/* ---- shapes -----------------------------------------------------------------------------------*/

static bool is_shared(kg_rule_size size)
{
  return size == KG_RULE_LAW || size == KG_RULE_MASSES || size == KG_RULE_OFFSETS;
}

/* the last extents of an operand: one or two; returns how many */
static int tail_of(const kg_body *body, kg_rule_size size, int32_t tail[2])
{
  const int32_t rows[] = {[KG_RULE_NONE] = 0,
                          [KG_RULE_STATE] = body->nq,
                          [KG_RULE_RATE] = body->nv,
                          [KG_RULE_JOINTS] = body->segment_count,
                          [KG_RULE_POINTS] = body->point_count,
                          [KG_RULE_BOTH] = body->nq + body->nv,
                          [KG_RULE_ONE] = 1,
                          [KG_RULE_LAW] = KG_CONTACT_PARAM_COUNT,
                          [KG_RULE_MASSES] = body->segment_count,
                          [KG_RULE_OFFSETS] = body->segment_count};
  tail[0] = rows[size];
  tail[1] = 3;
  return size == KG_RULE_JOINTS || size == KG_RULE_POINTS || size == KG_RULE_OFFSETS ? 2 : 1;
}

static size_t numbers_of(const kg_body *body, kg_rule_size size)
{
  int32_t tail[2];
  return tail_of(body, size, tail) == 2 ? 3 * (size_t)tail[0] : (size_t)tail[0];
}

/* whether a shape is lead (or nothing, for a shared operand) and the tail */
static bool has_tail(const kg_shape *shape, const kg_shape *lead, const int32_t *tail, int count)
{
  if (shape->rank != lead->rank + count) return false;
  return memcmp(shape->dim, lead->dim, (size_t)lead->rank * sizeof *tail) == 0 &&
         memcmp(shape->dim + lead->rank, tail, (size_t)count * sizeof *tail) == 0;
}

/* the leading dimensions are those of operand 0; one number is saved for each item */
static kg_status shape_of_use(void *user, int count, const kg_shape *shapes, kg_shape *result,
                              size_t *saved)
{
  const kg_rule_use *use = user;
  const kg_body *body = use->operators->body;
  const kg_shape nothing = {0, {0}};
  kg_shape lead = shapes[0];
  int at = 0;
  if (lead.rank < 1) return KG_ERR_SHAPE;
  lead.rank--;
  for (int k = 0; k < KG_RULE_OPERANDS; k++) {
    if (!(use->present >> k & 1)) continue;
    int32_t tail[2];
    const kg_rule_size size = use->rule->operands[k];
    const int extents = tail_of(body, size, tail);
    if (at >= count || !has_tail(&shapes[at++], is_shared(size) ? &nothing : &lead, tail, extents))
      return KG_ERR_SHAPE;
  }
  int32_t tail[2];
  const int extents = tail_of(body, use->rule->result, tail);
  *saved = kg_shape_size(&lead);
  *result = lead;
  if (lead.rank + extents > KG_MAX_RANK) return KG_ERR_SHAPE;
  for (int k = 0; k < extents; k++) {
    result->dim[result->rank++] = tail[k];
  }
  return KG_OK;
}

/* ---- quaternions ------------------------------------------------------------------------------*/

/* operators->q = q with unit quaternions; false where there is a zero one or no number */
static bool normalise(kg_dynamics_operators *o, const double *q)
{
  memcpy(o->q, q, 3 * sizeof *q);
  for (int i = 0; i < o->body->segment_count; i++) {
    const kg_quat r = kg_state_quat(q, i);
    const double size = kg_quat_dot(r, r);
    if (!(size > 0.0 && size < INFINITY)) return false;
    kg_state_set_quat(o->q, i, kg_quat_normalized(r));
  }
  return true;
}

/* Adds the gradient by the tangent of q to that by its numbers: a change d of a quaternion turns it
 * by 2 u* d / |q|, u = q / |q|. */
static void add_tangent(kg_dynamics_operators *o, const double *q, double *q_bar)
{
  for (int k = 0; k < 3; k++) {
    q_bar[k] += o->q_bar[k];
  }
  for (int i = 0; i < o->body->segment_count; i++) {
    const kg_vec3 t = kg_load3(o->q_bar + 3 + 3 * i);
    const kg_quat r = kg_state_quat(q, i), unit = kg_state_quat(o->q, i);
    const kg_quat along = kg_quat_mul(unit, kg_quat_make(0.0, t.x, t.y, t.z));
    const double s = 2.0 / sqrt(kg_quat_dot(r, r));
    double *bar = q_bar + 3 + 4 * i;
    bar[0] += s * along.w;
    bar[1] += s * along.x;
    bar[2] += s * along.y;
    bar[3] += s * along.z;
  }
}

/* ---- items ------------------------------------------------------------------------------------*/

/* Item number `index` of a call; adjoints NULL on the way forward. */
static kg_rule_item item_of(const kg_primitive_call *call, size_t index, const double *adjoint,
                            double *const *in_adjoints)
{
  const kg_rule_use *use = call->user;
  const kg_body *body = use->operators->body;
  const size_t size = numbers_of(body, use->rule->result);
  kg_rule_item item = {.operators = use->operators};
  item.out = call->out + index * size;
  item.saved = call->saved + index;
  item.out_bar = adjoint ? adjoint + index * size : NULL;
  for (int k = 0, at = 0; k < KG_RULE_OPERANDS; k++) {
    if (!(use->present >> k & 1)) continue;
    const kg_rule_size kind = use->rule->operands[k];
    const size_t start = is_shared(kind) ? 0 : index * numbers_of(body, kind);
    item.in[k] = call->in[at] + start;
    item.bar[k] = in_adjoints && in_adjoints[at] ? in_adjoints[at] + start : NULL;
    at++;
  }
  return item;
}

static size_t items_of(const kg_primitive_call *call)
{
  const kg_rule_use *use = call->user;
  return kg_shape_size(&call->shape) / numbers_of(use->operators->body, use->rule->result);
}

static kg_status forward_of_use(const kg_primitive_call *call)
{
  const kg_rule_use *use = call->user;
  kg_dynamics_operators *o = use->operators;
  kg_status status = KG_OK;
  for (size_t k = 0; k < items_of(call) && status == KG_OK; k++) {
    kg_rule_item item = item_of(call, k, NULL, NULL);
    if (!normalise(o, item.in[0])) return KG_ERR_UNDEFINED;
    item.in[0] = o->q;
    status = use->rule->forward(&item);
  }
  return status;
}

static kg_status vjp_of_use(const kg_primitive_call *call, const double *adjoint,
                            double *const *in_adjoints)
{
  const kg_rule_use *use = call->user;
  kg_dynamics_operators *o = use->operators;
  kg_status status = KG_OK;
  for (size_t k = 0; k < items_of(call) && status == KG_OK; k++) {
    kg_rule_item item = item_of(call, k, adjoint, in_adjoints);
    const double *q = item.in[0];
    double *q_bar = item.bar[0];
    if (!normalise(o, q)) return KG_ERR_UNDEFINED;
    memset(o->q_bar, 0, (size_t)o->body->nv * sizeof *q);
    item.in[0] = o->q;
    item.bar[0] = q_bar ? o->q_bar : NULL;
    status = use->rule->vjp(&item);
    if (q_bar && status == KG_OK) add_tangent(o, q, q_bar);
  }
  return status;
}

/* ---- object -----------------------------------------------------------------------------------*/

static kg_status copy_body(kg_body **copy, const kg_body *body, const kg_allocator *allocator)
{
  return kg_body_create(copy, body->segments, body->segment_count, body->points, body->point_count,
                        allocator);
}

static kg_status create_parts(kg_dynamics_operators *o, const kg_step_def *def)
{
  kg_status status = copy_body(&o->body, def->body, def->allocator);
  if (status == KG_OK) status = copy_body(&o->source, def->body, def->allocator);
  if (status != KG_OK) return status;
  kg_step_def step = *def;
  step.body = o->body;
  step.scene = def->scene ? &o->scene : NULL;
  status = kg_step_create(&o->step, &step);
  if (status == KG_OK) status = kg_dynamics_create(&o->dynamics, o->source, def->allocator);
  if (status != KG_OK) return status;
  kg_dynamics_set_gravity(o->dynamics, def->gravity);
  kg_correction_def correction = kg_correction_default_def(o->source, &o->scene);
  correction.kkt_tolerance = 1e-11;
  correction.allocator = def->allocator;
  return kg_correction_create(&o->correction, &correction);
}

kg_status kg_dynamics_operators_create(kg_dynamics_operators **operators, const kg_step_def *step,
                                       double dt)
{
  KG_ASSERT(dt > 0.0);
  *operators = NULL;
  kg_arena arena;
  kg_arena_init(&arena, step->allocator);
  kg_dynamics_operators *o = KG_ARENA_ARRAY(&arena, kg_dynamics_operators, 1);
  const kg_body *body = step->body;
  double *q = KG_ARENA_ARRAY(&arena, double, body->nq);
  double *q_bar = KG_ARENA_ARRAY(&arena, double, body->nv);
  double *end_bar = KG_ARENA_ARRAY(&arena, double, body->nv);
  kg_vec3 *x = KG_ARENA_ARRAY(&arena, kg_vec3, body->point_count);
  kg_vec3 *u = KG_ARENA_ARRAY(&arena, kg_vec3, body->point_count);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  *o = (kg_dynamics_operators){
    .law = step->contact, .dt = dt, .q = q, .q_bar = q_bar, .end_bar = end_bar, .x = x, .u = u};
  if (step->scene) o->scene = *step->scene;
  o->arena = arena;
  const kg_status status = create_parts(o, step);
  if (status != KG_OK) {
    kg_dynamics_operators_destroy(o);
    return status;
  }
  *operators = o;
  return KG_OK;
}

void kg_dynamics_operators_destroy(kg_dynamics_operators *operators)
{
  if (!operators) return;
  kg_step_destroy(operators->step);
  kg_correction_destroy(operators->correction);
  kg_dynamics_destroy(operators->dynamics);
  kg_body_destroy(operators->source);
  kg_body_destroy(operators->body);
  kg_arena arena = operators->arena; /* the arena holds the object itself */
  kg_arena_release(&arena);
}

/* ---- recording --------------------------------------------------------------------------------*/

/* The primitive of a rule with these operands; made at its first use. */
static const kg_primitive *primitive_of(kg_dynamics_operators *o, const kg_rule *rule,
                                        unsigned present)
{
  int k = 0;
  while (k < o->use_count && !(o->uses[k].rule == rule && o->uses[k].present == present)) {
    k++;
  }
  KG_ASSERT(k < KG_RULE_MAX_USES);
  if (k == o->use_count) {
    o->use_count++;
    o->uses[k] = (kg_rule_use){o, rule, present};
    o->primitives[k] = (kg_primitive){.name = rule->name,
                                      .user = &o->uses[k],
                                      .shape = shape_of_use,
                                      .forward = forward_of_use,
                                      .vjp = vjp_of_use};
  }
  return &o->primitives[k];
}

/* operands[k] of the rule; `needed` of them must be there, the others may be null */
static kg_value record(kg_tape *tape, kg_dynamics_operators *o, kg_rule_name name, int needed,
                       const kg_value operands[KG_RULE_OPERANDS])
{
  kg_value given[KG_RULE_OPERANDS];
  unsigned present = 0;
  int count = 0;
  for (int k = 0; k < KG_RULE_OPERANDS; k++) {
    if (k >= needed && kg_is_null(operands[k])) continue;
    present |= 1u << k;
    given[count++] = operands[k];
  }
  return kg_apply(tape, primitive_of(o, &kg_rules[name], present), count, given);
}

kg_value kg_inverse_dynamics(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                             kg_value v, kg_value a)
{
  return record(tape, operators, KG_RULE_INVERSE, 3, (kg_value[KG_RULE_OPERANDS]){q, v, a});
}

kg_value kg_forward_dynamics(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                             kg_value v, kg_value tau)
{
  return record(tape, operators, KG_RULE_FORWARD, 3, (kg_value[KG_RULE_OPERANDS]){q, v, tau});
}

kg_value kg_joint_positions(kg_tape *tape, kg_dynamics_operators *operators, kg_value q)
{
  return record(tape, operators, KG_RULE_POSITIONS, 1, (kg_value[KG_RULE_OPERANDS]){q});
}

kg_value kg_joint_velocities(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                             kg_value v)
{
  return record(tape, operators, KG_RULE_VELOCITIES, 2, (kg_value[KG_RULE_OPERANDS]){q, v});
}

kg_value kg_joint_accelerations(kg_tape *tape, kg_dynamics_operators *operators, kg_value q,
                                kg_value v, kg_value a)
{
  return record(tape, operators, KG_RULE_ACCELERATIONS, 3, (kg_value[KG_RULE_OPERANDS]){q, v, a});
}

kg_value kg_point_positions(kg_tape *tape, kg_dynamics_operators *operators, kg_value q)
{
  return record(tape, operators, KG_RULE_POINT_POSITIONS, 1, (kg_value[KG_RULE_OPERANDS]){q});
}

kg_value kg_point_forces(kg_tape *tape, kg_dynamics_operators *operators, kg_value q, kg_value f)
{
  return record(tape, operators, KG_RULE_POINT_FORCES, 2, (kg_value[KG_RULE_OPERANDS]){q, f});
}

kg_value kg_contact_forces(kg_tape *tape, kg_dynamics_operators *operators, kg_value q, kg_value v,
                           kg_value law)
{
  return record(tape, operators, KG_RULE_CONTACT_FORCES, 2,
                (kg_value[KG_RULE_OPERANDS]){q, v, law});
}

kg_value kg_implicit_step(kg_tape *tape, kg_dynamics_operators *operators, kg_value q, kg_value v,
                          kg_value tau, kg_value law, kg_value masses, kg_value offsets)
{
  return record(tape, operators, KG_RULE_STEP, 3,
                (kg_value[KG_RULE_OPERANDS]){q, v, tau, law, masses, offsets});
}

kg_value kg_collision_loss(kg_tape *tape, kg_dynamics_operators *operators, kg_value q)
{
  return record(tape, operators, KG_RULE_COLLISION, 1, (kg_value[KG_RULE_OPERANDS]){q});
}

kg_value kg_corrected_pose(kg_tape *tape, kg_dynamics_operators *operators, kg_value q)
{
  return record(tape, operators, KG_RULE_CORRECTION, 1, (kg_value[KG_RULE_OPERANDS]){q});
}
