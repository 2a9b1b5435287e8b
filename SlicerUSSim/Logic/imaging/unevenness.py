"""Echogenicity that varies within a tissue, for kernels/scattering.cl (docs/physics.md#uneven-tissue).

The level of a tissue's scatterers, in dB, is a random field g of unit variance times texture_db, plus specks: spheres
that are speck_db brighter in their middle, less by the square of the distance from there. Both come from hashes of
lattice indices, as scatterers do, and are fixed in the patient. Amplitudes are divided by the root of the mean power,
so that the tissue keeps its echogenicity.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from SlicerUSSim.Logic.opencl.layout import CONSTANTS

#: Distance, in steps of the lattice of g, at which its correlation is one half
HALF_CORRELATION = 0.754
#: Decibels to exponents of two of an amplitude
_LOG2_PER_DB = np.log2(10.0) / 20.0


def unevenness_table(tissues: np.ndarray) -> np.ndarray:
    """(labels, 8) float32 by layout.TISSUE, CONSTANTS["UNEVEN_WORDS"] numbers each.

    Steps of the lattice of g per mm, 0 for none; exponent of two of the amplitude per standard deviation; of all
    scatterers, which keeps the mean power; lattice cells of specks per mm, 0 for none; share of cells with one, in
    1/65536; exponent in their middle.
    """
    deviation, length, number, bright = (
        tissues[name].astype(float) for name in ("texture_db", "texture_mm", "specks_per_mm3", "speck_db")
    )
    table = np.zeros((len(tissues), CONSTANTS["UNEVEN_WORDS"]))
    has_texture = deviation > 0.0
    has_specks = (number > 0.0) & (bright > 0.0)
    per_mm = 1.0 / np.where(length > 0.0, length, 1.0)
    table[:, 0] = np.where(has_texture, HALF_CORRELATION * per_mm, 0.0)
    table[:, 1] = np.where(has_texture, _LOG2_PER_DB * deviation, 0.0)
    table[:, 3] = np.where(has_specks, 0.5 * per_mm, 0.0)
    share = np.minimum(np.rint(65536.0 * number * (2.0 * length) ** 3), 65536.0)
    table[:, 4] = np.where(has_specks, share, 0.0)
    table[:, 5] = np.where(has_specks, _LOG2_PER_DB * bright, 0.0)
    # The mean of 10^(d g / 10) of a normal g is exp((d ln 10 / 10)^2 / 2)
    neper = np.log(10.0) / 10.0 * np.where(has_texture, deviation, 0.0)
    power = np.exp(0.5 * neper**2)
    power *= 1.0 + table[:, 4] / 65536.0 * (np.array([speck_power(float(db)) for db in bright]) - 1.0)
    table[:, 2] = -0.5 * np.log2(power)
    return table.astype(np.float32)


def is_uneven(table: np.ndarray) -> bool:
    """Whether some tissue of an unevenness_table varies."""
    return bool((table[:, [0, 3]] > 0.0).any())


@cache
def speck_power(speck_db: float) -> float:
    """Mean power in a cell of the lattice of specks that has one, re tissue: 10^(db max(0, 1 - r^2) / 10), r from 0 in
    the middle to 1 at the faces."""
    axis = (np.arange(64) + 0.5) / 32.0 - 1.0
    squared = axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2
    return float((10.0 ** (0.1 * speck_db * np.maximum(1.0 - squared, 0.0))).mean())
