# One library per folder, one line per test: the only helpers the build files use.

add_library(metaekf_warnings INTERFACE)
target_compile_options(metaekf_warnings INTERFACE
  -Wall -Wextra -Werror -Wshadow -Wnon-virtual-dtor -Wno-missing-field-initializers
  $<$<CXX_COMPILER_ID:GNU>:-Wno-restrict -Wno-stringop-overflow>)  # g++ 12 sees overlaps and overflows in string assignments (GCC bug 105329)

# Headers that most files include are read once: to read them is a third of the build.
# metaekf_headers(name HEADERS <Eigen/Dense> … DEPS Eigen3::Eigen …) makes a target for others to reuse the headers of.
function(metaekf_headers name)
  cmake_parse_arguments(ARG "" "" "HEADERS;DEPS" ${ARGN})
  file(CONFIGURE OUTPUT ${CMAKE_CURRENT_BINARY_DIR}/${name}.cc CONTENT "// A target of headers alone wants a source file.\n")
  add_library(${name} OBJECT ${CMAKE_CURRENT_BINARY_DIR}/${name}.cc)
  target_link_libraries(${name} PRIVATE ${ARG_DEPS})
  target_precompile_headers(${name} PRIVATE ${ARG_HEADERS})
endfunction()

set(METAEKF_COMMON_HEADERS
  <algorithm> <cmath> <cstdint> <functional> <map> <memory> <optional> <set> <string> <utility> <vector>
  <Eigen/Dense> <absl/status/status.h> <absl/status/statusor.h> <absl/strings/str_cat.h>)

# metaekf_library(core_filter SOURCES a.cc b.cc DEPS metaekf::core_base Eigen3::Eigen)
# makes target metaekf_core_filter with alias metaekf::core_filter. HEADERS: precompiled ones of its own.
function(metaekf_library name)
  cmake_parse_arguments(ARG "" "" "SOURCES;DEPS;PRIVATE_DEPS;HEADERS" ${ARGN})
  add_library(metaekf_${name} STATIC ${ARG_SOURCES})
  add_library(metaekf::${name} ALIAS metaekf_${name})
  target_include_directories(metaekf_${name} PUBLIC ${PROJECT_SOURCE_DIR})
  target_link_libraries(metaekf_${name} PUBLIC ${ARG_DEPS} PRIVATE ${ARG_PRIVATE_DEPS} metaekf_warnings)
  if(ARG_HEADERS)
    target_precompile_headers(metaekf_${name} PRIVATE ${ARG_HEADERS})
  else()
    target_precompile_headers(metaekf_${name} REUSE_FROM metaekf_common_headers)
  endif()
endfunction()

# metaekf_test(core/filter/ekf_test.cc DEPS metaekf::core_filter LABELS slow)
# makes and registers the test core.filter.ekf_test.
function(metaekf_test source)
  cmake_parse_arguments(ARG "" "TIMEOUT" "DEPS;LABELS" ${ARGN})
  string(REGEX REPLACE "\\.cc$" "" name ${source})
  string(REPLACE "/" "." name ${name})
  add_executable(${name} ${source})
  target_link_libraries(${name} PRIVATE ${ARG_DEPS} GTest::gmock GTest::gtest_main metaekf_warnings)
  target_precompile_headers(${name} REUSE_FROM metaekf_test_headers)
  target_compile_options(${name} PRIVATE ${METAEKF_TEST_OPTIONS})
  set_target_properties(${name} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  add_test(NAME ${name} COMMAND ${name})
  if(NOT ARG_TIMEOUT)
    set(ARG_TIMEOUT 120)
  endif()
  if(CMAKE_CXX_FLAGS MATCHES "-fsanitize")
    math(EXPR ARG_TIMEOUT "10 * ${ARG_TIMEOUT}")
  endif()
  # Files of its own, or two presets' tests could not run at the same time.
  set(directory ${CMAKE_BINARY_DIR}/tests/tmp/${name})
  file(MAKE_DIRECTORY ${directory})
  set_tests_properties(${name} PROPERTIES TIMEOUT ${ARG_TIMEOUT} LABELS "${ARG_LABELS}" ENVIRONMENT TEST_TMPDIR=${directory})
  if("slow" IN_LIST ARG_LABELS)
    set_tests_properties(${name} PROPERTIES COST 1000)  # they begin first, so that none is left to run alone
  endif()
endfunction()
