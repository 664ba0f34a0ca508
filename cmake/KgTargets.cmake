# Compiler settings every target of this project shares. Nothing here leaks to users of the library.
option(KG_SANITIZE "Address and undefined-behaviour sanitizers" OFF)

function(kg_set_options target)
  set_target_properties(${target} PROPERTIES
    C_STANDARD 11 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF
    CXX_STANDARD 17 CXX_STANDARD_REQUIRED ON CXX_EXTENSIONS OFF)
  target_compile_options(${target} PRIVATE
    -Wall -Wextra -Wpedantic
    $<$<COMPILE_LANGUAGE:C>:-Wconversion -Wshadow -Wstrict-prototypes -Wmissing-prototypes>
    # the result must not depend on whether the compiler fuses a*b+c (bit-equal output files)
    -ffp-contract=off)
  target_compile_definitions(${target} PRIVATE _POSIX_C_SOURCE=200809L)
  if(KG_BUILD_FUZZERS) # what the fuzzer steers by
    target_compile_options(${target} PRIVATE -fsanitize=fuzzer-no-link)
    target_link_options(${target} PUBLIC -fsanitize=fuzzer-no-link)
  endif()
  if(KG_SANITIZE)
    target_compile_options(${target} PRIVATE -fsanitize=address,undefined -fno-sanitize-recover=all)
    target_link_options(${target} PUBLIC -fsanitize=address,undefined)
  endif()
endfunction()

# Kernels: objects compiled for one arithmetic and instruction set, beside the library's other objects
# because an object library hands on only what it compiles itself. Without contraction into fused
# multiply-adds (kg_set_options) every instruction set rounds alike. ARGN: options.
#   part: engine, physics or sdf; property KG_PART_KERNEL_OBJECTS lists the objects
function(kg_add_kernel_object part name source)
  add_library(${name} OBJECT ${source})
  kg_set_options(${name})
  target_compile_options(${name} PRIVATE
    $<IF:$<BOOL:${KG_SANITIZE}>,-O1,-O3> -fno-math-errno -fno-trapping-math
    -Wno-psabi # vectors are passed between inlined functions only
    ${ARGN})
  set_target_properties(${name} PROPERTIES POSITION_INDEPENDENT_CODE ON C_VISIBILITY_PRESET hidden)
  target_include_directories(${name} PRIVATE ${PROJECT_SOURCE_DIR}/include ${PROJECT_SOURCE_DIR})
  string(TOUPPER ${part} part)
  set_property(GLOBAL APPEND PROPERTY KG_${part}_KERNEL_OBJECTS $<TARGET_OBJECTS:${name}>)
endfunction()
