#pragma once

#include <functional>
#include <vector>

#include "metaekf/client.h"
#include "metaekf/v1/adaptation.pb.h"
#include "metaekf/v1/admin.pb.h"
#include "metaekf/v1/data.pb.h"
#include "metaekf/v1/estimation.pb.h"
#include "metaekf/v1/model.pb.h"
#include "metaekf/v1/server_info.pb.h"
#include "metaekf/v1/training.pb.h"

/// Between the structs of client.h and the messages of the wire.
namespace metaekf::client {

ServerInfo FromProto(const v1::ServerInfo& message);
Token FromProto(const v1::Token& message);
MetricFamily FromProto(const v1::MetricFamily& message);
BackupInfo FromProto(const v1::CreateBackupResponse::Header& message);
AuditEntry FromProto(const v1::AuditEntry& message);
Model FromProto(const v1::Model& message);
ModelVersion FromProto(const v1::ModelVersion& message);
TrainingProgress FromProto(const v1::TrainingProgress& message);
JobState FromProto(v1::Job::State state);
Job FromProto(const v1::Job& message);
Adaptation FromProto(const v1::Adaptation& message);
SessionInfo FromProto(const v1::SessionOpened& message);
EstimateBatch FromProto(const v1::EstimateBatch& message);
NoiseSettings FromProto(const v1::NoiseSettings& message);

void ToProto(const Channels& channels, v1::Channels* message);
void ToProto(const NoiseSettings& noise, v1::NoiseSettings* message);
void ToProto(const GateSettings& gate, v1::GateSettings* message);
void ToProto(const InnerLoop& inner_loop, v1::InnerLoopSpec* message);
v1::Adaptation::Method ToProto(std::optional<AdaptationMethod> method);
v1::OpenSession::CovarianceFormat ToProto(CovarianceFormat format);

/// Cuts a trajectory into messages below 1 MiB and hands each to `send` until it returns false.
/// Errors: InvalidArgument for matrices whose size is no multiple of the number of samples; the
/// caller learns from its stream why `send` failed.
Status SendSamples(const Trajectory& trajectory, const std::function<bool(v1::Samples)>& send);

}  // namespace metaekf::client
