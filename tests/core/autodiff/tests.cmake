metaekf_test(core/autodiff/activation_test.cc DEPS metaekf::core_autodiff)
metaekf_test(core/autodiff/differentiate_test.cc DEPS metaekf::core_autodiff metaekf::core_base)
metaekf_test(core/autodiff/compile_test.cc DEPS metaekf::core_autodiff metaekf::core_base)
metaekf_test(core/autodiff/swish_theorem_test.cc DEPS metaekf::core_autodiff)
