/* The --forces table: root residual, ground reaction per foot, joint torques. */
#include "cli/forces.h"

static void print_vec3(FILE *stream, kg_vec3 a)
{
  fprintf(stream, ",%.9g,%.9g,%.9g", a.x, a.y, a.z);
}

static void print_header(FILE *stream, const kg_body *body)
{
  fputs("time_s,frame"
        ",residual_force_x_N,residual_force_y_N,residual_force_z_N"
        ",residual_moment_x_Nm,residual_moment_y_Nm,residual_moment_z_Nm",
        stream);
  for (int side = 0; side < 2; side++) {
    const char *foot = side == 0 ? "left" : "right";
    fprintf(stream, ",%s_grf_x_N,%s_grf_y_N,%s_grf_z_N", foot, foot, foot);
    fprintf(stream, ",%s_cop_x_m,%s_cop_y_m,%s_cop_z_m,%s_free_moment_Nm", foot, foot, foot, foot);
  }
  fputs(",other_force_x_N,other_force_y_N,other_force_z_N", stream);
  for (int i = 1; i < body->segment_count; i++) { /* segment 0 is free: no joint, no torque */
    const char *name = body->segments[i].name;
    fprintf(stream, ",%s_x_Nm,%s_y_Nm,%s_z_Nm", name, name, name);
  }
  fputc('\n', stream);
}

static void print_row(FILE *stream, const kg_subject *subject, const kg_correct_result *result,
                      int t)
{
  const int frame = t + subject->first_frame;
  fprintf(stream, "%.9g,%d", frame * subject->dt, frame);
  print_vec3(stream, result->residual_force[t]);
  print_vec3(stream, result->residual_moment[t]);
  for (int side = 0; side < 2; side++) {
    const kg_foot_force *foot = &result->feet[2 * t + side];
    print_vec3(stream, foot->force);
    print_vec3(stream, foot->cop);
    fprintf(stream, ",%.9g", foot->moment);
  }
  print_vec3(stream, result->other_force[t]);
  const double *tau = result->tau + (size_t)t * (size_t)result->nv;
  for (int i = 6; i < result->nv; i++) { /* v: root's six, then three per segment */
    fprintf(stream, ",%.9g", tau[i]);
  }
  fputc('\n', stream);
}

void cli_write_forces(FILE *stream, const kg_subject *subject, const kg_correct_result *result)
{
  print_header(stream, subject->body);
  for (int t = 0; t < result->frame_count; t++) {
    print_row(stream, subject, result, t);
  }
}
