"""Host code of kernels/aperture.cl: what soft tissue does to beams, over the whole aperture."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe

ROWS = 3  # of points across the elevational aperture

_POINTS = 12  # intervals of points across one aperture
_MOST_POINTS = 96  # along the whole face
_LONGEST = 1.06  # of paths, in image depths: the fastest soft tissue
_SCREEN_STEP_MM, _SCREEN_DEPTHS = 8.0, (8, 24)
_LINES_PER_SCREEN = 3
_FAN_STEP_MM, _MOST_DEPTHS = (0.25, 1.0), 192  # limits of the length of a look-up; else a voxel
_COARSER, _COARSE_FAN_STEP_MM = 2.0, 2.0  # of drafts
_ANGLE_STEP, _WIDEST = 0.022, 1.5  # radians

_NEPERS_PER_DB = np.log(10.0) / 20.0


class Aperture(Stage):
    """Delay, deflection, level and attenuation of every line's beam in soft tissue, at several depths."""

    name = "aperture"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        kernels = device.kernels("aperture.cl")
        self._fans, self._screens, self._keep_levels, self._beams = (
            kernels[name] for name in ("fans", "screens", "keep_levels", "beams")
        )
        self.workspace = Workspace(device)

    def run(self, frame: DeviceFrame, with_level: bool = True) -> None:
        """Enqueue the beams of one frame: `screens`, `spreads` and `beams`, which are empty if beams are single rays.

        Without `with_level` screens have attenuation alone, and not what is lost because a beam is no longer focused.
        """
        fields, get = frame.acquisition, self.workspace.get
        lines, depths, traced = (int(fields[name]) for name in ("screen_lines", "screen_depths", "traced_lines"))
        fan = int(fields["fan_angles"]), int(fields["fan_points"]), ROWS
        frame.screens, frame.spreads = get("screens", lines * depths * 16), get("spreads", lines * depths * 8)
        frame.beams = get("beams", traced * (1 + depths) * 32)
        shades = get("shades", lines * depths * 16)
        frame.reflects = True
        if not fields["aperture_beams"]:
            return
        acoustics = get("acoustics", len(frame.medium.rows) * 16)
        rows = acoustic_rows(frame.medium.rows, fields)
        self.device.write(acoustics, rows)
        sums = get("sums", int(np.prod(fan)) * int(fields["fan_depths"]) * 16)
        frame.reflects = not are_soft(rows[frame.medium.present])
        all_soft = np.int32(not frame.reflects)
        self.device.run(
            self._fans, fan, frame.acquisition_buffer, frame.medium.voxel_buffer, acoustics, all_soft, sums, few=True
        )
        self.device.run(
            self._screens, (lines, depths), frame.acquisition_buffer, sums, np.int32(with_level), all_soft,
            frame.screens, shades, frame.spreads, few=True,
        )  # fmt: skip
        self.device.run(self._keep_levels, (depths, lines), frame.acquisition_buffer, frame.screens, frame.spreads)
        self.device.run(
            self._beams, (1 + depths, traced), frame.acquisition_buffer, frame.screens, shades, all_soft, frame.beams
        )


def acoustic_rows(tissues: np.ndarray, acquisition: np.ndarray) -> np.ndarray:
    """(labels, 4) float32 of layout.TISSUE records: extra path per mm, nepers per mm both ways, m/s, MRayl.

    The extra path is what a length adds to the displayed depth beyond itself, c_ref / c - 1. The speed is that by which
    beams tell what they go through (beam_speed in kernels/common.clh).
    """
    speed = tissues["speed_of_sound_m_s"]
    with np.errstate(divide="ignore"):
        extra = np.where(speed > 0.0, acquisition["reference_speed_m_s"] / speed - 1.0, 0.0)
    nepers = tissues["attenuation_db_cm_mhz"] * acquisition["frequency_mhz"] * 0.2 * _NEPERS_PER_DB
    speed = np.where(nepers > CONSTANTS["LOSSY_PER_MM"], -speed, speed)
    return np.stack([extra, nepers, speed, tissues["impedance_mrayl"]], axis=1).astype(np.float32)


def are_soft(acoustics: np.ndarray) -> bool:
    """Whether borders between all of acoustic_rows (labels, 4) are soft (is_soft in kernels/common.clh)."""

    def differ_less(column: int, contrast: float) -> bool:
        low, high = float(acoustics[:, column].min()), float(acoustics[:, column].max())
        return high - low < contrast * abs(high + low)

    # A little less, since the kernels round.
    return differ_less(2, 0.4999 * CONSTANTS["SOFT_SPEED"]) and differ_less(3, 0.9999 * CONSTANTS["SOFT_REFLECTION"])


def aperture_fields(
    probe: Probe, settings: SimulationSettings, voxel_mm: float, traced_lines: int, guard_lines: int, lateral_rays: int
) -> dict[str, float]:
    """The fields of layout.ACQUISITION for beams from an aperture.

    Points are a twelfth of the aperture apart, along all of the face and as far beyond it as lines are traced.
    """
    is_full = settings.quality == "full"
    coarser = 1.0 if is_full else _COARSER
    depth = _LONGEST * probe.depth_mm
    screens = int(np.clip(np.ceil(depth / _SCREEN_STEP_MM), *_SCREEN_DEPTHS))
    widest = 0.5 / probe.receive_f_number  # of the directions from which a depth is reached, to the line
    reach = -probe.first_line + guard_lines / lateral_rays * probe.line_spacing  # of traced lines
    if probe.is_linear or probe.apex_radius_mm > 0.0:
        along = reach / np.cos(probe.steering_rad) if probe.is_linear else reach * probe.apex_radius_mm
        if probe.has_flat_face and not probe.is_linear:
            along = probe.apex_radius_mm * np.tan(reach)
        span = 2.0 * along + probe.aperture_mm
        pitch = coarser * max(probe.aperture_mm / _POINTS, span / (_MOST_POINTS - 1))
        if probe.has_flat_face:
            widest += abs(probe.steering_rad) if probe.is_linear else reach
        else:
            widest += 0.5 * (probe.aperture_mm + pitch) / probe.apex_radius_mm
    else:
        span, pitch = probe.aperture_mm, coarser * probe.aperture_mm / _POINTS
        widest += reach
    points = round(span / pitch) + 1
    widest = min(widest, _WIDEST)
    angles = int(np.ceil(2.0 * widest / (coarser * _ANGLE_STEP))) + 1
    fan = depth + 0.5 * probe.aperture_mm  # from the edge of the aperture
    step_mm = float(np.clip(voxel_mm, *_FAN_STEP_MM)) if is_full else _COARSE_FAN_STEP_MM
    depths = int(min(np.ceil(fan / step_mm) + 1, _MOST_DEPTHS))
    return {
        "aperture_beams": settings.beam == "aperture",
        "screen_lines": max(2, -(-traced_lines // _LINES_PER_SCREEN)),
        "screen_depths": screens,
        "screen_step": depth / screens,
        "fan_points": points,
        "fan_first": -0.5 * pitch * (points - 1),
        "fan_pitch": pitch,
        "fan_angles": angles,
        "fan_first_angle": -widest,
        "fan_angle_step": 2.0 * widest / (angles - 1),
        "fan_depths": depths,
        "fan_step": fan / (depths - 1),
    }
