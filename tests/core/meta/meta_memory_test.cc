#include <gtest/gtest.h>
#include <malloc.h>

#include "core/meta/meta_gradient.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/sanitized.h"

namespace metaekf::meta {
namespace {

/// Bytes that malloc has handed out.
size_t HeapInUse() {
  const struct mallinfo2 info = mallinfo2();
  return info.uordblks + info.hblkhd;
}

struct Measured {
  size_t scratch;   // what a meta-gradient needs beside the model
  size_t gradient;  // scratch of one loss gradient: one step's activations
  size_t vector;    // one parameter vector
};

Measured Measure(int32_t steps) {
  const nssm::ModelCase c = nssm::ModelCases().front();
  nssm::ModelSpec spec = c.model;
  spec.encoder.hidden_widths = spec.transition.block.hidden_widths = {64, 64};
  spec.latent_size = 32;
  const nssm::Model model = *nssm::Model::Create(spec);
  const nssm::LossShape shape = *nssm::ShapeOfLoss(spec, c.loss, 40);
  const nn::Mask all(model.layout().tensors().size(), true);
  const nssm::LossFunction<double> loss(model, c.loss, shape, all, all);
  const size_t before_gradient = HeapInUse();
  const auto gradient_scratch = loss.MakeScratch();
  const size_t gradient = HeapInUse() - before_gradient;
  const TrainingSpec training{.loss = c.loss, .inner_loop = {.steps = steps}};
  const MetaGradient<double> meta(model, training, shape, shape, all);
  const size_t before = HeapInUse();
  const MetaGradient<double>::Scratch scratch(meta);
  return {HeapInUse() - before, gradient, sizeof(double) * static_cast<size_t>(model.layout().size())};
}

// The whole memory of a meta-gradient is its scratch: Compute allocates nothing.
TEST(MetaMemoryTest, FortyInnerStepsCostFortyParameterVectorsAndNoGraphs) {
  if (METAEKF_SANITIZED) GTEST_SKIP() << "the sanitizers' malloc does not tell what is in use";
  const Measured one = Measure(1), forty = Measure(40);
  EXPECT_LE(forty.scratch, one.scratch + 40 * (one.vector + one.gradient));
  // The bound with activations is generous; without any the 39 further iterates alone remain.
  EXPECT_LE(forty.scratch, one.scratch + 39 * one.vector + 4096);
}

}  // namespace
}  // namespace metaekf::meta
