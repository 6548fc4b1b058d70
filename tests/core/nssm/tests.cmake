metaekf_test(core/nssm/loss_test.cc DEPS metaekf::core_nssm)
