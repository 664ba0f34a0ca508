/* Tables of the kernels of physics/, one for each instruction set they are compiled for. Which one
 * an object uses is decided when it is created. */
#ifndef PHYSICS_KERNELS_KERNELS_H
#define PHYSICS_KERNELS_KERNELS_H

#include "physics/tree.h"

#include <stddef.h>

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

/* Recursive algorithms for one kind of number: a double, or eight frames at once, [k][8] for number
 * k. See the functions of dynamics.h. */
typedef struct kg_number_kernels {
  size_t scratch; /* bytes for each link */
  void (*inverse)(const kg_model *model, double *tau, const double *q, const double *v,
                  const double *a);
  void (*forward)(const kg_model *model, double *a, const double *q, const double *v,
                  const double *tau);
  /* a = M^-1 tau; v is not read */
  void (*mass_solve)(const kg_model *model, double *a, const double *q, const double *v,
                     const double *tau);
  /* out: p (n, 3), R (n, 9), and where v is given also p_dot (n, 3), w (n, 3) */
  void (*kinematics)(const kg_model *model, double *out, const double *q, const double *v,
                     const double *unused);
} kg_number_kernels;

#define KG_NUMBER_TABLE_(number, isa) kg_number_kernels_##number##_##isa
#define KG_NUMBER_TABLE(number, isa) KG_NUMBER_TABLE_(number, isa)

/* See the functions of the same names in tree.h. */
struct kg_physics_kernels {
  bool (*factor)(const kg_tree *tree, kg_tree_matrix *A);
  void (*solve)(const kg_tree *tree, const kg_tree_matrix *A, double *x);
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
  void (*mass_matrix)(const kg_dynamics *d, kg_tree_matrix *A);
  /* dense nv x nv, each may be NULL */
  void (*derivatives)(kg_dynamics *d, double *by_q, double *by_v, double *by_a);
  void (*dense_mass)(kg_dynamics *d, double *M);
  /* width numbers of eight frames: row[f] is one after the other, lanes side by side */
  void (*to_lanes)(double *lanes, const double *const row[8], int width);
  void (*from_lanes)(double *const row[8], const double *lanes, int width);
  /* inverse of `one` over vectors; NULL where they are too narrow to gain */
  void (*inverse)(const kg_model *model, double *tau, const double *q, const double *v,
                  const double *a);
  /* see wrenches.inc */
  void (*add_motion)(double *X, const double *parent, const kg_mat63 *T, const double *Y,
                     int stride);
  void (*wrench_rows)(double *B, const double *K, const double *D, const double *xi,
                      const double *nu, int stride);
  void (*add_contact)(double *K, double *D, const double x[3], const double u[3],
                      const double F_x[9], const double F_u[9]);
  void (*add_rows)(double *y, const double *C, const double *h, int stride);
  bool (*solve_dense)(double *B, int n, int stride, double *x);
  const kg_number_kernels *one;
  const kg_number_kernels *eight; /* NULL: this compiler has no vectors */
};

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
