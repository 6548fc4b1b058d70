metaekf_test(core/nssm/linearise_test.cc DEPS metaekf::core_nssm)
metaekf_test(core/nssm/loss_test.cc DEPS metaekf::core_nssm)
metaekf_test(core/nssm/model_file_test.cc DEPS metaekf::core_nssm)
metaekf_test(core/nssm/predict_test.cc DEPS metaekf::core_filter)
