# In the place of Slicer's packaging: what the extension says about itself.
foreach(name HOMEPAGE CATEGORY CONTRIBUTORS DESCRIPTION ICONURL SCREENSHOTURLS LICENSE_FILE README_FILE DEPENDS)
  file(APPEND "${RECORD}" "EXTENSION_${name} ${EXTENSION_${name}}\n")
endforeach()
