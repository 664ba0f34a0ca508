/* frozen.h - inside of a program: made by freeze.c and places.c, run by program.c.
 *
 * A program is a graph of its own in which every node is a block, scalars included: first the
 * inputs, then the constants, then the operators in recorded order. */
#ifndef AUTODIFF_FROZEN_H
#define AUTODIFF_FROZEN_H

#include "autodiff/graph.h"
#include "kinegrad/program.h"

/* Numbers the user writes before a sweep, for all outputs (seeds) or all inputs (tangents): those
 * of value i start at at[i] entries, each entry being (directions, lanes). */
typedef struct kg_port {
  kg_buffer memory;
  size_t *at;  /* (count + 1) */
  bool *given; /* (count) asked for since the directions changed */
  int count, directions;
} kg_port;

/* An operator with everything its kernels are called with. */
typedef struct kg_step {
  kg_call call;
  const kg_kernel *kernel;
  kg_block *block;
  kg_block **operand; /* (call.count) NULL: without adjoint */
  uint32_t node;
  bool is_run; /* its numbers are its own; else another node's (values shared, reshape) */
  bool active;
  bool writes; /* kg_writes_adjoints */
} kg_step;

struct kg_program {
  kg_graph graph;
  kg_arena arena; /* blocks and their numbers */
  kg_arithmetic arithmetic;
  kg_program_info info;
  uint32_t *input, *output; /* ids */
  const char **tag;         /* (graph.count) the user's tags, copied; NULL without */
  kg_step *step;            /* (step_count) in recorded order */
  size_t step_count;
  kg_port seed, tangent;
  bool ran; /* the last run succeeded */
  bool went_backward, went_forward; /* the last sweep, when it succeeded */
  kg_error error;
};

/* kg_program_create; unguarded: comparisons that were asked (kg_is_less) are not asked again */
kg_status kg_freeze(const kg_program_def *def, bool guarded, const kg_tape *tape, int input_count,
                    const kg_value *inputs, int output_count, const kg_value *outputs,
                    kg_program **program, kg_error *error);

/* Gives every value that a sweep asks for a place in its memory (places.c); false when memory is
 * refused. */
bool kg_plan_adjoints(kg_program *program, kg_arena *scratch);

static inline void kg_put_number(kg_arithmetic arithmetic, void *numbers, size_t at, double x)
{
  switch (arithmetic) {
    case KG_F64:
      ((double *)numbers)[at] = x;
      break;
    case KG_F32:
      ((float *)numbers)[at] = (float)x;
      break;
    case KG_C64: /* a complex number is laid out as two doubles */
      ((double *)numbers)[2 * at] = x;
      ((double *)numbers)[2 * at + 1] = 0;
      break;
  }
}

static inline double kg_real_part(kg_arithmetic arithmetic, const void *numbers, size_t at)
{
  switch (arithmetic) {
    case KG_F64:
      return ((const double *)numbers)[at];
    case KG_F32:
      return (double)((const float *)numbers)[at];
    default:
      return ((const double *)numbers)[2 * at];
  }
}

#endif
