"""The same model in plain numpy, stage by stage: what the kernels are checked and timed against.

Written from the equations of docs/physics.md, in float32 and in the kernels' order of operations where a rounding
decides between two branches of a ray or two tissues of a scatterer. It is some hundred times slower.

It computes everything itself from what a user gives: label map, tissue table, settings, fields of the probe, pose,
display. So a wrong value in the simulator's record, lines, pulse or medium shows as a wrong image. What it shares with
the simulator, and what therefore only `ussim validate` checks against theory:

- the equations themselves, with their hashes, polynomials and the lattice of scatterers;
- the names and number formats of layout.py, the block of samples over which widths are taken as linear, and
  settings.FULL_SCALE_DB;
- the names and the order of the stages (imaging/stages.py), and the pixels of an image (ImageGrid);
- no texture: hybrid scatterers are checked in tests/test_texture.py.
"""

from SlicerUSSim.Logic.verification.numpy_model.model import NumpyModel

__all__ = ["NumpyModel"]
