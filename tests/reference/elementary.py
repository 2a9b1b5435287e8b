"""Hashes and random numbers, equal in every bit to those of kernels/common.clh."""

from __future__ import annotations

import numpy as np

#: Factors of the indices of lattice cells along x, y and z
_STEPS = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint32)


def hash_mix(x: np.ndarray) -> np.ndarray:
    """Wellons' "lowbias32" of uint32."""
    x = x ^ (x >> np.uint32(16))
    x = x * np.uint32(0x7FEB352D)
    x = x ^ (x >> np.uint32(15))
    x = x * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def hash_of_cells(cells: np.ndarray, seed: int) -> np.ndarray:
    """(n,) uint32 random bits of lattice cells, (n, 3) whole numbers."""
    steps = (cells.astype(np.int64).astype(np.uint32) * _STEPS).sum(axis=-1, dtype=np.uint32)
    return hash_mix(steps ^ np.uint32(seed % 2**32))


def gaussian(bits: np.ndarray) -> np.ndarray:
    """N(0, 1) from 32 random bits: the sum of four bytes with a cubic correction."""
    total = sum((bits >> np.uint32(8 * byte)) & np.uint32(255) for byte in range(4))
    z = (total.astype(np.float32) - np.float32(510)) * np.float32(0.00676579)
    return z * (np.float32(0.94903328) + np.float32(0.01864238) * z * z)
