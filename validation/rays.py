"""Checks of the ray tree (docs/physics.md#3-rays) and of interfaces (docs/physics.md#2-interfaces)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import LinearProbe
from SlicerUSSim.Logic.tissue.tissue import Tissue
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import EVEN
from validation.phantoms import (
    FLUID,
    Phantom,
    layered,
    reflection_coefficient,
    voxel_sheet,
    voxel_sphere,
)
from validation.pictures import Curve, Plot, View, draw_plots, draw_views

#: Snell's law is of single rays; beams go straight through borders like this one.
_RAYS = SimulationSettings(beam="ray")
SLOW, FAST = Tissue("slow", 1450.0, 1.45, 0.3), Tissue("fast", 1650.0, 1.9, 0.9)


def _rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def refraction_and_reflectance(rotation: np.ndarray, device) -> Outcome:
    """A plane tilted by 20 degrees between two fluids."""
    phantom = layered([SLOW, FAST], [20.0], rotation, tilt_deg=20.0)
    tilt = np.radians(20.0)
    normal = phantom.probe_to_ras[:3, :3] @ [-np.sin(tilt), -np.cos(tilt), 0.0]
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _RAYS, device)
    rows, curves = [], []
    for name, probe in PROBES.items():
        tree = simulator.trace(probe, phantom.probe_to_ras)
        crossing = tree.hits[(tree.hits["reflections"] == 0) & (tree.hits["label_behind"] == 2)]
        angle = np.degrees(np.arccos(np.clip(crossing["normal"] @ normal, -1, 1)))
        cos_in = crossing["cos_incidence"].astype(float)
        expected = reflection_coefficient(SLOW, FAST, cos_in) ** 2
        rows += [
            Row(f"normal error RMS, {name}", "degrees", 0.0, _rms(angle), 3.0, "at most"),
            Row(f"largest error of R, {name}", "", 0.0, float(abs(crossing["reflectance"] - expected).max()), 2e-4),
            Row(
                f"sin t / sin i, {name}", "", FAST.speed_of_sound_m_s / SLOW.speed_of_sound_m_s,
                _sine_ratio(tree, normal), 0.02,
            ),
        ]  # fmt: skip
        order = np.argsort(cos_in)[:: max(len(cos_in) // 60, 1)]
        incidence = np.degrees(np.arccos(cos_in[order]))
        curves.append(Curve(name, incidence, crossing["reflectance"][order], incidence, expected[order]))
    plot = Plot("a plane between two fluids", "angle of incidence [degrees]", "reflectance R", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _sine_ratio(tree, normal: np.ndarray) -> float:
    """Median over lines of the sine of refraction divided by that of incidence, both to the true normal."""
    first = tree.segments["reflections"] == 0
    segments, lines = tree.segments[first], tree.segment_line[first]
    ratios = []
    for line in np.unique(lines):
        path = segments[lines == line]
        behind = np.flatnonzero(path["label"] == 2)
        if behind.size and behind[0] > 0:
            sines = [np.linalg.norm(np.cross(path[n]["direction"], normal)) for n in (behind[0] - 1, behind[0])]
            if sines[0] > 0.1:  # at nearly normal incidence the ratio is not accurate
                ratios.append(sines[1] / sines[0])
    return float(np.median(ratios))


def total_reflection(rotation: np.ndarray, device) -> Outcome:
    """A plane tilted by 75 degrees; the critical angle is 61.5 degrees."""
    phantom = layered([SLOW, FAST], [25.0], rotation, tilt_deg=75.0)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _RAYS, device)
    tree = simulator.trace(LinearProbe(2.0, 40.0, scan_lines=21), phantom.probe_to_ras)
    hits = tree.hits[(tree.hits["reflections"] == 0) & (tree.hits["label_behind"] == 2)]
    through = (tree.segments["reflections"] == 0) & (tree.segments["label"] == 2)
    view = View(
        "total reflection", phantom, PROBES["linear"], simulator.simulate(PROBES["linear"], phantom.probe_to_ras, EVEN)
    )
    reached = float(hits["reflectance"].min()) if len(hits) else 0.0
    return Outcome(
        (
            Row("smallest R beyond the critical angle", "", 1.0, reached, 0.0),
            Row("refracted rays", "", 0.0, float(through.sum()), 0.0),
        ),
        partial(draw_views, views=[view]),
    )


def attenuation_and_time(rotation: np.ndarray, device) -> Outcome:
    """A fast lossy slab 18 mm thick."""
    before, behind = replace(FLUID, attenuation_db_cm_mhz=0.2), replace(FLUID, name="behind", impedance_mrayl=1.7)
    phantom = layered([before, FAST, behind], [10.0, 28.0], rotation)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, SimulationSettings(reflections=False), device)
    rows = []
    for name, probe in PROBES.items():
        tree = simulator.trace(probe, phantom.probe_to_ras)
        middle = abs(tree.hit_line - 80) < 2.5  # the lines that meet the slab at right angles
        out = tree.hits[middle & (tree.hits["label_before"] == 2)]
        depth = 10.0 + 18.0 * 1540.0 / FAST.speed_of_sound_m_s
        loss = -2.0 * probe.frequency_mhz * (0.2 * 1.0 + FAST.attenuation_db_cm_mhz * 1.8)
        measured = 20 * np.log10(out["attenuation"].astype(float).mean())
        rows += [
            Row(f"depth of the back, {name}", "mm", depth, float(out["depth_mm"].mean()), 0.05),
            # Over the aperture, steps of a voxel through 0.9 dB/mm: an oblique slab is some 0.2 mm off.
            Row(f"two-way loss to the back, {name}", "dB", loss, float(measured), 0.3),
        ]
    frame = simulator.simulate(PROBES["convex"], phantom.probe_to_ras, EVEN)
    return Outcome(tuple(rows), partial(draw_views, views=[View("fast slab", phantom, PROBES["convex"], frame)]))


def sub_voxel_interfaces(rotation: np.ndarray, device) -> Outcome:
    """A sphere of 20 mm radius on 1 mm voxels."""
    phantom = voxel_sphere(rotation)
    settings = SimulationSettings(elevational_rays=16, reflections=False)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    probe = LinearProbe(30, 30, scan_lines=121, elevation_aperture_mm=30, elevation_focus_mm=60)
    hits = simulator.trace(probe, phantom.probe_to_ras).hits
    from_centre = hits["position"] - np.array(phantom.centre_ras)
    # Behind the equator, a ray along it enters a voxel of the sphere while it leaves the smooth one.
    is_front = (hits["label_before"] == 0) & (from_centre @ phantom.probe_to_ras[:3, 1] < 0.0)
    front, from_centre = hits[is_front], from_centre[is_front]
    seen = replace(PROBES["convex"], depth_mm=60.0)
    image = simulator.simulate(seen, phantom.probe_to_ras, EVEN)
    radius = np.linalg.norm(from_centre, axis=1)
    angle = np.degrees(np.arccos(np.clip((front["normal"] * from_centre / radius[:, None]).sum(axis=1), -1, 1)))
    return Outcome(
        (
            Row("normal error RMS", "degrees", 0.0, _rms(angle), 3.0, "at most"),
            Row("position error RMS", "voxels", 0.0, _rms(radius - 20.0), 0.15, "at most"),
            Row("mean position error", "voxels", 0.0, float((radius - 20.0).mean()), 0.05),
        ),
        partial(draw_views, views=[View("sphere of 1 mm voxels", phantom, seen, image)]),
    )


def thin_sheet(rotation: np.ndarray, device) -> Outcome:
    """A sheet one voxel thick."""
    phantom = voxel_sheet(rotation)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, SimulationSettings(reflections=False), device)
    rows = []
    for name, probe in PROBES.items():
        tree = simulator.trace(probe, phantom.probe_to_ras)
        front = tree.hits["label_behind"] == 1
        crossed = set(zip(tree.hit_line[front], tree.hit_ray[front], strict=True))
        rays = len(np.unique(tree.segment_line)) * simulator.settings.elevational_rays
        rows.append(Row(f"fraction of rays that hit it, {name}", "", 1.0, len(crossed) / rays, 0.0))
    frame = simulator.simulate(PROBES["convex"], phantom.probe_to_ras, EVEN)
    return Outcome(
        tuple(rows), partial(draw_views, views=[View("sheet of one voxel", phantom, PROBES["convex"], frame)])
    )


def energy(rotation: np.ndarray, device) -> Outcome:
    """The weights of leaves and cut branches of every tree add up to that of its root: R + T = 1 at each node."""
    phantom = layered([SLOW, FAST, SLOW, FAST], [10.0, 18.0, 29.0], rotation, tilt_deg=12.0)
    threshold = 1e-3
    settings = replace(_RAYS, reflection_threshold=threshold, intensity_threshold=1e-9)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    rows = []
    for name, probe in PROBES.items():
        total, cut, branches = _carried(simulator, replace(probe, scan_lines=41), phantom)
        rows += [
            Row(f"largest sum of weights, {name}", "", 1.0, total.max(), 1e-4, "at most"),
            Row(f"smallest sum of weights, {name}", "", 1.0, total.min(), 1e-4, "at least"),
            # Every node has met one interface, at which at most one branch below the threshold was cut.
            Row(f"cut / (nodes x threshold), {name}", "", 1.0, (cut / branches / threshold).max(), 0.0, "at most"),
        ]
    return Outcome(tuple(rows))


def _carried(simulator, probe, phantom: Phantom) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per traced line: weight of leaves and cut branches, weight of the cut branches, and number of segments."""
    tree = simulator.trace(probe, phantom.probe_to_ras)
    lines = np.unique(tree.segment_line)
    cut = tree.cut_weight[:, 0].astype(float)
    ends = tree.segments["depth_mm"] + tree.segments["length_mm"] * tree.segments["depth_per_mm"]
    leaf = ends > float(simulator.acquisition(probe, phantom.probe_to_ras)["traced_mm"]) - 1e-3
    totals, branches = [], []
    for n, line in enumerate(lines):
        here = tree.segment_line == line
        totals.append(float(tree.segments["weight"][here & leaf].sum(dtype=float)) + cut[n])
        branches.append(int(here.sum()))
    return np.array(totals), cut, np.array(branches)


CHECKS = (
    Check(
        "refraction and reflectance",
        "sin(t)/c2 = sin(i)/c1, and R = r^2 with r = (Z2 cos i - Z1 cos t)/(Z2 cos i + Z1 cos t).",
        refraction_and_reflectance,
    ),
    Check("total reflection", "Beyond the critical angle R = 1 and nothing is refracted.", total_reflection),
    Check(
        "attenuation and time",
        "Amplitude falls by 2 alpha f l dB; an interface is shown at c_ref/2 times its two-way travel time.",
        attenuation_and_time,
    ),
    Check("sub-voxel interfaces", "A voxelised sphere has the normals of a smooth one.", sub_voxel_interfaces),
    Check("thin sheet", "A sheet one voxel thick is hit by every ray.", thin_sheet),
    Check("energy", "The weights of the leaves and the cut branches of a tree sum to one.", energy),
)
