# Stands in for find_package(Slicer): records what the project asks of Slicer's build system, and lays files out as
# CMake/SlicerMacroBuildScriptedModule.cmake of Slicer and CMake/ctkMacroCompilePythonScript.cmake of CTK do: copied into
# the build tree's module folder at their paths relative to the source folder, below a folder of that folder's name with
# WITH_SUBDIR; and what then is in the build tree's folder, whatever put it there, is installed.

set(Slicer_USE_FILE "${CMAKE_CURRENT_LIST_DIR}/Nothing.cmake")
set(Slicer_EXTENSION_GENERATE_CONFIG "${CMAKE_CURRENT_LIST_DIR}/Nothing.cmake")
set(Slicer_EXTENSION_CPACK "${CMAKE_CURRENT_LIST_DIR}/Record.cmake")
set(Slicer_QTSCRIPTEDMODULES_LIB_DIR "lib/Slicer-5.10/qt-scripted-modules")
set(Slicer_INSTALL_QTSCRIPTEDMODULES_LIB_DIR "lib/Slicer-5.10/qt-scripted-modules")
set(RECORD "${CMAKE_BINARY_DIR}/record.txt")
file(WRITE "${RECORD}" "")

macro(slicerMacroBuildScriptedModule)
  cmake_parse_arguments(MY "WITH_GENERIC_TESTS;WITH_SUBDIR;VERBOSE" "NAME" "SCRIPTS;RESOURCES" ${ARGN})
  if(MY_UNPARSED_ARGUMENTS)
    message(FATAL_ERROR "Unknown keywords given to slicerMacroBuildScriptedModule(): ${MY_UNPARSED_ARGUMENTS}")
  endif()
  if(NOT MY_NAME OR NOT MY_SCRIPTS)
    message(FATAL_ERROR "slicerMacroBuildScriptedModule() needs NAME and SCRIPTS")
  endif()
  file(APPEND "${RECORD}" "NAME ${MY_NAME}\n")
  set(my_folder "${CMAKE_BINARY_DIR}/${Slicer_QTSCRIPTEDMODULES_LIB_DIR}")
  set(my_installed "${my_folder}/")
  if(MY_WITH_SUBDIR)
    get_filename_component(my_name "${CMAKE_CURRENT_SOURCE_DIR}" NAME)
    set(my_folder "${my_folder}/${my_name}")
    set(my_installed "${my_folder}")
  endif()
  set(my_copies "")
  foreach(kind SCRIPTS RESOURCES)
    foreach(path IN LISTS MY_${kind})
      if(NOT EXISTS "${CMAKE_CURRENT_SOURCE_DIR}/${path}")
        message(FATAL_ERROR "slicerMacroBuildScriptedModule(${kind}) given nonexistent file '${path}'")
      endif()
      add_custom_command(
        OUTPUT "${my_folder}/${path}"
        COMMAND ${CMAKE_COMMAND} -E copy "${CMAKE_CURRENT_SOURCE_DIR}/${path}" "${my_folder}/${path}"
        DEPENDS "${CMAKE_CURRENT_SOURCE_DIR}/${path}"
        )
      list(APPEND my_copies "${my_folder}/${path}")
    endforeach()
  endforeach()
  add_custom_target(Copy${MY_NAME} ALL DEPENDS ${my_copies})
  install(DIRECTORY "${my_installed}" DESTINATION "${Slicer_INSTALL_QTSCRIPTEDMODULES_LIB_DIR}")
endmacro()

macro(slicer_add_python_unittest)
  cmake_parse_arguments(MY "" "SCRIPT" "SLICER_ARGS" ${ARGN})
  file(APPEND "${RECORD}" "TEST ${MY_SCRIPT}\n")
endmacro()
