/* Contact force of one point with a scene and its exact derivatives.
 *
 * Equation numbers refer to docs/theory/contact.md: normal law (1) to (3), friction (4) and (5),
 * derivatives (6) to (8). Phi signed distance, n its gradient, H its Hessian, u velocity of the
 * point, u_t its part along the surface. */
#include "kinegrad/contact.h"

/* The ramp is smoothed where its argument is between -RAMP and RAMP; at rest it is 1. */
static const double RAMP = 0.1;

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

typedef struct curve {
  double y, slope;
} curve;

/* (1), (2) force of a point at rest and its derivative by Phi < layer */
static curve elastic(const kg_contact_params *p, double phi)
{
  const double floor = p->floor_share * p->layer;
  const double at = fmax(phi, floor);
  const double d = p->layer - at;
  const double unit = p->force / p->layer;
  curve c = {unit * d * d / at, -unit * d * (d + 2.0 * at) / (at * at)};
  c.y += c.slope * (phi - at); /* the tangent at the floor, below it */
  return c;
}

/* (3) max(u, 0), rounded with a parabola between -RAMP and RAMP */
static curve ramp(double u)
{
  if (u >= RAMP) return (curve){u, 1.0};
  if (u <= -RAMP) return (curve){0.0, 0.0};
  const double s = u + RAMP;
  return (curve){s * s / (4.0 * RAMP), s / (2.0 * RAMP)};
}

/* (5) w(u_t) = g(|u_t| / stick) u_t / |u_t| = factor u_t and its derivative factor 1 - bend u_t u_t' */
typedef struct slip {
  double factor, bend;
} slip;

static slip friction_slip(const kg_contact_params *p, kg_vec3 u_t)
{
  const double speed = kg_vec3_norm(u_t);
  if (speed >= p->stick) {
    const double inverse = 1.0 / speed;
    return (slip){inverse, inverse * inverse * inverse};
  }
  const double inverse = 1.0 / p->stick;
  return (slip){(2.0 - speed * inverse) * inverse, speed > 0.0 ? inverse * inverse / speed : 0.0};
}

static kg_mat3 hessian_of(const kg_sdf_value *s)
{
  const double *h = s->hessian;
  return (kg_mat3){{h[0], h[3], h[4], h[3], h[1], h[5], h[4], h[5], h[2]}};
}

/* (6) to (8); f_n = N r with elastic N and ramp r, all at one point */
static void differentiate(const kg_contact_params *p, const kg_sdf_value *s, kg_vec3 u, curve N,
                          curve r, kg_contact_force *out)
{
  const kg_vec3 n = s->normal;
  const kg_mat3 H = hessian_of(s);
  const double speed_n = kg_vec3_dot(n, u);
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, n);
  const slip w = friction_slip(p, u_t);
  const double push = p->damping * N.y * r.slope;
  const kg_vec3 Hu = kg_mat3_mul_vec(H, u);
  const kg_vec3 fn_x = kg_vec3_add_scaled(kg_vec3_scale(N.slope * r.y, n), -push, Hu); /* (6) */
  const kg_vec3 fn_u = kg_vec3_scale(-push, n);
  /* direction of the whole force: n - mu w(u_t), and mu f_n dw/du_t */
  const kg_vec3 along = kg_vec3_add_scaled(n, -p->friction * w.factor, u_t);
  const double mu_fn = p->friction * out->normal;
  const kg_mat3 dw = kg_mat3_add(kg_mat3_scale(mu_fn * w.factor, kg_mat3_identity()),
                                 kg_mat3_scale(-mu_fn * w.bend, kg_mat3_outer(u_t, u_t)));
  const kg_mat3 ut_u = kg_mat3_add(kg_mat3_identity(), kg_mat3_scale(-1.0, kg_mat3_outer(n, n)));
  const kg_mat3 ut_x =
    kg_mat3_scale(-1.0, kg_mat3_add(kg_mat3_scale(speed_n, H), kg_mat3_outer(n, Hu)));
  out->df_du = kg_mat3_add(kg_mat3_outer(along, fn_u), /* (8) */
                           kg_mat3_scale(-1.0, kg_mat3_mul(dw, ut_u)));
  out->df_dx = kg_mat3_add(kg_mat3_add(kg_mat3_outer(along, fn_x), kg_mat3_scale(out->normal, H)),
                           kg_mat3_scale(-1.0, kg_mat3_mul(dw, ut_x))); /* (7) */
}

bool kg_contact_evaluate(const kg_contact_params *params, const kg_scene *scene, kg_vec3 x,
                         kg_vec3 u, bool derivatives, kg_contact_force *out)
{
  KG_ASSERT(params->layer > 0.0 && params->stick > 0.0 && params->floor_share > 0.0);
  const kg_sdf_value s = kg_scene_distance(scene, x);
  *out = (kg_contact_force){.distance = s.distance, .direction = s.normal};
  if (s.distance >= params->layer) return false;
  const double speed_n = kg_vec3_dot(s.normal, u);
  const curve N = elastic(params, s.distance);
  const curve r = ramp(1.0 - params->damping * speed_n);
  const kg_vec3 u_t = kg_vec3_add_scaled(u, -speed_n, s.normal);
  const slip w = friction_slip(params, u_t);
  out->normal = N.y * r.y;
  out->f = kg_vec3_scale(out->normal,
                         kg_vec3_add_scaled(s.normal, -params->friction * w.factor, u_t)); /* (4) */
  if (derivatives) {
    differentiate(params, &s, u, N, r, out);
  }
  return true;
}
