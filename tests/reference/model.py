"""NumpyModel: the stages of UltrasoundSimulator from a pose to an image, in numpy."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from tests.reference.acquisition import acquisition_record, axial_sigma_mm
from tests.reference.floor import contact
from tests.reference.labels import Labels
from tests.reference.medium import HostMedium
from tests.reference.stages import TwinFrame, twin_of


class NumpyModel:
    """Simulates the images of `simulator` on the host.

    Of the simulator only the user's inputs are read (label map, tissues and settings), and the names and order of its
    stages; nothing is read from its device. Raises SimulationError for a simulator that uses a texture, which this
    model does not have, and for a stage without a twin.
    """

    def __init__(self, simulator: UltrasoundSimulator) -> None:
        require(
            not (simulator.medium.has_texture or simulator.settings.needs_texture),
            "NumpyModel has no texture, expected a simulator without one or partial_volume and mri_modulation_db 0",
        )
        self.simulator = simulator
        self._twins = {stage.name: twin_of(stage) for stage in simulator.stages}
        self._read_medium()
        #: Milliseconds per stage of the last image
        self.timings_ms: dict[str, float] = {}

    def _read_medium(self) -> None:
        given = self.simulator.medium
        self.medium = HostMedium(given.labels, given.tissues, given.membership, given.sheets)
        self._labels, self._whole = Labels(self.medium), given.labels

    def simulate(
        self,
        probe: Probe,
        probe_to_ras: np.ndarray,
        display: DisplaySettings | None = None,
        grid: ImageGrid | None = None,
        *,
        noise_seed: int = 0,
    ) -> np.ndarray:
        """(rows, columns) uint8 image; arguments as in UltrasoundSimulator.simulate."""
        if self.simulator.medium.tissues is not self.medium.tissues:
            self._read_medium()
        display, settings = display or DisplaySettings(), self.simulator.settings
        probe_to_ras, gap_mm = check_rigid("probe_to_ras", probe_to_ras), settings.contact_gap_mm
        record = acquisition_record(probe, probe_to_ras, settings, self.medium)
        frame = TwinFrame(
            probe=probe,
            settings=settings,
            acquisition=record,
            axial_sigma_mm=axial_sigma_mm(probe, settings),
            display=display,
            grid=grid or ImageGrid.for_probe(probe, display.image_size),
            noise_seed=noise_seed,
            contact=None if gap_mm is None else contact(record, self._whole, probe, probe_to_ras, gap_mm),
            labels=self._labels,
            tissues=self.medium.rows,
        )
        self.timings_ms = {}
        for name, twin in self._twins.items():
            start = perf_counter()
            twin(frame)
            self.timings_ms[name] = (perf_counter() - start) * 1e3
        return frame.image
