#include "core/filter/joint_model.h"

#include <cmath>
#include <utility>

#include "absl/container/inlined_vector.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

JointModel::JointModel(std::shared_ptr<const FilterModel> model, std::shared_ptr<const FilterModel::Parameters> parameters,
                       nssm::GaussMarkov process_bias, nssm::GaussMarkov measurement_bias)
    : model_(std::move(model)),
      parameters_(std::move(parameters)),
      process_bias_(std::move(process_bias)),
      measurement_bias_(std::move(measurement_bias)),
      state_size_(model_->state_size()),
      bias_begin_(state_size_ + parameters_->directions()) {}

VectorXd JointModel::ExtraDeviations(double parameter_std) const {
  VectorXd deviations = VectorXd::Ones(extra_size());
  deviations.head(bias_begin_ - state_size_).setConstant(parameter_std);
  return deviations;
}

VectorXd JointModel::ExtraNoise() const {
  VectorXd deviations = VectorXd::Zero(extra_size());
  const auto of = [](double correlation) { return std::sqrt(1 - correlation * correlation); };
  const Index c_h = measurement_bias_.loadings.cols();
  deviations.tail(c_h).setConstant(of(measurement_bias_.correlation));
  deviations.segment(bias_begin_ - state_size_, process_bias_.loadings.cols()).setConstant(of(process_bias_.correlation));
  return deviations;
}

void JointModel::Evaluate(Together function, std::span<const Point> points, FilterModel::Scratch* scratch) {
  if (points.empty()) return;
  absl::InlinedVector<FilterModel::Point, 8> of_models;
  for (const Point& p : points) {
    of_models.push_back({p.joint->parameters_.get(), {p.s->data(), p.joint->bias_begin_}, {p.u->data(), p.u->size()}, p.value, p.jacobian});
  }
  (points.front().joint->model_.get()->*function)(of_models, scratch);
}

void JointModel::Transition(std::span<const Point> points, FilterModel::Scratch* scratch) {
  Evaluate(&FilterModel::Transition, points, scratch);
  for (const Point& p : points) p.joint->CompleteTransition(*p.s, p.value, p.jacobian);
}

void JointModel::Measurement(std::span<const Point> points, FilterModel::Scratch* scratch) {
  Evaluate(&FilterModel::Measurement, points, scratch);
  for (const Point& p : points) p.joint->CompleteMeasurement(*p.s, p.value, p.jacobian);
}

void JointModel::Transition(const Ref<const VectorXd>& s, const Ref<const VectorXd>& u, VectorXd* f, MatrixXd* F,
                            FilterModel::Scratch* scratch) const {
  model_->Transition(*parameters_, s.head(bias_begin_), u, f, F, scratch);
  CompleteTransition(s, f, F);
}

void JointModel::CompleteTransition(const Ref<const VectorXd>& s, VectorXd* f, MatrixXd* F) const {
  if (extra_size() == 0) return;
  Keep(s, f, F);
  const Index n = state_size_, c_f = process_bias_.loadings.cols(), c_h = measurement_bias_.loadings.cols(), all = size();
  if (c_f > 0) {
    f->head(n).noalias() += process_bias_.loadings.lazyProduct(s.segment(bias_begin_, c_f));
    F->block(0, bias_begin_, n, c_f) = process_bias_.loadings;
    f->segment(bias_begin_, c_f) *= process_bias_.correlation;
    F->diagonal().segment(bias_begin_, c_f).setConstant(process_bias_.correlation);
  }
  F->block(0, all - c_h, n, c_h).setZero();
  f->tail(c_h) *= measurement_bias_.correlation;
  F->diagonal().tail(c_h).setConstant(measurement_bias_.correlation);
}

void JointModel::Measurement(const Ref<const VectorXd>& s, const Ref<const VectorXd>& u, VectorXd* h, MatrixXd* H,
                             FilterModel::Scratch* scratch) const {
  model_->Measurement(*parameters_, s.head(bias_begin_), u, h, H, scratch);
  CompleteMeasurement(s, h, H);
}

void JointModel::CompleteMeasurement(const Ref<const VectorXd>& s, VectorXd* h, MatrixXd* H) const {
  if (extra_size() == 0) return;
  const Index c_h = measurement_bias_.loadings.cols();
  H->middleCols(bias_begin_, process_bias_.loadings.cols()).setZero();
  if (c_h == 0) return;
  h->noalias() += measurement_bias_.loadings.lazyProduct(s.tail(c_h));
  H->rightCols(c_h) = measurement_bias_.loadings;
}

void JointModel::Reconstruct(const Ref<const VectorXd>& s, const Ref<const VectorXd>& u, VectorXd* reconstruction, MatrixXd* J,
                             FilterModel::Scratch* scratch) const {
  model_->Reconstruct(*parameters_, s.head(bias_begin_), u, reconstruction, J, scratch);
  Keep(s, reconstruction, J);
  J->topRightCorner(state_size_, size() - bias_begin_).setZero();
}

void JointModel::Encode(const Ref<const VectorXd>& window, VectorXd* latent, FilterModel::Scratch* scratch) const {
  model_->Encode(*parameters_, window, latent, scratch);
}

void JointModel::Keep(const Ref<const VectorXd>& s, VectorXd* value, MatrixXd* jacobian) const {
  const Index extra = extra_size();
  value->tail(extra) = s.tail(extra);
  jacobian->bottomRows(extra).setZero();
  jacobian->bottomRightCorner(extra, extra).setIdentity();
}

}  // namespace metaekf::filter
