metaekf_test(server/status/grpc_status_test.cc DEPS metaekf::server_status metaekf::proto_messages)
metaekf_test(server/status/text_test.cc DEPS metaekf::server_status)
