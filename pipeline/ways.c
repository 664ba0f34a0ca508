/* Which way two solids that are in each other are led apart, over time.
 *
 * The nearest way out of a solid is the wrong guide through time: where an arm is captured as passing
 * through the axis of another, it turns round from one frame to the next. Here a way n_k is chosen for
 * all frames of an overlap together:
 *   min  sum_k h s_k(n_k)^2 + TURN sum_k angle(n_k, n_{k+1})
 * over a fixed set of directions, by dynamic programming. s_k(n) is how far a solid has to go along n to
 * be out, h the frame time. Overlaps less than JOINED_S apart are one. The chosen steps are then rounded
 * over ROUNDED_S, and the first and the last way hold for JOINED_S before and after. */
#include "pipeline/ways.h"

#include "kinegrad/arena.h"
#include "physics/physics.h"
#include "pipeline/pipeline.h"

#include <stdlib.h>
#include <string.h>

static const double TURN = 1e-3;     /* m^2 s / rad                            */
static const double JOINED_S = 0.25; /* shorter gaps do not end an overlap     */
static const double ROUNDED_S = 0.05;

/* One overlap of a pair in one frame. */
typedef struct sample {
  int pair, frame;
  float way_out[KG_WAY_DIRECTIONS]; /* m, along each direction */
} sample;

/* The ways of a pair from frame `first` on. */
typedef struct run {
  int pair, first, count;
  kg_vec3 *way;
} run;

struct kg_ways {
  int frame_count;
  double dt;
  kg_vec3 directions[KG_WAY_DIRECTIONS];
  double angle[KG_WAY_DIRECTIONS][KG_WAY_DIRECTIONS]; /* between them, rad */
  sample *samples;
  size_t sample_count, sample_room;
  run *runs; /* by pair, then by frame */
  size_t run_count;
  kg_arena arena;
};

/* The corners of an icosahedron and the middles of its edges: 31 to 36 degrees apart. */
static void make_directions(kg_vec3 *out)
{
  const double g = 1.6180339887498949;
  int count = 0;
  for (int k = 0; k < 12; k++) {
    const double a = k & 1 ? -1.0 : 1.0, b = k & 2 ? -g : g;
    const double x[3] = {0.0, a, b};
    const int turn = k / 4;
    out[count++] = kg_vec3_normalized(kg_vec3_make(x[turn], x[(turn + 1) % 3], x[(turn + 2) % 3]));
  }
  for (int i = 0; i < 12; i++) {
    for (int j = i + 1; j < 12; j++) {
      if (kg_vec3_dot(out[i], out[j]) < 0.4) continue; /* neighbours: 0.447 */
      out[count++] = kg_vec3_normalized(kg_vec3_add(out[i], out[j]));
    }
  }
  KG_ASSERT(count == KG_WAY_DIRECTIONS);
}

kg_status kg_ways_create(kg_ways **ways, int frame_count, double dt, const kg_allocator *allocator)
{
  *ways = NULL;
  kg_arena arena;
  kg_arena_init(&arena, allocator);
  kg_ways *w = KG_ARENA_ARRAY(&arena, kg_ways, 1);
  if (!w) return KG_ERR_NO_MEMORY;
  w->frame_count = frame_count;
  w->dt = dt;
  make_directions(w->directions);
  for (int i = 0; i < KG_WAY_DIRECTIONS; i++) {
    for (int j = 0; j < KG_WAY_DIRECTIONS; j++) {
      const double c = kg_vec3_dot(w->directions[i], w->directions[j]);
      w->angle[i][j] = acos(fmin(fmax(c, -1.0), 1.0));
    }
  }
  w->arena = arena;
  *ways = w;
  return KG_OK;
}

void kg_ways_destroy(kg_ways *ways)
{
  if (ways) {
    kg_arena arena = ways->arena; /* it lives in its own arena */
    kg_arena_release(&arena);
  }
}

const kg_vec3 *kg_ways_directions(const kg_ways *ways)
{
  return ways->directions;
}

bool kg_ways_add(kg_ways *ways, int pair, int frame, const double *way_out)
{
  if (ways->sample_count == ways->sample_room) {
    const size_t room = ways->sample_room ? 2 * ways->sample_room : 256;
    sample *samples = KG_ARENA_ARRAY(&ways->arena, sample, room);
    if (!samples) return false;
    if (ways->sample_count) memcpy(samples, ways->samples, ways->sample_count * sizeof *samples);
    ways->samples = samples;
    ways->sample_room = room;
  }
  sample *s = &ways->samples[ways->sample_count++];
  s->pair = pair;
  s->frame = frame;
  for (int d = 0; d < KG_WAY_DIRECTIONS; d++) {
    s->way_out[d] = (float)way_out[d];
  }
  return true;
}

static int compare(const void *a, const void *b)
{
  const sample *x = a, *y = b;
  if (x->pair != y->pair) return x->pair < y->pair ? -1 : 1;
  return (x->frame > y->frame) - (x->frame < y->frame);
}

/* ---- one overlap -------------------------------------------------------------------------------*/

/* choice[k]: the direction of sample k */
static void choose(const kg_ways *w, const sample *samples, int count, unsigned char *from,
                   int *choice)
{
  enum { D = KG_WAY_DIRECTIONS };
  double cost[D] = {0.0}, next[D];
  for (int k = 0; k < count; k++) {
    for (int j = 0; j < D; j++) {
      int best = 0;
      double least = INFINITY;
      for (int i = 0; i < D; i++) {
        const double c = cost[i] + TURN * w->angle[i][j];
        if (c < least) {
          least = c;
          best = i;
        }
      }
      const double out = (double)samples[k].way_out[j];
      next[j] = (k > 0 ? least : 0.0) + w->dt * out * out;
      from[(size_t)k * D + (size_t)j] = (unsigned char)best;
    }
    memcpy(cost, next, sizeof cost);
  }
  int last = 0;
  for (int j = 1; j < D; j++) {
    if (cost[j] < cost[last]) last = j;
  }
  for (int k = count - 1; k >= 0; k--) {
    choice[k] = last;
    last = from[(size_t)k * D + (size_t)last];
  }
}

/* the chosen directions over the frames of the run, from one to the next at even speed, then rounded */
static void fill(const kg_ways *w, run *r, const sample *samples, const int *choice, int count,
                 double *numbers, kg_smoother *smoother)
{
  int k = 0;
  for (int t = 0; t < r->count; t++) {
    const int frame = r->first + t;
    while (k < count && samples[k].frame <= frame) {
      k++;
    }
    const int before = k > 0 ? k - 1 : 0, after = k < count ? k : count - 1;
    const int span = samples[after].frame - samples[before].frame;
    const double share = span > 0 ? (double)(frame - samples[before].frame) / span : 0.0;
    const kg_vec3 n = kg_vec3_lerp(w->directions[choice[before]], w->directions[choice[after]],
                                   fmin(fmax(share, 0.0), 1.0));
    kg_store3(numbers + 3 * t, n);
  }
  smoother->count = r->count;
  kg_smoother_factor(smoother, NULL, pow(ROUNDED_S / w->dt, 4.0));
  for (int c = 0; c < 3; c++) {
    kg_smoother_solve(smoother, numbers + c, 3);
  }
  for (int t = 0; t < r->count; t++) {
    const double *n = numbers + 3 * t;
    r->way[t] = kg_vec3_normalized(kg_vec3_make(n[0], n[1], n[2]));
  }
}

kg_status kg_ways_choose(kg_ways *ways)
{
  kg_ways *w = ways;
  if (w->sample_count == 0) return KG_OK;
  const int gap = (int)ceil(JOINED_S / w->dt);
  kg_arena scratch;
  kg_arena_init(&scratch, w->arena.allocator);
  unsigned char *from = KG_ARENA_ARRAY(&scratch, unsigned char, w->frame_count *KG_WAY_DIRECTIONS);
  int *choice = KG_ARENA_ARRAY(&scratch, int, w->frame_count);
  double *numbers = KG_ARENA_ARRAY(&scratch, double, 3 * w->frame_count);
  kg_smoother smoother;
  kg_smoother_create(&smoother, w->frame_count, &scratch);
  w->runs = KG_ARENA_ARRAY(&w->arena, run, w->sample_count);
  bool ok = !kg_arena_failed(&scratch) && !kg_arena_failed(&w->arena);
  if (ok) qsort(w->samples, w->sample_count, sizeof *w->samples, compare);
  for (size_t i = 0; ok && i < w->sample_count;) {
    const sample *first = &w->samples[i];
    int count = 1;
    while (i + (size_t)count < w->sample_count && first[count].pair == first->pair &&
           first[count].frame - first[count - 1].frame <= gap) {
      count++;
    }
    const int from_frame = first->frame > gap ? first->frame - gap : 0;
    const int last = first[count - 1].frame + gap;
    run *r = &w->runs[w->run_count++];
    *r = (run){.pair = first->pair, .first = from_frame};
    r->count = (last < w->frame_count ? last + 1 : w->frame_count) - from_frame;
    r->way = KG_ARENA_ARRAY(&w->arena, kg_vec3, r->count);
    ok = r->way != NULL;
    if (ok) {
      choose(w, first, count, from, choice);
      fill(w, r, first, choice, count, numbers, &smoother);
    }
    i += (size_t)count;
  }
  kg_arena_release(&scratch);
  return ok ? KG_OK : KG_ERR_NO_MEMORY;
}

bool kg_ways_at(const kg_ways *ways, int pair, int frame, kg_vec3 *way)
{
  for (size_t i = 0; i < ways->run_count; i++) {
    const run *r = &ways->runs[i];
    if (r->pair != pair || frame < r->first || frame >= r->first + r->count) continue;
    *way = r->way[frame - r->first];
    return true;
  }
  return false;
}
