"""PoseEntry: poses of the probe that are typed and saved."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.base.transforms import angles_of_pose
from SlicerUSSim.Logic.mrml.taken_files import written
from SlicerUSSim.Logic.tracked.pose_files import pose_of_text, write_pose
from SlicerUSSim.Workstation.browser_panel import BrowserPanel

#: Suffixes of files of poses
POSE_SUFFIXES = (".json", ".tfm", ".h5", ".mat", ".txt")
_NO_PROBE = "there is no probe yet, expected a patient; open an MRI or labels"


class PoseEntry:
    """Sets the pose of the probe from texts, and saves it.

    Parameters
    ----------
    pose : (4, 4) of the probe; None without one.
    move : sets it; the image follows.
    """

    def __init__(
        self, panel: BrowserPanel, pose: Callable[[], np.ndarray | None], move: Callable[[np.ndarray], None]
    ) -> None:
        self._shared, self._presenter = panel.shared, panel.presenter
        self._pose, self._move = pose, move

    def show(self) -> None:
        """Show the pose of the probe as numbers."""
        pose = self._pose()
        numbers = matrix = ""
        if pose is not None:
            numbers = _text(np.concatenate([pose[:3, 3], angles_of_pose(pose)]), 2)
            matrix = "\n".join(_text(row, 4) for row in pose)
        with self._shared.changing() as now:
            now.pose_numbers, now.pose_matrix = numbers, matrix

    def type(self, text: str) -> None:
        """Set the pose from six or sixteen numbers; called in a task."""
        with self._presenter.shown():
            self.set(pose_of_text(text))

    def file(self, suffix: str) -> tuple[str, bytes]:
        """(name, content) of a file with the pose. Raises SimulationError without a probe, or for another suffix."""
        pose = required(self._pose(), _NO_PROBE)
        require(suffix in POSE_SUFFIXES, f"the file type is {suffix!r}, expected {', '.join(POSE_SUFFIXES)}")
        return f"pose{suffix}", written(suffix, lambda path: write_pose(path, pose))

    def set(self, pose: np.ndarray) -> None:
        """Move the probe to a pose, (4, 4) probe_to_ras. Raises SimulationError without a probe."""
        require(self._pose() is not None, _NO_PROBE)
        self._move(pose)


def _text(numbers: np.ndarray, decimals: int) -> str:
    """Numbers with this many decimals, without -0."""
    return " ".join(f"{value:.{decimals}f}" for value in numbers.round(decimals) + 0.0)
