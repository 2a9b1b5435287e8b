"""FitSettings: what a fit of simulated to tracked images has to know beside the images."""

from __future__ import annotations

from dataclasses import dataclass

from SlicerUSSim.Logic.base.declaration import Declared, Shown, parameter


@dataclass(frozen=True)
class FitSettings(Declared):
    """What is fitted, to which images, and how long."""

    frames: str = parameter(
        "", "Frames", "Which images of the sequence: 0,5,10 or 0:20:5; empty for six, evenly spread", shown=True
    )
    free: str = parameter(
        "display, white matter", "Free parameters",
        'Names with commas between: "display", a tissue, or one of either (gain_db, white matter.mu0)',
    )  # fmt: skip
    estimate: bool = parameter(
        False, "Find the geometry in the images",
        "Find the field of the probe in the images, instead of taking the probe above; its frequency and beam stay",
        shown=True,
    )  # fmt: skip
    register: bool = parameter(
        False, "Register as well",
        "Also move the real ultrasound against the MRI, by a rigid transform; takes longer", shown=True,
        option="register/no-register",
    )  # fmt: skip
    evaluations: int = parameter(
        500, "Evaluations", "How often the images are compared at most; one takes some milliseconds",
        bounds=(1, 1_000_000), shown=Shown(10, 100_000, 100), option="evaluations",
    )  # fmt: skip
    restarts: int = parameter(
        2, "Restarts", "Searches from other starts with other speckle, which show what fits equally well",
        bounds=(0, 100), option="restarts",
    )  # fmt: skip

    def _owner(self) -> str:
        return "fit"
