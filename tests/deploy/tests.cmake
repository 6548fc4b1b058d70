metaekf_test(deploy/zoo_test.cc LABELS slow TIMEOUT 600 DEPS metaekf::core_experiments metaekf::core_meta metaekf::core_sim)
target_compile_definitions(deploy.zoo_test PRIVATE METAEKF_SOURCE_DIR="${PROJECT_SOURCE_DIR}")
metaekf_test(deploy/specs_test.cc DEPS metaekf::server_convert)
target_compile_definitions(deploy.specs_test PRIVATE METAEKF_SOURCE_DIR="${PROJECT_SOURCE_DIR}")
