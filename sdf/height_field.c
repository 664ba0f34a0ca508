/* Height fields as triangle meshes: the grid, and a far border that continues its edge heights.
 *
 * Vertices of row r and column c at origin + (c s, h, r s), s = spacing. Each cell is cut along the
 * diagonal from (r, c) to (r + 1, c + 1). One more ring of vertices stands REACH grid diagonals (and
 * 100 m) further out at the heights of the border. Beyond half of that the surface no longer changes
 * outwards, so a query point is moved in: exact while |Phi| is below the half. */
#include "kinegrad/sdf.h"

#include "kinegrad/arena.h"

#include <limits.h>

#define REACH 4.0

struct kg_height_field {
  kg_arena arena;
  kg_mesh *mesh;
  kg_vec3 lo, hi; /* query points are moved into x and z between these */
};

/* vertices of the extended grid: (rows + 2, columns + 2) */
static void fill_vertices(kg_vec3 *vertices, const double *heights, int rows, int columns,
                          double spacing, kg_vec3 origin, double reach)
{
  for (int r = -1; r <= rows; r++) {
    for (int c = -1; c <= columns; c++) {
      const int inner_r = r < 0 ? 0 : r == rows ? rows - 1 : r;
      const int inner_c = c < 0 ? 0 : c == columns ? columns - 1 : c;
      const double h = heights[(size_t)inner_r * (size_t)columns + (size_t)inner_c];
      *vertices++ = kg_vec3_add(origin, kg_vec3_make(inner_c * spacing + (c - inner_c) * reach, h,
                                                     inner_r * spacing + (r - inner_r) * reach));
    }
  }
}

static void fill_triangles(int *triangles, int rows, int columns)
{
  for (int r = 0; r < rows - 1; r++) {
    for (int c = 0; c < columns - 1; c++) {
      const int a = r * columns + c, b = a + columns; /* b: next row */
      const int pair[6] = {a, b, b + 1, a, b + 1, a + 1};
      for (int k = 0; k < 6; k++) {
        *triangles++ = pair[k];
      }
    }
  }
}

static kg_status build(kg_height_field *field, const double *heights, int rows, int columns,
                       double spacing, kg_vec3 origin, const kg_allocator *allocator)
{
  const double width = (columns - 1) * spacing, depth = (rows - 1) * spacing;
  const double reach = REACH * hypot(width, depth) + 100.0;
  field->lo = kg_vec3_sub(origin, kg_vec3_make(0.5 * reach, 0.0, 0.5 * reach));
  field->hi = kg_vec3_add(origin, kg_vec3_make(width + 0.5 * reach, 0.0, depth + 0.5 * reach));
  const int all_rows = rows + 2, all_columns = columns + 2;
  const int vertex_count = all_rows * all_columns;
  const int triangle_count = 2 * (all_rows - 1) * (all_columns - 1);
  kg_arena scratch;
  kg_arena_init(&scratch, allocator);
  kg_vec3 *vertices = KG_ARENA_ARRAY(&scratch, kg_vec3, vertex_count);
  int *triangles = KG_ARENA_ARRAY(&scratch, int, 3 * (size_t)triangle_count);
  kg_status status = KG_ERR_NO_MEMORY;
  if (vertices && triangles) {
    fill_vertices(vertices, heights, rows, columns, spacing, origin, reach);
    fill_triangles(triangles, all_rows, all_columns);
    status = kg_mesh_create(&field->mesh, vertices, vertex_count, triangles, triangle_count, NULL,
                            allocator, NULL);
  }
  kg_arena_release(&scratch);
  return status;
}

kg_status kg_height_field_create(kg_height_field **field, const double *heights, int rows,
                                 int columns, double spacing, kg_vec3 origin,
                                 const kg_allocator *allocator)
{
  KG_ASSERT(field && heights && rows >= 2 && columns >= 2 && spacing > 0.0);
  *field = NULL;
  if ((long long)(rows + 2LL) * (columns + 2LL) > INT_MAX / 16) return KG_ERR_UNSUPPORTED;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_height_field *built = KG_ARENA_ARRAY(&arena, kg_height_field, 1);
  if (!built) return KG_ERR_NO_MEMORY;
  built->arena = arena;
  const kg_status status = build(built, heights, rows, columns, spacing, origin, allocator);
  if (status != KG_OK) {
    kg_height_field_destroy(built);
    return status;
  }
  *field = built;
  return KG_OK;
}

void kg_height_field_destroy(kg_height_field *field)
{
  if (field) {
    kg_mesh_destroy(field->mesh);
    kg_arena arena = field->arena; /* the field lives in its own arena */
    kg_arena_release(&arena);
  }
}

kg_sdf_value kg_height_field_distance(const kg_height_field *field, kg_vec3 x)
{
  x.x = x.x < field->lo.x ? field->lo.x : x.x > field->hi.x ? field->hi.x : x.x;
  x.z = x.z < field->lo.z ? field->lo.z : x.z > field->hi.z ? field->hi.z : x.z;
  return kg_mesh_distance(field->mesh, x);
}
