metaekf_test(core/experiments/filter_run_test.cc DEPS metaekf::core_experiments metaekf::core_test_support)
metaekf_test(core/experiments/localization_data_test.cc DEPS metaekf::core_experiments)
metaekf_test(core/experiments/table_test.cc DEPS metaekf::core_experiments)
metaekf_test(core/experiments/experiment_test.cc LABELS slow DEPS metaekf::core_experiments TIMEOUT 600)
