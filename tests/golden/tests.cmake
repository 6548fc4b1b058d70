metaekf_test(golden/golden_test.cc DEPS metaekf::core_meta)
target_compile_definitions(golden.golden_test PRIVATE METAEKF_SOURCE_DIR="${PROJECT_SOURCE_DIR}")
