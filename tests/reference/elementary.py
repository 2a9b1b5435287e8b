"""Elementary functions in float32, as in kernels/common.clh."""

from __future__ import annotations

import numpy as np

LOG2_E = np.float32(1.44269504089)
LN10_OVER_20 = np.float32(0.11512925465)


def f32(value) -> np.ndarray:
    """A scalar or an array as float32."""
    return np.asarray(value, np.float32)


def exp2(x: np.ndarray) -> np.ndarray:
    """2^x by the kernels' polynomial."""
    whole = np.floor(x)
    f = x - whole
    p = f32(0.00150)
    for coefficient in (0.00961813, 0.05550411, 0.24022651, 0.69314718, 1.0):
        p = f32(coefficient) + f * p
    return p * ((whole.astype(np.int32) + 127) << 23).view(np.float32)


def log2(x: np.ndarray) -> np.ndarray:
    """The kernels' log2(x) for normal x > 0."""
    bits = f32(x).view(np.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    m = (bits - (exponent << 23)).view(np.float32)
    t = (m - f32(1)) / (m + f32(1))
    t2 = t * t
    series = f32(0.4121986)
    for coefficient in (0.57707802, 0.96179669, 2.88539008):
        series = f32(coefficient) + t2 * series
    return exponent.astype(np.float32) + t * series


def exp(x: np.ndarray) -> np.ndarray:
    return exp2(np.maximum(x * LOG2_E, f32(-125)))


def log(x: np.ndarray) -> np.ndarray:
    return log2(x) / LOG2_E


def turn(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(cos, sin) of 2 pi t."""
    t = t - np.floor(t + f32(0.5))
    angle = f32(2.0 * np.pi) * t
    return np.cos(angle), np.sin(angle)


def hash_mix(x: np.ndarray) -> np.ndarray:
    """Wellons' "lowbias32" on uint32."""
    x = x ^ (x >> np.uint32(16))
    x = x * np.uint32(0x7FEB352D)
    x = x ^ (x >> np.uint32(15))
    x = x * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def gaussian(bits: np.ndarray) -> np.ndarray:
    """N(0, 1) from 32 random bits: the sum of four bytes with a cubic correction."""
    total = sum(((bits >> np.uint32(8 * byte)) & np.uint32(255) for byte in range(4)), np.uint32(0))
    z = (total.astype(np.float32) - f32(510)) * f32(0.00676579)
    return z * (f32(0.94903328) + f32(0.01864238) * z * z)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products of (..., 3) vectors, summed in the order x, y, z."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(dot(a, a))


def unit(a: np.ndarray) -> np.ndarray:
    return a / length(a)[..., None]


def ramp(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Smooth step from 0 to 1 as x goes from low to high, with zero slope at the ends."""
    t = np.clip((x - f32(low)) / (f32(high) - f32(low)), f32(0), f32(1))
    return t * t * (f32(3) - f32(2) * t)


def sum8(a: np.ndarray) -> np.ndarray:
    """Sums over the last axis of eight, halves first."""
    b = a[..., :4] + a[..., 4:]
    c = b[..., :2] + b[..., 2:]
    return c[..., 0] + c[..., 1]


def affine_point(m: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(..., 3) points by the (3, 4) map, summed in the kernels' order."""
    return np.stack([r[0] * p[..., 0] + r[1] * p[..., 1] + r[2] * p[..., 2] + r[3] for r in m.reshape(3, 4)], axis=-1)


def affine_vector(m: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.stack([r[0] * p[..., 0] + r[1] * p[..., 1] + r[2] * p[..., 2] for r in m.reshape(3, 4)], axis=-1)
