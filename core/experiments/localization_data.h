#pragma once

#include <Eigen/Core>
#include <nlohmann/json_fwd.hpp>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/nssm/bundle.h"
#include "core/sim/magnetic_localization.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {

/// The vehicles of the study of localization, and what models of them are judged by. What the paper leaves open was settled here
/// before any training: wheels slip by 5 mm and 0.01 rad a sample, the sensor's noise is 1e-3 A/m.
inline constexpr int64_t kLocalizationSamples = 400;  ///< 40 s
inline constexpr int64_t kLocalizationContext = 80;   ///< a fifth of them

nlohmann::json LocalizationData();

/// Vehicles in fields, all drawn anew for another seed. Errors: those of sim::Simulate.
absl::StatusOr<sim::Fleet> Vehicles(int64_t count, uint64_t seed, base::Executor* executor);

/// One of average geometry whose field the paper shows: magnetization (1, 1) A/m, radius 3 m.
absl::StatusOr<sim::Fleet> VehicleInThePapersField(uint64_t seed, base::Executor* executor);

/// One row of sim::Fleet::parameters.
struct Vehicle {
  sim::SingleTrack geometry;
  sim::MagnetizedSphere sphere;
};
Vehicle VehicleOf(const sim::Fleet& fleet, Eigen::Index system);

/// Average geometry of the family.
sim::SingleTrack AverageGeometry();

/// x̂ − x of states (p_X, p_Y, ψ), headings as angles.
Eigen::MatrixXd StateErrors(const Eigen::MatrixXd& estimates, const Eigen::MatrixXd& states);

/// Σ ‖x̂ − x‖ over samples, in m and rad: the figure of the paper. Infinite if an error is not finite.
double SummedError(const Eigen::MatrixXd& errors);

/// States from sample `from` on as wheels and steering tell them: the last of the context, moved on by the inputs.
Eigen::MatrixXd DeadReckoning(const sim::SingleTrack& geometry, const data::Trajectory& recording, int64_t from);

/// The field of a model on a grid of `cells` × `cells` over |p_X|, |p_Y| ≤ 8 m, for vehicles that are headed as the path is at the
/// angle of the place, with average inputs.
inline constexpr double kFieldHalfWidthM = 8;
struct FieldGrid {
  Eigen::MatrixXd x, y;  ///< components, A/m: (i, j) at the middle of cell j along X, i along Y
};
FieldGrid FieldOf(const nssm::Bundle& model, int cells);
FieldGrid FieldOf(const sim::MagnetizedSphere& sphere, int cells);

/// Root mean square error of the components of the field, A/m.
struct FieldErrors {
  double everywhere = 0;      ///< the jump at r₀ and the inside, where no vehicle has been, too
  double outside = 0;         ///< further than a cell from the sphere
  double near_the_path = 0;   ///< within 0.5 m of it, where vehicles are
};
FieldErrors CompareFields(const FieldGrid& field, const sim::MagnetizedSphere& truth);

}  // namespace metaekf::experiments
