#pragma once

#include <string>
#include <vector>

#include "core/nssm/bundle.h"
#include "metaekf/v1/training.pb.h"

/// Models and fleets that are small enough for a test to train.
namespace metaekf::server {

/// Case I: one input, one output, two latents, a window of 3, sampled every 0.1 s. Adapts with 5
/// steps unless told otherwise.
nssm::Bundle TinyBundle(uint64_t seed = 1);
/// Case II: one input, one output.
nssm::Bundle TinyStateBundle(int32_t states = 2);
/// The same with layers so wide that sessions are stepped together.
nssm::Bundle LargeStateBundle();

/// A specification for TinyFleet with the architecture of TinyBundle.
v1::TrainingSpec TinySpec(uint32_t iterations);

/// y_{t+1} = a y_t + 0.3 u_t with another a per system, five systems of 60 samples.
std::vector<v1::Samples> TinyFleet();
/// `samples` samples of a sixth system.
v1::Samples TinyContext(uint32_t samples);

/// The requests that submit a job with TinyFleet.
std::vector<v1::CreateTrainingJobRequest> TinyJob(const std::string& model, uint32_t iterations);

}  // namespace metaekf::server
