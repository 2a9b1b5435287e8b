"""TrackedPresenter: a probe that a tracker moves, its calibration, and images sent over OpenIGTLink, without Qt."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mrml.fit_nodes import sequence_of
from SlicerUSSim.Logic.mrml.nodes import (
    composite_of,
    ijk_to_ras,
    is_driven_by_other,
    named,
    node_called,
    node_to_parent,
    read_volume,
)
from SlicerUSSim.Logic.tracked.images import face_of_calibration
from SlicerUSSim.Logic.tracked.openigtlink import DEFAULT_PORT
from SlicerUSSim.Logic.tracked.pose_files import matrix_of_text, read_calibration
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import CHECK

#: Names of nodes that are made: the probe's transform below a tracker's, and others
FACE = "Probe face"
_CALIBRATION, _CONNECTOR = "ImageToProbe", "Ultrasound device"


class TrackedPresenter:
    """Lets a tracker move the probe's face, and sends images to clients."""

    def __init__(self, panel: PanelHost) -> None:
        self._panel = panel
        #: How the last calibration was read, as text
        self.done = ""

    def text(self) -> str:
        """What was taken, and what to check."""
        probe, view = self._panel.parameters.probe_transform, self._panel.view.sliceNode()
        lines = [self.done] if self.done else []
        if probe is not None and (probe.GetName() or "").startswith(("ProbeTo", "ImageTo")):
            lines.insert(0, CHECK + _("{name!r} is not the pose of the probe's face: choose it as Tracked transform or "
                                      "Calibration").format(name=probe.GetName()))  # fmt: skip
        if view is not None and is_driven_by_other(view):
            lines.append(_("Volume Reslice Driver moves this slice view: Live leaves it there"))
        return "\n".join(lines)

    def useCalibration(self) -> None:
        """Put a transform of the probe's face below the tracked one, and choose it for the probe."""
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting():
            tracked: Any = required(parameters.tracked, "no tracked transform chosen, such as ProbeToReference")
            check_rigid(named(tracked), node_to_parent(tracked))
            matrix, source = self._calibration()
            real: Any = parameters.real
            face_to_probe, words = face_of_calibration(matrix, _images_of(real), self._face_pixel())
            face: Any = node_called(panel.logic.scene, "LinearTransform", FACE)
            face.SetMatrixTransformToParent(vtk_matrix(face_to_probe))
            face.SetAndObserveTransformNodeID(tracked.GetID())
            parameters.probe_transform = face
            if real is not None and real.IsA("vtkMRMLVolumeNode"):
                self._show_streamed(real, matrix, tracked)
            self.done = _("{source} below {name!r}: {words}").format(source=source, name=tracked.GetName(), words=words)

    def _calibration(self) -> tuple[np.ndarray, str]:
        """((4, 4) ImageToProbe, where it is from)."""
        node, text = self._panel.parameters.calibration, self._panel.parameters.panel.calibration_text.strip()
        if node is not None:
            return node_to_parent(node), named(node)
        require(text, "no calibration, expected a transform, a Plus configuration or 16 numbers")
        if Path(text).suffix.lower() != ".xml":
            return matrix_of_text("the calibration", text), _("the calibration")
        return required(read_calibration(text).get(_CALIBRATION), f"{text}: has no {_CALIBRATION}"), Path(text).name

    def _face_pixel(self) -> tuple[float, float] | None:
        text = self._panel.parameters.panel.face_pixel.strip()
        found = re.fullmatch(r"(\d+\.?\d*)[\s,]+(\d+\.?\d*)", text)
        require(found or not text, f"Face in the image is {text!r}, expected a column and a row")
        return None if found is None else (float(found[1]), float(found[2]))

    def _show_streamed(self, real: Any, image_to_probe: np.ndarray, tracked: Any) -> None:
        """Put a streamed image into the background of the slice view, which Blink uncovers.

        One in pixels, as Plus sends Image_Image, is placed by the calibration.
        """
        if real.GetParentTransformNode() is None and np.allclose(ijk_to_ras(real), np.eye(4)):
            chosen: Any = self._panel.parameters.calibration
            node: Any = chosen or node_called(self._panel.logic.scene, "LinearTransform", _CALIBRATION)
            node.SetMatrixTransformToParent(vtk_matrix(image_to_probe))
            node.SetAndObserveTransformNodeID(tracked.GetID())
            real.SetAndObserveTransformNodeID(node.GetID())
        view = self._panel.view.sliceNode()
        composite = None if view is None else composite_of(view)
        if composite is not None:
            composite.SetBackgroundVolumeID(real.GetID())

    def sendImages(self) -> None:
        """Start an OpenIGTLink server in Slicer that sends the image and the probe's transform, by OpenIGTLinkIF."""
        scene, parameters = self._panel.logic.scene, self._panel.parameters
        with self._panel.acting():
            nodes = required(parameters.output, "no image yet, simulate one first"), parameters.probe_transform
            connector: Any = required(
                node_called(scene, "IGTLConnector", _CONNECTOR),
                "Slicer lacks OpenIGTLinkIF: install the extension SlicerOpenIGTLink in the Extensions Manager",
            )
            connector.SetTypeServer(DEFAULT_PORT)
            for node in filter(None, nodes):
                node.SetAttribute("OpenIGTLinkIF.pushOnConnect", "true")
                connector.RegisterOutgoingMRMLNode(node)
            connector.Start()
            self._panel.view.showStatus(_("OpenIGTLink server at port {port}").format(port=DEFAULT_PORT))


def _images_of(real: Any) -> np.ndarray | None:
    """(n, rows, columns) of real images, if there are any."""
    if real is None:
        return None
    return sequence_of(real).images if real.IsA("vtkMRMLSequenceNode") else read_volume(real, "real image").array
