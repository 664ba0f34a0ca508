# Install tree: libraries, headers, find_package() and pkg-config files. It can be moved as a whole.
set(KG_CONFIG_FOLDER ${CMAKE_INSTALL_LIBDIR}/cmake/kinegrad)

install(TARGETS kinegrad kinegrad_static kinegrad_autodiff EXPORT kinegradTargets)
install(DIRECTORY include/kinegrad DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(EXPORT kinegradTargets NAMESPACE kinegrad:: DESTINATION ${KG_CONFIG_FOLDER})

configure_package_config_file(cmake/kinegradConfig.cmake.in kinegradConfig.cmake
  INSTALL_DESTINATION ${KG_CONFIG_FOLDER})
write_basic_package_version_file(kinegradConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/kinegradConfig.cmake
  ${PROJECT_BINARY_DIR}/kinegradConfigVersion.cmake DESTINATION ${KG_CONFIG_FOLDER})

file(RELATIVE_PATH KG_PC_TO_PREFIX /${CMAKE_INSTALL_LIBDIR}/pkgconfig /)
foreach(pc kinegrad kinegrad_autodiff)
  configure_file(cmake/${pc}.pc.in ${pc}.pc @ONLY)
  install(FILES ${PROJECT_BINARY_DIR}/${pc}.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig)
endforeach()
install(DIRECTORY docs DESTINATION ${CMAKE_INSTALL_DOCDIR})
install(DIRECTORY examples DESTINATION ${CMAKE_INSTALL_DOCDIR} FILES_MATCHING PATTERN "*.c")
install(FILES README.md LICENSE CHANGELOG.md CONTRIBUTING.md DESTINATION ${CMAKE_INSTALL_DOCDIR})
