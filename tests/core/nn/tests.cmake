metaekf_test(core/nn/block_test.cc DEPS metaekf::core_nn)
metaekf_test(core/nn/parameters_test.cc DEPS metaekf::core_nn)
