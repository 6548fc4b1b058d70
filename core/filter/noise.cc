#include "core/filter/noise.h"

#include "core/filter/lasting_errors.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kFloor = 1e-8;  // of a channel's variance, which is 1 in normalised units
constexpr size_t kLags = 20;

}  // namespace

NoiseEstimate::NoiseEstimate(const nssm::Bundle& bundle)
    : bundle_(bundle),
      filter_model_(FilterModel::Create(bundle)),
      scratch_(filter_model_->MakeScratch()) {
  const Index n = filter_model_->state_size(), n_y = bundle.model.spec().output_size;
  process_ = {std::vector(kLags + 1, MatrixXd(MatrixXd::Zero(n, n))), std::vector<int64_t>(kLags + 1)};
  measurement_ = {std::vector(kLags + 1, MatrixXd(MatrixXd::Zero(n_y, n_y))), std::vector<int64_t>(kLags + 1)};
  fitted_ = MatrixXd::Zero(n, n);
}

void NoiseEstimate::Add(const std::vector<double>& parameters, const data::Trajectory& normalised) {
  const nssm::ModelSpec& spec = bundle_.model.spec();
  const auto prepared = filter_model_->Prepare(parameters);
  const Index n = filter_model_->state_size(), n_y = spec.output_size, warmup = spec.warmup();
  const Index window = warmup * (spec.input_size + n_y);
  const auto state_at = [&](Index t) {
    if (!spec.is_case_one()) return VectorXd(normalised.states.col(t));
    VectorXd values(window), latent(n);
    for (Index s = 0, at = 0; s < warmup; ++s) {
      values.segment(at, spec.input_size) = normalised.inputs.col(t - warmup + 1 + s);
      at += spec.input_size;
      values.segment(at, n_y) = normalised.outputs.col(t - warmup + 1 + s);
      at += n_y;
    }
    filter_model_->Encode(*prepared, values, &latent, scratch_.get());
    if (spec.fits_start()) {
      fitted_ += filter_model_->EncodedCovariance(*scratch_);
      ++fitted_count_;
    }
    return latent;
  };
  VectorXd f(n), h(n_y);
  MatrixXd F(n, n), H(n_y, n);
  const bool next_input = spec.transition.input_time == nssm::InputTime::kNext;
  const Index begin = warmup - 1, samples = normalised.length() - begin;
  MatrixXd output_residuals(n_y, samples), state_residuals(n, samples - 1);
  VectorXd state = state_at(begin);
  for (Index i = 0; i < samples; ++i) {
    const Index t = begin + i;
    filter_model_->Measurement(*prepared, state, normalised.inputs.col(t), &h, &H, scratch_.get());
    output_residuals.col(i) = normalised.outputs.col(t) - h;
    if (i + 1 == samples) break;
    filter_model_->Transition(*prepared, state, normalised.inputs.col(next_input ? t + 1 : t), &f, &F, scratch_.get());
    state = state_at(t + 1);
    state_residuals.col(i) = state - f;
  }
  measurement_.Add(output_residuals);
  process_.Add(state_residuals);
}

void NoiseEstimate::Moments::Add(const MatrixXd& residuals) {
  for (size_t k = 0; k < sums.size(); ++k) {
    const Index pairs = residuals.cols() - static_cast<Index>(k);
    if (pairs <= 0) break;
    sums[k] += residuals.rightCols(pairs) * residuals.leftCols(pairs).transpose();
    counts[k] += pairs;
  }
}

std::vector<MatrixXd> NoiseEstimate::Moments::Means() const {
  std::vector<MatrixXd> means;
  for (size_t k = 0; k < sums.size() && counts[k] > 0; ++k) means.push_back(sums[k] / static_cast<double>(counts[k]));
  return means;
}

nssm::FilterNoise NoiseEstimate::Result(const data::Normaliser& normaliser) const {
  const bool case_one = bundle_.model.spec().is_case_one();
  const auto split = [case_one](std::vector<MatrixXd> moments) {
    moments[0].diagonal().array() += kFloor;
    if (case_one || moments.size() < 2) return SplitErrors{.lasting = {}, .white = moments[0]};
    return SplitByDuration(moments);
  };
  const SplitErrors process = split(process_.Means()), measurement = split(measurement_.Means());
  const auto scaled = [](const MatrixXd& rows, const VectorXd& scale) { return MatrixXd(scale.asDiagonal() * rows); };
  const auto physical = [&](const MatrixXd& cov, const VectorXd& scale) { return MatrixXd(scaled(cov, scale) * scale.asDiagonal()); };
  nssm::FilterNoise noise{.process = process.white, .measurement = physical(measurement.white, normaliser.outputs.scale)};
  noise.initial = fitted_count_ > 0 ? MatrixXd(fitted_ / static_cast<double>(fitted_count_)) : noise.process;
  if (case_one) return noise;
  const VectorXd& scale = normaliser.states.scale;
  noise.process = physical(process.white, scale);
  noise.initial = scale.cwiseAbs2().asDiagonal();
  noise.process_bias = {scaled(process.lasting.loadings, scale), process.lasting.correlation};
  noise.measurement_bias = {scaled(measurement.lasting.loadings, normaliser.outputs.scale), measurement.lasting.correlation};
  return noise;
}

}  // namespace metaekf::filter
