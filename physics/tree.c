/* Matrices with the sparsity of the kinematic tree: factors and solutions.
 *
 * Eliminating a block that has no descendants left changes only the blocks among its ancestors, and
 * these are in the pattern already: no fill-in [RBDA, section 6.4 for the symmetric case]. The same
 * holds for the non-symmetric Jacobian of a step, because contact forces depend on the motion of
 * their own path only (docs/theory/contact.md). */
#include "physics/tree.h"

#include "physics/rows.h"

#include <float.h>
#include <string.h>

void kg_tree_init(kg_tree *tree, const kg_body *body, kg_arena *arena)
{
  const int blocks = body->segment_count + 1;
  *tree = (kg_tree){.blocks = blocks,
                    .depth = KG_ARENA_ARRAY(arena, int, blocks),
                    .start = KG_ARENA_ARRAY(arena, int, blocks)};
  if (kg_arena_failed(arena)) {
    return;
  }
  for (int b = 1; b < blocks; b++) {
    const int parent = b == 1 ? 0 : body->segments[b - 1].parent + 1;
    tree->depth[b] = tree->depth[parent] + 1;
    tree->start[b] = tree->start[b - 1] + tree->depth[b - 1] + 1;
  }
  tree->entries = tree->start[blocks - 1] + tree->depth[blocks - 1] + 1;
  tree->path = KG_ARENA_ARRAY(arena, int, tree->entries);
  if (kg_arena_failed(arena)) {
    return;
  }
  for (int b = 1; b < blocks; b++) {
    const int parent = b == 1 ? 0 : body->segments[b - 1].parent + 1;
    int *row = tree->path + tree->start[b];
    memcpy(row, tree->path + tree->start[parent], (size_t)tree->depth[b] * sizeof *row);
    row[tree->depth[b]] = b;
  }
}

void kg_tree_matrix_init(kg_tree_matrix *A, const kg_tree *tree, kg_arena *arena)
{
  A->low = KG_ARENA_ARRAY(arena, kg_mat3, tree->entries);
  A->up = KG_ARENA_ARRAY(arena, kg_mat3, tree->entries);
}

static void swap_rows(double *A, int i, int j)
{
  for (int k = 0; k < 3; k++) {
    const double t = A[3 * i + k];
    A[3 * i + k] = A[3 * j + k];
    A[3 * j + k] = t;
  }
}

/* A := A^-1 by Gauss-Jordan with row pivoting; false when a pivot is below eps * scale. */
static bool invert(kg_mat3 *A, double scale)
{
  double *a = A->m;
  kg_mat3 inverse = kg_mat3_identity();
  double *b = inverse.m;
  for (int c = 0; c < 3; c++) {
    int pivot = c;
    for (int r = c + 1; r < 3; r++) {
      pivot = fabs(a[3 * r + c]) > fabs(a[3 * pivot + c]) ? r : pivot;
    }
    if (!(fabs(a[3 * pivot + c]) > 4.0 * DBL_EPSILON * scale)) {
      return false; /* also when not a number */
    }
    if (pivot != c) {
      swap_rows(a, pivot, c);
      swap_rows(b, pivot, c);
    }
    const double s = 1.0 / a[3 * c + c];
    for (int k = 0; k < 3; k++) {
      a[3 * c + k] *= s;
      b[3 * c + k] *= s;
    }
    for (int r = 0; r < 3; r++) {
      const double m = a[3 * r + c];
      for (int k = 0; k < 3 && r != c; k++) {
        a[3 * r + k] -= m * a[3 * c + k];
        b[3 * r + k] -= m * b[3 * c + k];
      }
    }
  }
  *A = inverse;
  return true;
}

static double largest(const kg_mat3 *A)
{
  double size = 0.0;
  for (int k = 0; k < 9; k++) {
    size = fmax(size, fabs(A->m[k]));
  }
  return size;
}

/* C -= A B */
static inline void subtract_product(kg_mat3 *C, const kg_mat3 *A, const kg_mat3 *B)
{
  const rows3 b = load_rows(B);
  for (int i = 0; i < 3; i++) {
    add_row(C->m + 3 * i, -A->m[3 * i], -A->m[3 * i + 1], -A->m[3 * i + 2], &b);
  }
}

/* For block b with pivot D and ancestors j, l:  A_jl -= A_jb D^-1 A_bl.  Afterwards low holds
 * D^-1 A_bl (the factor U), the diagonal D^-1, and up the untouched A_jb (the factor L). */
bool kg_tree_factor(const kg_tree *tree, kg_tree_matrix *A)
{
  for (int b = tree->blocks - 1; b >= 0; b--) {
    const int depth = tree->depth[b];
    const int *path = tree->path + tree->start[b];
    kg_mat3 *low = A->low + tree->start[b];
    const kg_mat3 *up = A->up + tree->start[b];
    if (!invert(&low[depth], largest(&low[depth]))) {
      return false;
    }
    for (int l = 0; l < depth; l++) {
      low[l] = kg_mat3_mul(low[depth], low[l]);
    }
    for (int j = 0; j < depth; j++) {
      kg_mat3 *row = A->low + tree->start[path[j]];
      for (int l = 0; l <= j; l++) {
        subtract_product(&row[l], &up[j], &low[l]);
      }
      for (int l = j + 1; l < depth; l++) {
        subtract_product(&A->up[tree->start[path[l]] + j], &up[j], &low[l]);
      }
    }
  }
  return true;
}

void kg_tree_solve(const kg_tree *tree, const kg_tree_matrix *A, double *x)
{
  for (int b = tree->blocks - 1; b >= 0; b--) {
    const int depth = tree->depth[b], start = tree->start[b];
    const kg_vec3 y =
      kg_mat3_mul_vec(A->low[start + depth], (kg_vec3){x[3 * b], x[3 * b + 1], x[3 * b + 2]});
    x[3 * b] = y.x;
    x[3 * b + 1] = y.y;
    x[3 * b + 2] = y.z;
    for (int k = 0; k < depth; k++) {
      double *t = x + 3 * tree->path[start + k];
      const kg_vec3 s = kg_mat3_mul_vec(A->up[start + k], y);
      t[0] -= s.x;
      t[1] -= s.y;
      t[2] -= s.z;
    }
  }
  for (int b = 1; b < tree->blocks; b++) {
    const int depth = tree->depth[b], start = tree->start[b];
    for (int k = 0; k < depth; k++) {
      const double *t = x + 3 * tree->path[start + k];
      const kg_vec3 s = kg_mat3_mul_vec(A->low[start + k], kg_vec3_make(t[0], t[1], t[2]));
      x[3 * b] -= s.x;
      x[3 * b + 1] -= s.y;
      x[3 * b + 2] -= s.z;
    }
  }
}

/* A = L D U with unit U, so A' y = x is U' z = x from the leaves to the root, then D and L' back. */
void kg_tree_solve_transposed(const kg_tree *tree, const kg_tree_matrix *A, double *x)
{
  for (int b = tree->blocks - 1; b >= 1; b--) {
    const int depth = tree->depth[b], start = tree->start[b];
    const kg_vec3 y = kg_vec3_make(x[3 * b], x[3 * b + 1], x[3 * b + 2]);
    for (int k = 0; k < depth; k++) {
      double *t = x + 3 * tree->path[start + k];
      const kg_vec3 s = kg_mat3_mul_vec_t(A->low[start + k], y);
      t[0] -= s.x;
      t[1] -= s.y;
      t[2] -= s.z;
    }
  }
  for (int b = 0; b < tree->blocks; b++) {
    const int depth = tree->depth[b], start = tree->start[b];
    kg_vec3 y = kg_vec3_make(x[3 * b], x[3 * b + 1], x[3 * b + 2]);
    for (int k = 0; k < depth; k++) {
      const double *t = x + 3 * tree->path[start + k];
      y = kg_vec3_sub(y, kg_mat3_mul_vec_t(A->up[start + k], kg_vec3_make(t[0], t[1], t[2])));
    }
    y = kg_mat3_mul_vec_t(A->low[start + depth], y);
    x[3 * b] = y.x;
    x[3 * b + 1] = y.y;
    x[3 * b + 2] = y.z;
  }
}

static void put_block(double *out, int stride, int row, int column, const kg_mat3 *A)
{
  for (int i = 0; i < 3; i++) {
    memcpy(out + (size_t)(3 * row + i) * (size_t)stride + 3 * column, A->m + 3 * i,
           3 * sizeof *out);
  }
}

void kg_tree_to_dense(const kg_tree *tree, const kg_tree_matrix *A, double *out)
{
  const int nv = 3 * tree->blocks;
  memset(out, 0, (size_t)nv * (size_t)nv * sizeof *out);
  for (int b = 0; b < tree->blocks; b++) {
    const int start = tree->start[b];
    for (int k = 0; k < tree->depth[b]; k++) {
      put_block(out, nv, b, tree->path[start + k], &A->low[start + k]);
      put_block(out, nv, tree->path[start + k], b, &A->up[start + k]);
    }
    put_block(out, nv, b, b, &A->low[start + tree->depth[b]]);
  }
}
