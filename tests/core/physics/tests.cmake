metaekf_test(core/physics/polyhedron_test.cc DEPS metaekf::core_physics metaekf::core_linalg)
metaekf_test(core/physics/projection_test.cc DEPS metaekf::core_physics)
metaekf_test(core/physics/polyhedral_layer_test.cc DEPS metaekf::core_physics)

# An independent oracle, where it is installed.
find_library(CDD_LIBRARY cdd)
if(CDD_LIBRARY)
  metaekf_test(core/physics/polyhedron_cdd_test.cc DEPS metaekf::core_physics ${CDD_LIBRARY})
endif()
