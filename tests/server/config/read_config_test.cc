#include "server/config/read_config.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "server/store/files.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

std::string Error(const std::string& text) {
  ServerOptions options;
  const absl::Status status = ApplyConfig(text, &options);
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << text;
  return std::string(status.message());
}

/// All options as text, to compare them.
std::string Describe(const ServerOptions& o) {
  std::ostringstream out;
  out << o.listen << " " << o.model_cache_bytes << " " << o.io_threads << " " << o.compute_threads
      << " " << o.drain_timeout << " " << o.training.concurrent_jobs << " "
      << o.training.threads_per_job << " " << o.training.max_queued_jobs << " "
      << o.training.checkpoint_period << " " << o.limits.memory_bytes << " "
      << o.limits.message_bytes << " " << o.limits.batch_bytes << " " << o.limits.sample_bytes << " " << o.sessions.checkpoint_period << " " << o.limits.metadata_bytes << " "
      << o.limits.streams_per_connection << " " << o.limits.model_file_bytes << " "
      << o.limits.dataset_bytes << " " << o.limits.samples_per_call << " " << o.limits.queued_calls
      << " " << o.security.require_tokens << " " << o.security.max_connection_age;
  return out.str();
}

/// Whether a line is a setting that is commented out, "# name: value" or "# name { … }"; takes the mark away.
bool PutInForce(absl::string_view* line) {
  absl::string_view setting = absl::StripLeadingAsciiWhitespace(*line);
  if (!absl::ConsumePrefix(&setting, "# ")) return false;
  const size_t end = std::min({setting.find(": "), setting.find(" { "), setting.size()});
  const bool is_name = end > 0 && end < setting.size() && std::all_of(setting.begin(), setting.begin() + end, [](char c) {
                         return absl::ascii_islower(c) || c == '_';
                       });
  if (is_name) *line = setting;
  return is_name;
}

TEST(ReadConfigTest, TheShippedFileShowsEveryDefault) {
  const std::string shipped =
      store::ReadFile(METAEKF_SOURCE_DIR "/deploy/metaekfd.textproto").value();
  ServerOptions as_shipped;
  ASSERT_TRUE(ApplyConfig(shipped, &as_shipped).ok());
  EXPECT_EQ(Describe(as_shipped), Describe(ServerOptions()));

  // Every setting that is commented out, put in force: nothing changes, but for the directory.
  int settings = 0;
  std::string in_force;
  for (absl::string_view line : absl::StrSplit(shipped, '\n')) {
    if (PutInForce(&line)) ++settings;
    absl::StrAppend(&in_force, line, "\n");
  }
  ServerOptions options;
  options.listen = "nowhere";
  options.model_cache_bytes = options.limits.message_bytes = options.limits.batch_bytes = options.limits.sample_bytes = options.limits.dataset_bytes = 1;
  options.io_threads = options.training.max_queued_jobs = 77;
  options.security.require_tokens = true;
  options.drain_timeout = options.security.max_connection_age = options.training.checkpoint_period = options.sessions.checkpoint_period = absl::Hours(1);
  const absl::Status applied = ApplyConfig(in_force, &options);
  ASSERT_TRUE(applied.ok()) << applied;
  // What has no default is shown by example.
  EXPECT_EQ(options.data_directory, "/var/lib/metaekf");
  EXPECT_EQ(options.metrics_listen, "127.0.0.1:9464");
  EXPECT_EQ(options.security.certificate_file, "/etc/metaekf/server.pem");
  EXPECT_EQ(options.security.key_file, "/etc/metaekf/server.key");
  EXPECT_EQ(options.security.client_ca_file, "/etc/metaekf/clients.pem");
  ASSERT_EQ(options.security.clients.size(), 1u);
  EXPECT_EQ(options.security.clients[0].certificate_name, "press-7.plant.example");
  EXPECT_EQ(options.security.clients[0].tenant, "plant");
  EXPECT_EQ(options.security.clients[0].scope, store::Scope::kStream);
  const store::Quota& quota = options.quotas.Of("plant");
  EXPECT_EQ(quota.sessions, 1000);
  EXPECT_EQ(quota.adaptations, 1000);
  EXPECT_EQ(quota.stored_bytes, 10'000'000'000);
  EXPECT_EQ(quota.queued_jobs, 10);
  EXPECT_EQ(quota.running_jobs, 1);
  EXPECT_EQ(quota.samples_per_s, 50'000);
  EXPECT_EQ(options.quotas.Of("works").sessions, store::Quota::kNoLimit);
  EXPECT_EQ(options.security.proxies, std::vector<std::string>{"10.0.0.5"});
  EXPECT_EQ(Describe(options), Describe(ServerOptions()));
  EXPECT_EQ(settings, 30) << "one for every field of the message";
}

TEST(ReadConfigTest, WhatIsLeftOutStays) {
  ServerOptions options;
  options.listen = "localhost:1";
  ASSERT_TRUE(ApplyConfig("training { checkpoint_period_s: 2.5 }", &options).ok());
  EXPECT_EQ(options.listen, "localhost:1");
  EXPECT_EQ(options.training.checkpoint_period, absl::Seconds(2.5));
  EXPECT_EQ(options.sessions.checkpoint_period, absl::Milliseconds(100));
  ASSERT_TRUE(ApplyConfig("sessions { checkpoint_period_s: 0 }", &options).ok());
  EXPECT_EQ(options.sessions.checkpoint_period, absl::ZeroDuration());
}

TEST(ReadConfigTest, ErrorsNameThePlace) {
  EXPECT_THAT(Error("listen: \"a\"\nspeed: 3"), HasSubstr("2:"));
  EXPECT_THAT(Error("listen: \"a\"\nspeed: 3"), HasSubstr("speed"));
  EXPECT_THAT(Error("io_threads: 0"), HasSubstr("io_threads is 0, must be at least 1"));
  EXPECT_THAT(Error("drain_timeout_s: -1"), HasSubstr("drain_timeout_s is -1"));
  EXPECT_THAT(Error("drain_timeout_s: nan"), HasSubstr("drain_timeout_s"));
  EXPECT_THAT(Error("drain_timeout_s: 0"), HasSubstr("drain_timeout_s is 0, must be positive"));
  EXPECT_THAT(Error("sessions { checkpoint_period_s: -1 }"), HasSubstr("checkpoint_period_s is -1, must be positive, or 0 for never,"));
  EXPECT_THAT(Error("security { clients { tenant: 'a' scope: READ } }"),
              HasSubstr("security.clients[0]: certificate_name is missing"));
  EXPECT_THAT(Error("security { clients { certificate_name: 'a' tenant: 'A' scope: READ } }"), HasSubstr("tenant 'A'"));
  EXPECT_THAT(Error("security { clients { certificate_name: 'a' tenant: 'a' } }"), HasSubstr("scope: must be"));
  EXPECT_THAT(Error("quotas { sessions: 1 } quotas { tenant: '!' }"), HasSubstr("quotas[1]: tenant '!'"));
  EXPECT_THAT(Error("quotas { samples_per_s: nan }"), HasSubstr("quotas[0].samples_per_s is nan"));
  EXPECT_THAT(Error("limits { dataset_bytes: 18446744073709551615 }"),
              HasSubstr("limits.dataset_bytes"));
}

TEST(ReadConfigTest, AMissingFileIsNamed) {
  ServerOptions options;
  const absl::Status status = ReadConfigFile("/nowhere/metaekfd.textproto", &options);
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(status.message()), HasSubstr("/nowhere/metaekfd.textproto"));
}

}  // namespace
}  // namespace metaekf::server
