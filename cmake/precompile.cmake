# Precompiled headers: one for the programs and their libraries, one for the tests. CMake compiles them
# once; every target below a folder reads one of them.

# precompiled_header(NAME HEADER LIBRARIES…)
function(precompiled_header name header)
  file(WRITE ${CMAKE_CURRENT_BINARY_DIR}/${name}.cpp "")
  add_library(${name} OBJECT ${CMAKE_CURRENT_BINARY_DIR}/${name}.cpp)
  target_include_directories(${name} PRIVATE ${PROJECT_SOURCE_DIR})
  target_link_libraries(${name} PRIVATE ${ARGN})
  target_precompile_headers(${name} PRIVATE ${header})
endfunction()

# reuse_precompiled_header(FOLDER NAME [LIBRARY]): in all targets of the folder and those below it, but for those with
# a header already, those with compile options of their own, which need a header of their own, and those that do not
# link LIBRARY.
function(reuse_precompiled_header folder name)
  get_property(targets DIRECTORY ${folder} PROPERTY BUILDSYSTEM_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(type ${target} TYPE)
    get_target_property(options ${target} COMPILE_OPTIONS)
    get_target_property(header ${target} PRECOMPILE_HEADERS)
    get_target_property(reused ${target} PRECOMPILE_HEADERS_REUSE_FROM)
    get_directory_property(common_options DIRECTORY ${folder} COMPILE_OPTIONS)
    get_target_property(libraries ${target} LINK_LIBRARIES)
    if(ARGN AND NOT libraries MATCHES "${ARGN}")
      continue()
    endif()
    if(type MATCHES "^(STATIC_LIBRARY|EXECUTABLE)$" AND NOT header AND NOT reused AND options STREQUAL common_options)
      target_precompile_headers(${target} REUSE_FROM ${name})
    endif()
  endforeach()
  get_property(folders DIRECTORY ${folder} PROPERTY SUBDIRECTORIES)
  foreach(below IN LISTS folders)
    reuse_precompiled_header(${below} ${name} ${ARGN})
  endforeach()
endfunction()
