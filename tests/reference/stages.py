"""The twins of the stages: their implementation in numpy, on a TwinFrame, by the name of the stage.

Those of the first seven stages are here. Later stages define their own, Stage.on_host.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB
from SlicerUSSim.Logic.imaging.stage import HostFrame, Stage
from tests.reference.acquisition import (
    elevational_quantiles,
    harmonic_level,
    line_roots,
    noise_key,
    pulse_taps,
)
from tests.reference.aperture import Screens
from tests.reference.beam import Beam
from tests.reference.drawn import sheet_hits
from tests.reference.echoes import (
    add_interfaces,
    frequencies_along,
    lateral_beam,
    lobe_lines,
    scatterer_lines,
)
from tests.reference.elementary import f32, gaussian, hash_mix
from tests.reference.face import face_hits
from tests.reference.floor import (
    add_lateral_lobes,
    lines_of_a_path,
    lobe_lattice,
    quiet_labels,
    ring_down,
)
from tests.reference.labels import Labels
from tests.reference.lobes import elevational_table
from tests.reference.tracing import Tracer


@dataclass(eq=False)
class TwinFrame(HostFrame):
    """A HostFrame with the inputs and outputs of the stages before the baseband signal."""

    labels: Labels
    #: layout.TISSUE per label
    tissues: np.ndarray
    #: (screen lines, depths, 4) float32 of aperture.Screens.run
    screens: np.ndarray = field(init=False)
    #: (screen lines, depths, 2) float32, also of it
    spreads: np.ndarray = field(init=False)
    #: layout.SEGMENT and layout.HIT with their traced lines
    segments: np.ndarray = field(init=False)
    segment_lines: np.ndarray = field(init=False)
    hits: np.ndarray = field(init=False)
    hit_lines: np.ndarray = field(init=False)
    #: (scan lines, samples) float32 of echoes.frequencies_along
    frequencies: np.ndarray = field(init=False)
    #: (2 traced lines, samples) and (scan lines, samples) complex64 impulses
    traced: np.ndarray = field(init=False)
    scanned: np.ndarray = field(init=False)


def aperture(frame: TwinFrame) -> None:
    """What soft tissue does to the beams."""
    frame.screens, frame.spreads = Screens(frame.acquisition, frame.labels, frame.tissues).run()


def ray_tree(frame: TwinFrame) -> None:
    """Segments along the axes, hits of the elevational rays."""
    record = frame.acquisition
    tracer = Tracer(record, frame.labels, frame.tissues, frame.screens)
    quantiles = elevational_quantiles(int(record["traced_lines"]), int(record["elevational_rays"]))
    frame.segments, frame.segment_lines, frame.hits, frame.hit_lines = tracer.run(line_roots(record), quantiles)
    if frame.labels.drawn is not None:
        hits, lines = sheet_hits(record, frame.labels.drawn, quantiles, frame.segments, frame.segment_lines)
        frame.hits, frame.hit_lines = np.concatenate([frame.hits, hits]), np.concatenate([frame.hit_lines, lines])
    hits, lines = face_hits(record, quantiles, frame.segments, frame.segment_lines)
    frame.hits, frame.hit_lines = np.concatenate([frame.hits, hits]), np.concatenate([frame.hit_lines, lines])
    frame.frequencies = frequencies_along(record, frame.segments, frame.segment_lines)


def scatterers(frame: TwinFrame) -> None:
    """Impulses of speckle on the edges of the traced lines' strips, also of the elevational side lobes."""
    record = frame.acquisition
    frame.traced = np.zeros((2 * int(record["traced_lines"]), int(record["samples"])), np.complex64)
    if not frame.settings.scattering:
        return
    of_all = frame.labels, frame.tissues
    frame.traced += scatterer_lines(record, *of_all, frame.segments, frame.segment_lines)
    if frame.settings.side_lobes:
        frame.traced += lobe_lines(
            lobe_lattice(record), *of_all, frame.segments, frame.segment_lines, elevational_table(record, frame.probe),
            lines_of_a_path(record, frame.probe), quiet_labels(frame.tissues, frame.labels.given),
        )  # fmt: skip


def interfaces(frame: TwinFrame) -> None:
    """Impulses of the interfaces, added to those of speckle."""
    if frame.settings.interfaces:
        add_interfaces(frame.acquisition, frame.hits, frame.hit_lines, frame.scanned)


def beam(frame: TwinFrame) -> None:
    """Impulses of the scan lines."""
    frame.scanned = lateral_beam(frame.acquisition, frame.traced, frame.spreads, frame.frequencies)


def side_lobes(frame: TwinFrame) -> None:
    """Impulses of the lateral side lobes, added to those of the main beam."""
    if frame.settings.side_lobes:
        frame.scanned = add_lateral_lobes(frame.acquisition, frame.probe, frame.scanned)


def pulse(frame: TwinFrame) -> None:
    """The baseband signal."""
    taps = pulse_taps(frame.axial_sigma_mm / float(frame.acquisition["sample_mm"]))
    record, reach = frame.acquisition, len(taps) // 2
    missing = 1.0 - frame.frequencies.astype(float)
    step = float(record["sample_mm"]) * float(record["cycles_per_mm"])
    turns = np.cumsum(missing, axis=1) * step - 0.5 * step * (missing + missing[:, :1])
    turning = np.exp(2j * np.pi * turns)
    # Of an echo between two samples, which have one phase: the mean of |1 - t + t exp(i angle)|^2
    kept = (2.0 + np.cos(2.0 * np.pi * step * missing)) / 3.0
    lines = (frame.scanned * turning / np.sqrt(kept)).astype(np.complex64)
    if frame.probe.harmonic:
        starts = Beam(record).line_start(np.arange(len(lines))) / record["sample_mm"]
        below = np.maximum(np.arange(lines.shape[1]) - np.floor(starts + f32(0.5)).astype(int)[:, None], 0)
        lines *= f32(harmonic_level(frame.probe, np.arange(lines.shape[1]) * float(record["sample_mm"])))[below]
    if frame.contact is not None:
        lines *= frame.contact[:, None]
    padded = np.pad(lines, ((0, 0), (reach, reach)))
    pulses = sum((tap * padded[:, k : k + lines.shape[1]] for k, tap in enumerate(taps)), np.zeros_like(lines))
    frame.iq = (pulses / turning).astype(np.complex64)


def b_mode(frame: TwinFrame) -> None:
    """Amplifier noise, time-gain compensation, envelope, log compression to eight bits."""
    record, display, iq = frame.acquisition, frame.display, frame.iq
    index = np.arange(iq.shape[1])
    starts = Beam(record).line_start(np.arange(len(iq))) / record["sample_mm"]
    below = index - np.floor(starts + f32(0.5)).astype(int)[:, None]  # the face, in samples
    if frame.settings.ring_down:
        ringing = ring_down(record, frame.probe, frame.axial_sigma_mm)
        iq = iq + np.where(below >= 0, ringing[np.maximum(below, 0)], 0)
    if display.noise_db is not None:
        noise = f32(10.0 ** (display.noise_db / 20.0) / np.sqrt(2.0))
        line = np.arange(len(iq), dtype=np.uint32)[:, None]
        key = hash_mix(
            index.astype(np.uint32) * np.uint32(0x9E3779B1)
            + (noise_key(record, frame.noise_seed) + line * np.uint32(0x85EBCA77))
        )
        iq = iq + noise * (gaussian(key) + 1j * gaussian(hash_mix(key + np.uint32(0x9E3779B9))))
    power = np.real(iq) ** 2 + np.imag(iq) ** 2 + f32(1e-30)
    # Two-way path, in cm
    rising = np.clip(below, 0, display.tgc_reach * frame.probe.depth_mm / float(record["sample_mm"]))
    tgc_db = rising * (2.0 * display.tgc_db_cm_mhz * float(record["frequency_mhz"]) * float(record["sample_mm"]) * 0.1)
    neper_db = 20.0 / np.log(10.0)
    tgc_db = tgc_db - neper_db * Beam(record).gain_of_band(tgc_db / neper_db).astype(float)
    sliders = [getattr(display, f"depth_gain_{n}_db") for n in range(1, 9)]
    middles = (np.arange(8) + 0.5) * frame.probe.depth_mm / 8.0
    depth_mm = np.maximum(below, 0) * float(record["sample_mm"])
    tgc_db = tgc_db + np.interp(depth_mm, middles, sliders) + display.near_gain_db * np.exp(-depth_mm / 6.0)
    across = np.linspace(0.0, 4.0, len(iq))
    knots = [getattr(display, f"line_gain_{n}_db") for n in range(1, 6)]
    tgc_db = tgc_db + np.interp(across, np.arange(5), knots)[:, None]
    frame.envelope = (np.sqrt(power) * 10.0 ** (tgc_db / 20.0)).astype(np.float32)
    level_db = 10.0 * np.log10(power) + tgc_db
    value = 255.0 * (1.0 + (level_db - (FULL_SCALE_DB - display.gain_db)) / display.dynamic_range_db)
    frame.grey = (np.clip(value, 0.0, 255.0) + 0.5).astype(np.uint8)


def scan_conversion(frame: TwinFrame) -> None:
    """Pixels: linear along the lines, cubic (Catmull-Rom) across them, 0 outside the field."""
    record, grid, grey = frame.acquisition, frame.grid, frame.grey
    width = max(round(grid.pixel_spacing_mm[1] / float(record["sample_mm"])), 1)
    lines, samples = grey.shape
    last = int(np.ceil(float(record["depth_mm"]) / float(record["sample_mm"]))) - 1  # of the image
    around = np.clip(np.arange(samples)[:, None] + np.arange(width) - width // 2, 0, last)
    grey = (grey[:, around].mean(axis=2) + 0.5).astype(np.uint8).astype(np.float32)
    x = grid.left_mm + (np.arange(grid.columns) + 0.5) * grid.pixel_spacing_mm[0]
    y = grid.top_mm + (np.arange(grid.rows)[:, None] + 0.5) * grid.pixel_spacing_mm[1]
    if record["linear"]:
        tilt = np.arcsin(float(record["steering_sin"]))
        lateral = x * np.cos(tilt) - y * np.sin(tilt)
        depth = x * np.sin(tilt) + y * np.cos(tilt) + float(record["start_mm"])
    else:
        from_apex = y + float(record["apex_radius_mm"])
        depth = np.hypot(x, from_apex) - float(record["apex_radius_mm"])
        lateral = np.where(from_apex > 0, np.arctan2(x, from_apex), 1e9)
    place = (lateral - float(record["first_line"])) / float(record["line_spacing"])
    inside = (place >= -0.5) & (place <= lines - 0.5) & (depth >= 0) & (depth < float(record["depth_mm"]))
    inside &= (y >= float(record["top_mm"])) & (y < float(record["bottom_mm"]))
    image = np.zeros((grid.rows, grid.columns), np.uint8)
    sample = depth[inside] / float(record["sample_mm"])
    bins = np.minimum(sample.astype(int), samples - 2)
    part = np.minimum(sample - bins, 1.0)
    place = np.clip(place[inside], 0.0, lines - 1.0)
    line = place.astype(int)
    t = place - line
    a, b, c, d = (
        grey[at, bins] * (1 - part) + grey[at, bins + 1] * part
        for at in (np.clip(line + n, 0, lines - 1) for n in (-1, 0, 1, 2))
    )
    value = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
    image[inside] = (np.clip(value, 0.0, 255.0) + 0.5).astype(np.uint8)
    frame.image = image


TWINS: dict[str, Callable[[TwinFrame], None]] = {
    "aperture": aperture,
    "ray tree": ray_tree,
    "scatterers": scatterers,
    "beam": beam,
    "interfaces": interfaces,
    "side lobes": side_lobes,
    "pulse": pulse,
    "B-mode": b_mode,
    "scan conversion": scan_conversion,
}


def twin_of(stage: Stage) -> Callable[[TwinFrame], None]:
    """The twin of a stage: its own on_host, or one of TWINS. Raises SimulationError if it has none."""
    if stage.has_own_twin():
        return stage.on_host
    if stage.name not in TWINS:
        raise SimulationError(f"stage {stage.name!r} has no twin in numpy, expected on_host in {type(stage).__name__}")
    return TWINS[stage.name]
