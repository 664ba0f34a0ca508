/* Tables of the kernels of physics/, one for each instruction set they are compiled for. Which one
 * an object uses is decided when it is created. */
#ifndef PHYSICS_KERNELS_KERNELS_H
#define PHYSICS_KERNELS_KERNELS_H

#include "kinegrad/contact.h"

#include "physics/tree.h"

#include <stddef.h>

/* Candidates of the small problem side by side. */
enum { KG_LANES = 8 };

/* What the recursive algorithms read of a link; lengths and moments in its own axes, about its own
 * joint. */
typedef struct kg_link_model {
  int parent;
  double mass;
  double offset[3];   /* of the joint in the parent's axes; zero for the root */
  double h[3];        /* mass * centre of mass                                */
  double inertia[6];  /* xx yy zz xy xz yz                                    */
  double columns[12]; /* the same as columns of four, the fourth zero        */
} kg_link_model;

typedef struct kg_model {
  int n;
  kg_link_model *links;
  double gravity[3];
  void *scratch;
} kg_model;

/* Where derivatives of inverse dynamics go, arrays as in tree_numbers.inc; a pair or the last may be
 * NULL. */
typedef struct kg_lanes_outputs {
  double *q_low, *q_up, *v_low, *v_up, *mass;
} kg_lanes_outputs;

/* Where derivatives of forward dynamics go, nv x nv; each may be NULL. */
typedef struct kg_lanes_dense {
  double *by_q, *by_v, *by_tau;
} kg_lanes_dense;

typedef void kg_frame_kernel(const kg_model *model, double *out, const double *q, const double *x,
                             const double *y);

/* Algorithms for one kind of number: a double, or eight frames at once, [k][8] for number k. See the
 * functions of dynamics.h and dynamics_lanes.h. */
typedef struct kg_number_kernels {
  size_t scratch;                     /* bytes for each link                              */
  kg_frame_kernel *inverse;           /* (tau; q, v, a)                                   */
  kg_frame_kernel *forward;           /* (a; q, v, tau)                                   */
  kg_frame_kernel *mass_solve;        /* a = M^-1 tau (a; q, not read, tau)          */
  kg_frame_kernel *kinematics;        /* p (n, 3), R (n, 9); with v p_dot, w (n, 3)  */
  kg_frame_kernel *acceleration;      /* p_ddot (n, 3), alpha (n, 3); (q, v, a)      */
  kg_frame_kernel *centroid;          /* com, com_dot, L (3 each), I (9); v or NULL  */
  kg_frame_kernel *centroidal_matrix; /* (6, nv); (q)                           */
  /* x (3), J (3, nv) or NULL */
  void (*point)(const kg_model *model, double *x, double *J, const double *q, int segment,
                const double s[3]);
  void (*mass_matrix)(const kg_model *model, const kg_tree *tree, double *low, const double *q);
  void (*factor)(const kg_tree *tree, double *low);
  void (*factor_solve)(const kg_tree *tree, const double *low, double *x);
  void (*inverse_derivatives)(const kg_model *model, const kg_tree *tree,
                              const kg_lanes_outputs *out, const double *q, const double *v,
                              const double *a);
  /* a = FD(q, v, tau) */
  void (*forward_derivatives)(const kg_model *model, const kg_tree *tree, const kg_lanes_dense *out,
                              const double *q, const double *v, const double *a, const double *tau);
} kg_number_kernels;

#define KG_NUMBER_TABLE_(number, isa) kg_number_kernels_##number##_##isa
#define KG_NUMBER_TABLE(number, isa) KG_NUMBER_TABLE_(number, isa)

/* See the functions of the same names in tree.h. */
struct kg_physics_kernels {
  bool (*factor)(const kg_tree *tree, kg_tree_matrix *A);
  void (*solve)(const kg_tree *tree, const kg_tree_matrix *A, double *x);
  void (*solve_from)(const kg_tree *tree, const kg_tree_matrix *A, double *x, const int *blocks,
                     int count);
  void (*solve_transposed)(const kg_tree *tree, const kg_tree_matrix *A, double *x);
  /* blocks NULL: all */
  void (*solve_many)(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns,
                     const int *blocks, int count);
  void (*solve_transposed_many)(const kg_tree *tree, const kg_tree_matrix *A, double *X,
                                int columns, const int *blocks, int count);
  size_t link_scratch; /* bytes of model->scratch for each link */
  void (*move)(kg_dynamics *d, const double *q, const double *v, const double *a);
  void (*prepare)(kg_dynamics *d);
  void (*prepare_mass)(kg_dynamics *d);
  void (*pencil)(kg_dynamics *d, int b, const kg_mat3 *E, double rate, double acceleration);
  void (*jacobian)(const kg_dynamics *d, kg_tree_matrix *A);
  /* dense nv x nv, each may be NULL */
  void (*derivatives)(kg_dynamics *d, double *by_q, double *by_v, double *by_a);
  void (*dense_mass)(kg_dynamics *d, double *M);
  /* width numbers of eight frames: row[f] is one after the other, lanes side by side */
  void (*to_lanes)(double *lanes, const double *const row[8], int width);
  void (*from_lanes)(double *const row[8], const double *lanes, int width);
  /* inverse of `one` over vectors; NULL where they are too narrow to gain */
  kg_frame_kernel *inverse;
  /* q_out = q turned by d, (count, 4) and (count, 3), as by kg_body_integrate */
  void (*integrate_joints)(double *q_out, const double *q, const double *d, int count);
  /* E = dt Jr(dt w) of each joint, w (count, 3) */
  void (*turns_by_rate)(kg_mat3 *E, const double *w, double dt, int count);
  /* see wrenches.inc */
  void (*add_motion)(double *X, const double *parent, const kg_mat63 *T, const double *Y,
                     int stride);
  void (*wrench_rows)(double *B, const double *K, const double *D, const double *xi,
                      const double *nu, int stride);
  void (*add_contact)(double *K, double *D, const double x[3], const double u[3],
                      const double F_x[9], const double F_u[9]);
  void (*add_rows)(double *y, const double *C, const double *h, int stride);
  bool (*solve_dense)(double *B, int n, int stride, double *x);
  /* a group of KG_LANES candidates, see law.inc */
  void (*plane_ground)(double *restrict ground, const double *restrict x, kg_vec3 point,
                       kg_vec3 normal);
  void (*settle_points)(const kg_contact_params *law, double dt, const double *restrict now,
                        const double *restrict ground, const double *restrict yield,
                        const double *restrict bound, double *restrict at, double *restrict touches,
                        double *restrict way);
  void (*law_forces)(const kg_contact_params *law, const double *restrict ground,
                     const double *restrict u, const double *restrict bound, double *restrict f);
  void (*law_derivatives)(const kg_contact_params *law, const double *restrict ground,
                          const double *restrict u, const double *restrict bound,
                          const double *restrict touches, double *restrict by_x,
                          double *restrict by_u);
  void (*linear_forces)(double *restrict f, const double *restrict law, const double *restrict by_x,
                        const double *restrict by_u, const double *restrict at,
                        const double *restrict state);
  const kg_number_kernels *one;
  const kg_number_kernels *eight;
};

/* Inverse dynamics of one frame: over vectors where that gains. */
static inline kg_frame_kernel *kg_inverse_of_one(const kg_physics_kernels *kernels)
{
  return kernels->inverse ? kernels->inverse : kernels->one->inverse;
}

extern const kg_physics_kernels kg_physics_kernels_base;
#ifdef KG_DISPATCH
extern const kg_physics_kernels kg_physics_kernels_v3, kg_physics_kernels_v4;
#endif

/* level 1: any processor; 2: x86-64-v3 (AVX2), 3: x86-64-v4 (AVX-512). NULL when this processor or
 * this build has not got it. */
const kg_physics_kernels *kg_physics_kernels_of_level(int level);
/* The fastest this processor runs. */
const kg_physics_kernels *kg_physics_kernels_best(void);

#endif
