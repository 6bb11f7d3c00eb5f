# The kernel texts as host C++: a second platform, and the one that sanitizers see. Sets host_kernels to the sources.
add_executable(host_kernel_generator ${CMAKE_CURRENT_LIST_DIR}/host_kernel_generator.cpp)
target_link_libraries(host_kernel_generator PRIVATE optim)
foreach(precision double single)
  set(source ${CMAKE_CURRENT_BINARY_DIR}/host_kernels_${precision}.cpp)
  add_custom_command(OUTPUT ${source} COMMAND host_kernel_generator ${precision} ${source}
                     DEPENDS host_kernel_generator)
  list(APPEND host_kernels ${source})
endforeach()
# OpenCL C casts as C does. No contraction: the host's rounding is the standard's.
set_source_files_properties(${host_kernels} PROPERTIES COMPILE_OPTIONS "-w;-ffp-contract=off")
if(CMAKE_CXX_COMPILER_ID STREQUAL Clang)
  set(single_constants -Xclang -cl-single-precision-constant)  # clang knows it as OpenCL's option only
else()
  set(single_constants -fsingle-precision-constant)
endif()
set_property(SOURCE ${CMAKE_CURRENT_BINARY_DIR}/host_kernels_single.cpp
             APPEND PROPERTY COMPILE_OPTIONS ${single_constants})
