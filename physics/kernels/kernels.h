/* Tables of the kernels of physics/, one for each instruction set they are compiled for. Which one
 * an object uses is decided when it is created. */
#ifndef PHYSICS_KERNELS_KERNELS_H
#define PHYSICS_KERNELS_KERNELS_H

#include "physics/tree.h"

/* See the functions of the same names in tree.h. */
struct kg_physics_kernels {
  bool (*factor)(const kg_tree *tree, kg_tree_matrix *A);
  void (*solve)(const kg_tree *tree, const kg_tree_matrix *A, double *x);
  void (*solve_transposed)(const kg_tree *tree, const kg_tree_matrix *A, double *x);
  void (*solve_many)(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns);
  void (*solve_transposed_many)(const kg_tree *tree, const kg_tree_matrix *A, double *X,
                                int columns);
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
