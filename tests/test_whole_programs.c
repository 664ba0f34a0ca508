/* Whole programs, not single operators: a recurrent network and the pose of a jointed hand, recorded as a user
 * would write them, against the same mathematics in plain complex loops, whose complex steps are
 * the true derivatives. Both are objectives of the ADBench suite (F. Srajer, Z. Kukelova,
 * A. Fitzgibbon, Optimization Methods and Software 33 (2018)), here with numbers of our own. */
#include "tape_support.h"

/* -- a recurrent network: LAYERS diagonal cells over FRAMES characters of BITS -------------------- */

enum {
  BITS = 5,
  LAYERS = 2,
  FRAMES = 9,
  GATES = 4,
  CELL = LAYERS * 2 * GATES * BITS,
  EXTRA = 3 * BITS
};

static complex_number sigmoid(complex_number a)
{
  return 1 / (1 + cexp(-a));
}

/* one cell: weights (4, BITS), biases (4, BITS); hidden and memory change in place */
static void plain_cell(const complex_number *w, complex_number *hidden, complex_number *memory,
                       const complex_number *input)
{
  const complex_number *bias = w + GATES * BITS;
  for (int i = 0; i < BITS; ++i) {
    const complex_number forget = sigmoid(input[i] * w[i] + bias[i]);
    const complex_number in = sigmoid(hidden[i] * w[BITS + i] + bias[BITS + i]);
    const complex_number out = sigmoid(input[i] * w[2 * BITS + i] + bias[2 * BITS + i]);
    const complex_number change = ctanh(hidden[i] * w[3 * BITS + i] + bias[3 * BITS + i]);
    memory[i] = memory[i] * forget + in * change;
    hidden[i] = out * ctanh(memory[i]);
  }
}

static complex_number plain_network(const complex_number *cells, const complex_number *extra,
                                    const double *start, const double *text)
{
  complex_number state[2 * LAYERS * BITS], x[BITS], total = 0;
  for (int i = 0; i < 2 * LAYERS * BITS; ++i) {
    state[i] = start[i];
  }
  for (int t = 0; t + 1 < FRAMES; ++t) {
    complex_number sum = 2;
    for (int i = 0; i < BITS; ++i) {
      x[i] = text[t * BITS + i] * extra[i];
    }
    for (int l = 0; l < LAYERS; ++l) {
      plain_cell(cells + l * 2 * GATES * BITS, state + 2 * l * BITS, state + (2 * l + 1) * BITS, x);
      memcpy(x, state + 2 * l * BITS, sizeof x);
    }
    for (int i = 0; i < BITS; ++i) {
      x[i] = x[i] * extra[BITS + i] + extra[2 * BITS + i];
      sum += cexp(x[i]);
    }
    for (int i = 0; i < BITS; ++i) {
      total += text[(t + 1) * BITS + i] * (x[i] - clog(sum));
    }
  }
  return -total / ((FRAMES - 1) * BITS);
}

static kg_value gate(kg_tape *t, kg_value cell, int g, kg_value x)
{
  const kg_value w = kg_slice(t, cell, 0, g, 1), bias = kg_slice(t, cell, 0, GATES + g, 1);
  return kg_add(t, kg_mul(t, x, w), bias);
}

static kg_value tape_network(kg_tape *t, kg_value cells, kg_value extra, const double *start,
                             const double *text)
{
  kg_value hidden[LAYERS], memory[LAYERS], loss[FRAMES - 1];
  double ones[FRAMES];
  for (int l = 0; l < LAYERS; ++l) {
    hidden[l] = kg_constant(t, KG_SHAPE(1, BITS), start + 2 * l * BITS);
    memory[l] = kg_constant(t, KG_SHAPE(1, BITS), start + (2 * l + 1) * BITS);
  }
  for (int frame = 0; frame + 1 < FRAMES; ++frame) {
    kg_value x = kg_mul(t, kg_constant(t, KG_SHAPE(1, BITS), text + frame * BITS),
                        kg_slice(t, extra, 0, 0, 1));
    for (int l = 0; l < LAYERS; ++l) {
      const kg_value cell = kg_slice(t, cells, 0, 2 * GATES * l, 2 * GATES);
      const kg_value forget = kg_sigmoid(t, gate(t, cell, 0, x));
      const kg_value in = kg_sigmoid(t, gate(t, cell, 1, hidden[l]));
      const kg_value out = kg_sigmoid(t, gate(t, cell, 2, x));
      const kg_value change = kg_tanh(t, gate(t, cell, 3, hidden[l]));
      memory[l] = kg_add(t, kg_mul(t, memory[l], forget), kg_mul(t, in, change));
      x = hidden[l] = kg_mul(t, out, kg_tanh(t, memory[l]));
    }
    x = kg_add(t, kg_mul(t, x, kg_slice(t, extra, 0, 1, 1)), kg_slice(t, extra, 0, 2, 1));
    const kg_value sum = kg_shift(t, kg_sum_all(t, kg_exp(t, x)), 2);
    const kg_value gold = kg_constant(t, KG_SHAPE(1, BITS), text + (frame + 1) * BITS);
    loss[frame] = kg_sum_all(t, kg_mul(t, gold, kg_sub(t, x, kg_log(t, sum))));
    ones[frame] = -1.0 / ((FRAMES - 1) * BITS);
  }
  return kg_combine(t, FRAMES - 1, ones, loss);
}

static void a_recurrent_network(void **state)
{
  (void)state;
  kg_random random = kg_random_make(3);
  double *cells = random_numbers(&random, CELL), *extra = random_numbers(&random, EXTRA);
  double *start = random_numbers(&random, 2 * LAYERS * BITS);
  double *text = random_numbers(&random, FRAMES * BITS);
  kg_tape *tape;
  assert_int_equal(kg_tape_create(NULL, &tape, NULL), KG_OK);
  const kg_value in[2] = {kg_input(tape, KG_SHAPE(LAYERS * 2 * GATES, BITS), cells),
                          kg_input(tape, KG_SHAPE(3, BITS), extra)};
  const kg_value loss = tape_network(tape, in[0], in[1], start, text);
  double gradient[CELL + EXTRA], *parts[2] = {gradient, gradient + CELL};
  if (kg_gradient(tape, loss, 2, in, parts) != KG_OK) fail_msg("%s", kg_tape_error(tape)->text);
  complex_number p[CELL + EXTRA];
  for (int i = 0; i < CELL + EXTRA; ++i) {
    p[i] = i < CELL ? cells[i] : extra[i - CELL];
  }
  assert_close(kg_item(tape, loss), creal(plain_network(p, p + CELL, start, text)), 1e-14);
  const double scale = largest(gradient, CELL + EXTRA);
  for (int i = 0; i < CELL + EXTRA; ++i) {
    const complex_number at = p[i];
    p[i] = at + CMPLX(0, 1e-100);
    const double expected = cimag(plain_network(p, p + CELL, start, text)) / 1e-100;
    p[i] = at;
    assert_at_most(fabs(gradient[i] - expected), 1e-13 * scale);
  }
  kg_tape_destroy(tape);
  free(cells);
  free(extra);
  free(start);
  free(text);
}

/* -- a hand: BONES in chains of three below a palm, skinned points ------------------------------- */

enum { FINGERS = 5, BONES = 1 + 3 * FINGERS, POINTS = 20, POSE = 6 + 4 * FINGERS };

typedef struct hand {
  int parent[BONES];
  double base[BONES][16]; /* of a bone in its parent's frame, at rest */
  double inverse[BONES]
                [16]; /* of a bone's rest frame in the world, inverted (any matrix serves here) */
  double weight[BONES][POINTS], points[4][POINTS], target[3][POINTS];
} hand;

static void random_hand(hand *h, kg_random *random)
{
  for (int b = 0; b < BONES; ++b) {
    h->parent[b] = b == 0 ? -1 : (b - 1) % 3 == 0 ? 0 : b - 1;
    for (int i = 0; i < 16; ++i) {
      h->base[b][i] = i >= 12 ? i == 15 : 0.6 * kg_random_normal(random);
      h->inverse[b][i] = i >= 12 ? i == 15 : 0.6 * kg_random_normal(random);
    }
    for (int p = 0; p < POINTS; ++p) {
      h->weight[b][p] = kg_random_uniform(random) / BONES;
    }
  }
  for (int p = 0; p < POINTS; ++p) {
    for (int i = 0; i < 3; ++i) {
      h->points[i][p] = kg_random_normal(random);
      h->target[i][p] = kg_random_normal(random);
    }
    h->points[3][p] = 1;
  }
}

/* rotation by (x, z, y) angles as ADBench composes them: R = Ry Rz Rx, each a plain matrix */
static void plain_euler(const complex_number *angle, complex_number R[16])
{
  const complex_number cx = ccos(angle[0]), sx = csin(angle[0]), cy = ccos(angle[1]);
  const complex_number sy = csin(angle[1]), cz = ccos(angle[2]), sz = csin(angle[2]);
  const complex_number rows[16] = {cy * cz,
                                   -cx * sz + sx * sy * cz,
                                   sx * sz + cx * sy * cz,
                                   0,
                                   cy * sz,
                                   cx * cz + sx * sy * sz,
                                   -sx * cz + cx * sy * sz,
                                   0,
                                   -sy,
                                   sx * cy,
                                   cx * cy,
                                   0,
                                   0,
                                   0,
                                   0,
                                   1};
  memcpy(R, rows, sizeof rows);
}

static void plain_product(int m, int k, int n, const complex_number *a, const complex_number *b,
                          complex_number *c)
{
  for (int i = 0; i < m; ++i) {
    for (int j = 0; j < n; ++j) {
      c[i * n + j] = 0;
      for (int l = 0; l < k; ++l) {
        c[i * n + j] += a[i * k + l] * b[l * n + j];
      }
    }
  }
}

static void widen(const double *x, size_t n, complex_number *z)
{
  for (size_t i = 0; i < n; ++i) {
    z[i] = x[i];
  }
}

/* angles of bone b: three for the first of a finger (two of them free), one for the others */
static int first_angle(int b)
{
  return b == 0 ? -1 : 6 + 4 * ((b - 1) / 3) + ((b - 1) % 3 == 0 ? 0 : 1 + (b - 1) % 3);
}

static void plain_hand(const hand *h, const complex_number *pose, complex_number *residual)
{
  complex_number world[BONES][16], moved[3 * POINTS] = {0};
  for (int b = 0; b < BONES; ++b) {
    complex_number angle[3] = {0}, R[16], base[16], relative[16], inverse[16], skin[16];
    complex_number points[4 * POINTS], placed[4 * POINTS];
    if (b > 0) angle[0] = pose[first_angle(b)];
    if (b > 0 && (b - 1) % 3 == 0) angle[1] = pose[first_angle(b) + 1];
    plain_euler(angle, R);
    widen(h->base[b], 16, base);
    widen(h->inverse[b], 16, inverse);
    widen(&h->points[0][0], 4 * POINTS, points);
    plain_product(4, 4, 4, base, R, relative);
    if (b == 0) {
      memcpy(world[b], relative, sizeof relative);
    } else {
      plain_product(4, 4, 4, world[h->parent[b]], relative, world[b]);
    }
    plain_product(4, 4, 4, world[b], inverse, skin);
    plain_product(4, 4, POINTS, skin, points, placed);
    for (int i = 0; i < 3 * POINTS; ++i) {
      moved[i] += h->weight[b][i % POINTS] * placed[i];
    }
  }
  /* Rodrigues: v cos a + (k x v) sin a + k (k v)(1 - cos a), then the translation */
  const complex_number a = csqrt(pose[0] * pose[0] + pose[1] * pose[1] + pose[2] * pose[2]);
  const complex_number k[3] = {pose[0] / a, pose[1] / a, pose[2] / a};
  for (int p = 0; p < POINTS; ++p) {
    const complex_number v[3] = {moved[p], moved[POINTS + p], moved[2 * POINTS + p]};
    const complex_number kv = k[0] * v[0] + k[1] * v[1] + k[2] * v[2];
    for (int i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, l = (i + 2) % 3;
      residual[3 * p + i] =
        h->target[i][p] - (v[i] * ccos(a) + (k[j] * v[l] - k[l] * v[j]) * csin(a) +
                           k[i] * kv * (1 - ccos(a)) + pose[3 + i]);
    }
  }
}

static kg_value tape_euler(kg_tape *t, kg_value x, kg_value y)
{
  const kg_value zero = kg_constant_scalar(t, 0), one = kg_constant_scalar(t, 1);
  const kg_value cx = kg_cos(t, x), sx = kg_sin(t, x), cy = kg_cos(t, y), sy = kg_sin(t, y);
  const kg_value entries[16] = {cy,
                                kg_mul(t, sx, sy),
                                kg_mul(t, cx, sy),
                                zero,
                                zero,
                                cx,
                                kg_neg(t, sx),
                                zero,
                                kg_neg(t, sy),
                                kg_mul(t, sx, cy),
                                kg_mul(t, cx, cy),
                                zero,
                                zero,
                                zero,
                                zero,
                                one};
  return kg_reshape(t, kg_stack(t, 16, entries), KG_SHAPE(4, 4));
}

static kg_value tape_hand(kg_tape *t, const hand *h, kg_value pose)
{
  kg_value world[BONES], sum = {0};
  const kg_value points = kg_constant(t, KG_SHAPE(4, POINTS), &h->points[0][0]);
  const kg_value zero = kg_constant_scalar(t, 0);
  for (int b = 0; b < BONES; ++b) {
    const int at = first_angle(b);
    const kg_value x = b ? kg_element(t, pose, (size_t)at) : zero;
    const kg_value y = b && (b - 1) % 3 == 0 ? kg_element(t, pose, (size_t)at + 1) : zero;
    const kg_value base = kg_constant(t, KG_SHAPE(4, 4), h->base[b]);
    const kg_value relative = kg_matmul(t, base, tape_euler(t, x, y), 0);
    world[b] = b ? kg_matmul(t, world[h->parent[b]], relative, 0) : relative;
    const kg_value skin = kg_matmul(t, world[b], kg_constant(t, KG_SHAPE(4, 4), h->inverse[b]), 0);
    const kg_value placed = kg_slice(t, kg_matmul(t, skin, points, 0), 0, 0, 3);
    const kg_value weighted = kg_mul(t, placed, kg_constant(t, KG_SHAPE(POINTS), h->weight[b]));
    sum = b ? kg_add(t, sum, weighted) : weighted;
  }
  const kg_value turn = kg_rotation_exp(t, kg_slice(t, pose, 0, 0, 3));
  const kg_value all = kg_broadcast(t, turn, KG_SHAPE(POINTS, 4));
  const kg_value turned = kg_rotate(t, all, kg_transpose(t, sum, 0, 1));
  const kg_value target = kg_constant(t, KG_SHAPE(3, POINTS), &h->target[0][0]);
  return kg_sub(t, kg_transpose(t, target, 0, 1), kg_add(t, turned, kg_slice(t, pose, 0, 3, 3)));
}

static void the_pose_of_a_hand(void **state)
{
  (void)state;
  kg_random random = kg_random_make(4);
  hand h;
  random_hand(&h, &random);
  double *pose = random_numbers(&random, POSE), J[3 * POINTS * POSE];
  kg_tape *tape;
  assert_int_equal(kg_tape_create(NULL, &tape, NULL), KG_OK);
  const kg_value in = kg_input(tape, KG_SHAPE(POSE), pose), out = tape_hand(tape, &h, in);
  if (kg_jacobian(tape, out, in, J) != KG_OK) fail_msg("%s", kg_tape_error(tape)->text);
  complex_number p[POSE], residual[3 * POINTS];
  widen(pose, POSE, p);
  const double scale = largest(J, KG_COUNT_OF(J));
  for (int i = 0; i < POSE; ++i) {
    p[i] += CMPLX(0, 1e-100);
    plain_hand(&h, p, residual);
    p[i] = pose[i];
    for (int r = 0; r < 3 * POINTS; ++r) {
      assert_close(kg_item_at(tape, out, (size_t)r), creal(residual[r]), 1e-13);
      assert_at_most(fabs(J[r * POSE + i] - cimag(residual[r]) / 1e-100), 1e-13 * scale);
    }
  }
  kg_tape_destroy(tape);
  free(pose);
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(a_recurrent_network),
    cmocka_unit_test(the_pose_of_a_hand),
  };
  return cmocka_run_group_tests(tests, NULL, NULL);
}
