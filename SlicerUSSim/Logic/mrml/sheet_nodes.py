"""Sheets in a scene: a model with a square for each surfel, which Segment writes or a user loads from a .vtp."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import fields
from typing import Any

import numpy as np

from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata, placed_surfels
from SlicerUSSim.Logic.mrml.nodes import display_of, named, node_to_world, require_node
from SlicerUSSim.Logic.mrml.own_results import SHEETS, mark_as_result
from SlicerUSSim.Logic.tissue.surfels import KINDS, Surfels


def write_sheets(model_node, surfels: Surfels, mri_node) -> None:
    """Write sheets, in the own frame of an MRI node, into a model node beside it, hidden at first."""
    model_node.SetAndObservePolyData(as_polydata(surfels))
    parent = mri_node.GetParentTransformNode()
    model_node.SetAndObserveTransformNodeID(None if parent is None else parent.GetID())
    mark_as_result(model_node, SHEETS)
    is_new = model_node.GetDisplayNode() is None
    display = display_of(model_node)
    if is_new and display is not None:
        display.SetVisibility(False)
        display.SetScalarVisibility(True)
        display.SetBackfaceCulling(False)


def sheets_version(model_node) -> Hashable:
    """A value that changes with the sheets of a model and with its place; None for no node."""
    if model_node is None or model_node.GetPolyData() is None:
        return None
    return model_node.GetID(), model_node.GetPolyData().GetMTime(), node_to_world(model_node).tobytes()


def holds_sheets(model_node) -> bool:
    """Whether a model has what placed_surfels reads, whoever made it; not the surface of something else."""
    data = model_node.GetPolyData()
    arrays = None if data is None else data.GetCellData()
    return arrays is not None and all(arrays.HasArray(entry.name) for entry in fields(Surfels))


def read_sheets(model_node, world_to_labels: np.ndarray, kinds: Iterable[str]) -> Surfels:
    """Sheets of some kinds, in the frame to which a (4, 4) linear transform leads from the world.

    Places and normals belong to the squares, which a hardened transform moves. Raises SimulationError for another
    node, and for a model of something else.
    """
    require_node(model_node, "vtkMRMLModelNode", use="sheets")
    data: Any = model_node.GetPolyData()
    if data is None or data.GetNumberOfCells() == 0:
        return Surfels.joined([])
    placed = placed_surfels(data, f"sheets {named(model_node)}", world_to_labels @ node_to_world(model_node))
    return placed.of_kind(*(kind for kind in KINDS if kind in set(kinds)))
