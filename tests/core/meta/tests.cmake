metaekf_test(core/meta/arx_test.cc DEPS metaekf::core_meta)
metaekf_test(core/meta/meta_gradient_test.cc DEPS metaekf::core_meta)
metaekf_test(core/meta/train_test.cc DEPS metaekf::core_meta)
metaekf_test(core/meta/meta_memory_test.cc DEPS metaekf::core_meta)
