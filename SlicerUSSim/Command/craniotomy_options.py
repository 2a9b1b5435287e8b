"""--craniotomy: an opening in the skull of a whole head; and the gel between its skin and the probe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from SlicerUSSim.Command.mri_options import NONE, MriOptions
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM as GEL_MM

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.probe import Probe

AUTO, DISC = "auto", "disc:"


@dataclass(frozen=True)
class Craniotomy:
    """What --craniotomy asks for."""

    source: str = NONE
    #: Of a disc, None for another opening or as wide as the probe needs
    diameter_mm: float | None = None

    @classmethod
    def of(cls, text: str) -> Craniotomy:
        """Raises SimulationError for an unknown value and for a file that does not exist."""
        if text in (NONE, AUTO):
            return cls(text)
        if text.startswith(DISC):
            try:
                diameter = float(text.removeprefix(DISC))
            except ValueError:
                diameter = math.nan
            require(
                5.0 <= diameter <= 150.0,
                f"--craniotomy is {text!r}, expected disc: and a diameter from 5 to 150 mm, such as disc:30",
            )
            return cls(DISC, diameter)
        from pathlib import Path

        require(
            Path(text).is_file(), f"--craniotomy is {text!r} (no such file), expected none, auto, disc:MM, or a file"
        )
        return cls(text)

    @property
    def is_wanted(self) -> bool:
        """Whether there is an opening."""
        return self.source != NONE

    @property
    def is_file(self) -> bool:
        """Whether the opening is from a file."""
        return self.is_wanted and not self.needs_pose

    @property
    def needs_pose(self) -> bool:
        """Whether the opening lies under the probe."""
        return self.source in (AUTO, DISC)

    def require_head(self, patient: MriOptions) -> None:
        """Raise SimulationError for an opening in a segmentation without skin and skull, as --outside finds them."""
        given = f"--craniotomy is {self.text}"
        if self.is_wanted:
            require(not patient.is_ct, f"{given}, which opens a head that was found in an MRI, and this is a CT")
            is_whole = patient.segmentation.outside
            require(is_whole, f"{given}, and only a brain is labelled, expected --outside and an MRI of a whole head")

    @property
    def text(self) -> str:
        """As it was given: "disc:30"."""
        return self.source if self.diameter_mm is None else f"{self.source}{self.diameter_mm:g}"

    def on(self, labels: Volume, names: Sequence[str], probe: Probe, probe_to_ras: np.ndarray | None) -> Volume:
        """Labels 1, 2, ... called `names` with the opening; says what was removed. The pose is needed for a disc alone.

        Raises SimulationError where that cannot be done.
        """
        if not self.is_wanted:
            return labels
        from SlicerUSSim.Logic.placement.craniotomy import (
            disc_diameter_mm,
            disc_opening,
            file_opening,
            middle_of,
            opened,
        )

        if self.needs_pose:
            need = f"--craniotomy {self.source.rstrip(':')} needs one pose of the probe, expected a file"
            at, diameter = required(probe_to_ras, need), self.diameter_mm or disc_diameter_mm(probe)
            opening, what = disc_opening(labels, names, at, diameter), f"a disc of {diameter:.0f} mm"
        else:
            opening, what = file_opening(labels, names, self.source), self.source
        found, millilitres = opened(labels, names, opening)
        right, front, up = middle_of(labels, found)
        note(
            f"craniotomy: {what}; {millilitres:.1f} ml of skin, scalp and skull about R {right:.0f}, A {front:.0f}, "
            f"S {up:.0f} mm are replaced by the coupling medium"
        )
        return found
