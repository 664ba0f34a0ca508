/* Queries: the interpolant, and what is certain about it.
 *
 *   x_i, v_i, g_i   the nodes around x, their values and gradients
 *   c_i             = x_i - v_i g_i, of a mesh: the closest point of the surface to x_i
 *
 * |Phi| changes by no more than the way gone, and no point of the surface is nearer than Phi says:
 *
 *   |v_i| - |x - x_i|  <=  |Phi(x)|  <=  |v_i| + |x - x_i|,    |Phi(x)| <= |x - c_i|
 *
 * Phi itself obeys the first one with its sign unless it jumps behind the border of an open mesh. */
#include "sdf/grid_internal.h"

kg_sdf_value grid_ask(const kg_grid_source *source, kg_vec3 x)
{
  return source->mesh ? kg_mesh_distance(source->mesh, x) : source->field(x, source->user);
}

static bool has_source(const kg_grid *grid)
{
  return grid->source.mesh || grid->source.field;
}

kg_grid_info kg_grid_describe(const kg_grid *grid)
{
  const grid_view *g = &grid->view;
  return (kg_grid_info){g->lo, grid->hi, g->spacing, {g->n[0], g->n[1], g->n[2]}, grid->slack};
}

/* index of the node nearest to a coordinate, or with nearest false of the cell that holds it */
static int clamped_index(double offset, double spacing, int n, bool nearest)
{
  const double at = floor(offset / spacing + (nearest ? 0.5 : 0.0));
  const int last = nearest ? n - 1 : n - 2;
  return at > 0.0 ? (at < last ? (int)at : last) : 0;
}

static const float *node_at(const grid_view *g, int i, int j, int k)
{
  return g->node + 4 * (((size_t)k * (size_t)g->n[1] + (size_t)j) * (size_t)g->n[0] + (size_t)i);
}

/* least and greatest that Phi(x) can be */
typedef struct interval {
  double lo, hi;
} interval;

static interval bracket(const kg_grid *grid, kg_vec3 x)
{
  const grid_view *g = &grid->view;
  const kg_vec3 d = kg_vec3_sub(x, g->lo);
  const int i = clamped_index(d.x, g->spacing, g->n[0], false);
  const int j = clamped_index(d.y, g->spacing, g->n[1], false);
  const int k = clamped_index(d.z, g->spacing, g->n[2], false);
  interval sure = {-INFINITY, INFINITY};
  double most = INFINITY; /* of |Phi| */
  for (int corner = 0; corner < 8; corner++) {
    const int at[3] = {i + corner % 2, j + corner / 2 % 2, k + corner / 4};
    const float *node = node_at(g, at[0], at[1], at[2]);
    const double v = (double)node[0];
    const kg_vec3 off = kg_vec3_sub(x, grid_place(g, at[0], at[1], at[2]));
    const double way = kg_vec3_norm(off) + grid->slack;
    sure.lo = fmax(sure.lo, v - way);
    sure.hi = fmin(sure.hi, v + way);
    most = fmin(most, fabs(v) + way);
    if (grid->has_closest) {
      const kg_vec3 n = {(double)node[1], (double)node[2], (double)node[3]};
      most = fmin(most, kg_vec3_norm(kg_vec3_add_scaled(off, v, n)) + grid->slack);
    }
  }
  if (!grid->is_continuous) return (interval){-most, most};
  return (interval){fmax(sure.lo, -most), fmin(sure.hi, most)};
}

static bool interpolated(const kg_grid *grid, kg_vec3 x, kg_grid_value *out)
{
  bool inside;
  *out = (kg_grid_value){.is_exact = false};
  grid->kernels->interpolate(&grid->view, 1, &x, &out->distance, &out->gradient, &inside);
  if (!inside) return false;
  const interval sure = bracket(grid, x);
  out->error = fmax(fabs(sure.hi - out->distance), fabs(sure.lo - out->distance));
  return true;
}

/* Outside of the box, or not a number. */
static kg_grid_value beside(const kg_grid *grid, kg_vec3 x)
{
  if (has_source(grid)) {
    const kg_sdf_value value = grid_ask(&grid->source, x);
    return (kg_grid_value){value.distance, value.normal, 0.0, true};
  }
  if (!(kg_vec3_norm(x) < 1e17)) { /* farther than any grid */
    return (kg_grid_value){kg_vec3_norm(x), {0.0, 1.0, 0.0}, INFINITY, false};
  }
  const kg_vec3 lo = grid->view.lo, hi = grid->hi;
  const kg_vec3 p = {fmin(fmax(x.x, lo.x), hi.x), fmin(fmax(x.y, lo.y), hi.y),
                     fmin(fmax(x.z, lo.z), hi.z)};
  kg_grid_value out;
  const bool inside = interpolated(grid, p, &out);
  KG_ASSERT(inside);
  (void)inside;
  const kg_vec3 out_of = kg_vec3_sub(x, p);
  const double way = kg_vec3_norm(out_of);
  out.distance += way;
  out.gradient = kg_vec3_normalized(out_of);
  out.error += 2.0 * way;
  return out;
}

kg_grid_value kg_grid_distance(const kg_grid *grid, kg_vec3 x)
{
  kg_grid_value out;
  return interpolated(grid, x, &out) ? out : beside(grid, x);
}

void kg_grid_distance_many(const kg_grid *grid, int count, const kg_vec3 *x, double *distance,
                           kg_vec3 *gradient)
{
  enum { SHARE = 256 };
  bool inside[SHARE];
  for (int first = 0; first < count; first += SHARE) {
    const int n = count - first < SHARE ? count - first : SHARE;
    grid->kernels->interpolate(&grid->view, n, x + first, distance + first, gradient + first,
                               inside);
    for (int i = 0; i < n; i++) {
      if (inside[i]) continue;
      const kg_grid_value value = beside(grid, x[first + i]);
      distance[first + i] = value.distance;
      gradient[first + i] = value.gradient;
    }
  }
}

double kg_grid_lower_bound(const kg_grid *grid, kg_vec3 x)
{
  const grid_view *g = &grid->view;
  const kg_vec3 d = kg_vec3_sub(x, g->lo);
  const int i = clamped_index(d.x, g->spacing, g->n[0], true);
  const int j = clamped_index(d.y, g->spacing, g->n[1], true);
  const int k = clamped_index(d.z, g->spacing, g->n[2], true);
  const kg_vec3 off = kg_vec3_sub(x, grid_place(g, i, j, k));
  const double bound = fabs((double)*node_at(g, i, j, k)) - kg_vec3_norm(off) - grid->slack;
  return bound > 0.0 ? bound : 0.0; /* 0 for NaN too */
}

bool kg_grid_distance_within(const kg_grid *grid, kg_vec3 x, double limit, kg_sdf_value *value)
{
  KG_ASSERT(has_source(grid));
  if (!(limit > 0.0) || kg_grid_lower_bound(grid, x) >= limit) return false;
  if (grid->source.mesh) return kg_mesh_distance_within(grid->source.mesh, x, limit, NULL, value);
  const kg_sdf_value asked = grid->source.field(x, grid->source.user);
  if (fabs(asked.distance) >= limit) return false;
  *value = asked;
  return true;
}
