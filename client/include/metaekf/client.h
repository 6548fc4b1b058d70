#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace metaekf::client {

/// As of gRPC, the same numbers.
enum class Code {
  kOk = 0,
  kCancelled = 1,
  kUnknown = 2,
  kInvalidArgument = 3,
  kDeadlineExceeded = 4,
  kNotFound = 5,
  kAlreadyExists = 6,
  kPermissionDenied = 7,
  kResourceExhausted = 8,
  kFailedPrecondition = 9,
  kAborted = 10,
  kOutOfRange = 11,
  kUnimplemented = 12,
  kInternal = 13,
  kUnavailable = 14,
  kDataLoss = 15,
  kUnauthenticated = 16,
};

struct FieldViolation {
  std::string field;  ///< path from the request's root, e.g. "header.spec.model.case"
  std::string description;
};

/// How a call ended.
struct Status {
  Code code = Code::kOk;
  std::string message;
  std::vector<FieldViolation> violations;       ///< of kInvalidArgument
  std::string reason;                           ///< for programs, e.g. "SEQUENCE_GAP"; may be empty
  std::map<std::string, std::string> metadata;  ///< beside the reason, e.g. {expected_seq: 7}
  std::optional<double> retry_delay_s;          ///< when to try again, if the server says

  bool ok() const { return code == Code::kOk; }
};

/// A value, or why there is none.
template <typename T>
class Result {
 public:
  Result(T value) : value_(std::move(value)) {}
  Result(Status error) : status_(std::move(error)) {}

  bool ok() const { return value_.has_value(); }
  const Status& status() const { return status_; }
  /// The value; only if ok().
  T& operator*() { return *value_; }
  const T& operator*() const { return *value_; }
  T* operator->() { return &*value_; }
  const T* operator->() const { return &*value_; }

 private:
  Status status_;
  std::optional<T> value_;
};

/// A moment of the server's clock; Time() if it is not known.
using Time = std::chrono::system_clock::time_point;

struct Channel {
  std::string name;
  std::string unit;  ///< empty: not said
};

struct Channels {
  std::vector<Channel> inputs, outputs, states;
};

/// One recording, in physical units. Matrices are flattened row by row, one row per sample: element
/// (t, i) stands at t · width + i. One that is absent is empty. NaN: not measured.
struct Trajectory {
  std::string name;
  double start_time_s = 0;
  double sample_period_s = 0;  ///< 0: the period of the model it is used with
  size_t samples = 0;
  std::vector<double> inputs, outputs, states;
};

/// What the server says about itself and its data directory.
struct ServerInfo {
  std::string version;
  Time start_time;
  uint32_t data_format_version = 0;
  uint64_t stored_bytes = 0;
  std::optional<uint64_t> free_disk_bytes;  ///< told to who looks after the server
  std::vector<std::string> problems;  ///< of stored files, one sentence each
  uint32_t models = 0, model_versions = 0, adaptations = 0, sessions = 0;
  uint32_t queued_jobs = 0, running_jobs = 0, ended_jobs = 0;
};

struct ModelAlias {
  std::string alias;
  uint32_t version = 0;
};

struct Model {
  std::string name;
  uint32_t latest_version = 0;
  uint32_t version_count = 0;
  std::vector<ModelAlias> aliases;
  Time create_time;
};

struct ModelVersion {
  std::string model;
  uint32_t version = 0;
  Time create_time;
  uint64_t size_bytes = 0;
  std::string sha256;
  std::string spec;               ///< TrainingSpec as protobuf text
  bool estimates_states = false;  ///< Case II: states x are estimated; else (Case I) outputs
  Channels channels;
  double sample_period_s = 0;
  uint64_t parameter_count = 0;
  std::optional<double> validation_loss;  ///< normalised units
  std::string training_job;               ///< empty: imported
};

/// What a client may do; each may do what those before it may.
enum class Scope {
  kRead,    ///< look, predict
  kStream,  ///< have sessions of estimates
  kWrite,   ///< make, change and delete what its tenant has
  kAdmin,   ///< look after the server
};

/// A bearer token, without its secret.
struct Token {
  std::string id;
  std::string tenant;  ///< whose things its holder works with
  Scope scope = Scope::kRead;
  std::string note;
  Time create_time;
  std::optional<Time> expire_time, revoke_time;
};

struct TokenRequest {
  std::string tenant;  ///< empty: "default"
  Scope scope = Scope::kRead;
  std::optional<double> lifetime_s;  ///< nothing: it does not expire
  std::string note;                  ///< for whom it is
};

struct NewToken {
  Token token;
  std::string secret;  ///< what its holder shows; the server does not keep it
};

/// Who did what, when.
struct AuditEntry {
  uint64_t number = 0;  ///< from 1 up
  Time time;
  std::string tenant, identity, action, resource, detail;
};

/// What a backup holds.
struct BackupInfo {
  std::string server_version;
  uint32_t data_format_version = 0;
  Time create_time;
  uint32_t files = 0;
  uint64_t size_bytes = 0;
};

struct BackupFile {
  std::string path;  ///< metaekf.db, or blobs/{sha256}
  uint64_t size_bytes = 0;
  std::string sha256;  ///< of its bytes; one that the server has lost has none
};

/// Receives a backup: Begin, then each File followed by its bytes. An error of any ends it.
class BackupSink {
 public:
  virtual ~BackupSink() = default;
  virtual Status Begin(const BackupInfo& info) = 0;
  virtual Status File(const BackupFile& file) = 0;
  virtual Status Bytes(const std::string& bytes) = 0;
};

/// One value that a server counts or measures; of several, their distribution.
struct Metric {
  std::map<std::string, std::string> labels;
  double value = 0;
  /// Of a histogram: how many values, their sum, and how many are at most each bound, the last of which is infinite.
  struct Histogram {
    uint64_t count = 0;
    double sum = 0;
    std::vector<double> upper_bounds;
    std::vector<uint64_t> cumulative_counts;
  };
  std::optional<Histogram> histogram;
};

struct MetricFamily {
  std::string name;  ///< with its unit
  std::string help;
  std::vector<Metric> metrics;
};

/// A fleet to learn from: one trajectory per system, no NaN.
struct TrainingRequest {
  std::string model;                 ///< NAME; made if there is none yet
  std::string spec;                  ///< TrainingSpec as protobuf text
  std::string spec_source = "spec";  ///< names it in messages, e.g. its file
  Channels channels;
  std::vector<Trajectory> fleet;
  std::string request_id;  ///< the same again answers with the job made the first time; or empty
};

/// Losses are mean squared errors in normalised units.
struct TrainingProgress {
  uint32_t iteration = 0, iterations = 0;
  std::optional<double> training_loss, validation_loss, best_validation_loss, time_left_s;
  std::string message;
};

enum class JobState { kUnknown, kQueued, kRunning, kSucceeded, kFailed, kCancelled };

struct Job {
  std::string id;
  std::string model;
  std::string spec;  ///< TrainingSpec as protobuf text
  JobState state = JobState::kUnknown;
  std::optional<TrainingProgress> progress;
  std::string error_message;
  std::optional<uint32_t> model_version;  ///< of kSucceeded
  uint32_t attempt = 0;
  Time create_time, start_time, end_time;

  bool ended() const {
    return state == JobState::kSucceeded || state == JobState::kFailed ||
           state == JobState::kCancelled;
  }
};

enum class AdaptationMethod { kGradientDescent, kAdam, kFromScratch, kLevenbergMarquardt };

/// m steps of learning rate β_in on the parameters that the mask names.
struct InnerLoop {
  std::optional<uint32_t> steps;
  std::optional<double> learning_rate;
  std::string adapted_mask;  ///< e.g. "encoder.4-5,transition"; empty: the model's
};

struct AdaptationRequest {
  std::string model;
  std::string adaptation_id;  ///< empty: the server chooses one
  std::optional<AdaptationMethod> method;  ///< none: what the model was trained for
  InnerLoop inner_loop;                    ///< what is left out is the model's
  uint64_t seed = 0;
  bool require_better_than_arx = false;  ///< refuse what is not, in free run on the context's tail
  Trajectory context;
  std::string request_id;
};

struct AdaptationProgress {
  uint32_t step = 0, steps = 0;
  double loss = 0;  ///< on the context, normalised units
};

/// Root mean square errors, one per output in its unit.
struct OutputErrors {
  std::vector<double> one_step, simulate;
};

/// Errors on the tail of the context, which was not adapted to.
struct HeldOutErrors {
  uint32_t samples = 0;
  OutputErrors before, after, arx;
  bool better_than_unadapted = false, better_than_arx = false;  ///< adapted, in free run, all outputs together
};

struct Adaptation {
  std::string id;
  std::string model;
  uint32_t model_version = 0;
  AdaptationMethod method = AdaptationMethod::kGradientDescent;
  InnerLoop inner_loop;  ///< as it was run
  uint64_t seed = 0;
  uint32_t context_samples = 0;
  double context_loss_before = 0, context_loss_after = 0;
  std::optional<HeldOutErrors> held_out;  ///< none if the context was too short
  double duration_s = 0;
  Time create_time;
};

/// What predicts or estimates: one of the two is empty.
struct Target {
  std::string model;
  std::string adaptation;
};

enum class PredictionMode { kOneStep, kSimulate };

struct PredictionRequest {
  Target target;
  PredictionMode mode = PredictionMode::kOneStep;
  std::vector<Trajectory> trajectories;
};

/// Predictions of one trajectory, flattened as there; NaN in the warm-up.
struct Prediction {
  std::string trajectory;
  uint32_t warmup_samples = 0;
  std::vector<double> outputs;
  std::vector<double> states;  ///< Case II
};

/// Overrides of a model's own noise; what is empty is the model's. Covariances as their diagonal or
/// as the lower triangle row by row.
struct NoiseSettings {
  std::vector<double> process_noise_cov, measurement_noise_cov, initial_mean, initial_cov;
};

/// How an estimate outside the set that the model's states lie in is put inside.
enum class Projection { kDefault, kQuadraticProgram, kAutoencoder, kNone };

/// When a measurement is taken for an outlier and left out.
struct GateSettings {
  double probability = 0;  ///< with which a right measurement passes; 0: the server's default
  int32_t recover_after = 0;  ///< samples with outliers in a row until they are believed; 0: its default
  bool off = false;           ///< every measurement is believed
};

enum class CovarianceFormat { kNone, kDiagonal, kLowerTriangle };

struct EstimationOptions {
  Target target;
  NoiseSettings noise;
  CovarianceFormat covariance = CovarianceFormat::kDiagonal;
  bool send_innovations = false;
  double sample_period_s = 0;   ///< 0: the model's
  double max_lag_s = 0;         ///< how far behind the latest sample a measurement may be
  int32_t initial_samples = 0;  ///< Case II: samples to find the first state from by least squares
  GateSettings gate;
  Projection projection = Projection::kDefault;
  bool stay_diverged = false;   ///< do not begin anew after a divergence
  size_t max_in_flight = 8192;  ///< samples that may wait for their answer
  /// Samples kept to be sent again. Beyond it a batch is sent only when all before it are answered.
  size_t max_kept = 262'144;
  double reconnect_for_s = 60;  ///< how long a stream that was lost is tried to be opened again; 0: not at all
};

struct SessionInfo {
  std::string session;
  std::string token;  ///< needed to resume
  uint64_t epoch = 0;
  uint64_t durable_seq = 0;
  std::string model;
  uint32_t model_version = 0;
  std::string adaptation;
  size_t input_size = 0, output_size = 0, estimate_size = 0;
  std::vector<Channel> estimated;  ///< states (Case II) or outputs (Case I)
  double sample_period_s = 0;
  CovarianceFormat covariance = CovarianceFormat::kNone;
  bool send_innovations = false;
  bool constrained = false;  ///< estimates come with slacks and projections
};

/// Consecutive samples, flattened row by row. NaN in outputs: not measured.
struct SampleBatch {
  size_t samples = 0;
  std::vector<double> inputs, outputs;
  std::vector<double> times_s;  ///< one each, or none: each one period after the one before
  /// R of each sample instead of the session's: rows × n_y (diagonals) or × n_y(n_y+1)/2; or none.
  std::vector<double> measurement_noise_covs;
};

enum class Health { kUnknown, kWarmingUp, kConsistent, kOverconfident, kDiverged, kUnderconfident };

/// Bits of EstimateBatch::flags.
enum Flag : uint32_t {
  kMissing = 1,    ///< some or all of y was not measured
  kGated = 2,      ///< some or all of y was left out as an outlier
  kProjected = 4,  ///< the estimate was moved into its constraints
  kDelayed = 8,    ///< y was applied at an earlier time than the latest
  kReset = 16,     ///< widened to believe y after outliers in a row, or begun anew after divergence
  kAdapted = 32,   ///< the model adapted to the stream
};

/// Posteriors of consecutive samples, flattened row by row; NaN while warming up.
struct EstimateBatch {
  bool forecast = false;   ///< answers AskForecast: of samples that are still to come
  uint64_t first_seq = 0;  ///< the sample that the first row answers
  uint64_t durable_seq = 0;
  size_t samples = 0;
  std::vector<double> times_s;
  std::vector<double> means;        ///< rows × n
  std::vector<double> covariances;  ///< rows × 0, n or n(n+1)/2, as asked
  std::vector<double> innovations, innovation_covs;
  std::vector<double> nis;  ///< normalised innovation squared, NaN where nothing was measured
  std::vector<Health> health;
  std::vector<uint32_t> flags;
  /// Of sessions that are constrained, in units of the states' scales: the distance to the nearest
  /// constraint before the estimate was put inside, negative outside, and how far it was moved.
  std::vector<double> slacks, projections;
};

struct SmoothingRequest {
  Target target;
  NoiseSettings noise;
  int32_t initial_samples = 0;  ///< Case II: samples to find the first state from by least squares
  GateSettings gate;
  Projection projection = Projection::kDefault;
  CovarianceFormat covariance = CovarianceFormat::kDiagonal;
  Trajectory trajectory;  ///< NaN in outputs: not measured
};

/// Estimates given a whole recording; NIS, health and flags as the filter had them.
struct Smoothed {
  std::vector<Channel> estimated;  ///< states (Case II) or outputs (Case I)
  bool constrained = false;
  std::vector<EstimateBatch> batches;  ///< in order, all samples
};

/// How a connection is encrypted; texts in PEM form.
struct Tls {
  std::string authorities;       ///< of which one has signed the server's certificate; empty: the system's
  std::string certificate, key;  ///< the client's own, with its chain, for a server that asks; else empty
};

struct Options {
  std::string server = "127.0.0.1:50051";  ///< HOST:PORT
  double timeout_s = 20;                   ///< of calls that ask one thing and get one answer
  std::string token{};                     ///< bearer token; empty: none is shown. Beyond this machine it wants `tls`
  std::optional<Tls> tls{};                ///< nothing: not encrypted
};

class EstimationSession;

/// A connection to a metaekf server. Connects with the first call and again after a loss; safe to
/// use from several threads.
///
/// Models are written NAME (its latest version), NAME@3 or NAME@ALIAS; adaptations, jobs and
/// sessions by their ids. Any name may also be given as the server spells it
/// ("models/m/versions/3").
///
/// Errors of every call: Unavailable with reason NO_SERVER if nothing listens at the address,
/// NO_CONNECTION if something may but no connection came about, CONNECTION_LOST if it went away; DeadlineExceeded; InvalidArgument with the wrong fields;
/// NotFound; what the server says otherwise.
class Client {
 public:
  explicit Client(const Options& options = {});
  ~Client();
  Client(Client&&) noexcept;
  Client& operator=(Client&&) noexcept;

  const std::string& server() const;

  /// @param verify_files  also reads every stored file and compares its digest.
  Result<ServerInfo> GetServerInfo(bool verify_files = false);

  Result<std::vector<Model>> ListModels();
  Result<Model> GetModel(const std::string& model);
  /// Newest first.
  Result<std::vector<ModelVersion>> ListModelVersions(const std::string& model);
  Result<ModelVersion> GetModelVersion(const std::string& model);
  /// The model file (safetensors), whole. Errors: DataLoss if it did not come as the server said.
  Result<std::string> ExportModel(const std::string& model);
  /// Adds a model file as a new version of `model`, which is made if there is none yet.
  Result<ModelVersion> ImportModel(const std::string& model, const std::string& file);
  Status SetModelAlias(const std::string& model, const std::string& alias, uint32_t version);
  /// @param model  NAME@ALIAS. The version stays.
  Status DeleteModelAlias(const std::string& model);
  /// @param model  NAME@VERSION.
  Status DeleteModelVersion(const std::string& model);

  /// Sends a fleet and queues its meta-training. Errors: InvalidArgument with "FILE:LINE:COLUMN:"
  /// if the specification is no TrainingSpec.
  Result<Job> CreateTrainingJob(const TrainingRequest& request);
  Result<Job> GetJob(const std::string& id);
  /// Newest first.
  Result<std::vector<Job>> ListJobs();
  /// Calls `on_change` with the job as it stands and after every change, until it has ended or
  /// `on_change` returns false; then gives the job as it stands.
  Result<Job> WatchJob(const std::string& id, const std::function<bool(const Job&)>& on_change);
  Result<Job> CancelJob(const std::string& id);

  /// Adapts a model to one recording; `on_step` hears of every inner step and stops it with false.
  /// Errors: FailedPrecondition if the context is too short, with the samples needed.
  Result<Adaptation> Adapt(const AdaptationRequest& request,
                           const std::function<bool(const AdaptationProgress&)>& on_step = {});
  Result<Adaptation> GetAdaptation(const std::string& id);
  Result<std::vector<Adaptation>> ListAdaptations();
  Status DeleteAdaptation(const std::string& id);

  /// Predicts recordings, one prediction each, in their order. `on_rows` hears how many samples
  /// have been answered.
  Result<std::vector<Prediction>> Predict(
      const PredictionRequest& request, const std::function<void(uint64_t samples)>& on_rows = {});

  /// Estimates of a recording from the whole of it.
  Result<Smoothed> Smooth(const SmoothingRequest& request);

  Result<std::unique_ptr<EstimationSession>> OpenEstimation(const EstimationOptions& options);
  /// Goes on with a session, e.g. after a restart: samples from info().durable_seq + 1 on are to be
  /// sent (again).
  Result<std::unique_ptr<EstimationSession>> ResumeEstimation(const std::string& session,
                                                              const std::string& token);

  /// Looking after the server: these need a token of scope kAdmin where tokens are needed at all.
  /// All that the server keeps, as it stands now; streams and jobs go on meanwhile.
  Status CreateBackup(BackupSink& sink);
  /// What the server counts and measures, as Prometheus reads it.
  Result<std::vector<MetricFamily>> GetMetrics();
  Result<NewToken> CreateToken(const TokenRequest& request);
  /// Expired and revoked ones too, the oldest first.
  Result<std::vector<Token>> ListTokens();
  Result<Token> RevokeToken(const std::string& id);
  /// The newest first. @param most  entries. @param tenant  whose; empty: everyone's.
  Result<std::vector<AuditEntry>> ListAuditEntries(const std::string& tenant, size_t most);

 private:
  friend class EstimationSession;
  struct Impl;
  std::shared_ptr<Impl> impl_;
};

/// A stream of samples to one filter and of its estimates back. One thread may send while another
/// receives.
///
/// Samples are numbered from 1. They are kept until the server says that they will survive a crash
/// (durable_seq), so that they can be sent again; of a server that makes none durable the latest
/// EstimationOptions::max_kept.
///
/// A stream that is lost, with its connection or its server, is opened again and goes on: what is not durable and what
/// was sent meanwhile is sent by itself, no estimate is missed and none comes twice. Only what does not pass within
/// EstimationOptions::reconnect_for_s is told as an error.
class EstimationSession {
 public:
  /// Ends the stream; the session stays on the server.
  ~EstimationSession();

  /// As of the time the session was opened, or Resume.
  const SessionInfo& info() const;
  /// Samples up to this number survive a crash of the server.
  uint64_t durable_seq() const;

  /// Sends samples and gives the number of the last. Blocks while max_in_flight samples wait for an
  /// answer: call Receive in another thread, or at least as often.
  /// Errors: InvalidArgument for sizes that do not fit and what is no number: nothing is sent then;
  /// Unavailable once the stream has ended (Receive says why).
  Result<uint64_t> Send(const SampleBatch& samples);
  /// Asks what the next `horizon` samples will be like; the answer comes by Receive, after those to
  /// what has been sent before.
  /// @param inputs  horizon × n_u; empty: the last input goes on.
  Status AskForecast(size_t horizon, const std::vector<double>& inputs = {});
  /// Says that nothing more will be sent.
  void FinishSending();

  /// The next estimates, waiting for them; nothing when all have come after FinishSending. After an
  /// error everything up to the last estimate received stands; its metadata say the durable_seq.
  /// Errors: what made the stream end, where that does not pass in time; InvalidArgument for samples that the server
  /// refuses: these and all sent after them are forgotten, and their numbers are given anew after Resume; Aborted if
  /// another stream took the session over; DataLoss if the server needs samples that are no longer kept.
  Result<std::optional<EstimateBatch>> Receive();

  /// After Receive gave an error (and no Send runs): tries once more, and sends what is not durable
  /// again. Estimates of those samples come again, bit for bit. Errors: as Receive.
  Status Resume();

 private:
  friend class Client;
  struct Impl;
  explicit EstimationSession(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// Q, R, initial mean and covariance from a protobuf text file (NoiseSettings).
/// Errors: InvalidArgument with "SOURCE:LINE:COLUMN:" and the field.
Result<NoiseSettings> ParseNoiseSettings(const std::string& text, const std::string& source);

}  // namespace metaekf::client
