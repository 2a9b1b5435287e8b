"""One VTK pipeline from MRI to ultrasound, rendered off-screen: python examples/vtk_pipeline.py [OUT.png]

Left: the image plane with the MRI resampled by vtkImageReslice, the simulated image on it, and the outline of the
imaged field. Right: the same in the patient, with the far half of the brain's surface. To update the image, change
`transform` and render again.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import vtkmodules.vtkRenderingOpenGL2  # noqa: F401, makes rendering work at all
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkTubeFilter
from vtkmodules.vtkImagingCore import vtkImageReslice, vtkImageThreshold
from vtkmodules.vtkImagingGeneral import vtkImageGaussianSmooth
from vtkmodules.vtkIOImage import vtkPNGWriter
from vtkmodules.vtkRenderingCore import (
    vtkActor,
    vtkImageSlice,
    vtkImageSliceMapper,
    vtkPolyDataMapper,
    vtkRenderer,
    vtkRenderWindow,
    vtkWindowToImageFilter,
)

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import PROBES, craniotomy_pose
from SlicerUSSim.Logic.vtk import SegmentationFilter, UltrasoundSimulationFilter


@dataclass
class Scene:
    """The objects that an application needs afterwards."""

    window: vtkRenderWindow
    transform: vtkTransform
    simulation: UltrasoundSimulationFilter
    ultrasound: vtkImageSlice


def build(mri: Volume, probe=PROBES["convex"]) -> Scene:
    """The pipeline, and a window with two views of it."""
    image = mri.to_vtk()
    segmentation = SegmentationFilter()
    segmentation.SetInputData(image)
    segmentation.Update()

    transform = vtkTransform()
    transform.SetMatrix(vtk_matrix(craniotomy_pose(Volume.from_vtk(segmentation.GetOutput()), probe)))
    simulation = UltrasoundSimulationFilter()
    simulation.SetInputConnection(segmentation.GetOutputPort())
    simulation.SetProbe(probe)
    simulation.SetProbeTransform(transform)
    simulation.SetFieldAlpha(True)

    in_plane = vtkRenderer()
    in_plane.SetViewport(0.0, 0.0, 0.5, 1.0)
    in_patient = vtkRenderer()
    in_patient.SetViewport(0.5, 0.0, 1.0, 1.0)
    ultrasound = image_actor(simulation.GetOutputPort(0), 255.0, 1.0)
    cut = mri_in_plane(image, transform)
    outline = line_actor(simulation.GetOutputPort(1))
    for renderer in (in_plane, in_patient):
        for actor in (cut, ultrasound, outline):
            renderer.AddViewProp(actor)
    in_patient.AddViewProp(surface_actor(segmentation))
    look_at(in_plane, transform, (0.0, 0.0, 1.0))
    look_at(in_patient, transform, (0.9, -0.5, 1.0))

    window = vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(1200, 600)
    window.AddRenderer(in_plane)
    window.AddRenderer(in_patient)
    return Scene(window, transform, simulation, ultrasound)


def mri_in_plane(image, transform: vtkTransform) -> vtkImageSlice:
    """The MRI in the image plane: resampled in the probe frame, and placed at the probe's pose."""
    reslice = vtkImageReslice()
    reslice.SetInputData(image)
    reslice.SetResliceTransform(transform)
    reslice.SetOutputOrigin(-100.0, -60.0, 0.3)  # slightly behind the ultrasound image, to avoid z-fighting
    reslice.SetOutputSpacing(0.5, 0.5, 0.5)
    reslice.SetOutputExtent(0, 400, 0, 500, 0, 0)
    reslice.SetInterpolationModeToCubic()
    actor = image_actor(reslice.GetOutputPort(), 1.1 * image.GetScalarRange()[1], 1.0)
    actor.SetUserTransform(transform)
    return actor


def image_actor(port, white: float, opacity: float) -> vtkImageSlice:
    """An image with black at 0."""
    mapper = vtkImageSliceMapper()
    mapper.SetInputConnection(port)
    actor = vtkImageSlice()
    actor.SetMapper(mapper)
    actor.GetProperty().SetColorWindow(white)
    actor.GetProperty().SetColorLevel(0.5 * white)
    actor.GetProperty().SetOpacity(opacity)
    return actor


def line_actor(port) -> vtkActor:
    """The outline as a yellow tube."""
    tube = vtkTubeFilter()
    tube.SetInputConnection(port)
    tube.SetRadius(0.5)
    return coloured(tube.GetOutputPort(), (1.0, 0.85, 0.1), 1.0)


def surface_actor(segmentation: SegmentationFilter) -> vtkActor:
    """The surface of all labelled voxels."""
    inside = vtkImageThreshold()
    inside.SetInputConnection(segmentation.GetOutputPort())
    inside.ThresholdByUpper(1.0)
    inside.SetInValue(1.0)
    inside.SetOutValue(0.0)
    inside.SetOutputScalarTypeToFloat()
    smooth = vtkImageGaussianSmooth()
    smooth.SetInputConnection(inside.GetOutputPort())
    smooth.SetStandardDeviation(2.0)
    surface = vtkFlyingEdges3D()
    surface.SetInputConnection(smooth.GetOutputPort())
    surface.SetValue(0, 0.5)
    actor = coloured(surface.GetOutputPort(), (0.9, 0.75, 0.7), 1.0)
    actor.GetProperty().SetFrontfaceCulling(1)  # only the far half: the planes stand in an open shell
    return actor


def coloured(port, colour, opacity: float) -> vtkActor:
    mapper = vtkPolyDataMapper()
    mapper.SetInputConnection(port)
    mapper.ScalarVisibilityOff()
    actor = vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(*colour)
    actor.GetProperty().SetOpacity(opacity)
    actor.GetProperty().SetAmbient(0.2)
    return actor


def look_at(renderer: vtkRenderer, transform: vtkTransform, direction) -> None:
    """Point the camera at the middle of the field, against a direction of the probe frame, with depth downwards."""
    camera = renderer.GetActiveCamera()
    camera.ParallelProjectionOn()
    middle = (0.0, 50.0, 0.0)
    camera.SetFocalPoint(transform.TransformPoint(middle))
    # Viewed against +z, the probe's x axis points left; the image would be mirrored.
    camera.SetPosition(transform.TransformPoint([m - 400.0 * d for m, d in zip(middle, direction, strict=True)]))
    camera.SetViewUp(transform.TransformVector((0.0, -1.0, 0.0)))
    camera.SetParallelScale(75.0)
    camera.SetClippingRange(1.0, 1000.0)


def write_png(window: vtkRenderWindow, path: str) -> None:
    """The content of the window."""
    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ReadFrontBufferOff()
    writer = vtkPNGWriter()
    writer.SetInputConnection(grab.GetOutputPort())
    writer.SetFileName(path)
    writer.Write()


if __name__ == "__main__":
    out = sys.argv[1] if len(sys.argv) > 1 else "vtk_pipeline.png"
    scene = build(demo_mri()[0])
    scene.window.Render()
    write_png(scene.window, out)
    print(f"wrote {out}", file=sys.stderr)
