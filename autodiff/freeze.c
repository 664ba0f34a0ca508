/* Freezing: from a record on a tape to a program.
 *
 *   varying   depends on an input of the program; the rest keeps its recorded numbers
 *   needed    an output, a comparison that was asked (kg_is_less), or an operand of something
 *             needed
 *   held      its numbers are read by a run: varying and needed, or a constant such a one reads
 *   same      the first value made by the same operator of the same operands. The later one takes
 *             over its numbers but stays a node, so that adjoints are summed as they would be on
 *             the tape. Equal constants, having no adjoints, become one node. */
#include "autodiff/attributes.h"
#include "autodiff/frozen.h"
#include "autodiff/tape.h"

#include <stdlib.h>
#include <string.h>

typedef struct trait {
  uint32_t same; /* tape index; 0: none found yet */
  uint32_t at;   /* index in the program; 0: not there */
  bool is_input, varying, needed, held, is_run;
} trait;

typedef struct freezer {
  const kg_tape *tape;
  kg_program *program;
  kg_arena scratch;
  trait *trait;    /* (nodes on the tape) */
  uint32_t *table; /* (slots) first nodes of their kind, by hash */
  size_t slots;    /* a power of two */
  bool guarded;    /* comparisons that were asked are kept */
} freezer;

/* -- nodes of the tape, scalars and blocks alike ----------------------------------------------- */

/* A node as a block: of a scalar node it is made up, with numbers, operands and attributes here. */
typedef struct view {
  kg_block block;
  kg_elementwise elementwise;
  size_t index;
} view;

static bool is_leaf(const kg_node *node)
{
  return node->op == kg_op_input || node->op == kg_op_constant;
}

static int operands_of_scalar(const kg_node *node)
{
  if (is_leaf(node)) return 0;
  return node->input[1] && node->op != kg_op_element ? 2 : 1;
}

static void view_scalar(const freezer *f, const kg_node *node, view *v)
{
  v->block = (kg_block){.kernel = &f->tape->graph.kernels[node->op],
                        .count = operands_of_scalar(node),
                        .input = node->input,
                        .size = 1,
                        .data = (void *)&node->is.value};
  if (node->op == kg_op_element) {
    v->index = node->input[1];
    v->block.attributes = &v->index;
    v->block.attribute_bytes = sizeof v->index;
  } else if (v->block.count) {
    const double p = v->block.count == 1 ? node->partial[1] : 0;
    v->elementwise = (kg_elementwise){.p = p};
    v->block.attributes = &v->elementwise;
    v->block.attribute_bytes = KG_FLAT_BYTES;
  }
}

static const kg_block *view_node(const freezer *f, uint32_t index, view *v)
{
  const kg_node *node = &f->tape->graph.node[index];
  if (node->is_block) return node->is.block;
  view_scalar(f, node, v);
  return &v->block;
}

static const kg_node *tape_node(const freezer *f, uint32_t index)
{
  return &f->tape->graph.node[index];
}

/* -- what depends on what ---------------------------------------------------------------------- */

static void find_varying(freezer *f)
{
  for (uint32_t i = 1; i < f->tape->graph.count; ++i) {
    view v;
    const kg_block *block = view_node(f, i, &v);
    f->trait[i].varying = f->trait[i].is_input;
    for (int k = 0; k < block->count && !f->trait[i].varying; ++k) {
      f->trait[i].varying = f->trait[kg_index(block->input[k])].varying;
    }
  }
}

/* Outputs are marked already. */
static void find_needed(freezer *f)
{
  for (uint32_t i = f->tape->graph.count - 1; i > 0; --i) {
    trait *t = &f->trait[i];
    if (f->guarded && t->varying && tape_node(f, i)->op == kg_op_is_less) {
      t->needed = t->held = true;
    }
    if (!t->needed || t->is_input) continue;
    view v;
    const kg_block *block = view_node(f, i, &v);
    for (int k = 0; k < block->count; ++k) {
      trait *operand = &f->trait[kg_index(block->input[k])];
      operand->needed = true;
      operand->held = operand->held || t->varying;
    }
  }
}

/* -- equal values ------------------------------------------------------------------------------ */

static uint64_t mix(uint64_t hash, const void *bytes, size_t count)
{
  const unsigned char *byte = bytes; /* FNV-1a */
  for (size_t i = 0; i < count; ++i) {
    hash = (hash ^ byte[i]) * 1099511628211u;
  }
  return hash;
}

static size_t number_bytes(const freezer *f, const kg_block *block)
{
  return block->size * f->tape->graph.number;
}

static uint64_t hash_of(const freezer *f, uint32_t index, const kg_block *block)
{
  const uint64_t start = 14695981039346656037u;
  if (!f->trait[index].varying) return mix(start, block->data, number_bytes(f, block));
  uint64_t hash = mix(start, &tape_node(f, index)->op, sizeof(uint16_t));
  hash = mix(hash, block->attributes, block->attribute_bytes);
  for (int k = 0; k < block->count; ++k) {
    hash = mix(hash, &f->trait[kg_index(block->input[k])].same, sizeof(uint32_t));
  }
  return hash;
}

static bool same_bytes(const void *a, const void *b, size_t bytes)
{
  return bytes == 0 || memcmp(a, b, bytes) == 0;
}

static bool are_same(const freezer *f, uint32_t i, uint32_t j)
{
  view v, w;
  const kg_block *a = view_node(f, i, &v), *b = view_node(f, j, &w);
  if (f->trait[i].varying != f->trait[j].varying || !kg_same_shape(a->shape, b->shape))
    return false;
  if (!f->trait[i].varying) return same_bytes(a->data, b->data, number_bytes(f, a));
  if (tape_node(f, i)->op != tape_node(f, j)->op || a->kernel != b->kernel ||
      a->count != b->count || a->attribute_bytes != b->attribute_bytes ||
      !same_bytes(a->attributes, b->attributes, a->attribute_bytes)) {
    return false;
  }
  for (int k = 0; k < a->count; ++k) {
    if (f->trait[kg_index(a->input[k])].same != f->trait[kg_index(b->input[k])].same) return false;
  }
  return true;
}

static uint32_t first_of_its_kind(freezer *f, uint32_t index)
{
  view v;
  size_t slot = hash_of(f, index, view_node(f, index, &v));
  while (f->table[slot &= f->slots - 1] && !are_same(f, f->table[slot], index)) {
    ++slot;
  }
  if (!f->table[slot]) f->table[slot] = index;
  return f->table[slot];
}

static void find_same(freezer *f)
{
  for (uint32_t i = 1; i < f->tape->graph.count; ++i) {
    trait *t = &f->trait[i];
    t->same = t->is_input || !t->held ? i : first_of_its_kind(f, i);
  }
}

/* -- building ---------------------------------------------------------------------------------- */

static void *numbers(kg_program *p, size_t size)
{
  return size ? kg_arena_take(&p->arena, size * p->graph.lanes * p->graph.number, 64) : NULL;
}

/* the recorded numbers, in every lane */
static void fill(const freezer *f, const kg_block *from, const kg_block *to)
{
  const kg_arithmetic recorded = f->tape->precision == KG_DOUBLE ? KG_F64 : KG_F32;
  const size_t lanes = f->program->graph.lanes;
  for (size_t e = 0; e < from->size; ++e) {
    const double x = kg_real_part(recorded, from->data, e);
    for (size_t lane = 0; lane < lanes; ++lane) {
      kg_put_number(f->program->arithmetic, to->data, e * lanes + lane, x);
    }
  }
}

/* Index in the program of what the operand of a node became. */
static uint32_t place_of(const freezer *f, uint32_t id)
{
  const trait *t = &f->trait[kg_index(id)];
  return t->varying ? t->at : f->trait[t->same].at;
}

/* Copies operands' ids; true when an adjoint can reach one of them. */
static bool connect(freezer *f, const kg_block *from, kg_block *block, uint32_t *input)
{
  bool active = false;
  for (int k = 0; k < from->count; ++k) {
    const uint32_t at = place_of(f, from->input[k]);
    input[k] = at ? at | KG_TENSOR : 0;
    active = active || f->program->graph.node[at].active;
  }
  block->input = input;
  return active;
}

/* Shares the numbers of an equal node, or of its operand when it renames them (reshape). */
static bool share(freezer *f, uint32_t index, const kg_block *from, kg_block *block)
{
  const kg_node *node = f->program->graph.node;
  const trait *t = &f->trait[index];
  if (t->same != index) {
    block->data = node[f->trait[t->same].at].is.block->data;
    block->saved = node[f->trait[t->same].at].is.block->saved;
    return true;
  }
  if (!from->count || from->data != kg_node_data(&f->tape->graph, from->input[0])) return false;
  block->data = node[kg_index(block->input[0])].is.block->data;
  return true;
}

static kg_block *copy_block(freezer *f, kg_op op, const kg_block *from, uint32_t **input)
{
  kg_program *p = f->program;
  kg_block *block = kg_arena_take(&p->arena, sizeof *block, 16);
  void *attributes = kg_arena_take(&p->arena, from->attribute_bytes, 16);
  *input = kg_arena_take(&p->arena, (size_t)from->count * sizeof **input, 16);
  if (kg_arena_failed(&p->arena)) return NULL;
  *block = *from;
  if (from->attribute_bytes) memcpy(attributes, from->attributes, from->attribute_bytes);
  block->attributes = attributes;
  if (from->kernel == &f->tape->graph.kernels[op]) block->kernel = &p->graph.kernels[op];
  block->data = block->saved = NULL;
  block->stamp = 0;
  return block;
}

static bool copy_tag(freezer *f, uint32_t index)
{
  kg_program *p = f->program;
  const char *text = kg_tag_at(f->tape, index), *last = p->tag[p->graph.count - 1];
  if (text && last && strcmp(text, last) == 0) {
    p->tag[p->graph.count] = last;
  } else if (text) {
    p->tag[p->graph.count] = kg_arena_text(&p->arena, text, strlen(text));
  }
  return !kg_arena_failed(&p->arena);
}

/* Node `index` of the tape as the newest node of the program; false when memory is refused. */
static bool add(freezer *f, uint32_t index)
{
  kg_program *p = f->program;
  trait *t = &f->trait[index];
  const kg_node *node = tape_node(f, index);
  const bool fixed = t->is_input || !t->varying;
  view v;
  kg_block from = *view_node(f, index, &v);
  if (fixed) from.count = 0, from.attribute_bytes = from.saved_size = 0;
  const kg_op op = t->is_input ? kg_op_input : fixed ? kg_op_constant : (kg_op)node->op;
  uint32_t *input;
  kg_block *block = copy_block(f, op, &from, &input);
  if (!block || !kg_graph_reserve(&p->graph) || !copy_tag(f, index)) return false;
  const bool active = connect(f, &from, block, input);
  if (!share(f, index, &from, block)) {
    block->data = numbers(p, block->size);
    block->saved = numbers(p, block->saved_size);
    if (kg_arena_failed(&p->arena)) return false;
    t->is_run = !fixed;
    p->info.run += !fixed;
  }
  if (fixed) fill(f, &from, block);
  if (from.count > p->graph.widest) p->graph.widest = from.count;
  t->at = p->graph.count;
  p->graph.node[p->graph.count++] = (kg_node){.is.block = block,
                                              .op = (uint16_t)op,
                                              .is_block = true,
                                              .active = node->active && (t->is_input || active)};
  return true;
}

static bool add_all(freezer *f, int input_count, const kg_value *inputs)
{
  bool fine = true;
  for (int i = 0; i < input_count && fine; ++i) {
    fine = add(f, kg_index(inputs[i].id));
  }
  for (uint32_t i = 1; i < f->tape->graph.count && fine; ++i) {
    const trait *t = &f->trait[i];
    if (t->held && !t->varying && t->same == i) fine = add(f, i);
  }
  for (uint32_t i = 1; i < f->tape->graph.count && fine; ++i) {
    const trait *t = &f->trait[i];
    if (t->held && t->varying && !t->is_input) fine = add(f, i);
  }
  return fine;
}

/* What the kernels of a node made from tape node `index` are called with. */
static bool prepare_step(freezer *f, uint32_t index)
{
  kg_program *p = f->program;
  const trait *t = &f->trait[index];
  kg_node *node = &p->graph.node[t->at];
  const kg_block *block = node->is.block;
  const void **in = KG_ARENA_ARRAY(&p->arena, const void *, block->count);
  kg_step step = {.kernel = block->kernel,
                  .block = node->is.block,
                  .operand = KG_ARENA_ARRAY(&p->arena, kg_block *, block->count),
                  .node = t->at,
                  .is_run = t->is_run,
                  .active = node->active,
                  .writes = kg_writes_adjoints(node)};
  if (kg_arena_failed(&p->arena)) return false;
  step.call = kg_block_call(&p->graph, block, in);
  for (int k = 0; k < block->count; ++k) {
    const kg_node *operand = &p->graph.node[kg_index(block->input[k])];
    step.operand[k] = operand->active ? operand->is.block : NULL;
  }
  p->step[p->step_count++] = step;
  return true;
}

/* once all nodes are there */
static bool prepare_steps(freezer *f)
{
  kg_program *p = f->program;
  bool fine = true;
  p->step = KG_ARENA_ARRAY(&p->arena, kg_step, p->graph.count);
  for (uint32_t i = 1; i < f->tape->graph.count && fine && p->step; ++i) {
    const trait *t = &f->trait[i];
    if (t->at && t->varying && !t->is_input) fine = prepare_step(f, i);
  }
  return fine && p->step;
}

/* -- creation ---------------------------------------------------------------------------------- */

static kg_status refuse(kg_error *error, kg_status status, const char *what, int i)
{
  return kg_fail(error, status, "", 0, 0, "program: %s %d", what, i);
}

static kg_status check_values(const kg_tape *tape, int input_count, const kg_value *inputs,
                              int output_count, const kg_value *outputs, kg_error *error)
{
  if (tape->error.status != KG_OK) {
    if (error) *error = tape->error;
    return tape->error.status;
  }
  for (int i = 0; i < input_count; ++i) {
    if (!inputs[i].id || kg_index(inputs[i].id) >= tape->graph.count ||
        !is_leaf(kg_node_of(tape, inputs[i]))) {
      return refuse(error, KG_ERR_UNSUPPORTED, "neither an input nor a constant of the tape: input",
                    i);
    }
    for (int k = 0; k < i; ++k) {
      if (inputs[k].id == inputs[i].id)
        return refuse(error, KG_ERR_UNSUPPORTED, "given twice: input", i);
    }
  }
  for (int o = 0; o < output_count; ++o) {
    if (!outputs[o].id || kg_index(outputs[o].id) >= tape->graph.count) {
      return refuse(error, KG_ERR_UNDEFINED, "null or rewound: output", o);
    }
  }
  return KG_OK;
}

static void count_fates(freezer *f)
{
  kg_program_info *info = &f->program->info;
  info->recorded = f->tape->graph.count - 1;
  for (uint32_t i = 1; i < f->tape->graph.count; ++i) {
    const trait *t = &f->trait[i];
    info->dead += !t->needed && !t->is_input;
    info->constant += t->needed && !t->varying;
    info->shared += t->needed && t->varying && !t->is_input;
  }
  info->shared -= info->run; /* what is neither evaluated nor constant has another one's numbers */
}

static bool begin(freezer *f, int input_count, const kg_value *inputs, int output_count,
                  const kg_value *outputs)
{
  const uint32_t count = f->tape->graph.count;
  kg_program *p = f->program;
  for (f->slots = 16; f->slots < 2 * (size_t)count; f->slots *= 2) {
  }
  f->trait = KG_ARENA_ARRAY(&f->scratch, trait, count);
  f->table = KG_ARENA_ARRAY(&f->scratch, uint32_t, f->slots);
  p->input = KG_ARENA_ARRAY(&p->arena, uint32_t, input_count);
  p->output = KG_ARENA_ARRAY(&p->arena, uint32_t, output_count);
  p->tag = KG_ARENA_ARRAY(&p->arena, const char *, count);
  if (kg_arena_failed(&f->scratch) || kg_arena_failed(&p->arena)) return false;
  for (int i = 0; i < input_count; ++i) {
    f->trait[kg_index(inputs[i].id)].is_input = true;
  }
  for (int o = 0; o < output_count; ++o) {
    trait *t = &f->trait[kg_index(outputs[o].id)];
    t->needed = t->held = true;
  }
  return true;
}

static bool begin_port(kg_program *p, kg_port *port, int count, const uint32_t *ids)
{
  port->count = count;
  port->at = KG_ARENA_ARRAY(&p->arena, size_t, count + 1);
  port->given = KG_ARENA_ARRAY(&p->arena, bool, count);
  if (kg_arena_failed(&p->arena)) return false;
  for (int i = 0; i < count; ++i) {
    port->at[i + 1] = port->at[i] + p->graph.node[kg_index(ids[i])].is.block->size;
  }
  return true;
}

static kg_status freeze(freezer *f, int input_count, const kg_value *inputs, int output_count,
                        const kg_value *outputs)
{
  kg_program *p = f->program;
  if (!begin(f, input_count, inputs, output_count, outputs)) return KG_ERR_NO_MEMORY;
  find_varying(f);
  find_needed(f);
  find_same(f);
  if (!add_all(f, input_count, inputs)) return KG_ERR_NO_MEMORY;
  for (int i = 0; i < input_count; ++i) {
    p->input[i] = f->trait[kg_index(inputs[i].id)].at | KG_TENSOR;
  }
  for (int o = 0; o < output_count; ++o) {
    p->output[o] = place_of(f, outputs[o].id) | KG_TENSOR;
  }
  count_fates(f);
  const bool fine = prepare_steps(f) && kg_plan_adjoints(p, &f->scratch) &&
                    begin_port(p, &p->seed, output_count, p->output) &&
                    begin_port(p, &p->tangent, input_count, p->input) &&
                    kg_graph_reserve_pointers(&p->graph);
  return fine ? KG_OK : KG_ERR_NO_MEMORY;
}

kg_program_def kg_program_default_def(void)
{
  return (kg_program_def){.lanes = 1};
}

static kg_program *new_program(const kg_program_def *def, const kg_tape *tape)
{
  const kg_allocator *allocator = def->allocator;
  kg_buffer self = {0};
  if (!kg_buffer_reserve(&self, allocator, sizeof(kg_program))) return NULL;
  kg_program *p = self.memory;
  *p = (kg_program){.info = {.lanes = def->lanes}};
  kg_arena_init(&p->arena, allocator);
  if (kg_graph_init(&p->graph, allocator) != KG_OK) {
    kg_program_destroy(p);
    return NULL;
  }
  static const size_t number[] = {
    [KG_F64] = sizeof(double), [KG_F32] = sizeof(float), [KG_C64] = 2 * sizeof(double)};
  p->arithmetic = def->arithmetic_complex ? KG_C64 : tape->precision == KG_DOUBLE ? KG_F64 : KG_F32;
  p->graph.number = number[p->arithmetic];
  p->graph.lanes = (size_t)def->lanes;
  p->graph.kernels = kg_kernels_for(p->arithmetic, tape->simd);
  return p;
}

kg_status kg_freeze(const kg_program_def *def, bool guarded, const kg_tape *tape, int input_count,
                    const kg_value *inputs, int output_count, const kg_value *outputs,
                    kg_program **program, kg_error *error)
{
  *program = NULL;
  kg_status status = check_values(tape, input_count, inputs, output_count, outputs, error);
  if (status != KG_OK) return status;
  freezer f = {.tape = tape, .program = new_program(def, tape), .guarded = guarded};
  if (!f.program) return kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "no memory for a program");
  f.program->info.inputs = input_count;
  f.program->info.outputs = output_count;
  kg_arena_init(&f.scratch, def->allocator);
  status = freeze(&f, input_count, inputs, output_count, outputs);
  kg_arena_release(&f.scratch);
  if (status != KG_OK) {
    kg_program_destroy(f.program);
    return kg_fail(error, status, "", 0, 0, "no memory for a program of %u values",
                   f.tape->graph.count - 1);
  }
  *program = f.program;
  return KG_OK;
}

kg_status kg_program_create(const kg_program_def *def, const kg_tape *tape, int input_count,
                            const kg_value *inputs, int output_count, const kg_value *outputs,
                            kg_program **program, kg_error *error)
{
  const kg_program_def settings = def ? *def : kg_program_default_def();
  if (settings.lanes < 1) {
    *program = NULL;
    return kg_fail(error, KG_ERR_SHAPE, "", 0, 0, "program: %d lanes; at least 1", settings.lanes);
  }
  return kg_freeze(&settings, true, tape, input_count, inputs, output_count, outputs, program,
                   error);
}
