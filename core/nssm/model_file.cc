#include "core/nssm/model_file.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <optional>

#include "absl/strings/str_join.h"
#include "core/base/status.h"
#include "core/nssm/safetensors.h"

namespace metaekf::nssm {
namespace {

using base::JsonFields;
using nlohmann::json;

constexpr char kMetadataKey[] = "metaekf";
constexpr char kPosteriorName[] = "posterior.information", kCoordinatesName[] = "posterior.coordinates",
               kProcessNoiseName[] = "noise.process", kMeasurementNoiseName[] = "noise.measurement", kProcessBiasName[] = "noise.process_bias", kMeasurementBiasName[] = "noise.measurement_bias";
constexpr char kAdaptedKey[] = "adapted";  // names of the tensors that the coordinates stand for
constexpr char kPriorPrefix[] = "prior.";

json ListOf(const Eigen::VectorXd& vector) { return std::vector<double>(vector.begin(), vector.end()); }

/// Row by row.
json ListOf(const Eigen::MatrixXd& matrix) {
  json rows = json::array();
  for (Eigen::Index i = 0; i < matrix.rows(); ++i) rows.push_back(ListOf(Eigen::VectorXd(matrix.row(i))));
  return rows;
}

json ScalingJson(const data::ChannelScaling& scaling) {
  return {{"mean", ListOf(scaling.mean)}, {"scale", ListOf(scaling.scale)}};
}

data::ChannelScaling ReadScaling(JsonFields* parent, const std::string& name, int32_t channels) {
  JsonFields fields = parent->Object(name);
  const auto vector = [&](const std::string& field) {
    const std::vector<double> values = fields.Numbers(field);
    if (static_cast<int32_t>(values.size()) != channels) {
      fields.Fail(field, absl::StrCat("expected ", channels, " numbers, got ", values.size()));
    }
    return Eigen::VectorXd(Eigen::Map<const Eigen::VectorXd>(values.data(), static_cast<Eigen::Index>(values.size())));
  };
  data::ChannelScaling scaling{vector("mean"), vector("scale")};
  if ((scaling.scale.array() <= 0).any()) fields.Fail("scale", "must be positive");
  parent->Include(fields.Finish());
  return scaling;
}

/// n rows of numbers, all as long; nothing where it is not that.
std::optional<Eigen::MatrixXd> ReadRows(const json& rows, int32_t n) {
  if (!rows.is_array() || rows.size() != static_cast<size_t>(n)) return std::nullopt;
  Eigen::MatrixXd matrix(n, n > 0 ? static_cast<Eigen::Index>(rows[0].size()) : 0);
  for (Eigen::Index i = 0; i < matrix.rows(); ++i) {
    const json& row = rows[static_cast<size_t>(i)];
    if (!row.is_array() || static_cast<Eigen::Index>(row.size()) != matrix.cols()) return std::nullopt;
    for (Eigen::Index j = 0; j < matrix.cols(); ++j) {
      const json& value = row[static_cast<size_t>(j)];
      if (!value.is_number()) return std::nullopt;
      matrix(i, j) = value.get<double>();
    }
  }
  return matrix;
}

/// A symmetric matrix, n × n, row by row.
Eigen::MatrixXd ReadCovariance(JsonFields* parent, const json& object, const std::string& name, int32_t n) {
  const std::optional<Eigen::MatrixXd> matrix = ReadRows(object.value(name, json()), n);
  if (matrix && matrix->cols() == n && matrix->allFinite() && matrix->isApprox(matrix->transpose(), 1e-9) &&
      (matrix->diagonal().array() >= 0).all()) {
    return *matrix;
  }
  parent->Fail(name, absl::StrCat("expected a symmetric matrix of ", n, " × ", n, " numbers"));
  return Eigen::MatrixXd::Zero(n, n);
}

std::vector<std::string> ReadNames(JsonFields* fields, const json& object, const std::string& name, int32_t count) {
  std::vector<std::string> names;
  const auto it = object.find(name);
  if (it != object.end() && it->is_array()) {
    for (const json& item : *it) names.push_back(item.is_string() ? item.get<std::string>() : "");
  }
  if (static_cast<int32_t>(names.size()) != count) fields->Fail(name, absl::StrCat("expected ", count, " names"));
  return names;
}

Safetensors::Tensor TensorOf(const nn::Tensor& tensor, const Bundle& bundle) {
  const auto begin = bundle.parameters.begin() + tensor.offset;
  return {.name = tensor.name,
          .shape = tensor.is_bias ? std::vector<int64_t>{tensor.out} : std::vector<int64_t>{tensor.out, tensor.in},
          .is_float32 = bundle.model.spec().precision == Precision::kFloat32,
          .values = std::vector<double>(begin, begin + tensor.size())};
}

absl::Status StoreTensor(const Safetensors::Tensor& tensor, Bundle* bundle, nn::Mask* seen) {
  const std::vector<nn::Tensor>& tensors = bundle->model.layout().tensors();
  for (size_t i = 0; i < tensors.size(); ++i) {
    if (tensors[i].name != tensor.name) continue;
    const Safetensors::Tensor expected = TensorOf(tensors[i], *bundle);
    if (tensor.shape != expected.shape || tensor.is_float32 != expected.is_float32) {
      return absl::InvalidArgumentError(
          absl::StrCat("tensor \"", tensor.name, "\" has not the shape or type that the specification says"));
    }
    std::copy(tensor.values.begin(), tensor.values.end(), bundle->parameters.begin() + tensors[i].offset);
    (*seen)[i] = true;
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" is not part of the model"));
}

Safetensors::Tensor TensorOf(const char* name, const Eigen::MatrixXd& cov) {
  return {.name = name, .shape = {cov.rows(), cov.cols()}, .values = std::vector<double>(cov.reshaped().begin(), cov.reshaped().end())};
}

/// Null where there is none.
json ToJson(const GaussMarkov& bias) {
  if (bias.loadings.cols() == 0) return json();
  return {{"loadings", ListOf(bias.loadings)}, {"correlation", bias.correlation}};
}

bool IsBias(const GaussMarkov& bias, Eigen::Index n) {
  return bias.loadings.rows() == n && bias.loadings.allFinite() && bias.correlation >= 0 && bias.correlation < 1;
}

/// An error that lasts, of n components; none where the file says nothing of it.
GaussMarkov ReadBias(JsonFields* parent, const json& object, const std::string& name, int32_t n) {
  GaussMarkov bias;
  const auto it = object.find(name);
  if (it == object.end() || it->is_null()) return bias;
  JsonFields fields = parent->Object(name);
  bias.correlation = fields.Number("correlation", 0, 0, 1);
  const std::optional<Eigen::MatrixXd> loadings = ReadRows(it->is_object() ? it->value("loadings", json()) : json(), n);
  if (loadings) bias.loadings = *loadings;
  parent->Include(fields.status());
  if (!loadings || !IsBias(bias, n)) parent->Fail(name, absl::StrCat("expected loadings of ", n, " rows and a correlation below 1"));
  return bias;
}

/// Replaces a covariance by one of the same size.
absl::Status StoreNoise(const Safetensors::Tensor& tensor, Eigen::MatrixXd* cov) {
  const Eigen::Index n = cov->rows();
  if (tensor.shape != std::vector<int64_t>{n, n}) {
    return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" is not ", n, " × ", n));
  }
  const Eigen::MatrixXd values = Eigen::Map<const Eigen::MatrixXd>(tensor.values.data(), n, n);
  if (!values.allFinite() || !values.isApprox(values.transpose(), 1e-9) || (values.diagonal().array() < 0).any()) {
    return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" is not a covariance"));
  }
  *cov = values;
  return absl::OkStatus();
}

/// Of n rows of loadings, and φ below them.
void AppendBias(const char* name, const GaussMarkov& bias, Safetensors* file) {
  if (bias.loadings.cols() == 0) return;
  Eigen::MatrixXd values(bias.loadings.rows() + 1, bias.loadings.cols());
  values << bias.loadings, Eigen::RowVectorXd::Constant(bias.loadings.cols(), bias.correlation);
  const Eigen::MatrixXd transposed = values.transpose();  // row-major
  file->tensors.push_back({.name = name, .shape = {values.rows(), values.cols()}, .values = std::vector<double>(transposed.data(), transposed.data() + transposed.size())});
}

/// Replaces an error of n components that lasts.
absl::Status StoreBias(const Safetensors::Tensor& tensor, Eigen::Index n, GaussMarkov* bias) {
  const absl::Status invalid = absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" is not ", n, " rows of loadings and a correlation below 1"));
  if (tensor.shape.size() != 2 || tensor.shape[0] != n + 1 || tensor.shape[1] == 0) return invalid;
  const Eigen::MatrixXd values = Eigen::Map<const Eigen::MatrixXd>(tensor.values.data(), tensor.shape[1], tensor.shape[0]).transpose();
  GaussMarkov read{values.topRows(n), values(n, 0)};
  if (!IsBias(read, n)) return invalid;
  *bias = std::move(read);
  return absl::OkStatus();
}

/// The matrices of a prior by the names of their tensors.
template <typename Prior, typename Visit>
void ForEachPriorMatrix(Prior& prior, const Visit& visit) {
  visit("dynamics", prior.dynamics);
  visit("start", prior.start);
  visit("start_guess", prior.start_guess);
  visit("examples", prior.examples);
  visit("loadings", prior.loadings);
}

void AppendPrior(const GaussianPrior& prior, Safetensors* file) {
  const auto append = [file](const std::string& name, std::vector<int64_t> shape, std::vector<double> values) {
    file->tensors.push_back({.name = kPriorPrefix + name, .shape = std::move(shape), .values = std::move(values)});
  };
  ForEachPriorMatrix(prior, [&](const std::string& name, const Eigen::MatrixXd& matrix) {
    if (matrix.size() == 0) return;
    const Eigen::MatrixXd transposed = matrix.transpose();  // row-major
    append(name, {matrix.rows(), matrix.cols()},
           std::vector<double>(transposed.data(), transposed.data() + transposed.size()));
  });
  append("noise_variance", {prior.noise_variance.size()},
         std::vector<double>(prior.noise_variance.begin(), prior.noise_variance.end()));
}

absl::Status StorePriorTensor(const Safetensors::Tensor& tensor, GaussianPrior* prior) {
  const auto invalid = [&](const std::string& reason) {
    return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" ", reason));
  };
  const std::string name = tensor.name.substr(sizeof(kPriorPrefix) - 1);
  if (name == "noise_variance") {
    prior->noise_variance = Eigen::Map<const Eigen::VectorXd>(tensor.values.data(), static_cast<Eigen::Index>(tensor.values.size()));
    if ((prior->noise_variance.array() <= 0).any()) return invalid("must be positive");
    return absl::OkStatus();
  }
  bool known = false;
  absl::Status status = absl::OkStatus();
  ForEachPriorMatrix(*prior, [&](const std::string& candidate, Eigen::MatrixXd& matrix) {
    if (candidate != name) return;
    known = true;
    if (tensor.shape.size() != 2) {
      status = invalid("is not a matrix");
      return;
    }
    matrix = Eigen::Map<const Eigen::MatrixXd>(tensor.values.data(), tensor.shape[1], tensor.shape[0]).transpose();
    const bool symmetric = name == "dynamics" || name == "start";
    if (symmetric && !matrix.isApprox(matrix.transpose(), 1e-9)) status = invalid("is not symmetric");
  });
  return known ? status : invalid("is not part of a prior");
}

Safetensors::Tensor TensorOf(const GaussianPosterior& posterior) {
  Safetensors::Tensor tensor{.name = kPosteriorName};
  for (Eigen::Index i = 0; i < posterior.information.rows(); ++i) {
    for (Eigen::Index j = 0; j <= i; ++j) tensor.values.push_back(posterior.information(i, j));
  }
  tensor.shape = {static_cast<int64_t>(tensor.values.size())};
  return tensor;
}

/// @param size  of what it is of: the adapted parameters, or the coordinates.
absl::StatusOr<GaussianPosterior> ReadPosterior(const Safetensors::Tensor& tensor, int64_t size) {
  if (static_cast<int64_t>(tensor.values.size()) != size * (size + 1) / 2) {
    return absl::InvalidArgumentError(absl::StrCat("tensor \"", tensor.name, "\" has ", tensor.values.size(), " elements, the triangle of ",
                                                   size, " adapted numbers has ", size * (size + 1) / 2));
  }
  GaussianPosterior posterior;
  posterior.information.resize(size, size);
  const double* value = tensor.values.data();
  for (Eigen::Index i = 0; i < size; ++i) {
    for (Eigen::Index j = 0; j <= i; ++j) posterior.information(i, j) = posterior.information(j, i) = *value++;
  }
  return posterior;
}

}  // namespace

std::string WriteModelFile(const Bundle& bundle) {
  Safetensors file;
  for (const nn::Tensor& tensor : bundle.model.layout().tensors()) file.tensors.push_back(TensorOf(tensor, bundle));
  if (bundle.prior) AppendPrior(*bundle.prior, &file);
  const json description = {
      {"format_version", kModelFormatVersion},
      {"model", ToJson(bundle.model.spec())},
      {"sample_period_s", bundle.sample_period_s},
      {"input_names", bundle.names.inputs},
      {"output_names", bundle.names.outputs},
      {"state_names", bundle.names.states},
      {"normalisation",
       {{"inputs", ScalingJson(bundle.normaliser.inputs)},
        {"outputs", ScalingJson(bundle.normaliser.outputs)},
        {"states", ScalingJson(bundle.normaliser.states)}}},
      {"noise",
       {{"process_cov", ListOf(bundle.noise.process)},
        {"measurement_cov", ListOf(bundle.noise.measurement)},
        {"initial_cov", ListOf(bundle.noise.initial)},
        {"log_std", bundle.noise.log_std},
        {"own_widening", bundle.noise.own_widening},
        {"process_bias", ToJson(bundle.noise.process_bias)},
        {"measurement_bias", ToJson(bundle.noise.measurement_bias)},
        {"parameter_std", bundle.noise.parameter_std}}},
      {"training", *bundle.training},
      {"provenance", *bundle.provenance},
  };
  file.metadata[kMetadataKey] = description.dump();
  return WriteSafetensors(file);
}

absl::StatusOr<Bundle> ReadModelFile(const std::string& bytes) {
  METAEKF_ASSIGN_OR_RETURN(const Safetensors file, ReadSafetensors(bytes));
  const auto metadata = file.metadata.find(kMetadataKey);
  if (metadata == file.metadata.end()) {
    return absl::InvalidArgumentError("the file has no \"metaekf\" metadata: it was not written by metaekf");
  }
  json object;
  METAEKF_RETURN_IF_ERROR(base::Annotate(base::ParseJson(metadata->second, &object), "metadata \"metaekf\""));
  JsonFields fields(object, "metadata");
  const int64_t version = fields.Integer("format_version", 0, 0, 1 << 30);
  if (version != kModelFormatVersion) {
    return absl::InvalidArgumentError(absl::StrCat("the file has format version ", version, ", this program reads version ",
                                                   kModelFormatVersion));
  }
  METAEKF_ASSIGN_OR_RETURN(ModelSpec spec, ReadModelSpec(fields.Object("model")));
  data::Normaliser normaliser;
  JsonFields normalisation = fields.Object("normalisation");
  normaliser.inputs = ReadScaling(&normalisation, "inputs", spec.input_size);
  normaliser.outputs = ReadScaling(&normalisation, "outputs", spec.output_size);
  normaliser.states = ReadScaling(&normalisation, "states", spec.state_size);
  METAEKF_RETURN_IF_ERROR(normalisation.Finish());
  TakeUnits(normaliser, &spec);
  METAEKF_ASSIGN_OR_RETURN(Model model, Model::Create(spec));
  Bundle bundle{.model = std::move(model), .normaliser = std::move(normaliser)};
  if (!fields.Has("sample_period_s")) fields.Fail("sample_period_s", "is missing");
  bundle.sample_period_s = fields.Number("sample_period_s", 0, 1e-12, 1e12);
  bundle.names.inputs = ReadNames(&fields, object, "input_names", spec.input_size);
  bundle.names.outputs = ReadNames(&fields, object, "output_names", spec.output_size);
  bundle.names.states = ReadNames(&fields, object, "state_names", spec.state_size);
  if (!object.contains("noise") || !object["noise"].is_object()) {
    return absl::InvalidArgumentError("metadata.noise is missing");
  }
  const json& noise = object["noise"];
  const int32_t filter_size = spec.is_case_one() ? spec.latent_size : spec.state_size;
  JsonFields noise_fields(noise, "metadata.noise");
  bundle.noise.process = ReadCovariance(&noise_fields, noise, "process_cov", filter_size);
  bundle.noise.measurement = ReadCovariance(&noise_fields, noise, "measurement_cov", spec.output_size);
  bundle.noise.initial = ReadCovariance(&noise_fields, noise, "initial_cov", filter_size);
  bundle.noise.log_std = noise_fields.Number("log_std", FilterNoise().log_std, 0, 1e3);
  bundle.noise.own_widening = noise_fields.Number("own_widening", FilterNoise().own_widening, 0, 1e3);
  bundle.noise.process_bias = ReadBias(&noise_fields, noise, "process_bias", filter_size);
  bundle.noise.measurement_bias = ReadBias(&noise_fields, noise, "measurement_bias", spec.output_size);
  bundle.noise.parameter_std = noise_fields.Number("parameter_std", FilterNoise().parameter_std, 0, 1e3);
  METAEKF_RETURN_IF_ERROR(noise_fields.status());
  METAEKF_RETURN_IF_ERROR(fields.status());
  bundle.training = object.value("training", json::object());
  bundle.provenance = object.value("provenance", json::object());
  bundle.parameters.assign(static_cast<size_t>(bundle.model.layout().size()), 0.0);
  nn::Mask seen(bundle.model.layout().tensors().size(), false);
  for (const Safetensors::Tensor& tensor : file.tensors) {
    if (tensor.name.rfind(kPriorPrefix, 0) != 0) {
      METAEKF_RETURN_IF_ERROR(StoreTensor(tensor, &bundle, &seen));
      continue;
    }
    if (!bundle.prior) bundle.prior.emplace();
    METAEKF_RETURN_IF_ERROR(StorePriorTensor(tensor, &*bundle.prior));
  }
  if (spec.fits_start()) {
    const bool whole = bundle.prior && bundle.prior->start.rows() == spec.latent_size && bundle.prior->start.cols() == spec.latent_size &&
                       bundle.prior->noise_variance.size() == spec.output_size &&
                       bundle.prior->start_guess.rows() == spec.latent_size &&
                       bundle.prior->start_guess.cols() == bundle.model.start_size() + 1;
    if (!whole) return absl::InvalidArgumentError("the start of the model is fitted, but the file has no prior to fit it with");
  }
  for (size_t i = 0; i < seen.size(); ++i) {
    if (!seen[i]) {
      return absl::InvalidArgumentError(absl::StrCat("tensor \"", bundle.model.layout().tensors()[i].name, "\" is missing"));
    }
  }
  return bundle;
}

std::string WriteAdaptedSubset(const Bundle& bundle, const nn::Mask& mask) {
  Safetensors file;
  const bool few = bundle.posterior && bundle.posterior->coordinates.size() > 0;
  std::vector<std::string> names;
  for (size_t i = 0; i < mask.size(); ++i) {
    if (!mask[i]) continue;
    names.push_back(bundle.model.layout().tensors()[i].name);
    if (!few) file.tensors.push_back(TensorOf(bundle.model.layout().tensors()[i], bundle));
  }
  if (few) {
    const Eigen::VectorXd& z = bundle.posterior->coordinates;
    file.tensors.push_back({.name = kCoordinatesName, .shape = {z.size()}, .values = std::vector<double>(z.begin(), z.end())});
    file.metadata[kAdaptedKey] = names.size() == mask.size() ? "*" : absl::StrJoin(names, ",");
  }
  if (bundle.posterior) file.tensors.push_back(TensorOf(*bundle.posterior));
  file.tensors.push_back(TensorOf(kProcessNoiseName, bundle.noise.process));
  file.tensors.push_back(TensorOf(kMeasurementNoiseName, bundle.noise.measurement));
  AppendBias(kProcessBiasName, bundle.noise.process_bias, &file);
  AppendBias(kMeasurementBiasName, bundle.noise.measurement_bias, &file);
  return WriteSafetensors(file);
}

namespace {

/// ω₀ + V z into the adapted tensors. @param mask  receives which these are.
/// Errors: InvalidArgument if the base has no such directions.
absl::Status MoveAlongLoadings(const Safetensors& file, const Safetensors::Tensor& coordinates, Bundle* bundle, nn::Mask* adapted_mask) {
  const auto adapted = file.metadata.find(kAdaptedKey);
  METAEKF_ASSIGN_OR_RETURN(*adapted_mask, nn::ParseMask(adapted == file.metadata.end() ? "*" : adapted->second, bundle->model.layout()));
  const nn::Mask& mask = *adapted_mask;
  std::vector<size_t> places;  // of the adapted parameters in ω
  for (size_t i = 0; i < mask.size(); ++i) {
    const nn::Tensor& tensor = bundle->model.layout().tensors()[i];
    for (int64_t k = 0; mask[i] && k < tensor.size(); ++k) places.push_back(static_cast<size_t>(tensor.offset + k));
  }
  const Eigen::VectorXd z = Eigen::Map<const Eigen::VectorXd>(coordinates.values.data(), static_cast<Eigen::Index>(coordinates.values.size()));
  if (!bundle->prior || bundle->prior->loadings.rows() != static_cast<Eigen::Index>(places.size()) || bundle->prior->loadings.cols() != z.size()) {
    return absl::InvalidArgumentError(absl::StrCat("tensor \"", coordinates.name, "\": the model's prior has no ", z.size(),
                                                   " directions of ", places.size(), " parameters"));
  }
  Eigen::VectorXd values(bundle->prior->loadings.rows());
  for (size_t i = 0; i < places.size(); ++i) values[static_cast<Eigen::Index>(i)] = bundle->parameters[places[i]];
  values = AlongLoadings(*bundle->prior, values, z);
  for (size_t i = 0; i < places.size(); ++i) bundle->parameters[places[i]] = values[static_cast<Eigen::Index>(i)];
  RoundToPrecision(bundle->model.spec().precision, &bundle->parameters);
  return absl::OkStatus();
}

}  // namespace

absl::Status ApplyAdaptedSubset(const std::string& bytes, Bundle* bundle) {
  METAEKF_ASSIGN_OR_RETURN(const Safetensors file, ReadSafetensors(bytes));
  nn::Mask seen(bundle->model.layout().tensors().size(), false);
  int64_t adapted = 0;
  const Safetensors::Tensor *posterior = nullptr, *coordinates = nullptr;
  for (const Safetensors::Tensor& tensor : file.tensors) {
    if (tensor.name == kPosteriorName || tensor.name == kCoordinatesName) {
      (tensor.name == kPosteriorName ? posterior : coordinates) = &tensor;
      continue;
    }
    if (tensor.name == kProcessNoiseName || tensor.name == kMeasurementNoiseName) {
      METAEKF_RETURN_IF_ERROR(StoreNoise(tensor, tensor.name == kProcessNoiseName ? &bundle->noise.process : &bundle->noise.measurement));
      continue;
    }
    if (tensor.name == kProcessBiasName || tensor.name == kMeasurementBiasName) {
      const bool of_process = tensor.name == kProcessBiasName;
      METAEKF_RETURN_IF_ERROR(StoreBias(tensor, (of_process ? bundle->noise.process : bundle->noise.measurement).rows(),
                                        of_process ? &bundle->noise.process_bias : &bundle->noise.measurement_bias));
      continue;
    }
    METAEKF_RETURN_IF_ERROR(StoreTensor(tensor, bundle, &seen));
    adapted += static_cast<int64_t>(tensor.values.size());
  }
  if (coordinates != nullptr) {
    METAEKF_RETURN_IF_ERROR(MoveAlongLoadings(file, *coordinates, bundle, &seen));
    adapted = static_cast<int64_t>(coordinates->values.size());
  }
  if (posterior == nullptr) return absl::OkStatus();
  METAEKF_ASSIGN_OR_RETURN(bundle->posterior, ReadPosterior(*posterior, adapted));
  bundle->posterior->mask = seen;
  if (coordinates != nullptr) {
    bundle->posterior->coordinates = Eigen::Map<const Eigen::VectorXd>(coordinates->values.data(), static_cast<Eigen::Index>(coordinates->values.size()));
  }
  return absl::OkStatus();
}

}  // namespace metaekf::nssm
