/* Matrices with the sparsity of the kinematic tree: their places in memory. What is computed with
 * them is in kernels/. */
#include "physics/tree.h"

#include "physics/kernels/kernels.h"

#include <string.h>

static void list_descendants(kg_tree *tree)
{
  int listed = 0;
  for (int a = 0; a < tree->blocks; a++) {
    tree->below_start[a] = listed;
    for (int b = a + 1; b < tree->blocks; b++) {
      const int deep = tree->depth[a];
      if (tree->depth[b] > deep && tree->path[tree->start[b] + deep] == a) {
        tree->below[listed++] = b;
      }
    }
  }
  tree->below_start[tree->blocks] = listed;
}

/* One number of padding at least, so that rows may be written four numbers at a time. */
static void lay_out_panels(kg_tree *tree)
{
  for (int b = 0; b < tree->blocks; b++) {
    tree->width[b] = (3 * tree->depth[b] + 4 + 7) / 8 * 8;
    tree->panel[b] = tree->size;
    tree->size += 3 * tree->width[b];
  }
}

void kg_tree_init(kg_tree *tree, const kg_body *body, kg_arena *arena)
{
  const int blocks = body->segment_count + 1;
  *tree = (kg_tree){.blocks = blocks,
                    .depth = KG_ARENA_ARRAY(arena, int, blocks),
                    .start = KG_ARENA_ARRAY(arena, int, blocks),
                    .below_start = KG_ARENA_ARRAY(arena, int, blocks + 1),
                    .width = KG_ARENA_ARRAY(arena, int, blocks),
                    .panel = KG_ARENA_ARRAY(arena, int, blocks),
                    .work = KG_ARENA_ARRAY(arena, double, 24 * blocks),
                    .kernels = kg_physics_kernels_best()};
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
  tree->below = KG_ARENA_ARRAY(arena, int, tree->entries);
  if (kg_arena_failed(arena)) {
    return;
  }
  for (int b = 1; b < blocks; b++) {
    const int parent = b == 1 ? 0 : body->segments[b - 1].parent + 1;
    int *row = tree->path + tree->start[b];
    memcpy(row, tree->path + tree->start[parent], (size_t)tree->depth[b] * sizeof *row);
    row[tree->depth[b]] = b;
  }
  list_descendants(tree);
  lay_out_panels(tree);
}

void kg_tree_matrix_init(kg_tree_matrix *A, const kg_tree *tree, kg_arena *arena)
{
  A->low = KG_ARENA_ARRAY(arena, double, tree->size);
  A->up = KG_ARENA_ARRAY(arena, double, tree->size);
}

kg_mat3 kg_tree_low(const kg_tree *tree, const kg_tree_matrix *A, int b, int k)
{
  const double *panel = A->low + tree->panel[b] + 3 * k;
  kg_mat3 block;
  for (int r = 0; r < 3; r++) {
    memcpy(block.m + 3 * r, panel + r * tree->width[b], 3 * sizeof *panel);
  }
  return block;
}

kg_mat3 kg_tree_up(const kg_tree *tree, const kg_tree_matrix *A, int b, int k)
{
  const double *panel = A->up + tree->panel[b] + 3 * k;
  kg_mat3 block;
  for (int i = 0; i < 9; i++) {
    block.m[i] = panel[i % 3 * tree->width[b] + i / 3];
  }
  return block;
}

void kg_tree_set_low(const kg_tree *tree, kg_tree_matrix *A, int b, int k, const kg_mat3 *block)
{
  double *panel = A->low + tree->panel[b] + 3 * k;
  for (int r = 0; r < 3; r++) {
    memcpy(panel + r * tree->width[b], block->m + 3 * r, 3 * sizeof *panel);
  }
}

void kg_tree_set_up(const kg_tree *tree, kg_tree_matrix *A, int b, int k, const kg_mat3 *block)
{
  double *panel = A->up + tree->panel[b] + 3 * k;
  for (int i = 0; i < 9; i++) {
    panel[i % 3 * tree->width[b] + i / 3] = block->m[i];
  }
}

void kg_tree_add_diagonal(const kg_tree *tree, kg_tree_matrix *A, int b, double s,
                          const kg_mat3 *block)
{
  double *panel = A->low + tree->panel[b] + 3 * tree->depth[b];
  for (int i = 0; i < 9; i++) {
    panel[i / 3 * tree->width[b] + i % 3] += s * block->m[i];
  }
}

bool kg_tree_factor(const kg_tree *tree, kg_tree_matrix *A)
{
  return tree->kernels->factor(tree, A);
}

void kg_tree_solve(const kg_tree *tree, const kg_tree_matrix *A, double *x)
{
  tree->kernels->solve(tree, A, x);
}

void kg_tree_solve_from(const kg_tree *tree, const kg_tree_matrix *A, double *x, const int *blocks,
                        int count)
{
  tree->kernels->solve_from(tree, A, x, blocks, count);
}

void kg_tree_solve_transposed(const kg_tree *tree, const kg_tree_matrix *A, double *x)
{
  tree->kernels->solve_transposed(tree, A, x);
}

void kg_tree_solve_many(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns)
{
  tree->kernels->solve_many(tree, A, X, columns, NULL, 0);
}

void kg_tree_solve_many_within(const kg_tree *tree, const kg_tree_matrix *A, double *X, int columns,
                               const int *blocks, int count)
{
  tree->kernels->solve_many(tree, A, X, columns, blocks, count);
}

void kg_tree_solve_transposed_many(const kg_tree *tree, const kg_tree_matrix *A, double *X,
                                   int columns)
{
  tree->kernels->solve_transposed_many(tree, A, X, columns, NULL, 0);
}

/* Columns of the path of block b: a row of the lower panel lies in the same row of out, a row of
 * the upper one in a column. */
static void scatter_panels(const kg_tree *tree, const kg_tree_matrix *A, int b, double *out)
{
  const int nv = 3 * tree->blocks, width = tree->width[b];
  const int *path = tree->path + tree->start[b];
  for (int r = 0; r < 3; r++) {
    const double *low = A->low + tree->panel[b] + r * width;
    const double *up = A->up + tree->panel[b] + r * width;
    double *row = out + (size_t)(3 * b + r) * (size_t)nv;
    for (int k = 0; k <= tree->depth[b]; k++) {
      memcpy(row + 3 * path[k], low + 3 * k, 3 * sizeof *row);
    }
    for (int k = 0; k < 3 * tree->depth[b]; k++) {
      out[(size_t)(3 * path[k / 3] + k % 3) * (size_t)nv + (size_t)(3 * b + r)] = up[k];
    }
  }
}

void kg_tree_to_dense(const kg_tree *tree, const kg_tree_matrix *A, double *out)
{
  const int nv = 3 * tree->blocks;
  memset(out, 0, (size_t)nv * (size_t)nv * sizeof *out);
  for (int b = 0; b < tree->blocks; b++) {
    scatter_panels(tree, A, b, out);
  }
}
