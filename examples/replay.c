/* Record once, run at many inputs: a frozen program, in lanes, and what happens to an `if`. */
#include <math.h>
#include <stdio.h>

#include "kinegrad/derivatives.h"
#include "kinegrad/program.h"

enum { LANES = 4 };

/* [formula] */
/* where a ball lands that is thrown from height 2 at speed v and angle a:
 * v cos a t with v sin a t - g t^2 / 2 = -2 */
static kg_value range(kg_tape *tape, kg_value v, kg_value a)
{
  const double g = 9.8;
  const kg_value up = kg_mul(tape, v, kg_sin(tape, a)), along = kg_mul(tape, v, kg_cos(tape, a));
  const kg_value root = kg_sqrt(tape, kg_shift(tape, kg_square(tape, up), 4 * g));
  const kg_value time = kg_scale(tape, kg_add(tape, up, root), 1 / g);
  return kg_mul(tape, along, time);
}
/* [formula] */

/* the program of the recorded formula; NULL, with a message, on failure */
static kg_program *freeze(void)
{
  kg_program *program = NULL;
  kg_error error = {0};
  kg_tape *tape;
  if (kg_tape_create(NULL, &tape, NULL) != KG_OK) return NULL;
  /* [freeze] */
  const kg_value inputs[2] = {kg_scalar(tape, 10), kg_scalar(tape, 0.5)};
  const kg_value output = range(tape, inputs[0], inputs[1]);
  kg_program_def def = kg_program_default_def();
  def.lanes = LANES;
  if (kg_program_create(&def, tape, 2, inputs, 1, &output, &program, &error) != KG_OK) {
    fprintf(stderr, "%s\n", error.text);
  }
  kg_tape_destroy(tape); /* the program does not need it */
  /* [freeze] */
  return program;
}

static bool throw_balls(kg_program *program)
{
  /* [run] */
  double *v = kg_program_input(program, 0), *a = kg_program_input(program, 1);
  for (int i = 0; i < LANES; ++i) {
    v[i] = 12;
    a[i] = 0.5 + 0.1 * i;
  }
  if (kg_program_run(program) != KG_OK) return false;
  double *seed = kg_program_seed(program, 0, 1);
  for (int i = 0; seed && i < LANES; ++i) {
    seed[i] = 1;
  }
  if (!seed || kg_program_backward(program, 1) != KG_OK) return false;
  const double *x = kg_program_output(program, 0), *by_angle = kg_program_adjoint(program, 1);
  for (int i = 0; i < LANES; ++i) {
    printf("angle %.1f: lands at %.3f, by the angle %+.3f\n", a[i], x[i], by_angle[i]);
  }
  /* [run] */
  return true;
}

/* [branch] */
/* a brake: the force of the pedal, or of the blocked wheel, whichever is less */
static kg_value brake(kg_tape *tape, kg_value pedal, kg_value limit)
{
  kg_tape_tag(tape, "brake");
  return kg_is_less(tape, pedal, limit) ? kg_square(tape, pedal) : kg_square(tape, limit);
}

static kg_status step_on_it(kg_tape *tape)
{
  const kg_value inputs[2] = {kg_scalar(tape, 1), kg_scalar(tape, 3)}; /* recorded: 1 < 3 */
  const kg_value force = brake(tape, inputs[0], inputs[1]);
  kg_program *program;
  kg_status status = kg_program_create(NULL, tape, 2, inputs, 1, &force, &program, NULL);
  if (status != KG_OK) return status;
  *(double *)kg_program_input(program, 0) = 4; /* now 4 < 3 is asked */
  status = kg_program_run(program);
  if (status != KG_OK) printf("%s\n", kg_program_error(program)->text);
  kg_program_destroy(program);
  return status;
}
/* [branch] */

int main(void)
{
  kg_program *program = freeze();
  const bool thrown = program && throw_balls(program);
  kg_program_destroy(program);
  kg_tape *tape;
  if (!thrown || kg_tape_create(NULL, &tape, NULL) != KG_OK) return 1;
  const kg_status status = step_on_it(tape);
  kg_tape_destroy(tape);
  return status == KG_ERR_STALE ? 0 : 1;
}
