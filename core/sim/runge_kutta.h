#pragma once

namespace metaekf::sim {

/// One step of the classical Runge–Kutta method of order 4 for ẋ = field(time, x).
template <typename State, typename Field>
State RungeKuttaStep(const Field& field, double time, const State& x, double step) {
  const State k1 = field(time, x);
  const State k2 = field(time + step / 2, State(x + step / 2 * k1));
  const State k3 = field(time + step / 2, State(x + step / 2 * k2));
  const State k4 = field(time + step, State(x + step * k3));
  return x + step / 6 * (k1 + 2 * (k2 + k3) + k4);
}

/// Goes over [time, time + step] in Runge–Kutta steps as short as they must be: a step is taken as
/// two halves, and each half again as two, until whole and halves differ by no more than
/// `tolerance`.
///
/// That finds the kinks of a field that is only continuous, where a step of any fixed length falls
/// back to order 2. What passes is extrapolated to order 5, so that its error is well below the
/// tolerance.
///
/// @param full          the whole step, RungeKuttaStep(field, time, x, step).
/// @param distance      (State, State) → double, in the unit of `tolerance`.
/// @param max_halvings  where to stop splitting, tolerance or not.
template <typename State, typename Field, typename Distance>
State RefineStep(const Field& field, double time, const State& x, double step, const State& full,
                 const Distance& distance, double tolerance, int max_halvings) {
  const double half = step / 2;
  const State middle = RungeKuttaStep(field, time, x, half);
  const State end = RungeKuttaStep(field, time + half, middle, half);
  if (max_halvings == 0 || distance(end, full) <= tolerance) return end + (end - full) / 15;
  const State refined_middle =
      RefineStep(field, time, x, half, middle, distance, tolerance, max_halvings - 1);
  const State second_half = RungeKuttaStep(field, time + half, refined_middle, half);
  return RefineStep(field, time + half, refined_middle, half, second_half, distance, tolerance,
                    max_halvings - 1);
}

}  // namespace metaekf::sim
