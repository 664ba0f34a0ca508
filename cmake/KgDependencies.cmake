# What the library links: OpenBLAS (its serial build, by name: other BLAS alternatives may be the
# system's default), Ceres and OpenMesh. kg_dependencies carries them to our own targets.
find_library(KG_OPENBLAS openblas
  PATH_SUFFIXES openblas-serial openblas-openmp openblas-pthread
  PATHS /usr/lib/${CMAKE_LIBRARY_ARCHITECTURE}/openblas-serial
  NO_CMAKE_FIND_ROOT_PATH)
if(NOT KG_OPENBLAS)
  message(FATAL_ERROR "OpenBLAS not found; on Debian: apt-get install libopenblas-serial-dev")
endif()
find_package(Ceres 2.1 REQUIRED)
find_library(KG_OPENMESH OpenMeshCore REQUIRED)
find_path(KG_OPENMESH_INCLUDE OpenMesh/Core/Mesh/TriMesh_ArrayKernelT.hh REQUIRED)

add_library(kg_dependencies INTERFACE)
target_include_directories(kg_dependencies SYSTEM INTERFACE ${KG_OPENMESH_INCLUDE})
target_link_libraries(kg_dependencies INTERFACE ${KG_OPENBLAS} Ceres::ceres ${KG_OPENMESH})

# plain names for users of the static library
set(KG_STATIC_LIBRARIES openblas ceres OpenMeshCore stdc++)
