"""3D models of a probe: the outline of its imaged field, the field as a surface, and the probe's body."""

from __future__ import annotations

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkFiltersCore import vtkAppendPolyData, vtkPolyDataNormals

from SlicerUSSim.Logic.probe.arrays import Probe

#: Width of the housing around a face, and minimum half width and half thickness of the probe, mm.
_HOUSING_MM, _LEAST_HALF_WIDTH_MM, _HALF_THICKNESS_MM = 3.0, 9.0, 8.0
#: Sections of the handle: distance behind the face, half width, half thickness, mm.
_HANDLE = ((34.0, 14.0, 11.0), (86.0, 14.0, 11.0), (92.0, 11.0, 8.5))
#: Length over which the housing has the cross-section of the face, mm.
_STRAIGHT_MM = 16.0
#: The ridge that marks one side: start and end behind the face, half width, half thickness, mm.
_RIDGE = (5.0, 30.0, 2.6, 1.8)
_RING_POINTS = 48
#: Red, green, blue of the body and of its ridge
_BODY_COLOR, _RIDGE_COLOR = (209, 219, 230), (255, 158, 46)


def outline_polydata(probe: Probe) -> vtkPolyData:
    """The outline of the imaged field in the probe frame (mm), one closed line."""
    corners = probe.outline_mm()
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(corners), deep=True))
    lines = vtkCellArray()
    lines.InsertNextCell(len(corners), list(range(len(corners))))
    outline = vtkPolyData()
    outline.SetPoints(points)
    outline.SetLines(lines)
    return outline


def field_polydata(probe: Probe) -> vtkPolyData:
    """The imaged field in the probe frame (mm) as triangles, with texture coordinates for the image."""
    left, right, top, bottom = probe.image_bounds_mm()
    corners = probe.outline_mm()[:-1]
    half = len(corners) // 2  # first half along the face, second half back along the far end
    polydata = vtkPolyData()
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(corners), deep=True))
    polydata.SetPoints(points)
    strip = vtkCellArray()
    order = [corner for n in range(half) for corner in (n, len(corners) - 1 - n)]
    strip.InsertNextCell(len(order), order)
    polydata.SetStrips(strip)
    # The first row of a texture is the top row of the image.
    across, down = (corners[:, 0] - left) / (right - left), (corners[:, 1] - top) / (bottom - top)
    coordinates = numpy_to_vtk(np.stack([across, down], axis=1).astype(np.float32), deep=True)
    coordinates.SetName("TextureCoordinates")
    polydata.GetPointData().SetTCoords(coordinates)
    return polydata


def probe_polydata(probe: Probe) -> vtkPolyData:
    """A probe's body behind its face, in the probe frame (mm), with a ridge on the side that is left in the image.

    For display only; the simulation does not use it. Cell scalars "Color" are red, green and blue.
    """
    near = probe.outline_mm()[: len(probe.outline_mm()) // 2, 0]
    half_face = max(float(np.abs(near).max()) + _HOUSING_MM, _LEAST_HALF_WIDTH_MM)
    face = _ring(half_face, _HALF_THICKNESS_MM)
    if not (probe.has_flat_face and probe.apex_radius_mm > 0.0):
        radius = max(probe.apex_radius_mm, 1.5 * half_face)
        face[:, 1] = np.sqrt(radius**2 - face[:, 0] ** 2) - radius
    housing = _ring(half_face, _HALF_THICKNESS_MM) - [0.0, _STRAIGHT_MM, 0.0]
    handle = [_ring(width, thickness) - [0.0, behind, 0.0] for behind, width, thickness in _HANDLE]
    first, last, width, thickness = _RIDGE
    ridge = [_ring(width, thickness) - [half_face, behind, 0.0] for behind in (first, last)]
    joined = vtkAppendPolyData()
    joined.AddInputData(_lofted([face, housing, *handle], _BODY_COLOR))
    joined.AddInputData(_lofted(ridge, _RIDGE_COLOR))
    normals = vtkPolyDataNormals()
    normals.SetInputConnection(joined.GetOutputPort())
    normals.SetFeatureAngle(50.0)
    normals.AutoOrientNormalsOn()
    normals.Update()
    return normals.GetOutput()


def _ring(half_width: float, half_thickness: float) -> np.ndarray:
    """(points, 3) of a rounded rectangle perpendicular to the probe axis."""
    turn = np.linspace(0.0, 2 * np.pi, _RING_POINTS, endpoint=False)
    x, z = (np.sign(v) * np.sqrt(np.abs(v)) for v in (np.cos(turn), np.sin(turn)))
    return np.stack([half_width * x, 0.0 * x, half_thickness * z], axis=1)


def _lofted(rings: list[np.ndarray], color: tuple[int, int, int]) -> vtkPolyData:
    """Rings of (points, 3), joined by quadrilaterals and closed at both ends."""
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(np.concatenate(rings)), deep=True))
    numbers = np.arange(len(rings) * _RING_POINTS).reshape(len(rings), _RING_POINTS)
    after = np.roll(numbers, -1, axis=1)
    cells = vtkCellArray()
    for quadrilateral in np.stack([numbers[:-1], after[:-1], after[1:], numbers[1:]], axis=-1).reshape(-1, 4):
        cells.InsertNextCell(4, quadrilateral.tolist())
    opposite = -np.arange(_RING_POINTS // 2 + 1) % _RING_POINTS  # the point at the same x across the thickness
    for ring, turned_round in ((numbers[0], True), (numbers[-1], False)):
        near, far = ring[: _RING_POINTS // 2 + 1], ring[opposite]
        for strip in np.stack([near[:-1], near[1:], far[1:], far[:-1]], axis=-1):
            cells.InsertNextCell(4, (strip[::-1] if turned_round else strip).tolist())
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    polydata.SetPolys(cells)
    scalars = numpy_to_vtk(np.tile(np.array(color, np.uint8), (cells.GetNumberOfCells(), 1)), deep=True)
    scalars.SetName("Color")
    polydata.GetCellData().SetScalars(scalars)
    return polydata
