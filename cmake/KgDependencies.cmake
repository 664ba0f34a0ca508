# What the library links: OpenBLAS (its serial build, by path: the system's libblas may be another,
# and its threads are not ours), Ceres and OpenMesh. kg_dependencies carries them to our own targets.
find_library(KG_OPENBLAS openblas PATHS /usr/lib/${CMAKE_LIBRARY_ARCHITECTURE}/openblas-serial
  NO_DEFAULT_PATH DOC "OpenBLAS, serial build")
find_library(KG_OPENBLAS openblas)
if(NOT KG_OPENBLAS)
  message(FATAL_ERROR "OpenBLAS not found; on Debian: apt-get install libopenblas-serial-dev")
elseif(NOT KG_OPENBLAS MATCHES "openblas-serial")
  message(WARNING "${KG_OPENBLAS} may run threads of its own; libopenblas-serial-dev is preferred")
endif()
find_package(Ceres 2.1 REQUIRED)
find_library(KG_OPENMESH OpenMeshCore REQUIRED)
find_path(KG_OPENMESH_INCLUDE OpenMesh/Core/Mesh/TriMesh_ArrayKernelT.hh REQUIRED)

add_library(kg_dependencies INTERFACE)
target_include_directories(kg_dependencies SYSTEM INTERFACE ${KG_OPENMESH_INCLUDE})
target_link_libraries(kg_dependencies INTERFACE ${KG_OPENBLAS} Ceres::ceres ${KG_OPENMESH} m)

# The libraries carry libopenblas.so.0 by name; this path makes it the serial one at run time too.
get_filename_component(KG_OPENBLAS_FOLDER ${KG_OPENBLAS} DIRECTORY)
set(CMAKE_INSTALL_RPATH ${KG_OPENBLAS_FOLDER})

# For users of the installed static library: cmake/kinegradConfig.cmake.in finds the same by name.
set(KG_STATIC_LIBRARIES openblas ceres glog OpenMeshCore stdc++ m)
list(TRANSFORM KG_STATIC_LIBRARIES PREPEND "-l" OUTPUT_VARIABLE KG_PC_PRIVATE)
list(JOIN KG_PC_PRIVATE " " KG_PC_PRIVATE)
