"""Surfels as a surface file that 3D Slicer and ParaView show: a small square for each."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import messages_withheld, written_whole
from SlicerUSSim.Logic.base.reading import in_child
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS
from SlicerUSSim.Logic.tissue.surfels import KINDS, Surfels

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

#: Colours of the kinds, 0 to 255
COLOURS = ((255, 140, 26), (0, 229, 255), (77, 107, 255), (57, 230, 57))


def require_surfel_file(path: str | os.PathLike) -> None:
    """Raise SimulationError unless surfels can be written under this name."""
    require(
        Path(path).suffix.lower() == ".vtp", f"{path}: sheets are written as a VTK surface, expected a name with .vtp"
    )


def write_surfels(path: str | os.PathLike, surfels: Surfels) -> None:
    """Write a .vtp, which read_surfels reads and Slicer shows in RAS.

    Raises SimulationError for another suffix, and if the file cannot be written.
    """
    require_surfel_file(path)
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(as_polydata(surfels))
    with written_whole(path) as partial, messages_withheld():
        writer.SetFileName(str(partial))
        # On a full disk VTK writes a part of the file, and says that it has written it.
        if writer.Write() != 1 or not _has_end(partial):
            raise OSError("not all of it is in the file; is the disk full?")


def _has_end(path: Path) -> bool:
    """Whether a .vtp is complete."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 64, 0))
        return b"</VTKFile>" in file.read()


def as_polydata(surfels: Surfels) -> vtkPolyData:
    """A square of its area for each surfel, with every entry as an array of the cells."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    count = len(surfels)
    first = np.cross(surfels.normal, np.eye(3, dtype=np.float32)[np.abs(surfels.normal).argmin(axis=1)])
    first = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    second = np.cross(surfels.normal, first)
    half = (0.5 * np.sqrt(surfels.area))[:, None]
    corners = [surfels.place + half * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.stack(corners, 1).reshape(-1, 3), deep=1))
    cells = vtkCellArray()
    offsets, places = np.arange(0, 4 * count + 1, 4), np.arange(4 * count)
    cells.SetData(*(numpy_to_vtkIdTypeArray(array.astype(np.int64), deep=1) for array in (offsets, places)))
    result = vtkPolyData()
    result.SetPoints(points)
    result.SetPolys(cells)
    for entry in fields(surfels):
        array = numpy_to_vtk(np.ascontiguousarray(getattr(surfels, entry.name)), deep=1)
        array.SetName(entry.name)
        result.GetCellData().AddArray(array)
    colours = numpy_to_vtk(np.repeat(np.array(COLOURS, np.uint8)[surfels.kind], 4, axis=0), deep=1)
    colours.SetName("colour")
    result.GetPointData().AddArray(colours)
    result.GetPointData().SetActiveScalars("colour")
    # SPACE is what Slicer looks for; without it, it takes a file to be in LPS.
    for name, texts in (("SPACE", ["RAS"]), ("kinds", KINDS)):
        strings = vtkStringArray()
        strings.SetName(name)
        for text in texts:
            strings.InsertNextValue(text)
        result.GetFieldData().AddArray(strings)
    return result


@in_child  # VTK ends the process for some damaged files
def read_surfels(path: str | os.PathLike) -> Surfels:
    """The surfels of a .vtp by write_surfels, where its squares are. Raises SimulationError for other files."""
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    require(Path(path).is_file(), f"{path}: no such file")
    require(Path(path).suffix.lower() == ".vtp", f"{path}: expected a .vtp that `ussim segment --sheets` has written")
    file = vtkXMLPolyDataReader()
    with messages_withheld():
        require(file.CanReadFile(str(path)) == 1, f"{path}: is not a VTK surface")
        require(_has_end(Path(path)), f"{path}: is incomplete; copy or write it again")
        file.SetFileName(str(path))
        file.Update()
        require(file.GetErrorCode() == 0, f"{path}: is damaged; copy or write it again")
        return placed_surfels(file.GetOutput(), str(path))


def surfels_of(data: vtkPolyData, source: str) -> Surfels:
    """The surfels of a surface by as_polydata, as its arrays have them, called `source` in errors.

    Raises SimulationError for another surface.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    arrays = []
    for entry in fields(Surfels):
        array = data.GetCellData().GetArray(entry.name)
        require(
            array is not None,
            f"{source}: has no array {entry.name!r} of its cells, expected a file of `ussim segment --sheets`",
        )
        kind = np.uint8 if entry.name == "kind" else np.float32
        arrays.append(np.array(vtk_to_numpy(array), kind))
    return Surfels(*arrays)


def placed_surfels(data: vtkPolyData, source: str, to_ras: np.ndarray | None = None) -> Surfels:
    """The surfels of a surface by as_polydata, where its squares are after a (4, 4) linear transform.

    Other programs move squares and leave the arrays as they were. What is in a sheet grows by its volume, and the
    thickness with it. Squares without area are left out. Without `to_ras`, the surface is in the frame that it states.
    Raises SimulationError as surfels_of does, and for cells other than squares.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    surfels = surfels_of(data, source)
    if not len(surfels):
        return surfels
    if to_ras is None:
        space = data.GetFieldData().GetAbstractArray("SPACE")
        # As Slicer writes a model
        to_ras = LPS_TO_RAS if space is not None and space.GetValue(0) == "LPS" else np.eye(4)
    squares = np.asarray(vtk_to_numpy(data.GetPolys().GetConnectivityArray()), np.int64)
    count = data.GetNumberOfPoints()
    require(
        len(squares) == 4 * len(surfels) and squares.min() >= 0 and squares.max() < count,
        f"{source} has cells that are not squares, expected a model of `ussim segment --sheets`",
    )
    corners = (
        vtk_to_numpy(data.GetPoints().GetData())[squares].reshape(-1, 4, 3).astype(float) @ to_ras[:3, :3].T
        + to_ras[:3, 3]
    )
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    volume = abs(float(np.linalg.det(to_ras[:3, :3])))
    is_whole = (area > 1e-9) & (surfels.area > 1e-9)
    thickness = surfels.thickness[is_whole] * volume * surfels.area[is_whole] / area[is_whole]
    chosen = surfels.chosen(is_whole)
    return Surfels(
        corners[is_whole].mean(axis=1).astype(np.float32),
        (normal[is_whole] / area[is_whole, None]).astype(np.float32),
        thickness.astype(np.float32), chosen.confidence, area[is_whole].astype(np.float32), chosen.kind,
    )  # fmt: skip
