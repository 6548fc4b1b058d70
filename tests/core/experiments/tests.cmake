metaekf_test(core/experiments/table_test.cc DEPS metaekf::core_experiments)
metaekf_test(core/experiments/experiment_test.cc DEPS metaekf::core_experiments TIMEOUT 600)
