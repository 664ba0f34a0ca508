/* Arena, quaternion and random numbers against definitions and closed forms. */
#include "support.h"

#include "kinegrad/arena.h"

static void arena_memory_is_zeroed_aligned_and_separate(void **state)
{
  (void)state;
  kg_arena arena;
  kg_arena_init(&arena, NULL);
  char *previous = NULL;
  for (size_t n = 1; n < 5000; n = n * 3 + 1) {
    char *memory = KG_ARENA_ARRAY(&arena, char, n);
    assert_non_null(memory);
    assert_int_equal((uintptr_t)memory % 64, 0);
    for (size_t i = 0; i < n; i++) {
      assert_int_equal(memory[i], 0);
    }
    memset(memory, 'x', n);
    if (previous) {
      assert_int_equal(previous[0], 'x');
    }
    previous = memory;
  }
  assert_null(kg_arena_alloc(&arena, SIZE_MAX / 4, 8));
  assert_true(kg_arena_failed(&arena));
  kg_arena_release(&arena);
}

static void arena_reports_every_refused_allocation(void **state)
{
  (void)state;
  enum { BLOCKS = 4 };
  for (int allowed = 0; allowed <= BLOCKS; allowed++) {
    failing_heap heap = {.calls_left = allowed};
    const kg_allocator allocator = {failing_alloc, failing_free, &heap};
    kg_arena arena;
    kg_arena_init(&arena, &allocator);
    for (int i = 0; i < BLOCKS; i++) {
      /* eight times the last: more than a block twice as large as the last has left */
      const void *memory = kg_arena_alloc(&arena, (size_t)1 << (12 + 3 * i), 1);
      assert_int_equal(memory != NULL, i < allowed);
      assert_int_equal(kg_arena_failed(&arena), i >= allowed);
    }
    assert_int_equal(heap.calls_left,
                     allowed < BLOCKS ? -1 : 0); /* none is tried after a refusal */
    /* once failed, even what would fit is refused */
    assert_int_equal(kg_arena_alloc(&arena, 1, 1) != NULL, allowed == BLOCKS);
    kg_arena_release(&arena);
    assert_int_equal(heap.live_bytes, 0);
  }
}

static void exp_and_log_are_inverse_at_all_sizes(void **state)
{
  (void)state;
  kg_random random = kg_random_make(1);
  const double sizes[] = {1e-12, 1e-6, 0.9e-4, 1.1e-4, 1e-3, 0.5, 0.9999, 1.0001, 2.0, 3.14};
  for (size_t i = 0; i < KG_COUNT_OF(sizes); i++) {
    const kg_vec3 r = kg_vec3_scale(sizes[i], kg_vec3_normalized(random_vec3(&random, 1.0)));
    const kg_vec3 back = kg_quat_log(kg_quat_exp(r));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(back, r)), 4e-15 * fmax(sizes[i], 0.1));
  }
}

/* Against long double, on both sides of where the series end. */
static void exponential_and_right_jacobian_are_right_to_rounding(void **state)
{
  (void)state;
  const double sizes[] = {1e-3, 0.1, 0.4999, 0.5001, 0.9999, 1.0001, 3.0};
  for (size_t i = 0; i < KG_COUNT_OF(sizes); i++) {
    const double a = sizes[i];
    const long double angle = a;
    const kg_quat q = kg_quat_exp(kg_vec3_make(0.0, a, 0.0));
    assert_close(q.w, (double)cosl(0.5L * angle), 3e-16);
    assert_close(q.y, (double)sinl(0.5L * angle), 3e-16);
    /* about y: Jr maps x to (sin a / a) x and (1 - cos a) / a z */
    const kg_mat3 Jr = kg_so3_right_jacobian(kg_vec3_make(0.0, a, 0.0));
    assert_close(Jr.m[0], (double)(sinl(angle) / angle), 4e-16);
    const long double s = sinl(0.5L * angle);
    assert_close(Jr.m[6], (double)(2.0L * s * s / angle), 4e-16);
  }
}

static void matrix_and_quaternion_rotate_alike(void **state)
{
  (void)state;
  kg_random random = kg_random_make(2);
  for (int i = 0; i < 200; i++) {
    const kg_quat q = random_quat(&random);
    const kg_vec3 a = random_vec3(&random, 1.0);
    const kg_vec3 b = kg_quat_rotate(q, a);
    const kg_vec3 c = kg_mat3_mul_vec(kg_quat_matrix(q), a);
    const kg_quat back = kg_quat_from_matrix(kg_quat_matrix(q));
    assert_at_most(kg_vec3_norm(kg_vec3_sub(b, c)), 1e-14 * (1.0 + kg_vec3_norm(a)));
    assert_close(fabs(kg_quat_dot(q, back)), 1.0, 1e-14);
    const kg_quat to = kg_quat_between(a, b);
    assert_at_most(kg_vec3_norm(kg_vec3_sub(kg_quat_rotate(to, a), b)),
                   1e-13 * (1.0 + kg_vec3_norm(a)));
  }
}

static void a_quaternion_without_direction_is_not_hidden(void **state)
{
  (void)state;
  const double values[] = {NAN, INFINITY, 1e300};
  for (int k = 0; k < 3; k++) {
    const kg_quat q = kg_quat_normalized(kg_quat_make(1.0, values[k], 0.0, 0.0));
    assert_true(isnan(q.w) && isnan(q.x));
  }
  assert_true(kg_quat_normalized(kg_quat_make(0.0, 0.0, 0.0, 0.0)).w == 1.0);
  assert_close(kg_quat_normalized(kg_quat_make(3.0, 0.0, 4.0, 0.0)).y, 0.8, 1e-15);
}

static void right_jacobian_matches_differences(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  const double sizes[] = {0.0, 1e-3, 0.99e-2, 1.01e-2, 0.7, 2.5};
  for (size_t k = 0; k < KG_COUNT_OF(sizes); k++) {
    const kg_vec3 r = kg_vec3_scale(sizes[k], kg_vec3_normalized(random_vec3(&random, 1.0)));
    const kg_mat3 Jr = kg_so3_right_jacobian(r);
    const double h = 1e-5;
    for (int j = 0; j < 3; j++) {
      const kg_vec3 e = kg_vec3_make(j == 0 ? h : 0.0, j == 1 ? h : 0.0, j == 2 ? h : 0.0);
      const kg_quat back = kg_quat_conj(kg_quat_exp(r));
      const kg_vec3 plus = kg_quat_log(kg_quat_mul(back, kg_quat_exp(kg_vec3_add(r, e))));
      const kg_vec3 minus = kg_quat_log(kg_quat_mul(back, kg_quat_exp(kg_vec3_sub(r, e))));
      const kg_vec3 d = kg_vec3_scale(0.5 / h, kg_vec3_sub(plus, minus));
      assert_close(Jr.m[j], d.x, 1e-9);
      assert_close(Jr.m[3 + j], d.y, 1e-9);
      assert_close(Jr.m[6 + j], d.z, 1e-9);
    }
  }
}

static void random_numbers_have_their_moments_and_repeat(void **state)
{
  (void)state;
  kg_random a = kg_random_make(7), b = kg_random_make(7);
  double sum = 0.0, sum2 = 0.0, uniform = 0.0;
  const int n = 100000;
  for (int i = 0; i < n; i++) {
    const double x = kg_random_normal(&a);
    sum += x;
    sum2 += x * x;
    assert_true(x == kg_random_normal(&b));
    uniform += kg_random_uniform(&a);
    (void)kg_random_uniform(&b);
  }
  assert_at_most(fabs(sum / n), 0.02);
  assert_at_most(fabs(sum2 / n - 1.0), 0.02);
  assert_at_most(fabs(uniform / n - 0.5), 0.01);
}

static void every_status_has_its_own_text(void **state)
{
  (void)state;
  for (int a = 0; a >= -7; a--) {
    assert_string_not_equal(kg_status_text((kg_status)a), kg_status_text((kg_status)99));
    for (int b = 0; b > a; b--) {
      assert_string_not_equal(kg_status_text((kg_status)a), kg_status_text((kg_status)b));
    }
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(arena_memory_is_zeroed_aligned_and_separate),
    cmocka_unit_test(arena_reports_every_refused_allocation),
    cmocka_unit_test(exp_and_log_are_inverse_at_all_sizes),
    cmocka_unit_test(exponential_and_right_jacobian_are_right_to_rounding),
    cmocka_unit_test(matrix_and_quaternion_rotate_alike),
    cmocka_unit_test(a_quaternion_without_direction_is_not_hidden),
    cmocka_unit_test(right_jacobian_matches_differences),
    cmocka_unit_test(random_numbers_have_their_moments_and_repeat),
    cmocka_unit_test(every_status_has_its_own_text),
  };
  return cmocka_run_group_tests_name("base", tests, NULL, NULL);
}
