/* Runs of implicit steps and their gradients.
 *
 * A run is cut into segments of `interval` steps. The states at their beginnings and the last one
 * are kept, and all states of one segment: of the only one, or, with checkpoints, of one that is run
 * again when the way back arrives there. A step is a function of its arguments alone, so it ends in
 * the same bits, which is checked. */
#include "kinegrad/rollout.h"

#include "physics/step_problem.h"

#include <string.h>

struct kg_rollout {
  kg_rollout_def def;
  int nq, nv;
  int interval;
  int steps; /* of the last run                                   */
  bool converged;
  const double *tau;       /* of the last run                                   */
  double *q_kept, *v_kept; /* states at the beginnings of segments, and the last */
  double *q, *v;           /* interval + 1 states                               */
  int *substeps;           /* interval                                          */
  int loaded;              /* the segment that is in them                       */
  double *bar;             /* 4 nv: adjoints of two neighbouring states         */
  kg_arena arena;
};

/* smallest r with r r >= n */
static int root_of(int n)
{
  int r = 1;
  while (r * r < n) {
    r++;
  }
  return r;
}

kg_status kg_rollout_create(kg_rollout **rollout, const kg_rollout_def *def)
{
  KG_ASSERT(def->step && def->max_steps > 0 && def->dt > 0.0);
  *rollout = NULL;
  const kg_body *body = def->step->def.body;
  const size_t nq = (size_t)body->nq, nv = (size_t)body->nv;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  kg_rollout *r = KG_ARENA_ARRAY(&arena, kg_rollout, 1);
  kg_rollout made = {.def = *def, .nq = body->nq, .nv = body->nv};
  made.interval = def->checkpoints ? root_of(def->max_steps) : def->max_steps;
  const size_t segments = (size_t)((def->max_steps + made.interval - 1) / made.interval);
  const size_t states = (size_t)made.interval + 1;
  made.q_kept = KG_ARENA_ARRAY(&arena, double, (segments + 1) * nq);
  made.v_kept = KG_ARENA_ARRAY(&arena, double, (segments + 1) * nv);
  made.q = KG_ARENA_ARRAY(&arena, double, states *nq);
  made.v = KG_ARENA_ARRAY(&arena, double, states *nv);
  made.substeps = KG_ARENA_ARRAY(&arena, int, states);
  made.bar = KG_ARENA_ARRAY(&arena, double, 4 * nv);
  if (kg_arena_failed(&arena)) {
    kg_arena_release(&arena);
    return KG_ERR_NO_MEMORY;
  }
  made.arena = arena;
  *r = made;
  *rollout = r;
  return KG_OK;
}

void kg_rollout_destroy(kg_rollout *rollout)
{
  if (rollout) {
    kg_arena arena = rollout->arena; /* the arena holds the object itself */
    kg_arena_release(&arena);
  }
}

/* ---- forward ----------------------------------------------------------------------------------*/

static void copy_state(const kg_rollout *r, double *q_to, double *v_to, const double *q,
                       const double *v)
{
  memcpy(q_to, q, (size_t)r->nq * sizeof *q);
  memcpy(v_to, v, (size_t)r->nv * sizeof *v);
}

/* state k of the loaded segment */
static double *q_at(const kg_rollout *r, int k)
{
  return r->q + (size_t)k * (size_t)r->nq;
}

static double *v_at(const kg_rollout *r, int k)
{
  return r->v + (size_t)k * (size_t)r->nv;
}

/* from state k of the segment, step t of the run, to state k + 1 */
static kg_step_report run_step(kg_rollout *r, int k, int t)
{
  kg_step_report report;
  kg_step_advance(r->def.step, q_at(r, k + 1), v_at(r, k + 1), q_at(r, k), v_at(r, k),
                  r->tau + (size_t)t * (size_t)r->nv, r->def.dt, false, &report);
  r->substeps[k] = report.substeps;
  return report;
}

/* The state at the beginning of a segment: from where it is kept into the segment, or the other
 * way. */
static void load(kg_rollout *r, int segment)
{
  const size_t s = (size_t)segment;
  copy_state(r, r->q, r->v, r->q_kept + s * (size_t)r->nq, r->v_kept + s * (size_t)r->nv);
  r->loaded = segment;
}

static void keep(kg_rollout *r, int segment, const double *q, const double *v)
{
  const size_t s = (size_t)segment;
  copy_state(r, r->q_kept + s * (size_t)r->nq, r->v_kept + s * (size_t)r->nv, q, v);
}

static void write_state(const kg_rollout *r, int t, int k, double *q_out, double *v_out)
{
  if (q_out) memcpy(q_out + (size_t)t * (size_t)r->nq, q_at(r, k), (size_t)r->nq * sizeof *q_out);
  if (v_out) memcpy(v_out + (size_t)t * (size_t)r->nv, v_at(r, k), (size_t)r->nv * sizeof *v_out);
}

static void add_report(kg_rollout_report *sum, const kg_step_report *step)
{
  sum->steps += step->converged;
  sum->substepped += step->substeps > 1;
  sum->iterations += step->iterations;
  sum->residual = fmax(sum->residual, step->residual);
}

kg_status kg_rollout_run(kg_rollout *rollout, int steps, const double *q, const double *v,
                         const double *tau, double *q_out, double *v_out, kg_rollout_report *report)
{
  if (steps < 1 || steps > rollout->def.max_steps) return KG_ERR_SHAPE;
  kg_rollout *r = rollout;
  kg_rollout_report own = {0};
  r->steps = steps;
  r->tau = tau;
  r->converged = true;
  keep(r, 0, q, v);
  load(r, 0);
  write_state(r, 0, 0, q_out, v_out);
  for (int t = 0; t < steps && r->converged; t++) {
    const int k = t % r->interval;
    if (k == 0 && t > 0) {
      keep(r, t / r->interval, q_at(r, r->interval), v_at(r, r->interval));
      load(r, t / r->interval);
    }
    const kg_step_report one = run_step(r, k, t);
    add_report(&own, &one);
    r->converged = one.converged;
    write_state(r, t + 1, k + 1, q_out, v_out);
  }
  const int last = (steps - 1) / r->interval, end = steps - last * r->interval;
  if (r->converged) keep(r, last + 1, q_at(r, end), v_at(r, end));
  if (report) *report = own;
  return r->converged ? KG_OK : KG_ERR_UNDEFINED;
}

/* ---- backward ---------------------------------------------------------------------------------*/

void kg_rollout_add_arrays(void *arrays, int t, const double *q, const double *v, double *q_bar,
                           double *v_bar)
{
  const kg_rollout_arrays *a = arrays;
  (void)q, (void)v;
  const size_t start = (size_t)t * (size_t)a->nv;
  for (int k = 0; k < a->nv; k++) {
    q_bar[k] += a->q_bar ? a->q_bar[start + (size_t)k] : 0.0;
    v_bar[k] += a->v_bar ? a->v_bar[start + (size_t)k] : 0.0;
  }
}

/* whether the loaded segment, run up to its state k, ends in the very state that was kept */
static bool meets_kept(const kg_rollout *r, int k)
{
  const size_t next = (size_t)r->loaded + 1, nq = (size_t)r->nq, nv = (size_t)r->nv;
  return memcmp(q_at(r, k), r->q_kept + next * nq, nq * sizeof(double)) == 0 &&
         memcmp(v_at(r, k), r->v_kept + next * nv, nv * sizeof(double)) == 0;
}

/* Runs a segment again unless it is there. Fails when it goes another way than it did. */
static kg_status ensure_loaded(kg_rollout *r, int segment)
{
  if (r->loaded == segment) return KG_OK;
  const int first = segment * r->interval, left = r->steps - first;
  const int count = left < r->interval ? left : r->interval;
  bool same = true;
  load(r, segment);
  for (int k = 0; same && k < count; k++) {
    same = run_step(r, k, first + k).converged;
  }
  if (same && meets_kept(r, count)) return KG_OK;
  r->loaded = -1;
  return KG_ERR_UNDEFINED;
}

/* The adjoints of two neighbouring states: then, at t + 1, and now, at t. */
typedef struct neighbours {
  double *q_then, *v_then, *q_now, *v_now;
} neighbours;

static void exchange(neighbours *n)
{
  *n = (neighbours){n->q_now, n->v_now, n->q_then, n->v_then};
}

/* from state k + 1 of the loaded segment to state k, step t of the run */
static kg_status return_step(kg_rollout *r, const kg_rollout_gradient *g, const neighbours *n,
                             int k, int t)
{
  const size_t bytes = (size_t)r->nv * sizeof(double), row = (size_t)t * (size_t)r->nv;
  memset(n->q_now, 0, bytes);
  memset(n->v_now, 0, bytes);
  const kg_step_gradient step = {.q = n->q_now,
                                 .v = n->v_now,
                                 .tau = g->tau ? g->tau + row : NULL,
                                 .contact = g->contact,
                                 .joint_damping = g->joint_damping,
                                 .passive = g->passive,
                                 .body = g->body};
  return kg_step_vjp(r->def.step, &step, q_at(r, k), v_at(r, k), r->tau + row, r->def.dt,
                     v_at(r, k + 1), r->substeps[k], n->q_then, n->v_then);
}

kg_status kg_rollout_vjp(kg_rollout *rollout, const kg_rollout_gradient *gradient,
                         kg_rollout_cotangent *cotangent, void *user)
{
  kg_rollout *r = rollout;
  if (r->steps == 0 || !r->converged) return KG_ERR_UNDEFINED;
  const int nv = r->nv;
  neighbours n = {r->bar, r->bar + nv, r->bar + 2 * nv, r->bar + 3 * nv};
  memset(r->bar, 0, 4 * (size_t)nv * sizeof *r->bar);
  for (int t = r->steps - 1; t >= 0; t--) {
    const int k = t % r->interval;
    kg_status status = ensure_loaded(r, t / r->interval);
    if (status != KG_OK) return status;
    cotangent(user, t + 1, q_at(r, k + 1), v_at(r, k + 1), n.q_then, n.v_then);
    status = return_step(r, gradient, &n, k, t);
    if (status != KG_OK) return status;
    exchange(&n);
  }
  cotangent(user, 0, q_at(r, 0), v_at(r, 0), n.q_then, n.v_then);
  for (int k = 0; k < nv; k++) {
    if (gradient->q) gradient->q[k] += n.q_then[k];
    if (gradient->v) gradient->v[k] += n.v_then[k];
  }
  return KG_OK;
}
