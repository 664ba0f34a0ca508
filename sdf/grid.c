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

/* The cell around a point, or the one nearest to it, and the block that holds it. */
typedef struct spot {
  int cell[3], nearest[3]; /* nodes, counted from the block's first */
  int first[3];            /* node of the block */
  int block;               /* -1: without nodes */
  const float *center;
  kg_vec3 center_place;
} spot;

static spot find_spot(const grid_view *g, kg_vec3 x)
{
  spot s;
  const double offset[3] = {x.x - g->lo.x, x.y - g->lo.y, x.z - g->lo.z};
  int of[3]; /* the block */
  for (int axis = 0; axis < 3; axis++) {
    const int cell = clamped_index(offset[axis], g->spacing, g->n[axis], false);
    of[axis] = cell / GRID_SIDE;
    s.first[axis] = of[axis] * GRID_SIDE;
    s.cell[axis] = cell - s.first[axis];
    s.nearest[axis] = clamped_index(offset[axis], g->spacing, g->n[axis], true) - s.first[axis];
  }
  const size_t at = grid_block_at(g, of[0], of[1], of[2]);
  s.block = g->block[at];
  s.center = g->center + 4 * at;
  s.center_place = grid_center_place(g, of[0], of[1], of[2]);
  return s;
}

static kg_vec3 place_in(const grid_view *g, const spot *s, const int at[3])
{
  return grid_place(g, s->first[0] + at[0], s->first[1] + at[1], s->first[2] + at[2]);
}

/* least and greatest that Phi(x) can be, and the greatest of |Phi(x)| */
typedef struct interval {
  double lo, hi, most;
} interval;

/* by the values of a node `off` away from x */
static void tighten(const kg_grid *grid, const float *node, kg_vec3 off, interval *sure)
{
  const double v = (double)node[0], way = kg_vec3_norm(off) + grid->slack;
  sure->lo = fmax(sure->lo, v - way);
  sure->hi = fmin(sure->hi, v + way);
  sure->most = fmin(sure->most, fabs(v) + way);
  if (grid->has_closest) {
    const kg_vec3 n = {(double)node[1], (double)node[2], (double)node[3]};
    sure->most = fmin(sure->most, kg_vec3_norm(kg_vec3_add_scaled(off, v, n)) + grid->slack);
  }
}

/* by the nodes of the cell around x, where there are none by the block's center */
static interval bracket(const kg_grid *grid, const spot *s, kg_vec3 x)
{
  const grid_view *g = &grid->view;
  interval sure = {-INFINITY, INFINITY, INFINITY};
  for (int corner = 0; corner < 8 && s->block >= 0; corner++) {
    const int at[3] = {s->cell[0] + corner % 2, s->cell[1] + corner / 2 % 2,
                       s->cell[2] + corner / 4};
    tighten(grid, g->node + 4 * grid_node_at(s->block, at[0], at[1], at[2]),
            kg_vec3_sub(x, place_in(g, s, at)), &sure);
  }
  if (s->block < 0) tighten(grid, s->center, kg_vec3_sub(x, s->center_place), &sure);
  if (!grid->is_continuous) return (interval){-sure.most, sure.most, sure.most};
  return (interval){fmax(sure.lo, -sure.most), fmin(sure.hi, sure.most), sure.most};
}

static double largest_error(interval sure, double distance)
{
  return fmax(fabs(sure.hi - distance), fabs(sure.lo - distance));
}

static bool interpolated(const kg_grid *grid, kg_vec3 x, kg_grid_value *out)
{
  int unknown;
  *out = (kg_grid_value){.is_exact = false};
  if (grid->kernels->interpolate(&grid->view, 1, &x, &out->distance, &out->gradient, &unknown) >
      0) {
    return false;
  }
  const spot s = find_spot(&grid->view, x);
  out->error = largest_error(bracket(grid, &s, x), out->distance);
  return true;
}

/* x in the box: the interpolant, or the plane through the center of a block without nodes */
static kg_grid_value without_source(const kg_grid *grid, kg_vec3 x)
{
  kg_grid_value out;
  if (interpolated(grid, x, &out)) return out;
  const spot s = find_spot(&grid->view, x);
  out.gradient = (kg_vec3){(double)s.center[1], (double)s.center[2], (double)s.center[3]};
  out.distance = (double)s.center[0] + kg_vec3_dot(out.gradient, kg_vec3_sub(x, s.center_place));
  out.error = largest_error(bracket(grid, &s, x), out.distance);
  return out;
}

/* Outside of the box or in a block without nodes, or not a number. */
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
  kg_grid_value out = without_source(grid, p);
  const kg_vec3 out_of = kg_vec3_sub(x, p);
  const double way = kg_vec3_norm(out_of);
  if (!(way > 0.0)) return out;
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
  enum { SHARE = 1024 };
  int unknown[SHARE];
  for (int first = 0; first < count; first += SHARE) {
    const int n = count - first < SHARE ? count - first : SHARE;
    const int unknown_count = grid->kernels->interpolate(
      &grid->view, n, x + first, distance + first, gradient + first, unknown);
    for (int i = 0; i < unknown_count; i++) {
      const int at = first + unknown[i];
      const kg_grid_value value = beside(grid, x[at]);
      distance[at] = value.distance;
      gradient[at] = value.gradient;
    }
  }
}

double kg_grid_lower_bound(const kg_grid *grid, kg_vec3 x)
{
  const grid_view *g = &grid->view;
  const spot s = find_spot(g, x);
  const bool has_nodes = s.block >= 0;
  const int *at = s.nearest;
  const float *node =
    has_nodes ? g->node + 4 * grid_node_at(s.block, at[0], at[1], at[2]) : s.center;
  const kg_vec3 off = kg_vec3_sub(x, has_nodes ? place_in(g, &s, at) : s.center_place);
  const double bound = fabs((double)*node) - kg_vec3_norm(off) - grid->slack;
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
