/* Running a frozen program: values, adjoints, tangents. It is made in freeze.c. */
#include "autodiff/attributes.h"
#include "autodiff/frozen.h"

#include <stdio.h>
#include <string.h>

void kg_program_destroy(kg_program *program)
{
  if (!program) return;
  const kg_allocator *allocator = program->graph.allocator;
  kg_buffer_release(&program->seed.memory, allocator);
  kg_buffer_release(&program->tangent.memory, allocator);
  kg_graph_release(&program->graph);
  kg_arena_release(&program->arena);
  kg_buffer self = {program, sizeof *program};
  kg_buffer_release(&self, allocator);
}

kg_program_info kg_program_describe(const kg_program *program)
{
  const kg_graph *graph = &program->graph;
  kg_program_info info = program->info;
  info.bytes = sizeof *program + kg_arena_bytes(&program->arena) +
               graph->capacity * sizeof *graph->node + graph->scalar.bytes + graph->tensor.bytes +
               graph->pointers.bytes + graph->given.bytes + graph->scratch.bytes +
               (graph->child ? kg_tape_bytes(graph->child) : 0) + program->seed.memory.bytes +
               program->tangent.memory.bytes;
  return info;
}

const kg_error *kg_program_error(const kg_program *program)
{
  return &program->error;
}

static const kg_block *block_of(const kg_program *program, uint32_t id)
{
  return program->graph.node[kg_index(id)].is.block;
}

void *kg_program_input(kg_program *program, int i)
{
  KG_ASSERT(i >= 0 && i < program->info.inputs);
  return block_of(program, program->input[i])->data;
}

const void *kg_program_output(const kg_program *program, int o)
{
  KG_ASSERT(o >= 0 && o < program->info.outputs);
  return block_of(program, program->output[o])->data;
}

size_t kg_program_input_size(const kg_program *program, int i)
{
  KG_ASSERT(i >= 0 && i < program->info.inputs);
  return block_of(program, program->input[i])->size;
}

size_t kg_program_output_size(const kg_program *program, int o)
{
  KG_ASSERT(o >= 0 && o < program->info.outputs);
  return block_of(program, program->output[o])->size;
}

/* -- values ------------------------------------------------------------------------------------ */

/* The first lane in which a comparison turned around: the guard has written the present answers. */
static size_t stale_lane(const kg_program *program, const kg_block *guard)
{
  const int64_t recorded = ((const kg_guard *)guard->attributes)->answer;
  size_t lane = 0;
  while ((kg_real_part(program->arithmetic, guard->data, lane) != 0) == (recorded != 0)) {
    ++lane;
  }
  return lane;
}

static kg_status fail(kg_program *program, kg_status status, const char *what, const char *tag,
                      const char *text)
{
  return kg_fail(&program->error, status, "", 0, 0, "%s%s%.200s%s: %s", what, tag ? " [" : "",
                 tag ? tag : "", tag ? "]" : "", text);
}

static kg_status fail_in_lane(kg_program *program, const kg_node *node, kg_status status,
                              const char *tag)
{
  const kg_graph *graph = &program->graph;
  const bool known = graph->lanes > 1 && graph->failed_lane != KG_NO_LANE;
  char text[256], lane[32] = "";
  if (known) snprintf(lane, sizeof lane, ", lane %zu", graph->failed_lane);
  snprintf(text, sizeof text, "%.200s%s", graph->detail ? graph->detail : kg_status_text(status),
           lane);
  return fail(program, status, kg_node_name(node), tag, text);
}

/* The operands' operator says more about a comparison than "is_less". */
static kg_status fail_at(kg_program *program, uint32_t index, kg_status status)
{
  const kg_node *node = &program->graph.node[index];
  const kg_block *block = node->is.block;
  const char *tag = program->tag[index];
  if (status != KG_ERR_STALE) return fail_in_lane(program, node, status, tag);
  const kg_op a = (kg_op)program->graph.node[kg_index(block->input[0])].op;
  const kg_op b = (kg_op)program->graph.node[kg_index(block->input[1])].op;
  char text[200];
  snprintf(text, sizeof text, "%s (%s < %s), lane %zu", kg_status_text(status), kg_op_name(a),
           kg_op_name(b), stale_lane(program, block));
  return fail(program, status, kg_op_name((kg_op)node->op), tag, text);
}

kg_status kg_program_run(kg_program *program)
{
  kg_graph *graph = &program->graph;
  program->ran = false;
  graph->detail = NULL;
  for (const kg_step *step = program->step; step < program->step + program->step_count; ++step) {
    const kg_status status = step->is_run ? step->kernel->forward(&step->call) : KG_OK;
    if (status != KG_OK) return fail_at(program, step->node, status);
  }
  program->ran = true;
  return KG_OK;
}

/* -- seeds and tangents ------------------------------------------------------------------------ */

/* bytes of one entry, of all directions and lanes */
static size_t entry_bytes(const kg_program *program, int directions)
{
  return (size_t)directions * program->graph.lanes * program->graph.number;
}

static void *open_port(kg_program *program, kg_port *port, int i, int directions)
{
  KG_ASSERT(directions > 0 && i >= 0 && i < port->count);
  const size_t entry = entry_bytes(program, directions);
  if (port->directions != directions) {
    const size_t bytes = port->at[port->count] * entry;
    port->directions = 0;
    if (!kg_buffer_reserve(&port->memory, program->graph.allocator, bytes)) {
      fail(program, KG_ERR_NO_MEMORY, "program", NULL, "no memory for the seeds of a sweep");
      return NULL;
    }
    memset(port->memory.memory, 0, bytes);
    memset(port->given, 0, (size_t)port->count * sizeof *port->given);
    port->directions = directions;
  }
  port->given[i] = true;
  return (char *)port->memory.memory + port->at[i] * entry;
}

void *kg_program_seed(kg_program *program, int o, int directions)
{
  return open_port(program, &program->seed, o, directions);
}

void *kg_program_tangent(kg_program *program, int i, int directions)
{
  return open_port(program, &program->tangent, i, directions);
}

static void add_numbers(const kg_program *program, void *to, const void *from, size_t bytes)
{
  if (program->arithmetic == KG_F32) {
    float *t = to;
    const float *x = from;
    for (size_t i = 0; i < bytes / sizeof *t; ++i) {
      t[i] += x[i];
    }
  } else { /* complex numbers add like twice as many doubles */
    double *t = to;
    const double *x = from;
    for (size_t i = 0; i < bytes / sizeof *t; ++i) {
      t[i] += x[i];
    }
  }
}

/* Starts a sweep from what was written to the port. */
static kg_status begin_sweep(kg_program *program, const kg_port *port, const uint32_t *ids,
                             const char *call, int directions)
{
  program->went_backward = program->went_forward = false;
  if (!program->ran)
    return fail(program, KG_ERR_UNDEFINED, call, NULL, "no run has succeeded before");
  if (port->directions != directions) {
    return fail(program, KG_ERR_UNDEFINED, call, NULL, "nothing was given for so many directions");
  }
  if (kg_sweep_begin(&program->graph, directions) != KG_OK) {
    return fail(program, KG_ERR_NO_MEMORY, call, NULL, "no memory for so many directions");
  }
  for (int i = 0; i < port->count; ++i) {
    void *to = port->given[i] ? kg_sweep_seed(&program->graph, ids[i]) : NULL;
    const size_t entry = entry_bytes(program, directions);
    const char *from = (char *)port->memory.memory + port->at[i] * entry;
    if (to) add_numbers(program, to, from, (port->at[i + 1] - port->at[i]) * entry);
  }
  return KG_OK;
}

/* -- sweeps ------------------------------------------------------------------------------------ */

/* a primitive's failure within a sweep */
static kg_status finish_sweep(kg_program *program)
{
  const kg_graph *graph = &program->graph;
  return graph->status == KG_OK ? KG_OK : fail_at(program, graph->failed, graph->status);
}

/* The sweep of sweep.c with its calls prepared; entry: bytes of one, all directions and lanes. */
static void step_back(const kg_program *program, kg_step *step, int directions, size_t entry)
{
  void **in_adjoint = program->graph.pointers.memory;
  const size_t row = program->graph.lanes * program->graph.number;
  const char *adjoint = (char *)program->graph.tensor.memory + step->block->adjoint * entry;
  step->call.fresh = 0;
  for (int k = 0; k < step->call.count; ++k) {
    kg_block *operand = step->operand[k];
    bool fresh = false, *wants_fresh = step->writes ? &fresh : NULL;
    in_adjoint[k] = operand ? kg_sweep_touch(&program->graph, operand, entry, wants_fresh) : NULL;
    step->call.fresh |= (unsigned)fresh << k;
  }
  for (int s = 0; s < directions; ++s) {
    step->kernel->vjp(&step->call, adjoint, in_adjoint);
    adjoint += step->block->size * row;
    for (int k = 0; s + 1 < directions && k < step->call.count; ++k) {
      if (in_adjoint[k]) in_adjoint[k] = (char *)in_adjoint[k] + step->operand[k]->size * row;
    }
  }
}

static void sweep_back(kg_program *program, int directions)
{
  kg_graph *graph = &program->graph;
  const size_t entry = entry_bytes(program, directions);
  for (size_t i = program->step_count; i > 0 && graph->status == KG_OK; --i) {
    kg_step *step = &program->step[i - 1];
    if (!step->active || step->block->stamp != graph->stamp) continue;
    graph->failed = step->node;
    step_back(program, step, directions, entry);
  }
}

kg_status kg_program_backward(kg_program *program, int directions)
{
  const kg_status status =
    begin_sweep(program, &program->seed, program->output, "backward", directions);
  if (status != KG_OK) return status;
  sweep_back(program, directions);
  for (int i = 0; i < program->info.inputs; ++i) {
    kg_sweep_seed(&program->graph, program->input[i]); /* zero where no seed led to */
  }
  program->went_backward = program->graph.status == KG_OK;
  return finish_sweep(program);
}

/* Every value that is asked for has a place, those without derivative too. */
static void *place(const kg_program *program, uint32_t id)
{
  const kg_graph *graph = &program->graph;
  return (char *)graph->tensor.memory +
         block_of(program, id)->adjoint * entry_bytes(program, graph->directions);
}

const void *kg_program_adjoint(const kg_program *program, int i)
{
  KG_ASSERT(i >= 0 && i < program->info.inputs);
  const kg_node *node = &program->graph.node[kg_index(program->input[i])];
  return node->active && program->went_backward ? place(program, program->input[i]) : NULL;
}

kg_status kg_program_forward(kg_program *program, int directions)
{
  const kg_status status =
    begin_sweep(program, &program->tangent, program->input, "forward", directions);
  if (status != KG_OK) return status;
  kg_sweep_forward(&program->graph, 1);
  for (int o = 0; o < program->info.outputs; ++o) {
    const uint32_t id = program->output[o];
    if (!kg_sweep_result(&program->graph, id)) {
      memset(place(program, id), 0, block_of(program, id)->size * entry_bytes(program, directions));
    }
  }
  program->went_forward = program->graph.status == KG_OK;
  return finish_sweep(program);
}

const void *kg_program_output_tangent(const kg_program *program, int o)
{
  KG_ASSERT(o >= 0 && o < program->info.outputs);
  return program->went_forward ? place(program, program->output[o]) : NULL;
}
