#include "core/nssm/start_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

#include "core/autodiff/differentiate.h"

namespace metaekf::nssm {

using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

enum Slot : int32_t { kParameters, kCarry, kTangents, kInput, kNextOut, kOutputOut, kNextTangentsOut, kOutputTangentsOut };

constexpr Index kStretch = 32;       // windows that follow each other in one place
constexpr Index kMostPlaces = 32;
constexpr int kSteps = 60;           // from one start at most
constexpr double kConverged = 0.1;   // decrease of ½ χ² that ends a fit: one-step errors are 0.7 % above those of the minimum
constexpr double kSurprise = 10;     // of ½ χ² above the last window's, that asks for other starts
constexpr double kFirstDamping = 1e-3;
constexpr double kEasing = 1.0 / 3;  // of the damping after a step, at most

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
  std::vector<Value> tangents =
      autodiff::Jvp(&graph, {{carry, graph.Input(kTangents, 0, n, n * width)}}, {step.next, step.output}, n);
  const int32_t rows[] = {n, output_size_};
  for (size_t i = 0; i < 2; ++i) {
    if (tangents[i] == kNoValue) tangents[i] = graph.Constant(0, rows[i], n * width);
  }
  step_.emplace(autodiff::Compile(graph, {{step.next, kNextOut},
                                          {step.output, kOutputOut},
                                          {tangents[0], kNextTangentsOut},
                                          {tangents[1], kOutputTangentsOut}}));
  arena_.emplace(std::initializer_list<const autodiff::Executable<double>*>{&*step_});
  const VectorXd zero = VectorXd::Zero(n);
  const Point point{zero, zero, zero, zero, MatrixXd::Zero(n, n), MatrixXd::Zero(n, n), 0};
  places_.assign(static_cast<size_t>(width), {.best = point, .trial = point, .fitted = point});
  for (MatrixXd* matrix : {&carry_, &next_, &second_}) matrix->setZero(n, width);
  for (MatrixXd* matrix : {&tangents_, &next_tangents_}) matrix->setZero(n, n * width);
  input_.setZero(input_size_, width);
  for (MatrixXd* matrix : {&output_, &measured_}) matrix->setZero(output_size_, width);
  output_tangents_.setZero(output_size_, n * width);
  for (Eigen::ArrayXXd* array : {&cost_, &residual_, &weighted_}) array->setZero(width, 1);
  gradient_.setZero(width, n);
  information_.setZero(width, n * (n + 1) / 2);
  damped_.setZero(n, n);
  step_vector_.setZero(n);
}

int32_t StartFit::WidthFor(Index windows) {
  return static_cast<int32_t>(std::clamp<Index>((windows + kStretch - 1) / kStretch, 1, kMostPlaces));
}

// ---- one window after the other ----

const MatrixXd& StartFit::Fit(const double* parameters, const MatrixXd& windows) {
  const Index count = windows.cols();
  result_.resize(latent_size_, count);
  Index next = 0;
  size_t busy = 0;
  for (Place& place : places_) {
    place.window = kNone;
    if (next >= count) continue;
    BeginStretch(&place, next, windows);
    next += kStretch;
    ++busy;
  }
  while (busy > 0) {
    Evaluate(parameters, windows);
    for (size_t j = 0; j < places_.size(); ++j) {
      Place& place = places_[j];
      if (place.window == kNone) continue;
      Read(static_cast<Index>(j), &place.trial);
      if (!Advance(&place, windows)) continue;
      if (next < count) {
        BeginStretch(&place, next, windows);
        next += kStretch;
      } else {
        place.window = kNone;
        --busy;
      }
    }
  }
  return result_;
}

void StartFit::BeginStretch(Place* place, Index first, const MatrixXd& windows) {
  place->window = first;
  place->stretch_end = std::min(first + kStretch, windows.cols());
  BeginStart(place, Start::kGuess, windows);
}

void StartFit::BeginStart(Place* place, Start start, const MatrixXd& windows) {
  place->start = start;
  place->steps = 0;
  place->damping = kFirstDamping;
  VectorXd& at = place->trial.start;
  switch (start) {
    case Start::kContinued:
      place->reference = place->fitted.cost;
      at = place->fitted.second;
      break;
    case Start::kGuess:
      at = guess_.col(windows.rows());
      at.noalias() += guess_.leftCols(windows.rows()).lazyProduct(windows.col(place->window));
      break;
    case Start::kOrigin:
      at.setZero();
      break;
  }
}

/// Decides, after a pass, where the next one is. Whether the stretch is done.
bool StartFit::Advance(Place* place, const MatrixXd& windows) {
  if (!Judge(place)) {
    Propose(place);
    return false;
  }
  const bool is_first = place->start == Start::kContinued || (place->start == Start::kGuess && place->window % kStretch == 0);
  if (is_first || place->best.cost < place->fitted.cost) std::swap(place->best, place->fitted);
  const bool as_before =
      place->start == Start::kContinued && place->fitted.cost <= place->reference + kSurprise * UnitOf(place->reference);
  if (!as_before && place->start != Start::kOrigin) {
    BeginStart(place, place->start == Start::kContinued ? Start::kGuess : Start::kOrigin, windows);
    return false;
  }
  result_.col(place->window) = place->fitted.end;
  if (++place->window == place->stretch_end) return true;
  BeginStart(place, Start::kContinued, windows);
  return false;
}

/// What counts as one in ½ χ²: where a model explains a window worse than the noise can be, that misfit is its noise.
double StartFit::UnitOf(double cost) const {
  const double expected = 0.5 * static_cast<double>((window_ - 1) * output_size_);
  return std::max(1.0, cost / expected);
}

// ---- steps from one start ----

/// Keeps what is better, and eases or tightens the damping by how much of what was promised has come (H. B. Nielsen, Damping
/// Parameter in Marquardt's Method, 1999). Whether the fit from this start has ended.
bool StartFit::Judge(Place* place) const {
  const bool is_start = place->steps++ == 0;
  const double gained = place->best.cost - place->trial.cost;
  const bool better = is_start || gained > 0;
  if (better) std::swap(place->best, place->trial);
  if (is_start) {
    place->growth = 2;
    return !std::isfinite(place->best.cost);
  }
  if (better) {
    place->damping *= std::max(kEasing, 1 - std::pow(2 * gained / place->promised - 1, 3));
    place->growth = 2;
  } else {
    place->damping *= place->growth;
    place->growth *= 2;
  }
  return (better ? gained : place->promised) < kConverged * UnitOf(place->best.cost) || place->steps == kSteps;
}

void StartFit::Propose(Place* place) {
  const Point& best = place->best;
  damped_ = best.information;
  damped_.diagonal() *= 1 + place->damping;
  const Eigen::LLT<Eigen::Ref<MatrixXd>> factor(damped_);
  step_vector_ = best.gradient;
  factor.solveInPlace(step_vector_);
  place->trial.start = best.start - step_vector_;
  place->promised = step_vector_.dot(best.gradient) - 0.5 * step_vector_.dot(best.information.lazyProduct(step_vector_));
}

// ---- passes through the windows ----

/// Runs every place's window from its trial's start.
void StartFit::Evaluate(const double* parameters, const MatrixXd& windows) {
  const Index rows = input_size_ + output_size_;
  autodiff::Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kCarry, carry_.data())
      .Input(kTangents, tangents_.data())
      .Input(kInput, input_.data())
      .Output(kNextOut, next_.data())
      .Output(kOutputOut, output_.data())
      .Output(kNextTangentsOut, next_tangents_.data())
      .Output(kOutputTangentsOut, output_tangents_.data());
  tangents_.setZero();
  for (Index i = 0; i < latent_size_; ++i) tangents_.row(i).segment(i * width_, width_).setOnes();
  for (Index j = 0; j < width_; ++j) carry_.col(j) = places_[static_cast<size_t>(j)].trial.start;
  cost_.setZero();
  gradient_.setZero();
  information_.setZero();
  for (Index k = 0; k + 1 < window_; ++k) {
    for (Index j = 0; j < width_; ++j) {
      const Index window = places_[static_cast<size_t>(j)].window;
      if (window == kNone) continue;
      input_.col(j) = windows.block((k + input_shift_) * rows, window, input_size_, 1);
      measured_.col(j) = windows.block((k + 1) * rows + input_size_, window, output_size_, 1);
    }
    autodiff::Evaluate(*step_, slots, *arena_);
    Accumulate();
    carry_.swap(next_);
    tangents_.swap(next_tangents_);
    slots.Input(kCarry, carry_.data()).Input(kTangents, tangents_.data()).Output(kNextOut, next_.data()).Output(kNextTangentsOut, next_tangents_.data());
    if (k == 0) second_ = carry_;
  }
}

/// Adds what one sample says.
void StartFit::Accumulate() {
  for (Index c = 0; c < output_size_; ++c) {
    residual_ = (output_.row(c) - measured_.row(c)).transpose();
    cost_ += 0.5 * weights_[c] * residual_.square();
    const auto by_component = [&](Index i) { return output_tangents_.row(c).segment(i * width_, width_).transpose().array(); };
    Index pair = 0;
    for (Index i = 0; i < latent_size_; ++i) {
      weighted_ = weights_[c] * by_component(i);
      gradient_.col(i) += weighted_ * residual_;
      for (Index l = 0; l <= i; ++l) information_.col(pair++) += weighted_ * by_component(l);
    }
  }
}

/// What the last pass has found in one place.
void StartFit::Read(Index column, Point* point) const {
  const Index n = latent_size_;
  point->second = second_.col(column);
  point->end = carry_.col(column);
  point->gradient.noalias() = start_precision_.lazyProduct(point->start);
  point->cost = cost_(column, 0) + 0.5 * point->start.dot(point->gradient);
  if (!std::isfinite(point->cost)) point->cost = std::numeric_limits<double>::infinity();
  Index pair = 0;
  for (Index i = 0; i < n; ++i) {
    point->gradient[i] += gradient_(column, i);
    point->sensitivity.col(i) = tangents_.col(i * width_ + column);
    for (Index l = 0; l <= i; ++l) {
      point->information(i, l) = start_precision_(i, l) + information_(column, pair++);
      point->information(l, i) = point->information(i, l);
    }
  }
}

MatrixXd StartFit::Covariance() const {
  const Point& fitted = places_[0].fitted;
  return fitted.sensitivity * fitted.information.llt().solve(fitted.sensitivity.transpose());
}

}  // namespace metaekf::nssm
