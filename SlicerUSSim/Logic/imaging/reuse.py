"""A simulator for inputs that change one at a time, as in a pipeline or a scene."""

from __future__ import annotations

import logging
from collections.abc import Hashable

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

_log = logging.getLogger(__name__)


class ReusedSimulator:
    """Keeps an UltrasoundSimulator and rebuilds it only if the voxels on the device must change."""

    def __init__(self) -> None:
        self._simulator: UltrasoundSimulator | None = None
        self._built_for: tuple | None = None

    def get(
        self,
        labels_version: Hashable,
        labels: Volume,
        tissues: TissueTable,
        settings: SimulationSettings,
        device: DeviceChoice = None,
        texture: Texture | None = None,
        sheets: Surfels | None = None,
    ) -> UltrasoundSimulator:
        """A simulator for these inputs; voxels are considered equal as long as `labels_version` is equal.

        Raises SimulationError as UltrasoundSimulator does; the next call then builds a new simulator.
        """
        # Of the settings, only the use of the texture affects data on the device; others apply per frame.
        wanted = (labels_version, texture, device, sheets, settings.partial_volume, settings.mri_modulation_db)
        if self._simulator is None or self._built_for != wanted:
            _log.debug("a simulator is built: %s", "the first" if self._built_for is None else self._changed(wanted))
            self.forget()
            self._simulator = UltrasoundSimulator(labels, tissues, settings, device, texture, sheets)
            self._built_for = wanted
        elif self._simulator.medium.tissues != tissues:
            self._simulator.set_tissues(tissues)
        self._simulator.settings = settings
        return self._simulator

    def _changed(self, wanted: tuple) -> str:
        names = ("labels", "texture", "device", "sheets", "partial_volume", "mri_modulation_db")
        values = zip(names, wanted, self._built_for or wanted, strict=True)
        return ", ".join(name for name, new, old in values if new != old) + " changed"

    def forget(self) -> None:
        """Release the device's memory."""
        self._simulator = self._built_for = None
