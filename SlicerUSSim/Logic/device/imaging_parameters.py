"""The imaging parameters of Plus, such as DepthMm, as values of a preset.

Names and formats are those of PlusLib's vtkPlusUsImagingParameters; FocusDepthMm is this device's own.
"""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.imaging.preset import Preset

#: Parameters of Plus that this device does not have
NOT_SET = (
    "Intensity", "Contrast", "PowerDb", "SectorPercent", "ZoomFactor", "Voltage", "SoundVelocity", "ImageSize",
)  # fmt: skip
#: 50 % are 0 dB; 0 % and 100 % are the ends of the panel's slider
_DB_PER_PERCENT = 0.8
_SLIDERS = np.arange(1, 9)


def imaging_parameters(preset: Preset) -> dict[str, str]:
    """{name: text, as Plus writes it} of all that this device has."""
    probe, display = preset.probe, preset.display
    numbers = {
        "DepthMm": probe.depth_mm, "FrequencyMhz": probe.frequency_mhz, "FocusDepthMm": probe.focus_mm or 0.0,
        "FocusDepthPercent": 100.0 * (probe.focus_mm or 0.0) / probe.depth_mm, "DynRangeDb": display.dynamic_range_db,
        "GainPercent": 50.0 + display.gain_db / _DB_PER_PERCENT,
    }  # fmt: skip
    gains = [getattr(display, f"depth_gain_{number}_db") for number in _SLIDERS]
    compensation = f"{gains[0]:g} {0.5 * (gains[3] + gains[4]):g} {gains[7]:g} "
    return {**{name: f"{value:g}" for name, value in numbers.items()}, "TimeGainCompensation": compensation}


def changed_parameter(preset: Preset, name: str, text: str) -> Preset:
    """A preset with one of these parameters changed.

    Raises ValueError for a text that is no number, or not three of them for TimeGainCompensation, and SimulationError
    for a value that is out of range, and for a parameter that this device does not have.
    """
    values = [float(part) for part in text.split()]
    if name == "TimeGainCompensation":
        face, middle, depth = values
        gains = np.interp(_SLIDERS, (1.0, 4.0, 5.0, 8.0), (face, middle, middle, depth)).tolist()
        return preset.changed("display", **{f"depth_gain_{n}_db": gain for n, gain in enumerate(gains, 1)})
    (value,) = values
    match name:
        case "DepthMm":
            return preset.changed("probe", depth_mm=value)
        case "FrequencyMhz":
            return preset.changed("probe", frequency_mhz=value)
        case "FocusDepthMm":
            return preset.changed("probe", focus_mm=value)
        case "FocusDepthPercent":
            return preset.changed("probe", focus_mm=preset.probe.depth_mm * value / 100.0)
        case "DynRangeDb":
            return preset.changed("display", dynamic_range_db=value)
        case "GainPercent":
            return preset.changed("display", gain_db=(value - 50.0) * _DB_PER_PERCENT)
    raise SimulationError(f"{name} cannot be changed in this device")
