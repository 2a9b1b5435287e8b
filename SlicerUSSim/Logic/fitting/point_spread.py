"""Point spread function by the width of the speckle in images: a start, which fits accept only with T2.

Developed speckle is as wide as the point spread function, s axially and laterally (speckle_width.py). Axially s tells
the band, frequency x fractional bandwidth = 0.2886 / s (mm, MHz: two-way pulses at 1540 m/s), laterally the aperture in
wavelengths, aperture x frequency. Frequency itself is in neither: 3.5 to 6 MHz fit one sweep equally, and nothing in
B-mode images tells them apart. And what is measured in a patient is wider than the point spread function, by texture
and by the scanner's processing: with the function that has the measured widths, images have half as many grains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.fitting.speckle_width import SpeckleWidth
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit
from SlicerUSSim.Logic.probe.arrays import Probe

#: Frequency x fractional bandwidth x sigma of the amplitude, MHz mm
BAND_SIGMA = 0.2886
#: Bounds of what is estimated, as probes have them
_BANDWIDTHS, _APERTURES_MM = (0.05, 1.5), (1.0, 60.0)


@dataclass(frozen=True)
class PointSpread:
    """What the width of the speckle says of a point spread function."""

    #: Width of the band, MHz, and aperture in mm times frequency in MHz; NaN where no speckle could be measured
    band_mhz: float
    aperture_mm_mhz: float
    #: Whether a fit took it; None: not tried
    is_taken: bool | None = None
    #: T1 and T2 with it, and without; None: not tried
    with_it: TextureMisfit | None = None
    without: TextureMisfit | None = None

    def of(self, probe: Probe) -> Probe:
        """The probe with this point spread function at its own frequency, which is not known from the images."""
        changes = {}
        if np.isfinite(self.band_mhz):
            changes["fractional_bandwidth"] = float(np.clip(self.band_mhz / probe.frequency_mhz, *_BANDWIDTHS))
        if np.isfinite(self.aperture_mm_mhz):
            changes["aperture_mm"] = float(np.clip(self.aperture_mm_mhz / probe.frequency_mhz, *_APERTURES_MM))
        return replace(probe, **changes)

    def to_dict(self) -> dict:
        """Plain values for JSON; what could not be measured is None."""
        values = {"band_mhz": self.band_mhz, "aperture_mm_mhz": self.aperture_mm_mhz}
        plain = {name: value if np.isfinite(value) else None for name, value in values.items()}
        tried = {
            name: {key: value if np.isfinite(value) else None for key, value in vars(misfit).items()}
            for name, misfit in (("with_it", self.with_it), ("without", self.without))
            if misfit is not None
        }
        return {**plain, "is_taken": self.is_taken, **tried, "frequency_mhz": None}

    def in_words(self) -> str:
        """One line, with what cannot be known."""
        taken = {
            None: "; not tried",
            True: "; taken, with as many grains",
            False: "; not taken: its grains are no more like the real ones",
        }[self.is_taken]
        return (
            f"speckle is as wide as that of a band of {self.band_mhz:.2f} MHz and an aperture of "
            f"{self.aperture_mm_mhz:.0f} mm MHz{taken}; the frequency itself cannot be known from B-mode images"
        )


def point_spread(widths: Sequence[SpeckleWidth], probe: Probe) -> PointSpread:
    """From the widths at some depths, of which axially the smallest counts, as texture only widens.

    Laterally it is the aperture with which `probe`, at its own frequency, focus and receive f-number, is closest to the
    measured widths at these depths, by least squares of their logarithms.
    """
    axial = [w.axial_mm for w in widths if np.isfinite(w.axial_mm)]
    band = BAND_SIGMA / min(axial) if axial else float("nan")
    measured = [(w.depth_mm, w.lateral_mm) for w in widths if np.isfinite(w.lateral_mm)]
    if not measured:
        return PointSpread(band, float("nan"))
    depth, lateral = np.array(measured).T
    apertures = np.geomspace(*_APERTURES_MM, 41)
    # Near the face the receive f-number makes the width, whatever the aperture: depths count by how much they tell
    misfits = [
        float(np.sum(np.log(replace(probe, aperture_mm=float(size)).speckle_sigma_mm(depth) / lateral) ** 2))
        for size in apertures
    ]
    best = apertures[int(np.argmin(misfits))]
    return PointSpread(band, float(best * probe.frequency_mhz))
