"""Fits on the nodes of a scene: reads real images, plots the cost, writes images for comparison."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import isfinite
from time import perf_counter

import numpy as np
from vtkmodules.vtkCommonCore import vtkDoubleArray

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.control_costs import neighbours_of
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.tracked_fit import Fit
from SlicerUSSim.Logic.mrml.nodes import (
    display_of,
    ijk_to_ras,
    named,
    node_called,
    node_to_parent,
    node_to_world,
    nodes_of_class,
    read_volume,
    require_node,
    write_volume,
)
from SlicerUSSim.Logic.mrml.own_results import COMPARED as COMPARED_RESULT, mark_as_result, require_result
from SlicerUSSim.Logic.mrml.sequence_nodes import TIME, number_in
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

_log = logging.getLogger(__name__)

#: Names of the images that a fit provides for comparison.
COMPARED = ("real", "before", "after", "difference")
#: Default number of images of a sequence, evenly spaced.
MOST_IMAGES = 6
#: Seconds between two updates of the plot.
_PLOT_EVERY = 0.25


def tracked_images(
    images_node, numbers: Sequence[int] | None, probe: Probe, *, probe_to_world: np.ndarray | None = None,
    estimate_geometry: bool = False, apart: Sequence[int] = (),
) -> TrackedImages:  # fmt: skip
    """Real images from a sequence of volumes, from a volume of one slice, or a slice of a 3D volume under the probe.

    A sequence has the poses of its browser's transforms at the same times. With `estimate_geometry` the
    geometry of the probe is estimated from the images; `probe` gives its other parameters. `apart` are numbers
    of images that are prepared beside those of the default choice.
    Raises SimulationError for nodes without such images and as TrackedImages does.
    """
    require_node(images_node, "vtkMRMLSequenceNode", "vtkMRMLScalarVolumeNode", use="real images")
    is_sequence = images_node.IsA("vtkMRMLSequenceNode")
    require(is_sequence or not apart, f"{named(images_node)} is not a sequence, expected one to predict other images")
    if is_sequence:
        sequence = sequence_of(images_node)
    else:
        volume = read_volume(images_node, "real image")
        if volume.array.shape[0] > 1:
            what = f"{named(images_node)} is a 3D volume, expected a probe transform to select its image plane"
            probe_to_world = required(probe_to_world, what)
            _log.info("%s is a 3D volume, resampled in the plane of the probe", named(images_node))
            placed = Volume(volume.array, node_to_world(images_node) @ volume.ijk_to_ras)
            sequence = TrackedSequence.from_volume(placed, probe, [probe_to_world])
            return TrackedImages.of(sequence, numbers, probe=probe)
        sequence = _of_slices([(volume.array[0], node_to_world(images_node) @ volume.ijk_to_ras)], [0.0])
    known = None if estimate_geometry else probe
    return TrackedImages.of(sequence, numbers, probe=known, beam=probe, most=MOST_IMAGES, apart=apart)


def neighbours_in(images_node, tracked: TrackedImages) -> list[list[np.ndarray]] | None:
    """The images before and after each of `tracked` in its sequence; None if they are not of a sequence node."""
    return neighbours_of(sequence_of(images_node), tracked) if images_node.IsA("vtkMRMLSequenceNode") else None


def sequence_of(sequence_node) -> TrackedSequence:
    """The images of a sequence node, each with its ImageToReference, which leads to the world.

    Raises SimulationError for an empty sequence, and for items other than images.
    """
    count = sequence_node.GetNumberOfDataNodes()
    require(count > 0, f"sequence {named(sequence_node)} is empty, expected images")
    browsers = nodes_of_class(sequence_node.GetScene(), "vtkMRMLSequenceBrowserNode")
    browser = next((node for node in browsers if node.IsSynchronizedSequenceNode(sequence_node, True)), None)
    shown = None if browser is None else browser.GetProxyNode(sequence_node)
    if shown is None:
        _log.info("%s: is in no browser, so the geometry of its images is used", named(sequence_node))
    parent = None if shown is None else shown.GetParentTransformNode()
    slices, times = [], []
    for number in range(count):
        item, index = sequence_node.GetNthDataNode(number), sequence_node.GetNthIndexValue(number)
        use = f"item {number} of {named(sequence_node)}"
        require(item.IsA("vtkMRMLScalarVolumeNode"), f"{use} is a {item.GetClassName()}, expected an image")
        image = item.GetImageData()
        require(image is not None and image.GetDimensions()[2] == 1, f"{use} is not one slice, expected an image")
        array = Volume.from_vtk(image, ijk_to_ras(item)).array[0]
        slices.append((array, _to_world_at(browser, parent, number, index) @ ijk_to_ras(item)))
        time = number_in(item.GetAttribute(TIME) or index)
        times.append(time if isfinite(time) else float(number))  # sequences may be indexed by text
    return _of_slices(slices, times)


def _to_world_at(browser, transform_node, number: int, index: str) -> np.ndarray:
    """(4, 4) of a chain of transforms, each taken from its sequence in the browser at this index value."""
    matrix = np.eye(4)
    while transform_node is not None:
        recorded = browser.GetSequenceNode(transform_node)
        item = transform_node if recorded is None else _recorded_at(recorded, number, index)
        if item is None or not item.IsA("vtkMRMLLinearTransformNode"):
            raise SimulationError(f"{named(transform_node)} has no linear transform at {index}")
        matrix = node_to_parent(item) @ matrix
        transform_node = transform_node.GetParentTransformNode()
    return matrix


def _recorded_at(sequence_node, number: int, index: str):
    """The item that corresponds to item `number` of another sequence, with index value `index`; None if there is none.

    It is found by its place if both sequences have the index value there, otherwise by the value: among values within
    its tolerance, a sequence node would return the first.
    """
    if number < sequence_node.GetNumberOfDataNodes() and sequence_node.GetNthIndexValue(number) == index:
        return sequence_node.GetNthDataNode(number)
    return sequence_node.GetDataNodeAtValue(index, False)


def _of_slices(slices: list[tuple[np.ndarray, np.ndarray]], times: list[float]) -> TrackedSequence:
    shapes = {image.shape for image, _ in slices}
    require(len(shapes) == 1, f"the images have the sizes {sorted(shapes)}, expected equal sizes")
    return TrackedSequence(
        np.stack([image for image, _ in slices]), tuple({"ImageToReference": m} for _, m in slices), np.array(times)
    )


class CostPlot:
    """The cost of an optimisation as a table, two series and a chart in the scene, updated while it runs."""

    def __init__(self, scene, name: str = "Fit to real ultrasound") -> None:
        self.chart = node_called(scene, "PlotChart", name)
        self.table = node_called(scene, "Table", f"{name} costs")
        self._columns = []
        for title in ("evaluation", "cost", "best"):
            column = vtkDoubleArray()
            column.SetName(title)
            self._columns.append(column)
        self.table.RemoveAllColumns()
        for column in self._columns:
            self.table.AddColumn(column)
        self.chart.RemoveAllPlotSeriesNodeIDs()
        for title, colour in (("cost", (0.55, 0.55, 0.55)), ("best", (0.85, 0.55, 0.0))):
            series = node_called(scene, "PlotSeries", f"{name} {title}")
            series.SetAndObserveTableNodeID(self.table.GetID())
            series.SetXColumnName("evaluation")
            series.SetYColumnName(title)
            series.SetPlotType(series.PlotTypeScatter)
            series.SetLineStyle(series.LineStyleSolid if title == "best" else series.LineStyleNone)
            series.SetMarkerStyle(series.MarkerStyleNone if title == "best" else series.MarkerStyleCircle)
            series.SetMarkerSize(4)
            series.SetColor(*colour)
            self.chart.AddAndObservePlotSeriesNodeID(series.GetID())
        self.chart.SetTitle(name)
        self.chart.SetXAxisTitle("evaluation")
        self.chart.SetYAxisTitle("cost")
        self._drawn = 0.0

    def add(self, progress: Progress) -> None:
        """Add an evaluation; the views are updated a few times a second."""
        if self.table.GetScene() is None or not isfinite(progress.cost):
            return  # the user closed the scene, or it is a step with another cost
        for column, value in zip(self._columns, (progress.evaluations, progress.cost, progress.best_cost), strict=True):
            column.InsertNextValue(value)
        if perf_counter() - self._drawn > _PLOT_EVERY:
            self.draw()

    def draw(self) -> None:
        """Update the views."""
        for column in self._columns:
            column.Modified()
        self.table.GetTable().Modified()
        self.table.Modified()
        self._drawn = perf_counter()


def write_compared(nodes: dict, fit: Fit, number: int, to_world: np.ndarray) -> None:
    """Write one image of a fit into volume nodes, {name among COMPARED: node}, at its position in the world.

    `to_world` (4, 4) is from the frame of the fit's poses. Raises SimulationError for an image that was not fitted.
    """
    tracked = fit.tracked
    known = ", ".join(map(str, tracked.numbers))
    require(number in tracked.numbers, f"image {number} was not fitted, expected one of {known}")
    place = tracked.numbers.index(number)
    real, after = np.where(tracked.mask, tracked.images[place], 0), fit.after[place]
    difference = np.where(tracked.mask, 127.5 + 0.5 * (after.astype(float) - real), 0)
    images = {"real": real, "before": fit.before[place], "after": after, "difference": difference}
    geometry = to_world @ tracked.poses[place] @ tracked.grid.slice_to_probe
    for name, node in nodes.items():
        require_node(node, "vtkMRMLScalarVolumeNode", use=f"volume for {name}")
        require_result(node, f"volume for {name}")
    for name, node in nodes.items():
        node.SetAndObserveTransformNodeID(None)
        write_volume(node, Volume(images[name].astype(np.uint8)[None], geometry))
        mark_as_result(node, COMPARED_RESULT)
        display = display_of(node)
        if display is not None:
            display.SetAutoWindowLevel(False)
            display.SetWindowLevelMinMax(0, 255)
