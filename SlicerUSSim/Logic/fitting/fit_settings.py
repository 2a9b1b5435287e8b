"""FitSettings: parameters of a fit of simulated to tracked images."""

from __future__ import annotations

from dataclasses import dataclass

from SlicerUSSim.Logic.base.declaration import Declared, Shown, parameter

#: The largest numbers of evaluations of a restart and of a search from the best of them, as fractions of those of the
#: search; most restarts need half of it or less. Draws are of solutions that are expected to fit equally well.
RESTART_SHARE, AGAIN_SHARE, DRAWS = 0.4, 0.3, 12


@dataclass(frozen=True)
class FitSettings(Declared):
    """Free parameters, images and effort of a fit."""

    frames: str = parameter(
        "", "Frames", "Images of the sequence, such as 0,5,10 or 0:20:5; empty: six, evenly spaced", shown=True
    )
    free: str = parameter(
        "display, tissues", "Free parameters",
        'Comma-separated: "display", "tissues", a tissue, or a parameter (gain_db, white matter.mu0)',
    )  # fmt: skip
    estimate: bool = parameter(
        False, "Find the geometry in the images",
        "Estimate the geometry of the probe, but not its frequency and beam, from the images",
        shown=True,
    )  # fmt: skip
    register: bool = parameter(
        False, "Also register",
        "Also fit a rigid transform of the real ultrasound to the MRI; takes longer", shown=True,
        option="register/no-register",
    )  # fmt: skip
    evaluations: int = parameter(
        1000, "Evaluations",
        "Largest number of evaluations of the cost, with restarts; registration, speckle and prediction take more",
        bounds=(1, 1_000_000), shown=Shown(10, 100_000, 100), option="evaluations",
    )  # fmt: skip
    restarts: int = parameter(
        2, "Restarts", "Additional searches from other starting points, to find equally good fits",
        bounds=(0, 100), option="restarts",
    )  # fmt: skip
    speckle: bool = parameter(
        False, "Also fit the speckle",
        "Also estimate the grey map, the smoothing and the tissues' texture from the speckle of the real images",
        shown=True, option="speckle/no-speckle",
    )  # fmt: skip
    validate: str = parameter(
        "", "Predict",
        "Images of the sequence to predict instead of fit, such as 2,6; empty: none",
        option="validate",
    )  # fmt: skip

    @property
    def free_names(self) -> list[str]:
        """The free parameters one by one."""
        return [name.strip() for name in self.free.split(",") if name.strip()]

    @property
    def of_search(self) -> int:
        """Evaluations of the search, such that with those of restarts there are at most `evaluations`, from 30 on."""
        share = 1.0 + (self.restarts * RESTART_SHARE + AGAIN_SHARE if self.restarts else 0.0)
        return max(int((self.evaluations - DRAWS - 2 * self.restarts) / share), self.evaluations // 4, 1)

    def _owner(self) -> str:
        return "fit"
