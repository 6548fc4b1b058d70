#include "core/nssm/start_fit.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <limits>

#include "core/autodiff/differentiate.h"

namespace metaekf::nssm {

using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Output;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

enum Slot : int32_t { kParameters, kCarry, kInput, kNextOut, kOutputOut, kByCarryNextOut, kByCarryOutputOut };

constexpr int kPasses = 15;
constexpr double kFirstDamping = 1e-3, kDampingFactor = 10;
constexpr double kConverged = 1e-6;  // relative decrease of the cost that a column stops at

}  // namespace

StartFit::StartFit(const Model& model, const GaussianPrior& prior, int32_t width)
    : latent_size_(model.spec().latent_size),
      input_size_(model.spec().input_size),
      output_size_(model.spec().output_size),
      window_(model.spec().window),
      width_(width),
      input_shift_(model.spec().transition.input_time == InputTime::kNext ? 1 : 0),
      start_precision_(prior.start),
      guess_(prior.start_guess),
      weights_(prior.noise_variance.cwiseInverse()) {
  const int32_t n = latent_size_;
  Graph graph;
  const ModelGraph parts(&model, &graph, nn::BindParameters(model.layout(), kParameters, &graph));
  const Value carry = graph.Input(kCarry, 0, n, width);
  const Value input = input_size_ > 0 ? graph.Input(kInput, 0, input_size_, width) : kNoValue;
  const Step step = BuildStep(model, RolloutMode::kLatent, parts, carry, input);
  // Direction i is a block of columns that moves component i of every window's carry.
  std::vector<double> directions(static_cast<size_t>(n * n * width), 0);
  for (int32_t i = 0; i < n; ++i) {
    for (int32_t j = 0; j < width; ++j) directions[static_cast<size_t>((i * width + j) * n + i)] = 1;
  }
  const Value seed = graph.ConstantData(std::move(directions), n, n * width);
  std::vector<Value> tangents = autodiff::Jvp(&graph, {{carry, seed}}, {step.next, step.output}, n);
  const int32_t rows[] = {n, output_size_};
  for (size_t i = 0; i < 2; ++i) {
    if (tangents[i] == kNoValue) tangents[i] = graph.Constant(0, rows[i], n * width);
  }
  step_.emplace(autodiff::Compile(graph, {{step.next, kNextOut},
                                          {step.output, kOutputOut},
                                          {tangents[0], kByCarryNextOut},
                                          {tangents[1], kByCarryOutputOut}}));
  arena_.emplace(std::initializer_list<const autodiff::Executable<double>*>{&*step_});
  const Point point{VectorXd::Zero(n), VectorXd::Zero(n), VectorXd::Zero(n), MatrixXd::Zero(n, n), MatrixXd::Zero(n, n), 0};
  best_.assign(static_cast<size_t>(width), point);
  trial_ = best_;
  damping_.assign(static_cast<size_t>(width), 0);
  carry_.setZero(n, width);
  next_.setZero(n, width);
  input_.setZero(input_size_, width);
  output_.setZero(output_size_, width);
  by_carry_next_.setZero(n, n * width);
  by_carry_output_.setZero(output_size_, n * width);
  result_.setZero(n, width);
  damped_.setZero(n, n);
  product_.setZero(n, n);
  row_.setZero(n);
  step_vector_.setZero(n);
}

void StartFit::Evaluate(const double* parameters, const MatrixXd& windows, int32_t count) {
  const Index n = latent_size_, rows = input_size_ + output_size_;
  autodiff::Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kCarry, carry_.data())
      .Input(kInput, input_.data())
      .Output(kNextOut, next_.data())
      .Output(kOutputOut, output_.data())
      .Output(kByCarryNextOut, by_carry_next_.data())
      .Output(kByCarryOutputOut, by_carry_output_.data());
  for (int32_t j = 0; j < count; ++j) {
    Point& p = trial_[static_cast<size_t>(j)];
    carry_.col(j) = p.start;
    p.sensitivity.setIdentity();
    p.information = start_precision_;
    p.gradient.noalias() = start_precision_.lazyProduct(p.start);
    p.cost = 0.5 * p.start.dot(p.gradient);
  }
  for (Index k = 0; k + 1 < window_; ++k) {
    input_.leftCols(count) = windows.block((k + input_shift_) * rows, 0, input_size_, count);
    autodiff::Evaluate(*step_, slots, *arena_);
    for (int32_t j = 0; j < count; ++j) {
      Point& p = trial_[static_cast<size_t>(j)];
      for (Index c = 0; c < output_size_; ++c) {
        const double residual = output_(c, j) - windows((k + 1) * rows + input_size_ + c, j);
        row_.setZero();
        for (Index i = 0; i < n; ++i) row_ += by_carry_output_(c, i * width_ + j) * p.sensitivity.row(i).transpose();
        p.cost += 0.5 * weights_[c] * residual * residual;
        p.gradient += weights_[c] * residual * row_;
        p.information.noalias() += weights_[c] * row_.lazyProduct(row_.transpose());
      }
      product_.setZero();
      for (Index i = 0; i < n; ++i) {
        product_.noalias() += by_carry_next_.col(i * width_ + j).lazyProduct(p.sensitivity.row(i));
      }
      p.sensitivity = product_;
    }
    carry_ = next_;
  }
  for (int32_t j = 0; j < count; ++j) {
    Point& p = trial_[static_cast<size_t>(j)];
    p.end = carry_.col(j);
    if (!std::isfinite(p.cost)) p.cost = std::numeric_limits<double>::infinity();
  }
}

const MatrixXd& StartFit::Fit(const double* parameters, const MatrixXd& windows, int32_t count) {
  for (int32_t j = 0; j < count; ++j) {
    VectorXd& start = trial_[static_cast<size_t>(j)].start;
    start = guess_.col(windows.rows());
    start.noalias() += guess_.leftCols(windows.rows()).lazyProduct(windows.col(j));
  }
  Evaluate(parameters, windows, count);
  for (int32_t j = 0; j < count; ++j) {
    std::swap(best_[static_cast<size_t>(j)], trial_[static_cast<size_t>(j)]);
    damping_[static_cast<size_t>(j)] = kFirstDamping;
  }
  for (int pass = 1; pass < kPasses; ++pass) {
    for (int32_t j = 0; j < count; ++j) {
      const Point& p = best_[static_cast<size_t>(j)];
      damped_ = p.information;
      damped_.diagonal() *= 1 + damping_[static_cast<size_t>(j)];
      const Eigen::LLT<Eigen::Ref<MatrixXd>> factor(damped_);
      step_vector_ = p.gradient;
      factor.solveInPlace(step_vector_);
      trial_[static_cast<size_t>(j)].start = p.start - step_vector_;
    }
    Evaluate(parameters, windows, count);
    bool converged = true;
    for (int32_t j = 0; j < count; ++j) {
      Point &best = best_[static_cast<size_t>(j)], &trial = trial_[static_cast<size_t>(j)];
      double& damping = damping_[static_cast<size_t>(j)];
      if (trial.cost < best.cost) {
        converged = converged && best.cost - trial.cost <= kConverged * best.cost;
        std::swap(best, trial);
        damping /= kDampingFactor;
      } else {
        converged = converged && trial.cost - best.cost <= kConverged * best.cost;
        damping *= kDampingFactor;
      }
    }
    if (converged) break;
  }
  for (int32_t j = 0; j < count; ++j) result_.col(j) = best_[static_cast<size_t>(j)].end;
  return result_;
}

MatrixXd StartFit::Covariance(int32_t column) const {
  const Point& p = best_[static_cast<size_t>(column)];
  return p.sensitivity * p.information.llt().solve(p.sensitivity.transpose());
}

}  // namespace metaekf::nssm
