/* Contact force of one point with a scene and its exact derivatives.
 *
 * Equation numbers refer to docs/theory/contact.md: normal law (1) to (3), friction (4) and (5),
 * derivatives (6) to (8). Phi signed distance, n its gradient, H its Hessian, u velocity of the
 * point, u_t its part along the surface. */
#include "physics/contact_law.h"

kg_contact_params kg_contact_default_params(void)
{
  const kg_contact_params params = {.layer = 0.006,
                                    .force = 140.0,
                                    .floor_share = 0.02,
                                    .damping = 1.0,
                                    .friction = 0.9,
                                    .stick = 3e-4};
  return params;
}

bool kg_contact_params_are_valid(const kg_contact_params *p)
{
  const bool law =
    p->layer > 0.0 && p->force >= 0.0 && p->floor_share > 0.0 && p->floor_share < 1.0;
  const bool motion = p->damping >= 0.0 && p->friction >= 0.0 && p->stick > 0.0;
  return law && motion && isfinite(p->layer + p->force + p->damping + p->friction + p->stick);
}

double kg_contact_reach(const kg_contact_params *params, const kg_ground *ground)
{
  return ground ? params->layer + ground->thickness : params->layer;
}

double kg_contact_friction(const kg_contact_params *params, const kg_ground *ground)
{
  return ground && ground->friction >= 0.0 ? ground->friction : params->friction;
}

/* ---- what acts on a point ----------------------------------------------------------------------*/

static kg_contact_site site_of(const kg_scene *scene, const kg_scene_point *at)
{
  kg_contact_site site = {
    .value = at->value, .slope = 1.0, .velocity = at->velocity, .ground = at->ground};
  if (at->shape < 0) return site;
  const kg_sdf_shape *shape = &scene->shapes[at->shape];
  if (shape->place > 0) site.spin = scene->places[shape->place - 1].spin;
  if (shape->kind == KG_SHAPE_SMOOTH_UNION) {
    site.slope = kg_vec3_norm(site.value.normal);
    site.value.normal = kg_vec3_normalized(site.value.normal);
  }
  return site;
}

/* Where grounds differ: the shape with the largest force at rest, else with the nearest layer */
static kg_scene_point find_strongest(const kg_contact_params *params, const kg_scene *scene,
                                     kg_vec3 x)
{
  kg_scene_point best = {.value = {INFINITY, {0.0, 1.0, 0.0}, {0.0}}, .shape = -1};
  double most = 0.0, least = INFINITY; /* force; way to the layer while there is none */
  for (int i = 0; i < scene->shape_count; i++) {
    const kg_sdf_shape *shape = &scene->shapes[i];
    const kg_ground *ground = shape->ground > 0 ? &scene->grounds[shape->ground - 1] : NULL;
    const double reach = kg_contact_reach(params, ground);
    kg_sdf_value value;
    if (shape->part ||
        !kg_scene_shape_distance(scene, i, x, least < 0.0 ? reach : least + reach, &value)) {
      continue;
    }
    const double force = kg_contact_normal(params, ground, value.distance, 0.0).force;
    const double way = value.distance - reach;
    const bool is_undefined = isnan(way); /* not taken for far away */
    if (!(force > most || (most == 0.0 && way < least) || is_undefined)) continue;
    most = force;
    least = fmin(least, way);
    best = (kg_scene_point){.value = value, .shape = i, .ground = ground};
    if (shape->place > 0) {
      best.velocity = kg_place_velocity(&scene->places[shape->place - 1], x);
    }
    if (is_undefined) break;
  }
  return best;
}

kg_contact_site kg_contact_find(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x)
{
  const kg_sdf_shape *plane = kg_only_plane(scene);
  if (plane) {
    return (kg_contact_site){
      .value = {.distance = kg_vec3_dot(plane->b, kg_vec3_sub(x, plane->a)), .normal = plane->b},
      .slope = 1.0};
  }
  const kg_scene_point at =
    scene->ground_count > 0 ? find_strongest(params, scene, x) : kg_scene_nearest(scene, x);
  return site_of(scene, &at);
}

/* ---- friction and derivatives ------------------------------------------------------------------*/

/* dn/dx of the unit normal: H, and (1 - n n') H / |grad Phi| where the gradient is not a unit vector */
static kg_mat3 turn_of(const kg_contact_site *s)
{
  const kg_mat3 H = kg_sdf_hessian(&s->value);
  if (s->slope == 1.0) return H;
  const kg_vec3 n = s->value.normal, Hn = kg_mat3_mul_vec(H, n);
  return kg_mat3_scale(1.0 / s->slope, kg_mat3_add(H, kg_mat3_scale(-1.0, kg_mat3_outer(n, Hn))));
}

/* What (7) has of the curvature H = dn/dx of the ground: f_n H - push along (H'u)' - mu f_n W du_t/dx */
static kg_mat3 by_curvature(const kg_mat3 *H, kg_vec3 n, kg_vec3 u, double speed_n, double normal,
                            double push, kg_vec3 along, const kg_mat3 *dw)
{
  const kg_vec3 Hu = kg_mat3_mul_vec_t(*H, u);
  const kg_mat3 ut_x =
    kg_mat3_scale(-1.0, kg_mat3_add(kg_mat3_scale(speed_n, *H), kg_mat3_outer(n, Hu)));
  const kg_mat3 turned =
    kg_mat3_add(kg_mat3_scale(normal, *H), kg_mat3_outer(along, kg_vec3_scale(-push, Hu)));
  return kg_mat3_add(turned, kg_mat3_scale(-1.0, kg_mat3_mul(*dw, ut_x)));
}

/* (6) to (8); N the normal law, u relative to the shape, all at one point */
static void differentiate(const kg_contact_params *p, const kg_contact_site *s, kg_vec3 u,
                          const kg_normal_law *N, double bound, kg_contact_force *out)
{
  const kg_vec3 n = s->value.normal;
  const double speed_n = kg_vec3_dot(n, u);
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, n);
  const kg_slip w = kg_slip_at(p, u_t);
  const double push = -N->by_speed, friction = kg_contact_friction(p, s->ground);
  /* direction in which f grows with f_n: n - mu w(u_t); mu f_n dw/du_t = a 1 - b u_t u_t' */
  const kg_vec3 along = bound < 0.0 ? kg_vec3_add_scaled(n, -friction * w.factor, u_t) : n;
  const double mu_fn = friction * (bound < 0.0 ? out->normal : bound);
  const double a = mu_fn * w.factor, b = mu_fn * w.bend;
  const kg_vec3 column = kg_vec3_add_scaled(kg_vec3_scale(a, n), -push, along);
  out->df_du = kg_mat3_add(kg_mat3_outer(column, n), /* (8); u_t u_t' n = 0 */
                           kg_mat3_outer(kg_vec3_scale(b, u_t), u_t));
  out->df_dx = kg_mat3_outer(kg_vec3_scale(N->by_distance * s->slope, along), n); /* (7) */
  for (int k = 0; k < 9; k += 4) {
    out->df_du.m[k] -= a;
  }
  if (!kg_sdf_is_flat(&s->value)) {
    const kg_mat3 H = turn_of(s);
    const kg_mat3 dw =
      kg_mat3_add(kg_mat3_scale(a, kg_mat3_identity()), kg_mat3_scale(-b, kg_mat3_outer(u_t, u_t)));
    out->df_dx =
      kg_mat3_add(out->df_dx, by_curvature(&H, n, u, speed_n, out->normal, push, along, &dw));
  }
  if (kg_vec3_dot(s->spin, s->spin) > 0.0) { /* (8a) the shape's velocity changes along x */
    const kg_mat3 carried = kg_mat3_mul(out->df_du, kg_mat3_skew(s->spin));
    out->df_dx = kg_mat3_add(out->df_dx, kg_mat3_scale(-1.0, carried));
  }
}

bool kg_contact_evaluate_at(const kg_contact_params *params, const kg_contact_site *site, kg_vec3 u,
                            double bound, bool derivatives, kg_contact_force *out)
{
  KG_ASSERT(params->layer > 0.0 && params->stick > 0.0 && params->floor_share > 0.0);
  const kg_vec3 n = site->value.normal;
  const double distance = site->value.distance;
  *out = (kg_contact_force){
    .distance = distance, .direction = n, .velocity = site->velocity, .ground = site->ground};
  if (distance >= kg_contact_reach(params, site->ground)) return false;
  u = kg_vec3_sub(u, site->velocity);
  const double speed_n = kg_vec3_dot(n, u);
  const kg_normal_law N = kg_contact_normal(params, site->ground, distance, speed_n);
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, n);
  const kg_slip w = kg_slip_at(params, u_t);
  out->normal = N.force;
  const double mu_fn =
    kg_contact_friction(params, site->ground) * (bound < 0.0 ? out->normal : bound);
  out->f = kg_vec3_add_scaled(kg_vec3_scale(out->normal, n), -mu_fn * w.factor, u_t); /* (4) */
  if (derivatives) {
    differentiate(params, site, u, &N, bound, out);
  }
  return true;
}

/* Derivatives of the elastic force (1), (2) by layer, force and floor share. */
static void elastic_by_params(const kg_contact_params *p, double phi, double by[3])
{
  const double share = p->floor_share, layer = p->layer, floor = share * layer;
  if (phi >= floor) {
    const double d = layer - phi;
    by[0] = p->force * d * (layer + phi) / (layer * layer * phi);
    by[1] = d * d / (layer * phi);
    by[2] = 0.0;
    return;
  }
  /* N = F (1 - s)^2 / s - F (1 - s^2) / s^2 (phi / layer - s) */
  const double steep = (1.0 - share * share) / (share * share), below = phi / layer - share;
  by[0] = p->force * steep * phi / (layer * layer);
  by[1] = (1.0 - share) * (1.0 - share) / share - steep * below;
  by[2] = 2.0 * p->force / (share * share * share) * below;
}

/* Derivative of (1a) by the layer */
static double soft_by_layer(const kg_contact_params *p, const kg_ground *g, double phi)
{
  const double share = (g->thickness + p->layer - phi) / p->layer;
  return g->stiffness * (share >= 1.0 ? 0.5 : share - 0.5 * share * share);
}

/* Derivative of the factor of (5) by the stick velocity */
static double slip_by_stick(const kg_contact_params *p, double speed)
{
  if (speed >= p->stick) return 0.0;
  const double inverse = 1.0 / p->stick;
  return 2.0 * inverse * inverse * (speed * inverse - 1.0);
}

void kg_contact_params_vjp(const kg_contact_params *params, const kg_contact_force *force,
                           kg_vec3 u, kg_vec3 f_bar, double *params_bar)
{
  const kg_contact_params *p = params;
  const kg_contact_force *c = force;
  double *bar = params_bar;
  u = kg_vec3_sub(u, c->velocity);
  const double speed_n = kg_vec3_dot(c->direction, u);
  const double friction = kg_contact_friction(p, c->ground);
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, c->direction);
  const double factor = kg_slip_at(p, u_t).factor;
  const double along = kg_vec3_dot(f_bar, c->direction), across = kg_vec3_dot(f_bar, u_t);
  const double by_normal = along - friction * factor * across;
  if (c->distance < p->layer) {
    const kg_curve N = kg_elastic_at(p, c->distance), r = kg_ramp_at(1.0 - p->damping * speed_n);
    double by[3];
    elastic_by_params(p, c->distance, by);
    for (int k = 0; k < 3; k++) {
      bar[k] += by_normal * r.y * by[k];
    }
    bar[3] -= by_normal * N.y * r.slope * speed_n;
  }
  if (c->ground) {
    const double r = kg_ramp_at(1.0 - c->ground->damping * speed_n).y;
    bar[0] += by_normal * r * soft_by_layer(p, c->ground, c->distance);
  }
  if (!(c->ground && c->ground->friction >= 0.0)) {
    bar[4] -= c->normal * factor * across;
  }
  bar[5] -= c->normal * friction * slip_by_stick(p, kg_vec3_norm(u_t)) * across;
}

bool kg_contact_evaluate(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x,
                         kg_vec3 u, bool derivatives, kg_contact_force *out)
{
  return kg_contact_evaluate_bounded(params, scene, x, u, -1.0, derivatives, out);
}
