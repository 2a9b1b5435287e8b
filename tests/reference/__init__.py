"""The same model in plain numpy, stage by stage, as a reference for results and times of the kernels.

Written from the equations of docs/physics.md. It uses float32 and the kernels' order of operations where rounding
decides between two branches of a ray or two tissues of a scatterer. It is some hundred times slower.

It computes everything from the user's inputs: label map, tissue table, settings, fields of the probe, pose, display. A
wrong value in the simulator's record, lines, pulse or medium is therefore visible as a wrong image. The following is
shared with the simulator, and therefore only checked against theory by `python -m validation`:

- the equations themselves, with their hashes, polynomials and the lattice of scatterers;
- the names and number formats of layout.py, the block of samples with linear interpolation of widths, and
  settings.FULL_SCALE_DB;
- the names and the order of the stages (imaging/stages.py), and the pixels of an image (ImageGrid);
- no texture: hybrid scatterers are checked in tests/test_texture.py.
"""

from tests.reference.model import NumpyModel

__all__ = ["NumpyModel"]
