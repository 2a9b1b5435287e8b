"""The same model in plain numpy, stage by stage: what the kernels are checked and timed against.

Written from the same equations, in float32 and in the kernels' order of operations where a rounding decides between two
branches of a ray or two tissues of a scatterer. It is some hundred times slower.
"""

from SlicerUSSim.Logic.verification.numpy_model.model import NumpyModel

__all__ = ["NumpyModel"]
