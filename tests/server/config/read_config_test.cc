#include "server/config/read_config.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <regex>

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
      << o.limits.message_bytes << " " << o.limits.metadata_bytes << " "
      << o.limits.streams_per_connection << " " << o.limits.model_file_bytes << " "
      << o.limits.dataset_bytes << " " << o.limits.samples_per_call << " " << o.limits.queued_calls;
  return out.str();
}

TEST(ReadConfigTest, TheShippedFileShowsEveryDefault) {
  const std::string shipped =
      store::ReadFile(METAEKF_SOURCE_DIR "/deploy/metaekfd.textproto").value();
  ServerOptions as_shipped;
  ASSERT_TRUE(ApplyConfig(shipped, &as_shipped).ok());
  EXPECT_EQ(Describe(as_shipped), Describe(ServerOptions()));

  // Every setting that is commented out, put in force: nothing changes, but for the directory.
  const std::string in_force =
      std::regex_replace(shipped, std::regex("(^|\n) *# ([a-z_]+: )"), "\n$2");
  ServerOptions options;
  options.listen = "nowhere";
  options.model_cache_bytes = options.limits.message_bytes = options.limits.dataset_bytes = 1;
  options.io_threads = options.training.max_queued_jobs = 77;
  options.drain_timeout = options.training.checkpoint_period = absl::Hours(1);
  const absl::Status applied = ApplyConfig(in_force, &options);
  ASSERT_TRUE(applied.ok()) << applied;
  EXPECT_EQ(options.data_directory, "/var/lib/metaekf");
  EXPECT_EQ(Describe(options), Describe(ServerOptions()));
  // One line per field of the message.
  const std::regex setting("\n *# [a-z_]+: ");
  EXPECT_EQ(std::distance(std::sregex_iterator(shipped.begin(), shipped.end(), setting),
                          std::sregex_iterator()),
            18);
}

TEST(ReadConfigTest, WhatIsLeftOutStays) {
  ServerOptions options;
  options.listen = "localhost:1";
  ASSERT_TRUE(ApplyConfig("training { checkpoint_period_s: 2.5 }", &options).ok());
  EXPECT_EQ(options.listen, "localhost:1");
  EXPECT_EQ(options.training.checkpoint_period, absl::Seconds(2.5));
}

TEST(ReadConfigTest, ErrorsNameThePlace) {
  EXPECT_THAT(Error("listen: \"a\"\nspeed: 3"), HasSubstr("2:"));
  EXPECT_THAT(Error("listen: \"a\"\nspeed: 3"), HasSubstr("speed"));
  EXPECT_THAT(Error("io_threads: 0"), HasSubstr("io_threads is 0, must be at least 1"));
  EXPECT_THAT(Error("drain_timeout_s: -1"), HasSubstr("drain_timeout_s is -1"));
  EXPECT_THAT(Error("drain_timeout_s: nan"), HasSubstr("drain_timeout_s"));
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
