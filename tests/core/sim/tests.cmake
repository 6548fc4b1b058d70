metaekf_test(core/sim/bouc_wen_test.cc DEPS metaekf::core_sim)
target_compile_definitions(core.sim.bouc_wen_test
  PRIVATE METAEKF_SOURCE_DIR="${PROJECT_SOURCE_DIR}")
metaekf_test(core/sim/fourier_test.cc DEPS metaekf::core_sim)
metaekf_test(core/sim/runge_kutta_test.cc DEPS metaekf::core_sim)
metaekf_test(core/sim/signal_test.cc DEPS metaekf::core_sim)
metaekf_test(core/sim/simulate_test.cc DEPS metaekf::core_sim)
metaekf_test(core/sim/system_test.cc DEPS metaekf::core_sim)
metaekf_test(core/sim/van_der_pol_test.cc DEPS metaekf::core_sim)
