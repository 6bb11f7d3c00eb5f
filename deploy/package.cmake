# The Debian package: cpack -G DEB in the build folder.
include(GNUInstallDirs)
set(CMAKE_SKIP_INSTALL_ALL_DEPENDENCY TRUE)  # what is packed is built before; tests need not be
install(TARGETS brdfit RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR})
install(FILES deploy/brdfit.service DESTINATION lib/systemd/system)
install(FILES deploy/brdfit.default DESTINATION /etc/default RENAME brdfit)
install(FILES README.md CHANGELOG.md deploy/nginx.conf docs/api.md docs/deployment.md DESTINATION share/doc/brdfit)

set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_STRIP_FILES TRUE)
set(CPACK_PACKAGE_CONTACT "brdfit <root@localhost>")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "Fits reflectance models to BRDF measurements, over HTTP")
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SECTION science)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_DEPENDS "adduser, pocl-opencl-icd | opencl-icd")
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION TRUE)
set(CPACK_DEBIAN_PACKAGE_CONTROL_EXTRA
    "${PROJECT_SOURCE_DIR}/deploy/postinst;${PROJECT_SOURCE_DIR}/deploy/prerm;${PROJECT_SOURCE_DIR}/deploy/postrm;${PROJECT_SOURCE_DIR}/deploy/conffiles"
)
include(CPack)
