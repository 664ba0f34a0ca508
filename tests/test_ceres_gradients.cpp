/* A second opinion: Ceres' GradientChecker on the Jacobians of recorded functions, and on the same functions with a
 * fault planted, where it and kg_gradcheck must both say no.
 *
 * Ceres differentiates numerically by Ridders' method, a code of its own. A cost function here has two parameter
 * blocks, which are the two halves of the packed input of kg_gradcheck_recorded. */
/* Eigen frees memory another way under the address sanitizer, but Ceres was not built with it. */
#define EIGEN_MALLOC_ALREADY_ALIGNED 1
#include <ceres/cost_function.h>
#include <ceres/gradient_checker.h>

#include <csetjmp>
#include <cstdarg>
#include <cstddef>
#include <cstdint>
#include <vector>
extern "C" {
#include <cmocka.h> /* behind the others: its macro `fail` is a name of theirs */
}

#include "kinegrad/derivatives.h"
#include "kinegrad/gradcheck.h"
#include "kinegrad/random.h"

namespace
{

enum fault { RIGHT, SIGN, MISSING, FACTOR };

kg_shape vector_of(int n)
{
  return kg_shape{1, {n}};
}

/* Two packed blocks to a vector of residuals. */
typedef kg_value formula(kg_tape *tape, kg_value a, kg_value b);

/* a rotation vector and a point: where the point goes, and how far */
kg_value rotation(kg_tape *tape, kg_value a, kg_value b)
{
  const kg_value moved = kg_rotate(tape, kg_rotation_exp(tape, a), b);
  const kg_value parts[2] = {
    moved, kg_reshape(tape, kg_norm(tape, kg_sub(tape, moved, a), 0), vector_of(1))};
  return kg_concat(tape, 0, 2, parts);
}

/* weights (3, 4) and inputs (4) of a layer with its soft maximum */
kg_value layer(kg_tape *tape, kg_value a, kg_value b)
{
  const kg_value W = kg_reshape(tape, a, kg_shape{2, {3, 4}});
  const kg_value x = kg_reshape(tape, b, kg_shape{2, {4, 1}});
  const kg_value y = kg_tanh(tape, kg_reshape(tape, kg_matmul(tape, W, x, 0), vector_of(3)));
  const kg_value parts[2] = {kg_softmax(tape, y, 0),
                             kg_reshape(tape, kg_logsumexp(tape, y, 0), vector_of(1))};
  return kg_concat(tape, 0, 2, parts);
}

/* (A A' + 1) X = b with A (3, 3) */
kg_value system(kg_tape *tape, kg_value a, kg_value b)
{
  static const double identity[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  const kg_value A = kg_reshape(tape, a, kg_shape{2, {3, 3}});
  const kg_value M = kg_add(tape, kg_matmul(tape, A, A, KG_TRANSPOSE_B),
                            kg_constant(tape, kg_shape{2, {3, 3}}, identity));
  const kg_value x = kg_solve(tape, M, kg_reshape(tape, b, kg_shape{2, {3, 2}}), 0);
  return kg_reshape(tape, x, vector_of(6));
}

/* scalars: the pinhole camera of bundle adjustment with one term of distortion */
kg_value camera(kg_tape *tape, kg_value a, kg_value b)
{
  kg_value p[3], f = kg_element(tape, a, 0), k = kg_element(tape, a, 1);
  for (size_t i = 0; i < 3; ++i) {
    p[i] = kg_element(tape, b, i);
  }
  const kg_value depth = kg_shift(tape, kg_square(tape, p[2]), 2.0);
  const kg_value u = kg_div(tape, p[0], depth), v = kg_div(tape, p[1], depth);
  const kg_value r2 = kg_add(tape, kg_square(tape, u), kg_square(tape, v));
  const kg_value gain = kg_mul(tape, f, kg_shift(tape, kg_mul(tape, k, r2), 1.0));
  const kg_value image[2] = {kg_mul(tape, gain, u), kg_mul(tape, gain, v)};
  return kg_stack(tape, 2, image);
}

struct function {
  const char *name;
  formula *record;
  int a, b, residuals;
};

const function functions[] = {{"rotation", rotation, 3, 3, 4},
                              {"layer", layer, 12, 4, 4},
                              {"system", system, 9, 6, 6},
                              {"camera", camera, 2, 3, 2}};

/* a with its value, and the derivative of its first entry turned around, lost or 1.001 times too large: constants that
 * are made anew at each recording hide a part of it. */
kg_value spoil(kg_tape *tape, kg_value a, fault kind)
{
  if (kind == RIGHT) return a;
  const size_t n = kg_size_of(tape, a);
  std::vector<double> factor(n, 1.0), rest(n, 0.0);
  factor[0] = kind == SIGN ? -1.0 : kind == MISSING ? 0.0 : 1.001;
  rest[0] = (1.0 - factor[0]) * kg_item(tape, a);
  const kg_shape shape = kg_shape_of(tape, a);
  const kg_value bent = kg_mul(tape, a, kg_constant(tape, shape, factor.data()));
  return kg_add(tape, bent, kg_constant(tape, shape, rest.data()));
}

struct recording {
  const function *f;
  fault kind;
};

/* the same for kg_gradcheck: both blocks from one input */
kg_value record_packed(kg_tape *tape, kg_value x, void *user)
{
  const recording *r = static_cast<recording *>(user);
  const kg_value a = kg_slice(tape, x, 0, 0, r->f->a);
  const kg_value b = kg_slice(tape, x, 0, r->f->a, r->f->b);
  return r->f->record(tape, spoil(tape, a, r->kind), b);
}

class tape_cost : public ceres::CostFunction
{
public:
  tape_cost(const recording &r) : recording_(r)
  {
    set_num_residuals(r.f->residuals);
    *mutable_parameter_block_sizes() = {r.f->a, r.f->b};
    assert_int_equal(kg_tape_create(nullptr, &tape_, nullptr), KG_OK);
  }
  tape_cost(const tape_cost &) = delete;
  tape_cost &operator=(const tape_cost &) = delete;
  ~tape_cost() override
  {
    kg_tape_destroy(tape_);
  }

  bool Evaluate(double const *const *x, double *residuals, double **J) const override
  {
    const function &f = *recording_.f;
    kg_tape_rewind(tape_, kg_tape_mark{});
    const kg_value in[2] = {kg_input(tape_, vector_of(f.a), x[0]),
                            kg_input(tape_, vector_of(f.b), x[1])};
    const kg_value y = f.record(tape_, spoil(tape_, in[0], recording_.kind), in[1]);
    for (int i = 0; i < f.residuals; ++i) {
      residuals[i] = kg_item_at(tape_, y, size_t(i));
    }
    for (int k = 0; J && k < 2; ++k) {
      if (J[k]) kg_jacobian(tape_, y, in[k], J[k]);
    }
    return kg_tape_status(tape_) == KG_OK;
  }

private:
  recording recording_;
  kg_tape *tape_ = nullptr;
};

bool ceres_says_yes(const recording &r, const double *x)
{
  const tape_cost cost(r);
  const ceres::GradientChecker checker(
    &cost, static_cast<const std::vector<const ceres::Manifold *> *>(nullptr),
    ceres::NumericDiffOptions());
  const double *blocks[2] = {x, x + r.f->a};
  ceres::GradientChecker::ProbeResults results;
  return checker.Probe(blocks, 1e-6, &results);
}

bool we_say_yes(recording *r, const double *x)
{
  kg_gradcheck_report report;
  kg_error error{};
  if (kg_gradcheck_recorded(r->f->name, record_packed, r, vector_of(r->f->a + r->f->b), x, nullptr,
                            &report, &error) != KG_OK) {
    fail_msg("%s", error.text);
  }
  return report.passed;
}

void both_agree(void **)
{
  kg_random random = kg_random_make(1);
  for (const function &f : functions) {
    for (const fault kind : {RIGHT, SIGN, MISSING, FACTOR}) {
      for (int point = 0; point < 20; ++point) {
        recording r = {&f, kind};
        std::vector<double> x(size_t(f.a + f.b));
        for (double &entry : x) {
          entry = kg_random_normal(&random);
        }
        const bool yes = kind == RIGHT;
        if (ceres_says_yes(r, x.data()) != yes)
          fail_msg("Ceres on %s, fault %d", f.name, int(kind));
        if (we_say_yes(&r, x.data()) != yes)
          fail_msg("kg_gradcheck on %s, fault %d", f.name, int(kind));
      }
    }
  }
}

} // namespace

int main()
{
  const struct CMUnitTest tests[] = {cmocka_unit_test(both_agree)};
  return cmocka_run_group_tests(tests, nullptr, nullptr);
}
