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

constexpr int kPasses = 60;  // of one window, which takes 35 on average: the last digits come slowly along a curved valley
constexpr double kFirstDamping = 1e-3, kDampingFactor = 10;
constexpr double kConverged = 1e-6;  // relative change of the cost that a window stops at

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
  places_.assign(static_cast<size_t>(width), {.best = point, .trial = point});
  carry_.setZero(n, width);
  next_.setZero(n, width);
  input_.setZero(input_size_, width);
  output_.setZero(output_size_, width);
  by_carry_next_.setZero(n, n * width);
  by_carry_output_.setZero(output_size_, n * width);
  damped_.setZero(n, n);
  product_.setZero(n, n);
  row_.setZero(n);
  step_vector_.setZero(n);
}

void StartFit::Begin(Place* place, Index window, const MatrixXd& windows) {
  place->window = window;
  place->passes = 0;
  place->damping = kFirstDamping;
  place->best.cost = std::numeric_limits<double>::infinity();
  place->trial.start = guess_.col(windows.rows());
  place->trial.start.noalias() += guess_.leftCols(windows.rows()).lazyProduct(windows.col(window));
}

void StartFit::Evaluate(const double* parameters, const MatrixXd& windows) {
  const Index n = latent_size_, rows = input_size_ + output_size_;
  autodiff::Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kCarry, carry_.data())
      .Input(kInput, input_.data())
      .Output(kNextOut, next_.data())
      .Output(kOutputOut, output_.data())
      .Output(kByCarryNextOut, by_carry_next_.data())
      .Output(kByCarryOutputOut, by_carry_output_.data());
  for (Index j = 0; j < width_; ++j) {
    Place& place = places_[static_cast<size_t>(j)];
    if (place.window == kNone) continue;
    Point& p = place.trial;
    carry_.col(j) = p.start;
    p.sensitivity.setIdentity();
    p.information = start_precision_;
    p.gradient.noalias() = start_precision_.lazyProduct(p.start);
    p.cost = 0.5 * p.start.dot(p.gradient);
  }
  for (Index k = 0; k + 1 < window_; ++k) {
    for (Index j = 0; j < width_; ++j) {
      const Index window = places_[static_cast<size_t>(j)].window;
      if (window != kNone) input_.col(j) = windows.block((k + input_shift_) * rows, window, input_size_, 1);
    }
    autodiff::Evaluate(*step_, slots, *arena_);
    for (Index j = 0; j < width_; ++j) {
      Place& place = places_[static_cast<size_t>(j)];
      if (place.window == kNone) continue;
      Point& p = place.trial;
      for (Index c = 0; c < output_size_; ++c) {
        const double residual = output_(c, j) - windows((k + 1) * rows + input_size_ + c, place.window);
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
  for (Index j = 0; j < width_; ++j) {
    Point& p = places_[static_cast<size_t>(j)].trial;
    p.end = carry_.col(j);
    if (!std::isfinite(p.cost)) p.cost = std::numeric_limits<double>::infinity();
  }
}

/// Keeps what is better. Whether the window is done.
bool StartFit::Judge(Place* place) {
  const double change = std::abs(place->best.cost - place->trial.cost);
  const bool better = place->trial.cost < place->best.cost || place->passes == 0;
  ++place->passes;
  const bool is_step = place->passes > 2;  // the first two are the guess and the origin
  const bool converged = is_step && std::isfinite(change) && change <= kConverged * place->best.cost;
  if (better) std::swap(place->best, place->trial);
  if (is_step) place->damping *= better ? 1 / kDampingFactor : kDampingFactor;
  return converged || place->passes == kPasses;
}

void StartFit::Propose(Place* place) {
  if (place->passes == 1) {
    place->trial.start.setZero();
    return;
  }
  damped_ = place->best.information;
  damped_.diagonal() *= 1 + place->damping;
  const Eigen::LLT<Eigen::Ref<MatrixXd>> factor(damped_);
  step_vector_ = place->best.gradient;
  factor.solveInPlace(step_vector_);
  place->trial.start = place->best.start - step_vector_;
}

const MatrixXd& StartFit::Fit(const double* parameters, const MatrixXd& windows) {
  const Index count = windows.cols();
  result_.resize(latent_size_, count);
  Index next = 0, busy = 0;
  for (Place& place : places_) {
    place.window = kNone;
    if (next == count) continue;
    Begin(&place, next++, windows);
    ++busy;
  }
  while (busy > 0) {
    Evaluate(parameters, windows);
    for (Place& place : places_) {
      if (place.window == kNone) continue;
      if (!Judge(&place)) {
        Propose(&place);
        continue;
      }
      result_.col(place.window) = place.best.end;
      if (next < count) {
        Begin(&place, next++, windows);
      } else {
        place.window = kNone;
        --busy;
      }
    }
  }
  return result_;
}

MatrixXd StartFit::Covariance(int32_t column) const {
  const Point& p = places_[static_cast<size_t>(column)].best;
  return p.sensitivity * p.information.llt().solve(p.sensitivity.transpose());
}

}  // namespace metaekf::nssm
