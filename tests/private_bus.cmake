# add_private_bus_test(NAME COMMAND program [argument…])
# A CTest that runs alone on an LCM bus of its own (tests/private_bus.sh), so that tests may run in
# parallel. Skipped where namespaces are not allowed.
set(PRIVATE_BUS ${CMAKE_CURRENT_LIST_DIR}/private_bus.sh)

function(add_private_bus_test name)
  cmake_parse_arguments(PARSE_ARGV 1 arg "" "" "COMMAND")
  if(NOT arg_COMMAND)
    message(FATAL_ERROR "add_private_bus_test(${name}): COMMAND is missing")
  endif()
  list(POP_FRONT arg_COMMAND program)
  if(TARGET ${program})
    set(program $<TARGET_FILE:${program}>)
  endif()
  add_test(NAME ${name} COMMAND ${PRIVATE_BUS} ${program} ${arg_COMMAND})
  set_tests_properties(${name} PROPERTIES SKIP_RETURN_CODE 77 TIMEOUT 120)
endfunction()
