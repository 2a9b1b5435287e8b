"""The pictures of docs/slicer.md: python examples/slicer_pictures.py OUT_FOLDER

Slicer's own views of the demo brain, rendered without its window: the first steps in a slice view, the image in a slice
view and in 3D, and a sweep along a curve. The picture of the panel comes from tests/test_slicer_module.py with
USSIM_PICTURES=OUT_FOLDER.

Needs pip install "SlicerUSSim[serve]".
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import slicer
from PIL import Image
from trame_slicer.core import SlicerApp
from trame_slicer.views import AbstractView, NoScheduleRendering, SliceView, ThreeDView
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.mrml import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import display_of, node_called, node_to_world, write_volume
from SlicerUSSim.Logic.probe import turned

LINE = 6  # pixels between views
ROLES = ("mri", "labels", "probe_transform", "output", "outline")
CLASSES = ("ScalarVolume", "Segmentation", "LinearTransform", "ScalarVolume", "Model")
#: Points of the curve on the MNI152 brain, RAS mm
SWEEP = ((15.0, 40.0, 55.0), (15.0, 20.0, 67.0), (15.0, 0.0, 76.0), (15.0, -20.0, 80.0), (15.0, -50.0, 79.0))


def grab(view: AbstractView) -> np.ndarray:
    """(rows, columns, 3) uint8 of a view as it is now."""
    view.render()
    width, height = view.render_window().GetSize()
    pixels = vtkUnsignedCharArray()
    view.render_window().GetPixelData(0, 0, width - 1, height - 1, 0, pixels, 0)
    return vtk_to_numpy(pixels).reshape(height, width, 3)[::-1]


def save(path: Path, *rows: list[np.ndarray]) -> None:
    """Write views of one size in rows, with a grey line between them."""
    line = ((0, LINE), (0, LINE), (0, 0))
    page = np.vstack([np.hstack([np.pad(view, line, constant_values=64) for view in row]) for row in rows])
    Image.fromarray(page[:-LINE, :-LINE]).save(path, optimize=True)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    app = SlicerApp()
    scene = app.scene
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    red = SliceView(scene, app.app_logic, "Red", NoScheduleRendering())
    threed = ThreeDView(scene, app.app_logic, "1", NoScheduleRendering())
    for view in (red, threed):
        view.render_window().SetSize(560, 470)
    red_node: Any = red.get_view_node()
    threed_node: Any = threed.get_view_node()
    threed_node.SetBoxVisible(False)
    threed_node.SetAxisLabelsVisible(False)

    logic = UltrasoundSceneLogic(scene)
    nodes = logic.parameters
    for role, kind in zip(ROLES, CLASSES, strict=True):
        setattr(nodes, role, node_called(scene, kind, role))
    write_volume(nodes.mri, demo_mri()[0])
    display_of(nodes.mri)
    red.set_background_volume_id(nodes.mri.GetID())
    logic.segment(nodes.mri, nodes.labels)
    tissues = display_of(nodes.labels)
    tissues.SetVisibility2D(False)
    tissues.SetOpacity2DFill(1.0)
    logic.preset = logic.preset.changed("probe", kind="convex").changed("display", gain_db=6.0)

    curve = node_called(scene, "MarkupsCurve", "Sweep")
    images = node_called(scene, "Sequence", "Sweep images")
    volume = node_called(scene, "ScalarVolume", "Sweep volume")
    for point in SWEEP:
        curve.AddControlPoint(point)
    browser, transforms = logic.followPath(nodes.labels, curve)
    logic.simulateSequence(nodes.labels, transforms, images, browser_node=browser)
    logic.compoundSequence(images, volume)
    display_of(volume).SetThreshold(1, 255)
    display_of(volume).SetApplyThreshold(True)
    red.set_foreground_volume_id(volume.GetID())
    red.set_foreground_opacity(1.0)
    red.set_orientation("Sagittal")
    red.fit_view_to_content()
    red_node.JumpSliceByOffsetting(*SWEEP[0])
    nodes.labels.CreateClosedSurfaceRepresentation()
    for segment in ("csf", "white matter", "leptomeninges"):
        tissues.SetSegmentVisibility3D(segment, False)
    threed.render()
    camera: Any = threed.get_camera_node()
    camera.SetFocalPoint(10.0, -5.0, 30.0)
    camera.SetPosition(240.0, 300.0, 270.0)
    camera.SetViewUp(0.0, 0.0, 1.0)
    camera.ResetClippingRange()
    save(folder / "slicer-sweep.png", [grab(threed), grab(red)])

    scene.RemoveNode(curve)
    tissues.SetVisibility3D(False)
    logic.placeProbe(nodes.labels, nodes.probe_transform)
    logic.startLiveUpdate(nodes.labels, nodes.probe_transform, nodes.output, nodes.outline, red_node)
    first = grab(red)
    red.set_foreground_volume_id(None)
    mri = grab(red)
    tissues.SetVisibility2D(True)
    segmented = grab(red)
    tissues.SetVisibility2D(False)
    pose = turned(node_to_world(nodes.probe_transform), tilt_deg=20.0)
    nodes.probe_transform.SetMatrixTransformToParent(vtk_matrix(pose))
    moved = grab(red)
    save(folder / "slicer-steps.png", [mri, segmented], [first, moved])

    logic.showProbe(nodes.outline, True)
    red.set_visible_in_3d(True)
    save(folder / "slicer-views.png", [moved, grab(threed)])

    frames = []
    for tilt in 22.0 * np.sin(np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)):
        nodes.probe_transform.SetMatrixTransformToParent(vtk_matrix(turned(pose, tilt_deg=tilt - 20.0)))
        both = Image.fromarray(np.hstack([grab(red), grab(threed)]))
        frames.append(both.resize((700, 294)).quantize(128, dither=Image.Dither.NONE))
    frames[0].save(folder / "slicer-moving.gif", save_all=True, append_images=frames[1:], duration=90, loop=0)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
