metaekf_test(server/session/estimation_service_test.cc
  DEPS metaekf::server_test_support metaekf::core_filter metaekf::proto)
metaekf_test(server/session/estimation_samples_test.cc
  DEPS metaekf::server_test_support metaekf::core_filter metaekf::proto)
metaekf_test(server/session/batch_queue_test.cc
  DEPS metaekf::server_test_support metaekf::server_session metaekf::core_filter metaekf::proto)
metaekf_test(server/session/sample_rate_test.cc DEPS metaekf::server_session)
metaekf_test(server/session/crowd_test.cc DEPS metaekf::server_session)
