#include "core/filter/noise.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kFloor = 1e-8;  // of a channel's variance, which is 1 in normalised units

}  // namespace

NoiseEstimate::NoiseEstimate(const nssm::Bundle& bundle)
    : bundle_(bundle),
      filter_model_(FilterModel::Create(bundle)),
      scratch_(filter_model_->MakeScratch()) {
  const Index n = filter_model_->state_size(), n_y = bundle.model.spec().output_size;
  process_ = MatrixXd::Zero(n, n);
  measurement_ = MatrixXd::Zero(n_y, n_y);
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
  VectorXd state = state_at(warmup - 1);
  for (Index t = warmup - 1; t < normalised.length(); ++t) {
    filter_model_->Measurement(*prepared, state, normalised.inputs.col(t), &h, &H, scratch_.get());
    const VectorXd output_residual = normalised.outputs.col(t) - h;
    measurement_ += output_residual * output_residual.transpose();
    ++measurement_count_;
    if (t + 1 == normalised.length()) break;
    filter_model_->Transition(*prepared, state, normalised.inputs.col(next_input ? t + 1 : t), &f, &F, scratch_.get());
    state = state_at(t + 1);
    process_ += (state - f) * (state - f).transpose();
    ++process_count_;
  }
}

nssm::FilterNoise NoiseEstimate::Result(const data::Normaliser& normaliser) const {
  const Index n = process_.rows(), n_y = measurement_.rows();
  const MatrixXd Q = process_ / static_cast<double>(process_count_) + kFloor * MatrixXd::Identity(n, n);
  const MatrixXd R = measurement_ / static_cast<double>(measurement_count_) + kFloor * MatrixXd::Identity(n_y, n_y);
  const auto physical = [](const MatrixXd& cov, const VectorXd& scale) {
    return MatrixXd(scale.asDiagonal() * cov * scale.asDiagonal());
  };
  const MatrixXd R_physical = physical(R, normaliser.outputs.scale);
  if (fitted_count_ > 0) return {Q, R_physical, fitted_ / static_cast<double>(fitted_count_)};
  if (bundle_.model.spec().is_case_one()) return {Q, R_physical, Q};
  const VectorXd& scale = normaliser.states.scale;
  return {physical(Q, scale), R_physical, MatrixXd(scale.cwiseAbs2().asDiagonal())};
}

}  // namespace metaekf::filter
