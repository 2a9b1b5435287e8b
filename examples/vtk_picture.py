"""From an MRI to a picture with VTK's own filters: python examples/vtk_picture.py MRI OUT.png"""

from __future__ import annotations

import sys

from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkImagingCore import vtkImageChangeInformation, vtkImageFlip
from vtkmodules.vtkIOImage import vtkPNGWriter

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.probe import craniotomy_pose
from SlicerUSSim.Logic.vtk import SegmentationFilter, UltrasoundSimulationFilter


def write_picture(mri: vtkImageData, path: str) -> UltrasoundSimulationFilter:
    """Write the image of the default probe at a craniotomy; returns the filter, whose transform may be moved."""
    segmentation = SegmentationFilter()
    segmentation.SetInputData(mri)
    segmentation.Update()

    simulation = UltrasoundSimulationFilter()
    simulation.SetInputConnection(segmentation.GetOutputPort())
    transform = vtkTransform()
    labels = Volume.from_vtk(segmentation.GetOutput())
    transform.SetMatrix(vtk_matrix(craniotomy_pose(labels, simulation.GetProbe())))
    simulation.SetProbeTransform(transform)

    # The first row is next to the probe, and writers put it at the bottom. vtkImageFlip works along the patient's axes,
    # so that the image loses its direction first (VTK 9.3 or newer).
    upright = vtkImageChangeInformation()
    upright.SetInputConnection(simulation.GetOutputPort())
    upright.SetOutputDirection((1, 0, 0, 0, 1, 0, 0, 0, 1))
    flip = vtkImageFlip()
    flip.SetFilteredAxis(1)
    flip.SetInputConnection(upright.GetOutputPort())

    writer = vtkPNGWriter()
    writer.SetInputConnection(flip.GetOutputPort())
    writer.SetFileName(path)
    writer.Write()
    require(not writer.GetErrorCode(), f"{path}: cannot be written")
    return simulation


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    try:
        write_picture(Volume.read(sys.argv[1]).to_vtk(), sys.argv[2])
    except SimulationError as error:
        sys.exit(str(error))
