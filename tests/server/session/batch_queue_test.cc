#include "server/session/batch_queue.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <future>
#include <limits>
#include <thread>
#include <vector>

#include "core/base/rng.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

std::shared_ptr<const ServedModel> Serve(nssm::Bundle bundle, const ServedModel* base) {
  auto model = std::make_shared<ServedModel>(ServedModel{.bundle = std::move(bundle)});
  model->filter_model = base == nullptr ? std::shared_ptr<const filter::FilterModel>(filter::FilterModel::Create(model->bundle)) : base->filter_model;
  model->filter_parameters = model->filter_model->Prepare(model->bundle, base == nullptr ? nullptr : base->filter_parameters.get());
  return model;
}

/// Sessions of a large model and of an adaptation of it, each behind a stream and once more, alone.
class BatchQueueTest : public testing::Test {
 protected:
  struct Client {
    std::shared_ptr<LiveSession> live = std::make_shared<LiveSession>();
    std::unique_ptr<Session> alone;
    base::Rng rng{1};
    v1::SampleBatch batch;
    v1::EstimateBatch answer;
    absl::Status status;
  };

  BatchQueueTest() : base_(Serve(LargeStateBundle(), nullptr)), queue_(std::make_shared<BatchQueue>(base_->filter_model)) {
    nssm::Bundle adapted = LargeStateBundle();
    for (size_t i = adapted.parameters.size() * 3 / 4; i < adapted.parameters.size(); ++i) adapted.parameters[i] *= 1.01;
    nssm::RoundToPrecision(adapted.model.spec().precision, &adapted.parameters);
    adapted_ = Serve(std::move(adapted), base_.get());
  }

  std::unique_ptr<Client> MakeClient(uint64_t seed) const {
    auto client = std::make_unique<Client>();
    v1::OpenSession open;
    open.set_covariance_format(v1::OpenSession::LOWER_TRIANGLE);
    open.set_max_lag_s(seed % 2 == 0 ? 0.3 : 0);
    client->live->session = Session::Open(seed % 3 == 0 ? adapted_ : base_, open).value();
    client->live->queue = queue_;
    client->alone = Session::Open(seed % 3 == 0 ? adapted_ : base_, open).value();
    client->rng = base::Rng(seed);
    return client;
  }

  /// The next `samples` samples, with times that leave out periods.
  static void MakeBatch(int samples, Client* client) {
    client->batch.Clear();
    client->batch.set_first_seq(client->alone->applied_seq() + 1);
    for (int i = 0; i < samples; ++i) {
      client->batch.add_inputs(client->rng.Normal());
      client->batch.add_outputs(client->rng.Normal());
    }
    client->answer.Clear();
  }

  bool Add(Client* client) {
    return queue_->Add({client->live, &client->batch, false, &client->answer, [client](const absl::Status& status, auto) { client->status = status; }});
  }

  void WorkThrough() {
    while (queue_->Work()) continue;
  }

  static void ExpectAsAlone(Client* client) {
    v1::EstimateBatch alone;
    const auto scratch = client->alone->model().filter_model->MakeScratch();
    EXPECT_EQ(client->status, client->alone->Apply(client->batch, false, scratch.get(), &alone));
    EXPECT_EQ(client->answer.SerializeAsString(), alone.SerializeAsString());
    EXPECT_EQ(client->live->session->Checkpoint(), client->alone->Checkpoint());
  }

  std::shared_ptr<const ServedModel> base_, adapted_;
  std::shared_ptr<BatchQueue> queue_;
};

TEST_F(BatchQueueTest, BatchesThatWaitAreAppliedAsEachWouldBeAlone) {
  std::vector<std::unique_ptr<Client>> clients;
  for (uint64_t seed = 0; seed < 13; ++seed) clients.push_back(MakeClient(seed));
  base::Rng rng(3);
  for (int round = 0; round < 20; ++round) {
    std::vector<Client*> waiting;
    int workers = 0;
    for (const auto& client : clients) {
      if (rng.Uniform() < 0.3) continue;
      MakeBatch(1 + static_cast<int>(rng.Index(5)), client.get());
      if (rng.Uniform() < 0.3) client->batch.set_outputs(0, std::numeric_limits<double>::quiet_NaN());
      workers += Add(client.get()) ? 1 : 0;
      waiting.push_back(client.get());
    }
    EXPECT_EQ(workers, std::min<int>(2, static_cast<int>(waiting.size())));
    for (; workers > 0; --workers) WorkThrough();
    for (Client* client : waiting) ExpectAsAlone(client);
  }
}

TEST_F(BatchQueueTest, ABatchIsDoneWhenItsOwnSamplesAre) {
  std::vector<int> order;
  std::vector<std::unique_ptr<Client>> clients;
  for (const int samples : {5, 1, 3, 2}) {
    clients.push_back(MakeClient(static_cast<uint64_t>(samples)));
    MakeBatch(samples, clients.back().get());
    queue_->Add({clients.back()->live, &clients.back()->batch, false, &clients.back()->answer, [&order, samples](const absl::Status&, auto) { order.push_back(samples); }});
  }
  WorkThrough();
  EXPECT_EQ(order, (std::vector<int>{1, 2, 3, 5}));
}

TEST_F(BatchQueueTest, ABatchThatIsRefusedDisturbsNoOther) {
  std::vector<std::unique_ptr<Client>> clients;
  for (uint64_t seed = 0; seed < 4; ++seed) {
    clients.push_back(MakeClient(seed));
    MakeBatch(3, clients.back().get());
  }
  clients[0]->batch.set_inputs(1, std::numeric_limits<double>::infinity());
  clients[1]->live->taken_over = true;
  for (const auto& client : clients) Add(client.get());
  WorkThrough();
  EXPECT_EQ(clients[0]->status.code(), absl::StatusCode::kInvalidArgument) << clients[0]->status;
  EXPECT_EQ(clients[0]->live->session->applied_seq(), 0u);
  EXPECT_EQ(clients[1]->status.code(), absl::StatusCode::kAborted) << clients[1]->status;
  ExpectAsAlone(clients[2].get());
  ExpectAsAlone(clients[3].get());
}

// As streams use it: alone where no one is in the way, else through the queue.
TEST_F(BatchQueueTest, NoBatchIsLostBetweenThreads) {
  constexpr int kClients = 6, kBatches = 60;
  std::vector<std::thread> threads, workers;
  std::mutex mutex;
  std::atomic<int> alone = 0;
  for (uint64_t seed = 0; seed < kClients; ++seed) {
    threads.emplace_back([&, seed] {
      const std::unique_ptr<Client> client = MakeClient(seed);
      const auto work = [&] {
        std::lock_guard lock(mutex);
        workers.emplace_back([this] { WorkThrough(); });
      };
      for (int i = 0; i < kBatches; ++i) {
        MakeBatch(1 + i % 3, client.get());
        if (queue_->Enter()) {
          const auto scratch = queue_->Take();
          client->status = client->live->session->Apply(client->batch, false, scratch.get(), &client->answer);
          ++alone;
          if (queue_->Leave()) work();
        } else {
          const auto done = std::make_shared<std::promise<absl::Status>>();
          if (queue_->Add({client->live, &client->batch, false, &client->answer, [done](const absl::Status& status, auto) { done->set_value(status); }})) work();
          client->status = done->get_future().get();
        }
        v1::EstimateBatch expected;
        const auto scratch = client->alone->model().filter_model->MakeScratch();
        EXPECT_EQ(client->status, client->alone->Apply(client->batch, false, scratch.get(), &expected));
        EXPECT_EQ(client->answer.SerializeAsString(), expected.SerializeAsString());
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  for (std::thread& worker : workers) worker.join();
  EXPECT_GT(alone, 0);
  // All workers have left.
  EXPECT_TRUE(queue_->Enter());
  EXPECT_TRUE(queue_->Enter());
  EXPECT_FALSE(queue_->Enter());
}

}  // namespace
}  // namespace metaekf::server
