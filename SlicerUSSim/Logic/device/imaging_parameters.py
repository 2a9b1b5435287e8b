"""The imaging parameters of Plus, such as DepthMm, as values of a preset.

Names and formats are those of PlusLib's vtkPlusUsImagingParameters; FocusDepthMm is this device's own.
"""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.imaging.preset import Preset

#: {name: (section, field, the field's value at 0, its change by 1)}; the gain is that of the panel's slider
_NUMBERS = {
    "DepthMm": ("probe", "depth_mm", 0.0, 1.0), "FrequencyMhz": ("probe", "frequency_mhz", 0.0, 1.0),
    "FocusDepthMm": ("probe", "focus_mm", 0.0, 1.0), "DynRangeDb": ("display", "dynamic_range_db", 0.0, 1.0),
    "GainPercent": ("display", "gain_db", -40.0, 0.8),
}  # fmt: skip
_FOCUS, _TGC = "FocusDepthPercent", "TimeGainCompensation"
#: Parameters of Plus that this device does not have
NOT_SET = ["Intensity", "Contrast", "PowerDb", "SectorPercent", "ZoomFactor", "Voltage", "SoundVelocity", "ImageSize"]


def imaging_parameters(preset: Preset) -> dict[str, str]:
    """{name: text, as Plus writes it} of all that this device has."""
    numbers = {
        name: (getattr(getattr(preset, section), field) - start) / step
        for name, (section, field, start, step) in _NUMBERS.items()
    }
    numbers[_FOCUS] = 100.0 * numbers["FocusDepthMm"] / numbers["DepthMm"]
    gains = [getattr(preset.display, f"depth_gain_{slider}_db") for slider in range(1, 9)]
    compensation = f"{gains[0]:g} {0.5 * (gains[3] + gains[4]):g} {gains[7]:g} "  # face, middle, and image depth
    return {**{name: f"{value:g}" for name, value in numbers.items()}, _TGC: compensation}


def changed_parameter(preset: Preset, name: str, text: str) -> Preset:
    """A preset with one of these parameters changed.

    Raises KeyError for an unknown one, ValueError for a text that is no number, or not three of them for
    TimeGainCompensation, and SimulationError for a value that is out of range, and for one of NOT_SET.
    """
    require(name not in NOT_SET, f"{name} cannot be changed in this device")
    values = [float(part) for part in text.split()]
    if name == _TGC:
        face, middle, depth = values
        gains = np.interp(range(1, 9), (1, 4, 5, 8), (face, middle, middle, depth)).tolist()
        return preset.changed("display", **{f"depth_gain_{slider}_db": gain for slider, gain in enumerate(gains, 1)})
    (value,) = values
    if name == _FOCUS:
        name, value = "FocusDepthMm", 0.01 * value * preset.probe.depth_mm
    section, field, start, step = _NUMBERS[name]
    return preset.changed(section, **{field: start + step * value})
