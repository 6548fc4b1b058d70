metaekf_test(core/filter/constrain_test.cc DEPS metaekf::core_filter)
metaekf_test(core/filter/ekf_test.cc DEPS metaekf::core_filter)
metaekf_test(core/filter/square_root_test.cc DEPS metaekf::core_filter)
