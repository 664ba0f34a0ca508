/* Ways out over time: against every sequence of directions, and around a round bar. */
#include "support.h"

#include "pipeline/ways.h"

#include "kinegrad/random.h"

enum { D = KG_WAY_DIRECTIONS };

static const double DT = 0.01;
static const double TURN = 1e-3, JOINED_S = 0.25; /* of pipeline/ways.c */

static kg_ways *make(int frames)
{
  kg_ways *ways = NULL;
  assert_int_equal(kg_ways_create(&ways, frames, DT, NULL), KG_OK);
  return ways;
}

static double angle_between(kg_vec3 a, kg_vec3 b)
{
  return acos(fmin(fmax(kg_vec3_dot(a, b), -1.0), 1.0));
}

static void directions_are_spread(void **state)
{
  (void)state;
  kg_ways *ways = make(1);
  const kg_vec3 *n = kg_ways_directions(ways);
  kg_random random = kg_random_make(1);
  for (int i = 0; i < D; i++) {
    assert_close(kg_vec3_norm(n[i]), 1.0, 1e-12);
    double nearest = 4.0;
    for (int j = 0; j < D; j++) {
      if (j != i) nearest = fmin(nearest, angle_between(n[i], n[j]));
    }
    assert_true(nearest > 0.5 && nearest < 0.65);
  }
  for (int trial = 0; trial < 1000; trial++) {
    const kg_vec3 any = kg_vec3_normalized(kg_vec3_make(
      kg_random_normal(&random), kg_random_normal(&random), kg_random_normal(&random)));
    double nearest = 4.0;
    for (int i = 0; i < D; i++) {
      nearest = fmin(nearest, angle_between(any, n[i]));
    }
    assert_true(nearest < 0.4);
  }
  kg_ways_destroy(ways);
}

static double cost(const kg_vec3 *n, double out[3][D], const int *choice)
{
  double sum = 0.0;
  for (int k = 0; k < 3; k++) {
    sum += DT * out[k][choice[k]] * out[k][choice[k]];
    if (k == 0) continue;
    sum += TURN * angle_between(n[choice[k - 1]], n[choice[k]]);
  }
  return sum;
}

/* The first and the last way, held before and after, are those of the best of all sequences. */
static void choice_is_the_best_of_all(void **state)
{
  (void)state;
  enum { FRAMES = 200 };
  const int at[3] = {60, 75, 90};
  kg_random random = kg_random_make(2);
  int turned = 0;
  for (int trial = 0; trial < 8; trial++) {
    kg_ways *ways = make(FRAMES);
    const kg_vec3 *n = kg_ways_directions(ways);
    double out[3][D], least = INFINITY;
    for (int k = 0; k < 3; k++) {
      for (int d = 0; d < D; d++) {
        out[k][d] = 0.05 + 0.6 * kg_random_uniform(&random);
      }
    }
    int best[3] = {0};
    for (int i = 0; i < D * D * D; i++) {
      const int choice[3] = {i % D, i / D % D, i / (D * D)};
      const double c = cost(n, out, choice);
      if (c >= least) continue;
      least = c;
      memcpy(best, choice, sizeof best);
    }
    for (int k = 2; k >= 0; k--) { /* in any order */
      assert_true(kg_ways_add(ways, 7, at[k], out[k]));
    }
    assert_int_equal(kg_ways_choose(ways), KG_OK);
    kg_vec3 first, last;
    assert_true(kg_ways_at(ways, 7, at[0] - 24, &first) && kg_ways_at(ways, 7, at[2] + 24, &last));
    assert_true(angle_between(first, n[best[0]]) < 0.1 && angle_between(last, n[best[2]]) < 0.1);
    turned += best[0] != best[2];
    kg_ways_destroy(ways);
  }
  assert_true(turned > 1 && turned < 8);
}

/* Overlaps of one pair that are near in time are one; others, and other pairs, are apart. */
static void overlaps_end(void **state)
{
  (void)state;
  enum { FRAMES = 400 };
  const int gap = (int)(JOINED_S / DT);
  kg_ways *ways = make(FRAMES);
  const kg_vec3 *n = kg_ways_directions(ways);
  double up[D], down[D];
  for (int d = 0; d < D; d++) {
    up[d] = 0.1 - 0.09 * n[d].y;
    down[d] = 0.1 + 0.09 * n[d].y;
  }
  assert_true(kg_ways_add(ways, 1, 0, up));
  assert_true(kg_ways_add(ways, 1, 200, up));
  assert_true(kg_ways_add(ways, 1, 200 + gap, up)); /* joined */
  assert_true(kg_ways_add(ways, 2, 200, down));
  assert_true(kg_ways_add(ways, 1, FRAMES - 1, down));
  assert_int_equal(kg_ways_choose(ways), KG_OK);
  kg_vec3 way;
  for (int t = 0; t < FRAMES; t++) {
    const bool early = t <= gap, middle = t >= 200 - gap && t <= 200 + 2 * gap;
    const bool late = t >= FRAMES - 1 - gap;
    assert_int_equal(kg_ways_at(ways, 1, t, &way), early || middle || late);
    if (early || middle) assert_true(way.y > 0.8);
    if (late) assert_true(way.y < -0.8);
    assert_int_equal(kg_ways_at(ways, 2, t, &way), t >= 200 - gap && t <= 200 + gap);
    assert_false(kg_ways_at(ways, 3, t, &way));
  }
  kg_ways_destroy(ways);
}

/* A point goes through a bar of radius R along z, past its axis: the nearest way out turns by half a turn
 * in two frames. The way chosen turns over the whole passage, on the side of the point. */
static void the_way_goes_around_a_bar(void **state)
{
  (void)state;
  enum { FRAMES = 120, FIRST = 40, LAST = 80 };
  const double R = 0.2;
  for (int side = -1; side <= 1; side += 2) {
    kg_ways *ways = make(FRAMES);
    const kg_vec3 *n = kg_ways_directions(ways);
    for (int t = FIRST; t <= LAST; t++) {
      const double x = 0.9 * R * (2.0 * (t - FIRST) / (LAST - FIRST) - 1.0), y = 0.15 * side * R;
      double out[D];
      for (int d = 0; d < D; d++) { /* |(x, y) + s n| = R in the plane */
        const double a = n[d].x * n[d].x + n[d].y * n[d].y, b = x * n[d].x + y * n[d].y;
        const double c = x * x + y * y - R * R;
        out[d] = a > 1e-9 ? fmin((sqrt(b * b - a * c) - b) / a, 1.0) : 1.0;
      }
      assert_true(kg_ways_add(ways, 0, t, out));
    }
    assert_int_equal(kg_ways_choose(ways), KG_OK);
    kg_vec3 before, way;
    assert_true(kg_ways_at(ways, 0, FIRST, &before));
    assert_true(before.x < -0.2);
    double fastest = 0.0;
    for (int t = FIRST + 1; t <= LAST; t++) {
      assert_true(kg_ways_at(ways, 0, t, &way));
      assert_close(kg_vec3_norm(way), 1.0, 1e-12);
      fastest = fmax(fastest, angle_between(before, way) / DT);
      before = way;
      if (t == (FIRST + LAST) / 2) assert_true(side * way.y > 0.8);
    }
    assert_true(way.x > 0.2);
    assert_true(fastest < 12.0); /* rad/s; half a turn in 0.4 s would be 7.9 */
    kg_ways_destroy(ways);
  }
}

static void refused_memory_leaves_nothing_behind(void **state)
{
  (void)state;
  double out[D];
  for (int d = 0; d < D; d++) {
    out[d] = 0.01 * d;
  }
  int calls = 0;
  for (bool done = false; !done; calls++) {
    failing_heap heap = {.calls_left = calls};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_ways *ways = NULL;
    done = kg_ways_create(&ways, 1000, DT, &allocator) == KG_OK;
    for (int t = 0; done && t < 1000; t++) {
      done = kg_ways_add(ways, t % 3, t, out);
    }
    done = done && kg_ways_choose(ways) == KG_OK;
    kg_ways_destroy(ways);
    assert_int_equal(heap.live_bytes, 0);
  }
  assert_true(calls > 5);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(directions_are_spread),
    cmocka_unit_test(choice_is_the_best_of_all),
    cmocka_unit_test(overlaps_end),
    cmocka_unit_test(the_way_goes_around_a_bar),
    cmocka_unit_test(refused_memory_leaves_nothing_behind),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
