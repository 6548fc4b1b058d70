#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <string>

#include "metaekf/client.h"

namespace metaekf::server {

/// A metric that a server tells of, summed over all that have these labels.
inline double Metric(const std::string& address, const std::string& name, const std::map<std::string, std::string>& labels = {}) {
  const auto families = client::Client({.server = address}).GetMetrics();
  EXPECT_TRUE(families.ok()) << families.status().message;
  if (!families.ok()) return 0;
  const auto family = std::find_if(families->begin(), families->end(), [&name](const auto& f) { return f.name == name; });
  if (family == families->end()) return 0;  // nothing has been counted
  double sum = 0;
  for (const client::Metric& metric : family->metrics) {
    const auto has = [&metric](const auto& label) { return metric.labels.at(label.first) == label.second; };
    if (std::all_of(labels.begin(), labels.end(), has)) sum += metric.value;
  }
  return sum;
}

}  // namespace metaekf::server
