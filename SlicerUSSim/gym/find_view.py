"""FindView: move a probe over a patient until the image shows a target view."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require_between, require_package
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, turned
from SlicerUSSim.Logic.probe.surface import PatientSurface

require_package("gymnasium", "SlicerUSSim[gym]", "an environment")
import gymnasium  # noqa: E402, after the message about what to install

#: Largest motion of a step: degrees over the surface to the right and to the front, of rock, tilt and rotation
STEP_DEG = (3.0, 3.0, 5.0, 5.0, 10.0)
#: A radian of turn counts as so many millimetres of way, about the distance of what is looked at
_ARM_MM = 60.0
#: Reward for the target, and where an episode begins, in steps from it
_FOUND, _FARTHEST = 10.0, (8.0, 8.0, 4.0, 4.0, 6.0)


class FindView(gymnasium.Env):
    """A probe on the surface of a patient, whose image an agent sees, and a view that it is to find.

    Observation: (rows, columns, 1) uint8, a B-mode image. Action: (5,) from -1 to 1, parts of STEP_DEG.
    Reward: the millimetres by which the probe came nearer to the target, a radian counted as 60 mm, and 10 when it is
    there, which ends the episode. `info` has "distance_mm" and "probe_to_ras".

    Parameters
    ----------
    view : "craniotomy", or one of placement.VIEWS.
    simulator : of any patient; default: the MNI152 brain, one for all environments of a process. Its quality is draft.
    image_size : (rows, columns).
    within_mm : distance at which the target is found.

    "SlicerUSSim/FindView-v0" ends episodes after 100 steps. Raises SimulationError for an unknown view and a distance
    out of range.
    """

    def __init__(
        self, view: str = "craniotomy", *, simulator: UltrasoundSimulator | None = None,
        probe: Probe = PROBES["phased"], image_size: tuple[int, int] = (128, 160), within_mm: float = 4.0,
    ) -> None:  # fmt: skip
        require_between("FindView", "within_mm", within_mm, 0.1, 100.0)
        self.simulator = simulator or _demo_simulator()
        self.surface, self.target = _scene(self.simulator, view)
        self.probe, self.within_mm = probe, within_mm
        self._display = DisplaySettings(image_size=image_size)
        self.observation_space = gymnasium.spaces.Box(0, 255, (*image_size, 1), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(STEP_DEG),), np.float32)
        self._pose, self._step = self.target, 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A random pose around the target, not within its distance."""
        super().reset(seed=seed)
        self._pose, self._step = self.target, 0
        while self.distance_mm() <= self.within_mm:
            self._pose = self._moved(self.target, self.np_random.uniform(-1.0, 1.0, len(STEP_DEG)) * _FARTHEST)
        return self._image(), self._about()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """(image after a motion, reward, whether the target is found, False, info)."""
        before = self.distance_mm()
        self._pose = self._moved(self._pose, np.clip(np.asarray(action, float), -1.0, 1.0))
        self._step += 1
        after = self.distance_mm()
        is_found = after <= self.within_mm
        return self._image(), before - after + _FOUND * is_found, is_found, False, self._about()

    def distance_mm(self) -> float:
        """From the pose to the target: way and turn."""
        way = np.linalg.norm(self._pose[:3, 3] - self.target[:3, 3])
        cosine = 0.5 * (np.trace(self._pose[:3, :3].T @ self.target[:3, :3]) - 1.0)
        return float(np.hypot(way, _ARM_MM * np.arccos(np.clip(cosine, -1.0, 1.0))))

    def _moved(self, pose: np.ndarray, action: np.ndarray) -> np.ndarray:
        right, front, rock, tilt, rotate = action * STEP_DEG
        here = self.surface.angles(pose[:3, 3])
        pose = self.surface.slid(pose, self.surface.at(here[0] + right, here[1] + front), upright=False)
        return turned(pose, rock_deg=rock, tilt_deg=tilt, rotate_deg=rotate)

    def _image(self) -> np.ndarray:
        found = self.simulator.simulate_batch(self.probe, [self._pose], display=self._display, noise_seed=self._step)
        return found["image"][0][..., None]

    def _about(self) -> dict[str, Any]:
        return {"distance_mm": self.distance_mm(), "probe_to_ras": self._pose.copy()}


@lru_cache(maxsize=1)
def _demo_simulator() -> UltrasoundSimulator:
    return UltrasoundSimulator.from_mri(demo_mri()[0], SimulationSettings(quality="draft"))


@lru_cache(maxsize=8)
def _scene(simulator: UltrasoundSimulator, view: str) -> tuple[PatientSurface, np.ndarray]:
    """(surface of the patient, (4, 4) pose of the view)."""
    labels, names = simulator.medium.labels, simulator.medium.tissues.names_by_label()
    pose = craniotomy_pose(labels, PROBES["phased"]) if view == "craniotomy" else view_pose(labels, names, view)[0]
    return PatientSurface(labels), pose
