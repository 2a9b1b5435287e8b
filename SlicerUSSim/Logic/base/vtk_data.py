"""Conversion of matrices and voxels between numpy and VTK."""

from __future__ import annotations

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkCommonMath import vtkMatrix4x4


def matrix_array(matrix: vtkMatrix4x4) -> np.ndarray:
    """(4, 4) float64 copy of a vtkMatrix4x4."""
    return np.array(matrix.GetData()).reshape(4, 4)


def vtk_matrix(array: np.ndarray) -> vtkMatrix4x4:
    """A vtkMatrix4x4 of a (4, 4) array."""
    matrix = vtkMatrix4x4()
    matrix.DeepCopy(np.asarray(array, float).ravel().tolist())
    return matrix


def set_scalars(image: vtkImageData, array: np.ndarray) -> None:
    """Set the voxels of `image` to a copy of a (k, j, i) or (..., j, i, components) array."""
    components = array.size // image.GetNumberOfPoints()
    scalars = numpy_to_vtk(np.ascontiguousarray(array).reshape(-1, components).squeeze(), deep=True)
    scalars.SetName("ImageScalars")
    image.GetPointData().SetScalars(scalars)
