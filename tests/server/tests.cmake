metaekf_test(server/status/grpc_status_test.cc DEPS metaekf::server_status metaekf::proto_messages)
metaekf_test(server/status/text_test.cc DEPS metaekf::server_status)
foreach(test adaptations audit blob_store crash database jobs models names page quota sessions sha256 store tokens)
  metaekf_test(server/store/${test}_test.cc DEPS metaekf::server_store)
endforeach()

metaekf_library(server_test_support
  SOURCES server/support/client.cc server/support/tiny_models.cc
  DEPS metaekf::core_nssm metaekf::proto_messages metaekf::server metaekf::server_convert
    metaekf::server_store
  PRIVATE_DEPS metaekf::core_test_support metaekf::proto GTest::gtest)
target_compile_definitions(metaekf_server_test_support
  INTERFACE METAEKFD_BINARY="$<TARGET_FILE:metaekfd>")
add_dependencies(metaekf_server_test_support metaekfd)  # the workers of jobs

foreach(test adaptation_service model_service prediction_service smoothing_service training_service)
  metaekf_test(server/handlers/${test}_test.cc DEPS metaekf::server_test_support)
endforeach()
foreach(test access_control exposure)
  metaekf_test(server/access/${test}_test.cc DEPS metaekf::server_access)
endforeach()
metaekf_library(test_certificates SOURCES support/certificates.cc PRIVATE_DEPS GTest::gtest OpenSSL::Crypto)
metaekf_test(server/access/tls_files_test.cc DEPS metaekf::server_access metaekf::test_certificates)
metaekf_test(server/access/matrix_test.cc DEPS metaekf::server_test_support metaekf::proto)
metaekf_test(server/metrics/metrics_test.cc DEPS metaekf::server_metrics)
metaekf_test(server/server_test.cc DEPS metaekf::server_test_support)
metaekf_test(server/training/resume_test.cc LABELS slow DEPS metaekf::server_test_support)
metaekf_test(server/fault/kill_test.cc LABELS slow TIMEOUT 3600 DEPS metaekf::server_test_support metaekf::server_training)
metaekf_test(server/main_test.cc DEPS metaekf::server_test_support metaekf::server_training)
metaekf_test(server/names/resource_names_test.cc DEPS metaekf::server_names)
foreach(test sample_budget samples spec)
  metaekf_test(server/convert/${test}_test.cc DEPS metaekf::server_convert)
endforeach()
metaekf_test(server/serving/model_cache_test.cc
  DEPS metaekf::server_serving metaekf::server_test_support)
metaekf_test(server/executor/background_executor_test.cc DEPS metaekf::server_executor)
metaekf_test(server/executor/give_way_test.cc DEPS metaekf::server_executor)
metaekf_test(server/training/job_feed_test.cc DEPS metaekf::server_training)
metaekf_test(server/config/read_config_test.cc
  DEPS metaekf::server_config metaekf::server_store)
target_compile_definitions(server.config.read_config_test
  PRIVATE METAEKF_SOURCE_DIR="${PROJECT_SOURCE_DIR}")
