#pragma once

#include <vector>

#include "core/data/trajectory.h"
#include "core/filter/ekf.h"

namespace metaekf::filter {

/// Estimates of recorded samples from the whole recording: the fixed-interval smoother of Rauch, Tung and Striebel behind a filter
/// that has gone through it.
///
///   C_t = P⁺_t F_tᵀ (P⁻_{t+1})⁻¹
///   xˢ_t = x⁺_t + C_t (xˢ_{t+1} − x⁻_{t+1})
///   Pˢ_t = (I − C_t F_t) P⁺_t (I − C_t F_t)ᵀ + C_t (Pˢ_{t+1} + Q) C_tᵀ
///
/// The form of Pˢ is that of P⁺_t + C_t (Pˢ_{t+1} − P⁻_{t+1}) C_tᵀ as a sum of squares, kept as a factor. Where a filter was widened
/// by λ, Q is what P⁻ has beyond F P⁺ Fᵀ; where it began anew, what comes later says nothing about before. Means that leave the
/// states' set are put inside (Constrain).
///
/// @param filter      that has applied no sample yet; passed by value.
/// @param trajectory  physical units; NaN in outputs: not measured.
/// @return one estimate per sample: mean and covariance smoothed, slack and projection of the smoothed mean, all else as the
///   filter said.
/// Memory: 2 n² + 3 n doubles a sample. Errors: as Ekf::Step, with the sample.
/// Source: H. E. Rauch, F. Tung, C. T. Striebel, AIAA J. 3 (1965) 1445; the sum of squares is ours.
absl::StatusOr<std::vector<Estimate>> Smooth(Ekf filter, const data::Trajectory& trajectory, FilterModel::Scratch* scratch);

/// What Smooth takes for each sample, its result included.
int64_t SmoothingBytesPerSample(const Ekf& filter);

}  // namespace metaekf::filter
