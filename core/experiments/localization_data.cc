#include "core/experiments/localization_data.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <numbers>
#include <string>

#include "core/base/status.h"
#include "core/filter/filter_model.h"

namespace metaekf::experiments {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::VectorXd;

constexpr double kNearM = 0.5;

std::map<std::string, std::string> Settings() {
  return {{"noise_std", "0.001"}, {"position_std", "0.005"}, {"heading_std", "0.01"}};
}

sim::Request RequestOf(int64_t count, uint64_t seed) {
  return {.system = "magnetic-localization", .systems = count, .seed = seed, .steps = kLocalizationSamples, .settings = Settings()};
}

double Parameter(const sim::Fleet& fleet, Index system, const std::string& name) {
  const auto& names = fleet.parameters.names;
  return fleet.parameters.values(system, std::find(names.begin(), names.end(), name) - names.begin());
}

Vector2d MiddleOfCell(Index row, Index column, int cells) {
  const double width = 2 * kFieldHalfWidthM / cells;
  return {-kFieldHalfWidthM + width * (static_cast<double>(column) + 0.5), -kFieldHalfWidthM + width * (static_cast<double>(row) + 0.5)};
}

/// Heading of the path at the angle of a place, as in the first round: from π/2 on.
double HeadingAt(const Vector2d& place) {
  const Vector2d east = sim::ReferencePath(0), north = sim::ReferencePath(std::numbers::pi / 2);
  double parameter = std::atan2(place[1] / north[1], place[0] / east[0]);
  if (parameter < 0) parameter += 2 * std::numbers::pi;
  const double heading = std::atan2(north[1] * std::cos(parameter), -east[0] * std::sin(parameter));
  // atan2 has left out a turn somewhere between π/2 and 5π/2.
  return heading < std::numbers::pi / 2 - 1e-12 ? heading + 2 * std::numbers::pi : heading;
}

/// Distance to the path, by points that are closer than a centimetre.
double DistanceToPath(const Vector2d& place) {
  static const std::vector<Vector2d> points = [] {
    constexpr int kPoints = 4000;
    std::vector<Vector2d> all;
    for (int i = 0; i < kPoints; ++i) all.push_back(sim::ReferencePath(2 * std::numbers::pi * i / kPoints));
    return all;
  }();
  double nearest = std::numeric_limits<double>::infinity();
  for (const Vector2d& point : points) nearest = std::min(nearest, (place - point).squaredNorm());
  return std::sqrt(nearest);
}

template <typename FieldAt>
FieldGrid OnGrid(int cells, const FieldAt& field_at) {
  FieldGrid grid{MatrixXd(cells, cells), MatrixXd(cells, cells)};
  for (Index row = 0; row < cells; ++row) {
    for (Index column = 0; column < cells; ++column) {
      const Vector2d field = field_at(MiddleOfCell(row, column, cells));
      grid.x(row, column) = field[0];
      grid.y(row, column) = field[1];
    }
  }
  return grid;
}

}  // namespace

nlohmann::json LocalizationData() {
  return {{"system", "magnetic-localization"}, {"settings", Settings()}, {"samples", kLocalizationSamples}, {"context_samples", kLocalizationContext}};
}

absl::StatusOr<sim::Fleet> Vehicles(int64_t count, uint64_t seed, base::Executor* executor) {
  return sim::Simulate(RequestOf(count, seed), *executor);
}

absl::StatusOr<sim::Fleet> VehicleInThePapersField(uint64_t seed, base::Executor* executor) {
  sim::Request request = RequestOf(1, seed);
  request.settings["nominal"] = "1";
  return sim::Simulate(request, *executor);
}

Vehicle VehicleOf(const sim::Fleet& fleet, Index system) {
  const auto at = [&](const char* name) { return Parameter(fleet, system, name); };
  return {{.l_f_m = at("l_f"), .l_r_m = at("l_r")}, {.magnetization = {at("m_X"), at("m_Y")}, .radius_m = at("r_0")}};
}

sim::SingleTrack AverageGeometry() {
  sim::SingleTrack geometry;
  for (const sim::Parameter& parameter : sim::MagneticLocalization().parameters) {
    if (parameter.name == "l_f") geometry.l_f_m = (parameter.min + parameter.max) / 2;
    if (parameter.name == "l_r") geometry.l_r_m = (parameter.min + parameter.max) / 2;
  }
  return geometry;
}

MatrixXd StateErrors(const MatrixXd& estimates, const MatrixXd& states) {
  MatrixXd errors = estimates - states;
  for (Index t = 0; t < errors.cols(); ++t) errors(2, t) = sim::AngleBetween(estimates(2, t), states(2, t));
  return errors;
}

double SummedError(const MatrixXd& errors) {
  const double sum = errors.colwise().norm().sum();
  return std::isfinite(sum) ? sum : std::numeric_limits<double>::infinity();
}

MatrixXd DeadReckoning(const sim::SingleTrack& geometry, const data::Trajectory& recording, int64_t from) {
  MatrixXd states(3, recording.length() - from);
  Vector3d state = recording.states.col(from - 1);
  for (Index t = from; t < recording.length(); ++t) {
    state = geometry.Move(state, recording.inputs.col(t - 1), recording.sample_period_s);
    states.col(t - from) = state;
  }
  return states;
}

FieldGrid FieldOf(const nssm::Bundle& model, int cells) {
  const auto functions = filter::FilterModel::Create(model);
  const auto parameters = functions->Prepare(model.parameters);
  const auto scratch = functions->MakeScratch();
  const data::Normaliser& units = model.normaliser;
  const VectorXd input = VectorXd::Zero(units.inputs.mean.size());
  VectorXd field(2);
  MatrixXd H(2, 3);
  return OnGrid(cells, [&](const Vector2d& place) -> Vector2d {
    const Vector3d state(place[0], place[1], HeadingAt(place));
    functions->Measurement(*parameters, units.states.Normalise(state), input, &field, &H, scratch.get());
    return units.outputs.Denormalise(field);
  });
}

FieldGrid FieldOf(const sim::MagnetizedSphere& sphere, int cells) {
  return OnGrid(cells, [&sphere](const Vector2d& place) { return sphere.FieldAt(place); });
}

FieldErrors CompareFields(const FieldGrid& field, const sim::MagnetizedSphere& truth) {
  const int cells = static_cast<int>(field.x.rows());
  const double cell = 2 * kFieldHalfWidthM / cells;
  struct Mean {
    double sum = 0;
    int count = 0;
    void Add(double square) { sum += square, count += 2; }
    double Root() const { return count > 0 ? std::sqrt(sum / count) : std::numeric_limits<double>::quiet_NaN(); }
  } everywhere, outside, near_the_path;
  for (Index row = 0; row < cells; ++row) {
    for (Index column = 0; column < cells; ++column) {
      const Vector2d place = MiddleOfCell(row, column, cells);
      const double square = (Vector2d(field.x(row, column), field.y(row, column)) - truth.FieldAt(place)).squaredNorm();
      everywhere.Add(square);
      if (place.norm() > truth.radius_m + cell) outside.Add(square);
      if (DistanceToPath(place) <= kNearM) near_the_path.Add(square);
    }
  }
  return {everywhere.Root(), outside.Root(), near_the_path.Root()};
}

}  // namespace metaekf::experiments
