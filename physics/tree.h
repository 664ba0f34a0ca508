/* Inside physics/: matrices with the sparsity of the kinematic tree, and the kernels of dynamics.c
 * that step.c needs as well.
 *
 * Unknowns come in blocks of three: block 0 is the root's linear velocity, block 1 + i the angular
 * velocity of segment i. Block 0 is the parent of block 1. A matrix of tree sparsity has a 3x3
 * block (a, b) only where one of a and b is an ancestor of the other, or both are the same. */
#ifndef PHYSICS_TREE_H
#define PHYSICS_TREE_H

#include "kinegrad/arena.h"
#include "kinegrad/dynamics.h"
#include "kinegrad/spatial.h"

#include "physics/chain.h"

typedef struct kg_physics_kernels kg_physics_kernels;

typedef struct kg_tree {
  int blocks;  /* n + 1                                                                        */
  int entries; /* blocks on and below the diagonal                                             */
  int *depth;  /* proper ancestors of a block                                                  */
  int *start;  /* path of block b: path[start[b]] .. path[start[b] + depth[b]]                 */
  int *path;   /* from the root to b, b itself last                                            */
  int *below_start; /* descendants of block b: below[below_start[b]] up to the start of b + 1  */
  int *below;
  int *width;   /* of one row of the panels of a block, a multiple of 8                         */
  int *panel;   /* where the panels of a block begin                                            */
  int size;     /* numbers in all panels of one kind                                            */
  double *work; /* 24 * blocks: scratch of the solves                                          */
  const kg_physics_kernels *kernels;
} kg_tree;

/* Two panels of three rows for every block b, with the blocks of its path side by side, 3 columns
 * for each: low holds A[b, path], the diagonal block included; up holds A[path, b]' . What lies
 * behind the path in a row is padding of any value. Number (r, c) of
 *   A[b, path[start[b] + k]] is low[panel[b] + r * width[b] + 3 * k + c],
 *   A[path[start[b] + k], b] is  up[panel[b] + c * width[b] + 3 * k + r]. */
typedef struct kg_tree_matrix {
  double *low, *up;
} kg_tree_matrix;

/* Block a is b or an ancestor of it. */
static inline bool kg_tree_is_above(const kg_tree *tree, int a, int b)
{
  return tree->depth[a] <= tree->depth[b] && tree->path[tree->start[b] + tree->depth[a]] == a;
}

/* Columns that kg_tree_solve_many takes at a time. */
enum { KG_TREE_STRIP = 32 };

/* Both take their memory from the arena; check kg_arena_failed afterwards. */
void kg_tree_init(kg_tree *tree, const kg_body *body, kg_arena *arena);
void kg_tree_matrix_init(kg_tree_matrix *A, const kg_tree *tree, kg_arena *arena);

/* The k-th block of row b of the lower triangle, and its mirror image A[path[k], b] (k < depth). */
kg_mat3 kg_tree_low(const kg_tree *tree, const kg_tree_matrix *A, int b, int k);
kg_mat3 kg_tree_up(const kg_tree *tree, const kg_tree_matrix *A, int b, int k);
void kg_tree_set_low(const kg_tree *tree, kg_tree_matrix *A, int b, int k, const kg_mat3 *block);
void kg_tree_set_up(const kg_tree *tree, kg_tree_matrix *A, int b, int k, const kg_mat3 *block);
/* A[b, b] += s block */
void kg_tree_add_diagonal(const kg_tree *tree, kg_tree_matrix *A, int b, double s,
                          const kg_mat3 *block);

/* A = L U from the leaves to the root, in place, no fill-in; false when a pivot block is singular. */
bool kg_tree_factor(const kg_tree *tree, kg_tree_matrix *A);
/* x := A^-1 x with the factors; x[3 * blocks]. */
void kg_tree_solve(const kg_tree *tree, const kg_tree_matrix *A, double *x);
/* The same for x that is zero outside some blocks: count in ascending order, every one with all its
 * ancestors. */
void kg_tree_solve_from(const kg_tree *tree, const kg_tree_matrix *A, double *x, const int *blocks,
                        int count);
/* x := A^-T x with the factors. */
void kg_tree_solve_transposed(const kg_tree *tree, const kg_tree_matrix *A, double *x);
/* X := A^-1 X and X := A^-T X for X (3 * blocks, columns) row-major. */
void kg_tree_solve_many(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns);
void kg_tree_solve_transposed_many(const kg_tree *tree, const kg_tree_matrix *A, double *X,
                                   int columns);
/* The same for X that is zero outside some blocks, and only the solution's rows of these blocks:
 * count blocks in ascending order, every one with all its ancestors. The other rows of X are
 * neither read nor written. */
void kg_tree_solve_many_within(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns,
                               const int *blocks, int count);
/* out[nv*nv] row-major, zeros outside the pattern. */
void kg_tree_to_dense(const kg_tree *tree, const kg_tree_matrix *A, double *out);

/* Three rows of three numbers, each followed by one of any value. */
typedef struct kg_rows {
  double m[12];
} kg_rows;

/* Six rows, three columns: the motion subspace of a ball joint and what is derived from it. */
typedef struct kg_mat63 {
  kg_rows w, v; /* angular rows, linear rows */
} kg_mat63;

/* General 6x6 in 3x3 blocks: [ww wv; vw vv]. */
typedef struct kg_mat66 {
  kg_mat3 ww, wv, vw, vv;
} kg_mat66;

/* What a segment is made of, copied from the body, and where it is and how it moves. World axes;
 * points and the frame of all spatial quantities relative to O, the root position. */
typedef struct kg_link {
  int parent;
  double mass;
  kg_vec3 offset, com; /* as in kg_segment                          */
  double inertia[6];   /* about the centre of mass, segment axes     */
  kg_mat3 R;
  kg_vec3 p, c;      /* joint, centre of mass                      */
  kg_vec3 w, p_dot;  /* angular velocity, velocity of the joint    */
  kg_vec3 alpha;     /* angular acceleration                       */
  kg_vec3 p_ddot;    /* acceleration of the joint minus gravity    */
  kg_force inertial; /* rate of change of momentum minus weight    */
  kg_force external; /* forces from outside, contact; else zero    */
} kg_link;

/* Sums over the subtree of a block, for the derivatives. */
typedef struct kg_composite {
  kg_inertia I;
  double Bs[6];      /* symmetric part of 2 B, docs/theory/dynamics.md (12) */
  kg_force momentum; /* sum of I v */
  kg_force inertial;
  kg_force external;
  bool loaded;   /* external forces act in the subtree: K and D are not zero */
  kg_mat66 K, D; /* d external = K xi + D nu, docs/theory/contact.md (9)      */
} kg_composite;

/* One column block of a directional derivative: the pose moves by the twists T, its rate changes by
 * U, the acceleration by W (docs/theory/dynamics.md (14)). */
typedef struct kg_pencil {
  kg_mat63 T, U, W;
} kg_pencil;

struct kg_dynamics {
  const kg_body *body;
  kg_vec3 gravity;
  int n;
  kg_vec3 origin;    /* O in the world */
  kg_link *links;    /* n      */
  kg_mat63 *S;       /* blocks */
  kg_mat63 *psi;     /* S moved with the parent: psi_dot of [SRW]   */
  kg_mat63 *psi_dot; /* psi_ddot of [SRW]                           */
  kg_mat63 *moved;   /* psi + S moved with the segment itself       */
  kg_composite *sum; /* blocks */
  kg_pencil *pencil; /* blocks */
  kg_rows *G;        /* blocks: (2 B)' S of the rows of the dense derivatives */
  kg_tree tree;
  kg_chain chain;   /* motion and its adjoints, chain.h      */
  kg_tree_matrix A; /* scratch of derivatives of the step */
  double *forward;  /* nv: acceleration of the public derivatives of forward dynamics */
  const kg_physics_kernels *kernels;
  struct kg_model *model; /* for the recursive algorithms */
  double *lanes[4];       /* eight frames: nq or nv numbers of each */
  double *motion;         /* 8 * 18 n: poses and velocities of eight frames */
  double *spare;          /* 9 n numbers nobody reads */
  kg_arena arena;
};

/* Stages of inverse dynamics; each uses what the ones before it left in links. */
void kg_links_pose(kg_dynamics *d, const double *q);
void kg_links_velocity(kg_dynamics *d, const double *v);
/* Both, the acceleration and the rate of momentum, (1) to (4). */
void kg_links_move(kg_dynamics *d, const double *q, const double *v, const double *a);
/* tau = S' (inertial - external), summed from the leaves to the root. */
void kg_links_project(const kg_dynamics *d, double *tau);

/* S, psi, psi_dot, moved and the sums over subtrees, after kg_links_move. K, D, external and
 * loaded of the sums must hold the segments' own values (kg_tree_clear_external for none). */
void kg_tree_clear_external(kg_dynamics *d);
/* The sum of a segment, to which K and D can be added: zero at first, with the link's external force. */
kg_composite *kg_tree_load(kg_dynamics *d, int segment);
void kg_tree_prepare(kg_dynamics *d);
/* The pencil of block b, after kg_tree_prepare:
 *   T = S E,  U = psi E + rate S,  W = psi_dot E + rate moved + acceleration S
 * for the pose moved by E per unit, the velocity of the block by rate, its acceleration by
 * acceleration; E NULL: zero. */
void kg_tree_pencil(kg_dynamics *d, int b, const kg_mat3 *E, double rate, double acceleration);
/* A = S' (d inertial - d external) for the pencil of every block. */
void kg_tree_jacobian(const kg_dynamics *d, kg_tree_matrix *A);
/* of all links, as they are now: masses may have changed since the body was made */
double kg_links_mass(const kg_dynamics *d);
/* diag(M) at the pose of the links. */
void kg_links_mass_diagonal(kg_dynamics *d, double *diagonal);

#endif
