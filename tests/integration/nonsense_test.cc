// Sensors and models that make no sense: a clear answer each time, and a server that goes on.

#include <cmath>
#include <limits>

#include "core/base/rng.h"
#include "metaekf/client.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

const double kNaN = std::nan("");
const double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kDenormal = 4.9e-324;

class NonsenseTest : public ServerTest {
 protected:
  client::Client Connect() { return client::Client({.server = server_->address()}); }
  std::unique_ptr<client::EstimationSession> Open(client::Client& client, const std::string& model,
                                                  double reconnect_for_s = 60) {
    client::EstimationOptions options;
    options.target.model = model;
    options.reconnect_for_s = reconnect_for_s;
    auto session = client.OpenEstimation(options);
    EXPECT_TRUE(session.ok()) << session.status().message;
    return std::move(*session);
  }
  static client::SampleBatch Sample(double input, double output) {
    return {.samples = 1, .inputs = {input}, .outputs = {output}};
  }
  static client::EstimateBatch Answer(client::EstimationSession& session, const client::SampleBatch& sample) {
    EXPECT_TRUE(session.Send(sample).ok());
    auto batch = session.Receive();
    EXPECT_TRUE(batch.ok()) << batch.status().message;
    return batch.ok() && *batch ? **batch : client::EstimateBatch();
  }
  void ExpectAlive() {
    EXPECT_EQ(client_->Health(), "SERVING");
    client::Client client = Connect();
    const auto session = Open(client, "good");
    EXPECT_EQ(Answer(*session, Sample(0.1, 0.1)).samples, 1u);
  }
};

TEST_F(NonsenseTest, WhatIsNoNumberIsRefusedBeforeItIsSentAndTheStreamGoesOn) {
  Import("good", TinyStateBundle());
  client::Client client = Connect();
  const auto session = Open(client, "good"), reference = Open(client, "good");
  for (int t = 0; t < 10; ++t) {
    for (const auto& [sample, field] : std::vector<std::pair<client::SampleBatch, std::string>>{
             {Sample(kNaN, 0), "inputs[0] is nan"},
             {Sample(-kInfinity, 0), "inputs[0] is -inf"},
             {Sample(0, kInfinity), "outputs[0] is inf"}}) {
      const client::Status status = session->Send(sample).status();
      EXPECT_EQ(status.code, client::Code::kInvalidArgument);
      EXPECT_THAT(status.message, HasSubstr(field));
    }
    const double u = std::sin(t), y = t % 3 == 0 ? kNaN : 0.1 * t;  // NaN in outputs: not measured
    const client::EstimateBatch a = Answer(*session, Sample(u, y)), b = Answer(*reference, Sample(u, y));
    EXPECT_EQ(a.means, b.means);
    EXPECT_EQ(a.covariances, b.covariances);
  }
}

// Finite, and no sensor's.
TEST_F(NonsenseTest, ValuesThatNoSensorHasLeaveTheSessionAsItWas) {
  Import("good", TinyStateBundle());
  Import("window", TinyBundle());
  for (const char* model : {"good", "window"}) {
    client::Client client = Connect();
    const auto session = Open(client, model), reference = Open(client, model);
    for (int t = 0; t < 60; ++t) {
      for (const double wild : {1e300, -1e300, 1e20, -std::numeric_limits<double>::max()}) {
        if (t % 10 != 5) continue;
        const bool input = t % 20 == 5;
        ASSERT_TRUE(session->Send(input ? Sample(wild, 0) : Sample(0, wild)).ok());
        const client::Status status = session->Receive().status();
        EXPECT_EQ(status.code, client::Code::kInvalidArgument);
        EXPECT_THAT(status.message, HasSubstr(input ? "samples.inputs[0]" : "samples.outputs[0]"));
        const client::Status resumed = session->Resume();
        ASSERT_TRUE(resumed.ok()) << resumed.message;
        // What the server had not yet made durable comes again first.
        while (session->durable_seq() < static_cast<uint64_t>(t) && !HasFailure()) {
          const auto again = session->Receive();
          ASSERT_TRUE(again.ok()) << again.status().message;
          if ((*again)->first_seq == static_cast<uint64_t>(t)) break;
        }
      }
      const double u = t % 4 == 0 ? kDenormal : std::sin(t), y = t % 4 == 1 ? -kDenormal : 0.2 * std::cos(t);
      const client::EstimateBatch a = Answer(*session, Sample(u, y)), b = Answer(*reference, Sample(u, y));
      ASSERT_EQ(a.first_seq, b.first_seq);
      for (size_t i = 0; i < a.means.size(); ++i) {
        EXPECT_TRUE(a.means[i] == b.means[i] || (std::isnan(a.means[i]) && std::isnan(b.means[i]))) << t;
      }
    }
  }
  ExpectAlive();
}

// Unlikely, and possible: as from a wrong unit.
TEST_F(NonsenseTest, ValuesFarOffAreAnsweredAndDoNotStay) {
  Import("good", TinyStateBundle());
  Import("window", TinyBundle());
  base::Rng rng(3);
  const double far[] = {1e8, -1e8, 1e5, -1e5, 1e3, kDenormal, 0.0, -0.0};
  for (const char* model : {"good", "window"}) {
    client::Client client = Connect();
    const auto session = Open(client, model, 0);
    for (int t = 0; t < 400; ++t) {
      const auto pick = [&] { return far[rng.Index(std::size(far))]; };
      const bool nonsense = t >= 50 && t < 300;
      const double u = nonsense && rng.Uniform() < 0.3 ? pick() : 0.3 * rng.Normal();
      const double y = nonsense && rng.Uniform() < 0.3 ? pick() : 0.3 * rng.Normal();
      const client::EstimateBatch batch = Answer(*session, Sample(u, y));
      ASSERT_EQ(batch.samples, 1u) << model << " " << t;
      const bool told = batch.health[0] == client::Health::kDiverged || batch.health[0] == client::Health::kWarmingUp;
      EXPECT_TRUE(told || std::isfinite(batch.means[0])) << model << " " << t;
      EXPECT_TRUE(told || std::isfinite(batch.covariances[0])) << model << " " << t;
      if (t == 399) {
        EXPECT_FALSE(told) << model;
      }
    }
  }
  ExpectAlive();
}

TEST_F(NonsenseTest, TimesBeyondTheLagLeaveTheSessionAsItWas) {
  Import("good", TinyStateBundle());
  client::Client client = Connect();
  const auto session = Open(client, "good"), reference = Open(client, "good");
  const auto at = [](double time_s, double y) {
    client::SampleBatch sample = Sample(0.2, y);
    sample.times_s = {time_s};
    return sample;
  };
  for (int t = 0; t < 5; ++t) {
    Answer(*session, at(0.1 * t, 0.1));
    Answer(*reference, at(0.1 * t, 0.1));
  }
  ASSERT_TRUE(session->Send(at(0.1, 5)).ok());
  const client::Status status = session->Receive().status();
  EXPECT_EQ(status.code, client::Code::kInvalidArgument);
  EXPECT_THAT(status.message, HasSubstr("samples.times_s[0]"));
  const client::Status resumed = session->Resume();
  ASSERT_TRUE(resumed.ok()) << resumed.message;
  ASSERT_TRUE(session->Send(at(0.5, 0.1)).ok());
  client::EstimateBatch a;
  while (a.first_seq < 6) {  // what the server could not know to have arrived comes again first
    const auto batch = session->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
    a = **batch;
  }
  const client::EstimateBatch b = Answer(*reference, at(0.5, 0.1));
  EXPECT_EQ(a.means, b.means);
  EXPECT_EQ(a.covariances, b.covariances);
}

TEST_F(NonsenseTest, AModelWithWildWeightsHurtsNobody) {
  Import("good", TinyStateBundle());
  base::Rng rng(5);
  int answered = 0, diverged = 0;
  for (nssm::Bundle bundle : {TinyBundle(), TinyStateBundle()}) {
    const std::vector<double> weights = bundle.parameters;
    for (const double scale : {1e-300, 1e6, 1e20, 1e38, 1e150, 1e300}) {
      for (const bool some : {false, true}) {
        for (size_t i = 0; i < weights.size(); ++i) {
          bundle.parameters[i] = some && rng.Uniform() < 0.8 ? weights[i] : scale * (weights[i] >= 0 ? 1 : -1);
        }
        const auto imported = client_->Import(ImportRequests("wild", nssm::WriteModelFile(bundle)));
        if (!imported.ok()) {
          EXPECT_EQ(imported.code, absl::StatusCode::kInvalidArgument) << imported;
          continue;
        }
        client::Client client = Connect();
        const auto session = Open(client, "wild", 0);
        if (session == nullptr) continue;
        for (int t = 0; t < 30; ++t) {
          ASSERT_TRUE(session->Send(Sample(std::sin(t), std::cos(t))).ok());
          const auto batch = session->Receive();
          if (!batch.ok()) {
            EXPECT_NE(batch.status().code, client::Code::kInternal) << batch.status().message;
            break;
          }
          ++answered;
          const client::Health health = (*batch)->health[0];
          diverged += health == client::Health::kDiverged;
          const bool finite = std::isfinite((*batch)->means[0]) && std::isfinite((*batch)->covariances[0]);
          EXPECT_TRUE(finite || health == client::Health::kDiverged || health == client::Health::kWarmingUp)
              << scale << " " << t;
        }
        client::Trajectory trajectory{.samples = 30};
        for (int t = 0; t < 30; ++t) {
          trajectory.inputs.push_back(std::sin(t));
          trajectory.outputs.push_back(std::cos(t));
          if (!bundle.model.spec().is_case_one()) trajectory.states.insert(trajectory.states.end(), {0.1, 0.2});
        }
        for (const client::Status& status :
             {client.Predict({.target = {.model = "wild"}, .mode = client::PredictionMode::kSimulate, .trajectories = {trajectory}}).status(),
              client.Adapt({.model = "wild", .context = trajectory}).status()}) {
          EXPECT_NE(status.code, client::Code::kInternal) << status.message;
          EXPECT_NE(status.code, client::Code::kUnavailable) << status.message;
        }
      }
    }
  }
  EXPECT_GT(answered, 0);
  EXPECT_GT(diverged, 0);
  ExpectAlive();
}

}  // namespace
}  // namespace metaekf::server
