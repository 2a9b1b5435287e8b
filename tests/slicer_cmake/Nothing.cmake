# Included where Slicer's own build system would have something to say.
