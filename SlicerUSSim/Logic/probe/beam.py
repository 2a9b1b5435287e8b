"""The beam of a probe: its parameters, and the widths that follow from apertures, foci and frequency."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from SlicerUSSim.Logic.base.declaration import Declared, Shown, parameter
from SlicerUSSim.Logic.probe.lens import LensBeam, lens_beam

NOMINAL_SPEED_M_S = 1540.0
#: -6 dB width of the main lobe of a uniform aperture, in wavelengths x f-number
MAIN_LOBE = 1.21
#: Smallest f-number of a focus on transmission and of the lens
LEAST_F_NUMBER = 0.5
FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
#: Part of the curvature with which speckle has the correlation of two equal apertures wherever the transmit beam is
#: wider than the receive beam: as in a wave simulation of 60 % bandwidth (docs/physics.md#wavefront-curvature)
CURVED = 0.6
#: Largest number of focal zones
MOST_ZONES = 8
#: Amplitude of twice the pulse's frequency that leaves the face itself, and of the rest of the pulse in the band,
#: relative to the harmonic at the focus: typical of transmitters (docs/physics.md#harmonic-imaging)
LEAKED = 0.1
#: f-number of a beam that is wide compared with all others
_NO_FOCUS = 1e4
#: {parameter of the transmit beam: the kind of transmission that it is for}
TRANSMIT_OF = {"focal_zones": "zones", "transmit_angles": "angles", "largest_angle_deg": "angles"}
if TYPE_CHECKING:

    class MmOrNone:
        """A number of millimetres that may be given as None, until the probe's depth is set."""

        def __get__(self, instance: object, owner: Any) -> float: ...
        def __set__(self, instance: object, value: float | None) -> None: ...

else:
    MmOrNone = float | None
#: None until the probe's depth is set. Typed Any, since constructed probes never have None
_BY_DEPTH: Any = None


@dataclass(frozen=True, kw_only=True)
class Beam(Declared):
    """The part of a Probe that forms its beam (docs/physics.md#4-beam-and-pulse)."""

    frequency_mhz: float = parameter(
        5.0, "Frequency", "Centre frequency of the pulse; higher: finer resolution, less penetration",
        unit="MHz", bounds=(0.5, 40), shown=Shown(1, 20, 0.1, is_slider=True),
    )  # fmt: skip
    harmonic: bool = parameter(
        False, "Harmonic imaging",
        "Receive at twice the frequency of the pulse: narrower beams, weaker side lobes, dark near the face",
        shown=True,
    )  # fmt: skip
    band_mhz: tuple[float, float] | None = parameter(
        None, "Band", "Frequencies that the array receives, -6 dB; a harmonic must be among them; none: any",
        unit="MHz", bounds=(0.1, 100),
    )  # fmt: skip
    fractional_bandwidth: float = parameter(
        0.5, "Bandwidth", "Relative bandwidth of the two-way pulse, -6 dB", bounds=(0.05, 1.5)
    )
    focus_mm: MmOrNone = parameter(  # noqa: RUF009, which ignores descriptors
        _BY_DEPTH, "Focus", "Depth of the transmit focus; none (panels: 0): 60 % of the image depth", unit="mm",
        bounds=(0.1, 1000), shown=Shown(0, 300, is_slider=True, none_at=0.0), can_be_none=True,
    )  # fmt: skip
    transmit: str = parameter(
        "focus", "Transmit",
        "focus: one focus. zones: several foci. angles: plane or diverging waves at several angles, in focus at every "
        "depth",
        choices=("focus", "zones", "angles"), shown=True,
    )  # fmt: skip
    focal_zones: int = parameter(
        3, "Focal zones", "Number of foci with zones, evenly over twice the focal depth", bounds=(2, MOST_ZONES),
    )  # fmt: skip
    transmit_angles: int = parameter(
        5, "Angles", "Number of waves with angles; 1: without focus", bounds=(1, 255),
    )  # fmt: skip
    largest_angle_deg: float = parameter(
        10.0, "Largest angle", "Angle of the outermost waves to the axis",
        unit="°", bounds=(0.1, 60),
    )  # fmt: skip
    aperture_mm: float = parameter(
        12.0, "Aperture", "Lateral size of the fully open aperture", unit="mm", bounds=(0.5, 200)
    )
    receive_f_number: float = parameter(
        2.5, "Receive f-number", "Smallest f-number of the receive aperture, which grows with depth",
        bounds=(0.5, 20),
    )  # fmt: skip
    receive_apodization: float = parameter(
        0.0, "Apodisation", "0: uniform receive aperture; 1: Hann, with lower side lobes and a wider beam",
        bounds=(0, 1),
    )  # fmt: skip
    clutter_db: float | None = parameter(
        -36.0, "Clutter", "Diffuse echoes from beside the beam, which fill cysts, relative to echoes of the beam; "
        "none: only side lobes", unit="dB", bounds=(-100, 0),
    )  # fmt: skip
    element_mm: float | None = parameter(
        None, "Element", "Width of the elements: wider ones darken steered lines; none: half a wavelength", unit="mm",
        bounds=(0.01, 10),
    )  # fmt: skip
    directivity: str = parameter(
        "soft", "Directivity", "Loss of steered lines. soft: elements in a soft baffle, as measured on arrays. rigid: "
        "less. none: no loss", choices=("soft", "rigid", "none"),
    )  # fmt: skip
    elevation_aperture_mm: float = parameter(
        7.0, "Elevational aperture", "Height of the elements", unit="mm", bounds=(0.5, 100)
    )
    elevation_focus_mm: MmOrNone = parameter(  # noqa: RUF009
        _BY_DEPTH, "Elevational focus", "Depth of the focus of the lens; none: 60 % of the image depth", unit="mm",
        bounds=(0.1, 1000), can_be_none=True,
    )  # fmt: skip

    @property
    def wavelength_mm(self) -> float:
        """Wavelength of the echoes at the nominal speed of sound of 1540 m/s, for which arrays are designed."""
        return NOMINAL_SPEED_M_S / self.received_mhz * 1e-3

    @property
    def received_mhz(self) -> float:
        """Centre frequency of the echoes before attenuation: that of the pulse, or of its second harmonic."""
        return self.frequency_mhz * (2.0 if self.harmonic else 1.0)

    @property
    def received_bandwidth(self) -> float:
        """-6 dB bandwidth as a fraction of received_mhz. The square of a Gaussian pulse is shorter by the root of 2."""
        return self.fractional_bandwidth / (np.sqrt(2.0) if self.harmonic else 1.0)

    @property
    def clutter_power(self) -> float:
        """Power of the clutter relative to the beam; 0 without."""
        return 0.0 if self.clutter_db is None else 10.0 ** (self.clutter_db / 10.0)

    @property
    def cycles_per_mm(self) -> float:
        """Cycles of the received frequency per millimetre of *depth* (two-way travel)."""
        return 2.0 / self.wavelength_mm

    @property
    def axial_sigma_mm(self) -> float:
        """Standard deviation of the pulse envelope in depth.

        A Gaussian spectrum whose amplitude is halved (-6 dB) at f0 (1 +- b/2) has sigma_f = b f0 / FWHM_PER_SIGMA, and
        sigma_t = 1 / (2 pi sigma_f); depth is c t / 2.
        """
        sigma_mhz = self.received_bandwidth * self.received_mhz / FWHM_PER_SIGMA
        return NOMINAL_SPEED_M_S * 1e-3 / (4.0 * np.pi * sigma_mhz)

    def beam_sigma_mm(self, depth_mm, cosine: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """(lateral, elevational) standard deviation of the two-way beam amplitude at `depth_mm` along a scan line.

        The aperture of a steered line is foreshortened by the `cosine` of its angle to the normal of the face.
        """
        depth = np.asarray(depth_mm, dtype=float)
        transmit, receive = self.lateral_sigmas_mm(depth, cosine)
        lateral = transmit * receive / np.hypot(transmit, receive)
        sigma = self.lens().sigma_mm.astype(float)
        return lateral, np.interp(depth, np.linspace(0.0, self.displayed_mm, len(sigma)), sigma)

    def lateral_sigmas_mm(self, depth_mm, cosine: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """(transmit, receive) standard deviations of the lateral one-way beams, as for beam_sigma_mm."""
        depth = np.asarray(depth_mm, dtype=float)
        zones = [(sigma / cosine, focus, length / cosine**2) for sigma, focus, length in self.transmit_zones()]
        if zones:
            transmit = np.min([self._gaussian_beam(depth, *zone) for zone in zones], axis=0)
        else:
            transmit = self._focused_everywhere(depth, *self.compounded_beam()) / cosine
        return transmit, self._focused_everywhere(depth, *self.receive_beam()) / cosine

    def steered_level(self, angle_rad) -> np.ndarray:
        """Amplitude of echoes along lines at these angles to the normal of the face, relative to a line along it.

        Elements w wide send and receive sinc(w sin a / wavelength), in a soft baffle cos a of that (A. R. Selfridge, G.
        S. Kino, B. T. Khuri-Yakub, Appl. Phys. Lett. 37(1), 1980). The beam, wider by 1 / cos a, keeps its power of
        speckle, so that the echo of a point is lowered by the elements alone.
        """
        sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
        if self.directivity == "none":
            return np.ones_like(cosine)
        width = 0.5 * self.wavelength_mm if self.element_mm is None else self.element_mm

        def pattern(mhz: float) -> np.ndarray:
            of_baffle = cosine if self.directivity == "soft" else 1.0
            return np.sinc(width * mhz * 1e3 / NOMINAL_SPEED_M_S * sine) * of_baffle

        sent = pattern(self.frequency_mhz)
        return (sent**2 if self.harmonic else sent) * pattern(self.received_mhz) / np.sqrt(cosine)

    def speckle_sigma_mm(self, depth_mm) -> np.ndarray:
        """Lateral sigma of the uncurved beam whose speckle correlates over the same distance.

        Speckle d apart has the correlation exp(-d^2 / 4 sigma^2). With SimulationSettings.wavefront_curvature the phase
        of the beam is k y^2 / 2 at the distance y from its axis, k^2 = CURVED (1 / receive^4 - 1 / transmit^4).
        """
        transmit, receive = self.lateral_sigmas_mm(depth_mm)
        more = np.maximum(receive**-2.0 - transmit**-2.0, 0.0)
        return (transmit**-2.0 + receive**-2.0 + CURVED * more) ** -0.5

    def receive_beam(self) -> tuple[float, float]:
        """(least sigma in mm, sigma per mm of depth) of the one-way lateral receive beam, focused at every depth."""
        per_f_number = MAIN_LOBE * widening(self.receive_apodization) * self.wavelength_mm / FWHM_PER_SIGMA
        return per_f_number * self.receive_f_number, per_f_number / self.aperture_mm

    @property
    def lens_height_mm(self) -> float:
        """Size of the elevational aperture; elements farther aside than the focus is deep hardly contribute."""
        return min(self.elevation_aperture_mm, self.elevation_focus_mm / LEAST_F_NUMBER)

    def lens(self) -> LensBeam:
        """The two-way elevational beam, by the diffraction integral of the lens."""
        spread = float(self.received_bandwidth / FWHM_PER_SIGMA)
        height = self.lens_height_mm
        return lens_beam(self.wavelength_mm, spread, height, self.elevation_focus_mm, self.displayed_mm, self.harmonic)

    def harmonic_level(self, depth_mm) -> np.ndarray:
        """Amplitude of the second harmonic at `depth_mm` relative to the fundamental, 1 at the transmit focus.

        In the quasi-linear approximation the square of a Gaussian beam feeds a Gaussian beam of twice the frequency and
        the same Rayleigh lengths, whose amplitude grows by 1 / sqrt((1 + i b)(1 + i c)) per millimetre, with b and c
        the distances to the lateral and elevational foci in these lengths (M. F. Hamilton, D. T. Blackstock, Nonlinear
        Acoustics, 1998, chapter 8). To it comes, in quadrature, what is sent at this frequency already (LEAKED), so
        that there is some of it at the face. Zones have gains by which their levels agree where one takes over from
        the other, as a scanner joins them.
        """
        depth = np.asarray(depth_mm, dtype=float)
        path = np.linspace(0.0, max(float(depth.max(initial=0.0)), self.focus_mm), 4097)
        _, focus, rayleigh = self.elevation_waist()
        aside = 1.0 / np.sqrt(1.0 + 1j * (path - focus) / rayleigh)
        zones = self.transmit_zones()
        if not zones:  # each of the waves is plane
            found = np.abs(_running_integral(aside, path))
        else:
            widths = np.array([self._gaussian_beam(path, *zone) for zone in zones])
            grown = [
                np.abs(_running_integral(aside / np.sqrt(1.0 + 1j * (path - at) / length), path)) / np.sqrt(sigma)
                for sigma, at, length in zones
            ]
            used, grown = widths.argmin(axis=0), np.array(grown)
            found = np.take_along_axis(grown, used[None], axis=0)[0]
            for border in np.flatnonzero(np.diff(used)) + 1:
                found[border:] *= grown[used[border - 1], border] / grown[used[border], border]
        found = np.hypot(found / np.interp(self.focus_mm, path, found), LEAKED) / np.hypot(1.0, LEAKED)
        return np.interp(depth, path, found)

    def transmit_zones(self) -> list[tuple[float, float, float]]:
        """(sigma at the focus, focus, Rayleigh length) in mm of every transmit focus; empty if all depths are in focus.

        Zones are at the odd multiples of focus_mm / focal_zones. At every depth the narrowest is used.
        """
        return [self._sent(*zone) for zone in self.transmit_apertures()]

    def transmit_apertures(self) -> list[tuple[float, float]]:
        """(focus, lateral size) in mm of the aperture of each of transmit_zones."""
        if self.transmit == "angles":
            return []
        if self.transmit == "focus":
            return [(self.focus_mm, self.aperture_mm)]
        foci = self.focus_mm * (2.0 * np.arange(self.focal_zones) + 1.0) / self.focal_zones
        return [(focus, min(self.aperture_mm, focus / self.receive_f_number)) for focus in foci.tolist()]

    def zone_at(self, depth_mm: np.ndarray) -> np.ndarray:
        """Which of transmit_zones is used at `depth_mm`, the narrowest; there must be one."""
        return np.argmin([self._gaussian_beam(depth_mm, *zone) for zone in self.transmit_zones()], axis=0)

    def compounded_beam(self) -> tuple[float, float]:
        """(least sigma in mm, sigma per mm of depth) of the lateral transmit beam of compounded waves.

        The coherent sum of n waves up to the angles +-a is the beam of an aperture seen under n / (n - 1) 2 a (G.
        Montaldo et al., IEEE TUFFC 56(3), 2009), at most that of the face.
        """
        per_f_number = MAIN_LOBE * self.wavelength_mm / FWHM_PER_SIGMA
        count = self.transmit_angles
        f_number = (count - 1) / count / (2.0 * np.sin(np.deg2rad(self.largest_angle_deg)))
        if count == 1:
            f_number = _NO_FOCUS
        return per_f_number * f_number, per_f_number / self.face_mm

    @property
    def face_mm(self) -> float:
        """Lateral size of all elements that can transmit, defined by each kind."""
        raise NotImplementedError

    @property
    def displayed_mm(self) -> float:
        """Largest distance from line_at's origin within the imaged field, defined by each kind."""
        raise NotImplementedError

    def elevation_waist(self) -> tuple[float, float, float]:
        """(sigma at the focus, focus, Rayleigh length) of the one-way elevational beam of the pulse, millimetres."""
        return self._waist(self.elevation_focus_mm, self.elevation_aperture_mm)

    def _waist(self, focus_mm: float, aperture_mm: float) -> tuple[float, float, float]:
        # Elements farther aside than the focus is deep hardly contribute (and scanners close them).
        f_number = max(focus_mm / aperture_mm, LEAST_F_NUMBER)
        wavelength = NOMINAL_SPEED_M_S / self.frequency_mhz * 1e-3
        sigma = MAIN_LOBE * wavelength * f_number / FWHM_PER_SIGMA
        # A Gaussian beam of amplitude exp(-y^2 / w^2), w^2 = 2 sigma^2, has the Rayleigh length pi w^2 / wavelength.
        return sigma, focus_mm, 2.0 * np.pi * sigma**2 / wavelength

    def _sent(self, focus_mm: float, aperture_mm: float) -> tuple[float, float, float]:
        # The harmonic has the profile of the square of the pulse's beam.
        sigma, focus, rayleigh = self._waist(focus_mm, aperture_mm)
        return (sigma / float(np.sqrt(2.0)) if self.harmonic else sigma), focus, rayleigh

    @staticmethod
    def _focused_everywhere(depth, least, slope):
        return np.maximum(least, slope * depth)

    @staticmethod
    def _gaussian_beam(depth, sigma, focus, rayleigh):
        return sigma * np.sqrt(1.0 + ((depth - focus) / rayleigh) ** 2)


def apodized_pattern(u: np.ndarray, apodization: float) -> np.ndarray:
    """The amplitude, 1 at u = 0, at u wavelengths x f-number from the axis of an aperture with weights, at its focus.

    The weights are 1 - a + a cos(pi x)^2 for x from -1/2 to 1/2: the transform of a constant and of a cosine.
    """
    half = 0.5 * apodization
    if not apodization:
        return np.sinc(u)
    return np.sinc(u) + 0.5 * half / (1.0 - half) * (np.sinc(u - 1.0) + np.sinc(u + 1.0))


@cache
def widening(apodization: float) -> float:
    """The -6 dB width of the main lobe of an aperture with weights (apodized_pattern) relative to a uniform one."""
    u = np.linspace(0.5, 1.1, 1201)  # half widths: 0.603 with 0, 1 with 1
    uniform, weighted = (float(np.interp(-0.5, -apodized_pattern(u, a), u)) for a in (0.0, apodization))
    return weighted / uniform


def _running_integral(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(places)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])
