"""Small scenes with random settings, for OpenCL devices that look for races and accesses out of bounds.

    OCLGRIND_DATA_RACES=1 PYOPENCL_NO_CACHE=1 USSIM_DEVICE=Oclgrind python -m benchmarks.small_scenes OUT [--seeds 0 8]
    python -m benchmarks.small_scenes OUT [--seeds 0 8]

Each seed draws a probe (array, transmission, steering, harmonic, apodisation), settings, tissues (fluid, brain, bone,
a lossy plate, one that is strong but does not bend, a membrane with a thin sulcus), sheets, a texture, and the grid of
the voxels. The signal goes to OUT/SEED.npy. If another device has written one already, the second command reports the
largest difference relative to the largest value. The first command interprets: a minute or two per seed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationSettings,
    Texture,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.probe import Probe
from SlicerUSSim.Logic.tissue import Surfels
from SlicerUSSim.Logic.tissue.tissue import Membrane

_FLUID = Tissue("fluid", 1520.0, 1.52, 0.0)
_BRAIN = Tissue("brain", 1546.0, 1.60, 0.5, mu0=0.3, sigma0=0.15)
_VOXELS = 14
#: Depth of the middle of the voxels, mm
_DEPTH = 6.0


def labels(rng: np.random.Generator) -> Volume:
    """A plate over one half, another deeper, a sulcus of one voxel and a cyst; the grid is turned."""
    spacing = float(rng.uniform(0.7, 1.1))
    turned = Rotation.from_quat(rng.normal(size=4)).as_matrix() if rng.random() < 0.7 else np.eye(3)
    ijk_to_ras = np.eye(4)
    ijk_to_ras[:3, :3] = spacing * turned
    ijk_to_ras[:3, 3] = turned @ np.full(3, -0.5 * spacing * (_VOXELS - 1)) + [0.0, _DEPTH, 0.0]
    places = np.stack(np.meshgrid(*[np.arange(_VOXELS)] * 3, indexing="ij"), -1)[..., ::-1]
    x, y, z = np.moveaxis(places @ ijk_to_ras[:3, :3].T + ijk_to_ras[:3, 3], -1, 0)
    y = y - _DEPTH
    array = np.ones(x.shape, np.uint8)
    plate, deep = rng.permutation([2, 3, 4])[:2]
    array[(y > -4) & (y < -2.2) & (x < rng.uniform(-3, 0))] = plate
    array[(y > 0) & (y < 1.5) & (np.abs(x - rng.uniform(-2, 2)) < 1.6)] = deep
    array[np.abs(y - 2.5 - 0.2 * x) < 0.5 * spacing] = 5
    array[np.hypot(x - 2, np.hypot(y + 1, z)) < 2] = 0
    return Volume(array, ijk_to_ras)


def tissues(rng: np.random.Generator) -> TissueTable:
    """Of every kind of border; with a membrane or without."""
    pia = Tissue("pia", 1546.0, 1.60, 0.6, mu0=0.9, sigma0=0.5)
    table = {
        0: _FLUID, 1: _BRAIN, 2: Tissue("bone", 3198.0, 6.364, 3.54, mu0=2.0), 3: Tissue("gristle", 1700.0, 2.4, 1.5),
        4: replace(_BRAIN, name="lossy", attenuation_db_cm_mhz=float(rng.uniform(4, 20))), 5: pia,
    }  # fmt: skip
    return TissueTable(table, Membrane(pia, 0.8, ("fluid", "pia")) if rng.random() < 0.7 else None)


def sheets(rng: np.random.Generator) -> Surfels:
    """A falx and a sulcus, both oblique."""
    across = np.stack(np.meshgrid(np.arange(-4, 4, 0.7), np.arange(-4, 4, 0.7)), -1).reshape(-1, 2)
    tilt = float(rng.uniform(-0.6, 0.6))
    place = np.stack([across[:, 0], _DEPTH - 1.5 + np.tan(tilt) * across[:, 0], across[:, 1]], axis=1)
    normal = np.tile([-np.sin(tilt), np.cos(tilt), 0.0], (len(place), 1))
    return Surfels.joined([
        Surfels.of("falx", place, normal, 0.7, 0.9, 0.5),
        Surfels.of("sulcus", place + [0.0, 3.0, 0.0], normal, 1.2, 0.6, 0.5),
    ])  # fmt: skip


def texture(volume: Volume, rng: np.random.Generator) -> Texture:
    """Shares of a second tissue."""
    shape = volume.array.shape
    second = rng.integers(0, 2, shape).astype(np.uint8)
    share, part = rng.uniform(0, 0.5, (2, *shape)).astype(np.float32)
    return Texture(second, share, rng.normal(size=shape).astype(np.float32), part if rng.random() < 0.5 else None)


def probe(rng: np.random.Generator) -> Probe:
    """An array of 6 to 12 lines."""
    kind, lines = rng.integers(3), int(rng.integers(6, 13))
    common = {
        "scan_lines": lines, "frequency_mhz": float(rng.uniform(3, 7)), "focus_mm": float(rng.uniform(3, 9)),
        "aperture_mm": float(rng.uniform(2, 6)), "receive_f_number": float(rng.uniform(0.8, 3)),
        "receive_apodization": float(rng.choice([0.0, 0.5, 1.0])), "elevation_focus_mm": float(rng.uniform(4, 10)),
        "elevation_aperture_mm": float(rng.uniform(2, 5)), "clutter_db": -36.0 if rng.random() < 0.5 else None,
    }  # fmt: skip
    found = (
        LinearProbe(8.0, 9.0, **common),
        ConvexProbe(8.0, 60.0, 9.0, **common),
        PhasedProbe(70.0, 9.0, **common),
    )[kind]
    mode = rng.integers(4)
    if mode == 1:
        found = replace(found, transmit="zones", focal_zones=int(rng.integers(2, 5)))
    elif mode == 2:
        found = replace(found, transmit="angles", transmit_angles=int(rng.integers(1, 8)))
    elif mode == 3:
        found = replace(found, harmonic=True, frequency_mhz=0.5 * found.frequency_mhz)
    if kind == 0 and rng.random() < 0.6:
        angle, is_fan = float(rng.uniform(-20, 20)), rng.random() < 0.5
        found = replace(found, trapezoid_deg=2 * abs(angle)) if is_fan else replace(found, steering_deg=angle)
    return found


def settings(rng: np.random.Generator) -> SimulationSettings:
    """Mostly the defaults, each switched now and then."""
    return SimulationSettings(
        seed=int(rng.integers(1 << 31)),
        max_ray_depth=int(rng.integers(0, 5)),
        scatterers_per_mm3=float(rng.choice([2.0, 5.0])),
        elevational_rays=int(rng.integers(1, 6)),
        lateral_rays=int(rng.choice([0, 0, 1, 3])),
        samples_per_cycle=int(rng.integers(3, 6)),
        beam=str(rng.choice(["aperture", "aperture", "ray"])),
        interface_reflection=str(rng.choice(["pressure", "energy"])),
        quality="full",
        partial_volume=bool(rng.random() < 0.6),
        mri_modulation_db=float(rng.choice([0.0, 2.0])),
        contact_gap_mm=float(rng.uniform(0, 4)) if rng.random() < 0.4 else None,
        **{
            name: bool(rng.random() < 0.8)
            for name in ("frequency_downshift", "wavefront_curvature", "reflections", "reflection_spreading",
                         "side_lobes", "ring_down", "interfaces", "scattering")
        },
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 8), metavar=("FIRST", "END"))
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for seed in range(*arguments.seeds):
        rng = np.random.default_rng(seed)
        volume, array, chosen = labels(rng), probe(rng), settings(rng)
        table, known = tissues(rng), texture(volume, rng)
        found = sheets(rng) if table.membrane is not None and rng.random() < 0.5 else None
        simulator = UltrasoundSimulator(volume, table, chosen, arguments.device, known, found)
        pose = np.eye(4)
        pose[:3, 3] = [*rng.uniform(-1, 1, 2), 0.0]
        frame = simulator.simulate(array, pose, DisplaySettings(image_size=(40, 36)))
        kind = f"{type(array).__name__}, {array.transmit}{', harmonic' if array.harmonic else ''}, {chosen.beam}"
        told, path = f"{seed}: {kind}, largest {np.abs(frame.iq).max():.4g}", arguments.out / f"{seed}.npy"
        if path.exists():
            other = np.load(path)
            difference = np.abs(frame.iq - other).max() / max(np.abs(other).max(), 1e-30)
            told += f", differs by {difference:.1e}"
        else:
            np.save(path, frame.iq)
        print(f"{told} ({simulator.device.info.platform})", flush=True)


if __name__ == "__main__":
    main()
