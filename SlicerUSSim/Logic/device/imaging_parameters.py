"""The imaging parameters of Plus, such as DepthMm, as values of a preset.

Names and formats are those of PlusLib's vtkPlusUsImagingParameters; FocusDepthMm is this device's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: (section, name) of values that are one number
_NUMBERS = {
    "DepthMm": ("probe", "depth_mm"), "FrequencyMhz": ("probe", "frequency_mhz"), "FocusDepthMm": ("probe", "focus_mm"),
    "DynRangeDb": ("display", "dynamic_range_db"), "SoundVelocity": ("settings", "reference_speed_m_s"),
}  # fmt: skip
_TGC, _SIZE, _GAIN, _FOCUS = "TimeGainCompensation", "ImageSize", "GainPercent", "FocusDepthPercent"
#: Parameters of Plus that this device does not have
_NOT_SET = ("Intensity", "Contrast", "PowerDb", "SectorPercent", "ZoomFactor", "Voltage")
KNOWN = (*_NUMBERS, _TGC, _SIZE, _GAIN, _FOCUS, *_NOT_SET)
#: 50 % are 0 dB; 0 % and 100 % are the ends of the panel's slider
_DB_PER_PERCENT = 0.8
#: Sliders of the gain by depth that have the gains at the face, in the middle and at the image depth
_TGC_SLIDERS = (1.0, 4.0, 5.0, 8.0)


def parameter_text(preset: Preset, grid: ImageGrid, name: str) -> str | None:
    """The text of one of KNOWN, as Plus writes it; None if it is not set."""
    probe = preset.probe
    if name in _NUMBERS:
        section, field = _NUMBERS[name]
        value = getattr(getattr(preset, section), field)
        return None if value is None else f"{value:g}"
    if name == _GAIN:
        return f"{50.0 + preset.display.gain_db / _DB_PER_PERCENT:g}"
    if name == _FOCUS:
        return None if probe.focus_mm is None else f"{100.0 * probe.focus_mm / probe.depth_mm:g}"
    if name == _SIZE:
        return f"{grid.columns} {grid.rows} 1 "
    if name == _TGC:
        sliders = [getattr(preset.display, f"depth_gain_{n}_db") for n in range(1, 9)]
        return f"{sliders[0]:g} {0.5 * (sliders[3] + sliders[4]):g} {sliders[7]:g} "
    return None


def changed_parameter(preset: Preset, name: str, text: str) -> Preset:
    """A preset with one of KNOWN changed.

    Raises ValueError for a text that is no number, or not three of them for TimeGainCompensation and ImageSize, and
    SimulationError for a value that is out of range, and for a parameter that cannot be changed.
    """
    number: Callable[[str], float] = int if name == _SIZE else float
    values = [number(part) for part in text.split()]
    if len(values) != (3 if name in (_TGC, _SIZE) else 1):
        raise ValueError(text)
    value = values[0]
    require(bool(np.isfinite(values).all()), f"{name} is {text}, expected finite numbers")
    if name in ("DepthMm", "FrequencyMhz", "FocusDepthMm", "DynRangeDb"):
        section, field = _NUMBERS[name]
        return preset.changed(section, **{field: value})
    if name == _GAIN:
        require(0.0 <= value <= 100.0, f"{name} is {text}, expected 0 to 100")
        return preset.changed("display", gain_db=(value - 50.0) * _DB_PER_PERCENT)
    if name == _FOCUS:
        return preset.changed("probe", focus_mm=preset.probe.depth_mm * value / 100.0)
    if name == _TGC:
        top, middle, bottom = values
        sliders = np.interp(np.arange(1.0, 9.0), _TGC_SLIDERS, (top, middle, middle, bottom)).tolist()
        return preset.changed("display", **{f"depth_gain_{n}_db": gain for n, gain in enumerate(sliders, 1)})
    raise SimulationError(f"{name} cannot be changed in this device")


def fixed_grid(preset: Preset, like: ImageGrid) -> ImageGrid:
    """The grid of a preset's probe with the rows and columns of another one, as a scanner's image has, and square
    pixels: beside a narrow field it is black."""
    left, right, top, bottom = preset.probe.image_bounds_mm()
    pixel = max((right - left) / like.columns, (bottom - top) / like.rows)
    left = 0.5 * (left + right - pixel * like.columns)
    return replace(like, left_mm=left, top_mm=top, pixel_spacing_mm=(pixel, pixel))
