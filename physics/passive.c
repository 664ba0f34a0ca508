/* Passive torque of a ball joint: a spring about a rest rotation and one-sided springs at the
 * limits of the components of the rotation vector.
 *
 * Equation numbers: docs/theory/dynamics.md, section 5. r: rotation vector of rest^-1 q. */
#include "physics/passive.h"

kg_joint_passive kg_joint_passive_default(void)
{
  return (kg_joint_passive){.rest = {1.0, 0.0, 0.0, 0.0},
                            .limit_low = {-INFINITY, -INFINITY, -INFINITY},
                            .limit_high = {INFINITY, INFINITY, INFINITY}};
}

/* (P1) excess of every component over its limit: positive above, negative below, zero between */
static kg_vec3 excess(const kg_joint_passive *p, kg_vec3 r)
{
  const kg_vec3 lo = p->limit_low, hi = p->limit_high;
  return kg_vec3_make(fmax(r.x - hi.x, 0.0) + fmin(r.x - lo.x, 0.0),
                      fmax(r.y - hi.y, 0.0) + fmin(r.y - lo.y, 0.0),
                      fmax(r.z - hi.z, 0.0) + fmin(r.z - lo.z, 0.0));
}

/* a rest that was left zero is the identity */
static kg_vec3 rotation_of(const kg_joint_passive *p, kg_quat q)
{
  if (kg_quat_dot(p->rest, p->rest) == 0.0) return kg_quat_log(q);
  return kg_quat_log(kg_quat_mul(kg_quat_conj(p->rest), q));
}

/* e |e|, component by component */
static kg_vec3 signed_square(kg_vec3 e)
{
  return kg_vec3_make(e.x * fabs(e.x), e.y * fabs(e.y), e.z * fabs(e.z));
}

/* g = dE/dr, (P2) */
static kg_vec3 slope(const kg_joint_passive *p, kg_vec3 r)
{
  const kg_vec3 spring = kg_vec3_scale(p->stiffness, r);
  if (p->limit_stiffness == 0.0) return spring;
  return kg_vec3_add_scaled(spring, p->limit_stiffness, signed_square(excess(p, r)));
}

double kg_joint_passive_energy(const kg_joint_passive *passive, kg_quat q)
{
  const kg_vec3 r = rotation_of(passive, q);
  const double spring = 0.5 * passive->stiffness * kg_vec3_dot(r, r);
  if (passive->limit_stiffness == 0.0) return spring;
  const kg_vec3 e = excess(passive, r);
  const double cubes = fabs(e.x * e.x * e.x) + fabs(e.y * e.y * e.y) + fabs(e.z * e.z * e.z);
  return spring + passive->limit_stiffness / 3.0 * cubes;
}

/* beta of Jr^-1 = 1 + [r]/2 + beta [r]^2 and its derivative by t = |r|, over t. The closed form
 * loses eps / t^4 of the latter to cancellation, the series of eight terms is good to 1e-16 below
 * 0.7. */
typedef struct curl {
  double beta, slope;
} curl;

static curl curl_of(double t)
{
  static const double terms[8] = {1.0 / 12,          1.0 / 720,
                                  1.0 / 30240,       1.0 / 1209600,
                                  1.0 / 47900160,    691.0 / 1307674368000,
                                  1.0 / 74724249600, 3617.0 / 10670622842880000};
  curl c = {0.0, 0.0};
  if (t < 0.7) {
    const double x = t * t;
    for (int k = 7; k >= 0; k--) {
      c.beta = c.beta * x + terms[k];
      c.slope = k > 0 ? c.slope * x + 2.0 * k * terms[k] : c.slope;
    }
    return c;
  }
  const double half = 0.5 * t, cot = cos(half) / sin(half), squared = t * t;
  c.beta = (1.0 - half * cot) / squared;
  /* d(1 - half cot)/dt = -cot / 2 + half (1 + cot^2) / 2 */
  c.slope = (0.5 * (half * (1.0 + cot * cot) - cot) / t - 2.0 * c.beta) / squared;
  return c;
}

static kg_mat3 inverse_right_jacobian(kg_vec3 r, double beta)
{
  const kg_mat3 X = kg_mat3_skew(r);
  return kg_mat3_add(kg_mat3_add(kg_mat3_identity(), kg_mat3_scale(0.5, X)),
                     kg_mat3_scale(beta, kg_mat3_mul(X, X)));
}

/* d/dr of Jr^-T(r) g = g - r x g / 2 + beta r x (r x g), g held */
static kg_mat3 turned_by_r(kg_vec3 r, kg_vec3 g, curl c)
{
  const kg_vec3 rg = kg_vec3_cross(r, g), rrg = kg_vec3_cross(r, rg);
  const kg_mat3 G = kg_mat3_skew(g), X = kg_mat3_skew(r);
  kg_mat3 A = kg_mat3_scale(0.5, G);
  A = kg_mat3_add(A, kg_mat3_scale(-c.beta, kg_mat3_add(kg_mat3_skew(rg), kg_mat3_mul(X, G))));
  return kg_mat3_add(A, kg_mat3_scale(c.slope, kg_mat3_outer(rrg, r)));
}

/* dg/dr: diagonal */
static kg_mat3 curvature(const kg_joint_passive *p, kg_vec3 r)
{
  kg_mat3 H = kg_mat3_scale(p->stiffness, kg_mat3_identity());
  if (p->limit_stiffness != 0.0) {
    const kg_vec3 e = excess(p, r);
    H.m[0] += 2.0 * p->limit_stiffness * fabs(e.x);
    H.m[4] += 2.0 * p->limit_stiffness * fabs(e.y);
    H.m[8] += 2.0 * p->limit_stiffness * fabs(e.z);
  }
  return H;
}

kg_vec3 kg_passive_torque(const kg_joint_passive *passive, kg_quat q, kg_mat3 *by_turn)
{
  const kg_vec3 r = rotation_of(passive, q);
  const kg_vec3 g = slope(passive, r);
  const curl c = curl_of(kg_vec3_norm(r));
  const kg_mat3 T = inverse_right_jacobian(r, c.beta);
  if (by_turn) {
    const kg_mat3 by_r =
      kg_mat3_add(turned_by_r(r, g, c), kg_mat3_mul(kg_mat3_transposed(T), curvature(passive, r)));
    *by_turn = kg_mat3_mul(by_r, T);
  }
  return kg_mat3_mul_vec_t(T, g);
}

void kg_passive_gradient(const kg_joint_passive *passive, kg_quat q, kg_vec3 w, kg_vec3 lambda,
                         double bar[3])
{
  const kg_vec3 r = rotation_of(passive, q);
  bar[0] += kg_vec3_dot(lambda, r); /* Jr^-T r = r */
  bar[1] += kg_vec3_dot(lambda, w);
  const kg_mat3 T = inverse_right_jacobian(r, curl_of(kg_vec3_norm(r)).beta);
  bar[2] += kg_vec3_dot(lambda, kg_mat3_mul_vec_t(T, signed_square(excess(passive, r))));
}
