"""UltrasoundSimulator: runs the stages from a label map and a pose to a B-mode image."""

from __future__ import annotations

import logging
import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from numbers import Integral
from threading import RLock
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import ref

import numpy as np

from SlicerUSSim.Logic.base.declaration import parameters_of
from SlicerUSSim.Logic.base.errors import require, require_kind, required
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging import quality, stages
from SlicerUSSim.Logic.imaging.aperture import Aperture, aperture_fields
from SlicerUSSim.Logic.imaging.batch import arrays_for, fetched, one_per_image, same_shapes
from SlicerUSSim.Logic.imaging.bmode import downshift, log_band_above, pulse_taps
from SlicerUSSim.Logic.imaging.compounding import Compounder, sweep_grid
from SlicerUSSim.Logic.imaging.contact import line_contact
from SlicerUSSim.Logic.imaging.frame import Echoes, Frame
from SlicerUSSim.Logic.imaging.medium import Medium, as_labels
from SlicerUSSim.Logic.imaging.noise import require_seed, stirred
from SlicerUSSim.Logic.imaging.raytracing import RayTracer
from SlicerUSSim.Logic.imaging.scattering import cells_in_view, sites_per_mm3
from SlicerUSSim.Logic.imaging.signals import RayTree
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device, DeviceChoice
from SlicerUSSim.Logic.opencl.layout import ACQUISITION, CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import CURVED
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.sheet_looks import DURA_ISOTROPIC, dura_label
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

if TYPE_CHECKING:
    from pyopencl import Buffer

#: Frames whose signals stay on the device: one, and the previous one, which is freed with the next assignment
_ON_DEVICE = 2
#: Beyond all fields
_FAR_MM = 1e6
#: Part of an image beyond the volume, in tissue, that triggers a warning
_TOLD_SHARE = 0.01
#: Cells of the scatterer lattice per image: about 5 s on two cores, what is not begun, and per second there (measured
#: with tall beams; two to three times as many with low ones)
_MANY_CELLS, _MOST_CELLS, _CELLS_PER_S = 1.5e8, 1e10, 3e7
_DEFAULT_DISPLAY = DisplaySettings()
_log = logging.getLogger(__name__)

StageKind = TypeVar("StageKind", bound=Stage)


class EmptyViewWarning(UserWarning):
    """The imaged field is completely outside the volume, or that has no labels: the image shows nothing of it."""


class SlowScatterersWarning(UserWarning):
    """The lattice of scatterers is so dense that an image takes long."""


class TreeOverflowWarning(UserWarning):
    """Scan lines have more ray segments than the buffer can hold; the speckle of the last ones is missing."""


class UltrasoundSimulator:
    """Simulates B-mode images of one patient.

    Parameters
    ----------
    labels : Volume of tissue labels; 0 is the coupling medium around the patient.
    tissues : TissueTable with a tissue for every label.
    settings : SimulationSettings. The attribute may be replaced between frames, for example by another seed; the
        settings of the texture only apply at construction.
    device : see opencl.devices.choose_device.
    texture : data from the MRI in addition to labels (Segmentation.texture, Texture.from_mri). Its probabilities place
        borders between voxels; scatterers use it with the settings partial_volume or mri_modulation_db.
    sheets : thin sheets found in the MRI (mri.sheets.find_sheets, .surfels), of the kinds that are to be drawn. They
        replace the lines that labels have in their place; None or none: the lines of the labels.

    Raises SimulationError for labels without a tissue, if a required texture is missing or has another shape, and if no
    device can be used.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import LinearProbe, TissueTable, UltrasoundSimulator, Volume
    >>> from SlicerUSSim.Logic.probe import pose_looking_at
    >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
    >>> simulator = UltrasoundSimulator(labels, TissueTable.named(["liver"]))
    >>> probe = LinearProbe(width_mm=20, depth_mm=30, scan_lines=64)
    >>> frame = simulator.simulate(probe, pose_looking_at(face_ras=(20, 20, 39), target_ras=(20, 20, 0)))
    >>> frame.image.shape, frame.image.dtype  # rows, columns
    ((512, 342), dtype('uint8'))
    """

    def __init__(
        self,
        labels: Volume,
        tissues: TissueTable,
        settings: SimulationSettings | None = None,
        device: DeviceChoice = None,
        texture: Texture | None = None,
        sheets: Surfels | None = None,
    ) -> None:
        require_kind("labels", labels, Volume, "Volume.read reads a file")
        require_kind("tissues", tissues, TissueTable, "TissueTable.brain makes one")
        self.settings = SimulationSettings() if settings is None else settings
        require(
            isinstance(self.settings, SimulationSettings),
            f"settings are {self.settings!r:.80}, expected SimulationSettings",
        )
        self.device = Device.get(device)
        self._device_choice = device if isinstance(device, str) else None
        #: As given, in the order of voxels of medium.labels; or None
        self.texture = texture = None if texture is None else texture.along(labels)
        labels = labels.along()  # kernels draw the tissues at borders along the axes of voxels
        packed = _packed_texture(texture, labels, self.settings)
        membership = None if texture is None else texture.membership()
        self.medium = Medium(labels, tissues, self.device, packed, membership, sheets)
        #: The stages of stages.py, also for the appearance model
        self.impulse_stages = [stage(self.device) for stage in stages.IMPULSE_STAGES]
        self.linear_stages = [stage(self.device) for stage in stages.LINEAR_STAGES]
        self.display_stages = [stage(self.device) for stage in stages.DISPLAY_STAGES]
        self.tracer = self.stage(RayTracer)
        self._acquisition_buffer = self.device.empty(ACQUISITION.itemsize)
        # The record of the last frame, and its inputs except the pose
        self._record: np.ndarray | None = None
        self._record_made_for: tuple | None = None
        # The baseband signal of the last frame, and its inputs
        self._iq: Buffer
        self._iq_made_for: tuple | None = None
        # The images shown so far, weighted by persistence, and for what
        self._shown: tuple[tuple, np.ndarray] | None = None
        #: Measure every stage (Frame.timings_ms); the host then waits for each stage.
        self.profiling = False
        self._told_share = 0.0  # of an image beyond the volume
        # The last frames, whose signals may still be on the device
        self._recent: deque[ref[Frame]] = deque()
        # Threads may share a simulator: its buffers hold one frame at a time
        self._lock = RLock()

    @classmethod
    def from_mri(
        cls, mri: Volume | str | os.PathLike, settings: SimulationSettings | None = None, device: DeviceChoice = None,
        **segmentation: Any,
    ) -> UltrasoundSimulator:  # fmt: skip
        """From an MRI or CT, or its file, to a simulator: segmented, with preset tissues and texture.

        `segmentation` are values of SegmentationSettings, such as contrast="t2" or thin_sulci=True, and arguments of
        segment_image, such as mask or progress: a whole head takes some 20 s. medium.labels is the label map, for
        example for craniotomy_pose. Raises SimulationError as Volume.read and segment_image do.
        """
        from SlicerUSSim.Logic.mri.modality import segment_image  # a simulator of labels does not wait for it

        image = mri if isinstance(mri, Volume) else Volume.read(mri)
        found = segment_image(image, device=device, **segmentation)
        return cls(found.labels, TissueTable.brain(found.tissue_names), settings, device, found.texture())

    def __reduce__(self) -> tuple:
        """Pickled by its arguments: where it is unpickled, it is built anew, on the device chosen by name or there."""
        medium = self.medium
        return type(self), (
            medium.labels, medium.tissues, self.settings, self._device_choice, self.texture, medium.sheets
        )  # fmt: skip

    def simulate(
        self,
        probe: Probe,
        probe_to_ras: np.ndarray,
        display: DisplaySettings | None = None,
        grid: ImageGrid | None = None,
        *,
        noise_seed: int = 0,
    ) -> Frame:
        """The image of `probe` at the pose `probe_to_ras` (4, 4), with the same noise each time (noise_seed 0).

        With display.persistence the image also shows what was in the last ones of this probe, grid and persistence.
        `grid` gives the pixels, for example those of a real image; by default they cover the bounding box of the imaged
        field, with display.image_size pixels. `noise_seed` selects the amplifier noise (noise.py): 0 depends only on
        the settings' seed, seed_of_pose(probe_to_ras) also on the pose.
        Warns with EmptyViewWarning if the field is outside the volume, whose last tissue continues there, and with
        SlowScatterersWarning if there are so many scatterers that it takes more than seconds on a CPU.
        Raises SimulationError if it would take minutes, for a pose that is not rigid and a noise_seed that is not a
        whole number of 32 bits.
        """
        require_kind("probe", probe, Probe, "a ConvexProbe, LinearProbe or PhasedProbe")
        if display is not None:
            require_kind("display", display, DisplaySettings)
        pose = check_rigid("probe_to_ras", probe_to_ras)
        self.warn_if_slow(probe)
        timings: dict[str, float] = {}
        with self._lock:
            frame = self.render(probe, pose, display, grid, noise_seed, timings=timings)
            self._warn_if_empty(probe, pose)  # while the device computes
            with self._timed("download", timings):
                image = self._persisted(frame.download("image"), probe, display, frame.grid)
                self._warn_if_overflown()
            samples = quality.line_shape(frame.probe, frame.settings)[1]
            iq, envelope, bmode = (frame.on_demand(name, samples) for name in ("iq", "envelope", "grey"))
            made = Frame(
                iq=iq,
                envelope=envelope,
                bmode=bmode,
                image=image,
                sample_interval_mm=quality.sample_mm(frame.probe, frame.settings),
                cycles_per_mm=quality.cycles_per_mm(probe, self.settings),
                grid=frame.grid,
                probe_to_ras=pose,
                timings_ms=timings,
                probe=probe,
                patient=self.medium.labels,
                reference_speed_m_s=frame.settings.reference_speed_m_s,
            )
            self._recent.append(ref(made))
            if len(self._recent) > _ON_DEVICE and (oldest := self._recent.popleft()()) is not None:
                oldest.download()
        return made

    def simulate_batch(
        self,
        probes: Probe | Sequence[Probe],
        poses: Iterable[np.ndarray],
        *,
        display: DisplaySettings | Sequence[DisplaySettings] | None = None,
        tissues: TissueTable | Sequence[TissueTable] | None = None,
        settings: SimulationSettings | Sequence[SimulationSettings] | None = None,
        outputs: Sequence[str] = ("image",),
        out: Mapping[str, np.ndarray] | None = None,
        noise_seed: int | Sequence[int] = 0,
    ) -> dict[str, np.ndarray]:
        """{output: array} of images at `poses` (n, 4, 4); image i has the noise_seed + i, or its own.

        One image is prepared while the device computes the previous one, and only the outputs are downloaded.

        Parameters
        ----------
        probes, display, tissues, settings : one for all images, or one for each; tissues and settings by default the
            simulator's. The images do not follow each other: display.persistence has no effect.
        outputs : some of "image" (n, rows, columns) uint8; "labels", the tissue labels at the places of the pixels, and
            "labels_as_imaged", where travel time and refraction put them, both (n, rows, columns) uint8 and 0 outside
            the imaged field; "depth" (n, rows, columns) float32, mm along the scan line, nan outside; "iq" complex64,
            "rf", its real signal, and "envelope" float32, and "bmode" uint8 (n, scan_lines, samples).
        out : {output: array} to write to, with all outputs, such as np.memmap. Without it arrays for which memory is
            short are temporary files (in TMPDIR), which go with them.

        Warns as simulate(). Raises SimulationError, before anything is computed, as simulate(), for images of different
        sizes, for an `out` of another shape or type, and for the "rf" of drafts, whose samples cannot hold it.

        >>> import numpy as np
        >>> from SlicerUSSim.Logic import DisplaySettings, LinearProbe, TissueTable, UltrasoundSimulator, Volume
        >>> from SlicerUSSim.Logic.probe import pose_looking_at, slide_sweep
        >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
        >>> simulator = UltrasoundSimulator(labels, TissueTable.named(["liver"]))
        >>> poses = slide_sweep(pose_looking_at((20, 20, 39), (20, 20, 0)), length_mm=4, frames=3)
        >>> display, probe = DisplaySettings(image_size=(128, 96)), LinearProbe(width_mm=20, depth_mm=30)
        >>> pairs = simulator.simulate_batch(probe, poses, display=display, outputs=("image", "labels"))
        >>> pairs["image"].shape, pairs["labels"].shape
        ((3, 128, 96), (3, 128, 96))
        """
        require_kind("poses", poses, Iterable, "of (4, 4) probe_to_ras")
        poses = [check_rigid(f"pose {number}", pose) for number, pose in enumerate(poses)]
        require(bool(poses), "the batch has no pose, expected at least one")
        probes, displays, tables, each, noise_seeds = (
            one_per_image(name, given, kind, len(poses))
            for name, given, kind in (
                ("probes", probes, Probe), ("display", display, DisplaySettings), ("tissues", tissues, TissueTable),
                ("settings", settings or self.settings, SimulationSettings), ("noise_seed", noise_seed, Integral),
            )
        )  # fmt: skip
        for seed in noise_seeds:
            require_seed(seed)
        grids = [
            ImageGrid.for_probe(probe, shown and shown.image_size)
            for probe, shown in zip(probes, displays, strict=True)
        ]
        sizes = [(grid.rows, grid.columns) for grid in grids]
        pixels = same_shapes(sizes, "set display.image_size, or simulate them apart")
        works = [quality.worked(*both, pixels[1]) for both in zip(probes, each, strict=True)]
        arrays = arrays_for(outputs, pixels, works, out)
        for both in dict.fromkeys(zip(probes, each, strict=True)):
            self.warn_if_slow(*both)

        def jobs() -> Iterator[tuple]:
            before = None
            for number, table in enumerate(tables):
                if table is not before:
                    self.set_tissues(table)
                    before = table
                if "labels_as_imaged" in arrays:
                    self.forget_echoes()  # they need the rays, too
                yield probes[number], poses[number], displays[number], grids[number], noise_seeds[number], each[number]

        def start(number: int, frame: DeviceFrame) -> Callable[[], None]:
            fetching = {name: fetched(name, frame, poses[number]) for name in arrays}

            def complete() -> None:
                for name, output in fetching.items():
                    arrays[name][number] = output()

            return complete

        with ExitStack() as stack:
            if tissues is not None:  # of this batch alone
                stack.enter_context(self._lock)
                stack.enter_context(self.with_tissues(self.medium.tissues))
            self._in_turn(jobs(), start)
        self._warn_if_overflown(len(poses))
        return arrays

    def redisplay(
        self, echoes: Echoes, probe: Probe, settings: SimulationSettings, display: DisplaySettings, noise_seed: int = 0
    ) -> np.ndarray:
        """(rows, columns) uint8 image of echoes that were kept, without earlier images (display.persistence).

        `probe`, `settings` and `noise_seed` belong to the echoes; the patient of this simulator does not matter.
        """
        with self._lock:
            grid = ImageGrid.for_probe(probe, display.image_size)
            made_by = replace(settings, contact_gap_mm=None)  # the echoes have that of contact already
            probe, settings = quality.worked(probe, made_by, grid.columns)
            frame = self.device_frame(
                replace(probe, scan_lines=len(echoes.parts)), echoes.probe_to_ras, display, grid, noise_seed,
                self._acquisition_buffer, settings,
            )  # fmt: skip
            frame.iq = self.device.upload(echoes.iq(frame.line_shape[1]))
            self._run(self.display_stages, frame, {})
            return frame.download("image")

    def _persisted(
        self, image: np.ndarray, probe: Probe, display: DisplaySettings | None, grid: ImageGrid
    ) -> np.ndarray:
        """(rows, columns) uint8 image with what stays of the last ones."""
        part = 0.0 if display is None else display.persistence
        made_for = (probe, grid, part)
        if part == 0.0 or self._shown is None or self._shown[0] != made_for:
            self._shown = None if part == 0.0 else (made_for, image.astype(np.float32))
            return image
        lasting = self._shown[1]  # not rounded: small changes would never arrive
        lasting *= np.float32(part)
        lasting += np.float32(1.0 - part) * image
        return np.rint(lasting).astype(np.uint8)

    def forget_echoes(self) -> None:
        """Recompute the rays and echoes of the next frame, even if nothing has changed.

        For measurements, and after the stages were run from outside, since their buffers then have another frame.
        """
        self._iq_made_for = None

    def render(
        self,
        probe: Probe,
        pose: np.ndarray,
        display: DisplaySettings | None = None,
        grid: ImageGrid | None = None,
        noise_seed: int = 0,
        settings: SimulationSettings | None = None,
        *,
        timings: dict[str, float] | None = None,
    ) -> DeviceFrame:
        """Enqueue all stages of one frame, whose image is on the device until the next one overwrites it.

        `settings` replace those of the simulator. If only the display, the noise or the pixels have changed since the
        last frame, its echoes are reused.
        """
        timings = {} if timings is None else timings
        with self._lock:
            with self._timed("upload", timings):
                grid = grid or ImageGrid.for_probe(probe, None if display is None else display.image_size)
                probe, settings = quality.worked(probe, settings or self.settings, grid.columns)
                frame = self.device_frame(probe, pose, display, grid, noise_seed, self._acquisition_buffer, settings)
            # The baseband signal does not depend on display, noise or pixels.
            inputs = (frame.acquisition.tobytes(), settings, self.medium.version)
            if self.profiling or self._iq_made_for != inputs:
                _log.debug("frame: rays and echoes computed")
                self._iq_made_for = None
                self._run([*self.impulse_stages, *self.linear_stages], frame, timings)
                self._iq, self._iq_made_for = frame.iq, inputs
            else:
                _log.debug("frame: the echoes of the last frame are reused")
            frame.iq = self._iq
            self._run(self.display_stages, frame, timings)
            return frame

    def _run(self, chosen: Iterable[Stage], frame: DeviceFrame, timings: dict[str, float]) -> None:
        for stage in chosen:
            with self._timed(stage.name, timings):
                stage.run(frame)

    @property
    def stages(self) -> list[Stage]:
        """All stages, in order."""
        return [*self.impulse_stages, *self.linear_stages, *self.display_stages]

    def stage(self, kind: type[StageKind]) -> StageKind:
        """The stage of a class, such as scattering.Scatterers. Raises SimulationError if no list has it."""
        found = next((stage for stage in self.stages if isinstance(stage, kind)), None)
        return required(found, f"no stage is a {kind.__name__}, see imaging/stages.py")

    def trace(self, probe: Probe, probe_to_ras: np.ndarray) -> RayTree:
        """The ray tree, on the host: segments along the beam axes and interface hits."""
        pose = check_rigid("probe_to_ras", probe_to_ras)
        with self._lock:
            self.trace_rays(self.device_frame(probe, pose, buffer=self._acquisition_buffer))
            return self.tracer.download()

    def trace_rays(self, frame: DeviceFrame, with_level: bool = True) -> None:
        """Enqueue the stages up to the ray tree of `frame`; `with_level` as in Aperture.run."""
        self.stage(Aperture).run(frame, with_level)
        self.tracer.run(frame)

    def sweep(
        self,
        probe: Probe,
        poses: Iterable[np.ndarray],
        display: DisplaySettings | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Iterator[Frame]:
        """Yields one Frame per pose, whose noise differs: that of simulate() with noise_seed 0, 1, 2, ...

        `progress` is called with the number done.
        """
        require_kind("poses", poses, Iterable, "of (4, 4) probe_to_ras")
        for number, pose in enumerate(poses):
            yield self.simulate(probe, pose, display, noise_seed=number)
            if progress is not None:
                progress(number + 1)

    def volume(
        self,
        probe: Probe,
        poses: Iterable[np.ndarray],
        display: DisplaySettings | None = None,
        *,
        spacing_mm: float = 0.5,
        like: Volume | None = None,
        hole_mm: float | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Volume:
        """A 3D image: the sweep over `poses` (regular or freehand), compounded in patient space, holes filled.

        `like` gives the grid, for example the MRI; without it the grid is along the patient's axes with `spacing_mm`.
        Gaps between images are filled up to a width of `hole_mm` (default: the widest gap of the sweep, at most 10 mm).
        The grey levels are uint8, and 0 without an image nearby. The noise of the images is as in sweep().
        Raises SimulationError as sweep_grid and Compounder do.

        >>> import numpy as np
        >>> from SlicerUSSim.Logic import LinearProbe, TissueTable, UltrasoundSimulator, Volume
        >>> from SlicerUSSim.Logic.probe import pose_looking_at, slide_sweep
        >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
        >>> simulator = UltrasoundSimulator(labels, TissueTable.named(["liver"]))
        >>> probe = LinearProbe(width_mm=20, depth_mm=30, scan_lines=64)
        >>> pose = pose_looking_at(face_ras=(20, 20, 39), target_ras=(20, 20, 0))
        >>> volume = simulator.volume(probe, slide_sweep(pose, length_mm=8, frames=9), spacing_mm=1.0)
        >>> volume.spacing_mm.tolist()
        [1.0, 1.0, 1.0]
        """
        require_kind("probe", probe, Probe, "a ConvexProbe, LinearProbe or PhasedProbe")
        require_kind("poses", poses, Iterable, "of (4, 4) probe_to_ras")
        poses = [check_rigid("probe_to_ras", pose) for pose in poses]
        self.warn_if_slow(probe)
        grid = like if like is not None else sweep_grid(probe, poses, spacing_mm)
        _log.info(
            "%d images are compounded in %s voxels %s", len(poses), "x".join(map(str, grid.array.shape[::-1])),
            "along the patient's axes" if like is None else "of the grid given",
        )  # fmt: skip
        compounder = Compounder(grid, probe, self.device)
        display = DisplaySettings() if display is None else display
        pixels = ImageGrid.for_probe(probe, display.image_size)

        def start(number: int, frame: DeviceFrame) -> Callable[[], object]:
            compounder.add_buffer(frame.image, pixels, poses[number])
            return self.device.mark().wait

        jobs = ((probe, pose, display, pixels, number) for number, pose in enumerate(poses))
        self._in_turn(jobs, start, progress)
        self._warn_if_overflown(len(poses))
        return compounder.volume(hole_mm)

    def _in_turn(
        self,
        jobs: Iterable[tuple],
        start: Callable[[int, DeviceFrame], Callable[[], object]],
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Enqueue images, each by arguments of render(), and call what `start` gives to complete them.

        While the device computes an image, the host completes the previous one and prepares the next, no more than one.
        """
        before: Callable[[], object] | None = None
        for number, job in enumerate(jobs):
            with self._lock:  # for one image, so that others need not wait for all
                frame = self.render(*job)
                complete = start(number, frame)
                self.device.queue.flush()
            self._warn_if_empty(*job[:2], stacklevel=4)
            if before is not None:
                before()
            before = complete
            if progress is not None:
                progress(number + 1)
        if before is not None:
            before()

    def set_tissues(self, tissues: TissueTable) -> None:
        """Change tissue parameters without rebuilding the medium."""
        with self._lock:
            self.medium.set_tissues(tissues)

    @contextmanager
    def with_tissues(self, tissues: TissueTable) -> Iterator[None]:
        """Simulate with other tissues within the block."""
        before = self.medium.tissues
        try:
            self.set_tissues(tissues)
            yield
        finally:
            self.set_tissues(before)

    # ---- the acquisition record --------------------------------------------------------------------------------------

    def device_frame(
        self,
        probe: Probe,
        pose: np.ndarray,
        display: DisplaySettings | None = None,
        grid: ImageGrid | None = None,
        noise_seed: int = 0,
        buffer: Buffer | None = None,
        settings: SimulationSettings | None = None,
    ) -> DeviceFrame:
        """The inputs of the stages of one frame; its record is written to `buffer`, by default a new one.

        Of full quality, unless probe and `settings` (default: the simulator's) come from quality.worked.
        """
        display, settings = _DEFAULT_DISPLAY if display is None else display, settings or self.settings
        require(isinstance(display, DisplaySettings), f"display is {display!r:.80}, expected DisplaySettings")
        gap_mm = settings.contact_gap_mm
        frame = DeviceFrame(
            probe=probe,
            settings=settings,
            contact=None if gap_mm is None else line_contact(self.medium.labels, probe, pose, gap_mm),
            acquisition=self.acquisition(probe, pose, settings),
            axial_sigma_mm=quality.axial_sigma_mm(probe, settings),
            display=display,
            grid=grid or ImageGrid.for_probe(probe, display.image_size),
            noise_seed=noise_seed,
            acquisition_buffer=buffer or self.device.empty(ACQUISITION.itemsize),
            medium=self.medium,
        )
        self.device.write(frame.acquisition_buffer, frame.acquisition)
        return frame

    def acquisition(self, probe: Probe, pose: np.ndarray, settings: SimulationSettings | None = None) -> np.ndarray:
        """The record (layout.ACQUISITION) of the constants of one frame, by default with the simulator's settings."""
        settings = settings or self.settings
        made_for = probe, settings, self.medium.version
        if self._record is None or self._record_made_for != made_for:
            self._record, self._record_made_for = self._record_of(probe, settings), made_for
        acquisition = self._record.copy()
        acquisition["probe_to_ras"] = pose[:3].ravel()
        return acquisition

    def _record_of(self, probe: Probe, settings: SimulationSettings) -> np.ndarray:
        """The part of the record that does not depend on the pose."""
        medium, step_mm = self.medium, quality.sample_mm(probe, settings)
        block = CONSTANTS["BLOCK"]
        axial_sigma = quality.axial_sigma_mm(probe, settings)
        acquisition = np.zeros((), ACQUISITION)
        for owner in (probe, settings):
            for parameter in parameters_of(type(owner)):
                if parameter.name in (ACQUISITION.names or ()):
                    acquisition[parameter.name] = getattr(owner, parameter.name)
        acquisition["ras_to_voxel"] = medium.ras_to_voxel.ravel()
        acquisition["dims"] = medium.dims
        acquisition["voxel_mm"] = medium.labels.spacing_mm.min()
        acquisition["smooth_groups"] = medium.smooth_groups
        acquisition["membrane_reach"] = medium.membrane_reach
        acquisition["sheet_label"] = medium.sheet_label
        acquisition["dura_label"] = dura_label(medium.tissues)
        acquisition["dura_isotropic"] = DURA_ISOTROPIC
        membrane = medium.tissues.membrane
        if membrane is not None:
            acquisition["sheet_reach_mm"] = 0.5 * membrane.thickness_mm
            acquisition["membrane_gain"] = 10.0 ** (membrane.diffuse_db / 20.0)
            of_sheets = membrane.sheet_exponent
            acquisition["membrane_exponent"] = membrane.diffuse_exponent
            acquisition["sheet_exponent"] = membrane.diffuse_exponent if of_sheets is None else of_sheets
            acquisition["patches_per_mm"] = 1.0 / membrane.patch_mm
            acquisition["membrane_variation"] = membrane.roughness_octaves
            acquisition["membrane_octaves"] = membrane.patch_db / 6.0206
            # 2 k s of the range's deviation s: the carrier has 2 k / 2 pi cycles per millimetre of depth.
            acquisition["membrane_phase"] = 2.0 * np.pi * quality.cycles_per_mm(probe, settings) * membrane.roughness_mm
        acquisition["linear"] = probe.is_linear
        acquisition["apex_radius_mm"] = 0.0 if probe.is_linear else probe.apex_radius_mm
        for name, value in steering_fields(probe).items():
            acquisition[name] = value
        acquisition["face_reflection"] = probe.face_reflection
        acquisition["face_half_mm"] = 0.5 * probe.face_mm
        acquisition["face_half_height_mm"] = 0.5 * probe.elevation_aperture_mm
        acquisition["first_line"] = probe.first_line
        acquisition["line_spacing"] = probe.line_spacing
        acquisition["frequency_mhz"] = probe.received_mhz
        acquisition["fractional_bandwidth"] = probe.received_bandwidth
        acquisition["cycles_per_mm"] = quality.cycles_per_mm(probe, settings)
        acquisition["sample_mm"] = step_mm
        # The last samples of the image have echoes from half a pulse behind it. Borders are found by labels, up to a
        # voxel behind where they are.
        behind = pulse_taps(axial_sigma / step_mm).size // 2
        acquisition["samples"] = -(-(quality.line_shape(probe, settings)[1] + behind) // block) * block
        acquisition["traced_mm"] = probe.displayed_mm + behind * step_mm + medium.labels.spacing_mm.min()
        acquisition["wavefront_curvature"] = CURVED if settings.wavefront_curvature else 0.0
        for name, value in transmit_fields(probe).items():
            acquisition[name] = value
        acquisition["receive_sigma_min"], acquisition["receive_sigma_slope"] = probe.receive_beam()
        acquisition["elevation_sigma"] = probe.lens().sigma_mm
        _, acquisition["elevation_focus"], acquisition["elevation_rayleigh"] = probe.elevation_waist()
        acquisition["max_ray_depth"] = settings.max_ray_depth if settings.reflections else 0
        lateral, guard = _traced_lines_for(probe, settings)
        acquisition["lateral_rays"], acquisition["guard_lines"] = lateral, guard
        traced = acquisition["traced_lines"] = (probe.scan_lines - 1) * lateral + 1 + 2 * guard
        voxel_mm = float(acquisition["voxel_mm"])
        for name, value in aperture_fields(probe, settings, voxel_mm, traced, guard, lateral).items():
            acquisition[name] = value
        acquisition["interface_gain"] = 10.0 ** (settings.interface_gain_db / 20.0)
        acquisition["interface_is_energy"] = settings.interface_reflection == "energy"
        density = sites_per_mm3(settings, probe)
        shift = acquisition["downshift"] = downshift(probe) if settings.frequency_downshift else 0.0
        acquisition["band_above"] = log_band_above(shift)
        acquisition["cell_mm"] = density ** (-1.0 / 3.0)
        acquisition["seed"] = _mixed(settings.seed)
        # The integral of the squared point spread function is pi^1.5 times the product of the three sigmas.
        acquisition["speckle_scale"] = (density * np.pi**1.5 * axial_sigma) ** -0.5
        return acquisition

    def warn_if_slow(self, probe: Probe, settings: SimulationSettings | None = None) -> None:
        """Warn if an image has so many scatterers that it takes seconds; with the simulator's settings by default.

        Raises SimulationError, before anything is computed, if it would take minutes.
        """
        settings = settings or self.settings
        if not settings.scattering:
            return
        lateral, guard = _traced_lines_for(probe, settings)
        traced = (probe.scan_lines - 1) * lateral + 1 + 2 * guard
        cells = cells_in_view(settings, probe, traced, lateral, CONSTANTS["BLOCK"] * quality.sample_mm(probe, settings))
        if cells <= _MANY_CELLS:
            return
        automatic = replace(settings, scatterers_per_mm3=None)
        found = (
            f"{sites_per_mm3(settings, probe):.6g} scatterers per mm³ ({probe.frequency_mhz:g} MHz, elevation "
            f"aperture {probe.elevation_aperture_mm:g} mm, elevation focus {probe.elevation_focus_mm:g} mm) are "
            f"{cells:.1e} cells of the lattice per image, about {cells / _CELLS_PER_S:.0f} s on two cores of a CPU"
        )
        remedy = (
            f"fewer scatterers_per_mm3 (none: {sites_per_mm3(automatic, probe):.0f}), a smaller elevation aperture, a "
            "deeper elevation focus, fewer scan lines or a smaller depth takes less"
        )
        require(cells <= _MOST_CELLS, f"{found}, expected at most {_MOST_CELLS:.0e} cells; {remedy}")
        warnings.warn(f"{found}; {remedy}", SlowScatterersWarning, stacklevel=3)

    def _warn_if_empty(self, probe: Probe, pose: np.ndarray, stacklevel: int = 3) -> None:
        """Warn if the volume has no labels, or the bounding box of the imaged field, in voxels, does not meet it."""
        if list(self.medium.present) == [0] and not self.medium.tissues[0].scatterer_variance:
            warnings.warn(
                "the label map has no labels, only 0: the image has no echoes of tissue",
                EmptyViewWarning,
                stacklevel=stacklevel,
            )
        left, right, top, bottom = probe.image_bounds_mm()
        corners = np.array([[x, y, 0.0, 1.0] for x in (left, right) for y in (top, bottom)])
        voxels = (self.medium.labels.ras_to_ijk @ pose @ corners.T)[:3]
        size = np.array(self.medium.labels.array.shape[::-1])
        if (voxels.max(axis=1) < -0.5).any() or (voxels.min(axis=1) > size - 0.5).any():
            warnings.warn(
                "the probe looks past the volume: the image shows only its last tissue, continued", EmptyViewWarning,
                stacklevel=stacklevel,
            )  # fmt: skip
        elif self._told_share < 0.5 and ((voxels.min(axis=1) < -0.5) | (voxels.max(axis=1) > size - 0.5)).any():
            self._tell_of_end(probe, pose)

    def _tell_of_end(self, probe: Probe, pose: np.ndarray) -> None:
        """Log how much of the imaged field is beyond the volume; again only once that has doubled."""
        labels, depth = self.medium.labels, np.linspace(0.0, probe.depth_mm, 33)
        origins, directions = probe.origins_mm()[::4, :, None], probe.directions()[::4, :, None]
        place, to_voxel = np.moveaxis(origins + depth * directions, 1, -1).reshape(-1, 3), labels.ras_to_ijk @ pose
        voxel = place @ to_voxel[:3, :3].T + to_voxel[:3, 3]
        inside = np.clip(np.rint(voxel).astype(int), 0, np.array(labels.array.shape[::-1]) - 1)
        is_beyond = (np.abs(voxel - inside) > 0.5).any(axis=1) & (labels.array[tuple(inside.T[::-1])] != 0)
        share = float(is_beyond.mean())
        if share > max(_TOLD_SHARE, 2.0 * self._told_share):
            self._told_share = share
            end = "%.0f %% of the image is beyond the volume: it shows the tissue at the volume's end, not the patient"
            _log.warning(end, 100.0 * share)

    def _warn_if_overflown(self, frames: int = 1) -> None:
        lines, traced = self.tracer.overflown_lines(), frames * self.tracer.shape[0]
        if lines > 0.01 * traced:  # a single chaotic line is not noticeable
            warnings.warn(
                f"{lines} of {traced} traced lines have more than {CONSTANTS['MAX_SEGMENTS']} ray segments, "
                "the last are ignored; raise reflection_threshold or lower max_ray_depth",
                TreeOverflowWarning,
                stacklevel=3,
            )

    @contextmanager
    def _timed(self, name: str, timings: dict[str, float]) -> Iterator[None]:
        if not self.profiling:
            yield
            return
        start = perf_counter()
        yield
        self.device.queue.finish()
        timings[name] = (perf_counter() - start) * 1e3


def _packed_texture(texture: Texture | None, labels: Volume, settings: SimulationSettings) -> np.ndarray | None:
    """The texture in the device's format, or None if the settings do not require it."""
    require(
        texture is not None or not settings.needs_texture,
        f"partial_volume {settings.partial_volume}, mri_modulation_db {settings.mri_modulation_db:g} need a texture; "
        "pass segmentation.texture(), or Texture.from_mri(mri, labels) for your own label map",
    )
    is_mixed = settings.partial_volume is not False and texture is not None and bool(texture.second_share.any())
    if texture is None or not (is_mixed or settings.needs_texture):
        return None
    return texture.packed(as_labels(labels.array), is_mixed, settings.mri_modulation_db)


def steering_fields(probe: Probe) -> dict[str, Any]:
    """The fields of layout.ACQUISITION for lines that are not at right angles to the face."""
    starts = probe.line_starts_mm(probe.line_positions())
    steered = bool(starts.any())
    ends = probe.line_ends_mm(probe.line_positions())[:, 1]
    return {
        "depth_mm": probe.displayed_mm,
        "steered": steered,
        "flat_face": probe.has_flat_face,
        "steering_sin": np.sin(probe.steering_rad),
        "steering_cos": np.cos(probe.steering_rad),
        "start_mm": float(probe.line_starts_mm(0.0)),
        "top_mm": 0.0 if steered else -_FAR_MM,
        "bottom_mm": ends.max() if steered and probe.is_linear else _FAR_MM,
    }


def transmit_fields(probe: Probe) -> dict[str, Any]:
    """The fields of layout.ACQUISITION for the transmit beam."""
    waists, fields = np.zeros((CONSTANTS["MAX_ZONES"], 3)), {}
    zones = probe.transmit_zones()
    if zones:
        waists[: len(zones)] = zones
    else:
        waists[0, 0], fields["transmit_sigma_slope"] = probe.compounded_beam()
    fields["transmit_sigma"], fields["transmit_focus"], fields["transmit_rayleigh"] = waists.T
    longest = 2.0 * probe.depth_mm  # a beam in focus at every depth changes slowly
    return fields | {"transmit_zones": len(zones), "transmit_waist": min([zone[2] for zone in zones], default=longest)}


def _mixed(seed: int) -> int:
    """A hash of the seed, so that neighbouring seeds are independent."""
    return stirred(seed) ^ 0x2545F491


def _traced_lines_for(probe: Probe, settings: SimulationSettings) -> tuple[int, int]:
    """(traced lines per scan line, traced lines beyond either edge of the field).

    Traced lines are at most 1.5 lateral beam sigmas apart at any depth, so that sums over them approximate integrals.
    Those beyond the edge provide the other half of the beam for the outermost scan lines (if it is at most 16 lines
    wide, which is not the case only near the apex of a phased array).
    """
    depth, sigmas = quality.sigmas_between(probe)
    lateral = settings.lateral_rays or int(min(np.ceil(sigmas.max() / 1.5), 128))
    deep = sigmas[depth >= 0.1 * probe.depth_mm]
    return lateral, int(min(np.ceil(settings.beam_cutoff * lateral / deep.min()), 16 * lateral))
