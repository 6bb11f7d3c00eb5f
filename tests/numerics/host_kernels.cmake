# The kernel texts as host C++: a second platform, and the one that sanitizers see.
if(NOT TARGET host_kernel_generator)
  add_executable(host_kernel_generator ${CMAKE_CURRENT_LIST_DIR}/host_kernel_generator.cpp)
  target_link_libraries(host_kernel_generator PRIVATE kernels)
endif()

# host_kernels(VARIABLE DOUBLES FLOATS OPTION...): sets the variable to the sources, of so many lanes in each precision,
# which are compiled with these options.
function(host_kernels variable doubles floats)
  set(sources)
  foreach(precision double single)
    set(source ${CMAKE_CURRENT_BINARY_DIR}/host_kernels_${precision}.cpp)
    set(lanes ${doubles})
    set(options -w ${ARGN})  # OpenCL C casts as C does
    if(precision STREQUAL single)
      set(lanes ${floats})
      if(CMAKE_CXX_COMPILER_ID STREQUAL Clang)
        list(APPEND options -Xclang -cl-single-precision-constant)  # clang knows it as OpenCL's option only
      else()
        list(APPEND options -fsingle-precision-constant)
      endif()
    endif()
    add_custom_command(OUTPUT ${source} COMMAND host_kernel_generator ${precision} ${lanes} ${source}
                       DEPENDS host_kernel_generator)
    set_source_files_properties(${source} PROPERTIES COMPILE_OPTIONS "${options}")
    list(APPEND sources ${source})
  endforeach()
  set(${variable} ${sources} PARENT_SCOPE)
endfunction()
