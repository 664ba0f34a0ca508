/* The calls: gradient, products with the Jacobian and its transpose, the Jacobian itself. */
#include "autodiff/tape.h"

#include "kinegrad/derivatives.h"

#include <math.h>
#include <string.h>

/* -- numbers of either precision --------------------------------------------------------------- */

/* Within a sweep a scalar's adjoint is double; that of a tensor has the tape's precision. */
static bool is_double(const kg_tape *tape, kg_value value)
{
  return tape->precision == KG_DOUBLE || !(value.id & KG_TENSOR);
}

void kg_add_numbers(const kg_tape *tape, kg_value value, void *to, const double *from, size_t n)
{
  for (size_t i = 0; i < n; ++i) {
    if (is_double(tape, value)) {
      ((double *)to)[i] += from[i];
    } else {
      ((float *)to)[i] += (float)from[i];
    }
  }
}

void kg_copy_numbers(const kg_tape *tape, kg_value value, const void *from, double *to, size_t n)
{
  if (!from) {
    memset(to, 0, n * sizeof *to);
  } else if (is_double(tape, value)) {
    const double *x = from;
    for (size_t i = 0; i < n; ++i) {
      to[i] = x[i];
    }
  } else {
    const float *x = from;
    for (size_t i = 0; i < n; ++i) {
      to[i] = (double)x[i];
    }
  }
}

/* -- checks ------------------------------------------------------------------------------------ */

bool kg_values_usable(kg_tape *tape, const char *call, int count, const kg_value *values)
{
  for (int i = 0; i < count && tape->error.status == KG_OK; ++i) {
    if (!values[i].id || kg_index(values[i].id) >= tape->graph.count) {
      kg_refuse(tape, KG_ERR_UNDEFINED, call, "value %d is null or was rewound", i);
    }
  }
  return tape->error.status == KG_OK;
}

bool kg_values_differentiable(kg_tape *tape, const char *call, int count, const kg_value *values)
{
  for (int i = 0; i < count && tape->error.status == KG_OK; ++i) {
    if (!kg_node_of(tape, values[i])->active) {
      kg_refuse(tape, KG_ERR_UNDEFINED, call, "input %d does not depend on a differentiable input",
                i);
    }
  }
  return tape->error.status == KG_OK;
}

kg_status kg_begin_sweep(kg_tape *tape, const char *call, int directions)
{
  if (kg_sweep_begin(&tape->graph, directions) != KG_OK) {
    kg_refuse(tape, KG_ERR_NO_MEMORY, call, "no memory for %d directions", directions);
  }
  return tape->error.status;
}

/* the oldest of the values: no sweep needs to go further */
static uint32_t oldest(int count, const kg_value *values)
{
  uint32_t first = UINT32_MAX;
  for (int i = 0; i < count; ++i) {
    first = kg_index(values[i].id) < first ? kg_index(values[i].id) : first;
  }
  return first;
}

/* -- backward ---------------------------------------------------------------------------------- */

static void seed_with_ones(kg_tape *tape, kg_value output)
{
  void *seed = kg_sweep_seed(&tape->graph, output.id);
  const double one = 1;
  const size_t number = is_double(tape, output) ? sizeof(double) : sizeof(float);
  for (size_t i = 0; seed && i < kg_size_of(tape, output); ++i) {
    kg_add_numbers(tape, output, (char *)seed + i * number, &one, 1);
  }
}

kg_status kg_backward(kg_tape *tape, kg_value output)
{
  if (!kg_values_usable(tape, "backward", 1, &output) ||
      kg_begin_sweep(tape, "backward", 1) != KG_OK) {
    return tape->error.status;
  }
  seed_with_ones(tape, output);
  kg_sweep_backward(&tape->graph, 1);
  return kg_sweep_status(tape);
}

/* why the value has no adjoint to be read; NULL when it has one */
static const char *missing_adjoint(const kg_tape *tape, kg_value value, bool wants_double)
{
  const kg_graph *graph = &tape->graph;
  const uint32_t index = kg_index(value.id);
  if (is_double(tape, value) != wants_double) {
    return wants_double ? "numbers of single precision: kg_adjoint_f32 reads them"
                        : "numbers of double precision: kg_adjoint reads them";
  }
  if (graph->directions == 0) return "no sweep since the tape was made, or the last one failed";
  if (index >= graph->swept) return "recorded after the last backward sweep";
  if (graph->complete == KG_NO_ADJOINTS) return "the last sweep went forward";
  return index < graph->complete ? "older than the inputs for which the last sweep was made" : NULL;
}

static const void *adjoint_of(kg_tape *tape, kg_value value, bool wants_double)
{
  if (!kg_values_usable(tape, "adjoint", 1, &value)) return NULL;
  if (!kg_node_of(tape, value)->active) {
    kg_refuse(tape, KG_ERR_UNDEFINED, "adjoint", "of a constant, or of what constants alone make");
    return NULL;
  }
  const char *reason = missing_adjoint(tape, value, wants_double);
  if (reason) {
    kg_refuse(tape, KG_ERR_UNSUPPORTED, "adjoint", "%s", reason);
    return NULL;
  }
  return kg_sweep_seed(&tape->graph, value.id); /* zero when the sweep did not reach it */
}

const double *kg_adjoint(kg_tape *tape, kg_value value)
{
  return adjoint_of(tape, value, true);
}

const float *kg_adjoint_f32(kg_tape *tape, kg_value value)
{
  return adjoint_of(tape, value, false);
}

double kg_adjoint_item(kg_tape *tape, kg_value value)
{
  const void *adjoint = adjoint_of(tape, value, is_double(tape, value));
  double item = NAN;
  if (adjoint) kg_copy_numbers(tape, value, adjoint, &item, 1);
  return item;
}

kg_status kg_gradient(kg_tape *tape, kg_value output, int count, const kg_value *inputs,
                      double *const *gradients)
{
  if (kg_values_usable(tape, "gradient", 1, &output) && kg_size_of(tape, output) != 1) {
    kg_refuse(tape, KG_ERR_SHAPE, "gradient", "of a value of shape %s; it must have one entry",
              kg_shape_print(kg_shape_of(tape, output)).text);
  }
  const double one = 1;
  const double *const seed = &one;
  return kg_vjp(tape, 1, 1, &output, &seed, count, inputs, gradients);
}

kg_status kg_vjp(kg_tape *tape, int directions, int output_count, const kg_value *outputs,
                 const double *const *seeds, int input_count, const kg_value *inputs,
                 double *const *results)
{
  KG_ASSERT(directions > 0);
  if (!kg_values_usable(tape, "vjp", output_count, outputs) ||
      !kg_values_usable(tape, "vjp", input_count, inputs) ||
      !kg_values_differentiable(tape, "vjp", input_count, inputs) ||
      kg_begin_sweep(tape, "vjp", directions) != KG_OK) {
    return tape->error.status;
  }
  for (int o = 0; o < output_count; ++o) {
    void *seed = kg_sweep_seed(&tape->graph, outputs[o].id);
    const size_t n = (size_t)directions * kg_size_of(tape, outputs[o]);
    if (seed) kg_add_numbers(tape, outputs[o], seed, seeds[o], n);
  }
  kg_sweep_backward(&tape->graph, oldest(input_count, inputs) + 1);
  for (int i = 0; i < input_count; ++i) {
    if (kg_is_scalar_node(inputs[i])) {
      const double *adjoint = kg_scalar_adjoint(&tape->graph, inputs[i].id);
      for (int s = 0; s < directions; ++s) {
        results[i][s] = adjoint[s];
      }
    } else {
      kg_copy_numbers(tape, inputs[i], kg_sweep_result(&tape->graph, inputs[i].id), results[i],
                      (size_t)directions * kg_size_of(tape, inputs[i]));
    }
  }
  return kg_sweep_status(tape);
}

/* -- forward ----------------------------------------------------------------------------------- */

kg_status kg_jvp(kg_tape *tape, int directions, int input_count, const kg_value *inputs,
                 const double *const *tangents, int output_count, const kg_value *outputs,
                 double *const *results)
{
  KG_ASSERT(directions > 0);
  if (!kg_values_usable(tape, "jvp", output_count, outputs) ||
      !kg_values_usable(tape, "jvp", input_count, inputs) ||
      !kg_values_differentiable(tape, "jvp", input_count, inputs) ||
      kg_begin_sweep(tape, "jvp", directions) != KG_OK) {
    return tape->error.status;
  }
  for (int i = 0; i < input_count; ++i) {
    const size_t n = (size_t)directions * kg_size_of(tape, inputs[i]);
    kg_add_numbers(tape, inputs[i], kg_sweep_seed(&tape->graph, inputs[i].id), tangents[i], n);
  }
  kg_sweep_forward(&tape->graph, oldest(input_count, inputs));
  for (int o = 0; o < output_count; ++o) {
    kg_copy_numbers(tape, outputs[o], kg_sweep_result(&tape->graph, outputs[o].id), results[o],
                    (size_t)directions * kg_size_of(tape, outputs[o]));
  }
  return kg_sweep_status(tape);
}
