"""B-mode ultrasound simulated from a patient's MRI. The public interface is `SlicerUSSim.Logic`."""

from pathlib import Path

__version__ = "0.1.0"

# The `ussim` command (SlicerUSSim.cli, python -m SlicerUSSim) lives in a folder of its own: 3D Slicer runs every Python
# file beside SlicerUSSim.py when it looks for modules, and a __main__.py there would become Slicer's own main module.
if "__path__" in globals():  # not where Slicer tries this file
    __path__.append(str(Path(__file__).parent / "Command"))
