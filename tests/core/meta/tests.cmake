metaekf_test(core/meta/meta_gradient_test.cc DEPS metaekf::core_meta)
