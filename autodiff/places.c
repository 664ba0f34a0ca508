/* Places of a program's adjoints and tangents.
 *
 * Those of a node matter from the node to the last operator that reads it, in a backward sweep as
 * in a forward one. Nodes of one size whose spans do not meet share their place: a sweep's memory
 * is that of the values alive at once, and mostly in the processor's cache. */
#include "autodiff/frozen.h"

/* Places of one size that nobody uses now: a chain through `next`, by node. */
typedef struct places {
  size_t size;
  uint32_t free; /* a node that had one; 0: none */
} places;

typedef struct planner {
  kg_graph *graph;
  uint32_t *last;   /* (nodes) the last node that reads it */
  uint32_t *ending; /* (nodes) first of the chain of nodes that are last read by this one */
  uint32_t *next;   /* (nodes) the next in its chain */
  places *places;
  size_t sizes;
} planner;

static places *places_of(planner *plan, size_t size)
{
  for (size_t i = 0; i < plan->sizes; ++i) {
    if (plan->places[i].size == size) return &plan->places[i];
  }
  plan->places[plan->sizes] = (places){.size = size};
  return &plan->places[plan->sizes++];
}

static void chain(planner *plan, uint32_t node, uint32_t *first)
{
  plan->next[node] = *first;
  *first = node;
}

static void find_spans(planner *plan, const kg_program *p)
{
  for (uint32_t i = 1; i < plan->graph->count; ++i) {
    const kg_block *block = plan->graph->node[i].is.block;
    plan->last[i] = i;
    for (int k = 0; k < block->count; ++k) {
      plan->last[kg_index(block->input[k])] = i;
    }
  }
  for (int o = 0; o < p->info.outputs; ++o) {
    plan->last[kg_index(p->output[o])] = plan->graph->count; /* read at the end */
  }
  for (uint32_t i = 1; i <= (uint32_t)p->info.inputs; ++i) {
    if (plan->last[i] == i) plan->last[i] = plan->graph->count; /* nobody's, but asked for */
  }
  for (uint32_t i = 1; i < plan->graph->count; ++i) {
    if (plan->last[i] < plan->graph->count) chain(plan, i, &plan->ending[plan->last[i]]);
  }
}

static void give_places(planner *plan)
{
  kg_graph *graph = plan->graph;
  for (uint32_t i = 1; i < graph->count; ++i) {
    kg_block *block = graph->node[i].is.block;
    const bool is_read_later = graph->node[i].active || plan->last[i] == graph->count;
    places *own = is_read_later ? places_of(plan, block->size) : NULL;
    if (own && own->free) {
      block->adjoint = graph->node[own->free].is.block->adjoint;
      own->free = plan->next[own->free];
    } else if (own) {
      block->adjoint = graph->adjoint_size;
      graph->adjoint_size += block->size;
    }
    for (uint32_t done = plan->ending[i], next; done; done = next) {
      next = plan->next[done];
      const kg_node *node = &graph->node[done];
      if (node->active) chain(plan, done, &places_of(plan, node->is.block->size)->free);
    }
  }
}

bool kg_plan_adjoints(kg_program *program, kg_arena *scratch)
{
  kg_graph *graph = &program->graph;
  planner plan = {.graph = graph};
  plan.last = KG_ARENA_ARRAY(scratch, uint32_t, graph->count);
  plan.ending = KG_ARENA_ARRAY(scratch, uint32_t, graph->count);
  plan.next = KG_ARENA_ARRAY(scratch, uint32_t, graph->count);
  plan.places = KG_ARENA_ARRAY(scratch, places, graph->count);
  if (kg_arena_failed(scratch)) return false;
  find_spans(&plan, program);
  give_places(&plan);
  return true;
}
