"""TrackedPresenter: a probe that a tracker moves, its calibration, and images sent over OpenIGTLink, without Qt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
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
    nodes_of_class,
    read_volume,
)
from SlicerUSSim.Logic.tracked.images import face_of_calibration
from SlicerUSSim.Logic.tracked.openigtlink import DEFAULT_PORT
from SlicerUSSim.Logic.tracked.pose_files import matrix_of_text, read_calibration
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import CHECK

#: Attribute of the probe's transform below a tracker's, and names of nodes that are made
_FACE = "SlicerUSSim.face"
_FACE_NAME, _CALIBRATION, _CONNECTOR = "Probe face", "ImageToProbe", "Ultrasound device"
_CONNECTOR_CLASS = "vtkMRMLIGTLConnectorNode"


def is_face(transform_node: Any) -> bool:
    """Whether a transform holds the probe's face to a tracked sensor: nothing else may move it."""
    return transform_node.GetAttribute(_FACE) is not None


class TrackedPresenter:
    """Lets a tracker move the probe's face, and sends images to clients."""

    def __init__(self, panel: PanelHost) -> None:
        self._panel = panel
        #: What the last calibration was taken for, as text
        self.done = ""

    def text(self) -> str:
        """What was taken, and what to check."""
        probe, view = self._panel.parameters.probe_transform, self._panel.view.sliceNode()
        lines = [self.done] if self.done else []
        if probe is not None and (probe.GetName() or "").startswith("ProbeTo"):
            lines.insert(0, CHECK + _("{name!r} is the pose of the sensor and not of the probe's face: choose it as "
                                      "Tracked transform").format(name=probe.GetName()))  # fmt: skip
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
            face_to_probe, words = face_of_calibration(matrix, self._images(), self._face_pixel())
            face: Any = node_called(panel.logic.scene, "LinearTransform", _FACE_NAME)
            face.SetAttribute(_FACE, "1")
            face.SetMatrixTransformToParent(vtk_matrix(face_to_probe))
            face.SetAndObserveTransformNodeID(tracked.GetID())
            parameters.probe_transform = face
            self._place_images(matrix, tracked)
            composite = None if (view := panel.view.sliceNode()) is None else composite_of(view)
            if composite is not None and parameters.real is not None and parameters.real.IsA("vtkMRMLVolumeNode"):
                composite.SetBackgroundVolumeID(parameters.real.GetID())  # which Blink uncovers
            self.done = _("{source} below {name!r}: {words}").format(
                source=source, name=tracked.GetName(), words="; ".join(words)
            )

    def _calibration(self) -> tuple[np.ndarray, str]:
        """((4, 4) ImageToProbe, where it is from)."""
        node, text = self._panel.parameters.calibration, self._panel.parameters.panel.calibration_text.strip()
        if node is not None:
            return node_to_parent(node), named(node)
        require(bool(text), "no calibration, expected a transform, a Plus configuration or 16 numbers")
        if Path(text).suffix.lower() != ".xml":
            return matrix_of_text("the calibration", text), _("the calibration")
        known = read_calibration(text)
        missing = f"{text}: has no {_CALIBRATION}, but {', '.join(sorted(known))}"
        return required(known.get(_CALIBRATION), missing), Path(text).name

    def _face_pixel(self) -> tuple[float, float] | None:
        text = self._panel.parameters.panel.face_pixel.replace(",", " ").split()
        if not text:
            return None
        try:
            column, row = map(float, text)
        except ValueError:
            raise SimulationError(f"Face in the image is {' '.join(text)!r}, expected a column and a row") from None
        return column, row

    def _images(self) -> np.ndarray | None:
        """(n, rows, columns) of the chosen real images; None without, and for a volume of several slices."""
        real: Any = self._panel.parameters.real
        if real is None:
            return None
        if real.IsA("vtkMRMLSequenceNode"):
            return sequence_of(real).images
        array = read_volume(real, "real image").array
        return array if len(array) == 1 else None

    def _place_images(self, image_to_probe: np.ndarray, tracked: Any) -> None:
        """Put a streamed image that is in pixels, as Plus sends Image_Image, below the calibration."""
        real: Any = self._panel.parameters.real
        if real is None or not real.IsA("vtkMRMLVolumeNode") or real.GetParentTransformNode() is not None:
            return
        if not np.allclose(ijk_to_ras(real), np.eye(4)):
            return
        chosen: Any = self._panel.parameters.calibration
        node: Any = chosen or node_called(self._panel.logic.scene, "LinearTransform", _CALIBRATION)
        node.SetMatrixTransformToParent(vtk_matrix(image_to_probe))
        node.SetAndObserveTransformNodeID(tracked.GetID())
        real.SetAndObserveTransformNodeID(node.GetID())

    # ---- OpenIGTLinkIF -----------------------------------------------------------------------------------------

    def sendImages(self) -> None:
        """Start an OpenIGTLink server in Slicer that sends the image and the probe's transform, by OpenIGTLinkIF."""
        scene, parameters = self._panel.logic.scene, self._panel.parameters
        with self._panel.acting():
            nodes = required(parameters.output, "no image yet, simulate one first"), parameters.probe_transform
            others = nodes_of_class(scene, _CONNECTOR_CLASS)
            connector: Any = next((node for node in others if node.GetName() == _CONNECTOR), None)
            if connector is None:
                connector = required(
                    scene.CreateNodeByClass(_CONNECTOR_CLASS),
                    "Slicer lacks OpenIGTLinkIF: install the extension SlicerOpenIGTLink in the Extensions Manager",
                )
                connector.UnRegister(None)
                connector.SetName(_CONNECTOR)
                connector.SetTypeServer(DEFAULT_PORT)
                connector = scene.AddNode(connector)
            for node in filter(None, nodes):
                node.SetAttribute("OpenIGTLinkIF.pushOnConnect", "true")
                connector.RegisterOutgoingMRMLNode(node)
            connector.Start()
            self._panel.view.showStatus(_("OpenIGTLink server at port {port}").format(port=DEFAULT_PORT))
