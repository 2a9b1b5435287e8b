"""Frame A compared with other simulators in one run: PyMUST's simus and zea's simulators.

    python -m benchmarks.peers [--device NAME] [--json FILE]

Needs pip install "SlicerUSSim[demo]" PyMUST zea jax; a simulator that is not installed is skipped.

Frame A has 196 scan lines of a 64-element phased array. PyMUST and zea compute the channel data of one transmission
from point scatterers, so an image of 196 focused lines takes 196 of them, each with the scatterers inside its beam
(2.25 standard deviations to either side, at this simulator's density). One transmission is timed with increasing
numbers of scatterers, and the time for those of one beam is extrapolated linearly. Beamforming, which is left to the
user of PyMUST and zea, is not included. They do not model interfaces or refraction, but they compute the wave field,
which this simulator does not.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
from collections.abc import Callable

import numpy as np
from scipy.integrate import trapezoid

from benchmarks.frames import FRAMES
from benchmarks.measuring import measured, output_file
from SlicerUSSim.Logic import SimulationSettings, TissueTable, UltrasoundSimulator, segment_mri
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.imaging.scattering import sites_per_mm3
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.opencl.devices import devices_to_measure
from SlicerUSSim.Logic.probe import craniotomy_pose

PROBE = FRAMES["A"]
ELEMENTS, PITCH_M, WIDTH_M, SPEED, FREQUENCY = 64, 0.15e-3, 0.14e-3, 1540.0, 5e6
COUNTS = (250, 500, 1000, 2000)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--device", help="see `ussim devices` (default: every one)")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    devices = devices_to_measure(arguments.device)
    segmentation = segment_mri(demo_mri()[0], device=devices[0], thin_sulci=False)
    tissues, pose = TissueTable.brain(segmentation.tissue_names), craniotomy_pose(segmentation.labels, PROBE)
    rows: dict[str, dict] = {}
    for info in devices:
        simulator = UltrasoundSimulator(segmentation.labels, tissues, device=info)

        def frame(simulator=simulator) -> None:
            simulator.forget_echoes()
            simulator.simulate(PROBE, pose)

        rows[f"SlicerUSSim, {info.platform}"] = {"frame_ms": measured(frame, 30)["best_ms"]}
    ours = min(row["frame_ms"] for row in rows.values())

    in_beam = scatterers_in_beam(SimulationSettings())
    for name, module, transmission in (
        ("PyMUST simus", "pymust", pymust_transmission),
        ("zea simulate_rf", "zea", lambda n: zea_transmission(n, "frequency")),
        ("zea simulate_rf_td", "zea", lambda n: zea_transmission(n, "time")),
    ):
        if importlib.util.find_spec(module):
            rows[name] = scaled(transmission, in_beam)
    print(f"\n{in_beam:.0f} scatterers in the beam of one line\n")
    print("| simulator | one transmission, 1000 scatterers | frame A | times SlicerUSSim |\n|---|---|---|---|")
    for name, row in rows.items():
        single = f"{row['transmission_ms']:.0f} ms" if "transmission_ms" in row else ""
        print(f"| {name} | {single} | {row['frame_ms'] / 1e3:.3g} s | {row['frame_ms'] / ours:.3g} |")
    if arguments.json:
        write_json(arguments.json, rows)


def scatterers_in_beam(settings: SimulationSettings) -> float:
    """Mean number inside the beam of one scan line of frame A."""
    depth = np.linspace(0.0, PROBE.depth_mm, 257)
    lateral, elevation = PROBE.beam_sigma_mm(depth)
    areas = 4.0 * settings.beam_cutoff**2 * lateral * elevation
    return float(sites_per_mm3(settings, PROBE) * trapezoid(areas, depth))


def scaled(transmission: Callable[[int], Callable[[], object]], in_beam: float) -> dict:
    """Time of 196 transmissions with `in_beam` scatterers each, extrapolated linearly from fewer scatterers."""
    times = [measured(transmission(count), 3)["best_ms"] for count in COUNTS]
    slope, offset = np.polyfit(COUNTS, times, 1)
    line = max(offset, 0.0) + slope * in_beam
    return {
        "scatterers": COUNTS,
        "times_ms": times,
        "transmission_ms": times[COUNTS.index(1000)],
        "frame_ms": line * PROBE.scan_lines,
    }


def scatterers(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lateral, depth, strength) inside the beam of the middle line, metres."""
    random = np.random.default_rng(0)
    depth = random.uniform(2e-3, PROBE.depth_mm * 1e-3, count)
    lateral = random.normal(0.0, 1.0, count) * PROBE.beam_sigma_mm(depth * 1e3)[0] * 1e-3
    return lateral, depth, random.normal(size=count)


def pymust_transmission(count: int) -> Callable[[], object]:
    """One focused transmission by PyMUST."""
    import pymust
    from pymust.utils import Param

    param = Param()
    param.fc, param.bandwidth, param.c = FREQUENCY, 60, SPEED
    param.pitch, param.width, param.Nelements, param.radius = PITCH_M, WIDTH_M, ELEMENTS, np.inf
    param.attenuation = 0.5
    delays = pymust.txdelay(0.0, PROBE.focus_mm * 1e-3, param)
    lateral, depth, strength = scatterers(count)
    return lambda: pymust.simus(lateral, depth, strength, delays, param)


def zea_transmission(count: int, domain: str) -> Callable[[], object]:
    """One focused transmission by zea, compiled beforehand."""
    os.environ.setdefault("KERAS_BACKEND", "jax")
    # Imported by name: they are not among this package's extras, so the type checker does not find them.
    jax = importlib.import_module("jax")
    if domain == "time":
        simulate = importlib.import_module("zea.simulator_time_domain").simulate_rf_td
    else:
        simulate = importlib.import_module("zea.simulator").simulate_rf

    elements = (np.arange(ELEMENTS) - 0.5 * (ELEMENTS - 1)) * PITCH_M
    focus = PROBE.focus_mm * 1e-3
    delays = (np.hypot(elements[0], focus) - np.hypot(elements, focus))[None] / SPEED
    sampling = 4 * FREQUENCY
    lateral, depth, strength = scatterers(count)
    fixed = {
        "probe_geometry": np.stack([elements, 0 * elements, 0 * elements], axis=-1).astype(np.float32),
        "apply_lens_correction": False, "lens_thickness": 0.0, "lens_sound_speed": 1000.0, "sound_speed": SPEED,
        "n_ax": int(2 * PROBE.depth_mm * 1e-3 / SPEED * sampling), "center_frequency": FREQUENCY,
        "sampling_frequency": sampling, "t0_delays": delays.astype(np.float32), "initial_times": np.zeros(1),
        "element_width": WIDTH_M, "attenuation_coef": 0.5, "tx_apodizations": np.ones((1, ELEMENTS)),
        "t_peak": np.full(1, 1.0 / FREQUENCY),
    }  # fmt: skip
    compiled = jax.jit(lambda place, magnitude: simulate(place, magnitude, **fixed))
    place = np.stack([lateral, 0 * lateral, depth], axis=-1).astype(np.float32)
    magnitude = strength.astype(np.float32)
    return lambda: jax.block_until_ready(compiled(place, magnitude))


if __name__ == "__main__":
    main()
