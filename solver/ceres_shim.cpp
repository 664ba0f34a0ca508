/* The one file that sees Ceres; the contract is in kinegrad/ceres.h.
 *
 * Ceres writes to its log on stderr when a residual that claims success holds a NaN, and when the
 * start breaks a bound: both are settled here, so its logging is never reached. */
#include "kinegrad/ceres.h"

#include <ceres/ceres.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <new>
#include <vector>

namespace
{

bool all_finite(const double *a, size_t count)
{
  return std::all_of(a, a + count, [](double value) { return std::isfinite(value); });
}

class callback_cost : public ceres::CostFunction
{
public:
  explicit callback_cost(const kg_ceres_def &def) : def_(def), m_(size_t(def.residual_count))
  {
    set_num_residuals(def.residual_count);
    mutable_parameter_block_sizes()->push_back(def.n);
  }

  bool Evaluate(double const *const *x, double *r, double **J) const override
  {
    if (!residual(r, x[0])) return false;
    if (!J || !J[0]) return true;
    if (!def_.jacobian) return differences(J[0], x[0]);
    return def_.jacobian(J[0], x[0], def_.user) && all_finite(J[0], m_ * size_t(def_.n));
  }

private:
  bool residual(double *r, const double *x) const
  {
    return def_.residual(r, x, def_.user) && all_finite(r, m_);
  }

  /* dr/dx_j = (8 (r(h) - r(-h)) - (r(2h) - r(-2h))) / 12 h + O(h^4); h = eps^(1/5) balances the
   * truncation against rounding */
  bool differences(double *J, const double *x) const
  {
    const int n = def_.n;
    std::vector<double> y(x, x + n), r(4 * m_);
    for (int j = 0; j < n; j++) {
      const double h = 7.4e-4 * std::max(1.0, std::fabs(x[j]));
      const double steps[4] = {-2.0 * h, -h, h, 2.0 * h};
      for (size_t k = 0; k < 4; k++) {
        y[size_t(j)] = x[j] + steps[k];
        if (!residual(&r[k * m_], y.data())) return false;
      }
      y[size_t(j)] = x[j];
      for (size_t i = 0; i < m_; i++) {
        const double near = r[2 * m_ + i] - r[m_ + i], far = r[3 * m_ + i] - r[i];
        J[i * size_t(n) + size_t(j)] = (8.0 * near - far) / (12.0 * h);
      }
    }
    return true;
  }

  const kg_ceres_def def_;
  const size_t m_;
};

ceres::Solver::Options solver_options(const kg_ceres_def &def)
{
  ceres::Solver::Options options;
  options.logging_type = ceres::SILENT;
  options.minimizer_progress_to_stdout = false;
  options.linear_solver_type = ceres::DENSE_QR;
  options.num_threads = 1;
  options.max_num_iterations = def.max_iterations;
  options.gradient_tolerance = def.gradient_tolerance;
  options.function_tolerance = def.function_tolerance;
  options.parameter_tolerance = def.parameter_tolerance;
  return options;
}

void set_bounds(ceres::Problem &problem, const kg_ceres_def &def, double *x)
{
  for (int i = 0; i < def.n; i++) {
    if (def.lower) {
      problem.SetParameterLowerBound(x, i, def.lower[i]);
      x[i] = std::max(x[i], def.lower[i]);
    }
    if (def.upper) {
      problem.SetParameterUpperBound(x, i, def.upper[i]);
      x[i] = std::min(x[i], def.upper[i]);
    }
  }
}

kg_status minimize(const kg_ceres_def &def, double *x, kg_ceres_report *report)
{
  std::vector<double> best(x, x + def.n), r(size_t(def.residual_count));
  ceres::Problem problem;
  problem.AddResidualBlock(new callback_cost(def), nullptr, best.data());
  set_bounds(problem, def, best.data());
  if (!all_finite(best.data(), best.size()) || !def.residual(r.data(), best.data(), def.user) ||
      !all_finite(r.data(), r.size())) {
    return KG_ERR_UNDEFINED;
  }
  ceres::Solver::Summary summary;
  ceres::Solve(solver_options(def), &problem, &summary);
  report->converged = summary.termination_type == ceres::CONVERGENCE;
  report->iterations = summary.num_successful_steps + summary.num_unsuccessful_steps;
  report->cost_before = summary.initial_cost;
  report->cost = summary.final_cost;
  std::snprintf(report->text, sizeof report->text, "%s", summary.message.c_str());
  std::copy(best.begin(), best.end(), x);
  return KG_OK;
}

} // namespace

extern "C" kg_ceres_def kg_ceres_default_def(int n, int residual_count)
{
  kg_ceres_def def = {};
  def.n = n;
  def.residual_count = residual_count;
  def.max_iterations = 200;
  def.gradient_tolerance = 1e-12;
  def.function_tolerance = 1e-16;
  def.parameter_tolerance = 1e-15;
  return def;
}

extern "C" kg_status kg_ceres_minimize(const kg_ceres_def *def, double *x, kg_ceres_report *report)
{
  KG_ASSERT(def && x && report && def->n >= 1 && def->residual_count >= 1 && def->residual);
  *report = {};
  try {
    return minimize(*def, x, report);
  } catch (const std::bad_alloc &) {
    return KG_ERR_NO_MEMORY;
  } catch (...) { /* Ceres documents none: whatever it is, it must not cross into C */
    return KG_ERR_UNDEFINED;
  }
}
