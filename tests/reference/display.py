"""From the baseband signal to pixels (docs/physics.md#6-from-rf-to-image). Of frames, inputs alone are read."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB
from SlicerUSSim.Logic.imaging.grey_map import grey_table
from SlicerUSSim.Logic.imaging.stage import DeviceFrame
from tests.reference.beam import Beam
from tests.reference.elementary import gaussian, hash_mix
from tests.reference.lines import samples_from_face


def image_of(frame: DeviceFrame, iq: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8 image of a baseband signal (scan lines, samples)."""
    grey = grey_levels(frame, smoothed(frame, envelope_of(frame, iq)))
    return scan_converted(frame, with_edges(frame, grey))


def envelope_of(frame: DeviceFrame, iq: np.ndarray) -> np.ndarray:
    """(scan lines, samples): with ring-down, amplifier noise, time-gain compensation and sliders."""
    display, probe, beam = frame.display, frame.probe, Beam(frame.acquisition)
    below, sample_mm = samples_from_face(beam, *iq.shape), beam.of["sample_mm"]
    if frame.settings.ring_down:
        iq = iq + np.where(below >= 0, ring_down(frame, iq.shape[1])[np.maximum(below, 0)], 0.0)
    if display.noise_db is not None:
        seed = frame.acquisition["seed"].reshape(1) * np.uint32(0x9E3779B1) + np.uint32(0x7F4A7C15)
        key = seed + hash_mix(np.array([frame.noise_seed], np.uint32))
        line, sample = (np.arange(n, dtype=np.uint32) for n in iq.shape)
        key = hash_mix(sample * np.uint32(0x9E3779B1) + (key + line * np.uint32(0x85EBCA77))[:, None])
        noise = gaussian(key) + 1j * gaussian(hash_mix(key + np.uint32(0x9E3779B9)))
        iq = iq + 10.0 ** (display.noise_db / 20.0) / np.sqrt(2.0) * noise
    depth_mm = np.maximum(below, 0) * sample_mm
    path_cm = 0.2 * np.minimum(depth_mm, display.tgc_reach * probe.depth_mm)
    loss = path_cm * display.tgc_db_cm_mhz * beam.of["frequency_mhz"] * np.log(10.0) / 20.0
    gain_db = 20.0 / np.log(10.0) * (loss - beam.gain_of_band(loss))
    sliders = [getattr(display, f"depth_gain_{n}_db") for n in range(1, 9)]
    gain_db += np.interp(depth_mm, (np.arange(8) + 0.5) * probe.depth_mm / 8.0, sliders)
    gain_db += display.near_gain_db * np.exp(-depth_mm / 6.0)
    knots = [getattr(display, f"line_gain_{n}_db") for n in range(1, 6)]
    gain_db += np.interp(np.linspace(0.0, 4.0, len(iq)), np.arange(5), knots)[:, None]
    return np.sqrt(np.abs(iq) ** 2 + 1e-30) * 10.0 ** (gain_db / 20.0)


def ring_down(frame: DeviceFrame, samples: int) -> np.ndarray:
    """(samples,) complex: pulses one width apart, of alternating sign, that fall by 40 dB over the ring-down."""
    probe, sigma, beam = frame.probe, frame.axial_sigma_mm, Beam(frame.acquisition)
    depth, signal = np.arange(samples) * beam.of["sample_mm"], np.zeros(samples, complex)
    sign, place = 1.0, 0.0
    while place < 2.0 * probe.ring_down_mm:
        level = 10.0 ** ((probe.ring_down_db - 40.0 * place / probe.ring_down_mm) / 20.0)
        carrier = np.exp(-2j * np.pi * beam.of["cycles_per_mm"] * place)
        signal += sign * level * carrier * np.exp(-0.5 * ((depth - place) / sigma) ** 2)
        sign, place = -sign, place + np.sqrt(8.0 * np.log(2.0)) * sigma
    return signal * (probe.harmonic_level(depth) if probe.harmonic else 1.0)


def smoothed(frame: DeviceFrame, envelope: np.ndarray) -> np.ndarray:
    """The envelope (scan lines, samples) after Gaussians along and across the lines."""
    display, probe = frame.display, frame.probe
    across = np.deg2rad(display.smoothing_lateral_deg) * (probe.focus_mm if probe.is_linear else 1.0)
    sigmas = display.smoothing_axial_mm / float(frame.acquisition["sample_mm"]), across / probe.line_spacing
    for axis, sigma in zip((1, 0), sigmas, strict=True):
        if sigma > 0.0:
            reach = min(max(int(np.ceil(2.6 * sigma)), 1), 128)
            envelope = ndimage.gaussian_filter1d(envelope, sigma, axis=axis, mode="nearest", radius=reach)
    return envelope


def grey_levels(frame: DeviceFrame, envelope: np.ndarray) -> np.ndarray:
    """(scan lines, samples) uint8 by log compression and the grey map."""
    part = 1.0 + (20.0 * np.log10(envelope) - FULL_SCALE_DB + frame.display.gain_db) / frame.display.dynamic_range_db
    table = grey_table(frame.display)
    return (np.interp(part, np.linspace(0.0, 1.0, len(table)), table) + 0.5).astype(np.uint8)


def with_edges(frame: DeviceFrame, grey: np.ndarray) -> np.ndarray:
    """Grey levels (scan lines, samples) uint8 with more of their difference to a mean over three lines and a mm."""
    step = max(round(0.125 / float(frame.acquisition["sample_mm"])), 1)
    across, along = np.ones((3, 1)) / 3.0, np.zeros((1, 8 * step + 1))
    along[0, ::step] = 1.0 / 9.0
    mean = ndimage.correlate(ndimage.correlate(grey.astype(float), along, mode="nearest"), across, mode="nearest")
    sharp = grey + frame.display.edge_enhancement * (grey - mean)
    return (np.clip(sharp, 0.0, 255.0) + 0.5).astype(np.uint8)


def scan_converted(frame: DeviceFrame, grey: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8 from grey levels: linear along lines, cubic (Catmull-Rom) across, 0 outside the field."""
    of, grid, (lines, samples) = Beam(frame.acquisition).of, frame.grid, grey.shape
    width = max(round(grid.pixel_spacing_mm[1] / of["sample_mm"]), 1)
    last = int(np.ceil(of["depth_mm"] / of["sample_mm"])) - 1  # of the image
    around = np.clip(np.arange(samples)[:, None] + np.arange(width) - width // 2, 0, last)
    grey = np.floor(grey[:, around].mean(axis=2) + 0.5)
    x = grid.left_mm + (np.arange(grid.columns) + 0.5) * grid.pixel_spacing_mm[0]
    y = grid.top_mm + (np.arange(grid.rows)[:, None] + 0.5) * grid.pixel_spacing_mm[1]
    if of["linear"]:
        sine, cosine = of["steering_sin"], of["steering_cos"]
        lateral, depth = x * cosine - y * sine, x * sine + y * cosine + of["start_mm"]
    else:
        from_apex = y + of["apex_radius_mm"]
        depth = np.hypot(x, from_apex) - of["apex_radius_mm"]
        lateral = np.where(from_apex > 0.0, np.arctan2(x, from_apex), 1e9)
    place = (lateral - of["first_line"]) / of["line_spacing"]
    inside = (place >= -0.5) & (place <= lines - 0.5) & (depth >= 0.0) & (depth < of["depth_mm"])
    inside &= (y >= of["top_mm"]) & (y < of["bottom_mm"])
    sample, place = depth[inside] / of["sample_mm"], np.clip(place[inside], 0.0, lines - 1.0)
    bins, line = np.minimum(sample.astype(int), samples - 2), place.astype(int)
    part, t = np.minimum(sample - bins, 1.0), place - line
    a, b, c, d = (
        grey[at, bins] * (1.0 - part) + grey[at, bins + 1] * part
        for at in (np.clip(line + n, 0, lines - 1) for n in (-1, 0, 1, 2))
    )
    value = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
    image = np.zeros((grid.rows, grid.columns), np.uint8)
    image[inside] = np.clip(value, 0.0, 255.0) + 0.5
    return image
