metaekf_test(core/data/csv_test.cc DEPS metaekf::core_data)
metaekf_test(core/data/csv_rows_test.cc DEPS metaekf::core_data)
metaekf_test(core/data/even_time_test.cc DEPS metaekf::core_data)
metaekf_test(core/data/normaliser_test.cc DEPS metaekf::core_data)
metaekf_test(core/data/split_test.cc DEPS metaekf::core_data)

metaekf_test(core/plot/axis_test.cc DEPS metaekf::core_plot)
metaekf_test(core/plot/decimate_test.cc DEPS metaekf::core_plot)
metaekf_test(core/plot/svg_test.cc DEPS metaekf::core_plot)
