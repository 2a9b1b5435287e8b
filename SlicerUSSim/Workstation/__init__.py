"""The workstation in the browser: Slicer's scene and views by trame-slicer, driven by the presenter of the panel."""
